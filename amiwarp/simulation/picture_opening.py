"""Open a video, a folder of pictures, or an array of pictures."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.inputs import errors_name, input_path, open_input, register_reader
from amiwarp.io.output_formats import video_library
from amiwarp.simulation.picture_light import MOST_PIXELS, read_picture
from amiwarp.simulation.pictures import PictureFolder, Pictures, PictureStack, VideoFile
from amiwarp.validation import TIME_LIMIT, real, shown

MOST_TABLE_BYTES = 64 << 20
"""Largest ``times.csv`` that is read [bytes]."""
MOST_PICTURES = 1_000_000
"""Largest number of pictures in a ``times.csv``."""

TIMES = "times.csv"
"""Name of the file, in a folder of pictures, that lists their times; its columns are file and t_us."""

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")
"""File suffixes of pictures in a folder."""


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
        raise AmiwarpError(
            f"{path} does not exist; give a video, a folder of pictures or an .npy stack",
            ErrorCode.FILE_MISSING,
        )
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
        pictures = [file for file in folder.iterdir() if file.suffix.lower() in PICTURE_SUFFIXES]
        files = sorted(pictures, key=_natural)
        if fps is None:
            raise AmiwarpError(
                f"{folder} has no times.csv (columns file, t_us); "
                "add this file, or give the pictures per second as fps",
                ErrorCode.CONTENT_MISSING,
            )
        times = np.rint(np.arange(len(files)) * (1e6 / fps)).astype(np.int64)
    if len(files) < 2:
        raise AmiwarpError(
            f"{folder} contains {len(files)} pictures; give at least 2", ErrorCode.CONTENT_MISSING
        )
    height, width = read_picture(files[0]).shape
    start_us = None if fps is not None else int(times[0])
    with errors_name(table, lambda: "times"):
        return PictureFolder(tuple(files), times - times[0], (width, height), start_us)


def _natural(file: Path) -> list[tuple[int, int, str]]:
    """Return a sort key by which picture 10 comes after picture 9."""
    key = []
    for part in re.split(r"(\d+)", file.name):
        if part.isdecimal():
            key.append((0, int(part), ""))
        elif part:
            key.append((1, 0, part))
    return key


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
            name = row.get("file")
            t = row.get("t_us")
            if not name or t is None:
                raise AmiwarpError(
                    f"line {rows.line_num} has no {'t_us' if name else 'file'}",
                    ErrorCode.FILE_DAMAGED,
                )
            try:
                files.append(table.parent / name)
                times.append(round(float(t)))
            except (ValueError, OverflowError) as error:
                raise AmiwarpError(
                    f"line {rows.line_num}: t_us is {shown(t)}; expected a finite number",
                    ErrorCode.FILE_DAMAGED,
                ) from error
            if abs(times[-1]) >= TIME_LIMIT:
                raise AmiwarpError(
                    f"line {rows.line_num}: t_us is {shown(t)}, beyond {TIME_LIMIT} us",
                    ErrorCode.FILE_DAMAGED,
                )
        return files, np.array(times, np.int64)


def _open_stack(path: Path, fps: float | None) -> PictureStack:
    try:
        pictures = np.load(input_path(path), mmap_mode="r", allow_pickle=False)
    except Exception as error:  # NumPy parses the header as Python: errors of many types
        what = " ".join(str(error).split())
        raise AmiwarpError(
            f"{path} cannot be read as an array ({what}); give a stack saved by numpy.save",
            ErrorCode.FORMAT_UNKNOWN,
        ) from error
    if pictures.ndim not in (3, 4) or len(pictures) < 2:
        raise AmiwarpError(
            f"{path} has shape {pictures.shape}; expected (n, height, width), n at least 2",
            ErrorCode.FORMAT_UNKNOWN,
        )
    if fps is None:
        raise AmiwarpError(
            f"{path} contains no times; give the pictures per second as fps",
            ErrorCode.CONTENT_MISSING,
        )
    return PictureStack(pictures, fps, str(path))


def _open_video(path: Path, fps: float | None) -> VideoFile:
    av = video_library(path)
    try:
        with av.open(str(input_path(path))) as container:
            if not container.streams.video:
                raise AmiwarpError(
                    f"{path} contains no video stream; give a video", ErrorCode.CONTENT_MISSING
                )
            stream = container.streams.video[0]
            native_fps = float(stream.average_rate or stream.guessed_rate or 0.0)
            if stream.duration:
                length_s = float(stream.duration * stream.time_base)
            else:
                length_s = (container.duration or 0) * 1e-6
            size = (stream.width, stream.height)
    except AmiwarpError:
        raise
    except Exception as error:  # damage shows in errors of many types
        raise AmiwarpError(
            f"{path} cannot be read as a video ({error}); give a file that FFmpeg can read",
            ErrorCode.FORMAT_UNKNOWN,
        ) from error
    if size[0] * size[1] > MOST_PIXELS:
        raise AmiwarpError(
            f"{path}: is {size[0]}x{size[1]}, over {MOST_PIXELS} pixels; make it smaller"
        )
    if native_fps <= 0.0 or min(size) < 2:
        raise AmiwarpError(
            f"{path} has no frame rate or no picture size; convert it to a common format",
            ErrorCode.FORMAT_UNKNOWN,
        )
    stretch = native_fps / fps if fps else 1.0
    with errors_name(path, lambda: "video header"):
        return VideoFile(path, size, native_fps, length_s * 1e6 * stretch, stretch)
