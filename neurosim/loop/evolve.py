"""From a simulator to controllers: any simulator, task, controller and optimiser.

Evolution has a first stage, on what the simulator expects or over outcomes drawn anew, and may go
on robustly: over drawn outcomes from the first stage's populations. While it runs,
``OUT.checkpoint`` holds what an interrupted evolution goes on from.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.checkpoint import Checkpoint
from neurosim.base.errors import RobotError, UserError
from neurosim.base.files import check_new_folder
from neurosim.base.generations import CHECKPOINT_EVERY, run_generations
from neurosim.base.interrupts import uninterrupted
from neurosim.base.progress import Progress
from neurosim.controllers import FixedPlan, SavedController, make_controller, read_controller
from neurosim.controllers.base import Controller
from neurosim.controllers.plan import commands_of
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.objectives import mean_fitness, repeats_of
from neurosim.loop.optimisers import make_optimiser
from neurosim.loop.reality import TRIALS_AGAIN, RealRobot, RealSearch
from neurosim.loop.search import Search
from neurosim.loop.settings import EvolveSettings, default_settings
from neurosim.loop.workers import Name
from neurosim.simulators.base import Simulator, check_commands
from neurosim.simulators.registry import read_simulator
from neurosim.simulators.sources import named
from neurosim.tasks.base import Task
from neurosim.tasks.registry import make_task


@dataclass(frozen=True)
class Result:
    """What came of a run, and what the simulator says of it.

    Attributes:
        controller: the family.
        genes: [G] of the best individual.
        poses: [T + 1, 3] the expected path from the (first) start; of a plan, at the start and
            after each command that is given.
        rest: [3] the expected pose at the end, where the motors have run down.
        fitness: of what is expected; where evolution drew outcomes, the mean over fresh ones.
        spread: standard deviation of a trial's fitness over those; None without.
        completes: whether what is expected does the task.
        probability: share of drawn outcomes that succeed; None where nothing is uncertain.
        expected_fitness: mean fitness over drawn outcomes, likewise.
        draws: how many outcomes these two are of.
        unsupported: share of the time in commands unlike any that the simulator was made from; of
            a controller that sees over drawn outcomes, where there are any.
        history: best and mean of every generation, {"best": [...], "mean": [...]}; after robust
            evolution also what it maximised, {"robust_best": ..., "robust_mean": ...}.
        run: which of the runs it came from.
        interrupted: whether evolution was stopped before its last generation.
    """

    controller: Controller
    genes: NDArray[np.float64]
    poses: NDArray[np.float64]
    rest: NDArray[np.float64]
    fitness: float
    spread: float | None
    completes: bool
    probability: float | None
    expected_fitness: float | None
    draws: int
    unsupported: float
    history: dict[str, Any]
    run: int
    interrupted: bool

    @property
    def commands(self) -> list[tuple[float, float, float] | None]:
        """The commands of a plan, None for a null one; of other kinds none."""
        return commands_of(self.controller, self.genes) if self.controller.blind else []


class Evolution:
    """An evolution under way, its stages one after the other.

    Attributes:
        stages: the searches in the simulator so far.
        real: the generations on the robot, once they have begun.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        settings: EvolveSettings,
        seed: int,
        reality: RealRobot | None = None,
        real_generations: int = 0,
    ):
        """Prepare the first stage.

        Args:
            evaluator: judges in the simulator.
            settings: how.
            seed: random seed.
            reality: the robot that goes on after the simulator, or None.
            real_generations: how many.

        Raises:
            UserError: if robust controllers are asked of a simulator in which nothing is
                uncertain, the optimiser does not exist, or plans may leave what the simulator was
                made from.
        """
        self.evaluator, self.settings, self._seed = evaluator, settings, seed
        self._reality, self._real_generations = reality, real_generations
        self._checkpoint: Checkpoint | None = None
        self._saved = time.monotonic()
        self._latest: dict[str, Any] | None = None
        self.real: RealSearch | None = None
        if reality is not None and (settings.runs > 1 or settings.robust is not None):
            raise UserError("generations on a robot go on after one run, which is not made robust")
        if settings.robust is not None:
            check_uncertain(evaluator.simulator)
        if not settings.extrapolate:
            _check_reach(evaluator)
        optimiser = make_optimiser(settings.optimiser, evaluator.controller, settings, seed)
        self._searched = evaluator
        if settings.arenas:
            self._searched = Evaluator(
                evaluator.simulator.elsewhere(settings.arenas, seed),
                evaluator.task,
                evaluator.controller,
                placing=settings.placing,
            )
        self.stages = [
            Search(
                self._searched,
                optimiser,
                objective=settings.objective,
                outcomes=settings.outcomes,
                rng=np.random.default_rng(seed),
                unsupported=settings.most_unsupported,
            )
        ]

    @property
    def resumable(self) -> bool:
        """Whether the optimiser can be interrupted and resumed."""
        return hasattr(self.stages[0].optimiser, "state")

    def run(self, checkpoint: Checkpoint | None = None, progress: bool = True) -> bool:
        """Run all stages; return whether Ctrl-C ended them early."""
        first, settings = self.stages[0], self.settings
        self._checkpoint = checkpoint if self.resumable else None
        if len(self.stages) == 1 and self._run(first, settings.generations, "evolving", progress):
            return True
        if self._reality is not None and self._real_generations:
            return self._run_real(self._reality, progress)
        if settings.robust is None:
            return False
        if len(self.stages) == 1:
            self.stages.append(self.robust_stage(first.top, np.asarray(first.optimiser.ask())))
        total = settings.robust.generations
        return self._run(self.stages[1], total, "making it robust", progress)

    def _run(self, stage: Search, total: int, label: str, progress: bool) -> bool:
        save = None if self._checkpoint is None else lambda _: self._save()
        return run_generations(stage, total, label, save=save, progress=progress)

    def _save(self) -> None:
        if self._checkpoint is not None:
            self._checkpoint.save(self.state())
        self._saved = time.monotonic()

    def _keep(self) -> None:
        """Remember how far it has come; write it down every few seconds, as trials may be short."""
        if self.resumable:
            self._latest = self.state()
        if time.monotonic() - self._saved >= CHECKPOINT_EVERY:
            self._save()

    def _rewind(self) -> None:
        """Go back to the end of the last trial, whatever was going on since; write that down."""
        if self._latest is not None:
            self.load(self._latest)
        self._save()

    def _run_real(self, reality: RealRobot, progress: bool) -> bool:
        """Run the generations on the robot; Ctrl-C is answered at once, trial by trial."""
        if self.real is None:
            self.real = RealSearch(self.stages[0], reality, self._keep)
        self._keep()
        total = self._real_generations
        try:
            with (
                Progress("on the robot", total, "generations") if progress else nullcontext() as bar
            ):
                if bar is not None:
                    bar.advance(self.real.done)
                while self.real.done < total:
                    note = self.real.generation()
                    if bar is not None:
                        bar.advance(note=note)
            self.real.choose(self._seed)
        except (KeyboardInterrupt, RobotError) as error:
            self._rewind()
            if isinstance(error, RobotError):
                raise
            return True
        self._save()
        return False

    def robust_stage(self, best: NDArray, population: NDArray) -> Search:
        """Go on robustly from the best [N, G] and the populations [N, P, G] of the first stage.

        Runs that have found nothing that completes the task get what others have found.
        """
        robust, evaluator = self.settings.robust, self.evaluator
        assert robust is not None
        population = population.reshape(-1, *population.shape[-2:])
        judged, _ = evaluator.judge(best, evaluator.expectation())
        completes = np.all(judged.success, axis=1)
        source = np.arange(len(completes))
        if completes.any():
            source[~completes] = np.resize(np.flatnonzero(completes), (~completes).sum())
        size = robust.genetic.population
        genes = np.take(population[source], np.arange(size), axis=1, mode="wrap")
        genes[:, 0] = best[source]
        return self.robust_from(genes)

    def robust_from(self, genes: NDArray[np.float64]) -> Search:
        """Return the robust stage from first populations [N, P, G]; the first of each is kept."""
        robust = self.settings.robust
        assert robust is not None
        settings = replace(self.settings, genetic=robust.genetic, runs=len(genes), insertion=True)
        optimiser = make_optimiser(
            settings.optimiser, self.evaluator.controller, settings, self._seed + 1, genes
        )
        return Search(
            self._searched,
            optimiser,
            objective=robust.objective,
            outcomes=robust.draws,
            refresh=robust.refresh,
            rng=np.random.default_rng([self._seed, 0x20B5]),
            kept=genes[:, 0],
            unsupported=self.settings.most_unsupported,
        )

    def best(self) -> NDArray[np.float64]:
        """Return the best individual of each run, [N, G]: of drawn outcomes, on fresh ones."""
        stage, settings, evaluator = self.stages[-1], self.settings, self.evaluator
        if self.real is not None and self.real.done:
            draws, candidates = self._selection(evaluator)[0], self.real.candidates()
            limit = settings.most_unsupported
            merit, _ = evaluator.merit(candidates, draws, settings.objective, unsupported=limit)
            return candidates[[merit.merit.argmax()]]
        if len(self.stages) > 1:
            robust = settings.robust
            assert robust is not None
            if not stage.done:
                return self.stages[0].top
            return stage.choose(self._searched.draw(robust.selection_draws, stage.rng))
        if not settings.outcomes:
            return stage.top
        return stage.choose(self._selection(self._searched)[0])

    def _selection(self, evaluator: Evaluator) -> tuple[Any, Any]:
        """Return outcomes on which the best is chosen, and others from the same starts."""
        rng = np.random.default_rng([self._seed, 1])
        each = evaluator.task.trial_starts
        count = -(-self.settings.selection // each) * each  # of whole trials
        starts, drawn = evaluator.starts(count, rng)
        repeats = repeats_of(self.settings.objective) if evaluator.simulator.uncertain else 1
        placing = None if drawn else evaluator.placing
        chosen = evaluator.rollouts.draw(np.tile(starts, (repeats, 1)), rng, placing)
        return chosen, evaluator.rollouts.draw(starts, rng, placing)

    def results(self, interrupted: bool) -> list[Result]:
        """Return the best of every run, the best first; see :class:`Result`."""
        evaluator, settings = self.evaluator, self.settings
        best = self.best()
        judged, expected = evaluator.judge(best, evaluator.expectation())
        history: dict[str, NDArray] = {}
        for prefix, stage in zip(("", "robust_"), self.stages, strict=False):
            if stage.done:
                history[prefix + "best"] = np.stack(stage.best, axis=1)
                history[prefix + "mean"] = np.stack(stage.mean, axis=1)
        if self.real is not None:
            for name in ("best", "mean"):
                real = np.array(getattr(self.real, name), float).reshape(1, -1)
                history[name] = np.concatenate([history[name], real], axis=1)
        drawn = self._drawn(best)
        unsupported = evaluator.unsupported(expected)
        found = []
        for run in range(len(best)):
            fitness = float(mean_fitness(evaluator.task, judged.fitness[[run]])[0])
            probability = expected_fitness = spread = None
            if drawn is not None:
                fitnesses, successes, unsupported[run] = drawn[run]
                probability = float(successes.mean())
                expected_fitness = float(mean_fitness(evaluator.task, fitnesses[None])[0])
                if settings.outcomes and not settings.robust:
                    fitness = expected_fitness
                    spread = float(fitnesses.std(ddof=1)) * evaluator.task.trial_starts**0.5
            poses, rest = path_of(expected, run, evaluator)
            found.append(
                Result(
                    controller=evaluator.controller,
                    genes=best[run],
                    poses=poses,
                    rest=rest,
                    fitness=fitness,
                    spread=spread,
                    completes=bool(judged.success[run].all()),
                    probability=probability,
                    expected_fitness=expected_fitness,
                    draws=0 if drawn is None else drawn[run][0].size,
                    unsupported=float(unsupported[run]),
                    history=self._history(history, run),
                    run=run,
                    interrupted=interrupted,
                )
            )
        return sorted(found, key=self._worth, reverse=True)

    def _history(self, history: Mapping[str, NDArray], run: int) -> dict[str, Any]:
        found: dict[str, Any] = {name: values[run].tolist() for name, values in history.items()}
        if self.real is not None:
            found["transfer"] = self.settings.generations
        return found

    def _drawn(self, best: NDArray) -> list[tuple[NDArray, NDArray, float]] | None:
        """Return fitness and success [R], and what is unsupported, of each run's best, drawn."""
        evaluator, settings = self._searched, self.settings
        if not evaluator.simulator.uncertain:
            return None
        if settings.outcomes and evaluator.task.trial_starts > 1:
            draws = self._selection(evaluator)[1]
        else:
            draws = evaluator.draw(settings.final_draws, self._seed + 0xF14A1)
        found = []
        for one in best:
            judged, trajectory = evaluator.judge(one[None], draws)
            unsupported = float(evaluator.unsupported(trajectory)[0])
            found.append((judged.fitness[0], judged.success[0], unsupported))
        return found

    def _worth(self, result: Result) -> tuple[bool, float]:
        robust, limit = self.settings.robust, self.settings.most_unsupported
        inside = True
        if limit is not None and self.evaluator.simulator.knows_gaps:
            inside = result.unsupported <= limit
        if robust is None:
            return inside, result.fitness
        value = result.expected_fitness if robust.objective == "fitness" else result.probability
        assert value is not None
        return inside, value

    def state(self) -> dict[str, Any]:
        """Return all that the next generations depend on, as arrays."""
        stages: dict[str, Any] = {f"stage{n}.": stage for n, stage in enumerate(self.stages)}
        if self.real is not None:
            stages["real."] = self.real
        return {
            prefix + name: value
            for prefix, stage in stages.items()
            for name, value in stage.state().items()
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from what :meth:`state` returned.

        Raises:
            KeyError, ValueError: if it is the state of something else.
        """
        parts = [
            {k.removeprefix(p): v for k, v in state.items() if k.startswith(p)}
            for p in ("stage0.", "stage1.", "real.")
        ]
        self.stages[0].load(parts[0])
        if parts[1]:
            robust = self.settings.robust
            assert robust is not None
            size = robust.genetic.population, self.evaluator.controller.genes
            stage = self.robust_from(np.zeros((self.settings.runs, *size)))
            stage.load(parts[1])
            self.stages[1:] = [stage]
        if parts[2] and self._reality is not None:
            self.real = RealSearch(self.stages[0], self._reality, self._keep)
            self.real.load(parts[2])


def _check_reach(evaluator: Evaluator) -> None:
    """Refuse plans whose slowest or fastest commands lie outside of what the simulator knows.

    Raises:
        UserError: saying which command, and what the simulator knows.
    """
    controller = evaluator.controller
    if not controller.blind:
        return
    genes = np.stack([np.zeros(controller.genes), np.ones(controller.genes)])
    commands, active = controller.commands(genes, 0.0)
    check_commands(evaluator.simulator, commands[active | (commands[..., -1] > 0)], "the commands")


def path_of(trajectory: Any, run: int, evaluator: Evaluator) -> tuple[NDArray, NDArray]:
    """Return the poses of one individual's expected path, and the last.

    Those of a plan are where its given commands begin and end.
    """
    poses = trajectory.poses[run, 0]
    if evaluator.controller.blind:
        slots = len(poses) - 1 - (evaluator.episode.rest > 0)
        given = np.flatnonzero(trajectory.active[run, 0, :slots]) + 1
        return poses[[0, *given]], poses[-1]
    return poses, poses[-1]


def evolve_in(
    simulator: Simulator,
    task: Task,
    controller: Controller,
    settings: EvolveSettings | None = None,
    *,
    seed: int = 0,
    progress: bool = True,
) -> list[Result]:
    """Evolve controllers for a task in a simulator; nothing is written.

    Ctrl-C after the first generation ends evolution and returns what it has found so far.

    Args:
        simulator, task, controller: see :class:`Evaluator`.
        settings: by default those of the paper that the controller is from.
        seed: random seed; the same one gives the same results.
        progress: whether to show progress on stderr.

    Returns:
        The best of every run, the best first: by what robust evolution maximised, else by its
        fitness.

    Raises:
        UserError: if one of them needs what another does not offer.
    """
    settings = settings or default_settings(controller, task)
    evaluator = Evaluator(simulator, task, controller, placing=settings.placing)
    evolution = Evolution(evaluator, settings, seed)
    return evolution.results(evolution.run(progress=progress))


def improve(
    simulator: Simulator,
    task: Task,
    controller: Controller,
    genes: Sequence[NDArray[np.float64]],
    settings: EvolveSettings,
    *,
    seed: int = 0,
    progress: bool = True,
) -> list[Result]:
    """Evolve individuals [G] robustly that have been evolved already, each in a run of its own.

    Args:
        simulator, task, controller, seed, progress: as :func:`evolve_in` takes them.
        genes: one individual for each run.
        settings: with ``robust``; the first stage's are not used.

    Returns:
        As :func:`evolve_in`; the history is that of robust evolution alone.
    """
    robust = settings.robust
    assert robust is not None
    settings = replace(settings, runs=len(genes))
    evaluator = Evaluator(simulator, task, controller, placing=settings.placing)
    evolution = Evolution(evaluator, settings, seed)
    size = robust.genetic.population
    first = np.repeat(np.stack(genes)[:, None], size, axis=1)
    stage = evolution.robust_stage(np.stack(genes), first)
    evolution.stages.append(stage)
    interrupted = run_generations(stage, robust.generations, "making it robust", progress=progress)
    return evolution.results(interrupted)


def check_uncertain(simulator: Simulator) -> None:
    """Refuse a simulator whose drawn outcomes would all be the same.

    Raises:
        UserError: saying so.
    """
    if not simulator.uncertain:
        raise UserError(
            "this simulator has neither noise nor an ensemble, so that it expects one outcome "
            "only; train one with the default trainer, or give it noise"
        )


def evolve(
    simulator: str | Path | Simulator,
    task: str | Task = "nine-rectangles",
    controller: str | Controller | None = None,
    *,
    out: str | Path | None = None,
    settings: EvolveSettings | None = None,
    source: str | Path | None = None,
    seed: int = 0,
    keep_all: bool = False,
    resume: bool = False,
    options: Mapping[str, Any] | None = None,
    reality: RealRobot | None = None,
    real_generations: int = 0,
    progress: bool = True,
    workers: Name = "local",
    **changes: Any,
) -> list[SavedController]:
    """Evolve controllers for a task in a simulator, and write the best.

    Args:
        simulator: a simulator or its folder.
        task: the task or its name.
        controller: the family or its kind; by default a plan for a task whose fitness needs no
            sensors, else a network of what the simulator senses.
        out: folder of the new controller; with ``keep_all`` there is one for each run, OUT-01 and
            on. None: nothing is written.
        settings: how; by default as in the paper that the controller is from.
        source: the folder of a simulator that is given itself, to be named in the controller.
        seed: random seed.
        keep_all: write the best of every run, not only the best of all.
        resume: go on with the interrupted evolution of ``out``.
        options: kept in the checkpoint, for whoever resumes.
        reality: the robot, for generations on it after those in the simulator.
        real_generations: how many.
        progress: whether to show progress on stderr.
        workers: Who judges: local, this process; or ray, the workers of a Ray cluster. The result
            is the same.
        **changes: of the settings: ``generations=50``, ``objective="progress"`` ...

    Returns:
        The best of every run, the best first.

    Raises:
        UserError: if they do not fit each other, something stands at ``out``, or what is to be
            resumed is not there or was begun with other settings.
        RobotError: if the robot was lost; the best controller so far is at ``out``.
    """
    if isinstance(simulator, str | Path):
        source, simulator = simulator, read_simulator(simulator)
    made_in = {} if source is None else named(source)
    task = make_task(task)
    if controller is None:
        controller = task.usual_controller
    if isinstance(controller, str):
        controller = make_controller(controller, simulator, task)
    if settings is None:
        settings = default_settings(controller, task)
    settings = replace(settings, **changes)
    evaluator = Evaluator(simulator, task, controller, placing=settings.placing, workers=workers)
    with uninterrupted():
        evolution = Evolution(evaluator, settings, seed, reality, real_generations)
    robot = None if reality is None else reality.describe()

    def saved(results: list[Result]) -> list[SavedController]:
        about: dict[str, Any] = {"settings": asdict(settings), "seed": seed}
        about |= simulator.conditions()
        if robot is not None:
            about["robot"] = robot
        if evolution.real is not None:
            about |= _on_robot(evolution.real, reality, results[0], seed)
        return [as_saved(result, task, made_in, about) for result in results]

    if out is None:
        return saved(evolution.results(evolution.run(progress=progress)))
    folders = _folders(Path(out), settings.runs if keep_all else 1)
    checkpoint = Checkpoint(out, "evolution")
    begun = {
        **asdict(settings),
        **simulator.conditions(),
        "seed": seed,
        "task": task.describe(),
        "controller": {"kind": controller.kind, "settings": controller.settings()},
        "simulator_sha256": made_in.get("sha256"),
        **({} if robot is None else {"real_generations": real_generations, **_same_robot(robot)}),
    }
    with checkpoint.held():
        for folder in folders:
            check_new_folder(folder, overwrite=resume and _unfinished(folder))
        if resume:
            if not evolution.resumable:
                raise UserError(
                    f"the optimiser {settings.optimiser} cannot be interrupted and resumed: it has "
                    "no state(); start the evolution anew"
                )
            state = checkpoint.resume(begun)
            if state is not None:
                try:
                    evolution.load(state)
                except (KeyError, ValueError, RuntimeError, TypeError):
                    raise checkpoint.damaged() from None
        elif evolution.resumable:
            checkpoint.begin(begun, options)

        def written(found: list[SavedController], interrupted: bool) -> list[SavedController]:
            if controller.blind and not found[0].given:
                if interrupted:
                    raise UserError("so far no plan gives any command; continue with --resume")
                checkpoint.remove()
                raise UserError("no plan that gives any command came of this; use more generations")
            for folder, one in zip(folders, found, strict=False):
                one.write(folder, overwrite=resume)
            if not interrupted:
                checkpoint.remove()
            return found

        interrupted = False
        try:
            interrupted = evolution.run(checkpoint, progress)
            if evolution.real is None:
                # What was found is judged and written before Ctrl-C is answered.
                with uninterrupted():
                    return written(saved(evolution.results(interrupted)), interrupted)
            found = saved(evolution.results(interrupted))
        except RobotError as error:
            if not evolution.stages[0].done:
                raise
            saved(evolution.results(True))[0].write(out, overwrite=resume)
            raise type(error)(
                f"{error}; the best controller so far is in {out}, go on with --resume"
            ) from None
        except KeyboardInterrupt:
            if evolution.real is None:
                raise
            # While the simulator and the robot were compared: all else is done.
            interrupted, found = True, saved(evolution.results(True))
        finally:
            if not evolution.stages[0].done and not resume:
                checkpoint.remove()  # nothing came of it
        return written(found, interrupted)


def _same_robot(robot: Mapping[str, Any]) -> dict[str, Any]:
    """Return what must be the same of a robot on which an evolution is resumed.

    That is which one it is and how fast its line is, not at which port.
    """
    lab = robot.get("virtual_lab")
    return {
        "robot": robot.get("kind") if lab is None else "virtual",
        "dialect": robot.get("dialect"),
        "baud": robot.get("baud"),
        "lab_seed": None if lab is None else lab.get("robot_seed"),
    }


def _on_robot(
    real: RealSearch, reality: RealRobot | None, best: Result, seed: int
) -> dict[str, Any]:
    """Return what is said of generations on a robot, and paths to compare once they are over."""
    found: dict[str, Any] = {}
    if real.again is not None:
        mean, spread = map(float, real.again)
        found["robot_fitness"] = {"mean": mean, "spread": spread, "trials": TRIALS_AGAIN}
        if reality is not None and not best.interrupted:
            found["trajectories"] = reality.compare(best.genes, seed)
    return found


def _folders(out: Path, count: int) -> list[Path]:
    if count == 1:
        return [out]
    return [out.with_name(f"{out.name}-{run + 1:02d}") for run in range(count)]


def _unfinished(folder: Path) -> bool:
    """Return whether what stands there is the best so far of an interrupted evolution."""
    if not (folder / "controller.json").exists():
        return False
    return bool(read_controller(folder).evolution.get("interrupted"))


def as_saved(
    result: Result, task: Task, source: Mapping[str, Any], about: Mapping[str, Any]
) -> SavedController:
    """Return what is written of a result.

    Args:
        result: of a run.
        task: that it was evolved for.
        source: what names the simulator.
        about: settings and seed of the evolution.
    """
    predicted: dict[str, Any] = {
        "poses": result.poses.tolist(),
        "rest": result.rest.tolist(),
        "fitness": result.fitness,
        "completes": result.completes,
        "unsupported": result.unsupported,
    }
    if result.spread is not None:
        predicted["spread"] = result.spread
    if result.probability is not None:
        predicted["probability"] = result.probability
        predicted["expected_fitness"] = result.expected_fitness
        predicted["draws"] = result.draws
    (x, y, heading), controller, genes = result.poses[0], result.controller, result.genes
    if controller.kind == "plan":
        controller, genes = FixedPlan(tuple(result.commands)), np.empty(0)
    return SavedController(
        controller=controller,
        genes=genes,
        task=task.describe(),
        start=(float(x), float(y), float(heading)),
        predicted=predicted,
        simulator=dict(source),
        evolution={
            **about,
            "run": result.run,
            "interrupted": result.interrupted,
            "history": dict(result.history),
        },
    )
