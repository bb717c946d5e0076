"""Translators: pictures by motion, pictures with events, events alone, data sets by name, masks of what is known."""

import csv
import json
import math
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates, shift
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Camera,
    CameraMotion,
    DataSet,
    Events,
    Interpolation,
    MemoryEvents,
    PictureStack,
    Prism,
    Recording,
    Scene,
    SensorModel,
    Simulation,
    Truth,
    open_recording,
    save_recording,
    translate,
)
from amiwarp.events import MemoryMasks
from amiwarp.simulation import DARK, open_pictures
from amiwarp.simulation.translation.camera_motion import find_motion
from amiwarp.simulation.translation.event_pictures import READ_US, EventPictures
from amiwarp.simulation.translation.motion_pictures import MotionPictures
from amiwarp.simulation.translation.mvsec import open_mvsec
from amiwarp.simulation.translation.picture_pair import PicturePair
from amiwarp.simulation.translation.saccades import SACCADE_US, SACCADES_PX, saccades
from amiwarp.simulation.translation.translator import translation
from amiwarp.simulation.translation.translator_input import translator_input
from tests.command_line import app

WEDGE = Prism(math.radians(1.0))
SIZE = (48, 64)


def texture(seed: int, shape: tuple[int, int] = SIZE, blur: float = 2.0) -> NDArray[np.float32]:
    """A smooth random picture of linear luminance, 0.05 .. 0.95."""
    light = gaussian_filter(np.random.default_rng(seed).normal(size=shape), blur)
    return np.asarray(0.05 + 0.9 * (light - light.min()) / np.ptp(light), np.float32)


def encoded(light: NDArray[Any]) -> NDArray[np.float32]:
    """Linear light as sRGB values 0 .. 1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055).astype(
        np.float32
    )


def moved(light: NDArray[np.float32], x: float, y: float) -> NDArray[np.float32]:
    return np.asarray(shift(light, (y, x), order=3, mode="wrap"), np.float32).clip(0.0)


def rms(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Rms difference, without a border of 8 px into which the pattern moves."""
    return float(np.sqrt(np.mean((a - b)[8:-8, 8:-8] ** 2)))


def test_brightness_follows_the_motion_between_pictures() -> None:
    light = texture(0)
    first, middle, last = (moved(light, 4.0 * k, 2.0 * k) for k in (0.0, 0.5, 1.0))
    pair, faded = PicturePair(first, last), PicturePair(first, last, Interpolation.BLEND)
    assert pair.motion_px == pytest.approx(math.hypot(4.0, 2.0), abs=0.5)
    true = np.log(middle + DARK)
    assert rms(pair.at(0.5), true) < 0.25 * rms(faded.at(0.5), true)
    assert pair.known[8:-8, 8:-8].mean() > 0.95
    assert faded.known.all()
    np.testing.assert_allclose(
        faded.at(0.25), 0.75 * faded.logs[0] + 0.25 * faded.logs[1], rtol=0, atol=1e-6
    )


def test_small_and_senseless_motion_is_blended() -> None:
    light, other = texture(0), texture(1)
    small = PicturePair(light, moved(light, 0.6, 0.0))
    assert 0.3 < small.motion_px < 1.0
    assert small.known.all()
    senseless = PicturePair(light, other)
    assert senseless.motion_px == 0.0
    assert senseless.known.mean() < 0.5
    for pair in (small, senseless):
        np.testing.assert_allclose(
            pair.at(0.5), 0.5 * (pair.logs[0] + pair.logs[1]), rtol=0, atol=1e-6
        )


def test_pictures_in_between_are_as_near_as_the_motion_needs() -> None:
    light = texture(0)
    stack = PictureStack(
        encoded(np.stack([moved(light, 4.0 * k, 0.0) for k in range(3)])), 50.0, "shift"
    )
    frames = MotionPictures(stack)
    times = [t for t, _ in frames.read()]
    assert times[0] == 0
    assert times[-1] == 40_000
    assert 8 <= (len(times) - 1) / 2 <= 10  # 4 px in steps of at most half a pixel
    assert frames.interval_us == pytest.approx(20_000 / ((len(times) - 1) / 2), rel=0.3)
    assert [t for t, _ in frames.take_known()] == [0, 20_000]
    assert frames.take_known() == []
    assert [t for t, _ in MotionPictures(stack, Interpolation.BLEND).read()] == [0, 20_000, 40_000]


