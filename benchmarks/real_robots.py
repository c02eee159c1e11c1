"""How well real robots are learned from logs of drives, compared with peers on the same windows.

    python benchmarks/real_robots.py [--robots dart,asphalt] [--quick] [--seed 0] [--json]
    python benchmarks/real_robots.py --peers peers.json      peers are measured once and kept there

A robot is learned from the earlier part of its log, through the import of CSV files. The rest of
the log, which shares no instant with it, is cut into windows. Each is predicted open loop, from the
commands that were sent within it and before it. Errors are mean absolute ones of dx, dy (cm) and
dtheta (deg) at the end of windows of 0.25, 1 and 2 s and of free runs of 5 s. Where a log is of
drives that are shorter, the longest windows are as long as these allow. ``f1tenth`` has only 20
drives: they are held out in four turns, and figures are means of these. Ratios are geometric means
over lengths and outputs, first to the single peer with the least such mean, then to the best peer
at each length and output.

Peers are those of :mod:`real_peers`. ``+u`` is on the residuals of the lagged bicycle, ``+v`` gets
the speed measured before the window. Ratios are to peers without it; then ours gets it, too, and
ratios are to all peers.

Intervals: the percentage of windows within the central intervals of 50, 80 and 95 %, of each
output; for each robot their mean over lengths and outputs, and by how many points those of 80 % are
off on average.

Constants were chosen on some of the robots: those of learning by windows and of cars on ``dart``,
``asphalt`` and ``f1tenth``, those of intervals on ``dart``, ``asphalt``, ``lab 104``, ``boat`` and
``barge``, those of a slow body on boats and ships that are not here, and how a known speed counts
on ``dart``, ``boat`` and all three floors. That the process learns from windows was seen on
``utias``; of which ones, and when it counts, was chosen by the mean of 20 logs: ``dart``, ``utias``
and drives of five labs (``lab 104`` and ``lab 105`` among them), boats, karts, a car and a small
robot. But for this, ``utias`` and ``lab 105`` are only reported; ``gravel`` and ``sand`` but for
the known speed; so are ``four wheels`` and the ship of :mod:`model_ship`. Ships of other lengths
and numbers decided how a measured speed counts for held commands, and that they have no floor. That
a measured turn tells of the drift was seen on this one, too. Labs, ``four wheels`` and boats,
simulated, are driven as by hand.

On one idle core about a minute for ours and two for peers, for each robot. The robots' records are
expected at ``../shared/data``. scikit-learn: pip install scikit-learn (extra ``bench``).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import model_ship
import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from real_peers import PETS_STEP, Lagged, Pets, Regressor
from zoo_robots import ZOO, LabRobot

from neurosim.base import files, se2
from neurosim.simulators import MotionNetwork
from neurosim.training.base import TrainingData
from neurosim.training.coverage import LEVELS, central
from neurosim.training.train import learn, training_data
from tracking.datasets.csv_files import import_csv
from tracking.datasets.logs import Log

Array = NDArray[np.float64]

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
OUTPUTS = ("dx", "dy", "dtheta")
READABLE = np.array([100.0, 100.0, 180.0 / np.pi])
#: Fraction of a log, last in time, that is held out, and how long windows are, s.
HELD_OUT, LENGTHS, FREE = 0.3, (0.25, 1.0, 2.0), 5.0
#: Peers get commands in steps of this, s, from this long before a window on; ours gets those of
#: the log, from its beginning to the window, and then in parts of a step, because a simulator knows
#: when each was given. Windows begin this often in the earlier rows, and in the held-out ones; and
#: the largest number of windows.
STEP, FINE, WARM, EVERY, APART, MOST, JUDGED = 0.05, 4, 20.0, 0.1, 0.25, 1200, 300
#: Turns in which the drives of a robot that has few are held out, so that all are judged.
FOLDS = 4
#: A speed before a window is measured over this time, s.
BEFORE = 0.1
#: The model ship, of 4 m.
MODEL = model_ship.ModelShip(4.0, 31)
#: Number of samples of each window.
DRAWS = 200


@dataclass(frozen=True)
class Robot:
    """A robot's logs, in two parts.

    Attributes:
        names: of its commands.
        learned: logs to learn from.
        held_out: logs to be judged by, with the time from which on windows may begin, s.
    """

    names: tuple[str, ...]
    learned: list[Log]
    held_out: list[tuple[Log, float]]


class Cut(NamedTuple):
    """Windows of one length.

    Attributes:
        log: index of its log, [W].
        begin: when it begins, [W] s.
        commands: in steps, from :data:`WARM` before the window to its end, [W, K, C].
        fine: of the window in shorter steps, [W, FINE K, C].
        moved: displacement, [W, 3] m, m, rad.
        speed: measured before the window, [W, 3] m/s, m/s, rad/s; NaN where it is not known.
    """

    log: Array
    begin: Array
    commands: Array
    fine: Array
    moved: Array
    speed: Array


def log_of(name: str, moment: Array, commands: Array, poses: Array) -> Log:
    """Return a log of one drive, without poses that repeat the one before."""
    moment, poses = np.array(moment, float), np.array(poses, float)
    poses[:, 2] = np.unwrap(poses[:, 2])
    fresh = np.append(True, (np.diff(poses, axis=0) != 0).any(1))
    return Log(name, moment, np.array(commands, float), fresh, moment[fresh], poses[fresh])


def in_two(log: Log) -> tuple[Log, tuple[Log, float]]:
    """Return the earlier part of a log, and the log with the time from which on it is held out."""
    end = log.time[0] + (1.0 - HELD_OUT) * (log.time[-1] - log.time[0])
    early, seen = log.time <= end, log.pose_time <= end
    part = (log.time[early], log.commands[early], log.seen[early])
    return Log(log.name, *part, log.pose_time[seen], log.poses[seen]), (log, end)


def of_logs(names: tuple[str, ...], logs: list[Log]) -> Robot:
    learned, held_out = zip(*map(in_two, logs), strict=True)
    return Robot(names, list(learned), list(held_out))


def of_drives(names: tuple[str, ...], logs: list[Log], held_out: Callable[[int], bool]) -> Robot:
    """Return a robot whose log is of many short drives, some of which are held out."""
    apart = [held_out(number) for number in range(len(logs))]
    judged = [(log, float(log.time[0])) for log, own in zip(logs, apart, strict=True) if own]
    return Robot(names, [log for log, own in zip(logs, apart, strict=True) if not own], judged)


def dart() -> Robot:
    logs = []
    for number in (1, 2):
        table = pd.read_csv(DATA / "real" / "dart" / f"drive-{number}.csv")
        commands = np.stack([table["throttle"] * table["safety_value"], table["steering"]], 1)
        poses = table[["vicon x", "vicon y", "vicon yaw"]].to_numpy()
        moment = table["vicon time"].to_numpy()
        logs.append(log_of(str(number), moment - moment[0], commands, poses))
    return of_logs(("throttle", "steering"), logs)


def drive(floor: str) -> Robot:
    table = pd.read_csv(DATA / "real" / "drive" / f"{floor}.csv")
    names = ["cmd_left_rad_s", "cmd_right_rad_s"]
    logs = [
        log_of(str(key), own["time_s"], own[names], own[["x_m", "y_m", "yaw_rad"]])
        for key, own in table.groupby("window")
    ]
    return of_drives(("left", "right"), logs, lambda n: n >= (1.0 - HELD_OUT) * len(logs))


def f1tenth(fold: int = 0) -> Robot:
    """Return the robot; its 20 drives are held out in four turns."""
    table = pd.read_csv(DATA / "real" / "f1tenth" / "drives.csv")
    names = ["v_cmd_m_s", "steer_cmd_rad"]
    logs = [
        log_of(str(key), own["time_s"], own[names], own[["x_m", "y_m", "heading_rad"]])
        for key, own in table.groupby("measurement")
    ]
    return of_drives(("speed", "steering"), logs, lambda n: n % FOLDS == fold)


def utias() -> Robot:
    odometry, truth = (
        np.loadtxt(DATA / "utias" / f"Robot_{name}.dat") for name in ("Odometry", "Groundtruth")
    )
    truth[:, 3] = np.unwrap(truth[:, 3])
    poses = np.stack([np.interp(odometry[:, 0], truth[:, 0], part) for part in truth[:, 1:].T], 1)
    return of_logs(("v", "w"), [log_of("1", odometry[:, 0], odometry[:, 1:], poses)])


def by_hand(name: str, seconds: float = 150.0) -> Robot:
    """Return a robot of the zoo, driven as by hand: commands change ten times a second."""
    robot, count = ZOO[name], round(10 * seconds)
    if not isinstance(robot, LabRobot):  # the noise of a pose is that of a command of 1.75 s
        relative, *pose = robot.noise
        robot = replace(robot, noise=(relative, *(0.24 * size for size in pose)))
    rng = np.random.default_rng([robot.lab_seed if isinstance(robot, LabRobot) else 0, 31])
    # The mean of both motors and their difference wander; now and then the robot is let go.
    wander = np.zeros((count, 2))
    for n in range(1, count):
        wander[n] = 0.93 * wander[n - 1] + rng.normal(0, (24.0, 9.0))
    wander *= np.repeat(rng.random(count // 30 + 1) < 0.85, 30)[:count, None]
    sides = np.stack([wander[:, 0] - wander[:, 1], wander.sum(1)], 1)
    each = sides.repeat(len(robot.names) // 2, axis=1)
    if each.shape != sides.shape:
        each += rng.normal(0, 5.0, each.shape) * (each != 0)
    commanded = each.clip(-100, 100).round()
    times = np.tile([1 / 30, 2 / 30, 0.1], (count, 1))
    starts, ends = robot._poses(np.column_stack([commanded, np.full(count, 0.1)]), times, rng, True)
    # It is put back to the middle of the board now and then, between two commands.
    moved, path = se2.between(starts[:, None], ends), [np.zeros((1, 3))]
    for own in moved:
        path.append(se2.compose(path[-1][-1], own))
    poses = np.concatenate(path)
    poses = poses + rng.normal(0, np.take(robot.camera, (0, 0, 1)), poses.shape)
    commands = np.concatenate([np.repeat(commanded, 3, axis=0), commanded[-1:]])
    return of_logs(robot.names, [log_of("1", np.arange(len(poses)) / 30, commands, poses)])


def ship() -> Robot:
    """Return a model ship with random orders."""
    orders = model_ship.at_random(np.random.default_rng(31), 400.0)
    return of_logs(model_ship.ORDERS, [log_of("1", *MODEL.drive(orders, 31))])


def trials() -> Robot:
    """Return the same ship in manoeuvring trials, of which a third are held out."""
    logs = [
        log_of(str(number), *MODEL.drive(orders, number))
        for number, orders in enumerate(model_ship.trials(80.0))
    ]
    return of_drives(model_ship.ORDERS, logs, lambda number: number % 3 == 2)


ROBOTS: dict[str, Callable[[], Robot]] = {
    "dart": dart,
    "asphalt": lambda: drive("asphalt"),
    "gravel": lambda: drive("gravel"),
    "sand": lambda: drive("sand"),
    "f1tenth": f1tenth,
    "utias": utias,
    **{
        name: partial(by_hand, name)
        for name in ("lab 104", "lab 105", "four wheels", "boat", "barge")
    },
    "ship": ship,
    "ship trials": trials,
}


def folds(name: str) -> list[Robot]:
    """Return a robot of :data:`ROBOTS`, once for each part of its log that is held out in turn."""
    return [f1tenth(fold) for fold in range(FOLDS)] if name == "f1tenth" else [ROBOTS[name]()]


def mean_of(results: list) -> Any:
    """Return the mean of results of the same shape: dictionaries and lists of numbers."""
    if isinstance(results[0], dict):
        return {key: mean_of([one[key] for one in results]) for key in results[0]}
    if isinstance(results[0], list):
        return [mean_of(list(own)) for own in zip(*results, strict=True)]
    return sum(results) / len(results)


def cut(logs: list[tuple[Log, float]], length: float, every: float, most: int) -> Cut:
    """Return windows of a length (s) that begin at this interval (s), ``most`` at most."""
    results: list[tuple[Array, ...]] = []
    first, last = -round(WARM / STEP), round(length / STEP)
    offsets = (np.arange(first, last) + 0.5) * STEP, (np.arange(FINE * last) + 0.5) * STEP / FINE
    for number, (log, start) in enumerate(logs):
        for begin in np.arange(
            max(start, log.pose_time[0]), log.pose_time[-1] - length + 1e-6, every
        ):
            places = (
                np.searchsorted(log.time, begin + o + 1e-6, side="right") - 1 for o in offsets
            )
            given = (log.commands[place.clip(0)] for place in places)
            ends = log.pose_at(np.array([begin - BEFORE, begin, begin + length]))
            known = begin - BEFORE >= log.pose_time[0]
            speed = se2.between(ends[0], ends[1]) / BEFORE if known else np.full(3, np.nan)
            results.append((number, begin, *given, se2.between(ends[1], ends[2]), speed))
    results = results[:: -(-len(results) // most)]
    return Cut(*(np.array(part) for part in zip(*results, strict=True)))


def lengths_of(robot: Robot) -> tuple[float, ...]:
    """Return the lengths of windows (s), a free run last, that a robot's logs have."""
    longest = max(log.pose_time[-1] - max(start, log.pose_time[0]) for log, start in robot.held_out)
    longest = np.floor(longest / 0.25 + 1e-6) * 0.25
    return tuple(dict.fromkeys(min(length, longest) for length in (*LENGTHS, FREE)))


