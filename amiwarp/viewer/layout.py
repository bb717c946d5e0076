"""Contents of the inspector's page: its state and history, names, units, keys and texts, and its template."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial, partialmethod
from operator import attrgetter
from typing import Any, TypeAlias
from urllib.parse import parse_qsl, urlencode

from amiwarp.calib.result import Calibration
from amiwarp.choices import Axis, Colour, View
from amiwarp.errors import AmiwarpError
from amiwarp.optics.models import MODELS, alternatives, size_names
from amiwarp.viewer.bookmarks import Bookmarks
from amiwarp.viewer.drawing import AGAINST, DECAY_US, ImageKind, Look, beside_text
from amiwarp.viewer.filters import Selection
from amiwarp.viewer.inspector import (
    OTHERS,
    SLIDING,
    Inspector,
    Knobs,
    Source,
    colours_on_offer,
    foreign_names,
    size_name,
    truth_text,
)
from amiwarp.viewer.serve import Check, flag, number, one_of

# State of the inspector's page: what it shows, with which parameters; its history, and its text in the address.

LONGEST_QUERY = 2000
"""Largest length of a state as text [characters]."""
LONGEST_HISTORY = 200
"""Largest number of states that can be undone."""
LONGEST_NOISE_US = 10_000_000
"""Largest time of a filter or a decay in an address [us]."""
RATE_LIMITS = (0.0, 1e12)
"""Smallest and largest rate to which events are limited [events/s]; 0 for no limit."""
MOST_EVERY, MOST_COUNT = 1_000_000, 1_000_000_000
"""Largest n of every n-th event, and largest number of events of a window set by its number."""


@dataclass(frozen=True)
class ViewState:
    """What the page shows. The page shows nothing that does not follow from it and the recording."""

    start_us: int
    """Start of the time window after the first event [us]."""
    length_us: int
    """Length of the time window [us]."""
    selection: Selection
    """Conditions for the shown events."""
    knobs: Knobs
    """Parameters of the prism."""
    sources: tuple[tuple[str, Source], ...]
    """Where the value of each parameter comes from, by name."""
    against: Knobs | None = None
    """Parameters to compare with; None to compare with the recorded events."""
    image: ImageKind = ImageKind.COUNT
    """What the images show."""
    colour: Colour = Colour.POLARITY
    """What the colour of the points shows."""
    axis: Axis = Axis.ANGLE
    """Third axis of the clouds."""
    view: View = View.FREE
    """Direction from which the clouds are seen."""
    overlaid: bool = False
    """Whether both clouds are in one frame."""
    fov_deg: float | None = None
    """Horizontal field of view [deg]; None if the recording holds its camera."""
    prism_index: float | None = None
    """Refractive index; None if the recording holds its prism."""
    fixed_count: int | None = None
    """Number of events by which the time window was set, and which it keeps when it moves; None: it keeps its length.
    """
    decay_us: int = DECAY_US
    """Decay time of a decaying time surface [us]."""
    same_scale: bool = False
    """Whether images of two recordings have one scale."""
    difference: bool = False
    """Whether the second image shows the difference of the two images."""


def current_state(inspector: Inspector, **look: Any) -> ViewState:
    """Return the state of an inspector, with the default look but for the given fields."""
    start_us, length_us = inspector.window or inspector.first_window()
    first = inspector.recording.events.t_first
    axis = Axis.ANGLE if math.isfinite(inspector.turn_us) else Axis.TIME
    sources = tuple(inspector.sources.items())
    of = {
        "axis": axis,
        "fixed_count": inspector.fixed_count,
        **{field["name"]: field["value"] for field in given_fields(inspector)},
        **look,
    }
    return ViewState(start_us - first, length_us, inspector.selection, inspector.knobs, sources, **of)


def apply_state(inspector: Inspector, state: ViewState) -> None:
    """Set window, selection and parameters of an inspector.

    Raises :class:`AmiwarpError`, and changes nothing, if no events meet the state's window and selection.
    """
    window = state.start_us + inspector.recording.events.t_first, state.length_us
    shown = inspector.window, inspector.selection, inspector.fixed_count
    if (window, state.selection, state.fixed_count) != shown:
        inspector.fixed_count = state.fixed_count
        try:
            inspector.open(*window, state.selection)
        except AmiwarpError:
            inspector.fixed_count = shown[-1]
            raise
    set_given(inspector, state.fov_deg, state.prism_index)
    inspector.set(state.knobs)
    held = {name for name in ("camera", "prism") if inspector.sources[name] is Source.FILE}
    inspector.sources = dict(state.sources) | dict.fromkeys(held, Source.FILE)


def set_given(inspector: Inspector, fov_deg: float | None, index: float | None) -> None:
    """Set the camera and the prism's index by hand where they differ from the inspector's; None keeps them."""
    if fov_deg is not None and fov_deg != inspector.fov_deg:
        inspector.set_camera(fov_deg)
    if index is not None and index != round(inspector.prism.index, 4):
        inspector.set_index(index)


class History:
    """States that can be undone and redone, from the first one on."""

    def __init__(self, first: ViewState) -> None:
        self.first = first
        self._states, self._at, self._change = [first], 0, ""

    @property
    def state(self) -> ViewState:
        """The current state."""
        return self._states[self._at]

    @property
    def can_undo(self) -> bool:
        """Whether there is a state before the current one."""
        return self._at > 0

    @property
    def can_redo(self) -> bool:
        """Whether a state was undone."""
        return self._at + 1 < len(self._states)

    def add(self, state: ViewState, change: str = "") -> None:
        """Add a state after the current one. States that were undone are dropped.

        ``change``: what has changed, such as the name of a slider. Successive changes of the same name count as one;
        an empty name always counts as a new change.
        """
        if state == self.state:
            return
        same = bool(change) and change == self._change and self.can_undo and not self.can_redo
        self._states = [*self._states[: self._at + (0 if same else 1)], state][-LONGEST_HISTORY:]
        self._at, self._change = len(self._states) - 1, change

    def undo(self) -> ViewState:
        """Go back by one state if possible, and return the current one."""
        self._at, self._change = max(self._at - 1, 0), ""
        return self.state

    def redo(self) -> ViewState:
        """Go forward by one state if possible, and return the current one."""
        self._at, self._change = min(self._at + 1, len(self._states) - 1), ""
        return self.state

    def reset(self) -> ViewState:
        """Add the first state again, and return it."""
        self.add(self.first)
        return self.first


# text in the address

LIMITS = {
    "apex": (0.0, 29.9), "phase": (-3600.0, 3600.0), "clock_offset": (-1e9, 1e9),
    **{name: p.limits for name, p in SLIDING.items()}, "rpm": (-1e5, 1e5),
    **{name: p.limits for name, p in OTHERS.items()}, "focal_length": (0.1, 1e6),
}  # fmt: skip
"""Smallest and largest value of each parameter in an address and a field, in degrees or the parameter's own unit."""
UNITS = {
    **dict.fromkeys(LIMITS, 1.0),
    **dict.fromkeys(("apex", "phase", *(name for name, p in OTHERS.items() if p.unit == "rad")), math.radians(1.0)),
}
"""Conversion from the units of page and address (angles in degrees) to the parameters' units (radians): factors."""
GIVEN = {"fov_deg": ("field of view", "°", (1.0, 170.0)), "prism_index": ("refractive index", "", (1.01, 3.5))}
"""Properties of camera and prism that a recording may lack: label, unit, and smallest and largest value."""

