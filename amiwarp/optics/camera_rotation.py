"""Rotation of the camera itself during a time window, with an angular velocity that is constant or linear in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.validation import guarded, real, shown

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.optics.camera import Camera

Vector = tuple[float, float, float]


@guarded
@dataclass(frozen=True, slots=True)
class CameraRotation:
    """Angular velocity of the camera in its own frame, constant or linear in time.

    The angular velocity at time t is ``angular_velocity + angular_acceleration * (t - middle_us)``. Compensation
    rotates every pixel back to the time ``middle_us``.

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
        """
        later = (middle_us - self.middle_us) * 1e-6
        x, y, z = (r + c * later for r, c in zip(self.angular_velocity, self.angular_acceleration, strict=True))
        return CameraRotation((x, y, z), self.angular_acceleration, middle_us)

    @property
    def moves(self) -> bool:
        """Whether the camera rotates at all."""
        return any(self.angular_velocity) or any(self.angular_acceleration)

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
            Angular velocity and acceleration as a Warp struct.
        """
        import warp as wp

        from amiwarp.kernels.camera import CameraRotationParams

        p = CameraRotationParams()
        p.velocity, p.acceleration = wp.vec3(*self.angular_velocity), wp.vec3(*self.angular_acceleration)
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
        rotations = self.rotation(np.array([-half_s, half_s]))
        if not rotations.any():
            return np.zeros(2)
        from scipy.spatial.transform import Rotation  # here, because a still camera does not need this slow import

        xy = border(camera)
        rays = np.asarray(camera.pixels_to_rays(xy.astype(np.float32)), np.float64)
        moved = [camera.rays_to_pixels(Rotation.from_rotvec(r).apply(rays).astype(np.float32)) for r in rotations]
        displacement = np.abs(np.concatenate([np.asarray(m) - xy for m in moved]))
        visible = displacement[np.isfinite(displacement).all(axis=1)]
        return visible.max(axis=0) if len(visible) else np.array([camera.width, camera.height], np.float64)


def border(camera: Camera) -> NDArray[np.float64]:
    """Return pixels along the image's border [px], shape (n, 2)."""
    x, y = np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9)
    grid = np.stack([m.ravel() for m in np.meshgrid(x, y)], axis=1)
    edge = np.isin(grid[:, 0], x[[0, -1]]) | np.isin(grid[:, 1], y[[0, -1]])
    return np.asarray(grid[edge])
