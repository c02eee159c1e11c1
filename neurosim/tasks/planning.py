"""Evolution of a command set in a simulator, Pretorius et al. (2009), section 6.2.

A chromosome has a constant number of commands, each of four genes: whether it is null (not
given), left and right speed, duration. The genetic algorithm is that of Table 1. Crossover
pairs commands that were given in the same rectangle: of two parents, the n-th command that one
was given in a rectangle with the n-th that the other was given there, wherever they stand in the
two command sets. Each such pair is crossed by simulated binary crossover; commands without a
counterpart, and null ones, pass unchanged. Mutation changes each gene with the same probability,
see :func:`mutate`. The paper leaves open how a null command is encoded, which counterparts are
paired where several were given in a rectangle, and what mutation does.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from neurosim.base.errors import UserError
from neurosim.base.progress import Progress
from neurosim.evolution.genetic import GeneticAlgorithm, GeneticSettings
from neurosim.evolution.operators import sbx
from neurosim.simulators.base import Simulator
from neurosim.tasks.base import Evaluation, Task

COMMAND_NAMES = ("left", "right", "duration")
GENES = 4
#: Share of a first generation's commands that are null.
NULL_SHARE = 0.2
#: The motors run down for this long after the last command before the robot is at rest, s.
RUN_DOWN = 0.5


@dataclass(frozen=True)
class PlanResult:
    """A command set that was evolved, and what the simulator says will come of it.

    Attributes:
        commands: (left %, right %, duration s) each, None for a null command.
        poses: (G + 1, 3) the start and the predicted pose after each of the G given commands,
            at the instant when the next takes over.
        rest: (3,) the predicted pose once the motors, stopped after the last command, stand.
        fitness: predicted fitness, of the path until the robot is at rest.
        completes: whether the prediction completes the task.
        history: best and mean fitness of every generation, {"best": [...], "mean": [...]}.
        run: which of the runs it came from.
        interrupted: whether evolution was stopped before its last generation.
    """

    commands: list[tuple[float, float, float] | None]
    poses: NDArray[np.float64]
    rest: NDArray[np.float64]
    fitness: float
    completes: bool
    history: dict[str, list[float]]
    run: int
    interrupted: bool


@dataclass(frozen=True)
class PlanSettings:
    """How plans are evolved; the defaults are section 6.2 and Table 1 of the paper.

    Attributes:
        commands: commands in a chromosome, null ones included.
        generations: how many populations are evaluated.
        runs: independent runs, evaluated together.
        max_speed: fastest motor speed, percent.
        durations: shortest and longest command, s.
        genetic: the genetic algorithm of every run; its ``mutation_scale`` is a share of a
            gene's range.
    """

    commands: int = 10
    generations: int = 1000
    runs: int = 1
    max_speed: float = 50.0
    durations: tuple[float, float] = (0.5, 3.0)
    genetic: GeneticSettings = field(default_factory=GeneticSettings)

    def __post_init__(self) -> None:
        for name in ("commands", "generations", "runs"):
            if getattr(self, name) < 1:
                raise UserError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not 0 < self.max_speed <= 100:
            raise UserError(f"the highest speed must be in 0 to 100 %, not {self.max_speed:g}")
        low, high = self.durations
        if not 0 < low <= high:
            raise UserError(f"durations must be above 0 and in order, not {low:g} to {high:g}")


def rollout(
    simulator: Simulator, start: Sequence[float], commands: Tensor, given: Tensor
) -> Tensor:
    """Drive command sets in a simulator, then stop the motors.

    Args:
        simulator: any; its commands must be left, right, duration.
        start: x (m), y (m), heading (rad).
        commands: [B, K, 3] left, right (percent), duration (s).
        given: [B, K] bool; a command that is not given leaves the robot as it is.

    Returns:
        [B, K + 2, 3]: the poses at the start, after each command, and at rest.
    """
    pose = commands.new_tensor(list(start)).expand(len(commands), 3)
    state = simulator.start(pose)
    poses = [state[:, :3]]
    for index in range(commands.shape[1]):
        after = simulator.step(state, commands[:, index])
        state = torch.where(given[:, index, None], after, state)
        poses.append(state[:, :3])
    stop = commands.new_tensor([0.0, 0.0, RUN_DOWN]).expand(len(commands), 3)
    poses.append(simulator.step(state, stop)[:, :3])
    return torch.stack(poses, dim=1)


def evolve_plan(
    simulator: Simulator,
    task: Task,
    settings: PlanSettings | None = None,
    *,
    seed: int,
    progress: bool = True,
    device: str | torch.device = "cpu",
) -> list[PlanResult]:
    """Evolve command sets for a task in a simulator.

    Ctrl-C after the first generation ends evolution and returns what it has found so far.

    Args:
        simulator: takes left, right, duration.
        task: gives the start and the fitness.
        settings: sizes, limits and the genetic algorithm.
        seed: of all that is drawn; the same seed gives the same plans.
        progress: whether to show progress on stderr.
        device: where the simulator lives.

    Returns:
        The best plan of every run, the best first.

    Raises:
        UserError: if the simulator takes other commands.
    """
    settings = settings or PlanSettings()
    if tuple(simulator.command_names) != COMMAND_NAMES:
        raise UserError(
            f"plans are of {', '.join(COMMAND_NAMES)}, but this simulator takes "
            f"{', '.join(simulator.command_names)}; use one that was learned from motor commands"
        )
    evolution = _Evolution(simulator, task, settings, torch.Generator(device).manual_seed(seed))
    interrupted = False
    bar_or_none = (
        Progress("evolving", settings.generations, "generations") if progress else nullcontext()
    )
    with _one_thread(), bar_or_none as bar:
        try:
            for _ in range(settings.generations):
                best = evolution.generation()
                if bar is not None:
                    bar.advance(note=f"fitness {best:.1f}")
        except KeyboardInterrupt:
            if not evolution.history:
                raise
            interrupted = True
    return evolution.results(interrupted)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keep torch to one thread: what happens in a generation is too little to be shared out."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class _Evolution:
    """Several runs of the genetic algorithm, rolled out together."""

    def __init__(
        self, simulator: Simulator, task: Task, settings: PlanSettings, generator: torch.Generator
    ):
        self._simulator, self._task, self._settings = simulator, task, settings
        shape = (settings.runs, settings.genetic.population, settings.commands * GENES)
        initial = torch.rand(
            shape, generator=generator, dtype=torch.float64, device=generator.device
        )
        self._algorithm = GeneticAlgorithm(
            initial, settings.genetic, generator, crossover=self._cross, mutation=self._mutate
        )
        #: Of the population last evaluated, [runs, population, commands].
        self._keys = torch.empty(0)
        #: Best and mean fitness of each generation, [runs] each.
        self.history: list[tuple[Tensor, Tensor]] = []

    def generation(self) -> float:
        """Evaluate a population, make the next, and return the best fitness so far."""
        population = self._algorithm.ask()
        runs, size, _ = population.shape
        evaluation, poses, given = self._evaluate(population.flatten(0, 1))
        region = torch.from_numpy(self._task.region(poses[:, :-2])).to(given.device)
        self._keys = pairing_keys(region, given).view(runs, size, -1)
        fitness = torch.from_numpy(evaluation.fitness).view(runs, size)
        self._algorithm.tell(fitness)
        self.history.append((self._algorithm.best_fitness.clone(), fitness.mean(-1)))
        return float(self._algorithm.best_fitness.max())

    def results(self, interrupted: bool) -> list[PlanResult]:
        """Return the best plan of each run, the best first."""
        evaluation, poses, given = self._evaluate(self._algorithm.best)
        commands = decode(self._algorithm.best, self._settings)[0].tolist()
        best, mean = (torch.stack(series).T.tolist() for series in zip(*self.history, strict=True))
        results = []
        for run, keep in enumerate(given.tolist()):
            after = [index + 1 for index, is_given in enumerate(keep) if is_given]
            results.append(
                PlanResult(
                    commands=[
                        tuple(command) if is_given else None
                        for command, is_given in zip(commands[run], keep, strict=True)
                    ],
                    poses=poses[run, [0, *after]],
                    rest=poses[run, -1],
                    fitness=float(evaluation.fitness[run]),
                    completes=bool(evaluation.completes[run]),
                    history={"best": best[run], "mean": mean[run]},
                    run=run,
                    interrupted=interrupted,
                )
            )
        return sorted(results, key=lambda result: -result.fitness)

    def _evaluate(self, genes: Tensor) -> tuple[Evaluation, NDArray, Tensor]:
        """Return the evaluation, poses (B, K + 2, 3) and given [B, K] of chromosomes [B, G]."""
        commands, given = decode(genes, self._settings)
        poses = rollout(self._simulator, self._task.start, commands, given).cpu().numpy()
        counted = torch.cat([given, given.new_zeros(len(given), 1)], dim=1)
        return self._task.evaluate(poses, counted.cpu().numpy()), poses, given

    def _cross(
        self, population: Tensor, first: Tensor, second: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        a, b = (_take(population, index).unflatten(-1, (-1, GENES)) for index in (first, second))
        eta = self._settings.genetic.eta
        return cross_paired(
            a, b, _take(self._keys, first), _take(self._keys, second), eta, generator
        )

    def _mutate(self, genes: Tensor, generator: torch.Generator) -> Tensor:
        genetic = self._settings.genetic
        return mutate(genes, genetic.mutation, genetic.mutation_scale, generator)


def mutate(genes: Tensor, probability: float, scale: float, generator: torch.Generator) -> Tensor:
    """Change each gene with ``probability``.

    A speed or duration gets normally distributed noise or is drawn anew, one as often as the
    other. A command whose null gene is hit becomes null; one that was null comes back, all of
    it drawn anew, for what it was before has not been selected for since.

    Args:
        genes: [..., 4 K] in 0..1.
        probability: chance of each gene.
        scale: standard deviation of the noise.
        generator: source of the draws.
    """
    draws = {"generator": generator, "dtype": genes.dtype, "device": genes.device}
    which = torch.rand(genes.shape, **draws)
    near = (genes + scale * torch.randn(genes.shape, **draws)).clamp_(0.0, 1.0)
    anew = torch.rand(genes.shape, **draws)
    hit = which < probability
    changed = torch.where(hit, torch.where(which < probability / 2, near, anew), genes)
    old, new, fresh, hit = (part.unflatten(-1, (-1, GENES)) for part in (genes, changed, anew, hit))
    was_null, flipped = is_null(old[..., :1]), hit[..., :1]
    new = torch.where(flipped & was_null, fresh, new)
    kept = fresh[..., :1] * (1.0 - NULL_SHARE)
    null = torch.where(was_null, kept, 1.0 - 0.5 * NULL_SHARE * fresh[..., :1])
    flag = torch.where(flipped, null, old[..., :1])
    return torch.cat([flag, new[..., 1:]], dim=-1).flatten(-2)


def cross_paired(
    a: Tensor, b: Tensor, keys_a: Tensor, keys_b: Tensor, eta: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Cross the commands of two parents that have the same key.

    Args:
        a, b: parents, [..., K, 4], genes in 0..1.
        keys_a, keys_b: [..., K], as from :func:`pairing_keys`; no key twice in a parent.
        eta: distribution index of simulated binary crossover.
        generator: source of the draws.

    Returns:
        Children, [..., 4 K] each: a's with its paired commands crossed, and b's.
    """
    same = keys_a.unsqueeze(-1) == keys_b.unsqueeze(-2)  # [..., command of a, command of b]
    partner = torch.take_along_dim(b, same.int().argmax(-1, keepdim=True), -2)
    crossed_a, crossed_b = sbx(a, partner, eta, generator, bounds=(0.0, 1.0))
    # The second children stand at the places of a's commands: bring them back to b's.
    crossed_b = torch.take_along_dim(crossed_b, same.int().argmax(-2).unsqueeze(-1), -2)
    child_a = torch.where(same.any(-1, keepdim=True), crossed_a, a)
    child_b = torch.where(same.any(-2).unsqueeze(-1), crossed_b, b)
    return child_a.flatten(-2), child_b.flatten(-2)


