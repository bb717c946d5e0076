"""Evaluation of the segmentation of a ball that is thrown before a moving camera."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Events
from amiwarp.optics.camera import Camera, CameraRotation
from amiwarp.studies.evaluate import study
from amiwarp.studies.evaluate.claims import Claim, differences, judge, untestable_as_stated
from amiwarp.studies.evaluate.flow import camera_flow, moving_instances, rotation_flow
from amiwarp.studies.evaluate.study import CellResult, Chart, Condition, Frames, Settings, Stream, Streams, Table

# Segmentation of moving bodies: what stays blurred after the camera's motion is compensated is clustered.
#
# The camera's rotation is that of the sharpest image of the events. A region is blurred if events agree much better
# under a further velocity in the image. The events of blurred regions are clustered in space and time by DBSCAN.


@dataclass(frozen=True, slots=True)
class SegmentationSettings:
    """Settings of the segmentation, for an image of 640 px; lengths scale with the width."""

    reach_px: float = 28.0
    """Largest motion of a body in a window, relative to the background [px]."""
    step_px: float = 2.5
    """Step of the velocities that are tried, times the window [px]."""
    least_px: float = 5.0
    """Least motion in a window that counts as the motion of a body [px]."""
    pool_px: float = 8.0
    """Standard deviation of the surrounding in which events are compared [px]."""
    gain: float = 1.5
    """Least agreement under a further velocity, relative to that without."""
    radius_px: float = 8.0
    """Radius of DBSCAN's neighbourhood [px]; a window lasts as long as five radii in its time axis."""
    density: float = 2.0
    """Least density of events around a core event, relative to that of all blurred events spread over the image."""
    least_share: float = 0.15
    """Least share of the blurred events in a cluster that counts as a body."""


MOST_CLUSTERED = 20_000
"""Largest number of events that are clustered; others belong to the cluster of the nearest of them."""
WINDOW_RADII = 5.0
"""Length of a window on the time axis of the clustering [radii]."""


def moving_events(events: Events, camera: Camera, settings: Sequence[SegmentationSettings]) -> list[NDArray[np.intp]]:
    """Return the number of the moving body that each event of a short window belongs to, shape (n,).

    The numbers begin at 1; 0 is the background. There is one array for each of several settings. ``events``: events of
    a plain camera, or compensated, in order of time. ``settings``: they may differ in the least gain and in the
    clustering only.
    """
    if len(events) < 2 or events.t[-1] == events.t[0]:
        return [np.zeros(len(events), np.intp) for _ in settings]
    size, scale = (camera.width, camera.height), camera.width / 640.0
    back = study.rotated_back(study.dithered(events), camera, study.estimate_rotation(events, camera))
    gain = agreement_gain(back, size, settings[0], scale)
    out = []
    for s in settings:
        which = gain > s.gain
        body = np.zeros(len(events), np.intp)
        body[which] = large_clusters(back[which], size, s, scale)
        out.append(body)
    return out


def agreement_gain(events: Events, size: tuple[int, int], s: SegmentationSettings, scale: float) -> NDArray[np.float64]:
    """Return how much better events agree under a further velocity where each event lies, shape (n,): a ratio."""
    seconds = (int(events.t[-1]) - int(events.t[0])) * 1e-6
    grid = study.velocity_grid(s.reach_px * scale, max(s.step_px * scale, 1.0)).reshape(-1, 2)
    fast = np.hypot(*grid.T) >= s.least_px * scale
    slow_best, fast_best = (np.zeros(size[::-1]) for _ in range(2))
    found = study.local_agreement(study.thinned(events, study.MOST_LOCAL), size, grid / seconds, s.pool_px * scale)
    for is_fast, agreement in zip(fast, found, strict=True):
        best = fast_best if is_fast else slow_best
        np.maximum(best, agreement, out=best)
    ratio = np.divide(fast_best, slow_best, out=np.where(fast_best > 0.0, np.inf, 0.0), where=slow_best > 0.0)
    return np.asarray(ratio.ravel()[study.pixel_index(events, size)])


