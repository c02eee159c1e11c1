"""What every task offers: where a trial starts, how long it is, and what a trajectory is worth."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, is_dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from neurosim.base.declared import Checked
from neurosim.base.trajectory import Episode, Trajectory
from neurosim.tasks.score import Replayed, Score

if TYPE_CHECKING:
    from neurosim.simulators.base import Simulator


@dataclass(frozen=True, eq=False)
class Judgement:
    """What a task says of a batch of trajectories; ``...`` are their leading axes.

    Attributes:
        fitness: [...] float64, finite; the higher the better.
        success: [...] bool, whether the task is done.
        reason: [...] why not: an index into the task's ``reasons``, or -1 where it is done.
        segment: [...] the command during which that was settled; the last where it is done.
        detail: name -> [...]: what the fitness was made of; a task's own.
    """

    fitness: NDArray[np.float64]
    success: NDArray[np.bool_]
    reason: NDArray[np.int64]
    segment: NDArray[np.int64]
    detail: dict[str, NDArray] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        fitness: NDArray,
        success: NDArray,
        reason: NDArray | int = 0,
        segment: NDArray | int = 0,
        **detail: NDArray,
    ) -> Judgement:
        """Return a judgement of arrays [...], with ``reason`` and ``segment`` filled in."""
        success = np.asarray(success, np.bool_)
        why = np.where(success, -1, reason)
        where = np.broadcast_to(np.asarray(segment, np.int64), success.shape)
        return cls(np.asarray(fitness, np.float64), success, why, where, detail)


class Task(Checked):
    """Something to be achieved, judged by one function of the trajectory; subclass it.

    A task of your own is a frozen dataclass with a ``name``, what makes it different as fields,
    with their ranges (:mod:`neurosim.base.declared`), and :meth:`judge`. A trajectory may be
    simulated or driven; that makes no difference here.

    Attributes:
        name: what ``--task`` takes.
        reasons: the ways in which a trial can fail, in words that follow "the robot".
        start: x (m), y (m), heading (rad) where a trial starts, in the board's frame.
        trial_starts: a trial is made from so many starts.
        highest_fitness: no trial is worth more; None: nothing is known of that.
        fitness_unit: of the fitness, if it has one.
        replanned: whether a plan is to be planned again after every command where nothing else is
            said, because no blind one does the task.
    """

    name: ClassVar[str]
    reasons: ClassVar[tuple[str, ...]] = ("did not complete the task",)
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    trial_starts: int = 1
    highest_fitness: float | None = None
    fitness_unit: ClassVar[str] = ""
    replanned: ClassVar[bool] = False

    @property
    def episode(self) -> Episode:
        """How a trial runs; by default 30 s of steps of 0.1 s, then the motors run down."""
        return Episode(rest=0.5)

    @property
    def usual_controller(self) -> str:
        """The kind of controller, unless another is named: a network where readings are needed."""
        return "network" if self.episode.readings else "plan"

    def judge(self, trajectory: Trajectory) -> Judgement:
        """Judge trajectories [...]; see :class:`Judgement`.

        Raises:
            UserError: if the task needs poses or readings and the trajectory has none.
        """
        raise NotImplementedError

    def progress(self, trajectory: Trajectory) -> NDArray[np.float64]:
        """Return how far trajectories [...] came, without steps: a fitness to climb.

        By default the fitness itself.
        """
        return self.judge(trajectory).fitness

    def score(self, count: int, columns: int, sensors: int) -> Score:
        """Return what follows the progress of trials step by step.

        By default each is judged anew after every step: time that grows with its square.

        Args:
            count: trials at once.
            columns: of their commands.
            sensors: whose readings there are.
        """
        return Replayed(self, count, columns, sensors)

    def whole(self, fitness: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fitness of whole trials [...] of those from each start [..., trial_starts]."""
        return fitness.mean(axis=-1)

    def draw_starts(
        self, simulator: Simulator, count: int, rng: np.random.Generator
    ) -> NDArray[np.float64] | None:
        """Return start poses [count, 3] drawn at random; None: every trial starts at ``start``.

        Args:
            simulator: knows what place there is.
            count: poses.
            rng: source of the draws.
        """
        return None

    def region(self, poses: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return which part of the course each pose [..., 3] is in, a number for each part.

        Crossover pairs commands of two plans that were given in the same part; by default in the
        same square of half a metre.
        """
        squares = np.floor(np.nan_to_num(np.asarray(poses)[..., :2], nan=1e3) / 0.5)
        x, y = np.clip(squares, -1000, 1000).astype(np.int64).T
        return (x * 2001 + y).T

    def outline(self) -> list[dict[str, Any]]:
        """Return what a picture of the task shows, in m: a list of shapes.

        Each is ``{"polygon": [[x, y], ...]}`` (of two points, a line), ``{"circle": [x, y,
        radius]}`` or ``{"text": str, "at": [x, y]}``; what the robot must not touch or enter has
        ``"forbidden": True``.
        """
        return []

    def describe(self) -> dict[str, Any]:
        """Return name and settings, enough to make the same task again."""
        settings: dict[str, Any] = asdict(self) if is_dataclass(self) else {}
        return {"name": self.name, "settings": settings}