def decode(genes: Tensor, settings: PlanSettings) -> tuple[Tensor, Tensor]:
    """Return commands [B, K, 3] (percent, percent, s) and which are given [B, K].

    In whole percents and milliseconds, as they will be sent.

    Args:
        genes: [B, 4 K] in 0..1: null above 1 - NULL_SHARE, left, right, duration.
        settings: limits of speed and duration.
    """
    parts = genes.unflatten(-1, (-1, GENES))
    speeds = ((2.0 * parts[..., 1:3] - 1.0) * settings.max_speed).round()
    low, high = settings.durations
    duration = (low + (high - low) * parts[..., 3:]).round(decimals=3)
    return torch.cat([speeds, duration], dim=-1), ~is_null(parts[..., 0])


def is_null(gene: Tensor) -> Tensor:
    """Return whether a command's first gene says that it is not given."""
    return gene > 1.0 - NULL_SHARE


def pairing_keys(region: Tensor, given: Tensor) -> Tensor:
    """Return a key [B, K] per command, equal in two plans for commands to be paired.

    The n-th command that was given in a region has the same key in every plan, and no other
    command of its plan has it. Null commands have keys that no other command has.

    Args:
        region: [B, K] where the robot was when each command was given, small whole numbers.
        given: [B, K] bool.
    """
    batch, commands = region.shape
    same = (region.unsqueeze(-1) == region.unsqueeze(-2)) & given.unsqueeze(-2)
    rank = same.tril(-1).sum(-1)
    alone = torch.arange(batch * commands, device=region.device).view(batch, commands)
    return torch.where(given, region * commands + rank, alone + 10**6)


def _take(population: Tensor, index: Tensor) -> Tensor:
    return torch.take_along_dim(population, index.unsqueeze(-1), -2)
