"""Pictures from events: close to the truth, unknown pixels marked, reproducible, and written completely."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    CameraMotion,
    CameraRotation,
    Encoder,
    ErrorCode,
    Events,
    ExactModel,
    Fill,
    MemoryEvents,
    Picture,
    Prism,
    PrismMotion,
    Reconstruction,
    Recording,
    Scene,
    SensorModel,
    Simulation,
    open_recording,
    reconstruct,
    save_recording,
)
from amiwarp.brightness.event_table import EventTable
from amiwarp.choices import Tone
from amiwarp.io import read_calib
from amiwarp.reconstruction import save_film, save_picture
from amiwarp.reconstruction.known_nodes import (
    nodes_near,
    without_small_holes,
    without_small_regions,
)
from amiwarp.reconstruction.off_excess import off_excess_by_counts
from amiwarp.reconstruction.picture_files import save_video, tones
from reference.calibration_sample import exact_calibration
from tests.command_line import app
from tests.errors import refused

CAMERA = Camera.from_fov(200, 150, math.radians(50.0))
PRISM, PHASE = Prism(math.radians(1.2)), 2.0
MODEL = ExactModel(CAMERA, PRISM, PHASE)
TURN_US = 83_333
START = 20_000


def simulation(picture: NDArray[np.uint8], **changes: object) -> Simulation:
    start = Simulation(
        Scene.from_picture(picture), CAMERA, PRISM, 0.2, PrismMotion(720.0, PHASE), seed=4
    )
    return replace(start, **changes)


@pytest.fixture(scope="module")
def sim(texture: NDArray[np.uint8]) -> Simulation:
    return simulation(texture)


@pytest.fixture(scope="module")
def recording(sim: Simulation) -> Recording:
    """With noise: shot noise, leak, hot pixels, mismatch, latency and a refractory period."""
    return sim.run()


@pytest.fixture(scope="module")
def truth(sim: Simulation) -> NDArray[np.float32]:
    return sim.log_view()


@pytest.fixture(scope="module")
def picture(recording: Recording) -> Picture:
    return reconstruct(recording, model=MODEL, start_us=START)


def correlation(a: NDArray[np.float32], b: NDArray[np.float32], where: NDArray[np.bool_]) -> float:
    return float(np.corrcoef(a[where], b[where])[0, 1])


def everywhere(picture: Picture) -> NDArray[np.bool_]:
    return np.ones_like(picture.known)


def with_events(recording: Recording, events: Events) -> Recording:
    order = np.argsort(events.t, kind="stable")
    return replace(
        recording, events=MemoryEvents(events[order], *recording.events.size), truth=None
    )


def calibration() -> Calibration:
    parameters = {"apex": PRISM.apex, "phase": PHASE}
    return exact_calibration(CAMERA, PRISM, parameters)


def test_one_turn_looks_like_the_truth(picture: Picture, truth: NDArray[np.float32]) -> None:
    assert correlation(picture.log, truth, picture.known) >= 0.96
    assert correlation(picture.log, truth, everywhere(picture)) >= 0.95
    assert picture.known.mean() > 0.2
    assert abs(float(np.median(picture.log[picture.known]))) < 1e-4


def test_its_contrast_is_the_threshold(picture: Picture, truth: NDArray[np.float32]) -> None:
    """One unit of the map is the simulated sensor's ON threshold, a log intensity of 0.25."""
    found, true = picture.log[picture.known], truth[picture.known]
    slope = float(np.cov(found, true)[0, 1] / np.var(found))
    assert slope == pytest.approx(0.25, abs=0.03)


def test_the_default_window_leaves_out_the_first_turn(
    recording: Recording, truth: NDArray[np.float32]
) -> None:
    """Shorter recordings: as late as possible."""
    found = reconstruct(recording, model=MODEL)
    first, last = recording.events.t_first, recording.events.t_last
    assert found.start_us == pytest.approx(first + TURN_US, abs=5)
    assert correlation(found.log, truth, everywhere(found)) >= 0.99
    work = Reconstruction(recording, model=MODEL)
    assert work.span(length_us=150_000) == (last + 1 - 150_000, 150_000)
    assert work.span(turns=10.0)[0] == first
    still = Reconstruction(recording, model=MODEL, encoder=Encoder.constant_speed(0.0, 0, last))
    assert still.span(length_us=20_000) == (first + 100_000, 20_000)


