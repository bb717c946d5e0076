"""Camera: image size, pinhole intrinsics and lens distortion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.distortion import (
    DISTORTIONS,
    Distortion,
    RadialTangential,
    coefficients,
    opencv_distortion,
)
from amiwarp.schema.calls import guarded
from amiwarp.schema.records import build, fields_of
from amiwarp.validation import INT64, array, one_of, real, shown, vector, whole

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
EventBlock = TypeVar("EventBlock")
"""Type of events, :class:`amiwarp.Events`. Its room imports this one."""


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
        unit = " pixels"
        for name, focal in (("width", "fx"), ("height", "fy")):
            size = whole(getattr(self, name), f"camera {name}", 1, LARGEST_SIZE, unit)
            least = LEAST_FOCAL * size
            length = real(getattr(self, focal), f"camera {focal}", least, LARGEST_FOCAL, unit)
            object.__setattr__(self, name, size)
            object.__setattr__(self, focal, length)
        for name in ("cx", "cy"):
            given = getattr(self, name)
            value = real(given, f"camera {name}", -LARGEST_SIZE, LARGEST_SIZE, unit)
            object.__setattr__(self, name, value)
        if not isinstance(self.distortion, Distortion | None):
            raise AmiwarpError(
                f"camera distortion is {shown(self.distortion)}; expected RadialTangential, Fisheye or None"
            )

    @classmethod
    def from_fov(
        cls,
        width: int,
        height: int,
        fov: float,
        distortion: Distortion | None = None,
    ) -> Camera:
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
        return cls(
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=(width - 1) / 2.0,
            cy=(height - 1) / 2.0,
            distortion=distortion,
        )

    @classmethod
    def from_opencv(
        cls,
        K: ArrayLike,
        dist: ArrayLike | None,
        size: tuple[int, int],
        *,
        fisheye: bool = False,
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
            Whether the coefficients belong to ``cv2.fisheye``.

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
            raise AmiwarpError(
                f"camera matrix K has a skew of {matrix[0, 1]:g} px; calibrate without skew"
            )
        if matrix[1, 0] != 0.0 or matrix[2].tolist() != [0.0, 0.0, 1.0]:
            raise AmiwarpError(
                f"camera matrix K is {shown(matrix.tolist())}; expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
            )
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()

        def side(value: object, what: str) -> int:
            return whole(value, what, 1, LARGEST_SIZE, " pixels")

        width, height = vector(size, 2, "size", side)
        distortion = opencv_distortion(dist, fisheye=fisheye)
        return cls(width, height, fx, fy, cx, cy, distortion)

    def to_opencv(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return OpenCV's camera matrix and distortion coefficients.

        Returns
        -------
        K : numpy.ndarray
            Camera matrix [px], shape (3, 3).
        dist : numpy.ndarray
            Coefficients k1 k2 p1 p2 k3, shape (5,), or with the rational k4 k5 k6, shape (8,), for the functions of
            ``cv2``, zeros for a pinhole camera; or the four of a :class:`Fisheye`, shape (4,), for ``cv2.fisheye``.

        Examples
        --------
        >>> camera = amiwarp.Camera(640, 480, 500.0, 501.0, 319.5, 239.5, amiwarp.Fisheye(0.02))
        >>> camera.to_opencv()[1]
        array([0.02, 0.  , 0.  , 0.  ])
        """
        matrix = [
            [self.fx, 0.0, self.cx],
            [0.0, self.fy, self.cy],
            [0.0, 0.0, 1.0],
        ]
        lens = self.distortion or RadialTangential()
        numbers = list(coefficients(lens).values())
        return np.array(matrix), np.array(numbers)

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

    @guarded
    def undistort(self, events: EventBlock, target: Camera | None = None) -> EventBlock:
        """Return events as a camera without lens distortion would see them.

        Parameters
        ----------
        events : Events
            Events of this camera: of the sensor, or compensated.
        target : Camera, optional
            The camera that would see them, at the same place with the same orientation, such as a pinhole camera with
            another focal length. By default, a pinhole camera with the ``fx``, ``fy``, ``cx`` and ``cy`` of this one.

        Returns
        -------
        Events
            The same events at float32 coordinates [px], NaN for an event that no ray reaches, or that lies behind the
            image plane of ``target``. Other events may lie outside the image. Times and polarities are unchanged.

        Raises
        ------
        AmiwarpError
            If ``events`` are no :class:`Events`, or an event of a sensor lies outside this camera's image.

        Examples
        --------
        >>> lens = amiwarp.RadialTangential(k1=-0.2)
        >>> camera = amiwarp.Camera(640, 480, 500.0, 500.0, 320.0, 240.0, lens)
        >>> events = amiwarp.Events.from_arrays(x=[320, 639], y=[240, 240], t=[0, 10], p=[1, 0])
        >>> camera.undistort(events).x.round(1)
        array([320. , 674.7], dtype=float32)
        """
        if not (is_dataclass(events) and isinstance(getattr(events, "x", None), np.ndarray)):
            raise AmiwarpError(f"events is {shown(events)}; give amiwarp.Events, in host memory")
        seen_by = replace(self, distortion=None) if target is None else target
        places = undistorted_places(events, self, seen_by)
        return replace(events, x=places.x, y=places.y)  # type: ignore[type-var]


