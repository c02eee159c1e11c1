"""Driver of a base that ROS 2 drives: velocities on a topic, odometry and a laser on others."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.base.commands import Commands, Number
from neurosim.base.declared import Metres, Seconds, checks
from neurosim.base.errors import RobotError, UserError
from neurosim.robots.base import Clock, Driver, Geometry, SystemClock
from neurosim.robots.ros.bridge import Bridge
from neurosim.robots.ros.laser import SCAN, Sectors

#: Time for which a command without a duration is repeated, s.
LONGEST = 60.0
#: Counters count tenths of a millimetre.
PER_METRE = 10_000.0
#: Shortest time between two messages of odometry or scans, s; and time after which they count as
#: missing.
EVERY, WITHIN = 0.02, 2.0
#: Name of the thread that repeats commands.
REPEATS = "ros repeats"
#: Name of the virtual lab's node.
VIRTUAL = "/neurosim_lab"
#: Name that stands for no topic.
NONE = "none"

TWIST, STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
ODOMETRY = "nav_msgs/msg/Odometry"

#: A velocity, m/s; a turn rate, rad/s; messages per second.
Velocity = Annotated[float, Meta(ge=0.001, le=20)]
TurnRate = Annotated[float, Meta(ge=0.001, le=50)]
Rate = Annotated[float, Meta(ge=1, le=100)]
#: Number of sensors of a laser; degrees.
SectorCount = Annotated[int, Meta(ge=1, le=72)]
Degrees = Annotated[float, Meta(ge=-360, le=360)]


@dataclass
class _Held:
    """A command that is being repeated: its numbers, its next time, and its end (s)."""

    numbers: tuple[float, ...]
    due: float
    until: float


@dataclass
class _Feed:
    """A topic whose messages must continue to come.

    Attributes:
        topic: its name.
        option: the option for its name.
        source: the node that publishes it, in words.
        seen: time of the last message, s; None: there was none yet.
    """

    topic: str
    option: str
    source: str
    seen: float | None = None


class Ros(Driver):
    """A base that ROS 2 drives, behind a rosbridge: a forward velocity and a turn rate.

    Follows :class:`neurosim.robots.base.Robot` and, with odometry, ``Counters``: they count the
    rotation of virtual wheels on a base of this radius. With a laser it follows ``Sensors``.
    ROS does not acknowledge commands; a command counts as taken when the bridge has it. It is then
    repeated, because the controllers of most bases stop after some time without messages. With
    ``stops_after`` the robot is ``SelfStopping``: the repeats end with the command, and then the
    controller stops the base.

    Args:
        url: Address of the rosbridge.
        cmd_vel: Topic on which the base takes velocities.
        odom: Topic on which the base publishes its odometry; none: it is not read.
        laser: Topic on which a laser publishes its scans, such as /scan; none: they are not read.
        laser_sectors: Number of sensors into which a scan is divided: the first looks straight
            ahead, the others follow to its left.
        laser_reach: Distance from which on a sensor reads 0, m; nearer it reads more, up to 1.
        laser_turned: Direction of the laser's own 0, degrees to the left of straight ahead.
        stamped: The base takes TwistStamped messages, not Twist.
        max_v: Greatest velocity that is commanded, forward and backward, m/s.
        max_omega: Greatest turn rate that is commanded, to both sides, rad/s.
        radius: Radius of the circle around the body, m.
        rate: Messages per second while a command is held.
        stops_after: Time without a message after which the base's controller stops it, s (the
            cmd_vel_timeout of a diff_drive_controller: 0.5); by default nothing is known to stop
            it.
        timeout: Wall-clock seconds that the bridge may take to acknowledge a message.
        clock: the robot's clock; the virtual lab gives its own.

    Attributes:
        pulses_per_metre: of the counters.
        geometry: radius, and the distance of the counters' virtual wheels, m.
    """

    pulses_per_metre = PER_METRE

    @checks
    def __init__(
        self,
        *,
        url: str = "ws://localhost:9090",
        cmd_vel: str = "/cmd_vel",
        odom: str = "/odom",
        laser: str = NONE,
        laser_sectors: SectorCount = 8,
        laser_reach: Metres = 1.0,
        laser_turned: Degrees = 0.0,
        stamped: bool = False,
        max_v: Velocity = 0.2,
        max_omega: TurnRate = 1.0,
        radius: Metres = 0.15,
        rate: Rate = 10.0,
        stops_after: Seconds | None = None,
        timeout: Seconds = 1.0,
        clock: Clock | None = None,
    ):
        if stops_after is not None and stops_after * rate <= 1:
            raise UserError(
                f"stops_after: a base that stops after {stops_after:g} s needs more than {rate:g} "
                "messages per second; raise the rate"
            )
        self.clock: Clock = SystemClock() if clock is None else _RepeatingClock(clock, self)
        self.commands = Commands(
            (Number("v", "m/s", -max_v, max_v), Number("omega", "rad/s", -max_omega, max_omega)),
            "twist",
            {"radius": radius},
        )
        self._topic = cmd_vel
        self._odom = None if odom == NONE else _Feed(odom, "--odom", "the driver of the base")
        self._laser = None if laser == NONE else _Feed(laser, "--laser", "the driver of the laser")
        self._stamped, self._stops_after, self._period = stamped, stops_after, 1 / rate
        self._bridge = Bridge(url, timeout)
        # The user's commands and the repeats take turns.
        self._lock = threading.RLock()
        self._held: _Held | None = None
        self._nodes: list[str] = []
        self._repeats = clock is None
        self._closed = threading.Event()
        self._seen: NDArray[np.float64] | None = None
        self._distances, self._zeros = np.zeros(2), np.zeros(2)
        if stops_after is not None:
            self.drive_for = self._drive_for
        if self._odom is not None:
            self.geometry = Geometry(radius, 2 * radius)
            self.read_counts, self.set_counts = self._read_counts, self._set_counts
        if self._laser is not None:
            self._sectors = Sectors(laser_sectors, laser_reach, math.radians(laser_turned))
            self._scans = {"sectors": laser_sectors, "reach": laser_reach, "turned": laser_turned}
            self.sensor_names = tuple(f"sensor_{number}" for number in range(laser_sectors))
            self.read_sensors = self._read_sensors

    def connect(self) -> None:
        """Connect to the bridge, check the topics, and stop the base.

        Raises:
            RobotError: if there is no bridge, a topic has no node at its other end, or its messages
                are of another type.
        """
        if self._bridge.is_open:
            return
        self._bridge.open()
        try:
            kind = STAMPED if self._stamped else TWIST
            self._nodes = self._others("subscribers", self._topic, kind, "--cmd-vel")
            self._bridge.advertise(self._topic, kind)
            self._bridge.farewell = (self._topic, self._message((0.0, 0.0)))
            self.stop()
            if self._odom is not None:
                self._seen = None
                self._listen(self._odom, ODOMETRY, self._see)
            if self._laser is not None:
                self._listen(self._laser, SCAN, self._sectors.take)
        except BaseException:
            self._bridge.close()
            raise
        if self._repeats:
            self._closed = threading.Event()
            thread = threading.Thread(
                target=self._run, name=REPEATS, args=(self._closed,), daemon=True
            )
            thread.start()

    def close(self) -> None:
        """Stop the base if the connection is still open, and end it; raises only Ctrl-C."""
        self._closed.set()
        try:
            if self._bridge.is_open:
                with suppress(Exception):
                    self.stop()
                    self._bridge.unadvertise(self._topic)
        finally:
            self._bridge.close()

    def drive(self, command: Sequence[float]) -> None:
        """Set both velocities, for a minute or until the next command.

        Raises:
            UserError: if one is beyond its limit.
            LinkLost: if the bridge does not acknowledge it.
        """
        self._hold(command, LONGEST)

    def _drive_for(self, command: Sequence[float], seconds: float) -> None:
        """Set both velocities, like :meth:`drive`, for a duration (s).

        Without another command the base's controller stops it ``stops_after`` later.
        """
        self._hold(command, seconds)

    def stop(self) -> None:
        """Set both velocities to 0."""
        with self._lock:
            self._held = None
            self._publish((0.0, 0.0))

    def describe(self) -> dict[str, Any]:
        """Describe this robot for a recording."""
        about: dict[str, Any] = {
            "kind": "ros",
            "url": self._bridge.url,
            "cmd_vel": self._topic,
            "odom": None if self._odom is None else self._odom.topic,
            "laser": None if self._laser is None else {"topic": self._laser.topic, **self._scans},
            "stamped": self._stamped,
            "rate": round(1 / self._period, 6),
            "stops_after": self._stops_after,
        }
        if self._nodes:
            about |= {"nodes": self._nodes, "virtual": VIRTUAL in self._nodes}
        return about

    # Commands

    def _hold(self, command: Sequence[float], seconds: float) -> None:
        numbers = self.commands.check(command)
        with self._lock:
            self._held = None
            self._publish(numbers)
            now = self.clock.now()
            if any(numbers):
                self._held = _Held(numbers, now + self._period, now + seconds)

    def _publish(self, numbers: Sequence[float]) -> None:
        self._bridge.publish(self._topic, self._message(numbers))

    def _message(self, numbers: Sequence[float]) -> dict[str, Any]:
        v, omega = numbers
        twist = {
            "linear": {"x": v, "y": 0.0, "z": 0.0},
            "angular": {"x": 0.0, "y": 0.0, "z": omega},
        }
        # The bridge puts its own time, which is also the base's, into a header without one.
        return {"header": {"frame_id": ""}, "twist": twist} if self._stamped else twist

    @property
    def due(self) -> float:
        """Time of the next repeat, s on the robot's clock; infinity: no command is held."""
        held = self._held
        return math.inf if held is None else min(held.due, held.until)

    def repeat(self) -> None:
        """Repeat the held command if it is due; end it after its duration."""
        with self._lock:
            # By rounding, a clock may be just before a time and not sleep any more.
            held, now = self._held, self.clock.now() + 1e-6
            if held is None or now < self.due:
                return
            if now < held.until:
                held.due = now + self._period
                self._publish(held.numbers)
            elif self._stops_after is None:
                self.stop()
            else:
                self._held = None

    def _run(self, closed: threading.Event) -> None:
        """Repeat commands and take messages until the robot is closed or lost."""
        with suppress(RobotError):
            while not closed.wait(self._period / 4):
                self._bridge.poll()
                self.repeat()

    # Topics

    def _others(
        self, role: Literal["subscribers", "publishers"], topic: str, kind: str, option: str
    ) -> list:
        """Return the nodes at the other end of a topic of the right type."""
        nodes = self._bridge.call(f"/rosapi/{role}", topic=topic).get(role)
        if not nodes or not isinstance(nodes, list):
            does = "subscribes to" if role == "subscribers" else "publishes"
            others = "" if role == "subscribers" else f", or leave it out with {option} {NONE}"
            raise RobotError(
                f"no node of ROS {does} {topic}: start the driver of the base, or name its topic "
                f"with {option}{others}"
            )
        published = str(self._bridge.call("/rosapi/topic_type", topic=topic).get("type"))
        if _plain(published) != _plain(kind):
            twists = {_plain(STAMPED): "add --stamped", _plain(TWIST): "leave out --stamped"}
            mend = twists.get(_plain(published)) if option == "--cmd-vel" else None
            raise RobotError(
                f"the messages of {topic} are of type {published}, not {kind}: "
                + (mend or f"name another topic with {option}")
            )
        return nodes

    def _listen(self, feed: _Feed, kind: str, take: Callable[[dict[str, Any]], bool]) -> None:
        """Subscribe to a topic, and wait for the first message."""
        self._others("publishers", feed.topic, kind, feed.option)
        feed.seen = None

        def taken(message: dict[str, Any]) -> None:
            if take(message):
                feed.seen = self.clock.now()

        self._bridge.subscribe(feed.topic, kind, EVERY, taken)
        end = self.clock.now() + WITHIN
        while feed.seen is None:
            if self.clock.now() >= end:
                raise RobotError(
                    f"nothing comes on {feed.topic} within {WITHIN:g} s: start {feed.source}, or "
                    f"leave it out with {feed.option} {NONE}"
                )
            self.clock.sleep_until(self.clock.now() + 0.05)
            self._bridge.sync()

    def _fresh(self, feed: _Feed) -> None:
        """Take the received messages; check that a topic's messages continue to come.

        Raises:
            LinkLost: if they do not come.
        """
        self._bridge.sync()
        silent = 0.0 if feed.seen is None else self.clock.now() - feed.seen
        if silent > WITHIN:
            raise self._bridge.lose(
                f"nothing has come on {feed.topic} for {silent:.1f} s: does {feed.source} still "
                "run?"
            )

    def _see(self, message: dict[str, Any]) -> bool:
        """Take a message of odometry, and add the wheels' distances; return whether it is valid."""
        try:
            pose = message["pose"]["pose"]
            place, turn = pose["position"], pose["orientation"]
            heading = 2 * math.atan2(float(turn["z"]), float(turn["w"]))
            now = np.array([float(place["x"]), float(place["y"]), heading])
        except (KeyError, TypeError, ValueError):
            return False
        if not np.isfinite(now).all():
            return False
        if self._seen is not None:
            moved = se2.between(self._seen, now)
            moved[2] = se2.wrapped(moved[2])
            forward, _, angle = se2.log(moved)
            aside = angle * self.geometry.wheel_base / 2
            self._distances += (forward - aside, forward + aside)
        self._seen = now
        return True

    def _read_counts(self) -> tuple[int, int]:
        """Read both counters, left and right, in pulses.

        Raises:
            LinkLost: if odometry no longer comes.
        """
        assert self._odom is not None
        with self._lock:
            self._fresh(self._odom)
            left, right = (
                round(PER_METRE * distance) for distance in self._distances - self._zeros
            )
        return left, right

    def _set_counts(self, left: int, right: int) -> None:
        """Set both counters, in pulses; the base's odometry is not changed."""
        self._read_counts()
        self._zeros = self._distances - np.array([int(left), int(right)]) / PER_METRE

    def _read_sensors(self) -> dict[str, float]:
        """Read all sensors, by name, from 0 (nothing within reach) to 1 (at the laser).

        Raises:
            LinkLost: if scans no longer come.
        """
        assert self._laser is not None
        with self._lock:
            self._fresh(self._laser)
            return dict(zip(self.sensor_names, map(float, self._sectors.readings), strict=True))


class _RepeatingClock:
    """A clock whose time advances only in sleeps, like the lab's; a sleep also repeats commands."""

    def __init__(self, clock: Clock, robot: Ros):
        self._clock, self._robot = clock, robot

    def now(self) -> float:
        return self._clock.now()

    def sleep_until(self, time: float) -> None:
        while (due := self._robot.due) < time:
            self._clock.sleep_until(due)
            self._robot.repeat()
        self._clock.sleep_until(time)


def _plain(kind: str) -> str:
    """Return the name of a type without the part that ROS 1 does not have."""
    return kind.replace("/msg/", "/")
