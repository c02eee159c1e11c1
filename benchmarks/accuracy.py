"""How well the trainers predict, compared with ordinary regressors and the noise floor.

    python benchmarks/accuracy.py DATASET [--floor data/noise_floor.json] [--seeds 5] [--json]
    python benchmarks/accuracy.py DATASET --sizes
    python benchmarks/accuracy.py UTIAS_FOLDER            (Odometry and Groundtruth files)

Mean absolute error on the last rows in time (a fifth; of MRCLAM files a quarter), its ratio to the
noise floor, and the seconds of one training of all outputs; medians over seeds. One network for
each output, no ensemble. They are compared with regressors of scikit-learn with its defaults, each
also on the residuals of the ideal unicycle: gradient boosting, a Gaussian process (one length scale
for each input, fitted on 1,000 rows, at most 2,000 rows used) and a random forest. If the floor was
measured with commands of held-out rows, the medians of the floor's drives are compared with these
rows too: no predictor can be expected to do better.

``--sizes`` trains on the first 100, 200, 500, 1,000, 2,000 and all rows. ``--quick`` uses one seed
and a short run of the paper's trainer, whose whole run takes minutes (see ga_training.py).
``--trainers combined --no-regressors`` measures the default trainer alone. ``--without NAME ...``
leaves out its parts, one at a time (see its settings); without ``parts`` it learns from whole
commands only.
Regressors: pip install scikit-learn (extra ``bench``).
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurosim.base import files
from neurosim.training.evaluate import errors
from neurosim.training.train import learn, training_data
from neurosim.training.trainers.combined import MECHANISMS
from neurosim.training.trainers.registry import TRAINERS
from neurosim.training.unicycle import unicycle
from tracking.datasets.dataset import Dataset
from tracking.datasets.mrclam import import_mrclam

OUTPUTS = ("dx", "dy", "dtheta")
SIZES = (100, 200, 500, 1000, 2000, 5000)
#: A whole run of the paper's trainer belongs to ga_training.py.
GA_GENERATIONS = 500
#: Learns from inputs (N, I) and outputs (N, 3) with a seed; returns a predictor.
Drives = tuple[np.ndarray, np.ndarray]
Learner = Callable[[Dataset, int], Callable[[np.ndarray], np.ndarray]]


def read(path: Path) -> tuple[Dataset, Dataset]:
    """Return the earlier rows and the held-out ones of a dataset or of MRCLAM files."""
    if (path / "dataset.json").exists():
        return Dataset.read(path).split(0.2)
    with tempfile.TemporaryDirectory() as folder:
        return import_mrclam(path, Path(folder) / "dataset").split(0.25)


def trainer(name: str, generations: int | None = None, without: str = "") -> Learner:
    def fitted(rows: Dataset, seed: int) -> Callable[[np.ndarray], np.ndarray]:
        settings: dict[str, Any] = {"generations": generations} if generations else {}
        if name == "combined":
            settings = {"members": 1, "noise": False, "whole_commands": without == "parts"}
            settings["without"] = (without,) if without not in ("", "parts") else ()
        simulator = learn(training_data(rows), seed, trainer=name, **settings)
        return lambda x: simulator.displacement_of(simulator.chained(torch.tensor(x))).numpy()

    return fitted


def regressors() -> dict[str, Callable[[int], object]]:
    from sklearn.ensemble import HistGradientBoostingRegressor, RandomForestRegressor

    return {
        "gradient boosting": lambda seed: HistGradientBoostingRegressor(random_state=seed),
        "random forest": lambda seed: RandomForestRegressor(random_state=seed, n_jobs=2),
        "Gaussian process": _GaussianProcess,
    }


class _GaussianProcess:
    """A Gaussian process on random rows; its length scales are fitted on fewer rows."""

    def __init__(self, seed: int):
        self._rng = np.random.default_rng(seed)

    def fit(self, x: np.ndarray, y: np.ndarray) -> _GaussianProcess:
        """Learn from inputs (N, I) and one output (N,)."""
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

        order = self._rng.permutation(len(x))
        kernel = ConstantKernel(1.0) * RBF(np.ones(x.shape[1])) + WhiteKernel(0.01)
        part = order[:1000]
        result = GaussianProcessRegressor(kernel, normalize_y=True).fit(x[part], y[part])
        part = order[:2000]
        self._model = GaussianProcessRegressor(result.kernel_, optimizer=None, normalize_y=True)
        self._model.fit(x[part], y[part])
        return self

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return the output (N,) of inputs (N, I)."""
        return self._model.predict(x)


def regressor(make: Callable[[int], object], on_residual: bool) -> Learner:
    def learn(rows: Dataset, seed: int) -> Callable[[np.ndarray], np.ndarray]:
        ideal = unicycle(rows)
        x, y = rows.input_array(), rows.output_array()
        scale = np.abs(x).max(0)
        left = y - ideal.displacement(x) if on_residual else y
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # lengths at their bounds
            models = [make(seed).fit(x / scale, column) for column in left.T]

        def predict(inputs: np.ndarray) -> np.ndarray:
            result = np.stack([model.predict(inputs / scale) for model in models], axis=1)
            return result + ideal.displacement(inputs) if on_residual else result

        return predict

    return learn


