"""Pixels that calibration leaves out: hot and flickering pixels are found, pixels of the scene are not."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from amiwarp import (
    AmiwarpError,
    Camera,
    CameraMotion,
    Encoder,
    Events,
    FlatSide,
    MemoryEvents,
    Prism,
    Recording,
    Scene,
    SensorModel,
    calibrate,
    model_error,
    simulate,
    truth_model,
)
from amiwarp.calib.bad_pixels import BadPixelSummary, find_bad_pixels, searched_part, without_pixels
from amiwarp.calib.checks import check_light
from amiwarp.calib.hot_pixels import bin_times, outliers, unrepeated_counts
from amiwarp.simulation import linear_luminance

CAMERA = Camera.from_fov(200, 150, math.radians(50.0))
SIZE = (200, 150)
PIXELS = 200 * 150
PRISM = Prism(math.radians(1.2), 1.52)
TURN_S = 60.0 / 720.0
SPARE_S = 1e-3
"""Length of a recording beyond whole turns [s]."""
CLEAN = SensorModel(hot_fraction=0.0)


@dataclass(frozen=True)
class Flicker:
    """One picture per millisecond, in which the brightness of a patch oscillates."""

    light: NDArray[np.float32]
    patch: NDArray[np.bool_]
    hz: float
    depth: float
    seconds: float

    @property
    def size(self) -> tuple[int, int]:
        return self.light.shape[1], self.light.shape[0]

    @property
    def interval_us(self) -> float:
        return 1000.0

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        for k in range(round(self.seconds * 1e3) + 2):
            gain = np.float32(1.0 + self.depth * math.cos(math.tau * self.hz * k * 1e-3))
            yield 1000 * k, np.where(self.patch, self.light * gain, self.light)


def record(
    scene: Scene | NDArray[np.uint8], turns: float, sensor: SensorModel = CLEAN, **more: object
) -> Recording:
    seconds = turns * TURN_S + SPARE_S
    return simulate(scene, CAMERA, PRISM, duration_s=seconds, sensor=sensor, seed=5, **more)  # type: ignore[arg-type]


def events_of(recording: Recording) -> Events:
    return recording.events.slice(0, len(recording.events))


def strange(recording: Recording, every: int = 1) -> tuple[NDArray[np.bool_], BadPixelSummary]:
    assert recording.encoder is not None
    events = events_of(recording)
    return find_bad_pixels(
        events[np.arange(len(events)) // 8 % every == 0], recording.encoder, SIZE
    )


def hot_pixels(fraction: float) -> NDArray[np.bool_]:
    """Mask of the pixels that the simulator makes hot: all that fire in front of a grey wall."""
    sensor = SensorModel(hot_fraction=fraction, hot_hz=5000.0, shot_noise_hz=0.0, leak_hz=0.0)
    return counts(record(np.full((60, 80), 128, np.uint8), 0.5, sensor)) > 20


def counts(recording: Recording) -> NDArray[np.int64]:
    events = events_of(recording)
    return np.bincount(events.y.astype(np.int64) * SIZE[0] + events.x, minlength=PIXELS).reshape(
        SIZE[::-1]
    )


# -- hot pixels


@pytest.mark.parametrize(
    ("fraction", "hz", "turns", "least"),
    [
        (0.002, 300.0, 4, 0.97),
        (0.05, 1000.0, 4, 0.99),
        (0.02, 2000.0, 1, 0.9),
        (0.01, 100.0, 8, 0.9),
    ],
)
def test_hot_pixels_are_found(
    texture: NDArray[np.uint8], fraction: float, hz: float, turns: int, least: float
) -> None:
    """Under two turns only pixels that fire far more than their neighbours are found; later also slower ones."""
    true = hot_pixels(fraction)
    mask, summary = strange(record(texture, turns, SensorModel(hot_fraction=fraction, hot_hz=hz)))
    assert (mask & true).sum() >= least * true.sum()
    assert (mask & ~true).sum() <= 1e-3 * PIXELS
    assert summary.hot == mask.sum()
    assert summary.flickering == 0


def test_hot_pixels_are_found_while_the_camera_turns(texture: NDArray[np.uint8]) -> None:
    """Events do not repeat then, so hot pixels are found only by their rate of unrepeated events."""
    true = hot_pixels(0.01)
    sensor = SensorModel(hot_fraction=0.01, hot_hz=2000.0)
    mask, _ = strange(record(texture, 4, sensor, camera_motion=CameraMotion((0.0, 0.5, 0.0))))
    assert (mask & true).sum() >= 0.97 * true.sum()
    assert (mask & ~true).sum() <= 1e-3 * PIXELS


@pytest.mark.parametrize("turns", [0.5, 1, 2, 4, 24])
def test_a_still_scene_has_no_strange_pixels(texture: NDArray[np.uint8], turns: float) -> None:
    mask, summary = strange(record(texture, turns))
    assert mask.sum() <= 1e-3 * PIXELS
    assert summary.flickering == 0


@pytest.mark.parametrize("every", [1, 8])
@pytest.mark.parametrize("degrees", [0.0, 10.0, 60.0])
def test_nor_has_a_turning_camera_or_a_noisy_one(
    texture: NDArray[np.uint8], degrees: float, every: int
) -> None:
    """A still camera with as many noise events as scene events, or a rotating one; also with thinned runs of events."""
    noise = SensorModel(hot_fraction=0.0, shot_noise_hz=0.0 if degrees else 30.0)
    recording = record(
        texture, 4, noise, camera_motion=CameraMotion((0.0, math.radians(degrees), 0.0))
    )
    mask, _ = strange(recording, every)
    assert mask.sum() <= 1e-3 * PIXELS


def test_what_repeats_counts_for_nothing_and_what_does_not_for_itself() -> None:
    """Two pixels over eight turns: the first fires at the same angles in every turn, the second at random."""
    rng = np.random.default_rng(1)
    encoder = Encoder.constant_speed(-600.0, 0, 800_000)  # 100 ms a turn, backwards
    locked = (np.arange(8)[:, None] * 100_000 + np.array([5_000, 20_000, 21_000, 66_000])).ravel()
    random = rng.integers(0, 800_000, 4000)
    t = np.concatenate([locked, random, [0, 800_000]])
    x = np.concatenate([np.zeros(len(locked)), np.ones(len(random)), [2, 2]]).astype(np.uint16)
    order = np.argsort(t, kind="stable")
    events = Events(x, np.zeros_like(x), t, (t % 2).astype(np.uint8))[order]
    found = unrepeated_counts(events, events.x.astype(np.int32), encoder, (3, 1))
    assert found is not None
    assert found[0, 0] == pytest.approx(0.0, abs=1e-9)
    # Sum of 40 squares, relative standard deviation 0.22
    assert found[0, 1] == pytest.approx(4000.0, rel=0.5)
    assert (
        unrepeated_counts(events[events.t < 190_000], events.x.astype(np.int32), encoder, (3, 1))
        is None
    )


@pytest.mark.parametrize("rpm", [600.0, -600.0])
def test_bins_of_the_angle(rpm: float) -> None:
    """Eight bins per turn, counted from the first event on the events' clock."""
    encoder = Encoder.constant_speed(rpm, 0, 1_000_000).with_clock_offset(4000.0)
    t = np.array([50_000, 400_000])
    none = np.zeros(2, np.uint16)
    edges = bin_times(Events(none, none, t, none.astype(np.uint8)), encoder)
    assert edges.tolist() == pytest.approx([50_000 + 12_500 * k for k in range(3 * 8 + 1)], abs=1)


