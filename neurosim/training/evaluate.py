"""The errors of a simulator, as in Table 2 of Pretorius et al. 2009."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from neurosim.base import files, se2
from neurosim.base.errors import UserError
from neurosim.base.generations import compiling_notice
from neurosim.simulators import MotionNetwork, read_simulator
from neurosim.simulators.motion.network import OUTPUTS
from neurosim.training.coverage import LEVELS, central, central_ranks, draw_displacements
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

#: Length of the windows in which rows are compared if they follow one another, s.
WINDOW = 1.0
#: Number of samples of rows that follow one another, and of parts that memory holds.
_JOINED_DRAWS, _PARTS = 200, 8
#: Time after which a robot has a command's final speeds, s.
_CALM = 5.0

#: Smallest variance of an output, m^2 and rad^2: that of poses of a robot that stands.
_FINEST = 1e-6
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
        unicycle's); ``coverage`` of its intervals, as :meth:`Compared.coverage`; ``window``, the
        length (s) of the windows in which rows that follow one another are compared, or None.

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
    compared = compare(network, fitted_to, used)
    which = "all rows of another dataset than it was trained on"
    if own:
        which = "the last rows, held out of training" if held_out_only else "all rows, seen or not"
    return {
        "rows": len(used),
        "which": which,
        "held_out": own and held_out_only,
        "window": compared.window,
        "errors": compared.errors(),
        "coverage": compared.coverage(),
        "paper": {name: {**PAPER[name], "unit": UNITS[name]} for name in PAPER},
        "baseline": compared.baseline_errors(),
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
    driven = _driven(network, rows)
    if driven is not None:
        return driven[0]
    inputs = torch.tensor(rows.input_array(), device=network.genes.device)
    moved = network.displacement_of(network.chained(inputs))
    starts = rows.start_array()
    if starts is not None:
        moved = network.on_floor(torch.from_numpy(starts).to(moved), moved)
    return moved.cpu().numpy()


@dataclass(frozen=True)
class Compared:
    """Predictions of rows compared with the robot's motion; if rows follow one another, of windows.

    Attributes:
        predicted, actual: (W, 3) dx, dy in m, dtheta in rad.
        baseline: description of the ideal robot, and its displacements (W, 3); None if the inputs
            do not fit one.
        central: (W, 3) probability of the smallest central interval with the actual value,
            :func:`neurosim.training.coverage.central`; None if the simulator has no noise.
        window: length of the windows, s; None: these are single rows.
    """

    predicted: NDArray
    actual: NDArray
    baseline: tuple[str, NDArray] | None
    central: NDArray | None
    window: float | None

    @property
    def what(self) -> str:
        """Whether rows or windows are compared, in words."""
        return "commands" if self.window is None else f"windows of {self.window:g} s"

    def errors(self) -> dict[str, dict[str, Any]]:
        """Return the simulator's errors, in the form of :func:`errors`."""
        return errors(self.predicted, self.actual)

    def explained(self) -> dict[str, float]:
        """Return the fraction of each output's variance that is predicted; below 0: none is."""
        left = np.square(self.predicted - self.actual).mean(0)
        spread = np.maximum(self.actual.var(0), _FINEST)
        return dict(zip(OUTPUTS, (1.0 - left / spread).tolist(), strict=True))

    def baseline_errors(self) -> dict[str, Any] | None:
        """Return the ideal robot's ``description`` and ``errors``, or None."""
        if self.baseline is None:
            return None
        description, displacement = self.baseline
        return {"description": description, "errors": errors(displacement, self.actual)}

    def coverage(self) -> dict[str, dict[str, float]] | None:
        """Return the fractions within the simulator's intervals.

        Returns:
            For each output, level ("0.5", ...) -> fraction within the central interval of that
            probability; None if the simulator has no noise model.
        """
        if self.central is None:
            return None
        return {
            name: {str(level): float((own <= level).mean()) for level in LEVELS}
            for name, own in zip(OUTPUTS, self.central.T, strict=True)
        }


