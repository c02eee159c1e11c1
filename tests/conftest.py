"""What tests of every room share."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Reference data made by others; a user's checkout has none beside it."""
    if not SHARED.is_dir():
        pytest.skip(f"the reference data is not there ({SHARED})")
    return SHARED
