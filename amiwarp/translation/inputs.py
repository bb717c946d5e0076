"""What the translators read: pictures, pictures with events, or events alone, as pictures for the simulator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.io.formats import detect_format, open_recording
from amiwarp.optics.camera import Camera
from amiwarp.progress import Progress
from amiwarp.simulation.description import Still
from amiwarp.simulation.motion import CameraMotion
from amiwarp.simulation.pictures import read_picture
from amiwarp.simulation.sequences import (
    PICTURE_SUFFIXES,
    PictureFolder,
    Pictures,
    PictureStack,
    VideoFile,
    open_pictures,
)
from amiwarp.translation.datasets import (
    SACCADE_US,
    SACCADES_PX,
    DataSet,
    MvsecPictures,
    open_mvsec,
    saccade_rates,
    saccades,
)
from amiwarp.translation.pictures_between import EventPictures, Interpolation, MotionPictures
from amiwarp.translation.reconstructed_pictures import (
    ReconstructedPictures,
    RectifiedPictures,
    Window,
    centred,
    find_motion,
    is_centred,
    motion_of,
)

if TYPE_CHECKING:
    from amiwarp.simulation.description import Frames

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
        pictures, events = open_mvsec(path), path if events is None else events
        return _with_events(pictures, _recording(events), interpolation)
    if isinstance(source, Recording) or (isinstance(source, str | Path) and _is_recording(Path(source))):
        if events is not None:
            raise AmiwarpError(f"{source} is a recording, and events are given too; give one of them, or pictures")
        return _from_events(_recording(source), dataset, device, progress)
    if dataset is DataSet.N_CALTECH101:
        return _from_picture(_path(source, "n-caltech101"))
    pictures = (
        source if isinstance(source, PictureFolder | PictureStack | VideoFile) else open_pictures(source, fps=fps)
    )
    if events is not None:
        return _with_events(pictures, _recording(events), interpolation)
    frames = MotionPictures(pictures, interpolation)
    about: dict[str, MetadataValue] = {"translated_from": "pictures", "interpolation": interpolation.value}
    return TranslatorInput(frames, pictures.duration_us, Camera.from_fov(*pictures.size, DEFAULT_FOV), about=about)


def _is_recording(path: Path) -> bool:
    """Whether a file is a recording of events, by its content."""
    if path.is_dir() or path.suffix.lower() in (".npy", *PICTURE_SUFFIXES) or not path.exists():
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
    frames = fast if is_centred(camera) else RectifiedPictures(fast, camera)
    return TranslatorInput(frames, fast.duration_us, centred(camera), about=about)


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
        windows, motion = _saccade_windows(recording.events.t_first, camera), saccades(camera)
    else:
        windows = find_motion(recording, camera, device=device, progress=progress)
        motion = motion_of(windows)
    frames = ReconstructedPictures(recording, camera, windows, motion, device=device)
    about: dict[str, MetadataValue] = {"translated_from": "events", "windows": len(windows)}
    return TranslatorInput(frames, frames.duration_us, centred(camera), about=about)


def _saccade_windows(start_us: int, camera: Camera) -> list[Window]:
    """Return one window for each saccade."""
    rates = saccade_rates(camera)
    return [Window(start_us + k * SACCADE_US, SACCADE_US, each) for k, each in enumerate(rates)]


def _from_picture(path: Path) -> TranslatorInput:
    """Return a still picture in front of which the camera makes the saccades of N-Caltech101."""
    light = read_picture(path)
    camera = Camera.from_fov(light.shape[1], light.shape[0], DEFAULT_FOV)
    duration = float(len(SACCADES_PX) * SACCADE_US)
    about: dict[str, MetadataValue] = {"translated_from": "picture", "dataset": DataSet.N_CALTECH101.value}
    return TranslatorInput(Still(light), duration, camera, saccades(camera), about)


def with_camera(given: TranslatorInput, camera: Camera) -> TranslatorInput:
    """Return the input for another camera; the image of a still picture moves by the same number of pixels."""
    moves = isinstance(given.frames, Still)
    return replace(given, camera=camera, camera_motion=saccades(camera) if moves else given.camera_motion)
