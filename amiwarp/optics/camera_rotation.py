"""How the camera itself turns during a window: its angular velocity, constant or linear in time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.optics.camera import Camera

    Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class CameraRotation:
    """Angular velocity in the camera's frame, constant or linear in time.

    At time t it is ``angular_velocity + angular_acceleration * (t - middle_us)``. Places are turned back to the middle.

    Over a window the rotation vector is ωτ + ατ²/2, τ from the middle: exact while the axis stays.
    """

    angular_velocity: Vector = (0.0, 0.0, 0.0)
    """At the middle [rad/s]."""
    angular_acceleration: Vector = (0.0, 0.0, 0.0)
    """[rad/s²]."""
    middle_us: int = 0

    def about(self, middle_us: int) -> CameraRotation:
        """The same motion seen from another middle."""
        later = (middle_us - self.middle_us) * 1e-6
        x, y, z = (r + c * later for r, c in zip(self.angular_velocity, self.angular_acceleration, strict=True))
        return replace(self, angular_velocity=(x, y, z), middle_us=middle_us)

    @property
    def moves(self) -> bool:
        """Whether the camera rotates at all."""
        return any(self.angular_velocity) or any(self.angular_acceleration)

    def rotation(self, tau: NDArray[np.float64]) -> NDArray[np.float64]:
        """Rotation vectors [rad] since the middle at ``tau`` [s] from it, shape (n, 3)."""
        return np.outer(tau, self.angular_velocity) + np.outer(0.5 * tau**2, self.angular_acceleration)

    def params(self) -> Any:
        """For kernels."""
        import warp as wp

        from amiwarp.kernels.camera import CameraRotationParams

        p = CameraRotationParams()
        p.velocity, p.acceleration = wp.vec3(*self.angular_velocity), wp.vec3(*self.angular_acceleration)
        return p

    def reach(self, camera: Camera, half_s: float) -> NDArray[np.float64]:
        """How far pixels of the image's border move within ``half_s`` of the middle, at most, along x and y [px]."""
        from scipy.spatial.transform import Rotation

        rotations = self.rotation(np.array([-half_s, half_s]))
        if not rotations.any():
            return np.zeros(2)
        xy = border(camera)
        rays = np.asarray(camera.pixels_to_rays(xy.astype(np.float32)), np.float64)
        moved = [camera.rays_to_pixels(Rotation.from_rotvec(r).apply(rays).astype(np.float32)) for r in rotations]
        far = np.abs(np.concatenate([np.asarray(m) - xy for m in moved]))
        seen = far[np.isfinite(far).all(axis=1)]
        # turned out of view altogether: by more than the image
        return seen.max(axis=0) if len(seen) else np.array([camera.width, camera.height], np.float64)


def border(camera: Camera) -> NDArray[np.float64]:
    """Pixels along the image's border, shape (n, 2)."""
    x, y = np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9)
    grid = np.stack([m.ravel() for m in np.meshgrid(x, y)], axis=1)
    edge = np.isin(grid[:, 0], x[[0, -1]]) | np.isin(grid[:, 1], y[[0, -1]])
    return np.asarray(grid[edge])
