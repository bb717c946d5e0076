"""The photometric stage: no bias as in contrast maximisation, and a refusal if it cannot determine the answer."""

import gc
import math
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from threading import current_thread
from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy import ndimage
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import spsolve

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    CameraMotion,
    Encoder,
    EncoderModel,
    Events,
    ExactModel,
    FlatSide,
    MemoryEvents,
    PhotometricSettings,
    Prism,
    PrismMotion,
    Recording,
    SensorModel,
    SensorTiming,
    calibrate,
    model_error,
    simulate,
    truth_model,
)
from amiwarp.brightness.event_table import EventTable
from amiwarp.brightness.pairs import PairSet
from amiwarp.brightness.residuals import Residuals
from amiwarp.brightness.solver import CONTRAST, DAMPING, BrightnessMap
from amiwarp.brightness.tiles import Tiles
from amiwarp.calib.events_ahead import EventsAhead
from amiwarp.calib.photometric.descent import Slopes, iterate
from amiwarp.calib.photometric.pair_spans import van_der_corput
from amiwarp.calib.photometric.tiles import TILE, choose_tiles, near_tiles, one_tile
from amiwarp.calib.turn_by_turn import mean_of_turns
from amiwarp.imaging import CanvasShape, Image
from tests.conftest import COARSE, TRUE_PHASE, TRUE_PRISM

KNOWN = PhotometricSettings(sensor=SensorTiming(latency_us=100.0, refractory_us=100.0))
KNOWN_COARSE = replace(COARSE, sensor=KNOWN.sensor)
SHORT: dict[str, Any] = {"events": 50_000, "global_evaluations": 40, "local_evaluations": 60}
"""Settings of a short search by sharpness, for recordings of which all explanations are tried in turn."""


def error_px(recording: Recording, c: Calibration) -> float:
    assert recording.camera is not None
    assert recording.truth is not None
    return model_error(c.model, truth_model(recording.camera, recording.truth, FlatSide.SCENE)).rms


def test_free_of_the_bias(recording: Recording, device: str) -> None:
    c = calibrate(recording, photometric=KNOWN, device=device)
    assert c.photometric is not None
    assert c.photometric.accepted
    assert error_px(recording, c) < 0.02
    assert abs(math.degrees(math.remainder(c.parameters["phase"] - TRUE_PHASE, math.tau))) < 0.3
    before = replace(c, parameters=c.photometric.sharpness_parameters)
    assert error_px(recording, c) < error_px(recording, before) / 2
    assert [s.name for s in c.stages][-1] == "photometric"


def test_unequal_thresholds(texture: np.ndarray) -> None:
    camera = Camera.from_fov(200, 150, math.radians(50.0))
    sensor = SensorModel(contrast_on=0.22, contrast_off=0.28, mismatch=0.05)
    recording = simulate(texture, camera, TRUE_PRISM, duration_s=0.25, sensor=sensor, seed=5)
    c = calibrate(recording, photometric=KNOWN_COARSE)
    assert error_px(recording, c) < 0.02
    assert c.photometric is not None
    # True value 1.27; noise pairs shift it towards 1
    assert 1.05 < c.photometric.off_over_on < 1.35


def test_every_model_of_the_ladder_runs(recording: Recording) -> None:
    c = calibrate(recording, model="radial", photometric=KNOWN_COARSE)
    assert c.photometric is not None
    assert c.photometric.accepted
    assert error_px(recording, c) < 0.1


def test_clock_offset_is_found(texture: np.ndarray) -> None:
    camera = Camera.from_fov(140, 105, math.radians(50))
    ramp = np.array([[0.0, 300.0], [0.3, 1500.0]])
    recording = simulate(
        texture, camera, TRUE_PRISM, duration_s=0.3, motion=PrismMotion(ramp, phase=1.0), seed=1,
        encoder=EncoderModel(clock_offset_us=1500.0),
    )  # fmt: skip
    c = calibrate(recording, free=("apex", "phase", "clock_offset"), photometric=KNOWN_COARSE)
    assert c.photometric is not None
    assert c.photometric.accepted
    assert c.parameters["clock_offset"] == pytest.approx(1500.0, abs=60.0)


