"""Adaptive prism speed: the estimate of edges seen, and the speed that follows from it."""

import math

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Camera,
    CameraMotion,
    Encoder,
    Events,
    ExactModel,
    Prism,
    PrismMotion,
    Scene,
    Simulation,
    compensate_events,
)
from amiwarp.live.stream import SpeedController
from amiwarp.live.stream.coverage import DIRECTIONS, Coverage, CoverageMeter, prism_path
from amiwarp.studies.stability import SceneKind
from amiwarp.studies.stability.scenes import draw

WINDOW_US = 33_000
CAMERA, PRISM, PHASE = Camera.from_fov(200, 150, math.radians(40.0)), Prism(math.radians(1.8)), 0.7


def watched(
    light: np.ndarray, rpm: float, rates: tuple[float, float, float], windows: int = 8
) -> tuple[CoverageMeter, list[Coverage]]:
    """Measure the windows of a simulated recording. ``rates``: the camera's angular velocity [rad/s]."""
    made = Simulation(
        Scene.from_picture(light), CAMERA, PRISM, windows * WINDOW_US * 1e-6, PrismMotion(rpm, PHASE),
        CameraMotion(rates),
    )  # fmt: skip
    events, encoder, model = made.run().events, made.encoder(), ExactModel(CAMERA, PRISM, PHASE)
    meter, out = CoverageMeter(CAMERA.width, CAMERA.height), []
    for start in range(0, windows * WINDOW_US, WINDOW_US):
        end = start + WINDOW_US
        out.append(meter(compensated(events.between(start, end), model, encoder), start, end,
                         prism_path(model, encoder, start, end)))  # fmt: skip
    return meter, out


def compensated(events: Events, model: ExactModel, encoder: Encoder) -> Events:
    xy = compensate_events(events, model, encoder)
    return Events(xy[:, 0], xy[:, 1], events.t, events.p)


@pytest.fixture(scope="module")
def leaves() -> np.ndarray:
    return draw(SceneKind.TEXTURE, 320, 240, period=20.0, seed=1)


def test_a_faster_prism_shows_more_edges(leaves: np.ndarray) -> None:
    shares = [
        np.mean([c.share for c in watched(leaves, rpm, (0.0, 0.0, 0.0))[1]])
        for rpm in (90.0, 270.0, 720.0)
    ]
    assert shares[0] < 0.95 < shares[1] < 0.999 < shares[2]


def test_the_cameras_own_motion_is_found_and_shows_edges_too(leaves: np.ndarray) -> None:
    _, still = watched(leaves, 120.0, (0.0, 0.0, 0.0))
    _, panning = watched(leaves, 120.0, (0.0, 1.0, 0.0))
    px_s = -CAMERA.fx  # the image moves against the camera
    np.testing.assert_allclose([c.drift for c in still[1:]], 0.0, atol=0.05 * CAMERA.fx)
    np.testing.assert_allclose(
        [c.drift for c in panning[1:]], [(px_s, 0.0)] * 7, atol=0.1 * CAMERA.fx
    )
    assert np.mean([1.0 - c.share for c in panning[1:]]) < 0.5 * np.mean(
        [1.0 - c.share for c in still[1:]]
    )


def stripes(angle: float) -> np.ndarray:
    """A picture of edges whose normals all have one angle [rad]."""
    rows, columns = np.mgrid[:240, :320]
    steps = (columns * math.cos(angle) + rows * math.sin(angle)) // 12
    return np.where(steps % 2, 0.9, 0.2).astype(np.float32)


@pytest.mark.parametrize("angle", [0.6, 2.2])
def test_the_texture_is_that_of_the_scene(angle: float, leaves: np.ndarray) -> None:
    normals = (np.arange(DIRECTIONS) + 0.5) * math.pi / DIRECTIONS
    near = np.abs(np.angle(np.exp(2j * (normals - angle)))) < 2.0 * math.radians(15.0)
    one = watched(stripes(angle), 720.0, (0.0, 0.0, 0.0))[1][-1].texture
    many = watched(leaves, 720.0, (0.0, 0.0, 0.0))[1][-1].texture
    assert one.sum() == pytest.approx(1.0)
    assert one[near].sum() > 0.7
    assert many.max() < 0.2


