"""From a dataset to a simulator."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor

from neurosim.base import files
from neurosim.base.checkpoint import Checkpoint
from neurosim.base.declared import Count, Seed, checks
from neurosim.base.errors import UserError
from neurosim.base.generations import run_generations
from neurosim.simulators import MotionNetwork
from neurosim.simulators.motion.domain import Domain
from neurosim.simulators.motion.files import write_motion
from neurosim.training.base import TrainingData, Within
from neurosim.training.coverage import coverage
from neurosim.training.evaluate import table_of_errors
from neurosim.training.sensors import learn_sensors
from neurosim.training.trainers.registry import DEFAULT, trainer_class, trainer_settings
from neurosim.training.uncertainty.ensemble import EnsembleTrainer
from tracking.datasets.dataset import Dataset

#: Networks of each output in an ensemble.
MEMBERS = 8

#: The trainer that stands for the paper: alone and without noise unless more is asked for.
PAPER = "ga"

#: The share of rows, last in time, that is never seen by training.
HELD_OUT = 0.2

#: Fewer rows than this are not a recording of a robot.
MIN_ROWS = 20

#: About as many generations stand in the history.
_HISTORY = 200

#: No ensemble has more networks of each output.
MOST_MEMBERS = 1000


#: Numbers of units of a kind.
Units = Annotated[int, Meta(ge=0, le=4096)]


@checks
def train(
    dataset: str | Path,
    out: str | Path,
    *,
    trainer: str = DEFAULT,
    members: Annotated[int, Meta(ge=1, le=MOST_MEMBERS)] | None = None,
    noise: bool | None = None,
    generations: Count | None = None,
    seed: Seed = 0,
    hidden: tuple[Units, Units] | None = None,
    activations: tuple[str, str] = ("linear", "linear"),
    settings: Mapping[str, Any] | None = None,
    device: str = "cpu",
    sensors: bool = True,
    resume: bool = False,
    options: Mapping[str, Any] | None = None,
    checkpoint_every: float = 5.0,
    progress: bool = True,
) -> MotionNetwork:
    """Learn a simulator from all but the last fifth of a dataset's rows, and write it to ``out``.

    While it runs, ``OUT.checkpoint`` holds what an interrupted training goes on from; one that
    was interrupted and resumed ends with the same simulator, bit for bit.

    Args:
        dataset: a dataset folder.
        out: the simulator folder to write.
        trainer: a name in :data:`neurosim.training.trainers.registry.TRAINERS`.
        members: Networks of each output in the ensemble; by default 8, and 1 of the paper's trainer
            ga.
        noise: Fit a noise model; by default yes, and no for the paper's trainer ga.
        generations: Generations of each search; by default as many as the trainer needs.
        seed: random seed.
        hidden: Numbers of product units and of summation units; by default the trainer's own.
        activations: Activations of the hidden units and of the output: linear, tanh or sigmoid. A
            perceptron has its own.
        settings: the trainer's own settings that are not to be its defaults.
        device: Where to compute, as PyTorch names it.
        sensors: Learn the sensors whose readings the dataset has.
        resume: go on with the interrupted training of ``out``.
        options: kept in the checkpoint, for whoever resumes.
        checkpoint_every: seconds between checkpoints; no more than this is lost.
        progress: show progress on stderr.

    Raises:
        UserError: if the dataset is too small, a setting cannot be, ``out`` is taken, or what is
            to be resumed is not there or was begun with other settings.
        FileError: if a file is missing or wrong.
    """
    files.check_new_folder(out)
    chosen = trainer_settings(trainer, dict(settings or {}))
    kind = trainer_class(trainer)
    generations = kind.default_generations if generations is None else generations
    members = (1 if trainer == PAPER else MEMBERS) if members is None else members
    noise = trainer != PAPER if noise is None else noise
    hidden = kind.default_hidden if hidden is None else hidden
    _check_device(device)
    rows = Dataset.read(dataset)
    repeated = rows.repeated
    different = len(rows) - repeated
    if different < MIN_ROWS:
        raise UserError(
            f"{dataset} has {different} different rows, of which the last fifth is held out; "
            f"training needs at least {MIN_ROWS}: record more commands"
        )
    earlier, later = rows.split(HELD_OUT)
    data = training_data(earlier)
    begun = {
        "trainer": trainer,
        "source": kind.source,
        "members": members,
        "noise": noise,
        "generations": generations,
        "seed": seed,
        "device": device,
        "hidden": list(hidden),
        "activations": list(activations),
        "held_out": HELD_OUT,
        **asdict(chosen),
    }
    source = {
        "dataset": Path(dataset).name,
        "sha256": files.sha256(Path(dataset) / "dataset.csv"),
        "virtual": bool(rows.meta.get("virtual", False)),
    }
    poses = Path(dataset) / "within.csv"
    if poses.exists():
        source["within_sha256"] = files.sha256(poses)
    senses = sensors and len(rows.readings) > 0
    if senses:
        source["readings_sha256"] = files.sha256(Path(dataset) / "readings.csv")
    learner = new_learner(
        data,
        seed,
        trainer=trainer,
        settings=chosen,
        members=members,
        noise=noise,
        generations=generations,
        hidden=hidden,
        activations=activations,
        device=device,
    )
    checkpoint = Checkpoint(out, "training")
    settings_now = {**begun, "dataset_sha256": source["sha256"]}
    settings_now["within_sha256"] = source.get("within_sha256")
    if senses:
        settings_now["readings_sha256"] = source["readings_sha256"]
    run = _Training(learner)
    with checkpoint.held():
        if resume:
            run.resume(checkpoint, settings_now)
        else:
            checkpoint.begin(settings_now, options)
        if run_generations(
            run,
            learner.generations,
            "training",
            save=checkpoint.save,
            every=checkpoint_every,
            progress=progress,
        ):
            raise KeyboardInterrupt
        began = time.monotonic()
        simulator = learner.result()
        simulator.known = domain_of(simulator, data, chosen)
        readings = {}
        if senses:
            simulator.sensors, readings["readings"] = learn_sensors(
                rows.readings, HELD_OUT, progress=progress
            )
        run.seconds += time.monotonic() - began
        simulator.meta = {
            **simulator.meta,
            **readings,
            "training": {
                **begun,
                "rows": len(earlier),
                "held_out_rows": len(later),
                "repeated_rows": repeated,
            },
            "history": [
                {"generation": int(generation), "mse": mse} for generation, *mse in run.history
            ],
            "test_errors": table_of_errors(simulator, later),
            "test_coverage": coverage(simulator, later, seed),
            "source": source,
            "wall_clock": {"training_seconds": round(run.seconds, 1)},
        }
        with files.new_folder(out) as folder:
            write_motion(simulator, folder)
        checkpoint.remove()
        return simulator


def training_data(dataset: Dataset) -> TrainingData:
    """Return a dataset's rows as tensors."""
    within = dataset.within
    poses = within[["dx", "dy", "dtheta"]].to_numpy(np.float64, copy=True)
    return TrainingData(
        dataset.meta["inputs"],
        torch.tensor(dataset.input_array()),
        torch.tensor(dataset.output_array()),
        Within(
            torch.tensor(within["row"].to_numpy(np.int64, copy=True)),
            torch.tensor(within["time"].to_numpy(np.float64, copy=True)),
            torch.tensor(poses),
        ),
    )


