"""Evaluation of edges: event images against the Canny edges of the grey picture and the edges of the geometry."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.truth import FrameTruth
from amiwarp.imaging.iwe import iwe
from amiwarp.studies.evaluate.claims import Claim, differences, judge, ranges
from amiwarp.studies.evaluate.conditions import Condition, Settings
from amiwarp.studies.evaluate.edge_agreement import (
    THRESHOLDS,
    Counts,
    best_f,
    binary_entropy,
    match,
    normalised,
)
from amiwarp.studies.evaluate.libraries import library
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
    CANNY_SIGMA,
    canny_edges,
    edge_strength,
    geometric_edges,
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

WINDOW_US = 33_000
"""Length of a window [us]."""
TOLERANCES = (1.0, 1.5, 2.0, 3.0, 4.5, 6.0)
QUICK_TOLERANCES = (1.5, 3.0, 6.0)
"""Tolerances [px]."""
USUAL = 6.0
STRICT = 1.5
"""Tolerances of the comparison with the paper and of the strict one [px]."""
CANNY = "Canny"
GEOMETRY = "geometry"
"""Kinds of true edges in the comparison."""
SIGMAS = {1.0: "Canny, σ 1 px", CANNY_SIGMA: CANNY, 3.0: "Canny, σ 3 px"}
"""Standard deviations of Canny's Gaussian in the sensitivity curve [px], and the kinds of edges that they give. The
curve is that at the strict tolerance."""
VALUES_IN_WORDS = {
    "f": "the ODS-F",
    "margin": "the margin of the ODS-F over its own chance",
    "entropy": "the entropy",
}
"""What the values are called in the claims."""
SET = ("scene", "camera", "stream", "truth", "tolerance")
"""Columns whose values make a set of images with one best threshold."""
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
SECTORS = 6
"""Number of classes of the angle between image motion and the normal of an edge."""
KEPT = 0.1
"""Relative loss of recall along the motion that counts as none."""
SLOWEST = 5.0
"""Slowest image motion whose direction counts [px/s]."""


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
    lists = [row[name] for name in ("found", "entropy") for row in values["images"]]
    lists += [row[name] for name in ("matched", "chance") for row in values["rows"]]
    if any(len(numbers) != len(THRESHOLDS) for numbers in lists):
        raise AmiwarpError(
            f"{what} has lists of other lengths than the {len(THRESHOLDS)} thresholds"
        )
    images = {row["stream"] for row in values["images"]}
    for row in values["rows"]:
        if row["stream"] not in images:
            raise AmiwarpError(f"{what} has a row of {row['stream']}, but not its images")
    return values


Values = Annotated[_Values, _checked]
"""What :func:`measure` returns."""


def conditions(settings: Settings) -> list[Condition]:
    """Return the standard scenes, at rest and moving."""
    return settings.scenes()


Masks = tuple["NDArray[np.bool_]", "NDArray[np.bool_]"]
"""Pixels above a threshold, and the same thinned."""


@dataclass(frozen=True)
class _Image:
    """Event image of a window with its true edges."""

    image: NDArray[np.float64]
    """Event image, relative to its scale."""
    true: dict[str, NDArray[np.bool_]]
    """True edges by their kind."""
    frame: FrameTruth
    """Ground truth at the middle of the window."""

    def masks(self) -> list[Masks]:
        """Return the pixels above each threshold, and the same thinned; equal masks are the same arrays."""
        skeletonize = library("skimage.morphology").skeletonize
        # Masks of the same number of pixels are equal, because each lies within the mask of a lower threshold.
        masks_by_count: dict[int, Masks] = {}
        masks = []
        for threshold in THRESHOLDS:
            above = np.asarray(self.image >= threshold, np.bool_)
            count = int(above.sum())
            if count not in masks_by_count:
                masks_by_count[count] = above, np.asarray(skeletonize(above), np.bool_)
            masks.append(masks_by_count[count])
        return masks


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
        window = _image(streams, name, middle_us)
        masks = window.masks()
        summary = _summary(name, masks)
        images.append(summary)
        counts = _count(name, window, masks, tolerances)
        rows += counts
        (strict,) = where(counts, truth=CANNY, tolerance=STRICT)
        best, _ = best_f(_counts(strict, summary))
        _, thinned = masks[best]
        sectors += _sectors(name, window, thinned)
        pictures[name] = _shown(window.image)
    frame = streams.frame(middle_us)
    pictures["grey picture"] = _shown(grey_picture(frame.intensity))
    true = _true_edges(frame)
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


def _true_edges(frame: FrameTruth) -> dict[str, NDArray[np.bool_]]:
    """Return the true edges of an instant by their kind."""
    canny = {name: canny_edges(frame.intensity, sigma) for sigma, name in SIGMAS.items()}
    return {**canny, GEOMETRY: geometric_edges(frame)}


def _image(streams: Streams, name: str, middle_us: int) -> _Image:
    """Return the event image of a stream, or the gradient of a standard camera's frame."""
    span = middle_us - WINDOW_US // 2, middle_us + WINDOW_US // 2
    frame = streams.frame(middle_us)
    if name in set(Frames):
        exposed = streams.last_exposure(Frames(name), span[1])
        assert exposed is not None
        return _Image(
            normalised(edge_strength(streams.grey_frame(exposed))), _true_edges(frame), frame
        )
    events = streams.window(Stream(name), *span)
    image = iwe(events, *streams.size, device=streams.device)
    return _Image(normalised(image), _true_edges(frame), frame)


