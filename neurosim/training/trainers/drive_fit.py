"""Finding the drive model that rows are best explained by.

Given the actuators' laws, the displacement is linear in the kinematics: first the turn, then, the
turn taken as measured, the translation. The laws themselves are found by search over a few numbers
each, for the largest likelihood; errors are taken to be distributed as Student's t (Lange, Little
and Taylor 1989), because a drive model leaves large ones. What rows say little about keeps to what
is usual: a weak prior on every law, and on the products in the kinematics.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor

from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.drive import DriveModel, Underway
from neurosim.simulators.motion.network import chain, rows_underway
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import Within

#: Rows that the laws are searched with.
_ROWS = 600
#: The coarse search: laws shared by all actuators.
_LAGS = (0.005, 0.03, 0.06, 0.1, 0.15, 0.25, 0.4)
_RATES = (0.5, 1.0, 2.0, 4.0, 20.0)
_DELAYS = (0.0, 0.05, 0.1, 0.15, 0.2)
#: The fine search: one number after the other by these steps, in units of each prior's width.
#: Lag and delay together are to be found to within a millisecond or two: in each, a robot that is
#: told to turn the other way turns by a fifth of a degree.
_STEPS, _ROUNDS = (0.5, 0.2, 0.08, 0.03, 0.012, 0.005), 6
#: A step must raise the log-likelihood by this much.
_GAIN = 0.05
#: A delay, which is nearly a lag where only the ends of commands are known, must raise it by this.
_BELIEF = 10.0
#: What is searched for: the logarithm of lag and delay together (which alone say how far the robot
#: gets), of slowing, of braking over slowing, and of the rate; bend; stick and delay (s). What is
#: usual, how far from it, and limits.
_TOTAL, _SLOWING, _BRAKING, _RATE, _BEND, _STICK, _DELAY = range(7)
_USUAL = (math.log(0.1), 0.0, 0.0, math.log(20.0), 0.0, 0.0, 0.0)
_WIDTH = (1.0, 0.5, 0.5, 1.5, 0.15, 0.02, 0.08)
_SHORTEST = 0.003
_LOWEST = (math.log(_SHORTEST), math.log(0.2), math.log(0.2), math.log(0.3), -0.5, 0.0, 0.0)
_HIGHEST = (math.log(2.0), math.log(5.0), math.log(5.0), math.log(50.0), 0.5, 0.2, 0.5)
#: Products count, before rows say more, for no more than this share of what is to be explained.
_PRODUCTS = 0.05
#: Degrees of freedom of errors, and where Huber's loss begins to be linear.
_FREEDOM, _HUBER = 2.0, 1.345
_REGRESSIONS = 8
#: Laws of actuators that reach their speeds at once.
_AT_ONCE = torch.tensor(_USUAL, dtype=torch.float64).unsqueeze(1)
_AT_ONCE[_TOTAL], _AT_ONCE[_RATE] = _LOWEST[_TOTAL], _HIGHEST[_RATE]


@dataclass(frozen=True)
class Motion:
    """Rows as the drive model takes them.

    Attributes:
        x: scaled inputs before the bend, dead zones applied, [N, I].
        y: displacements, [N, 3].
        follows: whether a row's command followed that of the row before, [N].
        columns: of the inputs.
        longest: what durations are scaled by, s.
        within: poses within the commands, where they are known.
    """

    x: Tensor
    y: Tensor
    follows: Tensor
    columns: CommandFeatures
    longest: float
    within: Within | None = None

    def first(self, rows: int) -> Motion:
        """Return the first rows, and as many of the poses within them."""
        within = self.within
        if within is not None:
            known = torch.nonzero(within.row < rows).squeeze(1)
            known = known[:: -(-len(known) // rows) or 1]
            within = Within(*(part[known] for part in within)) if len(known) else None
        parts = (self.x[:rows], self.y[:rows], self.follows[:rows])
        return Motion(*parts, self.columns, self.longest, within)

    def inputs(self, drive: DriveModel) -> Tensor:
        """Return the inputs that a drive model makes of the rows, see :func:`chain`."""
        x = self.x.clone()
        for places in (self.columns.driven, self.columns.before):
            x[:, list(places)] = drive.shaped(x[:, list(places)])
        return chain(drive, self.columns, x, self.follows, self.longest)


def fit_drive(motion: Motion, laws: bool = True) -> DriveModel:
    """Return the drive model of rows.

    Args:
        motion: rows.
        laws: whether to look for the actuators' laws; if not, speeds are reached at once.
    """
    if not laws:
        return _fitted(_model(_AT_ONCE.repeat(1, len(motion.columns.driven))), motion)[0]
    count = len(motion.columns.driven)
    searched = motion.first(_ROWS)
    usual = torch.tensor(_USUAL, dtype=torch.float64)
    width = torch.tensor(_WIDTH, dtype=torch.float64)
    # First of all actuators together, then of each. A delay is one for all: the first column's.
    each = torch.eye(len(_USUAL), dtype=torch.float64)
    shared = [one[:, None].repeat(1, count) for one in each]
    own = [torch.zeros_like(shared[0]) for _ in range(_DELAY * count)]
    for number, direction in enumerate(own):
        direction[number // count, number % count] = 1.0
    directions = [direction * width.unsqueeze(1) for direction in (*shared, *own)]
    lowest, highest = (
        torch.tensor(limit, dtype=torch.float64).unsqueeze(1) for limit in (_LOWEST, _HIGHEST)
    )
    best = usual.unsqueeze(1).repeat(1, count)
    cost = math.inf

    def tried(laws: Tensor) -> bool:
        nonlocal best, cost
        laws = torch.maximum(torch.minimum(laws, highest), lowest)
        off = (laws - usual.unsqueeze(1)) / width.unsqueeze(1)
        off[_DELAY, 1:] = 0.0
        # A rate above the usual is no limit.
        off[_RATE] = off[_RATE].clamp(max=0.0)
        found = _fitted(_model(laws), searched)[1] + 0.5 * off.square().sum().item()
        if found < cost - _GAIN:
            best, cost = laws, found
            return True
        return False

    def coarsely(delays: Sequence[float]) -> None:
        for lag, rate, delay in product(_LAGS, _RATES, delays):
            coarse = usual.unsqueeze(1).repeat(1, count)
            coarse[_TOTAL], coarse[_RATE] = math.log(lag + delay), math.log(rate)
            coarse[_DELAY] = delay
            tried(coarse)

    def followed(change: Tensor) -> None:
        """Go on in a direction for as long as that helps."""
        while tried(best + change):
            pass

    def refined() -> tuple[Tensor, float]:
        """Search by patterns (Hooke and Jeeves 1961): a round's change is tried once more."""
        for step in _STEPS:
            for _ in range(_ROUNDS):
                before = best
                for direction in directions:
                    for sign in (step, -step):
                        followed(sign * direction)
                if torch.equal(best, before):
                    break
                followed(best - before)
        return best, cost

    coarsely(_DELAYS)
    found, least = refined()
    if found[_DELAY, 0] > 0.0:
        highest = highest.clone()
        highest[_DELAY] = 0.0
        delayed = found
        for begin in (lambda: coarsely(_DELAYS[:1]), lambda: tried(delayed)):
            cost = math.inf
            begin()
            if refined()[1] < least + _BELIEF:
                found, least = best, cost - _BELIEF
    return _fitted(_model(found), motion)[0]


