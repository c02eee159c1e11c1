"""Sources of motor commands: the paper's random ones, a given list, or a closed loop.

Any object with ``command(index)`` and ``describe()`` is a source for the recorder. A source that
gets the robot's observations before each command is a :class:`SeeingSource`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Protocol, runtime_checkable

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base.commands import TWO_WHEELS, Commands
from neurosim.base.declared import Checked, Fraction, Percent, Seed
from neurosim.base.errors import UserError

#: Range of a random command's duration, s.
CommandTime = Annotated[float, Meta(ge=0.001, le=60)]


@dataclass(frozen=True)
class Command:
    """The numbers of a command, in the robot's units, held for a duration in seconds."""

    numbers: tuple[float, ...]
    duration: float

    @property
    def row(self) -> tuple[float, ...]:
        """The numbers, followed by the duration."""
        return (*self.numbers, self.duration)

    @classmethod
    def of(cls, row: Sequence[float]) -> Command:
        """Return the command of such a row."""
        *numbers, duration = map(float, row)
        return cls(tuple(numbers), duration)


class CommandSource(Protocol):
    """A source of commands, which gives command number ``index``, from 0.

    The same index gives the same command, so that an interrupted recording continues unchanged.
    """

    def command(self, index: int) -> Command:
        """Return the command with this number."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the settings that a resumed recording must share."""
        ...


@dataclass(frozen=True)
class Observation:
    """The observations of a robot before a command.

    Attributes:
        time: since the first command was due, s.
        pose: pose of the robot, [3] (m, m, rad, board frame), or None if it is unknown.
        readings: of its sensors by name, 0..1.
        sight: last pose seen by a camera, [3], and its age when the command is due, s; None without
            a camera.
    """

    time: float
    pose: NDArray[np.float64] | None
    readings: Mapping[str, float]
    sight: tuple[NDArray[np.float64], float] | None = None


@runtime_checkable
class SeeingSource(Protocol):
    """Gives a command for each observation: a closed-loop controller.

    Attributes:
        steps: number of its commands; each is computed at the end of the previous one.
        rest: time for which the robot is observed after the stop, s.
        start: first pose [3] of the robot (m, m, rad).
        sensors: names of the sensors that it needs.
        reads: whether the sensors are read, even if they are not needed.
        needs_pose: whether it needs the pose.
    """

    steps: int
    rest: float
    start: tuple[float, float, float]
    sensors: tuple[str, ...]
    reads: bool
    needs_pose: bool

    def begin(self) -> None:
        """Begin a trial, and forget earlier observations."""
        ...

    def react(self, seen: Observation) -> Command | None:
        """Return the next command, which lasts for its duration; None after the last one."""
        ...

    def describe(self) -> dict[str, Any]:
        """Describe the source for a recording."""
        ...


@dataclass(frozen=True)
class RandomCommands(Checked):
    """The paper's random commands (section 5.1).

    Attributes:
        max_speed: Largest speed, percent of full speed.
        durations: Shortest and longest command, s.
        straight: Fraction of commands that do not turn.
        stopped: Fraction of commands with all speeds zero. The rest is random.
        seed: Random seed.
        takes: the numbers of the robot's command.
    """

    max_speed: Percent = 50.0
    durations: tuple[CommandTime, CommandTime] = (0.5, 3.0)
    straight: Fraction = 0.3
    stopped: Fraction = 0.2
    seed: Seed = 0
    takes: Commands = TWO_WHEELS

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.durations
        if low > high:
            raise UserError(f"the shortest duration, {low:g} s, is above the longest, {high:g} s")
        if self.straight + self.stopped > 1:
            raise UserError(
                "the fractions of straight and of stopped commands sum to at most 1, "
                f"not {self.straight:g} + {self.stopped:g}"
            )

    def command(self, index: int) -> Command:
        """Return command ``index``; percents are whole numbers, which the NXT needs."""
        rng = np.random.default_rng([self.seed, index])
        kind, numbers = rng.random(), self.takes.numbers
        fractions = rng.uniform(0, self.max_speed, len(numbers)) / 100
        fractions = np.where(
            [one.speed for one in numbers], fractions, fractions * 100 / self.max_speed
        )
        forward = rng.choice([-1, 1], len(numbers)) > 0
        command = [
            float(fraction * (one.high if ahead else one.low))
            for fraction, ahead, one in zip(fractions, forward, numbers, strict=True)
        ]
        duration = round(float(rng.uniform(*self.durations)), 3)
        given: Sequence[float] = command
        if kind < self.straight:
            given = self.takes.straight(command)
        elif kind < self.straight + self.stopped:
            given = self.takes.rest(command)
        return Command(self.takes.within(given), duration)

    def describe(self) -> dict[str, Any]:
        """Return the fractions, limits and seed."""
        about = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "takes"}
        return {"kind": "random", **about, "durations": list(self.durations)}


@dataclass(frozen=True)
class FixedCommands:
    """A given list of commands, such as a controller's plan.

    Attributes:
        commands: in the order in which they are sent.
        how: their origin for recording.json; ``kind`` is one of its keys.
    """

    commands: Sequence[Command]
    how: Mapping[str, Any] = field(default_factory=lambda: {"kind": "fixed"})

    def command(self, index: int) -> Command:
        """Return command ``index``."""
        return self.commands[index]

    def describe(self) -> dict[str, Any]:
        """Return the commands' origin, and the commands themselves."""
        return {**self.how, "commands": [list(c.row) for c in self.commands]}
