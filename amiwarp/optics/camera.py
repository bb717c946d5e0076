"""Camera: image size, pinhole intrinsics, lens distortion, and rotation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.validation import INT64, array, guarded, real, shown, vector, whole

# Models of lens distortion.

LARGEST_COEFFICIENT = 1e6
"""Largest accepted magnitude of a distortion coefficient. The coefficients of long lenses reach thousands."""


@guarded
@dataclass(frozen=True, slots=True)
class RadialTangential:
    """OpenCV's radial-tangential distortion, also with its rational model. The coefficients are in OpenCV's order.

    The radial factor is (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶).

    Examples
    --------
    >>> amiwarp.RadialTangential(k1=-0.3, k2=0.1)
    RadialTangential(k1=-0.3, k2=0.1, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0)
    """

    k1: float = 0.0
    """Radial coefficient of r²."""
    k2: float = 0.0
    """Radial coefficient of r⁴."""
    p1: float = 0.0
    """First tangential coefficient."""
    p2: float = 0.0
    """Second tangential coefficient."""
    k3: float = 0.0
    """Radial coefficient of r⁶."""
    k4: float = 0.0
    """Coefficient of r² in the denominator."""
    k5: float = 0.0
    """Coefficient of r⁴ in the denominator."""
    k6: float = 0.0
    """Coefficient of r⁶ in the denominator."""

    def __post_init__(self) -> None:
        _check_coefficients(self)


@guarded
@dataclass(frozen=True, slots=True)
class Fisheye:
    """OpenCV's fisheye (equidistant) distortion.

    Examples
    --------
    >>> amiwarp.Fisheye(k1=0.02)
    Fisheye(k1=0.02, k2=0.0, k3=0.0, k4=0.0)
    """

    k1: float = 0.0
    """Coefficient of θ³, with θ the angle between the ray and the optical axis."""
    k2: float = 0.0
    """Coefficient of θ⁵."""
    k3: float = 0.0
    """Coefficient of θ⁷."""
    k4: float = 0.0
    """Coefficient of θ⁹."""

    def __post_init__(self) -> None:
        _check_coefficients(self)


Distortion = RadialTangential | Fisheye

DISTORTIONS: dict[str, type[RadialTangential] | type[Fisheye]] = {
    "radial_tangential": RadialTangential,
    "fisheye": Fisheye,
}
"""Distortion classes by their names in files and streams. The fields of a class are in the files' order."""
COEFFICIENTS = {"radial_tangential": (5, 8), "fisheye": (4,)}
"""Numbers of coefficients that files and streams hold for each distortion class."""

RATIONAL = ("k4", "k5", "k6")
"""Coefficients of :class:`RadialTangential` that files and arrays leave out if all are 0."""


def coefficients(lens: Distortion) -> dict[str, float]:
    """Return the coefficients of a lens by name, in the files' order."""
    given = asdict(lens)
    if isinstance(lens, RadialTangential) and not any(given[name] for name in RATIONAL):
        return {name: value for name, value in given.items() if name not in RATIONAL}
    return given


def _check_coefficients(lens: Distortion) -> None:
    for field in fields(lens):
        what = f"camera distortion {field.name}"
        value = real(getattr(lens, field.name), what, -LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)
        object.__setattr__(lens, field.name, value)


