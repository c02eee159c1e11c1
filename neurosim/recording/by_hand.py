"""Driving by hand: a person's wishes, by keys or sticks.

A person has levers, from -1 to 1: forward and turn of a robot on two wheels, else one for each
number of a command. The page that shows them sends their positions ten times a second or more;
without them, the robot is stopped (:mod:`.hand_session`).
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from neurosim.base.commands import Commands
from neurosim.base.errors import UserError
from tracking.datasets.recordings import BY_HAND

#: Time without lever positions after which the robot is stopped, s.
SILENT = 0.35

#: Keys that push and pull each lever, as browsers name them (``KeyboardEvent.code``).
KEYS = tuple((f"Key{a}", f"Key{b}") for a, b in ("WS", "AD", "QE", "RF", "TG", "YH", "UJ", "IK"))
ARROWS = (("ArrowUp", "ArrowDown"), ("ArrowLeft", "ArrowRight"))
#: Axes of a game pad for each lever: up and left push.
AXES = (1, 0, 2, 3)

#: State of the page before the first command.
READY = "ready"


@dataclass(frozen=True)
class Lever:
    """A lever that a person moves, from -1 to 1.

    Attributes:
        name: of it.
        push: keys that move it to 1.
        pull: keys that move it to -1.
        axis: of a game pad; None if no axis is left.
    """

    name: str
    push: tuple[str, ...]
    pull: tuple[str, ...]
    axis: int | None


def levers_of(takes: Commands) -> list[Lever]:
    """Return the levers of a robot that takes these commands."""
    names = ("forward", "turn left") if _has_sides(takes) else takes.names
    levers = []
    for place, name in enumerate(names):
        both = [keys[place] for keys in (KEYS, ARROWS) if place < len(keys)]
        axis = AXES[place] if place < len(AXES) else None
        levers.append(Lever(name, tuple(a for a, _ in both), tuple(b for _, b in both), axis))
    return levers


def command_of(takes: Commands, levers: Sequence[float], max_speed: float) -> tuple[float, ...]:
    """Return the command for some levers, within the robot's limits.

    Args:
        takes: the numbers of the robot's command.
        levers: of each lever, -1 to 1.
        max_speed: speed of a lever at its end, percent of the robot's limit; angles use their full
            range.
    """
    values = list(levers)
    if _has_sides(takes):
        forward, turn = levers
        values = [forward - turn, forward + turn]
    given = []
    for value, one in zip(values, takes.numbers, strict=True):
        fraction = min(max(value, -1.0), 1.0) * (max_speed / 100 if one.speed else 1.0)
        given.append(fraction * one.high if fraction > 0 else -fraction * one.low)
    return tuple(number + 0.0 for number in takes.within(given))


def _has_sides(takes: Commands) -> bool:
    """Return whether a command has a left and a right wheel."""
    return takes.body == "wheels" or takes.names == ("left", "right")


class Hand:
    """The link between the page with the levers and the session that sends commands; for threads.

    Args:
        max_speed: speed of a lever at its end, percent of the robot's limit.
        now: this computer's clock, s.
    """

    def __init__(self, max_speed: float = 50.0, now: Callable[[], float] = time.monotonic):
        self._max_speed, self._now = max_speed, now
        self._lock = threading.Lock()
        self._takes: Commands | None = None
        self._page, self._heard = "", -math.inf
        self._levers: tuple[float, ...] | None = None
        self._speed = 1.0
        self._given: tuple[float, ...] = ()
        self._standing, self._count = "", 0
        self._begun: float | None = None
        self._ended: float | None = None

    def describe(self) -> dict[str, Any]:
        """Describe the source of the commands for a recording."""
        return {"kind": BY_HAND, "max_speed": self._max_speed}

    # The page

    def take(self, page: str, levers: Sequence[float] | None, speed: float = 1.0) -> None:
        """Take the levers' positions.

        Args:
            page: a name of the page's own.
            levers: each -1 to 1; None: the page is closed.
            speed: fraction of the greatest speed for a lever at its end, 0 to 1.

        Raises:
            UserError: if another page drives, or the number of levers is wrong.
        """
        with self._lock:
            if page != self._page and self._is_heard():
                raise UserError("another page drives this robot: close it first")
            if levers is None or self._takes is None:
                self._levers, self._heard = None, -math.inf
                return
            if len(levers) != len(levers_of(self._takes)):
                raise UserError("this page has the controls of another robot: reload it")
            self._page, self._heard = page, self._now()
            self._levers, self._speed = tuple(map(float, levers)), min(max(speed, 0.0), 1.0)

    def end(self) -> None:
        """End the drive."""
        with self._lock:
            if self._ended is None:
                self._ended = self._now()

    def state(self) -> dict[str, Any]:
        """Return the state for the page."""
        with self._lock:
            now = self._now() if self._ended is None else self._ended
            takes = self._takes
            numbers = () if takes is None else takes.numbers
            return {
                "phase": "over" if self._ended else ("starting" if takes is None else "driving"),
                "levers": [] if takes is None else [vars(lever) for lever in levers_of(takes)],
                "given": [
                    {"name": one.name, "unit": one.unit, "value": value,
                     "low": one.low, "high": one.high}
                    for one, value in zip(numbers, self._given, strict=True)
                ],
                "standing": self._standing,
                "seconds": 0.0 if self._begun is None else round(now - self._begun, 1),
                "commands": self._count,
            }  # fmt: skip

    # The session

    def begin(self, takes: Commands) -> None:
        """Let the person drive from now on."""
        with self._lock:
            self._takes, self._given = takes, takes.rest()
            self._begun, self._standing = self._now(), READY

    @property
    def over(self) -> bool:
        """Whether the drive should end."""
        with self._lock:
            return self._ended is not None

    def wish(self) -> tuple[float, ...] | None:
        """Return the person's present command; None: nobody drives."""
        with self._lock:
            if self._takes is None or self._levers is None or not self._is_heard():
                return None
            return command_of(self._takes, self._levers, self._speed * self._max_speed)

    def sent(self, numbers: tuple[float, ...]) -> None:
        """Show a command that was sent."""
        with self._lock:
            self._given, self._standing = numbers, ""
            self._count += 1

    def stands(self, why: str) -> None:
        """Show that the robot was stopped, and why."""
        with self._lock:
            assert self._takes is not None
            self._given, self._standing = self._takes.rest(self._given), why

    def _is_heard(self) -> bool:
        return self._now() - self._heard <= SILENT
