"""The command line in processes of their own that begin at once.

Python, Numba and PyTorch take seconds to start. A server imports them once; for each process it
forks. Where nothing forks, as on Windows, each process starts as usual.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from functools import cache
from pathlib import Path
from typing import IO, Any

from patience import PATIENCE

#: The program of the server. Its child waits for the process and reports its end.
_SERVER = """
import atexit, gc, json, os, signal, socket, sys, threading, traceback
import neurosim.back_to_reality.run, neurosim.lab, neurosim.loop.evolve, neurosim.recording.record
import neurosim.reports.report, neurosim.sampling, neurosim.training.train, neurosim.trials.trial
import neurosim.cli.main, neurosim.watch, tracking.track
import torch

gc.freeze()
server = socket.socket(fileno=int(sys.argv[1]))
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
signal.signal(signal.SIGINT, signal.SIG_IGN)
while True:
    asked, files, _, _ = socket.recv_fds(server, 1 << 20, 4)
    if not asked:
        sys.exit()
    if os.fork() == 0:
        break
    for each in files:
        os.close(each)
server.close()
signal.signal(signal.SIGCHLD, signal.SIG_DFL)
asked, report = json.loads(asked), files.pop()
child = os.fork()
if child:
    for each in files:
        os.close(each)
    os.write(report, f"{child}\\n".encode())
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    os.write(report, f"{code}\\n".encode())
    os._exit(0)
os.close(report)
signal.signal(signal.SIGINT, signal.default_int_handler)
if asked["session"]:
    os.setsid()
for number, each in enumerate(files):
    os.dup2(each, number)
    os.close(each)
os.chdir(asked["cwd"])
os.environ.clear()
os.environ.update(asked["env"])
sys.argv = asked["argv"]
code = 0
try:
    exec(compile(asked["program"], "<string>", "exec"), {"__name__": "__main__"})
except SystemExit as stop:
    code = stop.code or 0
except BaseException:
    traceback.print_exc()
    code = 1
# As Python ends, but for the memory: to give it back piece by piece takes a second.
threading._shutdown()
atexit._run_exitfuncs()
sys.stdout.flush()
sys.stderr.flush()
os._exit(code)
"""
_COMMAND = """
import runpy
runpy.run_module("neurosim", run_name="__main__", alter_sys=True)
"""


class _Server:
    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair()
        self._lock = threading.Lock()
        subprocess.Popen(
            [sys.executable, "-c", _SERVER, str(theirs.fileno())],
            pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        theirs.close()

    def start(self, asked: dict[str, Any], files: list[int]) -> tuple[int, IO[str]]:
        """Start a process; return its number, and a file that later has its exit code."""
        ours, theirs = os.pipe()
        with self._lock:
            socket.send_fds(self._socket, [json.dumps(asked).encode()], [*files, theirs])
            os.close(theirs)
            report = os.fdopen(ours, closefd=True)
            if not (number := report.readline()):
                raise RuntimeError("the server of processes has ended; stderr has its error")
            return int(number), report


_server = cache(_Server)


class Forked:
    """A process of the server, to be used as one of :class:`subprocess.Popen`."""

    def __init__(self, asked: dict[str, Any], stdin: int, stdout: int, stderr: int):
        self.returncode: int | None = None
        theirs, ours = [], []
        for number, kind in enumerate((stdin, stdout, stderr)):
            own = None
            if kind == subprocess.PIPE:
                pair = os.pipe()
                theirs.append(pair[number > 0])
                own = os.fdopen(pair[number == 0], "r" if number else "w", encoding="utf-8")
            else:
                theirs.append(os.open(os.devnull, os.O_RDWR))
            ours.append(own)
        self.stdin, self.stdout, self.stderr = ours
        self.pid, self._report = _server().start(asked, theirs)
        for each in theirs:
            os.close(each)
        self._ended = threading.Event()
        threading.Thread(target=self._wait, daemon=True).start()

    def _wait(self) -> None:
        with self._report:
            self.returncode = int(self._report.readline() or -signal.SIGKILL)
        self._ended.set()

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int | None:
        if not self._ended.wait(timeout):
            raise subprocess.TimeoutExpired("neurosim", timeout or 0.0)
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float | None = None) -> tuple[str | None, str | None]:
        """Read both streams to their ends; return them once the process has ended."""
        texts: dict[int, str] = {}

        def read(number: int, stream: IO[str]) -> None:
            texts[number] = "" if stream.closed else stream.read()

        streams = [(n, one) for n, one in enumerate((self.stdout, self.stderr)) if one]
        threads = [threading.Thread(target=read, args=one, daemon=True) for one in streams]
        for thread in threads:
            thread.start()
        self.wait(timeout)
        for thread in threads:
            thread.join()
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream:
                stream.close()
        return texts.get(0), texts.get(1)


def process(
    program: str,
    *words: object,
    cwd: Path | str | None = None,
    stdin: int = subprocess.DEVNULL,
    stdout: int = subprocess.PIPE,
    stderr: int = subprocess.PIPE,
    session: bool = False,
) -> Any:
    """Start a process.

    Args:
        program: Python code.
        words: its arguments.
        cwd: folder; by default this process's.
        stdin, stdout, stderr: PIPE, of text, or DEVNULL.
        session: whether it has a session of its own.

    Returns:
        An object like a :class:`subprocess.Popen`.
    """
    argv = ["-c", *map(str, words)]
    if not hasattr(os, "fork"):
        return subprocess.Popen(
            [sys.executable, *argv[:1], program, *argv[1:]],
            cwd=cwd, stdin=stdin, stdout=stdout, stderr=stderr, text=True,
        )  # fmt: skip
    asked = {"program": program, "argv": argv, "cwd": str(cwd or os.getcwd())}
    asked |= {"env": dict(os.environ), "session": session}
    return Forked(asked, stdin, stdout, stderr)


def started(*words: object, **options: Any) -> Any:
    """Start the command as a user does, with options of :func:`process`."""
    return process(_COMMAND, *words, **options)


def finished(process: Any) -> subprocess.CompletedProcess:
    """Wait for a process; return its exit code and its streams."""
    stdout, stderr = process.communicate(timeout=PATIENCE)
    return subprocess.CompletedProcess([], process.returncode or 0, stdout, stderr)


def neurosim(*words: object, cwd: Path | str, check: bool = True) -> subprocess.CompletedProcess:
    """Run the command as a user does."""
    done = finished(started(*words, cwd=cwd))
    if check:
        assert done.returncode == 0, done.stderr
    return done


_ENDED = """
import os, pathlib, signal, sys
from neurosim.base import files
append, rows = files.LineLog.append, 0

def counted(self, *values):
    global rows
    append(self, *values)
    rows += self.path == pathlib.Path({log!r}){counts}
    if rows == {count}:
        rows += 1
        os.kill(os.getpid(), signal.{signal})

files.LineLog.append = counted
sys.argv = ["neurosim", *{words!r}]
from neurosim.cli import main
main()
"""


def ended_by(
    signal: str, words, *, log: Path | str, count: int, word: str = "", cwd: Path
) -> subprocess.CompletedProcess:
    """Run a command that sends itself a signal once a log has a given number of rows.

    Args:
        signal: its name, such as SIGKILL.
        words: of the command line.
        log: path as the command opens it.
        count: number of rows after which the signal is sent.
        word: only rows with this value count; by default all rows.
        cwd: folder.
    """
    program = _ENDED.format(
        log=str(log),
        counts=f" and {word!r} in values" if word else "",
        count=count,
        signal=signal,
        words=[str(each) for each in words],
    )
    return finished(process(program, cwd=cwd))
