"""Other people's optimisers and learners solve tasks in a simulator (``make test-extras``)."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from patience import PATIENCE

from neurosim.training.train import train

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("use_*.py"))
#: Fraction of trials in which the task is done, at least, where it is not nearly all.
LEAST = {"use_stable_baselines": 0.8}

pytestmark = pytest.mark.skipif(
    not os.environ.get("NEUROSIM_EXTRAS"), reason="run by make test-extras, which installs them"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a simulator, as the README's quick start makes one."""
    folder = tmp_path_factory.mktemp("examples")
    train(ROOT / "data" / "reference", folder / "simulator", members=2, progress=False)
    return folder


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_solve_their_task(path, folder):
    done = subprocess.run(
        [sys.executable, str(path)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=10 * PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    (success,) = re.findall(r"^success ([\d.]+)$", done.stdout, re.MULTILINE)
    assert float(success) >= LEAST.get(path.stem, 0.9)


def test_examples_are_short():
    assert len(EXAMPLES) >= 7
    for path in EXAMPLES:
        lines = [line for line in path.read_text("utf-8").splitlines() if line.strip()]
        assert len(lines) <= 20, path.name
