"""How many chosen commands are worth how many random ones, in the virtual lab's physics.

For each seed another robot of the lab is driven twice: with the random commands of Pretorius et al.
(2009), section 5.1, and with commands that ``neurosim record --guided`` would choose, in the same
rounds. The default trainer learns from the first rows of each (all of them: nothing is held out).
Its predictions are compared with outcomes of fresh random commands, each driven several times from
other places with another charge:

- error: mean absolute error of the outcomes, as benchmarks/accuracy.py has it;
- floor: mean absolute deviation of the outcomes from each command's median;
- excess: mean absolute distance of the prediction from that median.

``mean of N`` averages the predictions of N trainings, as an ensemble does.

To be quick it leaves out driver, camera and tracker: the commands go to the physics directly, and
the poses before and after a command get the noise of tracking (0.4 mm, 0.05 degrees). At the
perimeter line a command is cut, the robot is placed near the middle, and the command is sent again
after its predecessor's speeds, up to four times, as the recorder does.

    python benchmarks/guided_recording.py            5 seeds, about a quarter of an hour on one core
    python benchmarks/guided_recording.py --quick    one seed, fewer commands
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.lab.nxt.params import BOARD, LabParams
from neurosim.lab.nxt.physics import (
    REGULATED,
    S,
    U,
    advance,
    begin_command,
    new_inputs,
    new_state,
    slip_field,
)
from neurosim.recording.commands import Command, RandomCommands
from neurosim.recording.rounds import Rounds
from neurosim.training.base import TrainingData, Within
from neurosim.training.guided import MARGIN, Committee, Place, choose, motor_data
from neurosim.training.train import learn
from tracking.datasets.within import choose_instants

OUTPUTS = ("dx", "dy", "dtheta")
#: Of a pose that is tracked: standard deviations, m, m and rad.
TRACKED = np.array([4e-4, 4e-4, math.radians(0.05)])
#: From the board's middle to the line, m.
LINE = np.array([BOARD.length, BOARD.width]) / 2 - BOARD.line_inset
ATTEMPTS, LEAD_IN, BATTERY = 4, 0.6, (7.4, 8.1)
#: What a person reads: cm, cm, deg.
READ = np.array([100.0, 100.0, 180.0 / np.pi])


@njit(cache=True)
def drive(state, inputs, command, p, field, half_length, half_width, seen):
    """Drive a command in pieces of 0.05 s; return how many, -1 as soon as the rectangle is left.

    Time and pose [4] after each piece are written into ``seen``.
    """
    for wheel in range(2):
        inputs[U.POWER + wheel] = command[wheel]
        begin_command(state, wheel, p)
    began, pieces = state[S.TIME], 0
    end = began + command[2]
    while state[S.TIME] < end - 1e-9:
        advance(state, inputs, p, field, min(end, state[S.TIME] + 0.05))
        if abs(state[S.X]) > half_length or abs(state[S.Y]) > half_width:
            return -1
        seen[pieces, 0] = state[S.TIME] - began
        seen[pieces, 1:] = state[S.X : S.X + 3]
        pieces += 1
    return pieces


class Robot:
    """The lab's robot, without brick and camera; ``changes`` are of its parameters."""

    def __init__(self, lab_seed: int, seed: int, changes: dict[str, float] | None = None):
        params = replace(LabParams.sampled(lab_seed), **(changes or {}))
        self.rng = np.random.default_rng([seed, lab_seed])
        self._p, self._field = params.coefficients(), slip_field(params)
        self._state, self._inputs = new_state(params, seed, (0.0, 0.0, 0.0)), new_inputs()
        self._inputs[U.MODE : U.MODE + 2] = REGULATED
        self._seen = np.empty((200, 4))
        self.cuts = 0

    @property
    def pose(self) -> NDArray:
        """Where it is."""
        return self._state[S.X : S.X + 3].copy()

    def put(self, near: float = 1.0) -> None:
        """Place it within a fraction of the board, with some charge, and let it stand."""
        self._state[S.X : S.X + 2] = self.rng.uniform(-near * LINE, near * LINE)
        self._state[S.THETA] = self.rng.uniform(-np.pi, np.pi)
        self._state[S.BATTERY] = self.rng.uniform(*BATTERY)
        self.drive((0.0, 0.0, 0.5))

    def drive(self, command: tuple, line: NDArray | None = None) -> NDArray | None:
        """Drive a command; return times and poses (K, 4) in it, None if it was cut at the line."""
        half = np.full(2, np.inf) if line is None else line
        given, seen = np.array(command, float), self._seen
        pieces = drive(self._state, self._inputs, given, self._p, self._field, *half, seen)
        return None if pieces < 0 else seen[:pieces].copy()

    def measured(self, start: NDArray) -> NDArray:
        """Return the displacement since ``start`` as it would be tracked."""
        noise = TRACKED * self.rng.standard_normal((2, 3))
        return se2.between(start + noise[0], self.pose + noise[1])

    def record(self, commands: list[Command]) -> TrainingData:
        """Return the commands that were driven to their end, as rows of a recording's dataset."""
        before = (0.0, 0.0)
        rows, moved, within = [], [], []
        self.drive((*before, 0.5))
        for command in commands:
            given = command.row
            for _ in range(ATTEMPTS):
                start = self.pose
                seen = self.drive(given, LINE)
                if seen is not None:
                    within += self._within(len(rows), start, seen, command.duration)
                    rows.append([*before, *given])
                    moved.append(self.measured(start))
                    break
                self.cuts += 1
                self.put(0.3)
                self.drive((*before, LEAD_IN))
            before = given[:2]
        data = motor_data(np.array(rows), np.array(moved))
        row, time, poses = (np.array(part) for part in zip(*within, strict=True))
        parts = Within(torch.tensor(row), torch.tensor(time), torch.tensor(poses))
        return replace(data, within=parts)

    def _within(self, row: int, start: NDArray, seen: NDArray, duration: float) -> list[tuple]:
        """Return row, time and displacement (3,) of a few instants, as they would be tracked."""
        seen = seen[choose_instants(seen[:, 0], duration)]
        noise = TRACKED * self.rng.standard_normal((len(seen) + 1, 3))
        moved = se2.between(start + noise[0], seen[:, 1:] + noise[1:])
        return [(row, *pair) for pair in zip(seen[:, 0], moved, strict=True)]


