"""The compiled trial loop: one for all simulators, controllers, environments and replanning.

It works with simulators that have compiled functions. Such a simulator has a ``NamedTuple`` of its
numbers, its *model*, and for models of that class two functions compiled by Numba
(:func:`compiled`):

    step(model, states, command, z, work)   changes the states of robots that obey one command
    sense(model, state, z, work, out)       writes the readings of one robot

:func:`drive` is the loop. It is compiled once for each class, with the functions of that class
instead of :func:`_step` and :func:`_sense`, and stored on disk. Functions given as arguments would
be compiled again in every session (Numba's issue 6264).

Robots with the same commands since the start are stepped together: values that depend on the
commands alone, such as a motion network's prediction, are computed once for all of them.
"""

from __future__ import annotations

import hashlib
import inspect
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from neurosim.base.compiled import njit
from neurosim.base.kernels import kernel
from neurosim.base.threads import ALONE, Pool, cores, on_cores, taken
from neurosim.base.trajectory import Draws, Episode, Trajectory, planned, stepped
from neurosim.base.waiting import show
from neurosim.networks.control import NOT_READINGS, input_sources
from neurosim.networks.control_kernels import Pilot, act, closed_loop, observe, open_loop, units_of
from neurosim.simulators.sampling import SampledRollouts, Stepper, began

#: Number of steps for which another core is worth starting.
_WORTH_SHARING = 100


class Functions(NamedTuple):
    """The functions of a class of models; see the module."""

    step: Callable[..., None]
    sense: Callable[..., None]
    scratch: Callable[..., Any]
    drive: Any  #: :func:`drive`, compiled for these


_FUNCTIONS: dict[type, Functions] = {}


def compiled(
    model: type,
    step: Callable[..., None],
    sense: Callable[..., None] | None = None,
    scratch: Callable[..., Any] | None = None,
) -> None:
    """Name the compiled functions of a class of models.

    Args:
        model: a ``NamedTuple``: arrays, numbers, booleans, and such tuples.
        step: see the module. ``states`` [N, S] float64 in the columns of the simulator's
            ``state_names`` are changed; of ``command`` [C] float64 the columns are the simulator's
            ``command_names``; ``z`` [N, Z] float32 are the numbers of the noise, [0, 0] without
            noise.
        sense: ``state`` [S]; ``z`` [Z], or [0]; ``out`` [R] float64. None: there are no sensors.
        scratch: a Python function, (model) -> ``work``, arrays to which ``step`` and ``sense`` may
            write, made once for many steps. None: an empty array.

    Example:
        >>> class Cart(NamedTuple):
        ...     speed: float  # m/s at 1 %
        >>> @njit
        ... def step(cart, states, command, z, work):
        ...     states[:, 0] += cart.speed * command[0] * command[1]
        >>> ns.compiled(Cart, step)  # for simulators whose compiled() returns a Cart
    """
    files = {Path(inspect.getfile(getattr(one, "py_func", one))) for one in (step, sense) if one}
    kept = all(file.exists() for file in files)  # not functions typed in by hand, as in a notebook
    sources = [model.__module__.encode(), model.__qualname__.encode()]
    sources += [file.read_bytes() for file in sorted(files)] if kept else []
    # Numba stores machine code under a function's name, with the types for which it was compiled.
    # Each class has its own loop, so that it does not need the modules of others, or an old source.
    name = f"drive_{hashlib.sha256(b' '.join(sources)).hexdigest()[:16]}"
    sense, scratch = sense or _no_readings, scratch or _no_scratch
    known = {**drive.__globals__, "_step": step, "_sense": sense}
    own = FunctionType(drive.__code__, known, name)
    own.__qualname__ = name
    # Counting references to arrays would take as long as the steps, so no arrays are made there.
    # For several cores see :func:`_on_cores`.
    options: dict[str, Any] = {"_nrt": False, "no_cfunc_wrapper": True, "nogil": True}
    loop = njit(cache=kept, error_model="numpy", **options)(own)
    _FUNCTIONS[model] = Functions(step, sense, scratch, loop)


def functions_of(model: Any) -> Functions:
    """Return the functions of a model.

    Raises:
        TypeError: if :func:`compiled` was not called for its class.
    """
    if type(model) not in _FUNCTIONS:
        raise TypeError(f"{type(model).__name__} has no compiled functions: name them first")
    return _FUNCTIONS[type(model)]


