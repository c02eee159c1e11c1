"""Trials in reality: each is written down before it is used, and none is made twice.

A reality is any object with ``trial(genes, number)`` that returns a fitness; with poses if the
robot is tracked (:class:`~neurosim.base.trajectory.Tracked`). A search in reality asks an optimiser
for individuals, gets their fitness from the journal, and gives it to the optimiser. After an
interruption the search starts again, and the journal returns the known results.
"""

from __future__ import annotations

import math
import queue
import threading
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from neurosim.base.declared import Mismatch, convert
from neurosim.base.errors import FileError, RobotError, UserError
from neurosim.base.files import JsonLines, read_json_lines
from neurosim.base.formats import TrialRow
from neurosim.base.progress import Progress
from neurosim.base.trajectory import Tracked

FORMAT, VERSION = "neurosim-real-trials", 1
#: The file's name.
TRIALS = "trials.jsonl"
#: Largest number of trials made at once, which an interruption loses.
AT_ONCE = 6
#: Time that a running trial has to end after Ctrl-C, s.
GRACE = 3.0
_KEPT = "the trials before it are kept: fix the problem and continue with --resume"


@runtime_checkable
class Reality(Protocol):
    """A reality, in which controllers are tried.

    Optional: ``describe() -> dict``, a description for JSON, which must be the same on resume;
        ``instruction``, a sentence for the person who puts the robot back before every trial;
        ``patient = True``, if that person may take any time; ``trials(genes [N, G], numbers [N]) ->
        [N]``, if several can be made at once; ``stop()``, called from another thread when a running
        trial is given up; ``filmed``, the number of a trial's first steps in which the robot is
        tracked, if not in all. See also :class:`Comparing`.
    """

    def trial(self, genes: NDArray[np.float64], number: int) -> float | Tracked:
        """Return the fitness of an individual [G] in a trial; the higher the better.

        Args:
            genes: of it.
            number: number of earlier trials.
        """
        ...


@runtime_checkable
class Comparing(Protocol):
    """A reality that shows its path next to the simulator's."""

    def compare(self, genes: NDArray[np.float64], seed: int) -> list[dict[str, list]]:
        """Return paths of an individual [G], each ``simulated`` and ``robot`` from one start."""
        ...


