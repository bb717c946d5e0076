"""Rotation of a plain event camera over time, by contrast maximisation in successive windows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

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


Rates: TypeAlias = tuple[float, float, float]
"""Angular velocity about the camera's axes [rad/s], or its change [rad/s²]."""


@dataclass(frozen=True, slots=True)
class Window:
    """A time window and the camera's angular velocity in it."""

    start_us: int
    """Start [us]."""
    length_us: int
    """Length [us]."""
    rates: Rates
    """Angular velocity of the camera at the middle [rad/s]."""
    acceleration: Rates = (0.0, 0.0, 0.0)
    """Angular acceleration of the camera [rad/s²]."""

    @property
    def rotation(self) -> CameraRotation:
        """Rotation of the camera about the middle."""
        return CameraRotation(self.rates, self.acceleration, self.middle_us)

    def motion_px(self, camera: Camera) -> float:
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
    t_first = recording.events.t_first
    t_last = recording.events.t_last
    duration_us = t_last - t_first
    search = _Search(camera, device)
    windows: list[Window] = []
    start_us = t_first
    length_us = min(FIRST_US, max(duration_us, 1))
    while not windows or start_us < t_last - windows[-1].length_us // 2:
        events = recording.events.between(start_us, start_us + length_us)
        # The motion of the window before is a good start, if there was any.
        rates_before = None
        if windows and windows[-1].motion_px(camera) > LEAST_PX:
            rates_before = windows[-1].rates
        rates = search.run(events, start_us, length_us, rates_before)
        window = Window(start_us, length_us, rates)

        px_per_us = window.motion_px(camera) / length_us
        length_us = round(float(np.clip(MOTION_PX / max(px_per_us, 1e-9), *WINDOW_US)))

        # If the first window was too short to find a motion, try once more with a longer one.
        hardly_moves = window.motion_px(camera) < 2.0 * LEAST_PX
        can_be_longer = length_us >= 2 * window.length_us and duration_us > window.length_us
        if not windows and hardly_moves and can_be_longer:
            continue
        windows.append(window)
        start_us += window.length_us // 2
        if progress is not None:
            share = (start_us - t_first) / max(duration_us, 1)
            progress("finding the motion", min(1.0, share))
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
        self, events: Events, start_us: int, length_us: int, rates_before: Rates | None
    ) -> Rates:
        """Return the angular velocity for which the image of warped events of a window is sharpest.

        ``rates_before``: the angular velocity in the window before, or None if that is no good start.
        """
        if len(events) < LEAST_EVENTS:
            return (0.0, 0.0, 0.0)
        middle_us = start_us + length_us // 2
        stride = math.ceil(len(events) / MOST_EVENTS)
        encoder = still_encoder(start_us, start_us + length_us)
        arrays = upload_events(events[::stride], encoder, self._device, middle_us=middle_us)
        # Rates are searched in units that move the image by one pixel in the window.
        unit = 1e6 / (self._camera.fx * length_us)

        def cost(rates_px: NDArray[np.float64], smoothing: float = FINE_PX) -> float:
            x, y, z = (unit * rates_px).tolist()
            rotation = CameraRotation((x, y, z), middle_us=middle_us)
            meter = self._meters[smoothing]
            self._votes.clear()
            self._votes.add_events(self._model, arrays, camera_rotation=rotation)
            self._votes.read(meter.image)
            return -meter.measure()

        starts = [np.zeros(3)]
        if rates_before is None:
            starts = [*_starts(), *starts]
        else:
            starts.append(np.array(rates_before) / unit)
        starts.sort(key=lambda rates_px: cost(rates_px, COARSE_PX))

        optima = [_refined(cost, start) for start in starts[:BEST]]
        best = min(optima, key=lambda optimum: float(optimum.fun))
        x, y, z = (unit * best.x).tolist()
        return x, y, z


def _starts() -> list[NDArray[np.float64]]:
    """Return the starts of a search without a known motion, in eight directions [px in the window]."""
    starts = []
    for size in STARTS_PX:
        for angle in np.arange(8) * (math.tau / 8):
            starts.append(size * np.array([np.cos(angle), np.sin(angle), 0.0]))
    return starts


def _refined(cost: Callable[..., float], start: NDArray[np.float64]) -> Any:
    """Return SciPy's result of a search for the lowest cost from a start [px in the window]."""
    from scipy.optimize import minimize

    simplex = np.vstack([np.zeros(3), 1.5 * np.eye(3)])
    options: Any = {
        "initial_simplex": start + simplex,
        "xatol": TOLERANCE_PX,
        "fatol": 0.0,
        "maxfev": EVALUATIONS,
    }
    return minimize(cost, start, method="Nelder-Mead", options=options)
