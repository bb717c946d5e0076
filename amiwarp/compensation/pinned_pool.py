"""Reuse of page-locked host memory for results of a GPU.

A GPU writes to page-locked memory at full speed, but allocating one such array takes a millisecond, and a batch needs
five, while it is compensated in 1.1 to 1.4 ms (``docs/explanation/performance.md``, Streams). So arrays are reused once
the caller has released them. If the caller keeps more than :data:`POOL_SIZE` of a type, ordinary memory is handed out.
"""

from __future__ import annotations

import heapq
import weakref
from typing import Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import NDArray

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
