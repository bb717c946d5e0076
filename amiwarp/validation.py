"""Checks of values given by users, and the check of the arguments of public functions against their annotations.

Each check of a single value returns it in its plain type, or raises :class:`AmiwarpError` that says what was expected.
"""

from __future__ import annotations

import builtins
import collections.abc
import contextlib
import difflib
import enum
import functools
import inspect
import math
import numbers
import os
import re
import reprlib
import sys
import types
import typing
from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from types import FunctionType
from typing import Any, NoReturn, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError

Choice = TypeVar("Choice", bound=enum.StrEnum)
Number = TypeVar("Number", int, float)
Kind = TypeVar("Kind")
Target = TypeVar("Target", bound=Callable[..., Any])
"""Type variables: an enumeration whose members have names, any class, and any function or class."""

UNUSABLE = (TypeError, ValueError, OverflowError, RecursionError)
"""Exceptions that Python and NumPy raise for values of unexpected types."""

HOST_MEMORY = (1, 3)
"""DLPack's numbers of devices in host memory: CPU, and pinned memory of CUDA."""

LONGEST_NAME, LONGEST_PATH = 255, 4095
"""Limits of file systems: of the name of a file or folder, and of a whole path [bytes]."""

_short = reprlib.Repr()
_short.maxstring = _short.maxother = _short.maxlong = 80
_short.maxlevel = 2


def shown(value: object) -> str:
    """Return a short text of a value on one line, for messages."""
    try:
        return " ".join(_short.repr(value).split())
    except Exception:  # other classes may raise anything; an integer of 5000 digits raises too
        return f"a value of type {type(value).__name__}"


def choice(kind: type[Choice], value: object, what: str) -> Choice:
    """Return the member of the enumeration ``kind`` that ``value`` is or names.

    Raises :class:`AmiwarpError` with the names of all members.
    """
    if isinstance(value, kind):
        return value
    return kind(one_of(value, [member.value for member in kind], what))


def one_of(value: object, names: Collection[str], what: str) -> str:
    """Return ``value`` if it is one of ``names``; else raise :class:`AmiwarpError` with the names."""
    if not isinstance(value, str) or value not in names:
        raise AmiwarpError(f"{what} is {shown(value)}; choose among {', '.join(names)}")
    return str(value)


def instance(value: object, kind: type[Kind], what: str) -> Kind:
    """Return ``value`` if it is an instance of the class ``kind``; else raise :class:`AmiwarpError`."""
    if not isinstance(value, kind):
        raise AmiwarpError(f"{what} is {shown(value)}; expected a {kind.__name__}")
    return value


def real(value: object, what: str, low: float = -math.inf, high: float = math.inf, hint: str = "") -> float:
    """Return a finite number within ``low`` .. ``high``, both included, as float.

    Accepts numbers of Python and NumPy, but neither text nor truth values. Raises :class:`AmiwarpError`, whose message
    ends in ``hint``.
    """
    if type(value) is float and low <= value <= high and math.isfinite(value):
        return value  # a shortcut: a search builds thousands of models
    plain = _scalar(value)
    number = math.nan
    if not isinstance(plain, bool) and isinstance(plain, numbers.Real):
        try:
            number = float(plain)
        except UNUSABLE:  # an integer beyond float64
            number = math.nan
    if not (math.isfinite(number) and low <= number <= high):
        raise AmiwarpError(f"{what} = {shown(plain)} is not {_range('a finite number', low, high)}{hint}")
    return number


def whole(value: object, what: str, low: int, high: int, hint: str = "") -> int:
    """Return a whole number within ``low`` .. ``high``, both included, as int.

    Accepts integers of Python and NumPy, but neither floats nor truth values. Raises :class:`AmiwarpError`, whose
    message ends in ``hint``.
    """
    plain = _scalar(value)
    if isinstance(plain, bool) or not isinstance(plain, numbers.Integral) or not low <= int(plain) <= high:
        if isinstance(plain, float) and plain.is_integer():
            hint += ", but a float; give an int"
        wanted = "a whole number" if (low, high) == INT64 else _range("a whole number", low, high)
        raise AmiwarpError(f"{what} = {shown(plain)} is not {wanted}{hint}")
    return int(plain)


def as_words(value: object) -> object:
    """Return a single text, member of an enumeration or path as a tuple of it, and a list as a tuple."""
    if isinstance(value, str | Path):
        return (value,)
    return tuple(value) if isinstance(value, list) else value


