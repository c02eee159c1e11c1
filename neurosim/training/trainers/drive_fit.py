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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
#: Of other weights or dead bands it begins near, and takes no more steps than this.
_AGAIN = 3
#: The widest dead band, as a fraction of the largest command, and how many sizes are tried at once.
_WIDEST, _TRIED = 0.5, 24
#: A dead band must raise the log-likelihood by this much to be believed.
_BELIEVED = 3.0
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
        x: scaled inputs before the static curve, [N, I].
        y: displacements, [N, 3].
        follows: whether a row's command followed that of the row before, [N].
        columns: of the inputs.
        longest: what durations are scaled by, s.
        within: poses within the commands, where they are known.
        weight: what each row counts, [N]; None: all alike.
        band: dead bands of the actuators, scaled, [C]; None: they have none.
    """

    x: Tensor
    y: Tensor
    follows: Tensor
    columns: CommandFeatures
    longest: float
    within: Within | None = None
    weight: Tensor | None = None
    band: Tensor | None = None

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
        weight = None if self.weight is None else self.weight[:rows]
        return Motion(*parts, self.columns, self.longest, within, weight, self.band)

    def weighted(self, weight: Tensor) -> Motion:
        """Return the rows with other weights [N]."""
        return replace(self, weight=weight)

    def banded(self, band: Tensor) -> Motion:
        """Return the rows with other dead bands [C]."""
        return replace(self, band=band)

    @property
    def commanded(self) -> Tensor:
        """What commands ask for, scaled, [N, C]."""
        return self.x[:, list(self.columns.driven)]

    def inputs(self, drive: DriveModel) -> Tensor:
        """Return the inputs that a drive model makes of the rows, see :func:`chain`."""
        x = self.x.clone()
        for places in (self.columns.driven, self.columns.before):
            x[:, list(places)] = drive.shaped(outside(x[:, list(places)], self.band))
        return chain(drive, self.columns, x, self.follows, self.longest)

    def fitted(self, drive: DriveModel) -> tuple[DriveModel, list[Errors]]:
        """Return a drive model with the best kinematics, and the errors that it leaves."""
        return _fitted(drive, self)


class Errors(NamedTuple):
    """Errors of one kind.

    Attributes:
        error: [N].
        size: what they are like, robustly.
        weight: what each counts, [N] or [].
    """

    error: Tensor
    size: Tensor
    weight: Tensor

    @property
    def cost(self) -> float:
        """Minus the log-likelihood."""
        each = (self.error / self.size).square() / FREEDOM
        cost = (FREEDOM + 1.0) / 2.0 * each.log1p() + self.size.log()
        return (self.weight * cost).sum().item()


class Rows(Protocol):
    """What a drive model is fitted to.

    Attributes:
        columns: of the inputs.
        belief: by how much a delay must raise the log-likelihood.
        band: dead bands of the actuators, scaled, [C].
    """

    belief: ClassVar[float]

    @property
    def columns(self) -> CommandFeatures: ...

    @property
    def band(self) -> Tensor | None: ...

    def first(self, rows: int) -> Rows:
        """Return the first rows."""
        ...

    def weighted(self, weight: Tensor) -> Rows:
        """Return the rows with other weights [N]."""
        ...

    def banded(self, band: Tensor) -> Rows:
        """Return the rows with other dead bands [C]."""
        ...

    @property
    def commanded(self) -> Tensor:
        """What commands ask for, scaled, [N, C]."""
        ...

    def fitted(self, drive: DriveModel) -> tuple[DriveModel, list[Errors]]:
        """Return a drive model with the best kinematics, and the errors that it leaves."""
        ...


class Fit(NamedTuple):
    """A drive model of rows.

    Attributes:
        drive: the model.
        rows: these, with the dead bands that were found.
        laws: as they are searched for, [L, C]; None if they were not.
    """

    drive: DriveModel
    rows: Rows
    laws: Tensor | None


def fit_drive(motion: Rows, laws: bool = True, band: Tensor | None = None) -> Fit:
    """Return the drive model of rows.

    Args:
        motion: rows.
        laws: whether to look for the actuators' laws; if not, speeds are reached at once.
        band: dead bands, scaled, [C]; found from the rows if not given.
    """
    count = len(motion.columns.driven)
    motion = motion.banded(torch.zeros(count, dtype=torch.float64) if band is None else band)
    if not laws:
        at_once = _AT_ONCE.repeat(1, count)
        motion = motion if band is not None else motion.banded(_dead_bands(motion, at_once))
        return Fit(motion.fitted(_model(at_once))[0], motion, None)
    lowest, highest = (_of_each(values, count) for values in (_LOWEST, _HIGHEST))
    if band is None:
        motion = motion.banded(_dead_bands(motion, _roughly(motion, lowest, highest)))
    found = _searched(motion, lowest, highest)
    if band is None:
        # With the laws known better, slow commands say more.
        again = motion.banded(_dead_bands(motion, found))
        if not torch.equal(again.band, motion.band):
            motion = again
            found = _again(motion.first(_ROWS), found, lowest, highest)
    return Fit(motion.fitted(_model(found))[0], motion, found)


def _roughly(motion: Rows, lowest: Tensor, highest: Tensor) -> Tensor:
    """Return laws [L, C] that dead bands can be told by.

    They are without static friction, which could stand for a dead band.
    """
    highest = highest.clone()
    highest[_STICK] = 0.0
    searched = motion.first(_ROWS)
    starts = [_start(lag, _RATES[-1], delay, lowest) for lag, delay in product(_LAGS, _DELAYS)]
    best = min(starts, key=lambda one: _cost(one, searched.fitted(_model(one))[1]))
    return _again(searched, best, lowest, highest)


def _start(lag: float, rate: float, delay: float, lowest: Tensor) -> Tensor:
    """Return laws [L, C], of all actuators alike, where a search begins."""
    start = _of_each(_USUAL, lowest.shape[1])
    start[_TOTAL], start[_RATE], start[_DELAY] = math.log(lag + delay), math.log(rate), delay
    return torch.maximum(start, lowest)


def _dead_bands(motion: Rows, laws: Tensor) -> Tensor:
    """Return the dead bands [C] that rows are best explained by, given the laws.

    Only an actuator that is driven both ways can have one. It lies half way between two magnitudes
    that were commanded. First one band for all is sought, because where two wheels creep neither
    can be judged while the other is thought to move; then each for itself.
    """
    searched, model = motion.first(_ROWS), _model(laws)
    told, band = searched.commanded, torch.zeros(laws.shape[1], dtype=torch.float64)
    ways = (told.amin(0) < 0.0) & (told.amax(0) > 0.0)
    each = [torch.arange(len(band)) == c for c in torch.nonzero(ways).flatten()]
    for group in (ways, *each * 2) if len(each) > 1 else each:
        given = told[:, group].abs().unique()
        given = given[(given > 0.0) & (given <= _WIDEST)]
        costs: dict[float, float] = {}

        def cost(
            size: float,
            group: Tensor = group,
            costs: dict[float, float] = costs,
            others: Tensor = band,
        ) -> float:
            if size not in costs:
                rows = searched.banded(torch.where(group, size, others))
                costs[size] = sum(one.cost for one in rows.fitted(model)[1])
            return costs[size]

        sizes = [0.0, *((given[1:] + given[:-1]) / 2.0).tolist()]
        low, high, best = 0, len(sizes), 0.0
        while True:
            stride = -(-(high - low) // _TRIED)
            best = min((0.0, *sizes[low:high:stride]), key=cost)
            if stride == 1:
                break
            place = sizes.index(best)
            low, high = max(place - stride, 0), min(place + stride + 1, len(sizes))
        band = torch.where(group, best if cost(0.0) - cost(best) > _BELIEVED else 0.0, band)
    return band


def _searched(motion: Rows, lowest: Tensor, highest: Tensor) -> Tensor:
    """Return the laws [L, C] that rows are best explained by, within limits.

    Args:
        motion: rows.
        lowest: that each law may be, [L, C].
        highest: that each law may be, [L, C].
    """
    searched = motion.first(_ROWS)

    def errors(laws: Tensor) -> list[Errors]:
        return searched.fitted(_model(laws))[1]

    coarse: list[tuple[float, float, float, Tensor]] = []
    for lag, rate, delay in product(_LAGS, _RATES, _DELAYS):
        start = _start(lag, rate, delay, lowest)
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
        at_once, cost = best_of([*starts(0.0)[:1], found], 0.0)
        if cost < least + motion.belief:
            found = at_once
    return found


def fit_drives(fit: Fit, weights: Tensor) -> list[DriveModel]:
    """Return the drive models of the same rows with other weights.

    Args:
        fit: of the rows: where the search begins.
        weights: of the rows, [M, N].
    """
    count = len(fit.drive.lag)
    lowest, highest = _of_each(_LOWEST, count), _of_each(_HIGHEST, count)
    found = []
    for rows in map(fit.rows.weighted, weights):
        drive = fit.drive
        if fit.laws is not None:
            drive = _model(_again(rows.first(_ROWS), fit.laws, lowest, highest))
        found.append(rows.fitted(drive)[0])
    return found


def _again(searched: Rows, laws: Tensor, lowest: Tensor, highest: Tensor) -> Tensor:
    """Return the laws [L, C] of rows that differ a little from those of which others are."""
    if laws[_DELAY, 0] == 0.0:
        highest = highest.clone()
        highest[_DELAY] = 0.0
    found, _ = _refined(lambda one: searched.fitted(_model(one))[1], laws, lowest, highest, _AGAIN)
    return found


def outside(command: Tensor, band: Tensor | None) -> Tensor:
    """Return commands [N, C], zero within the dead band [C]."""
    return command if band is None else torch.where(command.abs() < band, 0.0, command)


def _of_each(values: Sequence[float], count: int) -> Tensor:
    """Return values [L] for each of so many actuators, [L, C]."""
    return torch.tensor(values, dtype=torch.float64).unsqueeze(1).repeat(1, count)


def _refined(
    errors: Callable[[Tensor], list[Errors]],
    laws: Tensor,
    lowest: Tensor,
    highest: Tensor,
    steps: int = _STEPS,
) -> tuple[Tensor, float]:
    """Return the best laws near others, and their cost, by Levenberg's and Marquardt's method.

    Args:
        errors: of laws [L, C].
        laws: to begin at.
        lowest: that each may be, [L, C].
        highest: that each may be, [L, C].
        steps: at most.
    """
    laws = torch.minimum(laws, highest)
    width = torch.tensor(_WIDTH, dtype=torch.float64).unsqueeze(1).expand_as(laws)
    varied = highest > lowest
    varied[_DELAY, 1:] = False  # a delay is one for all: the first column's
    places = torch.nonzero(varied)
    now = errors(laws)
    cost, damping = _cost(laws, now), _DAMPING
    for _ in range(steps):
        size = torch.cat([one.size.expand_as(one.error) for one in now])
        weight = torch.cat([one.weight.expand_as(one.error) for one in now])
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
    weight = torch.ones_like(turn) if motion.weight is None else motion.weight
    rate, turns_left = _regression(sum(pieces[1:], pieces[0]), turn, linear, weight)
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
        torch.cat([columns_x, columns_y]),
        torch.cat([moved[:, 0], moved[:, 1]]),
        linear,
        torch.cat([weight, weight]),
    )
    kinematics = torch.stack([*speeds.view(2, -1), rate], dim=1)
    laws = (getattr(drive, name) for name in DriveModel.NAMES[:-1])
    drive = DriveModel(*laws, kinematics)
    return drive, [turns_left, shifts_left, *_errors_within(drive, motion, under, told, weight)]


def _errors_within(
    drive: DriveModel, motion: Motion, under: Underway, told: Tensor, weight: Tensor
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
    weight = weight[row] * min(len(motion.x) / len(row), 1.0)
    return [Errors(error[:, k], size[k], weight) for k in range(error.shape[1])]


def _regression(
    features: Tensor, target: Tensor, linear: int, weight: Tensor
) -> tuple[Tensor, Errors]:
    """Return the weights of a regression with Huber's loss, and the errors that they leave.

    Args:
        features: [N, k F]: k times linear features and products.
        target: [N].
        linear: how many of F are linear.
        weight: what each row counts, [N].
    """
    width = linear + linear * (linear + 1) // 2
    product = torch.arange(features.shape[1]) % width >= linear
    shares, size = weight, target.square().mean().sqrt().clamp(min=1e-9)
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
        shares = weight * (_HUBER * size / error.clamp(min=1e-12)).clamp(max=1.0)
        pull = product * (size / usual).square()
    return weights, Errors(features @ weights - target, size, weight)
