"""Threads that serve a virtual robot on a pseudo-terminal or on a socket."""

from __future__ import annotations

import os
import select
import socket
import threading
from contextlib import suppress
from typing import Self

from neurosim.base.errors import RobotError

#: Time after which a client that does not read is left (s).
SEND_WITHIN = 0.5
#: Virtual robots are served to programs on this computer only.
LOOPBACK = "127.0.0.1"


class Server:
    """A thread that reads from one source and can be stopped at once.

    ``error`` is the exception that ended it (the lab runs in this thread), or None.
    """

    def __init__(self) -> None:
        self._wake_read, self._wake_write = socket.socketpair()
        self._stopping = False
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)

    def _serve(self) -> None:
        raise NotImplementedError

    def _close(self) -> None:
        self._wake_read.close()
        self._wake_write.close()

    def _run(self) -> None:
        try:
            self._serve()
        except BaseException as error:
            # The owner of the lab raises it; a thread could only print it.
            self.error = error
        finally:
            self._close()

    def _wait(self, readable: int | socket.socket, seconds: float | None) -> bool:
        """Return True when there are bytes to read, False when time or the server ends."""
        ready, _, _ = select.select([readable, self._wake_read], [], [], seconds)
        return readable in ready and not self._stopping

    def stop(self) -> None:
        """Close the line and end the thread. A second call does nothing."""
        self._stopping = True
        self._wake()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=5.0)

    def _wake(self) -> None:
        with suppress(OSError):
            self._wake_write.send(b"\0")

    def hang_up(self) -> None:
        """Close the line, like a brick that loses its battery."""
        self.stop()

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()


class PtyEnd(Server):
    """The robot's end of a pseudo-terminal; ``path`` is the device file that a client opens.

    A client may close it and another open it again.

    Raises:
        RobotError: if the system has no pseudo-terminals (Windows), or none is free.
    """

    def __init__(self) -> None:
        try:
            import tty
        except ImportError:
            raise RobotError(
                "this system has no pseudo-terminals: reach the virtual robot by a socket"
            ) from None
        try:
            self._master, self._slave = os.openpty()
        except OSError as error:
            raise RobotError(f"no pseudo-terminal is available: {error}") from None
        super().__init__()
        # The slave end stays open here: without it the line would hang up with each client.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._thread.start()

    def _write(self, data: bytes) -> None:
        # A client that does not read loses its replies, as over the air.
        with suppress(OSError):
            os.write(self._master, data)

    def _close(self) -> None:
        os.close(self._master)
        os.close(self._slave)
        super()._close()


class SocketEnd(Server):
    """The robot's end of a loopback socket; ``address`` is (host, port).

    One client at a time; the next is served when it leaves.

    Args:
        port: 0 for any free one.

    Raises:
        RobotError: if the port is taken.
    """

    def __init__(self, port: int = 0):
        super().__init__()
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            if os.name == "posix":  # On Windows it would let two servers share a port.
                self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._listener.bind((LOOPBACK, port))
            self._listener.listen()
        except (OSError, OverflowError) as error:
            self._listener.close()
            raise RobotError(f"cannot serve on port {port} of {LOOPBACK}: {error}") from None
        self.address: tuple[str, int] = self._listener.getsockname()
        self._thread.start()

    def _serve(self) -> None:
        while not self._stopping:
            if not self._wait(self._listener, None):
                continue
            client, _ = self._listener.accept()
            with client:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                client.settimeout(SEND_WITHIN)
                self._serve_client(client)
            self._client_left()

    def _serve_client(self, client: socket.socket) -> None:
        raise NotImplementedError

    def _client_left(self) -> None:
        """Do the due steps after a client has left."""

    def _close(self) -> None:
        self._listener.close()
        super()._close()


def receive(client: socket.socket) -> bytes:
    """Return the received bytes, or none if the client left."""
    try:
        return client.recv(4096)
    except OSError:
        return b""


def send(client: socket.socket, data: bytes) -> bool:
    """Send all of it; return whether the client took it."""
    try:
        client.sendall(data)
    except OSError:
        return False
    return True


class Served:
    """A virtual robot behind its line; ``with`` closes the line at the end."""

    _server: Server

    @property
    def alive(self) -> bool:
        """Whether the line is still open."""
        return self._server.error is None

    def close(self) -> None:
        """Close the line."""
        self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Close; an error inside the lab (a full disk) is raised instead of a lost link."""
        self.close()
        if self._server.error is not None:
            raise self._server.error
