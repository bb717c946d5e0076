"""Pictures and sequences of pictures: their files, pixel values as light, and the simulator's maps of log intensity."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.io.files import errors_name, input_path, open_input, register_reader
from amiwarp.io.formats import video_library
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import TIME_LIMIT, check_ascending, guarded, real, shown, vector, whole

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear red, green and blue in the luminance (ITU-R BT.709)."""

DARK = 0.02
"""Intensity added to every picture before the logarithm, relative to white.

It stands for stray light and dark current, and limits the contrast of shadows.
"""

MOST_PIXELS = 1 << 26
"""Largest picture that is read [px]: 67 megapixels. A small file may unpack to a huge picture."""

BAND = 1 << 24
"""Number of pixel values that are converted to light at a time."""

PICTURE_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "PPM", "GIF")
"""Formats of picture files that are read, by Pillow's names. Others are excluded because some of them run external
programs."""

LARGEST_MAP = 8192
"""Largest number of texels along a side of a map; a wider scene is resampled more coarsely."""


def read_picture(path: str | Path) -> NDArray[np.float32]:
    """Return the linear luminance of a picture file, shape (height, width); white is 1.

    Raises :class:`AmiwarpError` if the file cannot be read.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about Pillow's own, larger limits, and about damage that it tolerates
            with Image.open(input_path(path), formats=PICTURE_FORMATS) as image:
                if image.width * image.height > MOST_PIXELS:
                    raise ValueError(
                        f"{image.width}x{image.height} is over {MOST_PIXELS} pixels; make the picture smaller"
                    )
                wide = image.mode.startswith(("I", "F"))
                pixels = np.asarray(image if wide else image.convert("RGB"))
    except AmiwarpError:
        raise
    except Exception as error:  # Pillow raises errors of many types for damaged files
        what = " ".join(str(error).split()) or type(error).__name__
        raise AmiwarpError(f"{path} cannot be read as a picture ({what}); give a JPEG, PNG, TIFF ...") from error
    if pixels.dtype.kind == "i":  # Pillow returns 16-bit pictures as int32
        if pixels.min() < 0 or pixels.max() > 0xFFFF:
            raise AmiwarpError(
                f"{path} has values from {pixels.min()} to {pixels.max()}; save it with 16 bits, 0 to 65535"
            )
        pixels = pixels.astype(np.uint16)
    return linear_luminance(pixels, name=str(path))


def linear_luminance(pixels: NDArray[Any], *, name: str = "picture") -> NDArray[np.float32]:
    """Return the linear luminance of pixel values, shape (height, width) or (height, width, 3 or 4).

    uint8 and uint16 values are sRGB-encoded, as in files. Floating values are linear intensities, with white at 1.
    Raises :class:`AmiwarpError` for other shapes and types, and for values that are negative or not finite.
    """
    pixels = np.asarray(pixels)
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    colours = pixels.shape[2] if pixels.ndim == 3 else 0
    if pixels.ndim not in (2, 3) or colours not in (0, 1, 3, 4) or min(pixels.shape[:2]) < 2:
        raise AmiwarpError(f"{name} has shape {pixels.shape}; expected (height, width) or (height, width, 3)")
    if pixels.dtype in (np.uint8, np.uint16):
        top = np.iinfo(pixels.dtype).max
        table = srgb_to_linear(np.arange(top + 1, dtype=np.float32) / top)
    elif pixels.dtype.kind == "f":
        table = None
    else:
        raise AmiwarpError(f"{name} is of type {pixels.dtype}; expected uint8, uint16 (sRGB) or float (linear)")
    light = np.empty(pixels.shape[:2], np.float32)
    rows = max(1, BAND // pixels[0].size)
    for start in range(0, len(pixels), rows):
        part = pixels[start : start + rows]
        values = part.astype(np.float32) if table is None else table[part]
        if colours in (3, 4):
            values = values[..., :3] @ np.array(LUMINANCE, np.float32)
        light[start : start + rows] = values[..., 0] if colours == 1 else values
    if not (np.isfinite(light).all() and light.min() >= 0.0):
        raise AmiwarpError(f"{name} has intensities that are negative or not finite; expected 0 .. 1")
    return light


def srgb_to_linear(value: NDArray[Any]) -> NDArray[np.float32]:
    """Convert sRGB values 0 .. 1 to linear intensity (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Placement:
    """Placement of a picture map on the picture plane, which is at z = 1 in front of the camera."""

    width: int
    """Number of texels of the map along x."""
    height: int
    """Number of texels of the map along y."""
    box: tuple[float, float, float, float]
    """Part of the picture that the map shows: left, top, right and bottom edge [picture px]."""
    left: float
    """Coordinate x of the map's left edge on the picture plane."""
    top: float
    """Coordinate y of the map's top edge on the picture plane."""
    pitch: tuple[float, float]
    """Texels per unit of the picture plane, along x and along y."""

    def to_texel(self) -> NDArray[np.float64]:
        """Return the matrix (3, 3) from coordinates on the picture plane to texel coordinates.

        Texel centres have whole coordinates.
        """
        (px, py), left, top = self.pitch, self.left, self.top
        return np.array([[px, 0.0, -left * px - 0.5], [0.0, py, -top * py - 0.5], [0.0, 0.0, 1.0]])


def place_picture(
    size: tuple[int, int],
    view: tuple[float, float, float, float],
    pitch: float,
    *,
    fov: float | None = None,
) -> Placement:
    """Place a picture so that it covers a rectangle of the picture plane.

    ``size`` is the picture's (width, height); ``view`` is the rectangle (left, top, right, bottom) on the plane. The
    picture's aspect ratio is kept, and parts that are never seen are cut off. With ``fov`` [rad], its horizontal
    extent, the picture is centred on the optical axis instead, and mirrored at its edges if the view extends beyond.
    ``pitch``: texels per unit of the plane.
    """
    width, height = size
    left, top, right, bottom = view
    if fov is None:
        scale = max((right - left) / width, (bottom - top) / height)  # plane units per picture pixel
        x0, y0 = (left + right - width * scale) / 2.0, (top + bottom - height * scale) / 2.0
    else:
        scale = 2.0 * np.tan(fov / 2.0) / width
        x0, y0 = -width * scale / 2.0, -height * scale / 2.0
    box = (
        max((left - x0) / scale, 0.0),
        max((top - y0) / scale, 0.0),
        min((right - x0) / scale, float(width)),
        min((bottom - y0) / scale, float(height)),
    )
    if box[2] - box[0] < 1.0 or box[3] - box[1] < 1.0:
        box = (0.0, 0.0, float(width), float(height))  # only mirror images of the picture are seen
    texels = [int(np.clip(round(n * scale * pitch), 2, LARGEST_MAP)) for n in (box[2] - box[0], box[3] - box[1])]
    pitches = (texels[0] / ((box[2] - box[0]) * scale), texels[1] / ((box[3] - box[1]) * scale))
    return Placement(texels[0], texels[1], box, x0 + box[0] * scale, y0 + box[1] * scale, pitches)


def log_map(light: NDArray[np.float32], placement: Placement, blur: float) -> NDArray[np.float32]:
    """Return the log intensity of a picture resampled to a map, shape (height, width).

    Resampling is cubic, with a low-pass filter if the picture is finer than the map. A Gaussian blur of ``blur``
    [texels] follows.
    """
    from PIL import Image
    from scipy.ndimage import gaussian_filter

    size = (placement.width, placement.height)
    image = Image.fromarray(light).resize(size, Image.Resampling.BICUBIC, box=placement.box)
    texels = np.maximum(np.asarray(image, np.float32), 0.0)  # cubic interpolation overshoots at edges
    if blur > 0.0:
        texels = gaussian_filter(texels, blur, mode="mirror", truncate=3.0)
    return np.log(texels + np.float32(DARK))


# Picture sequences with times: folders of pictures, arrays and videos.

MOST_TABLE_BYTES, MOST_PICTURES = 64 << 20, 1_000_000
"""Largest ``times.csv`` that is read [bytes], and largest number of pictures in it."""

TIMES = "times.csv"
"""Name of the file, in a folder of pictures, that lists their times; its columns are file and t_us."""

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")
"""File suffixes of pictures in a folder."""


@guarded
@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class PictureFolder:
    """Folder of picture files with a time for each picture.

    Examples
    --------
    >>> import numpy as np
    >>> from pathlib import Path
    >>> folder = amiwarp.PictureFolder((Path("a.png"), Path("b.png")), np.array([0, 40_000]), (64, 48))
    >>> folder.duration_us
    80000.0
    """

    files: tuple[Path, ...]
    """Paths of the picture files, which are all of one size."""
    times_us: NDArray[np.int64]
    """Time of each picture [us], shape (n,), starting at 0 and increasing."""
    size: tuple[int, int]
    """Width and height of each picture [px]."""
    start_us: int | None = None
    """Time of the first picture in ``times.csv`` [us], or None if the times come from a rate."""

    def __post_init__(self) -> None:
        if len(self.files) < 2 or self.times_us.shape != (len(self.files),):
            given = f"{len(self.files)} files and times of shape {self.times_us.shape}"
            raise AmiwarpError(f"pictures have {given}; give at least two files and a time for each")
        if self.times_us.dtype != np.int64 or self.times_us[0] != 0:
            given = f"{self.times_us.dtype} times from {self.times_us[0]} on"
            raise AmiwarpError(f"pictures have {given}; give int64 times [us] that start at 0")
        check_ascending(self.times_us, "picture")
        if self.start_us is not None:
            whole(self.start_us, "start_us", -TIME_LIMIT, TIME_LIMIT, " us")
        vector(self.size, 2, "size of the pictures", lambda size, what: whole(size, what, 1, LARGEST_SIZE))

    @property
    def interval_us(self) -> float:
        """Smallest time between pictures [us]."""
        return float(np.diff(self.times_us).min())

    @property
    def duration_us(self) -> float:
        """Time from the first picture to the end of the last one [us].

        The last picture is shown for the median interval.
        """
        return float(self.times_us[-1]) + float(np.median(np.diff(self.times_us)))

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield times and pictures.

        Yields
        ------
        tuple
            Time [us], and linear luminance, float32, shape ``(height, width)``.

        Raises
        ------
        AmiwarpError
            If a picture cannot be read, or has another size than the first.
        """
        for file, t in zip(self.files, self.times_us.tolist(), strict=True):
            light = read_picture(file)
            if light.shape != self.size[::-1]:
                given = f"{light.shape[1]}x{light.shape[0]}"
                expected = f"{self.size[0]}x{self.size[1]}"
                raise AmiwarpError(f"{file} has {given} pixels, the first picture {expected}; resize this picture")
            yield t, light


@guarded
@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class PictureStack:
    """Array of pictures with a constant rate.

    Examples
    --------
    >>> import numpy as np
    >>> amiwarp.PictureStack(np.zeros((5, 48, 64), np.uint8), 25.0, "zeros").duration_us
    200000.0
    """

    pictures: NDArray[Any]
    """Pixel values of the pictures, shape (n, height, width) or (n, height, width, 3): sRGB-encoded, 0 .. 1, uint8 or
    uint16."""
    fps: float
    """Number of pictures per second [Hz]."""
    name: str
    """Name of the stack in messages."""

    def __post_init__(self) -> None:
        if self.pictures.ndim not in (3, 4):
            raise AmiwarpError(f"pictures have shape {self.pictures.shape}; give (n, height, width) or (..., 3)")
        real(self.fps, "fps", 1e-6, 1e6, " pictures per second")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of each picture [px]."""
        return self.pictures.shape[2], self.pictures.shape[1]

    @property
    def interval_us(self) -> float:
        """Time between pictures [us]."""
        return 1e6 / self.fps

    @property
    def duration_us(self) -> float:
        """Duration of all pictures [us]."""
        return len(self.pictures) * self.interval_us

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield times and pictures.

        Yields
        ------
        tuple
            Time [us], and linear luminance, float32, shape ``(height, width)``.

        Raises
        ------
        AmiwarpError
            If floating values are outside 0 .. 1.
        """
        for i, picture in enumerate(self.pictures):
            name = f"{self.name}: picture {i}"
            if picture.dtype.kind != "f":
                yield round(i * self.interval_us), linear_luminance(picture, name=name)
                continue
            if not (np.isfinite(picture).all() and picture.min() >= 0.0 and picture.max() <= 1.0):
                raise AmiwarpError(f"{name} has values outside 0 .. 1; scale the values, or store them as uint8")
            yield (
                round(i * self.interval_us),
                linear_luminance(srgb_to_linear(np.asarray(picture, np.float32)), name=name),
            )


@guarded
@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class VideoFile:
    """Video file, decoded by PyAV frame by frame. Frames with a time stamp not later than the one before are skipped.

    Examples
    --------
    >>> from pathlib import Path
    >>> amiwarp.VideoFile(Path("film.mp4"), (64, 48), fps=240.0, duration_us=1e6, stretch=0.5).interval_us
    2083.3333333333335
    """

    path: Path
    """Path of the video file."""
    size: tuple[int, int]
    """Width and height of a frame [px]."""
    fps: float
    """Nominal frame rate [Hz]. The simulation uses the time stamp of each frame instead."""
    duration_us: float
    """Duration of the video, after its times were multiplied by ``stretch`` [us]."""
    stretch: float = 1.0
    """Factor by which the times in the video file are multiplied."""

    def __post_init__(self) -> None:
        real(self.fps, "fps", 1e-6, 1e6, " pictures per second")
        real(self.stretch, "stretch", 0.0, 1e9)
        real(self.duration_us, "duration_us", 0.0, TIME_LIMIT, " us")
        vector(self.size, 2, "size of the frames", lambda size, what: whole(size, what, 1, LARGEST_SIZE))

    @property
    def interval_us(self) -> float:
        """Nominal time between frames, after times were multiplied by ``stretch`` [us]."""
        return 1e6 / self.fps * self.stretch

    def read(self) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Yield times and frames.

        Yields
        ------
        tuple
            Time [us], starting at 0, and linear luminance, float32, shape ``(height, width)``.

        Raises
        ------
        AmiwarpError
            If the file cannot be decoded, or a frame is too large.
        """
        av = video_library(self.path)
        first: Fraction | None = None
        last = -1
        try:
            with av.open(str(input_path(self.path))) as container:
                for i, frame in enumerate(container.decode(video=0)):
                    stamp = Fraction(i) / Fraction(self.fps) if frame.pts is None else frame.pts * frame.time_base
                    first = stamp if first is None else first
                    t = round((stamp - first) * 1_000_000 * Fraction(self.stretch))
                    if frame.width * frame.height > MOST_PIXELS:
                        raise AmiwarpError(
                            f"{self.path}: frame {i} is {frame.width}x{frame.height}, which is too large; make the "
                            "video smaller"
                        )
                    if t > last:
                        last = t
                        yield t, linear_luminance(frame.to_ndarray(format="rgb24"), name=f"{self.path}: frame {i}")
        except AmiwarpError:
            raise
        except Exception as error:  # damage shows in errors of many types
            raise AmiwarpError(
                f"{self.path} is damaged after {last / 1e6:.3f} s ({error}); cut the video at that time"
            ) from error
        if last < 0:
            raise AmiwarpError(f"{self.path} contains no frame that can be decoded; give another video")


Pictures = PictureFolder | PictureStack | VideoFile


def open_pictures(path: str | Path, *, fps: float | None = None) -> Pictures:
    """Open a video, a folder of pictures, or an .npy stack.

    ``fps`` is required for a stack, and for a folder without ``times.csv`` (columns file, t_us). A video is played at
    that rate instead of its own, as for a slow-motion film. Raises :class:`AmiwarpError` if the pictures cannot be
    read.
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
    opened = _open_stack(path, fps) if path.suffix == ".npy" else _open_video(path, fps)
    register_reader(opened, path)
    return opened


def _open_folder(folder: Path, fps: float | None) -> PictureFolder:
    """Open a folder of pictures, with times from ``times.csv`` or from ``fps``."""
    table = folder / TIMES
    if table.exists() and fps is None:
        files, times = _read_times(table)
    else:
        files = sorted((f for f in folder.iterdir() if f.suffix.lower() in PICTURE_SUFFIXES), key=_natural)
        if fps is None:
            raise AmiwarpError(
                f"{folder} has no times.csv (columns file, t_us); add this file, or give the pictures per second as fps"
            )
        times = np.rint(np.arange(len(files)) * (1e6 / fps)).astype(np.int64)
    if len(files) < 2:
        raise AmiwarpError(f"{folder} contains {len(files)} pictures; give at least 2")
    height, width = read_picture(files[0]).shape
    start_us = None if fps is not None else int(times[0])
    with errors_name(table, lambda: "times"):
        return PictureFolder(tuple(files), times - times[0], (width, height), start_us)


def _natural(file: Path) -> list[tuple[int, int, str]]:
    """Return a sort key by which picture 10 comes after picture 9."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", file.name) if part]


