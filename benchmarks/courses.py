"""Open-loop plans, networks that see their pose, and replanning, on the course.

This is the outlook of Pretorius et al. (2009). Several robots of the virtual lab each drive 400
random commands, as tracked, and a simulator is learned from these. In it are evolved a plan around
the nine rectangles (robustly, ``neurosim evolve --robust``) and a network that sees the distance
and direction of the next rectangle's middle. They are then driven, each time from a start with the
placing error of a person, with the lab's own slip and caster:

  - open_loop: the plan, without feedback;
  - replanned: the plan, replanned after every command (``neurosim run --replan``);
  - network: asked five times a second.

Every course is driven twice, the second time with a push of 10 cm aside (0.3 s, wheels skidding)
halfway, in a direction that does not by itself push the robot out of the rectangle where it is
expected to be. Printed are: how many courses were completed, by the true path; and how near the
robot came to the predicted points where it passes from one rectangle into the next. The prediction
is the whole path for plan and network; for a replanned plan it is made at each command. (A pushed
robot passes elsewhere, at first.)

Go to: from a pose anywhere on the board to another, within 2 cm and 3 degrees, by replanning,
without a first plan; in the simulator, with sampled noise, and in the lab.

Most drives are of the lab's physics without brick and camera: controllers that see get the true
pose with noise of 1 mm and 0.2 degrees, and compute in no time. With --camera some drives of
controllers that see are repeated through driver, radio, brick, camera and tracker, where computing
takes 0.3 s: every second one of them with a push.

    python benchmarks/courses.py                     3 robots, 10 courses each, 60 poses
    python benchmarks/courses.py --camera 1          one course of each robot also through the
    camera
    python benchmarks/courses.py --quick
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from guided_recording import random_rows
from reality_gap import make_calibration
from robust_plans import PERIMETER

from neurosim.base.trajectory import RUN_DOWN, Trajectory
from neurosim.controllers import FixedPlan, Network, Plan, SavedController
from neurosim.controllers.base import observe
from neurosim.controllers.goals import Goals
from neurosim.lab import Lab, LabParams, Push, VirtualRig
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import evolve
from neurosim.loop.replan import Replanner, ReplanSettings
from neurosim.loop.settings import RobustSettings, default_settings
from neurosim.recording.settings import Rig
from neurosim.simulators.base import Simulator
from neurosim.simulators.sampling import PLACING
from neurosim.tasks.go_to import GoTo, anywhere
from neurosim.tasks.nine_rectangles import NineRectangles
from neurosim.training.train import learn
from neurosim.trials.trial import FORESEEN, run_trial
from tracking.track import track

#: A radio takes most of 0.1 s for sensors and motors.
TASK = NineRectangles(step=0.2)
COMMANDS = 400
#: How far the robot is pushed, m.
PUSH = 0.1
#: Of a pose that is tracked live: standard deviations, m, m and rad.
TRACKED = np.array([0.001, 0.001, math.radians(0.2)])
#: Time between the poses of predicted paths, s.
DENSE = 0.05
NEAR = 0.03
#: Starts and goals are in the middle of the board, where a robot does not touch the line.
AREA = (1.9, 1.0)
TOLERANCE = 0.02, math.radians(3.0)
KINDS = ("open_loop", "replanned", "network")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 2, 3], help="lab seeds")
    parser.add_argument("--courses", type=int, default=10, help="of each robot")
    parser.add_argument("--poses", type=int, default=20, help="to go to, of each robot")
    parser.add_argument("--camera", type=int, default=0, help="courses of each the long way, too")
    parser.add_argument("--generations", type=int, default=300, help="of plans, without noise")
    parser.add_argument("--robust-generations", type=int, default=80)
    parser.add_argument("--network-generations", type=int, default=60)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if options.quick:
        options.robots, options.courses, options.poses = options.robots[:1], 2, 5
        options.generations, options.robust_generations, options.network_generations = 100, 20, 20
    drives: list[dict] = []
    goes: list[dict] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        calibration = make_calibration(folder) if options.camera else None
        for robot in options.robots:
            began = time.monotonic()
            one = Prepared(robot, options)
            for course in range(options.courses):
                drives += one.course(course)
            for course in range(options.camera):
                drives += one.filmed(course, folder, calibration)
            for number in range(options.poses):
                goes += [one.go(number, virtual) for virtual in (False, True)]
            print(f"robot {robot}: {time.monotonic() - began:.0f} s", file=sys.stderr)
            if not options.json:
                describe(drives, goes)
    if options.json:
        there = {"simulator": arrived(goes, False), "lab": arrived(goes, True)}
        settings = vars(options)
        print(json.dumps({"settings": settings, "drives": drives, "go_to": goes, "there": there}))


def arrived(goes: list[dict], lab: bool) -> dict[str, int]:
    """Return how many poses were reached, and of how many."""
    own = [one["there"] for one in goes if one["lab"] is lab]
    return {"reached": sum(own), "of": len(own)}


class Physics:
    """The lab's physics, driven command by command; without brick and camera."""

    def __init__(self, robot: int, noise: int, start: Any, push: Push | None = None):
        self.rng = np.random.default_rng([noise, robot, 0xC0])
        placed = np.asarray(start) + self.rng.standard_normal(3) * (PLACING[0], *PLACING)
        params = LabParams.sampled(robot)
        x, y, heading = placed.tolist()
        self.lab = Lab(noise, params=params, camera=None, start=(x, y, heading), push=push)
        self.commands: list[tuple[float, float, float]] = []
        self.began: list[float] = []

    def seen(self) -> np.ndarray:
        """Return the pose [3] as it is tracked."""
        return self.lab.body.pose + TRACKED * self.rng.standard_normal(3)

    def drive(self, left: float, right: float, seconds: float) -> None:
        """Drive a command."""
        now = self.lab.clock.now()
        for port, power in zip((1, 2), (left, right), strict=True):
            # Motor on, brake, regulated by speed, as the driver sends it.
            self.lab.body.set_output(port, round(power), 0x07, 1, 0, 0x20, 0)
        self.commands.append((left, right, seconds))
        self.began.append(now)
        self.lab.clock.sleep_until(now + seconds)

    def path(self) -> tuple[np.ndarray, np.ndarray]:
        """Stop, and return the true poses [M, 3] since the start and their commands [M]."""
        self.drive(0.0, 0.0, 2 * RUN_DOWN)
        truth = self.lab.truth
        return truth.poses, np.searchsorted(self.began, truth.times, side="right").clip(1) - 1

    def completed(self) -> tuple[bool, np.ndarray]:
        """Stop, and return whether the course was completed, and the path [M, 3]."""
        poses, segment = self.path()
        active = np.append(np.ones(len(self.began) - 1, bool), False)
        times = np.arange(len(poses))
        driven = Trajectory.of_track(times, poses, segment, np.array(self.commands), active)
        return bool(TASK.within_perimeter(PERIMETER).judge(driven).success), poses


