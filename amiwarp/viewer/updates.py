"""Updates of a page: windows, parameters and looks are computed in threads, and their results sent to the browser."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.plotting.figures import Images
from amiwarp.reconstruction.choices import Tone
from amiwarp.reconstruction.export import tones
from amiwarp.reconstruction.picture import reconstruct
from amiwarp.viewer.choices import Axis, Colour, ImageKind
from amiwarp.viewer.drawing import (
    NO_ORBIT,
    cloud_state,
    event_text,
    gradient,
    jpeg,
    orbit_state,
    whole_image,
)  # fmt: skip
from amiwarp.viewer.layout import UNITS
from amiwarp.viewer.page_values import AGAINST, GREYS, events_text, sharpness_text, truths

if TYPE_CHECKING:
    from amiwarp.viewer.panel import Panel
    from amiwarp.viewer.parameters import Knobs
    from amiwarp.viewer.window import DisplayedWindow

DIFFERENCES = np.array([[0, 114, 178], [255, 255, 255], [213, 94, 0]], np.uint8)
"""Colours of fewer, equally many and more events in an image of differences."""


class Updates:
    """Makes the updates of one page."""

    def __init__(self, panel: Panel) -> None:
        self._panel, self._state = panel, panel.state
        self.shown: DisplayedWindow | None = None
        """Window as the page shows it; None before the first update."""
        self.b: Knobs | None = None
        """Parameters that were kept to compare with."""
        self._picked = -1

    def first(self) -> None:
        """Forget what another recording has left, and show what there is before the first update."""
        self.shown, self.b, self._picked = None, None, -1
        nothing = np.zeros((0, 2), np.float32).tobytes()
        names = ("cloud_before", "cloud_after", "cloud_third", "colours_before", "colours_after")
        self._state.update({**dict.fromkeys(names, nothing), "region": [0, 0, *self._state.size], "titles": [],
                            "legend": {"title": "", "rows": [], "bar": "", "low": "", "high": ""},
                            "third_axis": {"low": 0.0, "high": 1.0, "title": ""}})  # fmt: skip
        self._show_prism()

    async def make(self, todo: set[str]) -> None:
        """Make quick updates: "suggestion", "window", "knobs" and "look"."""
        panel, state = self._panel, self._state
        if todo & {"window", "suggestion"}:
            with panel.errors_shown("window"):
                await self._open(suggest="suggestion" in todo)
        with panel.errors_shown("knobs"):
            if "knobs" in todo:
                panel.set_knobs()
            shown, values = await panel.in_thread(self._compute)
            self.shown = shown
            state.update(values)
            state.curve_mark = float(state[state.knob])
            self._show_prism()
            panel.show_knobs()

    async def make_slow(self, name: str) -> None:
        """Make a slow update: "curve" or "picture"."""
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
            region = (await panel.in_thread(panel.inspector.suggest_region)).region
            s.update({"region_wanted": list(region), "region_kind": "suggested"})
            await panel.in_thread(panel.inspector.open, start_us, length_us, panel.selection())
        self._picked = -1

    def _compute(self) -> tuple[DisplayedWindow, dict[str, Any]]:
        """Return what is to be shown, and the state variables that show it."""
        panel, s, inspector = self._panel, self._state, self._panel.inspector
        new = self.shown is None
        shown = inspector.show(against=self._against())
        values = cloud_state(shown, Colour(s.colour), Axis(s.axis), dark=bool(s.dark), zero_us=panel.zero_us)
        values |= self._images(shown) | self._orbit(shown)
        if new or shown.span is not self.shown.span:  # type: ignore[union-attr]
            values["overview"] = whole_image(shown.span.events, inspector.recording.events.size)
        compensated = panel.compensates
        left = "as recorded" if s.against == "recorded" else AGAINST[s.against]
        pair = [[0, left], [1, "compensated"]]
        text = "" if self._picked < 0 else event_text(shown, self._picked, panel.zero_us)
        return shown, {
            **values, "titles": pair if compensated else [[0, "events as recorded"]], "events": events_text(shown),
            "sharpness": sharpness_text(shown, compensated=compensated), "picked": self._picked, "picked_text": text,
            "against_title": f"region, {left}", "against_choices": [
                [name, words] for name, words in AGAINST.items() if self._has(name)],
        }  # fmt: skip

    def _has(self, name: str) -> bool:
        """Return whether the parameters exist that the left cloud can show."""
        panel = self._panel
        return {"recorded": True, "B": self.b is not None, "found": panel.calibration_job.found is not None,
                "truth": panel.inspector.truth is not None}[name]  # fmt: skip

    def _against(self) -> Knobs | None:
        """Return the parameters that the left cloud shows; None for the recorded events."""
        panel, name = self._panel, self._state.against
        if name == "recorded" or not self._has(name):
            return None
        found = panel.calibration_job.found
        knobs = {"B": self.b, "found": None if found is None else panel.inspector.knobs_of(found),
                 "truth": panel.inspector.truth}  # fmt: skip
        return knobs[name]

    def _images(self, shown: DisplayedWindow) -> dict[str, Any]:
        """Return the state variables of the images of the region."""
        kind, (left, top, right, bottom) = ImageKind(self._state.kind), shown.region
        images = Images(*(i[top:bottom, left:right] for i in (shown.image_before, shown.image_after)))
        scale = f"{images.top:.3g} events per pixel"
        values: dict[str, Any] = {"before": _grey(images.before, images.top), "image_top": scale, "kind_note": "",
                                  "image_slow": kind is ImageKind.LOG_INTENSITY, "kind_title": kind.value}  # fmt: skip
        if kind is ImageKind.COMPENSATED:
            values |= {"after": _grey(images.after, images.top), "kind_bar": GREYS, "kind_low": "0", "kind_high": scale}
        elif kind is ImageKind.DIFFERENCE:
            most = max(float(np.abs(images.after - images.before).max()), 1.0)
            share = (images.after - images.before) / (2.0 * most) + 0.5
            values |= {"after": jpeg(_mixed(share)), "kind_bar": gradient(DIFFERENCES), "kind_low": f"−{most:.3g}",
                       "kind_high": f"+{most:.3g} events per pixel"}  # fmt: skip
        return values

    def _orbit(self, shown: DisplayedWindow) -> dict[str, Any]:
        """Return the orbit of the scene point of the picked event, or of the middle of the region."""
        s, inspector = self._state, self._panel.inspector
        if not (s.orbit_shown and s.axis == Axis.ANGLE.value and self._panel.compensates):
            return NO_ORBIT
        left, top, right, bottom = shown.region
        middle = np.array([left + right, top + bottom]) / 2.0
        point = middle if self._picked < 0 else shown.after[self._picked]
        theta, xy = inspector.orbit(float(point[0]), float(point[1]))
        return orbit_state(theta, xy, point)

    def _show_prism(self) -> None:
        """Show what depends on the rotation of the prism."""
        turn, compensates = self._panel.inspector.turn_us, self._panel.compensates
        self._state.update({"turn_ms": turn * 1e-3 if compensates else 0.0, "has_model": compensates,
                            "step_name": "turn" if compensates else "window"})  # fmt: skip

    async def _curve(self) -> None:
        panel, s, name = self._panel, self._state, self._state.knob
        if not panel.compensates:
            return
        values, scores = await panel.in_thread(panel.inspector.curve, name)
        label, title = panel.knob_title()
        x = (values / UNITS[name]).tolist()
        if not x:
            return
        best = x[int(np.argmax(scores))]
        s.curve = {"name": label, "title": title, "text": f"highest at {best:.4g}; now {s[name]:.4g}", "x": x,
                   "y": scores.tolist(), "truth": truths(panel.inspector)[name]}  # fmt: skip
        s.curve_mark = float(s[name])

    async def _picture(self) -> None:
        panel, s, shown = self._panel, self._state, self.shown
        if s.kind != ImageKind.LOG_INTENSITY.value or shown is None:
            return
        inspector = panel.inspector
        try:
            if not math.isfinite(inspector.turn_us):
                raise AmiwarpError("the log intensity needs a prism that rotates: set its speed or calibrate")
            picture = await panel.in_thread(
                reconstruct, inspector.recording, model=inspector.model, encoder=inspector.adjusted_encoder,
                start_us=shown.span.start_us, length_us=shown.span.length_us, device=inspector.device,
            )  # fmt: skip
        except AmiwarpError as error:
            s.update({"after": "", "kind_note": str(error)})
            return
        left, top, right, bottom = shown.region
        image = jpeg(tones(picture, Tone.MAPPED)[top:bottom, left:right])
        s.update({"after": image, "kind_bar": GREYS, "kind_low": "dark",
                  "kind_high": f"bright; residual {picture.residual:.2f} thresholds"})  # fmt: skip


def _grey(image: Any, top: float) -> str:
    """Return the address of an image of events; brightness is the square root of the count."""
    return jpeg(np.sqrt(np.clip(image / top, 0.0, 1.0)))


def _mixed(share: Any) -> Any:
    """Return the colours (0 to 1) of differences from 0 to 1, shape ``(height, width, 3)``."""
    ends = np.linspace(0.0, 1.0, len(DIFFERENCES))
    return np.stack([np.interp(share, ends, DIFFERENCES[:, k] / 255.0) for k in range(3)], axis=-1)
