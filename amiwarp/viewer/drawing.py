"""What the browser draws of a window: points and colours as bytes, legends, and images as addresses."""

from __future__ import annotations

import base64
import io
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR
from amiwarp.viewer.choices import Axis, Colour
from amiwarp.viewer.cloud_scene import Look
from amiwarp.viewer.colouring import axis_range, colour_table, colours_of, scale_of, third_axis
from amiwarp.viewer.truth_colours import legend_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.events import Events
    from amiwarp.viewer.image_kinds import Scale
    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.window import DisplayedWindow

JPEG_QUALITY = 90
LEGEND_ROWS = 8
"""Largest number of causes, instances or depths in a legend."""
DIFFERENCES = np.array([[0, 114, 178], [255, 255, 255], [213, 94, 0]], np.float64)
"""Colours of fewer, equally many and more events in an image of differences."""
STOPS = 16
"""Number of colours from which the browser draws a colour scale."""


def cloud_state(shown: DisplayedWindow, colour: Colour, axis: Axis, *, dark: bool) -> dict[str, Any]:
    """Return the state variables of the event clouds."""
    look, (low, high) = Look(colour, axis, dark=dark), axis_range(shown, axis)
    title = "prism angle θ (°)" if axis is Axis.ANGLE else "time (ms)"
    colours = _pixels(colours_of(shown, look, after=True))
    differ = colour in (Colour.DENSITY, Colour.RESIDUAL)  # depend on the places of the points
    return {
        "cloud_before": float_bytes(shown.before), "cloud_after": float_bytes(shown.after),
        "cloud_third": float_bytes(third_axis(shown, axis)),
        "colours_before": _pixels(colours_of(shown, look, after=False)) if differ else colours,
        "colours_after": colours,
        "third_axis": {"low": low, "high": high, "title": title}, "region": list(shown.region),
        "legend": legend(shown, colour, dark=dark),
    }  # fmt: skip


def legend(shown: DisplayedWindow, colour: Colour, *, dark: bool) -> dict[str, Any]:
    """Return the legend of a colour choice: title, rows of colour and text, or a scale with its ends."""
    if colour is Colour.POLARITY:
        rows = [[ON_COLOUR, "ON: brighter"], [OFF_COLOUR, "OFF: darker"]]
        return {"title": "polarity", "rows": rows, "bar": "", "low": "", "high": ""}
    if known := legend_of(shown.truth, colour, LEGEND_ROWS):
        return {"title": known[0][1], "rows": [list(row) for row in known[1:]], "bar": "", "low": "", "high": ""}
    low, high, title = scale_of(shown, colour)
    return {"title": title, "rows": [], "bar": gradient(colour_table(colour, dark=dark)), "low": low, "high": high}


def gradient(table: NDArray[Any]) -> str:
    """Return a colour map, shape ``(n, 3)``, as a gradient of CSS."""
    chosen = table[np.linspace(0, len(table) - 1, min(STOPS, len(table))).round().astype(int)]
    colours = ", ".join(f"rgb({r} {g} {b})" for r, g, b in chosen.round().astype(int).tolist())
    return f"linear-gradient(90deg, {colours})"


def scale_state(scale: Scale) -> dict[str, Any]:
    """Return the colour bar of an image: its colours, its ticks from 0 to 1, and its title."""
    title = f"{scale.title} [{scale.unit}]" if scale.unit else scale.title
    values = scale.low + np.linspace(0.0, 1.0, 256) ** (1.0 / scale.gamma) * (scale.high - scale.low)
    if scale.colours != "polarity":
        ticks = [list(tick) for tick in scale.ticks()]
        return {"bar": gradient(scale.rgb(values[None])[0]), "ticks": ticks, "title": title}
    off_on = np.concatenate([values[::-2], values[::2]])  # from many OFF events over none to many ON events
    is_on = np.arange(len(off_on)) >= len(off_on) // 2
    table = scale.rgb(np.where(is_on, [[0.0], [1.0]], [[1.0], [0.0]])[:, None] * off_on)[0]
    ticks = [[0.0, f"{scale.high:.3g} OFF"], [0.5, "0"], [1.0, f"{scale.high:.3g} ON"]]
    return {"bar": gradient(table), "ticks": ticks, "title": title}