OPENCV_COUNTS = (4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV's radial-tangential model can have."""
LARGEST_SIZE = 65536
"""Largest width and height of a sensor [px], because columns and rows of events are uint16."""
LEAST_FOCAL = 1e-3
"""Smallest focal length, as a multiple of the width (fx) or height (fy). The field of view is then 179.8 deg."""
LARGEST_FOCAL = 1e6
"""Largest focal length [px]: one microradian per pixel. Above it float32 cannot represent the displacement."""
LEAST_FOV = 1e-9
"""Smallest accepted field of view [rad]. In practice :data:`LARGEST_FOCAL` sets the limit."""

CAMERA_NUMBERS = ("width", "height", "fx", "fy", "cx", "cy")
"""Names of the fields of :class:`Camera` without the distortion, in the order in which files and streams use them."""

Vectors = TypeVar("Vectors")
"""Type of the rows of vectors given to a camera: NumPy array (n, 2) or (n, 3), or Warp array of vec2 or vec3. Results
have the same type."""


@guarded
@dataclass(frozen=True, slots=True)
class Camera:
    """Camera intrinsics: image size, focal lengths, principal point and lens distortion.

    The centre of pixel ``(0, 0)`` has the image coordinates ``(0.0, 0.0)``.

    Raises
    ------
    AmiwarpError
        If the width or height is not in 1 .. 65536 px, ``fx`` is not between 0.001 times the width and 1e6 px, or
        ``fy`` not between 0.001 times the height and 1e6 px, or a coordinate of the principal point is not in
        -65536 .. 65536 px. The least focal lengths give a field of view of 179.8 deg.

    Examples
    --------
    >>> amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5).fov
    1.13...
    """

    width: int
    """Width of the image [px]."""
    height: int
    """Height of the image [px]."""
    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Coordinate x of the principal point [px]."""
    cy: float
    """Coordinate y of the principal point [px]."""
    distortion: Distortion | None = None
    """Lens distortion, or None for a pinhole camera."""

    def __post_init__(self) -> None:
        for name, focal in (("width", "fx"), ("height", "fy")):
            size = whole(getattr(self, name), f"camera {name}", 1, LARGEST_SIZE, " pixels")
            length = real(getattr(self, focal), f"camera {focal}", LEAST_FOCAL * size, LARGEST_FOCAL, " pixels")
            object.__setattr__(self, name, size)
            object.__setattr__(self, focal, length)
        for name in ("cx", "cy"):
            value = real(getattr(self, name), f"camera {name}", -LARGEST_SIZE, LARGEST_SIZE, " pixels")
            object.__setattr__(self, name, value)
        if not isinstance(self.distortion, Distortion | None):
            raise AmiwarpError(
                f"camera distortion is {shown(self.distortion)}; expected RadialTangential, Fisheye or None"
            )

    @classmethod
    def from_fov(cls, width: int, height: int, fov: float, distortion: Distortion | None = None) -> Camera:
        """Create a camera with square pixels and a centred principal point from its field of view.

        Parameters
        ----------
        width, height : int
            Image size [px].
        fov : float
            Horizontal field of view [rad], before distortion.
        distortion : Distortion, optional
            Lens distortion.

        Returns
        -------
        Camera
            The camera.

        Raises
        ------
        AmiwarpError
            If the field of view is not between 0 and pi, or the size is not in 1 .. 65536 px.

        Examples
        --------
        >>> amiwarp.Camera.from_fov(640, 480, fov=1.0).fx
        585.75...
        """
        width = whole(width, "camera width", 1, LARGEST_SIZE, " pixels")
        height = whole(height, "camera height", 1, LARGEST_SIZE, " pixels")
        hint = " rad, 0 .. 180 deg; is it given in degrees?"
        fov = real(fov, "camera field of view", LEAST_FOV, math.nextafter(math.pi, 0.0), hint)
        focal = width / (2.0 * math.tan(fov / 2.0))
        return cls(width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0, distortion)

    @classmethod
    def from_opencv(
        cls, K: ArrayLike, dist: ArrayLike | None, size: tuple[int, int], *, fisheye: bool = False
    ) -> Camera:
        """Create a camera from OpenCV's camera matrix and distortion coefficients.

        Parameters
        ----------
        K : array_like
            Camera matrix [px], shape (3, 3), without skew.
        dist : array_like or None
            Distortion coefficients, in any shape with one dimension longer than 1: k1 k2 p1 p2 [k3] of OpenCV's
            radial-tangential model, these and k4 k5 k6 of its rational model, or the four of its fisheye model. None
            stands for no distortion. Coefficients after the eighth must be 0.
        size : tuple of int
            Width and height of the image [px].
        fisheye : bool, default False
            Whether the coefficients are those of ``cv2.fisheye``.

        Returns
        -------
        Camera
            The camera. A radial-tangential lens whose coefficients are all 0 becomes a pinhole camera.

        Raises
        ------
        AmiwarpError
            If a shape is wrong, the matrix has skew, or the number of coefficients is none of these.

        Examples
        --------
        >>> K = [[500.0, 0.0, 319.5], [0.0, 501.0, 239.5], [0.0, 0.0, 1.0]]
        >>> amiwarp.Camera.from_opencv(K, [-0.3, 0.1, 0.0, 0.0], (640, 480)).distortion
        RadialTangential(k1=-0.3, k2=0.1, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0)
        """
        matrix = array(K, "camera matrix K").astype(np.float64)
        if matrix.shape != (3, 3):
            raise AmiwarpError(f"camera matrix K has shape {matrix.shape}; expected (3, 3)")
        if matrix[0, 1] != 0.0:
            raise AmiwarpError(f"camera matrix K has a skew of {matrix[0, 1]:g} px; calibrate without skew")
        if matrix[1, 0] != 0.0 or matrix[2].tolist() != [0.0, 0.0, 1.0]:
            raise AmiwarpError(
                f"camera matrix K is {shown(matrix.tolist())}; expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            )
        fx, fy, cx, cy = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        width, height = vector(size, 2, "size", lambda value, what: whole(value, what, 1, LARGEST_SIZE, " pixels"))
        return cls(width, height, fx, fy, cx, cy, _opencv_distortion(dist, fisheye=fisheye))

    def to_opencv(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return OpenCV's camera matrix and distortion coefficients.

        Returns
        -------
        K : numpy.ndarray
            Camera matrix [px], shape (3, 3).
        dist : numpy.ndarray
            Coefficients k1 k2 p1 p2 k3, shape (5,), or with the rational k4 k5 k6, shape (8,), for the functions of
            ``cv2``, zeros for a pinhole camera; or those of a :class:`Fisheye`, shape (4,), for ``cv2.fisheye``.

        Examples
        --------
        >>> camera = amiwarp.Camera(640, 480, 500.0, 501.0, 319.5, 239.5, amiwarp.Fisheye(0.02))
        >>> camera.to_opencv()[1]
        array([0.02, 0.  , 0.  , 0.  ])
        """
        matrix = np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])
        return matrix, np.array([*coefficients(self.distortion or RadialTangential()).values()])

    @property
    def fov(self) -> float:
        """Horizontal field of view without distortion [rad]."""
        return 2.0 * math.atan(self.width / (2.0 * self.fx))

    def pixels_to_rays(self, xy: Vectors) -> Vectors:
        """Return the unit bearing vector of each pixel.

        Parameters
        ----------
        xy : numpy.ndarray or warp.array
            Pixels [px], shape (n, 2), or vec2 of shape (n,).

        Returns
        -------
        numpy.ndarray or warp.array
            Unit vectors, shape (n, 3), or vec3 of shape (n,). A row holds NaN if no ray reaches that pixel, or if the
            pixel is NaN or infinite.

        Raises
        ------
        AmiwarpError
            If the array has another shape or does not hold numbers.

        Examples
        --------
        >>> camera = amiwarp.Camera(width=640, height=480, fx=500.0, fy=500.0, cx=320.0, cy=240.0)
        >>> camera.pixels_to_rays([[320.0, 240.0]])
        array([[0., 0., 1.]])
        """
        return _run("pixels_to_rays", self, xy, (2, 3))

    def rays_to_pixels(self, rays: Vectors) -> Vectors:
        """Return the pixel of each bearing vector.

        Parameters
        ----------
        rays : numpy.ndarray or warp.array
            Bearing vectors of any length, shape (n, 3), or vec3 of shape (n,).

        Returns
        -------
        numpy.ndarray or warp.array
            Pixels [px], shape (n, 2), or vec2 of shape (n,). A row is NaN if the ray lies behind the image plane, or
            beyond the radius at which the distortion stops increasing, or is NaN or infinite.

        Raises
        ------
        AmiwarpError
            If the array has another shape or does not hold numbers.
        """
        return _run("rays_to_pixels", self, rays, (3, 2))


