"""The virtual lab: a board, a robot and a roof camera in one time of their own."""

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

#: Walls and obstacles meet a disc of this radius around the middle of a robot that has no
#: ``radius`` of its own, m, so often, s.
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
        """Return the poses [..., 3] at given times, linear between what was kept."""
        columns = [np.interp(times, self.times, self.poses[:, i]) for i in range(3)]
        return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class Push:
    """A hand that pushes the robot aside while it drives, whatever its wheels do.

    Attributes:
        metres: how far.
        after: delay after the first command to a wheel, s.
        direction: rad, board frame.
        seconds: for so long, at a steady speed.
    """

    metres: float
    after: float
    direction: float
    seconds: float = 0.3

    #: It moves so many times.
    STEPS: ClassVar[int] = 30

    def __post_init__(self) -> None:
        if not (math.isfinite(self.metres) and self.after >= 0 and self.seconds > 0):
            raise ValueError(f"a push needs a length, a time and a duration, not {self}")


class Program(Protocol):
    """A robot's program that ends its commands by itself."""

    #: When the command that runs is over, s of the lab's time; infinity: none runs.
    ends: float

    def end(self) -> None:
        """End it."""
        ...


class Body(Protocol):
    """A robot's body in a time that moves when asked to; see :class:`NxtBody`."""

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
        """Put it down at a pose (m, m, rad)."""
        ...

    def shove(self, x: float, y: float) -> None:
        """Push it aside by so much, m."""
        ...

    def advance(self, until: float) -> None:
        """Drive on to a time, s."""
        ...

    def lamp_light(self) -> float:
        """Return the lamp's light summed over time until now, in seconds of full brightness."""
        ...


class LabTime:
    """A time that moves only when asked to, or, under a :class:`Pacer`, with the wall clock.

    Hold :attr:`lock` while touching the objects in the lab.

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
        """Return once the lab's time is ``time`` (s); at once if it is already."""
        with self.lock:
            while self._paced and self.time < time:
                self._moved.wait()
            self._advance(time)

    def _advance(self, time: float) -> None:
        raise NotImplementedError


class Lab(LabTime):
    """A board with a robot on it under a camera, in a time that moves only when asked to.

    Hold :attr:`lock` while touching the body. With :class:`Pacer` the time is the wall clock's,
    and :meth:`advance_to` waits for it.

    Args:
        seed: of everything drawn: the robot, the board, all noise.
        params: the robot and its ground; by default drawn from the seed.
        camera: the roof camera, or None for a lab without one (a hundred times faster).
        start: where the robot stands at first (m, m, rad, board frame).
        wiring: the wiring of the brick.
        truth_rate: true poses kept per second of lab time; 0 for none.
        around: the place: what lies and stands on the floor.
        push: what pushes the robot, or None.
        body: a robot in place of the NXT.
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
        """Put the robot down at a pose (m, m, rad, board frame).

        Raises:
            UserError: if that is beyond the room, and beyond all walls and obstacles, or it would
                stand in one.
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
        # Frames that fall due on the way are delivered to whoever started the camera.
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
        """Let the robot drive; walls and obstacles push it aside, and it slides along them."""
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
        """Return when the robot is next pushed (s), infinity for never."""
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
        """Add what truly happened since the last call to ``truth/truth-001.csv`` in ``folder``.

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
    """Read what :meth:`Lab.write_truth` wrote next to a recording.

    Raises:
        FileError: if it is missing or damaged.
    """
    path = Path(folder) / "truth" / f"truth-{session:03d}.csv"
    table = read_csv(path, dict.fromkeys(_TRUTH_COLUMNS, number), drop_torn_line=True)
    rows = table.to_numpy()
    return Truth(rows[:, 0], rows[:, 1:4], rows[:, 4])


class LabClock:
    """The lab's time as a robot's clock: to sleep is to let the lab go on."""

    def __init__(self, lab: LabTime):
        self._lab = lab

    def now(self) -> float:
        """Return the lab's time (s)."""
        with self._lab.lock:
            return self._lab.time

    def sleep_until(self, time: float) -> None:
        """Move the lab on to ``time`` (s)."""
        self._lab.advance_to(time)


class Pacer:
    """Keeps a lab's time in step with the wall clock, in a thread, while used as a context.

    A lab that cannot keep up (rendering on a slow machine) falls behind and catches up later.
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
        """Stop pacing; raise what stopped the pacer before, if something did."""
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
                    # A late lab moves in small pieces, so that others get at its lock.
                    lab._advance(min(time.perf_counter() - zero, lab.time + 10 * self._tick))
                    lab._moved.notify_all()
        except BaseException as error:
            self._error = error
        finally:
            with lab.lock:
                lab._paced = False
                lab._moved.notify_all()
