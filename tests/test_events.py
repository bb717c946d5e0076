"""Events, blocks and sources in memory."""

import itertools

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from amiwarp import AmiwarpError, DeviceEvents, Events, EventSource, MemoryEvents, Truth
from amiwarp.events.device_events import device_for
from amiwarp.events.recording import check_events, regroup


def make(t: list[int]) -> Events:
    index = np.arange(len(t))
    return Events.from_arrays(index % 64, index % 48, np.array(t, np.int64), index % 2)


def cut(events: Events, edges: list[int]) -> list[Events]:
    places = [0, *sorted(min(edge, len(events)) for edge in edges), len(events)]
    return [events[a:b] for a, b in itertools.pairwise(places)]


def assert_equal(given: Events, expected: Events) -> None:
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(given, name), getattr(expected, name), err_msg=name, strict=True)


times = st.lists(st.integers(0, 2000), max_size=80).map(sorted)


def test_from_arrays_converts_without_touching_what_it_is_given():
    p = np.array([-1, 0, 1, 2])
    events = Events.from_arrays([0, 1, 2, 65535], np.arange(4), [1, 2, 3, 4], p)
    assert [array.dtype for array in (events.x, events.y, events.t, events.p)] == [
        np.uint16,
        np.uint16,
        np.int64,
        np.uint8,
    ]
    assert events.p.tolist() == [0, 0, 1, 1]
    assert p.tolist() == [-1, 0, 1, 2]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (([70000], [0], [0], [0]), "65535"),
        (([-1], [0], [0], [0]), "0 .. 65535"),
        (([0], [0], [np.nan], [0]), "not finite"),
        (([0], [0], np.array([2**63], np.uint64), [0]), "beyond int64"),
        ((["a"], [0], [0], [0]), "expected numbers"),
        (([0, 1], [0], [0], [0]), "one length"),
        (([[0]], [[0]], [[0]], [[0]]), "one length"),
        (([0.5], [0], [0], [0]), "expected both uint16"),
    ],
)
def test_from_arrays_refuses(arrays, message):
    with pytest.raises(AmiwarpError, match=message):
        Events.from_arrays(*arrays)


def test_events_refuses_other_types():
    events = make([1, 2])
    with pytest.raises(AmiwarpError, match="int64"):
        Events(events.x, events.y, events.t.astype(np.int32), events.p)


def test_indexing_by_slice_index_and_mask():
    events = make([10, 20, 30, 40])
    assert events[1:3].t.tolist() == [20, 30]
    assert events[np.array([3, 0])].t.tolist() == [40, 10]
    assert events[events.t > 15].t.tolist() == [20, 30, 40]
    assert np.shares_memory(events[1:3].t, events.t)
    assert len(Events.empty()) == 0
    assert_equal(Events.concatenate([]), Events.empty())


@given(times, st.lists(st.integers(0, 80), max_size=6), st.integers(1, 30))
@settings(deadline=None, max_examples=150)
def test_regroup_by_count_keeps_all_in_order(t, edges, count):
    events = make(t)
    blocks = list(regroup(cut(events, edges), count=count))
    assert [len(block) for block in blocks[:-1]] == [count] * (len(blocks) - 1)
    assert all(0 < len(block) <= count for block in blocks[-1:])
    assert_equal(Events.concatenate(blocks), events)


