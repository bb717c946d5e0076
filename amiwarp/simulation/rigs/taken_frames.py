"""Frames and depth images of a simulated rig, one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.io import RecordingWriter
from amiwarp.simulation.rigs.cameras import RigDepthCamera, RigFrameCamera
from amiwarp.simulation.rigs.depth_renderer import DepthRenderer
from amiwarp.simulation.rigs.frame_renderer import FrameRenderer
from amiwarp.simulation.rigs.pixel_values import pixel_values
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.tasks import Progress, silent


@dataclass(frozen=True, slots=True, eq=False)
class TakenFrame:
    """Frame or depth image of a camera."""

    t_us: int
    image: NDArray[Any] | None = None
    exposure_us: tuple[int, int] | None = None
    depth: NDArray[np.float32] | None = None

    def append_to(self, writer: RecordingWriter) -> None:
        """Append the frame to a recording."""
        writer.append_image(self.t_us, self.image, exposure_us=self.exposure_us, depth=self.depth)


def taken_frames(
    sensor: RigFrameCamera | RigDepthCamera,
    scene: WorldScene,
    duration_s: float,
    *,
    seed: int,
    device: str,
    progress: Progress = silent,
) -> Iterator[TakenFrame]:
    """Yield the frames or depth images that a camera takes on its way through a world."""
    times = sensor.times(duration_s).tolist()
    if isinstance(sensor, RigDepthCamera):
        depths = DepthRenderer(sensor, scene, device)
        for k, t_us in enumerate(times):
            yield TakenFrame(t_us, depth=depths.depth(t_us))
            progress("simulating", (k + 1) / len(times))
        return
    frames = FrameRenderer(sensor, scene, device)
    for k, (begin_us, end_us) in enumerate(sensor.exposures(duration_s).tolist()):
        # Each frame has its own random numbers, whatever was drawn for those before.
        image = pixel_values(sensor, frames.light(begin_us), np.random.default_rng([seed, k]))
        yield TakenFrame(times[k], image, (begin_us, end_us))
        progress("simulating", (k + 1) / len(times))