class Prepared:
    """A robot, its learned simulator, and the controllers that are evolved there."""

    family = Plan()
    network = Network(("goal_distance", "goal_bearing"), scale=45.0)

    def __init__(self, robot: int, options: argparse.Namespace):
        self.robot, self._options = robot, options
        rows, _ = random_rows(robot, robot, COMMANDS)
        self.simulator = learn(rows, robot)
        self.simulator.perimeter = PERIMETER

    @cached_property
    def plan(self) -> SavedController:
        """The plan."""
        options = self._options
        robust = RobustSettings(generations=options.robust_generations)
        how = {"generations": options.generations, "runs": 6, "robust": robust}
        return self._evolved(self.family, how)

    @cached_property
    def genes(self) -> np.ndarray:
        """Of the network, [G]."""
        return self._evolved(self.network, {"generations": self._options.network_generations}).genes

    def _evolved(self, family: Any, how: dict[str, Any]) -> SavedController:
        settings = default_settings(family, TASK, **how)
        evolved = evolve(
            self.simulator, TASK, family, settings=settings, seed=self.robot, progress=False
        )
        return evolved[0]

    @cached_property
    def expected(self) -> dict[str, np.ndarray]:
        """The expected path of each controller, [N, 3]."""
        evaluator = Evaluator(self.simulator, TASK, self.network)
        poses = evaluator.run(self.genes[None], evaluator.expectation()).poses
        assert poses is not None
        open_loop = predicted(self.simulator, self.plan.commands, TASK.start)
        return {"network": poses[0, 0], "open_loop": open_loop, "replanned": open_loop}

    def push(self, kind: str, number: int) -> Push:
        """Return a push halfway along the expected path, within the rectangle there."""
        path = self.expected[kind]
        step = TASK.step if kind == "network" else DENSE
        if kind == "network":  # it stays where it has arrived
            moving = np.linalg.norm(path[:, :2] - path[-1, :2], axis=1) > 0.05
            path = path[: np.flatnonzero(moving)[-1] + 1]
        half = len(path) // 2
        rng = np.random.default_rng([self.robot, number, 0x9054])
        while True:
            direction = float(rng.uniform(-math.pi, math.pi))
            aside = PUSH * np.array([math.cos(direction), math.sin(direction), 0.0])
            if TASK.region(path[half] + aside) == TASK.region(path[half]):
                return Push(PUSH, half * step, direction)

    def course(self, number: int) -> list[dict]:
        """Drive a course in every way, without a push and with one."""
        results = []
        for kind in KINDS:
            for pushed in (False, True):
                push = self.push(kind, number) if pushed else None
                noise = 1000 * self.robot + number
                physics = Physics(self.robot, noise, TASK.start, push)
                before = getattr(self, f"_{kind}")(physics, noise)
                completed, path = physics.completed()
                results.append(self._row(kind, pushed, False, completed, before, path))
        return results

    def _row(
        self,
        kind: str,
        pushed: bool,
        filmed: bool,
        completed: bool,
        before: np.ndarray,
        path: np.ndarray,
        **more: Any,
    ) -> dict:
        about = {"robot": self.robot, "kind": kind, "pushed": pushed, "camera": filmed}
        return {**about, "completed": completed, "passes_m": passes(before, path), **more}

    def _open_loop(self, physics: Physics, noise: int) -> np.ndarray:
        for command in self.plan.commands:
            if command is not None:
                physics.drive(*command)
        return self.expected["open_loop"]

    def _replanned(self, physics: Physics, noise: int) -> np.ndarray:
        replanner = Replanner(self.simulator, TASK, self.family, self.plan.commands, seed=noise)
        while len(physics.commands) < replanner.steps:
            command = replanner.next(physics.seen())
            if command is None:
                break
            physics.drive(*command)
        poses = [one.pose for one in replanner.foreseen]
        return predicted(self.simulator, physics.commands, poses=poses)

    def _network(self, physics: Physics, noise: int) -> np.ndarray:
        genes = torch.from_numpy(self.genes[None])
        episode, memory = TASK.episode, self.network.start(1)
        goals = Goals(episode, 1)
        for step in range(episode.steps):
            pose = torch.from_numpy(physics.seen()[None])
            seen = observe(self.network.inputs, None, (), pose, goals.at(pose), step * episode.step)
            command, memory = self.network.act(genes, seen, memory)
            physics.drive(*command[0].tolist(), episode.step)
        return self.expected["network"]

    def filmed(self, number: int, folder: Path, calibration: Path | None) -> list[dict]:
        """Drive a course by the controllers that see, through driver, brick, camera and tracker."""
        pushed = (self.robot + number) % 2 == 1
        return [
            self._filmed(kind, pushed, 1000 * self.robot + number, folder, calibration)
            for kind in ("replanned", "network")
        ]

    def _filmed(
        self, kind: str, pushed: bool, noise: int, folder: Path, calibration: Path | None
    ) -> dict:
        family: Any = FixedPlan(tuple(self.plan.commands))
        genes, says, how = np.empty(0), {}, {}
        if kind == "network":
            family, genes = self.network, self.genes
        else:
            says = self.plan.predicted
            how = {"replan": (self.simulator, ReplanSettings()), "seed": noise}
        name, start = f"{kind}-{noise}", TASK.start
        SavedController(family, genes, TASK.describe(), start, says).write(folder / name)
        push = self.push(kind, noise) if pushed else None
        out = folder / f"{name}-trial"
        with VirtualRig(self.robot, noise_seed=noise, start=start, push=push) as rig:
            report = run_trial(
                folder / name,
                out,
                Rig.of_lab(rig),
                track=track,
                calibration=calibration,
                **how,
            )
        (out / "video-001.avi").unlink()
        before = self.expected[kind]
        if kind == "replanned":
            known = json.loads((out / FORESEEN).read_text("utf-8"))["commands"]
            begins = [one["pose"] for one in known]
            before = predicted(self.simulator, report["commands"], poses=begins)
        path = np.array(report["actual"]["path"])[:, 1:]
        more = {"deadlines": report["deadlines"], "reason": report["actual"]["reason"]}
        completed = report["actual"]["completes"]
        return self._row(kind, pushed, True, completed, before, path, **more)

    def go(self, number: int, virtual: bool) -> dict:
        """Go from a random pose to another; return the pose where the robot stopped."""
        noise = 1000 * self.robot + number
        rng = np.random.default_rng([noise, 0x60])
        start, goal = anywhere(AREA, 2, rng)
        within, turned = TOLERANCE
        task = GoTo(
            goals=(tuple(goal),), begin=tuple(start), tolerance=within, heading_tolerance=turned
        )
        plan = Plan(slots=5, durations=(0.3, 3.0))
        # The robot stands: for the first search there is time.
        replanner = Replanner(self.simulator, task, plan, seed=noise)
        drive: Callable[..., None]
        seen: Callable[[], np.ndarray]
        if virtual:
            physics = Physics(self.robot, noise, start)
            drive, seen = physics.drive, physics.seen
        else:
            simulated = Simulated(self.simulator, start, rng)
            drive, seen = simulated.drive, simulated.seen
        seconds = steps = 0.0
        while steps < replanner.steps:
            command = replanner.next(seen())
            if command is None:
                break
            drive(*command)
            seconds, steps = seconds + command[2], steps + 1
        end = physics.path()[0][-1] if virtual else simulated.pose
        away = float(np.linalg.norm(end[:2] - goal[:2]))
        off = abs(math.remainder(end[2] - goal[2], 2 * math.pi))
        there = away <= within and off <= turned
        result = {"robot": self.robot, "lab": virtual, "there": there, "away_m": away}
        return {**result, "off_rad": off, "commands": int(steps), "seconds": seconds}