def _read_times(table: Path) -> tuple[list[Path], NDArray[np.int64]]:
    """Read the file names and times in ``times.csv``."""
    with errors_name(table, lambda: "is not a table with the columns file, t_us"):
        with open_input(table) as file:
            text = file.read(MOST_TABLE_BYTES + 1)
        if len(text) > MOST_TABLE_BYTES:
            raise AmiwarpError(f"it is larger than {MOST_TABLE_BYTES >> 20} MiB")
        rows = csv.DictReader(io.StringIO(text.decode("utf-8-sig"), newline=""))
        files: list[Path] = []
        times = []
        for row in rows:
            if len(files) == MOST_PICTURES:
                raise AmiwarpError(f"it lists over {MOST_PICTURES} pictures; split the folder")
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
        pictures = np.load(input_path(path), mmap_mode="r", allow_pickle=False)
    except Exception as error:  # NumPy parses the header as Python: errors of many types
        what = " ".join(str(error).split())
        raise AmiwarpError(f"{path} cannot be read as an array ({what}); give a stack saved by numpy.save") from error
    if pictures.ndim not in (3, 4) or len(pictures) < 2:
        raise AmiwarpError(f"{path} has shape {pictures.shape}; expected (n, height, width), n at least 2")
    if fps is None:
        raise AmiwarpError(f"{path} contains no times; give the pictures per second as fps")
    return PictureStack(pictures, fps, str(path))


def _open_video(path: Path, fps: float | None) -> VideoFile:
    av = video_library(path)
    try:
        with av.open(str(input_path(path))) as container:
            if not container.streams.video:
                raise AmiwarpError(f"{path} contains no video stream; give a video")
            stream = container.streams.video[0]
            native_fps = float(stream.average_rate or stream.guessed_rate or 0.0)
            length = float(stream.duration * stream.time_base) if stream.duration else (container.duration or 0) * 1e-6
            size = (stream.width, stream.height)
    except AmiwarpError:
        raise
    except Exception as error:  # damage shows in errors of many types
        raise AmiwarpError(f"{path} cannot be read as a video ({error}); give a file that FFmpeg can read") from error
    if size[0] * size[1] > MOST_PIXELS:
        raise AmiwarpError(f"{path}: is {size[0]}x{size[1]}, over {MOST_PIXELS} pixels; make it smaller")
    if native_fps <= 0.0 or min(size) < 2:
        raise AmiwarpError(f"{path} has no frame rate or no picture size; convert it to a common format")
    stretch = native_fps / fps if fps else 1.0
    with errors_name(path, lambda: "video header"):
        return VideoFile(path, size, native_fps, length * 1e6 * stretch, stretch)
