"""What every simulator offers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.errors import UserError
from neurosim.base.schema import Rows, Shape
from neurosim.base.trajectory import Draws, Episode, Trajectory
from neurosim.simulators import numbers

#: Version 2 has the members of an ensemble, 3 may have sensors in a motion network.
FORMAT, VERSION = "neurosim-simulator", 3
_SOURCE = {"path?": str, "name?": str, "dataset?": str, "sha256?": str, "virtual?": bool}
_OUTPUTS = ("dx", "dy", "dtheta")
#: What simulator.json of any kind may say of where the simulator is from and how good it is.
ABOUT: dict[str, Shape] = {
    "kind": str,
    "inputs?": [{"name": str, "unit?": str}],
    "outputs?": [{"name": str, "unit?": str}],
    "training?": {"held_out?": float},
    "history?": [{"generation": float, "mse": Rows(None)}],
    "test_errors?": {key: {"mse": float, "mean_absolute_error": float} for key in _OUTPUTS},
    "source?": (_SOURCE, [_SOURCE]),
    "sources?": [_SOURCE],
    "wall_clock?": {"training_seconds?": float},
    "composition?": {
        "actuators": {str: {str: float}},
        "delay": float,
        "product_units": Rows(3),
        "kernel_units": int,
        "shares": {key: {"product_units": float, "process": float} for key in _OUTPUTS},
    },
    "readings?": {
        "rows": int,
        "held_out": int,
        "sensors": [
            {
                "name": str,
                **dict.fromkeys(("ahead", "aside", "after", "noise", "place_noise"), float),
                **dict.fromkeys(("rms_error", "rms"), float),
                "map": int,
            }
        ],
    },
    "robots?": [{"kind?": str, "virtual?": bool}],
    "virtual?": bool,
}

#: How well a person puts a robot down at a mark: standard deviations in x and y (m), heading (rad).
PLACING = (0.003, float(np.radians(0.5)))


class Rollouts(Protocol):
    """Runs one kind of controller in a simulator, whole trials at once."""

    def draw(
        self,
        starts: NDArray[np.float64],
        rng: np.random.Generator | int,
        placing: tuple[float, float] | None = None,
    ) -> Draws:
        """Draw outcomes, one from each of ``starts`` [R, 3].

        Args:
            starts: poses where the robot is put down.
            rng: source of all that is drawn, or a seed.
            placing: the robot is put down that exactly: standard deviations in x and y (m) and in
                heading (rad). None: it stands there already.
        """
        ...

    def run(self, genes: NDArray[np.float64], draws: Draws, *, reuse: bool = False) -> Trajectory:
        """Return the trajectories [P, R, ...] of individuals [P, G] through outcomes [R].

        Args:
            genes: a row for each individual.
            draws: of :meth:`draw`; one that was made with ``starts`` alone stands for what the
                simulator expects: no noise, the mean of the members.
            reuse: whether the arrays may be overwritten by the next run.
        """
        ...


class Stepper:
    """Steps whole batches in NumPy, each row with random numbers of its own.

    It asks the simulator's own :meth:`Simulator.step` and :meth:`Simulator.sense`; what is
    compiled is a subclass, held to this one by a test. What a row meets follows from its own seed
    and step alone, however many other rows there are.

    Attributes:
        simulator: whose steps they are.
        worth_sharing: from so many rows on, sharing them out to several cores pays.
    """

    worth_sharing: int = 0

    def __init__(self, simulator: Simulator):
        self.simulator = simulator

    def start(
        self, poses: NDArray[np.float64], member: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Return the states [B, S] of robots that stand still at poses [B, 3] (m, m, rad).

        Args:
            poses: where they stand.
            member: [B] which member of an ensemble each moves as, -1 for the mean; None: the mean.
        """
        pose = torch.from_numpy(np.asarray(poses, np.float64))
        if member is None or self.simulator.members == 1:
            return self.simulator.start(pose).numpy()
        return self.simulator.start_as(pose, torch.from_numpy(member)).numpy()

    def noise(self, seeds: NDArray[np.uint64], steps: NDArray[np.int64]) -> NDArray:
        """Return what the noise of a step is made of, as :meth:`step` and :meth:`sense` take it.

        Args:
            seeds: [B] of the rows' outcomes.
            steps: [B] the number of the step in each row.

        Returns:
            Numbers [B, noise_width]; or a seed for each row [B, 1], where the simulator draws its
            noise itself.
        """
        drawn = numbers.words_at(seeds, steps) >> np.uint64(1)
        if not self.simulator.noise_width:
            return drawn[:, None]
        rows = [self.simulator.draw_noise(1, 1, _generator(seed))[0, 0] for seed in drawn]
        return torch.stack(rows).numpy()

    def step(
        self, state: NDArray[np.float64], command: NDArray[np.float64], noise: NDArray | None
    ) -> NDArray[np.float64]:
        """Return the states [B, S] after commands [B, C]; ``noise`` of :meth:`noise`, or None."""
        return self._ask(self.simulator.step, noise, state, command)

    def sense(self, state: NDArray[np.float64], noise: NDArray | None) -> NDArray:
        """Return the readings [B, R] in 0..1 in states [B, S]; ``noise`` as in :meth:`step`."""
        return self._ask(self.simulator.sense, noise, state)

    def _ask(self, what: Any, noise: NDArray | None, *given: NDArray) -> NDArray:
        tensors = [torch.from_numpy(one) for one in given]
        with torch.no_grad():
            if noise is None:
                return what(*tensors).numpy()
            if self.simulator.noise_width:
                return what(*tensors, z=torch.from_numpy(noise)).numpy()
            rows = zip(*(one.split(1) for one in tensors), strict=True)
            found = [
                what(*row, generator=_generator(seed))
                for row, seed in zip(rows, noise[:, 0], strict=True)
            ]
            return torch.cat(found).numpy()


