"""Depth at rest: inverse depth of every edge from a camera at rest behind a rotating tilted plate."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.depths import SMALLEST_PX, find_depths, orbit_px
from amiwarp.calib.plate import (
    LARGEST_INVERSE,
    check_still,
    costs_at_rest,
    inverse_depth_by_wedge,
    span_at_rest,
)
from amiwarp.choices import DepthMethod
from amiwarp.compensation.recordings import check_size
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.device_events import device_of
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Recording
from amiwarp.imaging.phase import PhaseSums
from amiwarp.optics.models.plate import LARGEST_INVERSE_DEPTH, PlateModel
from amiwarp.reconstruction.depth_in_phase import HARMONICS, depths_in_phase
from amiwarp.reconstruction.phase_window import sums_of_turns
from amiwarp.results.calibration import Calibration
from amiwarp.results.depth_map import DepthMap
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress
from amiwarp.validation import real

LEAST_KNOWN = 1e-3
"""Smallest share of the pixels with events whose depth must be known. Single pixels are known by chance."""
LEAST_PAIRS = 3
"""Smallest number of pairs of events of a pixel whose depth is known."""
KNOWN_SHARE = 0.1
"""Largest relative standard deviation of an inverse depth that counts as known."""


@guarded
def depth(
    recording: Recording,
    calibration: Calibration,
    *,
    method: DepthMethod | str = DepthMethod.PHOTOMETRIC,
    nearest_m: float = 1.0 / LARGEST_INVERSE,
    device: Any = None,
    progress: Progress | None = None,
) -> DepthMap:
    """Find the inverse depth of every edge in a recording of a camera at rest behind a rotating tilted plate.

    Parameters
    ----------
    recording : Recording
        Recording of a still scene with a camera at rest, of two turns of the plate or more.
    calibration : Calibration
        Calibration of the plate.
    method : DepthMethod or str, optional
        ``"photometric"``, or ``"phase"``, which takes a fraction of the time, gives one depth for tiles of 48 px, and
        does not try orbits of over 14 px.
    nearest_m : float, optional
        Smallest depth that is tried [m], 0.05 or above.
    device : str or warp.Device, optional
        Device to compute on, by default the device of :class:`DeviceMemoryEvents`, else the CPU. The costs of orbits
        are computed on the CPU.
    progress : Progress, optional
        Called with the finished share.

    Returns
    -------
    DepthMap
        Inverse depth, its standard deviation and the point that each pixel sees; unknown where the events do not
        determine them to 10 %.

    Raises
    ------
    AmiwarpError
        If the calibration does not belong to a plate, the camera or the scene moves, the sensor sizes differ, or there
        are too few events.

    Notes
    -----
    The radius of the orbit on which the plate moves a point is proportional to its inverse depth. The method is
    described in ``docs/how-to/depth.md``.

    Examples
    --------
    >>> wedge = amiwarp.Calibration.load("calibration.json")  # doctest: +SKIP
    >>> amiwarp.depth(recording, wedge)  # doctest: +SKIP
    Traceback (most recent call last):
    amiwarp.errors.AmiwarpError: the calibration has the exact model, which moves near and far points alike: ...
    """
    name = recording.name
    nearest = real(nearest_m, "nearest_m", 1.0 / LARGEST_INVERSE_DEPTH, 100.0, " m")
    model = calibration.model
    if not isinstance(model, PlateModel):
        raise AmiwarpError(
            f"{name}: the calibration has the {model.NAME} model, which moves near and far points alike: depth is not "
            "determined; record through a rotating tilted plate"
        )
    if not len(recording.events):
        raise AmiwarpError(
            f"{name}: has no events; give a recording with events", ErrorCode.CONTENT_MISSING
        )
    check_size(calibration, recording.events.size, name)
    events = recording.events
    encoder = calibration.encoder_for(recording.encoder, events.t_first, events.t_last)
    device = device_of(events, device)

    def report(share: float) -> None:
        if progress is not None:
            progress("finding depths", share)

    inverse: NDArray[np.floating[Any]]
    std: NDArray[np.floating[Any]]
    if DepthMethod(method) is DepthMethod.PHASE:
        sums = sums_at_rest(recording, encoder, device)
        report(0.3)
        tiles = depths_in_phase(sums, model, 1.0 / nearest, lambda share: report(0.3 + 0.7 * share))
        inverse, std = tiles.of_pixels(*events.size)
        seen = sums.on + sums.off > LEAST_PAIRS
    else:
        costs = costs_at_rest(recording, model, encoder, 1.0 / nearest, device)
        found = find_depths(costs, model, 1.0 / nearest, report)
        check_still(found, name)
        inverse = found.inverse_depth
        std = found.std
        seen = found.count >= LEAST_PAIRS
    # Faces at an angle along the tilt look much like other depths, and are not looked for.
    wedge_std = calibration.uncertainty.get("wedge_x", 0.0)
    std = np.hypot(std, inverse_depth_by_wedge(model) * wedge_std)
    known = seen & (std < KNOWN_SHARE * inverse)
    if known.sum() < max(1.0, LEAST_KNOWN * seen.sum()):
        raise AmiwarpError(
            f"{name}: the events determine no depth: too little texture, or everything is beyond "
            f"{orbit_limit_m(model):.2g} m; record a nearer scene with more texture, or a longer time",
            ErrorCode.CONTENT_MISSING,
        )
    found_inverse = np.where(known, inverse, np.nan).astype(np.float32)
    points = _points(model, found_inverse)
    found_inverse[np.isnan(points).any(axis=2)] = np.nan  # no ray of the lens reaches these
    found_std = np.where(np.isnan(found_inverse), np.nan, std).astype(np.float32)
    return DepthMap(found_inverse, found_std, points)


def sums_at_rest(recording: Recording, encoder: Encoder, device: Any) -> PhaseSums:
    """Return the sums in phase of the whole turns of a recording from a camera at rest, without the first turn.

    Raises :class:`AmiwarpError` as :func:`span_at_rest`.
    """
    _, start, stop = span_at_rest(recording, encoder)
    sums, _ = sums_of_turns(
        recording.events, encoder, start, stop - start, harmonics=HARMONICS, device=device
    )
    return sums


def orbit_limit_m(model: PlateModel) -> float:
    """Return the depth beyond which orbits are too small to measure [m]."""
    return orbit_px(model) / SMALLEST_PX


def _points(model: PlateModel, inverse: Any) -> Any:
    """Return the points that pixels see on the mean of a turn [m], shape (height, width, 3)."""
    y, x = np.mgrid[: model.camera.height, : model.camera.width]
    pixels = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        depths = 1.0 / np.nan_to_num(inverse.ravel().astype(np.float64), nan=1.0)
        moved = []
        for k in range(8):
            theta = np.full(len(pixels), k * math.tau / 8)
            moved.append(model.compensate_at(pixels, theta, 1.0 / depths))
        mean = np.mean(moved, axis=0)
    rays = model.camera.pixels_to_rays(mean)
    points = rays / rays[:, 2:] * depths[:, None]
    points[~np.isfinite(inverse.ravel())] = np.nan
    return points.reshape(*inverse.shape, 3).astype(np.float32)
