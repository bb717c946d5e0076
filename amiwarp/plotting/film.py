"""Films of the events of any recording: counts per frame, or a time surface, at any speed."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import FilmMode, Layers
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, Recording
from amiwarp.imaging.export import brightest, in_two_colours, to_picture
from amiwarp.imaging.iwe import PIECE, CanvasShape, Votes
from amiwarp.imaging.palette import OFF_ON_BLACK, ON_ON_BLACK
from amiwarp.imaging.tensors import latest_times
from amiwarp.io.spans import blocks_between
from amiwarp.reconstruction.picture import LIMITS_UPDATE, save_film
from amiwarp.tasks import Progress
from amiwarp.validation import TIME_LIMIT, choice, guarded, real, vector, whole

# Which events each frame shows.

FPS = 30.0
"""Default frames per second of a film."""
MOST_FRAMES = 200_000
"""Largest number of frames, almost two hours of film."""
MOST_EVENTS = 1 << 26
"""Largest number of events of a frame, which are kept in memory."""
DECAY_FRAMES = 3.0
"""Default time constant of a time surface, in frames: edges leave a short trail."""
NEVER = -(2**62)
"""Time of the latest event of a pixel that has had none [us]."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Times of the frames of a film, on the clock of the events."""

    start_us: int
    """Start of the first frame [us]."""
    step_us: float
    """Time from a frame to the next [us]."""
    count: int
    """Number of frames."""

    def end(self, frame: int) -> int:
        """Return the time up to which a frame shows events [us]."""
        return self.start_us + round((frame + 1) * self.step_us)


@dataclass(frozen=True, slots=True)
class Shown:
    """Events that a frame shows."""

    events: Events
    """The events, in order of time."""
    end_us: int
    """Time up to which the frame shows them [us]."""
    new: int
    """Number of events since the frame before."""
    length_us: int
    """Time since the frame before [us]."""


def frames_of_time(blocks: Iterable[Events], timing: Timing, reach_us: int | None) -> Iterator[Shown]:
    """Yield for each frame the events of the last ``reach_us`` before its end, or those since the frame before.

    At most the events of a frame and one block are in memory.
    """
    waiting = iter(blocks)
    held = Events.empty()
    before = timing.start_us
    for frame in range(timing.count):
        end = timing.end(frame)
        low = before if reach_us is None else end - reach_us
        # Blocks are joined once a frame, which may hold the events of many.
        held = held[int(np.searchsorted(held.t, min(low, before))) :]
        parts = [held]
        count = len(held)
        while not len(parts[-1]) or int(parts[-1].t[-1]) < end:
            block = next(waiting, None)
            if block is None:
                break
            parts.append(block)
            count += len(block)
            if count > MOST_EVENTS:
                raise AmiwarpError(
                    f"a frame holds more than {MOST_EVENTS:,} events; give a shorter --frame-ms (frame_us in "
                    "Python), or a lower --speed"
                )
        held = Events.concatenate([part for part in parts if len(part)] or [Events.empty()])
        first, since, stop = np.searchsorted(held.t, (low, before, end)).tolist()
        yield Shown(held[first:stop], end, stop - since, end - before)
        held = held[min(first, since) :]
        before = end


def frames_of_count(blocks: Iterable[Events], start_us: int) -> Iterator[Shown]:
    """Yield a frame for each block of events."""
    before = start_us
    for events in blocks:
        end = int(events.t[-1]) + 1
        yield Shown(events, end, len(events), end - before)
        before = end


# The picture of a frame.


BRIGHT = 95.0
"""Percentile of the pixels with events whose count is brightest. Single hot pixels must not darken a sparse frame."""


