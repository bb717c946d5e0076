"""Time windows of the inspector: selection and loading of their events, parameters, and images on the device."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.parameters import optical_parameters
from amiwarp.choices import Colour, Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events, Recording
from amiwarp.events.truth import Cause, Truth
from amiwarp.imaging.corners import find_background_activity
from amiwarp.imaging.iwe import CanvasShape, UploadedEvents, Votes
from amiwarp.imaging.metrics import SharpnessMeter, relative_variance
from amiwarp.optics.models import PHASE, Model, size_names
from amiwarp.reconstruction.picture import Picture
from amiwarp.viewer.timeline import Span

# Ground truth of the events that the inspector draws, read from the recording on first use.

STORES = {Colour.CAUSE: "stored_causes", Colour.INSTANCE: "stored_instances", Colour.DEPTH: "stored_depths"}
"""Attribute of :class:`amiwarp.Truth` that each colour choice based on ground truth shows."""


def colours_on_offer(truth: Truth | None) -> list[Colour]:
    """Return the colour choices that are possible for a recording with this ground truth."""
    return [c for c in Colour if c not in STORES or getattr(truth, STORES[c], None) is not None]


def truth_text(truth: Truth | None) -> str:
    """Return a one-line summary of the content of a ground truth; empty without ground truth."""
    if truth is None:
        return ""
    stores = {"point": truth.stored_points, **{c.value: getattr(truth, name) for c, name in STORES.items()},
              "place": truth.stored_places}  # fmt: skip
    per_event = ", ".join(name for name, store in stores.items() if store is not None)
    parts = [f"per event: {per_event}"] if per_event else ["prism"] if truth.parameters else []
    parts += [f"{len(truth.labels.instances)} instances"] if truth.labels is not None else []
    parts += [f"{len(truth.frames.t):,} instants"] if truth.frames is not None else []
    parts += [f"{len(truth.poses):,} poses"] if truth.poses is not None else []
    return "; ".join(parts)


@dataclass(frozen=True, eq=False)
class DrawnTruth:
    """Ground truth of the events that the inspector draws."""

    truth: Truth | None
    """Ground truth of the whole recording; None if the recording has none."""
    span: Span
    """Time span from which the drawn events are a selection."""
    positions: NDArray[np.int64]
    """Indices of the drawn events in ``span.events``, shape ``(n,)``."""
    _read: dict[Colour, NDArray[Any]] = field(default_factory=dict)

    def values(self, colour: Colour) -> NDArray[Any]:
        """Return the values of the drawn events that a colour shows, shape ``(n,)``.

        The values are codes of causes, instance numbers, or depths [m]. Raises :class:`AmiwarpError` if the recording
        does not hold this ground truth.
        """
        if colour not in self._read:
            store = getattr(self.truth, STORES[colour], None)
            if store is None:
                given = ", ".join(c.value for c in colours_on_offer(self.truth))
                raise AmiwarpError(
                    f"colour {colour.value!r} needs ground truth that the recording does not hold; choose among {given}"
                )
            self._read[colour] = self.span.rows(store)[self.positions]
        return self._read[colour]

    def name(self, colour: Colour, number: int) -> str:
        """Return the name of the cause with the code ``number``, or of the instance with this number."""
        if colour is Colour.CAUSE:
            return list(Cause)[number].value.replace("_", " ") if number < len(Cause) else f"cause {number}"
        labels = () if self.truth is None or self.truth.labels is None else self.truth.labels.instances
        return "sky" if number == 0 else labels[number - 1] if number <= len(labels) else f"instance {number}"

    def text(self, k: int) -> str:
        """Return the known ground truth of the drawn event ``k`` as text: cause, instance and depth."""
        known = [c for c in colours_on_offer(self.truth) if c in STORES]
        return "; ".join(
            f"depth {self.values(c)[k]:.3f} m" if c is Colour.DEPTH else f"{c.value} {self.name(c, self.values(c)[k])}"
            for c in known
        )


# Images of warped events and their sharpness for the inspector, on the device.

SMOOTHING_PX = 1.0
"""Standard deviation of the Gaussian that smooths the image before its sharpness is measured, as in calibration [px].
"""

Region = tuple[int, int, int, int]
"""Part of the image: left, top, right and bottom [px]; right and bottom are exclusive."""


@dataclass(frozen=True, eq=False)
class MeasuredImage:
    """Image of warped events with its sharpness in a region."""

    image: NDArray[np.float32]
    """The whole image [events per pixel], shape ``(height, width)``."""
    variance: float
    """Variance over mean of the smoothed region, as :attr:`amiwarp.Sharpness.VARIANCE`. It grows with the number of
    events."""
    sharpness: float
    """Relative variance of the smoothed region, see
    :func:`amiwarp.imaging.metrics.relative_variance`. It does not depend on the number of events."""


class WindowImager:
    """Makes images of warped events and measures their sharpness.

    An imager owns its buffers, so only one thread may use it.
    """

    def __init__(self, size: tuple[int, int], device: Any) -> None:
        self._votes, self._device = Votes(CanvasShape(*size, dither=True), device), device
        self._meters: dict[tuple[int, int], SharpnessMeter] = {}

    def measure(self, model: Model, events: UploadedEvents, offset_us: float, region: Region) -> MeasuredImage:
        """Return the image, and its sharpness in the region.

        ``offset_us`` is added to the encoder's clock offset [us].
        """
        self._votes.clear()
        self._votes.add_events(model, events, drift=offset_us)
        left, top, right, bottom = region
        meter = self._meter(right - left, bottom - top)
        if meter.image.shape == self._votes.canvas.shape:
            self._votes.read(meter.image)
            image = part = meter.image.numpy()[0]
        else:
            image = self._votes.take()[0]
            part = image[top:bottom, left:right]
            meter.image.write(part[None])
        variance, mean = meter.measure(), float(part.mean())
        return MeasuredImage(image, variance, relative_variance(variance, mean, SMOOTHING_PX) if mean > 0.0 else 0.0)

    def _meter(self, width: int, height: int) -> SharpnessMeter:
        """Return the meter of images of this size. Only the last one is kept."""
        if (width, height) not in self._meters:
            canvas = CanvasShape(width, height, dither=True)
            meter = SharpnessMeter(canvas, Sharpness.VARIANCE, smoothing=SMOOTHING_PX, device=self._device)
            self._meters = {(width, height): meter}
        return self._meters[width, height]


# Parameters of the prism and selection of events under which the inspector shows a recording.


class Source(enum.StrEnum):
    """Where the value of a parameter comes from. The value of a member is the text that the page shows."""

    ASSUMED = "assumed"
    ESTIMATED = "estimated"
    FILE = "from the file"
    CALIBRATED = "calibrated"
    HAND = "set by hand"
    TRUTH = "known truth"


@dataclass(frozen=True)
class Knobs:
    """Parameters of the prism that the page's sliders set."""

    model: str = "exact"
    """Name of the optical model."""
    apex: float = 0.0
    """Apex angle of the prism [rad]."""
    phase: float = 0.0
    """Phase θ_b of the prism [rad]."""
    clock_offset: float = 0.0
    """Offset between the clocks of encoder and camera, as in :class:`Encoder` [us]."""
    rpm: float = 0.0
    """Speed of the prism if the recording has no encoder [1/min]."""
    focal_length: float | None = None
    """Calibrated focal length [px]; None: that of the camera."""
    others: tuple[tuple[str, float], ...] = ()
    """Names and values of other parameters of optical models that are not 0, sorted by name."""

    @classmethod
    def given(cls, values: Mapping[str, float], **known: Any) -> Knobs:
        """Return parameters with ``known`` fields, and the other parameters of optical models among the ``values``."""
        return cls(**known).with_values({name: values[name] for name in OTHERS if name in values})

    def value(self, name: str) -> float | None:
        """Return the value of a parameter; None if it is not known and has no slider."""
        if name not in OTHERS:
            known: float | None = getattr(self, name)
            return known
        return dict(self.others).get(name, 0.0 if name in SLIDING else None)

    def with_values(self, values: Mapping[str, float]) -> Knobs:
        """Return the parameters with other values of some of them."""
        others = dict(self.others) | {name: value for name, value in values.items() if name in OTHERS}
        fields: dict[str, Any] = {name: value for name, value in values.items() if name not in OTHERS}
        return replace(self, **fields, others=tuple(sorted((n, v) for n, v in others.items() if v)))

    @property
    def calibrated_only(self) -> dict[str, float]:
        """Parameters by name that the page cannot change, and that a calibration or the known truth gave."""
        found = {name: self.value(name) for name in (*(n for n in OTHERS if n not in SLIDING), "focal_length")}
        return {name: value for name, value in found.items() if value is not None}


