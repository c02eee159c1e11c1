"""Follow a closed line, lap after lap, without losing it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.closed_line import ClosedLine
from neurosim.base.declared import Metres, Pose, Seconds, Step
from neurosim.base.errors import UserError
from neurosim.base.place import Place
from neurosim.base.trajectory import Episode
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Interval, Judgement, Task


@dataclass(frozen=True)
class FollowLine(Task):
    """Follow a closed line on the board.

    Fitness is the distance along the line in laps, in the direction in which the robot was placed,
    until it loses the line or the time is up. Driving back reduces it.

    Attributes:
        place: Place with the line, a JSON file or a name: rectangle or ellipse, of 1.4 x 0.8 m
            around the board's middle; by default the rectangle. Its first closed line counts.
        laps: Laps without losing the line that count as success.
        within: Distance of the middle of the axle from the line beyond which the line is lost, m.
        direction: Which way trials go round: along the line (counter-clockwise, or in the points'
            order), against it, or both, each as often in random starts.
        step: Time between two commands, s.
        seconds: Time of a trial, s.
    """

    name: ClassVar[str] = "follow-line"
    reasons: ClassVar[tuple[str, ...]] = ("lost the line", "did not make all laps in its time")

    place: Place | None = None
    laps: Annotated[float, Meta(ge=0.001, le=1000000)] = 10.0
    within: Metres = 0.08
    direction: Literal["both", "along", "against"] = "both"
    step: Step = 0.2
    seconds: Seconds = 400.0

    def __post_init__(self) -> None:
        if self.place is None:
            object.__setattr__(self, "place", Place.with_line("rectangle"))
        super().__post_init__()
        if not self.within < self.line.length / 4:
            raise UserError(
                f"the line is {self.line.length:g} m long: within must be below a quarter of that, "
                f"not {self.within:g} m"
            )

    @cached_property
    def line(self) -> ClosedLine:
        """The line, in driving order."""
        assert self.place is not None
        for line in self.place.lines:
            if line.closed:
                return line.loop
        raise UserError("this place has no closed line to follow: add one to its lines")

    @property
    def start(self) -> Pose:  # type: ignore[override]
        """The beginning of the line, facing along it, or against it in that direction."""
        x, y, heading = self.line.poses(0.0, self.direction == "against").tolist()
        return x, y, heading

    @property
    def episode(self) -> Episode:
        """Steps for ``seconds``; a trial ends moving."""
        return Episode(self.step, max(round(self.seconds / self.step), 1))

    @property
    def usual_controller(self) -> str:
        """A network: a line cannot be followed in open loop."""
        return "network"

    def draw_starts(
        self, simulator: Simulator, count: int, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Return poses [count, 3] anywhere on the line, facing along it or against it."""
        along = rng.uniform(0.0, self.line.length, count)
        backwards = rng.permutation(count) % 2 == rng.integers(2)
        if self.direction != "both":
            backwards = np.full(count, self.direction == "against")
        return self.line.poses(along, backwards)

    def first_record(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return records [K, 7].

        Their columns: lost; position along the line (m); direction (1 or -1); laps, and most laps;
        sum of distances from the line (m), their number.
        """
        away, along, direction = self._seen(poses)
        lost = away > self.within
        zero = np.zeros(len(poses))
        near = np.where(lost, 0.0, away)
        return np.stack([lost, along, direction, zero, zero, near, ~lost], axis=1).astype(float)

    def advance(self, record: NDArray[np.float64], interval: Interval) -> None:
        """Add an interval; nothing counts after the line was lost."""
        away, along, _ = self._seen(interval.poses)
        lost = (record[:, 0] > 0) | (away > self.within)
        made = self._forward(record[:, 1], along) * record[:, 2] / self.line.length
        record[:, 0], record[:, 1] = lost, along
        record[:, 3] += np.where(lost, 0.0, made)
        record[:, 4] = np.maximum(record[:, 4], record[:, 3])
        record[:, 5] += np.where(lost, 0.0, away)
        record[:, 6] += ~lost

    def worth(self, record: NDArray[np.float64]) -> Judgement:
        """Return laps; ``detail`` also has the mean distance from the line until it was lost, m."""
        lost, _, _, laps, most, away, count = record.T
        mean, why = away / np.maximum(count, 1), np.where(lost > 0, 0, 1)
        return Judgement.of(laps, most >= self.laps, why, laps=laps, distance=mean)

    def outline(self) -> list[dict[str, Any]]:
        assert self.place is not None
        return self.place.shapes()

    def _seen(self, poses: NDArray[np.float64]) -> tuple[NDArray, NDArray, NDArray]:
        """Return distance of poses [..., 3] from the line, position along it, and direction.

        They are [...] each, m, m, and 1 if the robot faces along the line, else -1. Unknown poses
        are far away.
        """
        away, along = self.line.nearest(np.nan_to_num(poses[..., :2], nan=1e6))
        heading = self.line.poses(along)[..., 2]
        return away, along, np.where(np.cos(poses[..., 2] - heading) >= 0, 1.0, -1.0)

    def _forward(self, before: NDArray, after: NDArray) -> NDArray[np.float64]:
        """Return the change of the position along the line, m, the shorter way round."""
        length = self.line.length
        return np.remainder(after - before + length / 2, length) - length / 2
