"""Sorting of events by time across packets."""

from __future__ import annotations

import numpy as np

from amiwarp.events.recording import Events


class EventSorter:
    """Sorts events by time across packets. Each event is returned once.

    Packets in order pass at once and unchanged. After an event that is earlier than the events of a previous packet,
    events are held back for as long as that event was late, by at most ``most_us`` [us] of event time and
    ``most_events`` events. This ends after :data:`CALM_US` without disorder. An event that is later still gets the time
    of the last event returned, and is counted in :attr:`late`.
    """

    CALM_US = 1_000_000
    """Event time without disorder after which events are no longer held back [us]."""

    def __init__(self, *, most_us: int = 10_000, most_events: int = 1 << 18) -> None:
        self._most_us = most_us
        self._most_events = most_events
        self._hold_us = 0
        self._last_out_us = -(1 << 62)
        self._newest_us = -(1 << 62)
        self._disorder_us = 0  # newest time at the last disorder
        self._held: Events | None = None
        self.late = 0
        """Number of events that were too late to be sorted and got a later time stamp."""

    def put(self, events: Events) -> Events:
        """Add a packet's events; return the events that are ready, in order of time."""
        t = events.t
        if not len(events):
            return events
        holds_none = not self._hold_us
        if holds_none and t[0] >= self._last_out_us and not (t[1:] < t[:-1]).any():
            self._last_out_us = int(t[-1])
            self._newest_us = self._last_out_us
            return events

        lateness = self._newest_us - int(t.min())
        self._newest_us = max(self._newest_us, int(t.max()))
        if lateness > 0:
            self._hold_us = max(self._hold_us, min(lateness, self._most_us))
            self._disorder_us = self._newest_us
        elif self._newest_us - self._disorder_us > self.CALM_US:
            self._hold_us = 0
        return self._release(events, self._newest_us - self._hold_us)

    def flush(self) -> Events:
        """Return all events that are still held back."""
        return self._release(Events.empty(), self._newest_us)

    def _release(self, events: Events, until: int) -> Events:
        """Return the events up to the time ``until`` [us], and hold back the later events."""
        joined = events if self._held is None else Events.concatenate([self._held, events])
        joined = joined[np.argsort(joined.t, kind="stable")]
        late = int(np.searchsorted(joined.t, self._last_out_us))
        if late:
            self.late += late
            t = joined.t.copy()
            t[:late] = self._last_out_us
            joined = Events(joined.x, joined.y, t, joined.p)
        ready = int(np.searchsorted(joined.t, until, "right"))
        # Late events wait for nothing; held back, they would be overtaken by others that are as late.
        count = max(ready, late, len(joined) - self._most_events)
        out = joined[:count]
        held = joined[count:]
        self._held = held if len(held) else None
        if len(out):
            self._last_out_us = int(out.t[-1])
        return out
