"""Updates of a page: windows, parameters and looks are computed in threads, and their results sent to the browser."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.viewer.choices import Axis, Colour
from amiwarp.viewer.comparison import RECORDED
from amiwarp.viewer.drawing import (
    NO_ORBIT,
    cloud_state,
    difference_state,
    event_text,
    float_bytes,
    jpeg,
    orbit_lines,
    scale_state,
    whole_image,
)
from amiwarp.viewer.image_kinds import ImageKind, ShownImages, count_images, make_images
from amiwarp.viewer.layout import UNITS
from amiwarp.viewer.log_intensity import prepare
from amiwarp.viewer.page_values import events_text, sharpness_text, truths
from amiwarp.viewer.phase_estimate import estimate_phase
from amiwarp.viewer.selected_calibration import scope_text

if TYPE_CHECKING:
    from amiwarp.viewer.panel import Panel
    from amiwarp.viewer.window import DisplayedWindow


class Updates:
    """Makes the updates of one page."""

    def __init__(self, panel: Panel) -> None:
        self._panel, self._state = panel, panel.state
        self.shown: DisplayedWindow | None = None
        """Window as the page shows it; None before the first update."""
        self._picked = -1

    def first(self) -> None:
        """Forget what another recording has left, and show what there is before the first update."""
        self.shown, self._picked = None, -1
        nothing = np.zeros((0, 2), np.float32).tobytes()
        names = ("cloud_before", "cloud_after", "cloud_third", "colours_before", "colours_after")
        self._state.update({**dict.fromkeys(names, nothing), "region": [0, 0, *self._state.size], "titles": [],
                            "legend": {"title": "", "rows": [], "bar": "", "low": "", "high": ""},
                            "third_axis": {"low": 0.0, "high": 1.0, "title": ""}})  # fmt: skip
        self._show_prism()

    async def make(self, todo: set[str]) -> None:
        """Make quick updates: "suggestion", "window", "knobs", "look" and "state"."""
        panel, state = self._panel, self._state
        if todo & {"window", "suggestion"}:
            with panel.errors_shown("window"):
                try:
                    await self._open(suggest="suggestion" in todo)
                except AmiwarpError:
                    self._return_to_open_window()
                    raise
        with panel.errors_shown("knobs"):
            if "knobs" in todo:
                panel.set_knobs()
            if self.shown is None:
                panel.history.remember("")
            if "state" in todo:
                await panel.history.apply()
            panel.show_knobs()  # not after the computation: a value that is typed meanwhile would be lost
            shown, values = await panel.in_thread(self._compute)
            self.shown = shown
            state.update(values)
            state.curve_mark = float(state[state.knob])
            self._show_prism()
            if not state.playing:
                panel.history.remember("" if todo & {"suggestion", "state"} else panel.change)

    async def make_slow(self, name: str) -> None:
        """Make a slow update: "curve", "picture", or "preparation" of the first picture."""
        if name == "preparation":
            await self._panel.in_thread(prepare, self._panel.inspector)
        else:
            await (self._curve() if name == "curve" else self._picture())

    def pick(self, k: int) -> None:
        """Describe a drawn event, and show its orbit; -1 for none."""
        known = self.shown is not None and 0 <= k < len(self.shown.events)
        self._picked = k if known else -1
        self._panel.request("look")

    async def _open(self, *, suggest: bool) -> None:
        """Read the window and the selection that the page shows."""
        panel, s = self._panel, self._state
        start, length = float(s.start_ms), min(float(s.length_ms), float(s.whole_ms))
        if not length > 0.0:
            raise AmiwarpError(f"a window of {length:g} ms; give a length above 0")
        start_us, length_us = panel.zero_us + round(start * 1e3), max(1, round(length * 1e3))
        await panel.in_thread(panel.inspector.open, start_us, length_us, panel.selection())
        if suggest:
            if await panel.in_thread(estimate_phase, panel.inspector):
                panel.show_knobs()
            region = (await panel.in_thread(panel.inspector.suggest_region)).region
            s.update({"region_wanted": list(region), "region_kind": "suggested"})
            await panel.in_thread(panel.inspector.open, start_us, length_us, panel.selection())
        self._picked = -1

    def _return_to_open_window(self) -> None:
        """Show time and region of the window that is still shown. Playback goes on through a time without events."""
        inspector, s = self._panel.inspector, self._state
        if inspector.window is not None and not s.playing:
            start_us, length_us = inspector.window
            s.start_ms, s.length_ms = round((start_us - self._panel.zero_us) * 1e-3, 3), round(length_us * 1e-3, 3)
            s.region_wanted = list(inspector.loaded.region)

    def _compute(self) -> tuple[DisplayedWindow, dict[str, Any]]:
        """Return what is to be shown, and the state variables that show it."""
        panel, s, inspector = self._panel, self._state, self._panel.inspector
        new = self.shown is None
        shown = inspector.show(against=panel.comparison.knobs)
        values = cloud_state(shown, Colour(s.colour), Axis(s.axis), dark=bool(s.dark))
        values |= self._images(shown) | self._orbit(shown)
        if new or shown.span is not self.shown.span:  # type: ignore[union-attr]
            values["overview"] = whole_image(shown.span.events, inspector.recording.events.size)
        compensated = panel.compensates
        left = panel.comparison.title
        pair = [[0, left], [1, "compensated" if s.against == "recorded" else "compensated with A"]]
        text = "" if self._picked < 0 else event_text(shown, self._picked)
        return shown, {
            **values, "titles": pair if compensated else [[0, RECORDED]], "events": events_text(shown),
            "sharpness": sharpness_text(shown, compensated=compensated), "picked": self._picked, "picked_text": text,
            "against_title": left, "against_choices": panel.comparison.choices,
        }  # fmt: skip

    def _images(self, shown: DisplayedWindow) -> dict[str, Any]:
        """Return the state variables of the images of the region; of slow kinds, only that they are."""
        s, kind = self._state, ImageKind(self._state.kind)
        if kind is ImageKind.LOG_INTENSITY:
            return {"image_slow": True}
        images = count_images(shown) if kind is ImageKind.COUNT else self._make_images()
        return {"image_slow": False, **self._image_values(images)} | (
            difference_state(images.before, images.after)
            if s.difference and kind is ImageKind.COUNT and images.before is not None
            else {}
        )

    def _make_images(self) -> ShownImages:
        panel = self._panel
        return make_images(panel.inspector, ImageKind(self._state.kind), against=panel.comparison.knobs)

    def _image_values(self, images: ShownImages) -> dict[str, Any]:
        scale = scale_state(images.scale)
        before, after = (
            "" if image is None else jpeg(images.scale.rgb(image)) for image in (images.before, images.after)
        )
        return {"before": before, "after": after, "image_scale": scale, "after_scale": scale, "image_note": images.note}

    def _orbit(self, shown: DisplayedWindow) -> dict[str, Any]:
        """Return the orbit of the scene point of the picked event, or of the middle of the region."""
        s, inspector = self._state, self._panel.inspector
        if not (s.orbit_shown and s.axis == Axis.ANGLE.value and self._panel.compensates):
            return NO_ORBIT
        orbit, column = map(float_bytes, orbit_lines(inspector, shown, self._picked))
        recorded = self._panel.comparison.knobs is None  # otherwise, both clouds are compensated
        return {"orbit": orbit if recorded else column, "column": column, "has_orbit": True}

    def _show_prism(self) -> None:
        """Show what depends on the rotation of the prism."""
        turn, compensates = self._panel.inspector.turn_us, self._panel.compensates
        self._state.update({"turn_ms": turn * 1e-3 if compensates else 0.0, "has_model": compensates,
                            "step_name": "turn" if compensates else "window"})  # fmt: skip

    async def _curve(self) -> None:
        panel, s, name = self._panel, self._state, self._state.knob
        s.calibrate_on = await panel.in_thread(scope_text, panel.inspector)
        if not panel.compensates:
            return
        values, scores = await panel.in_thread(panel.inspector.curve, name)
        label, title = panel.knob_title()
        x = (values / UNITS[name]).tolist()
        if not x:
            return
        best = int(np.argmax(scores))
        peak = f"{'at the edge ' if best in (0, len(x) - 1) else ''}{x[best]:.4g}"
        s.curve = {"name": label, "title": title, "text": f"peak {peak}, now {s[name]:.4g}", "x": x,
                   "y": scores.tolist(), "truth": truths(panel.inspector)[name]}  # fmt: skip
        s.curve_mark = float(s[name])

    async def _picture(self) -> None:
        """Make images of a slow kind."""
        s = self._state
        if s.kind != ImageKind.LOG_INTENSITY.value or self.shown is None:
            return
        try:
            s.update(await self._panel.in_thread(lambda: self._image_values(self._make_images())))
        except AmiwarpError as error:
            s.update({"before": "", "after": "", "image_note": str(error)})
