"""The virtual lab: a board, a robot and a roof camera with a common time of their own."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np

from neurosim.base.errors import UserError
from neurosim.base.files import number, open_own, read_csv
from neurosim.base.place import Place
from neurosim.lab.camera.camera import RoofCamera
from neurosim.lab.contact import deepest
from neurosim.lab.nxt.body import NxtBody, Wiring
from neurosim.lab.nxt.params import BOARD, CameraParams, LabParams

#: Radius (m) of the disc that meets walls and obstacles, if a robot has no ``radius``; and the time
#: step (s).
SIZE, CONTACT = 0.12, 0.01
_TRUTH_COLUMNS = ("time", "x", "y", "theta", "voltage")


@dataclass(frozen=True)
class Truth:
    """The true motion, for tests and reports alone; no learner reads it."""

    #: Lab time, which is also the robot clock, [N] (s); poses [N, 3] (m, m, rad, unwrapped);
    #: the battery's voltage under load, [N] (V).
    times: np.ndarray
    poses: np.ndarray
    voltage: np.ndarray

    def pose_at(self, times: np.ndarray) -> np.ndarray:
        """Return the poses [..., 3] at given times, by linear interpolation."""
        columns = [np.interp(times, self.times, self.poses[:, i]) for i in range(3)]
        return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class Push:
    """A hand that pushes the robot aside while it drives.

    Attributes:
        metres: distance of the push.
        after: delay after the first command to a wheel, s.
        direction: rad, board frame.
        seconds: its duration, at a steady speed.
    """

    metres: float
    after: float
    direction: float
    seconds: float = 0.3

    #: Number of steps of a push.
    STEPS: ClassVar[int] = 30

    def __post_init__(self) -> None:
        if not (math.isfinite(self.metres) and self.after >= 0 and self.seconds > 0):
            raise ValueError(f"a push needs a length, a time and a duration, not {self}")


class Program(Protocol):
    """A robot's program that ends commands by itself."""

    #: End of the running command, s of the lab's time; infinity: no command runs.
    ends: float

    def end(self) -> None:
        """End the command."""
        ...


class Body(Protocol):
    """A robot's body, whose time advances on request; see :class:`NxtBody`."""

    driven_at: float | None

    @property
    def time(self) -> float:
        """The time in seconds."""
        ...

    @property
    def pose(self) -> np.ndarray:
        """The true pose, [3] (m, m, rad unwrapped, board frame)."""
        ...

    @property
    def voltage(self) -> float:
        """The battery's voltage, V."""
        ...

    def place(self, x: float, y: float, theta: float) -> None:
        """Place the robot at a pose (m, m, rad)."""
        ...

    def shove(self, x: float, y: float) -> None:
        """Push the robot aside by these distances, m."""
        ...

    def advance(self, until: float) -> None:
        """Advance to a time, s."""
        ...

    def lamp_light(self) -> float:
        """Return the integral of the lamp's brightness so far, in seconds of full brightness."""
        ...


class LabTime:
    """A time that advances only on request, or, under a :class:`Pacer`, with the wall clock.

    Hold :attr:`lock` while you use the objects in the lab.

    Attributes:
        program: of a robot that ends its commands by itself, or None.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.clock = LabClock(self)
        self._moved = threading.Condition(self.lock)
        self._paced = False
        self.program: Program | None = None

    @property
    def time(self) -> float:
        """Seconds since the lab was made."""
        raise NotImplementedError

    def advance_to(self, time: float) -> None:
        """Wait until the lab's time is ``time`` (s); return at once if it is later."""
        with self.lock:
            while self._paced and self.time < time:
                self._moved.wait()
            self._advance(time)

    def _advance(self, time: float) -> None:
        raise NotImplementedError


