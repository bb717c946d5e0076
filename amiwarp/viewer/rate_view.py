"""Event rates on a page's timeline: counted in the background, and shown for the part of the time that is visible."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from amiwarp.viewer.event_rates import EventRates

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.viewer.panel import Panel

BINS = 400
"""Number of points of the drawn rates."""
STEP_S = 0.2
"""Duration of counting after which the timeline shows what is counted [s]."""


class RateView:
    """Rates of ON and OFF events of a page's recording."""

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self._rates: EventRates | None = None

    def start(self) -> None:
        """Count the events of the page's recording."""
        self._rates = rates = EventRates(self._panel.inspector.recording.events)
        self._panel.start_job(self._fill(rates))

    def zoom(self, start_ms: float, end_ms: float) -> None:
        """Show the rates between two times [ms]."""
        whole = float(self._panel.state.whole_ms)
        start, end = max(0.0, start_ms), min(end_ms, whole)
        if end - start > 1e-2:
            self._panel.state.rate_span = [start, end]
            self.show()

    def show(self) -> None:
        """Show the rates of the visible time."""
        if self._rates is None:
            return
        zero_us, (start, end) = self._panel.zero_us, self._panel.state.rate_span
        curve = self._rates.curve(zero_us + round(start * 1e3), zero_us + round(end * 1e3), BINS)
        share = self._rates.share
        note = "" if share >= 1.0 else f"counting events: {100.0 * share:.0f} %"
        self._panel.state.update({"rate_on": _bytes(curve.on), "rate_off": _bytes(curve.off), "rate_note": note})

    async def _fill(self, rates: EventRates) -> None:
        finished = False
        while not finished and rates is self._rates:
            finished = await self._panel.in_thread(rates.fill, STEP_S)
            with self._panel.state:
                self.show()


def _bytes(values: NDArray[np.float64]) -> bytes:
    return values.astype(np.float32).tobytes()
