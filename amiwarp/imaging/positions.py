"""Choice of the kernel that finds the positions of events without the optic, and its launch arguments."""

from __future__ import annotations

from typing import Any

import warp as wp

from amiwarp.events.device_events import DeviceEvents, azimuths
from amiwarp.kernels import compensation as kernels
from amiwarp.kernels.launch import launch, load, specialised
from amiwarp.optics.camera import camera_params, pinhole_params
from amiwarp.optics.models import Model


class LaunchPlan:
    """Kernel and arguments that compensate events by one model on one device."""

    def __init__(self, model: Model, device: Any) -> None:
        """Load the kernel, so that threads that use the plan do not each try to. ``device``: a ``wp.Device``."""
        name = str(device)
        self.size = model.camera.width, model.camera.height
        """Sensor width and height [px]."""
        in_blocks = device.is_cpu and model.ANGLES == 1
        self.kernel = kernels.compensate_blocks if in_blocks else kernels.compensate_events
        self.block = int(kernels.BLOCK) if in_blocks else 1
        """Number of events per thread of the kernel; columns are padded to a multiple of this number."""
        self._camera = camera_params(model.camera, name)
        self._pinhole = pinhole_params(model.camera) or self._camera
        self._model, self._limits, self._azimuths = model.params(name), wp.vec2(*self.size), azimuths(name)
        load(specialised(self.kernel, [self._model, self._pinhole]), device)

    def padded(self, n: int) -> int:
        """Return the padded length of a column of ``n`` events."""
        return -(-n // self.block) * self.block

    def any_outside(self, max_x: int, max_y: int) -> bool:
        """Return whether any event can lie outside the sensor, given the largest coordinates of the events [px]."""
        return max_x >= self.size[0] or max_y >= self.size[1]

    def device_columns(self, events: DeviceEvents) -> list[wp.array]:
        """Return x, y and t of events on the device, padded, without a copy if they need no padding."""
        columns: list[wp.array] = []
        for values in (events.x, events.y, events.t):
            padded = self.padded(len(events))
            column = values if padded == len(events) else wp.zeros(padded, dtype=values.dtype, device=values.device)
            if column is not values:
                wp.copy(column, values)
            columns.append(column)
        return columns

    def run(self, columns: list[wp.array], encoder: Any, max_x: int, max_y: int, *, all_cores: bool = True) -> Any:
        """Compensate padded columns x, y, t, with these largest coordinates [px]; return new ``Columns``."""
        padded, device = len(columns[0]), columns[0].device
        c = kernels.Columns()
        c.x, c.y, c.t = columns
        c.out_x, c.out_y = (wp.empty(padded, dtype=float, device=device) for _ in range(2))
        c.inside = wp.empty(padded, dtype=wp.uint8, device=device)
        inputs = self.inputs(encoder, c, outside=self.any_outside(max_x, max_y))
        blocks = padded // self.block
        launch(self.kernel, blocks, inputs, [], device=device, smallest=512 if all_cores else blocks)
        return c

    def inputs(self, encoder: Any, columns: Any, *, outside: bool) -> list[Any]:
        """Return the kernel's inputs, except the first block.

        ``encoder``: ``EncoderParams``. ``columns``: ``Columns``. ``outside``: whether events may lie outside the
        sensor. If none does and the lens has no distortion, the faster kernel for a pinhole camera is used, which reads
        the ellipse model's per-pixel table without a bounds check.
        """
        camera = self._camera if outside else self._pinhole
        return [self._model, camera, self._limits, encoder, self._azimuths, columns]
