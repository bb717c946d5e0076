"""Maps of pixels: thresholds measured from a recording, hot and dead pixels, simulation with a map, and its file."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Camera,
    ErrorCode,
    ExactModel,
    PixelMap,
    Prism,
    Recording,
    Scene,
    SensorModel,
    SensorTiming,
    Simulation,
    open_recording,
    pixel_thresholds,
    save_recording,
    simulate,
)
from reference.calibration_sample import exact_calibration
from tests.command_line import app
from tests.errors import refused

SIZE = (96, 72)
CAMERA = Camera.from_fov(*SIZE, math.radians(26.0))
PRISM = Prism(math.radians(1.0))
MODEL = ExactModel(CAMERA, PRISM, 0.0)


DEAD = ([15, 35, 59], [93, 42, 70])
"""Rows and columns of dead pixels, where the picture has texture."""


def made(seed: int = 0, hot: int = 10) -> PixelMap:
    """Map with a mismatch of 10 %, ten hot pixels at random places, and dead pixels."""
    rng = np.random.default_rng(seed)
    shape = SIZE[::-1]
    on, off = (1.0 + 0.1 * rng.standard_normal((2, *shape))).clip(0.3)
    hot_hz, dead_at = np.zeros(shape), np.zeros(shape, np.bool_)
    hot_hz.ravel()[rng.choice(on.size, hot, replace=False)], dead_at[DEAD] = 100.0, True
    nothing = np.zeros(shape)
    return PixelMap(
        on, off, nothing, nothing, nothing.astype(int), nothing.astype(int), hot_hz, dead_at
    )


TRUE = made()


@pytest.fixture(scope="module")
def recording(texture: NDArray[np.uint8]) -> Recording:
    return simulate(texture, CAMERA, PRISM, duration_s=0.8, seed=1, pixels=TRUE)


@pytest.fixture(scope="module")
def found(recording: Recording) -> PixelMap:
    return pixel_thresholds(recording, model=MODEL)


@pytest.mark.parametrize("name", ["on", "off"])
def test_thresholds_of_pixels_with_texture_are_found(found: PixelMap, name: str) -> None:
    got, true, std = getattr(found, name), getattr(TRUE, name), getattr(found, f"{name}_std")
    known = np.isfinite(got) & ~TRUE.hot & ~TRUE.dead
    assert known.mean() > 0.3
    assert np.corrcoef(got[known], true[known])[0, 1] > 0.9
    assert np.median(got[known]) == pytest.approx(1.0, abs=0.01)
    error = (got - true / np.median(true))[known]
    assert 0.6 < np.std(error / std[known]) < 1.5
    pairs = getattr(found, f"{name}_pairs")
    assert (pairs[known] >= 20).all()
    np.testing.assert_array_equal(np.isnan(got), np.isnan(std))


def test_a_known_refractory_period_helps(texture: NDArray[np.uint8]) -> None:
    """The picture moves by while a pixel is blind, so its pairs span more than a threshold."""
    sensor = SensorModel(refractory_us=600.0)
    recording = simulate(texture, CAMERA, PRISM, duration_s=0.4, seed=1, pixels=TRUE, sensor=sensor)
    found = [
        pixel_thresholds(recording, model=MODEL, sensor=SensorTiming(refractory_us=us)).on
        for us in (0.0, 600.0)
    ]
    known = np.isfinite(found).all(axis=0) & ~TRUE.hot
    without, with_it = (np.std((one - TRUE.on)[known]) for one in found)
    assert with_it < 0.7 * without


def test_hot_and_dead_pixels_are_found_and_none_is_invented(found: PixelMap) -> None:
    np.testing.assert_array_equal(found.hot, TRUE.hot)
    assert np.median(found.hot_hz[found.hot]) == pytest.approx(100.0, rel=0.2)
    np.testing.assert_array_equal(found.dead, TRUE.dead)


def test_pixels_whose_map_is_empty_are_drawn_as_without_it(texture: NDArray[np.uint8]) -> None:
    nothing = np.zeros(SIZE[::-1])
    unknown = PixelMap(nothing * np.nan, nothing * np.nan, nothing, nothing, nothing.astype(int), nothing.astype(int),
                       nothing, nothing > 0)  # fmt: skip
    sensor = SensorModel(hot_fraction=0.0)
    plain, mapped = (
        simulate(texture, CAMERA, PRISM, duration_s=0.02, sensor=sensor, pixels=pixels).events
        for pixels in (None, unknown)
    )
    assert len(plain) == len(mapped) > 1000
    for name in "xytp":
        one, other = (getattr(events.slice(0, len(events)), name) for events in (plain, mapped))
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("cutoff_hz", [0.0, 500.0])
def test_simulated_pixels_have_the_map_s_thresholds(
    texture: NDArray[np.uint8], cutoff_hz: float
) -> None:
    """Pixels on the left have half the threshold, dead ones are silent, and a hot one fires at its rate."""
    one, nothing = np.ones(SIZE[::-1]), np.zeros(SIZE[::-1])
    half, hot_hz, dead = one.copy(), nothing.copy(), nothing > 0
    half[:, :48] = 0.5
    dead[10:20], hot_hz[40, 60] = True, 20_000.0
    pixels = PixelMap(
        half, half, nothing, nothing, nothing.astype(int), nothing.astype(int), hot_hz, dead
    )
    sensor = replace(SensorModel.ideal(), cutoff_hz=cutoff_hz)
    count = [
        _count(simulate(texture, CAMERA, PRISM, duration_s=0.1, sensor=sensor, pixels=p))
        for p in (None, pixels)
    ]
    left = count[1][:10, :48].sum() / count[0][:10, :48].sum()
    assert 1.7 < left < 2.6
    np.testing.assert_array_equal(
        np.delete(count[1], np.s_[:60], 1)[:10], np.delete(count[0], np.s_[:60], 1)[:10]
    )
    assert count[0][10:20].sum() > 1000
    assert count[1][10:20].sum() == 0
    assert count[1][40, 60] - count[0][40, 60] == pytest.approx(2000, rel=0.1)


def _count(recording: Recording) -> NDArray[np.int64]:
    events = recording.events.slice(0, len(recording.events))
    return np.bincount(
        events.y.astype(np.int64) * SIZE[0] + events.x, minlength=SIZE[0] * SIZE[1]
    ).reshape(SIZE[::-1])


def test_a_map_comes_back_from_its_file(tmp_path: Path) -> None:
    path = tmp_path / "pixels.npz"
    TRUE.save(path)
    back = PixelMap.load(path)
    for name in ("on", "off", "on_std", "off_std", "on_pairs", "off_pairs", "hot_hz", "dead"):
        np.testing.assert_array_equal(getattr(back, name), getattr(TRUE, name), strict=True)
    assert (back.size, int(back.hot.sum())) == (SIZE, 10)
    with refused(ErrorCode.OUTPUT_EXISTS):
        TRUE.save(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"on": None}, "has no array on; make the map with 'amiwarp pixels'"),
        ({"off": np.ones((3, 4, 2), np.float32)}, r"array off has shape \(3, 4, 2\)"),
        ({"off": np.ones((3, 5), np.float32)}, r"off has shape \(3, 5\), on \(72, 96\)"),
        ({"dead": np.zeros((72, 96), object)}, "array dead is object"),
        ({"on": np.full((72, 96), 1e3, np.float32)}, r"on holds 1000; expected 0.1 \.\. 10"),
        ({"hot_hz": np.full((72, 96), np.nan, np.float32)}, "hot_hz holds nan"),
    ],
)
def test_a_damaged_map_is_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    path = tmp_path / "pixels.npz"
    TRUE.save(path)
    with np.load(path) as stored:
        arrays = {**stored, **change}
    np.savez(path, **{name: values for name, values in arrays.items() if values is not None})
    with pytest.raises(AmiwarpError, match=rf"pixels\.npz: .*{message}"):
        PixelMap.load(path)


def test_a_map_of_another_camera_is_refused() -> None:
    camera = Camera.from_fov(40, 30, 0.5)
    with pytest.raises(AmiwarpError, match="the pixel map has 96x72 pixels, the camera 40x30"):
        Simulation(Scene.from_picture(np.ones((8, 8), np.float32)), camera, PRISM, 0.1, pixels=TRUE)


def test_events_that_show_no_picture_are_refused(recording: Recording) -> None:
    """With a model of ten times the deflection, no picture explains the events; few events know no threshold."""
    wrong = ExactModel(CAMERA, Prism(math.radians(8.0)), 1.0)
    with pytest.raises(
        AmiwarpError, match=r"do not show one picture, .* off by 0\.\d+ thresholds; calibrate again"
    ):
        pixel_thresholds(recording, model=wrong)
    with pytest.raises(
        AmiwarpError, match="no pixel has 20 pairs of events of a polarity; give a longer recording"
    ):
        pixel_thresholds(recording, model=MODEL, length_us=20_000)


def test_the_command_writes_the_map_and_simulate_reads_it(
    recording: Recording, found: PixelMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save_recording("rec.h5", recording)
    exact_calibration(CAMERA, PRISM, {"apex": PRISM.apex, "phase": 0.0}).save("cal.json")
    result = CliRunner().invoke(app, ["pixels", "rec.h5", "cal.json", "map.npz", "--json"])
    assert result.exit_code == 0, result.stderr
    data, stored = json.loads(result.stdout), PixelMap.load("map.npz")
    np.testing.assert_array_equal(stored.on, found.on)
    assert data["on"]["known"] == np.isfinite(stored.on).sum()
    assert data["on"]["mismatch"] == pytest.approx(0.1, abs=0.015)
    assert data["hot"] == np.argwhere(stored.hot)[:, ::-1].tolist()
    line = "simulate again.h5 --picture grey.png --size 96x72 --duration 0.05 --pixels map.npz"
    Image.fromarray(np.full((8, 8), 128, np.uint8)).save("grey.png")
    result = CliRunner().invoke(app, line.split())
    assert result.exit_code == 0, result.stderr
    count = _count(open_recording("again.h5"))
    assert count[stored.hot].mean() > 2
    assert count[~stored.hot].mean() < 0.2
