"""Evaluation of edges: event images against the Canny edges of the grey picture and the edges of the geometry."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.studies.evaluate.claims import Claim, differences, judge, ranges
from amiwarp.studies.evaluate.conditions import Condition, Settings
from amiwarp.studies.evaluate.edge_agreement import (
    THRESHOLDS,
    best_f,
)
from amiwarp.studies.evaluate.edge_matches import (
    CANNY,
    GEOMETRY,
    STRICT_TOLERANCE_PX,
    TRUTH_OF_SIGMA,
    USUAL_TOLERANCE_PX,
    WINDOW_US,
    match_rows,
    recall_by_direction,
    summary_of,
    true_edges,
    window_image,
)
from amiwarp.studies.evaluate.edge_scores import as_counts, scores, scores_by_seed
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    ChartKind,
    Compared,
    Count,
    Share,
    Table,
    Value,
    grouped,
    rows_of,
    where,
)
from amiwarp.studies.evaluate.stored_pictures import (
    Picture,
    check_pictures,
    decode_picture,
    encode_picture,
)
from amiwarp.studies.evaluate.streams import ENOUGH, Frames, Stream, Streams
from amiwarp.studies.evaluate.true_edges import (
    grey_picture,
)

TITLE = "Edges"
PROTOCOL = (
    "The events of 33 ms are voted into an image, which is divided by its 99th percentile, binarised by a threshold "
    "and thinned. Its pixels are matched one to one with true edge pixels within a tolerance, in as many pairs as "
    "possible. The F-score belongs to the best threshold for all images of a stream and a camera motion together "
    f"(ODS), of {len(THRESHOLDS)} thresholds. True edges are Canny's (σ = 2 px) of the noise-free grey picture without "
    "the prism at the middle of the window, or steps of instance, depth (5 %) or normal (20°). Chance is the score of "
    "the same images turned by 180°, at the threshold that is best for them then: each stream has its own. The margin "
    "is what a score has above it. The entropy is the entropy of the binarised image before thinning. Of the standard "
    "camera, the last frame that is complete at the end of the window is used: the "
    "image is its gradient (σ = 2 px) at the maxima that Canny's method keeps."
)
DIFFERENCES = (
    "The paper's pictures come from a camera behind the event camera's lens; here they are rendered. Its tolerance is"
    " not in the main text: 0.0075 of the diagonal is usual, 6 px at 640×480, and hides compensation errors, so the "
    "score is shown over the tolerance. Geometric edges leave out texture, which costs every stream precision. Canny "
    "also marks the fine texture of walls, so densely that chance scores high at wide tolerances, and the more so the "
    "more events there are. The claims are therefore judged by the margin over chance; scores alone are checks of ours."
)
VERSION = 6
NEEDS_TRUTH = True

TOLERANCES = (1.0, 1.5, 2.0, 3.0, 4.5, 6.0)
"""Tolerances of the curve [px]."""
QUICK_TOLERANCES = (1.5, 3.0, 6.0)
"""Tolerances of a quick run [px], which include both of the comparison."""
VALUES_IN_WORDS = {
    "f": "the ODS-F",
    "margin": "the margin of the ODS-F over its own chance",
    "entropy": "the entropy",
}
"""What the values are called in the claims."""
COLUMNS = {
    "scene": "scene",
    "camera": "camera",
    "true edges": "truth",
    "tolerance [px]": "tolerance",
    "stream": "stream",
    "ODS-F": "f",
    "std": "std",
    "chance": "chance",
    "margin over chance": "margin",
    "precision": "precision",
    "recall": "recall",
    "entropy [bit/px]": "entropy",
    "seeds": "seeds",
}
"""Columns of the tables of scores, with the names of their values in a row of :func:`scores`."""
ALONG_DEG = 60.0
"""Angle between motion and normal above which an edge lies along the motion [deg]."""
ACROSS_DEG = 30.0
"""Angle between motion and normal below which an edge lies across the motion [deg]."""
KEPT = 0.1
"""Relative loss of recall along the motion that counts as none."""


class _Summary(TypedDict):
    stream: Compared
    found: list[Count]
    entropy: list[Share]


class _Row(TypedDict):
    stream: Compared
    truth: Literal["Canny", "geometry", "Canny, σ 1 px", "Canny, σ 3 px"]
    tolerance: Amount
    matched: list[Count]
    chance: list[Count]
    true: Count


class _Sector(TypedDict):
    stream: Compared
    angle: Amount
    recall: Share


class _Values(TypedDict):
    images: list[_Summary]
    rows: list[_Row]
    sectors: list[_Sector]
    pictures: dict[str, str]


def _checked(values: _Values, what: str) -> _Values:
    """Return the values if each row has its images and numbers for each threshold."""
    check_pictures(list(values["pictures"].values()), 2, f"{what}.pictures")
    lists: dict[str, Sequence[object]] = {}
    for index, image in enumerate(values["images"]):
        lists |= {f"images[{index}].{name}": image[name] for name in ("found", "entropy")}
    for index, row in enumerate(values["rows"]):
        lists |= {f"rows[{index}].{name}": row[name] for name in ("matched", "chance")}
    for place, numbers in lists.items():
        if len(numbers) != len(THRESHOLDS):
            raise AmiwarpError(
                f"{what}.{place} has {len(numbers)} numbers; expected {len(THRESHOLDS)}, one for each threshold",
                ErrorCode.FIELD,
            )
    images = {row["stream"] for row in values["images"]}
    for row in values["rows"]:
        if row["stream"] not in images:
            raise AmiwarpError(
                f"{what}.rows has a row of {row['stream']}, whose images are missing",
                ErrorCode.FIELD,
            )
    return values


Values = Annotated[_Values, _checked]
"""What :func:`measure` returns."""


def conditions(settings: Settings) -> list[Condition]:
    """Return the standard scenes, at rest and moving."""
    return settings.scenes()


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return counts of matches over the thresholds, entropies, recall by direction, and example pictures."""
    images = []
    rows = []
    sectors = []
    pictures = {}
    middle_us = streams.end_us // 2
    names: list[str] = [s.value for s in streams.names if _has_enough_events(streams, s)]
    names += [camera.value for camera in Frames]
    tolerances = QUICK_TOLERANCES if settings.quick else TOLERANCES
    for name in names:
        window = window_image(streams, name, middle_us)
        masks = window.masks()
        summary = summary_of(name, masks)
        images.append(summary)
        counts = match_rows(name, window, masks, tolerances)
        rows += counts
        (strict,) = where(counts, truth=CANNY, tolerance=STRICT_TOLERANCE_PX)
        # The threshold that is best for this image alone: the sectors need one mask.
        best, _ = best_f(as_counts(strict, summary))
        _, thinned = masks[best]
        sectors += recall_by_direction(name, window, thinned)
        pictures[name] = _shown(window.values)
    frame = streams.frame(middle_us)
    pictures["grey picture"] = _shown(grey_picture(frame.intensity))
    true = true_edges(frame)
    pictures |= {name: _shown(true[name]) for name in (CANNY, GEOMETRY)}
    is_first = streams.condition.seed == settings.first_seed
    return {
        "images": images,
        "rows": rows,
        "sectors": sectors,
        "pictures": pictures if is_first else {},
    }


