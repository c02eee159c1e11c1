"""Sampling: the robot's tasks in order, and their results in a folder."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import files, formats
from neurosim.base.errors import FileError, LinkLost, UserError
from neurosim.base.progress import Progress
from neurosim.robots.base import LightSensors
from neurosim.sampling.eye import Eye
from neurosim.sampling.motors import Counters, interpolation_cost, sample_motors
from neurosim.sampling.reaction import read_reaction, sample_reaction
from neurosim.sampling.resampling import full_turn, wheel_sizes, write_samples
from neurosim.sampling.settings import Sampler, SampleSettings
from neurosim.sampling.turns import read_turns, reading_times, sample_object

FORMAT, VERSION = "neurosim-sampling", 2

#: Asks a person to place the robot, at an object of a kind, or on open floor ("open").
Place = Callable[[str], None]


def sample(
    out: str | Path,
    robot: Sampler,
    settings: SampleSettings,
    place: Place,
    *,
    resume: bool = False,
    seed: int = 0,
    progress: bool = True,
    eye: Eye | None = None,
    lab: Mapping[str, Any] | None = None,
    options: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Sample objects and the motors into a folder.

    Args:
        out: folder with ``sampling.json``, ``sensors.csv``, ``motors.csv`` and, for every object
            and repeat, a ``.sample`` file (``wall.sample``, ``wall-2.sample``, ...).
        robot: connected.
        settings: of the sampling.
        place: asks a person to place the robot at an object, facing it and touching it.
        resume: continue an interrupted call, with the same settings.
        seed: of the choice of settings held out.
        progress: whether to show progress on stderr.
        eye: a camera that measures the motors' settings instead of the counters.
        lab: settings of a virtual robot's lab.
        options: kept in ``sampling.json``, for resuming.

    Returns:
        ``samples`` (files), ``wheel_base`` (m, measured), ``wheel_sizes`` (left and right
        over their mean, measured), ``motor_settings``, ``reaction``
        (:class:`~neurosim.simulators.tables.reaction.Reaction`), and, with a grid,
        ``interpolation``: median and largest error at the held-out settings, in m/s (``forward``)
        and rad/s (``turn``).

    Raises:
        UserError: if ``out`` exists, the resumed sampling was begun with other settings or another
            robot, or the robot cannot sample itself.
        RobotError: if the robot is lost or stuck; the samples are kept.
    """
    if not isinstance(robot, Sampler):
        raise UserError(
            "this robot cannot sample itself: it needs a ring of proximity sensors, wheel "
            "counters and speeds in whole numbers"
        )
    if settings.light and not isinstance(robot, LightSensors):
        raise UserError("this robot does not measure ambient light: leave out --light")
    out, settings = Path(out), settings.of(robot)
    levels = settings.levels(robot.full_speed)
    about = {
        "settings": {**asdict(settings), "cylinders": list(settings.cylinders)},
        "seed": seed,
        "robot": {**robot.describe(), **_body(robot)},
        **({} if lab is None else {"virtual_lab": dict(lab)}),
        "motors": "counters" if eye is None else "camera",
    }
    _begin(out, {**about, "options": dict(options or {})}, resume)
    with files.locked(out, "sampled into"):
        try:
            return _sample(out, robot, settings, levels, place, seed, progress, eye)
        except LinkLost as error:
            how = "the samples so far are kept, continue with --resume"
            raise LinkLost(f"{error}; {how}") from None


def _sample(
    out: Path,
    robot: Sampler,
    settings: SampleSettings,
    levels: NDArray[np.int64],
    place: Place,
    seed: int,
    progress: bool,
    eye: Eye | None,
) -> dict[str, Any]:
    """Take the missing samples; see :func:`sample`."""
    total = settings.repeats * settings.distances * len(settings.kinds)
    bar = Progress("sample", total, "turns") if progress else None
    try:
        for name in settings.kinds:
            for repeat in range(1, settings.repeats + 1):
                sample_object(out, robot, settings, name, repeat, place, bar)
                full_turn(read_turns(out))  # wrong pulses per metre are reported at once
    finally:
        robot.stop()
        if bar is not None:
            bar.close()
    turns = read_turns(out)
    pulses = full_turn(turns)
    wheel_base = pulses / robot.pulses_per_metre / math.pi
    sizes = wheel_sizes(turns)
    made = write_samples(out, settings, turns, robot, pulses, sizes)
    in_the_open = _once(place, "open")
    try:
        with eye or nullcontext():
            measure = (eye or Counters(robot, wheel_base, sizes)).measure
            sample_motors(out, robot, settings, levels, measure, in_the_open, seed)
        sample_reaction(out, robot, in_the_open)
    finally:
        robot.stop()
    reaction = read_reaction(out, reading_times(out), robot.scan)
    result = {
        "samples": [path.name for path in made],
        "wheel_base": wheel_base,
        "wheel_sizes": list(sizes),
        "motor_settings": len(levels) ** 2,
        "reaction": reaction.to_json(),
    }
    cost = interpolation_cost(out)
    if cost is not None:
        result["interpolation"] = cost
    content = files.read_json(out / "sampling.json", FORMAT, VERSION, formats.BegunSampling)
    described = {
        key: content[key]
        for key in ("settings", "seed", "robot", "virtual_lab", "motors", "options")
        if key in content
    }
    files.write_json(out / "sampling.json", FORMAT, VERSION, {**described, "result": result})
    return result


def _body(robot: Sampler) -> dict[str, Any]:
    """Return the robot's numbers that tables need in addition to the samples."""
    return {"full_speed": robot.full_speed, "radius": robot.geometry.radius}


def _once(place: Place, where: str) -> Callable[[], None]:
    """Return a function that asks for the robot's placement at its first call."""
    return cache(lambda: place(where))


def _begin(out: Path, about: dict[str, Any], resume: bool) -> None:
    path = out / "sampling.json"
    if not resume:
        files.check_new_folder(out)
        files.write_json(path, FORMAT, VERSION, about)
        return
    begun = files.read_json(path, FORMAT, VERSION, formats.BegunSampling)
    files.check_no_links(out)
    if any(begun[name] != about[name] for name in ("settings", "seed")):
        raise FileError(
            path,
            "was started with other settings; give the same settings to continue",
            field="settings",
        )
    then, now = begun.get("motors", "counters"), about["motors"]
    if then != now:
        raise FileError(
            path, f"was begun with motors measured by {then}, not {now}", field="motors"
        )
    for part, names in _SAME.items():
        then, now = (side.get(part) or {} for side in (begun, about))
        for name in names:
            if then.get(name) not in (None, now.get(name)):
                raise FileError(
                    path,
                    f"was begun with {name} = {then[name]}, not {now.get(name)}",
                    field=f"{part}.{name}",
                )


#: Keys that identify a robot and its line when sampling is resumed.
_SAME = {"robot": ("virtual", "dialect", "baud"), "virtual_lab": ("robot_seed",)}
