"""Files of reconstructed pictures: 8 and 16 bit pictures, arrays and video. Each file is complete or absent."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import CONTRAST, Tone
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.export import encode_image
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import NewFile, check_output
from amiwarp.reconstruction.film_files import VIDEO, save_film
from amiwarp.reconstruction.picture import Picture
from amiwarp.validation import choice

DARK = 0.5
"""Percentile of intensity over the known pixels that is shown black."""
BRIGHT = 99.5
"""Percentile of intensity over the known pixels that is shown white."""
GAMMA = 2.2
"""Gamma with which pictures are displayed."""
LIMITS_UPDATE = 0.1
"""Weight of a new frame in the running average of a video's black and white levels. A small weight prevents flicker."""
STILL_SUFFIXES = (".png", ".tif", ".tiff", ".npy")
"""File suffixes of single pictures."""
MASK_SUFFIXES = (".png", ".tif", ".tiff")
"""File suffixes of masks."""


def limits(picture: Picture, contrast: float = CONTRAST) -> tuple[float, float]:
    """Return the intensities that are shown black and white."""
    shown = picture.known if picture.known.any() else np.isfinite(picture.log)
    dark, bright = np.exp(contrast * np.percentile(picture.log[shown], [DARK, BRIGHT]))
    return float(dark), float(max(bright, dark * (1.0 + 1e-6)))


def tones(
    picture: Picture,
    tone: Tone,
    *,
    contrast: float = CONTRAST,
    between: tuple[float, float] | None = None,
) -> NDArray[np.float32]:
    """Return the picture as pixel values 0 .. 1, shape (height, width); 0 where the picture is not filled.

    ``contrast``: the ON threshold [log intensity]. ``between``: intensities shown black and white, by default
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


def check_path(
    path: Path, endings: tuple[str, ...] = (*STILL_SUFFIXES, VIDEO), *, overwrite: bool = False
) -> None:
    """Raise :class:`AmiwarpError` for a file suffix that is not in ``endings``, or a folder that does not exist."""
    check_ending(path, "pictures are written", endings)
    check_output(path, overwrite=overwrite)


def save_picture(
    picture: Picture,
    path: Path,
    *,
    tone: Tone = Tone.MAPPED,
    bits: int = 8,
    contrast: float = CONTRAST,
) -> None:
    """Write a reconstructed picture as .png (8 or 16 bit), .tif (16 bit) or .npy.

    A .npy file holds the natural log intensity, float32, NaN where it is not filled.
    """
    _save_still(
        path,
        bits,
        array=lambda: contrast * picture.log,
        grey=lambda: tones(picture, tone, contrast=contrast),
    )


def save_network_picture(
    image: NDArray[np.float32], path: Path, *, tone: Tone = Tone.MAPPED, bits: int = 8
) -> None:
    """Write the picture of a network, shape (height, width), as .png, .tif or .npy, which holds its values."""
    _save_still(
        path,
        bits,
        array=lambda: image,
        grey=lambda: _network_tones(image, tone, _network_limits(image)),
    )


def _save_still(
    path: Path, bits: int, *, array: Callable[[], Any], grey: Callable[[], NDArray[np.float32]]
) -> None:
    """Write a picture: ``array`` as .npy, or the pixel values 0 .. 1 of ``grey`` as .png or .tif."""
    check_path(path, STILL_SUFFIXES)
    if bits not in (8, 16):
        raise AmiwarpError(f"{path}: {bits} bits per pixel; expected 8 or 16")
    ending = path.suffix.lower()
    if ending == ".npy":
        with NewFile(path) as new, open(new.part, "wb") as file:
            np.save(file, array().astype(np.float32))
        return
    save_grey(grey(), path, bits=bits if ending == ".png" else 16)


def _network_limits(image: NDArray[np.float32]) -> tuple[float, float]:
    """Return the values of a network's picture that are shown black and white."""
    dark, bright = np.percentile(np.nan_to_num(image), [DARK, BRIGHT])
    return float(dark), float(bright)


def _network_tones(
    image: NDArray[np.float32], tone: Tone, between: tuple[float, float]
) -> NDArray[np.float32]:
    """Return a network's picture as pixel values 0 .. 1. Networks learn from pictures that have a gamma already."""
    dark, bright = between
    if choice(Tone, tone, "tone") is Tone.LINEAR:
        dark, bright = 0.0, 1.0
    value = (np.nan_to_num(image) - dark) / max(bright - dark, 1e-6)
    return np.clip(value, 0.0, 1.0).astype(np.float32)


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
    pictures: Iterable[Picture],
    path: Path,
    *,
    fps: float,
    tone: Tone = Tone.MAPPED,
    contrast: float = CONTRAST,
) -> int:
    """Write an MP4 video (H.264) and return its number of frames.

    Black and white levels follow the scene slowly.
    """
    return _save_steady(
        pictures,
        path,
        fps,
        levels=lambda picture: limits(picture, contrast),
        grey=lambda picture, between: tones(picture, tone, contrast=contrast, between=between),
    )


def save_network_video(
    images: Iterable[NDArray[np.float32]], path: Path, *, fps: float, tone: Tone = Tone.MAPPED
) -> int:
    """Write the pictures of a network as :func:`save_video` does, and return their number."""
    return _save_steady(
        images,
        path,
        fps,
        levels=_network_limits,
        grey=lambda image, between: _network_tones(image, tone, between),
    )


class SteadyLevels:
    """Black and white levels that follow a scene slowly."""

    def __init__(self) -> None:
        self._between: tuple[float, float] | None = None

    def follow(self, dark: float, bright: float) -> tuple[float, float]:
        """Return the levels for the next picture, whose own levels are given."""
        if self._between is not None:
            dark = self._between[0] + LIMITS_UPDATE * (dark - self._between[0])
            bright = self._between[1] + LIMITS_UPDATE * (bright - self._between[1])
        self._between = (dark, bright)
        return self._between


def _save_steady(
    pictures: Iterable[Any],
    path: Path,
    fps: float,
    *,
    levels: Callable[[Any], tuple[float, float]],
    grey: Callable[[Any, tuple[float, float]], NDArray[np.float32]],
) -> int:
    """Write pictures as video, by functions of a picture's black and white levels, and of its values between them."""

    def frames() -> Iterator[NDArray[np.uint8]]:
        steady = SteadyLevels()
        for picture in pictures:
            between = steady.follow(*levels(picture))
            yield np.rint(255.0 * grey(picture, between)).astype(np.uint8)

    return save_film(frames(), path, fps=fps)
