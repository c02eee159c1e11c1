"""How late a robot answers its sensors, and what its wheels do in the meantime."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from neurosim.base.declared import Checked
from neurosim.base.formats import Delay

#: No robot of this kind is slower, s.
SLOWEST = 1.0


@dataclass(frozen=True)
class Reaction(Checked):
    """A robot's reaction time: a delay, then wheels that approach their new speeds.

    A wheel's speed v follows dv/dt = (u(t - delay) - v) / lag, with u what was commanded.

    Attributes:
        hold: from the moment that sensors are asked for to the one in which the command that
            follows from them is sent, s; drives on the robot keep to it.
        answer: from then until the wheels begin to answer it, and how old readings are when they
            are asked for, s.
        lag: of the left and of the right wheel, s.

    Raises:
        UserError: if one of them is not a time of 0 to 1 s.
    """

    hold: Delay = 0.0
    answer: Delay = 0.0
    lag: tuple[Delay, Delay] = (0.0, 0.0)

    @property
    def delay(self) -> float:
        """From a reading to when the wheels begin to answer it, s."""
        return self.hold + self.answer

    def to_json(self) -> dict[str, Any]:
        """Return the content for :meth:`from_json`."""
        return {"hold": self.hold, "answer": self.answer, "lag": list(self.lag)}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Reaction:
        """Return the delays from the content of :meth:`to_json`.

        Raises:
            UserError: if something is no time of 0 to 1 s.
        """
        return cls(**{**content, "lag": tuple(content.get("lag", (0.0, 0.0)))})
