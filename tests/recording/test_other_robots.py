"""A car, an omnidirectional base and a ROS base are recorded, kept on the board and tracked."""

import numpy as np
import pytest

from neurosim.lab import VirtualLinesRig, VirtualRosRig, VirtualThymioRig, read_truth
from neurosim.recording.commands import RandomCommands
from neurosim.recording.record import Guard, RecordSettings, record
from neurosim.recording.settings import Rig
from tracking.clock.motor_delay import motion_delay
from tracking.datasets.dataset import build

pytestmark = pytest.mark.slow

SIZE = (320, 240)
#: The guard has work, and a car room to turn.
BOARD = {"length": 2.2, "width": 1.5}
BOARDS = {"car": BOARD, "omni": BOARD, "ros": {"length": 1.5, "width": 1.1}}
COUNT = 40


@pytest.fixture(scope="module", params=["car", "omni", "ros"])
def made(request, tmp_path_factory):
    """Return the robot's kind, its commands, its recording, the truth, and the messages."""
    folder, messages = tmp_path_factory.mktemp(request.param), []
    options = {"noise_seed": 5, "camera_size": SIZE}
    with (
        VirtualRosRig(2, **options)
        if request.param == "ros"
        else VirtualLinesRig(2, kind=request.param, **options)
    ) as rig:
        optics = rig.camera.optics
        optics.calibration.write(folder / "calibration.json")
        rig.robot.connect()
        recording = record(
            folder / "recording",
            Rig.of_lab(rig),
            RandomCommands(seed=3, max_speed=80.0),
            RecordSettings(COUNT, board=BOARDS[request.param]),
            calibration=folder / "calibration.json",
            say=messages.append,
        )
        return request.param, rig.robot.commands, recording, read_truth(recording.path), messages


def test_commands_are_within_the_limits_and_named_as_the_robot_names_them(made):
    kind, takes, recording, _, message = made
    assert message == []
    assert recording.takes == takes.measured(full=0.5, track=0.13)
    table = recording.commands()
    sent = table[table["kind"] == "command"]
    assert set(sent["command"]) == set(range(COUNT))
    for one in takes.numbers:
        values = sent[one.name]
        assert values.between(one.low, one.high).all()
        # All of an angle's range, and 80 % of a speed's.
        reach = max(one.high, -one.low) * (0.8 if one.speed else 1.0)
        assert 0.6 * reach < values.abs().max() <= reach + 1e-9
    stops = (sent[[one.name for one in takes.numbers if one.speed]] == 0).all(axis=1)
    assert 2 <= stops.sum() <= 20
    assert recording.meta["units"][takes.names[-1]] == takes.numbers[-1].unit
    lamps = set(recording.commands()["kind"]) & {"lamp-on", "lamp-off"}
    assert bool(lamps) == (kind == "omni")


def test_its_position_keeps_it_on_the_board(made):
    kind, _, recording, truth, _ = made
    kinds = [line.kind for line in recording.commands().itertuples()]
    assert kinds.count("cut") >= 2
    assert kinds.count("manoeuvre") >= 4
    half = np.array([BOARDS[kind]["length"], BOARDS[kind]["width"]]) / 2
    assert (np.abs(truth.poses[:, :2]) < half - Guard().margin + 0.06).all()


def test_the_clocks_are_joined_by_the_lamp_or_by_the_motion(made):
    _, _, recording, truth, _ = made
    poses = recording.poses()
    seen = poses.quality > 0
    assert seen.mean() > 0.98
    off = poses.pose[seen] - truth.pose_at(poses.time[seen])
    assert np.sqrt((off[:, :2] ** 2).mean()) < 5e-3
    lines = [line for line in recording.commands().itertuples() if line.is_motor]
    delay = motion_delay(poses.time, poses.pose, lines)
    assert abs(delay.delay) < 0.02


def test_the_dataset_says_how_it_moves(made, tmp_path):
    _, takes, recording, _, _ = made
    dataset = build([recording.path], tmp_path / "dataset")
    names = takes.names
    assert dataset.inputs == (*(f"prev_{name}" for name in names), *names, "duration")
    assert {one["name"]: one["unit"] for one in dataset.meta["inputs"]}[names[0]] == "m/s"
    assert len(dataset) >= 0.8 * COUNT
    # A robot that followed its commands at once would move much like this.
    twist = takes.twist(dataset.table[[*names]].to_numpy())
    ideal = twist * dataset.table[["duration"]].to_numpy()
    turned = dataset.table["dtheta"].to_numpy()
    assert np.corrcoef(ideal[:, 2], turned)[0, 1] > 0.95
    previous = dataset.table[[f"prev_{name}" for name in names]].to_numpy()
    assert np.abs(previous).max() > 0


def test_a_slow_robot_returns_from_a_corner_of_a_large_board(tmp_path):
    with VirtualThymioRig(1, camera_size=SIZE, start=(1.1, 0.8, 0.6), fps=15) as rig:
        optics = rig.camera.optics
        optics.calibration.write(tmp_path / "calibration.json")
        rig.robot.connect()
        recording = record(
            tmp_path / "recording",
            Rig.of_lab(rig),
            RandomCommands(seed=3),
            RecordSettings(5, guard=Guard(by="position", speed=30.0)),
            calibration=tmp_path / "calibration.json",
        )
    kinds = list(recording.commands()["kind"])
    assert kinds.count("cut") >= 1
    assert kinds.count("manoeuvre") > 50  # a few seconds at a time, a few centimetres each
    last = read_truth(recording.path).poses[-1, :2]
    assert np.hypot(*last) < np.hypot(1.1, 0.8) - 0.6
