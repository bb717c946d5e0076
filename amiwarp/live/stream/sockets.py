"""Streams over sockets: connecting, listening, and servers that send events to their clients."""

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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.live.stream.packets import encode_encoder, encode_end, encode_events

# Connections over TCP and Unix sockets: connecting, listening, accepting.

CONNECT_S = 10.0
"""Longest wait for a connection to a sender of events [s]."""
RETRY_S = 1.0
"""Longest single attempt to reach a sender of events that was lost [s]."""
IDLE_S = 0.05
"""Longest single wait for an incoming connection [s]."""


class Unreachable(AmiwarpError):
    """Raised if no sender or client is reachable now; a later attempt may succeed."""


def ready(file: Any, timeout_s: float, *, to_write: bool = False) -> bool:
    """Wait until a file or socket can be read (or written) without blocking, or is broken; return False on time-out.

    Unlike ``select.select``, this supports file descriptors above 1023. Windows can wait for sockets only: there a pipe
    counts as ready, and its reader or writer waits.
    """
    if not hasattr(select, "poll"):
        try:
            return any(select.select([] if to_write else [file], [file] if to_write else [], [], timeout_s))
        except OSError:
            return True
    poll = select.poll()
    poll.register(file, select.POLLOUT if to_write else select.POLLIN)
    return bool(poll.poll(round(1e3 * timeout_s)))


def _parse(address: str) -> str | tuple[str, int]:
    """Return the path of a Unix socket, or the host and the port of a TCP address."""
    kind, _, rest = address.partition(":")
    if kind == "unix" and rest:
        return rest
    host, _, port = rest.rpartition(":")
    if kind != "tcp" or not port.isdecimal() or int(port) > 65535:
        raise AmiwarpError(f"{address}: is not an address; give tcp:HOST:PORT or unix:PATH")
    return host.strip("[]") or "127.0.0.1", int(port)


def _family(target: str | tuple[str, int]) -> socket.AddressFamily:
    if isinstance(target, str):
        if not hasattr(socket, "AF_UNIX"):
            raise AmiwarpError(f"unix:{target}: this system has no Unix sockets; give tcp:HOST:PORT")
        return socket.AF_UNIX
    return socket.AF_INET6 if ":" in target[0] else socket.AF_INET


def connect(address: str, timeout_s: float = CONNECT_S) -> socket.socket:
    """Connect to the sender that listens at ``address``. Raises :class:`Unreachable` if there is none."""
    target = _parse(address)
    try:
        if not isinstance(target, str):
            return socket.create_connection(target, timeout_s)
        connection = socket.socket(_family(target))
        try:
            connection.settimeout(timeout_s)
            connection.connect(target)
        except BaseException:
            connection.close()
            raise
        return connection
    except OSError as error:
        raise Unreachable(f"{address}: {error.strerror or error}; start its sender first") from error


def listen(address: str) -> tuple[socket.socket, str]:
    """Return a listening socket and its address, with the actual port if the port given was 0.

    Replaces a Unix socket without a listener. Raises :class:`AmiwarpError` if it cannot listen at ``address``.
    """
    target = _parse(address)
    family = _family(target)
    try:
        if isinstance(target, str):
            _remove_stale(target)
        server = socket.create_server(target, family=family)
    except OSError as error:
        why = error.strerror or error
        raise AmiwarpError(f"{address}: cannot listen at this address: {why}; choose another address") from error
    if isinstance(target, str):
        return server, address
    host = f"[{target[0]}]" if ":" in target[0] else target[0]
    return server, f"tcp:{host}:{server.getsockname()[1]}"


def _remove_stale(path: str) -> None:
    """Remove the socket file of a process that no longer exists."""
    with contextlib.suppress(FileNotFoundError):
        if stat.S_ISSOCK(os.stat(path).st_mode):
            with socket.socket(socket.AF_UNIX) as probe:
                try:
                    probe.connect(path)
                except ConnectionRefusedError:
                    os.unlink(path)


def accept(address: str) -> socket.socket:
    """Wait without limit for a sender that connects to ``address``, and return the connection."""
    return next(connection for connection in iter_accepted(address) if connection is not None)


def iter_accepted(address: str) -> Generator[socket.socket | None, None, None]:
    """Listen at ``address`` and yield connections.

    While nobody connects, None is yielded at least every :data:`IDLE_S`.
    """
    server, _ = listen(address)
    try:
        server.setblocking(False)
        while True:
            connection = None
            if ready(server, IDLE_S):
                with contextlib.suppress(OSError):  # the client left, or no file descriptor is free: try again
                    connection = server.accept()[0]
                if connection is None:
                    time.sleep(IDLE_S)
            yield connection
    finally:
        close_listener(server)


