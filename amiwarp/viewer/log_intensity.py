"""Log intensity of the shown region, reconstructed within about a second."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.imaging.regions import Region, inside
from amiwarp.io.spans import read_span
from amiwarp.reconstruction.picture import Picture
from amiwarp.reconstruction.reconstruct import Reconstruction
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.shown_window import LoadedWindow

MOST_EVENTS = 4_000_000
"""Largest number of events that are read. Of a fuller window, the middle is used."""


def select_part(
    inspector: Inspector,
    window: LoadedWindow,
    part: Region,
    *,
    most: float = math.inf,
    longest_us: float = math.inf,
) -> tuple[Recording, int, int, int]:
    """Return the selected events of a part of the image, without gaps in time, as a recording of a smaller camera.

    Returns the recording, with coordinates in the part, its camera, and the encoder of the whole recording; start and
    length of its time window [us]; and the distance between the used columns, and between the used rows [px].

    ``most``: largest number of events and pixels together; of a larger part, every second (third, ...) column and row
    is used. ``longest_us``: longest duration [us]; of a longer window, and of one with too many events, the middle is
    used.
    """
    # The middle of the window, without gaps.
    span = window.span
    events = window.counted
    share = min(1.0, longest_us / span.length_us, MOST_EVENTS / max(span.count, 1))
    length_us = max(1, math.ceil(share * span.length_us))
    start_us = span.start_us + (span.length_us - length_us) // 2
    if span.count > len(span.events):  # the window was read in runs with gaps
        span = read_span(inspector.recording.events, start_us, length_us, most_events=span.count)
        events = inspector.select(span, inspector.selection).counted
    first, stop = np.searchsorted(events.t, (start_us, start_us + length_us))
    events = events[first:stop]

    # So few columns and rows that events and pixels are at most ``most``.
    left, top, right, bottom = part
    work = float(np.count_nonzero(inside(events, part))) + (right - left) * (bottom - top)
    step = max(1, math.ceil(math.sqrt(work / most)))
    whole = inspector.recording
    whole_width, whole_height = whole.events.size
    columns = np.zeros(whole_width, np.bool_)
    columns[left:right:step] = True
    rows = np.zeros(whole_height, np.bool_)
    rows[top:bottom:step] = True
    kept = np.flatnonzero(columns[events.x] & rows[events.y])

    # The smaller camera, and the events at its pixels.
    width = -(-(right - left) // step)  # rounded up
    height = -(-(bottom - top) // step)
    x = ((events.x[kept] - left) // step).astype(np.uint16)
    y = ((events.y[kept] - top) // step).astype(np.uint16)
    source = MemoryEvents(Events(x, y, events.t[kept], events.p[kept]), width, height)
    c = inspector.camera
    camera = replace(
        c,
        width=width,
        height=height,
        fx=c.fx / step,
        fy=c.fy / step,
        cx=(c.cx - left) / step,
        cy=(c.cy - top) / step,
    )
    recording = Recording(source, camera, whole.encoder, whole.prism, name=whole.name)
    return recording, start_us, length_us, step


MOST_WORK = 500_000
"""Largest number of events and pixels together from which a picture is made, so that it takes about a second on two
cores. Of a larger region, only every second (third, ...) column and row is used."""
SAME_RESIDUAL = 0.25
"""Relative change of the residual up to which the weight of the smoothness prior is kept."""


def log_intensity(
    inspector: Inspector, window: LoadedWindow, knobs: Knobs, *, share: float = 1.0
) -> tuple[NDArray[np.float32], NDArray[np.bool_], str]:
    """Reconstruct the log intensity of a window's region with given parameters.

    Returns the log intensity [ON thresholds] and whether events determine each pixel, shape ``(height, width)``, and a
    text: number of equations, their residual, and what limits the picture. ``share``: share of :data:`MOST_WORK` that
    it may use.

    Raises :class:`AmiwarpError` if the prism does not rotate, or if no pixel fires twice.
    """
    turn_us = inspector.turn_us if inspector.has_encoder or knobs.rpm else math.inf
    if not math.isfinite(turn_us):
        raise AmiwarpError(
            "the log intensity needs a prism that rotates; set its speed (rpm), or calibrate"
        )
    # The prism may move events from around the region into it.
    shown_left, shown_top, shown_right, shown_bottom = window.region
    margin = inspector.margin_px
    width, height = inspector.recording.events.size
    left = max(shown_left - margin, 0)
    top = max(shown_top - margin, 0)
    right = min(shown_right + margin, width)
    bottom = min(shown_bottom + margin, height)
    part, start_us, length_us, step = select_part(
        inspector,
        window,
        (left, top, right, bottom),
        most=share * MOST_WORK,
        longest_us=turn_us,
    )

    if knobs.focal_length is not None:
        knobs = replace(knobs, focal_length=knobs.focal_length / step)
    model = inspector.model_of(knobs, part.camera, np.s_[top:bottom:step, left:right:step])
    reconstruction = partial(
        Reconstruction,
        part,
        model=model,
        encoder=inspector.encoder_of(knobs),
        device=inspector.device,
    )
    picture = _picture(reconstruction, (start_us, length_us), window.chosen)

    # The region in full size: pixels between the used ones show the used one before them.
    rows = (np.arange(shown_top, shown_bottom) - top) // step
    columns = (np.arange(shown_left, shown_right) - left) // step
    cut = np.ix_(rows, columns)
    notes = [f"{picture.pairs:,} pairs, residual {picture.residual:.2f}"]
    if step > 1:
        notes.append(f"{100 / step**2:.2g} % of the pixels")
    if length_us < window.span.length_us:
        notes.append(f"{length_us * 1e-3:.3g} ms in the middle")
    return picture.log[cut], picture.known[cut], "; ".join(notes)


def _picture(
    reconstruction: Callable[..., Reconstruction],
    window: tuple[int, int],
    chosen: list[Picture],
) -> Picture:
    """Return the picture of a time window.

    The choice of the smoothness takes most of the time. The smoothness of the picture in ``chosen`` is taken if the
    residual is about the same; otherwise, the new picture replaces it.
    """
    if chosen:
        picture = reconstruction(smoothness=chosen[0].smoothness).window(*window)
        if abs(picture.residual - chosen[0].residual) <= SAME_RESIDUAL * chosen[0].residual:
            return picture
    chosen[:] = [reconstruction().window(*window)]
    return chosen[0]
