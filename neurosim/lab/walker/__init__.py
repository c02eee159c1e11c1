"""A walking robot of the lab, and its floors."""

from neurosim.lab.walker.robot import PLACES, Ground, VirtualWalker

__all__ = ["PLACES", "Ground", "VirtualWalker"]
