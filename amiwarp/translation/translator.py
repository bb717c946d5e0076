"""Translate pictures and recordings of plain event cameras to recordings of the same scene through the prism."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import CONTRAST, Sharpness, Vote
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, MetadataValue, Recording
from amiwarp.imaging.iwe import CanvasShape, Votes, upload_events
from amiwarp.imaging.sharpness import SharpnessMeter
from amiwarp.io.formats import detect_format, open_recording
from amiwarp.optics.camera import Camera, CameraRotation
from amiwarp.optics.models import ExactModel
from amiwarp.optics.prism import Prism
from amiwarp.reconstruction.picture import Reconstruction
from amiwarp.simulation.description import CameraMotion, EncoderModel, Frames, PrismMotion, Scene, Still
from amiwarp.simulation.pictures import PICTURE_SUFFIXES, Pictures, open_pictures, read_picture
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.simulation.simulator import Simulation
from amiwarp.simulation.worlds.world import BLUR_PX
from amiwarp.tasks import Progress
from amiwarp.translation import sources
from amiwarp.translation.sources import DataSet, EventPictures, Interpolation, KnownPictures, MotionPictures
from amiwarp.validation import check_names, choice, guarded

# Pictures of a camera with lens distortion or an off-centre axis, as a centred pinhole camera sees them.


def centred(camera: Camera) -> Camera:
    """Return the pinhole camera of the same size and horizontal field of view, with its axis in the middle."""
    return Camera.from_fov(camera.width, camera.height, camera.fov)


def is_centred(camera: Camera) -> bool:
    """Whether :func:`centred` changes nothing, up to a hundredth of a pixel."""
    same, names = centred(camera), ("fx", "fy", "cx", "cy")
    return camera.distortion is None and all(abs(getattr(camera, n) - getattr(same, n)) < 0.01 for n in names)


def pixel_grid(camera: Camera) -> NDArray[np.float64]:
    """Return all pixels of a camera, row by row [px], shape (n, 2)."""
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([x, y], axis=2).reshape(-1, 2).astype(np.float64)


def looking(
    camera: Camera, rays: NDArray[np.float64], shape: tuple[int, ...]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return where rays meet the image of a camera, for one ray per pixel of an image of ``shape`` (height, width).

    The first array is the offset from each pixel [px], shape (height, width, 2); the second tells whether the ray meets
    the image.
    """
    rows, columns = np.indices(shape)
    xy = np.asarray(camera.rays_to_pixels(rays), np.float64).reshape(*shape, 2)
    inside = (xy >= -0.5).all(axis=2) & (xy[..., 0] < camera.width - 0.5) & (xy[..., 1] < camera.height - 0.5)
    return np.nan_to_num(xy - np.stack([columns, rows], axis=2)).astype(np.float32), inside


class RectifiedPictures:
    """Pictures as a centred pinhole camera without distortion sees them (:class:`amiwarp.Frames`)."""

    def __init__(self, pictures: EventPictures, camera: Camera) -> None:
        """``camera``: the camera that took the pictures."""
        self._pictures = pictures
        rays = np.asarray(centred(camera).pixels_to_rays(pixel_grid(camera)))
        self._offset, self._inside = looking(camera, rays, (camera.height, camera.width))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture [px]."""
        return self._pictures.size

    @property
    def interval_us(self) -> float:
        """Smallest time between two pictures [us]."""
        return self._pictures.interval_us

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield time [us] and linear luminance, shape (height, width)."""
        for t, light in self._pictures.read():
            yield t, np.maximum(sources.warped(light, self._offset), np.float32(0.0))

    def take_known(self) -> list[tuple[int, NDArray[np.bool_]]]:
        """Return, and forget, the masks of the pictures read so far."""
        taken = self._pictures.take_known()
        return [(t, (sources.warped(mask.astype(np.float32), self._offset) > 0.5) & self._inside) for t, mask in taken]


# Rotation of a plain event camera over time, by contrast maximisation in successive windows.

