"""Trials of a robot that stays on its floor: Lund and Miglino 1996, after the transfer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from neurosim.base.declared import Baud, Pose, Seed, checks
from neurosim.base.errors import LinkLost, UserError
from neurosim.base.interrupts import not_suspended
from neurosim.base.place import Place
from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.controllers import SavedController
from neurosim.lab import VirtualKheperaRig, VirtualThymioRig
from neurosim.loop.evaluate import Evaluator, rollouts_of
from neurosim.loop.objectives import mean_fitness
from neurosim.recording.commands import Command, Observation
from neurosim.robots.base import Counters, Proximity, Robot, drive_for, read_sensors
from neurosim.robots.khepera.dialects import dialect_named
from neurosim.robots.odometry import Odometry
from neurosim.simulators.base import InPlace
from neurosim.trials.by_hand import answer_to, put_at
from neurosim.trials.driver import Driver, missing

#: Time for which the robot wanders between trials, so that each begins at another pose, s.
WANDER = 2.0
#: Time for which it then stands, as at the start of a trial in a simulator, s.
REST = 0.3
#: Duration of compared paths, s, and number of their starts.
SECONDS, STARTS = 10.0, 2
#: Room around a virtual robot's first pose, m.
FREE = 0.0125
#: Reading of a forward sensor at which the wandering robot turns first.
NEAR = 0.3


class SeeingRobot(Robot, Proximity, Protocol):
    """A robot with proximity sensors."""


class OnFloor:
    """Tries controllers on a robot, one after the other, in the robot's own time.

    Nobody places the robot between trials: it wanders away from near objects, in a random
    direction, stands still, and the next trial starts from there. Every step begins with a reading;
    its command is sent a fixed time later, so that the delay is that of the simulator.

    Attributes:
        robot: connected.
        evaluator: the simulator, task and controller; the task is judged only by readings and
            commands.
        hold: time from the request for a reading to sending the command, s, as in the simulator (it
            may take longer); see :class:`~neurosim.simulators.tables.reaction.Reaction`.
    """

    def __init__(
        self,
        robot: SeeingRobot,
        evaluator: Evaluator,
        *,
        place: Callable[[NDArray[np.float64]], None],
        pose: Callable[[NDArray[np.float64]], Callable[[], Any]] | None,
        about: dict[str, Any],
        seed: int = 0,
    ):
        """Prepare trials.

        Args:
            robot, evaluator: see the class.
            place: makes a person, or the lab, place the robot at a pose (m, m, rad).
            pose: a function from a start pose to a source of the robot's pose; None: the pose is
                unknown.
            about: the robot's description.
            seed: of its wandering.

        Raises:
            UserError: if the robot lacks inputs of the controller or the task.
        """
        self.robot, self.evaluator = robot, evaluator
        reaction = getattr(evaluator.simulator, "reaction", None)
        self.hold = 0.0 if reaction is None else reaction.hold
        self._place, self._pose, self._about = place, pose, about
        self._seed, self._given_up = seed, False
        saved, task = self._saved(np.zeros(evaluator.controller.genes)), evaluator.task
        lacks = missing(saved, robot, None, task)
        if Driver(saved, task.episode, {}).needs_pose:
            lacks.append("the controller needs the robot's pose, and nobody knows where it wanders")
        if lacks:
            raise UserError("; ".join(lacks))
        task.check_scored(False, True)

    @property
    def seconds(self) -> float:
        """Duration of a controller's trial, s."""
        task, episode = self.evaluator.task, self.evaluator.episode
        return task.trial_starts * (WANDER + REST + episode.steps * episode.step)

    def describe(self) -> dict[str, Any]:
        """Return the robot's description."""
        return dict(self._about)

    def stop(self) -> None:
        """Stop the robot, because a trial is given up."""
        self._given_up = True
        self.robot.stop()

    def trial(self, genes: NDArray[np.float64], number: int) -> float:
        """Return the fitness of an individual [G] in a trial, from the robot's present pose."""
        task, rng = self.evaluator.task, np.random.default_rng([self._seed, number, 0xF1])
        drives = []
        try:
            for _ in range(task.trial_starts):
                self._wander(rng)
                drives.append(self.drive(genes, self.evaluator.episode.steps))
        finally:
            self.robot.stop()
        driven = Trajectory(
            None,
            np.stack([drive.commands for drive in drives])[None],
            drives[0].durations,
            np.stack([drive.readings for drive in drives])[None],
        )
        return float(mean_fitness(task, task.judge(driven).fitness)[0])

    def compare(self, genes: NDArray[np.float64], seed: int) -> list[dict[str, list]]:
        """Return paths of an individual [G] from the same starts, simulated and driven."""
        evaluator, rng = self.evaluator, np.random.default_rng([seed, 2])
        if self._pose is None or evaluator.controller.open_loop:
            return []
        steps = round(SECONDS / evaluator.episode.step)
        starts, _ = evaluator.starts(STARTS, rng)
        episode = Episode(evaluator.episode.step, steps, readings=True)
        rollouts = rollouts_of(evaluator.simulator, evaluator.controller, episode)
        paths = rollouts.run(genes[None], Draws(starts)).poses
        assert paths is not None
        drives = []
        for start, path in zip(starts, paths[0], strict=True):
            self.rest()
            self._place(start)
            real = self.drive(genes, steps, self._pose(start))
            assert real.poses is not None
            drives.append({"simulated": path.tolist(), "robot": real.poses.tolist()})
        self.robot.stop()
        return drives

    def drive(
        self, genes: NDArray[np.float64], steps: int, pose: Callable[[], Any] | None = None
    ) -> Trajectory:
        """Drive an individual [G] from the robot's present pose.

        Args:
            genes: its genes.
            steps: of the episode's step.
            pose: gives the robot's pose [3] (m, m, rad) before the first step and after each.
        """
        step, open_loop = self.evaluator.episode.step, self.evaluator.controller.open_loop
        driver = Driver(self._saved(genes), self.evaluator.episode, {}, self.robot.commands)
        names = self.evaluator.simulator.reading_names
        clock, readings, commands = self.robot.clock, [], []
        poses = [] if pose is None else [pose()]
        time = clock.now()
        for number in range(max(driver.steps, 1) if open_loop else steps):
            if self._given_up:
                raise LinkLost("the trial was given up")
            seen = read_sensors(self.robot, names)
            command = Command((0.0, 0.0), step)  # of a plan without any
            if driver.steps:
                command = driver.react(Observation(number * step, None, seen))
            clock.sleep_until(time + self.hold)
            drive_for(self.robot, command.numbers, command.duration)
            readings.append([seen[name] for name in names])
            commands.append([*command.numbers, command.duration])
            # A late step shifts the following ones instead of shortening them.
            time = max(time + command.duration, clock.now())
            clock.sleep_until(time)
            if pose is not None:
                poses.append(pose())
        given, path = np.array(commands), None if pose is None else np.array(poses, float)
        return Trajectory(
            path,
            given if open_loop else given[:, :-1],
            given[:, -1] if open_loop else step,
            np.array(readings),
        )

    def rest(self) -> None:
        """Stop and stand still."""
        self.robot.stop()
        self.robot.clock.sleep_until(self.robot.clock.now() + REST)

    def _saved(self, genes: NDArray[np.float64]) -> SavedController:
        task = self.evaluator.task
        return SavedController(self.evaluator.controller, genes, task.describe(), task.start, {})

    def _wander(self, rng: np.random.Generator) -> None:
        clock, ahead = self.robot.clock, np.cos(self.robot.angles) > -0.01
        side = 40.0 * rng.choice((-1.0, 1.0))
        turning = rng.uniform(0.0, WANDER / 2)
        begin = clock.now()
        while (now := clock.now()) < begin + WANDER and not self._given_up:
            near = self.robot.activations()[ahead].max() > NEAR
            forward = 0.0 if now - begin < turning or near else 60.0
            turn = 0.0 if forward else side
            drive_for(self.robot, (forward - turn, forward + turn), self.evaluator.episode.step)
            clock.sleep_until(now + self.evaluator.episode.step)
        self.rest()


