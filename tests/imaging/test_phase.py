"""Sums of each pixel's events in phase with the optic, compared with sums by NumPy in float64."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from amiwarp import (
    AmiwarpError,
    DeviceEvents,
    Encoder,
    Events,
    PhaseSums,
    phase_sums,
    weighted_sums,
)
from amiwarp.imaging import phase
from amiwarp.imaging.phase_device import DeviceSums

WIDTH = 12
HEIGHT = 7


def some_events(count: int, seed: int = 0) -> tuple[Events, NDArray[np.float64]]:
    """Return events of random pixels and polarities, and their angles [rad]."""
    rng = np.random.default_rng(seed)
    x = rng.integers(0, WIDTH, count)
    y = rng.integers(0, HEIGHT, count)
    p = rng.integers(0, 2, count)
    t = np.arange(count)
    angles = rng.uniform(0.0, math.tau, count)
    return Events.from_arrays(x, y, t, p), angles


def expected_sums(
    events: Events, angles: NDArray[np.float64], harmonics: int, off_ratio: float, turns: float
) -> NDArray[np.complex128]:
    """Return the sums by their definition, at the angles themselves."""
    out = np.zeros((harmonics, HEIGHT, WIDTH), complex)
    weights = np.where(events.p > 0, 1.0, -off_ratio)
    for m in range(1, harmonics + 1):
        terms = weights * np.exp(-1j * m * angles) / (math.tau * turns)
        np.add.at(out[m - 1], (events.y, events.x), terms)
    return out


def integers_of(
    events: Events, angles: NDArray[np.float64], harmonics: int, bins: int, off_ratio: float
) -> NDArray[np.int32]:
    """Return the integers of each pixel: the rows of its events, and at changes of polarity further ones."""
    turn = np.rint(angles * (65536 / math.tau)).astype(np.int64) % 65536
    rows = events.p.astype(np.int64) * bins + turn * bins // 65536
    table = phase.angle_table(bins, harmonics, off_ratio)
    further = phase.extreme_table(table)
    out = np.zeros((HEIGHT, WIDTH, 3 + 2 * harmonics), np.int32)
    for y, x in np.ndindex(HEIGHT, WIDTH):
        here = rows[(events.y == y) & (events.x == x)]
        before = np.roll(here, 1)
        changed = (here < bins) != (before < bins)
        total = table[here].sum(axis=0) + (further[here] + further[before])[changed].sum(axis=0)
        out[y, x] = np.insert(total, 2, changed.sum())
    return out


def middles(angles: NDArray[np.float64], bins: int) -> NDArray[np.float64]:
    """Return the angle at the middle of the bin of each angle."""
    turn = np.rint(angles * (65536 / math.tau)).astype(np.int64) % 65536
    return (turn * bins // 65536 + 0.5) * (math.tau / bins)


@pytest.mark.parametrize("off_ratio", [1.0, 1.3])
@pytest.mark.parametrize(("harmonics", "bins"), [(1, 16), (4, 64), (9, 100)])
def test_sums_are_those_of_the_definition_at_the_middles_of_bins(
    harmonics: int, bins: int, off_ratio: float
) -> None:
    events, angles = some_events(3000)
    found = phase_sums(
        events,
        angles,
        WIDTH,
        HEIGHT,
        turns=2.0,
        direction=1,
        off_ratio=off_ratio,
        harmonics=harmonics,
        bins=bins,
        extremes=False,
    )
    expected = expected_sums(events, middles(angles, bins), harmonics, off_ratio, 2.0)
    order = np.arange(1, harmonics + 1)
    expected /= np.sinc(order / bins)[:, None, None]
    # The table has steps of 1/4096, of which a pixel adds about 36.
    np.testing.assert_allclose(found.values, expected, atol=4e-4)
    assert found.turns == 2.0
    assert found.off_ratio == off_ratio


def test_fine_bins_give_the_sums_of_the_angles_themselves() -> None:
    events, angles = some_events(3000, seed=1)
    found = phase_sums(
        events,
        angles,
        WIDTH,
        HEIGHT,
        harmonics=3,
        bins=1024,
        turns=1.0,
        direction=1,
        extremes=False,
    )
    expected = expected_sums(events, angles, 3, found.off_ratio, 1.0)
    np.testing.assert_allclose(found.values, expected, atol=0.02)


def test_a_brightness_that_swings_gives_its_own_coefficients() -> None:
    """A pixel whose log intensity is 10 cos(2θ + 0.3) thresholds has A_2 = 2i · 5 exp(0.3i), and no other sum."""
    theta = np.linspace(0.0, math.tau, 100_001)
    brightness = 10.0 * np.cos(2.0 * theta + 0.3)
    levels = np.floor(brightness + 0.5)
    steps = np.diff(levels)
    at = np.flatnonzero(steps)
    events = Events.from_arrays(
        np.zeros(len(at), int), np.zeros(len(at), int), at, (steps[at] > 0).astype(int)
    )
    found = phase_sums(events, theta[at], 1, 1, harmonics=4, bins=1024, extremes=False)
    values = found.values[:, 0, 0]
    assert values[1] == pytest.approx(2j * 5.0 * np.exp(0.3j), rel=0.01)
    assert np.abs(values[[0, 2]]).max() < 0.05
    assert found.strength[0, 0] == pytest.approx(10.0 / math.sqrt(2.0), rel=0.02)


def test_sums_change_their_sign_with_the_direction() -> None:
    """The same events in time, seen at falling angles: the brightness falls with the angle where it rises in time."""
    events, angles = some_events(500, seed=8)
    rising = np.sort(angles)
    forward = phase_sums(events, rising, WIDTH, HEIGHT)
    backward = phase_sums(events, rising, WIDTH, HEIGHT, direction=-1)
    np.testing.assert_array_equal(forward.values, -backward.values)
    mirrored = phase_sums(events, -rising, WIDTH, HEIGHT, bins=1024, extremes=False)
    as_forward = phase_sums(events, rising, WIDTH, HEIGHT, bins=1024, extremes=False)
    np.testing.assert_allclose(mirrored.values, -as_forward.values.conj(), atol=0.01)


def test_counts_and_ratio_of_thresholds() -> None:
    events = Events.from_arrays([1, 1, 1, 2, 2], [3, 3, 3, 4, 4], [0, 1, 2, 3, 4], [1, 1, 0, 1, 1])
    found = phase_sums(events, np.zeros(5), WIDTH, HEIGHT)
    assert found.on[3, 1] == 2
    assert found.off[3, 1] == 1
    assert found.events == 5
    assert found.off_ratio == 4.0
    assert found.threshold_ratio[3, 1] == 2.0
    assert np.isnan(found.threshold_ratio[4, 2])
    assert np.isnan(found.threshold_ratio[0, 0])


@pytest.mark.parametrize("extremes", [True, False])
@pytest.mark.parametrize("off_ratio", [1.25, None])
def test_sums_as_a_gpu_makes_them_are_the_same(off_ratio: float | None, *, extremes: bool) -> None:
    """A GPU orders events by pixels and weights the table itself; its kernels run on a CPU too."""
    there = DeviceSums(WIDTH, HEIGHT, 9, 64, "cpu", extremes=extremes)
    for seed, turns, direction in ((2, 1.0, 1), (3, 2.0, -1), (4, 2.0, -1)):
        events, angles = some_events(5000 - 1000 * seed, seed=seed)
        options = {"turns": turns, "direction": direction, "off_ratio": off_ratio}
        there.sum(events, angles, **options)
        found = phase.copied_sums(there)
        expected = phase_sums(events, angles, WIDTH, HEIGHT, extremes=extremes, **options)
        np.testing.assert_array_equal(found.values, expected.values)
        np.testing.assert_array_equal(found.on, expected.on)
        np.testing.assert_array_equal(found.off, expected.off)
        assert found.off_ratio == expected.off_ratio
        assert found.turns == turns
        if extremes:
            np.testing.assert_array_equal(found.changes, expected.changes)
        known = there.known.numpy()
        np.testing.assert_array_equal(known, (expected.on + expected.off) > 0)


def test_sums_on_a_device_follow_the_encoder() -> None:
    """The encoder is copied once: a later part of it, another one, and events that it does not cover."""
    there = DeviceSums(WIDTH, HEIGHT, 4, 64, "cpu", extremes=True)
    times = np.arange(0, 100_001, 1000)
    uneven = Encoder(times, 0.1 + 2e-4 * times + 0.3 * np.sin(times / 9000.0))
    even = Encoder.constant_speed(720.0, 0, 100_000)
    events, _ = some_events(4000, seed=5)
    spread = Events(events.x, events.y, 25 * events.t, events.p)
    for encoder, part in ((uneven, spread[:3000]), (uneven, spread[2500:]), (even, spread)):
        there.sum(part, encoder, turns=1.0, direction=1)
        expected = phase_sums(part, encoder, WIDTH, HEIGHT, turns=1.0, direction=1, harmonics=4)
        np.testing.assert_array_equal(phase.copied_sums(there).values, expected.values)
    late = Events(events.x, events.y, 26 * events.t, events.p)
    with pytest.raises(AmiwarpError, match="102000"):
        there.sum(late, even, turns=1.0, direction=1)


def with_extremes(events: Events) -> NDArray[np.float64]:
    """Return the weight of each event: more for each neighbour in time of the other polarity, around the turn."""
    weights = np.ones(len(events))
    for pixel in np.unique(events.y.astype(int) * WIDTH + events.x):
        mine = np.flatnonzero(events.y.astype(int) * WIDTH + events.x == pixel)
        polarity = events.p[mine]
        weights[mine] += phase.EXTREME * (polarity != np.roll(polarity, 1))
        weights[mine] += phase.EXTREME * (polarity != np.roll(polarity, -1))
    return weights


def test_extremes_add_to_the_events_before_and_after() -> None:
    events, angles = some_events(3000, seed=9)
    found = phase_sums(
        events, angles, WIDTH, HEIGHT, turns=1.0, direction=1, off_ratio=1.2, harmonics=4
    )
    weights = with_extremes(events)
    signed = np.where(events.p > 0, 1.0, -1.2) * weights
    order = np.arange(1, 5)
    expected = np.zeros((4, HEIGHT, WIDTH), complex)
    for k in range(4):
        terms = signed * np.exp(-1j * order[k] * middles(angles, 64)) / math.tau
        np.add.at(expected[k], (events.y, events.x), terms)
    expected /= np.sinc(order / 64)[:, None, None]
    np.testing.assert_allclose(found.values, expected, atol=1e-3)
    assert found.changes is not None
    changes = np.zeros((HEIGHT, WIDTH))
    np.add.at(changes, (events.y, events.x), (weights - 1.0) / (2.0 * phase.EXTREME))
    np.testing.assert_allclose(found.changes, changes, atol=1e-9)


@pytest.mark.parametrize("size", [1.5, 3.3, 8.7])
def test_swings_have_their_size_with_extremes(size: float) -> None:
    """A sensor fires a whole threshold after a turning point, so that plain sums of a swing are too small."""
    theta = np.linspace(0.0, math.tau, 4001)[:-1]
    found = {True: 0.0, False: 0.0}
    starts = np.linspace(-0.5, 0.5, 21)[:-1]
    for level in starts:
        at, signs = fired_at(size * np.cos(theta), level)
        events = Events.from_arrays(0 * at, 0 * at, at, (signs > 0).astype(int))
        for extremes in found:
            sums = phase_sums(
                events,
                theta[at],
                1,
                1,
                harmonics=1,
                bins=1024,
                turns=1.0,
                off_ratio=1.0,
                extremes=extremes,
            )
            found[extremes] += abs(sums.values[0, 0]) / len(starts)
    # A_1 of a cosine is half of its size; plain sums lose as much as the extremes add to a smooth swing.
    assert found[True] == pytest.approx(0.5 * size, rel=0.08)
    assert abs(found[True] - 0.5 * size) < 0.6 * abs(found[False] - 0.5 * size)


def fired_at(
    brightness: NDArray[np.float64], level: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return where a pixel fires in the second of two equal turns, and the signs of its events."""
    events = []
    for turn in (0, 1):
        for k, value in enumerate(brightness):
            while abs(value - level) >= 1.0:
                sign = 1 if value > level else -1
                level += sign
                if turn == 1:
                    events.append((k, sign))
    at, signs = np.array(events).T
    return at, signs


