"""Packets over UDP: one datagram each, with a number, so that the receiver counts what was lost."""

from __future__ import annotations

import itertools
import secrets
import socket
import struct
import time
from collections import deque
from collections.abc import Callable

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.live.stream.sockets import host_and_port, ready
from amiwarp.live.stream.stream_format import (
    HELLO,
    checksum_fits,
    checksum_of,
    encode_end,
    is_packet,
    join_packets,
    kind_of,
    split_packets,
)

MAGIC = b"AMIU"
HEAD = struct.Struct("<4sIQ")
"""Begin of a datagram: magic, random number of the stream, number of the datagram."""
DATAGRAM_BYTES = 1400
"""Largest size of a datagram [bytes]: it passes Ethernet, also through tunnels, in one piece."""
HELLO_S = 0.5
"""Time after which the hello is sent again, for receivers that begin later [s]."""
SILENT_S = 3.0
"""Time without a datagram after which a sender counts as dead [s]."""
END_REPEATS = 3
"""Number of times that the end is sent, because datagrams may be lost."""
END_PAUSE_S = 0.05
"""Pause before each end, so that a full buffer of the receiver has room again [s]."""
MOST_JOINED = 1000
"""Largest number of datagrams that are made one packet."""
BUFFER_BYTES = 1 << 23
"""Size of the system's buffer of received datagrams that is asked for [bytes]. Linux gives at most ``rmem_max``."""
_MOST_PACKET = DATAGRAM_BYTES - HEAD.size
LARGEST_BYTES = 1 << 16
"""Size above any datagram [bytes]."""


class DatagramSink:
    """Sender of packets as UDP datagrams to one address, which never waits for the receiver.

    Long packets are sent as several ones of at most :data:`DATAGRAM_BYTES`. The hello is repeated, if :meth:`send` or
    :meth:`tick` are called often. ``say`` gets a message when the system refuses a datagram. Raises
    :class:`AmiwarpError` if the host is unknown.
    """

    def __init__(
        self, address: str, hello: bytes, *, say: Callable[[str], None] = lambda _: None
    ) -> None:
        family, self._target = _resolved(address)
        self.address = address
        self.lost = 0
        """Number of datagrams that the system did not take. What is lost on the way, the receiver counts."""
        (self._hello,) = split_packets(hello, _MOST_PACKET)
        self._say = say
        self._stream = secrets.randbits(32)
        self._number = 0
        self._hello_s = 0.0
        self._closed = False
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self.tick()

    def __enter__(self) -> DatagramSink:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def send(self, data: bytes) -> None:
        """Send complete packets, encoded by the ``encode_...`` functions; long ones as several packets."""
        self.tick()
        for packet in split_packets(data, _MOST_PACKET):
            self._put(packet)

    def tick(self) -> None:
        """Send the hello again if it is due."""
        now = time.monotonic()
        if now >= self._hello_s:
            self._hello_s = now + HELLO_S
            self._put(self._hello)

    def close(self) -> None:
        """Send the end message, repeatedly, and close the socket."""
        if self._closed:
            return
        self._closed = True
        for _ in range(END_REPEATS):
            time.sleep(END_PAUSE_S)
            self._put(encode_end())
        self._socket.close()

    def _put(self, packet: bytes | memoryview) -> None:
        head = HEAD.pack(MAGIC, self._stream, self._number)
        self._number += 1
        try:
            # Not connected: a connected socket refuses a datagram if nobody received the one before.
            self._socket.sendto(b"".join((head, packet)), self._target)
        except OSError as error:
            if not self.lost:
                self._say(f"{self.address}: a datagram was not sent: {error.strerror or error}")
            self.lost += 1


class DatagramReceiver:
    """Receiver of packets in UDP datagrams, for :class:`~amiwarp.live.stream.stream_source.PacketSource`.

    It takes one stream, from its next hello on, and ignores all other datagrams. A datagram that comes after a later
    one is dropped, and counted as lost. Raises :class:`AmiwarpError` if it cannot receive at the address.
    """

    def __init__(self, address: str) -> None:
        family, target = _resolved(address)
        self.lost = 0
        """Number of datagrams that were lost on the way."""
        self.problem: str | None = None
        """Why no more packets will come, in one line; None while they may."""
        self._stream: int | None = None
        self._number = 0
        self._latest_s = 0.0
        self._packets: deque[bytes] = deque()
        self._buffer = memoryview(bytearray(LARGEST_BYTES))
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            self._socket.bind(target)
        except OSError as error:
            self._socket.close()
            raise AmiwarpError(
                f"{address}: cannot receive at this address: {error.strerror or error}; give an address of this "
                "computer, such as udp:0.0.0.0:PORT, with a free port",
                ErrorCode.UNREACHABLE,
            ) from error

    def receive(self, timeout_s: float) -> bytes | None:
        """Return the next packet, at first the hello; None if there is none within the timeout."""
        until = time.monotonic() + timeout_s
        while not self._packets:
            # One packet of all waiting ones: thousands of small ones would cost more time than their events.
            waiting = itertools.islice(iter(self._next, None), MOST_JOINED)
            self._packets.extend(join_packets(waiting))
            now = time.monotonic()
            is_silent = self._stream is not None and now - self._latest_s > SILENT_S
            # A foreign or late datagram ends the loop above before the good ones behind it.
            if is_silent and not self._packets and not ready(self._socket, 0.0):
                self.problem = f"its sender has sent nothing for {SILENT_S:g} s"
            if not self._packets:
                if self.problem is not None or now >= until:
                    return None
                ready(self._socket, until - now)
        return self._packets.popleft()

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _next(self) -> bytes | None:
        """Return the packet of the next datagram that waits; None if there is none, or if it does not belong here."""
        try:
            size = self._socket.recv_into(self._buffer)
        except OSError:  # nothing waits; on Windows also: another program's port was closed
            return None
        packet = bytes(self._buffer[HEAD.size : size])
        if not is_packet(packet) or not checksum_fits(packet, checksum_of(packet)):
            return None
        magic, stream, number = HEAD.unpack_from(self._buffer)
        if self._stream is None and magic == MAGIC and kind_of(packet) == HELLO:
            self._stream = stream
            self._number = number
        if magic != MAGIC or stream != self._stream or number < self._number:
            return None
        self._latest_s = time.monotonic()
        self.lost += number - self._number
        self._number = number + 1
        return packet


def _resolved(address: str) -> tuple[int, tuple[object, ...]]:
    """Return family and socket address of ``udp:HOST:PORT``. Raises :class:`AmiwarpError` for an unknown host."""
    host, port = host_and_port(address, "udp:HOST:PORT")
    if not port:
        raise AmiwarpError(
            f"{address}: has port 0; give the port at which the other side sends or receives"
        )
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except OSError as error:
        raise AmiwarpError(
            f"{address}: {error.strerror or error}; check the name of the host",
            ErrorCode.UNREACHABLE,
        ) from error
    return found[0][0], found[0][4]
