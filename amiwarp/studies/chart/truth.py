"""Ground truth of the charts: the recording's true parameters, and the exact model in float64."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from amiwarp.calib import Calibration
from amiwarp.errors import AmiwarpError
from amiwarp.events.events import MemoryEvents
from amiwarp.events.recording import Recording
from amiwarp.imaging.metrics import truth_model
from amiwarp.optics.exact_model import axis_rotation
from amiwarp.optics.prism import FlatSide

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.encoder import Encoder
    from amiwarp.events.events import Events
    from amiwarp.optics.camera import Camera
    from amiwarp.optics.exact_model import ExactModel

MOST_EVENTS = 20_000_000
"""Largest number of events that are taken from the start of the recording, because they are held in memory."""
NEEDED = ("apex", "index", "phase")
"""Parameters that the ground truth must contain."""
PIECE = 1 << 20
"""Number of events that are processed at a time."""


@dataclass(frozen=True, eq=False)
class KnownRecording:
    """Recording in memory with its ground truth."""

    recording: Recording
    """Recording, which is held in memory."""
    events: Events
    """Events of the recording."""
    camera: Camera
    """Camera intrinsics."""
    encoder: Encoder
    """Encoder with the true clock offset."""
    model: ExactModel
    """Optical model with the true parameters."""

    @classmethod
    def of(cls, recording: Recording) -> KnownRecording:
        """Load a recording. Raises :class:`AmiwarpError` if it lacks camera, encoder, prism or ground truth."""
        truth, camera, encoder = recording.truth, recording.camera, recording.encoder
        if truth is None or not set(NEEDED) <= set(truth.parameters):
            raise AmiwarpError(
                f"{recording.name}: has no ground truth (apex, index, phase); create a recording with: amiwarp simulate"
            )
        if camera is None or encoder is None or recording.prism is None:
            raise AmiwarpError(
                f"{recording.name}: lacks camera, encoder or prism; create a recording with: amiwarp simulate"
            )
        events = recording.events.slice(0, MOST_EVENTS)
        if not len(events) or events.x.dtype != np.uint16:
            raise AmiwarpError(
                f"{recording.name}: has no sensor events (uint16); give a recording that is not compensated"
            )
        held = Recording(
            MemoryEvents(events, *recording.events.size), camera, encoder, recording.prism, truth, {}, recording.name
        )
        model = truth_model(camera, truth, recording.prism.flat_side)
        return cls(held, events, camera, encoder.with_clock_offset(truth.parameters.get("clock_offset_us", 0.0)), model)

    def calibration(self) -> Calibration:
        """Return the calibration with the true parameters."""
        tilt_x, tilt_y = self.model.tilt
        tilts = {"tilt_x": tilt_x, "tilt_y": tilt_y} if tilt_x or tilt_y else {}
        prism = self.model.prism
        values = {"apex": prism.apex, "phase": self.model.phase, "clock_offset": self.encoder.clock_offset_us, **tilts}
        return Calibration(
            model_name="exact", camera=self.camera, prism=prism, parameters=values, uncertainty={}, free=(),
            sharpness_name="variance", sharpness_before=0.0, sharpness_after=0.0, stages=(),
            events=len(self.events), seconds=0.0,
        )  # fmt: skip


def exact_places(model: ExactModel, xy: NDArray[np.float64], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the compensated positions of events [px], in float64; NaN for events without a position.

    ``xy`` (n, 2) [px] are the recorded positions, ``theta`` (n,) [rad] the prism angles. The closed form is that of
    ``docs/explanation/optics.md``. Lens distortion is computed in float32, within 3e-4 px.
    """
    prism, camera = model.prism, model.camera
    axis = axis_rotation(*model.tilt)
    ray = _rays(camera, xy) @ axis
    w = np.stack([np.cos(theta + model.phase), np.sin(theta + model.phase)], axis=1)
    sine, cosine, n2 = math.sin(prism.apex), math.cos(prism.apex), prism.index**2
    along = sine * np.sum(w * ray[:, :2], axis=1)
    with np.errstate(invalid="ignore"):
        if prism.flat_side is FlatSide.SCENE:
            q = along + cosine * ray[:, 2]
            shift = np.sqrt(n2 - 1.0 + q**2) - q
        else:
            q = along + cosine * np.sqrt(n2 - 1.0 + ray[:, 2] ** 2)
            shift = np.sqrt(1.0 - n2 + q**2) - q
        out = ray[:, :2] + (shift * sine)[:, None] * w
        ahead = np.sqrt(1.0 - np.sum(out**2, axis=1))
    return _pixels(camera, np.column_stack([out, ahead]) @ axis.T)


def _rays(camera: Camera, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit bearing vectors of pixels."""
    if camera.distortion is not None:
        return camera.pixels_to_rays(xy)
    ray = np.column_stack([(xy - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(xy))])
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def _pixels(camera: Camera, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pixels of bearing vectors."""
    if camera.distortion is not None:
        return camera.rays_to_pixels(rays)
    with np.errstate(invalid="ignore", divide="ignore"):
        tangent = np.where(rays[:, 2:] > 0.0, rays[:, :2] / rays[:, 2:], np.nan)
    return np.asarray(tangent * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def raw_places(events: Events) -> NDArray[np.float64]:
    """Return the recorded positions of events [px], shape ``(n, 2)``."""
    return np.stack([events.x, events.y], axis=1).astype(np.float64)


def exact_image(known: KnownRecording) -> NDArray[np.float64]:
    """Return the image of all events with bilinear votes at their exact positions, computed in float64.

    The values are numbers of events, shape ``(height, width)``.
    """
    width, height = known.camera.width, known.camera.height
    image = np.zeros((height + 1) * (width + 1) + 1)
    for start in range(0, len(known.events), PIECE):
        piece = known.events[start : start + PIECE]
        places = exact_places(known.model, raw_places(piece), known.encoder.angle_at(piece.t))
        places = places[np.isfinite(places).all(axis=1)]
        low = np.floor(places)
        share = places - low
        for dx in (0, 1):
            for dy in (0, 1):
                at = low + np.array((dx, dy))
                inside = ((at >= 0) & (at < (width, height))).all(axis=1)
                weight = np.abs(1 - dx - share[inside, 0]) * np.abs(1 - dy - share[inside, 1])
                index = (at[inside, 1] * width + at[inside, 0]).astype(np.int64)
                image += np.bincount(index, weight, len(image))
    return image[: width * height].reshape(height, width)


def rms(distance: NDArray[np.float64]) -> float:
    """Return the root mean square length [px] of rows ``(n, 2)``; rows that are not finite are left out."""
    finite = distance[np.isfinite(distance).all(axis=1)]
    if not len(finite):
        raise AmiwarpError(
            "no event has a finite position in both models; check that the ground truth belongs to the recording"
        )
    return float(np.sqrt(np.mean(np.sum(finite**2, axis=1))))