OTHERS = {name: p for name, p in optical_parameters().items() if name not in (*size_names(), PHASE.name)}
"""Parameters of the optical models but for sizes and phase, by name."""
SLIDING = {name: p for name, p in OTHERS.items() if p.label}
"""Those among :data:`OTHERS` that have a slider."""
CURVE_HALF_WIDTH = {
    "apex": math.radians(0.4), "phase": math.radians(30.0), "clock_offset": 5000.0, "rpm": 6.0,
    **{name: p.half_range for name, p in SLIDING.items()},
}  # fmt: skip
"""Half width of the range of each parameter over which its sharpness curve is drawn, in the parameter's unit."""


@dataclass(frozen=True)
class Selection:
    """Conditions for the events that are shown."""

    polarity: int | None = None
    """Polarity of the shown events: 1 for only ON, 0 for only OFF, None for both."""
    region: Region | None = None
    """Region of the image: left, top, right and bottom [px], right and bottom exclusive. None: the whole image."""
    hide_hot: bool = False
    """Whether the events of hot pixels are left out."""
    noise_us: int | None = None
    """Time within which an earlier event at a neighbouring pixel must support an event [us]; None: no noise filter."""


# Time windows of the inspector: their selected events, and what the page shows of them.


@dataclass(frozen=True, eq=False)
class WindowAngles:
    """Prism angles of a window's events, without the clock offset that is set on the page."""

    on_device: UploadedEvents
    """Events of the images, on the device."""
    theta: NDArray[np.float64]
    """Prism angles of the drawn events [rad], shape ``(n,)``."""
    speed: NDArray[np.float64]
    """Speed of the prism at the drawn events [rad/us], shape ``(n,)``."""