_Field: TypeAlias = tuple[str, Callable[[Any], str], Callable[[str], Any]]


def encode_state(state: ViewState, default: ViewState | None = None) -> str:
    """Return what differs from the ``default``, or all, as the query of an address, without a question mark."""
    now, usual = _texts(state), {} if default is None else _texts(default)
    return urlencode({key: value for key, value in now.items() if value != usual.get(key)}, safe=",:")


def decode_state(
    query: str, default: ViewState, *, size: tuple[int, int], duration_us: int
) -> tuple[ViewState, tuple[str, ...]]:
    """Return the state of an address's query, and what is wrong with it, one sentence each.

    Values that are wrong or missing stay those of ``default``. ``size``: width and height of the sensor [px].
    ``duration_us``: duration of the recording [us]. Never raises an error, whatever the text.
    """
    if len(query) > LONGEST_QUERY:
        return default, (f"the address has {len(query):,} characters after '?'; give at most {LONGEST_QUERY:,}",)
    state, wrong, fields = default, [], _fields(size, duration_us)
    for key, text in parse_qsl(query.removeprefix("?"), keep_blank_values=True, errors="replace"):
        try:
            if key in fields and not (key in GIVEN and getattr(state, key) is None):
                place, _, read = fields[key]
                state = _replaced(state, place, read(text))
            elif key == "sources":
                state = replace(state, sources=_sources(text, state.sources))
            else:
                place, name = ("against", key[2:]) if key.startswith("b_") else ("knobs", key)
                state = _replaced(state, place, _with_knob(getattr(state, place) or state.knobs, name, text))
        except (ValueError, KeyError, OverflowError):
            wrong.append(f"the address gives {key[:20]!r} = {text[:40]!r}, which this recording cannot show")
    return state, tuple(wrong)


