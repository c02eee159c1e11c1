"""Which markers a robot carries, as a person says it."""

from __future__ import annotations

from typing import Any

from neurosim.base.errors import UserError
from tracking.datasets.recordings import DEFAULT_MARKERS, KHEPERA_MARKERS, read_markers
from tracking.markers.colours import colour_pair, parse_colour

#: Robots whose markers are not the default, by the name that ``--robot`` takes.
OTHERS: dict[str, dict[str, Any]] = {
    "khepera": KHEPERA_MARKERS,
    "virtual-khepera": KHEPERA_MARKERS,
}


def marker_settings(markers: str | None = None, robot: str = "nxt") -> dict[str, Any]:
    """Return the markers of a robot, as recordings have them.

    Args:
        markers: two colours ``FRONT,REAR``; or a ``markers.json``, as ``neurosim watch`` writes
            it; None for the robot's default.
        robot: its name.

    Raises:
        UserError: for a colour that is not known, or one that a virtual robot does not carry.
        FileError: if the file is not one of markers.
    """
    known = OTHERS.get(robot, DEFAULT_MARKERS)
    if markers is None:
        return known
    if markers.endswith(".json"):
        found = read_markers(markers)
        for which in ("front", "rear"):
            parse_colour(str(found[which]["colour"]))
        return found
    colours = dict(zip(("front", "rear"), colour_pair(markers), strict=True))
    carried = {which: known[which]["colour"] for which in colours}
    if robot.startswith("virtual") and colours != carried:
        raise UserError(
            f"the virtual robot's markers are {carried['front']} and {carried['rear']}; "
            "leave --markers out"
        )
    return {**known, **{which: {**known[which], "colour": colours[which]} for which in colours}}