def test_a_fast_pixel_stands_out_a_fast_region_does_not() -> None:
    count = np.full((20, 20), 10.0)
    count[:, 10:] = 1000.0
    assert not outliers(count).any()
    count[5, 5] = 80.0
    count[0, 0] = count[5, 6] = 200.0
    count[8, 15] = 3500.0
    assert np.argwhere(outliers(count)).tolist() == [[0, 0], [5, 5], [5, 6], [8, 15]]


# -- flicker


@pytest.mark.parametrize(
    ("hz", "depth", "turns"), [(100.0, 0.3, 4), (100.0, 1.0, 1), (120.0, 0.6, 2)]
)
def test_a_flickering_lamp_is_found(
    texture: NDArray[np.uint8], hz: float, depth: float, turns: int
) -> None:
    """120 Hz is ten times the prism's frequency. It repeats every turn as the scene does, but in all pixels at once."""
    light = linear_luminance(texture)
    patch = np.zeros(light.shape, np.bool_)
    patch[60:140, 90:170] = True
    sensor = SensorModel(hot_fraction=0.001, hot_hz=1000.0)
    lit, still = (
        record(Scene(Flicker(light, patch, hz, d, turns * TURN_S)), turns, sensor)
        for d in (depth, 0.0)
    )
    mask, summary = strange(lit)
    more = counts(lit) - counts(still)
    # Without single pixels, in which the two recordings differ by chance
    lamp = ndimage.binary_opening(more >= 4)
    assert more[mask].sum() >= 0.97 * more[lamp].sum()
    assert (
        mask & ~ndimage.binary_dilation(lamp, iterations=6) & ~hot_pixels(0.001)
    ).sum() <= 1e-3 * PIXELS
    assert summary.lamps_hz[0] == pytest.approx(hz, abs=0.5 / (turns * TURN_S))
    assert summary.flickering >= 0.9 * lamp.sum()
    assert f"that flicker at {summary.lamps_hz[0]:.0f} Hz left out" in str(summary)