@pytest.mark.usefixtures("every_core")
def test_the_same_input_gives_the_same_bits(
    recording: Recording, calibration: Calibration, device: str
) -> None:
    a = (
        calibration
        if device == "cpu"
        else calibrate(recording, events=100_000, photometric=COARSE, device=device)
    )
    b = calibrate(recording, events=100_000, photometric=COARSE, device=device)
    assert dict(a.parameters) == dict(b.parameters)
    assert a.photometric == b.photometric


def test_without_it_sharpness_stands(recording: Recording) -> None:
    c = calibrate(recording, stages=("sharpness",), events=100_000)
    assert c.photometric is None
    with pytest.raises(AmiwarpError, match="stages"):
        calibrate(recording, stages=("photometric",))


def test_too_few_pairs_are_refused(texture: np.ndarray) -> None:
    camera = Camera.from_fov(160, 120, math.radians(50))
    dull = SensorModel(contrast_on=0.9, contrast_off=0.9)
    recording = simulate(texture, camera, TRUE_PRISM, duration_s=0.03, sensor=dull, seed=2)
    with pytest.raises(AmiwarpError, match="--stages sharpness"):
        calibrate(recording)
    assert calibrate(recording, stages=("sharpness",)).photometric is None


def test_missing_events_are_not_believed(texture: np.ndarray) -> None:
    """One event of seven is kept. The image is as sharp, but consecutive events are no longer one threshold apart."""
    recording = simulate(
        texture, Camera.from_fov(120, 90, math.radians(50)), TRUE_PRISM, duration_s=0.25, seed=3
    )
    few = recording.events.slice(0, len(recording.events))[::7]
    thinned = replace(recording, events=MemoryEvents(few, *recording.events.size))
    with pytest.raises(AmiwarpError, match="photometric stage"):
        calibrate(thinned, photometric=KNOWN_COARSE)
    assert error_px(recording, calibrate(thinned, stages=("sharpness",))) < 0.15


def test_a_camera_that_turns_is_found_out(texture: np.ndarray) -> None:
    """An undeclared 40 deg/s: no brightness map explains the events of a still camera, so motion is estimated."""
    camera = Camera.from_fov(140, 105, math.radians(50))
    recording = simulate(
        texture, camera, TRUE_PRISM, duration_s=0.18, camera_motion=CameraMotion((0.0, 0.7, 0.0)), seed=2,
        sensor=SensorModel(contrast_on=0.5, contrast_off=0.5),
    )  # fmt: skip
    c = calibrate(recording, events=100_000, photometric=COARSE)
    assert error_px(recording, c) < 0.02
    assert any("turned at 40" in warning for warning in c.warnings)
    assert c.free == ("apex", "phase")


def shaken(texture: np.ndarray, turning_s: float) -> Recording:
    """A camera that turns to and fro at 100 deg/s, ``turning_s`` each way, for 0.18 s or longer, and then rests."""
    way = [(turning_s * k, 0.75 * (-1) ** k, 1.5 * (-1) ** k, 0.0) for k in range(4)]
    rest = [(way[-1][0] + t, 0.05, 0.1, 0.0) for t in (0.04, 1.0)]
    return simulate(
        texture, Camera.from_fov(112, 84, math.radians(50)), TRUE_PRISM, duration_s=0.4,
        camera_motion=CameraMotion([*way, *rest]), seed=2, sensor=SensorModel(contrast_on=0.5, contrast_off=0.5),
    )  # fmt: skip


def test_the_calmest_turns_are_used(texture: np.ndarray) -> None:
    recording = shaken(texture, turning_s=0.06)
    c = calibrate(recording, events=100_000, photometric=COARSE, model="exact")
    assert error_px(recording, c) < 0.016
    since = [
        re.search(r"from (.*) to (.*) s, where the camera is calmest", warning)
        for warning in c.warnings
    ]
    assert [0.19 < float(found[1]) < float(found[2]) < 0.41 for found in since if found] == [True]


