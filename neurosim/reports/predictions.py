"""Predictions of held-out commands, compared with the robot's motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from neurosim.base.errors import FileError
from neurosim.base.files import sha256
from neurosim.reports.artefacts import Artefact
from neurosim.training.coverage import central_ranks
from neurosim.training.evaluate import errors, predict
from neurosim.training.unicycle import unicycle
from tracking.datasets.dataset import Dataset


@dataclass(frozen=True)
class HeldOut:
    """Predicted and actual displacements of commands that training never saw.

    Attributes:
        predicted, actual: (N, 3) dx, dy in m, dtheta in rad.
        baseline: description of the ideal robot, and its displacements (N, 3); None if the inputs
            do not fit one.
        how: description of the rows, in words.
        central: (N, 3) probability of the smallest central interval with the actual value,
            :func:`neurosim.training.coverage.central`; None if the simulator has no noise.
    """

    predicted: NDArray
    actual: NDArray
    baseline: tuple[str, NDArray] | None
    how: str
    central: NDArray | None = None

    def errors(self) -> dict[str, dict[str, Any]]:
        """Return the simulator's errors by output, in cm and degrees (equation 1)."""
        return errors(self.predicted, self.actual)

    def baseline_errors(self) -> dict[str, dict[str, Any]] | None:
        return None if self.baseline is None else errors(self.baseline[1], self.actual)


def dataset_of(simulator: Artefact, datasets: list[Artefact]) -> tuple[Dataset, bool] | None:
    """Return the dataset for a simulator's test, and whether it was trained on it.

    This is the training dataset, if given; else the first with the same inputs.
    """
    names = [column["name"] for column in simulator.meta["inputs"]]
    fitting = [one for one in datasets if list(one.content.inputs) == names]
    described = simulator.meta.get("source", {})
    source = described.get("sha256") if isinstance(described, dict) else None
    for artefact in fitting:
        if source == sha256(artefact.path / "dataset.csv"):
            return artefact.content, True
    return (fitting[0].content, False) if fitting else None


def held_out(simulator: Artefact, dataset: Dataset, trained_on_it: bool) -> HeldOut:
    """Predict the commands of a dataset that a simulator was not trained on."""
    network = simulator.content
    seen, rows = dataset, dataset
    how = f"all {len(rows)} commands of another dataset than the one it was trained on"
    if trained_on_it:
        fraction = simulator.meta.get("training", {}).get("held_out")
        if fraction is None or not 0 < fraction < 1:
            raise FileError(
                simulator.json, "expected a fraction of the dataset", field="training.held_out"
            )
        seen, rows = dataset.split(fraction)
        how = f"the last {fraction:.0%} of its dataset in time, {len(rows)} commands"
    ideal = unicycle(seen)
    baseline = None
    if ideal is not None:
        baseline = ideal.description, ideal.displacement(rows.input_array())
    actual = rows.output_array()
    return HeldOut(
        predict(network, rows),
        actual,
        baseline,
        how,
        central_ranks(network, rows.input_array(), actual, starts=rows.start_array()),
    )
