"""The markers of a robot, two colours or a tag, and their tracker."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import ArrayLike

from tracking.markers.colours import Colour, parse_colour
from tracking.markers.pair import Geometry
from tracking.markers.tag_tracker import TagTracker
from tracking.markers.tags import Tag
from tracking.markers.tracker import Tracker

#: The colours of the front and the rear marker, or a tag.
Sought = tuple[Colour, Colour] | Tag

#: Colours in which the ends of a tag are drawn, BGR.
_ENDS = (80, 220, 80), (60, 160, 240)


def sought(markers: Mapping[str, Any]) -> Sought:
    """Return the markers of a robot.

    Args:
        markers: as in recording.json.

    Raises:
        UserError: for a colour, or a tag, that is not known.
    """
    tag = markers.get("tag")
    if tag is not None:
        return Tag(tag["dictionary"], tag["id"])
    front, rear = (parse_colour(str(markers[which]["colour"])) for which in ("front", "rear"))
    return front, rear


def tracker_of(
    what: Sought, geometry: Geometry | None = None, start: ArrayLike | None = None
) -> Tracker | TagTracker:
    """Return a new tracker.

    Args:
        what: the colours or tag to look for.
        geometry: the known geometry of the pair of markers, or of a tag's ends.
        start: of two colours: see :class:`tracking.markers.tracker.Tracker`.
    """
    return TagTracker(what, geometry) if isinstance(what, Tag) else Tracker(*what, geometry, start)


def drawing_colours(what: Sought) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Return the colours, BGR, in which front and rear are drawn."""
    return _ENDS if isinstance(what, Tag) else (what[0].bgr, what[1].bgr)
