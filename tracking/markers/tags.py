"""Printed tags: AprilTag and ArUco squares, found and identified by OpenCV's detector."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import cv2
from numpy.typing import NDArray

from neurosim.base.errors import UserError

#: Short names of dictionaries, and their names in OpenCV.
KINDS = {"apriltag": "APRILTAG_36h11", "aruco": "4X4_50"}
#: The number of a tag unless another one is given.
DEFAULT_ID = 0

#: Smallest width of a cell in a picture, pixels, with which tags are found.
SMALLEST_CELL = 2.0
#: The white around the black square, in cells: detectors need one.
QUIET = 1.0


@dataclass(frozen=True)
class Tag:
    """One tag.

    Attributes:
        dictionary: as OpenCV names it, without ``DICT_``.
        number: its number in the dictionary.
    """

    dictionary: str = KINDS["apriltag"]
    number: int = DEFAULT_ID

    def __post_init__(self) -> None:
        count = len(self.words.bytesList)
        if not 0 <= self.number < count:
            raise UserError(
                f"the dictionary {self.dictionary} has no tag {self.number}: its tags are 0 to "
                f"{count - 1}"
            )

    def __str__(self) -> str:
        return f"tag {self.number} of {self.dictionary}"

    def as_dict(self) -> dict[str, str | int]:
        """Return it for JSON."""
        return {"dictionary": self.dictionary, "id": self.number}

    @cached_property
    def words(self) -> cv2.aruco.Dictionary:
        """The dictionary itself."""
        return dictionary_of(self.dictionary)

    @cached_property
    def cells(self) -> NDArray:
        """[N, N] bool, True where it is white, with its black border and no white around it."""
        side = self.words.markerSize + 2
        return cv2.aruco.generateImageMarker(self.words, self.number, side) > 0


def kind_of(text: str) -> str | None:
    """Return the dictionary that a person means, by its name in OpenCV; None: no dictionary."""
    wanted = f"DICT_{KINDS.get(text.strip().lower(), text.strip())}".upper()
    names = sorted(name for name in _names() if name.upper() == wanted)
    return names[-1].removeprefix("DICT_") if names else None


def dictionary_of(name: str) -> cv2.aruco.Dictionary:
    """Return a dictionary by its name in OpenCV, without ``DICT_``; upper and lower case alike.

    Raises:
        UserError: if no dictionary has this name.
    """
    known = kind_of(name)
    if known is None:
        raise UserError(
            f"there is no dictionary of tags {name!r}; use {' or '.join(KINDS)}, or a name of "
            "OpenCV's such as APRILTAG_25h9 or 5X5_100"
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{known}"))


def _names() -> Iterator[str]:
    return (name for name in dir(cv2.aruco) if name.startswith("DICT_"))
