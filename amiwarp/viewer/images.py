"""Images of the shown window, before and after compensation, in different kinds with the scale of their values."""

from __future__ import annotations

import enum
import math
from contextlib import suppress
from dataclasses import dataclass, replace
from types import EllipsisType

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.frequencies import pixel_frequencies, strongest
from amiwarp.imaging.tensors import latest_times
from amiwarp.plotting.colours import SKY, Scale, count_scale, depth_image
from amiwarp.reconstruction.image_in_phase import PhaseImage
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.log_intensity import log_intensity
from amiwarp.viewer.phase_maps import edge_strength, phase_of_window
from amiwarp.viewer.shown_window import DisplayedWindow, LoadedWindow

PREPARING_SHARE = 0.01
"""Share of these events and pixels in the picture that is made only to compile and load its kernels."""
_prepared: set[str] = set()
"""Devices on which :func:`prepare` has run."""


def prepare(inspector: Inspector) -> None:
    """Compile and load the kernels of time surface and log intensity, once per device, before a user asks for one."""
    if str(inspector.device) in _prepared:
        return
    with suppress(AmiwarpError):
        # The small picture must not choose the smoothness of the pictures that follow.
        window = replace(inspector.loaded, last_picture=[])
        _time_surface(_ImageSource(inspector, window, inspector.knobs))
        log_intensity(inspector, window, inspector.knobs, share=PREPARING_SHARE)
        _prepared.add(str(inspector.device))


class ImageKind(enum.StrEnum):
    """What the images show."""

    COUNT = "count"
    """Number of events per pixel."""
    POLARITY = "polarity"
    """Numbers of OFF and ON events per pixel, in two colours."""
    TIME_SURFACE = "time surface"
    """Time of the latest event of each pixel."""
    DECAY = "decay"
    """Decaying time surface: a weight for the latest event of each pixel that falls to 1/e in the decay time."""
    FREQUENCY = "frequency"
    """Frequency with which each pixel changes, for example by a lamp or a vibration."""
    LOG_INTENSITY = "log intensity"
    """Log intensity of the scene, reconstructed from the compensated events."""
    EDGES = "edges"
    """Size of the gradient of the log intensity, from sums of the events in phase with the optic."""
    MISFIT = "misfit"
    """Share of what each pixel saw in whole turns that no still scene explains: what moved."""
    DEPTH = "depth"
    """Depth of what each pixel sees, of a depth map."""


PHASE_KINDS = (ImageKind.EDGES, ImageKind.MISFIT)
"""Kinds that are made from sums in phase, of an optic that rotates."""
SLOW_KINDS = (ImageKind.LOG_INTENSITY, *PHASE_KINDS)
"""Kinds that take so long that they are made only when nothing moves."""


@dataclass(frozen=True, eq=False)
class ShownImages:
    """Images of the shown region, before and after compensation, with one scale for both."""

    before: NDArray[np.float32] | None
    """Image of the events as recorded, or of the parameters compared with, shape ``(height, width)``, or
    ``(2, height, width)`` for OFF and ON. NaN marks pixels without a value. None for a log intensity, edges
    and misfit, which need compensated events."""
    after: NDArray[np.float32]
    """Image of the compensated events, of the same shape."""
    scale: Scale
    note: str = ""
    """What limits the images, for the page; empty if nothing does."""
    after_scale: Scale | None = None
    """Scale of the second image if it has one of its own."""


ON_BLACK = "viridis on dark"
"""Colours of images in which pixels without a value are black."""
DECAY_US = 10_000
"""Decay time of a decaying time surface at the start [us]."""
MOST_FREQUENCIES = 3
"""Largest number of frequencies that are named below an image of frequencies."""


@dataclass(frozen=True, eq=False)
class _ImageSource:
    """What one of the two images is made of: the events of an inspector's window, and parameters that move them."""

    inspector: Inspector
    window: LoadedWindow
    knobs: Knobs | None
    """Parameters that compensate the events; None for the events as recorded."""


