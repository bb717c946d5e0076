"""Opening of live sources by name."""

from __future__ import annotations

from collections.abc import Callable

from amiwarp.live.stream.cameras import DvSource, PropheseeSource
from amiwarp.live.stream.packets import Source
from amiwarp.live.stream.reconnecting_source import SOCKETS, ReturningSource
from amiwarp.live.stream.sources import FileSource, StreamSource, open_stream


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
    ``tcp-listen:HOST:PORT`` and ``unix-listen:PATH`` wait for its sender to connect. ``dv``, ``dv:SERIAL``,
    ``prophesee`` and ``prophesee:SERIAL`` open a camera. ``wait_s``: how long to wait for the sender of a socket to
    return after its stream broke off [s]; ``say`` then gets messages.
    Raises :class:`AmiwarpError` if the source cannot be opened, or if ``wait_s`` is given for other than a socket.
    """
    kind, _, rest = spec.partition(":")
    if wait_s > 0.0:
        return ReturningSource(spec, wait_s, say)
    if spec == "-":
        # Read the descriptor directly, without the buffer of sys.stdin, and leave it open at the end.
        return StreamSource("standard input", open(0, "rb", buffering=0, closefd=False))
    if kind in SOCKETS:
        return open_stream(spec)
    if kind == "dv":
        return DvSource(rest or None, packet_us=packet_us)
    if kind == "prophesee":
        return PropheseeSource(rest or None, packet_us=packet_us)
    return FileSource(spec, pace=pace, packet_us=packet_us)