def difference_state(before: NDArray[Any], after: NDArray[Any]) -> dict[str, Any]:
    """Return the state variables of an image of differences: blue where ``after`` is lower, red where it is higher."""
    most = max(float(np.abs(after - before).max()), 1.0)
    share = (after - before) / (2.0 * most) + 0.5
    ends = np.linspace(0.0, 1.0, len(DIFFERENCES))
    colours = np.stack([np.interp(share, ends, DIFFERENCES[:, k]) for k in range(3)], axis=-1)
    ticks = [[0.0, f"−{most:.3g}"], [0.5, "0"], [1.0, f"+{most:.3g}"]]
    scale = {"bar": gradient(DIFFERENCES), "ticks": ticks, "title": "difference [events per pixel]"}
    return {"after": jpeg(colours), "after_scale": scale}


def orbit_lines(inspector: Inspector, shown: DisplayedWindow, picked: int = -1) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the orbit of a scene point, and the column in which the model sees it without the prism.

    The scene point is that of a drawn event, or of the middle of the region. Both lines have points x, y [px] and prism
    angle [deg], shape ``(n, 3)``.
    """
    left, top, right, bottom = shown.region
    point = np.array([left + right, top + bottom]) / 2.0 if picked < 0 else shown.after[picked]
    theta, orbit = inspector.orbit(float(point[0]), float(point[1]))
    lines = [np.column_stack([xy, np.degrees(theta)]) for xy in (orbit, np.broadcast_to(point, orbit.shape))]
    return lines[0], lines[1]


NO_ORBIT = {"orbit": b"", "column": b"", "has_orbit": False}
"""State variables without an orbit."""


def whole_image(events: Events, size: tuple[int, int]) -> str:
    """Return the image of events as recorded, as the address of a JPEG; brightness is the square root of the count."""
    width, height = size
    counts = np.bincount(events.y.astype(np.int64) * width + events.x, minlength=width * height)
    positive = counts[counts > 0]
    top = max(float(np.percentile(positive, 99.0)), 1.0) if len(positive) else 1.0
    return jpeg(255.0 * np.sqrt(np.minimum(counts.reshape(height, width) / top, 1.0)))


def jpeg(values: NDArray[Any]) -> str:
    """Return an image as the address of a JPEG.

    ``values``: from 0 to 255, shape ``(height, width)``, or ``(height, width, 3)`` for colours.
    """
    from PIL import Image

    data = io.BytesIO()
    Image.fromarray(values.astype(np.uint8)).save(data, "JPEG", quality=JPEG_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(data.getvalue()).decode()


def event_text(shown: DisplayedWindow, k: int) -> str:
    """Return the description of point ``k``: pixel, time, angle, polarity, compensated position and ground truth."""
    e, (x, y), truth = shown.events, shown.after[k], shown.truth.text(k)
    time_ms = (e.t[k] - shown.span.first_us) * 1e-3
    return (
        f"x {e.x[k]}, y {e.y[k]} px; {time_ms:.3f} ms; θ {math.degrees(shown.theta[k]):.2f}°; "
        f"{'ON' if e.p[k] else 'OFF'}; compensated {x:.2f}, {y:.2f} px{truth and f'; {truth}'}"
    )


def float_bytes(values: NDArray[Any]) -> bytes:
    """Return numbers as the browser reads them: float32, little-endian."""
    return np.ascontiguousarray(values, np.float32).tobytes()


def _pixels(colours: NDArray[np.uint8]) -> bytes:
    """Return colours, shape ``(n, 3)``, as opaque pixels of an image in the browser."""
    return np.column_stack([colours, np.full(len(colours), 255, np.uint8)]).tobytes()
