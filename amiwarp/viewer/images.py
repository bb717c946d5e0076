"""Images of the shown window in different kinds, each with the scale of its values for a colour bar."""

import enum
import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.imaging.export import GAMMA, PERCENTILE
from amiwarp.imaging.iwe import CanvasShape, Votes
from amiwarp.imaging.palette import OFF_ON_BLACK, ON_ON_BLACK
from amiwarp.reconstruction.picture import Picture, Reconstruction
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.timeline import read_span
from amiwarp.viewer.window import DisplayedWindow, Knobs, LoadedWindow, Region, inside

# Selected events of the inspector's window as a recording of a smaller camera.

MOST_EVENTS = 4_000_000
"""Largest number of events that are read. Of a fuller window, the middle is used."""


@dataclass(frozen=True, eq=False)
class SelectedPart:
    """Events of a part of the image without gaps in time, with the camera that sees only this part."""

    recording: Recording
    """The events, with coordinates in the part, and its camera; the encoder is that of the whole recording."""
    start_us: int
    """Start of the time window [us]."""
    length_us: int
    """Length of the time window [us]."""
    step: int
    """Distance between the used columns, and between the used rows [px]."""


def select_part(
    inspector: Inspector, window: LoadedWindow, part: Region, *, most: float = math.inf, longest_us: float = math.inf
) -> SelectedPart:
    """Return the selected events of a part of the image in a window of the inspector.

    ``most``: largest number of events and pixels together; of a larger part, every second (third, ...) column and row
    is used. ``longest_us``: longest duration [us]; of a longer window, and of one with too many events, the middle is
    used.
    """
    span, events = window.span, window.events
    share = min(1.0, longest_us / span.length_us, MOST_EVENTS / max(span.count, 1))
    length_us = max(1, math.ceil(share * span.length_us))
    start_us = span.start_us + (span.length_us - length_us) // 2
    if span.count > len(span.events):  # the window was read in runs with gaps
        events = inspector.select(read_span(inspector.recording.events, start_us, length_us, most_events=span.count))
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
    recording = Recording(source, camera, whole.encoder, whole.prism, name=whole.name)
    return SelectedPart(recording, start_us, length_us, step)


# Log intensity of the shown region, reconstructed within about a second.

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


SURFACE_GAMMA = 4.0
"""Exponent of the tone curve of time surfaces, which shows the last quarter of the window in most of the colours."""


class ImageKind(enum.StrEnum):
    """What the images show."""

    COUNT = "count"
    """Number of events per pixel."""
    POLARITY = "polarity"
    """Numbers of OFF and ON events per pixel, in two colours."""
    TIME_SURFACE = "time surface"
    """Time of the latest event of each pixel."""
    LOG_INTENSITY = "log intensity"
    """Log intensity of the scene, reconstructed from the compensated events."""


@dataclass(frozen=True)
class Scale:
    """How values become colours."""

    title: str
    """Name of the quantity."""
    unit: str
    """Unit of the values; empty for numbers without unit."""
    low: float
    """Value at the start of the colour bar. Lower values have the same colour."""
    high: float
    """Value at the end of the colour bar. Higher values have the same colour."""
    colours: str
    """Name of Matplotlib's colour map, or "polarity" for OFF and ON in two colours on black."""
    gamma: float = 1.0
    """Exponent of the tone curve: a colour's place on the bar is the share of the range to this power."""

    def __post_init__(self) -> None:
        assert self.low < self.high

    def places(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the places of values on the colour bar, 0 to 1; NaN stays NaN."""
        share = (np.asarray(values, np.float64) - self.low) / (self.high - self.low)
        return np.asarray(np.clip(share, 0.0, 1.0) ** self.gamma, np.float64)

    def rgb(self, values: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Return the colours of an image, shape ``(height, width, 3)``; pixels without a value are black.

        ``values``: shape ``(height, width)``, or ``(2, height, width)`` for OFF and ON.
        """
        steps = _steps(values, self.low, self.high)
        if self.colours == "polarity":
            places = np.linspace(0.0, 1.0, STEPS)[steps] ** self.gamma
            both = places[0][..., None] * np.array(OFF_ON_BLACK) + places[1][..., None] * np.array(ON_ON_BLACK)
            return np.asarray(np.rint(255.0 * np.clip(both, 0.0, 1.0)), np.uint8)
        colours = np.take(_table(self.colours, self.gamma), steps, axis=0)
        if self.colours != "gray":
            colours[np.isnan(values)] = 0
        return colours

    def ticks(self) -> tuple[tuple[float, str], ...]:
        """Return the marks of the colour bar: their places, 0 to 1, and their texts."""
        from matplotlib.ticker import MaxNLocator

        values = np.asarray(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]).tick_values(self.low, self.high), np.float64)
        values = values[(values >= self.low) & (values <= self.high)]
        return tuple((float(place), f"{v:g}") for place, v in zip(self.places(values), values, strict=True))


STEPS = 1 << 16
"""Number of steps into which the range of a scale is divided for its colours."""


def _steps(values: NDArray[np.floating], low: float, high: float) -> NDArray[np.uint16]:
    """Return the steps of values in a range; 0 for NaN."""
    share = (np.asarray(values, np.float32) - np.float32(low)) * np.float32((STEPS - 1) / (high - low))
    return np.asarray(np.fmin(np.fmax(share, 0.0), STEPS - 1.0), np.uint16)