def large_clusters(events: Events, size: tuple[int, int], s: SegmentationSettings, scale: float) -> NDArray[np.intp]:
    """Return the number of the large cluster of DBSCAN over x, y and t of each event, from 1 on; 0 for none."""
    from scipy.spatial import KDTree

    if not len(events):
        return np.zeros(0, np.intp)
    radius = s.radius_px * scale
    tau = (events.t - events.t[0]) / max(int(events.t[-1] - events.t[0]), 1)
    points = np.stack([events.x, events.y, WINDOW_RADII * radius * tau], axis=1)
    chosen = np.random.default_rng(0).permutation(len(points))[:MOST_CLUSTERED]
    even = len(chosen) * 4.0 / 3.0 * np.pi * radius**2 / (WINDOW_RADII * size[0] * size[1])
    least = max(3, round(s.density * even))
    label = study.library("sklearn.cluster").DBSCAN(eps=radius, min_samples=least).fit_predict(points[chosen])
    counts = np.bincount(label + 1, minlength=1)
    large = counts >= s.least_share * len(chosen)
    large[0] = False  # noise
    distance, nearest = KDTree(points[chosen]).query(points)
    number = np.where(large, np.cumsum(large), 0)
    return np.asarray(np.where(distance <= radius, number[label + 1][nearest], 0))


MOST_STEPS, OUTLIER = 10, 2.5
"""Number of steps of the fit of a rotation, and residual above which a pixel is left out [medians]."""


def moving_pixels(
    flow: NDArray[np.floating], camera: Camera, seconds: float, s: SegmentationSettings = SegmentationSettings()
) -> NDArray[np.intp]:
    """Return the number of the moving body that each pixel of a flow belongs to, from 1 on; 0 is the background.

    The camera's rotation is fitted to the flow, shape (height, width, 2) [px/s], without outliers. Bodies are connected
    regions that move further than that by ``least_px`` in a window of ``seconds``, and have ``least_share`` of all such
    pixels.
    """
    parts = [rotation_flow(camera, CameraRotation((x, y, z))) for x, y, z in np.eye(3).tolist()]  # flow of 1 rad/s
    basis, given = np.stack(parts, axis=-1).reshape(-1, 2, 3), flow.reshape(-1, 2).astype(np.float64)
    kept = np.ones(len(given), np.bool_)
    for _ in range(MOST_STEPS):
        rate = np.linalg.lstsq(basis[kept].reshape(-1, 3), given[kept].ravel(), rcond=None)[0]
        residual = np.hypot(*(given - basis @ rate).T)
        kept = residual <= OUTLIER * np.median(residual)
    moves = residual.reshape(flow.shape[:2]) * seconds >= s.least_px * camera.width / 640.0
    label, count = ndimage.label(moves)
    large = np.bincount(label.ravel(), minlength=count + 1) >= max(1.0, s.least_share * np.count_nonzero(moves))
    large[0] = False
    return np.asarray(np.where(large, np.cumsum(large), 0)[label], np.intp)


# Agreement of a set of events or pixels with the true set.


@dataclass(frozen=True, slots=True)
class Overlap:
    """Overlap of a found set with the true set. A ratio without a denominator is NaN."""

    iou: float
    """Intersection over union."""
    precision: float
    """Share of the found members that are true."""
    recall: float
    """Share of the true members that are found."""


def overlap(found: NDArray[np.bool_], truth: NDArray[np.bool_]) -> Overlap:
    """Return the overlap of two Boolean arrays of one shape. Raises :class:`AmiwarpError` for different shapes."""
    if found.shape != truth.shape:
        raise AmiwarpError(f"found and true masks have shapes {found.shape} and {truth.shape}; give equal shapes")
    both = int(np.count_nonzero(found & truth))
    counts = [int(np.count_nonzero(mask)) for mask in (found | truth, found, truth)]
    return Overlap(*(both / n if n else float("nan") for n in counts))


