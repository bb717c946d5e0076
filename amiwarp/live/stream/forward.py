"""Forwarding of a stream's events and encoder samples to a sink, unchanged."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.live.stream.sinks import Sink
from amiwarp.live.stream.stream_format import encode_encoder, encode_events


class Forward:
    """A :class:`~amiwarp.live.stream.consumers.RawConsumer` that sends events and encoder samples to a sink."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink

    def append(self, events: Events) -> None:
        """Send events of a sensor to the sink."""
        self._sink.send(encode_events(events))

    def append_encoder(
        self,
        t_us: NDArray[np.int64],
        angle: NDArray[np.float64],
        index_t_us: object = None,
        *,
        second: bool = False,
    ) -> None:
        """Send encoder samples on the events' clock to the sink. The angles already include the index pulses."""
        self._sink.send(encode_encoder(t_us, angle, second=second))

    def tick(self) -> None:
        """Let the sink continue to send the waiting packets."""
        self._sink.tick()
