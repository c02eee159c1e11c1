"""The choice of the next commands to record: those with the largest disagreement in an ensemble.

Query by committee (Seung, Opper and Sompolinsky, Query by committee, COLT 1992): the members of an
ensemble that learned from the rows so far disagree about commands that are unlike these rows. The
information of a command is the part of that disagreement that it would remove, which is less if its
result is noisy (Cohn, Ghahramani and Jordan, Active learning with statistical models, JAIR 4,
1996). The best of a few random commands is taken, not the best of all: so the choice stays spread
out, and also tests predictions on which all members agree by mistake.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.base.files import sha256
from neurosim.base.threads import one_thread
from neurosim.recording.commands import Command, CommandSource, RandomCommands
from neurosim.recording.rounds import Pose
from neurosim.simulators import MotionNetwork
from neurosim.training.base import TrainingData
from neurosim.training.error_size import size_features, size_weights
from neurosim.training.train import MIN_ROWS, learn
from tracking.datasets.dataset import MOTOR_INPUTS, OUTPUTS
from tracking.datasets.displacements import displacements
from tracking.datasets.logs import inputs_of
from tracking.datasets.recordings import Recording

#: Smallest expected size of an error, as a quantile of the rows' expected sizes.
_QUIETEST = 0.02

#: Distance from the board's edge inside which a chosen command must end, m: the perimeter line is
#: about half as far inside, and the light sensors are ahead of the axle.
MARGIN = 0.25

#: Fractions of a command at which its predicted path is checked.
_PARTS = (0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class GuidedSettings:
    """Settings of the choice of commands.

    Attributes:
        members: number of members of the voting ensemble.
        candidates: number of random commands of which the best is taken.
    """

    members: int = 16
    candidates: int = 8


class Committee:
    """An ensemble that learned from the rows so far.

    Args:
        data: the rows so far, inputs as :data:`tracking.datasets.dataset.MOTOR_INPUTS`.
        seed: of the training.
        settings: of the choice.
    """

    def __init__(self, data: TrainingData, seed: int, settings: GuidedSettings | None = None):
        settings = settings or GuidedSettings()
        self._ensemble = learn(data, seed, members=settings.members, noise=False)
        mean = self._ensemble.displacement_of(self._ensemble.chained(data.x))
        self._noise = _ErrorSize(self._ensemble, data.x, mean - data.y)
        self._usual = self._noise(data.x).square().mean(0)

    def displacements(self, x: Tensor) -> Tensor:
        """Return every member's prediction, [M, N, 3] (m, m, rad), for inputs [N, I]."""
        members, rows = self._ensemble.members, len(x)
        each = torch.arange(members).repeat_interleave(rows)
        return self._ensemble.displacement(x.repeat(members, 1), each).view(members, rows, 3)

    def worth(self, x: Tensor, displacements: Tensor) -> Tensor:
        """Return how much of the disagreement the results of inputs [N, I] would remove, [N].

        The three outputs count in units of their usual noise.

        Args:
            x: inputs [N, I].
            displacements: every member's predictions for them, [M, N, 3].
        """
        variance = displacements.var(0)
        return (taken_away(variance, self._noise(x).square()) / self._usual).sum(1)


def taken_away(variance: Tensor, noise: Tensor) -> Tensor:
    """Return the reduction of a belief's variance by a noisy result.

    Args:
        variance: variance of the belief about the result's mean.
        noise: variance of the result about its mean.
    """
    return variance.square() / (variance + noise)


class _ErrorSize:
    """The expected size of a command's error; see :mod:`neurosim.training.error_size`."""

    def __init__(self, simulator: MotionNetwork, x: Tensor, errors: Tensor):
        self._simulator = simulator
        features = self._features(x)
        self._weights = size_weights(features, errors, ridge=1e-2)
        fitted = features @ self._weights
        self._least, self._most = fitted.quantile(_QUIETEST, 0), fitted.amax(0)
        fitted = fitted.clamp(min=self._least)
        self._factor = (errors.square().mean(0) / (2.0 * fitted).exp().mean(0)).sqrt()

    def _features(self, x: Tensor) -> Tensor:
        return size_features(self._simulator.scaled(x))

    def __call__(self, x: Tensor) -> Tensor:
        """Return standard deviations [N, 3] of inputs [N, I]."""
        log = (self._features(x) @ self._weights).clamp(self._least, self._most)
        return log.exp() * self._factor


@dataclass(frozen=True)
class Place:
    """The robot's pose, and the area in which it must stay.

    Attributes:
        pose: x, y (m), heading (rad), on the board.
        length, width: of the rectangle about the board's middle in which it must stay, m.
    """

    pose: tuple[float, float, float]
    length: float
    width: float


