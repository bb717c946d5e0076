"""Inputs of the benchmarks: events of a rotating prism in order of time, simulated recordings, and files."""

from __future__ import annotations

import importlib.util
import math
import shutil
import tempfile
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp import (
    Camera,
    Events,
    ExactModel,
    Prism,
    Recording,
    SensorModel,
    Simulation,
    apex_from_deflection,
    truth_model,
)
from amiwarp.studies.demo import Demo, simulation
from amiwarp.tasks import cpu_threads
from benchmarks import compensate
from benchmarks.libraries import Missing

Array = NDArray[np.float64]

SECONDS, TURNS_PER_S = 2.0, 12.0
DEFLECTION, INDEX, FOV = math.radians(1.0), 1.5168, math.radians(60.0)
PHASE = math.pi
"""Phase of the prism [rad]: amiwarp displaces events along the angle, the formula of the other libraries against it."""
MARGIN = 24
"""Margin around the image that no event leaves [px]; the radius of the orbit is 9.7 px."""
CHUNK = 1 << 19
"""Number of events that one thread processes at a time."""
SAMPLE = 100_000
"""Largest number of events whose compensated positions are compared with the truth."""
WIDTH, HEIGHT = 640, 480
RECORDED = 10_000_000
"""Number of events of a recording of full size and length; shorter recordings keep the rate per pixel."""
SHORTEST_S = 0.25
"""Duration of the shortest recording [s]; for fewer events, the image becomes smaller instead."""
OFF_OVER_ON = 1.0 / 0.95
"""Ratio of the OFF to the ON threshold of the simulated sensor."""
PROBES, PROBE_S, DAMPED = 4, 0.1, 0.6
"""Number and length [s] of the probes that find the contrast threshold for the wanted number of events, and the
exponent of each correction.

The number of events falls with a power of the threshold between -1 and -2.
"""
FILTERS = ("hdf5plugin", "blosc")
"""Libraries that HDF5 files need. Without them, the benchmark's files are plain binary columns."""
threads = ThreadPoolExecutor(cpu_threads())


