"""Fit of the models with fewer parameters to the exact model, at the events of a scene.

The module also estimates the blur that remains even with the exact model: by encoder noise, clock resolution and
latency jitter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.calib.parameters import EXACT_PARAMETERS, ParameterSpace, size_name
from amiwarp.calib.space_setup import make_space
from amiwarp.optics.displacement import wrap_angle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.result import Calibration
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.optics.models import Model

SAMPLED = 5_000
"""Number of events at which models are compared: enough for an rms error accurate to 1 %."""
SLOPE_PX = 0.25
"""Step of the finite differences in the search vector [px]."""
STEPS = 2
"""Number of Gauss-Newton steps that fit a model, with the derivatives at the start. The displacement is nearly linear:
one step is accurate to 0.00001 px."""
TURN_ANGLES = 8
"""Number of prism angles that give the mean and the first harmonic of a motion. Higher harmonics fall off quickly."""
QUANTISATION_PX = 1.0 / math.sqrt(12.0)
"""Standard deviation of the error from rounding coordinates to whole pixels [px]."""
CLOCK_US = 1.0 / math.sqrt(12.0)
"""Standard deviation of the error from rounding times to whole microseconds [us]."""
LATENCY_JITTER_US = 30.0
"""Assumed standard deviation of the latency of a good sensor in good light [us]. It cannot be measured from a
recording."""
SHARE = 0.1
"""Default limit of the model error, as a share of the blur by quantisation and timing."""


@dataclass(frozen=True)
class Places:
    """Evenly thinned events at which models are compared.

    A difference between models therefore counts where and when the scene has events.
    """

    xy: NDArray[np.float64]
    """Pixel coordinates of the events [px], shape ``(n, 2)``."""
    theta: NDArray[np.float64]
    """Prism angle of each event according to the encoder [rad], shape ``(n,)``."""
    speed: NDArray[np.float64]
    """Speed of the prism at each event [rad/us], shape ``(n,)``."""

    @classmethod
    def of(cls, events: Events, encoder: Encoder) -> Places:
        """Return about :data:`SAMPLED` evenly thinned events with their prism angles and speeds."""
        some = events[:: max(1, len(events) // SAMPLED)]
        xy = np.stack([some.x, some.y], axis=1).astype(np.float64)
        return cls(xy, encoder.angle_at(some.t), encoder.speed_at(some.t) * 1e-6)

    def compensated(self, model: Model, ahead: float | NDArray[np.float64] = 0.0) -> NDArray[np.float64]:
        """Return the events' compensated coordinates [px], shape (n, 2), with ``ahead`` [rad] added to the angles."""
        theta = _on_cpu(self.theta + ahead) if np.any(ahead) else self._given_theta
        return np.asarray(model.compensate_points(self._given_xy, theta).numpy(), np.float64)

    @cached_property
    def _given_xy(self) -> Any:
        return wp.array(self.xy, dtype=wp.vec2, device="cpu")

    @cached_property
    def _given_theta(self) -> Any:
        return _on_cpu(self.theta)

    def distance(self, model: Model, other: Model, *, remove_lag: bool = False) -> float:
        """Return the rms distance of two models at the events [px].

        With ``remove_lag``, a constant angle between the models does not count.
        """
        away = self.compensated(model) - self.compensated(other)
        if remove_lag:
            h = 0.01
            per_angle = (self.compensated(model, h) - self.compensated(model, -h)) / (2.0 * h)
            away = away - per_angle * (np.nansum(away * per_angle) / np.nansum(per_angle**2))
        return _rms(away)

    def motion_per_angle(self, model: Model) -> float:
        """Return how far compensated events move per change of the prism angle [px rms per rad]."""
        h = 0.01
        return _rms(self.compensated(model, h) - self.compensated(model, -h)) / (2.0 * h)


def _on_cpu(theta: NDArray[np.float64]) -> Any:
    """Return angles [rad] as a Warp array, for CPU launches: a few thousand events are faster there than on a GPU."""
    return wp.array(wrap_angle(theta), dtype=float, device="cpu")


def _rms(shift: NDArray[np.float64]) -> float:
    squares = np.sum(shift**2, axis=1)
    return float(np.sqrt(np.mean(squares[np.isfinite(squares)])))


def timing_blur(model: Model, sample: Places, encoder: Encoder, speed: float) -> float:
    """Return the blur [px rms] by encoder noise, clock resolution and latency jitter at a prism speed [rad/us]."""
    noise = encoder_noise(encoder)
    return sample.motion_per_angle(model) * math.hypot(noise, speed * math.hypot(CLOCK_US, LATENCY_JITTER_US))


