"""Rows and records of a recording that are read on demand, from memory or from a file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, Protocol, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.validation import shown

Item = TypeVar("Item", covariant=True)
"""What a store returns: an array, or a record."""


class StoredRows(Protocol[Item]):
    """Protocol of rows that are read by slicing, in memory or in a file that is read on demand."""

    def __getitem__(self, which: slice, /) -> Item:
        """Return the rows in a slice without steps."""


class StoredInstants(Protocol[Item]):
    """Protocol of records at several times, in memory or in a file that is read on demand."""

    @property
    def t(self) -> NDArray[np.int64]:
        """Times of the records, on the clock of the events, in order [us], shape ``(k,)``."""

    def __len__(self) -> int:
        """Return the number of records."""

    def __iter__(self) -> Iterator[Item]:
        """Yield the records in order, one at a time."""

    @overload
    def __getitem__(self, which: int, /) -> Item: ...
    @overload
    def __getitem__(self, which: slice, /) -> StoredInstants[Item]: ...
    def __getitem__(self, which: int | slice, /) -> Item | StoredInstants[Item]:
        """Return the record at ``t[which]``, or the records of a slice, which are read on demand too.

        Negative indices count from the end.
        """


class Instants(Generic[Item]):
    """Records at several times: one by index, some by slice, or all one after the other."""

    def __init__(self, t: NDArray[np.int64]) -> None:
        """Take the times of the records [us], shape ``(k,)``."""
        self._t = t

    @property
    def t(self) -> NDArray[np.int64]:
        """Times of the records [us], shape ``(k,)``."""
        return self._t

    def _read(self, index: int) -> Item:
        """Return the record at ``t[index]``, where 0 <= index < k."""
        raise NotImplementedError

    def __len__(self) -> int:
        return len(self._t)

    def __iter__(self) -> Iterator[Item]:
        return map(self._read, range(len(self)))

    @overload
    def __getitem__(self, which: int, /) -> Item: ...
    @overload
    def __getitem__(self, which: slice, /) -> Instants[Item]: ...
    def __getitem__(self, which: int | slice, /) -> Item | Instants[Item]:
        every = range(len(self))
        try:
            found = every[which]
        except TypeError as error:
            raise AmiwarpError(
                f"index of a record is {shown(which)}; give a whole number or a slice"
            ) from error
        except IndexError as error:
            raise IndexError(f"index {which} is not one of {len(every)} records") from error
        if isinstance(found, int):
            return self._read(found)
        return _Slice(self, found)

    def __repr__(self) -> str:
        kind = type(self).__name__.lstrip("_")
        count = len(self)
        records = "record" if count == 1 else "records"
        span = f", t {self._t[0]} .. {self._t[-1]} us" if count else ""
        return f"{kind}({count:,} {records}{span})"


class _Slice(Instants[Item]):
    """Some of the records of a store."""

    def __init__(self, store: Instants[Item], which: range) -> None:
        super().__init__(store.t[np.array(which, np.int64)])
        self._store = store
        self._which = which

    @property
    def size(self) -> tuple[int, int]:
        """Size (width, height) of the frames [px], if the store has one."""
        size: tuple[int, int] = self._store.size  # type: ignore[attr-defined]
        return size

    @property
    def exposure(self) -> NDArray[np.int64] | None:
        """Begin and end of each exposure of the frames [us], shape ``(k, 2)``, or None."""
        exposure: NDArray[np.int64] | None = getattr(self._store, "exposure", None)
        return None if exposure is None else exposure[np.array(self._which, np.int64)]

    def _read(self, index: int) -> Item:
        return self._store._read(self._which[index])
