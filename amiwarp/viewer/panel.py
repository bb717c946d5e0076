"""Page of the inspector: passes input from the browser to the inspector, and the inspector's results to the browser."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.choices import Axis, Colour, View
from amiwarp.errors import AmiwarpError
from amiwarp.optics.models import MODELS
from amiwarp.viewer.clouds import (
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
from amiwarp.viewer.exports import Exports, export_state
from amiwarp.viewer.images import ImageKind, ShownImages, count_images, make_images, prepare
from amiwarp.viewer.inspector import NO_ENCODER
from amiwarp.viewer.jobs import CalibrationJob, LiveSource, Playback, estimate_phase, scope_text
from amiwarp.viewer.layout import KEYS, NAMES, SCOPES, SLIDERS, SPEEDS, TOOLS, UNITS, VIEWS, template
from amiwarp.viewer.serve import Check, finite, flag, number, one_of, use_page
from amiwarp.viewer.timeline import EventRates
from amiwarp.viewer.view_state import History, ViewState, apply_state, current_state, decode_state, encode_state
from amiwarp.viewer.window import Selection, Source, colours_on_offer, truth_text

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.viewer.inspector import Inspector, Library
    from amiwarp.viewer.window import DisplayedWindow, Knobs


# Limit of the updates of one page to the rate at which the page takes them.

MOST_IN_FLIGHT = 8
"""Largest number of messages to the page that are unsent; while more are waiting, nothing is computed."""
WAIT_S = 0.02
"""Interval between two checks of the number of unsent messages [s]."""


async def wait_until_page_keeps_up(server: Any) -> None:
    """Wait until at most :data:`MOST_IN_FLIGHT` messages to the page are unsent."""
    while _in_flight(server) > MOST_IN_FLIGHT:
        await asyncio.sleep(WAIT_S)


def _in_flight(server: Any) -> int:
    return 0 if server.protocol is None else int(server.protocol.network_monitor.pending)


# Parameters that the left cloud and image of a page can show: those kept as B, calibrated ones and the known truth.

AGAINST = {
    "recorded": "as recorded", "B": "compensated with B", "found": "compensated with the result",
    "truth": "compensated with the known truth",
}  # fmt: skip
"""What the left cloud and image can show: name, and title."""


RECORDED = "events as recorded"
"""Title of the only cloud, if there is no motion to compensate."""


class Comparison:
    """Comparison of the current parameters of a page (A) with others."""

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self.b: Knobs | None = None
        """Parameters that were kept as B."""

    @property
    def choices(self) -> list[list[str]]:
        """Names and titles of what the left cloud can show now."""
        return [[name, title] for name, title in AGAINST.items() if name == "recorded" or self._knobs(name) is not None]

    @property
    def knobs(self) -> Knobs | None:
        """Parameters that the left cloud shows; None for the recorded events."""
        return self._knobs(self._panel.state.against)

    @property
    def title(self) -> str:
        """Title of the left cloud."""
        return AGAINST["recorded" if self.knobs is None else self._panel.state.against]

    def keep_b(self) -> None:
        """Keep the current parameters as B, and show them on the left."""
        self.show_b(self._panel.inspector.knobs)

    def swap_b(self) -> None:
        """Exchange the current parameters and B."""
        panel = self._panel
        if self.b is not None:
            now, knobs = panel.inspector.knobs, self.b
            with panel.errors_shown("knobs"):
                panel.inspector.set(knobs)
                self.show_b(now)
            panel.knobs_taken()

    def compare_found(self) -> None:
        """Show the result of the calibration on the left."""
        if self._panel.calibration_job.found is not None:
            self._panel.state.against = "found"
            self._panel.request("knobs")

    def show_b(self, knobs: Knobs | None) -> None:
        """Show parameters on the left as B; None for the recorded events."""
        self.b = knobs
        text = "" if knobs is None else (
            f"{knobs.model}, apex {math.degrees(knobs.apex):.4g}°, phase {math.degrees(knobs.phase):.4g}°"
        )  # fmt: skip
        against = "recorded" if knobs is None else "B"
        self._panel.state.update({"has_b": knobs is not None, "b_text": text, "against": against})
        self._panel.request("knobs")

    def _knobs(self, name: str) -> Knobs | None:
        inspector, found = self._panel.inspector, self._panel.calibration_job.found
        if name == "found":
            return None if found is None else inspector.knobs_of(found)
        return {"B": self.b, "truth": inspector.truth}.get(name)


# Values of the page's state: what the page may set, its state at the start, and texts.

SETTABLE: dict[str, Check] = {
    **dict.fromkeys(NAMES, number()), "point_size": number(1.0, 20.0), "opacity": number(0.0, 1.0),
    "speed": one_of(*SPEEDS), "polarity": one_of("both", "ON", "OFF"), "model": one_of(*MODELS),
    "colour": one_of(*(each.value for each in Colour)), "axis": one_of(*(each.value for each in Axis)),
    "kind": one_of(*(each.value for each in ImageKind)), "against": one_of(*AGAINST), "scope": one_of(*SCOPES),
    "message": one_of(""),
    **dict.fromkeys(("hide_hot", "noise_filter", "dark", "overlaid", "orbit_shown", "help_shown", "open_shown", "loop",
                     "difference"),
                    flag),
}  # fmt: skip
"""State variables that the page may set directly, with the check of their values. The page changes all others through
calls."""
CLIENT_ONLY = ("hover", "hover_region", "measured", "tool")
"""State variables that the browser keeps to itself."""
NO_SCALE = {"bar": "", "ticks": [], "title": ""}
"""Scale of an image before the first update."""


def initial_state(inspector: Inspector) -> dict[str, Any]:
    """Return the page's state at the start, without the events' window and the prism's parameters."""
    recording = inspector.recording
    return {
        **source_state(inspector), **NO_ORBIT, "trame__title": f"amiwarp: {recording.name}",
        "trame_error_report_msg": "", "name": recording.name,
        "size": list(recording.events.size), "live": inspector.latest is not None, "live_rows": [], "stream_note": "",
        "notes": notes(inspector), "has_encoder": inspector.has_encoder, "models": list(MODELS),
        "apex_most": max(3.0, round(2.0 * math.degrees(inspector.prism.apex), 1)), "truths": truths(inspector),
        "has_truth": inspector.truth is not None, "truth": truth_text(recording.truth), **export_state(),
        "open_shown": False, "playing": False, "speed": 0.1, "speeds": list(SPEEDS), "loop": False, "polarity": "both",
        "hide_hot": False, "noise_filter": False, "noise_ms": 2.0, "region_kind": "whole",
        "colour": Colour.POLARITY.value, "colours": [each.value for each in colours_on_offer(recording.truth)],
        "axis": (Axis.ANGLE if math.isfinite(inspector.turn_us) else Axis.TIME).value, "axes": [a.value for a in Axis],
        "point_size": 2, "opacity": 1.0, "dark": False, "overlaid": False, "view": [View.FREE.value, 0],
        "views": [list(each) for each in VIEWS], "tool": "region", "tools": [list(each) for each in TOOLS],
        "hover": "", "hover_region": "", "measured": "", "orbit_shown": True, "help_shown": False,
        "keys": [[key, words] for key, _, words in KEYS], "address": "", "can_undo": False, "can_redo": False,
        "events": "", "sharpness": "", "updating": [], "severity": "info", "message": "", "picked": -1,
        "rate_on": b"", "rate_off": b"", "rate_note": "",
        "picked_text": "",
        "overview": "", "before": "", "after": "", "kind": ImageKind.COUNT.value,
        "kinds": [each.value for each in ImageKind], "image_note": "", "image_slow": False, "image_scale": NO_SCALE,
        "after_scale": NO_SCALE, "difference": False, "against_title": "",
        "against_choices": [], "curve": {"name": "", "title": "", "text": "", "x": [], "y": [], "truth": None},
        "curve_mark": 0.0, "against": "recorded", "has_b": False, "b_text": "", "busy": "", "calibrating": False,
        "progress": 0, "found": "", "surface": None, "scope": SCOPES[0], "scopes": list(SCOPES), "calibrate_on": "",
    }  # fmt: skip


