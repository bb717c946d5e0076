"""Sums in phase of the last turns of a stream and of parts of a turn, compared with whole turns and least squares."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from amiwarp import AmiwarpError, Encoder, Events, PhaseRing, PhaseSums, phase_sums, weighted_sums

WIDTH = 12
HEIGHT = 7
BINS = 64
TURN_US = 50_000


def some_stream(
    turns: float, seed: int = 0, per_turn: int = 3000
) -> tuple[Events, NDArray[np.float64]]:
    """Return events of random pixels over some turns from the angle 0.4 on, and their angles [rad]."""
    rng = np.random.default_rng(seed)
    count = round(turns * per_turn)
    t = np.sort(rng.integers(0, round(turns * TURN_US), count))
    x = rng.integers(0, WIDTH, count)
    y = rng.integers(0, HEIGHT, count)
    p = rng.integers(0, 2, count)
    return Events.from_arrays(x, y, t, p), 0.4 + t * (math.tau / TURN_US)


def filled(turns: float, *, direction: int = 1, kept: int = 1, harmonics: int = 4) -> PhaseRing:
    events, angles = some_stream(turns)
    ring = PhaseRing(WIDTH, HEIGHT, harmonics=harmonics, turns=kept)
    ring.add(events, direction * angles)
    return ring


def events_of(
    brightness: NDArray[np.float64], theta: NDArray[np.float64]
) -> tuple[Events, NDArray[np.float64]]:
    """Return the events of one pixel that sees a brightness [thresholds], and their angles."""
    steps = np.diff(np.floor(brightness + 0.5)).astype(int)
    at = np.repeat(np.arange(len(steps)), np.abs(steps))
    zeros = np.zeros(len(at), int)
    return Events.from_arrays(zeros, zeros, at, steps[at] > 0), theta[at]


@pytest.mark.parametrize("direction", [1, -1])
def test_the_last_turn_has_the_sums_of_its_events(direction: int) -> None:
    events, angles = some_stream(2.6)
    ring = PhaseRing(WIDTH, HEIGHT, harmonics=4, extremes=False)
    ring.add(events, direction * angles)
    assert ring.direction == direction
    assert ring.turns == 1.0
    bins = np.floor(angles * (BINS / math.tau)).astype(int)
    newest = bins[-1]
    assert ring.newest == newest
    last = (bins >= newest - BINS) & (bins < newest)
    chosen = Events(events.x[last], events.y[last], events.t[last], events.p[last])
    expected = phase_sums(
        chosen,
        direction * angles[last],
        WIDTH,
        HEIGHT,
        turns=1.0,
        direction=direction,
        harmonics=4,
        extremes=False,
    )
    found = ring.sums()
    # There, an event within 1/65536 turn of an edge may be in the other bin.
    np.testing.assert_allclose(found.values, expected.values, rtol=0, atol=0.07)
    assert np.abs(found.values - expected.values).mean() < 1e-3
    np.testing.assert_array_equal(found.on, expected.on)
    np.testing.assert_array_equal(found.off, expected.off)
    assert found.off_ratio == expected.off_ratio
    assert found.turns == 1.0
    assert ring.span_us(BINS)[0] == chosen.t[0]


def test_packets_of_any_size_give_the_same() -> None:
    events, angles = some_stream(1.7)
    ring = PhaseRing(WIDTH, HEIGHT, harmonics=4)
    for start in range(0, len(events), 37):
        ring.add(events[start : start + 37], angles[start : start + 37])
    at_once = filled(1.7)
    np.testing.assert_array_equal(ring.sums().values, at_once.sums().values)
    assert ring.span_us(16) == at_once.span_us(16)


@pytest.mark.parametrize("direction", [1, -1])
def test_encoder_and_angles_give_the_same(direction: int) -> None:
    events, _ = some_stream(1.7)
    encoder = Encoder.constant_speed(1200.0, 0, 2 * TURN_US, direction=direction)
    by_encoder = PhaseRing(WIDTH, HEIGHT, harmonics=4)
    for start in range(0, len(events), 500):
        by_encoder.add(events[start : start + 500], encoder)
    by_angles = PhaseRing(WIDTH, HEIGHT, harmonics=4)
    by_angles.add(events, encoder.angle_at(events.t))
    np.testing.assert_array_equal(by_encoder.sums().values, by_angles.sums().values)


def test_uneven_speed_is_followed_between_the_samples_of_an_encoder() -> None:
    events, _ = some_stream(1.7)
    t = np.arange(0, 2 * TURN_US, 700)
    angle = t * (math.tau / TURN_US) + 0.5 * np.sin(t * (2.0 * math.tau / TURN_US))
    encoder = Encoder.from_angles(t, angle)
    by_encoder = PhaseRing(WIDTH, HEIGHT, harmonics=4)
    by_encoder.add(events, encoder)
    by_angles = PhaseRing(WIDTH, HEIGHT, harmonics=4)
    by_angles.add(events, encoder.angle_at(events.t))
    np.testing.assert_array_equal(by_encoder.sums().values, by_angles.sums().values)


def test_weights_of_turns() -> None:
    """Each turn alone is the newest one of a ring that got no later events."""
    events, angles = some_stream(3.0)
    on = Events(events.x, events.y, events.t, np.ones_like(events.p))
    ring = PhaseRing(WIDTH, HEIGHT, harmonics=4, turns=2)
    ring.add(on, angles)
    newest = ring.sums()
    before = PhaseRing(WIDTH, HEIGHT, harmonics=4)
    until = int(np.searchsorted(angles, (ring.newest - BINS) * (math.tau / BINS)))
    before.add(on[: until + 1], angles[: until + 1])
    older = before.sums()
    found = ring.sums(2.0, weights=[1.0, 0.25])
    expected = weighted_sums([newest, older], [1.0, 0.25])
    np.testing.assert_allclose(found.values, expected.values, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(found.on, expected.on)
    assert found.turns == 2.0
    equal = weighted_sums([newest, older], [1.0, 1.0])
    np.testing.assert_allclose(ring.sums(2.0).values, equal.values, rtol=0, atol=1e-5)


def by_least_squares(
    counts: NDArray[np.float64],
    numbers: NDArray[np.int64],
    prior: NDArray[np.complex128],
    weight: float,
) -> NDArray[np.complex128]:
    """Return the sums of a pixel by least squares over real numbers: a constant, cosines and sines.

    The events of bins are ``counts``; the brightness changes by the sum of A_m exp(i m θ), averaged over each bin.
    """
    harmonics = len(prior)
    order = np.arange(1, harmonics + 1)
    attenuation = np.sinc(order / BINS)
    angles = (numbers + 0.5) * (math.tau / BINS)
    waves = np.outer(angles, order)
    columns = [np.ones((len(angles), 1)), 2.0 * np.cos(waves), -2.0 * np.sin(waves)]
    design = np.hstack(columns) / math.sqrt(BINS)
    seen = counts * (BINS / math.tau) / math.sqrt(BINS)
    # |A_-m|² = |A_m|², so real and imaginary part of each harmonic count twice
    strength = np.sqrt(weight * np.concatenate([[1.0], np.full(2 * harmonics, 2.0)]))
    expected = np.concatenate([[0.0], attenuation * prior.real, attenuation * prior.imag])
    rows = np.vstack([design, np.diag(strength)])
    found, *_ = np.linalg.lstsq(rows, np.concatenate([seen, strength * expected]), rcond=None)
    return (found[1 : harmonics + 1] + 1j * found[harmonics + 1 :]) / attenuation


@pytest.mark.parametrize("turns", [10 / BINS, 0.25, 0.5, 0.75, 1.0])
@pytest.mark.parametrize("weight", [0.02, 0.7])
def test_a_part_of_a_turn_is_solved_by_least_squares(turns: float, weight: float) -> None:
    events, angles = some_stream(1.9, seed=3)
    ring = PhaseRing(WIDTH, HEIGHT, harmonics=4, extremes=False)
    ring.add(events, angles)
    rng = np.random.default_rng(1)
    values = rng.normal(size=(2, 4, HEIGHT, WIDTH))
    sums = ring.sums()
    prior = PhaseSums(
        (values[0] + 1j * values[1]).astype(np.complex64), sums.on, sums.off, 1.0, 1.0
    )
    update = ring.update(prior, turns, weight_of_prior=weight)
    bins = np.floor(angles * (BINS / math.tau)).astype(int)
    numbers = np.arange(ring.newest - round(turns * BINS), ring.newest)
    here = (events.x == 5) & (events.y == 2)
    counts = np.zeros(len(numbers))
    for number, p in zip(bins[here], events.p[here], strict=True):
        if numbers[0] <= number <= numbers[-1]:
            counts[number - numbers[0]] += 1.0 if p else -sums.off_ratio
    expected = by_least_squares(counts, numbers, prior.values[:, 2, 5].astype(complex), weight)
    np.testing.assert_allclose(update.sums.values[:, 2, 5], expected, rtol=0, atol=2e-4)
    nothing = np.zeros(4, complex)
    alone = by_least_squares(counts, numbers, nothing, weight)
    assert update.size[2, 5] == pytest.approx((np.abs(alone) ** 2).sum(), rel=1e-3)
    change = np.abs(update.sums.values - prior.values) ** 2
    np.testing.assert_allclose(update.change, change.sum(axis=0), rtol=1e-3, atol=1e-4)
    assert update.sums.turns == turns
    assert update.sums.events == np.isin(bins, numbers).sum()


@pytest.mark.parametrize("direction", [1, -1])
def test_a_turn_has_the_extremes_of_its_events(direction: int) -> None:
    """If no bin has both polarities, the sums are those of the events in their order, the last before the first."""
    events, angles = some_stream(2.6, per_turn=600)
    bins = np.floor(angles * (BINS / math.tau)).astype(int)
    # one event of a pixel in a bin
    places = (events.y.astype(int) * WIDTH + events.x) * 1000 + bins
    kept = np.sort(np.unique(places, return_index=True)[1])
    events = Events(events.x[kept], events.y[kept], events.t[kept], events.p[kept])
    angles = angles[kept]
    bins = bins[kept]
    ring = PhaseRing(WIDTH, HEIGHT, harmonics=4)
    ring.add(events, direction * angles)
    last = (bins >= bins[-1] - BINS) & (bins < bins[-1])
    chosen = Events(events.x[last], events.y[last], events.t[last], events.p[last])
    expected = phase_sums(
        chosen,
        direction * angles[last],
        WIDTH,
        HEIGHT,
        turns=1.0,
        direction=direction,
        harmonics=4,
    )
    found = ring.sums()
    assert expected.changes is not None
    assert found.changes is not None
    assert expected.changes.sum() > 50
    np.testing.assert_array_equal(found.changes, expected.changes)
    assert np.abs(found.values - expected.values).mean() < 2e-3
    # Two turns, each closed
    long = PhaseRing(WIDTH, HEIGHT, harmonics=4, turns=2)
    long.add(events, direction * angles)
    newest = long.sums(2.0, weights=[1.0, 0.0])
    np.testing.assert_allclose(newest.values, found.values, rtol=0, atol=1e-5)


def test_a_part_of_a_turn_has_the_extremes_within_it() -> None:
    """An event before the part tells whether its first event follows an extreme, unless it is long ago."""
    # Bins of ON and OFF events of each pixel; the part are the bins 64 to 79
    cases: list[tuple[list[tuple[int, int]], dict[int, float]]] = [
        ([(60, 1), (66, 0), (70, 1), (70, 1)], {66: -1.8, 70: 2.4}),
        ([(60, 0), (66, 0), (70, 1)], {66: -1.4, 70: 1.4}),
        ([(40, 1), (66, 0), (75, 0)], {66: -1.0, 75: -1.0}),
        ([(60, 1), (66, 1), (66, 0), (72, 0)], {66: 0.0, 72: -1.0}),
        ([(66, 1), (66, 0), (72, 1)], {66: -0.4, 72: 1.4}),
        ([(48, 1), (66, 0)], {66: -1.4}),
        ([(47, 1), (66, 0)], {66: -1.0}),
        ([(65, 0), (66, 1), (66, 0)], {65: -1.0, 66: 0.0}),
    ]
    first = [(x, 0, (0.5, 1)) for x in range(len(cases))]
    given = [(x, 0, event) for x, (own, _) in enumerate(cases) for event in own]
    given += [(len(cases), 0, (place, 1)) for place in (20.0, 21.0, 22.0, 80.0)]
    order = sorted(first + given, key=lambda one: one[2][0])
    x, y = ([one[k] for one in order] for k in range(2))
    angles = (np.array([one[2][0] for one in order]) + 0.5) * (math.tau / BINS)
    p = [one[2][1] for one in order]
    ring = PhaseRing(len(cases) + 1, 1, harmonics=3)
    ring.add(Events.from_arrays(x, y, np.arange(len(x)), p), angles)
    nothing = np.zeros((3, 1, len(cases) + 1))
    empty = np.zeros((1, len(cases) + 1), int)
    prior = PhaseSums(nothing.astype(np.complex64), empty, empty, 1.0, 1.0)
    update = ring.update(prior, 0.25)
    ratio = update.sums.off_ratio
    numbers = np.arange(ring.newest - 16, ring.newest)
    assert numbers[0] == 64
    assert ratio > 1.2
    for k, (_, weights) in enumerate(cases):
        counts = np.zeros(16)
        for number, weight in weights.items():
            counts[number - 64] = weight if weight > 0.0 else ratio * weight
        if 66 in weights and weights[66] in (0.0, -0.4):
            # Both polarities in one bin, and what its extremes add
            counts[2] = (1.4 - 1.4 * ratio) + ratio * weights[66]
        expected = by_least_squares(counts, numbers, np.zeros(3, complex), 0.3)
        np.testing.assert_allclose(update.sums.values[:, 0, k], expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("turns", [0.25, 0.5, 0.75])
def test_known_brightness_is_found_from_parts_of_a_turn(turns: float, direction: int) -> None:
    """The brightness 30 cos(2θ + 0.3) + 20 cos(θ) becomes 1.2 times as much; parts of a turn tell so, one by one."""
    theta = np.linspace(0.0, 4.0 * math.tau, 400_001)
    brightness = 30.0 * np.cos(2.0 * theta + direction * 0.3) + 20.0 * np.cos(theta)
    brightness[theta > math.tau * 1.5] *= 1.2
    events, angles = events_of(brightness, theta)
    ring = PhaseRing(1, 1, harmonics=3)
    found: PhaseSums | None = None
    for part in ring.split(events, direction * angles):
        ring.add_part(part)
        if ring.bins < BINS or ring.newest % round(turns * BINS):
            continue
        found = ring.sums() if found is None else ring.update(found, turns).sums
    assert found is not None
    expected = 1.2 * np.array([10.0j, 30.0j * np.exp(0.3j), 0.0])
    np.testing.assert_allclose(found.values[:, 0, 0], expected, rtol=0, atol=2.5)
    still = ring.update(found, turns).change[0, 0]
    assert still < 0.01 * (np.abs(expected) ** 2).sum()


@pytest.mark.parametrize("extremes", [False, True])
def test_noise_is_what_an_event_at_a_random_angle_adds(extremes: bool) -> None:
    rng = np.random.default_rng(4)
    count = 5000
    theta = np.sort(rng.uniform(0.0, 1.5 * math.tau, count))
    zeros = np.zeros(count, int)
    p = rng.integers(0, 2, count)
    ring = PhaseRing(400, 1, harmonics=3, extremes=extremes)
    ring.add(Events.from_arrays(rng.integers(0, 400, count), zeros, np.arange(count), p), theta)
    nothing = PhaseSums(np.zeros((3, 1, 400), np.complex64), zeros, zeros, 1.0, 1.0)
    update = ring.update(nothing, 0.5)
    # of the squares of single events, as random_square has them
    expected = update.noise * (math.tau * update.sums.turns) ** 2 * update.sums.random_square
    found = float(update.size.sum())
    if extremes:
        # Events beside an extreme are near each other, so that some of what they add cancels
        assert update.noise * update.sums.events < found < expected.sum()
    else:
        assert found == pytest.approx(expected.sum(), rel=0.1)
    np.testing.assert_allclose(update.size, update.change, rtol=1e-5)


def test_counts_stop_at_255() -> None:
    """300 ON and 70 OFF events of one pixel in one bin, between events that begin and end a turn."""
    angles = np.concatenate([[-0.2, -0.01], np.full(370, 0.01), [0.2, math.tau - 0.01]])
    p = np.concatenate([[1, 1], np.ones(300, int), np.zeros(70, int), [1, 1]])
    zeros = np.zeros(len(angles), int)
    ring = PhaseRing(1, 1, harmonics=1)
    ring.add(Events.from_arrays(zeros, zeros, np.arange(len(angles)), p), angles)
    found = ring.sums()
    assert found.on[0, 0] == 1 + 255 + 1
    assert found.off[0, 0] == 70


def test_before_the_optic_moves_there_is_nothing() -> None:
    events, _ = some_stream(0.5)
    ring = PhaseRing(WIDTH, HEIGHT)
    ring.add(events, np.full(len(events), 0.3))
    assert ring.turns == 0.0
    assert ring.direction == 0
    with pytest.raises(AmiwarpError, match="holds 0 turns"):
        ring.sums()


def test_an_optic_that_turns_back_starts_anew() -> None:
    events, angles = some_stream(1.5)
    ring = filled(1.5)
    later = Events(events.x, events.y, events.t + 2 * TURN_US, events.p)
    # jitter of the encoder does not
    ring.add(later[:2], np.array([angles[-1] - 0.5, angles[-1] + 0.001]))
    assert ring.turns == 1.0
    ring.add(later[2:], angles[-1] - angles[2:])
    assert ring.direction == -1
    assert ring.turns == 1.0
    again = PhaseRing(WIDTH, HEIGHT, harmonics=4)
    again.add(later[2:], angles[-1] - angles[2:])
    np.testing.assert_array_equal(ring.sums().values, again.sums().values)


def test_after_a_gap_of_a_turn_the_ring_starts_anew() -> None:
    events, angles = some_stream(1.5)
    ring = filled(1.5)
    later = Events(events.x, events.y, events.t + 9 * TURN_US, events.p)
    ring.add(later[:20], angles[:20] + 3.0 * math.tau)
    assert ring.turns == 0.0
    ring.add(later[20:], angles[20:] + 3.0 * math.tau)
    again = PhaseRing(WIDTH, HEIGHT, harmonics=4)
    again.add(later, angles + 3.0 * math.tau)
    np.testing.assert_array_equal(ring.sums().values, again.sums().values)


def test_bins_without_events_hold_none_of_an_earlier_turn() -> None:
    """Half a turn in the dark: its bins are empty, not those of the turn before."""
    events, angles = some_stream(2.5)
    dark = (angles > 1.2 * math.tau) & (angles < 1.7 * math.tau)
    light = Events(events.x[~dark], events.y[~dark], events.t[~dark], events.p[~dark])
    ring = PhaseRing(WIDTH, HEIGHT, harmonics=4)
    until = int(np.searchsorted(angles[~dark], 1.75 * math.tau))
    ring.add(light[:until], angles[~dark][:until])
    found = ring.sums()
    span = np.array([ring.newest - BINS, ring.newest]) * (math.tau / BINS)
    inside = (angles[~dark] >= span[0]) & (angles[~dark] < span[1])
    assert found.events == inside.sum()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda ring: ring.sums(1.5), "whole number"),
        (lambda ring: ring.sums(3.0), "turns"),
        (lambda ring: ring.sums(0.001), "turns"),
        (lambda ring: ring.sums(2.0, weights=[1.0]), "one for each"),
        (lambda ring: ring.sums(2.0, weights=[0.0, 0.0]), "all weights are 0"),
        (lambda ring: ring.sums(2.0, weights=[1.0, -1.0]), "weights"),
        (lambda ring: ring.update(ring.sums(), 1.1), "turns"),
        (lambda ring: ring.update(ring.sums(), 0.5, weight_of_prior=0.0), "weight_of_prior"),
        (lambda ring: ring.update(filled(1.5, harmonics=3).sums(), 0.5), "prior"),
        (lambda ring: ring.add(some_stream(1.0)[0], np.zeros(3)), "angles"),
        (lambda ring: PhaseRing(4, 3, harmonics=32), "harmonics"),
        (lambda ring: PhaseRing(4, 3, turns=17), "turns"),
    ],
)
def test_unusable_values_are_refused(call: object, message: str) -> None:
    ring = filled(2.5, kept=2)
    assert callable(call)
    with pytest.raises(AmiwarpError, match=message):
        call(ring)


def test_events_outside_the_sensor_are_refused() -> None:
    ring = PhaseRing(4, 3)
    with pytest.raises(AmiwarpError, match="outside"):
        ring.add(Events.from_arrays([4, 0], [0, 0], [0, 1], [1, 1]), np.array([0.0, 1.0]))