@dataclass(frozen=True, eq=False)
class LoadedWindow:
    """Selected events of a window, in memory and on the device, and their image without compensation."""

    span: Span
    """Time window, with all events that were read from it."""
    region: Region
    """Part of the image that is shown."""
    selected: int
    """Number of events of the selection."""
    drawn: Events
    """Selected events that are drawn as points."""
    truth: DrawnTruth
    """Ground truth of the drawn events."""
    xy: NDArray[np.float32]
    """Pixels of the drawn events [px], shape ``(n, 2)``."""
    events: Events
    """Events of the images: the selected events, and those near the region that compensation may move into it."""
    curve_events: Events
    """Part of these events from which the sharpness curve is computed."""
    angles: dict[float, WindowAngles] = field(default_factory=dict)
    """Prism angles by the speed of a prism without encoder [1/min]; with an encoder, the only key is 0."""
    unmoved: list[MeasuredImage] = field(default_factory=list)
    """Image of the events as recorded, once it is measured."""
    chosen: list[Picture] = field(default_factory=list)
    """Reconstructed picture for which the weight of the smoothness prior was chosen last."""


@dataclass(frozen=True, eq=False)
class DisplayedWindow:
    """Time window shown with the current parameters: images of all events, and points of evenly spaced events."""

    span: Span
    """Time window, with all events that were read from it."""
    region: Region
    """Part of the image that is shown: left, top, right and bottom [px]; right and bottom are exclusive."""
    selected: int
    """Number of selected events, which are all in the images."""
    events: Events
    """Events that are drawn as points."""
    truth: DrawnTruth
    """Ground truth of these events."""
    before: NDArray[np.float32]
    """Pixels of the drawn events as recorded [px], shape ``(n, 2)``."""
    after: NDArray[np.float32]
    """Compensated positions of the drawn events [px], shape ``(n, 2)``; NaN if the model has no solution."""
    theta: NDArray[np.float64]
    """Prism angles of the drawn events [rad], from 0 to 2π, shape ``(n,)``."""
    image_before: NDArray[np.float32]
    """Image of the events as recorded [events per pixel], shape ``(height, width)``."""
    image_after: NDArray[np.float32]
    """Image of the compensated events [events per pixel], shape ``(height, width)``."""
    sharpness_before: float
    """Sharpness of ``image_before`` in the region: 0 for events at random, whatever their number."""
    sharpness_after: float
    """Sharpness of ``image_after`` in the region."""


