"""The compiled distances of rows, compared with those of the drive model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from neurosim.base.se2 import tensors as se2
from neurosim.simulators.motion.drive import PHASES, DriveModel, features_of, terms_of
from neurosim.simulators.motion.network import rows_underway
from neurosim.simulators.motion.noise import CommandFeatures
from neurosim.training.base import Within
from neurosim.training.trainers.drive_fit import (
    Actuators,
    Fit,
    Motion,
    body_modes,
    fit_drive,
    regressions,
    terms_near_zero,
)

#: Terms of full speed ahead of modes, and of its square alone.
AHEAD = torch.tensor([[1, 0, 1, 0, 0], [0, 0, 1, 0, 0]], dtype=torch.float64)
NAMES = ("prev_left", "prev_right", "left", "right", "duration")


def several_laws(generator: torch.Generator) -> torch.Tensor:
    """Return four models' laws [4, L, 2]: two with a delay, one with grip, one with friction."""
    laws = torch.zeros(4, 13, 2, dtype=torch.float64)
    laws[:, 0] = torch.rand(4, 2, generator=generator, dtype=torch.float64) - 2.0
    laws[:, 1:3] = 0.5 * torch.randn(4, 2, 2, generator=generator, dtype=torch.float64)
    laws[:, 3] = torch.tensor([0.5, 1.5, 3.0, 0.0], dtype=torch.float64)[:, None]
    laws[3, 4] = 0.05
    laws[:, 5:11] = 0.1 * torch.randn(4, 6, 2, generator=generator, dtype=torch.float64)
    laws[0, 11, 0], laws[3, 11, 0] = 0.06, 0.15
    return laws


@pytest.fixture
def motion() -> Motion:
    generator = torch.Generator().manual_seed(0)
    rows = 40
    x = 2.0 * torch.rand(rows, 5, generator=generator, dtype=torch.float64) - 1.0
    x[:, 4] = 0.02 + 0.98 * torch.rand(rows, generator=generator, dtype=torch.float64)
    follows = torch.arange(rows) % 5 > 0
    x[1:, :2] = torch.where(follows[1:, None], x[:-1, 2:4], x[1:, :2])
    row = torch.arange(rows).repeat_interleave(2)
    time = x[row, 4] * 2.0 * torch.tensor([0.3, 0.8], dtype=torch.float64).repeat(rows)
    y = torch.randn(rows, 3, generator=generator, dtype=torch.float64)
    moved = torch.randn(2 * rows, 3, generator=generator, dtype=torch.float64)
    return Motion(x, y, follows, CommandFeatures.of(NAMES), 2.0, Within(row, time, moved))


def test_stretches_of_rows_keep_their_poses(motion):
    x, follows = motion.x.repeat(20, 1), motion.follows.repeat(20)
    row = torch.arange(800).repeat_interleave(2)
    y = torch.arange(2400.0, dtype=torch.float64).view(800, 3)  # tells which row it is
    within = Within(row, motion.within.time.repeat(20), y[row] / 2.0)
    log = replace(motion, x=x, y=y, follows=follows, within=within)
    some = log.some(250)
    kept = [*range(125), *range(400, 525)]
    assert torch.equal(some.y, y[kept])
    expected = follows.clone()
    expected[[0, 400]] = False
    assert torch.equal(some.follows, expected[kept])
    assert len(some.within.row) == 250
    assert torch.equal(some.within.moved, some.y[some.within.row] / 2.0)
    assert torch.equal(log.some(800).y, y)


