"""World and camera trajectory, as the scene of a simulation."""

from __future__ import annotations

from dataclasses import dataclass

from amiwarp.simulation.worlds.choices import Seeing
from amiwarp.simulation.worlds.scene import World
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.validation import choice, guarded, instance, one_of, real, shown

SAMPLES = (1, 4, 9, 16)
"""Allowed numbers of rays per pixel or per texel."""


@guarded
@dataclass(frozen=True, eq=False)
class WorldScene:
    """Scene of a simulation in which a camera moves through a world, as an alternative to :class:`amiwarp.Scene`."""

    world: World
    """World that the camera sees."""
    trajectory: Trajectory
    """Pose of the camera over time."""
    blur: float = 0.5
    """Standard deviation of the optical blur, including the area of the pixel [px].

    The blur has no effect with ``seeing="rays"`` and ``samples=1``.
    """
    seeing: Seeing = Seeing.MAPS
    """Method by which the light that each pixel receives is computed."""
    samples: int | None = None
    """Number of rays: 1, 4, 9 or 16; None stands for 4.

    With maps, the rays of each texel at an edge; with rays, the rays of each pixel, which search the whole world only
    at edges.
    """
    motion_px: float = 0.5
    """Largest motion of the image between two successive maps [px], 0.01 to 2. Has no effect with rays."""

    def __post_init__(self) -> None:
        instance(self.world, World, "world scene's world")
        instance(self.trajectory, Trajectory, "world scene's trajectory")
        object.__setattr__(self, "blur", real(self.blur, "scene blur", 0.0, 20.0, " px"))
        object.__setattr__(self, "seeing", choice(Seeing, self.seeing, "seeing"))
        object.__setattr__(self, "motion_px", real(self.motion_px, "motion_px", 0.01, 2.0, " px"))
        if self.samples is not None:
            one_of(shown(self.samples), [str(n) for n in SAMPLES], "samples")
