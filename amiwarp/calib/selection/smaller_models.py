"""What a smaller model of the ladder makes of the exact answer, where the scene has its events."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.parameters import ParameterSpace, make_space, size_name

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.result import Calibration
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.optics.models import Model

SAMPLED = 5_000
"""Events by which a model's error is weighted: its rms is then good to 1 %."""
SLOPE_PX = 0.25
STEPS = 2
"""Gauss and Newton's: the displacement is all but linear in the vector, one is within 0.00001 px already."""
QUANTISATION_PX = 1.0 / math.sqrt(12.0)
CLOCK_US = 1.0 / math.sqrt(12.0)
"""Of time stamps in whole microseconds."""
LATENCY_JITTER_US = 30.0
"""Of a good sensor in good light. A recording does not tell it apart from the rest of its blur."""
SHARE = 0.1
"""The budget, as a share of the blur that is there anyway."""
ONLY_EXACT = ("apex", "index", "tilt_x", "tilt_y")


@dataclass(frozen=True)
class Places:
    """Events, evenly thinned: their pixels are where this scene has events, and when."""

    xy: NDArray[np.float64]
    """[px], shape (n, 2)."""
    theta: NDArray[np.float64]
    """The encoder's angle [rad], shape (n,)."""
    speed: NDArray[np.float64]
    """Of the prism [rad/us], shape (n,)."""

    @classmethod
    def of(cls, events: Events, encoder: Encoder) -> Places:
        some = events[:: max(1, len(events) // SAMPLED)]
        xy = np.stack([some.x, some.y], axis=1).astype(np.float64)
        return cls(xy, encoder.angle_at(some.t), encoder.speed_at(some.t) * 1e-6)

    def moved(self, model: Model, ahead: float | NDArray[np.float64] = 0.0) -> NDArray[np.float64]:
        """Where the model puts them [px], shape (n, 2), with the prism ``ahead`` of the encoder [rad]."""
        return model.compensate_points(self.xy, self.theta + ahead)

    def distance(self, model: Model, other: Model, *, remove_lag: bool = False) -> float:
        """Between two models [px rms over the events]; with ``remove_lag`` but for a constant angle between them."""
        away = self.moved(model) - self.moved(other)
        if remove_lag:
            h = 0.01
            turn = (self.moved(model, h) - self.moved(model, -h)) / (2.0 * h)
            away = away - turn * (np.nansum(away * turn) / np.nansum(turn**2))
        return _rms(away)

    def lever(self, model: Model) -> float:
        """Motion of the events per angle of the prism [px/rad, rms]."""
        h = 0.01
        return _rms(self.moved(model, h) - self.moved(model, -h)) / (2.0 * h)


def _rms(shift: NDArray[np.float64]) -> float:
    squares = np.sum(shift**2, axis=1)
    return float(np.sqrt(np.mean(squares[np.isfinite(squares)])))


def timing_blur(model: Model, places: Places, encoder: Encoder, speed: float) -> float:
    """Blur [px rms] from the encoder's noise, the clock's resolution and a typical jitter of the latency.

    ``speed``: of the prism [rad/us]. The encoder's noise, rounding included, is what neighbouring samples do not
    explain of one: the median of its second differences' magnitudes, for white noise √6 of its deviation.
    """
    noise = encoder_noise(encoder)
    return places.lever(model) * math.hypot(noise, speed * math.hypot(CLOCK_US, LATENCY_JITTER_US))


def encoder_noise(encoder: Encoder) -> float:
    """Standard deviation of the encoder's angles [rad], see :func:`timing_blur`; 0 for fewer than 4 samples."""
    t, angle = encoder.t, encoder.angle
    if len(t) < 4:
        return 0.0
    middle = np.diff(t[:-1]) / (t[2:] - t[:-2])
    excess = angle[1:-1] - angle[:-2] - middle * (angle[2:] - angle[:-2])
    share = 1.0 + middle**2 + (1.0 - middle) ** 2
    return float(np.median(np.abs(excess) / np.sqrt(share))) / 0.6745


def rung_space(
    model: str, exact: Calibration, free: tuple[str, ...], *, rad_per_us: float, duration_us: float
) -> ParameterSpace:
    """The space of one rung about the exact answer, ``free`` beside size and phase."""
    found = exact.parameters
    prism = replace(exact.prism, apex=found["apex"], index=found.get("index", exact.prism.index))
    size = size_name(model)
    start = {n: x for n, x in found.items() if size == "apex" or n not in ONLY_EXACT}
    start[size] = found["apex"] if size == "apex" else prism.deflection
    start["phase"] = math.remainder(found["phase"], math.tau)
    return make_space(
        model, exact.camera, prism, free=(size, "phase", *free), start=start, bounds={size: (0.0, 2.0 * start[size])},
        rad_per_us=rad_per_us, duration_us=duration_us, middle_us=exact.middle_us or 0,
    )  # fmt: skip


def fit(space: ParameterSpace, target: NDArray[np.float64], places: Places) -> tuple[dict[str, float], float]:
    """Parameters that bring a model closest to ``target`` [px], shape (n, 2), and the distance left [px rms].

    Size and phase are moved, so a constant lag is taken out.
    """

    def away(v: NDArray[np.float64]) -> NDArray[np.float64]:
        return places.moved(space.build(space.to_values(v))) - target

    v = space.to_vector(space.start)
    for _ in range(STEPS):
        left = away(v)
        steps = SLOPE_PX * np.eye(len(v))
        slopes = [(away(v + h) - away(v - h)) / (2.0 * SLOPE_PX) for h in steps]
        valid = np.isfinite(sum(slopes, left)).all(axis=1)
        design = np.stack([slope[valid].ravel() for slope in slopes], axis=1)
        v = v - np.linalg.lstsq(design, left[valid].ravel(), rcond=None)[0]
    return space.to_values(v), _rms(away(v))


def apart(space: ParameterSpace, v: NDArray[np.float64], places: Places) -> NDArray[np.float64]:
    """Directions that move events by a pixel each, those past size and phase by what these two cannot follow.

    Rows of vectors of the space, shape (n, n): the identity's first two, then each entry less the size and phase that
    come nearest to its motion, made as much longer as that motion is then smaller.
    """
    n = len(v)

    def at(shift: NDArray[np.float64]) -> NDArray[np.float64]:
        values = space.to_values(v + shift)
        return places.moved(space.build(values), places.speed * space.drift(values))

    fields = np.array([at(h) - at(-h) for h in SLOPE_PX * np.eye(n)]) / (2.0 * SLOPE_PX)
    fields = fields[:, np.isfinite(fields).all(axis=(0, 2))].reshape(n, -1)
    directions = np.eye(n)
    for k in range(2, n):
        follow = np.linalg.lstsq(fields[:2].T, fields[k], rcond=None)[0]
        left = fields[k] - follow @ fields[:2]
        directions[k, :2] = -follow
        directions[k] /= max(float(np.sqrt(2.0 * np.mean(left**2))), 1e-9)
    return directions
