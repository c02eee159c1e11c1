"""One end of a WebSocket: bytes to messages and back, without a socket and without waiting.

The protocol itself is that of the package websockets (RFC 6455), in its form without input and
output. Messages and answers to pings come in the order in which the other end sent them.
"""

from __future__ import annotations

from typing import Any

from neurosim.base.errors import UserError


class WebSocketEnd:
    """Takes bytes, gives messages, and has bytes to send.

    Args:
        url: of the server, ``ws://host:port`` or ``wss://host``; None: this end is the server.

    Attributes:
        host, port, secure: of the URL.
        pongs: payloads of the answers to pings that have come.
        pings: how many pings have come; their answers are among what is to be sent.

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
        """Whether the connection is to be closed: both ends have agreed, or it has failed."""
        return bool(self._protocol.close_expected())

    @property
    def refusal(self) -> str:
        """Why the other end is no WebSocket or does not let this one in; empty if it does."""
        error = getattr(self._protocol, "handshake_exc", None)
        return "" if error is None else str(error)

    def feed(self, data: bytes) -> list[str]:
        """Take bytes, none where the other end has hung up; return the messages that are whole."""
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
        """Have a message sent."""
        self._protocol.send_text(text.encode())

    def ping(self, payload: bytes) -> None:
        """Have a ping sent; its answer comes after all that the other end did before."""
        self._protocol.send_ping(payload)

    def close(self) -> None:
        """Have the end of the connection sent."""
        if self.is_open:
            self._protocol.send_close(1000)

    def to_send(self) -> bytes:
        """Return the bytes that are to be sent now."""
        return b"".join(self._protocol.data_to_send())