def test_motion_across_the_only_edges_is_enough() -> None:
    meter, _ = watched(stripes(math.pi / 2), 720.0, (0.0, 0.0, 0.0))
    way = np.linspace(0.0, 2.0, 17)
    across, along = np.column_stack([0.0 * way, way]), np.column_stack([way, 0.0 * way])
    assert meter(Events.empty(), 500_000, 533_000, across).share > 0.98
    assert meter(Events.empty(), 533_000, 566_000, along).share < 0.6


def test_a_window_without_events_has_the_prisms_coverage() -> None:
    meter, turned = CoverageMeter(64, 48), np.linspace(0.0, math.pi, 17)
    path = 3.0 * np.stack([np.cos(turned), np.sin(turned)], axis=1)
    empty = [
        meter(Events.empty(), t, t + WINDOW_US, scale * path)
        for t, scale in ((0, 1.0), (WINDOW_US, 0.0))
    ]
    assert empty[0].share > 0.99
    assert empty[1].share == 0.0
    np.testing.assert_allclose(empty[1].texture, 1.0 / DIRECTIONS)
    with pytest.raises(
        AmiwarpError, match=r"window 50000 \.\. 83000 us after one that ended at 66000"
    ):
        meter(Events.empty(), 50_000, 83_000, path)


EVEN = np.full(DIRECTIONS, 1.0 / DIRECTIONS)


def circle(radius: float) -> np.ndarray:
    turned = np.linspace(0.0, math.tau, 1024, endpoint=False)
    return radius * np.stack([np.cos(turned), np.sin(turned)], axis=1)


def scene(drift: tuple[float, float] = (0.0, 0.0), texture: np.ndarray = EVEN) -> Coverage:
    """The coverage of a window, with the fields that the controller uses."""
    return Coverage(1.0, np.array(drift), np.zeros(2), np.zeros(DIRECTIONS), texture)


def follow(
    controller: SpeedController, scenes: list[Coverage], mev_per_rpm: float = 0.005
) -> np.ndarray:
    """Run the control loop with a lagging motor. Return the requested speed of each window."""
    motor, told, out = controller.rpm, controller.rpm, []
    for k, seen in enumerate(scenes):
        motor += (told - motor) * (1.0 - math.exp(-0.33))
        told = (
            controller.update(k * WINDOW_US, (k + 1) * WINDOW_US, seen, mev_per_rpm * motor) or told
        )
        out.append(told)
    return np.array(out)


def unseen(radius: float, rpm: float, seen: Coverage) -> float:
    return 1.0 - float(seen.predict(np.array([rpm]), circle(radius), 1e-6 * WINDOW_US)[0])


@pytest.mark.parametrize("drift", [(0.0, 0.0), (90.0, -40.0), (0.0, 700.0)])
def test_what_is_foretold_is_what_windows_see(drift: tuple[float, float]) -> None:
    """The prediction is the coverage at the worst phase of the prism. The windows begin at any phase."""
    radius, rpm, along = 4.0, 500.0, np.linspace(0.0, 1.0, 17)
    shares = []
    for phase in np.arange(0.0, 1.0, 0.125):
        turned = math.tau * (phase + along * rpm / 60e6 * WINDOW_US)
        way = radius * np.stack([np.cos(turned), np.sin(turned)], axis=1)
        way += along[:, None] * np.array(drift) * 1e-6 * WINDOW_US
        # New, so it assumes a still camera and edges of all directions
        meter = CoverageMeter(64, 48)
        shares.append(meter(Events.empty(), 0, WINDOW_US, way).share)
    assert 1.0 - unseen(radius, rpm, scene(drift)) == pytest.approx(min(shares), abs=2e-3)
    assert 0.5 < min(shares) < 0.9999


@pytest.mark.parametrize("radius", [2.0, 4.0, 6.0, 12.0])
def test_it_settles_where_coverage_is_right_and_stays(radius: float) -> None:
    controller = SpeedController(circle(radius), 1000.0)
    speeds = follow(controller, [scene()] * 400)
    assert 1.0 - controller.high < unseen(radius, speeds[-1], scene()) < 1.0 - controller.low
    assert 120.0 < speeds[-1] < 1440.0
    assert (speeds[150:] == speeds[-1]).all()
    ways = np.sign(np.diff(speeds))
    assert len(set(ways[ways != 0.0])) == 1  # it never reverses


