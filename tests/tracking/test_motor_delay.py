"""The clock and the motors' delay from motion: synthetic wheels with a dead time and a lag."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_robot import MotorLine

from neurosim.base.errors import UserError
from tracking.clock.motion import disagreement, fit_clock_to_motion
from tracking.clock.motor_delay import answers_to, changes_of, motion_delay, signals_of
from tracking.clock.sync import ClockFit
from tracking.datasets.displacements import displacements
from tracking.datasets.recordings import Poses, Recording

LAG = 0.11


def commands(count, seed, first=3.0):
    """Lines as a recording has them: new speeds every 0.5 to 2 s, then a stop."""
    rng = np.random.default_rng(seed)
    durations = rng.uniform(0.5, 2.0, count)
    starts = first + np.concatenate([[0.0], np.cumsum(durations)])
    return [MotorLine(t, *rng.uniform(-50, 50, 2)) for t in starts[:-1]] + [
        MotorLine(starts[-1], 0.0, 0.0)
    ]


def drive(lines, dead, seed, *, drift=0.0, dropped=0.0, noise=(0.0005, 0.0005, 0.003)):
    """Robot times and poses of wheels that answer ``dead`` seconds late, seen at 30 a second."""
    rng = np.random.default_rng(seed)
    step = 0.002
    fine = np.arange(0.0, lines[-1].time + 2.0, step)
    current = np.searchsorted([line.time + dead for line in lines], fine, side="right")
    table = np.array([(0.0, 0.0), *((line.left, line.right) for line in lines)])
    wheels, speed = np.empty((len(fine), 2)), np.zeros(2)
    for i, wanted in enumerate(table[current] / 200):
        wheels[i] = speed
        speed = wanted + (speed - wanted) * np.exp(-step / LAG)
    # The middle of each step, so that a step is the speed's integral over it.
    wheels = np.vstack([[0.0, 0.0], (wheels[1:] + wheels[:-1]) / 2])
    theta = np.cumsum((wheels[:, 1] - wheels[:, 0]) / 0.13) * step
    v = wheels.mean(axis=1) * step
    poses = np.column_stack([np.cumsum(v * np.cos(theta)), np.cumsum(v * np.sin(theta)), theta])
    times = np.arange(rng.uniform(0, 1 / 30), fine[-1], 1 / 30)
    times = times[rng.random(len(times)) >= dropped]
    seen = np.column_stack([np.interp(times, fine, poses[:, i]) for i in range(3)])
    return times, seen + noise * rng.standard_normal(seen.shape)


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(st.floats(-0.06, 0.1), st.integers(0, 10**6), st.sampled_from([0.0, 0.1]))
def test_the_dead_time_is_found(dead, seed, dropped):
    lines = commands(30, seed)
    delay = motion_delay(*drive(lines, dead, seed, dropped=dropped), lines)
    assert delay.delay == pytest.approx(dead, abs=0.006)
    assert delay.lag == pytest.approx(LAG, abs=0.01)
    assert delay.answers >= 20


@pytest.mark.slow
def test_the_stated_deviation_covers_the_errors():
    misses = []
    for seed in range(25):
        lines = commands(15, seed)
        delay = motion_delay(*drive(lines, 0.02, seed), lines)
        misses.append(abs(delay.delay - 0.02) / delay.sd)
    assert np.mean(np.array(misses) < 2.0) >= 0.8


@settings(max_examples=8, deadline=None)
@given(st.floats(-1000, 1000), st.floats(-2e-4, 2e-4), st.integers(0, 10**6))
@pytest.mark.slow
def test_the_clock_is_found_without_a_flash(offset, drift, seed):
    lines = commands(120, seed)
    robot, poses = drive(lines, 0.0, seed, dropped=0.05)
    poses[200:230] = np.nan
    fit = fit_clock_to_motion((robot - offset) / (1 + drift), poses, lines)
    assert np.abs(fit.to_robot((robot - offset) / (1 + drift)) - robot).max() < 0.020
    assert fit.drift == pytest.approx(drift, abs=2e-4)
    assert 0 < fit.sd < 0.01
    assert fit.flashes == ()


@pytest.mark.slow
def test_the_clock_of_a_drive_in_closed_loop_is_found():
    """Ten commands a second, each little different from the one before."""
    errors, steps = [], np.arange(100)
    for seed in range(16):
        rng = np.random.default_rng(seed)
        offset = rng.uniform(-1000, 1000)
        turn = 12 * np.sin(0.09 * steps + rng.uniform(0, 6)) + 6 * np.sin(0.31 * steps)
        ahead = 30 - np.abs(turn)
        pairs = zip(3.0 + 0.1 * steps, ahead - turn, ahead + turn, strict=True)
        lines = [*(MotorLine(*one) for one in pairs), MotorLine(13.0, 0.0, 0.0)]
        robot, poses = drive(lines, 0.0, seed)
        fit = fit_clock_to_motion(robot - offset, poses, lines)
        errors.append(fit.offset - offset)
        assert abs(errors[-1]) < 0.02
        assert 0 < fit.sd < 0.03
    # One in a hundred is more than 0.02 s off, as the noise wants it.
    assert np.sqrt(np.mean(np.square(errors))) < 0.01


def test_long_commands_that_differ_little_are_no_two_places():
    ahead_turn = [(45, -35), (49, -17), (49, -8), (48, -43), (48, -39), (40, -22), (46, 10), (0, 0)]
    lines = [MotorLine(3.0 + 2.8 * k, v - w, v + w) for k, (v, w) in enumerate(ahead_turn)]
    times, poses = drive(lines, 0.0, 3)
    assert abs(fit_clock_to_motion(times, poses, lines).offset) < 0.01


def test_a_video_recorded_with_its_commands_shows_all_of_them():
    """A network that turns, drives on and turns again: half of it resembles the other half."""
    turn = np.repeat([15.0, 0.0, 15.0, 10.0], [4, 5, 4, 2])
    lines = [MotorLine(1.6 + k, -25.0 - w, -25.0 + w) for k, w in enumerate(turn)]
    lines.append(MotorLine(16.6, 0.0, 0.0))
    times, poses = drive(lines, 0.0, 3)
    with pytest.raises(UserError, match="the clock is ambiguous"):
        fit_clock_to_motion(times, poses, lines)
    assert abs(fit_clock_to_motion(times, poses, lines, whole=True).offset) < 0.01


@pytest.mark.parametrize(("off", "says"), [(0.1, "100 ms later"), (-3.0, "3000 ms earlier")])
def test_flashes_that_are_mistaken_are_noticed(off, says):
    lines = commands(30, 7)
    times, poses = drive(lines, 0.0, 7)
    camera = times + 12.0
    right = ClockFit(-12.0, 0.0, 0.0, (12.5,), 0.001)
    assert disagreement(right, camera, poses, lines) is None
    warnings = disagreement(ClockFit(-12.0 + off, 0.0, 0.0, (12.5,), 0.001), camera, poses, lines)
    assert "--sync motion" in warnings
    number, side = says.split(" ms ")
    assert side in warnings
    assert float(warnings.split(" ms ")[0].split()[-1]) == pytest.approx(float(number), abs=8)
    # A delay beyond the searched range may not be corrected.
    assert motion_delay(times + 0.2, poses, lines) is None


def test_motion_that_does_not_follow_the_commands():
    times, poses = drive(commands(30, 1), 0.0, 1)
    with pytest.raises(UserError, match="does not follow the commands"):
        fit_clock_to_motion(times, poses, commands(30, 2))
    with pytest.raises(UserError, match="too few"):
        fit_clock_to_motion(times, poses, commands(1, 1))
    with pytest.raises(UserError, match="too few"):
        fit_clock_to_motion(times, np.full_like(poses, np.nan), commands(30, 1))


def test_commands_that_repeat_themselves_are_ambiguous():
    lines = [
        MotorLine(3.0 + 2.0 * i, *((40.0, 20.0) if i % 2 == 0 else (-20.0, -40.0)))
        for i in range(30)
    ]
    times, poses = drive(lines, 0.0, 3)
    with pytest.raises(UserError, match=r"the motion fits the video at .* s and at .* s"):
        fit_clock_to_motion(times, poses, lines)


@pytest.mark.slow
def test_a_dataset_counts_from_when_the_motors_answered(tmp_path):
    """60 ms late or not at all: corrected, the displacements are the same."""
    lines = commands(40, 5)

    def rows(dead, **options):
        name = f"{dead}{options}"
        recording = Recording.create(tmp_path / name, {"robot": {"kind": "test"}})
        recording.begin_session(video=None)
        with recording.command_log() as log:
            for number, line in enumerate(lines[:-1], start=1):
                length = lines[number].time - line.time
                log.append(1, number, "command", line.time, line.left, line.right, length)
            log.append(1, None, "stop", lines[-1].time, 0.0, 0.0, None)
        times, poses = drive(lines, dead, 5, noise=(0.0, 0.0, 0.0))
        count = len(times)
        recording.write_poses(
            Poses(np.ones(count, int), np.arange(count), times, poses, np.ones(count))
        )
        result = displacements(recording, **options)
        return np.array([(r["dx"], r["dy"], r["dtheta"]) for r in result.rows]), result

    prompt, _ = rows(0.0)
    late, result = rows(0.06)
    as_sent, untouched = rows(0.06, correct_delay=False)
    assert result.corrected == {1}
    assert untouched.corrected == set()
    assert untouched.delays[1].delay == pytest.approx(0.06, abs=0.005)
    near = np.sqrt(np.mean((late - prompt)[:, 0] ** 2))
    far = np.sqrt(np.mean((as_sent - prompt)[:, 0] ** 2))
    assert near < 0.2 * far


def test_changes_that_all_lie_within_one_window_are_too_few_and_no_error():
    lines = [MotorLine(3.0 + 0.1 * k, 40.0 - 20.0 * (k % 2), 30.0) for k in range(4)]
    times, poses = drive([*lines, MotorLine(9.0, 0.0, 0.0)], 0.03, 1)
    assert answers_to(*signals_of(times, poses), changes_of(lines)) is not None
    assert motion_delay(times, poses, lines) is None