@pytest.mark.parametrize(("turns", "bar"), [(1.25, 0.05), (2.4, 0.01)])
def test_references_at_the_start_do_not_bias_the_thresholds(
    recording: Recording, turns: float, bar: float
) -> None:
    """The simulated pixels stood still before the start, so two of three first events are ON."""
    events = recording.events.between(0, round(turns * TURN_US))
    work = Reconstruction(with_events(recording, events), model=MODEL)
    assert abs(work.window(0, TURN_US).off_excess) < bar


@pytest.mark.parametrize(("turns", "bar"), [(0.25, 0.90), (2.0, 0.96)])
def test_other_lengths(
    recording: Recording, truth: NDArray[np.float32], turns: float, bar: float
) -> None:
    found = reconstruct(recording, model=MODEL, start_us=START, turns=turns)
    assert found.length_us == pytest.approx(turns * TURN_US, abs=5)
    assert correlation(found.log, truth, found.known) >= bar


def test_unequal_thresholds_are_found(
    texture: NDArray[np.uint8], truth: NDArray[np.float32]
) -> None:
    sensor = SensorModel(contrast_on=0.22, contrast_off=0.28)
    found = reconstruct(simulation(texture, sensor=sensor).run(), model=MODEL, start_us=START)
    assert found.off_excess == pytest.approx(0.28 / 0.22 - 1.0, abs=0.06)
    assert correlation(found.log, truth, found.known) >= 0.95


