"""Checks of values given by users.

Each check of a single value returns it in its plain type, or raises :class:`AmiwarpError` that says what was expected.
"""

from __future__ import annotations

import difflib
import enum
import math
import numbers
import os
import reprlib
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError

Choice = TypeVar("Choice", bound=enum.StrEnum)
Number = TypeVar("Number", int, float)
Kind = TypeVar("Kind")
"""Type variables: an enumeration whose members have names, a plain number, and any class."""

UNUSABLE = (TypeError, ValueError, OverflowError, RecursionError)
"""Exceptions that Python and NumPy raise for values of unexpected types."""

HOST_MEMORY = (1, 3)
"""DLPack's numbers of devices in host memory: CPU, and pinned memory of CUDA."""

LONGEST_NAME = 255
LONGEST_PATH = 4095
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


def real(
    value: object, what: str, low: float = -math.inf, high: float = math.inf, hint: str = ""
) -> float:
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
        raise AmiwarpError(
            f"{what} = {shown(plain)} is not {_range('a finite number', low, high)}{hint}"
        )
    return number


def whole(value: object, what: str, low: int, high: int, hint: str = "") -> int:
    """Return a whole number within ``low`` .. ``high``, both included, as int.

    Accepts integers of Python and NumPy, but neither floats nor truth values. Raises :class:`AmiwarpError`, whose
    message ends in ``hint``.
    """
    if type(value) is int and low <= value <= high:
        return value  # a shortcut: tensors of few events take less time than the checks below
    plain = _scalar(value)
    if (
        isinstance(plain, bool)
        or not isinstance(plain, numbers.Integral)
        or not low <= int(plain) <= high
    ):
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


def vector(
    value: object, count: int, what: str, check: Callable[[object, str], Number]
) -> tuple[Number, ...]:
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
        raise AmiwarpError(
            f"{what} has masked values; leave those rows out of all arrays, as in values[~mask]"
        )
    if on_gpu(value):
        raise AmiwarpError(
            f"{what} is on a GPU; copy it to the host, or give events as amiwarp.DeviceEvents"
        )
    try:
        found = np.asarray(
            value
            if not hasattr(value, "__dlpack__") or _numpy_reads(value)
            else np.from_dlpack(value)
        )
    except UNUSABLE:
        found = np.zeros(0, object)
    except (
        RuntimeError,
        BufferError,
    ) as error:  # such as a tensor of PyTorch that requires a gradient
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
    if values.ndim == 1 and len(values) > 1 and values.flags.carray:
        return values
    return np.require(values, requirements=["C", "A"]).reshape(-1).reshape(values.shape)


def finite(values: NDArray[Any], what: str, hint: str = "give finite numbers") -> NDArray[Any]:
    """Return an array without NaN and infinite values; raise :class:`AmiwarpError` that names the first one."""
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        first_bad = int(np.argmax(~np.isfinite(values)))
        raise AmiwarpError(f"{what} hold {values.flat[first_bad]} (number {first_bad}); {hint}")
    return values


TIME_LIMIT = 2**62
"""Limit of the magnitude of times of events, encoder samples and index pulses [us]: 146,000 years.

The difference and the sum of any two times then fit int64.
"""

TIME_HINT = "; times are whole microseconds (int64): give 100_000 for 0.1 s"
"""End of the message for a time that is no whole number."""

TIME_UNITS = {"us": 1.0, "s": 1e6}
"""Microseconds in each unit of times that arrays may have."""

FRACTION_OF_US = (
    "times are whole microseconds; for seconds, give t_unit='s' (events) or np.rint(t * 1e6)"
)
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
        first_bad = int(np.argmax(times != scaled))
        raise AmiwarpError(
            f"{what} hold {scaled.flat[first_bad]:.9g} (number {first_bad}): {FRACTION_OF_US}"
        )
    if times.size and max(-int(times.min()), int(times.max())) > limit:
        raise AmiwarpError(
            f"{what} reach {np.abs(times).max()} us, and {given.dtype} {COARSE_TIMES}"
        )
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
        first_bad = int(np.argmin(later)) + 1
        raise AmiwarpError(
            f"{what} {first_bad} ({t[first_bad]} us) is not later than the one before; sort by time"
        )


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


INT64 = -(1 << 63), (1 << 63) - 1
"""Smallest and largest whole number where no range is stated."""


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
