"""Evaluation of edges: event images against the Canny edges of the grey picture and the edges of the geometry."""

from collections.abc import Sequence
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
    grouped,
    rows_of,
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
        known: dict[int, Masks] = {}
        out = []
        for threshold in THRESHOLDS:
            above = np.asarray(self.image >= threshold, np.bool_)
            count = int(above.sum())
            if count not in known:
                known[count] = (
                    above,
                    np.asarray(library("skimage.morphology").skeletonize(above), np.bool_),
                )
            out.append(known[count])
        return out


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return counts of matches over the thresholds, entropies, recall by direction, and example pictures."""
    images = []
    rows = []
    sectors = []
    pictures = {}
    middle_us = streams.end_us // 2
    names: list[str] = [s.value for s in streams.names if _enough(streams, s)]
    names += [camera.value for camera in Frames]
    for name in names:
        window = _image(streams, name, middle_us)
        masks = window.masks()
        images.append(_summary(name, masks))
        counted = _count(name, window, masks, QUICK_TOLERANCES if settings.quick else TOLERANCES)
        rows += counted
        strict = next(r for r in counted if (r["truth"], r["tolerance"]) == (CANNY, STRICT))
        best = best_f(_counts(strict, images[-1]))[0]
        sectors += _sectors(name, window, masks[best][1])
        pictures[name] = _shown(window.image)
    frame = streams.frame(middle_us)
    pictures["grey picture"] = _shown(grey_picture(frame.intensity))
    true = _true(frame)
    pictures |= {name: _shown(true[name]) for name in (CANNY, GEOMETRY)}
    first = streams.condition.seed == settings.first_seed
    return {
        "images": images,
        "rows": rows,
        "sectors": sectors,
        "pictures": pictures if first else {},
    }


def _enough(streams: Streams, stream: Stream) -> bool:
    """Return whether the stream with the same count has as many events, which it never has at rest."""
    if stream is not Stream.SAME_COUNT:
        return True
    span = streams.end_us // 2 - WINDOW_US // 2, streams.end_us // 2 + WINDOW_US // 2
    return len(streams.window(stream, *span)) >= ENOUGH * streams.count(Stream.RAW, *span)


def _true(frame: FrameTruth) -> dict[str, NDArray[np.bool_]]:
    canny = {name: canny_edges(frame.intensity, sigma) for sigma, name in SIGMAS.items()}
    return {**canny, GEOMETRY: geometric_edges(frame)}


def _image(streams: Streams, name: str, middle_us: int) -> _Image:
    """Return the event image of a stream, or the gradient of a standard camera's frame."""
    span = middle_us - WINDOW_US // 2, middle_us + WINDOW_US // 2
    frame = streams.frame(middle_us)
    if name in set(Frames):
        exposed = streams.last_exposure(Frames(name), span[1])
        assert exposed is not None
        return _Image(normalised(edge_strength(streams.grey_frame(exposed))), _true(frame), frame)
    events = streams.window(Stream(name), *span)
    return _Image(
        normalised(iwe(events, *streams.size, device=streams.device)), _true(frame), frame
    )


def _summary(name: str, masks: Sequence[Masks]) -> dict[str, Any]:
    """Return the number of thinned pixels and the entropy of a stream's image over the thresholds."""
    entropy = np.array([binary_entropy(above) for above, _ in masks])
    found = [int(np.count_nonzero(thin)) for _, thin in masks]
    return {"stream": name, "found": found, "entropy": entropy.round(4).tolist()}


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
        for k, tolerance in enumerate(tolerances):
            row = {
                "stream": name,
                "truth": truth,
                "tolerance": tolerance,
                "matched": matched[k],
                "chance": chance[k],
                "true": int(edges.sum()),
            }
            rows.append(row)
    return rows


