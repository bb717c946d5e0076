"""Copying of event packets into long columns, by threads of native code."""

from __future__ import annotations

import heapq
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from ctypes import c_uint64
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.events import Events
from amiwarp.kernels.launch import RecordedLaunch, pool
from amiwarp.kernels.packet_copy import FOUND, ROW, gather_parts

# Pointers to the values of many small NumPy arrays, for native code.
#
# A batch of 104 packets has 416 arrays. NumPy's public interface needs 1 to 1.5 us per address, so that copying such a
# batch of 10,000 events per packet takes 1.13 ms on two cores. It takes 0.68 ms with :func:`pointers_in_place`, which
# needs 0.04 us per array, because native code then reads the pointer out of NumPy's array object itself. With a GPU the
# whole batch takes 1.1 to 1.4 ms (``docs/explanation/performance.md``, Streams), and the host is the bottleneck.
#
# Reading from the array object depends on how NumPy lays out its objects. :func:`layout_is_known` tests that once.
# :func:`listed_pointers`, which uses the public interface only, serves every other NumPy.

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


PIECE = 1 << 17
"""Number of events from which several threads copy a batch, and largest number of events per row of the table of
copies."""
THREADS = 2
"""Number of threads that copy a long batch together with the calling thread."""
CALLER_SHARE = 8
"""Share of the packets that the calling thread copies: one packet in eight.

While its native code runs, the other threads can take Python's lock and start. Without packets to copy, the caller
would keep the lock, and the threads would start only once the caller waits for them.
"""
WIDTHS = (2, 2, 8, 1)
"""Bytes per event of x, y, t and p."""


class ColumnCheck(NamedTuple):
    """Properties of packets that are found while they are copied."""

    unsorted: bool
    """Whether the times decrease within any packet."""
    max_x: int
    """Largest x of all events [px]."""
    max_y: int
    """Largest y of all events [px]."""


@dataclass(frozen=True, slots=True, eq=False)
class CopyInProgress:
    """Copy of packets on which threads are working."""

    jobs: list[Future[None]]
    found: NDArray[np.int32]
    """Results of the threads for each packet, shape (packets, 3): whether unsorted, largest x, largest y [px]."""
    sources: list[Pointers]
    """References that keep the packets' memory alive, because the threads only have addresses."""

    def wait(self) -> ColumnCheck:
        """Wait until all packets are copied, and return their properties."""
        for job in self.jobs:
            job.result()
        unsorted, max_x, max_y = self.found.max(axis=0).tolist()
        return ColumnCheck(bool(unsorted), max_x, max_y)