def vector(value: object, count: int, what: str, check: Callable[[object, str], Number]) -> tuple[Number, ...]:
    """Return a sequence of ``count`` numbers, each checked by the function ``check``.

    Raises :class:`AmiwarpError` for any other value.
    """
    axes = value.ndim if isinstance(value, np.ndarray) else 1
    if not isinstance(value, list | tuple | np.ndarray) or axes != 1 or len(value) != count:
        raise AmiwarpError(f"{what} is {shown(value)}; expected {count} numbers")
    return tuple(check(entry, what) for entry in value)


def array(value: object, what: str, kinds: str = "iuf") -> NDArray[Any]:
    """Return an array of numbers, without a copy if ``value`` is such an array. Raises :class:`AmiwarpError`.

    ``kinds`` are the accepted kinds of types, as in NumPy's ``dtype.kind``. Add ``b`` to accept truth values. Arrays of
    other libraries in host memory are shared too.
    """
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise AmiwarpError(f"{what} has masked values; leave those rows out of all arrays, as in values[~mask]")
    if on_gpu(value):
        raise AmiwarpError(f"{what} is on a GPU; copy it to the host, or give events as amiwarp.DeviceEvents")
    try:
        found = np.asarray(value if not hasattr(value, "__dlpack__") or _numpy_reads(value) else np.from_dlpack(value))
    except UNUSABLE:
        found = np.zeros(0, object)
    except (RuntimeError, BufferError) as error:  # such as a tensor of PyTorch that requires a gradient
        raise AmiwarpError(f"{what} cannot be read as an array: {error}") from error
    if isinstance(value, list | tuple) and not value:
        return np.zeros(0)
    if found.dtype.kind not in kinds:
        raise AmiwarpError(f"{what} is {shown(value)}, of type {found.dtype}; expected numbers")
    return found


def packed(values: NDArray[Any]) -> NDArray[Any]:
    """Return a C-contiguous and aligned array, without a copy if it is one already.

    Along an axis of length 1, NumPy accepts any stride in such an array. Warp takes other strides than those of the
    shape for gaps, so they are set here.
    """
    return np.require(values, requirements=["C", "A"]).reshape(-1).reshape(values.shape)


def finite(values: NDArray[Any], what: str, hint: str = "give finite numbers") -> NDArray[Any]:
    """Return an array without NaN and infinite values; raise :class:`AmiwarpError` that names the first one."""
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        at = int(np.argmax(~np.isfinite(values)))
        raise AmiwarpError(f"{what} hold {values.flat[at]} (number {at}); {hint}")
    return values


TIME_LIMIT = 2**62
"""Limit of the magnitude of times of events, encoder samples and index pulses [us]: 146,000 years.

The difference and the sum of any two times then fit int64.
"""

TIME_HINT = "; times are whole microseconds (int64): give 100_000 for 0.1 s"
"""End of the message for a time that is no whole number."""

TIME_UNITS = {"us": 1.0, "s": 1e6}
"""Microseconds in each unit of times that arrays may have."""

FRACTION_OF_US = "times are whole microseconds; for seconds, give t_unit='s' (events) or np.rint(t * 1e6)"
"""Message for floating times with a fraction."""
COARSE_TIMES = "does not resolve 1 us there; give float64 or int64 from the start"
"""Message for floating times that were rounded before."""


def as_times(values: ArrayLike, what: str = "times", unit: str = "us") -> NDArray[np.int64]:
    """Return times given in Python, of any numeric type and in one of :data:`TIME_UNITS`, as int64 [us].

    Times in seconds are rounded. Floating times in microseconds must be whole: others are likely in seconds. Raises
    :class:`AmiwarpError`, also for a time that is not finite, beyond :data:`TIME_LIMIT`, or too late for its type.
    """
    given = array(values, what)
    scale = TIME_UNITS[one_of(unit, TIME_UNITS, "t_unit")]
    if scale == 1.0 and given.dtype.kind != "f":
        return rounded_times(given, what)
    limit = largest_exact_time(given.dtype)
    with np.errstate(over="ignore"):
        scaled = given.astype(np.float64) * scale
    times = rounded_times(scaled, what)
    if scale == 1.0 and not np.array_equal(times, scaled):
        at = int(np.argmax(times != scaled))
        raise AmiwarpError(f"{what} hold {scaled.flat[at]:.9g} (number {at}): {FRACTION_OF_US}")
    if times.size and max(-int(times.min()), int(times.max())) > limit:
        raise AmiwarpError(f"{what} reach {np.abs(times).max()} us, and {given.dtype} {COARSE_TIMES}")
    return times