def test_random_events_have_the_expected_square() -> None:
    rng = np.random.default_rng(10)
    count = 40_000
    events = Events.from_arrays(
        rng.integers(0, WIDTH, count),
        rng.integers(0, HEIGHT, count),
        np.arange(count),
        rng.integers(0, 2, count),
    )
    angles = rng.uniform(0.0, math.tau, count)
    for extremes in (True, False):
        sums = phase_sums(
            events, angles, WIDTH, HEIGHT, turns=1.0, off_ratio=1.0, extremes=extremes
        )
        mean = (np.abs(sums.values) ** 2).mean()
        assert mean == pytest.approx(sums.random_square.mean(), rel=0.1)


def test_encoder_and_angles_give_the_same() -> None:
    events, _ = some_events(2000, seed=3)
    encoder = Encoder.constant_speed(30_000.0, 0, 2000, direction=-1)
    by_encoder = phase_sums(events, encoder, WIDTH, HEIGHT)
    by_angles = phase_sums(events, encoder.angle_at(events.t), WIDTH, HEIGHT)
    np.testing.assert_allclose(by_encoder.values, by_angles.values, atol=1e-3)
    # 30,000 turns a minute for 2 ms
    assert by_encoder.turns == by_angles.turns == 1.0


def test_turns_are_counted_up_to_whole_ones() -> None:
    events, _ = some_events(2000, seed=4)
    assert phase_sums(events, np.linspace(0.0, 4.9 * math.pi, 2000), WIDTH, HEIGHT).turns == 3.0
    assert phase_sums(events, np.linspace(0.0, -4.0 * math.pi, 2000), WIDTH, HEIGHT).turns == 2.0
    assert phase_sums(events, np.linspace(0.0, 0.1, 2000), WIDTH, HEIGHT).turns == 1.0


