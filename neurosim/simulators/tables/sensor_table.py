"""A sensor table: what every sensor says of each class of objects, by distance and angle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.simulators.tables.samples import Samples, as_evorobotpy2

#: The classes of objects: straight walls, and round obstacles of the size that was sampled.
OBJECTS = ("wall", "cylinder")
#: Repeats of one object are as bright as each other but for noise and the robot's placing: 2 %
#: apart in the virtual lab, where an obstacle of half the size is 35 % darker.
ALIKE = 1.2
#: How the rows and distances of ``.sample`` files are read.
Convention = Literal["neurosim", "evorobotpy2"]


@dataclass(frozen=True, eq=False)
class SensorTable:
    """Readings in 0..1 by object class, distance, angle and sensor.

    Attributes:
        mean: (2, D, A, S) means over repeats; objects as in :data:`OBJECTS`.
        spread: (2, D, A, S) standard deviations of a single reading, or None where nothing was
            sampled twice.
        first_distance: the smallest, from the robot's rim to the surface, m.
        distance_step: between distances, m.
    """

    mean: NDArray[np.float64]
    spread: NDArray[np.float64] | None
    first_distance: float
    distance_step: float

    def __post_init__(self) -> None:
        if self.mean.ndim != 4 or len(self.mean) != len(OBJECTS):
            raise ValueError("expected readings (objects, distances, angles, sensors)")
        if self.spread is not None and self.spread.shape != self.mean.shape:
            raise ValueError("expected a spread for every reading")
        for name, table in (("readings", self.mean), ("spread", self.spread)):
            if table is not None and not np.isfinite(table).all():
                holes = np.argwhere(~np.isfinite(table))
                k, d, a, s = holes[0]
                raise UserError(
                    f"the sensor table has {len(holes)} holes in its {name}, the first at the "
                    f"{OBJECTS[k]}, {1000 * (self.first_distance + d * self.distance_step):g} mm, "
                    f"angle {a} of {self.mean.shape[2]}, sensor {s}; sample these again"
                )

    @property
    def ambient(self) -> NDArray[np.float64]:
        """Each sensor's reading with nothing near, [S].

        The median over all angles and objects at the largest distance: at most angles a sensor
        looks past the object.
        """
        return np.median(self.mean[:, -1], axis=(0, 1))

    @property
    def ambient_spread(self) -> NDArray[np.float64]:
        """Its standard deviation [S], found in the same way; zero without repeats."""
        if self.spread is None:
            return np.zeros(self.mean.shape[-1])
        return np.median(self.spread[:, -1], axis=(0, 1))

    def bearings(self, kind: int = 0) -> NDArray[np.float64]:
        """Return where each sensor looks, [S] rad to the left; NaN where it sees nothing.

        The mean bearing at which it sees an object at the first distance, each weighted with the
        reading above ambient: a near object saturates a sensor over a wide angle.

        Args:
            kind: the class of object, an index into :data:`OBJECTS`.
        """
        turn = 2.0 * np.pi * np.arange(self.mean.shape[2]) / self.mean.shape[2]
        seen = np.maximum(self.mean[kind, 0] - self.ambient, 0.0)
        to = (seen * np.exp(-1j * turn)[:, None]).sum(axis=0)
        return np.where(np.abs(to) > 1e-9, np.angle(to), np.nan)

    @classmethod
    def from_samples(cls, samples: Mapping[str, Sequence[Samples]]) -> SensorTable:
        """Make a table of repeated samples of each object.

        Args:
            samples: object class -> repeats, at least one each.

        Raises:
            UserError: if a class is missing, samples differ in their distances, angles or sensors,
                or those of one class are not of one object.
        """
        missing = [name for name in OBJECTS if not samples.get(name)]
        if missing:
            raise UserError(f"there are no samples of the {missing[0]}; sample it too")
        every = [one for name in OBJECTS for one in samples[name]]
        first = every[0]
        for other in every[1:]:
            if _grid(other) != _grid(first):
                raise UserError(
                    "the samples do not fit each other: one has "
                    f"{_in_words(first)}, another {_in_words(other)}"
                )
        for name in OBJECTS:
            levels = [_brightness(one) for one in samples[name]]
            if max(levels) > ALIKE * min(levels):
                raise UserError(
                    f"the samples of the {name} are not repeats of one object: one reads "
                    f"{100 * (1 - min(levels) / max(levels)):.0f} % less than another. Give those "
                    "of one size and colour; the others make a simulator of their own"
                )
        stacks = [np.stack([one.activations for one in samples[name]]) for name in OBJECTS]
        repeated = min(map(len, stacks)) > 1
        return cls(
            mean=np.stack([stack.mean(axis=0) for stack in stacks]),
            spread=np.stack([stack.std(axis=0, ddof=1) for stack in stacks]) if repeated else None,
            first_distance=first.first_distance,
            distance_step=first.distance_step,
        )

    @classmethod
    def from_files(
        cls, paths: Sequence[str | Path], convention: Convention = "neurosim"
    ) -> SensorTable:
        """Make a table of ``.sample`` files; the object's class is part of each file's name.

        Args:
            paths: of the files.
            convention: how their rows and distances are read, see
                :func:`~neurosim.simulators.tables.samples.as_evorobotpy2`.

        Raises:
            FileError: if a file is wrong.
            UserError: if a name names no class of objects or two, and as :meth:`from_samples`.
        """
        samples: dict[str, list[Samples]] = {name: [] for name in OBJECTS}
        for path in paths:
            sampled = Samples.read(path)
            named = [name for name in OBJECTS if name in Path(path).stem.lower()]
            if len(named) != 1:
                raise UserError(
                    f"{path}: which object was sampled? The file's name must contain "
                    f"{' or '.join(OBJECTS)}"
                )
            if convention == "evorobotpy2":
                sampled = as_evorobotpy2(sampled, cylinder=named[0] == "cylinder")
            samples[named[0]].append(sampled)
        return cls.from_samples(samples)


def _brightness(samples: Samples) -> float:
    """Return the sum of what the sensors read beyond the largest distance's median."""
    readings = samples.activations
    return float(np.maximum(readings - np.median(readings[-1], axis=0), 0.0).sum())


def _grid(samples: Samples) -> tuple:
    return (samples.activations.shape, samples.first_distance, samples.distance_step)


def _in_words(samples: Samples) -> str:
    distances, angles, sensors = samples.activations.shape
    return (
        f"{sensors} sensors x {angles} angles x {distances} distances from "
        f"{1000 * samples.first_distance:g} mm in steps of {1000 * samples.distance_step:g} mm"
    )
