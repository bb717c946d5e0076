"""Stages of a session: a stream cut anywhere gives the events of the whole file, with every event counted."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from amiwarp import (
    Camera,
    Compensated,
    EventFilter,
    Events,
    Fisheye,
    Packet,
    Policy,
    RadialTangential,
)
from amiwarp.compensation import OUTSIDE
from amiwarp.live.link import monotonic_us
from amiwarp.live.stream import Session, SessionStatus, make_packet
from tests.io.test_io_readers import assert_equal

SIZE = WIDTH, HEIGHT = 64, 48
LENS = Camera(WIDTH, HEIGHT, 50.0, 52.0, 30.5, 24.0, RadialTangential(-0.3, 0.05))
HOT = np.zeros((HEIGHT, WIDTH), np.bool_)
HOT[3, 5] = HOT[20, 30] = True
FILTERS = {
    "region": EventFilter(region=(5, 3, 50, 40)),
    "hot": EventFilter(hot_pixels=HOT),
    "refractory": EventFilter(refractory_us=3000),
    "background": EventFilter(background_us=400),
    "rate": EventFilter(most_per_s=100_000.0),
    "all": EventFilter(
        region=(2, 0, 64, 46), hot_pixels=HOT, refractory_us=900, background_us=900, most_per_s=50_000.0
    ),
}  # fmt: skip


def some_events(n: int = 20_000, seed: int = 5) -> Events:
    rng = np.random.default_rng(seed)
    t = 1000 + np.sort(rng.integers(0, 100_000, n))
    x, y = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n)
    return Events.from_arrays(x, y, t, rng.integers(0, 2, n))


@dataclass
class CutSource:
    """Source of events in packets that end anywhere, also between events of one time, and in the middle of nothing."""

    events: Events
    edges: list[int]
    pause_s: float = 0.0
    """Pause before each packet [s]. Without it, a session takes many packets together."""
    size = SIZE
    camera = None
    prism = None
    encoders = 0
    name = "cut"

    def packets(self) -> Iterator[Packet]:
        for start, stop in zip([0, *self.edges], [*self.edges, len(self.events)], strict=True):
            time.sleep(self.pause_s)
            yield make_packet(monotonic_us(), self.events[start:stop])

    def close(self) -> None:
        pass


def cut(events: Events, seed: int) -> CutSource:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 200))
    return CutSource(events, np.sort(rng.integers(0, len(events) + 1, count)).tolist())


def ran(source: CutSource, **options: object) -> tuple[SessionStatus, list[Compensated]]:
    packets: list[Compensated] = []
    session = Session(source, sinks=(packets.append,), say=lambda _: None, **options)  # type: ignore[arg-type]
    return session.run(threading.Event(), lambda _: None), packets


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_filtered_stream_is_the_filtered_file(name: str, seed: int) -> None:
    events = some_events()
    source = cut(events, seed)
    if seed > 1:
        source.pause_s = 5e-4  # most packets go through the stages alone
    status, packets = ran(source, chosen=FILTERS[name])
    wanted = FILTERS[name].apply(events, SIZE)
    assert 100 < len(wanted) < len(events) - 100 or name == "hot"
    assert_equal(Events.concatenate([packet.events for packet in packets]), wanted)
    assert all(packet.events.whole_pixels and not packet.flags.any() for packet in packets)
    read, chosen = status.stages
    assert (read.name, chosen.name) == ("read", "filter")
    assert read.received == read.passed == chosen.received == len(events)
    assert chosen.passed == len(wanted)
    assert sum(chosen.removed.values()) == len(events) - len(wanted)
    assert all(chosen.removed.values())
    assert chosen.latency_ms is not None


@pytest.mark.parametrize("lens", [LENS.distortion, Fisheye(-0.01), None], ids=str)
def test_an_undistorted_stream_is_the_undistorted_file(lens: object) -> None:
    camera = Camera(WIDTH, HEIGHT, 50.0, 52.0, 30.5, 24.0, lens)  # type: ignore[arg-type]
    events = some_events()
    source = cut(events, 4)
    source.pause_s = 5e-4
    status, packets = ran(source, undistort=camera)
    found = Events.concatenate([packet.events for packet in packets])
    wanted = camera.undistort(events)
    assert_equal(found, wanted)
    outside = np.concatenate([packet.flags for packet in packets]) == OUTSIDE
    in_columns = (wanted.x >= -0.5) & (wanted.x < WIDTH - 0.5)
    in_rows = (wanted.y >= -0.5) & (wanted.y < HEIGHT - 0.5)
    assert np.array_equal(outside, ~(in_columns & in_rows))
    undistort = status.stages[-1]
    assert undistort.name == "undistort"
    assert undistort.marked == {"outside": int(np.count_nonzero(outside))}
    assert (undistort.marked["outside"] > 100) == (lens is not None)
    assert undistort.received == undistort.passed == len(events)


def test_the_filter_sees_the_sensor_and_not_the_undistorted_image() -> None:
    events = some_events()
    _, packets = ran(cut(events, 7), chosen=FILTERS["all"], undistort=LENS)
    found = Events.concatenate([packet.events for packet in packets])
    assert_equal(found, LENS.undistort(FILTERS["all"].apply(events, SIZE)))


def test_events_of_the_sensor_reach_raw_consumers_before_the_filter() -> None:
    class Kept:
        def __init__(self) -> None:
            self.events: list[Events] = []

        def append(self, events: Events) -> None:
            self.events.append(events)

        def append_encoder(self, *_: object, **__: object) -> None:
            raise AssertionError("a plain camera has no encoder")

        def tick(self) -> None:
            pass

    kept = Kept()
    events = some_events()
    ran(cut(events, 8), chosen=FILTERS["refractory"], raw=(kept,))
    assert_equal(Events.concatenate(kept.events), events)


@pytest.mark.parametrize("policy", [Policy.DROP_OLDEST, Policy.THIN])
def test_events_that_the_queue_drops_are_counted_by_the_first_stage(policy: Policy) -> None:
    events = some_events()
    source = CutSource(events, list(range(100, len(events), 100)))
    release = threading.Event()
    count = 0

    def slow(packet: Compensated) -> None:
        nonlocal count
        count += len(packet.events)
        release.wait(0.3)
        release.set()

    session = Session(
        source, sinks=(slow,), policy=policy, queue_events=2000, say=lambda _: None,
        chosen=FILTERS["region"],
    )  # fmt: skip
    status = session.run(threading.Event(), lambda _: None)
    read, chosen = status.stages
    assert read.removed["queue"] > 1000
    assert read.received == len(events) == read.passed + read.removed["queue"]
    assert chosen.received == read.passed
    assert chosen.passed == count == chosen.received - chosen.removed["region"]


def test_a_stage_that_removes_everything_gives_no_packet() -> None:
    events = some_events(500)
    empty = EventFilter(polarity=1)
    off = Events(events.x, events.y, events.t, np.zeros(len(events), np.uint8))
    status, packets = ran(cut(off, 2), chosen=empty, undistort=LENS)
    assert packets == []
    assert [(stage.name, stage.passed) for stage in status.stages] == [
        ("read", 500), ("filter", 0), ("undistort", 0),
    ]  # fmt: skip
