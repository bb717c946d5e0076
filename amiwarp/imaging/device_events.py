"""Events on a device, with the prism angle of each event."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import check_sensor
from amiwarp.events.device_encoder import azimuths, encoder_params
from amiwarp.events.device_events import DeviceEvents, time_span
from amiwarp.kernels.launch import launch
from amiwarp.kernels.pixel_votes import BLOCK
from amiwarp.kernels.votes import (
    EventArrays,
    drift_turns,
    fold_keys,
    layer_events,
    time_events,
    turn_events,
    unfold_keys,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events

TURNS = 1 << 16
"""Number of distinct prism angles per turn. One step is 0.0055 deg.

On an orbit with a radius of 10 px, the rounding moves an event by at most 0.0005 px.
"""
PIECE = 1 << 20
"""Number of angles that are converted at a time."""
LARGEST_FOLD = 1 << 16
"""Largest number of angle bins per turn into which a pixel's events can be merged."""
LARGEST_WEIGHT = 63
"""Largest number of events that one weighted point may represent; :mod:`amiwarp.kernels.tiles` packs the weight."""


@dataclass(frozen=True, slots=True)
class UploadedEvents:
    """Events with their prism angles on a device; made by :func:`upload_events`."""

    arrays: Any
    """Columns of the events: Warp struct ``amiwarp.kernels.votes.EventArrays``.

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

    def drift(self, value: float) -> None:
        """Set the prism angles for the value ``value`` of the drifting parameter."""
        launch(drift_turns, self.count, [self.base, self.slope, value], [self.arrays.turn], device=self.base.device)

    def in_parts(self, parts: int, *, per_polarity: bool) -> UploadedEvents:
        """Return the same events split over ``parts`` images, or over ``parts`` pairs (OFF, ON) of images."""
        old = self.arrays.layer
        layer = wp.empty_like(old)
        launch(layer_events, len(old), [old, parts, int(per_polarity)], [layer], device=old.device)
        return self._with(layer=layer)

    def every(self, step: int) -> UploadedEvents:
        """Return every ``step``-th event, copied on the device. The events must not be folded."""
        a, base = self.arrays, self.base

        def cut(values: Any) -> Any:
            if values is None or not len(values):
                return values
            on_cpu = values.device.is_cpu
            part = values.numpy()[: self.count : step] if on_cpu else values[: self.count : step].contiguous()
            return _put(part, values.dtype, values.device)

        turn = cut(a.turn if base is None else base)
        few = self._with(x=cut(a.x), y=cut(a.y), layer=cut(a.layer), turn=turn, time=cut(a.time))
        n, base = -(-self.count // step), None if base is None else wp.clone(turn)
        return replace(few, count=n, total=n, base=base, slope=cut(self.slope))

    def at_angles(self, angles: NDArray[np.float64]) -> UploadedEvents:
        """Return the same events at other prism angles [rad], shape ``(n,)``. The other columns are not copied."""
        return self._with(turn=_put(_turns(angles), wp.uint16, self.arrays.turn.device))

    def _with(self, **columns: wp.array) -> UploadedEvents:
        """Return the same events with other columns."""
        e = EventArrays()
        for name in ("x", "y", "turn", "azimuths", "time", "weight", "layer"):
            setattr(e, name, columns.get(name, getattr(self.arrays, name)))
        return replace(self, arrays=e)


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
    check_sensor(events)
    n, device = len(events), wp.get_device(device)
    padded = _padded(n, device)

    def put(values: Any, dtype: Any) -> Any:
        return _put(values, dtype, device)

    e = EventArrays()
    e.x, e.y = put(events.x, wp.uint16), put(events.y, wp.uint16)
    e.layer = put(events.p, wp.uint8)
    e.azimuths, e.time = azimuths(str(device)), wp.empty(0, dtype=float, device=device)
    e.weight = wp.empty(0, dtype=wp.uint8, device=device)
    if not isinstance(angles, np.ndarray) or middle_us is not None:
        t = _times(events, device)
    if isinstance(angles, np.ndarray):
        e.turn = put(_turns(angles), wp.uint16)
    else:
        e.turn = wp.zeros(padded, dtype=wp.uint16, device=device)
        if n:
            encoder = encoder_params(angles, *time_span(events), device)
            launch(turn_events, n, [encoder, t], [e.turn], device=device)
    if middle_us is not None:
        e.time = wp.empty(n, dtype=float, device=device)
        launch(time_events, n, [t, middle_us], [e.time], device=device)
    if fold:
        keys = _fold_keys(e, n, fold)
        del e  # free arrays after their last use: with ten million events, each has tens of megabytes
        points = _split(*_runs(keys))
        del keys
        return _folded(*points, n, fold, device)
    if slope is None:
        return UploadedEvents(e, n, n, None, None)
    return UploadedEvents(e, n, n, wp.clone(e.turn), put((slope * (TURNS / (2.0 * np.pi))).astype(np.float32), float))


def _padded(n: int, device: Any) -> int:
    """Return the padded length of a column of ``n`` events: CPU kernels process whole blocks."""
    return -(-n // int(BLOCK)) * int(BLOCK) if device.is_cpu else n


def _put(values: NDArray[Any] | wp.array, dtype: Any, device: Any) -> Any:
    """Copy values to the device, padded with zeros. A Warp array there that needs no padding is not copied."""
    n = len(values)
    if _padded(n, device) == n:
        return values if isinstance(values, wp.array) else wp.array(values, dtype=dtype, device=device)
    array = wp.zeros(_padded(n, device), dtype=dtype, device=device)
    array.numpy()[:n] = values.numpy() if isinstance(values, wp.array) else values  # only CPUs pad
    return array


def _times(events: Events | DeviceEvents, device: Any) -> wp.array:
    """Return the times of events on the device. On a CPU they are not copied."""
    if isinstance(events, DeviceEvents):
        return events.t
    return wp.array(events.t, dtype=wp.int64, device=device, copy=False)


def _turns(angles: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Return prism angles [rad] in units of 1/65536 turn. They are converted in pieces, to need little memory."""
    turns = np.empty(len(angles), np.uint16)
    for start in range(0, len(angles), PIECE):
        piece = slice(start, start + PIECE)
        turns[piece] = np.rint(angles[piece] * (TURNS / (2.0 * np.pi))).astype(np.int64)
    return turns


