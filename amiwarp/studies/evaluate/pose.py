"""Evaluation of human pose over the rate of the pictures, with an adapter for detectors."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.studies.evaluate.claims import Claim, untestable
from amiwarp.studies.evaluate.conditions import Condition, Settings, wide_focal
from amiwarp.studies.evaluate.joints import Detector, blob_keypoints, box_overlap, detected_joints
from amiwarp.studies.evaluate.pictures import PictureMaker, Window, reconstructed_streams
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    Share,
    Table,
    grouped,
    rows_of,
)
from amiwarp.studies.evaluate.similarity import displayed
from amiwarp.studies.evaluate.streams import Stream, Streams

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
VERSION = 2
NEEDS_TRUTH = True

RATES_HZ = (10.0, 30.0, 100.0, 300.0, 1000.0)
"""Rates of the pictures [1/s]."""
FRACTION = 0.2
"""Distance at which a joint counts as detected [torso diameters]."""
FRACTIONS = (0.05, 0.1, 0.2, 0.3, 0.5)
"""The distances of the sensitivity curve."""
FRACTION_HZ = 100.0
"""Rate of the pictures in that curve [1/s]."""
LEAST_TURNS = 0.25
"""Shortest window [turns]."""
HOLD = (0.0, 0.5, 1.0)
"""Times at which a picture's joints are compared, from its completion, as shares of the interval."""
QUICK_PICTURES = 1
FULL_PICTURES = 2
"""Number of pictures at each rate."""
TORSO = ("left shoulder", "right hip")
"""Joints whose distance is the torso's diameter."""


class _Row(TypedDict):
    stream: Literal["truth", *Stream]  # type: ignore[valid-type]
    detector: Literal["blob", "true joints"]
    rate: Amount
    pdj: Share | None
    iou: Share | None
    pdj_over_fraction: tuple[
        Share | None,
        Share | None,
        Share | None,
        Share | None,
        Share | None,
    ]


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]


def conditions(settings: Settings) -> list[Condition]:
    """Return the walking figure before a moving camera. The lens sees the whole figure."""
    return settings.conditions(world="person", trajectory="handheld", focal_px=wide_focal(settings))


def measure(
    streams: Streams, settings: Settings, detectors: Mapping[str, Detector] | None = None
) -> dict[str, Any]:
    """Return PDJ and IoU for each stream, detector and rate.

    ``detectors``: detectors by name, which are judged next to our check of the plumbing.
    """
    all_detectors: dict[str, Detector] = {"blob": blob_keypoints, **(detectors or {})}
    rows: list[dict[str, Any]] = []
    makers = {stream: PictureMaker(streams, stream) for stream in reconstructed_streams(streams)}
    for rate in RATES_HZ:
        chosen = windows(streams, rate, QUICK_PICTURES if settings.quick else FULL_PICTURES)
        known = {"stream": "truth", "detector": "true joints"}
        for window in chosen:
            rows += _rows(streams, window, rate, image_joints(streams, window.middle_us), known)
        for stream, maker in makers.items():
            for window, picture in zip(chosen, maker.pictures(chosen), strict=True):
                for name, detect in all_detectors.items():
                    known = {"stream": stream.value, "detector": name}
                    rows += _rows(streams, window, rate, detect(displayed(picture)), known)
    return {"rows": rows}


def windows(streams: Streams, rate_hz: float, count: int) -> list[Window]:
    """Return windows of pictures at a rate, whose joints hold until the recording's end at the latest."""
    interval = round(1e6 / rate_hz)
    length = max(interval, round(LEAST_TURNS * 60e6 / streams.condition.rpm))
    ends = np.arange(streams.start_us + length, streams.end_us - interval + 1, interval)
    if not len(ends):
        return []
    # Evenly spread, without the first and the last
    spread = np.linspace(0, len(ends) - 1, min(count, len(ends)) + 2).round().astype(np.int64)
    chosen = [int(end) for end in ends[np.unique(spread[1:-1])]]
    return [Window(end - length, end) for end in chosen]


