"""A whole run of back to reality: from a simulator, a controller and a reality to a folder."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.back_to_reality.alternate import Adaptation, Alternation
from neurosim.back_to_reality.settings import BackToRealitySettings, settings_named
from neurosim.back_to_reality.simulated import Simulated
from neurosim.base import files, formats
from neurosim.base.checkpoint import Checkpoint
from neurosim.base.errors import FileError, UserError, counted
from neurosim.base.scalars import Scalars
from neurosim.controllers import Plan, SavedController, read_controller
from neurosim.controllers.base import Controller
from neurosim.controllers.files import check_readable
from neurosim.loop.evaluate import Evaluator
from neurosim.loop.evolve import path_of
from neurosim.loop.journal import TRIALS, Journal, Reality, about_reality
from neurosim.simulators.base import Simulator
from neurosim.simulators.registry import read_simulator, write_simulator
from neurosim.simulators.sources import digest
from neurosim.tasks.base import Task

FORMAT, VERSION = "neurosim-back-to-reality", 1
GENES_FORMAT, GENES_VERSION = "neurosim-parameters", 1
#: Number of poses of the expected path that are written with a controller.
_POSES = 200


def start_genes(controller: Controller, path: str | Path | None = None) -> NDArray[np.float64]:
    """Return the genes [G] to start from.

    Args:
        controller: the family.
        path: a controller's folder; or a JSON file with the controller's parameters by name, or
            with ``genes``. None: the hand-tuned genes, if the controller has any.

    Raises:
        UserError: if there is nothing to start from, or it is of another kind or out of the
            controller's range of genes.
        FileError: if the file is missing or wrong.
    """
    if path is None:
        if (tuned := controller.hand_tuned()) is None:
            raise UserError(
                "name the controller to start from (--start): there is no hand-tuned "
                f"{controller.kind}"
            )
        return np.asarray(tuned, np.float64)
    genes, (low, high) = _read_genes(controller, path), controller.gene_range
    if not ((genes >= low) & (genes <= high)).all():
        raise UserError(
            f"{path}: a gene lies outside of {low:g} to {high:g}, where controllers of the kind "
            f"{controller.kind} are searched"
        )
    return genes


def _read_genes(controller: Controller, path: str | Path) -> NDArray[np.float64]:
    """Return the genes [G] that a file or a controller's folder holds."""
    if Path(path).is_dir():
        saved = read_controller(path)
        if saved.commands and isinstance(controller, Plan):
            return _genes_of_plan(controller, saved, path)
        if saved.kind != controller.kind or saved.genes.shape != (controller.genes,):
            raise UserError(
                f"{path} holds a {saved.kind} of {saved.genes.size} genes; expected a "
                f"{controller.kind} of {controller.genes}"
            )
        return saved.genes
    content = files.read_json(path, GENES_FORMAT, GENES_VERSION, formats.Genes)
    named = content.get("parameters")
    if named is not None:
        try:
            return np.asarray(controller.from_named(named), np.float64)
        except UserError as error:
            raise FileError(path, str(error), field="parameters") from None
    genes = np.array(content.get("genes", ()), np.float64)
    if genes.shape != (controller.genes,):
        raise FileError(path, f"expected {controller.genes} finite numbers", field="genes")
    return genes


def _genes_of_plan(controller: Plan, saved: SavedController, path: str | Path) -> NDArray:
    """Return the genes [G] of a plan that was saved as its commands."""
    room = controller.slots - len(saved.commands)
    if room < 0:
        raise UserError(
            f"{path} has {counted(len(saved.commands), 'command')}; expected at most "
            f"{controller.slots}"
        )
    return controller.encode([*saved.commands, *[None] * room])


