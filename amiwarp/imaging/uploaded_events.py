"""Events on a device, with the prism angle of each event."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events import device_events
from amiwarp.events.device_events import DeviceEvents
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.kernels import event_folding
from amiwarp.kernels import events_with_angles as angle_kernels
from amiwarp.kernels.compensation import azimuths
from amiwarp.kernels.encoder_pieces import encoder_params
from amiwarp.kernels.launch import launch
from amiwarp.kernels.pixel_votes import BLOCK

Vector = NDArray[np.float64]
Keys = NDArray[np.int64]

TURNS = 1 << 16
"""Number of distinct prism angles per turn. One step is 0.0055 deg.

On an orbit with a radius of 10 px, the rounding moves an event by at most 0.0005 px.
"""
TURNS_PER_RAD = TURNS / (2.0 * np.pi)
ANGLES_AT_ONCE = 1 << 20
"""Number of angles that are converted at a time."""
LARGEST_FOLD = 1 << 16
"""Largest number of angle bins per turn into which a pixel's events can be merged."""
LARGEST_WEIGHT = 63
"""Largest number of events that one weighted point may represent; :mod:`amiwarp.kernels.tiles` packs the weight."""


@dataclass(frozen=True, slots=True)
class UploadedEvents:
    """Events with their prism angles on a device; made by :func:`upload_events`."""

    arrays: Any
    """Columns of the events: Warp struct ``amiwarp.kernels.events_with_angles.EventsWithAngles``.

    Its column ``layer`` gives the image of each event: OFF goes to the first and ON to the second image, or both to the
    only one.
    """
    count: int
    """Number of entries, without padding."""
    total: int
    """Number of events that the entries stand for: ``count``, if they are not folded."""
    base: Any
    """Prism angles at drift 0 [1/65536 turn]; None if the angles do not depend on a drifting parameter."""
    slope: Any
    """Change of each prism angle per unit of the drifting parameter [1/65536 turn]; None if there is no such parameter.
    """
    second_base: Any = None
    """Angles of the second prism at drift 0 [1/65536 turn]; None for one prism."""
    ratio: float = 0.0
    """Mean speed of the second prism relative to the first."""

    def drift(self, value: float) -> None:
        """Set the prism angles for the value ``value`` of the drifting parameter."""
        self._drift_angles(self.base, value, self.arrays.turn)
        if self.second_base is not None:
            self._drift_angles(self.second_base, self.ratio * value, self.arrays.second)

    def _drift_angles(self, base: Any, value: float, out: Any) -> None:
        """Set the angles of one prism to those at drift 0, ``base``, moved by a drift."""
        launch(
            angle_kernels.drift_turns,
            self.count,
            [base, self.slope, value],
            [out],
            device=base.device,
        )

    def in_parts(self, parts: int, *, per_polarity: bool) -> UploadedEvents:
        """Return the same events split over ``parts`` images, or over ``parts`` pairs (OFF, ON) of images."""
        old = self.arrays.layer
        layer = wp.empty_like(old)
        launch(
            angle_kernels.store_layers,
            len(old),
            [old, parts, int(per_polarity)],
            [layer],
            device=old.device,
        )
        return self._with(layer=layer)

    def every(self, step: int) -> UploadedEvents:
        """Return every ``step``-th event, copied on the device. The events must not be folded."""
        kept = slice(0, self.count, step)
        count = math.ceil(self.count / step)

        def cut(values: Any) -> Any:
            if values is None or not len(values):
                return values
            device = values.device
            if device.is_cpu:
                return _put(values.numpy()[kept], values.dtype, device)
            return _put(values[kept].contiguous(), values.dtype, device)

        arrays = self.arrays
        columns = {name: cut(getattr(arrays, name)) for name in ("x", "y", "layer", "time")}

        # The columns of angles hold the angles of the last drift; a drift starts from copies of the bases.
        base = None
        if self.base is None:
            columns["turn"] = cut(arrays.turn)
        else:
            columns["turn"] = cut(self.base)
            base = wp.clone(columns["turn"])
        second_base = None
        if self.second_base is None:
            columns["second"] = cut(arrays.second)
        else:
            columns["second"] = cut(self.second_base)
            second_base = wp.clone(columns["second"])

        return replace(
            self._with(**columns),
            count=count,
            total=count,
            base=base,
            slope=cut(self.slope),
            second_base=second_base,
        )

    def at_angles(self, angles: Vector) -> UploadedEvents:
        """Return the same events at other prism angles [rad], shape ``(n,)``. The other columns are not copied."""
        turn = _put(_turns(angles), wp.uint16, self.arrays.turn.device)
        return self._with(turn=turn)

    def _with(self, **columns: wp.array) -> UploadedEvents:
        """Return the same events with other columns."""
        arrays = angle_kernels.EventsWithAngles()
        for name in ("x", "y", "turn", "second", "azimuths", "time", "weight", "layer"):
            own_values = getattr(self.arrays, name)
            setattr(arrays, name, columns.get(name, own_values))
        return replace(self, arrays=arrays)


