"""A virtual base's node of ROS: a controller for velocities that times out, odometry, a laser."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from neurosim.base import se2
from neurosim.lab.contact import distances
from neurosim.lab.lines.planar import PlanarBody
from neurosim.lab.ros.bridge import RosBridge, Topic
from neurosim.robots.ros.driver import ODOMETRY, STAMPED, TWIST, VIRTUAL
from neurosim.robots.ros.laser import SCAN

#: Largest speeds of the base, m/s and rad/s.
MAX_V, MAX_OMEGA = 0.3, 2.0
#: Radius of the circle around it, m.
RADIUS = 0.11
#: Time between two messages of odometry, s.
EVERY = 0.05
#: Odometry's errors of scale (standard deviations, of distance and turn), and its noise.
SCALE, NOISE = (0.01, 0.02), 0.01
#: The laser: number of odometry messages for each scan; number of beams, limits of ranges and their
#: noise (standard deviation), m, after the LDS-01 of a TurtleBot 3.
EACH, BEAMS, RANGES, RANGE_NOISE = 4, 360, (0.12, 3.5), 0.01


class BaseBody(PlanarBody):
    """A body that is driven forward and turned.

    Attributes:
        carried: whether a person has moved it since odometry was last published.
    """

    carried = False

    def __init__(self, robot_seed: int, seed: int):
        super().__init__("omni", robot_seed, seed)

    def place(self, x: float, y: float, theta: float) -> None:
        """Place the base at a pose (m, m, rad); its wheels do not turn."""
        super().place(x, y, theta)
        self.carried = True


class BaseNode:
    """Takes velocities from a topic, moves a body, publishes its odometry and its laser's scans.

    Args:
        body: of the base.
        seed: of odometry's errors.
        stamped: whether it takes TwistStamped.
        timeout: time without a message after which it stops, s; infinity: never.
        walls, cylinders: [W, 4] and [N, 3], objects for the laser, m.

    Attributes:
        bridge: the bridge to it.
        say: sends texts to the client; the server of the bridge sets it.
        velocities: the present commanded velocities, m/s and rad/s.
        publishes: whether it publishes odometry and scans.
    """

    def __init__(
        self,
        body: BaseBody,
        seed: int,
        *,
        stamped: bool = False,
        timeout: float = 0.5,
        walls: NDArray[np.float64],
        cylinders: NDArray[np.float64],
        **bridge: bool,
    ):
        self._body, self._timeout = body, timeout
        topics = {
            "/cmd_vel": Topic(STAMPED if stamped else TWIST, [VIRTUAL], take=self._take),
            "/odom": Topic(ODOMETRY, publishers=[VIRTUAL]),
            "/scan": Topic(SCAN, publishers=[VIRTUAL]),
        }
        self.bridge = RosBridge(topics, lambda: body.time, **bridge)
        self.say: Callable[[list[str]], None] = lambda texts: None
        self.velocities = (0.0, 0.0)
        self._stops = math.inf
        self._tick = 1
        self._rng = np.random.default_rng([seed, 0x0D0])
        self._scale = 1 + np.array([SCALE[0], SCALE[0], SCALE[1]]) * self._rng.standard_normal(3)
        self._last, self._pose = body.pose, np.zeros(3)
        self.publishes, self._surfaces = True, (walls, cylinders)
        # Compiled before a client waits for a scan.
        distances(np.zeros((1, 2)), np.zeros(1), walls, cylinders)

    @property
    def ends(self) -> float:
        """Time of the next event: a message of odometry, or the controller's time-out (s)."""
        return min(self._tick * EVERY, self._stops)

    def end(self) -> None:
        """Do the due steps."""
        # The body's time may be short of the due steps by its last digits.
        now = self._body.time + 1e-9
        if now >= self._stops:
            self._drive((0.0, 0.0))
            self._stops = math.inf
        if now >= self._tick * EVERY:
            texts = self._odometry()
            if self._tick % EACH == 0:
                texts += self._scan()
            self._tick += 1
            if texts:
                self.say(texts)

    def _take(self, message: dict[str, Any]) -> None:
        now = self._body.time
        if "twist" in message:
            stamp = message["header"]["stamp"]
            age = now - stamp["sec"] - stamp["nanosec"] * 1e-9
            # A stamp of 0 counts as now.
            if any(stamp.values()) and age > self._timeout:
                return
            message = message["twist"]
        v, omega = message["linear"]["x"], message["angular"]["z"]
        if not (math.isfinite(v) and math.isfinite(omega)):
            return
        self._stops = now + self._timeout
        self._drive((min(max(v, -MAX_V), MAX_V), min(max(omega, -MAX_OMEGA), MAX_OMEGA)))

    def _drive(self, velocities: tuple[float, float]) -> None:
        if velocities != self.velocities:
            self.velocities = velocities
            v, omega = velocities
            self._body.move((v, 0.0, omega))

    def _odometry(self) -> list[str]:
        pose, (v, omega) = self._body.pose, self._body.reached()
        moved = np.zeros(3) if self._body.carried else se2.between(self._last, pose)
        self._body.carried = False
        noise = 1 + NOISE * self._rng.standard_normal(3)
        self._pose = se2.compose(self._pose, moved * self._scale * noise)
        self._last = pose
        x, y, theta = self._pose
        now = self._body.time
        message = {
            "header": {
                "stamp": {"sec": int(now), "nanosec": round(1e9 * (now % 1))},
                "frame_id": "odom",
            },
            "child_frame_id": "base_link",
            "pose": {
                "pose": {
                    "position": {"x": float(x), "y": float(y)},
                    "orientation": {"z": math.sin(theta / 2), "w": math.cos(theta / 2)},
                }
            },
            "twist": {"twist": {"linear": {"x": v}, "angular": {"z": omega}}},
        }
        return self.bridge.publish("/odom", message) if self.publishes else []

    def _scan(self) -> list[str]:
        if not (self.publishes and self.bridge.is_subscribed("/scan")):
            return []
        step = 2 * math.pi / BEAMS
        x, y, theta = self._body.pose
        beams = theta + step * np.arange(BEAMS)
        ranges = distances(np.tile((x, y), (BEAMS, 1)), beams, *self._surfaces)
        ranges += RANGE_NOISE * self._rng.standard_normal(BEAMS)
        low, high = RANGES
        ranges[(ranges < low) | (ranges > high)] = math.inf
        message = {
            "header": {"frame_id": "base_scan"},
            "angle_max": 2 * math.pi - step,
            "angle_increment": step,
            "scan_time": EACH * EVERY,
            "range_min": low,
            "range_max": high,
            "ranges": ranges.tolist(),
        }
        return self.bridge.publish("/scan", message)
