"""Sequences of pictures with times: folders of pictures, arrays and videos."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import input_path
from amiwarp.io.output_formats import video_library
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.schema.calls import guarded
from amiwarp.simulation.picture_light import (
    MOST_PIXELS,
    linear_luminance,
    read_picture,
    srgb_to_linear,
)
from amiwarp.validation import TIME_LIMIT, check_ascending, real, vector, whole


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
            raise AmiwarpError(
                f"pictures have {given}; give at least two files and a time for each"
            )
        if self.times_us.dtype != np.int64 or self.times_us[0] != 0:
            given = f"{self.times_us.dtype} times from {self.times_us[0]} on"
            raise AmiwarpError(f"pictures have {given}; give int64 times [us] that start at 0")
        check_ascending(self.times_us, "picture")
        if self.start_us is not None:
            whole(self.start_us, "start_us", -TIME_LIMIT, TIME_LIMIT, " us")
        vector(
            self.size,
            2,
            "size of the pictures",
            lambda size, what: whole(size, what, 1, LARGEST_SIZE),
        )

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
                raise AmiwarpError(
                    f"{file} has {given} pixels, the first picture {expected}; resize this picture"
                )
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
            raise AmiwarpError(
                f"pictures have shape {self.pictures.shape}; give (n, height, width) or (..., 3)"
            )
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
            t = round(i * self.interval_us)
            if picture.dtype.kind != "f":
                yield t, linear_luminance(picture, name=name)
                continue
            if not (np.isfinite(picture).all() and picture.min() >= 0.0 and picture.max() <= 1.0):
                raise AmiwarpError(
                    f"{name} has values outside 0 .. 1; scale the values, or store them as uint8"
                )
            light = srgb_to_linear(np.asarray(picture, np.float32))
            yield t, linear_luminance(light, name=name)


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
        vector(
            self.size,
            2,
            "size of the frames",
            lambda size, what: whole(size, what, 1, LARGEST_SIZE),
        )

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
                    stamp = Fraction(i) / Fraction(self.fps)  # for frames without a time stamp
                    if frame.pts is not None:
                        stamp = frame.pts * frame.time_base
                    if first is None:
                        first = stamp
                    t = round((stamp - first) * 1_000_000 * Fraction(self.stretch))
                    if frame.width * frame.height > MOST_PIXELS:
                        raise AmiwarpError(
                            f"{self.path}: frame {i} is {frame.width}x{frame.height}, which is too large; make the "
                            "video smaller"
                        )
                    if t > last:
                        last = t
                        pixels = frame.to_ndarray(format="rgb24")
                        yield t, linear_luminance(pixels, name=f"{self.path}: frame {i}")
        except AmiwarpError:
            raise
        except Exception as error:  # damage shows in errors of many types
            raise AmiwarpError(
                f"{self.path} is damaged after {last / 1e6:.3f} s ({error}); cut the video at that time",
                ErrorCode.FILE_DAMAGED,
            ) from error
        if last < 0:
            raise AmiwarpError(
                f"{self.path} contains no frame that can be decoded; give another video",
                ErrorCode.FILE_DAMAGED,
            )


Pictures = PictureFolder | PictureStack | VideoFile
