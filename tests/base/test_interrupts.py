"""What asks a program to end, and when that is answered."""

import os
import signal
import subprocess
import sys

import pytest
from patience import PATIENCE

from neurosim.base.interrupts import (
    SIGNALS,
    answer_signals,
    deferred_interrupt,
    exit_code,
    interruption_in,
    not_suspended,
    uninterrupted,
)

pytestmark = pytest.mark.skipif(os.name != "posix", reason="Windows has other signals")


@pytest.fixture(autouse=True)
def handlers():
    """Answer signals as the command line does, and put back what was."""
    numbers = [*SIGNALS, signal.SIGTSTP]
    before = {number: signal.getsignal(number) for number in numbers}
    answer_signals()
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def send(*numbers):
    for number in numbers:
        os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", SIGNALS)
def test_every_one_interrupts_with_an_exit_code_of_its_own(number):
    with pytest.raises(KeyboardInterrupt):
        send(number)
    assert exit_code() == 128 + number


def test_what_is_ignored_stays_ignored():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    answer_signals()
    send(signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


def test_compiled_code_ends_before_it_is_answered():
    done = []
    with pytest.raises(KeyboardInterrupt), uninterrupted():
        send(signal.SIGTERM, signal.SIGTERM)
        done.append(1)
    assert done == [1]
    assert exit_code() == 128 + signal.SIGTERM


def test_within_another_the_outer_one_answers():
    done = []
    with pytest.raises(KeyboardInterrupt), uninterrupted():
        with uninterrupted():
            send(signal.SIGINT)
        done.append(1)
    assert done == [1]
    with pytest.raises(KeyboardInterrupt):
        send(signal.SIGINT)


def test_the_third_is_answered_at_once():
    done = []
    with pytest.raises(KeyboardInterrupt), uninterrupted():
        send(*[signal.SIGINT] * 3)
        done.append(1)
    assert done == []


def test_within_a_generation_it_is_answered_as_there():
    with deferred_interrupt() as interrupt:
        with uninterrupted():
            send(signal.SIGINT)
            assert not interrupt.pending
        assert interrupt.pending
        with pytest.raises(KeyboardInterrupt), uninterrupted():
            send(signal.SIGINT)


def test_a_program_with_a_robot_is_not_suspended():
    with pytest.raises(KeyboardInterrupt), not_suspended():
        send(signal.SIGTSTP)
    assert exit_code() == 128 + signal.SIGTSTP
    assert signal.getsignal(signal.SIGTSTP) == signal.SIG_DFL


def test_an_interruption_is_found_however_often_it_is_wrapped():
    inner = KeyboardInterrupt()
    once = SystemError("with an exception set")
    once.__context__ = inner
    twice = SystemError("with an exception set")
    twice.__cause__ = once
    assert interruption_in(twice) is interruption_in(inner) is inner
    assert interruption_in(SystemError("of its own")) is None
    other = SystemError("of its own")
    other.__cause__ = ValueError()
    other.__cause__.__context__ = inner  # of an error that was handled long before
    assert interruption_in(other) is None


KERNEL = """
import os, signal, sys, threading, time
import numpy as np
from neurosim.base.interrupts import answer_signals, exit_code
answer_signals()
from neurosim.tasks.registry import make_task
from neurosim.base.trajectory import Trajectory
from neurosim.loop.evaluate import Evaluator

task = make_task("nine-rectangles")
poses = np.zeros((1, 20000, 12, 3))
trajectory = Trajectory(poses, np.zeros((1, 20000, 11, 3)), np.ones((1, 20000, 11)), None,
                        np.ones((1, 20000, 11), bool))

class Judged(Evaluator):
    def __init__(self):
        self.task = task
    def run(self, genes, draws, reuse=False):
        return trajectory

judged = Judged()
judged.judge(None, None)  # compiled
def ask():
    time.sleep({delay})
    os.kill(os.getpid(), signal.SIGINT)
threading.Thread(target=ask, daemon=True).start()
try:
    while True:
        judged.judge(None, None)
except KeyboardInterrupt:
    sys.exit(exit_code())
"""


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.013, 0.047, 0.081, 0.123, 0.171])
def test_ctrl_c_while_a_task_is_judged_on_all_cores(delay):
    script = KERNEL.format(delay=delay)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=PATIENCE
    )
    assert done.returncode == 130, done.stderr
    assert done.stderr == ""
