"""Parameters to sharpness, on the device: buffers are allocated once, nothing per call but the result."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.iwe import CanvasShape, Votes, upload_events
from amiwarp.sharpness import Sharpness, SharpnessMeter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.parameters import Space
    from amiwarp.events import Events


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
        self._count = len(events)
        self._arrays = upload_events(events, theta, device, slope)
        camera = space.camera
        # the paper's J is left as it was written
        dither = kind is not Sharpness.PAPER_J
        canvas = CanvasShape(camera.width, camera.height, padding(space), scale, per_polarity, dither=dither)
        self._votes = Votes(canvas, device)
        self._meter = SharpnessMeter(canvas, kind, smoothing=smoothing * scale, device=device)

    def _vote(self, values: dict[str, float]) -> None:
        self._votes.clear()
        self._votes.add_events(self.space.build(values), self._arrays, self._count, self.space.drift(values))

    def values(self, values: dict[str, float]) -> float:
        """Sharpness at parameter values."""
        self.evaluations += 1
        self._vote(values)
        return self._meter.measure(self._votes.flat)

    def __call__(self, v: NDArray[np.float64]) -> float:
        """Sharpness at a vector of the space [px]."""
        return self.values(self.space.to_values(v))

    def image(self, values: dict[str, float]) -> NDArray[np.float32]:
        """The IWE at parameter values, shape (layers, rows, columns), padding included."""
        self._vote(values)
        return self._votes.take()


def padding(space: Space) -> int:
    """Border [px] that no event of the image can cross, at the largest size and any phase."""
    camera = space.camera
    largest = {**space.start, **{n: space.high[n] for n in space.names if n == space.size_name}}
    kind = "exact" if space.model == "ellipse" else space.model
    border = np.array(
        [(x, y) for x in np.linspace(0, camera.width - 1, 9) for y in np.linspace(0, camera.height - 1, 9)]
    )
    theta = np.repeat(np.arange(16) * (np.pi / 8), len(border))
    xy = np.tile(border, (16, 1))
    from amiwarp.calib.parameters import build_model

    moved = build_model(kind, camera, space.prism, largest).compensate_points(xy, theta) - xy
    reach = np.linalg.norm(moved[np.isfinite(moved).all(axis=1)], axis=1)
    return math.ceil(float(reach.max())) + 2 if len(reach) else 2
