"""A virtual robot and its camera, connected like real ones.

The robot is the real NXT driver, through the real nxt-python, over a pseudo-terminal (or a
socket on loopback where the system has none) to the virtual brick. Only the clock is the lab's, so
that no real time passes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace

import numpy as np

from neurosim.base.errors import RobotError
from neurosim.base.place import Place
from neurosim.lab.nxt.body import Wiring
from neurosim.lab.nxt.brick import VirtualBrick
from neurosim.lab.nxt.params import CameraParams, LabParams
from neurosim.lab.nxt.serve import PtyServer, Radio, SocketServer
from neurosim.lab.nxt.world import Lab, Push
from neurosim.lab.rig import BoardRig, put_down
from neurosim.robots.nxt.driver import NXT

#: Position of the light sensors for following a line: ahead of the axle and to either side (m), and
#: its standard deviation between robots.
FOLLOWING, BUILT = {"light_ahead": 0.07, "light_aside": 0.025}, 0.002


class VirtualRig(BoardRig):
    """A robot of the virtual lab, behind its line, with the roof camera over it.

    Args:
        robot_seed: number of robot and board; the same number gives the same robot, whose motors,
            slip and caster are to be learned.
        noise_seed: of all differences between sessions: the robot's exact start, slip, radio
            delays, sensor and camera noise.
        start: the pose at which a person tries to place the robot (m, m, rad, board frame).
        camera: whether there is a camera.
        camera_size: its frames, (width, height) in pixels.
        fps: frames per second.
        lamp: which lamp to use: that on motor port ``A``, ``color:3`` for the colour sensor's,
            or None.
        device: ``pty``, ``socket``, or None for the one that the system has.
        port: of the socket; 0 for any free one.
        real_time: whether the lab's time is the wall clock's (see :class:`Pacer`).
        changes: fields of :class:`LabParams` in which robot and ground differ from those of the
            seed, such as another floor's slip.
        around: the place; if it has lines, the robot's light sensors are mounted in front, to
            follow them.
        push: a push during the drive, or None.

    Attributes:
        lab: the lab itself; no learner looks into it.
        robot: the NXT driver, not connected yet.
        camera: the roof camera, or None.
        address: the brick's address, as keywords of the driver.
    """

    def __init__(
        self,
        robot_seed: int,
        *,
        noise_seed: int = 0,
        start: tuple[float, float, float] = (0.0, 0.0, 0.0),
        camera: bool = True,
        camera_size: tuple[int, int] = (640, 480),
        fps: float = 30.0,
        lamp: str | None = "A",
        device: str | None = None,
        port: int = 0,
        real_time: bool = False,
        changes: Mapping[str, float] | None = None,
        around: Place = Place(),  # noqa: B008 - frozen
        push: Push | None = None,
    ):
        self._about = {"robot_seed": robot_seed, "noise_seed": noise_seed}
        if changes:
            self._about["changes"] = dict(changes)
        if around != Place():
            self._about["place"] = around.to_json()
        if around.lines:
            changes = {**_following(robot_seed), **(changes or {})}
        if push is not None:
            self._about["push"] = asdict(push)
        rng = np.random.default_rng([noise_seed, robot_seed, 0x0A11])
        place = put_down(start, rng)
        self.lab = Lab(
            int(rng.integers(2**31)),
            params=replace(LabParams.sampled(robot_seed), **(changes or {})),
            camera=CameraParams(size=camera_size, fps=fps) if camera else None,
            start=place,
            wiring=Wiring(),
            around=around,
            push=push,
        )
        self.brick = VirtualBrick(self.lab.body, name=f"lab-{robot_seed}", lock=self.lab.lock)
        # A single telegram waits for others: in the lab's own time for longer than the slowest
        # computer needs, in real time too short to notice.
        patience = 0.002 if real_time else 60.0
        self.radio = Radio(self.brick, self.lab.clock, rng, patience=patience)
        self._server = _serve(self.radio, device, port)
        self.address = _address(self._server)
        # This computer is slow here (it compiles the physics once), not the brick.
        lights = FOLLOWING if around.lines else {}
        self.robot = NXT(clock=self.lab.clock, lamp=lamp, deadline=60.0, **lights, **self.address)
        self.robot.alone = False
        self.camera = self.lab.camera


def _following(robot_seed: int) -> dict[str, float]:
    """Return the positions of the light sensors of a robot that was built to follow a line."""
    rng = np.random.default_rng([robot_seed, 0x11E5])
    return {name: place + BUILT * rng.standard_normal() for name, place in FOLLOWING.items()}


def _serve(radio: Radio, device: str | None, port: int) -> PtyServer | SocketServer:
    if device != "socket":
        try:
            return PtyServer(radio)
        except RobotError:
            if device == "pty":
                raise
    return SocketServer(radio, port=port)


def _address(server: PtyServer | SocketServer) -> dict[str, str | int]:
    if isinstance(server, PtyServer):
        return {"filename": server.path}
    host, port = server.address
    return {"server_host": host, "server_port": port}
