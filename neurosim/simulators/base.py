"""The protocol of simulators."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from neurosim.base.errors import UserError, unwritten
from neurosim.base.perimeter import Perimeter
from neurosim.base.place import Place
from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.simulators.engine import CompiledRollouts, CompiledStepper
from neurosim.simulators.numbers import NORMAL, UNIFORM
from neurosim.simulators.numbers import numbers as random_numbers
from neurosim.simulators.sampling import Stepper

#: Version 2 has the members of an ensemble, 3 may have sensors in a motion network,
#: 8 has the place of tables, 10 a floor, 11 may have several cylinders and a light in tables, 12
#: has whether measured speeds count in a motion network, 13 two lags of its drift, 14 errors of
#: these speeds.
FORMAT, VERSION = "neurosim-simulator", 14

#: Values of :attr:`Simulator.noise_kind`.
NOISE_KINDS = {"uniform": UNIFORM, "normal": NORMAL}


#: Methods of simulators, and their arguments that have a row for each robot.
_OF_ROWS = {
    "start": ("pose",),
    "start_as": ("pose",),
    "step": ("state", "command"),
    "sense": ("state",),
    "over": ("state",),
    "seen": ("state", "before", "moved"),
}


@runtime_checkable
class InPlace(Protocol):
    """A simulator of a robot in a place that can be exchanged.

    Attributes:
        place: the place around the robot.
        bearings: direction of each sensor, [S] rad to the left; NaN for one that sees nothing.
    """

    place: Place

    @property
    def bearings(self) -> NDArray[np.float64]: ...

    def changed(self, *, place: Place = ..., noise: Any = ...) -> Simulator:
        """Return the simulator in another place, or with other noise."""
        ...


@runtime_checkable
class Sensing(Protocol):
    """A simulator with several kinds of sensors (senses), such as proximity and light.

    Attributes:
        senses: the senses that are read.
    """

    senses: tuple[str, ...]

    def changed(self, *, senses: tuple[str, ...] = ...) -> Simulator:
        """Return the simulator with other senses."""
        ...


@runtime_checkable
class Writable(Protocol):
    """A simulator that can be written."""

    def write(self, folder: str | Path) -> None:
        """Write the simulator as a new folder, whole or not at all."""
        ...


class Rollouts(Protocol):
    """Runs one kind of controller in a simulator, whole trials at once."""

    def draw(
        self,
        starts: NDArray[np.float64],
        rng: np.random.Generator | int,
        placing: tuple[float, float] | None = None,
    ) -> Draws:
        """Draw samples, one from each of ``starts`` [R, 3].

        Args:
            starts: poses where the robot is placed.
            rng: source of all random numbers, or a seed.
            placing: error in placing the robot: standard deviations in x and y (m) and in
                heading (rad). None: it is there already.
        """
        ...

    def run(self, genes: NDArray[np.float64], draws: Draws, *, reuse: bool = False) -> Trajectory:
        """Return the trajectories [P, R, ...] of individuals [P, G] through samples [R].

        Args:
            genes: a row for each individual.
            draws: of :meth:`draw`; one with ``starts`` alone gives the expected motion: no noise,
                the mean of the members.
            reuse: whether the arrays may be overwritten by the next run.
        """
        ...


class Simulator:
    """Predicts the state after a command, for a whole batch at once; subclass it.

    A simulator keeps no hidden state: all memory of a trajectory is in its ``state``. All
    simulators look the same to a controller. Only ``state_names``, ``command_names``,
    :meth:`start` and :meth:`step` must be given.

    Poses, states and commands have a row for each robot. They may be tensors, NumPy arrays or
    lists, of any type of number: a subclass gets tensors of its ``dtype``. If the first one is a
    tensor, a tensor is returned, else an array; both have the ``dtype``.

    Attributes:
        kind: its name in files.
        state_names: the columns of a state; the first three are x (m), y (m), theta (rad).
        command_names: the columns of a command; a ``duration`` (s), if any, is last.
        reading_names: names of the sensors that :meth:`sense` reads; none by default.
        notes: sentences for the user, such as about obstacles of a size that was not sampled.
        members: number of networks in an ensemble; a state may name one.
        has_noise: whether :meth:`step` or :meth:`sense` draws noise from a given generator.
        noise_width: if above 0, ``step`` and ``sense`` also take the random numbers of the noise,
            ``z`` [B, noise_width], instead of a generator.
        noise_kind: of these numbers: ``normal`` (standard) or ``uniform`` (-1 to 1).
        domain: lowest and highest value of each column of a command in its data, by name; a column
            without an entry has no limits.
        slack: commands may leave the domain by this fraction of its width.
        knows_gaps: whether :meth:`supported` knows gaps within the domain.
        radius: of the robot, m; None: unknown.
        perimeter: limits at which the guard ends drives on its robot; None: unknown, and no drive
            ends there.
        bearings: direction of each sensor, [S] rad to the left of straight ahead, NaN for one that
            sees nothing; None: unknown.
        dtype: type of its numbers.
        device: PyTorch's name of the device for arguments that are not tensors; tensors stay on
            their own.

    Example:
        >>> class Cart(ns.Simulator):
        ...     state_names, command_names = ("x", "y", "theta"), ("speed", "duration")
        ...
        ...     def start(self, pose, generator=None):
        ...         return pose
        ...
        ...     def step(self, state, command, generator=None):
        ...         after = state.clone()
        ...         after[:, 0] += command[:, 0] * command[:, 1]
        ...         return after
        >>> cart = Cart()
        >>> cart.step(cart.start([[0, 0, 0]]), [[0.5, 2]])
        array([[1., 0., 0.]])
    """

    kind: str = "simulator"
    state_names: tuple[str, ...]
    command_names: tuple[str, ...]
    reading_names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    members: int = 1
    has_noise: bool = False
    noise_width: int = 0
    noise_kind: str = "normal"
    radius: float | None = None
    perimeter: Perimeter | None = None
    slack: float = 0.05
    knows_gaps: bool = False
    dtype: torch.dtype = torch.float64
    device: str | torch.device = "cpu"

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for name in _OF_ROWS.keys() & vars(cls).keys():
            setattr(cls, name, _taking_arrays(name, vars(cls)[name]))

    @property
    def bearings(self) -> NDArray[np.float64] | None:
        return None

    @property
    def domain(self) -> Mapping[str, tuple[float, float]]:
        return {}

    @property
    def uncertain(self) -> bool:
        """Whether random samples differ, because of noise or of several members."""
        return self.has_noise or self.members > 1

    def supported(self, commands: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether commands [..., C] are like some in its data, [...].

        By default these are the commands within the domain; a simulator may know gaps.
        """
        supported = np.asarray(np.isfinite(commands).all(-1))
        for place, name in enumerate(self.command_names):
            low, high = _limits(self, name)
            supported &= (commands[..., place] >= low) & (commands[..., place] <= high)
        return supported

    def start(self, pose: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the states [B, S] of robots that stand still at ``pose`` [B, 3].

        With a generator, each robot's ensemble member is drawn.
        """
        raise unwritten(self, "start")

    def start_as(self, pose: Tensor, member: Tensor) -> Tensor:
        """Return the states [B, S] of robots with ensemble members [B], -1 for the mean."""
        return self.start(pose)

    def step(
        self, state: Tensor, command: Tensor, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return the states [B, S] after ``command`` [B, C] was carried out from ``state``.

        Noise is drawn only from a given generator; without one the result is the mean.
        """
        raise unwritten(self, "step")

    def sense(self, state: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the readings [B, len(reading_names)] in 0..1 of robots in ``state`` [B, S]."""
        raise UserError(f"{type(self).__name__} has no sensors: use a simulator that has")

    def noise_of(
        self,
        seeds: NDArray[np.uint64],
        steps: int,
        first: NDArray[np.int64] | None = None,
    ) -> NDArray[np.float32] | None:
        """Return the random numbers [R, steps, noise_width] of the samples' noise.

        It is None if the simulator draws its noise itself.

        Args:
            seeds: [R] of the samples.
            steps: number of steps.
            first: [R] number of the first step; by default 0.
        """
        if not self.noise_width:
            return None
        first = np.zeros(len(seeds), np.int64) if first is None else first
        return random_numbers(NOISE_KINDS[self.noise_kind], seeds, first, steps, self.noise_width)

    def standing(
        self, poses: NDArray[np.float64], member: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Return the states [B, S] of robots that stand still at poses [B, 3] (m, m, rad).

        Args:
            poses: poses of the robots.
            member: [B] ensemble member of each, -1 for the mean; None: the mean.
        """
        pose = torch.from_numpy(np.asarray(poses, np.float64))
        if member is None or self.members == 1:
            return self.start(pose).numpy()
        return self.start_as(pose, torch.from_numpy(member)).numpy()

    def over(self, state: Tensor) -> Tensor:
        """Return states [B, S] after the last command's end; the same command begins again."""
        return state

    def free_poses(self, count: int, rng: np.random.Generator) -> NDArray[np.float64] | None:
        """Return random poses [count, 3] at which the robot fits; None: there is no place."""
        return None

    def touching(self, poses: NDArray[np.float64], margin: float = 0.0) -> NDArray[np.bool_] | None:
        """Return whether a robot at poses [..., 3] touches something, or is this near (m), [...].

        It is None if there is nothing to touch.
        """
        return None

    def outline(self) -> list[dict[str, Any]]:
        """Return the shapes of the place for a picture, as a task's outline; [] for none."""
        return []

    def elsewhere(self, count: int, seed: int) -> Simulator:
        """Return this simulator in ``count`` other places, random from a seed.

        Raises:
            UserError: if it has no places.
        """
        raise UserError(
            f"a simulator of the kind {self.kind} has no arena, so there are no random arenas"
        )

    def conditions(self) -> dict[str, Any]:
        """Return settings that can differ from those in its file, such as its noise.

        They are saved with controllers that evolve in it, and must be the same on resume.
        """
        return {}

    def for_export(self, dtype: torch.dtype) -> Simulator:
        """Return this simulator computing in ``dtype``, for :mod:`neurosim.simulators.export`.

        Its step must be the same sequence of tensor operations for all arguments.

        Raises:
            UserError: if it is not the same.
        """
        raise UserError(
            f"a simulator of the kind {self.kind} cannot be exported, because the number of "
            "operations in its step depends on the robots' poses; a motion-network can"
        )

    def compiled(self) -> Any:
        """Return the model for compiled functions, a ``NamedTuple``; None: there is none.

        :func:`neurosim.simulators.engine.compiled` lists the functions of its class.
        """
        return None

    def stepper(self) -> Stepper:
        """Return a :class:`Stepper`: advances a batch, one random stream per robot."""
        return CompiledStepper(self) if self._runs_compiled else Stepper(self)

    @property
    def _runs_compiled(self) -> bool:
        """Whether there are compiled functions; they take noise, and do not draw it themselves."""
        given = self.noise_width > 0 or not self.has_noise
        return given and self.compiled() is not None

    def rollouts(self, controller: Any, episode: Episode) -> Rollouts | None:
        """Return compiled rollouts of a controller, if any; None: it is stepped.

        A test compares their results with :meth:`step`, for the same samples.
        """
        outputs = tuple(controller.outputs)
        timed = outputs if controller.open_loop else (*outputs, "duration")
        fits = self.command_names == timed or self.command_names == outputs
        drives = controller.open_loop or controller.arrays() is not None
        if not fits or not drives or not self._runs_compiled:
            return None
        return CompiledRollouts(self, controller, episode)


def _taking_arrays(name: str, method: Callable[..., Tensor]) -> Callable[..., Any]:
    """Return a method of simulators that also takes arrays and lists; see the class."""
    arguments = _OF_ROWS[name]

    @wraps(method)
    def taking(self: Simulator, *given: Any, **options: Any) -> Any:
        if getattr(type(self), name) is not taking:
            # Called by the method of a subclass, whose states may have more columns.
            return method(self, *given, **options)
        rows = list(given[: len(arguments)])
        rows += [options.pop(one) for one in arguments[len(rows) :] if one in options]
        pairs = zip(arguments, rows, strict=False)  # Python reports missing arguments itself
        tensors = [_tensor(self, name, argument, one) for argument, one in pairs]
        for one in (*given[len(arguments) :], options.get("generator")):
            if isinstance(one, np.random.Generator | np.random.RandomState):
                raise UserError("generator must be PyTorch's: torch.Generator().manual_seed(0)")
        result = method(self, *tensors, *given[len(arguments) :], **options)
        return result if isinstance(rows[0], Tensor) else result.detach().cpu().numpy()

    return taking


def _tensor(simulator: Simulator, method: str, argument: str, rows: ArrayLike | Tensor) -> Tensor:
    """Return rows [B, N] as a tensor for a simulator.

    Raises:
        UserError: if they are not numbers, or have another shape.
    """
    if not isinstance(rows, Tensor):
        try:
            rows = torch.from_numpy(np.array(rows, np.float64)).to(simulator.device)
        except (TypeError, ValueError):
            raise UserError(f"{argument} must be numbers, a row for each robot") from None
    place = ("x", "y", "heading")
    columns = {"pose": place, "moved": place, "command": simulator.command_names}
    names = columns.get(argument, tuple(simulator.state_names))
    # Readings may depend on the pose alone: then poses are accepted, too.
    wide = rows.ndim == 2 and (rows.shape[1] == len(names) or method == "sense")
    if not wide:
        more = " (start(pose) makes states)" if argument == "state" else ""
        raise UserError(
            f"{argument} must be [B, {len(names)}], for each robot a row of {', '.join(names)}"
            f"{more}, not of shape {list(rows.shape)}"
        )
    return rows if rows.dtype == simulator.dtype else rows.to(simulator.dtype)


def _limits(simulator: Simulator, name: str) -> tuple[float, float]:
    """Return the lowest and highest accepted command of a column.

    The largest recorded command is not quite the largest intended one.
    """
    low, high = simulator.domain.get(name, (-np.inf, np.inf))
    if not np.isfinite(high - low):
        return low, high
    more = simulator.slack * (high - low or max(abs(low), abs(high)))
    return low - more, high + more


def check_commands(simulator: Simulator, commands: NDArray, where: str = "commands") -> None:
    """Raise an error for commands [..., C] outside of the simulator's data.

    Raises:
        UserError: naming the first one that is not finite, has no duration, or is outside of the
            domain, and the domain.
    """
    names = simulator.command_names
    if commands.shape[-1] != len(names):
        raise UserError(
            f"{where} have {commands.shape[-1]} columns, but this simulator takes "
            f"{len(names)}: {', '.join(names)}"
        )
    flat = commands.reshape(-1, len(names))
    for place, name in enumerate(names):
        column = flat[:, place]
        low, high = simulator.domain.get(name, (-np.inf, np.inf))
        if name == "duration":
            low = max(low, 0.0)
        least, most = _limits(simulator, name)
        wrong = ~np.isfinite(column) | (column < least) | (column > most)
        if name == "duration":
            wrong |= column <= 0.0
        if wrong.any():
            at = np.unravel_index(int(wrong.argmax()), commands.shape[:-1])
            value, index = column[wrong.argmax()], "".join(f"[{i}]" for i in at)
            asked = f"{low:g} to {high:g}" if np.isfinite([low, high]).all() else "a finite number"
            raise UserError(
                f"{where}{index}: {name} = {value:g} lies outside of this simulator's data "
                f"({asked})"
            )
