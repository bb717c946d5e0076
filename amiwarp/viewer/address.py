"""The page's state as text in its address and in bookmarks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from operator import attrgetter
from typing import Any, TypeAlias
from urllib.parse import parse_qsl, urlencode

from amiwarp.choices import Axis, Colour, View
from amiwarp.optics.models.registry import MODELS
from amiwarp.viewer.bookmarks import Bookmarks
from amiwarp.viewer.images import ImageKind
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Knobs, Source, foreign_names
from amiwarp.viewer.sliders import GIVEN, LIMITS, UNITS
from amiwarp.viewer.view_state import ViewState

LONGEST_QUERY = 2000
"""Largest length of a state as text [characters]."""
LONGEST_TIME_US = 10_000_000
"""Largest time of a filter, and largest decay time, in an address [us]."""
RATE_LIMITS = (0.0, 1e12)
"""Smallest and largest rate to which events are limited [events/s]; 0 for no limit."""
MOST_EVERY = 1_000_000
MOST_COUNT = 1_000_000_000
"""Largest n of every n-th event, and largest number of events of a window set by its number."""
_Field: TypeAlias = tuple[str, Callable[[Any], str], Callable[[str], Any]]


def encode_state(state: ViewState, default: ViewState | None = None) -> str:
    """Return what differs from the ``default``, or all, as the query of an address, without a question mark."""
    usual = {} if default is None else _texts(default)
    differing = {key: text for key, text in _texts(state).items() if text != usual.get(key)}
    return urlencode(differing, safe=",:")


def decode_state(
    query: str, default: ViewState, *, size: tuple[int, int], duration_us: int
) -> tuple[ViewState, tuple[str, ...]]:
    """Return the state of an address's query, and what is wrong with it, one sentence each.

    Values that are wrong or missing stay as in ``default``. ``size``: width and height of the sensor [px].
    ``duration_us``: duration of the recording [us]. Never raises an error, whatever the text.
    """
    if len(query) > LONGEST_QUERY:
        return default, (
            f"the address has {len(query):,} characters after '?'; give at most {LONGEST_QUERY:,}",
        )
    state = default
    wrong = []
    fields = _fields(size, duration_us)
    for key, text in parse_qsl(query.removeprefix("?"), keep_blank_values=True, errors="replace"):
        try:
            held_by_recording = key in GIVEN and getattr(state, key) is None
            if key in fields and not held_by_recording:
                place, _, read = fields[key]
                state = _replaced(state, place, read(text))
            elif key == "sources":
                state = replace(state, sources=_sources(text, state.sources))
            elif key.startswith("b_"):
                against = state.against or state.knobs
                state = replace(state, against=_with_knob(against, key[2:], text))
            else:
                state = replace(state, knobs=_with_knob(state.knobs, key, text))
        except (ValueError, KeyError, OverflowError):
            wrong.append(
                f"the address gives {key[:20]!r} = {text[:40]!r}, which this recording cannot show"
            )
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
    state, wrong = decode_state(
        bookmarks.load(name), first, size=source.size, duration_us=duration_us
    )
    return state, tuple(f"{bookmarks.path.name}: {name!r}: {text}" for text in wrong)


def _fields(size: tuple[int, int], duration_us: int) -> dict[str, _Field]:
    """Return for each key of an address where the state holds its value, and how it becomes text and comes back."""

    def one_of(place: str, known: Mapping[str, Any]) -> _Field:
        texts = {value: text for text, value in known.items()}
        return place, texts.__getitem__, known.__getitem__

    def milliseconds(text: str, low: int, high: int) -> int:
        return int(_within(round(float(text) * 1e3), low, high))

    def region(text: str) -> tuple[int, ...] | None:
        if text == "all":
            return None
        left, top, right, bottom = (_whole(part, 0, max(size)) for part in text.split(","))
        return (
            left,
            top,
            int(_within(right, left + 1, size[0])),
            int(_within(bottom, top + 1, size[1])),
        )

    flags = {"0": False, "1": True}
    choices = {"image": ImageKind, "colour": Colour, "axis": Axis, "view": View}
    return {
        "start_ms": (
            "start_us",
            lambda us: f"{us * 1e-3:.3f}",
            lambda text: milliseconds(text, 0, duration_us - 1),
        ),
        "length_ms": (
            "length_us",
            lambda us: f"{us * 1e-3:.3f}",
            lambda text: milliseconds(text, 1, duration_us),
        ),
        "polarity": one_of("selection.polarity", {"both": None, "on": 1, "off": 0}),
        "region": (
            "selection.region",
            lambda sides: "all" if sides is None else ",".join(map(str, sides)),
            region,
        ),
        "hide_hot": one_of("selection.hide_hot", flags),
        "noise_us": (
            "selection.noise_us",
            lambda us: str(us or 0),
            lambda us: _whole(us, 0, LONGEST_TIME_US) or None,
        ),
        "refractory_us": (
            "selection.refractory_us",
            str,
            lambda us: _whole(us, 0, LONGEST_TIME_US),
        ),
        "most_per_s": (
            "selection.most_per_s",
            "{:.10g}".format,
            lambda rate: _number(RATE_LIMITS, rate),
        ),
        "every": ("selection.every", str, lambda n: _whole(n, 1, MOST_EVERY)),
        "events": (
            "fixed_count",
            lambda n: str(n or 0),
            lambda n: _whole(n, 0, MOST_COUNT) or None,
        ),
        "decay_us": ("decay_us", str, lambda us: _whole(us, 1, LONGEST_TIME_US)),
        "same_scale": one_of("same_scale", flags),
        "difference": one_of("difference", flags),
        "overlaid": one_of("overlaid", flags),
        **{
            name: one_of(name, {member.value: member for member in kind})
            for name, kind in choices.items()
        },
        **{
            name: (name, "{:.10g}".format, partial(_number, ends))
            for name, (_, _, ends) in GIVEN.items()
        },
    }


def _texts(state: ViewState) -> dict[str, str]:
    """Return all values of a state as texts."""
    texts = {}
    for key, (place, write, _) in _fields((0, 0), 0).items():
        value = attrgetter(place)(state)
        if key not in GIVEN or value is not None:
            texts[key] = write(value)
    texts |= _knob_texts("", state.knobs)
    if state.against is not None:
        texts |= _knob_texts("b_", state.against)
    foreign = foreign_names(state.knobs.model)
    shown = [(name, source) for name, source in state.sources if name not in foreign]
    texts["sources"] = ",".join(f"{name}:{source.name.lower()}" for name, source in shown)
    return texts


def _knob_texts(prefix: str, knobs: Knobs) -> dict[str, str]:
    """Return model and parameters as texts. ``prefix``: of their keys in the address."""
    texts = {f"{prefix}model": knobs.model}
    foreign = foreign_names(knobs.model)
    for name in LIMITS:
        value = knobs.value(name)
        if name not in foreign and value is not None:
            texts[prefix + name] = f"{value / UNITS[name]:.10g}"
    return texts


def _replaced(state: Any, place: str, value: Any) -> Any:
    """Return a state with another value of a field, or of a field of a field, such as ``selection.region``."""
    name, _, inner = place.partition(".")
    if inner:
        value = _replaced(getattr(state, name), inner, value)
    return replace(state, **{name: value})


def _with_knob(knobs: Knobs, name: str, text: str) -> Knobs:
    """Return parameters with one value of an address."""
    if name == "model" and text in MODELS:
        return replace(knobs, model=text)
    return knobs.with_values({name: _number(LIMITS[name], text) * UNITS[name]})


def _sources(text: str, known: tuple[tuple[str, Source], ...]) -> tuple[tuple[str, Source], ...]:
    given = {}
    for part in text.split(","):
        name, source = part.split(":")
        given[name] = Source[source.upper()]
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
