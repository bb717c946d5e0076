"""Event clouds before and after compensation as PyVista meshes, for scenes and files of other programs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib import Calibration
from amiwarp.choices import Axis
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.validation import choice, guarded, vector, whole
from amiwarp.viewer.drawing import Box, axis_range, residuals, third_axis
from amiwarp.viewer.inspector import DisplayedWindow, Inspector, Selection

if TYPE_CHECKING:
    import pyvista

TRUTHS = {
    "cause": "stored_causes", "instance": "stored_instances", "depth_m": "stored_depths", "place_m": "stored_places",
}  # fmt: skip
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
        If there are no events in window and region, or the calibration belongs to a camera of another size.

    Notes
    -----
    A point lies at x [px], -y [px], as VTK's y axis points up, and the prism angle or the time times a scale: the whole
    third axis is 0.75 times as long as the region is wide. Both clouds have these arrays:

    - ``t_us`` (int64): time after the first event of the recording [us],
    - ``theta_rad`` (float64): prism angle, from 0 to 2π [rad],
    - ``polarity`` (uint8): 1 for ON, 0 for OFF,
    - ``index`` (int64): index of the event in the recording,
    - ``residual_px`` (float32): standard deviation across the edge on which the event lies [px], up to 6,
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
    third, source = choice(Axis, axis, "axis"), recording.events
    inspector = Inspector(
        recording, calibration, device=device, most_events=max(len(source), 1), most_points=max(len(source), 1)
    )
    whole_window, whole_image = (source.t_first, source.t_last + 1), (0, 0, *source.size)
    start, stop = vector(whole_window if window is None else window, 2, "window", _whole)
    if stop <= start:
        raise AmiwarpError(f"window is {window}; give start and end [us], the end after the start")
    width, height = source.size
    left, top, right, bottom = vector(whole_image if region is None else region, 4, "region", _whole)
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        raise AmiwarpError(f"region is {region}; give left, top, right and bottom in an image of {width}x{height} px")
    inspector.open(start, stop - start, Selection(region=None if region is None else (left, top, right, bottom)))
    shown = inspector.show()
    before, after = (_cloud(shown, third, after=after) for after in (False, True))
    return before, after


def _whole(value: object, what: str) -> int:
    return whole(value, what, -(2**62), 2**62)


def _cloud(shown: DisplayedWindow, axis: Axis, *, after: bool) -> pyvista.PolyData:
    """Return one of the clouds."""
    import pyvista

    box, xy = Box(*shown.region, *axis_range(shown, axis)), shown.after if after else shown.before
    valid = np.isfinite(xy).all(axis=1)
    arrays: dict[str, NDArray[Any]] = {
        "t_us": shown.events.t - shown.span.first_us, "theta_rad": shown.theta, "polarity": shown.events.p,
        "index": np.concatenate([np.arange(run.start, run.stop) for run in shown.span.runs])[shown.truth.positions],
        "residual_px": residuals(shown, after=after).astype(np.float32),
    }  # fmt: skip
    for name, attribute in TRUTHS.items():
        if (store := getattr(shown.truth.truth, attribute, None)) is not None:
            arrays[name] = shown.span.rows(store)[shown.truth.positions]
    cloud = pyvista.PolyData(box.positions(xy, third_axis(shown, axis))[valid])
    for name, values in arrays.items():
        cloud.point_data[name] = values[valid]
    unit = "theta [deg]" if axis is Axis.ANGLE else "t [ms]"
    cloud.field_data["axes"] = ["x [px]", "-y [px]", f"({unit} - z_start) * z_scale"]
    cloud.field_data["z_scale"], cloud.field_data["z_start"] = [box.stretch], [box.low]
    cloud.field_data["t_first_us"] = np.array([shown.span.first_us], np.int64)
    return cloud
