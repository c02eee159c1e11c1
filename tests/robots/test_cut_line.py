"""An NXT whose line is cut after any byte, that loses a telegram, or that answers late."""

import itertools
import struct
import sys
import time
from contextlib import suppress

import numpy as np
import pytest
from patience import PATIENCE, wait_until

from neurosim.base.errors import LinkLost, RobotError
from neurosim.lab.nxt.body import Wiring
from neurosim.lab.nxt.brick import VirtualBrick
from neurosim.lab.nxt.params import LabParams
from neurosim.lab.nxt.physics import S
from neurosim.lab.nxt.serve import PtyServer, Radio
from neurosim.lab.nxt.world import Lab
from neurosim.robots.nxt.driver import DEGREES, LATE, LONGEST, NXT

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals on Windows")

ROBOTS = {seed: LabParams.sampled(seed) for seed in (2, 34)}
WIRINGS = {"BC": ("B", "C"), "CB": ("C", "B"), "AC": ("A", "C")}
SPEEDS = [(50, 50), (-50, 50), (100, -30), (0, 60), (-60, 0), (-100, -100)]
#: Seconds that the motors of the lab take to come to a stand.
COASTING = 3.0


class Brick:
    """A virtual brick with motors that turn."""

    def __init__(self, params, wiring):
        ports = dict(zip(("left", "right"), ("ABC".index(each) for each in wiring), strict=True))
        lamp = next(port for port in range(3) if port not in ports.values())
        wires = Wiring(**ports, lamp=lamp)
        self.lab = Lab(0, params=params, camera=None, wiring=wires, truth_rate=0.0)
        self.lamp = "ABC"[lamp]
        self.brick = VirtualBrick(self.lab.body, lock=self.lab.lock)

    def hear(self, telegrams):
        for telegram in telegrams:
            self.brick.handle(telegram)
            self.lab.advance_to(self.lab.time + 0.00125)

    @property
    def speeds(self):
        return self.lab.body.state[S.SPEED : S.SPEED + 2]

    def stands_after(self, longest):
        """Return after how many seconds both motors stand for good; None: they do not."""
        begun, stood = self.lab.time, None
        while self.lab.time < begun + longest:
            if stood is None and not self.speeds.any():
                stood = self.lab.time - begun
            if stood is not None and self.speeds.any():
                stood = None
            self.lab.advance_to(self.lab.time + 0.1)
        return stood


def sent(wiring, lamp, *commands):
    """Return the bytes of each command as the driver sends them through nxt-python on a line."""
    brick = Brick(ROBOTS[2], wiring)
    with PtyServer(Radio(brick.brick, brick.lab.clock, jitter=0.0, patience=PATIENCE)) as server:
        robot = NXT(
            filename=server.path, clock=brick.lab.clock, deadline=PATIENCE, lamp=lamp,
            left=wiring[0], right=wiring[1], light_left=None, light_right=None,
        )  # fmt: skip
        with robot:
            guard, heard = robot._brick._sock, []
            plain = guard._write
            guard._write = lambda data: heard.append(data) or plain(data)
            results = []
            for command in commands:
                heard.clear()
                command(robot)
                results.append(b"".join(heard))
            return results


def whole(data):
    """Return the telegrams that arrived whole; the brick waits for the rest of another."""
    telegrams = []
    while len(data) >= 2 and len(data) >= 2 + (length := struct.unpack_from("<H", data)[0]):
        telegrams.append(data[2 : 2 + length])
        data = data[2 + length :]
    return telegrams


def drive_for(left, right, seconds):
    return lambda robot: robot.drive_for((left, right), seconds)


COMMANDS = {
    **{f"drive_for {speeds}": (drive_for(*speeds, 1.0), 1.0) for speeds in SPEEDS},
    "drive_for short": (drive_for(40, 70, 0.2), 0.2),
    "drive": (lambda robot: robot.drive((60, -60)), LONGEST),
    "stop": (lambda robot: robot.stop(), 0.0),
    "lamp on": (lambda robot: robot.lamp(True), 0.0),
    "lamp off": (lambda robot: robot.lamp(False), 0.0),
    "close": (lambda robot: robot.close(), 0.0),
}
BEFORE = {
    "standing": (lambda robot: robot.stop(), 0.0, 1.0),
    "driving": (drive_for(70, 40, 2.0), 2.0, 0.6),
    "turning": (drive_for(-80, 80, 2.0), 2.0, 1.9),
    "one wheel": (drive_for(0, -50, 2.0), 2.0, 0.6),
    "held": (lambda robot: robot.drive((30, 90)), LONGEST, 0.6),
    "ended by itself": (drive_for(70, 40, 0.5), 0.5, 6.0),
}


