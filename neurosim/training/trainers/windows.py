"""The drive model of logs in which commands change faster than the robot answers.

There, rows follow one another, and each is too short to tell much. So the model is fitted to
windows: overlapping runs of rows of :data:`LENGTHS`, whose displacement is composed of those of
their rows. Pending commands and speeds continue from row to row, as in the simulator.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neurosim.base.compiled import njit
from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.drive import Underway
from neurosim.simulators.motion.kernels import _LAW, _come, _follow, _law, goal_of
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import Within
from neurosim.training.trainers.drive_fit import (
    Actuators,
    Errors,
    Fit,
    follow_late,
    outside,
    products_and_losses,
    regressions,
    searched_terms,
    stretches,
    terms_near_zero,
)

#: Durations of windows, s, and number of windows that begin within the length of one.
LENGTHS, OVERLAP = (0.25, 0.5, 1.0, 2.0), 4
#: Numbers of commands in a row, where each is long enough to be learned from by itself.
RUNS = (1, 3, 10)
#: Longest piece of constant twist, s.
PIECE = 0.1
#: Prior fraction of the motion that products of speeds explain. It is larger than for held
#: commands, because in a log of a car speed and steering change together.
_PRODUCTS = 0.2
#: Number of rows for the search of the laws, for each independent row.
_SHORTER = 5
#: Fraction of the largest motion below which a robot stands.
_STANDS = 1e-3


class Windows(NamedTuple):
    """Runs of rows, [W] each.

    Attributes:
        first: the first row.
        end: the row after the last one.
        kind: index of its length.
        weight: its weight. Windows overlap, and errors of neighbours are similar; all together have
            the weight of the possible separate windows of the longest length.
    """

    first: Tensor
    end: Tensor
    kind: Tensor
    weight: Tensor

    def sums(self, values: Tensor, axis: int = 0) -> Tensor:
        """Return sums of values over windows, [..., W, ...], of those of rows, [..., N, ...]."""
        nothing = torch.zeros_like(values.narrow(axis, 0, 1))
        until = torch.cat([nothing, values.cumsum(axis)], axis)
        return until.index_select(axis, self.end) - until.index_select(axis, self.first)

    def some(self, most: int) -> Windows:
        """Return every n-th window, so that there are no more than this, n times as heavy."""
        every = -(-len(self.first) // most)
        some = Windows(*(part[::every] for part in self))
        return some._replace(weight=every * some.weight)

    def separate(self, kind: int = 0) -> Tensor:
        """Return indices of windows of a kind or longer ones that share no rows: most of them."""
        chosen, last = [], 0
        first, end, kinds = (part.numpy() for part in self[:3])
        for place in np.argsort(end, kind="stable"):
            if kinds[place] >= kind and first[place] >= last:
                chosen.append(place)
                last = end[place]
        return torch.tensor(chosen)


def windows_of(time: Tensor, joined: Tensor) -> Windows:
    """Return the windows of rows.

    Args:
        time: durations, [N] s.
        joined: whether a row begins where that before it ended, [N] bool.
    """
    end = np.concatenate([[0.0], np.cumsum(time.numpy())])
    breaks = np.append(np.flatnonzero(~joined.numpy()), len(time))
    windows = []
    for kind, length in enumerate(LENGTHS):
        for start, stop in pairwise(breaks):
            last = -np.inf
            for first in range(start, stop):
                begin = end[first]
                if begin - last < length / OVERLAP - 1e-6:
                    continue
                until = int(np.searchsorted(end[: stop + 1], begin + length))
                until = min(max(until, first + 1), stop)
                if until > first + 1 and end[until] + end[until - 1] > 2.0 * (begin + length):
                    until -= 1
                lasts = end[until] - begin
                # A long row is a window of the length nearest to its own.
                nearest = int(np.abs(np.log(np.array(LENGTHS) / lasts)).argmin())
                if nearest != kind:
                    continue
                own = min(begin - last, lasts) / LENGTHS[-1] / len(LENGTHS)
                windows.append((first, until, kind, min(own, 1.0)))
                last = begin
    first_, end_, kind_, weight = np.array(windows).reshape(-1, 4).T
    whole = [torch.tensor(each.astype(np.int64)) for each in (first_, end_, kind_)]
    return Windows(*whole, torch.tensor(weight))


def runs_of(rows: int) -> Windows:
    """Return windows of :data:`RUNS` successive rows, for rows that are commands of their own."""
    windows = []
    for kind, length in enumerate(RUNS):
        stride = max(length // OVERLAP, 1)
        each = stride / RUNS[-1] / len(RUNS)
        firsts = range(0, rows - length + 1, stride)
        windows += [(first, first + length, kind, each) for first in firsts]
    first_, end_, kind_, weight = np.array(windows).reshape(-1, 4).T
    whole = [torch.tensor(each.astype(np.int64)) for each in (first_, end_, kind_)]
    return Windows(*whole, torch.tensor(weight))


def _cut(time: Tensor, y: Tensor, within: Within | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cut rows at known poses within them, without pieces shorter than :data:`PIECE`.

    Returns:
        For each piece the row, begin and end, [K] s since the row's beginning, and the
        displacement, [K, 3].
    """
    known: dict[int, list[tuple[float, Tensor]]] = {}
    if within is not None:
        for row, moment, moved in zip(
            within.row.tolist(), within.time.tolist(), within.moved, strict=True
        ):
            known.setdefault(row, []).append((moment, moved))
    rows, begins, ends, moves = [], [], [], []
    for row, lasts in enumerate(time.tolist()):
        begin, pose = 0.0, torch.zeros(3, dtype=y.dtype)
        for moment, moved in known.get(row, ()):
            if moment - begin >= PIECE - 1e-6 and lasts - moment >= PIECE - 1e-6:
                rows.append(row)
                begins.append(begin)
                ends.append(moment)
                moves.append(se2.between(pose[None], moved[None])[0])
                begin, pose = moment, moved
        rows.append(row)
        begins.append(begin)
        ends.append(lasts)
        moves.append(se2.between(pose[None], y[row][None])[0])
    of = (
        torch.tensor(rows),
        torch.tensor(begins, dtype=y.dtype),
        torch.tensor(ends, dtype=y.dtype),
    )
    return (*of, torch.stack(moves))


