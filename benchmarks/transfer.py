"""How well networks of tables transfer to the virtual robot: Lund and Miglino 1996, Figures 3, 4.

Five robots of the virtual lab sample themselves, through their serial line. In simulators made of
these samples, of a tenth of them (every second distance, every fifth angle, 36 of 441 motor
settings) and of hand-written formulas without any, networks are evolved for 200 generations. The
population then evolves for 20 more generations on the robot, in the lab's own time. Printed for
every run:

  - fitness of the simulator's best network in the simulator, with the noise of its evolution and
    without, and on the robot, at the same 50 starts;
  - mean fitness of the population on the robot, in the first generation there and the last, and
    of the best after it, from the same starts again;
  - how far apart the paths of simulator (without noise) and robot are over 10 s from the same
    starts: the median over time and starts, and the same between two drives of the robot.

    python benchmarks/transfer.py                       an hour on one core
    python benchmarks/transfer.py --tables samples
    python benchmarks/transfer.py --kept FILE           go on where FILE ends; keep each run there
    python benchmarks/transfer.py --direct              without a terminal between lab and robot
    python benchmarks/transfer.py --quick

With --direct the same bytes take the same time of the lab, but no other thread has to answer them:
a generation on the robot then costs 6 s rather than 24.

The hand-written simulator: sensors sit where the robot's manual has them, and read
(20 mm / d)^2 cos^2 a, at most 1, of an object at the distance d and the angle a from where they
look; wheels are ideal and nothing is late.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from neurosim.base.place import paper_arena
from neurosim.base.trajectory import Draws, Episode
from neurosim.controllers import Network
from neurosim.lab import VirtualKheperaRig, sampling_places
from neurosim.lab.cable import SerialCable
from neurosim.lab.khepera.rig import BITS
from neurosim.loop.evaluate import Evaluator, rollouts_of
from neurosim.loop.evolve import Evolution
from neurosim.loop.journal import Journal
from neurosim.loop.settings import default_settings
from neurosim.loop.transfer import Transfer
from neurosim.robots.khepera.dialects import dialect_named
from neurosim.robots.serial_line import SerialLine
from neurosim.sampling import SampleSettings, sample, sampled_reaction
from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.motor_table import MotorTable
from neurosim.simulators.tables.samples import Samples
from neurosim.simulators.tables.sensor_table import SensorTable
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance, avoidance
from neurosim.trials.floor import OnFloor

TABLES = ("samples", "tenth", "formulas")
TASK = ObstacleAvoidance()
FAMILY = Network(tuple(f"sensor_{number}" for number in range(8)))
PATH_STARTS, PATH_STEPS = 10, 100


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--runs", type=int, nargs="+", default=[1, 2, 3, 4, 5], help="robots")
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--generations", type=int, default=200)
    parser.add_argument("--on-robot", type=int, default=20, help="generations more")
    parser.add_argument("--baud", type=int, default=38400, help="of the robot's line")
    parser.add_argument("--direct", action="store_true", help="no terminal to the robot")
    parser.add_argument("--kept", type=Path, help="a file that each run is added to when made")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.runs, options.generations, options.on_robot = options.runs[:1], 40, 1
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        sampled = cache(lambda robot: sample_robot(Path(folder), robot, options))
        for kind in options.tables:
            for robot in options.runs:
                rows.append(run(kind, robot, sampled, options))
                if not options.json:
                    describe_row(rows[-1])
    by_kind = {kind: [row for row in rows if row["tables"] == kind] for kind in options.tables}
    if options.json:
        medians = {kind: typical(own, statistics.median) for kind, own in by_kind.items()}
        print(json.dumps({"baud": options.baud, "rows": rows, "medians": medians}))
        return
    for kind, own in by_kind.items():
        print(f"{kind}, medians of {len(own)} runs, the least and the most of them")
        for of in (statistics.median, min, max):
            describe_row(typical(own, of))


def run(
    kind: str, robot: int, sampled: Callable[[int], Path], options: argparse.Namespace
) -> dict[str, Any]:
    """Make a run, or read it from the file of runs."""
    what = {"tables": kind, "run": robot}
    what |= {name: getattr(options, name) for name in ("generations", "on_robot", "baud", "direct")}
    if options.kept and options.kept.exists():
        for line in options.kept.read_text("utf-8").splitlines(keepends=True):
            row = json.loads(line) if line.endswith("\n") else {}
            if what.items() <= row.items():
                return row
    row = {**what, **transfer(kind, robot, sampled(robot), options)}
    if options.kept:
        with open(options.kept, "a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
    return row


class DirectLine(SerialLine):
    """A robot's line that takes bytes to the lab and back itself, as the one to a port would."""

    def __init__(self, cable: SerialCable, baud: int):
        super().__init__("direct", baud=baud)
        self._cable, self._answers = cable, []

    def open(self) -> None:
        """Take the line up."""
        self._serial = self._cable

    def write(self, data: bytes) -> None:
        """Send bytes, and let the lab answer them."""
        answers = self._cable.exchange(data).replace(b"\r", b"\n").split(b"\n")
        self._answers += [answer for answer in answers if answer]

    def waiting(self) -> list[bytes]:
        """Return the lines that have come."""
        answers, self._answers = self._answers, []
        return answers

    def read_line(self, seconds: float) -> bytes | None:
        """Return the next line, or None: nothing comes later."""
        return self._answers.pop(0) if self._answers else None


