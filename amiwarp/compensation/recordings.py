"""Compensation of recordings: every event moved to where it would be without the prism."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from amiwarp.compensation.launch_plan import Placing
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_encoder import encoder_params
from amiwarp.events.events import Events, check_sensor
from amiwarp.io import RecordingWriter
from amiwarp.io.chunks import CHUNK
from amiwarp.io.native import NativeEvents
from amiwarp.kernels.compensation import Columns
from amiwarp.kernels.launch import launch
from amiwarp.progress import Progress

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.result import Calibration
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import EventSource
    from amiwarp.events.recording import MetadataValue, Recording
    from amiwarp.optics.models import Model

BLOCK = 1 << 20
"""Events of a block where nothing else is asked for."""
PIECE = 2 * CHUNK
"""Events that a thread works on at a time, from the file and back: few, so that they stay in its core's cache."""

"""Called with events done and all."""


@dataclass(frozen=True, slots=True)
class CompensationSummary:
    """What a compensation did."""

    events: int
    outside: int
    """Events kept, and marked, whose place lies outside the image or that have none (NaN)."""
    seconds: float
    """Whole time, reading and writing included."""

    @property
    def mev_per_s(self) -> float:
        """Million events a second."""
        return self.events / max(self.seconds, 1e-9) / 1e6


class Mover:
    """Moves events to where they are without the prism: a model and an encoder on a device, for any thread.

    Raises :class:`AmiwarpError` where the encoder does not cover the times ``t_first`` .. ``t_last`` [us].
    """

    def __init__(self, model: Model, encoder: Encoder, t_first: int, t_last: int, device: Any) -> None:
        self._device = wp.get_device(device)
        self._placing = Placing(model, self._device)
        self._encoder = encoder_params(encoder, t_first, t_last, str(self._device))
        # Warp's CUDA side keeps its books for one thread at a time
        self._alone = contextlib.nullcontext() if self._device.is_cpu else threading.Lock()

    def __call__(self, events: Events, *, all_cores: bool = False) -> tuple[Events, NDArray[np.uint8]]:
        """The events moved (NaN: nowhere), and 1 for each that lies on a pixel of the image, shape ``(n,)``."""
        check_sensor(events)
        if not len(events):
            return Events(np.zeros(0, np.float32), np.zeros(0, np.float32), events.t, events.p), np.zeros(0, np.uint8)
        with self._alone:
            x, y, inside = self._move(events, all_cores)
        return Events(x, y, events.t, events.p), inside

    def _move(self, events: Events, all_cores: bool) -> list[NDArray[Any]]:
        placing, n = self._placing, len(events)
        padded = placing.padded(n)
        c = Columns()
        c.x, c.y = (_on(self._device, values, wp.uint16, padded) for values in (events.x, events.y))
        c.t = _on(self._device, events.t, wp.int64, padded)
        c.out_x, c.out_y = (wp.empty(padded, dtype=float, device=self._device) for _ in range(2))
        c.inside = wp.empty(padded, dtype=wp.uint8, device=self._device)
        inputs = placing.inputs(self._encoder, c, strays=placing.strays(events.x.max(), events.y.max()))
        blocks = padded // placing.block
        if all_cores:
            launch(placing.kernel, blocks, inputs, [], device=self._device, smallest=512)
        else:
            wp.launch(placing.kernel, dim=blocks, inputs=[*inputs, 0], device=self._device)
        return [values.numpy()[:n] for values in (c.out_x, c.out_y, c.inside)]


def _on(device: Any, values: NDArray[Any], dtype: Any, padded: int) -> Any:
    """A column on the device, without a copy on CPUs where that can be."""
    if len(values) < padded:
        values = np.concatenate([values, np.zeros(padded - len(values), values.dtype)])
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device, copy=False)


