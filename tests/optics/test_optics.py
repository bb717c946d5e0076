"""The prism's models against the independent trace, the paper's formulas, and the published tables."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from amiwarp import (
    AmiwarpError,
    Camera,
    CameraRotation,
    CircleModel,
    EllipseModel,
    ExactModel,
    Fisheye,
    FlatSide,
    Model,
    Plate,
    Prism,
    RadialCircleModel,
    RadialTangential,
    RisleyModel,
    RotationPath,
    apex_from_deflection,
    deflection_from_apex,
    predicted_error,
)
from amiwarp.kernels.camera import CameraParams, PinholeParams, camera_params, pinhole_params
from amiwarp.kernels.camera_rotation import CameraRotationParams, undo_camera_rotation
from amiwarp.optics import MODELS, rungs, wrap_angle
from amiwarp.optics.models.several import compensate_by_each
from reference import optics as oracle

ATOL = 1e-3  # px, the documented limit; docs/explanation/optics.md has the measured values
SIDES = list(FlatSide)
BARREL = RadialTangential(
    -0.368436311798, 0.150947243557, -0.000296130534385, -0.000759431726241, 0.0
)
TURN = np.arange(36) * (2.0 * np.pi / 36)


def camera(fov_deg: float = 60.0, lens: Any = None, size: tuple[int, int] = (640, 480)) -> Camera:
    return Camera.from_fov(*size, math.radians(fov_deg), lens)


def glass(name: str) -> Prism | Plate:
    """Return the glass of a model."""
    return prism(1.0) if MODELS[name].GLASS is Prism else Plate(0.01, 0.3)


def prism(
    deflection_deg: float = 1.0, side: FlatSide = FlatSide.SCENE, index: float = 1.55
) -> Prism:
    return Prism(apex_from_deflection(math.radians(deflection_deg), index, side), index, side)


def samples(cam: Camera, count: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """Random pixels that float32 represents exactly, half of them integers, and angles; both float64."""
    rng = np.random.default_rng(1)
    xy = rng.uniform(0.0, [cam.width - 1, cam.height - 1], (count, 2)).astype(np.float32)
    xy[::2] = np.round(xy[::2])
    return xy.astype(np.float64), rng.uniform(-np.pi, np.pi, count)


def lattice(cam: Camera, columns: int = 33, rows: int = 25) -> tuple[np.ndarray, np.ndarray]:
    """Pixels on a regular grid over the image and angles over one turn, as in the published tables."""
    axes = np.linspace(0, cam.width - 1, columns), np.linspace(0, cam.height - 1, rows), TURN
    mesh = np.stack([m.ravel() for m in np.meshgrid(*axes, indexing="ij")], axis=1)
    return mesh[:, :2], mesh[:, 2]


def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.asarray(a, dtype=np.float64) - b, axis=1)


def on(device: str, xy: np.ndarray, theta: np.ndarray) -> tuple[wp.array, wp.array]:
    points = wp.array(xy.astype(np.float32), dtype=wp.vec2, device=device)
    return points, wp.array(theta.astype(np.float32), dtype=float, device=device)


# -- apex and deflection


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("index", [1.33, 1.5168, 1.9])
@pytest.mark.parametrize("apex_deg", [0.0, 0.1, 1.817, 4.0, 15.0])
def test_conversions_meet_the_traced_axial_ray(
    side: FlatSide, index: float, apex_deg: float
) -> None:
    wedge = Prism(math.radians(apex_deg), index, side)
    out = oracle.through_prism(wedge, np.array([[0.0, 0.0, 1.0]]), np.zeros(1), to_scene=True)[0]
    turned = math.atan2(out[0], out[2]) * (1.0 if side is FlatSide.SCENE else -1.0)
    assert wedge.deflection == pytest.approx(turned, abs=1e-12)
    assert apex_from_deflection(wedge.deflection, index, side) == pytest.approx(
        wedge.apex, abs=1e-12
    )
    assert deflection_from_apex(wedge.apex, index, side) == wedge.deflection


def test_deflection_is_not_the_apex() -> None:
    for deflection, apex in [
        (0.5, 0.909),
        (1.0, 1.817),
        (2.0, 3.627),
    ]:  # published pairs [deg], n = 1.55
        assert math.degrees(prism(deflection, FlatSide.CAMERA).apex) == pytest.approx(
            apex, abs=6e-4
        )
    thin = Prism(1e-4, 1.55)
    assert thin.deflection == pytest.approx(0.55e-4, abs=1e-11)


@pytest.mark.parametrize(
    "values", [(1.8, 1.5), (-0.01, 1.5), (math.nan, 1.5), (0.03, 1.0), (0.03, math.nan)]
)
def test_impossible_prisms_are_refused(values: tuple[float, float]) -> None:
    with pytest.raises(AmiwarpError, match=r"prism (apex|index)"):
        Prism(*values)


# -- the exact model


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("lens", [None, BARREL, Fisheye(-0.01, 0.005, -0.002, 0.0003)], ids=str)
def test_exact_model_meets_the_two_interface_trace(device: str, side: FlatSide, lens: Any) -> None:
    cam, wedge = camera(70.0, lens), Prism(math.radians(4.0), 1.55, side)
    model = ExactModel(cam, wedge, phase=0.7, tilt=(0.02, -0.03))
    xy, theta = samples(cam)
    points, angles = on(device, xy, theta)
    seen = model.compensate_points(points, angles)
    expected = oracle.move(cam, wedge, xy, theta, to_scene=True, phase=0.7, tilt=(0.02, -0.03))
    assert distance(seen.numpy(), expected).max() < ATOL
    assert distance(model.deflect_points(seen, angles).numpy(), xy).max() < ATOL
    expected = oracle.move(cam, wedge, xy, theta, to_scene=False, phase=0.7, tilt=(0.02, -0.03))
    assert distance(model.deflect_points(points, angles).numpy(), expected).max() < ATOL


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("lens", [None, BARREL], ids=str)
@pytest.mark.parametrize(
    "uneven",
    [
        {"cylinder": (0.01, -0.007)},
        {"wobble": (0.05, -0.03)},
        {"cylinder": (0.02, 0.02), "wobble": (-0.04, 0.09), "tilt": (0.02, -0.03)},
    ],
    ids=str,
)
def test_an_uneven_prism_meets_the_two_interface_trace(
    device: str, side: FlatSide, lens: Any, uneven: Any
) -> None:
    cam, wedge = camera(70.0, lens), Prism(math.radians(4.0), 1.55, side)
    model = ExactModel(cam, wedge, 0.7, **uneven)
    xy, theta = samples(cam)
    points, angles = on(device, xy, theta)
    seen = model.compensate_points(points, angles)
    assert (
        distance(
            seen.numpy(), oracle.move(cam, wedge, xy, theta, to_scene=True, phase=0.7, **uneven)
        ).max()
        < ATOL
    )
    assert distance(model.deflect_points(seen, angles).numpy(), xy).max() < ATOL
    expected = oracle.move(cam, wedge, xy, theta, to_scene=False, phase=0.7, **uneven)
    assert distance(model.deflect_points(points, angles).numpy(), expected).max() < ATOL


def test_cylinder_power_stretches_along_the_wedge_and_turns_with_it() -> None:
    """Thin: a ray of tangent t is shifted by (n − 1) C t more, with C in the frame of the wedge."""
    cam, power, theta = Camera(801, 801, 800.0, 800.0, 400.0, 400.0), 1e-3, 0.6
    along = np.array([math.cos(theta), math.sin(theta)])
    across = np.array([-along[1], along[0]])
    tangent = 0.1
    for (x, y), shift in (((power, 0.0), along), ((0.0, power), across)):
        models = [ExactModel(cam, Prism(1e-3, 1.5), cylinder=c) for c in ((x, y), (0.0, 0.0))]
        xy = [400.0, 400.0] + 800.0 * tangent * along[None]
        got, even = (m.compensate_points(xy, np.array([theta])) for m in models)
        np.testing.assert_allclose(
            (got - even)[0], 800.0 * 0.5 * power * tangent * shift, rtol=0.03, atol=2e-4
        )


@pytest.mark.parametrize("side", SIDES)
def test_a_wobble_at_one_angle_is_a_tilt(side: FlatSide) -> None:
    """At φ = 0, a wobble by one small angle is the tilt of the whole axis by it; at φ = 180° it is the opposite one."""
    cam, wedge, angle = camera(), prism(2.0, side), 0.03
    xy, _ = samples(cam, 500)
    for wobble, tilt in (((angle, 0.0), (0.0, angle)), ((0.0, angle), (-angle, 0.0))):
        leaning = ExactModel(cam, wedge, wobble=(math.tan(wobble[0]), math.tan(wobble[1])))
        for theta, sign in ((0.0, 1.0), (math.pi, -1.0)):
            at = np.full(len(xy), theta)
            expected = ExactModel(
                cam, wedge, tilt=(sign * tilt[0], sign * tilt[1])
            ).compensate_points(xy, at)
            assert distance(leaning.compensate_points(xy, at), expected).max() < ATOL


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.02, -0.03)], ids=str)
@pytest.mark.parametrize("side", SIDES)
def test_an_uneven_prism_of_smallest_angles_is_the_even_one(
    side: FlatSide, tilt: tuple[float, float]
) -> None:
    """The rare case meets the usual one; without a wedge or a slope nothing moves."""
    cam = camera(90.0)
    xy, theta = samples(cam, 500)
    even = ExactModel(cam, prism(2.0, side), 0.3, tilt)
    uneven = replace(even, cylinder=(1e-9, -1e-9), wobble=(1e-9, 1e-9))
    for name in ("compensate_points", "deflect_points"):
        assert (
            distance(getattr(even, name)(xy, theta), getattr(uneven, name)(xy, theta)).max() < 5e-4
        )
    flat = replace(uneven, prism=Prism(0.0, 1.5, side))
    assert distance(flat.compensate_points(xy, theta), xy).max() < 5e-4
    still = ExactModel.from_values(
        cam,
        prism(2.0, side),
        ExactModel.still_values({"apex": 0.03, "phase": 0.1, "cylinder_x": 0.02, "wobble_y": 0.1}),
    )
    assert distance(still.compensate_points(xy, theta), xy).max() < 5e-4


@pytest.mark.parametrize(("side", "sign"), [(FlatSide.SCENE, 1.0), (FlatSide.CAMERA, -1.0)])
@pytest.mark.parametrize("theta", [0.0, math.pi / 2, -2.0])
def test_axis_is_moved_along_the_tilt(side: FlatSide, sign: float, theta: float) -> None:
    """θ is the azimuth of the tilted face's normal, from x (right) to y (down). The scene's pixel lies there."""
    cam = Camera(641, 481, 600.0, 600.0, 320.0, 240.0)
    radius = sign * 600.0 * math.tan(math.radians(1.0))
    expected = [[320.0 + radius * math.cos(theta), 240.0 + radius * math.sin(theta)]]
    for name in ("circle", "radial", "exact", "ellipse"):
        model = MODELS[name].from_prism(cam, prism(1.0, side))
        got = model.compensate_points(np.array([[320.0, 240.0]]), np.array([theta]))
        np.testing.assert_allclose(got, expected, rtol=0, atol=0.02)


def test_swapping_the_faces_swaps_the_directions() -> None:
    cam, wedge = camera(), Prism(0.03, 1.5)
    xy, theta = samples(cam, 500)
    turned = ExactModel(cam, replace(wedge, flat_side=FlatSide.CAMERA))
    np.testing.assert_array_equal(
        ExactModel(cam, wedge).deflect_points(xy, theta), turned.compensate_points(xy, theta)
    )


def test_phase_adds_to_the_angle_and_whole_turns_do_not_count() -> None:
    cam = camera()
    xy, theta = samples(cam, 500)
    model = ExactModel(cam, prism())
    base = model.compensate_points(xy, theta + 0.4)
    assert distance(replace(model, phase=0.4).compensate_points(xy, theta), base).max() < 1e-4
    assert (
        distance(model.compensate_points(xy, theta + 0.4 + 2.0 * np.pi * 100_000), base).max()
        < 1e-4
    )


def test_tilt_about_x_moves_the_axis_of_rotation_up() -> None:
    """A tilt of 1 degree changes compensated positions by 0.05 to 1 px rms."""
    cam, wedge = camera(), prism(2.0)
    straight, tilted = ExactModel(cam, wedge), ExactModel(cam, wedge, tilt=(math.radians(1.0), 0.0))
    assert 0.05 < predicted_error(tilted, straight).rms < 1.0


# -- the paper's cross-section


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("apex_deg", [1.0, 4.0])
def test_paper_formula_in_the_plane_of_the_wedge(side: FlatSide, apex_deg: float) -> None:
    """δ = Φq − Φo + Φp − Φi with signed angles equals the trace in the plane of the optical axis and the tilt."""
    wedge = Prism(math.radians(apex_deg), 1.55, side)
    angle = np.radians(np.linspace(-60.0, 60.0, 121))
    rays = np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1)
    for to_scene in (True, False):
        out = oracle.through_prism(wedge, rays, 0.0 * angle, to_scene=to_scene)
        tilted_first = (side is FlatSide.SCENE) == to_scene
        delta = oracle.cross_section(angle, wedge.apex, 1.55, tilted_first=tilted_first)
        np.testing.assert_allclose(
            np.arctan2(out[:, 0], out[:, 2]) - angle, delta, rtol=0, atol=1e-13
        )


def test_paper_formula_needs_signed_angles() -> None:
    """Ray from the scene at α = 1°, φ = 45°: −0.93°. With both refractions counted towards the normal it is −34.8°."""
    apex, phi_i = math.radians(1.0), np.array(math.radians(45.0))
    signed = oracle.cross_section(phi_i, apex, 1.55, tilted_first=False)
    assert math.degrees(signed) == pytest.approx(-0.93, abs=5e-3)
    phi_p = np.arcsin(np.sin(phi_i) / 1.55)
    phi_o = phi_p - apex
    phi_q = np.arcsin(1.55 * np.sin(phi_o))
    assert math.degrees(signed) == pytest.approx(
        math.degrees((phi_q - phi_o) + (phi_p - phi_i)), abs=1e-9
    )
    assert math.degrees((phi_o - phi_q) + (phi_p - phi_i)) == pytest.approx(-34.8, abs=0.05)


@pytest.mark.parametrize("side", SIDES)
def test_skew_rays_follow_the_cross_section_with_the_bravais_index(side: FlatSide) -> None:
    """Outside that plane s = bearing · axis is constant, and the projection refracts with √(n² − s²)/√(1 − s²)."""
    rng = np.random.default_rng(2)
    rays = oracle.pixels_to_rays(camera(80.0), samples(camera(80.0), 500)[0])
    phi = rng.uniform(-np.pi, np.pi, len(rays))
    wedge = Prism(math.radians(4.0), 1.55, side)
    along = np.stack([np.cos(phi), np.sin(phi)], axis=1)
    axis = np.stack([-np.sin(phi), np.cos(phi), 0.0 * phi], axis=1)
    out = oracle.through_prism(wedge, rays, phi, to_scene=True)
    s = np.sum(rays * axis, axis=1)
    np.testing.assert_allclose(np.sum(out * axis, axis=1), s, rtol=0, atol=1e-14)
    before = np.arctan2(np.sum(rays[:, :2] * along, axis=1), rays[:, 2])
    after = np.arctan2(np.sum(out[:, :2] * along, axis=1), out[:, 2])
    index = np.sqrt(1.55**2 - s**2) / np.sqrt(1.0 - s**2)
    delta = oracle.cross_section(before, wedge.apex, index, tilted_first=side is FlatSide.SCENE)
    np.testing.assert_allclose(after - before, delta, rtol=0, atol=1e-13)
    plain = oracle.cross_section(before, wedge.apex, 1.55, tilted_first=side is FlatSide.SCENE)
    assert np.abs(after - before - plain).max() > 1e-3


# -- circles


@pytest.mark.parametrize("side", SIDES)
def test_circle_is_a_rotation_of_the_bearing(device: str, side: FlatSide) -> None:
    cam = camera(80.0, BARREL)
    xy, theta = samples(cam, 1000)
    model = CircleModel.from_prism(cam, prism(1.0, side), phase=0.3)
    sign = 1.0 if side is FlatSide.SCENE else -1.0
    rays = oracle.turn(oracle.pixels_to_rays(cam, xy), theta + 0.3, sign * math.radians(1.0))
    points, angles = on(device, xy, theta)
    seen = model.compensate_points(points, angles)
    assert distance(seen.numpy(), oracle.rays_to_pixels(cam, rays)).max() < ATOL
    assert distance(model.deflect_points(seen, angles).numpy(), xy).max() < ATOL


def growth(rays: np.ndarray, index: float) -> np.ndarray:
    return (np.sqrt(index**2 - 1.0 + rays[:, 2] ** 2) / rays[:, 2] - 1.0) / (index - 1.0)


@pytest.mark.parametrize(
    ("fov", "deflection", "one", "per_pixel"),
    [
        (40.0, 0.5, (0.48, 1.65), (0.03, 0.11)),
        (60.0, 1.0, (1.60, 6.78), (0.14, 0.71)),
        (75.0, 1.0, (2.28, 11.1), (0.18, 1.18)),
        (90.0, 0.5, (1.63, 8.49), (0.06, 0.51)),
        (90.0, 2.0, (6.74, 47.0), (1.07, 11.4)),
    ],
)
def test_published_circle_table(
    fov: float, deflection: float, one: tuple[float, float], per_pixel: tuple[float, float]
) -> None:
    """Mean and worst error [px] of a single δ and of δ(φ) of the observed ray; the flat face points to the camera."""
    cam, wedge = camera(fov), prism(deflection, FlatSide.CAMERA)
    xy, theta = lattice(cam)
    exact = oracle.move(cam, wedge, xy, theta, to_scene=True)
    rays = oracle.pixels_to_rays(cam, xy)
    for factor, (mean, worst) in ((1.0, one), (growth(rays, 1.55), per_pixel)):
        turned = oracle.turn(rays, theta, -factor * math.radians(deflection))
        error = distance(oracle.rays_to_pixels(cam, turned), exact)
        assert error.mean() == pytest.approx(mean, abs=0.006 + 0.015 * mean)
        assert error.max() == pytest.approx(worst, abs=0.006 + 0.015 * worst)


@pytest.mark.parametrize("side", SIDES)
def test_radial_circle_takes_its_angle_on_the_tilted_side(device: str, side: FlatSide) -> None:
    cam = camera(75.0)
    xy, theta = samples(cam, 1000)
    points, angles = on(device, xy, theta)
    model = RadialCircleModel.from_prism(cam, prism(1.0, side))
    rays = oracle.pixels_to_rays(cam, xy)
    turned = oracle.turn(rays, theta, math.radians(1.0) * growth(rays, 1.55))
    direct, back = model.compensate_points, model.deflect_points
    if side is FlatSide.CAMERA:
        direct, back = back, direct
    moved = direct(points, angles)
    assert distance(moved.numpy(), oracle.rays_to_pixels(cam, turned)).max() < ATOL
    assert distance(back(moved, angles).numpy(), xy).max() < ATOL


@pytest.mark.parametrize("side", SIDES)
def test_radial_circle_errs_in_second_order_only(side: FlatSide) -> None:
    """Twice the prism has four times the error; 0.036 px rms at 60 degrees and apex 1 degree, for both flat sides."""
    cam = camera(60.0)
    errors = [predicted_error(RadialCircleModel.from_prism(cam, p), ExactModel(cam, p))
              for p in (prism(1.0, side), prism(2.0, side))]  # fmt: skip
    assert errors[0].rms == pytest.approx(0.036, abs=0.003)
    assert errors[0].worst < 0.1
    assert errors[1].rms / errors[0].rms == pytest.approx(4.0, abs=0.2)


def test_radial_circle_refuses_what_would_divide_by_zero() -> None:
    with pytest.raises(AmiwarpError, match="index"):
        RadialCircleModel(camera(), 0.01, index=1.0)
    with pytest.raises(AmiwarpError, match="deflection"):
        RadialCircleModel(camera(), -0.01)


# -- ellipse


@pytest.mark.parametrize(
    ("fov", "apex_deg", "mean", "worst"),
    [(40.0, 1.0, 0.001, 0.004), (60.0, 1.0, 0.003, 0.024), (60.0, 2.0, 0.011, 0.097), (75.0, 2.0, 0.030, 0.27),
     (90.0, 2.0, 0.076, 0.75)],
)  # fmt: skip
def test_published_ellipse_table(
    device: str, fov: float, apex_deg: float, mean: float, worst: float
) -> None:
    cam, wedge = camera(fov), Prism(math.radians(apex_deg), 1.55)
    xy, theta = lattice(cam, 17, 13)
    xy = np.round(xy).astype(np.float64)
    model = EllipseModel.from_model(ExactModel(cam, wedge), device)
    points, angles = on(device, xy, theta)
    exact = oracle.move(cam, wedge, xy, theta, to_scene=True)
    error = distance(model.compensate_points(points, angles).numpy(), exact)
    assert error.mean() == pytest.approx(mean, abs=0.001 + 0.2 * mean)
    assert error.max() == pytest.approx(worst, abs=0.002 + 0.1 * worst)


def test_ellipse_tables_are_the_mean_and_first_harmonic() -> None:
    cam, wedge = camera(60.0, BARREL, (64, 48)), prism(2.0)
    model = EllipseModel.from_prism(cam, wedge, phase=0.5)
    xy = np.array([[10.0, 20.0], [63.0, 47.0]])
    turn = np.arange(64) * (2.0 * np.pi / 64)
    for pixel in xy:
        moved = oracle.move(cam, wedge, np.tile(pixel, (64, 1)), turn, to_scene=True) - pixel
        at = int(pixel[1]), int(pixel[0])
        np.testing.assert_allclose(model.offset[at], moved.mean(axis=0), rtol=0, atol=1e-4)
        np.testing.assert_allclose(
            model.cosine[at], 2.0 * (moved.T @ np.cos(turn)) / 64, rtol=0, atol=1e-4
        )
        np.testing.assert_allclose(
            model.sine[at], 2.0 * (moved.T @ np.sin(turn)) / 64, rtol=0, atol=1e-4
        )
    assert model.phase == 0.5


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("lens", [None, BARREL], ids=str)
def test_ellipse_round_trip_and_between_pixels(device: str, side: FlatSide, lens: Any) -> None:
    cam = camera(60.0, lens, (160, 120))
    model = EllipseModel.from_model(ExactModel(cam, prism(2.0, side), 0.2), device)
    xy, theta = samples(cam)
    points, angles = on(device, xy, theta)
    seen = model.compensate_points(points, angles)
    assert distance(model.deflect_points(seen, angles).numpy(), xy).max() < ATOL
    exact = oracle.move(cam, prism(2.0, side), xy, theta, to_scene=True, phase=0.2)
    assert distance(seen.numpy(), exact).max() < 1.0


def test_ellipse_of_the_other_models() -> None:
    cam = camera(60.0, None, (160, 120))
    for name in ("circle", "radial"):
        model = MODELS[name].from_prism(cam, prism(1.0), phase=0.1)
        assert not isinstance(model, EllipseModel)
        ellipse = EllipseModel.from_model(model)
        xy, theta = samples(cam, 500)
        assert (
            distance(ellipse.compensate_points(xy, theta), model.compensate_points(xy, theta)).max()
            < 0.1
        )


@pytest.mark.parametrize("name", ["vibration", "mirror", "steerer", "risley", "ellipse"])
def test_ellipse_of_another_optic_is_refused(name: str) -> None:
    pair = replace(prism(1.0), second=prism(0.5))
    model = MODELS[name].from_values(
        camera(60.0, None, (16, 12)), pair, MODELS[name].start_values(pair)
    )
    with pytest.raises(
        AmiwarpError, match=f"the {name} model cannot be fitted by ellipses; give a model of one"
    ):
        EllipseModel.from_model(model)


def test_ellipse_keeps_invalid_pixels_invalid_and_in_bounds(device: str) -> None:
    """If the lens folds inside the image, corners have no ray. No read beyond the tables happens there."""
    cam = camera(90.0, RadialTangential(k1=-0.4), (64, 48))
    model = EllipseModel.from_model(ExactModel(cam, prism(1.0)), device)
    broken = [[math.nan, 3.0], [3.0, math.nan], [math.inf, 1.0], [1e30, 0.0]]
    xy = np.array([[0.0, 0.0], [0.5, 0.5], *broken, [31.0, 23.0], [31.5, 23.0]])
    points, angles = on(device, xy, np.zeros(len(xy)))
    valid = [False] * 6 + [True] * 2
    for move in (model.compensate_points, model.deflect_points):
        got = move(points, angles).numpy()
        np.testing.assert_array_equal(np.isfinite(got).all(axis=1), valid)
        np.testing.assert_array_equal(np.isnan(got).all(axis=1), np.logical_not(valid))


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (5, 1), (2, 2)])
@pytest.mark.parametrize("name", list(rungs()))
def test_tiny_images(size: tuple[int, int], name: str) -> None:
    cam = camera(40.0, None, size)
    model = MODELS[name].from_prism(cam, glass(name))
    xy = np.array([[0.0, 0.0], [size[0] - 1.0, size[1] - 1.0], [0.3, 0.1]])
    theta = np.array([0.0, 1.0, 2.0])
    seen = model.compensate_points(xy, theta)
    assert distance(model.deflect_points(seen, theta), xy).max() < 1e-4
    if MODELS[name].GLASS is Prism:
        assert distance(seen, ExactModel(cam, prism(1.0)).compensate_points(xy, theta)).max() < 0.1
        # Px; 1 x 5 pixels span 110 degrees
        assert predicted_error(model, ExactModel(cam, prism(1.0))).worst < 0.2


def test_fit_recovers_a_known_field() -> None:
    """The fit to random pairs of a known field of degree 2 with 0.1 px of noise is ten times better than the noise."""
    cam = camera(60.0, None, (160, 120))
    rng = np.random.default_rng(3)
    xy, theta = samples(cam, 20_000)
    u, v = (2.0 * xy / [159.0, 119.0] - 1.0).T
    field = {
        "offset": np.stack([0.1 * u - 0.2 * v, 0.3 * u * v], axis=1),
        "cosine": np.stack([5.0 + u**2, 0.5 * u * v], axis=1),
        "sine": np.stack([0.4 * u, 5.0 - v**2], axis=1),
    }
    moved = (
        xy
        + field["offset"]
        + field["cosine"] * np.cos(theta)[:, None]
        + field["sine"] * np.sin(theta)[:, None]
    )
    noisy = moved + rng.normal(0.0, 0.1, moved.shape)
    noisy[::100] = np.nan
    theta = theta.copy()
    theta[1::100] = np.nan
    model = EllipseModel.fit(cam, xy, theta, noisy, degree=2)
    whole = (xy == np.round(xy)).all(axis=1)
    at = xy[whole].astype(int)
    for name, values in field.items():
        table = getattr(model, name)[at[:, 1], at[:, 0]]
        np.testing.assert_allclose(table, values[whole], rtol=0, atol=0.02)
    known = np.isfinite(theta)
    assert distance(model.compensate_points(xy[known], theta[known]), moved[known]).max() < 0.03


def test_fit_of_a_real_prism_needs_no_optics() -> None:
    cam, wedge = camera(60.0, BARREL, (160, 120)), prism(1.0)
    xy, theta = samples(cam, 5000)
    model = EllipseModel.fit(
        cam, xy, theta, oracle.move(cam, wedge, xy, theta, to_scene=True, phase=0.4)
    )
    assert predicted_error(model, ExactModel(cam, wedge, 0.4)).rms < 0.03


def test_fit_says_when_pairs_do_not_determine_it() -> None:
    xy, theta = samples(camera(), 30)
    with pytest.raises(AmiwarpError, match="30 pairs determine 30 of 45"):
        EllipseModel.fit(camera(), xy, theta, xy)
    with pytest.raises(AmiwarpError, match="spread them over the image and the angles"):
        EllipseModel.fit(
            camera(), *(samples(camera(), 500)[0], np.zeros(500)), samples(camera(), 500)[0]
        )


def test_fit_leaves_out_pairs_that_are_not_finite() -> None:
    cam, wedge = camera(60.0, None, (64, 48)), prism(1.0)
    xy, theta = samples(cam, 600)
    moved = oracle.move(cam, wedge, xy, theta, to_scene=True)
    expected = EllipseModel.fit(cam, xy[3:], theta[3:], moved[3:], degree=2)
    xy[0], theta[1], moved[2] = np.nan, np.inf, np.nan
    found = EllipseModel.fit(cam, xy, theta, moved, degree=2)
    np.testing.assert_allclose(found.cosine, expected.cosine, rtol=0, atol=1e-6)  # px
    with pytest.raises(AmiwarpError, match="600 pairs hold no finite values"):
        EllipseModel.fit(cam, xy, theta * np.nan, moved)
    moved[3] = 1e300
    with pytest.raises(
        AmiwarpError, match=r"lies 1e\+300 px from the origin; give pixels within 65536 px"
    ):
        EllipseModel.fit(cam, xy, theta, moved)


# -- invalid rays


@pytest.mark.parametrize("side", SIDES)
def test_grazing_rays_end_where_the_trace_ends(device: str, side: FlatSide) -> None:
    """Thick wedge, 170 degree lens: rays with total reflection and rays that miss a face are NaN, the others exact."""
    focal = 640 / math.radians(170.0)
    cam = Camera(640, 640, focal, focal, 319.5, 319.5, Fisheye())
    wedge = Prism(math.radians(20.0), 1.5, side)
    xy, theta = samples(cam, 20_000)
    points, angles = on(device, xy, theta)
    model = ExactModel(cam, wedge)
    for to_scene, move in ((True, model.compensate_points), (False, model.deflect_points)):
        got, expected = (
            move(points, angles).numpy(),
            oracle.move(cam, wedge, xy, theta, to_scene=to_scene),
        )
        lost = np.isnan(expected).all(axis=1)
        assert 500 < lost.sum() < 15_000
        assert (
            np.isnan(got).all(axis=1) != lost
        ).sum() <= 5  # float32 differs from float64 at the very limit
        both = np.isfinite(got).all(axis=1) & ~lost
        assert np.quantile(distance(got[both], expected[both]), 0.99) < ATOL


@pytest.mark.parametrize("name", list(rungs()))
def test_broken_rows_stay_alone(device: str, name: str) -> None:
    cam = camera(60.0, BARREL, (64, 48))
    model = MODELS[name].from_prism(cam, glass(name))
    xy = np.array([[5.0, 6.0], [math.nan, 6.0], [5.0, 6.0], [5.0, 6.0]])
    points, angles = on(device, xy, np.array([0.1, 0.1, math.nan, 0.1]))
    for move in (model.compensate_points, model.deflect_points):
        got = move(points, angles).numpy()
        np.testing.assert_array_equal(np.isnan(got).all(axis=1), [False, True, True, False])
        np.testing.assert_array_equal(got[0], got[3])


@pytest.mark.parametrize("side", SIDES)
def test_radial_circle_never_returns_an_unsolved_point(device: str, side: FlatSide) -> None:
    """Near the horizon the iteration may not converge. Such points are NaN, not approximations."""
    focal = 640 / math.radians(178.0)
    cam = Camera(640, 640, focal, focal, 319.5, 319.5, Fisheye())
    model = RadialCircleModel.from_prism(cam, prism(2.0, side))
    xy, theta = samples(cam, 20_000)
    points, angles = on(device, xy, theta)
    direct, solved = model.compensate_points, model.deflect_points
    if side is FlatSide.CAMERA:
        direct, solved = solved, direct
    found = solved(points, angles)
    back = direct(found, angles).numpy()
    valid = np.isfinite(back).all(axis=1)
    assert 0.5 < valid.mean() < 1.0
    assert distance(back[valid], xy[valid]).max() < 0.5


# -- predicted error


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("lens", [None, BARREL], ids=str)
def test_predicted_error_is_that_of_a_dense_independent_evaluation(
    side: FlatSide, lens: Any
) -> None:
    cam, wedge = camera(60.0, lens, (320, 240)), prism(1.0, side)
    xy, theta = lattice(cam, 28, 21)
    rays = oracle.pixels_to_rays(cam, xy)
    sign = 1.0 if side is FlatSide.SCENE else -1.0
    circle = oracle.rays_to_pixels(cam, oracle.turn(rays, theta, sign * math.radians(1.0)))
    error = distance(circle, oracle.move(cam, wedge, xy, theta, to_scene=True))
    got = predicted_error(CircleModel.from_prism(cam, wedge), ExactModel(cam, wedge))
    assert got.rms == pytest.approx(math.sqrt(np.mean(error**2)), abs=0.1 * got.rms)
    assert got.worst == pytest.approx(error.max(), abs=0.05 * got.worst)
    assert got.lag == 0.0


def test_predicted_error_removes_a_lag() -> None:
    cam, wedge = camera(60.0, None, (160, 120)), prism(1.0)
    got = predicted_error(ExactModel(cam, wedge, 0.3), ExactModel(cam, wedge), remove_lag=True)
    assert got.lag == pytest.approx(0.3, abs=1e-3)
    assert got.worst < 5e-3
    far = predicted_error(ExactModel(cam, wedge, 3.0), ExactModel(cam, wedge), remove_lag=True)
    assert far.rms < 5e-3
    assert predicted_error(ExactModel(cam, wedge, 0.3), ExactModel(cam, wedge)).rms > 0.5


def test_predicted_error_needs_a_common_point() -> None:
    cam = Camera(8, 8, 4.0, 4.0, 400.0, 3.5, RadialTangential(k1=-0.4))
    with pytest.raises(AmiwarpError, match="no valid point in common"):
        predicted_error(CircleModel(cam, 0.01), ExactModel(cam, prism(1.0)))


# -- arrays in and out


@pytest.mark.parametrize("name", list(rungs()))
def test_same_kind_out_and_untouched(name: str) -> None:
    model: Model = MODELS[name].from_prism(camera(60.0, None, (64, 48)), glass(name))
    xy = np.array([[1, 2], [3, 4]])
    theta = np.array([0.0, 100.0])
    for dtype, wanted in (
        (np.float64, np.float64),
        (np.float32, np.float32),
        (np.uint16, np.float32),
    ):
        given = xy.astype(dtype)
        got = model.compensate_points(given, theta)
        assert isinstance(got, np.ndarray)
        assert got.dtype == wanted
        np.testing.assert_array_equal(given, xy)
    np.testing.assert_array_equal(theta, [0.0, 100.0])
    assert model.deflect_points(np.empty((0, 2)), np.empty(0)).shape == (0, 2)
    points, angles = on("cpu", xy, theta)
    assert isinstance(model.compensate_points(points, angles), wp.array)
    np.testing.assert_array_equal(points.numpy(), xy)


def test_wrong_arrays_are_named() -> None:
    model = CircleModel(camera(), 0.01)
    with pytest.raises(AmiwarpError, match=r"give \(n, 2\) and \(n,\)"):
        model.compensate_points(np.zeros((3, 2)), np.zeros(2))
    with pytest.raises(AmiwarpError, match=r"give \(n, 2\) and \(n,\)"):
        model.compensate_points(np.zeros(3), np.zeros(3))
    points, angles = on("cpu", np.zeros((3, 2)), np.zeros(3))
    with pytest.raises(AmiwarpError, match="give theta as a float32 Warp array"):
        model.compensate_points(points, np.zeros(3))
    with pytest.raises(AmiwarpError, match="give vec2"):
        model.compensate_points(points, angles[:2])


def test_wrap_angle_before_rounding() -> None:
    angle = np.array([0.5, -np.pi, np.pi, 0.5 + 2e7 * np.pi])
    np.testing.assert_allclose(wrap_angle(angle), [0.5, -np.pi, -np.pi, 0.5], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    "model",
    [
        ExactModel(Camera(20, 10, 30.0, 30.0, 9.5, 4.5), Prism(0.03), 0.7),
        ExactModel(
            Camera(20, 10, 30.0, 30.0, 9.5, 4.5),
            Prism(0.03, 1.6, FlatSide.CAMERA),
            -2.7,
            (0.02, -0.01),
        ),
        ExactModel(
            Camera(20, 10, 30.0, 30.0, 9.5, 4.5),
            Prism(0.03),
            0.7,
            (0.02, 0.0),
            (0.01, -0.02),
            (-0.03, 0.04),
        ),
        CircleModel(Camera(20, 10, 30.0, 30.0, 9.5, 4.5), 0.013, 1.1),
        RadialCircleModel(Camera(20, 10, 30.0, 30.0, 9.5, 4.5), 0.013, 1.1, 1.6, FlatSide.CAMERA),
    ],
)
def test_kernel_values_are_the_fields_of_the_struct(
    model: ExactModel | CircleModel | RadialCircleModel,
) -> None:
    params = model.params("cpu")
    row = wp.zeros(1, dtype=params._cls, device="cpu").numpy()
    row[0] = model.kernel_values()
    assert row.tobytes() == bytes(params.__ctype__())
    side = 1.0 if getattr(model, "prism", model).flat_side is FlatSide.SCENE else -1.0
    expected = {
        "phase": model.phase,
        "phase_cos": math.cos(model.phase),
        "phase_sin": math.sin(model.phase),
    }
    if isinstance(model, ExactModel):
        apex, tilted = model.prism.apex, any(model.tilt)
        expected |= {
            "sin_apex": math.sin(apex),
            "cos_apex": math.cos(apex),
            "index2": model.prism.index**2,
        }
        expected |= {"flat_to_scene": (1 + side) / 2, "tilted": int(tilted)}
        angle, (x, y) = math.atan(math.hypot(*model.wobble)), model.wobble
        expected |= {
            "uneven": int(angle > 0.0),
            "cylinder_x": model.cylinder[0],
            "cylinder_y": model.cylinder[1],
        }
        expected |= {"wobble_sine": math.sin(angle), "wobble_versine": 1.0 - math.cos(angle)}
        expected |= {
            "wobble_cos": x / math.tan(angle) if angle else 1.0,
            "wobble_sin": y / math.tan(angle or 1.0),
        }
        assert np.allclose(row["axis"][0], np.eye(3), atol=1e-9) != tilted
    elif isinstance(model, CircleModel):
        expected |= {
            "sine": side * math.sin(model.deflection),
            "versine": 1.0 - math.cos(model.deflection),
        }
    else:
        expected |= {"deflection": side * model.deflection, "index": model.index}
    for name, value in expected.items():
        assert float(row[name][0]) == pytest.approx(value, rel=1e-5), name


def test_several_models_in_one_call_equal_one_call_each() -> None:
    """Successive places of one model share a launch; models may have different lenses."""
    cam, wedge = camera(), prism()
    a, b = ExactModel(cam, wedge, phase=0.2), ExactModel(cam, wedge, phase=0.9)
    c = RadialCircleModel.from_prism(cam, wedge)
    d = ExactModel(replace(cam, fx=1.5 * cam.fx), wedge, phase=0.2)
    rng = np.random.default_rng(0)
    xy, theta = rng.uniform(0.0, 48.0, (50, 2)), rng.uniform(-3.0, 3.0, (8, 50))
    models = [a, a, b, d, c, c, d, a]
    expected = [
        compensate_by_each([model], xy, angle)[0]
        for model, angle in zip(models, theta, strict=True)
    ]
    np.testing.assert_array_equal(compensate_by_each(models, xy, theta), expected)


# -- rotation of the camera


def test_a_rotation_is_the_integral_of_its_velocity() -> None:
    """About any reference time; the velocity is linear in time."""
    rotation = CameraRotation((0.4, -0.6, 0.9), (2.0, 1.0, -3.0), middle_us=50_000)
    tau = np.linspace(-0.04, 0.07, 1101)
    velocity = np.asarray(rotation.angular_velocity) + np.outer(tau, rotation.angular_acceleration)
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(tau)[:, None]
    travelled = rotation.rotation(tau) - rotation.rotation(tau[:1])
    np.testing.assert_allclose(travelled[1:], np.cumsum(steps, axis=0), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(rotation.rotation(np.zeros(1)), np.zeros((1, 3)))
    later = rotation.about(80_000)
    assert later.middle_us == 80_000
    expected = rotation.rotation(tau + 0.03) - rotation.rotation(np.array([0.03]))
    np.testing.assert_allclose(later.rotation(tau), expected, rtol=0, atol=1e-12)


def test_a_growth_may_be_expressed_about_any_time() -> None:
    growing = CameraRotation(growth=1.6, middle_us=50_000)
    later, tau = growing.about(80_000), np.linspace(-0.04, 0.07, 12)
    whole, part = 1.0 - growing.growth * (tau + 0.03), 1.0 - growing.growth * 0.03
    np.testing.assert_allclose(1.0 - later.growth * tau, whole / part, rtol=1e-12)
    assert growing.about(650_000).growth == pytest.approx(1.6 / 0.04)
    with pytest.raises(
        AmiwarpError, match=r"growth 1.6 1/s the camera reaches the scene 0.625 s after 50000 us"
    ):
        growing.about(675_000)


def test_a_rotation_moves_if_it_turns_or_accelerates() -> None:
    assert CameraRotation().moves is False
    assert CameraRotation(angular_velocity=(0.0, 1e-6, 0.0)).moves is True
    assert CameraRotation(angular_acceleration=(0.0, 0.0, 1e-6)).moves is True
    assert CameraRotation(growth=1e-6).moves is True
    assert CameraRotation(path=SWING).moves is True


def test_the_reach_of_a_pan_is_that_of_the_border() -> None:
    """A pan by an angle moves the centre by fx·tan of it, the edge by more, and corners also up or down."""
    camera = Camera.from_fov(201, 101, math.radians(60.0))
    pan = CameraRotation(angular_velocity=(0.0, 0.5, 0.0))
    angle, edge = 0.5 * 0.1, math.atan(100 / camera.fx)
    reach = pan.reach(camera, 0.1)
    assert reach[0] == pytest.approx(
        camera.fx * (math.tan(edge + angle) - math.tan(edge)), abs=1e-2
    )
    corner = 50.0 * (math.cos(edge) / math.cos(edge + angle) - 1.0)
    assert reach[1] == pytest.approx(corner, abs=1e-2)
    np.testing.assert_array_equal(CameraRotation().reach(camera, 0.1), np.zeros(2))
    assert CameraRotation(angular_acceleration=(0.0, 100.0, 0.0)).reach(camera, 0.1)[0] > reach[0]
    np.testing.assert_allclose(
        CameraRotation(growth=2.0).reach(camera, 0.1), [20.0, 10.0], atol=1e-3
    )
    # Before it
    np.testing.assert_allclose(
        CameraRotation(growth=2.0).reach(camera, 0.6), [120.0, 60.0], atol=1e-3
    )
    flipped = CameraRotation(angular_velocity=(0.0, math.pi, 0.0))
    np.testing.assert_array_equal(flipped.reach(camera, 1.0), [201.0, 101.0])


SWING = RotationPath.from_rates(
    np.array([-200_000, 0, 200_000]),
    np.array([[1.0, -2.0, 0.5], [-0.5, 1.0, 0.0], [0.3, 2.0, -1.0]]),
    (-200_000, 200_000),
)
"""Path of a camera whose axis of rotation changes."""


@wp.kernel
def undo_rotation(
    pinhole: PinholeParams,
    general: CameraParams,
    rotation: CameraRotationParams,
    time: float,
    xy: wp.array(dtype=wp.vec2),
    out: wp.array2d(dtype=wp.vec2),
):
    i = wp.tid()
    out[0, i] = undo_camera_rotation(pinhole, xy[i], rotation, time)
    out[1, i] = undo_camera_rotation(general, xy[i], rotation, time)


@pytest.mark.parametrize("growth", [0.0, 1.5])
@pytest.mark.parametrize("path", [None, SWING])
@pytest.mark.parametrize("turns", [False, True])
def test_a_rotation_is_undone_as_the_rotation_of_bearings(
    device: str, turns: bool, growth: float, path: RotationPath | None
) -> None:
    """And a forward motion as one towards a plane.

    For a camera without distortion, whose principal point lies off the centre and whose pixels are not square.
    """
    camera = Camera(201, 101, 150.0, 140.0, 90.0, 55.0)
    rotation = CameraRotation((0.4, -0.6, 0.9), (2.0, 1.0, -3.0)) if turns else CameraRotation()
    rotation = replace(rotation, growth=growth, path=path)
    xy = np.array([[0.0, 0.0], [200.0, 0.0], [90.0, 55.0], [17.5, 80.25], [0.0, 100.0]])
    out = wp.zeros((2, len(xy)), dtype=wp.vec2, device=device)
    for time in (-0.1, 0.0, 0.15):
        inputs = [pinhole_params(camera), camera_params(camera, device), rotation.params(device), time,
                  wp.array(xy.astype(np.float32), dtype=wp.vec2, device=device)]  # fmt: skip
        wp.launch(undo_rotation, len(xy), inputs=inputs, outputs=[out], device=device)
        rays = np.column_stack([(xy - [90.0, 55.0]) / [150.0, 140.0], np.ones(len(xy))])
        turned = Rotation.from_rotvec(rotation.rotation(np.array([time]))[0]).apply(rays)
        plane = turned / turned[:, 2:]
        # At the time 0 the plane is farther away
        plane[:, 2] += growth * time / (1.0 - growth * time)
        expected = plane[:, :2] / plane[:, 2:] * [150.0, 140.0] + [90.0, 55.0]
        np.testing.assert_allclose(out.numpy(), [expected, expected], rtol=0, atol=1e-3)  # px
    if growth:  # the camera has passed the plane
        inputs[3] = 0.7
        wp.launch(undo_rotation, len(xy), inputs=inputs, outputs=[out], device=device)
        assert np.isnan(out.numpy()).all()


def test_bounds_lie_about_the_value() -> None:
    camera, prism = Camera.from_fov(64, 48, 1.0), Prism(0.02)
    half = next(p.half_range for p in ExactModel.PARAMETERS if p.name == "tilt_x")
    assert ExactModel.default_bounds("tilt_x", 0.5 * half, camera, prism) == (
        -0.5 * half,
        1.5 * half,
    )
    pair = replace(prism, second=Prism(0.01))
    assert RisleyModel.default_bounds("second_apex", 0.01, camera, pair) == (0.0, 0.02)
    low, high = RisleyModel.default_bounds("second_phase", 0.3, camera, pair)
    assert -low == high == math.pi