def load_bookmark(
    bookmarks: Bookmarks, name: str, inspector: Inspector, first: ViewState
) -> tuple[ViewState, tuple[str, ...]]:
    """Return the state of a bookmark, and what is wrong with it, one sentence each.

    ``first``: state of which values stay that are wrong or missing. Raises :class:`AmiwarpError` as
    :meth:`Bookmarks.load`.
    """
    source = inspector.recording.events
    duration_us = int(source.t_last - source.t_first + 1)
    state, wrong = decode_state(bookmarks.load(name), first, size=source.size, duration_us=duration_us)
    return state, tuple(f"{bookmarks.path.name}: {name!r}: {text}" for text in wrong)


def _fields(size: tuple[int, int], duration_us: int) -> dict[str, _Field]:
    """Return for each key of an address where the state holds its value, and how it becomes text and comes back."""

    def one_of(place: str, known: Mapping[str, Any]) -> _Field:
        return place, {value: text for text, value in known.items()}.__getitem__, known.__getitem__

    def milliseconds(text: str, low: int, high: int) -> int:
        return int(_within(round(float(text) * 1e3), low, high))

    def region(text: str) -> tuple[int, ...] | None:
        if text == "all":
            return None
        left, top, right, bottom = (_whole(each, 0, max(size)) for each in text.split(","))
        return left, top, int(_within(right, left + 1, size[0])), int(_within(bottom, top + 1, size[1]))

    flags, choices = {"0": False, "1": True}, {"image": ImageKind, "colour": Colour, "axis": Axis, "view": View}
    return {
        "start_ms": ("start_us", lambda us: f"{us * 1e-3:.3f}", lambda text: milliseconds(text, 0, duration_us - 1)),
        "length_ms": ("length_us", lambda us: f"{us * 1e-3:.3f}", lambda text: milliseconds(text, 1, duration_us)),
        "polarity": one_of("selection.polarity", {"both": None, "on": 1, "off": 0}),
        "region": ("selection.region", lambda sides: "all" if sides is None else ",".join(map(str, sides)), region),
        "hide_hot": one_of("selection.hide_hot", flags),
        "noise_us": ("selection.noise_us", lambda us: str(us or 0), lambda us: _whole(us, 0, LONGEST_NOISE_US) or None),
        "refractory_us": ("selection.refractory_us", str, lambda us: _whole(us, 0, LONGEST_NOISE_US)),
        "most_per_s": ("selection.most_per_s", "{:.10g}".format, lambda rate: _number(RATE_LIMITS, rate)),
        "every": ("selection.every", str, lambda n: _whole(n, 1, MOST_EVERY)),
        "events": ("fixed_count", lambda n: str(n or 0), lambda n: _whole(n, 0, MOST_COUNT) or None),
        "decay_us": ("decay_us", str, lambda us: _whole(us, 1, LONGEST_NOISE_US)),
        "same_scale": one_of("same_scale", flags),
        "difference": one_of("difference", flags),
        "overlaid": one_of("overlaid", flags),
        **{name: one_of(name, {each.value: each for each in kind}) for name, kind in choices.items()},
        **{name: (name, "{:.10g}".format, partial(_number, ends)) for name, (_, _, ends) in GIVEN.items()},
    }  # fmt: skip


def _texts(state: ViewState) -> dict[str, str]:
    """Return all values of a state as texts."""
    fields = {key: (attrgetter(place)(state), write) for key, (place, write, _) in _fields((0, 0), 0).items()}
    out = {key: write(value) for key, (value, write) in fields.items() if key not in GIVEN or value is not None}
    for before, knobs in (("", state.knobs), ("b_", state.against)):
        if knobs is not None:
            known = {name: knobs.value(name) for name in LIMITS if name not in foreign_names(knobs.model)}
            out[f"{before}model"] = knobs.model
            out |= {before + n: f"{value / UNITS[n]:.10g}" for n, value in known.items() if value is not None}
    foreign = foreign_names(state.knobs.model)
    shown = [(name, source) for name, source in state.sources if name not in foreign]
    return {**out, "sources": ",".join(f"{name}:{source.name.lower()}" for name, source in shown)}


