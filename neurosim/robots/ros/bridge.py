"""A client of rosbridge: topics of ROS as JSON over a WebSocket, protocol version 2.

It follows ROSBRIDGE_PROTOCOL.md and the sources of rosbridge_suite for ROS 2. That server does not
notify its client of a dropped message: it only writes to its log. So the client first asks the node
rosapi whether a topic exists, for its type, and for the nodes at its other end. Other servers send
a ``status``; it is raised as an error.
"""

from __future__ import annotations

import json
import os
import select
import socket
import ssl
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

from neurosim.base.errors import LinkLost, RobotError
from neurosim.robots.ros.websocket import WebSocketEnd

#: Longest time of a ROS service, s: rosapi asks each node of the graph.
SERVICE = 5.0
#: Number of bytes of a read.
_PIECE = 65_536
#: Largest number of reads of waiting bytes.
_AT_MOST = 64

T = TypeVar("T")


class Bridge:
    """A connection to a rosbridge, which one thread uses at a time.

    Args:
        url: of the server, such as ``ws://localhost:9090``.
        timeout: Wall-clock seconds that the server may take to acknowledge messages.

    Attributes:
        farewell: topic and message that are sent when the connection is given up, or None; without
            waiting for an acknowledgement.
    """

    def __init__(self, url: str, timeout: float):
        self.url = url
        self.farewell: tuple[str, dict[str, Any]] | None = None
        self._timeout = timeout
        self._lock = threading.RLock()
        self._socket: socket.socket | None = None
        self._end: WebSocketEnd | None = None
        self._gone: str | None = None
        self._takers: dict[str, Callable[[dict[str, Any]], None]] = {}
        self._answers: dict[str, dict[str, Any]] = {}
        self._refused = ""
        self._number = 0

    @property
    def is_open(self) -> bool:
        """Whether the connection is open."""
        return self._socket is not None

    def open(self) -> None:
        """Connect.

        Raises:
            RobotError: if nothing listens there, or it is not a WebSocket.
            UserError: if the address is wrong.
        """
        end = WebSocketEnd(self.url)
        why = (
            "start it (ros2 launch rosbridge_server rosbridge_websocket_launch.xml), and check the "
            "address"
        )
        try:
            opened = socket.create_connection((end.host, end.port), timeout=self._timeout)
            if end.secure:
                opened = ssl.create_default_context().wrap_socket(opened, server_hostname=end.host)
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            reason = error.strerror or str(error) or type(error).__name__
            raise RobotError(f"no rosbridge answers at {self.url} ({reason}): {why}") from None
        self._socket, self._end, self._gone = opened, end, None
        self._answers, self._takers, self._refused = {}, {}, ""
        try:
            self._send()
            self._until(lambda: end.is_open or end.refusal or None, self._timeout)
            if not end.is_open:
                reason = end.refusal or "it does not answer"
                raise RobotError(
                    f"the server at {self.url} is not a rosbridge ({reason[:80]}): {why}"
                ) from None
        except LinkLost:
            raise RobotError(f"the server at {self.url} is not a rosbridge: {why}") from None
        except BaseException:
            self._drop()
            raise

    def close(self) -> None:
        """End the connection; never raises."""
        with self._lock:
            if self._end is not None:
                with suppress(Exception):
                    self._end.close()
                    self._send()
            self._drop()

    def call(self, service: str, **arguments: Any) -> dict[str, Any]:
        """Call a service; return its values.

        Raises:
            RobotError: if the service does not exist, or fails.
            LinkLost: if the connection is gone.
        """
        with self._lock:
            number = self._next()
            self._say({"op": "call_service", "id": number, "service": service, "args": arguments})
            answer = self._until(
                lambda: self._answers.pop(number, None), max(SERVICE, self._timeout)
            )
        values = {} if answer is None else answer.get("values")
        if answer is None or answer.get("result") is not True or not isinstance(values, dict):
            answered = "it does not answer" if answer is None else str(values)[:80]
            raise RobotError(
                f"the bridge at {self.url} has no service {service} ({answered}): start it by its "
                "launch file, which starts rosapi, too"
            )
        return values

    def advertise(self, topic: str, kind: str) -> None:
        """Announce messages of a type on a topic.

        Raises:
            RobotError: if the server rejects them.
        """
        with self._lock:
            self._say({"op": "advertise", "id": self._next(), "topic": topic, "type": kind})
            self.sync()

    def unadvertise(self, topic: str) -> None:
        """End the announcement of a topic."""
        with self._lock:
            self._say({"op": "unadvertise", "topic": topic})
            self.sync()

    def publish(self, topic: str, message: dict[str, Any]) -> None:
        """Publish a message; return when the server has it.

        Raises:
            RobotError: if the server rejects it.
            LinkLost: if it does not acknowledge it, or the connection is gone.
        """
        with self._lock:
            self._say({"op": "publish", "topic": topic, "msg": message})
            self.sync()

    def subscribe(
        self, topic: str, kind: str, every: float, take: Callable[[dict[str, Any]], None]
    ) -> None:
        """Call a function with the messages of a topic when they are read.

        Args:
            topic: its name.
            kind: type of its messages.
            every: shortest time between two messages, s.
            take: called with each message, in the thread of the bridge's user.
        """
        with self._lock:
            self._takers[topic] = take
            about = {"topic": topic, "type": kind, "throttle_rate": round(1000 * every)}
            self._say({"op": "subscribe", "id": self._next(), **about, "queue_length": 1})
            self.sync()

    def sync(self) -> None:
        """Wait until the server has all sent messages, and its own earlier messages are taken.

        Raises:
            RobotError: if it rejected a message.
            LinkLost: if it does not answer in time, or the connection is gone.
        """
        with self._lock:
            payload = os.urandom(4)
            end = self._talking()
            end.ping(payload)
            self._send()
            if self._until(lambda: payload in end.pongs or None, self._timeout) is None:
                raise self.lose(
                    f"the bridge at {self.url} stopped answering: nothing within "
                    f"{self._timeout:g} s; is the network up, and the robot's computer on?"
                )
            end.pongs.clear()
            self._raise_refusal()

    def poll(self) -> None:
        """Take the received messages, without waiting."""
        with self._lock:
            self._until(lambda: None, 0.0)

    def lose(self, why: str) -> LinkLost:
        """Close the connection for good and return the error, which later calls raise again.

        First the farewell is sent: it may arrive even if no answer comes back.
        """
        with self._lock:
            farewell, self.farewell = self.farewell, None
            if farewell is not None:
                topic, message = farewell
                with suppress(Exception):
                    self._say({"op": "publish", "topic": topic, "msg": message})
            self._drop()
            self._gone = why
        return LinkLost(why)

    def _next(self) -> str:
        self._number += 1
        return f"neurosim-{self._number}"

    def _connected(self) -> WebSocketEnd:
        if self._gone is not None:
            raise LinkLost(self._gone)
        if self._end is None:
            raise RobotError(f"the bridge at {self.url} is not connected: connect first")
        return self._end

    def _talking(self) -> WebSocketEnd:
        end = self._connected()
        if not end.is_open:
            raise self._cut("it is ending")
        return end

    def _say(self, message: dict[str, Any]) -> None:
        self._talking().text(json.dumps(message))
        self._send()

    def _send(self) -> None:
        end = self._connected()
        assert self._socket is not None
        try:
            self._socket.settimeout(self._timeout)
            self._socket.sendall(end.to_send())
        except OSError as error:
            raise self._cut(str(error)) from None

    def _until(self, wanted: Callable[[], T | None], seconds: float) -> T | None:
        """Take messages until a search succeeds, and return its result; None after the deadline."""
        until, reads = time.monotonic() + seconds, 0
        while True:
            answer = wanted()
            left = max(until - time.monotonic(), 0.0)
            # Bounded, so that a flood of messages cannot block this thread.
            reads = 0 if left else reads + 1
            if answer is not None or reads > _AT_MOST:
                return answer
            end = self._connected()
            assert self._socket is not None
            pending = isinstance(self._socket, ssl.SSLSocket) and self._socket.pending()
            if not pending and not select.select([self._socket], [], [], left)[0]:
                return wanted()
            try:
                data = self._socket.recv(_PIECE)
            except (ssl.SSLWantReadError, TimeoutError):
                continue
            except OSError as error:
                raise self._cut(str(error)) from None
            for text in end.feed(data):
                self._take(text)
            if end.refusal:
                return wanted()
            self._send()
            if not data:
                raise self._cut("it hung up")

    def _take(self, text: str) -> None:
        """Take a message of the server; messages of other kinds are ignored."""
        try:
            message = json.loads(text)
            kind = message["op"]
        except (ValueError, KeyError, TypeError):
            return
        if kind == "service_response":
            self._answers[str(message.get("id"))] = message
        elif kind == "status" and message.get("level") == "error":
            self._refused = str(message.get("msg"))
        elif kind == "publish" and message.get("topic") in self._takers:
            self._takers[message["topic"]](message.get("msg"))

    def _raise_refusal(self) -> None:
        if self._refused:
            refusal, self._refused = self._refused, ""
            raise RobotError(f"the bridge at {self.url} rejected a message: {refusal[:160]}")

    def _cut(self, why: str) -> LinkLost:
        return self.lose(
            f"the bridge at {self.url} closed the connection ({why}): the robot keeps its last "
            "command until its controller stops it; see whether rosbridge still runs"
        )

    def _drop(self) -> None:
        if self._socket is not None:
            with suppress(Exception):
                self._socket.close()
        self._socket = self._end = None
