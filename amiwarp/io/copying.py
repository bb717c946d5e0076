"""Copy of a recording into a native file."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from amiwarp.events.checks import inside_image
from amiwarp.io.native_writer import RecordingWriter
from amiwarp.validation import guarded

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording, Truth
    from amiwarp.progress import Progress

POSE_BLOCK = 1 << 16
"""Number of poses that are copied at a time."""


def copy_events(
    recording: Recording, writer: RecordingWriter, size: tuple[int, int], progress: Progress | None = None
) -> None:
    """Append all events of a recording to a writer, with their ground truth and flags, IMU samples and frames.

    ``size`` is that of the image [px]. Flags that a source of compensated events does not have follow from it.
    """
    source, truth = recording.events, recording.truth
    flags = {name: getattr(source, name, None) for name in ("inside", "extrapolated")}
    start = 0
    for block in source.blocks():
        stop = start + len(block)
        known = None if truth is None else truth.of_events(start, stop)
        marks = {name: None if flag is None else flag(start, stop) for name, flag in flags.items()}
        if marks["inside"] is None and not block.whole_pixels:
            marks["inside"] = inside_image(block.x, block.y, *size)
        writer.append(block, truth=known, **marks)
        start = stop
        if progress is not None:
            progress("writing events", start / len(source))
    if truth is not None:
        _copy_world_truth(truth, writer)
    if recording.imu is not None:
        writer.append_imu(recording.imu)
    if recording.frames is not None:
        for index, t in enumerate(recording.frames.t.tolist()):
            writer.append_image(t, recording.frames[index])


def _copy_world_truth(truth: Truth, writer: RecordingWriter) -> None:
    """Append to a writer the ground truth of instants, the masks of known pixels, and the poses."""
    if truth.known is not None:
        for index, t in enumerate(truth.known.t.tolist()):
            writer.append_known(t, truth.known[index])
    if truth.frames is not None:
        for index in range(len(truth.frames.t)):
            writer.append_frame(truth.frames[index])
    if truth.poses is not None:
        for start in range(0, len(truth.poses), POSE_BLOCK):
            writer.append_poses(truth.poses[start : start + POSE_BLOCK])


@guarded
def save_recording(path: str | os.PathLike[str], recording: Recording, *, overwrite: bool = False) -> None:
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
    source = recording.events
    width, height = source.size
    with RecordingWriter(
        path,
        width=width,
        height=height,
        camera=recording.camera,
        prism=recording.prism,
        encoder=recording.encoder,
        truth_parameters=None if recording.truth is None else recording.truth.parameters,
        truth_labels=None if recording.truth is None else recording.truth.labels,
        metadata=recording.metadata,
        overwrite=overwrite,
    ) as writer:
        copy_events(recording, writer, source.size)
