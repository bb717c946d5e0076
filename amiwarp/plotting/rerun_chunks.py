"""Frames for the viewer Rerun: chunks of columns, which a file holds and a viewer receives."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.errors import AmiwarpError, ErrorCode, optional_module
from amiwarp.io.output_formats import Outline
from amiwarp.plotting.frames import Window, degrees_in_turn, points

TIMELINE = "sensor_time"
"""Timeline of Rerun, in the sensor's time."""


def rerun_module() -> Any:
    """Import Rerun. Raises :class:`AmiwarpError` if it is missing."""
    reason = "Rerun needs its library"
    optional_module(
        "rerun.chunk", "rerun", reason
    )  # is not imported with rerun; older versions lack it
    return optional_module("rerun", "rerun", reason)


def rerun_chunks(window: Window) -> Iterator[Any]:
    """Yield the content of a window for Rerun: images and point clouds of the frames, and angles [deg]."""
    rerun = rerun_module()

    def chunk(entity: str, t: Any, columns: Any) -> Any:
        times = rerun.TimeColumn(TIMELINE, duration=np.asarray(t, "timedelta64[us]"))
        return rerun.chunk.Chunk.from_columns(entity, [times], columns)

    for name, frame in window.frames.items():
        image = rerun.EncodedImage.columns(blob=[frame.png], media_type=["image/png"])
        yield chunk(f"/{name}/image", [window.t], image)
        positions, colours = points(window, frame.events)
        cloud = rerun.Points3D.columns(positions=positions, colors=colours)
        yield chunk(f"/{name}/points", [window.t], cloud.partition([len(positions)]))
    for name, (t, angle) in window.angles.items():
        if len(t):
            yield chunk(f"/prism/{name}", t, rerun.Scalars.columns(scalars=degrees_in_turn(angle)))


def write_rerun(part: Path, content: Iterable[Window], about: Outline) -> None:
    """Write windows to a file for Rerun."""
    rerun = rerun_module()
    failed: list[BaseException] = []

    def chunks() -> Iterator[Any]:
        try:
            for window in content:
                yield from rerun_chunks(window)
        except BaseException as error:  # Rerun raises its own error instead
            failed.append(error)
            raise

    try:
        stream = rerun.chunk.LazyChunkStream.from_iter(chunks())
        # Rerun joins recordings with the same id.
        recording_id = f"{about.path.stem}-{uuid.uuid4().hex[:8]}"
        stream.write_rrd(part, application_id="amiwarp", recording_id=recording_id)
    except RuntimeError as error:
        if failed:
            raise failed[0] from error
        raise AmiwarpError(
            f"{about.path}: Rerun cannot write it: {error}; choose a place with room that you may write to",
            ErrorCode.OUTPUT_FAILED,
        ) from error