def _opencv_distortion(dist: ArrayLike | None, *, fisheye: bool) -> Distortion | None:
    """Return the lens of OpenCV's coefficients, or None if it does not distort."""
    if dist is None:
        return Fisheye() if fisheye else None
    given = array(dist, "distortion coefficients").astype(np.float64)
    if given.size != max(given.shape, default=0):
        raise AmiwarpError(f"distortion coefficients have shape {given.shape}; expected (n,), (1, n) or (n, 1)")
    k = given.ravel().tolist()
    if fisheye:
        if len(k) != 4:
            raise AmiwarpError(f"a fisheye lens has {len(k)} distortion coefficients; expected k1 k2 k3 k4")
        return Fisheye(*k)
    if len(k) not in OPENCV_COUNTS:
        raise AmiwarpError(f"the lens has {len(k)} distortion coefficients; expected 4, 5 or 8 in OpenCV's order")
    if any(k[8:]):
        raise AmiwarpError(
            f"distortion coefficients {shown(k)} go beyond k6; calibrate without the thin-prism and tilt models"
        )
    return RadialTangential(*k[:8]) if any(k) else None


def check_size(width: float, height: float, where: object) -> None:
    """Raise :class:`AmiwarpError` for a sensor size out of 1 .. :data:`LARGEST_SIZE` px; ``where`` names the source."""
    width, height = (whole(size, f"{where}: size of the sensor", *INT64) for size in (width, height))
    if not (1 <= width <= LARGEST_SIZE and 1 <= height <= LARGEST_SIZE):
        raise AmiwarpError(f"{where}: size {width}x{height}; expected 1 .. {LARGEST_SIZE} pixels each way")