def largest_exact_time(dtype: np.dtype[Any]) -> float:
    """Return the largest time whose neighbours in a type are at most 1 us away [us]."""
    return 2.0 / float(np.finfo(dtype).eps) if dtype.kind == "f" else TIME_LIMIT


def rounded_times(values: ArrayLike, what: str = "times") -> NDArray[np.int64]:
    """Return times of a file, of any numeric type, as int64 [us], rounded.

    Raises :class:`AmiwarpError` for a time that is not finite or beyond :data:`TIME_LIMIT`.
    """
    given = array(values, what)
    if given.size and not (given.min() > -TIME_LIMIT and given.max() < TIME_LIMIT):
        spans = f"{what} span {given.min()} .. {given.max()} us: not finite or beyond int64"
        raise AmiwarpError(f"{spans}; expected microseconds within {TIME_LIMIT} us of 0")
    return np.asarray(np.rint(given) if given.dtype.kind == "f" else given, np.int64)


def check_ascending(t: NDArray[np.int64], what: str) -> None:
    """Raise :class:`AmiwarpError` if a time is not later than the one before. ``what`` is at each time."""
    later = t[1:] > t[:-1]
    if not later.all():
        at = int(np.argmin(later)) + 1
        raise AmiwarpError(f"{what} {at} ({t[at]} us) is not later than the one before; sort by time")


def on_gpu(value: Any) -> bool:
    """Return whether an array of any library is outside the host's memory, by DLPack's ``__dlpack_device__``."""
    if isinstance(value, np.ndarray):
        return False
    try:
        return int(value.__dlpack_device__()[0]) not in HOST_MEMORY
    except Exception:  # other libraries may raise anything; lists and numbers have no such method
        return False


def _numpy_reads(value: object) -> bool:
    """Return whether NumPy reads an array by itself."""
    return hasattr(value, "__array__") or hasattr(value, "__array_interface__")


def _scalar(value: object) -> Any:
    """Return the number in an array without axes, or any other value unchanged."""
    return value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value


def _range(what: str, low: float, high: float) -> str:
    """Return the text of a range whose limits may be infinite."""
    if math.isinf(low) and math.isinf(high):
        return what
    if math.isinf(high):
        return f"{what} of at least {_plain(low)}"
    return f"{what} in {_plain(low)} .. {_plain(high)}"


def _plain(number: float) -> str:
    """Return a limit of a range as text."""
    return str(number) if isinstance(number, int) else f"{number:.6g}"


_REMEDIES = {
    ("path", "Recording"): "open it with amiwarp.open_recording",
    ("path", "Calibration"): "read it with amiwarp.Calibration.load",
    ("path", "World"): "read it with amiwarp.load_world",
    ("path", "Trajectory"): "read it with amiwarp.Trajectory.from_file",
    ("path", "Scene"): "read it with amiwarp.Scene.from_picture",
    ("structured array", "Events"): "make events of it with amiwarp.Events.from_structured",
    ("Recording", "Events"): "give its events, recording.events[:]; as a transform, amiwarp.ToTensor(function, ...)",
    ("Compensated", "Events"): "give its events, packet.events",
    ("EventSource", "Events"): "give its events, source[:]",
    ("Calibration", "Model"): "give its model, calibration.model",
    ("Recording", "Camera"): "give its camera, recording.camera",
    ("Recording", "path"): "write it with amiwarp.save_recording(path, recording), and give the path",
    ("list", "NumPy"): "make arrays of lists, with numpy.array, or events with amiwarp.Events.from_arrays",
    ("Events", "Recording"): "make one with amiwarp.Recording(amiwarp.MemoryEvents(events, width, height))",
    ("Events", "EventSource"): "wrap them as amiwarp.MemoryEvents(events, width, height)",
    ("DeviceEvents", "EventSource"): "wrap them as amiwarp.DeviceMemoryEvents(events, width, height)",
}
"""What to do with a value of one kind where an object of a class is expected."""

