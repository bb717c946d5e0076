"""Packets of events put together to long columns, by threads of native code."""

from __future__ import annotations

from collections.abc import Callable
from ctypes import c_uint64
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.events import Events
from amiwarp.kernels.launch import Recorded, pool
from amiwarp.kernels.packet_copy import FOUND, ROW, gather_parts

PIECE, THREADS, OURS = 1 << 17, 2, 8
"""Of more events than that, an eighth of the packets is put together by the caller and the rest by two threads beside:
while it copies, they get Python's lock and begin. Otherwise they would wait until the caller waits for them."""
WIDTHS = (2, 2, 8, 1)
"""Bytes of x, y, t, p of an event."""
HEAD = object.__basicsize__
"""Bytes of an array's object before the address of its values, in NumPy's C interface (``PyArrayObject_fields``): to
ask NumPy for the address takes 1.5 us, of 100 packets' columns nearly as long as to copy them."""


class PacketCopier:
    """Puts packets together by several threads, see :mod:`amiwarp.kernels.packet_copy`."""

    def __init__(self) -> None:
        probe = np.zeros(1)
        if c_uint64.from_address(id(probe) + HEAD).value != address(probe):
            raise RuntimeError(f"NumPy {np.__version__} keeps its arrays' addresses elsewhere; use NumPy 2")
        self._make(64)

    def _make(self, rows: int) -> None:
        table, found = (
            wp.zeros(rows * ROW, dtype=wp.uint64, device="cpu"),
            wp.zeros(rows * FOUND, dtype=int, device="cpu"),
        )
        self._table, self._found = table.numpy().reshape(-1, ROW), found.numpy().reshape(-1, FOUND)
        self._commands = [Recorded(gather_parts, [table, found], [], device="cpu") for _ in range(1 + THREADS)]

    def __call__(
        self, parts: list[Events], n: int, to: list[int], *, with_p: bool
    ) -> Callable[[], tuple[bool, int, int]]:
        """Copies ``n`` events of the parts to where the addresses ``to`` say: of x, y, t and, if it is asked for, p.

        What it returns waits for it, and tells whether any part is unsorted, and the largest x and y. Not before that
        may this be called again.
        """
        goes_on: Any = 0  # whether a row's first event follows the last of the row before in memory
        counts = np.array([part.t.size for part in parts])
        if counts.max() > PIECE:
            parts, goes_on = _cut(parts)
            counts = np.array([part.t.size for part in parts])
        columns = [_plain([getattr(part, name) for part in parts]) for name in ("x", "y", "t", "p")]
        places = np.concatenate([[0], np.cumsum(counts)[:-1]])
        if len(parts) > len(self._table):
            self._make(2 * len(parts))
        table = self._table[: len(parts)]
        for k, (column, start, width) in enumerate(zip(columns, to, WIDTHS, strict=True)):
            table[:, k] = list(map(id, column))
            table[:, 4 + k] = start + width * places if k < 3 or with_p else 0
        table[:, :4] += np.uint64(HEAD)
        table[:, 8], table[:, 9] = counts, goes_on
        threads = THREADS if n > PIECE else 0
        ours = len(parts) // OURS if threads else len(parts)
        edges = [0, *(ours + (len(parts) - ours) * k // max(threads, 1) for k in range(threads + 1))]

        def run(k: int) -> None:
            self._commands[k](edges[k], edges[k + 1] - edges[k])

        jobs = [pool().submit(run, k) for k in range(1, threads + 1)]
        run(0)

        def found(_held: object = columns) -> tuple[bool, int, int]:
            """The columns are held until all was copied: of the arrays only the addresses are with the threads."""
            for job in jobs:
                job.result()
            unsorted, most_x, most_y = self._found[: len(parts)].max(axis=0).tolist()
            return bool(unsorted), most_x, most_y

        return found


def _cut(parts: list[Events]) -> tuple[list[Events], list[int]]:
    """Parts in pieces of :data:`PIECE` at most, and which of them go on where the one before ended."""
    whole = [Events(*_plain([part.x, part.y, part.t, part.p])) for part in parts]
    cut = [(part[k : k + PIECE], int(k > 0)) for part in whole for k in range(0, len(part), PIECE)]
    return [piece for piece, _ in cut], [goes_on for _, goes_on in cut]


def _plain(columns: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Without gaps."""
    return [column if column.flags.c_contiguous else np.ascontiguousarray(column) for column in columns]


def address(array: NDArray[Any]) -> int:
    """Of its first value."""
    return int(array.__array_interface__["data"][0])
