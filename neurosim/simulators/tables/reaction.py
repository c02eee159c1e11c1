"""The delay from a robot's sensors to its motion, and the lag of its wheels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from neurosim.base.declared import Checked
from neurosim.base.formats import Delay

#: Largest delay, s.
SLOWEST = 1.0


@dataclass(frozen=True)
class Reaction(Checked):
    """A robot's reaction time: a delay, then wheels that approach their new speeds.

    A wheel's speed v follows dv/dt = (u(t - delay) - v) / lag, with the commanded speed u.

    Attributes:
        hold: time from the request for the readings to sending their command, s; drives on the
            robot keep it.
        answer: time from then until the wheels begin to answer, plus the age of the readings, s.
        lag: time constants of the left and the right wheel, s.

    Raises:
        UserError: if one of them is not between 0 and 1 s.
    """

    hold: Delay = 0.0
    answer: Delay = 0.0
    lag: tuple[Delay, Delay] = (0.0, 0.0)

    @property
    def delay(self) -> float:
        """Time from a reading until the wheels begin to answer it, s."""
        return self.hold + self.answer

    def to_json(self) -> dict[str, Any]:
        """Return the content for :meth:`from_json`."""
        return {"hold": self.hold, "answer": self.answer, "lag": list(self.lag)}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Reaction:
        """Return the delays from the content of :meth:`to_json`.

        Raises:
            UserError: if a value is not between 0 and 1 s.
        """
        return cls(**{**content, "lag": tuple(content.get("lag", (0.0, 0.0)))})
