"""The lab as a whole: its time, the brick's hardware in it, and the true poses that it keeps."""

import math
import threading
from dataclasses import replace

import numpy as np
import pytest

from neurosim.base.errors import FileError, UserError
from neurosim.lab.nxt.body import NxtBody, Wiring
from neurosim.lab.nxt.params import CameraParams, LabParams
from neurosim.lab.nxt.world import Lab, Pacer, Push, read_truth

ON, BRAKE, REGULATED = 1, 2, 4
RUNNING = 0x20
LIGHT_ACTIVE, LIGHT_INACTIVE, COLOR_RED, COLOR_NONE = 5, 6, 14, 17
IDEAL = LabParams.ideal()
SMALL = CameraParams(size=(160, 120))


def run_motor(body, port, power, mode=ON | BRAKE | REGULATED, limit=0):
    body.set_output(port, power, mode, 1 if mode & REGULATED else 0, 0, RUNNING, limit)


def film(seed):
    """Return the frames, their times and the truth of half a second of driving."""
    lab = Lab(seed, camera=SMALL)
    frames = []
    lab.camera.start(lambda time, frame: frames.append((time, frame)))
    run_motor(lab.body, 1, 40)
    run_motor(lab.body, 2, 25)
    lab.clock.sleep_until(0.21)
    lab.body.set_output(0, 100, ON, 0, 0, RUNNING, 0)
    lab.clock.sleep_until(0.5)
    return np.array([t for t, _ in frames]), np.stack([f for _, f in frames]), lab.truth


def test_same_seed_same_frames_and_truth():
    first, again, other = film(3), film(3), film(4)
    assert np.array_equal(first[0], again[0])
    assert np.array_equal(first[1], again[1])
    assert np.array_equal(first[2].poses, again[2].poses)
    assert np.array_equal(first[2].voltage, again[2].voltage)
    assert not np.array_equal(first[1], other[1])
    assert not np.array_equal(first[2].poses, other[2].poses)


def test_time_moves_only_forward_and_only_when_asked():
    lab = Lab(0, camera=None)
    lab.clock.sleep_until(1.25)
    assert lab.clock.now() == 1.25
    lab.clock.sleep_until(1.0)
    assert lab.clock.now() == 1.25


def test_truth_is_kept_at_its_rate():
    lab = Lab(0, params=IDEAL, camera=None, truth_rate=50)
    run_motor(lab.body, 1, 40)
    run_motor(lab.body, 2, 40)
    lab.advance_to(1.0)
    truth = lab.truth
    assert truth.times == pytest.approx(np.arange(51) / 50)
    lag = IDEAL.lag_left
    t = truth.times
    assert truth.poses[:, 0] == pytest.approx(0.2 * (t - lag * (1 - np.exp(-t / lag))), abs=1e-9)
    assert truth.pose_at(np.array([0.99])) == pytest.approx(truth.poses[[49, 50]].mean(0)[None])


def test_truth_is_written_piece_by_piece(tmp_path):
    lab = Lab(2, camera=None)
    run_motor(lab.body, 1, 30)
    lab.advance_to(0.5)
    path = lab.write_truth(tmp_path)
    assert path == tmp_path / "truth" / "truth-001.csv"
    lab.advance_to(1.0)
    lab.write_truth(tmp_path)
    read = read_truth(tmp_path)
    assert read.times == pytest.approx(lab.truth.times, abs=1e-6)
    assert read.poses == pytest.approx(lab.truth.poses, abs=1e-6)
    assert Lab(2, camera=None).write_truth(tmp_path, session=2).name == "truth-002.csv"
    with pytest.raises(FileError, match=r"truth-003\.csv: no such file"):
        read_truth(tmp_path, session=3)


def test_the_robot_can_be_put_down_in_the_room_only():
    lab = Lab(0, camera=None, start=(0.3, -0.2, 7.0))
    assert lab.body.pose == pytest.approx([0.3, -0.2, 7.0])
    with pytest.raises(UserError, match="outside"):
        lab.place(9.0, 0.0, 0.0)