def _replaced(state: Any, place: str, value: Any) -> Any:
    """Return a state with another value of a field, or of a field of a field, such as ``selection.region``."""
    name, _, inner = place.partition(".")
    return replace(state, **{name: _replaced(getattr(state, name), inner, value) if inner else value})


def _with_knob(knobs: Knobs, name: str, text: str) -> Knobs:
    """Return parameters with one value of an address."""
    if name == "model" and text in MODELS:
        return replace(knobs, model=text)
    return knobs.with_values({name: _number(LIMITS[name], text) * UNITS[name]})


def _sources(text: str, known: tuple[tuple[str, Source], ...]) -> tuple[tuple[str, Source], ...]:
    given = {name: Source[source.upper()] for name, source in (each.split(":") for each in text.split(","))}
    if given.keys() - dict(known).keys():
        raise ValueError(text)
    return tuple((dict(known) | given).items())


def _whole(text: str, low: int, high: int) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 12):
        raise ValueError(text)
    return int(_within(int(text), low, high))


def _number(ends: tuple[float, float], text: str) -> float:
    return _within(float(text), *ends)


def _within(value: float, low: float, high: float) -> float:
    """Return a value in a range. Raises ValueError for any other, such as NaN."""
    if not low <= value <= high:
        raise ValueError(value)
    return value