class Simulated:
    """A robot in a simulator, one sample of it."""

    def __init__(self, simulator: Simulator, start: np.ndarray, rng: np.random.Generator):
        self._stepper, self._rng = simulator.stepper(), rng
        member = rng.integers(0, simulator.members, 1) if simulator.members > 1 else None
        self._state = self._stepper.start(start[None], member)
        self._seed, self._steps = rng.integers(0, 2**63, 1).astype(np.uint64), 0

    @property
    def pose(self) -> np.ndarray:
        """Where it is, [3]."""
        return self._state[0, :3].copy()

    def seen(self) -> np.ndarray:
        """Return the pose [3] as it is tracked."""
        return self.pose + TRACKED * self._rng.standard_normal(3)

    def drive(self, *command: float) -> None:
        """Drive a command (%, %, s)."""
        noise = self._stepper.noise(self._seed, np.array([self._steps]))
        self._state = self._stepper.step(self._state, np.array([command]), noise)
        self._steps += 1


def predicted(
    simulator: Simulator,
    commands: Any,
    start: Any = None,
    *,
    poses: Any = None,
) -> np.ndarray:
    """Return the path [N, 3] that commands are expected to lead along.

    Args:
        simulator: that expects it.
        commands: of (%, %, s); those that are None are not given.
        start: pose [3].
        poses: [K, 3] where each command is expected to begin, if that is known as it is given.
    """
    stepper = simulator.stepper()
    state = stepper.start(np.array([start if poses is None else poses[0]], float))
    path = [state[0, :3].copy()]
    given = [command for command in commands if command is not None]
    for place, (left, right, seconds) in enumerate(given if poses is None else given[: len(poses)]):
        if poses is not None:
            state[0, :3] = poses[place]
        count = max(round(seconds / DENSE), 1)
        for _ in range(count):
            state = stepper.step(state, np.array([[left, right, seconds / count]]), None)
            path.append(state[0, :3].copy())
    return np.array(path)