def _has_enough_events(streams: Streams, stream: Stream) -> bool:
    """Return whether the stream with the same count has as many events, which it never has at rest."""
    if stream is not Stream.SAME_COUNT:
        return True
    middle_us = streams.end_us // 2
    span = middle_us - WINDOW_US // 2, middle_us + WINDOW_US // 2
    return len(streams.window(stream, *span)) >= ENOUGH * streams.count(Stream.RAW, *span)


def _shown(image: NDArray[Any]) -> str:
    """Return an image as text; black on white for events and edges."""
    return encode_picture(np.asarray(np.clip(image.astype(np.float64), 0.0, 1.0) * 255.0, np.uint8))


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return scores at two tolerances, the curve over the tolerance, and the recall by direction."""
    all_scores = scores(results)
    usual = [row for row in all_scores if row["truth"] in (CANNY, GEOMETRY)]
    at_two = [row for row in usual if row["tolerance"] in (USUAL_TOLERANCE_PX, STRICT_TOLERANCE_PX)]
    panels = ("scene", "camera", "true edges")
    return [
        Table(
            "edges",
            "F-score, entropy, precision and recall at two tolerances",
            tuple(COLUMNS),
            _in_columns(at_two, COLUMNS),
            "Scores belong to the best threshold of each row. The spread is over the seeds at this threshold.",
        ),
        Table(
            "edges_tolerance",
            "F-score over the tolerance",
            tuple(COLUMNS),
            _in_columns(usual, COLUMNS),
            "A wide tolerance hides blur and errors of the compensation, and rewards chance.",
            Chart("tolerance [px]", "ODS-F", "stream", "std", panels=panels),
        ),
        Table(
            "edges_margin",
            "Margin of the F-score over chance, over the tolerance",
            tuple(COLUMNS),
            _in_columns(usual, COLUMNS),
            "What a stream's score has above its own chance.",
            Chart("tolerance [px]", "margin over chance", "stream", panels=panels),
        ),
        _smoothing_table(where(all_scores, tolerance=STRICT_TOLERANCE_PX)),
        _direction_table(rows_of(results, "sectors")),
    ]


def _in_columns(
    rows: Sequence[dict[str, Any]], columns: Mapping[str, str]
) -> list[tuple[Value, ...]]:
    """Return the values of rows, in the order of the columns."""
    return [tuple(row[name] for name in columns.values()) for row in rows]


def _smoothing_table(scores: Sequence[dict[str, Any]]) -> Table:
    """Return the table of the scores at the strict tolerance over the smoothing of Canny's edges."""
    sigma_of = {name: sigma for sigma, name in TRUTH_OF_SIGMA.items()}
    rows = [row | {"sigma": sigma_of[row["truth"]]} for row in scores if row["truth"] in sigma_of]
    columns = {
        "scene": "scene",
        "camera": "camera",
        "σ [px]": "sigma",
        "stream": "stream",
        "margin over chance": "margin",
        "std": "std",
        "ODS-F": "f",
        "chance": "chance",
    }
    return Table(
        "edges_canny",
        "Margin over chance over the smoothing of the true edges (Canny, 1.5 px)",
        tuple(columns),
        _in_columns(rows, columns),
        "With little smoothing the true edges include the fine texture of walls, which chance finds too.",
        Chart("σ [px]", "margin over chance", "stream", "std", panels=("scene", "camera")),
    )