def test_without_opencv_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    stack = PictureStack(encoded(np.stack([texture(0)] * 2)), 50.0, "still")
    with pytest.raises(AmiwarpError, match=r"pip install 'amiwarp\[translate\]'"):
        translate(stack, WEDGE)
    assert translate(stack, WEDGE, interpolation="blend", duration_s=0.01).events.size == (64, 48)


# -- pictures with events

ON, OFF = 0.2, 0.3
END_US = 40_000


def log_at(first: NDArray[Any], change: NDArray[Any], t: float) -> NDArray[np.float64]:
    """Log intensity that changes only between 10 and 20 ms; a blend would change it all the time."""
    return np.asarray(first + change * np.clip((t - 10_000) / 10_000, 0.0, 1.0), np.float64)


def events_of(change: NDArray[Any], silent: NDArray[np.bool_]) -> Events:
    """Events of that change at ideal thresholds, from random references on; none where ``silent``."""
    rows = []
    passed = np.random.default_rng(5).random(change.shape)  # part of the first threshold
    for y, x in np.argwhere(~silent):
        step = ON if change[y, x] > 0 else OFF
        count = int(abs(change[y, x]) / step + passed[y, x])
        t = 10_000 + 10_000 * step * (np.arange(1, count + 1) - passed[y, x]) / abs(change[y, x])
        rows += [(x, y, round(float(one)), change[y, x] > 0) for one in t]
    x, y, t, p = np.array(sorted(rows, key=lambda row: row[2])).T
    return Events.from_arrays(x, y, t, p)


class CountedEvents(MemoryEvents):
    """Events that keep the length of the longest span that was read [us]."""

    longest = 0

    def between(self, t_start: int, t_end: int) -> Events:
        self.longest = max(self.longest, t_end - t_start)
        return super().between(t_start, t_end)


@pytest.fixture(scope="module")
def changing() -> tuple[PictureStack, Recording, NDArray[Any], NDArray[Any], NDArray[np.bool_]]:
    """Two pictures, the events between them, the first log intensity, its change, and where events are missing."""
    first = np.log(texture(0) + DARK)
    change = np.log(texture(1) + DARK) - first
    silent = np.zeros(SIZE, np.bool_)
    silent[10:20, 30:40] = True
    change[silent] = -0.9  # the pictures change there, the events do not say so
    second = np.exp(first + change) - DARK
    pictures = PictureStack(
        encoded(np.stack([np.exp(first) - DARK, second]).clip(0.0, 1.0)), 1e6 / END_US, "change"
    )
    change = np.log(second.clip(0.0, 1.0) + DARK) - first
    events = CountedEvents(events_of(change, silent), SIZE[1], SIZE[0])
    return pictures, Recording(events, name="change"), first, change, silent


def test_events_tell_the_brightness_between_pictures(changing: Any) -> None:
    pictures, recording, first, change, silent = changing
    fast = EventPictures(pictures, recording.events, 0, Interpolation.BLEND)
    assert fast.contrasts == pytest.approx((ON, OFF), rel=0.15)
    seen = {t: np.log(light + DARK) for t, light in fast.read()}
    assert sorted(seen) == list(range(0, END_US + 1, 1000))
    ((start, known),) = fast.take_known()
    assert start == 0
    assert not known[silent].any()
    assert known[~silent].mean() > 0.99
    assert recording.events.longest <= READ_US
    for t in (5000, 10_000, 15_000, 20_000, 30_000):
        true, blend = log_at(first, change, t), first + change * (t / END_US)
        error = (seen[t] - true)[~silent]
        # Between two events, log intensity is free within a threshold
        assert np.abs(error).max() < 1.5 * OFF
        if t == 20_000:  # all is over, and a blend is halfway
            much = ~silent & (np.abs(change) > 0.6)
            assert much.sum() > 200
            assert np.abs(seen[t] - true)[much].mean() < 0.6 * np.abs(blend - true)[much].mean()
    np.testing.assert_allclose(seen[END_US], first + change, rtol=0, atol=1e-3)


