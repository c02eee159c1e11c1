"""The coverage of a simulator's intervals and regions."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.simulators import MotionNetwork

#: Nominal probabilities of the intervals.
LEVELS = (0.5, 0.8, 0.95)

#: Number of samples of each command.
DRAWS = 400

#: Number of rows computed at a time.
_ROWS = 500


def central_ranks(
    simulator: MotionNetwork,
    inputs: NDArray,
    actual: NDArray,
    seed: int = 0,
    draws: int = DRAWS,
    starts: NDArray | None = None,
) -> NDArray | None:
    """Return :func:`central` of the results of commands, by samples from a simulator.

    Args:
        inputs: [N, I], in the simulator's units and order, in the order of time.
        actual: [N, 3] dx, dy (m), dtheta (rad).
        seed: of the draws.
        draws: number of samples of each command.
        starts: poses of the robot at the commands' beginnings, [N, 3] m, m, rad; None: an even
            floor is assumed.

    Returns:
        [N, 3] in 0..1; None if the simulator has no noise model.
    """
    if simulator.noise is None:
        return None
    generator = torch.Generator().manual_seed(seed)
    x = simulator.chained(torch.tensor(inputs))
    where = None if starts is None else torch.tensor(starts)
    samples = draw_displacements(simulator, x, draws, generator, where).numpy()
    return central(samples, actual)


def draw_displacements(
    simulator: MotionNetwork,
    x: Tensor,
    draws: int,
    generator: torch.Generator,
    starts: Tensor | None = None,
) -> Tensor:
    """Return random displacements [D, N, 3] for scaled inputs [N, I], each with member and noise.

    ``starts`` [N, 3] are poses on the floor, as in :func:`central_ranks`.
    """
    samples = torch.empty(draws, len(x), 3, dtype=torch.float64)
    members = torch.arange(draws) % simulator.members
    for part in torch.arange(len(x)).split(_ROWS):
        own = x[part]
        mean = torch.stack([simulator.displacement_of(own, m) for m in range(simulator.members)])
        means = mean[members].flatten(0, 1)
        z = simulator.noise.draw(len(means), 1, generator)[:, 0]
        noisy = simulator.disturbed(own.repeat(draws, 1), means, z)
        if starts is not None:
            each = members.repeat_interleave(len(own))
            noisy = simulator.on_floor(starts[part].repeat(draws, 1), noisy, each)
        samples[:, part] = noisy.unflatten(0, (draws, -1))
    return samples


def central(samples: NDArray, actual: NDArray) -> NDArray:
    """Return the probability of the smallest central interval with the actual value.

    Intervals are central in probability: equal parts are below and above.

    Args:
        samples: (D, N, K) samples of each of N results.
        actual: (N, K).

    Returns:
        (N, K) in 0..1; at most p for a fraction p of them if the intervals are right.
    """
    # Half a draw to either side: a result beyond all draws is not quite impossible.
    below = ((samples < actual).sum(0) + 0.5 * (samples == actual).sum(0) + 0.5) / (
        len(samples) + 1
    )
    return np.abs(2.0 * below - 1.0)


def region(samples: NDArray, actual: NDArray) -> NDArray:
    """Return the probability of the smallest region with a robot's actual position.

    Regions are ellipses about the mean of the samples, in the shape of their covariance
    (Mahalanobis distance), of the size that contains the fraction of the samples.

    Args:
        samples: (D, N, 2) points of each of N robots.
        actual: (N, 2).

    Returns:
        (N,) in 0..1.
    """
    centre = samples.mean(0)
    off = samples - centre
    shape = np.linalg.inv(np.einsum("dni,dnj->nij", off, off) / (len(samples) - 1))
    far = np.einsum("dni,nij,dnj->dn", off, shape, off)
    own = np.einsum("ni,nij,nj->n", actual - centre, shape, actual - centre)
    return ((far < own).sum(0) + 0.5) / (len(samples) + 1)
