"""Events, blocks and sources in memory."""

import dataclasses
import itertools

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

import amiwarp
from amiwarp import (
    AmiwarpError,
    DeviceEvents,
    DeviceMemoryEvents,
    ErrorCode,
    Events,
    EventSource,
    MemoryEvents,
    Truth,
)
from amiwarp.calib.bad_pixels import MaskedEventSource
from amiwarp.calib.start_burst import LaterEvents
from amiwarp.events import MemoryMasks
from amiwarp.events.device_events import device_for
from amiwarp.events.recording import check_events, regroup
from tests.errors import refused


def make(t: list[int]) -> Events:
    index = np.arange(len(t))
    return Events.from_arrays(index % 64, index % 48, np.array(t, np.int64), index % 2)


def floating(**changes) -> Events:
    arrays = {
        "x": np.array([1.0, 2.0], np.float32),
        "y": np.array([-3.0, 99.0], np.float32),
        **changes,
    }
    return Events(arrays["x"], arrays["y"], np.array([1, 2]), np.zeros(2, np.uint8))


def cut(events: Events, edges: list[int]) -> list[Events]:
    places = [0, *sorted(min(edge, len(events)) for edge in edges), len(events)]
    return [events[a:b] for a, b in itertools.pairwise(places)]


def assert_equal(given: Events, expected: Events) -> None:
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(
            getattr(given, name), getattr(expected, name), err_msg=name, strict=True
        )


times = st.lists(st.integers(0, 2000), max_size=80).map(sorted)


def test_from_arrays_converts_without_touching_what_it_is_given():
    p = np.array([-1, -1, 1, 1])
    events = Events.from_arrays([0, 1, 2, 65535], np.arange(4), [1, 2, 3, 4], p)
    assert [array.dtype for array in (events.x, events.y, events.t, events.p)] == [
        np.uint16,
        np.uint16,
        np.int64,
        np.uint8,
    ]
    assert events.p.tolist() == [0, 0, 1, 1]
    assert p.tolist() == [-1, -1, 1, 1]


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


def test_one_event_of_a_longer_array_has_no_gaps() -> None:
    """NumPy keeps the stride of an array of one value, which Warp takes for a gap."""
    x, t, p = np.arange(8, dtype=np.uint16)[::8], np.arange(8)[::8], np.ones(8, np.uint8)[::8]
    found = Events.from_arrays(x, x, t, p)
    assert [getattr(found, name).strides for name in "xytp"] == [(2,), (2,), (8,), (1,)]
    on_device = DeviceEvents.from_arrays(x, x, t, p, device="cpu")
    assert all(getattr(on_device, name).is_contiguous for name in "xytp")


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
@settings(max_examples=150)
def test_regroup_by_count_keeps_all_in_order(t, edges, count):
    events = make(t)
    blocks = list(regroup(cut(events, edges), count=count))
    assert [len(block) for block in blocks[:-1]] == [count] * (len(blocks) - 1)
    assert all(0 < len(block) <= count for block in blocks[-1:])
    assert_equal(Events.concatenate(blocks), events)


