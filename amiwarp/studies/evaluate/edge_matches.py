"""Matches of event images with true edges, and the recall of edges by their direction."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.truth import FrameTruth
from amiwarp.imaging.iwe import iwe
from amiwarp.studies.evaluate.edge_agreement import THRESHOLDS, binary_entropy, match, normalised
from amiwarp.studies.evaluate.libraries import library
from amiwarp.studies.evaluate.streams import Frames, Stream, Streams
from amiwarp.studies.evaluate.true_edges import (
    CANNY_SIGMA,
    canny_edges,
    edge_strength,
    geometric_edges,
    grey_picture,
)

WINDOW_US = 33_000
"""Length of a window [us]."""
USUAL_TOLERANCE_PX = 6.0
"""Tolerance of the comparison with the paper [px]."""
STRICT_TOLERANCE_PX = 1.5
"""Tolerance that hides no errors of the compensation [px]."""
CANNY = "Canny"
"""Kind of true edges: Canny's, of the grey picture."""
GEOMETRY = "geometry"
"""Kind of true edges: steps of instance, depth or normal."""
TRUTH_OF_SIGMA = {1.0: "Canny, σ 1 px", CANNY_SIGMA: CANNY, 3.0: "Canny, σ 3 px"}
"""Standard deviations of Canny's Gaussian in the sensitivity curve [px], and the kinds of edges that they give. The
curve is that at the strict tolerance."""
SECTORS = 6
"""Number of classes of the angle between image motion and the normal of an edge."""
SLOWEST = 5.0
"""Slowest image motion whose direction counts [px/s]."""
Masks = tuple["NDArray[np.bool_]", "NDArray[np.bool_]"]
"""Pixels above a threshold, and the same thinned."""


@dataclass(frozen=True)
class WindowImage:
    """Event image of a window with its true edges."""

    values: NDArray[np.float64]
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
            above = np.asarray(self.values >= threshold, np.bool_)
            count = int(above.sum())
            if count not in masks_by_count:
                masks_by_count[count] = above, np.asarray(skeletonize(above), np.bool_)
            masks.append(masks_by_count[count])
        return masks


def true_edges(frame: FrameTruth) -> dict[str, NDArray[np.bool_]]:
    """Return the true edges of an instant by their kind."""
    canny = {name: canny_edges(frame.intensity, sigma) for sigma, name in TRUTH_OF_SIGMA.items()}
    return {**canny, GEOMETRY: geometric_edges(frame)}


def window_image(streams: Streams, name: str, middle_us: int) -> WindowImage:
    """Return the event image of a stream, or the gradient of a standard camera's frame."""
    span = middle_us - WINDOW_US // 2, middle_us + WINDOW_US // 2
    frame = streams.frame(middle_us)
    if name in set(Frames):
        exposed = streams.last_exposure(Frames(name), span[1])
        if exposed is None:
            raise AmiwarpError(
                f"no frame of {name} is complete at {span[1]} us; measure a longer recording",
                ErrorCode.CONTENT_MISSING,
            )
        return WindowImage(
            normalised(edge_strength(streams.grey_frame(exposed))), true_edges(frame), frame
        )
    events = streams.window(Stream(name), *span)
    image = iwe(events, *streams.size, device=streams.device)
    return WindowImage(normalised(image), true_edges(frame), frame)


def summary_of(name: str, masks: Sequence[Masks]) -> dict[str, Any]:
    """Return the number of thinned pixels and the entropy of a stream's image over the thresholds."""
    entropy = np.array([binary_entropy(above) for above, _ in masks])
    counts = [int(np.count_nonzero(thin)) for _, thin in masks]
    return {"stream": name, "found": counts, "entropy": entropy.round(4).tolist()}


def match_rows(
    name: str, image: WindowImage, masks: Sequence[Masks], tolerances: Sequence[float]
) -> list[dict[str, Any]]:
    """Return the number of matches over the thresholds for each kind of true edges and tolerance.

    ``tolerances``: tolerances of the comparison [px]; the other kinds have the strict one. ``chance`` belongs to the
    true edges turned by 180 deg, which have the same matches as a turned image.
    """
    rows = []
    for truth, edges in image.true.items():
        is_compared = truth in (CANNY, GEOMETRY)
        of_truth = tolerances if is_compared else (STRICT_TOLERANCE_PX,)
        turned = edges[::-1, ::-1]
        matched = np.transpose(_matched(masks, edges, of_truth)).tolist()
        chance = np.transpose(_matched(masks, turned, of_truth)).tolist()
        for index, tolerance in enumerate(of_truth):
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


def recall_by_direction(
    name: str, image: WindowImage, thinned: NDArray[np.bool_]
) -> list[dict[str, Any]]:
    """Return the recall of Canny edges by the angle between the image motion and the normal of the edge.

    ``thinned``: pixels of the image's edges.
    """
    limits_deg = np.linspace(0.0, 90.0, SECTORS + 1)
    true = image.true[CANNY]
    (matched,) = match(thinned, true, [STRICT_TOLERANCE_PX])
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
