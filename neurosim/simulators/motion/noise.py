r"""Noise of a motion network: noise on displacements, correlated and of varying size.

The noise is in the mid-turn frame (see :mod:`neurosim.base.se2`). With the mean displacement
:math:`(\bar p, \bar\theta)` and noise of turn, forward and sideways :math:`(e_t, e_f, e_s)`,

.. math:: \theta = \bar\theta + e_t, \qquad
          p = R(e_t / 2)\, \bar p + R(\theta / 2)\, (e_f, e_s)

so that a larger turn also rotates the displacement. The three are a linear map of
standard normal draws z, the Cholesky factor of their covariance C, which is a sum:

.. math:: C = \mathrm{diag}(s^2) e^{2 \tau g} + J \Big(\sum_k U_k m m^T U_k^T\Big) J^T

Noise during the motion, such as slip of a wheel, changes the twist :math:`m = (\theta, l_f, l_s)`,
the turn and the lengths of the arc, in proportion to it: every source k by its matrix :math:`U_k`.
J converts this to the chord :math:`c = \mathrm{sinc}(\theta / 2)\, l`, which a turn makes shorter:

.. math:: J = \begin{pmatrix} 1 & 0 \\ l\, \mathrm{sinc}' & I\, \mathrm{sinc} \end{pmatrix}

Noise on the chord itself would be too large on curves or too small on straight runs, which plans
consist of: a wheel that slips on a curve changes the length and the bend of the arc, and these
effects compensate each other in the chord.

The rest has heavy tails, as if its scale itself were uncertain (Clark 1973, Econometrica
41): g is standard normal, the same for all three, and ln s and :math:`\ln \tau` are linear in
features of the command: its suddenness, its duration, the speed of the motors before it (after a
stop the caster's direction is unknown), and the motion that follows: a robot that stands does not
stray, and what a start adds grows ever more slowly with the motion. :math:`\tau` depends on
distance and turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import torch
from torch import Tensor

from neurosim.base.se2 import tensors as se2

#: The three components of the noise, in the order of every array here.
COMPONENTS = ("turn", "forward", "sideways")

#: Number of draws of a command: one for each component, and g, which scales all three.
DRAWS = 4

#: Smallest variance, m^2 or rad^2.
TINY = 1e-30

#: The heaviest tails, as :math:`\tau`.
HEAVIEST = 1.5

#: Features of ln s and of ln tau, which are linear in them; see :func:`features`.
SCALE_FEATURES = ("one", "jump", "reversal", "time", "before", "moved")
TAIL_FEATURES = ("one", "travel", "turn")

#: Size of a twist, in units, at which the feature of the motion is half of its largest value.
HALF_MOVED = 2.0

#: Number of sources of noise during the motion.
SOURCES = 3

#: Smallest chord as a fraction of its arc, for arcs of nearly a full circle.
LEAST_CHORD = 0.1


@dataclass(frozen=True)
class NoiseModel:
    """A learned noise model; all tensors are float64 and on the CPU.

    Attributes:
        unit: [3] root mean square of the mean turn (rad), forward and sideways chord (m), the units
            of turns and distances in the features.
        log_scale: [3, len(SCALE_FEATURES)] of ln s_t (rad), ln s_f and ln s_s (m).
        tail: [len(TAIL_FEATURES)] of ln tau.
        sources: [SOURCES, 3, 3] the matrices U, from twists in units to turn (rad) and lengths (m).
    """

    unit: Tensor
    log_scale: Tensor
    tail: Tensor
    sources: Tensor

    SHAPES: ClassVar[dict[str, tuple[int, ...]]] = {
        "unit": (3,),
        "log_scale": (3, len(SCALE_FEATURES)),
        "tail": (len(TAIL_FEATURES),),
        "sources": (SOURCES, 3, 3),
    }

    def __post_init__(self) -> None:
        for name, shape in self.SHAPES.items():
            value = getattr(self, name)
            if tuple(value.shape) != shape:
                raise ValueError(f"noise {name} must be of shape {shape}, not {value.shape}")
            object.__setattr__(self, name, value.detach().cpu().double())
        if (self.unit <= 0).any():
            raise ValueError("noise unit must be above 0")

    def tensors(self) -> dict[str, Tensor]:
        """Return the numbers by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def times(self, factor: float | Tensor) -> NoiseModel:
        """Return a noise model that is larger by a factor, or by one for each component, [3]."""
        factors = torch.as_tensor(factor, dtype=torch.float64).expand(3)
        scale = self.log_scale.clone()
        scale[:, 0] += factors.log()
        return replace(self, log_scale=scale, sources=self.sources * factors.unsqueeze(1))

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
    """The indices of a network's inputs that a noise model uses; they follow from the names.

    Attributes:
        driven: indices of the command's inputs, without its duration.
        before: index of the same input before the command, -1 if it does not exist.
        duration: index of the duration, -1 if it does not exist.
    """

    driven: tuple[int, ...]
    before: tuple[int, ...]
    duration: int

    @classmethod
    def of(cls, names: tuple[str, ...]) -> CommandFeatures:
        """Return the features' indices for inputs of these names."""
        driven = [n for n in names if not n.startswith("prev_") and n != "duration"]
        before = [names.index("prev_" + n) if "prev_" + n in names else -1 for n in driven]
        duration = names.index("duration") if "duration" in names else -1
        return cls(tuple(names.index(n) for n in driven), tuple(before), duration)


