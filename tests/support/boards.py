"""Runs the programs of firmware/micropython on a computer."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

FIRMWARE = Path(__file__).parents[2] / "firmware"
RUN = Path(__file__).parents[1] / "firmware" / "boards" / "run.py"


def micropython(name: str, real: bool) -> list[str]:
    """Return the command that runs a program under MicroPython, or under Python itself."""
    run = [str(RUN), str(FIRMWARE / "micropython"), name]
    if not real:
        return [sys.executable, *run]
    if find_spec("micropython_unix") is None:
        pytest.skip("MicroPython's unix port is not installed: pip install neurosim[firmware]")
    return [sys.executable, "-m", "micropython_unix", *run]