# Selected events of a time window, on the host and with their prism angles on the device.

MOST_POINTS = 100_000
"""Largest number of points in each event cloud."""
CURVE_EVENTS = 200_000
"""Largest number of events that a sharpness curve uses."""


def load_window(
    recording: Recording, span: Span, selection: Selection, *, margin_px: int, hot: NDArray[np.bool_] | None
) -> LoadedWindow:
    """Select the events of a time window.

    ``margin_px``: how far outside the region events belong to its images. ``hot``: the hot pixels to leave out.
    Raises :class:`AmiwarpError` if no event meets the selection.
    """
    region = selection.region or (0, 0, *recording.events.size)
    left, top, right, bottom = region
    wide = (left - margin_px, top - margin_px, right + margin_px, bottom + margin_px)
    keep = kept(recording, span.events, selection, wide, hot)
    near = None if keep.all() else np.flatnonzero(keep)  # None stands for all
    events = span.events if near is None else span.events[near]
    within = np.flatnonzero(inside(events, region)) if selection.region else None
    n = len(events) if within is None else len(within)
    if not n:
        what = "no events" if not len(span.events) else f"{span.count:,} events, none of them selected,"
        raise AmiwarpError(f"{what} from {(span.start_us - recording.events.t_first) * 1e-3:.3f} ms on for "
                           f"{span.length_us * 1e-3:.3f} ms; take another window")  # fmt: skip
    thin = np.arange(min(n, MOST_POINTS)) * n // min(n, MOST_POINTS)
    thin = thin if within is None else within[thin]
    drawn, truth = events[thin], DrawnTruth(recording.truth, span, thin if near is None else near[thin])
    xy = np.stack([drawn.x, drawn.y], axis=1).astype(np.float32)
    curve_events = events[:: max(1, -(-len(events) // CURVE_EVENTS))]
    return LoadedWindow(span, region, n, drawn, truth, xy, events, curve_events)


def kept(
    recording: Recording, events: Events, selection: Selection, region: Region, hot: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """Return whether each event meets the selection, with another region, shape ``(n,)``."""
    keep = np.ones(len(events), np.bool_)
    if recording.encoder is not None:
        first, last = recording.encoder.coverage
        keep &= (events.t >= first) & (events.t <= last)
    if selection.polarity is not None:
        keep &= events.p == selection.polarity
    if selection.region is not None:
        keep &= inside(events, region)
    if hot is not None:
        keep &= ~hot[events.y, events.x]
    if selection.noise_us is not None:
        keep &= ~find_background_activity(events, recording.events.size, window_us=selection.noise_us)
    return keep


def inside(events: Events, region: Region) -> NDArray[np.bool_]:
    """Return whether each event lies in a region, shape ``(n,)``."""
    left, top, right, bottom = region
    return (events.x >= left) & (events.x < right) & (events.y >= top) & (events.y < bottom)
