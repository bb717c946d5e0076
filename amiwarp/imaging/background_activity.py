"""Background activity: events that no earlier event at a neighbouring pixel supports."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.device_events import check_sensor
from amiwarp.events.recording import Events
from amiwarp.imaging.corners import sensor_side
from amiwarp.imaging.filters import EventFilter, RunningFilter
from amiwarp.kernels.event_filter import LONGEST_US
from amiwarp.schema.calls import guarded
from amiwarp.validation import instance, vector, whole

SUPPORT_US = 10_000
"""Default time within which a neighbour supports an event [us]."""


@guarded
def find_background_activity(
    events: Events,
    size: tuple[int, int],
    *,
    window_us: int = SUPPORT_US,
) -> NDArray[np.bool_]:
    """Find the events that are probably noise, because no neighbouring pixel fired shortly before.

    Parameters
    ----------
    events : Events
        Events from a sensor, sorted by time.
    size : tuple of int
        Sensor size (width, height) [px].
    window_us : int, optional
        Longest time since an event at one of the eight neighbours [us], 1 to 1e9. Polarities are not compared.

    Returns
    -------
    ndarray
        Whether each event is background activity, bool, shape ``(n,)``.

    Raises
    ------
    AmiwarpError
        If the events are compensated, out of order or outside the sensor, or ``window_us`` is below 1 or over 1e9.

    Notes
    -----
    Source: Delbruck, "Frame-free dynamic digital vision", 2008. The first event of an edge at each place has no support
    and is removed too. A single CPU thread passes over the events in their order.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[3, 4, 9], y=[3, 3, 9], t=[0, 500, 900], p=[1, 1, 0])
    >>> amiwarp.find_background_activity(events, (16, 16), window_us=1000)
    array([ True, False,  True])
    """
    instance(events, Events, "events")
    check_sensor(events)
    sides = vector(size, 2, "size of the sensor", sensor_side)
    width, height = map(int, sides)
    window_us = whole(window_us, "window_us", 1, LONGEST_US, " us")
    chosen = EventFilter(background_us=window_us)
    return ~RunningFilter(chosen, (width, height)).keep(events)
