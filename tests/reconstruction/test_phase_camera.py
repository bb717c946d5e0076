"""Pictures of a stream from parts of a turn, on simulated recordings whose scene is known."""

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from amiwarp import (
    AmiwarpError,
    Camera,
    EncoderStream,
    Events,
    ExactModel,
    LivePicture,
    PhaseCamera,
    PhaseRing,
    Prism,
    PrismMotion,
    Recording,
    RisleyModel,
    Scene,
    Simulation,
    phase_picture,
)

CAMERA = Camera.from_fov(200, 150, math.radians(50.0))
PRISM = Prism(math.radians(1.2))
PHASE = 2.0
MODEL = ExactModel(CAMERA, PRISM, PHASE)
TURN_US = 83_333
SECONDS = 0.4
PACKET_US = 3000
SPEED = 100.0
"""Speed of the square that moves [px/s]."""
LEFT = 30
TOP = 50
SIDE = 40


def simulated(picture: NDArray[np.uint8], rpm: float = 720.0, seed: int = 4) -> Simulation:
    motion = PrismMotion(rpm, PHASE)
    return Simulation(Scene.from_picture(picture), CAMERA, PRISM, SECONDS, motion, seed=seed)


@pytest.fixture(scope="module")
def simulation(texture: NDArray[np.uint8]) -> Simulation:
    return simulated(texture)


@pytest.fixture(scope="module")
def recording(simulation: Simulation) -> Recording:
    return simulation.run()


@pytest.fixture(scope="module")
def truth(simulation: Simulation) -> NDArray[np.float32]:
    return simulation.log_view()


@pytest.fixture(scope="module")
def with_square(recording: Recording, texture: NDArray[np.uint8]) -> Events:
    """A square of another scene moves to the right before the scene."""
    behind = recording.events[:]
    square = simulated(texture[::-1, ::-1].copy(), seed=5).run().events[:]
    shift = np.floor(SPEED * 1e-6 * behind.t)
    covered = (np.abs(behind.y - TOP - SIDE / 2) < SIDE / 2) & (behind.x >= LEFT + shift)
    covered &= behind.x < LEFT + SIDE + shift
    seen = (np.abs(square.y - TOP - SIDE / 2) < SIDE / 2) & (square.x >= LEFT)
    seen &= square.x < LEFT + SIDE
    moved = np.floor(SPEED * 1e-6 * square.t[seen]).astype(int)
    x = np.concatenate([behind.x[~covered], square.x[seen] + moved])
    y = np.concatenate([behind.y[~covered], square.y[seen]])
    t = np.concatenate([behind.t[~covered], square.t[seen]])
    p = np.concatenate([behind.p[~covered], square.p[seen]])
    order = np.argsort(t, kind="stable")
    return Events.from_arrays(x[order], y[order], t[order], p[order])


def encoder_of(recording: Recording) -> EncoderStream:
    assert recording.encoder is not None
    encoder = EncoderStream()
    encoder.append(recording.encoder.t, recording.encoder.angle)
    return encoder


def packets(events: Events, length_us: int) -> list[Events]:
    edges = np.searchsorted(events.t, np.arange(0, int(events.t[-1]) + length_us, length_us))
    return [events[start:stop] for start, stop in itertools.pairwise(edges)]


def pictures(camera: PhaseCamera, events: Events, length_us: int = PACKET_US) -> list[LivePicture]:
    out: list[LivePicture] = []
    for packet in packets(events, length_us):
        camera.put(packet, 0)
        out += camera.take(0)
    return out + camera.flush()


@pytest.fixture(scope="module")
def by_quarters(recording: Recording) -> list[LivePicture]:
    return pictures(PhaseCamera(MODEL, encoder_of(recording)), recording.events[:])


def correlation(
    a: NDArray[np.float32], b: NDArray[np.float32], where: NDArray[np.bool_] | None = None
) -> float:
    inner = np.zeros(a.shape, bool)
    inner[8:-8, 8:-8] = True
    if where is not None:
        inner &= where
    return float(np.corrcoef(a[inner], b[inner])[0, 1])


