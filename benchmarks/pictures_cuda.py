"""Pictures of a stream on a GPU: speed, latency, and agreement with the pictures of the CPU.

    python -m benchmarks.pictures_cuda [--device cuda:0] [--seconds 0.7] [--out FILE.json]

The astronaut at 640x480 through a prism of 1 deg at 260 turns/min: 10 million events a second. ``check``: the same
packets give pictures on both devices. ``alone``: pictures of the newest bins without new events, one after the other
or with the next one begun before the last is copied. ``stream``: packets as fast as possible, a picture after each of
the 64 bins of a turn. ``take_ms`` is the time from a packet that completes a bin to its picture.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp import Events, LivePicture, PhaseCamera, Recording
from amiwarp.studies.machine import machine
from benchmarks.pictures import camera_for, correlations, packets, simulation

WIDTH = 640
HEIGHT = 480
RPM = 260.0
BINS = 64
ALONE = 400
"""Number of pictures that are made without new events."""
MOST_APART = 0.05
"""Largest difference between the pictures of both devices [thresholds]."""


def pictures_of(camera: PhaseCamera, blocks: list[Events]) -> list[LivePicture]:
    found: list[LivePicture] = []
    for block in blocks:
        camera.put(block, 0)
        found += camera.take(0)
    return found


def check(recording: Recording, truth: NDArray[np.float32], device: str) -> dict[str, Any]:
    """Return how far the pictures of both devices are apart, and their correlation with the scene."""
    blocks = packets(recording.events[:], 20_000)
    on_host = pictures_of(camera_for(recording, "cpu"), blocks)
    on_device = pictures_of(camera_for(recording, device), blocks)
    apart = 0.0
    for host, found in zip(on_host, on_device, strict=True):
        apart = max(apart, float(np.abs(host.picture.log - found.picture.log).max()))
    whole, detail = correlations(on_device[-1].picture.log, truth)
    return {
        "what": "check",
        "pictures": len(on_host),
        "largest_difference": apart,
        "whole": whole,
        "detail": detail,
        "ok": apart <= MOST_APART,
    }


def alone(recording: Recording, device: str, bins: int, *, overlapped: bool) -> dict[str, Any]:
    """Return the time of a picture of the newest bins without new events."""
    camera = camera_for(recording, device)
    pictures_of(camera, packets(recording.events[:], 20_000))
    maker = camera._pictures
    finish: Callable[[], Any] | None = None
    began = time.perf_counter()
    for _ in range(ALONE):
        begun = maker.begin(bins, first=False, find_lag=False)
        if not overlapped:
            begun()
        elif finish is not None:
            finish()
        finish = begun
    if overlapped and finish is not None:
        finish()
    seconds = time.perf_counter() - began
    return {
        "what": "alone",
        "bins": bins,
        "overlapped": overlapped,
        "ms": 1e3 * seconds / ALONE,
        "per_s": ALONE / seconds,
    }


def stream(recording: Recording, device: str, packet_us: int) -> dict[str, Any]:
    """Return the pictures a second of a stream that comes as fast as it is taken, one for each bin."""
    camera = camera_for(recording, device, turns=1.0 / BINS)
    count = 0
    latencies = []
    began = time.perf_counter()
    for block in packets(recording.events[:], packet_us):
        camera.put(block, 0)
        before = time.perf_counter()
        found = camera.take(0)
        if found and count:  # the first one loads kernels
            latencies.append(time.perf_counter() - before)
        count += len(found)
    seconds = time.perf_counter() - began
    return {
        "what": "stream",
        "packet_us": packet_us,
        "pictures": count,
        "per_s": count / seconds,
        "mev_s": 1e-6 * len(recording.events) / seconds,
        "take_ms": 1e3 * statistics.median(latencies),
        "take_99_ms": 1e3 * float(np.percentile(latencies, 99)),
    }


def main() -> int:
    """Print the rows and write them; the exit status is 1 if the pictures of both devices differ."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--seconds", type=float, default=0.7)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    scene = simulation("astronaut", WIDTH, HEIGHT, RPM, args.seconds)
    recording = scene.run()
    rows = [check(recording, scene.log_view(), args.device)]
    for overlapped in (False, True):
        for bins in (1, 16):
            rows.append(alone(recording, args.device, bins, overlapped=overlapped))
    for packet_us in (20_000, 1_000):
        rows.append(stream(recording, args.device, packet_us))
    for row in rows:
        print(json.dumps(row))
    if args.out is not None:
        about = {"protocol": __doc__, "machine": machine(args.device)}
        args.out.write_text(json.dumps(about | {"rows": rows}, indent=1) + "\n")
    return 0 if rows[0]["ok"] else 1


if __name__ == "__main__":
    raise SystemExit(main())