class UndistortedPlaces(NamedTuple):
    """Places of events in an undistorted image."""

    x: NDArray[np.float32]
    """Column [px], NaN if no ray reaches the event, shape ``(n,)``."""
    y: NDArray[np.float32]
    """Row [px], NaN if no ray reaches the event, shape ``(n,)``."""
    outside: NDArray[np.bool_]
    """Whether each event lies on no pixel of the undistorted image, shape ``(n,)``."""


def undistorted_places(events: Any, camera: Camera, target: Camera) -> UndistortedPlaces:
    """Return the places of events of ``camera`` in the image of ``target``, which has the same view.

    Events of a sensor are looked up in a table of all pixels, which is many times faster than a kernel's launch for
    each packet of a stream. Raises :class:`AmiwarpError` if such an event lies outside the image of ``camera``.
    """
    if not events.whole_pixels:
        return _places_of(np.stack([events.x, events.y], axis=1), camera, target)
    check_pixels(events, camera)
    table = places_of_pixels(camera, target)
    pixel = events.y.astype(np.intp)
    pixel *= camera.width
    pixel += events.x
    return UndistortedPlaces(table.x.take(pixel), table.y.take(pixel), table.outside.take(pixel))


@lru_cache(maxsize=4)
def places_of_pixels(camera: Camera, target: Camera) -> UndistortedPlaces:
    """Return the places of all pixels, row by row."""
    rows, columns = np.indices((camera.height, camera.width), np.float32)
    return _places_of(np.stack([columns.ravel(), rows.ravel()], axis=1), camera, target)


def _places_of(xy: NDArray[np.float32], camera: Camera, target: Camera) -> UndistortedPlaces:
    """Return the places of points of ``camera`` [px], shape (n, 2)."""
    places = target.rays_to_pixels(camera.pixels_to_rays(xy))
    x, y = np.ascontiguousarray(places.T)
    in_columns = (x >= -0.5) & (x < target.width - 0.5)
    in_rows = (y >= -0.5) & (y < target.height - 0.5)
    return UndistortedPlaces(x, y, ~(in_columns & in_rows))


def check_pixels(events: Any, camera: Camera) -> None:
    """Raise :class:`AmiwarpError` if an event lies outside the camera's image."""
    if not len(events):
        return
    largest_x = int(events.x.max())
    largest_y = int(events.y.max())
    if largest_x >= camera.width or largest_y >= camera.height:
        raise AmiwarpError(
            f"events reach to pixel ({largest_x}, {largest_y}), and the camera has {camera.width}x{camera.height} "
            "pixels; give the camera of these events"
        )


def check_size(width: float, height: float, where: object) -> None:
    """Raise :class:`AmiwarpError` for a sensor size out of 1 .. :data:`LARGEST_SIZE` px; ``where`` names the source."""
    what = f"{where}: size of the sensor"
    width = whole(width, what, *INT64)
    height = whole(height, what, *INT64)
    if not (1 <= width <= LARGEST_SIZE and 1 <= height <= LARGEST_SIZE):
        raise AmiwarpError(
            f"{where}: size {width}x{height}; expected 1 .. {LARGEST_SIZE} pixels each way"
        )


