"""``neurosim build-tables``: samples -> simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from neurosim.cli._common import emit, json_option, next_step, warn_of
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
    """Make a look-up-table simulator of SAMPLES: .sample files of a wall, of cylinders, of a light.

    A file's name contains wall, cylinder or light, and a cylinder's its radius, such as
    cylinder-12.5mm. Several files of one object are repeats, from which sensor noise is estimated.
    The robot's delays are read from the sampling.json next to the motor samples.
    """
    from neurosim.sampling import build_tables as build_tables_

    simulator = build_tables_(samples, out=out, **settings)
    _, distances, angles, sensors = simulator.sensors.mean.shape
    motors, lights = settings.get("motors"), simulator.lights
    result = {
        "simulator": str(out),
        "sensors": sensors,
        "objects": [*simulator.sensors.kinds, *(lights.kinds if lights else ())],
        "angles": angles,
        "distances": distances,
        "repeated": simulator.sensors.spread is not None,
        "motors": "ideal" if motors is None else str(motors),
        "body": {
            "radius": simulator.radius,
            "wheel_base": simulator.motors.wheel_base,
            "full_speed": simulator.motors.full_speed,
            "from": simulator.meta["body"],
        },
        "ambient": simulator.sensors.ambient,
        "reaction": simulator.reaction.to_json(),
    }
    moved = "an ideal robot" if motors is None else f"motors of {motors}"
    emit(
        result,
        as_json,
        f"{out}: {sensors} sensors at {angles} angles and {distances} distances of "
        f"{', '.join(result['objects'])}; {moved}.\n"
        + _body(result["body"])
        + next_step("evolve", out, "--task", "obstacle-avoidance", "-o", "CONTROLLER"),
    )
    warn_of(simulator)


#: The robot's size and speed: words for a message, and the option that gives each value.
_BODY = {
    "radius": ("radius {:.1f} mm", "--radius"),
    "wheel_base": ("{:.1f} mm between its wheels", "--wheel-base"),
    "full_speed": ("{:.0f} mm/s at full speed", "--full-speed"),
}


def _body(body: dict[str, Any]) -> str:
    """Return a sentence on the robot's size and speed, and a question if they were guessed."""
    parts = [
        f"{words.format(1000 * body[name])} ({body['from'][name]})"
        for name, (words, _) in _BODY.items()
    ]
    text = f"The robot: {', '.join(parts)}.\n"
    guessed = [option for name, (_, option) in _BODY.items() if body["from"][name] == "guessed"]
    if guessed:
        text += f"Is it a Khepera? If not, build again with its {', '.join(guessed)}.\n"
    return text