def test_without_events_all_is_zero() -> None:
    none = Events.from_arrays([], [], [], [])
    found = phase_sums(none, np.zeros(0), WIDTH, HEIGHT)
    assert not found.values.any()
    assert found.events == 0
    assert found.off_ratio == 1.0


def test_weighted_sums_are_the_mean() -> None:
    parts: list[PhaseSums] = []
    for seed in (5, 6):
        events, angles = some_events(1000, seed)
        parts.append(phase_sums(events, angles, WIDTH, HEIGHT, turns=1.0, off_ratio=1.0))
    found = weighted_sums(parts, [3.0, 1.0])
    np.testing.assert_allclose(
        found.values, 0.75 * parts[0].values + 0.25 * parts[1].values, atol=1e-6
    )
    assert found.turns == 2.0
    assert found.events == 2000
    np.testing.assert_array_equal(found.on, parts[0].on + parts[1].on)
    only = weighted_sums(parts, [0.0, 2.0])
    np.testing.assert_array_equal(only.values, parts[1].values)
    assert only.turns == 1.0


def test_events_in_device_memory_give_the_same() -> None:
    events, angles = some_events(1000, seed=7)
    on_device = DeviceEvents.from_arrays(events.x, events.y, events.t, events.p)
    found = phase_sums(on_device, angles, WIDTH, HEIGHT)
    expected = phase_sums(events, angles, WIDTH, HEIGHT)
    np.testing.assert_array_equal(found.values, expected.values)