def image_joints(streams: Streams, t_us: int) -> dict[str, NDArray[np.float64]]:
    """Return the true joints [px] at a time by name; NaN outside the view."""
    scene = streams.simulation.scene
    camera = streams.camera
    if not isinstance(scene, WorldScene) or not scene.world.joints:
        raise AmiwarpError(
            "the world has no joints, so a pose cannot be judged; use the world 'person'",
            ErrorCode.CONTENT_MISSING,
        )
    t = [t_us * 1e-6]
    rotations, positions = scene.trajectory.poses(t)
    rotation = rotations[0]
    position = positions[0]
    places = np.stack([path.poses(t)[1][0] for path in scene.world.joints.values()])
    xy = np.asarray(camera.rays_to_pixels((places - position) @ rotation), np.float64)
    size = np.array([camera.width, camera.height])
    in_view = ((xy > -0.5) & (xy < size - 0.5)).all(axis=1)
    xy[~in_view] = np.nan
    return dict(zip(scene.world.joints, xy, strict=True))


def _rows(
    streams: Streams,
    window: Window,
    rate: float,
    joints: Mapping[str, NDArray[Any]],
    known: dict[str, Any],
) -> list[dict[str, Any]]:
    """Return the scores of joints at the times until the next picture."""
    rows = []
    for share in HOLD:
        t_us = min(window.end_us + round(share * 1e6 / rate), streams.end_us)
        truth = image_joints(streams, t_us)
        pdj, iou = pose_scores(joints, truth)
        row = {**known, "rate": rate, "pdj": pdj[FRACTION], "iou": iou}
        row["pdj_over_fraction"] = [pdj[fraction] for fraction in FRACTIONS]
        rows.append(row)
    return rows


def pose_scores(
    found: Mapping[str, NDArray[Any]], truth: Mapping[str, NDArray[Any]]
) -> tuple[dict[float, float | None], float | None]:
    """Return the PDJ for each of :data:`FRACTIONS`, and the IoU; None if the torso is not in view."""
    torso = float(np.hypot(*(truth[TORSO[0]] - truth[TORSO[1]])))
    if not np.isfinite(torso):
        return dict.fromkeys(FRACTIONS), None
    nowhere = np.full(2, np.nan)
    places = np.stack([np.asarray(found.get(name, nowhere), np.float64) for name in truth])
    true = np.stack(list(truth.values()))
    pdj: dict[float, float | None] = {}
    for fraction in FRACTIONS:
        pdj[fraction] = detected_joints(places, true, torso, fraction=fraction)
    return pdj, box_overlap(places, true)


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return PDJ and IoU over the rate of the pictures, and the PDJ over its threshold."""
    names = ("scene", "camera", "detector", "stream")
    caption = (
        "'blob' checks the plumbing only. 'true joints' show the effect of window and rate alone."
    )
    rows = rows_of(results, "rows")
    spread = []
    for row in rows:
        if row["rate"] == FRACTION_HZ:
            for fraction, pdj in zip(FRACTIONS, row["pdj_over_fraction"], strict=True):
                spread.append({**row, "fraction": fraction, "pdj": pdj})

    def chart(x: str, *, log_x: bool = False) -> Chart:
        panels = ("scene", "camera", "detector")
        return Chart(x, "PDJ", "stream", "std of PDJ", panels=panels, log_x=log_x)

    return [
        Table(
            "pose",
            "Detected joints over the rate of the pictures",
            (*names, "rate [1/s]", "comparisons", "PDJ", "std of PDJ", "IoU", "std of IoU"),
            grouped(rows, (*names, "rate"), ["pdj", "iou"]),
            caption,
            chart("rate [1/s]", log_x=True),
        ),
        Table(
            "pose_threshold",
            f"Detected joints over the threshold, {FRACTION_HZ:g} pictures/s",
            (*names, "threshold [torso diameters]", "comparisons", "PDJ", "std of PDJ"),
            grouped(spread, (*names, "fraction"), ["pdj"]),
            caption,
            chart("threshold [torso diameters]"),
        ),
    ]


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return that the paper's claim cannot be tested without a pose network."""
    return [
        untestable(
            9,
            "Pose is better with the AMI-EV, above all at high picture rates.",
            "the paper's comparison needs a network that makes pictures (E2VID) and one that finds poses "
            "(OpenPifPaf), trained on pictures of people; no weights are part of amiwarp, and the figure of "
            "the world has no looks of a person",
        )
    ]