def _matched(
    masks: Sequence[Masks], true: NDArray[np.bool_], tolerances: Sequence[float]
) -> list[list[int]]:
    """Return the number of matches for each threshold and tolerance."""
    counts: list[list[int]] = []
    for k, (_, thin) in enumerate(masks):
        same_as_before = k > 0 and thin is masks[k - 1][1]
        if same_as_before:
            counts.append(counts[-1])
            continue
        matches = match(thin, true, tolerances)
        counts.append([int(np.count_nonzero(matched)) for matched in matches])
    return counts


def _counts(row: dict[str, Any], images: dict[str, Any], which: str = "matched") -> Counts:
    """Return the counts of a row of matches and of the summary of its images; ``which`` may be "chance"."""
    matched = np.array(row[which])
    found = np.array(images["found"])
    return Counts(matched, found, np.full(len(found), row["true"]))


def _sectors(name: str, image: _Image, found: NDArray[np.bool_]) -> list[dict[str, Any]]:
    """Return the recall of Canny edges by the angle between the image motion and the normal of the edge."""
    edges = np.linspace(0.0, 90.0, SECTORS + 1)
    at = np.nonzero(image.true[CANNY])
    seen = match(found, image.true[CANNY], [STRICT])[0][at]
    angle = _angle(image.frame)[at]
    sector = np.clip(np.digitize(angle, edges) - 1, 0, SECTORS - 1)
    rows = []
    for k in range(SECTORS):
        chosen = np.isfinite(angle) & (sector == k)
        if chosen.any():
            middle = float(edges[k : k + 2].mean())
            rows.append({"stream": name, "angle": middle, "recall": float(seen[chosen].mean())})
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
    images = {(_recording(r), r["stream"]): r for r in rows_of(results, "images")}
    sets: dict[tuple[Any, ...], list[_Member]] = {}
    for row in rows_of(results, "rows"):
        seen = images[_recording(row), row["stream"]]
        member = _Member(
            row["seed"], _counts(row, seen), _counts(row, seen, "chance"), seen["entropy"]
        )
        sets.setdefault(tuple(row[c] for c in SET), []).append(member)
    return sets


def _best(members: Sequence[Counts]) -> tuple[Counts, int]:
    """Return the counts of a set, and the index of its best threshold."""
    total = Counts(
        *(np.sum([getattr(c, n) for c in members], axis=0) for n in ("matched", "found", "true"))
    )
    return total, best_f(total)[0]


def scores(results: Sequence[CellResult]) -> list[dict[str, Any]]:
    """Return the ODS-F of each world, motion, stream, kind of truth and tolerance, with its precision and recall."""
    out = []
    for key, members in _sets(results).items():
        total, best = _best([m.counts for m in members])
        chance, worst = _best([m.chance for m in members])
        f = float(total.f_score[best])
        level = float(chance.f_score[worst])
        out.append(
            {
                **dict(zip(SET, key, strict=True)),
                "f": f,
                "chance": level,
                "margin": f - level,
                "std": float(np.std([m.counts.f_score[best] for m in members])),
                "precision": float(total.precision[best]),
                "seeds": len(members),
                "recall": float(total.recall[best]),
                "entropy": float(np.mean([m.entropy[best] for m in members])),
            }
        )
    return out


def _by_seed(results: Sequence[CellResult]) -> list[dict[str, Any]]:
    """Return score, margin over chance and entropy of each recording, at the best thresholds of its set."""
    out = []
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
            out.append(row)
    return out


