"""Translate pictures and recordings of plain event cameras to recordings of the same scene through the prism."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.schema.calls import guarded
from amiwarp.simulation.description import Scene
from amiwarp.simulation.encoder_model import EncoderModel
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.pictures import Pictures
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.translation.datasets import DataSet
from amiwarp.simulation.translation.picture_pair import Interpolation
from amiwarp.simulation.translation.translator_input import (
    TranslatorInput,
    translator_input,
    with_camera,
)
from amiwarp.simulation.worlds.world_scene import BLUR_PX
from amiwarp.tasks import Progress
from amiwarp.validation import check_names, choice


@guarded
def translation(
    source: str | Path | Pictures | Recording | TranslatorInput,
    prism: Prism,
    *,
    events: str | Path | Recording | None = None,
    dataset: DataSet | str | None = None,
    interpolation: Interpolation | str = Interpolation.AUTO,
    fps: float | None = None,
    fov: float | None = None,
    blur: float = BLUR_PX,
    camera: Camera | None = None,
    duration_s: float | None = None,
    motion: PrismMotion | float = 720.0,
    sensor: SensorModel | None = None,
    encoder: EncoderModel | None = None,
    nominal_prism: Prism | None = None,
    seed: int = 0,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Simulation:
    """Set up the simulation of what is translated, with the settings of :func:`translate`."""
    if isinstance(source, TranslatorInput):
        given = source
    else:
        given = translator_input(
            source,
            events=events,
            dataset=None if dataset is None else choice(DataSet, dataset, "dataset"),
            interpolation=choice(Interpolation, interpolation, "interpolation"),
            fps=fps,
            device=device,
            progress=progress,
        )
    if camera is not None:
        given = with_camera(given, camera)
    duration = given.duration_us * 1e-6 if duration_s is None else duration_s
    if not duration > 0.0:
        raise AmiwarpError(
            "the source does not state its duration; give duration_s", ErrorCode.CONTENT_MISSING
        )
    return Simulation(
        Scene(given.frames, fov, blur),
        given.camera,
        prism,
        duration,
        motion if isinstance(motion, PrismMotion) else PrismMotion(motion),
        given.camera_motion,
        sensor=sensor or SensorModel(),
        encoder_model=encoder or EncoderModel(),
        nominal_prism=nominal_prism,
        seed=seed,
        device=device,
        source=given.about,
    )


@guarded
def translate(
    source: str | Path | Pictures | Recording,
    prism: Prism,
    *,
    events: str | Path | Recording | None = None,
    dataset: DataSet | str | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Recording:
    """Simulate the recording, through the prism, of pictures or of what a plain event camera has recorded.

    For recordings larger than memory, use ``amiwarp.simulation.translation.translator.translation(...).write(path)``.

    Parameters
    ----------
    source : str, Path, Pictures or Recording
        Video file, folder of pictures, .npy stack, or opened pictures. Or a recording of an event camera without a
        prism that rotates in front of a still scene, which is then translated from its events alone.
    prism : Prism
        The true prism.
    events : str, Path or Recording, optional
        Recording of the events between the pictures, by the same camera. A folder of pictures gives times on the clock
        of the events (``times.csv``); other pictures begin at the first event.
    dataset : DataSet or str, optional
        Data set that the source belongs to: ``n-caltech101`` or ``mvsec``.
    progress : Progress, optional
        Called with the stage and the finished share.
    **settings : dict
        Optional settings: ``interpolation`` (:class:`Interpolation`), ``fps`` (pictures per second, required for
        .npy stacks), ``fov`` (horizontal field of view of the pictures [rad]; pixels beyond it are unknown), ``blur``
        (standard deviation of the optical blur [sensor px], by default 0.5 as in :func:`simulate`; 0 for pictures of a
        camera with the same resolution, which has blurred them already), ``camera``, ``duration_s``, ``motion``,
        ``sensor``, ``encoder``, ``nominal_prism``, ``seed`` and ``device``, as for :func:`simulate`. By default, the
        pictures are just large enough to cover everything that the camera sees through the turning prism. The camera
        has the size of the pictures, and the horizontal field of view of the recording's camera, or 60 degrees. The
        recording lasts as long as the source.

    Returns
    -------
    Recording
        The recording, with ground truth. ``truth.known`` tells which pixels the source determines.

    Raises
    ------
    AmiwarpError
        If the source cannot be read, the pictures do not change as the events say, a value is out of range, or a
        setting does not apply to the source.

    Notes
    -----
    Each way has its limits; see ``docs/explanation/translators.md``.

    Examples
    --------
    >>> import numpy as np
    >>> pictures = np.random.default_rng(0).integers(0, 256, (3, 24, 32), np.uint8)
    >>> stack = amiwarp.PictureStack(pictures, fps=200.0, name="random")
    >>> amiwarp.translate(stack, amiwarp.Prism(0.03)).events.size
    (32, 24)
    """
    known = (
        inspect.signature(translation).parameters.keys()
        - inspect.signature(translate).parameters.keys()
    )
    check_names(settings, sorted(known), "translate: setting ")
    work = translation(source, prism, events=events, dataset=dataset, progress=progress, **settings)
    return work.run(progress=progress)
