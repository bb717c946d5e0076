"""Motion compensation of recordings."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, overload

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.calib.result import Calibration
from amiwarp.errors import AmiwarpError
from amiwarp.events import device_events
from amiwarp.events.device_events import DeviceEvents, device_for, limits, wait
from amiwarp.events.encoder import Encoder, check_prisms
from amiwarp.events.recording import Events, EventSource, MetadataValue, Recording
from amiwarp.io import RecordingWriter
from amiwarp.io.depth_map import DepthMap
from amiwarp.io.export import bag_of, export, left_out, subtracted_us
from amiwarp.io.files import check_output
from amiwarp.io.formats import Codec, OutputFormat, Rounding, check_codec, check_rounding, output_format
from amiwarp.io.hdf5_files import CHUNK, compile_checksums
from amiwarp.io.native_format import FlaggedEvents, NativeEvents, copy_records
from amiwarp.kernels.compensation import Columns, LaunchPlan
from amiwarp.kernels.events import join_columns
from amiwarp.kernels.launch import RecordedLaunch, launch, page_locked
from amiwarp.kernels.prism_angle import encoder_params
from amiwarp.optics.models import Model, PlateModel
from amiwarp.tasks import Progress, in_order
from amiwarp.validation import guarded

# Compensation of pieces of events on a GPU, through page-locked buffers that threads share.

GIVEN = {"x": wp.uint16, "y": wp.uint16, "t": wp.int64}
FOUND = {"out_x": wp.float32, "out_y": wp.float32, "inside": wp.uint8}
BUFFERS = 3
"""Number of pieces that threads process on the GPU at a time. Page-locking the memory of a piece takes 5 ms."""
PIECE = 4 * CHUNK
"""Number of events that a thread reads, compensates and writes at a time. With fewer, threads wait more often for
Python's lock; more events need more memory."""


class PieceBuffers:
    """Page-locked memory and memory on a GPU for one piece of events."""

    def __init__(self, room: int, plan: LaunchPlan, encoder: Any, device: Any) -> None:
        """Allocate memory for ``room`` events."""
        self.room, self._plan, self._encoder, self._device = room, plan, encoder, device
        self._done = wp.Event(device)
        self._columns, self._locked = Columns(), {}
        for name, dtype in (GIVEN | FOUND).items():
            setattr(self._columns, name, wp.empty(room, dtype=dtype, device=device))
            self._locked[name] = page_locked(self, (room,), dtype, device, written_by_host=name in GIVEN)
        self._host = {name: array.numpy() for name, array in self._locked.items()}
        self._launches: dict[bool, RecordedLaunch] = {}

    def put(self, events: Events) -> None:
        """Copy events to the page-locked memory."""
        for name in GIVEN:
            self._host[name][: len(events)] = getattr(events, name)

    def start(self, n: int, outside: bool) -> None:
        """Start the compensation of ``n`` events. ``outside``: whether events may lie outside the sensor."""
        for name in GIVEN:
            wp.copy(getattr(self._columns, name), self._locked[name], count=n)
        if outside not in self._launches:
            inputs = self._plan.inputs(self._encoder, self._columns, outside=outside)
            self._launches[outside] = RecordedLaunch(self._plan.kernel, [*inputs, 0], [], device=self._device)
        self._launches[outside](0, n)
        for name in FOUND:
            wp.copy(self._locked[name], getattr(self._columns, name), count=n)
        self._device.stream.record_event(self._done)

    def take(self, found: list[NDArray[Any]]) -> None:
        """Wait for the GPU, and store x and y [px] and 1 for each event inside the image in arrays."""
        wp.synchronize_event(self._done)
        for name, values in zip(FOUND, found, strict=True):
            values[:] = self._host[name][: len(values)]