def data_of(robot: Robot) -> TrainingData:
    """Return the rows to learn a robot from, through the import of CSV files."""
    tables = [
        pd.DataFrame(
            {
                "drive": log.name,
                "time": log.time,
                **dict(zip(("x", "y", "heading"), log.pose_at(log.time).T, strict=True)),
                **dict(zip(robot.names, log.commands.T, strict=True)),
            }
        )[log.time <= log.pose_time[-1]]
        for log in robot.learned
    ]
    columns = {name: name for name in ("time", "x", "y", "heading", *robot.names)}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        pd.concat(tables).to_csv(path, index=False)
        rows = import_csv(path, Path(folder) / "dataset", columns=columns, session="drive")
    return training_data(rows)


def at(simulator: MotionNetwork, log: Log, times: Array) -> Array:
    """Return the states [T, S] at ascending times (s), by the commands of a log until then.

    The first one is taken to have been given :data:`WARM` before, to a robot that stood.
    """
    stepper, states = simulator.stepper(), []
    state, now = stepper.start(np.zeros((1, 3))), float(log.time[0]) - WARM
    fresh = np.append(True, (np.diff(log.commands, axis=0) != 0).any(1))
    changes, commands = log.time[fresh], log.commands[fresh]
    place = 0
    for until in times:
        while now < until - 1e-9:
            while place + 1 < len(changes) and changes[place + 1] <= now + 1e-9:
                place += 1
            then = min(until, changes[place + 1]) if place + 1 < len(changes) else until
            state = stepper.step(state, np.append(commands[place], then - now)[None], None)
            now = then
        states.append(state[0])
    return np.array(states)