def in_the_lab(robot: int, options: argparse.Namespace, **others: Any) -> VirtualKheperaRig:
    """Return a lab with a robot that is not connected yet."""
    rig = VirtualKheperaRig(robot, baud=options.baud, **others)
    if options.direct:
        cable = SerialCable(rig.firmware, rig.lab.clock, BITS / options.baud)
        rig.robot._line = DirectLine(cable, options.baud)
    return rig


def sample_robot(folder: Path, robot: int, options: argparse.Namespace) -> Path:
    """Have a robot sample itself and return the folder."""
    out = folder / str(robot)
    arena, poses = sampling_places()
    rig = in_the_lab(robot, options, noise_seed=100 + robot, place=arena, start=poses["open"])
    with rig, rig.robot as driver:
        rng = np.random.default_rng([robot, 0x6B50])

        def place(where: str) -> None:
            x, y, theta = poses[where]
            slack = 0.0 if where == "open" else math.radians(1)
            rig.lab.place(x, y, theta + slack * rng.standard_normal())

        sample(out, driver, SampleSettings(), place, seed=robot, progress=False)
    return out


def simulator_of(kind: str, folder: Path) -> TableSimulator:
    """Return the simulator that is made of a robot's samples, or without them."""
    if kind == "formulas":
        return TableSimulator(formulas())
    samples = {name: Samples.read(folder / f"{name}.sample") for name in ("wall", "cylinder")}
    motors = MotorTable.read_csv(folder / "motors.csv", resolution=10.0)
    if kind == "tenth":
        samples = {
            name: Samples(one.activations[::2, ::5], one.first_distance, 2 * one.distance_step)
            for name, one in samples.items()
        }
        motors = MotorTable(motors.levels[::4], motors.twist[::4, ::4], None, motors.resolution)
    table = SensorTable.from_samples({name: [one] for name, one in samples.items()})
    return TableSimulator(table, motors, reaction=sampled_reaction(folder))


def formulas() -> SensorTable:
    """Return tables of the hand-written formulas."""
    distance = 0.005 + 0.002 * np.arange(30)[:, None, None]
    turned = np.radians(2.0 * np.arange(180))[None, :, None]
    off = turned + np.radians(dialect_named("khepera").angles)
    seen = np.minimum((0.02 / distance) ** 2, 1.0) * np.maximum(np.cos(off), 0.0) ** 2
    samples = Samples(seen, 0.005, 0.002)
    return SensorTable.from_samples({"wall": [samples], "cylinder": [samples]})


