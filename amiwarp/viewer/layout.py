"""Contents of the inspector's page: its keys, downloads and fields, what it may call and set, and its first state."""

from __future__ import annotations

import math
from typing import Any

from amiwarp.choices import Axis, Colour, View
from amiwarp.optics.models.registry import MODELS, alternatives
from amiwarp.viewer.address import MOST_EVERY
from amiwarp.viewer.captions import AGAINST, beside_text
from amiwarp.viewer.drawn_truth import colours_on_offer, truth_text
from amiwarp.viewer.filters import Selection
from amiwarp.viewer.images import DECAY_US, ImageKind
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Source
from amiwarp.viewer.page_messages import Check, flag, number, one_of
from amiwarp.viewer.sliders import given_fields, sliders

FILTER_FIELDS = {
    "noise_ms": ("noise filter", "ms", (0.01, 1000.0)),
    "refractory_ms": ("refractory period", "ms", (0.0, 10_000.0)),
    "most_mev_s": ("largest rate", "Mev/s", (0.0, 1e6)),
    "every": ("every n-th event", "", (1.0, float(MOST_EVERY))),
    "decay_ms": ("decay time", "ms", (0.001, 10_000.0)),
}
"""Fields of filters and of the decay by name: label, unit, and smallest and largest value."""
SCOPES = ("selection", "whole recording")
"""Choices of the events that a calibration uses."""
KEYS = (
    ("ArrowRight", ("step", 1), "forward by one turn, or by the window's length"),
    ("ArrowLeft", ("step", -1), "back by one turn, or by the window's length"),
    (" ", ("play",), "play (or follow a live stream), or stop"),
    ("1", ("look_from", View.FREE.value), "view from the corner"),
    ("2", ("look_from", View.XY.value), "view along the third axis: x-y, the image"),
    ("3", ("look_from", View.X_THIRD.value), "view along y: x-θ"),
    ("4", ("look_from", View.Y_THIRD.value), "view along x: y-θ"),
    ("e", ("suggest",), "show the suggested region"),
    ("w", ("whole",), "show the whole image"),
    ("t", ("toggle_axis",), "third axis: prism angle or time"),
    ("o", ("toggle", "overlaid"), "side by side or overlaid"),
    ("d", ("toggle", "dark"), "light or dark"),
    ("l", ("toggle", "loop"), "play in a loop, or once"),
    ("z", ("undo",), "undo; also Ctrl+Z"),
    ("y", ("redo",), "redo; also Ctrl+Y"),
    ("r", ("reset",), "back to the first state"),
    ("b", ("keep_b",), "keep the parameters as B, to compare with"),
    ("c", ("calibrate",), "calibrate, or cancel"),
    ("a", ("accept",), "accept the result of the calibration"),
    ("s", ("export", "calibration"), "save the calibration"),
    ("p", ("export", "picture"), "save a picture of the clouds"),
    ("?", ("toggle", "help_shown"), "show or hide this help"),
)
"""Keys of the page: name of the key, method of the panel with its arguments, and help text."""
RATE_BINS = 400
"""Number of bins of the drawn event rates."""
EXPORTS = {
    "picture": ("picture", ".png"),
    "image": ("images", ".png"),
    "pdf": ("figure, PDF", ".pdf"),
    "svg": ("figure, SVG", ".svg"),
    "values": ("image values", ".tif"),
    "events": ("events", ".h5"),
    "compensated": ("compensated events", ".h5"),
    "csv": ("events, CSV", ".csv"),
    "npz": ("events, NPZ", ".npz"),
    "vtp": ("cloud, VTP", ".vtp"),
    "vtp_after": ("compensated cloud, VTP", ".vtp"),
    "calibration": ("calibration", ".json"),
    "turntable": ("film, turning", ".mp4"),
    "film": ("film from here", ".mp4"),
}
"""Downloads by name: text of the button, and suffix."""
FILMS = ("turntable", "film")
"""Downloads that are films: they take long, and the page shows their progress."""
OF_OPTICS = ("compensated", "vtp_after", "calibration")
"""Downloads that only a recording with an optic has."""
CALLS = (
    "key",
    "released",
    "choose",
    "slide",
    "typed",
    "draw",
    "whole",
    "suggest",
    "look_from",
    "step",
    "move_window",
    "resize_window",
    "pick",
    "play",
    "calibrate",
    "accept",
    "discard",
    "take_truth",
    "zoom_timeline",
    "undo",
    "redo",
    "reset",
    "restore",
    "answer",
    "keep_b",
    "swap_b",
    "export",
    "open_file",
    "use_card",
    "end_film",
    "list_hot",
    "record",
    "save_view",
    "open_view",
    "delete_view",
    "choose_beside",
)
"""Methods of the panel that the page may call."""
SETTABLE: dict[str, Check] = {
    "point_size": number(1.0, 20.0),
    "opacity": number(0.0, 1.0),
    "speed": number(0.001, 10.0),
    "polarity": one_of("both", "ON", "OFF"),
    "model": one_of(*MODELS),
    "colour": one_of(*(colour.value for colour in Colour)),
    "axis": one_of(*(axis.value for axis in Axis)),
    "kind": one_of(*(kind.value for kind in ImageKind)),
    "against": one_of(*AGAINST),
    "scope": one_of(*SCOPES),
    "message": one_of(""),
    **dict.fromkeys(
        (
            "hide_hot",
            "noise_filter",
            "dark",
            "overlaid",
            "orbit_shown",
            "help_shown",
            "open_shown",
            "loop",
            "difference",
            "optic",
            "same_scale",
        ),
        flag,
    ),
}
"""State variables that the page may set directly, with the check of their values. The page changes all others through
:data:`CALLS`."""
CLIENT_ONLY = (
    "hover",
    "measured",
    "tool",
    "late",
    "slice",
    "sliced",
    "turned",
    "marked",
    "picture_scale",
    "view_name",
    "rig_hidden",
)
"""State variables that the browser keeps to itself."""
TEXTS = (
    "trame_error_report_msg",
    "stream_note",
    "hover",
    "measured",
    "address",
    "events",
    "drawn",
    "sharpness",
    "message",
    "rate_note",
    "picked_text",
    "image_note",
    "against_title",
    "after_title",
    "b_text",
    "busy",
    "found",
    "view_name",
    "views_file",
)
"""State variables that are texts."""
ARRAYS = (
    "cloud_before",
    "cloud_after",
    "cloud_third",
    "third_before",
    "colours_before",
    "colours_after",
    "rate_on",
    "rate_off",
    "orbit",
    "column",
)
"""State variables that are arrays as bytes: points, colours, rates and lines."""
FLAGS = (
    "help_shown",
    "open_shown",
    "playing",
    "loop",
    "hide_hot",
    "noise_filter",
    "dark",
    "overlaid",
    "can_undo",
    "can_redo",
    "image_slow",
    "difference",
    "has_b",
    "calibrating",
    "same_scale",
    "recording",
)
"""State variables that are true or false."""
OPTIONAL = (
    "overview",
    "before",
    "after",
    "surface",
    "image_scale",
    "after_scale",
    "marked",
    "hot_rows",
)
"""State variables that are None while there is nothing to show: images, maps and lists."""
ROWS = (
    "live_rows",
    "updating",
    "titles",
    "against_choices",
    "old",
    "steps",
    "beside_rows",
    "views",
    "rate_rows",
    "beside_counts",
    "rig_pictures",
    "rig_hidden",
)
"""State variables that are rows of texts, names or numbers."""
EMPTY: dict[str, Any] = {
    **dict.fromkeys(TEXTS, ""),
    **dict.fromkeys(ARRAYS, b""),
    **dict.fromkeys(FLAGS, False),
    **dict.fromkeys(OPTIONAL, None),
    **dict.fromkeys(ROWS, ()),
    "fixed_count": 0,
}
"""Values of state variables before the first update, by name."""


