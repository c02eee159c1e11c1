"""Finding out how small an input must be to do nothing: a motor's dead zone.

Forward way and turn of a robot are, but for a tenth, linear in how long it is told to drive how
fast; and where a slow motor stands, all of its part is missing. So the zone is what a linear model
with the inputs in the zone taken as zero fits best. Errors are taken to be distributed as
Student's t (Lange, Little and Taylor 1989, Robust statistical modeling using the t distribution):
a command that the linear model is no good for says little about zones.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.noise import CommandFeatures

#: The largest dead zone, as a share of an input's largest magnitude, and how many sizes are tried.
_LARGEST, _TRIED = 0.5, 64
#: A dead zone must raise the log-likelihood by this much to be believed.
_BELIEVED = 3.0
#: Degrees of freedom of the errors.
_FREEDOM = 2.0
#: Steps of the robust regression, and rounds in which all inputs' zones are sought.
_STEPS, _ROUNDS = 8, 2
#: Where Huber's loss begins to be linear, in standard deviations.
_HUBER = 1.345


def find_dead_zone(names: Sequence[str], x: Tensor, y: Tensor) -> Tensor:
    """Return the dead zone of each input, [I]: smaller magnitudes do nothing.

    Only inputs that take both signs can have one, and an input has that of its predecessor
    (``left`` and ``prev_left`` are the same motor). It lies half way between two magnitudes that
    were given. First one zone for all is sought, because where both motors creep neither can be
    judged while the other is thought to move; then each for itself.

    Args:
        names: of the inputs.
        x: scaled inputs, [N, I].
        y: displacements, [N, 3] (m, m, rad).
    """
    columns = CommandFeatures.of(tuple(names))
    pairs = zip(columns.driven, columns.before, strict=True)
    motors = [pair for pair in pairs if x[:, pair[0]].amin() < 0 < x[:, pair[0]].amax()]
    zone = torch.zeros_like(x[0])
    if not motors:
        return zone
    rows = _Rows(columns, x, y)
    for group in (motors, *[[motor] for motor in motors] * _ROUNDS):
        zone = rows.settled(zone, group)
    return zone


class _Rows:
    """What a linear model says of rows under the assumption of a dead zone.

    In the mid-turn frame, forward way and turn are those of a constant twist, the way times the
    chord of the turn.
    """

    def __init__(self, columns: CommandFeatures, x: Tensor, y: Tensor):
        self._columns, self._x = columns, x
        ahead, _, turn = se2.mid_turn(y).unbind(-1)
        self._moved = torch.stack([ahead, turn])
        self._chord = torch.stack([se2.chord(turn), torch.ones_like(turn)])

    def settled(self, zone: Tensor, motors: Sequence[tuple[int, int]]) -> Tensor:
        """Return a zone in which that of these inputs, the same for all, is the likeliest.

        Args:
            zone: assumed so far, [I].
            motors: places of an input and of its predecessor, -1 if it has none.
        """
        places = [place for pair in motors for place in pair if place >= 0]
        group = torch.zeros_like(zone, dtype=torch.bool)
        group[places] = True
        features = self._features(zone)
        fits = [_robust_fit(c.unsqueeze(1) * features, m) for c, m in self._outputs()]
        given = self._x[:, [now for now, _ in motors]].abs()
        given = given[(given > 0) & (given <= _LARGEST)].unique()
        sizes = [0.0, *((given[1:] + given[:-1]) / 2.0)[:: len(given) // _TRIED + 1].tolist()]
        tried = [torch.where(group, size, zone) for size in sizes]
        costs = [self._cost(one, fits) for one in tried]
        best = min(range(len(costs)), key=costs.__getitem__)
        return tried[best if costs[0] - costs[best] > _BELIEVED else 0]

    def _outputs(self) -> zip:
        return zip(self._chord, self._moved, strict=True)

    def _features(self, zone: Tensor) -> Tensor:
        """Return what ways are linear in, [N, F].

        A wheel that follows its command u, after u', with a lag makes the way
        u * duration + (u' - u) * lag.
        """
        columns = self._columns
        x = torch.where(self._x.abs() < zone, 0.0, self._x)
        now = x[:, list(columns.driven)]
        before = x[:, [place for place in columns.before if place >= 0]]
        if columns.duration < 0:
            return torch.cat([now, before], dim=1)
        return torch.cat([now * x[:, columns.duration, None], now, before], dim=1)

    def _cost(self, zone: Tensor, fits: Sequence[tuple[Tensor, Tensor]]) -> float:
        """Return minus the log-likelihood of the rows, but for a constant."""
        features = self._features(zone)
        cost = 0.0
        for (chord, moved), (weights, size) in zip(self._outputs(), fits, strict=True):
            error = (chord * (features @ weights) - moved) / size
            each = (error.square() / _FREEDOM).log1p()
            cost += (_FREEDOM + 1.0) / 2.0 * each.sum().item()
        return cost


def _robust_fit(features: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weights [F] of a regression with Huber's loss, and the size of its errors, []."""
    shares = torch.ones_like(target)
    for _ in range(_STEPS):
        weighed = features * shares.unsqueeze(1)
        square = weighed.T @ features
        square.diagonal().add_(1e-9 * square.diagonal().mean())
        weights = torch.linalg.solve(square, weighed.T @ target)
        error = (features @ weights - target).abs()
        # The median of the magnitude is 0.67 standard deviations of a normal distribution.
        size = (1.4826 * error.median()).clamp(min=1e-12)
        shares = (_HUBER * size / error.clamp(min=1e-12)).clamp(max=1.0)
    return weights, size