def test_pictures_and_events_that_do_not_belong_together_are_told(changing: Any) -> None:
    pictures, recording, *_ = changing
    n = len(recording.events)
    events = recording.events.slice(0, n)
    swapped = Events(events.x, events.y, events.t, 1 - events.p)
    with pytest.raises(AmiwarpError, match="do not change as the events say"):
        EventPictures(pictures, MemoryEvents(swapped, 64, 48), 0)
    with pytest.raises(AmiwarpError, match=r"give times\.csv"):
        EventPictures(pictures, recording.events, 10**9)
    with pytest.raises(AmiwarpError, match="64x48 px, the events 80x48"):
        EventPictures(pictures, MemoryEvents(events, 80, 48), 0)


def write_folder(folder: Path, pictures: PictureStack, start_us: int) -> Path:
    folder.mkdir()
    with (folder / "times.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["file", "t_us"])
        for k, picture in enumerate(pictures.pictures):
            Image.fromarray(np.rint(255.0 * picture).astype(np.uint8)).save(folder / f"{k}.png")
            table.writerow([f"{k}.png", start_us + k * END_US])
    return folder


def test_command_translates_pictures_with_events_and_stores_the_mask(
    changing: Any, tmp_path: Path
) -> None:
    pictures, recording, _, _, silent = changing
    n = len(recording.events)
    events = recording.events.slice(0, n)
    later = Events(events.x, events.y, events.t + 7_000_000, events.p)
    save_recording(tmp_path / "events.h5", Recording(MemoryEvents(later, 64, 48)))
    folder = write_folder(tmp_path / "pictures", pictures, 7_000_000)
    assert open_pictures(folder).start_us == 7_000_000  # type: ignore[union-attr]
    out = tmp_path / "out.h5"
    command = ["translate", str(folder), str(out), "--events", str(tmp_path / "events.h5"), "--picture-fov-deg", "60",
               "--interpolation", "blend", "--duration", "0.04", "--json"]  # fmt: skip
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    found = open_recording(out)
    assert json.loads(result.stdout)["events"] == len(found.events) > 1000
    assert found.metadata["translated_from"] == "pictures and events"
    assert found.metadata["source_contrast_on"] == pytest.approx(ON, rel=0.15)
    truth = found.truth
    assert truth is not None
    assert truth.known is not None
    assert truth.known.t.tolist() == [0]
    assert not truth.known[0][
        silent
    ].any()  # the camera has the pictures' view: pixel by pixel the same
    assert truth.known[0][~silent].mean() > 0.98
    count = len(found.events)
    t, points = found.events.slice(0, count).t, truth.points(0, count)
    assert points is not None
    known = truth.known_at(t, points)
    x, y = np.rint(points[known]).astype(int).T
    assert not silent[y, x].any()
    assert known.mean() > 0.8
    save_recording(tmp_path / "copy.h5", found)
    copied = open_recording(tmp_path / "copy.h5").truth
    assert copied is not None
    assert copied.known is not None
    np.testing.assert_array_equal(copied.known[0], truth.known[0])


def test_masks_tell_what_is_known_at_a_time_and_place() -> None:
    right = np.zeros((3, 4), np.bool_)
    right[:, 2:] = True
    truth = Truth(known=MemoryMasks([10, 20], [right, ~right]))
    t = [5, 10, 19, 20, 30, 30, 30]
    xy = [[3, 1], [3, 1], [1, 1], [1, 1], [0.4, 2.4], [-0.6, 0], [math.nan, 0]]
    assert truth.known_at(t, xy).tolist() == [False, True, False, True, True, False, False]
    assert Truth().known_at([1], [[9, 9]]).tolist() == [True]


def test_pixels_beyond_the_pictures_are_unknown() -> None:
    """A camera with twice the view of the pictures knows only its middle."""
    stack = PictureStack(encoded(np.stack([texture(0)] * 2)), 50.0, "still")
    wide = Camera(64, 48, 27.713, 27.713, 31.5, 23.5)
    fov = 2.0 * math.atan(32.0 / (2.0 * 27.713))  # 32 columns
    truth = translate(stack, WEDGE, camera=wide, fov=fov, duration_s=0.005).truth
    assert truth is not None
    assert truth.known is not None
    expected = np.zeros((48, 64), np.bool_)
    expected[12:36, 16:48] = True
    np.testing.assert_array_equal(truth.known[0], expected)


# -- events alone

PAN = (0.15, -0.25, 0.0)
PICTURE, FOV = (
    np.kron(np.random.default_rng(3).uniform(0.02, 1.0, (30, 40)), np.ones((6, 6))).astype(
        np.float32
    ),
    1.6,
)


def plain(rates: Any, seconds: float) -> Recording:
    """A recording of a plain event camera that turns in front of a picture."""
    scene, camera = Scene.from_picture(PICTURE, fov=FOV), Camera.from_fov(80, 60, 1.0)
    motion = CameraMotion(rates)
    return Simulation(
        scene, camera, Prism(0.0), seconds, camera_motion=motion, encoder_model=None, seed=1
    ).run()


def seen_at(recording: Recording, motion: CameraMotion, t_us: float) -> NDArray[np.float64]:
    """Log intensity that the turning camera sees, shape (height, width)."""
    camera = recording.camera
    assert camera is not None
    y, x = np.mgrid[: camera.height, : camera.width]
    rays = np.asarray(
        camera.pixels_to_rays(np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64))
    )
    rays = rays @ motion.orientation(1.0)(np.array([t_us * 1e-6]))[0].T
    height, width = PICTURE.shape
    at = rays[:, :2] / rays[:, 2:] * (width / 2.0 / math.tan(FOV / 2.0)) + (
        width / 2.0 - 0.5,
        height / 2.0 - 0.5,
    )
    light = map_coordinates(PICTURE, at[:, ::-1].T, order=1)
    return np.asarray(np.log(light + DARK).reshape(y.shape), np.float64)