class Lab(LabTime):
    """A board with a robot on it under a camera; its time advances only on request.

    Hold :attr:`lock` while you use the body. With :class:`Pacer` the time is the wall clock's,
    and :meth:`advance_to` waits for it.

    Args:
        seed: of the robot, the board and all noise.
        params: the robot and its ground; by default drawn from the seed.
        camera: the roof camera, or None for a lab without one (a hundred times faster).
        start: first pose of the robot (m, m, rad, board frame).
        wiring: the wiring of the brick.
        truth_rate: true poses kept per second of lab time; 0 for none.
        around: the place: lines and objects on the floor.
        push: a push of the robot, or None.
        body: a robot that replaces the NXT.
    """

    def __init__(
        self,
        seed: int,
        *,
        params: LabParams | None = None,
        camera: CameraParams | None = CameraParams(),  # noqa: B008 - frozen
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        wiring: Wiring | None = None,
        truth_rate: float = 100.0,
        around: Place = Place(),  # noqa: B008 - frozen
        push: Push | None = None,
        body: Body | None = None,
    ):
        self.seed = seed
        self._push, self._pushed = push, 0
        super().__init__()
        self.params = LabParams.sampled(seed) if params is None else params
        self.body: Any = body or NxtBody(self.params, seed, (0.0, 0.0, 0.0), wiring, around)
        self.around = around
        self._size: float = getattr(self.body, "radius", SIZE)
        self.place(*start)
        self.camera = (
            None if camera is None else RoofCamera(camera, seed, lambda: self.time, around)
        )
        self._truth_rate = truth_rate
        self._truth = np.empty((1024, len(_TRUTH_COLUMNS)))
        self._kept = self._written = self._ticks = 0

    @property
    def time(self) -> float:
        """Seconds since the lab was made."""
        return self.body.time

    def place(self, x: float, y: float, theta: float) -> None:
        """Place the robot at a pose (m, m, rad, board frame).

        Raises:
            UserError: if the pose is outside of the room, or in a wall or an obstacle.
        """
        board = self.around.board or BOARD
        things = np.concatenate([self.around.surfaces.reshape(-1, 2), self.around.cylinders[:, :2]])
        room = np.array([board.length, board.width]) / 2 + self.params.room
        if not (np.abs([x, y]) <= np.maximum(room, np.abs(things).max(axis=0, initial=0.0))).all():
            raise UserError(
                f"the robot cannot start at x {100 * x:.1f} cm, y {100 * y:.1f} cm: it is outside "
                "of the lab's room"
            )
        if self.around.solid:
            self.around.check_start((x, y, theta), self._size)
        with self.lock:
            self.body.place(x, y, theta)

    def _advance(self, time: float) -> None:
        # Frames that become due meanwhile go to the object that started the camera.
        while True:
            truth_due = self._ticks / self._truth_rate if self._truth_rate > 0 else math.inf
            camera_due = math.inf if self.camera is None else self.camera.due
            push_due = self._push_due()
            program_due = math.inf if self.program is None else self.program.ends
            due = min(truth_due, camera_due, push_due, program_due)
            if due > time:
                break
            self._drive(due)
            if program_due <= due:
                self.program.end()
            if push_due <= due:
                self._shove()
            if truth_due <= due:
                self._keep_truth()
            if camera_due <= due:
                self.camera.look(self.body.pose, self.body.lamp_light())
        self._drive(time)

    def _drive(self, until: float) -> None:
        """Let the robot drive; at walls and obstacles it slides along the surface."""
        if not self.around.solid:
            self.body.advance(until)
            return
        begun, walls, cylinders = self.body.time, self.around.surfaces, self.around.cylinders
        pieces = max(math.ceil((until - begun) / CONTACT - 1e-9), 1)
        for moment in np.linspace(begun, until, pieces + 1)[1:].tolist():
            self.body.advance(moment)
            for _ in range(4):
                x, y, _ = self.body.pose
                depth, to_x, to_y = deepest(x, y, self._size, walls, cylinders)
                if depth <= 0.0:
                    break
                self.body.shove(depth * to_x, depth * to_y)

    def _push_due(self) -> float:
        """Return the time of the next push (s), infinity for none."""
        push, began = self._push, self.body.driven_at
        if push is None or began is None or self._pushed == push.STEPS:
            return math.inf
        return began + push.after + push.seconds * (self._pushed + 1) / push.STEPS

    def _shove(self) -> None:
        push = self._push
        assert push is not None
        self._pushed += 1
        distance = push.metres / push.STEPS
        self.body.shove(distance * math.cos(push.direction), distance * math.sin(push.direction))

    def _keep_truth(self) -> None:
        if self._kept == len(self._truth):
            self._truth = np.concatenate([self._truth, np.empty_like(self._truth)])
        row = self._truth[self._kept]
        row[0], row[1:4], row[4] = self.time, self.body.pose, self.body.voltage
        self._kept += 1
        self._ticks += 1

    @property
    def truth(self) -> Truth:
        """The true motion so far."""
        with self.lock:
            rows = self._truth[: self._kept].copy()
        return Truth(rows[:, 0], rows[:, 1:4], rows[:, 4])

    def write_truth(self, folder: str | Path, session: int = 1) -> Path:
        """Add the true motion since the last call to ``truth/truth-001.csv`` in ``folder``.

        Columns are time, x, y, theta, voltage, as in :class:`Truth`; the number in the name is
        the session's. The first call of a lab begins a new file.

        Returns:
            The file.
        """
        path = Path(folder) / "truth" / f"truth-{session:03d}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        with self.lock:
            rows = self._truth[self._written : self._kept].copy()
            first = self._written == 0
            self._written = self._kept
        with open_own(path, "wb" if first else "ab") as file:
            if first:
                file.write((",".join(_TRUTH_COLUMNS) + "\n").encode())
            np.savetxt(file, rows, fmt="%.6f", delimiter=",")
        return path


