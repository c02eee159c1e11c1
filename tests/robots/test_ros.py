"""A base behind ROS: the driver and the virtual bridge, whose connection is cut or stays silent."""

import json
import math
import socket
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from patience import wait_until

from neurosim.base.errors import LinkLost, RobotError, UserError
from neurosim.base.place import THICKNESS, Place
from neurosim.lab import VirtualRosRig
from neurosim.lab.nxt.world import Pacer
from neurosim.lab.ros.bridge import Refused, RosBridge, Topic, populate
from neurosim.robots import Counters, Lamp, Sensors, open_robot
from neurosim.robots.base import SelfStopping
from neurosim.robots.odometry import Odometry
from neurosim.robots.ros.bridge import Bridge
from neurosim.robots.ros.driver import ODOMETRY, REPEATS, STAMPED, TWIST, Ros
from neurosim.robots.ros.laser import Sectors
from neurosim.trials.rig import Setup, open_rig


@contextmanager
def a_rig(**options):
    with VirtualRosRig(1, **{"camera": False, **options}) as rig:
        yield rig


def driver(rig, **options):
    return Ros(url=rig.address, clock=rig.lab.clock, **{"timeout": 10.0, **options})


def wait(robot, seconds):
    robot.clock.sleep_until(robot.clock.now() + seconds)


@pytest.mark.parametrize("stamped", [False, True])
def test_the_driver_drives_and_reads_it(stamped):
    with a_rig(stamped=stamped) as rig, rig.robot as robot:
        assert isinstance(robot, Counters)
        assert isinstance(robot, SelfStopping)
        assert not isinstance(robot, Lamp)
        assert not isinstance(robot, Sensors)
        assert robot.commands.names == ("v", "omega")
        odometry = Odometry(robot, np.zeros(3))
        first = rig.lab.body.pose
        robot.drive_for((0.2, 0.5), 3.0)
        assert rig.node.velocities == (0.2, 0.5)
        wait(robot, 3.0)
        assert rig.node.velocities == (0.2, 0.5)  # six times its controller's time-out
        robot.stop()
        assert rig.standing
        wait(robot, 1.0)
        pose, truth = odometry.read(), rig.lab.body.pose - first
        assert np.hypot(*(pose - truth)[:2]) < 0.05
        assert pose[2] == pytest.approx(truth[2], rel=0.06)
        assert pose[2] == pytest.approx(1.5, rel=0.1)
        about = json.loads(json.dumps(robot.describe()))
        assert about["kind"] == "ros"
        assert about["virtual"] is True
        assert rig.node.bridge.log == []


def test_counters_go_on_where_a_heading_begins_again():
    with a_rig() as rig, rig.robot as robot:
        robot.set_counts(0, 0)
        robot.drive_for((0.0, 2.0), 10.0)
        wait(robot, 10.0)
        robot.stop()
        wait(robot, 1.0)
        left, right = robot.read_counts()
        turn = (right - left) / robot.pulses_per_metre / robot.geometry.wheel_base
        assert turn > 2.5 * math.pi
        assert turn == pytest.approx(rig.lab.body.pose[2], rel=0.08)


def test_a_base_that_is_carried_counts_nothing():
    with a_rig() as rig, rig.robot as robot:
        wait(robot, 1.0)
        robot.set_counts(0, 0)
        rig.lab.place(0.5, -0.3, 1.0)
        wait(robot, 1.0)
        assert np.abs(robot.read_counts()).max() <= 1


def test_a_command_is_repeated_as_long_as_it_lasts_and_no_longer():
    with a_rig() as rig, driver(rig, stops_after=0.5) as robot:
        taken, take = [], rig.node.bridge.topics["/cmd_vel"].take
        rig.node.bridge.topics["/cmd_vel"].take = lambda message: (
            taken.append(rig.lab.time), take(message)
        )  # fmt: skip
        robot.drive_for((0.1, 0.0), 2.0)
        begun = rig.lab.time
        wait(robot, 3.0)
        assert len(taken) == 20
        assert max(np.diff(taken)) < 0.12
        assert taken[-1] < begun + 2.0
        assert rig.standing  # stopped by the controller: nothing was sent


