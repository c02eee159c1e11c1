"""How tests wait for threads and processes: for a condition, never for a length of time."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

#: Seconds after which a test gives up. It only ends a test that would hang: no test that passes
#: comes near it, however slow or busy the machine.
PATIENCE = 900.0


def wait_until(condition: Callable[[], T], what: str = "what is waited for") -> T:
    """Return a condition's value as soon as it is true."""
    end = time.monotonic() + PATIENCE
    while not (value := condition()):
        assert time.monotonic() < end, f"{what} does not come"
        time.sleep(0.01)
    return value


_ENDED = """
import os, pathlib, signal, sys
from neurosim.base import files
append, rows = files.LineLog.append, 0

def counted(self, *values):
    global rows
    append(self, *values)
    rows += self.path == pathlib.Path({log!r}){counts}
    if rows == {count}:
        rows += 1
        os.kill(os.getpid(), signal.{signal})

files.LineLog.append = counted
sys.argv = ["neurosim", *{words!r}]
from neurosim.cli import main
main()
"""


def ended_by(
    signal: str, words, *, log: Path | str, count: int, word: str = "", cwd: Path
) -> subprocess.CompletedProcess:
    """Run a command that sends itself a signal once a log has a given number of rows.

    Args:
        signal: its name, such as SIGKILL.
        words: of the command line.
        log: path as the command opens it.
        count: number of rows after which the signal is sent.
        word: only rows with this value count; by default all rows.
        cwd: folder.
    """
    script = _ENDED.format(
        log=str(log),
        counts=f" and {word!r} in values" if word else "",
        count=count,
        signal=signal,
        words=[str(each) for each in words],
    )
    return subprocess.run(
        [sys.executable, "-c", script],
        cwd=cwd,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=PATIENCE,
    )
