"""How well a simulator of a real quadruped, adapted to some of its trials, predicts the others.

    python benchmarks/quadratot.py [--seeds 10] [--data FOLDER] [--out FILE] [--quick] [--json]

The robot is a QuadraTot (Yosinski et al. 2011): 634 trials of gaits of five parameters, each with
the distance between the places before and after it, in pixels of 1.7 mm. A seed samples 40 trials.
The simulator (:mod:`neurosim.simulators.legged.quadratot`) is adapted to these by L3 of back to
reality (CMA-ES, 8 generations of 12 parameter sets), and predicts the other 594. It is compared
with:

- the simulator as it is, which knows no trial;
- a Gaussian process (Matern 5/2, a length for each parameter, noise) on the same 40;
- the two joined: a Gaussian process on the simulator's residuals, whose mean is a line through the
  simulator's predictions; with the simulator as it is, and adapted;
- the mean of the 40, for all.

All compare and learn square roots of distances, because repeats of gaits that go far differ more.
Errors are root mean squares over the 594, in pixels and in square roots, divided by the standard
deviation of repeats of one and the same gait (94 gaits of the data have several trials). A
prediction that knows each gait's mean has 1. The rank is Spearman's. No constant was chosen on
these trials; the model's docstring says which of its values are guesses.

The record is expected at ``../shared/data/real/quadratot``, with a ``gaits.csv``. A seed takes
three minutes of a core; ``--out`` keeps the result of each seed, which is then not computed again.
It needs the extras ``bench``, ``mujoco`` and ``cma``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from neurosim.back_to_reality import Simulated
from neurosim.back_to_reality.adapt import SPREAD, Compared, best_set, rank_correlation
from neurosim.back_to_reality.settings import settings_named
from neurosim.base.errors import UserError
from neurosim.base.files import JsonLines
from neurosim.base.generations import run_generations
from neurosim.controllers.sine_gait import SineGait
from neurosim.evolution.climb import Climb
from neurosim.evolution.optimisers import make_optimiser
from neurosim.evolution.space import SearchSpace
from neurosim.robots.quadratot import FRAME
from neurosim.simulators.legged.quadratot import QuadraTot
from neurosim.simulators.legged.simulator import LeggedSimulator
from neurosim.tasks.base import Judgement
from neurosim.tasks.walking import Walking

Array = NDArray[np.float64]

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "real" / "quadratot"
COLUMNS = ["amp", "tau_s", "scale_in_out", "mult_fb", "mult_lr", "distance_px"]
#: Number of trials that are sampled.
SAMPLED = 40
#: Height of the camera above the robot, m, and duration of a trial, s.
PIXEL, SECONDS = 0.0017, 12.0
GAIT = SineGait(SECONDS)
METHODS = (
    "mean of the sampled trials",
    "Gaussian process",
    "simulator as it is",
    "simulator adapted",
    "process on the simulator as it is",
    "process on the simulator adapted",
)


@dataclass(frozen=True)
class Roots(Walking):
    """Walking whose fitness is the square root of the displacement in pixels."""

    circle: float = 0.0

    def worth(self, record: Array) -> Judgement:
        """Return square roots of displacements."""
        judged = super().worth(record)
        roots = np.sqrt(judged.fitness * self.seconds / PIXEL)
        return Judgement.of(roots, judged.success, judged.reason, progress=roots)


class Trials(NamedTuple):
    """Trials of the real robot.

    Attributes:
        genes: [N, 5] of their gaits.
        gait: [N] a number for each gait; repeats have the same.
        roots: [N] square roots of the distances in pixels.
    """

    genes: Array
    gait: NDArray[np.int64]
    roots: Array


def read_trials(folder: Path) -> Trials:
    """Read the record of the real robot.

    Raises:
        UserError: if it is not there, or has other columns.
    """
    path = folder / "gaits.csv"
    if not path.is_file():
        raise UserError(f"there is no {path}: name the folder of the record with --data")
    table = pd.read_csv(path)
    if missing := [name for name in COLUMNS if name not in table]:
        raise UserError(f"{path} has no column {missing[0]}")
    values = table[COLUMNS].to_numpy(float)
    names = [one.name for one in GAIT.parameters]
    genes = np.stack([GAIT.from_named(dict(zip(names, row, strict=True))) for row in values[:, :5]])
    _, gait = np.unique(values[:, :5], axis=0, return_inverse=True)
    return Trials(genes, gait.ravel(), np.sqrt(values[:, 5]))


class Robot(NamedTuple):
    """The real robot and its simulator.

    Attributes:
        trials: all of the real robot.
        noise: standard deviation of repeats, in pixels and in square roots.
        simulated: its simulator.
        as_is: [N] its predictions of the trials before it is adapted, square roots.
    """

    trials: Trials
    noise: tuple[float, float]
    simulated: Simulated
    as_is: Array


def robot_of(trials: Trials, noise: tuple[float, float]) -> Robot:
    """Return a robot of trials, with its simulator's predictions."""
    simulated = Simulated(LeggedSimulator(QuadraTot()), Roots(SECONDS, FRAME, 0.0), GAIT)
    return Robot(trials, noise, simulated, predicted(simulated, trials, simulated.as_is))