class GpuPieces:
    """Compensation of pieces of events on a GPU. Any thread may call it."""

    def __init__(self, plan: LaunchPlan, encoder: Any, device: Any) -> None:
        self._plan, self._encoder, self._device = plan, encoder, device
        self._free = threading.Semaphore(BUFFERS)
        self._idle: list[PieceBuffers] = []
        self.one_thread = threading.Lock()
        """Lock for launches and copies, because Warp's bookkeeping on CUDA allows one thread at a time."""

    def __call__(self, events: Events) -> list[NDArray[Any]]:
        """Return compensated x and y [px] and 1 for each event inside the image, shape ``(n,)``."""
        n, outside = len(events), self._plan.any_outside(int(events.x.max()), int(events.y.max()))
        found = [np.empty(n, wp.dtype_to_numpy(dtype)) for dtype in FOUND.values()]
        for first in range(0, n, PIECE):
            self._run(events[first : first + PIECE], outside, [a[first : first + PIECE] for a in found])
        return found

    def _run(self, events: Events, outside: bool, found: list[NDArray[Any]]) -> None:
        with self._free:
            buffers = self._buffers(len(events))
            buffers.put(events)
            with self.one_thread:
                buffers.start(len(events), outside)
            buffers.take(found)
            self._idle.append(buffers)

    def _buffers(self, n: int) -> PieceBuffers:
        """Return idle or new buffers for ``n`` events; idle ones that are too small are dropped."""
        with self.one_thread:
            while self._idle:
                buffers = self._idle.pop()
                if buffers.room >= n:
                    return buffers
            # a power of two, so that blocks of growing size seldom need new buffers
            return PieceBuffers(1 << (n - 1).bit_length(), self._plan, self._encoder, self._device)


@guarded
@dataclass(frozen=True, slots=True)
class CompensationSummary:
    """Summary of the compensation of a recording.

    Examples
    --------
    >>> amiwarp.CompensationSummary(events=2_000_000, outside=150, seconds=0.5).mev_per_s
    4.0
    """

    events: int
    """Number of compensated events."""
    outside: int
    """Number of events outside the image or without coordinates (NaN). They are kept unless coordinates are rounded."""
    seconds: float
    """Duration of the compensation, including reading and writing [s]."""
    format: OutputFormat = OutputFormat.NATIVE
    """Format that was written."""
    rounding: Rounding | None = None
    """How coordinates were rounded to whole pixels, or None if they were not."""
    dropped: int = 0
    """Number of events that were not written, because after rounding they are outside the image."""
    left_out: tuple[str, ...] = ()
    """Parts of the recording that the new file does not hold, such as ``"encoder"`` in a format without."""
    subtracted_us: int = 0
    """Time that was subtracted from all events [us]: in a ROS 2 bag the first event, if the last is later than 28 h."""

    @property
    def mev_per_s(self) -> float:
        """Speed of the compensation [million events/s]."""
        return self.events / max(self.seconds, 1e-9) / 1e6


class BlockCompensator:
    """Compensation of blocks of events by one model and one encoder on a device. Any thread may call it."""

    def __init__(self, model: Model, encoder: Encoder, t_first: int, t_last: int, device: Any) -> None:
        """Copy the model, and the encoder's samples for a span of event times, to the device.

        Raises :class:`AmiwarpError` if the encoder does not cover the times ``t_first`` .. ``t_last`` [us].
        """
        check_prisms(encoder, model.ANGLES)
        self._device = wp.get_device(device)
        self._plan = LaunchPlan(model, self._device)
        self._encoder = encoder_params(encoder, t_first, t_last, str(self._device))
        self._pieces = None if self._device.is_cpu else GpuPieces(self._plan, self._encoder, self._device)

    def __call__(self, events: Events, *, all_cores: bool = False) -> tuple[Events, NDArray[np.uint8]]:
        """Return compensated events (NaN without coordinates), and 1 for each inside the image, shape ``(n,)``."""
        device_events.check_sensor(events)
        if not len(events):
            return Events(np.zeros(0, np.float32), np.zeros(0, np.float32), events.t, events.p), np.zeros(0, np.uint8)
        x, y, inside = self._compensate(events, all_cores) if self._pieces is None else self._pieces(events)
        return Events(x, y, events.t, events.p), inside

    def on_device(self, events: DeviceEvents) -> tuple[wp.array, wp.array]:
        """Return compensated x and y of at least one event, as Warp arrays of shape ``(n,)``."""
        device_events.check_sensor(events)
        _, _, max_x, max_y, _, _ = limits(events)
        with self._pieces.one_thread if self._pieces else contextlib.nullcontext():
            c = self._plan.run(self._plan.device_columns(events), self._encoder, max_x, max_y)
        return c.out_x[: len(events)], c.out_y[: len(events)]

    def _compensate(self, events: Events, all_cores: bool) -> list[NDArray[Any]]:
        """Return compensated x and y [px] and 1 for each event inside the image, on a CPU."""
        padded = self._plan.padded(len(events))
        columns = [_column(values, wp.uint16, padded) for values in (events.x, events.y)]
        columns.append(_column(events.t, wp.int64, padded))
        c = self._plan.run(columns, self._encoder, events.x.max(), events.y.max(), all_cores=all_cores)
        return [values.numpy()[: len(events)] for values in (c.out_x, c.out_y, c.inside)]


