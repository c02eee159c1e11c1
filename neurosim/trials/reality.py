"""Generations on the robot itself: Lund and Miglino 1996, after the transfer."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.interrupts import not_suspended
from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.controllers.base import observe
from neurosim.lab import LabArena, VirtualKheperaRig
from neurosim.loop.evaluate import Evaluator, rollouts_of
from neurosim.loop.objectives import mean_fitness
from neurosim.robots.base import Proximity, Robot, drive_for
from neurosim.robots.khepera.dialects import dialect_named
from neurosim.robots.odometry import Odometry

#: Between trials the robot wanders for so long, so that each begins elsewhere, s.
WANDER = 2.0
#: For so long it then stands still, as it does at the start of a trial in a simulator, s.
REST = 0.3
#: Paths are compared for so many seconds, from so many starts.
SECONDS, STARTS = 10.0, 2


class SeeingRobot(Robot, Proximity, Protocol):
    """A robot that sees what is near."""


class RobotTrials:
    """Tries controllers on a robot, one after the other, in the robot's own time.

    Nobody puts the robot down between trials: it wanders away from what is near, in a direction
    drawn anew, stands still, and the next trial starts from there. Every step begins with a
    reading; the command that follows from it is sent a fixed time later, so that the robot is as
    late in every step as it is in the simulator.

    It is the :class:`~neurosim.loop.reality.RealRobot` of an evolution.

    Attributes:
        robot: connected.
        evaluator: the simulator, task and controller of the evolution; the task is judged by
            readings and commands alone.
        hold: from asking for a reading to sending the command, s, or as long as that takes; see
            :class:`~neurosim.simulators.tables.reaction.Reaction`.
    """

    def __init__(
        self,
        robot: SeeingRobot,
        evaluator: Evaluator,
        *,
        place: Callable[[NDArray[np.float64]], None],
        pose: Callable[[NDArray[np.float64]], Callable[[], Any]],
        about: Mapping[str, Any],
        hold: float = 0.0,
    ):
        """Prepare trials.

        Args:
            robot, evaluator, hold: see the class.
            place: has the robot put at a pose (m, m, rad), by a person or in the lab.
            pose: from a start pose on, returns what tells the robot's pose.
            about: what the evolution says of the robot.
        """
        self.robot, self.evaluator, self.hold = robot, evaluator, hold
        self._place, self._pose, self._about = place, pose, dict(about)

    @property
    def seconds(self) -> float:
        """How long a controller's trial takes, s."""
        task, episode = self.evaluator.task, self.evaluator.episode
        return task.trial_starts * (WANDER + REST + episode.steps * episode.step)

    def describe(self) -> dict[str, Any]:
        """Return what the evolution says of the robot."""
        return dict(self._about)

    def fitness(self, genes: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the fitness [P] of individuals [P, G], each in a trial of its own.

        Raises:
            UserError: if the task cannot be judged without the robot's poses.
        """
        task, found = self.evaluator.task, np.empty(len(genes))
        try:
            for index, one in enumerate(genes):
                drives = []
                for _ in range(task.trial_starts):
                    self._wander(rng)
                    drives.append(self.drive(one, self.evaluator.episode.steps))
                driven = Trajectory(
                    None,
                    np.stack([drive.commands for drive in drives])[None],
                    self.evaluator.episode.step,
                    np.stack([drive.readings for drive in drives])[None],
                )
                found[index] = mean_fitness(task, task.judge(driven).fitness)[0]
        finally:
            self.robot.stop()
        return found

    def compare(self, genes: NDArray[np.float64], seed: int) -> list[dict[str, list]]:
        """Return paths of an individual [G] from the same starts, simulated and driven."""
        evaluator, rng = self.evaluator, np.random.default_rng([seed, 2])
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
        """Drive an individual [G] from where the robot stands.

        Args:
            genes: its genes.
            steps: of the episode's step.
            pose: tells where the robot is [3] (m, m, rad) before the first step and after each.
        """
        controller, names = self.evaluator.controller, self.evaluator.simulator.reading_names
        row, memory = torch.from_numpy(genes[None]), controller.start(1)
        clock, readings, commands = self.robot.clock, [], []
        poses = [] if pose is None else [pose()]
        time = clock.now()
        for step in range(steps):
            seen = self.robot.activations()
            now = torch.from_numpy(np.asarray(seen, np.float64)[None])
            where = torch.zeros(1, 3, dtype=torch.float64)
            observed = observe(
                controller.inputs, now, names, where, None, step * self.evaluator.episode.step
            )
            given, memory = controller.act(row, observed, memory)
            command = given[0].tolist()
            clock.sleep_until(time + self.hold)
            drive_for(self.robot, *command, self.evaluator.episode.step)
            readings.append(seen)
            commands.append(command)
            # A step that took too long shifts those after it rather than shortening them.
            time = max(time + self.evaluator.episode.step, clock.now())
            clock.sleep_until(time)
            if pose is not None:
                poses.append(pose())
        return Trajectory(
            None if pose is None else np.array(poses, float),
            np.array(commands),
            self.evaluator.episode.step,
            np.array(readings),
        )

    def rest(self) -> None:
        """Stop and stand still."""
        self.robot.stop()
        self.robot.clock.sleep_until(self.robot.clock.now() + REST)

    def _wander(self, rng: np.random.Generator) -> None:
        clock = self.robot.clock
        side = 40.0 * rng.choice((-1.0, 1.0))
        turning = rng.uniform(0.0, WANDER / 2)
        begin = clock.now()
        while (now := clock.now()) < begin + WANDER:
            near = self.robot.activations()[:6].max() > 0.3
            ahead = 0.0 if now - begin < turning or near else 1.0
            turn = side * (1.0 - ahead)
            speeds = 60.0 * ahead - turn, 60.0 * ahead + turn
            drive_for(self.robot, *speeds, self.evaluator.episode.step)
            clock.sleep_until(now + self.evaluator.episode.step)
        self.rest()


@contextmanager
def on_khepera(
    robot: Any, evaluator: Evaluator, place: Callable[[NDArray[np.float64]], None]
) -> Iterator[RobotTrials]:
    """Connect a Khepera and give the trials on it; its path is known by its counters.

    Args:
        robot: not connected yet.
        evaluator: of the evolution, in a simulator with a reaction time.
        place: asks a person to put the robot at a pose (m, m, rad).

    Raises:
        UserError: if the reaction time was measured on a line of another speed.
        RobotError: if the robot cannot be reached.
    """
    _check_line(evaluator.simulator, robot.describe()["baud"])
    with not_suspended(), robot:
        yield RobotTrials(
            robot,
            evaluator,
            place=place,
            pose=lambda start: Odometry(robot, start).read,
            about=robot.describe(),
            hold=evaluator.simulator.reaction.hold,  # type: ignore[attr-defined]
        )


@contextmanager
def in_lab(
    evaluator: Evaluator, *, seed: int = 0, lab_seed: int = 0, baud: int | None = None
) -> Iterator[RobotTrials]:
    """Give the trials on a Khepera of the virtual lab, in the simulator's arena.

    Args:
        evaluator: of the evolution, in a table simulator.
        seed: of the lab's noise.
        lab_seed: which virtual robot.
        baud: speed of its line; by default the robot's own.

    Raises:
        UserError: as :func:`on_khepera`.
    """
    baud = baud or dialect_named("khepera").baud
    _check_line(evaluator.simulator, baud)
    arena = evaluator.simulator.arena  # type: ignore[attr-defined]
    start = tuple(arena.free_poses(1, 0.03, np.random.default_rng(seed))[0])
    place = LabArena.of(arena)
    with (
        VirtualKheperaRig(lab_seed, noise_seed=seed, arena=place, start=start, baud=baud) as rig,
        rig.robot as robot,
    ):
        yield RobotTrials(
            robot,
            evaluator,
            place=lambda pose: rig.lab.place(*pose),
            pose=lambda _: lambda: rig.lab.pose,
            about={**robot.describe(), "virtual_lab": rig.describe()},
            hold=evaluator.simulator.reaction.hold,  # type: ignore[attr-defined]
        )


def _check_line(simulator: Any, baud: int) -> None:
    """Refuse a robot on a line of another speed than the reaction time was measured on."""
    sampled = simulator.meta.get("baud")
    if sampled not in (None, baud):
        raise UserError(
            f"the simulator's reaction time was measured at {sampled} baud, and the robot's line "
            f"is at {baud}: give --baud {sampled}, or sample again at {baud}"
        )