MOTION_PX = 6.0
"""Wanted motion of the image in a window [px]: enough for each pixel to see several parts of the scene."""
WINDOW_US = (10_000, 250_000)
"""Shortest and longest window [us]."""
FIRST_US = 40_000
"""Length of the first window [us]."""
MOST_EVENTS = 30_000
"""Largest number of events per window whose sharpness is measured; more are thinned evenly."""
LEAST_EVENTS = 200
"""Smallest number of events in a window from which a motion is found."""
LEAST_PX = 1.0
"""Motion of the image in a window below which the next search starts from all directions, and nothing is known [px]."""
STARTS_PX = (2.0, 5.0, 10.0)
"""Motions of the image in a window that are tried in eight directions [px]."""
SMOOTHING_PX = COARSE_PX, FINE_PX = 2.0, 1.0
"""Standard deviations of the Gaussians that smooth the image of warped events [px]."""
TOLERANCE_PX = 0.02
"""A search ends when its steps move the image by less than this in the window [px]."""
EVALUATIONS = 120
"""Largest number of images of warped events per search."""
BEST = 2
"""Number of starts that are refined."""
PAD = 16
"""Border of the image of warped events [px]."""


@dataclass(frozen=True, slots=True)
class Window:
    """A time window and the camera's angular velocity in it."""

    start_us: int
    """Start [us]."""
    length_us: int
    """Length [us]."""
    rates: tuple[float, float, float]
    """Angular velocity of the camera at the middle [rad/s]."""
    acceleration: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Angular acceleration of the camera [rad/s²]."""

    @property
    def rotation(self) -> CameraRotation:
        """Rotation of the camera about the middle."""
        return CameraRotation(self.rates, self.acceleration, self.middle_us)

    def moves_px(self, camera: Camera) -> float:
        """Return the motion of the image in the window [px]."""
        x, y, z = self.rates
        speed = math.hypot(camera.fy * x, camera.fx * y) + 0.25 * camera.width * abs(z)
        return speed * self.length_us * 1e-6

    @property
    def middle_us(self) -> int:
        """Middle [us]."""
        return self.start_us + self.length_us // 2


def still_encoder(t_first: int, t_last: int) -> Encoder:
    """Return the encoder of a prism that does not turn; with an apex of 0 it stands for no prism."""
    return Encoder(np.array([t_first - 1_000_000, t_last + 1_000_000], np.int64), np.zeros(2))


def find_motion(
    recording: Recording, camera: Camera, *, device: Any = "cpu", progress: Progress | None = None
) -> list[Window]:
    """Return the angular velocity of the camera in windows that overlap by half, from the first event to the last.

    The windows are as long as the image takes to move by :data:`MOTION_PX`. An angular velocity of 0 means that none
    was found.
    """
    first, last = recording.events.t_first, recording.events.t_last
    search = _Search(camera, device)
    windows: list[Window] = []
    start, length = first, min(FIRST_US, max(last - first, 1))
    while not windows or start < last - windows[-1].length_us // 2:
        events = recording.events.between(start, start + length)
        last_rates = windows[-1].rates if windows and windows[-1].moves_px(camera) > LEAST_PX else None
        window = Window(start, length, search.run(events, start, length, last_rates))
        speed = window.moves_px(camera) / length  # px per microsecond
        length = round(float(np.clip(MOTION_PX / max(speed, 1e-9), *WINDOW_US)))
        small = window.moves_px(camera) < 2.0 * LEAST_PX
        if not windows and small and length >= 2 * window.length_us and last - first > window.length_us:
            continue  # the first window was too short to find a motion
        windows.append(window)
        start += window.length_us // 2
        if progress is not None:
            progress("finding the motion", min(1.0, (start - first) / max(last - first, 1)))
    return _with_acceleration(windows)


def _with_acceleration(windows: list[Window]) -> list[Window]:
    """Return the windows with the change of the angular velocity between those before and after."""
    if len(windows) < 2:
        return windows
    t = np.array([window.middle_us for window in windows]) * 1e-6
    change = np.gradient(np.array([window.rates for window in windows]), t - t[0], axis=0)
    return [replace(w, acceleration=(x, y, z)) for w, (x, y, z) in zip(windows, change.tolist(), strict=True)]


def motion_of(windows: list[Window]) -> CameraMotion:
    """Return the rotation through all windows; time 0 is the start of the first."""
    origin = windows[0].start_us
    rows = [((w.middle_us - origin) * 1e-6, *w.rates) for w in windows]
    return CameraMotion(np.array([*rows, *[(t + 1.0, *rates) for t, *rates in rows[-1:]]]))


class _Search:
    """Contrast maximisation over the angular velocity in one window."""

    def __init__(self, camera: Camera, device: Any) -> None:
        self._camera, self._device = camera, device
        self._model = ExactModel(camera, Prism(0.0))
        canvas = CanvasShape(camera.width, camera.height, PAD, 1.0, False, Vote.BILINEAR)
        self._votes = Votes(canvas, device)
        self._meters = {s: SharpnessMeter(canvas, Sharpness.VARIANCE, smoothing=s, device=device) for s in SMOOTHING_PX}

    def run(
        self, events: Events, start: int, length: int, last: tuple[float, float, float] | None
    ) -> tuple[float, float, float]:
        """Return the angular velocity [rad/s] for which the image of warped events is sharpest."""
        from scipy.optimize import minimize

        if len(events) < LEAST_EVENTS:
            return (0.0, 0.0, 0.0)
        middle = start + length // 2
        thinned = events[:: -(-len(events) // MOST_EVENTS)]
        arrays = upload_events(thinned, still_encoder(start, start + length), self._device, middle_us=middle)
        unit = 1e6 / (self._camera.fx * length)  # moves the image by one pixel in the window

        def cost(rates: NDArray[np.float64], smoothing: float = FINE_PX) -> float:
            x, y, z = (unit * rates).tolist()
            meter = self._meters[smoothing]
            self._votes.clear()
            self._votes.add_events(self._model, arrays, camera_rotation=CameraRotation((x, y, z), middle_us=middle))
            self._votes.read(meter.image)
            return -meter.measure()

        starts = self._starts() if last is None else []
        starts += [np.zeros(3), *([] if last is None else [np.array(last) / unit])]
        starts.sort(key=lambda rates: cost(rates, COARSE_PX))
        simplex = np.vstack([np.zeros(3), 1.5 * np.eye(3)])
        limits = {"xatol": TOLERANCE_PX, "fatol": 0.0, "maxfev": EVALUATIONS}
        runs: list[Any] = []
        for at in starts[:BEST]:
            options: Any = {"initial_simplex": at + simplex, **limits}
            runs.append(minimize(cost, at, method="Nelder-Mead", options=options))
        x, y, z = (unit * min(runs, key=lambda run: float(run.fun)).x).tolist()
        return x, y, z

    @staticmethod
    def _starts() -> list[NDArray[np.float64]]:
        angles = np.arange(8) * (math.tau / 8)
        return [size * np.array([np.cos(a), np.sin(a), 0.0]) for size in STARTS_PX for a in angles]


# Fast pictures from events alone: a brightness map for each time window, moved as the camera turns.

MEDIAN_LIGHT = 0.2
"""Luminance of the median of each picture, relative to white: events say nothing about it."""
STEP_PX = 0.5
"""Largest motion between two fast pictures [px]."""
INTERVAL_US = (100.0, 5000.0)
"""Shortest and longest time between two fast pictures [us]."""

View = tuple[int, NDArray[np.float32], NDArray[np.bool_]]
"""Time [us], log intensity and mask of known pixels of a picture."""


class ReconstructedPictures(KnownPictures):
    """Pictures of a recording of a plain event camera that rotates in front of a still scene (:class:`amiwarp.Frames`).

    Each window gives one picture at its middle by linear least squares (:class:`amiwarp.Reconstruction`). In between,
    the pictures before and after are turned with the camera and blended. The pictures are those of a camera without
    distortion, of the same size and field of view.
    """

    def __init__(
        self, recording: Recording, camera: Camera, windows: list[Window], motion: CameraMotion, *, device: Any = "cpu"
    ) -> None:
        """``motion``: rotation of the camera, from the start of the first window on."""
        self._windows, self._source = windows, camera
        self._start_us = windows[0].start_us
        self.duration_us = float(recording.events.t_last - self._start_us)
        """Time from the start of the first window to the last event [us]."""
        self._view = centred(camera)
        self._orientation = motion.orientation(self.duration_us * 1e-6 + 1.0)
        x, y, z = motion.largest_rates
        self._speed = float(np.hypot(camera.fy * x, camera.fx * y)) + 0.5 * camera.width * z
        encoder = still_encoder(recording.events.t_first, recording.events.t_last)
        model = ExactModel(camera, Prism(0.0))
        self._work = Reconstruction(recording, model=model, encoder=encoder, device=device)
        super().__init__()
        self._rays = np.asarray(self._view.pixels_to_rays(pixel_grid(camera)))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture [px]."""
        return self._view.width, self._view.height

    @property
    def interval_us(self) -> float:
        """Time between two pictures [us]."""
        return float(np.clip(STEP_PX / max(self._speed, 1e-6) * 1e6, *INTERVAL_US))

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield time since the start of the first window [us], and linear luminance, shape (height, width)."""
        self._known.clear()
        interval, k = self.interval_us, 0
        for first, second in pairwise(self._views()):
            self._known.append((round(k * interval), first[2] & self._turned(second, first[0])[2]))
            while k * interval < second[0]:
                t = round(k * interval)
                before, after = self._turned(first, t)[1], self._turned(second, t)[1]
                part = np.float32(np.clip((t - first[0]) / (second[0] - first[0]), 0.0, 1.0))
                yield t, sources.light_of((np.float32(1.0) - part) * before + part * after)
                k += 1

    def _views(self) -> Iterator[View]:
        """Yield the pictures of all windows, and the last one again at the end."""
        last: View | None = None
        for window in self._windows:
            view = self._reconstruct(window)
            if last is not None:
                view = self._levelled(view, last)
            last = view
            yield last
        assert last is not None
        yield self._turned(last, max(round(self.duration_us), last[0]) + 1)

    def _reconstruct(self, window: Window) -> View:
        """Return the picture of a window; an even grey without known pixels if its events determine nothing."""
        t = window.middle_us - self._start_us
        nothing = t, np.full(self.size[::-1], np.log(MEDIAN_LIGHT), np.float32), np.zeros(self.size[::-1], np.bool_)
        if window.moves_px(self._source) < LEAST_PX:
            return nothing
        self._work.camera_rotation = window.rotation
        try:
            picture = self._work.window(window.start_us, window.length_us).to_host()
        except AmiwarpError:  # no pixel fires twice
            return nothing
        log = np.float32(CONTRAST) * picture.log + np.float32(np.log(MEDIAN_LIGHT))
        return self._seen((t, log, picture.known), self._source, self._rays)

    def _turned(self, view: View, t: int) -> View:
        """Return a picture as the camera sees it at another time [us]."""
        at = self._orientation(np.array([view[0], t], np.float64) * 1e-6)
        return t, *self._seen(view, self._view, self._rays @ (at[0].T @ at[1]).T)[1:]

    def _seen(self, view: View, camera: Camera, rays: NDArray[np.float64]) -> View:
        """Return the picture of a camera along other rays, one for each pixel, shape (n, 3)."""
        t, log, known = view
        offset, inside = looking(camera, rays, log.shape)
        return t, sources.warped(log, offset), (sources.warped(known.astype(np.float32), offset) > 0.5) & inside

    def _levelled(self, view: View, last: View) -> View:
        """Return the picture with the mean brightness of the one before, which events do not determine."""
        _, before, known = self._turned(last, view[0])
        common = known & view[2]
        if not common.any():
            return view
        return view[0], view[1] + np.float32(np.median((before - view[1])[common])), view[2]


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
    pictures: Pictures | sources.MvsecPictures
    if dataset is DataSet.MVSEC:
        _check_unused("mvsec, whose pictures have times", fps=fps)
        path = _path(source, "mvsec")
        pictures, events = sources.open_mvsec(path), path if events is None else events
        return _with_events(pictures, _recording(events), interpolation)
    if isinstance(source, Recording) or (isinstance(source, str | Path) and _is_recording(Path(source))):
        if events is not None:
            raise AmiwarpError(f"{source} is a recording, and events are given too; give one of them, or pictures")
        _check_unused("a recording, which has no pictures", fps=fps, interpolation=interpolation)
        return _from_events(_recording(source), dataset, device, progress)
    if dataset is DataSet.N_CALTECH101:
        _check_unused("a still picture of n-caltech101", events=events, fps=fps, interpolation=interpolation)
        return _from_picture(_path(source, "n-caltech101"))
    if isinstance(source, Pictures):
        _check_unused("opened pictures, which have times", fps=fps)
        pictures = source
    else:
        pictures = open_pictures(source, fps=fps)
    if events is not None:
        return _with_events(pictures, _recording(events), interpolation)
    frames = MotionPictures(pictures, interpolation)
    about: dict[str, MetadataValue] = {"translated_from": "pictures", "interpolation": interpolation.value}
    return TranslatorInput(frames, pictures.duration_us, Camera.from_fov(*pictures.size, DEFAULT_FOV), about=about)


def _check_unused(what: str, **settings: object) -> None:
    """Raise :class:`AmiwarpError` for a setting that is given, but does not apply to ``what``."""
    for name, value in settings.items():
        if value is not None and value is not Interpolation.AUTO:
            raise AmiwarpError(f"{name} is given, but does not apply to {what}; leave it out")


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
    pictures: Pictures | sources.MvsecPictures, recording: Recording, interpolation: Interpolation
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
        windows, motion = _saccade_windows(recording.events.t_first, camera), sources.saccades(camera)
    else:
        windows = find_motion(recording, camera, device=device, progress=progress)
        motion = motion_of(windows)
    frames = ReconstructedPictures(recording, camera, windows, motion, device=device)
    about: dict[str, MetadataValue] = {"translated_from": "events", "windows": len(windows)}
    return TranslatorInput(frames, frames.duration_us, centred(camera), about=about)


def _saccade_windows(start_us: int, camera: Camera) -> list[Window]:
    """Return one window for each saccade."""
    rates = sources.saccade_rates(camera)
    return [Window(start_us + k * sources.SACCADE_US, sources.SACCADE_US, each) for k, each in enumerate(rates)]


def _from_picture(path: Path) -> TranslatorInput:
    """Return a still picture in front of which the camera makes the saccades of N-Caltech101."""
    light = read_picture(path)
    camera = Camera.from_fov(light.shape[1], light.shape[0], DEFAULT_FOV)
    duration = float(len(sources.SACCADES_PX) * sources.SACCADE_US)
    about: dict[str, MetadataValue] = {"translated_from": "picture", "dataset": DataSet.N_CALTECH101.value}
    return TranslatorInput(Still(light), duration, camera, sources.saccades(camera), about)


def with_camera(given: TranslatorInput, camera: Camera) -> TranslatorInput:
    """Return the input for another camera; the image of a still picture moves by the same number of pixels."""
    moves = isinstance(given.frames, Still)
    return replace(given, camera=camera, camera_motion=sources.saccades(camera) if moves else given.camera_motion)


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
    given = source if isinstance(source, TranslatorInput) else translator_input(
        source, events=events, dataset=None if dataset is None else choice(DataSet, dataset, "dataset"),
        interpolation=choice(Interpolation, interpolation, "interpolation"), fps=fps, device=device, progress=progress,
    )  # fmt: skip
    if camera is not None:
        given = with_camera(given, camera)
    duration = given.duration_us * 1e-6 if duration_s is None else duration_s
    if not duration > 0.0:
        raise AmiwarpError("the source does not state its duration; give duration_s")
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
    known = inspect.signature(translation).parameters.keys() - inspect.signature(translate).parameters.keys()
    check_names(settings, sorted(known), "translate: setting ")
    work = translation(source, prism, events=events, dataset=dataset, progress=progress, **settings)
    return work.run(progress=progress)
