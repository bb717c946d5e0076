"""The exact scores of AMI-Bench's five tasks, as functions of arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import minimize_scalar

from amiwarp.optics.camera import Camera
from amiwarp.optics.models.base import Model
from amiwarp.studies.evaluate.optical_flow import flow_error
from amiwarp.studies.evaluate.overlaps import overlap

Values = NDArray[np.float64]

ANGLES = 16
"""Number of encoder angles, evenly over a turn, at which a calibration is scored."""
ROWS = 6
COLUMNS = 8
"""Numbers of rows and columns of the grid of pixels at which a calibration is scored."""
LAG_REACH = 0.75
"""Largest lag that is removed from a calibration [rad]: 10 ms at 720 turns/min, the delay of a sensor in dim light."""
LAGS = 31
"""Number of lags from which the search for the best one starts."""
DETAIL_PX = 5.0
"""Standard deviation of the Gaussian whose result is taken off a picture to leave its detail [px]."""
FLOW_TURNS = 0.25
"""Time in which endpoint errors of the flow grow, in turns of the prism."""


def calibration_grid(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pixels, shape (ROWS, COLUMNS, 2), and the encoder's angles [rad], shape (ANGLES,), of the grid."""
    x = np.linspace(0.0, camera.width - 1.0, COLUMNS)
    y = np.linspace(0.0, camera.height - 1.0, ROWS)
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    angles = np.arange(ANGLES, dtype=np.float64) * (2.0 * math.pi / ANGLES)
    return pixels, np.asarray(angles, np.float64)


def displacement_of(model: Model, lag: float = 0.0) -> NDArray[np.float64]:
    """Return how a model moves events at the grid, shape (ANGLES, ROWS, COLUMNS, 2) [px].

    It is the place without the prism less the place of the event. ``lag`` is taken off the encoder's angles [rad].
    """
    pixels, angles = calibration_grid(model.camera)
    flat = pixels.reshape(-1, 2)
    moved = []
    for angle in angles:
        every = np.full(len(flat), angle - lag)
        moved.append(model.compensate_points(flat, every) - flat)
    return np.asarray(moved).reshape(ANGLES, ROWS, COLUMNS, 2)


def calibration_error(displacement: NDArray[np.floating], truth: Model) -> float:
    """Return the rms distance of a displacement from the true one, over the turn and the image [px].

    The true displacement is taken at the lag up to :data:`LAG_REACH` that fits best: events are later than the light,
    by a time that no calibration can tell from the phase.
    """

    def distance(lag: float) -> float:
        difference = displacement - displacement_of(truth, lag)
        return math.sqrt(np.mean(np.sum(difference**2, axis=-1)))

    lags = np.linspace(-LAG_REACH, LAG_REACH, LAGS)
    distances = [distance(float(lag)) for lag in lags]
    best = int(np.argmin(distances))
    step = float(lags[1] - lags[0])
    low = max(float(lags[best]) - step, -LAG_REACH)
    high = min(float(lags[best]) + step, LAG_REACH)
    found = minimize_scalar(distance, bounds=(low, high), method="bounded", options={"xatol": 1e-6})
    return min(float(found.fun), *distances)


@dataclass(frozen=True, slots=True)
class PictureScore:
    """Correlations of a picture with the true one, -1 to 1; 0 for a uniform picture."""

    whole: float
    """Of the whole picture."""
    detail: float
    """Of its detail: the picture less itself smoothed by :data:`DETAIL_PX`."""


def picture_score(log: NDArray[np.floating], truth: NDArray[np.floating]) -> PictureScore:
    """Return the correlations of a picture of log intensity with the true one, both of shape (height, width)."""
    return PictureScore(_correlation(log, truth), _correlation(_detail(log), _detail(truth)))


def _detail(picture: NDArray[np.floating]) -> Values:
    values = picture.astype(np.float64)
    return np.asarray(values - ndimage.gaussian_filter(values, DETAIL_PX, mode="nearest"))


def _correlation(first: NDArray[np.floating], second: NDArray[np.floating]) -> float:
    """Return Pearson's correlation; 0 if one of both is constant, but for rounding."""
    a = first.astype(np.float64)
    b = second.astype(np.float64)
    da = a - a.mean()
    db = b - b.mean()
    size = math.sqrt(float(np.sum(da**2)) * float(np.sum(db**2)))
    rounding = (
        1e-9 * a.size * max(float(np.abs(a).max()), 1e-30) * max(float(np.abs(b).max()), 1e-30)
    )
    return float(np.sum(da * db)) / size if size > rounding else 0.0


@dataclass(frozen=True, slots=True)
class FlowScore:
    """Mean errors of a flow at the edges of the true picture."""

    endpoint_px: float
    """Endpoint error in a quarter turn of the prism [px]."""
    angle_deg: float
    """Angle between (u, v, 1) of both flows, in px in a quarter turn [deg]."""


def flow_score(
    flow: NDArray[np.floating],
    truth: NDArray[np.floating],
    edges: NDArray[np.bool_],
    turn_us: int,
) -> FlowScore:
    """Return the errors of a flow [px/s], shape (height, width, 2), at the pixels ``edges`` with a true flow."""
    seconds = FLOW_TURNS * turn_us * 1e-6
    known = edges & np.isfinite(truth).all(axis=-1)
    found = flow.astype(np.float64) * seconds
    true = truth.astype(np.float64) * seconds
    error = flow_error(found, true, known)
    ones = np.ones(int(np.count_nonzero(known)))
    a = np.column_stack([found[known], ones])
    b = np.column_stack([true[known], ones])
    across = np.linalg.norm(np.cross(a, b), axis=1)
    angle = np.arctan2(across, np.sum(a * b, axis=1))
    return FlowScore(error.epe, math.degrees(float(angle.mean())))


def detection_score(mask: NDArray[np.bool_], truth: NDArray[np.bool_]) -> float:
    """Return the intersection over union of the pixels of the ball, both masks of shape (height, width)."""
    return overlap(mask, truth).iou


def rotation_error(rates: NDArray[np.floating], truth: NDArray[np.floating]) -> float:
    """Return the rms over the windows of the distance between angular velocities, both of shape (n, 3) [deg/s]."""
    difference = rates.astype(np.float64) - truth
    return math.sqrt(float(np.mean(np.sum(difference**2, axis=1))))
