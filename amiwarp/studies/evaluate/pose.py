"""Evaluation of human pose over the rate of the pictures, with an adapter for detectors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.studies.evaluate.blob_detector import blob_keypoints
from amiwarp.studies.evaluate.conditions import Condition, Streams
from amiwarp.studies.evaluate.measures.keypoints import detected_joints
from amiwarp.studies.evaluate.measures.masks import box_overlap
from amiwarp.studies.evaluate.measures.pictures import displayed
from amiwarp.studies.evaluate.results import (
    CellResult,
    Chart,
    Claim,
    Settings,
    Table,
    Verdict,
    grouped,
    rows_of,
    wide_focal,
)
from amiwarp.studies.evaluate.stream_pictures import PictureMaker, Window, reconstructed_streams

if TYPE_CHECKING:
    from amiwarp.events.truth import FrameTruth
    from amiwarp.optics.camera import Camera

Detector = Callable[[NDArray[Any]], Mapping[str, NDArray[Any]]]
"""Function that returns the joints (x, y) [px] by name in a grey picture with values from 0 to 255; missing ones are
left out. The names are those of the world's joints."""

TITLE = "Human pose"
PROTOCOL = (
    "Our own reconstruction makes pictures at several rates, each from a window as long as the interval between "
    "pictures, but at least a quarter turn. A detector finds the joints of the walking figure in a picture. They hold "
    "until the next picture, and are compared with the true joints at three times in between: the share of detected "
    "joints (PDJ: closer than 0.2 torso diameters) and the intersection over union (IoU) of the joints' bounding "
    "boxes. 'blob' is a heuristic that only checks the plumbing; its numbers say nothing about pose estimation. 'true "
    "joints' are the joints in the middle of the window, so they show the effect of window and rate alone."
)
DIFFERENCES = (
    "The paper uses a pose network on pictures of people. No weights are part of amiwarp: give a detector to "
    "`amiwarp.studies.evaluate.pose.measure`."
)
VERSION = 1
NEEDS_TRUTH = True

RATES_HZ = (10.0, 30.0, 100.0, 300.0, 1000.0)
"""Rates of the pictures [1/s]."""
LEAST_TURNS = 0.25
"""Shortest window [turns]."""
HOLD = (0.0, 0.5, 1.0)
"""Times at which a picture's joints are compared, from its completion, as shares of the interval."""
QUICK_PICTURES, FULL_PICTURES = 1, 4
"""Number of pictures at each rate."""
TORSO = ("left shoulder", "right hip")
"""Joints whose distance is the torso's diameter."""


def conditions(settings: Settings) -> list[Condition]:
    """Return the walking figure before a moving camera. The lens sees the whole figure."""
    return settings.conditions(world="person", trajectory="handheld", focal_px=wide_focal(settings))


def measure(streams: Streams, settings: Settings, detectors: Mapping[str, Detector] | None = None) -> dict[str, Any]:
    """Return PDJ and IoU for each stream, detector and rate.

    ``detectors``: detectors by name, which are judged next to our check of the plumbing.
    """
    found: dict[str, Detector] = {"blob": blob_keypoints, **(detectors or {})}
    rows: list[dict[str, Any]] = []
    for rate in RATES_HZ:
        chosen = windows(streams, rate, QUICK_PICTURES if settings.quick else FULL_PICTURES)
        for window in chosen:
            now = image_joints(streams.frame(window.middle_us), streams.camera)
            rows += _rows(streams, window, rate, now, {"stream": "truth", "detector": "true joints"})
        for stream in reconstructed_streams(streams):
            maker = PictureMaker(streams, stream)
            for window, picture in zip(chosen, maker.pictures(chosen), strict=True):
                for name, detect in found.items():
                    joints = detect(displayed(picture))
                    rows += _rows(streams, window, rate, joints, {"stream": stream.value, "detector": name})
    return {"rows": rows}


def windows(streams: Streams, rate_hz: float, count: int) -> list[Window]:
    """Return windows of pictures at a rate, whose joints hold until the recording's end at the latest."""
    interval = round(1e6 / rate_hz)
    length = max(interval, round(LEAST_TURNS * 60e6 / streams.condition.rpm))
    ends = np.arange(streams.start_us + length, streams.end_us - interval + 1, interval)
    if not len(ends):
        return []
    chosen = np.unique(np.linspace(0, len(ends) - 1, min(count, len(ends)) + 2).round().astype(np.int64)[1:-1])
    return [Window(int(ends[k]) - length, int(ends[k])) for k in chosen]


def image_joints(truth: FrameTruth, camera: Camera) -> dict[str, NDArray[np.float64]]:
    """Return the true joints [px] by name; NaN outside the view."""
    if not truth.joints:
        raise AmiwarpError("the world has no joints, so a pose cannot be judged; use the world 'person'")
    places = np.stack([(at - truth.position) @ truth.rotation for at in truth.joints.values()])
    xy = np.asarray(camera.rays_to_pixels(places), np.float64)
    size = np.array([camera.width, camera.height])
    xy[~((xy > -0.5) & (xy < size - 0.5)).all(axis=1)] = np.nan
    return dict(zip(truth.joints, xy, strict=True))


def _rows(
    streams: Streams, window: Window, rate: float, joints: Mapping[str, NDArray[Any]], known: dict[str, Any]
) -> list[dict[str, Any]]:
    """Return the scores of joints at the times until the next picture."""
    rows = []
    for share in HOLD:
        t_us = min(window.end_us + round(share * 1e6 / rate), streams.end_us)
        truth = image_joints(streams.frame(t_us), streams.camera)
        pdj, iou = pose_scores(joints, truth)
        rows.append({**known, "rate": rate, "pdj": pdj, "iou": iou})
    return rows


def pose_scores(
    found: Mapping[str, NDArray[Any]], truth: Mapping[str, NDArray[Any]]
) -> tuple[float | None, float | None]:
    """Return PDJ and IoU of joints by name; None if the torso is not in view."""
    torso = float(np.hypot(*(truth[TORSO[0]] - truth[TORSO[1]])))
    if not np.isfinite(torso):
        return None, None
    nowhere = np.full(2, np.nan)
    places = np.stack([np.asarray(found.get(name, nowhere), np.float64) for name in truth])
    true = np.stack(list(truth.values()))
    return detected_joints(places, true, torso), box_overlap(places, true)


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return PDJ and IoU over the rate of the pictures."""
    names = ("scene", "camera", "detector", "stream", "rate")
    columns = ("scene", "camera", "detector", "stream", "rate [1/s]", "comparisons", "PDJ", "std of PDJ", "IoU",
               "std of IoU")  # fmt: skip
    caption = "'blob' checks the plumbing only. 'true joints' show the effect of window and rate alone."
    rows = grouped(rows_of(results, "rows"), names, ["pdj", "iou"])
    chart = Chart("rate [1/s]", "PDJ", "stream", "std of PDJ", panels=("scene", "camera", "detector"), log_x=True)
    return [Table("pose", "Detected joints over the rate of the pictures", columns, rows, caption, chart)]


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return that the paper's claim cannot be tested without a pose network."""
    return [Claim("Pose is better with the AMI-EV, above all at high picture rates.", "curves of PDJ and IoU", "–",
                  Verdict.NOT_TESTABLE, "needs a pose network, and no weights are part of amiwarp")]  # fmt: skip
