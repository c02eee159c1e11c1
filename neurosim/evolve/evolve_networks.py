"""From a simulator of tables to a network on disk, by way of a robot where one is given."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.checkpoint import Checkpoint
from neurosim.base.errors import RobotError
from neurosim.base.files import check_new_folder
from neurosim.base.progress import Progress
from neurosim.base.provenance import robot_kind
from neurosim.controllers import NetworkController
from neurosim.evolve.network_evolution import (
    NetworkEvolution,
    NetworkSettings,
    TableTrials,
    Trials,
)
from neurosim.simulators import TableSimulator
from neurosim.simulators.sources import named
from neurosim.tasks.obstacle_avoidance import FITNESS, ObstacleAvoidance

#: Drives a network [18] in the simulator of some trials and in reality: see the report's Figure 4.
Compare = Callable[[NDArray[np.float64], TableTrials], list[dict[str, list]]]

#: Seconds between checkpoints.
CHECKPOINT_EVERY = 5.0

#: Starts from which the last population is compared.
CHOICE_STARTS = 50
#: On a robot so many of the last population's best are tried again, and so often each.
AGAIN, TRIALS_AGAIN = 5, 4


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
    robot: Mapping[str, Any] | None = None,
    compare: Compare | None = None,
    resume: bool = False,
    options: Mapping[str, Any] | None = None,
) -> NetworkController:
    """Evolve a network for a task in a simulator and write the best of the last population.

    The best is found by trying all of the last population from many more starts: what was best
    in its own generation may have been lucky. After generations on a robot the last one's best few
    are tried there again, for the same reason.

    While it runs, ``OUT.checkpoint`` holds what an interrupted evolution goes on from. Where it is
    interrupted, or the robot is lost, the best network so far is written all the same, and is
    replaced when the evolution is resumed.

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
        robot: what the robot says of itself, for ``evolution["robot"]``; of a virtual one
            ``virtual_lab`` as well, what makes the same lab again.
        compare: drives the chosen network in simulator and reality, for
            ``evolution["trajectories"]``.
        resume: go on with the interrupted evolution of ``out``.
        options: kept in the checkpoint, for whoever resumes.

    Raises:
        UserError: if something stands at ``out``, the robot does not fit into the arena, or what
            is to be resumed is not there or was begun with other settings.
        RobotError: if the robot was lost; the best network so far is at ``out``.
    """
    settings = settings or NetworkSettings()
    trials, evolution = TableTrials(simulator, task), NetworkEvolution(settings, seed)
    run = _Run(evolution, Checkpoint(out, "evolution"))
    about = {
        "settings": asdict(settings),
        "seed": seed,
        "noise": {"kind": simulator.noise, "level": simulator.noise_level},
        "arena": simulator.arena.to_json(),
    }
    made_in = {} if source is None else named(source)
    begun = begun_with(simulator, task, settings, source, seed, robot_generations, robot)
    if resume:
        check_new_folder(out, overwrite=_is_unfinished(out))
        run.resume(begun)
    else:
        check_new_folder(out)
        run.checkpoint.begin(begun, options)

    def write(interrupted: bool, **driven: Any) -> NetworkController:
        tried, on_its_own = run.tried, {}
        if on_robot is not None and len(evolution.best) > settings.generations:
            if run.again is None and not interrupted:
                run.choose(*_again(on_robot, tried, seed))
            tried = run.tried[:1]
            if run.again is not None:
                mean, spread = map(float, run.again)
                found = {"mean": mean, "spread": spread, "trials": TRIALS_AGAIN}
                on_its_own = {"robot_fitness": found}
        genes, fitness, spread = choose(trials, tried, seed)
        if compare is not None and not interrupted:
            driven = {"trajectories": compare(genes, trials)}
        history: dict[str, Any] = {"best": evolution.best, "mean": evolution.mean}
        if len(evolution.best) > settings.generations:
            history["transfer"] = settings.generations
        controller = NetworkController(
            weights=genes.reshape(2, -1),
            task=task.describe(),
            predicted={"fitness": fitness, "spread": spread, "starts": CHOICE_STARTS},
            simulator=made_in,
            evolution={
                **about,
                **({} if robot is None else {"robot": dict(robot)}),
                **on_its_own,
                "interrupted": interrupted,
                "history": history,
                **driven,
            },
        )
        controller.write(out, overwrite=resume)
        return controller

    try:
        run.advance(trials, settings.generations, on_robot or trials, robot_generations, progress)
        controller = write(False)
    except (KeyboardInterrupt, SystemError, RobotError) as error:
        # Ctrl-C within a compiled kernel comes out of it wrapped.
        wrapped = isinstance(error, SystemError)
        run.stop()
        if run.tried is None or (wrapped and not isinstance(error.__cause__, KeyboardInterrupt)):
            raise
        controller = write(True)
        if isinstance(error, RobotError):
            raise type(error)(
                f"{error}; the best network so far is in {out}, go on with --resume"
            ) from None
        return controller
    finally:
        if run.tried is None and not resume:
            run.checkpoint.remove()  # nothing came of it
    run.checkpoint.remove()
    return controller


def begun_with(
    simulator: TableSimulator,
    task: ObstacleAvoidance,
    settings: NetworkSettings,
    source: str | Path | None,
    seed: int,
    robot_generations: int,
    robot: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """Return what must be the same when an evolution is resumed; see :func:`evolve_networks`.

    Of the robot that is which one it is and how fast its line is, not at which port.
    """
    same_robot = {}
    if robot is not None:
        lab = robot.get("virtual_lab")
        same_robot = {
            "robot": robot_kind(robot) if lab is None else "virtual",
            "dialect": robot.get("dialect"),
            "baud": robot.get("baud"),
            "lab_seed": None if lab is None else lab["robot_seed"],
        }
    return {
        **asdict(settings),
        "seed": seed,
        "noise": {"kind": simulator.noise, "level": simulator.noise_level},
        "arena": simulator.arena.to_json(),
        "task": task.describe(),
        "simulator_sha256": None if source is None else named(source).get("sha256"),
        "robot_generations": robot_generations,
        **same_robot,
    }


class _Run:
    """An evolution under way, and its checkpoint.

    Attributes:
        tried: of which networks the best is to be chosen, [N, 18]; None before the first
            generation.
        again: mean and standard deviation of the fitness of the first of these in trials anew on
            the robot, [2]; None before these.
    """

    def __init__(self, evolution: NetworkEvolution, checkpoint: Checkpoint):
        self.evolution = evolution
        self.checkpoint = checkpoint
        self.tried: NDArray[np.float64] | None = None
        self.again: NDArray[np.float64] | None = None
        self._saved = time.monotonic()
        self._state = evolution.state()

    def advance(
        self, trials: Trials, generations: int, on_robot: Trials, more: int, progress: bool
    ) -> None:
        """Try generations in the simulator, and more of them on the robot."""
        evolution, total = self.evolution, generations + more
        bar = Progress("evolve", total, "generations") if progress else None
        try:
            if bar is not None and evolution.best:
                bar.advance(len(evolution.best))
            while (number := len(evolution.best)) < total:
                population = evolution.population.copy()
                if number < generations:
                    evolution.generation(trials)
                    self.tried = population
                else:
                    fitness = evolution.generation(on_robot, self._keep)
                    self.tried = population[np.argsort(-fitness)[:AGAIN]]
                self._keep()
                if bar is not None:
                    bar.advance(note=f"best {evolution.best[-1]:.1f}")
        finally:
            if bar is not None:
                bar.close()

    def choose(self, genes: NDArray[np.float64], again: NDArray[np.float64]) -> None:
        """Remember which network [1, 18] was best in trials anew, and its fitness there [2]."""
        self.tried, self.again = genes, again
        self._keep()

    def _keep(self) -> None:
        """Remember how far it has come, and write it down every few seconds."""
        kept = {"tried": self.tried, "again": self.again}
        known = {name: value for name, value in kept.items() if value is not None}
        self._state = {**self.evolution.state(), **known}
        if time.monotonic() - self._saved >= CHECKPOINT_EVERY:
            self.checkpoint.save(self._state)
            self._saved = time.monotonic()

    def stop(self) -> None:
        """Write down how far it had come before whatever was going on when it was interrupted."""
        self._load(self._state)
        self.checkpoint.save(self._state)

    def resume(self, settings: Mapping[str, Any]) -> None:
        """Go on from the checkpoint of an evolution that was begun with these settings."""
        state = self.checkpoint.resume(settings)
        if state is None:
            return
        try:
            self._load(state)
        except (KeyError, ValueError, RuntimeError, TypeError):
            raise self.checkpoint.damaged() from None

    def _load(self, state: dict[str, NDArray]) -> None:
        self.evolution.load(state)
        self.tried, self.again, self._state = state.get("tried"), state.get("again"), state


def _is_unfinished(out: str | Path) -> bool:
    """Return whether what stands there is the best so far of an interrupted evolution."""
    if not (Path(out) / "controller.json").exists():
        return False
    return bool(NetworkController.read(out).evolution.get("interrupted"))


def _again(
    on_robot: Trials, genes: NDArray[np.float64], seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return that of some networks [N, 18] which is best in trials anew, [1, 18], and its fitness.

    The fitness is the mean and the standard deviation of its trials, [2].
    """
    rng = np.random.default_rng([seed, 3])
    each = np.stack([on_robot(genes, rng) for _ in range(TRIALS_AGAIN)], axis=1)
    best = int(each.mean(axis=1).argmax())
    return genes[[best]], np.array([each[best].mean(), each[best].std(ddof=1)])


def choose(
    trials: TableTrials, genes: NDArray[np.float64], seed: int
) -> tuple[NDArray[np.float64], float, float]:
    """Return the network [18] that is best from many starts, its fitness, and the spread of it.

    The fitness is a trial's: the mean over starts times the task's number of starts; the spread
    is the standard deviation that trials have.
    """
    rng, task = np.random.default_rng([seed, 1]), trials.task
    starts = trials.simulator.arena.free_poses(CHOICE_STARTS, trials.simulator.radius, rng)
    best = int(trials.judge(genes, starts, rng)[1].argmax())
    each = FITNESS[task.fitness](trials.drive(genes[[best]], starts, rng))[0]
    spread = float(each.std(ddof=1)) * task.starts**0.5
    return genes[best], float(each.mean()) * task.starts, spread
