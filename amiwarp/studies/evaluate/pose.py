"""Evaluation of human pose over the rate of the pictures, with an adapter for detectors."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from amiwarp.errors import AmiwarpError
from amiwarp.simulation.worlds.world import WorldScene
from amiwarp.studies.evaluate import study
from amiwarp.studies.evaluate.claims import Claim, untestable
from amiwarp.studies.evaluate.pictures import PictureMaker, Window, reconstructed_streams
from amiwarp.studies.evaluate.study import CellResult, Chart, Condition, Settings, Stream, Streams, Table

# Detector of a figure's joints that only checks the plumbing of the pose evaluation. It is no pose estimator.

PROPORTIONS: dict[str, tuple[float, float]] = {
    "head": (0.5, 0.07),
    "left shoulder": (0.35, 0.2), "right shoulder": (0.65, 0.2),
    "left elbow": (0.3, 0.37), "right elbow": (0.7, 0.37),
    "left wrist": (0.3, 0.5), "right wrist": (0.7, 0.5),
    "left hip": (0.42, 0.48), "right hip": (0.58, 0.48),
    "left knee": (0.42, 0.72), "right knee": (0.58, 0.72),
    "left ankle": (0.42, 0.94), "right ankle": (0.58, 0.94),
}  # fmt: skip
"""Place of each joint in the bounding box of a standing figure, as shares of its width and height from the top left."""


def blob_keypoints(picture: NDArray[Any]) -> dict[str, NDArray[np.float64]]:
    """Return joints [px] by name, in fixed proportions of the bounding box of the picture's largest blob.

    The blob is the largest connected region whose smoothed distance from the median exceeds half its maximum. This
    checks the plumbing only: the joints of a real figure are elsewhere, and in a textured scene the blob is often
    another object. A uniform picture has no joints.
    """
    distance = ndimage.gaussian_filter(np.abs(picture - np.median(picture)).astype(np.float64), 1.0)
    if not distance.max() > 0.0:
        return {}
    label, count = ndimage.label(distance > 0.5 * distance.max())
    largest = 1 + int(np.argmax(ndimage.sum_labels(np.ones_like(distance), label, np.arange(1, count + 1))))
    rows, columns = ndimage.find_objects(label)[largest - 1]
    low = np.array([columns.start, rows.start], np.float64)
    size = np.array([columns.stop - columns.start - 1, rows.stop - rows.start - 1], np.float64)
    return {name: low + size * np.array(share) for name, share in PROPORTIONS.items()}


Detector = Callable[[NDArray[Any]], Mapping[str, NDArray[Any]]]
"""Function that returns the joints (x, y) [px] by name in a grey picture with values from 0 to 255; missing ones are
left out. The names are those of the world's joints."""


# Accuracy of detected joints.


def detected_joints(found: NDArray[Any], truth: NDArray[Any], torso_px: float, *, fraction: float = 0.2) -> float:
    """Return the percentage of detected joints (PDJ), as a share from 0 to 1.

    A joint counts as detected if it is closer to its true place than ``fraction`` of the torso's diameter. ``found``
    and ``truth``: joints in the same order [px], shape (n, 2). A joint that was not found is NaN and counts as not
    detected. True joints that are NaN, as outside the view, do not count. The result is NaN if no true joint counts.

    Source: B. Sapp and B. Taskar, "MODEC: Multimodal Decomposable Models for Human Pose Estimation", CVPR 2013; the
    diameter is the distance from the left shoulder to the right hip.
    Raises :class:`AmiwarpError` for different shapes.
    """
    if found.shape != truth.shape or truth.ndim != 2 or truth.shape[1] != 2:
        raise AmiwarpError(f"found and true joints have shapes {found.shape} and {truth.shape}; give (n, 2) twice")
    known = np.isfinite(truth).all(axis=1)
    if not known.any():
        return float("nan")
    distance = np.hypot(*(found[known] - truth[known]).T)
    return float((distance < fraction * torso_px).mean())  # a comparison with NaN is false


def box_overlap(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Return the intersection over union of the bounding boxes of two point sets, shapes (n, 2) and (m, 2).

    Points that are not finite do not count. The result is 0 if a set has no points or a box has no area.
    """
    a, b = (points[np.isfinite(points).all(axis=1)] for points in (a, b))
    if not len(a) or not len(b):
        return 0.0
    low, high = np.stack([a.min(axis=0), b.min(axis=0)]), np.stack([a.max(axis=0), b.max(axis=0)])
    shared = float(np.prod(np.maximum(high.min(axis=0) - low.max(axis=0), 0.0)))
    union = float(np.prod(high - low, axis=1).sum()) - shared
    return shared / union if union > 0.0 else 0.0


# Evaluation.

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
FRACTION, FRACTIONS = 0.2, (0.05, 0.1, 0.2, 0.3, 0.5)
"""Distance at which a joint counts as detected [torso diameters], and the values of the sensitivity curve."""
FRACTION_HZ = 100.0
"""Rate of the pictures in that curve [1/s]."""
LEAST_TURNS = 0.25
"""Shortest window [turns]."""
HOLD = (0.0, 0.5, 1.0)
"""Times at which a picture's joints are compared, from its completion, as shares of the interval."""
QUICK_PICTURES, FULL_PICTURES = 1, 2
"""Number of pictures at each rate."""
TORSO = ("left shoulder", "right hip")
"""Joints whose distance is the torso's diameter."""


class _Row(TypedDict):
    stream: Literal["truth", *Stream]  # type: ignore[valid-type]
    detector: Literal["blob", "true joints"]
    rate: study.Amount
    pdj: study.Share | None
    iou: study.Share | None
    pdj_over_fraction: tuple[
        study.Share | None, study.Share | None, study.Share | None, study.Share | None, study.Share | None
    ]


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]


