"""The command line: one command a stage of the pipeline."""

from neurosim.cli.main import main

__all__ = ["main"]
