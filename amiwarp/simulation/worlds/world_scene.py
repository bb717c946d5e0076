"""A camera that moves through a world, as the scene of a simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from amiwarp.schema.calls import guarded
from amiwarp.simulation.choices import Seeing
from amiwarp.simulation.worlds.trajectory import Trajectory
from amiwarp.simulation.worlds.world import World
from amiwarp.validation import choice, instance, one_of, real, whole

if TYPE_CHECKING:
    pass

BLUR_PX = 0.5
"""Default standard deviation of the optical blur, including the area of the pixel [sensor px]."""

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
    blur: float = BLUR_PX
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
            samples = whole(self.samples, "samples", SAMPLES[0], SAMPLES[-1])
            one_of(str(samples), [str(n) for n in SAMPLES], "samples")
            object.__setattr__(self, "samples", samples)
