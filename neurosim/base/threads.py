"""The number of threads of PyTorch and of compiled kernels."""

from __future__ import annotations

import os
import timeit
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from threading import Lock, Semaphore, Thread, local
from time import sleep
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from neurosim.base.kernels import kernel
from neurosim.base.waiting import claim, compiled, passed, rest

#: Whether a thread keeps its kernels on one core.
_ALONE = local()
#: Number of rows from which several cores are faster than one.
WORTH_SHARING = 500
#: How long a thread waits with its core awake, s; how often it looks after that whether work is
#: done, s; and the number of turns of which the duration is measured.
_AWAKE, _LOOKS, _TURNS = 2e-4, 1e-4, 2000
#: Largest number of threads that work together.
_MOST = 256


class Pool(NamedTuple):
    """How a compiled function shares its pieces of work with other threads."""

    numbers: NDArray[np.int64]  #: of work given, at 0
    given: int  #: shown there first, which starts the other threads; 0: another one does that
    free: NDArray[np.int64]  #: at 8 q: how many pieces of the q-th part have been taken
    own: int  #: number of the thread's part; after it, it takes pieces of the others'
    parts: int  #: number of parts, which are equal; 1: nothing is shared
    pieces: int  #: taken at a time


#: For a function that does all its pieces.
ALONE = Pool(np.zeros(1, np.int64), 0, np.zeros(1, np.int64), 0, 1, 1)
#: Number of times that a thread takes pieces of its part.
_TIMES = 8


def on_cores(
    function: Any, part: Callable[..., None], count: int, least: int = 1, *, pooled: bool = False
) -> None:
    """Distribute ``count`` pieces of work to the cores that compiled kernels may use.

    Kernels with a parallel region of their own take twice as long to compile. The threads of such
    regions also stay busy for milliseconds after each region, on cores that others want.

    Args:
        function: the compiled function that ``part`` calls, with ``nogil``. If it is not compiled
            yet, that happens in the calling thread, where an interruption ends it. None: unknown.
        part: called as ``part(first, last)`` for the pieces from ``first`` to before ``last``.
        count: number of pieces.
        least: smallest number of pieces for which another core is worth starting.
        pooled: ``part`` also takes a :class:`Pool`, and the function starts the other threads and
            takes free pieces until there are none. Else the threads find Python's lock taken until
            this one is in the kernel, and sleep for longer than a little work takes; and wait for
            each other in the end.
    """
    worth = count // least
    parts = min(cores(), worth, _MOST) if worth > 1 else 1
    if parts == 1 or not compiled():
        part(0, count)
        return
    if not getattr(function, "overloads", True):
        part(0, 0)
    _helpers().do(part, count, parts, pooled)


class _Helper:
    """A thread that does pieces of work, and between them waits for a moment with its core awake.

    To wake a core takes 0.1 ms, which is as long as a step of a thousand robots on two cores. So
    both threads look at numbers in memory, in compiled code without Python's lock; a helper for
    :data:`_AWAKE`, then it sleeps.
    """

    def __init__(self, numbers: NDArray[np.int64], place: int, turns: int):
        self._numbers, self._place, self._turns = numbers, place, turns
        self._work: tuple[int, Callable[..., None], tuple[Any, ...]] | None = None
        self._error: BaseException | None = None
        self._sleeps, self._change, self._woken = False, Lock(), Semaphore(0)
        Thread(target=self._run, args=(int(numbers[0]),), name="neurosim", daemon=True).start()

    def take(self, number: int, part: Callable[..., None], *given: Any) -> None:
        """Take a part of the work, which begins when its number is shown."""
        self._work = number, part, given
        self._wake()

    def finish(self, number: int) -> BaseException | None:
        """Wait until the pieces are done; return the error, if any."""
        while not passed(self._numbers, self._place, number, self._turns):
            self._wake()  # it may have slept again before its number was shown
            sleep(_LOOKS)
        error, self._error = self._error, None
        return error

    def _wake(self) -> None:
        with self._change:
            wake, self._sleeps = self._sleeps, False
        if wake:
            self._woken.release()

    def _run(self, done: int) -> None:
        while True:
            if not rest(self._numbers, self._place, done, self._turns):
                with self._change:
                    self._sleeps = sleeps = bool(self._numbers[0] == done)
                if sleeps:
                    self._woken.acquire()
                continue
            done, work = int(self._numbers[0]), self._work
            if work is not None and work[0] == done:  # work may be for other helpers alone
                try:
                    work[1](*work[2])
                except BaseException as error:
                    self._error = error
                self._work = None
            del work


class _Helpers:
    """The helpers of a process, for one of its threads at a time."""

    def __init__(self) -> None:
        self._all, self._used = list[_Helper](), Lock()
        self._numbers = np.zeros(8 * _MOST, np.int64)
        # Compiled here, and not in a helper: an interruption ends it.
        rest(self._numbers, 8, -1, 1)
        passed(self._numbers, 8, 0, 1)
        lasted = timeit.repeat(lambda: passed(self._numbers, 8, 1, _TURNS), number=1)
        self._turns = int(_TURNS * _AWAKE / min(lasted)) + 1

    def do(self, part: Callable[..., None], count: int, parts: int, pooled: bool) -> None:
        """Do ``count`` pieces of work in ``parts`` threads; raise an error, if any."""
        if not self._used.acquire(blocking=False):  # by another thread, or in a piece of work
            part(0, count)
            return
        try:
            while len(self._all) < parts - 1:
                place = 8 * (len(self._all) + 1)
                self._all.append(_Helper(self._numbers, place, self._turns))
            helpers, number = self._all[: parts - 1], int(self._numbers[0]) + 1
            given: list[tuple[Any, ...]]
            given = list(pairwise(count * n // parts for n in range(parts + 1)))
            if pooled:
                free, pieces = np.zeros(8 * parts, np.int64), max(count // (parts * _TIMES), 1)
                given = [
                    (0, count, Pool(self._numbers, number * (q == 0), free, q, parts, pieces))
                    for q in range(parts)
                ]
            for helper, own in zip(helpers, given[1:], strict=True):
                helper.take(number, part, *own)
            try:
                if not pooled:
                    self._numbers[0] = number
                part(*given[0])
            finally:
                self._numbers[0] = number  # also if this thread was interrupted before
                errors = [helper.finish(number) for helper in helpers]
        finally:
            self._used.release()
        for error in errors:
            if error is not None:
                raise error


@kernel(forceinline=True)
def taken(pool, count, turn):  # type: ignore[no-untyped-def]
    """Take free pieces of work for a thread, first those of its own part.

    Args:
        pool: :class:`Pool`.
        count: number of all pieces.
        turn: 0 at first, then as returned.

    Returns:
        The first piece, the piece after the last, the same if there are none, and ``turn``.
    """
    while turn < pool.parts:
        q = (pool.own + turn) % pool.parts
        until = count * (q + 1) // pool.parts
        first = count * q // pool.parts + claim(pool.free, 8 * q, pool.pieces)
        if first < until:
            return first, min(first + pool.pieces, until), turn
        turn += 1
    return count, count, turn


@cache
def _helpers() -> _Helpers:
    """Return this process's helpers, which start at their first use."""
    return _Helpers()


# A forked process does not have the threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)


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
