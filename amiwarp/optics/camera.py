"""Camera model: image size, pinhole intrinsics and lens distortion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.optics.lens import Distortion
from amiwarp.validation import INT64, array, guarded, real, shown, whole

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

Rows = TypeVar("Rows")
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

    @property
    def fov(self) -> float:
        """Horizontal field of view without distortion [rad]."""
        return 2.0 * math.atan(self.width / (2.0 * self.fx))

    def pixels_to_rays(self, xy: Rows) -> Rows:
        """Return the unit bearing vector of each pixel.

        Parameters
        ----------
        xy : numpy.ndarray or warp.array
            Pixels [px], shape (n, 2), or vec2 of shape (n,).

        Returns
        -------
        numpy.ndarray or warp.array
            Unit vectors, shape (n, 3), or vec3 of shape (n,). A row is NaN if no ray reaches that pixel.

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

    def rays_to_pixels(self, rays: Rows) -> Rows:
        """Return the pixel of each bearing vector.

        Parameters
        ----------
        rays : numpy.ndarray or warp.array
            Bearing vectors of any length, shape (n, 3), or vec3 of shape (n,).

        Returns
        -------
        numpy.ndarray or warp.array
            Pixels [px], shape (n, 2), or vec2 of shape (n,). A row is NaN if the ray lies behind the image plane, or
            beyond the radius at which the distortion stops increasing.

        Raises
        ------
        AmiwarpError
            If the array has another shape or does not hold numbers.
        """
        return _run("rays_to_pixels", self, rays, (3, 2))


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
    from amiwarp.optics.device_camera import camera_params

    given, wanted = ({2: wp.vec2, 3: wp.vec3}[size] for size in sizes)
    if isinstance(rows, wp.array):
        if rows.dtype is not given or rows.ndim != 1:
            raise AmiwarpError(f"array has type {rows.dtype} and shape {rows.shape}; give vec{sizes[0]} of shape (n,)")
        out = wp.empty(len(rows), dtype=wanted, device=rows.device)
        params = camera_params(camera, str(rows.device))
        launch(getattr(kernels, kernel_name), len(rows), [params, rows], [out], device=rows.device)
        return out
    rows = array(rows, "array")
    if rows.ndim != 2 or rows.shape[1] != sizes[0]:
        raise AmiwarpError(f"array has shape {rows.shape}; give (n, {sizes[0]})")
    result = _run(kernel_name, camera, wp.array(rows.astype(np.float32), dtype=given, device="cpu"), sizes)
    return result.numpy().astype(rows.dtype if np.issubdtype(rows.dtype, np.floating) else np.float32, copy=False)
