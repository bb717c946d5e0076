"""Ground truth of the charts: the recording's true parameters, and the exact model in float64."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.imaging.metrics import truth_model
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.exact import ExactModel, axis_rotation
from amiwarp.optics.prism import FlatSide, as_wedge
from amiwarp.results.calibration import Calibration

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
        truth = recording.truth
        camera = recording.camera
        encoder = recording.encoder
        if truth is None or not set(NEEDED) <= set(truth.parameters):
            raise AmiwarpError(
                f"{recording.name}: has no ground truth (apex, index, phase); "
                "create a recording with: amiwarp simulate",
                ErrorCode.CONTENT_MISSING,
            )
        if camera is None or encoder is None or recording.prism is None:
            raise AmiwarpError(
                f"{recording.name}: lacks camera, encoder or prism; create a recording with: amiwarp simulate",
                ErrorCode.CONTENT_MISSING,
            )
        events = recording.events.slice(0, MOST_EVENTS)
        if not len(events) or events.x.dtype != np.uint16:
            raise AmiwarpError(
                f"{recording.name}: has no sensor events (uint16); give a recording that is not compensated",
                ErrorCode.CONTENT_MISSING,
            )
        held = Recording(
            MemoryEvents(events, *recording.events.size),
            camera,
            encoder,
            recording.prism,
            truth,
            {},
            recording.name,
        )
        true_offset_us = truth.parameters.get("clock_offset_us", 0.0)
        true_encoder = encoder.with_clock_offset(true_offset_us)
        model = truth_model(camera, truth, as_wedge(recording.prism).flat_side)
        return cls(held, events, camera, true_encoder, model)

    def calibration(self) -> Calibration:
        """Return the calibration with the true parameters."""
        model = self.model
        prism = self.model.prism
        values = {
            "apex": prism.apex,
            "phase": model.phase,
            "clock_offset": self.encoder.clock_offset_us,
        }
        pairs = {"tilt": model.tilt, "cylinder": model.cylinder, "wobble": model.wobble}
        for name, (along_x, along_y) in pairs.items():
            if along_x or along_y:
                values[f"{name}_x"] = along_x
                values[f"{name}_y"] = along_y
        return Calibration(
            model_name="exact",
            camera=self.camera,
            prism=prism,
            parameters=values,
            uncertainty={},
            free=(),
            sharpness_name="variance",
            sharpness_before=0.0,
            sharpness_after=0.0,
            stages=(),
            events=len(self.events),
            seconds=0.0,
        )


def exact_places(
    model: ExactModel, xy: NDArray[np.float64], theta: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the compensated positions of events [px], in float64; NaN for events without a position.

    ``xy`` (n, 2) [px] are the recorded positions, ``theta`` (n,) [rad] the prism angles. The closed form stands in
    ``docs/explanation/optics.md``. Lens distortion is computed in float32, within 3e-4 px.
    """
    prism = model.prism
    camera = model.camera

    # Rays in the prism's frame
    axis = axis_rotation(*model.tilt)
    azimuth = theta + model.phase
    wedge = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    along_axis = _rays(camera, xy) @ axis
    ray = _tipped(model, along_axis, wedge, sign=-1.0)

    # Refraction at both faces
    sine, cosine, w = _local_slope(model, ray, wedge)
    n2 = prism.index**2
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

    behind = np.column_stack([out, ahead])
    bent = _tipped(model, behind, wedge, sign=1.0)
    return _pixels(camera, bent @ axis.T)


def _tipped(
    model: ExactModel, ray: NDArray[np.float64], wedge: NDArray[np.float64], sign: float
) -> NDArray[np.float64]:
    """Return bearing vectors out of the wobbling prism's frame (``sign`` 1), or into it (-1).

    ``wedge`` (n, 2) holds the (cos, sin) of the wedge's azimuths.
    """
    if not any(model.wobble):
        return ray
    from scipy.spatial.transform import Rotation

    x, y = model.wobble
    angle = sign * math.atan(math.hypot(x, y)) / math.hypot(x, y)
    w0, w1 = wedge.T
    # Z × the direction of the tip
    turns = np.column_stack([-(x * w1 + y * w0), x * w0 - y * w1, np.zeros(len(ray))])
    return np.asarray(Rotation.from_rotvec(angle * turns).apply(ray))


def _local_slope(
    model: ExactModel, ray: NDArray[np.float64], wedge: NDArray[np.float64]
) -> tuple[Any, Any, NDArray[np.float64]]:
    """Return sine and cosine of the apex angle, and its azimuth's (cos, sin), where rays meet the tilted face."""
    apex = model.prism.apex
    x, y = model.cylinder
    if not (x or y):
        return math.sin(apex), math.cos(apex), wedge
    # Place where the ray meets the face, along the wedge and across it
    across = np.column_stack([-wedge[:, 1], wedge[:, 0]])
    t = np.sum(ray[:, :2] * wedge, axis=1) / ray[:, 2]
    u = np.sum(ray[:, :2] * across, axis=1) / ray[:, 2]
    slope_along = math.tan(apex) + x * t + y * u
    slope_across = y * t - x * u
    slope = slope_along[:, None] * wedge + slope_across[:, None] * across
    steep = np.linalg.norm(slope, axis=1)
    angle = np.arctan(steep)
    azimuth = slope / np.maximum(steep, 1e-300)[:, None]
    return np.sin(angle), np.cos(angle), azimuth


def _rays(camera: Camera, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit bearing vectors of pixels."""
    if camera.distortion is not None:
        return camera.pixels_to_rays(xy)
    tangent = (xy - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    ray = np.column_stack([tangent, np.ones(len(xy))])
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
    width = known.camera.width
    height = known.camera.height
    # Longer than the image, because bincount returns a length that depends on the largest index.
    image = np.zeros((height + 1) * (width + 1) + 1)
    for start in range(0, len(known.events), PIECE):
        piece = known.events[start : start + PIECE]
        theta = known.encoder.angle_at(piece.t)
        places = exact_places(known.model, raw_places(piece), theta)
        places = places[np.isfinite(places).all(axis=1)]
        # Each event votes for the four pixels around it.
        top_left = np.floor(places)
        share = places - top_left
        for dx in (0, 1):
            for dy in (0, 1):
                pixel = top_left + np.array((dx, dy))
                inside = ((pixel >= 0) & (pixel < (width, height))).all(axis=1)
                column, row = pixel[inside].T
                share_x, share_y = share[inside].T
                weight = np.abs(1 - dx - share_x) * np.abs(1 - dy - share_y)
                index = (row * width + column).astype(np.int64)
                image += np.bincount(index, weight, len(image))
    return image[: width * height].reshape(height, width)


def rms(distance: NDArray[np.float64]) -> float:
    """Return the root mean square length [px] of rows ``(n, 2)``; rows that are not finite are left out."""
    finite = distance[np.isfinite(distance).all(axis=1)]
    if not len(finite):
        raise AmiwarpError(
            "no event has a finite position in both models; check that the ground truth belongs to the recording"
        )
    square = np.sum(finite**2, axis=1)
    return float(np.sqrt(np.mean(square)))
