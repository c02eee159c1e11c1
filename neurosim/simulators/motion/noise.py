r"""What a motion network cannot foresee: noise on displacements, correlated and of varying size.

The noise stands in the mid-turn frame (see :mod:`neurosim.base.se2`). With the mean displacement
:math:`(\bar p, \bar\theta)` and noise of turn, forward and sideways :math:`(e_t, e_f, e_s)`,

.. math:: \theta = \bar\theta + e_t, \qquad
          p = R(e_t / 2)\, \bar p + R(\theta / 2)\, (e_f, e_s)

so that a turn that came out larger carries the robot round with it. The three are a linear map of
standard normal draws z, a Cholesky decomposition of their covariance (Pourahmadi 1999, Biometrika
86), which is positive definite whatever its numbers:

.. math:: e_t = S_t z_t, \qquad e_f = S_f (z_f + c_1 z_t), \qquad
          e_s = S_s (z_s + c_2 z_t + c_3 z_f)

Each c is linear in features of the command. A size S is of two parts, whose variances add up:

.. math:: S^2 = s^2 e^{2 \tau g} + r^2

What happens in the course of the motion, as slip does, has variance :math:`r^2`, linear in the
squares of turn and distance. What else there is has heavy tails, as if its scale itself were
uncertain (Clark 1973, Econometrica 41): g is standard normal, the same for all three, and ln s and
:math:`\ln \tau` are linear in features of the command (how far, how much of a turn, how sudden,
how fast the motors ran before it: where they stood, the motion before that, which no input tells,
has left the caster in some direction).
A product of features alone would say that a robot that goes straight ahead hardly strays, and
plans would be looked for where it says so.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import ClassVar

import torch
from torch import Tensor

from neurosim.base.se2 import tensors as se2

#: The three components of the noise, in the order of every array here.
COMPONENTS = ("turn", "forward", "sideways")

#: Draws of a command: one a component, and g, on which the width of all three depends.
DRAWS = 4

#: The heaviest tails, as :math:`\tau`.
HEAVIEST = 1.5

#: What ln s is linear in, what a coupling c, and what ln tau; see :func:`features`.
SCALE_FEATURES = (
    "one",
    "travel",
    "travel_squared",
    "turn",
    "forward",
    "jump",
    "reversal",
    "time",
    "before",
)
COUPLING_FEATURES = ("one", "product", "turn", "forward")
#: What r^2 is linear in: the squares of these.
MOTION_FEATURES = ("one", "turn", "forward")
TAIL_FEATURES = ("one", "travel", "turn")


@dataclass(frozen=True)
class NoiseModel:
    """A learned noise model; all tensors are float64 and on the CPU.

    Attributes:
        unit: [3] root mean square of the mean turn (rad), forward and sideways chord (m): what
            the features measure turns and distances in.
        log_scale: [3, len(SCALE_FEATURES)] of ln s_t (rad), ln s_f and ln s_s (m).
        coupling: [3, len(COUPLING_FEATURES)] of c_1, c_2 and c_3.
        tail: [len(TAIL_FEATURES)] of ln tau.
        motion: [3, len(MOTION_FEATURES)] of r_t^2 (rad^2), r_f^2 and r_s^2 (m^2).
    """

    unit: Tensor
    log_scale: Tensor
    coupling: Tensor
    tail: Tensor
    motion: Tensor

    SHAPES: ClassVar[dict[str, tuple[int, ...]]] = {
        "unit": (3,),
        "log_scale": (3, len(SCALE_FEATURES)),
        "coupling": (3, len(COUPLING_FEATURES)),
        "tail": (len(TAIL_FEATURES),),
        "motion": (3, len(MOTION_FEATURES)),
    }

    def __post_init__(self) -> None:
        for name, shape in self.SHAPES.items():
            value = getattr(self, name)
            if tuple(value.shape) != shape:
                raise ValueError(f"noise {name} must be of shape {shape}, not {value.shape}")
            object.__setattr__(self, name, value.detach().cpu().double())
        if (self.unit <= 0).any():
            raise ValueError("noise unit must be above 0")
        if (self.motion < 0).any():
            raise ValueError("noise motion must not be negative")

    def widened(self, factor: Tensor) -> NoiseModel:
        """Return the model with each component [3] as many times as wide."""
        log_scale = self.log_scale.clone()
        log_scale[:, 0] += factor.log()
        motion = self.motion * factor.square().unsqueeze(-1)
        return replace(self, log_scale=log_scale, motion=motion)

    def tensors(self) -> dict[str, Tensor]:
        """Return the numbers by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def draw(self, rows: int, steps: int, generator: torch.Generator) -> Tensor:
        """Return the draws [rows, steps, DRAWS] of trajectories, for :func:`disturb`."""
        return draw(rows, steps, generator)


