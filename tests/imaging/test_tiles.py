"""Votes of events sorted by tile in shared memory, against a single pass over the events."""

import math

import numpy as np
import pytest
import warp as wp

from amiwarp import (
    Camera,
    CameraRotation,
    CircleModel,
    Encoder,
    Events,
    ExactModel,
    Model,
    Prism,
    RadialTangential,
    Vote,
)
from amiwarp.imaging import CanvasShape, Image, Votes, upload_events
from amiwarp.imaging.tile_votes import TileVotes

pytestmark = pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")

CAMERA = Camera.from_fov(200, 150, math.radians(60))


def events(n: int = 300_000, of_one_pixel: int = 150_000) -> Events:
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 200, n), rng.integers(0, 150, n)
    x[:of_one_pixel], y[:of_one_pixel] = 33, 40  # more events than a chunk holds
    return Events.from_arrays(x, y, np.sort(rng.integers(0, 250_000, n)), rng.integers(0, 2, n))


def both(
    canvas: CanvasShape, models: list[Model], voted: Events | None = None, **kwargs: object
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the images of all models, by tiles and by a single pass."""
    camera_rotation = kwargs.pop("camera_rotation", None)
    middle = None if camera_rotation is None else camera_rotation.middle_us
    encoder = Encoder.constant_speed(720.0, 0, 250_000)
    uploaded = upload_events(voted or events(), encoder, "cuda:0", middle_us=middle, **kwargs)
    image = Image(canvas, 3, "cuda:0")
    tiles = TileVotes(image, canvas, uploaded, models[0], candidates=len(models))
    for k, model in enumerate(models):
        tiles.set(k, model, camera_rotation=camera_rotation)
    tiles.launch()
    found, expected = [], []
    for k, model in enumerate(models):
        tiles.read(k, image)
        found.append(image.numpy())
        votes = Votes(canvas, "cuda:0")
        votes.add_events(model, uploaded, camera_rotation=camera_rotation)
        expected.append(votes.take())
    return found, expected


@pytest.mark.parametrize("vote", list(Vote))
@pytest.mark.parametrize("scale", [0.5, 1.0, 1.7])
@pytest.mark.parametrize("apex_deg", [2.0, 12.0])
def test_tiles_vote_as_one_pass_does(vote: Vote, scale: float, apex_deg: float) -> None:
    """At 12 degrees votes leave the tiles' windows. Four candidates are more than one block takes."""
    canvas = CanvasShape(200, 150, 5, scale, per_polarity=True, vote=vote)
    models = [ExactModel(CAMERA, Prism(math.radians(apex_deg)), 0.3 * k) for k in range(4)]
    found, expected = both(canvas, models)
    for a, b in zip(found, expected, strict=True):
        assert a.sum(dtype=np.float64) == pytest.approx(b.sum(dtype=np.float64), abs=50)
        # the GPU's fast division may move a nearest vote to the next pixel; half of the events share a pixel
        moved = np.abs(a - b).sum()
        assert moved < (400_000 if vote is Vote.NEAREST else 3000)
        if vote is Vote.BILINEAR:
            assert np.abs(a - b).max() < 0.004 * max(1.0, b.max())


@pytest.mark.parametrize("vote", list(Vote))
def test_tiles_of_few_events_vote_as_one_pass_does(vote: Vote) -> None:
    """All tiles have so few events that they are voted without a window."""
    canvas = CanvasShape(200, 150, 5, per_polarity=True, vote=vote)
    models = [ExactModel(CAMERA, Prism(math.radians(2.0)), 0.3 * k) for k in range(4)]
    for a, b in zip(*both(canvas, models, events(20_000, 0)), strict=True):
        assert a.sum(dtype=np.float64) == pytest.approx(b.sum(dtype=np.float64), abs=5)
        # 40,000 if all were misplaced
        assert np.abs(a - b).sum() < (400 if vote is Vote.NEAREST else 200)


def test_distorted_and_turning_cameras() -> None:
    camera = Camera(200, 150, 180.0, 180.0, 99.5, 74.5, RadialTangential(-0.2, 0.05, 0.0, 0.0, 0.0))
    camera_rotation = CameraRotation((0.3, 0.2, 0.5), (0.0, 0.0, 0.0), 125_000, growth=0.4)
    found, expected = both(
        CanvasShape(200, 150, 8), [CircleModel(camera, 0.02, 0.1)], camera_rotation=camera_rotation
    )
    assert np.abs(found[0] - expected[0]).max() < 0.004 * expected[0].max()


def test_folded_points_keep_their_weight() -> None:
    found, expected = both(CanvasShape(200, 150, 8), [CircleModel(CAMERA, 0.02, 0.1)], fold=256)
    assert found[0].sum(dtype=np.float64) == pytest.approx(300_000, abs=50)
    assert np.abs(found[0] - expected[0]).max() < 0.004 * expected[0].max()
