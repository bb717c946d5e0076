"""Copy of a recording's events into a writer."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from amiwarp.events.recording import Recording
    from amiwarp.io.native_writer import RecordingWriter
    from amiwarp.progress import Progress


def copy_events(recording: Recording, writer: RecordingWriter, progress: Progress | None = None) -> None:
    """Append all events of a recording to a writer, with their true points and flags."""
    source, truth = recording.events, recording.truth
    flags = {name: getattr(source, name, None) for name in ("inside", "extrapolated")}
    start = 0
    for block in source.blocks():
        stop = start + len(block)
        points = None if truth is None else truth.points(start, stop)
        marks = {name: None if flag is None else flag(start, stop) for name, flag in flags.items()}
        writer.append(block, truth_points=points, **marks)
        start = stop
        if progress is not None:
            progress("writing events", start / len(source))