def _summary(name: str, masks: Sequence[Masks]) -> dict[str, Any]:
    """Return the number of thinned pixels and the entropy of a stream's image over the thresholds."""
    entropy = np.array([binary_entropy(above) for above, _ in masks])
    counts = [int(np.count_nonzero(thin)) for _, thin in masks]
    return {"stream": name, "found": counts, "entropy": entropy.round(4).tolist()}


def _count(
    name: str, image: _Image, masks: Sequence[Masks], usual: Sequence[float]
) -> list[dict[str, Any]]:
    """Return the number of matches over the thresholds for each kind of true edges and tolerance, usually ``usual``.

    ``chance`` belongs to the image turned by 180 deg.
    """
    rows = []
    for truth, edges in image.true.items():
        tolerances = usual if truth in (CANNY, GEOMETRY) else (STRICT,)
        turned = edges[::-1, ::-1]
        matched = np.transpose(_matched(masks, edges, tolerances)).tolist()
        chance = np.transpose(_matched(masks, turned, tolerances)).tolist()
        for index, tolerance in enumerate(tolerances):
            row = {
                "stream": name,
                "truth": truth,
                "tolerance": tolerance,
                "matched": matched[index],
                "chance": chance[index],
                "true": int(edges.sum()),
            }
            rows.append(row)
    return rows


def _matched(
    masks: Sequence[Masks], true: NDArray[np.bool_], tolerances: Sequence[float]
) -> list[list[int]]:
    """Return the number of matches for each threshold and tolerance."""
    counts: list[list[int]] = []
    previous = None
    for _, thin in masks:
        # Equal masks are the same arrays.
        if thin is previous:
            counts.append(counts[-1])
            continue
        matches = match(thin, true, tolerances)
        counts.append([int(np.count_nonzero(matched)) for matched in matches])
        previous = thin
    return counts


def _counts(row: dict[str, Any], images: dict[str, Any], which: str = "matched") -> Counts:
    """Return the counts of a row of matches and of the summary of its images; ``which`` may be "chance"."""
    matched = np.array(row[which])
    found = np.array(images["found"])
    return Counts(matched, found, np.full(len(found), row["true"]))


