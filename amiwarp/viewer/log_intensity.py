"""Log intensity of the shown region, reconstructed within about a second."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.reconstruction.picture import Reconstruction
from amiwarp.viewer.selected_part import SelectedPart, select_part

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.reconstruction.result import Picture
    from amiwarp.viewer.imager import Region
    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.parameters import Knobs
    from amiwarp.viewer.window import LoadedWindow

MOST_WORK = 500_000
"""Largest number of events and pixels together from which a picture is made, so that it takes about a second on two
cores. Of a larger region, only every second (third, ...) column and row is used."""
PREPARING_SHARE = 0.01
"""Share of these events and pixels in the picture that is made only to compile and load its kernels."""
SAME_RESIDUAL = 0.25
"""Relative change of the residual up to which the weight of the smoothness prior is kept."""


@dataclass(frozen=True, eq=False)
class LogIntensity:
    """Log intensity of a region."""

    log: NDArray[np.float32]
    """Log intensity [ON thresholds], shape ``(height, width)`` of the region."""
    known: NDArray[np.bool_]
    """Whether events determine each pixel, same shape."""
    note: str
    """Number of equations, their residual, and what limits the picture."""


_prepared: set[str] = set()
"""Devices on which :func:`prepare` has run."""


def prepare(inspector: Inspector) -> None:
    """Compile and load what a log intensity needs, once per device, so that the first one takes no longer."""
    if str(inspector.device) in _prepared:
        return
    with suppress(AmiwarpError):
        window = replace(inspector.loaded, chosen=[])
        log_intensity(inspector, window, inspector.knobs, share=PREPARING_SHARE)
        _prepared.add(str(inspector.device))


def log_intensity(inspector: Inspector, window: LoadedWindow, knobs: Knobs, *, share: float = 1.0) -> LogIntensity:
    """Reconstruct the log intensity of a window's region with given parameters.

    ``share``: share of :data:`MOST_WORK` that it may use.

    Raises :class:`AmiwarpError` if the prism does not rotate, or if no pixel fires twice.
    """
    turn_us = inspector.turn_us if inspector.has_encoder or knobs.rpm else math.inf
    if not math.isfinite(turn_us):
        raise AmiwarpError("the log intensity needs a prism that rotates; set its speed (rpm), or calibrate")
    left, top, right, bottom = _wide(inspector, window)
    part = select_part(inspector, window, (left, top, right, bottom), most=share * MOST_WORK, longest_us=turn_us)
    step = part.step
    if knobs.focal_length is not None:
        knobs = replace(knobs, focal_length=knobs.focal_length / step)
    model, encoder = inspector.model_of(knobs, part.recording.camera), inspector.encoder_of(knobs)
    work = Reconstruction(part.recording, model=model, encoder=encoder, device=inspector.device)
    picture = _picture(work, part, window.chosen)
    rows, columns = (np.arange(window.region[k], window.region[k + 2]) for k in (1, 0))
    cut = np.ix_((rows - top) // step, (columns - left) // step)
    limits = [f"{100 / step**2:.2g} % of the pixels"] if step > 1 else []
    if part.length_us < window.span.length_us:
        limits.append(f"{part.length_us * 1e-3:.3g} ms in the middle")
    note = "; ".join([f"{picture.pairs:,} pairs, residual {picture.residual:.2f}", *limits])
    return LogIntensity(picture.log[cut], picture.known[cut], note)


def _picture(work: Reconstruction, part: SelectedPart, chosen: list[Picture]) -> Picture:
    """Return the picture of a part.

    The choice of the smoothness takes most of the time. That of the picture in ``chosen`` is taken if the residual is
    about the same; otherwise, the new picture replaces it.
    """
    if chosen:
        work.smoothness = chosen[0].smoothness
        picture = work.window(part.start_us, part.length_us)
        if abs(picture.residual - chosen[0].residual) <= SAME_RESIDUAL * chosen[0].residual:
            return picture
        work.smoothness = None
    chosen[:] = [work.window(part.start_us, part.length_us)]
    return chosen[0]


def _wide(inspector: Inspector, window: LoadedWindow) -> Region:
    """Return the part of the image whose events the prism may move into the region."""
    left, top, right, bottom = window.region
    width, height = inspector.recording.events.size
    m = inspector.margin_px
    return max(left - m, 0), max(top - m, 0), min(right + m, width), min(bottom + m, height)
