"""The camera: OpenCV's lens polynomials and their inverses against the float64 reference, and pixels without a ray."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from amiwarp import AmiwarpError, Camera, Distortion, ExactModel, Fisheye, Prism, RadialTangential
from amiwarp.kernels.camera import CameraParams, camera_params, fold_radius, solve_ray
from reference import optics as oracle

# as in the package's kernels; otherwise a GPU would fuse multiplications and additions in this module only
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

DAVIS = Camera(
    240, 180, 199.092366542, 198.82882047, 132.192071378, 110.712660011,
    RadialTangential(-0.368436311798, 0.150947243557, -0.000296130534385, -0.000759431726241, 0.0),
)  # fmt: skip
"""The DAVIS240C of the public recording shapes_rotation, with a barrel distortion typical of event cameras."""

LENSES: list[Distortion | None] = [
    None,
    DAVIS.distortion,
    RadialTangential(-0.4, 0.2, 1e-3, -2e-3, -0.05),
    RadialTangential(0.3, 0.5, -5e-3, 5e-3, 0.5),
    RadialTangential(0.9, 0.2, 1e-3, -2e-3, 0.01, 1.2, 0.4, 0.03),
    Fisheye(-0.01, 0.005, -0.002, 0.0003),
    Fisheye(0.3, 0.1, 0.0, 0.0),
]
ATOL = 3e-4  # px; measured 1.2e-4 at 640 x 480


def camera(lens: Distortion | None, *, fov_deg: float = 60.0) -> Camera:
    return Camera.from_fov(640, 480, math.radians(fov_deg), lens)


def pixels(cam: Camera, *, count: int = 2000, whole: bool = False) -> np.ndarray:
    """Random pixels of the image that float32 represents exactly, as float64 (n, 2)."""
    xy = (
        np.random.default_rng(0)
        .uniform(0.0, [cam.width - 1, cam.height - 1], (count, 2))
        .astype(np.float32)
    )
    return (np.round(xy) if whole else xy).astype(np.float64)


def distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.asarray(a, dtype=np.float64) - b, axis=1)


@wp.kernel
def solve_each_pixel(c: CameraParams, rays: wp.array2d(dtype=wp.vec3)):
    row, col = wp.tid()
    rays[row, col] = solve_ray(c, wp.vec2(float(col), float(row)))


def test_oracle_gives_the_published_polynomial() -> None:
    """Computed by hand from OpenCV's formula: r² = 0.3125, radial factor 0.948791504."""
    lens = RadialTangential(k1=-0.2, k2=0.1, p1=0.001, p2=-0.002, k3=0.05)
    got = oracle.distort_radial_tangential(lens, np.array([[0.5, -0.25]]))
    np.testing.assert_allclose(got, [[0.472520752, -0.236260376]], rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES, ids=str)
@pytest.mark.parametrize("whole", [True, False])
def test_pixels_to_rays_meets_the_oracle(device: str, lens: Distortion | None, whole: bool) -> None:
    cam = camera(lens)
    xy = pixels(cam, whole=whole)
    rays = cam.pixels_to_rays(wp.array(xy.astype(np.float32), dtype=wp.vec2, device=device))
    assert rays.dtype is wp.vec3
    assert str(rays.device) == device
    np.testing.assert_allclose(np.linalg.norm(rays.numpy(), axis=1), 1.0, rtol=0, atol=3e-7)
    np.testing.assert_allclose(
        rays.numpy(), oracle.pixels_to_rays(cam, xy), rtol=0, atol=ATOL / cam.fx
    )


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_rays_to_pixels_meets_the_oracle(device: str, lens: Distortion | None) -> None:
    cam = camera(lens)
    xy = pixels(cam)
    rays = oracle.pixels_to_rays(cam, xy).astype(np.float32)
    got = cam.rays_to_pixels(wp.array(rays, dtype=wp.vec3, device=device)).numpy()
    assert distance(got, oracle.rays_to_pixels(cam, rays)).max() < ATOL
    assert distance(got, xy).max() < ATOL


