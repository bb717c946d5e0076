"""Fit of the models with fewer parameters to the exact model, at the events of a scene.

The module also estimates the blur that remains even with the exact model: by encoder noise, clock resolution and
latency jitter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib.parameters import EXACT_PARAMETERS, ParameterSpace, size_name
from amiwarp.calib.space_setup import make_space
from amiwarp.optics.displacement import compensate_by_each, rms, wrap_angle

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from amiwarp.calib.result import Calibration
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.optics.models import Model

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

    xy: NDArray[np.float64]
    """Pixel coordinates of the events [px], shape ``(n, 2)``."""
    theta: NDArray[np.float64]
    """Prism angle of each event according to the encoder, wrapped to a turn [rad], shape ``(n,)``."""
    speed: NDArray[np.float64]
    """Speed of the prism at each event [rad/us], shape ``(n,)``."""

    @classmethod
    def of(cls, events: Events, encoder: Encoder, most: int = SAMPLED) -> Places:
        """Return about ``most`` evenly thinned events with their prism angles and speeds."""
        some = events[:: max(1, len(events) // most)]
        xy = np.stack([some.x, some.y], axis=1).astype(np.float64)
        return cls(xy, wrap_angle(encoder.angle_at(some.t)), encoder.speed_at(some.t) * 1e-6)

    def compensated(self, model: Model) -> NDArray[np.float64]:
        """Return the events' compensated coordinates [px], shape (n, 2)."""
        return self.by_each([model])[0]

    def by_each(self, models: Sequence[Model], ahead: NDArray[np.float64] | float = 0.0) -> NDArray[np.float64]:
        """Return the events' coordinates compensated by each model [px], shape (models, n, 2).

        ``ahead`` are angles to add to those of the events [rad], shape (models, 1) or (models, n).
        """
        return compensate_by_each(models, self.xy, self.theta + ahead)

    def path(self, model: Model) -> NDArray[np.float64]:
        """Return the events' compensated coordinates at :data:`TURN` [px], shape (TURN_ANGLES, n, 2)."""
        return self.by_each([model] * len(TURN), TURN)

    def distance(self, model: Model, other: Model, *, remove_lag: bool = False) -> float:
        """Return the rms distance of two models at the events [px].

        With ``remove_lag``, a constant angle between the models does not count.
        """
        away = self.compensated(model) - self.compensated(other)
        if remove_lag:
            later, earlier = self.by_each([model, model], np.array([[0.01], [-0.01]]))
            per_angle = later - earlier
            away = away - per_angle * (np.nansum(away * per_angle) / np.nansum(per_angle**2))
        return rms(away)


def motion_per_angle(path: NDArray[np.float64]) -> float:
    """Return how far compensated events move per change of the prism angle [px rms per rad].

    ``path`` holds their coordinates at :data:`TURN` [px], shape (TURN_ANGLES, n, 2). The result is exact for the first
    harmonic of the motion, next to which the others are small.
    """
    return rms(path[1] - path[-1]) / (2.0 * math.sin(TURN[1, 0]))


def scales(path: NDArray[np.float64], sample: Places, exact: Calibration, speed: float) -> dict[str, float]:
    """Return how far events move per unit of each of the exact model's parameters, to first order in the apex [px rms].

    ``path`` holds the coordinates of the sample's events at :data:`TURN` [px], shape (TURN_ANGLES, n, 2). ``speed`` is
    the mean speed of the prism [rad/us].
    """
    moved, turned = rms(path[0] - sample.xy), motion_per_angle(path)
    found = exact.parameters
    return {
        "apex": moved / found["apex"], "phase": turned, "clock_offset": turned * abs(speed),
        "index": moved / (found.get("index", exact.prism.index) - 1.0),
    }  # fmt: skip


def timing_blur(path: NDArray[np.float64], noise: float, speed: float) -> float:
    """Return the blur [px rms] by encoder noise [rad], clock resolution and latency jitter at a prism speed [rad/us].

    ``path`` holds the compensated coordinates of n events at :data:`TURN` [px], shape (TURN_ANGLES, n, 2).
    """
    return motion_per_angle(path) * math.hypot(noise, speed * math.hypot(CLOCK_US, LATENCY_JITTER_US))


