"""Finding the drive model that rows are best explained by.

Given the actuators' laws, the displacement is linear in the kinematics: first the turn, then, the
turn taken as measured, the translation. The laws themselves are a few numbers for each actuator,
searched for by the method of Levenberg (1944) and Marquardt (1963), with the kinematics fitted anew
at each step (Golub and Pereyra 1973). Errors are taken to be distributed as Student's t (Lange,
Little and Taylor 1989), because a drive model leaves large ones. What rows say little about keeps
to what is usual: a weak prior on every law, and on the products in the kinematics.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import ClassVar, NamedTuple, Protocol

import torch
from torch import Tensor

from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.drive import CURVES, DriveModel, Underway
from neurosim.simulators.motion.network import chain, rows_underway
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import Within

#: Rows that the laws are searched with.
_ROWS = 600
#: The coarse search: laws shared by all actuators.
_LAGS = (0.005, 0.03, 0.06, 0.1, 0.15, 0.25, 0.4)
_RATES = (0.5, 1.0, 2.0, 4.0, 20.0)
_DELAYS = (0.0, 0.05, 0.1, 0.15, 0.2)
#: The fine search starts from the best of the coarse one at so many rates.
_STARTS = 2
#: It ends after so many steps, or when one gains less in log-likelihood.
_STEPS, _GAIN = 40, 0.05
#: Derivatives are differences over this share of each prior's width; no step is longer than this.
_DIFFERENCE, _LONGEST = 1e-4, 2.0
#: How much steps are damped, at first, at least and at most, and by which factors that changes.
_DAMPING, _FREEST, _STIFFEST, _LESS, _MORE = 1e-2, 1e-6, 1e4, 0.2, 4.0
#: What is searched for: the logarithm of lag and delay together (which alone say how far the robot
#: gets), of slowing, of braking over slowing, and of the rate; stick (s), the static curve, and the
#: delay (s). What is usual, how far from it, and limits.
_TOTAL, _SLOWING, _BRAKING, _RATE, _STICK, _CURVE, _DELAY = *range(6), 5 + CURVES
_USUAL = (math.log(0.1), 0.0, 0.0, math.log(20.0), 0.0, *[0.0] * CURVES, 0.0)
_WIDTH = (1.0, 0.5, 0.5, 1.5, 0.02, *[0.15] * 3, *[0.1] * 3, 0.08)
_SHORTEST = 0.003
_LOWEST = (
    math.log(_SHORTEST),
    math.log(0.2),
    math.log(0.2),
    math.log(0.3),
    0.0,
    *[-5.0] * CURVES,
    0.0,
)
_HIGHEST = (math.log(2.0), math.log(5.0), math.log(5.0), math.log(50.0), 0.2, *[5.0] * CURVES, 0.5)
#: Products count, before rows say more, for no more than this share of what is to be explained.
_PRODUCTS = 0.05
#: Degrees of freedom of errors, and where Huber's loss begins to be linear.
FREEDOM, _HUBER = 2.0, 1.345
_REGRESSIONS = 8
#: Laws of actuators that reach their speeds at once.
_AT_ONCE = torch.tensor(_USUAL, dtype=torch.float64).unsqueeze(1)
_AT_ONCE[_TOTAL], _AT_ONCE[_RATE] = _LOWEST[_TOTAL], _HIGHEST[_RATE]


@dataclass(frozen=True)
class Motion:
    """Rows as the drive model takes them.

    Attributes:
        x: scaled inputs before the static curve, dead zones applied, [N, I].
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

    #: A delay is nearly a lag where only the ends of commands are known.
    belief: ClassVar[float] = 10.0

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

    def fitted(self, drive: DriveModel) -> tuple[DriveModel, list[Errors]]:
        """Return a drive model with the best kinematics, and the errors that it leaves."""
        return _fitted(drive, self)


class Errors(NamedTuple):
    """Errors of one kind.

    Attributes:
        error: [N].
        size: what they are like, robustly.
        weight: what each counts.
    """

    error: Tensor
    size: Tensor
    weight: float = 1.0

    @property
    def cost(self) -> float:
        """Minus the log-likelihood."""
        each = (self.error / self.size).square() / FREEDOM
        cost = (FREEDOM + 1.0) / 2.0 * each.log1p().sum() + len(self.error) * self.size.log()
        return self.weight * cost.item()