def samples(
    simulator: MotionNetwork,
    logs: list[tuple[Log, float]],
    windows: Cut,
    draws: int,
    seed: int,
    speeds: bool = False,
) -> tuple[Array, Array]:
    """Return predicted displacements [W, 3] of windows of logs, and samples of them, [D, W, 3].

    With ``speeds`` the simulator gets the speed that was measured before the window.
    """
    stepper, rng = simulator.stepper(), np.random.default_rng(seed)
    count = len(windows.moved)
    state = np.zeros((2, count, len(simulator.state_names)))
    for number in np.unique(windows.log):
        own = windows.log == number
        times = windows.begin[own] - [[BEFORE], [0.0]]
        order = np.argsort(times, axis=None)
        through = at(simulator, logs[number][0], times.flat[order])
        state[:, own] = through[np.argsort(order)].reshape(2, own.sum(), -1)
    before, state = state
    if speeds:
        state = simulator.seen(state, before, BEFORE * windows.speed, BEFORE)
    state = simulator.over(state)  # the noise begins with the window
    begun, sampled = state[:, :3], np.tile(state, (draws, 1))
    if simulator.members > 1:
        sampled[:, -1] = rng.integers(simulator.members, size=len(sampled))
    lasts = np.full((count, 1), STEP / FINE)
    for commanded in np.moveaxis(windows.fine, 1, 0):
        command = np.concatenate([commanded, lasts], 1)
        state = stepper.step(state, command, None)
        if draws:
            z = rng.standard_normal((len(sampled), simulator.noise_width), np.float32)
            sampled = stepper.step(sampled, np.tile(command, (draws, 1)), z)
    ends = sampled[:, :3].reshape(draws, count, 3)
    return se2.between(begun, state[:, :3]), se2.between(begun, ends)


