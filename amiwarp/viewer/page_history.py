"""History of a page: undo, redo, reset, and the state in the page's address."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from amiwarp.viewer.choices import Axis, Colour, View
from amiwarp.viewer.image_kinds import ImageKind
from amiwarp.viewer.view_state import History, ViewState, apply_state, current_state, decode_state, encode_state

if TYPE_CHECKING:
    from amiwarp.viewer.panel import Panel


class PageHistory:
    """States that a page has shown."""

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self._history: History | None = None
        self._default: ViewState | None = None
        self._wanted: ViewState | str | None = None

    def forget(self) -> None:
        """Forget all states, because the page shows another recording."""
        self._history = self._default = self._wanted = None

    def remember(self, change: str) -> None:
        """Add what the page shows now to the history. Equal ``change`` of successive states make one step."""
        state = self._current()
        if self._history is None:
            self._history, self._default = History(state), state
        self._history.add(state, change)
        self._show()

    def undo(self) -> None:
        """Go back by one step."""
        if self._history is not None:
            self._want(self._history.undo())

    def redo(self) -> None:
        """Go forward by one step that was undone."""
        if self._history is not None:
            self._want(self._history.redo())

    def reset(self) -> None:
        """Show the first state again."""
        if self._history is not None and self._default is not None:
            self._history.add(self._default)
            self._want(self._default)

    def restore(self, address: str) -> None:
        """Show the state that an address describes."""
        self._want(address)

    async def apply(self) -> None:
        """Show the requested state. Raises :class:`AmiwarpError` if it selects no events."""
        panel, wanted = self._panel, self._wanted
        self._wanted = None
        if wanted is None or self._default is None:
            return
        source = panel.inspector.recording.events
        if isinstance(wanted, str):
            duration_us = source.t_last - source.t_first + 1
            wanted, wrong = decode_state(wanted, self._default, size=source.size, duration_us=duration_us)
            if wrong:
                panel.show_message("; ".join(wrong), "error")
        await panel.in_thread(apply_state, panel.inspector, wanted)
        self._take(wanted)

    def _want(self, state: ViewState | str) -> None:
        self._wanted = state
        self._panel.request("state")
        self._panel.slider_released()

    def _current(self) -> ViewState:
        """Return the state that the page shows."""
        s, panel = self._panel.state, self._panel
        return replace(
            current_state(panel.inspector), against=panel.comparison.knobs, image=ImageKind(s.kind), axis=Axis(s.axis),
            colour=Colour(s.colour), view=View(s.view[0]), overlaid=bool(s.overlaid),
        )  # fmt: skip

    def _take(self, state: ViewState) -> None:
        """Set the page's state variables to a state."""
        s, selection = self._panel.state, state.selection
        width, height = s.size
        region = selection.region or (0, 0, width, height)
        kind = s.region_kind if list(region) == s.region_wanted else "whole" if selection.region is None else "drawn"
        s.update({
            "start_ms": round(state.start_us * 1e-3, 3), "length_ms": round(state.length_us * 1e-3, 3),
            "polarity": {None: "both", 1: "ON", 0: "OFF"}[selection.polarity], "hide_hot": selection.hide_hot,
            "noise_filter": selection.noise_us is not None, "region_wanted": list(region), "region_kind": kind,
            "kind": state.image.value, "colour": state.colour.value, "axis": state.axis.value,
            "view": [state.view.value, s.view[1] + int(state.view.value != s.view[0])], "overlaid": state.overlaid,
        })  # fmt: skip
        if selection.noise_us is not None:
            s.noise_ms = selection.noise_us * 1e-3
        if state.against != self._panel.comparison.knobs:
            self._panel.comparison.show_b(state.against)
        self._panel.show_knobs()

    def _show(self) -> None:
        assert self._history is not None
        assert self._default is not None
        history = self._history
        address = encode_state(history.state, self._default)
        self._panel.state.update({"can_undo": history.can_undo, "can_redo": history.can_redo, "address": address})