def initial_state(inspector: Inspector) -> dict[str, Any]:
    """Return the page's state at the start, without the events' window."""
    recording = inspector.recording
    size = recording.events.size
    beside_chosen = 0
    if inspector.beside is not None:
        beside_chosen = inspector.besides.index(inspector.beside)
    kinds = list(ImageKind)
    if inspector.depth is None:
        kinds.remove(ImageKind.DEPTH)
    axis = Axis.ANGLE if math.isfinite(inspector.turn_us) else Axis.TIME
    return {
        **EMPTY,
        **source_state(inspector),
        **knob_state(inspector),
        "turn_ms": turn_ms(inspector),
        "trame__title": f"amiwarp: {recording.name}",
        "name": recording.name,
        "truth": truth_text(recording.truth),
        "size": list(size),
        "optic": inspector.has_optic,
        "count": 0,
        "live": inspector.latest is not None,
        "models": list(alternatives(inspector.knobs.model)),
        "has_truth": inspector.truth is not None,
        "beside": inspector.beside is not None,
        "besides": [beside_text(inspector_beside) for inspector_beside in inspector.besides],
        "beside_chosen": beside_chosen,
        "exports": [
            [name, text, name in FILMS, name in OF_OPTICS] for name, (text, _) in EXPORTS.items()
        ],
        "keys": [[key, words] for key, _, words in KEYS],
        "scope": SCOPES[0],
        "scopes": list(SCOPES),
        "colour": Colour.POLARITY.value,
        "colours": [colour.value for colour in colours_on_offer(recording.truth)],
        "axis": axis.value,
        "axes": [axis.value for axis in Axis],
        "kind": ImageKind.COUNT.value,
        "kinds": [kind.value for kind in kinds],
        "speed": 0.1,
        "noise_ms": 2.0,
        "region_kind": "whole",
        "region_wanted": [0, 0, *size],
        "region": [0, 0, *size],
        "knob": inspector.orbit_names[0],
        "point_size": 2,
        "opacity": 1.0,
        "orbit_shown": True,
        "view": [View.FREE.value, 0],
        "tool": "region",
        "late": 0,
        "slice": [0.0, 1.0],
        "sliced": "",
        "turned": False,
        "severity": "info",
        "picked": -1,
        "picture_scale": 2,
        **filter_state(inspector.selection),
        "decay_ms": DECAY_US * 1e-3,
        "against": "recorded",
        "progress": 0,
        "calibrate_on": ["", ""],
        "curve_mark": 0.0,
        "third_axis": {"low": 0.0, "high": 1.0, "title": ""},
        "legend": {"title": "", "rows": [], "bar": "", "low": "", "high": ""},
        "curve": {"name": "", "title": "", "text": "", "x": [], "y": [], "truth": None},
        "statistics": {"rows": [], "x": [], "y": [], "median": None},
    }


