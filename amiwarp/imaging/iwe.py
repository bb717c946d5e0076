"""The image of warped events (IWE): events voted into pixels, with or without motion compensation."""

from __future__ import annotations

from typing import Any, overload

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.choices import Vote
from amiwarp.errors import AmiwarpError
from amiwarp.events import device_events
from amiwarp.events.device_events import DeviceEvents, device_for, wait
from amiwarp.events.encoder import Encoder, check_prisms
from amiwarp.events.recording import Events
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.uploaded_events import upload_events
from amiwarp.imaging.votes import Votes
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.base import Model
from amiwarp.schema.calls import guarded

PIECE = 1 << 22
"""Number of events that are copied to the device at a time."""


@overload
def iwe(
    events: Events,
    width: int,
    height: int,
    *,
    model: Model | None = ...,
    encoder: Encoder | None = ...,
    camera_rotation: CameraRotation | None = ...,
    pad: int = ...,
    per_polarity: bool = ...,
    vote: Vote = ...,
    device: Any = ...,
) -> NDArray[np.float32]: ...
@overload
def iwe(
    events: DeviceEvents,
    width: int,
    height: int,
    *,
    model: Model | None = ...,
    encoder: Encoder | None = ...,
    camera_rotation: CameraRotation | None = ...,
    pad: int = ...,
    per_polarity: bool = ...,
    vote: Vote = ...,
    device: Any = ...,
) -> wp.array: ...
@guarded
def iwe(
    events: Events | DeviceEvents,
    width: int,
    height: int,
    *,
    model: Model | None = None,
    encoder: Encoder | None = None,
    camera_rotation: CameraRotation | None = None,
    pad: int = 0,
    per_polarity: bool = False,
    vote: Vote = Vote.BILINEAR,
    device: Any = None,
) -> NDArray[np.float32] | wp.array:
    """Compute the image of warped events (IWE).

    With ``model`` and ``encoder``, the events are compensated first. Without them, they are voted at their coordinates.

    Parameters
    ----------
    events : Events or DeviceEvents
        Events to vote, sorted by time. Those that are compensated, here or before, and lie outside the image are left
        out.
    width, height : int
        Sensor size [px].
    model : Model, optional
        Optical model of the prism. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    camera_rotation : CameraRotation, optional
        The camera's own rotation, compensated together with the prism. Requires ``model`` and ``encoder``.
    pad : int, optional
        Border added on each side [px].
    per_polarity : bool, optional
        Return separate images for OFF and ON.
    vote : Vote, optional
        How a vote is shared among pixels.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device are voted there, without a copy.

    Returns
    -------
    ndarray or warp.array
        Events per pixel, float32, shape ``(height + 2 * pad, width + 2 * pad)``. With ``per_polarity``, shape
        ``(2, height + 2 * pad, width + 2 * pad)``: OFF, then ON. A Warp array on the same device for
        :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If only one of ``model`` and ``encoder`` is given, or ``camera_rotation`` without them; if the encoder does not
        cover the events, their times decrease, a raw event lies outside the sensor, or they are on another device than
        ``device``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.iwe(events, 4, 2)
    array([[0., 2., 0., 0.],
           [0., 0., 1., 0.]], dtype=float32)
    """
    if (model is None) != (encoder is None):
        raise AmiwarpError(
            "only one of model and encoder is given; give both a model and an encoder, or neither"
        )
    if model is not None and encoder is not None:
        check_prisms(encoder, model.ANGLES)
    elif camera_rotation is not None:
        raise AmiwarpError(
            "camera_rotation is given without a model and an encoder, which it needs; give all three"
        )
    device = device_for(events, device)
    device_events.check_order(events)
    votes = Votes(CanvasShape(width, height, pad, 1.0, per_polarity, vote), device)
    device_events.check_inside(events, width, height)
    for start in range(0, len(events), PIECE):
        piece = events[start : start + PIECE]
        if model is not None and encoder is not None:
            middle = None if camera_rotation is None else camera_rotation.middle_us
            arrays = upload_events(piece, encoder, device, middle_us=middle)
            votes.add_events(model, arrays, camera_rotation=camera_rotation)
        else:
            votes.add_unmoved(piece)
    image = votes.take_on_device() if isinstance(events, DeviceEvents) else votes.take()
    wait(device)
    return image if per_polarity else image[0]
