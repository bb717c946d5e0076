"""Pictures of high dynamic range in Radiance's format (.hdr), decoded by OpenCV in the reading process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, optional_module
from amiwarp.io.inputs import errors_name, open_input
from amiwarp.io.reading_process import run_with_arrays


def read_radiance(path: Path, most_pixels: int) -> NDArray[np.float32]:
    """Return linear red, green and blue of a picture file, shape (height, width, 3).

    Raises :class:`AmiwarpError` if OpenCV is missing, the file cannot be read, or it has over ``most_pixels`` pixels.
    """
    optional_module("cv2", "worlds", f"{path}: pictures of high dynamic range need OpenCV")
    with errors_name(path, lambda: "cannot be read as a Radiance picture"):
        shape, (values,) = run_with_arrays(f"{__name__}:decode_radiance", path, most_pixels)
    return np.asarray(values.reshape(shape), np.float32)


def decode_radiance(path: str, most_pixels: int) -> tuple[list[int], list[NDArray[Any]]]:
    """Decode a file in the reading process. Return the shape, and the values of red, green and blue."""
    import cv2

    with open_input(Path(path)) as file:
        data = np.frombuffer(file.read(), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)
    if picture is None or picture.dtype != np.float32:
        raise AmiwarpError("the file is damaged, or is no Radiance picture")
    height, width = picture.shape[:2]
    if height * width > most_pixels:
        raise AmiwarpError(
            f"{width}x{height} is over {most_pixels} pixels; make the picture smaller"
        )
    # OpenCV has blue first.
    colours = np.ascontiguousarray(picture[..., ::-1])
    return list(colours.shape), [colours.ravel()]
