"""The speed that a stream asks for, and the edges seen that it is made from."""

import math

import numpy as np
import pytest

from amiwarp.camera import Camera
from amiwarp.compensate import compensate_events
from amiwarp.encoder import Encoder
from amiwarp.errors import AmiwarpError
from amiwarp.events import Events
from amiwarp.motion import CameraMotion, PrismMotion
from amiwarp.optics import ExactModel, Prism
from amiwarp.simulate import Scene, Simulation
from amiwarp.stability.scenes import SceneKind, draw
from amiwarp.stream.adaptive import DIRECTIONS, Coverage, CoverageMeter, SpeedController, prism_path

WINDOW_US = 33_000
CAMERA, PRISM, PHASE = Camera.from_fov(200, 150, math.radians(40.0)), Prism(math.radians(1.8)), 0.7


def watched(
    light: np.ndarray, rpm: float, rates: tuple[float, float, float], windows: int = 8
) -> tuple[CoverageMeter, list[Coverage]]:
    """Windows of a simulated recording; ``rates`` of the camera [rad/s]."""
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
    shares = [np.mean([c.share for c in watched(leaves, rpm, (0.0, 0.0, 0.0))[1]]) for rpm in (90.0, 270.0, 720.0)]
    assert shares[0] < 0.95 < shares[1] < 0.999 < shares[2]


def test_the_cameras_own_motion_is_found_and_shows_edges_too(leaves: np.ndarray) -> None:
    _, still = watched(leaves, 120.0, (0.0, 0.0, 0.0))
    _, panning = watched(leaves, 120.0, (0.0, 1.0, 0.0))
    px_s = -CAMERA.fx  # the image runs against the camera
    np.testing.assert_allclose([c.drift for c in still[1:]], 0.0, atol=0.05 * CAMERA.fx)
    np.testing.assert_allclose([c.drift for c in panning[1:]], [(px_s, 0.0)] * 7, atol=0.1 * CAMERA.fx)
    assert np.mean([1.0 - c.share for c in panning[1:]]) < 0.5 * np.mean([1.0 - c.share for c in still[1:]])


def stripes(angle: float) -> np.ndarray:
    """Edges whose normals are at one angle [rad]."""
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
    empty = [meter(Events.empty(), t, t + WINDOW_US, scale * path) for t, scale in ((0, 1.0), (WINDOW_US, 0.0))]
    assert empty[0].share > 0.99
    assert empty[1].share == 0.0
    np.testing.assert_allclose(empty[1].texture, 1.0 / DIRECTIONS)
    with pytest.raises(AmiwarpError, match=r"window 50000 \.\. 83000 us after one that ended at 66000"):
        meter(Events.empty(), 50_000, 83_000, path)


def unseen(rpm: float, enough: float) -> float:
    """As in a still scene: what is unseen falls by e for each tenth of the speed."""
    return 1e-3 * math.exp(10.0 * (1.0 - rpm / enough))


def follow(controller: SpeedController, enough: list[float], mev_per_rpm: float = 0.005) -> list[float]:
    """Speeds of a loop with a lagging motor, where ``enough`` is the speed that a window would need."""
    motor, told, out = controller.rpm, controller.rpm, []
    for k, need in enumerate(enough):
        motor += (told - motor) * (1.0 - math.exp(-0.33))
        share = 1.0 - min(1.0, unseen(motor, need) * (1.0 + 0.5 * math.sin(2.5 * k)))
        told = controller.update((k + 1) * WINDOW_US, share, mev_per_rpm * motor) or told
        out.append(told)
    return out


@pytest.mark.parametrize("enough", [150.0, 400.0, 550.0, 900.0, 1200.0])
def test_it_settles_where_coverage_is_right_and_stays(enough: float) -> None:
    speeds = np.array(follow(SpeedController(), [enough] * 400))
    assert speeds[-1] == pytest.approx(enough, rel=0.12)
    assert (speeds[150:] == speeds[-1]).all()
    ways = np.sign(np.diff(speeds))
    assert len(set(ways[ways != 0.0])) == 1  # it never turned back


def test_it_follows_a_scene_that_changes_without_swinging() -> None:
    speeds = np.array(follow(SpeedController(), [400.0] * 150 + [160.0] * 200 + [700.0] * 200))
    assert speeds[[149, 349, 549]] == pytest.approx([400.0, 160.0, 700.0], rel=0.12)
    for part in (speeds[150:350], speeds[350:]):
        ways = np.sign(np.diff(part))
        ways = ways[ways != 0.0]
        assert np.count_nonzero(np.diff(ways)) <= 1


def test_inside_the_band_it_holds_still() -> None:
    controller = SpeedController()
    for k, share in enumerate([0.9994, 0.9992, 0.9997, 0.9989] * 20):
        assert controller.update((k + 1) * WINDOW_US, share, 3.0) is None
    assert controller.rpm == 720.0


def test_limits_and_ramp_are_kept() -> None:
    controller = SpeedController(300.0, least_rpm=200.0, most_rpm=500.0, ramp_rpm_s=100.0)
    speeds = [300.0]
    for k in range(400):
        speeds.append(controller.update((k + 1) * WINDOW_US, 0.2 if k < 150 else 1.0, 3.0) or speeds[-1])
    assert max(speeds) == 500.0
    assert speeds[-1] == 200.0
    assert np.abs(np.diff(speeds)).max() == pytest.approx(100.0 * 0.033)


def test_the_event_rate_comes_before_coverage() -> None:
    speeds = np.array(follow(SpeedController(most_mev_s=2.0), [900.0] * 400, mev_per_rpm=0.005))  # 2 Mev/s at 400 rpm
    assert 0.8 * 400.0 <= speeds[-1] <= 400.0
    assert (speeds[200:] == speeds[-1]).all()


def test_what_makes_no_sense_is_said() -> None:
    with pytest.raises(AmiwarpError, match=r"100 rpm to start with is not in 120 \.\. 1440 rpm"):
        SpeedController(100.0)
    with pytest.raises(AmiwarpError, match=r"coverage from 0\.99 to 0\.9"):
        SpeedController(low=0.99, high=0.9)
    with pytest.raises(AmiwarpError, match="ramp_rpm_s = 0"):
        SpeedController(ramp_rpm_s=0.0)
    controller = SpeedController()
    with pytest.raises(AmiwarpError, match=r"coverage nan at 1 Mev/s"):
        controller.update(0, math.nan, 1.0)
    controller.update(1000, 1.0, 1.0)
    with pytest.raises(AmiwarpError, match="window at 1000 us after that at 1000 us"):
        controller.update(1000, 1.0, 1.0)
