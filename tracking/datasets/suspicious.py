"""Signs of wrong numbers in imported files: a sentence for each, with a remedy.

Commands are compared with the motion that follows them. If a command has a unit (v in m/s, w in
rad/s), it gives the robot's speed; otherwise speeds and sizes are compared with those of existing
robots.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.declared import Checked
from tracking.datasets.logs import Log, is_known, off_axis

#: Units in SI.
LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
ANGLES = {"rad": 1.0, "deg": math.pi / 180.0}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

#: Speeds of robots, m/s and rad/s; how far apart two wheels are, m; seconds from one sample of a
#: log to the next.
_SPEEDS, _RATES, _TRACKS, _SAMPLES = (0.002, 20.0), (0.02, 50.0), (0.01, 10.0), (2e-4, 3.0)
#: Largest ratio of the motion to the command, or its inverse; beyond it another unit may fit.
_OBEYS, _MENDED = 5.0, 2.5
_RIGHT = "commands, speeds and times do not fit each other: they would with {}"
#: Duration over which motion is measured, s.
_SPAN = 0.1
#: Smallest number of samples of the motion, and fraction of its variance that counters explain.
_FEW, _COUNTED = 30, 0.5
#: Median angle between heading and way, rad, from which they do not fit each other: a robot that
#: slips is below it.
_ASIDE = 0.6
#: Fraction of the time in which a command is rarely so large, and in multiples of what it is
#: otherwise, how large.
_RARELY, _FAR = 0.03, 5.0
#: Smallest command, as a fraction of the largest, that is never near 0, and fraction of the
#: variance of the motion that a constant must explain in addition.
_NEVER, _GAINED = 0.3, 0.2
#: Largest heading within one turn, rad, with some noise.
ONE_TURN = 2 * math.pi + 0.1
#: Fraction of changing lines above which a command counts as measured or computed.
_ALWAYS = 0.9


@dataclass(frozen=True)
class Conventions(Checked):
    """The conventions of a file.

    Attributes:
        length: unit of x, y, dx, dy: m, cm or mm.
        angle: unit of headings and dtheta: rad or deg.
        time: unit of times and durations: s, ms, us or ns.
        y: direction of y, seen along x: left, as in mathematics, with counter-clockwise headings;
            or right, as in pictures with y down, with clockwise headings.
        frame: of the dx, dy in a file of rows: body, the robot's at the command's beginning, or
            world, the frame of ``heading0``.
    """

    length: Literal["m", "cm", "mm"] = "m"
    angle: Literal["rad", "deg"] = "rad"
    time: Literal["s", "ms", "us", "ns"] = "s"
    y: Literal["left", "right"] = "left"
    frame: Literal["body", "world"] = "body"

    def poses(self, numbers: NDArray) -> NDArray:
        """Return poses or displacements (N, 3) in SI and with y to the left."""
        length, angle = LENGTHS[self.length], ANGLES[self.angle]
        side = 1.0 if self.y == "left" else -1.0
        return numbers * (length, side * length, side * angle)

    def besides(self, other: Conventions) -> list[str]:
        """Return the options that change these conventions to the others."""
        names = ("length", "angle", "time", "y")
        pairs = [(name, getattr(other, name)) for name in names]
        return [f"--{name} {value}" for name, value in pairs if value != getattr(self, name)]


@dataclass(frozen=True)
class Moved:
    """Commands, and the motion that followed them.

    Attributes:
        commands: (K, C).
        twist: (K, 3) of the motion, m/s, m/s, rad/s.
        apart: seconds from one sample to the next; None for rows, whose lines are commands.
        changes: (K, C) of the commands during the motion, 1/s; None for rows.
    """

    commands: NDArray
    twist: NDArray
    apart: float | None
    changes: NDArray | None = None


def moved_in(logs: Sequence[Log]) -> Moved:
    """Return the motion in logs, in steps of :data:`_SPAN` or two samples."""
    apart = float(np.median(np.concatenate([np.diff(log.time) for log in logs])))
    span = max(_SPAN, 2.0 * apart)
    commands, twists, changes = [], [], []
    for log in logs:
        grid = np.arange(log.pose_time[0], log.pose_time[-1] - span, span)
        grid = grid[is_known(log.pose_time, grid, 2.0 * span)] if len(grid) else grid
        displacement = se2.between(log.pose_at(grid), log.pose_at(grid + span))
        twists.append(_twist(displacement, np.full(len(grid), span)))
        place = np.searchsorted(log.time, grid + span / 2, side="right") - 1
        commands.append(log.commands[np.clip(place, 0, len(log.time) - 1)])
        first, last = (
            np.column_stack([np.interp(at, log.time, own) for own in log.commands.T])
            for at in (grid, grid + span)
        )
        changes.append((last - first) / span)
    parts = (np.concatenate(part) for part in (commands, twists))
    return Moved(*parts, apart, np.concatenate(changes))


def _twist(displacement: NDArray, duration: NDArray) -> NDArray:
    """Return mean speeds (K, 3), of the arc if it is not closed."""
    half = displacement[:, 2] / 2
    cos, sin = np.cos(half), np.sin(half)
    x, y = displacement[:, 0], displacement[:, 1]
    chord = np.sinc(half / np.pi)
    arc = np.where(np.abs(chord) > 0.2, chord, 1.0)
    ahead, aside = (cos * x + sin * y) / arc, (cos * y - sin * x) / arc
    return np.column_stack([ahead, aside, displacement[:, 2]]) / duration[:, None]


def of_rows(commands: NDArray, duration: NDArray, displacement: NDArray) -> Moved:
    """Return the motion of rows (N, ...), each with its duration, s."""
    with np.errstate(all="ignore"):
        return Moved(commands, _twist(displacement, duration), None)


def suspicions(
    moved: Moved,
    names: Sequence[str],
    units: Mapping[str, str],
    given: Conventions,
    read: Conventions | None = None,
    degrees: bool = True,
) -> list[str]:
    """Return sentences on suspicious findings in commands and the motion that followed them.

    Args:
        moved: commands and motion.
        names: of the commands.
        units: of the commands.
        given: the conventions that the user gave.
        read: the conventions used for reading the motion, if others.
        degrees: whether headings may be in degrees; those within one turn in radians may not.
    """
    if len(moved.twist) < 8:
        return []
    by_units = _units(moved, names, units, given, read or given, degrees)
    # Headings in another unit are no way to go; otherwise a wrong way is no unit.
    sideways = [] if any("--angle" in one for one in by_units) else _sideways(moved, names)
    turns = _turns(moved, names, units, given)
    of_motion = sideways or [*by_units, *turns] or _backwards(moved, names, units)
    of_commands = (*_constant(moved, names), *_rare(moved, names), *_neutral(moved, names))
    return [*of_commands, *of_motion]


def _constant(moved: Moved, names: Sequence[str]) -> list[str]:
    warnings = []
    for name, column in zip(names, moved.commands.T, strict=True):
        if (column == column[0]).all():
            warnings.append(f"the command {name} never changes: leave it out of --columns")
    if (moved.twist == 0).all():
        warnings.append(
            "the robot never moves: look whether x, y and heading are the right --columns"
        )
    return warnings


def _rare(moved: Moved, names: Sequence[str]) -> list[str]:
    """Return a sentence for each command that is rarely far larger than otherwise."""
    warnings = []
    for name, size in zip(names, np.abs(moved.commands).T, strict=True):
        usual = float(np.quantile(size, 1.0 - _RARELY))
        far = size > _FAR * usual
        if usual > 0.0 and far.any():
            warnings.append(
                f"the command {name} is up to {size.max():g} in {far.mean():.1%} of the time, and "
                f"at most {size[~far].max():g} otherwise: if it was not sent, remove these lines"
            )
    return warnings


def _neutral(moved: Moved, names: Sequence[str]) -> list[str]:
    """Return a sentence if commands are never near 0, and 0 does not mean standing still."""
    size = np.abs(moved.commands)
    never = [
        name
        for name, column, lowest, highest in zip(
            names, moved.commands.T, size.min(0), size.max(0), strict=True
        )
        if lowest > _NEVER * highest and (column != column[0]).any()
    ]
    usual = _usual(moved.commands)
    if not never or usual.sum() < _FEW:
        return []
    scaled, motion = moved.commands[usual] / size.max(0), moved.twist[usual][:, [0, 2]]
    spread = motion.var(0)
    if (spread == 0.0).any():
        return []

    def missed(inputs: NDArray) -> NDArray:
        left = motion - inputs @ np.linalg.lstsq(inputs, motion, rcond=None)[0]
        return np.square(left).mean(0) / spread

    gained = missed(scaled) - missed(np.column_stack([scaled, np.ones(len(scaled))]))
    if gained.max() < _GAINED:
        return []
    ranges = ", ".join(
        f"{name} is {column.min():g} to {column.max():g}"
        for name, column in zip(names, moved.commands.T, strict=True)
        if name in never
    )
    return [
        f"{ranges}: 0 must mean standing still or straight on; if another value does, subtract it"
    ]


def off_heading(moved: Moved) -> float:
    """Return the median angle, 0 to pi/2, between headings and the way of a robot that moves."""
    speed = np.hypot(moved.twist[:, 0], moved.twist[:, 1])
    fast = speed > 0.3 * np.quantile(speed, 0.95)
    if fast.sum() < 8:
        return 0.0
    return float(np.median(off_axis(np.arctan2(moved.twist[fast, 1], moved.twist[fast, 0]))))


def fit_better(turned: Moved, moved: Moved, names: Sequence[str]) -> bool:
    """Return whether other headings fit the way of a robot of two commands; True for others."""
    if len(names) > 2:
        return True
    return off_heading(turned) <= min(off_heading(moved), _ASIDE)


def _sideways(moved: Moved, names: Sequence[str]) -> list[str]:
    """Return a sentence if a robot of two commands goes sideways; its speeds then say nothing."""
    if len(names) > 2 or (off := off_heading(moved)) < _ASIDE:
        return []
    other = "is the tracked point far from the axle"
    if moved.apart is None:
        other = "are dx and dy in the room's frame (--frame world)"
    return [
        f"the robot goes {math.degrees(off):.0f} degrees off its headings (median): are x and y "
        f"swapped, is one mirrored, is heading 0 not along x, or {other}? Headings grow from x to y"
    ]


def _gains(moved: Moved, names: Sequence[str], units: Mapping[str, str]) -> dict[str, float]:
    """Return the ratios of the robot's speed to commands in m/s and rad/s, by unit."""
    gains = {}
    for unit, output in (("m/s", 0), ("rad/s", 2)):
        columns = [place for place, name in enumerate(names) if units.get(name) == unit]
        if len(columns) != 1:
            continue
        asked, got = moved.commands[:, columns[0]], moved.twist[:, output]
        much = np.abs(asked) > 0.3 * np.abs(asked).max()
        if much.sum() >= 8:
            gains[unit] = float(np.median(got[much] / asked[much]))
    return gains