def test_a_camera_does_not_change_the_drive():
    poses = []
    for camera in (None, SMALL):
        lab = Lab(5, camera=camera)
        if lab.camera:
            lab.camera.start(lambda time, frame: None)
        for left, right, until in ((40, 30, 1.0), (-20, -50, 2.0), (0, 0, 2.5)):
            run_motor(lab.body, 1, left)
            run_motor(lab.body, 2, right)
            lab.advance_to(until)
        poses.append(lab.body.pose)
    assert poses[0] == pytest.approx(poses[1], abs=1e-4)


def test_a_push_moves_a_robot_that_drives_aside():
    push = Push(0.1, after=0.5, direction=math.pi / 2)
    labs = [Lab(5, params=IDEAL, camera=None, push=one) for one in (None, push)]
    for lab in labs:
        lab.advance_to(2.0)  # no motor runs yet
        assert lab.body.pose == pytest.approx([0.0, 0.0, 0.0])
        run_motor(lab.body, 1, 40)
        run_motor(lab.body, 2, 40)
        lab.advance_to(4.0)
    left, pushed = (lab.truth for lab in labs)
    aside = pushed.poses - left.poses
    assert aside[-1] == pytest.approx([0.0, 0.1, 0.0], abs=1e-9)
    times = np.array([2.5, 2.65, 2.8])
    assert np.interp(times, left.times, aside[:, 1]) == pytest.approx([0.0, 0.05, 0.1], abs=1e-3)
    with pytest.raises(ValueError, match="a push needs"):
        Push(math.nan, 0.5, 0.0)


def test_tacho_counts_the_wheels_degrees():
    lab = Lab(0, params=IDEAL, camera=None)
    run_motor(lab.body, 1, 40)
    run_motor(lab.body, 2, 40)
    lab.advance_to(2.0)
    degrees = math.degrees(lab.body.pose[0] / (IDEAL.diameter_left / 2))
    assert lab.body.output(1).tacho_count == pytest.approx(degrees, abs=1.01)
    lab.body.reset_tacho(1, relative=False)
    before = lab.body.output(1).tacho_count
    lab.advance_to(2.5)
    output = lab.body.output(1)
    assert output.rotation_count == output.tacho_count - before
    assert output.block_tacho_count == output.tacho_count
    assert lab.body.output(0).tacho_count == 0


@pytest.mark.parametrize("power", [60, -60])
def test_a_motor_stops_at_its_limit(power):
    lab = Lab(0, params=IDEAL, camera=None)
    run_motor(lab.body, 1, power, limit=360)
    lab.advance_to(4.0)
    output = lab.body.output(1)
    assert output.run_state == 0
    # It turns 360 degrees and then coasts: the speed times the lag.
    beyond = math.degrees(0.6 * IDEAL.full_speed * IDEAL.coast_lag)
    assert abs(output.tacho_count) == pytest.approx(360 + beyond, abs=3)
    assert lab.body.output(2).tacho_count == 0


def test_a_limit_counts_from_the_last_ones_end_unless_the_motor_ran_without_one():
    """Counted as by dOutputSetTachoLimit and dOutputTachoLimitControl of LEGO's d_output.c."""
    lab = Lab(0, params=IDEAL, camera=None)
    run_motor(lab.body, 1, 60, limit=3600)
    lab.advance_to(0.5)
    run_motor(lab.body, 1, -60, limit=3600)  # back to 0, not to -3600 from here
    lab.advance_to(10.0)
    coasted = math.degrees(0.6 * IDEAL.full_speed * IDEAL.coast_lag)
    assert lab.body.output(1).tacho_count == pytest.approx(-coasted, abs=5)
    run_motor(lab.body, 1, 1, mode=ON)
    lab.advance_to(10.1)
    begun = lab.body.output(1).tacho_count
    run_motor(lab.body, 1, 60, limit=720)
    lab.advance_to(20.0)
    assert lab.body.output(1).tacho_count - begun == pytest.approx(720 + coasted, abs=3)


def test_a_motor_coasts_further_than_it_brakes():
    turned = {}
    for name, mode in (("coast", 0), ("brake", ON | BRAKE)):
        lab = Lab(0, params=IDEAL, camera=None)
        run_motor(lab.body, 2, 50)
        lab.advance_to(2.0)
        before = lab.body.output(2).tacho_count
        run_motor(lab.body, 2, 0, mode)
        lab.advance_to(5.0)
        turned[name] = lab.body.output(2).tacho_count - before
    speed = math.degrees(0.5 * IDEAL.full_speed)
    assert turned["coast"] == pytest.approx(speed * IDEAL.coast_lag, abs=2)
    assert turned["brake"] == pytest.approx(speed * IDEAL.brake_lag, abs=2)