def _direction_table(sectors: Sequence[dict[str, Any]]) -> Table:
    """Return the table of the recall over the angle between the image motion and the normal of an edge."""
    angle = "angle between motion and edge normal [deg]"
    return Table(
        "edges_direction",
        "Recall by the direction of edges (Canny, 1.5 px)",
        ("scene", "camera", angle, "stream", "windows", "recall", "std"),
        grouped(sectors, ("scene", "camera", "angle", "stream"), ["recall"]),
        "At 90° an edge lies along the motion, and a plain event camera loses it. The threshold is the "
        "best of the recording. A still camera has no motion.",
        Chart(angle, "recall", "stream", "std", panels=("scene", "camera"), kind=ChartKind.LINES),
    )


def pictures(results: Sequence[CellResult]) -> list[Picture]:
    """Return the first event images of each motion, side by side."""
    pictures_of: dict[str, dict[str, str]] = {}
    for result in results:
        if isinstance(result.condition, Condition) and result.values.get("pictures"):
            pictures_of.setdefault(result.condition.trajectory, result.values["pictures"])

    shown = ("grey picture", CANNY, GEOMETRY, Stream.PLAIN, Stream.CALIBRATED, Frames.FAST)
    mosaics = []
    for camera in _motions(results):
        stored = pictures_of.get(camera)
        if stored is None:
            continue
        names = [name for name in shown if name in stored]
        caption = f"Camera {camera}. From left to right: {', '.join(names)}."
        mosaic = _mosaic([decode_picture(stored[name]) for name in names])
        mosaics.append(Picture(f"edges_{camera}", caption, [mosaic]))
    return mosaics


def _motions(results: Sequence[CellResult]) -> list[str]:
    """Return the motions of the camera in the order in which they appear."""
    motions = [r.condition.trajectory for r in results if isinstance(r.condition, Condition)]
    return list(dict.fromkeys(motions))


