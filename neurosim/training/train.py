"""From a dataset to a simulator."""

from __future__ import annotations

import math
import time
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neurosim.base import files
from neurosim.base.declared import Seed, checks
from neurosim.base.errors import UserError
from neurosim.base.perimeter import Perimeter
from neurosim.base.progress import Progress
from neurosim.base.scalars import Scalars
from neurosim.simulators import MotionNetwork
from neurosim.simulators.motion.domain import Domain
from neurosim.simulators.motion.files import write_motion
from neurosim.simulators.registry import check_device
from neurosim.training.base import Trainer, TrainingData, Within
from neurosim.training.evaluate import compare
from neurosim.training.sensors import learn_sensors
from neurosim.training.trainers.registry import DEFAULT, trainer_class, trainer_settings
from neurosim.training.trainers.windows import LENGTHS
from tracking.datasets.dataset import OUTPUTS, Dataset

#: Fraction of rows, last in time, that training never uses.
HELD_OUT = 0.2

#: Smallest number of rows for training.
MIN_ROWS = 20

#: Approximate number of generations in the history.
_HISTORY = 200


@checks
def train(
    dataset: str | Path,
    out: str | Path,
    *,
    trainer: str = DEFAULT,
    seed: Seed = 0,
    device: str = "cpu",
    sensors: bool = True,
    progress: bool = True,
    tensorboard: str | Path | None = None,
    **settings: Any,
) -> MotionNetwork:
    """Learn a simulator from all but the last fifth of a dataset's rows, and write it to ``out``.

    Args:
        dataset: a dataset folder.
        out: the simulator folder to write.
        trainer: a name in :data:`neurosim.training.trainers.registry.TRAINERS`.
        seed: random seed.
        device: Where the trainer ga computes, as PyTorch names it; the others compute on the CPU.
        sensors: Learn the sensors whose readings the dataset has.
        progress: show progress on stderr.
        tensorboard: folder for curves of the errors (extra ``tensorboard``); None: there are none.
        **settings: the trainer's own settings that differ from its defaults.

    Raises:
        UserError: if the dataset is too small, a setting is invalid, or ``out`` exists.
        FileError: if a file is missing or wrong.

    Example:
        >>> simulator = ns.train(
        ...     "data/reference", "trained", trainer="ga", generations=2, progress=False
        ... )  # for a first look: leave trainer and generations out
        >>> simulator.command_names
        ('left', 'right', 'duration')
    """
    files.check_new_folder(out)
    chosen = trainer_settings(trainer, settings)
    check_device(device)
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
    source = {
        "dataset": Path(dataset).name,
        "sha256": files.sha256(Path(dataset) / "dataset.csv"),
        "virtual": bool(rows.meta.get("virtual", False)),
    }
    for name in ("within", "readings"):
        path = Path(dataset) / f"{name}.csv"
        if path.exists():
            source[f"{name}_sha256"] = files.sha256(path)
    began = time.monotonic()
    with Scalars(tensorboard) as scalars:
        learner = new_learner(data, seed, trainer, chosen, device)
        history = _advanced(learner, progress, scalars)
    simulator = learner.result()
    simulator.known = domain_of(simulator, data, chosen)
    readings = {}
    if sensors and len(rows.readings) > 0:
        simulator.sensors, readings["readings"] = learn_sensors(
            rows.readings, HELD_OUT, progress=progress
        )
    simulator.perimeter = Perimeter.from_json(rows.meta.get("perimeter"))
    compared = compare(simulator, earlier, later, seed)
    simulator.meta = {
        **simulator.meta,
        **readings,
        "perimeter": rows.meta.get("perimeter"),
        "training": {
            "trainer": trainer,
            "source": learner.source,
            "seed": seed,
            "device": getattr(learner, "device", device),
            "held_out": HELD_OUT,
            **asdict(chosen),
            "rows": len(earlier),
            "held_out_rows": len(later),
            "repeated_rows": repeated,
        },
        "history": history,
        "test_window": compared.window,
        "test_errors": compared.errors(),
        "test_explained": compared.explained(),
        "test_coverage": compared.coverage(),
        "source": source,
        "wall_clock": {"training_seconds": round(time.monotonic() - began, 1)},
    }
    with files.new_folder(out) as folder:
        write_motion(simulator, folder)
    return simulator


