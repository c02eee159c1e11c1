"""The correction of a motion network's twists: by hand, compiled, cut, written, and bounded."""

import json
import math
from dataclasses import asdict, astuple, replace

import numpy as np
import pytest
import torch
from closed_loops import POSES_GOALS_TIME, assert_alike, both, families
from given_plans import GivenPlans, by_protocol, expected, sampled_poses
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_networks import LONGEST, drive_model, random_motion_network

from neurosim.base.errors import FileError, UserError
from neurosim.base.trajectory import Draws, Episode
from neurosim.simulators import read_simulator
from neurosim.simulators.adjustable import Adjustable, AdjustableSimulator
from neurosim.simulators.motion.correction import Correction
from neurosim.simulators.motion.drive import CURVES, DriveModel
from neurosim.simulators.motion.files import write_motion

SIMULATOR = random_motion_network()
CORRECTION = Correction(1.1, 0.9, 0.3, -0.01, 0.05)
BASE = 0.12
#: Wheels 0.3 m/s fast, on a track of BASE.
TWO_WHEELS = [[0.15, 0.0, -0.3 / BASE], [0.15, 0.0, 0.3 / BASE], *[[0.0] * 3] * 3]


def double(values):
    return torch.tensor(values, dtype=torch.float64)


def instant():
    """Return a drive model of two wheels that are at their speeds at once."""
    laws = [double([value, value]) for value in (1e-9, 1.0, 1.0, 1e12, 0.0)]
    return DriveModel(*laws, torch.zeros(2, CURVES), double([0.0]), double(TWO_WHEELS))


def driven_twist(drive, left, right, time):
    speeds = double([[left, right]])
    pieces = drive.pieces(drive.begun(speeds), speeds, double([time]))
    return sum(piece.features for piece in pieces) @ drive.twists


@st.composite
def corrections(draw):
    """Return values within all bounds."""
    return np.array([one.at(draw(st.floats(0.0, 1.0))) for one in SIMULATOR.parameters])


def some(count=6, seed=1):
    """Return plans of six commands each, [count]."""
    rng = np.random.default_rng(seed)
    commands = rng.uniform((-50, -50, 0.2), (50, 50, LONGEST), (count, 6, 3))
    return GivenPlans(commands, rng.random((count, 6)) < 0.8)


def test_two_wheels_worked_by_hand():
    # Wheels that travel 1.2 and 0.9 times as far: forward and turn are scaled by their mean; of 1 m
    # forward the left travels 0.3 m more than the right, of 1 rad each half a track.
    left, right = 1.2, 0.9
    correction = Correction(1.05, 1.05, (right - left) / BASE, (right - left) * BASE / 4)
    drive = correction.of_drive(instant())
    distances = 0.3 * 2.0 * left * 0.5, 0.3 * 2.0 * right * 1.0
    wanted = sum(distances) / 2, 0.0, (distances[1] - distances[0]) / BASE
    assert driven_twist(drive, 0.5, 1.0, 2.0)[0].tolist() == pytest.approx(wanted)


def test_slip_worked_by_hand():
    # 0.225 m/s and 1.25 rad/s, for 2 s; speeds that are corrected slip more.
    drive = Correction(slip=0.04).of_drive(instant())
    aside = 0.04 * 0.225 * 1.25 * 2.0
    assert driven_twist(drive, 0.5, 1.0, 2.0)[0].tolist() == pytest.approx([0.45, aside, 2.5])
    drive = Correction(forward=2.0, turn=1.5, slip=0.04).of_drive(instant())
    wanted = [0.9, 3.0 * aside, 3.75]
    assert driven_twist(drive, 0.5, 1.0, 2.0)[0].tolist() == pytest.approx(wanted)
    # Straight on, and on the spot, there is none.
    assert driven_twist(drive, 0.5, 0.5, 2.0)[0, 1] == pytest.approx(0.0, abs=1e-15)
    assert driven_twist(drive, -0.5, 0.5, 2.0)[0, 1] == pytest.approx(0.0, abs=1e-15)


