"""Matplotlib figures: empty ones, the numbers of logarithmic axes, and their PNG and SVG files."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from amiwarp.imaging.export import save_png
from amiwarp.io.output_formats import check_ending
from amiwarp.io.outputs import write_text

GREYS = 128
FAINT = 8
"""Number of grey entries in a figure's palette of 256 colours, and largest difference of the channels of a grey
[levels]."""
MOST_NUMBERS = 9
"""Largest number of numbers on a logarithmic axis."""


def blank(
    size: tuple[float, float], layout: Literal["compressed"] | None = None, dpi: int = 110
) -> Any:
    """Return an empty Matplotlib figure of a width and height [inch]."""
    # Without pyplot, which would change global state and look for a display.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=dpi, layout=layout)
    FigureCanvasAgg(figure)
    return figure


def number_logarithmic(*axes: Any) -> None:
    """Number logarithmic axes in plain digits: at decades and as many values between as fit, or evenly within one."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    for axis in axes:
        low, high = axis.get_view_interval()
        decades = math.log10(high / low)
        locator: Any = MaxNLocator(7, steps=(1, 2, 5, 10))
        if decades >= 1.0:
            locator = LogLocator(subs=_digits(decades))
        values = locator.tick_values(low, high)
        axis.set_ticks([value for value in values if low <= value <= high])
        axis.set_major_formatter(lambda value, _: f"{value:,.12f}".rstrip("0").rstrip("."))
        axis.set_minor_formatter(NullFormatter())


def _digits(decades: float) -> tuple[float, ...]:
    """Return the digits with which an axis of a number of decades can be numbered."""
    for digits in ((1.0, 2.0, 5.0), (1.0, 3.0)):
        if decades * len(digits) <= MOST_NUMBERS:
            return digits
    return (1.0,)


def save(figure: Any, path: Path, *, all_colours: bool = False, overwrite: bool = False) -> None:
    """Write a figure as a PNG; the write is atomic.

    The file has 256 colours, which takes a third of the space, or ``all_colours``.
    """
    from PIL import Image

    buffer = io.BytesIO()
    uncompressed = {"compress_level": 0}  # the bytes are decoded again at once
    figure.savefig(
        buffer, format="png", bbox_inches="tight", pad_inches=0.12, pil_kwargs=uncompressed
    )
    picture = Image.open(buffer).convert("RGB")
    if not all_colours:
        picture = indexed(np.asarray(picture))
    save_png(path, picture, overwrite=overwrite)


def save_svg(figure: Any, path: Path) -> None:
    """Write a figure as an SVG without a date; the write is atomic."""
    check_ending(path, "figures are written here", [".svg"])
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    write_text(path, text.getvalue())


def save_png_and_svg(figure: Any, path: Path) -> None:
    """Write a figure as ``path`` with the endings .png and .svg; each write is atomic."""
    save(figure, path.with_suffix(".png"))
    save_svg(figure, path.with_suffix(".svg"))


def indexed(rgb: NDArray[np.uint8]) -> Any:
    """Return the picture ``(height, width, 3)`` with a palette of :data:`GREYS` even greys and other colours.

    A palette optimised for all pixels at once has too few greys, which shows steps in smooth areas, or too few colours.
    """
    from PIL import Image

    red, green, blue = np.moveaxis(rgb, 2, 0)
    largest = np.maximum(np.maximum(red, green), blue)
    smallest = np.minimum(np.minimum(red, green), blue)
    coloured = largest - smallest > FAINT

    index = np.rint(rgb.mean(axis=2) * ((GREYS - 1) / 255.0)).astype(np.uint8)
    greys = np.rint(np.linspace(0.0, 255.0, GREYS)).astype(np.uint8)
    palette = np.repeat(greys, 3).tolist()
    if coloured.any():
        pixels = Image.fromarray(rgb[coloured][None])
        colours = pixels.quantize(256 - GREYS, Image.Quantize.MEDIANCUT)
        index[coloured] = GREYS + np.asarray(colours)[0]
        palette += colours.getpalette() or []
    picture = Image.fromarray(index)
    picture.putpalette(palette[: 3 * 256])
    return picture