def test_nothing_is_claimed_where_nothing_fired() -> None:
    """Half of the scene is blank, with noise events only."""
    picture = np.full((240, 320), 128, np.uint8)
    picture[:, :150] = (np.indices((240, 150)).sum(axis=0) // 5 % 2 * 180 + 40).astype(np.uint8)
    made = simulation(picture)
    events = made.run()
    found = reconstruct(events, model=MODEL, start_us=START, fill=Fill.NONE)
    blank = np.zeros_like(found.known)
    blank[:, 115:] = True
    x = events.events.between(START, START + TURN_US).x
    assert (x >= 115).sum() > 500
    assert found.known[blank].mean() < 0.01
    assert found.known[10:-10, 10:85].mean() > 0.9
    assert np.array_equal(np.isnan(found.log), ~found.known)
    filled = reconstruct(events, model=MODEL, start_us=START)
    assert np.isfinite(filled.log).all()
    assert np.std(filled.log[:, 130:]) < 0.5


def test_noise_makes_nothing_known(
    texture: NDArray[np.uint8], truth: NDArray[np.float32], picture: Picture
) -> None:
    """Each pixel fires 20 random events per second, a third of all events."""
    noisy = simulation(texture, sensor=SensorModel(shot_noise_hz=20.0)).run()
    found = reconstruct(noisy, model=MODEL, start_us=START)
    assert found.known.mean() == pytest.approx(picture.known.mean(), abs=0.03)
    assert correlation(found.log, truth, found.known) >= 0.94


def test_edge_fill_breaks_rather_than_bends(
    recording: Recording, truth: NDArray[np.float32]
) -> None:
    found = reconstruct(recording, model=MODEL, start_us=START, fill=Fill.EDGE)
    assert np.isfinite(found.log).all()
    assert correlation(found.log, truth, everywhere(found)) >= 0.95
    gap = ~found.known[:, 1:] & ~found.known[:, :-1]

    def evenness(of: Picture) -> float:
        """Return mean over rms of the steps between neighbours in the gaps."""
        step = np.abs(np.diff(of.log, axis=1))[gap]
        return float(step.mean() / np.sqrt(np.mean(step**2)))

    smooth = Reconstruction(recording, model=MODEL, smoothness=found.smoothness)
    assert evenness(found) < 0.95 * evenness(smooth.window(START, found.length_us))


def test_a_given_smoothness_is_used_and_a_chosen_one_is_kept(recording: Recording) -> None:
    half = 30_000
    given = Reconstruction(recording, model=MODEL, smoothness=0.3).window(START, half)
    assert given.smoothness == 0.3
    with pytest.raises(AmiwarpError, match="smoothness"):
        Reconstruction(recording, model=MODEL, smoothness=-1.0)

    # Two milliseconds have too few pairs for a choice, and get the strongest prior.
    work = Reconstruction(recording, model=MODEL)
    first = work.window(START, 2_000)
    assert work.window(START, half).smoothness == first.smoothness
    assert Reconstruction(recording, model=MODEL).window(START, half).smoothness < first.smoothness


def test_silence_makes_even_areas_smooth(recording: Recording) -> None:
    def steps(work: Reconstruction) -> float:
        """Return the mean step between neighbours [ON thresholds]."""
        return float(np.abs(np.diff(work.window(START, 30_000).log, axis=1)).mean())

    usual = steps(Reconstruction(recording, model=MODEL, smoothness=0.1))
    without = steps(Reconstruction(recording, model=MODEL, smoothness=0.1, with_silence=False))
    assert usual < 0.985 * without


def test_hot_pixels_leave_no_salt(recording: Recording, picture: Picture) -> None:
    rng = np.random.default_rng(1)
    n, each = 60, 400
    x, y = np.repeat(rng.integers(0, 200, n), each), np.repeat(rng.integers(0, 150, n), each)
    t = rng.integers(0, 200_000, n * each)
    p = rng.integers(0, 2, n * each).astype(np.uint8)
    hot = Events(x.astype(np.uint16), y.astype(np.uint16), t, p)  # unsorted
    clean = recording.events.slice(0, len(recording.events))
    found = reconstruct(
        with_events(recording, Events.concatenate([clean, hot])), model=MODEL, start_us=START
    )
    assert found.hot >= 0.9 * n
    away = np.abs(found.log - picture.log)[picture.known & found.known]
    assert np.quantile(away, 0.999) < 1.0
    assert float(away.max()) < 3.0


def test_hot_pixels_are_told_from_texture(device: str) -> None:
    count = np.full((20, 30), 12)
    count[5, 7], count[6, 8] = 200, 14
    y, x = (np.repeat(a.ravel(), count.ravel()) for a in np.indices(count.shape))
    events = Events.from_arrays(
        x.astype(np.uint16), y.astype(np.uint16), np.arange(len(x)), np.ones(len(x))
    )
    table = EventTable([events], np.zeros(count.shape, np.int32), device)
    assert np.array_equal(table.exclude_hot_pixels(), count)
    assert np.argwhere(table.tile_of.numpy() < 0).tolist() == [[5, 7]]


def test_hot_pixels_are_those_of_a_percentile_filter(device: str) -> None:
    rng = np.random.default_rng(3)
    count = rng.integers(0, 6, (40, 50)) ** 2
    count[rng.random(count.shape) < 0.05] += 40
    count[rng.random(count.shape) < 0.05] += 70
    count[rng.random(count.shape) < 0.02] += 200
    y, x = (np.repeat(a.ravel(), count.ravel()) for a in np.indices(count.shape))
    events = Events.from_arrays(
        x.astype(np.uint16), y.astype(np.uint16), np.arange(len(x)), np.ones(len(x))
    )
    typical = ndimage.percentile_filter(count.astype(np.float32), 75, size=5, mode="mirror")
    table = EventTable([events], np.zeros(count.shape, np.int32), device)
    table.exclude_hot_pixels()
    expected = count > 3.0 * typical + 5.0 * np.sqrt(typical) + 8.0
    # Some of the fast pixels are hot, some are not
    assert 50 < expected.sum() < (count > 40).sum() - 20
    assert np.array_equal(table.tile_of.numpy() < 0, expected)


def test_growing_is_a_dilation(device: str) -> None:
    mask = np.random.default_rng(2).random((30, 40)) < 0.05
    known = wp.array(mask.view(np.uint8), device=device)
    near = nodes_near(known, 3).numpy().reshape(mask.shape)
    assert np.array_equal(near, ndimage.binary_dilation(mask, iterations=3))
    assert np.array_equal(known.numpy(), mask)
    assert nodes_near(wp.zeros_like(known), 3).numpy().all()


@pytest.mark.parametrize("share", [0.1, 0.4, 0.5, 0.6, 0.9])
@pytest.mark.parametrize("shape", [(1, 60), (60, 1), (13, 17), (60, 80)])
def test_small_regions_and_holes_are_found(
    share: float, shape: tuple[int, int], device: str
) -> None:
    """Compare with the labels of SciPy."""
    for seed in range(10):
        mask = np.random.default_rng(seed).random(shape) < share
        known = wp.array(mask.view(np.uint8), device=device)
        for values, least, found in (
            (mask, 12, without_small_regions(known).numpy() == 1),
            (~mask, 5, without_small_holes(known).numpy() == 0),
        ):
            label, _count = ndimage.label(values)
            assert np.array_equal(found, values & (np.bincount(label.ravel()) >= least)[label])
        assert np.array_equal(known.numpy(), mask)


def test_the_mask_has_no_pinholes(picture: Picture) -> None:
    known = np.ones((20, 30), np.uint8)
    known[5, 7] = known[9, 12:16] = known[14, 20:25] = False
    expected = np.ones((20, 30), np.bool_)
    expected[14, 20:25] = False
    assert np.array_equal(without_small_holes(wp.array(known, device="cpu")).numpy() == 1, expected)
    label, count = ndimage.label(~picture.known)
    inside = [np.argwhere(label == k + 1) for k in range(count) if (label == k + 1).sum() <= 4]
    size = np.array(picture.known.shape) - 1
    assert all(((where == 0) | (where == size)).any() for where in inside)


def test_bit_for_bit_the_same(recording: Recording, picture: Picture) -> None:
    again = reconstruct(recording, model=MODEL, start_us=START)
    assert np.array_equal(again.log, picture.log)
    assert np.array_equal(again.known, picture.known)


def test_devices_agree(recording: Recording, picture: Picture, device: str) -> None:
    found = reconstruct(recording, model=MODEL, start_us=START, device=device)
    both = found.known & picture.known
    assert both.sum() > 0.99 * picture.known.sum()
    assert np.quantile(np.abs(found.log - picture.log)[both], 0.99) < 0.05


def test_while_the_camera_turns(texture: NDArray[np.uint8]) -> None:
    rate = (0.0, math.radians(20.0), math.radians(-15.0))
    turning = simulation(texture, camera_motion=CameraMotion(rate), duration_s=0.1).run()
    still = reconstruct(turning, model=MODEL, start_us=0)
    right = reconstruct(turning, model=MODEL, start_us=0, camera_rotation=CameraRotation(rate))
    wrong = reconstruct(
        turning, model=MODEL, start_us=0, camera_rotation=CameraRotation(tuple(-r for r in rate))
    )
    assert right.residual < 0.7 * still.residual
    assert right.residual < 0.7 * wrong.residual


@pytest.mark.parametrize(
    ("name", "expected"), [("shapes_rotation", 0.35), ("dynamic_rotation", 0.25)]
)
def test_real_rotation_without_a_prism(data_dir: Path, name: str, expected: float) -> None:
    """``expected``: limit of the residual [thresholds]. The sign of the rotation is that of the data's README."""
    folder = data_dir / "text" / name
    real = open_recording(folder / "events.txt")
    width, height = real.events.size
    camera = read_calib(folder / "calib.txt", width, height)
    first, last = real.events.t_first, real.events.t_last
    x, y, z = np.loadtxt(folder / "motion.txt").ravel()[-3:].tolist()
    still = {
        "model": ExactModel(camera, Prism(0.0)),
        "encoder": Encoder.constant_speed(0.0, first, last),
        "length_us": last - first + 1,
    }
    right = reconstruct(real, camera_rotation=CameraRotation((x, y, z)), **still)
    wrong = reconstruct(real, camera_rotation=CameraRotation((-x, -y, -z)), **still)
    assert right.residual < expected
    assert wrong.residual > 2.0 * right.residual


def test_tones(picture: Picture) -> None:
    mapped, linear = tones(picture, Tone.MAPPED), tones(picture, Tone.LINEAR)
    for value in (mapped, linear):
        assert value.min() >= 0.0
        assert value.max() == 1.0
    assert np.median(mapped) > np.median(linear)
    brightest = np.percentile(picture.intensity()[picture.known], 99.5)
    inside = linear < 1.0
    np.testing.assert_allclose(linear[inside] * brightest, picture.intensity()[inside], rtol=1e-4)


def test_files_of_each_ending(picture: Picture, tmp_path: Path) -> None:
    for name, kind in (("a.png", np.uint8), ("b.tif", np.uint16), ("c.tiff", np.uint16)):
        save_picture(picture, tmp_path / name)
        pixels = np.asarray(Image.open(tmp_path / name))
        assert pixels.dtype == kind
        assert pixels.shape == (150, 200)
        assert np.ptp(pixels) == np.iinfo(kind).max
    save_picture(picture, tmp_path / "d.png", bits=16, tone=Tone.LINEAR)
    deep = np.asarray(Image.open(tmp_path / "d.png")).astype(np.float64) / 65535.0
    np.testing.assert_allclose(deep, tones(picture, Tone.LINEAR), atol=1e-5)
    save_picture(picture, tmp_path / "e.npy", contrast=0.2)
    np.testing.assert_array_equal(np.load(tmp_path / "e.npy"), np.float32(0.2) * picture.log)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "a.png",
        "b.tif",
        "c.tiff",
        "d.png",
        "e.npy",
    ]