def encoder_noise(encoder: Encoder) -> float:
    """Return the standard deviation of an encoder's angle noise [rad], rounding included; 0 for less than 4 samples.

    Samples are compared with the interpolation between their two neighbours: at most about :data:`SAMPLED`, however
    long the recording is. The median magnitude of the differences gives the standard deviation of white noise.
    """
    t, angle = encoder.t, encoder.angle
    if len(t) < 4:
        return 0.0
    step = max(1, len(t) // SAMPLED)
    (t0, a0), (t1, a1), (t2, a2) = ((t[k : len(t) - 2 + k : step], angle[k : len(t) - 2 + k : step]) for k in range(3))
    middle = (t1 - t0) / (t2 - t0)
    excess = a1 - a0 - middle * (a2 - a0)
    share = 1.0 + middle**2 + (1.0 - middle) ** 2
    return float(np.median(np.abs(excess) / np.sqrt(share))) / 0.6745


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
    prism = replace(exact.prism, apex=found["apex"], index=found.get("index", exact.prism.index))
    size = size_name(model)
    start = {n: x for n, x in found.items() if size == "apex" or n not in EXACT_PARAMETERS}
    start[size] = found["apex"] if size == "apex" else prism.deflection
    start["phase"] = math.remainder(found["phase"], math.tau)
    if pixels is not None:
        pixels = {**pixels, size: pixels["apex"] * prism.apex / start[size]}
    return make_space(
        model, exact.camera, prism, free=(size, "phase", *free), start=start, bounds={size: (0.0, 2.0 * start[size])},
        rad_per_us=rad_per_us, duration_us=duration_us, middle_us=exact.middle_us or 0, pixels=pixels,
    )  # fmt: skip


@dataclass(frozen=True)
class LinearMotion:
    """Motion of n events to first order about a point of a parameter space of k dimensions."""

    space: ParameterSpace
    """The parameter space."""
    v: NDArray[np.float64]
    """The point: a search vector [px], shape ``(k,)``."""
    at: NDArray[np.float64]
    """Compensated coordinates of the events at the point [px], shape ``(n, 2)``."""
    slopes: NDArray[np.float64]
    """Their change per entry of the search vector [px/px], shape ``(k, n, 2)``."""


def linear_motions(spaces: Sequence[ParameterSpace], sample: Places) -> list[LinearMotion]:
    """Return the motion of events about the start of each parameter space, by finite differences.

    The motion is nearly linear in size and phase, which are Cartesian. The differences by other parameters take a step
    both ways: a clock offset turns the orbits, and a tilt that moves events by :data:`SLOPE_PX` is large.
    """
    starts = [space.to_vector(space.start) for space in spaces]
    steps = [SLOPE_PX * np.eye(len(v)) for v in starts]
    near = [
        [space.to_values(at) for at in (v, *(v + h), *(v - h[2:]))]
        for space, v, h in zip(spaces, starts, steps, strict=True)
    ]
    each = [(space, values) for space, several in zip(spaces, near, strict=True) for values in several]
    drifts = np.array([[space.drift(values)] for space, values in each])
    moved = sample.by_each([space.build(values) for space, values in each], drifts * sample.speed)
    found = []
    for space, v, part in zip(spaces, starts, np.split(moved, np.cumsum([len(n) for n in near])[:-1]), strict=True):
        at, ahead, back = part[0], part[1 : 1 + len(v)], part[1 + len(v) :]
        slopes = (ahead - at) / SLOPE_PX
        slopes[2:] = (ahead[2:] - back) / (2.0 * SLOPE_PX)
        found.append(LinearMotion(space, v, at, slopes))
    return found


def fit(
    motions: Sequence[LinearMotion], target: NDArray[np.float64], sample: Places
) -> list[tuple[dict[str, float], float]]:
    """Fit the parameters of several models to the compensated coordinates ``target`` [px], shape (n, 2).

    Return the parameters and the remaining distance [px rms] of each model. The phase is fitted too, which removes a
    constant lag. The displacement is nearly linear: one Gauss-Newton step is accurate to 0.00001 px.
    """
    best = []
    for m in motions:
        fields = _finite(np.stack([m.at - target, *m.slopes]))
        left, design = fields[0], fields[1:]
        best.append(m.space.to_values(m.v - np.linalg.solve(design @ design.T, design @ left)))
    found = sample.by_each([m.space.build(values) for m, values in zip(motions, best, strict=True)])
    return [(values, rms(at - target)) for values, at in zip(best, found, strict=True)]


def _finite(fields: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return fields of motion, shape (k, n, 2), in rows of 2 n numbers, without the events that one of them lacks."""
    valid = np.isfinite(np.sum(fields, axis=0)).all(axis=1)
    return (fields if valid.all() else fields[:, valid]).reshape(len(fields), -1)


def ellipse_error(path: NDArray[np.float64]) -> float:
    """Return the error of the ellipse model [px rms]: the second and higher harmonics of the motion ``path``.

    ``path`` holds the compensated coordinates of n events [px] at :data:`TURN`, shape (TURN_ANGLES, n, 2).
    """
    # mean and first harmonic of the motion at each event's own angle, the first of the turn
    ellipse = np.einsum("k,knx->nx", 1.0 + 2.0 * np.cos(TURN[:, 0]), path) / len(TURN)
    return rms(path[0] - ellipse)


def independent_directions(motion: LinearMotion) -> NDArray[np.float64]:
    """Return search directions along which each parameter moves events by 1 px in ways that size and phase cannot.

    The rows are search vectors, shape (k, k). The first two are unit vectors along size and phase. Each other row is a
    unit vector, minus the size and phase that best reproduce its motion of events, scaled so that the remaining motion
    is one pixel (rms).
    """
    fields = _finite(motion.slopes)
    directions = np.eye(len(fields))
    products = fields @ fields[:2].T
    for k in range(2, len(fields)):
        reproduced = np.linalg.lstsq(products[:2], products[k], rcond=None)[0]
        left = fields[k] - reproduced @ fields[:2]
        directions[k, :2] = -reproduced
        directions[k] /= max(float(np.sqrt(2.0 * np.mean(left**2))), 1e-9)
    return directions
