"""The demo compiles functions ahead of their use, in another process."""

import subprocess
import sys

import pytest
from patience import PATIENCE

from neurosim.cli import _ahead


@pytest.mark.slow
def test_the_stages_are_done_on_a_few_commands(tmp_path, monkeypatch):
    marker, there = tmp_path / "compiled", []
    monkeypatch.setattr(_ahead, "compiled_ahead", lambda: marker)
    _ahead.main(lambda: there.append(marker.exists()))
    assert there == [False]
    assert marker.exists()


@pytest.mark.slow
def test_it_tells_the_demo_when_evolution_can_begin():
    with subprocess.Popen(
        [sys.executable, "-m", "neurosim.cli._ahead"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout.readline() == "evolution\n"
        process.stdin.close()


def test_it_ends_with_the_demo_that_started_it():
    process = subprocess.Popen(
        [sys.executable, "-m", "neurosim.cli._ahead"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    )
    process.stdin.close()
    assert process.wait(timeout=PATIENCE) == 1