@kernel()
def _no_readings(model, state, z, work, out):
    pass


def _no_scratch(model: Any) -> NDArray:
    return np.empty(0)


def _step(model, states, command, z, work):
    """Take the place of the ``step`` of a class of models."""
    raise NotImplementedError


def _sense(model, state, z, work, out):
    """Take the place of the ``sense`` of a class of models."""
    raise NotImplementedError


class Room(NamedTuple):
    """The working memory of a core."""

    work: Any  #: of ``scratch``
    values: np.ndarray  #: of the network's units
    states: np.ndarray  #: [N, S] of the robots that are stepped together
    command: np.ndarray  #: [C]
    seen: np.ndarray  #: [R] readings
    no_noise: np.ndarray  #: [0]
    no_noises: np.ndarray  #: [0, 0]
    pool: Pool  #: of the groups


def drive(model, pilot, genes, begun, z, first, last, room, poses, commands, readings, ends):
    """Drive individuals through samples; :func:`compiled` compiles it for each class.

    Samples are driven in groups of ``room.states``; the groups of an individual follow each other.

    Args:
        model: of a class for which :func:`compiled` was called.
        pilot: :class:`~neurosim.networks.control_kernels.Pilot`, common to all individuals.
        genes: [P, G] of networks.
        begun: [1 or P, R, S] first states of the robots, for all individuals or for each.
        z: [1 or P, T, R, Z] float32, the noise of every step; T = 0: none. The readings before step
            k use the k-th, the n-th given command the n-th, both after ``pilot.drawn`` others.
        first, last: the driven groups, from the first to before the last; or those among which it
            takes free ones.
        room: :class:`Room`.
        poses: [P, R, T + 1, 3], written: before each step and after the last; empty: not kept.
        commands: [P, R, T, C], written: of networks, without the duration; T = 0: not kept.
        readings: [P, R, T, Q] float32, written: before each step from ``pilot.reads`` on; T = 0:
            not kept.
        ends: [P, R, S], written: the states after the last step.
    """
    pool, turn = room.pool, 0
    if pool.given > 0:
        show(pool.numbers, 0, pool.given)
    command, seen, values, together = room.command, room.seen, room.values, len(room.states)
    samples, width, columns = ends.shape[1], ends.shape[2], len(pilot.scale)
    parts = (samples + together - 1) // together
    posed, noted, kept = poses.shape[2] > 0, commands.shape[2] > 0, readings.shape[2] > 0
    noisy = z.shape[1] > 0
    group, stop = first, last
    if pool.parts > 1:
        group, stop, turn = taken(pool, last, turn)
    while group < stop:
        p, n = group // parts, group % parts * together
        here = room.states[: min(together, samples - n)]
        own, numbers = p if len(begun) > 1 else 0, p if len(z) > 1 else 0
        for r in range(len(here)):
            for i in range(width):
                here[r, i] = begun[own, n + r, i]
        values[:] = 0.0
        goal, sent = 0, pilot.drawn
        for k in range(pilot.length):
            if posed:
                for r in range(len(here)):
                    for i in range(3):
                        poses[p, n + r, k, i] = here[r, i]
            if k >= pilot.reads:
                for r in range(len(here)):
                    noise_here = z[numbers, pilot.drawn + k, n + r] if noisy else room.no_noise
                    _sense(model, here[r], noise_here, room.work, seen)
                    if kept:
                        for i in range(len(seen)):
                            readings[p, n + r, k - pilot.reads, i] = seen[i]
            given = True
            if pilot.open_loop:
                given = pilot.given[p, k]
                for c in range(pilot.commands.shape[2]):
                    command[c] = pilot.commands[p, k, c]
            elif k < pilot.steps:
                x, y, theta = here[0, 0], here[0, 1], here[0, 2]
                goal = observe(pilot, x, y, theta, goal, k * pilot.step, seen, values)
                act(pilot, genes[p], values, command)
                command[columns] = pilot.step
            else:
                command[:columns] = 0.0
                command[columns] = pilot.rest
            if noted:
                for c in range(columns):
                    commands[p, n, k, c] = command[c]
            if given:
                noise_here = z[numbers, sent, n : n + len(here)] if noisy else room.no_noises
                _step(model, here, command, noise_here, room.work)
                sent += 1
        for r in range(len(here)):
            if posed:
                for i in range(3):
                    poses[p, n + r, pilot.length, i] = here[r, i]
            for i in range(width):
                ends[p, n + r, i] = here[r, i]
        group += 1
        if group == stop and pool.parts > 1:
            group, stop, turn = taken(pool, last, turn)


