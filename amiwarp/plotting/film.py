"""Films of the events of any recording: counts per frame, or a time surface, at any speed."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import FilmMode
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.io.spans import blocks_between
from amiwarp.plotting.film_frames import MOST_EVENTS, Timing, frames_of_count, frames_of_time
from amiwarp.plotting.film_pictures import Caption, CountPainter, SurfacePainter
from amiwarp.reconstruction.film_files import save_film
from amiwarp.schema.calls import guarded
from amiwarp.tasks import Progress
from amiwarp.validation import TIME_LIMIT, choice, real, vector, whole

FPS = 30.0
"""Default frames per second of a film."""
MOST_FRAMES = 200_000
"""Largest number of frames, almost two hours of film."""
DECAY_FRAMES = 3.0
"""Default time constant of a time surface, in frames: edges leave a short trail."""

LEAST_WIDTH = 960
"""Width below which a picture is enlarged by a whole number by default [px]. Videos store one colour for 2 x 2 pixels,
in which single events of a small picture would fade."""
MOST_ENLARGED = 64
"""Largest number by which a picture is enlarged."""
LARGEST_SIDE = 4096
"""Side up to which a picture is enlarged by default [px]."""


@guarded
@dataclass(frozen=True, slots=True)
class FilmSummary:
    """What :func:`render` has written.

    Examples
    --------
    >>> amiwarp.FilmSummary(frames=30, events=5000, width=640, height=506, fps=30.0, speed=0.1, decay_us=None).frames
    30
    """

    frames: int
    """Number of frames."""
    events: int
    """Number of events that they show, each counted once."""
    width: int
    """Width of the film [px]."""
    height: int
    """Height of the film [px]."""
    fps: float
    """Frames per second."""
    speed: float | None
    """Speed relative to real time, or None for frames of a number of events."""
    decay_us: float | None
    """Time constant of a time surface [us], or None for counts."""


@guarded
def render(
    recording: Recording,
    path: str | os.PathLike[str],
    *,
    mode: FilmMode | str = FilmMode.COUNTS,
    fps: float = FPS,
    speed: float | None = None,
    frame_us: int | None = None,
    events: int | None = None,
    decay_us: float | None = None,
    window: tuple[int, int] | None = None,
    scale: int | None = None,
    caption: bool = True,
    device: Any = None,
    progress: Progress | None = None,
    overwrite: bool = False,
) -> FilmSummary:
    """Write a film of the events of a recording: OFF in blue, ON in orange, on black.

    Memory use does not depend on the length of the recording, but on the number of events in a frame.

    Parameters
    ----------
    recording : Recording
        Recording of any event camera, raw or compensated.
    path : str or path-like
        The film to write: .mp4, or .gif for short ones.
    mode : FilmMode or str, default "counts"
        What a frame shows.
    fps : float, default 30
        Frames per second.
    speed : float, optional
        Speed relative to real time: 0.01 is a hundred times slower. By default 1, or such that the frames of
        ``frame_us`` follow one another.
    frame_us : int, optional
        Time of the events in a frame of counts [us]. By default, each frame shows the events since the frame before.
    events : int, optional
        Number of events in a frame of counts, instead of a time.
    decay_us : float, optional
        Time constant of a time surface [us]. By default three frames.
    window : tuple of int, optional
        First time, and time after the last, of the events that are shown [us]. By default all events.
    scale : int, optional
        Number by which the picture is enlarged. By default the least with which the film is at least 960 px wide, but
        no side longer than 4096 px for it.
    caption : bool, default True
        Whether a line below the picture shows the time since the recording's first event, the event rate, and the
        colours.
    device : str or warp.Device, optional
        Device to compute on, by default the CPU.
    progress : callable, optional
        Called with the name of the step and the finished fraction, 0 to 1.
    overwrite : bool, default False
        Whether an existing file may be replaced.

    Returns
    -------
    FilmSummary
        What was written.

    Raises
    ------
    AmiwarpError
        If PyAV is missing, the window holds no events, options contradict one another, a frame would be shorter than
        1 us or hold more than 67 million events, there would be more than 200,000 frames, or the file cannot be
        written. Then no file remains.

    Examples
    --------
    >>> events = amiwarp.Events.from_arrays(x=[1, 2, 2], y=[0, 0, 3], t=[0, 400, 999], p=[1, 0, 1])
    >>> recording = amiwarp.Recording(amiwarp.MemoryEvents(events, width=4, height=4))
    >>> amiwarp.render(recording, "slow.mp4", speed=0.01).frames
    3
    """
    path = Path(path)
    source = recording.events
    mode = choice(FilmMode, mode, "mode")
    _check_options(mode, speed=speed, frame_us=frame_us, events=events, decay_us=decay_us)
    fps = real(fps, "fps", 0.1, 1000.0, " frames/s")
    if not len(source):
        raise AmiwarpError(
            f"{recording.name}: holds no events to show; give a recording with events",
            ErrorCode.CONTENT_MISSING,
        )
    start = source.t_first
    stop = source.t_last + 1
    if window is not None:
        first, last = vector(window, 2, "window", _time)
        start = max(start, first)
        stop = min(stop, last)
    if not start < stop:
        raise AmiwarpError(
            f"{recording.name}: has no events in the window; they span 0 .. "
            f"{(source.t_last - source.t_first) * 1e-6:g} s from the first",
            ErrorCode.CONTENT_MISSING,
        )
    width, height = source.size
    if scale is None:
        wanted = -(-LEAST_WIDTH // width)  # rounded up
        scale = max(min(wanted, LARGEST_SIDE // max(width, height)), 1)
    else:
        scale = whole(scale, "scale", 1, MOST_ENLARGED)

    # Which events each frame shows.
    if events is not None:
        events = whole(events, "events", 1, MOST_EVENTS, " events per frame")
        timing = None
        decay = None
        chosen = frames_of_count(blocks_between(source, start, stop, count=events), start)
    else:
        timing = _timing(start, stop, fps, speed, frame_us)
        decay = _decay(mode, decay_us, timing)
        chosen = frames_of_time(blocks_between(source, start, stop), timing, frame_us)

    # What the frames look like.
    paint: CountPainter | SurfacePainter = CountPainter((width, height), device)
    if decay is not None:
        paint = SurfacePainter((width, height), decay, device)
    write = _caption(width * scale, source.t_first, timing, frame_us, decay) if caption else None
    total = 0
    film_height = 0
    film_width = 0

    def pictures() -> Iterator[NDArray[np.uint8]]:
        nonlocal total, film_height, film_width
        for shown in chosen:
            picture = paint(shown).repeat(scale, axis=0).repeat(scale, axis=1)
            if write is not None:
                picture = np.concatenate([picture, write(shown)])
            # A frame may show fewer, or some that the last one showed
            total += min(shown.new, len(shown.events))
            film_height, film_width, _ = picture.shape
            yield picture
            if progress is not None:
                progress("rendering", (min(shown.end_us, stop) - start) / (stop - start))

    frames = save_film(pictures(), path, fps=fps, overwrite=overwrite)
    pace = None if timing is None else timing.step_us * fps * 1e-6
    # Films have even sides.
    film_width += film_width % 2
    film_height += film_height % 2
    return FilmSummary(frames, total, film_width, film_height, fps, pace, decay)


def _time(value: Any, what: str) -> int:
    """Return a time [us]."""
    return whole(value, what, -TIME_LIMIT, TIME_LIMIT, " us")


def _check_options(
    mode: FilmMode,
    *,
    speed: float | None,
    frame_us: int | None,
    events: int | None,
    decay_us: float | None,
) -> None:
    """Raise :class:`AmiwarpError` for options that contradict one another."""
    if events is not None and not (speed is None and frame_us is None):
        raise AmiwarpError(
            "--events and --speed or --frame-ms both choose the events of a frame; give one of them",
            ErrorCode.OPTIONS,
        )
    if mode is FilmMode.SURFACE and not (events is None and frame_us is None):
        raise AmiwarpError(
            "--events and --frame-ms apply to counts; for a time surface give --decay-ms",
            ErrorCode.OPTIONS,
        )
    if mode is FilmMode.COUNTS and decay_us is not None:
        raise AmiwarpError(
            "--decay-ms applies to a time surface; give --mode surface too, or leave it out",
            ErrorCode.OPTIONS,
        )


def _timing(start: int, stop: int, fps: float, speed: float | None, frame_us: int | None) -> Timing:
    """Return the times of the frames of the events from ``start`` to before ``stop`` [us]."""
    if frame_us is not None:
        frame_us = whole(frame_us, "frame_us", 1, 1 << 40, " us in a frame")
    if speed is None:
        step = 1e6 / fps if frame_us is None else float(frame_us)
    else:
        step = real(speed, "speed", 1e-9, 1e6) * 1e6 / fps
    if step < 1.0:
        raise AmiwarpError(
            f"a frame has {step:.3g} us at speed {speed} and {fps:g} frames/s, but at least 1 us; give a higher "
            "--speed or fewer --fps"
        )
    count = math.ceil((stop - start) / step)
    if count > MOST_FRAMES:
        raise AmiwarpError(
            f"{(stop - start) * 1e-6:g} s would give {count:,} frames, more than {MOST_FRAMES:,}; give a part with "
            "--window (window in Python), or a higher --speed"
        )
    return Timing(start, step, count)


def _decay(mode: FilmMode, decay_us: float | None, timing: Timing) -> float | None:
    """Return the time constant of a time surface [us], or None for counts."""
    if mode is FilmMode.COUNTS:
        return None
    if decay_us is None:
        return DECAY_FRAMES * timing.step_us
    return real(decay_us, "decay_us", 1.0, 1e9, " us")


def _caption(
    width: int, first_us: int, timing: Timing | None, frame_us: int | None, decay: float | None
) -> Caption:
    """Return the line of text for the frames of a film that is ``width`` px wide."""
    if timing is None:
        return Caption(width, first_us, 6, None)
    decimals = min(max(math.ceil(-math.log10(timing.step_us * 1e-6)), 0), 6)
    if decay is not None:
        return Caption(width, first_us, decimals, f"decay {decay * 1e-3:.4g} ms")
    length = timing.step_us if frame_us is None else float(frame_us)
    return Caption(width, first_us, decimals, f"{length * 1e-3:.4g} ms")