def hull(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the pixels in the convex hull of the pixels of a mask."""
    cv2 = study.library("cv2")
    filled = np.zeros(mask.shape, np.uint8)
    if mask.any():
        cv2.fillConvexPoly(filled, cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32)), 1)
    return filled > 0


def object_ious(events: Events, number: NDArray[np.intp], bodies: Sequence[NDArray[np.bool_]]) -> list[float]:
    """Return for each body the IoU of the convex hulls of its pixels and of the events of the best cluster.

    It does not depend on how many events the body and the background have. ``number``: cluster of each event, 0 for
    none. ``bodies``: pixels of each body, shape (height, width).
    """
    clusters = []
    for k in range(1, int(number.max(initial=0)) + 1):
        mask = np.zeros_like(bodies[0])
        height, width = mask.shape
        mask.ravel()[study.pixel_index(events[number == k], (width, height))] = True
        clusters.append(mask)
    return best_ious(clusters, bodies)


def best_ious(clusters: Sequence[NDArray[np.bool_]], bodies: Sequence[NDArray[np.bool_]]) -> list[float]:
    """Return for each body the IoU of its convex hull with that of the best cluster; all are pixels of an image."""
    hulls = [hull(cluster) for cluster in clusters]
    return [max((overlap(found, hull(body)).iou for found in hulls), default=0.0) for body in bodies]


# Evaluation.

TITLE = "Motion segmentation"
PROTOCOL = (
    "In windows of a quarter turn, the camera's rotation is that of the sharpest image of the events (contrast "
    "maximisation). A region stays blurred if its events agree much better (1.5 times) under a further velocity in the "
    "image. The events of such regions are clustered over x, y and t (DBSCAN); large clusters are moving bodies. Per "
    "event, IoU, precision and recall compare them with the events whose pixel saw the ball; events of noise count "
    "too, as what their pixel saw. These depend on the ball's share of the events, which the prism changes. Per "
    "object, the IoU is that of two areas: the convex hull of the best cluster, and that of the ball's pixels at the "
    "start, in the middle and at the end of the window; it is 0 for a ball that is not found. With an equal budget, "
    "each stream is thinned evenly to the number of events of the stream that has the fewest in the window. Of the "
    "standard camera, the flow between the two frames nearest to the window (OpenCV's DIS) is taken less that of a "
    "rotation, which is fitted to it; connected regions that move further than in the events' search are bodies, and "
    "are compared with the ball at the time of the first frame."
)
DIFFERENCES = (
    "The paper shows pictures only, and does not describe its clustering. Ours has the settings of "
    "`SegmentationSettings`, which are the same for all streams. They were chosen on recordings of seed 0 of this "
    "world, whose texture, throw and camera motion differ from those of the seeds that are scored. The agreement is "
    "measured on at most 100,000 events of a window, evenly thinned."
)
VERSION = 5
NEEDS_TRUTH = True

WINDOW_TURNS = 0.25
"""Length of a window [turns]."""
QUICK_WINDOWS, FULL_WINDOWS = 1, 2
"""Number of windows of a recording."""
QUICK_STREAMS = (Stream.PLAIN, Stream.TRUE, Stream.CALIBRATED)
"""Streams of a quick run."""
OWN, EQUAL = "own", "equal"
"""Budgets of events: all of a stream, or as many as the stream with the fewest has."""
LEAST_PIXELS = 20
"""Smallest number of pixels of a body that counts."""
STANDARD = SegmentationSettings()
"""Settings of the comparison."""
VARIED = {"gain": (1.25, 2.0), "least_share": (0.08, 0.3), "density": (1.0, 4.0), "radius_px": (5.0, 12.0)}
"""Further values of the settings in the sensitivity curves."""
MARGIN = 0.1
"""Loss of IoU that still counts as no influence of the prism."""
NAMES = {"gain": "least gain", "least_share": "least share of a cluster", "density": "least density of a cluster",
         "radius_px": "radius of the clustering [px]"}  # fmt: skip
"""What the settings are called in the report."""


class _Row(TypedDict):
    stream: study.Compared
    budget: Literal["own", "equal"]
    events: study.Count
    gain: study.Amount
    least_share: study.Share
    density: study.Amount
    radius_px: study.Amount
    share: study.Share | None
    object_iou: study.Share | None
    iou: study.Share | None
    precision: study.Share | None
    recall: study.Share | None


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]


def conditions(settings: Settings) -> list[Condition]:
    """Return the ball before a moving camera. The lens sees the whole throw."""
    return settings.conditions(
        world="ball", trajectory="handheld", apex=study.FEATURES_APEX, focal_px=study.wide_focal(settings)
    )


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return the scores of each stream, budget, window and choice of settings.

    A quick run has the standard choice, and only the streams that the verdicts need.
    """
    varied = {} if settings.quick else VARIED
    choices = [STANDARD, *(replace(STANDARD, **{n: v}) for n, values in varied.items() for v in values)]
    length = round(WINDOW_TURNS * 60e6 / streams.condition.rpm)
    count = QUICK_WINDOWS if settings.quick else FULL_WINDOWS
    starts = np.linspace(streams.start_us, streams.end_us - length, count + 2).astype(np.int64)[1:-1]
    rows = []
    for start in starts.tolist():
        end = start + length
        frames = [streams.frame(t).instance for t in (start, (start + end) // 2, end)]
        masks = [np.logical_or.reduce([frame == k for frame in frames]) for k in moving_instances(streams)]
        bodies = [mask for mask in masks if np.count_nonzero(mask) >= LEAST_PIXELS]
        names = [s for s in streams.names_with_own(settings) if s in QUICK_STREAMS or not settings.quick]
        windows = {stream: streams.window(stream, start, end) for stream in names}
        fewest = min(map(len, windows.values()))
        for stream, events in windows.items():
            instance = streams.event_truth(stream, start, end).instance
            assert instance is not None
            truth = np.isin(instance, moving_instances(streams))
            own = _scores(events, truth, bodies, streams.camera, choices)
            rows += [row | {"stream": stream.value, "budget": OWN} for row in own]
            if stream is not Stream.SAME_COUNT:
                some = np.arange(fewest) * len(events) // max(fewest, 1)
                equal = own[:1] if len(events) == fewest else _scores(
                    events[some], truth[some], bodies, streams.camera, [STANDARD]
                )  # fmt: skip
                rows += [row | {"stream": stream.value, "budget": EQUAL} for row in equal]
        rows += [row for kind in Frames for row in _frame_scores(streams, kind, (start + end) // 2, length * 1e-6)]
    return {"rows": rows}


def _frame_scores(streams: Streams, kind: Frames, middle_us: int, seconds: float) -> list[dict[str, Any]]:
    """Return the score per object of the frames of a standard camera that are nearest to the middle of a window."""
    found = camera_flow(streams, kind, middle_us)
    if found is None:
        return []
    number, instance = moving_pixels(found[0], streams.camera, seconds), streams.frame(found[1]).instance
    bodies = [instance == k for k in moving_instances(streams) if np.count_nonzero(instance == k) >= LEAST_PIXELS]
    if not bodies:
        return []
    objects = best_ious([number == k for k in range(1, int(number.max()) + 1)], bodies)
    unknown = dict.fromkeys(("share", "iou", "precision", "recall"))
    return [{"stream": kind.value, "budget": OWN, "events": 0, **_values(STANDARD), **unknown,
             "object_iou": float(np.mean(objects))}]  # fmt: skip


def _scores(
    events: Events, truth: NDArray[np.bool_], bodies: Sequence[NDArray[np.bool_]], camera: Camera,
    choices: Sequence[SegmentationSettings],
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the scores of a window for each choice of settings; ``truth``: which events see a moving body."""
    rows = []
    for chosen, number in zip(choices, moving_events(events, camera, choices), strict=True):
        scores = {name: study.finite(value) for name, value in asdict(overlap(number > 0, truth)).items()}
        objects = object_ious(events, number, bodies) if bodies else []
        rows.append({"events": len(events), **_values(chosen), **scores,
                     "object_iou": float(np.mean(objects)) if objects else None,
                     "share": float(truth.mean()) if len(truth) else None})  # fmt: skip
    return rows


def _values(settings: SegmentationSettings) -> dict[str, float]:
    """Return the settings that are varied."""
    return {name: getattr(settings, name) for name in VARIED}


def _curves(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of each setting's curve: those in which all other settings are standard."""
    usual = _values(STANDARD)
    return [
        row | {"setting": NAMES[name], "value of the setting": row[name]}
        for name in VARIED for row in rows if all(row[other] == usual[other] for other in VARIED if other != name)
    ]  # fmt: skip


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the scores of the standard settings, and those over the least gain."""
    rows = study.rows_of(results, "rows")
    own = [r for r in rows if r["budget"] == OWN and r["stream"] in set(Stream)]
    names, scores = ("scene", "camera", "stream"), ["object_iou", "iou", "precision", "recall"]
    columns = ("seeds x windows", "IoU per object", "std", "IoU per event", "std of IoU per event", "precision",
               "std of precision", "recall", "std of recall")  # fmt: skip
    standard = [r for r in rows if _values(STANDARD).items() <= r.items()]
    return [
        Table("segmentation", "Segmentation of a thrown ball",
              ("budget of events", *names, *columns, "events of the ball", "std of share"),
              study.grouped(standard, ("budget", *names), [*scores, "share"]),
              "Precision is undefined for a window in which no body is found; its IoU is 0."),
        Table("segmentation_settings", "Segmentation over its settings",
              ("setting", *names, "value of the setting", *columns),
              study.grouped(_curves(own), ("setting", *names, "value of the setting"), scores),
              "Gain: that in agreement of what stays blurred. The other settings are those of the clustering.",
              Chart("value of the setting", "IoU per object", "stream", "std", panels=("setting",))),
    ]  # fmt: skip


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the segmentation, which the paper shows in pictures: no worse by a margin than without
    the prism, and better than by a standard camera."""
    rows = [r for r in study.rows_of(results, "rows") if _values(STANDARD).items() <= r.items()]
    measures = (("object_iou", "per object"), ("iou", "per event"))
    own = [r for r in rows if r["budget"] == OWN]
    return [
        *(judge(number, f"A thrown ball is segmented no worse than with the S-EV, by more than {MARGIN:g} of the IoU "
                f"(moving camera, {text}, {budget} budget of events).",
                differences([r for r in rows if r["budget"] == budget], score, {"stream": Stream.CALIBRATED},
                            {"stream": Stream.PLAIN}),
                f"the IoU {text} of '{Stream.CALIBRATED}' less that of '{Stream.PLAIN}'", above=-MARGIN)
          for number, budget in ((8, OWN), (None, EQUAL)) for score, text in measures),
        *untestable_as_stated(8, "With the S-EV and the AMI-EV it is segmented better than with a standard camera.",
                              "how many frames/s the standard camera has", [
            judge(None, f"With the {name} it is segmented better than with a standard camera of {rate} frames/s (per "
                  "object).", differences(own, "object_iou", {"stream": stream}, {"stream": frames}),
                  f"the IoU per object of '{stream}' less that of '{frames}'", above=0.0)
            for name, stream in (("S-EV", Stream.PLAIN), ("AMI-EV", Stream.CALIBRATED))
            for rate, frames in ((30, Frames.SLOW), (60, Frames.FAST))]),
    ]  # fmt: skip
