"""Whether the pair of markers after a loss must be the one from before."""

import json

import cv2
import numpy as np
import pytest
import tracking_scene as scene
from click.testing import CliRunner
from synthetic_robot import MotorLine

from neurosim.base.files import flag, number, read_csv
from neurosim.cli.track import track as command
from tracking.camera.video import Video
from tracking.clock.motion import follows_commands
from tracking.identity import doubtful
from tracking.markers.colours import parse_colour
from tracking.markers.tracker import Tracker
from tracking.track import _unclear

FPS = 30.0


def track_of(places, separation=20.0):
    """Frames of a pair whose middle is at these places, px; None where it was not found."""
    middle = np.array([(np.nan, np.nan) if place is None else place for place in places], float)
    ahead = np.array([separation / 2, 0.0])
    return np.arange(len(places)) / FPS, middle + ahead, middle - ahead


def driving(frames, start=(100.0, 100.0), speed=0.0):
    return [(start[0] + speed * i / FPS, start[1]) for i in range(frames)]


@pytest.mark.parametrize(
    ("lost_for", "moved", "speed", "certain"),
    [
        (30, 0, 0, True),  # hidden where it stood
        (300, 0, 0, True),
        (300, 15, 0, True),  # less than a separation
        (6, 30, 0, True),  # 0.2 s: 1 + 2 x 3 x 0.2 = 2.2 separations of 20 px
        (6, 50, 0, False),
        (6, 50, 100, True),  # it was seen to drive 5 separations a second
        (30, 130, 0, True),  # 7 separations in a second
        (30, 150, 0, False),
        (75, 100, 0, False),  # 2.5 s: any position is possible
    ],
)
def test_how_far_a_robot_can_have_come(lost_for, moved, speed, certain):
    before = driving(40, speed=speed)
    u, v = before[-1]
    places = before + [None] * lost_for + driving(20, (u + moved, v))
    doubtful_rows = doubtful(*track_of(places))
    assert not doubtful_rows[: 40 + lost_for].any()
    assert (doubtful_rows[40 + lost_for :] == (not certain)).all()


def test_what_is_found_elsewhere_stays_doubtful_until_it_is_back():
    home, away = driving(30), driving(30, (300.0, 300.0))
    places = home + [None] * 90 + away + [None] * 3 + away + home + [None] * 90 + home
    doubtful_rows = doubtful(*track_of(places))
    assert doubtful_rows.tolist() == [False] * 120 + [True] * 63 + [False] * 150


def test_nothing_and_one_sight_are_not_doubtful():
    assert not doubtful(*track_of([None] * 5)).any()
    assert not doubtful(*track_of([None, (3.0, 4.0), None])).any()


@pytest.mark.slow
@pytest.mark.parametrize(("twin_from", "back_at"), [(40, 116), (60, 60), (100, 116), (118, 300)])
def test_an_identical_plate_alone_after_a_loss(shared_data, twin_from, back_at):
    with Video(shared_data / "footage" / "marker-pushed.avi") as video:
        forth = [frame for _, _, frame in video]
    tracker, rows = Tracker(parse_colour("blue"), parse_colour("pink")), []
    for i, frame in enumerate((forth + forth[::-1])[:150]):
        frame = frame.copy()
        if i >= twin_from:
            frame[180:233, 350:395] = forth[0][342:395, 200:245]
        if 26 <= i < back_at:
            frame[342:395, 200:245] = frame[250:303, 300:345]
        seen = tracker.update(frame, i / FPS)
        rows.append((i / FPS, *seen.front, *seen.rear))
    time, front, rear = (np.array(rows)[:, part] for part in (0, slice(1, 3), slice(3, 5)))
    middle, result = (front + rear) / 2, np.isfinite(front[:, 0])
    false = np.hypot(*(middle - middle[0]).T) > 5
    marked = doubtful(time, front, rear)
    assert not (false & ~marked).any()
    assert not (result & ~false & marked).any()
    # The pair at the position where the robot was lost is the robot, as soon as it is seen.
    assert (result & ~false)[back_at + 4 :].all()


@pytest.mark.slow
def test_a_twin_is_said_and_marked_by_the_command(tmp_path):
    rng, background = np.random.default_rng(0), scene.background((320, 240))
    path = tmp_path / "twin.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (320, 240))
    for i in range(130):
        image = background.copy()
        if i < 40:
            scene.robot(image, np.array([60.0 + i, 60.0]), 0.02 * i, body=(48, 18))
        elif i >= 105:
            scene.robot(image, np.array([240.0, 180.0]), 1.0, body=(48, 18))
        writer.write(scene.finish(image, rng))
    writer.release()
    done = CliRunner().invoke(command, [str(path), "-o", str(tmp_path / "poses")])
    assert done.exit_code == 0, done.exception
    table = read_csv(tmp_path / "poses" / "poses.csv", {"doubtful": flag, "quality": number})
    result = np.array(table["quality"]) > 0
    assert result[110:].all()
    assert table["doubtful"].tolist() == (result & (np.arange(130) >= 105)).tolist()
    count = sum(table["doubtful"])
    assert f"{count} poses may be of another pair" in done.stderr
    assert json.loads((tmp_path / "poses" / "tracking.json").read_text())["doubtful"] == count


def commanded():
    rng = np.random.default_rng(1)
    lines = [MotorLine(2.0 * i, *rng.uniform(-50, 50, 2)) for i in range(12)]
    return [*lines, MotorLine(24.0, 0.0, 0.0)]


def driven(lines, times):
    """A robot that follows its commands at once: 0.5 m/s at full speed, wheels 0.13 m apart."""
    now = np.searchsorted([line.time for line in lines], times, side="right") - 1
    speeds = 0.005 * np.array([(line.left, line.right) for line in lines])[np.maximum(now, 0)]
    step = np.diff(times, prepend=times[0])
    theta = np.cumsum(step * (speeds[:, 1] - speeds[:, 0]) / 0.13)
    along = step * speeds.mean(axis=1)
    x, y = np.cumsum(along * np.cos(theta)), np.cumsum(along * np.sin(theta))
    return np.column_stack([x, y, theta])


def test_what_moves_as_the_robot_was_told_is_the_robot():
    lines, times = commanded(), np.arange(0, 26, 1 / FPS)
    poses = driven(lines, times)
    poses[100:103] = np.nan
    assert follows_commands(times, poses, lines)
    assert follows_commands(times[60:500], poses[60:500], lines)
    assert not follows_commands(times[60:200], poses[60:200], lines)  # too few commands
    assert not follows_commands(times, np.zeros_like(poses), lines)  # one that stands still
    assert not follows_commands(times, np.full_like(poses, np.nan), lines)
    assert not follows_commands(times, poses, [])
    commanded_otherwise = [
        line._replace(left=other.left, right=other.right)
        for line, other in zip(lines, [*lines[5:], *lines[:5]], strict=True)
    ]
    assert not follows_commands(times, driven(commanded_otherwise, times), lines)
    steady = np.column_stack([0.1 * times, 0 * times, 0 * times])
    assert not follows_commands(times, steady, lines)


def test_a_stretch_of_a_recording_that_follows_its_commands_is_not_doubtful():
    lines, times = commanded(), np.arange(0, 26, 1 / FPS)
    poses = driven(lines, times)
    marked = np.zeros(len(times), bool)
    marked[60:500] = True  # ten commands
    marked[600:660] = True  # one
    left = _unclear(marked, times, poses, lines)
    assert np.flatnonzero(left).tolist() == list(range(600, 660))
    poses[60:500] = poses[60]
    assert (_unclear(marked, times, poses, lines) == marked).all()
