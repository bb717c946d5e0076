"""The queue between sensor and consumer: its bound, its three ways of being full, and its counts."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from amiwarp import AmiwarpError, Events, Packet, Policy
from amiwarp.live import PacketQueue
from amiwarp.live.stream import make_packet


def packet(first: int, n: int) -> Packet:
    t = np.arange(first, first + n)
    zero = np.zeros(n, np.int64)
    events = Events.from_arrays(zero, zero, t, zero)
    return make_packet(0, events, np.array([first]), np.array([first]), np.array([0.5]))


def drained(queue: PacketQueue) -> tuple[np.ndarray, list[Packet]]:
    queue.close()
    out = []
    while (got := queue.get(0.0)) is not None:
        out.append(got)
    assert queue.ended
    return np.concatenate([p.events.t for p in out]), out


@pytest.mark.parametrize("policy", list(Policy))
def test_nothing_is_lost_while_there_is_room(policy: Policy) -> None:
    queue = PacketQueue(1000, policy)
    for start in range(0, 500, 100):
        queue.put(packet(start, 100))
    times, _ = drained(queue)
    np.testing.assert_array_equal(times, np.arange(500))
    assert (queue.received, queue.dropped) == (500, 0)


def test_the_oldest_go_and_the_rest_stays_in_order() -> None:
    queue = PacketQueue(1000, Policy.DROP_OLDEST)
    for start in range(0, 5000, 100):
        queue.put(packet(start, 100))
        assert queue.held <= 1000
    times, out = drained(queue)
    np.testing.assert_array_equal(times, np.arange(4000, 5000))
    assert (queue.received, queue.dropped) == (5000, 4000)
    np.testing.assert_array_equal(
        np.concatenate([p.triggers for p in out]), np.arange(0, 5000, 100)
    )
    np.testing.assert_array_equal(
        np.concatenate([p.encoder_t for p in out]), np.arange(0, 5000, 100)
    )


def test_thinning_is_even_and_keeps_the_bound() -> None:
    queue = PacketQueue(1000, Policy.THIN)
    for start in range(0, 10_000, 100):
        queue.put(packet(start, 100))
        assert queue.held <= 1000
    times, out = drained(queue)
    assert len(times) + queue.dropped == queue.received == 10_000
    assert (np.diff(times) > 0).all()
    assert len(times) <= 1000
    np.testing.assert_array_equal(
        np.concatenate([p.triggers for p in out]), np.arange(0, 10_000, 100)
    )
    # within a packet that was thinned by a third the gaps are of one event or none
    queue = PacketQueue(300, Policy.THIN)
    for start in range(0, 200, 100):
        queue.put(packet(start, 100))
    thinned = drained(queue)[1][-1].events.t
    assert 60 <= len(thinned) <= 70
    assert set(np.diff(thinned).tolist()) == {1, 2}


def test_single_events_are_thinned_as_those_of_large_packets_are() -> None:
    queue = PacketQueue(100, Policy.THIN)
    queue.put(packet(0, 50))
    for start in range(50, 250):
        queue.put(packet(start, 1))
    assert 90 <= queue.held <= 100
    assert queue.held + queue.dropped == queue.received == 250


def test_a_full_queue_holds_the_source_back_until_there_is_room() -> None:
    queue = PacketQueue(250, Policy.BLOCK)
    through = threading.Event()

    def feed() -> None:
        for start in range(0, 500, 100):
            queue.put(packet(start, 100))
        through.set()

    thread = threading.Thread(target=feed)
    thread.start()
    assert not through.wait(0.05)
    assert queue.held <= 250
    times = []
    while len(times) < 500:
        got = queue.get(120.0)
        assert got is not None
        times += got.events.t.tolist()
    thread.join(120.0)
    assert through.is_set()
    np.testing.assert_array_equal(times, np.arange(500))


def test_closing_lets_a_source_go_that_waits() -> None:
    queue = PacketQueue(100, Policy.BLOCK)
    queue.put(packet(0, 100))
    thread = threading.Thread(target=queue.put, args=(packet(100, 100),))
    thread.start()
    queue.close()
    thread.join(120.0)
    assert not thread.is_alive()
    np.testing.assert_array_equal(drained(queue)[0], np.arange(200))


def test_a_packet_larger_than_the_queue_still_passes() -> None:
    for policy in (Policy.BLOCK, Policy.DROP_OLDEST):
        queue = PacketQueue(10, policy)
        queue.put(packet(0, 100))
        np.testing.assert_array_equal(drained(queue)[0], np.arange(100))


def test_an_empty_queue_answers_in_time() -> None:
    queue = PacketQueue(10, Policy.BLOCK)
    assert queue.get(0.01) is None
    assert not queue.ended
    with pytest.raises(AmiwarpError, match="most_events = 0"):
        PacketQueue(0, Policy.BLOCK)
