"""Commands of two wheels, a car and bases that take their own velocities."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from neurosim.base.commands import TWO_WHEELS, Commands, Number
from neurosim.base.errors import UserError

WHEELS = TWO_WHEELS.measured(full=0.5, track=0.13)
CAR = Commands(
    (Number("speed", "m/s", -0.3, 0.4), Number("steer", "rad", -0.4, 0.4, speed=False)),
    "car",
    {"wheelbase": 0.2},
)
OMNI = Commands(
    (
        Number("vx", "m/s", -0.3, 0.3),
        Number("vy", "m/s", -0.3, 0.3),
        Number("omega", "rad/s", -2.0, 2.0),
    ),
    "twist",
)
UNICYCLE = Commands((Number("v", "m/s", -0.2, 0.5), Number("w", "rad/s", -3.0, 3.0)), "twist")
ALL = [WHEELS, CAR, OMNI, UNICYCLE]


def test_twists_by_hand():
    assert WHEELS.twist((40, 20)) == pytest.approx([0.15, 0, -0.1 / 0.13])
    # On a circle of radius wheelbase / tan(steering angle).
    assert CAR.twist((0.4, 0.3)) == pytest.approx([0.4, 0, 0.4 / (0.2 / math.tan(0.3))])
    assert CAR.twist((-0.3, 0.3))[2] < 0
    assert OMNI.twist((0.1, -0.2, 1.5)) == pytest.approx([0.1, -0.2, 1.5])
    assert UNICYCLE.twist(np.array([[0.1, 1.0], [0, -2.0]])).tolist() == [[0.1, 0, 1], [0, 0, -2]]


def test_percents_of_two_wheels_are_their_mean_and_half_difference():
    assert WHEELS.percent((40, 20)).tolist() == [30.0, -10.0]
    assert CAR.percent((0.2, 0.4)) == pytest.approx([50, 50])
    assert OMNI.percent((-0.3, 0.3, 1.0)) == pytest.approx([-100, 50])


@pytest.mark.parametrize("takes", ALL)
@given(st.floats(-0.1, 0.1), st.floats(-0.6, 0.6))
def test_a_command_toward_a_twist_gives_it(takes, forward, turn):
    if not takes.turns_on_the_spot and abs(turn) > 2 * abs(forward):
        return
    command = takes.toward(forward, turn)
    assert takes.check(command) == tuple(map(float, command))
    assert takes.twist(command)[0] == pytest.approx(forward, abs=0.003)
    # Whole percents and steering in 1/10 mrad.
    assert takes.twist(command)[2] == pytest.approx(turn, abs=0.05)


def test_what_stands_and_what_is_held():
    assert WHEELS.rest((20, 30)) == (0, 0)
    assert CAR.rest((0.2, 0.3)) == (0, 0.3)
    assert CAR.stands((0.0, 0.3))
    assert not CAR.stands((0.1, 0.0))
    assert WHEELS.straight((20, -30)) == (20, 20)
    assert CAR.straight((0.2, 0.3)) == (0.2, 0.0)
    assert OMNI.straight((0.2, 0.1, 1.0)) == (0.2, 0.1, 0.0)


def test_limits():
    assert CAR.within((1.0, -0.12346)) == (0.4, -0.1235)
    assert WHEELS.within((-33.6, 101)) == (-34, 100)
    with pytest.raises(UserError, match=r"speed: 0\.5 is beyond its limits; use -0\.3 to 0\.4 m/s"):
        CAR.check((0.5, 0))
    with pytest.raises(UserError, match=r"has 3 numbers \(vx, vy, omega\), not 2"):
        OMNI.check((0, 0))
    with pytest.raises(UserError, match="beyond its limits"):
        UNICYCLE.check((math.nan, 0))


@pytest.mark.parametrize("takes", ALL)
def test_they_are_described_and_read_back(takes):
    assert Commands.of(json.loads(json.dumps(takes.describe()))) == takes


def test_what_describes_no_commands():
    one = Number("v", "m/s", -1, 1)
    with pytest.raises(ValueError, match="numbers of different names"):
        Commands((one, one))
    with pytest.raises(ValueError, match="'time' cannot be the name"):
        Commands((Number("time", "s", 0, 1),))
    with pytest.raises(ValueError, match="the body car does not have these numbers"):
        Commands((one,), "car")
    unknown = Commands((Number("throttle", "%", -100, 100),))
    assert not unknown.moves_as_known
    with pytest.raises(UserError, match="does not give its body"):
        unknown.twist((3,))
    assert Commands.of(None) == WHEELS
