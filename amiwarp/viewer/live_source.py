"""Live stream as the inspector sees it: its last seconds as a recording, and figures about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder_speed import rpm_between

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording
    from amiwarp.live.stream.recent_events import RecentEvents


@dataclass(frozen=True)
class LiveFigures:
    """Figures about a live stream, for the page."""

    connected: bool
    """Whether events arrive."""
    problem: str
    """Why no events arrive; empty if they do."""
    no_angles: str
    """Why no angles of the prism arrive; empty if they do, or if no events arrive either."""
    rate_mev_s: float
    """Rate of the received events [million events/s]."""
    latency_ms: float
    """Time since the latest events arrived [ms]: the age of what is shown, if it is shown now."""
    turn_share: float
    """Share of a turn of the prism that the kept events cover, 0 to 1."""
    dropped: int
    """Number of events that were dropped because this computer was too slow."""
    late: int
    """Number of events that arrived out of order and got a later time."""
    rpm: float | None
    """Measured speed of the prism in the last turn of the shown events [turns/min]; None if it is unknown."""
    message: str
    """Latest message of the source or of the controller; empty if there was none."""


class LiveSource:
    """Function that returns the last seconds of a stream as a recording, with figures about the stream."""

    def __init__(self, recent: RecentEvents, messages: Sequence[str]) -> None:
        """Start with events of at least one turn. ``messages`` grows while the stream is followed.

        Raises :class:`AmiwarpError` if there are fewer events.
        """
        first = recent.recording()
        if first is None:
            raise AmiwarpError("the stream has delivered less than one full turn; wait for one")
        self._recent, self._messages, self._last = recent, messages, first

    def __call__(self) -> Recording:
        """Return the latest events of at least one turn."""
        self._last = self._recent.recording() or self._last
        return self._last

    def figures(self) -> LiveFigures:
        """Return the figures of this moment."""
        recent, status, problem = self._recent, self._recent.status, self._recent.silence
        last, encoder = self._last.events.t_last, self._last.encoder
        turn_us = 2e6 if encoder is None else min(2e6, 60e6 / max(abs(encoder.rpm), 1.0))
        rpm = None if encoder is None else rpm_between(encoder, round(last - turn_us), last)
        return LiveFigures(
            not problem, problem, "" if problem else recent.encoder_silence, 0.0 if problem else status.rate_mev_s,
            1e3 * recent.age_s, recent.turn_share, status.dropped, status.late, rpm,
            self._messages[-1] if self._messages else "",
        )  # fmt: skip