def new_learner(
    data: TrainingData,
    seed: int,
    *,
    trainer: str = DEFAULT,
    settings: Any = None,
    members: int = MEMBERS,
    noise: bool = True,
    generations: int | None = None,
    hidden: tuple[int, int] | None = None,
    activations: tuple[str, str] = ("linear", "linear"),
    device: str = "cpu",
) -> Any:
    """Return what learns an ensemble and its noise model, ready for its first generation.

    Args:
        data: rows to learn from.
        settings: of the trainer, of its own class; its defaults if not given.
        seed, trainer, members, noise, generations, hidden, activations, device: as :func:`train`.

    Raises:
        UserError: if a setting cannot be.
    """
    kind = trainer_class(trainer)
    settings = kind.settings_type() if settings is None else settings
    generations = kind.default_generations if generations is None else generations
    asked = {"members": members, "noise": noise, "generations": generations}
    try:
        network = kind.make_network(len(data.inputs), hidden or kind.default_hidden, activations)
        if getattr(kind, "makes_ensembles", False):
            return kind(data, network, settings, seed, device, **asked)
        return EnsembleTrainer(kind, data, network, settings, seed, device, **asked)
    except ValueError as error:
        raise UserError(f"trainer {trainer!r} has invalid settings: {error}") from None


def learn(data: TrainingData, seed: int, **options: Any) -> MotionNetwork:
    """Return a simulator learned from all these rows; options are those of :func:`new_learner`."""
    learner = new_learner(data, seed, **options)
    for _ in range(learner.generations):
        learner.advance()
    return learner.result()