def noise_of(values: Array, gait: NDArray[np.int64]) -> float:
    """Return the standard deviation of repeats, over all gaits that were tried several times."""
    counts = np.bincount(gait)
    means = np.bincount(gait, values) / np.maximum(counts, 1)
    return float(np.sqrt(((values - means[gait]) ** 2).sum() / np.maximum(counts - 1, 0).sum()))


def adapted(simulated: Simulated, trials: Trials, seed: int, generations: int) -> Array:
    """Return the parameters [K], as fractions, that L3 finds for trials."""
    how = settings_named("better").adapt_genetic
    compared = Compared(simulated, trials.genes, trials.roots)
    start = simulated.as_is[None]
    space = SearchSpace(start, (seed, 0, 3), how, SPREAD, (0.0, 1.0), how.population)
    climb = Climb(make_optimiser("cma", space), lambda sets: -compared.discrepancy(sets))
    if run_generations(climb, generations, f"seed {seed}: L3"):
        raise KeyboardInterrupt
    return best_set(compared, climb, start[0])


def predicted(simulated: Simulated, trials: Trials, parameters: Array) -> Array:
    """Return predictions of trials by a simulator with parameters [K], [N] square roots."""
    _, first, place = np.unique(trials.gait, return_index=True, return_inverse=True)
    return simulated.fitness(trials.genes[first], parameters)[place]


def process(genes: Array, roots: Array, at: Array) -> Array:
    """Return the mean [M] of a Gaussian process on gaits [N, 5] and values [N], at gaits [M, 5]."""
    try:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
        from threadpoolctl import threadpool_limits
    except ImportError:
        raise UserError(
            "the Gaussian process needs the package scikit-learn: pip install scikit-learn"
        ) from None
    kernel = ConstantKernel(1.0, (1e-2, 1e2)) * Matern(np.full(5, 0.5), (0.05, 20.0), nu=2.5)
    kernel += WhiteKernel(0.1, (1e-3, 1.0))
    model = GaussianProcessRegressor(
        kernel, normalize_y=True, n_restarts_optimizer=2, random_state=0
    )
    with threadpool_limits(1), warnings.catch_warnings():
        # A parameter that nothing depends on has the longest length there may be.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return model.fit(genes, roots).predict(at)


def joined(mean: Array, mean_at: Array, genes: Array, roots: Array, at: Array) -> Array:
    """Return predictions [M] of a process on the residuals of a line through a simulator's.

    Args:
        mean, mean_at: [N], [M] the simulator's predictions.
        genes, roots, at: as of :func:`process`.
    """
    slope, level = np.polyfit(mean, roots, 1)
    rest = process(genes, roots - (level + slope * mean), at)
    return level + slope * mean_at + rest


def measures(result: Array, trials: Trials, noise: tuple[float, float]) -> dict[str, float | None]:
    """Return rank, and errors over the noise, of predictions [N] of trials (square roots)."""
    result = np.maximum(result, 0.0)
    pixels = np.sqrt(np.mean((result**2 - trials.roots**2) ** 2))
    roots = np.sqrt(np.mean((result - trials.roots) ** 2))
    rank = rank_correlation(result, trials.roots)
    return {"rank": rank, "pixels": float(pixels / noise[0]), "roots": float(roots / noise[1])}


