"""Properties of every camera and prism in the supported range: field of view to 90 degrees, apex to 4 degrees."""

import math
from dataclasses import replace

import hypothesis.strategies as st
import numpy as np
from hypothesis import assume, given, settings

from amiwarp import (
    Camera,
    CircleModel,
    Distortion,
    ExactModel,
    Fisheye,
    FlatSide,
    Prism,
    RadialCircleModel,
    RadialTangential,
    apex_from_deflection,
    deflection_from_apex,
    predicted_error,
)
from amiwarp.optics import MODELS
from reference import optics as oracle

ATOL = 1e-3  # px, the documented limit for float32
COUNT = 300

quick = settings(max_examples=60)
few = settings(quick, max_examples=12)


def lens_radius(lens: Distortion | None, half_angle: float) -> float:
    """Return the distorted normalised radius of the ray at ``half_angle`` [rad]."""
    if isinstance(lens, Fisheye):
        return float(oracle.polynomial(np.array(half_angle), lens.k1, lens.k2, lens.k3, lens.k4))
    tangent = np.array(math.tan(half_angle))
    return float(oracle.polynomial(tangent, lens.k1, lens.k2, lens.k3) if lens else tangent)


def gentle(lens: Distortion | None, half_angle: float) -> bool:
    """Whether the scale out to ``half_angle`` is 0.4 to 2.5 times that of the centre, as for real lenses."""
    angles = np.linspace(0.01, half_angle, 50)
    radii = np.array([lens_radius(lens, a) for a in angles])
    slope = np.diff(radii) / np.diff(angles if isinstance(lens, Fisheye) else np.tan(angles))
    return bool(slope.min() > 0.4 and slope.max() < 2.5)


@st.composite
def cameras(draw: st.DrawFn, *, lenses: bool = True) -> Camera:
    """True horizontal field of view 20 to 90 degrees, lens included; sensors from 16 pixels to 1280."""
    width, height = draw(
        st.sampled_from([(16, 12), (240, 180), (346, 260), (640, 480), (1280, 720)])
    )
    half = math.radians(draw(st.floats(20.0, 90.0))) / 2.0
    small = st.floats(-0.005, 0.005)
    lens: Distortion | None = None
    kind = draw(st.sampled_from(["pinhole", "radial", "fisheye"])) if lenses else "pinhole"
    if kind == "radial":
        k1, k2, k3 = (
            draw(st.floats(*limits)) for limits in ((-0.45, 0.2), (-0.1, 0.25), (-0.05, 0.05))
        )
        lens = RadialTangential(k1, k2, draw(small), draw(small), k3)
    elif kind == "fisheye":
        lens = Fisheye(*(draw(st.floats(-limit, limit)) for limit in (0.1, 0.05, 0.02, 0.01)))
    corner = math.atan(math.tan(half) * math.hypot(width, height) / width)
    assume(gentle(lens, corner + math.radians(8.0)))
    focal = width / (2.0 * lens_radius(lens, half))
    aspect = draw(st.floats(0.98, 1.02))
    shift = draw(st.floats(-0.02, 0.02)) * width
    return Camera(
        width,
        height,
        focal,
        focal * aspect,
        (width - 1) / 2.0 + shift,
        (height - 1) / 2.0 - shift,
        lens,
    )


@st.composite
def prisms(draw: st.DrawFn) -> Prism:
    apex = math.radians(draw(st.floats(0.0, 4.0)))
    return Prism(apex, draw(st.floats(1.33, 1.9)), draw(st.sampled_from(FlatSide)))


tilts = st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
cylinders = st.tuples(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02))
wobbles = st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
phases = st.floats(-math.pi, math.pi)
seeds = st.integers(0, 2**32 - 1)


def samples(cam: Camera, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0.0, [cam.width - 1, cam.height - 1], (COUNT, 2)).astype(np.float32)
    xy[::2] = np.round(xy[::2])
    xy[:4] = [[0, 0], [cam.width - 1, 0], [0, cam.height - 1], [cam.width - 1, cam.height - 1]]
    return xy.astype(np.float64), rng.uniform(-np.pi, np.pi, COUNT)


def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a - b, axis=1)


@quick
@given(cam=cameras(), wedge=prisms(), tilt=tilts, phase=phases, seed=seeds)
def test_exact_model_is_the_trace(
    cam: Camera, wedge: Prism, tilt: tuple[float, float], phase: float, seed: int
) -> None:
    model = ExactModel(cam, wedge, phase, tilt)
    xy, theta = samples(cam, seed)
    for to_scene, move in ((True, model.compensate_points), (False, model.deflect_points)):
        expected = oracle.move(cam, wedge, xy, theta, to_scene=to_scene, phase=phase, tilt=tilt)
        got = move(xy, theta)
        assert np.isfinite(expected).all()
        assert distance(got, expected).max() < ATOL