def conditions(settings: Settings) -> list[Condition]:
    """Return the walking figure before a moving camera. The lens sees the whole figure."""
    return settings.conditions(world="person", trajectory="handheld", focal_px=study.wide_focal(settings))


def measure(streams: Streams, settings: Settings, detectors: Mapping[str, Detector] | None = None) -> dict[str, Any]:
    """Return PDJ and IoU for each stream, detector and rate.

    ``detectors``: detectors by name, which are judged next to our check of the plumbing.
    """
    found: dict[str, Detector] = {"blob": blob_keypoints, **(detectors or {})}
    rows: list[dict[str, Any]] = []
    makers = {stream: PictureMaker(streams, stream) for stream in reconstructed_streams(streams)}
    for rate in RATES_HZ:
        chosen = windows(streams, rate, QUICK_PICTURES if settings.quick else FULL_PICTURES)
        for window in chosen:
            now = image_joints(streams, window.middle_us)
            rows += _rows(streams, window, rate, now, {"stream": "truth", "detector": "true joints"})
        for stream, maker in makers.items():
            for window, picture in zip(chosen, maker.pictures(chosen), strict=True):
                for name, detect in found.items():
                    joints = detect(study.displayed(picture))
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


def image_joints(streams: Streams, t_us: int) -> dict[str, NDArray[np.float64]]:
    """Return the true joints [px] at a time by name; NaN outside the view."""
    scene, camera = streams.simulation.scene, streams.camera
    if not isinstance(scene, WorldScene) or not scene.world.joints:
        raise AmiwarpError("the world has no joints, so a pose cannot be judged; use the world 'person'")
    t = [t_us * 1e-6]
    (rotation,), (position,) = scene.trajectory.poses(t)
    places = np.stack([path.poses(t)[1][0] for path in scene.world.joints.values()])
    xy = np.asarray(camera.rays_to_pixels((places - position) @ rotation), np.float64)
    size = np.array([camera.width, camera.height])
    xy[~((xy > -0.5) & (xy < size - 0.5)).all(axis=1)] = np.nan
    return dict(zip(scene.world.joints, xy, strict=True))


def _rows(
    streams: Streams, window: Window, rate: float, joints: Mapping[str, NDArray[Any]], known: dict[str, Any]
) -> list[dict[str, Any]]:
    """Return the scores of joints at the times until the next picture."""
    rows = []
    for share in HOLD:
        t_us = min(window.end_us + round(share * 1e6 / rate), streams.end_us)
        truth = image_joints(streams, t_us)
        pdj, iou = pose_scores(joints, truth)
        rows.append({**known, "rate": rate, "pdj": pdj[FRACTION], "iou": iou,
                     "pdj_over_fraction": [pdj[f] for f in FRACTIONS]})  # fmt: skip
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
    return {f: detected_joints(places, true, torso, fraction=f) for f in FRACTIONS}, box_overlap(places, true)


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return PDJ and IoU over the rate of the pictures, and the PDJ over its threshold."""
    names = ("scene", "camera", "detector", "stream")
    caption = "'blob' checks the plumbing only. 'true joints' show the effect of window and rate alone."
    rows = study.rows_of(results, "rows")
    spread = [{**r, "fraction": f, "pdj": pdj} for r in rows if r["rate"] == FRACTION_HZ
              for f, pdj in zip(FRACTIONS, r["pdj_over_fraction"], strict=True)]  # fmt: skip

    def chart(x: str) -> Chart:
        return Chart(x, "PDJ", "stream", "std of PDJ", panels=("scene", "camera", "detector"), log_x=x[0] == "r")

    return [
        Table("pose", "Detected joints over the rate of the pictures",
              (*names, "rate [1/s]", "comparisons", "PDJ", "std of PDJ", "IoU", "std of IoU"),
              study.grouped(rows, (*names, "rate"), ["pdj", "iou"]), caption, chart("rate [1/s]")),
        Table("pose_threshold", f"Detected joints over the threshold, {FRACTION_HZ:g} pictures/s",
              (*names, "threshold [torso diameters]", "comparisons", "PDJ", "std of PDJ"),
              study.grouped(spread, (*names, "fraction"), ["pdj"]), caption, chart("threshold [torso diameters]")),
    ]  # fmt: skip


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return that the paper's claim cannot be tested without a pose network."""
    return [untestable(9, "Pose is better with the AMI-EV, above all at high picture rates.",
                       "the paper's comparison needs a network that makes pictures (E2VID) and one that finds poses "
                       "(OpenPifPaf), trained on pictures of people; no weights are part of amiwarp, and the figure of "
                       "the world has no looks of a person")]  # fmt: skip
