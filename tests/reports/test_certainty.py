"""Measures of predicted uncertainty, compared with hand-worked numbers."""

from pathlib import Path

import numpy as np
import pytest
from report_artefacts import make_trial

from neurosim.reports import certainty
from neurosim.reports.artefacts import Artefact, Artefacts, gather
from neurosim.reports.predictions import HeldOut
from neurosim.training.evaluate import Compared


def trials_saying(tmp_path, predicted):
    folders = [
        make_trial(tmp_path / f"t{place}", completes=done, probability=message)
        for place, (message, done) in enumerate(predicted)
    ]
    return gather(folders)


def test_probabilities_of_plans_against_what_happened(tmp_path):
    artefacts = trials_saying(
        tmp_path, [(0.9, True), (0.9, True), (0.8, False), (0.1, False), (None, True)]
    )
    (table,) = certainty.section(artefacts, {}).blocks
    assert table.rows == [["0% to 20%", "1", "10%", "0%"], ["80% to 100%", "3", "87%", "67%"]]
    # (0.01 + 0.01 + 0.64 + 0.01) / 4, and 1/2 x 1/2 of two in four
    assert certainty.brier(certainty.with_probability(artefacts.trials)) == pytest.approx(
        (0.1675, 0.25)
    )
    assert "Brier score 0.168; of always saying the base rate 0.250" in table.note


def test_intervals_of_single_commands():
    # Of 20 commands 10, 16 and 20 lie within the 50, 80 and 95 % intervals of dx; all of dy do;
    # none of dtheta.
    rank = np.concatenate([np.full(10, 0.2), np.full(6, 0.7), np.full(4, 0.9)])
    ranks = np.stack([rank, np.zeros(20), np.ones(20)], axis=1)
    rows = np.zeros((20, 3))
    test = HeldOut(Compared(rows, rows, None, ranks, None), "some")
    artefacts = Artefacts(simulators=[Artefact("simulator", Path("net"), {})])
    table, _ = certainty.section(artefacts, {0: test}).blocks
    assert table.rows == [
        ["50%", "50%", "100%", "0%"],
        ["80%", "80%", "100%", "0%"],
        ["95%", "100%", "100%", "0%"],
    ]


def test_nothing_said_nothing_shown(tmp_path):
    assert certainty.section(trials_saying(tmp_path, [(None, True)]), {}) is None
