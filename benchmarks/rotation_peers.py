"""Speed and error of contrast maximisation for a rotating camera without a prism: amiwarp and eventcv, in one run.

    python -m benchmarks.rotation_peers [--repeats 5] [--out FILE.json]

Events of edge points on a sphere about a camera (640x480, 60 degrees) that rotates about all three axes for 50 ms, with
positions rounded to pixels and a tenth of the events at random places. Both libraries get the events and the camera,
and start from no motion. Both use all events and all cores; amiwarp runs its sharpness stage only. The error of the
velocity is relative to the true one. The image is that of the true rotation; its error is the rms difference from a
float64 image of exact rotations, relative to that image's standard deviation. eventcv does not document its warp; its
errors do not decrease with more events. The exit status is 1 if amiwarp's
velocity is wrong by more than 1 %.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from amiwarp.calib import calibrate
from amiwarp.calib.parameters import RATES
from amiwarp.choices import Vote
from amiwarp.cpu_threads import cpu_threads
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.events.recording import Recording
from amiwarp.imaging.iwe import iwe
from amiwarp.optics.camera import Camera
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.exact_model import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.studies.cluster import processor
from benchmarks.truth import votes

WIDTH, HEIGHT, LENGTH_US = 640, 480, 50_000
CAMERA = Camera.from_fov(WIDTH, HEIGHT, math.radians(60.0))
VELOCITY = np.array([0.3, -0.5, 0.8])
"""Angular velocity of the camera about its x, y and z axes [rad/s]."""
POINTS, NOISE, BORDER = 300, 0.1, 40.0
"""Number of edge points; share of events at random places; distance of edge points from the image's border [px]."""
BAR = 0.01
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """Events of a rotating camera."""

    events: Events
    image: Array
    """Image of the events at the middle time, exact rotations in float64 [events], shape (height, width)."""


def rotated(xy: Array, seconds: Array) -> Array:
    """Return where points are seen after the camera has turned for ``seconds``, each its own [px]."""
    bearings = np.stack([(xy[:, 0] - CAMERA.cx) / CAMERA.fx, (xy[:, 1] - CAMERA.cy) / CAMERA.fy, np.ones(len(xy))], 1)
    seen = Rotation.from_rotvec(-VELOCITY * seconds[:, None]).apply(bearings)
    return np.stack(
        [seen[:, k] / seen[:, 2] * f + c for k, f, c in ((0, CAMERA.fx, CAMERA.cx), (1, CAMERA.fy, CAMERA.cy))], 1
    )


def scene(n: int) -> Scene:
    rng = np.random.default_rng(n)
    t = np.sort(rng.integers(0, LENGTH_US, n))
    seconds = (t - LENGTH_US // 2) * 1e-6
    points = rng.uniform(BORDER, [WIDTH - BORDER, HEIGHT - BORDER], (POINTS, 2))
    xy = np.rint(rotated(points[rng.integers(0, POINTS, n)], seconds))
    noise = rng.random(n) < NOISE
    xy[noise] = rng.integers(0, [WIDTH, HEIGHT], (np.count_nonzero(noise), 2))
    events = Events.from_arrays(xy[:, 0].astype(np.int64), xy[:, 1].astype(np.int64), t, rng.integers(0, 2, n))
    return Scene(events, votes(rotated(xy, -seconds), WIDTH, HEIGHT)[Vote.BILINEAR])


def of_amiwarp(given: Scene) -> tuple[Callable[[], Array], Callable[[], Any]]:
    events = given.events
    recording = Recording(MemoryEvents(events, WIDTH, HEIGHT), camera=CAMERA)
    encoder = Encoder.constant_speed(0.0, 0, LENGTH_US)
    model = ExactModel(CAMERA, Prism(0.0))
    x, y, z = VELOCITY.tolist()

    def velocity() -> Array:
        found = calibrate(recording, free=("motion",), start={"apex": 0.0}, stages=("sharpness",), events=len(events))
        return np.array([found.parameters[name] for name in RATES])

    turned = CameraRotation((x, y, z), middle_us=LENGTH_US // 2)
    return velocity, lambda: iwe(events, WIDTH, HEIGHT, model=model, encoder=encoder, camera_rotation=turned)


def of_eventcv(given: Scene) -> tuple[Callable[[], Array], Callable[[], Any]]:
    import eventcv

    e = given.events
    table = np.stack([e.x, e.y, e.t, e.p], axis=1).astype(np.int64)
    stream = eventcv.from_numpy(table, sensor_size=(WIDTH, HEIGHT), time_unit="us")
    camera = eventcv.Camera(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
    return (
        lambda: np.array(stream.contrast_maximise(model="rotation", camera=camera)["params"]),
        lambda: stream.iwe(VELOCITY.tolist(), model="rotation", camera=camera).numpy()[0],
    )


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    began = time.perf_counter()
    result = work()
    return time.perf_counter() - began, result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, help="JSON file to write")
    a = parser.parse_args()
    rows = []
    for n in (20_000, 200_000, 1_000_000):
        given = scene(n)
        programs = {"amiwarp": of_amiwarp(given), "eventcv": of_eventcv(given)}
        seconds: dict[tuple[str, int], list[float]] = {(name, job): [] for name in programs for job in (0, 1)}
        last: dict[tuple[str, int], Any] = {}
        for k in range(a.repeats + 1):  # the first round compiles
            for key, spent in seconds.items():
                took, last[key] = timed(programs[key[0]][key[1]])
                if k:
                    spent.append(took)
        for name in programs:
            rows.append({
                "library": name, "events": n, "search_s": float(np.median(seconds[name, 0])),
                "velocity_error": float(np.linalg.norm(last[name, 0] - VELOCITY) / np.linalg.norm(VELOCITY)),
                "image_s": float(np.median(seconds[name, 1])),
                "image_error": float(np.std(last[name, 1] - given.image) / np.std(given.image)),
            })  # fmt: skip
            print(json.dumps(rows[-1]), flush=True)
    if a.out:
        versions = {name: importlib.metadata.version(name) for name in ("warp-lang", "numpy", "eventcv")}
        machine = f"{processor()}, {cpu_threads()} cores"
        result = {"benchmark": "rotation_peers", "machine": machine, "versions": versions, "rows": rows}
        a.out.write_text(json.dumps(result, indent=1) + "\n")
    if any(row["library"] == "amiwarp" and not row["velocity_error"] <= BAR for row in rows):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
