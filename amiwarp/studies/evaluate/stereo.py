"""Evaluation of stereo: disparity at edges by two event cameras, with and without prisms."""

from collections.abc import Sequence
from typing import Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.truth import FrameTruth
from amiwarp.imaging.iwe import iwe
from amiwarp.simulation.other_camera import disparity, places_in
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.studies.evaluate.claims import Claim, differences, judge
from amiwarp.studies.evaluate.conditions import Condition, Settings
from amiwarp.studies.evaluate.event_images import grey_images
from amiwarp.studies.evaluate.flow import edge_pixels
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    ChartKind,
    Share,
    Table,
    finite,
    grouped,
    rows_of,
    where,
)
from amiwarp.studies.evaluate.right_camera import BASELINE_M, right_streams
from amiwarp.studies.evaluate.stereo_matching import (
    OUTLIER_PX,
    disparity_error,
    match,
)
from amiwarp.studies.evaluate.streams import Frames, Stream, Streams
from amiwarp.studies.evaluate.track_truth import seen_places

TITLE = "Stereo"
PROTOCOL = (
    "Two cameras look in the same direction, 10 cm apart, through prisms of one kind at different angles. "
    "Semi-global matching (OpenCV's StereoSGBM, blocks of 9 px) compares their images of events along the rows. The "
    "disparity is measured in the middle of a window at the edges of the true picture that both cameras see, which are "
    "the same pixels for all streams. A pixel has a disparity if it has events and the matcher finds one. "
    "Completeness is the share of edge pixels with a disparity; outliers are off by more than 1 px; right is the share "
    "of edge pixels whose disparity is off by less. 'One disparity' predicts the median of the true disparities "
    "everywhere. Frames of the standard cameras are compared at their own time."
)
DIFFERENCES = (
    "The paper does not evaluate stereo: all verdicts here are checks of ours. The size of the blocks was chosen on "
    "recordings of seed 0. The cameras are rectified by construction, and their intrinsics and poses are known "
    "exactly; both prisms are compensated by one calibration. That the prisms turn at different angles decides the "
    "results in fast motion: an edge then fires at different times in the two cameras, between which the rig moves. "
    "Prisms in phase, which need a common motor, were tried on one small recording only (96x72 px, fast, seed 0): "
    "half a turn then gives 85 % of the edges, prisms 2 rad apart 67 %, and two S-EVs 81 %."
)
VERSION = 1
NEEDS_TRUTH = True

TURNS = (0.25, 0.5, 1.0)
"""Lengths of the windows [turns]."""
STANDARD_TURNS = 0.5
"""Length of the windows by which the streams are judged [turns]."""
MIXED = f"{Stream.CALIBRATED} + {Stream.PLAIN}"
"""Name of the pair whose right camera is a plain event camera."""
ONE_DISPARITY = "one disparity"
"""Name of the prediction that everything is equally far."""
MARGIN_PX = 0.1
"""Increase of the median error that counts as no worse [px]."""


class _Row(TypedDict):
    stream: Literal["one disparity", "AMI-EV, calibrated + S-EV", *Stream, *Frames]  # type: ignore[valid-type]
    turns: Amount
    complete: Share | None
    median: Amount | None
    outliers: Share | None
    right: Share | None


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]


def conditions(settings: Settings) -> list[Condition]:
    """Return the room at rest, and in slow and fast motion; in full also the desk."""
    found = []
    for world in ("room",) if settings.quick else ("room", "desk"):
        for motion in ("still", "handheld", "fast"):
            found += settings.conditions(world=world, trajectory=motion)
    return found


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return the errors of each pair of cameras, over the length of the window."""
    right = right_streams(streams)
    middle = (streams.start_us + streams.end_us) // 2
    turn_us = 60e6 / streams.condition.rpm
    truth = streams.frame(middle)
    edges = shared_edges(streams, right, truth)
    true_disparity = _true_disparity(streams, truth)
    rows: list[dict[str, Any]] = []

    # Windows of equal count would be of other lengths.
    names = [name for name in streams.names if name is not Stream.SAME_COUNT]
    pairs = [(name.value, name, name) for name in names]
    if Stream.CALIBRATED in names:
        pairs.append((MIXED, Stream.CALIBRATED, Stream.PLAIN))
    for turns in TURNS:
        half = round(0.5 * turns * turn_us)
        for name, of_left, of_right in pairs:
            events = [
                streams.window(of_left, middle - half, middle + half),
                right.window(of_right, middle - half, middle + half),
            ]
            images = [iwe(each, *streams.size) for each in events]
            found = match(*grey_images(images))
            has_events = images[0] > 0.5
            seen = np.where(has_events, found, np.nan)
            rows.append(_row(name, turns, seen, true_disparity, edges))
        constant = np.full_like(true_disparity, np.median(true_disparity[edges]))
        rows.append(_row(ONE_DISPARITY, turns, constant, true_disparity, edges))

    for camera in Frames:
        times = streams.exposures(camera)
        nearest = int(times[np.abs(times - middle).argmin()])
        truth = streams.frame(nearest)
        edges = shared_edges(streams, right, truth)
        found = match(streams.grey_frame(nearest), right.grey_frame(nearest))
        # Frames do not depend on the length of the windows.
        for turns in TURNS:
            rows.append(_row(camera.value, turns, found, _true_disparity(streams, truth), edges))
    return {"rows": rows}


def shared_edges(left: Streams, right: Streams, truth: FrameTruth) -> NDArray[np.bool_]:
    """Return the pixels at edges of the left camera's true picture that the right camera sees, too."""
    edges = edge_pixels(truth) & np.isfinite(truth.depth)
    row, column = np.nonzero(edges)
    xy = np.stack([column, row], axis=1).astype(np.float64)
    times = np.full(len(xy), truth.t_us)
    of_left = left.simulation.scene
    of_right = right.simulation.scene
    assert isinstance(of_left, WorldScene)
    assert isinstance(of_right, WorldScene)
    places = seen_places(truth, left.camera, of_left.trajectory, xy, times)
    seen = places_in(
        places, times, right.camera, of_right.trajectory, world=of_right.world, device=right.device
    )
    shared = np.zeros_like(edges)
    shared[row, column] = seen.visible
    return shared


