"""Copying of event packets into long columns, by threads of native code."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.compensation.pointers import FindPointers, Pointers, fastest
from amiwarp.events.events import Events
from amiwarp.kernels.launch import RecordedLaunch, pool
from amiwarp.kernels.packet_copy import FOUND, ROW, gather_parts

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
        """Set the function that finds the arrays' memory, see :mod:`amiwarp.compensation.pointers`."""
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
