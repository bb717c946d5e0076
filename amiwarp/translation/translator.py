"""Translate pictures and recordings of plain event cameras to recordings of the same scene through the prism."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.io.formats import detect_format, open_recording
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.progress import Progress
from amiwarp.simulation import pictures as sequences
from amiwarp.simulation.description import CameraMotion, EncoderModel, Frames, PrismMotion, Scene, SensorModel, Still
from amiwarp.simulation.pictures import Pictures, read_picture
from amiwarp.simulation.simulator import Simulation
from amiwarp.translation import datasets, reconstructed_pictures
from amiwarp.translation.datasets import DataSet, MvsecPictures
from amiwarp.translation.pictures_between import EventPictures, Interpolation, MotionPictures
from amiwarp.translation.reconstructed_pictures import Window
from amiwarp.validation import check_names, choice, guarded

# What the translators read: pictures, pictures with events, or events alone, as pictures for the simulator.

DEFAULT_FOV = math.radians(60.0)
"""Default horizontal field of view of the camera [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class TranslatorInput:
    """Pictures for the simulator, and what they were made from."""

    frames: Frames
    """The pictures."""
    duration_us: float
    """Duration [us]."""
    camera: Camera
    """Camera that sees the pictures: that of the recording without its distortion, or one with the default view."""
    camera_motion: CameraMotion = field(default_factory=CameraMotion)
    """Rotation of the camera in front of a still picture."""
    about: Mapping[str, MetadataValue] = field(default_factory=dict)
    """How the pictures were made, for the metadata of the recording."""


def translator_input(
    source: str | Path | Pictures | Recording,
    *,
    events: str | Path | Recording | None = None,
    dataset: DataSet | None = None,
    interpolation: Interpolation = Interpolation.AUTO,
    fps: float | None = None,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> TranslatorInput:
    """Open what is to be translated. Raises :class:`AmiwarpError` if it cannot be read."""
    pictures: Pictures | MvsecPictures
    if dataset is DataSet.MVSEC:
        path = _path(source, "mvsec")
        pictures, events = datasets.open_mvsec(path), path if events is None else events
        return _with_events(pictures, _recording(events), interpolation)
    if isinstance(source, Recording) or (isinstance(source, str | Path) and _is_recording(Path(source))):
        if events is not None:
            raise AmiwarpError(f"{source} is a recording, and events are given too; give one of them, or pictures")
        return _from_events(_recording(source), dataset, device, progress)
    if dataset is DataSet.N_CALTECH101:
        return _from_picture(_path(source, "n-caltech101"))
    pictures = (
        source
        if isinstance(source, sequences.PictureFolder | sequences.PictureStack | sequences.VideoFile)
        else sequences.open_pictures(source, fps=fps)
    )
    if events is not None:
        return _with_events(pictures, _recording(events), interpolation)
    frames = MotionPictures(pictures, interpolation)
    about: dict[str, MetadataValue] = {"translated_from": "pictures", "interpolation": interpolation.value}
    return TranslatorInput(frames, pictures.duration_us, Camera.from_fov(*pictures.size, DEFAULT_FOV), about=about)


def _is_recording(path: Path) -> bool:
    """Whether a file is a recording of events, by its content."""
    if path.is_dir() or path.suffix.lower() in (".npy", *sequences.PICTURE_SUFFIXES) or not path.exists():
        return False
    try:
        detect_format(path)
    except AmiwarpError:
        return False
    return True


def _path(source: object, dataset: str) -> Path:
    if not isinstance(source, str | Path):
        raise AmiwarpError(f"data set {dataset} is given with {type(source).__name__}; give the path of a file")
    return Path(source)


def _recording(source: str | Path | Recording) -> Recording:
    return source if isinstance(source, Recording) else open_recording(source)


def _with_events(
    pictures: Pictures | MvsecPictures, recording: Recording, interpolation: Interpolation
) -> TranslatorInput:
    """Return pictures between which the events tell the brightness."""
    start = getattr(pictures, "start_us", None)
    if not len(recording.events):
        raise AmiwarpError(f"{recording.name} has no events; give a recording with events, or translate the pictures")
    fast = EventPictures(
        pictures, recording.events, recording.events.t_first if start is None else start, interpolation
    )
    about: dict[str, MetadataValue] = {
        "translated_from": "pictures and events", "interpolation": interpolation.value,
        "source_contrast_on": fast.contrasts[0], "source_contrast_off": fast.contrasts[1],
    }  # fmt: skip
    camera = recording.camera or Camera.from_fov(*pictures.size, DEFAULT_FOV)
    frames = (
        fast if reconstructed_pictures.is_centred(camera) else reconstructed_pictures.RectifiedPictures(fast, camera)
    )
    return TranslatorInput(frames, fast.duration_us, reconstructed_pictures.centred(camera), about=about)


def _from_events(
    recording: Recording, dataset: DataSet | None, device: Any, progress: Progress | None
) -> TranslatorInput:
    """Return pictures that are reconstructed from the events of a plain event camera."""
    if not len(recording.events):
        raise AmiwarpError(f"{recording.name} has no events; give a recording with events")
    if recording.prism is not None:
        raise AmiwarpError(f"{recording.name} was recorded through a prism; give a recording of a plain event camera")
    camera = recording.camera or Camera.from_fov(*recording.events.size, DEFAULT_FOV)
    if dataset is DataSet.N_CALTECH101:
        windows, motion = _saccade_windows(recording.events.t_first, camera), datasets.saccades(camera)
    else:
        windows = reconstructed_pictures.find_motion(recording, camera, device=device, progress=progress)
        motion = reconstructed_pictures.motion_of(windows)
    frames = reconstructed_pictures.ReconstructedPictures(recording, camera, windows, motion, device=device)
    about: dict[str, MetadataValue] = {"translated_from": "events", "windows": len(windows)}
    return TranslatorInput(frames, frames.duration_us, reconstructed_pictures.centred(camera), about=about)


def _saccade_windows(start_us: int, camera: Camera) -> list[Window]:
    """Return one window for each saccade."""
    rates = datasets.saccade_rates(camera)
    return [Window(start_us + k * datasets.SACCADE_US, datasets.SACCADE_US, each) for k, each in enumerate(rates)]


def _from_picture(path: Path) -> TranslatorInput:
    """Return a still picture in front of which the camera makes the saccades of N-Caltech101."""
    light = read_picture(path)
    camera = Camera.from_fov(light.shape[1], light.shape[0], DEFAULT_FOV)
    duration = float(len(datasets.SACCADES_PX) * datasets.SACCADE_US)
    about: dict[str, MetadataValue] = {"translated_from": "picture", "dataset": DataSet.N_CALTECH101.value}
    return TranslatorInput(Still(light), duration, camera, datasets.saccades(camera), about)


def with_camera(given: TranslatorInput, camera: Camera) -> TranslatorInput:
    """Return the input for another camera; the image of a still picture moves by the same number of pixels."""
    moves = isinstance(given.frames, Still)
    return replace(given, camera=camera, camera_motion=datasets.saccades(camera) if moves else given.camera_motion)


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
    given = source if isinstance(source, TranslatorInput) else translator_input(
        source, events=events, dataset=None if dataset is None else choice(DataSet, dataset, "dataset"),
        interpolation=choice(Interpolation, interpolation, "interpolation"), fps=fps, device=device, progress=progress,
    )  # fmt: skip
    if camera is not None:
        given = with_camera(given, camera)
    duration = given.duration_us * 1e-6 if duration_s is None else duration_s
    if not duration > 0.0:
        raise AmiwarpError(f"{source} does not state its duration; give duration_s")
    return Simulation(
        Scene(given.frames, fov, blur=0.0),  # the camera that took the pictures has blurred them
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

    For recordings larger than memory, use ``amiwarp.translation.translator.translation(...).write(path)``.

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
        stacks), ``fov`` (horizontal field of view of the pictures [rad]; pixels beyond it are unknown), ``camera``,
        ``duration_s``, ``motion``, ``sensor``, ``encoder``, ``nominal_prism``, ``seed`` and ``device``, as for
        :func:`simulate`. By default, the pictures are just large enough to cover everything that the camera sees
        through the turning prism. The camera has the size of the pictures, and the horizontal field of view of the
        recording's camera, or 60 degrees. The recording lasts as long as the source.

    Returns
    -------
    Recording
        The recording, with ground truth. ``truth.known`` tells which pixels the source determines.

    Raises
    ------
    AmiwarpError
        If the source cannot be read, the pictures do not change as the events say, or a value is out of range.

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
    known = inspect.signature(translation).parameters.keys() - inspect.signature(translate).parameters.keys()
    check_names(settings, sorted(known), "translate: setting ")
    work = translation(source, prism, events=events, dataset=dataset, progress=progress, **settings)
    return work.run(progress=progress)