def _sectors(name: str, image: _Image, thinned: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """Return the recall of Canny edges by the angle between the image motion and the normal of the edge.

    ``thinned``: pixels of the image's edges.
    """
    limits_deg = np.linspace(0.0, 90.0, SECTORS + 1)
    true = image.true[CANNY]
    (matched,) = match(thinned, true, [STRICT])
    is_found = matched[true]
    angle_deg = _angle(image.frame)[true]
    sector = np.clip(np.digitize(angle_deg, limits_deg) - 1, 0, SECTORS - 1)
    rows = []
    for index in range(SECTORS):
        chosen = np.isfinite(angle_deg) & (sector == index)
        if chosen.any():
            middle = float(limits_deg[index : index + 2].mean())
            recall = float(is_found[chosen].mean())
            rows.append({"stream": name, "angle": middle, "recall": recall})
    return rows


def _angle(frame: FrameTruth) -> NDArray[np.float64]:
    """Return the angle between image motion and brightness gradient, 0 .. 90 [deg]; NaN where nothing moves."""
    gy, gx = np.gradient(grey_picture(frame.intensity))
    u = frame.flow[..., 0].astype(np.float64)
    v = frame.flow[..., 1].astype(np.float64)
    speed = np.hypot(u, v)
    with np.errstate(invalid="ignore", divide="ignore"):
        cos = np.abs(gx * u + gy * v) / (np.hypot(gx, gy) * speed)
        return np.where(speed >= SLOWEST, np.degrees(np.arccos(np.clip(cos, 0.0, 1.0))), np.nan)


def _shown(image: NDArray[Any]) -> str:
    """Return an image as text; black on white for events and edges."""
    return encode_picture(np.asarray(np.clip(image.astype(np.float64), 0.0, 1.0) * 255.0, np.uint8))


@dataclass(frozen=True)
class _Member:
    """Recording of a set."""

    seed: int
    """Seed."""
    counts: Counts
    """Counts of matches."""
    chance: Counts
    """The same for images turned by 180 deg."""
    entropy: list[float]
    """Entropy over the thresholds."""


def _sets(results: Sequence[CellResult]) -> dict[tuple[Any, ...], list[_Member]]:
    """Return the recordings of each scene, motion, stream, kind of truth and tolerance."""
    images = {(_recording(row), row["stream"]): row for row in rows_of(results, "images")}
    sets: dict[tuple[Any, ...], list[_Member]] = {}
    for row in rows_of(results, "rows"):
        summary = images[_recording(row), row["stream"]]
        member = _Member(
            row["seed"], _counts(row, summary), _counts(row, summary, "chance"), summary["entropy"]
        )
        sets.setdefault(tuple(row[column] for column in SET), []).append(member)
    return sets


def _best(members: Sequence[Counts]) -> tuple[Counts, int]:
    """Return the counts of a set, and the index of its best threshold."""
    matched = np.sum([member.matched for member in members], axis=0)
    found = np.sum([member.found for member in members], axis=0)
    true = np.sum([member.true for member in members], axis=0)
    total = Counts(matched, found, true)
    best, _ = best_f(total)
    return total, best


def scores(results: Sequence[CellResult]) -> list[dict[str, Any]]:
    """Return the ODS-F of each world, motion, stream, kind of truth and tolerance, with its precision and recall."""
    rows = []
    for key, members in _sets(results).items():
        total, best = _best([member.counts for member in members])
        chance, best_of_chance = _best([member.chance for member in members])
        score = float(total.f_score[best])
        score_of_chance = float(chance.f_score[best_of_chance])
        row = {
            **dict(zip(SET, key, strict=True)),
            "f": score,
            "chance": score_of_chance,
            "margin": score - score_of_chance,
            "std": float(np.std([member.counts.f_score[best] for member in members])),
            "precision": float(total.precision[best]),
            "seeds": len(members),
            "recall": float(total.recall[best]),
            "entropy": float(np.mean([member.entropy[best] for member in members])),
        }
        rows.append(row)
    return rows


def _by_seed(results: Sequence[CellResult]) -> list[dict[str, Any]]:
    """Return score, margin over chance and entropy of each recording, at the best thresholds of its set."""
    rows = []
    for key, members in _sets(results).items():
        _, best = _best([member.counts for member in members])
        _, best_of_chance = _best([member.chance for member in members])
        known = dict(zip(SET, key, strict=True))
        for member in members:
            score = member.counts.f_score[best]
            by_chance = member.chance.f_score[best_of_chance]
            row = {
                **known,
                "seed": member.seed,
                "f": float(score),
                "margin": float(score - by_chance),
                "entropy": member.entropy[best],
            }
            rows.append(row)
    return rows


def _recording(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["scene"], row["camera"], row["seed"]


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return scores at two tolerances, the curve over the tolerance, and the recall by direction."""
    all_scores = scores(results)
    usual = [row for row in all_scores if row["truth"] in (CANNY, GEOMETRY)]
    at_two = [row for row in usual if row["tolerance"] in (USUAL, STRICT)]
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
        _smoothing_table(where(all_scores, tolerance=STRICT)),
        _direction_table(rows_of(results, "sectors")),
    ]


def _in_columns(
    rows: Sequence[dict[str, Any]], columns: Mapping[str, str]
) -> list[tuple[Value, ...]]:
    """Return the values of rows, in the order of the columns."""
    return [tuple(row[name] for name in columns.values()) for row in rows]


def _smoothing_table(scores: Sequence[dict[str, Any]]) -> Table:
    """Return the table of the scores at the strict tolerance over the smoothing of Canny's edges."""
    sigma_of = {name: sigma for sigma, name in SIGMAS.items()}
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
    rows = where(_by_seed(results), truth=CANNY)
    moving = [row for row in rows if row["camera"] != "still"]
    at_rest = where(rows, camera="still")
    usual = where(moving, tolerance=USUAL)
    strict = where(moving, tolerance=STRICT)
    geometry = [
        row
        for row in where(_by_seed(results), truth=GEOMETRY, tolerance=STRICT)
        if row["camera"] != "still"
    ]
    return [
        _is_higher(
            2,
            "Event images of the moving AMI-EV fit the picture's edges better (Canny, 6 px).",
            usual,
            "f",
        ),
        _is_steadier(2, "They do so more steadily over the camera's motions.", usual, "f"),
        _is_higher(2, "Their entropy is higher (moving camera).", usual, "entropy"),
        *_fading(rows_of(results, "sectors")),
        _is_higher(
            None,
            "They are better than chance by a larger margin at 6 px, where chance scores high.",
            usual,
            "margin",
        ),
        _is_higher(
            None,
            "So they are at rest, where the S-EV sees nothing.",
            where(at_rest, tolerance=USUAL),
            "margin",
        ),
        _is_higher(
            None, "The margin over chance is larger at a tolerance of 1.5 px.", strict, "margin"
        ),
        _is_steadier(None, "That margin is steadier over the camera's motions.", strict, "margin"),
        _is_higher(None, "It is larger for geometric edges, at 1.5 px.", geometry, "margin"),
        _is_higher(
            None,
            "It is larger at 1.5 px than with an S-EV with as many events.",
            strict,
            "margin",
            than=Stream.SAME_COUNT,
        ),
        _is_higher(
            None,
            "The entropy is higher than with an S-EV with as many events.",
            usual,
            "entropy",
            than=Stream.SAME_COUNT,
        ),
    ]


def _is_higher(
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


def _is_steadier(
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
        if row["angle"] > 60.0:
            sides.append(row | {"along": True})
        elif row["angle"] < 30.0:
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
        f"the recall by '{stream}' of edges whose normal is over 60° from the motion, "
        "less the same of edges below 30°, relative to the latter,",
        above=above,
        below=below,
    )
