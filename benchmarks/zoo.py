"""How well the learner predicts robots of different make, compared with ordinary regressors.

    python benchmarks/zoo.py --peers peers.json [--sizes 30,100,300,1000] [--seeds 3] [--json]
    python benchmarks/zoo.py --peers peers.json --learners ours --robots car,omni
    python benchmarks/zoo.py --peers peers.json --outliers --repeated
    python benchmarks/zoo.py --peers peers.json --ours ours.json --json    in parts, or resumed

Robots are those of :mod:`zoo_robots`, judged by their motion without noise, and that of the UTIAS
recording (``--utias FOLDER``, with its Odometry and Groundtruth files), whose last quarter in
time is held out and judged as measured; a seed is a stretch of the rows before. If it has fewer
rows than a size, all of them are used once, for the first such size.

Errors are the mean absolute ones of dx, dy (cm) and dtheta (deg), medians over seeds. A ratio is
the error over that of the best peer at the output; means over outputs and robots are geometric.
Learners:

    ours          the default trainer, no ensemble, no noise model
    whole         the same, from whole commands alone, as peers get them
    ideal         unicycle of two factors, of robots with commands left and right, or v and w
    fitted        unicycle whose speeds ahead and aside and rate of turn are linear in all that a
                  command drives (of a car, also in speed times steering), by least squares
    lagged        unicycle whose twist follows commands after a lag and a delay, both fitted (of a
                  car also squares and products of two commands), of :mod:`real_peers`
    linear        ridge regression on products of two inputs, its penalty by leave-one-out
    forest        random forest                     } of scikit-learn with its defaults, as in
    boosting      gradient boosting of histograms   } accuracy.py
    process       Gaussian process, as in accuracy.py: lengths of 1,000 rows, at most 2,000 used
    perceptrons   mean of five, two layers of 64 tanh each, each stopped early on its own tenth

``+u``: on the residuals of the fitted unicycle; ``+l``: on those of the lagged one. Peers get our
inputs and whole commands.

``--without PART,...``: ours without its drive model's laws (``laws``), ``dead_band``, ``swing``,
``process`` (the Gaussian process) or ``row_weights``, each in turn; columns ``-PART``.

``--outliers``: one row in a hundred, but at least one, ends 30 cm off in a random direction.
``--repeated``: a recording added five times; sizes are its rows before. ``--peers FILE`` keeps
peers' errors: they are measured once, and shown with any ``--learners``. ``--ours FILE`` keeps our
errors. So the zoo can be measured in parts (some ``--robots``, ``--sizes`` or ``--learners`` at a
time), or continued after a stop: a last call with all of them and both files shows it all.
The files know nothing of changes to robots, peers or trainer; delete them then. ``--json`` has also
the root mean square errors.

On one idle core, seconds for a robot, of peers and ours: 6 and 3 at 100 rows, 80 and 20 at 1,000.
``OMP_NUM_THREADS=1`` keeps scikit-learn to it.
scikit-learn: pip install scikit-learn (extra ``bench``).
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from accuracy import regressors
from numpy.typing import NDArray
from real_peers import Lagged
from zoo_robots import CAR, ZOO, Drives, Robot, clean, rows

from neurosim.base import files, se2
from neurosim.base.errors import UserError
from neurosim.training.base import TrainingData, Within
from neurosim.training.evaluate import errors
from neurosim.training.train import learn
from neurosim.training.trainers.combined import MECHANISMS
from tracking.datasets.mrclam import import_mrclam
from tracking.datasets.within import WITHIN

Array = NDArray[np.float64]
Predict = Callable[[Array], Array]

OUTPUTS = ("dx", "dy", "dtheta")
UNITS = ("cm", "cm", "deg")
SIZES = (30, 100, 300, 1000, 3000, 10000)
UTIAS = Path(__file__).resolve().parents[2] / "shared" / "data" / "utias"
#: Noise-free rows that a robot of the zoo is judged by.
JUDGED = 2000
#: Fraction of rows that end elsewhere, and how far off, m.
OUTLIERS, OFF = 0.01, 0.3
REPEATS = 5
#: Commands are given to the lagged unicycle in steps of this, s.
STEP = 0.05


def ours(name: str, inputs: list[dict[str, str]], drives: Drives, seed: int) -> Predict:
    """Learn from drives with the learner that is measured here, in one of :data:`OURS`."""
    data = TrainingData(
        inputs, torch.tensor(drives.x), torch.tensor(drives.y), poses_within(drives)
    )
    without = (name[1:],) if name in ABLATIONS else ()
    whole = name == "whole"
    simulator = learn(data, seed, members=1, noise=False, whole_commands=whole, without=without)
    return lambda x: simulator.displacement_of(simulator.chained(torch.tensor(x))).numpy()


def poses_within(drives: Drives) -> Within | None:
    """Return as many poses within commands as a dataset has."""
    looks = drives.times.shape[1] - 1
    if looks < 1:
        return None
    taken = np.unique(np.linspace(0, looks - 1, WITHIN).astype(int))
    row = np.repeat(np.arange(len(drives.x)), len(taken))
    time = drives.times[:, taken].ravel()
    moved = drives.poses[:, taken].reshape(-1, 3)
    inside = time < np.repeat(drives.times[:, -1], len(taken)) - 1e-2
    return Within(*(torch.tensor(part[inside]) for part in (row, time, moved)))


@dataclass(frozen=True)
class Case:
    """A robot to be learned.

    Attributes:
        robot: names and units of the parts of a command.
        judged: the rows that predictions are compared with.
        learned: of a number of rows and a seed, the rows to learn from.
        most: the largest number of rows there is.
    """

    robot: Robot
    judged: Drives
    learned: Callable[[int, int], Drives]
    most: int | None = None


def of_zoo(name: str) -> Case:
    robot = ZOO[name]
    return Case(robot, clean(robot, JUDGED), lambda count, seed: rows(robot, count, seed))


def of_utias(folder: Path) -> Case:
    """Return the robot of the UTIAS recording."""
    with tempfile.TemporaryDirectory() as made:
        earlier, later = import_mrclam(folder, Path(made) / "dataset").split(0.25)

    def drives(dataset, part: slice = slice(None)) -> Drives:
        x, y = dataset.input_array()[part], dataset.output_array()[part]
        return Drives(x, y, x[:, -1:], y[:, None])  # seen at the end alone

    def learned(count: int, seed: int) -> Drives:
        start = np.random.default_rng([seed, 3]).integers(len(earlier) - count + 1)
        return drives(earlier, slice(start, start + count))

    return Case(Robot(names=("v", "w"), units="SI"), drives(later), learned, len(earlier))


def unicycle(robot: Robot, drives: Drives, two_factors: bool) -> Predict | None:
    """Fit constant body twists in commands' durations; None if there is no such unicycle.

    A twist's parts are linear in features of the command. Durations times features, times
    the chord of the measured turn, are fitted to what was moved in the mid-turn frame.
    """
    count = len(robot.names)
    if two_factors and robot.names not in (("left", "right"), ("v", "w")):
        return None

    def features(x: Array) -> tuple[Array, Array, Array]:
        u = x[:, count : 2 * count]
        if not two_factors:
            product = u[:, :1] * u[:, 1:] if robot.kind == CAR else u[:, :0]
            return u, u, np.column_stack([u, product])
        if robot.names == ("left", "right"):
            u = np.column_stack([u[:, 0] + u[:, 1], u[:, 1] - u[:, 0]])
        return u[:, :1], u[:, :0], u[:, 1:]

    moved, duration = se2.mid_turn(drives.y), drives.x[:, -1]
    chord = se2.chord(moved[:, 2])
    scales = (duration * chord, duration * chord, duration)
    factors = [
        np.linalg.lstsq(scale[:, None] * part, moved[:, place], rcond=None)[0]
        for place, (scale, part) in enumerate(zip(scales, features(drives.x), strict=True))
    ]

    def predict(x: Array) -> Array:
        parts = [part @ factor for part, factor in zip(features(x), factors, strict=True)]
        return se2.exp(x[:, -1:] * np.column_stack(parts))

    return predict


def lagged(robot: Robot, drives: Drives) -> Predict:
    """Fit the lagged unicycle to whole commands, each begun at the speeds of the one before."""
    count = len(robot.names)

    def sampled(x: Array) -> tuple[Array, Array]:
        """Return commands [N, 1 + K, C] in steps, the one before first, and the steps' spans."""
        steps = np.arange(math.ceil(x[:, -1].max() / STEP))
        before, commanded = x[:, None, :count], x[:, None, count : 2 * count]
        commands = np.concatenate([before, commanded.repeat(len(steps), 1)], 1)
        return commands, np.clip(x[:, -1:] - STEP * steps, 0.0, STEP)

    model = Lagged(robot.kind == CAR, STEP, STEP)
    commands, spans = sampled(drives.x)
    model.fit(commands, drives.y, spans)

    def predict(x: Array) -> Array:
        commands, spans = sampled(x)
        return model.predict(commands, spans)

    return predict


