"""Copying of packets into the columns of a batch: by NumPy, or for long batches by several threads of native code."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.recording import Events
from amiwarp.kernels.launch import RecordedLaunch
from amiwarp.kernels.packet_copy import COUNT, FOUND, ROW, SOURCES, TARGETS, gather_parts
from amiwarp.kernels.workers import pool
from amiwarp.workarounds import address, pointer_places

PIECE = 1 << 17
"""Number of events from which several threads copy a batch, and into which longer packets are cut."""
THREADS = 2
"""Number of threads that copy a long batch together with the calling thread."""
CALLER_SHARE = 8
"""Share of the packets that the calling thread copies: one packet in eight.

While its native code runs, the other threads can take Python's lock and start. Without packets to copy, the caller
would keep the lock, and the threads would start only once the caller waits for them.
"""
COLUMNS = ("x", "y", "t", "p")
"""Columns of a packet, in the order in which they are copied."""
WIDTHS = (2, 2, 8, 1)
"""Bytes per event of each column."""


class ColumnCheck(NamedTuple):
    """Properties of packets that are found while they are copied."""

    unsorted: bool
    """Whether the times decrease within any packet."""
    max_x: int
    """Largest x of all events [px]."""
    max_y: int
    """Largest y of all events [px]."""


def join_packets(parts: list[Events], targets: list[NDArray[Any]]) -> ColumnCheck:
    """Copy packets into the columns x, y, t and, if it is given, p. Times must not decrease between packets."""
    for name, column in zip(COLUMNS, targets, strict=False):
        if len(parts) == 1:  # faster by 1 us for each column
            column[:] = getattr(parts[0], name)
        else:
            np.concatenate([getattr(part, name) for part in parts], out=column)
    x, y, t, *_ = targets
    falls = t[1:] < t[:-1]
    return ColumnCheck(
        unsorted=bool(falls.any()),
        max_x=int(x.max()),
        max_y=int(y.max()),
    )


class PacketCopier:
    """Does what :func:`join_packets` does by several threads, see :mod:`amiwarp.kernels.packet_copy`.

    Threads that call NumPy would wait for Python's lock at each column of each packet. One copy at a time.
    """

    def __init__(self) -> None:
        """Allocate a table for batches of up to 64 packets, which grows with longer ones."""
        self._allocate(64)

    def _allocate(self, rows: int) -> None:
        """Allocate a table of copies with ``rows`` rows."""
        table = wp.zeros(rows * ROW, dtype=wp.uint64, device="cpu")
        found = wp.zeros(rows * FOUND, dtype=int, device="cpu")
        self._table = table.numpy().reshape(-1, ROW)
        self._found = found.numpy().reshape(-1, FOUND)
        # A command for the caller and for each thread, because a command runs once at a time.
        self._commands = []
        for _ in range(1 + THREADS):
            command = RecordedLaunch(gather_parts, [table, found, 0], [], device="cpu")
            self._commands.append(command)

    def __call__(
        self, parts: list[Events], targets: list[NDArray[Any]]
    ) -> Callable[[], ColumnCheck]:
        """Start to copy packets; return a function that waits. Call it before the next copy."""
        rows = len(parts)
        if rows > len(self._table):
            self._allocate(2 * rows)
        kept_alive = self._fill_table(parts, targets)

        # The first rows are the caller's, the others are divided among the threads.
        caller, *others = self._commands
        ours = rows // CALLER_SHARE
        theirs = rows - ours
        edges = [ours + theirs * k // THREADS for k in range(THREADS + 1)]
        jobs = []
        for command, (start, stop) in zip(others, pairwise(edges), strict=True):
            jobs.append(pool().submit(command, start, stop - start))
        caller(0, ours)
        return partial(self._wait, jobs, rows, kept_alive)

    def _fill_table(self, parts: list[Events], targets: list[NDArray[Any]]) -> list[Any]:
        """Fill a row for each packet: where its columns are, where they go to, and how many events it has.

        Return what must be kept alive until the packets are copied.
        """
        counts = np.array([part.t.size for part in parts])
        offsets = np.concatenate([[0], np.cumsum(counts)[:-1]])
        table = self._table[: len(parts)]
        table[:] = 0
        kept_alive = []
        for k, column in enumerate(targets):
            columns = [getattr(part, COLUMNS[k]) for part in parts]
            places, alive = pointer_places(columns)
            table[:, SOURCES + k] = places
            table[:, TARGETS + k] = address(column) + WIDTHS[k] * offsets
            kept_alive.append(alive)
        table[:, COUNT] = counts
        return kept_alive

    def _wait(self, jobs: list[Future[None]], rows: int, _kept: object) -> ColumnCheck:
        """Wait for the copy of ``rows`` packets.

        Their columns are kept alive until then by an argument that is not used, because threads only have addresses.
        """
        for job in jobs:
            job.result()
        largest = self._found[:rows].max(axis=0)
        unsorted, max_x, max_y = largest.tolist()
        return ColumnCheck(bool(unsorted), max_x, max_y)
