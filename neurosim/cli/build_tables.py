"""``neurosim build-tables``: samples -> simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from neurosim.cli._common import emit, json_option, next_step
from neurosim.cli._options import SettingsCommand, settings_options
from neurosim.cli._types import PATH


@click.command("build-tables", cls=SettingsCommand)
@click.argument("samples", type=PATH, nargs=-1, required=True)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new simulator.")
@settings_options(
    "settings",
    "neurosim.sampling:build_tables",
    skip=("samples", "out"),
    units={"wheel_base": "mm", "full_speed": "mm/s", "radius": "mm"},
)
@json_option
def build_tables(
    samples: tuple[Path, ...], out: Path, settings: dict[str, Any], as_json: bool
) -> None:
    """Make a look-up-table simulator of SAMPLES: .sample files of a wall and of a cylinder.

    A file's name says which: it contains wall or cylinder. Several files of one object are
    repeats, from which sensor noise is estimated. How late the robot answers is read from the
    sampling.json beside the motor samples.
    """
    from neurosim.sampling import build_tables as build_tables_

    simulator = build_tables_(samples, out=out, **settings)
    _, distances, angles, sensors = simulator.sensors.mean.shape
    motors = settings.get("motors")
    result = {
        "simulator": str(out),
        "sensors": sensors,
        "angles": angles,
        "distances": distances,
        "repeated": simulator.sensors.spread is not None,
        "motors": "ideal" if motors is None else str(motors),
        "ambient": simulator.sensors.ambient,
        "reaction": simulator.reaction.to_json(),
    }
    emit(
        result,
        as_json,
        f"{out}: {sensors} sensors at {angles} angles and {distances} distances, "
        f"{'an ideal robot' if motors is None else f'motors of {motors}'}.\n"
        + next_step("evolve", out, "--task", "obstacle-avoidance", "-o", "CONTROLLER"),
    )
