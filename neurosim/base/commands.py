"""The numbers of a robot's command: names, units, limits, and the motion that they describe.

A robot's driver describes its commands. All code above the driver uses this: recordings name their
columns by it; guards and clocks compute the ideal motion of a command.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neurosim.base import se2
from neurosim.base.errors import UserError

#: Kinds of bodies, and the measures (m and m/s) that each needs.
BODIES: dict[str, tuple[str, ...]] = {
    "wheels": ("full", "track"),  # left, right: two wheels; speed of a wheel at its limit
    "car": ("wheelbase",),  # a speed of the axle (m/s), and a steering angle (rad)
    "twist": (),  # v or vx, vy (m/s), w or omega (rad/s): any of them
}
#: Names of a twist's parts: forward, to the left, turn to the left.
_TWIST = {"v": 0, "vx": 0, "vy": 1, "w": 2, "omega": 2}
#: Names of a recording's other columns.
RESERVED = ("session", "command", "kind", "time", "duration", "numbers", "is_motor", "forward",
            "turn", "index", "count")  # fmt: skip


@dataclass(frozen=True)
class Number:
    """One number of a command, between two limits.

    Attributes:
        name: such as left, v, steer.
        unit: %, m/s, rad/s or rad.
        low: least value.
        high: greatest value.
        speed: whether 0 means rest; a held angle, such as a car's steering, is not a speed.
    """

    name: str
    unit: str
    low: float
    high: float
    speed: bool = True


@dataclass(frozen=True)
class Commands:
    """The numbers of a robot's command.

    Attributes:
        numbers: of a command, in order.
        body: a key of :data:`BODIES`, or empty if the robot's motion is unknown.
        measures: of the body, also the ``radius`` of the circle around it.
    """

    numbers: tuple[Number, ...]
    body: str = ""
    measures: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = self.names
        if not names or len(set(names)) < len(names):
            raise ValueError(f"a command has numbers of different names, not {names}")
        wrong = [name for name in names if not name.isidentifier() or name in RESERVED]
        if wrong:
            raise ValueError(f"{wrong[0]!r} cannot be the name of a number of a command")
        suits = {
            "wheels": len(names) == 2,
            "car": [one.unit for one in self.numbers] == ["m/s", "rad"],
            "twist": set(names) <= set(_TWIST),
        }
        if not suits.get(self.body, True):
            raise ValueError(f"the body {self.body} does not have these numbers: {names}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers."""
        return tuple(one.name for one in self.numbers)

    @property
    def units(self) -> dict[str, str]:
        """Units of the numbers by name."""
        return {one.name: one.unit for one in self.numbers}

    @property
    def moves_as_known(self) -> bool:
        """Whether :meth:`twist` can compute the robot's motion."""
        needed = BODIES.get(self.body)
        return needed is not None and all(self.measures.get(name, 0) > 0 for name in needed)

    @property
    def turns_on_the_spot(self) -> bool:
        """Whether the robot can turn without driving."""
        return self.body == "wheels" or (self.body == "twist" and self._place(2) is not None)

    @property
    def arm(self) -> float:
        """Length that converts a turn into a distance, m: half the track, or the body's radius."""
        if self.body == "wheels":
            return self.measures["track"] / 2
        return self.measures.get("radius", self.measures.get("wheelbase", 0.2) / 2)

    @property
    def fastest(self) -> float:
        """The greatest forward speed, m/s."""
        return float(self.twist([one.high if one.speed else 0.0 for one in self.numbers])[0])

    def measured(self, **measures: float) -> Commands:
        """Return a copy with measures that the robot itself does not give."""
        return replace(self, measures={**measures, **self.measures})

    def rest(self, last: Sequence[float] | None = None) -> tuple[float, ...]:
        """Return the command for rest; angles stay as in the last command."""
        held = [0.0] * len(self.numbers) if last is None else last
        return tuple(
            0 if one.speed else float(value) for one, value in zip(self.numbers, held, strict=True)
        )

    def stands(self, command: Sequence[float]) -> bool:
        """Return whether a robot stands at this command."""
        return not any(value for one, value in zip(self.numbers, command, strict=True) if one.speed)

    def check(self, command: Sequence[float]) -> tuple[float, ...]:
        """Return a command's numbers.

        Raises:
            UserError: if one is beyond its limits, or the number of numbers is wrong.
        """
        if len(command) != len(self.numbers):
            raise UserError(
                f"a command of this robot has {len(self.numbers)} numbers "
                f"({', '.join(self.names)}), not {len(command)}"
            )
        for one, value in zip(self.numbers, command, strict=True):
            if not one.low <= value <= one.high:
                raise UserError(
                    f"{one.name}: {value:g} is beyond its limits; use {one.low:g} to {one.high:g} "
                    f"{one.unit}"
                )
        return tuple(float(value) for value in command)

    def within(self, command: Sequence[float]) -> tuple[float, ...]:
        """Return a command limited to its ranges, and rounded as it is sent.

        Percents are whole ones, other numbers have four decimals.
        """
        pairs = zip(self.numbers, command, strict=True)
        cut = [(one, min(max(float(value), one.low), one.high)) for one, value in pairs]
        return tuple(round(value) if one.unit == "%" else round(value, 4) for one, value in cut)

    def twist(self, command: ArrayLike) -> NDArray[np.float64]:
        """Return the twist of a robot that follows its command ideally.

        Args:
            command: [..., C].

        Returns:
            [..., 3] forward and left (m/s), turn (rad/s).
        """
        given = np.asarray(command, np.float64)
        if self.body == "wheels":
            speed = [self.measures["full"] / one.high for one in self.numbers]
            return se2.of_wheels(
                speed[0] * given[..., 0], speed[1] * given[..., 1], self.measures["track"]
            )
        twist = np.zeros((*given.shape[:-1], 3))
        if self.body == "car":
            twist[..., 0] = given[..., 0]
            twist[..., 2] = given[..., 0] * np.tan(given[..., 1]) / self.measures["wheelbase"]
        elif self.body == "twist":
            for place, name in enumerate(self.names):
                twist[..., _TWIST[name]] = given[..., place]
        else:
            raise UserError(
                "this robot does not give its body, so its motion cannot be computed: name a "
                "body in its commands"
            )
        return twist

    def percent(self, command: ArrayLike) -> NDArray[np.float64]:
        """Return the forward and the turning speed [..., 2], in percent of the greatest.

        Of two wheels these are the mean and half the difference of their speeds.
        """
        given = np.asarray(command, np.float64)
        if self.body == "wheels":
            percent = given * [100.0 / one.high for one in self.numbers]
            return np.stack(
                [percent.mean(axis=-1), (percent[..., 1] - percent[..., 0]) / 2], axis=-1
            )
        limits = np.array([[one.low, one.high] for one in self.numbers]).T
        most = np.abs(self.twist(np.stack([limits[1], limits[0], limits.max(axis=0)]))).max(axis=0)
        twist = self.twist(given)
        return 100.0 * twist[..., [0, 2]] / np.maximum(most[[0, 2]], 1e-9)

    def toward(self, forward: float, turn: float) -> tuple[float, ...]:
        """Return the command with the most similar motion, within the limits.

        Args:
            forward: m/s.
            turn: rad/s; a car that stands does not turn.
        """
        if self.body == "wheels":
            aside = turn * self.measures["track"] / 2
            speeds = (forward - aside, forward + aside)
            wanted = [v / self.measures["full"] * one.high
                      for v, one in zip(speeds, self.numbers, strict=True)]  # fmt: skip
        elif self.body == "car":
            steer = math.atan2(turn * self.measures["wheelbase"], abs(forward))
            wanted = [forward, math.copysign(1.0, forward) * steer if forward else 0.0]
        else:
            parts = (forward, 0.0, turn)
            wanted = [parts[_TWIST[name]] for name in self.names]
        return self.within(wanted)

    def straight(self, command: Sequence[float]) -> tuple[float, ...]:
        """Return this command without a turn: for two wheels, both like the left one."""
        if self.body == "wheels" or self.names == ("left", "right"):
            return (command[0], command[0])
        turns = {"car": 1, "twist": self._place(2)}.get(self.body)
        return tuple(0.0 if place == turns else float(v) for place, v in enumerate(command))

    def describe(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            "numbers": [asdict(one) for one in self.numbers],
            "body": self.body,
            "measures": dict(self.measures),
        }

    @classmethod
    def of(cls, content: Mapping[str, Any] | None) -> Commands:
        """Return the commands that :meth:`describe` described; by default those of two wheels.

        Raises:
            ValueError, TypeError, KeyError: if it is not a description of commands.
        """
        if content is None:
            return TWO_WHEELS.measured(full=0.5, track=0.13)
        numbers = tuple(Number(**one) for one in content["numbers"])
        return cls(numbers, content["body"], dict(content["measures"]))

    def _place(self, part: int) -> int | None:
        """Return the index of the number that is a part of the twist, or None."""
        places = [place for place, name in enumerate(self.names) if _TWIST.get(name) == part]
        return places[0] if self.body == "twist" and places else None


#: Of a robot on two wheels that are commanded in percent of their full speed.
TWO_WHEELS = Commands(
    (Number("left", "%", -100.0, 100.0), Number("right", "%", -100.0, 100.0)), "wheels"
)
