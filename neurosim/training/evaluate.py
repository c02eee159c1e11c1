"""The errors of a simulator, as in Table 2 of Pretorius et al. 2009."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base import files, se2
from neurosim.base.errors import UserError
from neurosim.simulators import MotionNetwork, read_simulator
from neurosim.training.coverage import coverage
from neurosim.training.trainers.windows import LENGTHS, windows_of
from neurosim.training.unicycle import unicycle
from tracking.datasets.dataset import Dataset

#: Table 2 of the paper: final MSE (cm^2, deg^2) and average absolute error (cm, deg), by the names
#: of the outputs here (its change in y is dx here, its change in x is -dy).
PAPER = {
    "dx": {"mse": 12.909, "mean_absolute_error": 2.143},
    "dy": {"mse": 18.559, "mean_absolute_error": 2.782},
    "dtheta": {"mse": 26.412, "mean_absolute_error": 3.585},
}

#: Length of the windows for errors if rows follow one another, s.
WINDOW = 1.0
#: Time after which a robot has a command's final speeds, s.
_CALM = 5.0

#: Factors from metres and radians to centimetres and degrees, and the units' names.
READABLE = {"dx": 100.0, "dy": 100.0, "dtheta": 180.0 / np.pi}
UNITS = {"dx": "cm", "dy": "cm", "dtheta": "deg"}


def evaluate(
    simulator: str | Path, dataset: str | Path, held_out_only: bool = True
) -> dict[str, Any]:
    """Compare a simulator's predictions with the actual displacements.

    Args:
        simulator: a simulator folder.
        dataset: a dataset folder.
        held_out_only: from the training dataset, use only the held-out rows; from any other dataset
            all rows are used.

    Returns:
        number of ``rows``, ``which`` rows in words, ``held_out`` (bool), ``errors`` by output
        (``mse``, ``mean_absolute_error``, ``unit``) of the simulator, the same of ``paper`` and
        of the ideal unicycle (``baseline``: description and errors; None if the inputs are not a
        unicycle's); ``coverage`` of its intervals, as :func:`neurosim.training.coverage.coverage`,
        None without a noise model.

    Raises:
        FileError: if a file is missing or wrong.
        UserError: if the dataset's inputs are not the simulator's.
    """
    network = read_simulator(simulator)
    if not isinstance(network, MotionNetwork):
        raise UserError(f"{simulator} is not a motion network: it was not learned from a dataset")
    rows = Dataset.read(dataset)
    if rows.inputs != network.input_names:
        raise UserError(
            f"{dataset} has the inputs {', '.join(rows.inputs)}, but {simulator} takes "
            f"{', '.join(network.input_names)}; name a dataset of the same robot"
        )
    held_out = _held_out_fraction(network, dataset)
    own = held_out is not None
    fitted_to = used = rows
    if own:
        fitted_to, later = rows.split(held_out)
        used = later if held_out_only else rows
    ideal = unicycle(fitted_to)
    baseline = None
    if ideal is not None:
        predicted = ideal.displacement(used.input_array())
        baseline = {
            "description": ideal.description,
            "errors": errors(predicted, used.output_array()),
        }
    which = "all rows of another dataset than it was trained on"
    if own:
        which = "the last rows, held out of training" if held_out_only else "all rows, seen or not"
    return {
        "rows": len(used),
        "which": which,
        "held_out": own and held_out_only,
        "errors": table_of_errors(network, used),
        "coverage": coverage(network, used),
        "paper": {name: {**PAPER[name], "unit": UNITS[name]} for name in PAPER},
        "baseline": baseline,
    }


def _held_out_fraction(network: MotionNetwork, dataset: str | Path) -> float | None:
    """Return the fraction of a dataset's rows that the simulator's training held out."""
    source, training = network.meta.get("source"), network.meta.get("training")
    if not isinstance(source, dict) or not isinstance(training, dict):
        return None
    if source.get("sha256") != files.sha256(Path(dataset) / "dataset.csv"):
        return None
    return training.get("held_out")


def predict(network: MotionNetwork, rows: Dataset) -> NDArray:
    """Return a simulator's predicted displacements (N, 3) for a dataset's rows.

    If rows follow one another, it drives through them, with the speeds reached.
    """
    if rows.joined is not None and network.drive is not None:
        return _driven(network, rows, rows.joined)
    inputs = torch.tensor(rows.input_array(), device=network.genes.device)
    moved = network.displacement_of(network.chained(inputs))
    starts = rows.start_array()
    if starts is not None:
        moved = network.on_floor(torch.from_numpy(starts).to(moved), moved)
    return moved.cpu().numpy()


def _driven(network: MotionNetwork, rows: Dataset, joined: NDArray[np.bool_]) -> NDArray:
    """Return the displacements (N, 3) in rows that follow one another, all drives in parallel."""
    inputs = rows.input_array()
    names = list(rows.inputs)
    own = [names.index(name) for name in network.command_names]
    before = [names.index(f"prev_{n}" if n != "duration" else n) for n in network.command_names]
    starts = np.flatnonzero(~joined)
    lasts = np.diff(np.append(starts, len(inputs)))
    # Each drive begins with the final speeds of the previous command.
    calm = inputs[starts][:, before]
    calm[:, network.command_names.index("duration")] = step = min(network.longest, _CALM)
    state = network.start(torch.zeros(len(starts), 3, dtype=torch.float64), member=-1)
    for _ in range(math.ceil(_CALM / step)):
        state = network.step(state, torch.from_numpy(calm))
    moved, where = np.zeros((len(inputs), 3)), rows.start_array()
    for number in range(lasts.max()):
        going = np.flatnonzero(lasts > number)
        place = starts[going] + number
        was = state[going]
        if where is not None:  # with the floor's effect there
            was[:, :3] = torch.from_numpy(where[place])
        state[going] = network.step(was, torch.from_numpy(inputs[place][:, own]))
        moved[place] = se2.between(was[:, :3].numpy(), state[going, :3].numpy())
    return moved


def windows_of_rows(
    rows: Dataset, joined: NDArray[np.bool_], displacement: NDArray
) -> dict[float, NDArray]:
    """Return the displacements in windows of a length (s) of rows that follow one another.

    Args:
        rows: the rows, with their durations.
        joined: whether a row begins at the end of the previous one, (N,).
        displacement: displacements of the rows, (N, 3).
    """
    duration = torch.tensor(rows.table["duration"].to_numpy(np.float64, copy=True))
    windows = windows_of(duration, torch.from_numpy(joined))
    poses = [np.zeros(3)]
    for each in displacement:
        poses.append(se2.compose(poses[-1], each))
    ends = np.array(poses)
    moved = se2.between(ends[windows.first.numpy()], ends[windows.end.numpy()])
    return {length: moved[windows.kind.numpy() == k] for k, length in enumerate(LENGTHS)}


def table_of_errors(network: MotionNetwork, rows: Dataset) -> dict[str, dict[str, Any]]:
    """Return a simulator's errors on a dataset's rows, in the form of :func:`errors`.

    If rows follow one another, they are errors in windows of :data:`WINDOW`.
    """
    predicted, actual, joined = predict(network, rows), rows.output_array(), rows.joined
    if joined is not None:
        both = [windows_of_rows(rows, joined, moved) for moved in (predicted, actual)]
        # The longest existing windows, up to that length.
        known = [length for length, moved in both[0].items() if len(moved) and length <= WINDOW]
        if known:
            predicted, actual = (moved[known[-1]] for moved in both)
    return errors(predicted, actual)


def errors(predicted: NDArray, actual: NDArray) -> dict[str, dict[str, Any]]:
    """Return MSE (equation 1) and mean absolute error of displacements (N, 3), by output.

    They are in cm and deg, as in the paper; the key ``unit`` names the unit.
    """
    table = {}
    for place, (name, factor) in enumerate(READABLE.items()):
        difference = factor * (predicted[:, place] - actual[:, place])
        table[name] = {
            "mse": float(np.mean(difference**2)),
            "mean_absolute_error": float(np.mean(np.abs(difference))),
            "unit": UNITS[name],
        }
    return table