@pytest.mark.parametrize("whole", [True, False])
def test_newton_converges_everywhere_in_a_real_barrel(whole: bool) -> None:
    y, x = np.mgrid[: DAVIS.height, : DAVIS.width]
    xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64) + (0.0 if whole else 0.25)
    back = DAVIS.rays_to_pixels(DAVIS.pixels_to_rays(xy))
    assert distance(back, xy).max() < 1e-4
    angle = np.degrees(np.arccos(DAVIS.pixels_to_rays(np.array([[0.0, 0.0]]))[0, 2]))
    # Degrees off the axis at the farthest corner; 40.9 without distortion
    assert 45.0 < angle < 50.0


def test_real_calibration_file_is_the_camera_above(data_dir: Path) -> None:
    values = [
        float(v) for v in (data_dir / "text" / "shapes_rotation" / "calib.txt").read_text().split()
    ]
    lens = DAVIS.distortion
    assert isinstance(lens, RadialTangential)
    assert values == [
        DAVIS.fx,
        DAVIS.fy,
        DAVIS.cx,
        DAVIS.cy,
        lens.k1,
        lens.k2,
        lens.p1,
        lens.p2,
        lens.k3,
    ]


@pytest.mark.parametrize("seed", range(10))
def test_inverse_agrees_with_bisection_for_wild_lenses(seed: int) -> None:
    """Strong lenses of every sign, some folding inside the image: same rays and same missing rays as the reference."""
    rng = np.random.default_rng(seed)
    lenses: list[Distortion] = [
        RadialTangential(*(rng.uniform(-1, 1, 5) * [0.6, 0.5, 0.01, 0.01, 0.3])),
        RadialTangential(*(rng.uniform(-1, 1, 8) * [0.6, 0.5, 0.01, 0.01, 0.3, 0.6, 0.5, 0.3])),
        Fisheye(*(rng.uniform(-1, 1, 4) * [0.4, 0.3, 0.2, 0.1])),
    ]
    for lens in lenses:
        cam = camera(lens, fov_deg=rng.uniform(40, 110))
        xy = pixels(cam, count=400)
        rays = cam.pixels_to_rays(xy)
        expected = oracle.pixels_to_rays(cam, xy)
        np.testing.assert_array_equal(np.isnan(rays), np.isnan(expected))
        valid = np.isfinite(rays[:, 0])
        assert valid.any()
        assert distance(oracle.rays_to_pixels(cam, rays[valid]), xy[valid]).max() < ATOL


@pytest.mark.parametrize("lens", [lens for lens in LENSES if lens is not None], ids=str)
def test_table_of_bearings_is_what_the_solver_gives(device: str, lens: Distortion) -> None:
    params = camera_params(Camera.from_fov(64, 48, 1.2, lens), device)
    solved = wp.empty((48, 64), dtype=wp.vec3, device=device)
    wp.launch(solve_each_pixel, dim=(48, 64), inputs=[params], outputs=[solved], device=device)
    np.testing.assert_array_equal(params.rays.numpy(), solved.numpy())


def test_fold_is_the_first_root_of_the_slope() -> None:
    assert fold_radius(-0.4, 0.0, 0.0, largest=100.0) == pytest.approx(
        1.0 / math.sqrt(1.2), abs=1e-12
    )
    assert fold_radius(0.3, 0.2, 0.0, largest=100.0) == 100.0
    # The slope's smallest value is 0.6
    assert fold_radius(-0.368, 0.151, 0.0, largest=100.0) == 100.0
    assert fold_radius(0.0, 0.0, 0.0, largest=1.5) == 1.5
    assert fold_radius(-0.4, 0.0, 5e-324, largest=100.0) == pytest.approx(
        1.0 / math.sqrt(1.2), abs=1e-12
    )
    for below in (
        (-0.3, 0.1, 0.0),
        (1.2, 0.4, 0.03),
        (0.0, 0.0, -0.1),
    ):  # the last two fold, and have a pole
        assert fold_radius(0.1, -0.1, 0.02, below=below, largest=10.0) == pytest.approx(
            oracle.monotonic_limit(0.1, -0.1, 0.02, below=below, largest=10.0), abs=1e-9
        )
    k = (0.3, -0.5, 0.01)
    assert fold_radius(*k, largest=100.0) == pytest.approx(
        oracle.monotonic_limit(*k, largest=100.0), abs=1e-9
    )


