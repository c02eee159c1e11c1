"""A virtual base behind its rosbridge, with the roof camera over it."""

from __future__ import annotations

import math
import socket
import threading
from contextlib import suppress
from typing import Unpack

import numpy as np

from neurosim.base.place import Place
from neurosim.lab.nxt.params import BOARD
from neurosim.lab.rig import BoardRig, OnBoard
from neurosim.lab.ros.base import MAX_OMEGA, MAX_V, RADIUS, BaseBody, BaseNode
from neurosim.lab.server import SocketEnd, receive, send
from neurosim.robots.base import Clock
from neurosim.robots.ros.driver import NONE, Ros
from neurosim.robots.ros.websocket import WebSocketEnd

#: Delay of a message, and of the answer to a ping, s.
LATENCY = 0.003


class BridgeEnd(SocketEnd):
    """The bridge's end of a WebSocket, one client at a time.

    Args:
        node: the node behind the bridge.
        clock: the lab's.
        lock: held while the node is used.
        port: 0 for any free one.

    Attributes:
        silent: whether messages are no longer taken or answered.
    """

    def __init__(self, node: BaseNode, clock: Clock, lock: threading.RLock, port: int):
        self._node, self._clock, self._lab = node, clock, lock
        # Held while bytes are made and sent; its holder does not wait for the lab.
        self._wire = threading.Lock()
        self._client: socket.socket | None = None
        self._end: WebSocketEnd | None = None
        self.silent = False
        node.say = self.say
        super().__init__(port)

    @property
    def url(self) -> str:
        """The address for a client."""
        host, port = self.address
        return f"ws://{host}:{port}"

    def say(self, texts: list[str]) -> None:
        """Send texts to the client, if there is one."""
        with self._wire:
            if self._client is not None and self._end is not None and self._end.is_open:
                for text in texts:
                    self._end.text(text)
                send(self._client, self._end.to_send())

    def _serve_client(self, client: socket.socket) -> None:
        end = self._end = WebSocketEnd()
        self._client = client
        while not self._stopping:
            if not self._wait(client, None):
                continue
            data = receive(client)
            if self.silent and data:
                continue
            with self._wire:
                before, taken = end.pings, end.feed(data)
            answers = []
            for text in taken:
                self._sleep(LATENCY)
                with self._lab:
                    answers += self._node.bridge.take(text)
            self._sleep(LATENCY * (end.pings - before))
            with self._wire:
                # The answer to a ping leaves with these: the messages before it are done.
                for answer in answers if end.is_open else ():
                    end.text(answer)
                if not send(client, end.to_send()) or not data or end.is_over:
                    return

    def _sleep(self, seconds: float) -> None:
        if seconds:
            self._clock.sleep_until(self._clock.now() + seconds)

    def _client_left(self) -> None:
        with self._wire:
            self._client = self._end = None
        with self._lab:
            self._node.bridge.leave()

    def drop_client(self) -> None:
        """Cut the connection."""
        with self._wire, suppress(OSError):
            if self._client is not None:
                self._client.shutdown(socket.SHUT_RDWR)


class VirtualRosRig(BoardRig):
    """A base of the virtual lab that ROS drives, behind its rosbridge.

    Args:
        robot_seed: number of robot and board; the same number gives the same robot.
        port: of the socket; 0 for any free one.
        real_time: whether the lab's time is the wall clock's (see
            :class:`neurosim.lab.nxt.world.Pacer`).
        stamped: whether the base takes TwistStamped.
        stops_after: time without a message after which its controller stops it, s; infinity: never.
        laser, laser_sectors, laser_reach: of the driver, see
            :class:`neurosim.robots.ros.driver.Ros`.
        statuses, rosapi: see :class:`neurosim.lab.ros.bridge.RosBridge`.
        **board: see :class:`neurosim.lab.rig.OnBoard`.

    Attributes:
        lab: the lab itself; no learner looks into it.
        node: the base's node of ROS, with its bridge.
        walls: half the length and half the width of the room that its laser sees, m.
        robot: the driver, not connected yet, in the lab's own time.
        camera: the roof camera, or None.
        address: the driver's url.
    """

    def __init__(
        self,
        robot_seed: int,
        *,
        port: int = 0,
        real_time: bool = False,
        stamped: bool = False,
        stops_after: float = 0.5,
        laser: str = NONE,
        laser_sectors: int = 8,
        laser_reach: float = 1.0,
        statuses: bool = False,
        rosapi: bool = True,
        **board: Unpack[OnBoard],
    ):
        body, seed = self._set_up(
            "ros",
            0x2052,
            BaseBody,
            robot_seed,
            **board,
        )
        room = self.lab.params.room
        around = self.lab.around
        on = around.board or BOARD
        self.walls = (on.length / 2 + room, on.width / 2 + room)
        self.node = BaseNode(
            body,
            seed,
            stamped=stamped,
            timeout=stops_after,
            walls=np.concatenate(
                [Place.rectangle(2 * self.walls[0], 2 * self.walls[1]).surfaces, around.surfaces]
            ),
            cylinders=around.cylinders,
            statuses=statuses,
            rosapi=rosapi,
        )
        self.lab.program = self.node
        self._server = BridgeEnd(self.node, self.lab.clock, self.lab.lock, port)
        self.address = self._server.url
        self.robot = Ros(
            url=self.address,
            stamped=stamped,
            max_v=MAX_V,
            max_omega=MAX_OMEGA,
            radius=RADIUS,
            stops_after=None if math.isinf(stops_after) else stops_after,
            laser=laser,
            laser_sectors=laser_sectors,
            laser_reach=laser_reach,
            timeout=2.0 if real_time else 10.0,
            clock=self.lab.clock,
        )

    @property
    def standing(self) -> bool:
        """Whether the base is commanded to stand."""
        return not any(self.node.velocities)

    def switch_off(self) -> None:
        """Switch the network off: messages are no longer taken or answered."""
        self._server.silent = True

    def hang_up(self) -> None:
        """Cut the connection, like a bridge that ends."""
        self._server.drop_client()
