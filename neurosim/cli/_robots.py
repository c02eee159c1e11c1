"""The options that say which robot, and which camera films it."""

from __future__ import annotations

from neurosim.cli._options import choice_options, settings_options
from neurosim.cli._types import SIZE

#: Adds ``--robot`` and the options of the robot that it names; see :mod:`neurosim.trials.rig`.
robot_option = choice_options(
    "--robot",
    "neurosim.trials.rig:RIGS",
    default="virtual",
    help="The robot: one of the virtual lab, or a real one by the name of its driver",
)

#: Adds the options of the camera.
camera_options = settings_options(
    "camera",
    "neurosim.trials.rig:Setup",
    only=("camera", "size", "fps"),
    names={"size": "camera-size"},
    kinds={"size": SIZE},
)
