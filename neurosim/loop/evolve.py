"""From a simulator to controllers: any simulator, task, controller and optimiser.

Evolution has a first stage, on the expected motion or over new samples. A robust stage may follow,
over random samples, from the first stage's populations. While it runs, ``OUT.checkpoint`` holds the
state from which an interrupted evolution is resumed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base.checkpoint import Checkpoint
from neurosim.base.cluster import Name
from neurosim.base.declared import Seed, checks
from neurosim.base.errors import RobotError, UserError
from neurosim.base.files import check_new_folder
from neurosim.base.generations import run_generations, slow_notice
from neurosim.base.interrupts import uninterrupted
from neurosim.base.progress import Progress
from neurosim.base.scalars import Scalars
from neurosim.controllers import SavedController, read_controller
from neurosim.controllers.base import Controller
from neurosim.loop.evaluate import Evaluator, joined
from neurosim.loop.journal import TRIALS, Comparing, Journal, Reality, about_reality
from neurosim.loop.objectives import mean_fitness, repeats_of
from neurosim.loop.search import Search, new_optimiser, part_of
from neurosim.loop.settings import EvolveSettings, default_settings
from neurosim.loop.transfer import Transfer
from neurosim.loop.unmet import in_unmet_arenas
from neurosim.simulators.base import Simulator, check_commands
from neurosim.simulators.sources import digest, named
from neurosim.tasks.base import Task


class Evolution:
    """A running evolution, whose stages follow one another.

    Attributes:
        stages: the searches in the simulator so far.
        real: the generations in reality, after they have begun.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        settings: EvolveSettings,
        seed: int,
        real_generations: int = 0,
    ):
        """Prepare the first stage.

        Args:
            evaluator: judges in the simulator.
            settings: of the evolution.
            seed: random seed.
            real_generations: number of generations in reality after the simulator.

        Raises:
            UserError: if robust controllers are to evolve in a simulator without uncertainty, the
                optimiser does not exist, or plans may leave the range of the simulator's data.
        """
        self.evaluator, self.settings, self._seed = evaluator, settings, seed
        self._real_generations = real_generations
        self.real: Transfer | None = None
        if real_generations and (settings.runs > 1 or settings.robust is not None):
            raise UserError("generations in reality need a single run (runs=1), and not robust")
        if settings.robust is not None:
            check_uncertain(evaluator.simulator)
        if not settings.extrapolate:
            _check_reach(evaluator)
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
                new_optimiser(evaluator.controller, settings, seed),
                seed=[seed, 0],
                objective=settings.objective,
                samples=settings.samples,
                unsupported=settings.most_unsupported,
                settling=None if settings.robust is None else settings.robust.settling,
            )
        ]

    def run(
        self,
        checkpoint: Checkpoint | None = None,
        progress: bool = True,
        journal: Journal | None = None,
        scalars: Scalars | None = None,
    ) -> bool:
        """Run all stages; return whether Ctrl-C ended them early.

        Args:
            checkpoint: for the stages in the simulator.
            progress: whether to show progress on stderr.
            journal: of the trials in reality.
            scalars: for curves of the best and the mean.
        """
        first, settings = self.stages[0], self.settings
        curves = scalars or Scalars(None)
        save = None if checkpoint is None else lambda _: checkpoint.save(self.state())

        def ended(stage: Search, total: int, label: str) -> bool:
            def after() -> None:
                kind = "evolution" if stage is first else "robust"
                for name, values in (("best", stage.best[-1]), ("mean", stage.mean[-1])):
                    for run, value in enumerate(values, start=1):
                        curves.add(f"{kind}/{name}/run-{run}", float(value), stage.done)

            return run_generations(stage, total, label, save=save, progress=progress, after=after)

        if len(self.stages) == 1 and ended(first, settings.generations, "evolving"):
            return True
        if self._real_generations and journal is not None:
            if save is not None:
                save(None)
            self._run_real(journal, progress, curves)
        if settings.robust is None:
            return False
        if len(self.stages) == 1:
            self._make_robust()
        return ended(self.stages[1], settings.robust.generations, "making it robust")

    def _run_real(self, journal: Journal, progress: bool, curves: Scalars) -> None:
        """Run the generations in reality; Ctrl-C is handled at once, trial by trial."""
        total = self._real_generations
        self.real = Transfer(self.stages[0].optimiser, journal, self.evaluator)
        with Progress("in reality", total, "generations") if progress else nullcontext() as bar:
            while self.real.done < total:
                note = self.real.generation()
                for name, values in self.real.history().items():
                    curves.add(f"reality/{name}", values[-1], self.real.done)
                if bar is not None:
                    bar.advance(note=note)
        self.real.choose()

    def _make_robust(self) -> None:
        first = self.stages[0]
        self.stages[1:] = [self.robust_stage(first.top, first.population)]

    def robust_stage(self, best: NDArray, population: NDArray) -> Search:
        """Begin the robust stage with the best [N, G] and the populations [N, P, G] of the first.

        Runs without an individual that completes the task get those of other runs.
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
        settings = replace(self.settings, genetic=robust.genetic, runs=len(genes), insertion=True)
        return Search(
            self._searched,
            new_optimiser(self.evaluator.controller, settings, self._seed + 1, genes),
            seed=[self._seed, 0x20B5],
            objective=robust.objective,
            samples=robust.draws,
            refresh=robust.refresh,
            kept=genes[:, 0],
            unsupported=self.settings.most_unsupported,
            halving=robust.halving,
        )

    def best(self) -> NDArray[np.float64]:
        """Return the best individual of each run, [N, G], chosen on new random samples."""
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
            rng = np.random.default_rng([self._seed, 0xC4])
            return stage.choose(self._searched.draw(robust.selection_draws, rng))
        if not settings.samples:
            return stage.top
        return stage.choose(self._selection(self._searched)[0])

    def _selection(self, evaluator: Evaluator) -> tuple[Any, Any]:
        """Return samples for choosing the best, and others from the same starts."""
        rng = np.random.default_rng([self._seed, 1])
        each = evaluator.task.trial_starts
        count = -(-self.settings.selection // each) * each  # a number of whole trials
        starts, by_task = evaluator.starts(count, rng)
        repeats = repeats_of(self.settings.objective) if evaluator.simulator.uncertain else 1
        placing = None if by_task else evaluator.placing
        chosen = evaluator.rollouts.draw(np.tile(starts, (repeats, 1)), rng, placing)
        return chosen, evaluator.rollouts.draw(starts, rng, placing)

    def results(
        self,
        interrupted: bool,
        made_in: Mapping[str, Any] | None = None,
        about: Mapping[str, Any] | None = None,
    ) -> list[SavedController]:
        """Return the best of every run, in order of merit.

        Args:
            interrupted: whether evolution was stopped before its last generation.
            made_in: the simulator's path and checksum.
            about: further entries about the evolution, in addition to ``run``, ``interrupted`` and
                ``history``: best and mean of every generation; after robust evolution also
                ``robust_best`` and ``robust_mean`` of its objective.
        """
        evaluator, settings, task = self.evaluator, self.settings, self.evaluator.task
        best = self.best()
        judged, expected = evaluator.judge(best, evaluator.expectation())
        sampled, unsupported = self._sampled(best), evaluator.unsupported(expected)
        unmet = in_unmet_arenas(evaluator, best, self._seed)
        controllers = []
        for run, genes in enumerate(best):
            poses, rest = path_of(expected, run, evaluator)
            predicted = {
                "poses": poses.tolist(),
                "rest": rest.tolist(),
                "fitness": float(mean_fitness(task, judged.fitness[[run]])[0]),
                "completes": bool(judged.success[run].all()),
            }
            if sampled is not None:
                fitness, success, unsupported[run] = sampled[run]
                mean = float(mean_fitness(task, fitness[None])[0])
                if settings.samples and not settings.robust:
                    spread = float(fitness.std(ddof=1)) * task.trial_starts**0.5
                    predicted |= {"fitness": mean, "spread": spread}
                predicted["probability"] = float(success.mean())
                predicted |= {"expected_fitness": mean, "draws": fitness.size}
            predicted["unsupported"] = float(unsupported[run])
            if unmet is not None:
                predicted["unmet"] = unmet[run].describe()
            this_run = {"run": run, "interrupted": interrupted, "history": self._history(run)}
            controllers.append(
                SavedController.of(
                    evaluator.controller,
                    genes,
                    task.describe(),
                    tuple(poses[0].tolist()),
                    predicted,
                    dict(made_in or {}),
                    {**(about or {}), **this_run},
                )
            )
        return sorted(controllers, key=self._worth, reverse=True)

    def _history(self, run: int) -> dict[str, Any]:
        """Return best and mean of every generation of a run."""
        history: dict[str, Any] = {}
        for prefix, stage in zip(("", "robust_"), self.stages, strict=False):
            if stage.done:
                history[f"{prefix}best"] = [float(each[run]) for each in stage.best]
                history[f"{prefix}mean"] = [float(each[run]) for each in stage.mean]
        if self.real is not None:
            for name, values in self.real.history().items():
                history[name] += values
            history["transfer"] = self.settings.generations
        return history

    def _sampled(self, best: NDArray) -> list[tuple[NDArray, NDArray, float]] | None:
        """Return fitness and success [R], and the unsupported fraction, of each run's best."""
        evaluator, settings = self._searched, self.settings
        if not evaluator.simulator.uncertain:
            return None
        if settings.samples and evaluator.task.trial_starts > 1:
            draws = self._selection(evaluator)[1]
        else:
            draws = evaluator.draw(settings.final_draws, self._seed + 0xF14A1)
        sampled = []
        for one in best:
            judged, trajectory = evaluator.judge(one[None], draws)
            unsupported = float(evaluator.unsupported(trajectory)[0])
            sampled.append((judged.fitness[0], judged.success[0], unsupported))
        return sampled

    def _worth(self, one: SavedController) -> tuple[bool, float]:
        robust, limit = self.settings.robust, self.settings.most_unsupported
        inside = True
        if limit is not None and self.evaluator.simulator.knows_gaps:
            inside = one.predicted["unsupported"] <= limit
        if robust is None:
            # The best in one arena may be good in that arena only.
            return inside, one.predicted.get("unmet", one.predicted)["fitness"]
        name = "expected_fitness" if robust.objective == "fitness" else "probability"
        return inside, one.predicted[name]

    def state(self) -> dict[str, Any]:
        """Return as arrays all values on which the next generations depend."""
        return {
            f"stage{number}.{name}": value
            for number, stage in enumerate(self.stages)
            for name, value in stage.state().items()
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from a result of :meth:`state`.

        Raises:
            KeyError, ValueError: if it is the state of another search.
            UserError: if the optimiser asks for other individuals than before.
        """
        self.stages[0].load(part_of(state, "stage0."))
        if robust := part_of(state, "stage1."):
            self._make_robust()
            self.stages[1].load(robust)


def _check_reach(evaluator: Evaluator) -> None:
    """Raise an error for plans whose slowest or fastest commands leave the simulator's domain.

    Raises:
        UserError: with the command and the simulator's ranges.
    """
    controller = evaluator.controller
    if not controller.open_loop:
        return
    genes = np.stack([np.zeros(controller.genes), np.ones(controller.genes)])
    commands, active = controller.commands(genes, 0.0)
    given = commands[active | (commands[..., -1] > 0)]
    try:
        check_commands(evaluator.simulator, given, "the commands of plans")
    except UserError as error:
        raise UserError(
            f"{error}; give plans a smaller range (--max-speed, --durations, --limits), or add "
            "--extrapolate"
        ) from None


def path_of(trajectory: Any, run: int, evaluator: Evaluator) -> tuple[NDArray, NDArray]:
    """Return the poses of an individual's expected path, and the last pose.

    Those of a plan are at the beginning and the end of its given commands.
    """
    poses = trajectory.poses[run, 0]
    if evaluator.controller.open_loop:
        slots = len(poses) - 1 - (evaluator.episode.rest > 0)
        given = np.flatnonzero(trajectory.active[run, 0, :slots]) + 1
        return poses[[0, *given]], poses[-1]
    return poses, poses[-1]


def check_uncertain(simulator: Simulator) -> None:
    """Raise an error for a simulator whose random samples would all be the same.

    Raises:
        UserError: saying so.
    """
    if not simulator.uncertain:
        raise UserError(
            "this simulator has neither noise nor an ensemble, so it always predicts the same "
            "motion; train one with the default trainer, or give it noise"
        )


@checks
def evolve(
    simulator: str | Path | Simulator,
    task: str | Task = "nine-rectangles",
    controller: str | Controller | None = None,
    *,
    out: str | Path | None = None,
    settings: EvolveSettings | None = None,
    source: str | Path | None = None,
    seed: Seed = 0,
    keep_all: bool = False,
    resume: bool = False,
    options: Mapping[str, Any] | None = None,
    reality: Reality | None = None,
    real_generations: int = 0,
    ask: Callable[[str], None] | None = None,
    patience: float = 600.0,
    progress: bool = True,
    workers: Name = "local",
    tensorboard: str | Path | None = None,
    **changes: Any,
) -> list[SavedController]:
    """Evolve controllers for a task in a simulator, and write the best.

    Args:
        simulator: a simulator or its folder.
        task: the task or its name.
        controller: the family or its kind; by default a plan for a task whose fitness needs no
            sensors, else a network of what the simulator senses.
        out: folder of the new controller; with ``keep_all`` there is one for each run, OUT-01,
            OUT-02 ... None: nothing is written.
        settings: of the evolution; by default those of the controller's paper.
        source: the folder of a simulator that is given as an object, to be named in the controller.
        seed: random seed.
        keep_all: whether to write the best of every run, not only the best of all.
        resume: whether to continue the interrupted evolution of ``out``.
        options: kept in the checkpoint, for resuming.
        reality: a reality in which evolution continues after the simulator (Lund and Miglino 1996),
            or None.
        real_generations: number of generations there.
        ask: asks a person to do something, and returns when it is done.
        patience: longest time of a trial in reality, s.
        progress: whether to show progress on stderr.
        workers: Where controllers are evaluated: local, in this process; or ray, on a Ray cluster.
            The result is the same.
        tensorboard: folder for curves of the best and the mean (extra ``tensorboard``), or None.
        **changes: of the settings: ``generations=50``, ``objective="progress"`` ...

    Returns:
        The best of every run, the best first.

    Raises:
        UserError: if they do not fit each other, ``out`` exists already, or the evolution to be
            resumed does not exist or was begun with other settings.
        RobotError: if the robot was lost; the best controller so far is in ``out``.

    Example:
        >>> best = ns.evolve(
        ...     "tables", "obstacle-avoidance", "network", generations=2, runs=1, progress=False
        ... )[0]
        >>> best.genes.shape
        (18,)
    """
    if isinstance(simulator, str | Path):
        source = simulator
    simulator, task, controller = joined(simulator, task, controller)
    if settings is None:
        settings = default_settings(controller, task)
    settings = settings.changed(changes)
    evaluator = Evaluator(simulator, task, controller, placing=settings.placing, workers=workers)
    simulator, ends = evaluator.simulator, evaluator.task.perimeter
    perimeter = None if ends is None else ends.describe()
    made_in = {} if source is None else named(source)
    if perimeter is not None:
        made_in["perimeter"] = perimeter
    real_generations = 0 if reality is None else real_generations
    with uninterrupted():
        evolution = Evolution(evaluator, settings, seed, real_generations)
    about: dict[str, Any] = {"settings": asdict(settings), "seed": seed, **simulator.conditions()}
    if real_generations:
        about["robot"] = about_reality(reality)

    def results(interrupted: bool) -> list[SavedController]:
        details = about | _in_reality(evolution.real, None if interrupted else reality, seed)
        slow = slow_notice("the controllers found are being tried in further random samples")
        if not progress:
            slow.cancel()
        try:
            return evolution.results(interrupted, made_in, details)
        finally:
            slow.cancel()

    def trials_in(folder: Path) -> AbstractContextManager[Journal | None]:
        if reality is None or not real_generations:
            return nullcontext()
        return Journal(reality, folder / TRIALS, each=1, patience=patience, ask=ask)

    if out is None:
        with (
            tempfile.TemporaryDirectory() as name,
            trials_in(Path(name)) as journal,
            Scalars(tensorboard) as scalars,
        ):
            return results(evolution.run(None, progress, journal, scalars))
    folders = folders_of(Path(out), settings.runs if keep_all else 1)
    checkpoint = Checkpoint(out, "evolution")
    begun = {
        **asdict(settings),
        **{name: value for name, value in about.items() if name != "settings"},
        "task": task.describe(),
        "controller": {"kind": controller.kind, "settings": controller.settings()},
        "simulator_sha256": None if source is None else digest(source),
        "perimeter": perimeter,
        "real_generations": real_generations,
    }
    with checkpoint.held():
        if not resume:
            checkpoint.check_none()
        for folder in folders:
            check_new_folder(folder, overwrite=resume and _unfinished(folder))
        if resume:
            state = checkpoint.resume(begun)
            if state is not None:
                try:
                    evolution.load(state)
                except (KeyError, ValueError, RuntimeError, TypeError):
                    raise checkpoint.damaged() from None
        else:
            checkpoint.begin(begun, options)

        def written(interrupted: bool) -> list[SavedController]:
            controllers = results(interrupted)
            if controller.open_loop and not controllers[0].given:
                if interrupted:
                    raise UserError("no plan has a command yet; continue with --resume")
                checkpoint.remove()
                raise UserError("the best plan has no command; use more generations")
            for folder, one in zip(folders, controllers, strict=False):
                one.write(folder, overwrite=resume)
            if not interrupted:
                checkpoint.remove()
            return controllers

        try:
            with trials_in(checkpoint.folder) as journal, Scalars(tensorboard) as scalars:
                interrupted = evolution.run(checkpoint, progress, journal, scalars)
                if evolution.real is not None:
                    return written(interrupted)
            # The result is judged and written before Ctrl-C is handled.
            with uninterrupted():
                return written(interrupted)
        except RobotError as error:
            if not evolution.stages[0].done:
                raise
            written(True)
            raise type(error)(
                f"{error}; the best controller so far is in {out}, continue with --resume"
            ) from None
        except KeyboardInterrupt:
            if evolution.real is None:
                raise
            return written(True)
        finally:
            if not evolution.stages[0].done and not resume:
                checkpoint.remove()  # nothing was saved


def _in_reality(real: Transfer | None, reality: Reality | None, seed: int) -> dict[str, Any]:
    """Return the description of the generations in reality, and paths to compare."""
    if real is None or real.chosen is None:
        return {}
    mean, spread = float(real.again.mean()), float(real.again.std(ddof=1))
    about: dict[str, Any] = {
        "robot_fitness": {"mean": mean, "spread": spread, "trials": len(real.again)}
    }
    if isinstance(reality, Comparing):
        about["trajectories"] = reality.compare(real.chosen, seed)
    return about


def folders_of(out: Path, count: int) -> list[Path]:
    """Return the folders of the controllers of a number of runs."""
    if count == 1:
        return [out]
    return [out.with_name(f"{out.name}-{run + 1:02d}") for run in range(count)]


def _unfinished(folder: Path) -> bool:
    """Return whether a folder is the best controller so far of an interrupted evolution."""
    if not (folder / "controller.json").exists():
        return False
    return bool(read_controller(folder).evolution.get("interrupted"))