class Rows(Protocol):
    """What a drive model is fitted to.

    Attributes:
        columns: of the inputs.
        belief: by how much a delay must raise the log-likelihood.
    """

    belief: ClassVar[float]

    @property
    def columns(self) -> CommandFeatures: ...

    def first(self, rows: int) -> Rows:
        """Return the first rows."""
        ...

    def fitted(self, drive: DriveModel) -> tuple[DriveModel, list[Errors]]:
        """Return a drive model with the best kinematics, and the errors that it leaves."""
        ...


def fit_drive(motion: Rows, laws: bool = True) -> DriveModel:
    """Return the drive model of rows.

    Args:
        motion: rows.
        laws: whether to look for the actuators' laws; if not, speeds are reached at once.
    """
    count = len(motion.columns.driven)
    if not laws:
        return motion.fitted(_model(_AT_ONCE.repeat(1, count)))[0]
    searched = motion.first(_ROWS)
    lowest, usual, highest = (
        torch.tensor(values, dtype=torch.float64).unsqueeze(1).repeat(1, count)
        for values in (_LOWEST, _USUAL, _HIGHEST)
    )

    def errors(laws: Tensor) -> list[Errors]:
        return searched.fitted(_model(laws))[1]

    coarse: list[tuple[float, float, float, Tensor]] = []
    for lag, rate, delay in product(_LAGS, _RATES, _DELAYS):
        start = usual.clone()
        start[_TOTAL], start[_RATE], start[_DELAY] = math.log(lag + delay), math.log(rate), delay
        start = torch.maximum(torch.minimum(start, highest), lowest)
        coarse.append((_cost(start, errors(start)), rate, delay, start))
    coarse.sort(key=lambda one: one[0])

    def best_of(starts: list[Tensor], longest_delay: float) -> tuple[Tensor, float]:
        limit = highest.clone()
        limit[_DELAY] = longest_delay
        found = [_refined(errors, start, lowest, limit) for start in starts]
        return min(found, key=lambda one: one[1])

    def starts(longest_delay: float) -> list[Tensor]:
        # Of each rate the best, as no step leads from a rate that never limits to one that does.
        of_rates: dict[float, Tensor] = {}
        for _, rate, delay, start in coarse:
            if delay <= longest_delay:
                of_rates.setdefault(rate, start)
        return list(of_rates.values())[:_STARTS]

    found, least = best_of(starts(_HIGHEST[_DELAY]), _HIGHEST[_DELAY])
    if found[_DELAY, 0] > 0.0:
        at_once, cost = best_of([*starts(0.0), found], 0.0)
        if cost < least + motion.belief:
            found = at_once
    return motion.fitted(_model(found))[0]


def _refined(
    errors: Callable[[Tensor], list[Errors]], laws: Tensor, lowest: Tensor, highest: Tensor
) -> tuple[Tensor, float]:
    """Return the best laws near others, and their cost, by Levenberg's and Marquardt's method.

    Args:
        errors: of laws [L, C].
        laws: to begin at.
        lowest: that each may be, [L, C].
        highest: that each may be, [L, C].
    """
    laws = torch.minimum(laws, highest)
    width = torch.tensor(_WIDTH, dtype=torch.float64).unsqueeze(1).expand_as(laws)
    varied = highest > lowest
    varied[_DELAY, 1:] = False  # a delay is one for all: the first column's
    places = torch.nonzero(varied)
    now = errors(laws)
    cost, damping = _cost(laws, now), _DAMPING
    for _ in range(_STEPS):
        size = torch.cat([one.size.expand_as(one.error) for one in now])
        weight = torch.cat([torch.full_like(one.error, one.weight) for one in now])
        error = torch.cat([one.error for one in now])
        # Weights of iteratively reweighted least squares for Student's t.
        weight = weight * (FREEDOM + 1.0) / (FREEDOM + (error / size).square())
        slopes, unit = [], width[varied]
        for place in places:
            at, moved = tuple(place), laws.clone()
            share = _DIFFERENCE
            if laws[at] + share * width[at] > highest[at]:
                share = -share
            moved[at] += share * width[at]
            change = torch.cat([one.error for one in errors(moved)]) - error
            slopes.append(change / size / share)
        slope = torch.stack(slopes, dim=1)  # of each error, by each law in units of its prior
        off, counts = _off(laws)
        gradient = slope.T @ (weight * error / size) + off[varied]
        curvature = slope.T @ (weight.unsqueeze(1) * slope) + torch.diag(counts[varied])
        # What stands at a limit and would go beyond stays there.
        here, low, high = laws[varied], lowest[varied], highest[varied]
        free = ~(((here <= low) & (gradient > 0.0)) | ((here >= high) & (gradient < 0.0)))
        before = cost
        while damping < _STIFFEST and cost == before:
            damped = curvature + damping * torch.diag(curvature.diagonal() + 1.0)
            step = torch.zeros_like(gradient)
            step[free] = -torch.linalg.solve(damped[free][:, free], gradient[free])
            tried = laws.clone()
            tried[varied] = here + unit * step.clamp(-_LONGEST, _LONGEST)
            tried = torch.maximum(torch.minimum(tried, highest), lowest)
            found = errors(tried)
            reached = _cost(tried, found)
            if reached < cost:
                laws, now, cost = tried, found, reached
                damping = max(_LESS * damping, _FREEST)
            else:
                damping *= _MORE
        if before - cost < _GAIN:
            break
    return laws, cost


