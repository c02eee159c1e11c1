"""Tracks frames as a camera delivers them, without making the camera wait."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from numpy.typing import NDArray

from tracking.markers.pair import Geometry, Sighting
from tracking.markers.palette import SeenColour
from tracking.markers.sought import Sought, tracker_of
from tracking.markers.tag_tracker import TagTracker

#: Frames that may wait to be tracked; beyond it the oldest is skipped, so that the robot's pose is
#: never older than these.
WAITING = 2


@dataclass(frozen=True, eq=False)
class Seen:
    """One frame and the robot in it.

    Attributes:
        index: of the frame within its video.
        time: camera time in seconds.
        arrived: when the frame was delivered, in seconds on the clock handed to the tracker.
        frame: the picture, BGR [H, W, 3] uint8; nobody may write to it.
        sighting: what the tracker found.
        colours: of front and rear as this camera sees them, once they were found.
        others: numbers of tags that were seen next to the robot's.
    """

    index: int
    time: float
    arrived: float
    frame: NDArray
    sighting: Sighting
    colours: tuple[SeenColour, SeenColour] | None = None
    others: frozenset[int] = frozenset()


class LiveTracker:
    """A tracker (:func:`tracking.markers.sought.tracker_of`) at a camera.

    Frames of a camera that waits (one that is rendered) are tracked as they come, in the caller's
    thread: the same frames give the same sightings at the same moments. Others are tracked in a
    thread of their own; frames that come too fast are skipped, and counted.
    If a camera's time goes back, its video has begun again, and tracking begins again too.

    Args:
        what: it looks for.
        geometry: the known geometry of the pair.
        now: the clock for arrival times, in seconds.
        on_seen: called with every frame that was tracked, in the order of the frames.
        waits: whether the camera waits until its frames are taken.
    """

    def __init__(
        self,
        what: Sought,
        geometry: Geometry | None,
        now: Callable[[], float],
        on_seen: Callable[[Seen], None],
        *,
        waits: bool = False,
    ):
        self._what, self._geometry = what, geometry
        self._now = now
        self._on_seen = on_seen
        self._waits = waits
        self._tracker = tracker_of(what, geometry)
        self._taken = 0
        self._last = -math.inf
        self.passed_over = 0
        self._error: BaseException | None = None
        self._ended = False
        self._change = threading.Condition()
        self._queue: deque[tuple[int, float, float, NDArray]] = deque()
        self._thread: threading.Thread | None = None
        if not waits:
            self._thread = threading.Thread(target=self._run, name="live tracker", daemon=True)
            self._thread.start()

    @property
    def failed(self) -> bool:
        """Whether tracking failed; :meth:`close` raises the error."""
        return self._error is not None

    def look_for(self, what: Sought | None = None, geometry: Geometry | None = None) -> None:
        """Begin again with other colours or another tag, another geometry, or both."""
        with self._change:
            self._what = what or self._what
            self._geometry = geometry or self._geometry
            self._tracker = tracker_of(self._what, self._geometry)

    def take(self, time: float, frame: NDArray) -> None:
        """Take the camera's next frame; returns at once unless the camera waits."""
        item = (self._taken, time, self._now(), frame)
        self._taken += 1
        if self._waits:
            self._look(*item)
            return
        with self._change:
            self._queue.append(item)
            if len(self._queue) > WAITING:
                self._queue.popleft()
                self.passed_over += 1
            self._change.notify()

    def close(self) -> None:
        """Track the waiting frames and end; raise the error of tracking, if there was one."""
        with self._change:
            self._ended = True
            self._change.notify()
        if self._thread is not None:
            self._thread.join()
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        while True:
            with self._change:
                while not self._queue and not self._ended:
                    self._change.wait()
                if not self._queue:
                    return
                item = self._queue.popleft()
            try:
                self._look(*item)
            except Exception as error:
                self._error = error
                return

    def _look(self, index: int, time: float, arrived: float, frame: NDArray) -> None:
        if time <= self._last:
            self.look_for()
        self._last = time
        tracker = self._tracker
        sighting = tracker.update(frame, time)
        others = frozenset(tracker.others) if isinstance(tracker, TagTracker) else frozenset()
        self._on_seen(Seen(index, time, arrived, frame, sighting, tracker.seen_colours, others))
