"""Case ``pictures`` of :mod:`benchmarks.load`: pictures of a stream behind a prism, by sums in phase."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np

from amiwarp import (
    Camera,
    EncoderStream,
    Events,
    ExactModel,
    LivePicture,
    Packet,
    PhaseCamera,
    Prism,
)
from amiwarp.live.link import monotonic_us
from amiwarp.live.stream import PictureStream, Session, SessionStatus, make_packet
from benchmarks.load_stream import PACKET_US, ThreadTimes, cpu_s, wait_until

SIZE = WIDTH, HEIGHT = 640, 480
CAMERA = Camera.from_fov(WIDTH, HEIGHT, math.radians(60))
PRISM = Prism(math.radians(1.0))
MODEL = ExactModel.from_prism(CAMERA, PRISM, 0.3)
TURN_US = 1e6 / 12.0
"""Time of a turn at 720 turns a minute [us]."""
PICTURE_HZ = 15.0
PERIOD_PACKETS = 100
COMPARED_US = 400_000
"""Time of the stream whose pictures are compared with a camera that gets all events at once [us]."""


class PrismSource:
    """Source of random events and of encoder samples at 1 kHz, in real time."""

    size = SIZE
    camera = CAMERA
    prism = PRISM
    encoders = 1
    name = "synthetic stream behind a prism"

    def __init__(self, mev_s: float, seconds: float) -> None:
        rng = np.random.default_rng(0)
        count = round(mev_s * PACKET_US)
        self._x = rng.integers(0, WIDTH, (PERIOD_PACKETS, count)).astype(np.uint16)
        self._y = rng.integers(0, HEIGHT, (PERIOD_PACKETS, count)).astype(np.uint16)
        self._p = rng.integers(0, 2, (PERIOD_PACKETS, count)).astype(np.uint8)
        self._t = (np.arange(count) / mev_s).astype(np.int64)
        self.count = round(1e6 * seconds / PACKET_US)
        self.sent = 0
        self.start_us = 0

    def events(self, number: int) -> Events:
        """Return the events of a packet."""
        k = number % PERIOD_PACKETS
        return Events(
            self._x[k], self._y[k], self._t + self.start_us + number * PACKET_US, self._p[k]
        )

    def samples(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the encoder sample at the end of a packet, with the one at its start for the first."""
        first = number if number == 0 else number + 1
        t = np.arange(first, number + 2) * PACKET_US
        return self.start_us + t, t * (2.0 * math.pi / TURN_US)

    def packets(self) -> Iterator[Packet]:
        """Yield the packets."""
        self.start_us = monotonic_us()
        for k in range(self.count):
            wait_until(self.start_us + (k + 1) * PACKET_US)
            events = self.events(k)
            self.sent += len(events)
            t, angle = self.samples(k)
            yield make_packet(monotonic_us(), events, encoder_t=t, encoder_angle=angle)

    def close(self) -> None:
        """Do nothing."""


def pictures(mev_s: float, seconds: float) -> dict[str, Any]:
    """Return the figures of pictures of a stream, after a short one whose pictures are compared."""
    compared, _, _ = drawn_from(PrismSource(mev_s, 1e-6 * COMPARED_US), newest=False)
    wanted = expected(compared.source)
    is_equal = list(compared.logs) == list(wanted) and all(
        np.array_equal(log, wanted[end]) for end, log in compared.logs.items()
    )
    source = PrismSource(mev_s, seconds)
    times = ThreadTimes(0.5)
    times.start()
    spent = cpu_s()
    _, drawn, status = drawn_from(source, newest=True)
    spent = cpu_s() - spent
    times.end()
    median, slow, most = (1e-3 * np.percentile(drawn.latencies_us, [50, 99, 100])).round(1).tolist()
    is_whole = status.events == source.sent and not status.dropped
    # The first picture comes after a whole turn.
    due = (seconds - TURN_US * 1e-6) * PICTURE_HZ
    return {
        "mev_s": mev_s,
        "seconds": round(status.seconds, 2),
        "cores": round(spent / status.seconds, 3),
        "memory_last_mib": round(times.memory_mib[-1], 1),
        "memory_most_mib": round(max(times.memory_mib), 1),
        "sent": source.sent,
        "lost": status.dropped,
        "pictures": drawn.made,
        "pictures_left_out": drawn.skipped,
        "latency_p50_ms": median,
        "latency_p99_ms": slow,
        "latency_max_ms": most,
        "compared": len(wanted),
        "equal": is_equal,
        "right": is_equal and is_whole and abs(drawn.made + drawn.skipped - due) <= 2.0,
    }


class Pictures:
    """The first pictures of a stream, by the time of their end."""

    def __init__(self, source: PrismSource) -> None:
        self.source = source
        self.logs: dict[int, np.ndarray] = {}

    def give(self, picture: LivePicture) -> None:
        """Take a picture."""
        if picture.end_us - self.source.start_us < COMPARED_US:
            self.logs[picture.end_us] = picture.picture.log


def drawn_from(
    source: PrismSource, *, newest: bool
) -> tuple[Pictures, PictureStream, SessionStatus]:
    """Run a session that makes pictures of a source."""
    found = Pictures(source)
    camera = PhaseCamera(MODEL, EncoderStream(), rate_hz=PICTURE_HZ)
    drawn = PictureStream(camera, found.give, newest=newest)
    session = Session(source, raw=(drawn,), say=lambda _: None)
    status = session.run(threading.Event(), lambda _: None)
    drawn.close()
    return found, drawn, status


def expected(source: PrismSource) -> dict[int, np.ndarray]:
    """Return the pictures of the first events by the time of their end, from a camera without a session."""
    encoder = EncoderStream()
    camera = PhaseCamera(MODEL, encoder, rate_hz=PICTURE_HZ)
    found = []
    for k in range(min(COMPARED_US // PACKET_US, source.count)):
        encoder.append(*source.samples(k))
        camera.put(source.events(k), 0)
        found += camera.take(0)
    found += camera.flush()
    return {one.end_us: one.picture.log for one in found}
