"""State of the inspector's page: what it shows, with which parameters; its history, and its text in the address."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import parse_qsl, urlencode

from amiwarp.choices import Axis, Colour, View
from amiwarp.optics.models import MODELS
from amiwarp.viewer.images import ImageKind
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.window import OTHERS, SLIDING, Knobs, Selection, Source

LONGEST_QUERY = 2000
"""Largest length of a state as text [characters]."""
LONGEST_HISTORY = 200
"""Largest number of states that can be undone."""
LONGEST_NOISE_US = 10_000_000
"""Largest time of the noise filter in an address [us]."""
LARGEST_RPM, LARGEST_OFFSET_US = 100_000.0, 1e9
"""Largest speed [1/min] and clock offset [us] in an address."""


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


def current_state(inspector: Inspector) -> ViewState:
    """Return the state of an inspector, with the default look."""
    start_us, length_us = inspector.window or inspector.first_window()
    first = inspector.recording.events.t_first
    axis = Axis.ANGLE if math.isfinite(inspector.turn_us) else Axis.TIME
    sources = tuple(inspector.sources.items())
    return ViewState(start_us - first, length_us, inspector.selection, inspector.knobs, sources, axis=axis)


def apply_state(inspector: Inspector, state: ViewState) -> None:
    """Set window, selection and parameters of an inspector.

    Raises :class:`AmiwarpError`, and changes nothing, if no events meet the state's window and selection.
    """
    window = state.start_us + inspector.recording.events.t_first, state.length_us
    if (window, state.selection) != (inspector.window, inspector.selection):
        inspector.open(*window, state.selection)
    inspector.set(state.knobs)
    inspector.sources = dict(state.sources)


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

ANGLES = ("apex", "phase", *(name for name, p in OTHERS.items() if p.unit == "rad"))
"""Parameters that the address gives in degrees."""
LIMITS = {
    "apex": (0.0, 60.0), "phase": (-3600.0, 3600.0), "clock_offset": (-LARGEST_OFFSET_US, LARGEST_OFFSET_US),
    **{name: p.limits for name, p in SLIDING.items()}, "rpm": (-LARGEST_RPM, LARGEST_RPM),
    **{name: p.limits for name, p in OTHERS.items()}, "focal_length": (0.1, 1e6),
}  # fmt: skip
"""Smallest and largest value of each parameter in an address: angles in degrees, others in their own units."""
CHOICES: dict[str, Any] = {"image": ImageKind, "colour": Colour, "axis": Axis, "view": View}
POLARITIES = {"both": None, "on": 1, "off": 0}
FLAGS = {"0": False, "1": True}


def encode_state(state: ViewState, default: ViewState) -> str:
    """Return what differs from the ``default`` as the query of an address, without a question mark."""
    now, usual = _texts(state), _texts(default)
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
    state, wrong = default, []
    for key, value in parse_qsl(query.removeprefix("?"), keep_blank_values=True, errors="replace"):
        try:
            state = _with_value(state, key, value, size, duration_us)
        except (ValueError, KeyError, OverflowError):
            wrong.append(f"the address gives {key[:20]!r} = {value[:40]!r}, which this recording cannot show")
    return state, tuple(wrong)


def _texts(state: ViewState) -> dict[str, str]:
    """Return all values of a state as texts."""
    s, polarities = state.selection, {value: text for text, value in POLARITIES.items()}
    out = {
        "start_ms": f"{state.start_us * 1e-3:.3f}", "length_ms": f"{state.length_us * 1e-3:.3f}",
        "polarity": polarities[s.polarity], "region": "all" if s.region is None else ",".join(map(str, s.region)),
        "hide_hot": str(int(s.hide_hot)), "noise_us": "0" if s.noise_us is None else str(s.noise_us),
        "overlaid": str(int(state.overlaid)), **{name: getattr(state, name).value for name in CHOICES},
        **_knob_texts(state.knobs, ""),
    }  # fmt: skip
    if state.against is not None:
        out |= _knob_texts(state.against, "b_")
    letters = ",".join(f"{name}:{source.name.lower()}" for name, source in state.sources)
    return {**out, "sources": letters}


def _knob_texts(knobs: Knobs, before: str) -> dict[str, str]:
    """Return the values of parameters as texts, with ``before`` in front of their names."""
    out = {f"{before}model": knobs.model}
    for name in LIMITS:
        if (value := knobs.value(name)) is not None:
            out[before + name] = f"{math.degrees(value) if name in ANGLES else value:.10g}"
    return out


def _with_value(state: ViewState, key: str, text: str, size: tuple[int, int], duration_us: int) -> ViewState:
    """Return a state with one value of an address. Raises ValueError, KeyError or OverflowError for a wrong value."""
    plain: dict[str, Callable[[], ViewState]] = {
        "start_ms": lambda: replace(state, start_us=_time(text, 0, duration_us - 1)),
        "length_ms": lambda: replace(state, length_us=_time(text, 1, duration_us)),
        "polarity": lambda: _selected(state, polarity=POLARITIES[text]),
        "region": lambda: _selected(state, region=_region(text, size)),
        "hide_hot": lambda: _selected(state, hide_hot=FLAGS[text]),
        "noise_us": lambda: _selected(state, noise_us=_whole(text, 0, LONGEST_NOISE_US) or None),
        "overlaid": lambda: replace(state, overlaid=FLAGS[text]),
        "sources": lambda: replace(state, sources=_sources(text, state.sources)),
    }
    if key in plain:
        return plain[key]()
    if key in CHOICES:
        return replace(state, **{key: CHOICES[key](text)})
    if key.startswith("b_"):
        return replace(state, against=_with_knob(state.against or state.knobs, key.removeprefix("b_"), text))
    return replace(state, knobs=_with_knob(state.knobs, key, text))


def _with_knob(knobs: Knobs, name: str, text: str) -> Knobs:
    """Return parameters with one value of an address."""
    if name == "model" and text in MODELS:
        return replace(knobs, model=text)
    value = _within(float(text), *LIMITS[name])
    return knobs.with_values({name: math.radians(value) if name in ANGLES else value})


def _selected(state: ViewState, **changes: Any) -> ViewState:
    return replace(state, selection=replace(state.selection, **changes))


def _region(text: str, size: tuple[int, int]) -> tuple[int, int, int, int] | None:
    if text == "all":
        return None
    left, top, right, bottom = (_whole(each, 0, max(size)) for each in text.split(","))
    return left, top, int(_within(right, left + 1, size[0])), int(_within(bottom, top + 1, size[1]))


def _sources(text: str, known: tuple[tuple[str, Source], ...]) -> tuple[tuple[str, Source], ...]:
    given = {name: Source[source.upper()] for name, source in (each.split(":") for each in text.split(","))}
    if given.keys() - dict(known).keys():
        raise ValueError(text)
    return tuple((dict(known) | given).items())


def _time(text: str, low: int, high: int) -> int:
    """Return a time in us from a text in ms."""
    return int(_within(round(float(text) * 1e3), low, high))


def _whole(text: str, low: int, high: int) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 12):
        raise ValueError(text)
    return int(_within(int(text), low, high))


def _within(value: float, low: float, high: float) -> float:
    """Return a value in a range. Raises ValueError for any other, such as NaN."""
    if not low <= value <= high:
        raise ValueError(value)
    return value
