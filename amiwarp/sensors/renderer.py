"""What an event camera needs of a simulator: pictures of rays, and, if it is to choose their number, what moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import warp as wp

from amiwarp.errors import AmiwarpError
from amiwarp.schema.calls import guarded
from amiwarp.sensors.rays import Rays
from amiwarp.simulation.event_sensor import MOST_CAMERAS
from amiwarp.validation import whole


@guarded
@dataclass(frozen=True, eq=False)
class Surfaces:
    """What the rays of all cameras hit, on the renderer's device.

    Examples
    --------
    >>> import warp as wp
    >>> nothing = wp.full((1, 6, 8), -1, dtype=int)
    >>> surfaces = amiwarp.Surfaces(wp.zeros((1, 6, 8), dtype=float), nothing, nothing)
    """

    distance: Any
    """Distance from the ray's origin [m], Warp array of float32, shape (cameras, height, width); 0 for nothing."""
    body: Any
    """Row of the body among the renderer's :meth:`Renderer.bodies`, int32, same shape; -1 for what rests."""
    shape: Any
    """Number of the shape or geometry in the simulator, int32, same shape; -1 for nothing."""


@guarded
class Renderer:
    """What draws the pictures of an :class:`amiwarp.EventCamera`: base class, derived for each simulator.

    A derived class has :meth:`luminance`. With :meth:`between`, pictures between two states are drawn. With
    :meth:`cameras_at`, :meth:`bodies` and :meth:`surfaces` too, their number is chosen from what moves.

    Parameters
    ----------
    cameras : int
        Number of cameras.
    device : str or warp.Device
        Device of rays and pictures.

    Examples
    --------
    >>> import numpy as np
    >>> class Dark(amiwarp.Renderer):
    ...     def luminance(self, scene, rays):
    ...         return np.zeros((self.cameras, 6, 8), np.float32)
    >>> eyes = amiwarp.EventCamera(Dark(2, "cpu"), amiwarp.Camera.from_fov(8, 6, 1.0), pictures=1)
    >>> len(eyes.step(None, 0)[0])
    0
    """

    AXES: ClassVar[tuple[int, int, int]] = (1, 1, 1)
    """Signs of x, y and z of the simulator's camera frame. Here it is amiwarp's: x to the right, y down, z ahead; (1,
    -1, -1) for y up and -z ahead."""

    def __init__(self, cameras: int, device: Any) -> None:
        self.cameras = whole(cameras, "cameras", 1, MOST_CAMERAS)
        """Number of cameras."""
        self.device = wp.get_device(device)
        """Device of rays and pictures."""

    def snapshot(self, state: Any) -> Any:
        """Return what the pictures of a state need, which the simulator may then overwrite.

        Parameters
        ----------
        state : object
            The simulator's state.

        Returns
        -------
        object
            A copy of what changes, which is the scene of the other methods. Here the state itself.
        """
        return state

    def between(self, before: Any, after: Any, fraction: float) -> Any:
        """Return the scene between two.

        Parameters
        ----------
        before, after : object
            Scenes of :meth:`snapshot`.
        fraction : float
            Place in time between both, 0 to 1.

        Returns
        -------
        object
            The scene. Here the later one, if it is asked for.
        """
        if fraction < 1.0:
            raise AmiwarpError(
                f"{type(self).__name__} has no method between, which draws pictures between two states; write one, or "
                "give pictures=1"
            )
        return after

    def luminance(self, scene: Any, rays: Rays) -> Any:
        """Return what the rays see, averaged over the rays of each pixel.

        Parameters
        ----------
        scene : object
            The scene.
        rays : Rays
            Rays of all cameras.

        Returns
        -------
        array
            Linear luminance with white at 1, or linear red, green and blue on a last axis, of float16, float32 or
            float64, shape (cameras, height, width), on :attr:`device`, of any library with DLPack.
        """
        raise AmiwarpError(
            f"{type(self).__name__} has no method luminance; derive a class from amiwarp.Renderer that has it"
        )

    def cameras_at(self, scene: Any) -> Any:
        """Return the places of the cameras.

        Parameters
        ----------
        scene : object
            The scene.

        Returns
        -------
        warp.array or None
            Transforms from the simulator's camera frame to its world, shape (cameras,); None if they are not known.
        """
        return None

    def bodies(self, scene: Any) -> Any:
        """Return the places of the bodies.

        Parameters
        ----------
        scene : object
            The scene.

        Returns
        -------
        warp.array or None
            Transforms from the frame of each body to the world, shape (bodies,); None if they are not known.
        """
        return None

    def surfaces(self, scene: Any, rays: Rays) -> Surfaces | None:
        """Return what the rays hit.

        Parameters
        ----------
        scene : object
            The scene.
        rays : Rays
            Rays of all cameras, one for each pixel.

        Returns
        -------
        Surfaces or None
            What they hit; None if it is not known.
        """
        return None