def _fold_keys(e: Any, n: int, bins: int) -> NDArray[np.int64]:
    """Return the sorted keys of events: bin, pixel and polarity. Neighbours share an angle, as the bin comes first."""
    device = e.x.device
    if not 1 <= bins <= LARGEST_FOLD:
        raise AmiwarpError(f"fold = {bins} angles a turn; give 1 .. {LARGEST_FOLD}, or 0 to disable folding")
    room = n if device.is_cpu else 2 * n  # sorting on CUDA needs scratch memory behind the keys
    keys = wp.empty(room, dtype=wp.int64, device=device)
    launch(fold_keys, n, [e.x, e.y, e.layer, e.turn, bins], [keys], device=device)
    if device.is_cpu:
        values = keys.numpy()  # shares the memory of keys
        values.sort()
        return values
    wp.utils.radix_sort_pairs(keys, wp.zeros(room, dtype=int, device=device), n)
    return np.asarray(keys[:n].numpy())


def _folded(key: NDArray[np.int64], weight: NDArray[np.uint8], n: int, bins: int, device: Any) -> UploadedEvents:
    """Return weighted points on the device by their keys. They stand for ``n`` events."""
    m = len(key)
    out = EventArrays()
    out.x, out.y, out.turn = (wp.zeros(_padded(m, device), dtype=wp.uint16, device=device) for _ in range(3))
    out.layer = wp.zeros(_padded(m, device), dtype=wp.uint8, device=device)
    out.weight, out.azimuths = _put(weight, wp.uint8, device), azimuths(str(device))
    out.time = wp.empty(0, dtype=float, device=device)
    launch(unfold_keys, m, [wp.array(key, dtype=wp.int64, device=device, copy=False), bins], [out], device=device)
    return UploadedEvents(out, m, n, None, None)


def _runs(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return each distinct value of a sorted array, and how often it occurs."""
    starts = np.ones(len(keys), dtype=bool)
    np.not_equal(keys[1:], keys[:-1], out=starts[1:])
    first = np.flatnonzero(starts).astype(np.int32)
    return keys[first], np.diff(first, append=np.int32(len(keys)))


def _split(key: NDArray[np.int64], count: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return keys and weights of points; more than :data:`LARGEST_WEIGHT` events need several points."""
    if not len(count) or int(count.max()) <= LARGEST_WEIGHT:
        return key, count.astype(np.uint8)
    times = -(-count // LARGEST_WEIGHT)
    weight = np.full(int(times.sum()), LARGEST_WEIGHT, dtype=np.uint8)
    weight[np.cumsum(times) - 1] = count - (times - 1) * LARGEST_WEIGHT
    return np.repeat(key, times), weight