def compare(network: MotionNetwork, fitted_to: Dataset, rows: Dataset, seed: int = 0) -> Compared:
    """Compare a simulator's predictions of rows with the robot's motion.

    If rows follow one another, what is compared are windows of :data:`WINDOW`, or the longest that
    there are up to this length: single rows are short, and have mostly the noise of two poses.

    Args:
        network: the simulator.
        fitted_to: the rows to which the ideal robot is fitted.
        rows: the rows to predict.
        seed: of the random samples for the intervals.
    """
    driven, actual = _driven(network, rows), rows.output_array()
    predicted = predict(network, rows) if driven is None else driven[0]
    ideal = unicycle(fitted_to)
    baseline = None
    if ideal is not None:
        baseline = ideal.description, ideal.displacement(rows.input_array())
    windows = _windows(rows)
    if windows is None:
        starts = rows.start_array()
        ranks = central_ranks(network, rows.input_array(), actual, seed, starts=starts)
        return Compared(predicted, actual, baseline, ranks, None)
    length, first, end = windows

    def over(displacement: NDArray) -> NDArray:
        """Return displacements [..., W, 3] in windows of rows with displacements [..., N, 3]."""
        by_row = np.moveaxis(displacement, -2, 0)
        poses = np.zeros((len(by_row) + 1, *by_row.shape[1:]))
        for number, each in enumerate(by_row):
            poses[number + 1] = se2.compose(poses[number], each)
        return np.moveaxis(se2.between(poses[first], poses[end]), 0, -2)

    actual, ranks = over(actual), None
    if network.noise is not None:
        begun = None if driven is None else driven[1]
        samples = map(over, _samples(network, rows, begun, seed))
        ranks = central(np.concatenate(list(samples)), actual)
    if baseline is not None:
        baseline = baseline[0], over(baseline[1])
    return Compared(over(predicted), actual, baseline, ranks, length)


def _windows(rows: Dataset) -> tuple[float, NDArray, NDArray] | None:
    """Return the length (s), the first rows, and the rows after the last ones, of windows.

    None if rows do not follow one another, or no windows are that short.
    """
    if rows.joined is None:
        return None
    duration = torch.tensor(rows.table["duration"].to_numpy(np.float64, copy=True))
    windows = windows_of(duration, torch.from_numpy(rows.joined))
    kinds = [kind for kind in windows.kind.unique().tolist() if LENGTHS[kind] <= WINDOW]
    if not kinds:
        return None
    some = windows.kind == kinds[-1]
    return LENGTHS[kinds[-1]], windows.first[some].numpy(), windows.end[some].numpy()


def _samples(
    network: MotionNetwork, rows: Dataset, begun: NDArray | None, seed: int
) -> Iterator[NDArray]:
    """Give random displacements (D, N, 3) of rows that follow one another, some at a time.

    Each sample keeps its member; noise does not change the speeds with which the next row begins.
    ``begun`` (N, S) are the states before the rows, None without a drive model.
    """
    generator = torch.Generator().manual_seed(seed)
    numbers = np.array_split(np.arange(_JOINED_DRAWS), _PARTS)
    if begun is None:
        x = network.chained(torch.tensor(rows.input_array()))
        for some in numbers:
            yield draw_displacements(network, x, len(some), generator).numpy()
        return
    stepper, commands = network.stepper(), _commands(network, rows)
    begun = network.over(torch.from_numpy(begun)).numpy()
    for some in numbers:
        moved = np.empty((len(some), len(rows), 3))
        for number, own in zip(some, moved, strict=True):
            if network.members > 1:
                begun[:, -1] = number % network.members
            z = network.noise.draw(len(rows), 1, generator)[:, 0].numpy()
            own[:] = se2.between(begun[:, :3], stepper.step(begun, commands, z)[:, :3])
        yield moved


def _commands(network: MotionNetwork, rows: Dataset) -> NDArray:
    """Return the commands (N, C) of rows."""
    return rows.input_array()[:, [rows.inputs.index(name) for name in network.command_names]]


def _driven(network: MotionNetwork, rows: Dataset) -> tuple[NDArray, NDArray] | None:
    """Drive through rows that follow one another, all drives in parallel.

    Returns:
        The mean's displacements, (N, 3), and its states before the rows, (N, S). None if rows do
        not follow one another, or there is no drive model.
    """
    joined = rows.joined
    if joined is None or network.drive is None:
        return None
    stepper, commands = network.stepper(), _commands(network, rows)
    starts = np.flatnonzero(~joined)
    lasts = np.diff(np.append(starts, len(joined)))
    # Each drive begins with the final speeds of the previous command.
    before = [f"prev_{name}" if name != "duration" else name for name in network.command_names]
    calm = rows.input_array()[starts][:, [rows.inputs.index(name) for name in before]]
    calm[:, network.command_names.index("duration")] = step = min(network.longest, _CALM)
    state = network.standing(np.zeros((len(starts), 3)))
    slow = compiling_notice("the comparison with the recording")
    try:
        for _ in range(math.ceil(_CALM / step)):
            state = stepper.step(state, calm, None)
    finally:
        slow.cancel()
    moved, begun = np.zeros((len(joined), 3)), np.zeros((len(joined), state.shape[1]))
    where = rows.start_array()
    for number in range(lasts.max()):
        going = np.flatnonzero(lasts > number)
        place = starts[going] + number
        if where is not None:  # with the floor's effect there
            state[going, :3] = where[place]
        begun[place] = state[going]
        state[going] = stepper.step(begun[place], commands[place], None)
        moved[place] = se2.between(begun[place, :3], state[going, :3])
    return moved, begun


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
