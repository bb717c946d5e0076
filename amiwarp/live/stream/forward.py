"""A stream handed on as it came: events and encoder samples, to whoever connects."""

from __future__ import annotations

from typing import TYPE_CHECKING

from amiwarp.live.stream.packets import encode_encoder, encode_events

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from amiwarp.events.events import Events
    from amiwarp.live.stream.sockets import PipeSink, SocketSink


class Forward:
    """Takes what a :class:`LiveWriter` takes, and sends it."""

    def __init__(self, sink: SocketSink | PipeSink) -> None:
        self._sink = sink

    def append(self, events: Events) -> None:
        """A sensor's events."""
        self._sink.send(encode_events(events))

    def append_encoder(self, t_us: NDArray[np.int64], angle: NDArray[np.float64], index_t_us: object = None) -> None:
        """Samples on the events' clock; index pulses are in the angles."""
        self._sink.send(encode_encoder(t_us, angle))

    def tick(self) -> None:
        """Goes on with what waits."""
        self._sink.tick()
