"""Drawing of the shown window: images in different kinds with the scale of their values, and event clouds."""

from __future__ import annotations

import enum
import math
import os
import sys
from collections.abc import Sequence
from contextlib import closing, suppress
from ctypes.util import find_library
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Axis, Colour, View
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.imaging.export import GAMMA, save_png
from amiwarp.imaging.frequencies import pixel_frequencies, strongest
from amiwarp.imaging.palette import OFF_COLOUR, OFF_ON_BLACK, ON_COLOUR, ON_ON_BLACK
from amiwarp.imaging.regions import SMOOTHING_PX, Region, inside
from amiwarp.imaging.residuals import WIDEST_PX, at_pixels, outside, residual
from amiwarp.imaging.sharpness import random_variance
from amiwarp.imaging.tensors import latest_times
from amiwarp.io.depth_map import DepthMap
from amiwarp.io.files import check_output
from amiwarp.io.spans import read_span
from amiwarp.plotting.colours import (
    GREY,
    LIGHT_GREY,
    Scale,
    as_bytes,
    cause_colours,
    count_scale,
    depth_colours,
    depth_ends,
    depth_image,
    table_of,
    ticks,
)
from amiwarp.plotting.figures import instance_colours
from amiwarp.plotting.meshes import Box
from amiwarp.reconstruction.picture import Picture, Reconstruction
from amiwarp.tasks import interrupts_later
from amiwarp.validation import choice
from amiwarp.viewer.axes import CloudAxes, projected, view_matrix
from amiwarp.viewer.filters import rate_text
from amiwarp.viewer.inspector import DisplayedWindow, DrawnTruth, Inspector, Knobs, LoadedWindow, colours_on_offer
from amiwarp.viewer.texts import (
    FONT_PX,
    VTK_FONT_FILE,
    fitting_font,
    font,
    label_actor,
    on_paper,
    text_actor,
    text_width,
)

if TYPE_CHECKING:
    import pyvista

# Selected events of the inspector's window as a recording of a smaller camera.

MOST_EVENTS = 4_000_000
"""Largest number of events that are read. Of a fuller window, the middle is used."""