_NUMBERS = frozenset(("int", "float", "None"))
"""Names in the annotation of one number."""
_PLAIN = _NUMBERS | {"str", "Any", "ArrayLike", "Literal", "us", "s", "tuple", "slice"}
"""Names in annotations of values that functions check themselves, because they know ranges, choices and shapes."""
_SOME_NUMBERS = {"tuple", "float"}, {"tuple", "float", "None"}
"""Names in annotations of a tuple of numbers."""
_TEXT = {"str"}, {"str", "None"}
"""Names in annotations of a text."""
_WORDS = re.compile(r"(tuple\[str, \.\.\.\]|Sequence\[str( \| Path)?\])( \| None)?")
"""Annotation of a sequence of texts or paths."""


def not_called(instead: str) -> Callable[[Target], Target]:
    """Decorate a protocol or base class, so that a call of it says what to do ``instead``. Derived classes are free."""

    def decorate(target: Target) -> Target:
        kind: Any = target

        def init(self: Any, *args: Any, **options: Any) -> None:
            if type(self) is kind:
                raise AmiwarpError(f"{kind.__name__} is a type for annotations and for own classes; {instead}")
            super(kind, self).__init__(*args, **options)

        init.__signature__ = inspect.signature(lambda self: None)  # type: ignore[attr-defined]  # as it was
        type.__setattr__(kind, "__init__", init)
        return target

    return decorate


class NamedType:
    """Public name of a type that is no class, for annotations and ``isinstance``; a call says what to call instead.

    The name may also be joined with other types by ``|``.
    """

    def __init__(self, name: str, value: Any) -> None:
        self.__name__ = name
        self.__value__ = value

    def __call__(self, *_: object, **__: object) -> NoReturn:
        parts = typing.get_args(self.__value__)
        if isinstance(parts[0], list):  # the types of a function's arguments
            instead = f"give a function of ({', '.join(part.__name__ for part in parts[0])})"
        else:
            *others, last = [part.__name__ for part in parts]
            instead = f"use {', '.join(others)} or {last}"
        raise AmiwarpError(f"{self.__name__} is a type for annotations; {instead}")

    def __instancecheck__(self, value: object) -> bool:
        return isinstance(value, self.__value__)

    def __subclasscheck__(self, kind: type) -> bool:
        return issubclass(kind, self.__value__)

    def __or__(self, other: Any) -> Any:
        return self.__value__ | other

    def __ror__(self, other: Any) -> Any:
        return other | self.__value__

    def __repr__(self) -> str:
        return f"amiwarp.{self.__name__}"


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
    bases = [base for base in reversed(target.__mro__[:-1]) if not getattr(base, "_is_protocol", False)]
    for name, member in {name: one for base in bases for name, one in vars(base).items()}.items():
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
    found = [(name, _Parameter(function, label, name, numbers_too)) for name in names]
    positional = [(first + k, one) for k, (_, one) in enumerate(found[: code.co_argcount - first]) if one.guarded]
    named = {name: one for name, one in found if one.guarded}
    if not named:
        return function

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        given = args
        for index, parameter in positional:
            if index < len(args) and type(args[index]) not in parameter.known:
                plain = parameter.check(args[index])
                given = given if plain is args[index] else (*given[:index], plain, *given[index + 1 :])
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


