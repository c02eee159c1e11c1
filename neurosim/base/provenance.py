"""The origin of artefacts, the virtual lab or a robot, by the JSON of the artefact."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Keys of neurosim's JSON files that give the origin of the content.
_PARTS = ("robot", "robots", "camera", "source", "simulator", "evolution")


def is_virtual(meta: Any) -> bool | None:
    """Return whether an artefact is from the virtual lab; None if it is unknown.

    A robot of the lab reports this when it is connected (``virtual`` in the driver's description),
    even if another program runs it. Artefacts made from its recordings inherit the mark. If one of
    several parts is virtual, the whole is.

    Args:
        meta: the artefact's JSON, or a part of it.
    """
    if isinstance(meta, list):
        return _any(is_virtual(part) for part in meta)
    if not isinstance(meta, Mapping):
        return None
    if isinstance(meta.get("virtual"), bool):
        return meta["virtual"]
    if meta.get("virtual_lab") is not None or meta.get("kind") == "virtual roof camera":
        return True
    virtual = _any(is_virtual(meta.get(part)) for part in _PARTS)
    # A recording that was made directly in the lab has this mark.
    return False if virtual is None and "virtual_lab" in meta else virtual


def _any(answers: Any) -> bool | None:
    known = [answer for answer in answers if answer is not None]
    return any(known) if known else None


def robot_kind(robot: Mapping[str, Any]) -> str | None:
    """Return the kind from a robot's description; None if it has none.

    Older descriptions of a Khepera have it under ``robot``.
    """
    return robot.get("kind") or robot.get("robot")
