"""Where compiled functions are kept between two runs."""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

#: Folders of machine code are named after it and what they were compiled from.
_PREFIX = "neurosim-compiled-"


#: Folders of sources, until :func:`keep_compiled` has named where their machine code is kept.
_later: list[Path] = []


class _BeforeNumba:
    """Has the folder named when Numba is imported: that takes a moment, and not all need it."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> None:
        """Find no module, and see that Numba is asked for."""
        if name == "numba":
            _named_now()


def keep_compiled_later(*packages: Path) -> None:
    """Have :func:`keep_compiled` called before Numba is imported, or now if it is already."""
    _later.extend(packages)
    sys.meta_path.insert(0, _BeforeNumba)
    if "numba" in sys.modules:
        _named_now()


def _named_now() -> None:
    packages = tuple(_later)
    _later.clear()
    if packages:
        keep_compiled(*packages)


def keep_compiled(*packages: Path) -> None:
    """Name a folder for what Numba compiles from the sources as they are.

    Numba looks at the file of the outermost function alone: after an edit of one that it calls, it
    would go on with the machine code of before. So the folder is another one wherever a source
    next to compiled functions differs. It is in ``NUMBA_CACHE_DIR``, next to the source, or in the
    user's cache. Where none can be written to, as in an installation that is read-only for a user
    without a home, it is one of this process's own, removed at its end.

    Args:
        packages: folders of the sources; it may be kept next to the first.
    """
    name = _PREFIX + _digest(packages)
    asked = os.environ.get("NUMBA_CACHE_DIR")
    if asked and Path(asked).name == name:  # of the process that started this one
        return
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    for place in [Path(asked)] if asked else [packages[0] / "__pycache__", Path(cache)]:
        try:
            (place / name).mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=place / name):
                os.environ["NUMBA_CACHE_DIR"] = str(place / name)
                return
        except OSError:
            pass
    # Nobody else may write there: what is kept in it runs when it is loaded.
    folder = tempfile.mkdtemp(prefix=_PREFIX)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = folder


def compiled_ahead() -> Path:
    """Return the file next to the machine code that marks all of a demo as compiled."""
    _named_now()
    return Path(os.environ["NUMBA_CACHE_DIR"]) / "compiled-ahead"


def _digest(packages: tuple[Path, ...]) -> str:
    """Return a digest of all sources in folders that have compiled functions.

    Their neighbours count, too: compiled functions take in constants of theirs.
    """
    sources = {p: p.read_bytes() for package in packages for p in package.rglob("*.py")}
    folders = {path.parent for path, source in sources.items() if b"import numba" in source}
    folders |= {path.parent for path, source in sources.items() if b"from numba" in source}
    digest = hashlib.sha256()
    for path in sorted(sources):
        if path.parent in folders:
            digest.update(sources[path])
    return digest.hexdigest()[:16]
