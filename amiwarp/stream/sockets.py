"""Sockets for streams, ``tcp:HOST:PORT`` and ``unix:PATH``: to connect to, to listen at, and sinks that serve them."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import stat
import sys
import time
from collections import deque
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

from amiwarp.errors import AmiwarpError
from amiwarp.stream.packets import encode_end

CONNECT_S = 10.0
MOST_BYTES = 1 << 24
"""Bytes that wait for a client before it loses packets."""
PARTING_S = 2.0
"""How long the last packets may take to leave."""


def _parsed(address: str) -> str | tuple[str, int]:
    """Path of a Unix socket, or host and port."""
    kind, _, rest = address.partition(":")
    if kind == "unix" and rest:
        return rest
    host, _, port = rest.rpartition(":")
    if kind != "tcp" or not port.isdecimal() or int(port) > 65535:
        raise AmiwarpError(f"{address}: is no address; give tcp:HOST:PORT or unix:PATH")
    return host.strip("[]") or "127.0.0.1", int(port)


def _kind(place: str | tuple[str, int]) -> socket.AddressFamily:
    if isinstance(place, str):
        if not hasattr(socket, "AF_UNIX"):
            raise AmiwarpError(f"unix:{place}: this system has no Unix sockets; give tcp:HOST:PORT")
        return socket.AF_UNIX
    return socket.AF_INET6 if ":" in place[0] else socket.AF_INET


def connect(address: str) -> socket.socket:
    """A connection to who listens at ``address``; :class:`AmiwarpError` where nobody does."""
    place = _parsed(address)
    try:
        if not isinstance(place, str):
            return socket.create_connection(place, CONNECT_S)
        connection = socket.socket(_kind(place))
        try:
            connection.connect(place)
        except BaseException:
            connection.close()
            raise
        return connection
    except OSError as error:
        raise AmiwarpError(f"{address}: {error.strerror or error}; start its sender first") from error


def listen(address: str) -> tuple[socket.socket, str]:
    """A socket that listens, and its address with the port, should that have been 0.

    Raises :class:`AmiwarpError` where that cannot be. A Unix socket that nobody listens at any more is replaced.
    """
    place = _parsed(address)
    family = _kind(place)
    try:
        if isinstance(place, str):
            _clear(place)
        server = socket.create_server(place, family=family)
    except OSError as error:
        raise AmiwarpError(f"{address}: cannot listen there: {error.strerror or error}; choose another") from error
    if isinstance(place, str):
        return server, address
    host = f"[{place[0]}]" if ":" in place[0] else place[0]
    return server, f"tcp:{host}:{server.getsockname()[1]}"


def _clear(path: str) -> None:
    """Removes a socket that a process left which is gone."""
    with contextlib.suppress(FileNotFoundError):
        if stat.S_ISSOCK(os.stat(path).st_mode):
            with socket.socket(socket.AF_UNIX) as probe:
                try:
                    probe.connect(path)
                except ConnectionRefusedError:
                    os.unlink(path)


def accept(address: str) -> socket.socket:
    """Waits for one who connects to ``address``, for as long as that takes."""
    server, _ = listen(address)
    try:
        return server.accept()[0]
    finally:
        shut(server)


def shut(server: socket.socket) -> None:
    """Closes a listening socket; a Unix one's file goes too."""
    name = server.getsockname()
    server.close()
    if isinstance(name, str) and name:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)


@dataclass(slots=True, eq=False)
class _Client:
    connection: socket.socket
    waiting: deque[memoryview] = field(default_factory=deque)
    waiting_bytes: int = 0

    def put(self, data: bytes) -> None:
        self.waiting.append(memoryview(data))
        self.waiting_bytes += len(data)

    def push(self) -> bool:
        """Sends what goes without waiting; whether the client is still there."""
        try:
            while self.waiting:
                sent = self.connection.send(self.waiting[0])
                self.waiting_bytes -= sent
                rest = self.waiting.popleft()[sent:]
                if rest:
                    self.waiting.appendleft(rest)
        except BlockingIOError:
            pass
        except OSError:
            return False
        return True


class SocketSink:
    """Serves packets to any number of clients, without ever waiting for one.

    Each gets ``hello`` first and then what is sent from then on. Where more than ``most_bytes`` wait for a client, it
    loses whole packets. Listens at 127.0.0.1 unless the address names a host. Call :meth:`send` or :meth:`tick` often:
    nothing happens in between. Raises :class:`AmiwarpError` where it cannot listen.
    """

    def __init__(self, address: str, hello: bytes, *, most_bytes: int = MOST_BYTES) -> None:
        self._server, self.address = listen(address)
        self._server.setblocking(False)
        self._hello, self._most_bytes = hello, most_bytes
        self._clients: list[_Client] = []
        self.lost = 0
        """Packets that a client did not get, over all clients."""

    def __enter__(self) -> SocketSink:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def clients(self) -> int:
        """Number of those who are connected."""
        return len(self._clients)

    @property
    def waiting(self) -> int:
        """Bytes that wait for the client for whom most do."""
        return max((client.waiting_bytes for client in self._clients), default=0)

    def send(self, data: bytes) -> None:
        """Hands whole packets, as ``encode_...`` makes them, to all clients."""
        self._accept()
        for client in self._clients:
            if data and client.waiting_bytes + len(data) > self._most_bytes and client.waiting:
                self.lost += 1
            elif data:
                client.put(data)
        self._push()

    def tick(self) -> None:
        """Goes on with what waits, and greets new clients."""
        self.send(b"")

    def close(self) -> None:
        """Tells the clients that the stream ends, and waits a little for what is on its way."""
        if self._server.fileno() < 0:
            return
        shut(self._server)
        for client in self._clients:
            client.put(encode_end())
        self._push()
        until = time.monotonic() + PARTING_S
        while (busy := [client.connection for client in self._clients if client.waiting]) and time.monotonic() < until:
            select.select([], busy, [], max(until - time.monotonic(), 0.0))
            self._push()
        for client in self._clients:
            client.connection.close()
        self._clients = []

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                connection, _ = self._server.accept()
                connection.setblocking(False)
                if connection.family != getattr(socket, "AF_UNIX", None):
                    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                client = _Client(connection)
                client.put(self._hello)
                self._clients.append(client)

    def _push(self) -> None:
        gone = [client for client in self._clients if not client.push()]
        for client in gone:
            client.connection.close()
            self._clients.remove(client)


class PipeSink:
    """Writes packets to a file or pipe, and waits for it: standard output where no ``file`` is given.

    Raises :class:`AmiwarpError` where nobody reads it any more.
    """

    def __init__(self, hello: bytes, file: Any = None) -> None:
        self._file = sys.stdout.buffer if file is None else file
        self.lost = 0
        """None ever."""
        self.send(hello)

    def __enter__(self) -> PipeSink:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()

    def send(self, data: bytes) -> None:
        """Writes whole packets, as ``encode_...`` makes them."""
        try:
            self._file.write(data)
            self._file.flush()
        except OSError as error:
            raise AmiwarpError(f"standard output: {error.strerror}; is its reader gone?") from error

    def tick(self) -> None:
        """Nothing waits here."""

    def close(self) -> None:
        """Tells that the stream ends; the file stays open."""
        self.send(encode_end())


def open_sink(spec: str, hello: bytes) -> SocketSink | PipeSink:
    """A sink by its name: ``-``, ``tcp:HOST:PORT`` or ``unix:PATH``, the latter two to listen at."""
    return PipeSink(hello) if spec == "-" else SocketSink(spec, hello)
