"""Trials of networks on the robot itself: Lund and Miglino 1996, generations after the transfer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.robots.base import Proximity, Robot
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance, Trajectory

#: Between trials the robot wanders for so long, so that each begins elsewhere, s.
WANDER = 2.0
#: For so long it then stands still, as it does at the start of a trial in a simulator, s.
REST = 0.3


class SeeingRobot(Robot, Proximity, Protocol):
    """A robot that sees what is near."""


class RobotTrials:
    """Tries networks on a robot, one after the other, in the robot's own time.

    Nobody puts the robot down between trials: it wanders away from what is near, in a direction
    drawn anew, stands still, and the next trial starts from there. Every step begins with a
    reading; the command that follows from it is sent a fixed time later, so that the robot is as
    late in every step as it is in the simulator.

    Attributes:
        robot: connected.
        task: what counts as good, of readings and commands alone.
        hold: from asking for a reading to sending the command, s, or as long as that takes; see
            :class:`~neurosim.simulators.tables.reaction.Reaction`.
    """

    def __init__(self, robot: SeeingRobot, task: ObstacleAvoidance, hold: float = 0.0):
        if task.fitness != "avoidance":
            raise UserError(
                f"the fitness {task.fitness!r} needs the robot's poses, which it does not know; "
                "on the robot only avoidance can be evolved"
            )
        self.robot = robot
        self.task = task
        self.hold = hold

    @property
    def seconds(self) -> float:
        """How long a network's trial takes, s."""
        return self.task.starts * (WANDER + REST + self.task.steps_a_start * self.task.duration)

    def __call__(self, genes: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the fitness [P] of networks [P, 18], each in a trial of its own."""
        found = np.empty(len(genes))
        try:
            for place, one in enumerate(genes):
                drives = []
                for _ in range(self.task.starts):
                    self._wander(rng)
                    drives.append(self.drive(one, self.task.steps_a_start))
                found[place] = self.task.evaluate(
                    Trajectory(
                        np.stack([drive.readings for drive in drives]),
                        np.stack([drive.commands for drive in drives]),
                    )
                )
        finally:
            self.robot.stop()
        return found

    def drive(
        self, genes: NDArray[np.float64], steps: int, pose: Callable[[], Any] | None = None
    ) -> Trajectory:
        """Drive a network [18] from where the robot stands.

        Args:
            genes: its weights.
            steps: of the task's duration.
            pose: tells where the robot is [3] (m, m, rad) before the first step and after each.
        """
        weights = genes.reshape(2, -1)
        clock, readings, commands = self.robot.clock, [], []
        poses = [] if pose is None else [pose()]
        time = clock.now()
        for _ in range(steps):
            seen = self.robot.activations()
            command = 100.0 * np.tanh(weights[:, :-1] @ seen + weights[:, -1])
            clock.sleep_until(time + self.hold)
            self.robot.drive(*command)
            readings.append(seen)
            commands.append(command)
            # A step that took too long shifts those after it rather than shortening them.
            time = max(time + self.task.duration, clock.now())
            clock.sleep_until(time)
            if pose is not None:
                poses.append(pose())
        return Trajectory(
            np.array(readings), np.array(commands), None if pose is None else np.array(poses, float)
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
            self.robot.drive(60.0 * ahead - turn, 60.0 * ahead + turn)
            clock.sleep_until(now + self.task.duration)
        self.rest()
