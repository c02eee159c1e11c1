"""Whether a simulator's intervals hold what they say, in the virtual lab.

Commands are those of Pretorius et al. (2009), section 5.1, fresh ones, driven by the robot that the
reference dataset was recorded with: through driver, radio link and brick, but without a camera. So
the intervals are compared with the truth, while the simulator has learned from tracked
displacements. The robot starts at random places, with a battery as full as at some time of a
recording. Two things are measured:

- single commands, driven one after another until the robot comes to the edge: the fraction of each
  output within the simulator's central 50, 80 and 95 % intervals, of all commands, of those that
  move the robot, of those straight ahead or back, and of those from rest. A command is left out if
  its predicted mean ends beyond the board's edge, on a floor that the simulator has learned nothing
  of (a recorder cuts it short at the line);
- sequences of ten commands from rest: the fraction of final positions within the 50, 80 and 95 %
  regions (ellipses about the mean of the simulated positions, in the shape of their covariance),
  and of final headings within the central intervals.
  A sequence is left out if its predicted mean path comes close to the board's edge.

Results of left-out commands and sequences do not count.

    python benchmarks/interval_coverage.py                    train on the reference data, measure
    python benchmarks/interval_coverage.py --simulator FOLDER measure a simulator that is there
    python benchmarks/interval_coverage.py --tracked DATASET  also a tracked dataset's held-out rows

Measuring takes about two minutes on two cores, training as long as ``neurosim train``.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.lab import VirtualRig
from neurosim.lab.nxt.params import BOARD
from neurosim.lab.nxt.physics import S
from neurosim.recording.commands import RandomCommands
from neurosim.simulators import MotionNetwork, read_simulator
from neurosim.training import evaluate, train
from neurosim.training.coverage import LEVELS, central, central_ranks, region

REFERENCE = Path(__file__).resolve().parents[1] / "data" / "reference"
OUTPUTS = ("dx", "dy", "dtheta")
#: Battery's open-circuit voltage at the start (V), and how near (m) to the edge a path may come.
BATTERY, EDGE = (7.4, 8.1), 0.15
#: A tracked recording's clock is set by the lamp, whose light follows a telegram after the radio's
#: mean delay of 20 ms and its filament's 4 ms: so much later than sent a command counts as begun.
TAKEN = 0.024


class Drives:
    """The lab's robot, placed at random with a random charge."""

    def __init__(self, rig: VirtualRig, seed: int):
        self.rng = np.random.default_rng(seed)
        self._commands = RandomCommands(seed=seed)
        self._rig = rig
        self._next = 0

    def command(self) -> NDArray:
        """Return the next random command (left, right, duration)."""
        command = self._commands.command(self._next)
        self._next += 1
        return np.array(command.row)

    def pose(self) -> NDArray:
        """Return a random pose on the board."""
        half = np.array([BOARD.length, BOARD.width]) / 2 - 0.3
        return np.append(self.rng.uniform(-half, half), self.rng.uniform(-np.pi, np.pi))

    def put(self, pose: NDArray) -> None:
        """Stop the robot and place it at a pose, with some charge."""
        lab, clock = self._rig.lab, self._rig.robot.clock
        self._rig.robot.stop()
        clock.sleep_until(clock.now() + 0.7)
        with lab.lock:
            lab.place(*pose)
            lab.body.state[S.BATTERY] = self.rng.uniform(*BATTERY)

    def drive(self, command: NDArray) -> float:
        """Send a command and let it run; return the time at which it counts as begun."""
        clock = self._rig.robot.clock
        sent = clock.now()
        self._rig.robot.drive(command[:2])
        clock.sleep_until(sent + command[2])
        return sent + TAKEN

    @property
    def there(self) -> NDArray:
        """Where the robot is now."""
        return self._rig.lab.body.pose

    @property
    def now(self) -> float:
        """The time at which a command sent now would count as begun."""
        return self._rig.robot.clock.now() + TAKEN

    def poses(self, times: list) -> NDArray:
        """Return the true poses at times before the last :meth:`put`."""
        return self._rig.lab.truth.pose_at(np.array(times))


def on_board(poses: NDArray, edge: float = EDGE) -> NDArray:
    """Return whether poses (..., 3) are on the board, ``edge`` (m) away from its edge."""
    half = np.array([BOARD.length, BOARD.width]) / 2 - edge
    return (np.abs(poses[..., :2]) < half).all(-1)


def single_commands(
    simulator: MotionNetwork, drives: Drives, count: int
) -> tuple[NDArray, NDArray, NDArray]:
    """Return starts (N, 3), inputs (N, 5) and true displacements (N, 3) of commands in a row."""
    inputs, times, kept = [], [], []
    while sum(kept) < count:
        drives.put(drives.pose())
        before = np.zeros(2)
        for _ in range(30):
            command, start = drives.command(), drives.there
            times.append([drives.drive(command), drives.now])
            inputs.append([*before, *command])
            mean = simulator.displacement(torch.tensor([inputs[-1]])).numpy()[0]
            kept.append(on_board(se2.compose(start, mean), 0.0))
            before = command[:2]
            if not on_board(drives.there):
                break
    drives.put(np.zeros(3))
    kept = np.flatnonzero(kept)[:count]
    start, end = np.moveaxis(drives.poses(times), 1, 0)[:, kept]
    return start, np.array(inputs)[kept], se2.between(start, end)