class _Parameter:
    """Parameter of a guarded function."""

    def __init__(self, function: Any, label: str, name: str, numbers_too: bool) -> None:
        self._function, self._label, self._name = function, label, name
        self.known = set[type]()  # types of which each instance is accepted
        annotation = function.__annotations__.get(name, "Any")
        assert isinstance(annotation, str), f"{function.__module__} needs: from __future__ import annotations"
        words = frozenset(re.findall(r"[A-Za-z]\w*", annotation))
        self._number = numbers_too and words <= _NUMBERS
        of_record = numbers_too and function.__name__ == "__init__"
        self._text = of_record and words in _TEXT
        self._numbers = of_record and words in _SOME_NUMBERS
        self._numbers_too = numbers_too
        self._words = _WORDS.fullmatch(annotation) is not None
        plain = words <= _PLAIN and not (self._number or self._numbers or self._text or self._words)
        self.guarded = name == "device" or not plain
        self._arrays = "NDArray" in words and words.isdisjoint(("Callable", "Mapping", "dict", "tuple"))
        last = (function.__kwdefaults__ or {}).get(name, ...)
        self._optional = last is None or (words > {"None"} and words <= _PLAIN)

    @functools.cached_property
    def _kind(self) -> Any:
        """The annotated type."""
        names = self._function.__globals__
        return eval(self._function.__annotations__[self._name], names, _PublicNames(names))

    def check(self, value: Any) -> Any:
        """Return the value, or raise :class:`AmiwarpError` if it is not of the type.

        NumPy's numbers become plain ones. Where a sequence of words is expected, one word or a list becomes a tuple.
        """
        if self._words:
            value = as_words(value)
            if not self._numbers_too:  # the record checks its words, which it knows
                return value
        if (value is None and self._optional) or (self._arrays and _fits_array(value)):
            return value
        kind = self._kind
        if self._number:
            if type(value) is int and INT64[0] <= value <= INT64[1]:
                return value  # a shortcut
            what, floating = f"{self._label}: {self._name}", float in (kind, *typing.get_args(kind))
            hint = TIME_HINT if self._name == "t" or self._name.startswith("t_") else ""
            found = real(value, what) if floating else whole(value, what, *INT64, hint)
            return found if isinstance(value, np.generic | np.ndarray) else value
        if self._name == "device":
            unmet = _no_device(value, kind, here="workers" not in self._function.__annotations__)
        else:
            unmet = _unmet("text" if self._text else kind, value)
        if unmet:
            words, kinds = re.findall(r"\w+", unmet), {base.__name__ for base in type(value).__mro__}
            if isinstance(value, str | os.PathLike):
                kinds = {"path"}
            elif isinstance(value, np.ndarray) and value.dtype.names is not None:
                kinds = {"structured array"}
            hints = [text for (given, wanted), text in _REMEDIES.items() if given in kinds and wanted in words]
            hint = "".join(f"; {text}" for text in sorted(hints))
            raise AmiwarpError(f"{self._label}: {self._name} is {shown(value)}; expected {unmet}{hint}")
        if isinstance(value, bool | None) or type(value).__module__.startswith("amiwarp."):
            self.known.add(type(value))
        return value


class _PublicNames(dict[str, Any]):
    """Names in annotations that a module imports for type checkers only."""

    def __init__(self, module: dict[str, Any]) -> None:
        self._module = module

    def __missing__(self, name: str) -> Any:
        if name in self._module or hasattr(builtins, name):
            raise KeyError(name)
        for place in (collections.abc, typing, np.typing):
            if hasattr(place, name):
                return getattr(place, name)
        return getattr(sys.modules["amiwarp"], name, Any)  # Any for types of libraries that are imported where used


def _unmet(kind: Any, value: Any) -> str:
    """Return what a type expects, in words, if a value does not fit; else an empty text."""
    origin, parts = typing.get_origin(kind) or kind, typing.get_args(kind)
    if hasattr(origin, "__value__"):  # a named type, as NDArray and ArrayLike are from NumPy 2.5 on
        return _unmet(origin.__value__, value)
    if origin in (typing.Union, types.UnionType):
        paths = {os.PathLike, Path} & {typing.get_origin(part) or part for part in parts}
        words = list(dict.fromkeys(_unmet(part, value) for part in parts if not (paths and part is str)))
        return "" if "" in words else " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
    if origin in _CHECKS:
        fits, wording = _CHECKS[origin]
        return "" if fits(value) else wording
    if not isinstance(origin, type) or issubclass(origin, enum.Enum | int | float | str):
        return ""
    if issubclass(origin, collections.abc.Mapping):
        whole_mapping = isinstance(value, collections.abc.Mapping) and all(isinstance(key, str) for key in value)
        return _unmet_entries("mapping (dict) by names", parts[1:], value.values() if whole_mapping else None)
    if issubclass(origin, tuple | list) or origin is collections.abc.Sequence:
        return _unmet_entries("tuple or list", parts[:1], value if isinstance(value, list | tuple) else None)
    if getattr(origin, "_is_protocol", False):
        return "" if _has_members(origin, value) else origin.__name__
    library = origin.__module__.partition(".")[0] + "."
    return "" if isinstance(value, origin) else f"{library}{origin.__name__}".removeprefix("amiwarp.")


def _unmet_entries(what: str, kinds: Sequence[Any], entries: Iterable[Any] | None) -> str:
    """Return what a container expects, in words, if it or one of its entries does not fit; else an empty text."""
    unmet = (_unmet(_INSIDE.get(kind, kind), entry) for entry in entries or () for kind in kinds)
    return what if entries is None else next((f"{what}, each {words}" for words in unmet if words), "")