def test_grey_films_keep_their_grey_levels(tmp_path: Path) -> None:
    """A GIF of colours has few grey ones, and would show grey by patterns of dots."""
    pytest.importorskip("av")
    ramp = np.tile(np.arange(0, 256, 4, dtype=np.uint8), (16, 1))
    save_film([ramp, ramp[:, ::-1]], tmp_path / "ramp.gif", fps=10.0)
    with Image.open(tmp_path / "ramp.gif") as film:
        first = np.asarray(film.convert("L")).astype(int)
        film.seek(1)
        second = np.asarray(film.convert("L")).astype(int)
    np.testing.assert_allclose(first, ramp, atol=2)
    np.testing.assert_allclose(second, ramp[:, ::-1], atol=2)


def test_video(recording: Recording, truth: NDArray[np.float32], tmp_path: Path) -> None:
    import av

    work = Reconstruction(recording, model=MODEL)
    pictures = list(work.windows(START, TURN_US, step_us=20_000.0))
    assert len(pictures) == work.count(START, TURN_US, step_us=20_000.0) == 5
    assert all(correlation(p.log, truth, p.known) >= 0.96 for p in pictures)
    assert save_video(pictures, tmp_path / "v.mp4", fps=50.0) == 5
    with av.open(str(tmp_path / "v.mp4")) as container:
        stream = container.streams.video[0]
        assert float(stream.average_rate) == 50.0
        frames = [f.to_ndarray(format="gray") for f in container.decode(stream)]
    assert len(frames) == 5
    assert frames[0].shape == (150, 200)
    assert np.abs(frames[0].astype(float) - 255.0 * tones(pictures[0], Tone.MAPPED)).mean() < 4.0