def off(predicted: Array, windows: Cut) -> list[float]:
    """Return the mean absolute errors of dx, dy (cm) and dtheta (deg)."""
    return (np.abs(predicted - windows.moved).mean(0) * READABLE).tolist()


def held(sampled: Array, windows: Cut) -> list[list[float]]:
    """Return percentages within the intervals of :data:`LEVELS` of each output, [3][L]."""
    ranks = central(sampled, windows.moved)
    return [[100.0 * float((own <= level).mean()) for level in LEVELS] for own in ranks.T]


def measured(robot: Robot, seed: int, quick: bool) -> dict[str, dict[str, dict]]:
    """Return the peers' "error" and "coverage" at each length (as text)."""
    warm, lengths = round(WARM / STEP), lengths_of(robot)
    earlier = [(log, float(log.time[0])) for log in robot.learned]
    basis = cut(earlier, 0.5, EVERY, MOST)
    lagged = {
        f"lagged {name}": Lagged(products, STEP, WARM).fit(basis.commands, basis.moved)
        for name, products in (("unicycle", False), ("bicycle", True))
    }
    short = cut(earlier, PETS_STEP, EVERY / 2, 2 * MOST)
    pets = Pets(STEP, warm, seed).fit(short.commands, short.moved, short.speed)
    kinds = ("ridge", "boosting") if quick else ("ridge", "process", "boosting", "ensemble")
    regressors: dict[float, dict[str, Regressor]] = {}
    results: dict[str, dict[str, dict]] = {}
    for length in lengths:
        judged = cut(robot.held_out, length, APART, JUDGED)
        own: dict[str, dict] = {"stands still": {"error": off(0.0 * judged.moved, judged)}}
        for name, model in lagged.items():
            own[name] = {"error": off(model.predict(judged.commands), judged)}
        mean, particles = pets.predict(judged.commands, judged.speed)
        own["PETS+v"] = {"error": off(mean, judged), "coverage": held(particles, judged)}
        if length == lengths[-1]:
            for name, model in regressors[1.0].items():
                if not name.endswith("+v"):
                    own[name] = {"error": off(_composed(model, judged), judged)}
            results[f"{length:g}"] = own
            continue
        learns = cut(earlier, length, EVERY, MOST)
        made = regressors.setdefault(length, {})
        for kind in kinds:
            for ending, base in (("", None), ("+u", lagged["lagged bicycle"])):
                for speeds in (False, True):
                    name = kind + ending + "+v" * speeds
                    made[name] = Regressor(kind, base, speeds, warm, seed)
                    made[name].fit(learns.commands, learns.moved, learns.speed)
                    mean, error = made[name].predict(judged.commands, judged.speed)
                    own[name] = {"error": off(mean, judged)}
                    if error is not None:
                        rng = np.random.default_rng(seed)
                        random = mean + error * rng.standard_normal((DRAWS, *mean.shape))
                        own[name]["coverage"] = held(random, judged)
        results[f"{length:g}"] = own
    return results


