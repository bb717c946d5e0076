"""Events as tensors for networks: counts, voxel grids, histograms, time surfaces; windows, batches and transforms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceEvents
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.imaging.whole_windows import are_sparse, run_on_windows, takes_whole_windows
from amiwarp.imaging.window_batch import WindowBatch, batch_of
from amiwarp.imaging.window_images import (
    SMALLEST,
    Grid,
    check_lengths,
    count_images,
    latest_images,
    normalise,
    result_rows,
    share_images,
    struct_of,
)
from amiwarp.imaging.windows import Windows
from amiwarp.kernels import tensor_values, tensors_by_window
from amiwarp.kernels import tensors as kernels
from amiwarp.kernels.launch import launch
from amiwarp.optics.models.base import Model
from amiwarp.schema.calls import guarded
from amiwarp.validation import real, whole

MOST_BINS = 1 << 20
"""Largest number of time bins."""


def _check_carry(events: Any, cut: Windows) -> None:
    """Raise :class:`AmiwarpError` if times cannot be carried from each window to the next."""
    if isinstance(events, list | tuple) and len(events) > 1:
        raise AmiwarpError(
            f"carry is given for {len(events)} recordings; call the function for each of them"
        )
    if (np.diff(cut.start) < 0).any() or (np.diff(cut.t_end) < 0).any():
        raise AmiwarpError(
            "carry is given for windows that are not in order of time; sort them, or leave carry out"
        )


EventsLike: TypeAlias = Events | DeviceEvents | Sequence[Events] | Sequence[DeviceEvents]
"""Events of one recording, or of several."""


@guarded
def event_count(
    events: EventsLike,
    width: int,
    height: int,
    *,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[Any] | wp.array:
    """Count the events at each pixel.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or the events of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, the times of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        Events per pixel, shape ``(height, width)``, int32. Compensated events are shared among the four nearest
        pixels by bilinear weights, as float32. A Warp array on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.event_count(events, 3, 2)
    array([[0, 2, 0],
           [0, 0, 1]], dtype=int32)
    """
    batch = batch_of(events, (width, height), windows, t_start, t_end, model, encoder, device)
    return batch.finish(_counted(batch, Grid(*batch.size)).reshape((-1, height, width)))


@guarded
def polarity_histogram(
    events: EventsLike,
    width: int,
    height: int,
    *,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[Any] | wp.array:
    """Count the OFF and the ON events at each pixel.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or the events of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, the times of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        OFF, then ON events per pixel, shape ``(2, height, width)``, int32. Compensated events are shared among the
        four nearest pixels by bilinear weights, as float32. A Warp array on the same device for
        :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.polarity_histogram(events, 3, 2)[1]
    array([[0, 1, 0],
           [0, 0, 1]], dtype=int32)
    """
    batch = batch_of(events, (width, height), windows, t_start, t_end, model, encoder, device)
    return batch.finish(_counted(batch, Grid(*batch.size, layers=2)))


def _counted(batch: WindowBatch, grid: Grid) -> wp.array | NDArray[Any]:
    """Return the counts of all windows, shape (windows, layers, height, width)."""
    if not batch.events.whole_pixels:
        return share_images(batch, grid, 1)
    shape = grid.layers, grid.height, grid.width
    if takes_whole_windows(batch):
        out = batch.zeros(shape, np.int32)
        settings = [struct_of(kernels.Grid, *grid)]
        run_on_windows(batch, tensors_by_window.count_windows, settings, out)
        return out
    out = batch.empty(shape, wp.int32)
    for first, number, images in count_images(batch, grid):
        wp.copy(result_rows(out, first, number), images, count=number * math.prod(shape))
    return out


@guarded
def voxel_grid(
    events: EventsLike,
    width: int,
    height: int,
    bins: int,
    *,
    end_bin: bool = True,
    normalize: bool = False,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[np.float32] | wp.array:
    """Compute the voxel grid: the polarities of the events, shared linearly between time bins.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or the events of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    bins : int
        Number of time bins.
    end_bin : bool, default True
        Put the first bin at the start and the last bin at the end of the window, so that there are ``bins - 1``
        intervals. Without it, there are ``bins`` intervals, and what belongs to the window's end is left out.
    normalize : bool, default False
        Shift and scale the elements of each window that are not 0 to a mean of 0 and a standard deviation of 1.
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, the times of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        Voxel grid, float32, shape ``(bins, height, width)``. A Warp array on the same device for
        :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Notes
    -----
    An event of polarity p (1 for ON, -1 for OFF) at time t adds ``p * max(0, 1 - abs(b - s))`` to bin b, with
    ``s = (bins - 1) * (t - t_start) / (t_end - t_start)`` [1]_. Compensated events are shared among the four nearest
    pixels, too. Each event is exact to 2**-23, and the sums do not depend on the device or the number of threads.

    References
    ----------
    .. [1] Zhu et al., "Unsupervised event-based learning of optical flow, depth, and egomotion", CVPR 2019.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.voxel_grid(events, 3, 2, bins=2)[:, 0, 1]
    array([-0.5,  0.5], dtype=float32)
    """
    bins = whole(bins, "bins", 1, MOST_BINS)
    batch = batch_of(events, (width, height), windows, t_start, t_end, model, encoder, device)
    intervals = bins - 1 if end_bin else bins
    grid = Grid(*batch.size, steps=max(intervals, 1), rate=intervals, off=-1)
    out = share_images(batch, grid, bins)
    if normalize and len(batch.windows):
        normalise(out.reshape((len(batch.windows), -1)))
    return batch.finish(out)


@guarded
def stacked_histogram(
    events: EventsLike,
    width: int,
    height: int,
    bins: int,
    *,
    limit: int = 255,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[np.uint8] | wp.array:
    """Count the OFF and the ON events at each pixel in time bins, as bytes.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or the events of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    bins : int
        Number of time bins of equal length.
    limit : int, default 255
        Largest count. Larger ones are clipped.
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, the times of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        Counts of the OFF events in each bin, then of the ON events, uint8, shape ``(2 * bins, height, width)``. A
        compensated event counts at its nearest pixel. A Warp array on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Notes
    -----
    An event at time t is in bin ``floor(bins * (t - t_start) / (t_end - t_start))``; those at ``t_end`` are in the last
    bin. This is the input of RVT [1]_.

    References
    ----------
    .. [1] Gehrig and Scaramuzza, "Recurrent vision transformers for object detection with event cameras", CVPR 2023.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.stacked_histogram(events, 3, 2, bins=2)[:, 0, 1]
    array([1, 0, 0, 1], dtype=uint8)
    """
    bins = whole(bins, "bins", 1, MOST_BINS)
    limit = whole(limit, "limit", 1, 255)
    batch = batch_of(events, (width, height), windows, t_start, t_end, model, encoder, device)
    grid = Grid(*batch.size, steps=bins, rate=bins, layers=2)
    if takes_whole_windows(batch) and are_sparse(batch, 2 * bins * width * height):
        check_lengths(batch.windows, grid)
        out = batch.zeros((2 * bins, height, width), np.uint8)
        settings = [struct_of(kernels.Grid, *grid), limit]
        run_on_windows(batch, tensors_by_window.clip_windows, settings, out)
        return batch.finish(out)
    out = batch.empty((2 * bins, height, width), wp.uint8)
    length = width if batch.device.is_cpu else 1
    for first, number, images in count_images(batch, grid):
        part = result_rows(out, first, number)
        inputs = [images, struct_of(kernels.Grid, *grid), limit, length]
        launch(
            tensor_values.clip_counts,
            part.size // length,
            inputs,
            [part],
            device=batch.device,
            smallest=SMALLEST,
        )
    return batch.finish(out)


@guarded
def time_surface(
    events: EventsLike,
    width: int,
    height: int,
    tau_us: float,
    *,
    linear: bool = False,
    per_polarity: bool = True,
    carry: bool = False,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[np.float32] | wp.array:
    """Compute the time surface: how long ago the latest event was at each pixel, as a decay from 1 to 0.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or the events of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    tau_us : float
        Time constant of the decay [us].
    linear : bool, default False
        Decay linearly to 0 within ``tau_us``, not exponentially.
    per_polarity : bool, default True
        Return separate images for OFF and ON.
    carry : bool, default False
        Use the latest times of earlier windows, too. The windows must then be of one recording and in order.
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, the times of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        Time surface, float32, shape ``(2, height, width)``: OFF, then ON. Without ``per_polarity``, shape
        ``(height, width)``. A compensated event is at its nearest pixel. A Warp array on the same device for
        :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Notes
    -----
    With the latest event at time t, a pixel is ``exp(-(t_end - t) / tau_us)`` [1]_, or
    ``max(0, 1 - (t_end - t) / tau_us)``; without events, it is 0. If t is after ``t_end``, it is 1.

    References
    ----------
    .. [1] Lagorce et al., "HOTS: a hierarchy of event-based time-surfaces for pattern recognition", TPAMI 2017.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.time_surface(events, 3, 2, tau_us=20, linear=True, per_polarity=False)[:, 1:]
    array([[0.5, 0. ],
           [0. , 1. ]], dtype=float32)
    """
    tau = real(tau_us, "tau_us", 1e-6, hint=" us")
    batch = batch_of(events, (width, height), windows, t_start, t_end, model, encoder, device)
    grid = Grid(*batch.size, layers=2 if per_polarity else 1)
    size = grid.layers * height * width
    decay = tensor_values.Decay()
    decay.tau = tau
    decay.linear = int(linear)
    if carry:
        _check_carry(events, batch.windows)
    elif takes_whole_windows(batch):
        out = batch.zeros((grid.layers, height, width), np.float32)
        settings = [struct_of(kernels.Grid, *grid), decay]
        run_on_windows(batch, tensors_by_window.decay_windows, settings, out, scratch=size)
        return batch.finish(out if per_polarity else out.reshape((-1, height, width)))
    out = batch.empty((grid.layers, height, width), wp.float32)
    for first, number, images in latest_images(batch, grid, carry=carry):
        part = result_rows(out, first, number)
        ends = wp.array(
            batch.windows.t_end[first : first + number], dtype=wp.int64, device=batch.device
        )
        launch(
            tensor_values.decay_times,
            part.size,
            [images, ends, size, decay],
            [part],
            device=batch.device,
        )
    return batch.finish(out if per_polarity else out.reshape((-1, height, width)))


@guarded
def latest_times(
    events: EventsLike,
    width: int,
    height: int,
    *,
    per_polarity: bool = True,
    carry: bool = False,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[np.int64] | wp.array:
    """Return the time of the latest event at each pixel: the surface of active events (SAE).

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or the events of several recordings. Compensated events outside the
        image are left out.
    width, height : int
        Size of the image [px].
    per_polarity : bool, default True
        Return separate images for OFF and ON.
    carry : bool, default False
        Use the latest times of earlier windows, too. The windows must then be of one recording and in order.
    windows : Windows, optional
        Windows of the events. The result then has one more axis, in front. A list of events has one window for each.
    t_start, t_end : int, optional
        First and last time of the only window [us], both included. By default, the times of the first and last event.
    model : Model, optional
        Optical model. Events are first moved to their positions without the optic. Requires ``encoder``.
    encoder : Encoder, optional
        Encoder that covers the events. Requires ``model``.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device stay there.

    Returns
    -------
    ndarray or warp.array
        Times [us], int64, shape ``(2, height, width)``: OFF, then ON. Without ``per_polarity``, shape
        ``(height, width)``. Pixels without events have the lowest value of int64. A compensated event is at its
        nearest pixel. A Warp array on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.latest_times(events, 3, 2, per_polarity=False)[0, 1]
    np.int64(10)
    """
    batch = batch_of(events, (width, height), windows, t_start, t_end, model, encoder, device)
    grid = Grid(*batch.size, layers=2 if per_polarity else 1)
    out = batch.empty((grid.layers, height, width), wp.int64)
    if carry:
        _check_carry(events, batch.windows)
    elif takes_whole_windows(batch):
        settings = [struct_of(kernels.Grid, *grid)]
        run_on_windows(batch, tensors_by_window.keep_latest_windows, settings, out.numpy())
        return batch.finish(out if per_polarity else out.reshape((-1, height, width)))
    for first, number, images in latest_images(batch, grid, carry=carry):
        size = number * grid.layers * height * width
        wp.copy(result_rows(out, first, number), images, count=size)
    return batch.finish(out if per_polarity else out.reshape((-1, height, width)))
