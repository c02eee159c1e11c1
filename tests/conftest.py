"""Settings and fixtures of all tests."""

from __future__ import annotations

import gc
import os
import signal
from pathlib import Path

import pytest

# Workers share the cores: threads that wait for others must not keep a core busy.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# A shell that starts the tests in the background, or nohup, makes them and their child processes
# ignore the signals that end a process.
signal.signal(signal.SIGINT, signal.default_int_handler)
for name in ("SIGHUP", "SIGQUIT"):
    if hasattr(signal, name):
        signal.signal(getattr(signal, name), signal.SIG_DFL)

#: A test that uses one of these waits for another process: all commands in a row, or a browser.
SLOW_FIXTURES = {"pipeline", "browser", "tab"}

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    # All tests of all files are half a million objects: the collector goes through them neither
    # again and again while they are made, nor at each full collection later.
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(items):
    for item in items:
        if SLOW_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    # All tests of a file run in one worker. Slow files come first; no worker waits at the end.
    # One worker runs all stages first, whose compiled functions other tests need.
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path.name != "test_pipeline.py", item.path not in slow))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of published reference data; skip where a checkout lacks it."""
    if not SHARED.is_dir():
        pytest.skip(f"the reference data is not there ({SHARED})")
    return SHARED