def test_distances_are_those_of_the_drive_model(motion):
    laws = several_laws(torch.Generator().manual_seed(1))
    bands = torch.tensor([[0.0, 0.0], [0.1, 0.2], [0.0, 0.3], [0.05, 0.0]], dtype=torch.float64)
    actuators = Actuators.of(laws, bands)
    turning = torch.tensor([-0.4, 0.6], dtype=torch.float64)
    modes = torch.tensor([[0.6, 0.4], [-0.5, 0.5]], dtype=torch.float64)
    motion = replace(motion, turning=turning, modes=modes)
    pieces, within, *_ = motion.distances(actuators)
    for p in range(len(laws)):
        *each, drag = (torch.from_numpy(part) for part in actuators.one(p)[3:])
        drive = DriveModel(*each, torch.zeros(features_of(2), 3), turning, None, modes, drag)
        fit = Fit(drive, motion, bands[p], laws[p], True, actuators)
        x = motion.inputs(fit)
        under = rows_underway(drive, motion.columns, x)
        expected = [one.features for one in drive.pieces(under, x[:, 2:4], x[:, 4] * 2.0)]
        # The piece after the speeds have settled, those in which they change, and all.
        assert pytest.approx(expected[-1], abs=1e-9) == pieces[p, -1].T
        assert pytest.approx(expected[-1 - PHASES], abs=1e-9) == pieces[p, PHASES].T
        assert pytest.approx(sum(expected), abs=1e-9) == pieces[p].sum(0).T
        row = motion.within.row
        under = type(under)(*(part[row] for part in under))
        pieces_of = drive.pieces(under, x[row, 2:4], motion.within.time)
        until = [one.features for one in pieces_of]
        assert pytest.approx(sum(until), abs=1e-9) == within[p].sum(0).T
        assert pytest.approx(until[-1], abs=1e-9) == within[p, -1].T


def in_curves(ahead: float, turn: float) -> Motion:
    """Return rows of a robot with two wheels that loses these fractions of its speeds in a spin."""
    generator = torch.Generator().manual_seed(2)
    rows, double = 200, torch.float64
    x = 2.0 * torch.rand(rows, 5, generator=generator, dtype=double) - 1.0
    x[:, 4] = 0.2 + 0.8 * torch.rand(rows, generator=generator, dtype=double)
    kinematics = torch.zeros(features_of(2), 3, dtype=double)
    kinematics[:2] = torch.tensor([[0.1, 0.0, -1.0], [0.1, 0.0, 1.0]])
    losses = kinematics[:2] * torch.tensor([-ahead, 0.0, -turn], dtype=double)
    laws = [torch.full((2,), value, dtype=double) for value in (0.1, 1.0, 1.0, 20.0, 0.0)]
    curve, delay = torch.zeros(2, 6, dtype=double), torch.zeros(1, dtype=double)
    turning = torch.tensor([-0.5, 0.5], dtype=double)
    true = DriveModel(*laws, curve, delay, kinematics, turning, losses)
    under = rows_underway(true, CommandFeatures.of(NAMES), x)
    changing, twist = true.phases(under, x[:, 2:4], x[:, 4] * 2.0)
    y = se2.compose(changing, se2.exp(twist))
    y = y + 0.001 * torch.randn(rows, 3, generator=generator, dtype=double)
    return Motion(x, y, torch.zeros(rows, dtype=torch.bool), CommandFeatures.of(NAMES), 2.0)


@pytest.mark.slow
def test_what_a_robot_loses_in_curves_is_found():
    fit = fit_drive(in_curves(1 / 3, 1 / 2))
    assert fit.drive.turning.tolist() == pytest.approx([-0.5, 0.5], abs=0.02)
    assert fit.drive.losses[:, 0].tolist() == pytest.approx([-1 / 30, -1 / 30], rel=0.15)
    assert fit.drive.losses[:, 2].tolist() == pytest.approx([0.5, -0.5], rel=0.15)


@pytest.mark.slow
def test_a_robot_that_loses_nothing_in_curves_has_no_losses():
    assert not fit_drive(in_curves(0.0, 0.0)).drive.losses.any()


