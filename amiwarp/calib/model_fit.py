"""Fit of the models with fewer parameters to the exact model, at the events of a scene.

The blur that remains even with the exact model is estimated too: by encoder noise, clock resolution and latency jitter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.optics.models.angles import wrap_angle
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.comparison import rms
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.models.several import compensate_by_each
from amiwarp.optics.prism import as_wedge
from amiwarp.results.calibration import Calibration
from amiwarp.results.parameters import ParameterSpace, values_of
from amiwarp.results.space_setup import make_space

Vector = NDArray[np.float64]

SAMPLED = 1_000
"""Number of events at which models are compared: enough for an rms error accurate to 3 %."""
SLOPE_PX = 0.25
"""Step of the finite differences in the search vector [px]."""
TURN_ANGLES = 4
"""Number of prism angles that give the mean and the first harmonic of a motion. Four keep the ellipse model's error to
0.3 %: higher harmonics fall off quickly."""
TURN = math.tau * np.arange(TURN_ANGLES)[:, None] / TURN_ANGLES
"""These prism angles, from the event's own [rad], shape ``(TURN_ANGLES, 1)``."""
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

    xy: Vector
    """Pixel coordinates of the events [px], shape ``(n, 2)``."""
    theta: Vector
    """Prism angle of each event according to the encoder, wrapped to a turn [rad], shape ``(n,)``."""
    speed: Vector
    """Speed of the prism at each event [rad/us], shape ``(n,)``."""

    @classmethod
    def of(cls, events: Events, encoder: Encoder, most: int = SAMPLED) -> Places:
        """Return about ``most`` evenly thinned events with their prism angles and speeds."""
        every = max(1, len(events) // most)
        some = events[::every]
        xy = np.stack([some.x, some.y], axis=1).astype(np.float64)
        theta = wrap_angle(encoder.angle_at(some.t))
        rad_per_s = encoder.speed_at(some.t)
        return cls(xy, theta, rad_per_s * 1e-6)

    def compensated(self, model: Model) -> Vector:
        """Return the events' compensated coordinates [px], shape (n, 2)."""
        (moved,) = compensate_by_each([model], self.xy, self.theta)
        return moved

    def path(self, model: Model) -> Vector:
        """Return the events' compensated coordinates at :data:`TURN` [px], shape (TURN_ANGLES, n, 2)."""
        return compensate_by_each([model] * len(TURN), self.xy, self.theta + TURN)

    def distance(self, model: Model, other: Model, *, remove_lag: bool = False) -> float:
        """Return the rms distance of two models at the events [px].

        With ``remove_lag``, a constant angle between the models does not count.
        """
        away = self.compensated(model) - self.compensated(other)
        if remove_lag:
            # Project out the motion by an angle. The factor's unit does not matter.
            angles = self.theta + np.array([[0.01], [-0.01]])
            later, earlier = compensate_by_each([model, model], self.xy, angles)
            by_lag = later - earlier
            lag = np.nansum(away * by_lag) / np.nansum(by_lag**2)
            away = away - by_lag * lag
        return rms(away)


def motion_per_angle(path: Vector) -> float:
    """Return how far compensated events move per change of the prism angle [px rms per rad].

    ``path`` holds their coordinates at :data:`TURN` [px], shape (TURN_ANGLES, n, 2). The result is exact for the first
    harmonic of the motion, next to which the others are small.
    """
    across = 2.0 * math.sin(TURN[1, 0])
    return rms(path[1] - path[-1]) / across


def scales(
    path: Vector,
    sample: Places,
    exact: Calibration,
    speed: float,
) -> dict[str, float]:
    """Return how far events move per unit of each of the exact model's parameters, to first order in the apex [px rms].

    ``path`` holds the coordinates of the sample's events at :data:`TURN` [px], shape (TURN_ANGLES, n, 2). ``speed`` is
    the mean speed of the prism [rad/us].
    """
    moved = rms(path[0] - sample.xy)
    turned = motion_per_angle(path)
    found = exact.parameters
    index = found.get("index", exact.prism.index)
    return {
        "apex": moved / found["apex"],
        "phase": turned,
        "clock_offset": turned * abs(speed),
        "index": moved / (index - 1.0),
    }


def timing_blur(path: Vector, noise: float, speed: float) -> float:
    """Return the blur [px rms] by encoder noise [rad], clock resolution and latency jitter at a prism speed [rad/us].

    ``path`` holds the compensated coordinates of n events at :data:`TURN` [px], shape (TURN_ANGLES, n, 2).
    """
    timing_us = math.hypot(CLOCK_US, LATENCY_JITTER_US)
    blur_rad = math.hypot(noise, speed * timing_us)
    return motion_per_angle(path) * blur_rad


def encoder_noise(encoder: Encoder) -> float:
    """Return the standard deviation of an encoder's angle noise [rad], rounding included; 0 for less than 4 samples.

    Samples are compared with the interpolation between their two neighbours: at most about :data:`SAMPLED`, however
    long the recording is. The median magnitude of the differences gives the standard deviation of white noise.
    """
    t = encoder.t
    angle = encoder.angle
    if len(t) < 4:
        return 0.0
    step = max(1, len(t) // SAMPLED)
    first = slice(0, len(t) - 2, step)
    second = slice(1, len(t) - 1, step)
    third = slice(2, len(t), step)
    middle = (t[second] - t[first]) / (t[third] - t[first])
    interpolated = middle * (angle[third] - angle[first])
    excess = angle[second] - angle[first] - interpolated

    # The three samples have the same noise.
    variance = 1.0 + middle**2 + (1.0 - middle) ** 2
    magnitude = np.abs(excess) / np.sqrt(variance)
    return float(np.median(magnitude)) / 0.6745


def candidate_space(
    model: str,
    exact: Calibration,
    free: tuple[str, ...],
    *,
    rad_per_us: float,
    duration_us: float,
    pixels: Mapping[str, float] | None = None,
) -> ParameterSpace:
    """Return the parameter space of ``model`` about the exact calibration: size, phase and ``free`` are free.

    ``rad_per_us`` is the mean speed of the prism [rad/us], ``duration_us`` the duration of the events [us]. ``pixels``
    tells how far events move per unit of each free parameter of the exact model [px rms]; None: it is measured.
    """
    found = exact.parameters
    apex = found["apex"]
    index = found.get("index", exact.prism.index)
    prism = replace(as_wedge(exact.prism), apex=apex, index=index)
    kind = MODELS[model]
    size = kind.SIZE
    start = values_of(model, found)
    start[size] = kind.size_from_apex(apex, prism)
    start["phase"] = math.remainder(found["phase"], math.tau)
    if pixels is not None:
        px_per_size = pixels["apex"] * prism.apex / start[size]
        pixels = {**pixels, size: px_per_size}
    return make_space(
        model,
        exact.camera,
        prism,
        free=(size, "phase", *free),
        start=start,
        bounds={size: (0.0, 2.0 * start[size])},
        rad_per_us=rad_per_us,
        duration_us=duration_us,
        middle_us=exact.middle_us or 0,
        pixels=pixels,
    )


@dataclass(frozen=True)
class LinearMotion:
    """Motion of n events to first order about a point of a parameter space of k dimensions."""

    space: ParameterSpace
    """The parameter space."""
    v: Vector
    """The point: a search vector [px], shape ``(k,)``."""
    at: Vector
    """Compensated coordinates of the events at the point [px], shape ``(n, 2)``."""
    slopes: Vector
    """Their change per entry of the search vector [px/px], shape ``(k, n, 2)``."""


def linear_motions(spaces: Sequence[ParameterSpace], sample: Places) -> list[LinearMotion]:
    """Return the motion of events about the start of each parameter space, by finite differences.

    The motion is nearly linear in size and phase, which are Cartesian. The differences by other parameters take a step
    both ways: a clock offset turns the orbits, and a tilt that moves events by :data:`SLOPE_PX` is large.
    """
    # All models of all spaces are computed at once.
    starts = [space.to_vector(space.start) for space in spaces]
    models: list[Model] = []
    drifts: list[list[float]] = []
    ends: list[int] = []
    for space, v in zip(spaces, starts, strict=True):
        step = SLOPE_PX * np.eye(len(v))
        ahead = v + step
        back = v - step[2:]
        for near in (v, *ahead, *back):
            values = space.to_values(near)
            models.append(space.build(values))
            drifts.append([space.drift(values)])
        ends.append(len(models))
    drifted = np.array(drifts) * sample.speed
    moved = compensate_by_each(models, sample.xy, sample.theta + drifted)

    found = []
    of_spaces = np.split(moved, ends[:-1])
    for space, v, part in zip(spaces, starts, of_spaces, strict=True):
        at = part[0]
        ahead = part[1 : 1 + len(v)]
        back = part[1 + len(v) :]
        slopes = (ahead - at) / SLOPE_PX
        slopes[2:] = (ahead[2:] - back) / (2.0 * SLOPE_PX)
        found.append(LinearMotion(space, v, at, slopes))
    return found


def fit(
    motions: Sequence[LinearMotion],
    target: Vector,
    sample: Places,
) -> list[tuple[dict[str, float], float]]:
    """Fit the parameters of several models to the compensated coordinates ``target`` [px], shape (n, 2).

    Return the parameters and the remaining distance [px rms] of each model. The phase is fitted too, which removes a
    constant lag. The displacement is nearly linear: one Gauss-Newton step is accurate to 0.00001 px. No space has a
    free drift (``clock_offset`` or ``rpm``), which would turn the angles of ``sample``.
    """
    best = []
    models = []
    for motion in motions:
        away = motion.at - target
        fields = _finite(np.stack([away, *motion.slopes]))
        left = fields[0]
        design = fields[1:]
        step = np.linalg.solve(design @ design.T, design @ left)
        values = motion.space.to_values(motion.v - step)
        best.append(values)
        models.append(motion.space.build(values))

    fits = []
    moved = compensate_by_each(models, sample.xy, sample.theta)
    for values, at in zip(best, moved, strict=True):
        fits.append((values, rms(at - target)))
    return fits


def _finite(fields: Vector) -> Vector:
    """Return fields of motion, shape (k, n, 2), in rows of 2 n numbers, without the events that one of them lacks."""
    total = np.sum(fields, axis=0)
    valid = np.isfinite(total).all(axis=1)
    if not valid.all():
        fields = fields[:, valid]
    return fields.reshape(len(fields), -1)


def ellipse_error(path: Vector) -> float:
    """Return the error of the ellipse model [px rms]: the second and higher harmonics of the motion ``path``.

    ``path`` holds the compensated coordinates of n events [px] at :data:`TURN`, shape (TURN_ANGLES, n, 2).
    """
    # mean and first harmonic of the motion at each event's own angle, the first of the turn
    weights = 1.0 + 2.0 * np.cos(TURN[:, 0])
    ellipse = np.einsum("k,knx->nx", weights, path) / len(TURN)
    return rms(path[0] - ellipse)


def independent_directions(motion: LinearMotion) -> Vector:
    """Return search directions along which each parameter moves events by 1 px in ways that size and phase cannot.

    The rows are search vectors, shape (k, k). The first two are unit vectors along size and phase. Each other row is a
    unit vector, minus the size and phase that best reproduce its motion of events, scaled so that the remaining motion
    is one pixel (rms).
    """
    fields = _finite(motion.slopes)
    size_and_phase = fields[:2]
    directions = np.eye(len(fields))
    products = fields @ size_and_phase.T
    for k in range(2, len(fields)):
        reproduced, *_ = np.linalg.lstsq(products[:2], products[k], rcond=None)
        left = fields[k] - reproduced @ size_and_phase
        moved_px = float(np.sqrt(2.0 * np.mean(left**2)))
        directions[k, :2] = -reproduced
        directions[k] /= max(moved_px, 1e-9)
    return directions
