"""Conversion of a recording of any format to the native one, with its encoder, camera and prism."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events.encoder import Encoder
from amiwarp.events.events import EventSource
from amiwarp.io.copying import copy_events
from amiwarp.io.formats import open_recording
from amiwarp.io.native_writer import RecordingWriter
from amiwarp.optics.camera import Camera
from amiwarp.progress import Progress

if TYPE_CHECKING:
    from amiwarp.optics.prism import NominalPrism

GAP_INTERVALS = 5
"""Number of median sample intervals above which the time between two encoder samples is reported as a gap."""


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


def convert(
    source_path: str | os.PathLike[str],
    out_path: str | os.PathLike[str],
    *,
    encoder: Encoder | None = None,
    camera: Camera | None = None,
    prism: NominalPrism | None = None,
    topic: str | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> ConversionSummary:
    """Convert a recording to the native format, in constant memory.

    Parameters
    ----------
    source_path : str or path-like
        The recording to read, in any format of :class:`Format`.
    out_path : str or path-like
        The native HDF5 file to write.
    encoder : Encoder, optional
        Replaces the encoder of the file.
    camera : Camera, optional
        Replaces the camera of the file. Gives the sensor size if the file does not store it.
    prism : Prism or UnsizedPrism, optional
        Replaces the nominal prism of the file.
    topic : str, optional
        The topic or camera to read, if the input holds several, see :func:`open_recording`.
    progress : callable, optional
        Called with the name of the step and the finished fraction of the task, 0 to 1.
    overwrite : bool, default False
        Whether an existing output may be replaced.

    Returns
    -------
    ConversionSummary
        What was converted.

    Raises
    ------
    AmiwarpError
        If the input cannot be read or the output cannot be written, if both are the same file, or if the output exists
        without ``overwrite``. Then no output remains.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2], y=[0, 0], t=[0, 10], p=[1, 0])
    >>> amiwarp.save_recording("in.h5", amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4)))
    >>> amiwarp.convert("in.h5", "out.h5", prism=amiwarp.Prism(apex=0.03)).events
    2
    """
    recording = open_recording(source_path, topic=topic)
    source = recording.events
    encoder = encoder or recording.encoder
    camera = camera or recording.camera
    width, height = source.size
    if camera is not None and not getattr(source, "size_is_known", True):
        width, height = camera.width, camera.height
    metadata = {name: value for name, value in recording.metadata.items() if name != "format"}
    with RecordingWriter(
        out_path,
        width=width,
        height=height,
        camera=camera,
        prism=prism or recording.prism,
        encoder=encoder,
        truth_parameters=None if recording.truth is None else recording.truth.parameters,
        truth_labels=None if recording.truth is None else recording.truth.labels,
        metadata={"source_name": recording.name, "source_format": recording.metadata["format"], **metadata},
        overwrite=overwrite,
    ) as writer:
        copy_events(recording, writer, progress)
    return _summary(source, (width, height), encoder, dict(getattr(source, "repairs", {})))


def _summary(
    source: EventSource, size: tuple[int, int], encoder: Encoder | None, repairs: dict[str, int]
) -> ConversionSummary:
    ends = (source.t_first, source.t_last) if len(source) else None
    slip = np.zeros(0) if encoder is None else encoder.slip()
    return ConversionSummary(
        events=len(source),
        t_first=ends[0] if ends else None,
        t_last=ends[1] if ends else None,
        width=size[0],
        height=size[1],
        repairs=repairs,
        encoder_covers=None if encoder is None else ends is None or encoder.covers(*ends),
        encoder_gaps=() if encoder is None else _gaps(encoder),
        index_slip=float(np.abs(slip).max()) if slip.size else None,
    )


def _gaps(encoder: Encoder) -> tuple[tuple[int, int], ...]:
    return tuple(encoder.gaps(GAP_INTERVALS * float(np.median(np.diff(encoder.t)))))
