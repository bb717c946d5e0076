"""Compensation of recordings: nothing lost, nothing reordered, places those of the model."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import TRUE_PRISM

from amiwarp.calib import Calibration, calibrate
from amiwarp.compensate import compensate, compensate_events, compensated_blocks, inside_image
from amiwarp.errors import AmiwarpError
from amiwarp.events import Events, MemoryEvents, Recording
from amiwarp.io import open_recording
from amiwarp.iwe import iwe
from amiwarp.metrics import edge_blur, truth_model
from amiwarp.optics import ExactModel, FlatSide
from amiwarp.sharpness import sharpness


@pytest.fixture(scope="module")
def calibration(recording: Recording) -> Calibration:
    return calibrate(recording, events=200_000)


def test_places_agree_with_the_stored_truth(recording: Recording, device: str) -> None:
    """The simulator's truth is the scene point at the moment of crossing; events are stamped 0.1 ms late."""
    assert recording.truth is not None
    assert recording.encoder is not None
    events = recording.events.slice(0, 100_000)
    truth = truth_model(recording.camera, recording.truth, FlatSide.SCENE)
    moved = compensate_events(events, truth, recording.encoder, device=device)
    d = np.linalg.norm(moved - recording.truth.points(0, 100_000), axis=1)
    assert np.sqrt(np.nanmean(d**2)) < 0.12  # px: 130 us at 75 rad/s on an orbit of 9 px


def test_file_keeps_time_polarity_and_order(
    recording: Recording, calibration: Calibration, tmp_path: Path, device: str
) -> None:
    done = []
    summary = compensate(
        recording, calibration, tmp_path / "out.h5", device=device, progress=lambda n, _: done.append(n)
    )
    raw = recording.events.slice(0, len(recording.events))
    out = open_recording(tmp_path / "out.h5")
    moved = out.events.slice(0, len(out.events))
    assert summary.events == len(raw) == done[-1]
    np.testing.assert_array_equal(moved.t, raw.t)
    np.testing.assert_array_equal(moved.p, raw.p)
    assert recording.encoder is not None
    expected = compensate_events(raw, calibration.model, recording.encoder, device=device)
    np.testing.assert_array_equal(np.stack([moved.x, moved.y], axis=1), expected)
    outside = ~inside_image(expected, *recording.events.size)
    assert summary.outside == outside.sum() > 0
    np.testing.assert_array_equal(out.events.inside(0, len(raw)), ~outside)
    assert list(tmp_path.iterdir()) == [tmp_path / "out.h5"]


def test_compensation_sharpens(recording: Recording, calibration: Calibration) -> None:
    width, height = recording.events.size
    raw = recording.events.slice(0, len(recording.events))
    before = iwe(raw, width, height)
    after = iwe(raw, width, height, model=calibration.model, encoder=recording.encoder)
    assert sharpness(after, smoothing=1.0) > 1.5 * sharpness(before, smoothing=1.0)
    assert recording.encoder is not None
    places = compensate_events(raw, calibration.model, recording.encoder)
    blur = edge_blur(places, width, height)
    was = edge_blur(places, width, height, of=np.stack([raw.x, raw.y], axis=1).astype(np.float32))
    assert blur < was / 3


def test_blocks_by_time_hold_every_event_once(recording: Recording, calibration: Calibration) -> None:
    assert recording.encoder is not None
    blocks = list(compensated_blocks(recording, calibration.model, recording.encoder, duration_us=33_000))
    assert sum(map(len, blocks)) == len(recording.events)
    assert all(np.ptp(b.t) < 33_000 for b in blocks)


def test_empty_recording(recording: Recording, calibration: Calibration, tmp_path: Path) -> None:
    empty = replace(recording, events=MemoryEvents(Events.empty(), *recording.events.size), truth=None)
    summary = compensate(empty, calibration, tmp_path / "empty.h5")
    assert summary.events == 0
    assert len(open_recording(tmp_path / "empty.h5").events) == 0


def test_another_camera_is_refused(recording: Recording, calibration: Calibration, tmp_path: Path) -> None:
    events = recording.events.slice(0, 10)
    small = replace(recording, events=MemoryEvents(events, 400, 300), camera=None, truth=None)
    with pytest.raises(AmiwarpError, match="400x300"):
        compensate(small, calibration, tmp_path / "out.h5")
    assert list(tmp_path.iterdir()) == []


def test_an_interrupt_leaves_nothing(recording: Recording, calibration: Calibration, tmp_path: Path) -> None:
    def interrupt(_done: int, _all: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compensate(recording, calibration, tmp_path / "out.h5", progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_inside_image_at_its_border() -> None:
    xy = np.array([[-0.5, 0], [-0.51, 0], [9.49, 4.49], [9.5, 0], [0, 4.5], [np.nan, 0]], dtype=np.float32)
    np.testing.assert_array_equal(inside_image(xy, 10, 5), [True, False, True, False, False, False])


def test_total_reflection_is_marked_not_spread(recording: Recording, tmp_path: Path) -> None:
    """A prism so steep that part of the image has no ray: NaN places, marked, and an image without NaN."""
    assert recording.camera is not None
    assert recording.encoder is not None
    wide = replace(recording.camera, fx=30.0, fy=30.0)
    steep = ExactModel(wide, replace(TRUE_PRISM, apex=math.radians(25.0)))
    events = recording.events.slice(0, 50_000)
    places = compensate_events(events, steep, recording.encoder)
    assert np.isnan(places).any()
    image = iwe(events, *recording.events.size, model=steep, encoder=recording.encoder)
    assert np.isfinite(image).all()
    assert 0 < image.sum() < len(events)