def test_a_camera_that_moves_too_fast_is_named(texture: np.ndarray) -> None:
    with pytest.raises(
        AmiwarpError,
        match=r"moves too fast for the prism.*hold the camera still.*or record such motion for",
    ):
        calibrate(shaken(texture, turning_s=0.13), photometric=COARSE, model="exact", **SHORT)


def test_a_tremor_that_hides_the_prism_is_refused(texture: np.ndarray) -> None:
    """A tremor of 0.5 px at 10.5 Hz beside a fast rotation: one map explains the events of two turns, by another orbit.

    The prism has 12 turns per second. The answer was 0.27 px off and accepted.
    """
    t = np.arange(0.0, 0.4, 0.005)
    tremor = 0.22 * np.sin(2.0 * math.pi * 10.5 * t + 1.0)
    recording = simulate(
        texture, Camera.from_fov(112, 84, math.radians(50)), TRUE_PRISM, duration_s=0.4,
        camera_motion=CameraMotion(np.stack([t, 0.2 + tremor, np.full_like(t, 0.7), 0.0 * t], axis=1)), seed=2,
        sensor=SensorModel(contrast_on=0.5, contrast_off=0.5),
    )  # fmt: skip
    with pytest.raises(AmiwarpError, match="the camera moves too fast for the prism"):
        calibrate(recording, photometric=COARSE, model="exact", **SHORT)


def test_a_camera_that_never_rests_is_calibrated_turn_by_turn(
    texture: np.ndarray, device: str
) -> None:
    """It sways at 1.3 Hz, by up to 70 deg/s, and trembles at 9.7 Hz beside a prism of 12 turns per second."""
    t = np.arange(0.0, 1.7, 0.005)
    sway, tremor = (
        1.2 * np.sin(2.0 * math.pi * 1.3 * t + 1.0),
        0.22 * np.sin(2.0 * math.pi * 9.7 * t + 1.0),
    )
    recording = simulate(
        texture, Camera.from_fov(80, 60, math.radians(50)), TRUE_PRISM, duration_s=1.7,
        camera_motion=CameraMotion(np.stack([t, np.gradient(sway, t) / 10.0 + tremor, sway, 0.3 * tremor], axis=1)),
        seed=2, sensor=SensorModel(contrast_on=0.5, contrast_off=0.5),
    )  # fmt: skip
    said: list[str] = []
    c = calibrate(
        recording,
        photometric=COARSE,
        model="exact",
        device=device,
        progress=lambda what, _: said.append(what),
        **SHORT,
    )
    assert [
        bool(re.search(r"never rests: the answer is the mean of those of \d+ turns", w))
        for w in c.warnings
    ] == [True]
    assert error_px(recording, c) < 0.05
    assert c.free == ("apex", "phase")
    assert set(c.parameters) == {"apex", "phase"}
    assert c.photometric is not None
    assert c.photometric.verdict.startswith("mean of the answers of")
    assert "calibrating, turn by turn" in said


@pytest.mark.parametrize("oscillations", [2, 3.6, 9.5, 23, 45.2])
def test_the_mean_of_turns_removes_oscillations(oscillations: float) -> None:
    share = (np.arange(48) + 0.5) / 48
    wave = np.exp(1j * (2.0 * math.pi * oscillations * share + 0.4))
    mean, covariance = mean_of_turns(np.stack([3.0 + wave.real, 0.5 + wave.imag], axis=1), share)
    np.testing.assert_allclose(mean, [3.0, 0.5], rtol=0, atol=0.02)
    # With one answer a turn, 48 oscillations look like none
    apart = min(oscillations, 48 - oscillations)
    assert (np.sqrt(np.trace(covariance)) < 0.02) == (apart > 5)  # those near none tell the error


