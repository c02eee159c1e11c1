"""Predicted intervals of commands and probabilities of success, compared with the results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from neurosim.reports import charts
from neurosim.reports.artefacts import Artefacts, Trial
from neurosim.reports.page import Block, Picture, Row, Section, Table
from neurosim.reports.predictions import HeldOut
from neurosim.training.coverage import LEVELS
from neurosim.training.evaluate import Compared

#: Number of bins in which probabilities of success are compared with results.
BINS = 5


def section(artefacts: Artefacts, tests: Mapping[int, HeldOut]) -> Section | None:
    """Write the section on uncertainty; None without predicted uncertainties."""
    blocks: list[Block] = []
    known = {
        place: (artefacts.simulators[place].name, test.compared)
        for place, test in tests.items()
        if test.compared.central is not None
    }
    if known:
        blocks.append(_intervals(list(known.values())))
        blocks.append(Row([_calibration(*one, f"u{place}") for place, one in known.items()]))
    trials = with_probability(artefacts.trials)
    if trials:
        blocks.append(_trials(trials))
    return Section("uncertainty", "Uncertainty: predicted and actual", blocks) if blocks else None


def with_probability(trials: Sequence[Trial]) -> list[Trial]:
    """Return the trials whose controllers have a predicted probability of success."""
    return [trial for trial in trials if trial.meta["predicted"].get("probability") is not None]


def brier(trials: Sequence[Trial]) -> tuple[float, float]:
    """Return the Brier score of the probabilities, and that of a constant base rate.

    The score is the mean squared difference between the predicted probability and the result, 0 or
    1 (Brier 1950); the smaller the better.
    """
    predicted = np.array([trial.meta["predicted"]["probability"] for trial in trials])
    happened = np.array([trial.completes for trial in trials], float)
    base = happened.mean()
    return float(np.mean((predicted - happened) ** 2)), float(base * (1.0 - base))


def _intervals(simulators: Sequence[tuple[str, Compared]]) -> Table:
    coverage = [compared.coverage() or {} for _, compared in simulators]
    rows = [
        [
            f"{level:.0%}",
            *(f"{part[str(level)]:.0%}" for each in coverage for part in each.values()),
        ]
        for level in LEVELS
    ]
    what = " or ".join(dict.fromkeys(one.what for _, one in simulators))
    return Table(
        f"Intervals of {what}: nominal probability, and measured fraction",
        ["predicted", *["dx", "dy", "dtheta"] * len(simulators)],
        rows,
        note=f"Fractions of the held-out {what} of Table 2 within the central interval of that "
        "probability, which covers the simulator's ensemble and its noise.",
        groups=[(name, 3) for name, _ in simulators],
    )


def _calibration(name: str, compared: Compared, prefix: str) -> Picture:
    fraction = np.linspace(0.0, 1.0, 101)
    held = (compared.central[:, :, None] <= fraction).mean(0)
    off = float(np.abs(held - fraction).max())
    words = f"{name}: fraction of held-out {compared.what} within an interval, over its probability"
    lines = {
        output: (fraction, line) for output, line in zip(("dx", "dy", "dtheta"), held, strict=True)
    }
    svg = charts.calibration(lines, words, prefix)
    return Picture(svg, f"{words}; {100 * off:.0f} points off the diagonal at the most.")


def _trials(trials: Sequence[Trial]) -> Table:
    predicted = np.array([trial.meta["predicted"]["probability"] for trial in trials])
    happened = np.array([trial.completes for trial in trials], float)
    place = np.minimum((predicted * BINS).astype(int), BINS - 1)
    rows = [
        [
            f"{low / BINS:.0%} to {(low + 1) / BINS:.0%}",
            str((place == low).sum()),
            f"{predicted[place == low].mean():.0%}",
            f"{happened[place == low].mean():.0%}",
        ]
        for low in range(BINS)
        if (place == low).any()
    ]
    note = "For each controller it was predicted how probably it completes the task."
    if len(trials) > 1:
        score, base = brier(trials)
        note += f" Brier score {score:.3f}; of always saying the base rate {base:.3f}."
    return Table(
        "Probabilities of success: predicted and measured",
        ["predicted to complete", "trials", "said, mean", "completed"],
        rows,
        note=note,
    )
