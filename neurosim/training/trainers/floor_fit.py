"""Learning the floor from differences between the robot's motion and its commands.

The map is a Gaussian process over the board, observed through its effect on turns and distances
ahead (Rasmussen and Williams 2006, section 9.4: derivative observations), approximated by a sum of
bells. Its length and size have the largest likelihood of the rows. It is accepted only if it is
much likelier than no map, and only for turns, or also for distances ahead, if these become
likelier.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from neurosim.simulators.motion.floor import SPACING, Floor, pieces

#: Lengths of a bell, as fractions of the size of the area where the robot was.
LENGTHS = (1 / 8, 1 / 5, 1 / 3, 1 / 2)
#: Variance of the map over that of the rows' noise: candidates.
RATIOS = tuple(10.0 ** (step / 3) for step in range(-15, 7))
#: Gain in log-likelihood for accepting a map.
BELIEVED = 5.0
#: Number of rows, evenly spread over all, that are enough for a map.
MOST_ROWS = 4000
#: Smallest width of the area, as a fraction of its length, for a robot that drove up and down a
#: line.
NARROWEST = 0.1
#: Largest residual, in standard deviations; larger ones are clipped.
FAR = 2.5
#: Number of steps in which rows are evened, each about a hundred times as exact as the previous
#: one.
_EVENINGS = 3
#: Added to the diagonal of the bells' covariance, because neighbours are nearly equal.
_JITTER = 1e-6


class FloorFit(NamedTuple):
    """A learned floor, and its effect on rows that were left out.

    Attributes:
        floor: the floor.
        unseen: its turn of each row learned from all other rows, less that from all rows, [N] rad;
            0 for rows beyond :data:`MOST_ROWS`, each of which changes little.
    """

    floor: Floor
    unseen: Tensor

    def described(self) -> dict[str, float]:
        """Return the size of its map's unevenness, its length (m) and ``ahead``, for people."""
        floor = self.floor
        spread = float(floor.map[0, ..., 0].std())
        return {"sd": spread, "length": floor.length, "ahead": floor.ahead}


class _Believed(NamedTuple):
    """A map that was learned from rows.

    Attributes:
        gain: its gain in log-likelihood.
        floor: the floor with its bells.
        basis: matrix from the eigenvectors' weights to the bells' weights, [K, K].
        weights: of the eigenvectors, [K].
        sd: standard deviations of these, [K].
        unseen: as in :class:`FloorFit`, for its training rows.
    """

    gain: float
    floor: Floor
    basis: Tensor
    weights: Tensor
    sd: Tensor
    unseen: Tensor