def _composed(model: Regressor, windows: Cut) -> Array:
    """Return the displacements [W, 3] of free runs by a regressor of windows of 1 s."""
    second, pose = round(1.0 / STEP), np.zeros((len(windows.moved), 3))
    warm = round(WARM / STEP)
    for begin in range(0, windows.commands.shape[1] - warm - second + 1, second):
        part = windows.commands[:, begin : begin + warm + second]
        pose = se2.compose(pose, model.predict(part, windows.speed)[0])
    return pose


def ratios(ours: dict[str, list[float]], peers: dict[str, dict[str, dict]], speeds: bool) -> dict:
    """Return ratios of our errors to the peers', for windows and for free runs (the last length).

    Returns:
        ``windows`` and ``free``, each with the best single ``peer``, the ratio ``of peer``, the
        mean ratio ``of each`` output's and length's best peer, and the ``worst`` of these.
    """
    result, lengths = {}, list(ours)
    for part, some in (("windows", lengths[:-1]), ("free", lengths[-1:])):
        names = [
            name
            for name in peers[some[0]]
            if name != "stands still" and (speeds or not name.endswith("+v"))
        ]
        table = np.array([[peers[length][name]["error"] for name in names] for length in some])
        own = np.array([ours[length] for length in some])
        logs = np.log(own[:, None] / table)  # [lengths, peers, outputs]
        single = logs.mean((0, 2))
        best, each = int(single.argmax()), logs.max(1)
        result[part] = {
            "peer": names[best],
            "of peer": float(np.exp(single[best])),
            "of each": float(np.exp(each.mean())),
            "worst": float(np.exp(each.max())),
        }
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", default=",".join(ROBOTS), help="a,b,...")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--quick", action="store_true", help="fewer peers, fewer draws")
    parser.add_argument("--without", nargs="+", default=(), help="parts of ours left out: spread")
    parser.add_argument("--peers", type=Path, help="JSON file that keeps peers' errors")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    names = options.robots.split(",")
    if unknown := set(names) - set(ROBOTS):
        parser.error(f"no robots {', '.join(unknown)}; there are {', '.join(ROBOTS)}")
    torch.set_num_threads(1)
    kept = json.loads(options.peers.read_text()) if options.peers and options.peers.exists() else {}
    results: dict[str, dict] = {}
    for name in names:
        robots, parts = folds(name), []
        key = f"{name}, seed {options.seed}, {'quick' if options.quick else 'full'}"
        key += f", {len(robots)} folds" if len(robots) > 1 else ""
        if key not in kept:
            kept[key] = mean_of([measured(one, options.seed, options.quick) for one in robots])
            if options.peers:
                files.write_text(options.peers, json.dumps(kept))
        for robot in robots:
            data, began = data_of(robot), time.monotonic()
            simulator = learn(data, options.seed, without=tuple(options.without))
            part: dict[str, Any] = {"rows": len(data.x), "seconds": time.monotonic() - began}
            part["ours"] = {}
            for length in lengths_of(robot):
                judged = cut(robot.held_out, length, APART, JUDGED)
                draws = DRAWS // 4 if options.quick else DRAWS
                given = simulator, robot.held_out, judged
                mean, sampled = samples(*given, draws, options.seed)
                part["ours"][f"{length:g}"] = {
                    "windows": len(judged.moved),
                    "error": off(mean, judged),
                    "coverage": held(sampled, judged),
                    "error, speed known": off(
                        samples(*given, 0, options.seed, speeds=True)[0], judged
                    ),
                }
            parts.append(part)
        together = mean_of(parts)
        ours = together["ours"]
        errors, known = (
            {length: own[key] for length, own in ours.items()}
            for key in ("error", "error, speed known")
        )
        results[name] = {
            "rows": round(together["rows"]),
            "seconds": round(together["seconds"], 1),
            "ours": ours,
            "peers": kept[key],
            "ratios": ratios(errors, kept[key], False),
            "ratios, speeds known": ratios(known, kept[key], True),
        }
        if not options.json:
            print(words(name, results[name]), flush=True)
    if options.json:
        print(json.dumps(results))
    elif len(results) > 1:
        print(summary(results))