class Linear:
    """Ridge regression on inputs and their products."""

    def __init__(self, seed: int):
        from sklearn.linear_model import RidgeCV
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import PolynomialFeatures, StandardScaler

        products = PolynomialFeatures(2, include_bias=False)
        self._model = make_pipeline(products, StandardScaler(), RidgeCV(np.logspace(-6, 3, 10)))

    def fit(self, x: Array, y: Array) -> Linear:
        """Learn from inputs [N, I] and outputs [N]."""
        self._model.fit(x, y)
        return self

    def predict(self, x: Array) -> Array:
        """Return the output [N] of inputs [N, I]."""
        return self._model.predict(x)


class Perceptrons:
    """The mean of perceptrons that predict all outputs together, trained side by side."""

    MEMBERS, UNITS, BATCH, RATE = 5, 64, 256, 5e-3

    def __init__(self, seed: int):
        self._generator = torch.Generator().manual_seed(seed)

    def fit(self, x: Array, y: Array) -> Perceptrons:
        """Learn from inputs [N, I] and outputs [N, 3]; keep the weights best on unseen rows."""
        self._x, self._y = _standard(x), _standard(y)
        inputs, outputs = self._of(x, self._x), self._of(y, self._y)
        count, held = len(x), max(len(x) // 10, 1)
        order = torch.stack(
            [torch.randperm(count, generator=self._generator) for _ in range(self.MEMBERS)]
        )
        unseen, seen = order[:, :held], order[:, held:]
        sizes = (x.shape[1], self.UNITS, self.UNITS, y.shape[1])
        weights = self._begin(sizes)
        best, least = [w.detach().clone() for w in weights], torch.full((self.MEMBERS,), math.inf)
        steps = min(max(4 * count, 2000), 12000)
        optimiser = torch.optim.Adam(weights, self.RATE)
        slower = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
        for step in range(steps):
            batch = seen
            if seen.shape[1] > self.BATCH:
                sampled = (self.MEMBERS, self.BATCH)
                batch = torch.randint(seen.shape[1], sampled, generator=self._generator)
                batch = seen.gather(1, batch)
            optimiser.zero_grad()
            error = self._forward(weights, inputs[batch]) - outputs[batch]
            error.square().mean((1, 2)).sum().backward()
            optimiser.step()
            slower.step()
            if step % 25 == 24:
                with torch.no_grad():
                    error = self._forward(weights, inputs[unseen]) - outputs[unseen]
                    now = error.square().mean((1, 2))
                    better = now < least
                    least = torch.where(better, now, least)
                    for kept, weight in zip(best, weights, strict=True):
                        kept[better] = weight[better]
        self._weights = best
        return self

    def predict(self, x: Array) -> Array:
        """Return the outputs [N, 3] of inputs [N, I]."""
        with torch.no_grad():
            inputs = self._of(x, self._x).expand(self.MEMBERS, -1, -1)
            result = self._forward(self._weights, inputs).mean(0).double().numpy()
        return result * self._y[1] + self._y[0]

    @staticmethod
    def _of(values: Array, standard: tuple[Array, Array]) -> torch.Tensor:
        return torch.tensor((values - standard[0]) / standard[1], dtype=torch.float32)

    def _begin(self, sizes: tuple[int, ...]) -> list[torch.Tensor]:
        weights = []
        for width, out in pairwise(sizes):
            random = torch.randn(self.MEMBERS, width, out, generator=self._generator)
            weights += [random / width**0.5, torch.zeros(self.MEMBERS, 1, out)]
        return [weight.requires_grad_() for weight in weights]

    @staticmethod
    def _forward(weights: list[torch.Tensor], x: torch.Tensor) -> torch.Tensor:
        for place in (0, 2):
            x = torch.baddbmm(weights[place + 1], x, weights[place]).tanh()
        return torch.baddbmm(weights[5], x, weights[4])


def _standard(values: Array) -> tuple[Array, Array]:
    """Return the mean and the standard deviation of columns, 1 where it is zero."""
    deviation = values.std(0)
    return values.mean(0), np.where(deviation > 0, deviation, 1.0)


class Each:
    """A regressor of one output, for each of them."""

    def __init__(self, make: Callable[[int], object], seed: int):
        self._make, self._seed = make, seed

    def fit(self, x: Array, y: Array) -> Each:
        """Learn from inputs [N, I] and outputs [N, 3]."""
        self._models = [self._make(self._seed) for _ in y.T]
        for model, column in zip(self._models, y.T, strict=True):
            if hasattr(model, "n_jobs"):
                model.n_jobs = 1
            model.fit(x, column)
        return self

    def predict(self, x: Array) -> Array:
        """Return the outputs [N, 3] of inputs [N, I]."""
        return np.column_stack([model.predict(x) for model in self._models])


def makers() -> dict[str, Callable[[int], object]]:
    """Return functions that make regressors of all outputs from a seed, by learners' names."""
    result = regressors()
    return {
        "linear": partial(Each, Linear),
        "forest": partial(Each, result["random forest"]),
        "boosting": partial(Each, result["gradient boosting"]),
        "process": partial(Each, result["Gaussian process"]),
        "perceptrons": Perceptrons,
    }


#: Models without a regressor, by learners' names.
MODELS: dict[str, Callable[[Robot, Drives], Predict | None]] = {
    "ideal": partial(unicycle, two_factors=True),
    "fitted": partial(unicycle, two_factors=False),
    "lagged": lagged,
}
#: The models whose residuals regressors learn, by the ends of their names.
RESIDUALS = {"u": "fitted", "l": "lagged"}
REGRESSORS = ("linear", "forest", "boosting", "process", "perceptrons")
PEERS = (
    *MODELS,
    *(name + end for name in REGRESSORS for end in ("", "+u")),
    "process+l",
)
ABLATIONS = tuple(f"-{name}" for name in MECHANISMS)
OURS = ("ours", "whole", *ABLATIONS)
LEARNERS = (*OURS, *PEERS)
#: Learners that are measured by default.
USUAL = ("ours", "whole", *PEERS)


def learner_of(name: str, robot: Robot, drives: Drives, seed: int) -> Predict | None:
    """Return a learner's predictions as a function, None if it does not suit this robot."""
    if name in OURS:
        return ours(name, robot.inputs, drives, seed)
    if name in MODELS:
        return MODELS[name](robot, drives)
    base, _, end = name.partition("+")
    drive = MODELS[RESIDUALS[end]](robot, drives) if end else None
    scale = np.abs(drives.x).max(0)
    scale[scale == 0] = 1.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a process' lengths at their bounds
        y = drives.y if drive is None else drives.y - drive(drives.x)
        model = makers()[base](seed).fit(drives.x / scale, y)
    return lambda x: model.predict(x / scale) + (0.0 if drive is None else drive(x))


def spoiled(drives: Drives, seed: int, outliers: bool, repeated: bool) -> Drives:
    """Return drives with the outliers or repeats of the options."""
    if outliers:
        rng = np.random.default_rng([seed, 4])
        count = max(round(OUTLIERS * len(drives.x)), 1)
        which = rng.choice(len(drives.x), count, replace=False)
        angle = rng.uniform(0, 2 * math.pi, count)
        y, poses = drives.y.copy(), drives.poses.copy()
        y[which, :2] += OFF * np.column_stack([np.cos(angle), np.sin(angle)])
        poses[:, -1] = y
        drives = replace(drives, y=y, poses=poses)
    if repeated:
        arrays = (drives.x, drives.y, drives.times, drives.poses)
        drives = Drives(*(np.concatenate([array] * REPEATS) for array in arrays))
    return drives


def judge(name: str, case: Case, drives: Drives, seed: int) -> dict[str, object] | None:
    """Return the errors (cm, cm, deg) and the seconds of one training."""
    began = time.perf_counter()
    predict = learner_of(name, case.robot, drives, seed)
    if predict is None:
        return None
    seconds = time.perf_counter() - began
    table = errors(predict(case.judged.x), case.judged.y)
    error = np.array([table[output]["mean_absolute_error"] for output in OUTPUTS])
    rms = np.sqrt([table[output]["mse"] for output in OUTPUTS])
    error, rms = (np.where(np.isfinite(values), values, np.inf).tolist() for values in (error, rms))
    return {"error": error, "rms": rms, "seconds": seconds}


class Known:
    """Learners' results in a file, if there is to be one."""

    def __init__(self, path: Path | None):
        self._path = path
        self._results: dict[str, dict] = {}
        if path is not None and path.exists():
            self._results = json.loads(path.read_text(encoding="utf-8"))

    def get(self, key: str) -> dict | None:
        """Return the result of a key."""
        return self._results.get(key)

    def put(self, key: str, result: dict) -> None:
        """Keep a result, in the file too."""
        self._results[key] = result
        if self._path is not None:
            files.write_text(self._path, json.dumps(self._results, indent=0))


def measure(
    name: str, case: Case, count: int, options: argparse.Namespace, known: dict[bool, Known]
) -> dict[str, dict]:
    """Return the errors of all learners on one robot, medians over seeds, and the runs.

    Args:
        name: of the robot.
        case: the robot.
        count: rows to learn from.
        options: of the command line.
        known: results of ours (False) and of peers (True).
    """
    option = " ".join(word for word in ("outliers", "repeated") if vars(options)[word]) or "plain"
    runs: dict[str, list[dict]] = {}
    for seed in range(options.seeds):
        drives = spoiled(case.learned(count, seed), seed, options.outliers, options.repeated)
        for learner in LEARNERS:
            key = f"{name}|{count}|{seed}|{learner}|{option}"
            peer = learner in PEERS
            result = known[peer].get(key) if peer or learner in options.learners else None
            if result is None and learner in options.learners:
                result = judge(learner, case, drives, seed)
                if result is not None:
                    known[peer].put(key, result)
            if result is not None:
                runs.setdefault(learner, []).append(result)
    return {
        learner: {
            "runs": results,
            **{
                what: np.median([run[what] for run in results], axis=0).tolist()
                for what in ("error", "rms", "seconds")
            },
        }
        for learner, results in runs.items()
    }


def compare(computed: dict[str, dict]) -> str | None:
    """Add ratios to the best peer at each output; return the peer that is best in all three."""
    peers = [name for name in computed if name in PEERS]
    if not peers:
        return None
    least = np.min([computed[name]["error"] for name in peers], axis=0)
    for result in computed.values():
        result["ratios"] = (np.array(result["error"]) / least).tolist()
        result["ratio"] = geometric(result["ratios"])
    return min(peers, key=lambda name: computed[name]["ratio"])


def geometric(values: list[float]) -> float:
    return float(np.exp(np.mean(np.log(values)))) if len(values) else math.nan


def summary(robots: dict[str, dict]) -> dict[str, object]:
    """Return learners' geometric means over robots, and the worst case of ours."""
    tables = [entry["learners"] for entry in robots.values() if entry["best_peer"]]
    means = {
        name: geometric([table[name]["ratio"] for table in tables if name in table])
        for name in LEARNERS
        if any(name in table for table in tables)
    }
    cases = [
        (ratio, name, output)
        for name, entry in robots.items()
        for output, ratio in zip(
            OUTPUTS, entry["learners"].get("ours", {}).get("ratios", []), strict=False
        )
    ]
    worst = max(cases, default=None)
    return {"means": means, "worst": worst}


def show(size: int, robots: dict[str, dict], total: dict[str, object]) -> None:
    names = list(total["means"])
    short = {name: name.replace("perceptrons", "percep.") for name in names}
    print(f"\n{size} rows: error / best peer at each output, geometric mean of the three")
    print(f"{'':16s}" + "".join(f"{short[name]:>11s}" for name in names))
    for robot, entry in robots.items():
        table = entry["learners"]
        ratios = [table.get(name, {}).get("ratio", math.nan) for name in names]
        print(
            f"{label(robot, entry, size):16s}"
            + "".join(f"{value:11.2f}" if value == value else f"{'-':>11s}" for value in ratios)
        )
    print(f"{'geometric mean':16s}" + "".join(f"{v:11.2f}" for v in total["means"].values()))
    units = "".join(f"{unit:>8s}" for unit in UNITS)
    print(f"\n{'':16s}{'best peer':14s}{units}  {'ours':6s}{units}")
    for robot, entry in robots.items():
        table, best = entry["learners"], entry["best_peer"]
        figures = [
            "".join(f"{value:8.3f}" for value in table.get(name, {}).get("error", [math.nan] * 3))
            for name in (best, "ours")
        ]
        seconds = table.get("ours", {}).get("seconds", math.nan)
        print(
            f"{label(robot, entry, size):16s}{best or '-':14s}{figures[0]}  {'':6s}{figures[1]}"
            f"{seconds:8.1f} s"
        )


def label(robot: str, entry: dict, size: int) -> str:
    return robot if entry["rows"] == size else f"{robot}, {entry['rows']}"


def chosen(text: str, there_is: tuple[str, ...], what: str) -> list[str]:
    words = [word.strip() for word in text.split(",")]
    for word in words:
        if word not in there_is:
            raise SystemExit(f"no {what} {word!r}; there are {', '.join(there_is)}")
    return words


def read_cases(options: argparse.Namespace) -> dict[str, Case]:
    cases = {name: of_zoo(name) for name in options.robots if name != "utias"}
    if "utias" in options.robots:
        try:
            cases["utias"] = of_utias(options.utias)
        except (UserError, OSError) as error:
            print(f"the UTIAS robot is left out: {error}", file=sys.stderr)
    return cases


def main() -> None:
    everything = (*ZOO, "utias")
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", default=",".join(everything), help="a,b,...")
    parser.add_argument("--sizes", default="30,100,300,1000", help="rows to learn from, a,b,...")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--learners", default=",".join(USUAL), help="a,b,... or peers")
    parser.add_argument(
        "--without", default="", help="parts of ours left out in turn, a,b,... or all"
    )
    parser.add_argument("--outliers", action="store_true", help="1 %% of rows end 30 cm off")
    parser.add_argument("--repeated", action="store_true", help="every row five times")
    parser.add_argument("--peers", type=Path, metavar="FILE", help="keeps peers' results")
    parser.add_argument("--ours", type=Path, metavar="FILE", help="keeps results of ours")
    parser.add_argument("--utias", type=Path, default=UTIAS, metavar="FOLDER")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    options.robots = chosen(options.robots, everything, "robot")
    if options.learners == "peers":
        options.learners = ",".join(PEERS)
    options.learners = chosen(options.learners, USUAL, "learner")
    if options.without:
        parts = ",".join(MECHANISMS) if options.without == "all" else options.without
        options.learners += [f"-{name}" for name in chosen(parts, MECHANISMS, "part")]
    sizes = sorted(int(size) for size in options.sizes.split(","))
    torch.set_num_threads(1)
    cases = read_cases(options)
    known = {False: Known(options.ours), True: Known(options.peers)}
    result: dict[str, object] = {"units": dict(zip(OUTPUTS, UNITS, strict=True)), "rows": {}}
    began, ratios, worst = time.perf_counter(), [], []
    for size in sizes:
        robots: dict[str, dict] = {}
        for name, case in cases.items():
            count = min(size, case.most or size)
            if count < size and any(count <= other < size for other in sizes):
                continue
            computed = measure(name, case, count, options, known)
            if not computed:
                continue
            robots[name] = {"rows": count, "best_peer": compare(computed), "learners": computed}
            spent = time.perf_counter() - began
            print(f"{spent:7.0f} s: {name}, {count} rows", file=sys.stderr, flush=True)
        total = summary(robots)
        result["rows"][size] = {"robots": robots, **total}
        ratios += [
            entry["learners"]["ours"]["ratio"]
            for entry in robots.values()
            if entry["best_peer"] and "ours" in entry["learners"]
        ]
        if total["worst"]:
            worst.append((*total["worst"], size))
        if not options.json:
            show(size, robots, total)
            sys.stdout.flush()
    if worst:
        result["ours"] = {"mean": geometric(ratios), "worst": max(worst), "cases": len(ratios)}
        if not options.json:
            ratio, name, output, size = max(worst)
            print(
                f"\nours, all robots and sizes: geometric mean {geometric(ratios):.2f} of the",
                end="",
            )
            print(f" best peer; worst {ratio:.2f}, {output} of {name} at {size} rows")
    if options.json:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
