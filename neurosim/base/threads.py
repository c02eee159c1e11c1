"""The number of threads of PyTorch and of compiled kernels."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import Any

import numba

#: Whether a thread keeps its kernels on one core.
_ALONE = threading.local()
#: Number of rows from which several cores are faster than one.
WORTH_SHARING = 500


def on_cores(kernel: Any, part: Callable[[int, int], None], count: int, least: int = 1) -> None:
    """Distribute ``count`` pieces of work to the cores that compiled kernels may use.

    Kernels with a parallel region of their own take twice as long to compile. The threads of such
    regions also stay busy for milliseconds after each region, on cores that others want.

    Args:
        kernel: the compiled function that ``part`` calls, with ``nogil``. If it is not compiled
            yet, that happens in the calling thread, where an interruption ends it. None: unknown.
        part: called as ``part(first, last)`` for the pieces from ``first`` to before ``last``.
        count: number of pieces.
        least: smallest number of pieces for which another core is worth starting.
    """
    worth = count // least
    parts = min(cores(), worth) if worth > 1 else 1
    if parts == 1:
        part(0, count)
        return
    edges = [count * n // parts for n in range(parts + 1)]
    if not getattr(kernel, "overloads", True):  # with NUMBA_DISABLE_JIT it is a plain function
        part(0, 0)
    others = [_threads().submit(part, *ends) for ends in pairwise(edges[1:])]
    part(0, edges[1])
    for other in others:
        other.result()


@cache
def _threads() -> ThreadPoolExecutor:
    """Return this process's threads, which start at their first use."""
    return ThreadPoolExecutor(thread_name_prefix="neurosim")


# A forked process does not have the threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.cache_clear)


def cores() -> int:
    """Return the number of cores that this thread's kernels may use."""
    return 1 if getattr(_ALONE, "wanted", False) else numba.get_num_threads()


@contextmanager
def one_core(wanted: bool = True) -> Iterator[None]:
    """Keep this thread's kernels on one core if ``wanted``, for little work.

    On a machine with other busy programs, a second core may cost a time slice of the scheduler,
    which is more than the whole work. Numba's own limit would take longer than a step of a robot.
    """
    before = getattr(_ALONE, "wanted", False)
    _ALONE.wanted = wanted or before
    try:
        yield
    finally:
        _ALONE.wanted = before


@contextmanager
def one_thread(device: str = "cpu") -> Iterator[None]:
    """Limit PyTorch on the CPU to one thread, where more threads are not faster.

    Between two tasks, PyTorch's second thread keeps a core busy that compiled kernels or other
    programs could use. Also, the number of threads changes the order of long sums, and so their
    last digits.
    """
    import torch  # takes a second, which compiled work alone need not wait for

    threads = torch.get_num_threads()
    if torch.device(device).type == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