def learners(options: argparse.Namespace) -> dict[str, Learner]:
    results: dict[str, Learner] = {}
    for name in options.trainers:
        short = name == "ga"
        label = f"ga, {GA_GENERATIONS} generations" if short else name
        results[label] = trainer(name, GA_GENERATIONS if short else None)
    for part in options.without:
        results[f"combined without {part}"] = trainer("combined", without=part)
    results["ideal unicycle"] = lambda rows, seed: unicycle(rows).displacement
    if options.regressors:
        try:
            for name, make in regressors().items():
                results[name] = regressor(make, on_residual=False)
                results[f"{name} on unicycle"] = regressor(make, on_residual=True)
        except ImportError as error:
            print(f"regressors are left out: {error}", file=sys.stderr)
    return results


def judge(
    learn: Learner, rows: Dataset, later: Dataset, seeds: int, drives: Drives | None
) -> dict[str, object]:
    """Return the errors (cm, cm, deg) of every seed, their medians, and the median seconds."""
    runs, seconds, driven = [], [], []
    for seed in range(seeds):
        began = time.perf_counter()
        predict = learn(rows, seed)
        seconds.append(time.perf_counter() - began)
        runs.append(absolute(predict(later.input_array()), later.output_array()))
        if drives is not None:
            driven.append(absolute(predict(drives[0]), drives[1]))
    result = {"error": np.median(runs, axis=0).tolist(), "runs": runs}
    if driven:
        result |= {"on_drives": np.median(driven, axis=0).tolist(), "drives_runs": driven}
    return {**result, "seconds": statistics.median(seconds)}


def absolute(predicted: np.ndarray, actual: np.ndarray) -> list[float]:
    table = errors(predicted, actual)
    return [table[name]["mean_absolute_error"] for name in OUTPUTS]


def read_floor(path: Path | None) -> list[float] | None:
    if path is None or not path.exists():
        return None
    floor = json.loads(path.read_text(encoding="utf-8"))["floor"]
    return [floor[name]["mean_absolute_deviation"] for name in OUTPUTS]


def read_drives(path: Path, inputs: tuple[str, ...]) -> Drives | None:
    """Return the inputs (N, I) and displacements (N, 3) of the drives that a floor is of."""
    path = path.with_suffix(".csv")
    if not path.exists():
        return None
    table = files.read_csv(path, dict.fromkeys((*inputs, *OUTPUTS), files.number))
    inputs_, outputs = (
        np.array([table[name] for name in names], float).T for names in (inputs, OUTPUTS)
    )
    return inputs_, outputs


def of_medians(drives: Drives, later: Dataset) -> dict[str, object] | None:
    """Return the errors of the drives' medians on the held-out rows of the same commands."""
    commands, number = np.unique(drives[0], axis=0, return_inverse=True)
    medians = [np.median(drives[1][number == n], axis=0) for n in range(len(commands))]
    known = {tuple(command): median for command, median in zip(commands, medians, strict=True)}
    rows = list(zip(map(tuple, later.input_array()), later.output_array(), strict=True))
    pairs = np.array([(known[command], moved) for command, moved in rows if command in known])
    if not len(pairs):
        return None
    error = absolute(pairs[:, 0], pairs[:, 1])
    return {"error": error, "rows": len(pairs), "seconds": float("nan")}


def line(name: str, result: dict[str, object], floor: list[float] | None) -> str:
    error = result["error"]
    nothing = [float("nan")] * 3
    ratios = [
        e / f
        for e in (error, result.get("on_drives", nothing))
        for e, f in zip(e, floor or nothing, strict=True)
    ]
    return (
        f"{name:30s}"
        + "".join(f"{ratio:8.2f}" for ratio in ratios)
        + "".join(f"{value:9.3f}" for value in error)
        + f"{result['seconds']:9.1f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--floor", type=Path, default=Path("data/noise_floor.json"))
    parser.add_argument("--no-floor", action="store_true", help="of another robot")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--trainers", nargs="*", default=TRAINERS.names(), choices=TRAINERS.names())
    parser.add_argument("--without", nargs="*", default=[], choices=(*MECHANISMS, "parts"))
    parser.add_argument("--no-regressors", dest="regressors", action="store_false")
    parser.add_argument("--sizes", action="store_true", help="error against the number of rows")
    parser.add_argument("--quick", action="store_true", help="one seed")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    earlier, later = read(options.dataset)
    same_robot = earlier.inputs[:2] == ("prev_left", "prev_right") and not options.no_floor
    floor = read_floor(options.floor) if same_robot else None
    drives = read_drives(options.floor, earlier.inputs) if floor else None
    seeds = 1 if options.quick else options.seeds
    counts = [len(earlier)]
    if options.sizes:
        counts = [n for n in SIZES if n < len(earlier)] + counts
    result: dict[str, object] = {"floor": floor, "held_out_rows": len(later), "rows": {}}
    medians = of_medians(drives, later) if drives else None
    if medians:
        result["floor_medians"] = medians
    for count in counts:
        if not options.json:
            print(f"\n{count} rows to learn from, {len(later)} held out, {seeds} seeds")
            print(f"{'':30s}{'error / floor':>24s}{'on its drives':>24s}", end="")
            print(f"{'cm':>9s}{'cm':>9s}{'deg':>9s}{'s':>9s}")
        table = result["rows"].setdefault(count, {})
        for name, learner in learners(options).items():
            repeats = 1 if name == "ideal unicycle" else seeds
            table[name] = judge(learner, earlier.part(slice(count)), later, repeats, drives)
            if not options.json:
                print(line(name, table[name], floor), flush=True)
        if medians and not options.json:
            print(line(f"floor's medians, {medians['rows']} rows", medians, floor))
    if options.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