def words(name: str, result: dict) -> str:
    """Return a robot's table for a person."""
    lines = [f"{name}: {result['rows']} rows, learned in {result['seconds']:g} s"]
    for length, own in result["ours"].items():
        peers = result["peers"][length]
        lines.append(
            f"  {length} s, {own['windows']:g} windows" + " " * 9 + "dx cm  dy cm dtheta deg"
        )
        ordered = {"ours": own, "ours+v": {"error": own["error, speed known"]}, **peers}
        for label, one in ordered.items():
            cells = "".join(f"{value:8.2f}" for value in one["error"])
            if "coverage" in one:
                fractions = ("/".join(f"{c:.0f}" for c in output) for output in one["coverage"])
                cells += "   holds " + ", ".join(fractions)
            lines.append(f"    {label:18s}{cells}")
    return "\n".join(lines)


def summary(result: dict[str, dict]) -> str:
    """Return the table of all robots: ratios, and how far intervals are off."""
    lines = [
        "",
        "ratio to the best single peer, to the best at each output, the worst of these",
        f"{'':10s}{'windows':>21s}{'free runs':>21s}{'windows, +v too':>21s}"
        f"{'intervals hold':>18s}{'80 off':>8s}",
    ]
    for name, one in result.items():
        cells = ""
        for kind, part in (
            ("ratios", "windows"),
            ("ratios", "free"),
            ("ratios, speeds known", "windows"),
        ):
            own = one[kind][part]
            cells += f"{own['of peer']:9.2f}{own['of each']:6.2f}{own['worst']:6.2f}"
        coverage = np.array([own["coverage"] for own in one["ours"].values()])
        mean = "/".join(f"{value:.0f}" for value in coverage.mean((0, 1)))
        apart = np.abs(coverage[..., LEVELS.index(0.8)] - 80.0).mean()
        lines.append(f"{name:10s}{cells}{mean:>18s}{apart:8.1f}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