def _run(kernel_name: str, camera: Camera, rows: Any, sizes: tuple[int, int]) -> Any:
    """Run a kernel over rows of vectors; ``sizes`` are the vector lengths of its input and of its output."""
    import warp as wp

    from amiwarp.kernels import camera as kernels
    from amiwarp.kernels.launch import launch

    given, wanted = ({2: wp.vec2, 3: wp.vec3}[size] for size in sizes)
    if isinstance(rows, wp.array):
        if rows.dtype is not given or rows.ndim != 1:
            raise AmiwarpError(f"array has type {rows.dtype} and shape {rows.shape}; give vec{sizes[0]} of shape (n,)")
        out = wp.empty(len(rows), dtype=wanted, device=rows.device)
        params = kernels.camera_params(camera, str(rows.device))
        launch(getattr(kernels, kernel_name), len(rows), [params, rows], [out], device=rows.device)
        return out
    rows = array(rows, "array")
    if rows.ndim != 2 or rows.shape[1] != sizes[0]:
        raise AmiwarpError(f"array has shape {rows.shape}; give (n, {sizes[0]})")
    result = _run(kernel_name, camera, wp.array(rows.astype(np.float32), dtype=given, device="cpu"), sizes)
    return result.numpy().astype(rows.dtype if np.issubdtype(rows.dtype, np.floating) else np.float32, copy=False)


# Rotation of the camera itself during a time window, with an angular velocity that is constant or linear in time.

Vector = tuple[float, float, float]


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Return a camera as a JSON object."""
    out = {name: getattr(camera, name) for name in CAMERA_NUMBERS}
    if camera.distortion is not None:
        [kind] = (name for name, lens in DISTORTIONS.items() if isinstance(camera.distortion, lens))
        out["distortion"] = {"kind": kind, **coefficients(camera.distortion)}
    return out


LENS = ("focal_length", "center_x", "center_y", "k1", "fy_over_fx")
"""Parameters of the camera's lens. A calibration may free them: the focal length (px), the principal point (px), the
first radial coefficient of distortion, and fy / fx."""


def given_lens(camera: Camera) -> dict[str, float]:
    """Return the values of a camera's lens parameters (:data:`LENS`)."""
    lens = camera.distortion
    values = (camera.fx, camera.cx, camera.cy, lens.k1 if lens else 0.0, camera.fy / camera.fx)
    return dict(zip(LENS, values, strict=True))


def with_lens(camera: Camera, values: Mapping[str, float]) -> Camera:
    """Return the camera with those of its lens parameters (:data:`LENS`) that ``values`` contain."""
    if values.keys().isdisjoint(LENS):
        return camera
    fx = values.get("focal_length", camera.fx)
    fy = fx * values.get("fy_over_fx", camera.fy / camera.fx)
    lens = camera.distortion
    if "k1" in values:
        lens = replace(lens or RadialTangential(), k1=values["k1"])
    cx, cy = values.get("center_x", camera.cx), values.get("center_y", camera.cy)
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=lens)


