"""Layout of files of plain columns: which column is which, the unit of time, and the coding of polarity.

Here it is applied to the columns of a file. :func:`amiwarp.io.columns.search.find_layout` finds it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import MetadataValue
from amiwarp.io.assumptions import Assumption
from amiwarp.io.columns.options import TIME_UNITS
from amiwarp.io.event_packets import Packet, whole_pixels
from amiwarp.validation import TIME_LIMIT, rounded_times

SAMPLE = 1 << 16
"""Number of events from which a layout is found."""


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a file."""

    name: str | None
    """Its name, or None."""
    values: NDArray[Any]
    """Its first values, up to :data:`SAMPLE` of them."""
    unit: str | None = None
    """Unit of time that the file states for it, or None."""


@dataclass(frozen=True, slots=True)
class Hints:
    """What a format promises, or a file states elsewhere."""

    order: tuple[str, ...] | None = None
    """Order of columns without names, if the format promises it."""
    unit: str | None = None
    """Unit of time that the format promises."""
    fractions: str | None = None
    """Unit of times with fractions that the format promises."""
    compensated: bool = False
    """Whether x and y with fractions belong to compensated events."""
    is_text: bool = False
    """Whether the file is text, which OpenMV does not write."""
    is_own: bool = False
    """Whether the layout is amiwarp's own in all details: its promised unit is believed for any rate, and x and y in
    pixels."""


Coding: TypeAlias = Mapping[int, bool]
"""For each value of the polarity whether it is ON."""

ZERO_OR_ONE: Coding = {0: False, 1: True}
"""Coding of which 1 is ON and 0 is OFF."""

SIGNED: Coding = {-1: False, 0: False, 1: True}
"""Coding of which 1 is ON, and 0 or -1 is OFF."""

UNSIGNED_MINUS_ONE = (255, 2**16 - 1, 2**32 - 1, 2**64 - 1)
"""Values of -1 in unsigned integers."""


def is_plain_polarity(p: NDArray[Any]) -> bool:
    """Return whether values of the polarity are 1 for ON, 0 or -1 for OFF."""
    if p.dtype == np.bool_:
        return True
    if p.dtype.kind == "u" and int(p.max(initial=0)) <= 1:
        return True
    values = np.unique(p).tolist()
    return set(values).issubset(SIGNED)


