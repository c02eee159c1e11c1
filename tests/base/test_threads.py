"""Work distributed to cores."""

import threading
from pathlib import Path
from types import SimpleNamespace

import numba
import pytest

import neurosim
from neurosim.base.threads import cores, on_cores, one_core

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


def test_no_kernel_has_a_parallel_region_of_its_own():
    """Their threads keep a core busy for milliseconds after each region."""
    sources = sorted(Path(neurosim.__file__).parent.rglob("*.py"))
    assert len(sources) > 50
    assert [p.name for p in sources if "parallel=True" in p.read_text(encoding="utf-8")] == []
