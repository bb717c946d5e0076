"""Rotation of a plain event camera over time, by contrast maximisation in successive windows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Sharpness, Vote
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, Recording
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.sharpness import SharpnessMeter
from amiwarp.imaging.uploaded_events import upload_events
from amiwarp.imaging.votes import Votes
from amiwarp.optics.camera import Camera
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.simulation.motion import CameraMotion
from amiwarp.tasks import Progress

MOTION_PX = 6.0
"""Wanted motion of the image in a window [px]: enough for each pixel to see several parts of the scene."""
WINDOW_US = (10_000, 250_000)
"""Shortest and longest window [us]."""
FIRST_US = 40_000
"""Length of the first window [us]."""
MOST_EVENTS = 30_000
"""Largest number of events per window whose sharpness is measured; more are thinned evenly."""
LEAST_EVENTS = 200
"""Smallest number of events in a window from which a motion is found."""
LEAST_PX = 1.0
"""Motion of the image in a window below which the next search starts from all directions, and nothing is known [px]."""
STARTS_PX = (2.0, 5.0, 10.0)
"""Motions of the image in a window that are tried in eight directions [px]."""
COARSE_PX = 2.0
FINE_PX = 1.0
"""Standard deviations of the Gaussians that smooth the image of warped events [px]: to compare starts, and to refine.
"""
TOLERANCE_PX = 0.02
"""A search ends when its steps move the image by less than this in the window [px]."""
EVALUATIONS = 120
"""Largest number of images of warped events per search."""
BEST = 2
"""Number of starts that are refined."""
PAD = 16
"""Border of the image of warped events [px]."""


@dataclass(frozen=True, slots=True)
class Window:
    """A time window and the camera's angular velocity in it."""

    start_us: int
    """Start [us]."""
    length_us: int
    """Length [us]."""
    rates: tuple[float, float, float]
    """Angular velocity of the camera at the middle [rad/s]."""
    acceleration: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Angular acceleration of the camera [rad/s²]."""

    @property
    def rotation(self) -> CameraRotation:
        """Rotation of the camera about the middle."""
        return CameraRotation(self.rates, self.acceleration, self.middle_us)

    def moves_px(self, camera: Camera) -> float:
        """Return the motion of the image in the window [px]."""
        x, y, z = self.rates
        speed = math.hypot(camera.fy * x, camera.fx * y) + 0.25 * camera.width * abs(z)
        return speed * self.length_us * 1e-6

    @property
    def middle_us(self) -> int:
        """Middle [us]."""
        return self.start_us + self.length_us // 2


def still_encoder(t_first: int, t_last: int) -> Encoder:
    """Return the encoder of a prism that does not turn; with an apex of 0 it stands for no prism."""
    return Encoder(np.array([t_first - 1_000_000, t_last + 1_000_000], np.int64), np.zeros(2))


def find_motion(
    recording: Recording, camera: Camera, *, device: Any = "cpu", progress: Progress | None = None
) -> list[Window]:
    """Return the angular velocity of the camera in windows that overlap by half, from the first event to the last.

    The windows are as long as the image takes to move by :data:`MOTION_PX`. An angular velocity of 0 means that none
    was found.
    """
    first = recording.events.t_first
    last = recording.events.t_last
    search = _Search(camera, device)
    windows: list[Window] = []
    start = first
    length = min(FIRST_US, max(last - first, 1))
    while not windows or start < last - windows[-1].length_us // 2:
        events = recording.events.between(start, start + length)
        # The motion of the window before is a good start, if there was any.
        last_rates = None
        if windows and windows[-1].moves_px(camera) > LEAST_PX:
            last_rates = windows[-1].rates
        window = Window(start, length, search.run(events, start, length, last_rates))

        speed = window.moves_px(camera) / length  # px per microsecond
        length = round(float(np.clip(MOTION_PX / max(speed, 1e-9), *WINDOW_US)))

        # If the first window was too short to find a motion, try once more with a longer one.
        small = window.moves_px(camera) < 2.0 * LEAST_PX
        longer = length >= 2 * window.length_us and last - first > window.length_us
        if not windows and small and longer:
            continue
        windows.append(window)
        start += window.length_us // 2
        if progress is not None:
            progress("finding the motion", min(1.0, (start - first) / max(last - first, 1)))
    return _with_acceleration(windows)


def _with_acceleration(windows: list[Window]) -> list[Window]:
    """Return the windows with the change of the angular velocity between those before and after."""
    if len(windows) < 2:
        return windows
    t = np.array([window.middle_us for window in windows]) * 1e-6
    rates = np.array([window.rates for window in windows])
    change = np.gradient(rates, t - t[0], axis=0)
    accelerated = []
    for window, (x, y, z) in zip(windows, change.tolist(), strict=True):
        accelerated.append(replace(window, acceleration=(x, y, z)))
    return accelerated


def motion_of(windows: list[Window]) -> CameraMotion:
    """Return the rotation through all windows; time 0 is the start of the first."""
    origin = windows[0].start_us
    rows = []
    for window in windows:
        middle_s = (window.middle_us - origin) * 1e-6
        rows.append((middle_s, *window.rates))
    # The last speed holds for another second.
    rows.append((middle_s + 1.0, *window.rates))
    return CameraMotion(np.array(rows))


class _Search:
    """Contrast maximisation over the angular velocity in one window."""

    def __init__(self, camera: Camera, device: Any) -> None:
        self._camera = camera
        self._device = device
        self._model = ExactModel(camera, Prism(0.0))
        canvas = CanvasShape(camera.width, camera.height, PAD, 1.0, False, Vote.BILINEAR)
        self._votes = Votes(canvas, device)
        self._meters = {}
        for smoothing in (COARSE_PX, FINE_PX):
            self._meters[smoothing] = SharpnessMeter(
                canvas, Sharpness.VARIANCE, smoothing=smoothing, device=device
            )

    def run(
        self, events: Events, start: int, length: int, last: tuple[float, float, float] | None
    ) -> tuple[float, float, float]:
        """Return the angular velocity [rad/s] for which the image of warped events is sharpest."""
        from scipy.optimize import minimize

        if len(events) < LEAST_EVENTS:
            return (0.0, 0.0, 0.0)
        middle = start + length // 2
        stride = math.ceil(len(events) / MOST_EVENTS)
        encoder = still_encoder(start, start + length)
        arrays = upload_events(events[::stride], encoder, self._device, middle_us=middle)
        unit = 1e6 / (self._camera.fx * length)  # moves the image by one pixel in the window

        def cost(rates: NDArray[np.float64], smoothing: float = FINE_PX) -> float:
            x, y, z = (unit * rates).tolist()
            rotation = CameraRotation((x, y, z), middle_us=middle)
            meter = self._meters[smoothing]
            self._votes.clear()
            self._votes.add_events(self._model, arrays, camera_rotation=rotation)
            self._votes.read(meter.image)
            return -meter.measure()

        starts = self._starts() if last is None else []
        starts.append(np.zeros(3))
        if last is not None:
            starts.append(np.array(last) / unit)
        starts.sort(key=lambda rates: cost(rates, COARSE_PX))

        simplex = np.vstack([np.zeros(3), 1.5 * np.eye(3)])
        runs: list[Any] = []
        for at in starts[:BEST]:
            options: Any = {
                "initial_simplex": at + simplex,
                "xatol": TOLERANCE_PX,
                "fatol": 0.0,
                "maxfev": EVALUATIONS,
            }
            runs.append(minimize(cost, at, method="Nelder-Mead", options=options))
        best = min(runs, key=lambda run: float(run.fun))
        x, y, z = (unit * best.x).tolist()
        return x, y, z

    @staticmethod
    def _starts() -> list[NDArray[np.float64]]:
        angles = np.arange(8) * (math.tau / 8)
        return [size * np.array([np.cos(a), np.sin(a), 0.0]) for size in STARTS_PX for a in angles]