def upload_events(
    events: Events | DeviceEvents,
    angles: Encoder | NDArray[np.float64],
    device: Any,
    *,
    slope: NDArray[np.float64] | None = None,
    middle_us: int | None = None,
    fold: int = 0,
) -> UploadedEvents:
    """Copy events to ``device`` and attach a prism angle to each. Events on the device are not copied.

    Parameters
    ----------
    events : Events or DeviceEvents
        Events with whole pixel coordinates (uint16), sorted by time.
    angles : Encoder or ndarray
        Encoder from which the angles are interpolated, or one angle per event [rad], shape ``(n,)``.
    device : str or warp.Device
        Device to copy to.
    slope : ndarray, optional
        Change of each angle [rad] per unit of a drifting parameter, shape ``(n,)``.
    middle_us : int, optional
        Reference time [us]. If it is given, the event times relative to it are stored too, so that the camera rotation
        can be compensated.
    fold : int, optional
        Number of angle bins per turn, for a still scene; 0 disables folding. All events of one pixel, polarity and bin
        become one weighted point at the middle of the bin. Cannot be combined with ``slope`` and ``middle_us``.

    Returns
    -------
    UploadedEvents
        The events on the device.

    Raises
    ------
    AmiwarpError
        If the encoder does not cover the events, or ``fold`` is out of range.
    """
    device_events.check_sensor(events)
    count = len(events)
    device = wp.get_device(device)
    padded = _padded(count, device)

    arrays = angle_kernels.EventsWithAngles()
    arrays.x = _put(events.x, wp.uint16, device)
    arrays.y = _put(events.y, wp.uint16, device)
    arrays.layer = _put(events.p, wp.uint8, device)
    arrays.azimuths = azimuths(str(device))
    arrays.time = wp.empty(0, dtype=float, device=device)
    arrays.weight = wp.empty(0, dtype=wp.uint8, device=device)
    arrays.second = wp.empty(0, dtype=wp.uint16, device=device)

    if not isinstance(angles, np.ndarray) or middle_us is not None:
        t = _times(events, device)
    encoder = None
    if isinstance(angles, np.ndarray):
        arrays.turn = _put(_turns(angles), wp.uint16, device)
    else:
        encoder = angles
        arrays.turn = wp.zeros(padded, dtype=wp.uint16, device=device)
        if count:
            pieces = encoder_params(encoder, *device_events.time_span(events), device)
            inputs = [pieces, t]
            launch(angle_kernels.store_turns, count, inputs, [arrays.turn], device=device)
            if encoder.second is not None:
                arrays.second = wp.zeros(padded, dtype=wp.uint16, device=device)
                launch(
                    angle_kernels.store_second_turns, count, inputs, [arrays.second], device=device
                )
    if middle_us is not None:
        arrays.time = wp.empty(count, dtype=float, device=device)
        launch(angle_kernels.store_times, count, [t, middle_us], [arrays.time], device=device)

    if fold:
        keys = _fold_keys(arrays, count, fold)
        # Free arrays after their last use: with ten million events, each has tens of megabytes
        del arrays
        points = _split(*_runs(keys))
        del keys
        return _folded(*points, count, fold, device)
    if slope is None:
        return UploadedEvents(arrays, count, count, None, None)

    turns_per_unit = (slope * TURNS_PER_RAD).astype(np.float32)
    slopes = _put(turns_per_unit, float, device)
    uploaded = UploadedEvents(arrays, count, count, wp.clone(arrays.turn), slopes)
    if encoder is None or encoder.ratio is None:
        return uploaded
    return replace(uploaded, second_base=wp.clone(arrays.second), ratio=encoder.ratio)


def _padded(n: int, device: Any) -> int:
    """Return the padded length of a column of ``n`` events: CPU kernels process whole blocks."""
    if not device.is_cpu:
        return n
    block = int(BLOCK)
    return math.ceil(n / block) * block