class PacketCopier:
    """Copies many packets by several threads, see :mod:`amiwarp.kernels.packet_copy`. One copy at a time."""

    def __init__(self, find_pointers: FindPointers | None = None) -> None:
        """Set the function that finds the arrays' memory, see :mod:`amiwarp.compensation.packet_copy`."""
        self._find_pointers = find_pointers or fastest()
        self._allocate(64)

    def _allocate(self, rows: int) -> None:
        """Allocate a table of copies with ``rows`` rows."""
        table, found = (
            wp.zeros(rows * ROW, dtype=wp.uint64, device="cpu"),
            wp.zeros(rows * FOUND, dtype=int, device="cpu"),
        )
        self._table, self._found = table.numpy().reshape(-1, ROW), found.numpy().reshape(-1, FOUND)
        self._commands = [RecordedLaunch(gather_parts, [table, found], [], device="cpu") for _ in range(1 + THREADS)]

    def __call__(self, parts: list[Events], n: int, to: list[int], *, with_p: bool) -> CopyInProgress:
        """Start to copy all ``n`` events of ``parts`` to the addresses ``to`` of the columns x, y, t and p.

        Polarities (p) are copied only if ``with_p`` is true. Call ``wait`` of the result before the next copy.
        """
        follows: Any = 0  # whether a row's first event directly follows the last of the row before in memory
        counts = np.array([part.t.size for part in parts])
        if counts.max() > PIECE:
            parts, follows = _cut(parts)
            counts = np.array([part.t.size for part in parts])
        if len(parts) > len(self._table):
            self._allocate(2 * len(parts))
        columns = [_contiguous([getattr(part, name) for part in parts]) for name in ("x", "y", "t", "p")]
        sources = [self._find_pointers(column) for column in columns]
        table = self._table[: len(parts)]
        offsets = np.concatenate([[0], np.cumsum(counts)[:-1]])
        for k, (source, start, width) in enumerate(zip(sources, to, WIDTHS, strict=True)):
            table[:, k] = source.at
            table[:, 4 + k] = start + width * offsets if k < 3 or with_p else 0
        table[:, 8], table[:, 9] = counts, follows
        return CopyInProgress(self._run(len(parts), THREADS if n > PIECE else 0), self._found[: len(parts)], sources)

    def _run(self, rows: int, threads: int) -> list[Future[None]]:
        """Copy the calling thread's share of the packets, while background threads start to copy their shares."""
        ours = rows // CALLER_SHARE if threads else rows
        edges = [0, *(ours + (rows - ours) * k // max(threads, 1) for k in range(threads + 1))]

        def run(k: int) -> None:
            self._commands[k](edges[k], edges[k + 1] - edges[k])

        jobs = [pool().submit(run, k) for k in range(1, threads + 1)]
        run(0)
        return jobs


def _cut(parts: list[Events]) -> tuple[list[Events], list[int]]:
    """Cut packets into pieces of at most :data:`PIECE` events; return also 1 for each piece that continues a packet."""
    whole = [Events(*_contiguous([part.x, part.y, part.t, part.p])) for part in parts]
    cut = [(part[k : k + PIECE], int(k > 0)) for part in whole for k in range(0, len(part), PIECE)]
    return [piece for piece, _ in cut], [follows for _, follows in cut]


def _contiguous(columns: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Replace columns that have gaps in memory by contiguous copies."""
    return [column if column.flags.c_contiguous else np.ascontiguousarray(column) for column in columns]


# Reuse of page-locked host memory for results of a GPU.
#
# A GPU writes to page-locked memory at full speed, but allocating one such array takes a millisecond, and a batch needs
# five, while it is compensated in 1.1 to 1.4 ms (``docs/explanation/performance.md``, Streams). So arrays are reused
# once the caller has released them. If the caller keeps more than :data:`POOL_SIZE` of a type, ordinary memory is
# handed out.

POOL_SIZE = 16
"""Largest number of pooled arrays of each data type."""
PooledArray: TypeAlias = tuple[Any, NDArray[Any]]
"""Pooled Warp array, and the NumPy view of its first values that the caller gets."""


class PinnedPool:
    """Pool of page-locked host arrays. An array is reused once its user has dropped all views of it."""

    def __init__(self, size: int, *, pinned: bool = True) -> None:
        """Make a pool of arrays with at most ``size`` values. ``pinned``: page-lock the memory, which requires CUDA."""
        self._size, self._pinned = size, pinned
        self._arrays: dict[Any, list[Any]] = {np.int64: [], np.float32: [], np.uint8: []}
        self._free: dict[Any, list[int]] = {dtype: [] for dtype in self._arrays}  # numbers of the free arrays, as heaps

    def fill(self, counts: dict[Any, int]) -> None:
        """Allocate arrays in advance. ``counts``: number of arrays of each data type."""
        for dtype, count in counts.items():
            for _ in range(count):
                heapq.heappush(self._free[dtype], self._allocate(dtype))

    def _allocate(self, dtype: Any) -> int:
        """Allocate an array of the pool and return its number."""
        arrays = self._arrays[dtype]
        arrays.append(wp.empty(self._size, dtype=wp.dtype_from_numpy(dtype), device="cpu", pinned=self._pinned))
        return len(arrays) - 1

    def __call__(self, n: int, dtype: Any) -> PooledArray:
        """Return an array of ``n`` uninitialised values."""
        free = self._free[dtype]
        if not free and len(self._arrays[dtype]) >= POOL_SIZE:
            view = np.empty(n, dtype)
            return wp.array(view, dtype=wp.dtype_from_numpy(dtype), device="cpu", copy=False), view
        # the lowest number, so that few arrays are in use
        number = heapq.heappop(free) if free else self._allocate(dtype)
        array = self._arrays[dtype][number]
        # Not a slice: NumPy makes a slice of a slice refer to the base, and the pool would miss that it is in use.
        view = np.frombuffer(memoryview(array.numpy()), dtype, n)
        weakref.finalize(view, heapq.heappush, free, number).atexit = False
        return array, view