def test_a_command_without_a_duration_ends_by_the_driver(monkeypatch):
    monkeypatch.setattr("neurosim.robots.ros.driver.LONGEST", 3.0)
    with a_rig(stops_after=math.inf) as rig, driver(rig) as robot:
        assert not isinstance(robot, SelfStopping)
        robot.drive((0.1, 0.0))
        wait(robot, 2.9)
        assert not rig.standing
        wait(robot, 0.2)
        assert rig.standing


def test_what_the_robot_does_not_take_is_refused_before_it_is_sent():
    with a_rig() as rig, driver(rig) as robot:
        with pytest.raises(UserError, match=r"v: 0\.21 is beyond its limits"):
            robot.drive((0.21, 0.0))
        assert rig.standing
    with pytest.raises(UserError, match="needs more than 10 messages per second"):
        Ros(stops_after=0.1)
    with pytest.raises(UserError, match="max_v: expected a number from"):
        Ros(max_v=-1.0)


def test_leaving_stops_the_base_whatever_happened():
    for error in (RuntimeError, KeyboardInterrupt):
        with a_rig(stops_after=math.inf) as rig:
            with pytest.raises(error), driver(rig) as robot:
                robot.drive((0.1, 0.0))
                raise error
            assert rig.standing


@pytest.mark.parametrize("act", ["wait", "drive", "read_counts"])
def test_a_bridge_that_ends_while_the_base_drives(act):
    with a_rig() as rig, driver(rig) as robot:
        robot.drive((0.1, 0.0))
        rig.hang_up()
        does = {"wait": lambda: wait(robot, 1.0), "drive": lambda: robot.drive((0.1, 0.0)),
                "read_counts": robot.read_counts}[act]  # fmt: skip
        with pytest.raises(LinkLost, match="closed the connection"):
            does()
        with pytest.raises(LinkLost, match="closed the connection"):  # and again
            robot.stop()
        rig.lab.clock.sleep_until(rig.lab.time + 0.6)
        assert rig.standing


def test_a_network_that_fails_while_the_base_drives():
    with a_rig() as rig, driver(rig) as robot:
        robot.drive((0.1, 0.0))
        rig.switch_off()
        robot._bridge._timeout = 0.05
        with pytest.raises(LinkLost, match=r"stopped answering: nothing within 0\.05 s"):
            wait(robot, 1.0)
        rig.lab.clock.sleep_until(rig.lab.time + 0.6)
        assert rig.standing


def test_a_lost_robot_is_connected_again():
    with a_rig() as rig, driver(rig) as robot:
        rig.hang_up()
        with pytest.raises(LinkLost):
            robot.stop()
        robot.connect()
        robot.drive((0.1, 0.0))
        assert rig.node.velocities == (0.1, 0.0)


def test_odometry_that_no_longer_comes():
    with a_rig() as rig, driver(rig) as robot:
        robot.drive((0.1, 0.0))
        rig.node.publishes = False
        robot.read_counts()
        wait(robot, 1.0)
        robot.read_counts()
        wait(robot, 1.5)
        with pytest.raises(LinkLost, match=r"nothing has come on /odom for 2\.\d s"):
            robot.read_counts()
        wait_until(lambda: rig.standing, "the farewell")
        with pytest.raises(RobotError, match="nothing comes on /odom within 2 s"):
            driver(rig).connect()
        with driver(rig, odom="none") as robot:
            assert not isinstance(robot, Counters)
            robot.drive((0.1, 0.0))
            assert not rig.standing


def test_a_laser_is_a_ring_of_sensors():
    with a_rig() as rig, driver(rig, laser="/scan") as robot:
        assert isinstance(robot, Sensors)
        assert robot.sensor_names == tuple(f"sensor_{number}" for number in range(8))
        # Half a metre from the wall ahead, 0.8 m from that to the left; others are out of reach.
        x, y, slant = rig.walls[0] - 0.5, rig.walls[1] - 0.8, math.cos(math.pi / 8)
        distances = np.array([0.5, 0.5 / slant, 0.8, 0.8 / slant, 1, 1, 1, 0.5 / slant])
        for turns, heading in enumerate((0.0, math.pi / 2, -math.pi)):
            rig.lab.place(x, y, heading)
            wait(robot, 1.0)
            read = list(robot.read_sensors().values())
            # Of several beams the nearest counts, so a little more is read than in the mean.
            np.testing.assert_allclose(read, np.roll(1 - distances, -2 * turns), atol=0.05)
        about = json.loads(json.dumps(robot.describe()))
        assert about["laser"] == {"topic": "/scan", "sectors": 8, "reach": 1.0, "turned": 0.0}
        assert rig.node.bridge.log == []
    with a_rig() as rig, driver(rig, laser="/scan", laser_sectors=4, laser_turned=90.0) as robot:
        rig.lab.place(rig.walls[0] - 0.5, 0.0, 0.0)
        wait(robot, 1.0)
        # The laser's own 0, which sees the wall, looks to the left.
        assert np.argmax(list(robot.read_sensors().values())) == 1


