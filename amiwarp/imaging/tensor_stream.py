"""Tensors of a stream of events at a steady rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from amiwarp.events.recording import Events
from amiwarp.schema.calls import guarded
from amiwarp.validation import instance, real

LEAST_HZ = 0.1
MOST_HZ = 1e5
"""Lowest and highest rate of tensors [Hz]. Events of a window are held until its end."""


@guarded
@dataclass(frozen=True, slots=True, eq=False)
class StreamTensor:
    """Tensor of the events of one window of a stream."""

    tensor: Any
    """The tensor, as the representation returns it, not checked."""
    t_start: int
    """Start of the window, on the events' clock [us]."""
    t_end: int
    """End of the window [us], exclusive."""
    events: int
    """Number of events in the window."""


@guarded
class TensorStream:
    """Tensors of a stream at a steady rate. Packets of any length give the same tensors.

    The first window starts at the first event. A window is complete once an event at or after its end has come. Windows
    without events give no tensor: each tensor names its times. Use a stream from one thread only.

    Parameters
    ----------
    representation : callable
        Function of events with the parameters ``t_start`` and ``t_end`` [us], such as
        ``amiwarp.ToTensor(amiwarp.voxel_grid, width=640, height=480, bins=5)``.
    rate_hz : float
        Number of tensors per second of the stream [Hz].

    Raises
    ------
    AmiwarpError
        If the rate is not between 0.1 and 100,000 Hz.

    Examples
    --------
    >>> to_tensor = amiwarp.ToTensor(amiwarp.event_count, width=3, height=2)
    >>> stream = amiwarp.TensorStream(to_tensor, rate_hz=100.0)
    >>> events = amiwarp.Events.from_arrays([1, 1, 2], [0, 0, 1], [0, 5_000, 12_000], [0, 1, 1])
    >>> [(found.t_start, found.t_end, found.events) for found in stream.put(events)]
    [(0, 10000, 2)]
    >>> stream.finish().tensor
    array([[0, 0, 0],
           [0, 0, 1]], dtype=int32)
    """

    def __init__(self, representation: Callable[..., Any], rate_hz: float) -> None:
        self._representation = representation
        self._rate_hz = real(rate_hz, "rate_hz", LEAST_HZ, MOST_HZ, " Hz")
        self._first_us: int | None = None
        self._number = 0
        self._held: list[Events] = []

    def put(self, events: Events) -> list[StreamTensor]:
        """Add events, and return the tensors of the windows that are complete.

        Parameters
        ----------
        events : Events
            Events of a sensor, or compensated or undistorted ones, sorted by time and not earlier than those before.

        Returns
        -------
        list of StreamTensor
            The tensors, in order of time.
        """
        instance(events, Events, "events")
        if not len(events):
            return []
        if self._first_us is None:
            self._first_us = int(events.t[0])
        found = []
        start = 0
        while start < len(events):
            number = self._number_of(int(events.t[start]))
            if self._held and number != self._number:
                found.append(self._tensor())
            self._number = number
            stop = int(np.searchsorted(events.t, self._start_us(number + 1)))
            self._held.append(events[start:stop])
            start = stop
        return found

    def finish(self) -> StreamTensor | None:
        """Return the tensor of the last window, which may not be complete; None if there are no further events.

        Returns
        -------
        StreamTensor or None
            The tensor.
        """
        return self._tensor() if self._held else None

    def _start_us(self, number: int) -> int:
        """Return the start of a window [us]."""
        assert self._first_us is not None
        return self._first_us + round(number * 1e6 / self._rate_hz)

    def _number_of(self, t: int) -> int:
        """Return the number of the window of a time [us]."""
        assert self._first_us is not None
        number = int((t - self._first_us) * 1e-6 * self._rate_hz)
        while self._start_us(number + 1) <= t:  # the start was rounded down
            number += 1
        return number

    def _tensor(self) -> StreamTensor:
        """Return the tensor of the events that are held, and release them."""
        events = Events.concatenate(self._held)
        self._held = []
        t_start = self._start_us(self._number)
        t_end = self._start_us(self._number + 1)
        tensor = self._representation(events, t_start=t_start, t_end=t_end)
        return StreamTensor(tensor, t_start, t_end, len(events))
