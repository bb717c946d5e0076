"""Copy of a recording into a native file."""

from __future__ import annotations

import os

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.events.other_sensors import ImageStore
from amiwarp.events.recording import Recording, inside_image
from amiwarp.io.native.layout import FLAGS
from amiwarp.io.native.writer import RecordingWriter
from amiwarp.io.output_formats import Codec
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress

POSE_BLOCK = 1 << 16
"""Number of poses that are copied at a time."""


def write_recording(
    path: str | os.PathLike[str],
    recording: Recording,
    size: tuple[int, int],
    *,
    codec: Codec = Codec.BLOSC,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> None:
    """Write a recording to a native file.

    ``size`` is the size of the output's image [px], which a scale may have changed.
    """
    truth = recording.truth
    with RecordingWriter(
        path,
        width=size[0],
        height=size[1],
        camera=recording.camera,
        prism=recording.prism,
        encoder=recording.encoder,
        metadata=recording.metadata,
        overwrite=overwrite,
        codec=codec,
        truth_parameters=None if truth is None else truth.parameters,
        truth_labels=None if truth is None else truth.labels,
    ) as writer:
        copy_recording(recording, writer, size, progress)


def copy_recording(
    recording: Recording, writer: RecordingWriter, size: tuple[int, int], progress: Progress | None
) -> None:
    """Append the events of a recording to a writer, and all records beside them.

    ``size``: size of the output's image [px].
    """
    _copy_events(recording, writer, size, progress)
    copy_sensors_and_truth(recording, writer)
    copy_frames(recording.frames, recording.depth, writer)


def _copy_events(
    recording: Recording, writer: RecordingWriter, size: tuple[int, int], progress: Progress | None
) -> None:
    """Append all events of a recording to a writer, with their ground truth and flags.

    ``size`` is the size of the image [px]. If a source of compensated events has no flags, they follow from it.
    """
    source = recording.events
    truth = recording.truth
    flags_of = {name: getattr(source, name, None) for name in FLAGS}
    start = 0
    for block in source.blocks():
        stop = start + len(block)
        truth_of_block = None if truth is None else truth.of_events(start, stop)
        flags = {
            name: None if flags_between is None else flags_between(start, stop)
            for name, flags_between in flags_of.items()
        }
        if flags["inside"] is None and not block.whole_pixels:
            flags["inside"] = inside_image(block.x, block.y, *size)
        writer.append(block, truth=truth_of_block, **flags)
        start = stop
        if progress is not None:
            progress("writing events", start / len(source))


def copy_sensors_and_truth(recording: Recording, writer: RecordingWriter) -> None:
    """Append to a writer a recording's IMU samples, ground truth of instants, masks of known pixels, and poses."""
    truth = recording.truth
    if recording.imu is not None:
        writer.append_imu(recording.imu)
    if truth is None:
        return
    if truth.known is not None:
        for index, t in enumerate(truth.known.t.tolist()):
            writer.append_known(t, truth.known[index])
    if truth.frames is not None:
        for index in range(len(truth.frames.t)):
            writer.append_frame(truth.frames[index])
    if truth.poses is not None:
        for start in range(0, len(truth.poses), POSE_BLOCK):
            writer.append_poses(truth.poses[start : start + POSE_BLOCK])


def copy_frames(
    frames: ImageStore | None, depth: ImageStore | None, writer: RecordingWriter
) -> None:
    """Append frames and depth maps to a writer.

    Raises :class:`AmiwarpError` if both are given with other times, because a file has one time for both.
    """
    given = [store for store in (frames, depth) if store is not None]
    if not given:
        return
    first = given[0]
    if not all(np.array_equal(first.t, store.t) for store in given):
        raise AmiwarpError(
            f"{writer.path}: frames and depth maps have other times; save them as two recordings of a rig"
        )
    for index, t in enumerate(first.t.tolist()):
        exposure_us = None
        if first.exposure is not None:
            begin, end = first.exposure[index].tolist()
            exposure_us = begin, end
        writer.append_image(
            t,
            None if frames is None else frames[index],
            exposure_us=exposure_us,
            depth=None if depth is None else depth[index],
        )


@guarded
def save_recording(
    path: str | os.PathLike[str], recording: Recording, *, overwrite: bool = False
) -> None:
    """Write a recording to a native HDF5 file.

    Parameters
    ----------
    path : str or path-like
        The file to write, which ends in ``.h5`` or ``.hdf5``. :func:`convert` writes other formats.
    recording : Recording
        The recording.
    overwrite : bool, default False
        Whether an existing file may be replaced.

    Raises
    ------
    AmiwarpError
        If the path has another extension, cannot be written, is being read, or exists without ``overwrite``.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4))
    >>> amiwarp.save_recording("short.h5", recording)
    """
    write_recording(path, recording, recording.events.size, overwrite=overwrite)
