"""Log intensity of the shown region, reconstructed within about a second."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.reconstruction.picture import Picture
from amiwarp.reconstruction.reconstruct import Reconstruction
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.selected_part import select_part
from amiwarp.viewer.shown_window import LoadedWindow

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
    picture = _picture(reconstruction, (start_us, length_us), window.last_picture)

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
    last_picture: list[Picture],
) -> Picture:
    """Return the picture of a time window.

    The choice of the smoothness takes most of the time. The smoothness of the picture in ``last_picture``, which is
    empty at first, is taken if the residual is about the same; otherwise, the new picture replaces it.
    """
    if last_picture:
        last = last_picture[0]
        picture = reconstruction(smoothness=last.smoothness).window(*window)
        if abs(picture.residual - last.residual) <= SAME_RESIDUAL * last.residual:
            return picture
    picture = reconstruction().window(*window)
    last_picture[:] = [picture]
    return picture
