"""Timing of the sensor that was not given: slow photoreceptors and a refractory period are found and corrected."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from amiwarp import Calibration, ExactModel, PhotometricSettings, Settings, calibrate, model_error
from amiwarp.brightness.event_table import EventTable
from amiwarp.brightness.slow_pixels import THRESHOLD, darkness, set_lags
from amiwarp.brightness.solver import BrightnessMap
from amiwarp.brightness.tiles import Tiles
from amiwarp.calib.photometric.findings import SlowPixels
from amiwarp.calib.photometric.verdicts import refused
from amiwarp.studies.stability import Condition
from amiwarp.studies.stability.recordings import make

SMALL = Condition(width=160, height=120, turns=3.0, latency_us=0.0)
COARSE = Settings(model="exact", photometric=PhotometricSettings(density=1.0))


def calibrated(condition: Condition) -> tuple[Calibration, float]:
    """Return the calibration of a recording under a condition, and its model error [px]."""
    sample = make(condition, 0)
    assert sample.recording.truth is not None
    truth = ExactModel(
        condition.camera, condition.prism, sample.recording.truth.parameters["phase"]
    )
    found = calibrate(sample.recording, COARSE)
    return found, model_error(found.model, truth).rms


@pytest.mark.slow
def test_slow_photoreceptors_are_found() -> None:
    """Without the correction the answer is refused; on a sensor of 160 × 120 px it is 0.07 px off."""
    found, error = calibrated(replace(SMALL, cutoff_hz=100.0, width=128, height=96))
    assert error < 0.05
    assert found.photometric is not None
    # 1592 us at white, 3470 us at the middle level
    assert 1000.0 < found.photometric.time_constant_us < 6000.0
    assert any("the pixels are slow" in w for w in found.warnings)


def test_pixels_too_slow_are_refused() -> None:
    """About a tenth of a correction remains, and slow pixels turn the path by more than a small angle."""
    assert refused(SlowPixels(2000.0, 0.2, 0.1)) == ""
    for turn, moved_px, words in ((0.4, 0.1, "turns by 23 deg"), (0.2, 0.38, "by 0.38 px rms")):
        reason = refused(SlowPixels(2000.0, turn, moved_px))
        assert words in reason
        assert "slower prism" in reason


@pytest.mark.slow
def test_an_unknown_refractory_period_is_found() -> None:
    """Without the correction the error is 0.041 px."""
    found, error = calibrated(replace(SMALL, refractory_us=3000.0))
    assert error < 0.03
    assert found.photometric is not None
    assert 1500.0 < found.photometric.refractory_us < 4000.0


@pytest.mark.slow
def test_a_short_refractory_period_is_found() -> None:
    """It explains 1.7 % of the residual. Without the correction the error is 0.021 px."""
    found, error = calibrated(replace(SMALL, refractory_us=1700.0))
    assert error < 0.02
    assert found.photometric is not None
    assert found.photometric.refractory_us > 200.0


def test_fast_pixels_are_left_alone() -> None:
    found, error = calibrated(SMALL)
    assert error < 0.015  # a map with one node per pixel makes this orbit 0.012 px too large
    assert found.photometric is not None
    assert (found.photometric.time_constant_us, found.photometric.refractory_us) == (0.0, 0.0)


@pytest.mark.parametrize("turn", [0.3, -0.2])
def test_lags_on_a_slope_of_brightness(device: str, turn: float) -> None:
    """Where the brightness is linear, the filter sees a circle that is rotated and contracted: no offset remains.

    The map is so flat that all places are equally bright, but not so flat that the path is lost in rounding. The tile
    of the right half has twice the light.
    """
    sample = make(SMALL, 0)
    recording, width, height = sample.recording, SMALL.width, SMALL.height
    assert recording.encoder is not None
    assert recording.truth is not None
    tile_of = np.repeat(np.arange(width)[None] >= width // 2, height, axis=0).astype(np.int32)
    table = EventTable([recording.events.slice(0, 3000)], tile_of, device)
    pairs = table.pairs(recording.encoder, longest_gap_us=60_000)
    pairs.clear_lags()
    margin = 20.0
    tiles = Tiles(np.full((2, 2), -margin), height + 40, width + 40, 1.0)
    brightness = BrightnessMap(pairs, tiles, off_excess=0.0)
    model = ExactModel(SMALL.camera, SMALL.prism, recording.truth.parameters["phase"])
    slope = 0.01
    columns = np.arange(tiles.columns) * slope
    brightness.unknowns = np.concatenate([np.tile(columns, 2 * tiles.rows), [0.0, 0.0]]).astype(
        np.float32
    )
    turns = np.array([turn, 0.5 * turn])
    set_lags(brightness, model, turns, math.atan(turn), with_offsets=True)
    n = len(pairs)
    lag = pairs.arrays.lag.numpy().reshape(4, -1)[:, :n]
    on_device, middle = darkness(brightness, model, ahead=math.atan(turn))
    relative = on_device.numpy()[:, :n]
    assert abs(middle - slope * (margin + width / 2)) < 0.5
    np.testing.assert_allclose(
        np.hypot(lag[0], lag[1]),
        np.cos(np.arctan(turns[pairs.column("tile")] * relative[0])),
        atol=1e-5,
    )
    np.testing.assert_allclose(relative, 1.0, atol=THRESHOLD * slope * width)
    offset = pairs.arrays.offset.numpy()[:n]
    # Largest change of brightness on an orbit
    step = 2.0 * slope * SMALL.prism.deflection * SMALL.camera.fx
    assert np.abs(offset).max() < 0.02 * step
    assert wp.get_device(device) == brightness.device
