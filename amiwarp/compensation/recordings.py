"""Motion compensation of recordings."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.compensation.gpu_pieces import PIECE
from amiwarp.compensation.in_memory import BlockCompensator
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events, EventSource, Recording
from amiwarp.io import RecordingWriter
from amiwarp.io.conversion import bag_of, left_out, subtracted_us
from amiwarp.io.export import export
from amiwarp.io.hdf5.fletcher32 import compile_checksums
from amiwarp.io.native.copying import copy_sensors_and_truth
from amiwarp.io.native.event_writer import FlaggedEvents
from amiwarp.io.native.events import NativeEvents
from amiwarp.io.output_formats import (
    Codec,
    OutputFormat,
    Rounding,
    check_codec,
    check_rounding,
    output_format,
)
from amiwarp.io.outputs import check_output
from amiwarp.optics.models.base import Model
from amiwarp.optics.models.plate import PlateModel
from amiwarp.results.calibration import Calibration
from amiwarp.results.depth_map import DepthMap
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress, in_order


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
        The format to write, if the extension does not give it. The layout of DSEC (``"dsec"``) needs it.
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
    output = output_format(out_path, format)
    codec = check_codec(out_path, codec, output)
    rounding = check_rounding(out_path, rounding, output)
    events = recording.events
    check_size(calibration, events.size, recording.name)
    model = calibration.model if depth is None else at_depths(calibration.model, depth)
    encoder = recording.encoder
    compensator = None
    if len(events):
        if not events[:1].whole_pixels:
            raise AmiwarpError(
                f"{recording.name}: its events are already compensated; give the sensor's events",
                ErrorCode.CONTENT_MISSING,
            )
        encoder = calibration.encoder_for(encoder, events.t_first, events.t_last)
        if encoder is not None:
            compensator = BlockCompensator(model, encoder, events.t_first, events.t_last, device)

    tally = _Tally(len(events), progress, on_block)
    if output is OutputFormat.NATIVE:
        truth = recording.truth
        width, height = events.size
        writer = RecordingWriter(
            out_path,
            width=width,
            height=height,
            camera=model.camera,
            prism=recording.prism,
            encoder=encoder,
            truth_parameters=None if truth is None else truth.parameters,
            truth_labels=None if truth is None else truth.labels,
            metadata={**recording.metadata, "compensated_with": calibration.model_name},
            overwrite=overwrite,
            codec=codec,
        )
        _write_native(writer, recording, compensator, tally)
        missing = _left_out_of_native(recording)
        seconds = time.perf_counter() - began
        return CompensationSummary(tally.done, tally.outside, seconds, left_out=missing)

    with contextlib.closing(_counted(events, compensator, tally)) as blocks:
        dropped = export(
            events,
            out_path,
            output,
            events.size,
            codec=codec,
            progress=None,
            overwrite=overwrite,
            blocks=blocks,
            rounding=rounding,
            seed=seed,
            bag=bag_of(recording, output),
        )
    missing = left_out(recording, output)
    seconds = time.perf_counter() - began
    return CompensationSummary(
        tally.done,
        tally.outside,
        seconds,
        output,
        rounding,
        dropped,
        missing,
        subtracted_us(events, output),
    )


def _write_native(
    writer: RecordingWriter,
    recording: Recording,
    compensator: BlockCompensator | None,
    tally: _Tally,
) -> None:
    """Write the compensated events of a recording, and what else it holds, to a native file.

    ``compensator``: None for a recording without events.
    """
    with writer:
        if compensator is not None:
            compile_checksums()
            pieces = compensated_pieces(recording.events, compensator)
            written = writer.fill(pieces, count=PIECE, t_first=recording.events.t_first)
            with contextlib.closing(written):
                for compensated, inside, _ in written:
                    tally.count(compensated, inside)
        copy_sensors_and_truth(recording, writer)


class _Tally:
    """Counts events when they are written, and reports them."""

    def __init__(
        self, total: int, progress: Progress | None, on_block: Callable[[Events], None] | None
    ) -> None:
        self._total = total
        self._progress = progress
        self._on_block = on_block
        self.done = 0
        """Number of events that were written."""
        self.outside = 0
        """Number of events among them outside the image."""

    def count(self, events: Events, inside: NDArray[np.uint8]) -> None:
        """Count a block of events; ``inside`` is 1 for each event inside the image."""
        self.outside += len(events) - int(np.count_nonzero(inside))
        self.done += len(events)
        if self._on_block is not None:
            self._on_block(events)
        if self._progress is not None:
            self._progress("compensating", self.done / self._total)


def _left_out_of_native(recording: Recording) -> tuple[str, ...]:
    """Return the parts of a recording that a compensated native file does not hold."""
    missing = []
    truth = recording.truth
    if truth is not None:
        of_events = (
            truth.stored_points,
            truth.stored_causes,
            truth.stored_instances,
            truth.stored_depths,
            truth.stored_places,
        )
        if any(values is not None for values in of_events):
            missing.append("ground truth of events")
    if recording.frames is not None:
        missing.append("frames")
    if recording.depth is not None:
        missing.append("depth maps")
    return tuple(missing)


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
    source: EventSource, compensator: BlockCompensator | None, tally: _Tally
) -> Generator[Events, None, None]:
    """Yield the compensated events, which threads compute ahead, and count them when they are written."""
    if compensator is None:
        return
    with contextlib.closing(in_order(compensated_pieces(source, compensator))) as pieces:
        for events, inside, _ in pieces:
            yield events
            tally.count(events, inside)


def compensated_pieces(
    source: EventSource, compensator: BlockCompensator
) -> Iterator[Callable[[], FlaggedEvents]]:
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


def _compensate_stored(
    source: NativeEvents, start: int, compensator: BlockCompensator
) -> FlaggedEvents:
    """Return a compensated piece of a native file, with its times and polarities as they are encoded there."""
    stop = start + PIECE
    events, inside = compensator(source.slice(start, stop))
    return events, inside, source.encoded_times_and_polarities(start, stop)


def _compensate_piece(events: Events, compensator: BlockCompensator) -> FlaggedEvents:
    """Return a compensated piece of events, whose times and polarities the writer encodes."""
    compensated, inside = compensator(events)
    return compensated, inside, {}


def check_size(
    fitted: Calibration | Model, size: tuple[int, int], name: str, *, what: str = "calibration"
) -> None:
    """Raise :class:`AmiwarpError` if a calibration or model belongs to another sensor size than ``size`` [px]."""
    width = fitted.camera.width
    height = fitted.camera.height
    if size != (width, height):
        raise AmiwarpError(
            f"{name}: its sensor is {size[0]}x{size[1]}, the {what} is for {width}x{height}; calibrate this camera"
        )
