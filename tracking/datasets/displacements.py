"""Poses at the instants of motor commands, and the displacement that each command caused.

Frames are not at the instants of commands, and a robot without pauses changes its velocity just
after each of these instants. So the pose at an instant is fitted to the frames just before it, in
which the robot moved steadily, and one frame after it, before the motors have answered: a
constant-twist fit (heading linear in time, position on the arc that such a heading gives). On
simulated wheels that answer 20 to 40 ms late with a lag of 0.1 s, five frames before and one
after leave a bias of 0.01 mm and 0.01 degrees and three quarters of the noise that
interpolation between the two nearest frames leaves; with the frames after the instant weighing
as much as those before, the bias is 0.1 to 0.4 mm.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.declared import Checked, Seconds
from tracking.clock.motor_delay import Delay, motion_delay
from tracking.datasets.recordings import CommandLine, Poses, Recording
from tracking.datasets.within import choose_instants, poses_within

#: Reasons for leaving a command out of a dataset.
REASONS = {
    "cut": "cut short at a line",
    "incomplete": "the session or the video ended before the command did",
    "clock": "the motors held the command longer or shorter than planned",
    "lost track": "the robot was not seen near the start or the end, or for too long in between",
    "jump": "the track moves faster than the robot can",
    "doubtful": "the tracked pair may not be the robot",
}


#: Smallest number of answers, and smallest delay in standard deviations, for correcting a motor
#: delay: a wrong correction would be worse than none.
FEWEST_ANSWERS, SIGNIFICANT = 20, 2.0


@dataclass(frozen=True)
class Settings(Checked):
    """Settings of displacements from a track.

    Attributes:
        fit_before: time before an instant whose frames the pose is fitted to, s.
        settling: time that the motors may take to follow a command; frames of it are not
            fitted unless there are no others, s.
        nearest: frames farther than this from an instant cannot tell the pose there, in
            intervals between frames.
        longest_gap: longest time that the robot may be lost within a command, s.
        max_speed: faster than this between two frames is a jump, m/s.
        max_turn_rate: turning faster than this between two frames is a jump, rad/s.
        timing: how far a command's end may be from its planned time, s.
    """

    fit_before: Seconds = 0.17
    settling: Seconds = 0.3
    nearest: Annotated[float, Meta(ge=0.001, le=1000)] = 1.5
    longest_gap: Seconds = 0.3
    max_speed: Annotated[float, Meta(ge=0.001, le=1000)] = 1.2
    max_turn_rate: Annotated[float, Meta(ge=0.001, le=1000)] = 15.0
    timing: Seconds = 0.15


@dataclass
class Displacements:
    """The rows of one recording.

    Attributes:
        rows: one dict per usable command, keys command, the numbers of the command and, with
            ``prev_`` before their names, of the one before (for two wheels prev_left, prev_right,
            left, right, percent), duration (s), dx, dy (m), dtheta (rad), quality (0..1),
            ``start``, the pose (m, m, rad) where it began, and ``within``, the tracked poses at
            some frames within it (:func:`tracking.datasets.within.poses_within`).
        left_out: reason -> count of the commands that gave no row.
        sent: every command as often as it was sent, dicts with its numbers by name, ``forward``
            and ``turn`` (percent), duration, attempt (from 1) and ``fate``: ``cut``,
            ``completed`` or ``other``.
        delays: the motors' delay of every session in which it could be estimated
            (:class:`tracking.clock.motor_delay.Delay`).
        corrected: the sessions whose displacements begin at that later instant.
        untracked: session -> count of the commands after the last pose, where several were.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)
    sent: list[dict[str, Any]] = field(default_factory=list)
    delays: dict[int, Delay] = field(default_factory=dict)
    corrected: set[int] = field(default_factory=set)
    untracked: dict[int, int] = field(default_factory=dict)


