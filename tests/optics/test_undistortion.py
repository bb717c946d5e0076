"""Events without the distortion of their lens, against the float64 reference and OpenCV."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from amiwarp import AmiwarpError, Camera, Distortion, Events, Fisheye, RadialTangential
from reference import optics as oracle

LENSES = [
    None,
    RadialTangential(-0.368, 0.151, -0.0003, -0.00076),
    RadialTangential(0.9, 0.2, 1e-3, -2e-3, 0.01, 1.2, 0.4, 0.03),
    Fisheye(-0.01, 0.005, -0.002, 0.0003),
]
ATOL = 6e-4  # px; twice as large as for one of the two steps in test_camera.py


def camera(lens: Distortion | None) -> Camera:
    return Camera(320, 240, 251.3, 249.7, 163.2, 117.9, lens)


def events_of(xy: np.ndarray) -> Events:
    n = len(xy)
    return Events(*np.ascontiguousarray(xy.T), np.arange(n), (np.arange(n) % 2).astype(np.uint8))


def some_events(cam: Camera, *, whole: bool) -> Events:
    xy = np.random.default_rng(3).uniform(0.0, [cam.width - 1, cam.height - 1], (3000, 2))
    return events_of(np.rint(xy).astype(np.uint16) if whole else xy.astype(np.float32))


@pytest.mark.parametrize("lens", LENSES, ids=str)
@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("own", [True, False])
def test_events_are_where_a_pinhole_camera_sees_them(
    lens: Distortion | None, whole: bool, own: bool
) -> None:
    cam = camera(lens)
    events = some_events(cam, whole=whole)
    target = None if own else Camera(200, 300, 180.0, 190.0, 90.5, 160.25)
    found = cam.undistort(events, target)
    pinhole = replace(cam, distortion=None) if target is None else target
    rays = oracle.pixels_to_rays(cam, np.stack([events.x, events.y], axis=1).astype(np.float64))
    wanted = oracle.rays_to_pixels(pinhole, rays)
    assert np.isfinite(wanted).all()
    np.testing.assert_allclose(np.stack([found.x, found.y], axis=1), wanted, rtol=0, atol=ATOL)
    assert found.x.dtype == found.y.dtype == np.float32
    assert found.t is events.t
    assert found.p is events.p


def test_opencv_undistorts_alike() -> None:
    cv2 = pytest.importorskip("cv2")
    cam = camera(LENSES[1])
    events = some_events(cam, whole=True)
    matrix, coefficients = cam.to_opencv()
    xy = np.stack([events.x, events.y], axis=1).astype(np.float64)
    steps = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    wanted = cv2.undistortPoints(xy[:, None], matrix, coefficients, None, None, matrix, steps)
    found = cam.undistort(events)
    np.testing.assert_allclose(np.stack([found.x, found.y], 1), wanted[:, 0], rtol=0, atol=ATOL)


def test_pixels_without_a_ray_are_nan_and_alone() -> None:
    folding = Camera(320, 240, 150.0, 150.0, 159.5, 119.5, RadialTangential(k1=-0.4))
    rays = oracle.pixels_to_rays(folding, np.array([[0.0, 0.0], [160.0, 120.0]]))
    assert np.isnan(rays[0]).all()
    for dtype in (np.uint16, np.float32):
        found = folding.undistort(events_of(np.array([[0, 0], [160, 120]], dtype)))
        assert np.isnan([found.x[0], found.y[0]]).all()
        np.testing.assert_allclose(found.x[1], 160.0, rtol=0, atol=0.01)
    lost = events_of(np.array([[np.nan, np.nan], [160.0, 120.0]], np.float32))
    assert np.isnan(folding.undistort(lost).x).tolist() == [True, False]


def test_a_wide_lens_ends_at_the_image_plane() -> None:
    """In an equidistant fisheye the angle is the radius, so its tangent is the place in a pinhole camera."""
    fisheye = Camera(321, 241, 100.0, 100.0, 160.0, 120.0, Fisheye(0.0))
    pinhole = Camera(321, 241, 300.0, 300.0, 160.0, 120.0)
    found = fisheye.undistort(events_of(np.array([[2, 120], [60, 120]], np.uint16)), pinhole)
    assert np.isnan(found.x[0])  # 1.58 rad, more than 90 deg
    assert abs(found.x[1] - (160.0 - 300.0 * math.tan(1.0))) < 2e-3


def test_empty_and_foreign_events() -> None:
    cam = camera(LENSES[1])
    assert len(cam.undistort(Events.empty())) == 0
    for x, y in ((320, 0), (0, 240)):
        with pytest.raises(AmiwarpError, match="give the camera of these events"):
            cam.undistort(events_of(np.array([[1, 1], [x, y]], np.uint16)))