def test_the_mean_of_turns_knows_its_error() -> None:
    """Of answers with independent errors, some of which are missing."""
    rng, share = np.random.default_rng(3), (np.arange(48) + 0.5) / 48
    ratios = []
    for _ in range(300):
        there = rng.uniform(size=48) < 0.85
        mean, covariance = mean_of_turns(rng.normal(size=(there.sum(), 2)), share[there])
        ratios.append(float(mean @ mean) / float(np.trace(covariance)))
    assert np.median(ratios) == pytest.approx(0.8, abs=0.25)


def test_the_result_survives_its_file(calibration: Calibration, tmp_path: Path) -> None:
    calibration.save(tmp_path / "c.json")
    assert Calibration.load(tmp_path / "c.json") == calibration


def test_the_map_is_the_scene(device: str) -> None:
    """The map of events computed along a brightness ramp has the slope of the ramp."""
    width, height, slope = 24, 16, 3.0  # thresholds per px
    camera = Camera.from_fov(width, height, math.radians(20))
    model = ExactModel(camera, Prism(math.radians(3.0)))
    encoder = Encoder.constant_speed(600.0, 0, 200_000)
    t = np.arange(0, 200_000, 50)
    rows = []
    for y in range(height):
        for x in range(width):
            xy = np.tile([[float(x), float(y)]], (len(t), 1))
            level = slope * model.compensate_points(xy, encoder.angle_at(t))[:, 0]
            reference = level[0]
            for k in range(1, len(t)):
                if abs(level[k] - reference) >= 1.0:
                    rows.append((t[k], x, y, level[k] > reference))
                    reference = level[k]
    rows.sort()
    at, x, y, p = np.array(rows).T
    events = Events.from_arrays(x, y, at, p)
    everywhere = np.zeros((height, width), dtype=np.int32)
    pairs = EventTable([events], everywhere, device).pairs(encoder, longest_gap_us=200_000)
    tiles = Tiles(np.array([[-10.0, -10.0]], dtype=np.float32), height + 20, width + 20, 1.0)
    brightness = BrightnessMap(pairs, tiles, damping=1e-4)
    brightness.place(model)
    brightness.solve(1.0, steps=200, rounds=2)
    residual = brightness.residuals.values.numpy()[: len(pairs)]
    assert np.nanmedian(np.abs(residual)) < 0.05
    assert brightness.residuals.median() == pytest.approx(np.nanmedian(np.abs(residual)), abs=1e-4)
    inner = brightness.maps()[0, 12:24, 14:30]
    np.testing.assert_allclose(np.diff(inner, axis=1), slope, rtol=0, atol=0.15)
    np.testing.assert_allclose(np.diff(inner, axis=0), 0.0, rtol=0, atol=0.15)


@pytest.mark.usefixtures("every_core")
def test_single_precision_is_enough(recording: Recording, device: str) -> None:
    """The map and its residuals agree with SciPy's float64 solution of the same equations."""
    events = recording.events.slice(0, 200_000)
    width, height = recording.events.size
    tile_of = np.full((height, width), -1, dtype=np.int32)
    tile_of[50:90, 60:110] = 0
    assert recording.camera is not None
    assert recording.encoder is not None
    pairs = EventTable([events], tile_of, device).pairs(recording.encoder, longest_gap_us=60_000)
    tiles = Tiles(np.array([[44.0, 34.0]], dtype=np.float32), 72, 82, 1.0)
    brightness = BrightnessMap(pairs, tiles, off_excess=0.0, damping=0.02)
    brightness.place(ExactModel(recording.camera, TRUE_PRISM, TRUE_PHASE))
    brightness.solve(1e6, steps=300)  # all weights are 1
    residual = brightness.residuals.values.numpy()
    cell = brightness._positions.geometry.cell.numpy().reshape(2, -1)
    part = brightness._positions.geometry.part.numpy().reshape(2, 2, -1)
    on = np.flatnonzero(cell[0, : len(pairs)] >= 0)
    rows, columns, values = [], [], []
    for side, sign in ((1, 1.0), (0, -1.0)):
        fx, fy = part[side][:, on].astype(np.float64)
        for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
            rows.append(np.arange(len(on)))
            columns.append(cell[side, on] + dx + dy * tiles.columns)
            values.append(sign * np.abs(1 - dx - fx) * np.abs(1 - dy - fy))
    shape = (len(on), tiles.nodes)
    matrix = csr_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape
    )
    right = np.where(pairs.column("on")[on] == 1, 1.0, -1.0)
    solved = spsolve((matrix.T @ matrix + 0.02 * eye_array(tiles.nodes)).tocsc(), matrix.T @ right)
    np.testing.assert_allclose(brightness.maps()[0].ravel(), solved, rtol=0, atol=0.01)
    np.testing.assert_allclose(residual[on], right - matrix @ solved, rtol=0, atol=2e-3)


