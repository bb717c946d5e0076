"""Writing of recordings in formats other than the native one, conversion, and export of ground truth."""

from __future__ import annotations

import contextlib
import io
import itertools
import os
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import SENSOR_DTYPE, Events, EventSource, Recording, check_coordinates
from amiwarp.events.truth import FrameStore, Poses, PoseStore
from amiwarp.io import formats
from amiwarp.io.file_scan import ASSUMED, ASSUMED_SIZE, RECORDS, FileEvents, assumed_texts
from amiwarp.io.files import NewFile, check_output, errors_name
from amiwarp.io.formats import LIMITS, Bag, Codec, Outline, OutputFormat, Rounding, open_recording
from amiwarp.io.native_format import write_recording
from amiwarp.io.plain_files import write_array
from amiwarp.io.text_size import TextSize, may_replace_size, size_file, write_size
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import NominalPrism
from amiwarp.tasks import Progress
from amiwarp.validation import guarded, instance, shown, whole

# Writing of events in formats other than the native one, in constant memory and completely or not at all.

Writer: TypeAlias = Callable[[Path, Iterable[Events], Outline], None]
"""Function that writes all events into a new file."""


def export(
    source: EventSource,
    path: str | os.PathLike[str],
    chosen: OutputFormat,
    size: tuple[int, int],
    *,
    codec: Codec,
    progress: Progress | None,
    overwrite: bool,
    blocks: Iterable[Events] | None = None,
    rounding: Rounding | None = None,
    seed: int = 0,
    bag: Bag | None = None,
) -> int:
    """Write the events of a source, and return how many were dropped because they are outside the image.

    ``blocks`` are written instead of the source's events: the same events with other coordinates. ``rounding`` and
    ``seed`` apply to compensated events. Text has its size in a second file, :func:`size_file`. Raises
    :class:`AmiwarpError` for events that the format cannot hold.
    """
    path, limits = Path(path), LIMITS[chosen]
    ends = (source.t_first, source.t_last) if len(source) else (0, 0)
    outline = Outline(path, *size, *ends, codec, bag)
    check_limits(outline, limits)
    pixels = Pixels(limits, size, rounding, seed)
    write: Writer = formats.io_function(formats.WRITERS[chosen])
    foreign: list[Exception] = []
    written = _written(source.blocks() if blocks is None else blocks, pixels, outline, len(source), progress, foreign)
    with contextlib.ExitStack() as files:  # both files appear at the end, or neither
        new = files.enter_context(NewFile(path, overwrite=overwrite))
        beside = None
        if limits.text_unit is not None:
            beside = files.enter_context(NewFile(size_file(path), overwrite=may_replace_size(path) or overwrite))
        try:
            write(new.part, written, outline)
            if beside is not None and limits.text_unit is not None:
                write_size(beside.part, new.part, TextSize(size, limits.text_unit, pixels.fractional))
        except BaseException as error:
            if error in foreign:
                raise
            with errors_name(path, lambda: f"writing {limits.label}"):
                raise
    return pixels.dropped


def check_limits(about: Outline, limits: formats.Limits) -> None:
    """Raise :class:`AmiwarpError` if the size or the times lie beyond what a format can hold."""
    remedy = "write a native recording (.h5)"
    if max(about.width, about.height) > limits.side:
        largest = f"{limits.side}x{limits.side}"
        raise AmiwarpError(
            f"{about.path}: the sensor is {about.width}x{about.height}, {limits.label} holds up to {largest}; {remedy}"
        )
    span = about.t_last - about.t_first
    for held, t in ((limits.t_first <= about.t_first, about.t_first), (about.t_last <= limits.t_last, about.t_last)):
        if not held:
            allowed = f"{limits.t_first} .. {limits.t_last} us"
            raise AmiwarpError(f"{about.path}: an event is at {t} us, {limits.label} holds {allowed}; {remedy}")
    if span > limits.span:
        raise AmiwarpError(
            f"{about.path}: the events span {span} us, {limits.label} holds up to {limits.span} us; {remedy}"
        )


def _written(
    blocks: Iterable[Events],
    pixels: Pixels,
    about: Outline,
    count: int,
    progress: Progress | None,
    foreign: list[Exception],
) -> Iterator[Events]:
    """Yield the events as the format holds them, in blocks of at least one. ``count`` is the number of all events.

    An exception that is not amiwarp's, of a caller's function or source, is noted in ``foreign``.
    """
    done = 0
    try:
        for block in blocks:
            events = pixels(block)
            if len(events):
                if events.whole_pixels:
                    check_coordinates(events, about.width, about.height, where=str(about.path), first_index=done)
                yield events
            done += len(block)
            if progress is not None:
                progress("writing events", done / count)
    except AmiwarpError:
        raise
    except Exception as error:
        foreign.append(error)
        raise