def _cost(laws: Tensor, errors: list[Errors]) -> float:
    """Return minus the logarithm of laws' probability after errors."""
    off, _ = _off(laws)
    return sum(one.cost for one in errors) + 0.5 * off.square().sum().item()


def _off(laws: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far laws [L, C] are off the usual, in widths of the prior, and where it counts."""
    usual, width = (torch.tensor(v, dtype=torch.float64).unsqueeze(1) for v in (_USUAL, _WIDTH))
    counts = torch.ones_like(laws)
    counts[_DELAY, 1:] = 0.0
    counts[_RATE] = (laws[_RATE] < _USUAL[_RATE]).to(laws)  # above the usual it is no limit
    return (laws - usual) / width * counts, counts


def _model(laws: Tensor) -> DriveModel:
    total, slowing, braking, rate = laws[: _RATE + 1].exp()
    delay = laws[_DELAY, :1]
    lag = (total - delay).clamp(min=_SHORTEST)
    shape = DriveModel.shapes(len(lag))["kinematics"]
    parts = lag, slowing, slowing * braking, rate, laws[_STICK], laws[_CURVE:_DELAY].T, delay
    return DriveModel(*parts, torch.zeros(shape))


def _fitted(drive: DriveModel, motion: Motion) -> tuple[DriveModel, list[Errors]]:
    """Return a drive model with the best kinematics, and the errors that it leaves."""
    x, turn = motion.inputs(drive), motion.y[:, 2]
    columns = motion.columns
    under, told = rows_underway(drive, columns, x), x[:, list(columns.driven)]
    pieces = drive.pieces(under, told, x[:, columns.duration] * motion.longest)
    linear = len(columns.driven)
    rate, turns_left = _regression(sum(pieces[1:], pieces[0]), turn, linear)
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
    speeds, shifts_left = _regression(
        torch.cat([columns_x, columns_y]), torch.cat([moved[:, 0], moved[:, 1]]), linear
    )
    kinematics = torch.stack([*speeds.view(2, -1), rate], dim=1)
    laws = (getattr(drive, name) for name in DriveModel.NAMES[:-1])
    drive = DriveModel(*laws, kinematics)
    return drive, [turns_left, shifts_left, *_errors_within(drive, motion, under, told)]


def _errors_within(
    drive: DriveModel, motion: Motion, under: Underway, told: Tensor
) -> list[Errors]:
    """Return the errors of poses within commands.

    They are from the same commands as the rows, which they are not to outweigh: they count as many
    as there are rows, at most.
    """
    within = motion.within
    if within is None or len(within.row) == 0:
        return []
    row = within.row
    under = Underway(*(part[row] for part in under))
    changing, twist = drive.phases(under, told[row], within.time.to(told))
    error = se2.compose(changing, se2.exp(twist)) - within.moved.to(told)
    # What is short is measured by what is short.
    size = (1.4826 * error.abs().median(0).values).clamp(min=1e-6)
    weight = min(len(motion.x) / len(row), 1.0)
    return [Errors(error[:, k], size[k], weight) for k in range(error.shape[1])]


def _regression(features: Tensor, target: Tensor, linear: int) -> tuple[Tensor, Errors]:
    """Return the weights of a regression with Huber's loss, and the errors that they leave.

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
    return weights, Errors(features @ weights - target, size)