@guarded
@dataclass(frozen=True, slots=True)
class CameraRotation:
    """Angular velocity of the camera in its own frame, constant or linear in time, and growth of the image.

    The angular velocity at time t is ``angular_velocity + angular_acceleration * (t - middle_us)``. Compensation
    rotates every pixel back to the time ``middle_us``, and then undoes the growth of the image.

    Notes
    -----
    The rotation vector is ωτ + ατ²/2, with τ the time since ``middle_us``. This is exact if the axis is constant.

    Examples
    --------
    >>> pan = amiwarp.CameraRotation(angular_velocity=(0.0, 0.5, 0.0), middle_us=10_000)
    >>> pan.moves
    True
    """

    angular_velocity: Vector = (0.0, 0.0, 0.0)
    """Angular velocity at ``middle_us`` [rad/s], about x, y and z."""
    angular_acceleration: Vector = (0.0, 0.0, 0.0)
    """Angular acceleration [rad/s²], about x, y and z."""
    middle_us: int = 0
    """Reference time of the rotation [us], usually the middle of the time window."""
    growth: float = 0.0
    """Speed of a forward motion, divided by the scene's depth [1/s]: the image grows about the principal point."""

    def about(self, middle_us: int) -> CameraRotation:
        """Return the same rotation, expressed about another reference time.

        Parameters
        ----------
        middle_us : int
            New reference time [us].

        Returns
        -------
        CameraRotation
            The rotation with the angular velocity at the new reference time.

        Raises
        ------
        AmiwarpError
            If a forward motion has reached the scene before the new reference time.
        """
        later = (middle_us - self.middle_us) * 1e-6
        x, y, z = (r + c * later for r, c in zip(self.angular_velocity, self.angular_acceleration, strict=True))
        left = 1.0 - self.growth * later
        if left <= 0.0:
            raise AmiwarpError(
                f"middle_us is {middle_us}; with growth {self.growth:g} 1/s the camera reaches the scene "
                f"{1.0 / self.growth:g} s after {self.middle_us} us; give a time before that, or no growth"
            )
        return CameraRotation((x, y, z), self.angular_acceleration, middle_us, self.growth / left)

    @property
    def moves(self) -> bool:
        """Whether the camera moves at all."""
        return any((*self.angular_velocity, *self.angular_acceleration, self.growth))

    def rotation(self, tau: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rotation vectors since the reference time.

        Parameters
        ----------
        tau : numpy.ndarray
            Time since the reference time [s], shape (n,).

        Returns
        -------
        numpy.ndarray
            Rotation vectors [rad], shape (n, 3).
        """
        if not (np.abs(tau) <= 1e9).all():
            raise AmiwarpError(f"tau = {shown(tau)} is not within 1e9 s of the reference time; give seconds")
        return np.outer(tau, self.angular_velocity) + np.outer(0.5 * tau**2, self.angular_acceleration)

    def params(self) -> Any:
        """Return the parameters for kernels.

        Returns
        -------
        amiwarp.kernels.camera.CameraRotationParams
            Angular velocity, acceleration and growth as a Warp struct.
        """
        import warp as wp

        from amiwarp.kernels.camera import CameraRotationParams

        p = CameraRotationParams()
        p.velocity, p.acceleration = wp.vec3(*self.angular_velocity), wp.vec3(*self.angular_acceleration)
        p.growth = self.growth
        return p

    def reach(self, camera: Camera, half_s: float) -> NDArray[np.float64]:
        """Return the largest displacement of border pixels within ``half_s`` of the reference time.

        Parameters
        ----------
        camera : Camera
            The camera.
        half_s : float
            Half the length of the window [s].

        Returns
        -------
        numpy.ndarray
            Largest displacement along x and y [px], shape (2,). It is the image size if every border pixel leaves the
            view.
        """
        half_s = real(half_s, "half_s", 0.0, 1e9, " s")
        ends = np.array([-half_s, half_s])
        rotations, sizes = self.rotation(ends), 1.0 - self.growth * ends
        if not (rotations.any() or self.growth):
            return np.zeros(2)
        from scipy.spatial.transform import Rotation  # here, because a still camera does not need this slow import

        xy = border(camera)
        rays = np.asarray(camera.pixels_to_rays(xy.astype(np.float32)), np.float64)
        sizes = np.where(sizes > 0.0, sizes, np.nan)  # beyond the scene
        turned = (Rotation.from_rotvec(r).apply(rays) * (s, s, 1.0) for r, s in zip(rotations, sizes, strict=True))
        moved = [camera.rays_to_pixels(each.astype(np.float32)) for each in turned]
        displacement = np.abs(np.concatenate([np.asarray(m) - xy for m in moved]))
        visible = displacement[np.isfinite(displacement).all(axis=1)]
        return visible.max(axis=0) if len(visible) else np.array([camera.width, camera.height], np.float64)


def border(camera: Camera) -> NDArray[np.float64]:
    """Return pixels along the image's border [px], shape (n, 2)."""
    x, y = np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9)
    grid = np.stack([m.ravel() for m in np.meshgrid(x, y)], axis=1)
    edge = np.isin(grid[:, 0], x[[0, -1]]) | np.isin(grid[:, 1], y[[0, -1]])
    return np.asarray(grid[edge])