def iter_connected(address: str) -> Generator[socket.socket | None, None, None]:
    """Connect to ``address`` repeatedly and yield each connection.

    While no connection is possible, None is yielded at least every second.
    """
    while True:
        try:
            yield connect(address, RETRY_S)
        except Unreachable:
            for _ in range(4):
                yield None
                time.sleep(IDLE_S)


def close_listener(server: socket.socket) -> None:
    """Close a listening socket and remove the file of a Unix socket."""
    name = server.getsockname()
    server.close()
    if isinstance(name, str) and name:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)


# Sinks of live streams: a server on a socket, and a pipe or file.

MOST_BYTES = 1 << 24
"""Memory of the packets that may wait for a client; a client that is slower loses packets [bytes]."""
PACKET_OVERHEAD = 256
"""Memory of a waiting packet beyond its data, for its Python objects [bytes]."""
MOST_CLIENTS = 32
"""Largest number of clients at a time. With :data:`MOST_BYTES` each, at most half a GiB waits."""
EXHAUSTED = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
"""Error numbers of a process or machine without resources for another connection. The client then waits in the system's
queue."""
REST_S = 0.5
"""Pause after an error of :data:`EXHAUSTED` before connections are accepted again [s]."""
PIPE_BYTES = getattr(select, "PIPE_BUF", 512)
"""Number of bytes that a pipe accepts without blocking once it is writable."""
DRAIN_S = 2.0
"""Longest time for sending the last packets when the stream ends [s]."""


@dataclass(slots=True, eq=False)
class _Client:
    """Client that is connected, with the packets that wait for it."""

    connection: socket.socket
    waiting: deque[memoryview] = field(default_factory=deque)
    waiting_bytes: int = 0

    def put(self, data: bytes) -> None:
        self.waiting.append(memoryview(data))
        self.waiting_bytes += len(data) + PACKET_OVERHEAD

    def push(self) -> bool:
        """Send as much as possible to the client without blocking; return False if the client is gone."""
        try:
            while self.waiting:
                sent = self.connection.send(self.waiting[0])
                self.waiting_bytes -= sent
                rest = self.waiting.popleft()[sent:]
                if rest:
                    self.waiting.appendleft(rest)
                else:
                    self.waiting_bytes -= PACKET_OVERHEAD
        except BlockingIOError:
            pass
        except OSError:
            return False
        return True

    def has_left(self) -> bool:
        """Return whether the client has closed its side of the connection."""
        try:
            return not self.connection.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return False
        except OSError:
            return True


