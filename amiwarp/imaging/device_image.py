"""Image of a canvas in the memory of a device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.kernels.iwe import CPU_WIDTH, Frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.imaging.warped_image import CanvasShape


class Image:
    """Image of a canvas on a device, padded with zeros so that kernels need not test for the border."""

    def __init__(self, canvas: CanvasShape, radius: int, device: Any) -> None:
        """Allocate the image. ``radius``: how far from a pixel kernels read [px]."""
        self.shape = canvas.shape
        self.device = wp.get_device(device)
        self.width = CPU_WIDTH if self.device.is_cpu else 1
        layers, rows, columns = canvas.shape
        f = Frame()
        f.rows, f.columns, f.blocks = rows, columns, -(-columns // self.width)
        f.stride = max(f.blocks * self.width, columns + radius)
        f.layer = (rows + radius) * f.stride
        f.first = (radius + 1) * f.stride
        self.frame = f
        self.blocks = layers * rows * f.blocks
        self.pixels = wp.zeros(f.first + layers * f.layer + f.stride, dtype=float, device=device)

    def _view(self, flat: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the pixels inside the padding."""
        layers, rows, columns = self.shape
        end = self.frame.first + layers * self.frame.layer
        stacked = flat[self.frame.first : end].reshape(layers, -1, self.frame.stride)
        return np.asarray(stacked[:, :rows, :columns])

    def numpy(self) -> NDArray[np.float32]:
        """Return a copy, shape (layers, rows, columns)."""
        return self._view(self.pixels.numpy()).copy()

    def _device_view(self) -> Any:
        """Return the pixels inside the padding as a Warp array with gaps, shape (layers, rows, columns)."""
        f, size = self.frame, self.pixels.strides[0]
        return wp.array(
            ptr=self.pixels.ptr + f.first * size, dtype=float, shape=self.shape, device=self.device,
            strides=(f.layer * size, f.stride * size, size),
        )  # fmt: skip

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
        wp.copy(self.pixels, wp.array(flat, dtype=float, device="cpu"))