def about_robot(robot: Robot) -> dict[str, Any]:
    """Return the robot's description, without its port and its counts so far."""
    return {k: v for k, v in robot.describe().items() if k not in ("port", "reboots")}


@contextmanager
def on_floor(robot: Any, controller: Any, task: Any, simulator: Any) -> Iterator[OnFloor]:
    """Connect a robot and give the trials on its floor; its path comes from its counters.

    Args:
        robot: not connected yet.
        controller, task: see :class:`OnFloor`.
        simulator: the simulator of the controller's evolution.

    Raises:
        UserError: if the robot lacks inputs, or its line has another speed than that of the
            simulator's measured reaction time.
        RobotError: if it cannot be reached.
    """
    evaluator = Evaluator(simulator, task, controller)
    _check_line(simulator, robot.describe().get("baud"))
    with not_suspended(), robot:
        yield OnFloor(
            robot,
            evaluator,
            place=_put_by_a_person,
            pose=(lambda start: Odometry(robot, start).read)
            if isinstance(robot, Counters)
            else None,
            about=about_robot(robot),
        )


@contextmanager
@checks
def virtual_khepera(
    controller: Any,
    task: Any,
    simulator: Any,
    lab_seed: Seed = 0,
    baud: Baud | None = None,
    seed: Seed = 0,
) -> Iterator[OnFloor]:
    """Give the trials on a Khepera of the virtual lab, in the simulator's place.

    Args:
        controller, task, simulator: see :func:`on_floor`.
        lab_seed: Number of the virtual lab's robot.
        baud: Speed of its serial line; by default the robot's own, 9600.
        seed: Of the lab's noise.

    Raises:
        UserError: as :func:`on_floor`.
    """
    baud = baud or dialect_named("khepera").baud
    _check_line(simulator, baud)

    def rig(place: Place, start: Pose) -> VirtualKheperaRig:
        return VirtualKheperaRig(lab_seed, noise_seed=seed, place=place, start=start, baud=baud)

    with _in_the_lab(rig, Evaluator(simulator, task, controller), seed) as trials:
        yield trials


