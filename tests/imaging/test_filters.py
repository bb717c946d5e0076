"""Filters of events, against plain Python, in blocks of any length; and ``amiwarp filter``."""

import itertools
import json
import math
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Camera,
    ErrorCode,
    EventFilter,
    Events,
    ImuSamples,
    MemoryEvents,
    MemoryImages,
    Prism,
    Recording,
    filter_recording,
    find_hot_pixels,
    open_recording,
    save_recording,
    simulate,
)
from amiwarp.imaging.filters import RunningFilter
from tests.command_line import app
from tests.errors import refused
from tests.io.test_io_readers import assert_equal

WIDTH, HEIGHT = 14, 9


def some_events(n: int = 3000, seed: int = 0) -> Events:
    """Return events at random pixels, several at many a time."""
    rng = np.random.default_rng(seed)
    t = 10_000 + np.sort(rng.integers(0, 40_000, n))
    x = rng.integers(0, WIDTH, n).astype(np.uint16)
    y = rng.integers(0, HEIGHT, n).astype(np.uint16)
    return Events(x, y, t, rng.integers(0, 2, n).astype(np.uint8))


def expected(events: Events, chosen: EventFilter) -> list[int]:
    """Return the indices of the kept events, one event at a time."""
    last_kept: dict[tuple[int, int], int] = {}
    last_fired: dict[tuple[int, int], int] = defaultdict(lambda: -(10**9))
    credit = most = max(1.0, chosen.most_per_s * 1e-3)
    last_t = None
    left = 0
    out = []
    for i, (x, y, t, p) in enumerate(
        zip(events.x.tolist(), events.y.tolist(), events.t.tolist(), events.p.tolist(), strict=True)
    ):
        if chosen.window is not None and not chosen.window[0] <= t < chosen.window[1]:
            continue
        if chosen.region is not None:
            left_edge, top, right, bottom = chosen.region
            if not (left_edge <= x < right and top <= y < bottom):
                continue
        if chosen.polarity is not None and p != chosen.polarity:
            continue
        if chosen.hot_pixels is not None and chosen.hot_pixels[y, x]:
            continue
        if chosen.refractory_us:
            if (x, y) in last_kept and t - last_kept[x, y] < chosen.refractory_us:
                continue
            last_kept[x, y] = t
        if chosen.background_us:
            around = [(x + a, y + b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]
            supported = any(t - last_fired[pixel] <= chosen.background_us for pixel in around)
            last_fired[x, y] = t
            if not supported:
                continue
        if chosen.most_per_s:
            if last_t is not None:
                credit = min(most, credit + 1e-6 * chosen.most_per_s * (t - last_t))
            last_t = t
            if credit < 1.0:
                continue
            credit -= 1.0
        left += 1
        if (left - 1) % chosen.every == 0:
            out.append(i)
    return out


HOT = np.zeros((HEIGHT, WIDTH), np.bool_)
HOT[3, 5] = HOT[8, 13] = True
FILTERS = {
    "window": EventFilter(window=(20_000, 30_000)),
    "region": EventFilter(region=(2, 1, 13, 9)),
    "ON": EventFilter(polarity=1),
    "OFF": EventFilter(polarity=0),
    "hot pixels": EventFilter(hot_pixels=HOT),
    "refractory": EventFilter(refractory_us=1500),
    "background": EventFilter(background_us=40),
    "rate": EventFilter(most_per_s=20_000.0),
    "low rate": EventFilter(most_per_s=300.0),
    "every": EventFilter(every=7),
    "all": EventFilter(
        window=(15_000, 45_000), region=(1, 0, 14, 8), hot_pixels=HOT, refractory_us=700, background_us=100,
        most_per_s=30_000.0, every=2,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FILTERS)
def test_each_part_keeps_what_plain_python_keeps_in_blocks_of_any_length(name: str) -> None:
    events, chosen = some_events(), FILTERS[name]
    known = expected(events, chosen)
    assert 5 < len(known) < len(events)
    assert_equal(chosen.apply(events, (WIDTH, HEIGHT)), events[np.array(known)])
    for cuts in ([], [1, 2, 700], [1500, 1500, 2999]):
        running = RunningFilter(chosen, (WIDTH, HEIGHT))
        edges = [0, *cuts, len(events)]
        kept = [running.keep(events[a:b]) for a, b in itertools.pairwise(edges)]
        assert np.flatnonzero(np.concatenate(kept)).tolist() == known
        assert sum(running.removed.values()) == len(events) - len(known)
        assert len(running.removed) == (7 if name == "all" else 1)


@pytest.mark.parametrize(
    ("refractory_us", "background_us"),
    [(900_000_000, 0), (0, 800_000_000), (600_000_000, 999_999_999)],
)
@pytest.mark.parametrize("start", [0, -(2**59)])
def test_times_of_pixels_are_kept_over_hours(
    refractory_us: int, background_us: int, start: int
) -> None:
    """The filter remembers times from a base, which it moves every 1000 s."""
    rng = np.random.default_rng(4)
    n = 2500
    steps = rng.choice(
        [1, 70_000, 250_000_000, 999_999_999, 1_000_000_001, 5_000_000_000],
        n,
        p=[0.3, 0.3, 0.25, 0.06, 0.06, 0.03],
    )
    t = start + np.cumsum(steps)
    x, y = rng.integers(0, 5, n), rng.integers(0, 4, n)
    events = Events.from_arrays(x, y, t, rng.integers(0, 2, n))
    chosen = EventFilter(refractory_us=refractory_us, background_us=background_us)
    known = expected(Events(events.x, events.y, events.t - start, events.p), chosen)
    assert 200 < len(known) < n - 200
    running = RunningFilter(chosen, (5, 4))
    kept = [running.kept(events[a : a + 300]) for a in range(0, n, 300)]
    assert_equal(Events.concatenate(kept), events[np.array(known)])
    assert sum(running.removed.values()) == n - len(known)


def test_removed_events_of_hot_pixels_are_counted_one_by_one() -> None:
    events = some_events()
    running = RunningFilter(EventFilter(hot_pixels=HOT), (WIDTH, HEIGHT))
    for a, b in ((0, 1400), (1400, len(events))):
        running.keep(events[a:b])
    counted = [
        (x, y, int(np.count_nonzero((events.x == x) & (events.y == y))))
        for x, y in ((5, 3), (13, 8))
    ]
    assert running.hot_counts() == tuple(sorted(counted, key=lambda each: -each[2]))
    assert min(count for *_, count in counted) > 2
    assert sum(count for *_, count in counted) == running.removed["hot_pixels"]


def test_a_limited_rate_is_even_and_allows_a_short_burst() -> None:
    t = np.concatenate([np.arange(0, 100_000, 10), [300_000] * 30])
    zeros = np.zeros(len(t), np.uint16)
    kept = (
        EventFilter(most_per_s=10_000.0)
        .apply(Events(zeros, zeros, t, zeros.astype(np.uint8)), (1, 1))
        .t
    )
    steady = kept[(kept > 5_000) & (kept < 100_000)]
    assert set(np.diff(steady).tolist()) == {100}
    assert np.count_nonzero(kept == 300_000) == 10  # a millisecond's


def test_hot_pixels_are_found_but_not_an_edge_at_rest() -> None:
    events = some_events(2000, seed=2)
    # two hot pixels side by side, one at the border, and a line with both ends
    extra_x = np.concatenate([np.repeat([4, 5, 13], 400), np.tile(np.arange(2, 9), 100)]).astype(
        np.uint16
    )
    extra_y = np.concatenate([np.repeat([8, 8, 1], 400), np.full(700, 4)]).astype(np.uint16)
    x, y = np.concatenate([events.x, extra_x]), np.concatenate([events.y, extra_y])
    t = np.arange(len(x))
    whole = Events(x, y, t, np.zeros(len(x), np.uint8))
    hot = find_hot_pixels(whole, (WIDTH, HEIGHT))
    assert np.argwhere(hot).tolist() == [[1, 13], [8, 4], [8, 5]]
    assert np.array_equal(find_hot_pixels(MemoryEvents(whole, WIDTH, HEIGHT), (WIDTH, HEIGHT)), hot)


def test_simulated_hot_pixels_are_found() -> None:
    """Where no edge passes. Next to a busy edge, a pixel of 40 events does not stand out."""
    camera = Camera.from_fov(120, 90, math.radians(50))
    picture = np.where(np.arange(300) < 150, 0.3, 0.6) * np.ones((200, 1))
    recording = simulate(picture, camera, Prism(math.radians(1.0)), duration_s=0.5, seed=3)
    truth = recording.truth
    assert truth is not None
    events = recording.events.slice(0, len(recording.events))
    cause = truth.of_events(0, len(events)).cause
    assert cause is not None
    from_hot = events[cause == 3]
    counts = np.bincount(from_hot.y.astype(int) * 120 + from_hot.x, minlength=120 * 90).reshape(
        90, 120
    )
    found = find_hot_pixels(events, (120, 90))
    away = np.abs(np.arange(120) - 59.5) > 20.0
    busy = (counts >= 12) & away  # they fire alone there
    assert busy.any()
    assert found[busy].all()
    assert not (found & (counts == 0)).any()


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"window": (5, 5)}, "the end after the start"),
        ({"region": (4, 0, 4, 9)}, "region is"),
        ({"polarity": 2}, "polarity"),
        ({"every": 0}, "every"),
        ({"refractory_us": -1}, "refractory_us"),
        ({"background_us": 1_000_000_001}, "background_us"),
        ({"most_per_s": math.nan}, "most_per_s"),
    ],
)
def test_wrong_values_are_refused(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(AmiwarpError, match=says):
        EventFilter(**wrong)


def test_a_filter_that_does_not_fit_the_sensor_is_refused() -> None:
    with pytest.raises(AmiwarpError, match=r"region is .*; expected a part of the image of 14x9"):
        EventFilter(region=(0, 0, 15, 9)).apply(some_events(), (WIDTH, HEIGHT))
    with pytest.raises(
        AmiwarpError, match=r"hot_pixels has shape \(9, 14\).*expected booleans of shape \(14, 9\)"
    ):
        EventFilter(hot_pixels=HOT).apply(some_events(), (HEIGHT, WIDTH))
    running = RunningFilter(EventFilter(every=2), (WIDTH, HEIGHT))
    running.keep(some_events())
    with pytest.raises(AmiwarpError, match="earlier"):
        running.keep(some_events())


def run(*args: Any) -> Any:
    result = CliRunner().invoke(app, [str(arg) for arg in args])
    assert result.exit_code in (0, 1), result.output
    return result


def test_a_file_is_filtered_with_all_that_it_holds(tmp_path: Path, texture: np.ndarray) -> None:
    camera, prism = Camera.from_fov(120, 90, math.radians(50)), Prism(math.radians(1.0))
    recording = simulate(texture, camera, prism, duration_s=0.2, seed=1, nominal_prism=prism)
    save_recording(tmp_path / "in.h5", recording)
    first = recording.events.t_first
    result = run(
        "filter", tmp_path / "in.h5", tmp_path / "out.h5", "--window", "0.05:0.15", "--region", "10,20,100,80",
        "--only", "off", "--refractory-us", "500", "--background-ms", "5", "--hot-pixels", "--json",
    )  # fmt: skip
    data = json.loads(result.stdout)
    found = open_recording(tmp_path / "out.h5")
    events = found.events.slice(0, len(found.events))
    assert len(events) == data["kept"] == data["events"] - sum(data["removed"].values())
    assert list(data["removed"]) == [
        "window",
        "region",
        "polarity",
        "hot_pixels",
        "refractory_us",
        "background_us",
    ]
    assert events.t.min() >= first + 50_000
    assert events.t.max() < first + 150_000
    assert (events.x >= 10).all()
    assert (events.x < 100).all()
    assert (events.y >= 20).all()
    assert (events.y < 80).all()
    assert not events.p.any()
    assert (found.camera, found.prism) == (recording.camera, recording.prism)
    assert found.encoder is not None
    assert found.truth is not None
    assert recording.truth is not None
    # the ground truth is that of the kept events
    whole = recording.events.slice(0, len(recording.events))
    keys = {
        (x, y, t): point
        for x, y, t, point in zip(
            whole.x.tolist(), whole.y.tolist(), whole.t.tolist(),
            np.asarray(recording.truth.points(0, len(whole))).tolist(), strict=True,
        )
    }  # fmt: skip
    points = np.asarray(found.truth.points(0, len(events))).tolist()
    for x, y, t, point in zip(
        events.x.tolist(), events.y.tolist(), events.t.tolist(), points, strict=True
    ):
        assert keys[x, y, t] == point
    assert "window (" in str(found.metadata["filter"])
    assert "background_us 5000" in str(found.metadata["filter"])
    filter_recording(found, tmp_path / "again.h5", EventFilter(every=2))
    assert str(open_recording(tmp_path / "again.h5").metadata["filter"]).endswith(
        "background_us 5000; then every 2"
    )


def sensors(t: list[int]) -> dict[str, Any]:
    """Return IMU samples and frames at some times, whose values tell their index."""
    values = np.arange(3.0 * len(t)).reshape(-1, 3)
    images = [np.full((2, 3), index, np.uint8) for index in range(len(t))]
    return {
        "imu": ImuSamples(np.array(t), values, -values),
        "frames": MemoryImages(np.array(t), images),
    }


def test_a_window_cuts_other_records(tmp_path: Path) -> None:
    times = [9_000, 19_999, 20_000, 25_000, 29_999, 30_000, 60_000]
    counts = {"imu_samples": 7, "frames": 7, "triggers": 5, "note": "kept"}
    recording = Recording(
        MemoryEvents(some_events(), WIDTH, HEIGHT), metadata=counts, **sensors(times)
    )
    summary = filter_recording(recording, tmp_path / "out.h5", EventFilter(window=(20_000, 30_000)))
    in_window = recording.events.between(20_000, 30_000).t
    assert summary.kept_us == in_window[-1] - in_window[0] < summary.duration_us
    assert (summary.removed_records, summary.left_out) == (
        {"imu_samples": 4, "frames": 4},
        ("triggers",),
    )
    found = open_recording(tmp_path / "out.h5")
    assert found.imu is not None
    assert found.frames is not None
    assert found.imu.t.tolist() == found.frames.t.tolist() == times[2:5]
    assert found.imu.angular_velocity[:, 0].tolist() == [6.0, 9.0, 12.0]
    assert found.imu.acceleration[:, 0].tolist() == [-6.0, -9.0, -12.0]
    assert [int(image[0, 0]) for image in found.frames] == [2, 3, 4]
    assert {name: found.metadata.get(name) for name in counts} == {
        "imu_samples": 3, "frames": 3, "triggers": None, "note": "kept",
    }  # fmt: skip
    whole = filter_recording(recording, tmp_path / "every.h5", EventFilter(every=2))
    assert (whole.removed_records, whole.left_out) == ({}, ())
    found = open_recording(tmp_path / "every.h5")
    assert found.imu is not None
    assert found.imu.t.tolist() == times
    assert found.metadata["triggers"] == 5


class _InBlocks(MemoryEvents):
    """Events that are read in blocks of a hundred."""

    def blocks(self, *, count: int | None = None, duration_us: int | None = None) -> Any:
        return super().blocks(count=100)


def test_the_kept_time_spans_all_blocks(tmp_path: Path) -> None:
    events = some_events()
    recording = Recording(_InBlocks(events, WIDTH, HEIGHT))
    summary = filter_recording(recording, tmp_path / "out.h5", EventFilter(window=(20_000, 30_000)))
    t = events.t[(events.t >= 20_000) & (events.t < 30_000)]
    assert (summary.kept, summary.kept_us) == (len(t), t[-1] - t[0])


def test_a_window_without_other_records(tmp_path: Path) -> None:
    recording = Recording(MemoryEvents(some_events(), WIDTH, HEIGHT), **sensors([60_000]))
    save_recording(tmp_path / "in.h5", recording)
    first = recording.events.t_first
    window = f"0:{(30_000 - first) * 1e-6}"
    result = run("filter", tmp_path / "in.h5", tmp_path / "out.h5", "--window", window)
    assert "removed by time: 1 IMU samples, 1 frames" in result.stdout
    found = open_recording(tmp_path / "out.h5")
    assert (found.imu, found.frames) == (None, None)
    assert (len(found.events), found.events.t_last < 30_000) == (
        np.count_nonzero(some_events().t < 30_000),
        True,
    )


def test_other_formats_and_lines_of_text(tmp_path: Path) -> None:
    events = some_events()
    save_recording(tmp_path / "in.h5", Recording(MemoryEvents(events, WIDTH, HEIGHT)))
    result = run("filter", tmp_path / "in.h5", tmp_path / "out.raw", "--every", "3", "--hot-pixels")
    assert "out.raw: 1,000 of 3,000 events (33.3 %)" in " ".join(result.stdout.split())
    assert "removed by every n-th: 2,000" in result.stdout
    found = open_recording(tmp_path / "out.raw")
    assert_equal(found.events.slice(0, 2000), events[np.arange(0, 3000, 3)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.h5", "out.raw"]
    (tmp_path / "mine.raw").write_text("mine")
    with refused(ErrorCode.OUTPUT_EXISTS):
        filter_recording(
            open_recording(tmp_path / "in.h5"), tmp_path / "mine.raw", EventFilter(every=2)
        )


def test_a_table_is_filtered_with_the_options_for_its_layout(tmp_path: Path) -> None:
    lines = "".join(f"{k},{k % 9},{k % 7},{k % 2}\n" for k in range(100))
    (tmp_path / "a.csv").write_text("when,column,line,sign\n" + lines)
    columns = ("--columns", "t=when,x=column,y=line,p=sign", "--time-unit", "ms", "--size", "9x7")
    result = run(
        "filter", tmp_path / "a.csv", tmp_path / "out.h5", "--window", "0.02:0.05", *columns
    )
    assert result.exit_code == 0, result.output
    found = open_recording(tmp_path / "out.h5")
    assert found.events.slice(0, 99).t.tolist() == list(range(20_000, 50_000, 1000))
    assert found.events.size == (9, 7)
    same = EventFilter(hot_pixels=HOT)
    assert same == EventFilter(hot_pixels=~HOT)  # compared without the arrays
    assert hash(same) == hash(EventFilter())


def test_a_filter_that_keeps_nothing_or_says_nothing_leaves_no_file(tmp_path: Path) -> None:
    save_recording(tmp_path / "in.h5", Recording(MemoryEvents(some_events(), WIDTH, HEIGHT)))
    result = run("filter", tmp_path / "in.h5", tmp_path / "out.h5", "--window", "5:6")
    assert result.exit_code == 1
    assert "in: the filter keeps none of 3,000 events" in " ".join(result.stderr.split())
    result = run("filter", tmp_path / "in.h5", tmp_path / "out.raw", "--window", "5:6")
    assert "in: the filter keeps none of 3,000 events" in " ".join(result.stderr.split())
    result = run("filter", tmp_path / "in.h5", tmp_path / "out.h5")
    assert "no filter is chosen" in " ".join(result.stderr.split())
    result = run("filter", tmp_path / "in.h5", tmp_path / "out.h5", "--region", "0,0,2.5,4")
    assert "whole pixels" in " ".join(result.stderr.split())
    assert [path.name for path in tmp_path.iterdir()] == ["in.h5"]