_OF_MODELS = {name: (p.label, {"rad": "°", "1": ""}.get(p.unit, p.unit), p.slider) for name, p in SLIDING.items()}
SLIDERS: dict[str, tuple[str, str, tuple[float, float, float]]] = {
    "apex": ("apex angle", "°", (0.0, 3.0, 0.005)),
    **{name: slider for name, slider in _OF_MODELS.items() if name in size_names()},
    "phase": ("phase", "°", (-180.0, 180.0, 0.25)),
    "clock_offset": ("clock offset", "µs", (-20000.0, 20000.0, 10.0)),
    "rpm": ("speed of the prism", "rpm", (-3000.0, 3000.0, 0.5)),
    **{name: slider for name, slider in _OF_MODELS.items() if name not in size_names()},
}
"""Sliders by parameter, in their order: label, unit, and (minimum, maximum, step). That of the apex may be longer."""
FILTER_FIELDS = {
    "noise_ms": ("noise filter", "ms", (0.01, 1000.0)), "refractory_ms": ("refractory period", "ms", (0.0, 10_000.0)),
    "most_mev_s": ("largest rate", "Mev/s", (0.0, 1e6)), "every": ("every n-th event", "", (1.0, float(MOST_EVERY))),
    "decay_ms": ("decay time", "ms", (0.001, 10_000.0)),
}  # fmt: skip
"""Fields of filters and of the decay by name: label, unit, and smallest and largest value."""
FIELD_LIMITS = {**{name: LIMITS[name] for name in SLIDERS}, **{name: ends for name, (_, _, ends) in GIVEN.items()}}
"""Smallest and largest value of the fields of the prism and the camera, in the page's units."""
SCOPES = ("selection", "whole recording")
"""Choices of the events that a calibration uses."""
KEYS = (
    ("ArrowRight", ("step", 1), "forward by one turn, or by the window's length"),
    ("ArrowLeft", ("step", -1), "back by one turn, or by the window's length"),
    (" ", ("play",), "play (or follow a live stream), or stop"),
    ("1", ("look_from", View.FREE.value), "view from the corner"),
    ("2", ("look_from", View.XY.value), "view along the third axis: x-y, the image"),
    ("3", ("look_from", View.X_AXIS.value), "view along y: x-θ"),
    ("4", ("look_from", View.Y_AXIS.value), "view along x: y-θ"),
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
BINS = 400
"""Number of points of the drawn event rates."""
EXPORTS = {
    "picture": ("picture", ".png"), "image": ("images", ".png"), "pdf": ("figure, PDF", ".pdf"),
    "svg": ("figure, SVG", ".svg"), "values": ("image values", ".tif"),
    "events": ("events", ".h5"), "compensated": ("compensated events", ".h5"), "csv": ("events, CSV", ".csv"),
    "npz": ("events, NPZ", ".npz"), "vtp": ("cloud, VTP", ".vtp"), "vtp_after": ("compensated cloud, VTP", ".vtp"),
    "calibration": ("calibration", ".json"), "turntable": ("film, turning", ".mp4"),
    "film": ("film from here", ".mp4"),
}  # fmt: skip
"""Downloads by name: text of the button, and suffix."""
FILMS = ("turntable", "film")
"""Downloads that take long."""
OF_OPTICS = ("compensated", "vtp_after", "calibration")
"""Downloads that only a recording with an optic has."""
CALLS = (
    "key", "released", "choose", "slide", "typed", "draw", "whole", "suggest", "look_from", "step", "move_window",
    "resize_window", "pick", "play", "calibrate", "accept", "discard", "take_truth", "zoom_timeline", "undo", "redo",
    "reset", "restore", "answer", "keep_b", "swap_b", "export", "open_file", "use_card", "end_film",
    "list_hot", "record", "save_view", "open_view", "delete_view", "choose_beside",
)  # fmt: skip
"""Methods of the panel that the page may call."""
SETTABLE: dict[str, Check] = {
    "point_size": number(1.0, 20.0), "opacity": number(0.0, 1.0),
    "speed": number(0.001, 10.0), "polarity": one_of("both", "ON", "OFF"), "model": one_of(*MODELS),
    "colour": one_of(*(each.value for each in Colour)), "axis": one_of(*(each.value for each in Axis)),
    "kind": one_of(*(each.value for each in ImageKind)), "against": one_of(*AGAINST), "scope": one_of(*SCOPES),
    "message": one_of(""),
    **dict.fromkeys(("hide_hot", "noise_filter", "dark", "overlaid", "orbit_shown", "help_shown", "open_shown", "loop",
                     "difference", "optic", "same_scale"),
                    flag),
}  # fmt: skip
"""State variables that the page may set directly, with the check of their values. The page changes all others through
:data:`CALLS`."""
CLIENT_ONLY = ("hover", "measured", "tool", "late", "slice", "sliced", "turned", "marked", "picture_scale", "view_name")
"""State variables that the browser keeps to itself."""
EMPTY: tuple[tuple[Any, str], ...] = (
    ("", "trame_error_report_msg stream_note hover measured address events drawn sharpness message rate_note "
         "picked_text image_note against_title after_title b_text busy found view_name views_file"),
    (b"", "cloud_before cloud_after cloud_third third_before colours_before colours_after rate_on rate_off orbit "
          "column"),
    (False, "help_shown open_shown playing loop hide_hot noise_filter dark overlaid can_undo can_redo image_slow "
            "difference has_b calibrating same_scale recording"),
    (None, "overview before after surface image_scale after_scale marked hot_rows"),
    ((), "live_rows updating titles against_choices old steps beside_rows views rate_rows beside_counts"),
    (0, "fixed_count"),
)  # fmt: skip
"""Values of state variables before the first update, and their names."""


class Actions:
    """What page and window do alike: actions of keys and buttons, playback, and the history of what is shown."""

    keys: tuple[tuple[str, tuple[Any, ...], str], ...] = KEYS
    inspector: Inspector
    look: Look
    view: View
    time_window: tuple[int, int]
    """Start and length of the wanted time window on the events' clock [us]."""
    b: Knobs | None = None
    """Parameters that were kept as B."""
    found: Calibration | None = None
    """Result of a calibration that is not accepted yet."""
    history: History | None = None
    request: Callable[..., None]
    """Request updates, by their names. Successive ones with an equal ``change`` are undone in one step."""
    say: Callable[..., None]
    """Show a text as a message."""
    steps: tuple[Callable[[History], ViewState], ...] = ()
    """Steps through the history that are to be made after the changes which were requested before them."""
    bookmarks: Bookmarks | None = None
    """Named views of the recording; None if it is no file."""
    listener: Callable[[ViewState], None] | None = None
    """Called with what is shown after each update; None for nobody."""

    def released(self) -> None:
        """End a change that lasts, such as a drag."""

    @contextlib.contextmanager
    def errors_shown(self, what: str) -> Iterator[None]:
        """Show errors of the enclosed code as a message. ``what``: kind of the action."""
        try:
            yield
        except (AmiwarpError, OSError) as error:
            self.say(str(error))

    def knobs_taken(self) -> None:
        """Show parameters that the inspector has taken from elsewhere."""
        self.request("knobs")
        self.released()

    @property
    def against(self) -> Knobs | None:
        """Parameters that the first cloud shows; None for the recorded events."""
        return self.b

    @property
    def image(self) -> ImageKind:
        """What the images show."""
        return ImageKind.COUNT

    @property
    def decay_us(self) -> int:
        """Decay time of a decaying time surface [us]."""
        return DECAY_US

    @property
    def same_scale(self) -> bool:
        """Whether images of two recordings have one scale."""
        return False

    @property
    def difference(self) -> bool:
        """Whether the second image shows the difference of the two images."""
        return False

    @property
    def compensates(self) -> bool:
        """Whether the prism rotates, so that there is a motion to compensate."""
        return math.isfinite(self.inspector.turn_us)

    @property
    def whole_us(self) -> int:
        """Duration of the recording [us]."""
        source = self.inspector.recording.events
        return int(source.t_last - source.t_first + 1)

    def key(self, key: str) -> None:
        """Run the action of a key."""
        for known, (name, *given), _ in self.keys:
            if key == known:
                getattr(self, name)(*given)

    def suggest(self) -> None:
        """Show the region in which compensation gains most sharpness."""
        self.request("suggestion", "window")
        self.released()

    def toggle_axis(self) -> None:
        """Switch the third axis between angle and time."""
        self.restyle(axis=Axis.TIME if self.look.axis is Axis.ANGLE else Axis.ANGLE)

    def restyle(self, **changes: Any) -> None:
        """Change fields of the look."""
        self.look = replace(self.look, **changes)
        self.request("look")

    def choose_beside(self, k: int) -> None:
        """Show the recording with the number ``k`` of those that are on the same time axis."""
        others = self.inspector.besides
        if 0 <= k < len(others):
            self.inspector.beside = others[k]
            self.request("knobs")

    def take_truth(self) -> None:
        """Set the parameters to the known truth of a simulated recording."""
        with self.errors_shown("knobs"):
            self.inspector.take_truth()
        self.knobs_taken()

    def accept(self) -> None:
        """Set the parameters to the result of the calibration."""
        if self.found is not None:
            with self.errors_shown("knobs"):
                self.inspector.accept(self.found)
            self.discard()
            self.knobs_taken()

    def discard(self) -> None:
        """Forget the result of the calibration."""
        self.found = None

    # Time

    def step(self, count: int) -> None:
        """Move the time window by turns; without a prism, by its length; set by number, by as many events."""
        start_us, length_us = self.time_window
        if self.inspector.fixed_count is not None:
            self.move(self.inspector.start_after(count))
            self.released()
            return
        self.move(start_us + count * (round(self.inspector.turn_us) if self.compensates else length_us))
        self.released()

    def move(self, start_us: int, change: str = "") -> bool:
        """Move the time window to a start, within the recording. Return whether it is at the end."""
        first, (_, length_us) = self.inspector.recording.events.t_first, self.time_window
        last = first + max(0, self.whole_us - length_us)
        self.time_window = min(max(start_us, first), last), length_us
        self.request("window", change=change)
        return start_us >= last

    def newest_window(self) -> tuple[int, int]:
        """Return start and length of the window that ends with the last event [us]."""
        source, (_, length_us) = self.inspector.recording.events, self.time_window
        if self.inspector.fixed_count is not None:  # it starts as early as it takes
            return int(source.t_last), length_us
        return int(source.t_first) + max(0, self.whole_us - length_us), length_us

    def can_play(self) -> bool:
        """Go back to the start from the end. Return whether there is something to play, or a live stream to follow."""
        start_us, length_us = self.time_window
        if self.inspector.latest is None:
            if length_us >= self.whole_us:
                self.say("the window holds the whole recording; make it shorter to play")
                return False
            if self.move(start_us):
                self.move(self.inspector.recording.events.t_first)
        return True

    def advance(self, shown_us: float, *, loop: bool) -> bool:
        """Move the time window on while the recording is played, once or in a loop. Return whether it goes on."""
        start_us = self.time_window[0] + round(shown_us)
        if not self.move(start_us):
            return True
        self.move(self.inspector.recording.events.t_first if loop else start_us)
        return loop

    # Bookmarks

    def save_view(self, name: str) -> None:
        """Save what is shown as a bookmark."""
        if self.bookmarks is not None:
            with self.errors_shown("bookmark"):
                self.bookmarks.save(name, encode_state(self.state_now()))
                self.say(f"saved {name.strip()!r} in {self.bookmarks.path.name}")

    def open_view(self, name: str) -> None:
        """Show a bookmark."""
        if self.bookmarks is None:
            return
        with self.errors_shown("bookmark"):
            state, wrong = load_bookmark(self.bookmarks, name, self.inspector, self.state_now())
            self.travel(lambda _: state)
            if wrong:
                self.say("; ".join(wrong))

    # History

    def travel(self, step: Callable[[History], ViewState]) -> None:
        """Request the state that a step through the history gives."""
        self.steps = (*self.steps, step)
        self.request("state")
        self.released()

    undo = partialmethod(travel, History.undo)
    redo = partialmethod(travel, History.redo)
    reset = partialmethod(travel, History.reset)

    def travelled(self) -> ViewState | None:
        """Make the requested steps, and return the state to show; None to stay."""
        steps, self.steps, state = self.steps, (), None
        if self.history is not None:
            for step in steps:
                state = step(self.history)
        return state

    def state_now(self) -> ViewState:
        """Return the state that is shown now."""
        look = self.look
        return current_state(
            self.inspector,
            against=self.against,
            image=self.image,
            axis=look.axis,
            colour=look.colour,
            view=self.view,
            overlaid=look.overlaid,
            decay_us=self.decay_us,
            same_scale=self.same_scale,
            difference=self.difference,
        )

    def announce(self) -> None:
        """Tell the listener what is shown now, unless steps through the history will change it at once."""
        if self.listener is not None and not self.steps:
            self.listener(self.state_now())

    def remember(self, change: str) -> History:
        """Add what is shown now to the history, and return it. Equal ``change`` of successive states make one step."""
        now = self.state_now()
        self.history = self.history or History(now)
        self.history.add(now, change)
        return self.history


# State at the start, and the parts of it that follow from the recording and the inspector's parameters.


def initial_state(inspector: Inspector) -> dict[str, Any]:
    """Return the page's state at the start, without the events' window."""
    recording = inspector.recording
    size = recording.events.size
    return {
        **{name: value for value, names in EMPTY for name in names.split()},
        **source_state(inspector), **knob_state(inspector), "turn_ms": turn_ms(inspector),
        "trame__title": f"amiwarp: {recording.name}", "name": recording.name, "truth": truth_text(recording.truth),
        "size": list(size), "optic": inspector.has_optic, "count": 0, "live": inspector.latest is not None,
        "models": list(alternatives(inspector.knobs.model)),
        "has_truth": inspector.truth is not None, "beside": inspector.beside is not None,
        "besides": [beside_text(each) for each in inspector.besides],
        "beside_chosen": 0 if inspector.beside is None else inspector.besides.index(inspector.beside),
        "exports": [[name, text, name in FILMS, name in OF_OPTICS] for name, (text, _) in EXPORTS.items()],
        "keys": [[key, words] for key, _, words in KEYS], "scope": SCOPES[0], "scopes": list(SCOPES),
        "colour": Colour.POLARITY.value, "colours": [each.value for each in colours_on_offer(recording.truth)],
        "axis": (Axis.ANGLE if math.isfinite(inspector.turn_us) else Axis.TIME).value, "axes": [a.value for a in Axis],
        "kind": ImageKind.COUNT.value,
        "kinds": [each.value for each in ImageKind if each is not ImageKind.DEPTH or inspector.depth is not None],
        "speed": 0.1, "noise_ms": 2.0, "region_kind": "whole", "region_wanted": [0, 0, *size],
        "region": [0, 0, *size], "knob": inspector.orbit_names[0], "point_size": 2, "opacity": 1.0, "orbit_shown": True,
        "view": [View.FREE.value, 0], "tool": "region", "late": 0, "slice": [0.0, 1.0], "sliced": "", "turned": False,
        "severity": "info", "picked": -1, "picture_scale": 2, **filter_state(inspector.selection),
        "decay_ms": DECAY_US * 1e-3, "against": "recorded", "progress": 0, "calibrate_on": ["", ""],
        "curve_mark": 0.0, "third_axis": {"low": 0.0, "high": 1.0, "title": ""},
        "legend": {"title": "", "rows": [], "bar": "", "low": "", "high": ""},
        "curve": {"name": "", "title": "", "text": "", "x": [], "y": [], "truth": None},
        "statistics": {"rows": [], "x": [], "y": [], "median": None},
    }  # fmt: skip


def filter_state(selection: Selection) -> dict[str, Any]:
    """Return the state variables of the filters of events."""
    noise = {} if selection.noise_us is None else {"noise_ms": selection.noise_us * 1e-3}
    return {
        "polarity": {None: "both", 1: "ON", 0: "OFF"}[selection.polarity],
        "hide_hot": selection.hide_hot,
        "noise_filter": selection.noise_us is not None,
        **noise,
        "refractory_ms": selection.refractory_us * 1e-3,
        "most_mev_s": selection.most_per_s * 1e-6,
        "every": selection.every,
    }


def source_state(inspector: Inspector) -> dict[str, Any]:
    """Return the state variables that depend on the events; they change in a live stream."""
    source = inspector.recording.events
    whole_ms = (source.t_last - source.t_first + 1) * 1e-3
    return {"whole_ms": whole_ms, "rate_span": [0.0, whole_ms]}


def knob_values(inspector: Inspector) -> dict[str, float]:
    """Return the prism's parameters in the page's units, rounded as the page shows them."""
    return {name: round((inspector.knobs.value(name) or 0.0) / UNITS[name], 4) for name in SLIDERS}


def knob_state(inspector: Inspector) -> dict[str, Any]:
    """Return the state variables of the prism's parameters."""
    return {"knobs": sliders(inspector), "given": given_fields(inspector), "model": inspector.knobs.model,
            "notes": notes(inspector)}  # fmt: skip


def turn_ms(inspector: Inspector) -> float:
    """Return the duration of a turn [ms]; 0 if the prism does not rotate, so that there is no motion to compensate."""
    return inspector.turn_us * 1e-3 if math.isfinite(inspector.turn_us) else 0.0


def sliders(inspector: Inspector) -> list[dict[str, Any]]:
    """Return the sliders of the model's parameters: label, unit, ends, step, limits, value, true value and source."""
    values, known = knob_values(inspector), truths(inspector)
    shown = {*MODELS[inspector.knobs.model].FREE} - size_names()
    shown |= {*inspector.orbit_names, "clock_offset" if inspector.has_encoder else "rpm"}
    out = []
    for name, (label, unit, (least, most, step)) in SLIDERS.items():
        if name in shown:
            end = max(most, round(2.0 * math.degrees(inspector.nominal_apex), 1)) if name == "apex" else most
            low, high = FIELD_LIMITS[name]
            out.append({
                "name": name, "label": label, "unit": unit, "least": least, "most": end, "step": step, "low": low,
                "high": high, "value": values[name], "truth": known[name], "note": str(inspector.sources[name].value),
            })  # fmt: skip
    return out


def given_fields(inspector: Inspector) -> list[dict[str, Any]]:
    """Return the properties of camera and prism that the recording lacks: name, label, unit, value and its limits."""
    by_hand = {name for name, source in inspector.sources.items() if source in (Source.ASSUMED, Source.HAND)}
    prism = "prism" in by_hand and MODELS[inspector.knobs.model].PRISM
    found = {"fov_deg": ("camera" in by_hand, inspector.fov_deg), "prism_index": (prism, inspector.prism.index)}
    return [
        {"name": name, "label": label, "unit": unit, "value": round(found[name][1], 4), "low": low, "high": high}
        for name, (label, unit, (low, high)) in GIVEN.items()
        if found[name][0]
    ]


def truths(inspector: Inspector) -> dict[str, float | None]:
    """Return the known true parameters in the page's units; None for an unknown one."""
    known = inspector.truth
    return {n: None if known is None else round((known.value(n) or 0.0) / UNITS[n], 4) for n in SLIDERS}


def notes(inspector: Inspector) -> list[str]:
    """Return what the recording lacks or what is only assumed, for the place where it matters."""
    texts = {
        Source.ASSUMED: "phase assumed, not known: calibrate, or set it",
        Source.ESTIMATED: "phase estimated from the events: calibrate for an accurate one",
    }
    phase = texts.get(inspector.sources["phase"], "") if math.isfinite(inspector.turn_us) else ""
    return [*inspector.notes, *filter(None, [phase])]


# Texts about the prism's parameters.


def with_unit(name: str, value: float, digits: int = 4) -> str:
    """Return a value of a slider, in its unit, as text."""
    unit = SLIDERS[name][1]
    return f"{value:.{digits}g}{unit if unit in ('°', '') else f' {unit}'}"


def orbit_text(model: str, value: Callable[[str], float | None], phase: float) -> str:
    """Return the size of a model, as its slider sets it, and its phase [rad], with their units.

    ``value``: function that returns the value of a parameter by its name.
    """
    name = size_name(model)
    size = with_unit(name, (value(name) or 0.0) / UNITS[name])
    return f"{name.replace('_', ' ')} {size}, phase {math.degrees(phase):.4g}°"
