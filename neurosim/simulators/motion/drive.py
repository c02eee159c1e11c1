r"""The drive model: how a robot would move if its actuators followed simple laws.

Each input that a command drives (a wheel's speed, a forward speed, a steering angle) is taken for
an actuator. A command begins to act after a delay, in which those before it go on to act, each for
as long as it was given. From the speed s that it has an actuator goes to its goal g, which follows
from the command that acts, as a first-order lag whose rate of change is limited:

.. math:: ds/dt = \mathrm{clip}((g - s) / \mathrm{lag}(s, g), -\mathrm{rate}, \mathrm{rate})

The lag is another where the speed is above its goal in magnitude, and where the goal is to stand.
Static friction holds an actuator that starts or turns round until the goal, summed up over time,
has overcome it. Within its dead band it stands; beyond it the goal is a static curve of the
command, forwards and backwards each of its own, which need not rise. The speeds, and their products
by pairs, make a body twist, linearly: a differential drive, an omnidirectional base and a car at
small steering angles are all of this form (Siegwart, Nourbakhsh and Scaramuzza 2011, chapter 3).
A robot that slips in curves, as with skid steering, loses speed in proportion to the rate of turn:
the speeds times the magnitude of one of their linear combinations are part of the twist, too.

So what is under way where a command begins (:class:`Underway`) says all about the commands before
it, and speeds and distances until any instant follow in closed form. The pose does by pieces of
constant twist: while the speeds change, in :data:`PHASES`, and one more for the rest.
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

#: Pieces of constant twist while the speeds change, and how many time constants that lasts.
PHASES, SETTLED = 2, 2.5

#: How many numbers a static curve has beside its slope.
CURVES = 6

#: Static friction holds an actuator that stands; one of this speed, a fraction, it no longer holds.
MOVING = 0.02

#: Slower is standing: rounding is not to decide which way a wheel moves.
STILL = 1e-9

#: Speeds that differ by less are alike: what is left of an earlier command after seconds, or lost
#: in float32, is not to decide whether a wheel slows down.
ALIKE = 1e-4

#: No piece of a command is shorter, s.
SHORTEST = 1e-3

#: Commands that wait for the delay to pass are kept apart if they are given for so long, s;
#: shorter ones become one, which asks for their mean. So a state has a fixed width.
SHORTEST_COMMAND = 0.02

#: A command that acts for longer than this while another waits is cut into :data:`PHASES`, s.
LONG_WAIT = 0.1


class Approach(NamedTuple):
    """How actuators come from one speed to another; tensors [B, C].

    Attributes:
        left: what is left of the difference, the goal minus the speed reached.
        missed: its integral since the approach began, s: the way lost.
        settling: when the speed has settled, s.
        push: how far static friction is overcome, see :class:`Underway`.
    """

    left: Tensor
    missed: Tensor
    settling: Tensor
    push: Tensor


class Underway(NamedTuple):
    """The state of the actuators at the beginning of a command.

    Attributes:
        speed: of the actuators, [B, C].
        push: goals of actuators that stood, summed up over time, [B, C] s, since they last moved or
            were commanded to stand: at ``stick`` an actuator breaks loose.
        goals: of the commands before, the oldest first, [B, N, C].
        acts: when these begin to act, [B, N] s since the command began; what is not above 0 does
            already, and the last of those is what the actuators obey.
    """

    speed: Tensor
    push: Tensor
    goals: Tensor
    acts: Tensor


@dataclass(frozen=True)
class DriveModel:
    """Actuators and kinematics of a robot; speeds are fractions of an input's largest value.

    Attributes:
        lag: time constants, [C] s.
        slowing: of the lag where a speed is above its goal in magnitude: a factor, [C].
        braking: of the lag where it is commanded to stand: a factor, [C].
        rate: the most that a speed changes, [C] 1/s.
        stick: static friction; an actuator that starts or reverses waits stick over its commanded
        speed, [C] s.
        curve: of the speed by the command, coefficients of :func:`curvature`, [C, 6].
        delay: from a command to the first answer, [1] s.
        kinematics: of the twist (m/s, m/s, rad/s) by speeds and their products, [F, 3].
        turning: of what stands for the rate of turn in the losses, by speeds, [C]; zeros if not
            given.
        losses: of the twist by speeds times the magnitude of that, [C, 3]; zeros if not given.
        slots: how many commands may be waiting or acting where another one begins.
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
    slots: int = field(init=False, default=0)

    #: Laws of each actuator, and all that a drive model consists of.
    LAWS: ClassVar[tuple[str, ...]] = ("lag", "slowing", "braking", "rate", "stick")
    NAMES: ClassVar[tuple[str, ...]] = (*LAWS, "curve", "delay", "kinematics", "turning", "losses")

    def __post_init__(self) -> None:
        count = len(self.lag)
        shapes = self.shapes(count)
        for name in self.NAMES:
            value = getattr(self, name)
            if value is None:
                value = self.lag.new_zeros(shapes[name])
            if tuple(value.shape) != shapes[name]:
                raise ValueError(
                    f"{name} must be of shape {shapes[name]}, not {tuple(value.shape)}"
                )
            object.__setattr__(self, name, value.detach().double())
        above = torch.cat([self.lag, self.slowing, self.braking, self.rate])
        if (above <= 0).any() or (torch.cat([self.stick, self.delay]) < 0).any():
            raise ValueError(
                "lag, slowing, braking and rate must be above 0, stick and delay not below"
            )
        slots = math.ceil(float(self.delay) / SHORTEST_COMMAND - 1e-6)
        object.__setattr__(self, "slots", max(slots, int(float(self.delay) > 0.0)))

    @staticmethod
    def shapes(count: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the tensors for so many actuators."""
        each = dict.fromkeys(DriveModel.LAWS, (count,))
        rest = {"curve": (count, CURVES), "delay": (1,), "kinematics": (features_of(count), 3)}
        return {**each, **rest, "turning": (count,), "losses": (count, 3)}

    @property
    def twists(self) -> Tensor:
        """The twist's coefficients of :func:`motion_features`, [K, 3]."""
        return torch.cat([self.kinematics, self.losses])

    def to(self, device: torch.device | str) -> DriveModel:
        """Return the model on another device."""
        return DriveModel(**{name: getattr(self, name).to(device) for name in self.NAMES})

    def shaped(self, command: Tensor) -> Tensor:
        """Return the speeds that commands [..., C], scaled to -1..1, come to in the end."""
        return command * (1.0 + (curvature(command) * self.curve).sum(-1))

    def begun(self, speed: Tensor, goal: Tensor | None = None) -> Underway:
        """Return the state at ``speed`` [B, C] with a single command acting.

        Args:
            speed: of the actuators.
            goal: of the command that acts, [B, C]; None: to go on at that speed.
        """
        waits = int(self.slots > 0)
        goals = (speed if goal is None else goal).unsqueeze(1)[:, :waits]
        acts = speed.new_zeros(len(speed), waits)
        return Underway(speed, torch.zeros_like(speed), goals, acts)

    def approach(
        self, before: Tensor, goal: Tensor, time: Tensor, push: Tensor | None = None
    ) -> Approach:
        """Return how far speeds have come from ``before`` to ``goal`` [B, C] after ``time`` [B].

        There is no delay in it: ``goal`` is that of the command that acts.
        """
        push = torch.zeros_like(before) if push is None else push
        difference, speed = goal - before, goal.abs().clamp(min=STILL)
        size, moves = difference.abs(), speed > STILL
        above = speed < before.abs() - ALIKE
        slow = self.lag * torch.where(moves, self.slowing, self.braking)
        lag = torch.where(above | ~moves, slow, self.lag)
        # From a higher speed the other way round it comes to its goal's magnitude first.
        turns = moves & (before * goal < 0.0)
        first = turns & above
        since = torch.where(first, 2.0 * speed, size)
        linear = self.rate * slow
        fast = ((size - linear).clamp(min=0.0) - (since - linear).clamp(min=0.0)) / self.rate
        fast = torch.where(first, fast, 0.0)
        faded = torch.minimum(size, linear) / torch.minimum(since, linear).clamp(min=STILL)
        until = torch.where(first, fast + slow * faded.clamp(min=1.0).log(), 0.0)
        lag = torch.where(first, self.lag, lag)
        # It is held at the instant at which this is left of the difference: at speed 0, or at once.
        then = torch.minimum(since, torch.where(goal * before > 0.0, since, speed))
        push = torch.where(turns & (before.abs() > STILL), 0.0, push)
        held = (1.0 - before * goal.sign() / MOVING).clamp(0.0, 1.0)
        starts = moves & (turns | (before.abs() < speed))
        stands = (held * self.stick - push).clamp(min=0.0) * starts / speed
        linear = self.rate * lag
        ramp = (since - linear).clamp(min=0.0) / self.rate  # how long the limit holds
        bow = torch.minimum(since, linear) / then.clamp(min=STILL)
        zero = ramp + lag * bow.clamp(min=1.0).log()
        zero = torch.where(then < linear, zero, (since - then) / self.rate)
        t = time.unsqueeze(-1)
        left, missed = self._fallen(size, slow, torch.minimum(t, until))
        rest = (t - until).clamp(min=0.0)
        stood = torch.minimum((rest - zero).clamp(min=0.0), stands)
        later, more = self._fallen(since, lag, rest - stood)
        left = torch.where(t < until, left, later)
        missed = torch.where(first, missed, 0.0) + more + then * stood
        settling = torch.where(size > ALIKE, fast + ramp + SETTLED * lag + stands, 0.0)
        sign = difference.sign()
        runs = (goal - sign * left).abs() >= MOVING
        push = torch.where(moves & ~runs, push + stood * speed, 0.0)
        return Approach(sign * left, sign * missed, settling, push)

    def _fallen(self, size: Tensor, lag: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rest of differences after times [B, C], and their integral until then."""
        linear = self.rate * lag
        ramp = (size - linear).clamp(min=0.0) / self.rate
        on_ramp, fading = torch.minimum(time, ramp), torch.minimum(size, linear)
        decay = torch.exp(-(time - on_ramp) / lag)
        after = time > ramp
        left = torch.where(after, fading * decay, size - self.rate * on_ramp)
        missed = on_ramp * (size - 0.5 * self.rate * on_ramp)
        return left, missed + torch.where(after, fading * lag * (1.0 - decay), 0.0)

    def reached(self, under: Underway, commanded: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """Return speeds and push [B, C] after a command ``commanded`` [B, C] of ``time`` s."""
        speed, push = under.speed, under.push
        for goal, span in self._turns(under, commanded, time):
            approach = self.approach(speed, goal, span, push)
            speed, push = self._come(speed, goal, span, push, approach)
        return speed, push

    def _turns(
        self, under: Underway, commanded: Tensor, time: Tensor
    ) -> list[tuple[Tensor, Tensor]]:
        """Return the goals [B, C] that act one after the other, and for how long, [B] s each."""
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
        # What rounding leaves of the two is no motion; in float64 it is below STILL.
        rounding = 8.0 * torch.finfo(speed.dtype).eps * goal.abs()
        speed = torch.where(speed.abs() < rounding.clamp(min=STILL), 0.0, speed)
        return torch.where(acts, speed, before), torch.where(acts, approach.push, push)

    def after(
        self, under: Underway, commanded: Tensor, time: Tensor, reached: tuple[Tensor, Tensor]
    ) -> Underway:
        """Return the state at the end of a command.

        Args:
            under: where it began.
            commanded: its goals, [B, C].
            time: how long it was given, [B] s.
            reached: of :meth:`reached`.
        """
        if not self.slots:
            return Underway(*reached, under.goals, under.acts)
        delay = self.delay.to(time).expand_as(time)
        acts = torch.cat([under.acts, delay.unsqueeze(1)], 1) - time.unsqueeze(1)
        goals = torch.cat([under.goals, commanded.unsqueeze(1)], 1)
        # The oldest is forgotten, unless it acts: then, and where both are short, the newest two
        # become one.
        lasts = acts[:, -1] - acts[:, -2]
        short = (torch.maximum(time, lasts) < SHORTEST_COMMAND * (1.0 - 1e-6)) & (acts[:, -2] > 0)
        join = ((acts[:, 1] > 0.0) | short).unsqueeze(1)
        waited = (acts[:, -1] - acts[:, -2].clamp(min=0.0)).clamp(min=0.0)
        fraction = (waited / (waited + time).clamp(min=1e-9)).unsqueeze(1)
        mean = fraction * goals[:, -2] + (1.0 - fraction) * commanded
        joined = torch.cat([goals[:, :-2], mean.unsqueeze(1)], 1)
        goals = torch.where(join.unsqueeze(2), joined, goals[:, 1:])
        return Underway(*reached, goals, torch.where(join, acts[:, :-1], acts[:, 1:]))

    def pieces(self, under: Underway, commanded: Tensor, time: Tensor) -> list[Tensor]:
        """Return the features of each piece of constant twist, tensors [B, K].

        The last is that after the speeds have settled; before it come :data:`PHASES` of each
        command that acts.
        """
        pieces = []
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
    ) -> list[Tensor]:
        """Return the features of the twists from one instant [B] to the next, [B, K] each.

        The last is that until ``time`` [B], of which the approach is ``end``.
        """
        pieces = []
        before, began = torch.zeros_like(goal), torch.zeros_like(time)
        missed = [self.approach(speed, goal, one, push).missed for one in instants]
        for until, lost in zip((*instants, time), (*missed, end.missed), strict=True):
            distances = goal * until.unsqueeze(-1) - lost
            pieces.append(motion_features(distances - before, until - began, self.turning))
            before, began = distances, until
        return pieces

    def phases(self, under: Underway, commanded: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """Return the displacement [B, 3] while the speeds change, and the twist of what follows.

        The twist [B, 3] (m, m, rad) is that of all the rest of the time.

        Args:
            under: at the beginning.
            commanded: goals of the command, [B, C].
            time: since the beginning, [B] s.
        """
        *changing, steady = self.pieces(under, commanded, time)
        twists = self.twists
        moved = se2.exp(changing[0] @ twists)
        for piece in changing[1:]:
            moved = se2.compose(moved, se2.exp(piece @ twists))
        return moved, steady @ twists


def curvature(command: Tensor) -> Tensor:
    """Return by what goals differ from commands [..., C], as fractions of these, [..., C, 6].

    They are |u|, |u|^2, |u|^3 and, of opposite sign forwards and backwards, 1, |u|, |u|^2.
    """
    size, sign = command.abs().clamp(max=1.0), command.sign()
    square = size * size
    return torch.stack([size, square, size * square, sign, sign * size, sign * square], -1)


def features_of(count: int) -> int:
    """Return how many numbers a twist is linear in: so many speeds, and their products."""
    return count + count * (count + 1) // 2


def terms_of(count: int) -> int:
    """Return how many numbers a twist is linear in: these, and losses of so many speeds."""
    return features_of(count) + count


def motion_features(distance: Tensor, time: Tensor, turning: Tensor) -> Tensor:
    """Return the features in which twists are linear, [B, K].

    Distances, time times products of mean speeds by pairs, and distances times the magnitude of
    the speeds' combination that stands for the rate of turn.

    Args:
        distance: distances of actuators, [B, C].
        time: that they took, [B] s.
        turning: of the combination, [C].
    """
    count = distance.shape[-1]
    time = time.unsqueeze(-1)
    mean = distance / time.clamp(min=1e-9)
    products = [mean[:, i] * mean[:, j] for i in range(count) for j in range(i, count)]
    lost = distance * (mean @ turning).abs().unsqueeze(-1)
    return torch.cat([distance, torch.stack(products, dim=-1) * time, lost], dim=-1)
