"""A closed line on the lab's board: seen by sensors and camera, and followed."""

import math
from dataclasses import replace

import numpy as np
import pytest

from neurosim.base.place import Place
from neurosim.lab import CameraParams, LabParams, VirtualRig
from neurosim.lab.nxt.body import NxtBody
from neurosim.lab.nxt.world import Lab

PLACE = Place.with_line("rectangle", 1.4, 0.8, 0.3)
LINE = PLACE.lines[0].loop
#: The left sensor is above the middle of the axle.
UNDER = replace(LabParams.ideal(), light_ahead=0.0, light_aside=0.0)


def light(x, y, params=UNDER, theta=0.0, side=0):
    return NxtBody(params, 0, (x, y, theta), around=PLACE).reflected_light(side)


def test_light_by_hand():
    assert light(0.0, 0.4) == pytest.approx(0.2)  # the middle of the line
    assert light(0.0, 0.0) == pytest.approx(0.55)  # the bare board
    assert light(0.0, 0.42) == pytest.approx((0.2 + 0.55) / 2)  # its edge
    # A round spot of 8 mm, its centre 4 mm outside: a third of a circle less a triangle.
    fraction = 1 / 3 - math.sqrt(3) / (4 * math.pi)
    assert light(0.0, 0.424) == pytest.approx(0.55 - 0.35 * fraction)
    assert light(0.7 - 0.3 + 0.3 * math.sin(0.7), 0.1 + 0.3 * math.cos(0.7)) == pytest.approx(0.2)
    assert light(0.0, 0.92 - 0.12) == pytest.approx(0.25)  # the perimeter line is still there


def test_sensors_are_where_they_are_mounted():
    params = replace(UNDER, light_ahead=0.07, light_aside=0.03)
    # Facing up: the left sensor is at -x.
    assert light(0.03, 0.33, params, math.pi / 2, side=0) == pytest.approx(0.2)
    assert light(0.7 - 0.03, 0.0 - 0.07, params, math.pi / 2, side=1) == pytest.approx(0.2)
    assert light(0.7 - 0.03, 0.0 - 0.07, params, math.pi / 2, side=0) == pytest.approx(0.55)


def test_the_camera_sees_it():
    lab = Lab(0, camera=CameraParams(size=(320, 240)), around=PLACE)
    picture = lab.camera.render(None, noise=False).mean(axis=2)
    poses = LINE.poses(np.linspace(0, LINE.length, 60))

    def grey(aside):
        places = poses[:, :2] + aside * np.stack([-np.sin(poses[:, 2]), np.cos(poses[:, 2])], 1)
        pixels = lab.camera.project(np.column_stack([places, np.zeros(60)])).round().astype(int)
        return picture[pixels[:, 1], pixels[:, 0]]

    assert grey(0.0).max() < 110 < 150 < grey(0.06).min()


def test_a_robot_that_steers_towards_the_dark_goes_round():
    start = tuple(LINE.poses(0.0).tolist())
    with VirtualRig(3, start=start, camera=False, around=PLACE) as rig, rig.robot as robot:
        assert rig.describe()["place"]["lines"][0]["width"] == 0.04
        assert rig.lab.params.light_aside == pytest.approx(0.025, abs=0.01)
        due = robot.clock.now()
        for _ in range(130):
            seen = robot.read_sensors()
            steer = 35 * (seen["line_left"] - seen["line_right"])
            robot.drive((30 + steer, 30 - steer))
            due += 0.2
            robot.clock.sleep_until(due)
        poses = rig.lab.truth.poses
    away, along = LINE.nearest(poses[:, :2])
    assert away.max() < 0.04
    gone = np.diff(along)
    length = LINE.length
    assert np.sum((gone + length / 2) % length - length / 2) > 0.8 * length
