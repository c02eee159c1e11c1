"""``neurosim tables``: samples -> simulator."""

from __future__ import annotations

from pathlib import Path

import click

from neurosim.base.errors import UserError
from neurosim.cli._common import PATH, NumberIn, emit, is_given, json_option, next_step

noise_option = click.option(
    "--noise",
    type=click.Choice(["none", "uniform", "samples"]),
    help="On every sensor and displacement: none; uniform, 5 % of the range; the samples' own.",
)
arena_option = click.option(
    "--arena", "arena_path", type=PATH, help="JSON of the arena.  [60 x 35 cm, three obstacles]"
)


@click.command()
@click.argument("samples", type=PATH, nargs=-1, required=True)
@click.option("-o", "--out", type=PATH, required=True, help="Folder of the new simulator.")
@click.option(
    "--motors",
    type=PATH,
    help="CSV or dataset of motor samples: left, right, duration, dx, dy, dtheta.  "
    "[an ideal robot]",
)
@click.option(
    "--wheel-base",
    type=NumberIn(1, 10_000),
    default=53.0,
    show_default=True,
    help="Of the ideal robot, between wheels, mm.",
)
@click.option(
    "--full-speed",
    type=NumberIn(1, 10_000),
    default=100.0,
    show_default=True,
    help="Of the ideal robot's wheels, mm/s.",
)
@click.option(
    "--units",
    type=click.IntRange(1, 1000),
    help="Whole speeds that the robot can be set to, up to full speed.  [as sampled, or 10]",
)
@arena_option
@noise_option
@json_option
def tables(
    samples: tuple[Path, ...],
    out: Path,
    motors: Path | None,
    wheel_base: float,
    full_speed: float,
    units: int | None,
    arena_path: Path | None,
    noise: str | None,
    as_json: bool,
) -> None:
    """Make a simulator of SAMPLES: .sample files of a wall and of a round obstacle.

    A file's name says which: it contains wall or cylinder. Several files of one object are
    repeats, from which the spread of readings is taken. How late the robot answers is read from
    the sampling.json beside the motor samples.
    """
    from neurosim.base.files import new_folder
    from neurosim.sampling import sampled_baud, sampled_body, sampled_reaction
    from neurosim.simulators.sources import sources
    from neurosim.simulators.tables.arena import Arena, paper_arena
    from neurosim.simulators.tables.motor_table import MotorTable
    from neurosim.simulators.tables.sensor_table import SensorTable
    from neurosim.simulators.tables.simulator import RADIUS, TableSimulator

    for name, option in (("wheel_base", "--wheel-base"), ("full_speed", "--full-speed")):
        if motors is not None and is_given(name):
            raise UserError(f"{option} is of an ideal robot: leave it out, or --motors")
    sampling = (motors or samples[0]).parent
    reaction, baud = sampled_reaction(sampling), sampled_baud(sampling)
    sampled_units, radius = sampled_body(sampling)
    # An ideal robot has a row and a column of settings for each: only so many that are asked for.
    units = units or (10 if motors is None else sampled_units) or 10
    table = SensorTable.from_files(samples)
    motor_table = (
        MotorTable.ideal(wheel_base / 1000, full_speed / 1000, units=units)
        if motors is None
        else MotorTable.read_csv(motors, resolution=100.0 / units)
    )
    used = [*samples, *([] if motors is None else [motors])]
    simulator = TableSimulator(
        table,
        motor_table,
        paper_arena() if arena_path is None else Arena.read(arena_path),
        noise=noise or "uniform",
        radius=RADIUS if radius is None else radius,
        reaction=reaction,
        meta={**sources(used), **({} if baud is None else {"baud": baud})},
    )
    with new_folder(out) as partial:
        simulator.write(partial)
    _, distances, angles, sensors = table.mean.shape
    result = {
        "simulator": str(out),
        "sensors": sensors,
        "angles": angles,
        "distances": distances,
        "repeated": table.spread is not None,
        "motors": "ideal" if motors is None else str(motors),
        "ambient": table.ambient,
        "reaction": reaction.to_json(),
    }
    emit(
        result,
        as_json,
        f"{out}: {sensors} sensors at {angles} angles and {distances} distances, "
        f"{'an ideal robot' if motors is None else f'motors of {motors}'}.\n"
        + next_step("evolve", out, "--task", "obstacle-avoidance", "-o", "CONTROLLER"),
    )
