"""Usual models, fitted to windows of logs, with which ``real_robots.py`` compares the learner.

    lagged unicycle   body twist linear in the commands after a lag and a delay, fitted in turn
    lagged bicycle    the same, with squares and products of two commands: a car at small angles
    ridge             ridge regression on products of two, its penalty by cross-validation
    process           Gaussian process, lengths of 150 windows, at most 500 used
    boosting          gradient boosting of histograms, scikit-learn's defaults
    ensemble          mean of five perceptrons, two layers of 64, stopped early on their own tenths
    PETS              five such networks that predict mean and variance of the next 0.25 s from the
                      speed and the commands, as in Chua et al. 2018; particles keep their network

The two lagged models and PETS are composed of steps; the others learn the displacement of a window
of one length from means of commands before and within it, and of a free run compose windows of 1 s.
``zoo.py`` has the lagged models too: there a window is a whole command, after the one before.
"""

from __future__ import annotations

import warnings
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from neurosim.base import se2

Array = NDArray[np.float64]

#: Lags and delays that the lagged models are tried with, s.
LAGS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2, 2.4, 4.8)
DELAYS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4)
#: Windows that fit the lengths of the Gaussian process, and windows that it uses.
FITTED_ON, USED = 150, 500
NETWORKS, WIDTH, EPOCHS, PATIENCE = 5, 64, 400, 40
#: A step of PETS, s, and its particles.
PETS_STEP, PARTICLES = 0.25, 200


class Lagged:
    """A body twist linear in commands (and products of two) after a lag and a delay."""

    def __init__(self, products: bool, step: float, warm: float):
        self._products, self._step, self._warm = products, step, round(warm / step)

    def fit(self, commands: Array, moved: Array, spans: Array | None = None) -> Lagged:
        """Learn from windows: commands [W, K, C] from before them on, displacements [W, 3].

        Args:
            commands: in steps.
            moved: m, m, rad.
            spans: how much of each step within a window belongs to it, [W, K'] s; None: all.
        """
        self._scale = np.abs(commands).max((0, 1))
        middle = se2.mid_turn(moved)
        chord = np.sinc(moved[:, 2:] / 2 / np.pi)
        self._best: list[tuple] = [(np.inf,), (np.inf,)]
        for lag in LAGS:
            for delay in DELAYS:
                distances = self._distances(commands, lag, delay, spans).sum(1)
                targets = ((distances * chord, middle[:, :2]), (distances, moved[:, 2:]))
                for kind, (x, y) in enumerate(targets):
                    pull = 1e-4 * len(x) * np.diag((x**2).mean(0) + 1e-12)
                    weights = np.linalg.solve(x.T @ x + pull, x.T @ y)
                    error = np.abs(x @ weights - y).sum()
                    if error < self._best[kind][0]:
                        self._best[kind] = (error, lag, delay, weights)
        return self

    def _distances(self, commands: Array, lag: float, delay: float, spans: Array | None) -> Array:
        """Return actuators' speeds (and products of two) times time of steps, [W, K', F]."""
        late, u = round(delay / self._step), commands / self._scale
        if late:
            u = np.concatenate([np.repeat(u[:, :1], late, 1), u[:, :-late]], 1)
        if lag > 0.0:
            stays, speed, mean = np.exp(-self._step / lag), u[:, 0], np.empty_like(u)
            for k in range(u.shape[1]):
                after = stays * speed + (1.0 - stays) * u[:, k]
                mean[:, k], speed = (speed + after) / 2.0, after
            u = mean
        u = u[:, self._warm :]
        count = u.shape[2]
        pairs = [(a, b) for a in range(count) for b in range(a, count)] if self._products else []
        both = [u[..., a : a + 1] * u[..., b : b + 1] for a, b in pairs]
        return np.concatenate([u, *both], 2) * (self._step if spans is None else spans[..., None])

    def predict(self, commands: Array, spans: Array | None = None) -> Array:
        """Return the displacements [W, 3] of windows of any length."""
        parts = [
            self._distances(commands, lag, delay, spans) @ weights
            for _, lag, delay, weights in self._best
        ]
        pose = np.zeros((len(commands), 3))
        for twist in np.moveaxis(np.concatenate(parts, 2), 1, 0):
            pose = se2.compose(pose, se2.exp(twist))
        return pose


