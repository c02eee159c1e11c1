"""How many threads PyTorch and compiled kernels work in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numba
import torch

#: From so many rows on, sharing them out to several cores pays.
WORTH_SHARING = 500


@contextmanager
def one_core(wanted: bool = True) -> Iterator[None]:
    """Keep compiled kernels on one core, if that is wanted: for little work.

    On a machine that is busy with something else too, sharing out may cost a time slice of the
    scheduler, more than the whole work.
    """
    threads = numba.get_num_threads()
    if wanted:
        numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(threads)


@contextmanager
def one_thread(device: str = "cpu") -> Iterator[None]:
    """Let PyTorch work in one thread where more do not pay, if it works on the CPU.

    PyTorch's second thread, between two of its tasks, keeps busy on a core that compiled kernels,
    or other programs, want. And how it cuts up long sums, and so their last digits, depends on
    how many threads there are.
    """
    threads = torch.get_num_threads()
    if torch.device(device).type == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
