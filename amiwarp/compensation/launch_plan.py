"""The kernel that takes a prism out of events, and what it is launched with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from amiwarp.events.device_encoder import azimuths
from amiwarp.kernels import compensation as kernels
from amiwarp.kernels.launch import load
from amiwarp.optics.device_camera import camera_params, pinhole_params

if TYPE_CHECKING:
    from amiwarp.optics.models import Model


class Placing:
    """A model on a device, for events that are placed there."""

    def __init__(self, model: Model, device: Any) -> None:
        """``device``: a ``wp.Device``. The kernel is loaded here, before threads would each try."""
        name = str(device)
        self.size = model.camera.width, model.camera.height
        self.kernel = kernels.compensate_blocks if device.is_cpu else kernels.compensate_events
        self.block = int(kernels.BLOCK) if device.is_cpu else 1
        """Events of a kernel's thread: columns are filled up to a multiple of it."""
        self._camera = camera_params(model.camera, name)
        self._pinhole = pinhole_params(model.camera) or self._camera
        self._model, self._limits, self._azimuths = model.params(name), wp.vec2(*self.size), azimuths(name)
        load(self.kernel, device)

    def padded(self, n: int) -> int:
        """Events that a column for ``n`` has room for."""
        return -(-n // self.block) * self.block

    def strays(self, most_x: int, most_y: int) -> bool:
        """Whether events up to there lie outside the image [px]."""
        return most_x >= self.size[0] or most_y >= self.size[1]

    def inputs(self, encoder: Any, columns: Any, *, strays: bool) -> list[Any]:
        """Of the kernel, less the first block. ``encoder``: ``EncoderParams``; ``columns``: ``Columns``."""
        # The quick way of placing takes an event's pixel from the image's tables without a look.
        camera = self._camera if strays else self._pinhole
        return [self._model, camera, self._limits, encoder, self._azimuths, columns]
