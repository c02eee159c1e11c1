"""Signals that ask a program to end, and when it ends."""

import contextlib
import importlib
import os
import signal
import subprocess
import sys

import click
import pytest
from patience import PATIENCE
from processes import finished, process

from neurosim.base.interrupts import (
    INTERRUPTED,
    SIGNALS,
    answer_signals,
    deferred_interrupt,
    ended_as_usual,
    exit_code,
    interruption_in,
    not_suspended,
    uninterrupted,
)

main_module = importlib.import_module("neurosim.cli.main")  # the package has a function main

pytestmark = pytest.mark.skipif(os.name != "posix", reason="Windows has other signals")


@pytest.fixture(autouse=True)
def handlers():
    """Handle signals as the command line does, and restore the handlers afterwards."""
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
    other.__cause__.__context__ = inner  # belongs to an error that was handled earlier
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
    done = finished(process(script))
    assert done.returncode == 130, done.stderr
    assert done.stderr == ""


OWN = """
import ctypes, os, signal, sys, time
from neurosim.base import interrupts
interrupts.own_process()
interrupts.answer_signals()
interrupts.PATIENCE = interrupts.LONGEST = 0.5

def send(number):
    os.kill(os.getpid(), number)

{body}
"""

STUBBORN = """
with interrupts.stopped_at_end(lambda: os.write(1, b"stopped")):
    while True:
        try:
            send(signal.SIGTERM)
            time.sleep(30)
        except KeyboardInterrupt:
            pass
"""

DEFERRED = """
with interrupts.deferred_interrupt():
    send(signal.SIGTERM)
    time.sleep(30)
"""

#: The process ends without waiting for a generation whose loops are compiled.
COMPILING = """
from numba.core.compiler_lock import global_compiler_lock
interrupts.LONGEST = 1000.0
with interrupts.deferred_interrupt(), global_compiler_lock:
    send(signal.SIGTERM)
    time.sleep(30)
"""

#: Machine code runs for minutes; Python calls no signal handler meanwhile.
DEAF = """
import hashlib, threading
threading.Timer(0.2, send, (signal.SIGTERM,)).start()
hashlib.pbkdf2_hmac("sha256", b"", b"", 300_000_000)
"""

#: Like Numba's compiler, which calls Python from machine code: exceptions there are only printed.
CALLBACK = """
called = ctypes.CFUNCTYPE(None)(lambda: send(signal.SIGHUP))
try:
    called()
    time.sleep(5)
except KeyboardInterrupt:
    os._exit(interrupts.exit_code())
"""

THIRD = """
with interrupts.uninterrupted():
    for _ in range(3):
        send(signal.SIGQUIT)
    print("went on", flush=True)
"""


@pytest.mark.parametrize(
    ("body", "number", "prints"),
    [
        (STUBBORN, signal.SIGTERM, "stopped"),
        (DEFERRED, signal.SIGTERM, ""),
        (COMPILING, signal.SIGTERM, ""),
        (DEAF, signal.SIGTERM, ""),
        (CALLBACK, signal.SIGHUP, ""),
        (THIRD, signal.SIGQUIT, ""),
    ],
)
def test_a_process_that_is_asked_to_end_ends(body, number, prints):
    done = subprocess.run(
        [sys.executable, "-c", OWN.format(body=body)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 128 + number
    assert done.stdout == prints
    assert len(done.stderr.splitlines()) <= 1
    assert "Traceback" not in done.stderr


IMPORTING = """
import os, signal, sys, threading
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "neurosim.cli.main":
            os.kill(os.getpid(), {number})
sys.meta_path.insert(0, Finder())
sys.argv = ["neurosim", "--version"]
from neurosim.__main__ import main
main()
"""


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_while_modules_are_imported_is_one_line(number):
    done = subprocess.run(
        [sys.executable, "-c", IMPORTING.format(number=int(number))],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert (done.returncode, done.stdout) == (128 + number, "")
    assert done.stderr == f"{INTERRUPTED}\n"


def test_what_was_asked_is_not_forgotten_at_the_end(monkeypatch, capsys):
    monkeypatch.setattr(main_module.cli, "main", lambda **options: _swallow(signal.SIGTERM))
    with pytest.raises(SystemExit) as stop:
        main_module.main()
    assert stop.value.code == 128 + signal.SIGTERM
    assert capsys.readouterr().err == f"{INTERRUPTED}\n"
    assert signal.getsignal(signal.SIGTERM) != signal.SIG_IGN  # this process continues


@pytest.mark.parametrize("asked", [False, True])
def test_a_command_that_says_why_it_ends_is_its_only_line_and_code(monkeypatch, capsys, asked):
    @main_module.cli.command("ends")
    def ends():
        if asked:
            _swallow(signal.SIGTERM)
        click.echo("why", err=True)
        click.get_current_context().exit(exit_code() if asked else 1)

    monkeypatch.setattr(sys, "argv", ["neurosim", "ends"])
    try:
        with pytest.raises(SystemExit) as stop:
            main_module.main()
    finally:
        del main_module.cli.commands["ends"]
    assert stop.value.code == (128 + signal.SIGTERM if asked else 1)
    assert capsys.readouterr().err == "why\n"


def test_any_error_that_comes_out_of_an_interrupted_compiler_is_an_interruption(
    monkeypatch, capsys
):
    def compiles(**options):
        _swallow(signal.SIGINT)
        raise RuntimeError("no compiled object yet")

    monkeypatch.setattr(main_module.cli, "main", compiles)
    with pytest.raises(SystemExit) as stop:
        main_module.main()
    assert stop.value.code == 130
    assert capsys.readouterr().err == f"{INTERRUPTED}\n"


def test_the_message_says_how_a_command_continues_if_it_can():
    def added(name):
        return main_module._again(main_module.cli.commands.get(name))

    for name in ("record", "evolve", "sample", "back-to-reality"):
        assert added(name) == "; to continue, run the command again with --resume"
    assert added("demo") == added("pipeline") == "; to continue, run the command again"
    assert added("run") == added("train") == added("unknown") == ""


def _swallow(number):
    with contextlib.suppress(KeyboardInterrupt):
        send(number)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGHUP, 129)])
def test_ctrl_c_alone_is_the_usual_end_of_what_runs_until_it_is_stopped(monkeypatch, number, code):
    def run(**options):
        _swallow(number)
        ended_as_usual()

    monkeypatch.setattr(main_module.cli, "main", run)
    if code == 0:
        main_module.main()
        return
    with pytest.raises(SystemExit) as stop:
        main_module.main()
    assert stop.value.code == code
