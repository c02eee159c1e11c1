"""A page on this computer with the camera's picture and the tracker's results."""

from neurosim.watch.server import PageServer
from neurosim.watch.viewer import Viewer

__all__ = ["PageServer", "Viewer"]