def choose(
    committee: Committee,
    source: CommandSource,
    numbers: Sequence[int],
    place: Place | None = None,
    settings: GuidedSettings | None = None,
) -> list[Command]:
    """Choose a sequence of commands for a robot that stands.

    Each is the one of the source's next few commands that has the most information after the
    previous one. If the robot's pose is known, commands whose predicted path leaves the rectangle
    are taken only if all do; then the one that ends nearest to the middle.

    Args:
        committee: the voting ensemble.
        source: of candidates: command ``n`` is one of the source's ``candidates`` from number
            ``candidates * n``.
        numbers: numbers of the chosen commands.
        place: pose and area of the robot.
        settings: of the choice.
    """
    settings = settings or GuidedSettings()
    chosen: list[Command] = []
    before: tuple[float, ...] | None = None
    pose = None if place is None else np.array(place.pose, float)
    for number in numbers:
        first = settings.candidates * number
        candidates = [source.command(first + k) for k in range(settings.candidates)]
        if before is None:  # the robot stands
            before = (0.0,) * len(candidates[0].numbers)
        x = torch.tensor([[*before, *c.row] for c in candidates], dtype=torch.float64)
        predicted = committee.displacements(x)
        worth = committee.worth(x, predicted).numpy()
        if place is None or pose is None:
            best = int(worth.argmax())
        else:
            moved = predicted.mean(0)
            path = se2.compose(pose, [se2.arc(moved.numpy(), part) for part in _PARTS])
            inside = _inside(path, place)
            if inside.any():
                best = int(np.where(inside, worth, -np.inf).argmax())
            else:
                best = int(np.hypot(path[-1, :, 0], path[-1, :, 1]).argmin())
            pose = path[-1, best]
        chosen.append(candidates[best])
        before = candidates[best].numbers
    return chosen


def _inside(path: NDArray, place: Place) -> NDArray:
    # The arc of a whole turn is unknown, so it may leave the rectangle.
    half = np.array([place.length, place.width]) / 2
    return (np.abs(path[..., :2]) <= half).all((0, 2))


def motor_data(x: NDArray, y: NDArray, units: Mapping[str, str] = MOTOR_INPUTS) -> TrainingData:
    """Return rows (N, I) and (N, 3) as a trainer's data; by default of a robot on wheels.

    Args:
        x, y: inputs and displacements.
        units: of the inputs, by name.
    """
    inputs = [{"name": name, "unit": unit} for name, unit in units.items()]
    return TrainingData(inputs, torch.tensor(x), torch.tensor(y))


def choose_round(
    made: Sequence[Recording], source: RandomCommands, numbers: range, pose: Pose
) -> tuple[list[Command], dict[str, Any]]:
    """Choose the commands of a round of a guided recording from the earlier rounds.

    Args:
        made: the rounds so far, tracked.
        source: of candidates; its seed is also that of all random numbers here.
        numbers: of the commands to choose.
        pose: pose of the robot.

    Returns:
        The commands, and the description of the choice for the recording.

    Raises:
        UserError: if too few commands were tracked so far.
    """
    units = inputs_of(made[0].takes.units)
    x, y = _rows(made, units)
    settings = GuidedSettings()
    committee = Committee(motor_data(x, y, units), source.seed, settings)
    board = made[-1].meta["board"]
    place = Place(pose, board["length"] - 2 * MARGIN, board["width"] - 2 * MARGIN)
    # Small computations: a second thread would only wait.
    with one_thread():
        chosen = choose(committee, source, numbers, place, settings)
    return chosen, {
        "chosen_by": "disagreement",
        "choice": asdict(settings),
        "rows": len(x),
        "learned_from": {
            f"{recording.path.name}/poses.csv": sha256(recording.path / "poses.csv")
            for recording in made
        },
    }


def _rows(made: Sequence[Recording], units: Mapping[str, str]) -> tuple[NDArray, NDArray]:
    """Return inputs [N, I] and displacements [N, 3] of the rounds so far."""
    rows = [row for recording in made for row in displacements(recording).rows]
    if len(rows) < MIN_ROWS:
        raise UserError(
            f"only {len(rows)} commands could be tracked, too few to learn from; check the "
            f"camera, or see {made[-1].path} with neurosim report"
        )
    inputs, outputs = (
        np.array([[row[name] for name in names] for row in rows], float)
        for names in (units, OUTPUTS)
    )
    return inputs, outputs