def _mosaic(images: Sequence[NDArray[np.uint8]], columns: int = 3) -> NDArray[np.uint8]:
    """Return images of one size side by side, in rows, with white gaps."""
    height, width = images[0].shape
    gap = 6
    rows = -(-len(images) // columns)
    mosaic = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap), 255, np.uint8)
    for index, image in enumerate(images):
        row, column = divmod(index, columns)
        top = row * (height + gap)
        left = column * (width + gap)
        mosaic[top : top + height, left : left + width] = image
    return mosaic


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the F-score, its steadiness, the entropy and the recall by direction; and robustness."""
    rows = where(scores_by_seed(results), truth=CANNY)
    moving = [row for row in rows if row["camera"] != "still"]
    at_rest = where(rows, camera="still")
    usual = where(moving, tolerance=USUAL_TOLERANCE_PX)
    strict = where(moving, tolerance=STRICT_TOLERANCE_PX)
    geometry = [
        row
        for row in where(scores_by_seed(results), truth=GEOMETRY, tolerance=STRICT_TOLERANCE_PX)
        if row["camera"] != "still"
    ]
    return [
        _claim_higher(
            2,
            "Event images of the moving AMI-EV fit the picture's edges better (Canny, 6 px).",
            usual,
            "f",
        ),
        _claim_steadier(2, "They do so more steadily over the camera's motions.", usual, "f"),
        _claim_higher(2, "Their entropy is higher (moving camera).", usual, "entropy"),
        *_fading(rows_of(results, "sectors")),
        _claim_higher(
            None,
            "They are better than chance by a larger margin at 6 px, where chance scores high.",
            usual,
            "margin",
        ),
        _claim_higher(
            None,
            "So they are at rest, where the S-EV sees nothing.",
            where(at_rest, tolerance=USUAL_TOLERANCE_PX),
            "margin",
        ),
        _claim_higher(
            None, "The margin over chance is larger at a tolerance of 1.5 px.", strict, "margin"
        ),
        _claim_steadier(
            None, "That margin is steadier over the camera's motions.", strict, "margin"
        ),
        _claim_higher(None, "It is larger for geometric edges, at 1.5 px.", geometry, "margin"),
        _claim_higher(
            None,
            "It is larger at 1.5 px than with an S-EV with as many events.",
            strict,
            "margin",
            than=Stream.SAME_COUNT,
        ),
        _claim_higher(
            None,
            "The entropy is higher than with an S-EV with as many events.",
            usual,
            "entropy",
            than=Stream.SAME_COUNT,
        ),
    ]


def _claim_higher(
    number: int | None,
    text: str,
    rows: Sequence[dict[str, Any]],
    value: str,
    *,
    than: Stream = Stream.PLAIN,
) -> Claim:
    """Judge whether a value of the AMI-EV's images is higher than the value of another stream's."""
    return judge(
        number,
        text,
        differences(rows, value, {"stream": Stream.CALIBRATED}, {"stream": than}),
        f"{VALUES_IN_WORDS[value]} of '{Stream.CALIBRATED}' less the same of '{than}'",
        above=0.0,
    )


def _claim_steadier(
    number: int | None, text: str, moving: Sequence[dict[str, Any]], value: str
) -> Claim:
    """Judge whether a value varies less over the camera's motions for the AMI-EV than for the S-EV."""
    of_scenes = differences(
        ranges(moving, value),
        value,
        {"stream": Stream.CALIBRATED},
        {"stream": Stream.PLAIN},
        by=("scene",),
    )
    return judge(
        number,
        text,
        of_scenes,
        f"the range of {VALUES_IN_WORDS[value]} over the motions of "
        f"'{Stream.CALIBRATED}' less the same of '{Stream.PLAIN}'",
        below=0.0,
    )


def _fading(rows: Sequence[dict[str, Any]]) -> list[Claim]:
    """Judge whether edges along the motion fade from the S-EV, and whether they do not from the AMI-EV."""
    sides = []
    for row in rows:
        if row["angle"] > ALONG_DEG:
            sides.append(row | {"along": True})
        elif row["angle"] < ACROSS_DEG:
            sides.append(row | {"along": False})
    return [
        _recall_along(
            "The S-EV finds fewer of the edges along the motion than of those across it.",
            sides,
            Stream.PLAIN,
            below=0.0,
        ),
        _recall_along(
            f"The AMI-EV finds no fewer of them, within {KEPT:.0%}.",
            sides,
            Stream.CALIBRATED,
            above=-KEPT,
        ),
    ]


def _recall_along(
    text: str,
    sides: Sequence[dict[str, Any]],
    stream: Stream,
    *,
    above: float = -math.inf,
    below: float = math.inf,
) -> Claim:
    """Judge a stream's recall of edges along the motion, relative to edges across it."""
    along = {"stream": stream, "along": True}
    across = {"stream": stream, "along": False}
    return judge(
        3,
        text,
        differences(sides, "recall", along, across, relative=True),
        f"the recall by '{stream}' of edges whose normal is over {ALONG_DEG:g}° from the motion, "
        f"less the same of edges below {ACROSS_DEG:g}°, relative to the latter,",
        above=above,
        below=below,
    )