def _column(values: NDArray[Any], dtype: Any, padded: int) -> Any:
    """Return values as a padded column on a CPU, without a copy if possible."""
    if len(values) < padded:
        values = np.concatenate([values, np.zeros(padded - len(values), values.dtype)])
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device="cpu", copy=False)


@overload
def compensate_events(events: Events, model: Model, encoder: Encoder, *, device: Any = ...) -> NDArray[np.float32]: ...
@overload
def compensate_events(events: DeviceEvents, model: Model, encoder: Encoder, *, device: Any = ...) -> wp.array: ...
@guarded
def compensate_events(
    events: Events | DeviceEvents, model: Model, encoder: Encoder, *, device: Any = None
) -> NDArray[np.float32] | wp.array:
    """Compensate events in memory: return their positions without the prism.

    Parameters
    ----------
    events : Events or DeviceEvents
        Events with the whole pixel coordinates of a sensor (uint16), sorted by time.
    model : Model
        Optical model of the prism.
    encoder : Encoder
        Encoder that covers the events.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU. Events on a device are compensated there.

    Returns
    -------
    ndarray or warp.array
        Coordinates without the prism [px], float32, shape ``(n, 2)``; NaN for events without a solution. A Warp array
        on the same device for :class:`DeviceEvents`.

    Raises
    ------
    AmiwarpError
        If the encoder does not cover the events, their coordinates are not whole pixels, their times decrease, or they
        are on another device than ``device``.

    Examples
    --------
    >>> camera = amiwarp.Camera.from_fov(64, 48, 1.0)
    >>> model = amiwarp.CircleModel.from_prism(camera, amiwarp.Prism(0.02), 0.3)
    >>> events = amiwarp.Events.from_arrays([10, 20], [30, 40], [0, 1000], [0, 1])
    >>> encoder = amiwarp.Encoder.constant_speed(720.0, 0, 2000)
    >>> amiwarp.compensate_events(events, model, encoder).shape
    (2, 2)
    """
    device = device_for(events, device)
    device_events.check_order(events)
    if isinstance(events, DeviceEvents):
        return _compensate_on_device(events, model, encoder)
    first, last = (int(events.t.min()), int(events.t.max())) if len(events) else encoder.coverage
    compensated, _inside = BlockCompensator(model, encoder, first, last, device)(events, all_cores=True)
    return np.stack([compensated.x, compensated.y], axis=1)


def _compensate_on_device(events: DeviceEvents, model: Model, encoder: Encoder) -> wp.array:
    """Return finished coordinates without the prism [px], shape (n, 2)."""
    device_events.check_sensor(events)
    xy = wp.empty((len(events), 2), dtype=float, device=events.device)
    if len(events):
        compensator = BlockCompensator(model, encoder, events.t_first, events.t_last, events.device)
        launch(join_columns, len(events), compensator.on_device(events), [xy], device=events.device)
    wait(events.device)
    return xy


