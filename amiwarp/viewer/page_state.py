"""What the browser draws of a window: points and colours as bytes, legends, and images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Axis, Colour
from amiwarp.imaging.palette import OFF_ON_BLACK, ON_ON_BLACK
from amiwarp.plotting.colours import Scale, as_bytes, table_of
from amiwarp.viewer.cloud_colours import (
    axis_range,
    colours_of,
    legend_of,
    scale_of,
    third_axis,
    unknown_rows,
)
from amiwarp.viewer.look import Look
from amiwarp.viewer.rig_pictures import SensorPicture
from amiwarp.viewer.shown_window import DisplayedWindow

LEGEND_ROWS = 8
"""Largest number of causes, instances or depths in a legend."""
STOPS = 16
"""Number of colours from which the browser draws a colour scale."""
MOST_SENT = 4_000_000
"""Largest number of pixels of an image that the browser gets."""
SQUARE = 32
"""Width and height of the legend of two polarities [colours]."""


def cloud_state(
    shown: DisplayedWindow, colour: Colour, axis: Axis, *, dark: bool
) -> dict[str, Any]:
    """Return the state variables of the event clouds."""
    look = Look(colour, axis, dark=dark)
    low, high = axis_range(shown, axis)
    title = "prism angle θ (°)" if axis is Axis.ANGLE else "time (ms)"
    first = shown.first
    third = float_bytes(third_axis(shown, axis))
    third_before = third
    if shown.beside is not None:
        third_before = float_bytes(third_axis(first, axis))
    colours = _pixels(colours_of(shown, look, after=True))
    colours_before = colours
    # the colours of density and residual depend on the places of the points
    if shown.beside is not None or colour in (Colour.DENSITY, Colour.RESIDUAL):
        colours_before = _pixels(colours_of(first, look, after=False))
    return {
        "cloud_before": float_bytes(first.before),
        "cloud_after": float_bytes(shown.after),
        "cloud_third": third,
        "third_before": third_before,
        "colours_before": colours_before,
        "colours_after": colours,
        "third_axis": {"low": low, "high": high, "title": title},
        "region": list(shown.region),
        "legend": legend(shown, colour, dark=dark),
    }


def legend(shown: DisplayedWindow, colour: Colour, *, dark: bool) -> dict[str, Any]:
    """Return the legend of a colour choice: title, rows of colour and text, and a scale with its ends if it has one."""
    bar = scale_of(shown, colour, dark=dark)
    if bar is None:
        (_, title), *rows = legend_of(shown.truth, colour, LEGEND_ROWS)
        return {
            "title": title,
            "rows": [list(row) for row in rows],
            "bar": "",
            "low": "",
            "high": "",
        }
    if bar.counts:
        title = f"{bar.label} (square root)"
        unit = ""
    else:
        title = bar.title
        unit = "°" if bar.unit == "°" else f" {bar.unit}"
    return {
        "title": title,
        "rows": [list(row) for row in unknown_rows(shown, colour)],
        "bar": gradient(bar.colours),
        "low": f"{bar.low:.6g}",
        "high": f"{bar.high:.6g}{unit}",
    }


def gradient(colours: str) -> str:
    """Return the colours of a scale as a gradient of CSS."""
    entries = np.linspace(0, 255, STOPS).round().astype(int)
    chosen = table_of(colours)[entries].tolist()
    stops = ", ".join(f"rgb({red} {green} {blue})" for red, green, blue in chosen)
    return f"linear-gradient(90deg, {stops})"


def scale_state(scale: Scale) -> dict[str, Any]:
    """Return the colour bar of an image: its colours, its ticks from 0 to 1, and its title.

    OFF and ON have a square instead of a bar: OFF to the right, ON upwards.
    """
    title = scale.label
    ticks = [list(tick) for tick in scale.ticks()]
    if scale.colours != "polarity":
        return {"bar": gradient(scale.colours), "ticks": ticks, "title": title, "square": None}
    square = picture_state(polarity_square(scale), replace(scale, unit=""))
    return {"bar": "", "ticks": ticks, "title": title, "square": square}


def polarity_square(scale: Scale) -> NDArray[np.floating[Any]]:
    """Return the numbers of OFF and ON events of a square legend, OFF to the right and ON upwards, shape ``(2, n, n)``.

    The colours of these numbers are evenly spaced.
    """
    shares = np.linspace(0.0, 1.0, SQUARE) ** (1.0 / scale.gamma)
    values = scale.low + shares * (scale.high - scale.low)
    return np.stack(np.broadcast_arrays(values, values[::-1, None]))


def picture_state(values: NDArray[Any], scale: Scale) -> dict[str, Any]:
    """Return an image as the browser draws it: its values, and how they become colours as in :meth:`Scale.rgb`.

    ``values``: shape ``(height, width)``, or ``(2, height, width)`` for OFF and ON. Of an image with more than
    :data:`MOST_SENT` pixels, the browser gets the largest values in squares of pixels.
    """
    step = math.ceil(math.sqrt(math.prod(values.shape[-2:]) / MOST_SENT))
    if step > 1:
        for axis in (-2, -1):
            values = np.fmax.reduceat(values, range(0, values.shape[axis], step), axis=axis)
    height, width = values.shape[-2:]

    # Counts are sent as the smallest whole numbers that hold them.
    kind = "float32"
    if scale.counts and scale.low == 0.0:
        most = values.max(initial=0.0)
        if most < 1 << 8:
            kind = "uint8"
        elif most < 1 << 16:
            kind = "uint16"

    unit = "events" if scale.counts else scale.unit
    if step > 1:
        unit = f"{unit} at most in {step}×{step} px"
    two = scale.colours == "polarity"
    return {
        "values": np.ascontiguousarray(values, kind).tobytes(),
        "kind": kind,
        "width": width,
        "height": height,
        "low": scale.low,
        "high": scale.high,
        "gamma": scale.gamma,
        "step": step,
        "unit": unit,
        "pair": [list(OFF_ON_BLACK), list(ON_ON_BLACK)] if two else None,
        "missing": [*as_bytes(scale.missing).tolist(), scale.missing_text],
        "table": b"" if two else _pixels(table_of(scale.colours)),
    }


def rig_state(pictures: Sequence[SensorPicture]) -> list[dict[str, Any]]:
    """Return pictures of the sensors of a rig as the browser draws them, with their colour bars."""
    rows = []
    for each in pictures:
        height, width = each.values.shape[:2]
        row: dict[str, Any] = {"name": each.name, "text": each.text, "size": [width, height]}
        if each.scale is None:
            row["picture"] = _colour_state(each.values)
            row["scale"] = None
        else:
            row["picture"] = picture_state(each.values, each.scale)
            row["scale"] = scale_state(each.scale)
        rows.append(row)
    return rows


def _colour_state(colours: NDArray[np.uint8]) -> dict[str, Any]:
    """Return an image in colour, shape ``(height, width, 3)``, as the browser draws it.

    Of an image with more than :data:`MOST_SENT` pixels, the browser gets every n-th one.
    """
    step = math.ceil(math.sqrt(math.prod(colours.shape[:2]) / MOST_SENT))
    sent = colours[::step, ::step]
    height, width = sent.shape[:2]
    return {
        "rgba": _pixels(sent.reshape(-1, 3)),
        "width": width,
        "height": height,
        "step": step,
    }


def float_bytes(values: NDArray[Any]) -> bytes:
    """Return numbers as the browser reads them: float32, little-endian."""
    return np.ascontiguousarray(values, np.float32).tobytes()


def _pixels(colours: NDArray[np.uint8]) -> bytes:
    """Return colours, shape ``(n, 3)``, as opaque pixels of an image in the browser."""
    return np.column_stack([colours, np.full(len(colours), 255, np.uint8)]).tobytes()