@dataclass(frozen=True, slots=True)
class Layout:
    """Meaning of a file's columns."""

    columns: Mapping[str, int]
    """Index of the column of each role. The events of OpenMV have two further columns of time."""
    unit: str
    """Unit of time."""
    coding: Coding
    """Meaning of the values of the polarity."""
    scale: int = 1
    """Number by which x and y are divided."""
    compensated: bool = False
    """Whether fractions of x and y are kept."""
    assumptions: tuple[Assumption, ...] = ()
    """What the file does not state."""
    openmv: bool = False
    """Whether the columns are type, s, ms, us, x and y, as OpenMV writes them."""
    unit_is_assumed: bool = False
    """Whether the unit was inferred from whole numbers."""
    is_promised: bool = False
    """Whether the file has a documented layout, and nothing was assumed."""
    names: Mapping[str, str] = field(default_factory=dict)
    """Name or number of the column of each role, for the metadata."""
    rounded_times: str | None = None
    """What a program that wrote the text has rounded times to, or None."""

    @property
    def chosen(self) -> tuple[int, ...]:
        """Indices of the columns that are read, in the order of :meth:`events`."""
        return tuple(self.columns.values())

    @property
    def metadata(self) -> dict[str, MetadataValue]:
        """Columns, unit and assumptions, for the metadata of a recording; empty for a layout that a format promises."""
        metadata: dict[str, MetadataValue] = {}
        if not self.is_promised:
            metadata["columns"] = ", ".join(f"{role} = {name}" for role, name in self.names.items())
            metadata["time_unit"] = self.unit
        if self.rounded_times is not None:
            metadata["rounded_times"] = self.rounded_times
        if not self.is_promised:
            metadata |= [assumption.entry for assumption in self.assumptions]
        return metadata

    def events(self, *columns: NDArray[Any], notes: dict[str, int]) -> Packet:
        """Return the events of the columns in the order of :attr:`chosen`. Counts go to ``notes``."""
        if self.openmv:
            return self._openmv_events(columns, notes)
        return self.columns_of_events(*columns)

    def columns_of_events(
        self,
        t: NDArray[Any],
        x: NDArray[Any],
        y: NDArray[Any],
        p: NDArray[Any],
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.int64], NDArray[np.uint8]]:
        """Return x, y [px], t [us] and p of the columns t, x, y and p."""
        return self.pixels(x), self.pixels(y), self.times(t), self.polarities(p)

    def times(self, t: NDArray[Any]) -> NDArray[np.int64]:
        """Return times [us]."""
        factor = TIME_UNITS[self.unit]
        if self.unit == "ns":
            return self._times_of_nanoseconds(t)
        if t.dtype.kind == "f":
            with np.errstate(over="ignore"):
                return rounded_times(t.astype(np.float64) * factor)
        if self.unit == "us":
            return rounded_times(t)
        if t.size:
            earliest = int(t.min())
            latest = int(t.max())
            if max(abs(earliest), abs(latest)) * factor >= TIME_LIMIT:
                raise AmiwarpError(
                    f"times reach {latest} {self.unit}, beyond int64 in us; the unit must be another"
                )
        return t.astype(np.int64) * int(factor)

    def _times_of_nanoseconds(self, t: NDArray[Any]) -> NDArray[np.int64]:
        """Return times [us] of times [ns]: half a microsecond is rounded up, for integers and floating numbers."""
        if t.dtype.kind == "f":
            t = t.astype(np.float64)
        elif t.size and int(t.max()) >= 2**63:
            raise AmiwarpError(
                f"a time is {int(t.max())} ns, beyond int64; the file is damaged",
                ErrorCode.FILE_DAMAGED,
            )
        else:
            t = t.astype(np.int64)
        # Times that are not finite are refused.
        with np.errstate(invalid="ignore"):
            return rounded_times(t // 1000 + (t % 1000 >= 500))

    def pixels(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return coordinates [px]: integers, or floating ones of compensated events."""
        if self.compensated and values.dtype.kind == "f":
            return values / self.scale if self.scale > 1 else values
        whole = whole_pixels(values) if values.dtype.kind == "f" else values
        if self.scale == 1:
            return whole
        scaled, rest = np.divmod(whole, self.scale)
        if rest.any():
            raise AmiwarpError(
                f"a coordinate is {int(whole[rest != 0][0])}, no multiple of {self.scale}; give another --scale-xy"
            )
        return np.asarray(scaled)

    def polarities(self, p: NDArray[Any]) -> NDArray[np.uint8]:
        """Return polarities: 1 for ON, 0 for OFF. Raises :class:`AmiwarpError` for a value without a meaning."""
        if p.dtype == np.bool_:
            p = p.view(np.uint8)
        on = np.zeros(p.shape, np.bool_)
        known = np.zeros(p.shape, np.bool_)
        for value, is_on in self.coding.items():
            if _fits(value, p.dtype):
                has_value = p == value
                known |= has_value
                if is_on:
                    on |= has_value
        if not known.all():
            raise AmiwarpError(
                f"a polarity is {p[~known][0]}; expected {listed(self.coding)}; say what it means with --polarity, "
                "such as 1=on,2=off",
                ErrorCode.AMBIGUOUS,
            )
        return on.view(np.uint8)

    def _openmv_events(self, columns: Sequence[NDArray[Any]], notes: dict[str, int]) -> Packet:
        """Return the events of OpenMV's columns: type, s, ms, us, x, y. Types from 2 on are no events of pixels."""
        kind, s, ms, us, x, y = (values.astype(np.int64) for values in columns)
        t = s * 1_000_000 + ms * 1000 + us
        is_event = kind <= 1
        others = int(np.count_nonzero(~is_event))
        notes["other_records"] = notes.get("other_records", 0) + others
        return x[is_event], y[is_event], t[is_event], kind[is_event]


def _fits(value: int, dtype: np.dtype[Any]) -> bool:
    """Return whether an array of this type can hold a value."""
    if dtype.kind == "f":
        return True
    limits = np.iinfo(dtype)
    return int(limits.min) <= value <= int(limits.max)


def listed(values: Iterable[int]) -> str:
    return ", ".join(str(value) for value in sorted(values))
