"""The virtual lab: robots, their boards and arenas and a roof camera in software.

They are reached like real ones: by a serial line, and by the frames of a camera.
"""

from neurosim.lab.khepera.params import KheperaParams
from neurosim.lab.khepera.rig import VirtualKheperaRig, sampling_places
from neurosim.lab.lines.rig import VirtualLinesRig
from neurosim.lab.nxt.params import CameraParams, LabParams
from neurosim.lab.nxt.rig import VirtualRig
from neurosim.lab.nxt.world import Lab, Pacer, Push, Truth, read_truth
from neurosim.lab.ros.rig import VirtualRosRig
from neurosim.lab.thymio.rig import VirtualThymioRig

__all__ = [
    "CameraParams",
    "KheperaParams",
    "Lab",
    "LabParams",
    "Pacer",
    "Push",
    "Truth",
    "VirtualKheperaRig",
    "VirtualLinesRig",
    "VirtualRig",
    "VirtualRosRig",
    "VirtualThymioRig",
    "read_truth",
    "sampling_places",
]