def source_state(inspector: Inspector) -> dict[str, Any]:
    """Return the state variables that depend on the events; they change in a live stream."""
    source = inspector.recording.events
    whole_ms = (source.t_last - source.t_first + 1) * 1e-3
    return {"whole_ms": whole_ms, "rate_span": [0.0, whole_ms]}


def truths(inspector: Inspector) -> dict[str, float | None]:
    """Return the known true parameters in the page's units; None for an unknown one."""
    known = inspector.truth
    return {n: None if known is None else round(getattr(known, n) / scale, 4) for n, scale in UNITS.items()}


def sharpness_text(shown: DisplayedWindow, *, compensated: bool) -> str:
    """Return the sharpness of the images as text, with the gain if there are two images."""
    before, after = shown.sharpness_before, shown.sharpness_after
    if not compensated:
        return f"{before:.3f}"
    gain = f" (×{after / before:.2f})" if before > 1e-3 and after > 0.0 else ""
    return f"{before:.3f} → {after:.3f}{gain}"


def events_text(shown: DisplayedWindow) -> str:
    """Return the numbers of events of the window, of those that were read, in the selection and drawn."""
    total, read, drawn = shown.span.count, len(shown.span.events), len(shown.events)
    thinned = "" if read == total else f", {read:,} of them read"
    selected = "" if shown.selected == read else f", {shown.selected:,} selected"
    return f"{total:,} events{thinned}{selected}, {'all' if drawn == shown.selected else f'{drawn:,}'} drawn"


