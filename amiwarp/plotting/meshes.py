"""Event clouds before and after compensation as PyVista meshes, for scenes and files of other programs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Axis, Vote
from amiwarp.compensation.in_memory import compensate_events
from amiwarp.compensation.recordings import check_size
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.imaging.iwe import iwe
from amiwarp.imaging.regions import inside
from amiwarp.imaging.residuals import residual
from amiwarp.results.calibration import Calibration
from amiwarp.schema.calls import guarded
from amiwarp.validation import choice, vector, whole

if TYPE_CHECKING:
    import pyvista

AXIS_HEIGHT = 0.75
"""Length of the drawn third axis, as a multiple of the region's width."""

TRUTHS = {
    "cause": "stored_causes",
    "instance": "stored_instances",
    "depth_m": "stored_depths",
    "place_m": "stored_places",
}
"""Arrays of the clouds by name, and the ground truth that they hold."""


@guarded
def event_clouds(
    recording: Recording,
    calibration: Calibration,
    *,
    window: tuple[int, int] | None = None,
    region: tuple[int, int, int, int] | None = None,
    axis: str = "angle",
    device: Any = "cpu",
) -> tuple[pyvista.PolyData, pyvista.PolyData]:
    """Return the events as recorded and compensated as point clouds, to plot, slice and save with PyVista.

    Parameters
    ----------
    recording : Recording
        Events to show.
    calibration : Calibration
        Calibration of the recording.
    window : tuple of int, optional
        Start and end of the time window on the events' clock [us]; the end is exclusive. Default: the whole recording.
    region : tuple of int, optional
        Left, top, right and bottom of a part of the image [px]; right and bottom are exclusive. The clouds hold the
        events that were recorded in it. Default: the whole image.
    axis : str
        Third axis: "angle" or "time".
    device : str or warp.Device
        Device that compensates the events.

    Returns
    -------
    tuple of pyvista.PolyData
        Clouds before and after compensation, with one vertex per event.

    Raises
    ------
    AmiwarpError
        If there are no events in window and region, the calibration belongs to a camera of another size, or neither
        recording nor calibration know how the prism turns.

    Notes
    -----
    A point lies at x [px], -y [px], as VTK's y axis points up, and the prism angle or the time times a scale: the whole
    third axis is 0.75 times as long as the region is wide. Both clouds have these arrays:

    - ``t_us`` (int64): time after the first event of the recording [us],
    - ``theta_rad`` (float64): prism angle, from 0 to 2π [rad],
    - ``polarity`` (uint8): 1 for ON, 0 for OFF,
    - ``index`` (int64): index of the event in the recording,
    - ``residual_px`` (float32): standard deviation across the edge on which the event lies [px], up to 6; NaN, as it
      is unknown, if the model moves the event out of the region,
    - of a simulation: ``cause``, ``instance``, ``depth_m`` [m] and ``place_m`` (point in the world that the event saw
      [m], shape ``(n, 3)``), as far as the recording holds them.

    The field data hold ``axes`` (names and units of the coordinates), ``z_scale`` (length of one unit of the third axis
    [px]), ``z_start`` (its value at z = 0) and ``t_first_us`` (time of the first event on its clock [us], int64). All
    events of the window are in the first cloud, but those outside of the encoder's record. Events for which the model
    has no solution are not in the second cloud.

    Examples
    --------
    >>> camera, prism = amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.02)
    >>> events = amiwarp.Events.from_arrays([10, 20], [12, 14], [0, 1000], [0, 1])
    >>> encoder = amiwarp.Encoder.constant_speed(720.0, 0, 2000)
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, 32, 24), camera, encoder, prism)
    >>> calibration = amiwarp.Calibration(
    ...     model_name="circle", camera=camera, prism=prism, parameters={"deflection": 0.01, "phase": 0.3},
    ...     uncertainty={}, free=(), sharpness_name="variance", sharpness_before=1.0, sharpness_after=2.0,
    ...     stages=(), events=2, seconds=0.0)
    >>> before, after = amiwarp.event_clouds(recording, calibration)
    >>> after.n_points, after["t_us"].tolist()
    (2, [0, 1000])
    """
    import pyvista

    third = choice(Axis, axis, "axis")
    source = recording.events
    check_size(calibration, source.size, recording.name)
    integer = partial(whole, low=-(2**62), high=2**62)
    if window is None:
        window = (source.t_first, source.t_last + 1)
    start, stop = vector(window, 2, "window", integer)
    if stop <= start:
        raise AmiwarpError(f"window is {window}; give start and end [us], the end after the start")
    width, height = source.size
    if region is None:
        region = (0, 0, width, height)
    left, top, right, bottom = vector(region, 4, "region", integer)
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        raise AmiwarpError(
            f"region is {region}; give left, top, right and bottom in an image of {width}x{height} px"
        )

    # The events of window and region, as far as the encoder covers them.
    encoder = calibration.encoder_for(recording.encoder, source.t_first, source.t_last)
    begin, end = encoder.coverage
    first = source.find(max(start, begin))
    last = source.find(min(stop, end + 1))
    events = source.slice(first, last)
    chosen = np.flatnonzero(inside(events, (left, top, right, bottom)))
    if not len(chosen):
        raise AmiwarpError(
            f"{recording.name}: no events in the window and the region; take another window",
            ErrorCode.CONTENT_MISSING,
        )

    t_us = events.t - source.t_first
    theta = np.mod(encoder.angle_at(events.t), math.tau)
    if third is Axis.ANGLE:
        low = 0.0
        high = 360.0
        along = np.degrees(theta)
        unit = "theta [deg]"
    else:
        low = (start - source.t_first) * 1e-3
        high = (stop - source.t_first) * 1e-3
        along = t_us * 1e-3
        unit = "t [ms]"
    box = Box(left, top, right, bottom, low, high)
    arrays: dict[str, NDArray[Any]] = {
        "t_us": t_us[chosen],
        "theta_rad": theta[chosen],
        "polarity": events.p[chosen],
        "index": first + chosen,
    }
    for name, attribute in TRUTHS.items():
        store = getattr(recording.truth, attribute, None)
        if store is not None:
            arrays[name] = store[first:last][chosen]

    # Places of the events, and the image from which their residuals are measured, before and after compensation.
    count = partial(iwe, events, width, height, vote=Vote.NEAREST, device=device)
    recorded = np.stack([events.x, events.y], axis=1).astype(np.float32)
    moved = compensate_events(events, calibration.model, encoder, device=device)
    moved_image = count(model=calibration.model, encoder=encoder)
    part = (slice(top, bottom), slice(left, right))
    clouds = []
    for place, image in ((recorded, count()), (moved, moved_image)):
        spread = residual(image, place[chosen], part).astype(np.float32)
        points = box.positions(place[chosen], along[chosen])
        valid = np.isfinite(points).all(axis=1)
        cloud = pyvista.PolyData(points[valid])
        clouds.append(cloud)
        for name, values in (arrays | {"residual_px": spread}).items():
            cloud.point_data[name] = values[valid]
        cloud.field_data["axes"] = ["x [px]", "-y [px]", f"({unit} - z_start) * z_scale"]
        cloud.field_data["z_scale"] = [box.stretch]
        cloud.field_data["z_start"] = [box.low]
        cloud.field_data["t_first_us"] = np.array([source.t_first], np.int64)
    return clouds[0], clouds[1]


@dataclass(frozen=True)
class Box:
    """Frame of both clouds: a region of the image [px], and the range of the third axis."""

    left: int
    top: int
    right: int
    bottom: int
    low: float
    """Start of the third axis [deg or ms]."""
    high: float
    """End of the third axis [deg or ms]."""

    @property
    def width(self) -> int:
        """Width of the shown region of the image [px]."""
        return self.right - self.left

    @property
    def axis_height(self) -> float:
        """Length of the third axis in the scene [px]."""
        return AXIS_HEIGHT * self.width

    @property
    def stretch(self) -> float:
        """Scale of the third axis [px per deg or ms]. The scale of x and y is 1."""
        return self.axis_height / (self.high - self.low)

    def positions(self, xy: NDArray[Any], third: NDArray[Any]) -> NDArray[np.float32]:
        """Return points in the scene, shape ``(n, 3)``; y is negated, because the scene's y axis points up."""
        height = (third - self.low) * self.stretch
        return np.stack([xy[:, 0], -xy[:, 1], height], axis=1).astype(np.float32)
