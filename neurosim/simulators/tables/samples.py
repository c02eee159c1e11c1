"""The ``.sample`` format: a robot's readings while it turned in front of an object.

A header ``sensors angles distances first-distance-mm distance-step-mm``; for each distance a line
``TURN k`` and, for each angle, a line of as many activations (0 to 1) as there are sensors; a
last line ``END``. Lines end in CR LF, and the header and every line of activations in a space
before that. It is the format of the evorobot family of simulators.

Distances are from the robot's rim to the object's surface. In row 0 the object is straight ahead.
From row to row the robot turns to its left (counter-clockwise), by a full turn over the number of
angles, so that the object moves to its right. With the published samples of a Khepera this fits the
manual's order of sensors: 0 to 5 from left to right in front, 6 behind to the right, 7 behind to
the left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files
from neurosim.base.errors import FileError


@dataclass(frozen=True, eq=False)
class Samples:
    """One object's samples.

    Attributes:
        activations: (D, A, S) in 0..1, distance x angle x sensor.
        first_distance: from rim to surface, m.
        distance_step: between distances, m.
        line_end: end of the file's lines; CR LF in the published ones.
    """

    activations: NDArray[np.float64]
    first_distance: float
    distance_step: float
    line_end: str = "\r\n"

    @classmethod
    def read(cls, path: str | Path) -> Samples:
        """Read and check a file.

        Raises:
            FileError: naming the line, if the file is missing or cut short, or has a wrong
                header, a wrong number of lines or numbers, or a value that is not an activation.
        """
        text = files.read_text(path, "a .sample file", encoding="ascii")
        line_end = "\r\n" if "\r\n" in text or "\n" not in text else "\n"
        lines = text.replace("\r\n", "\n").removesuffix("\n").split("\n")
        sensors, angles, distances, first, step = _header(Path(path), lines[0])
        expected = 2 + distances * (angles + 1)
        if len(lines) < expected:
            last = _is_whole(lines[-1], sensors)
            raise FileError(
                path,
                f"is cut short: expected {expected} lines",
                line=len(lines) + 1 if last else len(lines),
            )
        rows = np.empty((distances * angles, sensors))
        for index in range(distances * (angles + 1)):
            number = index + 2
            distance, row = divmod(index, angles + 1)
            if row == 0:
                _expect(path, lines[number - 1], f"TURN {distance}", number)
            else:
                rows[distance * angles + row - 1] = _row(path, lines[number - 1], sensors, number)
        _expect(path, lines[expected - 1], "END", expected)
        if any(line.strip() for line in lines[expected:]):
            raise FileError(path, "continues after END", line=expected + 1)
        turns = rows.reshape(distances, angles, sensors)
        return cls(turns, first / 1000, step / 1000, line_end)

    def write(self, path: str | Path) -> None:
        """Write a file, whole or not at all; activations to six decimals, or as many as needed.

        Raises:
            ValueError: if an activation is not in 0 to 1, so that the file could not be read.
        """
        distances, angles, sensors = self.activations.shape
        if not ((self.activations >= 0) & (self.activations <= 1)).all():
            raise ValueError("expected activations in 0 to 1")
        first, step = (_plain(1000 * value) for value in (self.first_distance, self.distance_step))
        lines = [f"{sensors} {angles} {distances} {first} {step} "]
        for distance, turn in enumerate(self.activations):
            lines.append(f"TURN {distance}")
            lines += ["".join(f"{_activation(value)} " for value in row) for row in turn]
        with files.atomic_path(path) as partial:
            partial.write_bytes("".join(line + self.line_end for line in [*lines, "END"]).encode())


def as_evorobotpy2(samples: Samples, *, cylinder: bool) -> Samples:
    """Return samples in the interpretation of the simulator evorobotpy2.

    It uses the rows in the opposite order (an object in row k is further to the robot's left). It
    uses a cylinder's samples at distances that are smaller by twice the first one, 10 mm in the
    published ones. Beyond the last sampled distance it uses the last row.

    Source: S. Nolfi, evorobotpy2, ``updateInfraredSensor`` in lib/robot-env.cpp.

    Args:
        samples: as in their file.
        cylinder: whether they are of a cylinder.
    """
    rows = np.roll(samples.activations[:, ::-1], 1, axis=1)
    if cylinder:
        count = len(rows)
        places = np.arange(count) + 2.0 * samples.first_distance / samples.distance_step
        below = np.minimum(places.astype(int), count - 1)
        above, fraction = np.minimum(below + 1, count - 1), (places % 1.0)[:, None, None]
        rows = (1.0 - fraction) * rows[below] + fraction * rows[above]
    return replace(samples, activations=rows)


def _is_whole(line: str, sensors: int) -> bool:
    return line.startswith("TURN") or len(line.split()) == sensors


def _header(path: Path, line: str) -> tuple[int, int, int, float, float]:
    words = line.split()
    try:
        sensors, angles, distances = (int(word) for word in words[:3])
        first, step = (files.number(word) for word in words[3:])
    except ValueError:
        sensors = angles = distances = 0
        first = step = math.nan
    if not (0 < sensors <= 1000 and 3 < angles <= 100_000 and 1 < distances <= 100_000):
        step = math.nan
    if not (step > 0 and first >= 0):
        raise FileError(
            path,
            "expected a header 'sensors angles distances first-distance-mm distance-step-mm' "
            f"such as '8 180 20 5 2', found {line!r:.60}",
            line=1,
        )
    return sensors, angles, distances, first, step


def _expect(path: str | Path, line: str, word: str, number: int) -> None:
    if line.strip() != word:
        raise FileError(path, f"expected {word!r}, found {line!r:.60}", line=number)


def _row(path: str | Path, line: str, sensors: int, number: int) -> list[float]:
    words = line.split()
    if len(words) != sensors:
        raise FileError(
            path, f"expected {sensors} activations, found {line.strip()!r:.60}", line=number
        )
    try:
        values = [files.number(word) for word in words]
    except ValueError:
        values = [math.nan]
    if not all(0 <= value <= 1 for value in values):
        raise FileError(
            path, f"expected activations in 0 to 1, found {line.strip()!r:.60}", line=number
        )
    return values


def _activation(value: float) -> str:
    short = f"{value:.6f}"
    return short if float(short) == value else repr(float(value))


def _plain(millimetres: float) -> str:
    """Return a length without the rounding errors of a division by 1000."""
    return f"{millimetres:.9g}"
