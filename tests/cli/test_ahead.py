"""The demo compiles functions ahead of their use, in another process."""

import subprocess
import sys

import pytest
from patience import PATIENCE

from neurosim.base.compiled import compiled_ahead


@pytest.mark.slow
def test_the_stages_are_done_on_a_few_commands():
    marker = compiled_ahead()
    marker.unlink(missing_ok=True)
    with subprocess.Popen(
        [sys.executable, "-m", "neurosim.cli._ahead"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        # So the demo knows that evolution can begin, while replanning is still compiled.
        assert process.stdout.readline() == "evolution\n"
        assert not marker.exists()
        assert process.wait() == 0
    assert marker.exists()


def test_it_ends_with_the_demo_that_started_it():
    process = subprocess.Popen(
        [sys.executable, "-m", "neurosim.cli._ahead"],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
    )
    process.stdin.close()
    assert process.wait(timeout=PATIENCE) == 1