def _true_disparity(streams: Streams, truth: FrameTruth) -> NDArray[np.float64]:
    """Return the true disparity of all pixels [px]."""
    return disparity(truth.depth, streams.camera, streams.camera, BASELINE_M)


def _row(
    name: str,
    turns: float,
    found: NDArray[Any],
    truth: NDArray[np.float64],
    edges: NDArray[np.bool_],
) -> dict[str, Any]:
    """Return the errors of a pair of cameras as a row."""
    error = disparity_error(found, truth, edges)
    return {
        "stream": name,
        "turns": turns,
        "complete": finite(error.complete),
        "median": finite(error.median),
        "outliers": finite(error.outliers),
        "right": finite(error.right),
    }


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the errors with windows of half a turn, and the share of right disparities over their length."""
    rows = rows_of(results, "rows")
    names = ("scene", "camera", "stream")
    values = ["right", "complete", "median", "outliers"]
    columns = (
        "seeds",
        "share right",
        "std",
        "complete",
        "std of complete",
        "median error [px]",
        "std of median",
        "outliers",
        "std of outliers",
    )
    return [
        Table(
            "stereo",
            "Disparity at edges, windows of half a turn",
            (*names, *columns),
            grouped(where(rows, turns=STANDARD_TURNS), names, values),
            "Share right: share of the edge pixels whose disparity is off by at most 1 px. Two streams of the same "
            "name are compared, such as S-EV and S-EV.",
            Chart("camera", "share right", "stream", "std", panels=("scene",), kind=ChartKind.BARS),
        ),
        Table(
            "stereo_window",
            "Disparity at edges over the length of the window",
            (*names, "window [turns]", *columns),
            grouped(rows, (*names, "turns"), values),
            "Over whole turns, raw events of both cameras are blurred by the same circle, which moves no edge.",
            Chart("window [turns]", "share right", "stream", "std", panels=("scene", "camera")),
        ),
    ]


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return our checks: the paper does not evaluate stereo."""
    rows = where(rows_of(results, "rows"), turns=STANDARD_TURNS)
    checks = []
    for motion, text in (
        ("still", "At rest"),
        ("handheld", "With a handheld rig"),
        ("fast", "With a fast rig"),
    ):
        moving = where(rows, camera=motion)
        checks += [
            _finds_more(moving, text, Stream.CALIBRATED, Stream.PLAIN),
            _finds_more(moving, text, MIXED, Stream.PLAIN),
            _finds_more(moving, text, Stream.CALIBRATED, Frames.FAST),
            _finds_more(moving, text, Stream.CALIBRATED, ONE_DISPARITY),
        ]
    in_motion = [row for row in rows if row["camera"] != "still"]
    no_worse = judge(
        None,
        f"In motion the median error of two AMI-EVs is larger than the error of two S-EVs by at most {MARGIN_PX:g} px.",
        differences(in_motion, "median", {"stream": Stream.CALIBRATED}, {"stream": Stream.PLAIN}),
        f"the median error of '{Stream.CALIBRATED}' less the error of '{Stream.PLAIN}'",
        below=MARGIN_PX,
        unit="px",
    )
    return [*checks, no_worse]


def _finds_more(rows: Sequence[dict[str, Any]], motion: str, first: str, second: str) -> Claim:
    """Judge whether one pair finds the right disparity at more edges than another one."""
    return judge(
        None,
        f"{motion}, '{first}' finds the disparity of more edges than '{second}'.",
        differences(rows, "right", {"stream": first}, {"stream": second}),
        f"the share of edge pixels within {OUTLIER_PX:g} px of '{first}' less the share of '{second}'",
        above=0.0,
    )
