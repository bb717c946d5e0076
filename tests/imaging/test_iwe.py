"""The image of warped events against NumPy, exact integer sums, and cells that overflow."""

import math

import numpy as np
import pytest
import warp as wp

from amiwarp import (
    AmiwarpError,
    Camera,
    CameraRotation,
    DeviceEvents,
    Encoder,
    Events,
    ExactModel,
    Prism,
    Vote,
    iwe,
)
from amiwarp.imaging import CanvasShape, Image, Votes, cpu_votes, upload_events
from amiwarp.imaging.cuda_votes import FIRST_BATCH
from amiwarp.optics import MODELS, rungs


def random_events(n: int, width: int, height: int, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, width, n), rng.integers(0, height, n)
    return Events.from_arrays(x, y, np.sort(rng.integers(0, 250_000, n)), rng.integers(0, 2, n))


def bilinear(xy: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return NumPy's bilinear votes in float64."""
    image = np.zeros((height + 2, width + 2))
    low = np.floor(xy).astype(int)
    f = xy - low
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - f[:, 0]) * np.abs(1 - dy - f[:, 1])
            col, row = low[:, 0] + dx + 1, low[:, 1] + dy + 1
            ok = (col >= 0) & (row >= 0) & (col < width + 2) & (row < height + 2)
            np.add.at(image, (row[ok], col[ok]), weight[ok])
    return image[1:-1, 1:-1]


@pytest.mark.parametrize("name", list(rungs()))
def test_fused_iwe_equals_points_voted_by_numpy(name: str, device: str) -> None:
    camera = Camera.from_fov(64, 48, math.radians(60))
    model = MODELS[name].from_prism(camera, Prism(math.radians(2)), 0.4)
    events, encoder = random_events(5000, 64, 48), Encoder.constant_speed(720.0, 0, 250_000)
    image = iwe(events, 64, 48, model=model, encoder=encoder, device=device)
    xy = model.compensate_points(
        np.stack([events.x, events.y], axis=1).astype(float), encoder.angle_at(events.t)
    )
    # Votes are rounded to 1/256
    np.testing.assert_allclose(image, bilinear(xy, 48, 64), rtol=0, atol=0.08)


def test_votes_are_kept_exactly(device: str) -> None:
    camera = Camera.from_fov(64, 48, math.radians(60))
    events, encoder = random_events(20_000, 64, 48), Encoder.constant_speed(720.0, 0, 250_000)
    model = ExactModel(camera, Prism(math.radians(3)))
    image = iwe(events, 64, 48, model=model, encoder=encoder, pad=20, device=device)
    assert image.shape == (88, 104)
    assert image.sum(dtype=np.float64) == len(events)


def test_polarities_add_up_to_the_merged_image(device: str) -> None:
    events = random_events(5000, 64, 48)
    merged = iwe(events, 64, 48, device=device)
    off, on = iwe(events, 64, 48, per_polarity=True, device=device)
    np.testing.assert_array_equal(off + on, merged)
    assert on.sum() == events.p.sum()


def test_nearest_votes_equal_a_histogram(device: str) -> None:
    events = random_events(5000, 64, 48)
    expected = np.zeros((48, 64))
    np.add.at(expected, (events.y.astype(int), events.x.astype(int)), 1)
    np.testing.assert_array_equal(iwe(events, 64, 48, vote=Vote.NEAREST, device=device), expected)


def test_raw_events_outside_the_sensor_are_refused(device: str) -> None:
    """Compensated ones, before or here, may leave the image."""
    events = random_events(5000, 64, 48)
    for given in (
        events,
        DeviceEvents.from_arrays(events.x, events.y, events.t, events.p, device=device),
    ):
        message = r"event \d+ \(x=\d+, y=\d+, .* outside the 48x64 frame; give width 64 and height 48, if they are"
        with pytest.raises(AmiwarpError, match=message):
            iwe(given, 48, 64, device=device)
        with pytest.raises(AmiwarpError, match="outside the 64x47 frame"):
            iwe(given, 64, 47, pad=9, device=device)
    moved = Events(events.x - np.float32(20.5), events.y.astype(np.float32), events.t, events.p)
    assert 0 < iwe(moved, 64, 48, device=device).sum() < len(events)


