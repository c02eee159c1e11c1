"""Where compiled functions are kept between two runs."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path


def keep_compiled(package: Path) -> None:
    """Name a folder for what Numba compiles where it would find none that it may write to.

    It keeps that beside the source or in the user's cache, and refuses to work where neither can
    be written: an installation that is read-only, for a user without a home. A folder of this
    process's own is made then, and removed at its end; what is compiled lasts no longer.

    Args:
        package: folder of the source.
    """
    if os.environ.get("NUMBA_CACHE_DIR") or os.access(package, os.W_OK):
        return
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    try:
        os.makedirs(cache, exist_ok=True)
        with tempfile.TemporaryFile(dir=cache):
            return
    except OSError:
        pass
    # Nobody else may write there: what is kept in it runs when it is loaded.
    folder = tempfile.mkdtemp(prefix="neurosim-compiled-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = folder