def test_a_film_in_colour_keeps_its_place_if_its_size_is_odd(tmp_path: Path) -> None:
    """The codec needs even sizes: the last row and column are repeated."""
    import av

    grey = np.full((31, 45), 200, np.uint8)
    colour = np.stack([grey, grey // 4, np.zeros_like(grey)], axis=2)
    colour[:16] = 0
    for value in grey, colour, colour[:, :44], colour[:30]:
        assert save_film([value] * 3, tmp_path / f"{value.shape}.mp4", fps=10.0) == 3
        with av.open(str(tmp_path / f"{value.shape}.mp4")) as container:
            (frame, *_) = [
                f.to_ndarray(format="rgb24") for f in container.decode(container.streams.video[0])
            ]
        rows, columns = value.shape[:2]
        assert frame.shape == (rows + rows % 2, columns + columns % 2, 3)
        expected = value if value.ndim == 3 else np.repeat(value[:, :, None], 3, axis=2)
        assert np.abs(frame[:rows, :columns].astype(int) - expected).mean() < 8.0
        assert (
            np.abs(frame[-1, 4:-4].astype(int) - expected[-1, 4 : columns - 4].mean(axis=0)).max()
            < 40
        )


def test_command(recording: Recording, tmp_path: Path) -> None:
    save_recording(tmp_path / "r.h5", recording)
    calibration().save(tmp_path / "c.json")
    base = ["reconstruct", str(tmp_path / "r.h5")]
    more = ["--calibration", str(tmp_path / "c.json"), "--device", "cpu"]
    out = CliRunner().invoke(
        app,
        [
            *base,
            str(tmp_path / "p.png"),
            *more,
            "--turns",
            "0.5",
            "--mask",
            str(tmp_path / "m.png"),
            "--json",
        ],
    )
    assert out.exit_code == 0, out.stderr
    data = json.loads(out.stdout)
    mask = np.asarray(Image.open(tmp_path / "m.png"))
    assert data["known"] == pytest.approx((mask == 255).mean(), abs=1e-9)
    assert set(np.unique(mask)) == {0, 255}
    film = CliRunner().invoke(
        app, [*base, str(tmp_path / "v.mp4"), *more, "--fps", "20", "--length", "0.05"]
    )
    assert film.exit_code == 0, film.stderr
    assert "3 frames" in film.stdout
    assert {p.name for p in tmp_path.iterdir()} == {"r.h5", "c.json", "p.png", "m.png", "v.mp4"}


def test_command_refuses(recording: Recording, tmp_path: Path) -> None:
    save_recording(tmp_path / "r.h5", recording)
    calibration().save(tmp_path / "c.json")
    before = {p.name for p in tmp_path.iterdir()}
    for out, more, said in (
        ("p.bmp", [], "pictures are written as .png, .tif, .tiff, .npy or .mp4, not '.bmp'"),
        ("none/p.png", [], "does not exist"),
        ("p.png", ["--fps", "20"], "--fps applies to a video"),
        ("v.mp4", ["--mask", "m.png"], "--mask"),
        ("p.png", ["--start", "9"], "no events in"),
        ("p.png", ["--bits", "12"], "12 bits"),
        ("p.png", ["--turns", "1", "--length", "0.1"], "length_us are both given"),
    ):
        args = [
            "reconstruct",
            str(tmp_path / "r.h5"),
            str(tmp_path / out),
            "--calibration",
            str(tmp_path / "c.json"),
        ]
        result = CliRunner().invoke(app, [*args, "--device", "cpu", *more])
        assert result.exit_code == 1
        assert said in result.stderr
        assert {p.name for p in tmp_path.iterdir()} == before


def test_a_picture_that_no_event_determines_is_not_written(
    recording: Recording, tmp_path: Path
) -> None:
    """As with the calibration of another recording."""
    save_recording(tmp_path / "r.h5", recording)
    other = {"apex": PRISM.apex, "phase": PHASE + math.pi}
    exact_calibration(CAMERA, PRISM, other).save(tmp_path / "c.json")
    args = ["reconstruct", "r.h5", "p.png", "--calibration", "c.json", "--device", "cpu"]
    result = CliRunner().invoke(app, [str(tmp_path / a) if "." in a else a for a in args])
    assert result.exit_code == 1
    assert "the events determine 0.0 % of the picture; calibrate this recording" in result.stderr
    assert not (tmp_path / "p.png").exists()


def test_what_cannot_be(recording: Recording, picture: Picture, tmp_path: Path) -> None:
    with pytest.raises(AmiwarpError, match="no events in"):
        reconstruct(recording, model=MODEL, start_us=10_000_000)
    with pytest.raises(AmiwarpError, match="no pixel fires twice"):
        reconstruct(recording, model=MODEL, start_us=START, length_us=1)
    with pytest.raises(AmiwarpError, match="200x150, the model is for 64x48"):
        reconstruct(recording, model=ExactModel(Camera.from_fov(64, 48, 1.0), PRISM))
    small = replace(calibration(), camera=Camera.from_fov(64, 48, 1.0))
    with pytest.raises(AmiwarpError, match="the calibration is for 64x48"):
        reconstruct(recording, small)
    with pytest.raises(AmiwarpError, match="give a calibration, or a model"):
        reconstruct(recording)
    with refused(ErrorCode.CONTENT_MISSING):
        reconstruct(with_events(recording, Events.empty()), model=MODEL)
    some = recording.events[:100]
    moved = Events(some.x.astype(np.float32), some.y.astype(np.float32), some.t, some.p)
    with pytest.raises(AmiwarpError, match="already compensated; give events from a sensor"):
        reconstruct(
            with_events(recording, moved), model=MODEL, start_us=int(some.t[0]), length_us=10_000
        )
    with pytest.raises(AmiwarpError, match="no picture to write"):
        save_video([], tmp_path / "v.mp4", fps=25.0)
    with refused(ErrorCode.OUTPUT_FAILED):
        save_picture(picture, _folder(tmp_path / "f.png"))
    assert [p.name for p in tmp_path.iterdir()] == ["f.png"]


def _folder(path: Path) -> Path:
    path.mkdir()
    return path


def test_too_few_events_do_not_tell_the_ratio_of_the_thresholds() -> None:
    n = 900
    t = np.arange(n) * 1000
    events = Events.from_arrays(np.arange(n) % 30, np.zeros(n, int), t, np.arange(n) % 3 > 0)
    source = MemoryEvents(events, 30, 1)
    assert off_excess_by_counts(source, 100_000.0, 0, 900_000) == 0.0
