"""Files for the viewers Rerun and Foxglove, with frames as recorded and compensated, and the prism's angle."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from amiwarp.compensation.in_memory import BlockCompensator
from amiwarp.compensation.recordings import check_size
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.io.export import check_limits
from amiwarp.io.inputs import errors_name
from amiwarp.io.output_formats import LIMITS, Codec, Limits, Outline, OutputFormat
from amiwarp.io.outputs import NewFile
from amiwarp.plotting.foxglove_messages import write_foxglove
from amiwarp.plotting.frames import COMPENSATED, FRAME_US, RECORDED, Window, windows
from amiwarp.plotting.rerun_chunks import write_rerun
from amiwarp.results.calibration import Calibration
from amiwarp.tasks import Progress

VIEWERS: dict[str, tuple[Callable[[Path, Iterable[Window], Outline], None], Limits]] = {
    ".rrd": (write_rerun, Limits("a file for Rerun", t_first=-(2**52), t_last=2**52)),
    ".mcap": (write_foxglove, replace(LIMITS[OutputFormat.ROS2], label="a file for Foxglove")),
}
"""Function that writes the file of each viewer, and what it holds, by the extension of the file."""


@dataclass(frozen=True, slots=True)
class ViewerSummary:
    """Content of a file for a viewer."""

    events: int
    """Number of recorded events."""
    frames: int
    """Number of frames of each stream."""
    streams: tuple[str, ...]
    """Names of the streams of frames."""
    angles: int
    """Number of prism angles."""


def save_for_viewer(
    recording: Recording,
    path: Path,
    *,
    calibration: Calibration | None = None,
    frame_us: int = FRAME_US,
    device: Any = "cpu",
    progress: Progress | None = None,
) -> ViewerSummary:
    """Write frames of a recording, and the prism's angle, to a file for Rerun (.rrd) or for Foxglove (.mcap).

    Memory use does not depend on the length of the recording, but on the number of events in a frame.

    Parameters
    ----------
    recording : Recording
        Recording to show.
    path : Path
        File to write.
    calibration : Calibration, optional
        Calibration of the same camera and prism, for frames of the compensated events.
    frame_us : int
        Length of the time window of a frame [us].
    device : str or warp.Device, optional
        Device to compute on.
    progress : Progress, optional
        Called with the finished share.

    Returns
    -------
    ViewerSummary
        Content of the file.

    Raises
    ------
    AmiwarpError
        If a library is missing, the recording has no events, the calibration is for another sensor size, the encoder
        does not cover the events, or the file cannot be written or exists. No partial file remains.
    """
    source = recording.events
    encoder = recording.encoder
    compensate = None
    if not len(source):
        raise AmiwarpError(
            f"{recording.name}: holds no events to show; give a recording with events",
            ErrorCode.CONTENT_MISSING,
        )
    ends = source.t_first, source.t_last
    if calibration is not None:
        check_size(calibration, source.size, recording.name)
        encoder = calibration.encoder_for(encoder, *ends)
        compensate = BlockCompensator(calibration.model, encoder, *ends, device)
    write, limits = VIEWERS[path.suffix.lower()]
    about = Outline(path, *source.size, *ends, Codec.BLOSC)
    check_limits(about, limits)
    done = 0
    frames = 0
    angles = 0

    def counted() -> Iterator[Window]:
        nonlocal done, frames, angles
        for window in windows(recording, compensate, encoder, frame_us, device):
            yield window
            done += len(window.frames[RECORDED].events)
            frames += 1
            angles += sum(len(t) for t, _ in window.angles.values())
            if progress is not None:
                progress("writing frames", done / len(source))

    with NewFile(path) as new, errors_name(path, lambda: f"writing {limits.label}"):
        write(new.part, counted(), about)
    streams = (RECORDED,) if compensate is None else (RECORDED, COMPENSATED)
    return ViewerSummary(done, frames, streams, angles)