class Pixels:
    """Conversion of coordinates to those that a format holds.

    Rounded events outside the image, and events without coordinates (NaN), are dropped and counted. Random numbers are
    drawn for each event in turn, so that the result does not depend on the blocks.
    """

    def __init__(self, limits: formats.Limits, size: tuple[int, int], rounding: Rounding | None, seed: int) -> None:
        """Take the limits of the format and the size of the sensor [px]."""
        self._limits, self._size, self._rounding = limits, size, rounding
        self._random = np.random.default_rng(whole(seed, "seed", 0, 2**63 - 1))
        self.dropped = 0
        self.fractional = False
        """Whether events with fractional pixels, which are compensated, were kept so far."""

    def __call__(self, events: Events) -> Events:
        """Return events as the format holds them. Raises :class:`AmiwarpError` if they need rounding, or must not."""
        if events.whole_pixels and self._rounding is None:
            return events
        if events.whole_pixels:
            raise AmiwarpError("events have whole pixels and are not rounded; leave --round (rounding= in Python) out")
        if self._rounding is not None:
            return self._rounded(events, self._rounding)
        if self._limits.fractional:
            self.fractional = True
            return events
        names = " or ".join(Rounding)
        exact = [end for end, one in formats.EXTENSIONS.items() if one in LIMITS and LIMITS[one].fractional]
        raise AmiwarpError(
            f"events are compensated and have fractional pixels, {self._limits.label} holds whole pixels; "
            f"give --round (rounding= in Python) {names}, or write .h5, {', '.join(exact[:-1])} or {exact[-1]}"
        )

    def _rounded(self, events: Events, rounding: Rounding) -> Events:
        """Return the events that are inside the image after rounding."""
        shift = np.full((2, 1), 0.5) if rounding is Rounding.NEAREST else self._random.random((len(events), 2)).T
        with np.errstate(invalid="ignore"):
            places = [np.floor(values + by) for values, by in zip((events.x, events.y), shift, strict=True)]
        inside = np.logical_and.reduce([(at >= 0) & (at < side) for at, side in zip(places, self._size, strict=True)])
        x, y = (at[inside].astype(SENSOR_DTYPE) for at in places)
        self.dropped += len(events) - len(x)
        return Events(x, y, events.t[inside], events.p[inside])


# Conversion of a recording from any format to the native one or to others.

GAP_INTERVALS = 5
"""Number of median sample intervals above which the time between two encoder samples is reported as a gap."""


SOURCE_NAMES = ("source_name", "source_format")
"""Metadata that name the recording that was converted."""


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
        The format to write, if not that of the extension. The layout of DSEC (``"dsec"``) and EVT 2.1 (``"evt21"``)
        need it.
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
    chosen = formats.output_format(out_path, format)
    codec = formats.check_codec(out_path, codec, chosen)
    rounding = formats.check_rounding(out_path, rounding, chosen)
    opened = open_recording(
        source_path, topic=topic, columns=columns, time_unit=time_unit, polarity=polarity, scale_xy=scale_xy, size=size,
        chip=chip, sort=sort,
    )  # fmt: skip
    recording = replace(
        opened, encoder=encoder or opened.encoder, camera=camera or opened.camera, prism=prism or opened.prism
    )
    frame = recording.events.size
    if recording.camera is not None and not getattr(recording.events, "size_is_known", True):
        frame = recording.camera.width, recording.camera.height
        known = {name: value for name, value in recording.metadata.items() if name != ASSUMED_SIZE}
        recording = replace(recording, metadata=known)
    dropped = 0
    if chosen is OutputFormat.NATIVE:
        source = dict(zip(SOURCE_NAMES, (recording.name, recording.metadata["format"]), strict=True))
        metadata = {**source, **{name: value for name, value in recording.metadata.items() if name != "format"}}
        write_recording(
            out_path, replace(recording, metadata=metadata), frame, codec=codec, progress=progress, overwrite=overwrite
        )
    else:
        dropped = export(
            recording.events, out_path, chosen, frame, codec=codec, progress=progress, overwrite=overwrite,
            rounding=rounding, seed=seed, bag=bag_of(recording, chosen),
        )  # fmt: skip
    return _summary(recording, frame, chosen, rounding, dropped)


