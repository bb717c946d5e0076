"""Selected events of a time window, on the host and with their prism angles on the device."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.imaging.background_activity import find_background_activity
from amiwarp.imaging.device_events import upload_events
from amiwarp.viewer.drawn_truth import DrawnTruth
from amiwarp.viewer.window import LoadedWindow

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.events.recording import Recording
    from amiwarp.imaging.device_events import UploadedEvents
    from amiwarp.optics.camera import Camera
    from amiwarp.optics.prism import Prism
    from amiwarp.viewer.imager import Region
    from amiwarp.viewer.parameters import Selection
    from amiwarp.viewer.timeline import Span

MOST_POINTS = 100_000
"""Largest number of points in each event cloud."""
CURVE_EVENTS = 200_000
"""Largest number of events that a sharpness curve uses."""
LARGEST_APEX = math.radians(3.0)
"""Apex angle up to which events that move into the region are in its images, if the nominal apex is smaller [rad]."""


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


def upload(events: Events, encoder: Encoder, device: Any, *, drifting: bool) -> UploadedEvents:
    """Upload events with their prism angles.

    ``drifting``: whether the clock offset of the encoder can be changed afterwards.
    """
    return upload_events(events, encoder, device, slope=encoder.speed_at(events.t) * 1e-6 if drifting else None)


def margin(camera: Camera, prism: Prism) -> int:
    """Return how far a prism may move events [px]: the margin around a region."""
    largest = replace(prism, apex=max(LARGEST_APEX, 2.0 * abs(prism.apex)))
    return math.ceil(1.2 * math.tan(abs(largest.deflection)) * max(camera.fx, camera.fy))


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
