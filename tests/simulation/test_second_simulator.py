"""The second simulator: optic, pixels, delays, and a calibration of its events."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from amiwarp import Camera, Encoder, MemoryEvents, Prism, Recording, calibrate
from benchmarks import true_optics
from reference import optics as oracle
from reference.second_simulator import (
    LEAST_LIGHT,
    Pixels,
    SmoothField,
    dead_leaves,
    events_of,
    light_at,
)

CAMERA = Camera.from_fov(96, 72, math.radians(40.0))
QUIET = Pixels(
    spread=0.0,
    refractory_us=0.0,
    bandwidth_hz=1e9,
    buffer_hz=1e9,
    noise=0.0,
    background_hz=0.0,
    leak_hz=0.0,
    delay_us=0.0,
    jitter_us=0.0,
)


def through_wedge(xy: Any, t: float) -> Any:
    theta = np.full(len(xy), 75.0 * t)
    return oracle.move(CAMERA, Prism(math.radians(1.0)), xy, theta, to_scene=True, phase=0.3)


def at_rest(xy: Any, t: float) -> Any:
    return xy


def test_the_polynomial_equals_the_trace_at_every_pixel() -> None:
    field = SmoothField(96, 72)
    xy = np.stack(np.meshgrid(np.arange(96.0), np.arange(72.0)), axis=-1).reshape(-1, 2)
    assert np.abs(field(through_wedge, 0.013) - through_wedge(xy, 0.013)).max() < 1e-7


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_events_are_one_threshold_of_light_apart(sign: float) -> None:
    rng = np.random.default_rng(1)
    scene = dead_leaves(96, 72, rng)

    def lamp(t: float) -> float:
        return math.exp(sign * 8.0 * t)

    pixels = Pixels(**{**QUIET.__dict__, "on": 0.2, "off": 0.3})
    events = events_of(scene, CAMERA, at_rest, 0.2, rng, pixels, lamp)
    assert len(events) > 96 * 72 * 2
    assert (events.p == (sign > 0.0)).all()
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    light = np.exp(sign * 8.0 * 1e-6 * events.t) * light_at(scene, xy) + LEAST_LIGHT
    order = np.lexsort([events.t, events.y.astype(int) * 96 + events.x])
    same = np.diff(events.y.astype(int)[order] * 96 + events.x[order]) == 0
    steps = np.diff(np.log(light[order]))[same]
    assert len(steps) > 5000
    np.testing.assert_allclose(steps, 0.2 if sign > 0.0 else -0.3, atol=2e-4)


def test_a_pixel_is_blind_after_an_event_and_starts_again_from_there() -> None:
    rng = np.random.default_rng(2)
    scene = dead_leaves(96, 72, rng)
    pixels = Pixels(**{**QUIET.__dict__, "refractory_us": 20_000.0})
    events = events_of(scene, CAMERA, at_rest, 0.2, rng, pixels, lambda t: math.exp(10.0 * t))
    order = np.lexsort([events.t, events.y.astype(int) * 96 + events.x])
    same = np.diff(events.y.astype(int)[order] * 96 + events.x[order]) == 0
    waits = np.diff(events.t[order])[same]
    # 20 ms of reset, then the time in which bright pixels gain a threshold of 0.25 at 10 /s
    assert waits.min() >= 20_000 + 25_000 - 2
    assert np.median(waits) < 20_000 + 30_000


def test_delays_and_time_stamps() -> None:
    scene = dead_leaves(96, 72, np.random.default_rng(3))

    def made(**changes: Any) -> Any:
        pixels = Pixels(**{**QUIET.__dict__, **changes})
        return events_of(scene, CAMERA, through_wedge, 0.02, np.random.default_rng(4), pixels)

    plain, late, coarse = made(), made(off_delay_us=500.0, delay_us=70.0), made(stamp_us=1000)
    for polarity, delay_us in ((1, 70), (0, 570)):
        assert (
            np.abs(
                np.sort(late.t[late.p == polarity])
                - np.sort(plain.t[plain.p == polarity])
                - delay_us
            ).max()
            <= 1
        )
    assert set(np.unique(coarse.t % 1000)) == {0}
    assert np.abs(np.sort(coarse.t) - np.sort(plain.t)).max() <= 500


@pytest.mark.slow
def test_a_wedge_is_found_in_its_events() -> None:
    rng = np.random.default_rng(0)
    one = true_optics.Wedge(math.radians(1.0), 0.3, 720.0)
    angle = true_optics.turning(720.0)
    rig = true_optics.Rig(one.place(angle), true_optics.read(angle, 0.25), Prism(1.1 * one.apex))
    recording = true_optics.record(rig, rng, None)
    found = calibrate(recording, photometric=true_optics.known_timing(rig))
    error, largest, _ = true_optics.errors_px(rig, recording, found)
    assert error < 0.004
    assert largest < 0.008


def test_errors_leave_out_a_lag_and_a_rotation_of_the_camera_but_no_phase_of_one_kind() -> None:
    """The measure itself: a true calibration has no error, a larger prism has the error that it must have."""
    rng = np.random.default_rng(5)
    one = true_optics.Wedge(math.radians(1.0), 0.4, 720.0)
    angle = true_optics.turning(720.0)
    rig = true_optics.Rig(one.place(angle), true_optics.read(angle, 0.25), Prism(one.apex))
    t = np.sort(rng.integers(0, 250_000, 100))
    events = true_optics.Events.from_arrays(
        rng.integers(0, 320, 100), rng.integers(0, 240, 100), t, rng.integers(0, 2, 100)
    )
    recording = Recording(
        MemoryEvents(events, 320, 240), true_optics.CAMERA, rig.encoder, rig.prism, name="few"
    )
    from reference.calibration_sample import exact_calibration

    def errors(rig: true_optics.Rig, apex_deg: float, phase: float) -> tuple[float, float, float]:
        values = {"apex": math.radians(apex_deg), "phase": phase}
        found = exact_calibration(true_optics.CAMERA, Prism(one.apex), values)
        return true_optics.errors_px(rig, recording, found)

    def error(apex_deg: float, phase: float) -> float:
        return errors(rig, apex_deg, phase)[0]

    assert error(1.0, 0.4) < 1e-4
    assert error(1.0, 0.43) < 1e-4  # a lag of 0.4 ms
    # 1 % of the orbit, whose radius grows towards the corners.
    xy = np.stack(np.meshgrid(np.linspace(8, 311, 12), np.linspace(8, 231, 9)), axis=-1).reshape(
        -1, 2
    )
    turned = [
        oracle.move(true_optics.CAMERA, Prism(one.apex), xy, np.full(108, a), to_scene=True)
        for a in range(6)
    ]
    radius = math.sqrt(float(np.mean(np.sum((np.array(turned) - xy) ** 2, axis=-1))))
    assert error(1.01, 0.4) == pytest.approx(0.01 * radius, rel=0.03)
    # A camera that points elsewhere sees the same motion. Without a shift only, its turn is left.
    elsewhere = oracle.Rotation.from_rotvec([1e-3, -2e-3, 3e-3])
    turned_rig = replace(
        rig, place=lambda xy, t: oracle.turned(true_optics.CAMERA, elsewhere, rig.place(xy, t))
    )
    without_rotation, _, without_shift = errors(turned_rig, 1.0, 0.4)
    assert without_rotation < 0.01
    assert without_shift == pytest.approx(
        3e-3 * math.sqrt(float(np.mean(np.sum((xy - xy.mean(axis=0)) ** 2, axis=1)))), rel=0.1
    )
    # A picture that is magnified is no rotation.
    middle = np.array([true_optics.CAMERA.cx, true_optics.CAMERA.cy])
    magnified = replace(rig, place=lambda xy, t: middle + 1.001 * (rig.place(xy, t) - middle))
    assert errors(magnified, 1.0, 0.4)[0] > 0.08


def test_a_trouble_is_named_by_a_warning_or_by_a_bound_that_covers_the_error() -> None:
    said = ["the first encoder's angle is wrong by 2 deg once a turn: it was corrected"]
    assert true_optics.is_named(0.05, said, {}, true_optics.ANGLE)
    assert not true_optics.is_named(0.05, said, {}, true_optics.SHAPE)
    # The clock of an encoder is not its angle, and an error that is no cause has no words.
    clock = ["the scale or the clock of the encoder is wrong"]
    assert not true_optics.is_named(0.05, clock, {}, true_optics.ANGLE)
    assert not true_optics.is_named(0.05, said, {}, ())
    bounds = {"the evenness of the prism's faces": 0.06, "the plate's thickness": 0.04}
    assert true_optics.is_named(0.06, [], bounds, true_optics.SHAPE)
    assert not true_optics.is_named(0.061, [], bounds, true_optics.SHAPE)
    assert not true_optics.is_named(0.05, [], bounds, ("thickness",))
    assert not true_optics.is_named(None, [], bounds, true_optics.SHAPE)  # a refusal
    assert true_optics.is_named(None, ["No EVENNESS"], {}, true_optics.SHAPE)


def test_the_summary_counts_what_is_neither_named_nor_stated() -> None:
    def row(
        error: float, stated: float, hidden: float, *, named: bool = False, refused: bool = False
    ) -> dict[str, Any]:
        total = true_optics.total_px(stated, {"a": 0.5 * hidden, "b": hidden})
        given = {"stated_px": stated, "total_px": total, "named": named, "refused": refused}
        return {**given, "error_px": None if refused else error}

    rows = [
        row(0.001, 0.002, 0.002),
        row(0.05, 0.01, 0.02),  # beyond three deviations and the total
        row(0.05, 0.01, 0.06),  # a cause of this size could hide
        row(0.05, 0.02, 0.0),
        row(0.05, 0.01, 0.0, named=True),
        row(0.05, 0.01, 0.0, refused=True),
    ]
    found = true_optics.summary(rows)
    assert (found["recordings"], found["answered"], found["silent"], found["unstated"]) == (
        6,
        5,
        3,
        1,
    )
    assert found["within_total"] == pytest.approx(0.4)


def test_drawn_recordings_begin_at_a_seed() -> None:
    calls = true_optics.drawn(range(101, 104), ["mirror"])
    assert [seed for _, _, seed in calls] == [101, 102, 103]
    assert [trouble for _, trouble, _ in calls] == [
        true_optics.DRAWN["mirror"][k % 3] for k in (101, 102, 103)
    ]


def test_every_trouble_can_be_made() -> None:
    names = [
        (optic, trouble) for optic, troubles in true_optics.DRAWN.items() for trouble in troubles
    ]
    for optic, trouble in (*names, *true_optics.FRESH):
        rig = true_optics.OPTICS[optic](np.random.default_rng(7), trouble)
        xy = np.array([[10.0, 20.0], [200.0, 100.0]])
        places = rig.place(xy, 0.01)
        assert places.shape == (2, 2)
        assert np.abs(places - xy).max() < 60.0
        assert (
            isinstance(rig.encoder, Encoder)
            or optic == "vibration"
            or trouble.startswith("no encoder")
        )
