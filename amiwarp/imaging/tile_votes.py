"""Events prepared for repeated voting on CUDA, for several candidate parameter sets per pass."""

from __future__ import annotations

import ctypes
import math
from typing import Any

import numpy as np
import warp as wp

from amiwarp.imaging.canvas import CanvasShape, Image
from amiwarp.imaging.uploaded_events import UploadedEvents
from amiwarp.kernels import tiles as kernels
from amiwarp.kernels.camera import pinhole_params
from amiwarp.kernels.camera_rotation import CameraRotationParams
from amiwarp.kernels.loading import specialised
from amiwarp.kernels.page_locked_memory import page_locked
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.base import Model, model_camera


class TileVotes:
    """Events sorted by image tile, and the vote images of a few candidate parameter sets.

    Buffers are allocated once. ``launch`` only launches kernels, so it can be captured in a CUDA graph. Kernels read
    the parameters from device memory when they run.
    """

    def __init__(
        self,
        image: Image,
        canvas: CanvasShape,
        events: UploadedEvents,
        like: Model,
        *,
        candidates: int = 1,
    ) -> None:
        """Sort the events. ``image`` is an image of the canvas, into which votes are read later.

        ``like`` is a model with the type and camera of the candidates.
        """
        device = image.device
        self.device = device
        self.canvas = canvas
        self.candidates = candidates
        self._params = canvas.params()

        # Without drift and rotation of the camera, the kernel of a pinhole camera may do.
        still = len(events.arrays.time) == 0 and events.slope is None
        camera = pinhole_params(like.camera) if still else None
        self._camera = camera or model_camera(like, device)

        self._arrays = self._sort(events)
        self.votes = wp.zeros((candidates, len(image.pixels)), dtype=wp.int64, device=device)
        """Votes of each candidate parameter set [1/256 event], in the memory layout of the image."""
        frame = image.frame
        self._layout = kernels.Layout()
        self._layout.stride = frame.stride
        self._layout.layer = frame.layer
        self._layout.first = frame.first
        self._layout.shift = (canvas.pad + 0.5) * canvas.scale - 0.5

        # Parameters of the candidates, on the host and on the device.
        dtypes = [like.STRUCT]
        if not still:
            dtypes += [float, CameraRotationParams]
        self._host = []
        self._on_device = []
        for dtype in dtypes:
            host = page_locked(self, (candidates,), dtype, device, written_by_host=True)
            self._host.append(host)
            self._on_device.append(wp.zeros(candidates, dtype=host.dtype, device=device))
        self._rows = self._host[0].numpy()
        self._drifts = None if still else self._host[1].numpy()
        self._motion: Any = kernels.Still()
        if not still:
            self._motion = kernels.Motion()
            self._motion.drift = self._on_device[1]
            self._motion.camera_rotation = self._on_device[2]
        self._inputs = [
            self._on_device[0],
            self._camera,
            self._arrays,
            self._motion,
            self._params,
            self._layout,
        ]
        self._kernel = specialised(kernels.vote_tiles, self._inputs)

    def _sort(self, events: UploadedEvents) -> Any:
        """Sort the events by tile and pack each event into one word."""
        arrays = events.arrays
        count = events.count
        device = self.device
        layers = self.canvas.shape[0]

        # Size of a tile [sensor px], and how many tiles there are.
        size = min(kernels.TILE, max(1, int(kernels.TILE / self.canvas.scale)))
        across = math.ceil(self.canvas.width / size)
        down = math.ceil(self.canvas.height / size)
        tiles = layers * across * down

        keys = wp.empty(2 * count, dtype=int, device=device)  # sorting needs scratch memory
        order = wp.empty(2 * count, dtype=int, device=device)
        counts = wp.zeros(tiles, dtype=int, device=device)
        inputs = [arrays.x, arrays.y, arrays.layer, layers, across, across * down, size]
        wp.launch(kernels.key_events, count, inputs, [keys, order, counts], device=device)
        wp.utils.radix_sort_pairs(keys, order, count, end_bit=tiles.bit_length())

        slope = events.slope
        if slope is None:
            slope = wp.empty(0, dtype=float, device=device)
        turn = arrays.turn if events.base is None else events.base
        slopes = count if len(slope) else 0
        times = count if len(arrays.time) else 0
        packed = kernels.TileEvents()
        packed.packed = wp.empty(count, dtype=wp.uint32, device=device)
        packed.slope = wp.empty(slopes, dtype=float, device=device)
        packed.time = wp.empty(times, dtype=float, device=device)
        inputs = [arrays.x, arrays.y, turn, slope, arrays.time, arrays.weight, order, size]
        wp.launch(kernels.pack_events, count, inputs, [packed], device=device)

        chunks = self._chunks(counts.numpy(), size, across, down)
        packed.chunks = wp.array(chunks, dtype=kernels.Chunk, device=device)
        return packed

    def _chunks(self, counts: Any, size: int, across: int, down: int) -> Any:
        """Return runs of at most CHUNK events of one tile and layer, each with a vote window centred on the tile."""
        pieces = -(-counts // kernels.CHUNK)  # rounded up
        if not pieces.any():
            pieces[0] = 1  # an empty chunk, if there are no events
        key = np.repeat(np.arange(len(counts)), pieces)  # tile and layer of each chunk
        struct: Any = kernels.Chunk
        chunks = np.zeros(len(key), dtype=struct.numpy_dtype())

        first_chunk = np.cumsum(pieces) - pieces  # of each tile and layer
        number = np.arange(len(key)) - first_chunk[key]  # of each chunk within its tile and layer
        stop = np.cumsum(counts)[key]
        first = stop - counts[key]
        start = first + number * kernels.CHUNK
        chunks["start"] = start
        chunks["stop"] = np.minimum(start + kernels.CHUNK, stop)

        layer, tile = np.divmod(key, across * down)
        chunks["layer"] = layer
        chunks["x"] = tile % across * size
        chunks["y"] = tile // across * size
        chunks["column"] = self._window_start(chunks["x"], size, kernels.COLUMNS)
        chunks["row"] = self._window_start(chunks["y"], size, kernels.ROWS)
        return chunks

    def _window_start(self, origin: Any, size: int, window: Any) -> Any:
        """Return where vote windows begin along an axis, so that their middles are the middles of their tiles."""
        in_image = origin + size / 2.0 + self.canvas.pad
        middle = in_image * self.canvas.scale
        return np.rint(middle - int(window) / 2)

    def set(
        self,
        k: int,
        model: Model,
        *,
        drift: float = 0.0,
        camera_rotation: CameraRotation | None = None,
    ) -> None:
        """Set the parameters of candidate ``k`` for the next :meth:`launch`. A previous launch must have finished.

        ``drift`` and ``camera_rotation`` move only events that have slopes or times.
        """
        self._rows[k] = model.kernel_values()
        if self._drifts is not None:
            self._drifts[k] = drift
            rotation = camera_rotation or CameraRotation()
            _write(self._host[2], k, rotation.params(self.device))

    def launch(self) -> None:
        """Compute the image of warped events of every candidate."""
        for host, on_device in zip(self._host, self._on_device, strict=True):
            wp.copy(on_device, host)
        self.votes.zero_()
        threads = int(kernels.THREADS)
        passes = math.ceil(self.candidates / int(kernels.AT_ONCE))
        blocks = len(self._arrays.chunks) * passes
        wp.launch(
            self._kernel,
            (blocks, threads),
            self._inputs,
            [self.votes],
            device=self.device,
            block_dim=threads,
        )

    def read(self, k: int, image: Image) -> None:
        """Write the image of candidate ``k`` [events] to ``image``."""
        wp.launch(
            kernels.read_tiles,
            len(image.pixels),
            [self.votes[k], 0],
            [image.pixels],
            device=self.device,
        )


def _write(array: Any, k: int, struct: Any) -> None:
    """Write a struct to element ``k`` of an array of structs on the host."""
    size = wp.types.type_size_in_bytes(array.dtype)
    ctypes.memmove(array.ptr + k * size, ctypes.byref(struct.__ctype__()), size)