def domain_of(simulator: MotionNetwork, data: TrainingData, settings: Any) -> Domain:
    """Return the commands that a simulator has learned from.

    A drive model that has learned from poses within commands knows how each of them began.

    Args:
        simulator: what was made of the data.
        data: the rows.
        settings: of the trainer.
    """
    places = [simulator.input_names.index(name) for name in simulator.command_names]
    inside = data.within is not None and len(data.within.row) > 0
    begins = (
        simulator.drive is not None and inside and not getattr(settings, "whole_commands", False)
    )
    return Domain.of(simulator.command_names, data.x[:, places].cpu().numpy(), begins=begins)


class _Training:
    """A training under way: a :class:`~neurosim.base.generations.Stage`.

    Attributes:
        done: generations so far.
        history: of some generations [generation, three mean squared errors].
        seconds: worked so far.
    """

    def __init__(self, learner: Any):
        self._learner = learner
        self._stride = max(1, learner.generations // _HISTORY)
        self.done = 0
        self.history: list[list[float]] = []
        self.seconds = 0.0

    def generation(self) -> str:
        """Work one generation; return the errors so far."""
        began = time.monotonic()
        mse = self._learner.advance().tolist()
        self.done += 1
        if self.done in (1, self._learner.generations) or self.done % self._stride == 0:
            self.history.append([self.done, *mse])
        self.seconds += time.monotonic() - began
        return _figures(mse)

    def state(self) -> dict[str, Tensor]:
        """Return all that the next generations depend on."""
        state: dict[str, Tensor] = {f"trainer.{k}": v for k, v in self._learner.state().items()}
        state["run.generation"] = torch.tensor([self.done])
        state["run.history"] = torch.tensor(self.history, dtype=torch.float64)
        state["run.seconds"] = torch.tensor([self.seconds], dtype=torch.float64)
        return state

    def resume(self, checkpoint: Checkpoint, settings: Mapping[str, Any]) -> None:
        """Go on from a checkpoint of a training that was begun with the same settings.

        Raises:
            UserError: if there is none, or it was begun with others.
            FileError: if it is damaged.
        """
        state = checkpoint.resume(settings)
        if state is None:
            return
        tensors = {name: torch.from_numpy(value) for name, value in state.items()}
        try:
            self._learner.load(
                {
                    k.removeprefix("trainer."): v
                    for k, v in tensors.items()
                    if k.startswith("trainer.")
                }
            )
            self.done = int(tensors["run.generation"])
            self.history = tensors["run.history"].tolist()
            self.seconds = float(tensors["run.seconds"])
        except (KeyError, ValueError, RuntimeError):
            raise checkpoint.damaged() from None


def _figures(mse: list[float]) -> str:
    dx, dy, dtheta = (math.sqrt(value) for value in mse)
    return f"rms {100 * dx:.2f} cm, {100 * dy:.2f} cm, {math.degrees(dtheta):.2f} deg"


def _check_device(device: str) -> None:
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError):
        raise UserError(f"PyTorch has no device {device!r} on this computer; try cpu") from None
