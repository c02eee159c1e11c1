"""Places in the lab: walls stop robots, boards have other sizes, and the camera sees both."""

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner
from patience import PATIENCE, wait_until

from neurosim.base.errors import UserError
from neurosim.base.perimeter import Board
from neurosim.base.place import THICKNESS, Line, Place
from neurosim.cli.main import cli
from neurosim.lab import CameraParams, LabParams, VirtualLinesRig, VirtualThymioRig
from neurosim.lab.camera import scene
from neurosim.lab.nxt.body import ground_light
from neurosim.lab.nxt.world import SIZE, Lab
from neurosim.robots.thymio.driver import Thymio
from tracking.datasets.recordings import Recording

IDEAL = LabParams.ideal()
#: Its surface is at x = 0.5 m.
WALL = (0.5 + THICKNESS / 2, -1.0, 0.5 + THICKNESS / 2, 1.0)
SMALL = Place(board=Board(1.6, 1.2, line_inset=0.1, line_width=0.04))


def drive(place, left, right, seconds, start=(0.0, 0.0, 0.0)):
    lab = Lab(0, params=IDEAL, camera=None, around=place, start=start)
    for port, power in ((1, left), (2, right)):
        lab.body.set_output(port, power, 7, 1, 0, 0x20, 0)
    lab.advance_to(seconds)
    return lab


def test_a_wall_holds_a_robot_whose_wheels_turn_on():
    free, held = (drive(Place(walls=walls), 40, 40, 4.0) for walls in ((), (WALL,)))
    assert free.body.pose[0] == pytest.approx(0.2 * (4.0 - IDEAL.lag_left), abs=1e-3)
    assert held.body.pose == pytest.approx([0.5 - SIZE, 0.0, 0.0], abs=2e-3)
    counts = [lab.body.output(1).rotation_count for lab in (free, held)]
    assert counts[0] == counts[1] > 1000


def test_a_robot_slides_along_a_wall_and_round_an_obstacle():
    lab = drive(Place(walls=(WALL,)), 40, 40, 4.0, start=(0.0, -0.5, math.radians(45)))
    # Along the wall it gets as far as without the wall.
    distance = 0.2 * (4.0 - IDEAL.lag_left) * math.sin(math.radians(45))
    assert lab.body.pose[:2] == pytest.approx([0.5 - SIZE, -0.5 + distance], abs=3e-3)
    post = Place(obstacles=((0.5, 0.03, 0.05),))
    lab = drive(post, 40, 40, 6.0)
    away = np.hypot(*(lab.truth.poses[:, :2] - (0.5, 0.03)).T)
    assert away.min() == pytest.approx(SIZE + 0.05, abs=1e-3)
    assert lab.body.pose[0] > 0.7  # it went past on the right
    assert lab.truth.poses[:, 1].min() < -0.1


def test_nobody_is_put_into_a_wall():
    with pytest.raises(UserError, match="stand in a wall or an obstacle"):
        Lab(0, camera=None, around=Place(walls=(WALL,)), start=(0.45, 0.0, 0.0))
    with pytest.raises(UserError, match="outside of the lab's room"):
        Lab(0, camera=None, around=SMALL, start=(2.0, 0.0, 0.0))


def test_light_of_another_board_and_its_lines_by_hand():
    place = Place(board=SMALL.board, lines=(Line(((0.0, -0.3), (0.0, 0.3)), 0.04, closed=False),))
    assert ground_light(0.3, 0.0, 0.008, place) == pytest.approx(0.55)
    assert ground_light(0.7, 0.0, 0.008, place) == pytest.approx(0.25)  # the perimeter line
    assert ground_light(0.81, 0.0, 0.008, place) == pytest.approx(0.35)  # the floor
    assert ground_light(0.0, 0.1, 0.008, place) == pytest.approx(0.2)  # an open line
    assert ground_light(0.0, 0.4, 0.008, place) == pytest.approx(0.55)  # beyond its end
    bare = Place(board=Board(1.6, 1.2, line_inset=0.1, line_width=0.0))
    assert ground_light(0.7, 0.0, 0.008, bare) == pytest.approx(0.55)


def test_the_camera_sees_the_place():
    place = Place(
        walls=((0.3, -0.3, 0.3, 0.3),),
        obstacles=((-0.4, 0.2, 0.08),),
        lines=(Line(((-0.2, -0.2), (0.1, -0.2)), 0.04, closed=False),),
        board=SMALL.board,
    )
    camera = Lab(0, camera=CameraParams(size=(640, 480)), around=place).camera
    picture = camera.render(None, noise=False).mean(axis=2)

    def grey(x, y):
        u, v = camera.project(np.array([[x, y, 0.0]]))[0].round().astype(int)
        return picture[v, u]

    bare = grey(0.1, 0.2)
    assert bare > 150
    assert grey(-0.05, -0.2) < 0.5 * bare
    assert grey(0.7, 0.3) < 0.5 * bare
    assert grey(0.85, 0.0) < 0.7 * bare
    for wall in (grey(0.3, 0.1), grey(-0.4, 0.2), grey(-0.36, 0.24)):
        assert 0.6 * bare < wall < 0.85 * bare
    # The board fills the picture, whatever its size.
    corners = camera.project(np.array([[-0.8, 0.6, 0.0], [0.8, -0.6, 0.0]]))
    assert corners.min() > 0
    assert (corners[1] - corners[0] > 0.75 * np.array([640, 480])).all()
    marks = scene.marks_of(place.board)
    assert np.abs(marks).max(axis=0) == pytest.approx([0.75, 0.55])
    assert all(grey(*mark) < 0.7 * bare for mark in marks)