def back_to_reality(
    simulator: Simulator | str | Path,
    task: Task,
    controller: Controller,
    reality: Reality,
    *,
    out: str | Path,
    start: NDArray[np.float64] | None = None,
    settings: BackToRealitySettings | None = None,
    seed: int = 0,
    resume: bool = False,
    options: Mapping[str, Any] | None = None,
    ask: Callable[[str], None] | None = None,
    patience: float = 600.0,
    progress: bool = True,
    tensorboard: str | Path | None = None,
) -> dict[str, Any]:
    """Adapt a controller and a simulator to each other, and write the result.

    While it runs ``OUT.checkpoint`` holds the trials made so far and the state of the search.

    Args:
        simulator: with adjustable parameters, or the folder of one.
        task: judges trials in the simulator.
        controller: the family.
        reality: tries controllers.
        out: folder of the result: ``back-to-reality.json``, ``trials.jsonl``, ``controller`` (if
            the best is not a plan without any command) and, of a simulator that can be written,
            ``simulator``.
        start: [G] the genes to start from; None: those tuned by hand.
        settings: of the alternation; by default neurosim's own, ``settings_named("better")``.
        seed: random seed.
        resume: continue the interrupted run of ``out``.
        options: kept in the checkpoint, for resuming.
        ask: asks a person to do something, and returns when it is done.
        patience: longest time of a trial in reality, s.
        progress: whether to show progress on stderr.
        tensorboard: folder for curves of the fitness in reality and of each search (extra
            ``tensorboard``); None: there are none.

    Returns:
        The content of ``back-to-reality.json``.

    Raises:
        UserError: if they do not fit each other, ``out`` exists already, or the run to be resumed
            does not exist or was begun with other settings.
        RobotError: if reality did not answer; continue with ``resume``.
        KeyboardInterrupt: at Ctrl-C; continue with ``resume``.
    """
    settings = settings or settings_named("better")
    check_readable(controller)
    written = None
    if isinstance(simulator, str | Path):
        written = digest(simulator)
        simulator = read_simulator(simulator)
    simulated = Simulated(simulator, task, controller)
    fractions = simulated.fractions_of(start_genes(controller) if start is None else start)
    if start is not None:
        controller.check(np.asarray(start, np.float64))
    begun = {
        **asdict(settings),
        "simulator": {
            "kind": simulator.kind,
            "sha256": written,
            "parameters": {one.name: asdict(one) for one in simulated.parameters},
            **simulator.conditions(),
        },
        "seed": seed,
        "task": task.describe(),
        "controller": {"kind": controller.kind, "settings": controller.settings()},
        "reality": about_reality(reality),
        "start": simulated.real_genes(fractions).tolist(),
    }
    files.check_new_folder(out)
    checkpoint = Checkpoint(out, "run")
    with checkpoint.held():
        state = None
        if resume:
            state = checkpoint.resume(begun)
        else:
            checkpoint.begin(begun, options)
        journal = None
        try:
            with (
                Scalars(tensorboard) as scalars,
                Journal(
                    reality,
                    checkpoint.folder / TRIALS,
                    each=settings.trials,
                    patience=patience,
                    ask=ask,
                    progress=progress,
                ) as journal,
            ):
                result = Alternation(
                    simulated, journal, fractions, settings, seed=seed, state=state,
                    save=checkpoint.save, progress=progress, scalars=scalars,
                ).run()  # fmt: skip
        finally:
            if not ((journal and journal.made) or resume or checkpoint.saved):
                checkpoint.remove()  # nothing came of it
        content = _content(result, simulated, begun, task, controller)
        with files.new_folder(out) as partial:
            shutil.copyfile(checkpoint.folder / TRIALS, partial / TRIALS)
            kept = write_simulator(simulated.adjusted(result.parameters), partial / "simulator")
            saved = _controller(result, simulated, task, controller, content, kept)
            if saved.kind != "plan" or saved.given:
                saved.write(partial / "controller")
            files.write_json(partial / "back-to-reality.json", FORMAT, VERSION, content)
        checkpoint.remove()
        return content


def _content(
    result: Adaptation,
    simulated: Simulated,
    begun: Mapping[str, Any],
    task: Task,
    controller: Controller,
) -> dict[str, Any]:
    genes = simulated.real_genes(result.genes)
    named = controller.named(genes)
    parameters = [
        {"name": one.name, "unit": one.unit, "low": one.low, "high": one.high, "before": one.value}
        for one in simulated.parameters
    ]
    settings = {name: begun[name] for name in asdict(BackToRealitySettings())}
    return {
        "task": begun["task"],
        "controller": {**begun["controller"], "genes": genes, "named": named},
        "reality": begun["reality"],
        "settings": settings,
        "seed": begun["seed"],
        "parameters": parameters,
        "start": {"genes": begun["start"], "fitness": result.start},
        "best": {"fitness": result.fitness, "times_start": _times(result)},
        "evaluations": result.evaluations,
        "trials": result.trials,
        "simulated_trials": simulated.tried,
        "real": [one.fitness for one in result.record.all],
        "believed": [
            result.record.believed(settings["confirm"], first + 1).fitness
            for first in range(len(result.record))
        ],
        "cycles": result.cycles,
    }


def _times(result: Adaptation) -> float | None:
    return result.fitness / result.start if result.start > 0.0 else None


def _controller(
    result: Adaptation,
    simulated: Simulated,
    task: Task,
    controller: Controller,
    content: Mapping[str, Any],
    kept: bool,
) -> SavedController:
    """Return the best controller as it is saved, with the adapted simulator's prediction."""
    genes = simulated.real_genes(result.genes)
    evaluator = Evaluator(simulated.adjusted(result.parameters), task, controller)
    judged, trajectory = evaluator.judge(genes[None], evaluator.expectation())
    assert trajectory.poses is not None
    fitness = float(judged.fitness[0].mean())
    poses, rest = path_of(trajectory, 0, evaluator)
    # The best in reality may fall or blow up in the simulator: the last finite pose is repeated.
    expected = np.isfinite(poses).all(axis=1)
    if controller.kind == "plan":
        poses = poses[np.maximum.accumulate(np.where(expected, np.arange(len(poses)), 0))]
        rest = rest if np.isfinite(rest).all() else poses[-1]
    else:
        poses = poses[expected]
        poses = poses[np.unique(np.linspace(0, len(poses) - 1, _POSES).round().astype(int))]
        rest = poses[-1]
    return SavedController.of(
        controller,
        genes,
        content["task"],
        tuple(poses[0].tolist()),
        {
            "poses": poses.tolist(),
            "rest": rest.tolist(),
            "fitness": fitness if math.isfinite(fitness) else 0.0,
            "completes": bool(judged.success[0].all()),
            "unsupported": 0.0,
        },
        {"path": "simulator"} if kept else {},
        {
            "settings": content["settings"],
            "seed": content["seed"],
            "run": 0,
            "interrupted": False,
            "robot": content["reality"],
            "fitness_in_reality": result.fitness,
            "history": result.cycles[-1]["L1"] if result.cycles else {"best": [], "mean": []},
        },
    )