class CountPainter:
    """Pictures of the numbers of OFF and ON events. Their brightness follows the events slowly, without flicker."""

    def __init__(self, size: tuple[int, int], device: Any) -> None:
        """Take the width and height of the sensor [px]."""
        self._votes = Votes(CanvasShape(*size, per_polarity=True), device)
        self._top: float | None = None

    def __call__(self, shown: Shown) -> NDArray[np.uint8]:
        """Return the picture of the events, shape ``(height, width, 3)``."""
        for start in range(0, len(shown.events), PIECE):
            self._votes.add_unmoved(shown.events[start : start + PIECE])
        counts = self._votes.take()
        top = brightest(counts, BRIGHT)
        if counts.any():
            self._top = top if self._top is None else self._top + LIMITS_UPDATE * (top - self._top)
        return to_picture(counts, Layers.POLARITY, top=self._top)


class SurfacePainter:
    """Pictures of the time surfaces of OFF and ON events. Each event is looked at once, however slowly it decays."""

    def __init__(self, size: tuple[int, int], decay_us: float, device: Any) -> None:
        """Take the width and height of the sensor [px], and the time constant of the decay [us]."""
        self._size, self._decay_us, self._device = size, decay_us, device
        width, height = size
        self._latest = np.full((2, height, width), NEVER, np.int64)

    def __call__(self, shown: Shown) -> NDArray[np.uint8]:
        """Return the picture after the events since the frame before, shape ``(height, width, 3)``."""
        if len(shown.events):
            latest = latest_times(shown.events, *self._size, device=self._device)
            np.maximum(self._latest, np.asarray(latest), out=self._latest)
        age = (shown.end_us - self._latest).astype(np.float32)
        off, on = np.exp(age / np.float32(-self._decay_us))
        return np.asarray(np.rint(np.clip(in_two_colours(off, on), 0.0, 1.0) * 255.0), np.uint8)


# The line of text below each picture.

LEAST_WIDTH = 960
"""Width below which a picture is enlarged by a whole number by default [px]. Videos store one colour for 2 x 2 pixels,
in which single events of a small picture would fade."""
MOST_ENLARGED = 64
"""Largest number by which a picture is enlarged."""
LARGEST_SIDE = 4096
"""Side up to which a picture is enlarged by default [px]."""
FONT_SHARE, FONT_SIZES = 1 / 50, (11, 28)
"""Height of the font as a share of the picture's width, and its limits [px]."""
INK = (190, 190, 190)
"""Colour of the text."""


class Caption:
    """Line of text: time, event rate, length of a frame, and the colours of OFF and ON."""

    def __init__(self, width: int, first_us: int, decimals: int, note: str | None) -> None:
        """Take the width of the film [px], the time that is 0, the decimals of a time [s], and a text about frames.

        Without a text, it is the number of events of each frame.
        """
        from PIL import ImageFont

        low, high = FONT_SIZES
        self._space = min(max(round(width * FONT_SHARE), low), high)
        self._font = ImageFont.load_default(self._space)
        self._shape = round(1.6 * self._space), width
        self._first_us, self._decimals, self._note = first_us, decimals, note

    def parts(self, shown: Shown) -> list[tuple[str, tuple[int, ...]]]:
        """Return the texts of the line with their colours."""
        time = f"{(shown.end_us - self._first_us) * 1e-6:.{self._decimals}f} s"
        rate = _rate(1e6 * shown.new / max(shown.length_us, 1))
        note = f"{len(shown.events):,} events" if self._note is None else self._note
        off, on = (tuple(round(255 * part) for part in colour) for colour in (OFF_ON_BLACK, ON_ON_BLACK))
        return [(time, INK), (rate, INK), ("OFF", off), ("ON", on), (note, INK)]

    def __call__(self, shown: Shown) -> NDArray[np.uint8]:
        """Return the picture of the line, shape ``(height, width, 3)``. What does not fit is left out."""
        from PIL import Image, ImageDraw

        height, width = self._shape
        image = Image.new("RGB", (width, height))
        draw = ImageDraw.Draw(image)
        left = self._space / 2
        for text, colour in self.parts(shown):
            right = left + draw.textlength(text, font=self._font)
            if right > width:
                break
            draw.text((left, height / 2), text, fill=colour, font=self._font, anchor="lm")
            left = right + self._space
        return np.asarray(image)