def test_other_robots_stand_in_it_too():
    with VirtualLinesRig(1, kind="omni", camera=False, around=Place(walls=(WALL,))) as rig:
        assert rig.describe()["place"]["walls"] == [list(WALL)]
        with rig.robot as robot:
            robot.drive((0.3, 0.0, 0.0))
            robot.clock.sleep_until(robot.clock.now() + 4.0)
            robot.stop()
        assert rig.lab.body.pose[0] == pytest.approx(0.5 - SIZE, abs=0.005)
    line = Place(lines=(Line(((-1.0, 0.0), (1.0, 0.0)), 0.2, closed=False),))
    with VirtualThymioRig(1, camera=False, around=line) as rig, rig.robot as robot:
        dark = robot.read_sensors()
        rig.lab.place(0.0, 0.5, 0.0)
        robot.clock.sleep_until(robot.clock.now() + 0.1)  # until it reads its sensors again
        light = robot.read_sensors()
    assert all(dark[name] < 0.6 * light[name] for name in ("line_left", "line_right"))


@pytest.mark.slow
def test_a_recording_in_a_place_keeps_it_and_goes_by_its_board(tmp_path):
    """The perimeter line that the robot sees is that of the small board."""
    SMALL.write(tmp_path / "small.json")
    words = ["record", tmp_path / "r", "--commands", 12, "--camera", "none", "--seed", 2]

    def call(*words):
        return CliRunner().invoke(cli, list(map(str, words)))

    done = call(*words, "--place", tmp_path / "small.json")
    assert done.exit_code == 0, done.output
    meta = json.loads((tmp_path / "r" / "recording.json").read_text())
    assert Place.of(meta["place"]) == SMALL
    assert meta["board"]["length"] == meta["place"]["board"]["length"] == 1.6
    kinds = Recording(tmp_path / "r").commands()["kind"]
    assert "cut" in set(kinds)
    truth = np.loadtxt(tmp_path / "r" / "truth" / "truth-001.csv", delimiter=",", skiprows=1)
    assert (np.abs(truth[:, 1:3]).max(axis=0) < [0.8, 0.6]).all()
    wrong = call(*words[:1], tmp_path / "s", *words[2:], "--place", "moon")
    assert "moon: no such file of a place" in str(wrong.exception)


@pytest.mark.parametrize("kind", ["nxt", "lines", "thymio", "ros"])
def test_the_command_line_keeps_a_robot_in_a_place(tmp_path, monkeypatch, kind):
    place, labs = Place.rectangle(1.0, 0.8), []
    place.write(tmp_path / "place.json")
    monkeypatch.setattr("neurosim.cli.lab._stay", lambda rig, seconds: labs.append(rig.lab))
    words = ["lab", kind, "--place", str(tmp_path / "place.json"), "--start", "20", "10", "90"]
    done = CliRunner().invoke(cli, [*words, "--json"], catch_exceptions=False)
    assert done.exit_code == 0
    assert labs[0].around == place
    assert labs[0].body.pose == pytest.approx([0.2, 0.1, math.pi / 2], abs=0.03)
    for x, why in (("45", "in a wall or an obstacle"), ("500", "outside of the lab's room")):
        words[5] = x
        with pytest.raises(UserError, match=why):
            CliRunner().invoke(cli, words, catch_exceptions=False)


def test_other_programs_read_what_stands_around_a_thymio(tmp_path, monkeypatch):
    Place.rectangle(1.0, 0.8).write(tmp_path / "place.json")
    seen = []

    def look(rig, seconds):
        with Thymio(rig.address, timeout=PATIENCE) as robot:
            wait_until(lambda: seen.append(robot.activations()) or seen[-1][2] > 0, "a scan")

    monkeypatch.setattr("neurosim.cli.lab._stay", look)
    words = ["lab", "thymio", "--place", str(tmp_path / "place.json"), "--start", "38", "0", "0"]
    assert CliRunner().invoke(cli, words, catch_exceptions=False).exit_code == 0
    assert seen[-1][2] == pytest.approx(4505 / (1 + 4.05**2 / 73) / 4500, rel=0.4)
    assert seen[-1][5:].max() < 0.01
