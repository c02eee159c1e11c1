"""The text of a drive's result."""

from pathlib import Path

import pytest

from neurosim.cli.run import _text


@pytest.mark.parametrize(
    ("missed", "replanned", "advice"), [(60, False, False), (61, False, True), (61, True, False)]
)
def test_a_drive_whose_commands_were_often_late_is_not_the_simulated_one(missed, replanned, advice):
    report = {
        "actual": {"completes": True, "fitness": 52.3, "reason": None},
        "predicted": {"fitness": 52.4},
        "guard": {"predicted": True, "driven": True},
        "errors": [],
        "replanned": replanned,  # a plan has no --step
        "deadlines": {"steps": 600, "missed": missed, "worst_late_s": 0.0837},
    }
    text = _text(Path("trial"), Path("network"), report)
    assert f"{missed} of 600 commands were late" in text
    assert ("by 0.08 s at most" in text) == advice
    assert ("evolve with a longer --step" in text) == advice
