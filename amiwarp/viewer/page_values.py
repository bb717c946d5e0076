"""Values of the page's state: numbers converted to text, image addresses and SVG points."""

from __future__ import annotations

import base64
import io
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.optics.models import MODELS
from amiwarp.viewer.choices import Axis, Colour, View
from amiwarp.viewer.drawn_truth import colours_on_offer, truth_text
from amiwarp.viewer.layout import NAMES, SPEEDS
from amiwarp.viewer.message_filter import Check, flag, list_of, number, one_of, text

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.window import DisplayedWindow

JPEG_QUALITY = 90
_pixels = number(0, LARGEST_SIZE)
SETTABLE: dict[str, Check] = {
    **dict.fromkeys(NAMES, number()), "start_ms": number(), "region_x": list_of(_pixels, _pixels),
    "region_y": list_of(_pixels, _pixels), "point_size": number(0.1, 20.0), "opacity": number(0.0, 1.0),
    "speed": one_of(*SPEEDS), "polarity": one_of("both", "ON", "OFF"), "model": one_of(*MODELS),
    "colour": one_of(*(each.value for each in Colour)), "axis": one_of(*(each.value for each in Axis)),
    "view": one_of(*(each.value for each in View)), "out": text(200), "playing": one_of(False), "picked": one_of(""),
    "message": one_of(""), **dict.fromkeys(("hide_hot", "dark", "overlaid", "orbit_shown", "help_shown"), flag),
}  # fmt: skip
"""State variables that the page may set directly, with the check of their values. The page changes all others through
calls."""


def initial_state(inspector: Inspector) -> dict[str, Any]:
    """Return the page's state at the start, without the prism's parameters."""
    source, recording = inspector.recording.events, inspector.recording
    start, length = inspector.window or inspector.first_window()
    has_turns = math.isfinite(inspector.turn_us)
    return {
        **source_state(inspector), "live": inspector.latest is not None,
        "trame__title": f"amiwarp: {recording.name}", "name": recording.name, "size": list(source.size),
        "start_ms": round((start - source.t_first) * 1e-3, 3),
        "length_ms": round(length * 1e-3, 3), "turn_ms": inspector.turn_us * 1e-3 if has_turns else 0.0,
        "playing": False, "speed": 0.1, "polarity": "both", "hide_hot": False, "region_x": [0, source.size[0]],
        "region_y": [0, source.size[1]], "colour": Colour.POLARITY.value, "point_size": 2.0, "opacity": 1.0,
        "axis": (Axis.ANGLE if has_turns else Axis.TIME).value, "dark": False, "overlaid": False,
        "view": View.FREE.value, "colours": [each.value for each in colours_on_offer(recording.truth)],
        "truth": truth_text(recording.truth),
        "knob": "apex", "has_encoder": inspector.has_encoder, "orbit_shown": True, "help_shown": False, "out": "",
        "apex_most": max(3.0, round(2.0 * math.degrees(inspector.prism.apex), 1)), "events": "", "sharpness": "",
        "before": "", "after": "", "picture": "", "picture_note": "", "curve": "", "curve_mark": 0.0, "curve_text": "",
        "curve_low": 0.0, "curve_high": 1.0, "shown_from": 0.0, "shown_part": 1.0, "severity": "info",
        "message": "; ".join(inspector.notes), "busy": "", "progress": 0, "found": "", "picked": "",
    }  # fmt: skip


def source_state(inspector: Inspector) -> dict[str, Any]:
    """Return the state variables that depend on the events; they change in a live stream."""
    source, (times, rates) = inspector.recording.events, inspector.rate
    return {
        "whole_ms": (source.t_last - source.t_first + 1) * 1e-3, "rate": polyline(times[:-1], rates),
        "rate_top": f"{rates.max() * 1e-6:.3g} Mev/s" if len(rates) else "",
    }  # fmt: skip


def event_text(shown: DisplayedWindow, k: int) -> str:
    """Return the description of point ``k``: pixel, time, angle, polarity, compensated position and ground truth."""
    e, (x, y), truth = shown.events, shown.after[k], shown.truth.text(k)
    return (
        f"x {e.x[k]}, y {e.y[k]} px; t {e.t[k]} µs; θ {math.degrees(shown.theta[k]):.2f}°; "
        f"{'ON' if e.p[k] else 'OFF'}; compensated {x:.2f}, {y:.2f} px{truth and f'; {truth}'}"
    )


def jpeg(values: NDArray[Any]) -> str:
    """Return an image with values from 0 to 1, shape (height, width), as the address (data URL) of a JPEG."""
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray((255.0 * values).astype(np.uint8)).save(data, "JPEG", quality=JPEG_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(data.getvalue()).decode()


def polyline(x: NDArray[Any], y: NDArray[Any]) -> str:
    """Return the SVG points of a curve, scaled to a box of 100 x 40."""
    if not len(x):
        return ""
    across = 100.0 * (x - x[0]) / max(float(x[-1] - x[0]), 1e-12)
    low, high = float(np.min(y)), float(np.max(y))
    up = 38.0 - 36.0 * (y - low) / max(high - low, 1e-12)
    return " ".join(f"{a:.2f},{b:.2f}" for a, b in zip(across, up, strict=True))


def percent_of_range(value: float, low: float, high: float) -> float:
    """Return the position of ``value`` between ``low`` and ``high`` [%], from 0 to 100."""

    return min(max(100.0 * (value - low) / max(high - low, 1e-12), 0.0), 100.0)
