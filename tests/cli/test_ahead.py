"""The demo compiles functions ahead of their use, in another process."""

import shutil
import subprocess
import sys

from patience import PATIENCE

from neurosim.cli import _ahead


def test_the_stages_are_done_on_the_first_round(pipeline, tmp_path, monkeypatch):
    shutil.copytree(pipeline / "recording", tmp_path / "recording" / "round-01")
    marker = tmp_path / "compiled"
    monkeypatch.setattr(_ahead, "compiled_ahead", lambda: marker)
    _ahead.main(tmp_path)
    assert marker.exists()


def test_it_ends_with_the_demo_that_started_it(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "neurosim.cli._ahead", str(tmp_path)], stdin=subprocess.PIPE
    )
    process.stdin.close()
    # It would wait for a recording that nobody makes.
    assert process.wait(timeout=PATIENCE) == 1