def test_a_laser_sees_the_walls_and_obstacles_of_a_place():
    """Half a metre ahead the side of a wall, 0.6 m to the left a cylinder; all else is far."""
    wall = (0.5 + THICKNESS / 2, -0.4, 0.5 + THICKNESS / 2, 0.4)
    place = Place(walls=(wall,), obstacles=((0.0, 0.65, 0.05),))
    options = {"lab_seed": 1, "laser": "/scan", "laser_sectors": 4}
    with open_rig("virtual-ros", options, Setup(camera="none", place=place)) as rig:
        robot = rig.robot
        rig.place(0.0, 0.0, 0.0)
        wait(robot, 1.0)
        read = list(robot.read_sensors().values())
        np.testing.assert_allclose(read, [0.5, 0.4, 0.0, 0.0], atol=0.05)
        # Turned to the right, both are seen a sector farther to the left.
        rig.place(0.0, 0.0, -math.pi / 2)
        wait(robot, 1.0)
        read = list(robot.read_sensors().values())
        np.testing.assert_allclose(read, [0.0, 0.5, 0.4, 0.0], atol=0.05)


def test_scans_that_are_missing():
    with a_rig() as rig:
        with pytest.raises(RobotError, match=r"no node of ROS publishes /laser: .*with --laser"):
            driver(rig, laser="/laser").connect()
        with driver(rig, laser="/scan", odom="none") as robot:
            rig.node.publishes = False
            robot.drive((0.1, 0.0))
            wait(robot, 3.0)
            with pytest.raises(
                LinkLost, match=r"nothing has come on /scan for \d\.\d s: does the dr"
            ):
                robot.read_sensors()
            wait_until(lambda: rig.standing, "the farewell")
        with pytest.raises(RobotError, match="nothing comes on /scan within 2 s: start the driver"):
            driver(rig, laser="/scan", odom="none").connect()


def scan(ranges, **options):
    whole = {"angle_min": 0.0, "angle_increment": math.pi / 2, "range_min": 0.1, "range_max": 3.0}
    return {**whole, "ranges": ranges, **options}


@pytest.mark.parametrize(
    ("message", "readings"),
    [
        (scan([0.5, 1.0, 1.5, 2.0]), [0.75, 0.5, 0.25, 0.0]),
        # Null stands for infinity or NaN; a value beyond the laser's limits is not a measurement.
        (scan([None, 0.05, 3.5, 1.0]), [0.0, 0.0, 0.0, 0.5]),
        (scan([3.5, 3.5, 0.5, 3.5], range_max=None), [0.0, 0.0, 0.75, 0.0]),
        # A laser that looks to the front only, from its right to its left.
        (scan([1.0, 0.5, 1.5], angle_min=-math.pi / 2), [0.75, 0.25, 0.0, 0.5]),
        # The nearest in a sector counts, in both directions; angles beyond a turn are wrapped.
        (scan([1.8, 0.2, 1.6], angle_min=2 * math.pi - 0.5, angle_increment=0.5), [0.9, 0, 0, 0]),
        (scan([]), [0, 0, 0, 0]),
    ],
)
def test_sectors_of_a_scan(message, readings):
    sectors = Sectors(4, 2.0, 0.0)
    assert sectors.take(message)
    np.testing.assert_allclose(sectors.readings, readings)


@pytest.mark.parametrize(
    "message", [{}, scan(None), scan(["x"]), scan([1.0], angle_min=None), {"ranges": 3}]
)
def test_what_is_no_scan_changes_nothing(message):
    sectors = Sectors(4, 2.0, 0.0)
    sectors.take(scan([1.0] * 4))
    assert not sectors.take(message)
    np.testing.assert_allclose(sectors.readings, [0.5] * 4)