@given(times, st.lists(st.integers(0, 80), max_size=6), st.integers(1, 500))
@settings(max_examples=150)
def test_regroup_by_duration_cuts_on_the_grid_of_the_first_event(t, edges, duration):
    events = make(t)
    blocks = list(regroup(cut(events, edges), duration_us=duration))
    windows = [set(((block.t - t[0]) // duration).tolist()) for block in blocks]
    assert [len(window) for window in windows] == [1] * len(windows)
    order = [window.pop() for window in windows]
    assert order == sorted(set(order))
    assert_equal(Events.concatenate(blocks), events)


@pytest.mark.parametrize(
    "options", [{"count": 0}, {"duration_us": 0}, {"count": 1, "duration_us": 1}]
)
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
    assert source.slice(0, 1).t.tolist() == [10]
    assert [block.t.tolist() for block in source.blocks(count=2)] == [[10, 20], [20, 30], [45]]
    assert [block.t.tolist() for block in source.blocks(duration_us=15)] == [
        [10, 20, 20],
        [30],
        [45],
    ]


@pytest.mark.parametrize("stored", ["memory", "native", "npz"])
def test_slices_of_sources_are_those_of_arrays(stored, tmp_path):
    events = make(list(range(10, 110, 10)))
    source = MemoryEvents(events, 64, 48)
    if stored != "memory":
        amiwarp.save_recording(tmp_path / "native.h5", amiwarp.Recording(source))
        amiwarp.convert(tmp_path / "native.h5", tmp_path / "npz.npz")
        source = amiwarp.open_recording(next(tmp_path.glob(f"{stored}.*"))).events
    assert isinstance(source, EventSource)
    for ends in itertools.product((None, -20, -3, 0, 4, 9, 30), repeat=2):
        which = slice(*ends)
        assert_equal(
            source[which],
            Events(events.x[which], events.y[which], events.t[which], events.p[which]),
        )
    for rejected, message in (
        (0, r"\[0:1\] for one event"),
        (np.int64(-1), r"\[-1:\] for one"),
        ("a", "slice"),
    ):
        with pytest.raises(AmiwarpError, match=message):
            source[rejected]
    with pytest.raises(AmiwarpError, match="steps of -1"):
        source[::-1]
    with pytest.raises(AmiwarpError, match="blocks"):
        list(source)
    with pytest.raises(AmiwarpError, match="for one event"):
        events[3]


SOURCES = ("memory", "native", "npz", "device", "masked", "later")


@pytest.mark.parametrize("kind", SOURCES)
def test_sources_refuse_what_would_silently_be_empty(kind, tmp_path):
    """Seconds, reversed windows and negative indices; and the arrays of all events, which are read on demand."""
    events = make(list(range(10, 110, 10)))
    source = MemoryEvents(events, 64, 48)
    if kind in ("native", "npz"):
        amiwarp.save_recording(tmp_path / "native.h5", amiwarp.Recording(source))
        amiwarp.convert(tmp_path / "native.h5", tmp_path / "npz.npz")
        source = amiwarp.open_recording(next(tmp_path.glob(f"{kind}.*"))).events
    elif kind == "device":
        source = DeviceMemoryEvents(
            DeviceEvents.from_arrays(events.x, events.y, events.t, events.p), 64, 48
        )
    elif kind == "masked":
        source = MaskedEventSource(source, np.zeros((48, 64), np.bool_))
    elif kind == "later":
        source = LaterEvents(source, 2)
    for window in ((0.1, 0.2), (1, 40.5)):
        with pytest.raises(
            AmiwarpError,
            match=r"is not a whole number; times are whole microseconds \(int64\): give",
        ):
            source.between(*window)
    with pytest.raises(
        AmiwarpError, match=r"between\(50, 40\) ends before its start; give the start, then the end"
    ):
        source.between(50, 40)
    assert len(source.between(50, 50)) == 0
    assert source.between(50, 51).t.tolist() == [50]
    assert len(source.between(0, 5)) == 0
    with pytest.raises(
        AmiwarpError,
        match=r"slice\(-5, 3\) has a negative index, .*; events\[-5:\] are the last five",
    ):
        source.slice(-5, 3)
    for ends in (("a", 3), (0, "b"), (0.5, 3)):
        with pytest.raises(AmiwarpError, match="is not a whole number"):
            source.slice(*ends)
    for name in ("x", "y", "t", "p"):
        with pytest.raises(
            AttributeError, match=rf"has no attribute '{name}': .* events\[:\]\.{name} for all"
        ):
            getattr(source, name)
    with pytest.raises(AttributeError, match=r"has no attribute 'times'$"):
        source.times  # noqa: B018
    assert isinstance(source, EventSource)
    assert len(source[:]) == len(source)


EVENT_CD = np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
"""Events of Prophesee's Metavision."""
TONIC = np.dtype([("x", "<i2"), ("y", "<i2"), ("t", "<i8"), ("p", "?")])
"""Events of tonic."""


@pytest.mark.parametrize(
    "dtype", [None, EVENT_CD, TONIC, [("t", "f8"), ("p", "i1"), ("y", "f4"), ("x", "u4")]]
)
def test_structured_arrays_in_and_out(dtype):
    events = make([10, 20, 30, 40])
    array = events.to_structured(dtype)
    assert array.dtype == np.dtype(dtype or [("x", "u2"), ("y", "u2"), ("t", "i8"), ("p", "u1")])
    for name in "xytp":
        assert array[name].tolist() == getattr(events, name).tolist()
    if dtype is None or isinstance(dtype, np.dtype):
        assert_equal(Events.from_structured(array), events)


def test_structured_arrays_take_seconds_signs_and_compensated_events():
    rows = np.array(
        [(0.5, 1.25, 2.0, -1, 7), (0.6, 3.0, 4.0, 1, 7)],
        [(n, "f8") for n in ("t", "x", "y", "p", "other")],
    )
    before = rows.copy()
    events = Events.from_structured(rows, t_unit="s")
    assert np.array_equal(rows, before)
    assert (events.t.tolist(), events.p.tolist(), events.x.tolist()) == (
        [500_000, 600_000],
        [0, 1],
        [1.25, 3.0],
    )
    assert_equal(Events.from_structured(events.to_structured()), events)
    lost = floating(x=np.array([np.nan, 2.0], np.float32))
    assert np.isnan(lost.to_structured()["x"][0])


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((3, 4)), "type float64 without fields; field x is missing"),
        (
            np.zeros(3, [("x", "i4"), ("y", "i4"), ("ts", "i8"), ("p", "?")]),
            "fields x, y, ts, p; field t is missing",
        ),
        ([1, 2, 3], "structured array"),
    ],
)
def test_arrays_without_the_fields_are_refused(array, message):
    with pytest.raises(AmiwarpError, match=message):
        Events.from_structured(array)


