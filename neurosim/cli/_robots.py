"""The options of the robot and of the camera that films it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from neurosim.cli._options import choice_options, settings_options
from neurosim.cli._types import SIZE


def _is_real(name: str) -> bool:
    from neurosim.trials.rig import RIGS

    return not RIGS.is_virtual(name)


def robot_option_of(default: str, help: str) -> Callable[[Callable], Callable]:
    """Return a decorator that adds ``--robot`` and the options of the chosen robot.

    Args:
        default: the robot's name; see :mod:`neurosim.trials.rig`.
        help: of the option; the names are added.
    """
    return choice_options(
        "--robot", "neurosim.trials.rig:RIGS", default=default, help=help, outside=_is_real
    )


#: Adds ``--robot`` and the options of the robot that it names.
robot_option = robot_option_of(
    "virtual", "The robot: one of the virtual lab, or a real one by the name of its driver"
)

#: Adds the options of the camera.
camera_options = settings_options(
    "camera",
    "neurosim.trials.rig:Setup",
    only=("camera", "size", "fps"),
    names={"size": "camera-size"},
    kinds={"size": SIZE},
)


def without_camera(options: Any) -> dict[str, Any]:
    """Return a resumed run's options without a camera, unless it is the virtual lab's.

    A file, which may be from anybody, must not choose what is opened: a camera's name may be any
    file or URL.
    """
    options = dict(options) if isinstance(options, dict) else {}
    if options.get("camera") not in ("lab", "none"):
        options.pop("camera", None)
    return options
