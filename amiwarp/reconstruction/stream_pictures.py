"""How the pictures of a stream are made from the ring of its last turn: on a CPU, or wholly on a GPU.

Both give the same pictures, but for the rounding of sums.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy import ndimage

from amiwarp.imaging.phase import BINS, RANDOM_CHANGE, PhaseSums
from amiwarp.imaging.phase_ring import LEAST_EVENTS, PhaseRing, PhaseUpdate
from amiwarp.imaging.phase_ring_device import DeviceRing
from amiwarp.kernels import phase_ring_device as kernels
from amiwarp.kernels.launch import launch
from amiwarp.kernels.phase_misfit import write_misfit
from amiwarp.optics.models.base import Model
from amiwarp.reconstruction.device_picture import DevicePictures, captured
from amiwarp.reconstruction.phase_lag import lag_of
from amiwarp.reconstruction.phase_tiles import scene_of_tiles
from amiwarp.reconstruction.picture_in_phase import (
    joined_picture,
    motion_of,
    picture_of_slopes,
    pixel_motion,
)

MOVED = 0.5
"""Misfit over which something has moved at a pixel."""
LEAST_ROWS = 64
"""Fewest rows of an image for which a thread is worth its start."""
RIM_PX = 25
"""Side of the square around a moved pixel that counts as moved [px]: events show edges, not what lies between."""


class Made(NamedTuple):
    """Picture of a stream on the host."""

    log: NDArray[np.float32]
    """Log intensity [ON thresholds], shape (height, width)."""
    known: NDArray[np.bool_]
    """Which pixels have sums, shape (height, width)."""
    misfit: NDArray[np.float32]
    """Share of the newest brightness that was not expected, 0 to 1, shape (height, width)."""
    moved: NDArray[np.bool_]
    """Whether something moved at the pixel or near it, shape (height, width)."""
    off_ratio: float
    """OFF threshold divided by the ON threshold."""
    events: int
    """Number of events of the newest part."""


class HostPictures:
    """Pictures on a CPU. Use one object from one thread only."""

    def __init__(self, model: Model, harmonics: int) -> None:
        self.ring = PhaseRing(model.camera.width, model.camera.height, harmonics=harmonics)
        """The events of the last turn."""
        self._model = model
        self._lag = 0.0
        self._before: tuple[PhaseSums, NDArray[np.float32]] | None = None
        # Refuses the model, or loads kernels and tables before the stream needs them
        nothing = _nothing(self.ring)
        self._picture(nothing)
        lag_of(nothing, model)

    def begin(self, bins: int, *, first: bool, find_lag: bool) -> Callable[[], Made]:
        """Make the picture of the last bins, and return what gives it.

        ``first`` forgets the pictures before, for a whole turn. ``find_lag`` finds the lag of events anew.
        """
        made = self._drawn(bins, first, find_lag)
        return lambda: made

    def _drawn(self, bins: int, first: bool, find_lag: bool) -> Made:
        """Return the picture of the last bins."""
        if first or self._before is None:
            sums = self.ring.sums()
            misfit = np.zeros(sums.on.shape, np.float32)
            before = None
        else:
            prior, before = self._before
            update = self.ring.update(prior, bins / BINS)
            sums = update.sums
            misfit = _misfit(update)
        if find_lag:
            self._lag = lag_of(sums, self._model)
        log, slopes = self._picture(sums)
        ground = log
        moved = ndimage.maximum_filter(misfit > MOVED, RIM_PX)
        if before is not None and moved.any():
            wrong = _difference(before, slopes, moved)
            ground = log + picture_of_slopes(wrong, self._model)
            log = np.where(moved, log, ground)
            log -= np.median(log)
        self._before = sums, ground
        known = sums.values[0] != 0
        return Made(log, known, misfit, moved, sums.off_ratio, sums.events)

    def _picture(self, sums: PhaseSums) -> tuple[NDArray[np.float32], NDArray[np.complex64]]:
        """Return the picture of sums, and its gradient."""
        slopes = motion_of(sums, self._model).gradient(sums.values[0], self._lag)
        detail = scene_of_tiles(sums, self._model, self._lag, with_rest=False).detail
        return joined_picture(detail, slopes, self._model), slopes


class DevicePicturesOfStream:
    """Pictures on a GPU: its memory holds events, sums and pictures. Use one object from one thread only.

    On CUDA, the launches of a picture are two graphs, between which the lag may be found. Tests run it on a CPU, too.
    """

    def __init__(self, model: Model, harmonics: int, device: Any) -> None:
        pixel_motion(model)  # refuses an optic that moves the image along a line
        width = model.camera.width
        height = model.camera.height
        self.ring = DeviceRing(width, height, harmonics, device)
        """The events of the last turn."""
        self._device = self.ring.device
        self._scene = DevicePictures(model, self.ring.values)
        shape = (height, width)
        images = [wp.zeros(shape, dtype=float, device=self._device) for _ in range(4)]
        self._ground, self._shown, self._correction, self._nothing = images
        self._wrong = wp.empty(shape, dtype=wp.vec2, device=self._device)
        self._lines = wp.empty(shape, dtype=wp.uint8, device=self._device)
        self._moved = wp.zeros(shape, dtype=wp.uint8, device=self._device)
        self._idle: list[_Copy] = []
        # Without events, to load all kernels: none may be loaded while launches are captured
        self.ring.sum_given()
        self._find_lag()
        self._make()
        self._sum = self._graph(self.ring.sum_given)
        self._draw = self._graph(self._make)

    def begin(self, bins: int, *, first: bool, find_lag: bool) -> Callable[[], Made]:
        """Queue the picture of the last bins, and return what waits for it.

        ``first`` forgets the pictures before, for a whole turn. ``find_lag`` finds the lag of events anew.
        """
        with wp.ScopedDevice(self._device):
            self.ring.give(bins, first=first)
            self._sum()
            if find_lag:
                self._find_lag()
            self._draw()
            copy = self._idle.pop() if self._idle else _Copy(self._shown)
            copy.queue(self._shown, self.ring, self._moved)
        return partial(self._finish, copy)

    def _finish(self, copy: _Copy) -> Made:
        """Return a picture when it is made."""
        made = copy.result()
        self._idle.append(copy)
        return made

    def _graph(self, run: Callable[[], None]) -> Callable[[], None]:
        """Return a function that repeats launches, on CUDA as a graph."""
        if self._device.is_cpu:
            return run
        return partial(wp.capture_launch, captured(run, self._device))

    def _find_lag(self) -> None:
        """Find the lag of events."""
        self._scene.transform()
        self._scene.find_lag()

    def _make(self) -> None:
        """Make the picture of the sums, and what does not move alone, as the gradient of the one before shows it."""
        scene = self._scene
        pixels = self._shown.size
        scene.transform()
        scene.make_scenes()
        scene.add_long_waves()
        inputs = [self.ring.misfit, MOVED, RIM_PX // 2]
        self._launch(kernels.moved_in_line, pixels, inputs, [self._lines])
        self._launch(kernels.moved_in_column, pixels, [self._lines, RIM_PX // 2], [self._moved])
        inputs = [self._ground, scene.slopes, self._moved]
        self._launch(kernels.wrong_slopes, pixels, inputs, [self._wrong])
        scene.replace_long_waves(self._nothing, self._wrong, self._correction)
        inputs = [scene.picture, self._correction, self._moved]
        outputs = [self._ground, self._shown, scene.keys]
        self._launch(kernels.join_ground, pixels, inputs, outputs)
        scene.subtract_median(self._shown)

    def _launch(self, kernel: Any, n: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Run a kernel whose last input is ``start: int``."""
        launch(kernel, n, inputs, outputs, device=self._device)