def random_rows(
    lab_seed: int, seed: int, count: int, changes: dict[str, float] | None = None
) -> tuple[TrainingData, int]:
    """Return rows and how many commands were cut, of a random recording."""
    robot, source = Robot(lab_seed, seed, changes), RandomCommands(seed=seed)
    return robot.record([source.command(n) for n in range(count)]), robot.cuts


def guided_rows(lab_seed: int, seed: int, rounds: Rounds) -> tuple[TrainingData, int]:
    """Return the same of a guided recording, whose rounds are as the command line's."""
    robot, source = Robot(lab_seed, seed), RandomCommands(seed=seed)
    first, *others = rounds.numbers()
    data = robot.record([source.command(n) for n in first])
    room = (BOARD.length - 2 * MARGIN, BOARD.width - 2 * MARGIN)
    for numbers in others:
        committee = Committee(replace(data, within=None), seed)
        place = Place(tuple(map(float, robot.pose)), *room)
        more = robot.record(choose(committee, source, numbers, place))
        data = together(data, more)
    return data, robot.cuts


def together(one: TrainingData, other: TrainingData) -> TrainingData:
    """Return the rows of both, one after the other."""
    shifted = other.within._replace(row=other.within.row + len(one.x))
    within = Within(*(torch.cat(pair) for pair in zip(one.within, shifted, strict=True)))
    x, y = torch.cat([one.x, other.x]), torch.cat([one.y, other.y])
    return replace(one, x=x, y=y, within=within)