@njit(error_model="numpy")
def _driven(a, turning, modes, commanded, before, time, joined, features, lasts, row, states):
    """Drive rows one after the other.

    Args:
        a: :class:`Actuators` of one model.
        turning: as in DriveModel, [C].
        modes: as in DriveModel, [C, C].
        commanded: commands of the rows, [N, C].
        before: previous commands of the rows, used if a row is not joined to the previous one, [N,
            C].
        time: of the rows, s.
        joined: whether a row begins at the end of the previous one.
        features: [M, F], written: for each piece distances, and products of mean speeds times time.
        lasts: [M], written: its duration, s.
        row: [M], written: its row.
        states: [N, 2 C], written: speeds and pushes at a row's beginning.

    Returns:
        The number of pieces.
    """
    count, delay = commanded.shape[1], a.delay[0]
    speed, push, distance = np.zeros(count), np.zeros(count), np.zeros(count)
    law, goals, earlier = np.zeros(_LAW), np.zeros(commanded.shape), np.zeros(count)
    made, acting, start, acts = 0, 0, 0.0, 0.0
    for i in range(len(time)):
        if not joined[i]:
            acting, start, acts = i - 1, 0.0, delay  # before[i] acts until then
            for c in range(count):
                earlier[c] = goal_of(a, modes, before[i], c)
                speed[c], push[c] = earlier[c], 0.0
            chain = i
        for c in range(count):
            goals[i, c] = goal_of(a, modes, commanded[i], c)
            states[i, c], states[i, count + c] = speed[c], push[c]
        now, end = start, start + time[i]
        while now < end - 1e-9:
            while acting < i and acts <= now + 1e-9:
                acting += 1
                acts += time[acting]
            until = end if acting >= i else min(end, acts)
            span = until - now
            span /= np.ceil(span / PIECE - 1e-9)
            for c in range(count):
                goal = goals[acting, c] if acting >= chain else earlier[c]
                _law(a, c, speed[c], goal, push[c], law)
                left, missed = _follow(law, span)
                distance[c] = goal * span - missed
                speed[c], push[c] = _come(law, span, left)
                features[made, c] = distance[c]
            products_and_losses(turning, span, count, features[made])
            lasts[made], row[made] = span, i
            made += 1
            now += span
        start = end
    return made