def _has_members(protocol: Any, value: Any) -> bool:
    """Return whether a value has what a protocol names, without calling its properties."""
    if protocol in type(value).__mro__:
        return True
    every = {name for base in protocol.__mro__ if getattr(base, "_is_protocol", False) for name in vars(base)}
    names = {name for name in every if name[0] != "_" or name in ("__getitem__", "__len__")}
    held = getattr(value, "__dict__", {})
    simple = isinstance(value, type) or type(value).__module__ == "builtins"
    return not simple and all(hasattr(type(value), name) or name in held for name in names)


_INSIDE: dict[Any, Any] = {float: "number", str: "text"}  # in a container, plain values are checked too
INT64 = -(1 << 63), (1 << 63) - 1  # limits of whole numbers whose range the function does not state


def _fits_number(value: Any) -> bool:
    with contextlib.suppress(AmiwarpError):
        real(value, "")
        return True
    return False


def _fits_array(value: Any) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.dtype.kind in "biuf"
        and (type(value) is np.ndarray or not np.ma.is_masked(value))
    )


def _fits_path(value: Any) -> bool:
    with contextlib.suppress(Exception):  # other classes may raise anything
        plain = os.fspath(value)
        check_name_lengths(Path(plain))
        return b"\0" not in os.fsencode(plain) and isinstance(plain, str)
    return False


_CHECKS: dict[Any, tuple[Callable[[Any], bool], str]] = {
    bool: (lambda value: isinstance(value, bool | np.bool_), "True or False"),
    types.NoneType: (lambda value: value is None, "None"),
    **dict.fromkeys(
        (os.PathLike, Path), (_fits_path, f"a path without null bytes and with names of at most {LONGEST_NAME} bytes")
    ),
    np.ndarray: (_fits_array, "a NumPy array of numbers without masked values"),
    collections.abc.Callable: (callable, "a function"),
    collections.abc.Iterable: (lambda value: np.iterable(value) and not isinstance(value, str), "an iterable"),
    "number": (_fits_number, "a finite number"),
    "text": (lambda value: isinstance(value, str), "a text"),
}
"""Check of a value, and what it expects in words, by type."""


def _no_device(value: Any, kind: Any, *, here: bool) -> str:
    """Return the devices, in words, if a value names none of them. ``here``: this machine must have the device."""
    if not here:
        fits = isinstance(value, str) and re.fullmatch(r"cpu|cuda(:\d+)?", value)
        return "" if fits else "a device, such as cpu or cuda:0"
    import warp as wp

    with contextlib.suppress(Exception):  # Warp raises several kinds of errors
        if isinstance(value, str if kind is str else str | wp.Device):
            wp.get_device(value)
            return ""
    return f"a device of this machine; choose among {', '.join(device.alias for device in wp.get_devices())}"


def check_name_lengths(path: Path, longest: int = LONGEST_NAME) -> None:
    """Raise :class:`AmiwarpError` if a name in a path, or the path, is too long for a file system.

    ``longest``: limit of each name [bytes].
    """
    for name in path.parts:
        if len(os.fsencode(name)) > longest:
            what = f"the name {name}" if len(path.parts) > 1 else "the name"
            raise AmiwarpError(
                f"{path}: {what} has {len(os.fsencode(name))} bytes; the limit is {longest}; give a shorter name"
            )
    if len(os.fsencode(path)) > LONGEST_PATH:
        raise AmiwarpError(
            f"{path}: the path has {len(os.fsencode(path))} bytes; the limit is {LONGEST_PATH}; give a shorter path"
        )


def check_names(given: Collection[str], known: Collection[str], what: str) -> None:
    """Raise :class:`AmiwarpError`, which names the nearest known name, if a given name is none of the known ones."""
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(str(name), known, 1)
            meant = f"did you mean {near[0]}?" if near else f"choose among {', '.join(known)}"
            raise AmiwarpError(f"{what}{shown(name)[1:-1]} is unknown; {meant}")


def check_slice(start: int, stop: int) -> None:
    """Raise :class:`AmiwarpError` for a negative index in ``slice``, which counts from the first event."""
    if min(start, stop) < 0:
        raise AmiwarpError(
            f"slice({start}, {stop}) has a negative index, and counts from the first event; events[-5:] are the last "
            "five, as of a list"
        )
