"""Representations of the latest events at each pixel, and the event spike tensor."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.imaging.tensors import MOST_BINS, EventsLike
from amiwarp.imaging.window_batch import MOST_EVENTS, WindowBatch, batch_of, window_rows
from amiwarp.imaging.window_images import (
    MOST_BYTES,
    SMALLEST,
    Grid,
    check_lengths,
    result_rows,
    struct_of,
)
from amiwarp.imaging.windows import Windows
from amiwarp.kernels import recent_events
from amiwarp.kernels import tensors as kernels
from amiwarp.kernels.background_activity import NEVER
from amiwarp.kernels.launch import launch, slices
from amiwarp.kernels.loading import load
from amiwarp.kernels.workers import run_together
from amiwarp.optics.models.base import Model
from amiwarp.schema.calls import guarded
from amiwarp.tasks import cpu_threads
from amiwarp.validation import real, whole

MOST_DEPTH = 256
"""Largest number of latest events of a pixel."""
MOST_STACKS = 32
"""Largest number of stacks: each has about half as many events as the one before it."""


@guarded
def tore_volume(
    events: EventsLike,
    width: int,
    height: int,
    depth: int,
    *,
    shortest_us: float = 150.0,
    longest_us: float = 5_000_000.0,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[np.float32] | wp.array:
    """Compute the volume of time-ordered recent events (TORE): the ages of the latest events, as logarithms.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or the events of several recordings. A compensated event counts at
        its nearest pixel, and is left out if it is outside the image.
    width, height : int
        Size of the image [px].
    depth : int
        Number of latest events of each pixel and polarity, at most 256.
    shortest_us, longest_us : float
        Limits of the age [us]. A pixel with fewer events has the longest age for those that it lacks.
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
        Logarithms of the ages, float32, shape ``(2 * depth, height, width)``: of the OFF events from the latest one,
        then of the ON events. 0 is the shortest age. A Warp array on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Notes
    -----
    An event at time t gives ``log((age + 1) / (shortest_us + 1))`` with ``age = t_end - t``, limited to ``shortest_us``
    and ``longest_us`` [1]_. Only events of the window count. The authors put ON before OFF.

    References
    ----------
    .. [1] Baldwin et al., "Time-ordered recent event (TORE) volumes for event cameras", TPAMI 2022.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.tore_volume(events, 3, 2, depth=1, shortest_us=9.0, longest_us=99.0)[:, 0, 1]
    array([0.74193734, 0.09531018], dtype=float32)
    """
    depth = whole(depth, "depth", 1, MOST_DEPTH)
    shortest = real(shortest_us, "shortest_us", 0.0, hint=" us")
    longest = real(longest_us, "longest_us", 0.0, hint=" us")
    if longest <= shortest:
        raise AmiwarpError(
            f"longest_us is {longest} us and shortest_us {shortest} us; give a longer longest_us"
        )
    batch = batch_of(events, (width, height), windows, t_start, t_end, model, encoder, device)
    out = batch.empty((2 * depth, height, width), wp.float32)
    size = 2 * depth * height * width
    grid = Grid(*batch.size, steps=depth)
    for first, number, recent in _values(batch, grid, recent_events.keep_recent, 2 * depth, NEVER):
        ends_us = batch.windows.t_end[first : first + number]
        ends = wp.array(ends_us, dtype=wp.int64, device=batch.device)
        part = result_rows(out, first, number)
        _read(batch, recent_events.read_recent, [recent, ends, size, shortest, longest], part)
    return batch.finish(out)


@guarded
def mixed_density_stack(
    events: EventsLike,
    width: int,
    height: int,
    stacks: int,
    *,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[np.int8] | wp.array:
    """Stack the polarities of the last events at each pixel: of all events, of the later half, and so on.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or the events of several recordings. A compensated event counts at
        its nearest pixel, and is left out if it is outside the image.
    width, height : int
        Size of the image [px].
    stacks : int
        Number of stacks, at most 32.
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
        Polarity of the last event of each pixel in each stack, int8, shape ``(stacks, height, width)``: 1 for ON, -1
        for OFF, 0 without an event. A Warp array on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Notes
    -----
    The first stack has all n events of the window. Each further stack leaves out the first ``n // 2``, then
    ``n // 4``, ``n // 8``, … of the remaining events [1]_, so that about ``n / 2**k`` are left.

    References
    ----------
    .. [1] Nam et al., "Stereo depth from events cameras: concentrate and focus on the future", CVPR 2022.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.mixed_density_stack(events, 3, 2, stacks=2)[:, 1, 2]
    array([1, 1], dtype=int8)
    """
    stacks = whole(stacks, "stacks", 1, MOST_STACKS)
    batch = batch_of(events, (width, height), windows, t_start, t_end, model, encoder, device)
    out = batch.empty((stacks, height, width), wp.int8)
    size = height * width
    kept = _values(
        batch, Grid(*batch.size), recent_events.keep_last, 1, 0, results_per_number=stacks
    )
    for first, number, last in kept:
        rows, _ = window_rows(batch.windows[first : first + number], batch.device)
        part = result_rows(out, first, number)
        inputs = [last, rows, size, stacks]
        launch(recent_events.read_stack, number * size, inputs, [part], device=batch.device)
    return batch.finish(out)


@guarded
def event_spike_tensor(
    events: EventsLike,
    width: int,
    height: int,
    bins: int,
    *,
    windows: Windows | None = None,
    t_start: int | None = None,
    t_end: int | None = None,
    model: Model | None = None,
    encoder: Encoder | None = None,
    device: Any = None,
) -> NDArray[np.float32] | wp.array:
    """Compute the event spike tensor (EST) with the trilinear kernel: the times of events, shared between time bins.

    Parameters
    ----------
    events : Events or DeviceEvents, or a list of them
        Events, raw or compensated, sorted by time; or the events of several recordings. A compensated event counts at
        its nearest pixel, and is left out if it is outside the image.
    width, height : int
        Size of the image [px].
    bins : int
        Number of time bins. The first one is at the start of the window, and the last one at its end.
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
        Sums of the OFF events in each bin, then of the ON events, float32, shape ``(2 * bins, height, width)``. A Warp
        array on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If a raw event lies outside the image, the times of a window decrease, the windows do not fit the events, only
        one of ``model`` and ``encoder`` is given, or the events are on another device than ``device``.

    Notes
    -----
    An event at ``s = (t - t_start) / (t_end - t_start)`` adds ``s * max(0, 1 - abs((bins - 1) * s - b))`` to bin b of
    its polarity: the time as the measurement, and the trilinear kernel with which the authors initialise the kernel
    that they train [1]_. Each event is exact to 2**-29, and the sums depend neither on the device nor on the number of
    threads.

    References
    ----------
    .. [1] Gehrig et al., "End-to-end learning of representations for asynchronous event-based data", ICCV 2019.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 10, 20], [0, 1, 1])
    >>> amiwarp.event_spike_tensor(events, 3, 2, bins=2)[2:, 0, 1]
    array([0.25, 0.25], dtype=float32)
    """
    bins = whole(bins, "bins", 1, MOST_BINS)
    batch = batch_of(events, (width, height), windows, t_start, t_end, model, encoder, device)
    out = batch.empty((2 * bins, height, width), wp.float32)
    grid = Grid(*batch.size, steps=max(bins - 1, 1), rate=bins - 1)
    check_lengths(batch.windows, grid)
    for first, number, sums in _values(batch, grid, recent_events.add_spikes, 2 * bins, 0):
        part = result_rows(out, first, number)
        _read(batch, recent_events.read_spikes, [sums], part)
    return batch.finish(out)


def _read(batch: WindowBatch, kernel: Any, inputs: list[Any], out: wp.array) -> None:
    """Run a kernel that computes elements of the result: on a CPU, a thread computes a row of an image."""
    width, _ = batch.size
    length = width if batch.device.is_cpu else 1
    launch(
        kernel,
        out.size // length,
        [*inputs, length],
        [out],
        device=batch.device,
        smallest=SMALLEST,
    )


def _values(
    batch: WindowBatch,
    grid: Grid,
    kernel: Any,
    images: int,
    empty: Any,
    *,
    results_per_number: int = 1,
) -> Iterator[tuple[int, int, wp.array]]:
    """Run a kernel on the events of all windows. Yield the first window, the number of windows, and their numbers.

    A window has ``images`` images of 64-bit numbers, ``empty`` at first, which the next windows overwrite. On a CPU,
    each thread takes some of the windows. ``results_per_number``: numbers of the result for each of them, all of which
    32-bit indices must reach.
    """
    device = batch.device
    count = len(batch.windows)
    size = images * grid.height * grid.width
    threads = cpu_threads() if device.is_cpu else 1
    fitting = max(MOST_BYTES["cpu" if device.is_cpu else "cuda"] // (8 * size), threads)
    most = max(1, min(fitting, count, MOST_EVENTS // (size * results_per_number)))
    values = wp.empty(min(most, count) * size, dtype=wp.int64, device=device)
    columns = batch.device_columns()
    length = int(kernels.BLOCK) if device.is_cpu else 1
    load(kernel, device)

    def run(cut: Windows, part: wp.array) -> None:
        rows, blocks = window_rows(cut, device)
        inputs = [*columns, rows, struct_of(kernels.Grid, *grid), length]
        outputs = [batch.faults, part]
        wp.launch(kernel, blocks * int(kernels.BLOCK) // length, inputs, outputs, device=device)

    for first in range(0, count, most):
        number = min(most, count - first)
        values.fill_(int(empty))
        jobs = []
        for start, stop in slices(number, threads, 1):
            cut = batch.windows[first + start : first + stop]
            jobs.append(partial(run, cut, values[start * size : stop * size]))
        run_together(jobs)
        yield first, number, values