@pytest.mark.slow
@pytest.mark.parametrize(("wiring", "robot"), [("BC", 2), ("CB", 34), ("AC", 2)])
def test_cut_after_any_byte_of_any_command_every_motor_ends_by_itself(wiring, robot):
    lamp = next(port for port in "ABC" if port not in WIRINGS[wiring])
    cuts = 0
    for (was, before), (now, command) in itertools.product(BEFORE.items(), COMMANDS.items()):
        earlier, stream = sent(WIRINGS[wiring], lamp, before[0], command[0])
        outcomes = {}
        for count in range(len(stream) + 1):
            telegrams = whole(stream[:count])
            cuts += 1
            if len(telegrams) in outcomes:
                continue
            brick = Brick(ROBOTS[robot], WIRINGS[wiring])
            brick.hear(whole(earlier))
            brick.lab.advance_to(brick.lab.time + before[2])
            brick.hear(telegrams)
            # A motor's command has ended by its limit, whichever it was, and the motor has coasted.
            lasts = max(before[1], command[1])
            longest = 1.25 * (lasts + LATE) + COASTING
            stood = brick.stands_after(longest + 2.0)
            outcomes[len(telegrams)] = stood
            assert stood is not None, (was, now, count)
            assert stood <= longest, (was, now, count)
        assert len(outcomes) > 1
    assert cuts > 3000


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_limit_does_not_end_a_command_before_its_time(robot):
    for (was, before), (now, command) in itertools.product(BEFORE.items(), COMMANDS.items()):
        if not now.startswith("drive"):
            continue
        earlier, stream = sent(("B", "C"), "A", before[0], command[0])
        brick = Brick(ROBOTS[robot], ("B", "C"))
        brick.hear(whole(earlier))
        brick.lab.advance_to(brick.lab.time + before[2])
        brick.hear(whole(stream))
        asked = [brick.lab.body.output(port).power for port in (1, 2)]
        brick.lab.advance_to(brick.lab.time + command[1] + 0.9 * LATE)
        drives = [brick.lab.body.output(port).run_state != 0 for port in (1, 2)]
        assert drives == [True, True], (was, now)
        assert (brick.speeds != 0).tolist() == [bool(power) for power in asked], (was, now)


def test_no_motor_turns_at_the_power_that_it_idles_at():
    for params in ROBOTS.values():
        (stream,) = sent(("B", "C"), "A", drive_for(50, -50, 1.0))
        brick = Brick(params, ("B", "C"))
        brick.hear(whole(stream)[:2])
        outputs = [brick.lab.body.output(port) for port in (1, 2)]
        assert [output.power for output in outputs] == [1, 1]
        assert [output.tacho_limit for output in outputs] == [0, 0]
        brick.lab.advance_to(brick.lab.time + 5.0)
        assert [brick.lab.body.output(port).tacho_count for port in (1, 2)] == [0, 0]


class Rig:
    """A brick on a pseudo-terminal, and the driver on it."""

    def __init__(self, deadline=PATIENCE):
        self.brick = Brick(ROBOTS[2], ("B", "C"))
        self.radio = Radio(self.brick.brick, self.brick.lab.clock, jitter=0.0, patience=PATIENCE)
        self.server = PtyServer(self.radio)
        options = {} if deadline is None else {"deadline": deadline}
        self.robot = NXT(
            filename=self.server.path, clock=self.brick.lab.clock,
            light_left=None, light_right=None, **options,
        )  # fmt: skip

    def __enter__(self):
        self.robot.connect()
        return self

    def __exit__(self, *error):
        with suppress(RobotError):
            self.robot.close()
        self.server.stop()

    @property
    def powers(self):
        return [self.brick.lab.body.output(port).power for port in (1, 2)]

    def lose(self, which):
        """Lose those of the next telegrams that have these numbers."""
        handle, heard = self.brick.brick.handle, itertools.count()

        def deaf(telegram):
            return None if next(heard) in which else handle(telegram)

        self.brick.brick.handle = deaf


@pytest.mark.parametrize("seconds", [2.0, 0.2])
@pytest.mark.parametrize("lost", [{2}, {3}, {2, 3}, {0, 2}, {1, 3}, {0, 1, 2, 3}])
def test_a_command_that_was_lost_stops_the_robot(lost, seconds):
    with Rig() as rig:
        rig.robot.drive_for((30, 30), seconds)
        rig.lose(lost)
        with pytest.raises(RobotError, match=r"motor port . is at .* it was commanded to stop"):
            for _ in range(2 if seconds < 0.5 else 1):
                rig.radio.patience = 0.01
                rig.robot.drive_for((60, -60), seconds)
                # A short command reaches one side only, and is lost again the next time.
                rig.lose(lost)
        wait_until(lambda: rig.powers == [0, 0], "a stop")


@pytest.mark.parametrize("lost", [{0}, {1}, {0, 1}])
def test_without_its_first_telegrams_a_command_ends_later_but_ends(lost):
    with Rig() as rig:
        rig.robot.drive_for((60, 60), 2.0)
        rig.lose(lost)
        rig.robot.drive_for((30, 60), 1.0)
        # The remainder of the last limit is turned, too.
        left = DEGREES * (60 * 3.0 + 60 * 2.0)
        stood = rig.brick.stands_after(60.0)
        assert stood is not None
        turned = [rig.brick.lab.body.output(port).tacho_count for port in (1, 2)]
        assert np.all(np.abs(turned) < left + 300)


@pytest.mark.slow
def test_a_brick_that_answers_late_is_stopped_and_lost():
    with Rig(deadline=None) as rig:
        rig.robot.drive_for((30, 30), 2.0)
        rig.radio.patience = 0.01
        handle = rig.brick.brick.handle

        def late(telegram):
            if not telegram[0] & 0x80:
                time.sleep(2.5)
            return handle(telegram)

        rig.brick.brick.handle = late
        with pytest.raises(LinkLost, match="stopped answering: no reply within 1 s"):
            rig.robot.drive_for((60, 60), 2.0)
        with pytest.raises(RobotError):
            rig.robot.stop()
        wait_until(lambda: rig.powers == [0, 0], "a stop")