@guarded
def compensate(
    recording: Recording,
    calibration: Calibration,
    out_path: str | os.PathLike[str],
    *,
    depth: DepthMap | None = None,
    device: Any = "cpu",
    progress: Progress | None = None,
    on_block: Callable[[Events], None] | None = None,
    overwrite: bool = False,
    format: OutputFormat | str | None = None,
    codec: Codec | str = Codec.BLOSC,
    rounding: Rounding | str | None = None,
    seed: int = 0,
) -> CompensationSummary:
    """Compensate a recording and write the result to a file.

    Events keep their time, polarity and order; coordinates become sub-pixel float32 values. Events outside the image
    are kept; the native format marks them in ``events/inside``. Memory use is constant.

    The native format, npz and text (to 1e-6 px) hold sub-pixel coordinates. The other formats need ``rounding``. A
    native file gets the calibrated camera, the IMU samples, and the ground truth of instants; frames, which show the
    image through the optic, and the ground truth of single events are left out. From a bag to one of the same version
    of ROS, the messages of all other topics are copied.

    Parameters
    ----------
    recording : Recording
        Recording to compensate.
    calibration : Calibration
        Calibration of the same camera and prism.
    out_path : str or os.PathLike
        Path of the new recording. Its extension gives the format, as for :func:`convert`.
    depth : DepthMap, optional
        Depth of what each pixel sees, for a rotating tilted plate. Without it, a plate's scene is a plane at the
        calibrated depth. Unknown depths are filled by :meth:`DepthMap.filled`.
    device : str or warp.Device, optional
        Device to compute on.
    progress : Progress, optional
        Called with the finished share.
    on_block : callable, optional
        Called with each block of compensated events, in order.
    overwrite : bool, optional
        Replace an existing file.
    format : OutputFormat or str, optional
        The format to write, if not that of the extension. The layout of DSEC (``"dsec"``) needs it.
    codec : Codec or str, default "blosc"
        Compression of HDF5. Programs without HDF5's Blosc filter read ``"gzip"``.
    rounding : Rounding or str, optional
        How to round coordinates to whole pixels. Events outside the image after that are dropped and counted.
    seed : int, default 0
        Seed of the random numbers of ``"dithered"``. The same recording and seed give the same result.

    Returns
    -------
    CompensationSummary
        Number of events, duration, and what the format leaves out.

    Raises
    ------
    AmiwarpError
        If the calibration is for another sensor size, the events are already compensated or not covered by the encoder,
        a depth map is given for another optic than a plate or has another size, the format cannot hold the events, or
        the output cannot be written, is the recording itself, or exists. No partial file remains.

    Examples
    --------
    >>> camera, prism = amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.02)
    >>> events = amiwarp.Events.from_arrays([10, 20], [12, 14], [0, 1000], [0, 1])
    >>> encoder = amiwarp.Encoder.constant_speed(720.0, 0, 2000)
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, 32, 24), camera, encoder, prism)
    >>> calibration = amiwarp.Calibration(
    ...     model_name="circle", camera=camera, prism=prism, parameters={"deflection": 0.01, "phase": 0.3},
    ...     uncertainty={}, free=(), sharpness_name="variance", sharpness_before=1.0, sharpness_after=2.0,
    ...     stages=(), events=2, seconds=0.0)
    >>> amiwarp.compensate(recording, calibration, "compensated.h5").events
    2
    """
    began = time.perf_counter()
    out_path = Path(out_path)
    check_output(out_path, overwrite=overwrite)
    chosen = output_format(out_path, format)
    codec = check_codec(out_path, codec, chosen)
    rounding = check_rounding(out_path, rounding, chosen)
    width, height = recording.events.size
    check_size(calibration, recording.events.size, recording.name)
    model = calibration.model if depth is None else at_depths(calibration.model, depth)
    n = len(recording.events)
    encoder = recording.encoder
    if n:
        if not recording.events[:1].whole_pixels:
            raise AmiwarpError(f"{recording.name}: its events are already compensated; give those of the sensor")
        encoder = calibration.encoder_for(encoder, recording.events.t_first, recording.events.t_last)
    outside = done = dropped = 0
    metadata: dict[str, MetadataValue] = {**recording.metadata, "compensated_with": calibration.model_name}
    truth = recording.truth

    def count(events: Events, inside: NDArray[np.uint8]) -> None:
        nonlocal outside, done
        outside += len(events) - int(np.count_nonzero(inside))
        done += len(events)
        if on_block is not None:
            on_block(events)
        if progress is not None:
            progress("compensating", done / n)

    compensator = None
    if encoder is not None and n:
        compensator = BlockCompensator(model, encoder, recording.events.t_first, recording.events.t_last, device)
    if chosen is not OutputFormat.NATIVE:
        with contextlib.closing(_counted(recording.events, compensator, count)) as blocks:
            dropped = export(
                recording.events, out_path, chosen, (width, height), codec=codec, progress=None, overwrite=overwrite,
                blocks=blocks, rounding=rounding, seed=seed, bag=bag_of(recording, chosen),
            )  # fmt: skip
        missing = left_out(recording, chosen)
        seconds = time.perf_counter() - began
        moved = subtracted_us(recording.events, chosen)
        return CompensationSummary(done, outside, seconds, chosen, rounding, dropped, missing, moved)
    parameters, labels = (None, None) if truth is None else (truth.parameters, truth.labels)
    with RecordingWriter(
        out_path, width=width, height=height, camera=model.camera, prism=recording.prism, encoder=encoder,
        truth_parameters=parameters, truth_labels=labels, metadata=metadata, overwrite=overwrite, codec=codec,
    ) as writer:  # fmt: skip
        if compensator is not None:
            compile_checksums()
            pieces = compensated_pieces(recording.events, compensator)
            writer.fill(pieces, count=PIECE, t_first=recording.events.t_first, done=count)
        copy_records(recording, writer)
    of_events = () if truth is None else (
        truth.stored_points, truth.stored_causes, truth.stored_instances, truth.stored_depths, truth.stored_places
    )  # fmt: skip
    lost = {
        "ground truth of events": any(values is not None for values in of_events),
        "frames": recording.frames is not None,
    }
    missing = tuple(name for name, left in lost.items() if left)
    return CompensationSummary(done, outside, time.perf_counter() - began, left_out=missing)