ONE = np.eye(DIRECTIONS)[0]
"""Texture whose edge normals all lie near x."""


def test_it_follows_a_scene_that_changes_without_swinging() -> None:
    """All edges have one direction. A camera that moves across them needs no prism."""
    still, moved = scene(texture=ONE), scene((800.0, 0.0), ONE)
    controller = SpeedController(circle(4.0))
    speeds = follow(controller, [still] * 150 + [moved] * 200 + [still] * 200)
    assert speeds[349] == pytest.approx(120.0, rel=0.015)
    assert speeds[549] == pytest.approx(speeds[149], rel=0.15)
    assert speeds[149] > 300.0
    for part in (speeds[150:350], speeds[350:]):
        ways = np.sign(np.diff(part))
        assert len(set(ways[ways != 0.0])) == 1


def test_where_prism_and_camera_cancel_slower_is_enough() -> None:
    """The camera is as fast as the prism would be at 2000 rpm; at 600 some edges see little for part of the turn."""
    radius = 5.0
    seen = scene((radius * 2000.0 * math.tau / 60.0, 0.0))
    assert unseen(radius, 400.0, seen) < 1e-3 < unseen(radius, 600.0, seen)
    speeds = follow(SpeedController(circle(radius), 600.0), [seen] * 200)
    assert unseen(radius, speeds[-1], seen) < 1e-3
    assert speeds[-1] < 450.0


def test_inside_the_band_it_holds_still() -> None:
    controller = SpeedController(circle(6.0))
    settled = follow(controller, [scene()] * 200)[-1]
    rng = np.random.default_rng(0)
    for k in range(200, 280):
        texture = EVEN * rng.uniform(0.8, 1.2, DIRECTIONS)
        window = k * WINDOW_US, (k + 1) * WINDOW_US
        assert controller.update(*window, scene(texture=texture / texture.sum()), 3.0) is None
    assert controller.rpm == settled


def test_limits_and_ramp_are_kept() -> None:
    controller = SpeedController(
        circle(0.5), 300.0, least_rpm=200.0, most_rpm=500.0, ramp_rpm_s=100.0
    )
    speeds = follow(controller, [scene()] * 150 + [scene((800.0, 0.0), ONE)] * 250)
    assert max(speeds) == pytest.approx(500.0, rel=0.01)
    assert max(speeds) <= 500.0
    assert speeds[-1] == pytest.approx(200.0, rel=0.01)
    assert np.abs(np.diff(speeds)).max() == pytest.approx(100.0 * 0.033)


def test_the_event_rate_comes_before_coverage() -> None:
    controller = SpeedController(circle(2.0), most_mev_s=2.0)  # reached at 400 rpm
    speeds = follow(controller, [scene()] * 400)
    assert 0.8 * 400.0 <= speeds[-1] <= 400.0
    assert (speeds[300:] == speeds[-1]).all()


def test_above_the_largest_event_rate_the_speed_is_lowered_well_below_it() -> None:
    """From 600 rpm, where the rate is reached at 400 rpm, to nine tenths of it: a rate at the limit would swing."""
    controller = SpeedController(circle(2.0), 600.0, most_mev_s=2.0)
    speeds = follow(controller, [scene()] * 400)
    assert 0.8 * 400.0 <= speeds[-1] <= 0.91 * 400.0
    assert (np.diff(speeds) <= 0.0).all()


def test_what_makes_no_sense_is_said() -> None:
    orbit = circle(4.0)
    with pytest.raises(AmiwarpError, match=r"100 rpm to start with is not in 120 \.\. 1440 rpm"):
        SpeedController(orbit, 100.0)
    with pytest.raises(AmiwarpError, match=r"coverage limits low = 0\.99 and high = 0\.9"):
        SpeedController(orbit, low=0.99, high=0.9)
    with pytest.raises(AmiwarpError, match="ramp_rpm_s = 0"):
        SpeedController(orbit, ramp_rpm_s=0.0)
    controller = SpeedController(orbit)
    with pytest.raises(AmiwarpError, match="nan Mev/s"):
        controller.update(0, 1000, scene(), math.nan)
    controller.update(0, 1000, scene(), 1.0)
    with pytest.raises(
        AmiwarpError, match=r"window 500 \.\. 2000 us after one that ended at 1000 us"
    ):
        controller.update(500, 2000, scene(), 1.0)
