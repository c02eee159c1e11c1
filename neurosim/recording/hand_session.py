"""One session of a recording in which a person drives.

Commands follow the person's levers, and are written down when they are sent. They have no duration:
each lasts until the next line of the log.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.perimeter import STOPPING
from neurosim.base.progress import Progress
from neurosim.recording.by_hand import READY, Hand
from neurosim.recording.session import BATTERY_EVERY, LOOK_EVERY, SeenToStand, Session
from neurosim.robots.base import Robot, drive_for
from tracking.datasets.recordings import Recording

#: Shortest time between commands, s; a slower robot gets the newest one.
STEP = 0.06
#: Time after which a command is sent again, s; robots that stop by themselves get it for twice as
#: long.
REFRESH = 0.3
#: Time after which a standing robot counts as waiting, s, from which nothing is learned.
IDLE = 3.0

NOBODY = "nobody drives: the page is closed, hidden or not connected"
STANDS = "the robot was commanded to move and is seen to stand: is it held, or the camera frozen?"
OUTSIDE = "this command leads off the board"
NOT_SEEN = "the robot is not seen"


class HandSession(Session):
    """One session in which a person drives; see :class:`~neurosim.recording.session.Session`.

    After a stop by the guard, the person must release the levers. Then the robot can be driven back
    inside, or carried; its motion until the next command is not used.
    """

    def __init__(self, recording: Recording, session: int, robot: Robot, hand: Hand, *others: Any):
        super().__init__(recording, session, robot, hand, *others)
        self._hand = hand
        numbers = recording.commands()["command"].dropna()
        self._number = 0 if numbers.empty else int(numbers.max()) + 1
        #: Whether nobody drives; whether the levers were released since the guard stopped the
        #: robot.
        self._alone, self._released = True, True
        #: Direction of motion when the guard stopped the robot, [2] in its frame; None: it is
        #: inside.
        self._outward: NDArray | None = None
        self._refreshed = 0.0

    def _drive(self) -> bool:
        self._check_battery()
        asked = self._clock.now()
        self._hand.begin(self._takes)
        with Progress("driving by hand", None, "commands") as progress:
            while not self._hand.over:
                now = self._clock.now()
                if now - asked > BATTERY_EVERY:
                    asked = now
                    self._check_battery()
                self._look_around()
                progress.advance(self._follow(self._hand.wish()))
                self._clock.sleep_until(now + LOOK_EVERY)
        return True

    def _look_around(self) -> None:
        """Stop the robot if the guard requires it, or if it does not move."""
        try:
            self._check_camera()
        except SeenToStand:
            self._agreement = self._agreement.afresh()
            self._hold_back(STANDS)
        if self._running is None or self._takes.stands(self._numbers):
            return
        readings = self._lines()
        if self._guard.at_line == "ignore":
            return
        if self._outward is not None and self._on_line(readings) is None:
            self._outward = None
        # On the line its sensors do not tell its direction.
        if self._must_stop(readings if self._outward is None else {}):
            known = self._takes.moves_as_known
            self._outward = self._takes.twist(self._numbers)[:2] if known else np.zeros(2)
            self._hold_back(str(self._stop))
            if self._guard.at_line == "end":
                self.stopped = self._stop
                self._hand.end()

    def _follow(self, wish: tuple[float, ...] | None) -> bool:
        """Follow the levers as far as the guard allows; return whether a command was sent."""
        runs = self._running is not None
        if wish is None:
            if runs:
                self._stand(NOBODY)
            self._alone = True
            return False
        if self._alone and not runs and self._released:
            self._hand.stands(READY)
        self._alone = False
        still = self._takes.stands(wish)
        self._released = self._released or still
        if not self._released or (still and not runs):
            return False
        now = self._clock.now()
        if runs and wish == self._numbers:
            if still and now - self._sent > IDLE:
                self._stand(READY)
            elif now - self._refreshed >= REFRESH:
                self._send(wish, None)
            return False
        if runs and now - self._sent < STEP:
            return False
        if why := self._refusal(wish):
            self._hold_back(why)
            return False
        self._write("command", wish, None, self._number)
        self._number += 1
        self._hand.sent(wish)
        return True

    def _send(self, numbers: tuple[float, ...], duration: float | None) -> None:
        drive_for(self._robot, numbers, 2 * REFRESH)
        self._refreshed = self._clock.now()

    def _refusal(self, wish: tuple[float, ...]) -> str:
        """Return the guard's reason against a command, or an empty text."""
        if self._guard.at_line == "ignore" or self._takes.stands(wish):
            return ""
        if self._is_lost():
            return NOT_SEEN
        if not self._takes.moves_as_known:
            return ""
        twist = self._takes.twist(wish)
        if self._outward is not None and twist[:2] @ self._outward > 0:
            return OUTSIDE
        if (pose := self._pose()) is None:
            return ""
        there = self._perimeter.beyond(se2.compose(pose, se2.exp(twist * STOPPING)))
        return OUTSIDE if there > max(self._perimeter.beyond(pose), 0.0) else ""

    def _hold_back(self, why: str) -> None:
        """Stop the robot until the person has released the levers."""
        self._say(why)
        self._released = False
        self._stand(f"{why}. Let go, then drive back inside or carry the robot")

    def _stand(self, why: str) -> None:
        """Stop the robot, if it has a command."""
        if self._running is not None:
            self._write("stop", self._rest)
        self._hand.stands(why)
