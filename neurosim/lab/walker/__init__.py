"""A walking robot of the lab, and the places where it walks."""

from neurosim.lab.walker.robot import PLACES, Ground, VirtualWalker

__all__ = ["PLACES", "Ground", "VirtualWalker"]
