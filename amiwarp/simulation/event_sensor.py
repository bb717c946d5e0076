"""Simulated event sensors that look at images of other programs: a layer between a renderer and a network."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import NAMES, DeviceEvents, wait
from amiwarp.imaging.windows import Windows
from amiwarp.kernels import (
    camera_keys,
    camera_pixels,
    event_selection,
    launch,
    loading,
    pixels,
    prism_view,
    readout,
)
from amiwarp.kernels.camera_keys import CAMERA_LOW_BITS, CameraKeys
from amiwarp.kernels.camera_pixels import Cameras
from amiwarp.kernels.photoreceptors import Receptor
from amiwarp.optics.camera import LARGEST_SIZE
from amiwarp.schema.calls import guarded
from amiwarp.simulation.engine import LATEST_US, has_photoreceptors, sensor_params
from amiwarp.simulation.image_levels import ImageEncoding, ImageLevels
from amiwarp.simulation.key_buffer import KeyBuffer, sort_keys
from amiwarp.simulation.readout import bus_of, row_scan
from amiwarp.simulation.sensor_model import SensorModel
from amiwarp.validation import TIME_LIMIT, array, instance, whole

MOST_CAMERAS = 1 << 16
"""Largest number of cameras of an :class:`EventSensor`."""
MOST_PIXELS = 1 << 24
"""Largest number of pixels of all cameras of an :class:`EventSensor`, whose steps then take up to 65 ms."""
EVENTS_PER_PIXEL = 4
"""Initial capacity of the event buffer of a step [events per pixel]. The buffer grows if necessary."""
LARGEST_SEED = (1 << 31) - 1


@guarded
class EventSensor:
    """Event sensors of many cameras, whose images come from another program and stay on the device.

    :meth:`step` takes one image of each camera, and returns the events since the images before. Between two images, log
    intensity is linear in time. The sensors work as in :func:`simulate`, with the same random numbers: a camera gives
    the same events, bit for bit, as a simulation with its seed whose time steps end at its images.

    Parameters
    ----------
    cameras : int
        Number of cameras, 1 to 65536.
    height, width : int
        Size of the images [px].
    model : SensorModel, optional
        Pixels and readout of all cameras.
    seed : int or sequence of int, default 0
        Seed of each camera, or the seed of the first camera, from which the seeds of the others count up.
    device : str or warp.Device, default "cpu"
        Device of the images and the events.

    Raises
    ------
    AmiwarpError
        If a value is out of range, the seeds are not one for each camera, or all cameras have over 2**24 pixels. With
        ``row_us``, the number of cameras and the number of pixels of each count as the next power of two.

    Examples
    --------
    >>> import numpy as np
    >>> sensor = amiwarp.EventSensor(2, 1, 3, amiwarp.SensorModel.ideal(contrast=0.25))
    >>> images = np.zeros((2, 1, 3), np.float32)
    >>> len(sensor.step(images, 0)[0])  # the first images set the references
    0
    >>> images[1, 0, 2] = 0.6
    >>> events, windows = sensor.step(images, 1000)
    >>> events.t.numpy().tolist(), windows.start.tolist(), windows.stop.tolist()
    ([417, 833], [0, 0], [0, 2])
    """

    def __init__(
        self,
        cameras: int,
        height: int,
        width: int,
        model: SensorModel | None = None,
        *,
        seed: int | Sequence[int] | NDArray[np.integer[Any]] = 0,
        device: Any = "cpu",
    ) -> None:
        n = whole(cameras, "cameras", 1, MOST_CAMERAS)
        height = whole(height, "height", 1, LARGEST_SIZE, " pixels")
        width = whole(width, "width", 1, LARGEST_SIZE, " pixels")
        self._shape = (n, height, width)
        self._pixels = height * width
        self._model = instance(SensorModel() if model is None else model, SensorModel, "model")
        self._scan = row_scan(self._model, width, height)
        self._bus = bus_of(self._model)
        scans = int(self._scan.row_ps) > 0
        count = n * self._pixels
        if scans:
            count = 1 << ((n - 1).bit_length() + (self._pixels - 1).bit_length())
        if count > MOST_PIXELS:
            have = "with row_us count as" if scans else "have"
            raise AmiwarpError(
                f"{n} cameras of {width} x {height} {have} {count} pixels; the limit is {MOST_PIXELS}; "
                "give fewer cameras at a time"
            )
        self._device = wp.get_device(device)
        contrast = min(self._model.contrast_on, self._model.contrast_off)
        self._images = ImageLevels(self._shape, self._device, contrast)
        self._cameras = Cameras()
        self._cameras.pixels = self._pixels
        self._cameras.seed = wp.array(_seeds(seed, n), dtype=int, device=self._device)
        self._starts = np.ones(n, np.uint8)
        self._kernel = camera_pixels.run_camera_pixels
        self._state = [wp.empty(n * self._pixels, dtype=pixels.Pixel, device=self._device)]
        if has_photoreceptors(self._model):
            self._kernel = camera_pixels.run_filtered_camera_pixels
            self._state.append(wp.empty(n * self._pixels, dtype=Receptor, device=self._device))
        self._buffer = KeyBuffer(n * self._pixels, self._device, EVENTS_PER_PIXEL)
        self._nothing: wp.array = wp.empty(0, dtype=wp.int64, device=self._device)
        self._carry = self._nothing
        self._free = wp.zeros(n, dtype=wp.int64, device=self._device)
        self._layout = self._key_layout()
        self._first_us = -1
        self._now_us = -1

    def _key_layout(self) -> Any:
        """Return the layout of the keys of events."""
        cameras, _, width = self._shape
        bits_of_camera = (cameras - 1).bit_length()
        bits_of_pixel = (self._pixels - 1).bit_length()
        layout = CameraKeys()
        layout.pixels = self._pixels
        layout.width = width
        # Keys as pixels generate them: the time begins behind the number among the pixels of all cameras.
        shift = int(pixels.LOW_BITS) + (cameras * self._pixels - 1).bit_length()
        layout.shift = shift
        # Keys sorted by camera: pixel, time, camera and part, each from its lowest bit on.
        pixel = int(CAMERA_LOW_BITS) if int(self._scan.row_ps) else 1
        time = pixel + bits_of_pixel
        # The sign stays 0 in both kinds of keys; the part has two bits.
        bits_of_time = min(63 - shift, 61 - bits_of_camera - time)
        camera = time + bits_of_time
        layout.pixel = pixel
        layout.time = time
        layout.camera = camera
        layout.part = camera + bits_of_camera
        return layout

    def step(
        self, images: Any, t_us: int, encoding: str = ImageEncoding.LOG
    ) -> tuple[DeviceEvents, Windows]:
        """Advance all cameras to their next images, and return the events since the images before.

        The first images, and those after :meth:`reset`, set the reference of each pixel and give no events. Events
        whose latency ends after ``t_us`` follow in a later step. If the model has a bus, events that wait in its queue
        may have later times than ``t_us``.

        Parameters
        ----------
        images : array
            Log intensity, or luminance by ``encoding``, shape (cameras, height, width), for one camera also (height,
            width). Luminance may have a last axis of red, green and blue, or of these and a fourth value, which does
            not count. Of Warp, PyTorch, CuPy, JAX or any other library with DLPack, with any strides. Arrays in host
            memory are copied to a GPU. Arrays are not modified.
        t_us : int
            Time of the images [us], after the time of the images before.
        encoding : {"log", "linear", "srgb8"}
            What the values are, see :class:`amiwarp.simulation.ImageEncoding`: the natural logarithm of the luminance
            plus 0.02, white being ``log(1.02)``; linear luminance with white at 1; or 8-bit sRGB values. 0.02 is the
            simulator's stray light and dark current: the bandwidth and the noise of the model depend on it,
            thresholds do not.

        Returns
        -------
        DeviceEvents
            Events of all cameras, sorted by camera, then by time.
        Windows
            One window for each camera: the range of its events, and the times of the two images.

        Raises
        ------
        AmiwarpError
            If the images have another shape, type or device, or a value that is not within -100 .. 100; if the time
            does not increase, or the step is too long for the number of pixels. The state then stays as it was.

        Warns
        -----
        UserWarning
            Once, for luminance: if 8-bit images are stairs of over a tenth of a threshold, or if over 1 % of the
            pixels change by over 4 thresholds from one image to the next, whose events then come in bands.
        """
        t_us = whole(t_us, "t_us", 0, TIME_LIMIT - 1, " us")
        length = self._length(t_us)
        levels = self._images.convert(images, encoding)
        keys = self._generate(levels, t_us, length)
        keys, edges = self._arrange(keys, length)
        found, edges = self._read(keys, edges)
        self._now_us = t_us
        start = np.where(self._starts, t_us, t_us - length)
        self._starts[:] = 0
        wait(self._device)
        windows = Windows(
            start=edges[:-1].copy(),
            stop=edges[1:].copy(),
            t_start=start,
            t_end=np.full(len(start), t_us, np.int64),
        )
        return found, windows

    def reset(self, which: Any = None) -> None:
        """Start cameras anew at their next images, with the same random numbers as at first.

        Their events that have not been read out yet are dropped. If all cameras start anew, so do the times.
        Otherwise a row scan goes on, so that these cameras may get other time stamps than at first, and lose other
        events.

        Parameters
        ----------
        which : int or array_like, optional
            Number of a camera, or numbers of several cameras, shape (k,), or truth values, shape (cameras,). By
            default, all cameras.

        Raises
        ------
        AmiwarpError
            If there is no camera of a number.
        """
        n = self._shape[0]
        chosen = array(np.arange(n) if which is None else which, "which", "biu").reshape(-1)
        if chosen.dtype == bool:
            if len(chosen) != n:
                raise AmiwarpError(
                    f"which has {len(chosen)} truth values; expected one for each of {n} cameras"
                )
            chosen = np.flatnonzero(chosen)
        if chosen.size and not 0 <= int(chosen.min()) <= int(chosen.max()) < n:
            raise AmiwarpError(
                f"which holds cameras {chosen.min()} .. {chosen.max()}; expected 0 .. {n - 1}"
            )
        chosen = chosen.astype(np.int64)
        self._starts[chosen] = 1
        self._images.restart()
        free = self._free.numpy()
        free[chosen] = 0
        self._free = wp.array(free, dtype=wp.int64, device=self._device)
        if self._starts.all():
            self._carry = self._nothing
            self._now_us = -1

    def _length(self, t_us: int) -> int:
        """Return the duration of the step to a time [us]; 0 for the first step."""
        if self._now_us < 0:
            return 0
        length = t_us - self._now_us
        longest = (1 << (int(self._layout.camera) - int(self._layout.time))) - LATEST_US
        longest = min(longest, ((1 << 31) - 1) // int(pixels.TICKS))
        if not 1 <= length <= longest:
            raise AmiwarpError(
                f"t_us is {t_us} after {self._now_us} us; with {self._shape[0] * self._pixels} pixels, a step takes "
                f"1 .. {longest} us; give a later time, images in between, or fewer cameras"
            )
        return length

    def _generate(self, levels: wp.array, t_us: int, length: int) -> wp.array:
        """Simulate the pixels over a step. Return the keys of events, with those carried over, unsorted."""
        steps = prism_view.Steps()
        steps.count = 1
        steps.ticks = length * int(pixels.TICKS)
        steps.per_tick = 1.0 / max(int(steps.ticks), 1)
        steps.shift = self._layout.shift
        if length == 0:
            self._first_us = t_us
            self._bus.origin = t_us
        self._cameras.starts = wp.array(self._starts, dtype=wp.uint8, device=self._device)
        sensor = sensor_params(self._model, max(length, 1))
        loading.load(self._kernel, self._device)
        inputs = [levels, self._cameras, steps, sensor]
        return self._buffer.run(self._kernel, inputs, self._state, self._carry)

    def _arrange(self, keys: wp.array, length: int) -> tuple[wp.array, NDArray[np.int64]]:
        """Return the keys of the events that are read out in this step, sorted by camera, and the cameras' ranges.

        ``keys``: twice the needed length. Later events are kept for the next step.
        """
        n = self._shape[0]
        total = len(keys) // 2
        self._layout.length = length
        if not total:  # Warp cannot slice an empty array
            return self._nothing, np.zeros(n + 1, np.int64)
        if int(self._scan.row_ps):
            self._scan.since_scan_us = self._now_us - self._first_us
            self._scan.shift = self._layout.shift
            self._launch(readout.stamp_rows, total - len(self._carry), [self._scan, keys])
        self._launch(camera_keys.sort_by_camera, total, [self._layout, self._cameras.starts, keys])
        lowest = 0 if int(self._scan.row_ps) else int(self._layout.pixel)
        sort_keys(keys, total, lowest, int(self._layout.part) + 2)
        found = wp.empty(n + 2, dtype=int, device=self._device)
        self._launch(camera_keys.find_cameras, n + 2, [self._layout, keys, total, n], [found])
        edges = found.numpy().astype(np.int64)
        now, later = edges[n:].tolist()
        self._carry = wp.clone(keys[now:later]) if now < later else self._nothing
        self._launch(camera_keys.carry_over, len(self._carry), [self._layout, self._carry])
        return keys[:now] if now else self._nothing, edges[: n + 1]

    def _read(
        self, keys: wp.array, edges: NDArray[np.int64]
    ) -> tuple[DeviceEvents, NDArray[np.int64]]:
        """Return the events of sorted keys that the sensors read out, and the ranges of the cameras."""
        if int(self._scan.row_ps) and len(keys):
            (keys,), edges = self._keep(event_selection.mark_first_of_pixel, [keys], [keys], edges)
        n = len(keys)
        types = (wp.uint16, wp.uint16, wp.int64, wp.uint8)
        columns = [wp.empty(n, dtype=dtype, device=self._device) for dtype in types]
        self._launch(camera_keys.unpack_cameras, n, [self._layout, keys, self._now_us], columns)
        if int(self._bus.event_ps) and n:
            _, y, t, _ = columns
            first = wp.array(edges, dtype=int, device=self._device)
            stamp = wp.empty(n, dtype=wp.int64, device=self._device)
            loading.load(readout.queue_events, self._device)
            wp.launch(
                readout.queue_events,
                self._shape[0],
                [self._bus, t, y, first, self._free],
                [stamp],
                device=self._device,
            )
            columns[NAMES.index("t")] = stamp
            columns, edges = self._keep(event_selection.mark_transmitted, [stamp], columns, edges)
        return DeviceEvents(*columns), edges

    def _keep(
        self, mark: Any, inputs: list[wp.array], columns: list[wp.array], edges: NDArray[np.int64]
    ) -> tuple[list[wp.array], NDArray[np.int64]]:
        """Return the values of columns that the kernel ``mark`` marks, and the ranges of the cameras in them."""
        n = len(columns[0])
        kept = wp.empty(n, dtype=int, device=self._device)
        self._launch(mark, n, inputs, [kept])
        ends = wp.empty_like(kept)
        wp.utils.array_scan(kept, ends, inclusive=True)
        index = wp.array(edges, dtype=int, device=self._device)
        self._launch(event_selection.count_before, len(edges), [ends], [index])
        edges = index.numpy().astype(np.int64)
        total = int(edges[-1])
        kept_columns = []
        for values in columns:
            kept_values = wp.empty(total, dtype=values.dtype, device=self._device)
            self._launch(event_selection.keep_marked, n, [values, ends], [kept_values])
            kept_columns.append(kept_values)
        return kept_columns, edges

    def _launch(
        self, kernel: Any, n: int, inputs: list[Any], outputs: Sequence[wp.array] = ()
    ) -> None:
        """Run a kernel whose last input is ``start: int`` over ``range(n)``."""
        launch.launch(kernel, n, inputs, outputs, device=self._device)


def _seeds(seed: Any, cameras: int) -> NDArray[np.int32]:
    """Return the seed of each camera, checked."""
    if not isinstance(seed, list | tuple | range | np.ndarray):
        first = whole(seed, "seed", 0, LARGEST_SEED - cameras + 1)
        return (first + np.arange(cameras)).astype(np.int32)
    given = array(seed, "seed", "iu")
    if given.shape != (cameras,) or int(given.min()) < 0 or int(given.max()) > LARGEST_SEED:
        raise AmiwarpError(
            f"seed has shape {given.shape}; expected one number, or one for each of {cameras} cameras, in 0 .. "
            f"{LARGEST_SEED}"
        )
    return given.astype(np.int32)
