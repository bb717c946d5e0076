"""What the translators read: pictures, pictures with events, or events alone, as pictures for the simulator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import MetadataValue, Recording
from amiwarp.io.formats import detect_format, open_recording
from amiwarp.optics.camera import Camera
from amiwarp.simulation.description import Frames, Still
from amiwarp.simulation.motion import CameraMotion
from amiwarp.simulation.picture_light import read_picture
from amiwarp.simulation.picture_opening import PICTURE_SUFFIXES, open_pictures
from amiwarp.simulation.pictures import Pictures
from amiwarp.simulation.translation.camera_motion import Window, find_motion, motion_of
from amiwarp.simulation.translation.centred_camera import RectifiedPictures, centred, is_centred
from amiwarp.simulation.translation.datasets import DataSet
from amiwarp.simulation.translation.event_pictures import EventPictures
from amiwarp.simulation.translation.motion_pictures import MotionPictures
from amiwarp.simulation.translation.mvsec import MvsecPictures, open_mvsec
from amiwarp.simulation.translation.picture_pair import Interpolation
from amiwarp.simulation.translation.reconstructed_pictures import ReconstructedPictures
from amiwarp.simulation.translation.saccades import SACCADE_US, SACCADES_PX, saccade_rates, saccades
from amiwarp.tasks import Progress

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
    """Camera that sees the pictures: the recording's camera without its distortion, or one with the default view."""
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
        _check_unused("mvsec, whose pictures have times", fps=fps)
        path = _path(source, "mvsec")
        pictures = open_mvsec(path)
        events = path if events is None else events
        return _with_events(pictures, _recording(events), interpolation)
    if isinstance(source, Recording) or (
        isinstance(source, str | Path) and _is_recording(Path(source))
    ):
        if events is not None:
            raise AmiwarpError(
                f"{source} is a recording, and events are given too; give one of them, or pictures",
                ErrorCode.OPTIONS,
            )
        _check_unused("a recording, which has no pictures", fps=fps, interpolation=interpolation)
        return _from_events(_recording(source), dataset, device, progress)
    if dataset is DataSet.N_CALTECH101:
        _check_unused(
            "a still picture of n-caltech101", events=events, fps=fps, interpolation=interpolation
        )
        return _from_picture(_path(source, "n-caltech101"))
    if isinstance(source, Pictures):
        _check_unused("opened pictures, which have times", fps=fps)
        pictures = source
    else:
        pictures = open_pictures(source, fps=fps)
    if events is not None:
        return _with_events(pictures, _recording(events), interpolation)
    frames = MotionPictures(pictures, interpolation)
    about: dict[str, MetadataValue] = {
        "translated_from": "pictures",
        "interpolation": interpolation.value,
    }
    return TranslatorInput(
        frames, pictures.duration_us, Camera.from_fov(*pictures.size, DEFAULT_FOV), about=about
    )


def _check_unused(what: str, **settings: object) -> None:
    """Raise :class:`AmiwarpError` for a setting that is given, but does not apply to ``what``."""
    for name, value in settings.items():
        if value is not None and value is not Interpolation.AUTO:
            raise AmiwarpError(
                f"{name} is given, but does not apply to {what}; leave it out", ErrorCode.OPTIONS
            )


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
        raise AmiwarpError(
            f"data set {dataset} is given with {type(source).__name__}; give the path of a file"
        )
    return Path(source)


def _recording(source: str | Path | Recording) -> Recording:
    return source if isinstance(source, Recording) else open_recording(source)


def _with_events(
    pictures: Pictures | MvsecPictures, recording: Recording, interpolation: Interpolation
) -> TranslatorInput:
    """Return pictures between which the events tell the brightness."""
    start = getattr(pictures, "start_us", None)
    if not len(recording.events):
        raise AmiwarpError(
            f"{recording.name} has no events; give a recording with events, or translate the pictures",
            ErrorCode.CONTENT_MISSING,
        )
    fast = EventPictures(
        pictures,
        recording.events,
        recording.events.t_first if start is None else start,
        interpolation,
    )
    about: dict[str, MetadataValue] = {
        "translated_from": "pictures and events",
        "interpolation": interpolation.value,
        "source_contrast_on": fast.contrasts[0],
        "source_contrast_off": fast.contrasts[1],
    }
    camera = recording.camera or Camera.from_fov(*pictures.size, DEFAULT_FOV)
    frames = fast if is_centred(camera) else RectifiedPictures(fast, camera)
    return TranslatorInput(frames, fast.duration_us, centred(camera), about=about)


def _from_events(
    recording: Recording, dataset: DataSet | None, device: Any, progress: Progress | None
) -> TranslatorInput:
    """Return pictures that are reconstructed from the events of a plain event camera."""
    if not len(recording.events):
        raise AmiwarpError(
            f"{recording.name} has no events; give a recording with events",
            ErrorCode.CONTENT_MISSING,
        )
    if recording.prism is not None:
        raise AmiwarpError(
            f"{recording.name} was recorded through a prism; give a recording of a plain event camera"
        )
    camera = recording.camera or Camera.from_fov(*recording.events.size, DEFAULT_FOV)
    if dataset is DataSet.N_CALTECH101:
        windows = _saccade_windows(recording.events.t_first, camera)
        motion = saccades(camera)
    else:
        windows = find_motion(recording, camera, device=device, progress=progress)
        motion = motion_of(windows)
    frames = ReconstructedPictures(recording, camera, windows, motion, device=device)
    about: dict[str, MetadataValue] = {"translated_from": "events", "windows": len(windows)}
    return TranslatorInput(frames, frames.duration_us, centred(camera), about=about)


def _saccade_windows(start_us: int, camera: Camera) -> list[Window]:
    """Return one window for each saccade."""
    rates = saccade_rates(camera)
    return [Window(start_us + k * SACCADE_US, SACCADE_US, rate) for k, rate in enumerate(rates)]


def _from_picture(path: Path) -> TranslatorInput:
    """Return a still picture in front of which the camera makes the saccades of N-Caltech101."""
    light = read_picture(path)
    camera = Camera.from_fov(light.shape[1], light.shape[0], DEFAULT_FOV)
    duration = float(len(SACCADES_PX) * SACCADE_US)
    about: dict[str, MetadataValue] = {
        "translated_from": "picture",
        "dataset": DataSet.N_CALTECH101.value,
    }
    return TranslatorInput(Still(light), duration, camera, saccades(camera), about)


def with_camera(given: TranslatorInput, camera: Camera) -> TranslatorInput:
    """Return the input for another camera; the image of a still picture moves by the same number of pixels."""
    moves = isinstance(given.frames, Still)
    return replace(
        given,
        camera=camera,
        camera_motion=saccades(camera) if moves else given.camera_motion,
    )
