"""Timeline of the inspector's page: how many events a recording has over time, counted in the background."""

from __future__ import annotations

from typing import Any

from amiwarp.io.event_rates import EventRates
from amiwarp.viewer import captions, layout, page_state
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.page_panel import PagePanel

STEP_S = 0.2
"""Duration of counting events after which the timeline shows what is counted [s]."""


class PageTimeline:
    """Counted events of a panel's recording, and of the recordings on its time axis."""

    def __init__(self, panel: PagePanel) -> None:
        self._panel = panel
        self._rates: list[EventRates] = []
        self._rates_first_us = 0
        """First event of the recording when its events were counted [us]."""

    def forget(self) -> None:
        """Forget what was counted: the panel shows another recording, whose count has not begun."""
        self._rates = []

    async def count_events(self) -> None:
        """Count the recording's events in the background, for the timeline."""
        inspectors = (self._panel.inspector, *self._panel.inspector.besides)
        rates = [EventRates(each.recording.events) for each in inspectors]
        self._rates = rates
        self._rates_first_us = self._panel.inspector.recording.events.t_first
        with self._panel.errors_shown("timeline"):
            for each in rates:
                finished = False
                while not finished and rates is self._rates:
                    finished = await self._panel.work.in_thread(each.fill, STEP_S)
                    await self._show_rates()
        self._panel.state.flush()

    async def show_zoomed(self) -> None:
        """Show what is counted of another part of the time."""
        with self._panel.errors_shown("timeline"):
            await self._show_rates()
        self._panel.state.flush()

    async def _show_rates(self) -> None:
        """Show what is counted of the shown part of the time, unless the page shows another part before it is ready."""
        rates = self._rates
        span = self._panel.state.rate_span
        if not rates:
            return
        values = await self._panel.work.in_thread(
            self._rate_state, self._panel.inspector, rates, span
        )
        if rates is self._rates and span == self._panel.state.rate_span:
            with self._panel.state:
                self._panel.state.update(values)

    def _rate_state(
        self, inspector: Inspector, rates: list[EventRates], span: list[float]
    ) -> dict[str, Any]:
        """Return the state variables of the timeline between two times [ms]. It may read events from a file."""
        # Of a live stream, the counted events may be a second older than the shown ones.
        first_us = self._rates_first_us
        start_us, end_us = (round(1e3 * each) for each in span)
        own, *others = rates
        _, own_rates = own.curve(first_us + start_us, first_us + end_us, layout.RATE_BINS)
        off, on = map(page_state.float_bytes, own_rates)
        rows = []
        for each, counted in zip(inspector.besides, others, strict=True):
            _, rates_beside = counted.curve(
                each.time_of(start_us), each.time_of(end_us), layout.RATE_BINS
            )
            off_beside, on_beside = map(page_state.float_bytes, rates_beside)
            name = captions.beside_text(each)
            rows.append({"name": name, "on": on_beside, "off": off_beside})
        note = "" if own.ended else f"counting events: {100.0 * own.share:.0f} %"
        return {"rate_on": on, "rate_off": off, "rate_note": note, "rate_rows": rows}