def test_without_regulation_speed_follows_the_battery():
    turned = []
    for volts in (8.0, 7.0):
        lab = Lab(0, params=replace(IDEAL, battery=volts), camera=None)
        run_motor(lab.body, 1, 50, ON)
        lab.advance_to(3.0)
        turned.append(lab.body.output(1).tacho_count)
    assert turned[0] / turned[1] == pytest.approx(8.0 / 7.0, rel=0.01)


@pytest.mark.parametrize(
    ("y", "light"),
    [(0.0, 0.55), (0.80 - 0.09, 0.25), (0.80 - 0.09 - 0.01, 0.40), (0.95 - 0.09, 0.35)],
    ids=["board", "line", "edge of line", "floor"],
)
def test_light_sensor_sees_the_ground_under_it(y, light):
    body = NxtBody(IDEAL, 0, (0.2, y, 0.0))
    body.set_input(0, LIGHT_ACTIVE, 0)
    reading = body.input(0)
    assert reading.valid
    assert (1023 - reading.raw) / 1023 == pytest.approx(light, abs=0.002)
    assert body.reflected_light(1) == pytest.approx(0.55)  # the right one is still on the board


def test_light_sensor_without_its_lamp_sees_no_line():
    body = NxtBody(IDEAL, 0, (0.2, 0.71, 0.0))
    body.set_input(0, LIGHT_INACTIVE, 0)
    assert 1 - body.input(0).raw / 1023 == pytest.approx(IDEAL.light_ambient, abs=0.002)
    assert body.input(3).raw == 1023


def test_sensor_noise_is_far_smaller_than_the_line():
    body = NxtBody(LabParams(), 0)
    body.set_input(1, LIGHT_ACTIVE, 0)
    raw = np.array([body.input(1).raw for _ in range(400)])
    assert 3 < raw.std() < 15


def test_lamp_light_adds_up():
    body = NxtBody(replace(IDEAL, lamp_lag=0.01), 0, wiring=Wiring(colour=3))
    body.set_output(0, 100, ON, 0, 0, RUNNING, 0)
    body.advance(1.0)
    assert body.lamp_light() == pytest.approx(1.0 - 0.01, abs=1e-9)
    body.set_output(0, 0, 0, 0, 0, 0, 0)
    body.advance(2.0)
    assert body.lamp_light() == pytest.approx(1.0)
    body.set_input(3, COLOR_RED, 0)
    body.advance(3.0)
    body.set_input(3, COLOR_NONE, 0)
    body.advance(4.0)
    assert body.lamp_light() == pytest.approx(2.0)


def test_battery_reads_in_millivolts_and_sags():
    lab = Lab(0, camera=None)
    rest = np.mean([lab.body.battery_millivolts() for _ in range(50)])
    assert rest == pytest.approx(1000 * lab.params.battery, abs=10)
    run_motor(lab.body, 1, 100)
    run_motor(lab.body, 2, 100)
    lab.advance_to(0.5)
    assert lab.body.battery_millivolts() < rest - 400


def test_paced_lab_moves_by_itself():
    lab = Lab(0, camera=None)
    run_motor(lab.body, 1, 50)
    with Pacer(lab):
        lab.clock.sleep_until(0.05)
        with lab.lock:  # as a brick does while a telegram travels
            lab.advance_to(lab.time + 0.02)
        assert lab.clock.now() >= 0.07
    stopped = lab.clock.now()
    lab.clock.sleep_until(stopped + 1.0)
    assert lab.clock.now() == stopped + 1.0


def test_pacer_says_what_stopped_it():
    lab = Lab(0, camera=SMALL)
    failed = threading.Event()

    def refuse(time, frame):
        failed.set()
        raise OSError("disk full")

    lab.camera.start(refuse)
    with pytest.raises(OSError, match="disk full"), Pacer(lab):
        assert failed.wait(10)
        lab.clock.sleep_until(0.0)