def test_order_does_not_matter(device: str) -> None:
    camera = Camera.from_fov(64, 48, math.radians(60))
    model, encoder = (
        ExactModel(camera, Prism(math.radians(2))),
        Encoder.constant_speed(720.0, 0, 250_000),
    )
    events = random_events(100_000, 64, 48)
    theta, order = encoder.angle_at(events.t), np.random.default_rng(1).permutation(len(events))
    images = []
    for pick in (np.arange(len(events)), order):
        votes = Votes(CanvasShape(64, 48), device)
        votes.add_events(model, upload_events(events[pick], theta[pick], device))
        images.append(votes.take())
    np.testing.assert_array_equal(*images)


def columns(xy: np.ndarray, device: str) -> list[wp.array]:
    return [wp.array(values, dtype=float, device=device) for values in xy.T.astype(np.float32)]


def test_nan_and_far_points_vote_nowhere(device: str) -> None:
    votes = Votes(CanvasShape(8, 6), device)
    xy = np.array(
        [[np.nan, 2], [2, np.nan], [1e9, 2], [-1e9, 2], [np.inf, 2], [3, 2]], dtype=np.float32
    )
    votes.add_points(*columns(xy, device), wp.zeros(6, dtype=wp.uint8, device=device))
    image = votes.take()[0]
    assert image[2, 3] == 1.0
    assert image.sum() == 1.0


