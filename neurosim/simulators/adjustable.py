"""Parameters of a simulator that can be adjusted to agree with reality."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.simulators.base import Simulator


@dataclass(frozen=True)
class Adjustable:
    """A named parameter with bounds.

    Attributes:
        name: its name.
        value: value before any adjustment, in ``unit``.
        low, high: bounds.
        unit: SI unit, or empty.
        log: whether its scale is logarithmic.
    """

    name: str
    value: float
    low: float
    high: float
    unit: str = ""
    log: bool = False

    def __post_init__(self) -> None:
        finite = math.isfinite(self.low) and math.isfinite(self.high)
        if not finite or self.low >= self.high or (self.log and self.low <= 0.0):
            raise UserError(
                f"the parameter {self.name}: {self.low:g} to {self.high:g} is not a range"
            )
        self.checked(self.value)

    def at(self, fraction: float) -> float:
        """Return the value at a fraction of the range, cut to 0..1."""
        fraction = min(max(fraction, 0.0), 1.0)
        if self.log:
            value = self.low * (self.high / self.low) ** fraction
        else:
            value = self.low + (self.high - self.low) * fraction
        return min(max(value, self.low), self.high)

    def fraction(self, value: float) -> float:
        """Return a value as a fraction of the range.

        Raises:
            UserError: if it is out of bounds.
        """
        self.checked(value)
        if self.log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def checked(self, value: float) -> float:
        """Return a value.

        Raises:
            UserError: if it is out of bounds.
        """
        if not self.low <= value <= self.high:
            unit = f" {self.unit}" if self.unit else ""
            raise UserError(
                f"the parameter {self.name} is {value:g}, outside of {self.low:g} to "
                f"{self.high:g}{unit}"
            )
        return value


def adjustables(
    values: Any, ranges: Mapping[str, tuple[float, float, str, bool]]
) -> tuple[Adjustable, ...]:
    """Return attributes of an object as parameters.

    Args:
        values: an object with an attribute of each name.
        ranges: bounds, unit, and whether the scale is logarithmic, by name.

    Raises:
        UserError: if a value is out of bounds.
    """
    return tuple(Adjustable(name, float(getattr(values, name)), *ranges[name]) for name in ranges)


@runtime_checkable
class AdjustableSimulator(Protocol):
    """A :class:`Simulator` with adjustable parameters."""

    @property
    def parameters(self) -> Sequence[Adjustable]:
        """Return its parameters with their present values."""
        ...

    def adjusted(self, values: NDArray[np.float64]) -> Simulator:
        """Return the simulator with other values [K], in the parameters' units.

        Raises:
            UserError: if one is out of bounds.
        """
        ...
