"""Predictions of held-out commands, compared with the robot's motion."""

from __future__ import annotations

from typing import NamedTuple

from neurosim.base.errors import FileError
from neurosim.base.files import sha256
from neurosim.reports.artefacts import Artefact
from neurosim.training.evaluate import Compared, compare
from tracking.datasets.dataset import Dataset


class HeldOut(NamedTuple):
    """Rows that training never saw, compared with a simulator's predictions.

    Attributes:
        compared: predicted and actual displacements.
        how: description of the rows, in words.
    """

    compared: Compared
    how: str


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
    """Predict rows of a dataset that a simulator was not trained on."""
    seen, rows = dataset, dataset
    if trained_on_it:
        fraction = simulator.meta.get("training", {}).get("held_out")
        if fraction is None or not 0 < fraction < 1:
            raise FileError(
                simulator.json, "expected a fraction of the dataset", field="training.held_out"
            )
        seen, rows = dataset.split(fraction)
    compared = compare(simulator.content, seen, rows)
    many = f"{len(compared.actual)} {compared.what}"
    how = f"all {many} of another dataset than the one it was trained on"
    if trained_on_it:
        how = f"the last {fraction:.0%} of its dataset in time, {many}"
    return HeldOut(compared, how)