def fixed_point(xy: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the votes in integer multiples of 1/256, computed in NumPy."""
    image = np.zeros((height + 2, width + 2), np.int64)
    low = np.floor(xy).astype(int)
    fx, fy = np.floor((xy - low) * np.float32(256) + np.float32(0.5)).astype(int).T
    b = (fx * fy + 128) >> 8
    for dx, dy, weight in ((0, 0, 256 - fx - fy + b), (1, 0, fx - b), (0, 1, fy - b), (1, 1, b)):
        np.add.at(image, (low[:, 1] + dy + 1, low[:, 0] + dx + 1), weight)
    return image[1:-1, 1:-1]


@pytest.mark.parametrize("fold", [0, 64])
def test_sums_move_to_totals_before_they_overflow(
    fold: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    events, encoder = random_events(70_000, 32, 24), Encoder.constant_speed(720.0, 0, 250_000)
    model, canvas = (
        ExactModel(Camera.from_fov(32, 24, math.radians(60)), Prism(math.radians(1))),
        CanvasShape(32, 24),
    )

    def image(times: int) -> np.ndarray:
        votes = Votes(canvas, "cpu")
        for _ in range(times):
            votes.add_events(model, upload_events(events, encoder, "cpu", fold=fold))
        return votes.take()

    once, thrice = image(1), image(3)
    np.testing.assert_array_equal(thrice, 3.0 * once)
    monkeypatch.setattr(cpu_votes, "CAPACITY", 10_000)
    np.testing.assert_array_equal(image(3), thrice)


@pytest.mark.parametrize("n", [1023, 1024, 1025, 5_000_000])
def test_a_full_cell_loses_nothing(n: int, device: str) -> None:
    """1,024 events overflow the word of a cell, and each of its fields in turn."""
    xy = (np.random.default_rng(0).integers(256, 512, (n, 2)) / 256.0).astype(np.float32)
    # Nearly a whole vote for the next pixel fills the fields as fast as possible
    xy[: n // 2] = 511 / 256
    votes = Votes(CanvasShape(5, 4), device)
    votes.add_points(*columns(xy, device), wp.zeros(n, dtype=wp.uint8, device=device))
    image = Image(CanvasShape(5, 4), 1, device)
    votes.read(image)
    expected = fixed_point(xy, 4, 5)
    np.testing.assert_array_equal(image.numpy()[0], (expected / 256.0).astype(np.float32))
    assert expected.sum() == 256 * n
    np.testing.assert_array_equal(votes.take(), image.numpy())
    assert votes.take().sum() == 0.0  # taking the image empties it


@pytest.mark.parametrize("name", list(rungs()))
@pytest.mark.parametrize("vote", list(Vote))
def test_events_are_voted_as_their_points_are(name: str, vote: Vote, device: str) -> None:
    """The vectorised loop against one event at a time: whole blocks and a remainder, both polarities."""
    camera = Camera.from_fov(64, 48, math.radians(60))
    model = MODELS[name].from_prism(camera, Prism(math.radians(2)), 0.4)
    events = random_events(70_001, 64, 48)
    theta = np.random.default_rng(2).integers(0, 65536, len(events)) * (2.0 * math.pi / 65536)
    canvas = CanvasShape(64, 48, 3, 1.5, per_polarity=True, vote=vote)
    fused, points = Votes(canvas, device), Votes(canvas, device)
    fused.add_events(model, upload_events(events, theta, device))
    xy = model.compensate_points(np.stack([events.x, events.y], axis=1).astype(np.float32), theta)
    points.add_points(*columns(xy, device), wp.array(events.p, device=device))
    image, expected = fused.take(), points.take()
    assert image.sum(dtype=np.float64) == pytest.approx(expected.sum(dtype=np.float64), abs=2)
    # positions differ by float32 rounding, which may move a nearest vote to the next pixel
    assert np.abs(image - expected).sum() < (200.0 if vote is Vote.NEAREST else 20.0)


@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
@pytest.mark.parametrize("name", list(rungs()))
@pytest.mark.parametrize("vote", list(Vote))
@pytest.mark.parametrize("points", [500, 64 * 48])
def test_cpu_and_cuda_agree_bit_for_bit(name: str, vote: Vote, points: int) -> None:
    """On CUDA by the fast vote, whose words overflow with 500 points, and by the exact vote for the rest."""
    camera = Camera.from_fov(64, 48, math.radians(60))
    model = MODELS[name].from_prism(camera, Prism(math.radians(2)), 0.4)
    n = FIRST_BATCH + 100_000
    where = np.random.default_rng(3).integers(0, points, n)
    t = np.sort(np.random.default_rng(4).integers(0, 250_000, n))
    events = Events.from_arrays(where % 64, where // 64, t, where % 2)
    encoder = Encoder.constant_speed(720.0, 0, 250_000)
    images = [
        iwe(
            events,
            64,
            48,
            model=model,
            encoder=encoder,
            pad=4,
            vote=vote,
            per_polarity=True,
            device=device,
        )
        for device in ("cpu", "cuda:0")
    ]
    np.testing.assert_array_equal(*images)


def test_scaled_canvas_keeps_places() -> None:
    votes = Votes(CanvasShape(8, 8, pad=2, scale=0.5), "cpu")
    # the 2 x 2 block of sensor pixels (2..3, 4..5) is one canvas pixel; its middle is (2.5, 4.5)
    votes.add_points(
        *columns(np.array([[2.5, 4.5]]), "cpu"), wp.zeros(1, dtype=wp.uint8, device="cpu")
    )
    image = votes.take()[0]
    assert image.shape == (6, 6)
    assert image[3, 2] == 1.0


def test_compensated_events_are_not_compensated_twice() -> None:
    events = random_events(10, 64, 48)
    moved = Events(events.x.astype(np.float32), events.y.astype(np.float32), events.t, events.p)
    with pytest.raises(AmiwarpError, match="already compensated"):
        upload_events(moved, np.zeros(10), "cpu")


def test_camera_rotation_without_a_model_is_refused() -> None:
    with pytest.raises(
        AmiwarpError, match="camera_rotation is given without a model and an encoder"
    ):
        iwe(random_events(10, 64, 48), 64, 48, camera_rotation=CameraRotation((0.0, 1.0, 0.0)))


def test_a_rotation_from_over_36_minutes_before_the_events() -> None:
    """The camera has turned as far as at a 3,000 times faster rate from one second before: 32 bits hold 2,147 s."""
    camera = Camera.from_fov(64, 48, 1.0)
    spread = random_events(500, 64, 48)
    events = Events(spread.x, spread.y, np.full(500, 3_000_000_000), spread.p)
    encoder = Encoder.constant_speed(720.0, 2_999_000_000, 3_001_000_000)
    early = CameraRotation((0.0, 1e-5, 0.0), middle_us=0)
    late = CameraRotation((0.0, 0.03, 0.0), middle_us=2_999_000_000)
    images = [
        iwe(
            events,
            64,
            48,
            model=ExactModel(camera, Prism(0.0)),
            encoder=encoder,
            camera_rotation=rotation,
        )
        for rotation in (early, late)
    ]
    np.testing.assert_allclose(*images, rtol=0, atol=1e-3)


def test_model_without_encoder_is_refused() -> None:
    model = ExactModel(Camera.from_fov(64, 48, 1.0), Prism(0.02))
    with pytest.raises(AmiwarpError, match="both a model and an encoder"):
        iwe(random_events(10, 64, 48), 64, 48, model=model)
