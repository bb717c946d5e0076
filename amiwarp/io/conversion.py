"""Any recording into a native one, with its encoder, camera and prism put in."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.events.encoder import Encoder
from amiwarp.events.events import EventSource
from amiwarp.io.formats import open_recording
from amiwarp.io.native_writer import RecordingWriter, copy_events
from amiwarp.optics.camera import Camera
from amiwarp.progress import Progress

if TYPE_CHECKING:
    from amiwarp.optics.prism import NominalPrism

GAP_INTERVALS = 5
"""Neighbouring encoder samples more than so many median intervals apart are reported as a gap."""


@dataclass(frozen=True, slots=True)
class ConversionSummary:
    """What a conversion did."""

    events: int
    """Events written."""
    t_first: int | None
    """Time of the first event [us], None without events."""
    t_last: int | None
    """Time of the last event [us], None without events."""
    width: int
    """Sensor's width [px]."""
    height: int
    """Sensor's height [px]."""
    repairs: dict[str, int]
    """Counts of what was repaired or noticed while reading."""
    encoder_covers: bool | None
    """Whether the encoder has an angle for every event; None without an encoder."""
    encoder_gaps: tuple[tuple[int, int], ...]
    """Pairs of sample times [us] between which encoder samples are missing."""
    index_slip: float | None
    """Largest angle at an index pulse [rad]; None without pulses. More than a count tells of lost counts."""


def convert(
    source_path: str | os.PathLike[str],
    out_path: str | os.PathLike[str],
    *,
    encoder: Encoder | None = None,
    camera: Camera | None = None,
    prism: NominalPrism | None = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> ConversionSummary:
    """Convert a recording to the native format in constant memory; what is given replaces what the file holds.

    Where the file does not tell the sensor's size, the camera's is taken. Raises :class:`AmiwarpError` for what cannot
    be read or written, for an output that is the input, and for one that exists unless ``overwrite``; nothing is left
    behind then.
    """
    recording = open_recording(source_path)
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
