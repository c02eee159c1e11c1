"""Learning a noise model from predictions for unseen rows.

Scales, tails and sources are fitted together by maximum likelihood, with a weak pull to zero for
coefficients that the rows hardly determine. The learned noise includes the camera's noise of the
poses at both ends of a command, which remains while a robot stands.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.polynomial.hermite_e import hermegauss
from torch import Tensor

from neurosim.base.compiled import njit
from neurosim.base.threads import one_thread
from neurosim.simulators.motion.noise import (
    HEAVIEST,
    SCALE_FEATURES,
    TAIL_FEATURES,
    TINY,
    CommandFeatures,
    NoiseModel,
    arcs,
    components,
    features,
    residual,
)
from neurosim.training.base import minimise, root_mean_square

#: Strength of the pull to zero, in rows: a coefficient of 1 costs as much likelihood as two rows.
PULL = 4.0

#: The same for logarithms of the factors of spread, in separate windows, towards that of the usual
#: factor of the members' differences. Members that learn the same rows with other weights agree too
#: much: a simulator's own error after ten commands of plans was 1.4 times their differences on
#: eleven robots (300 rows; of single commands 1.7 times).
SPREAD_PULL, USUAL_SPREAD = 4.0, 1.5

#: Smallest difference of residuals, m and rad.
FINEST = 1e-6

#: First sources of the search, as fractions of the residuals' root mean squares: one of turn and
#: one forward, for turns and distances ahead, and one of a curve to the side.
BEGIN = (
    ((0.2, 0.1, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ((0.0, 0.0, 0.0), (0.1, 0.2, 0.0), (0.0, 0.0, 0.0)),
    ((-0.1, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.1, 0.0)),
)

#: Nodes and weights of Gauss-Hermite quadrature over a standard normal number.
_PLACES, _WEIGHTS = hermegauss(11)

#: Degrees of freedom of the errors of windows, and half widths of 80 % intervals of a standard
#: normal number and of Student's t.
_FREEDOM, _OF_NORMAL, _OF_STUDENT = 4.0, 1.2816, 1.5332

#: Default ln tau: slight tails.
SLIGHT = -0.7


def fit_noise(
    columns: CommandFeatures,
    inputs: Tensor,
    mean: Tensor,
    actual: Tensor,
    weight: Tensor | None = None,
) -> NoiseModel:
    """Learn the noise between predicted and actual displacements.

    Args:
        columns: of the inputs.
        inputs: scaled inputs of rows, [N, I].
        mean: displacements predicted by models that had not seen the row, [N, 3].
        actual: actual displacements, [N, 3].
        weight: weights of the rows, [N]; equal by default.
    """
    weight = torch.ones_like(mean[:, 0]) if weight is None else weight
    unit = root_mean_square(components(mean))
    scale, tail = features(unit, columns, inputs, mean)
    error = residual(mean, actual)
    size = error.square().mean(0).sqrt().clamp(min=FINEST)
    error = error / size
    rows = weight.sum()
    w = torch.zeros(3, len(SCALE_FEATURES), dtype=torch.float64)
    h = torch.zeros(len(TAIL_FEATURES), dtype=torch.float64)
    h[0] = SLIGHT
    u = torch.tensor(BEGIN, dtype=torch.float64)
    searched, slopes = (w, h, u), tuple(torch.zeros_like(part) for part in (w, h, u))
    arc, jacobian = arcs(unit, mean)
    jacobian = jacobian * size / size.unsqueeze(1)
    given = (scale, tail, arc, jacobian, error, FINEST / size, weight, *searched, *slopes)
    arrays = [part.contiguous().numpy() for part in given]

    def loss() -> Tensor:
        value = -_log_likelihood(_PLACES, _WEIGHTS, *arrays)
        pulled = w.clone(), h.clone(), u
        pulled[0][:, 0] = 0.0
        pulled[1][0] -= SLIGHT
        for part, slope, off in zip(searched, slopes, pulled, strict=True):
            part.grad = (PULL * off - slope) / rows
            value += PULL * float(off.square().sum()) / 2.0
        return value / rows

    with one_thread():
        minimise([w, h, u], loss, steps=150)
    w[:, 0] += size.log()
    return NoiseModel(unit=unit, log_scale=w, tail=h, sources=u * size.unsqueeze(-1))


@njit(error_model="numpy")
def _log_likelihood(
    places, weights, scale, tail, arc, jacobian, error, finest, weight, w, h, u, of_w, of_h, of_u
):
    """Return the log-likelihood of residuals, and write its derivatives.

    The Cholesky factor has the rows (a), (b, e), (d, f, g), as in
    :func:`neurosim.simulators.motion.noise.cholesky`; its derivatives follow backwards (Smith 1995,
    Differentiation of the Cholesky algorithm).

    Args:
        places, weights: Gauss-Hermite quadrature of g.
        scale: features of ln s, [N, S].
        tail: features of ln tau, [N, T].
        arc: twists m, [N, 3].
        jacobian: J for residuals that are divided by their sizes, [N, 3, 3].
        error: residuals divided by their sizes, [N, 3].
        finest: resolution of the residuals, which limits the likelihood, [3].
        weight: of the rows, [N].
        w, h, u: the coefficients of ln s [3, S] and ln tau [T], and the sources [K, 3, 3].
        of_w, of_h, of_u: the derivatives by them, written.
    """
    of_w[:], of_h[:], of_u[:], likelihood = 0.0, 0.0, 0.0, 0.0
    count, sources = len(places), len(u)
    each, fraction, larger = np.empty(count), np.empty(count), np.empty(count)
    of_variance, moved = np.empty((count, 6)), np.empty((sources, 3))
    fixed, of_moved, of_twist = np.empty(6), np.empty(3), np.empty(3)
    variance, of_log_s = np.empty(3), np.empty(3)
    total = math.log(weights.sum())
    for n in range(len(error)):
        for c in range(3):
            log_s = 0.0
            for j in range(scale.shape[1]):
                log_s += w[c, j] * scale[n, j]
            variance[c] = math.exp(2.0 * log_s)
        log_tau = 0.0
        for j in range(tail.shape[1]):
            log_tau += h[j] * tail[n, j]
        tau = min(math.exp(log_tau), HEAVIEST)
        fixed[:] = 0.0
        for k in range(sources):
            for c in range(3):
                of_twist[c] = 0.0
                for b in range(3):
                    of_twist[c] += u[k, c, b] * arc[n, b]
            place = 0
            for c in range(3):
                moved[k, c] = 0.0
                for b in range(3):
                    moved[k, c] += jacobian[n, c, b] * of_twist[b]
                for b in range(c + 1):
                    fixed[place] += moved[k, c] * moved[k, b]
                    place += 1
        best = -math.inf
        for p in range(count):
            larger[p] = math.exp(2.0 * tau * places[p])
            a = math.sqrt(max(fixed[0] + variance[0] * larger[p], TINY))
            b, d = fixed[1] / a, fixed[3] / a
            e = math.sqrt(max(fixed[2] + variance[1] * larger[p] - b * b, TINY))
            f = (fixed[4] - d * b) / e
            g = math.sqrt(max(fixed[5] + variance[2] * larger[p] - d * d - f * f, TINY))
            z0 = error[n, 0] / a
            z1 = (error[n, 1] - b * z0) / e
            z2 = (error[n, 2] - d * z0 - f * z1) / g
            r0, r1, r2 = finest[0] / a, finest[1] / e, finest[2] / g
            power = z0 * z0 + z1 * z1 + z2 * z2 + r0 * r0 + r1 * r1 + r2 * r2
            each[p] = math.log(weights[p]) - total - power / 2.0 - math.log(a * e * g)
            best = max(best, each[p])
            # Derivatives by z, then by the factor, then by the covariance.
            of_z1 = -z1 + z2 * f / g
            of_z0 = -z0 + z2 * d / g - of_z1 * b / e
            of_g = (r2 * r2 - 1.0 + z2 * z2) / g
            of_f = z2 * z1 / g - of_g * f / g
            of_d = z2 * z0 / g - of_g * d / g - of_f * b / e
            of_e = (r1 * r1 - 1.0 - of_z1 * z1 - of_f * f) / e
            of_b = -of_z1 * z0 / e - of_f * d / e - of_e * b / e
            of_a = (r0 * r0 - 1.0 - of_z0 * z0 - of_d * d - of_b * b) / a
            of_variance[p, 0], of_variance[p, 1] = of_a / (2.0 * a), of_b / a
            of_variance[p, 2], of_variance[p, 3] = of_e / (2.0 * e), of_d / a
            of_variance[p, 4], of_variance[p, 5] = of_f / e, of_g / (2.0 * g)
        mixed = 0.0
        for p in range(count):
            fraction[p] = math.exp(each[p] - best)
            mixed += fraction[p]
        likelihood += weight[n] * (best + math.log(mixed))
        fixed[:], of_log_s[:], of_tau = 0.0, 0.0, 0.0
        for p in range(count):
            part = weight[n] * fraction[p] / mixed
            for c in range(6):
                fixed[c] += part * of_variance[p, c]
            for c in range(3):
                by = 2.0 * part * of_variance[p, c * (c + 3) // 2] * variance[c] * larger[p]
                of_tau += by * places[p]
                of_log_s[c] += by
        for c in range(3):
            for j in range(scale.shape[1]):
                of_w[c, j] += of_log_s[c] * scale[n, j]
        if tau < HEAVIEST:
            for j in range(tail.shape[1]):
                of_h[j] += of_tau * tau * tail[n, j]
        for k in range(sources):
            of_moved[:], place = 0.0, 0
            for c in range(3):
                for b in range(c + 1):
                    of_moved[c] += fixed[place] * moved[k, b]
                    of_moved[b] += fixed[place] * moved[k, c]
                    place += 1
            for c in range(3):
                by = 0.0
                for b in range(3):
                    by += jacobian[n, b, c] * of_moved[b]
                for b in range(3):
                    of_u[k, c, b] += by * arc[n, b]
    return likelihood


def fit_spread(
    error: Tensor, noise: Tensor, members: Tensor, weight: Tensor, usual: float = USUAL_SPREAD
) -> tuple[Tensor, Tensor]:
    """Return factors of the noise and of the members' differences [3] for windows of rows.

    Errors have Student's t distribution, whose central 80 % are those of the sum of both.

    Args:
        error: turn, forward and sideways, of models that had not seen the rows, [W, 3].
        noise: samples of the noise, [D, W, 3].
        members: differences of the members from the mean, [M, W, 3].
        weight: of the windows, [W]; together, they count as many as there are separate ones.
        usual: usual factor of the members' differences; that of the noise is 1.

    Returns:
        Factors of turn, forward and sideways; without windows the usual ones.
    """
    centre = torch.tensor([[1.0], [usual]], dtype=torch.float64).repeat(1, 3)
    if not len(weight):
        return centre[0], centre[1]
    places = torch.tensor([0.1, 0.9], dtype=noise.dtype)
    low, high = noise.quantile(places, dim=0)
    of_noise = ((high - low) / (2.0 * _OF_NORMAL)).square()
    of_members = members.square().sum(0) / max(len(members), 1)
    logs = centre.log().requires_grad_()

    def loss() -> Tensor:
        logs.grad = None
        first, second = (2.0 * logs).exp()
        variance = (of_noise * first + of_members * second).clamp(min=FINEST**2)
        off = error.square() / variance * (_OF_STUDENT / _OF_NORMAL) ** 2 / _FREEDOM
        each = (_FREEDOM + 1.0) / 2.0 * off.log1p() + variance.log() / 2.0
        value = (weight @ each).sum() + SPREAD_PULL / 2.0 * (logs - centre.log()).square().sum()
        value.backward()
        return value

    with one_thread():
        minimise([logs], loss, steps=150)
    first, second = logs.detach().exp()
    return first, second
