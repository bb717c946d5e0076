"""Rotation of the camera itself during a time window, with an angular velocity that is constant or linear in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera, border
from amiwarp.optics.rotation_path import STEP_US, RotationPath, rotation_table
from amiwarp.schema.calls import guarded
from amiwarp.validation import real, shown

Vector = tuple[float, float, float]
"""Three numbers about the camera's x, y and z axes."""
PATH_TIMES = 33
"""Number of times in a window at which the displacement by a known path is computed."""


@guarded
@dataclass(frozen=True, slots=True)
class CameraRotation:
    """Angular velocity of the camera in its own frame, constant or linear in time, and growth of the image.

    The angular velocity at time t is ``angular_velocity + angular_acceleration * (t - middle_us)``, beyond the motion
    of a known ``path``. Compensation rotates every pixel back to the time ``middle_us``, and then undoes the growth of
    the image.

    Notes
    -----
    The rotation vector is ωτ + ατ²/2, with τ the time since ``middle_us``. This is exact if the axis is constant. The
    rotation vector of the path is added, which is exact for small ωτ: the path is the rotation that a gyroscope
    measured, and ω its bias.

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
    path: RotationPath | None = None
    """Known part of the rotation, or None."""

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
        later_s = (middle_us - self.middle_us) * 1e-6
        x, y, z = (
            velocity + acceleration * later_s
            for velocity, acceleration in zip(
                self.angular_velocity, self.angular_acceleration, strict=True
            )
        )
        depth_left = (
            1.0 - self.growth * later_s
        )  # as a share of the depth at the present reference time
        if depth_left <= 0.0:
            raise AmiwarpError(
                f"middle_us is {middle_us}; with growth {self.growth:g} 1/s the camera reaches the scene "
                f"{1.0 / self.growth:g} s after {self.middle_us} us; give a time before that, or no growth"
            )
        return CameraRotation(
            (x, y, z), self.angular_acceleration, middle_us, self.growth / depth_left, self.path
        )

    @property
    def moves(self) -> bool:
        """Whether the camera moves at all."""
        return self.path is not None or any(
            (*self.angular_velocity, *self.angular_acceleration, self.growth)
        )

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
            raise AmiwarpError(
                f"tau = {shown(tau)} is not within 1e9 s of the reference time; give seconds"
            )
        by_velocity = np.outer(tau, self.angular_velocity)
        by_acceleration = np.outer(0.5 * tau**2, self.angular_acceleration)
        turned = by_velocity + by_acceleration
        if self.path is not None:
            turned = turned + self.path.at(tau, self.middle_us)
        return turned

    def params(self, device: Any) -> Any:
        """Return the parameters for kernels.

        Parameters
        ----------
        device : str or warp.context.Device
            Device on which the kernels run.

        Returns
        -------
        amiwarp.kernels.camera_rotation.CameraRotationParams
            Angular velocity, acceleration, growth and path as a Warp struct.
        """
        import warp as wp

        from amiwarp.kernels.camera_rotation import CameraRotationParams

        params = CameraRotationParams()
        params.velocity = wp.vec3(*self.angular_velocity)
        params.acceleration = wp.vec3(*self.angular_acceleration)
        params.growth = self.growth
        if self.path is not None:
            params.path = rotation_table(self.path, self.middle_us, str(wp.get_device(device)))
            params.path_start = (self.path.start_us - self.middle_us) * 1e-6
            params.path_rate = 1e6 / STEP_US
        return params

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
        # Without a path, the rotation is largest at one of the window's ends.
        times_s = np.array([-half_s, half_s])
        if self.path is not None:
            times_s = np.linspace(-half_s, half_s, PATH_TIMES)
        rotations = self.rotation(times_s)
        if not (rotations.any() or self.growth):
            return np.zeros(2)
        # Here, because a still camera does not need this slow import
        from scipy.spatial.transform import Rotation

        xy = border(camera)
        rays = np.asarray(camera.pixels_to_rays(xy.astype(np.float32)), np.float64)
        sizes = 1.0 - self.growth * times_s
        sizes = np.where(sizes > 0.0, sizes, np.nan)  # else the camera is beyond the scene
        displacements = []
        for rotation, size in zip(rotations, sizes, strict=True):
            turned = Rotation.from_rotvec(rotation).apply(rays) * (size, size, 1.0)
            moved = camera.rays_to_pixels(turned.astype(np.float32))
            displacements.append(np.abs(np.asarray(moved) - xy))
        displacement = np.concatenate(displacements)
        visible = displacement[np.isfinite(displacement).all(axis=1)]
        if not len(visible):
            return np.array([camera.width, camera.height], np.float64)
        return visible.max(axis=0)