def _recording(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["scene"], row["camera"], row["seed"]


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return scores at two tolerances, the curve over the tolerance, and the recall by direction."""
    found = scores(results)
    names = (
        "scene",
        "camera",
        "true edges",
        "tolerance [px]",
        "stream",
        "ODS-F",
        "std",
        "chance",
        "margin over chance",
        "precision",
        "recall",
        "entropy [bit/px]",
        "seeds",
    )
    keys = (
        "scene",
        "camera",
        "truth",
        "tolerance",
        "stream",
        "f",
        "std",
        "chance",
        "margin",
        "precision",
        "recall",
        "entropy",
        "seeds",
    )
    usual = [r for r in found if r["truth"] in (CANNY, GEOMETRY)]
    widths = {name: sigma for sigma, name in SIGMAS.items()}
    smoothed = [
        r | {"sigma": widths[r["truth"]]}
        for r in found
        if r["truth"] in widths and r["tolerance"] == STRICT
    ]
    sectors = grouped(
        rows_of(results, "sectors"), ("scene", "camera", "angle", "stream"), ["recall"]
    )
    return [
        Table(
            "edges",
            "F-score, entropy, precision and recall at two tolerances",
            names,
            [tuple(r[k] for k in keys) for r in usual if r["tolerance"] in (USUAL, STRICT)],
            "Scores belong to the best threshold of each row. The spread is over the seeds at this threshold.",
        ),
        Table(
            "edges_tolerance",
            "F-score over the tolerance",
            names,
            [tuple(r[k] for k in keys) for r in usual],
            "A wide tolerance hides blur and errors of the compensation, and rewards chance.",
            Chart(
                "tolerance [px]", "ODS-F", "stream", "std", panels=("scene", "camera", "true edges")
            ),
        ),
        Table(
            "edges_margin",
            "Margin of the F-score over chance, over the tolerance",
            names,
            [tuple(r[k] for k in keys) for r in usual],
            "What a stream's score has above its own chance.",
            Chart(
                "tolerance [px]",
                "margin over chance",
                "stream",
                panels=("scene", "camera", "true edges"),
            ),
        ),
        Table(
            "edges_canny",
            "Margin over chance over the smoothing of the true edges (Canny, 1.5 px)",
            ("scene", "camera", "σ [px]", "stream", "margin over chance", "std", "ODS-F", "chance"),
            [
                tuple(
                    r[k]
                    for k in ("scene", "camera", "sigma", "stream", "margin", "std", "f", "chance")
                )
                for r in smoothed
            ],
            "With little smoothing the true edges include the fine texture of walls, which chance finds too.",
            Chart("σ [px]", "margin over chance", "stream", "std", panels=("scene", "camera")),
        ),
        Table(
            "edges_direction",
            "Recall by the direction of edges (Canny, 1.5 px)",
            (
                "scene",
                "camera",
                "angle between motion and edge normal [deg]",
                "stream",
                "windows",
                "recall",
                "std",
            ),
            sectors,
            "At 90° an edge lies along the motion, and a plain event camera loses it. The threshold is the "
            "best of the recording. A still camera has no motion.",
            Chart(
                "angle between motion and edge normal [deg]",
                "recall",
                "stream",
                "std",
                panels=("scene", "camera"),
                kind=ChartKind.LINES,
            ),
        ),
    ]


def pictures(results: Sequence[CellResult]) -> list[Picture]:
    """Return the first event images of each motion, side by side."""
    out = []
    for camera in dict.fromkeys(
        r.condition.trajectory for r in results if isinstance(r.condition, Condition)
    ):
        cells = [
            r
            for r in results
            if isinstance(r.condition, Condition) and r.condition.trajectory == camera
        ]
        given = next((r.values["pictures"] for r in cells if r.values.get("pictures")), None)
        if given is not None:
            names = [
                n
                for n in (
                    "grey picture",
                    CANNY,
                    GEOMETRY,
                    Stream.PLAIN,
                    Stream.CALIBRATED,
                    Frames.FAST,
                )
                if n in given
            ]
            caption = f"Camera {camera}. From left to right: {', '.join(names)}."
            out.append(
                Picture(
                    f"edges_{camera}",
                    caption,
                    [_mosaic([decode_picture(given[n]) for n in names])],
                )
            )
    return out


def _mosaic(images: Sequence[NDArray[np.uint8]], columns: int = 3) -> NDArray[np.uint8]:
    """Return images of one size side by side, in rows, with white gaps."""
    height, width = images[0].shape
    gap = 6
    rows = -(-len(images) // columns)
    out = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap), 255, np.uint8)
    for k, image in enumerate(images):
        top = (k // columns) * (height + gap)
        left = (k % columns) * (width + gap)
        out[top : top + height, left : left + width] = image
    return out


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the F-score, its steadiness, the entropy and the recall by direction; and robustness."""
    rows = _by_seed(results)

    def more(
        number: int | None,
        text: str,
        value: str,
        *,
        other: Stream = Stream.PLAIN,
        moving: bool = True,
        tolerance: float = USUAL,
        truth: str = CANNY,
    ) -> Claim:
        chosen = [
            r
            for r in rows
            if r["tolerance"] == tolerance
            and r["truth"] == truth
            and (r["camera"] != "still") == moving
        ]
        found = differences(chosen, value, {"stream": Stream.CALIBRATED}, {"stream": other})
        return judge(
            number,
            text,
            found,
            f"{VALUES_IN_WORDS[value]} of '{Stream.CALIBRATED}' less the same of '{other}'",
            above=0.0,
        )

    def steadier(number: int | None, text: str, value: str, tolerance: float) -> Claim:
        moving = [
            r
            for r in rows
            if r["camera"] != "still" and r["tolerance"] == tolerance and r["truth"] == CANNY
        ]
        found = differences(
            ranges(moving, value),
            value,
            {"stream": Stream.CALIBRATED},
            {"stream": Stream.PLAIN},
            by=("scene",),
        )
        return judge(
            number,
            text,
            found,
            f"the range of {VALUES_IN_WORDS[value]} over the motions of "
            f"'{Stream.CALIBRATED}' less the same of '{Stream.PLAIN}'",
            below=0.0,
        )

    return [
        more(
            2,
            "Event images of the moving AMI-EV fit the picture's edges better (Canny, 6 px).",
            "f",
        ),
        steadier(2, "They do so more steadily over the camera's motions.", "f", USUAL),
        more(2, "Their entropy is higher (moving camera).", "entropy"),
        *_fading(rows_of(results, "sectors")),
        more(
            None,
            "They are better than chance by a larger margin at 6 px, where chance scores high.",
            "margin",
        ),
        more(None, "So they are at rest, where the S-EV sees nothing.", "margin", moving=False),
        more(
            None,
            "The margin over chance is larger at a tolerance of 1.5 px.",
            "margin",
            tolerance=STRICT,
        ),
        steadier(None, "That margin is steadier over the camera's motions.", "margin", STRICT),
        more(
            None,
            "It is larger for geometric edges, at 1.5 px.",
            "margin",
            tolerance=STRICT,
            truth=GEOMETRY,
        ),
        more(
            None,
            "It is larger at 1.5 px than with an S-EV with as many events.",
            "margin",
            tolerance=STRICT,
            other=Stream.SAME_COUNT,
        ),
        more(
            None,
            "The entropy is higher than with an S-EV with as many events.",
            "entropy",
            other=Stream.SAME_COUNT,
        ),
    ]


def _fading(rows: Sequence[dict[str, Any]]) -> list[Claim]:
    """Judge whether edges along the motion fade from the S-EV, and whether they do not from the AMI-EV."""
    sides = [
        r | {"along": r["angle"] > 60.0} for r in rows if r["angle"] > 60.0 or r["angle"] < 30.0
    ]

    def judged(text: str, stream: Stream, **limit: Any) -> Claim:
        across = {"stream": stream, "along": False}
        found = differences(sides, "recall", across | {"along": True}, across, relative=True)
        return judge(
            3,
            text,
            found,
            f"the recall by '{stream}' of edges whose normal is over 60° from the motion, "
            "less the same of edges below 30°, relative to the latter,",
            **limit,
        )

    return [
        judged(
            "The S-EV finds fewer of the edges along the motion than of those across it.",
            Stream.PLAIN,
            below=0.0,
        ),
        judged(
            f"The AMI-EV finds no fewer of them, within {KEPT:.0%}.", Stream.CALIBRATED, above=-KEPT
        ),
    ]