def test_what_networks_add_is_corrected_too():
    twist = double([[0.1, 0.02, 0.5]])
    assert CORRECTION.of_twists(twist)[0].tolist() == pytest.approx([0.105, 0.02, 0.48])
    # The whole motion of a robot that settles at once is one twist, of drive model and networks.
    sim = random_motion_network(noise=False)
    x = torch.rand(5, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    moved = sim.adjusted(np.array([1.3, 1.0, 0.0, 0.0, 0.0]))
    outputs = torch.full((5, 3), 0.1, dtype=torch.float64)
    more = outputs * double([1.3, 1.0, 1.0])
    bare = replace(sim.drive, kinematics=sim.drive.kinematics * double([1.3, 1.0, 1.0]))
    again = random_motion_network(noise=False)
    again._corrected = bare
    torch.testing.assert_close(
        moved.from_outputs(outputs, x), again.from_outputs(more, x), rtol=0, atol=1e-14
    )


def test_a_robot_may_turn_round_within_a_command():
    # 2 pi and more: where a displacement has no twist.
    correction = Correction(1.1, 1.05, 0.2, 0.004, 0.02)
    before, near = instant(), []
    for time in np.linspace(0.9, 1.1, 41) * math.tau / 5.0:
        moved, twist = correction.of_drive(before).phases(
            before.begun(double([[-1.0, 1.0]])), double([[-1.0, 1.0]]), double([time])
        )
        near.append((moved[0, :2].abs() + twist[0, :2].abs()).max())
    assert max(near) < 0.05


def test_as_it_stands_nothing_changes():
    sim = SIMULATOR.adjusted(np.array(astuple(Correction())))
    assert sim.conditions() == {}
    plans, starts = some(), np.zeros((6, 3))
    assert np.array_equal(by_protocol(sim, starts, plans), by_protocol(SIMULATOR, starts, plans))
    rolled_out = [expected(one.rollouts(plans, Episode(rest=0.5)), plans, starts[0]) for one in
             (sim, SIMULATOR)]  # fmt: skip
    assert np.array_equal(*rolled_out)
    for name, value in SIMULATOR.compiled()._asdict().items():
        assert np.array_equal(getattr(sim.compiled(), name), value, equal_nan=True), name


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(corrections())
def test_compiled_is_stepped(values):
    sim, plans = SIMULATOR.adjusted(values), some()
    start, rest = np.array([0.1, -0.2, 0.7]), Episode(rest=0.5)
    rolled_out = expected(sim.rollouts(plans, rest), plans, start)
    stepped = by_protocol(sim, np.repeat(start[None], 6, 0), plans)
    np.testing.assert_allclose(rolled_out, stepped, rtol=0, atol=1e-9)
    family = families(POSES_GOALS_TIME, scale=(40.0, 35.0))["hidden"]
    episode = Episode(0.4, 8, 0.5, np.array([[0.05, 0.02, 0.3]]))
    draws = sim.rollouts(family, episode).draw(np.zeros((4, 3)), 3)
    assert_alike(*both(sim, family, episode, draws), 1e-9, 1e-6)


@settings(max_examples=10, deadline=None)
@given(corrections(), st.lists(st.floats(0.05, 1.0), min_size=2, max_size=6))
def test_it_does_not_matter_into_what_a_command_is_cut(values, cuts):
    sim, ends = SIMULATOR.adjusted(values), []
    times = 2.5 * np.array(cuts) / sum(cuts)
    for parts in ([2.5], times):
        commanded = np.array([[20.0, -30.0, 0.7], *([35.0, 45.0, t] for t in parts)])[None]
        plans = GivenPlans(commanded, np.ones(commanded.shape[:2], bool))
        rollouts = sim.rollouts(plans, Episode(rest=0.5))
        noise = np.random.default_rng(4).standard_normal((1, 2, 4))
        noise = np.concatenate([noise, np.full((1, commanded.shape[1] - 1, 4), 99.0)], axis=1)
        noise[:, -1] = 0.1
        draws = Draws(np.zeros((1, 3)), np.array([1]), noise)
        paths = (
            sampled_poses(rollouts, plans, draws)[0, 0],
            by_protocol(sim, np.zeros((1, 3)), plans)[0],
        )
        ends.append([path[[commanded.shape[1], -1]] for path in paths])
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-10)