def notes(inspector: Inspector) -> list[str]:
    """Return what the recording lacks or what is only assumed, for the place where it matters."""
    texts = {
        Source.ASSUMED: "phase assumed, not known: calibrate, or set it",
        Source.ESTIMATED: "phase estimated from the events: calibrate for an accurate one",
    }
    phase = texts.get(inspector.sources["phase"], "") if math.isfinite(inspector.turn_us) else ""
    missing = [note for note in inspector.notes if not (note == NO_ENCODER and inspector.knobs.rpm)]
    return [*missing, *filter(None, [phase])]


# History of a page: undo, redo, reset, and the state in the page's address.


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


# Event rates on a page's timeline: counted in the background, and shown for the part of the time that is visible.

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


# Updates of a page: windows, parameters and looks are computed in threads, and their results sent to the browser.


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


# Functions that the page calls: what buttons, keys, fields and the mouse do.

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


# Page of the inspector: passes input from the browser to the inspector, and the inspector's results to the browser.
#
# Each browser tab has one panel with its own inspector and state. Slow work runs in threads. If a slider moves several
# times meanwhile, only its last position is used. What waits for an update is marked on the page.

_CUDA_LOCK = asyncio.Lock()
"""Lock for all tabs: Warp's CUDA calls may run in only one thread at a time."""
QUICK = {**dict.fromkeys(("window", "suggestion", "state", "knobs"), ("clouds", "images")), "look": ("clouds",)}
SLOW = ("curve", "picture")
"""Updates that are made at once, with the parts of the page that wait for them, and updates that take longer."""