@pytest.mark.parametrize("statuses", [False, True])
def test_topics_that_are_wrong(statuses):
    with a_rig(statuses=statuses) as rig:
        for options, says in [
            ({"cmd_vel": "/base/cmd_vel"}, "no node of ROS subscribes to /base/cmd_vel"),
            ({"stamped": True}, f"of type {TWIST}, not {STAMPED}: leave out --stamped"),
            ({"odom": "/wheel_odom"}, "no node of ROS publishes /wheel_odom"),
        ]:
            with pytest.raises(RobotError, match=says):
                driver(rig, **options).connect()
        rig.node.bridge.topics["/odom"].kind = "nav_msgs/msg/Path"
        with pytest.raises(RobotError, match=f"nav_msgs/msg/Path, not {ODOMETRY}: name another"):
            driver(rig).connect()
    says = f"of type {STAMPED}, not {TWIST}: add --stamped"
    with a_rig(statuses=statuses, stamped=True) as rig, pytest.raises(RobotError, match=says):
        driver(rig).connect()
    with (
        a_rig(statuses=statuses, rosapi=False) as rig,
        pytest.raises(RobotError, match="has no service /rosapi/subscribers"),
    ):
        driver(rig).connect()


def test_what_is_no_bridge():
    with pytest.raises(RobotError, match=r"no rosbridge answers at ws://127\.0\.0\.1:1 "):
        Ros(url="ws://127.0.0.1:1").connect()
    for url in ("http://127.0.0.1:9090", "localhost"):
        with pytest.raises(UserError, match="is not the address of a rosbridge"):
            Ros(url=url).connect()


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", "is not a rosbridge .*404"),
        (b"0 robot neurosim-lines 1 a b*1234\r\n\r\n", "is not a rosbridge"),
        (b"", r"is not a rosbridge \(it does not answer\)"),
    ],
)
def test_what_listens_and_is_no_bridge(answer, says):
    listener = socket.create_server(("127.0.0.1", 0))

    def serve():
        client, _ = listener.accept()
        with client:
            while client.recv(4096):
                client.sendall(answer)

    threading.Thread(target=serve, daemon=True).start()
    with listener, pytest.raises(RobotError, match=says):
        Ros(url=f"ws://127.0.0.1:{listener.getsockname()[1]}", timeout=0.3).connect()


def test_without_the_library(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "websockets.client", None)
    with pytest.raises(UserError, match=r"needs the package websockets: pip install 'neurosim"):
        Ros().connect()


@pytest.mark.slow
def test_in_real_time_a_thread_repeats_whatever_the_program_does():
    with a_rig(real_time=True, stops_after=2.0) as rig, Pacer(rig.lab):
        with open_robot("ros", url=rig.address, max_v=0.3, stops_after=2.0) as robot:
            robot.drive_for((0.2, 0.0), 4.0)
            begun = rig.lab.time
            while rig.lab.time < begun + 3.5:  # a program that does not wait by the robot's clock
                assert not rig.standing
                time.sleep(0.02)
            wait_until(lambda: rig.standing, "the controller's stop")
            left, _ = robot.read_counts()
            assert left / robot.pulses_per_metre > 0.5
        wait_until(lambda: not [one for one in threading.enumerate() if one.name == REPEATS],
                   "the thread's end")  # fmt: skip


# The virtual bridge, after the protocol's document and the words of rosbridge_suite.


def bridge(**options):
    taken = []
    topics = {
        "/cmd_vel": Topic(TWIST, ["/base"], take=taken.append),
        "/odom": Topic(ODOMETRY, publishers=["/base"]),
    }
    made = RosBridge(topics, lambda: 12.25, **{"statuses": True, **options})
    return made, taken


def ask(made, **message):
    return [json.loads(text) for text in made.take(json.dumps(message))]


