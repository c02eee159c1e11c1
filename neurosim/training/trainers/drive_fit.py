"""The search for the drive model that fits rows best.

With given laws of the actuators, the displacement is linear in the kinematics: first the turn, then
the translation with the measured turn. The laws are a few numbers for each actuator. The method of
Levenberg (1944) and Marquardt (1963) searches them, and the kinematics are fitted again at each
step (Golub and Pereyra 1973). Errors are assumed to have Student's t distribution (Lange, Little
and Taylor 1989), because a drive model has large ones. Parameters that rows hardly determine stay
near usual values: a weak prior on every law, and on the products in the kinematics or, of a car, on
all terms of the turn but these.

Many laws are compared at a time: P of them are a tensor [P, L, C], with errors [P, N]. Distances
are computed by the compiled functions of simulators.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.compiled import njit
from neurosim.base.kernels import kernel, smallest
from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.drive import (
    CURVES,
    LONG_WAIT,
    PHASES,
    SHORTEST,
    DriveModel,
    features_of,
    terms_of,
)
from neurosim.simulators.motion.kernels import _LAW, _come, _follow, _law, drifted, goal_of
from neurosim.simulators.motion.network import chain
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import Within
from neurosim.training.error_size import relative_size

#: Number of rows for the search of the laws, and of each of the stretches that they are from.
_ROWS, _STRETCH = 600, 100
#: The coarse search: laws shared by all actuators.
_LAGS = (0.005, 0.03, 0.06, 0.1, 0.15, 0.25, 0.4, 0.8, 1.6)
_RATES = (0.5, 1.0, 2.0, 4.0, 20.0)
_DELAYS = (0.0, 0.05, 0.1, 0.15, 0.2)
#: Number of rates at which the fine search starts from the best of the coarse one.
_STARTS = 2
#: Largest number of its steps, and gain in log-likelihood at which it ends.
_STEPS, _GAIN = 40, 0.05
#: Largest number of steps with other dead bands, from a near start.
_AGAIN = 3
#: Widest dead band, as a fraction of the largest command, and number of sizes tried at once.
_WIDEST, _TRIED = 0.5, 24
#: Number of models that are computed together.
_TOGETHER = 32
#: Gain in log-likelihood for accepting a dead band.
_BELIEVED = 3.0
#: Factor of the gain for accepting losses in curves over that for a delay.
_LOST = 1.5
#: Gain in log-likelihood for laws of the body's modes, and for a lag of sideways motion. Modes are
#: not tried if each is one actuator, to this fraction, or if their condition number is larger;
#: sideways motion is one if an actuator moves the robot so far aside, as a fraction of forward.
_INERT, _ALIKE, _WORST, _ASIDE = 10.0, 0.9, 5.0, 0.2
#: Gain in log-likelihood for the prior of a car.
_STEERED = 1.0
#: Width of the prior of a straight static curve, as a fraction of the usual one, and the gain in
#: the logarithm of the evidence for it.
_STRAIGHT, _EVIDENT = 0.1, 5.0
#: Derivatives are differences over this fraction of a prior's width; steps are at most this long.
_DIFFERENCE, _LONGEST = 1e-4, 2.0
#: Damping of steps: first, smallest and largest value, and the factors of its change.
_DAMPING, _FREEST, _STIFFEST, _LESS, _MORE = 1e-2, 1e-6, 1e4, 0.2, 4.0
#: The searched parameters: logarithms of the sum of lag and delay (which alone determines the
#: distance), of slowing, of braking over slowing, and of the rate; stick (s), the static curve, the
#: delay (s), and the quadratic drag. Usual values, their spread, and limits.
_TOTAL, _SLOWING, _BRAKING, _RATE, _STICK, _CURVE, _DELAY, _DRAG = *range(6), 5 + CURVES, 6 + CURVES
_USUAL = (math.log(0.1), 0.0, 0.0, math.log(20.0), 0.0, *[0.0] * CURVES, 0.0, 0.0)
_WIDTH = (1.0, 0.5, 0.5, 1.5, 0.02, *[0.15] * 3, *[0.1] * 3, 0.08, 1.0)
_SHORTEST = 0.003
_LOWEST = (
    math.log(_SHORTEST),
    math.log(0.2),
    math.log(0.2),
    math.log(0.3),
    0.0,
    *[-5.0] * CURVES,
    0.0,
    0.0,
)
_FASTEST = math.log(60.0), math.log(5.0), math.log(5.0), math.log(50.0)
_HIGHEST = (*_FASTEST, 0.2, *[5.0] * CURVES, 0.5, 10.0)
#: Lags of velocity by products and losses that are tried, s.
_DRIFTS = (0.1, 0.14, 0.2, 0.28, 0.4, 0.57, 0.8, 1.1, 1.6, 2.3, 3.2)
#: First quadratic drag of a search, and the shortest lag (s) of a law that may have it.
_FIRST_DRAG, _SLUGGISH = 0.5, 0.3
#: Smallest number of rows for quadratic drag, for learning how the size of errors depends on the
#: commands, and for members' laws that are searched to the end.
_SIZED = 100
#: Prior part of products in the target, as a fraction, and by how much it is less for those that a
#: symmetric body cannot have.
_PRODUCTS, _SYMMETRIC = 0.05, 20.0
#: Degrees of freedom of errors, and error from which Huber's loss is linear.
FREEDOM, _HUBER = 2.0, 1.345
#: Number of steps of iteratively reweighted least squares.
REGRESSIONS = 8
#: Laws of actuators that reach their speeds at once.
_AT_ONCE = torch.tensor(_USUAL, dtype=torch.float64).unsqueeze(1)
_AT_ONCE[_TOTAL], _AT_ONCE[_RATE] = _LOWEST[_TOTAL], _HIGHEST[_RATE]


#: Number of pieces of constant twist of a command: while the previous one acts, and its own.
_PIECES = PHASES + PHASES + 1


class Actuators(NamedTuple):
    """The actuators of P drive models, [P, C], or of one, [C], for compiled functions."""

    driven: NDArray  #: [C] their numbers
    input_scale: NDArray  #: [C] ones, as commands are scaled
    dead_band: NDArray  #: dead bands
    lag: NDArray  #: this and the next seven as in DriveModel
    slowing: NDArray
    braking: NDArray
    rate: NDArray
    stick: NDArray
    curve: NDArray
    delay: NDArray
    drag: NDArray

    @classmethod
    def of(cls, laws: Tensor, band: Tensor) -> Actuators:
        """Return the actuators for laws [P, L, C] with dead bands [C] or [P, C]."""
        total, slowing, braking, rate = laws[:, : _RATE + 1].exp().unbind(1)
        delay, stick, drag = laws[:, _DELAY, :1], laws[:, _STICK], laws[:, _DRAG]
        lag = (total - delay).clamp(min=_SHORTEST)
        curve = laws[:, _CURVE:_DELAY].mT
        parts = band.expand_as(lag), lag, slowing, slowing * braking, rate, stick, curve, delay
        count = lag.shape[1]
        return cls(
            np.arange(count),
            np.ones(count),
            *(part.contiguous().numpy() for part in (*parts, drag)),
        )

    def turning(self, given: Tensor | None) -> NDArray:
        """Return the actuators' combination for the rate of turn, [C]; zeros by default."""
        return np.zeros(len(self.driven)) if given is None else given.numpy()

    def modes(self, given: Tensor | None) -> NDArray:
        """Return the goals of laws by those of actuators, [C, C]; equal by default."""
        return np.eye(len(self.driven)) if given is None else given.numpy()

    def one(self, number: int) -> Actuators:
        """Return the actuators of one of the models."""
        return Actuators(self.driven, self.input_scale, *(part[number] for part in self[2:]))


