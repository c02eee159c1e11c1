r"""The drive model: the motion of a robot whose actuators follow simple laws.

Each driven input (a wheel's speed, a forward speed, a steering angle) counts as an actuator. A
command begins to act after a delay; until then the earlier ones act, each for its duration. An
actuator's speed s approaches its goal g, which the acting command sets, with a first-order lag and
a limited rate of change:

.. math:: ds/dt = \mathrm{clip}((g - s) / \mathrm{lag}(s, g), -\mathrm{rate}, \mathrm{rate})

The lag has another value if the magnitude of the speed is above that of the goal, and if the goal
is 0. Static friction holds an actuator that starts or reverses until the integral of the goal has
overcome it. Within its dead band it stands; beyond it the goal is a static curve of the command,
separate for forwards and backwards, which need not rise. Where the body is slower than its
actuators, as that of a boat is, s and g are those of modes, linear combinations of the actuators'
goals: of forward motion, and of the turn. Its drag may grow with the speed, too (Fossen 2011,
section 6.4): then g is the speed at which drag equals the commanded force, and the difference falls
1 + drag (|s| + |g|) times as fast up to the rate. Where s and g differ in sign, that
sum is :math:`(g^2 + s^2) / (|g| + |s|)`; it is replaced by |g|, and while |s| > |g| by the mean of
both, within a sixth, so that all stays in closed form. The speeds, and their products by pairs,
make a body twist, linearly: a differential drive, an omnidirectional base and a car at small
steering angles are all of this form (Siegwart, Nourbakhsh and Scaramuzza 2011, chapter 3).
A robot that slips in curves, as with skid steering, loses speed in proportion to the rate of turn:
the speeds times the magnitude of one of their linear combinations are part of the twist, too.
A ship that turns drifts outwards and loses speed, but not at once (Fossen 2011, section 6.5): what
products and losses add to its velocity, ahead and aside, comes with lags of its own, from piece to
piece.

So the actuators' state at the beginning of a command (:class:`Underway`) has all effects of the
earlier commands, and speeds and distances at any instant follow in closed form. The pose follows
from pieces of constant twist: :data:`PHASES` while the speeds change, and one more for the rest.
The real motion differs; the networks learn that difference.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from neurosim.base.se2 import tensors as se2

#: Number of pieces of constant twist while the speeds change, and their duration in time constants.
PHASES, SETTLED = 2, 2.5

#: Number of coefficients of a static curve in addition to its slope.
CURVES = 6

#: Speed, as a fraction, from which static friction no longer holds an actuator.
MOVING = 0.02

#: Speed below which an actuator stands, so that rounding does not decide a wheel's direction.
STILL = 1e-9

#: Difference below which speeds count as equal, so that remainders of earlier commands and rounding
#: in float32 do not decide whether a wheel slows down.
ALIKE = 1e-4

#: Shortest piece of a command, s.
SHORTEST = 1e-3

#: Shortest duration of a pending command that is kept separately, s; shorter ones become one
#: command with their mean. So a state has a fixed width.
SHORTEST_COMMAND = 0.02

#: Time after which a command that acts while another waits is cut into :data:`PHASES`, s.
LONG_WAIT = 0.1


#: Curvature of a fall below which it is straight.
CURVED = 1e-12


class Approach(NamedTuple):
    """The approach of actuators from one speed to another; tensors [B, C].

    Attributes:
        left: remaining difference, the goal minus the speed reached.
        missed: its integral since the approach began, s: the lost distance.
        settling: time at which the speed has settled, s.
        push: progress against static friction, see :class:`Underway`.
    """

    left: Tensor
    missed: Tensor
    settling: Tensor
    push: Tensor


class Underway(NamedTuple):
    """The state of the actuators at the beginning of a command.

    Attributes:
        speed: of the actuators, [B, C].
        push: integral of the goals of standing actuators, [B, C] s, since they last moved or were
            commanded to stand: at ``stick`` an actuator begins to move.
        goals: of the earlier commands, the oldest first, [B, N, C].
        acts: times at which these begin to act, [B, N] s since the command began. Those at 0 or
            below act already; the actuators follow the last of them.
        drift: velocity by products and losses, [B, 2] m/s; [B, 0] if it has no lags of its own.
    """

    speed: Tensor
    push: Tensor
    goals: Tensor
    acts: Tensor
    drift: Tensor


class Piece(NamedTuple):
    """A piece of constant twist.

    Attributes:
        features: in which the twist is linear, see :func:`motion_features`, [B, K].
        lasts: its duration, [B] s.
    """

    features: Tensor
    lasts: Tensor


class Reached(NamedTuple):
    """The state of the actuators at the end of a command: parts of :class:`Underway`."""

    speed: Tensor
    push: Tensor
    drift: Tensor


@dataclass(frozen=True)
class DriveModel:
    """Actuators and kinematics of a robot; speeds are fractions of an input's largest value.

    Attributes:
        lag: time constants, [C] s.
        slowing: factor of the lag if a speed is above its goal in magnitude, [C].
        braking: factor of the lag if the goal is to stand, [C].
        rate: largest rate of change of a speed, [C] 1/s.
        stick: static friction; an actuator that starts or reverses waits stick over its commanded
        speed, [C] s.
        curve: coefficients of :func:`curvature` for the speed by the command, [C, 6].
        delay: from a command to its first effect, [1] s.
        kinematics: of the twist (m/s, m/s, rad/s) by speeds and their products, [F, 3].
        turning: combination of speeds that represents the rate of turn in the losses, [C]; zeros by
            default.
        losses: of the twist by speeds times the magnitude of this combination, [C, 3]; zeros by
            default.
        modes: goals of the laws by goals of the actuators, [C, C]; by default the laws are those of
            the actuators.
        drag: quadratic drag, as a fraction of linear drag at full speed, [C]; zeros by default.
        drift: time constants of the velocity ahead and aside by products and losses, [2] s; 0, the
            default: no lag.
        slots: largest number of pending or acting commands when another one begins.
    """

    lag: Tensor
    slowing: Tensor
    braking: Tensor
    rate: Tensor
    stick: Tensor
    curve: Tensor
    delay: Tensor
    kinematics: Tensor
    turning: Tensor = None  # type: ignore[assignment]
    losses: Tensor = None  # type: ignore[assignment]
    modes: Tensor = None  # type: ignore[assignment]
    drag: Tensor = None  # type: ignore[assignment]
    drift: Tensor = None  # type: ignore[assignment]
    slots: int = field(init=False, default=0)
    drifts: bool = field(init=False, default=False)
    _drags: bool = field(init=False, default=False)

    #: Laws of each actuator, and all tensors of a drive model.
    LAWS: ClassVar[tuple[str, ...]] = ("lag", "slowing", "braking", "rate", "stick")
    NAMES: ClassVar[tuple[str, ...]] = (
        *(*LAWS, "curve", "delay", "kinematics", "turning", "losses", "modes", "drag", "drift"),
    )

    def __post_init__(self) -> None:
        count = len(self.lag)
        shapes = self.shapes(count)
        for name in self.NAMES:
            value = getattr(self, name)
            if value is None:
                value = self.lag.new_zeros(shapes[name])
                value = torch.eye(count) if name == "modes" else value
            if tuple(value.shape) != shapes[name]:
                raise ValueError(
                    f"{name} must be of shape {shapes[name]}, not {tuple(value.shape)}"
                )
            object.__setattr__(self, name, value.detach().double())
        above = torch.cat([self.lag, self.slowing, self.braking, self.rate])
        others = torch.cat([self.stick, self.delay, self.drag, self.drift])
        if (above <= 0).any() or (others < 0).any():
            raise ValueError(
                "lag, slowing, braking and rate must be above 0, the other times and drag not below"
            )
        object.__setattr__(self, "_drags", bool((self.drag > 0.0).any()))
        object.__setattr__(self, "drifts", bool((self.drift > 0.0).any()))
        slots = math.ceil(float(self.delay) / SHORTEST_COMMAND - 1e-6)
        object.__setattr__(self, "slots", max(slots, int(float(self.delay) > 0.0)))

    @staticmethod
    def shapes(count: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the tensors for a number of actuators."""
        each = dict.fromkeys(DriveModel.LAWS, (count,))
        rest = {"curve": (count, CURVES), "delay": (1,), "kinematics": (features_of(count), 3)}
        rest |= {"turning": (count,), "losses": (count, 3), "modes": (count, count)}
        return {**each, **rest, "drag": (count,), "drift": (2,)}

    @property
    def twists(self) -> Tensor:
        """The twist's coefficients of :func:`motion_features`, [K, 3]."""
        return torch.cat([self.kinematics, self.losses])

    def to(self, device: torch.device | str) -> DriveModel:
        """Return the model on another device."""
        return DriveModel(**{name: getattr(self, name).to(device) for name in self.NAMES})

    def shaped(self, command: Tensor) -> Tensor:
        """Return the final speeds of commands [..., C], scaled to -1..1."""
        force = command * (1.0 + (curvature(command) * self.curve).sum(-1)) @ self.modes.T
        root = (1.0 + 4.0 * self.drag * (1.0 + self.drag) * force.abs()).sqrt()
        return 2.0 * (1.0 + self.drag) * force / (1.0 + root)

    @property
    def memory(self) -> float:
        """The longest lag, s: for how long the motion depends on earlier commands."""
        slowest = self.lag * (self.slowing * self.braking.clamp(min=1.0)).clamp(min=1.0)
        return float(torch.cat([slowest, self.drift]).max())

    def begun(
        self, speed: Tensor, goal: Tensor | None = None, drift: Tensor | None = None
    ) -> Underway:
        """Return the state at ``speed`` [B, C] with a single command acting.

        Args:
            speed: of the actuators.
            goal: of the acting command, [B, C]; None: to continue at that speed.
            drift: as in :class:`Underway`; None: what it is at lasting speeds.
        """
        waits = int(self.slots > 0)
        goals = (speed if goal is None else goal).unsqueeze(1)[:, :waits]
        acts = speed.new_zeros(len(speed), waits)
        if drift is None:
            steady = motion_features(speed, torch.ones_like(speed[:, 0]), self.turning)
            drift = self._late(steady)[:, : 2 * self.drifts]
        return Underway(speed, torch.zeros_like(speed), goals, acts, drift)

    def approach(
        self, before: Tensor, goal: Tensor, time: Tensor, push: Tensor | None = None
    ) -> Approach:
        """Return the approach of speeds from ``before`` to ``goal`` [B, C] after ``time`` [B].

        There is no delay: ``goal`` is that of the acting command.
        """
        push = torch.zeros_like(before) if push is None else push
        difference, speed = goal - before, goal.abs().clamp(min=STILL)
        size, moves = difference.abs(), speed > STILL
        # Without drag there is less to compute, and to export.
        drag = self.drag if self._drags else 0.0
        above = speed < before.abs() - ALIKE
        slow = self.lag * torch.where(moves, self.slowing, self.braking)
        lag = torch.where(above | ~moves, slow, self.lag)
        # From a higher speed in the other direction it first reaches its goal's magnitude.
        turns = moves & (before * goal < 0.0)
        first = turns & above
        since = torch.where(first, 2.0 * speed, size)
        until, fast = self._takes(size, since, slow, 1.0, drag / 2.0)
        until, fast = (torch.where(first, one, 0.0) for one in (until, fast))
        lag = torch.where(first, self.lag, lag)
        # Then its speed becomes 0; friction holds it when this difference remains, or at once.
        then, against = torch.where(turns, speed, since), 1.0 + drag * speed
        zero = torch.where(turns, self._takes(since, then, lag, against)[0], 0.0)
        push = torch.where(turns & (before.abs() > STILL), 0.0, push)
        held = (1.0 - before * goal.sign() / MOVING).clamp(0.0, 1.0)
        starts = moves & (turns | (before.abs() < speed))
        stands = (held * self.stick - push).clamp(min=0.0) * starts / speed
        along = torch.where(~turns & (before.abs() > speed), drag, -drag) if self._drags else 0.0
        t = time.unsqueeze(-1)
        left, missed = self._fallen(size, slow, torch.minimum(t, until), 1.0, drag / 2.0)
        rest = (t - until).clamp(min=0.0)
        sooner, more = self._fallen(since, lag, torch.minimum(rest, zero), against)
        stood = torch.minimum((rest - zero).clamp(min=0.0), stands)
        moving = ((rest - zero).clamp(min=0.0) - stood).clamp(min=0.0)
        later, most = self._fallen(then, lag, moving, 1.0 + 2.0 * drag * speed, along)
        left = torch.where(t < until, left, torch.where(rest < zero, sooner, later))
        missed = missed + more + then * stood + most
        ramp = (since - self._unlimited(lag, against, 0.0)).clamp(min=0.0) / self.rate
        settling = fast + ramp + SETTLED * lag / against + stands
        settling = torch.where(size > ALIKE, settling, 0.0)
        sign = difference.sign()
        runs = (goal - sign * left).abs() >= MOVING
        push = torch.where(moves & ~runs, push + stood * speed, 0.0)
        return Approach(sign * left, sign * missed, settling, push)

    def _takes(
        self,
        size: Tensor,
        less: Tensor,
        lag: Tensor,
        first: Tensor | float,
        growth: Tensor | float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        """Return the times in which differences fall to smaller ones, and those on the ramp."""
        linear = self._unlimited(lag, first, growth)
        ramp = ((size - linear).clamp(min=0.0) - (less - linear).clamp(min=0.0)) / self.rate
        size, less = torch.minimum(size, linear), torch.minimum(less, linear).clamp(min=STILL)
        ratio = size * (first + growth * less) / (less * (first + growth * size))
        return ramp + lag / first * ratio.clamp(min=1.0).log(), ramp

    def _unlimited(self, lag: Tensor, first: Tensor | float, growth: Tensor | float) -> Tensor:
        """Return the differences from which the rate no longer limits their fall."""
        limit = self.rate * lag
        if not self._drags:
            return limit
        square = first * first + 4.0 * growth * limit
        linear = 2.0 * limit / (first + torch.as_tensor(square).clamp(min=0.0).sqrt())
        return torch.where(torch.as_tensor(square) < 0.0, torch.inf, linear)

    def _fallen(
        self,
        size: Tensor,
        lag: Tensor,
        time: Tensor,
        first: Tensor | float,
        growth: Tensor | float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        """Return the remaining differences after times [B, C], and their integral until then.

        A difference e falls as de/dt = -e (first + growth e) / lag, but not faster than the rate.
        """
        linear = self._unlimited(lag, first, growth)
        ramp = (size - linear).clamp(min=0.0) / self.rate
        on_ramp, fading = torch.minimum(time, ramp), torch.minimum(size, linear)
        decay = torch.exp(-(time - on_ramp) * first / lag)
        ramped, after = on_ramp * (size - 0.5 * self.rate * on_ramp), time > ramp
        if not self._drags:
            left = torch.where(after, fading * decay, size - self.rate * on_ramp)
            return left, ramped + torch.where(after, fading * lag * (1.0 - decay), 0.0)
        share = fading / (first + growth * fading) * decay
        left = first * share / (1.0 - growth * share)
        fell = (fading - left) / (first + growth * left)
        curved = growth * fell
        known = curved.abs() > CURVED
        fell = fell * torch.where(known, curved.log1p() / torch.where(known, curved, 1.0), 1.0)
        left = torch.where(after, left, size - self.rate * on_ramp)
        return left, ramped + torch.where(after, lag * fell, 0.0)

    def reached(self, under: Underway, commanded: Tensor, time: Tensor) -> Reached:
        """Return the actuators' state after a command of ``time`` s with goals [B, C]."""
        speed, push = under.speed, under.push
        for goal, span in self._turns(under, commanded, time):
            approach = self.approach(speed, goal, span, push)
            speed, push = self._come(speed, goal, span, push, approach)
        drift = self._twists(under, commanded, time)[1] if self.drifts else under.drift
        return Reached(speed, push, drift)

    def _turns(
        self, under: Underway, commanded: Tensor, time: Tensor
    ) -> list[tuple[Tensor, Tensor]]:
        """Return the goals [B, C] that act one after the other, and their durations, [B] s each."""
        delay = self.delay.to(time).expand_as(time)
        begins = [*under.acts.clamp(min=0.0).unbind(1), delay] if self.slots else [0.0 * time]
        ends = [torch.minimum(one, time) for one in (*begins[1:], time)]
        goals = (*under.goals.unbind(1), commanded) if self.slots else (commanded,)
        spans = [(end - begin).clamp(min=0.0) for begin, end in zip(begins, ends, strict=True)]
        turns = list(zip(goals, spans, strict=True))
        if torch.compiler.is_compiling():
            return turns
        return [turn for turn in turns[:-1] if (turn[1] > 0.0).any()] + turns[-1:]

    def _come(
        self, before: Tensor, goal: Tensor, time: Tensor, push: Tensor, approach: Approach
    ) -> tuple[Tensor, Tensor]:
        """Return speeds and push [B, C] after ``time`` [B], see :meth:`approach`."""
        acts, speed = time.unsqueeze(-1) > 0.0, goal - approach.left
        # The remainder after rounding is not motion; in float64 it is below STILL.
        rounding = 8.0 * torch.finfo(speed.dtype).eps * goal.abs()
        speed = torch.where(speed.abs() < rounding.clamp(min=STILL), 0.0, speed)
        return torch.where(acts, speed, before), torch.where(acts, approach.push, push)

    def after(self, under: Underway, commanded: Tensor, time: Tensor, reached: Reached) -> Underway:
        """Return the state at the end of a command.

        Args:
            under: the state at its beginning.
            commanded: its goals, [B, C].
            time: its duration, [B] s.
            reached: result of :meth:`reached`.
        """
        speed, push, drift = reached
        if not self.slots:
            return Underway(speed, push, under.goals, under.acts, drift)
        delay = self.delay.to(time).expand_as(time)
        acts = torch.cat([under.acts, delay.unsqueeze(1)], 1) - time.unsqueeze(1)
        goals = torch.cat([under.goals, commanded.unsqueeze(1)], 1)
        # The oldest is dropped unless it acts; then, or if both are short, the newest two become
        # one.
        lasts = acts[:, -1] - acts[:, -2]
        short = (torch.maximum(time, lasts) < SHORTEST_COMMAND * (1.0 - 1e-6)) & (acts[:, -2] > 0)
        join = ((acts[:, 1] > 0.0) | short).unsqueeze(1)
        waited = (acts[:, -1] - acts[:, -2].clamp(min=0.0)).clamp(min=0.0)
        fraction = (waited / (waited + time).clamp(min=1e-9)).unsqueeze(1)
        mean = fraction * goals[:, -2] + (1.0 - fraction) * commanded
        joined = torch.cat([goals[:, :-2], mean.unsqueeze(1)], 1)
        goals = torch.where(join.unsqueeze(2), joined, goals[:, 1:])
        acts = torch.where(join, acts[:, :-1], acts[:, 1:])
        return Underway(speed, push, goals, acts, drift)

    def pieces(self, under: Underway, commanded: Tensor, time: Tensor) -> list[Piece]:
        """Return the pieces of constant twist of a command.

        The last piece is after the speeds have settled; before it there are :data:`PHASES` for each
        acting command.
        """
        pieces: list[Piece] = []
        speed, push = under.speed, under.push
        *waiting, (_, own) = self._turns(under, commanded, time)
        for goal, span in waiting:
            end = self.approach(speed, goal, span, push)
            first = torch.where(span > LONG_WAIT, span / PHASES, 0.0)
            instants = [first * k for k in range(1, PHASES)]
            pieces += self._distances(speed, push, goal, instants, span, end)
            speed, push = self._come(speed, goal, span, push, end)
        end = self.approach(speed, commanded, own, push)
        settled = torch.minimum(own, end.settling.amax(-1).clamp(min=SHORTEST))
        instants = [settled * (k + 1) / PHASES for k in range(PHASES)]
        return pieces + self._distances(speed, push, commanded, instants, own, end)

    def _distances(
        self,
        speed: Tensor,
        push: Tensor,
        goal: Tensor,
        instants: Sequence[Tensor],
        time: Tensor,
        end: Approach,
    ) -> list[Piece]:
        """Return the pieces from one instant [B] to the next.

        The last instant is ``time`` [B], whose approach is ``end``.
        """
        pieces = []
        before, began = torch.zeros_like(goal), torch.zeros_like(time)
        missed = [self.approach(speed, goal, one, push).missed for one in instants]
        for until, lost in zip((*instants, time), (*missed, end.missed), strict=True):
            distances = goal * until.unsqueeze(-1) - lost
            lasts = until - began
            pieces.append(Piece(motion_features(distances - before, lasts, self.turning), lasts))
            before, began = distances, until
        return pieces

    def phases(self, under: Underway, commanded: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """Return the displacement [B, 3] while the speeds change, and the twist of the rest.

        The twist [B, 3] (m, m, rad) is that of the whole remaining time.

        Args:
            under: the state at the beginning.
            commanded: goals of the command, [B, C].
            time: since the beginning, [B] s.
        """
        *changing, steady = self._twists(under, commanded, time)[0]
        moved = se2.exp(changing[0])
        for twist in changing[1:]:
            moved = se2.compose(moved, se2.exp(twist))
        return moved, steady

    def _twists(
        self, under: Underway, commanded: Tensor, time: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Return the twists [B, 3] of a command's pieces, each of its time, and the last drift."""
        twists, drift = [], under.drift
        for features, lasts in self.pieces(under, commanded, time):
            twist = features @ self.twists
            if self.drifts:
                lasts = lasts.unsqueeze(1).clamp(min=1e-9)
                steady = self._late(features) / lasts
                then = steady + (drift - steady) * torch.exp(-lasts / self.drift)
                moved = twist[:, :2] - self.drift * (then - drift)
                twist, drift = torch.cat([moved, twist[:, 2:]], 1), then
            twists.append(twist)
        return twists, drift

    def _late(self, features: Tensor) -> Tensor:
        """Return the part of twists' translation [B, 2] by products and losses."""
        count = len(self.lag)
        return features[:, count:] @ self.twists[count:, :2]


def curvature(command: Tensor) -> Tensor:
    """Return features of the goals' deviation from commands [..., C], as fractions, [..., C, 6].

    They are |u|, |u|^2, |u|^3 and, of opposite sign forwards and backwards, 1, |u|, |u|^2.
    """
    size, sign = command.abs().clamp(max=1.0), command.sign()
    square = size * size
    return torch.stack([size, square, size * square, sign, sign * size, sign * square], -1)


def features_of(count: int) -> int:
    """Return the number of features of a twist for ``count`` speeds: these, and their products."""
    return count + count * (count + 1) // 2


def terms_of(count: int) -> int:
    """Return the number of terms of a twist for ``count`` speeds: features, and losses."""
    return features_of(count) + count


def motion_features(distance: Tensor, time: Tensor, turning: Tensor) -> Tensor:
    """Return the features in which twists are linear, [B, K].

    They are distances, time times products of pairs of mean speeds, and distances times the
    magnitude of the combination of speeds that represents the rate of turn.

    Args:
        distance: distances of actuators, [B, C].
        time: their duration, [B] s.
        turning: coefficients of the combination, [C].
    """
    count = distance.shape[-1]
    time = time.unsqueeze(-1)
    mean = distance / time.clamp(min=1e-9)
    products = [mean[:, i] * mean[:, j] for i in range(count) for j in range(i, count)]
    lost = distance * (mean @ turning).abs().unsqueeze(-1)
    return torch.cat([distance, torch.stack(products, dim=-1) * time, lost], dim=-1)
