"""Sockets and pipes for streams: to connect to, to listen at, and sinks that serve them."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import select
import socket
import stat
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

from amiwarp.errors import AmiwarpError
from amiwarp.live.stream.packets import encode_end

CONNECT_S = 10.0
RETRY_S = 1.0
"""Longest single attempt to reach a sender that is gone."""
IDLE_S = 0.05
"""Longest wait in one go, before a wish to stop is looked at again."""
MOST_BYTES = 1 << 24
"""Bytes that wait for a client before it loses packets."""
PIECE = 256
"""Bytes that a waiting packet counts for beyond its own: the Python objects that hold it."""
MOST_CLIENTS = 32
"""More are turned away: with :data:`MOST_BYTES` each, half a GiB may wait at most."""
EXHAUSTED = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
"""The process or the machine has no room for another connection now; who connects waits in the system's queue."""
PIPE_BYTES = getattr(select, "PIPE_BUF", 512)
"""A pipe that is ready takes this many without blocking."""
REST_S = 0.5
"""Pause after that, before connections are accepted again."""
PARTING_S = 2.0
"""How long the last packets may take to leave."""


class Unreachable(AmiwarpError):
    """Nobody is there now; a later attempt may succeed."""


def ready(file: Any, timeout_s: float, *, to_write: bool = False) -> bool:
    """Wait until a file or socket can be read (or written) without blocking, or is broken; False if it cannot in time.

    Unlike ``select.select`` alone this takes descriptors above 1023.
    """
    if not hasattr(select, "poll"):
        return any(select.select([] if to_write else [file], [file] if to_write else [], [], timeout_s))
    poll = select.poll()
    poll.register(file, select.POLLOUT if to_write else select.POLLIN)
    return bool(poll.poll(round(1e3 * timeout_s)))


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


def connect(address: str, timeout_s: float = CONNECT_S) -> socket.socket:
    """Connect to the sender that listens at ``address``. Raises :class:`Unreachable` if nobody does."""
    place = _parsed(address)
    try:
        if not isinstance(place, str):
            return socket.create_connection(place, timeout_s)
        connection = socket.socket(_kind(place))
        try:
            connection.settimeout(timeout_s)
            connection.connect(place)
        except BaseException:
            connection.close()
            raise
        return connection
    except OSError as error:
        raise Unreachable(f"{address}: {error.strerror or error}; start its sender first") from error


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
    """Wait for a sender that connects to ``address``, for as long as that takes."""
    return next(connection for connection in accepting(address) if connection is not None)


def accepting(address: str) -> Generator[socket.socket | None, None, None]:
    """Listen at ``address`` and yield who connects; None at least every :data:`IDLE_S` while nobody does."""
    server, _ = listen(address)
    try:
        server.setblocking(False)
        while True:
            connection = None
            if ready(server, IDLE_S):
                with contextlib.suppress(OSError):  # gone again, or no descriptor is free: the next round may succeed
                    connection = server.accept()[0]
                if connection is None:
                    time.sleep(IDLE_S)
            yield connection
    finally:
        shut(server)


def connecting(address: str) -> Generator[socket.socket | None, None, None]:
    """Connect to ``address`` again and again and yield each connection; None at least every second without one."""
    while True:
        try:
            yield connect(address, RETRY_S)
        except Unreachable:
            for _ in range(4):
                yield None
                time.sleep(IDLE_S)


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
        self.waiting_bytes += len(data) + PIECE

    def push(self) -> bool:
        """Sends what goes without waiting; whether the client is still there."""
        try:
            while self.waiting:
                sent = self.connection.send(self.waiting[0])
                self.waiting_bytes -= sent
                rest = self.waiting.popleft()[sent:]
                if rest:
                    self.waiting.appendleft(rest)
                else:
                    self.waiting_bytes -= PIECE
        except BlockingIOError:
            pass
        except OSError:
            return False
        return True

    def left(self) -> bool:
        """Whether the client has ended its side of the connection."""
        try:
            return not self.connection.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return False
        except OSError:
            return True