@pytest.mark.parametrize(
    ("events", "dtype", "message"),
    [
        (make([1]), "i4", "fields x, y, t, p"),
        (make([1]), "nothing", "NumPy data type"),
        (make([1]), [("x", "u2"), ("y", "u2"), ("t", "i8")], "fields x, y, t, p"),
        (make([1]), [("x", "u2"), ("y", "u2"), ("t", "i8"), ("p", "U3")], "p of type"),
        (
            make([1 << 40]),
            [("x", "u2"), ("y", "u2"), ("t", "i4"), ("p", "?")],
            "t of type int32, which cannot hold",
        ),
        (
            floating(x=np.array([1.5, np.nan], np.float32)),
            EVENT_CD,
            "x of type uint16, which cannot hold 1.5",
        ),
    ],
)
def test_types_that_cannot_hold_the_events_are_refused(events, dtype, message):
    with pytest.raises(AmiwarpError, match=message):
        events.to_structured(dtype)


def test_representations_are_short(tmp_path):
    n = 100_000
    t = np.arange(n) * 10
    events = Events.from_arrays(
        np.zeros(n, np.uint16), np.zeros(n, np.uint16), t, np.ones(n, np.uint8)
    )
    source = MemoryEvents(events, 640, 480)
    assert repr(events) == "Events(100,000 events, t 0 .. 999990 us, 0.1 Mev/s)"
    assert repr(source) == "MemoryEvents(100,000 events, 640x480 px, t 0 .. 999990 us, 0.1 Mev/s)"
    assert repr(Events.empty()) == "Events(0 events)"
    assert repr(make([5])) == "Events(1 event, t 5 .. 5 us)"
    assert repr(floating()).startswith("Events(2 events, compensated, ")
    encoder = amiwarp.Encoder.constant_speed(720.0, 0, 1_000_000)
    assert repr(encoder).endswith("720 rpm)")
    recording = amiwarp.Recording(source, encoder=encoder, name="wall")
    assert repr(recording) == f"Recording('wall', {source!r}, with encoder)"
    assert repr(amiwarp.Recording(source)).endswith("events only)")
    amiwarp.save_recording(tmp_path / "a.h5", recording)
    assert repr(amiwarp.open_recording(tmp_path / "a.h5").events) == repr(source).replace(
        "Memory", "Native"
    )


def test_a_recording_wraps_events_in_the_size_of_its_camera():
    events = amiwarp.Events.from_arrays([1, 7], [0, 5], [0, 10], [1, 0])
    camera = amiwarp.Camera.from_fov(8, 6, 1.0)
    recording = amiwarp.Recording(events, camera, name="wall")
    assert isinstance(recording.events, MemoryEvents)
    assert recording.events.size == (8, 6)
    assert_equal(recording.events[:], events)
    again = dataclasses.replace(recording, metadata={"a": 1})
    assert (again.events, again.camera, again.name, again.metadata) == (
        recording.events,
        camera,
        "wall",
        {"a": 1},
    )
    with pytest.raises(
        AmiwarpError, match=r"no sensor size; give the camera too, or .*MemoryEvents\(events, width"
    ):
        amiwarp.Recording(events)
    with pytest.raises(
        AmiwarpError, match=r"event 1 \(x=7, y=5, t=10 us\) lies outside the 6x8 frame"
    ):
        amiwarp.Recording(events, amiwarp.Camera.from_fov(6, 8, 1.0))
    for width, height in ((6, 6), (7, 7)):  # neither would hold the event if swapped
        with pytest.raises(
            AmiwarpError, match=f"outside the {width}x{height} frame; check the size"
        ):
            MemoryEvents(events, width, height)
    on_device = DeviceEvents.from_arrays(events.x, events.y, events.t, events.p)
    with pytest.raises(
        AmiwarpError, match=r"wrap them as amiwarp.DeviceMemoryEvents\(events, width, height\)"
    ):
        amiwarp.Recording(on_device, camera)


