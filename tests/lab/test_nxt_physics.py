"""The virtual NXT's motion: an ideal robot by hand, a real one by statistics."""

import math
from dataclasses import replace

import numpy as np
import pytest
from nxt_drives import displacements

from neurosim.base import se2
from neurosim.lab.nxt import physics
from neurosim.lab.nxt.params import LabParams
from neurosim.lab.nxt.physics import S, U

IDEAL = LabParams.ideal()
LAG = IDEAL.lag_left
FULL = 0.5  # m/s at the rim


def drive(params, *commands, seed=0, start=(0.0, 0.0, 0.0), battery=None):
    """Return the pose at the start and after each command (left %, right %, seconds)."""
    state = physics.new_state(params, seed, start)
    if battery is not None:
        state[S.BATTERY] = battery
    field = physics.slip_field(params)
    return displacements(state, np.array(commands, float), params.coefficients(), field)


def path(before, after, seconds):
    """Return the distance of a wheel that lags from one speed (m/s) to another, in closed form."""
    return after * seconds + (before - after) * LAG * (1.0 - math.exp(-seconds / LAG))


def paper_commands(count, rng):
    """Draw commands as Pretorius et al. 2009, section 5.1."""
    kind = rng.random(count)
    commands = np.column_stack([rng.uniform(-50, 50, (count, 2)), rng.uniform(0.5, 3.0, count)])
    equal = (kind >= 0.5) & (kind < 0.8)
    commands[equal, 1] = commands[equal, 0]
    commands[kind >= 0.8, :2] = 0.0
    return commands


@pytest.mark.slow
def test_ideal_robot_runs_straight_after_its_lag():
    end = drive(IDEAL, (40, 40, 2.0))[-1]
    assert end == pytest.approx([path(0, 0.4 * FULL, 2.0), 0.0, 0.0], abs=1e-9)


def test_ideal_robot_spins_on_the_spot():
    end = drive(IDEAL, (-20, 20, 1.5))[-1]
    turn = 2 * path(0, 0.2 * FULL, 1.5) / IDEAL.track
    assert turn > 1.0
    assert end == pytest.approx([0.0, 0.0, turn], abs=2e-5)


def test_ideal_robot_drives_an_arc():
    end = drive(IDEAL, (20, 40, 3.0))[-1]
    left, right = path(0, 0.2 * FULL, 3.0), path(0, 0.4 * FULL, 3.0)
    turn, radius = (right - left) / IDEAL.track, 0.5 * IDEAL.track * (right + left) / (right - left)
    expected = [radius * math.sin(turn), radius * (1 - math.cos(turn)), turn]
    assert end == pytest.approx(expected, abs=2e-5)


def test_speed_carries_over_from_the_command_before():
    poses = drive(IDEAL, (50, 50, 2.0), (-30, -30, 1.0))
    speed = 0.5 * FULL * (1 - math.exp(-2.0 / LAG))
    assert poses[2, 0] - poses[1, 0] == pytest.approx(path(speed, -0.3 * FULL, 1.0), abs=1e-9)


def test_a_batch_of_one_step_is_the_step():
    params = LabParams.sampled(3)
    state, inputs = physics.new_state(params, 1, (0.2, 0.1, 0.5)), physics.new_inputs()
    inputs[U.MODE : U.MODE + 2], inputs[U.POWER : U.POWER + 2] = physics.REGULATED, (30, -20)
    other = state.copy()
    arguments = inputs, params.coefficients(), physics.slip_field(params)
    for _ in range(50):
        physics.step(state, *arguments, physics.STEP)
    assert physics.advance(other, *arguments, 50 * physics.STEP) == -1
    assert state[: S.TIME + 1] == pytest.approx(other[: S.TIME + 1])
    assert state[S.X : S.SIZE] == pytest.approx(other[S.X : S.SIZE], abs=1e-9)


def test_dead_band_holds_the_wheels():
    params = LabParams()
    assert np.ptp(drive(params, (3.5, -3.5, 2.0), (-3, 3.5, 2.0)), axis=0).max() == 0.0
    assert drive(params, (6, 6, 2.0))[-1, 0] > 0.03


def test_static_friction_holds_a_wheel_that_changes_direction():
    sticky = replace(IDEAL, breakaway=0.6)
    free, held = (drive(p, (20, 20, 2.0), (-20, -20, 2.0))[-1] for p in (IDEAL, sticky))
    # Once at the start (0.6 % s at 20 % is 30 ms) and once at the reversal; the first loses
    # forward distance, the second backward distance.
    start = drive(sticky, (20, 20, 2.0))[-1, 0] - drive(IDEAL, (20, 20, 2.0))[-1, 0]
    assert start == pytest.approx(-0.03 * 0.2 * FULL, abs=3e-4)
    assert held[0] - free[0] - start == pytest.approx(0.03 * 0.2 * FULL, abs=6e-4)


def test_caster_swings_round_when_the_direction_turns():
    params = replace(IDEAL, caster_drag=0.18, caster_yaw=1.0, caster_draw=0.0, caster_bias=0.16)
    forward = drive(params, (40, 40, 2.0), (40, 40, 2.0))
    assert abs(forward[-1, 2]) < 1e-3
    turned = drive(params, (40, 40, 2.0), (-40, -40, 2.0))
    # The yaw is caster_yaw * trail * integral of sin from pi to 0, and its sign is the bias's.
    yaw = turned[-1, 2] - turned[1, 2]
    assert abs(yaw) == pytest.approx(2 * 0.016, rel=0.7)
    mirrored = drive(replace(params, caster_bias=-0.16), (40, 40, 2.0), (-40, -40, 2.0))
    assert mirrored[-1, 2] == pytest.approx(-turned[-1, 2], abs=1e-9)
    dragged = turned[1, 0] - turned[2, 0]
    free = drive(IDEAL, (40, 40, 2.0), (-40, -40, 2.0))
    assert 0.001 < (free[1, 0] - free[2, 0]) - dragged < 0.02


