"""Live pictures as a GPU makes them, compared with those of the CPU; their kernels run on both."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from amiwarp import (
    Camera,
    EncoderStream,
    Events,
    ExactModel,
    LivePicture,
    PhaseCamera,
    Prism,
    PrismMotion,
    Recording,
    Scene,
    Simulation,
)
from amiwarp.imaging.phase_ring import PhaseRing
from amiwarp.imaging.phase_ring_device import DeviceRing
from amiwarp.optics.models.base import Model
from amiwarp.reconstruction import phase_camera
from amiwarp.reconstruction.stream_pictures import DevicePicturesOfStream

CAMERA = Camera.from_fov(150, 70, math.radians(50.0))
PRISM = Prism(math.radians(1.2))
MODEL = ExactModel(CAMERA, PRISM, 2.0)
ROUNDING = 2e-3
"""Largest difference of pictures in which something moves, with a range of 10 [thresholds]."""


@pytest.fixture(scope="module")
def recording(texture: NDArray[np.uint8]) -> Recording:
    scene = Scene.from_picture(texture)
    return Simulation(scene, CAMERA, PRISM, 0.21, PrismMotion(-720.0, 2.0), seed=4).run()


@pytest.fixture(scope="module")
def moving(recording: Recording) -> Events:
    """From 0.12 s on, a part of the image shows another part of it."""
    events = recording.events[:]
    late = events.t >= 120_000
    inside = (np.abs(events.x - 40.0) < 15) & (np.abs(events.y - 30.0) < 15)
    other = (np.abs(events.x - 100.0) < 15) & (np.abs(events.y - 40.0) < 15)
    kept = ~(late & inside)
    copied = late & other
    x = np.concatenate([events.x[kept], events.x[copied] - 60])
    y = np.concatenate([events.y[kept], events.y[copied] - 10])
    t = np.concatenate([events.t[kept], events.t[copied]])
    p = np.concatenate([events.p[kept], events.p[copied]])
    order = np.argsort(t, kind="stable")
    return Events.from_arrays(x[order], y[order], t[order], p[order])


def pictures(recording: Recording, events: Events, device: str) -> list[LivePicture]:
    assert recording.encoder is not None
    encoder = EncoderStream()
    encoder.append(recording.encoder.t, recording.encoder.angle)
    camera = PhaseCamera(MODEL, encoder, device=device)
    out = []
    # Several pictures at once, and single ones
    for start, stop in ((0, 110_000), (110_000, 170_000), (170_000, 180_000), (180_000, 300_000)):
        first, last = np.searchsorted(events.t, (start, stop))
        camera.put(events[first:last], 0)
        out += camera.take(0)
    return out


def test_live_pictures_are_those_of_the_cpu(
    recording: Recording, moving: Events, device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = pictures(recording, moving, "cpu")

    def there(device: Any, model: Model, harmonics: int) -> DevicePicturesOfStream:
        return DevicePicturesOfStream(model, harmonics, device)

    monkeypatch.setattr(phase_camera, "pictures_on", there)
    found = pictures(recording, moving, device)
    assert len(found) == len(expected) == 7
    assert any(one.moved.any() for one in expected)
    assert not all(one.moved.any() for one in expected)
    for one, other in zip(found, expected, strict=True):
        assert (one.turns, one.events, one.end_us) == (other.turns, other.events, other.end_us)
        assert one.picture.off_excess == other.picture.off_excess
        np.testing.assert_array_equal(one.picture.known, other.picture.known)
        np.testing.assert_allclose(one.misfit, other.misfit, rtol=0, atol=1e-4)
        np.testing.assert_array_equal(one.moved, other.moved)
        np.testing.assert_allclose(one.picture.log, other.picture.log, rtol=0, atol=ROUNDING)
        assert np.ptp(other.picture.log) > 2.0
    assert not np.array_equal(found[-1].picture.log, found[-2].picture.log)


def test_sums_of_a_ring_on_a_device(device: str) -> None:
    """A whole turn, and then parts of some lengths, with more events of a pixel and bin than are counted."""
    rng = np.random.default_rng(2)
    count = 120_000
    angles = -np.sort(rng.uniform(0.0, 2.5 * math.tau, count))
    x, y = rng.integers(0, (60, 50), (count, 2)).T
    crowd = (angles < -1.4 * math.tau) & (angles > -1.45 * math.tau)
    x[crowd] = 3
    y[crowd] = 2
    events = Events.from_arrays(x, y, np.arange(count), rng.random(count) < 0.6)
    host = PhaseRing(60, 50, harmonics=5)
    there = DeviceRing(60, 50, 5, device)
    sums = None
    for start, bins in ((0, 64), (80_000, 12), (84_000, 20), (100_000, 64)):
        stop = start + 4000 if start else 80_000
        for ring in (host, there):
            ring.add(events[start:stop], angles[start:stop])
        there.give(bins, first=sums is None)
        there.sum_given()
        sums = host.sums() if sums is None else host.update(sums, bins / 64).sums
        values = there.values.numpy().view(np.complex64)[..., 0]
        np.testing.assert_allclose(values, sums.values, rtol=0, atol=2e-4)
        assert there.ratio == sums.off_ratio
    assert (host._planes >> 8).max() == (host._planes & 255).max() == 255


def test_events_are_added_once(device: str) -> None:
    ring = DeviceRing(4, 3, 1, device)
    events = Events.from_arrays([1, 1, 3, 1], [2, 2, 0, 2], [0, 1, 2, 3], [1, 0, 1, 1])
    ring.add(events, np.array([0.01, 0.02, 0.03, 0.04]))
    words = ring._words.numpy()
    assert words[0, 9] == (2 << 16) + 1
    assert words[0, 3] == 1 << 16
    assert words.sum() == (3 << 16) + 1