@contextmanager
@checks
def virtual_thymio(
    controller: Any, task: Any, simulator: Any, lab_seed: Seed = 0, seed: Seed = 0
) -> Iterator[OnFloor]:
    """Give the trials on a Thymio of the virtual lab, in the simulator's place.

    Args:
        controller, task, simulator: see :func:`on_floor`.
        lab_seed: Number of the virtual lab's robot.
        seed: Of the lab's noise.

    Raises:
        UserError: as :func:`on_floor`.
    """

    def rig(place: Place, start: Pose) -> VirtualThymioRig:
        return VirtualThymioRig(lab_seed, noise_seed=seed, around=place, start=start, camera=False)

    with _in_the_lab(rig, Evaluator(simulator, task, controller), seed) as trials:
        yield trials


@contextmanager
def _in_the_lab(
    make: Callable[[Place, Pose], Any], evaluator: Evaluator, seed: int
) -> Iterator[OnFloor]:
    """Give the trials on a virtual robot, in the simulator's place.

    Args:
        make: makes the robot's rig from the place and its first pose.
        evaluator: the simulator, task and controller.
        seed: of its first pose and its wandering.
    """
    simulator: Any = evaluator.simulator
    if not isinstance(simulator, InPlace):
        raise UserError(
            f"the virtual robot drives in the simulator's place, and a simulator of the kind "
            f"{simulator.kind} has none: name another reality (--reality)"
        )
    place, room = simulator.place, simulator.radius + FREE
    start = tuple(place.free_poses(1, room, np.random.default_rng(seed))[0].tolist())
    with make(place, start) as rig, rig.robot as robot:
        yield OnFloor(
            robot,
            evaluator,
            place=lambda pose: rig.lab.place(*pose),
            pose=lambda _: lambda: rig.lab.body.pose,
            about={**about_robot(robot), "virtual_lab": rig.describe()},
            seed=seed,
        )


def _put_by_a_person(start: NDArray[np.float64]) -> None:
    answer_to(f"{put_at(start)}, and press Enter: ")


def _check_line(simulator: Any, baud: int | None) -> None:
    """Raise an error for a line of another speed than that of the measured reaction time."""
    sampled = getattr(simulator, "meta", {}).get("baud")
    if None not in (sampled, baud) and sampled != baud:
        raise UserError(
            f"the simulator's reaction time was measured at {sampled} baud, and the robot's line "
            f"is at {baud}: give --baud {sampled}, or sample again at {baud}"
        )
