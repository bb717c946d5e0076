"""Opening of live sources by name: recordings, streams of packets and cameras."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable

from amiwarp.errors import AmiwarpError
from amiwarp.live.stream import returning_source
from amiwarp.live.stream.cameras import CAMERAS, open_camera_source
from amiwarp.live.stream.packets import Source
from amiwarp.live.stream.returning_source import SENDERS, ReturningSource
from amiwarp.live.stream.sockets import Unreachable
from amiwarp.live.stream.stream_source import FileSource, StreamSource, open_stream


def open_source(
    spec: str,
    *,
    pace: float | None = 1.0,
    packet_us: int = 1000,
    wait_s: float = 0.0,
    say: Callable[[str], None] = lambda _: None,
) -> Source:
    """Open a source of live events by its name.

    The name of a file replays a recording at ``pace`` times its speed (None: as fast as possible), in packets of
    ``packet_us`` [us]. ``-``, ``tcp:HOST:PORT`` and ``unix:PATH`` read a stream (``docs/reference/stream-format.md``);
    ``tcp-listen:HOST:PORT`` and ``unix-listen:PATH`` wait for its sender to connect. ``shm:NAME`` reads it from shared
    memory, ``udp:HOST:PORT`` from datagrams that are sent to this address. ``camera:``, ``camera:SERIAL`` and
    ``camera:MODEL`` open a camera; ``dv``, ``dv:SERIAL``, ``prophesee`` and ``prophesee:SERIAL`` open one through other
    libraries. Each may go on with settings (:class:`CameraSettings`). ``wait_s``: how long to wait for the sender of a
    socket, or for a camera, to return after its stream broke off [s]; ``say`` gets messages.
    Raises :class:`AmiwarpError` if the source cannot be opened, or if ``wait_s`` is given for another source.
    """
    kind = spec.partition(":")[0]
    if wait_s > 0.0:
        return ReturningSource(spec, wait_s, say, packet_us=packet_us)
    if spec == "-":
        # Read the descriptor directly, without the buffer of sys.stdin, and leave it open at the end.
        return StreamSource("standard input", open(0, "rb", buffering=0, closefd=False))
    if kind in SENDERS:
        return open_stream(spec)
    if kind in CAMERAS:
        return open_camera_source(spec, say, packet_us=packet_us)
    source = FileSource(spec, pace=pace, packet_us=packet_us)
    for text in source.assumptions:
        say(f"assumed {text}: amiwarp convert has the option; play the file that it writes")
    return source


def reopen_source(spec: str, stop: threading.Event) -> Source | None:
    """Open a socket or a camera again as soon as it is there, until ``stop`` is set.

    Returns None for files and pipes, which cannot be opened again, and after ``stop``.
    """
    kind = spec.partition(":")[0]
    if kind in SENDERS:
        with contextlib.closing(returning_source.sender_attempts(spec)) as attempts:
            for reopen in attempts:
                if reopen is not None:
                    # The sender may leave before its hello message.
                    with contextlib.suppress(Unreachable):
                        return reopen(hello_s=returning_source.REOPEN_S)
                if stop.is_set():
                    return None
    while kind in CAMERAS and not stop.wait(returning_source.REOPEN_S):
        with contextlib.suppress(AmiwarpError):
            return open_source(spec)
    return None