def compensate_events(events: Events, model: Model, encoder: Encoder, *, device: Any = "cpu") -> NDArray[np.float32]:
    """Places of the events without the prism [px], shape (n, 2); NaN where there is none.

    ``events`` come from a sensor (uint16). Raises :class:`AmiwarpError` where the encoder does not cover them.
    """
    first, last = (int(events.t.min()), int(events.t.max())) if len(events) else encoder.coverage
    moved, _inside = Mover(model, encoder, first, last, device)(events, all_cores=True)
    return np.stack([moved.x, moved.y], axis=1)


def inside_image(xy: NDArray[np.float32], width: int, height: int) -> NDArray[np.bool_]:
    """Which points (n, 2) lie on a pixel of the image; NaN lies on none."""
    x, y = xy[:, 0], xy[:, 1]
    return (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)


def compensated_blocks(
    recording: Recording, model: Model, encoder: Encoder, *, device: Any = "cpu", **blocks: int
) -> Iterator[Events]:
    """The recording's events, compensated, block by block (``count=`` or ``duration_us=``), in order, none dropped."""
    source = recording.events
    if not len(source):
        return
    mover = Mover(model, encoder, source.t_first, source.t_last, device)
    for block in source.blocks(**(blocks or {"count": BLOCK})):
        yield mover(block, all_cores=True)[0]


def compensate(
    recording: Recording,
    calibration: Calibration,
    out_path: str | os.PathLike[str],
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
    on_block: Callable[[Events], None] | None = None,
    overwrite: bool = False,
) -> CompensationSummary:
    """Writes the compensated recording: sub-pixel float32 coordinates; time, polarity and order kept.

    In blocks, in constant memory. Events that leave the image are kept and marked (``events/inside``). ``on_block``
    sees each compensated block. Raises :class:`AmiwarpError` for a camera of another size, an encoder that does not
    cover the events, or an output that cannot be written, is the recording, or exists (unless ``overwrite``); nothing
    is left behind then.
    """
    began = time.perf_counter()
    width, height = recording.events.size
    check_size(calibration, recording.events.size, recording.name)
    n = len(recording.events)
    encoder = recording.encoder
    if n:
        encoder = calibration.encoder_for(encoder, recording.events.t_first, recording.events.t_last)
    outside = done = 0
    metadata: dict[str, MetadataValue] = {**recording.metadata, "compensated_with": calibration.model_name}
    truth = None if recording.truth is None else recording.truth.parameters

    def count(events: Events, inside: NDArray[np.uint8]) -> None:
        nonlocal outside, done
        outside += len(events) - int(np.count_nonzero(inside))
        done += len(events)
        if on_block is not None:
            on_block(events)
        if progress is not None:
            progress("compensating", done / n)

    with RecordingWriter(
        out_path, width=width, height=height, camera=recording.camera or calibration.camera, prism=recording.prism,
        encoder=encoder, truth_parameters=truth, metadata=metadata, overwrite=overwrite,
    ) as writer:  # fmt: skip
        if encoder is not None and n:
            first, last = recording.events.t_first, recording.events.t_last
            mover = Mover(calibration.model, encoder, first, last, device)
            writer.fill(moved_pieces(recording.events, mover), t_first=first, done=count)
    return CompensationSummary(done, outside, time.perf_counter() - began)


def moved_pieces(source: EventSource, mover: Mover) -> Iterator[Callable[[], tuple[Events, NDArray[np.uint8]]]]:
    """The recording, moved, in pieces: threads read them where the file lets them, and move them."""
    if isinstance(source, NativeEvents):
        for read in source.pieces(PIECE):
            yield partial(_read_and_move, read, mover)
    else:
        for events in source.blocks(count=PIECE):
            yield partial(mover, events)


def _read_and_move(read: Callable[[], Events], mover: Mover) -> tuple[Events, NDArray[np.uint8]]:
    return mover(read())


def check_size(calibration: Calibration, size: tuple[int, int], name: str) -> None:
    """Raises :class:`AmiwarpError` where a calibration belongs to a camera of another size than ``name``'s."""
    width, height = calibration.camera.width, calibration.camera.height
    if size != (width, height):
        raise AmiwarpError(
            f"{name}: is {size[0]}x{size[1]}, the calibration is for {width}x{height}; calibrate this camera"
        )