class SocketSink:
    """Serve packets to up to :data:`MOST_CLIENTS` clients, without ever waiting for one.

    Each gets ``hello`` first and then what is sent from then on. Where more than ``most_bytes`` wait for a client, it
    loses whole packets. Listens at 127.0.0.1 unless the address names a host. Call :meth:`send` or :meth:`tick` often:
    nothing happens in between. ``say`` gets a sentence when connections cannot be accepted; they are later, once that
    is possible. Raises :class:`AmiwarpError` where it cannot listen.
    """

    def __init__(
        self, address: str, hello: bytes, *, most_bytes: int = MOST_BYTES, say: Callable[[str], None] = lambda _: None
    ) -> None:
        self._server, self.address = listen(address)
        self._server.setblocking(False)
        self._hello, self._most_bytes, self._say = hello, most_bytes, say
        self._resting_until = 0.0
        self._said = ""
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
        while any(client.waiting for client in self._clients) and time.monotonic() < until:
            time.sleep(0.002)
            self._push()
        for client in self._clients:
            client.connection.close()
        self._clients = []

    def _accept(self) -> None:
        """Greet those who wait, some at a time."""
        if time.monotonic() < self._resting_until:
            return
        for _ in range(MOST_CLIENTS):
            try:
                connection, _ = self._server.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in EXHAUSTED:
                    self._resting_until = time.monotonic() + REST_S
                    self._say_once(f"{self.address}: cannot accept a connection: {error.strerror}; trying again")
                    return
                continue  # it was gone before it was accepted
            try:
                self._greet(connection)
            except OSError:
                connection.close()

    def _greet(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        if connection.family != getattr(socket, "AF_UNIX", None):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if len(self._clients) >= MOST_CLIENTS:
            self._part([client for client in self._clients if client.left()])
        if len(self._clients) >= MOST_CLIENTS:
            connection.close()
            self._say_once(f"{self.address}: {MOST_CLIENTS} receivers are connected; others are turned away")
            return
        client = _Client(connection)
        client.put(self._hello)
        self._clients.append(client)
        self._said = ""

    def _say_once(self, sentence: str) -> None:
        if sentence != self._said:
            self._said = sentence
            self._say(sentence)

    def _push(self) -> None:
        self._part([client for client in self._clients if not client.push()])

    def _part(self, gone: list[_Client]) -> None:
        for client in gone:
            client.connection.close()
            self._clients.remove(client)


class PipeSink:
    """Write packets to a file or pipe, and wait for it: standard output where no ``file`` is given.

    Once ``stop`` is set it waits for :data:`PARTING_S` at most. Raises :class:`AmiwarpError` if nobody reads it any
    more, or in that time.
    """

    def __init__(self, hello: bytes, file: Any = None, *, stop: threading.Event | None = None) -> None:
        self._file = sys.stdout.buffer if file is None else file
        self._stop = stop or threading.Event()
        self._waits = _may_block(self._file)
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
        """Write whole packets, as ``encode_...`` makes them."""
        try:
            step = PIPE_BYTES if self._waits else max(len(data), 1)
            for start in range(0, len(data), step):
                if self._waits:
                    self._await()
                self._file.write(data[start : start + step])
                self._file.flush()
        except OSError as error:
            raise AmiwarpError(f"standard output: {error.strerror}; is its reader gone?") from error

    def _await(self) -> None:
        """Wait until the reader takes something."""
        until = math.inf
        while not ready(self._file, IDLE_S, to_write=True):
            if self._stop.is_set():
                until = min(until, time.monotonic() + PARTING_S)
            if time.monotonic() > until:
                raise AmiwarpError("standard output: its reader takes nothing any more; the stream there is cut off")

    def tick(self) -> None:
        """Nothing waits here."""

    def close(self) -> None:
        """Tells that the stream ends; the file stays open."""
        self.send(encode_end())


def _may_block(file: Any) -> bool:
    """Whether writing to it may take long: a pipe, not a file on a disk."""
    try:
        return not stat.S_ISREG(os.fstat(file.fileno()).st_mode)
    except OSError:  # a stand-in for standard output
        return False


def open_sink(
    spec: str, hello: bytes, *, stop: threading.Event | None = None, say: Callable[[str], None] = lambda _: None
) -> SocketSink | PipeSink:
    """Open a sink by its name: ``-``, ``tcp:HOST:PORT`` or ``unix:PATH``, the latter two to listen at."""
    return PipeSink(hello, stop=stop) if spec == "-" else SocketSink(spec, hello, say=say)