def draw(rows: int, steps: int, generator: torch.Generator, width: int = DRAWS) -> Tensor:
    """Return standard normal draws [rows, steps, width], on the generator's device."""
    return torch.randn(
        rows, steps, width, generator=generator, dtype=torch.float64, device=generator.device
    )


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
) -> tuple[Tensor, Tensor, Tensor]:
    """Return what the noise's size, coupling and tails depend on.

    Args:
        unit: of the noise model, [3].
        columns: of the inputs.
        inputs: scaled inputs, [B, I].
        mean: mean displacements, [B, 3].

    Returns:
        [B, len(SCALE_FEATURES)], [B, len(COUPLING_FEATURES)] and [B, len(TAIL_FEATURES)].
    """
    one = torch.ones_like(mean[:, 0])
    duration = inputs[:, columns.duration].clamp(min=0) if columns.duration >= 0 else one
    travel = jump = reversal = speed = torch.zeros_like(one)
    for now, before in zip(columns.driven, columns.before, strict=True):
        u = inputs[:, now]
        v = inputs[:, before] if before >= 0 else u
        travel = travel + u.abs() * duration / len(columns.driven)
        jump = jump + (u - v).abs()
        reversal = reversal + (-u * v).clamp(min=0.0)
        speed = speed + v.abs() / len(columns.driven)
    turn, forward, _ = (components(mean) / unit).unbind(-1)
    log_travel = (travel + 0.01).log()
    reverses = reversal > 0.0  # the square root has no gradient at 0
    scale = [
        one,
        log_travel,
        log_travel.square(),
        (turn.abs() + 0.02).log(),
        (forward.abs() + 0.02).log(),
        (jump + 0.02).log(),
        torch.where(reverses, torch.where(reverses, reversal, 1.0).sqrt(), 0.0),
        (duration + 0.02).log(),
        (speed + 0.02).log(),
    ]
    coupling = [
        one,
        turn * forward / (turn.square() + forward.square() + 0.01),
        turn / (turn.square() + 0.05).sqrt(),
        forward / (forward.square() + 0.05).sqrt(),
    ]
    tail = [one, log_travel, scale[SCALE_FEATURES.index("turn")]]
    return torch.stack(scale, dim=-1), torch.stack(coupling, dim=-1), torch.stack(tail, dim=-1)


def disturb(
    noise: NoiseModel, columns: CommandFeatures, inputs: Tensor, mean: Tensor, z: Tensor
) -> Tensor:
    """Return displacements [B, 3] with noise.

    Args:
        noise: the model.
        columns: of the inputs.
        inputs: scaled inputs, [B, I].
        mean: mean displacements, [B, 3].
        z: draws of :meth:`NoiseModel.draw`, [B, DRAWS].
    """
    scale, coupling, tail = features(noise.unit.to(mean), columns, inputs, mean)
    c = coupling @ noise.coupling.to(mean).T
    z = z.to(mean)
    t, f, side = z[:, :3].unbind(-1)
    width = (heaviness(tail, noise.tail.to(mean)) * z[:, 3]).exp()
    s = (scale @ noise.log_scale.to(mean).T).exp() * width.unsqueeze(-1)
    s = (s.square() + in_motion(noise, mean)).sqrt()
    turn = s[:, 0] * t
    forward = s[:, 1] * (f + c[:, 0] * t)
    sideways = s[:, 2] * (side + c[:, 1] * t + c[:, 2] * f)
    theta = mean[:, 2] + turn
    a = se2.rotate(turn / 2, mean[:, :2])
    b = se2.rotate(theta / 2, torch.stack([forward, sideways], dim=-1))
    return torch.cat([a + b, theta.unsqueeze(-1)], dim=-1)


def in_motion(noise: NoiseModel, mean: Tensor) -> Tensor:
    """Return r^2 [B, 3] of mean displacements [B, 3]."""
    return motion_features(noise.unit.to(mean), mean) @ noise.motion.to(mean).T


def motion_features(unit: Tensor, mean: Tensor) -> Tensor:
    """Return the squares [B, len(MOTION_FEATURES)] of mean displacements [B, 3]."""
    turn, forward, _ = (components(mean) / unit).square().unbind(-1)
    return torch.stack([torch.ones_like(turn), turn, forward], dim=-1)


def heaviness(features: Tensor, tail: Tensor) -> Tensor:
    """Return tau [B] of the tails, of features [B, len(TAIL_FEATURES)]."""
    return (features @ tail).exp().clamp(max=HEAVIEST)


def components(displacement: Tensor) -> Tensor:
    """Return displacements [B, 3] as turn, and x and y in the mid-turn frame."""
    return se2.mid_turn(displacement).roll(1, -1)


def residual(mean: Tensor, actual: Tensor) -> Tensor:
    """Return the noise (turn, forward, sideways) [B, 3] that makes ``actual`` of ``mean``.

    Args:
        mean, actual: displacements, [B, 3].
    """
    turn = actual[:, 2] - mean[:, 2]
    moved = actual[:, :2] - se2.rotate(turn / 2, mean[:, :2])
    return torch.cat([turn.unsqueeze(-1), se2.rotate(-actual[:, 2] / 2, moved)], dim=-1)