def heavy(
    forward: float, turn: float, modes: bool = True, drag: float = 0.0, noise: float = 0.001
) -> Motion:
    """Return rows, one straight into the next, of a robot with two lags (s).

    They are of forward motion and the turn, or of the two wheels; ``drag`` is of the first. The
    ``noise`` is that of displacements, m and rad.
    """
    rng = np.random.default_rng(3)
    double = torch.float64
    commanded = torch.tensor(rng.uniform(-1.0, 1.0, (200, 2)))
    time = torch.tensor(rng.uniform(0.5, 2.0, 200))
    kinematics = torch.zeros(features_of(2), 3, dtype=double)
    kinematics[:2] = torch.tensor([[0.3, 0.0, 0.0], [0.0, 0.0, 1.5]])
    body = torch.tensor([[0.5, 0.5], [-0.5, 0.5]], dtype=double)
    if not modes:
        kinematics[:2] = body.T @ kinematics[:2]
    laws = [torch.full((2,), value, dtype=double) for value in (1.0, 1.0, 20.0, 0.0)]
    true = DriveModel(
        torch.tensor([forward, turn], dtype=double), *laws,
        torch.zeros(2, 6, dtype=double), torch.zeros(1, dtype=double), kinematics,
        modes=body if modes else None, drag=torch.tensor([drag, 0.0], dtype=double),
    )  # fmt: skip
    before = torch.cat([torch.zeros(1, 2, dtype=double), commanded[:-1]])
    x = torch.cat([before, commanded, time[:, None] / 2.0], 1)
    under, moved = true.begun(torch.zeros(1, 2, dtype=double)), []
    for goal, lasts in zip(true.shaped(commanded).split(1), time.split(1), strict=True):
        changing, twist = true.phases(under, goal, lasts)
        moved.append(se2.compose(changing, se2.exp(twist)))
        under = true.after(under, goal, lasts, true.reached(under, goal, lasts))
    y = torch.cat(moved) + torch.tensor(rng.normal(0.0, noise, (200, 3)))
    follows = torch.arange(200) > 0
    return Motion(x, y, follows, CommandFeatures.of(NAMES), 2.0)


@pytest.mark.slow
def test_a_body_slower_forward_than_in_a_turn_has_laws_of_its_own():
    rows = heavy(2.5, 0.5)
    drive = fit_drive(rows).drive
    assert drive.modes.flatten().tolist() == pytest.approx([0.5, 0.5, -0.5, 0.5], abs=0.03)
    assert drive.lag.tolist() == pytest.approx([2.5, 0.5], rel=0.1)
    # Without them the turn determines both lags.
    alone = fit_drive(rows, without=("modes",)).drive
    assert torch.equal(alone.modes, torch.eye(2, dtype=torch.float64))
    assert alone.lag.tolist() == pytest.approx([0.5, 0.5], abs=0.1)


@pytest.mark.slow
def test_quadratic_drag_is_found_where_there_is_one():
    drive = fit_drive(heavy(2.5, 0.5, drag=1.5)).drive
    assert drive.drag[0].item() == pytest.approx(1.5, rel=0.3)
    assert drive.lag[0].item() == pytest.approx(2.5, rel=0.15)
    assert fit_drive(heavy(2.5, 0.5)).drive.drag.tolist() == [0.0, 0.0]


@pytest.mark.slow
def test_wheels_with_lags_of_their_own_have_no_modes():
    drive = fit_drive(heavy(0.3, 0.15, modes=False)).drive
    assert torch.equal(drive.modes, torch.eye(2, dtype=torch.float64))
    assert drive.lag.tolist() == pytest.approx([0.3, 0.15], rel=0.15)