class Distances(NamedTuple):
    """Features of the twists of pieces of P models' commands, see :meth:`DriveModel.pieces`.

    Attributes:
        rows: of whole rows, [P, pieces, K, N].
        within: until the poses within them, [P, pieces, K, L].
        late: the same with a drift, ahead and aside, [P, 2, pieces, K, N]; see :func:`follow_late`.
        late_within: the same until the poses within them.
    """

    rows: Tensor
    within: Tensor
    late: Tensor
    late_within: Tensor


@njit(error_model="numpy")
def _distances(a, turning, modes, drift, before, commanded, time, follows, row, until, features):
    """Write the features of the twists of pieces of commands, see :class:`Distances`.

    Args:
        a: :class:`Actuators` of one model.
        turning: as in DriveModel, [C].
        modes: as in DriveModel, [C, C].
        drift: as in DriveModel, [2] s.
        before: the previous command of each, [N, C].
        commanded: the commands, [N, C].
        time: durations, [N] s.
        follows: whether a row's command followed that of the previous row, [N].
        row: row of each instant within a command, [L], ascending.
        until: time of each instant since the row began, [L] s.
        features: :class:`Distances` of one model, zeros, written; late ones if there is a drift.
    """
    count, terms = commanded.shape[1], features.rows.shape[1]
    rate, late = np.zeros((2, terms)), np.zeros((2, _PIECES, terms))
    pieces, lasts, drifts = np.zeros((_PIECES, terms)), np.zeros(_PIECES), drift.max() > 0.0
    law, distance = np.empty((count, _LAW)), np.empty(count)
    begins, reached, goals = np.empty(count), np.zeros(2 * count), np.empty((2, count))
    k = 0
    for i in range(len(commanded)):
        for c in range(count):
            goals[0, c] = goal_of(a, modes, before[i], c)
            goals[1, c] = goal_of(a, modes, commanded[i], c)
            begins[c] = reached[c] if follows[i] else goals[0, c]
        if not follows[i] and drifts:
            rate[0, :count] = goals[0]
            products_and_losses(turning, 1.0, count, rate[0])
            rate[1] = rate[0]
        while k < len(row) and row[k] == i:
            _cut(a, turning, begins, goals, until[k], law, distance, reached, pieces, lasts)
            features.within[:, :, k] = pieces
            if drifts:
                then = rate.copy()
                _follow_both(drift, count, pieces, lasts, then, late)
                features.late_within[:, :, :, k] = late
            k += 1
        _cut(a, turning, begins, goals, time[i], law, distance, reached, pieces, lasts)
        features.rows[:, :, i] = pieces
        if drifts:
            _follow_both(drift, count, pieces, lasts, rate, late)
            features.late[:, :, :, i] = late


@kernel()
def _follow_both(drift, count, pieces, lasts, rate, late):
    """Let features follow with the lags ahead and aside [2], piece after piece; for each lag,
    :func:`follow_late`.
    """
    for d in range(2):
        for n in range(_PIECES):
            follow_late(drift[d], count, pieces[n], lasts[n], rate[d], late[d, n])


@kernel()
def follow_late(lag, count, features, lasts, rate, late):
    """Let the products and losses among the features [K] of a piece follow with a lag.

    Motion is linear in the twist's coefficients; so each feature can follow by itself.

    Args:
        lag: s.
        count: C, number of actuators; the features that follow are those after their distances.
        features: see :func:`motion_features`.
        lasts: its duration, s.
        rate: rates of change of the late features, [K] 1/s, changed to those at the end.
        late: [K], written.
    """
    for f in range(len(rate)):
        late[f], rate[f] = drifted(lag if f >= count else 0.0, rate[f], features[f], lasts)


@njit(error_model="numpy")
def _cut(a, turning, begins, goals, time, law, distance, reached, features, lasts):
    """Cut a command into pieces of constant twist.

    Args:
        a: :class:`Actuators` of one model.
        turning: as in DriveModel, [C].
        begins: speeds, [C].
        goals: goals that act before and after the delay, [2, C].
        time: its duration, s.
        law: [C, _LAW] scratch.
        distance: [C] scratch.
        reached: [2 C], written: speeds and pushes at the end.
        features: [_PIECES, K], written, see :func:`motion_features`.
        lasts: [_PIECES], written: durations of the pieces, s.
    """
    count, begin = len(begins), 0.0
    features[:], lasts[:] = 0.0, 0.0
    for c in range(count):
        reached[c], reached[count + c] = begins[c], 0.0
    for own in range(2):
        ends = time if own else min(a.delay[0], time)
        span = ends - begin
        if span <= 0.0:
            continue
        begin, settling = ends, SHORTEST
        for c in range(count):
            _law(a, c, reached[c], goals[own, c], reached[count + c], law[c])
            settling = max(settling, law[c, 10])
            distance[c] = 0.0
        changing = min(span, settling) if own else span
        pieces = PHASES if own or span > LONG_WAIT else 1
        first = PHASES if own else PHASES - pieces
        last = 0.0
        for k in range(pieces + own):
            end = changing * (k + 1) / pieces if k < pieces else span
            for c in range(count):
                left, missed = _follow(law[c], end)
                gone = goals[own, c] * end - missed
                features[first + k, c], distance[c] = gone - distance[c], gone
                if end == span:
                    reached[c], reached[count + c] = _come(law[c], span, left)
            products_and_losses(turning, end - last, count, features[first + k])
            lasts[first + k], last = end - last, end