class Journal:
    """The trials of one run, and their file.

    Attributes:
        used: number of trials that the run has used so far, including those before an interruption.
        made: number of those made since it was begun or resumed.
    """

    def __init__(
        self,
        reality: Reality | Callable[[NDArray[np.float64]], float],
        path: str | Path,
        *,
        each: int = 3,
        patience: float = 600.0,
        ask: Callable[[str], None] | None = None,
        progress: bool = False,
    ):
        """Open the file of trials, or begin it.

        Args:
            reality: a reality, or a function of genes [G] that returns a fitness.
            path: the file, lines of JSON.
            each: number of trials of an evaluation, whose fitness is their mean (section 5.2: 3).
            patience: longest time of a trial, s.
            ask: asks a person to do something, and returns when it is done.
            progress: whether to show progress on stderr, unless a person is asked.

        Raises:
            UserError: if the reality needs a person and there is none.
            FileError: if the file is damaged, or is of another reality.
        """
        self._reality: Any = _Function(reality) if not isinstance(reality, Reality) else reality
        self._each, self._patience, self._ask = each, patience, ask
        self._instruction = getattr(self._reality, "instruction", None)
        self._progress = progress and self._instruction is None
        if self._instruction is not None and ask is None:
            raise UserError(
                f"this reality needs a person ({self._instruction}): give a function that asks one"
            )
        self._file = JsonLines(path, FORMAT, VERSION, {"reality": about_reality(self._reality)})
        self._known: dict[bytes, list[_Trial]] = {}
        for line, row in enumerate(self._file.rows, 2):
            genes, trial = _checked(row, self._file.path, line)
            self._known.setdefault(genes.tobytes(), []).append(trial)
        self._count = len(self._file.rows)
        self.used = self.made = 0
        self._taken: dict[bytes, int] = {}
        self._interrupted = False
        self._steps: int | None = None

    def expect(self, steps: int) -> None:
        """Raise an error, from now on, for trials that were tracked for another number of steps.

        Raises:
            FileError: if there is one among those that were made before.
        """
        self._steps = steps = min(steps, getattr(self._reality, "filmed", 0) or steps)
        for line, row in enumerate(self._file.rows, 2):
            if "poses" in row and len(row["poses"]) != steps:
                wrong = self._other_steps(len(row["poses"]))
                raise FileError(self._file.path, wrong, line=line, field="poses")

    def _other_steps(self, steps: int) -> str:
        return (
            f"reality tracked {steps} poses in a trial; expected {self._steps}, one after each "
            "step of the task's trial"
        )

    @property
    def evaluations(self) -> float:
        """Number of evaluations that the run has used so far: trials over trials of one."""
        return self.used / self._each

    def evaluate(
        self, genes: NDArray[np.float64], why: str, evaluations: int = 1
    ) -> NDArray[np.float64]:
        """Return the mean fitness [P] of individuals [P, G]; see :meth:`fitness`."""
        return self.fitness(genes, why, evaluations).mean(axis=1)

    def fitness(
        self, genes: NDArray[np.float64], why: str, evaluations: int = 1
    ) -> NDArray[np.float64]:
        """Return the fitness [P, T] of individuals [P, G] in T trials, and make missing trials.

        Args:
            genes: a row for each individual.
            why: the purpose of the trials, for the file.
            evaluations: number for each; trials that were made before count.

        Raises:
            UserError: if the reality did not return a finite number.
            RobotError: if it did not answer in time, or was lost.
            KeyboardInterrupt: at Ctrl-C; a trial that ended within :data:`GRACE` is written down.
        """
        wanted = evaluations * self._each
        missing = []
        for key, row in {row.tobytes(): row for row in genes}.items():
            missing += [row] * (wanted - len(self._known.get(key, [])))
            self.used += max(wanted - self._taken.get(key, 0), 0)
            self._taken[key] = max(wanted, self._taken.get(key, 0))
        self._make(missing, why)
        each = [self._known[row.tobytes()][:wanted] for row in genes]
        return np.array([[trial.fitness for trial in trials] for trials in each])

    def poses(self, genes: NDArray[np.float64]) -> list[NDArray[np.float64]] | None:
        """Return the poses [R, K, 3] in the R tracked trials of each of individuals [P, G].

        These are the trials that the run has used so far, not further ones in the file: an
        interruption changes nothing. NaN where a pose was not seen; None if no pose was seen at
        all.
        """
        each = []
        for row in genes:
            key = row.tobytes()
            used = self._known.get(key, [])[: self._taken.get(key, 0)]
            each.append([trial.poses for trial in used if trial.poses is not None])
        seen = [poses for trials in each for poses in trials]
        if not any(np.isfinite(poses).any() for poses in seen):
            return None
        return [np.array(trials).reshape(-1, *seen[0].shape) for trials in each]

    def _make(self, rows: list[NDArray[np.float64]], why: str) -> None:
        together = hasattr(self._reality, "trials") and self._instruction is None
        size = AT_ONCE if together else 1
        label = f"{why}: trials in reality"
        shown = Progress(label, len(rows), "trials") if self._progress and rows else None
        with shown or nullcontext():
            for first in range(0, len(rows), size):
                part = np.stack(rows[first : first + size])
                self._make_some(part, why, together)
                if shown:
                    shown.advance(len(part))

    def _make_some(self, part: NDArray[np.float64], why: str, together: bool) -> None:
        """Make a trial, or several at once, and write them down."""
        number = self._count
        if self._ask is not None and self._instruction is not None:
            self._ask(self._instruction)
        call = partial(self._reality.trial, part[0], number)
        if together:
            call = partial(self._reality.trials, part, number + np.arange(len(part)))
        answer = self._answer(call, len(part), number)
        if together and np.shape(answer)[:1] != (len(part),):
            raise _no_number(answer, number)
        for row, one in zip(part, answer if together else [answer], strict=True):
            self._write(row, one, why)
        self._stop_if_interrupted()

    def _stop_if_interrupted(self) -> None:
        if self._interrupted:
            self._interrupted = False
            raise KeyboardInterrupt

    def _answer(self, call: Callable[[], Any], trials: int, number: int) -> Any:
        """Return the result of a call, unless it takes too long."""
        if self._instruction is not None and getattr(self._reality, "patient", False):
            return call()
        box: queue.Queue[tuple[Any, BaseException | None]] = queue.Queue()

        def work() -> None:
            try:
                box.put((call(), None))
            except BaseException as error:
                box.put((None, error))

        try:
            try:
                threading.Thread(target=work, daemon=True).start()
                answer, error = box.get(timeout=self._patience * trials)
            except KeyboardInterrupt:
                self._interrupted = True
                answer, error = box.get(timeout=GRACE)
        except queue.Empty:
            if hasattr(self._reality, "stop"):
                self._reality.stop()
            self._stop_if_interrupted()
            which = f"trial {number + 1}" + (f" to {number + trials}" if trials > 1 else "")
            raise RobotError(
                f"reality did not answer in {which} within {self._patience * trials:g} s; {_KEPT}"
            ) from None
        if error is not None:
            self._stop_if_interrupted()
            raise error
        return answer

    def _write(self, genes: NDArray[np.float64], answer: Any, why: str) -> None:
        fitness, poses = answer, None
        if isinstance(answer, Tracked):
            fitness, poses = answer.fitness, _poses(answer.poses)
            if poses is None:
                raise UserError(
                    f"reality returned poses of shape {np.shape(answer.poses)} in trial "
                    f"{self._count + 1}, not [K, 3]"
                )
            if self._steps not in (None, len(poses)):
                raise UserError(f"{self._other_steps(len(poses))}; {_KEPT}")
        try:
            value = float(fitness)
        except (TypeError, ValueError):
            raise _no_number(fitness, self._count) from None
        if not math.isfinite(value):
            raise _no_number(fitness, self._count)
        row: dict[str, Any] = {
            "number": self._count,
            "genes": genes.tolist(),
            "fitness": value,
            "why": why,
        }
        if poses is not None:
            row["poses"] = [one.tolist() if np.isfinite(one).all() else None for one in poses]
        self._file.append(row)
        self._known.setdefault(genes.tobytes(), []).append(_Trial(value, poses))
        self._count += 1
        self.made += 1

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def about_reality(reality: Any) -> dict[str, Any]:
    """Return the description of a reality; empty if it has none."""
    return reality.describe() if hasattr(reality, "describe") else {}


