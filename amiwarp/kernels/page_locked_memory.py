"""Page-locked memory on the host, and reading from a GPU that does not wait at once.

A GPU copies to and from page-locked memory at full speed and without waiting, but locking the memory takes up to two
milliseconds. So arrays are used again.
"""

import heapq
import weakref
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

_Kind = tuple[Any, ...]
"""What arrays that may take each other's place have in common: shape, type, and use."""
_Numbered = tuple[int, wp.array]
"""Number of an array among the arrays of its kind, in the order in which they were made, and the array."""


class PageLockedPool:
    """Page-locked host arrays of Warp, which are used again once their owners are deleted."""

    def __init__(self, most: int | None = None, *, locked: bool = True) -> None:
        """Start without arrays. ``most``: largest number of :meth:`result` arrays of a kind.

        ``locked=False`` gives ordinary memory, for machines without CUDA.
        """
        self._most = most
        self._locked = locked
        self._idle: defaultdict[_Kind, list[_Numbered]] = defaultdict(list)  # heaps
        self._made: Counter[_Kind] = Counter()

    def _take(self, kind: _Kind) -> _Numbered:
        """Return the idle array of a kind that was made first, so that few are in use, or a new one."""
        try:
            return heapq.heappop(self._idle[kind])
        except IndexError:
            shape, dtype, *_ = kind
            self._made[kind] += 1
            return self._made[kind], wp.empty(shape, dtype=dtype, device="cpu", pinned=self._locked)

    def _give_back(self, kind: _Kind, user: object, taken: _Numbered) -> None:
        """Make an array idle once ``user`` is deleted."""
        weakref.finalize(user, heapq.heappush, self._idle[kind], taken).atexit = False

    def array(self, owner: object, shape: tuple[int, ...], dtype: Any, *use: object) -> wp.array:
        """Return an array with undefined values, which another owner may get once ``owner`` is deleted.

        Keep no reference to it beyond ``owner``. ``use``: only an owner with the same use may get it.
        """
        kind = shape, dtype, *use
        taken = self._take(kind)
        self._give_back(kind, owner, taken)
        _, array = taken
        return array

    def fill(self, size: int, dtypes: Iterable[Any]) -> None:
        """Lock memory for the :meth:`result` arrays of each of ``dtypes`` in advance."""
        kinds = [((size,), dtype) for dtype in dtypes]
        # All are taken before the first one is idle again: so there is one for each, also of equal types.
        taken = [self._take(kind) for kind in kinds]
        for kind, numbered in zip(kinds, taken, strict=True):
            heapq.heappush(self._idle[kind], numbered)

    def result(self, size: int, n: int, dtype: Any) -> tuple[wp.array, NDArray[Any]]:
        """Return an array of ``size`` values, and a NumPy view of its first ``n``, which a caller may keep.

        The array is used again once all views of it are dropped. If a caller keeps too many, ordinary memory is handed
        out.
        """
        kind = (size,), dtype
        if self._most is not None and not self._idle[kind] and self._made[kind] >= self._most:
            view = np.empty(n, wp.dtype_to_numpy(dtype))
            return wp.array(view, dtype=dtype, device="cpu", copy=False), view
        taken = self._take(kind)
        _, array = taken
        # Not a slice: NumPy makes a slice of a slice refer to the base, and the pool would miss that it is in use.
        view = np.frombuffer(memoryview(array.numpy()), wp.dtype_to_numpy(dtype), n)
        self._give_back(kind, view, taken)
        return array, view


_shared = PageLockedPool()


def page_locked(
    owner: object, shape: tuple[int, ...], dtype: Any, device: Any, *, written_by_host: bool = False
) -> wp.array:
    """Return a page-locked array with undefined values, which another owner may get once ``owner`` is deleted.

    ``device`` may use it only on Warp's stream, so that what it does for an earlier owner comes first. Only one side
    writes to it: ``device``, or the host. Keep no reference to it beyond ``owner``.
    """
    return _shared.array(owner, shape, dtype, str(device), written_by_host)


def start_read(array: wp.array) -> Callable[[], NDArray[Any]]:
    """Start to copy a small contiguous array of numbers to the host. Return a function that waits and returns a copy.

    It does not wait for what is launched later.
    """
    if array.device.is_cpu:
        found = array.numpy().copy()
        return lambda: found
    size = array.size * wp.types.type_size_in_bytes(array.dtype)

    def result() -> NDArray[Any]:
        wp.synchronize_event(copied)
        values: NDArray[Any] = host.numpy()[:size].view(wp.dtype_to_numpy(array.dtype))
        return values.reshape(array.shape).copy()

    # sizes are powers of two, so that arrays of other sizes can use the memory, too
    capacity = 1 << (size - 1).bit_length()
    host = page_locked(result, (capacity,), wp.uint8, array.device)
    there = wp.array(ptr=array.ptr, dtype=wp.uint8, shape=size, device=array.device)
    wp.copy(host, there, count=size)
    copied = array.device.stream.record_event()
    return result