def described(commands: Array, speed: Array | None, warm: int) -> Array:
    """Return a regressor's inputs of windows, [W, F].

    Means of the commands 1 to 0.5, 0.5 to 0.2 and 0.2 to 0 s before, and of quarters of the window.
    """
    before = [commands[:, warm - a : warm - b].mean(1) for a, b in ((20, 10), (10, 4), (4, 0))]
    inside = commands[:, warm:]
    quarters = np.array_split(inside, min(4, inside.shape[1]), axis=1)
    parts = [*before, *(part.mean(1) for part in quarters)]
    return np.concatenate(parts if speed is None else [*parts, np.nan_to_num(speed)], 1)


class Regressor:
    """A regressor of displacements of one length, or of the residuals of another model."""

    def __init__(self, kind: str, base: Lagged | None, speeds: bool, warm: int, seed: int):
        self._kind, self._base, self._speeds = kind, base, speeds
        self._warm, self._seed = warm, seed

    def _x(self, commands: Array, speed: Array) -> Array:
        return described(commands, speed if self._speeds else None, self._warm)

    def fit(self, commands: Array, moved: Array, speed: Array) -> Regressor:
        """Learn from windows: displacements [W, 3], and speeds [W, 3] measured before."""
        x, y = self._x(commands, speed), moved
        if self._base is not None:
            y = y - self._base.predict(commands)
        self._centre, self._spread = x.mean(0), x.std(0) + 1e-9
        self._mean, self._size = y.mean(0), y.std(0) + 1e-9
        x, y = (x - self._centre) / self._spread, (y - self._mean) / self._size
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # lengths at their bounds
            self._model: Any = _MAKERS[self._kind](x, y, self._seed)
        return self

    def predict(self, commands: Array, speed: Array) -> tuple[Array, Array | None]:
        """Return displacements [W, 3], and their standard deviations where they are known."""
        x = (self._x(commands, speed) - self._centre) / self._spread
        result = self._model(x)
        result, error = result if isinstance(result, tuple) else (result, None)
        result = result * self._size + self._mean
        if self._base is not None:
            result = result + self._base.predict(commands)
        return result, None if error is None else error * self._size


def _ridge(x: Array, y: Array, seed: int):
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    model = make_pipeline(
        PolynomialFeatures(2, include_bias=False),
        StandardScaler(),
        RidgeCV(np.logspace(-3, 4, 15)),
    )
    return model.fit(x, y).predict


def _boosting(x: Array, y: Array, seed: int):
    from sklearn.ensemble import HistGradientBoostingRegressor

    models = [HistGradientBoostingRegressor(random_state=seed).fit(x, own) for own in y.T]
    return lambda x: np.stack([model.predict(x) for model in models], 1)


def _process(x: Array, y: Array, seed: int):
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    order = np.random.default_rng(seed).permutation(len(x))
    models = []
    for own in y.T:
        kernel = ConstantKernel(1.0) * RBF(np.full(x.shape[1], 3.0), (0.3, 300.0))
        kernel += WhiteKernel(0.1, (1e-4, 2.0))
        few, many = order[:FITTED_ON], order[:USED]
        result = GaussianProcessRegressor(kernel).fit(x[few], own[few]).kernel_
        models.append(GaussianProcessRegressor(result, optimizer=None).fit(x[many], own[many]))

    def predict(x: Array) -> tuple[Array, Array]:
        means, errors = zip(*(model.predict(x, return_std=True) for model in models), strict=True)
        return np.stack(means, 1), np.stack(errors, 1)

    return predict


class _Networks(nn.Module):
    """Perceptrons side by side, [N, B, I] -> [N, B, O]."""

    def __init__(self, inputs: int, outputs: int, generator: torch.Generator):
        super().__init__()
        sizes = (inputs, WIDTH, WIDTH, outputs)
        self.weights = nn.ParameterList()
        for a, b in pairwise(sizes):
            random = torch.randn(NETWORKS, a, b, generator=generator) / a**0.5
            self.weights += [nn.Parameter(random), nn.Parameter(torch.zeros(NETWORKS, 1, b))]

    def forward(self, x: Tensor) -> Tensor:
        for k in range(0, len(self.weights), 2):
            x = torch.baddbmm(self.weights[k + 1], x, self.weights[k])
            x = x.tanh() if k + 2 < len(self.weights) else x
        return x


