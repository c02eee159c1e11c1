"""``neurosim sample``: robot -> samples of its sensors and motors."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from neurosim.base.errors import UserError, counted
from neurosim.cli._common import (
    calibration_option,
    emit,
    is_given,
    json_option,
    markers_option,
    next_step,
    resume_option,
    seed_option,
    tag_option,
)
from neurosim.cli._options import (
    SettingsCommand,
    given_options,
    settings_options,
)
from neurosim.cli._robots import robot_option_of, without_camera
from neurosim.cli._types import PATH

if TYPE_CHECKING:
    from neurosim.recording.settings import Rig

_PROMPTS = {
    "wall": "Put the robot in front of a long wall, facing it and touching it, and press Enter",
    "cylinder": "Put the robot in front of a round obstacle, {} mm across, facing it and touching "
    "it, with nothing else near, and press Enter",
    "light": "Darken the room, put the robot with its front below a lamp, facing where the lamp is "
    "when the robot backs off, with nothing else near, and press Enter",
    "open": "Put the robot on open floor, 30 cm free all around, under the camera if there is one, "
    "and press Enter",
}


def _begun(values: dict[str, Any]) -> dict[str, Any]:
    from neurosim.base.files import read_json
    from neurosim.sampling import FORMAT, VERSION

    path = values["out"] / "sampling.json"
    options = read_json(path, FORMAT, VERSION).get("options") if path.exists() else None
    return without_camera(options)


@click.command(cls=SettingsCommand, begun=_begun)
@click.argument("out", type=PATH)
@robot_option_of(
    "virtual-khepera",
    "The robot, with a ring of proximity sensors; the virtual lab puts its own robot in place",
)
@settings_options(
    "settings",
    "neurosim.sampling.settings:SampleSettings",
    skip=("held_out", "duration"),
    units={"first": "mm", "step": "mm", "cylinders": "mm", "light_step": "mm"},
)
@click.option(
    "--camera",
    help="Measure the motor settings by a camera above the robot, not by its counters: the "
    "camera's number, a file or URL that OpenCV opens, or lab for the virtual lab's.",
)
@calibration_option("The camera's calibration.json, with its place above the floor.")
@markers_option
@tag_option
@resume_option
@seed_option
@json_option
def sample(
    out: Path,
    robot: str,
    robot_options: dict[str, Any],
    settings: dict[str, Any],
    camera: str | None,
    calibration: Path | None,
    markers: str | None,
    tag: int | None,
    resume: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Let a robot sample a wall, round obstacles, a light and its motors, into the folder OUT.

    Put it in front of each when asked. It turns on the spot, backs off, and turns again. On open
    floor it drives its motor settings. Its counters, or a camera, measure the distances; a camera
    also measures slip.
    """
    from neurosim.lab import sampling_places
    from neurosim.recording.markers import marker_settings
    from neurosim.sampling import Eye, SampleSettings
    from neurosim.sampling import sample as sample_
    from neurosim.trials.rig import Setup, open_rig
    from tracking.camera.camera_model import CameraModel

    how, model = SampleSettings(**settings), None
    if camera is None:
        for name in ("calibration", "markers", "tag"):
            if is_given(name):
                raise UserError(f"--{name} needs --camera")
    elif calibration is None:
        raise UserError(
            "--camera needs --calibration calibration.json (from neurosim calibrate, with the "
            "camera in its present place)"
        )
    else:
        model = CameraModel.read(calibration)
    carried = marker_settings(markers, robot, tag)
    place, poses = sampling_places(how.kinds)
    setup = Setup(
        camera=camera or "none",
        size=None if model is None else tuple(model.image_size),
        seed=seed,
        start=poses["open"],
        place=place,
        markers=carried,
    )
    with open_rig(robot, robot_options, setup) as rig, rig.robot as driver:
        eye = None if model is None else Eye(rig.camera, model, carried, driver.clock)
        result = sample_(
            out,
            driver,
            how,
            _place(rig, how.kinds, seed),
            resume=resume,
            seed=seed,
            eye=eye,
            lab=rig.lab,
            options=given_options(),
        )
    emit({"sampling": str(out), **result}, as_json, lambda: _words(out, result))


def _place(rig: Rig, kinds: tuple[str, ...], seed: int) -> Callable[[str], None]:
    """Return a function by which the lab, or a person, places the robot."""
    import numpy as np

    from neurosim.lab import sampling_places
    from neurosim.simulators.tables.sensor_table import radius_of

    rng = np.random.default_rng([seed, 0x6B50])

    def by_lab(where: str) -> None:
        assert rig.place is not None
        robot: Any = rig.robot
        _, poses = sampling_places(kinds, robot.geometry.radius)
        x, y, theta = poses[where]
        slack = 0.0 if where == "open" else math.radians(1)
        rig.place(x, y, theta + slack * rng.standard_normal())

    def by_person(where: str) -> None:
        kind, _, _ = where.partition("-")
        text = _PROMPTS[kind].format(f"{2000 * radius_of(where):g}")
        click.prompt(text, default="", show_default=False, prompt_suffix=": ", err=True)

    return by_person if rig.place is None else by_lab


def _words(out: Path, result: dict[str, Any]) -> str:
    files = [out / name for name in result["samples"]]
    left, right = result["wheel_sizes"]
    text = (
        f"{out}: {counted(len(files), 'sample')}, "
        f"{counted(result['motor_settings'], 'motor setting')}; the wheels are "
        f"{1000 * result['wheel_base']:.1f} mm apart and differ by "
        f"{100 * abs(right - left):.1f} %.\n"
    )
    cost = result.get("interpolation")
    if cost is not None:
        text += (
            f"At {cost['settings']} settings outside of the grid the interpolation error is "
            f"{1000 * cost['forward']['median']:.2f} mm/s and "
            f"{math.degrees(cost['turn']['median']):.2f} degrees/s (median; at most "
            f"{1000 * cost['forward']['max']:.2f} and {math.degrees(cost['turn']['max']):.2f}).\n"
        )
    return text + next_step(
        "build-tables", *files, "--motors", out / "motors.csv", "-o", "SIMULATOR"
    )
