"""Write reconstructed pictures to files: 8 and 16 bit pictures, arrays and video. Each file is complete or absent."""

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import CONTRAST, Tone
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.export import encode_image
from amiwarp.io.files import NewFile, check_output
from amiwarp.io.formats import check_ending
from amiwarp.reconstruction.picture import Picture
from amiwarp.validation import choice

DARK, BRIGHT = 0.5, 99.5
"""Percentiles of intensity over the known pixels that are shown black and white."""
GAMMA = 2.2
"""Gamma with which pictures are displayed."""
LIMITS_UPDATE = 0.1
"""Weight of a new frame in the running average of a video's black and white levels. A small weight prevents flicker."""
STILL_SUFFIXES = (".png", ".tif", ".tiff", ".npy")
"""File suffixes of single pictures."""
MASK_SUFFIXES = (".png", ".tif", ".tiff")
"""File suffixes of masks."""
VIDEO = ".mp4"
"""File suffix of videos."""


def limits(picture: Picture, contrast: float = CONTRAST) -> tuple[float, float]:
    """Return the intensities that are shown black and white."""
    shown = picture.known if picture.known.any() else np.isfinite(picture.log)
    dark, bright = np.exp(contrast * np.percentile(picture.log[shown], [DARK, BRIGHT]))
    return float(dark), float(max(bright, dark * (1.0 + 1e-6)))


def tones(
    picture: Picture, tone: Tone, *, contrast: float = CONTRAST, between: tuple[float, float] | None = None
) -> NDArray[np.float32]:
    """Return the picture as pixel values 0 .. 1, shape (height, width); 0 where the picture is not filled.

    ``contrast``: the ON threshold [log intensity]. ``between``: intensities shown black and white, by default those of
    :func:`limits`.
    """
    tone = choice(Tone, tone, "tone")
    dark, bright = between or limits(picture, contrast)
    light = picture.intensity(contrast)
    if tone is Tone.LINEAR:
        value = np.clip(light / bright, 0.0, 1.0)
    else:
        value = np.clip((light - dark) / (bright - dark), 0.0, 1.0) ** (1.0 / GAMMA)
    return np.nan_to_num(value).astype(np.float32)


def check_path(path: Path, endings: tuple[str, ...] = (*STILL_SUFFIXES, VIDEO)) -> None:
    """Raise :class:`AmiwarpError` for a file suffix that is not in ``endings``, or a folder that does not exist."""
    check_ending(path, "pictures are written", endings)
    check_output(path)


def save_picture(
    picture: Picture, path: Path, *, tone: Tone = Tone.MAPPED, bits: int = 8, contrast: float = CONTRAST
) -> None:
    """Write a reconstructed picture as .png (8 or 16 bit), .tif (16 bit) or .npy.

    A .npy file holds the natural log intensity, float32, NaN where it is not filled.
    """
    check_path(path, STILL_SUFFIXES)
    tone = choice(Tone, tone, "tone")
    if bits not in (8, 16):
        raise AmiwarpError(f"{path}: {bits} bits per pixel; expected 8 or 16")
    ending = path.suffix.lower()
    if ending == ".npy":
        with NewFile(path) as new, open(new.part, "wb") as file:
            np.save(file, (contrast * picture.log).astype(np.float32))
        return
    save_grey(tones(picture, tone, contrast=contrast), path, bits=bits if ending == ".png" else 16)


def save_mask(picture: Picture, path: Path) -> None:
    """Write the mask of known pixels as .png or .tif: white where events determine the picture."""
    check_path(path, MASK_SUFFIXES)
    save_grey(picture.known.astype(np.float32), path, bits=8)


def save_grey(value: NDArray[np.float32], path: Path, *, bits: int) -> None:
    """Write values 0 .. 1, shape (height, width), as a grey picture of 8 or 16 bits."""
    from PIL import Image

    kind = np.uint8 if bits == 8 else np.uint16
    image = Image.fromarray(np.rint(value * np.iinfo(kind).max).astype(kind))
    with NewFile(path) as new:
        encode_image(new.part, image, "PNG" if path.suffix.lower() == ".png" else "TIFF")


def save_video(
    pictures: Iterable[Picture], path: Path, *, fps: float, tone: Tone = Tone.MAPPED, contrast: float = CONTRAST
) -> int:
    """Write an MP4 video (H.264) and return its number of frames.

    Black and white levels follow the scene slowly.
    """

    def frames() -> Iterator[NDArray[np.uint8]]:
        between: tuple[float, float] | None = None
        for picture in pictures:
            dark, bright = limits(picture, contrast)
            if between is not None:
                dark = between[0] + LIMITS_UPDATE * (dark - between[0])
                bright = between[1] + LIMITS_UPDATE * (bright - between[1])
            between = (dark, bright)
            yield np.rint(255.0 * tones(picture, tone, contrast=contrast, between=between)).astype(np.uint8)

    return save_film(frames(), path, fps=fps)


def save_film(frames: Iterable[NDArray[np.uint8]], path: Path, *, fps: float) -> int:
    """Write frames as MP4 (H.264), or as GIF if ``path`` ends in .gif, and return the number of frames.

    Each frame has shape (height, width) or (height, width, 3). Raises :class:`AmiwarpError` for no frames, an unknown
    suffix, or a folder that does not exist.
    """
    import av

    check_path(path, (VIDEO, ".gif"))
    count, kind = 0, path.suffix.lower().removeprefix(".")
    with NewFile(path) as new, av.open(str(new.part), "w", format=kind) as container:
        stream: Any = None
        for value in map(padded_to_even, frames):
            if stream is None:
                stream = _add_stream(container, fps, value.shape[:2], kind)
            frame = av.VideoFrame.from_ndarray(value, format="gray" if value.ndim == 2 else "rgb24")
            container.mux(stream.encode(frame))
            count += 1
        if stream is None:
            raise AmiwarpError(f"{path}: no picture to write; give at least one frame")
        container.mux(stream.encode())
    return count


def _add_stream(container: Any, fps: float, shape: tuple[int, ...], kind: str) -> Any:
    """Add a video stream to a PyAV container and return it."""
    rate = Fraction(fps).limit_denominator(1000)
    stream = container.add_stream("gif" if kind == "gif" else "libx264", rate=rate)
    stream.height, stream.width = shape
    stream.pix_fmt = "rgb8" if kind == "gif" else "yuv420p"
    if kind != "gif":
        stream.options = {"crf": "16", "preset": "fast"}
    return stream


def padded_to_even(value: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repeat the last row or column of an image with an odd height or width, because the codec requires even sizes."""
    rows, columns = value.shape[:2]
    return np.pad(value, ((0, rows % 2), (0, columns % 2), *[(0, 0)] * (value.ndim - 2)), mode="edge")