def _advanced(learner: Trainer, progress: bool, scalars: Scalars) -> list[dict[str, Any]]:
    """Run all generations; return the mean squared errors of about :data:`_HISTORY` of them."""
    history, total = [], learner.generations
    stride = max(1, total // _HISTORY)
    with Progress("training", total, "steps") if progress else nullcontext() as shown:
        for generation in range(1, total + 1):
            mse = learner.advance().tolist()
            for name, value in zip(OUTPUTS, mse, strict=True):
                scalars.add(f"training/rms-{name}", math.sqrt(value), generation)
            if generation in (1, total) or generation % stride == 0:
                history.append({"generation": generation, "mse": mse})
            if shown is not None:
                shown.advance(note=_figures(mse))
    return history


def training_data(dataset: Dataset) -> TrainingData:
    """Return a dataset's rows as tensors."""
    within, joined = dataset.within, dataset.joined
    poses = within[["dx", "dy", "dtheta"]].to_numpy(np.float64, copy=True)
    starts = dataset.start_array()
    return TrainingData(
        dataset.meta["inputs"],
        torch.tensor(dataset.input_array()),
        torch.tensor(dataset.output_array()),
        Within(
            torch.tensor(within["row"].to_numpy(np.int64, copy=True)),
            torch.tensor(within["time"].to_numpy(np.float64, copy=True)),
            torch.tensor(poses),
        ),
        joined=None if joined is None else torch.from_numpy(joined),
        start=None if starts is None else torch.from_numpy(starts),
    )


def new_learner(
    data: TrainingData, seed: int, trainer: str, settings: Any, device: str = "cpu"
) -> Trainer:
    """Return a trainer, ready for its first generation.

    Args:
        data: the training rows.
        seed, trainer, device: as in :func:`train`.
        settings: of the trainer, of its own class.

    Raises:
        UserError: if a setting is invalid.
    """
    try:
        return trainer_class(trainer)(data, settings, seed, device)
    except ValueError as error:
        raise UserError(f"trainer {trainer!r} has invalid settings: {error}") from None


def learn(
    data: TrainingData, seed: int, *, trainer: str = DEFAULT, **settings: Any
) -> MotionNetwork:
    """Return a simulator learned from all rows of the data, with settings of the trainer."""
    learner = new_learner(data, seed, trainer, trainer_settings(trainer, settings))
    for _ in range(learner.generations):
        learner.advance()
    return learner.result()


def domain_of(simulator: MotionNetwork, data: TrainingData, settings: Any) -> Domain:
    """Return the domain of the commands from which a simulator has learned.

    A drive model that has learned from poses within commands knows the beginning of each. One that
    has learned from windows of a log has composed their commands to the longest window, so a
    command may last as long.

    Args:
        simulator: the simulator learned from the data.
        data: the rows.
        settings: of the trainer.
    """
    places = [simulator.input_names.index(name) for name in simulator.command_names]
    inside = data.within is not None and len(data.within.row) > 0
    begins = (
        simulator.drive is not None and inside and not getattr(settings, "whole_commands", False)
    )
    commands = data.x[:, places].cpu().numpy().copy()
    if data.joined is not None and simulator.drive is not None:
        begins = True
        lasts = commands[:, simulator.command_names.index("duration")]
        np.maximum(lasts, LENGTHS[-1], out=lasts)
    return Domain.of(simulator.command_names, commands, begins=begins)


def _figures(mse: list[float]) -> str:
    dx, dy, dtheta = (math.sqrt(value) for value in mse)
    return f"rms {100 * dx:.2f} cm, {100 * dy:.2f} cm, {math.degrees(dtheta):.2f} deg"
