import math
from itertools import pairwise

import numpy as np
import pytest

from neurosim.base.commands import TWO_WHEELS
from neurosim.lab import VirtualRig
from neurosim.recording.commands import RandomCommands
from neurosim.recording.homing import Homing
from neurosim.recording.record import RecordSettings, Rig, record

TAKES = TWO_WHEELS.measured(full=0.5, track=0.13)


def test_after_driving_ahead_the_way_in_is_back():
    home = Homing()
    home.moved(TAKES.twist((50, 50)), 2.0)
    angle, direction = home.turn_inside()
    assert angle == pytest.approx(0)
    assert direction == -1


def test_after_backing_the_way_in_is_ahead():
    home = Homing()
    home.moved(TAKES.twist((-50, -50)), 2.0)
    assert home.turn_inside() == (pytest.approx(0), 1)


def test_after_a_quarter_turn_on_the_spot_the_way_in_is_to_the_side():
    home = Homing()
    home.moved(TAKES.twist((50, 50)), 2.0)
    # The wheels turn the robot by 2 v / track a second.
    quarter = math.pi / 2 / (2 * 0.25 / 0.13)
    home.moved(TAKES.twist((-50, 50)), quarter)
    angle, direction = home.turn_inside()
    # It faces left now, so the point behind its former position is to its left: +90 degrees ahead
    # or -90 degrees backwards.
    assert (angle, direction) in [
        (pytest.approx(math.pi / 2, abs=0.02), 1),
        (pytest.approx(-math.pi / 2, abs=0.02), -1),
    ]


def test_old_places_are_forgotten():
    home = Homing(memory=5.0)
    home.moved(TAKES.twist((50, 50)), 4.0)
    home.moved(TAKES.twist((0, 0)), 6.0)
    assert home.turn_inside() == (0.0, -1.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 5])
def test_the_robot_stays_on_the_board_and_no_long_run_is_lost(tmp_path, seed):
    """150 commands in the lab, without its camera; the truth says where the robot was."""
    with VirtualRig(seed, noise_seed=seed, camera=False) as rig:
        recording = record(
            tmp_path / "r", Rig(rig.robot), RandomCommands(seed=seed), RecordSettings(150)
        )
        places = rig.lab.truth.poses
    motor = [line for line in recording.commands().itertuples() if line.is_motor]
    assert any(line.kind == "cut" for line in motor)
    done = {
        line.command
        for line, after in pairwise(motor)
        if line.kind == "command" and after.kind != "cut"
    }
    assert done == set(range(150))
    outside = (np.abs(places[:, 0]) > 1.38) | (np.abs(places[:, 1]) > 0.92)
    assert outside.mean() < 0.02
