"""Films from frames: MP4 or GIF."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.io.output_formats import check_ending, video_library
from amiwarp.io.outputs import NewFile, check_output

GIF_FPS = 50.0
"""Most frames per second of a GIF. Programs show those with shorter frames more slowly."""
VIDEO = ".mp4"
"""File suffix of videos."""
FILM_SUFFIXES = (VIDEO, ".gif")
"""File suffixes of films."""


def check_film(path: Path, *, fps: float, overwrite: bool = False) -> Any:
    """Return PyAV.

    Raises :class:`AmiwarpError` without it, and for a file that cannot be a film, have this rate or be written.
    """
    check_ending(path, "pictures are written", FILM_SUFFIXES)
    if path.suffix.lower() == ".gif" and fps > GIF_FPS:
        raise AmiwarpError(
            f"{path}: a GIF has at most {GIF_FPS:g} frames/s that programs show at their speed, not {fps:g}; give "
            "fewer, or write .mp4"
        )
    check_output(path, overwrite=overwrite)
    return video_library(path)


def save_film(
    frames: Iterable[NDArray[np.uint8]], path: Path, *, fps: float, overwrite: bool = False
) -> int:
    """Write frames as MP4 (H.264), or as GIF if ``path`` ends in .gif, and return the number of frames.

    Each frame has shape (height, width) or (height, width, 3). Raises :class:`AmiwarpError` for no frames, an unknown
    suffix, a folder that does not exist, or without PyAV.
    """
    av = check_film(path, fps=fps, overwrite=overwrite)
    count = 0
    kind = path.suffix.lower().removeprefix(".")
    with (
        _films_are_written(path),
        NewFile(path, overwrite=overwrite) as new,
        av.open(str(new.part), "w", format=kind) as container,
    ):
        stream: Any = None
        for value in map(padded_to_even, frames):
            if stream is None:
                stream = _add_stream(container, fps, value.shape, kind)
            frame = av.VideoFrame.from_ndarray(value, format="gray" if value.ndim == 2 else "rgb24")
            container.mux(stream.encode(frame))
            count += 1
        if stream is None:
            raise AmiwarpError(
                f"{path}: no picture to write; give at least one frame", ErrorCode.CONTENT_MISSING
            )
        container.mux(stream.encode())
    return count


@contextlib.contextmanager
def _films_are_written(path: Path) -> Iterator[None]:
    """Turn the errors of PyAV, such as for a picture that is too large, into :class:`AmiwarpError`."""
    from av.error import FFmpegError

    try:
        yield
    except FFmpegError as error:
        raise AmiwarpError(
            f"{path}: cannot be written as a film: {error.strerror}; try smaller pictures",
            ErrorCode.OUTPUT_FAILED,
        ) from error


def _add_stream(container: Any, fps: float, shape: tuple[int, ...], kind: str) -> Any:
    """Add a video stream for frames of a shape to a PyAV container and return it."""
    rate = Fraction(fps).limit_denominator(1000)
    if kind == "gif":
        stream = container.add_stream("gif", rate=rate)
        # Of 256 colours, few are grey.
        stream.pix_fmt = "gray" if len(shape) == 2 else "rgb8"
    else:
        stream = container.add_stream("libx264", rate=rate)
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "16", "preset": "fast"}
    stream.height, stream.width = shape[:2]
    return stream


def padded_to_even(value: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repeat the last row or column of an image with an odd height or width, because the codec requires even sizes."""
    rows, columns = value.shape[:2]
    padding = [(0, rows % 2), (0, columns % 2)]
    if value.ndim > 2:  # colours
        padding.append((0, 0))
    return np.pad(value, padding, mode="edge")
