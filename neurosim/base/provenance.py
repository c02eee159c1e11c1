"""Where something is from, the virtual lab or which robot: as what was written of it says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: What may stand in a JSON of ours and say where its content is from.
_PARTS = ("robot", "robots", "camera", "source", "simulator", "evolution")


def is_virtual(meta: Any) -> bool | None:
    """Return whether an artefact is from the virtual lab; None if nothing in it says.

    A robot of the lab says so itself when it is connected (``virtual`` in what a driver
    describes), also one that another program keeps running; what is made of its recordings
    hands that on. If any part of several is virtual, all of it is.

    Args:
        meta: what the artefact's JSON says, or a part of it.
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
    # A recording says so if it was made in the lab by itself.
    return False if virtual is None and "virtual_lab" in meta else virtual


def _any(answers: Any) -> bool | None:
    known = [answer for answer in answers if answer is not None]
    return any(known) if known else None


def robot_kind(robot: Mapping[str, Any]) -> str | None:
    """Return the kind from a robot's description; None where it did not say.

    A Khepera used to say it under ``robot``.
    """
    return robot.get("kind") or robot.get("robot")
