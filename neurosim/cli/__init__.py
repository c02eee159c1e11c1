"""The front door: one verb a stage of the road."""

from neurosim.cli.main import main

__all__ = ["main"]
