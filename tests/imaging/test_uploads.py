"""Events on a device: angles against the encoder in float64, and folding, which keeps the number of events."""

import math

import numpy as np
import pytest

from amiwarp import AmiwarpError, Camera, Encoder, Events, ExactModel, Prism
from amiwarp.calib.calibration_events import CalibrationEvents
from amiwarp.imaging import CanvasShape, Votes, upload_events
from amiwarp.imaging.uploaded_events import LARGEST_WEIGHT, TURNS


def still_scene(n: int, points: int = 200, seed: int = 0) -> Events:
    """Events of a few pixels that repeat every turn. The last pixel fires far too often."""
    rng = np.random.default_rng(seed)
    which = rng.integers(0, points, n)
    which[: n // 4] = points - 1
    t = np.sort(rng.integers(0, 250_000, n))
    return Events.from_arrays(which % 64, which // 64, t, which % 2)


def test_angles_are_the_encoder_s(device: str) -> None:
    t = np.cumsum(np.random.default_rng(1).integers(500, 1500, 300)) + 1_700_000_000_000_000
    encoder = Encoder.from_angles(t, 0.04 * np.arange(300) ** 1.1, clock_offset_us=12.25)
    events = Events.from_arrays(
        [1] * 1000, [2] * 1000, np.linspace(t[0], t[-1] - 20, 1000).astype(np.int64), [1] * 1000
    )
    turn = upload_events(events, encoder, device).arrays.turn.numpy()[:1000]
    expected = encoder.angle_at(events.t) * (TURNS / (2.0 * math.pi))
    error = (turn - expected + TURNS / 2) % TURNS - TURNS / 2
    assert np.abs(error).max() < 0.5 + 1e-3


def test_other_angles_leave_the_other_columns_alone(device: str) -> None:
    events, rng = still_scene(1000), np.random.default_rng(2)
    angles, others = rng.uniform(-20.0, 20.0, (2, 1000))
    first = upload_events(events, angles, device)
    found, expected = first.at_angles(others), upload_events(events, others, device)
    assert found.arrays.x.ptr == first.arrays.x.ptr
    for name in ("x", "y", "layer", "turn"):
        np.testing.assert_array_equal(
            getattr(found.arrays, name).numpy(), getattr(expected.arrays, name).numpy()
        )
    turns = angles * (TURNS / (2.0 * math.pi))
    np.testing.assert_array_equal(
        first.arrays.turn.numpy()[:1000], np.rint(turns).astype(np.int64) % TURNS
    )


@pytest.mark.parametrize("middle_us", [None, 100_000])
@pytest.mark.parametrize("drifts", [False, True])
def test_every_third_event_as_if_uploaded_alone(
    drifts: bool, middle_us: int | None, device: str
) -> None:
    t = np.cumsum(np.random.default_rng(1).integers(500, 1500, 300))
    encoder = Encoder.from_angles(t, 0.04 * np.arange(300) ** 1.1, clock_offset_us=12.25)
    events = still_scene(20_000)
    events = events[np.searchsorted(events.t, 2000) :]
    everything = CalibrationEvents(
        events, encoder, (lambda at: encoder.speed_at(at) * 1e-6) if drifts else None
    )
    everything.on(device, middle_us)
    found = everything.every(3).on(device, middle_us)
    expected = CalibrationEvents(events[::3], encoder, everything.slope_of).on(device, middle_us)
    n = found.count
    assert found.total == n == expected.count
    for name in ("x", "y", "layer", "turn", "time"):
        one, other = (getattr(of.arrays, name).numpy()[:n] for of in (found, expected))
        np.testing.assert_array_equal(one, other)
    if drifts:
        np.testing.assert_array_equal(found.slope.numpy()[:n], expected.slope.numpy()[:n])
        found.drift(300.0)
        assert np.any(found.arrays.turn.numpy() != expected.arrays.turn.numpy())
        np.testing.assert_array_equal(found.base.numpy(), expected.base.numpy())


def test_uncovered_events_are_refused(device: str) -> None:
    encoder = Encoder.constant_speed(720.0, 0, 100_000)
    with pytest.raises(AmiwarpError, match="outside the encoder"):
        upload_events(still_scene(100), encoder, device)


@pytest.mark.parametrize("per_polarity", [False, True])
def test_folding_by_the_finest_bins_changes_nothing(per_polarity: bool, device: str) -> None:
    events, encoder = still_scene(20_000), Encoder.constant_speed(720.0, 0, 250_000)
    model = ExactModel(Camera.from_fov(64, 48, math.radians(60)), Prism(math.radians(2)), 0.4)
    images = []
    for fold in (0, TURNS):
        votes = Votes(CanvasShape(64, 48, 4, per_polarity=per_polarity), device)
        votes.add_events(model, upload_events(events, encoder, device, fold=fold))
        images.append(votes.take())
    np.testing.assert_array_equal(*images)


def test_points_stand_for_all_events_of_their_bin(device: str) -> None:
    events, encoder = still_scene(20_000), Encoder.constant_speed(720.0, 0, 250_000)
    folded = upload_events(events, encoder, device, fold=64)
    weight = folded.arrays.weight.numpy()[: folded.count].astype(int)
    assert weight.sum() == len(events)
    # The pixel that fires too often has several points of largest weight
    assert weight.max() == LARGEST_WEIGHT
    x, y = (a.numpy()[: folded.count].astype(int) for a in (folded.arrays.x, folded.arrays.y))
    expected = np.bincount(events.y.astype(int) * 64 + events.x, minlength=64 * 48)
    np.testing.assert_array_equal(np.bincount(y * 64 + x, weight, minlength=64 * 48), expected)
    middle = folded.arrays.turn.numpy()[: folded.count] % (TURNS // 64)
    assert (middle == TURNS // 128).all()


@pytest.mark.parametrize("fold", [-1, TURNS + 1])
def test_senseless_bins_are_refused(fold: int) -> None:
    with pytest.raises(AmiwarpError, match="angles a turn"):
        upload_events(still_scene(100), Encoder.constant_speed(720.0, 0, 250_000), "cpu", fold=fold)