def outcomes(lab_seed: int, commands: int, repeats: int) -> tuple[NDArray, NDArray]:
    """Return inputs (N, 5) and outcomes (N, R, 3) of fresh random commands after random ones."""
    robot, source = Robot(lab_seed, 10_000 + lab_seed), RandomCommands(seed=10_000)
    inputs, result, draws = [], [], 10 * commands
    for n in range(commands):
        one, two = source.command(2 * n), source.command(2 * n + 1)
        inputs.append([*one.numbers, *two.row])
        runs = []
        while len(runs) < repeats:
            robot.put()
            draws += 1
            earlier = source.command(draws)
            robot.drive((*earlier.numbers, LEAD_IN))
            robot.drive(one.row)
            start = robot.pose
            robot.drive(two.row)
            # One in fifty drives that leave the board is kept, so that no long command is tried for
            # ever; the ground is another there.
            ends = np.abs([start[:2], robot.pose[:2]]) < LINE
            if ends.all() or robot.rng.random() < 0.02:
                runs.append(robot.measured(start))
        result.append(runs)
    return np.array(inputs), np.array(result)


def learned(data: TrainingData, seed: int) -> Callable[[NDArray], NDArray]:
    """Return the simulator that the default trainer learns from these rows."""
    simulator = learn(data, seed, members=1, noise=False)
    return lambda inputs: simulator.displacement(torch.tensor(inputs)).numpy()


def judged(data: TrainingData, test: tuple[NDArray, NDArray], seed: int, repeats: int) -> dict:
    """Return errors and excesses (cm, cm, deg) of a training, averaged, and of their mean."""
    inputs, result = test
    middle = np.median(result, axis=1)
    predicted = np.array([learned(data, 100 * k + seed)(inputs) for k in range(repeats)])

    def off(prediction: NDArray) -> tuple[NDArray, NDArray]:
        error = np.abs(prediction[:, None] - result).mean((0, 1)) * READ
        return error, np.abs(prediction - middle).mean(0) * READ

    error, excess = np.mean([off(one) for one in predicted], axis=0)
    together, together_excess = off(predicted.mean(0))
    return {
        "error": error.tolist(),
        "excess": excess.tolist(),
        "error of the mean": together.tolist(),
        "excess of the mean": together_excess.tolist(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--random", type=int, nargs="*", default=[250, 500, 1000, 2000])
    parser.add_argument("--guided", type=int, nargs="*", default=[250, 500])
    parser.add_argument("--round", type=int, default=50)
    parser.add_argument("--repeats", type=int, default=3, help="trainings of the same rows")
    parser.add_argument("--quick", action="store_true", help="one seed, few commands")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    commands, runs = 600, 30
    if options.quick:
        options.seeds, options.repeats, commands, runs = 1, 1, 150, 10
        options.random, options.guided = [100, 200, 400], [100, 200]
    torch.set_num_threads(1)
    result: dict = {"settings": vars(options), "floor": [], "cut": [], "random": {}, "guided": {}}
    for seed in range(options.seeds):
        test = outcomes(seed, commands, runs)
        deviation = np.abs(test[1] - np.median(test[1], axis=1, keepdims=True))
        result["floor"].append((deviation.mean((0, 1)) * READ).tolist())
        rounds = Rounds(max(options.guided), options.round)
        made = {
            "random": random_rows(seed, seed, max(options.random)),
            "guided": guided_rows(seed, seed, rounds),
        }
        result["cut"].append({name: cuts for name, (_, cuts) in made.items()})
        for name, (data, _) in made.items():
            for count in getattr(options, name):
                judgement = judged(data.part(slice(count)), test, seed, options.repeats)
                result[name].setdefault(count, []).append(judgement)
                print(
                    f"seed {seed}, {count} {name}: {judgement['error']}",
                    file=sys.stderr,
                    flush=True,
                )
    print(json.dumps(result) if options.json else words(result, options.repeats))


def words(result: dict, repeats: int) -> str:
    """Return the table for a person: medians over seeds."""

    def cells(values: list) -> str:
        return "".join(f"{value:8.3f}" for value in np.median(values, axis=0))

    head = "".join(f"{text:>24s}" for text in ("error", "excess", f"error of mean of {repeats}"))
    lines = [f"{'virtual lab; cm, cm, deg':24s}{head}", f"{'floor':24s}{cells(result['floor'])}"]
    for name in ("random", "guided"):
        for count, runs in result[name].items():
            parts = ("error", "excess", "error of the mean")
            row = "".join(cells([run[part] for run in runs]) for part in parts)
            lines.append(f"{f'{count} {name}':24s}{row}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