class _Trial(NamedTuple):
    """The answer to a trial: its fitness, and poses [K, 3] if it was tracked."""

    fitness: float
    poses: NDArray[np.float64] | None


class _Function:
    """A reality made from a function of genes."""

    def __init__(self, function: Any):
        if not callable(function):
            raise UserError(
                "a reality must be a function of genes, or have a method trial(genes, number)"
            )
        self._function = function

    def trial(self, genes: NDArray[np.float64], number: int) -> float:
        """Return the function's result."""
        return self._function(genes)


def _no_number(answer: Any, number: int) -> UserError:
    shown = "nothing" if answer is None else f"{answer!s:.40}"
    return UserError(f"reality returned {shown} in trial {number + 1}, not a fitness; {_KEPT}")


def _poses(answer: Any) -> NDArray[np.float64] | None:
    """Return poses [K, 3], all NaN where one of the three is not finite; None if there are no
    poses."""
    try:
        poses = np.array(answer, np.float64)
    except (TypeError, ValueError):
        return None
    if poses.ndim != 2 or poses.shape[1] != 3 or not len(poses):
        return None
    return np.where(np.isfinite(poses).all(axis=1, keepdims=True), poses, np.nan)


def _checked(row: dict[str, Any], path: Path, line: int) -> tuple[NDArray[np.float64], _Trial]:
    try:
        convert(row, TrialRow)
    except Mismatch as error:
        raise FileError(path, error.what, line=line, field=error.field) from None
    given = row.get("poses")
    poses = _poses([[math.nan] * 3 if one is None else one for one in given]) if given else None
    return np.array(row["genes"], np.float64), _Trial(float(row["fitness"]), poses)


def read_trials(path: str | Path) -> list[dict[str, Any]]:
    """Read a file of trials: number, genes, fitness and why of each, poses where it was tracked.

    Raises:
        FileError: if it is missing or damaged.
    """
    rows = read_json_lines(path)[0][1:]
    for line, row in enumerate(rows, 2):
        _checked(row, Path(path), line)
    return rows
