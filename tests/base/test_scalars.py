"""Curves for TensorBoard: of a training, an evolution and an alternation, read back."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from sliding_block import Block, Push, Slide, reality_of
from tensorboard_curves import curves

from neurosim.back_to_reality import settings_named
from neurosim.back_to_reality.run import back_to_reality
from neurosim.base.errors import UserError
from neurosim.base.scalars import Scalars
from neurosim.cli.main import cli
from neurosim.controllers import CONTROLLERS
from neurosim.loop.journal import read_trials
from neurosim.tasks.registry import TASKS

DATA = Path(__file__).resolve().parents[2] / "data" / "reference"


def neurosim(*words):
    done = CliRunner().invoke(cli, [*map(str, words), "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def test_training_and_evolution(tmp_path):
    small = ["--generations", 4, "--population", 20]
    train = ["train", DATA, "-o", tmp_path / "s", "--trainer", "ga", *small]
    neurosim(*train, "--tensorboard", tmp_path / "curves" / "train")
    computed = curves(tmp_path / "curves" / "train")
    history = json.loads((tmp_path / "s" / "simulator.json").read_text())["history"]
    assert sorted(computed) == ["training/rms-dtheta", "training/rms-dx", "training/rms-dy"]
    for place, name in enumerate(("dx", "dy", "dtheta")):
        steps, values = zip(*computed[f"training/rms-{name}"], strict=True)
        assert steps == (1, 2, 3, 4)
        expected = [math.sqrt(one["mse"][place]) for one in history]
        assert values == pytest.approx(expected, rel=1e-5)
    evolve = ["evolve", tmp_path / "s", "-o", tmp_path / "c", "--runs", 2, *small]
    result = neurosim(*evolve, "--tensorboard", tmp_path / "curves" / "evolve")
    computed = curves(tmp_path / "curves" / "evolve")
    assert sorted(computed) == [
        "evolution/best/run-1", "evolution/best/run-2",
        "evolution/mean/run-1", "evolution/mean/run-2",
    ]  # fmt: skip
    for name in ("best", "mean"):
        runs = [[value for _, value in computed[f"evolution/{name}/run-{run}"]] for run in (1, 2)]
        assert any(values == pytest.approx(result[name], rel=1e-5) for values in runs)
        assert [step for step, _ in computed[f"evolution/{name}/run-1"]] == [1, 2, 3, 4]


def test_back_to_reality(tmp_path, monkeypatch):
    monkeypatch.setitem(CONTROLLERS._registered, "push", Push)
    monkeypatch.setitem(TASKS._registered, "slide", Slide)
    settings = settings_named(
        "paper", generations=5, adapt_generations=3, candidates=4, policy_steps=1, trials=2
    )
    content = back_to_reality(
        Block(), Slide(), Push(), reality_of(), out=tmp_path / "out", settings=settings, seed=3,
        start=np.array([0.5, 0.5]), progress=False, tensorboard=tmp_path / "curves",
    )  # fmt: skip
    result = curves(tmp_path / "curves")
    steps, values = zip(*result["reality/fitness"], strict=True)
    assert steps == tuple(range(1, len(content["real"]) + 1))
    assert values == pytest.approx(content["real"], rel=1e-5)
    assert len(read_trials(tmp_path / "out" / "trials.jsonl")) == 2 * len(steps)
    for cycle, one in enumerate(content["cycles"]):
        for name in ("best", "mean"):
            points = result[f"cycle-{cycle + 1}/L1/{name}"]
            assert [value for _, value in points] == pytest.approx(one["L1"][name], rel=1e-5)
            assert [step for step, _ in points] == list(range(1, len(points) + 1))
    assert [-value for _, value in result["cycle-1/L3/best"]] == pytest.approx(
        content["cycles"][0]["L3"]["history"]["best"], rel=1e-5
    )


def test_numbers_that_are_not_finite_are_left_out(tmp_path):
    with Scalars(tmp_path / "c") as scalars:
        for step, value in enumerate((1.0, math.nan, -math.inf, 2.0)):
            scalars.add("x", value, step)
    assert curves(tmp_path / "c") == {"x": [(0, 1.0), (3, 2.0)]}


def test_without_the_package_or_with_a_file(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="file is a file; name a folder"):
        Scalars(tmp_path / "file")
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    words = ["train", DATA, "-o", tmp_path / "s", "--tensorboard", tmp_path / "c"]
    with pytest.raises(UserError, match=r"pip install 'neurosim\[tensorboard\]'"):
        CliRunner().invoke(cli, [str(word) for word in words], catch_exceptions=False)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
