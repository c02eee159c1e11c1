"""The markers of a robot, from a user's option."""

from __future__ import annotations

from typing import Any

from neurosim.base.errors import UserError
from tracking.datasets.recordings import (
    DEFAULT_MARKERS,
    DEFAULT_TAG,
    KHEPERA_MARKERS,
    KHEPERA_TAG,
    read_markers,
)
from tracking.markers.colours import colour_pair
from tracking.markers.sought import sought
from tracking.markers.tags import DEFAULT_ID, KINDS, Tag, kind_of

#: Robots whose markers and tag are not the default, by their name for ``--robot``.
OTHERS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "khepera": (KHEPERA_MARKERS, KHEPERA_TAG),
    "virtual-khepera": (KHEPERA_MARKERS, KHEPERA_TAG),
}


def marker_settings(
    markers: str | None = None,
    robot: str = "nxt",
    tag: int | None = None,
    recorded: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the markers of a robot in the form of recording.json.

    Args:
        markers: two colours ``FRONT,REAR``; a kind of tag; or a ``markers.json``, as ``neurosim
            watch`` writes it; None for the robot's default.
        robot: its name.
        tag: the tag's number; without ``markers``, that of an AprilTag.
        recorded: markers of a recording, which replace the robot's default.

    Raises:
        UserError: for an unknown colour or tag, a tag's number together with colours, or colours
            that a virtual robot does not have.
        FileError: if the file has no markers.
    """
    pair, square = OTHERS.get(robot, (DEFAULT_MARKERS, DEFAULT_TAG))
    default = recorded or pair
    if default.get("tag") is not None:
        square = default
    else:
        pair = default
    if markers is not None and markers.endswith(".json"):
        return _with_tag(read_markers(markers), tag)
    if markers is None and (tag is None or default is square):
        return _with_tag(default, tag)
    kind = kind_of(markers or next(iter(KINDS)))
    if kind is not None:
        return {**square, "tag": Tag(kind, DEFAULT_ID if tag is None else tag).as_dict()}
    colours = dict(zip(("front", "rear"), colour_pair(markers or ""), strict=True))
    carried = {which: pair[which]["colour"] for which in colours}
    if robot.startswith("virtual") and colours != carried:
        raise UserError(
            f"the virtual robot's markers are {carried['front']} and {carried['rear']}; "
            "leave --markers out"
        )
    named = {which: {**pair[which], "colour": colours[which]} for which in colours}
    return _with_tag({**pair, **named}, tag)


def _with_tag(markers: dict[str, Any], number: int | None) -> dict[str, Any]:
    """Return the same markers with another tag of the same dictionary, if there is a number.

    Raises:
        UserError: if they are colours, or the colours or the tag are unknown.
    """
    if number is not None:
        if markers.get("tag") is None:
            raise UserError("--tag is the number of a tag, but the robot's markers are colours")
        markers = {**markers, "tag": {**markers["tag"], "id": number}}
    sought(markers)  # raises the error
    return markers
