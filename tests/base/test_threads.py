"""Work distributed to cores."""

import os
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest

import neurosim
from neurosim.base.compiled import njit
from neurosim.base.threads import ALONE, cores, on_cores, one_core, taken
from neurosim.base.waiting import show

COMPILED = SimpleNamespace(overloads={"one": True})


@pytest.mark.parametrize("cores", [1, 2, 3])
@pytest.mark.parametrize(("count", "least"), [(0, 1), (1, 1), (7, 1), (7, 4), (8, 3)])
def test_each_piece_is_done_once_on_as_many_cores_as_it_pays(monkeypatch, cores, count, least):
    monkeypatch.setattr(numba, "get_num_threads", lambda: cores)
    parts = []
    on_cores(COMPILED, lambda first, last: parts.append((first, last)), count, least)
    assert sorted(n for first, last in parts for n in range(first, last)) == list(range(count))
    assert len(parts) == max(1, min(cores, count // least))


def test_one_core_is_for_this_thread_and_until_its_end(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 3)
    seen = []
    with one_core():
        with one_core(False):
            assert cores() == 1
        parts = []
        on_cores(COMPILED, lambda first, last: parts.append((first, last)), 9)
        other = threading.Thread(target=lambda: seen.append(cores()))
        other.start()
        other.join()
    assert parts == [(0, 9)]
    assert seen == [3]
    assert cores() == 3
    with pytest.raises(ValueError, match="within"), one_core():
        raise ValueError("within")
    assert cores() == 3


def test_a_kernel_is_compiled_in_the_calling_thread(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    calls = []

    def part(first, last):
        calls.append((first, last, threading.current_thread() is threading.main_thread()))

    on_cores(SimpleNamespace(overloads={}), part, 2)
    assert calls[0] == (0, 0, True)
    assert sorted(calls[1:])[0] == (0, 1, True)
    assert sorted(calls[1:])[1][:2] == (1, 2)


def test_a_kernel_that_numba_leaves_alone_is_shared_out_too(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    parts = []
    on_cores(len, lambda first, last: parts.append((first, last)), 2)
    assert sorted(parts) == [(0, 1), (1, 2)]


def test_an_error_in_another_thread_is_raised(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)

    def part(first, last):
        if first == 1:
            raise ValueError("second")

    with pytest.raises(ValueError, match="second"):
        on_cores(COMPILED, part, 2)


@njit(nogil=True, cache=False)
def _count(pool, count, done, slow):
    if pool.given > 0:
        show(pool.numbers, 0, pool.given)
    first, last, turn = taken(pool, count, 0)
    while first < last:
        for n in range(first, last):
            done[n] += 1
            for _ in range(slow[n]):
                done[n] += 1
            done[n] -= slow[n]
        first, last, turn = taken(pool, count, turn)


@pytest.mark.parametrize("cores", [2, 3, 5])
@pytest.mark.parametrize("count", [2, 5, 1000])
def test_threads_take_free_pieces_until_each_is_done_once(monkeypatch, cores, count):
    monkeypatch.setattr(numba, "get_num_threads", lambda: cores)
    # The first part takes much longer than the others.
    slow, threads = np.where(np.arange(count) < count // cores, 20_000, 0), set()
    for _ in range(20):
        done = np.zeros(count, np.int64)

        def part(first, last, pool=ALONE, done=done):
            if pool is ALONE:
                assert first == last == 0  # so that it is compiled
                return
            assert (first, last) == (0, count)
            threads.add((threading.get_ident(), pool.own))
            _count(pool, last, done, slow)

        on_cores(_count, part, count, pooled=True)
        assert (done == 1).all()
    assert len(threads) == min(cores, count)


def test_helpers_that_sleep_are_woken(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    for pause in (0.0, 1e-4, 3e-4, 1e-2) * 10:
        parts = []
        on_cores(COMPILED, lambda first, last: parts.append(first), 2)  # noqa: B023
        assert sorted(parts) == [0, 1]
        time.sleep(pause)


def test_two_threads_and_work_within_work_do_all(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    done = np.zeros((4, 6, 10), np.int64)

    def outer(own):
        def part(first, last):
            for n in range(first, last):
                on_cores(COMPILED, lambda a, b, n=n: add(n, a, b), 10)

        def add(n, first, last):
            done[own, n, first:last] += 1

        on_cores(COMPILED, part, 6)

    threads = [threading.Thread(target=outer, args=(own,)) for own in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (done == 1).all()


def test_an_interruption_leaves_helpers_that_work(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)

    def interrupted(first, last, *pool):
        if threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt

    for pooled in (False, True):
        with pytest.raises(KeyboardInterrupt):
            on_cores(COMPILED, interrupted, 2, pooled=pooled)
        parts = []
        on_cores(COMPILED, lambda first, last: parts.append(first), 2)  # noqa: B023
        assert sorted(parts) == [0, 1]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="without forks")
def test_a_forked_process_starts_helpers_of_its_own(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    on_cores(COMPILED, lambda first, last: None, 2)
    child = os.fork()
    if child == 0:
        parts = []
        on_cores(COMPILED, lambda first, last: parts.append(first), 2)
        os._exit(0 if sorted(parts) == [0, 1] else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_no_kernel_has_a_parallel_region_of_its_own():
    """Their threads keep a core busy for milliseconds after each region."""
    sources = sorted(Path(neurosim.__file__).parent.rglob("*.py"))
    assert len(sources) > 50
    assert [p.name for p in sources if "parallel=True" in p.read_text(encoding="utf-8")] == []