def test_written_and_read(tmp_path):
    write_motion(SIMULATOR.adjusted(np.array(astuple(CORRECTION))), tmp_path)
    again = read_simulator(tmp_path)
    assert again.correction == CORRECTION
    assert again.meta == {}
    assert again.conditions() == {"correction": asdict(CORRECTION)}
    assert torch.equal(again.drive.kinematics, SIMULATOR.drive.kinematics)
    # Another correction replaces it.
    assert again.adjusted(np.array(astuple(Correction()))).correction == Correction()
    write_motion(SIMULATOR, tmp_path)
    assert "correction" not in json.loads((tmp_path / "simulator.json").read_text())


@pytest.mark.parametrize(
    "wrong",
    [
        [],
        {"forward": 1.0},
        asdict(CORRECTION) | {"turn": "1"},
        asdict(CORRECTION) | {"turn": True},
        asdict(CORRECTION) | {"turn": 0.0},
        asdict(CORRECTION) | {"more": 0.0},
    ],
)
def test_a_damaged_one_is_refused(tmp_path, wrong):
    write_motion(SIMULATOR, tmp_path)
    path = tmp_path / "simulator.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"correction": wrong}))
    with pytest.raises(FileError, match="'correction"):
        read_simulator(tmp_path)


def test_bounds_and_what_cannot_be_corrected():
    assert isinstance(SIMULATOR, AdjustableSimulator)
    names = [one.name for one in SIMULATOR.parameters]
    assert names == ["forward", "turn", "yaw", "drift", "slip"]
    with pytest.raises(UserError, match=r"the parameter yaw is 1\.2, outside of -1 to 1 rad/m"):
        SIMULATOR.adjusted(np.array([1.0, 1.0, 1.2, 0.0, 0.0]))
    with pytest.raises(UserError, match="expected 5 parameters"):
        SIMULATOR.adjusted(np.ones(4))
    with pytest.raises(UserError, match="outside"):
        SIMULATOR.adjusted(np.array([1.0, np.nan, 0.0, 0.0, 0.0]))
    bare = random_motion_network(drives=False)
    with pytest.raises(UserError, match="no drive model to correct"):
        bare.adjusted(np.ones(5))
    for values in ((0.0, 1.0), (1.0, -1.0), (math.inf, 1.0), (1.0, 1.0, math.nan)):
        with pytest.raises(UserError, match=r"(forward|turn|yaw): .* found"):
            Correction(*values)


def test_a_robot_that_does_not_turn_by_its_wheels_has_no_slip():
    drive = drive_model(0, 3, kinematics=torch.eye(9, 3, dtype=torch.float64) * double([1, 1, 0]))
    assert torch.equal(Correction(slip=0.1).of_drive(drive).kinematics, drive.kinematics)


@settings(deadline=None)
@given(
    st.floats(1e-3, 10.0), st.floats(1.001, 1e3), st.booleans(), st.sampled_from([0.0, 1.0])
    | st.floats(-1.0, 2.0),
)  # fmt: skip
def test_no_share_leads_out_of_bounds(low, width, log, fraction):
    one = Adjustable("x", low, low, low * width, log=log)
    value = one.checked(one.at(fraction))
    if 0.0 <= fraction <= 1.0:
        assert one.fraction(value) == pytest.approx(fraction, abs=1e-9)