class Track:
    """The poses of one session, on the robot's clock.

    Args:
        times: (N,) increasing, s.
        poses: (N, 3) x, y in m and unwrapped theta in rad; NaN where the robot was not seen.
        quality: (N,) 0..1.
        settings: of poses and displacements.
    """

    def __init__(
        self, times: NDArray, poses: NDArray, quality: NDArray, settings: Settings | None = None
    ):
        self.settings = settings or Settings()
        seen = np.isfinite(poses).all(axis=1)
        self.interval = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        self.last_time = float(times[-1]) if len(times) else -np.inf
        self.times, self.poses, self.quality = times[seen], poses[seen], quality[seen]
        steps = np.diff(self.times)
        moved = np.abs(np.diff(self.poses, axis=0))
        self._jumps = (np.hypot(moved[:, 0], moved[:, 1]) > self.settings.max_speed * steps) | (
            moved[:, 2] > self.settings.max_turn_rate * steps
        )

    def pose_at(self, time: float, steady_since: float = -np.inf) -> tuple[NDArray, float] | None:
        """Return the pose (3,) at ``time`` and its quality, or None if the track is lost.

        Args:
            time: the instant, on the robot's clock.
            steady_since: since when the motors have followed their last command.
        """
        after = int(np.searchsorted(self.times, time, side="left"))
        if not 2 <= after < len(self.times):
            return None
        near = self.settings.nearest * self.interval
        if time - self.times[after - 1] > near or self.times[after] - time > near:
            return None
        first = np.searchsorted(self.times, max(time - self.settings.fit_before, steady_since))
        chosen = slice(min(int(first), after - 2), after + 1)
        pose = fit_pose(self.times[chosen] - time, self.poses[chosen])
        return pose, float(self.quality[after - 1 : after + 1].min())

    def within(self, begin: float, duration: float) -> tuple[NDArray, NDArray]:
        """Return some of the frames in a command that begins at ``begin`` and has this duration.

        Returns:
            times: (K,) s since ``begin``.
            poses: (K, 3) the frames' own poses, not fitted.
        """
        since = slice(*np.searchsorted(self.times, (begin, begin + duration)))
        times = self.times[since] - begin
        chosen = choose_instants(times, duration)
        return times[chosen], self.poses[since][chosen]

    def trouble(self, start: float, end: float) -> str | None:
        """Return the reason why the stretch from ``start`` to ``end`` is unusable, or None."""
        first = max(int(np.searchsorted(self.times, start, side="right")) - 1, 0)
        last = int(np.searchsorted(self.times, end, side="left"))
        if (np.diff(self.times[first : last + 1]) > self.settings.longest_gap).any():
            return "lost track"
        return "jump" if self._jumps[first:last].any() else None


def fit_pose(times: NDArray, poses: NDArray) -> NDArray:
    """Fit motion of constant twist by least squares and return its pose at time 0.

    With a heading linear in time, position is p + g(t) u in the complex plane with
    g(t) = (exp(i omega t) - 1) / (i omega), linear in the unknowns p and u.

    Args:
        times: (N,) s, at least two different ones.
        poses: (N, 3) with unwrapped headings.
    """
    rate, heading = _line(times, poses[:, 2])
    half = rate * times / 2.0
    travelled = times * np.exp(1j * half) * np.sinc(half / np.pi)
    _, place = _line(travelled, poses[:, 0] + 1j * poses[:, 1])
    return np.array([place.real, place.imag, heading])


def _line(x: NDArray, y: NDArray) -> tuple[Any, Any]:
    """Return slope and intercept of a least-squares line, of real or complex numbers."""
    mean_x, mean_y = x.mean(), y.mean()
    centred = x - mean_x
    slope = np.vdot(centred, y - mean_y) / np.vdot(centred, centred).real
    return slope, mean_y - slope * mean_x


