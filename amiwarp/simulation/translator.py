"""Pictures in time, a video or a folder, to the recording that a camera behind the prism would have made of them."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.events import TIME_LIMIT
from amiwarp.io.files import errors_name, register_reader
from amiwarp.optics.camera import Camera
from amiwarp.progress import Progress
from amiwarp.regular_file import check_regular
from amiwarp.simulation.motion import EncoderModel, PrismMotion
from amiwarp.simulation.pictures import MOST_PIXELS, linear_luminance, read_picture, srgb_to_linear
from amiwarp.simulation.simulator import Scene, SensorModel, Simulation
from amiwarp.validation import real, shown

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording
    from amiwarp.optics.prism import Prism

MOST_TABLE_BYTES = 64 << 20
"""Largest ``times.csv`` that is read: a million pictures."""
DEFAULT_FOV = math.radians(60.0)
"""Horizontal field of view of the camera where none is given [rad]."""

TIMES = "times.csv"
"""Of a folder of pictures: columns file, t_us."""

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class PictureFolder:
    """Picture files with times."""

    files: tuple[Path, ...]
    times_us: NDArray[np.int64]
    size: tuple[int, int]

    @property
    def interval_us(self) -> float:
        return float(np.diff(self.times_us).min())

    @property
    def duration_us(self) -> float:
        return float(self.times_us[-1]) + float(np.median(np.diff(self.times_us)))

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        for file, t in zip(self.files, self.times_us.tolist(), strict=True):
            light = read_picture(file)
            if light.shape != self.size[::-1]:
                given = f"{light.shape[1]}x{light.shape[0]}"
                raise AmiwarpError(f"{file} has {given} pixels, the first picture {self.size[0]}x{self.size[1]}")
            yield t, light


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class PictureStack:
    """An array of pictures, shape (n, height, width) or (n, height, width, 3), sRGB-encoded: 0 .. 1 or uint8."""

    pictures: NDArray[Any]
    fps: float
    name: str

    @property
    def size(self) -> tuple[int, int]:
        return self.pictures.shape[2], self.pictures.shape[1]

    @property
    def interval_us(self) -> float:
        return 1e6 / self.fps

    @property
    def duration_us(self) -> float:
        return len(self.pictures) * self.interval_us

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        for i, picture in enumerate(self.pictures):
            name = f"{self.name}: picture {i}"
            if picture.dtype.kind != "f":
                yield round(i * self.interval_us), linear_luminance(picture, name=name)
                continue
            if not (np.isfinite(picture).all() and picture.min() >= 0.0 and picture.max() <= 1.0):
                raise AmiwarpError(f"{name} has values outside 0 .. 1; scale them, or store uint8")
            yield (
                round(i * self.interval_us),
                linear_luminance(srgb_to_linear(np.asarray(picture, np.float32)), name=name),
            )


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class VideoFile:
    """A video that PyAV decodes, a frame at a time; frames stamped no later than the one before are left out."""

    path: Path
    size: tuple[int, int]
    fps: float
    """Nominal rate; each frame's own time is what counts."""
    duration_us: float
    stretch: float = 1.0
    """Time between frames relative to what the file says."""

    @property
    def interval_us(self) -> float:
        return 1e6 / self.fps * self.stretch

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        import av

        first: Fraction | None = None
        last = -1
        try:
            with av.open(str(self.path)) as container:
                for i, frame in enumerate(container.decode(video=0)):
                    stamp = Fraction(i) / Fraction(self.fps) if frame.pts is None else frame.pts * frame.time_base
                    first = stamp if first is None else first
                    t = round((stamp - first) * 1_000_000 * Fraction(self.stretch))
                    if frame.width * frame.height > MOST_PIXELS:
                        raise AmiwarpError(f"{self.path}: frame {i} is {frame.width}x{frame.height}; make it smaller")
                    if t > last:
                        last = t
                        yield t, linear_luminance(frame.to_ndarray(format="rgb24"), name=f"{self.path}: frame {i}")
        except AmiwarpError:
            raise
        except Exception as error:  # damage shows in errors of many types
            raise AmiwarpError(f"{self.path} breaks off after {last / 1e6:.3f} s ({error}); cut it there") from error
        if last < 0:
            raise AmiwarpError(f"{self.path} holds no picture that can be decoded")


Pictures = PictureFolder | PictureStack | VideoFile


def open_pictures(path: str | Path, *, fps: float | None = None) -> Pictures:
    """Pictures with times: a video, a folder of pictures, or an .npy stack.

    ``fps`` is needed for a stack, and for a folder without ``times.csv`` (columns file, t_us); a video is played at
    that rate instead of its own (a slow-motion film). Raises :class:`AmiwarpError` for what cannot be read.
    """
    path = Path(path)
    if fps is not None:
        fps = real(fps, "fps", 1e-6, 1e6)
    if not path.exists():
        raise AmiwarpError(f"{path} does not exist; give a video, a folder of pictures or an .npy stack")
    if path.is_dir():
        folder = _open_folder(path, fps)
        register_reader(folder, path / TIMES, *folder.files)
        return folder
    check_regular(path)
    opened = _open_stack(path, fps) if path.suffix == ".npy" else _open_video(path, fps)
    register_reader(opened, path)
    return opened


