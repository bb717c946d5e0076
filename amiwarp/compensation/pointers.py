"""Pointers to the values of many small NumPy arrays, for native code.

A batch of 104 packets has 416 arrays. NumPy's public interface needs 1 to 1.5 us per address, so that copying such a
batch of 10,000 events per packet takes 1.13 ms on two cores. It takes 0.68 ms with :func:`pointers_in_place`, which
needs 0.04 us per array, because native code then reads the pointer out of NumPy's array object itself. With a GPU the
whole batch takes 1.1 to 1.4 ms (``docs/explanation/performance.md``, Streams), and the host is the bottleneck.

Reading from the array object depends on how NumPy lays out its objects. :func:`layout_is_known` tests that once.
:func:`listed_pointers`, which uses the public interface only, serves every other NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from ctypes import c_uint64
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

HEAD = object.__basicsize__
"""Offset of the pointer to the values in NumPy's array object (``PyArrayObject_fields`` in its C interface) [bytes]."""


@dataclass(frozen=True, slots=True)
class Pointers:
    """Pointers to the values of several arrays, in memory that native code can read."""

    at: NDArray[np.uint64]
    """Address at which each pointer is stored, shape ``(n,)``."""
    owners: object
    """Objects that own the pointers and the values. Keep these objects until native code has finished."""


FindPointers: TypeAlias = Callable[[list[NDArray[Any]]], Pointers]


def address(array: NDArray[Any]) -> int:
    """Return the address of an array's first value."""
    return int(array.__array_interface__["data"][0])


def listed_pointers(arrays: list[NDArray[Any]]) -> Pointers:
    """Return copies of the arrays' pointers in a new array, read through NumPy's public interface."""
    values = np.array([address(array) for array in arrays], np.uint64)
    return Pointers(
        np.uint64(address(values)) + np.uint64(8) * np.arange(len(arrays), dtype=np.uint64), (values, arrays)
    )


def pointers_in_place(arrays: list[NDArray[Any]]) -> Pointers:
    """Return the addresses at which NumPy's array objects store the pointers to their values.

    Nothing is copied. Use this function only if :func:`layout_is_known` returns True.
    """
    return Pointers(np.array(list(map(id, arrays)), np.uint64) + np.uint64(HEAD), arrays)


@cache
def layout_is_known() -> bool:
    """Return whether this NumPy keeps the pointer to an array's values at :data:`HEAD`."""
    probe = np.zeros(1)
    return bool(c_uint64.from_address(id(probe) + HEAD).value == address(probe))


def fastest() -> FindPointers:
    """Return :func:`pointers_in_place` if it works with the installed NumPy, else :func:`listed_pointers`."""
    return pointers_in_place if layout_is_known() else listed_pointers