def _on_cores(
    model: Any,
    works: list[Any],
    pilot: Pilot,
    genes: NDArray[np.float64],
    begun: NDArray[np.float64],
    z: NDArray[np.float32],
    together: int,
    *written: NDArray,
) -> None:
    """Drive all individuals through all samples, on all cores; arguments as in :func:`drive`.

    Args:
        model, pilot, genes, begun, z: see :func:`drive`.
        works: unused results of ``scratch`` for this model, changed.
        together: number of robots that are stepped together; 1 for networks.
        written: poses, commands, readings, ends.
    """
    functions, ends, readings = functions_of(model), written[-1], written[-2]
    groups = len(ends) * -(-ends.shape[1] // together)
    least = -(-_WORTH_SHARING // max(1, together * pilot.length))

    def part(first: int, last: int, pool: Pool = ALONE) -> None:
        try:
            work = works.pop()
        except IndexError:
            work = functions.scratch(model)
        room = Room(
            work,
            np.empty(units_of(pilot)),
            np.empty((together, ends.shape[2])),
            np.zeros(len(pilot.scale) + 1),
            np.zeros(readings.shape[3]),
            np.empty(0, np.float32),
            np.empty((0, 0), np.float32),
            pool,
        )
        functions.drive(model, pilot, genes, begun, z, first, last, room, *written)
        works.append(work)

    on_cores(functions.drive, part, groups, least, pooled=True)


class ThreadSafe:
    """Base of rollouts that several threads may run at once."""


class CompiledRollouts(SampledRollouts, ThreadSafe):
    """Rollouts of one kind of controller in a simulator with compiled functions."""

    def __init__(self, simulator: Any, controller: Any, episode: Episode):
        """Prepare the arrays of the controllers, which are open-loop or networks."""
        super().__init__(simulator, controller, episode)
        self._model, self._works = simulator.compiled(), list[Any]()
        names = simulator.reading_names
        reads = bool(names) and (
            episode.readings or any(name not in NOT_READINGS for name in controller.inputs)
        )
        self._reads = reads
        self._net: Pilot | None = None
        if not controller.open_loop:
            sources = input_sources(controller.inputs, names)
            self._net = closed_loop(controller.arrays(), sources, episode, reads)
        self._kept: dict[tuple[int, str], NDArray] = {}

    def run(self, genes: NDArray[np.float64], draws: Draws, *, reuse: bool = False) -> Trajectory:
        """Return the trajectories [P, R, ...] of individuals [P, G] through samples [R].

        Raises:
            ValueError: if the number of genes or of noise numbers is wrong.
        """
        if genes.ndim != 2 or genes.shape[1] != self._controller.genes:
            wanted = self._controller.genes
            raise ValueError(f"expected genes [P, {wanted}], got {list(genes.shape)}")
        pilot, rest, samples = self._net, self._episode.rest, len(draws)
        if pilot is None:
            commands, active = self._controller.commands(genes, rest)
            given = np.array(active)
            if rest > 0:
                given[:, -1] = True
            pilot = open_loop(commands, given, 0 if self._reads else given.shape[1])
        begun = began(self._simulator, draws)[None]
        noise = _as_steps(draws.noise, self._simulator, samples, pilot.length)
        together = 1
        if pilot.open_loop:  # the samples of a single plan are distributed to the cores
            together = -(-samples // cores()) if len(genes) == 1 else samples
        columns = 0 if pilot.open_loop else len(pilot.scale)
        poses, driven, readings = self._buffers(len(genes), samples, pilot.length, columns, reuse)
        ends = np.empty((len(genes), *begun.shape[1:]))
        genes = np.ascontiguousarray(genes, np.float64)
        written = poses, driven, readings, ends
        _on_cores(self._model, self._works, pilot, genes, begun, noise, together, *written)
        read = readings if self._reads else None
        if pilot.open_loop:
            trajectory = planned(poses, commands, active, rest)
            return replace(trajectory, readings=read)
        return stepped(poses, driven, read, self._episode)

    def _buffers(
        self, count: int, samples: int, steps: int, columns: int, reuse: bool
    ) -> list[NDArray]:
        """Return arrays [P, R, ...] for poses, commands and readings.

        New memory of tens of megabytes takes as long as the computation: with ``reuse`` the memory
        of this thread's previous run is used if it is large enough.
        """
        sensors = len(self._simulator.reading_names)
        shapes = {
            "poses": ((steps + 1, 3), np.float64),
            "commands": ((steps * (columns > 0), columns), np.float64),
            "readings": ((steps * self._reads, sensors), np.float32),
        }
        buffers = []
        for name, (each, dtype) in shapes.items():
            kept = self._kept.get(own := (threading.get_ident(), name))
            if not reuse or kept is None or len(kept) < count or kept.shape[1:] != (samples, *each):
                kept = np.empty((count, samples, *each), dtype)
                if reuse:
                    self._kept[own] = kept
            buffers.append(kept[:count])
        return buffers


class CompiledStepper(Stepper):
    """Steps batches in compiled code, on all cores; for one thread at a time."""

    def __init__(self, simulator: Any):
        super().__init__(simulator)
        self._model, self._works = simulator.compiled(), list[Any]()
        self._plans: dict[int, Pilot] = {}  # by their number of steps
        functions_of(self._model)  # raises an error if there are none

    def step(
        self, state: NDArray[np.float64], command: NDArray[np.float64], noise: NDArray | None
    ) -> NDArray[np.float64]:
        """Return the states [B, S] after commands [B, C]."""
        z = None if noise is None else noise[:, None]
        return self._drive(self._plan(command, 1), state, z)[0]

    def sense(self, state: NDArray[np.float64], noise: NDArray | None) -> NDArray:
        """Return the readings [B, R] in 0..1, float32."""
        commands = np.empty((len(state), 1, len(self.simulator.command_names)))
        pilot = open_loop(commands, np.zeros((len(state), 1), np.bool_), 0)
        return self._drive(pilot, state, None if noise is None else noise[:, None])[1]

    def step_and_sense(
        self,
        state: NDArray[np.float64],
        command: NDArray[np.float64],
        noises: NDArray | None,
        at: int = 0,
    ) -> tuple[NDArray[np.float64], NDArray]:
        """Return the states [B, S] after commands [B, C], and their readings [B, R], float32."""
        return self._drive(self._plan(command, 2)._replace(drawn=at), state, noises)

    def _plan(self, command: NDArray[np.float64], steps: int) -> Pilot:
        """Return a plan of a command; sensors are read before the null command that may follow."""
        rows = len(command)
        if steps not in self._plans or len(self._plans[steps].given) < rows:
            given = np.zeros((rows, steps), np.bool_)
            given[:, 0] = True
            self._plans[steps] = open_loop(np.zeros((rows, steps, command.shape[1])), given, 1)
        plan = self._plans[steps]
        commands = plan.commands[:rows]
        commands[:, 0] = command
        return plan._replace(commands=commands, given=plan.given[:rows])

    def _drive(
        self, pilot: Pilot, state: NDArray[np.float64], z: NDArray | None
    ) -> tuple[NDArray[np.float64], NDArray]:
        rows, sensors = len(state), len(self.simulator.reading_names)
        begun = np.ascontiguousarray(state, np.float64)[:, None]
        noise = np.empty((1, 0, 0, 0), np.float32)
        if z is not None:
            noise = np.ascontiguousarray(z, np.float32)[:, :, None]
        unused, ends = np.empty((rows, 1, 0, 3)), np.empty_like(begun)
        readings = np.empty((rows, 1, pilot.length - pilot.reads, sensors), np.float32)
        genes = np.empty((0, 0))
        written = unused, unused, readings, ends
        _on_cores(self._model, self._works, pilot, genes, begun, noise, 1, *written)
        return ends[:, 0], readings[:, 0, -1] if readings.shape[2] else readings[:, 0]


def _as_steps(
    noise: NDArray | None, simulator: Any, samples: int, steps: int
) -> NDArray[np.float32]:
    """Return noise [1, T, R, Z] for the loop from noise [R, T, Z]; T = 0: none.

    Raises:
        ValueError: if its shape is wrong, which compiled code does not check.
    """
    width = simulator.noise_width
    if noise is None:
        return np.empty((1, 0, 0, width), np.float32)
    if len(noise) != samples or noise.shape[1] < steps or noise.shape[2] < width:
        raise ValueError(f"expected noise [{samples}, {steps}, {width}], got {list(noise.shape)}")
    return np.ascontiguousarray(noise.transpose(1, 0, 2), np.float32)[None]
