"""A page on this computer that shows what the camera sees and what the tracker makes of it."""

from neurosim.watch.server import PageServer
from neurosim.watch.viewer import Viewer

__all__ = ["PageServer", "Viewer"]