def at_depths(model: Model, depth: DepthMap) -> PlateModel:
    """Return the model of a plate with the depth of what each pixel sees.

    Raises :class:`AmiwarpError` for another optic, or if the map does not have the camera's size.
    """
    if not isinstance(model, PlateModel):
        raise AmiwarpError(
            f"a depth map is for a rotating tilted plate, but a {model.MOVER} moves this image, and near and far "
            "points alike; leave the depth map out"
        )
    return model.with_depths(depth.filled())


def _counted(
    source: EventSource, compensator: BlockCompensator | None, count: Callable[[Events, NDArray[np.uint8]], None]
) -> Generator[Events, None, None]:
    """Yield the compensated events, which threads compute ahead, and count them when they are written."""
    if compensator is None:
        return
    with contextlib.closing(in_order(compensated_pieces(source, compensator))) as pieces:
        for events, inside, _ in pieces:
            yield events
            count(events, inside)


def compensated_pieces(source: EventSource, compensator: BlockCompensator) -> Iterator[Callable[[], FlaggedEvents]]:
    """Yield functions that return the compensated events of each piece, as :meth:`RecordingWriter.fill` takes them.

    Threads may call them in parallel; pieces of native files are then read in parallel too, and their times and
    polarities are not encoded again.
    """
    if isinstance(source, NativeEvents):
        for start in range(0, len(source), PIECE):
            yield partial(_compensate_stored, source, start, compensator)
    else:
        for events in source.blocks(count=PIECE):
            yield partial(_compensate_piece, events, compensator)


def _compensate_stored(source: NativeEvents, start: int, compensator: BlockCompensator) -> FlaggedEvents:
    return *compensator(source.slice(start, start + PIECE)), source.encoded_times_and_polarities(start, start + PIECE)


def _compensate_piece(events: Events, compensator: BlockCompensator) -> FlaggedEvents:
    return *compensator(events), {}


def check_size(fitted: Calibration | Model, size: tuple[int, int], name: str, *, what: str = "calibration") -> None:
    """Raise :class:`AmiwarpError` if a calibration or model belongs to another sensor size than ``size`` [px]."""
    width, height = fitted.camera.width, fitted.camera.height
    if size != (width, height):
        raise AmiwarpError(
            f"{name}: its sensor is {size[0]}x{size[1]}, the {what} is for {width}x{height}; calibrate this camera"
        )
