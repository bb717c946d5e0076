"""Compensation of recordings: every event moved to where it would be without the prism."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events import Events
from amiwarp.io import RecordingWriter
from amiwarp.optics import wrap_angle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.result import Calibration
    from amiwarp.encoder import Encoder
    from amiwarp.events import MetadataValue, Recording
    from amiwarp.optics import Model

BLOCK = 1 << 20
"""Events that are in memory at a time."""

Progress = Callable[[int, int], None]
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


def compensate_events(events: Events, model: Model, encoder: Encoder, *, device: Any = "cpu") -> NDArray[np.float32]:
    """Places of the events without the prism [px], shape (n, 2); NaN where there is none.

    ``events`` come from a sensor (uint16). Raises :class:`AmiwarpError` where the encoder does not cover them.
    """
    import warp as wp

    if events.x.dtype != np.uint16:
        raise AmiwarpError(
            f"event coordinates are {events.x.dtype}, already compensated; give events from a sensor (uint16)"
        )
    xy = np.empty((len(events), 2), dtype=np.float32)
    xy[:, 0], xy[:, 1] = events.x, events.y
    theta = wrap_angle(encoder.angle_at(events.t)).astype(np.float32)
    moved = model.compensate_points(
        wp.array(xy, dtype=wp.vec2, device=device), wp.array(theta, dtype=float, device=device)
    )
    return moved.numpy()


def inside_image(xy: NDArray[np.float32], width: int, height: int) -> NDArray[np.bool_]:
    """Which points (n, 2) lie on a pixel of the image; NaN lies on none."""
    x, y = xy[:, 0], xy[:, 1]
    return (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)


def compensated_blocks(
    recording: Recording, model: Model, encoder: Encoder, *, device: Any = "cpu", **blocks: int
) -> Iterator[Events]:
    """The recording's events, compensated, block by block (``count=`` or ``duration_us=``), in order, none dropped."""
    for block in recording.events.blocks(**(blocks or {"count": BLOCK})):
        xy = compensate_events(block, model, encoder, device=device)
        yield Events(np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1]), block.t, block.p)


def compensate(
    recording: Recording,
    calibration: Calibration,
    out_path: str | os.PathLike[str],
    *,
    device: Any = "cpu",
    progress: Progress | None = None,
    on_block: Callable[[Events], None] | None = None,
) -> CompensationSummary:
    """Writes the compensated recording: sub-pixel float32 coordinates; time, polarity and order kept.

    In blocks, in constant memory. Events that leave the image are kept and marked (``events/inside``). ``on_block``
    sees each compensated block. Raises :class:`AmiwarpError` for a camera of another size, an encoder that does not
    cover the events, or an output that cannot be written; nothing is left behind then.
    """
    began = time.perf_counter()
    width, height = recording.events.size
    check_size(calibration, recording)
    n = len(recording.events)
    encoder = recording.encoder
    if n:
        encoder = calibration.encoder_for(encoder, recording.events.t_first, recording.events.t_last)
    outside = done = 0
    metadata: dict[str, MetadataValue] = {**recording.metadata, "compensated_with": calibration.model_name}
    truth = None if recording.truth is None else recording.truth.parameters
    with RecordingWriter(
        out_path, width=width, height=height, camera=recording.camera or calibration.camera, prism=recording.prism,
        encoder=encoder, truth_parameters=truth, metadata=metadata,
    ) as writer:  # fmt: skip
        for block in compensated_blocks(recording, calibration.model, encoder, device=device) if encoder else ():
            inside = inside_image(np.stack([block.x, block.y], axis=1), width, height)
            writer.append(block, inside=inside)
            outside += int((~inside).sum())
            done += len(block)
            if on_block is not None:
                on_block(block)
            if progress is not None:
                progress(done, n)
    return CompensationSummary(done, outside, time.perf_counter() - began)


def check_size(calibration: Calibration, recording: Recording) -> None:
    """Raises :class:`AmiwarpError` where a calibration belongs to a camera of another size."""
    size = (calibration.camera.width, calibration.camera.height)
    if size != recording.events.size:
        width, height = recording.events.size
        raise AmiwarpError(
            f"{recording.name}: is {width}x{height}, the calibration is for {size[0]}x{size[1]}; calibrate this camera"
        )
