"""Map of the sharpness over two parameters, with marks of known ones."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from amiwarp.plotting.colours import Scale
from amiwarp.results.calibration import Calibration
from amiwarp.tasks import Progress, silent
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.knobs import CURVE_HALF_WIDTH, Knobs, size_name
from amiwarp.viewer.page_state import picture_state
from amiwarp.viewer.sliders import SLIDERS, UNITS

SURFACE_POINTS = (21, 37)
"""Number of values of the first and the second parameter of a cost surface."""


def cost_surface(
    inspector: Inspector,
    found: Calibration | None = None,
    *,
    points: tuple[int, int] = SURFACE_POINTS,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Return a map of the sharpness of the region over the two parameters that matter most, with all others fixed.

    These are the size, from 0 to twice its value, and phase, over one turn about its value. Without an encoder, they
    are speed and size; with a depth map, clock offset and phase. ``points``: numbers of their values. The map has marks
    of the current, the ``found`` and the true parameters. The call may run in a thread; ``progress`` may raise an error
    to stop it.
    """
    current = inspector.knobs
    sharpness = inspector.sharpness_meter()
    columns, rows = points

    if inspector.depth is not None:  # there is no one size
        first = "clock_offset"
        width = CURVE_HALF_WIDTH["clock_offset"]
        firsts = current.clock_offset + np.linspace(-width, width, columns)
    else:
        first = size_name(current.model)
        size = current.value(first) or inspector.nominal_apex or CURVE_HALF_WIDTH[first]
        firsts = np.linspace(0.0, 2.0 * size, columns)
    if inspector.has_encoder:
        second = "phase"
        width = math.pi
    else:
        second = "rpm"
        width = CURVE_HALF_WIDTH["rpm"]
    seconds = (current.value(second) or 0.0) + np.linspace(-width, width, rows)

    surface = np.empty((rows, columns))
    for row, second_value in enumerate(seconds.tolist()):
        progress(f"sharpness over {first} and {second}", row / rows)
        surface[row] = [
            sharpness(current.with_values({first: first_value, second: second_value}))
            for first_value in firsts.tolist()
        ]

    names = (first, second)
    low = float(surface.min())
    high = max(float(surface.max()), low + 1e-9)
    scale = Scale("sharpness", "1", low, high, "cividis")
    return {
        "x": (firsts / UNITS[first]).tolist(),
        "y": (seconds / UNITS[second]).tolist(),
        "marks": surface_marks(inspector, names, current, found),
        "x_title": _title(first),
        "y_title": _title(second),
        "names": list(names),
        "picture": picture_state(surface[::-1], scale),
    }


def _title(name: str) -> str:
    """Return the title of an axis: name and unit of a parameter."""
    label, unit, _ = SLIDERS[name]
    return f"{label} ({unit})"


def surface_marks(
    inspector: Inspector, names: Sequence[str], about: Knobs, found: Calibration | None
) -> list[dict[str, Any]]:
    """Return the marks of the current, the true and the ``found`` parameters on a map over two parameters.

    ``names``: of the map's two parameters; ``about``: parameters in the middle of the map, about which the phase has
    one turn.
    """
    first, second = names
    result = None if found is None else inspector.knobs_of(found)
    known = (
        ("○", "now", inspector.knobs),
        ("◇", "truth", inspector.truth),
        ("✕", "result", result),
    )
    marks = []
    for sign, title, knobs in known:
        if knobs is None:
            continue
        x = (knobs.value(first) or 0.0) / UNITS[first]
        y = (knobs.value(second) or 0.0) / UNITS[second]
        if second == "phase":
            y += 360.0 * round((about.phase / UNITS[second] - y) / 360.0)
        marks.append({"x": x, "y": y, "sign": sign, "title": title})
    return marks
