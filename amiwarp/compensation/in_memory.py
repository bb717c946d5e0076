"""Motion compensation of events in memory."""

from __future__ import annotations

import contextlib
from typing import Any, overload

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.compensation.gpu_pieces import GpuPieces
from amiwarp.events.device_events import (
    DeviceEvents,
    check_order,
    check_sensor,
    device_for,
    limits,
    time_span,
    wait,
)
from amiwarp.events.encoder import Encoder, check_prisms
from amiwarp.events.recording import Events
from amiwarp.kernels.compensation import LaunchPlan
from amiwarp.kernels.encoder_pieces import encoder_params
from amiwarp.kernels.events import join_columns
from amiwarp.kernels.launch import launch
from amiwarp.optics.models.base import Model
from amiwarp.schema.calls import guarded


class BlockCompensator:
    """Compensation of blocks of events by one model and one encoder on a device. Any thread may call it."""

    def __init__(
        self,
        model: Model,
        encoder: Encoder,
        t_first: int,
        t_last: int,
        device: Any,
    ) -> None:
        """Copy the model, and the encoder's samples for a span of event times, to the device.

        Raises :class:`AmiwarpError` if the encoder does not cover the times ``t_first`` .. ``t_last`` [us].
        """
        check_prisms(encoder, model.ANGLES)
        self._device = wp.get_device(device)
        self._plan = LaunchPlan(model, self._device)
        self._encoder = encoder_params(encoder, t_first, t_last, str(self._device))
        self._pieces = None
        if not self._device.is_cpu:
            self._pieces = GpuPieces(self._plan, self._encoder, self._device)

    def __call__(
        self,
        events: Events,
        *,
        all_cores: bool = False,
    ) -> tuple[Events, NDArray[np.uint8]]:
        """Return compensated events (NaN without coordinates), and 1 for each inside the image, shape ``(n,)``."""
        check_sensor(events)
        if not len(events):
            no_positions = np.zeros(0, np.float32)
            return Events(no_positions, no_positions, events.t, events.p), np.zeros(0, np.uint8)
        if self._pieces is None:
            x, y, inside = self._on_cpu(events, all_cores)
        else:
            x, y, inside = self._pieces(events)
        return Events(x, y, events.t, events.p), inside

    def on_device(self, events: DeviceEvents) -> tuple[wp.array, wp.array]:
        """Return compensated x and y of at least one event, as Warp arrays of shape ``(n,)``."""
        check_sensor(events)
        extremes = limits(events)
        one_thread = self._pieces.one_thread if self._pieces else contextlib.nullcontext()
        with one_thread:
            columns = self._plan.device_columns(events)
            results = self._plan.run(columns, self._encoder, extremes.right, extremes.bottom)
        return results.out_x[: len(events)], results.out_y[: len(events)]

    def _on_cpu(self, events: Events, all_cores: bool) -> list[NDArray[Any]]:
        """Return compensated x and y [px] and 1 for each event inside the image, on a CPU."""
        count = len(events)
        padded = self._plan.padded(count)
        columns = [
            _column(events.x, wp.uint16, padded),
            _column(events.y, wp.uint16, padded),
            _column(events.t, wp.int64, padded),
        ]
        max_x = events.x.max()
        max_y = events.y.max()
        results = self._plan.run(columns, self._encoder, max_x, max_y, all_cores=all_cores)
        x = results.out_x.numpy()
        y = results.out_y.numpy()
        inside = results.inside.numpy()
        return [x[:count], y[:count], inside[:count]]


def _column(values: NDArray[Any], dtype: Any, padded: int) -> Any:
    """Return values as a padded column on a CPU, without a copy if possible."""
    if len(values) < padded:
        padding = np.zeros(padded - len(values), values.dtype)
        values = np.concatenate([values, padding])
    contiguous = np.ascontiguousarray(values)
    return wp.array(contiguous, dtype=dtype, device="cpu", copy=False)


@overload
def compensate_events(
    events: Events, model: Model, encoder: Encoder, *, device: Any = ...
) -> NDArray[np.float32]: ...
@overload
def compensate_events(
    events: DeviceEvents, model: Model, encoder: Encoder, *, device: Any = ...
) -> wp.array: ...
@guarded
def compensate_events(
    events: Events | DeviceEvents, model: Model, encoder: Encoder, *, device: Any = None
) -> NDArray[np.float32] | wp.array:
    """Compensate events in memory: return their positions without the prism.

    Parameters
    ----------
    events : Events or DeviceEvents
        Events with the whole pixel coordinates of a sensor (uint16), sorted by time.
    model : Model
        Optical model of the prism.
    encoder : Encoder
        Encoder that covers the events.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device are compensated there.

    Returns
    -------
    ndarray or warp.array
        Coordinates without the prism [px], float32, shape ``(n, 2)``; NaN for events without a solution. A Warp array
        on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If the encoder does not cover the events, their coordinates are not whole pixels, their times decrease, or they
        are on another device than ``device``.

    Examples
    --------
    >>> camera = amiwarp.Camera.from_fov(64, 48, 1.0)
    >>> model = amiwarp.CircleModel.from_prism(camera, amiwarp.Prism(0.02), 0.3)
    >>> events = amiwarp.Events.from_arrays([10, 20], [30, 40], [0, 1000], [0, 1])
    >>> encoder = amiwarp.Encoder.constant_speed(720.0, 0, 2000)
    >>> amiwarp.compensate_events(events, model, encoder).shape
    (2, 2)
    """
    device = device_for(events, device)
    check_order(events)
    if isinstance(events, DeviceEvents):
        return _compensate_on_device(events, model, encoder)
    t_first, t_last = time_span(events) if len(events) else encoder.coverage
    compensator = BlockCompensator(model, encoder, t_first, t_last, device)
    compensated, _ = compensator(events, all_cores=True)
    return np.stack([compensated.x, compensated.y], axis=1)


def _compensate_on_device(events: DeviceEvents, model: Model, encoder: Encoder) -> wp.array:
    """Return finished coordinates without the prism [px], shape (n, 2)."""
    check_sensor(events)
    device = events.device
    count = len(events)
    xy = wp.empty((count, 2), dtype=float, device=device)
    if count:
        compensator = BlockCompensator(model, encoder, events.t_first, events.t_last, device)
        x, y = compensator.on_device(events)
        launch(join_columns, count, [x, y], [xy], device=device)
    wait(events.device)
    return xy
