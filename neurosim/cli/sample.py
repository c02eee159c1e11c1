"""``neurosim sample``: robot -> samples of its sensors and motors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from neurosim.base.errors import UserError
from neurosim.cli._common import (
    PATH,
    POSITIVE,
    NumberIn,
    Resumable,
    emit,
    given_options,
    is_given,
    json_option,
    next_step,
    seed_option,
)
from neurosim.cli._robots import khepera, khepera_or_virtual, open_camera, virtual_khepera_baud
from neurosim.cli.record import marker_settings

_PROMPTS = {
    "wall": "Put the robot in front of a long wall, facing it and touching it, and press Enter",
    "cylinder": "Put the robot in front of a round obstacle, facing it and touching it, nothing "
    "else near, and press Enter",
    "open": "Put the robot on open floor, 20 cm free all around, under the camera if there is one, "
    "and press Enter",
}


def _begun(values: dict[str, Any]) -> dict[str, Any]:
    from neurosim.base.files import read_json
    from neurosim.sampling import FORMAT, VERSION

    path = values["out"] / "sampling.json"
    options = read_json(path, FORMAT, VERSION).get("options") if path.exists() else None
    return options if isinstance(options, dict) else {}


@click.command(cls=Resumable, begun=_begun)
@click.argument("out", type=PATH)
@khepera_or_virtual(
    "virtual: the lab in software, in which the robot is put down by itself.", "Which robot."
)
@click.option("--angles", type=click.IntRange(min=4), default=180, show_default=True)
@click.option("--distances", type=click.IntRange(min=2), default=20, show_default=True)
@click.option("--first", type=NumberIn(min=0), default=5.0, show_default=True, help="Distance, mm.")
@click.option(
    "--step", type=POSITIVE, default=2.0, show_default=True, help="From distance to distance, mm."
)
@click.option(
    "--repeats",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Of everything; two or more tell how readings spread.",
)
@click.option(
    "--grid",
    type=click.IntRange(min=2),
    help="Drive a grid of so many speeds of each motor, and some settings beside it to see what "
    "interpolation costs.  [every setting]",
)
@click.option(
    "--camera",
    help="A camera above the robot measures the motor settings, not the counters: its number, a "
    "file or URL that OpenCV opens, or lab for the virtual robot's.  [none]",
)
@click.option("--calibration", type=PATH, help="Of the camera, with its place above the floor.")
@click.option(
    "--markers",
    default="pink,blue",
    show_default=True,
    help="Colours FRONT,REAR of the robot's markers, or a markers.json that says where they are.",
)
@click.option("--resume", is_flag=True, help="Go on with sampling that was interrupted.")
@seed_option
@json_option
def sample(
    out: Path,
    robot: str,
    lab_seed: int,
    angles: int,
    distances: int,
    first: float,
    step: float,
    repeats: int,
    grid: int | None,
    camera: str | None,
    calibration: Path | None,
    markers: str,
    resume: bool,
    seed: int,
    as_json: bool,
    **options: Any,
) -> None:
    """Let a robot sample a wall, a round obstacle and its motors, into the folder OUT.

    Put it in front of each as asked. It turns on the spot, backs off, turns again; on open floor
    it drives its motor settings, and its counters tell how far it got; or a camera does, which sees
    wheels slip, and differ.
    """
    from neurosim.sampling import SampleSettings
    from neurosim.sampling import sample as sample_

    settings = SampleSettings(angles, distances, first / 1000, step / 1000, repeats, grid or 0)
    eye = _Eye.of(robot, camera, calibration, markers)
    with _opened(robot, lab_seed, seed, eye, options) as (driver, place, opened, virtual):
        result = sample_(
            out,
            driver,
            settings,
            place,
            resume=resume,
            seed=seed,
            eye=opened,
            lab=virtual,
            options=given_options(),
        )
    files = [out / name for name in result["samples"]]
    left, right = result["wheel_sizes"]
    text = (
        f"{out}: {len(files)} samples, {result['motor_settings']} motor settings; the wheels are "
        f"{1000 * result['wheel_base']:.1f} mm apart and differ by "
        f"{100 * abs(right - left):.1f} %.\n"
    )
    cost = result.get("interpolation")
    if cost is not None:
        text += (
            f"At {cost['settings']} settings beside the grid interpolation errs by "
            f"{1000 * cost['forward']['median']:.2f} mm/s and "
            f"{math.degrees(cost['turn']['median']):.2f} degrees/s (median; at most "
            f"{1000 * cost['forward']['max']:.2f} and {math.degrees(cost['turn']['max']):.2f}).\n"
        )
    emit(
        {"sampling": str(out), **result},
        as_json,
        text + next_step("tables", *files, "--motors", out / "motors.csv", "-o", "SIMULATOR"),
    )


@dataclass(frozen=True)
class _Eye:
    """The options of a camera above the robot: which, its calibration, the robot's markers."""

    camera: str
    model: Any
    markers: dict[str, Any]

    @staticmethod
    def of(robot: str, camera: str | None, calibration: Path | None, markers: str) -> _Eye | None:
        from tracking.camera.camera_model import CameraModel

        if camera is None:
            for name, option in (("calibration", "--calibration"), ("markers", "--markers")):
                if is_given(name):
                    raise UserError(f"{option} is of a camera: name it with --camera")
            return None
        if calibration is None:
            raise UserError(
                "--camera needs --calibration calibration.json (neurosim calibrate makes one, of "
                "the camera where it is now)"
            )
        kind = "khepera" if robot == "khepera" else "virtual khepera"
        return _Eye(camera, CameraModel.read(calibration), marker_settings(markers, kind))

    def opened(self, camera: Any, clock: Any) -> Any:
        from neurosim.sampling import Eye

        return Eye(camera, self.model, self.markers, clock)


@contextmanager
def _opened(
    kind: str, lab_seed: int, seed: int, eye: _Eye | None, options: dict[str, Any]
) -> Iterator[tuple[Any, Callable[[str], None], Any, dict[str, Any] | None]]:
    if kind == "khepera":
        if eye is not None and eye.camera == "lab":
            raise UserError("--camera lab is the virtual robot's; name a camera that there is")
        with khepera(options) as robot:
            camera = eye and open_camera(eye.camera, robot.clock.now, None, None)
            yield robot, _ask, eye and eye.opened(camera, robot.clock), None
        return
    from neurosim.lab import CameraParams, VirtualKheperaRig, sampling_places

    baud = virtual_khepera_baud(options)
    if eye is not None and eye.camera != "lab":
        raise UserError(
            f"--camera {eye.camera} does not see the virtual robot: use --camera lab, or add "
            "--robot khepera"
        )
    arena, poses = sampling_places()
    params = eye and CameraParams(size=tuple(eye.model.image_size))
    with (
        VirtualKheperaRig(
            lab_seed, noise_seed=seed, arena=arena, start=poses["open"], baud=baud, camera=params
        ) as rig,
        rig.robot as robot,
    ):

        def place(where: str) -> None:
            exact = where == "open"
            rig.lab.place(*poses[where], placing=(0.0, 0.0 if exact else math.radians(1)))

        yield robot, place, eye and eye.opened(rig.camera, robot.clock), rig.describe()


def _ask(where: str) -> None:
    click.prompt(_PROMPTS[where], default="", show_default=False, prompt_suffix=": ", err=True)