@pytest.mark.parametrize("lens", [RadialTangential(k1=-0.4), Fisheye(k1=-0.3)], ids=str)
def test_folded_distortion_is_invalid_not_wrong(device: str, lens: Distortion) -> None:
    """A barrel distortion without k2 folds back. Beyond the fold no ray has a pixel, and no pixel a ray."""
    cam = camera(lens)
    limit = oracle.lens_limit(cam)
    angles = np.array([0.99, 1.01]) * (
        math.atan(limit) if isinstance(lens, RadialTangential) else limit
    )
    rays = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1).astype(np.float32)
    got = cam.rays_to_pixels(wp.array(rays, dtype=wp.vec3, device=device)).numpy()
    assert np.isfinite(got[0]).all()
    assert np.isnan(got[1]).all()
    edge = cam.fx * oracle.polynomial(np.array(limit), lens.k1)
    xy = np.array(
        [[cam.cx + 0.99 * edge, cam.cy], [cam.cx + 1.01 * edge, cam.cy]], dtype=np.float32
    )
    bearings = cam.pixels_to_rays(wp.array(xy, dtype=wp.vec2, device=device)).numpy()
    assert np.isfinite(bearings[0]).all()
    assert np.isnan(bearings[1]).all()


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_rays_behind_and_broken_rows_are_invalid_alone(
    device: str, lens: Distortion | None
) -> None:
    cam = camera(lens)
    nan = math.nan
    rays = np.array(
        [
            [0, 0, 1],
            [0, 0, -1],
            [1, 0, 0],
            [0.1, 0, -0.9],
            [nan, 0, 1],
            [0, 0, nan],
            [0, 0, 0],
            [0, 0, 2],
        ]
    )
    got = cam.rays_to_pixels(
        wp.array(rays.astype(np.float32), dtype=wp.vec3, device=device)
    ).numpy()
    np.testing.assert_array_equal(
        np.isnan(got).all(axis=1), [False, True, True, True, True, True, True, False]
    )
    np.testing.assert_allclose(got[[0, 7]], [[cam.cx, cam.cy]] * 2, rtol=0, atol=1e-4)
    xy = np.array([[nan, 1.0], [1.0, nan], [math.inf, 0.0], [1.0, 1.0]], dtype=np.float32)
    bearings = cam.pixels_to_rays(wp.array(xy, dtype=wp.vec2, device=device)).numpy()
    np.testing.assert_array_equal(np.isnan(bearings).any(axis=1), [True, True, True, False])


def test_extreme_fisheye_reaches_the_horizon() -> None:
    """Equidistant lens, field of view 160 degrees: the round trip holds up to a pinhole tangent of 5.7."""
    focal = 640 / math.radians(160.0)
    cam = Camera(640, 480, focal, focal, 319.5, 239.5, Fisheye())
    xy = np.stack([np.linspace(0, 639, 641), np.full(641, 239.5)], axis=1)
    rays = cam.pixels_to_rays(xy)
    assert np.degrees(np.arccos(rays[0, 2])) == pytest.approx(80.0, abs=0.2)
    assert distance(cam.rays_to_pixels(rays), xy).max() < ATOL
    beyond = cam.pixels_to_rays(np.array([[319.5 + focal * math.pi / 2, 239.5]]))
    assert np.isnan(beyond).all()