def _summary(
    recording: Recording, size: tuple[int, int], chosen: OutputFormat, rounding: Rounding | None, dropped: int
) -> ConversionSummary:
    source, encoder = recording.events, recording.encoder
    ends = (source.t_first, source.t_last) if len(source) else None
    slip = np.zeros(0) if encoder is None else encoder.slip()
    return ConversionSummary(
        events=len(source) - dropped,
        t_first=ends[0] if ends else None,
        t_last=ends[1] if ends else None,
        width=size[0],
        height=size[1],
        repairs=dict(getattr(source, "repairs", {})),
        encoder_covers=None if encoder is None else ends is None or encoder.covers(*ends),
        encoder_gaps=() if encoder is None else _gaps(encoder),
        index_slip=float(np.abs(slip).max()) if slip.size else None,
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
    source, about = recording.events, recording.metadata
    if not isinstance(source, FileEvents) or chosen not in BAGS or about.get("format") != BAGS[chosen]:
        return None
    return Bag(source.path, str(about["topic"]))


def left_out(recording: Recording, chosen: OutputFormat) -> tuple[str, ...]:
    """Return what a recording has in addition to its events and a format does not hold."""
    if chosen is OutputFormat.NATIVE:
        return ("triggers",) if recording.metadata.get("triggers") and recording.encoder is None else ()
    known = {"format", *SOURCE_NAMES, *getattr(recording.events, "repairs", {}), "other_topics", "columns"}
    known |= {"time_unit", "time_zone", "rounded_times"}
    known |= {name for name in recording.metadata if name.startswith(ASSUMED)}
    from_bag = str(recording.metadata.get("format")).startswith("rosbag")
    copied = bag_of(recording, chosen) is not None
    if copied:
        known |= {"topic", *RECORDS}
    found = {
        "encoder": recording.encoder is not None,
        "camera": recording.camera is not None,
        "prism": recording.prism is not None,
        "ground truth": recording.truth is not None,
        "IMU samples": recording.imu is not None and not copied,
        "frames": recording.frames is not None and not copied,
        "triggers": bool(recording.metadata.get("triggers")),
        "other topics": bool(recording.metadata.get("other_topics")) and from_bag and not copied,
        "metadata": not set(recording.metadata) <= known,
    }
    return tuple(name for name, left in found.items() if left)


def subtracted_us(source: EventSource, chosen: OutputFormat) -> int:
    """Return what is subtracted from the times of all events [us], so that only the stamps of a ROS 2 bag hold them."""
    return formats.origin_of(source) if chosen is OutputFormat.ROS2 and len(source) else 0


def _gaps(encoder: Encoder) -> tuple[tuple[int, int], ...]:
    return tuple(encoder.gaps(GAP_INTERVALS * float(np.median(np.diff(encoder.t)))))


# Export of ground truth to the formats of public data sets: optical flow for DSEC and MVSEC, poses for TUM.
#
# ``docs/reference/recording-format.md`` describes the conventions.

DSEC_SCALE, DSEC_ZERO = 128.0, 1 << 15
"""Encoding of displacements in DSEC's flow pictures: levels per pixel, and the level of displacement 0."""

POSE_ROWS = 1 << 14
"""Number of poses that are read and written at a time."""


@guarded
def save_flow_dsec(
    folder: str | os.PathLike[str],
    frames: FrameStore,
    *,
    with_prism: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write displacements in the DSEC format: ``forward/000000.png`` ... and ``forward_timestamps.txt``.

    Parameters
    ----------
    folder : str or path-like
        Folder to write to, which is created if necessary.
    frames : FrameStore
        Ground truth of at least two instants.
    with_prism : bool, default False
        Whether to write the displacements that the pixels see through the turning prism.
    overwrite : bool, default False
        Whether existing files may be replaced.
    progress : callable, optional
        Function that is called with the name of the present step and the finished fraction.

    Returns
    -------
    int
        Number of written pictures: one per interval between two instants.

    Raises
    ------
    AmiwarpError
        If there are fewer than two instants, or a file cannot be written.

    Notes
    -----
    A picture has three channels of 16 bits: x and y displacement, each times 128 plus 2¹⁵, and 1 for known pixels.
    Displacements of 256 px and more do not fit into the format and count as unknown. ``occlusion/000000.png`` ... hold
    :attr:`FrameTruth.occlusion` of the same intervals, with 8 bits.

    Examples
    --------
    >>> square = amiwarp.Mesh([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> scene = amiwarp.WorldScene(
    ...     amiwarp.World("example", (amiwarp.Body("wall", square),)),
    ...     amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0]))
    >>> recording = amiwarp.simulate(
    ...     scene, amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.01), duration_s=0.01, truth_hz=200)
    >>> amiwarp.save_flow_dsec("flow", recording.truth.frames)
    2
    """
    from PIL import Image

    intervals = _intervals(frames)
    folder = Path(folder)
    formats.make_folder(folder / "forward")
    formats.make_folder(folder / "occlusion")
    with contextlib.ExitStack() as files:  # either all files appear at the end, or no file
        lines = ["# from_timestamp_us, to_timestamp_us"]
        for index, (start, stop) in enumerate(intervals):
            moved, occlusion = _displacement(frames, index, with_prism=with_prism)
            new = files.enter_context(NewFile(folder / "forward" / f"{index:06d}.png", overwrite=overwrite))
            new.part.write_bytes(encode_png16(dsec_picture(moved)))
            new = files.enter_context(NewFile(folder / "occlusion" / f"{index:06d}.png", overwrite=overwrite))
            buffer = io.BytesIO()  # Pillow may not notice a full disk
            Image.fromarray(occlusion).save(buffer, format="PNG")
            new.part.write_bytes(buffer.getbuffer())
            lines.append(f"{start}, {stop}")
            if progress is not None:
                progress("writing flow", (index + 1) / len(intervals))
        new = files.enter_context(NewFile(folder / "forward_timestamps.txt", overwrite=overwrite))
        new.part.write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")
    return len(intervals)


@guarded
def save_flow_mvsec(
    path: str | os.PathLike[str],
    frames: FrameStore,
    *,
    with_prism: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write displacements in the MVSEC format: ``timestamps``, ``x_flow_dist``, ``y_flow_dist`` in a .npz file.

    Parameters
    ----------
    path : str or path-like
        File to write, with the suffix .npz.
    frames : FrameStore
        Ground truth of at least two instants.
    with_prism : bool, default False
        Whether to write the displacements that the pixels see through the turning prism.
    overwrite : bool, default False
        Whether an existing file may be replaced.
    progress : callable, optional
        Function that is called with the name of the present step and the finished fraction.

    Returns
    -------
    int
        Number of written flow maps: one per instant.

    Raises
    ------
    AmiwarpError
        If there are fewer than two instants, or the file cannot be written.

    Notes
    -----
    ``timestamps`` are in seconds, shape (k,). The flow maps have shape (k, height, width) and hold displacements [px]
    from an instant to the next. Unknown pixels, and all of the last instant, hold 0, which evaluations on MVSEC ignore.
    The array ``occlusion`` holds :attr:`FrameTruth.occlusion`.

    Examples
    --------
    >>> square = amiwarp.Mesh([[-1, 2, -1], [1, 2, -1], [1, 2, 1], [-1, 2, 1]], [[0, 1, 2], [0, 2, 3]])
    >>> scene = amiwarp.WorldScene(
    ...     amiwarp.World("example", (amiwarp.Body("wall", square),)),
    ...     amiwarp.Trajectory.still([0, 0, 0], look_at=[0, 1, 0]))
    >>> recording = amiwarp.simulate(
    ...     scene, amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.01), duration_s=0.01, truth_hz=200)
    >>> amiwarp.save_flow_mvsec("gt_flow_dist.npz", recording.truth.frames)
    3
    """
    path = Path(path)
    formats.check_ending(path, "the flow of MVSEC is written", [".npz"])
    intervals = _intervals(frames)
    count = len(intervals) + 1
    with NewFile(path, overwrite=overwrite) as new, zipfile.ZipFile(new.part, "w", zipfile.ZIP_DEFLATED) as archive:
        seconds = np.asarray(frames.t, np.float64) * 1e-6
        write_array(archive, "timestamps", seconds.shape, "<f8", [seconds.astype("<f8").tobytes()])
        height, width = frames[0].depth.shape
        for axis, name in enumerate(("x_flow_dist", "y_flow_dist")):

            def maps(axis: int = axis) -> Iterator[bytes]:
                for index in range(count):
                    moved, _ = _displacement(frames, index, with_prism=with_prism)
                    known = np.isfinite(moved).all(axis=2)
                    yield np.where(known, moved[..., axis], 0.0).astype("<f4").tobytes()
                    if progress is not None:
                        progress("writing flow", (axis + (index + 1) / count) / 2.0)

            write_array(archive, name, (count, height, width), "<f4", maps())
        found = (_displacement(frames, index, with_prism=with_prism)[1] for index in range(count))
        write_array(archive, "occlusion", (count, height, width), "|u1", (part.tobytes() for part in found))
    return count


@guarded
def save_poses_tum(
    path: str | os.PathLike[str], poses: PoseStore, *, body: str | None = None, overwrite: bool = False
) -> None:
    """Write poses to a TUM file: lines of ``timestamp tx ty tz qx qy qz qw``.

    Parameters
    ----------
    path : str or path-like
        File to write, with the suffix .txt or .tum.
    poses : PoseStore
        Poses of the camera and of moving bodies.
    body : str, optional
        Name of the body whose poses are written. By default, the poses of the camera are written.
    overwrite : bool, default False
        Whether an existing file may be replaced.

    Raises
    ------
    AmiwarpError
        If no poses of this body are stored, or the file cannot be written.

    Examples
    --------
    >>> import numpy as np
    >>> poses = amiwarp.Poses(t=np.array([0, 1000]), camera=np.tile([0.0, 0, 0, 0, 0, 0, 1], (2, 1)))
    >>> amiwarp.save_poses_tum("camera.txt", poses)
    >>> amiwarp.Trajectory.from_file("camera.txt").t.tolist()
    [0.0, 0.001]
    """
    path = Path(path)
    formats.check_ending(path, "poses are written", formats.POSE_ENDINGS)
    given: Any = poses  # an array of numbers can be sliced too
    known = sorted(instance(None if isinstance(given, np.ndarray) else given[:0], Poses, "poses[:0]").bodies)
    if body is not None and not (isinstance(body, str) and body in known):
        raise AmiwarpError(f"body {shown(body)} has no poses; choose among {', '.join(known) or 'none: no body moves'}")
    with NewFile(path, overwrite=overwrite) as new, open(new.part, "w", encoding="ascii", newline="\n") as file:
        file.write("# timestamp tx ty tz qx qy qz qw\n")
        for start in range(0, len(poses), POSE_ROWS):
            block = poses[start : start + POSE_ROWS]
            for t, row in zip(block.t, block.camera if body is None else block.bodies[body], strict=True):
                file.write(f"{int(t) * 1e-6:.6f} " + " ".join(f"{value:.9g}" for value in row) + "\n")


def _intervals(frames: FrameStore) -> list[tuple[int, int]]:
    """Return the intervals between instants [us]; raise :class:`AmiwarpError` if there are fewer than two instants."""
    t = [int(at) for at in frames.t]
    if len(t) < 2:
        raise AmiwarpError(f"flow needs ground truth of two instants, but there are {len(t)}; simulate with --truth-hz")
    return list(itertools.pairwise(t))


def _displacement(frames: FrameStore, index: int, *, with_prism: bool) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the displacement to the next instant [px], shape (height, width, 2), and the occlusion of the points."""
    frame = frames[index]
    if with_prism:
        return frame.displacement_with_prism, frame.occlusion_with_prism
    return frame.displacement, frame.occlusion


def dsec_picture(displacement: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Encode displacements [px], shape (height, width, 2), as a flow picture of DSEC, shape (height, width, 3)."""
    known: NDArray[np.bool_] = np.asarray(np.isfinite(displacement).all(axis=2))
    levels = np.rint(np.where(known[..., None], displacement, 0.0) * DSEC_SCALE) + DSEC_ZERO
    known &= np.asarray(((levels >= 0) & (levels < 1 << 16)).all(axis=2))
    levels = np.where(known[..., None], levels, 0.0)
    return np.concatenate([levels, known[..., None]], axis=2).astype(np.uint16)


def encode_png16(picture: NDArray[np.uint16]) -> bytes:
    """Encode a picture as PNG with three channels of 16 bits, which Pillow cannot write."""
    height, width, _ = picture.shape
    rows = picture.astype(">u2").reshape(height, -1).view(np.uint8)
    lines = np.concatenate([np.zeros((height, 1), np.uint8), rows], axis=1)  # each row begins with PNG filter type 0
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(lines.tobytes(), 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_png_part(kind, data) for kind, data in parts)


def _png_part(kind: bytes, data: bytes) -> bytes:
    """Return a chunk of a PNG file: length, kind, data and checksum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
