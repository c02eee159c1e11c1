"""How many threads PyTorch works in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


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
