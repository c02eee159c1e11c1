"""What a network does at every step of a trial, compiled: for the loops of the simulators.

They compute what :meth:`neurosim.controllers.Controller.act` and
:func:`neurosim.controllers.base.observe` do for batches of tensors.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from neurosim.base.trajectory import Episode
from neurosim.networks.control import (
    CTRNN,
    FEED_FORWARD,
    OF_GOALS,
    POLAR_INPUTS,
    NetworkArrays,
    input_sources,
)

#: Inputs, as their sources, that take the heading's cosine and sine.
_TURNED = input_sources(("cos_heading", "sin_heading", *OF_GOALS), ())
_POLAR = input_sources(POLAR_INPUTS, ())

#: Sums keep their order: the same genes give the same commands in every simulator.
_MATHS = {"contract", "nsz"}


class Loop(NamedTuple):
    """A family of networks and the trial that they are in, as numbers."""

    source: np.ndarray  #: [I] of the inputs, see :func:`neurosim.networks.control.input_sources`
    hidden: np.ndarray  #: this and the next two as in NetworkArrays
    scale: np.ndarray
    recurrence: int
    turned: bool  #: whether the cosine and sine of the heading are needed
    polar: bool  #: whether the goal's polar coordinates are needed
    goals: np.ndarray  #: [N, 4] x, y, cosine and sine of the heading; N = 0: there are none
    reach: float  #: as in Episode, like the next three
    step: float
    steps: int
    rest: float


def make_loop(net: NetworkArrays, source: np.ndarray, episode: Episode) -> Loop:
    """Return what the kernels compute with."""
    goals = np.empty((0, 3)) if episode.goals is None else np.asarray(episode.goals, np.float64)
    x, y, heading = goals.reshape(-1, 3).T
    return Loop(
        source,
        net.hidden,
        net.scale,
        net.recurrence,
        bool(np.isin(source, _TURNED).any()),
        bool(np.isin(source, _POLAR).any()),
        np.stack([x, y, np.cos(heading), np.sin(heading)], axis=1),
        float(episode.reach),
        float(episode.step),
        int(episode.steps),
        float(episode.rest),
    )


def room(loop: Loop) -> int:
    """Return how many values of units :func:`act` works with."""
    kept = 1 if loop.recurrence == FEED_FORWARD else 3
    return len(loop.source) + kept * int(loop.hidden.sum())


@njit(cache=True, fastmath=_MATHS, error_model="numpy", inline="always")
def observe(loop, x, y, cos, sin, goal, time, readings, seen):
    """Write what a network observes; return the index of the next goal.

    Args:
        loop: :class:`Loop`.
        x, y: position, m.
        cos, sin: of the heading.
        goal: the index of the goal that was the next one so far.
        time: since the start, s.
        readings: [S] of sensors.
        seen: [I], written.
    """
    ahead, left, goal_cos, goal_sin = 0.0, 0.0, 1.0, 0.0
    if len(loop.goals) > 0:
        dx, dy = loop.goals[goal, 0] - x, loop.goals[goal, 1] - y
        if goal + 1 < len(loop.goals) and math.sqrt(dx * dx + dy * dy) <= loop.reach:
            goal += 1
            dx, dy = loop.goals[goal, 0] - x, loop.goals[goal, 1] - y
        ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
        goal_cos = loop.goals[goal, 2] * cos + loop.goals[goal, 3] * sin
        goal_sin = loop.goals[goal, 3] * cos - loop.goals[goal, 2] * sin
    distance, bearing, approach = 0.0, 0.0, 0.0
    if loop.polar:
        side = 1.0 if ahead >= 0.0 else -1.0
        distance = side * math.sqrt(ahead * ahead + left * left)
        bearing = math.atan2(side * left, side * ahead)
        approach = math.atan2(goal_sin, goal_cos) - bearing
        approach -= 2.0 * math.pi * math.floor(approach / (2.0 * math.pi) + 0.5)
    known = (x, y, cos, sin, ahead, left, goal_cos, goal_sin, time, distance, bearing, approach)
    for i in range(len(loop.source)):
        source = loop.source[i]
        seen[i] = readings[source] if source >= 0 else known[-1 - source]
    return goal


@njit(cache=True, fastmath=_MATHS, error_model="numpy", inline="always")
def _sum(genes, first, values, at, count):
    """Return the sum of a unit: its row of genes begins at ``first``, its inputs at ``at``."""
    total = genes[first + count]
    for i in range(count):
        total += genes[first + i] * values[at + i]
    return total


@njit(cache=True, fastmath=_MATHS, error_model="numpy", inline="always")
def _tanh(x, scale):
    """Return scale tanh(x); the library's own takes twice as long."""
    return scale - 2.0 * scale / (math.exp(2.0 * x) + 1.0)


@njit(cache=True, fastmath=_MATHS, error_model="numpy", forceinline=True)
def act(hidden, scale, recurrence, inputs, genes, values, command):
    """Write what a network commands.

    Args:
        hidden, scale, recurrence, inputs: as in NetworkArrays.
        genes: [G] of an individual.
        values: [V] of the units, zeros at first; see :func:`room`. The first are the inputs, the
            rest is written, and remembered by recurrent networks.
        command: [C or more], written: the first C.
    """
    at, count, first = 0, inputs, 0
    if recurrence == FEED_FORWARD:
        for layer in range(len(hidden)):
            after = at + count
            for u in range(hidden[layer]):
                values[after + u] = _tanh(_sum(genes, first, values, at, count), 1.0)
                first += count + 1
            at, count = after, hidden[layer]
    else:
        # Inputs, the hidden units' tanh, what they are, and what they tend to.
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