class SocketSink:
    """Server that sends packets to up to :data:`MOST_CLIENTS` clients and never waits for one.

    A client gets ``hello`` first, then all later packets. If more than ``most_bytes`` wait for a client, it loses whole
    packets. The server listens at 127.0.0.1 unless the address names a host. Call :meth:`send` or :meth:`tick` often,
    because all work happens there. ``say`` gets a message while connections cannot be accepted; the server accepts them
    later. Raises :class:`AmiwarpError` if it cannot listen at the address.
    """

    def __init__(
        self, address: str, hello: bytes, *, most_bytes: int = MOST_BYTES, say: Callable[[str], None] = lambda _: None
    ) -> None:
        self._server, self.address = listen(address)
        self._server.setblocking(False)
        self._hello, self._most_bytes, self._say = hello, most_bytes, say
        self._resume_s = 0.0
        self._last_message = ""
        self._clients: list[_Client] = []
        self.lost = 0
        """Number of packets that were dropped for a slow client, summed over all clients."""

    def __enter__(self) -> SocketSink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    @property
    def waiting(self) -> int:
        """Memory of the packets that wait for the slowest client [bytes]."""
        return max((client.waiting_bytes for client in self._clients), default=0)

    def send(self, data: bytes) -> None:
        """Send complete packets, encoded by the ``encode_...`` functions, to all clients."""
        self._accept()
        for client in self._clients:
            if data and client.waiting_bytes + len(data) > self._most_bytes and client.waiting:
                self.lost += 1
            elif data:
                client.put(data)
        self._push()

    def tick(self) -> None:
        """Continue to send the waiting packets, and accept new clients."""
        self.send(b"")

    def close(self) -> None:
        """Send the end message, wait at most :data:`DRAIN_S` until the waiting packets are sent, and disconnect."""
        if self._server.fileno() < 0:
            return
        close_listener(self._server)
        for client in self._clients:
            client.put(encode_end())
        self._push()
        until = time.monotonic() + DRAIN_S
        while any(client.waiting for client in self._clients) and time.monotonic() < until:
            time.sleep(0.002)
            self._push()
        for client in self._clients:
            client.connection.close()
        self._clients = []

    def _accept(self) -> None:
        """Accept the clients that wait for a connection, at most :data:`MOST_CLIENTS` at a time."""
        if time.monotonic() < self._resume_s:
            return
        for _ in range(MOST_CLIENTS):
            try:
                connection, _ = self._server.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in EXHAUSTED:
                    self._resume_s = time.monotonic() + REST_S
                    self._say_once(f"{self.address}: cannot accept a connection: {error.strerror}; trying again")
                    return
                continue  # the client left before it was accepted
            try:
                self._add_client(connection)
            except OSError:
                connection.close()

    def _add_client(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        if connection.family != getattr(socket, "AF_UNIX", None):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if len(self._clients) >= MOST_CLIENTS:
            self._disconnect([client for client in self._clients if client.has_left()])
        if len(self._clients) >= MOST_CLIENTS:
            connection.close()
            self._say_once(f"{self.address}: {MOST_CLIENTS} receivers are connected; further ones are refused")
            return
        client = _Client(connection)
        client.put(self._hello)
        self._clients.append(client)
        self._last_message = ""

    def _say_once(self, sentence: str) -> None:
        if sentence != self._last_message:
            self._last_message = sentence
            self._say(sentence)

    def _push(self) -> None:
        self._disconnect([client for client in self._clients if not client.push()])

    def _disconnect(self, gone: list[_Client]) -> None:
        for client in gone:
            client.connection.close()
            self._clients.remove(client)


class PipeSink:
    """Writer of packets to a file or pipe, standard output by default. It waits for a slow reader.

    Once ``stop`` is set, it waits for at most :data:`DRAIN_S`. Raises :class:`AmiwarpError` if the reader is gone, or
    accepts nothing in that time.
    """

    address = "-"
    """Its name, see :func:`open_sink`."""

    def __init__(self, hello: bytes, file: Any = None, *, stop: threading.Event | None = None) -> None:
        self._file = sys.stdout.buffer if file is None else file
        self._stop = stop or threading.Event()
        self._may_block_long = _may_block(self._file)
        self.lost = 0
        """Number of lost packets: always 0, because a pipe waits for its reader."""
        self.send(hello)

    def __enter__(self) -> PipeSink:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()

    def send(self, data: bytes) -> None:
        """Write complete packets, encoded by the ``encode_...`` functions."""
        try:
            step = PIPE_BYTES if self._may_block_long else max(len(data), 1)
            for start in range(0, len(data), step):
                if self._may_block_long:
                    self._wait_for_reader()
                self._file.write(data[start : start + step])
                self._file.flush()
        except OSError as error:
            raise AmiwarpError(f"standard output: {error.strerror}; start the program that reads it again") from error

    def _wait_for_reader(self) -> None:
        """Wait until the pipe's reader accepts data."""
        until = math.inf
        while not ready(self._file, IDLE_S, to_write=True):
            if self._stop.is_set():
                until = min(until, time.monotonic() + DRAIN_S)
            if time.monotonic() > until:
                raise AmiwarpError(
                    "standard output: its reader accepts no more data, so the end of the stream is lost; check the "
                    "program that reads it"
                )

    def tick(self) -> None:
        """Do nothing, because no data wait to be sent."""

    def close(self) -> None:
        """Write the end message; the file stays open."""
        self.send(encode_end())


def _may_block(file: Any) -> bool:
    """Return whether a write to ``file`` may block for long, as to a pipe, unlike to a file on a disk."""
    try:
        return not stat.S_ISREG(os.fstat(file.fileno()).st_mode)
    except OSError:  # a substitute for standard output, without a file descriptor
        return False


def open_sink(
    spec: str, hello: bytes, *, stop: threading.Event | None = None, say: Callable[[str], None] = lambda _: None
) -> SocketSink | PipeSink:
    """Open a sink by its name: ``-`` for standard output, ``tcp:HOST:PORT`` or ``unix:PATH`` for a server."""
    return PipeSink(hello, stop=stop) if spec == "-" else SocketSink(spec, hello, say=say)


# Forwarding of a stream's events and encoder samples to a sink, unchanged.


class Forward:
    """Sends events and encoder samples to a sink. It has the methods of a :class:`LiveWriter`."""

    def __init__(self, sink: SocketSink | PipeSink) -> None:
        self._sink = sink

    def append(self, events: Events) -> None:
        """Send events of a sensor to the sink."""
        self._sink.send(encode_events(events))

    def append_encoder(
        self, t_us: NDArray[np.int64], angle: NDArray[np.float64], index_t_us: object = None, *, second: bool = False
    ) -> None:
        """Send encoder samples on the events' clock to the sink. The angles already include the index pulses."""
        self._sink.send(encode_encoder(t_us, angle, second=second))

    def tick(self) -> None:
        """Let the sink continue to send the waiting packets."""
        self._sink.tick()