def _track(moved: Moved, names: Sequence[str]) -> tuple[float, float] | None:
    """Return the distance of two wheels, m, and the turn rate by right minus left; or None."""
    if list(names) != ["left", "right"]:
        return None
    usual = _usual(moved.commands)
    if usual.sum() < 8:
        return None
    with_one = np.column_stack([moved.commands[usual], np.ones(usual.sum())])
    weights = np.linalg.lstsq(with_one, moved.twist[usual][:, [0, 2]], rcond=None)[0]
    forward, turn = weights[:2, 0].sum(), (weights[1, 1] - weights[0, 1]) / 2
    if abs(turn) * np.abs(moved.commands).max() < 1e-9:
        return None
    return abs(forward / turn), float(turn)


def like_degrees(time: NDArray, heading: NDArray) -> bool:
    """Return whether headings (N,) in supposed radians are degrees.

    Headings in radians are within one turn, or have no large steps.

    Args:
        time: (N,) of the samples.
        heading: (N,).
    """
    if len(heading) < 2:
        return False
    apart = np.abs(np.diff(time))
    steps = np.abs(np.diff(heading))[apart <= 3.0 * np.median(apart)]
    return bool(np.abs(heading).max() > ONE_TURN and (steps > np.pi).any())


def _units(
    moved: Moved,
    names: Sequence[str],
    units: Mapping[str, str],
    given: Conventions,
    now: Conventions,
    degrees: bool,
) -> list[str]:
    """Return other units in which implausible numbers would make sense."""
    gains, track = _gains(moved, names, units), _track(moved, names)
    fast = float(np.quantile(np.hypot(moved.twist[:, 0], moved.twist[:, 1]), 0.95))
    turning = float(np.quantile(np.abs(moved.twist[:, 2]), 0.95))

    def sensible(other: Conventions, factor: float) -> bool:
        time = TIMES[other.time] / TIMES[now.time]
        length = LENGTHS[other.length] / LENGTHS[now.length]
        angle = ANGLES[other.angle] / ANGLES[now.angle]
        held = [_within(fast * length / time, _SPEEDS) or fast == 0.0]
        held.append(_within(turning * angle / time, _RATES) or turning == 0.0)
        if moved.apart is not None:
            held.append(_within(moved.apart * time, _SAMPLES))
        for unit, size in (("m/s", length), ("rad/s", angle)):
            gain = abs(gains.get(unit, 0.0)) * size / time
            # A robot that hardly moves does not show its units.
            held.append(gain == 0.0 or 1 / factor < gain < factor)
        if track is not None:
            held.append(_within(track[0] * length / angle, _TRACKS))
        return all(held)

    if sensible(now, _OBEYS):
        return [] if now == given else [_RIGHT.format(" ".join(given.besides(now)))]
    others = [
        replace(now, length=length, angle=angle, time=time)
        for length, angle, time in product(LENGTHS, ANGLES if degrees else [now.angle], TIMES)
    ]
    fitting = [other for other in others if sensible(other, _MENDED)]
    fitting.sort(key=lambda other: len(given.besides(other)))
    if fitting and fitting[0] != given:
        fewest = len(given.besides(fitting[0]))
        near = [other for other in fitting if len(given.besides(other)) == fewest]
        return [_RIGHT.format(" or ".join(" ".join(given.besides(other)) for other in near))]
    warnings = []
    likely = {"m/s": _within(fast, _SPEEDS), "rad/s": _within(turning, _RATES)}
    for unit, gain in gains.items():
        if likely[unit] and gain and not 1 / _OBEYS < abs(gain) < _OBEYS:
            name = next(name for name in names if units.get(name) == unit)
            warnings.append(
                f"the robot moves {abs(gain):.3g} times as fast as {name} in {unit} says: is that "
                f"its unit? Otherwise name it, such as --units {name}=%"
            )
    for name, column in zip(names, moved.commands.T, strict=True):
        limits = {"m/s": _SPEEDS, "rad/s": _RATES}.get(units.get(name, ""), (0.0, math.inf))
        if (largest := np.abs(column).max()) > limits[1]:
            other = {"m/s": "mm/s", "rad/s": "deg/s"}[units[name]]
            warnings.append(
                f"the command {name} is up to {largest:.3g} {units[name]}: is that its unit? "
                f"Otherwise name it, such as --units {name}={other}"
            )
    if not _within(fast, _SPEEDS) and fast:
        warnings.append(
            f"the robot moves at {fast:.3g} m/s: are --length {now.length} and --time {now.time} "
            "right?"
        )
    if not _within(turning, _RATES) and turning:
        warnings.append(
            f"the robot turns at {turning:.3g} rad/s: are --angle {now.angle} and --time "
            f"{now.time} right?"
        )
    if moved.apart is not None and not _within(moved.apart, _SAMPLES):
        warnings.append(f"samples are {moved.apart:.3g} s apart: is --time {now.time} right?")
    return warnings