def displacements(
    recording: Recording,
    settings: Settings | None = None,
    *,
    correct_delay: bool = True,
    doubtful: bool = False,
) -> Displacements:
    """Compute the displacement of every complete command of a tracked recording.

    The motors go from one command straight into the next, so a command's displacement runs
    from its own time to the time of the next line that was sent to the motors. Both times are later
    by the session's motor delay, if it is certain enough.

    Args:
        recording: a tracked recording.
        settings: how displacements are taken.
        correct_delay: whether the motors' delay counts.
        doubtful: whether doubtful poses count, too.

    Raises:
        FileError: if commands.csv or poses.csv is missing, wrong somewhere, or its clock goes
            backwards.
    """
    settings = settings or Settings()
    lines = [line for line in recording.commands().itertuples() if line.is_motor]
    every = recording.poses()
    poses = every if doubtful else every.certain()
    tracks = {
        int(session): _track(poses.of_session(session), settings)
        for session in np.unique(poses.session)
    }
    left = {session: every.of_session(session) for session in tracks if not doubtful}
    result = Displacements()
    for session in tracks:
        own, driven = poses.of_session(session), [x for x in lines if x.session == session]
        delay = motion_delay(own.time, own.pose, driven)
        if delay is None:
            continue
        result.delays[session] = delay
        certain = abs(delay.delay) > SIGNIFICANT * delay.sd and delay.answers >= FEWEST_ANSWERS
        if correct_delay and certain:
            result.corrected.add(session)
    # The last command may be shown to its end by no picture.
    seen = {session: track.last_time for session, track in tracks.items()}
    commands = (line for line in lines if line.kind == "command")
    after = (x.session for x in commands if x.time > seen.get(x.session, -np.inf))
    result.untracked = {session: count for session, count in Counter(after).items() if count > 1}
    late = {session: result.delays[session].delay for session in result.corrected}
    attempts: Counter[int | None] = Counter()
    takes, names = recording.takes, recording.takes.names
    for place, line in enumerate(lines):
        if line.kind != "command":
            continue
        before, after = _neighbour(lines, place, -1), _neighbour(lines, place, +1)
        reason = _not_completed(line, after, settings)
        fate = {None: "completed", "cut": "cut"}.get(reason, "other")
        planned = {**dict(zip(names, line.numbers, strict=True)), "duration": line.duration}
        attempts[line.command] += 1
        commanded = {"forward": line.forward, "turn": line.turn}
        result.sent.append(
            {**planned, **commanded, "fate": fate, "attempt": attempts[line.command]}
        )
        if reason is None:
            shown = (
                None if x is None else x._replace(time=x.time + late.get(line.session, 0.0))
                for x in (before, line, after)
            )
            taken = _displacement(tracks.get(line.session), *shown, settings)
            if isinstance(taken, str):
                reason = taken
                if line.session in left and _any_doubtful(left[line.session], line, after):
                    reason = "doubtful"
            else:
                # A session begins with the robot standing.
                previous = takes.rest() if before is None else before.numbers
                result.rows.append(
                    {
                        "command": line.command,
                        **{f"prev_{x}": v for x, v in zip(names, previous, strict=True)},
                        **planned,
                        **taken,
                    }
                )
        if reason is not None:
            result.left_out[reason] += 1
    return result


def _any_doubtful(poses: Poses, line: CommandLine, after: CommandLine) -> bool:
    """Return whether any pose of a command that ``after`` ended was left out as doubtful."""
    rows = slice(*np.searchsorted(poses.time, (line.time, after.time)))
    return bool(poses.doubtful[rows].any())


def _track(poses: Poses, settings: Settings) -> Track:
    return Track(poses.time, poses.pose, poses.quality, settings)


def _neighbour(lines: list[CommandLine], place: int, step: int) -> CommandLine | None:
    other = place + step
    if 0 <= other < len(lines) and lines[other].session == lines[place].session:
        return lines[other]
    return None


def _not_completed(line: CommandLine, after: CommandLine | None, settings: Settings) -> str | None:
    if after is None:
        return "incomplete"
    if after.kind == "cut":
        return "cut"
    late = after.time - line.time - line.duration
    if abs(late) <= settings.timing:
        return None
    stopped_early = late < 0 and after.kind == "stop"
    return "incomplete" if stopped_early else "clock"


def _displacement(
    track: Track | None,
    before: CommandLine | None,
    line: CommandLine,
    after: CommandLine,
    settings: Settings,
) -> dict[str, Any] | str:
    """Return a completed command's dx, dy, dtheta, quality, within, or why there are none."""
    if track is None or track.last_time < after.time:
        return "incomplete"
    steady = before.time + settings.settling if before is not None else -np.inf
    start = track.pose_at(line.time, steady)
    end = track.pose_at(after.time, line.time + settings.settling)
    if start is None or end is None:
        return "lost track"
    trouble = track.trouble(line.time, after.time)
    if trouble is not None:
        return trouble
    dx, dy, dtheta = (float(value) for value in se2.between(start[0], end[0]))
    # In its row, a command that was held too long ends at its planned time.
    times, poses = track.within(line.time, min(line.duration, after.time - line.time))
    return {
        "dx": dx,
        "dy": dy,
        "dtheta": dtheta,
        "quality": min(start[1], end[1]),
        "start": start[0],
        "within": poses_within(times, start[0], poses),
    }
