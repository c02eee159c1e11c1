"""Trajectories of simulated and real robots, schedules of trials, and random samples."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Time after the last command until a robot is at rest, s; the motors are stopped meanwhile.
RUN_DOWN = 0.5


@runtime_checkable
class OfTime(Protocol):
    """A controller whose commands depend on time alone, so that it can give them all at once."""

    def over(self, genes: NDArray[np.float64], times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the commands [P, T, C] of individuals [P, G] at times [T] s."""
        ...


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses, commands and readings of robots; leading axes ``...`` are trials.

    A trajectory has T intervals, in each of which one command holds. In a simulation an interval is
    a command. For a filmed robot it is the time between two frames, so that several intervals may
    belong to one command.

    Attributes:
        poses: [..., T + 1, 3] x (m), y (m), heading (rad, unwrapped) in the board's frame, before
            the first interval and after each; None if they were not observed.
        commands: [..., T, C] as the controller gave them; the columns of motor commands are left
            and right (% of full speed) and, where a controller chooses it, the duration (s).
        durations: [..., T] of the intervals, s, or one for all.
        readings: [..., T, S] of the sensors at the beginning of each interval, 0..1, or None.
        active: [..., T] bool, whether an interval belongs to a command of the controller: not a
            null command, nor the motors running down at the end. None: all do.
        segment: [T] the index of the command that each interval belongs to, never decreasing;
            None: each is a command of its own.
        touching: [..., T] bool, whether the robot touches something after each interval; None:
            unknown.

    Raises:
        ValueError: if the shapes do not fit each other.

    Example:
        >>> path = ns.Trajectory(np.zeros((3, 3)), np.zeros((2, 3)), durations=0.5)
        >>> path.times
        array([0. , 0.5, 1. ])
    """

    poses: NDArray[np.float64] | None
    commands: NDArray
    durations: NDArray[np.float64] | float
    readings: NDArray | None = None
    active: NDArray[np.bool_] | None = None
    segment: NDArray[np.int64] | None = None
    touching: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        *shape, intervals, _ = self.commands.shape
        self._check("poses", (*shape, intervals + 1, 3))
        if self.readings is not None:
            self._check("readings", (*shape, intervals, self.readings.shape[-1]))
        self._check("active", (*shape, intervals))
        self._check("touching", (*shape, intervals))
        self._check("segment", (intervals,))

    def _check(self, name: str, expected: tuple[int, ...]) -> None:
        value = getattr(self, name)
        if value is not None and tuple(value.shape) != expected:
            raise ValueError(f"expected {name} {expected}, not {tuple(value.shape)}")

    @property
    def shape(self) -> tuple[int, ...]:
        """The leading axes."""
        return self.commands.shape[:-2]

    @property
    def times(self) -> NDArray[np.float64]:
        """Return the times of the poses since the start, s, [..., T + 1]."""
        each = np.broadcast_to(self.durations, self.commands.shape[:-1])
        return np.concatenate([np.zeros_like(each[..., :1]), np.cumsum(each, axis=-1)], axis=-1)

    @classmethod
    def of_track(
        cls,
        times: ArrayLike,
        poses: ArrayLike,
        segment: ArrayLike,
        commands: ArrayLike,
        active: ArrayLike | None = None,
        readings: ArrayLike | None = None,
    ) -> Trajectory:
        """Return one driven trajectory from all observed poses.

        A command during which no pose was seen still is a command: it gets an interval on the
        spot. An interval belongs to the command in which it ends.

        Args:
            times: [M] of the poses, s, rising.
            poses: [M, 3], finite.
            segment: [M] never decreasing: the index of the command during which each was seen.
            commands: [K, C] as they were sent.
            active: [K] bool; False for a command that the controller did not give.
            readings: [K, S] when each command was sent, or None.

        Raises:
            ValueError: if there is no pose, or the lengths do not fit.
        """
        times, poses = np.asarray(times, np.float64), np.asarray(poses, np.float64)
        segment, commands = np.asarray(segment), np.asarray(commands)
        if len(poses) == 0 or not len(poses) == len(segment) == len(times):
            raise ValueError("expected at least one pose, and a time and a segment for each")
        silent = np.setdiff1d(np.arange(len(commands)), segment[1:])
        order = np.argsort(np.concatenate([segment[1:], silent]), kind="stable")
        steps = np.concatenate([segment[1:], silent])[order]
        seen = np.concatenate([np.arange(1, len(poses)), np.full(len(silent), -1)])[order]
        arrivals = np.maximum.accumulate(np.concatenate([[0], seen]))
        return cls(
            poses=poses[arrivals],
            commands=commands[steps],
            durations=np.diff(times[arrivals]),
            readings=None if readings is None else np.asarray(readings)[steps],
            active=None if active is None else np.asarray(active, np.bool_)[steps],
            segment=steps,
        )


@dataclass(frozen=True, eq=False)
class Tracked:
    """The result of a trial in reality with tracked poses.

    Attributes:
        fitness: the higher the better.
        poses: [K, 3] (m, m, rad) after each of the K steps of the task's trial, as if it had begun
            exactly at the task's start; NaN where the robot was not seen.
    """

    fitness: float
    poses: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Episode:
    """The parts of a trial that simulators need.

    Attributes:
        step: time between two commands of a closed-loop controller, s.
        steps: number of these commands.
        rest: duration of the stop at the end, s; 0: the trial ends while the robot moves.
        goals: [N, 3] poses to reach in turn, or None; a controller may get the position of the next
            one.
        reach: distance within which a goal counts as reached, and the next one follows, m.
        readings: whether the fitness needs the sensors' readings.
        contacts: whether the fitness needs the times at which the robot touches something.
        circle: distance from the start at which a trial ends, m; 0: it does not.

    Example:
        >>> ns.Episode(step=0.1, steps=50).steps
        50
    """

    step: float = 0.1
    steps: int = 300
    rest: float = 0.0
    goals: NDArray[np.float64] | None = None
    reach: float = 0.05
    readings: bool = False
    contacts: bool = False
    circle: float = 0.0


@dataclass(frozen=True, eq=False)
class Draws:
    """Random samples that are the same for every controller (common random numbers).

    Attributes:
        starts: [R, 3] first poses of the robot (m, m, rad, board frame).
        member: [R] index of the simulator's ensemble member, -1 for the mean; None if a simulator
            has no members.
        noise: [R, T, Z] numbers for the noise of every step, as the simulator's ``step`` and
            ``sense`` take them; None without noise, or if it comes from ``seeds``.
        seeds: [R] uint64 of a simulator that draws its noise itself, or None.
        state: [S] of the simulator, for a robot that is moving: every sample continues from this
            state, with the pose and the member above; the previous command has ended. None: the
            robot stands still.
    """

    starts: NDArray[np.float64]
    member: NDArray[np.int64] | None = None
    noise: NDArray[np.float64] | None = None
    seeds: NDArray[np.uint64] | None = None
    state: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.starts)


def planned(poses: NDArray, commands: NDArray, active: NDArray, rest: float) -> Trajectory:
    """Return the trajectories of plans.

    Args:
        poses: [P, R, T + 1, 3].
        commands: [P, T, 3]; the last column is the duration, s.
        active: [P, T].
        rest: duration of the last command where it is the stop, s; 0: there is none.
    """
    durations = np.where(active, commands[..., -1], 0.0)
    if rest > 0:
        durations[:, -1] = rest
    shape = (*poses.shape[:2], commands.shape[1])
    return Trajectory(
        poses,
        np.broadcast_to(commands[:, None], (*shape, commands.shape[2])),
        np.broadcast_to(durations[:, None], shape),
        active=np.broadcast_to(active[:, None], shape),
    )


def stepped(
    poses: NDArray, commands: NDArray, readings: NDArray | None, episode: Episode
) -> Trajectory:
    """Return the trajectories of closed-loop controllers.

    Args:
        poses: [P, R, T + 1, 3].
        commands: [P, R, T, C], without the duration.
        readings: [P, R, T, S], or None.
        episode: the trial.
    """
    durations: float | NDArray = episode.step
    active, shape = None, commands.shape[:-1]
    if episode.rest > 0:
        each = np.append(np.full(episode.steps, episode.step), episode.rest)
        durations = np.broadcast_to(each, shape)
        active = np.broadcast_to(np.arange(shape[-1]) < episode.steps, shape)
    return Trajectory(poses, commands, durations, readings, active)