def test_weighted_sums_have_the_noise_of_their_weights() -> None:
    events, angles = some_events(4000, seed=11)
    one = phase_sums(events, angles, WIDTH, HEIGHT, turns=1.0)
    equal = weighted_sums([one, one], [1.0, 1.0])
    np.testing.assert_allclose(equal.random_square, 0.5 * one.random_square, rtol=1e-5)
    nearly_one = weighted_sums([one, one], [99.0, 1.0])
    expected = (0.99**2 + 0.01**2) * one.random_square
    np.testing.assert_allclose(nearly_one.random_square, expected, rtol=1e-5)


def test_sums_with_and_without_extremes_are_not_mixed() -> None:
    events, angles = some_events(100, seed=12)
    with_them = phase_sums(events, angles, WIDTH, HEIGHT, turns=1.0)
    without = phase_sums(events, angles, WIDTH, HEIGHT, turns=1.0, extremes=False)
    with pytest.raises(AmiwarpError, match="some sums have extremes"):
        weighted_sums([with_them, without], [1.0, 1.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"harmonics": 0}, "harmonics"),
        ({"harmonics": 32}, "harmonics"),
        ({"bins": 2}, "bins"),
        ({"width": 5}, "outside"),
        ({"turns": 0.0}, "turns"),
        ({"off_ratio": 0.0}, "off_ratio"),
    ],
)
def test_bad_numbers_are_refused(changes: dict[str, float], message: str) -> None:
    events, angles = some_events(100)
    given = {"width": WIDTH, "height": HEIGHT, **changes}
    with pytest.raises(AmiwarpError, match=message):
        phase_sums(events, angles, **given)


def test_a_pixel_whose_sums_could_overflow_is_named() -> None:
    count = phase.MOST_EVENTS + 1
    same = np.zeros(count, np.uint16)
    events = Events(same + 2, same + 1, np.arange(count), np.ones(count, np.uint8))
    with pytest.raises(AmiwarpError, match=r"pixel \(2, 1\) has 262,144 events.*hot-pixels"):
        phase_sums(events, np.zeros(count), WIDTH, HEIGHT, off_ratio=1.0)


