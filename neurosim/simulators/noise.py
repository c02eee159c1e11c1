r"""What a motion network cannot foresee: noise on displacements, correlated and of varying size.

The noise stands in the frame half way round the command's turn. With the mean displacement
:math:`(\bar p, \bar\theta)` and noise of turn, forward and sideways :math:`(e_t, e_f, e_s)`,

.. math:: \theta = \bar\theta + e_t, \qquad
          p = R(e_t / 2)\, \bar p + R(\theta / 2)\, (e_f, e_s)

so that a turn that came out larger carries the robot round with it. The three are a linear map of
three standardised draws z, a Cholesky decomposition of their covariance (Pourahmadi 1999,
Biometrika 86), which is positive definite whatever its numbers are:

.. math:: e_t = s_t z_t, \qquad e_f = s_f (z_f + c_1 z_t), \qquad
          e_s = s_s (z_s + c_2 z_t + c_3 z_f)

Each ln s is linear in features of the command (how far, how much of a turn, how sudden), each c in
others. The draws z are heavy-tailed: a mixture of normal distributions of different
:data:`WIDTHS`, the same one for all three. Part of them may drift: what lasts for longer than a
command (the ground of one corner, the battery) makes one command's noise resemble that of the
next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import torch
from torch import Tensor

#: The three components of the noise, in the order of every array here.
COMPONENTS = ("turn", "forward", "sideways")

#: Standard deviations of the normal distributions that z is a mixture of.
WIDTHS = (0.5, 1.0, 2.0, 4.0)

#: What ln s is linear in, and what a coupling c is; see :func:`features`.
SCALE_FEATURES = ("one", "travel", "travel_squared", "turn", "forward", "jump", "reversal", "time")
COUPLING_FEATURES = ("one", "product", "turn", "forward")


@dataclass(frozen=True)
class NoiseModel:
    """A learned noise model; all tensors are float64 and on the CPU.

    Attributes:
        unit: [3] root mean square of the mean turn (rad), forward and sideways chord (m): what
            the features measure turns and distances in.
        log_scale: [3, len(SCALE_FEATURES)] of ln s_t (rad), ln s_f and ln s_s (m).
        coupling: [3, len(COUPLING_FEATURES)] of c_1, c_2 and c_3.
        shares: [len(WIDTHS)] of the draws that are so wide; they sum to one.
        drift: [3] share of the variance of z that lasts, of each component.
        memory: [3] correlation of what lasts from one command to the next.
    """

    unit: Tensor
    log_scale: Tensor
    coupling: Tensor
    shares: Tensor
    drift: Tensor
    memory: Tensor

    SHAPES: ClassVar[dict[str, tuple[int, ...]]] = {
        "unit": (3,),
        "log_scale": (3, len(SCALE_FEATURES)),
        "coupling": (3, len(COUPLING_FEATURES)),
        "shares": (len(WIDTHS),),
        "drift": (3,),
        "memory": (3,),
    }

    def __post_init__(self) -> None:
        for name, shape in self.SHAPES.items():
            value = getattr(self, name)
            if tuple(value.shape) != shape:
                raise ValueError(f"noise {name} must be of shape {shape}, not {value.shape}")
            object.__setattr__(self, name, value.detach().cpu().double())
        if (self.unit <= 0).any():
            raise ValueError("noise unit must be above 0")
        if (self.shares < 0).any() or (self.shares.sum() - 1.0).abs() > 1e-6:
            raise ValueError("noise shares must be at least 0 and sum to 1")
        if (self.drift < 0).any() or (self.drift >= 1).any():
            raise ValueError("noise drift must lie in 0..1")
        if (self.memory.abs() > 1).any():
            raise ValueError("noise memory must lie in -1..1")

    @property
    def lasting(self) -> bool:
        """Whether the noise of one command resembles that of the next."""
        return bool((self.drift > 0).any())

    @property
    def power(self) -> float:
        """The variance of a draw z."""
        return float(self.shares @ self.shares.new_tensor(WIDTHS).square())

    def widened(self, factor: Tensor) -> NoiseModel:
        """Return the model with each component [3] as many times as wide."""
        log_scale = self.log_scale.clone()
        log_scale[:, 0] += factor.log()
        return replace(self, log_scale=log_scale)

    def tensors(self) -> dict[str, Tensor]:
        """Return the numbers by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def draw(self, rows: int, steps: int, generator: torch.Generator) -> Tensor:
        """Return the draws z [rows, steps, 3] of trajectories, for :func:`disturb`.

        Along a trajectory they are correlated as the model says; trajectories are independent.
        """
        device = generator.device
        lasting = self.draw_drift(rows, generator)
        draws = []
        for _ in range(steps):
            z, lasting = self.next_draw(lasting, generator)
            draws.append(z)
        if not draws:
            return torch.empty(rows, 0, 3, dtype=torch.float64, device=device)
        return torch.stack(draws, dim=1)

    def draw_drift(self, rows: int, generator: torch.Generator) -> Tensor:
        """Return what lasts, [rows, 3], of robots just put down: standard normal."""
        return torch.randn(
            rows, 3, generator=generator, dtype=torch.float64, device=generator.device
        )

    def next_draw(self, lasting: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return the draws z [B, 3] of one command, and what lasts after it.

        Args:
            lasting: [B, 3] before the command.
            generator: source of the draws.
        """
        draws = {"generator": generator, "dtype": torch.float64, "device": lasting.device}
        memory, drift = self.memory.to(lasting), self.drift.to(lasting)
        fresh = torch.randn(len(lasting), 7, **draws)
        lasting = memory * lasting + (1.0 - memory.square()).sqrt() * fresh[:, :3]
        # A normal draw decides on the width too, so that there is one call to the generator.
        rank = 0.5 * torch.erfc(fresh[:, 6] / math.sqrt(2.0))
        which = torch.bucketize(rank, self.shares.cumsum(0)[:-1].to(lasting))
        own = fresh[:, 3:6] * lasting.new_tensor(WIDTHS)[which].unsqueeze(-1)
        return (1.0 - drift).sqrt() * own + (drift * self.power).sqrt() * lasting, lasting


@dataclass(frozen=True)
class CommandFeatures:
    """How a noise model reads a network's inputs; follows from their names.

    Attributes:
        driven: places of the command's inputs but its duration.
        before: place of the same input before the command, -1 where it is not an input.
        duration: place of the duration, -1 where it is not an input.
    """

    driven: tuple[int, ...]
    before: tuple[int, ...]
    duration: int

    @classmethod
    def of(cls, names: tuple[str, ...]) -> CommandFeatures:
        """Return them for inputs of these names."""
        driven = [n for n in names if not n.startswith("prev_") and n != "duration"]
        before = [names.index("prev_" + n) if "prev_" + n in names else -1 for n in driven]
        duration = names.index("duration") if "duration" in names else -1
        return cls(tuple(names.index(n) for n in driven), tuple(before), duration)


def features(
    unit: Tensor, columns: CommandFeatures, inputs: Tensor, mean: Tensor
) -> tuple[Tensor, Tensor]:
    """Return what the noise's size and coupling depend on.

    Args:
        unit: of the noise model, [3].
        columns: of the inputs.
        inputs: scaled inputs, [B, I].
        mean: mean displacements, [B, 3].

    Returns:
        [B, len(SCALE_FEATURES)] and [B, len(COUPLING_FEATURES)].
    """
    one = torch.ones_like(mean[:, 0])
    duration = inputs[:, columns.duration].clamp(min=0) if columns.duration >= 0 else one
    travel, jump, reversal = 0.0 * one, 0.0 * one, 0.0 * one
    for now, before in zip(columns.driven, columns.before, strict=True):
        u = inputs[:, now]
        v = inputs[:, before] if before >= 0 else u
        travel = travel + u.abs() * duration / len(columns.driven)
        jump = jump + (u - v).abs()
        reversal = reversal + (-u * v).clamp(min=0.0)
    turn, forward, _ = (half_way_frame(mean) / unit).unbind(-1)
    log_travel = (travel + 0.01).log()
    scale = [
        one,
        log_travel,
        log_travel.square(),
        (turn.abs() + 0.02).log(),
        (forward.abs() + 0.02).log(),
        (jump + 0.02).log(),
        reversal.sqrt(),
        (duration + 0.02).log(),
    ]
    coupling = [
        one,
        turn * forward / (turn.square() + forward.square() + 0.01),
        turn / (turn.square() + 0.05).sqrt(),
        forward / (forward.square() + 0.05).sqrt(),
    ]
    return torch.stack(scale, dim=-1), torch.stack(coupling, dim=-1)


def disturb(
    noise: NoiseModel, columns: CommandFeatures, inputs: Tensor, mean: Tensor, z: Tensor
) -> Tensor:
    """Return displacements [B, 3] with noise.

    Args:
        noise: the model.
        columns: of the inputs.
        inputs: scaled inputs, [B, I].
        mean: mean displacements, [B, 3].
        z: draws of :meth:`NoiseModel.draw`, [B, 3].
    """
    scale, coupling = features(noise.unit.to(mean), columns, inputs, mean)
    s = (scale @ noise.log_scale.to(mean).T).exp()
    c = coupling @ noise.coupling.to(mean).T
    t, f, side = (z.to(mean) * orientation(mean)).unbind(-1)
    turn = s[:, 0] * t
    forward = s[:, 1] * (f + c[:, 0] * t)
    sideways = s[:, 2] * (side + c[:, 1] * t + c[:, 2] * f)
    theta = mean[:, 2] + turn
    a = rotate(turn / 2, mean[:, :2])
    b = rotate(theta / 2, torch.stack([forward, sideways], dim=-1))
    return torch.cat([a + b, theta.unsqueeze(-1)], dim=-1)


def orientation(mean: Tensor) -> Tensor:
    """Return the signs [B, 3] that point noise along the motion.

    Wheels that slip turn less and come less far, whichever way they go: what lasts is a share of
    the motion, and not a pull to one side.
    """
    turn, along, _ = torch.copysign(torch.ones_like(mean), half_way_frame(mean)).unbind(-1)
    return torch.stack([turn, along, turn * along], dim=-1)


def half_way_frame(displacement: Tensor) -> Tensor:
    """Return turn, and what lies ahead and to the side as seen from half way round, [B, 3]."""
    turn = displacement[:, 2]
    return torch.cat([turn.unsqueeze(-1), rotate(-turn / 2, displacement[:, :2])], dim=-1)


def residual(mean: Tensor, actual: Tensor) -> Tensor:
    """Return the noise (turn, forward, sideways) [B, 3] that makes ``actual`` of ``mean``.

    Args:
        mean, actual: displacements, [B, 3].
    """
    turn = actual[:, 2] - mean[:, 2]
    moved = actual[:, :2] - rotate(turn / 2, mean[:, :2])
    return torch.cat([turn.unsqueeze(-1), rotate(-actual[:, 2] / 2, moved)], dim=-1)


def standardised(
    noise: NoiseModel, columns: CommandFeatures, inputs: Tensor, mean: Tensor, actual: Tensor
) -> Tensor:
    """Return the draws z [B, 3] that make ``actual`` of ``mean``: undoes :func:`disturb`."""
    scale, coupling = features(noise.unit.to(mean), columns, inputs, mean)
    s = (scale @ noise.log_scale.to(mean).T).exp()
    c = coupling @ noise.coupling.to(mean).T
    t, f, side = (residual(mean, actual) / s).unbind(-1)
    f = f - c[:, 0] * t
    side = side - c[:, 1] * t - c[:, 2] * f
    return torch.stack([t, f, side], dim=-1) * orientation(mean)


def rotate(angle: Tensor, vector: Tensor) -> Tensor:
    """Return vectors [B, 2] turned by angles [B]."""
    cos, sin = angle.cos(), angle.sin()
    x, y = vector.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)