def _model(laws: Tensor) -> DriveModel:
    total, slowing, braking, rate = laws[: _RATE + 1].exp()
    delay = laws[_DELAY, :1]
    lag = (total - delay).clamp(min=_SHORTEST)
    shape = DriveModel.shapes(len(lag))["kinematics"]
    parts = lag, slowing, slowing * braking, rate, laws[_BEND], laws[_STICK], delay
    return DriveModel(*parts, torch.zeros(shape))


def _fitted(drive: DriveModel, motion: Motion) -> tuple[DriveModel, float]:
    """Return a drive model with the best kinematics, and minus the log-likelihood of the rows."""
    x, turn = motion.inputs(drive), motion.y[:, 2]
    columns = motion.columns
    under, told = rows_underway(drive, columns, x), x[:, list(columns.driven)]
    pieces = drive.pieces(under, told, x[:, columns.duration] * motion.longest)
    linear = len(columns.driven)
    rate, cost = _regression(sum(pieces[1:], pieces[0]), turn, linear)
    turns = [piece @ rate for piece in pieces[:-1]]
    turns.append(turn - sum(turns, torch.zeros_like(turn)))
    ahead, aside, heading = 0.0, 0.0, -turn / 2.0
    for piece, part in zip(pieces, turns, strict=True):
        chord, angle = se2.chord(part), heading + part / 2.0
        ahead = ahead + (chord * angle.cos()).unsqueeze(1) * piece
        aside = aside + (chord * angle.sin()).unsqueeze(1) * piece
        heading = heading + part
    moved = se2.mid_turn(motion.y)
    columns_x, columns_y = torch.cat([ahead, -aside], 1), torch.cat([aside, ahead], 1)
    speeds, more = _regression(
        torch.cat([columns_x, columns_y]), torch.cat([moved[:, 0], moved[:, 1]]), linear
    )
    kinematics = torch.stack([*speeds.view(2, -1), rate], dim=1)
    laws = (getattr(drive, name) for name in DriveModel.NAMES[:-1])
    drive = DriveModel(*laws, kinematics)
    return drive, cost + more + _cost_within(drive, motion, under, told)


