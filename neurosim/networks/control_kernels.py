"""A network at every step of a trial, compiled for the loops of the simulators.

The functions compute the same as :meth:`neurosim.controllers.Controller.act` and
:func:`neurosim.controllers.base.observe`, which work on batches of tensors.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from neurosim.base.kernels import kernel
from neurosim.base.trajectory import Episode
from neurosim.networks.control import (
    CTRNN,
    FEED_FORWARD,
    OF_GOALS,
    POLAR_INPUTS,
    NetworkArrays,
    input_sources,
)

#: Sources of the inputs that are the heading's cosine and sine.
_TURNED = input_sources(("cos_heading", "sin_heading", *OF_GOALS), ())
_POLAR = input_sources(POLAR_INPUTS, ())

#: Sums keep their order, so that the same genes give the same commands in every simulator.
_MATHS = {"contract", "nsz"}


class Pilot(NamedTuple):
    """A family of controllers and their trial, as numbers.

    A controller is open-loop, with commands known in advance, or a network.
    """

    open_loop: bool  #: whether the controller is open-loop
    commands: np.ndarray  #: [P, T, C] of open-loop ones
    given: np.ndarray  #: [P, T] bool; a command that is not given does not change the robot's state
    length: int  #: steps of a trial, including the stop at its end
    reads: int  #: first step in which sensors are read
    source: np.ndarray  #: [I] of the inputs, see :func:`neurosim.networks.control.input_sources`
    hidden: np.ndarray  #: this and the next two as in NetworkArrays
    scale: np.ndarray
    recurrence: int
    polar: bool  #: whether the goal's polar coordinates are needed
    turned: bool  #: whether the cosine and sine of the heading are needed
    goals: np.ndarray  #: [N, 4] x, y, cosine and sine of the heading; N = 0: there are none
    reach: float  #: as in Episode, like the next three
    step: float
    steps: int
    rest: float
    drawn: int = 0  #: number of steps whose noise comes before that of the first


def open_loop(commands: np.ndarray, given: np.ndarray, reads: int) -> Pilot:
    """Return the pilot of open-loop controllers; arguments as in :class:`Pilot`."""
    none = np.empty(0, np.int64)
    return Pilot(
        open_loop=True,
        commands=np.ascontiguousarray(commands, np.float64),
        given=np.ascontiguousarray(given, np.bool_),
        length=given.shape[1],
        reads=reads,
        source=none,
        hidden=none,
        scale=np.empty(commands.shape[2] - 1),
        recurrence=FEED_FORWARD,
        polar=False,
        turned=False,
        goals=np.empty((0, 4)),
        reach=0.0,
        step=0.0,
        steps=0,
        rest=0.0,
    )


def closed_loop(net: NetworkArrays, source: np.ndarray, episode: Episode, reads: bool) -> Pilot:
    """Return the pilot of networks.

    Args:
        net: the networks.
        source: of their inputs, as in :class:`Pilot`.
        episode: the trial.
        reads: whether sensors are read.
    """
    goals = np.empty((0, 3)) if episode.goals is None else np.asarray(episode.goals, np.float64)
    x, y, heading = goals.reshape(-1, 3).T
    length = episode.steps + (episode.rest > 0)
    return Pilot(
        open_loop=False,
        commands=np.empty((0, 0, 0)),
        given=np.empty((0, 0), np.bool_),
        length=length,
        reads=0 if reads else length,
        source=source,
        hidden=net.hidden,
        scale=net.scale,
        recurrence=net.recurrence,
        polar=bool(np.isin(source, _POLAR).any()),
        turned=bool(np.isin(source, _TURNED).any()),
        goals=np.stack([x, y, np.cos(heading), np.sin(heading)], axis=1),
        reach=float(episode.reach),
        step=float(episode.step),
        steps=int(episode.steps),
        rest=float(episode.rest),
    )


def units_of(pilot: Pilot) -> int:
    """Return the number of units' values that :func:`act` needs."""
    kept = 1 if pilot.recurrence == FEED_FORWARD else 3
    return len(pilot.source) + kept * int(pilot.hidden.sum())