@pytest.mark.parametrize(
    ("first_hz", "second_hz", "depth"), [(100.4, 101.2, 0.8), (100.45, 101.2, 0.7)]
)
def test_two_estimates_for_a_lamp_are_one_lamp(
    first_hz: float, second_hz: float, depth: float
) -> None:
    """The second patch is found by a second search. Within a second, less than 1 Hz cannot be told apart."""
    rng = np.random.default_rng(3)
    count = 60_000

    def lit(left: int, hz: float, depth: float) -> list[NDArray[np.int64]]:
        t = rng.integers(0, 1_000_000, count)
        chance = 0.5 + 0.5 * depth * np.cos(math.tau * hz * 1e-6 * t)
        x, y = rng.integers(0, 32, (2, count))
        return [left + x, 16 + y, t, rng.random(count) < chance]

    columns = np.concatenate([lit(16, first_hz, 1.0), lit(96, second_hz, depth)], axis=1)
    events = Events.from_arrays(*columns[:, np.argsort(columns[2], kind="stable")])
    _, summary = find_bad_pixels(events, Encoder.constant_speed(720.0, 0, 1_000_000), (144, 64))
    assert summary.flickering > 2000, "both patches"
    assert summary.lamps_hz == (pytest.approx(first_hz, abs=0.1),)


def test_an_image_of_hot_pixels_is_not_called_flickering() -> None:
    mask = np.ones((4, 4), np.bool_)
    with pytest.raises(AmiwarpError, match="100 % of the pixels are hot"):
        check_light(mask, BadPixelSummary(16, 0, (), 1.0), "events")
    with pytest.raises(AmiwarpError, match="flicker at 100 Hz"):
        check_light(mask, BadPixelSummary(0, 16, (100.0,), 1.0), "events")


def test_calibration_without_them(texture: NDArray[np.uint8]) -> None:
    """With many fast hot pixels, no motion is sharpest, which is refused. Without them, calibration finds the prism."""
    recording = record(texture, 4, SensorModel(hot_fraction=0.02, hot_hz=2000.0))
    mask, _ = strange(recording)
    assert recording.camera is not None
    assert recording.truth is not None
    truth = truth_model(recording.camera, recording.truth, FlatSide.SCENE)
    cut = replace(recording, events=MemoryEvents(without_pixels(events_of(recording), mask), *SIZE))
    settings = {"stages": ("sharpness",), "events": 100_000}
    assert model_error(calibrate(cut, **settings).model, truth).rms < 0.3
    with pytest.raises(AmiwarpError, match="as sharp with no motion compensation"):
        calibrate(recording, **settings)


# -- the rest


def test_a_stretch_of_a_long_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two to eight turns in the middle, up to the requested number of events; fewer turns if the prism is slow."""
    t = np.arange(0, 2_400_000, 100)
    none = np.zeros(len(t), np.uint16)
    source = MemoryEvents(Events(none, none, t, none.astype(np.uint8)), 4, 3)
    encoder = Encoder.constant_speed(-600.0, 0, 2_400_000)  # 1000 events a turn
    for most, turns in ((10**6, 8), (5_200, 5), (600, 2)):
        monkeypatch.setattr("amiwarp.calib.bad_pixels.MOST_EVENTS", most)
        found = searched_part(source, encoder)
        assert len(found) == pytest.approx(1000 * turns + 50, abs=1)
        assert found.t[0] + found.t[-1] == pytest.approx(2_400_000, abs=200)
    slow = Encoder.constant_speed(20.0, 0, 2_400_000)
    assert len(searched_part(source, slow)) == pytest.approx(2400, abs=1)
    monkeypatch.undo()
    assert len(searched_part(source, slow)) == len(t)


def test_keep() -> None:
    events = Events.from_arrays([1, 2, 3, 2], [0, 1, 1, 1], [5, 6, 7, 8], [1, 0, 1, 1])
    mask = np.zeros((2, 4), np.bool_)
    assert without_pixels(events, mask) is events
    mask[1, 2] = True
    assert without_pixels(events, mask).t.tolist() == [5, 7]


def test_nothing_to_look_at() -> None:
    samples = Encoder.constant_speed(720.0, 0, 2000)
    for events in (Events.empty(), Events.from_arrays([1], [1], [500], [1])):
        mask, summary = find_bad_pixels(events, samples, (4, 3))
        assert mask.shape == (3, 4)
        assert not mask.any()
        assert str(summary) == ""


def test_the_summary_says_what_was_left_out() -> None:
    assert str(BadPixelSummary(1, 0, (), 0.031)) == "1 hot pixel left out, 3 % of the events"
    text = str(BadPixelSummary(12, 3400, (100.2,), 0.41))
    assert text == "12 hot pixels and 3400 that flicker at 100 Hz left out, 41 % of the events"
    text = str(BadPixelSummary(0, 3400, (100.2, 120.0, 50.0), 0.41))
    assert text == "3400 pixels that flicker at 100, 120, 50 Hz left out, 41 % of the events"
    text = str(BadPixelSummary(0, 1, (100.2,), 0.0))
    assert text == "1 pixel that flickers at 100 Hz left out, 0 % of the events"
    text = str(BadPixelSummary(2, 1, (100.2,), 0.0))
    assert text == "2 hot pixels and 1 that flickers at 100 Hz left out, 0 % of the events"
