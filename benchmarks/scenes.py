"""What the methods are given: events of a turning prism in the order of time, simulated recordings, files."""

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

from amiwarp.events.events import Events
from amiwarp.events.recording import Recording
from amiwarp.imaging.metrics import truth_model
from amiwarp.kernels.cores import cpu_threads
from amiwarp.optics.camera import Camera
from amiwarp.optics.models import ExactModel, apex_from_deflection
from amiwarp.optics.prism import Prism
from amiwarp.simulation.simulator import SensorModel, Simulation
from amiwarp.studies.demo import Demo, simulation
from benchmarks import compensate
from benchmarks.libraries import Missing

Array = NDArray[np.float64]

SECONDS, TURNS_PER_S = 2.0, 12.0
DEFLECTION, INDEX, FOV = math.radians(1.0), 1.5168, math.radians(60.0)
PHASE = math.pi  # amiwarp compensates towards the angle, the peers' formula away from it
MARGIN = 24  # px around the image that no event leaves: the orbit's radius is 9.7 px
CHUNK = 1 << 19
SAMPLE = 100_000  # events at most, of which places are compared
WIDTH, HEIGHT = 640, 480
RECORDED = 10_000_000
"""Events of a recording of that size and length: it keeps their rate a pixel where fewer are asked for."""
SHORTEST_S = 0.25
OFF_OVER_ON = 1.0 / 0.95
PROBES, PROBE_S, DAMPED = 4, 0.1, 0.6
"""To find the contrast at which there are so many: between 1/contrast and its square they fall as it rises."""
FILTERS = ("hdf5plugin", "numcodecs")
"""Without these the files are bare columns."""
threads = ThreadPoolExecutor(cpu_threads())


@dataclass(frozen=True, slots=True, eq=False)
class EventScene:
    """Events with the prism's angle at each; what is derived from them is kept, so that methods share it."""

    name: str
    camera: Camera
    prism: Prism
    events: Events
    theta: Array
    """The prism's angle at each event [rad], unwrapped."""
    kept: dict[Any, Any] = field(default_factory=dict)

    @property
    def radius(self) -> float:
        """Of the orbit of a point on the axis [px]: the circle that peers take out."""
        return self.camera.fx * math.tan(DEFLECTION)

    def keep(self, key: Any, make: Callable[[], Any]) -> Any:
        if key not in self.kept:
            self.kept[key] = make()
        return self.kept[key]

    def __len__(self) -> int:
        return len(self.theta)

    @property
    def some(self) -> slice:
        """Events evenly spread over the scene, of which places are compared."""
        return slice(None, None, -(-len(self) // SAMPLE))

    def sample(self) -> tuple[Array, Array]:
        """Their pixels (m, 2) and angles (m,)."""
        xy = np.stack([self.events.x[self.some], self.events.y[self.some]], axis=1).astype(np.float64)
        return xy, self.theta[self.some]


def in_chunks(work: Callable[[int, int], Any], n: int) -> list[Any]:
    """``work(start, stop)`` over ``range(n)`` on all cores."""
    return list(threads.map(lambda start: work(start, min(start + CHUNK, n)), range(0, n, CHUNK)))


def event_scene(name: str, n: int, *, points: int = 0, width: int = WIDTH, height: int = HEIGHT) -> EventScene:
    """``points`` edge points, each seen on its orbit and rounded to the pixel; 0: any pixel at any time."""
    camera = Camera.from_fov(width, height, FOV)
    scene = EventScene(
        name, camera, Prism(apex_from_deflection(DEFLECTION, INDEX), INDEX),
        Events(np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(n, np.int64), np.empty(n, np.uint8)),
        np.empty(n),
    )  # fmt: skip
    border = math.ceil(scene.radius) + 1
    edges = np.random.default_rng(points).uniform(border, [width - 1 - border, height - 1 - border], (points, 2))

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
    """A recording that was simulated, and how."""

    made: Simulation
    recording: Recording

    def __len__(self) -> int:
        return len(self.recording.events)

    @cached_property
    def model(self) -> ExactModel:
        """The prism that it was made with."""
        assert self.recording.truth is not None
        return truth_model(self.made.camera, self.recording.truth, self.made.prism.flat_side)

    @cached_property
    def view(self) -> NDArray[np.float32]:
        """What the camera sees without the prism: log intensity, shape (height, width)."""
        return self.made.log_view()


def recording_scene(n: int, device: str, picture: Path | None) -> RecordingScene:
    """About ``n`` events of a still picture, the demo's camera and prism; shorter and smaller for fewer of them.

    Without a ``picture`` it is PyVista's map of the earth. Raises :class:`Missing` where that is not there.
    """
    seconds = max(SHORTEST_S, SECONDS * n / RECORDED)
    size = math.sqrt(n / seconds * SECONDS / RECORDED)
    demo = Demo(Path(), picture, round(WIDTH * size), round(HEIGHT * size), seconds, device=device)
    try:
        made = simulation(demo)
    except ImportError as error:
        raise Missing("no picture: give --picture, or install pyvista for its map of the earth") from error
    contrast = SensorModel().contrast_on
    for _ in range(PROBES):
        probe = replace(made, sensor=sensor(contrast), duration_s=2.0 * PROBE_S).run().events
        settled = probe.between(round(PROBE_S * 1e6), round(2e6 * PROBE_S))  # the first turn has more of them
        contrast *= (len(settled) / PROBE_S * seconds / n) ** DAMPED
    made = replace(made, sensor=sensor(contrast))
    return RecordingScene(made, made.run())


def sensor(contrast: float) -> SensorModel:
    """By its ON threshold [log intensity]."""
    return SensorModel(contrast_on=contrast, contrast_off=contrast * OFF_OVER_ON)


@dataclass(frozen=True, eq=False)
class FileScene:
    """A recording in a temporary folder, which goes when the scene does."""

    source: Path
    n: int
    missing: tuple[str, ...]
    """Libraries without which the file is bare columns."""

    def __len__(self) -> int:
        return self.n


def file_scene(n: int) -> FileScene:
    """``n`` events in a file; see :mod:`benchmarks.compensate`."""
    folder = Path(tempfile.mkdtemp())
    missing = tuple(name for name in FILTERS if importlib.util.find_spec(name) is None)
    scene = FileScene(folder / "recording", n, missing)
    weakref.finalize(scene, shutil.rmtree, folder)
    compensate.make(scene.source, n, bool(missing))
    return scene