def correlation_of_known(
    recording: Recording, dataset: DataSet | None, motion: CameraMotion, device: str
) -> float:
    """Correlation of a picture in the middle of the recording with the truth, where it is known."""
    given = translator_input(recording, dataset=dataset, device=device)
    pictures = {t: np.log(light + DARK) for t, light in given.frames.read()}
    masks = given.frames.take_known()  # type: ignore[attr-defined]
    assert [t for t, _ in masks] == sorted({t for t, _ in masks})
    t, known = masks[len(masks) // 2]
    assert known.mean() > 0.1
    true = seen_at(recording, motion, t + recording.events.t_first)
    return float(np.corrcoef(pictures[t][known], true[known])[0, 1])


def test_motion_and_picture_are_found_from_events_alone(device: str) -> None:
    recording = plain(PAN, 0.15)
    assert recording.camera is not None
    for window in find_motion(recording, recording.camera, device=device):
        np.testing.assert_allclose(window.rates, PAN, rtol=0, atol=0.04)  # rad/s: 0.3 px in 100 ms
    assert correlation_of_known(recording, None, CameraMotion(PAN), device) > 0.75


def test_a_camera_at_rest_knows_nothing() -> None:
    recording = plain((0.0, 0.0, 0.0), 0.1)
    assert len(recording.events) > 100  # noise
    truth = translate(recording, WEDGE, duration_s=0.05).truth
    assert truth is not None
    assert truth.known is not None
    assert not any(truth.known[k].any() for k in range(len(truth.known.t)))


def test_recordings_that_cannot_be_translated_are_told(recording: Recording) -> None:
    with pytest.raises(AmiwarpError, match="through a prism"):
        translate(recording, WEDGE)
    with pytest.raises(AmiwarpError, match="events are given too"):
        translate(recording, WEDGE, events=recording)
    empty = Recording(MemoryEvents(Events.empty(), 8, 8), name="empty")
    with pytest.raises(AmiwarpError, match="empty has no events"):
        translate(empty, WEDGE)
    with pytest.raises(AmiwarpError, match="dataset"):
        translate(empty, WEDGE, dataset="imagenet")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"fps": 50.0},
            "fps is given, but does not apply to opened pictures, which have times; leave it out",
        ),
        (
            {"dataset": "n-caltech101", "fps": 50.0},
            "fps is given, .* to a still picture of n-caltech101",
        ),
        (
            {"dataset": "n-caltech101", "events": "a.h5"},
            "events is given, .* to a still picture of n-caltech101",
        ),
        (
            {"dataset": "n-caltech101", "interpolation": "motion"},
            "interpolation is given, .* of n-caltech101",
        ),
        ({"dataset": "mvsec", "fps": 50.0}, "fps is given, .* to mvsec, whose pictures have times"),
        ({"fps": 50.0}, "fps is given, but does not apply to a recording, which has no pictures"),
        ({"interpolation": "blend"}, "interpolation is given, but does not apply to a recording"),
    ],
)
def test_settings_that_do_not_apply_are_refused(
    settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    source: Any = tmp_path / "picture.png"
    if "recording" in message:
        source = Recording(MemoryEvents(Events.empty(), 8, 8))
    elif "dataset" not in settings:
        source = PictureStack(np.zeros((2, 24, 32), np.uint8), 25.0, "grey")
    with pytest.raises(AmiwarpError, match=message):
        translate(source, WEDGE, **settings)


# -- data sets by name


def test_image_moves_as_in_the_saccades() -> None:
    camera = Camera.from_fov(240, 180, 1.0)
    at = saccades(camera).orientation(0.4)
    ends = at(np.arange(4) * SACCADE_US * 1e-6)
    point = np.array([0.0, 0.0, 1.0])  # of the scene; it moves through the image
    xy = np.array([camera.rays_to_pixels((turn.T @ point)[None])[0] for turn in ends])
    # Px: 1 ms to turn around
    np.testing.assert_allclose(np.diff(xy, axis=0), SACCADES_PX, rtol=0, atol=0.15)


def test_n_caltech101_from_a_picture_and_from_events(tmp_path: Path) -> None:
    Image.fromarray(np.rint(255.0 * encoded(texture(0))).astype(np.uint8)).save(
        tmp_path / "image_0001.png"
    )
    first, again = (
        translate(tmp_path / "image_0001.png", WEDGE, dataset="n-caltech101", seed=3)
        for _ in range(2)
    )
    assert first.metadata["duration_us"] == 3 * SACCADE_US
    n = len(first.events)
    assert n > 5000
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(
            getattr(first.events.slice(0, n), name), getattr(again.events.slice(0, n), name)
        )
    camera = Camera.from_fov(80, 60, 1.0)
    motion = saccades(camera)
    assert (
        correlation_of_known(plain(motion.rates, 0.315), DataSet.N_CALTECH101, motion, "cpu") > 0.85
    )


def test_mvsec_pictures_and_their_times(changing: Any, tmp_path: Path) -> None:
    pictures, recording, *_ = changing
    path = tmp_path / "scene_data.hdf5"
    light = np.rint(255.0 * np.stack([one for _, one in pictures.read()])).astype(np.uint8)
    epoch = 1_500_000_000_000_000
    with h5py.File(path, "w") as file:
        file["davis/left/image_raw"] = light
        file["davis/left/image_raw_ts"] = np.array([epoch, epoch + END_US]) * 1e-6
    opened = open_mvsec(path)
    assert (opened.start_us, opened.times_us.tolist(), opened.size) == (
        epoch,
        [0, END_US],
        (64, 48),
    )
    np.testing.assert_allclose(next(opened.read())[1], light[0] / 255.0, rtol=0, atol=1e-6)
    events = recording.events.slice(0, len(recording.events))
    later = Recording(MemoryEvents(Events(events.x, events.y, events.t + epoch, events.p), 64, 48))
    work = translation(path, WEDGE, dataset="mvsec", events=later, sensor=SensorModel.ideal())
    assert work.duration_us == END_US
    assert work.source["source_contrast_off"] == pytest.approx(OFF, rel=0.2)
    with h5py.File(path, "a") as file:
        del file["davis/left/image_raw_ts"]
    with pytest.raises(AmiwarpError, match=r"scene_data\.hdf5.*no davis/left/image_raw"):
        translation(path, WEDGE, dataset="mvsec", events=later)
