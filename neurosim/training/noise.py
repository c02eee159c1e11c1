"""Learning a noise model from what was predicted of rows that had not been seen.

Scales, couplings and tail are fitted together by maximum likelihood, with a weak pull to zero
for what few rows say little about. What lasts from command to command is then read off the
correlation of the standardised residuals of commands that followed each other. The noise of the
poses at both ends of a command, as the camera saw them, is part of what is learned: it is what
is left of the noise where a robot stands still.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from neurosim.simulators import MotionNetwork
from neurosim.simulators.noise import (
    COUPLING_FEATURES,
    SCALE_FEATURES,
    WIDTHS,
    CommandFeatures,
    NoiseModel,
    features,
    half_way_frame,
    residual,
    standardised,
)
from neurosim.training.base import TrainingData, one_thread, root_mean_square

#: Strength of the pull to zero, in rows: a coefficient of 1 costs as much likelihood as half a row.
PULL = 1.0

#: Residuals are not told apart below this, m and rad.
FINEST = 1e-6

#: The least share of the variance that is left when the members' spread is taken off.
LEAST = 0.1

#: Chi-squared above which a correlation is no chance (99.9 %, for the best of several memories).
CHANCE = 11.0

#: Commands ahead that the correlation of residuals is looked at.
LAGS = 6


def fit_noise(
    simulator: MotionNetwork, data: TrainingData, outputs: Tensor, order: Tensor
) -> NoiseModel:
    """Learn the noise of an ensemble's displacements.

    Args:
        simulator: the ensemble.
        data: rows.
        outputs: what networks that had not seen a row said of it, [N, O], averaged.
        order: number of each row's command, [N]; those of commands in a row differ by one.
    """
    mean = simulator.from_outputs(outputs)
    columns = CommandFeatures.of(simulator.input_names)
    inputs = simulator.scaled(data.x)
    noise = _most_likely(columns, inputs, mean, data.y)
    z = standardised(noise, columns, inputs, mean, data.y)
    drift, memory = _lasting(z, noise.power, order)
    spread = _spread(noise, columns, simulator, data)
    left = (1.0 - spread / noise.power).clamp(min=LEAST).sqrt()
    return replace(noise, drift=drift, memory=memory).widened(left)


def search_optimism(
    simulator: MotionNetwork, data: TrainingData, said: list[Tensor], seen: Tensor
) -> Tensor:
    """Return how many times as wide as the residuals of rows that a search saw the noise is, [3].

    Args:
        simulator: whose networks they are.
        data: rows.
        said: what the networks of searches on halves say of all rows, [N, O] each.
        seen: which rows each search saw, [S, N].
    """
    inside, outside = torch.zeros(2, 3, dtype=torch.float64)
    for outputs, own in zip(said, seen, strict=True):
        error = residual(simulator.from_outputs(outputs), data.y).abs()
        # Medians: a network may be wild on some row that it has not seen.
        inside += error[own].median(0).values
        outside += error[~own].median(0).values
    ratio = (outside / inside.clamp(min=1e-12)).square()
    # Optimism falls as one over the rows, of which the search itself had twice as many.
    return (1.0 + 0.5 * (ratio - 1.0).clamp(0.0, 8.0)).sqrt()


def _spread(
    noise: NoiseModel, columns: CommandFeatures, simulator: MotionNetwork, data: TrainingData
) -> Tensor:
    """Return the variance [3] of what the members say, in draws z.

    What the rows strayed by holds it already: left in the noise, it would count twice.
    """
    if simulator.members == 1:
        return torch.zeros(3, dtype=torch.float64)
    inputs, mean = simulator.scaled(data.x), simulator.displacement(data.x)
    strays = [
        standardised(noise, columns, inputs, mean, simulator.displacement(data.x, m))
        for m in range(simulator.members)
    ]
    variance = torch.stack(strays).square().sum(0) / (simulator.members - 1)
    return variance.clamp(max=noise.power).mean(0)


def _lasting(z: Tensor, power: float, order: Tensor) -> tuple[Tensor, Tensor]:
    """Return the share of the variance of z that lasts, and its memory, [3] each.

    A share d with memory m makes draws that are n commands apart correlate by d m^n; the two are
    fitted to the correlations found, and nothing lasts where that explains no more than chance.
    """
    z = z.clamp(-3.0 * power**0.5, 3.0 * power**0.5)
    z = (z - z.mean(0)) / z.std(0).clamp(min=1e-12)
    found, pairs = [], []
    for lag in range(1, LAGS + 1):
        near = order[lag:] - order[:-lag] == lag
        count = int(near.sum())
        both = (z[lag:] * z[:-lag])[near]
        found.append(both.mean(0) if count else torch.zeros(3, dtype=torch.float64))
        pairs.append(count)
    weight = torch.tensor(pairs, dtype=torch.float64)
    drift, memory = torch.zeros(2, 3, dtype=torch.float64)
    lags = torch.arange(1, LAGS + 1)
    for j, r in enumerate(torch.stack(found).T):
        best = torch.tensor(CHANCE, dtype=torch.float64)
        for m in torch.linspace(0.05, 1.0, 20, dtype=torch.float64):
            shape = m**lags
            norm = (weight * shape * shape).sum()
            share = ((weight * shape * r).sum() / norm.clamp(min=1e-12)).clamp(0.0, 0.9)
            gain = share * share * norm  # chi-squared with one degree of freedom, if by chance
            if gain > best:
                best, drift[j], memory[j] = gain, share, m
    return drift, memory


def _most_likely(
    columns: CommandFeatures, inputs: Tensor, mean: Tensor, actual: Tensor
) -> NoiseModel:
    unit = root_mean_square(half_way_frame(mean))
    scale, coupling = features(unit, columns, inputs, mean)
    error = residual(mean, actual)
    size = error.square().mean(0).sqrt().clamp(min=FINEST)
    error = error / size
    rows = len(error)
    w = torch.zeros(3, len(SCALE_FEATURES), dtype=torch.float64, requires_grad=True)
    c = torch.zeros(3, len(COUPLING_FEATURES), dtype=torch.float64, requires_grad=True)
    logits = torch.zeros(len(WIDTHS), dtype=torch.float64, requires_grad=True)
    widths = torch.tensor(WIDTHS, dtype=torch.float64)

    def draws() -> tuple[Tensor, Tensor]:
        log_s, k = scale @ w.T, coupling @ c.T
        t, f, s = (error * (-log_s).exp()).unbind(-1)
        f = f - k[:, 0] * t
        return torch.stack([t, f, s - k[:, 1] * t - k[:, 2] * f], dim=-1), log_s

    def loss() -> Tensor:
        optimiser.zero_grad()
        z, log_s = draws()
        # As if each had been read to the finest step only: no residual is likelier than that.
        finest = (FINEST / size * (-log_s).exp()).square()
        power = (z.square() + finest).sum(-1, keepdim=True) / (2.0 * widths.square())
        likelihood = (logits.log_softmax(0) - power - 3.0 * widths.log()).logsumexp(-1)
        pull = w[:, 1:].square().sum() + c.square().sum() + logits.square().sum()
        value = (log_s.sum(-1) - likelihood).mean() + PULL * pull / (2 * rows)
        value.backward()
        return value

    optimiser = torch.optim.LBFGS([w, c, logits], max_iter=100, line_search_fn="strong_wolfe")
    with one_thread("cpu"):
        optimiser.step(loss)
    w, c = w.detach(), c.detach()
    w[:, 0] += size.log()
    return NoiseModel(
        unit=unit,
        log_scale=w,
        coupling=c,
        shares=logits.detach().softmax(0),
        drift=torch.zeros(3),
        memory=torch.zeros(3),
    )
