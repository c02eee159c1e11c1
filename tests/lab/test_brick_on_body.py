"""Driver, nxt-python, line, radio, brick and the lab's body together."""

import numpy as np
import pytest
from brick_body import LabClock

from neurosim.lab.nxt.body import NxtBody
from neurosim.lab.nxt.brick import VirtualBrick
from neurosim.lab.nxt.params import LabParams
from neurosim.lab.nxt.serve import Radio, SocketServer
from neurosim.robots.nxt.driver import NXT


class BodyClock(LabClock):
    """The body's own time."""

    def __init__(self, body):
        super().__init__()
        self.body = body

    def sleep_until(self, time):
        super().sleep_until(time)
        self.body.advance(self.time)


def test_from_a_percentage_to_the_wheels():
    body = NxtBody(LabParams.ideal(), seed=3)
    clock = BodyClock(body)
    radio = Radio(VirtualBrick(body), clock, np.random.default_rng(3))
    with SocketServer(radio) as server:
        host, port = server.address
        with NXT(clock=clock, server_host=host, server_port=port) as robot:
            light = robot.read_sensors()
            assert light["line_left"] == pytest.approx(0.55, abs=0.02)
            robot.lamp(True)
            robot.drive((50, 50))
            clock.sleep_until(clock.now() + 1.0)
            robot.stop()
            clock.sleep_until(clock.now() + 0.5)
            left, right = (body.output(port).rotation_count for port in (1, 2))
            assert 6.0 < robot.battery() < 10.0
    x, y, heading = body.pose
    assert x == pytest.approx(0.25, abs=0.03)
    assert (y, heading) == pytest.approx((0.0, 0.0), abs=0.01)
    assert np.radians(left) * 0.028 == pytest.approx(x, abs=0.01)
    assert left == pytest.approx(right, abs=2)
    assert body.lamp_light() > 1.0