def encoder_noise(encoder: Encoder) -> float:
    """Return the standard deviation of an encoder's angle noise [rad], rounding included; 0 for less than 4 samples.

    Each sample is compared with the interpolation between its two neighbours. The median magnitude of the differences
    gives the standard deviation of white noise.
    """
    t, angle = encoder.t, encoder.angle
    if len(t) < 4:
        return 0.0
    middle = np.diff(t[:-1]) / (t[2:] - t[:-2])
    excess = angle[1:-1] - angle[:-2] - middle * (angle[2:] - angle[:-2])
    share = 1.0 + middle**2 + (1.0 - middle) ** 2
    return float(np.median(np.abs(excess) / np.sqrt(share))) / 0.6745


def candidate_space(
    model: str, exact: Calibration, free: tuple[str, ...], *, rad_per_us: float, duration_us: float
) -> ParameterSpace:
    """Return the parameter space of ``model`` about the exact calibration: size, phase and ``free`` are free.

    ``rad_per_us`` is the mean speed of the prism [rad/us], ``duration_us`` the duration of the events [us].
    """
    found = exact.parameters
    prism = replace(exact.prism, apex=found["apex"], index=found.get("index", exact.prism.index))
    size = size_name(model)
    start = {n: x for n, x in found.items() if size == "apex" or n not in EXACT_PARAMETERS}
    start[size] = found["apex"] if size == "apex" else prism.deflection
    start["phase"] = math.remainder(found["phase"], math.tau)
    return make_space(
        model, exact.camera, prism, free=(size, "phase", *free), start=start, bounds={size: (0.0, 2.0 * start[size])},
        rad_per_us=rad_per_us, duration_us=duration_us, middle_us=exact.middle_us or 0,
    )  # fmt: skip


def fit(space: ParameterSpace, target: NDArray[np.float64], sample: Places) -> tuple[dict[str, float], float]:
    """Fit a model's parameters to the compensated coordinates ``target`` [px], shape (n, 2).

    Return the parameters and the remaining distance [px rms]. The phase is fitted too, which removes a constant lag.
    """

    def away(v: NDArray[np.float64]) -> NDArray[np.float64]:
        return sample.compensated(space.build(space.to_values(v))) - target

    v = space.to_vector(space.start)
    left = away(v)
    slopes = [(away(v + h) - left) / SLOPE_PX for h in SLOPE_PX * np.eye(len(v))]
    valid = np.isfinite(sum(slopes, left)).all(axis=1)
    design = np.stack([slope[valid].ravel() for slope in slopes])
    for _ in range(STEPS):
        v = v - np.linalg.solve(design @ design.T, design @ np.nan_to_num(left[valid]).ravel())
        left = away(v)
    return space.to_values(v), _rms(left)


def ellipse_error(model: Model, sample: Places) -> float:
    """Return the error of the ellipse model at the events [px rms]: the second and higher harmonics of the motion."""
    turn = math.tau * np.arange(TURN_ANGLES) / TURN_ANGLES
    xy, angles = np.repeat(sample.xy, len(turn), axis=0), (sample.theta[:, None] + turn).ravel()
    path = model.compensate_points(xy, angles).reshape(-1, len(turn), 2)
    # mean and first harmonic of the motion at each event's own angle, the first of the turn
    ellipse = np.mean(path * (1.0 + 2.0 * np.cos(turn))[:, None], axis=1)
    return _rms(path[:, 0] - ellipse)


def independent_directions(space: ParameterSpace, v: NDArray[np.float64], sample: Places) -> NDArray[np.float64]:
    """Return search directions along which each parameter moves events by 1 px in ways that size and phase cannot.

    The rows are search vectors, shape (n, n). The first two are unit vectors along size and phase. Each other row is a
    unit vector, minus the size and phase that best reproduce its motion of events, scaled so that the remaining motion
    is one pixel (rms).
    """
    n = len(v)

    def at(shift: NDArray[np.float64]) -> NDArray[np.float64]:
        values = space.to_values(v + shift)
        return sample.compensated(space.build(values), sample.speed * space.drift(values))

    fields = np.array([at(h) - at(-h) for h in SLOPE_PX * np.eye(n)]) / (2.0 * SLOPE_PX)
    fields = fields[:, np.isfinite(fields).all(axis=(0, 2))].reshape(n, -1)
    directions = np.eye(n)
    products = fields @ fields[:2].T
    for k in range(2, n):
        reproduced = np.linalg.lstsq(products[:2], products[k], rcond=None)[0]
        left = fields[k] - reproduced @ fields[:2]
        directions[k, :2] = -reproduced
        directions[k] /= max(float(np.sqrt(2.0 * np.mean(left**2))), 1e-9)
    return directions