def test_pairs_are_neighbours_in_time_of_one_pixel(recording: Recording, device: str) -> None:
    events = recording.events.slice(0, 200_000)
    width, height = recording.events.size
    tile_of = np.full((height, width), -1, dtype=np.int32)
    tile_of[20:60, 30:90] = 0
    assert recording.encoder is not None
    table = EventTable([events], tile_of, device)
    pairs = table.pairs(recording.encoder, longest_gap_us=20_000, shortest_gap_us=100.0)
    gap = np.rint(np.diff(pairs.time, axis=0)[0] * 1e6)
    assert gap.min() > 100
    assert gap.max() <= 20_000
    counts = []
    for x, y in ((40, 30), (77, 55), (88, 21), (60, 40), (50, 50)):
        of_pixel = events.t[(events.x == x) & (events.y == y)]
        gaps = np.diff(of_pixel)
        counts.append(int(((gaps <= 20_000) & (gaps > 100)).sum()))
        assert ((pairs.column("x") == x) & (pairs.column("y") == y)).sum() == counts[-1]
    assert sum(counts) > 0


def test_pairs_of_spans_add_up(recording: Recording, device: str) -> None:
    width, height = recording.events.size
    tile_of = np.zeros((height, width), dtype=np.int32)
    assert recording.encoder is not None
    spans = [recording.events.slice(0, 30_000), recording.events.slice(50_000, 90_000)]

    def of(which: list[Events]) -> PairSet:
        assert recording.encoder is not None
        found = EventTable(which, tile_of, device).pairs(recording.encoder, longest_gap_us=20_000)
        return found.with_slope(lambda t: t * 1e-3, 0)

    whole, parts = of(spans), PairSet.concatenate([of(spans[:1]), of(spans[1:])])
    assert len(parts) == len(whole) > 1000
    for name in ("x", "y", "tile", "on"):
        assert np.array_equal(parts.column(name), whole.column(name))
    for name in ("azimuth", "time", "slope"):
        one, other = (
            getattr(p.arrays, name).numpy().reshape(-1, p.arrays.stride)[:, : len(p)]
            for p in (parts, whole)
        )
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-6)


def test_events_copied_ahead_are_those_of_their_spans(recording: Recording) -> None:
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    source = recording.events
    assert isinstance(source, MemoryEvents)
    edges = np.linspace(source.t_first, source.t_last + 1, 7).astype(int).tolist()
    spans = list(pairwise(edges))[::-1]
    most = sum(len(source.between(*span)) for span in spans[:4])
    with EventsAhead(source, spans, most, "cuda:0") as ahead:
        for taken in (spans[:4], spans[1:3]):
            found = ahead.take(taken)
            assert found is not None
            expected = Events.concatenate([source.between(*span) for span in taken])
            for name in ("x", "y", "t", "p"):
                assert np.array_equal(getattr(found.to_host(), name), getattr(expected, name))
        assert ahead.take(spans[3:5]) is None


def test_garbage_is_collected_by_no_thread_that_copies_events(recording: Recording) -> None:
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    source, threads, thresholds = recording.events, list[str](), gc.get_threshold()
    assert isinstance(source, MemoryEvents)

    def note(phase: str, info: object) -> None:
        threads.append(current_thread().name)

    gc.callbacks.append(note)
    gc.set_threshold(1)
    try:
        for _ in range(20):
            with EventsAhead(source, [(source.t_first, source.t_last)], len(source), "cuda:0"):
                before = len(threads)
                garbage = [[] for _ in range(1000)]  # what this thread allocates is counted for all
                assert len(threads) == before
            del garbage
            assert len(threads) > before
    finally:
        gc.set_threshold(*thresholds)
        gc.callbacks.remove(note)
    assert not [name for name in threads if name.startswith("amiwarp")]