@pytest.mark.parametrize(
    ("weights", "message"),
    [([1.0], "1 weights"), ([0.0, 0.0], "all weights are 0"), ([1.0, -1.0], "weights")],
)
def test_bad_weights_are_refused(weights: list[float], message: str) -> None:
    events, angles = some_events(10)
    part = phase_sums(events, angles, WIDTH, HEIGHT)
    with pytest.raises(AmiwarpError, match=message):
        weighted_sums([part, part], weights)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(
    ("harmonics", "bins", "off_ratio"), [(1, 16, 1.0), (9, 64, 1.3), (4, 100, 10.0)]
)
def test_integers_give_the_sums_bit_for_bit(
    harmonics: int, bins: int, off_ratio: float, direction: int
) -> None:
    events, angles = some_events(4000, seed=9)
    settings = {"turns": 3.0, "off_ratio": off_ratio, "bins": bins, "direction": direction}
    integers = integers_of(events, angles, harmonics, bins, off_ratio)
    before = integers.copy()
    found = PhaseSums.from_integers(integers, **settings)
    expected = phase_sums(events, angles, WIDTH, HEIGHT, harmonics=harmonics, **settings)
    np.testing.assert_array_equal(found.values, expected.values)
    np.testing.assert_array_equal(found.on, expected.on)
    np.testing.assert_array_equal(found.off, expected.off)
    np.testing.assert_array_equal(found.changes, expected.changes)
    assert (found.turns, found.off_ratio) == (3.0, off_ratio)
    np.testing.assert_array_equal(integers, before)
    wide = PhaseSums.from_integers(integers.astype(np.int64), **settings)
    np.testing.assert_array_equal(wide.values, found.values)


def test_integers_that_events_cannot_have_given_are_refused() -> None:
    events, angles = some_events(4000, seed=10)
    integers = integers_of(events, angles, 3, 64, 2.0)

    def refuse(changed: NDArray[np.generic], message: str, **more: float) -> None:
        settings = {"turns": 1.0, "off_ratio": 2.0, **more}
        with pytest.raises(AmiwarpError, match=message):
            PhaseSums.from_integers(changed, **settings)

    refuse(integers[0], r"shape \(12, 9\)")
    refuse(integers[:, :, :-1], r"shape \(7, 12, 8\)")
    refuse(integers[:, :, :3], r"shape \(7, 12, 3\)")
    refuse(integers, "at most 2 harmonics for 6 bins", bins=6)
    refuse(integers.astype(np.float32), "expected numbers")
    refuse(integers.byteswap(), r"pixel \(0, 0\)")
    # at a single angle all cosines are as large as they can be
    one_angle = integers_of(events, np.zeros(4000), 3, 64, 2.0)
    refuse(one_angle, "off_ratio may not be 0.5", off_ratio=0.5)
    refuse(integers, "turns", turns=0.0)
    refuse(integers, "direction is 0", direction=0)

    for column, value, message in [
        (0, -1, r"pixel \(5, 2\), -1, .*negative"),
        (1, -1, r"pixel \(5, 2\), .*negative"),
        (0, 32767, r"pixel \(5, 2\), 32767.*may have lost some"),
        (1, 32767, "may have lost some"),
        (2, -2, "number of changes"),
        (2, 65000, "number of changes"),
        (2, int(integers[2, 5, 2]) - 1, "number of changes"),
        (3, 1 << 20, "sums that its events cannot give"),
        (8, -(1 << 20), "sums that its events cannot give"),
    ]:
        changed = integers.copy()
        changed[2, 5, column] = value
        refuse(changed, message)
    only_off = Events(events.x, events.y, events.t, np.zeros_like(events.p))
    as_large = integers_of(only_off, np.zeros(4000), 3, 64, 2.0)
    assert PhaseSums.from_integers(as_large, turns=1.0, off_ratio=2.0).events == 4000
    refuse(as_large[:, :, [1, 0, *range(2, 9)]], "its events cannot give")
    # ON at 0 and OFF at half a turn, in turns: no events give larger sums
    polarity = np.arange(4000) % 2
    same = np.zeros(4000, int)
    alternating = Events.from_arrays(same, same, np.arange(4000), polarity)
    largest = integers_of(alternating, np.where(polarity, 0.0, math.pi), 1, 64, 2.0)
    found = PhaseSums.from_integers(largest, turns=1.0, off_ratio=2.0)
    assert found.changes is not None
    assert found.changes[0, 0] == 4000
    few_off = largest.copy()
    few_off[0, 0, 0] = 1
    refuse(few_off, "number of changes")

    nearly_full = integers.copy()
    nearly_full[2, 5, :2] = 32766
    assert PhaseSums.from_integers(nearly_full, turns=1.0, off_ratio=2.0).on[2, 5] == 32766