def one_seed(
    robot: Robot, seed: int, sampled: int = SAMPLED, generations: int | None = None
) -> dict[str, Any]:
    """Return every method's predictions of the trials that are not sampled.

    Args:
        robot: the real one, and its simulator.
        seed: of the sampled trials, and of L3.
        sampled: number of trials.
        generations: of L3; by default those of our settings; 0: no L3.
    """
    began, trials, simulated = time.monotonic(), robot.trials, robot.simulated
    simulated.tried = 0
    order = np.random.default_rng(seed).permutation(len(trials.roots))
    own, other = np.split(order, [sampled])
    known, held = (Trials(*(one[part] for one in trials)) for part in (own, other))
    count = settings_named("better").adapt_generations if generations is None else generations
    commanded = {
        METHODS[0]: np.full(len(other), known.roots.mean()),
        METHODS[1]: process(known.genes, known.roots, held.genes),
    }
    simulators, result = {"as it is": (robot.as_is[own], robot.as_is[other])}, None
    if count:
        result = adapted(simulated, known, seed, count)
        simulators["adapted"] = tuple(predicted(simulated, one, result) for one in (known, held))
    for name, (mean, mean_at) in simulators.items():
        commanded[f"simulator {name}"] = mean_at
        commanded[f"process on the simulator {name}"] = joined(
            mean, mean_at, known.genes, known.roots, held.genes
        )
    parameters = {}
    if result is not None:
        values = simulated.values(result).tolist()
        names = (one.name for one in simulated.parameters)
        parameters = dict(zip(names, values, strict=True))
    return {
        "seed": seed,
        "sampled": sampled,
        "generations": count,
        "noise": robot.noise,
        "held out": {name: measures(commanded[name], held, robot.noise) for name in commanded},
        "sampled ones": {
            name: measures(mean, known, robot.noise) for name, (mean, _) in simulators.items()
        },
        "parameters": parameters,
        "simulated": simulated.tried,
        "seconds": round(time.monotonic() - began, 1),
    }


def over_seeds(rows: list[dict[str, Any]]) -> dict[str, dict[str, str]]:
    """Return median, least and most over seeds, in words, of each method's three measures."""
    cells: dict[str, dict[str, str]] = {}
    for name in (one for one in METHODS if one in rows[0]["held out"]):
        cells[name] = {}
        for what in ("rank", "pixels", "roots"):
            values = [row["held out"][name][what] for row in rows]
            if None not in values:
                low, middle, high = np.quantile(values, [0.0, 0.5, 1.0])
                cells[name][what] = f"{middle:.2f} ({low:.2f} to {high:.2f})"
    return cells


def summary(rows: list[dict[str, Any]]) -> str:
    """Return the table of medians over seeds, for a person."""
    text = f"{len(rows)} seeds of {rows[0]['sampled']} trials; "
    text += "medians, in brackets the least and the most\n"
    text += f"  {'':36s}{'rank':>20s}{'error px / noise':>22s}{'error roots / noise':>22s}\n"
    for name, cells in over_seeds(rows).items():
        text += f"  {name:36s}"
        for what, width in (("rank", 20), ("pixels", 22), ("roots", 22)):
            text += f"{cells.get(what, '-'):>{width}s}"
        text += "\n"
    noise = rows[0]["noise"]
    text += f"noise of repeats: {noise[0]:.1f} px, {noise[1]:.2f} in square roots\n"
    for name in rows[0]["sampled ones"]:
        own = [row["sampled ones"][name]["roots"] for row in rows]
        text += f"simulator {name}, sampled trials: {np.median(own):.2f} (roots / noise)\n"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=DATA, help="folder of gaits.csv")
    parser.add_argument("--seeds", type=int, default=10, help="how many")
    parser.add_argument("--generations", type=int, help="of L3; 0: no L3, a minute for 20 seeds")
    parser.add_argument("--out", type=Path, help="file that keeps each seed, one a line")
    parser.add_argument("--quick", action="store_true", help="10 trials, 1 generation, 30 held out")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    try:
        rows = all_seeds(options)
    except UserError as error:
        sys.exit(f"{parser.prog}: {error}")
    result = {"seeds": rows, "over_seeds": over_seeds(rows)}
    print(json.dumps(result) if options.json else summary(rows))


def all_seeds(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of all seeds; those that the file has are not computed again."""
    trials = read_trials(options.data)
    noise = noise_of(trials.roots**2, trials.gait), noise_of(trials.roots, trials.gait)
    how = {"sampled": SAMPLED, "generations": options.generations}
    if options.quick:
        part = np.random.default_rng(0).permutation(len(trials.roots))[:40]
        trials = Trials(*(one[part] for one in trials))
        how = {"sampled": 10, "generations": 1}
    kept = JsonLines(options.out, "neurosim-quadratot", 1, how) if options.out else None
    rows = [row for row in kept.rows if row["seed"] < options.seeds] if kept else []
    if missing := sorted(set(range(options.seeds)) - {row["seed"] for row in rows}):
        robot = robot_of(trials, noise)
        for seed in missing:
            rows.append(one_seed(robot, seed, **how))
            if kept:
                kept.append(rows[-1])
    return rows


if __name__ == "__main__":
    main()