def _put(values: NDArray[Any] | wp.array, dtype: Any, device: Any) -> Any:
    """Copy values to the device, padded with zeros. A Warp array there that needs no padding is not copied."""
    n = len(values)
    padded = _padded(n, device)
    if padded == n:
        if isinstance(values, wp.array):
            return values
        return wp.array(values, dtype=dtype, device=device)
    if isinstance(values, wp.array):
        values = values.numpy()  # only CPUs pad
    array = wp.zeros(padded, dtype=dtype, device=device)
    array.numpy()[:n] = values
    return array


def _times(events: Events | DeviceEvents, device: Any) -> wp.array:
    """Return the times of events on the device. On a CPU they are not copied."""
    if isinstance(events, DeviceEvents):
        return events.t
    return wp.array(events.t, dtype=wp.int64, device=device, copy=False)


def _turns(angles: Vector) -> NDArray[np.uint16]:
    """Return prism angles [rad] in units of 1/65536 turn. They are converted in pieces, to need little memory."""
    turns = np.empty(len(angles), np.uint16)
    for start in range(0, len(angles), ANGLES_AT_ONCE):
        piece = slice(start, start + ANGLES_AT_ONCE)
        exact = angles[piece] * TURNS_PER_RAD
        turns[piece] = np.rint(exact).astype(np.int64)
    return turns


def _fold_keys(arrays: Any, n: int, bins: int) -> Keys:
    """Return the sorted keys of events: bin, pixel and polarity. Neighbours share an angle, as the bin comes first."""
    device = arrays.x.device
    if not 1 <= bins <= LARGEST_FOLD:
        raise AmiwarpError(
            f"fold = {bins} angles a turn; give 1 .. {LARGEST_FOLD}, or 0 to disable folding"
        )
    key_count = (
        n if device.is_cpu else 2 * n
    )  # sorting on CUDA needs scratch memory behind the keys
    keys = wp.empty(key_count, dtype=wp.int64, device=device)
    inputs = [arrays.x, arrays.y, arrays.layer, arrays.turn, bins]
    launch(event_folding.fold_keys, n, inputs, [keys], device=device)
    if device.is_cpu:
        values = keys.numpy()  # shares the memory of keys
        values.sort()
        return values
    order = wp.zeros(key_count, dtype=int, device=device)
    wp.utils.radix_sort_pairs(keys, order, n)
    return np.asarray(keys[:n].numpy())


def _folded(
    key: Keys,
    weight: NDArray[np.uint8],
    n: int,
    bins: int,
    device: Any,
) -> UploadedEvents:
    """Return weighted points on the device by their keys. They stand for ``n`` events."""
    count = len(key)
    padded = _padded(count, device)
    points = angle_kernels.EventsWithAngles()
    points.x = wp.zeros(padded, dtype=wp.uint16, device=device)
    points.y = wp.zeros(padded, dtype=wp.uint16, device=device)
    points.turn = wp.zeros(padded, dtype=wp.uint16, device=device)
    points.layer = wp.zeros(padded, dtype=wp.uint8, device=device)
    points.weight = _put(weight, wp.uint8, device)
    points.azimuths = azimuths(str(device))
    points.time = wp.empty(0, dtype=float, device=device)
    points.second = wp.empty(0, dtype=wp.uint16, device=device)
    keys = wp.array(key, dtype=wp.int64, device=device, copy=False)
    launch(event_folding.unfold_keys, count, [keys, bins], [points], device=device)
    return UploadedEvents(points, count, n, None, None)


def _runs(keys: Keys) -> tuple[Keys, NDArray[np.int32]]:
    """Return each distinct value of a sorted array, and how often it occurs."""
    starts = np.ones(len(keys), dtype=bool)
    np.not_equal(keys[1:], keys[:-1], out=starts[1:])
    first = np.flatnonzero(starts).astype(np.int32)
    counts = np.diff(first, append=np.int32(len(keys)))
    return keys[first], counts


def _split(key: Keys, count: NDArray[np.int32]) -> tuple[Keys, NDArray[np.uint8]]:
    """Return keys and weights of points; more than :data:`LARGEST_WEIGHT` events need several points."""
    if not len(count) or int(count.max()) <= LARGEST_WEIGHT:
        return key, count.astype(np.uint8)
    points = -(-count // LARGEST_WEIGHT)  # rounded up
    weight = np.full(int(points.sum()), LARGEST_WEIGHT, dtype=np.uint8)
    last = np.cumsum(points) - 1
    weight[last] = count - (points - 1) * LARGEST_WEIGHT
    return np.repeat(key, points), weight