def _trained(x: Array, y: Array, seed: int, variance: bool) -> _Networks:
    """Return networks trained by Adam on bootstrap samples, each stopped early on its own tenth."""
    generator = torch.Generator().manual_seed(seed)
    inputs, targets = (torch.tensor(part, dtype=torch.float32) for part in (x, y))
    model = _Networks(x.shape[1], y.shape[1] * (1 + variance), generator)
    orders = torch.stack([torch.randperm(len(x), generator=generator) for _ in range(NETWORKS)])
    tenth = max(len(x) // 10, 2)
    apart, own = orders[:, :tenth], orders[:, tenth:]
    optimiser = torch.optim.Adam(model.parameters(), 3e-3, weight_decay=1e-4)

    def losses(places: Tensor) -> Tensor:
        result, wanted = model(inputs[places]), targets[places]
        if not variance:
            return (result - wanted).square().mean((1, 2))
        mean, log = result.chunk(2, 2)
        log = log.clamp(-8.0, 3.0)
        return ((mean - wanted).square() * (-log).exp() + log).mean((1, 2))

    best = [torch.full((NETWORKS,), torch.inf), [p.detach().clone() for p in model.parameters()]]
    since, batch = 0, min(256, own.shape[1])
    for _ in range(EPOCHS):
        mixed = own.gather(1, torch.rand(own.shape, generator=generator).argsort(1))
        for part in mixed.split(batch, 1):
            optimiser.zero_grad()
            losses(part).sum().backward()
            optimiser.step()
        with torch.no_grad():
            now = losses(apart)
            better = now < best[0]
            best[0] = torch.where(better, now, best[0])
            for kept, value in zip(best[1], model.parameters(), strict=True):
                kept[better] = value[better]
        since = 0 if better.any() else since + 1
        if since >= PATIENCE:
            break
    with torch.no_grad():
        for kept, value in zip(best[1], model.parameters(), strict=True):
            value.copy_(kept)
    return model


def _ensemble(x: Array, y: Array, seed: int):
    model = _trained(x, y, seed, False)

    def predict(x: Array) -> Array:
        with torch.no_grad():
            given = torch.tensor(x, dtype=torch.float32).expand(NETWORKS, *x.shape)
            return model(given).mean(0).double().numpy()

    return predict


_MAKERS = {"ridge": _ridge, "process": _process, "boosting": _boosting, "ensemble": _ensemble}


class Pets:
    """A probabilistic ensemble that is composed of steps, from a measured speed on."""

    def __init__(self, step: float, warm: int, seed: int):
        self._steps, self._length, self._warm, self._seed = (
            round(PETS_STEP / step),
            PETS_STEP,
            warm,
            seed,
        )

    def _x(self, speed: Array, commands: Array, begin: int) -> Array:
        n = self._steps
        before = [commands[:, begin - (k + 1) * n : begin - k * n].mean(1) for k in (1, 0)]
        inside = [commands[:, begin + k] for k in range(n)]
        return np.concatenate([speed, *before, *inside], 1)

    def fit(self, commands: Array, moved: Array, speed: Array) -> Pets:
        """Learn from windows of :data:`PETS_STEP` that have a speed before."""
        known = np.isfinite(speed).all(1)
        x, y = self._x(speed, commands, self._warm)[known], moved[known]
        self._centre, self._spread = x.mean(0), x.std(0) + 1e-9
        self._mean, self._size = y.mean(0), y.std(0) + 1e-9
        x, y = (x - self._centre) / self._spread, (y - self._mean) / self._size
        self._model = _trained(x, y, self._seed, True)
        return self

    def predict(self, commands: Array, speed: Array) -> tuple[Array, Array]:
        """Return the mean displacements [W, 3] of windows and those of particles, [P, W, 3]."""
        generator = torch.Generator().manual_seed(self._seed)
        each, count = PARTICLES // NETWORKS, len(commands)
        poses = np.zeros((NETWORKS, each * count, 3))
        speeds = np.tile(np.nan_to_num(speed), (NETWORKS, each, 1))
        commanded = np.tile(commands, (each, 1, 1))
        for begin in range(self._warm, commands.shape[1] - self._steps + 1, self._steps):
            x = np.stack([self._x(own, commanded, begin) for own in speeds])
            with torch.no_grad():
                given = torch.tensor((x - self._centre) / self._spread, dtype=torch.float32)
                mean, log = self._model(given.clamp(-10.0, 10.0)).chunk(2, 2)
                noise = torch.randn(mean.shape, generator=generator)
                sampled = mean + noise * (log.clamp(-8.0, 3.0) / 2.0).exp()
            moved = sampled.double().numpy() * self._size + self._mean
            poses, speeds = se2.compose(poses, moved), moved / PETS_STEP
        particles = poses.reshape(NETWORKS * each, count, 3)
        return particles.mean(0), particles
