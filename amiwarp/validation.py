"""Checks of single values given by users.

Each check returns the value in its plain type, or raises :class:`AmiwarpError` that says what was expected.
"""

from __future__ import annotations

import enum
import math
import numbers
import reprlib
from collections.abc import Callable, Collection
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError

Choice = TypeVar("Choice", bound=enum.StrEnum)
"""Type variable: an enumeration whose members have names."""

Kind = TypeVar("Kind")
"""Type variable: any class."""

UNUSABLE = (TypeError, ValueError, OverflowError, RecursionError)
"""Exceptions that Python and NumPy raise for values of unexpected types."""

HOST_MEMORY = (1, 3)
"""DLPack's numbers of devices in host memory: CPU, and pinned memory of CUDA."""

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
        raise AmiwarpError(f"{what} = {shown(plain)} is not {_range('a whole number', low, high)}{hint}")
    return int(plain)


def vector(value: object, count: int, what: str, check: Callable[[object, str], float]) -> tuple[float, ...]:
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
