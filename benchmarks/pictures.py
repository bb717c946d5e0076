"""Speed, latency and correlation of pictures of a stream from sums in phase.

    python -m benchmarks.pictures [--only speed live moves] [--seconds 2] [--out FILE.json]

``speed``: recordings of about 10 million events per second, in packets of 1 ms, as fast as possible: CPU time for each
second of the stream at the rate of pictures that is asked for.
``live``: the same in real time, as ``amiwarp live --picture`` makes pictures: how many are made and left out, and the
time from the arrival of a picture's last event to the picture.
``moves``: a square of another scene moves before the scene. The correlation of the rest with the scene, for pictures
in which what moves is kept out, and for whole turns.

The correlation is of the whole picture, and of its detail, without waves over some 8 px. The CPU time is of the
process, of all its threads. The exit status is 1 if a picture is worse than it should be; times are only reported.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from amiwarp import (
    Camera,
    EncoderStream,
    Events,
    ExactModel,
    LivePicture,
    PhaseCamera,
    PhaseRing,
    Prism,
    PrismMotion,
    Recording,
    Scene,
    Simulation,
    phase_picture,
)
from amiwarp.live.stream import PictureStream
from amiwarp.studies.machine import machine

PRISM = Prism(math.radians(1.0))
PHASE = 0.3
SIZES = {"640x480": (640, 480, 260.0, 15.0), "320x240": (320, 240, 1310.0, 50.0)}
"""Width, height, speed of the prism with which the scenes have about 10 million events a second, pictures a second."""
SCENES = ("astronaut", "coffee")
PACKET_US = 1000
MOVING_S = 0.7
"""Length of the streams with a square that moves [s]."""
LEAST_DETAIL = 0.97
LEAST_WHOLE = 0.9
MOST_LOST = 0.02
"""Largest loss of the correlation of the rest of a picture by what moves."""
MARGIN_PX = 14
"""Distance from what moves from which on a picture is compared [px]."""


def simulation(name: str, width: int, height: int, rpm: float, seconds: float) -> Simulation:
    from skimage import data

    picture = getattr(data, name)()
    grey = picture.mean(axis=2) if picture.ndim == 3 else picture
    camera = Camera.from_fov(width, height, math.radians(60.0))
    scene = Scene.from_picture(grey.astype(np.uint8))
    return Simulation(scene, camera, PRISM, seconds, PrismMotion(rpm, PHASE), seed=1)


def packets(events: Events, packet_us: int = PACKET_US) -> list[Events]:
    last = int(events.t[-1])
    edges = np.searchsorted(events.t, np.arange(0, last + 2 * packet_us, packet_us)).tolist()
    return [events[a:b] for a, b in itertools.pairwise(edges)]


def camera_for(recording: Recording, device: str = "cpu", **options: float) -> PhaseCamera:
    assert recording.camera is not None
    assert recording.encoder is not None
    encoder = EncoderStream()
    encoder.append(recording.encoder.t, recording.encoder.angle)
    model = ExactModel(recording.camera, PRISM, PHASE)
    return PhaseCamera(model, encoder, device=device, **options)


def correlations(
    picture: NDArray[np.float32], truth: NDArray[np.float32], where: NDArray[np.bool_] | None = None
) -> tuple[float, float]:
    """Return the correlation of the whole picture and of its detail, without the border."""
    inner = np.zeros(truth.shape, np.bool_)
    inner[8:-8, 8:-8] = True
    if where is not None:
        inner &= where
    parts = [
        [image[inner], (image - gaussian_filter(image, 8.0))[inner]] for image in (picture, truth)
    ]
    whole, detail = (float(np.corrcoef(a, b)[0, 1]) for a, b in zip(*parts, strict=True))
    return whole, detail


def scored(pictures: list[LivePicture], truth: NDArray[np.float32]) -> dict[str, Any]:
    """Return the median correlation of the later half of the pictures, which no start disturbs."""
    found = [correlations(one.picture.log, truth) for one in pictures[len(pictures) // 2 :]]
    whole, detail = np.median(found, axis=0)
    return {
        "whole": float(whole),
        "detail": float(detail),
        "moved": float(np.median([one.moved.mean() for one in pictures])),
        "ok": bool(whole >= LEAST_WHOLE and detail >= LEAST_DETAIL),
    }


def speed(recording: Recording, truth: NDArray[np.float32], rate_hz: float) -> dict[str, Any]:
    blocks = packets(recording.events[:])
    camera_for(recording, rate_hz=rate_hz)  # loads kernels and tables
    camera = camera_for(recording, rate_hz=rate_hz)
    pictures: list[LivePicture] = []
    fastest = math.inf
    began = time.process_time()
    for block in blocks:
        camera.put(block, 0)
        before = time.process_time()
        found = camera.take(0)
        if pictures and found:
            fastest = min(fastest, time.process_time() - before)
        pictures += found
    took = time.process_time() - began
    seconds = len(blocks) * PACKET_US * 1e-6
    return {
        "pictures": len(pictures),
        "cpu_s_per_s": took / seconds,
        "cpu_ms_per_picture": 1e3 * took / len(pictures),
        "cpu_ms_fastest": 1e3 * fastest,
        **scored(pictures, truth),
    }


def live(recording: Recording, truth: NDArray[np.float32], rate_hz: float) -> dict[str, Any]:
    blocks = packets(recording.events[:])
    pictures: list[LivePicture] = []
    stream = PictureStream(camera_for(recording, rate_hz=rate_hz), pictures.append, newest=True)
    began = time.perf_counter()
    cpu = time.process_time()
    for k, block in enumerate(blocks):
        # a packet exists once the time of its last event has passed
        time.sleep(max(0.0, (k + 1) * PACKET_US * 1e-6 - (time.perf_counter() - began)))
        stream.append(block)
    stream.close()
    seconds = time.perf_counter() - began
    median, p99 = np.percentile(stream.latencies_us, [50, 99]) * 1e-3
    half_ms = float(np.median([one.picture.length_us for one in pictures])) * 0.5e-3
    return {
        "per_s": stream.made / seconds,
        "left_out": stream.skipped,
        "cpu_s_per_s": (time.process_time() - cpu) / seconds,
        "ms_median": float(median),
        "ms_p99": float(p99),
        "half_of_newest_part_ms": half_ms,
        **scored(pictures, truth),
    }


class Square:
    """Square of another scene that moves to the right before a scene."""

    def __init__(self, speed: float, left: int, top: int, side: int) -> None:
        self._speed = speed
        self._left = left
        self._top = top
        self._side = side

    def before(self, scene: Events, other: Events) -> Events:
        """Return the events of the scene with the square before it."""
        covered = self._covers(scene.x, scene.y, self._speed * 1e-6 * scene.t)
        shown = self._covers(other.x, other.y, 0.0)
        moved = np.floor(self._speed * 1e-6 * other.t[shown]).astype(int)
        x = np.concatenate([scene.x[~covered], other.x[shown] + moved])
        y = np.concatenate([scene.y[~covered], other.y[shown]])
        t = np.concatenate([scene.t[~covered], other.t[shown]])
        p = np.concatenate([scene.p[~covered], other.p[shown]])
        order = np.argsort(t, kind="stable")
        return Events.from_arrays(x[order], y[order], t[order], p[order])

    def _covers(self, x: Any, y: Any, shift: Any) -> Any:
        inside = (x >= self._left + np.floor(shift)) & (
            x < self._left + self._side + np.floor(shift)
        )
        return inside & (y >= self._top) & (y < self._top + self._side)

    def touched(self, from_us: int, to_us: int, margin: int, size: tuple[int, int]) -> Any:
        """Return which pixels it touches in a time, with a margin [px], shape (height, width)."""
        width, height = size
        y, x = np.mgrid[:height, :width]
        first = self._left + self._speed * 1e-6 * from_us - margin
        last = self._left + self._side + self._speed * 1e-6 * to_us + margin
        rows = (y >= self._top - margin) & (y < self._top + self._side + margin)
        return rows & (x >= first) & (x <= last)


def moves(speed: float, seconds: float) -> dict[str, Any]:
    """Compare the rest of pictures with a square that moves at ``speed`` [px/s]."""
    width, height, rpm = 320, 240, 720.0
    scene = simulation("coffee", width, height, rpm, seconds)
    recording = scene.run()
    truth = scene.log_view()
    other = simulation("astronaut", width, height, rpm, seconds).run()
    square = Square(speed, 30, 90, 60)
    events = square.before(recording.events[:], other.events[:])
    assert recording.encoder is not None
    assert recording.camera is not None
    model = ExactModel(recording.camera, PRISM, PHASE)
    camera = camera_for(recording)
    ring: PhaseRing | None = None
    rows: list[list[float]] = []
    for block in packets(events):
        camera.put(block, 0)
        found = camera.take(0)
        if ring is not None:
            ring.add(block, recording.encoder)
        for one in found:
            ring = ring or PhaseRing(width, height, harmonics=6)
            if ring.turns < 1.0:
                continue
            turn_us = round(60e6 / rpm)
            rest = ~square.touched(one.end_us - turn_us, one.end_us, MARGIN_PX, (width, height))
            there = square.touched(one.end_us, one.end_us, 0, (width, height))
            plain = phase_picture(ring.sums(), model)
            whole, detail = correlations(one.picture.log, truth, rest)
            whole_turn, turn_detail = correlations(plain, truth, rest)
            marks = [float(one.moved[there].mean()), float(one.moved[rest].mean())]
            rows.append([whole, detail, whole_turn, turn_detail, *marks])
    middle = np.median(np.array(rows[len(rows) // 2 :]), axis=0).tolist()
    names = ("whole", "detail", "whole_of_turns", "detail_of_turns", "marked_there", "marked_rest")
    return {"px_per_s": speed, **dict(zip(names, middle, strict=True))}


def rows(only: list[str], seconds: float) -> Iterator[dict[str, Any]]:
    for name in SCENES:
        for size, (width, height, rpm, rate_hz) in SIZES.items():
            if "speed" not in only and "live" not in only:
                continue
            scene = simulation(name, width, height, rpm, seconds)
            recording = scene.run()
            truth = scene.log_view()
            mev_s = len(recording.events) / seconds * 1e-6
            row = {"scene": name, "size": size, "rpm": rpm, "mev_s": mev_s, "asked_hz": rate_hz}
            if "speed" in only:
                yield {"what": "speed", **row, **speed(recording, truth, rate_hz)}
            if "live" in only:
                yield {"what": "live", **row, **live(recording, truth, rate_hz)}
    if "moves" in only:
        still = moves(0.0, MOVING_S)["whole"]
        for px_per_s in (0.0, 30.0, 60.0, 120.0, 240.0):
            row = moves(px_per_s, MOVING_S)
            yield {"what": "moves", **row, "ok": row["whole"] > still - MOST_LOST}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=["speed", "live", "moves"])
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    found: list[dict[str, Any]] = []
    for row in rows(args.only, args.seconds):
        found.append(row)
        print(json.dumps(row), flush=True)
    if args.out:
        data = {"machine": machine("cpu"), "device": "cpu", "rows": found}
        args.out.write_text(json.dumps(data, indent=1) + "\n")
    return int(not all(row["ok"] for row in found))


if __name__ == "__main__":
    sys.exit(main())