@pytest.mark.parametrize("lens", LENSES, ids=str)
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (2, 2)])
def test_tiny_images(lens: Distortion | None, size: tuple[int, int]) -> None:
    cam = Camera.from_fov(*size, 0.8, lens)
    y, x = np.mgrid[: size[1], : size[0]]
    xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
    valid = np.isfinite(oracle.pixels_to_rays(cam, xy)).all(axis=1)
    back = cam.rays_to_pixels(cam.pixels_to_rays(xy))
    np.testing.assert_array_equal(np.isfinite(back).all(axis=1), valid)
    assert distance(back[valid], xy[valid]).max() < 1e-5


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint16])
def test_numpy_in_numpy_out_and_untouched(dtype: type) -> None:
    xy = np.array([[3, 4], [500, 20]], dtype=dtype)
    before = xy.copy()
    rays = DAVIS.pixels_to_rays(xy[:1])
    wanted = np.float32 if dtype is np.uint16 else dtype
    assert rays.dtype == wanted
    assert DAVIS.rays_to_pixels(rays).dtype == wanted
    np.testing.assert_array_equal(xy, before)
    assert DAVIS.pixels_to_rays(xy[:0]).shape == (0, 3)
    assert DAVIS.rays_to_pixels(rays[:0]).shape == (0, 2)


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(AmiwarpError, match=r"shape \(3, 3\); give \(n, 2\)"):
        DAVIS.pixels_to_rays(np.zeros((3, 3)))
    with pytest.raises(AmiwarpError, match=r"shape \(2,\); give \(n, 3\)"):
        DAVIS.rays_to_pixels(np.zeros(2))
    with pytest.raises(AmiwarpError, match="give vec2"):
        DAVIS.pixels_to_rays(wp.zeros(4, dtype=wp.vec3, device="cpu"))


def test_field_of_view_round_trip() -> None:
    cam = Camera.from_fov(640, 480, math.radians(75.0))
    assert math.degrees(cam.fov) == pytest.approx(75.0, abs=1e-12)
    assert (cam.cx, cam.cy) == (319.5, 239.5)
    edges = oracle.pixels_to_rays(cam, np.array([[-0.5, 239.5], [639.5, 239.5]]))
    assert math.degrees(math.acos(edges[0] @ edges[1])) == pytest.approx(75.0, abs=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"width": 0}, "width = 0 "),
        ({"fx": 0.0}, "fx = 0.0"),
        ({"fy": math.nan}, "fy = nan"),
        ({"cx": math.inf}, "cx = inf"),
        (
            {"distortion": "fisheye"},
            "distortion is 'fisheye'; expected RadialTangential, Fisheye or None",
        ),
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, Any], message: str) -> None:
    values: dict[str, Any] = {
        "width": 240,
        "height": 180,
        "fx": 200.0,
        "fy": 200.0,
        "cx": 120.0,
        "cy": 90.0,
    } | change
    with pytest.raises(AmiwarpError, match=message):
        Camera(**values)


@pytest.mark.parametrize("lens", [RadialTangential, Fisheye])
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e7, "0.1", None])
def test_impossible_lenses_are_refused(lens: Any, value: Any) -> None:
    with pytest.raises(AmiwarpError, match="distortion k2 = "):
        lens(k2=value)


@pytest.mark.parametrize("fov", [0.0, -1.0, 5e-324, 1e-300, math.pi, math.nan])
def test_impossible_field_of_view_is_refused(fov: float) -> None:
    with pytest.raises(AmiwarpError, match=r"field of view|fov = nan"):
        Camera.from_fov(640, 480, fov)


