"""Check of the arguments of public functions and classes against their annotations."""

from __future__ import annotations

import collections.abc
import functools
import math
import os
import types
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar, cast

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.schema.annotations import annotated_type, leaves, parts_of
from amiwarp.schema.kinds import TEXT, expectation, fits_array, no_device
from amiwarp.validation import INT64, TIME_HINT, as_words, real, shown, whole

Target = TypeVar("Target", bound=Callable[..., Any])
"""Any function or class."""

_REMEDIES = {
    ("path", "Recording"): "open it with amiwarp.open_recording",
    ("path", "Calibration"): "read it with amiwarp.Calibration.load",
    ("path", "World"): "read it with amiwarp.load_world",
    ("path", "Trajectory"): "read it with amiwarp.Trajectory.from_file",
    ("path", "Scene"): "read it with amiwarp.Scene.from_picture",
    ("structured array", "Events"): "make events of it with amiwarp.Events.from_structured",
    (
        "Recording",
        "Events",
    ): "give its events, recording.events[:]; as a transform, amiwarp.ToTensor(function, ...)",
    ("Compensated", "Events"): "give its events, packet.events",
    ("EventSource", "Events"): "give its events, source[:]",
    ("Calibration", "Model"): "give its model, calibration.model",
    ("Recording", "Camera"): "give its camera, recording.camera",
    (
        "Recording",
        "path",
    ): "write it with amiwarp.save_recording(path, recording), and give the path",
    (
        "list",
        "NumPy",
    ): "make arrays of lists, with numpy.array, or events with amiwarp.Events.from_arrays",
    (
        "Events",
        "Recording",
    ): "make one with amiwarp.Recording(amiwarp.MemoryEvents(events, width, height))",
    ("Events", "EventSource"): "wrap them as amiwarp.MemoryEvents(events, width, height)",
    (
        "DeviceEvents",
        "EventSource",
    ): "wrap them as amiwarp.DeviceMemoryEvents(events, width, height)",
}
"""What to do with a value of one kind where an object of a class is expected."""

_NUMBERS = frozenset((int, float, types.NoneType))
"""Types in the annotation of one number."""
_PLAIN = _NUMBERS | {str, Any, typing.Literal, tuple, slice}
"""Types in annotations of values that functions check themselves, because they know ranges, choices and shapes."""
_SOME_NUMBERS = frozenset((tuple, float))
"""Types in the annotation of a tuple of numbers."""
_WORDS = frozenset((tuple[str, ...], Sequence[str], Sequence[str | Path]))
"""Types of sequences of texts or paths, for which one text or path may be given."""
_CONTAINERS = frozenset(
    (collections.abc.Callable, collections.abc.Mapping, dict, tuple),
)
"""Types with which an annotation stands for more than one array."""


def guarded(target: Target) -> Target:
    """Decorate a public function or class, so that calls check the kinds of objects by the annotations.

    Objects, functions, mappings, NumPy arrays, paths, truth values, devices, and the numbers of functions, methods and
    records are checked. Ranges, choices and shapes are the function's own business. An annotation is resolved when a
    value first needs it, because its types may be imported for type checkers only. Raises :class:`AmiwarpError`, also
    if NumPy or SciPy finds no solution of a system of equations.
    """
    if not isinstance(target, type):
        return cast(Target, _checked_call(target, target.__name__, 0))
    record = hasattr(target, "__dataclass_fields__") and not (
        hasattr(target, "__post_init__") or hasattr(target, "check")
    )
    bases = [
        base for base in reversed(target.__mro__[:-1]) if not getattr(base, "_is_protocol", False)
    ]
    members: dict[str, Any] = {}
    for base in bases:
        members |= vars(base)
    for name, member in members.items():
        if name.startswith("_") and name != "__init__":
            continue
        label = target.__name__ if name == "__init__" else f"{target.__name__}.{name}"
        if isinstance(member, FunctionType):
            setattr(target, name, _checked_call(member, label, 1, record or name != "__init__"))
        elif isinstance(member, classmethod):
            setattr(target, name, classmethod(_checked_call(member.__func__, label, 1)))
    return target


def _checked_call(function: Any, label: str, first: int, numbers_too: bool = True) -> Any:
    """Return the function with checks of its arguments from the index ``first`` on."""
    code = function.__code__
    names = code.co_varnames[first : code.co_argcount + code.co_kwonlyargcount]
    if not names:
        return function
    named = {name: _Parameter(function, label, name, numbers_too) for name in names}
    by_position = code.co_varnames[first : code.co_argcount]
    positional = [(first + k, named[name]) for k, name in enumerate(by_position)]

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        given = args
        for index, parameter in positional:
            if index < len(args) and type(args[index]) not in parameter.known:
                plain = parameter.check(args[index])
                if plain is not args[index]:
                    given = (*given[:index], plain, *given[index + 1 :])
        for name, value in kwargs.items():
            if name in named and type(value) not in named[name].known:
                kwargs[name] = named[name].check(value)
        try:
            return function(*given, **kwargs)
        except np.linalg.LinAlgError as error:
            raise AmiwarpError(
                f"{label}: a system of equations has no solution ({error}): the given data do not determine the "
                "result; give more data, or data without values that are not finite"
            ) from error

    return call