def _open_folder(folder: Path, fps: float | None) -> PictureFolder:
    table = folder / TIMES
    if table.exists() and fps is None:
        files, times = _read_times(table)
    else:
        files = sorted((f for f in folder.iterdir() if f.suffix.lower() in PICTURE_SUFFIXES), key=_natural)
        if fps is None:
            raise AmiwarpError(f"{folder} has no times.csv (columns file, t_us); add it, or give fps")
        times = np.rint(np.arange(len(files)) * (1e6 / fps)).astype(np.int64)
    if len(files) < 2:
        raise AmiwarpError(f"{folder} holds {len(files)} pictures; at least 2 are needed")
    if not (np.diff(times) > 0).all():
        at = int(np.argmin(np.diff(times) > 0)) + 1
        raise AmiwarpError(
            f"{table}: t_us of picture {at} ({times[at]}) is not later than the one before; sort the rows"
        )
    height, width = read_picture(files[0]).shape
    return PictureFolder(tuple(files), times - times[0], (width, height))


def _natural(file: Path) -> list[tuple[int, int, str]]:
    """Sort key by which picture 10 comes after picture 9."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.split(r"(\d+)", file.name) if part]


def _read_times(table: Path) -> tuple[list[Path], NDArray[np.int64]]:
    check_regular(table)
    with errors_name(table, lambda: "is not a table with the columns file, t_us"):
        with table.open("rb") as file:
            text = file.read(MOST_TABLE_BYTES + 1)
        if len(text) > MOST_TABLE_BYTES:
            raise AmiwarpError(f"it is larger than {MOST_TABLE_BYTES >> 20} MiB")
        rows = csv.DictReader(io.StringIO(text.decode("utf-8"), newline=""))
        files, times = [], []
        for row in rows:
            name, t = row.get("file"), row.get("t_us")
            if not name or t is None:
                raise AmiwarpError(f"line {rows.line_num} has no {'t_us' if name else 'file'}")
            try:
                files.append(table.parent / name)
                times.append(round(float(t)))
            except (ValueError, OverflowError) as error:
                raise AmiwarpError(f"line {rows.line_num}: t_us is {shown(t)}; expected a finite number") from error
            if abs(times[-1]) >= TIME_LIMIT:
                raise AmiwarpError(f"line {rows.line_num}: t_us is {shown(t)}, beyond {TIME_LIMIT} us")
        return files, np.array(times, np.int64)


def _open_stack(path: Path, fps: float | None) -> PictureStack:
    try:
        pictures = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # NumPy parses the header as Python: errors of many types
        what = " ".join(str(error).split())
        raise AmiwarpError(f"{path} cannot be read as an array ({what}); give a stack saved by numpy.save") from error
    if pictures.ndim not in (3, 4) or len(pictures) < 2:
        raise AmiwarpError(f"{path} has shape {pictures.shape}; expected (n, height, width), n at least 2")
    if fps is None:
        raise AmiwarpError(f"{path} says nothing of time; give fps")
    return PictureStack(pictures, fps, str(path))


def _open_video(path: Path, fps: float | None) -> VideoFile:
    import av

    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise AmiwarpError(f"{path} holds no video")
            stream = container.streams.video[0]
            own = float(stream.average_rate or stream.guessed_rate or 0.0)
            length = float(stream.duration * stream.time_base) if stream.duration else (container.duration or 0) * 1e-6
            size = (stream.width, stream.height)
    except AmiwarpError:
        raise
    except Exception as error:  # damage shows in errors of many types
        raise AmiwarpError(f"{path} cannot be read as a video ({error}); give a file that FFmpeg knows") from error
    if size[0] * size[1] > MOST_PIXELS:
        raise AmiwarpError(f"{path}: is {size[0]}x{size[1]}, over {MOST_PIXELS} pixels; make it smaller")
    if own <= 0.0 or min(size) < 2:
        raise AmiwarpError(f"{path} has no frame rate or no picture size; convert it to a common format")
    stretch = own / fps if fps else 1.0
    return VideoFile(path, size, own, length * 1e6 * stretch, stretch)


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
    """The simulation that looks at a sequence of pictures; log intensity runs linearly from picture to picture.

    Each picture fills the camera's view, as a still does. By default the camera has the pictures' size and a field of
    view of 60 degrees, and the recording lasts as long as the pictures.
    """
    pictures = source if isinstance(source, Pictures) else open_pictures(source, fps=fps)
    duration = pictures.duration_us * 1e-6 if duration_s is None else duration_s
    if not duration > 0.0:
        raise AmiwarpError(f"{source} does not say how long it lasts; give duration_s")
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
    """The recording of :func:`translation`, whose ``settings`` it takes; long ones are written by its ``write``."""
    return translation(source, prism, **settings).run(progress=progress)