@cache
def _table(colours: str, gamma: float) -> NDArray[np.uint8]:
    """Return the colours of all steps, of a colour map of Matplotlib after a tone curve, shape ``(STEPS, 3)``."""
    from matplotlib import colormaps

    shares = np.linspace(0.0, 1.0, STEPS) ** gamma
    return np.asarray(np.rint(255.0 * colormaps[colours](shares)[:, :3]), np.uint8)


@dataclass(frozen=True, eq=False)
class ShownImages:
    """Images of the shown region, before and after compensation, with one scale for both."""

    kind: ImageKind
    before: NDArray[np.float32] | None
    """Image of the events as recorded, or of the parameters compared with, shape ``(height, width)``, or
    ``(2, height, width)`` for OFF and ON. NaN marks pixels without a value. None for a log intensity, which needs
    compensated events."""
    after: NDArray[np.float32]
    """Image of the compensated events, of the same shape."""
    scale: Scale
    note: str = ""
    """What limits the images, for the page; empty if nothing does."""


def make_images(
    inspector: Inspector, kind: ImageKind, knobs: Knobs | None = None, *, against: Knobs | None = None
) -> ShownImages:
    """Return the images of the inspector's window.

    ``knobs``: parameters of the second image, by default the current ones. ``against``: parameters of the first image
    instead of none. Raises :class:`AmiwarpError` if a log intensity cannot be reconstructed.
    """
    window, knobs = inspector.loaded, knobs or inspector.knobs
    left, top, right, bottom = window.region
    cut = np.s_[..., top:bottom, left:right]
    if kind is ImageKind.LOG_INTENSITY:
        return _log_images(inspector, window, knobs, against)
    if kind is ImageKind.TIME_SURFACE:
        images = [_time_surface(inspector, window, k)[cut] for k in (against, knobs)]
        scale = Scale("time of the latest event", "ms", 0.0, window.span.length_us * 1e-3, "viridis", SURFACE_GAMMA)
        return ShownImages(kind, images[0], images[1], scale)
    per_polarity = kind is ImageKind.POLARITY
    images = [_counts(inspector, window, k, per_polarity=per_polarity)[cut] for k in (against, knobs)]
    colours = "polarity" if per_polarity else "gray"
    scale = Scale("events", "per pixel", 0.0, _top(*images), colours, GAMMA)
    return ShownImages(kind, images[0], images[1], scale)


def count_images(shown: DisplayedWindow) -> ShownImages:
    """Return the images of kind :attr:`ImageKind.COUNT` of a window that is already shown."""
    left, top, right, bottom = shown.region
    images = [each[top:bottom, left:right] for each in (shown.image_before, shown.image_after)]
    scale = Scale("events", "per pixel", 0.0, _top(*images), "gray", GAMMA)
    return ShownImages(ImageKind.COUNT, images[0], images[1], scale)


def _top(*images: NDArray[np.float32]) -> float:
    """Return the count at the end of the scale of both images."""
    positive = [image[image > 0.0] for image in images]
    return max([1.0, *(float(np.percentile(each, PERCENTILE)) for each in positive if each.size)])


def _counts(
    inspector: Inspector, window: LoadedWindow, knobs: Knobs | None, *, per_polarity: bool
) -> NDArray[np.float32]:
    """Return the events per pixel, with the place of each event dithered in its pixel."""
    size = inspector.recording.events.size
    votes = Votes(CanvasShape(*size, per_polarity=per_polarity, dither=True), inspector.device)
    with inspector.lock:
        model, events, drift_us = inspector.warped(window, knobs)
        votes.add_events(model, events, drift=drift_us)
        image = votes.take()
    return image if per_polarity else image[0]


def _time_surface(inspector: Inspector, window: LoadedWindow, knobs: Knobs | None) -> NDArray[np.float32]:
    """Return the time of the latest event of each pixel from the start of the window on [ms]; NaN without events."""
    events, (width, height) = window.events, inspector.recording.events.size
    if knobs is None:
        pixel = events.y.astype(np.int64) * width + events.x
    else:
        x, y = np.rint(inspector.positions(events, knobs)).T
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        with np.errstate(invalid="ignore"):
            pixel = np.where(inside, y.astype(np.int64) * width + x.astype(np.int64), width * height)
    surface = np.full(width * height + 1, np.nan, np.float32)  # the last element takes the events outside of the image
    # events are in order of time; of several values for one pixel, NumPy keeps the last
    surface[pixel] = (events.t - window.span.start_us) * 1e-3
    return surface[:-1].reshape(height, width)


def _log_images(inspector: Inspector, window: LoadedWindow, knobs: Knobs, against: Knobs | None) -> ShownImages:
    """Return log intensities of the region with one scale."""
    found = [None if each is None else log_intensity(inspector, window, each) for each in (against, knobs)]
    first, second = found
    assert second is not None
    known = np.concatenate([each.log[each.known] for each in found if each is not None])
    low, high = (float(np.percentile(known, share)) for share in (0.5, 99.5)) if known.size else (0.0, 1.0)
    scale = Scale("log intensity", "ON thresholds", low, max(high, low + 1e-3), "gray")
    return ShownImages(ImageKind.LOG_INTENSITY, None if first is None else first.log, second.log, scale, second.note)