@pytest.mark.parametrize("car", [True, False])
def test_a_car_of_few_rows_turns_less_when_it_is_slower(car):
    rng = np.random.default_rng(4)
    speed, steering = rng.uniform(0.8, 1.0, 12), rng.uniform(-1.0, 1.0, 12)
    commanded = torch.tensor(np.stack([speed, steering], 1))
    time = torch.tensor(rng.uniform(0.5, 2.0, 12))
    x = torch.cat([torch.zeros(12, 2), commanded, time[:, None] / 2.0], 1)
    kinematics = torch.zeros(features_of(2), 3, dtype=torch.float64)
    kinematics[0, 0] = 0.4
    kinematics[3 if car else 1, 2] = 1.2
    laws = [torch.full((2,), value, dtype=torch.float64) for value in (0.1, 1.0, 1.0, 20.0, 0.0)]
    true = DriveModel(*laws, torch.zeros(2, 6).double(), torch.zeros(1).double(), kinematics)
    columns = CommandFeatures.of(NAMES)
    changing, twist = true.phases(rows_underway(true, columns, x), commanded, time)
    y = se2.compose(changing, se2.exp(twist)) + torch.tensor(rng.normal(0.0, 0.005, (12, 3)))
    rows = Motion(x, y, torch.zeros(12, dtype=torch.bool), columns, 2.0)
    fit = fit_drive(rows)
    assert fit.rows.steered == car
    # At half the speed a car turns half as fast.
    slow = torch.tensor([0.5, 1.0, 0.25, 0.5, 1.0], dtype=torch.float64)
    expected = float((slow @ kinematics)[2])
    assert float((slow @ fit.drive.kinematics)[2]) == pytest.approx(expected, rel=0.15)
    usual = fit_drive(rows, without=("car",))
    assert not usual.rows.steered
    if car:
        assert float((slow @ usual.drive.kinematics)[2]) > 1.5 * expected


def test_forward_motion_and_turn_are_modes_of_four_wheels_too():
    wheels = torch.tensor([[0.25] * 4, [-0.25, -0.25, 0.25, 0.25]], dtype=torch.float64)
    modes = body_modes(torch.stack([wheels[0], 0.01 * wheels[1], 4.0 * wheels[1]]))
    assert modes[:2].flatten().tolist() == pytest.approx(wheels.flatten().tolist())
    # The other two do not move the body.
    assert (modes[2:] @ wheels.T).abs().max() < 1e-9
    assert torch.linalg.matrix_rank(modes) == 4
    # Those of a robot that is commanded by them are its actuators.
    assert body_modes(torch.tensor([[0.4, 0.01], [0.0, 0.0], [0.02, 2.0]]).double()) is None


def test_terms_that_a_symmetric_body_cannot_have_are_held_nearer_zero():
    # Terms: forward, turn; their products 11, 12, 22; losses of both.
    rows = replace(heavy(2.5, 0.5), symmetric=True)
    turn, shift = terms_near_zero(rows, terms_of(2))
    assert turn.tolist() == [0, 0, 400, 1, 400, 400, 1]
    assert shift.tolist() == [0, 0, 1, 400, 1, 1, 400, 0, 0, 400, 1, 400, 400, 1]
    turn, shift = terms_near_zero(replace(rows, symmetric=False), features_of(2))
    assert turn.tolist() == [0, 0, 1, 1, 1]
    assert shift.tolist() == 2 * turn.tolist()


@pytest.mark.slow
def test_a_symmetric_body_of_few_rows_drives_nearly_straight_ahead():
    rows = heavy(2.5, 0.5, noise=0.03)
    few = replace(rows, x=rows.x[:100], y=rows.y[:100], follows=rows.follows[:100])
    turns = []
    for without in ((), ("symmetry",)):
        fit = fit_drive(few, without=without)
        assert fit.rows.symmetric == (not without)
        # Of full speed ahead, and of its square.
        turns.append([abs(float(k @ fit.drive.kinematics[:, 2])) for k in AHEAD])
    assert turns[0][0] < 0.75 * turns[1][0]
    assert turns[0][1] < 0.4 * turns[1][1]


def test_a_regression_without_rows_has_no_weights():
    # The first part of a log in which the robot stands has no windows.
    none, terms = torch.zeros(0, dtype=torch.float64), torch.ones(2, dtype=torch.bool)
    weights, errors = regressions(none.view(1, 0).expand(1, 2, 0), none, terms, none)
    assert weights.tolist() == [[0.0, 0.0]]
    assert errors.error.shape == (1, 0)
