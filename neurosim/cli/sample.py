"""``neurosim sample``: robot -> samples of its sensors and motors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from neurosim.cli._common import (
    PATH,
    Resumable,
    emit,
    given_options,
    json_option,
    next_step,
    seed_option,
)
from neurosim.cli._robots import khepera, khepera_options, virtual_khepera_baud

_PROMPTS = {
    "wall": "Put the robot in front of a long wall, facing it and touching it, and press Enter",
    "cylinder": "Put the robot in front of a round obstacle, facing it and touching it, nothing "
    "else near, and press Enter",
    "open": "Put the robot on open floor, 20 cm free all around, and press Enter",
}


def _begun(values: dict[str, Any]) -> dict[str, Any]:
    from neurosim.base.files import read_json
    from neurosim.sampling import FORMAT, VERSION

    path = values["out"] / "sampling.json"
    options = read_json(path, FORMAT, VERSION).get("options") if path.exists() else None
    return options if isinstance(options, dict) else {}


@click.command(cls=Resumable, begun=_begun)
@click.argument("out", type=PATH)
@click.option(
    "--robot",
    type=click.Choice(["virtual", "khepera"]),
    default="virtual",
    show_default=True,
    help="virtual: the lab in software, in which the robot is put down by itself.",
)
@khepera_options
@click.option(
    "--lab-seed", type=click.IntRange(min=0), default=0, show_default=True, help="Which robot."
)
@click.option("--angles", type=click.IntRange(min=4), default=180, show_default=True)
@click.option("--distances", type=click.IntRange(min=2), default=20, show_default=True)
@click.option("--first", default=5.0, show_default=True, help="Distance, mm.")
@click.option("--step", default=2.0, show_default=True, help="From distance to distance, mm.")
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
    resume: bool,
    seed: int,
    as_json: bool,
    **options: Any,
) -> None:
    """Let a robot sample a wall, a round obstacle and its motors, into the folder OUT.

    Put it in front of each as asked. It turns on the spot, backs off, turns again; on open floor
    it drives its motor settings.
    """
    from neurosim.sampling import SampleSettings
    from neurosim.sampling import sample as sample_

    settings = SampleSettings(angles, distances, first / 1000, step / 1000, repeats, grid or 0)
    with _opened(robot, lab_seed, seed, options) as (driver, place):
        result = sample_(
            out, driver, settings, place, resume=resume, seed=seed, options=given_options()
        )
    files = [out / name for name in result["samples"]]
    text = (
        f"{out}: {len(files)} samples, {result['motor_settings']} motor settings; the wheels are "
        f"{1000 * result['wheel_base']:.1f} mm apart.\n"
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


@contextmanager
def _opened(
    kind: str, lab_seed: int, seed: int, options: dict[str, Any]
) -> Iterator[tuple[Any, Callable[[str], None]]]:
    if kind == "khepera":
        with khepera(options) as robot:
            yield robot, _ask
        return
    from neurosim.lab import VirtualKheperaRig, sampling_places

    baud = virtual_khepera_baud(options)
    arena, poses = sampling_places()
    with (
        VirtualKheperaRig(
            lab_seed, noise_seed=seed, arena=arena, start=poses["open"], baud=baud
        ) as rig,
        rig.robot as robot,
    ):

        def place(where: str) -> None:
            exact = where == "open"
            rig.lab.place(*poses[where], placing=(0.0, 0.0 if exact else math.radians(1)))

        yield robot, place


def _ask(where: str) -> None:
    click.prompt(_PROMPTS[where], default="", show_default=False, prompt_suffix=": ", err=True)