def detail(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    return picture - gaussian_filter(picture, 8.0)


def test_a_picture_after_each_quarter_of_a_turn(
    by_quarters: list[LivePicture], recording: Recording
) -> None:
    # A turn after a part of a bin, then every quarter.
    assert by_quarters[0].turns == 1.0
    assert {found.turns for found in by_quarters[1:]} == {0.25}
    ends = np.array([found.end_us for found in by_quarters])
    assert len(ends) == math.floor((SECONDS * 1e6 - ends[0]) / (TURN_US / 4)) + 1
    np.testing.assert_allclose(np.diff(ends), TURN_US / 4, rtol=0, atol=200)
    assert by_quarters[0].picture.length_us == pytest.approx(TURN_US, abs=200)
    for found in by_quarters:
        t = recording.events[:].t
        inside = (t >= found.picture.start_us) & (t < found.end_us)
        assert found.events == pytest.approx(inside.sum(), rel=0.01)


def test_pictures_look_like_the_truth(
    by_quarters: list[LivePicture], truth: NDArray[np.float32]
) -> None:
    for found in by_quarters:
        assert correlation(detail(found.picture.log), detail(truth)) > 0.97
    # At its start, the sensor's first events are not those of a scene at rest.
    for found in by_quarters[4:]:
        assert correlation(found.picture.log, truth) > 0.97
        assert found.moved.mean() < 0.06
    assert abs(float(np.median(by_quarters[-1].picture.log))) < 1e-4


def test_packets_of_any_size_give_the_same(
    by_quarters: list[LivePicture], recording: Recording
) -> None:
    again = pictures(PhaseCamera(MODEL, encoder_of(recording)), recording.events[:], 50_000)
    assert len(again) == len(by_quarters)
    for found, expected in zip(again, by_quarters, strict=True):
        np.testing.assert_array_equal(found.picture.log, expected.picture.log)
        np.testing.assert_array_equal(found.misfit, expected.misfit)


def test_a_prism_that_turns_backwards(
    texture: NDArray[np.uint8], truth: NDArray[np.float32]
) -> None:
    turned = simulated(texture, rpm=-720.0).run()
    found = pictures(PhaseCamera(MODEL, encoder_of(turned)), turned.events[:])
    assert correlation(detail(found[-1].picture.log), detail(truth)) > 0.97


def test_pictures_at_a_rate(recording: Recording) -> None:
    camera = PhaseCamera(MODEL, encoder_of(recording), rate_hz=40.0, turns=0.125)
    found = pictures(camera, recording.events[:])
    ends = np.array([one.end_us for one in found])
    np.testing.assert_allclose(np.diff(ends), 25_000, rtol=0, atol=2700)  # two bins
    assert ends[-1] - ends[0] == pytest.approx(25_000 * (len(ends) - 1), abs=2700)
    # all events since the picture before: 25 ms of 83
    assert all(0.25 < one.turns < 0.35 for one in found[1:])
    fast = pictures(
        PhaseCamera(MODEL, encoder_of(recording), rate_hz=300.0), recording.events[: 1 << 16]
    )
    assert {one.turns for one in fast[1:]} <= {0.25}


@pytest.mark.parametrize("rate_hz", [None, 40.0])
def test_a_picture_does_not_wait_for_more_events(
    recording: Recording, rate_hz: float | None
) -> None:
    """Packets are counted together, but for those that make a picture due."""
    camera = PhaseCamera(MODEL, encoder_of(recording), rate_hz=rate_hz)
    found = 0
    for packet in packets(recording.events[: 1 << 18], 170):
        camera.put(packet, 0)
        for picture in camera.take(0):
            found += 1
            # Up to a bin until its last event is followed by a later bin, and the packet
            assert 0 <= int(packet.t[-1]) - picture.end_us < TURN_US / 64 + 400
    assert found > 3


def test_of_pictures_that_are_ready_the_newest(recording: Recording) -> None:
    camera = PhaseCamera(MODEL, encoder_of(recording))
    events = recording.events[:]
    until = int(np.searchsorted(events.t, 250_000))
    camera.put(events[:until], 0)
    first = camera.take(0, newest=True)
    assert len(first) == 1
    assert 250_000 - TURN_US / 4 < first[0].end_us <= 250_000
    assert camera.skipped == 7  # those at 1.02, 1.27 … 2.52 turns
    camera.put(events[until:], 0)
    second = camera.take(0, newest=True)
    assert len(second) == 1
    # all events since the picture before, as much as a turn
    assert second[0].turns == 1.0


def test_after_the_prism_turned_back_a_whole_turn_is_awaited(recording: Recording) -> None:
    events = recording.events[:]
    encoder = EncoderStream()
    t = np.arange(0, 400_000, 1000)
    encoder.append(t, np.where(t < 150_000, t, 300_000 - t) * (math.tau / TURN_US))
    found = pictures(PhaseCamera(MODEL, encoder), events)
    assert [one.turns for one in found[:4]] == [1.0, 0.25, 0.25, 0.25]
    later = [one for one in found if one.end_us > 190_000]
    assert later[0].turns == 1.0
    # a quarter of a turn shows that it turned back
    assert later[0].end_us == pytest.approx(150_000 + 1.25 * TURN_US, abs=2 * PACKET_US)
    assert {one.turns for one in later[1:]} == {0.25}


def around_square(end_us: int, margin: int) -> NDArray[np.bool_]:
    """Return which pixels the square touched during the last turn, with a margin."""
    first = LEFT + SPEED * 1e-6 * (end_us - TURN_US)
    last = LEFT + SIDE + SPEED * 1e-6 * end_us
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    beside = (x < first - margin) | (x > last + margin)
    return ~(beside | (y < TOP - margin) | (y > TOP + SIDE + margin))


def test_what_moves_is_marked_and_the_rest_is_not_smeared(
    with_square: Events, recording: Recording, truth: NDArray[np.float32]
) -> None:
    encoder = encoder_of(recording)
    found = pictures(PhaseCamera(MODEL, encoder), with_square)[-4:]
    ring = PhaseRing(CAMERA.width, CAMERA.height, harmonics=7)
    ring.add(with_square, encoder.over(0, round(SECONDS * 1e6)))
    whole_turn = phase_picture(ring.sums(), MODEL)
    for one in found:
        rest = ~around_square(one.end_us, 14)
        assert one.moved[around_square(one.end_us, 0)].mean() > 0.4
        assert one.moved[rest].mean() < 0.1
        smeared = correlation(whole_turn, truth, rest)
        assert correlation(one.picture.log, truth, rest) > max(0.95, smeared)
        assert correlation(detail(one.picture.log), detail(truth), rest) > 0.97


def test_packets_wait_for_the_encoder(recording: Recording) -> None:
    assert recording.encoder is not None
    events = recording.events[:]
    encoder = EncoderStream()
    camera = PhaseCamera(MODEL, encoder, wait_us=10_000, start_us=20_000)
    camera.put(events[: 1 << 14], 0)
    assert camera.take(19_999) == []
    assert camera.left_out == 0
    t = recording.encoder.t
    half = int(np.searchsorted(t, 200_000))
    encoder.append(t[:half], recording.encoder.angle[:half])
    for packet in packets(events[1 << 14 :], PACKET_US):
        camera.put(packet, 30_000)
    before = camera.take(30_000)
    assert before[-1].end_us <= 200_000
    # after the longest wait the rest is extrapolated
    after = camera.take(40_000)
    assert after[-1].end_us > 380_000
    assert camera.left_out == 0


def test_events_without_an_angle_are_left_out(recording: Recording) -> None:
    events = recording.events[: 1 << 15]
    camera = PhaseCamera(MODEL, EncoderStream(), start_us=0)
    camera.put(events, 0)
    assert camera.take(0) == []
    assert camera.left_out == len(events)


def test_no_more_events_wait_than_allowed(recording: Recording) -> None:
    camera = PhaseCamera(MODEL, EncoderStream(), most_waiting=5000)
    for start in range(0, 10_000, 1000):
        camera.put(recording.events[start : start + 1000], 0)
    assert camera.waiting == 10_000
    assert camera.take(0) == []
    assert camera.waiting == 5000
    assert camera.left_out == 5000


def test_what_cannot_be_is_refused(recording: Recording) -> None:
    with pytest.raises(AmiwarpError, match="two prisms"):
        PhaseCamera(RisleyModel.from_prism(CAMERA, PRISM, 0.0), EncoderStream())
    with pytest.raises(AmiwarpError, match="turns"):
        PhaseCamera(MODEL, EncoderStream(), turns=0.0)
    with pytest.raises(AmiwarpError, match="rate_hz"):
        PhaseCamera(MODEL, EncoderStream(), rate_hz=0.0)
    camera = PhaseCamera(MODEL, EncoderStream())
    camera.put(Events.from_arrays([1], [1], [10], [1]), 0)
    with pytest.raises(AmiwarpError, match="sort the packets"):
        camera.put(Events.from_arrays([1], [1], [9], [1]), 0)
