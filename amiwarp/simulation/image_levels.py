"""Images of other programs as log intensities on a device: any numbers, colours and encodings."""

from __future__ import annotations

import math
import warnings
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from amiwarp.errors import AmiwarpError, Option
from amiwarp.events.device_columns import cast, first_beyond, import_array
from amiwarp.kernels import luminance
from amiwarp.kernels.launch import launch
from amiwarp.simulation.picture_light import DARK, srgb_to_linear
from amiwarp.validation import array, choice, on_gpu, packed

LARGEST_LEVEL = 100.0
"""Largest magnitude of a log intensity."""
FLOATS = (np.float16, np.float32, np.float64)
"""Types of linear luminance and of log intensity."""
HIGHEST_STAIR = 0.1
"""Part of a threshold above which the stairs of 8-bit values are named: times of events err by as much of the time from
one to the next."""
WATCHED_IMAGES = 8
"""Number of images after the first ones that are watched for steps in time that are too large."""
LARGE_CHANGE = 4.0
"""Change of a pixel between two images that counts as large [thresholds]."""
MANY_PIXELS = 0.01
"""Part of the pixels above which large changes are named."""


class ImageEncoding(Option):
    """What the values of an image mean to an :class:`EventSensor`.

    Examples
    --------
    >>> amiwarp.simulation.ImageEncoding("linear")
    <ImageEncoding.LINEAR: 'linear'>
    """

    LINEAR = "linear"
    """Linear luminance, white at 1, or linear red, green and blue; float16, float32 or float64."""
    SRGB8 = "srgb8"
    """8-bit values as in files and on screens (sRGB), grey or red, green and blue; uint8."""
    LOG = "log"
    """Natural logarithm of the luminance plus 0.02; float16, float32 or float64."""


_REMEDIES = {
    ImageEncoding.LINEAR: "give linear luminance of at least 0",
    ImageEncoding.LOG: "take the log of luminance + 0.02, or give linear luminance with encoding='linear'",
}


