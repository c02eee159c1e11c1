"""Predictions of a plan before the robot moves."""

import math

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from ideal_simulator import IdealWheels

from neurosim.base.errors import UserError
from neurosim.cli.plan_check import _in_words, plan_check
from neurosim.controllers import FixedPlan, SavedController
from neurosim.loop.check import check
from neurosim.networks import ProductSummationNetwork
from neurosim.simulators import MotionNetwork
from neurosim.simulators.motion.files import write_motion
from neurosim.tasks.nine_rectangles import NineRectangles

TASK = NineRectangles()


class Gusts(IdealWheels):
    """Every command is blown away by 1 cm in x, one way or the other, but for stops."""

    has_noise = True

    def step(self, state, command, generator=None):
        after = super().step(state, command)
        if generator is not None:
            sign = torch.randint(2, (len(state),), generator=generator) * 2 - 1
            after[:, 0] += 0.01 * sign * (command[:, 0] != 0)
        return after


def plan(*commands, start=TASK.start):
    return SavedController(
        controller=FixedPlan(commands),
        genes=np.empty(0),
        task=TASK.describe(),
        start=start,
        predicted={
            "poses": [list(TASK.start)] * (len([c for c in commands if c]) + 1),
            "rest": list(TASK.start),
            "fitness": 0.0,
            "completes": False,
        },
    )


def test_failures_are_counted_where_they_happen():
    # Up into rectangle 1 and no further: no sample ends in the right place.
    commands = [(48.0, 48.0, 1.0), (48.0, 48.0, 1.0)]
    checked = check(plan(*commands), Gusts(), TASK, draws=2000, placing=(0.0, 0.0))
    assert checked.probability == 0.0
    assert checked.members is None
    assert [(f.command, f.reason, f.fraction) for f in checked.failures] == [
        (3, "did not end in the last rectangle", 1.0)
    ]
    # 1 cm after one command; 0 or 2 cm after two.
    assert checked.after == (1, 2, 3)
    assert checked.spread[0] == pytest.approx(0.01, abs=1e-3)
    assert checked.spread[1] == pytest.approx(0.02, abs=1e-3)
    assert checked.spread[2] == checked.spread[1]
    assert checked.turn == pytest.approx([0.0] * 3)
    # On the border of the grid one gust of two carries the robot out.
    edge = plan(*commands, start=(-1.195, 0.0, math.pi / 2))
    checked = check(edge, Gusts(), draws=4000, placing=(0.0, 0.0))
    fractions = {(f.command, f.reason): f.fraction for f in checked.failures}
    assert fractions.pop((1, "left the grid")) == pytest.approx(0.5, abs=0.03)
    assert fractions.pop((3, "did not end in the last rectangle")) == pytest.approx(0.5, abs=0.03)
    assert not fractions
    words = _in_words(checked)
    assert "probability of 0.0 % (4000 random samples: 0.0 % to 0.1 %)" in words
    assert "command 1: left the grid" in words
    assert "running down: did not end in the last rectangle" in words


def motion_network(members):
    network = ProductSummationNetwork(inputs=5)
    names = ("prev_left", "prev_right", "left", "right", "duration")
    generator = torch.Generator().manual_seed(0)
    genes = 0.2 * torch.randn(members, 3, network.genes, generator=generator, dtype=torch.float64)
    return MotionNetwork(
        [{"name": name, "unit": ""} for name in names],
        network,
        genes,
        torch.tensor([50.0, 50.0, 50.0, 50.0, 3.0]),
        torch.full((3,), 0.1),
    )


def test_a_simulator_that_knows_one_outcome_is_refused():
    with pytest.raises(UserError, match="neither noise nor an ensemble"):
        check(plan((10.0, 10.0, 1.0)), motion_network(1))


def test_the_command_reads_folders(tmp_path):
    plan((10.0, 10.0, 1.0), None, (-20.0, 30.0, 2.0)).write(tmp_path / "plan")
    (tmp_path / "simulator").mkdir()
    write_motion(motion_network(4), tmp_path / "simulator")
    words = [str(tmp_path / "plan"), str(tmp_path / "simulator"), "--draws", "200"]
    result = CliRunner().invoke(plan_check, words, catch_exceptions=False)
    assert result.exit_code == 0
    assert "members of the simulator's ensemble" in result.output
    assert "at the end" in result.output
    again = check(tmp_path / "plan", tmp_path / "simulator", draws=200)
    assert len(again.spread) == len(again.turn) == 3
    assert np.isclose(sum(f.fraction for f in again.failures), 1.0 - again.probability)
    low, high = again.members
    assert low <= again.probability <= high
