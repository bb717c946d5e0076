"""Functions that the page calls: what buttons, keys, fields and the mouse do."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING

from amiwarp.viewer.choices import Axis, View
from amiwarp.viewer.layout import KEYS, NAMES
from amiwarp.viewer.message_filter import finite

if TYPE_CHECKING:
    from amiwarp.viewer.panel import Panel

EDITABLE = ("start_ms", "length_ms", "turns", "noise_ms")
"""State variables with a number field, next to the prism's parameters."""


class PageCalls:
    """Functions that one page calls. The server checks their arguments by their annotations."""

    def __init__(self, panel: Panel) -> None:
        self._panel, self._state = panel, panel.state

    @property
    def offered(self) -> dict[str, Callable[..., None]]:
        """Functions that the page may call, by name."""
        comparison, history = self._panel.comparison, self._panel.history
        own = (
            self.key, self.released, self.choose, self.typed, self.edge, self.draw, self.whole, self.suggest,
            self.look_from, self.step, self.move_window, self.resize_window, self.take_from_curve, self.pick, self.play,
            self.calibrate, self.accept, self.discard, self.take_truth, self.zoom_timeline, self.undo, self.redo,
            self.reset, self.keep_b, self.export, self.open_file,
        )  # fmt: skip
        return {call.__name__: call for call in (*own, comparison.swap_b, comparison.compare_found, history.restore)}

    def key(self, key: str) -> None:
        """Run the action of a key that was pressed outside of a text field."""
        for known, (name, *given), _ in KEYS:
            if key == known:
                getattr(self, name)(*given)

    def released(self) -> None:
        """Update the slow parts of the page after a slider or the timeline was released."""
        self._panel.slider_released()

    def choose(self, name: str) -> None:
        """Select the parameter over which the sharpness curve is drawn."""
        if name in NAMES and name != self._state.knob:
            self._state.knob = name
            self._panel.request_slow("curve")

    def typed(self, name: str, text: str) -> None:
        """Set the value that a user typed into a number field."""
        if name not in (*NAMES, *EDITABLE):
            return
        try:
            value = finite(text)
        except ValueError:
            self._panel.show_message(f"{text!r} is not a number; give a number such as 1.5", "error")
            return
        if name == "turns":
            name, value = "length_ms", value * float(self._state.turn_ms)
        self._state[name] = round(value, 4)
        if name in NAMES:
            self._state.knob = name
            self._panel.request("knobs")
        else:
            self._panel.request("window")
        self._panel.slider_released()

    def edge(self, side: int, text: str) -> None:
        """Set one side of the region (0: left, 1: top, 2: right, 3: bottom) to a typed number [px]."""
        with contextlib.suppress(ValueError):
            wanted = [*self._state.region]
            if side in (0, 1, 2, 3):
                wanted[int(side)] = round(finite(text))
                self.draw(*wanted)

    def draw(self, left: float, top: float, right: float, bottom: float) -> None:
        """Show a region of the image [px] that was drawn or typed."""
        self._panel.show_region([int(each) for each in (left, top, right, bottom)], "drawn")

    def whole(self) -> None:
        """Show the whole image."""
        self._panel.show_region([0, 0, *self._state.size], "whole")

    def suggest(self) -> None:
        """Show the region in which compensation gains most sharpness."""
        self._panel.request("suggestion", "window")
        self._panel.slider_released()

    def toggle(self, name: str) -> None:
        """Invert a state variable that is true or false."""
        self._state[name] = not self._state[name]

    def toggle_axis(self) -> None:
        """Switch the third axis between angle and time."""
        angle, time = Axis.ANGLE.value, Axis.TIME.value
        self._state.axis = time if self._state.axis == angle else angle

    def look_from(self, view: str) -> None:
        """Set the view, and reset a camera that the mouse has moved."""
        if view in list(View):
            self._state.view = [view, self._state.view[1] + 1]

    def step(self, count: int) -> None:
        """Move the time window by one turn, forward (1) or back (-1); without a prism, by the window's length."""
        if count in (-1, 1):
            turn = self._panel.inspector.turn_us * 1e-3 if self._panel.compensates else float(self._state.length_ms)
            self._panel.move(float(self._state.start_ms) + count * turn)
            self._panel.slider_released()

    def move_window(self, start_ms: float) -> None:
        """Move the time window to a start [ms]; playing stops, except a live stream's."""
        if not self._state.live:
            self._state.playing = False
        self._panel.move(float(start_ms), change="start_ms")

    def resize_window(self, start_ms: float, end_ms: float) -> None:
        """Set the ends of the time window [ms]."""
        start, end = max(0.0, float(start_ms)), min(float(end_ms), float(self._state.whole_ms))
        if end > start:
            self._state.update({"start_ms": round(start, 3), "length_ms": round(end - start, 3)})
            self._panel.request("window", change="length_ms")

    def take_from_curve(self, value: float) -> None:
        """Set the parameter of the sharpness curve to a clicked value."""
        self._state[self._state.knob] = round(float(value), 4)
        self._panel.request("knobs")
        self._panel.slider_released()

    def pick(self, k: int) -> None:
        """Describe a drawn event; -1 for none."""
        self._panel.updates.pick(int(k))

    def play(self) -> None:
        self._panel.playback.toggle()

    def calibrate(self) -> None:
        self._panel.calibration_job.toggle()

    def accept(self) -> None:
        """Set the prism's parameters to the result of the calibration."""
        if self._panel.calibration_job.found is not None:
            with self._panel.errors_shown("knobs"):
                self._panel.inspector.accept(self._panel.calibration_job.found)
            self.discard()
            self._panel.knobs_taken()

    def discard(self) -> None:
        """Forget the result of the calibration."""
        self._panel.calibration_job.found = None
        self._state.update({"found": "", "surface": None})
        if self._state.against == "found":
            self._panel.comparison.show_b(self._panel.comparison.b)

    def undo(self) -> None:
        self._panel.history.undo()

    def redo(self) -> None:
        self._panel.history.redo()

    def reset(self) -> None:
        self._panel.history.reset()

    def keep_b(self) -> None:
        self._panel.comparison.keep_b()

    def zoom_timeline(self, start_ms: float, end_ms: float) -> None:
        """Show another part of the time on the timeline [ms]."""
        self._panel.rates.zoom(float(start_ms), float(end_ms))

    def export(self, what: str) -> None:
        """Give the browser a file."""
        self._panel.exports.export(what)

    def open_file(self, name: str) -> None:
        """Show another recording of the folder."""
        self._state.open_shown = False
        self._panel.start_job(self._panel.open_file(name))

    def take_truth(self) -> None:
        """Set the parameters to the known truth of a simulated recording."""
        with self._panel.errors_shown("knobs"):
            self._panel.inspector.take_truth()
        self._panel.knobs_taken()
