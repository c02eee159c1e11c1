"""A walking robot of the lab, and its floors."""

from neurosim.lab.walker.robot import FLOORS, Ground, VirtualWalker

__all__ = ["FLOORS", "Ground", "VirtualWalker"]