def select_part(
    inspector: Inspector, window: LoadedWindow, part: Region, *, most: float = math.inf, longest_us: float = math.inf
) -> tuple[Recording, int, int, int]:
    """Return the selected events of a part of the image, without gaps in time, as a recording of a smaller camera.

    Returns the recording, with coordinates in the part, its camera, and the encoder of the whole recording; start and
    length of its time window [us]; and the distance between the used columns, and between the used rows [px].

    ``most``: largest number of events and pixels together; of a larger part, every second (third, ...) column and row
    is used. ``longest_us``: longest duration [us]; of a longer window, and of one with too many events, the middle is
    used.
    """
    span, events = window.span, window.counted
    share = min(1.0, longest_us / span.length_us, MOST_EVENTS / max(span.count, 1))
    length_us = max(1, math.ceil(share * span.length_us))
    start_us = span.start_us + (span.length_us - length_us) // 2
    if span.count > len(span.events):  # the window was read in runs with gaps
        span = read_span(inspector.recording.events, start_us, length_us, most_events=span.count)
        events = inspector.select(span, inspector.selection).counted
    first, stop = np.searchsorted(events.t, (start_us, start_us + length_us))
    events = events[first:stop]
    left, top, right, bottom = part
    work = float(np.count_nonzero(inside(events, part))) + (right - left) * (bottom - top)
    step = max(1, math.ceil(math.sqrt(work / most)))
    columns, rows = (np.zeros(size, np.bool_) for size in inspector.recording.events.size)
    columns[left:right:step] = rows[top:bottom:step] = True
    kept = np.flatnonzero(columns[events.x] & rows[events.y])
    x, y = (((each[kept] - least) // step).astype(np.uint16) for each, least in ((events.x, left), (events.y, top)))
    width, height = -(-(right - left) // step), -(-(bottom - top) // step)
    c = inspector.camera
    camera = replace(
        c, width=width, height=height, fx=c.fx / step, fy=c.fy / step, cx=(c.cx - left) / step, cy=(c.cy - top) / step
    )
    source = MemoryEvents(Events(x, y, events.t[kept], events.p[kept]), width, height)
    whole = inspector.recording
    return Recording(source, camera, whole.encoder, whole.prism, name=whole.name), start_us, length_us, step


# Log intensity of the shown region, reconstructed within about a second.

MOST_WORK = 500_000
"""Largest number of events and pixels together from which a picture is made, so that it takes about a second on two
cores. Of a larger region, only every second (third, ...) column and row is used."""
PREPARING_SHARE = 0.01
"""Share of these events and pixels in the picture that is made only to compile and load its kernels."""
SAME_RESIDUAL = 0.25
"""Relative change of the residual up to which the weight of the smoothness prior is kept."""

_prepared: set[str] = set()
"""Devices on which :func:`prepare` has run."""


def prepare(inspector: Inspector) -> None:
    """Compile and load what time surface and log intensity need, once per device, so that the first take no longer."""
    if str(inspector.device) in _prepared:
        return
    with suppress(AmiwarpError):
        window = replace(inspector.loaded, chosen=[])
        _time_surface(inspector, window, inspector.knobs)
        log_intensity(inspector, window, inspector.knobs, share=PREPARING_SHARE)
        _prepared.add(str(inspector.device))


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
        raise AmiwarpError("the log intensity needs a prism that rotates; set its speed (rpm), or calibrate")
    (left, top, right, bottom), m = window.region, inspector.margin_px  # from where the prism may move events into it
    width, height = inspector.recording.events.size
    left, top, right, bottom = wide = max(left - m, 0), max(top - m, 0), min(right + m, width), min(bottom + m, height)
    part, start_us, length_us, step = select_part(inspector, window, wide, most=share * MOST_WORK, longest_us=turn_us)
    if knobs.focal_length is not None:
        knobs = replace(knobs, focal_length=knobs.focal_length / step)
    model = inspector.model_of(knobs, part.camera, np.s_[top:bottom:step, left:right:step])
    work = Reconstruction(part, model=model, encoder=inspector.encoder_of(knobs), device=inspector.device)
    picture = _picture(work, (start_us, length_us), window.chosen)
    rows, columns = (np.arange(window.region[k], window.region[k + 2]) for k in (1, 0))
    cut = np.ix_((rows - top) // step, (columns - left) // step)
    limits = [f"{100 / step**2:.2g} % of the pixels"] if step > 1 else []
    if length_us < window.span.length_us:
        limits.append(f"{length_us * 1e-3:.3g} ms in the middle")
    note = "; ".join([f"{picture.pairs:,} pairs, residual {picture.residual:.2f}", *limits])
    return picture.log[cut], picture.known[cut], note


def _picture(work: Reconstruction, window: tuple[int, int], chosen: list[Picture]) -> Picture:
    """Return the picture of a time window.

    The choice of the smoothness takes most of the time. That of the picture in ``chosen`` is taken if the residual is
    about the same; otherwise, the new picture replaces it.
    """
    if chosen:
        work.smoothness = chosen[0].smoothness
        picture = work.window(*window)
        if abs(picture.residual - chosen[0].residual) <= SAME_RESIDUAL * chosen[0].residual:
            return picture
        work.smoothness = None
    chosen[:] = [work.window(*window)]
    return chosen[0]


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
    """Frequency with which each pixel changes, such as that of a lamp or of a vibration."""
    LOG_INTENSITY = "log intensity"
    """Log intensity of the scene, reconstructed from the compensated events."""
    DEPTH = "depth"
    """Depth of what each pixel sees, of a depth map."""


@dataclass(frozen=True, eq=False)
class ShownImages:
    """Images of the shown region, before and after compensation, with one scale for both."""

    before: NDArray[np.float32] | None
    """Image of the events as recorded, or of the parameters compared with, shape ``(height, width)``, or
    ``(2, height, width)`` for OFF and ON. NaN marks pixels without a value. None for a log intensity, which needs
    compensated events."""
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
    counts that do not follow the values, while a slider moves. Raises :class:`AmiwarpError` if a log intensity cannot
    be reconstructed, or there is no depth map.
    """
    window, knobs = inspector.loaded, inspector.knobs
    left, top, right, bottom = window.region
    if kind is ImageKind.LOG_INTENSITY:
        found = [log_intensity(inspector, window, each) for each in (against, knobs) if each is not None]
        known = np.concatenate([log[where] for log, where, _ in found])
        low, high = (float(np.percentile(known, share)) for share in (0.5, 99.5)) if known.size else (0.0, 1.0)
        scale = Scale("log intensity", "ON thresholds", low, max(high, low + 1e-3), "gray")
        return ShownImages(None if against is None else found[0][0], found[-1][0], scale, found[-1][2])
    if kind is ImageKind.DEPTH:
        if inspector.depth is None:
            raise AmiwarpError("there is no depth map; start 'amiwarp view' with --depth")
        counts = make_images(inspector, ImageKind.COUNT, against=against, shown=shown)
        metres, scale = depth_image(inspector.depth)
        return replace(counts, after=metres[top:bottom, left:right], after_scale=scale)
    first = inspector.beside if against is None and inspector.beside is not None else inspector
    pair = (first, first.loaded, against), (inspector, window, knobs)
    if kind is ImageKind.TIME_SURFACE:
        before, after = (_time_surface(*each)[top:bottom, left:right] for each in pair)
        scale = Scale("time after the window's start", "ms", 0.0, window.span.length_us * 1e-3, ON_BLACK)
        return ShownImages(before, after, scale)
    if kind is ImageKind.DECAY:
        before, after = (_decayed(*each, decay_us)[top:bottom, left:right] for each in pair)
        scale = Scale(f"exp(-age / {decay_us * 1e-3:g} ms)", "1", 0.0, 1.0, "inferno")
        return ShownImages(before, after, scale)
    if kind is ImageKind.FREQUENCY:
        before, after = (_frequencies(*each)[top:bottom, left:right] for each in pair)
        return ShownImages(before, after, _frequency_scale(before, after), frequency_text(after))
    if kind is ImageKind.COUNT and shown is not None:
        images = [shown.image_before, shown.image_after]
    else:
        images = [each.counts(w, k, per_polarity=kind is ImageKind.POLARITY) for each, w, k in pair]
    before, after = (each[..., top:bottom, left:right] for each in images)
    colours = "polarity" if kind is ImageKind.POLARITY else "gray"
    if kept is not None and not difference:
        return ShownImages(before, after, kept[0], after_scale=kept[1])
    if first is not inspector and not same_scale:
        return ShownImages(before, after, count_scale((before,), colours), after_scale=count_scale((after,), colours))
    scale = count_scale((before, after), colours)
    if not (difference and kind is ImageKind.COUNT):
        return ShownImages(before, after, scale)
    most = max(float(np.abs(after - before).max()), 1.0)
    own = Scale("difference of events", "per pixel", -most, most, "difference")
    return ShownImages(before, after - before, scale, after_scale=own)


def _time_surface(inspector: Inspector, window: LoadedWindow, knobs: Knobs | None) -> NDArray[np.float32]:
    """Return the time of the latest event of each pixel from the start of the window on [ms]; NaN without events."""
    encoder = None if knobs is None else inspector.encoder_of(knobs)
    model = None if knobs is None else inspector.model_of(knobs)
    latest = latest_times(window.counted, *inspector.recording.events.size, per_polarity=False, model=model,
                          encoder=encoder, device=inspector.device)  # fmt: skip
    return np.where(latest < window.span.start_us, np.nan, (latest - window.span.start_us) * 1e-3).astype(np.float32)


def _decayed(inspector: Inspector, window: LoadedWindow, knobs: Knobs | None, decay_us: int) -> NDArray[np.float32]:
    """Return exp(-age / decay time) of the latest event of each pixel; NaN without events.

    The age is that at the end of the window, or at the last event of a recording that ends before.
    """
    span, last_us = window.span, inspector.recording.events.t_last
    end_ms = min(span.length_us, last_us - span.start_us) * 1e-3
    age_ms = end_ms - _time_surface(inspector, window, knobs)
    return np.exp(-age_ms / (decay_us * 1e-3)).astype(np.float32)


def _frequencies(inspector: Inspector, window: LoadedWindow, knobs: Knobs | None) -> NDArray[np.float32]:
    """Return the frequency of each pixel [Hz], shape ``(height, width)``; NaN without one."""
    events = inspector.at_pixels(window, knobs if math.isfinite(inspector.turn_us) else None)
    starts = window.span.run_starts if len(window.span.runs) > 1 else None
    return pixel_frequencies(events, inspector.recording.events.size, starts=starts)


def _frequency_scale(*images: NDArray[np.float32]) -> Scale:
    """Return one scale for images of frequencies."""
    known = np.concatenate([image[np.isfinite(image)] for image in images])
    low, high = np.percentile(known, (2.0, 98.0)).tolist() if len(known) else (0.0, 1.0)
    low, high = 0.9 * low, 1.1 * high  # so that one frequency alone has a colour of the middle
    return Scale("frequency", "Hz", low, high, ON_BLACK, missing_text="no frequency")


def frequency_text(image: NDArray[np.float32]) -> str:
    """Return which frequencies most pixels of an image have."""
    found = strongest(image, MOST_FREQUENCIES)
    if not found:
        return "no pixel has a frequency: it takes 4 equal periods in the window"
    return "; ".join(f"{hz:.4g} Hz: {count:,} px" for hz, count in found)


# Colours for events by cause, instance and depth, and the legend of these colours.


def _truth_colours(colour: Colour, values: NDArray[Any]) -> NDArray[np.float64]:
    """Return the colours (0 to 1) of causes, instances or depths, shape ``(n, 3)``. The sky is grey."""
    from matplotlib.colors import to_rgb

    if colour is Colour.DEPTH:
        return depth_colours(values, depth_ends(values))
    if colour is Colour.CAUSE:
        return cause_colours(values)
    return np.asarray(np.where((values == 0)[:, None], to_rgb(GREY), instance_colours(values)))


def legend_of(truth: DrawnTruth, colour: Colour, most: int) -> tuple[tuple[str, str], ...]:
    """Return the legend of a colour choice; the legend is empty if a scale explains the colours.

    Its rows are a colour in hexadecimal notation, which is empty for the title, and the meaning of the colour. A legend
    of depth has ``most`` rows. Other legends list at most ``most`` causes or instances, the most frequent first, with
    their fractions of the drawn events, and sum up the rest.
    """
    from matplotlib.colors import to_hex

    if colour is Colour.POLARITY:
        return ("", "polarity"), (ON_COLOUR, "ON: brighter"), (OFF_COLOUR, "OFF: darker")
    if colour in colours_on_offer(None):  # which needs no ground truth
        return ()
    values, title, more = truth.values(colour), colour.value, []
    if colour is Colour.DEPTH:
        steps, title = np.geomspace(*depth_ends(values), most), "depth [m]"  # in equal ratios
        rgb, texts = depth_colours(steps, depth_ends(values)), [f"{step:#.3g}".rstrip(".") for step in steps]
        more = [(GREY, "sky")] if np.isinf(values).any() else []
    else:
        counts = np.bincount(values)
        found = np.argsort(-counts, kind="stable")[: np.count_nonzero(counts)]
        shares, others = 100.0 * counts / counts.sum(), found[most:]
        texts = [f"{truth.name(colour, k)} {shares[k]:.3g} %" for k in found[:most].tolist()]
        rgb = _truth_colours(colour, found[:most])
        more = [("", f"{len(others)} more {shares[others].sum():.3g} %")] if len(others) else []
    return (("", title), *zip(map(to_hex, rgb), texts, strict=True), *more)


# Colours of the points in the event clouds, and the quantities that the colours show.


def third_axis(shown: DisplayedWindow, axis: Axis) -> NDArray[np.float64]:
    """Return each point's third coordinate, shape ``(n,)``: prism angle [deg], or time [ms]."""
    if axis is Axis.ANGLE:
        return np.asarray(np.degrees(shown.theta), np.float64)
    return np.asarray((shown.events.t - shown.span.first_us + shown.offset_us) * 1e-3, np.float64)


def axis_range(shown: DisplayedWindow, axis: Axis) -> tuple[float, float]:
    """Return the ends of the third axis: prism angle [deg], or time after the recording's first event [ms]."""
    if axis is Axis.ANGLE:
        return 0.0, 360.0
    start_ms = shown.span.start_ms + shown.offset_us * 1e-3
    return start_ms, start_ms + shown.span.length_us * 1e-3


def colours_of(shown: DisplayedWindow, look: Look, *, after: bool) -> NDArray[np.uint8]:
    """Return red, green and blue of each point (0 to 255), shape ``(n, 3)``."""
    from matplotlib.colors import to_rgb

    unknown = shown.is_beside and look.colour not in colours_on_offer(shown.truth.truth)
    if (look.overlaid and not after) or unknown:
        return np.full((len(shown.events), 3), 128, np.uint8)
    if look.colour is Colour.POLARITY:
        two = np.array([to_rgb(OFF_COLOUR), to_rgb(ON_COLOUR)])
        return np.asarray((255.0 * two).astype(np.uint8)[shown.events.p])
    scale = scale_of(shown, look.colour, dark=look.dark)
    if scale is None:
        return as_bytes(_truth_colours(look.colour, shown.truth.values(look.colour)))
    if look.colour in (Colour.ANGLE, Colour.TIME):
        return scale.rgb(third_axis(shown, Axis(look.colour.value)))
    image, xy = (shown.image_after, shown.after) if after else (shown.image_before, shown.before)
    if look.colour is Colour.DENSITY:
        return scale.rgb(at_pixels(image, xy))
    return scale.rgb(residual(image, xy, _known_part(shown, look.colour)))


def _known_part(shown: DisplayedWindow, colour: Colour) -> tuple[slice, slice]:
    """Return the rows and columns in which density or residual are known: those of the image, or of the region."""
    if colour is Colour.DENSITY:
        height, width = shown.image_after.shape
        return slice(0, height), slice(0, width)
    left, top, right, bottom = shown.region
    return slice(top, bottom), slice(left, right)


def unknown_rows(shown: DisplayedWindow, colour: Colour) -> tuple[tuple[str, str], ...]:
    """Return the row of the legend that counts the drawn events whose density or residual is unknown.

    A model moves them out of the image or the region. Returns no row if there are none.
    """
    if colour not in (Colour.DENSITY, Colour.RESIDUAL):
        return ()
    first = _count_outside(shown.first.before, _known_part(shown.first, colour))
    second = _count_outside(shown.after, _known_part(shown, colour))
    if first:
        return ((LIGHT_GREY, f"unknown: {first:,} of the first cloud, {second:,} of the second"),)
    return ((LIGHT_GREY, f"unknown: {second:,} events"),) if second else ()


def _count_outside(xy: NDArray[np.float32], part: tuple[slice, slice]) -> int:
    """Return the number of points that are drawn, and lie outside rows and columns of an image."""
    drawn = np.isfinite(xy).all(axis=1)
    return int(np.count_nonzero(drawn & outside(xy, *part)))


def scale_of(shown: DisplayedWindow, colour: Colour, *, dark: bool) -> Scale | None:
    """Return the scale of a colour choice; None for polarity and ground truth, whose legends have rows.

    The colour maps are perceptually uniform; that of the angle is cyclic, with white ends and a black middle. The scale
    of the density is that of both clouds.
    """
    from matplotlib.colors import to_rgb

    unknown, paper = to_rgb(LIGHT_GREY), " on dark" if dark else ""  # the darkest colours are like a dark background
    if colour is Colour.ANGLE:
        return Scale("prism angle θ", "°", 0.0, 360.0, f"twilight on {'dark' if dark else 'light'}")
    if colour is Colour.TIME:
        return Scale("time", "ms", *axis_range(shown, Axis.TIME), f"viridis{paper}")
    if colour is Colour.DENSITY:
        image = shown.image_after
        top = math.ceil(np.percentile(image[image > 0], 99.0)) if (image > 0).any() else 1.0
        return Scale("events", "per pixel", 0.0, float(top), f"cividis{paper}", GAMMA, missing=unknown)
    if colour is Colour.RESIDUAL:
        return Scale("residual σ", "px", 0.0, WIDEST_PX, f"cividis{paper}", missing=unknown)
    return None


# Legend of the inspector's picture as VTK actors: rows of a coloured mark and the meaning of the colour, or a scale.

CORNER = (0.05, 0.985)
"""Upper left corner of the legend in its strip, in shares of the strip's width and height from the lower left."""
BAR_BOTTOM = 0.3
"""Lower end of a scale, in shares of the height of the strip."""
MARK = "■"
"""Character that shows the colour of a row."""
MARGIN_EM, LARGEST_STRIP = 4.0, 0.35
"""Width of mark and margins in sizes of the font, and largest width of the strip as a fraction of the picture."""
TITLE_EM = 2.7
"""Height of the title of a scale, in sizes of the font."""
FOOT_PX, OWN_RENDERERS = 22, 4
"""Height of the caption [px], and number of renderers of a scene: two clouds, their legend and the caption."""
ROW_PX, LEAST_ROWS, MOST_ROWS = 40, 3, 12
"""Height of the picture per row of the legend [px], and smallest and largest number of rows."""


def strip_share(texts: Sequence[str], width: int, font_px: int = FONT_PX) -> float:
    """Return the fraction of a picture's ``width`` [px] that the texts of a legend need."""
    widest = max(text_width(text, font_px) for text in texts)
    return min((MARGIN_EM * font_px + widest) / width, LARGEST_STRIP)


def bar_actors(bar: Scale, ink: str, height: int, font_px: int = FONT_PX) -> list[Any]:
    """Return the actors of a vertical scale. ``ink``: colour of the text; ``height``: of the bar's renderer [px]."""
    import pyvista
    from vtkmodules.vtkRenderingAnnotation import vtkScalarBarActor

    rgb = table_of(bar.colours)[np.rint(255.0 * np.linspace(0.0, 1.0, 256) ** bar.gamma).astype(int)]
    table = pyvista.LookupTable(values=np.column_stack([rgb, np.full(256, 255, np.uint8)]))
    table.scalar_range = bar.low, bar.high
    actor = vtkScalarBarActor()
    actor.SetLookupTable(table)
    actor.SetMaximumNumberOfColors(256)
    actor.SetUseCustomLabels(True)
    actor.SetCustomLabels(pyvista.convert_array(ticks(bar.low, bar.high, whole=bar.counts)))
    actor.SetLabelFormat("%.4g")
    actor.UnconstrainedFontSizeOn()
    actor.SetPosition(CORNER[0], BAR_BOTTOM)
    actor.SetWidth(0.5)
    actor.SetHeight(CORNER[1] - TITLE_EM * font_px / height - BAR_BOTTOM)
    actor.SetLabelTextProperty(pyvista.TextProperty(color=ink, font_size=font_px, font_file=str(font())))
    return [actor, text_actor(bar.label, ink, CORNER, font_px)]


# What the clouds show, in words: their titles, and the caption of a picture.

RECORDED = "events as recorded"
"""Title of the only cloud, if there is no motion to compensate."""
AGAINST = {
    "recorded": "as recorded", "B": "compensated with B", "found": "compensated with the result",
    "truth": "compensated with the known truth",
}  # fmt: skip
"""What the left cloud and image can show: name, and title."""
PLACE_VARIANCE = 0.0025
"""Relative variance of what one event adds to the variance of an image smoothed by 1 px, over its place in a pixel."""
LEAST_CERTAIN = 0.05
"""Standard deviation of the sharpness of random events below which any sharpness is shown."""


def against_title(inspector: Inspector, against: str) -> str:
    """Return the title of what the left cloud shows, by its name in :data:`AGAINST`."""
    beside = inspector.beside if against == "recorded" else None
    return AGAINST[against] if beside is None else f"{beside.recording.name}, as recorded"


def cloud_titles(inspector: Inspector, against: str, axis: Axis | None = None) -> tuple[str, ...]:
    """Return the titles of the clouds. ``against``: name of what the left one shows, see :data:`AGAINST`.

    Of two recordings, the titles have both names. ``axis``: third axis; a recording without angles of its own is said
    to be at those of the other.
    """
    turns, two = math.isfinite(inspector.turn_us), inspector.beside is not None and against == "recorded"
    if not turns and not two:
        return (RECORDED,)
    right = "compensated" if against == "recorded" else "compensated with A"
    if not two:
        return against_title(inspector, against), right
    name = inspector.recording.name
    lent = f", at the prism angles of {name}" if turns and axis is Axis.ANGLE and inspector.angles_lent else ""
    return against_title(inspector, against) + lent, f"{name}, {right if turns else 'as recorded'}"


def beside_text(other: Inspector) -> str:
    """Return the name of a recording beside another one, and when it starts, if it does not start with that one."""
    start = f", which starts at {other.offset_us * 1e-3:.3f} ms" if other.offset_us else ""
    return f"{other.recording.name}{start}"


def caption(inspector: Inspector, shown: DisplayedWindow, stride: int = 1) -> str:
    """Return what a picture of the clouds shows: recording, time, region, numbers of events and sharpness.

    ``stride``: only every ``stride``-th point is drawn. Right and bottom of the region are exclusive, as its edges are
    in fields and options. Of two recordings, each has its own numbers.
    """
    left, top, right, bottom = shown.region
    end_ms = shown.span.start_ms + shown.span.length_us * 1e-3
    place = f"{shown.span.start_ms:.3f} to {end_ms:.3f} ms; x {left} to {right}, y {top} to {bottom} px"
    if shown.beside is not None:
        return f"{place}; {'; '.join(': '.join([row[0], ', '.join(row[1:])]) for row in beside_rows(inspector, shown))}"
    sharpness = sharpness_text(shown, compensated=math.isfinite(inspector.turn_us))
    return f"{inspector.recording.name}: {place}; {events_text(shown, stride)}; sharpness {sharpness}"


def beside_rows(inspector: Inspector, shown: DisplayedWindow) -> list[list[str]]:
    """Return the figures of two recordings that are shown side by side: name, numbers of events, rate, sharpness."""
    if shown.beside is None or inspector.beside is None:
        return []
    both = (inspector.beside, shown.beside, shown.sharpness_before), (inspector, shown, shown.sharpness_after)
    return [
        [beside_text(each), chosen_text(part), rate_text(1e6 * part.selected / part.read_us),
         f"sharpness {_certain(part, sharpness)}"]
        for each, part, sharpness in both
    ]  # fmt: skip


def sharpness_text(shown: DisplayedWindow, *, compensated: bool) -> str:
    """Return the sharpness of the images as text, with the gain if there are two images of one recording.

    So few events that their sharpness may be that of random ones have none. Of two recordings, the text is empty: each
    has its own, see :func:`beside_rows`.
    """
    before, after = shown.sharpness_before, shown.sharpness_after
    if shown.beside is not None:
        return ""
    if _is_random(shown, max(abs(before), abs(after))):
        return _certain(shown, before)
    if not compensated:
        return f"{before:.3f}"
    gain = f" (×{after / before:.2f})" if before > 1e-3 and after > 0.0 else ""
    return f"{before:.3f} → {after:.3f}{gain}"


def _certain(shown: DisplayedWindow, sharpness: float) -> str:
    """Return a sharpness as text, or that it is unknown."""
    return "unknown: too few events" if _is_random(shown, abs(sharpness)) else f"{sharpness:.3f}"


def _is_random(shown: DisplayedWindow, sharpness: float) -> bool:
    """Return whether a sharpness may be that of as many random events."""
    left, top, right, bottom = shown.region
    area = (right - left) * (bottom - top)
    # for random events, the variance over mean varies by sqrt(2 / area) of itself, and with the places in the pixels
    relative = math.sqrt(2.0 / area + PLACE_VARIANCE / shown.selected)
    deviation = random_variance(SMOOTHING_PX) * area / shown.selected * relative
    return deviation > LEAST_CERTAIN and sharpness < 3.0 * deviation


def events_text(shown: DisplayedWindow, stride: int = 1) -> str:
    """Return the numbers of events of the window, of those that were read, of these selected, and of these drawn.

    ``stride``: only every ``stride``-th point is drawn.
    """
    return f"{chosen_text(shown)}, {drawn_text(shown, stride)}"


def chosen_text(shown: DisplayedWindow) -> str:
    """Return the numbers of events of the window, of those that were read, and of these selected."""
    total, read = shown.span.count, len(shown.span.events)
    parts = [f"{total:,} events"]
    parts += [] if read == total else [f"{read:,} of them read"]
    parts += [] if shown.selected == read else [f"{shown.selected:,} of these selected"]
    return ", ".join(parts)


def drawn_text(shown: DisplayedWindow, stride: int = 1) -> str:
    """Return how many of the selected events are drawn, if every ``stride``-th point is.

    Those of the drawn ones that the model cannot compensate are counted apart: they are missing in the second cloud.
    """
    drawn = len(range(0, len(shown.events), stride))
    unmoved = int(np.count_nonzero(np.isnan(shown.after[:, 0])))
    rest = f", {unmoved:,} not compensated" if unmoved else ""
    if drawn < shown.selected:
        return f"{drawn:,} of these drawn{rest}"
    return f"{'all drawn' if shown.selected == shown.span.count else 'all of these drawn'}{rest}"


# VTK scene with the event clouds before and after compensation, drawn off screen without a user interface.

BACKGROUND_AND_INK = {False: ("white", "#333333"), True: ("#15181c", "#d8d8d8")}
"""Colours of background and lines, for light (False) and dark (True) mode."""
CAMERA_DIRECTIONS = {
    View.FREE: ((1.0, -1.35, 0.75), (0.0, 0.0, 1.0)),
    View.XY: ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    View.X_AXIS: ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    View.Y_AXIS: ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
}
"""Direction from the clouds to the camera, and the upward direction, for each view."""
ORBIT_COLOUR = "#009e73"
"""Colour of the model's orbit, as on the page."""
PICK_PX = 4.0
"""Distance from the mouse up to which an event is found [px]."""
ROUND_PX = 4.0
"""Diameter of the points from which they are round [px]. Smaller discs have no shape, and squares are faster."""
NOWHERE = (0.0, 0.0, 0.0, 0.0)
"""Place of a renderer that is hidden."""
VIEW_ANGLE = 26.0
"""Vertical field of view of the camera [deg]."""
LEAST_FONT_PX, FULL_FONT_PX = 8, 800
"""Smallest size of the texts, and width of a picture from which they have their full size [px]."""
MARGIN = 0.02
"""Margin around the clouds, as a multiple of the region's width."""
LABELS_EM = (6.0, 3.4)
"""Space on each side of the clouds, across and upwards, for title and labels of the axes, in sizes of the font."""
PIXEL_PX = 2.0
"""Diameter of the points at which they are as large as the pixels in the view along the third axis [px]."""


@dataclass(frozen=True)
class Look:
    """Style in which the event clouds are drawn."""

    colour: Colour = Colour.POLARITY
    """Quantity that the points' colour shows."""
    axis: Axis = Axis.ANGLE
    """Quantity along the third axis: prism angle or time."""
    point_size: float = 2.0
    """Diameter of the points in the picture [px]. In the view along the third axis, 2 is the size of the pixels."""
    opacity: float = 1.0
    """Opacity of the points, 0 to 1."""
    dark: bool = False
    """Whether the background is dark."""
    overlaid: bool = False
    """Whether both clouds are drawn in one frame, with the first one in grey."""
    titles: tuple[str, ...] = ("as recorded", "compensated")
    """Titles of the clouds. With a single title, only the second cloud is drawn."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "colour", choice(Colour, self.colour, "colour"))
        object.__setattr__(self, "axis", choice(Axis, self.axis, "axis"))

    def for_clouds(self, titles: Sequence[str]) -> Look:
        """Return the look for clouds with these titles. A single cloud gets the whole picture."""
        return replace(self, titles=tuple(titles), overlaid=self.overlaid or len(titles) == 1)


def side_line() -> Any:
    """Return a grey line at the left side of a renderer."""
    import pyvista
    from vtkmodules.vtkRenderingCore import vtkActor2D, vtkCoordinate, vtkPolyDataMapper2D

    shares, mapper, actor = vtkCoordinate(), vtkPolyDataMapper2D(), vtkActor2D()
    shares.SetCoordinateSystemToNormalizedViewport()
    mapper.SetTransformCoordinate(shares)
    mapper.SetInputData(pyvista.Line((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    mapper.ScalarVisibilityOff()  # PyVista's line has numbers along it
    actor.SetMapper(mapper)
    actor.GetProperty().SetColor(pyvista.Color(GREY).float_rgb)
    actor.GetProperty().SetLineWidth(2.0)  # of which the right half is inside
    return actor


def place_renderer(renderer: Any, place: tuple[float, ...], *, shown: bool) -> None:
    """Draw a renderer at a place (left, bottom, right and top, in shares of the picture's size), or hide it.

    A hidden renderer gets an empty place. PyVista lets each renderer under a pressed mouse button follow the mouse,
    also one that draws nothing, which would take the mouse from the clouds.
    """
    renderer.SetDraw(shown)
    renderer.SetViewport(*(place if shown else NOWHERE))


class Scene:
    """Event clouds before and after compensation, with one camera for both, their legend and a caption."""

    on_display = False
    """Whether this process has opened a window. Films of it are then drawn with OpenGL of its display, too: contexts of
    EGL beside it spoil what the window shows."""

    def __init__(
        self, size: tuple[int, int] = (1000, 420), *, more: int = 0, off_screen: bool = True
    ) -> None:  # fmt: skip
        """Create an empty scene; ``size`` is the picture's width and height [px].

        ``more``: number of renderers for other parts; they follow the :data:`OWN_RENDERERS` of the scene. Without
        ``off_screen``, a window shows the scene. Raises :class:`AmiwarpError` if VTK cannot draw on this machine.
        """
        if off_screen and not Scene.on_display and sys.platform.startswith("linux"):
            if find_library("EGL") is None:  # VTK would end the process
                raise AmiwarpError("VTK needs OpenGL (EGL); on Debian run: apt-get install libegl1 libgl1-mesa-dri")
            os.environ["VTK_DEFAULT_OPENGL_WINDOW"] = "vtkEGLRenderWindow"  # needs neither a display nor libX11
        import pyvista

        parts = 1, OWN_RENDERERS + more
        self.plotter = pyvista.Plotter(off_screen=off_screen, shape=parts, border=False, window_size=list(size))
        Scene.on_display = Scene.on_display or not off_screen
        self.plotter.render_window.SetMultiSamples(0)  # doubles the speed of a software renderer
        self.plotter.link_views((0, 1))
        self._views = list(self.plotter.renderers)[:2]  # of the clouds
        self._area, self._foot = (0.0, 0.0, 1.0, 1.0), 0.0
        self.font_px = min(FONT_PX, max(LEAST_FONT_PX, round(FONT_PX * size[0] / FULL_FONT_PX)))
        """Size of the texts [px]."""
        self._divide(0.0, overlaid=False)
        self.view = View.FREE
        self.stride = 1
        """Distance between the events that are drawn: 1 for all."""
        self._clouds: list[Any] = []
        self._meshes: list[Any] = [None, None]
        self._drawn: list[tuple[Any, ...]] = [((), (), None)] * 2
        self._frame: list[Any] = []
        self._look = Look()
        self._titles = [label_actor("black", FONT_PX, up="top") for _ in self._views]
        self._axes = [CloudAxes(renderer) for renderer in self._views]
        for renderer, title in zip(self._views, self._titles, strict=True):
            renderer.add_actor(title, render=False, pickable=False, reset_camera=False)
            renderer.AddObserver("StartEvent", lambda caller, _: self._before_drawing(caller))
        if more:  # a window, in which zoomed clouds would touch each other
            self._views[1].AddActor(side_line())
        self._lines: list[Any] = []
        self._explained: tuple[Any, ...] = ()
        self._caption = text_actor("", "black", (0.01, 0.9))
        self.plotter.renderers[3].add_actor(self._caption, render=False, pickable=False, reset_camera=False)
        self._framed: tuple[Any, ...] | None = None
        self._size = tuple(size)
        self.box = Box(0, 0, 1, 1, 0.0, 1.0)

    @property
    def views(self) -> list[Any]:
        """The renderers of the clouds."""
        return self._views

    def show(self, shown: DisplayedWindow, look: Look, lines: Sequence[NDArray[Any]] = (), caption: str = "") -> None:
        """Draw the events of a window. If the region of the image has changed, the camera moves, but does not turn.

        ``lines``: a line for each cloud, points x, y [px] and on the third axis, shape ``(n, 3)``. ``caption``: text
        below the clouds.
        """
        before, self._look = self.box, look
        self.box = Box(*shown.region, *axis_range(shown, look.axis))
        self._cloud(0, shown.first.before, shown.first, look)
        self._cloud(1, shown.after, shown, look)
        self._draw_frame(look)
        self._draw_lines(lines, look)
        self._draw_legend(shown, look, caption)
        if replace(before, low=self.box.low, high=self.box.high) != self.box:  # the region has changed
            self._fit(look)

    def look_from(self, view: View, look: Look) -> None:
        """Move the camera to a view direction from which both clouds fit into the picture."""
        self.view = view
        camera, (away, up) = self.plotter.renderers[0].camera, CAMERA_DIRECTIONS[view]
        camera.parallel_projection, camera.view_angle = view is not View.FREE, VIEW_ANGLE
        camera.position, camera.focal_point, camera.up = away, (0.0, 0.0, 0.0), up
        self._fit(look)

    def _fit(self, look: Look) -> None:
        """Move the camera, without turning it, to where both clouds fit into the picture."""
        self._draw_frame(look)
        b, camera = self.box, self.plotter.renderers[0].camera
        away, up = -np.array(camera.direction), np.array(camera.up)
        right = np.cross(up, away) / np.linalg.norm(np.cross(up, away))
        up = np.cross(away, right)
        margin = MARGIN * b.width
        low, high = np.array([b.left, -b.bottom, 0.0]) - margin, np.array([b.right, -b.top, b.axis_height]) + margin
        middle = (low + high) / 2.0
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T - middle
        wide, tall, near = (np.abs(corners @ right), np.abs(corners @ up), corners @ away)
        width_px, height_px = self._cloud_size(look)
        across_px, up_px = (2.0 * share * self.font_px for share in LABELS_EM)
        tall *= height_px / max(height_px - up_px, 0.4 * height_px)
        wide *= width_px / max(width_px - across_px, 0.4 * width_px)
        aspect = width_px / height_px
        half = math.tan(math.radians(VIEW_ANGLE / 2.0))
        camera.parallel_scale = float(np.maximum(tall, wide / aspect).max())
        away = away * float((near + np.maximum(tall, wide / aspect) / half).max())
        camera.position, camera.focal_point, camera.up = tuple(middle + away), tuple(middle), tuple(up)
        for renderer in self._views:
            renderer.camera = camera

    def _cloud_size(self, look: Look) -> tuple[float, float]:
        """Return width and height of what shows a cloud [px]."""
        width, height = self.plotter.render_window.GetSize()
        left, low, right, top = self._area
        wide = (right - left - self._strip) * (1.0 if look.overlaid else 0.5)
        return max(width * wide, 1.0), max(height * (top - low - self._foot), 1.0)

    def place(self, area: tuple[float, float, float, float], font_px: int, look: Look) -> None:
        """Fill another part of the picture: left, low, right and top in shares of its size, with texts of a size."""
        size = tuple(self.plotter.render_window.GetSize())
        if (area, font_px, size) == (self._area, self.font_px, self._size):
            return
        self._area, self.font_px, self._size = area, font_px, size
        self._explained, self._framed = (), None
        self._divide(self._strip, overlaid=self._overlaid)
        if self._clouds:
            self._fit(look)

    def event_at(self, place: tuple[int, int], shown: DisplayedWindow, look: Look) -> int:
        """Return the index of the front event within :data:`PICK_PX` of a place in the picture; -1 if there is none.

        ``place``: pixels from the left and from the bottom.
        """
        for k, renderer in enumerate(self._views):
            if not (renderer.GetDraw() and renderer.IsInViewport(*place)):
                continue
            xy = shown.after if k == 1 or self._overlaid else shown.before
            points = self.box.positions(xy, third_axis(shown, look.axis))
            renderer.ResetCameraClippingRange()  # which is that of the cloud that was drawn last
            places, depth = projected(points, view_matrix(renderer), renderer.GetSize())
            away = np.hypot(*(places + renderer.GetOrigin() - place).T)
            near = np.flatnonzero((away <= max(PICK_PX, 0.5 * self._clouds[k].prop.point_size)) & (depth >= 0.0))
            return int(near[np.lexsort((away[near], depth[near]))[0]]) if len(near) else -1
        return -1

    def picture(self) -> NDArray[np.uint8]:
        """Return the drawn picture, shape ``(height, width, 3)``."""
        from pyvista.plotting.utilities.regression import image_from_window  # a Plotter asks for its show() first

        self.plotter.render_window.Render()
        return np.asarray(image_from_window(self.plotter.render_window, ignore_alpha=True), np.uint8)

    def turntable(self, frames: int) -> Any:
        """Yield pictures while the camera moves once around the clouds, each of shape ``(height, width, 3)``."""
        for _ in range(frames):
            yield self.picture()
            self.plotter.renderers[0].camera.Azimuth(360.0 / frames)

    def close(self) -> None:
        """Release the VTK renderer and its memory."""
        self.plotter.close()

    def _add(self, k: int, mesh: Any, **how: Any) -> Any:
        self.plotter.subplot(0, k)
        return self.plotter.add_mesh(mesh, lighting=False, show_scalar_bar=False, reset_camera=False, render=False,
                                     pickable=False, **how)  # fmt: skip

    def _cloud(self, k: int, xy: NDArray[np.float32], shown: DisplayedWindow, look: Look) -> None:
        """Draw the points of a cloud. Only what has changed is computed, and the points are moved where they are."""
        import pyvista

        drawn = k == 1 or len(look.titles) > 1
        places = (id(xy), id(shown.theta if look.axis is Axis.ANGLE else shown.events), self.box, self.stride, drawn)
        colours: tuple[Any, ...] = (id(shown.events), id(shown.theta), look.colour, look.dark, look.overlaid)
        if look.colour is Colour.DENSITY:  # the scale is that of the second image
            colours = (*colours, id(shown.image_before), id(shown.image_after))
        elif look.colour is Colour.RESIDUAL:
            colours = (*colours, id(shown.image_after if k else shown.image_before))
        mesh, (old_places, old_colours, _) = self._meshes[k], self._drawn[k]
        same = places == old_places, colours == old_colours
        self._drawn[k] = places, colours, shown  # which keeps the arrays, so that no others get their identities
        if not all(same):
            few = shown.every(self.stride if drawn else len(xy))
            points = self.box.positions(few.after if k else few.before, third_axis(few, look.axis))
            valid = ... if math.isfinite(float(points.sum())) else np.isfinite(points).all(axis=1)
            if valid is not ... and not valid.any():  # VTK needs a point, which is then not visible
                drawn, points, valid = False, np.zeros((len(points), 3), np.float32), np.arange(len(points)) < 1
            points = points[valid]
            fits = mesh is not None and len(mesh.points) == len(points)
            if fits and valid is ...:
                mesh.points = points
            else:
                mesh = self._meshes[k] = pyvista.PolyData(points)
                mesh["colour"] = np.zeros((len(points), 3), np.uint8)
                if len(self._clouds) == k:
                    self._clouds.append(self._add(k, mesh, style="points", scalars="colour", rgb=True))
                self._clouds[k].mapper.dataset = mesh
            if not (same[1] and fits and valid is ...):
                mesh["colour"] = colours_of(few, look, after=k == 1)[valid]
        self._clouds[k].visibility = drawn
        self._clouds[k].prop.opacity = look.opacity

    def _before_drawing(self, renderer: Any) -> None:
        """Size the points, and place the title: a window may have changed its size, and the mouse the camera.

        Both clouds have one camera, so that each needs its own clipping range, from what it shows now.
        """
        renderer.ResetCameraClippingRange()
        look, (width, height) = self._look, renderer.GetSize()
        k = self._views.index(renderer)
        self._titles[k].SetPosition(0.5 * width, height - 0.5 * self.font_px)
        camera = renderer.camera
        size, is_round = look.point_size, look.point_size >= ROUND_PX
        if camera.parallel_projection and abs(camera.direction[2]) > 0.9999:  # the image: its pixels touch each other
            pixel_px = height / (2.0 * camera.parallel_scale)
            size, is_round = max(1.0, pixel_px * look.point_size / PIXEL_PX), False
        for cloud in self._clouds:
            if renderer.HasViewProp(cloud):
                cloud.prop.point_size, cloud.prop.render_points_as_spheres = size, is_round

    def _draw_frame(self, look: Look) -> None:
        """Draw the boxes, their titles and axes, if they have changed."""
        import pyvista

        wanted = (self.box, look.axis, look.dark, look.overlaid, look.titles, self.font_px)
        if wanted == self._framed:
            return
        self._framed = wanted
        background, ink = BACKGROUND_AND_INK[look.dark]
        left, right = self._views
        if look.overlaid != self._overlaid:
            self._divide(self._strip, overlaid=look.overlaid)
            home, cloud = (left, right)[not look.overlaid], self._clouds[1]
            (right if look.overlaid else left).RemoveActor(cloud)
            home.AddActor(cloud)
        for renderer in list(self.plotter.renderers)[:OWN_RENDERERS]:
            renderer.set_background(background)
        for renderer in self._views:
            renderer.remove_actor(self._frame, render=False)
        titles = (" and ".join(look.titles),) if look.overlaid else look.titles
        third = "θ [°]" if look.axis is Axis.ANGLE else "t [ms]"
        for title, axes in zip(self._titles, self._axes, strict=True):
            title.input = ""
            axes.hide()
        b, self._frame = self.box, []
        for k, text in enumerate(titles):
            outline = pyvista.Box((b.left, b.right, -b.bottom, -b.top, 0, b.axis_height)).outline()
            self._frame.append(self._add(k, outline, color=ink, line_width=1.0))
            self._axes[k].label(b, ("x [px]", "y [px]", third), (background, ink), self.font_px)
            self._titles[k].input = text
            self._titles[k].prop.color, self._titles[k].prop.font_size = ink, round(1.2 * self.font_px)
            on_paper(self._titles[k], background)

    def _draw_lines(self, lines: Sequence[NDArray[Any]], look: Look) -> None:
        """Draw a line in each cloud, instead of those drawn before."""
        import pyvista

        for renderer in self._views:
            renderer.remove_actor(self._lines, render=False)
        curves = [pyvista.lines_from_points(self.box.positions(line[:, :2], line[:, 2])) for line in lines]
        self._lines = [self._add(0 if look.overlaid else k, curve, color=ORBIT_COLOUR, line_width=2.5)
                       for k, curve in enumerate(curves)]  # fmt: skip

    def _draw_legend(self, shown: DisplayedWindow, look: Look, caption: str) -> None:
        """Draw the legend in a strip on the left, and the caption below. The clouds shrink to make room."""
        ink, camera = BACKGROUND_AND_INK[look.dark][1], self._views[0].camera
        home = self.plotter.renderers[2]
        whole_px = width, height = self.plotter.render_window.GetSize()
        height = round(height * (self._area[3] - self._area[1]))
        bar = scale_of(shown, look.colour, dark=look.dark)
        rows = legend_of(shown.truth, look.colour, max(LEAST_ROWS, min(MOST_ROWS, height // ROW_PX)))
        rows = (*rows, *unknown_rows(shown, look.colour))
        if look.overlaid and len(look.titles) > 1:
            rows = (*rows, (GREY, look.titles[0]))
        title = [] if bar is None else [bar.label]
        strip_px = round(width * strip_share([*title, *(text for _, text in rows)], width, self.font_px))
        # Both clouds get a whole number of pixels, and so the same ones.
        strip_px += (round(width * (self._area[2] - self._area[0])) - strip_px) % 2
        strip = strip_px / width
        foot = FOOT_PX * self.font_px / FONT_PX / whole_px[1] * bool(caption)
        if (strip, foot) != (self._strip, self._foot):
            whole = self._area[2] - self._area[0]
            grows = (whole - self._strip) / (whole - strip)
            self._foot = foot
            self._divide(strip, overlaid=look.overlaid)
            camera.Dolly(1.0 / grows)
            camera.parallel_scale *= grows
        room_px = 0.98 * whole_px[0] * (self._area[2] - self._area[0])
        self._caption.input, self._caption.prop.color = caption, ink
        self._caption.prop.font_size = fitting_font(caption, room_px, self.font_px)
        explained = rows, ink, bar
        if self._explained == explained:
            return
        self._explained = explained
        place, actors = CORNER if bar is None else (CORNER[0], BAR_BOTTOM - 0.05), []
        for k, (colour, text) in enumerate(rows):
            # all rows start at one corner, after line breaks: their distance does not depend on the picture's size
            actors += [text_actor("\n" * k + MARK, colour, place, self.font_px)] if colour else []
            actors.append(text_actor("\n" * k + ("     " if colour else "") + text, ink, place, self.font_px))
        actors += [] if bar is None else bar_actors(bar, ink, height, self.font_px)
        home.clear_actors()
        for actor in actors:
            home.add_actor(actor, render=False, pickable=False, reset_camera=False)

    def _divide(self, strip: float, *, overlaid: bool) -> None:
        """Divide the scene's part of the picture into the legend's strip, a share of the width, and the clouds."""
        self._strip, self._overlaid, (left, right, legend, foot, *_) = strip, overlaid, self.plotter.renderers
        first, bottom, last, top = self._area
        start, low = first + strip, bottom + self._foot
        middle = (last + start) / 2.0
        place_renderer(legend, (first, low, start, top), shown=strip > 0.0)
        place_renderer(foot, (first, bottom, last, low), shown=self._foot > 0.0)
        place_renderer(left, (start, low, last if overlaid else middle, top), shown=True)
        place_renderer(right, (middle, low, last, top), shown=not overlaid)


def draw_depth(plotter: pyvista.Plotter, first: int, depth: DepthMap, font_px: int = FONT_PX) -> None:
    """Draw a depth map in three renderers, from number ``first`` on: colour bar, image, and its points in space.

    The background is light, as the dark colours of far points need it.
    """
    import pyvista

    (background, ink), (metres, scale) = BACKGROUND_AND_INK[False], depth_image(depth)
    height, width = metres.shape
    image = pyvista.ImageData(dimensions=(width + 1, height + 1, 1), origin=(-0.5, 0.5 - height, 0.0))
    image["colour"] = scale.rgb(metres[::-1]).reshape(-1, 3)
    known = depth.known & np.isfinite(depth.points).all(axis=2)
    x, y, z = depth.points[known].T
    cloud = pyvista.PolyData(np.column_stack([x, z, -y]))  # VTK's third axis points up
    cloud["colour"] = scale.rgb(metres[known])
    for renderer in list(plotter.renderers)[first : first + 3]:
        renderer.set_background(background)
    for actor in bar_actors(scale, ink, plotter.renderers[first].GetSize()[1] or plotter.window_size[1], font_px):
        plotter.renderers[first].add_actor(actor, render=False, pickable=False, reset_camera=False)
    for k, mesh, title in ((1, image, "depth map"), (2, cloud, "its points")):
        plotter.subplot(0, first + k)
        plotter.add_mesh(mesh, scalars="colour", rgb=True, lighting=False, render=False, pickable=False, point_size=3.0)
        text = text_actor(title, ink, (0.4, CORNER[1]), font_px)
        plotter.renderers[first + k].add_actor(text, render=False, pickable=False, reset_camera=False)
    bounds = plotter.show_bounds(
        mesh=cloud, xtitle="x [m]", ytitle="depth [m]", ztitle="-y [m]", color=ink, location="outer", fmt="%.1f",
        n_xlabels=3, n_ylabels=3, n_zlabels=3, bold=False, font_size=font_px, use_3d_text=False, render=False,
    )  # fmt: skip
    for axis in range(3):
        for prop in (bounds.GetTitleTextProperty(axis), bounds.GetLabelTextProperty(axis)):
            prop.SetFontFamily(VTK_FONT_FILE)
            prop.SetFontFile(str(font()))
    plotter.view_vector((0.6, -1.0, 0.5), (0.0, 0.0, 1.0), render=False)
    plotter.camera.zoom(0.8)
    plotter.subplot(0, first + 1)
    plotter.view_xy(render=False)
    plotter.enable_parallel_projection()


def save_screenshot(
    inspector: Inspector,
    path: Path,
    *,
    view: View = View.FREE,
    look: Look | None = None,
    size: tuple[int, int],
    against: Knobs | None = None,
) -> None:
    """Write a picture of both event clouds as PNG, as :func:`draw_picture` returns it."""
    check_output(path)
    with interrupts_later():  # VTK crashes if an exception leaves it half-drawn
        save_png(path, draw_picture(inspector, view, look or Look(), size, against))


def draw_picture(
    inspector: Inspector, view: View, look: Look, size: tuple[int, int], against: Knobs | None = None
) -> NDArray[np.uint8]:
    """Return a picture of both event clouds, shape ``(height, width, 3)``; ``size`` is its width and height [px].

    ``against``: parameters of the first cloud; None for the recorded events.
    """
    clouds = inspector.show(against=against)
    with interrupts_later(), closing(Scene(size)) as scene:
        look = look.for_clouds(cloud_titles(inspector, "recorded" if against is None else "B"))
        scene.show(clouds, look, caption=caption(inspector, clouds))
        scene.look_from(view, look)
        return scene.picture()


# What the browser draws of a window: points and colours as bytes, legends, and images as addresses.

LEGEND_ROWS = 8
"""Largest number of causes, instances or depths in a legend."""
STOPS = 16
"""Number of colours from which the browser draws a colour scale."""
MOST_SENT = 4_000_000
"""Largest number of pixels of an image that the browser gets."""
SQUARE = 32
"""Width and height of the legend of two polarities [colours]."""


def cloud_state(shown: DisplayedWindow, colour: Colour, axis: Axis, *, dark: bool) -> dict[str, Any]:
    """Return the state variables of the event clouds."""
    look, (low, high) = Look(colour, axis, dark=dark), axis_range(shown, axis)
    title = "prism angle θ (°)" if axis is Axis.ANGLE else "time (ms)"
    colours = _pixels(colours_of(shown, look, after=True))
    # the colours of density and residual depend on the places of the points
    first, differ = shown.first, shown.beside is not None or colour in (Colour.DENSITY, Colour.RESIDUAL)
    third = float_bytes(third_axis(shown, axis))
    return {
        "cloud_before": float_bytes(first.before), "cloud_after": float_bytes(shown.after), "cloud_third": third,
        "third_before": third if shown.beside is None else float_bytes(third_axis(first, axis)),
        "colours_before": _pixels(colours_of(first, look, after=False)) if differ else colours,
        "colours_after": colours,
        "third_axis": {"low": low, "high": high, "title": title}, "region": list(shown.region),
        "legend": legend(shown, colour, dark=dark),
    }  # fmt: skip


def legend(shown: DisplayedWindow, colour: Colour, *, dark: bool) -> dict[str, Any]:
    """Return the legend of a colour choice: title, rows of colour and text, and a scale with its ends if it has one."""
    bar = scale_of(shown, colour, dark=dark)
    if bar is None:
        (_, title), *rows = legend_of(shown.truth, colour, LEGEND_ROWS)
        return {"title": title, "rows": [list(row) for row in rows], "bar": "", "low": "", "high": ""}
    title = f"{bar.label} (square root)" if bar.counts else bar.title
    unit = "" if bar.counts else bar.unit if bar.unit == "°" else f" {bar.unit}"
    return {
        "title": title,
        "rows": [list(row) for row in unknown_rows(shown, colour)],
        "bar": gradient(bar.colours),
        "low": f"{bar.low:.6g}",
        "high": f"{bar.high:.6g}{unit}",
    }


def gradient(colours: str) -> str:
    """Return the colours of a scale as a gradient of CSS."""
    chosen = table_of(colours)[np.linspace(0, 255, STOPS).round().astype(int)].tolist()
    return f"linear-gradient(90deg, {', '.join(f'rgb({r} {g} {b})' for r, g, b in chosen)})"


def scale_state(scale: Scale) -> dict[str, Any]:
    """Return the colour bar of an image: its colours, its ticks from 0 to 1, and its title.

    OFF and ON have a square instead of a bar: OFF to the right, ON upwards.
    """
    title, ticks = scale.label, [list(tick) for tick in scale.ticks()]
    if scale.colours != "polarity":
        return {"bar": gradient(scale.colours), "ticks": ticks, "title": title, "square": None}
    square = picture_state(polarity_square(scale), replace(scale, unit=""))
    return {"bar": "", "ticks": ticks, "title": title, "square": square}


def polarity_square(scale: Scale) -> NDArray[np.floating[Any]]:
    """Return the numbers of OFF and ON events of a square legend, OFF to the right and ON upwards, shape ``(2, n, n)``.

    The numbers are those of evenly spaced colours.
    """
    values = scale.low + np.linspace(0.0, 1.0, SQUARE) ** (1.0 / scale.gamma) * (scale.high - scale.low)
    return np.stack(np.broadcast_arrays(values, values[::-1, None]))


def picture_state(values: NDArray[Any], scale: Scale) -> dict[str, Any]:
    """Return an image as the browser draws it: its values, and how they become colours as in :meth:`Scale.rgb`.

    ``values``: shape ``(height, width)``, or ``(2, height, width)`` for OFF and ON. Of an image with more than
    :data:`MOST_SENT` pixels, the browser gets the largest values in squares of pixels.
    """
    step, kind = math.ceil(math.sqrt(math.prod(values.shape[-2:]) / MOST_SENT)), "float32"
    for axis in (-2, -1) if step > 1 else ():
        values = np.fmax.reduceat(values, range(0, values.shape[axis], step), axis=axis)
    height, width = values.shape[-2:]
    unit = "events" if scale.counts else scale.unit
    if scale.counts and scale.low == 0.0 and (most := values.max(initial=0.0)) < 1 << 16:
        kind = "uint8" if most < 1 << 8 else "uint16"
    two = scale.colours == "polarity"
    return {
        "values": np.ascontiguousarray(values, kind).tobytes(), "kind": kind, "width": width, "height": height,
        "low": scale.low, "high": scale.high, "gamma": scale.gamma, "step": step,
        "unit": unit if step == 1 else f"{unit} at most in {step}×{step} px",
        "pair": [list(OFF_ON_BLACK), list(ON_ON_BLACK)] if two else None,
        "missing": [*as_bytes(scale.missing).tolist(), scale.missing_text],
        "table": b"" if two else _pixels(table_of(scale.colours)),
    }  # fmt: skip


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


def shown_lines(
    inspector: Inspector, shown: DisplayedWindow, axis: Axis, against: Knobs | None, picked: int = -1
) -> tuple[NDArray[Any], ...]:
    """Return the line of each cloud: of a scene point that moves, or that stays; none without a motion or over time."""
    if axis is not Axis.ANGLE or not math.isfinite(inspector.turn_us):
        return ()
    orbit, column = orbit_lines(inspector, shown, picked)
    return (orbit if against is None and shown.beside is None else column, column)


def event_text(shown: DisplayedWindow, k: int, *, compensated: bool) -> str:
    """Return the description of point ``k``: pixel, time, polarity and ground truth.

    The time is given after the first event [ms], and as the recording holds it [us]. ``compensated``: whether there is
    a prism, so that the point has an angle and a compensated position.
    """
    e, (x, y), truth = shown.events, shown.after[k], shown.truth.text(k)
    time_ms = (e.t[k] - shown.span.first_us) * 1e-3
    parts = [f"x {e.x[k]}, y {e.y[k]} px", f"{time_ms:.3f} ms (t = {e.t[k]} µs)", "ON" if e.p[k] else "OFF"]
    if compensated:
        parts += [f"θ {math.degrees(shown.theta[k]):.2f}°", f"compensated {x:.2f}, {y:.2f} px"]
    return "; ".join([*parts, *([truth] if truth else [])])


def float_bytes(values: NDArray[Any]) -> bytes:
    """Return numbers as the browser reads them: float32, little-endian."""
    return np.ascontiguousarray(values, np.float32).tobytes()


def _pixels(colours: NDArray[np.uint8]) -> bytes:
    """Return colours, shape ``(n, 3)``, as opaque pixels of an image in the browser."""
    return np.column_stack([colours, np.full(len(colours), 255, np.uint8)]).tobytes()
