"""The virtual lab: an NXT, its board and a roof camera in software, reached as real ones are."""

from neurosim.lab.params import CameraParams, LabParams
from neurosim.lab.rig import VirtualRig
from neurosim.lab.world import Lab, Pacer, Truth, read_truth

__all__ = ["CameraParams", "Lab", "LabParams", "Pacer", "Truth", "VirtualRig", "read_truth"]
