"""Copying of packets into columns, and the pool of result arrays: fast and plain implementations."""

from __future__ import annotations

import gc

import numpy as np
import pytest

from amiwarp import Events
from amiwarp.compensation import packet_copy
from amiwarp.compensation.packet_copy import (
    PIECE,
    POOL_SIZE,
    FindPointers,
    PacketCopier,
    PinnedPool,
    address,
    fastest,
    listed_pointers,
    pointers_in_place,
)

WAYS = pytest.mark.parametrize("find_pointers", [pointers_in_place, listed_pointers])


def packets(sizes: list[int]) -> list[Events]:
    """Packets of random events in order of time. The x columns are not contiguous in memory."""
    rng = np.random.default_rng(0)
    t, parts = np.sort(rng.integers(0, 10**6, sum(sizes))), []
    for start, n in zip(np.cumsum([0, *sizes[:-1]]).tolist(), sizes, strict=True):
        x, y = rng.integers(0, 640, 2 * n).astype(np.uint16)[::2], rng.integers(0, 480, n).astype(np.uint16)
        parts.append(Events(x, y, t[start : start + n].copy(), rng.integers(0, 2, n).astype(np.uint8)))
    return parts


def copied(copier: PacketCopier, parts: list[Events]) -> tuple[Events, tuple[bool, int, int]]:
    n = sum(map(len, parts))
    to = [np.zeros(n, dtype) for dtype in (np.uint16, np.uint16, np.int64, np.uint8)]
    check = copier(parts, n, [address(column) for column in to], with_p=True).wait()
    return Events(*to), check


@WAYS
@pytest.mark.parametrize("sizes", [[1], [1, 700, 3], [10] * 300, [PIECE + 5, 100, 2 * PIECE]])
def test_packets_are_copied_one_after_the_other(find_pointers: FindPointers, sizes: list[int]) -> None:
    parts = packets(sizes)
    whole = Events.concatenate(parts)
    found, check = copied(PacketCopier(find_pointers), parts)
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
    assert check == (False, whole.x.max(), whole.y.max())


@WAYS
@pytest.mark.parametrize("at", [5, PIECE])
def test_a_step_back_in_a_packet_is_found(find_pointers: FindPointers, at: int) -> None:
    """Also at the border between two pieces of a long packet."""
    (part,) = packets([PIECE + 100])
    part.t[at] = part.t[at - 1] - 1
    assert copied(PacketCopier(find_pointers), [part])[1].unsorted


def test_an_unknown_layout_of_numpy_is_served_by_its_public_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    assert fastest() is pointers_in_place
    monkeypatch.setattr(packet_copy, "layout_is_known", lambda: False)
    assert fastest() is listed_pointers


def test_a_pooled_array_is_reused_once_it_is_released() -> None:
    pool = PinnedPool(100, pinned=False)
    _, first = pool(100, np.float32)
    _, second = pool(50, np.float32)
    assert not np.shares_memory(first, second)
    start = address(first)
    del first
    _, again = pool(10, np.float32)
    assert address(again) == start


def test_a_pooled_array_is_not_reused_while_a_view_of_it_is_held() -> None:
    pool = PinnedPool(100, pinned=False)
    _, array = pool(100, np.int64)
    array[:] = np.arange(100)
    part, buffer = array[20:30][::2], memoryview(array[40:])
    del array
    gc.collect()
    other = pool(100, np.int64)[1]
    other[:] = -1
    np.testing.assert_array_equal(part, np.arange(20, 30, 2))
    del part
    pool(100, np.int64)[1][:] = -1
    assert buffer[0] == 40


def test_when_the_pool_is_empty_ordinary_memory_is_handed_out() -> None:
    pool = PinnedPool(100, pinned=False)
    pool.fill({np.uint8: POOL_SIZE})
    held = [pool(100, np.uint8) for _ in range(2 * POOL_SIZE)]
    assert len({address(view) for _, view in held}) == len(held)
    for array, view in held:
        view[:] = 7
        assert (array.numpy()[:100] == 7).all()
    del array, view
    pooled = {address(view) for _, view in held[:POOL_SIZE]}
    held.clear()
    assert {address(view) for _, view in [pool(100, np.uint8) for _ in range(POOL_SIZE)]} == pooled