def test_unequal_wheels_bend_a_straight_command():
    params = replace(IDEAL, diameter_right=IDEAL.diameter_left * 1.01)
    end = drive(params, (50, 50, 3.0))[-1]
    assert end[2] == pytest.approx(0.01 * path(0, 0.5 * FULL, 3.0) / IDEAL.track, rel=1e-3)


def test_same_seed_same_drive():
    params = LabParams.sampled(5)
    commands = paper_commands(20, np.random.default_rng(0))
    first, again, other = (drive(params, *commands, seed=s) for s in (1, 1, 2))
    assert np.array_equal(first, again)
    assert np.abs(first - other).max() > 0.01


def test_drawn_robots_differ_and_repeat():
    assert LabParams.sampled(4) == LabParams.sampled(4)
    assert LabParams.sampled(4) != LabParams.sampled(5)


def test_slip_field_has_its_deviation_and_length():
    values = np.stack([physics.slip_field(LabParams(slip_seed=s)) for s in range(40)])
    assert values.std() == pytest.approx(LabParams().slip_field, rel=0.1)
    apart = round(LabParams().slip_length / 0.05)
    correlation = (values[..., apart:] * values[..., :-apart]).mean() / (values**2).mean()
    assert correlation == pytest.approx(math.exp(-0.5), abs=0.08)


def test_draws_are_standard_normal():
    params = LabParams()
    state, p = physics.new_state(params, 9, (0, 0, 0)), params.coefficients()
    slips = []
    for _ in range(4000):
        physics.begin_command(state, 1, p)
        slips.append(state[S.SLIP + 1] / params.slip_draw)
    slips = np.array(slips)
    assert abs(slips.mean()) < 0.06
    assert slips.std() == pytest.approx(1.0, abs=0.04)
    assert (np.abs(slips) > 1.96).mean() == pytest.approx(0.05, abs=0.015)


@pytest.mark.slow
def test_battery_sags_under_load_and_runs_down():
    params = LabParams()
    state, inputs = physics.new_state(params, 0, (0, 0, 0)), physics.new_inputs()
    p, field = params.coefficients(), physics.slip_field(params)
    inputs[U.MODE : U.MODE + 2], inputs[U.POWER : U.POWER + 2] = physics.REGULATED, (50, -50)
    physics.advance(state, inputs, p, field, 3600.0)
    lost = params.battery_idle_loss + 0.5 * params.battery_drive_loss
    assert state[S.BATTERY] == pytest.approx(params.battery - lost, abs=1e-3)
    assert state[S.VOLTAGE] == pytest.approx(state[S.BATTERY] - 0.5 * params.battery_sag)


def test_regulation_hides_the_battery_until_the_motor_can_do_no_more():
    fresh, flat = (drive(IDEAL, (50, 50, 3.0), battery=v)[-1, 0] for v in (8.0, 6.5))
    assert flat == pytest.approx(fresh, rel=0.02)
    fresh, flat = (drive(IDEAL, (100, 100, 1.5), battery=v)[-1, 0] for v in (8.0, 6.0))
    assert flat < 0.85 * fresh


def test_the_room_has_walls():
    x = drive(IDEAL, (100, 100, 60.0))[-1, 0]
    assert x == pytest.approx(2.76 / 2 + IDEAL.room)


@pytest.mark.slow
def test_what_cannot_be_predicted_is_small_and_what_can_is_not():
    """Mean absolute deviations of the same command, over places, batteries and draws."""
    params = LabParams.sampled(1)
    rng = np.random.default_rng(1)
    commands, repeats = paper_commands(120, rng), 16
    p, field = params.coefficients(), physics.slip_field(params)
    moved = np.empty((repeats, len(commands), 3))
    for r in range(repeats):
        for i, command in enumerate(commands):
            place = rng.uniform([-1.1, -0.7, -math.pi], [1.1, 0.7, math.pi])
            state = physics.new_state(params, 1000 * r + i, tuple(place))
            state[S.BATTERY] = rng.uniform(7.2, 8.2)
            poses = displacements(state, np.stack([commands[i - 1], command]), p, field)
            moved[r, i] = se2.between(poses[1], poses[2])
    noise = np.abs(moved - moved.mean(0)).mean((0, 1))
    assert 0.001 < noise[0] < 0.004
    assert 0.001 < noise[1] < 0.005
    assert 0.8 < math.degrees(noise[2]) < 2.2

    v, w = commands[:, :2].mean(1) * 0.005, np.diff(commands[:, :2])[:, 0] * 0.005 / 0.13
    unicycle = se2.exp(np.column_stack([v, 0 * v, w]) * commands[:, 2:])
    assert (np.abs(moved.mean(0) - unicycle).mean(0) > 3 * noise).all()

    straight = (commands[:, 0] == commands[:, 1]) & (commands[:, 0] != 0)
    assert 0.15 < np.abs(moved[:, straight, 0]).mean() < 0.3