class ImageLevels:
    """Converts the images of cameras to log intensities, and warns once of what makes their events worse.

    ``shape``: cameras, height and width. ``contrast``: the lower threshold of the sensors; without it, nothing is
    said.
    """

    def __init__(
        self, shape: tuple[int, int, int], device: Any, contrast: float = math.inf
    ) -> None:
        self._shape = shape
        self._device = device
        self._contrast = contrast
        self._stairs_sought = math.isinf(contrast)
        self._watched = WATCHED_IMAGES if math.isinf(contrast) else 0
        self._before: wp.array | None = None

    def restart(self) -> None:
        """Do not compare the next images with those before, after cameras have started anew."""
        self._before = None

    def convert(self, images: Any, encoding: str) -> wp.array:
        """Return images as one row of levels on the device, checked, shape (1, pixels of all cameras)."""
        kind = choice(ImageEncoding, encoding, "encoding")
        values = self._values(images, kind)
        levels = self._logarithms(values, kind)
        self._check(levels, kind)
        if kind is not ImageEncoding.LOG:
            self._watch(levels)
        return levels.reshape((1, -1))

    def _values(self, images: Any, kind: ImageEncoding) -> wp.array:
        """Return the values of images on the device, checked for their type and shape."""
        if on_gpu(images):
            of_vectors = isinstance(images, wp.array) and wp.types.type_is_vector(images.dtype)
            values = import_array(wp.from_dlpack(images) if of_vectors else images, "images")
            dtype = wp.dtype_to_numpy(values.dtype)
            where = values.device
        else:
            values = packed(array(images, "images"))
            dtype = values.dtype
            where = self._device
        allowed = (np.uint8,) if kind is ImageEncoding.SRGB8 else FLOATS
        colours = () if kind is ImageEncoding.LOG else (1, 3, 4)
        one_camera = self._shape[0] == 1
        shapes = [self._shape, *((*self._shape, count) for count in colours)]
        if one_camera:
            shapes += [shape[1:] for shape in shapes]
        if dtype not in allowed or tuple(values.shape) not in shapes:
            names = " or ".join(np.dtype(each).name for each in allowed)
            also = ", or with a last axis of 3 colours" if colours else ""
            hint = "; for 8-bit images, give encoding='srgb8'" if dtype == np.uint8 else ""
            raise AmiwarpError(
                f"images are {np.dtype(dtype)} of shape {tuple(values.shape)}; expected {names} of shape "
                f"{self._shape}{also}, for encoding {kind}{hint}"
            )
        if where != self._device:
            raise AmiwarpError(
                f"images are on {where}, the sensor is on {self._device}; move the images"
            )
        pixels = self._shape[0] * self._shape[1] * self._shape[2]
        if isinstance(values, np.ndarray):
            # An axis of one camera, added by [None], has a stride that Warp cannot reshape
            flat = values.reshape(-1)
            native = flat.astype(flat.dtype.newbyteorder("="), copy=False)
            kept = self._device.is_cpu
            kind_of_value = wp.dtype_from_numpy(native.dtype)
            values = wp.array(native, dtype=kind_of_value, device=self._device, copy=not kept)
        return values.reshape((pixels, -1))

    def _logarithms(self, values: wp.array, kind: ImageEncoding) -> wp.array:
        """Return the log intensity of values, shape (pixels,). ``values``: axes pixel and channel."""
        if kind is ImageEncoding.LOG:
            return cast(values, wp.float32).reshape(-1)
        pixels = len(values)
        levels = wp.empty(pixels, dtype=float, device=self._device)
        if kind is ImageEncoding.LINEAR:
            launch(luminance.log_of_linear, pixels, [values, DARK], [levels], device=self._device)
            return levels
        table = _linear_table(str(self._device))
        launch(luminance.log_of_coded, pixels, [values, table, DARK], [levels], device=self._device)
        if not self._stairs_sought:
            self._look_for_stairs(values, table)
        return levels

    def _check(self, levels: wp.array, kind: ImageEncoding) -> None:
        """Raise :class:`AmiwarpError` for a level that is NaN or out of range."""
        place = first_beyond(levels, LARGEST_LEVEL)
        if place < levels.size:
            camera, row, column = (int(k) for k in np.unravel_index(place, self._shape))
            raise AmiwarpError(
                f"the image of camera {camera} has log intensity {levels.numpy()[place]} at row {row}, column "
                f"{column}; expected -{LARGEST_LEVEL:g} .. {LARGEST_LEVEL:g}; {_REMEDIES[kind]}"
            )

    def _look_for_stairs(self, values: wp.array, table: wp.array) -> None:
        """Warn if 8 bits are coarse against the thresholds where the images are."""
        highest = wp.zeros(1, dtype=float, device=self._device)
        inputs = [values, table, DARK]
        launch(luminance.find_highest_stair, len(values), inputs, [highest], device=self._device)
        stair = float(highest.numpy()[0])
        self._stairs_sought = True
        if stair > HIGHEST_STAIR * self._contrast:
            warnings.warn(
                f"8-bit images are stairs of up to {stair:.3f} in log intensity, {stair / self._contrast:.0%} of the "
                "threshold, mostly in the dark; give linear luminance in float (encoding='linear'), such as the "
                "renderer's HDR image",
                stacklevel=6,
            )

    def _watch(self, levels: wp.array) -> None:
        """Warn if many pixels change by several thresholds from one image to the next."""
        if self._watched >= WATCHED_IMAGES:
            return
        before = self._before
        self._before = levels
        if before is None:
            return
        self._watched += 1
        count = wp.zeros(1, dtype=int, device=self._device)
        inputs = [before, levels, LARGE_CHANGE * self._contrast]
        launch(luminance.count_large_changes, levels.size, inputs, [count], device=self._device)
        share = float(count.numpy()[0]) / levels.size
        if share > MANY_PIXELS:
            self._watched = WATCHED_IMAGES
            warnings.warn(
                f"{share:.1%} of the pixels change by over {LARGE_CHANGE:g} thresholds from one image to the next, so "
                "their events come evenly in time, in bands; give more images, so that nothing moves by more than "
                "about 0.25 px from one to the next",
                stacklevel=5,
            )


@lru_cache(maxsize=4)
def _linear_table(device: str) -> wp.array:
    """Return the linear intensity of each 8-bit value."""
    values = srgb_to_linear(np.arange(256, dtype=np.float32) / 255.0)
    return wp.array(values, dtype=float, device=device)