class _Copy:
    """Picture that is copied to the host when the device has made it."""

    def __init__(self, picture: wp.array) -> None:
        pinned = picture.device.is_cuda
        types = (float, wp.uint8, float, wp.uint8)
        self._parts = [
            wp.empty(picture.shape, dtype=kind, device="cpu", pinned=pinned) for kind in types
        ]
        self._made = wp.Event(picture.device) if pinned else None
        self._off_ratio = 1.0
        self._events = 0

    def queue(self, picture: wp.array, ring: DeviceRing, moved: wp.array) -> None:
        """Queue the copies of a picture behind its work."""
        sources = (picture, ring.known, ring.misfit, moved)
        for to, source in zip(self._parts, sources, strict=True):
            wp.copy(to, source)
        self._off_ratio = ring.ratio
        self._events = ring.events
        if self._made is not None:
            picture.device.stream.record_event(self._made)

    def result(self) -> Made:
        """Wait for the picture, and return it."""
        if self._made is not None:
            wp.synchronize_event(self._made)
        log, known, misfit, moved = (part.numpy() for part in self._parts)
        return Made(
            log.copy(),
            known.astype(np.bool_),
            misfit.copy(),
            moved.astype(np.bool_),
            self._off_ratio,
            self._events,
        )


def pictures_on(device: Any, model: Model, harmonics: int) -> HostPictures | DevicePicturesOfStream:
    """Return what makes the pictures of a stream on a device."""
    if device.is_cuda:
        return DevicePicturesOfStream(model, harmonics, device)
    return HostPictures(model, harmonics)


def _difference(
    before: NDArray[np.float32], slopes: NDArray[np.complex64], where: NDArray[np.bool_]
) -> NDArray[np.complex64]:
    """Return how the gradient of the picture before differs from ``slopes`` at some pixels, and 0 at the others."""
    height, width = before.shape
    y, x = np.nonzero(where)
    above = np.maximum(y - 1, 0)
    below = np.minimum(y + 1, height - 1)
    left = np.maximum(x - 1, 0)
    right = np.minimum(x + 1, width - 1)
    found = np.zeros_like(slopes)
    along_x = (before[y, right] - before[y, left]) / (right - left)
    along_y = (before[below, x] - before[above, x]) / (below - above)
    found[y, x] = along_x + 1j * along_y - slopes[y, x]
    return found


def _nothing(ring: PhaseRing) -> PhaseSums:
    """Return the sums of no events."""
    shape = (ring.height, ring.width)
    none = np.zeros(shape, np.int32)
    return PhaseSums(np.zeros((ring.harmonics, *shape), np.complex64), none, none, 1.0, 1.0)


def _misfit(update: PhaseUpdate) -> NDArray[np.float32]:
    """Return the share of the newest brightness around each pixel that was not expected, 0 where nothing happens.

    Events at random angles add the same to the squares of the change and of the newest part; the expected sums have as
    much noise.
    """
    sums = update.sums
    changes = np.zeros_like(sums.on) if sums.changes is None else sums.changes
    parts = (update.change, update.size, sums.on, sums.off, changes)
    inputs: list[Any] = [wp.array(part.ravel(), device="cpu", copy=False) for part in parts]
    noise = update.noise * np.array([1.0, sums.off_ratio**2, RANDOM_CHANGE])
    inputs += [wp.vec3(*noise), update.noise * LEAST_EVENTS]
    misfit = np.empty(sums.on.shape, np.float32)
    outputs = [wp.array(misfit, device="cpu", copy=False)]
    launch(write_misfit, len(misfit), inputs, outputs, device="cpu", smallest=LEAST_ROWS)
    return misfit
