"""Error of a calibration in the stability study: where it puts events, against where they belong."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import minimize_scalar

from amiwarp.events.recording import Recording
from amiwarp.optics.models.plate import PlateModel
from amiwarp.results.calibration import Calibration
from amiwarp.studies.stability.rigs import Rig

COLUMNS = 12
ROWS = 9
TIMES = 96
"""Number of columns and rows of pixels, and of times, at which a calibration is compared with the truth."""
LEAST_VALID = 0.5
"""Smallest share of these places that must be valid, for an error that is finite."""
LAGS_S = np.linspace(-2e-3, 2e-3, 41)
"""Lags of all events that are tried [s]."""


def error_px(rig: Rig, recording: Recording, calibration: Calibration) -> float:
    """Return the error of a calibration [px rms] over the image and the recording; infinite if it is nowhere valid.

    One lag of all events and one shift of the picture are removed: neither can be seen. For a plate it is the error at
    the true depths.
    """
    camera = rig.simulation.camera
    columns = np.linspace(8, camera.width - 9, COLUMNS)
    rows = np.linspace(8, camera.height - 9, ROWS)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    times = np.rint(np.linspace(0.03, 0.97, TIMES) * 1e6 * rig.simulation.duration_s)
    # Every pixel at every time
    xy = np.tile(pixels, (len(times), 1))
    t_us = np.repeat(times, len(pixels))

    events = recording.events
    encoder = calibration.encoder_for(recording.encoder, events.t_first, events.t_last)
    angles = encoder.angles_at(times.astype(np.int64))
    theta = np.repeat(angles, len(pixels), axis=0)
    if rig.inverse_depth is None:
        places = calibration.model.compensate_points(xy, theta)
    else:
        assert isinstance(calibration.model, PlateModel)
        inverse_depth = rig.inverse_depth(rig.places(xy, t_us))
        places = calibration.model.compensate_at(xy, theta, inverse_depth)

    def rms(lag_s: float) -> float:
        apart = places - rig.places(xy, t_us - 1e6 * lag_s)
        apart = apart[np.isfinite(apart).all(axis=1)]
        if len(apart) < LEAST_VALID * len(xy):
            return math.inf
        without_shift = apart - apart.mean(axis=0)
        square = np.sum(without_shift**2, axis=1)
        return float(np.sqrt(np.mean(square)))

    start = min(LAGS_S, key=rms)
    step = float(LAGS_S[1] - LAGS_S[0])
    around = (start - step, start + step)
    best = minimize_scalar(rms, bounds=around, method="bounded", options={"xatol": 1e-8})
    return rms(float(best.x))
