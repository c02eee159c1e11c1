"""The drive model: how a robot would move if its actuators followed simple laws.

Each input that a command drives (a wheel's speed, a forward speed, a steering angle) is taken for
an actuator. From the speed p that it has it goes to the speed u that it is told, after a delay,
as a first-order lag whose rate of change is limited; where it slows down or stops the lag may be
another. Static friction holds it for a while where it starts or turns round; within its dead band
it stands, and near full speed it may fall behind in proportion. The speeds, and their products by
pairs, make a body twist, linearly: a differential drive, an omnidirectional base and a car at small
steering angles are all of this form (Siegwart, Nourbakhsh and Scaramuzza 2011, chapter 3).

So the displacement until any instant of a command follows in closed form: while the speeds change,
in :data:`PHASES` pieces of constant twist, and one more for the rest.
What a robot really does differs; the networks learn that difference.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from neurosim.base.se2 import tensors as se2

#: Pieces of constant twist while the speeds change, and how many time constants that lasts.
PHASES, SETTLED = 2, 2.5

#: Static friction holds an actuator that stands; one of this speed, a share, it no longer holds.
MOVING = 0.02

#: Slower is standing: rounding is not to decide which way a wheel moves.
STILL = 1e-9

#: Speeds that differ by less are alike: what is left of an earlier command after seconds, or lost
#: in float32, is not to decide whether a wheel slows down.
ALIKE = 1e-4

#: No piece of a command is shorter, s.
SHORTEST = 1e-3


class Approach(NamedTuple):
    """How actuators come from one speed to another; tensors [B, C].

    Attributes:
        left: what is left of the difference, u minus the speed reached.
        missed: its integral since the command began, s: the way lost.
        settling: when the speed has settled, s.
    """

    left: Tensor
    missed: Tensor
    settling: Tensor


@dataclass(frozen=True)
class DriveModel:
    """Actuators and kinematics of a robot; speeds are shares of an input's largest value.

    Attributes:
        lag: time constants, [C] s.
        slowing: of the lag where the speed falls: a factor, [C].
        braking: of the lag where it is told to stand: a factor, [C].
        rate: the most that a speed changes, [C] 1/s.
        bend: what is missing at full speed, a share, [C].
        stick: what starts or turns round stands for this over the speed it is told, [C] s.
        delay: from a command to the first answer, [1] s.
        kinematics: of the twist (m/s, m/s, rad/s) by speeds and their products, [F, 3].
    """

    lag: Tensor
    slowing: Tensor
    braking: Tensor
    rate: Tensor
    bend: Tensor
    stick: Tensor
    delay: Tensor
    kinematics: Tensor

    #: Laws of each actuator, and all that a drive model consists of.
    LAWS: ClassVar[tuple[str, ...]] = ("lag", "slowing", "braking", "rate", "bend", "stick")
    NAMES: ClassVar[tuple[str, ...]] = (*LAWS, "delay", "kinematics")

    def __post_init__(self) -> None:
        count = len(self.lag)
        shapes = self.shapes(count)
        for field in fields(self):
            value = getattr(self, field.name)
            if tuple(value.shape) != shapes[field.name]:
                raise ValueError(
                    f"{field.name} must be of shape {shapes[field.name]}, not {tuple(value.shape)}"
                )
            object.__setattr__(self, field.name, value.detach().double())
        above = torch.cat([self.lag, self.slowing, self.braking, self.rate])
        if (above <= 0).any() or (torch.cat([self.stick, self.delay]) < 0).any():
            raise ValueError(
                "lag, slowing, braking and rate must be above 0, stick and delay not below"
            )

    @staticmethod
    def shapes(count: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the tensors for so many actuators."""
        each = dict.fromkeys(DriveModel.LAWS, (count,))
        return {**each, "delay": (1,), "kinematics": (features_of(count), 3)}

    def to(self, device: torch.device | str) -> DriveModel:
        """Return the model on another device."""
        return DriveModel(**{name: getattr(self, name).to(device) for name in self.NAMES})

    def shaped(self, command: Tensor) -> Tensor:
        """Return the speeds that commands [..., C], scaled to -1..1, come to in the end."""
        return command * (1.0 - self.bend * command.abs())

    def approach(self, before: Tensor, told: Tensor, time: Tensor) -> Approach:
        """Return how far speeds have come from ``before`` to ``told`` [B, C] after ``time`` [B]."""
        difference, speed = told - before, told.abs().clamp(min=STILL)
        lag = torch.where(speed < before.abs() - ALIKE, self.lag * self.slowing, self.lag)
        lag = torch.where(speed <= STILL, self.lag * self.braking, lag)
        size, linear = difference.abs(), self.rate * lag
        ramp = (size - linear).clamp(min=0.0) / self.rate  # how long the limit holds
        fading = torch.minimum(size, linear)
        # It is held at the instant at which this is left of the difference: at speed 0, or at once.
        then = torch.minimum(size, torch.where(told * before > 0.0, size, speed))
        held = (1.0 - before * told.sign() / MOVING).clamp(0.0, 1.0) * (speed > STILL)
        stands = held * self.stick / speed
        bow = ramp + lag * (fading / then.clamp(min=STILL)).clamp(min=1.0).log()
        zero = torch.where(then < linear, bow, (size - then) / self.rate)
        t = (time.unsqueeze(-1) - self.delay).clamp(min=0.0)
        stood = torch.minimum((t - zero).clamp(min=0.0), stands)
        t = t - stood
        on_ramp = torch.minimum(t, ramp)
        decay = torch.exp(-(t - on_ramp) / lag)
        after = t > ramp
        left = torch.where(after, fading * decay, size - self.rate * on_ramp)
        missed = on_ramp * (size - 0.5 * self.rate * on_ramp)
        missed = missed + torch.where(after, fading * lag * (1.0 - decay), 0.0)
        missed = missed + size * torch.minimum(time.unsqueeze(-1), self.delay) + then * stood
        sign = difference.sign()
        settling = torch.where(size > ALIKE, ramp + SETTLED * lag + stands + self.delay, 0.0)
        return Approach(sign * left, sign * missed, settling)

    def reached(self, before: Tensor, told: Tensor, time: Tensor) -> Tensor:
        """Return the speeds [B, C] after ``time`` [B] s."""
        speed = told - self.approach(before, told, time).left
        # What rounding leaves of the two is no motion; in float64 it is below STILL.
        rounding = 8.0 * torch.finfo(speed.dtype).eps * told.abs()
        return torch.where(speed.abs() < rounding.clamp(min=STILL), 0.0, speed)

    def pieces(self, before: Tensor, told: Tensor, time: Tensor) -> list[Tensor]:
        """Return what each piece of constant twist is linear in, PHASES + 1 tensors [B, F]."""
        settling = self.approach(before, told, time).settling.amax(-1)
        settled = torch.minimum(time, settling.clamp(min=SHORTEST))
        ends = [settled * (k + 1) / PHASES for k in range(PHASES)] + [time]
        found = []
        way, began = torch.zeros_like(told), torch.zeros_like(time)
        for end in ends:
            until = told * end.unsqueeze(-1) - self.approach(before, told, end).missed
            found.append(motion_features(until - way, end - began))
            way, began = until, end
        return found

    def phases(self, before: Tensor, told: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
        """Return the displacement [B, 3] while the speeds change, and the twist of what follows.

        The twist [B, 3] (m, m, rad) is that of all the rest of the time.

        Args:
            before: speeds at the beginning, [B, C].
            told: speeds to come to, [B, C].
            time: since the beginning, [B] s.
        """
        *changing, steady = self.pieces(before, told, time)
        moved = se2.exp(changing[0] @ self.kinematics)
        for piece in changing[1:]:
            moved = se2.compose(moved, se2.exp(piece @ self.kinematics))
        return moved, steady @ self.kinematics


def features_of(count: int) -> int:
    """Return how many numbers a twist is linear in: so many speeds, and their products."""
    return count + count * (count + 1) // 2


def motion_features(way: Tensor, time: Tensor) -> Tensor:
    """Return ways [B, C] of actuators and time times products of mean speeds, [B, F]."""
    count = way.shape[-1]
    time = time.unsqueeze(-1)
    mean = way / time.clamp(min=1e-9)
    products = [mean[:, i] * mean[:, j] for i in range(count) for j in range(i, count)]
    return torch.cat([way, torch.stack(products, dim=-1) * time], dim=-1)
