"""Sources of live events by their names."""

from __future__ import annotations

from collections.abc import Callable

from amiwarp.live.stream.cameras import DvSource, PropheseeSource
from amiwarp.live.stream.packets import Source
from amiwarp.live.stream.returning import SOCKETS, ReturningSource
from amiwarp.live.stream.sources import FileSource, StreamSource, open_stream


def open_source(
    spec: str,
    *,
    pace: float | None = 1.0,
    packet_us: int = 1000,
    wait_s: float = 0.0,
    say: Callable[[str], None] = lambda _: None,
) -> Source:
    """Open a source by its name.

    FILE: a recording, ``pace`` times as fast as it was (None: as fast as it can be read), in packets of ``packet_us``.
    ``-``, ``tcp:HOST:PORT``, ``unix:PATH``: a stream of packets (``docs/stream-format.md``); ``tcp-listen:HOST:PORT``,
    ``unix-listen:PATH`` wait for its sender. ``dv`` or ``dv:SERIAL``, ``prophesee`` or ``prophesee:SERIAL``: a camera.
    ``wait_s``: how long the sender of a socket is waited for when its stream broke off [s]; ``say`` then gets a
    sentence.
    Raises :class:`AmiwarpError` for a source that cannot be opened, or not waited for.
    """
    kind, _, rest = spec.partition(":")
    if wait_s > 0.0:
        return ReturningSource(spec, wait_s, say)
    if spec == "-":
        # past the buffer of sys.stdin, and without closing the descriptor at the end
        return StreamSource("standard input", open(0, "rb", buffering=0, closefd=False))
    if kind in SOCKETS:
        return open_stream(spec)
    if kind == "dv":
        return DvSource(rest or None, packet_us=packet_us)
    if kind == "prophesee":
        return PropheseeSource(rest or None, packet_us=packet_us)
    return FileSource(spec, pace=pace, packet_us=packet_us)
