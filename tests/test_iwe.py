"""The image of warped events against NumPy, its exactness in integers, and its brink."""

import math

import numpy as np
import pytest
import warp as wp

from amiwarp.camera import Camera
from amiwarp.encoder import Encoder
from amiwarp.errors import AmiwarpError
from amiwarp.events import Events
from amiwarp.iwe import MAX_PENDING, CanvasShape, Vote, Votes, iwe, upload_events
from amiwarp.optics import MODELS, ExactModel, Prism


def random_events(n: int, width: int, height: int, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, width, n), rng.integers(0, height, n)
    return Events.from_arrays(x, y, np.sort(rng.integers(0, 250_000, n)), rng.integers(0, 2, n))


def bilinear(xy: np.ndarray, height: int, width: int) -> np.ndarray:
    """NumPy's bilinear votes in float64."""
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


@pytest.mark.parametrize("name", list(MODELS))
def test_fused_iwe_equals_points_voted_by_numpy(name: str, device: str) -> None:
    camera = Camera.from_fov(64, 48, math.radians(60))
    model = MODELS[name].from_prism(camera, Prism(math.radians(2)), 0.4)
    events, encoder = random_events(5000, 64, 48), Encoder.constant_speed(720.0, 0, 250_000)
    image = iwe(events, 64, 48, model=model, encoder=encoder, device=device)
    xy = model.compensate_points(np.stack([events.x, events.y], axis=1).astype(float), encoder.angle_at(events.t))
    np.testing.assert_allclose(image, bilinear(xy, 48, 64), rtol=0, atol=0.08)  # votes are rounded to 1/256


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


def test_order_does_not_matter(device: str) -> None:
    camera = Camera.from_fov(64, 48, math.radians(60))
    model, encoder = ExactModel(camera, Prism(math.radians(2))), Encoder.constant_speed(720.0, 0, 250_000)
    events = random_events(100_000, 64, 48)
    theta, order = encoder.angle_at(events.t), np.random.default_rng(1).permutation(len(events))
    images = []
    for pick in (np.arange(len(events)), order):
        votes = Votes(CanvasShape(64, 48), device)
        votes.add_events(model, upload_events(events[pick], theta[pick], device), len(events))
        images.append(votes.take())
    np.testing.assert_array_equal(*images)


def test_nan_and_far_points_vote_nowhere(device: str) -> None:
    votes = Votes(CanvasShape(8, 6), device)
    xy = np.array([[np.nan, 2], [2, np.nan], [1e9, 2], [-1e9, 2], [np.inf, 2], [3, 2]], dtype=np.float32)
    votes.add_points(wp.array(xy, dtype=wp.vec2, device=device), wp.zeros(6, dtype=wp.uint8, device=device))
    image = votes.take()[0]
    assert image[2, 3] == 1.0
    assert image.sum() == 1.0


def test_one_pixel_takes_more_events_than_32_bits_hold(device: str) -> None:
    """Driven over the brink: 2**23 full votes would overflow a pixel, so the buffer moves them on before."""
    votes = Votes(CanvasShape(4, 4), device)
    n = 1 << 22
    xy = wp.full(n, wp.vec2(1.0, 2.0), dtype=wp.vec2, device=device)
    p = wp.zeros(n, dtype=wp.uint8, device=device)
    for _ in range(3):
        votes.add_points(xy, p)
    assert votes.pending < MAX_PENDING
    image = votes.take()
    assert image[0, 2, 1] == 3 * n
    assert image.sum(dtype=np.float64) == 3 * n


def test_too_many_events_at_once_are_refused() -> None:
    votes = Votes(CanvasShape(4, 4), "cpu")
    p = wp.zeros(MAX_PENDING, dtype=wp.uint8, device="cpu")
    with pytest.raises(AmiwarpError, match="vote at most"):
        votes.add_points(wp.zeros(MAX_PENDING, dtype=wp.vec2, device="cpu"), p)


def test_scaled_canvas_keeps_places() -> None:
    votes = Votes(CanvasShape(8, 8, pad=2, scale=0.5), "cpu")
    # the 2 x 2 block of sensor pixels (2..3, 4..5) is one canvas pixel; its middle is (2.5, 4.5)
    xy = wp.array([[2.5, 4.5]], dtype=wp.vec2, device="cpu")
    votes.add_points(xy, wp.zeros(1, dtype=wp.uint8, device="cpu"))
    image = votes.take()[0]
    assert image.shape == (6, 6)
    assert image[3, 2] == 1.0


def test_compensated_events_are_not_compensated_twice() -> None:
    events = random_events(10, 64, 48)
    moved = Events(events.x.astype(np.float32), events.y.astype(np.float32), events.t, events.p)
    with pytest.raises(AmiwarpError, match="already compensated"):
        upload_events(moved, np.zeros(10), "cpu")


def test_model_without_encoder_is_refused() -> None:
    model = ExactModel(Camera.from_fov(64, 48, 1.0), Prism(0.02))
    with pytest.raises(AmiwarpError, match="both a model and an encoder"):
        iwe(random_events(10, 64, 48), 64, 48, model=model)
