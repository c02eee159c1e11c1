"""One end of a WebSocket: turns bytes into messages and back, without a socket or waiting.

The protocol itself is that of the package websockets (RFC 6455), in its form without input and
output. Messages and answers to pings come in the order in which the other end sent them.
"""

from __future__ import annotations

from typing import Any

from neurosim.base.errors import UserError


class WebSocketEnd:
    """Turns received bytes into messages, and messages into bytes to send.

    Args:
        url: of the server, ``ws://host:port`` or ``wss://host``; None: this end is the server.

    Attributes:
        host, port, secure: of the URL.
        pongs: payloads of the received answers to pings.
        pings: number of received pings; their answers are among the bytes to send.

    Raises:
        UserError: if the URL is wrong, or the package websockets is missing.
    """

    def __init__(self, url: str | None = None):
        try:
            from websockets.client import ClientProtocol
            from websockets.exceptions import InvalidURI
            from websockets.server import ServerProtocol
            from websockets.uri import parse_uri
        except ImportError:
            raise UserError(
                "a robot behind ROS needs the package websockets: pip install 'neurosim[ros]'"
            ) from None
        self.pongs: list[bytes] = []
        self.pings = 0
        self._parts: list[bytes] = []
        if url is None:
            self._protocol: Any = ServerProtocol()
            return
        try:
            place = parse_uri(url)
        except (InvalidURI, ValueError):
            raise UserError(
                f"{url!r} is not the address of a rosbridge: give one such as ws://localhost:9090"
            ) from None
        self.host, self.port, self.secure = place.host, place.port, place.secure
        self._protocol = ClientProtocol(place)
        self._protocol.send_request(self._protocol.connect())

    @property
    def is_open(self) -> bool:
        """Whether messages can be sent."""
        return bool(self._protocol.state.name == "OPEN")

    @property
    def is_over(self) -> bool:
        """Whether the connection must be closed: both ends have agreed, or it has failed."""
        return bool(self._protocol.close_expected())

    @property
    def refusal(self) -> str:
        """Reason why the other end is not a WebSocket or rejects this one; empty if it accepts."""
        error = getattr(self._protocol, "handshake_exc", None)
        return "" if error is None else str(error)

    def feed(self, data: bytes) -> list[str]:
        """Take bytes, empty if the other end has hung up; return the complete messages."""
        from websockets.frames import Frame, Opcode
        from websockets.http11 import Request

        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        texts = []
        for event in self._protocol.events_received():
            if isinstance(event, Request):
                self._protocol.send_response(self._protocol.accept(event))
            elif isinstance(event, Frame) and event.opcode is Opcode.PONG:
                self.pongs.append(bytes(event.data))
            elif isinstance(event, Frame) and event.opcode is Opcode.PING:
                self.pings += 1
            elif isinstance(event, Frame) and event.opcode in (Opcode.TEXT, Opcode.CONT):
                self._parts.append(bytes(event.data))
                if event.fin:
                    texts.append(b"".join(self._parts).decode("utf-8", "replace"))
                    self._parts = []
        return texts

    def text(self, text: str) -> None:
        """Queue a message."""
        self._protocol.send_text(text.encode())

    def ping(self, payload: bytes) -> None:
        """Queue a ping; its answer comes after all earlier work of the other end."""
        self._protocol.send_ping(payload)

    def close(self) -> None:
        """Queue the end of the connection."""
        if self.is_open:
            self._protocol.send_close(1000)

    def to_send(self) -> bytes:
        """Return the queued bytes."""
        return b"".join(self._protocol.data_to_send())