@pytest.mark.parametrize(
    ("message", "says"),
    [
        ({"topic": "/cmd_vel"}, "Received a message without an op."),
        ({"op": "dance"}, "Unknown operation: dance."),
        ({"op": "advertise", "topic": "/cmd_vel"}, "Expected a type field but none was found."),
        ({"op": "advertise", "topic": "/cmd_vel", "type": "std_msgs/String"}, "Unable to import"),
        ({"op": "advertise", "topic": "/cmd_vel", "type": STAMPED}, "already established with"),
        ({"op": "publish", "topic": "/new", "msg": {}}, "as it is not yet advertised"),
        ({"op": "publish", "topic": "/cmd_vel", "msg": 3}, "Expected field msg to be one of"),
        ({"op": "publish", "topic": "/cmd_vel", "msg": {"linear": {"w": 1}}},
         "publish: Message type geometry_msgs/Twist does not have a field linear.w"),
        ({"op": "publish", "topic": "/cmd_vel", "msg": {"linear": {"x": "1"}}},
         "geometry_msgs/Twist message requires a float64 for field linear.x, but got a <class 'st"),
        ({"op": "publish", "topic": "/cmd_vel", "msg": {"linear": 1.0}},
         "requires a geometry_msgs/Vector3 for field linear"),
        ({"op": "subscribe", "topic": "/scan"}, "Cannot infer topic type for topic /scan"),
        ({"op": "subscribe", "topic": "/odom", "type": TWIST}, "already established with type nav"),
    ],
)  # fmt: skip
def test_the_bridge_refuses(message, says):
    made, taken = bridge()
    (answer,) = ask(made, id="7", **message)
    assert (answer["op"], answer["level"], answer["id"]) == ("status", "error", "7")
    assert says in answer["msg"]
    assert taken == []
    silent, _ = bridge(statuses=False)
    assert ask(silent, **message) == []
    assert says in silent.log[0]


def test_the_bridge_takes_topics_and_services():
    made, taken = bridge()
    assert ask(made, op="advertise", topic="/cmd_vel", type="geometry_msgs/Twist") == []
    assert ask(made, op="publish", topic="/cmd_vel", msg={"linear": {"x": 1}}) == []
    assert taken[0]["linear"] == {"x": 1.0, "y": 0.0, "z": 0.0}
    assert taken[0]["angular"]["z"] == 0.0
    call = {"op": "call_service", "id": "a", "args": {"topic": "/cmd_vel"}}
    assert ask(made, service="/rosapi/topic_type", **call) == [
        {"op": "service_response", "id": "a", "service": "/rosapi/topic_type", "result": True,
         "values": {"type": TWIST}}
    ]  # fmt: skip
    assert ask(made, service="/rosapi/subscribers", **call)[0]["values"] == {
        "subscribers": ["/base"]
    }
    assert ask(made, service="/reset", **call)[0]["result"] is False
    assert made.publish("/odom", {}) == []
    assert ask(made, op="subscribe", topic="/odom", throttle_rate=100) == []
    (sent,) = map(json.loads, made.publish("/odom", {"pose": {"pose": {"position": {"x": 2}}}}))
    assert sent["msg"]["pose"]["pose"]["position"]["x"] == 2.0
    assert made.publish("/odom", {}) == []  # 0 s later
    made.leave()
    assert made.publish("/odom", {}) == []


def test_a_header_gets_the_time_only_where_it_is_there_without_one():
    stamp = {"sec": 12, "nanosec": 250_000_000}
    assert populate({"header": {"frame_id": ""}}, STAMPED, 12.25)["header"]["stamp"] == stamp
    assert populate({}, STAMPED, 12.25)["header"]["stamp"]["sec"] == 0
    given = {"header": {"stamp": {"sec": 3}}}
    assert populate(given, STAMPED, 12.25)["header"]["stamp"] == {"sec": 3, "nanosec": 0}
    with pytest.raises(Refused, match=r"a int32 for field header\.stamp\.sec"):
        populate({"header": {"stamp": {"sec": 1.5}}}, STAMPED)


def test_a_status_of_the_bridge_is_an_error():
    with a_rig(statuses=True) as rig:
        client = Bridge(rig.address, 10.0)
        client.open()
        with pytest.raises(
            RobotError, match="rejected a message: publish: Message type geometry_ms"
        ):
            client.publish("/cmd_vel", {"speed": 1})
        client.publish("/cmd_vel", {"linear": {"x": 0.1}})
        assert rig.node.velocities == (0.1, 0.0)
        client.close()


def test_messages_in_pieces_and_of_others_are_taken_or_passed_over():
    with a_rig() as rig:
        client, seen = Bridge(rig.address, 10.0), []
        client.open()
        client.subscribe("/odom", ODOMETRY, 0.0, seen.append)
        rig._server.say(['{"op": "publish", "topic": "/odom", "msg": "' + "x" * 200_000 + '"}'])
        rig._server.say(["no JSON", "[]", '{"op": "publish", "topic": "/other", "msg": 1}'])
        client.sync()
        assert seen == ["x" * 200_000]
        client.close()
