"""Sinks of live streams: a server on a socket, and a pipe or file. Others are in files of their own."""

from __future__ import annotations

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
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.live.stream.datagrams import DatagramSink
from amiwarp.live.stream.shared_ring import RingSink
from amiwarp.live.stream.sockets import IDLE_S, close_listener, listen, ready
from amiwarp.live.stream.stream_format import encode_end, packet_count

MOST_BYTES = 1 << 24
"""Memory of the packets that may wait for one client [bytes]. A slower client loses packets."""
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


class Sink(Protocol):
    """Sink of encoded packets (protocol)."""

    address: str
    """Its name, see :func:`open_sink`, with the actual port if the port given was 0."""
    lost: int
    """Number of packets that were not sent."""

    def __enter__(self) -> Sink: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: Any, /
    ) -> None: ...

    def send(self, data: bytes) -> None:
        """Send complete packets, encoded by the ``encode_...`` functions."""

    def tick(self) -> None:
        """Continue pending work without new data."""

    def close(self) -> None:
        """Send the end message and release everything."""


@dataclass(slots=True, eq=False)
class _Client:
    """Client that is connected, with the packets that wait for it."""

    connection: socket.socket
    waiting: deque[memoryview] = field(default_factory=deque)
    counts: deque[int] = field(default_factory=deque)
    """Number of packets in each of ``waiting``."""
    waiting_bytes: int = 0

    def put(self, data: bytes) -> None:
        self.waiting.append(memoryview(data))
        self.counts.append(packet_count(data))
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
                    self.counts.popleft()
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
        self,
        address: str,
        hello: bytes,
        *,
        most_bytes: int = MOST_BYTES,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._server, self.address = listen(address)
        self._server.setblocking(False)
        self._hello = hello
        self._most_bytes = most_bytes
        self._say = say
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
        if data:
            for client in self._clients:
                is_full = client.waiting_bytes + len(data) > self._most_bytes
                if client.waiting and is_full:
                    self.lost += packet_count(data)
                else:
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
            if client.waiting:
                self.lost += sum(client.counts) - 1  # all but the end
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
                    self._say_once(
                        f"{self.address}: cannot accept a connection: {error.strerror}; trying again"
                    )
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
            self._say_once(
                f"{self.address}: {MOST_CLIENTS} receivers are connected; further ones are refused"
            )
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

    def __init__(
        self,
        hello: bytes,
        file: Any = None,
        *,
        stop: threading.Event | None = None,
        name: str = "standard output",
    ) -> None:
        """Write ``hello`` to an open binary ``file``, called ``name`` in messages."""
        self._name = name
        self._file = sys.stdout.buffer if file is None else file
        self._stop = stop or threading.Event()
        self._may_block_long = _may_block(self._file)
        self.lost = 0
        """Number of lost packets: always 0, because a pipe waits for its reader."""
        self.send(hello)

    def __enter__(self) -> PipeSink:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # After an error the stream is incomplete, and gets no end.
        if kind is None:
            self.close()

    def send(self, data: bytes) -> None:
        """Write complete packets, encoded by the ``encode_...`` functions."""
        if self._file.closed:
            raise AmiwarpError(f"{self._name}: the file is closed; open it again")
        try:
            step = PIPE_BYTES if self._may_block_long else max(len(data), 1)
            for start in range(0, len(data), step):
                if self._may_block_long:
                    self._wait_for_reader()
                self._file.write(data[start : start + step])
                self._file.flush()
        except OSError as error:
            raise AmiwarpError(
                f"{self._name}: {error.strerror}; start the program that reads it again",
                ErrorCode.OUTPUT_FAILED,
            ) from error

    def _wait_for_reader(self) -> None:
        """Wait until the pipe's reader accepts data."""
        until = math.inf
        while not ready(self._file, IDLE_S, to_write=True):
            if self._stop.is_set():
                until = min(until, time.monotonic() + DRAIN_S)
            if time.monotonic() > until:
                raise AmiwarpError(
                    f"{self._name}: its reader accepts no more data, so the end of the stream is lost; check the "
                    "program that reads it",
                    ErrorCode.OUTPUT_FAILED,
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
    spec: str,
    hello: bytes,
    *,
    stop: threading.Event | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Sink:
    """Open a sink by its name.

    ``-`` is standard output, ``tcp:HOST:PORT`` and ``unix:PATH`` are servers, ``shm:NAME`` is shared memory, and
    ``udp:HOST:PORT`` sends datagrams. ``say`` is called with messages.
    """
    kind = spec.partition(":")[0]
    if spec == "-":
        return PipeSink(hello, stop=stop)
    if kind == "shm":
        return RingSink(spec, hello)
    if kind == "udp":
        return DatagramSink(spec, hello, say=say)
    return SocketSink(spec, hello, say=say)