class _EveryType(set[type]):
    """Set of all types."""

    def __contains__(self, _: object) -> bool:
        return True


class _Rule:
    """How the values of a parameter are checked, by its annotated type."""

    def __init__(self, function: Any, name: str, numbers_too: bool) -> None:
        self.kind = annotated_type(function, name)
        """Annotated type."""
        inside = leaves(self.kind)
        of_record = numbers_too and function.__name__ == "__init__"
        something = inside - {types.NoneType}
        self.is_number = numbers_too and inside <= _NUMBERS
        self.may_be_float = float in parts_of(self.kind)
        self.is_text = of_record and something == {str}
        self.has_words = any(part in _WORDS for part in parts_of(self.kind))
        """Whether it is a sequence of texts or paths."""
        self.is_device = name == "device"
        self.is_array = np.ndarray in inside and inside.isdisjoint(_CONTAINERS)
        plain = inside <= _PLAIN
        some_numbers = of_record and something == _SOME_NUMBERS
        self.may_be_none = plain and types.NoneType in inside
        checked = self.is_number or self.is_text or self.has_words or self.is_device or some_numbers
        self.is_free = plain and not checked
        """Whether the function checks the values itself."""

    @functools.cached_property
    def expected(self) -> Callable[[Any], str]:
        """Function of a value: what the type expects, in words, if the value does not fit; else an empty text."""
        return expectation(TEXT if self.is_text else self.kind)


class _Parameter:
    """Parameter of a guarded function."""

    def __init__(self, function: Any, label: str, name: str, numbers_too: bool) -> None:
        self._function = function
        self._label = label
        self._name = name
        self._numbers_too = numbers_too
        self._none_by_default = (function.__kwdefaults__ or {}).get(name, ...) is None
        self.known: set[type] = set()
        """Types of which each instance is accepted."""

    @functools.cached_property
    def _rule(self) -> _Rule:
        return _Rule(self._function, self._name, self._numbers_too)

    def check(self, value: Any) -> Any:
        """Return the value, or raise :class:`AmiwarpError` if it is not of the type.

        NumPy's numbers become plain ones. Where a sequence of words is expected, one word or a list becomes a tuple.
        """
        if value is None and self._none_by_default:
            return value
        rule = self._rule
        if rule.is_free:
            self.known = _EveryType()
            return value
        if rule.has_words:
            value = as_words(value)
            if not self._numbers_too:  # the record checks its words, which it knows
                return value
        if (value is None and rule.may_be_none) or (rule.is_array and fits_array(value)):
            return value
        if rule.is_number:
            return self._number(value, rule)
        if rule.is_device:
            here = "workers" not in self._function.__annotations__
            expected = no_device(value, rule.kind, here=here)
        else:
            expected = rule.expected(value)
        if expected:
            is_absent = rule.is_device and isinstance(value, str)
            raise AmiwarpError(
                f"{self._label}: {self._name} is {shown(value)}; expected {expected}"
                f"{_remedies(value, expected)}",
                ErrorCode.DEVICE_MISSING if is_absent else None,
            )
        is_own = type(value).__module__.startswith("amiwarp.")
        is_device = rule.is_device and not isinstance(value, str)
        if is_own or is_device or isinstance(value, bool | None):
            self.known.add(type(value))
        return value

    def _number(self, value: Any, rule: _Rule) -> Any:
        """Return a number, of Python if it is one of NumPy; raise :class:`AmiwarpError` for other values."""
        if type(value) is int and INT64[0] <= value <= INT64[1]:
            return value  # a shortcut
        if type(value) is float and rule.may_be_float and math.isfinite(value):
            return value  # another one
        what = f"{self._label}: {self._name}"
        if rule.may_be_float:
            plain: float = real(value, what)
        else:
            is_time = self._name == "t" or self._name.startswith("t_")
            plain = whole(value, what, *INT64, TIME_HINT if is_time else "")
        return plain if isinstance(value, np.generic | np.ndarray) else value


def _remedies(value: Any, expected: str) -> str:
    """Return what to do with a value where something else is ``expected``, as the end of a message."""
    given = {base.__name__ for base in type(value).__mro__}
    if isinstance(value, str | os.PathLike):
        given = {"path"}
    elif isinstance(value, np.ndarray) and value.dtype.names is not None:
        given = {"structured array"}
    words = expected.replace(",", " ").split()
    remedies = []
    for (kind, wanted), text in _REMEDIES.items():
        if kind in given and wanted in words:
            remedies.append(f"; {text}")
    return "".join(sorted(remedies))
