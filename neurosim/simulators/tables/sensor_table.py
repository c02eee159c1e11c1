"""A sensor table: readings of every sensor by kind of object, distance and angle.

A kind has a name, which is also part of a ``.sample`` file's name: ``wall``, a straight one;
``light``; ``cylinder``, a round obstacle of the size in Lund and Miglino 1996, or
``cylinder-12.5mm``, one of another radius. Proximity sensors see walls and cylinders, which are in
one table; sensors of ambient light see lights, which have a table of their own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.simulators.tables.samples import Samples, as_evorobotpy2

#: The classes of kinds.
WALL, CYLINDER, LIGHT = "wall", "cylinder", "light"
#: The kinds of a usual table.
OBJECTS = (WALL, CYLINDER)
#: Radius of a cylinder without one in its name (the paper's diameter is 5.5 cm), and of the small
#: one of the evorobot simulators, m.
OBSTACLE, SMALL = 0.0275, 0.0125
#: Names of a cylinder in the evorobot simulators, and of a small one.
_ROUND, _SMALL = ("cylinder", "round"), ("scylinder", "sround")
#: Largest difference in brightness between repeats of one object. In the virtual lab it is 2 %, by
#: noise and the robot's placing; an obstacle of half the size is 35 % darker.
ALIKE = 1.2
#: Interpretations of the rows and distances of ``.sample`` files.
Convention = Literal["neurosim", "evorobotpy2"]


def cylinder(radius: float) -> str:
    """Return the name of round obstacles of a radius, m."""
    millimetres = f"{1000 * radius:.9g}"
    return CYLINDER if float(millimetres) == 1000 * OBSTACLE else f"{CYLINDER}-{millimetres}mm"


def radius_of(kind: str) -> float:
    """Return the radius of objects of a kind, m; 0 for a wall or a light."""
    if not kind.startswith(CYLINDER):
        return 0.0
    _, _, millimetres = kind.partition("-")
    return OBSTACLE if not millimetres else float(millimetres.removesuffix("mm")) / 1000


def is_kind(name: str) -> bool:
    """Return whether a text is the name of a kind."""
    try:
        return name in (WALL, LIGHT) or name == cylinder(radius_of(name)) != cylinder(0.0)
    except ValueError:
        return False


def kind_of(path: str | Path) -> str:
    """Return the kind of object in a ``.sample`` file's name.

    Raises:
        UserError: if the name contains no kind, or two.
    """
    stem = Path(path).stem.lower()
    classes = {WALL: (WALL,), CYLINDER: _ROUND, LIGHT: (LIGHT,)}
    named = [one for one, words in classes.items() if any(word in stem for word in words)]
    if len(named) != 1:
        raise UserError(
            f"{path}: which object was sampled? The file's name must contain {WALL}, {CYLINDER} or "
            f"{LIGHT}, and may contain the cylinder's radius, such as {cylinder(SMALL)}"
        )
    if named[0] != CYLINDER:
        return named[0]
    radius = re.search(r"(\d+(?:\.\d+)?)mm", stem)
    if radius is not None:
        return cylinder(float(radius[1]) / 1000)
    return cylinder(SMALL if any(word in stem for word in _SMALL) else OBSTACLE)


@dataclass(frozen=True, eq=False)
class SensorTable:
    """Readings in 0..1 by kind of object, distance, angle and sensor.

    Attributes:
        mean: (K, D, A, S) means over repeats.
        spread: (K, D, A, S) standard deviations of a single reading, or None without repeats.
        first_distance: the smallest, from the robot's rim to the surface, m.
        distance_step: between distances, m.
        kinds: names of the kinds [K]: the wall and then cylinders, or a light alone.
    """

    mean: NDArray[np.float64]
    spread: NDArray[np.float64] | None
    first_distance: float
    distance_step: float
    kinds: tuple[str, ...] = OBJECTS

    def __post_init__(self) -> None:
        first, *others = self.kinds
        if not (self.kinds == (LIGHT,) or (first == WALL and others)):
            raise ValueError(f"expected a wall and cylinders, or a light, not {self.kinds}")
        if self.mean.ndim != 4 or len(self.mean) != len(self.kinds):
            raise ValueError("expected readings (kinds, distances, angles, sensors)")
        if self.spread is not None and self.spread.shape != self.mean.shape:
            raise ValueError("expected a spread for every reading")
        for name, table in (("readings", self.mean), ("spread", self.spread)):
            if table is not None and not np.isfinite(table).all():
                holes = np.argwhere(~np.isfinite(table))
                k, d, a, s = holes[0]
                raise UserError(
                    f"the sensor table has {len(holes)} holes in its {name}, the first at the "
                    f"{self.kinds[k]}, {1000 * (self.first_distance + d * self.distance_step):g} "
                    f"mm, angle {a} of {self.mean.shape[2]}, sensor {s}; sample these again"
                )

    @property
    def radii(self) -> NDArray[np.float64]:
        """Radii of the kinds, [K] m."""
        return np.array([radius_of(kind) for kind in self.kinds])

    @property
    def ambient(self) -> NDArray[np.float64]:
        """Each sensor's reading without near objects, [S].

        The median over all angles and kinds at the largest distance: at most angles a sensor
        looks past the object.
        """
        return np.median(self.mean[:, -1], axis=(0, 1))

    @property
    def ambient_spread(self) -> NDArray[np.float64]:
        """Standard deviation of these readings [S], in the same way; zero without repeats."""
        if self.spread is None:
            return np.zeros(self.mean.shape[-1])
        return np.median(self.spread[:, -1], axis=(0, 1))

    def bearings(self, kind: int = 0) -> NDArray[np.float64]:
        """Return each sensor's direction, [S] rad to the left; NaN for one that sees nothing.

        The mean bearing at which it sees an object at the first distance, each weighted with the
        reading above ambient: a near object saturates a sensor over a wide angle.

        Args:
            kind: the kind of object, an index into :attr:`kinds`.
        """
        turn = 2.0 * np.pi * np.arange(self.mean.shape[2]) / self.mean.shape[2]
        seen = np.maximum(self.mean[kind, 0] - self.ambient, 0.0)
        to = (seen * np.exp(-1j * turn)[:, None]).sum(axis=0)
        return np.where(np.abs(to) > 1e-9, np.angle(to), np.nan)

    @classmethod
    def from_samples(cls, samples: Mapping[str, Sequence[Samples]]) -> SensorTable:
        """Make a table from repeated samples of each kind of object.

        Args:
            samples: name of the kind -> repeats, at least one each.

        Raises:
            UserError: if the wall or a cylinder is missing, samples differ in their distances,
                angles or sensors, or repeats are of different objects.
        """
        kinds = tuple(sorted(filter(samples.get, samples), key=_order))
        if kinds != (LIGHT,):
            for name in OBJECTS:
                if not any(kind.startswith(name) for kind in kinds):
                    raise UserError(f"there are no samples of the {name}; sample it too")
        every = [one for name in kinds for one in samples[name]]
        first = every[0]
        for other in every[1:]:
            if _grid(other) != _grid(first):
                raise UserError(
                    "the samples do not fit each other: one has "
                    f"{_in_words(first)}, another {_in_words(other)}"
                )
        for name in kinds:
            levels = [_brightness(one) for one in samples[name]]
            if max(levels) > ALIKE * min(levels):
                raise UserError(
                    f"the samples of the {name} are not repeats of one object: one reads "
                    f"{100 * (1 - min(levels) / max(levels)):.0f} % less than another. Give those "
                    "of one size and colour; a cylinder of another size has its radius in the "
                    f"file's name, such as {cylinder(SMALL)}.sample"
                )
        stacks = [np.stack([one.activations for one in samples[name]]) for name in kinds]
        repeated = min(map(len, stacks)) > 1
        return cls(
            mean=np.stack([stack.mean(axis=0) for stack in stacks]),
            spread=np.stack([stack.std(axis=0, ddof=1) for stack in stacks]) if repeated else None,
            first_distance=first.first_distance,
            distance_step=first.distance_step,
            kinds=kinds,
        )

    @classmethod
    def from_files(
        cls, paths: Sequence[str | Path], convention: Convention = "neurosim"
    ) -> SensorTable:
        """Make a table from ``.sample`` files; the kind of object is part of each file's name.

        Args:
            paths: of the files.
            convention: interpretation of their rows and distances, see
                :func:`~neurosim.simulators.tables.samples.as_evorobotpy2`.

        Raises:
            FileError: if a file is wrong.
            UserError: see :func:`kind_of` and :meth:`from_samples`.
        """
        samples: dict[str, list[Samples]] = {}
        for path in paths:
            sampled, kind = Samples.read(path), kind_of(path)
            if convention == "evorobotpy2":
                sampled = as_evorobotpy2(sampled, cylinder=kind.startswith(CYLINDER))
            samples.setdefault(kind, []).append(sampled)
        return cls.from_samples(samples)


def _order(kind: str) -> tuple[bool, float]:
    """Return the key by which kinds are sorted: the wall first, cylinders by their size."""
    return kind != WALL, radius_of(kind)


def _brightness(samples: Samples) -> float:
    """Return the sum of the readings above the median at the largest distance."""
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
