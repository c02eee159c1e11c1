"""The samples of a robot become a table simulator: Lund and Miglino 1996."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from neurosim.base import files, formats
from neurosim.base.declared import Count, FullSpeed, Metres, checks
from neurosim.base.errors import UserError
from neurosim.base.place import Place, paper_arena
from neurosim.robots.khepera.dialects import DIALECTS
from neurosim.sampling.sampler import FORMAT, VERSION
from neurosim.simulators.sources import sources
from neurosim.simulators.tables.motor_table import MotorTable
from neurosim.simulators.tables.reaction import Reaction
from neurosim.simulators.tables.sensor_table import LIGHT, SensorTable, kind_of
from neurosim.simulators.tables.simulator import RADIUS, TableSimulator

#: Number of speeds of an ideal robot up to full speed: a Khepera's.
UNITS = 10
#: Number of sensors of a Khepera.
KHEPERA_SENSORS = 8


#: Radius of the circle around a robot's body, m.
Radius = Annotated[float, Meta(ge=0.001, le=10)]


@checks
def build_tables(
    samples: Sequence[str | Path],
    motors: str | Path | None = None,
    *,
    out: str | Path | None = None,
    wheel_base: Metres | None = None,
    full_speed: FullSpeed | None = None,
    units: Count | None = None,
    radius: Radius | None = None,
    place: Place | str | Path | None = None,
    noise: Literal["none", "uniform", "samples"] = "uniform",
    convention: Literal["neurosim", "evorobotpy2"] = "neurosim",
) -> TableSimulator:
    """Make a table simulator of samples.

    The robot's delays, its radius, its number of speeds and the speed of its serial line are read
    from the ``sampling.json`` next to the motor samples, if it exists.

    Args:
        samples: ``.sample`` files of a wall, of a cylinder or several and, if there is one, of a
            light, each with the kind in the file's name
            (:func:`~neurosim.simulators.tables.sensor_table.kind_of`). Several files of one object
            are repeats, from which sensor noise is estimated.
        motors: CSV file or dataset of motor samples: left, right, duration, dx, dy, dtheta; by
            default the robot is an ideal one.
        out: Folder of the new simulator; None: it is not written.
        wheel_base: Distance between the wheels of the ideal robot, m; by default a Khepera's, 53
            mm.
        full_speed: Wheel speed of the ideal robot at 100 %, m/s; by default a Khepera's, 100 mm/s.
        units: Number of the robot's speed steps up to full speed; by default as sampled, or 10.
        radius: Radius of the robot's body, m; by default as sampled, or 27.5 mm, a Khepera's, with
            eight sensors.
        place: Place of the robot, a JSON file or a name (from Python also a place); by default the
            arena of the paper, 60 x 35 cm with three obstacles, as much larger as the robot is
            than a Khepera.
        noise: Noise on every sensor and displacement: none; uniform, 5 % of the range; or
            samples, as wide as that of the samples.
        convention: How the samples are read: neurosim, where the object moves to the robot's
            right from row to row; or evorobotpy2, with rows in the opposite order and cylinders
            nearer by twice the first distance.

    Returns:
        The simulator. ``meta["body"]`` says where its ``radius``, ``wheel_base`` and ``full_speed``
        come from: given, sampled, or guessed, which are a Khepera's.

    Raises:
        UserError: if ``out`` exists, an object has no samples, the ideal robot is described
            although there are motor samples, or the robot's size is unknown.
        FileError: if a file is missing or wrong.
    """
    if motors is not None:
        for name, value in (("wheel base", wheel_base), ("full speed", full_speed)):
            if value is not None:
                raise UserError(
                    f"the {name} is for an ideal robot: leave it out, or leave out the motor "
                    "samples"
                )
    used = [Path(path) for path in samples]
    if not used:
        raise UserError("give the samples of a wall and of a cylinder, .sample files")
    sampling = (used[0] if motors is None else Path(motors)).parent
    robot = _sampling(sampling).get("robot", {})
    baud, whole, sampled_radius = robot.get("baud"), robot.get("full_speed"), _radius_of(robot)
    body = {
        "radius": _source(radius, sampled_radius),
        "wheel_base": _source(wheel_base, motors),
        "full_speed": _source(full_speed, motors),
    }
    radius = sampled_radius if radius is None else radius
    # An ideal robot's table has a row and a column for each speed, so their number is limited.
    units = units or (None if motors is None else whole) or UNITS
    if motors is None:
        given = {"wheel_base": wheel_base, "full_speed": full_speed}
        known = {name: value for name, value in given.items() if value is not None}
        table = MotorTable.ideal(**known, units=units)
    else:
        table = MotorTable.read_csv(motors, resolution=100.0 / units)
        used = [*used, Path(motors)]
    of_light = [path for path in samples if kind_of(path) == LIGHT]
    sensors = SensorTable.from_files([one for one in samples if one not in of_light], convention)
    lights = SensorTable.from_files(of_light, convention) if of_light else None
    count = sensors.mean.shape[-1]
    if radius is None and count != KHEPERA_SENSORS:
        raise UserError(
            f"the size of this robot is unknown, and with {count} sensors it is not a Khepera: "
            "give its radius (--radius, mm)"
        )
    size = RADIUS if radius is None else radius
    simulator = TableSimulator(
        sensors,
        table,
        paper_arena(max(size / RADIUS, 1.0)) if place is None else Place.of(place),
        noise=noise,
        radius=size,
        reaction=sampled_reaction(sampling),
        meta={
            **sources(used),
            "convention": convention,
            **({} if baud is None else {"baud": baud}),
            "body": body,
        },
        lights=lights,
    )
    if out is not None:
        with files.new_folder(out) as partial:
            simulator.write(partial)
    return simulator


def _source(given: object, sampled: object) -> Literal["given", "sampled", "guessed"]:
    return "given" if given is not None else "guessed" if sampled is None else "sampled"


def sampled_reaction(folder: str | Path) -> Reaction:
    """Return the reaction measured in a sampling; None if a folder is not a sampling.

    Raises:
        FileError: if ``sampling.json`` is wrong.
    """
    result = _sampling(folder).get("result")
    return Reaction.from_json(result["reaction"]) if result else Reaction()


def _sampling(folder: str | Path) -> dict[str, Any]:
    """Return the content of a folder's ``sampling.json``; empty if there is none."""
    path = Path(folder) / "sampling.json"
    return files.read_json(path, FORMAT, VERSION, formats.Sampling) if path.exists() else {}


def _radius_of(robot: Mapping[str, Any]) -> float | None:
    """Return the radius (m) of a robot that sampled itself; None if it is unknown."""
    # Older samplings do not have it.
    dialect = DIALECTS.get(robot.get("dialect", ""))
    nominal = None if dialect is None else dialect.geometry.radius
    return robot.get("radius", nominal)
