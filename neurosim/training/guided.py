"""Choosing the commands to record next: those that an ensemble disagrees about most.

Query by committee (Seung, Opper and Sompolinsky, Query by committee, COLT 1992): the members of an
ensemble that learned from the rows so far disagree about commands that these rows say little about.
The information of a command is the part of that disagreement that it would remove, which is less if
its result is noisy (Cohn, Ghahramani and Jordan, Active learning with statistical models, JAIR 4,
1996). The best of a few random commands is taken, not the best of all: so what is chosen stays
spread out, and what the committee agrees on by mistake is met now and then.
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
from tracking.datasets.dataset import MOTOR_INPUTS, OUTPUTS, inputs_of
from tracking.datasets.displacements import displacements
from tracking.datasets.recordings import Recording

#: The least size of an expected error, as a quantile of those expected of the rows.
_QUIETEST = 0.02

#: How far inside the board's edge a chosen command is to end, m: the perimeter line lies about
#: half as far in, and the light sensors ahead of the axle.
MARGIN = 0.25

#: Parts of a command after which its predicted path is looked at.
_PARTS = (0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class GuidedSettings:
    """How commands are chosen.

    Attributes:
        members: of the ensemble that votes.
        candidates: random commands of which the best is taken.
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
        """Return how much of the disagreement the outcomes of inputs [N, I] would take away, [N].

        The three outputs count in units of their usual noise.

        Args:
            x: inputs [N, I].
            displacements: what every member says of them, [M, N, 3].
        """
        variance = displacements.var(0)
        return (taken_away(variance, self._noise(x).square()) / self._usual).sum(1)


def taken_away(variance: Tensor, noise: Tensor) -> Tensor:
    """Return by how much an outcome with some noise lessens the variance of what is believed.

    Args:
        variance: of what is believed of the outcome's mean.
        noise: variance of the outcome about its mean.
    """
    return variance.square() / (variance + noise)


class _ErrorSize:
    """How large an error is expected of a command; see :mod:`neurosim.training.error_size`."""

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
    """Where the robot is, and where it may go.

    Attributes:
        pose: x, y (m), heading (rad), on the board.
        length, width: of the rectangle about the board's middle that it is to stay in, m.
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
    """Choose commands to be given in a row, to a robot that stands.

    Each is the one of the source's next few that is worth most after the command before it.
    Where the robot's place is known, those that are predicted to lead out of the rectangle are
    taken only if all do; then the one that ends nearest to the middle.

    Args:
        committee: what votes.
        source: of candidates: command ``n`` is one of the source's ``candidates`` from number
            ``candidates * n``.
        numbers: of the commands to be chosen.
        place: where the robot is.
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
    # Where the arc of a whole turn is not known, nobody says that it is inside.
    half = np.array([place.length, place.width]) / 2
    return (np.abs(path[..., :2]) <= half).all((0, 2))


def motor_data(x: NDArray, y: NDArray, units: Mapping[str, str] = MOTOR_INPUTS) -> TrainingData:
    """Return rows (N, I) and (N, 3) as a trainer takes them; by default of a robot on wheels.

    Args:
        x, y: inputs and displacements.
        units: of the inputs, by name.
    """
    inputs = [{"name": name, "unit": unit} for name, unit in units.items()]
    return TrainingData(inputs, torch.tensor(x), torch.tensor(y))


def choose_round(
    made: Sequence[Recording], source: RandomCommands, numbers: range, pose: Pose
) -> tuple[list[Command], dict[str, Any]]:
    """Choose the commands of a round of a guided recording by what was recorded before.

    Args:
        made: the rounds so far, tracked.
        source: of candidates; its seed is that of all that is drawn here, too.
        numbers: of the commands to choose.
        pose: where the robot stands.

    Returns:
        The commands, and what the recording says of how they were chosen.

    Raises:
        UserError: if too few commands were tracked so far.
    """
    units = inputs_of(made[0].takes)
    x, y = _rows(made, units)
    settings = GuidedSettings()
    committee = Committee(motor_data(x, y, units), source.seed, settings)
    board = made[-1].meta["board"]
    place = Place(pose, board["length"] - 2 * MARGIN, board["width"] - 2 * MARGIN)
    # Little at a time: a second thread would only wait.
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
    """Return inputs [N, I] and displacements [N, 3] of what was recorded so far."""
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
