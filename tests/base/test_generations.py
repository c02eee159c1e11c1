"""The loop that runs generations, and how it ends when it is interrupted."""

import os
import signal
import threading
import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from neurosim.base.generations import run_generations
from neurosim.base.interrupts import SIGNALS, deferred_interrupt
from neurosim.loop.evaluate import Fitness


class Counting:
    """Counts generations; calls a function in the generation of a given number."""

    ended = False

    def __init__(self, at=0, then=None):
        self.done, self._at, self._then = 0, at, then
        self.worked = 0

    def generation(self):
        if self.done + 1 == self._at:
            self._then()
        self.worked += 1
        self.done += 1
        return f"number {self.done}"

    def state(self):
        return {"done": np.array([self.done])}


def send(*numbers):
    for number in numbers:
        os.kill(os.getpid(), number)


@pytest.fixture
def handlers():
    """Restore the signal handlers."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def interrupting(number, frame):
    raise KeyboardInterrupt


def test_generations_run_up_to_the_total_and_go_on_where_they_were():
    stage, saved = Counting(), []
    assert not run_generations(stage, 5, "", save=saved.append, every=1e9, progress=False)
    assert stage.worked == 5
    assert not saved
    assert not run_generations(stage, 8, "", save=saved.append, every=0.0, progress=False)
    assert stage.worked == 8
    assert [int(state["done"][0]) for state in saved] == [6, 7, 8]


@pytest.mark.parametrize("number", SIGNALS)
def test_a_generation_ends_before_it_is_answered(handlers, number):
    signal.signal(number, interrupting)
    stage, saved = Counting(3, lambda: send(number)), []
    assert run_generations(stage, 9, "", save=saved.append, every=1e9, progress=False)
    assert stage.worked == stage.done == 3
    assert [int(state["done"][0]) for state in saved] == [3]
    assert signal.getsignal(number) is interrupting


@pytest.mark.parametrize("numbers", [(signal.SIGINT,) * 2, (signal.SIGINT, signal.SIGTERM)])
def test_the_second_is_answered_at_once(handlers, numbers):
    for number in numbers:
        signal.signal(number, interrupting)
    stage, saved = Counting(3, lambda: send(*numbers)), []
    with pytest.raises(KeyboardInterrupt):
        run_generations(stage, 9, "", save=saved.append, every=1e9, progress=False)
    assert stage.worked == 2
    assert not saved
    assert all(signal.getsignal(number) is interrupting for number in numbers)


@pytest.mark.parametrize("number", SIGNALS)
def test_what_is_ignored_stays_ignored(handlers, number):
    signal.signal(number, signal.SIG_IGN)
    stage = Counting(3, lambda: send(number, number))
    assert not run_generations(stage, 5, "", progress=False)
    assert stage.worked == 5
    assert signal.getsignal(number) == signal.SIG_IGN


def test_what_python_does_not_handle_is_left_to_the_system(handlers):
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with deferred_interrupt():
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
        assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler


def test_an_interruption_that_compiled_code_wrapped_is_one():
    def wrapped():
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    def other():
        raise SystemError("of its own")

    with pytest.raises(KeyboardInterrupt):
        run_generations(Counting(1, wrapped), 3, "", progress=False)
    with pytest.raises(SystemError, match="of its own"):
        run_generations(Counting(1, other), 3, "", progress=False)


def test_it_runs_in_any_thread():
    stage, result = Counting(), []

    def work():
        with deferred_interrupt() as interrupt:
            result.append(interrupt.pending)
        result.append(run_generations(stage, 4, "", progress=False))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert result == [False, False]
    assert stage.worked == 4


def test_a_first_generation_that_takes_long_says_why(monkeypatch, capsys):
    monkeypatch.setattr("neurosim.base.generations.COMPILES_AFTER", 0.01)
    run_generations(Counting(1, lambda: time.sleep(0.5)), 3, "evolving")
    message = capsys.readouterr().err
    assert message.count("loops are compiled") == 1
    assert message.startswith("evolving: the first generation is under way")
    monkeypatch.setattr("neurosim.base.generations.COMPILES_AFTER", 600.0)
    run_generations(Counting(), 3, "evolving")
    assert "compiled" not in capsys.readouterr().err


class Sleeps:
    """Takes the place of a slow evaluator."""

    controller = SimpleNamespace(genes=2)

    def threads_for(self, individuals):
        return nullcontext()

    def merit(self, rows, *others):
        time.sleep(0.5)
        return SimpleNamespace(merit=rows.sum(1)), {}


@pytest.mark.slow
def test_a_first_evaluation_from_python_that_takes_long_says_why(monkeypatch, capsys):
    monkeypatch.setattr("neurosim.base.generations.COMPILES_AFTER", 0.01)
    fitness = Fitness(Sleeps(), [0], "fitness")
    assert fitness(np.array([1.0, 2.0])) == 3.0
    assert capsys.readouterr().err.startswith("the first evaluation is under way")
    fitness(np.array([1.0, 2.0]))
    assert capsys.readouterr().err == ""