def _within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]


def _turns(
    moved: Moved, names: Sequence[str], units: Mapping[str, str], now: Conventions
) -> list[str]:
    """Return a sentence about turns in the opposite direction, if any."""
    other = "left" if now.y == "right" else "right"
    gain, track = _gains(moved, names, units).get("rad/s", 0.0), _track(moved, names)
    if gain < -1 / _OBEYS:
        name = next(name for name in names if units.get(name) == "rad/s")
        return [
            f"the robot turns the other way than {name} says: does y point to the {other} "
            f"(--y {other})? If only {name} counts clockwise, change its sign"
        ]
    if track is not None and track[1] < 0:
        return [
            "the robot turns left where `left` is the faster: are left and right exchanged in "
            f"--columns, or does y point to the {other} (--y {other})?"
        ]
    return []


def _backwards(moved: Moved, names: Sequence[str], units: Mapping[str, str]) -> list[str]:
    """Return a sentence about a robot of two commands whose speed has the other sign, if any."""
    if len(names) > 2 or not -_OBEYS < _gains(moved, names, units).get("m/s", 0.0) < -1 / _OBEYS:
        return []
    name = next(name for name in names if units.get(name) == "m/s")
    return [f"the robot goes backwards where {name} is above 0: do its headings point backwards?"]


