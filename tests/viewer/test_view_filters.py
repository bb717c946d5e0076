"""Filters, hot pixels, windows by number of events, decaying time surfaces and frequencies of the inspector."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Camera,
    EventFilter,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    filter_recording,
    find_hot_pixels,
    open_recording,
    simulate,
)
from amiwarp.imaging.filters import NAMES
from amiwarp.imaging.frequencies import pixel_frequencies, strongest
from amiwarp.io import spans
from amiwarp.viewer import (
    ImageKind,
    Inspector,
    Selection,
    apply_state,
    current_state,
    decode_state,
    encode_state,
    make_images,
)
from amiwarp.viewer import inspector as viewer
from amiwarp.viewer.calibration_job import calibrated_events
from amiwarp.viewer.captions import events_text
from amiwarp.viewer.downloads import write_events
from amiwarp.viewer.filters import FilterStep, rate_text, step_rows
from amiwarp.viewer.view_state import History

WIDTH, HEIGHT, LENGTH_US = 48, 36, 200_000
HOT = (7, 30)


def sorted_events(rows: np.ndarray) -> Events:
    """Return the events of rows of x, y, t and p, in the order of time."""
    x, y, t, p = rows[np.argsort(rows[:, 2], kind="stable")].T
    return Events(x.astype(np.uint16), y.astype(np.uint16), t.astype(np.int64), p.astype(np.uint8))


def blinking(x: int, y: int, hz: float, phase_us: float = 0.0) -> np.ndarray:
    """Return the events of a pixel that blinks: two ON events, and half a period later two OFF events."""
    starts = np.arange(phase_us, LENGTH_US, 1e6 / hz)
    rows = [
        np.stack(
            [
                np.full(len(starts), x),
                np.full(len(starts), y),
                starts + later,
                np.full(len(starts), p),
            ],
            1,
        )
        for later, p in ((0.0, 1), (300.0, 1), (0.5e6 / hz, 0), (0.5e6 / hz + 300.0, 0))
    ]
    return np.concatenate(rows)


@pytest.fixture(scope="module")
def plain() -> Recording:
    """Return a recording without a prism: random events, a hot pixel and lamps of 100 and 250 Hz."""
    rng = np.random.default_rng(5)
    n = 12_000
    noise = np.stack(
        [
            rng.integers(0, WIDTH, n),
            rng.integers(0, HEIGHT, n),
            rng.integers(0, LENGTH_US, n),
            rng.integers(0, 2, n),
        ],
        1,
    )
    hot = np.stack(
        [np.full(900, HOT[0]), np.full(900, HOT[1]), np.arange(900) * 220, np.arange(900) % 2], 1
    )
    slow = [blinking(x, 4, 100.0, 40.0 * x) for x in range(20, 30)]
    fast = [blinking(x, 9, 250.0, 40.0 * x) for x in range(20, 25)]
    rows = np.concatenate([noise, hot, *slow, *fast])
    return Recording(
        MemoryEvents(sorted_events(rows[rows[:, 2] < LENGTH_US]), WIDTH, HEIGHT), name="plain"
    )


def opened(recording: Recording, selection: Selection) -> Inspector:
    """Return an inspector that shows the whole time."""
    made = Inspector(recording)
    made.open(
        recording.events.t_first, recording.events.t_last - recording.events.t_first + 1, selection
    )
    return made


CHAIN = Selection(1, (2, 1, 40, 34), True, 3000, 500, 10_000.0, 2)


def test_the_selection_is_that_of_the_filter_command(plain: Recording, tmp_path: Path) -> None:
    made = opened(plain, CHAIN)
    events, size = plain.events.slice(0, len(plain.events)), plain.events.size
    chosen = EventFilter(
        region=CHAIN.region, polarity=1, hot_pixels=find_hot_pixels(events, size), refractory_us=500,
        background_us=3000, most_per_s=10_000.0, every=2,
    )  # fmt: skip
    kept = chosen.apply(events, size)
    assert made.loaded.selected == len(kept)
    for ours, given in ((made.loaded.counted.x, kept.x), (made.loaded.counted.t, kept.t)):
        np.testing.assert_array_equal(ours, given)
    removed = filter_recording(plain, tmp_path / "kept.h5", chosen).removed
    steps = made.loaded.steps
    assert {step.name: step.before - step.after for step in steps} == {
        NAMES[n]: k for n, k in removed.items()
    }
    assert all(first.after == second.before for first, second in pairwise(steps))
    assert (steps[0].before, steps[-1].after) == (len(events), len(kept))
    assert all(step.after < step.before for step in steps)


def test_without_a_filter_there_are_no_steps(plain: Recording) -> None:
    assert opened(plain, Selection()).loaded.steps == ()


@pytest.mark.parametrize(
    "selection",
    [
        Selection(refractory_us=2000),
        Selection(every=3),
        Selection(most_per_s=20_000.0),
        Selection(hide_hot=True),
    ],
)
def test_a_downloaded_file_holds_the_shown_events_whatever_the_blocks(
    plain: Recording, selection: Selection, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = opened(plain, selection).loaded.counted
    assert 100 < len(expected) < len(plain.events)
    monkeypatch.setattr(viewer, "MOST_EVENTS", 6400)
    assert spans.blocks_between.__kwdefaults__ is not None
    monkeypatch.setitem(spans.blocks_between.__kwdefaults__, "count", 500)
    thinned = opened(plain, selection)
    assert len(thinned.loaded.span.events) < thinned.loaded.span.count
    assert write_events(thinned, tmp_path / "events.h5", compensated=False) == len(expected)
    written = open_recording(tmp_path / "events.h5").events
    np.testing.assert_array_equal(written.slice(0, len(written)).t, expected.t)


def test_steps_count_the_events_of_the_region_though_more_are_kept_around_it(
    texture: np.ndarray,
) -> None:
    camera = Camera.from_fov(160, 120, math.radians(60))
    turning = simulate(texture, camera, Prism(math.radians(1.0)), duration_s=0.1, seed=1)
    made = Inspector(turning)
    made.take_truth()
    made.open(*made.first_window(), Selection(region=(40, 30, 120, 90), refractory_us=4000))
    region, refractory = made.loaded.steps
    assert (region.name, refractory.name) == ("region", "refractory period")
    assert region.before == len(made.loaded.span.events)
    assert region.after == refractory.before
    assert refractory.after == made.loaded.selected < len(made.loaded.counted)
    assert refractory.after < refractory.before


def test_the_texts_of_steps_have_rates_before_and_after() -> None:
    rows = step_rows((FilterStep("rate", 120_000, 85_000),), 100_000.0)
    assert rows == [["rate", "1.2 → 0.85 Mev/s", "120,000 → 85,000 events (−29.2 %)"]]
    assert [rate_text(each) for each in (12.0, 999.7, 12_345.0)] == [
        "12 ev/s",
        "1 kev/s",
        "12.3 kev/s",
    ]


def test_hot_pixels_are_listed_with_rate_and_share(plain: Recording) -> None:
    made = Inspector(plain)
    first = made.hot_pixels[0]
    assert (first.x, first.y) == HOT
    events = plain.events.slice(0, len(plain.events))
    mask = (events.x == HOT[0]) & (events.y == HOT[1])
    duration_s = 1e-6 * float(events.t[-1] - events.t[0] + 1)
    assert first.rate == pytest.approx(mask.sum() / duration_s)
    assert first.share == pytest.approx(mask.mean())
    assert [each.rate for each in made.hot_pixels] == sorted(
        (each.rate for each in made.hot_pixels), reverse=True
    )
    kept = opened(plain, Selection(hide_hot=True)).loaded.counted
    assert not ((kept.x == HOT[0]) & (kept.y == HOT[1])).any()


# frequencies


def test_the_frequency_of_lamps_is_found_and_random_events_have_none(plain: Recording) -> None:
    events = plain.events.slice(0, len(plain.events))
    found = pixel_frequencies(events, plain.events.size)
    assert found.shape == (HEIGHT, WIDTH)
    np.testing.assert_allclose(found[4, 20:30], 100.0, rtol=0.05)
    np.testing.assert_allclose(found[9, 20:25], 250.0, rtol=0.05)
    found[4, 20:30] = found[9, 20:25] = np.nan
    assert np.isfinite(found).mean() < 0.005


def test_the_frequency_is_exact_without_noise() -> None:
    found = pixel_frequencies(sorted_events(blinking(3, 2, 62.5)), (8, 6))
    assert found[2, 3] == pytest.approx(62.5, rel=1e-4)
    assert np.isnan(np.delete(found.ravel(), 2 * 8 + 3)).all()


def test_few_periods_and_one_polarity_have_no_frequency() -> None:
    rows = blinking(3, 2, 50.0)
    periods = pixel_frequencies(sorted_events(rows[rows[:, 2] < 100_500]), (8, 6))
    assert periods[2, 3] == pytest.approx(50.0, rel=1e-4)  # 4 periods
    assert np.isnan(pixel_frequencies(sorted_events(rows[rows[:, 2] < 99_500]), (8, 6))).all()
    assert np.isnan(pixel_frequencies(sorted_events(rows[rows[:, 3] == 1]), (8, 6))).all()
    assert np.isnan(pixel_frequencies(Events.empty(), (8, 6))).all()


def test_no_period_is_counted_over_a_gap() -> None:
    rows = blinking(3, 2, 100.0)
    runs = [
        rows[(rows[:, 2] >= start) & (rows[:, 2] < start + 18_000)]
        for start in range(0, LENGTH_US, 40_000)
    ]
    events, starts = sorted_events(np.concatenate(runs)), np.arange(0, LENGTH_US, 40_000)
    # That of the gaps
    assert pixel_frequencies(events, (8, 6))[2, 3] == pytest.approx(1e6 / 30_000.0, rel=1e-4)
    assert np.isnan(pixel_frequencies(events, (8, 6), starts=starts)).all()
    runs = [
        rows[(rows[:, 2] >= start) & (rows[:, 2] < start + 28_000)]
        for start in range(0, LENGTH_US, 40_000)
    ]
    events = sorted_events(np.concatenate(runs))
    assert pixel_frequencies(events, (8, 6), starts=starts)[2, 3] == pytest.approx(100.0, rel=1e-4)


def test_the_frequencies_of_most_pixels_are_named() -> None:
    image = np.full((4, 5), np.nan, np.float32)
    image[0] = [100.0, 101.0, 99.5, 250.0, 252.0]
    image[1, 0] = 3.0
    assert [count for _, count in strongest(image, 2)] == [3, 2]
    assert strongest(image, 3)[0][0] == pytest.approx(100.0, rel=0.02)


def test_images_of_frequencies_and_of_decay(plain: Recording) -> None:
    made = opened(plain, Selection(region=(10, 2, 40, 12)))
    images = make_images(made, ImageKind.FREQUENCY)
    assert images.after.shape == (10, 30)
    assert images.after[2, 10] == pytest.approx(100.0, rel=0.05)
    assert images.scale.unit == "Hz"
    assert images.scale.low < 100.0 < images.scale.high
    assert images.note.startswith("100 Hz: ")
    latest, decayed = (
        make_images(made, kind, decay_us=20_000)
        for kind in (ImageKind.TIME_SURFACE, ImageKind.DECAY)
    )
    length_ms = (made.recording.events.t_last - made.recording.events.t_first) * 1e-3
    np.testing.assert_allclose(decayed.after, np.exp((latest.after - length_ms) / 20.0), rtol=1e-5)
    assert decayed.scale.label == "exp(-age / 20 ms) [1]"
    made.open(100_000, 500_000)  # longer than the rest of the recording
    assert np.nanmax(make_images(made, ImageKind.DECAY, decay_us=20_000).after) > 0.95
    made.open(100_000, 50_000)
    latest, decayed = (
        make_images(made, kind, decay_us=20_000)
        for kind in (ImageKind.TIME_SURFACE, ImageKind.DECAY)
    )
    np.testing.assert_allclose(decayed.after, np.exp((latest.after - 50.0) / 20.0), rtol=1e-5)


def test_behind_a_prism_the_frequency_is_at_the_compensated_pixels(texture: np.ndarray) -> None:
    camera = Camera.from_fov(80, 60, math.radians(60))
    turning = simulate(texture, camera, Prism(math.radians(2.0)), duration_s=0.5, seed=1)
    made = Inspector(turning)
    made.take_truth()
    made.open(turning.events.t_first, 450_000)
    images = make_images(made, ImageKind.FREQUENCY)
    assert images.before is not None
    rounds = 1e6 / made.turn_us
    # The edges come back once a turn
    assert np.nanmedian(images.before) == pytest.approx(rounds, rel=0.03)
    assert not np.array_equal(images.before, images.after, equal_nan=True)
    at = made.at_pixels(made.loaded, made.knobs)
    assert int(made.counts(made.loaded, made.knobs).sum()) == len(at)


# windows by number of events


def test_a_window_set_by_number_keeps_it(plain: Recording) -> None:
    made = Inspector(plain)
    made.fixed_count = 700
    made.open(20_000, 5)
    assert made.loaded.span.count == pytest.approx(700, abs=5)
    start, length = made.window or (0, 0)
    assert start == 20_000
    times = plain.events.slice(0, len(plain.events)).t
    after = made.start_after(1)
    assert after == times[np.searchsorted(times, start + length)]
    made.open(after, 5)
    assert made.loaded.span.count == pytest.approx(700, abs=5)
    back = made.start_after(-1)
    assert np.searchsorted(times, after) - np.searchsorted(times, back) == pytest.approx(700, abs=5)
    made.open(int(times[-1]), 5)  # too few events follow
    assert made.loaded.span.count == pytest.approx(700, abs=5)
    assert sum(made.window or (0, 0)) == times[-1] + 1
    made.fixed_count = None
    made.open(20_000, 5_000)
    assert made.window == (20_000, 5_000)


def test_filters_and_number_are_in_the_address_and_undone(plain: Recording) -> None:
    made = Inspector(plain)
    history = History(first := current_state(made))
    made.fixed_count = 500
    made.open(30_000, 5, replace(CHAIN, hide_hot=False))
    state = current_state(made, decay_us=2500, same_scale=True)
    history.add(state)
    query = encode_state(state, first)
    for text in (
        "refractory_us=500",
        "most_per_s=10000",
        "every=2",
        "events=500",
        "decay_us=2500",
        "same_scale=1",
    ):
        assert text in query
    found, wrong = decode_state(query, first, size=plain.events.size, duration_us=LENGTH_US)
    assert (found, wrong) == (state, ())
    apply_state(made, history.undo())
    assert (made.fixed_count, made.selection, made.window) == (
        None,
        Selection(),
        first_window(made),
    )
    apply_state(made, history.redo())
    assert (made.fixed_count, made.loaded.selected) == (500, opened_count(plain, state))
    empty = replace(state, selection=Selection(region=(0, 0, 1, 1)), fixed_count=1)
    with pytest.raises(AmiwarpError):
        apply_state(made, empty)
    assert made.fixed_count == 500


def first_window(made: Inspector) -> tuple[int, int]:
    start, length = Inspector(made.recording).first_window()
    return start, length


def opened_count(recording: Recording, state: Any) -> int:
    """Return how many events a new inspector selects in a state."""
    made = Inspector(recording)
    apply_state(made, state)
    return made.loaded.selected


@pytest.mark.parametrize(
    "query",
    ["refractory_us=-1", "most_per_s=nan", "every=0", "events=x", "decay_us=0", "same_scale=2"],
)
def test_wrong_filters_of_an_address_are_explained(plain: Recording, query: str) -> None:
    first = current_state(Inspector(plain))
    found, wrong = decode_state(query, first, size=plain.events.size, duration_us=LENGTH_US)
    assert found == first
    assert len(wrong) == 1


def test_a_calibration_says_which_filters_its_events_passed(plain: Recording) -> None:
    made = opened(plain, replace(CHAIN, hide_hot=False))
    text = calibrated_events(made)[1]
    assert text.endswith(
        "without background activity (3 ms), refractory period 0.5 ms, at most 10 kev/s, one of 2 events"
    )
    assert "events" in events_text(made.show())


@pytest.mark.parametrize(
    ("rate", "said"),
    [(999_600.0, "1 Mev/s"), (999_400.0, "999 kev/s"), (999.6, "1 kev/s"), (12.0, "12 ev/s")],
)
def test_rates_have_at_most_three_digits_before_the_point(rate: float, said: str) -> None:
    assert rate_text(rate) == said
    step = FilterStep("rate", round(rate * 10), round(rate * 10))
    number, unit = said.split(" ")
    assert step_rows((step,), 1e7)[0][1] == f"{number} → {number} {unit}"