def filter_state(selection: Selection) -> dict[str, Any]:
    """Return the state variables of the filters of events."""
    state = {
        "polarity": {None: "both", 1: "ON", 0: "OFF"}[selection.polarity],
        "hide_hot": selection.hide_hot,
        "noise_filter": selection.noise_us is not None,
        "refractory_ms": selection.refractory_us * 1e-3,
        "most_mev_s": selection.most_per_s * 1e-6,
        "every": selection.every,
    }
    if selection.noise_us is not None:  # else the page keeps the time in its field
        state["noise_ms"] = selection.noise_us * 1e-3
    return state


def source_state(inspector: Inspector) -> dict[str, Any]:
    """Return the state variables that depend on the events; they change in a live stream."""
    source = inspector.recording.events
    whole_ms = (source.t_last - source.t_first + 1) * 1e-3
    return {"whole_ms": whole_ms, "rate_span": [0.0, whole_ms]}


def knob_state(inspector: Inspector) -> dict[str, Any]:
    """Return the state variables of the prism's parameters."""
    return {
        "knobs": sliders(inspector),
        "given": given_fields(inspector),
        "model": inspector.knobs.model,
        "notes": what_is_missing(inspector),
    }


def turn_ms(inspector: Inspector) -> float:
    """Return the duration of a turn [ms]; 0 if the prism does not rotate, so that there is no motion to compensate."""
    return inspector.turn_us * 1e-3 if math.isfinite(inspector.turn_us) else 0.0


def what_is_missing(inspector: Inspector) -> list[str]:
    """Return what the recording lacks or what is only assumed, for the place where it matters."""
    texts = {
        Source.ASSUMED: "phase assumed, not known: calibrate, or set it",
        Source.ESTIMATED: "phase estimated from the events: calibrate for an accurate one",
    }
    notes = list(inspector.notes)
    source = inspector.sources["phase"]
    if source in texts and math.isfinite(inspector.turn_us):
        notes.append(texts[source])
    return notes
