"""Compensation of streams: the same as of recordings, every event once and in order, extrapolated angles marked."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Camera,
    Compensated,
    Compensator,
    Encoder,
    EncoderStream,
    Events,
    ExactModel,
    MirrorModel,
    Model,
    Prism,
    RadialTangential,
    RisleyModel,
    compensate_events,
    iwe,
)
from amiwarp.compensation import EXTRAPOLATED, NO_ANGLE, OUTSIDE
from amiwarp.optics import MODELS, rungs

WIDTH, HEIGHT = 64, 48
CAMERA = Camera.from_fov(WIDTH, HEIGHT, math.radians(60))
MODEL = ExactModel.from_prism(CAMERA, Prism(math.radians(2.0)), 0.4)
ENCODER = Encoder.constant_speed(720.0, 0, 100_000)


def random_events(n: int, seconds: float = 0.1, seed: int = 0) -> Events:
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, WIDTH, n), rng.integers(0, HEIGHT, n)
    return Events.from_arrays(
        x, y, np.sort(rng.integers(0, round(seconds * 1e6), n)), rng.integers(0, 2, n)
    )


def streamed(encoder: Encoder = ENCODER) -> EncoderStream:
    stream = EncoderStream(encoder.clock_offset_us)
    stream.append(encoder.t, encoder.angle)
    return stream


def test_flush_returns_events_however_long_they_may_wait() -> None:
    model = MODELS["circle"].from_prism(CAMERA, Prism(math.radians(2.0)), 0.4)
    with pytest.raises(AmiwarpError, match="start_us"):
        Compensator(model, EncoderStream(), start_us=2**62)
    compensator = Compensator(model, EncoderStream(), start_us=2**61, wait_us=2**61)
    compensator.put(random_events(3), 2**60)
    assert [len(packet.events) for packet in compensator.flush()] == [3]


def joined(packets: list[Compensated]) -> tuple[Events, np.ndarray]:
    return Events.concatenate([p.events for p in packets]), np.concatenate(
        [p.flags for p in packets]
    )


@pytest.mark.parametrize("name", list(rungs()))
@pytest.mark.parametrize("distorted", [False, True])
def test_a_stream_comes_out_as_its_recording_does(name: str, distorted: bool, device: str) -> None:
    """Equal bit for bit, for packets of any size, some longer than a batch, with a clock offset."""
    camera = (
        replace(CAMERA, distortion=RadialTangential(-0.2, 0.05, 0.001, -0.001, 0.0))
        if distorted
        else CAMERA
    )
    model, events = (
        MODELS[name].from_prism(camera, Prism(math.radians(2.0)), 0.4),
        random_events(30_000),
    )
    encoder = Encoder.constant_speed(720.0, -5000, 110_000).with_clock_offset(123.4)
    compensator = Compensator(model, streamed(encoder), batch=4000, device=device)
    out, start = [], 0
    for n in (1, 0, 63, 64, 65, 9000, 777, 30_000):
        compensator.put(events[start : start + n], 0)
        out += compensator.take(0)
        start += n
    found, flags = joined(out + compensator.flush())
    expected = compensate_events(events, model, encoder, device=device)
    np.testing.assert_array_equal(np.stack([found.x, found.y], axis=1), expected)
    np.testing.assert_array_equal(found.t, events.t)
    np.testing.assert_array_equal(found.p, events.p)
    inside = (
        (found.x >= -0.5) & (found.x < WIDTH - 0.5) & (found.y >= -0.5) & (found.y < HEIGHT - 0.5)
    )
    np.testing.assert_array_equal(flags, np.where(inside, 0, OUTSIDE))
    assert 0 < np.count_nonzero(flags) < len(events) / 2
    assert compensator.waiting == 0


def test_the_running_image_is_that_of_the_events_taken(device: str) -> None:
    events = random_events(50_000)
    compensator = Compensator(MODEL, streamed(), batch=2048, device=device)
    images = []
    for start in range(0, 50_000, 1000):
        compensator.put(events[start : start + 1000], 0)
        compensator.take(0)
        if start == 20_000:
            images.append(compensator.image())
    images.append(compensator.image())
    for image, part in zip(images, (events[:21_000], events[21_000:]), strict=True):
        expected = iwe(part, WIDTH, HEIGHT, model=MODEL, encoder=ENCODER, device=device)
        assert image.sum() == pytest.approx(expected.sum(), rel=1e-3)
        # Angles have 16 bits in iwe, 32 bits here
        assert np.abs(image - np.squeeze(expected)).max() < 0.3
    assert compensator.image().sum() == 0.0


@pytest.mark.parametrize("size", [700, 3000])
def test_the_image_is_whole_however_many_batches_are_under_way(size: int, device: str) -> None:
    """One call takes many batches, so each buffer is used several times."""
    events = random_events(100_000)
    compensator = Compensator(MODEL, streamed(), batch=4096, device=device)
    for start in range(0, 100_000, size):
        compensator.put(events[start : start + size], 0)
    found, _ = joined(compensator.take(0) + compensator.flush())
    expected = compensate_events(events, MODEL, ENCODER, device=device)
    np.testing.assert_array_equal(np.stack([found.x, found.y], axis=1), expected)
    image = iwe(events, WIDTH, HEIGHT, model=MODEL, encoder=ENCODER, device=device)
    assert np.abs(compensator.image() - np.squeeze(image)).max() < 0.5


def test_columns_with_gaps_are_sorted_too(device: str) -> None:
    """Long packets whose columns are strided views of a structured array."""
    n = 600_000
    records = np.zeros(n, [("x", "<u2"), ("y", "<u2"), ("t", "<i8"), ("p", "u1")])
    records["t"] = np.arange(n) // 6
    compensator = Compensator(MODEL, streamed(), batch=1 << 20, device=device)
    compensator.put(Events(*(records[name] for name in "xytp")), 0)
    found, _ = joined(compensator.take(0))
    np.testing.assert_array_equal(found.t, records["t"])


def test_a_packet_that_steps_back_between_two_batches_is_refused() -> None:
    events = random_events(8000)
    back = Events(events.x, events.y, np.concatenate([events.t[4000:], events.t[:4000]]), events.p)
    compensator = Compensator(MODEL, streamed(), batch=4000)
    with pytest.raises(AmiwarpError, match="not sorted"):
        compensator.put(back, 0)
    assert compensator.waiting == 0


def test_batches_under_way_come_with_the_next_call(device: str) -> None:
    """Flags depend on the samples known when a batch began. Each event comes once, in order."""
    events, stream = random_events(60_000), EncoderStream()
    compensator = Compensator(MODEL, stream, wait_us=0, batch=1024, device=device)
    compensator._least_returned = 2  # as on CUDA
    out, known = [], ENCODER.t <= 90_000
    for start in range(0, 60_000, 6000):
        part = events[start : start + 6000]
        if start == 6000:
            stream.append(ENCODER.t[known], ENCODER.angle[known])
        if start == 54_000:  # samples arrive while batches are in flight
            compensator.put(part, 0)
            out += compensator.take(10**9)
            stream.append(ENCODER.t[~known], ENCODER.angle[~known])
            continue
        for k in range(0, 6000, 500):
            compensator.put(part[k : k + 500], 0)
        out += compensator.take(10**9 if start == 0 else 0)
        assert compensator.waiting == 0
    assert sum(len(packet.flags) for packet in out) < 60_000
    found, flags = joined(out + compensator.flush())
    np.testing.assert_array_equal(found.t, events.t)
    np.testing.assert_array_equal(found.p, events.p)
    expected = compensate_events(events, MODEL, ENCODER, device=device)
    sure = flags & (NO_ANGLE | EXTRAPOLATED) == 0
    np.testing.assert_array_equal(np.stack([found.x, found.y], axis=1)[sure], expected[sure])
    last = sure[found.t > 91_000]
    assert not last[0]  # its batch began before its samples arrived
    assert last[-1]  # its batch began after they arrived
    assert sure[(found.t > events.t[6000]) & (found.t < 90_000)].all()


def test_a_packet_waits_for_the_encoder_and_no_longer_than_it_may() -> None:
    events, stream = random_events(3000, 0.03), EncoderStream()
    compensator = Compensator(MODEL, stream, wait_us=10_000, start_us=500_000)
    early, middle, late = (events[k : k + 1000] for k in (0, 1000, 2000))
    compensator.put(early, 0)
    assert compensator.take(499_999) == []  # no encoder sample yet
    known = int(np.searchsorted(ENCODER.t, early.t[-1])) + 1
    stream.append(ENCODER.t[:known], ENCODER.angle[:known])
    assert not joined(compensator.take(499_999))[1].astype(bool).all()
    compensator.put(middle, 500_000)
    compensator.put(late, 504_000)
    assert compensator.take(509_999) == []
    first = compensator.take(510_000)
    assert [len(p.events) for p in first] == [1000]  # without the event that still waits
    assert (first[0].flags[-1] & EXTRAPOLATED) == EXTRAPOLATED
    assert first[0].arrived_us == 500_000
    assert compensator.waiting == 1000
    stream.append(ENCODER.t[known:], ENCODER.angle[known:])
    last = compensator.take(510_000)
    assert not (joined(last)[1] & EXTRAPOLATED).any()  # its samples arrived in time
    # extrapolation is exact at constant speed
    found, _ = joined([*first, *last])
    expected = compensate_events(events[1000:], MODEL, ENCODER)
    np.testing.assert_allclose(np.stack([found.x, found.y], axis=1), expected, atol=2e-3)


def test_samples_that_come_after_a_guess_replace_it_for_later_events() -> None:
    """The prism turns back where its angle was extrapolated; a later packet has events of the same time."""
    stream = EncoderStream()
    stream.append([0, 10_000], [0.0, 0.754])
    compensator = Compensator(MODEL, stream, wait_us=1000)
    events = Events.from_arrays([30, 40], [20, 30], [15_000, 20_000], [1, 0])
    compensator.put(events, 0)
    (guess,) = compensator.take(1000)
    assert (guess.flags & EXTRAPOLATED).tolist() == [EXTRAPOLATED] * 2
    stream.append([20_000, 30_000], [0.2, 0.0])
    compensator.put(events[1:], 2000)
    (found,) = compensator.take(2000)
    assert not (found.flags & EXTRAPOLATED).any()
    expected = compensate_events(
        events[1:], MODEL, Encoder.from_angles([0, 10_000, 20_000, 30_000], [0, 0.754, 0.2, 0])
    )
    np.testing.assert_allclose(
        np.stack([found.events.x, found.events.y], axis=1), expected, rtol=0, atol=1e-3
    )


def test_too_many_that_wait_are_guessed_at_once() -> None:
    events, stream = random_events(5000, 0.05), EncoderStream()
    stream.append([0, 1000], [0.0, 0.0754])
    compensator = Compensator(MODEL, stream, wait_us=10**9, most_waiting=2500)
    sizes = []
    for start in range(0, 5000, 500):
        compensator.put(events[start : start + 500], 0)
        sizes.append(sum(len(p.events) for p in compensator.take(0)))
        assert compensator.waiting <= 2500
    assert sum(sizes) == 2500
    assert sum(len(p.events) for p in compensator.flush()) == 2500


def test_without_any_angle_there_is_no_place() -> None:
    events = random_events(1000)
    compensator = Compensator(MODEL, EncoderStream(), start_us=1000)
    compensator.put(events, 0)
    assert compensator.take(999) == []
    found, flags = joined(compensator.take(1000))
    assert np.isnan(found.x).all()
    assert np.isnan(found.y).all()
    assert (flags == OUTSIDE | NO_ANGLE).all()
    assert compensator.image().sum() == 0.0


def test_events_before_the_first_sample_have_no_place(device: str) -> None:
    stream, events = EncoderStream(), random_events(10_000)
    late = ENCODER.t >= 50_000
    stream.append(ENCODER.t[late], ENCODER.angle[late])
    compensator = Compensator(MODEL, stream, device=device)
    compensator.put(events, 0)
    found, flags = joined(compensator.take(0))
    # As in recordings, angles reach back one interval before the first sample
    before = events.t < 49_000
    np.testing.assert_array_equal((flags & NO_ANGLE) > 0, before)
    np.testing.assert_array_equal((flags & EXTRAPOLATED) > 0, (events.t < 50_000) & ~before)
    np.testing.assert_array_equal(np.isnan(found.x), before)
    expected = compensate_events(events[~before], MODEL, ENCODER)
    np.testing.assert_array_equal(found.x[~before], expected[:, 0])
    assert compensator.image().sum() == pytest.approx(((flags & OUTSIDE) == 0).sum(), rel=0.02)


def test_a_hole_in_the_samples_is_marked() -> None:
    stream, events = EncoderStream(), random_events(10_000)
    kept = (ENCODER.t <= 30_000) | (ENCODER.t >= 60_000)
    stream.append(ENCODER.t[kept], ENCODER.angle[kept])
    compensator = Compensator(MODEL, stream)
    compensator.put(events, 0)
    flags = joined(compensator.take(0))[1]
    np.testing.assert_array_equal(
        (flags & EXTRAPOLATED) > 0, (events.t > 30_000) & (events.t < 60_000)
    )


def test_nothing_is_interpolated_from_one_zero_to_another() -> None:
    """After a reset, the angle is extrapolated at constant speed up to the first new sample, where it jumps."""
    stream, events = EncoderStream(), random_events(10_000)
    before, after = ENCODER.t <= 40_000, ENCODER.t >= 50_000
    stream.append(ENCODER.t[before], ENCODER.angle[before])
    stream.restart()
    stream.append(ENCODER.t[after], ENCODER.angle[after] + 1.0)
    compensator = Compensator(MODEL, stream)
    compensator.put(events, 0)
    found, flags = joined(compensator.take(0))
    between = (events.t > 40_000) & (events.t < 50_000)
    np.testing.assert_array_equal((flags & EXTRAPOLATED) > 0, between)
    expected = compensate_events(events, MODEL, ENCODER)
    xy = np.stack([found.x, found.y], axis=1)
    np.testing.assert_allclose(xy[events.t < 49_999], expected[events.t < 49_999], atol=2e-3)
    shifted = compensate_events(events, replace(MODEL, phase=MODEL.phase + 1.0), ENCODER)
    np.testing.assert_allclose(xy[events.t >= 50_000], shifted[events.t >= 50_000], atol=2e-3)


@pytest.mark.parametrize("seed", range(40))
def test_every_event_comes_out_once_and_in_order(seed: int) -> None:
    """For packets of any size, any number of samples, and any pauses between them."""
    rng = np.random.default_rng(seed)
    steps = rng.integers(0, [401, 10, 30_001], (int(rng.integers(0, 31)), 3)).tolist()
    events, stream = random_events(sum(n for n, _, _ in steps)), EncoderStream()
    compensator = Compensator(
        MODEL, stream, wait_us=20_000, start_us=50_000, most_waiting=2000, batch=300
    )
    out: list[Compensated] = []
    start = sample = now = 0
    for n, samples, pause in steps:
        compensator.put(events[start : start + n], now)
        stream.append(
            ENCODER.t[sample : sample + samples], ENCODER.angle[sample : sample + samples]
        )
        start, sample, now = start + n, sample + samples, now + pause
        out += compensator.take(now)
    out += compensator.flush()
    assert compensator.waiting == 0
    found = Events.concatenate([p.events for p in out]) if out else Events.empty()
    np.testing.assert_array_equal(found.t, events.t)
    np.testing.assert_array_equal(found.p, events.p)
    assert all(len(p.flags) == len(p.events) for p in out)
    known = np.concatenate([(p.flags & NO_ANGLE) == 0 for p in out]) if out else np.zeros(0, bool)
    np.testing.assert_array_equal(np.isfinite(found.x), known)


def test_pixels_outside_the_sensor_are_placed_as_in_a_recording(device: str) -> None:
    """Packets with such pixels lie between packets without, which are displaced in a faster way."""
    events = random_events(9000)
    x = events.x.copy()
    x[3000:6000:7] = 300
    events = replace(events, x=x)
    compensator = Compensator(MODEL, streamed(), device=device)
    out = []
    for start in range(0, 9000, 3000):
        compensator.put(events[start : start + 3000], 0)
        out += compensator.take(0)
    found, _ = joined(out)
    expected = compensate_events(events, MODEL, ENCODER, device=device)
    np.testing.assert_allclose(np.stack([found.x, found.y], axis=1), expected, atol=2e-3)


def test_strays_leave_nothing_behind_for_events_that_come_after(device: str) -> None:
    """The unused end of a block is displaced too, with old pixel values from earlier events."""
    model = MODELS["ellipse"].from_prism(CAMERA, Prism(math.radians(2.0)), 0.4)
    compensator = Compensator(model, streamed(), batch=64, device=device)
    far = np.full(64, 65535, np.uint16)
    events = random_events(400)
    compensator.put(replace(events[:64], x=far, y=far), 0)
    out = compensator.take(0)
    for start in (64, 128, 192, 256, 257):
        compensator.put(events[start : start + (64 if start < 256 else 1)], 0)
        out += compensator.take(0)
    found = joined(out[1:])[0]
    expected = compensate_events(events[64:258], model, ENCODER, device=device)
    np.testing.assert_array_equal(np.stack([found.x, found.y], axis=1), expected)


def test_bad_packets_are_refused_and_nothing_is_put() -> None:
    events = random_events(100)
    compensator = Compensator(MODEL, streamed())
    compensator.put(events[50:], 0)
    with pytest.raises(AmiwarpError, match="sort the packets by time"):
        compensator.put(events[:50], 0)
    with pytest.raises(AmiwarpError, match="already compensated"):
        compensator.put(
            Events(events.x.astype(np.float32), events.y.astype(np.float32), events.t, events.p), 0
        )
    assert compensator.waiting == 50


@pytest.mark.parametrize("parts", [1, 40])
def test_a_packet_that_is_not_sorted_is_told_when_it_is_its_turn(parts: int) -> None:
    events = random_events(200_000)
    t = events.t.copy()
    t[150_001] = t[150_000] - 1
    compensator = Compensator(MODEL, streamed(), batch=1 << 18)
    for start in range(0, 200_000, 200_000 // parts):
        compensator.put(replace(events, t=t)[start : start + 200_000 // parts], 0)
    with pytest.raises(AmiwarpError, match="sort each packet"):
        compensator.take(0)


@pytest.mark.parametrize("size", [1000, 70_000, 200_000])
def test_packets_that_are_ready_together_come_out_together(size: int, device: str) -> None:
    """Several threads copy the packets, whatever their sizes."""
    events = random_events(200_000)
    compensator = Compensator(MODEL, streamed(), batch=1 << 18, device=device)
    for start in range(0, 200_000, size):
        compensator.put(events[start : start + size], start)
    (out,) = compensator.take(0)
    assert out.arrived_us == 0
    np.testing.assert_array_equal(out.events.t, events.t)
    np.testing.assert_array_equal(out.events.p, events.p)
    expected = compensate_events(events, MODEL, ENCODER, device=device)
    np.testing.assert_array_equal(np.stack([out.events.x, out.events.y], axis=1), expected)


def test_what_was_taken_stays_while_it_is_held(device: str) -> None:
    """On a GPU, the memory of released results is used again."""
    events = random_events(1_500_000)
    compensator = Compensator(MODEL, streamed(), batch=1 << 17, device=device)
    held, sums, places = [], [], set()

    def summed(out: Compensated) -> list[float]:
        e = out.events
        return [
            float(np.nansum(values, dtype=np.float64)) for values in (e.x, e.y, e.t, e.p, out.flags)
        ]

    for start in range(0, 1_500_000, 100_000):
        compensator.put(events[start : start + 50_000], 0)
        compensator.put(events[start + 50_000 : start + 100_000], 0)
        (out,) = compensator.take(0)
        places.add(out.events.x.ctypes.data)
        if start % 300_000 == 0:
            held.append(out)
            sums.append(summed(out))
        del out
    assert device == "cpu" or len(places) < 10
    for out, given in zip(held, sums, strict=True):
        assert summed(out) == given


def test_what_is_put_stays_as_it_is() -> None:
    events = random_events(1000)
    kept = Events(*(getattr(events, name).copy() for name in ("x", "y", "t", "p")))
    compensator = Compensator(MODEL, streamed())
    compensator.put(events, 0)
    compensator.take(0)
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(events, name), getattr(kept, name))


# Two angles: a pair of prisms, and a mirror.

PAIR = RisleyModel(
    CAMERA, Prism(math.radians(1.2), second=Prism(math.radians(0.9), 1.6)), 0.3, -0.7
)
MIRROR = MirrorModel.from_values(CAMERA, Prism(0.0), {
    "amplitude": 0.02, "second_amplitude": 0.015, "phase": 0.4, "second_phase": -0.9, "direction": 0.1,
    "second_direction": 1.6, "fold": 0.3, "incidence": 0.8,
})  # fmt: skip
FIRST_T, SECOND_T = np.arange(-3000, 112_000, 1000), np.arange(-2500, 113_000, 1300)
"""Sample times of two encoders, of which the second starts later [us]."""
LARGEST = 7.0


def commands(t: np.ndarray) -> np.ndarray:
    """Return a command of two frequencies, which seldom reaches its largest magnitude."""
    return np.asarray(LARGEST * (0.7 * np.sin(6e-4 * t) + 0.3 * np.cos(1.7e-3 * t)))


Fed: TypeAlias = tuple[EncoderStream, Encoder, list[Callable[[int], object]]]
"""A stream, the encoder of all its samples, and functions that append the k-th samples of each encoder."""


def measured(offset: float = 0.0) -> tuple[Encoder, Encoder]:
    first = Encoder(FIRST_T, FIRST_T * 75e-6 + 0.02 * np.sin(FIRST_T * 1e-4), offset)
    return first, Encoder(SECOND_T, SECOND_T * -52e-6, offset)


def samples_of(into: EncoderStream, encoder: Encoder) -> Callable[[int], object]:
    return lambda k: into.append(encoder.t[4 * k : 4 * k + 4], encoder.angle[4 * k : 4 * k + 4])


def two_encoders(offset: float) -> Fed:
    first, second = measured(offset)
    other = EncoderStream(offset)
    stream = EncoderStream(offset, second=other)
    return stream, first.with_second(second), [samples_of(stream, first), samples_of(other, second)]


def geared(offset: float) -> Fed:
    first, _ = measured(offset)
    stream = EncoderStream(offset, second=-0.7)
    return stream, first.with_second(-0.7), [samples_of(stream, first)]


def commanded(offset: float) -> Fed:
    other = EncoderStream(offset)
    stream = EncoderStream(offset, second=other)
    first, second = commands(FIRST_T), commands(0.7 * SECOND_T)
    encoder = Encoder.from_command(FIRST_T, first, largest=LARGEST, clock_offset_us=offset)

    def feed(into: EncoderStream, t: np.ndarray, u: np.ndarray) -> Callable[[int], object]:
        return lambda k: into.append_command(
            t[4 * k : 4 * k + 4], u[4 * k : 4 * k + 4], largest=LARGEST
        )

    feeds = [feed(stream, FIRST_T, first), feed(other, SECOND_T, second)]
    return (
        stream,
        encoder.with_second(Encoder.from_command(SECOND_T, second, largest=LARGEST)),
        feeds,
    )


TWO_ANGLES = [
    pytest.param(PAIR, two_encoders, id="pair"),
    pytest.param(PAIR, geared, id="geared pair"),
    pytest.param(MIRROR, two_encoders, id="mirror"),
    pytest.param(MIRROR, commanded, id="mirror by commands"),
]


@pytest.mark.parametrize("on_device", [False, True], ids=["take", "take_on_device"])
@pytest.mark.parametrize(("model", "make"), TWO_ANGLES)
def test_a_stream_of_two_angles_comes_out_as_its_recording_does(
    model: Model, make: Callable[[float], Fed], on_device: bool, device: str
) -> None:
    """Equal bit for bit, for packets of any size, while samples of both encoders come in turn."""
    stream, encoder, feeds = make(123.4)
    events = random_events(30_000)
    compensator = Compensator(model, stream, batch=6000, device=device)
    out: list[tuple[np.ndarray, np.ndarray]] = []

    def take(now: int) -> None:
        if on_device:
            found = [(p.events.to_host(), p.flags.numpy()) for p in compensator.take_on_device(now)]
        else:
            found = [(p.events, p.flags) for p in compensator.take(now)]
        out.extend((np.stack([e.x, e.y], axis=1), flags) for e, flags in found)

    start = 0
    for k in range(40):
        n = (1, 700, 63, 64, 65, 1500, 777)[k % 7]
        compensator.put(events[start : start + n], 0)
        start += n
        for feed in feeds:
            feed(k)
            take(0)
    assert sum(len(flags) for _, flags in out) > 10_000
    compensator.put(events[start:], 0)
    for _ in range(3):  # a GPU returns its last batches later
        take(0)
    xy, flags = (np.concatenate(column) for column in zip(*out, strict=True))
    np.testing.assert_array_equal(xy, compensate_events(events, model, encoder, device=device))
    inside = (xy >= -0.5).all(axis=1) & (xy < np.array([WIDTH, HEIGHT]) - 0.5).all(axis=1)
    np.testing.assert_array_equal(flags, np.where(inside, 0, OUTSIDE))
    assert np.linalg.norm(xy - np.stack([events.x, events.y], axis=1), axis=1).max() > 1.0
    image = compensator.image_on_device().numpy() if on_device else compensator.image()
    assert image.sum() == pytest.approx(inside.sum(), rel=0.02)


def test_a_packet_waits_for_both_encoders(device: str) -> None:
    """Angles that one of the encoders has not measured are marked, and no event is compensated without both."""
    events, (stream, encoder, _) = random_events(10_000), two_encoders(0.0)
    assert encoder.second is not None
    other = stream.second
    assert isinstance(other, EncoderStream)
    compensator = Compensator(PAIR, stream, wait_us=10_000, start_us=500_000, device=device)
    compensator.put(events, 0)
    stream.append(encoder.t, encoder.angle)
    assert compensator.take(499_999) == []  # the second encoder has sent nothing
    known = (encoder.second.t >= 20_000) & (encoder.second.t <= 60_000)
    other.append(encoder.second.t[known], encoder.second.angle[known])
    assert (stream.first, stream.last) == (
        int(encoder.second.t[known][0]) - 1300,
        int(encoder.second.t[known][-1]),
    )
    assert compensator.take(9_999) == []
    found, flags = joined(compensator.take(10_000) + compensator.flush())
    begin, end = (int(encoder.second.t[known][k]) for k in (0, -1))
    np.testing.assert_array_equal((flags & NO_ANGLE) > 0, events.t < begin - 1300)
    estimated = (events.t >= begin - 1300) & ((events.t < begin) | (events.t > end))
    np.testing.assert_array_equal((flags & EXTRAPOLATED) > 0, estimated)
    xy, expected = (
        np.stack([found.x, found.y], axis=1),
        compensate_events(events, PAIR, encoder, device=device),
    )
    sure = flags & (NO_ANGLE | EXTRAPOLATED) == 0
    assert sure.sum() > 3000
    np.testing.assert_array_equal(xy[sure], expected[sure])
    # Px; its speed is constant
    np.testing.assert_allclose(xy[estimated], expected[estimated], rtol=0, atol=2e-3)


@pytest.mark.parametrize("which", [0, 1])
def test_a_hole_in_the_samples_of_either_encoder_is_marked(which: int) -> None:
    events, (stream, encoder, _) = random_events(10_000), two_encoders(0.0)
    assert encoder.second is not None
    assert isinstance(stream.second, EncoderStream)
    for k, (into, samples) in enumerate(((stream, encoder), (stream.second, encoder.second))):
        kept = (
            (samples.t <= 30_000) | (samples.t >= 60_000)
            if k == which
            else np.ones(samples.t.size, bool)
        )
        into.append(samples.t[kept], samples.angle[kept])
    holed = (encoder, encoder.second)[which].t
    begin, end = holed[holed <= 30_000][-1], holed[holed >= 60_000][0]
    compensator = Compensator(PAIR, stream)
    compensator.put(events, 0)
    flags = joined(compensator.take(0))[1]
    np.testing.assert_array_equal((flags & EXTRAPOLATED) > 0, (events.t > begin) & (events.t < end))


def test_the_streams_encoders_must_suit_the_model() -> None:
    with pytest.raises(
        AmiwarpError,
        match=r"two prisms, .* of a stream, EncoderStream\(second=EncoderStream\(\)\) or",
    ):
        Compensator(MIRROR, EncoderStream())
    with pytest.raises(
        AmiwarpError, match="the model has one prism; use the model 'risley', or 'mirror'"
    ):
        Compensator(MODEL, EncoderStream(second=-0.5))


def test_samples_that_turn_out_to_be_on_another_clock_are_forgotten_on_the_device_too() -> None:
    """Samples are copied to the device ahead of the events."""
    t = np.arange(0, 200_000, 1000)
    encoder = EncoderStream()
    encoder.append(t, t * 1e-4)
    compensator = Compensator(MODEL, encoder)
    compensator.put(Events.from_arrays([30], [20], [5000], [1]), 0)
    compensator.take(0)
    encoder.clear()
    assert (len(encoder), encoder.first) == (0, None)
    encoder.append(t, t * 1e-4 + 2.0)
    compensator.put(Events.from_arrays([30], [20], [20_000], [1]), 0)
    [packet] = compensator.take(0)
    assert packet.flags.tolist() == [0]
    expected = MODEL.compensate_points(
        np.array([[30.0, 20.0]], np.float32), np.array([4.0], np.float32)
    )
    np.testing.assert_allclose([packet.events.x[0], packet.events.y[0]], expected[0], atol=1e-3)


def test_samples_of_both_encoders_are_forgotten() -> None:
    t = np.arange(0, 10_000, 1000)
    second = EncoderStream()
    encoder = EncoderStream(second=second)
    for each in (encoder, second):
        each.append(t, t * 1e-4)
    encoder.clear()
    assert (len(encoder), len(second)) == (0, 0)
    for each in (encoder, second):
        each.append(t, t * 1e-4 + 2.0)
    np.testing.assert_allclose(encoder.over(0, 9000).angles_at([5000])[0], 2.5)


def test_all_angles_count_as_guesses_while_the_clock_is_not_sure() -> None:
    encoder = EncoderStream()
    encoder.append([0, 1000, 2000], [0.0, 0.1, 0.2])
    assert encoder.knows(100, 1900)
    encoder.sure = False
    assert not encoder.knows(100, 1900)
    assert encoder.guessed(np.array([100, 1900])).tolist() == [True, True]
