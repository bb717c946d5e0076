"""Copying of packets into columns, and the pool of result arrays: fast and plain implementations."""

from __future__ import annotations

import gc
from collections.abc import Callable

import numpy as np
import pytest
import warp as wp

from amiwarp import Events, workarounds
from amiwarp.compensation.batches import MOST_HELD
from amiwarp.compensation.packet_copy import PIECE, ColumnCheck, PacketCopier, join_packets
from amiwarp.kernels.page_locked_memory import PageLockedPool

Copy = Callable[[list[Events], list[np.ndarray]], ColumnCheck]


def by_threads(parts: list[Events], to: list[np.ndarray]) -> ColumnCheck:
    return PacketCopier()(parts, to)()


WAYS = pytest.mark.parametrize("copy", [join_packets, by_threads])


def packets(sizes: list[int]) -> list[Events]:
    """Packets of random events in order of time. The x columns are not contiguous in memory."""
    rng = np.random.default_rng(0)
    t, parts = np.sort(rng.integers(0, 10**6, sum(sizes))), []
    for start, n in zip(np.cumsum([0, *sizes[:-1]]).tolist(), sizes, strict=True):
        x, y = (
            rng.integers(0, 640, 2 * n).astype(np.uint16)[::2],
            rng.integers(0, 480, n).astype(np.uint16),
        )
        parts.append(
            Events(x, y, t[start : start + n].copy(), rng.integers(0, 2, n).astype(np.uint8))
        )
    return parts


def copied(copy: Copy, parts: list[Events]) -> tuple[Events, tuple[bool, int, int]]:
    n = sum(map(len, parts))
    to = [np.zeros(n, dtype) for dtype in (np.uint16, np.uint16, np.int64, np.uint8)]
    check = copy(parts, to)
    return Events(*to), check


@WAYS
@pytest.mark.parametrize("sizes", [[1], [1, 700, 3], [10] * 300, [PIECE + 5, 100, 2 * PIECE]])
def test_packets_are_copied_one_after_the_other(copy: Copy, sizes: list[int]) -> None:
    parts = packets(sizes)
    whole = Events.concatenate(parts)
    found, check = copied(copy, parts)
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
    assert check == (False, whole.x.max(), whole.y.max())


@WAYS
@pytest.mark.parametrize("at", [5, PIECE])
def test_a_step_back_in_a_packet_is_found(copy: Copy, at: int) -> None:
    (part,) = packets([PIECE + 100])
    part.t[at] = part.t[at - 1] - 1
    assert copied(copy, [part])[1].unsorted


def test_an_unknown_layout_of_numpy_is_served_by_its_public_interface(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert workarounds.layout_is_known()
    monkeypatch.setattr(workarounds, "layout_is_known", lambda: False)
    parts = packets([10, 700])
    found, check = copied(by_threads, parts)
    np.testing.assert_array_equal(found.t, Events.concatenate(parts).t)
    assert not check.unsorted


def test_a_pooled_array_is_reused_once_it_is_released() -> None:
    pool = PageLockedPool(MOST_HELD, locked=False)
    _, first = pool.result(100, 100, wp.float32)
    _, second = pool.result(100, 50, wp.float32)
    assert not np.shares_memory(first, second)
    start = first.ctypes.data
    del first
    _, again = pool.result(100, 10, wp.float32)
    assert again.ctypes.data == start


def test_a_pooled_array_is_not_reused_while_a_view_of_it_is_held() -> None:
    pool = PageLockedPool(MOST_HELD, locked=False)
    _, array = pool.result(100, 100, wp.int64)
    array[:] = np.arange(100)
    part, buffer = array[20:30][::2], memoryview(array[40:])
    del array
    gc.collect()
    other = pool.result(100, 100, wp.int64)[1]
    other[:] = -1
    np.testing.assert_array_equal(part, np.arange(20, 30, 2))
    del part
    pool.result(100, 100, wp.int64)[1][:] = -1
    assert buffer[0] == 40


def test_when_the_pool_is_empty_ordinary_memory_is_handed_out() -> None:
    pool = PageLockedPool(MOST_HELD, locked=False)
    pool.fill(100, [wp.uint8] * MOST_HELD)
    held = [pool.result(100, 100, wp.uint8) for _ in range(2 * MOST_HELD)]
    assert len({view.ctypes.data for _, view in held}) == len(held)
    for array, view in held:
        view[:] = 7
        assert (array.numpy()[:100] == 7).all()
    del array, view
    pooled = {view.ctypes.data for _, view in held[:MOST_HELD]}
    held.clear()
    assert {
        view.ctypes.data for _, view in [pool.result(100, 100, wp.uint8) for _ in range(MOST_HELD)]
    } == pooled
