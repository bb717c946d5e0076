"""Calibration on what the inspector shows, and the sharpness over two parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib import Calibration, Settings, calibrate
from amiwarp.progress import Progress, silent
from amiwarp.viewer.imager import WindowImager
from amiwarp.viewer.parameters import CURVE_HALF_WIDTH
from amiwarp.viewer.selected_part import SelectedPart, select_part

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.viewer.inspector import Inspector

SURFACE_POINTS = (21, 37)
"""Number of values of the first and the second parameter of a cost surface."""


@dataclass(frozen=True, eq=False)
class FoundCalibration:
    """Result of a calibration on the shown events, which nobody has accepted yet."""

    calibration: Calibration
    """The calibration, of the whole camera."""
    scope: str
    """The events that it used, for the page."""
    before: float
    """Sharpness of the shown region as recorded."""
    current: float
    """Sharpness of the shown region with the inspector's parameters at the end of the calibration."""
    after: float
    """Sharpness of the shown region with the calibrated parameters."""


def scope_text(inspector: Inspector) -> str:
    """Return on which events :func:`calibrate_selected` works, for the page."""
    return _text(inspector, _part(inspector))


def calibrate_selected(
    inspector: Inspector, settings: Settings | None = None, *, progress: Progress | None = None
) -> FoundCalibration:
    """Calibrate on the events of the window and the selection.

    Without an encoder, the search starts at the speed set on the page. Raises :class:`AmiwarpError` if these events
    cannot determine the parameters.
    """
    part, knobs = _part(inspector), inspector.knobs
    scope = _text(inspector, part)
    settings = settings or Settings()
    if not inspector.has_encoder and knobs.rpm:
        settings = replace(settings, start={"rpm": knobs.rpm, **settings.start})
    found = calibrate(part.recording, settings, device=inspector.device, progress=progress)
    whole = replace(found, camera=inspector.camera)
    sharpness = inspector.sharpness_meter(WindowImager(inspector.recording.events.size, inspector.device))
    values = (sharpness(each) for each in (None, inspector.knobs, inspector.knobs_of(whole)))
    return FoundCalibration(whole, scope, *values)


def _part(inspector: Inspector) -> SelectedPart:
    window = inspector.loaded
    return select_part(inspector, window, window.region)


def _text(inspector: Inspector, part: SelectedPart) -> str:
    """Return a description of the events of a part."""
    s, first = inspector.selection, inspector.recording.events.t_first
    start_s = (part.start_us - first) * 1e-6
    kind = "" if s.polarity is None else ("OFF ", "ON ")[s.polarity]
    texts = [
        f"{len(part.recording.events):,} {kind}events from {start_s:.3f} s to {start_s + part.length_us * 1e-6:.3f} s"
    ]
    if s.region is not None:
        left, top, right, bottom = s.region
        texts.append(f"x {left} to {right - 1}, y {top} to {bottom - 1} px")
    texts += ["without hot pixels"] if s.hide_hot else []
    texts += [f"without background activity ({s.noise_us * 1e-3:g} ms)"] if s.noise_us is not None else []
    return ", ".join(texts)


@dataclass(frozen=True, eq=False)
class CostSurface:
    """Sharpness of the shown region over two parameters, with all others fixed."""

    names: tuple[str, str]
    """Names of the parameters along the columns and along the rows."""
    values: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Values of these parameters, in their units, shapes ``(columns,)`` and ``(rows,)``."""
    sharpness: NDArray[np.float64]
    """Sharpness, shape ``(rows, columns)``."""

    @property
    def best(self) -> tuple[float, float]:
        """Values of both parameters with the largest sharpness."""
        row, column = np.unravel_index(int(np.argmax(self.sharpness)), self.sharpness.shape)
        return float(self.values[0][column]), float(self.values[1][row])


def cost_surface(
    inspector: Inspector, *, points: tuple[int, int] = SURFACE_POINTS, progress: Progress | None = None
) -> CostSurface:
    """Return the sharpness over the two parameters that matter most.

    These are apex, from 0 to twice its value, and phase, over one turn about its value. Without an encoder, they are
    speed and apex. ``points``: numbers of their values. The call may run in a thread; ``progress`` may raise an error
    to stop it.
    """
    progress, current = progress or silent, inspector.knobs
    sharpness = inspector.sharpness_meter(WindowImager(inspector.recording.events.size, inspector.device))
    apex = np.linspace(0.0, 2.0 * (current.apex or inspector.prism.apex), points[0])
    if inspector.has_encoder:
        names, values = ("apex", "phase"), (apex, current.phase + np.linspace(-math.pi, math.pi, points[1]))
    else:
        width = CURVE_HALF_WIDTH["rpm"]
        names, values = ("apex", "rpm"), (apex, current.rpm + np.linspace(-width, width, points[1]))
    out = np.empty((len(values[1]), len(values[0])))
    for row, second in enumerate(values[1]):
        progress(f"sharpness over {names[0]} and {names[1]}", row / len(out))
        for column, first in enumerate(values[0]):
            changes: dict[str, Any] = {names[0]: float(first), names[1]: float(second)}
            out[row, column] = sharpness(replace(current, **changes))
    return CostSurface(names, values, out)