@kernel(forceinline=True)
def products_and_losses(turning, time, count, terms):
    """Write the features of a twist after the distances, see :func:`motion_features`.

    Args:
        turning: as in DriveModel, [C].
        time: duration of the distances, s.
        count: C.
        terms: [K], distances of actuators first; written from there on. Without the last C there
            are no losses.
    """
    place, turned, inverse = count, 0.0, 1.0 / max(time, 1e-9)
    for c in range(count):
        turned += terms[c] * turning[c]
        for d in range(c, count):
            terms[place] = terms[c] * terms[d] * inverse
            place += 1
    for c in range(len(terms) - place):
        terms[place + c] = terms[c] * abs(turned) * inverse


def stretches(rows: int, most: int) -> tuple[Tensor, Tensor]:
    """Return which rows are in stretches from all over a record, and where these begin, [N] bool.

    A record changes while it is made: the drive, the battery, the guide of a recording.

    Args:
        rows: N.
        most: largest number of rows in them; all rows, if there are not more.
    """
    kept, begins = torch.ones(rows, dtype=torch.bool), torch.zeros(rows, dtype=torch.bool)
    if rows > most:
        count = max(most // _STRETCH, 1)
        part = torch.arange(rows) * count // rows
        begins = part != torch.cat([torch.tensor([-1]), part[:-1]])
        number = torch.arange(rows)
        kept = number - torch.where(begins, number, 0).cummax(0).values < most // count
    return kept, begins


@dataclass(frozen=True)
class Motion:
    """Rows in the form for the drive model.

    Attributes:
        x: scaled inputs before the static curve, [N, I].
        y: displacements, [N, 3].
        follows: whether a row's command followed that of the previous row, [N].
        columns: of the inputs.
        longest: scale of durations, s.
        within: poses within the commands, if known, in the order of the rows.
        weight: weights of the rows, [N]; None: equal.
        turning: of the drive models that are fitted, [C]; None: nothing is lost in curves.
        modes: of the drive models that are fitted, [C, C]; None: the laws are of actuators.
        steered: whether the prior is that of a car, see :func:`terms_near_zero`.
        straight: whether the prior holds static curves nearly straight.
        symmetric: whether the prior is that of a body with two like sides.
        drift: that of the drive models that are fitted, s.
        precision: reciprocal of the relative size of the errors of turns and of translations, [2,
            N]; None: all are alike.
    """

    x: Tensor
    y: Tensor
    follows: Tensor
    columns: CommandFeatures
    longest: float
    within: Within | None = None
    weight: Tensor | None = None
    turning: Tensor | None = None
    modes: Tensor | None = None
    steered: bool = False
    straight: bool = False
    symmetric: bool = False
    drift: tuple[float, float] = (0.0, 0.0)
    precision: Tensor | None = None

    #: A delay is nearly a lag where only the ends of commands are known.
    belief: ClassVar[float] = 10.0

    def some(self, most: int) -> Motion:
        """Return stretches of the rows, ``most`` at most, and of the poses within them as many."""
        kept, begins = stretches(len(self.x), most)
        within = self.within
        if within is not None:
            known = torch.nonzero(kept[within.row]).squeeze(1)
            known = known[:: -(-len(known) // most) or 1]
            number = kept.cumsum(0) - 1
            within = Within(number[within.row[known]], within.time[known], within.moved[known])
        weight = None if self.weight is None else self.weight[kept]
        cut = {"x": self.x[kept], "y": self.y[kept], "follows": (self.follows & ~begins)[kept]}
        precision = None if self.precision is None else self.precision[:, kept]
        return replace(self, **cut, within=within, weight=weight, precision=precision)

    def weighted(self, weight: Tensor) -> Motion:
        """Return the rows with other weights [N]."""
        return replace(self, weight=weight)

    @property
    def commanded(self) -> Tensor:
        """The goals of commands, scaled, [N, C]."""
        return self.x[:, list(self.columns.driven)]

    def inputs(self, fit: Fit) -> Tensor:
        """Return a drive model's inputs of the rows, see :func:`chain`."""
        x = self.x.clone()
        for places in (self.columns.driven, self.columns.before):
            x[:, list(places)] = fit.drive.shaped(outside(x[:, list(places)], fit.band))
        return chain(fit.drive, self.columns, x, self.follows, self.longest)

    def distances(self, actuators: Actuators) -> Distances:
        """Return the features of the twists of pieces of each model's commands."""
        x, columns, within = self.x, self.columns, self.within
        if within is None:
            none = torch.zeros(0, dtype=x.dtype)
            within = Within(none.long(), none, none)
        terms = searched_terms(self)
        rows, parts = len(x), len(within.row)
        shapes = [(count, terms, _PIECES) for count in (rows, parts)]
        late = [(*shape, 2) for shape in shapes] if max(self.drift) > 0.0 else [(0,) * 4] * 2
        features = Distances(
            *(
                torch.zeros(len(actuators.lag), *reversed(shape), dtype=x.dtype)
                for shape in (*shapes, *late)
            )
        )
        given = x[:, list(columns.before)], x[:, list(columns.driven)]
        times = x[:, columns.duration] * self.longest, self.follows
        known = [part.numpy() for part in (*given, *times, within.row, within.time.to(x))]
        each = actuators.turning(self.turning), actuators.modes(self.modes), np.array(self.drift)
        for p, own in enumerate(zip(*(part.numpy() for part in features), strict=True)):
            _distances(actuators.one(p), *each, *known, Distances(*own))
        if max(self.drift) > 0.0:
            return features
        both = (part.unsqueeze(1).expand(-1, 2, -1, -1, -1) for part in features[:2])
        return Distances(*features[:2], *both)

    def fitted(self, actuators: Actuators) -> tuple[Tensor, list[Errors]]:
        """Return the best kinematics of each model, and their errors."""
        return _fitted(actuators, self)


class Errors(NamedTuple):
    """Errors of P models.

    Attributes:
        error: [P, N].
        size: robust size of the errors, [P, 1] or, of several kinds, [P, N].
        weight: weights of the errors, [N] or [].
    """

    error: Tensor
    size: Tensor
    weight: Tensor

    @property
    def cost(self) -> Tensor:
        """Minus the log-likelihood, [P]."""
        each = (self.error / self.size).square() / FREEDOM
        cost = (FREEDOM + 1.0) / 2.0 * each.log1p() + self.size.log()
        return (self.weight * cost).sum(1)


class Rows(Protocol):
    """The data to which a drive model is fitted.

    Attributes:
        columns: of the inputs.
        turning: of the drive models that are fitted, [C].
        modes: of the drive models that are fitted, [C, C].
        steered: whether the prior is that of a car.
        straight: whether the prior holds static curves nearly straight.
        symmetric: whether the prior is that of a body with two like sides.
        drift: that of the drive models that are fitted, s.
        belief: gain in log-likelihood for accepting a delay.
    """

    belief: ClassVar[float]

    @property
    def columns(self) -> CommandFeatures: ...

    @property
    def turning(self) -> Tensor | None: ...

    @property
    def modes(self) -> Tensor | None: ...

    @property
    def steered(self) -> bool: ...

    @property
    def straight(self) -> bool: ...

    @property
    def symmetric(self) -> bool: ...

    @property
    def drift(self) -> tuple[float, float]: ...

    def some(self, most: int) -> Rows:
        """Return stretches of the rows, about ``most`` rows or fewer."""
        ...

    def weighted(self, weight: Tensor) -> Rows:
        """Return the rows with other weights [N]."""
        ...

    @property
    def commanded(self) -> Tensor:
        """The goals of commands, scaled, [N, C]."""
        ...

    def fitted(self, actuators: Actuators) -> tuple[Tensor, list[Errors]]:
        """Return the best twists [P, K, 3] of each model, and their errors."""
        ...


class Fit(NamedTuple):
    """A drive model of rows.

    Attributes:
        drive: the model.
        rows: the rows.
        band: dead bands, scaled, [C].
        laws: in the form of the search, [L, C].
        searched: whether the laws were searched; if not, speeds are reached at once.
        actuators: of the model.
    """

    drive: DriveModel
    rows: Rows
    band: Tensor
    laws: Tensor
    searched: bool
    actuators: Actuators

    @classmethod
    def of(cls, rows: Rows, band: Tensor, laws: Tensor, searched: bool) -> Fit:
        """Return the fit of rows with given laws and dead bands."""
        actuators = Actuators.of(laws.unsqueeze(0), band)
        *parts, drag = (torch.from_numpy(part) for part in actuators.one(0)[3:])
        kinematics, twists = features_of(len(band)), rows.fitted(actuators)[0][0]
        losses = None if rows.turning is None else twists[kinematics:]
        drift = torch.tensor(rows.drift, dtype=torch.float64)
        body = rows.turning, losses, rows.modes, drag, drift
        drive = DriveModel(*parts, twists[:kinematics], *body)
        return cls(drive, rows, band, laws, searched, actuators)


def searched_terms(rows: Rows) -> int:
    """Return the number of terms in the twists of the rows' drive models."""
    return (features_of if rows.turning is None else terms_of)(len(rows.columns.driven))


def fit_drive(rows: Rows, band: Tensor | None = None, without: Collection[str] = ()) -> Fit:
    """Return the drive model of rows.

    A command of full speed leaves larger errors than a slow one, and counts less.

    Args:
        rows: the rows.
        band: dead bands, scaled, [C]; found from the rows if not given.
        without: what is left out, though it might fit the rows better: the actuators' ``laws``
            (speeds are reached at once), laws of the body's ``modes`` and their ``symmetry``, the
            prior of a ``car``, that of nearly ``straight`` static curves, and a ``drift``, a lag of
            products and losses.
    """
    fit = _fit_evenly(rows, band, without)
    if fit.searched and "drift" not in without:
        fit = _drifting(fit)
    if not (fit.searched and isinstance(fit.rows, Motion) and len(fit.rows.x) >= _SIZED):
        return fit
    turns, shifts = (one.error[0] for one in fit.rows.fitted(fit.actuators)[1][:2])
    left = torch.stack([turns, shifts.unflatten(0, (2, -1)).norm(dim=0)])
    sized = replace(fit.rows, precision=(-relative_size(fit.rows.x, left)).exp())
    limits = _of_each(_LOWEST, len(fit.band)), _of_each(_HIGHEST, len(fit.band))
    best = _again(sized.some(_ROWS), fit.band, fit.laws, *limits, _STEPS)
    return Fit.of(sized, fit.band, best, True)


def _drifting(fit: Fit) -> Fit:
    """Return the fit with the drift that fits the rows best, if one does."""
    searched, costs = fit.rows.some(_ROWS), dict[tuple[float, float], float]()
    best = none = 0.0, 0.0
    for part in ("both", "aside", "ahead"):
        for lag in (0.0, *_DRIFTS):
            drift = {"both": (lag, lag), "aside": (best[0], lag), "ahead": (lag, best[1])}[part]
            if drift not in costs:
                late = replace(searched, drift=drift)
                costs[drift] = float(_costs(late, fit.laws[None], fit.band))
        best = min(costs, key=costs.__getitem__)
    if costs[none] - costs[best] < _INERT:
        return fit
    searched, turning = replace(searched, drift=best), fit.rows.turning
    if turning is None:  # losses may be seen once they come late
        turning = _turning(searched, fit.laws, fit.band)
    searched = replace(searched, turning=turning)
    limits = _of_each(_LOWEST, len(fit.band)), _of_each(_HIGHEST, len(fit.band))
    laws = _again(searched, fit.band, fit.laws, *limits, _STEPS)
    return Fit.of(replace(fit.rows, drift=best, turning=turning), fit.band, laws, True)


def _fit_evenly(rows: Rows, band: Tensor | None, without: Collection[str]) -> Fit:
    """Return the drive model of rows whose errors all have one size; see :func:`fit_drive`."""
    count = len(rows.columns.driven)
    searched = rows.some(_ROWS)
    if "laws" in without:
        at_once = _AT_ONCE.repeat(1, count)
        return Fit.of(
            rows, _dead_bands(searched, at_once) if band is None else band, at_once, False
        )
    limits = _of_each(_LOWEST, count), _of_each(_HIGHEST, count)
    none = torch.zeros(count, dtype=torch.float64)
    roughly = _roughly(searched, *limits)
    if "car" not in without and count > 1:
        cars = replace(searched, steered=True)
        costs = [_costs(each, roughly[None], none) for each in (searched, cars)]
        if costs[0] - costs[1] > _STEERED:
            rows, searched = replace(rows, steered=True), cars
    straight = "straight" not in without
    fit, cost = _fully(rows, roughly, band, *limits, straight)
    twists, _ = searched.fitted(Actuators.of(roughly[None], none))
    # Of a car, only the products tell the turn: there are no modes in its linear terms.
    body = "modes" not in without and count > 1 and not rows.steered
    modes = body_modes(twists[0, :count].T) if body else None
    if modes is None:
        return fit
    of_body = {"modes": modes, "symmetric": "symmetry" not in without}
    of_modes = replace(searched, **of_body)
    slow = _roughly(of_modes, *limits)
    if _costs(searched, roughly[None], none) - _costs(of_modes, slow[None], none) < _INERT:
        return fit
    inert, less = _fully(replace(rows, **of_body), slow, band, *limits, straight)
    return inert if cost - less > _INERT else fit


def _fully(
    rows: Rows,
    laws: Tensor,
    band: Tensor | None,
    lowest: Tensor,
    highest: Tensor,
    straight: bool,
) -> tuple[Fit, float]:
    """Return the best drive model from approximate laws [L, C], and its cost."""
    searched = rows.some(_ROWS)
    turning = _turning(searched, laws, band)
    rows, searched = replace(rows, turning=turning), replace(searched, turning=turning)
    given, band = band, _dead_bands(searched, laws) if band is None else band
    best = _searched(searched, band, lowest, highest)
    # With better laws, slow commands tell more.
    again = band if given is not None else _dead_bands(searched, best)
    if not torch.equal(again, band):
        band, best = again, _again(searched, again, best, lowest, highest)
    if straight:
        nearly, laws = replace(searched, straight=True), best.clone()
        laws[_CURVE:_DELAY] *= _STRAIGHT
        laws = _again(nearly, band, laws, lowest, highest, _STEPS)
        pairs = (searched, best), (nearly, laws)
        curved, less = (_less_evident(each, band, own, lowest, highest) for each, own in pairs)
        if curved - less > _EVIDENT:
            rows, searched, best = replace(rows, straight=True), nearly, laws
    return Fit.of(rows, band, best, True), float(_costs(searched, best[None], band))


def _less_evident(rows: Rows, band: Tensor, laws: Tensor, lowest: Tensor, highest: Tensor) -> float:
    """Return minus the logarithm of the evidence for the rows' prior, but for a constant.

    By Laplace's approximation around the best laws [L, C] (MacKay 1992, section 3).
    """
    varied = _varied(laws, lowest, _kept(laws, highest))
    near = _near(rows, band, laws, varied, highest)
    curvature = near.slope.T @ (near.weight.unsqueeze(1) * near.slope)
    curvature = curvature + torch.eye(len(curvature), dtype=curvature.dtype)
    return float(_costs(rows, laws[None], band)) + 0.5 * float(torch.logdet(curvature))


def _roughly(rows: Rows, lowest: Tensor, highest: Tensor) -> Tensor:
    """Return approximate laws [L, C] for estimating dead bands.

    They have no static friction, which could be mistaken for a dead band.
    """
    highest, none = highest.clone(), torch.zeros(lowest.shape[1], dtype=torch.float64)
    highest[_STICK] = 0.0
    starts = [_start(lag, _RATES[-1], delay, lowest) for lag, delay in product(_LAGS, _DELAYS)]
    best = int(_costs(rows, torch.stack(starts), none).argmin())
    return _again(rows, none, starts[best], lowest, highest)


def body_modes(moves: Tensor) -> Tensor | None:
    """Return modes of the body, [C, C] by actuators, if they are not nearly the actuators.

    They are forward motion, the turn, and of more than two actuators sideways motion, as far as
    these exist, and combinations at right angles to them.

    Args:
        moves: forward and sideways motion and turn by actuators, [3, C].
    """
    forward, aside, turn = moves
    count, chosen = len(forward), [forward, turn]
    if count > 2 and aside.norm() > _ASIDE * forward.norm():
        chosen.append(aside)
    modes = torch.stack(chosen)
    if len(chosen) < count:
        modes = torch.cat([modes, torch.linalg.svd(modes).Vh[len(chosen) :]])
    modes = modes / modes.abs().sum(1, keepdim=True).clamp(min=1e-12)
    alike = bool((modes.abs().amax(1) > _ALIKE).all())
    return None if alike or torch.linalg.cond(modes) > _WORST else modes


def _turning(rows: Rows, laws: Tensor, band: Tensor | None) -> Tensor | None:
    """Return the actuators' combination for the rate of turn [C], if it costs speed."""
    count = laws.shape[1]
    band = torch.zeros(count, dtype=torch.float64) if band is None else band
    actuators = Actuators.of(laws[None], band)
    twists, errors = rows.fitted(actuators)
    turning = twists[0, :count, 2]
    turning = turning / turning.abs().sum().clamp(min=1e-9)
    _, less = replace(rows, turning=turning).fitted(actuators)
    gain = sum(one.cost for one in errors) - sum(one.cost for one in less)
    return turning if gain > _LOST * rows.belief else None


def _start(lag: float, rate: float, delay: float, lowest: Tensor) -> Tensor:
    """Return the first laws [L, C] of a search, equal for all actuators."""
    start = _of_each(_USUAL, lowest.shape[1])
    start[_TOTAL], start[_RATE], start[_DELAY] = math.log(lag + delay), math.log(rate), delay
    return torch.maximum(start, lowest)


def _dead_bands(rows: Rows, laws: Tensor) -> Tensor:
    """Return the dead bands [C] that fit rows best with given laws.

    Only an actuator that is driven both ways can have one. It is half way between two commanded
    magnitudes. First a common band is searched, because of two creeping wheels neither can be
    judged while the other is assumed to move; then each band separately.
    """
    commanded, band = rows.commanded, torch.zeros(laws.shape[1], dtype=torch.float64)
    reverses = (commanded.amin(0) < 0.0) & (commanded.amax(0) > 0.0)
    each = [torch.arange(len(band)) == c for c in torch.nonzero(reverses).flatten()]
    for group in (reverses, *each * 2) if len(each) > 1 else each:
        given = commanded[:, group].abs().unique()
        given = given[(given > 0.0) & (given <= _WIDEST)]
        costs: dict[float, float] = {}
        sizes = [0.0, *((given[1:] + given[:-1]) / 2.0).tolist()]
        low, high, best = 0, len(sizes), 0.0
        while True:
            stride = -(-(high - low) // _TRIED)
            tried = list(dict.fromkeys((0.0, *sizes[low:high:stride])))
            new = [size for size in tried if size not in costs]
            if new:
                bands = torch.where(group, torch.tensor(new, dtype=band.dtype)[:, None], band)
                losses = _costs(rows, laws.repeat(len(new), 1, 1), bands)
                costs.update(zip(new, losses.tolist(), strict=True))
            best = min(tried, key=costs.__getitem__)
            if stride == 1:
                break
            place = sizes.index(best)
            low, high = max(place - stride, 0), min(place + stride + 1, len(sizes))
        band = torch.where(group, best if costs[0.0] - costs[best] > _BELIEVED else 0.0, band)
    return band


def _searched(rows: Rows, band: Tensor, lowest: Tensor, highest: Tensor) -> Tensor:
    """Return the laws [L, C] that fit rows best, within limits.

    Args:
        rows: the rows.
        band: dead bands, [C].
        lowest: lower limit of each law, [L, C].
        highest: upper limit of each law, [L, C].
    """
    tried = list(product(_LAGS, _RATES, _DELAYS))
    coarse = torch.stack([_start(*one, lowest) for one in tried])
    order = _costs(rows, coarse, band).argsort().tolist()

    def best_of(starts: list[Tensor], longest_delay: float) -> tuple[Tensor, float]:
        limit = highest.clone()
        limit[_DELAY], limit[_DRAG] = longest_delay, 0.0
        refined = [_refined(rows, band, start, lowest, limit) for start in starts]
        return min(refined, key=lambda one: one[1])

    def starts(longest_delay: float) -> list[Tensor]:
        # The best of each rate, because no step leads from a rate without effect to one with
        # effect.
        of_rates: dict[float, Tensor] = {}
        for number in order:
            _, rate, delay = tried[number]
            if delay <= longest_delay:
                of_rates.setdefault(rate, coarse[number])
        return list(of_rates.values())[:_STARTS]

    best, least = best_of(starts(_HIGHEST[_DELAY]), _HIGHEST[_DELAY])
    if best[_DELAY, 0] > 0.0:
        at_once, cost = best_of([*starts(0.0)[:1], best], 0.0)
        if cost < least + rows.belief:
            best, least = at_once, cost
    slow = best[_TOTAL].exp() > _SLUGGISH
    if slow.any() and len(rows.commanded) >= _SIZED:
        limit, start = highest.clone(), best.clone()
        limit[_DRAG, ~slow], limit[_DELAY] = 0.0, _HIGHEST[_DELAY] * (best[_DELAY, 0] > 0.0)
        start[_DRAG, slow] = _FIRST_DRAG
        start[_TOTAL, slow] += math.log1p(_FIRST_DRAG)
        dragged, cost = _refined(rows, band, start, lowest, limit)
        if cost < least - rows.belief:
            best = dragged
    return best


def fit_again(fit: Fit, weights: Tensor) -> list[Fit]:
    """Return the fits of the same rows with other weights.

    Args:
        fit: fit of the rows, the start of the search.
        weights: of the rows, [M, N].
    """
    limits = [_of_each(values, fit.laws.shape[1]) for values in (_LOWEST, _HIGHEST)]
    fits = []
    for rows in map(fit.rows.weighted, weights):
        laws = fit.laws
        if fit.searched:
            # Of a log, windows tell the size of members' differences; a few rows of each have too
            # many solutions.
            steps = _STEPS if isinstance(rows, Motion) and len(rows.x) >= _SIZED else _AGAIN
            laws = _again(rows.some(_ROWS), fit.band, laws, *limits, steps)
        fits.append(Fit.of(rows, fit.band, laws, fit.searched))
    return fits


def _again(
    rows: Rows,
    band: Tensor,
    laws: Tensor,
    lowest: Tensor,
    highest: Tensor,
    steps: int = _AGAIN,
) -> Tensor:
    """Return the laws [L, C] of slightly changed rows, from the laws of the original ones."""
    return _refined(rows, band, laws, lowest, _kept(laws, highest), steps)[0]


def _kept(laws: Tensor, highest: Tensor) -> Tensor:
    """Return the upper limits of laws [L, C] with which a delay and a drag of 0 remain so."""
    highest = highest.clone()
    highest[_DRAG, laws[_DRAG] == 0.0] = 0.0
    if laws[_DELAY, 0] == 0.0:
        highest[_DELAY] = 0.0
    return highest


def _varied(laws: Tensor, lowest: Tensor, highest: Tensor) -> Tensor:
    """Return which laws a search varies, [L, C]; the delay is common to all: the first column's."""
    varied = (highest > lowest).expand_as(laws).clone()
    varied[_DELAY, 1:] = False
    return varied


def outside(command: Tensor, band: Tensor) -> Tensor:
    """Return commands [N, C], zero within the dead band [C]."""
    return torch.where(command.abs() < band, 0.0, command)


def _of_each(values: Sequence[float], count: int) -> Tensor:
    """Return values [L] repeated for each actuator, [L, C]."""
    return torch.tensor(values, dtype=torch.float64).unsqueeze(1).repeat(1, count)


def _refined(
    rows: Rows, band: Tensor, laws: Tensor, lowest: Tensor, highest: Tensor, steps: int = _STEPS
) -> tuple[Tensor, float]:
    """Return the best laws near given ones, and their cost, by Levenberg's and Marquardt's method.

    Args:
        rows: the rows to fit.
        band: dead bands, [C].
        laws: first laws, [L, C].
        lowest: lower limit of each, [L, C].
        highest: upper limit of each, [L, C].
        steps: largest number of steps.
    """
    laws = torch.minimum(laws, highest)
    varied = _varied(laws, lowest, highest)
    unit = _widths(rows).expand_as(laws)[varied]
    cost, damping = float(_costs(rows, laws[None], band)), _DAMPING
    for _ in range(steps):
        near = _near(rows, band, laws, varied, highest)
        here, low, high = laws[varied], lowest[varied], highest[varied]
        off, counts = _off(laws, _widths(rows))
        gradient = near.slope.T @ (near.weight * near.error) + off[varied]
        curvature = near.slope.T @ (near.weight.unsqueeze(1) * near.slope)
        curvature = curvature + torch.diag(counts[varied])
        # A law at a limit that would go beyond it stays there.
        free = ~(((here <= low) & (gradient > 0.0)) | ((here >= high) & (gradient < 0.0)))
        before = cost
        while damping < _STIFFEST and cost == before:
            damped = curvature + damping * torch.diag(curvature.diagonal() + 1.0)
            step = torch.zeros_like(gradient)
            step[free] = -torch.linalg.solve(damped[free][:, free], gradient[free])
            tried = laws.clone()
            tried[varied] = here + unit * step.clamp(-_LONGEST, _LONGEST)
            tried = torch.maximum(torch.minimum(tried, highest), lowest)
            reached = float(_costs(rows, tried[None], band))
            if reached < cost:
                laws, cost = tried, reached
                damping = max(_LESS * damping, _FREEST)
            else:
                damping *= _MORE
        if before - cost < _GAIN:
            break
    return laws, cost


class _Near(NamedTuple):
    """Laws, and those near them.

    Attributes:
        error: all errors in units of their size, [E].
        weight: of each, as in iteratively reweighted least squares for Student's t, [E].
        slope: of the errors by each varied law in units of its prior, [E, V].
    """

    error: Tensor
    weight: Tensor
    slope: Tensor


def _near(rows: Rows, band: Tensor, laws: Tensor, varied: Tensor, highest: Tensor) -> _Near:
    """Return the errors at laws [L, C] with upper limits, and their slopes by the varied ones."""
    here, high, unit = (part[varied] for part in (laws, highest, _widths(rows).expand_as(laws)))
    step = torch.where(here + _DIFFERENCE * unit > high, -_DIFFERENCE, _DIFFERENCE)
    moved = laws.repeat(1 + len(step), 1, 1)
    moved[1:, varied] += torch.diag(step * unit)
    errors = rows.fitted(Actuators.of(moved, band))[1]
    each = torch.cat([one.error for one in errors], 1)
    size = torch.cat([one.size[0].expand_as(one.error[0]) for one in errors])
    weight = torch.cat([one.weight.expand_as(one.error[0]) for one in errors])
    error = each[0] / size
    weight = weight * (FREEDOM + 1.0) / (FREEDOM + error.square())
    return _Near(error, weight, ((each[1:] - each[0]) / size / step.unsqueeze(1)).T)


def _costs(rows: Rows, laws: Tensor, band: Tensor) -> Tensor:
    """Return minus the logarithm of the probability [P] of laws [P, L, C] after rows.

    Dead bands are [C] or [P, C].
    """
    pairs = zip(laws.split(_TOGETHER), band.expand_as(laws[:, 0]).split(_TOGETHER), strict=True)
    errors = [rows.fitted(Actuators.of(own, near))[1] for own, near in pairs]
    costs = torch.cat([torch.stack([one.cost for one in each]).sum(0) for each in errors])
    return costs + 0.5 * _off(laws, _widths(rows))[0].square().sum((1, 2))


def _widths(rows: Rows) -> Tensor:
    """Return the widths of the rows' prior of laws, [L, 1]."""
    width = torch.tensor(_WIDTH, dtype=torch.float64).unsqueeze(1)
    width[_CURVE:_DELAY] *= _STRAIGHT if rows.straight else 1.0
    return width


def _off(laws: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
    """Return the deviation of laws [..., L, C] from usual ones, in widths [L, 1] of the prior."""
    counts = torch.ones_like(laws)
    counts[..., _DELAY, 1:] = 0.0
    # A rate above the usual one has no effect.
    counts[..., _RATE, :] = (laws[..., _RATE, :] < _USUAL[_RATE]).to(laws)
    usual = torch.tensor(_USUAL, dtype=torch.float64).unsqueeze(1)
    return (laws - usual) / width * counts, counts


def _fitted(actuators: Actuators, motion: Motion) -> tuple[Tensor, list[Errors]]:
    """Return the best kinematics [P, F, 3], and their errors."""
    x, y, within = motion.x, motion.y, motion.within
    pieces, parts, late, late_parts = motion.distances(actuators)
    of_turn, of_shift = terms_near_zero(motion, pieces.shape[2])
    turn = y[:, 2]
    weight = torch.ones_like(turn) if motion.weight is None else motion.weight
    precision = torch.ones_like(y[:, :2]).T if motion.precision is None else motion.precision
    of_pieces = pieces.sum(1) * precision[0]
    rate, turns_left = regressions(of_pieces, turn * precision[0], of_turn, weight)
    turns = (rate[:, None, None] @ pieces).squeeze(2)  # [P, pieces, N]
    turns[:, -1] = turn - turns[:, :-1].sum(1)
    heading = turns.cumsum(1) - turns / 2.0 - turn / 2.0
    chord = se2.chord(turns)

    def turned(features: Tensor) -> tuple[Tensor, Tensor]:
        """Return rows' displacements by the features as forward motion, [P, K, N] each."""
        parts = chord * heading.cos() * precision[1], chord * heading.sin() * precision[1]
        ahead, aside = (torch.einsum("pkn,pkfn->pfn", part, features) for part in parts)
        return ahead, aside

    moved = se2.mid_turn(y)
    (ahead, aside), (late_ahead, late_aside) = map(turned, late.unbind(1))
    both = torch.cat([torch.cat([ahead, aside], 2), torch.cat([-late_aside, late_ahead], 2)], 1)
    target = (moved[:, :2].T * precision[1]).flatten()
    speeds, shifts_left = regressions(both, target, of_shift, weight.repeat(2))
    kinematics = torch.stack([*speeds.chunk(2, 1), rate], dim=2)
    errors = [turns_left, shifts_left]
    if within is not None and len(within.row):
        # They are from the same commands as the rows and must not outweigh them: in all they have
        # at most the weight of the rows.
        counts = weight[within.row] * min(len(x) / len(within.row), 1.0)
        forward, sideways, turn = (one[:, None, None] for one in kinematics.unbind(2))
        late_ahead, late_aside = late_parts.unbind(1)
        twists = torch.stack([forward @ late_ahead, sideways @ late_aside, turn @ parts], -1)
        twists = twists.squeeze(2)  # [P, pieces, L, 3]
        steps = se2.exp(twists).unbind(1)
        pose = steps[0]
        for step in steps[1:]:
            pose = se2.compose(pose, step)
        error = pose - within.moved.to(x)
        # Errors of short parts are compared with those of short parts.
        size = (1.4826 * error.abs().median(1, keepdim=True).values).clamp(min=1e-6)
        errors += [Errors(error[..., k], size[..., k], counts) for k in range(error.shape[2])]
    return kinematics, errors


def terms_near_zero(rows: Rows, width: int) -> tuple[Tensor, Tensor]:
    """Return how near zero the prior holds the terms of the turn, [F], and the translation, [2 F].

    It is 0 where the prior leaves a term free, 1 where it holds it, and more where it holds it
    nearer. Held are products and losses. Where rows do not tell the terms of the turn from each
    other, say because a car always drove at one speed, this prior decides. That of a car turns only
    while it moves: all terms of its turn are near zero but the products of two actuators.

    A symmetric body's mirror image, driven with the opposite turn, makes the mirror image of the
    motion. So its turn and its sideways motion change their sign with the second mode, the turn,
    and its forward motion does not; terms that would break this are held nearer zero.

    Args:
        rows: with C actuators or modes; if it is symmetric, forward motion and the turn are first.
        width: F, number of terms.
    """
    count = len(rows.columns.driven)
    pairs = [(i, j) for i in range(count) for j in range(i, count)]
    held = (torch.arange(width) >= count).double()
    turn, ahead, aside = held.clone(), held.clone(), held.clone()
    if rows.steered:
        turn[:] = 1.0
        turn[count : count + len(pairs)] = torch.tensor([float(i == j) for i, j in pairs])
    if rows.symmetric:
        # Nothing is known of the sides of modes after the second.
        sign = [1.0, -1.0, *[0.0] * (count - 2)]
        signs = torch.tensor([*[0.0] * count, *(sign[i] * sign[j] for i, j in pairs), *sign])[
            :width
        ]
        ahead[signs < 0.0] = turn[signs > 0.0] = aside[signs > 0.0] = _SYMMETRIC**2
    return turn, torch.cat([ahead, aside])


def regressions(
    features: Tensor,
    target: Tensor,
    near_zero: Tensor,
    weight: Tensor,
    products: float = _PRODUCTS,
    kind: Tensor | None = None,
    student: bool = False,
) -> tuple[Tensor, Errors]:
    """Return the weights [P, F] of robust regressions, and their errors.

    Args:
        features: [P, F, N]: of speeds, products and losses.
        target: [N].
        near_zero: how near zero the prior holds a weight, [F], see :func:`terms_near_zero`.
        weight: what each row counts, [N].
        products: prior fraction of the target that terms explain at 1.
        kind: of the rows, whose errors differ in size, [N], 0, 1 ...; None: all are of one kind.
        student: whether errors have Student's t distribution; if not, Huber's loss is minimised.
    """
    models, terms, rows = features.shape
    if kind is None:
        kind = torch.zeros(rows, dtype=torch.long)
    weights = torch.empty(models, terms, dtype=torch.float64)
    error = torch.empty(models, rows, dtype=torch.float64)
    size = torch.empty(models, len(kind.unique()), dtype=torch.float64)
    given = (features, target, near_zero, weight, kind, weights, error, size)
    _regress(*(part.contiguous().numpy() for part in given), products, student)
    return weights, Errors(error, size if size.shape[1] == 1 else size[:, kind], weight)


@njit(error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _regress(features, target, near_zero, weight, kind, weights, error, size, products, student):
    """Write the results of :func:`regressions`: weights [P, F], errors [P, N], sizes [P, kinds].

    The other arguments are as there.
    """
    models, terms, rows = features.shape
    kinds = size.shape[1]
    square, counts, magnitude = np.empty((terms, terms)), np.empty(rows), np.empty(rows)
    weighed, pull, first, many = np.empty(rows), np.empty(terms), np.zeros(kinds), np.zeros(kinds)
    for n in range(rows):
        first[kind[n]] += target[n] * target[n]
        many[kind[n]] += 1.0
    for k in range(kinds):
        first[k] = max(math.sqrt(first[k] / max(many[k], 1.0)), 1e-9)
    for p in range(models):
        for n in range(rows):
            counts[n] = weight[n] / first[kind[n]] ** 2
        for step in range(REGRESSIONS):
            for i in range(terms):
                right = 0.0
                for n in range(rows):
                    weighed[n] = counts[n] * features[p, i, n]
                    right += weighed[n] * target[n]
                weights[p, i] = right
                for j in range(i + 1):
                    total = 0.0
                    for n in range(rows):
                        total += weighed[n] * features[p, j, n]
                    square[i, j] = total
            mean = 0.0
            for i in range(terms):
                mean += square[i, i] / terms
            for i in range(terms):
                square[i, i] += 1e-9 * max(mean, 1e-12)
                # After the size of errors is known.
                if step > 0:
                    square[i, i] += pull[i]
            _solve(square, weights[p])
            for n in range(rows):
                error[p, n] = -target[n]
            for i in range(terms):
                for n in range(rows):
                    error[p, n] += weights[p, i] * features[p, i, n]
            for k in range(kinds):
                place = 0
                for n in range(rows):
                    if kind[n] == k:
                        magnitude[place] = abs(error[p, n])
                        place += 1
                if place:
                    # The median is 0.67 standard deviations of a normal distribution.
                    size[p, k] = max(1.4826 * smallest(magnitude, place, (place - 1) // 2), 1e-9)
            if step == 0:
                # By such a term alone, the target would have ``products`` of its size or less.
                for i in range(terms):
                    power = 0.0
                    for n in range(rows):
                        power += (features[p, i, n] / first[kind[n]]) ** 2
                    pull[i] = near_zero[i] * power / max(rows, 1) / products**2
            for n in range(rows):
                off = abs(error[p, n]) / size[p, kind[n]]
                if student:
                    inside = (FREEDOM + 1.0) / (FREEDOM + off * off)
                else:
                    inside = min(_HUBER / max(off, 1e-12), 1.0)
                counts[n] = weight[n] * inside / size[p, kind[n]] ** 2


@kernel()
def _solve(square, right):
    """Solve a positive definite system, whose lower half is given, by Cholesky's method.

    Args:
        square: [F, F], overwritten by its factor.
        right: [F], overwritten by the solution.
    """
    count = len(right)
    for i in range(count):
        for j in range(i + 1):
            total = square[i, j]
            for k in range(j):
                total -= square[i, k] * square[j, k]
            square[i, j] = math.sqrt(total) if i == j else total / square[j, j]
        for k in range(i):
            right[i] -= square[i, k] * right[k]
        right[i] /= square[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            right[i] -= square[k, i] * right[k]
        right[i] /= square[i, i]
