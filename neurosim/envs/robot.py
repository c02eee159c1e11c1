"""A task on a robot, virtual or real, as a Gymnasium environment with a simulator's spaces."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.envs.face import Face
from neurosim.envs.single import TrialEnv, made
from neurosim.recording.closed_loop import Deadlines
from neurosim.recording.markers import marker_settings
from neurosim.recording.perimeter import Reckoning
from neurosim.recording.session import STILL, flash
from neurosim.recording.settings import RecordSettings
from neurosim.recording.spotter import Spotter
from neurosim.robots.base import Counters, Lamp, drive_for, read_sensors, sensors_read_with
from neurosim.robots.odometry import Odometry
from neurosim.simulators.base import Simulator
from neurosim.simulators.sampling import PLACING, placed
from neurosim.tasks.base import EVERY, Interval, Task
from neurosim.trials.by_hand import put_at
from neurosim.trials.rig import RIGS, Setup, open_rig, place_of
from tracking.camera.camera_model import CameraModel

#: Time that the robot stands still before a trial, s.
REST = 0.3


class RobotEnv(TrialEnv):
    """A trial of a task on the robot is an episode, in the robot's own time.

    Spaces, observations and rewards are those of :class:`neurosim.envs.single.TaskEnv` in the
    simulator. An action lasts for the task's step; :meth:`step` returns at its end. Poses come from
    the wheels' counters, or from a camera with a calibration; these are predicted to the time of
    the observation from the last actions, and a lamp flashes before the first trial to tell how
    late they are. The last ``info`` also has
    ``missed_deadlines``, the number of actions that came too late.

    Attributes:
        robot: its driver.
    """

    def __init__(
        self,
        simulator: str | Path | Simulator,
        task: str | Mapping[str, Any] | Task = "nine-rectangles",
        *,
        robot: str = "virtual",
        options: Mapping[str, Any] | None = None,
        calibration: str | Path | None = None,
        camera: str | None = None,
        place: Callable[[Sequence[float]], None] | None = None,
        observe: Sequence[str] | None = None,
        render_mode: str | None = None,
        **settings: Any,
    ):
        """Connect.

        Args:
            simulator: of this robot; it determines the spaces.
            task: its name, or the task.
            robot: a name for ``--robot``: virtual, virtual-khepera, or a real robot's.
            options: of the robot.
            calibration: of the camera that films it; without one, poses come from its counters.
            camera: a camera's number or URL; in the virtual lab its own.
            place: a function that places the robot at a pose (m, m, rad) before each trial; by
                default the virtual lab does this, or a person is asked at the terminal.
            observe: names of the observations.
            render_mode: None, rgb_array or human.
            settings: of a task that is given by name.

        Raises:
            UserError: if the robot does not take the simulator's commands, lacks its sensors, or
                its pose is unknown; or as for a simulator.
            RobotError: if it cannot be reached.
        """
        simulator, goal = made(simulator, task, settings)
        self._face = Face(simulator, goal, 1, observe)
        self.observation_space = self._face.observation_space
        self.action_space = self._face.action_space
        self._prepare(simulator, goal, render_mode)
        self._timed = False
        self._stack = ExitStack()
        with ExitStack() as opening:
            setup = Setup(
                camera=camera or (None if calibration is not None else "none"),
                place=place_of(robot, goal, simulator),
            )
            rig = opening.enter_context(open_rig(robot, options, setup))
            self.robot = opening.enter_context(rig.robot)
            usual = {"full": RecordSettings.full_speed, "track": RecordSettings.track}
            self._takes = self.robot.commands.measured(**usual)
            own = rig.place
            self._place = place or (_ask if own is None else lambda pose: own(*pose))
            self._virtual = RIGS.is_virtual(robot)
            self._spotter: Spotter | None = None
            if calibration is not None:
                self._spotter = self._watch(rig.camera, Path(calibration), robot, opening)
            self._check_robot(robot)
            self._stack = opening.pop_all()

    def _check_robot(self, name: str) -> None:
        takes = self.robot.commands.names
        if sorted(self._face.outputs) != sorted(takes):
            raise UserError(
                f"the simulator ({self._face.simulator.kind}) takes "
                f"{', '.join(self._face.outputs)}, and the robot {name} is driven by "
                f"{', '.join(takes)}"
            )
        names = sensors_read_with(self.robot)
        lacking = [one for one in self._face.simulator.reading_names if one not in names]
        if self._face.reads and lacking:
            raise UserError(
                f"the robot {name} has no {', '.join(lacking)}, which this simulator reads: use a "
                "simulator of this robot"
            )
        if self._spotter is None and not isinstance(self.robot, Counters):
            raise UserError(
                f"the position of the robot {name} is unknown, because it has no wheel counters: "
                "give the calibration of a camera above it"
            )

    def _watch(self, camera: Any, calibration: Path, robot: str, stack: ExitStack) -> Spotter:
        model = CameraModel.read(calibration)
        if camera is None or not model.has_board:
            raise UserError(
                f"{calibration} gives no positions: a camera and a calibration with points on the "
                "board are needed"
            )
        spotter = Spotter(
            marker_settings(robot=robot),
            model,
            self.robot.clock.now,
            _Nothing(),  # type: ignore[arg-type]
            0,
            gymnasium.logger.warn,
            waits=camera.waits,
        )
        camera.start(spotter.take)
        stack.callback(spotter.close)
        stack.callback(camera.stop)
        return spotter

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Stop the robot, have it placed at the start of a trial, and observe it."""
        self._check_open()
        super().reset(seed=seed)
        task, simulator = self._face.task, self._face.simulator
        self.robot.stop()
        starts = task.draw_starts(simulator, 1, self.np_random)
        start = np.asarray(task.start if starts is None else starts[0], np.float64)
        there = start
        if self._virtual and starts is None:  # with a person's error
            there = placed(start[None], PLACING, self.np_random)[0]
        self._place([float(value) for value in there])
        clock = self.robot.clock
        clock.sleep_until(clock.now() + REST)
        self._odometry = None
        if self._spotter is None:
            self._odometry = Odometry(self.robot, start)  # type: ignore[arg-type]
        self._pose, self._steps, self._deadlines = start, 0, Deadlines()
        self._due: float | None = None
        self._reckoning = Reckoning()
        if self._spotter is not None:
            if self._spotter.unseen(clock.now()) > REST:
                raise UserError("the camera does not see the robot: put it on the board, in view")
            if isinstance(self.robot, Lamp) and not self._timed:
                self._spotter.time_by_flash(self._flash(self.robot))
                self._timed = True
        self._look()
        self._face.begin(np.zeros(1, np.int64), self._pose[None])
        self._begun = True
        if self._picture is not None:
            self._picture.begin([0], self._pose[None])
        self._show(1e3)  # in the robot's own time
        return self._see(), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Give the robot a command, and return at the end of the task's step.

        Raises:
            UserError: if the action is not in the action space, or no trial is running.
            RobotError: if the robot stopped answering.
        """
        self._check_open()
        if not self._begun:
            raise UserError("no trial has begun: call reset() before step()")
        commands = self._face.checked(action)
        face, clock, episode = self._face, self.robot.clock, self._face.episode
        takes = self.robot.commands
        given = dict(zip(face.outputs, map(float, commands[0]), strict=False))
        command = tuple(min(max(given[x.name], x.low), x.high) for x in takes.numbers)
        now = clock.now()
        due = now if self._due is None else self._due
        drive_for(self.robot, command, episode.step)
        self._drives(command)
        self._due = self._deadlines.sent(due, now, episode.step)
        readings = self._readings
        clock.sleep_until(self._due)
        self._look()
        face.add(
            EVERY, Interval(self._pose[None], episode.step, commands=commands, readings=readings)
        )
        self._steps += 1
        decided = bool(face.records.over()[0])
        late = self._steps >= episode.steps and not decided
        info: dict[str, Any] = {}
        if decided or late:
            self.robot.stop()
            self._drives(self.robot.commands.rest(command))
            if late and episode.rest > 0:  # the result of one that is decided does not change
                clock.sleep_until(clock.now() + episode.rest)
                readings = self._readings
                self._look()
                still = face.lasting(np.zeros((1, 2)), episode.rest)
                moved = Interval(
                    self._pose[None], episode.rest, False, commands=still, readings=readings
                )
                face.add(EVERY, moved)
        reward, judged = face.reward()
        if decided or late:
            self._begun = False
            info = {
                "is_success": bool(judged.success[0]),
                "progress": float(judged.progress[0]),
                "missed_deadlines": self._deadlines.missed,
            }
        if self._picture is not None:
            self._picture.add(self._pose[None])
        self._show(1e3)  # in the robot's own time
        return self._see(), float(reward[0]), decided, late, info

    def _drives(self, command: tuple[float, ...]) -> None:
        """Note a command that has just been sent."""
        if self._takes.moves_as_known:
            self._reckoning.sent(self.robot.clock.now(), self._takes.twist(command))

    def _flash(self, lamp: Lamp) -> list[tuple[float, float]]:
        clock = self.robot.clock

        def wait(seconds: float) -> None:
            clock.sleep_until(clock.now() + seconds)

        wait(STILL)
        times = flash(lamp, wait, lambda what: clock.now())
        wait(STILL)
        return times

    def _look(self) -> None:
        """Read the sensors and the pose; a robot that is not seen keeps its last pose."""
        self._readings = None
        if self._face.reads:
            names = self._face.simulator.reading_names
            read = read_sensors(self.robot, names)
            values = [read[name] for name in names]
            self._readings = np.array([values], np.float32)
        if self._odometry is not None:
            self._pose = np.array(self._odometry.read())
        elif self._spotter is not None and (last := self._spotter.last) is not None:
            pose, _ = self._reckoning.predict(last[1], last[0], self.robot.clock.now())
            turned = pose[2] - self._pose[2]  # a camera measures headings within one turn
            self._pose = np.array([*pose[:2], self._pose[2] + se2.wrapped(turned)])

    def _see(self) -> NDArray[np.float32]:
        times = np.array([self._steps * self._face.episode.step])
        return self._face.observation(EVERY, self._pose[None], self._readings, times)[0]

    def close(self) -> None:
        """Stop the robot and disconnect."""
        if self._closed:
            return
        super().close()
        self._stack.close()


class _Nothing:
    """A log that keeps nothing."""

    def append(self, *values: Any) -> None:
        """Forget it."""


def _ask(pose: Sequence[float]) -> None:
    """Ask a person to place the robot at a pose (m, m, rad)."""
    input(f"{put_at(pose)}; Enter: ")