def sequences(
    simulator: MotionNetwork, drives: Drives, count: int, length: int
) -> tuple[NDArray, NDArray, NDArray]:
    """Return starts (N, 3), commands (N, length, 3) and true final poses (N, 3)."""
    starts, commands, ends = [], [], []
    while len(starts) < count:
        start = np.array([drives.pose() for _ in range(200)])
        given = np.array([[drives.command() for _ in range(length)] for _ in start])
        state, keep = simulator.start(torch.tensor(start)), np.ones(len(start), bool)
        for step in range(length):
            state = simulator.step(state, torch.tensor(given[:, step]))
            keep &= on_board(state[:, :3].numpy())
        for n in np.flatnonzero(keep)[: count - len(starts)]:
            drives.put(start[n])
            starts.append(start[n])
            commands.append(given[n])
            for command in given[n]:
                drives.drive(command)
            ends.append(drives.now)
    drives.put(np.zeros(3))
    return np.array(starts), np.array(commands), drives.poses(ends)


def measure(simulator: MotionNetwork, options: argparse.Namespace) -> dict:
    """Return the coverage of intervals and of regions."""
    generator = torch.Generator().manual_seed(options.seed)
    rig = VirtualRig(options.lab_seed, noise_seed=10_000 + options.seed, camera=False)
    with rig, rig.robot:
        drives = Drives(rig, options.seed)
        places, inputs, actual = single_commands(simulator, drives, options.commands)
        starts, commands, ends = sequences(simulator, drives, options.sequences, options.length)
    ranks = central_ranks(simulator, inputs, actual, options.seed, options.draws, starts=places)
    assert ranks is not None  # main refuses simulators without noise
    moving = inputs[:, 2:4].any(1)
    some = {
        "": np.ones(len(inputs), bool),
        ", moving": moving,
        ", straight": moving & (inputs[:, 2] == inputs[:, 3]),
        ", from rest": moving & ~inputs[:, :2].any(1),
    }
    table = {
        name + words: coverage(ranks[rows, place])
        for words, rows in some.items()
        for place, name in enumerate(OUTPUTS)
    }

    poses = np.empty((options.draws, len(starts), 3))
    for n, (start, given) in enumerate(zip(starts, commands, strict=True)):
        state = simulator.start(torch.tensor(start).expand(options.draws, 3), generator)
        for command in torch.tensor(given):
            state = simulator.step(state, command.expand(options.draws, 3), generator)
        poses[:, n] = state[:, :3]
    points, off = poses[..., :2], poses[..., 2] - ends[:, 2]
    turned = np.mod(off + np.pi, 2 * np.pi) - np.pi
    table[f"position after {options.length}"] = coverage(region(points, ends[:, :2]))
    table[f"heading after {options.length}"] = coverage(central(turned, np.zeros(len(ends))))
    error = np.linalg.norm(points.mean(0) - ends[:, :2], axis=1)
    return {
        "table": table,
        "median distance from the predicted mean (m)": float(np.median(error)),
        "median turn from the predicted mean (rad)": float(np.median(np.abs(turned.mean(0)))),
    }


def coverage(ranks: NDArray) -> dict[str, float]:
    """Return the fraction of ranks up to each level."""
    return {str(level): float((ranks <= level).mean()) for level in LEVELS}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--dataset", type=Path, default=REFERENCE)
    parser.add_argument("--simulator", type=Path, help="measure this one instead of training one")
    parser.add_argument("--tracked", type=Path, help="a dataset, whose rows are measured too")
    parser.add_argument("--commands", type=int, default=4500)
    parser.add_argument("--sequences", type=int, default=1200)
    parser.add_argument("--length", type=int, default=10)
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--lab-seed", type=int, default=0, help="the robot that was recorded")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="a fifth of it all, fewer draws")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.commands, options.sequences, options.draws = 1000, 300, 200
    result: dict = {"settings": {k: str(v) for k, v in vars(options).items()}}
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.simulator or Path(temporary) / "simulator"
        began = time.monotonic()
        if options.simulator is None:
            train(options.dataset, folder, seed=options.seed)
            result["training_seconds"] = time.monotonic() - began
        simulator = read_simulator(folder)
        if simulator.noise is None:
            parser.error(f"{folder} has no noise model; train it with one")
        result |= measure(simulator, options)
        if options.tracked is not None:
            for name, row in evaluate(folder, options.tracked)["coverage"].items():
                result["table"][f"{name}, tracked"] = row
    print(json.dumps(result) if options.json else words(result))


def words(result: dict) -> str:
    """Return the table for a person."""
    lines = [f"{'virtual lab, % within':24}" + "".join(f"{100 * p:8.0f} %" for p in LEVELS)]
    for name, row in result["table"].items():
        lines.append(f"{name:24}" + "".join(f"{100 * row[str(p)]:10.1f}" for p in LEVELS))
    lines += [f"{name}: {value:.3f}" for name, value in result.items() if name.startswith("median")]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