@given(times, st.lists(st.integers(0, 80), max_size=6), st.integers(1, 500))
@settings(deadline=None, max_examples=150)
def test_regroup_by_duration_cuts_on_the_grid_of_the_first_event(t, edges, duration):
    events = make(t)
    blocks = list(regroup(cut(events, edges), duration_us=duration))
    windows = [set(((block.t - t[0]) // duration).tolist()) for block in blocks]
    assert [len(window) for window in windows] == [1] * len(windows)
    order = [window.pop() for window in windows]
    assert order == sorted(set(order))
    assert_equal(Events.concatenate(blocks), events)


@pytest.mark.parametrize("options", [{"count": 0}, {"duration_us": 0}, {"count": 1, "duration_us": 1}])
def test_regroup_refuses(options):
    with pytest.raises(AmiwarpError, match="block"):
        list(regroup([make([1])], **options))


def test_memory_source():
    source = MemoryEvents(make([10, 20, 20, 30, 45]), 64, 48)
    assert isinstance(source, EventSource)
    assert (len(source), source.t_first, source.t_last, source.size) == (5, 10, 45, (64, 48))
    assert source.between(20, 45).t.tolist() == [20, 20, 30]
    assert source.between(46, 60).t.tolist() == []
    assert source.slice(3, 99).t.tolist() == [30, 45]
    assert source.slice(-2, 1).t.tolist() == [10]
    assert [block.t.tolist() for block in source.blocks(count=2)] == [[10, 20], [20, 30], [45]]
    assert [block.t.tolist() for block in source.blocks(duration_us=15)] == [[10, 20, 20], [30], [45]]


def test_empty_source_has_no_first_time():
    source = MemoryEvents(Events.empty(), 64, 48)
    assert list(source.blocks()) == []
    for name in ("t_first", "t_last"):
        with pytest.raises(AmiwarpError, match="no events"):
            getattr(source, name)


def floating(**changes) -> Events:
    arrays = {"x": np.array([1.0, 2.0], np.float32), "y": np.array([-3.0, 99.0], np.float32), **changes}
    return Events(arrays["x"], arrays["y"], np.array([1, 2]), np.zeros(2, np.uint8))


def test_check_names_the_first_bad_event():
    good = make([1, 2, 3])
    check_events(good, 3, 3, where="here", after_t=1)
    bad_p = Events(good.x, good.y, good.t, np.array([0, 1, 2], np.uint8))
    nan = floating(x=np.array([1.0, np.nan], np.float32))
    for events, options, message in (
        (good, {"width": 2}, r"here: event 12 \(x=2, y=2, t=3 us\) lies outside the 2x3 frame"),
        (good[np.array([0, 2, 1])], {}, "event 12 .* earlier than the one before"),
        (good, {"after_t": 2}, r"event 10 .* earlier than the one before \(2 us\)"),
        (bad_p, {}, "event 12 .* polarity"),
        (nan, {}, "event 11 .* not finite"),
    ):
        with pytest.raises(AmiwarpError, match=message):
            check_events(events, **{"width": 3, "height": 3, "where": "here", "first_index": 10, **options})
    check_events(nan, 3, 3, where="here", allow_nan=True)
    check_events(floating(), 3, 3, where="compensated events may leave the frame")


def test_memory_source_refuses_unsorted_events():
    with pytest.raises(AmiwarpError, match="sort by time"):
        MemoryEvents(make([3, 1]), 64, 48)


def test_truth_points():
    points = np.arange(8, dtype=np.float32).reshape(4, 2)
    truth = Truth({"apex": 0.03}, points)
    np.testing.assert_array_equal(truth.points(1, 3), points[1:3])
    assert Truth({}).points(0, 4) is None


def test_blocks_on_a_device_are_joined_in_order():
    blocks = [
        DeviceEvents.from_arrays(*(getattr(make(t), name) for name in "xytp"), device="cpu") for t in ([1, 2], [3])
    ]
    joined = DeviceEvents.concatenate(blocks)
    assert joined.t.numpy().tolist() == [1, 2, 3]
    assert DeviceEvents.concatenate(blocks[:1]) is blocks[0]
    with pytest.raises(AmiwarpError, match="at least one"):
        DeviceEvents.concatenate([])


def test_events_on_the_host_go_to_the_device_that_is_named():
    assert device_for(make([1]), None) == wp.get_device("cpu")
    with pytest.raises(Exception, match="cuda:77"):
        device_for(make([1]), "cuda:77")
