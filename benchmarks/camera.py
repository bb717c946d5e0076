"""Recording of a stand-in for a camera that sends 10^8 events and trigger edges through neuromorphic-drivers.

    python -m benchmarks.camera [--events 100000000] [--packet 50000] [--folder FOLDER] [--out FILE.json]

The package's own Python code runs above a substitute for its compiled part, without pauses: 10 million events and 1000
rising edges per second of the camera's clock. They are recorded as ``amiwarp record`` does, with the edges as counts of
the encoder. Then every event and every edge in the file is compared with what was sent. The exit status is 1 if one is
missing or altered. No camera is needed; what USB and the camera's own decoder cost is not measured.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp import open_recording
from amiwarp.io.native.live_writer import LiveWriter
from amiwarp.live.stream.camera_neuromorphic import NeuromorphicSource
from amiwarp.live.stream.camera_settings import parse_camera
from amiwarp.live.stream.session import Session
from amiwarp.studies.machine import machine
from reference.camera_stub import POLARITY, TRIGGER, Part, StubCamera, connected

BLOCK = 1 << 20
"""Largest number of events in a packet, and number of those that are compared at a time."""
POOL, MEV_S, EDGE_US, START_US = 1 << 21, 10, 1000, (1 << 32) - 1_000_000
"""Number of different pixels, event rate, interval of the edges, and first time: counters of 32 bits wrap after 1 s."""


class Sent:
    """What the camera sends: rows of a pool at random pixels, at new times."""

    def __init__(self, events: int, packet: int) -> None:
        rng = np.random.default_rng(0)
        pool = np.zeros(POOL, POLARITY)
        pool["x"], pool["y"] = rng.integers(0, 1280, POOL), rng.integers(0, 720, POOL)
        pool["on"] = rng.integers(0, 2, POOL)
        self.pool = np.concatenate([pool, pool[:BLOCK]])
        self.events, self._packet, self.cpu_s = events, packet, 0.0

    def rows(self, first: int, count: int) -> np.ndarray:
        start = first % POOL
        made = self.pool[start : start + count].copy()
        made["t"] = np.arange(first, first + count, dtype=np.uint64) // np.uint64(
            MEV_S
        ) + np.uint64(START_US)
        return made

    def edges(self, first_us: int, stop_us: int) -> np.ndarray:
        """Rising edges at multiples of the interval, and falling ones between them."""
        t = np.arange(-(-2 * first_us // EDGE_US), -(-2 * stop_us // EDGE_US))
        made = np.zeros(t.size, TRIGGER)
        made["t"], made["rising"] = t * (EDGE_US // 2) + START_US, t % 2 == 0
        return made

    def parts(self) -> Iterator[Part | Exception]:
        for first in range(0, self.events, self._packet):
            began = time.thread_time()
            count = min(self._packet, self.events - first)
            edges = self.edges(first // MEV_S, (first + count) // MEV_S)
            part = Part(self.rows(first, count), edges if len(edges) else None)
            self.cpu_s += time.thread_time() - began
            yield part
        yield RuntimeError("all events were sent")


class TimedSource(NeuromorphicSource):
    """Camera whose conversion of packets is timed."""

    cpu_s = 0.0

    def _packet(self, packet: Any) -> Any:
        began = time.thread_time()
        made = super()._packet(packet)
        self.cpu_s += time.thread_time() - began
        return made


def altered(path: Path, sent: Sent) -> dict[str, int]:
    """Return how many events and encoder samples of a recording are missing or differ from those that were sent."""
    recording = open_recording(path)
    differing = first = 0
    for block in recording.events.blocks(count=BLOCK):
        made = sent.rows(first, len(block))
        differing += sum(
            int(np.count_nonzero(column != made[name]))
            for name, column in (("t", block.t), ("x", block.x), ("y", block.y), ("on", block.p))
        )
        first += len(block)
    edges = sent.edges(0, sent.events // MEV_S)
    t, encoder = edges["t"][edges["rising"]], recording.encoder
    angle = 2.0 * math.pi / 4096 * np.arange(len(t))
    same = (
        encoder is not None
        and np.array_equal(encoder.t, t.astype(np.int64))
        and np.allclose(encoder.angle, angle)
    )
    return {
        "missing": sent.events - first,
        "altered": differing,
        "edges": len(t),
        "edges_right": int(same),
    }


def run(sent: Sent, path: Path) -> dict[str, Any]:
    messages: list[str] = []
    before_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    with connected(StubCamera(parts=[sent.parts()])):
        source = TimedSource(parse_camera("camera:evk4,counts_per_turn=4096"), messages.append)
        began, cpu = time.perf_counter(), time.process_time()
        with LiveWriter(
            path, width=source.size[0], height=source.size[1], metadata=source.metadata
        ) as writer:
            status = Session(source, raw=[writer], say=messages.append).run(
                threading.Event(), lambda _: None
            )
        wall, cpu = time.perf_counter() - began, time.process_time() - cpu
    return {
        "events": status.events, "lost_usb_packets": source.lost, "dropped": status.dropped, "late": status.late,
        "wall_s": wall, "cpu_s": cpu, "made_cpu_s": sent.cpu_s, "source_cpu_s": source.cpu_s,
        "source_mev_per_cpu_s": status.events / source.cpu_s / 1e6, "mev_per_wall_s": status.events / wall / 1e6,
        "source_share": source.cpu_s / (cpu - sent.cpu_s), "rss_before_mib": before_mib,
        "rss_most_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, "file_bytes": path.stat().st_size,
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--events", type=int, default=100_000_000)
    parser.add_argument("--packet", type=int, default=50_000, help=f"at most {BLOCK}")
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    sent = Sent(arguments.events, arguments.packet)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        path = Path(folder) / "camera.h5"
        found = {"machine": machine("cpu"), "packet": arguments.packet, **run(sent, path)}
        found |= altered(path, sent)
    text = json.dumps(found, indent=1)
    print(text)
    if arguments.out is not None:
        arguments.out.write_text(text + "\n")
    lost = (
        found["missing"]
        or found["altered"]
        or found["dropped"]
        or found["late"]
        or found["lost_usb_packets"]
    )
    return int(bool(lost) or not found["edges_right"])


if __name__ == "__main__":
    sys.exit(main())
