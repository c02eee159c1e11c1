"""Evolution of networks: Lund and Miglino 1996, a population and whatever tries it.

:class:`NetworkEvolution` knows only fitness; :class:`TableTrials` gives it in a simulator. The
same population can go on in another place: on the robot itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base.errors import UserError
from neurosim.base.files import check_new_folder, sha256
from neurosim.base.progress import Progress
from neurosim.controllers import NetworkController
from neurosim.evolution import GeneticAlgorithm, GeneticSettings, truncation
from neurosim.simulators import TableSimulator
from neurosim.simulators.table_kernels import SENSORS, drive_networks
from neurosim.tasks.obstacle_avoidance import FITNESS, ObstacleAvoidance, Trajectory

GENES = 2 * (SENSORS + 1)

#: Tries networks: genes [P, 18] and the generation's random numbers -> fitness [P].
Trials = Callable[[NDArray[np.float64], np.random.Generator], NDArray[np.float64]]

#: Drives a network [18] in the simulator of some trials and in reality: see the report's Figure 4.
Compare = Callable[[NDArray[np.float64], "TableTrials"], list[dict[str, list]]]


@dataclass(frozen=True)
class NetworkSettings:
    """How networks are evolved.

    The paper gives population and parents (and so 5 children of each); the rest is ours.

    Attributes:
        generations: to evolve.
        population: networks.
        parents: the best, which alone have children, each as many as the others.
        crossover: chance that two children are crossed.
        eta: distribution index of the crossover.
        mutation: chance of each weight of a child to be changed.
        mutation_scale: standard deviation of a change.
        first_scale: standard deviation of the first population's weights.
    """

    generations: int = 200
    population: int = 100
    parents: int = 20
    crossover: float = 0.5
    eta: float = 2.0
    mutation: float = 0.15
    mutation_scale: float = 1.0
    first_scale: float = 1.0

    def __post_init__(self) -> None:
        if not 1 <= self.parents <= self.population or self.population < 2:
            raise UserError(f"a population of {self.population} cannot have {self.parents} parents")


class TableTrials:
    """Tries networks in a table simulator, every one from the same starts, through the same noise.

    Attributes:
        simulator: with the arena and the noise to use.
        task: what counts as good.
    """

    def __init__(self, simulator: TableSimulator, task: ObstacleAvoidance):
        self.simulator = simulator
        self.task = task

    def __call__(self, genes: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
        """Return the fitness [P] of networks from starts drawn anew."""
        starts = self.simulator.arena.free_poses(self.task.starts, self.simulator.radius, rng)
        return self.task.evaluate(self.drive(genes, starts, rng))

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
                :class:`~neurosim.controllers.network.NetworkController`.
            starts: poses.
            rng: of the noise; without one there is none.
            steps: of each; the task's by default.
        """
        arrays = self.simulator.arrays
        seeds = np.zeros(len(starts), np.uint64)
        if rng is None:
            arrays = arrays._replace(noise=0)
        else:
            seeds = rng.integers(0, 2**64, len(starts), dtype=np.uint64)
        poses, readings, commands = drive_networks(
            arrays,
            np.ascontiguousarray(genes, float),
            np.ascontiguousarray(starts, float),
            seeds,
            self.task.steps_a_start if steps is None else steps,
            self.task.duration,
            int(self.simulator.substeps(self.task.duration)),
        )
        return Trajectory(readings, commands, poses)


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

    def generation(self, trials: Trials) -> NDArray[np.float64]:
        """Try every network, breed the next population, and return the fitness [P] of this one."""
        fitness = np.asarray(trials(self.population, self._rng), float)
        self.best.append(float(fitness.max()))
        self.mean.append(float(fitness.mean()))
        self._algorithm.tell(torch.from_numpy(fitness))
        return fitness


def evolve_networks(
    simulator: TableSimulator,
    out: str | Path,
    task: ObstacleAvoidance,
    settings: NetworkSettings | None = None,
    *,
    source: str | Path | None = None,
    seed: int = 0,
    progress: bool = True,
    on_robot: Trials | None = None,
    robot_generations: int = 0,
    compare: Compare | None = None,
) -> NetworkController:
    """Evolve a network for a task in a simulator and write the best of the last population.

    The best is found by trying all of the last population from many more starts: what was best
    in its own generation may have been lucky. After generations on a robot it is the best of
    the last of them.

    Args:
        simulator: with its arena and noise.
        out: folder of the controller.
        task: the task.
        settings: how to evolve.
        source: the simulator's folder, to be named in the controller.
        seed: of all that is drawn.
        progress: whether to show progress on stderr.
        on_robot: tries networks on the robot, for ``robot_generations`` after the simulator's.
        robot_generations: how many; the history says where they began (``transfer``).
        compare: drives the chosen network in simulator and reality, for
            ``evolution["trajectories"]``.

    Raises:
        UserError: if something stands at ``out`` or the robot does not fit into the arena.
    """
    check_new_folder(out)
    settings = settings or NetworkSettings()
    trials, evolution = TableTrials(simulator, task), NetworkEvolution(settings, seed)
    interrupted = False
    total = settings.generations + robot_generations
    bar = Progress("evolve", total, "generations") if progress else None
    try:
        for number in range(total):
            population = evolution.population.copy()
            transferred = on_robot is not None and number >= settings.generations
            fitness = evolution.generation(on_robot if transferred else trials)
            tried = population[[fitness.argmax()]] if transferred else population
            if bar is not None:
                bar.advance(note=f"best {evolution.best[-1]:.1f}")
    except KeyboardInterrupt:
        if not evolution.best:
            raise
        interrupted = True
    finally:
        if bar is not None:
            bar.close()
    genes, fitness, spread = choose(trials, tried, seed)
    history = {"best": evolution.best, "mean": evolution.mean}
    if len(evolution.best) > settings.generations:
        history["transfer"] = settings.generations
    driven = {} if compare is None or interrupted else {"trajectories": compare(genes, trials)}
    controller = NetworkController(
        weights=genes.reshape(2, -1),
        task=task.describe(),
        predicted={"fitness": fitness, "spread": spread, "starts": CHOICE_STARTS},
        simulator={}
        if source is None
        else {"path": str(source), "sha256": sha256(Path(source) / "simulator.json")},
        evolution={
            "settings": asdict(settings),
            "seed": seed,
            "noise": {"kind": simulator.noise, "level": simulator.noise_level},
            "arena": simulator.arena.to_json(),
            "interrupted": interrupted,
            "history": history,
            **driven,
        },
    )
    controller.write(out)
    return controller


#: Starts from which the last population is compared.
CHOICE_STARTS = 50


def choose(
    trials: TableTrials, genes: NDArray[np.float64], seed: int
) -> tuple[NDArray[np.float64], float, float]:
    """Return the network [18] that is best from many starts, its fitness, and the spread of it.

    The fitness is a trial's: the mean over starts times the task's number of starts; the spread
    is the standard deviation that trials have.
    """
    rng, task = np.random.default_rng([seed, 1]), trials.task
    starts = trials.simulator.arena.free_poses(CHOICE_STARTS, trials.simulator.radius, rng)
    each = FITNESS[task.fitness](trials.drive(genes, starts, rng))
    best = int(each.mean(axis=1).argmax())
    spread = float(each[best].std(ddof=1)) * task.starts**0.5
    return genes[best], float(each[best].mean()) * task.starts, spread


def _select(
    parents: int, fitness: torch.Tensor, count: int, generator: torch.Generator
) -> torch.Tensor:
    return truncation(fitness, parents, count, generator)
