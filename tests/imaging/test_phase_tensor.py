"""Sums in phase as tensors: channels, windows, devices, and the transform that finds the encoder in a recording."""

import math

import numpy as np
import pytest

import amiwarp
from amiwarp import AmiwarpError, DeviceEvents, Encoder, Events, MemoryEvents, Recording

WIDTH = 12
HEIGHT = 9
TURN_US = 50_000
ENCODER = Encoder.constant_speed(1200.0, 0, 4 * TURN_US)


@pytest.fixture(scope="module")
def events() -> Events:
    rng = np.random.default_rng(3)
    count = 4000
    t = np.sort(rng.integers(0, 4 * TURN_US, count))
    x = rng.integers(0, WIDTH, count)
    y = rng.integers(0, HEIGHT, count)
    return Events.from_arrays(x, y, t, rng.integers(0, 2, count))


def test_channels_are_the_parts_of_the_sums(events: Events) -> None:
    found = amiwarp.phase_tensor(
        events, WIDTH, HEIGHT, 3, encoder=ENCODER, turns=4.0, off_ratio=1.1
    )
    sums = amiwarp.phase_sums(events, ENCODER, WIDTH, HEIGHT, harmonics=3, turns=4.0, off_ratio=1.1)
    assert found.shape == (6, HEIGHT, WIDTH)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found[0::2], sums.values.real)
    np.testing.assert_array_equal(found[1::2], sums.values.imag)


def test_each_window_has_a_tensor(events: Events) -> None:
    cut = amiwarp.windows(events, encoder=ENCODER, turns=1.0)
    found = amiwarp.phase_tensor(events, WIDTH, HEIGHT, 2, encoder=ENCODER, windows=cut)
    assert found.shape == (len(cut), 4, HEIGHT, WIDTH)
    assert len(cut) >= 3
    for k in (0, 2):
        part = events[int(cut.start[k]) : int(cut.stop[k])]
        alone = amiwarp.phase_tensor(part, WIDTH, HEIGHT, 2, encoder=ENCODER)
        np.testing.assert_array_equal(found[k], alone)
    none = amiwarp.windows(events, ranges=np.zeros((0, 2), np.int64))
    empty = amiwarp.phase_tensor(events, WIDTH, HEIGHT, 2, encoder=ENCODER, windows=none)
    assert empty.shape == (0, 4, HEIGHT, WIDTH)
    with pytest.raises(AmiwarpError, match="windows reach to event"):
        amiwarp.phase_tensor(events[:10], WIDTH, HEIGHT, 2, encoder=ENCODER, windows=cut)


def test_events_on_a_device_give_an_array_there(events: Events, device: str) -> None:
    there = DeviceEvents.from_arrays(events.x, events.y, events.t, events.p, device=device)
    cut = amiwarp.windows(events, encoder=ENCODER, turns=2.0)
    for windows in (None, cut):
        found = amiwarp.phase_tensor(there, WIDTH, HEIGHT, 2, encoder=ENCODER, windows=windows)
        here = amiwarp.phase_tensor(events, WIDTH, HEIGHT, 2, encoder=ENCODER, windows=windows)
        assert str(found.device) == device
        np.testing.assert_array_equal(found.numpy(), here)


def test_the_transform_finds_the_encoder_of_a_recording(events: Events) -> None:
    recording = Recording(MemoryEvents(events, WIDTH, HEIGHT), encoder=ENCODER)
    transform = amiwarp.ToTensor(amiwarp.phase_tensor, harmonics=2)
    expected = amiwarp.phase_tensor(events, WIDTH, HEIGHT, 2, encoder=ENCODER)
    np.testing.assert_array_equal(transform(recording), expected)
    with pytest.raises(AmiwarpError, match="ToTensor has no width"):
        transform(events)


def test_an_event_turns_with_the_optic() -> None:
    """A single ON event at a quarter turn: exp(-i m pi / 2) / 2 pi."""
    one = Events.from_arrays([4], [2], [TURN_US // 4], [1])
    found = amiwarp.phase_tensor(one, WIDTH, HEIGHT, 2, encoder=ENCODER, bins=1024, off_ratio=1.0)[
        :, 2, 4
    ]
    expected = np.exp(-0.5j * math.pi * np.array([1.0, 2.0])) / math.tau
    np.testing.assert_allclose(found[0::2] + 1j * found[1::2], expected, atol=2e-3)