def _run(kernel_name: str, camera: Camera, rows: Any, sizes: tuple[int, int]) -> Any:
    """Run a kernel over rows of vectors; ``sizes`` are the vector lengths of its input and of its output."""
    import warp as wp

    from amiwarp.kernels import camera as kernels
    from amiwarp.kernels.launch import launch

    types = {2: wp.vec2, 3: wp.vec3}
    given_size, wanted_size = sizes
    given = types[given_size]
    wanted = types[wanted_size]
    if isinstance(rows, wp.array):
        if rows.dtype is not given or rows.ndim != 1:
            raise AmiwarpError(
                f"array has type {rows.dtype} and shape {rows.shape}; give vec{given_size} of shape (n,)"
            )
        device = rows.device
        out = wp.empty(len(rows), dtype=wanted, device=device)
        params = kernels.camera_params(camera, str(device))
        launch(getattr(kernels, kernel_name), len(rows), [params, rows], [out], device=device)
        return out
    rows = array(rows, "array")
    if rows.ndim != 2 or rows.shape[1] != given_size:
        raise AmiwarpError(f"array has shape {rows.shape}; give (n, {given_size})")
    on_device = wp.array(rows.astype(np.float32), dtype=given, device="cpu")
    result = _run(kernel_name, camera, on_device, sizes)
    dtype = rows.dtype if np.issubdtype(rows.dtype, np.floating) else np.float32
    return result.numpy().astype(dtype, copy=False)


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Return a camera as a JSON object."""
    out = {name: getattr(camera, name) for name in CAMERA_NUMBERS}
    lens = camera.distortion
    if lens is not None:
        [kind] = [name for name, lens_class in DISTORTIONS.items() if isinstance(lens, lens_class)]
        out["distortion"] = {"kind": kind, **coefficients(lens)}
    return out


def camera_from_json(data: Any, where: str = "") -> Camera:
    """Return a camera from a JSON object.

    ``where`` is the object's name in messages. Raises :class:`AmiwarpError` naming the field.
    """
    given = fields_of(data, where, *CAMERA_NUMBERS, optional=("distortion",))
    prefix = f"{where}." if where else ""
    lens = given.get("distortion")
    distortion = None
    if lens is not None:
        field = f"{prefix}distortion"
        numbers = dict(lens) if isinstance(lens, dict) else fields_of(lens, field)
        kind = one_of(numbers.pop("kind", None), DISTORTIONS, f"field {field}.kind")
        distortion = build(DISTORTIONS[kind], numbers, field)
    numbers_of_camera = {name: given[name] for name in CAMERA_NUMBERS}
    return Camera(**numbers_of_camera, distortion=distortion)


LENS = ("focal_length", "center_x", "center_y", "k1", "fy_over_fx")
"""Parameters of the camera's lens. A calibration may free them: the focal length (px), the principal point (px), the
first radial coefficient of distortion, and fy / fx."""


def given_lens(camera: Camera) -> dict[str, float]:
    """Return the values of a camera's lens parameters (:data:`LENS`)."""
    lens = camera.distortion
    return {
        "focal_length": camera.fx,
        "center_x": camera.cx,
        "center_y": camera.cy,
        "k1": lens.k1 if lens else 0.0,
        "fy_over_fx": camera.fy / camera.fx,
    }


def with_lens(camera: Camera, values: Mapping[str, float]) -> Camera:
    """Return the camera with the lens parameters (:data:`LENS`) that ``values`` contain."""
    if values.keys().isdisjoint(LENS):
        return camera
    fx = values.get("focal_length", camera.fx)
    fy = fx * values.get("fy_over_fx", camera.fy / camera.fx)
    lens = camera.distortion
    if "k1" in values:
        lens = replace(lens or RadialTangential(), k1=values["k1"])
    cx = values.get("center_x", camera.cx)
    cy = values.get("center_y", camera.cy)
    return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, distortion=lens)


BORDER_POINTS = 9
"""Number of points on each side of the image's border, corners included."""


def border(camera: Camera) -> NDArray[np.float64]:
    """Return pixels along the image's border, evenly on each side [px], shape (32, 2)."""
    x = np.linspace(0, camera.width - 1, BORDER_POINTS)
    y = np.linspace(0, camera.height - 1, BORDER_POINTS)
    columns, rows = np.meshgrid(x, y)
    grid = np.stack([columns.ravel(), rows.ravel()], axis=1)
    left_or_right = np.isin(grid[:, 0], x[[0, -1]])
    top_or_bottom = np.isin(grid[:, 1], y[[0, -1]])
    return np.asarray(grid[left_or_right | top_or_bottom])
