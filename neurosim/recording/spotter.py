"""Live tracking during a recording, and its log."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.files import LineLog
from tracking.camera.camera_model import CameraModel
from tracking.clock.sync import fit_clock
from tracking.live import LiveTracker, Seen
from tracking.markers.palette import SeenColour, warning
from tracking.markers.sought import sought
from tracking.poses import marker_geometry, marker_poses, too_small

#: Time without sight after which the user gets a message, s.
WARN_AFTER = 0.5
#: Longest time that a picture, and a radio, take, if no flash tells, s.
LATENCY = 0.1
#: Number of last frames in which a flash is looked for, and longest time after which one may be
#: seen, s.
FLASHED, LATEST = 600, 1.0


class Spotter:
    """Tracks a camera's frames, logs the results, and warns when the robot is lost.

    Args:
        markers: as in recording.json.
        model: the camera's calibration, with its place over the board.
        now: the robot's clock, s.
        log: gets the result of every frame.
        session: its number.
        say: takes messages for the user.
        waits: whether the camera waits until its frames are taken.
        on_seen: called with every frame, too.
    """

    def __init__(
        self,
        markers: Mapping[str, Any],
        model: CameraModel,
        now: Callable[[], float],
        log: LineLog,
        session: int,
        say: Callable[[str], None],
        *,
        waits: bool,
        on_seen: Callable[[Seen], None] | None = None,
    ):
        self._markers, self._model = markers, model
        self._log, self._session = log, session
        self._say = say
        self._on_seen = on_seen
        self._by = f" ({sought(markers)})" if markers.get("tag") else ""
        self._lock = threading.Lock()
        self._last: tuple[float, NDArray] | None = None
        self._delay: float | None = None
        self._frames = deque[tuple[float, float, float]](maxlen=FLASHED)
        self._since = now()
        self._warned = False
        self._judged = False
        self._others: frozenset[int] = frozenset()
        if problem := too_small(markers, model):
            say(problem)
        self._tracker = LiveTracker(
            sought(markers), marker_geometry(markers, model), now, self._look, waits=waits
        )
        self.take = self._tracker.take

    @property
    def last(self) -> tuple[float, NDArray] | None:
        """Time (s, robot clock) and pose [3] of the last sighting; None if there was none.

        Until :meth:`time_by_flash`, it is the time when the picture arrived.
        """
        with self._lock:
            return self._last

    @property
    def uncertainty(self) -> float:
        """Time, s, by which a sighting may be older than it says."""
        return LATENCY if self._delay is None else 0.0

    def time_by_flash(self, lamp: Sequence[tuple[float, float]]) -> None:
        """Find out how long after a command its effect is seen, from the lamp.

        The camera, and a radio, take a tenth of a second or more. Sightings then have the times
        that their tracked video will have, from which simulators are learned: those of the commands
        whose effect they show.

        Args:
            lamp: (on, off) times of a flash, s, robot clock.
        """
        with self._lock:
            frames = np.array(self._frames, float).reshape(-1, 3)
        times, arrived, brightness = frames.T
        try:
            clock = fit_clock(times, brightness, lamp)
        except UserError:
            return  # tracking will tell why
        delay = float(np.median(arrived - clock.to_robot(times)))
        if 0.0 < delay < LATEST:  # a robot that is seen later is stopped, because it seems to stand
            self._delay = delay

    def unseen(self, now: float) -> float:
        """Return the seconds since the robot was last seen."""
        with self._lock:
            return now - (self._since if self._last is None else self._last[0])

    @property
    def passed_over(self) -> int:
        """Number of frames that the tracker was too slow for."""
        return self._tracker.passed_over

    def close(self) -> None:
        """Track the waiting frames; raise the errors of tracking."""
        self._tracker.close()

    def _look(self, seen: Seen) -> None:
        sighting = seen.sighting
        self._log.append(
            self._session, seen.index, *sighting.front, *sighting.rear, sighting.quality,
            sighting.lamp,
        )  # fmt: skip
        with self._lock:
            self._frames.append((seen.time, seen.arrived, sighting.lamp))
        if seen.others - self._others:
            self._others |= seen.others
            named = ", ".join(map(str, sorted(self._others)))
            self._say(f"other tags are in view, and ignored: {named}")
        if sighting.in_view:
            pose = marker_poses(
                sighting.front[None], sighting.rear[None], self._markers, self._model
            )[0]
            away = self.unseen(seen.arrived)
            with self._lock:
                self._last = (seen.arrived - (self._delay or 0.0), pose)
            if seen.colours is not None and not self._judged:
                self._judge(seen.colours)
            if self._warned:
                self._say(f"the robot is seen again, after {away:.1f} s")
                self._warned = False
        elif not self._warned and self.unseen(seen.arrived) > WARN_AFTER:
            self._warned = True
            self._say(f"the robot{self._by} is lost from sight: is it covered, or off the board?")
        if self._on_seen is not None:
            self._on_seen(seen)

    def _judge(self, colours: tuple[SeenColour, SeenColour]) -> None:
        """Warn at the first sight, before the robot drives, of uncertain colours."""
        self._judged = True
        front, rear = colours
        problem = warning({"front": front.as_dict(), "rear": rear.as_dict()})
        if problem:
            self._say(problem)
