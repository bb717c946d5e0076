"""Events prepared for repeated voting on CUDA, for several candidate parameter sets per pass."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.kernels import tiles as kernels
from amiwarp.kernels.camera import CameraRotationParams
from amiwarp.kernels.refraction import CircleParams, ExactParams, RadialCircleParams
from amiwarp.kernels.tiles import AT_ONCE, THREADS, read_tiles, vote_tiles
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.circle_models import CircleModel, RadialCircleModel
from amiwarp.optics.device_camera import pinhole_params
from amiwarp.optics.displacement import model_camera
from amiwarp.optics.ellipse_model import EllipseModel
from amiwarp.optics.exact_model import ExactModel

if TYPE_CHECKING:
    from amiwarp.imaging.device_events import UploadedEvents
    from amiwarp.imaging.device_image import Image
    from amiwarp.imaging.warped_image import CanvasShape
    from amiwarp.optics.models import Model


class TileVotes:
    """Events sorted by image tile, and the vote images of a few candidate parameter sets.

    Buffers are allocated once. ``launch`` only launches kernels, so it can be captured in a CUDA graph. Kernels read
    the parameters from device memory when they run.
    """

    def __init__(
        self, image: Image, canvas: CanvasShape, events: UploadedEvents, like: Model, *, candidates: int = 1
    ) -> None:
        """Sort the events. ``image`` is an image of the canvas, into which votes are read later.

        ``like`` is a model with the type and camera of the candidates.
        """
        device = self.device = image.device
        self.canvas, self.candidates = canvas, candidates
        still = len(events.arrays.time) == 0 and events.slope is None
        self._params = canvas.params()
        self._camera = (pinhole_params(like.camera) if still else None) or model_camera(like, self.device)
        self._arrays = self._sort(events)
        self.votes = wp.zeros((candidates, len(image.pixels)), dtype=wp.int64, device=device)
        """Votes of each candidate parameter set [1/256 event], in the memory layout of the image."""
        frame, self._layout = image.frame, kernels.Layout()
        self._layout.stride, self._layout.layer, self._layout.first = frame.stride, frame.layer, frame.first
        self._layout.shift = (canvas.pad + 0.5) * canvas.scale - 0.5
        kind = {CircleModel: CircleParams, RadialCircleModel: RadialCircleParams, ExactModel: ExactParams}[type(like)]
        dtypes = (kind,) if still else (kind, float, CameraRotationParams)
        self._host = [wp.zeros(candidates, dtype=dtype, device="cpu", pinned=True) for dtype in dtypes]
        self._on_device = [wp.zeros(candidates, dtype=array.dtype, device=device) for array in self._host]
        self._rows = self._host[0].numpy()
        self._drifts = None if still else self._host[1].numpy()
        self._motion: Any = kernels.Still()
        if not still:
            self._motion = kernels.Motion()
            self._motion.drift, self._motion.camera_rotation = self._on_device[1:]

    def _sort(self, events: UploadedEvents) -> Any:
        """Sort the events by tile and pack each event into one word."""
        a, n, device = events.arrays, events.count, self.device
        layers = self.canvas.shape[0]
        size = min(kernels.TILE, max(1, int(kernels.TILE / self.canvas.scale)))
        across, down = -(-self.canvas.width // size), -(-self.canvas.height // size)
        keys, order = (wp.empty(2 * n, dtype=int, device=device) for _ in range(2))
        counts = wp.zeros(layers * across * down, dtype=int, device=device)
        inputs = [a.x, a.y, a.layer, layers, across, across * down, size]
        wp.launch(kernels.key_events, n, inputs, [keys, order, counts], device=device)
        wp.utils.radix_sort_pairs(keys, order, n, end_bit=(layers * across * down).bit_length())
        slope = events.slope if events.slope is not None else wp.empty(0, dtype=float, device=device)
        out = kernels.TileEvents()
        out.packed = wp.empty(n, dtype=wp.uint32, device=device)
        out.slope, out.time = (wp.empty(n if len(v) else 0, dtype=float, device=device) for v in (slope, a.time))
        turn = events.base if events.base is not None else a.turn
        wp.launch(kernels.pack_events, n, [a.x, a.y, turn, slope, a.time, a.weight, order, size], [out], device=device)
        out.chunks = wp.array(self._chunks(counts.numpy(), size, across, down), dtype=kernels.Chunk, device=device)
        return out

    def _chunks(self, counts: Any, size: int, across: int, down: int) -> Any:
        """Return runs of at most CHUNK events of one tile and layer, each with a vote window centred on the tile."""
        pieces = -(-counts // kernels.CHUNK)
        if not pieces.any():
            pieces[0] = 1  # an empty chunk, if there are no events
        key = np.repeat(np.arange(len(counts)), pieces)
        first = np.cumsum(pieces) - pieces  # number of the first chunk of each tile and layer
        struct: Any = kernels.Chunk
        chunks = np.zeros(len(key), dtype=struct.numpy_dtype())
        stop = np.cumsum(counts)[key]
        start = stop - counts[key] + (np.arange(len(key)) - first[key]) * kernels.CHUNK
        chunks["start"], chunks["stop"] = start, np.minimum(start + kernels.CHUNK, stop)
        layer, tile = np.divmod(key, across * down)
        chunks["layer"] = layer
        chunks["x"], chunks["y"] = tile % across * size, tile // across * size
        for name, origin, window in (("column", "x", kernels.COLUMNS), ("row", "y", kernels.ROWS)):
            middle = (chunks[origin] + size / 2.0 + self.canvas.pad) * self.canvas.scale
            chunks[name] = np.rint(middle - int(window) / 2)
        return chunks

    def set(self, k: int, model: Model, *, drift: float = 0.0, camera_rotation: CameraRotation | None = None) -> None:
        """Set the parameters of candidate ``k`` for the next :meth:`launch`. A previous launch must have finished.

        ``drift`` and ``camera_rotation`` move only events that have slopes or times.
        """
        assert not isinstance(model, EllipseModel)
        self._rows[k] = model.kernel_values()
        if self._drifts is not None:
            self._drifts[k] = drift
            _write(self._host[2], k, (camera_rotation or CameraRotation()).params())

    def launch(self) -> None:
        """Compute the image of warped events of every candidate."""
        for host, there in zip(self._host, self._on_device, strict=True):
            wp.copy(there, host)
        self.votes.zero_()
        blocks = len(self._arrays.chunks) * -(-self.candidates // int(AT_ONCE))
        inputs = [self._on_device[0], self._camera, self._arrays, self._motion, self._params, self._layout]
        wp.launch(vote_tiles, (blocks, int(THREADS)), inputs, [self.votes], device=self.device, block_dim=int(THREADS))

    def read(self, k: int, image: Image) -> None:
        """Write the image of candidate ``k`` [events] to ``image``."""
        wp.launch(read_tiles, len(image.pixels), [self.votes[k], 0], [image.pixels], device=self.device)


def _write(array: Any, k: int, struct: Any) -> None:
    """Write a struct to element ``k`` of an array of structs on the host."""
    size = wp.types.type_size_in_bytes(array.dtype)
    ctypes.memmove(array.ptr + k * size, ctypes.byref(struct.__ctype__()), size)
