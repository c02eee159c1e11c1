"""Learning a noise model from what was predicted of rows that had not been seen.

Scales, couplings and tails are fitted together by maximum likelihood, with a weak pull to zero
for what few rows say little about. The noise of the poses at both ends of a command, as the camera
saw them, is part of what is learned: it is what is left of the noise where a robot stands still.
"""

from __future__ import annotations

import torch
from numpy.polynomial.hermite_e import hermegauss
from torch import Tensor

from neurosim.base.threads import one_thread
from neurosim.simulators import MotionNetwork
from neurosim.simulators.motion.noise import (
    COUPLING_FEATURES,
    MOTION_FEATURES,
    SCALE_FEATURES,
    TAIL_FEATURES,
    CommandFeatures,
    NoiseModel,
    components,
    features,
    heaviness,
    motion_features,
    residual,
)
from neurosim.training.base import root_mean_square

#: Strength of the pull to zero, in rows: a coefficient of 1 costs as much likelihood as half a row.
PULL = 1.0

#: Residuals are not told apart below this, m and rad.
FINEST = 1e-6

#: The most that members may explain of a row, in mean squares.
MOST = 4.0

#: Of r^2 where nothing is known, as the logarithm of its share in the mean square.
LITTLE = -3.0

#: Places and weights of Gauss-Hermite quadrature over a standard normal number.
_PLACES, _SHARES = (torch.from_numpy(part) for part in hermegauss(11))

#: Of ln tau where nothing is known: slight tails.
SLIGHT = -0.7


def fit_noise(
    simulator: MotionNetwork,
    x: Tensor,
    y: Tensor,
    outputs: Tensor,
    weight: Tensor | None = None,
    besides_members: bool = True,
) -> NoiseModel:
    """Learn the noise of an ensemble's displacements.

    Args:
        simulator: the ensemble.
        x: scaled inputs of rows, [N, I].
        y: displacements that followed, [N, 3].
        outputs: what networks that had not seen a row said of it, [N, O], averaged.
        weight: how much each row counts, [N]; alike if not given.
        besides_members: whether what the members say is left out of the noise, in which it would
            count twice.
    """
    mean = simulator.from_outputs(outputs, x)
    weight = torch.ones_like(mean[:, 0]) if weight is None else weight
    spread = _spread(simulator, x, mean) if besides_members else torch.zeros_like(mean)
    return _most_likely(simulator.columns, x, mean, y, spread, weight)


def _spread(simulator: MotionNetwork, x: Tensor, mean: Tensor) -> Tensor:
    """Return the variance [N, 3] of what the members say of rows.

    What the rows strayed by holds it already: left in the noise, it would count twice.
    """
    if simulator.members == 1:
        return torch.zeros_like(mean)
    own = simulator.displacement_of(x)
    strays = [residual(own, simulator.displacement_of(x, m)) for m in range(simulator.members)]
    return torch.stack(strays).square().sum(0) / (simulator.members - 1)


def _most_likely(
    columns: CommandFeatures,
    inputs: Tensor,
    mean: Tensor,
    actual: Tensor,
    said: Tensor,
    weight: Tensor,
) -> NoiseModel:
    """Fit the noise, beside what the members say [N, 3]."""
    unit = root_mean_square(components(mean))
    scale, coupling, tail = features(unit, columns, inputs, mean)
    error = residual(mean, actual)
    size = error.square().mean(0).sqrt().clamp(min=FINEST)
    error = error / size
    rows = weight.sum()
    # A member may be wild on some row; the row itself says how far that can be believed.
    besides = (said / size.square()).clamp(max=MOST)
    w = torch.zeros(3, len(SCALE_FEATURES), dtype=torch.float64, requires_grad=True)
    c = torch.zeros(3, len(COUPLING_FEATURES), dtype=torch.float64, requires_grad=True)
    h = torch.zeros(len(TAIL_FEATURES), dtype=torch.float64)
    h[0] = SLIGHT
    h.requires_grad_()
    in_motion = motion_features(unit, mean)
    v = torch.full((3, len(MOTION_FEATURES)), LITTLE, dtype=torch.float64, requires_grad=True)
    shares = (_SHARES / _SHARES.sum()).log()

    def loss() -> Tensor:
        optimiser.zero_grad()
        k = (coupling @ c.T).unsqueeze(-1)
        log_s = (scale @ w.T).unsqueeze(-1) + (
            heaviness(tail, h).unsqueeze(-1) * _PLACES
        ).unsqueeze(1)
        rest = in_motion @ v.exp().T + besides
        variance = (2.0 * log_s).exp() + rest.unsqueeze(-1)  # [N, 3, places]
        t, f, s = (error.unsqueeze(-1) / variance.sqrt()).unbind(1)
        f = f - k[:, 0] * t
        z = torch.stack([t, f, s - k[:, 1] * t - k[:, 2] * f], dim=1)
        # As if each had been read to the finest step only: no residual is likelier than that.
        power = z.square() + (FINEST / size).square().unsqueeze(-1) / variance
        likelihood = (shares - (power + variance.log()).sum(1) / 2.0).logsumexp(-1)
        pull = w[:, 1:].square().sum() + c.square().sum() + (h[0] - SLIGHT).square()
        pull = pull + h[1:].square().sum() + 0.1 * (v - LITTLE).square().sum()
        value = -(weight * likelihood).sum() / rows + PULL * pull / (2 * rows)
        value.backward()
        return value

    optimiser = torch.optim.LBFGS([w, c, h, v], max_iter=100, line_search_fn="strong_wolfe")
    with one_thread():
        optimiser.step(loss)
    w, c = w.detach(), c.detach()
    w[:, 0] += size.log()
    return NoiseModel(
        unit=unit,
        log_scale=w,
        coupling=c,
        tail=h.detach(),
        motion=v.detach().exp() * size.square().unsqueeze(-1),
    )