def _rate(per_s: float) -> str:
    """Return a rate of events in words, with a unit in which it is not 0."""
    for unit, size in (("Mev/s", 1e6), ("kev/s", 1e3)):
        if per_s >= 0.1 * size:
            return f"{per_s / size:.2f} {unit}"
    return f"{per_s:.0f} ev/s"


# Films.


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
        raise AmiwarpError(f"{recording.name}: holds no events to show; give a recording with events")
    start, stop = source.t_first, source.t_last + 1
    if window is not None:
        first, last = vector(window, 2, "window", _time)
        start, stop = max(start, first), min(stop, last)
    if not start < stop:
        raise AmiwarpError(
            f"{recording.name}: has no events in the window; they span 0 .. "
            f"{(source.t_last - source.t_first) * 1e-6:g} s from the first"
        )
    width, height = source.size
    if scale is None:
        scale = max(min(-(-LEAST_WIDTH // width), LARGEST_SIDE // max(width, height)), 1)
    else:
        scale = whole(scale, "scale", 1, MOST_ENLARGED)
    total = 0
    if events is not None:
        events = whole(events, "events", 1, MOST_EVENTS, " events per frame")
        timing, decay = None, None
        chosen = frames_of_count(blocks_between(source, start, stop, count=events), start)
    else:
        timing = _timing(start, stop, fps, speed, frame_us)
        decay = _decay(mode, decay_us, timing)
        chosen = frames_of_time(blocks_between(source, start, stop), timing, frame_us)
    paint: CountPainter | SurfacePainter = CountPainter((width, height), device)
    if decay is not None:
        paint = SurfacePainter((width, height), decay, device)
    write = _caption(width * scale, source.t_first, timing, frame_us, decay) if caption else None
    size = [0, 0]

    def pictures() -> Iterator[NDArray[np.uint8]]:
        nonlocal total
        for shown in chosen:
            picture = paint(shown).repeat(scale, axis=0).repeat(scale, axis=1)
            if write is not None:
                picture = np.concatenate([picture, write(shown)])
            total += min(shown.new, len(shown.events))  # a frame may show fewer, or some that the last one showed
            size[:] = picture.shape[:2]
            yield picture
            if progress is not None:
                progress("rendering", (min(shown.end_us, stop) - start) / (stop - start))

    frames = save_film(pictures(), path, fps=fps, overwrite=overwrite)
    pace = None if timing is None else timing.step_us * fps * 1e-6
    return FilmSummary(frames, total, size[1] + size[1] % 2, size[0] + size[0] % 2, fps, pace, decay)


def _time(value: Any, what: str) -> int:
    """Return a time [us]."""
    return whole(value, what, -TIME_LIMIT, TIME_LIMIT, " us")


def _check_options(
    mode: FilmMode, *, speed: float | None, frame_us: int | None, events: int | None, decay_us: float | None
) -> None:
    """Raise :class:`AmiwarpError` for options that contradict one another."""
    if events is not None and not (speed is None and frame_us is None):
        raise AmiwarpError("--events and --speed or --frame-ms both choose the events of a frame; give one of them")
    if mode is FilmMode.SURFACE and not (events is None and frame_us is None):
        raise AmiwarpError("--events and --frame-ms apply to counts; for a time surface give --decay-ms")
    if mode is FilmMode.COUNTS and decay_us is not None:
        raise AmiwarpError("--decay-ms applies to a time surface; give --mode surface too, or leave it out")


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
    return DECAY_FRAMES * timing.step_us if decay_us is None else real(decay_us, "decay_us", 1.0, 1e9, " us")


def _caption(width: int, first_us: int, timing: Timing | None, frame_us: int | None, decay: float | None) -> Caption:
    """Return the line of text for the frames of a film that is ``width`` px wide."""
    if timing is None:
        return Caption(width, first_us, 6, None)
    decimals = min(max(math.ceil(-math.log10(timing.step_us * 1e-6)), 0), 6)
    if decay is not None:
        return Caption(width, first_us, decimals, f"decay {decay * 1e-3:.4g} ms")
    length = timing.step_us if frame_us is None else float(frame_us)
    return Caption(width, first_us, decimals, f"{length * 1e-3:.4g} ms")