def passes(before: np.ndarray, path: np.ndarray) -> list[float]:
    """Return the distances (m) of a path from the predicted passages between rectangles.

    Args:
        before: [N, 3] the predicted path.
        path: [M, 3] the driven one.
    """
    region = TASK.region(before)
    places = np.flatnonzero(region[1:] != region[:-1]) + 1
    between = 0.5 * (before[places, :2] + before[places - 1, :2])
    return [float(np.linalg.norm(path[:, :2] - place, axis=1).min()) for place in between]


def describe(drives: list[dict], goes: list[dict]) -> None:
    print(
        "               pushed  through   completed  passes within 3 cm  median cm  nine of ten cm"
    )
    for filmed in (False, True):
        for kind in KINDS:
            for pushed in (False, True):
                rows = [
                    row
                    for row in drives
                    if (row["kind"], row["pushed"], row["camera"]) == (kind, pushed, filmed)
                ]
                if not rows:
                    continue
                near = 100 * np.array([one for row in rows for one in row["passes_m"]])
                done = sum(row["completed"] for row in rows)
                print(
                    f"{kind:14} {'yes' if pushed else 'no':6}  {'camera' if filmed else 'physics'} "
                    f"{done:6} of {len(rows):2}  {(near <= 100 * NEAR).sum():9} of {len(near):3}"
                    f"   {np.median(near):12.1f}  {np.quantile(near, 0.9):14.1f}"
                )
                late = [row["deadlines"] for row in rows if row.get("deadlines")]
                if late:
                    missed = sum(one["missed"] for one in late)
                    print(f"    deadlines missed: {missed} of {sum(one['steps'] for one in late)}")
    for virtual in (False, True):
        rows = [row for row in goes if row["lab"] == virtual]
        if rows:
            there = sum(row["there"] for row in rows)
            away, off, seconds = (
                np.quantile([row[name] for row in rows], 0.95)
                for name in ("away_m", "off_rad", "seconds")
            )
            print(
                f"go to, {'lab' if virtual else 'simulator'}: {there} of {len(rows)} within 2 cm "
                f"and 3 degrees; 95 % of them within {100 * away:.1f} cm, {math.degrees(off):.1f} "
                f"degrees and {seconds:.0f} s"
            )
    sys.stdout.flush()


if __name__ == "__main__":
    main()