def always_changing(logs: Sequence[Log], names: Sequence[str], sent: Sequence[str]) -> list[str]:
    """Return a sentence if commands change with every sample, like measured ones.

    Args:
        logs: of a robot.
        names: of its commands.
        sent: those that should be as they were sent.
    """
    changes = np.concatenate([np.diff(log.commands, axis=0) != 0 for log in logs])
    always = dict(zip(names, changes.mean(0) > _ALWAYS, strict=True))
    busy = [name for name in sent if always[name]]
    if not busy:
        return []
    return [
        f"{' and '.join(busy)} change with every sample, as measured speeds do: name the columns "
        "of the sent commands in --columns, if they exist"
    ]


def counting(moved: Moved, names: Sequence[str]) -> list[str]:
    """Return a sentence if the robot moves as fast as commands change, as counters of wheels do."""
    if moved.changes is None or len(moved.twist) < _FEW:
        return []
    explained = [_explained(inputs, moved.twist) for inputs in (moved.changes, moved.commands)]
    if explained[0] < _COUNTED or explained[1] > _COUNTED / 2.0:
        return []
    return [
        f"the robot moves as fast as {' and '.join(names)} change: if they are counters, as of "
        f"wheels, import it with --counters {','.join(names)}"
    ]


def _usual(inputs: NDArray) -> NDArray[np.bool_]:
    """Return which inputs (K, C) are not far larger than most."""
    return (np.abs(inputs) <= 10.0 * np.quantile(np.abs(inputs), 0.9, axis=0)).all(1)


