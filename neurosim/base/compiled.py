"""Compiled functions, and where their machine code is stored between two runs."""

from __future__ import annotations

import atexit
import contextlib
import functools
import hashlib
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

#: Beginning of the names of machine code folders; a digest of the sources follows.
_PREFIX = "neurosim-compiled-"
#: So long a process waits for another one that compiles a function, s.
_PATIENCE = 120.0


#: Folders of sources for which :func:`keep_compiled` has not been called yet.
_later: list[Path] = []


class _BeforeNumba:
    """Calls :func:`keep_compiled` when Numba is imported, because it takes a moment."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> None:
        """Find no module; notice the import of Numba."""
        if name == "numba":
            _named_now()


def keep_compiled_later(*packages: Path) -> None:
    """Call :func:`keep_compiled` before Numba is imported, or now if it is imported already."""
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
    """Set the folder for Numba's machine code, which depends on the content of the sources.

    Numba checks only the file of the outermost function: after an edit of a function that this one
    calls, it would use old machine code. So every content of the sources has its own folder. It
    is in ``NUMBA_CACHE_DIR``, next to the source, or in the user's cache. If none can be
    written to, such as in a read-only installation for a user without a home, the process makes
    a temporary folder and removes it at its end.

    Args:
        packages: folders of the sources; machine code may be stored next to the first.
    """
    name = _PREFIX + _digest(packages)
    asked = os.environ.get("NUMBA_CACHE_DIR")
    if asked and Path(asked).name == name:  # set by the process that started this one
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
    # Nobody else may write there: code in it runs when it is loaded.
    folder = tempfile.mkdtemp(prefix=_PREFIX)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = folder


def njit(function: Callable | None = None, /, *, cache: bool = True, **options: Any) -> Any:
    """Compile a function as ``numba.njit`` does, in one process where several need it at once.

    The others wait, and load the machine code that it has stored.

    Args:
        function: without it, a decorator with these options is returned.
        cache: whether the machine code is stored; if not, each process compiles its own.
        options: of ``numba.njit``.
    """
    if function is None:
        return functools.partial(njit, cache=cache, **options)
    import numba
    from filelock import FileLock
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    compiled = numba.njit(cache=cache, **options)(function)
    if cache and isinstance(compiled, Dispatcher):  # NUMBA_DISABLE_JIT leaves the function
        name = re.sub("[<>]", "", f"{function.__module__}.{function.__qualname__}.lock")
        path, compile_here = Path(os.environ["NUMBA_CACHE_DIR"]) / name, compiled.compile

        @functools.cache
        def lock_of(process: int) -> Any:
            # A process that was forked has a lock of its own.
            return FileLock(path, timeout=_PATIENCE)

        def compile_once(signature: Any) -> Any:
            # Numba's own lock comes first: so no thread waits for a file that another one's
            # function needs.
            with global_compiler_lock, contextlib.ExitStack() as held:
                # The other process may be suspended, and not every file system has locks.
                with contextlib.suppress(OSError, NotImplementedError):
                    held.enter_context(lock_of(os.getpid()))
                return compile_here(signature)

        vars(compiled)["compile"] = compile_once
    return compiled


def compiled_ahead() -> Path:
    """Return the file next to the machine code that marks a demo's functions as compiled."""
    _named_now()
    return Path(os.environ["NUMBA_CACHE_DIR"]) / "compiled-ahead"


def _digest(packages: tuple[Path, ...]) -> str:
    """Return a digest of all sources in folders that have compiled functions.

    Files next to them count, too: compiled functions contain their constants.
    """
    sources = {p: p.read_bytes() for package in packages for p in package.rglob("*.py")}
    uses = (b"import numba", b"from numba", b"import njit")
    folders = {path.parent for path, source in sources.items() if any(u in source for u in uses)}
    digest = hashlib.sha256()
    for path in sorted(sources):
        if path.parent in folders:
            digest.update(sources[path])
    return digest.hexdigest()[:16]
