"""Fit of the models with fewer parameters to the exact model, at the events of a scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.event_sample import ANGLES_OVER_TURN, EventSample
from amiwarp.calib.timing_blur import motion_per_angle
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.comparison import rms
from amiwarp.optics.models.registry import MODELS
from amiwarp.optics.models.several import compensate_by_each
from amiwarp.optics.prism import as_wedge
from amiwarp.results.calibration import Calibration
from amiwarp.results.parameters import ParameterSpace, values_of
from amiwarp.results.space_setup import make_space

Floats = NDArray[np.float64]

SLOPE_PX = 0.25
"""Step of the finite differences in the search vector [px]."""
SIZE_AND_PHASE = 2
"""Number of the first entries of every search vector, which are size and phase."""
BUDGET_SHARE = 0.1
"""Default limit of the model error, as a share of the blur by quantisation and timing."""


def px_per_unit(
    path: Floats,
    sample: EventSample,
    exact: Calibration,
    speed: float,
) -> dict[str, float]:
    """Return how far events move per unit of each of the exact model's parameters, to first order in the apex [px rms].

    ``path`` holds the coordinates of the sample's events at :data:`ANGLES_OVER_TURN` [px], shape (TURN_ANGLES, n, 2).
    ``speed`` is the mean speed of the prism [rad/us].
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
        # No rotation of the camera is free, so the middle does not matter.
        middle_us=exact.middle_us or 0,
        pixels=pixels,
    )


@dataclass(frozen=True)
class LinearMotion:
    """Motion of n events to first order about a point of a parameter space of k dimensions."""

    space: ParameterSpace
    """The parameter space."""
    point: Floats
    """The point: a search vector [px], shape ``(k,)``."""
    moved: Floats
    """Compensated coordinates of the events at the point [px], shape ``(n, 2)``."""
    slopes: Floats
    """Their change per entry of the search vector [px/px], shape ``(k, n, 2)``."""


def linear_motions(spaces: Sequence[ParameterSpace], sample: EventSample) -> list[LinearMotion]:
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
        back = v - step[SIZE_AND_PHASE:]
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
        moved_at_point = part[0]
        ahead = part[1 : 1 + len(v)]
        back = part[1 + len(v) :]
        slopes = (ahead - moved_at_point) / SLOPE_PX
        slopes[SIZE_AND_PHASE:] = (ahead[SIZE_AND_PHASE:] - back) / (2.0 * SLOPE_PX)
        found.append(LinearMotion(space, v, moved_at_point, slopes))
    return found


def fit_models(
    motions: Sequence[LinearMotion],
    target: Floats,
    sample: EventSample,
) -> list[tuple[dict[str, float], float]]:
    """Fit the parameters of several models to the compensated coordinates ``target`` [px], shape (n, 2).

    Return the parameters and the remaining distance [px rms] of each model. The phase is fitted too, which removes a
    constant lag. The displacement is nearly linear: one Gauss-Newton step is accurate to 0.00001 px. No space has a
    free drift (``clock_offset`` or ``rpm``), which would turn the angles of ``sample``.
    """
    best = []
    models = []
    for motion in motions:
        away = motion.moved - target
        fields = _finite(np.stack([away, *motion.slopes]))
        left = fields[0]
        design = fields[1:]
        step = np.linalg.solve(design @ design.T, design @ left)
        values = motion.space.to_values(motion.point - step)
        best.append(values)
        models.append(motion.space.build(values))

    fits = []
    moved = compensate_by_each(models, sample.xy, sample.theta)
    for values, positions in zip(best, moved, strict=True):
        fits.append((values, rms(positions - target)))
    return fits


def _finite(fields: Floats) -> Floats:
    """Return fields of motion, shape (k, n, 2), in rows of 2 n numbers, without the events that one of them lacks."""
    total = np.sum(fields, axis=0)
    valid = np.isfinite(total).all(axis=1)
    if not valid.all():
        fields = fields[:, valid]
    return fields.reshape(len(fields), -1)


def ellipse_error(path: Floats) -> float:
    """Return the error of the ellipse model [px rms]: the second and higher harmonics of the motion ``path``.

    ``path`` holds the compensated coordinates of n events [px] at :data:`ANGLES_OVER_TURN`, shape (TURN_ANGLES, n, 2).
    """
    # mean and first harmonic of the motion at each event's own angle, the first of the turn
    weights = 1.0 + 2.0 * np.cos(ANGLES_OVER_TURN[:, 0])
    ellipse = np.einsum("k,knx->nx", weights, path) / len(ANGLES_OVER_TURN)
    return rms(path[0] - ellipse)


def independent_directions(motion: LinearMotion) -> Floats:
    """Return search directions along which each parameter moves events by 1 px in ways that size and phase cannot.

    The rows are search vectors, shape (k, k). The first two are unit vectors along size and phase. Each other row is a
    unit vector, minus the size and phase that best reproduce its motion of events, scaled so that the remaining motion
    is one pixel (rms).
    """
    fields = _finite(motion.slopes)
    size_and_phase = fields[:SIZE_AND_PHASE]
    directions = np.eye(len(fields))
    products = fields @ size_and_phase.T
    for k in range(SIZE_AND_PHASE, len(fields)):
        reproduced, *_ = np.linalg.lstsq(products[:SIZE_AND_PHASE], products[k], rcond=None)
        left = fields[k] - reproduced @ size_and_phase
        moved_px = float(np.sqrt(2.0 * np.mean(left**2)))
        directions[k, :SIZE_AND_PHASE] = -reproduced
        directions[k] /= max(moved_px, 1e-9)
    return directions