def features(
    unit: Tensor, columns: CommandFeatures, inputs: Tensor, mean: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the features of ln s and of ln tau.

    Args:
        unit: of the noise model, [3].
        columns: of the inputs.
        inputs: scaled inputs, [B, I].
        mean: mean displacements, [B, 3].

    Returns:
        [B, len(SCALE_FEATURES)] and [B, len(TAIL_FEATURES)].
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
    size = arcs(unit, mean)[0].norm(dim=-1)
    reverses = reversal > 0.0  # the square root has no gradient at 0
    scale = [
        one,
        (jump + 0.02).log(),
        torch.where(reverses, torch.where(reverses, reversal, 1.0).sqrt(), 0.0),
        (duration + 0.02).log(),
        (speed + 0.02).log(),
        (size / (size + HALF_MOVED) + 0.02).log(),
    ]
    turn = (mean[:, 2] / unit[0]).abs()
    tail = [one, (travel + 0.01).log(), (turn + 0.02).log()]
    return torch.stack(scale, dim=-1), torch.stack(tail, dim=-1)


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
    scale, tail = features(noise.unit.to(mean), columns, inputs, mean)
    z = z.to(mean)
    width = (heaviness(tail, noise.tail.to(mean)) * z[:, 3]).exp()
    s = (scale @ noise.log_scale.to(mean).T).exp() * width.unsqueeze(-1)
    moving = in_motion(noise.unit.to(mean), noise.sources.to(mean), mean)
    lower = cholesky(moving, s.square().unbind(-1))
    turn, forward, sideways = (
        torch.stack([part * z[:, k] for k, part in enumerate(row)]).sum(0) for row in lower
    )
    return added(mean, torch.stack([forward, sideways, turn], dim=-1))


def added(moved: Tensor, more: Tensor) -> Tensor:
    """Return displacements [B, 3] with more motion [B, 3] in the mid-turn frame."""
    theta, turn = moved[:, 2] + more[:, 2], more[:, 2]
    a = se2.rotate(turn / 2, moved[:, :2])
    b = se2.rotate(theta / 2, more[:, :2])
    return torch.cat([a + b, theta.unsqueeze(-1)], dim=-1)


def in_motion(unit: Tensor, sources: Tensor, mean: Tensor) -> Tensor:
    """Return the covariance [B, 3, 3] of noise during the motion.

    Args:
        unit: of the noise model, [3].
        sources: of the noise model, [SOURCES, 3, 3].
        mean: mean displacements, [B, 3].
    """
    arc, jacobian = arcs(unit, mean)
    # Two factors at a time: for three, opt_einsum (where it is installed) fixes the size of an
    # exported batch.
    each = torch.einsum("kcb,nb->nkc", sources, arc) @ jacobian.mT
    return each.mT @ each


def arcs(unit: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Return the twists m [B, 3] of mean displacements [B, 3] in units [3], and J [B, 3, 3]."""
    turn, forward, sideways = components(mean).unbind(-1)
    along = se2.chord(turn)
    along = torch.where(along < 0.0, -1.0, 1.0) * along.abs().clamp(min=LEAST_CHORD)
    arc = torch.stack([turn, forward / along, sideways / along], dim=-1)
    jacobian = torch.diag_embed(torch.stack([torch.ones_like(along), along, along], dim=-1))
    jacobian[:, 1:, 0] = arc[:, 1:] * shortened(turn).unsqueeze(-1)
    return arc / unit, jacobian


def shortened(turn: Tensor) -> Tensor:
    """Return the derivative of a chord, for an arc of length 1, by its turn, per rad."""
    small = turn.abs() < 1e-3
    safe = torch.where(small, 1.0, turn)
    return torch.where(small, -turn / 12.0, ((safe / 2.0).cos() - se2.chord(safe)) / safe)


def cholesky(covariance: Tensor, variances: Sequence[Tensor]) -> tuple[tuple[Tensor, ...], ...]:
    """Return the rows of the lower factor of sums of covariances, each number [...].

    Like the compiled one, it replaces variances that are negative by rounding by 0.

    Args:
        covariance: [..., 3, 3].
        variances: added to its diagonal, three of [...].
    """
    c = covariance
    a = (c[..., 0, 0] + variances[0]).clamp(min=TINY).sqrt()
    b, d = c[..., 1, 0] / a, c[..., 2, 0] / a
    e = (c[..., 1, 1] + variances[1] - b.square()).clamp(min=TINY).sqrt()
    f = (c[..., 2, 1] - d * b) / e
    g = (c[..., 2, 2] + variances[2] - d.square() - f.square()).clamp(min=TINY).sqrt()
    return (a,), (b, e), (d, f, g)


def heaviness(features: Tensor, tail: Tensor) -> Tensor:
    """Return tau [B] of the tails from features [B, len(TAIL_FEATURES)]."""
    return (features @ tail).exp().clamp(max=HEAVIEST)


def components(displacement: Tensor) -> Tensor:
    """Return displacements [B, 3] as turn, and x and y in the mid-turn frame."""
    return se2.mid_turn(displacement).roll(1, -1)


def residual(mean: Tensor, actual: Tensor) -> Tensor:
    """Return the noise (turn, forward, sideways) [B, 3] that changes ``mean`` into ``actual``.

    Args:
        mean, actual: displacements, [B, 3].
    """
    turn = actual[:, 2] - mean[:, 2]
    moved = actual[:, :2] - se2.rotate(turn / 2, mean[:, :2])
    return torch.cat([turn.unsqueeze(-1), se2.rotate(-actual[:, 2] / 2, moved)], dim=-1)
