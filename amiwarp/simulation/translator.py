"""Simulation of the recording of a picture sequence (a video, a folder or an array) seen through the prism."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amiwarp.errors import AmiwarpError
from amiwarp.optics.camera import Camera
from amiwarp.progress import Progress
from amiwarp.simulation.motion import EncoderModel, PrismMotion
from amiwarp.simulation.scene import Scene
from amiwarp.simulation.sensor import SensorModel
from amiwarp.simulation.sequences import Pictures, open_pictures
from amiwarp.simulation.simulator import Simulation

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording
    from amiwarp.optics.prism import Prism

DEFAULT_FOV = math.radians(60.0)
"""Default horizontal field of view of the camera [rad]."""


def translation(
    source: str | Path | Pictures,
    prism: Prism,
    *,
    fps: float | None = None,
    camera: Camera | None = None,
    duration_s: float | None = None,
    motion: PrismMotion | float = 720.0,
    sensor: SensorModel | None = None,
    encoder: EncoderModel | None = None,
    nominal_prism: Prism | None = None,
    seed: int = 0,
    device: str = "cpu",
) -> Simulation:
    """Return the simulation of a picture sequence. Log intensity is interpolated linearly between pictures.

    Each picture fills the camera's view, as a still picture does. By default, the camera has the size of the pictures
    and a field of view of 60 degrees, and the recording lasts as long as the pictures.
    """
    pictures = source if isinstance(source, Pictures) else open_pictures(source, fps=fps)
    duration = pictures.duration_us * 1e-6 if duration_s is None else duration_s
    if not duration > 0.0:
        raise AmiwarpError(f"{source} does not state its duration; give the duration as duration_s")
    return Simulation(
        Scene(pictures),
        camera or Camera.from_fov(*pictures.size, DEFAULT_FOV),
        prism,
        duration,
        motion if isinstance(motion, PrismMotion) else PrismMotion(motion),
        sensor=sensor or SensorModel(),
        encoder_model=encoder or EncoderModel(),
        nominal_prism=nominal_prism,
        seed=seed,
        device=device,
    )


def translate(
    source: str | Path | Pictures,
    prism: Prism,
    *,
    progress: Progress | None = None,
    **settings: Any,
) -> Recording:
    """Simulate the recording of a picture sequence seen through the prism.

    For recordings larger than memory, use ``amiwarp.simulation.translator.translation(...).write(path)``.

    Parameters
    ----------
    source : str, Path or Pictures
        Video file, folder of pictures, .npy stack, or opened pictures.
    prism : Prism
        The true prism.
    progress : Progress, optional
        Called with the finished share.
    **settings : dict
        Optional settings: ``fps`` (pictures per second, required for stacks), ``camera``, ``duration_s``, ``motion``,
        ``sensor``, ``encoder``, ``nominal_prism``, ``seed`` and ``device``, as for :func:`simulate`. By default, the
        camera has the size of the pictures and a horizontal field of view of 60 degrees, and the recording lasts as
        long as the pictures.

    Returns
    -------
    Recording
        The recording, with ground truth.

    Raises
    ------
    AmiwarpError
        If the pictures cannot be read, or a value is out of range.

    Examples
    --------
    >>> import numpy as np
    >>> pictures = np.random.default_rng(0).integers(0, 256, (3, 24, 32), np.uint8)
    >>> stack = amiwarp.PictureStack(pictures, fps=200.0, name="random")
    >>> amiwarp.translate(stack, amiwarp.Prism(0.03)).events.size
    (32, 24)
    """
    return translation(source, prism, **settings).run(progress=progress)
