"""What tests of every room share."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

# A shell that starts the tests in the background has them, and all that they start, ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Reference data made by others; a user's checkout has none beside it."""
    if not SHARED.is_dir():
        pytest.skip(f"the reference data is not there ({SHARED})")
    return SHARED