class Panel:
    """Panel that connects the page of one browser tab with its inspector. Call :meth:`close` when the tab is closed."""

    def __init__(self, server: Any, inspector: Inspector, library: Library | None = None) -> None:
        """Build the page on a new trame server. ``library``: other recordings that the page may open."""
        self.server, self.state, self.inspector, self.library = server, server.state, inspector, library
        self.buffers_lock = asyncio.Lock()
        """Lock of the inspector's buffers on the device, which only one thread may use at a time."""
        self.device_lock: Any = _CUDA_LOCK if "cuda" in str(inspector.device) else contextlib.nullcontext()
        self.calibration_job, self.playback, self.updates = CalibrationJob(self), Playback(self), Updates(self)
        self.calls = PageCalls(self)
        self.comparison, self.history, self.rates = Comparison(self), PageHistory(self), RateView(self)
        self.exports = Exports(self)
        self.change = ""
        """What the user changes; successive changes of one name are undone together."""
        self._drags = 0
        self._quick_requests: set[str] = set()
        self._slow_requests: set[str] = set()
        self._doing: set[str] = set()
        self._quick: asyncio.Task[None] | None = None
        self._slow: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._error_source = ""
        self._threads = ThreadPoolExecutor(3, "amiwarp-tab")  # calibration or film; curve or picture; quick updates
        use_page(server, template())
        self.state.client_only(*CLIENT_ONLY)
        self._listen()
        self.start(inspector)

    def start(self, inspector: Inspector) -> None:
        """Show an inspector from its first state."""
        self.inspector, state = inspector, self.state
        inspector.renew()  # a live stream may have gone on since the inspector was made
        files = [] if self.library is None else self.library.files()
        folder = "" if self.library is None else str(self.library.folder)
        state.update({**initial_state(inspector), "files": files, "folder": folder})
        start, length = inspector.window or inspector.first_window()
        state.update({"start_ms": round((start - self.zero_us) * 1e-3, 3), "length_ms": round(length * 1e-3, 3),
                      "region_wanted": [0, 0, *inspector.recording.events.size], "knob": "apex"})  # fmt: skip
        self.show_knobs()
        self.updates.first()
        self.history.forget()
        self.comparison.b = None
        self.rates.start()
        self.request("window", *(["suggestion"] if self.compensates else []))
        self.slider_released()
        self.request_slow("preparation")
        if inspector.latest is not None:
            self.playback.toggle()
        if isinstance(inspector.latest, LiveSource):
            self.start_job(self.playback.watch(inspector.latest))

    async def open_file(self, name: str) -> None:
        """Show another recording of the library."""
        if self.library is None:
            return
        self.calibration_job.cancel()
        self.state.playing = False
        with self.errors_shown("file"):
            inspector = await self.in_thread(self.library.open, name)
            await self.wait_until_drawn()
            self.start(inspector)
        self.state.flush()

    def close(self) -> None:
        """Stop all work of the browser tab. A thread ends when its current work is done."""
        self.calibration_job.cancel()
        self.playback.end()
        self.exports.end()
        for task in [*self._tasks, *filter(None, [self._quick, self._slow])]:
            task.cancel()
        self._threads.shutdown(wait=False, cancel_futures=True)

    @property
    def zero_us(self) -> int:
        """Time of the recording's first event, from which the page counts all times [us]."""
        return int(self.inspector.recording.events.t_first)

    @property
    def compensates(self) -> bool:
        """Whether the prism rotates, so that there is a motion to compensate."""
        return math.isfinite(self.inspector.turn_us)

    def knobs_taken(self) -> None:
        """Show parameters that the inspector has taken from elsewhere."""
        self.show_knobs()
        self.request("knobs")
        self.slider_released()

    def slider_released(self) -> None:
        """Update the slow parts of the page after a change, and end what is undone in one step."""
        self._drags += 1
        self.request_slow(*SLOW)

    def show_region(self, region: list[int], kind: str) -> None:
        """Show a region of the image [px]. ``kind`` is "drawn", "whole" or "suggested"."""
        width, height = self.state.size
        left, right = (min(max(x, 0), width) for x in region[::2])
        top, bottom = (min(max(y, 0), height) for y in region[1::2])
        self.state.update({"region_wanted": [left, top, right, bottom], "region_kind": kind})
        self.request("window")
        self.slider_released()

    def request(self, *what: str, change: str = "") -> None:
        """Request quick updates of the page: "window", "knobs", "look", "suggestion" or "state".

        ``change``: name of a change that lasts, such as a drag; it is undone in one step.
        """
        self.change = f"{change} {self._drags}" if change else ""
        self._quick_requests.update(what)
        self._show_pending()
        if self._quick is None:
            self._quick = self._task(self._work())

    def request_slow(self, *what: str) -> None:
        """Request updates that run in a thread after all quick updates: "curve", "picture" or "preparation"."""
        self._slow_requests.update(what)
        self._show_pending()
        if self._slow is None:
            self._slow = self._task(self._work_slowly())

    async def wait_until_drawn(self) -> None:
        """Wait until no quick update is pending."""
        while self._quick is not None:
            await asyncio.sleep(0.005)

    def start_job(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a job until it ends or the browser tab is closed."""
        self._tasks.add(task := self._task(work))
        task.add_done_callback(self._tasks.discard)

    async def in_thread(self, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Call ``work`` in one of the browser tab's threads, and return its result."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, partial(work, *args, **options))

    def show_message(self, text: str, severity: str) -> None:
        with self.state:
            self.state.update({"message": text, "severity": severity})

    @contextlib.contextmanager
    def errors_shown(self, what: str) -> Iterator[None]:
        """Show errors of the enclosed code as a message, until the same kind of action (``what``) succeeds."""
        try:
            yield
        except (AmiwarpError, OSError) as error:
            self._error_source = what
            self.state.update({"message": str(error), "severity": "error"})
        else:
            if self.state.severity == "error" and self._error_source == what:
                self.state.update({"message": "", "severity": "info"})

    def move(self, start_ms: float, change: str = "") -> bool:
        """Move the time window to a start [ms], limited to the recording. Return whether the window is at the end."""
        last = max(0.0, float(self.state.whole_ms) - float(self.state.length_ms))
        self.state.start_ms = round(min(max(start_ms, 0.0), last), 3)
        self.request("window", change=change)
        return start_ms >= last

    def renew(self) -> None:
        """Take the current events of a live stream, and move the window to their end."""
        with self.errors_shown("stream"):
            self.inspector.renew()
        self.state.update(source_state(self.inspector))
        self.rates.start()
        self.move(float(self.state.whole_ms))

    def download(self, name: str, content: bytes, kind: str) -> None:
        """Give the browser a file to save; ``kind`` is its media type."""
        self.server.js_call("page", "download", name, content, kind)

    def selection(self) -> Selection:
        """Return the conditions for events that the page shows."""
        s = self.state
        region, whole = tuple(s.region_wanted), (0, 0, *s.size)
        noise_us = round(1e3 * float(s.noise_ms)) if s.noise_filter else None
        return Selection({"both": None, "ON": 1, "OFF": 0}[s.polarity], None if region == whole else region,
                         bool(s.hide_hot), noise_us)  # fmt: skip

    def show_knobs(self) -> None:
        """Show the inspector's parameters on the page."""
        inspector = self.inspector
        sources = {name: str(source.value) for name, source in inspector.sources.items()}
        self.state.update(
            {**self._knobs(), "model": inspector.knobs.model, "sources": sources, "notes": notes(inspector)}
        )

    # internal

    def _listen(self) -> None:
        """Follow the state variables that the page sets, and offer the functions that it calls."""
        for name in NAMES:
            self.state.change(name)(_without_state(self._dragged, name))
        for what, names in {
            "window": ("polarity", "hide_hot", "noise_filter"), "look": ("colour", "axis", "dark", "orbit_shown"),
            "knobs": ("model", "against", "kind", "difference"),
        }.items():  # fmt: skip
            self.state.change(*names)(_without_state(self.request, what))
        self.state.change("model", "kind", "polarity", "hide_hot", "noise_filter")(_without_state(self.slider_released))
        for name, call in self.calls.offered.items():
            self.server.trigger(name)(call)

    def _dragged(self, name: str) -> None:
        """Follow a slider. Values that the server itself has set are ignored."""
        if self.state[name] != self._knobs()[name]:
            self.state.knob = name
            self.request("knobs", change=name)

    def _knobs(self) -> dict[str, float]:
        """Return the prism's parameters in the page's units, rounded as the page shows them."""
        return {name: round(getattr(self.inspector.knobs, name) / scale, 4) for name, scale in UNITS.items()}

    def _show_pending(self) -> None:
        """Show which parts of the page wait for an update."""
        quick = self._quick_requests | self._doing
        parts = {part for what in quick for part in QUICK.get(what, ())} | (self._slow_requests | self._doing) & {*SLOW}
        self.state.updating = sorted(parts)

    def _task(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        task.add_done_callback(self._ended)
        return task

    def _ended(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            logging.getLogger(__name__).error("the page's work failed", exc_info=error)
            text = f"internal error: {error or type(error).__name__}; the log of the server shows the details"
            self.show_message(text, "error")

    async def _work(self) -> None:
        try:
            while self._quick_requests:
                await wait_until_page_keeps_up(self.server)
                todo, self._quick_requests = self._quick_requests, set()
                async with self._done(todo), self.device_lock, self.buffers_lock:
                    await self.updates.make(todo)
                await asyncio.sleep(0)
        finally:
            self._quick = None

    async def _work_slowly(self) -> None:
        try:
            while self._slow_requests:
                await self.wait_until_drawn()
                name = min(self._slow_requests)  # in alphabetical order: the curve first, the preparation last
                self._slow_requests.discard(name)
                async with self._done({name}), self.device_lock:
                    with self.errors_shown(name):
                        await self.updates.make_slow(name)
        finally:
            self._slow = None

    @contextlib.asynccontextmanager
    async def _done(self, todo: set[str]) -> Any:
        """Mark updates as being made, and send the state to the browser when they are made."""
        self._doing |= todo
        try:
            yield
        finally:
            self._doing -= todo
            with self.state:
                self._show_pending()

    def set_knobs(self) -> None:
        """Give the inspector the parameters that the page shows, where they differ from the inspector's."""
        rounded = self._knobs()
        values = {name: float(self.state[name]) * UNITS[name] for name in NAMES
                  if self.state[name] != rounded[name]}  # fmt: skip
        self.inspector.set(replace(self.inspector.knobs, model=self.state.model, **values))

    def knob_title(self) -> tuple[str, str]:
        """Return the name of the sharpness curve's parameter, and its name with the unit."""
        label, unit, *_ = SLIDERS[self.state.knob]
        return label, f"{label} ({unit})"


def _without_state(call: Callable[..., None], *args: str) -> Callable[..., None]:
    """Return a function that ignores the page's state, which trame passes to it, and calls ``call``."""
    return lambda **_: call(*args)