def _explained(inputs: NDArray, twist: NDArray) -> float:
    """Return the fraction of the variance of the motion (K, 3) that inputs (K, C) explain.

    Far larger inputs do not count, such as where a counter begins again.
    """
    usual = _usual(inputs)
    if usual.sum() < _FEW:
        return 0.0
    inputs, twist = inputs[usual], twist[usual]
    with_one = np.column_stack([inputs / np.abs(inputs).max(0).clip(1e-12), np.ones(len(inputs))])
    motion = twist[:, [0, 2]] - twist[:, [0, 2]].mean(0)
    motion = motion / motion.std(0).clip(1e-12)
    left = motion - with_one @ np.linalg.lstsq(with_one, motion, rcond=None)[0]
    return 1.0 - float(left.var(0).sum() / max(motion.var(0).sum(), 1e-12))


def wrapped(moved: Moved, duration: NDArray) -> int:
    """Return the number of rows (N,) that turned by more than half a turn, but have a smaller turn.

    The turn by commands is learned from rows with small turns, and compared with the others.
    """
    if len(duration) < 8:
        return 0
    turn = moved.twist[:, 2] * duration
    with_one = np.column_stack([moved.commands, np.ones(len(duration))])
    usable = duration <= np.quantile(duration, 0.3)
    expected = turn
    for _ in range(5):
        weights = np.linalg.lstsq(with_one[usable], moved.twist[usable, 2], rcond=None)[0]
        expected = with_one @ weights * duration
        usable = (np.abs(expected) < 2.0) & (np.abs(expected - turn) < 1.0)
        if usable.sum() < 8:
            return 0
    return int(((np.abs(expected) > np.pi) & (np.abs(expected - turn) > np.pi)).sum())