def _generator(seed: np.uint64) -> torch.Generator:
    return torch.Generator().manual_seed(int(seed))


class Simulator:
    """Predicts the state that a command leads to, for a whole batch at once; subclass it.

    A simulator keeps no hidden state: what a trajectory must remember is in its ``state``. A
    controller cannot tell which simulator it runs in. Only ``state_names``, ``command_names``,
    :meth:`start` and :meth:`step` must be given.

    Attributes:
        kind: its name in files.
        state_names: the columns of a state; the first three are x (m), y (m), theta (rad).
        command_names: the columns of a command; a ``duration`` (s), where there is one, is last.
        reading_names: of the sensors that :meth:`sense` reads; none by default.
        members: how many networks an ensemble has; a state may name one.
        has_noise: whether :meth:`step` or :meth:`sense` draws noise where it is given a generator.
        noise_width: where above 0, ``step`` and ``sense`` also take the numbers that the noise is
            made of, ``z`` [B, noise_width], in place of a generator; see :meth:`draw_noise`.
        domain: lowest and highest value of the command's columns that it was made from, by name;
            a column that is not named has no limits.
        slack: commands may leave the domain by this share of its width.
        knows_gaps: whether :meth:`supported` tells gaps within the domain.
        radius: of the robot, m; None: its size is not known.
        bearings: where each sensor looks, [S] rad to the left of straight ahead, NaN where one
            sees nothing; None: it is not known.
    """

    kind: str = "simulator"
    state_names: tuple[str, ...]
    command_names: tuple[str, ...]
    reading_names: tuple[str, ...] = ()
    members: int = 1
    has_noise: bool = False
    noise_width: int = 0
    radius: float | None = None
    slack: float = 0.05
    knows_gaps: bool = False

    @property
    def bearings(self) -> NDArray[np.float64] | None:
        """Return where the sensors look; see the class."""
        return None

    @property
    def domain(self) -> Mapping[str, tuple[float, float]]:
        """Return the limits of commands; see the class."""
        return {}

    @property
    def uncertain(self) -> bool:
        """Whether drawn outcomes differ: there is noise, or members that disagree."""
        return self.has_noise or self.members > 1

    def supported(self, commands: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether commands [..., C] are like some that it was made from, [...].

        That is within the domain; a simulator that knows more of them may say more.
        """
        found = np.asarray(np.isfinite(commands).all(-1))
        for place, name in enumerate(self.command_names):
            low, high = _limits(self, name)
            found &= (commands[..., place] >= low) & (commands[..., place] <= high)
        return found

    def start(self, pose: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the states [B, S] of robots that stand still at ``pose`` [B, 3].

        With a generator each draws the member that it moves as.
        """
        raise NotImplementedError

    def start_as(self, pose: Tensor, member: Tensor) -> Tensor:
        """Return the states [B, S] of robots that move as the members [B], -1 for the mean."""
        return self.start(pose)

    def step(
        self, state: Tensor, command: Tensor, generator: torch.Generator | None = None
    ) -> Tensor:
        """Return the states [B, S] after ``command`` [B, C] was carried out from ``state``.

        Noise is drawn only where a generator is given; without one the answer is the mean.
        """
        raise NotImplementedError

    def sense(self, state: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the readings [B, len(reading_names)] in 0..1 of robots in ``state`` [B, S]."""
        raise NotImplementedError(f"{type(self).__name__} has no sensors")

    def draw_noise(self, rows: int, steps: int, generator: torch.Generator) -> Tensor:
        """Return the numbers [rows, steps, noise_width] that noise of trajectories is made of."""
        raise NotImplementedError(f"{type(self).__name__} draws its noise itself")

    def noise_of(self, draws: Draws, steps: int) -> NDArray[np.float64] | None:
        """Return the numbers [R, steps, noise_width] of drawn outcomes' noise.

        None where there is no noise, or it is drawn from generators of ``draws.seeds``.
        """
        return draws.noise

    def free_poses(self, count: int, rng: np.random.Generator) -> NDArray[np.float64] | None:
        """Return random poses [count, 3] where the robot fits; None: it knows of no place."""
        return None

    def touching(self, poses: NDArray[np.float64]) -> NDArray[np.bool_] | None:
        """Return whether a robot at poses [..., 3] touches something, [...].

        None: it knows of nothing that could be touched.
        """
        return None

    def outline(self) -> list[dict[str, Any]]:
        """Return what a picture of the place shows, shapes as of a task's outline; [] for none."""
        return []

    def elsewhere(self, count: int, seed: int) -> Simulator:
        """Return this simulator in ``count`` other places, drawn from a seed.

        Raises:
            UserError: if it knows of no places.
        """
        raise UserError(
            f"a simulator of the kind {self.kind} has no arena, so there are no others to draw"
        )

    def conditions(self) -> dict[str, Any]:
        """Return what may have been changed since the simulator was read, such as its noise.

        It is written beside what was evolved in it, and is the same when that is resumed.
        """
        return {}

    def for_export(self, dtype: torch.dtype) -> Simulator:
        """Return this simulator computing in ``dtype``, for :mod:`neurosim.simulators.export`.

        Its step must be one sequence of tensor operations, whatever it is given.

        Raises:
            UserError: if it is not.
        """
        raise UserError(
            f"a simulator of the kind {self.kind} cannot be exported: how many operations its step "
            "takes depends on where the robots are; those of the kind motion-network can"
        )

    def stepper(self) -> Stepper:
        """Return what steps batches of robots of which each has random numbers of its own."""
        return Stepper(self)

    def rollouts(self, controller: Any, episode: Episode) -> Rollouts | None:
        """Return compiled rollouts of a controller, where there are any; None: it is stepped.

        What they compute is held to :meth:`step` by a test, for the same draws.
        """
        return None


def as_seed(rng: np.random.Generator | int) -> int:
    """Return a seed for PyTorch: the number itself, or one drawn."""
    return rng if isinstance(rng, int) else int(rng.integers(2**62))


def draw_members(count: int, members: int, generator: torch.Generator) -> NDArray[np.int64]:
    """Return which member each of so many outcomes moves as, in random order.

    As many of each as can be: what is left to chance is noise in the fitness.
    """
    order = torch.randperm(count, generator=generator)
    return (torch.arange(count) % members)[order].numpy()


def draw_outcomes(
    simulator: Simulator,
    starts: NDArray[np.float64],
    rng: np.random.Generator | int,
    placing: tuple[float, float] | None,
    steps: int,
) -> Draws:
    """Draw outcomes: where each robot stands, its member, and the noise that a simulator is given.

    Args:
        simulator: in which they are.
        starts, rng, placing: as :meth:`Rollouts.draw` takes them.
        steps: of a trial.
    """
    generator = torch.Generator().manual_seed(as_seed(rng))
    starts = put_down(starts, placing, generator)
    member = noise = None
    if simulator.members > 1:
        member = draw_members(len(starts), simulator.members, generator)
    if simulator.has_noise and simulator.noise_width:
        noise = simulator.draw_noise(len(starts), steps, generator).numpy()
    return Draws(starts, member, noise)


def put_down(
    starts: NDArray[np.float64], placing: tuple[float, float] | None, generator: torch.Generator
) -> NDArray[np.float64]:
    """Return poses [R, 3] that robots put down by hand at ``starts`` [R, 3] really have."""
    if placing is None:
        return np.asarray(starts, np.float64)
    scatter = torch.randn(len(starts), 3, generator=generator, dtype=torch.float64).numpy()
    return starts + scatter * np.array([placing[0], placing[0], placing[1]])


def _limits(simulator: Simulator, name: str) -> tuple[float, float]:
    """Return the lowest and highest command of a column that is not refused.

    The largest that was recorded is not quite the largest that was meant.
    """
    low, high = simulator.domain.get(name, (-np.inf, np.inf))
    if not np.isfinite(high - low):
        return low, high
    more = simulator.slack * (high - low or max(abs(low), abs(high)))
    return low - more, high + more


def check_commands(simulator: Simulator, commands: NDArray, where: str = "commands") -> None:
    """Refuse commands [..., C] that the simulator cannot have learned.

    Raises:
        UserError: naming the first one that is not finite, lasts no time, or lies outside the
            domain, and what would be right.
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
                f"{where}{index}: {name} = {value:g} lies outside of what this simulator was made "
                f"from ({asked})"
            )
