"""Shape of a vote image, and the image in the memory of a device."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.choices import Vote
from amiwarp.errors import AmiwarpError
from amiwarp.kernels import votes
from amiwarp.kernels.iwe import CPU_WIDTH, Frame
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.validation import choice, whole


@dataclass(frozen=True, slots=True)
class CanvasShape:
    """Shape of a vote image: the sensor's image, extended by ``pad`` px on each side, then scaled."""

    width: int
    """Width of the sensor [px]."""
    height: int
    """Height of the sensor [px]."""
    pad: int = 0
    """Border on each side of the sensor's image that keeps displaced events inside the canvas [sensor px]."""
    scale: float = 1.0
    """Canvas pixels per sensor pixel, along each axis."""
    per_polarity: bool = False
    """Whether OFF and ON events get separate layers, in this order."""
    vote: Vote = Vote.BILINEAR
    """How a vote is shared among pixels."""
    parts: int = 1
    """Number of disjoint subsets of the events with separate images; event k belongs to subset ``k % parts``."""
    dither: bool = False
    """Whether each event is voted at a pseudo-random position in its pixel. At pixel centres the pixel grid would add
    sharpness."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "vote", choice(Vote, self.vote, "vote"))
        for name in ("width", "height"):
            size = whole(getattr(self, name), f"canvas {name}", 1, LARGEST_SIZE, " pixels")
            object.__setattr__(self, name, size)
        pad = whole(self.pad, "canvas pad", 0, LARGEST_SIZE, " pixels")
        object.__setattr__(self, "pad", pad)
        if math.prod(self.shape) > 1 << 29:
            raise AmiwarpError(
                f"the image has shape {self.shape}, more than {1 << 29} pixels; give a smaller pad"
            )

    @property
    def layers(self) -> int:
        """Number of image layers: one per part, or two per part with separate polarities."""
        return self.parts * (2 if self.per_polarity else 1)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of the image: (layers, rows, columns)."""
        padded_height = self.height + 2 * self.pad
        padded_width = self.width + 2 * self.pad
        rows = max(1, round(padded_height * self.scale))
        columns = max(1, round(padded_width * self.scale))
        return self.layers, rows, columns

    def params(self) -> Any:
        """Return the canvas as the struct that the kernels take."""
        _, rows, columns = self.shape
        canvas = votes.Canvas()
        canvas.pad = float(self.pad)
        canvas.scale = self.scale
        canvas.nearest = int(self.vote is Vote.NEAREST)
        canvas.dither = float(self.dither)
        # One more row and column on each side take votes beyond the border.
        canvas.rows = rows + 2
        canvas.columns = columns + 2
        canvas.layer = canvas.rows * canvas.columns if self.layers > 1 else 0
        return canvas


class Image:
    """Image of a canvas on a device, padded with zeros so that kernels need not test for the border."""

    def __init__(self, canvas: CanvasShape, radius: int, device: Any) -> None:
        """Allocate the image. ``radius``: how far from a pixel kernels read [px]."""
        self.shape = canvas.shape
        self.device = wp.get_device(device)
        self.width = CPU_WIDTH if self.device.is_cpu else 1
        layers, rows, columns = canvas.shape
        frame = Frame()
        frame.rows = rows
        frame.columns = columns
        frame.blocks = -(-columns // self.width)  # rounded up
        frame.stride = max(frame.blocks * self.width, columns + radius)
        frame.layer = (rows + radius) * frame.stride
        frame.first = (radius + 1) * frame.stride
        self.frame = frame
        self.blocks = layers * rows * frame.blocks
        size = frame.first + layers * frame.layer + frame.stride
        self.pixels = wp.zeros(size, dtype=float, device=device)

    def _view(self, flat: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the pixels inside the padding."""
        layers, rows, columns = self.shape
        first = self.frame.first
        end = first + layers * self.frame.layer
        stacked = flat[first:end].reshape(layers, -1, self.frame.stride)
        return np.asarray(stacked[:, :rows, :columns])

    def numpy(self) -> NDArray[np.float32]:
        """Return a copy, shape (layers, rows, columns)."""
        return self._view(self.pixels.numpy()).copy()

    def _device_view(self) -> Any:
        """Return the pixels inside the padding as a Warp array with gaps, shape (layers, rows, columns)."""
        frame = self.frame
        pixel_bytes = self.pixels.strides[0]
        return wp.array(
            ptr=self.pixels.ptr + frame.first * pixel_bytes,
            dtype=float,
            shape=self.shape,
            device=self.device,
            strides=(frame.layer * pixel_bytes, frame.stride * pixel_bytes, pixel_bytes),
        )

    def on_device(self) -> Any:
        """Return a copy as a Warp array, shape (layers, rows, columns)."""
        out = wp.empty(self.shape, dtype=float, device=self.device)
        wp.copy(out, self._device_view())
        return out

    def write(self, image: NDArray[np.float32] | wp.array) -> None:
        """Set all pixels from an array of shape (layers, rows, columns): NumPy, or Warp on the same device."""
        if isinstance(image, wp.array):
            wp.copy(self._device_view(), image)
            return
        flat = np.zeros(len(self.pixels), np.float32)
        self._view(flat)[...] = image
        on_cpu = wp.array(flat, dtype=float, device="cpu")
        wp.copy(self.pixels, on_cpu)