def test_empty_source_has_no_first_time():
    source = MemoryEvents(Events.empty(), 64, 48)
    assert list(source.blocks()) == []
    for name in ("t_first", "t_last"):
        with refused(ErrorCode.CONTENT_MISSING):
            getattr(source, name)


def test_check_names_the_first_bad_event():
    good = make([1, 2, 3])
    check_events(good, 3, 3, where="here", after_t=1)
    nan = floating(x=np.array([1.0, np.nan], np.float32))
    for events, options, message in (
        (good, {"width": 2}, r"here: event 12 \(x=2, y=2, t=3 us\) lies outside the 2x3 frame"),
        (good[np.array([0, 2, 1])], {}, "event 12 .* earlier than the one before"),
        (good, {"after_t": 2}, r"event 10 .* earlier than the one before \(2 us\)"),
        (nan, {}, "event 11 .* not finite"),
    ):
        with pytest.raises(AmiwarpError, match=message):
            check_events(
                events, **{"width": 3, "height": 3, "where": "here", "first_index": 10, **options}
            )
    check_events(nan, 3, 3, where="here", allow_nan=True)
    check_events(floating(), 3, 3, where="compensated events may leave the frame")


def test_events_refuse_other_polarities_than_0_and_1():
    good = make([1, 2, 3])
    with pytest.raises(
        AmiwarpError,
        match=r"events' p holds 255 \(number 2\); expected .* if ON is 255 .*give p > 0",
    ):
        Events(good.x, good.y, good.t, np.array([0, 1, 255], np.uint8))


def test_memory_source_refuses_unsorted_events():
    with pytest.raises(AmiwarpError, match="sort by time"):
        MemoryEvents(make([3, 1]), 64, 48)


def test_truth_points():
    points = np.arange(8, dtype=np.float32).reshape(4, 2)
    truth = Truth({"apex": 0.03}, points)
    np.testing.assert_array_equal(truth.points(1, 3), points[1:3])
    assert Truth({}).points(0, 4) is None


def test_a_printed_truth_is_short():
    glass = {"bus_queue": 4096.0, "phase": 1.0, "apex": 0.03, "index": 1.5}
    assert repr(Truth(glass, np.zeros((4, 2), np.float32), np.zeros(4, np.uint8))) == (
        "Truth(apex 1.7189 deg, index 1.5, phase 57.296 deg, 1 more parameters;\n      points, causes of events)"
    )
    labels = amiwarp.WorldLabels("room", ("wall", "chair"), ("", ""))
    masks = MemoryMasks([3, 9], [np.ones((2, 3), np.bool_)] * 2)
    assert repr(Truth({"x_hz": 30.0}, labels=labels, known=masks)) == (
        "Truth(x_hz 30;\n      2 masks, labels of 2 instances)"
    )
    assert repr(Truth()) == "Truth(no parameters;\n      nothing else)"


def test_records_at_several_times_are_a_sequence():
    """Frames, ground truth of all pixels and masks, in memory: tests of files compare with these."""
    images = np.arange(24, dtype=np.uint8).reshape(4, 2, 3)
    frames = amiwarp.MemoryImages(np.array([5, 6, 8, 9]), images)
    assert len(frames) == 4
    np.testing.assert_array_equal(list(frames), images)
    np.testing.assert_array_equal(frames[-1], images[3])
    for which in (
        slice(1, 3),
        slice(-2, None),
        slice(None, None, -1),
        slice(3, 1),
        slice(None, None, 2),
    ):
        part = frames[which]
        assert part.t.tolist() == frames.t[which].tolist()
        assert part.size == (3, 2)
        assert len(part) == len(images[which])
        assert [image.tolist() for image in part] == images[which].tolist()
    assert frames[1:][:2][-1].tolist() == images[2].tolist()
    masks = MemoryMasks([3, 9], [np.ones((2, 3), np.bool_), np.zeros((2, 3), np.bool_)])
    assert [mask.all() for mask in masks[::-1]] == [False, True]
    assert repr(frames) == "MemoryImages(4 records, t 5 .. 9 us)"
    assert repr(frames[:1]) == "Slice(1 record, t 5 .. 5 us)"
    for index in (4, -5):
        with pytest.raises(IndexError, match=f"index {index} is not one of 4 records"):
            frames[index]
    for index in ("a", 1.5, None, slice("a", 2)):
        with pytest.raises(
            AmiwarpError, match=r"index of a record is .*; give a whole number or a slice"
        ):
            frames[index]


def test_blocks_on_a_device_are_joined_in_order():
    blocks = [
        DeviceEvents.from_arrays(*(getattr(make(t), name) for name in "xytp"), device="cpu")
        for t in ([1, 2], [3])
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
