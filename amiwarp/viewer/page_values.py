"""Values of the page's state: what the page may set, its state at the start, and texts."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from amiwarp.optics.models import MODELS
from amiwarp.viewer.choices import Axis, Colour, View
from amiwarp.viewer.comparison import AGAINST
from amiwarp.viewer.drawing import NO_ORBIT
from amiwarp.viewer.drawn_truth import colours_on_offer, truth_text
from amiwarp.viewer.image_kinds import ImageKind
from amiwarp.viewer.inspector import NO_ENCODER
from amiwarp.viewer.layout import KEYS, NAMES, SCOPES, SPEEDS, TOOLS, UNITS, VIEWS
from amiwarp.viewer.message_filter import Check, flag, number, one_of
from amiwarp.viewer.page_exports import export_state
from amiwarp.viewer.parameters import Source

if TYPE_CHECKING:
    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.window import DisplayedWindow

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