def read_truth(folder: str | Path, session: int = 1) -> Truth:
    """Read the file of :meth:`Lab.write_truth` in a recording.

    Raises:
        FileError: if it is missing or damaged.
    """
    path = Path(folder) / "truth" / f"truth-{session:03d}.csv"
    table = read_csv(path, dict.fromkeys(_TRUTH_COLUMNS, number), drop_torn_line=True)
    rows = table.to_numpy()
    return Truth(rows[:, 0], rows[:, 1:4], rows[:, 4])


class LabClock:
    """The lab's time as a robot's clock; a sleep advances the lab."""

    def __init__(self, lab: LabTime):
        self._lab = lab

    def now(self) -> float:
        """Return the lab's time (s)."""
        with self._lab.lock:
            return self._lab.time

    def sleep_until(self, time: float) -> None:
        """Advance the lab to ``time`` (s)."""
        self._lab.advance_to(time)


class Pacer:
    """Keeps a lab's time in step with the wall clock, in a thread, while used as a context.

    A lab that is too slow (rendering on a slow machine) is late and catches up afterwards.
    """

    def __init__(self, lab: LabTime, *, tick: float = 0.005):
        self._lab = lab
        self._tick = tick
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="lab pacer", daemon=True)
        self._error: BaseException | None = None

    def __enter__(self) -> Pacer:
        self._lab._paced = True
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Stop pacing; raise the error that stopped the pacer before, if any."""
        self._end.set()
        self._thread.join()
        if self._error is not None and error[0] is None:
            raise self._error

    def _run(self) -> None:
        lab = self._lab
        zero = time.perf_counter() - lab.time
        try:
            while not self._end.wait(self._tick):
                with lab.lock:
                    # A late lab advances in small pieces, so that others can get its lock.
                    lab._advance(min(time.perf_counter() - zero, lab.time + 10 * self._tick))
                    lab._moved.notify_all()
        except BaseException as error:
            self._error = error
        finally:
            with lab.lock:
                lab._paced = False
                lab._moved.notify_all()
