"""Buffers of votes on CUDA: what they hold until it is verified."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from amiwarp import Camera, CircleModel, Encoder, Events, Vote
from amiwarp.imaging import cuda_votes
from amiwarp.imaging.canvas import CanvasShape
from amiwarp.imaging.uploaded_events import upload_events
from amiwarp.kernels.camera import pinhole_params


def test_events_of_many_calls_are_not_held_until_the_image_is_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The fast kernel runs on any device, but its sums are right on CUDA only: here all of its batches pass."""
    monkeypatch.setattr(cuda_votes, "FIRST_BATCH", 1000)
    monkeypatch.setattr(cuda_votes, "MOST_UNVERIFIED", 3000)
    canvas = CanvasShape(32, 24, 2, 1.0, False, Vote.BILINEAR)
    votes = cuda_votes.WordVotes(canvas.params(), canvas.layers, "cpu")
    held: list[int] = []

    def verify() -> None:
        held.append(sum(count for _, count, _ in votes._batches))
        votes._batches_fit = True
        votes._discard_batches()

    monkeypatch.setattr(votes, "_verify_batches", verify)
    model = CircleModel(Camera.from_fov(32, 24, 1.0), 0.01)
    encoder = Encoder.constant_speed(720.0, -10, 100_000)
    params = model.params("cpu")
    camera: Any = pinhole_params(model.camera)
    for index in range(9):
        t = np.arange(1000, dtype=np.int64) + 1000 * index
        x = (t % 32).astype(np.uint16)
        y = (t % 24).astype(np.uint16)
        events = upload_events(Events(x, y, t, np.ones(1000, np.uint8)), encoder, "cpu")
        inputs = [params, camera, events.arrays, canvas.params()]
        votes.vote(votes.EVENTS, inputs, events.count, events.total)
    # The first batch is verified alone, as it says how large the others may be.
    assert held == [1000, 3000, 3000]