MATRIX = np.array([[520.0, 0.0, 322.0], [0.0, 521.5, 236.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("count", [0, 4, 5, 8])
def test_opencv_projects_what_the_camera_projects(count: int) -> None:
    cv2 = pytest.importorskip("cv2")
    dist = np.array([-0.3, 0.12, 1e-3, -2e-3, -0.02, -0.1, 0.05, -0.02])[:count]
    cam = Camera.from_opencv(MATRIX, dist[:, None] if count else None, (640, 480))
    assert (cam.distortion is None) == (count == 0)
    _check_projection(cam, lambda p, k, d: cv2.projectPoints(p, np.zeros(3), np.zeros(3), k, d)[0])


def test_opencv_projects_what_the_fisheye_projects() -> None:
    cv2 = pytest.importorskip("cv2")
    cam = Camera.from_opencv(
        MATRIX * [[0.5], [0.5], [1.0]], [[0.02, -0.01, 0.003, -0.001]], (320, 240), fisheye=True
    )
    assert cam.distortion == Fisheye(0.02, -0.01, 0.003, -0.001)
    _check_projection(
        cam, lambda p, k, d: cv2.fisheye.projectPoints(p, np.zeros(3), np.zeros(3), k, d)[0]
    )


def _check_projection(cam: Camera, project: Any) -> None:
    """The reference camera equals OpenCV's to 1e-6 px, the camera's own float32 kernels within their accuracy."""
    matrix, dist = cam.to_opencv()
    xy = pixels(cam, count=500)
    rays = oracle.pixels_to_rays(cam, xy)
    there = project((rays / rays[:, 2:])[:, None], matrix, dist)[:, 0]
    assert distance(there, xy).max() < 1e-6  # px
    assert distance(cam.rays_to_pixels(rays), there).max() < ATOL
    assert distance(cam.pixels_to_rays(xy), rays).max() < ATOL / cam.fx
    again = Camera.from_opencv(
        matrix, dist, (cam.width, cam.height), fisheye=isinstance(cam.distortion, Fisheye)
    )
    assert again == cam


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": np.eye(2)}, r"K has shape \(2, 2\); expected \(3, 3\)"),
        (
            {"K": MATRIX + 0.5 * np.eye(3, k=1) * [[1.0], [0.0], [0.0]]},
            "skew of 0.5 px; calibrate without skew",
        ),
        ({"K": MATRIX.T}, r"expected \[\[fx, 0, cx\]"),
        ({"dist": np.zeros(6)}, "6 distortion coefficients; expected 4, 5 or 8"),
        ({"dist": np.zeros((2, 2))}, r"shape \(2, 2\); expected \(n,\)"),
        ({"dist": [*np.zeros(11), 1e-3]}, "thin-prism"),
        (
            {"dist": np.zeros(5), "fisheye": True},
            "fisheye lens has 5 distortion coefficients; expected k1 k2 k3 k4",
        ),
        ({"dist": [0.1, np.nan, 0.0, 0.0]}, "distortion k2 = nan"),
        ({"size": (0, 480)}, "size"),
        ({"size": None}, "size"),
    ],
)
def test_impossible_opencv_cameras_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(AmiwarpError, match=message):
        Camera.from_opencv(**{"K": MATRIX, "dist": None, "size": (640, 480)} | change)


@pytest.mark.parametrize("apex_deg", [1.0, 2.0])
def test_lens_calibrations_through_a_standing_prism_average_to_the_camera(apex_deg: float) -> None:
    """OpenCV calibrates the lens from a board seen through the prism at four angles a quarter turn apart."""
    cv2 = pytest.importorskip("cv2")
    camera = Camera.from_fov(640, 480, math.radians(60))
    model = ExactModel(camera, Prism(math.radians(apex_deg)))
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    board = np.float32([[i - 4.5, j - 3.0, 0] for j in range(7) for i in range(10)]) * 0.03  # m
    rng = np.random.default_rng(0)
    found = []
    for theta in np.arange(4) * np.pi / 2:
        seen: list[np.ndarray] = []
        while len(seen) < 25:
            pose = rng.uniform(-0.6, 0.6, 3), rng.uniform([-0.2, -0.15, 0.3], [0.2, 0.15, 0.7])
            xy = cv2.projectPoints(board, *pose, matrix, None)[0][:, 0].astype(float)
            if ((xy > 5) & (xy < [634, 474])).all():
                seen.append(
                    model.deflect_points(xy, np.full(len(xy), theta)).astype(np.float32)[:, None]
                )
        _, fitted, *_ = cv2.calibrateCamera([board] * len(seen), seen, (640, 480), None, None)
        found.append(fitted[[0, 1, 0, 1], [0, 1, 2, 2]])
    true = [camera.fx, camera.fy, camera.cx, camera.cy]
    assert np.abs(found[0] - true).max() > 5  # px, at one angle
    np.testing.assert_allclose(np.mean(found, axis=0), true, rtol=0, atol=0.6)  # px