def test_damping_follows_the_contrast_of_the_seen_nodes(recording: Recording, device: str) -> None:
    width, height = recording.events.size
    table = EventTable(
        [recording.events.slice(0, 3000)], np.zeros((height, width), np.int32), device
    )
    assert recording.encoder is not None
    pairs = table.pairs(recording.encoder, longest_gap_us=20_000)
    solver = BrightnessMap(pairs, Tiles(np.zeros((1, 2), np.float32), 90, 100))
    values = np.zeros(9002, np.float32)
    values[100:3100] = np.random.default_rng(0).normal(size=3000)
    solver.unknowns = values
    assert not solver.relax_damping()
    solver.unknowns = 4.0 * values
    assert solver.relax_damping()
    square = np.mean((4.0 * values[100:3100].astype(np.float64)) ** 2)
    assert solver._prior.damping.numpy()[0] == pytest.approx(DAMPING * CONTRAST / square, rel=1e-6)


@pytest.mark.parametrize("density", [1.0, 3.0, 4.0])
def test_a_map_starts_from_one_of_another_density(
    recording: Recording, device: str, density: float
) -> None:
    width, height = recording.events.size
    table = EventTable(
        [recording.events.slice(0, 3000)], np.zeros((height, width), np.int32), device
    )
    assert recording.encoder is not None
    pairs = table.pairs(recording.encoder, longest_gap_us=20_000)
    tiles = Tiles(np.zeros((2, 2), np.float32), 21, 33)
    given = BrightnessMap(pairs, tiles)
    given.unknowns = np.random.default_rng(0).normal(size=2 * 21 * 33 + 2).astype(np.float32)
    another = BrightnessMap(pairs, tiles.at_density(density))
    another.start_from(given)
    np.testing.assert_array_equal(another.extra, given.extra)
    y, x = np.indices(another.maps().shape[1:]) * (tiles.density / density)
    for found, of in zip(another.maps(), given.maps(), strict=True):
        expected = ndimage.map_coordinates(of.astype(np.float64), [y, x], order=1, mode="nearest")
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)


def test_no_pair_is_an_error() -> None:
    one = Events.from_arrays([1], [1], [5], [1])
    tile_of = np.zeros((4, 4), dtype=np.int32)
    pairs = EventTable([one], tile_of, "cpu").pairs(
        Encoder.constant_speed(60, 0, 1000), longest_gap_us=100
    )
    with pytest.raises(AmiwarpError, match="no pixel fired twice"):
        BrightnessMap(pairs, Tiles(np.zeros((1, 2), np.float32), 8, 8))


@pytest.mark.parametrize("far", [0, 1, 6, 30])
def test_the_pixels_near_tiles(far: int) -> None:
    image = Image(CanvasShape(330, 250), 1, "cpu")
    image.write(np.random.default_rng(1).random((1, 250, 330)).astype(np.float32))
    cases = [
        (choose_tiles(image, 0, 2.0, 3), 3),
        (choose_tiles(image, 0, 0.7, 8), 8),
        (one_tile(330, 250, 2.0, 3), 3),
    ]
    for (tile_of, tiles), margin in cases:
        expected = ndimage.maximum_filter(tile_of >= 0, size=2 * far + 1)
        np.testing.assert_array_equal(near_tiles(tiles, margin, far, (250, 330)) == 0, expected)


