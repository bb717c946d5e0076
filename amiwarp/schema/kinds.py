"""Whether a value of Python is of an annotated type, and what that type expects, in words."""

import collections.abc
import contextlib
import enum
import functools
import math
import os
import re
import types
import typing
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.schema.annotations import parts_of
from amiwarp.validation import LONGEST_NAME, check_name_lengths, real


def expectation(kind: Any) -> Callable[[Any], str]:
    """Return a function of a value: what a type expects, in words, if the value does not fit; else an empty text.

    The type is resolved here, once, because a search checks thousands of values. Single numbers, texts and members of
    enumerations always fit: functions check these themselves, because they know ranges and choices. Inside a container
    they are checked.
    """
    origin = typing.get_origin(kind) or kind
    arguments = typing.get_args(kind)
    if hasattr(origin, "__value__"):  # a named type, as NDArray and ArrayLike are from NumPy 2.5 on
        return expectation(origin.__value__)
    parts = parts_of(kind)
    if len(parts) > 1:
        return _expectation_of_union(parts)
    if origin in _CHECKS:
        return _expectation_of(*_CHECKS[origin])
    if not isinstance(origin, type) or issubclass(origin, enum.Enum | int | float | str):
        return lambda _: ""
    if issubclass(origin, collections.abc.Mapping):
        return _expectation_of_mapping(arguments[1:])
    if issubclass(origin, tuple | list) or origin is collections.abc.Sequence:
        return _expectation_of_entries("tuple or list", arguments[:1], _entries_of_sequence)
    if getattr(origin, "_is_protocol", False):
        return _expectation_of(functools.partial(has_members, origin), origin.__name__)
    library = origin.__module__.partition(".")[0]
    wording = origin.__name__ if library == "amiwarp" else f"{library}.{origin.__name__}"
    return _expectation_of(lambda value: isinstance(value, origin), wording)


def _expectation_of(fits: Callable[[Any], bool], wording: str) -> Callable[[Any], str]:
    return lambda value: "" if fits(value) else wording


def _expectation_of_union(parts: Sequence[Any]) -> Callable[[Any], str]:
    """Return what the members of a union expect, in words, if a value fits none of them, as a function of the value."""
    origins = {typing.get_origin(part) or part for part in parts}
    is_path = not origins.isdisjoint((os.PathLike, Path))
    # A path given as text is checked as a path.
    expectations = [expectation(part) for part in parts if not (part is str and is_path)]

    def expected(value: Any) -> str:
        words: list[str] = []
        for expected_by_part in expectations:
            word = expected_by_part(value)
            if not word:
                return ""
            if word not in words:
                words.append(word)
        if len(words) == 1:
            return words[0]
        return f"{', '.join(words[:-1])} or {words[-1]}"

    return expected


def _expectation_of_mapping(kinds: Sequence[Any]) -> Callable[[Any], str]:
    """Return the expectation of a mapping by names, whose values are of a type."""

    def entries_of(value: Any) -> Iterable[Any] | None:
        by_name = isinstance(value, collections.abc.Mapping) and all(
            isinstance(key, str) for key in value
        )
        return value.values() if by_name else None

    return _expectation_of_entries("mapping (dict) by names", kinds, entries_of)


def _entries_of_sequence(value: Any) -> Iterable[Any] | None:
    return value if isinstance(value, list | tuple) else None


def _expectation_of_entries(
    what: str, kinds: Sequence[Any], entries_of: Callable[[Any], Iterable[Any] | None]
) -> Callable[[Any], str]:
    """Return what a container expects, in words, if it or one of its entries does not fit, as a function of it.

    ``entries_of`` returns the entries of a value, or None if it is no such container.
    """
    expectations = [expectation(_INSIDE.get(kind, kind)) for kind in kinds]
    of_numbers = list(kinds) == [float]

    def expected(value: Any) -> str:
        entries = entries_of(value)
        if entries is None:
            return what
        if of_numbers and set(map(type, entries)) <= {float} and all(map(math.isfinite, entries)):
            return ""  # a shortcut: a search checks the values of thousands of models
        for entry in entries:
            for expected_of_entry in expectations:
                words = expected_of_entry(entry)
                if words:
                    return f"{what}, each {words}"
        return ""

    return expected


def has_members(protocol: Any, value: Any) -> bool:
    """Return whether a value has what a protocol names, without calling its properties."""
    if protocol in type(value).__mro__:
        return True
    protocols = [base for base in protocol.__mro__ if getattr(base, "_is_protocol", False)]
    every = {name for base in protocols for name in vars(base)}
    names = {name for name in every if name[0] != "_" or name in ("__getitem__", "__len__")}
    held = getattr(value, "__dict__", {})
    simple = isinstance(value, type) or type(value).__module__ == "builtins"
    return not simple and all(hasattr(type(value), name) or name in held for name in names)


def fits_array(value: Any) -> bool:
    """Return whether a value is a NumPy array of numbers or truth values without masked ones."""
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
        return False
    return type(value) is np.ndarray or not np.ma.is_masked(value)


def _fits_number(value: Any) -> bool:
    with contextlib.suppress(AmiwarpError):
        real(value, "")
        return True
    return False


def _fits_path(value: Any) -> bool:
    with contextlib.suppress(Exception):  # other classes may raise anything
        plain = os.fspath(value)
        check_name_lengths(Path(plain))
        return b"\0" not in os.fsencode(plain) and isinstance(plain, str)
    return False


NUMBER = "number"
TEXT = "text"
"""Stand for float and str where these are checked."""
_INSIDE: dict[Any, Any] = {float: NUMBER, str: TEXT}
_PATH_WORDS = f"a path without null bytes and with names of at most {LONGEST_NAME} bytes"
_CHECKS: dict[Any, tuple[Callable[[Any], bool], str]] = {
    bool: (lambda value: isinstance(value, bool | np.bool_), "True or False"),
    types.NoneType: (lambda value: value is None, "None"),
    os.PathLike: (_fits_path, _PATH_WORDS),
    Path: (_fits_path, _PATH_WORDS),
    np.ndarray: (fits_array, "a NumPy array of numbers without masked values"),
    collections.abc.Callable: (callable, "a function"),
    collections.abc.Iterable: (
        lambda value: np.iterable(value) and not isinstance(value, str),
        "an iterable",
    ),
    NUMBER: (_fits_number, "a finite number"),
    TEXT: (lambda value: isinstance(value, str), "a text"),
}
"""Check of a value, and what it expects in words, by type."""


def no_device(value: Any, kind: Any, *, here: bool) -> str:
    """Return the devices, in words, if a value names none of them. ``here``: this machine must have the device."""
    if not here:
        fits = isinstance(value, str) and re.fullmatch(r"cpu|cuda(:\d+)?", value)
        return "" if fits else "cpu, cuda for all GPUs, or one GPU such as cuda:0"
    import warp as wp

    with contextlib.suppress(Exception):  # Warp raises several kinds of errors
        if isinstance(value, str if kind is str else str | wp.Device):
            wp.get_device(value)
            return ""
    return f"a device of this machine; choose among {', '.join(device.alias for device in wp.get_devices())}"
