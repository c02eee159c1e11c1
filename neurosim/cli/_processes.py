"""Runs each command in a separate process, on this computer or on a Ray cluster."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from neurosim.base.cluster import Name, ray_cluster
from neurosim.base.errors import UserError

#: Seconds in which an interrupted command saves its results.
ENDING = 30.0
#: Seconds after which, at most, a worker of a cluster notices that it is cancelled.
WORKER_NOTICES = 2.0


class Processes:
    """Runs several commands at once.

    Attributes:
        count: how many run at once.
    """

    def __init__(self, count: int | None, workers: Name, plugins: Sequence[Path] = ()):
        """Prepare the processes; nothing runs yet.

        Args:
            count: how many; None: one on this computer, or as many as a cluster has cores.
            workers: ``local``, this computer; or ``ray``, a cluster whose computers reach the
                same folders.
            plugins: files that each command runs first.

        Raises:
            UserError: if Ray is not installed or its cluster cannot be reached.
        """
        self._ray = None if workers == "local" else ray_cluster()
        if self._ray is None:
            self.count = count or 1
            threads = max((os.cpu_count() or 1) // self.count, 1)
        else:
            self.count = count or max(int(self._ray.cluster_resources().get("CPU", 1)), 1)
            threads = 1
        self._threads = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), str(threads))
        self._plugins = [word for path in plugins for word in ("--plugin", str(path))]
        self._running: set[Any] = set()
        self._lock, self._ended = threading.Lock(), False

    def run(self, words: Sequence[str]) -> dict[str, Any]:
        """Run a command of neurosim with ``--json``; return its result.

        Raises:
            UserError: with the command's last line on stderr, if it failed.
        """
        words = ["-m", "neurosim", *self._plugins, *words, "--json"]
        run = self._here if self._ray is None else self._elsewhere
        code, printed, errors = run(words)
        if code:
            lines = errors.strip().splitlines() or [f"it ended with exit code {code}"]
            raise UserError(lines[-1].removeprefix("neurosim: "))
        return dict(json.loads(printed))

    def end(self) -> None:
        """Interrupt the running commands, and start no more."""
        with self._lock:
            self._ended, running = True, list(self._running)
        if self._ray is None:
            _interrupt(running)
            return
        for one in running:
            self._ray.cancel(one)
        if running:
            self._ray.wait(running, num_returns=len(running), timeout=ENDING + WORKER_NOTICES)

    def _start(self, start: Any, *args: Any, **kwargs: Any) -> Any:
        with self._lock:
            if self._ended:
                raise UserError("interrupted")
            one = start(*args, **kwargs)
            self._running.add(one)
        return one

    def _here(self, words: list[str]) -> tuple[int, str, str]:
        process = self._start(_python, words, self._threads)
        printed, errors = process.communicate()
        self._running.discard(process)
        return process.returncode, printed, errors

    def _elsewhere(self, words: list[str]) -> tuple[int, str, str]:
        assert self._ray is not None
        task = self._ray.remote(num_cpus=1, max_retries=0)(_run)
        reference = self._start(task.remote, words, self._threads, str(Path.cwd()))
        try:
            return tuple(self._ray.get(reference))  # type: ignore[return-value]
        except self._ray.exceptions.RayError as error:
            raise UserError(f"its worker was lost: {type(error).__name__}") from None
        finally:
            self._running.discard(reference)


def _run(words: list[str], environment: dict[str, str], folder: str) -> tuple[int, str, str]:
    """Run a command in a worker of a cluster, by its own Python; end it when this is cancelled."""
    process = _python(words, environment, folder)
    try:
        while True:
            # A worker is cancelled between two lines of Python, and never while it waits.
            with suppress(subprocess.TimeoutExpired):
                printed, errors = process.communicate(timeout=WORKER_NOTICES / 4)
                return process.returncode, printed, errors
    finally:
        _interrupt([process])


def _python(
    words: list[str], environment: dict[str, str], folder: str | None = None
) -> subprocess.Popen[str]:
    """Start this process's Python with these words, and more variables in its environment."""
    return subprocess.Popen(
        [sys.executable, *words],
        cwd=folder,
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _interrupt(processes: Sequence[subprocess.Popen[str]]) -> None:
    """Interrupt those that run; return when all have ended.

    They are asked by SIGTERM: what a worker of Ray starts ignores SIGINT.
    """
    for one in processes:
        with suppress(OSError):
            one.terminate()
    for one in processes:
        try:
            one.wait(ENDING)
        except subprocess.TimeoutExpired:
            one.kill()