def make_images(
    inspector: Inspector,
    kind: ImageKind,
    *,
    against: Knobs | None = None,
    shown: DisplayedWindow | None = None,
    difference: bool = False,
    decay_us: int = DECAY_US,
    same_scale: bool = False,
    kept: tuple[Scale, Scale] | None = None,
) -> ShownImages:
    """Return the images of the inspector's window.

    ``against``: parameters of the first image instead of none. ``shown``: the window with these parameters, if it is
    known: its counts are not made again. ``difference``: of counts, the second image shows after minus before, with a
    scale of its own. ``decay_us``: decay time of a decaying time surface [us]. ``same_scale``: whether counts of
    another recording beside have the scale of this one; otherwise each has its own. ``kept``: scales of both images of
    counts that do not follow the values, while a slider moves. Raises :class:`AmiwarpError` if a log intensity,
    edges or misfit cannot be made, or there is no depth map.
    """
    if kind is ImageKind.LOG_INTENSITY:
        return _log_intensities(inspector, against)
    if kind in PHASE_KINDS:
        return _phase_maps(inspector, against, kind)
    if kind is ImageKind.DEPTH:
        return _count_and_depth(inspector, against, shown)

    left_inspector = inspector
    if against is None and inspector.beside is not None:
        left_inspector = inspector.beside
    left = _ImageSource(left_inspector, left_inspector.loaded, against)
    right = _ImageSource(inspector, inspector.loaded, inspector.knobs)
    part = _shown_part(inspector)

    if kind is ImageKind.TIME_SURFACE:
        before = _time_surface(left)[part]
        after = _time_surface(right)[part]
        length_ms = right.window.span.length_us * 1e-3
        scale = Scale("time after the window's start", "ms", 0.0, length_ms, ON_BLACK)
        return ShownImages(before, after, scale)
    if kind is ImageKind.DECAY:
        before = _decayed(left, decay_us)[part]
        after = _decayed(right, decay_us)[part]
        scale = Scale(f"exp(-age / {decay_us * 1e-3:g} ms)", "1", 0.0, 1.0, "inferno")
        return ShownImages(before, after, scale)
    if kind is ImageKind.FREQUENCY:
        before = _frequencies(left)[part]
        after = _frequencies(right)[part]
        return ShownImages(before, after, _frequency_scale(before, after), frequency_text(after))

    if kind is ImageKind.COUNT and shown is not None:
        before = shown.image_before[part]
        after = shown.image_after[part]
    else:
        per_polarity = kind is ImageKind.POLARITY
        before = _counts(left, per_polarity=per_polarity)[part]
        after = _counts(right, per_polarity=per_polarity)[part]
    if kept is not None and not difference:
        scale, after_scale = kept
        return ShownImages(before, after, scale, after_scale=after_scale)
    colours = "polarity" if kind is ImageKind.POLARITY else "gray"
    if left_inspector is not inspector and not same_scale:
        scale = count_scale((before,), colours)
        return ShownImages(before, after, scale, after_scale=count_scale((after,), colours))
    scale = count_scale((before, after), colours)
    if difference and kind is ImageKind.COUNT:
        change = after - before
        return ShownImages(before, change, scale, after_scale=_difference_scale(change))
    return ShownImages(before, after, scale)


def _shown_part(inspector: Inspector) -> tuple[EllipsisType, slice, slice]:
    """Return the index of the shown region in an image of the whole sensor, of one or of two polarities."""
    left, top, right, bottom = inspector.loaded.region
    return ..., slice(top, bottom), slice(left, right)


def _count_and_depth(
    inspector: Inspector, against: Knobs | None, shown: DisplayedWindow | None
) -> ShownImages:
    """Return the counts of the first image, and the depth map as the second one."""
    if inspector.depth is None:
        raise AmiwarpError("there is no depth map; start 'amiwarp view' with --depth")
    counts = make_images(inspector, ImageKind.COUNT, against=against, shown=shown)
    metres, scale = depth_image(inspector.depth)
    return replace(counts, after=metres[_shown_part(inspector)], after_scale=scale)


def _counts(source: _ImageSource, *, per_polarity: bool) -> NDArray[np.float32]:
    """Return the number of events per pixel, shape ``(height, width)``, or ``(2, height, width)`` per polarity."""
    return source.inspector.counts(source.window, source.knobs, per_polarity=per_polarity)


def _difference_scale(change: NDArray[np.float32]) -> Scale:
    """Return the scale of a difference of counts, with 0 in its middle."""
    most = max(float(np.abs(change).max()), 1.0)
    return Scale("difference of events", "per pixel", -most, most, "difference")


