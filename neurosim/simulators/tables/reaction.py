"""How late a robot answers its sensors, and what its wheels do in the meantime."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from neurosim.base.errors import UserError
from neurosim.base.schema import Number, Rows, Shape

#: No robot of this kind is slower, s.
SLOWEST = 1.0


@dataclass(frozen=True)
class Reaction:
    """A robot's reaction time: a delay, then wheels that approach their new speeds.

    A wheel's speed v follows dv/dt = (u(t - delay) - v) / lag, with u what was commanded.

    Attributes:
        hold: from the moment that sensors are asked for to the one in which the command that
            follows from them is sent, s; whoever drives the robot keeps to it.
        answer: from then until the wheels begin to answer it, and how old readings are when they
            are asked for, s.
        lag: of the left and of the right wheel, s.

    Raises:
        UserError: if one of them is not a time of 0 to 1 s.
    """

    #: What :meth:`to_json` returns, as it is checked where a file is read.
    FIELDS: ClassVar[dict[str, Shape]] = {
        "hold": Number(0.0, SLOWEST), "answer": Number(0.0, SLOWEST), "lag": Rows(2, most=SLOWEST)
    }  # fmt: skip

    hold: float = 0.0
    answer: float = 0.0
    lag: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name, value in (("hold", self.hold), ("answer", self.answer), *_wheels(self.lag)):
            wrong = isinstance(value, bool) or not isinstance(value, int | float)
            if wrong or not math.isfinite(value) or not 0 <= value <= SLOWEST:
                raise UserError(f"a robot's {name} is 0 to {SLOWEST:g} s, not {value!r:.60}")

    @property
    def delay(self) -> float:
        """From a reading to when the wheels begin to answer it, s."""
        return self.hold + self.answer

    def to_json(self) -> dict[str, Any]:
        """Return what :meth:`from_json` takes."""
        return {"hold": self.hold, "answer": self.answer, "lag": list(self.lag)}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Reaction:
        """Return what :meth:`to_json` gave, of the shape of :attr:`FIELDS`.

        Raises:
            UserError: if something is no time of 0 to 1 s.
        """
        left, right = content["lag"]
        return cls(content["hold"], content["answer"], (left, right))


def _wheels(lag: tuple[float, float]) -> list[tuple[str, float]]:
    return [("left wheel's lag", lag[0]), ("right wheel's lag", lag[1])]