@dataclass(frozen=True, slots=True, eq=False)
class EventScene:
    """Events with their prism angles. Data derived from them are kept, so that all methods share them."""

    name: str
    camera: Camera
    prism: Prism
    events: Events
    theta: Array
    """Unwrapped prism angle of each event [rad]."""
    kept: dict[Any, Any] = field(default_factory=dict)

    @property
    def radius(self) -> float:
        """Radius of the orbit of a point on the optical axis [px]: the circle that other libraries compensate."""
        return self.camera.fx * math.tan(DEFLECTION)

    def keep(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return the result of ``make``, which is called only once per key."""
        if key not in self.kept:
            self.kept[key] = make()
        return self.kept[key]

    def __len__(self) -> int:
        return len(self.theta)

    @property
    def some(self) -> slice:
        """Indices of evenly spaced events whose positions are compared with the truth."""
        return slice(None, None, -(-len(self) // SAMPLE))

    def sample(self) -> tuple[Array, Array]:
        """Return the pixels, shape ``(m, 2)``, and the angles [rad], shape ``(m,)``, of the events in :attr:`some`."""
        xy = np.stack([self.events.x[self.some], self.events.y[self.some]], axis=1).astype(
            np.float64
        )
        return xy, self.theta[self.some]


def in_chunks(work: Callable[[int, int], Any], n: int) -> list[Any]:
    """Call ``work(start, stop)`` for chunks of ``range(n)`` on all cores, and return the results."""
    return list(threads.map(lambda start: work(start, min(start + CHUNK, n)), range(0, n, CHUNK)))


def event_scene(
    name: str, n: int, *, points: int = 0, width: int = WIDTH, height: int = HEIGHT
) -> EventScene:
    """Return events of ``points`` edge points on their orbits, rounded to pixels; with 0 points, at random pixels."""
    camera = Camera.from_fov(width, height, FOV)
    scene = EventScene(
        name, camera, Prism(apex_from_deflection(DEFLECTION, INDEX), INDEX),
        Events(np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(n, np.int64), np.zeros(n, np.uint8)),
        np.empty(n),
    )  # fmt: skip
    border = math.ceil(scene.radius) + 1
    edges = np.random.default_rng(points).uniform(
        border, [width - 1 - border, height - 1 - border], (points, 2)
    )

    def fill(start: int, stop: int) -> None:
        rng, e, m = np.random.default_rng([points, start]), scene.events, stop - start
        e.t[start:stop] = (np.arange(start, stop) + rng.random(m)) * (SECONDS * 1e6 / n)
        theta = e.t[start:stop] * (1e-6 * TURNS_PER_S * 2.0 * math.pi)
        scene.theta[start:stop] = theta
        e.p[start:stop] = rng.integers(0, 2, m, np.uint8)
        if points:
            x, y = edges[rng.integers(0, points, m)].T
            e.x[start:stop] = np.rint(x + scene.radius * np.cos(theta))
            e.y[start:stop] = np.rint(y + scene.radius * np.sin(theta))
        else:
            e.x[start:stop] = rng.integers(0, width, m, np.uint16)
            e.y[start:stop] = rng.integers(0, height, m, np.uint16)

    in_chunks(fill, n)
    return scene


@dataclass(frozen=True, eq=False)
class RecordingScene:
    """Simulated recording together with its simulation."""

    made: Simulation
    recording: Recording

    def __len__(self) -> int:
        return len(self.recording.events)

    @cached_property
    def model(self) -> ExactModel:
        """Exact model with the true parameters."""
        assert self.recording.truth is not None
        return truth_model(self.made.camera, self.recording.truth, self.made.prism.flat_side)

    @cached_property
    def view(self) -> NDArray[np.float32]:
        """Log intensity that the camera would see without the prism, shape ``(height, width)``."""
        return self.made.log_view()


def recording_scene(n: int, device: str, picture: Path | None) -> RecordingScene:
    """Simulate about ``n`` events of a still picture with the camera and the prism of the demo.

    For fewer events the recording is shorter, then smaller. Without a ``picture`` the scene is PyVista's map of the
    earth. Raises :class:`Missing` if PyVista is not installed.
    """
    seconds = max(SHORTEST_S, SECONDS * n / RECORDED)
    size = math.sqrt(n / seconds * SECONDS / RECORDED)
    demo = Demo(Path(), picture, round(WIDTH * size), round(HEIGHT * size), seconds, device=device)
    try:
        made = simulation(demo)
    except ImportError as error:
        raise Missing(
            "no picture: give --picture, or install pyvista for its map of the earth"
        ) from error
    contrast = SensorModel().contrast_on
    for _ in range(PROBES):
        probe = replace(made, sensor=sensor(contrast), duration_s=2.0 * PROBE_S).run().events
        # The first turn has more events
        settled = probe.between(round(PROBE_S * 1e6), round(2e6 * PROBE_S))
        contrast *= (len(settled) / PROBE_S * seconds / n) ** DAMPED
    made = replace(made, sensor=sensor(contrast))
    return RecordingScene(made, made.run())


def sensor(contrast: float) -> SensorModel:
    """Return the sensor with this ON threshold [log intensity]."""
    return SensorModel(contrast_on=contrast, contrast_off=contrast * OFF_OVER_ON)


@dataclass(frozen=True, eq=False)
class FileScene:
    """Recording in a temporary folder that is deleted together with the scene."""

    source: Path
    """Path of the recording's file or folder."""
    n: int
    """Number of events."""
    missing: tuple[str, ...]
    """Missing libraries, because of which the file consists of plain binary columns."""

    def __len__(self) -> int:
        return self.n


def file_scene(n: int) -> FileScene:
    """Write ``n`` events into a file; see :mod:`benchmarks.compensate`."""
    folder = Path(tempfile.mkdtemp())
    missing = tuple(name for name in FILTERS if importlib.util.find_spec(name) is None)
    scene = FileScene(folder / ("recording" if missing else "recording.h5"), n, missing)
    weakref.finalize(scene, shutil.rmtree, folder)
    compensate.make(scene.source, n, bool(missing))
    return scene