def _log_intensities(inspector: Inspector, against: Knobs | None) -> ShownImages:
    """Return the log intensity with the current parameters, and before it the one with those compared with."""
    window = inspector.loaded
    before = None
    known_before: tuple[NDArray[np.float32], ...] = ()
    if against is not None:
        before, known, _ = log_intensity(inspector, window, against)
        known_before = (before[known],)
    after, known, note = log_intensity(inspector, window, inspector.knobs)

    values = np.concatenate([*known_before, after[known]])
    low = 0.0
    high = 1.0
    if values.size:
        low = float(np.percentile(values, 0.5))
        high = float(np.percentile(values, 99.5))
    scale = Scale("log intensity", "ON thresholds", low, max(high, low + 1e-3), "gray")
    return ShownImages(before, after, scale, note)


def _phase_maps(inspector: Inspector, against: Knobs | None, kind: ImageKind) -> ShownImages:
    """Return edges or misfit with the current parameters, and before it those with the parameters compared with."""
    window = inspector.loaded
    part = _shown_part(inspector)
    before = None
    if against is not None:
        compared, _ = phase_of_window(inspector, window, against)
        before = _phase_map(compared, kind)[part]
    current, note = phase_of_window(inspector, window, inspector.knobs)
    after = _phase_map(current, kind)[part]
    if kind is ImageKind.MISFIT:
        scale = Scale(
            "misfit", "1", 0.0, 1.0, "inferno", missing=SKY, missing_text="hardly any events"
        )
    else:
        strongest_edge = max(float(np.percentile(after, 99.5)), 1e-3)
        scale = Scale("gradient", "ON thresholds/px", 0.0, strongest_edge, "gray")
    return ShownImages(before, after, scale, note)


def _phase_map(image: PhaseImage, kind: ImageKind) -> NDArray[np.float32]:
    """Return edges or misfit of all pixels, shape ``(height, width)``."""
    return image.misfit if kind is ImageKind.MISFIT else edge_strength(image)


def _time_surface(source: _ImageSource) -> NDArray[np.float32]:
    """Return the time of the latest event of each pixel from the start of the window on [ms]; NaN without events."""
    inspector = source.inspector
    encoder = None
    model = None
    if source.knobs is not None:
        encoder = inspector.encoder_of(source.knobs)
        model = inspector.model_of(source.knobs)
    latest_us = latest_times(
        source.window.counted,
        *inspector.recording.events.size,
        per_polarity=False,
        model=model,
        encoder=encoder,
        device=inspector.device,
    )
    start_us = source.window.span.start_us
    # A pixel without events has a time before all events.
    times_ms = np.where(latest_us < start_us, np.nan, (latest_us - start_us) * 1e-3)
    return times_ms.astype(np.float32)


def _decayed(source: _ImageSource, decay_us: int) -> NDArray[np.float32]:
    """Return exp(-age / decay time) of the latest event of each pixel; NaN without events.

    The age is taken at the end of the window, or at the last event of a recording that ends before.
    """
    span = source.window.span
    last_us = source.inspector.recording.events.t_last
    end_ms = min(span.length_us, last_us - span.start_us) * 1e-3
    age_ms = end_ms - _time_surface(source)
    return np.exp(-age_ms / (decay_us * 1e-3)).astype(np.float32)


def _frequencies(source: _ImageSource) -> NDArray[np.float32]:
    """Return the frequency of each pixel [Hz], shape ``(height, width)``; NaN without one."""
    inspector = source.inspector
    turns = math.isfinite(inspector.turn_us)
    events = inspector.at_pixels(source.window, source.knobs if turns else None)
    span = source.window.span
    starts = span.run_starts if len(span.runs) > 1 else None
    return pixel_frequencies(events, inspector.recording.events.size, starts=starts)


def _frequency_scale(*images: NDArray[np.float32]) -> Scale:
    """Return one scale for images of frequencies."""
    known = np.concatenate([image[np.isfinite(image)] for image in images])
    low = 0.0
    high = 1.0
    if len(known):
        low, high = np.percentile(known, (2.0, 98.0)).tolist()
    # Wider than the values, so that a single frequency gets the colour in the middle.
    low *= 0.9
    high *= 1.1
    return Scale("frequency", "Hz", low, high, ON_BLACK, missing_text="no frequency")


def frequency_text(image: NDArray[np.float32]) -> str:
    """Return which frequencies most pixels of an image have."""
    frequencies = strongest(image, MOST_FREQUENCIES)
    if not frequencies:
        return "no pixel has a frequency: it takes 4 equal periods in the window"
    return "; ".join(f"{hz:.4g} Hz: {count:,} px" for hz, count in frequencies)
