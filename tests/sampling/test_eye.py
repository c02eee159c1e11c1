"""A camera measures how a virtual Khepera moves: compared with the lab's hidden truth."""

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import example, given, settings
from hypothesis import strategies as st

from neurosim.base import se2
from neurosim.base.errors import UserError
from neurosim.base.place import Place
from neurosim.cli.main import cli
from neurosim.lab import CameraParams, KheperaParams, VirtualKheperaRig
from neurosim.lab.camera.optics import Optics
from neurosim.lab.camera.photographs import render_photographs
from neurosim.lab.khepera.camera import SCALE
from neurosim.lab.khepera.params import SPEED_UNIT, WHEEL_BASE
from neurosim.sampling import Eye, SampleSettings
from neurosim.sampling.eye import steady_twist
from neurosim.sampling.motors import Counters, sample_motors
from neurosim.simulators.tables.motor_table import MotorTable
from tracking.camera.camera_model import CameraModel
from tracking.datasets.recordings import KHEPERA_MARKERS

CAMERA = CameraParams()


def calibration(**changes):
    optics = Optics(CAMERA)
    parts = {
        "image_size": CAMERA.size,
        "camera_matrix": optics.matrix,
        "distortion": optics.distortion,
        "rotation": optics.rotation,
        "translation": SCALE * optics.translation,
    }
    return CameraModel(**{**parts, **changes})


@example((0.0, 0.0, 6.0), (0.0, 0.0, 0.0), 2**15 - 1)  # a gap of 0.53 s
@settings(deadline=None, max_examples=60)
@given(
    twist=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.02, 0.02), st.floats(-6, 6)),
    start=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-9, 9)),
    dropped=st.integers(0, 2**20),
)
def test_a_steady_twist_is_found_from_its_poses(twist, start, dropped):
    times = np.arange(25) / 30.0 + 12.5
    times = times[[k < 5 or not dropped >> (k - 5) & 1 for k in range(25)]]
    poses = np.array([se2.compose(start, se2.exp(np.multiply(twist, t))) for t in times])
    poses[:, 2] = np.angle(np.exp(1j * poses[:, 2]))
    np.testing.assert_allclose(steady_twist(times, poses), twist, atol=1e-8)


def rig(params, start=(0.0, 0.0, 0.0)):
    return VirtualKheperaRig(1, params=params, start=start, place=ARENA, camera=CAMERA, baud=38400)


#: A wall far away.
ARENA = Place(walls=((3.0, -1.0, 3.0, 1.0),))


@pytest.mark.slow
def test_it_sees_what_counters_do_not(tmp_path):
    wheels = np.array([1.03, 0.98])
    params = KheperaParams.ideal(wheel=wheels)
    plan = SampleSettings(grid=3, held_out=0, duration=0.5)
    tables = {}
    for direction in ("counters", "camera"):
        folder = tmp_path / direction
        folder.mkdir()
        with rig(params) as virtual, virtual.robot as robot:
            levels = plan.levels(robot.full_speed)
            if direction == "counters":
                measure = Counters(robot, WHEEL_BASE).measure
                sample_motors(folder, robot, plan, levels, measure, lambda: None, 0)
            else:
                with Eye(virtual.camera, calibration(), KHEPERA_MARKERS, robot.clock) as eye:
                    sample_motors(folder, robot, plan, levels, eye.measure, lambda: None, 0)
        tables[direction] = MotorTable.read_csv(folder / "motors.csv").twist
    speeds = 10 * SPEED_UNIT * np.array([-1.0, 0.0, 1.0])
    left, right = np.meshgrid(wheels[0] * speeds, wheels[1] * speeds, indexing="ij")
    truth = np.stack([(left + right) / 2, 0 * left, (right - left) / WHEEL_BASE], axis=-1)
    missed = np.abs(tables["camera"] - truth).max(axis=(0, 1))
    assert missed[0] < 3e-4
    assert missed[1] < 3e-4
    assert missed[2] < math.radians(0.5)
    # Both forward at full speed: the robot turns, and its counters say that it does not.
    assert abs(tables["counters"][2, 2, 2]) < math.radians(0.5)
    assert tables["camera"][2, 2, 2] == pytest.approx(-0.05 * 0.1 / WHEEL_BASE, abs=0.01)


def test_a_robot_out_of_view_is_reported(tmp_path):
    with (
        rig(KheperaParams.ideal()) as virtual,
        virtual.robot as robot,
        Eye(virtual.camera, calibration(), KHEPERA_MARKERS, robot.clock) as eye,
    ):
        robot.set_speeds(2, 2)
        eye.measure(0.3)
        virtual.lab.place(1.0, 0.5, 0.0)
        with pytest.raises(UserError, match=r"does not see the robot.*--resume"):
            eye.measure(0.3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rotation": None, "translation": None}, "--points"),
        ({"image_size": (1280, 720)}, "1280x720, but the camera gives 640x480"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused(changes, message):
    with rig(KheperaParams.ideal()) as virtual, pytest.raises(UserError, match=message):
        Eye(virtual.camera, calibration(**changes), KHEPERA_MARKERS, virtual.lab.clock)


def test_photographs_over_a_khepera_are_of_a_smaller_board(tmp_path):
    marks = {}
    for scale in (1.0, SCALE):
        folder = tmp_path / f"{scale:g}"
        render_photographs(folder, CAMERA, 0, 1, scale=scale)
        marks[scale] = np.loadtxt(folder / "points.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(marks[SCALE], marks[1.0] * [1, 1, SCALE, SCALE], atol=1e-6)


def output_of(*words):
    done = CliRunner().invoke(cli, ["sample", *map(str, words)])
    return done.exit_code, str(done.exception or done.output)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--camera", "lab"], "--camera needs --calibration"),
        (["--calibration", "calibration.json"], "--calibration needs --camera"),
        (["--markers", "red,green"], "--markers needs --camera"),
        (["--camera", "0", "--calibration", "calibration.json"], "does not see the virtual robot"),
        (["--camera", "lab", "--calibration", "none.json"], "none.json"),
        (
            ["--camera", "lab", "--calibration", "calibration.json", "--markers", "red,green"],
            "pink and blue",
        ),
        (
            [
                "--camera",
                "lab",
                "--calibration",
                "calibration.json",
                "--robot",
                "khepera",
                "--port",
                "COM3",
            ],
            "--camera lab is for virtual robots",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    calibration().write("calibration.json")
    code, text = output_of("out", *words)
    assert code != 0
    assert message in text
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_sampling_with_a_camera_through_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    calibration().write("calibration.json")
    small = "out --angles 12 --distances 2 --grid 2 --json"
    done = CliRunner().invoke(
        cli, ["sample", *small.split(), "--camera", "lab", "--calibration", "calibration.json"]
    )
    assert done.exit_code == 0, done.output
    about = json.loads((tmp_path / "out" / "sampling.json").read_text())
    assert about["motors"] == "camera"
    table = MotorTable.read_csv(tmp_path / "out" / "motors.csv")
    assert (np.abs(table.twist[..., 1]) > 0).all()  # counters say 0
    code, text = output_of("out", "--resume", "--markers", "pink,blue", "--camera", "0")
    assert code != 0
    assert "does not see the virtual robot" in text
