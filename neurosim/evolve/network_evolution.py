"""Evolution of networks: Lund and Miglino 1996, a population and whatever tries it.

:class:`NetworkEvolution` knows only fitness; :class:`TableTrials` gives it in a simulator. The
same population can go on in another place: on the robot itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.evolution import GeneticAlgorithm, GeneticSettings, truncation
from neurosim.simulators import TableSimulator
from neurosim.simulators.tables.kernels import SENSORS, drive_networks
from neurosim.tasks.obstacle_avoidance import ObstacleAvoidance, Trajectory

GENES = 2 * (SENSORS + 1)

_MASK = 2**64 - 1

#: Tries networks: genes [P, 18] and the generation's random numbers -> fitness [P], and where
#: something else decides who has children, that [P] beside it.
Trials = Callable[
    [NDArray[np.float64], np.random.Generator],
    NDArray[np.float64] | tuple[NDArray[np.float64], NDArray[np.float64]],
]


@dataclass(frozen=True)
class NetworkSettings:
    """How networks are evolved.

    The paper gives population and parents (and so 5 children of each); the rest is ours.

    Attributes:
        generations: to evolve.
        population: networks.
        parents: the best, which alone have children, each as many as the others; a fifth of the
            population by default, as in the paper.
        crossover: chance that two children are crossed.
        eta: distribution index of the crossover.
        mutation: chance of each weight of a child to be changed.
        mutation_scale: standard deviation of a change.
        first_scale: standard deviation of the first population's weights.
    """

    generations: int = 200
    population: int = 100
    parents: int = 0
    crossover: float = 0.5
    eta: float = 2.0
    mutation: float = 0.15
    mutation_scale: float = 1.0
    first_scale: float = 1.0

    def __post_init__(self) -> None:
        if not self.parents:
            object.__setattr__(self, "parents", max(self.population // 5, 1))
        if not 1 <= self.parents <= self.population or self.population < 2:
            raise UserError(f"a population of {self.population} cannot have {self.parents} parents")


#: Paths of the same network that differ by this much (median, m) cost it all of its fitness.
APART = 0.2
#: So many networks are driven before their fitness is taken.
TOGETHER = 100


class TableTrials:
    """Tries networks in a table simulator, every one from the same starts, through the same noise.

    A network drives twice from every start, through different noise. Fitness is the mean; of two
    networks that are as fit, the one whose paths differ less has the better chances, as what noise
    changes little carries over to the robot. Without noise nothing differs, and it drives once.

    Attributes:
        simulator: with the arena and the noise to use.
        task: what counts as good.
        apart: differences of paths (median, m) that cost as much as the fitness is; infinite: the
            fitness alone counts, as in the paper.
    """

    def __init__(self, simulator: TableSimulator, task: ObstacleAvoidance, apart: float = APART):
        self.simulator = simulator
        self.task = task
        self.apart = apart
        self._rooms: tuple[dict[str, NDArray], ...] = ({}, {})

    def __call__(
        self, genes: NDArray[np.float64], rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the fitness [P] of networks from starts drawn anew, and their merit [P]."""
        starts = self.simulator.arena.free_poses(self.task.starts, self.simulator.radius, rng)
        return self.judge(genes, starts, rng)

    def judge(
        self, genes: NDArray[np.float64], starts: NDArray[np.float64], rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the fitness [P] of networks [P, 18] from starts [R, 3], and their merit [P]."""
        if self.simulator.noise == "none":
            fitness = self.fitness(genes, starts, rng)
            return fitness, fitness
        noises = [_seeds(starts, rng) for _ in range(2)]
        fitness, apart = np.empty((2, len(genes))), np.empty(len(genes))
        for part in _parts(len(genes)):
            driven = [
                self._driven(genes[part], starts, seeds, room)
                for seeds, room in zip(noises, self._rooms, strict=True)
            ]
            fitness[:, part] = [self.task.evaluate(one) for one in driven]
            between = driven[0].poses[..., :2] - driven[1].poses[..., :2]
            apart[part] = np.median(np.linalg.norm(between, axis=-1), axis=(1, 2))
        mean = fitness.mean(axis=0)
        return mean, mean - np.abs(mean) * np.minimum(apart / self.apart, 1.0)

    def fitness(
        self,
        genes: NDArray[np.float64],
        starts: NDArray[np.float64],
        rng: np.random.Generator | None = None,
    ) -> NDArray[np.float64]:
        """Return the fitness [P] of networks [P, 18], each driven once from starts [R, 3]."""
        found, seeds = np.empty(len(genes)), None if rng is None else _seeds(starts, rng)
        for part in _parts(len(genes)):
            driven = self._driven(genes[part], starts, seeds, self._rooms[0])
            found[part] = self.task.evaluate(driven)
        return found

    def drive(
        self,
        genes: NDArray[np.float64],
        starts: NDArray[np.float64],
        rng: np.random.Generator | None = None,
        steps: int | None = None,
    ) -> Trajectory:
        """Drive networks [P, 18] from starts [R, 3]; returns trajectories [P, R, ...].

        Args:
            genes: weights, row by row as in
                :class:`~neurosim.controllers.network_files.NetworkController`.
            starts: poses.
            rng: of the noise; without one there is none.
            steps: of each; the task's by default.
        """
        seeds = None if rng is None else _seeds(starts, rng)
        return self._driven(genes, starts, seeds, {}, steps)

    def _driven(
        self,
        genes: NDArray[np.float64],
        starts: NDArray[np.float64],
        seeds: NDArray[np.uint64] | None,
        room: dict[str, NDArray],
        steps: int | None = None,
    ) -> Trajectory:
        """Drive networks and keep what they did in ``room``, until that is driven into again."""
        arrays = self.simulator.arrays
        if seeds is None:
            arrays, seeds = arrays._replace(noise=0), np.zeros(len(starts), np.uint64)
        count = self.task.steps_a_start if steps is None else steps
        shapes = {
            "poses": ((count + 1, 3), np.float64),
            "readings": ((count, SENSORS), np.float32),
            "commands": ((count, 2), np.float32),
        }
        for name, (each, kind) in shapes.items():
            shape = (len(genes), len(starts), *each)
            kept = room.get(name)
            if kept is None or kept.shape[1:] != shape[1:] or len(kept) < len(genes):
                room[name] = np.empty(shape, kind)
        poses, readings, commands = (room[name][: len(genes)] for name in shapes)
        drive_networks(
            arrays,
            np.ascontiguousarray(genes, float),
            np.ascontiguousarray(starts, float),
            seeds,
            self.task.duration,
            int(self.simulator.substeps(self.task.duration)),
            poses,
            readings,
            commands,
        )
        return Trajectory(readings, commands, poses)


def _seeds(starts: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.uint64]:
    """Draw the noise of every start [R]."""
    return rng.integers(0, 2**64, len(starts), dtype=np.uint64)


def _parts(count: int) -> list[slice]:
    """Cut networks into so many that what they do, of a usual trial, stays near the processor."""
    return [slice(begin, begin + TOGETHER) for begin in range(0, count, TOGETHER)]


class NetworkEvolution:
    """A population of networks, generation after generation.

    Attributes:
        best, mean: fitness of every generation so far, its best network's and the mean.
        population: [P, 18], the networks that :meth:`generation` tries next.
    """

    def __init__(self, settings: NetworkSettings, seed: int):
        self.settings = settings
        self.best: list[float] = []
        self.mean: list[float] = []
        self._fitness = np.full(settings.population, np.nan)
        self._rng = np.random.default_rng(seed)
        generator = torch.Generator().manual_seed(seed)
        first = settings.first_scale * torch.randn(
            settings.population, GENES, generator=generator, dtype=torch.float64
        )
        genetic = GeneticSettings(
            population=settings.population,
            crossover=settings.crossover,
            mutation=settings.mutation,
            eta=settings.eta,
            mutation_scale=settings.mutation_scale,
            elites=0,
        )
        self._algorithm = GeneticAlgorithm(
            first, genetic, generator, selection=partial(_select, settings.parents)
        )

    @property
    def population(self) -> NDArray[np.float64]:
        """The networks that are tried next."""
        return self._algorithm.ask().numpy()

    def generation(
        self, trials: Trials, after_each: Callable[[], None] | None = None
    ) -> NDArray[np.float64]:
        """Try every network, breed the next population, and return the fitness [P] of this one.

        Args:
            trials: tries networks.
            after_each: where given, networks are tried one by one, and it is called after each,
                so that :meth:`state` may be kept; those tried before are not tried again.
        """
        if after_each is None:
            fitness, merit = _both(trials(self.population, self._rng))
        else:
            for place in np.flatnonzero(np.isnan(self._fitness)):
                self._fitness[place] = _both(trials(self.population[[place]], self._rng))[0][0]
                after_each()
            fitness = merit = self._fitness
        self.best.append(float(fitness.max()))
        self.mean.append(float(fitness.mean()))
        self._algorithm.tell(torch.from_numpy(merit))
        self._fitness = np.full(len(fitness), np.nan)
        return fitness

    def state(self) -> dict[str, NDArray]:
        """Return all that the next generations depend on."""
        drawn = self._rng.bit_generator.state
        large = [drawn["state"][name] for name in ("state", "inc")]
        words = [word for value in large for word in (value >> 64, value & _MASK)]
        words += [drawn["has_uint32"], drawn["uinteger"]]
        return {
            **{f"algorithm.{k}": v.numpy() for k, v in self._algorithm.state().items()},
            "random": np.array(words, np.uint64),
            "fitness": self._fitness.copy(),
            "best": np.array(self.best, float),
            "mean": np.array(self.mean, float),
        }

    def load(self, state: Mapping[str, NDArray]) -> None:
        """Go on from what :meth:`state` returned.

        Raises:
            KeyError, ValueError: if it is the state of something else.
        """
        if state["fitness"].shape != self._fitness.shape or len(state["random"]) != 6:
            raise ValueError("the state is of another population")
        prefix = "algorithm."
        self._algorithm.load(
            {
                name.removeprefix(prefix): torch.from_numpy(value)
                for name, value in state.items()
                if name.startswith(prefix)
            }
        )
        a, b, c, d, has, integer = (int(word) for word in state["random"])
        self._rng.bit_generator.state = {
            "bit_generator": "PCG64",
            "state": {"state": a << 64 | b, "inc": c << 64 | d},
            "has_uint32": has,
            "uinteger": integer,
        }
        self._fitness = state["fitness"].copy()
        self.best, self.mean = state["best"].tolist(), state["mean"].tolist()


def _both(found: object) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return fitness [P] and what decides who has children [P]."""
    fitness, merit = found if isinstance(found, tuple) else (found, found)
    return np.asarray(fitness, float), np.asarray(merit, float)


def _select(
    parents: int, fitness: torch.Tensor, count: int, generator: torch.Generator
) -> torch.Tensor:
    return truncation(fitness, parents, count, generator)