@pytest.mark.parametrize(("width", "height"), [(330, 250), (40, 20)])
def test_tiles_have_most_events_of_their_part(width: int, height: int, device: str) -> None:
    pad = 5
    layers = (
        np.random.default_rng(2)
        .integers(0, 50, (2, height + 2 * pad, width + 2 * pad))
        .astype(np.float32)
    )
    image = Image(CanvasShape(width, height, pad, per_polarity=True), 1, device)
    image.write(layers)
    tile_of, tiles = choose_tiles(image, pad, 2.0, 3)
    events = layers.sum(axis=0)[pad : pad + height, pad : pad + width]
    across, down = max(1, width // TILE), max(1, height // TILE)
    cells = [(row * TILE, column * TILE) for row in range(down) for column in range(across)]
    counts = np.array([events[y : y + TILE, x : x + TILE].sum() for y, x in cells]).reshape(
        down, across
    )
    parts = [counts[np.ix_(r, c)] for r in np.array_split(np.arange(down), min(3, down))
             for c in np.array_split(np.arange(across), min(4, across))]  # fmt: skip
    chosen = [events[tile_of == k].sum() for k in range(len(tiles.origin))]
    assert chosen == [part.max() for part in parts]


def test_turns_are_spread() -> None:
    assert sorted(van_der_corput(24)) == list(range(24))
    assert van_der_corput(8)[:4] == [0, 4, 2, 6]


def test_a_memory_source_without_truth(recording: Recording, calibration: Calibration) -> None:
    """Calibration does not use the simulation's ground truth."""
    n = len(recording.events)
    bare = replace(
        recording,
        events=MemoryEvents(recording.events.slice(0, n), *recording.events.size),
        truth=None,
    )
    assert calibrate(bare, events=100_000, photometric=COARSE).parameters == calibration.parameters


def test_pairs_are_split_by_time(recording: Recording, device: str) -> None:
    width, height = recording.events.size
    assert recording.encoder is not None
    table = EventTable(
        [recording.events.slice(0, 60_000)], np.zeros((height, width), np.int32), device
    )
    pairs = table.pairs(recording.encoder, longest_gap_us=20_000)
    late, long = (array.numpy()[: len(pairs)] for array in pairs.split_by_time())
    first, second = pairs.time.astype(np.float64)
    middle = 0.5 * (first + second)
    np.testing.assert_allclose(late, (middle - middle.mean()) / middle.std(), rtol=0, atol=1e-3)
    np.testing.assert_array_equal(long, second - first > np.median(second - first))


@pytest.mark.usefixtures("every_core")
def test_sums_of_products_by_square(recording: Recording, device: str) -> None:
    """Sums over the pairs of each square of 16 px agree with NumPy; pairs with a NaN count nowhere."""
    width, height = recording.events.size
    assert recording.encoder is not None
    table = EventTable(
        [recording.events.slice(0, 60_000)], np.zeros((height, width), np.int32), device
    )
    pairs = table.pairs(recording.encoder, longest_gap_us=20_000)
    rng = np.random.default_rng(3)
    factors = rng.normal(size=(3, len(pairs))).astype(np.float32)
    factors[1, ::7] = np.nan
    weight = rng.uniform(0.1, 1.0, len(pairs)).astype(np.float32)
    residuals = Residuals(pairs, 1)
    residuals.weight = wp.array(weight, dtype=float, device=device)
    columns, rows = -(-width // 16), -(-height // 16)
    on_device = [wp.array(f, dtype=float, device=device) for f in factors]
    found, squares = residuals.products_by_square(on_device, 16, columns, rows)
    number = pairs.column("y").astype(int) // 16 * columns + pairs.column("x").astype(int) // 16
    known = np.isfinite(factors).all(axis=0)
    assert np.array_equal(squares, np.unique(number[known]))
    exact = factors.astype(np.float64)
    for k, square in enumerate(squares):
        of = exact[:, known & (number == square)]
        np.testing.assert_allclose(
            found[k], (of * weight[known & (number == square)]) @ of.T, rtol=1e-12, atol=1e-12
        )


@pytest.mark.parametrize("tiles", [1, 4])
def test_sums_of_slopes_by_cluster(recording: Recording, device: str, tiles: int) -> None:
    """Sums over the pairs of each square of 64 px, or of each tile, agree with NumPy; NaN counts as 0."""
    width, height = recording.events.size
    assert recording.encoder is not None
    table = EventTable(
        [recording.events.slice(0, 60_000)], np.zeros((height, width), np.int32), device
    )
    pairs = table.pairs(recording.encoder, longest_gap_us=20_000)
    rng = np.random.default_rng(4)
    if tiles > 1:
        tile = np.zeros(pairs.arrays.stride, np.int32)
        tile[: len(pairs)] = rng.choice([0, 1], len(pairs))
        tile[5] = 3
        pairs.arrays.tile.assign(tile)
    slopes = rng.normal(size=(3, len(pairs))).astype(np.float32)
    slopes[1, ::7] = np.nan
    weight = rng.uniform(0.1, 1.0, len(pairs)).astype(np.float32)
    residuals = Residuals(pairs, tiles)
    residuals.weight = wp.array(weight, dtype=float, device=device)
    residuals.values = wp.ones(len(pairs), dtype=float, device=device)
    on_device = [wp.array(slope, dtype=float, device=device) for slope in slopes]

    found = residuals.start_clusters(on_device, width, height)()

    columns = -(-width // 64)
    cluster = pairs.column("y").astype(int) // 64 * columns + pairs.column("x").astype(int) // 64
    if tiles > 1:
        cluster = pairs.column("tile").astype(int)
    used = np.unique(cluster)
    assert len(used) == 3 if tiles > 1 else len(used) > columns
    summed = np.nan_to_num(slopes.astype(np.float64)) * weight
    expected = np.array([[row[cluster == k].sum() for k in used] for row in summed])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)


def test_gauss_newton_halves_steps_that_are_too_long() -> None:
    """Slopes are started at each trial point before its score is known, and awaited only at points that are kept."""
    started: list[float] = []
    awaited: list[float] = []

    def start_score(v: np.ndarray) -> Callable[[], float]:
        x = float(v[0])
        return lambda: -math.log(1.0 + x * x)

    def start_slopes(v: np.ndarray) -> Callable[[], Slopes]:
        x = float(v[0])
        started.append(x)

        def result() -> Slopes:
            awaited.append(x)
            weight = 1.0 / (1.0 + x * x)
            curvature = 0.3 * weight  # too small, so that steps are too long
            return Slopes(np.array([[curvature]]), np.array([x * weight]), np.empty((1, 0)))

        return result

    far = np.full(1, 5.0)
    stage = iterate(
        start_score,
        start_slopes,
        np.array([0.3]),
        low=-far,
        high=far,
        tolerance=1e-3,
        report=lambda *_: None,
    )
    assert abs(stage.x[0]) < 1e-3
    assert len(stage.scores) == stage.evaluations
    kept = np.maximum.accumulate(stage.scores) == stage.scores
    assert not kept.all()
    assert set(awaited) <= set(stage.points[kept, 0])
    assert set(awaited) < set(started)


@pytest.mark.parametrize(
    ("limits", "ended", "evaluations"),
    [
        ({}, "budget", 16),
        ({"least": -1.0}, "too far from the least score", 4),
        ({"least": -4.5}, "budget", 16),
        ({"walls": (np.full(1, -np.inf), np.full(1, 3.0))}, "budget", 16),
        ({"high": np.full(1, 0.25), "walls": (np.full(1, -np.inf), np.full(1, 0.25))}, "bound", 5),
    ],
)
def test_a_hopeless_search_is_given_up(
    limits: dict[str, Any], ended: str, evaluations: int
) -> None:
    """Of a score that rises by 0.1 with each step of 0.1 px from -5 on."""
    stage = iterate(
        lambda v: lambda: float(v[0]) - 5.0, lambda _: lambda: Slopes(np.eye(1), np.full(1, -0.1), np.empty((1, 0))),
        np.zeros(1), **{"low": np.zeros(1), "high": np.full(1, 9.0), **limits}, tolerance=1e-9,
        report=lambda *_: None, early=False,
    )  # fmt: skip
    assert (stage.ended, stage.evaluations) == (ended, evaluations)
