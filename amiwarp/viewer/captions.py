"""What the clouds show, in words: their titles, the caption of a picture, and the description of an event."""

from __future__ import annotations

import math

import numpy as np

from amiwarp.choices import Axis
from amiwarp.imaging.regions import SMOOTHING_PX
from amiwarp.imaging.relative_variance import random_variance
from amiwarp.viewer.filters import rate_text
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.shown_window import DisplayedWindow

RECORDED = "events as recorded"
"""Title of the only cloud, if there is no motion to compensate."""
AGAINST = {
    "recorded": "as recorded",
    "B": "compensated with B",
    "found": "compensated with the result",
    "truth": "compensated with the known truth",
}
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
    to be at the angles of the other.
    """
    turns = math.isfinite(inspector.turn_us)
    two = inspector.beside is not None and against == "recorded"
    if not turns and not two:
        return (RECORDED,)
    left = against_title(inspector, against)
    right = "compensated" if against == "recorded" else "compensated with A"
    if not two:
        return left, right
    name = inspector.recording.name
    if turns and axis is Axis.ANGLE and inspector.angles_lent:
        left += f", at the prism angles of {name}"
    return left, f"{name}, {right if turns else 'as recorded'}"


def beside_text(other: Inspector) -> str:
    """Return the name of a recording beside another one, and when it starts, if it does not start with that one."""
    name = other.recording.name
    if not other.offset_us:
        return name
    return f"{name}, which starts at {other.offset_us * 1e-3:.3f} ms"


def caption(inspector: Inspector, shown: DisplayedWindow, stride: int = 1) -> str:
    """Return what a picture of the clouds shows: recording, time, region, numbers of events and sharpness.

    ``stride``: only every ``stride``-th point is drawn. Right and bottom of the region are exclusive, as its edges are
    in fields and options. Of two recordings, each has its own numbers.
    """
    left, top, right, bottom = shown.region
    end_ms = shown.span.start_ms + shown.span.length_us * 1e-3
    place = (
        f"{shown.span.start_ms:.3f} to {end_ms:.3f} ms; x {left} to {right}, y {top} to {bottom} px"
    )
    if shown.beside is not None:
        parts = [place]
        for name, *figures in beside_rows(inspector, shown):
            parts.append(f"{name}: {', '.join(figures)}")
        return "; ".join(parts)
    sharpness = sharpness_text(shown, compensated=math.isfinite(inspector.turn_us))
    return (
        f"{inspector.recording.name}: {place}; {events_text(shown, stride)}; sharpness {sharpness}"
    )


def beside_rows(inspector: Inspector, shown: DisplayedWindow) -> list[list[str]]:
    """Return the figures of two recordings that are shown side by side: name, numbers of events, rate, sharpness."""
    if shown.beside is None or inspector.beside is None:
        return []
    return [
        _figures(inspector.beside, shown.beside, shown.sharpness_before),
        _figures(inspector, shown, shown.sharpness_after),
    ]


def _figures(inspector: Inspector, shown: DisplayedWindow, sharpness: float) -> list[str]:
    """Return the figures of one of two recordings."""
    return [
        beside_text(inspector),
        chosen_text(shown),
        rate_text(1e6 * shown.selected / shown.read_us),
        f"sharpness {_certain(shown, sharpness)}",
    ]


def sharpness_text(shown: DisplayedWindow, *, compensated: bool) -> str:
    """Return the sharpness of the images as text, with the gain if there are two images of one recording.

    It is unknown for so few events that random ones may have this sharpness. Of two recordings, the text is empty: each
    has its own, see :func:`beside_rows`.
    """
    if shown.beside is not None:
        return ""
    before = shown.sharpness_before
    after = shown.sharpness_after
    if _is_random(shown, max(abs(before), abs(after))):
        return _certain(shown, before)
    if not compensated:
        return f"{before:.3f}"
    gain = f" (×{after / before:.2f})" if before > 1e-3 and after > 0.0 else ""
    return f"{before:.3f} → {after:.3f}{gain}"


def _certain(shown: DisplayedWindow, sharpness: float) -> str:
    """Return a sharpness as text, or that it is unknown."""
    if _is_random(shown, abs(sharpness)):
        return "unknown: too few events"
    return f"{sharpness:.3f}"


def _is_random(shown: DisplayedWindow, sharpness: float) -> bool:
    """Return whether as many random events may have this sharpness."""
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
    total = shown.span.count
    read = len(shown.span.events)
    parts = [f"{total:,} events"]
    if read != total:
        parts.append(f"{read:,} of them read")
    if shown.selected != read:
        parts.append(f"{shown.selected:,} of these selected")
    return ", ".join(parts)


def drawn_text(shown: DisplayedWindow, stride: int = 1) -> str:
    """Return how many of the selected events are drawn, if every ``stride``-th point is.

    Drawn events that the model cannot compensate are counted apart: they are missing in the second cloud.
    """
    drawn = len(range(0, len(shown.events), stride))
    if drawn < shown.selected:
        text = f"{drawn:,} of these drawn"
    elif shown.selected == shown.span.count:
        text = "all drawn"
    else:
        text = "all of these drawn"
    unmoved = int(np.count_nonzero(np.isnan(shown.after[:, 0])))
    if unmoved:
        text += f", {unmoved:,} not compensated"
    return text


def event_text(shown: DisplayedWindow, k: int, *, compensated: bool) -> str:
    """Return the description of point ``k``: pixel, time, polarity and ground truth.

    The time is given after the first event [ms], and as the recording holds it [us]. ``compensated``: whether there is
    a prism, so that the point has an angle and a compensated position.
    """
    events = shown.events
    time_ms = (events.t[k] - shown.span.first_us) * 1e-3
    parts = [
        f"x {events.x[k]}, y {events.y[k]} px",
        f"{time_ms:.3f} ms (t = {events.t[k]} µs)",
        "ON" if events.p[k] else "OFF",
    ]
    if compensated:
        x, y = shown.after[k]
        parts.append(f"θ {math.degrees(shown.theta[k]):.2f}°")
        parts.append(f"compensated {x:.2f}, {y:.2f} px")
    truth = shown.truth.text(k)
    if truth:
        parts.append(truth)
    return "; ".join(parts)