def fit_floor(
    start: Tensor,
    moved: Tensor,
    left: Tensor,
    trust: Tensor,
    members: int,
    generator: torch.Generator,
) -> FloorFit | None:
    """Learn a floor; None if the rows do not show one.

    Args:
        start: poses at the commands' beginnings, [N, 3] m, m, rad.
        moved: displacements, [N, 3].
        left: residuals of turn (rad) and distance ahead (m), [N, 2].
        trust: their weights, [N, 2], in proportion to 1 / variance.
        members: number of members, each with a random floor.
        generator: of these floors.
    """
    chosen = slice(None, None, -(-len(start) // MOST_ROWS))
    every, (start, moved, left, trust) = (
        len(start),
        (x[chosen] for x in (start, moved, left, trust)),
    )
    size = start[:, :2].amax(0) - start[:, :2].amin(0)
    size = size.clamp(min=NARROWEST * float(size.max()))
    sizes = 1.4826 * (left * trust.sqrt()).abs().median(0).values
    if (sizes <= 0).any() or (size <= 0).any():
        return None
    root = trust.sqrt() / sizes
    best: _Believed | None = None
    for fraction in LENGTHS:
        length = fraction * float(size.prod().sqrt())
        count = (size / (SPACING * length)).ceil().long() + 3
        origin = start[:, :2].amin(0) - (SPACING * length * (count - 1) - size) / 2
        none = torch.zeros(1, int(count[1]), int(count[0]), dtype=torch.float64)
        floors = [Floor(none, origin, length, ahead) for ahead in (0.0, 1.0)]
        whitened = _whitening(floors[0])
        design = _effects(floors[0], start, moved) @ whitened
        for where in floors:
            one = _of_bells(where, whitened, design, left, root)
            if one.gain > (BELIEVED if best is None else best.gain):
                best = one
    if best is None:
        return None
    normals = torch.randn(members, len(best.sd), generator=generator, dtype=torch.float64)
    weights = torch.cat([best.weights[None], best.weights + best.sd * normals]) @ best.basis.T
    where = best.floor
    weights = weights.unflatten(1, where.weights.shape[1:])
    unseen = torch.zeros(every, dtype=torch.float64)
    unseen[chosen] = best.unseen
    return FloorFit(Floor(weights, where.origin, where.length, where.ahead), unseen)


def evened(floor: Floor, start: Tensor, moved: Tensor) -> Tensor:
    """Return the displacements [N, 3] for an even floor.

    Args:
        floor: the floor of the displacements.
        start: poses at their beginnings, [N, 3].
        moved: the displacements, [N, 3].
    """
    even = moved
    for _ in range(_EVENINGS):
        even = even + moved - floor.moved(start, even)
    return even


def _of_bells(
    where: Floor, whitened: Tensor, design: Tensor, left: Tensor, root: Tensor
) -> _Believed:
    """Return the likeliest map of bells at given positions.

    Args:
        where: the positions, and whether the distance ahead is used, too.
        whitened: of :func:`_whitening`.
        design: product of :func:`_effects` and that, [N, 2, K].
        left: as in :func:`fit_floor`.
        root: factors that scale ``left`` to about 1, [N, 2].
    """
    columns = slice(2 if where.ahead else 1)
    scaled = (left * root).clamp(-FAR, FAR)[:, columns]
    design = (design[:, columns] * root[:, columns, None]).flatten(0, 1)
    y = scaled.flatten()
    values, vectors = torch.linalg.eigh(design.T @ design)
    values, along = values.clamp(min=0.0), vectors.T @ (design.T @ y)
    likelihoods = [_log_likelihood(y, values, along, ratio) for ratio in (0.0, *RATIOS)]
    gains = [one - likelihoods[0] for one in likelihoods[1:]]
    gain, ratio = max(zip(gains, RATIOS, strict=True))
    shrunk = ratio / (1.0 + ratio * values)
    own, mean = design @ vectors, shrunk * along
    variance = (y.square().sum() - (along * mean).sum()) / len(y)
    leverage, seen = (own.square() * shrunk).sum(1), own @ mean
    unseen = (seen - leverage * y) / (1.0 - leverage).clamp(min=0.1) - seen
    return _Believed(
        gain,
        where,
        whitened @ vectors,
        mean,
        (variance * shrunk).sqrt(),
        unseen.unflatten(0, scaled.shape)[:, 0] / root[:, 0],
    )


def _log_likelihood(y: Tensor, values: Tensor, along: Tensor, ratio: float) -> float:
    """Return the log-likelihood of rows [N], at the noise with the largest likelihood.

    Args:
        y: the rows.
        values: eigenvalues of the design's square, [K].
        along: product of rows and design, along the eigenvectors, [K].
        ratio: variance of the map over that of the noise.
    """
    explained = (along.square() * ratio / (1.0 + ratio * values)).sum()
    variance = ((y.square().sum() - explained) / len(y)).clamp(min=1e-30)
    return float(-0.5 * len(y) * variance.log() - 0.5 * (ratio * values).log1p().sum())


def _whitening(floor: Floor) -> Tensor:
    """Return the matrix [K, K] from independent normal numbers to bells' weights."""
    covariance = floor.bells(floor.centres)[0]
    covariance.diagonal().add_(_JITTER)
    triangle = torch.linalg.cholesky(covariance)
    one = torch.eye(len(triangle), dtype=triangle.dtype)
    return torch.linalg.solve_triangular(triangle, one, upper=False).T


def _effects(floor: Floor, start: Tensor, moved: Tensor) -> Tensor:
    """Return each bell's effect on each row's turn and distance ahead, [N, 2, K] rad, m."""
    points, chords = pieces(start, moved)
    bells = floor.bells(points.flatten(0, 1)).unflatten(1, points.shape[:2])  # [3, N, P, K]
    across = chords[..., :1] * bells[2] - chords[..., 1:] * bells[1]
    turn = across.sum(1) - moved[:, 2:] * bells[0].mean(1)
    middle = start[:, 2] + moved[:, 2] / 2.0
    along = torch.stack([middle.cos(), middle.sin()], 1)
    ahead = (chords * along.unsqueeze(1)).sum(2, keepdim=True) * bells[0]
    return torch.stack([turn, -ahead.sum(1)], dim=1)
