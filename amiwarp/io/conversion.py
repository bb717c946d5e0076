"""Conversion of a recording from any format to the native one or to others."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from amiwarp.events.encoder import GAP_INTERVALS, Encoder
from amiwarp.events.recording import EventSource, MetadataValue, Recording
from amiwarp.io.assumptions import ASSUMED, ASSUMED_SIZE, assumed_texts
from amiwarp.io.export import export
from amiwarp.io.file_scan import RECORDS, FileEvents
from amiwarp.io.formats import open_recording
from amiwarp.io.native.copying import write_recording
from amiwarp.io.output_formats import (
    Bag,
    Codec,
    OutputFormat,
    Rounding,
    check_codec,
    check_rounding,
    origin_of,
    output_format,
)
from amiwarp.io.outputs import check_output
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress

OF_INPUT = (
    "format",
    "source_name",
    "source_format",
    "other_topics",
    "columns",
    "time_unit",
    "time_zone",
    "rounded_times",
)
"""Metadata that describe the file that was read."""


@guarded
@dataclass(frozen=True, slots=True)
class ConversionSummary:
    """Summary of the conversion of a recording.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> amiwarp.save_recording("in.h5", amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4)))
    >>> summary = amiwarp.convert("in.h5", "out.h5")
    >>> summary.events, summary.width, summary.encoder_covers
    (2, 4, None)
    """

    events: int
    """Number of events that were written."""
    t_first: int | None
    """Time of the first event [us], or None without events."""
    t_last: int | None
    """Time of the last event [us], or None without events."""
    width: int
    """Width of the sensor [px]."""
    height: int
    """Height of the sensor [px]."""
    repairs: dict[str, int]
    """Number of repairs and other findings while reading, by name of the finding."""
    encoder_covers: bool | None
    """Whether the encoder has an angle for every event, or None without an encoder."""
    encoder_gaps: tuple[tuple[int, int], ...]
    """Gaps in the encoder samples: the times of the samples before and after each gap [us]."""
    index_slip: float | None
    """Largest angle error at an index pulse [rad], or None without pulses. A value above one count means that counts
    were lost."""
    format: OutputFormat
    """Format that was written."""
    left_out: tuple[str, ...]
    """Parts of the recording that the format does not hold, such as ``"encoder"``. Empty for the native format."""
    rounding: Rounding | None = None
    """How coordinates were rounded to whole pixels, or None if they were not."""
    dropped: int = 0
    """Number of events that were not written, because after rounding they are outside the image."""
    assumptions: tuple[str, ...] = ()
    """What was assumed, because the input does not state it, with the option that overrides it."""
    subtracted_us: int = 0
    """Time that was subtracted from all events [us]: in a ROS 2 bag the first event, if the last is later than 28 h."""


@guarded
def convert(
    source_path: str | os.PathLike[str],
    out_path: str | os.PathLike[str],
    *,
    encoder: Encoder | None = None,
    camera: Camera | None = None,
    prism: NominalPrism | None = None,
    topic: str | None = None,
    columns: str | None = None,
    time_unit: str | None = None,
    polarity: str | None = None,
    scale_xy: int | None = None,
    size: tuple[int, int] | None = None,
    chip: str | None = None,
    sort: bool = False,
    progress: Progress | None = None,
    overwrite: bool = False,
    format: OutputFormat | str | None = None,
    codec: Codec | str = Codec.BLOSC,
    rounding: Rounding | str | None = None,
    seed: int = 0,
) -> ConversionSummary:
    """Convert a recording to the native format or to another one, in constant memory.

    Only the native format holds the encoder, the camera, the prism, the ground truth, the IMU samples, the frames and
    the metadata. All formats keep x, y, t and p of every event exactly, with three exceptions. Of compensated events,
    text and csv hold the coordinates to 1e-6 px, and formats of whole pixels need ``rounding``. In a ROS 2 bag the
    times begin at 0 if the last is later than 28 h, as are times since 1970: only the stamps of its messages hold
    those, and the summary's ``subtracted_us``. From a bag to a bag of the same version of ROS, the messages of all
    other topics are copied. The sensor size of text and csv is in a second file, such as ``OUT.txt.json``.

    Parameters
    ----------
    source_path : str or path-like
        The recording to read, in any format of :class:`Format`.
    out_path : str or path-like
        The file to write. Its extension gives the format, see :class:`OutputFormat`.
    encoder : Encoder, optional
        Replaces the encoder of the file.
    camera : Camera, optional
        Replaces the camera of the file. Gives the sensor size if the file does not store it.
    prism : Prism or UnsizedPrism, optional
        Replaces the nominal prism of the file.
    topic : str, optional
        The topic or camera to read, if the input holds several, see :func:`open_recording`.
    columns, time_unit, polarity : str, optional
        Layout of the input, see :func:`open_recording`.
    scale_xy : int, optional
        Number by which x and y of the input are divided, see :func:`open_recording`.
    size : tuple of int, optional
        Sensor size (width, height) [px]. It replaces the size in the input.
    chip : str, optional
        Name of the camera's chip, see :func:`open_recording`.
    sort : bool, default False
        Whether to sort the events by time, see :func:`open_recording`.
    progress : callable, optional
        Called with the name of the step and the finished fraction of the task, 0 to 1.
    overwrite : bool, default False
        Whether an existing output may be replaced.
    format : OutputFormat or str, optional
        The format to write; by default, the format of the extension. The layout of DSEC (``"dsec"``) and EVT 2.1
        (``"evt21"``) need it.
    codec : Codec or str, default "blosc"
        Compression of HDF5. Programs without HDF5's Blosc filter read ``"gzip"``.
    rounding : Rounding or str, optional
        How to round the coordinates of compensated events to whole pixels. Events outside the image after that are
        dropped and counted.
    seed : int, default 0
        Seed of the random numbers of ``"dithered"``. The same events and seed give the same result.

    Returns
    -------
    ConversionSummary
        What was converted.

    Raises
    ------
    AmiwarpError
        If the input cannot be read or the output cannot be written, if both are the same file, if the output exists
        without ``overwrite``, or if the format cannot hold the events. Then no output remains.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> amiwarp.save_recording("in.h5", amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4)))
    >>> amiwarp.convert("in.h5", "out.h5", prism=amiwarp.Prism(apex=0.03)).events
    2
    >>> amiwarp.convert("out.h5", "out.aedat4").left_out
    ('prism',)

    Compensated events get whole pixels for programs that need them:

    >>> moved = amiwarp.Events.from_arrays(x=[1.3, 2.9], y=[0.0, 0.2], t=[0, 10], p=[1, 0])
    >>> amiwarp.save_recording("moved.h5", amiwarp.Recording(amiwarp.MemoryEvents(moved, width=4, height=4)))
    >>> amiwarp.convert("moved.h5", "moved.raw", rounding="nearest").events
    2
    """
    out_path = Path(out_path)
    check_output(out_path, overwrite=overwrite)
    chosen = output_format(out_path, format)
    codec = check_codec(out_path, codec, chosen)
    rounding = check_rounding(out_path, rounding, chosen)
    opened = open_recording(
        source_path,
        topic=topic,
        columns=columns,
        time_unit=time_unit,
        polarity=polarity,
        scale_xy=scale_xy,
        size=size,
        chip=chip,
        sort=sort,
    )
    recording = replace(
        opened,
        encoder=encoder or opened.encoder,
        camera=camera or opened.camera,
        prism=prism or opened.prism,
    )
    size_of_image = recording.events.size
    if recording.camera is not None and not getattr(recording.events, "size_is_known", True):
        # The camera states the size. Nothing is assumed any more.
        size_of_image = recording.camera.width, recording.camera.height
        stated = {name: value for name, value in recording.metadata.items() if name != ASSUMED_SIZE}
        recording = replace(recording, metadata=stated)

    dropped = 0
    if chosen is OutputFormat.NATIVE:
        write_recording(
            out_path,
            replace(recording, metadata=_metadata_with_source(recording)),
            size_of_image,
            codec=codec,
            progress=progress,
            overwrite=overwrite,
        )
    else:
        dropped = export(
            recording.events,
            out_path,
            chosen,
            size_of_image,
            codec=codec,
            progress=progress,
            overwrite=overwrite,
            rounding=rounding,
            seed=seed,
            bag=bag_of(recording, chosen),
        )
    return _summary(recording, size_of_image, chosen, rounding, dropped)


def _metadata_with_source(recording: Recording) -> dict[str, MetadataValue]:
    """Return the metadata of a recording with the name and the format of its source."""
    # The metadata of an earlier conversion win: they name the original.
    others = {name: value for name, value in recording.metadata.items() if name != "format"}
    return {
        "source_name": recording.name,
        "source_format": recording.metadata["format"],
        **others,
    }


def _summary(
    recording: Recording,
    size: tuple[int, int],
    chosen: OutputFormat,
    rounding: Rounding | None,
    dropped: int,
) -> ConversionSummary:
    source = recording.events
    t_first = t_last = None
    if len(source):
        t_first = source.t_first
        t_last = source.t_last

    encoder = recording.encoder
    encoder_covers = None
    encoder_gaps: tuple[tuple[int, int], ...] = ()
    index_slip = None
    if encoder is not None:
        encoder_covers = t_first is None or t_last is None or encoder.covers(t_first, t_last)
        usual_us = float(np.median(np.diff(encoder.t)))
        encoder_gaps = tuple(encoder.gaps(GAP_INTERVALS * usual_us))
        slip = encoder.slip()
        if slip.size:
            index_slip = float(np.abs(slip).max())

    return ConversionSummary(
        events=len(source) - dropped,
        t_first=t_first,
        t_last=t_last,
        width=size[0],
        height=size[1],
        repairs=dict(getattr(source, "repairs", {})),
        encoder_covers=encoder_covers,
        encoder_gaps=encoder_gaps,
        index_slip=index_slip,
        format=chosen,
        left_out=left_out(recording, chosen),
        rounding=rounding,
        dropped=dropped,
        subtracted_us=subtracted_us(source, chosen),
        assumptions=tuple(assumed_texts(recording.metadata)),
    )


BAGS = {OutputFormat.ROS1: "rosbag1", OutputFormat.ROS2: "rosbag2"}
"""Format in the metadata of a bag whose other topics a bag of a format takes over."""


def bag_of(recording: Recording, chosen: OutputFormat) -> Bag | None:
    """Return the bag and the topic that a recording is read from, if a bag of the same version of ROS is written."""
    source = recording.events
    if not isinstance(source, FileEvents) or chosen not in BAGS:
        return None
    if recording.metadata.get("format") != BAGS[chosen]:
        return None
    return Bag(source.path, str(recording.metadata["topic"]))


def left_out(recording: Recording, chosen: OutputFormat) -> tuple[str, ...]:
    """Return what a recording has in addition to its events and a format does not hold."""
    about = recording.metadata
    if chosen is OutputFormat.NATIVE:
        # Triggers are held as the encoder that is made of them.
        return ("triggers",) if about.get("triggers") and recording.encoder is None else ()

    # Messages of other topics are copied from bag to bag.
    is_copied = bag_of(recording, chosen) is not None
    is_from_bag = str(about.get("format")).startswith("rosbag")

    # Nothing is lost with metadata that describe the input, or the reading of it.
    of_input = {name for name in about if name in OF_INPUT or name.startswith(ASSUMED)}
    of_input |= set(getattr(recording.events, "repairs", {}))
    if is_copied:
        of_input |= {"topic", *RECORDS}

    is_left_out = {
        "encoder": recording.encoder is not None,
        "camera": recording.camera is not None,
        "prism": recording.prism is not None,
        "ground truth": recording.truth is not None,
        "IMU samples": recording.imu is not None and not is_copied,
        "frames": recording.frames is not None and not is_copied,
        "depth maps": recording.depth is not None,
        "triggers": bool(about.get("triggers")),
        "other topics": bool(about.get("other_topics")) and is_from_bag and not is_copied,
        "metadata": not set(about) <= of_input,
    }
    return tuple(name for name, is_missing in is_left_out.items() if is_missing)


def subtracted_us(source: EventSource, chosen: OutputFormat) -> int:
    """Return what is subtracted from the times of all events [us], so that only the stamps of a ROS 2 bag hold them."""
    if chosen is not OutputFormat.ROS2 or not len(source):
        return 0
    return origin_of(source)