def _cost_within(drive: DriveModel, motion: Motion, under: Underway, told: Tensor) -> float:
    """Return minus the log-likelihood of poses within commands.

    They are from the same commands as the rows, which they are not to outweigh: they count as many
    as there are rows, at most.
    """
    within = motion.within
    if within is None or len(within.row) == 0:
        return 0.0
    row = within.row
    under = Underway(*(part[row] for part in under))
    changing, twist = drive.phases(under, told[row], within.time.to(told))
    error = se2.compose(changing, se2.exp(twist)) - within.moved.to(told)
    # What is short is measured by what is short.
    size = (1.4826 * error.abs().median(0).values).clamp(min=1e-6)
    each = (error / size).square() / _FREEDOM
    cost = (_FREEDOM + 1.0) / 2.0 * each.log1p().sum() + len(row) * size.log().sum()
    return cost.item() * min(len(motion.x) / len(row), 1.0)


def _regression(features: Tensor, target: Tensor, linear: int) -> tuple[Tensor, float]:
    """Return the weights of a regression with Huber's loss, and minus the log-likelihood.

    Args:
        features: [N, k F]: k times linear features and products.
        target: [N].
        linear: how many of F are linear.
    """
    width = linear + linear * (linear + 1) // 2
    product = torch.arange(features.shape[1]) % width >= linear
    shares, size = torch.ones_like(target), target.square().mean().sqrt().clamp(min=1e-9)
    pull = torch.zeros(features.shape[1], dtype=features.dtype)
    weights = pull
    # By a product alone a target would be of the size that it has, or less.
    power = features.square().mean(0).sqrt().clamp(min=1e-9)
    usual = _PRODUCTS * target.square().mean().sqrt().clamp(min=1e-9) / power
    for _ in range(_REGRESSIONS):
        weighed = features * shares.unsqueeze(1)
        square = weighed.T @ features
        least = 1e-9 * square.diagonal().mean().clamp(min=1e-12)
        square.diagonal().add_(pull + least)
        weights = torch.linalg.solve(square, weighed.T @ target)
        error = (features @ weights - target).abs()
        # The median of the magnitude is 0.67 standard deviations of a normal distribution.
        size = (1.4826 * error.median()).clamp(min=1e-9)
        shares = (_HUBER * size / error.clamp(min=1e-12)).clamp(max=1.0)
        pull = product * (size / usual).square()
    each = ((features @ weights - target) / size).square() / _FREEDOM
    cost = (_FREEDOM + 1.0) / 2.0 * each.log1p().sum() + len(target) * size.log()
    return weights, cost.item()