def transfer(kind: str, robot: int, folder: Path, options: Any) -> dict[str, float]:
    """Evolve in a simulator, then on the robot, and return the results of the run."""
    simulator = simulator_of(kind, folder)
    evaluator, arena = Evaluator(simulator, TASK, FAMILY), paper_arena()
    settings = default_settings(FAMILY, TASK, generations=options.generations)
    evolution = Evolution(evaluator, settings, robot)
    evolution.run(progress=False)
    genes, drives = evolution.best()[0], evaluator.rollouts
    rng = np.random.default_rng([robot, 1])
    starts = arena.free_poses(settings.selection, simulator.radius, rng)
    noisy = drives.run(genes[None], drives.draw(starts, np.random.default_rng(robot)))
    paths = rollouts_of(simulator, FAMILY, Episode(TASK.duration, PATH_STEPS, readings=True))
    quiet = paths.run(genes[None], Draws(starts[:PATH_STARTS]))
    row = {
        "simulated": per_trial(noisy),
        "simulated_without_noise": per_trial(drives.run(genes[None], Draws(starts))),
    }
    rig = in_the_lab(robot, options, noise_seed=robot, place=arena, start=starts[0])
    with rig, rig.robot as driver:
        real = OnFloor(
            driver,
            evaluator,
            place=lambda pose: rig.lab.place(*pose),
            pose=lambda _: lambda: rig.lab.pose,
            about={},
        )

        def put_down(network: np.ndarray, start: np.ndarray) -> Any:
            real.rest()
            rig.lab.place(*start)
            return real.drive(network, PATH_STEPS, lambda: rig.lab.pose)

        def from_starts(network: np.ndarray) -> float:
            fitness = [avoidance(put_down(network, start)) for start in starts]
            return TASK.starts * float(np.mean(fitness))

        paths = np.stack(
            [[put_down(genes, start).poses for start in starts[:PATH_STARTS]] for _ in range(2)]
        )
        row["path_apart"] = apart(quiet.poses[0], paths[0])
        row["robot_apart"] = apart(paths[1], paths[0])
        row["robot"] = from_starts(genes)
        row["change"] = row["robot"] / row["simulated"] - 1.0
        row["change_without_noise"] = row["robot"] / row["simulated_without_noise"] - 1.0
        if options.on_robot:
            with Journal(real, folder / f"{kind}.jsonl", each=1) as journal:
                after = Transfer(evolution.stages[0].optimiser, journal, evaluator)
                for _ in range(options.on_robot):
                    after.generation()
                after.choose()
            mean = after.history()["mean"]
            row["mean_first"], row["mean_last"] = mean[0], mean[-1]
            row["robot_after"] = from_starts(after.chosen)
    return row


def per_trial(trajectory: Any) -> float:
    """Return a trial's fitness, of trajectories [1, R] from many starts."""
    return TASK.starts * float(avoidance(trajectory).mean())


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """Return the median distance (m) between paths [R, T, 3]."""
    return float(np.median(np.linalg.norm(one[..., :2] - other[..., :2], axis=-1)))


def typical(rows: list[dict[str, Any]], of: Callable[[list[Any]], Any]) -> dict[str, Any]:
    """Return a row of the medians (or other) of numbers, and of the text that all rows have."""
    return {
        name: value if isinstance(value, str) else of([row[name] for row in rows])
        for name, value in rows[0].items()
    }


def describe_row(row: dict[str, Any]) -> None:
    after = ""
    if "robot_after" in row:
        after = (
            f" {row['robot_after']:.0f} after, its population {row['mean_first']:.0f} to "
            f"{row['mean_last']:.0f};"
        )
    print(
        f"  {row['tables']:8} {row['run']:3.0f}: fitness {row['simulated']:.0f} in the simulator "
        f"({row['simulated_without_noise']:.0f} without noise), {row['robot']:.0f} on the robot "
        f"({100 * row['change']:+.1f} %; {100 * row['change_without_noise']:+.1f} %);{after} paths "
        f"{100 * row['path_apart']:.2f} cm apart, two of the robot "
        f"{100 * row['robot_apart']:.2f} cm"
    )
    sys.stdout.flush()


if __name__ == "__main__":
    main()
