"""Parameters to sharpness, on the device: buffers are allocated once, nothing per call but the result."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib.parameters import MOTION, build_model
from amiwarp.iwe import CanvasShape, Votes, upload_events
from amiwarp.sharpness import Sharpness, SharpnessMeter
from amiwarp.turning import border

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from amiwarp.calib.parameters import Space
    from amiwarp.events import Events

MOTION_ROOM_PX = 16.0


class Objective:
    """Sharpness of the IWE of a set of events as a function of the free parameters; counts its evaluations."""

    def __init__(
        self,
        space: Space,
        events: Events,
        theta: NDArray[np.float64],
        slope: NDArray[np.float64] | None,
        *,
        kind: Sharpness,
        smoothing: float,
        scale: float = 1.0,
        per_polarity: bool = False,
        device: Any = "cpu",
    ) -> None:
        """``theta``: encoder's angle of each event [rad]; ``slope``: its change per unit of the drifting parameter.

        ``smoothing``: standard deviation [sensor px]; ``scale``: canvas pixels per sensor pixel.
        """
        self.space = space
        self.evaluations = 0
        middle = space.middle_us if space.moving else None
        self._arrays = upload_events(events, theta, device, slope=slope, middle_us=middle)
        camera = space.camera
        # the paper's J is left as it was written
        dither = kind is not Sharpness.PAPER_J
        canvas = CanvasShape(camera.width, camera.height, padding(space), scale, per_polarity, dither=dither)
        self._votes = Votes(canvas, device)
        self._meter = SharpnessMeter(canvas, kind, smoothing=smoothing * scale, device=device)

    def _vote(self, values: dict[str, float]) -> None:
        self._votes.clear()
        drift, turning = self.space.drift(values), self.space.turning(values)
        self._votes.add_events(self.space.build(values), self._arrays, drift=drift, turning=turning)

    def values(self, values: dict[str, float]) -> float:
        """Sharpness at parameter values."""
        self.evaluations += 1
        self._vote(values)
        self._votes.read(self._meter.image)
        return self._meter.measure()

    def __call__(self, v: NDArray[np.float64]) -> float:
        """Sharpness at a vector of the space [px]."""
        return self.values(self.space.to_values(v))

    def image(self, values: dict[str, float]) -> NDArray[np.float32]:
        """The IWE at parameter values, shape (layers, rows, columns), padding included."""
        self._vote(values)
        return self._votes.take()


def padding(space: Space) -> int:
    """Border [px] that no event of the image can cross, at the largest size and any phase, or as far as it turns."""
    largest = {n: space.high[n] for n in space.names if n == space.size_name}
    # a search that goes as far as its bounds is lost anyway: twice the start's motion, and a little, is room enough
    faster = {n: 2.0 * abs(space.start.get(n, 0.0)) for n in MOTION if n in space.start}
    room = MOTION_ROOM_PX if space.moving else 0.0
    return math.ceil(reach(space, {**space.start, **largest, **faster}) + room) + 2


def reach(space: Space, values: Mapping[str, float]) -> float:
    """How far events are moved at ``values``, at most [px], by the prism and by the camera's turning."""
    camera = space.camera
    kind = "exact" if space.model == "ellipse" else space.model
    at = border(camera)
    theta = np.repeat(np.arange(16) * (np.pi / 8), len(at))
    xy = np.tile(at, (16, 1))
    moved = build_model(kind, camera, space.prism, values).compensate_points(xy, theta) - xy
    radius = np.linalg.norm(moved[np.isfinite(moved).all(axis=1)], axis=1)
    turned = space.turning(values).reach(camera, space.duration_us * 0.5e-6)
    return float(radius.max(initial=0.0)) + float(np.linalg.norm(turned))
