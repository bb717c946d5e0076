"""Films of events show every event once, at its time, and are written completely or not at all."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from typer.testing import CliRunner

import amiwarp
from amiwarp import (
    AmiwarpError,
    Events,
    FilmMode,
    MemoryEvents,
    Recording,
    open_recording,
    render,
    save_recording,
)
from amiwarp.plotting import film, film_frames
from amiwarp.plotting.film_frames import Shown, Timing
from amiwarp.plotting.film_pictures import Caption
from tests.command_line import app

SIZE = WIDTH, HEIGHT = 40, 30
FIRST = 1_700_000_000_000_000  # us


def made(count: int = 4000, length_us: int = 100_000) -> Events:
    rng = np.random.default_rng(3)
    t = np.sort(rng.integers(0, length_us + 1, count))
    t[0], t[-1] = 0, length_us
    x, y = (rng.integers(0, side, count) for side in SIZE)
    return Events.from_arrays(x, y, FIRST + t, rng.integers(0, 2, count))


def recording(events: Events | None = None) -> Recording:
    return Recording(MemoryEvents(made() if events is None else events, *SIZE), name="plain")


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """The pictures that are given to the encoder."""
    found: list[np.ndarray] = []
    save = film.save_film

    def keep(frames: Iterator[np.ndarray], path: Path, **options: Any) -> int:
        def kept() -> Iterator[np.ndarray]:
            for frame in frames:
                found.append(frame)
                yield frame

        return save(kept(), path, **options)

    monkeypatch.setattr(film, "save_film", keep)
    return found


def counts(events: Events) -> np.ndarray:
    """Numbers of OFF and ON events per pixel."""
    image = np.zeros((2, HEIGHT, WIDTH), np.int64)
    np.add.at(image, (events.p, events.y, events.x), 1)
    return image


def assert_shows(picture: np.ndarray, events: Events) -> None:
    """OFF events are blue, ON events are orange, and more events of a pixel are not darker."""
    off, on = counts(events)
    red, _, blue = (picture[..., channel].astype(int) for channel in range(3))
    np.testing.assert_array_equal(picture.any(axis=2), (off + on) > 0)
    assert (blue[(off > 0) & (on == 0)] > red[(off > 0) & (on == 0)]).all()
    assert (red[(on > 0) & (off == 0)] > blue[(on > 0) & (off == 0)]).all()
    for values, number, other in ((blue, off, on), (red, on, off)):
        alone = (number > 0) & (other == 0)
        order = np.argsort(number[alone], kind="stable")
        assert (np.diff(values[alone][order]) >= 0).all()


PLAIN = {"scale": 1, "caption": False}


def between(events: Events, low: float, high: float) -> Events:
    start, stop = np.searchsorted(events.t - FIRST, [round(low), round(high)])
    return events[start:stop]


@pytest.mark.parametrize("speed", [1.0, 0.1, 0.007])
def test_each_event_is_in_the_frame_of_its_time(
    tmp_path: Path, pictures: list[np.ndarray], speed: float
) -> None:
    events = made()
    summary = render(recording(events), tmp_path / "a.mp4", fps=30.0, speed=speed, **PLAIN)
    step = 1e6 * speed / 30.0
    assert summary.frames == len(pictures) == -(-100_001 // step)
    assert (summary.events, summary.width, summary.height) == (len(events), WIDTH, HEIGHT)
    assert (summary.speed, summary.decay_us) == (pytest.approx(speed), None)
    for k, picture in enumerate(pictures):
        assert_shows(picture, between(events, k * step, (k + 1) * step))


def test_a_frame_may_hold_more_or_less_than_the_time_between_frames(
    tmp_path: Path, pictures: list[np.ndarray]
) -> None:
    events = made()
    for frame_us in (9_000, 700):
        pictures.clear()
        options = {"fps": 100.0, "speed": 0.2, "frame_us": frame_us, "overwrite": True, **PLAIN}
        summary = render(recording(events), tmp_path / "a.mp4", **options)
        shown = [between(events, (k + 1) * 2000 - frame_us, (k + 1) * 2000) for k in range(51)]
        assert summary.events == (len(events) if frame_us > 2000 else sum(map(len, shown)))
        assert len(pictures) == 51
        for k, picture in enumerate(pictures):
            assert_shows(picture, between(events, (k + 1) * 2000 - frame_us, (k + 1) * 2000))


def test_frames_of_a_time_follow_one_another(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    events = made()
    summary = render(recording(events), tmp_path / "a.mp4", fps=50.0, frame_us=4000, **PLAIN)
    assert (summary.frames, summary.speed) == (26, pytest.approx(0.2))
    for k, picture in enumerate(pictures):
        assert_shows(picture, between(events, k * 4000, (k + 1) * 4000))


def test_frames_of_a_number_of_events(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    events = made()
    summary = render(recording(events), tmp_path / "a.mp4", events=900, **PLAIN)
    assert (summary.frames, summary.events, summary.speed) == (5, 4000, None)
    for k, picture in enumerate(pictures):
        assert_shows(picture, events[900 * k : 900 * (k + 1)])


@pytest.mark.parametrize("decay_us", [None, 800.0])
def test_a_time_surface_decays_from_the_end_of_each_frame(
    tmp_path: Path, pictures: list[np.ndarray], decay_us: float | None
) -> None:
    """Of all earlier events, each of which is read once."""
    events = made()
    options = {"mode": "surface", "fps": 100.0, "speed": 0.1, "decay_us": decay_us}
    summary = render(recording(events), tmp_path / "a.mp4", **options, **PLAIN)
    decay = decay_us or 3000.0
    assert (summary.frames, summary.decay_us) == (101, pytest.approx(decay))
    for k, picture in enumerate(pictures):
        end = (k + 1) * 1000
        age = np.full((2, HEIGHT, WIDTH), np.inf)
        seen = between(events, 0, end)
        np.minimum.at(age, (seen.p, seen.y, seen.x), end - (seen.t - FIRST).astype(float))
        off, on = np.exp(-age / decay)
        expected = off[..., None] * np.array([0.2, 0.55, 1.0]) + on[..., None] * np.array(
            [1.0, 0.55, 0.1]
        )
        np.testing.assert_allclose(picture, 255 * np.clip(expected, 0, 1), rtol=0, atol=0.5 + 1e-3)


@pytest.mark.parametrize("mode", FilmMode)
def test_only_the_window_is_shown_and_read(
    tmp_path: Path, pictures: list[np.ndarray], mode: FilmMode
) -> None:
    events = made()
    window = FIRST + 20_000, FIRST + 45_000
    summary = render(
        recording(events),
        tmp_path / "a.mp4",
        mode=mode,
        fps=100.0,
        speed=0.5,
        window=window,
        **PLAIN,
    )
    assert (summary.frames, summary.events) == (5, len(between(events, 20_000, 45_000)))
    if mode is FilmMode.COUNTS:
        for k, picture in enumerate(pictures):
            assert_shows(picture, between(events, 20_000 + 5000 * k, 25_000 + 5000 * k))


def test_frames_do_not_depend_on_the_blocks_of_a_source(
    tmp_path: Path, pictures: list[np.ndarray]
) -> None:
    """A text file is read from its start in blocks of its own; parts of an HDF5 file are read on demand."""
    events = made()
    shown = []
    save_recording(tmp_path / "a.h5", recording(events))
    amiwarp.convert(tmp_path / "a.h5", tmp_path / "a.txt")
    for source in (
        recording(events),
        open_recording(tmp_path / "a.h5"),
        open_recording(tmp_path / "a.txt"),
    ):
        pictures.clear()
        window = FIRST + 3_000, FIRST + 90_001
        render(source, tmp_path / "a.mp4", speed=0.1, window=window, overwrite=True, **PLAIN)
        shown.append(np.array(pictures))
    np.testing.assert_array_equal(shown[1], shown[0])
    np.testing.assert_array_equal(shown[2], shown[0])


def test_blocks_are_read_as_frames_need_them() -> None:
    events, taken = made(), []

    def blocks() -> Iterator[Events]:
        for start in range(0, len(events), 100):
            taken.append(start)
            yield events[start : start + 100]

    timing = Timing(FIRST, 5000.0, 21)
    for k, shown in enumerate(film_frames.frames_of_time(blocks(), timing, None)):
        expected = between(events, 5000 * k, 5000 * (k + 1))
        np.testing.assert_array_equal(shown.events.t, expected.t)
        assert len(taken) * 100 <= np.searchsorted(events.t - FIRST, 5000 * (k + 1)) + 200


def test_a_frame_of_too_many_events_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(film_frames, "MOST_EVENTS", 1000)
    with pytest.raises(
        AmiwarpError, match="a frame holds more than 1,000 events; give a shorter --frame-ms"
    ):
        render(recording(), tmp_path / "a.mp4", fps=1.0)
    assert list(tmp_path.iterdir()) == []


def test_a_pause_is_dark_or_fades(tmp_path: Path, pictures: list[np.ndarray]) -> None:
    events = Events.from_arrays([1, 2], [3, 4], [FIRST, FIRST + 500_000], [1, 0])
    for mode in FilmMode:
        pictures.clear()
        summary = render(
            recording(events), tmp_path / "a.mp4", mode=mode, fps=30.0, overwrite=True, **PLAIN
        )
        assert (summary.frames, summary.events) == (16, 2)
        levels = [int(picture[3, 1].max()) for picture in pictures]
        if mode is FilmMode.COUNTS:
            assert levels == [255] + 15 * [0]
        else:
            assert (np.diff(levels[:12]) < 0).all()
        assert [bool(picture[4, 2].any()) for picture in pictures] == 15 * [False] + [True]


def test_the_brightness_follows_slowly_and_ignores_a_hot_pixel(
    tmp_path: Path, pictures: list[np.ndarray]
) -> None:
    """First 9 events at each of 40 pixels, then one at each and a hundred at another."""
    first = [(x, 1, 0) for x in range(40) for _ in range(9)]
    second = [(x, 2, 2000) for x in range(40)] + [(0, 3, 2000)] * 100
    x, y, t = np.array(first + second).T
    events = Events.from_arrays(x, y, FIRST + t, np.ones(len(x), np.int64))
    render(recording(events), tmp_path / "a.mp4", frame_us=1000, **PLAIN)
    assert [len(pictures), pictures[0][1, 5, 0], pictures[1].max()] == [3, 255, 0]
    top = 9.0 + 0.1 * (1.0 - 9.0)
    assert pictures[2][2, 5, 0] == round(255 * (1.0 / top) ** 0.5)
    assert pictures[2][3, 0, 0] == 255


def test_compensated_events_are_shown_at_their_nearest_pixels(
    tmp_path: Path, pictures: list[np.ndarray]
) -> None:
    x, y = (
        np.array([3.4, 5.6, np.nan, -9.0], np.float32),
        np.array([2.0, 7.4, 1.0, 2.0], np.float32),
    )
    events = Events(x, y, FIRST + np.arange(4), np.ones(4, np.uint8))
    for mode in FilmMode:
        pictures.clear()
        render(recording(events), tmp_path / "a.mp4", mode=mode, overwrite=True, **PLAIN)
        assert len(pictures) == 1
        assert pictures[0].any(axis=2)[[2, 7], [3, 6]].all()


def test_the_film_is_that_of_the_pictures_enlarged_with_a_caption(
    tmp_path: Path, pictures: list[np.ndarray]
) -> None:
    summary = render(recording(), tmp_path / "a.mp4", speed=0.1)
    assert (summary.width, summary.height) == (960, 720 + 30)  # 24 times, and a line of text
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert float(container.streams.video[0].average_rate) == 30.0
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == summary.frames == 31
    for frame, picture in zip(frames, pictures, strict=True):
        assert frame.shape == (750, 960, 3)
        assert np.abs(frame[: len(picture)].astype(int) - picture).mean() < 3.0
        assert (
            picture[: 24 * HEIGHT : 24, ::24].repeat(24, 0).repeat(24, 1) == picture[: 24 * HEIGHT]
        ).all()
        assert picture[24 * HEIGHT :].max() > 150


@pytest.mark.parametrize("count", [4000, 300])
def test_the_rate_is_that_of_all_events_since_the_frame_before(count: int) -> None:
    """Also if a frame shows only the last of them."""
    events = made()
    blocks = [events[k : k + count] for k in range(0, len(events), count)]
    timing = Timing(FIRST, 10_000.0, 10)
    for reach_us in (100, 10_000, 25_000):
        for k, shown in enumerate(film_frames.frames_of_time(blocks, timing, reach_us)):
            assert shown.new == len(between(events, k * 10_000, (k + 1) * 10_000))
            assert len(shown.events) == len(
                between(events, (k + 1) * 10_000 - reach_us, (k + 1) * 10_000)
            )


def test_the_caption_says_time_rate_colours_and_length() -> None:
    events = made()
    shown = Shown(events[:300], FIRST + 12_345, 250, 1000)
    texts = [text for text, _ in Caption(960, FIRST, 4, "1 ms").parts(shown)]
    assert texts == ["0.0123 s", "0.25 Mev/s", "OFF", "ON", "1 ms"]
    wide, narrow = (Caption(width, FIRST, 4, "1 ms")(shown) for width in (960, 100))
    assert (wide.shape[1], narrow.shape[1]) == (960, 100)
    assert wide[:, 300:].any()
    assert narrow.any()
    rates = ((3e5, "0.30 Mev/s"), (12_345.0, "12.35 kev/s"), (50.0, "50 ev/s"), (0.0, "0 ev/s"))
    for per_s, text in rates:
        slow = Shown(events[:3], FIRST, round(per_s * 100), 100_000_000)
        assert Caption(960, FIRST, 4, "").parts(slow)[1][0] == text
    timing = Timing(FIRST, 333.3, 5)
    for given, note in (
        ((timing, None, None), "0.3333 ms"),
        ((timing, 2000, None), "2 ms"),
        ((timing, None, 1500.0), "decay 1.5 ms"),
        ((None, None, None), "300 events"),
    ):
        assert film._caption(960, FIRST, *given).parts(shown)[-1][0] == note


REFUSED = [
    ({"events": 5, "speed": 0.1}, "--events and --speed or --frame-ms both choose"),
    ({"mode": "surface", "events": 5}, "--events and --frame-ms apply to counts"),
    ({"mode": "surface", "frame_us": 5}, "--events and --frame-ms apply to counts"),
    ({"decay_us": 5.0}, "--decay-ms applies to a time surface; give --mode surface"),
    ({"mode": "voxels"}, "mode is 'voxels'; choose among counts, surface"),
    ({"speed": 1e-6}, "a frame has 0.0333 us at speed 1e-06 and 30 frames/s, but at least 1 us"),
    ({"frame_us": 1, "fps": 1000.0, "scale": 65}, "scale = 65"),
    ({"fps": 0.0}, "fps = 0.0"),
    ({"speed": -1.0}, "speed = -1.0"),
    ({"window": (0, 5)}, "has no events in the window; they span 0 .. 0.1 s from the first"),
    ({"window": (0, 5.5)}, "window"),
    ({"events": 0}, "events = 0"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED)
def test_what_cannot_be_shown_is_refused(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(AmiwarpError, match=message.replace("(", r"\(")):
        render(recording(), tmp_path / "a.mp4", **options)
    assert list(tmp_path.iterdir()) == []


def test_a_tall_sensor_is_not_enlarged_beyond_what_programs_show(tmp_path: Path) -> None:
    events = Events.from_arrays([0, 9], [0, 3999], [0, 50_000], [1, 0])
    tall = Recording(MemoryEvents(events, 10, 4000))
    summary = render(tall, tmp_path / "a.mp4", caption=False)
    assert (summary.width, summary.height) == (10, 4000)
    with pytest.raises(AmiwarpError, match=r"b\.mp4: cannot be written as a film"):
        render(tall, tmp_path / "b.mp4", scale=5)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_a_gif_has_frames_that_programs_show_at_their_speed(tmp_path: Path) -> None:
    with pytest.raises(
        AmiwarpError, match=r"a GIF has at most 50 frames/s .*, not 60; give fewer, or write \.mp4"
    ):
        render(recording(), tmp_path / "a.gif", fps=60.0)
    assert not [*tmp_path.iterdir()]


def test_what_was_assumed_of_the_recording_is_printed(tmp_path: Path) -> None:
    rows = "".join(f"{k},{k % 40},{k % 30},{k % 2}\n" for k in range(0, 90_000, 30))
    (tmp_path / "a.csv").write_text(rows)
    for command, *rest in (("render", "a.mp4"), ("filter", "b.h5", "--every", "2")):
        rest[0] = str(tmp_path / rest[0])
        done = CliRunner().invoke(app, [command, str(tmp_path / "a.csv"), *rest])
        assert done.exit_code == 0, done.stderr
        assert "note: assumed size 128x128 (--size)" in done.stdout


def test_too_many_frames_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "MOST_FRAMES", 25)
    with pytest.raises(
        AmiwarpError,
        match=r"0\.100001 s would give 26 frames, more than 25; give a part with --window",
    ):
        render(recording(), tmp_path / "a.mp4", frame_us=4000)
    assert render(recording(), tmp_path / "a.mp4", frame_us=4001, **PLAIN).frames == 25


def test_no_events_are_refused(tmp_path: Path) -> None:
    with pytest.raises(AmiwarpError, match="plain: holds no events to show"):
        render(recording(Events.empty()), tmp_path / "a.mp4")


def test_a_stopped_film_leaves_what_was_there(tmp_path: Path) -> None:
    shares: list[float] = []

    def stop(what: str, share: float) -> None:
        shares.append(share)
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render(recording(), tmp_path / "a.mp4", speed=0.1, progress=stop, **PLAIN)
    assert list(tmp_path.iterdir()) == []
    assert shares == sorted(shares)
    (tmp_path / "a.mp4").write_bytes(b"mine")
    with pytest.raises(AmiwarpError, match=r"a\.mp4: exists; give another name"):
        render(recording(), tmp_path / "a.mp4")
    assert (tmp_path / "a.mp4").read_bytes() == b"mine"


def run(*words: object) -> Any:
    return CliRunner().invoke(app, [str(word) for word in ("render", *words)])


def test_the_command_says_what_it_did(tmp_path: Path) -> None:
    save_recording(tmp_path / "a.h5", recording())
    done = run(tmp_path / "a.h5", tmp_path / "a.mp4", "--speed", "0.1", "--window", "0.02:0.05")
    assert done.exit_code == 0, done.stderr
    assert "a.mp4: 9 frames of 960 x 750 px, 0.3 s at 0.1 of real time; " in done.stdout
    assert " frames/s, " in done.stdout
    options = [
        "--mode",
        "surface",
        "--decay-ms",
        "1.5",
        "--fps",
        "20",
        "--scale",
        "2",
        "--no-caption",
        "--json",
    ]
    done = run(tmp_path / "a.h5", tmp_path / "b.gif", *options)
    assert done.exit_code == 0, done.stderr
    data = json.loads(done.stdout)
    assert (data["frames"], data["width"], data["height"], data["decay_us"], data["speed"]) == (
        3,
        80,
        60,
        1500.0,
        1.0,
    )
    assert (tmp_path / "b.gif").read_bytes()[:3] == b"GIF"
    done = run(tmp_path / "a.h5", tmp_path / "c.mp4", "--frame-ms", "5", "--json")
    assert json.loads(done.stdout)["speed"] == pytest.approx(0.15)
    done = run(tmp_path / "a.h5", tmp_path / "d.mp4", "--events", "1000")
    assert "d.mp4: 4 frames of 960 x 750 px, 0.1333 s; 4,000 events" in done.stdout


def test_a_missing_library_is_named_before_the_recording_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    done = run(tmp_path / "none.h5", tmp_path / "a.mp4")
    assert (done.exit_code, done.stderr.count("\n")) == (1, 1)
    assert "a.mp4: videos need PyAV; run: pip install 'amiwarp[video]'" in done.stderr


REAL = [
    "evt/evt2_balls_640x480.raw",
    "text/slider_depth/events_chunk.txt",
    "aedat/aedat4_davis346_cars.aedat4",
]


@pytest.mark.parametrize("file", REAL)
def test_real_recordings_are_shown(data_dir: Path, tmp_path: Path, file: str) -> None:
    source = open_recording(data_dir / file)
    found = render(source, tmp_path / "a.mp4", fps=25.0, speed=0.25, scale=1)
    assert found.events == len(source.events)
    with av.open(str(tmp_path / "a.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == found.frames
    width, height = source.events.size
    assert all(frame[:height, :width].max() > 60 for frame in frames[:-1])