@quick
@given(cam=cameras(), wedge=prisms(), cylinder=cylinders, wobble=wobbles, phase=phases, seed=seeds)
def test_an_uneven_prism_is_the_trace(
    cam: Camera,
    wedge: Prism,
    cylinder: tuple[float, float],
    wobble: tuple[float, float],
    phase: float,
    seed: int,
) -> None:
    uneven = {"cylinder": cylinder, "wobble": wobble}
    model = ExactModel(cam, wedge, phase, **uneven)
    xy, theta = samples(cam, seed)
    for to_scene, move in ((True, model.compensate_points), (False, model.deflect_points)):
        expected = oracle.move(cam, wedge, xy, theta, to_scene=to_scene, phase=phase, **uneven)
        assert np.isfinite(expected).all()
        assert distance(move(xy, theta), expected).max() < ATOL
    assert (
        distance(model.deflect_points(model.compensate_points(xy, theta), theta), xy).max() < ATOL
    )


@quick
@given(cam=cameras(), wedge=prisms(), tilt=tilts, seed=seeds)
def test_exact_model_round_trip(
    cam: Camera, wedge: Prism, tilt: tuple[float, float], seed: int
) -> None:
    model = ExactModel(cam, wedge, tilt=tilt)
    xy, theta = samples(cam, seed)
    assert (
        distance(model.deflect_points(model.compensate_points(xy, theta), theta), xy).max() < ATOL
    )
    assert (
        distance(model.compensate_points(model.deflect_points(xy, theta), theta), xy).max() < ATOL
    )


@quick
@given(cam=cameras(), wedge=prisms(), seed=seeds, name=st.sampled_from(["circle", "radial"]))
def test_circles_round_trip(cam: Camera, wedge: Prism, seed: int, name: str) -> None:
    model = MODELS[name].from_prism(cam, wedge)
    xy, theta = samples(cam, seed)
    assert (
        distance(model.deflect_points(model.compensate_points(xy, theta), theta), xy).max() < ATOL
    )


@quick
@given(cam=cameras(lenses=False), wedge=prisms(), turn=phases, seed=seeds)
def test_turning_camera_and_prism_together_turns_the_picture(
    cam: Camera, wedge: Prism, turn: float, seed: int
) -> None:
    """No direction is special: if image and prism rotate by one angle, the result rotates too."""
    cam = replace(cam, fy=cam.fx)
    xy, theta = samples(cam, seed)
    c, s = math.cos(turn), math.sin(turn)
    matrix, centre = np.array([[c, -s], [s, c]]), np.array([cam.cx, cam.cy])
    for name in ("circle", "radial", "exact"):
        model = MODELS[name].from_prism(cam, wedge)
        turned = model.compensate_points((xy - centre) @ matrix.T + centre, theta + turn)
        expected = (model.compensate_points(xy, theta) - centre) @ matrix.T + centre
        assert distance(turned, expected).max() < ATOL


@quick
@given(cam=cameras(), index=st.floats(1.33, 1.9), side=st.sampled_from(FlatSide), seed=seeds)
def test_a_plane_plate_moves_nothing(cam: Camera, index: float, side: FlatSide, seed: int) -> None:
    xy, theta = samples(cam, seed)
    for name in ("circle", "radial", "exact"):
        model = MODELS[name].from_prism(cam, Prism(0.0, index, side))
        assert distance(model.compensate_points(xy, theta), xy).max() < ATOL


@quick
@given(wedge=prisms())
def test_conversions_are_inverses(wedge: Prism) -> None:
    deflection = deflection_from_apex(wedge.apex, wedge.index, wedge.flat_side)
    assert math.isclose(
        apex_from_deflection(deflection, wedge.index, wedge.flat_side), wedge.apex, abs_tol=1e-12
    )
    assert abs(deflection - (wedge.index - 1.0) * wedge.apex) <= 2.0 * wedge.apex**3 + 1e-15


@few
@given(cam=cameras(), wedge=prisms())
def test_the_ladder_goes_up(cam: Camera, wedge: Prism) -> None:
    """δ(φ) is never worse than a single δ and keeps its second-order bound. The exact model has no error."""
    exact = ExactModel(cam, wedge)
    circle = predicted_error(CircleModel.from_prism(cam, wedge), exact, grid=8)
    radial = predicted_error(RadialCircleModel.from_prism(cam, wedge), exact, grid=8)
    assert radial.rms <= circle.rms + 1e-3
    assert radial.rms <= 0.6 * cam.fx * wedge.apex**2 + 1e-3
    assert predicted_error(exact, exact, grid=8).worst == 0.0