@njit(error_model="numpy")
def _late(features, lasts, row, joined, lag, count, late, states):
    """Let the features of pieces of rows follow with a lag, see :func:`follow_late`.

    Args:
        features, lasts, row: of :func:`_driven`.
        joined: whether a row begins at the end of the previous one.
        lag, count: as there.
        late: [M, F], written.
        states: [N, F], written: the rates of change of the features at a row's beginning, 1/s.
    """
    rate = np.zeros(features.shape[1])
    last = -1
    for k in range(len(features)):
        if row[k] != last:
            last = row[k]
            if not joined[last]:
                rate[:] = features[k] / lasts[k]
            states[last] = rate
        follow_late(lag, count, features[k], lasts[k], rate, late[k])


@dataclass(frozen=True)
class Chains:
    """Rows that follow one another, cut at known poses within them, and windows of these.

    Attributes:
        commanded: scaled commands, before the static curve, [N, C].
        before: the same for the previous command, [N, C].
        time: durations, [N] s.
        joined: whether a row begins where that before it ended, [N] bool.
        y: displacements, [N, 3].
        windows: runs of these rows.
        whole: indices at which the uncut rows begin, [K].
        columns: of their inputs.
        weight: weights of the whole rows, [K]; None: equal.
        turning: of the drive models that are fitted, [C]; None: nothing is lost in curves.
        modes: of the drive models that are fitted, [C, C]; None: the laws are of actuators.
        steered: whether the prior is that of a car, see :func:`terms_near_zero`.
        straight: whether the prior holds static curves nearly straight.
        symmetric: whether the prior is that of a body with two like sides.
        drift: that of the drive models that are fitted, s.
    """

    commanded: Tensor
    before: Tensor
    time: Tensor
    joined: Tensor
    y: Tensor
    windows: Windows
    whole: Tensor
    columns: CommandFeatures
    weight: Tensor | None = None
    turning: Tensor | None = None
    modes: Tensor | None = None
    steered: bool = False
    straight: bool = False
    symmetric: bool = False
    drift: tuple[float, float] = (0.0, 0.0)

    #: Windows begin anywhere in a command, also while its delay lasts.
    belief: ClassVar[float] = 1.0

    @classmethod
    def of(
        cls,
        x: Tensor,
        y: Tensor,
        joined: Tensor,
        columns: CommandFeatures,
        longest: float,
        within: Within | None = None,
    ) -> Chains:
        """Return rows with their windows, without those in which the robot should stand and stands.

        Args:
            x: scaled inputs before the static curve, [N, I].
            y: displacements, [N, 3].
            joined: whether a row begins where that before it ended, [N] bool.
            columns: of the inputs.
            longest: scale of durations, s.
            within: poses within the rows.
        """
        row, begin, end, y = _cut(x[:, columns.duration] * longest, y, within)
        whole = torch.nonzero(begin == 0.0).squeeze(1)
        commanded, before = x[row][:, list(columns.driven)], x[row][:, list(columns.before)]
        joined = joined[row] | (begin > 0.0)
        time = end - begin
        windows = windows_of(time, joined)
        asked = (commanded != 0).any(1) | (before != 0).any(1)
        moves = asked | (y.abs() > _STANDS * y.abs().amax(0)).any(1)
        count = torch.cat([torch.zeros(1), moves.cumsum(0)])
        some = count[windows.end] > count[windows.first]
        windows = Windows(*(part[some] for part in windows))
        return cls(commanded, before, time, joined, y, windows, whole, columns)

    def some(self, most: int) -> Chains:
        """Return stretches of the rows with their windows; more than ``most``: they are short."""
        rows, count = len(self.time), len(self.whole)
        of_whole, begin = stretches(count, max(_SHORTER * most * count // rows, 1))
        kept, begins = of_whole[self._uncut], torch.zeros(rows, dtype=torch.bool)
        begins[self.whole[begin]] = True
        joined = self.joined & ~begins
        # All rows of a window must be kept, and none but its first may begin a stretch.
        gaps = torch.cat([torch.zeros(1, dtype=torch.long), (~kept | begins).cumsum(0)])
        windows = self.windows
        inside = kept[windows.first] & (gaps[windows.end] == gaps[windows.first + 1])
        number = torch.cat([kept.cumsum(0) - kept.long(), kept.sum()[None]])
        windows = Windows(*(part[inside] for part in windows))
        windows = windows._replace(first=number[windows.first], end=number[windows.end])
        names = ("commanded", "before", "time", "y")
        parts = {name: getattr(self, name)[kept] for name in names}
        weight = None if self.weight is None else self.weight[of_whole]
        firsts = number[self.whole[of_whole]]
        return replace(
            self, **parts, joined=joined[kept], windows=windows, whole=firsts, weight=weight
        )

    def weighted(self, weight: Tensor) -> Chains:
        """Return the rows with other weights of the whole rows, [K]."""
        return replace(self, weight=weight)

    @property
    def _uncut(self) -> Tensor:
        """The number of the uncut row that each row is a part of, [N]."""
        begins = torch.zeros(len(self.time), dtype=torch.long)
        begins[self.whole] = 1
        return begins.cumsum(0) - 1

    def _counted(self) -> Windows:
        """Return the windows with the mean weight of their rows."""
        if self.weight is None:
            return self.windows
        windows = self.windows
        mean = windows.sums(self.weight[self._uncut] * self.time) / windows.sums(self.time)
        return windows._replace(weight=windows.weight * mean)

    def driven(self, actuators: Actuators) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return features [M, F], durations and rows [M] of pieces, and the rows' first states.

        These are speeds and pushes, [N, 2 C].
        """
        time, count = self.time.numpy(), self.commanded.shape[1]
        # Each row, and each command that begins to act in one, may leave a shorter piece.
        most = int((time / PIECE).sum()) + 3 * len(time) + 8
        features = np.zeros((most, searched_terms(self)))
        lasts, row, states = (
            np.zeros(most),
            np.zeros(most, np.int64),
            np.zeros((len(time), 2 * count)),
        )
        given = (self.commanded.numpy(), self.before.numpy(), time, self.joined.numpy())
        each = actuators.turning(self.turning), actuators.modes(self.modes)
        made = _driven(actuators, *each, *given, features, lasts, row, states)
        parts = (features[:made], lasts[:made], row[:made], states)
        return tuple(map(torch.from_numpy, parts))  # type: ignore[return-value]

    def late(
        self, features: Tensor, lasts: Tensor, row: Tensor, lag: float
    ) -> tuple[Tensor, Tensor]:
        """Return the features with a lag [M, F], and their rates at rows' beginnings, [N, F].

        Args:
            features, lasts, row: those of :meth:`driven`.
            lag: of products and losses, s.
        """
        late, states = features.clone(), torch.zeros(len(self.time), features.shape[1]).double()
        given = (part.numpy() for part in (features, lasts, row, self.joined))
        _late(*given, lag, self.commanded.shape[1], late.numpy(), states.numpy())
        return late, states

    def inputs(self, fit: Fit, x: Tensor) -> tuple[Tensor, Underway]:
        """Return networks' inputs of whole rows, like :func:`chain`, and the actuators' states.

        Args:
            fit: the drive model.
            x: scaled inputs of the whole rows, as given.
        """
        drive, count = fit.drive, self.commanded.shape[1]
        own = replace(self, modes=fit.rows.modes, turning=fit.rows.turning, drift=fit.rows.drift)
        *pieces, states = own.driven(fit.actuators.one(0))
        speed, push = states[self.whole].chunk(2, 1)
        drift = speed[:, :0]
        if drive.drifts:
            each = [own.late(*pieces, lag)[1][self.whole, count:] for lag in own.drift]
            twists = drive.twists[count : count + each[0].shape[1]]
            drift = torch.stack([rates @ twists[:, k] for k, rates in enumerate(each)], 1)
        goals, before = (
            drive.shaped(outside(part, fit.band)) for part in (self.commanded, self.before)
        )
        begin = self.time.cumsum(0) - self.time
        number = torch.arange(len(begin))
        chain = torch.where(self.joined, 0, number).cummax(0).values
        earlier = self.whole[:, None] - drive.slots + torch.arange(drive.slots)
        first = chain[self.whole][:, None]
        inside, earlier = earlier >= first, torch.maximum(earlier, first)
        waiting = torch.where(inside.unsqueeze(2), goals[earlier], before[earlier])
        acts = begin[earlier] + drive.delay - begin[self.whole][:, None]
        under = Underway(speed, push, waiting, torch.where(inside, acts, 0.0), drift)
        x = x.clone()
        x[:, list(self.columns.driven)] = goals[self.whole]
        x[:, list(self.columns.before)] = speed
        return torch.cat([x, before[self.whole], drift], 1), under

    def fitted(self, actuators: Actuators) -> tuple[Tensor, list[Errors]]:
        """Return the best kinematics of each model, and their errors."""
        each = [self._fitted(actuators.one(p)) for p in range(len(actuators.lag))]
        kinematics, errors = zip(*each, strict=True)
        together = [
            Errors(torch.stack(error), torch.stack(size), weight[0])
            for error, size, weight in (
                zip(*kind, strict=True) for kind in zip(*errors, strict=True)
            )
        ]
        return torch.stack(kinematics), together

    def _fitted(self, actuators: Actuators) -> tuple[Tensor, list[Errors]]:
        """Return the best kinematics [F, 3] of one model, and its errors."""
        features, lasts, row, _ = self.driven(actuators)
        windows = self._counted()
        first, end, kind, _ = windows
        rows, width = len(self.time), features.shape[1]

        def by_row(values: Tensor) -> Tensor:
            return torch.zeros(rows, *values.shape[1:], dtype=values.dtype).index_add_(
                0, row, values
            )

        path = se2.path(self.y)
        heading = path[:, 2]
        turn = heading[end] - heading[first]
        of_turn, of_shift = terms_near_zero(self, width)
        rate, turns_left = _regression(windows.sums(by_row(features)), turn, of_turn, windows)
        # The turn of a row by the model, plus the model's error.
        turns = features @ rate
        missed = self.y[:, 2] - by_row(turns)
        turns = turns + (missed / self.time)[row] * lasts
        ended = turns.cumsum(0)
        middle = ended - turns / 2.0
        chord = se2.chord(turns)
        back = -(heading[first] + heading[end]) / 2.0
        moved = se2.rotate(back, path[end, :2] - path[first, :2])
        cos, sin = back.cos()[:, None], back.sin()[:, None]

        def turned(features: Tensor) -> tuple[Tensor, Tensor]:
            """Return windows' displacements by the features as forward motion, [W, F] each."""
            parts = (chord * middle.cos())[:, None], (chord * middle.sin())[:, None]
            x, y = (windows.sums(by_row(part * features)) for part in parts)
            return cos * x - sin * y, sin * x + cos * y

        moves = {
            lag: turned(self.late(features, lasts, row, lag)[0] if lag > 0.0 else features)
            for lag in set(self.drift)
        }
        (ahead, aside), (late_ahead, late_aside) = (moves[lag] for lag in self.drift)
        both = torch.cat([torch.cat([ahead, aside]), torch.cat([-late_aside, late_ahead])], 1)
        twice = Windows(*(torch.cat([part, part]) for part in windows))
        twice = twice._replace(kind=torch.cat([kind, kind + len(LENGTHS)]))
        speeds, shifts_left = _regression(both, moved.T.flatten(), of_shift, twice)
        return torch.stack([*speeds.view(2, width), rate], dim=1), [turns_left, shifts_left]


def _regression(
    features: Tensor, target: Tensor, near_zero: Tensor, windows: Windows
) -> tuple[Tensor, Errors]:
    """Return the weights [F] of windows by Student's t, and the errors, [W].

    Args:
        features: [W, F]: of speeds, products and losses.
        target: [W].
        near_zero: how near zero the prior holds a weight, [F], see :func:`terms_near_zero`.
        windows: their kinds and weights.
    """
    kind = windows.kind.unique(return_inverse=True)[1]
    given = (features.T[None], target, near_zero, windows.weight, _PRODUCTS, kind, True)
    weights, (error, size, weight) = regressions(*given)
    return weights[0], Errors(error[0], size[0].expand_as(error[0]), weight)
