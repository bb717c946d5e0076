"""Time windows of a recording, and the part of the scene that pixels see in them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.tiles import Tiles
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import EventSource, Recording
from amiwarp.optics.camera import border
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.base import Model
from amiwarp.validation import TIME_LIMIT, real

LARGEST_MARGIN = 0.5
"""Largest margin of the map on each side of the image, relative to the image's width."""
STILL_WINDOW_US = 100_000
"""Default length of a time window if the prism does not turn [us]."""


def settled_span(
    source: EventSource, turn_us: float | None, length_us: int | None
) -> tuple[int, int]:
    """Return start and length [us] of a time window without the beginning of the recording, if it is long enough.

    There, the reference of a pixel is unknown until its first event. ``turn_us``: duration of a turn [us], None if the
    prism does not turn. ``length_us``: length of the window, by default a turn.
    """
    beginning = round(turn_us or STILL_WINDOW_US)
    length = length_us or beginning
    latest_start = source.t_last + 1 - length
    start = min(source.t_first + beginning, latest_start)
    return max(source.t_first, start), length


def window_span(
    recording: Recording,
    turn_us: float | None,
    start_us: int | None,
    length_us: int | None,
    turns: float | None,
) -> tuple[int, int]:
    """Return start and length [us] of a time window, see :meth:`Reconstruction.span`.

    ``turn_us``: duration of a turn [us], None if the prism does not turn.
    """
    first = recording.events.t_first
    last = recording.events.t_last
    if turns is not None:
        if length_us is not None:
            raise AmiwarpError(
                "turns and length_us are both given; give one of them", ErrorCode.OPTIONS
            )
        if turn_us is None:
            raise AmiwarpError("turns is given, but the prism does not turn; give a length")
        length_us = round(turns * turn_us)
    settled, length = settled_span(recording.events, turn_us, length_us)
    start = settled if start_us is None else start_us
    if length < 1 or start > last or start + length <= first:
        where = f"{start} .. {start + length} us"
        raise AmiwarpError(
            f"{recording.name}: no events in {where}; give a window that overlaps {first} .. {last} us",
            ErrorCode.CONTENT_MISSING,
        )
    return start, length


def window_count(recording: Recording, start_us: int, length_us: int, step_us: float) -> int:
    """Return the number of complete windows from ``start_us`` on, ``step_us`` apart [us], at least 1."""
    step_us = real(step_us, "step_us", 1.0, TIME_LIMIT, " us")
    room = recording.events.t_last + 1 - start_us - length_us
    return max(1, math.floor(room / step_us) + 1)


def map_tile(
    model: Model, camera_rotation: CameraRotation, length_us: int
) -> tuple[int, int, Tiles]:
    """Return the map's margin left of and above the image (columns, rows), and the map of all that pixels see.

    ``camera_rotation`` is the rotation about the window's middle. ``length_us`` is the window's length [us].
    """
    camera = model.camera
    by_prism = np.max(np.abs(border_displacements(model)), axis=0)
    by_camera = camera_rotation.reach(camera, length_us * 0.5e-6)
    limit = LARGEST_MARGIN * camera.width
    reach_x, reach_y = (by_prism + by_camera).tolist()
    left = math.ceil(min(reach_x, limit)) + 2
    top = math.ceil(min(reach_y, limit)) + 2
    origin = np.array([[-left, -top]], np.float32)
    return left, top, Tiles(origin, camera.height + 2 * top, camera.width + 2 * left, 1.0)


def border_displacements(model: Model) -> NDArray[np.float64]:
    """Return the displacements of the image's border by the prism over one turn [px], shape (n, 2)."""
    pixels = border(model.camera)
    theta = np.arange(24) * (math.tau / 24)
    repeated = np.repeat(pixels, 24, axis=0)
    moved = model.compensate_points(repeated.astype(np.float32), np.tile(theta, len(pixels)))
    displacement = np.asarray(moved, np.float64) - repeated
    return displacement[np.isfinite(displacement).all(axis=1)]