@kernel(fastmath=_MATHS, inline="always")
def observe(pilot, x, y, theta, goal, time, readings, seen):
    """Write a network's observations; return the index of the next goal.

    Args:
        pilot: :class:`Pilot`.
        x, y, theta: pose, m, m, rad.
        goal: the index of the last step's next goal.
        time: since the start, s.
        readings: [S] of sensors.
        seen: [I], written.
    """
    cos, sin = 1.0, 0.0
    if pilot.turned:
        cos, sin = math.cos(theta), math.sin(theta)
    ahead, left, goal_cos, goal_sin = 0.0, 0.0, 1.0, 0.0
    if len(pilot.goals) > 0:
        dx, dy = pilot.goals[goal, 0] - x, pilot.goals[goal, 1] - y
        if goal + 1 < len(pilot.goals) and math.sqrt(dx * dx + dy * dy) <= pilot.reach:
            goal += 1
            dx, dy = pilot.goals[goal, 0] - x, pilot.goals[goal, 1] - y
        ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
        goal_cos = pilot.goals[goal, 2] * cos + pilot.goals[goal, 3] * sin
        goal_sin = pilot.goals[goal, 3] * cos - pilot.goals[goal, 2] * sin
    distance, bearing, approach = 0.0, 0.0, 0.0
    if pilot.polar:
        side = 1.0 if ahead >= 0.0 else -1.0
        distance = side * math.sqrt(ahead * ahead + left * left)
        bearing = math.atan2(side * left, side * ahead)
        approach = math.atan2(goal_sin, goal_cos) - bearing
        approach -= 2.0 * math.pi * math.floor(approach / (2.0 * math.pi) + 0.5)
    known = (x, y, cos, sin, ahead, left, goal_cos, goal_sin, time, distance, bearing, approach)
    for i in range(len(pilot.source)):
        source = pilot.source[i]
        seen[i] = readings[source] if source >= 0 else known[-1 - source]
    return goal


@kernel(fastmath=_MATHS, inline="always")
def _sum(genes, first, values, at, count):
    """Return the sum of a unit: its row of genes begins at ``first``, its inputs at ``at``."""
    total = genes[first + count]
    for i in range(count):
        total += genes[first + i] * values[at + i]
    return total


@kernel(fastmath=_MATHS, inline="always")
def _tanh(x, scale):
    """Return scale tanh(x); the library's own takes twice as long."""
    return scale - 2.0 * scale / (math.exp(2.0 * x) + 1.0)


@kernel(fastmath=_MATHS, forceinline=True)
def act(pilot, genes, values, command):
    """Write a network's commands.

    Args:
        pilot: :class:`Pilot`.
        genes: [G] of an individual.
        values: [V] of the units, zeros at the start; see :func:`units_of`. The first are the
            inputs; the rest is written, and is the memory of recurrent networks.
        command: [C or more], written: the first C.
    """
    hidden, scale, recurrence = pilot.hidden, pilot.scale, pilot.recurrence
    inputs = len(pilot.source)
    at, count, first = 0, inputs, 0
    if recurrence == FEED_FORWARD:
        for layer in range(len(hidden)):
            after = at + count
            for u in range(hidden[layer]):
                values[after + u] = _tanh(_sum(genes, first, values, at, count), 1.0)
                first += count + 1
            at, count = after, hidden[layer]
    else:
        # Inputs, the hidden units' tanh, their states, and their targets.
        count = hidden[0]
        if recurrence == CTRNN:
            first = count
        for u in range(count):
            values[inputs + 2 * count + u] = _sum(genes, first, values, 0, inputs + count)
            first += inputs + count + 1
        for u in range(count):
            alpha, own = 1.0, inputs + count + u
            if recurrence == CTRNN:
                alpha = 1.0 / (1.0 + math.exp(genes[u]))
            values[own] += alpha * (values[own + count] - values[own])
            values[inputs + u] = _tanh(values[own], 1.0)
        at = inputs
    for c in range(len(scale)):
        command[c] = _tanh(_sum(genes, first, values, at, count), scale[c])
        first += count + 1
