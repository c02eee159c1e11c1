"""How tests wait for threads and processes: for a condition, never for a length of time."""

from __future__ import annotations

import time
from collections.abc import Callable
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
