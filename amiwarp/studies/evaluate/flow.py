"""Evaluation of optical flow on objects that do not move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, TypedDict

import numpy as np
from scipy import ndimage

from amiwarp.imaging.warped_image import iwe
from amiwarp.studies.evaluate.conditions import FOCAL_PX, Condition, Stream, Streams
from amiwarp.studies.evaluate.flow_estimation import flow_by_contrast, flow_by_dis
from amiwarp.studies.evaluate.measures.flow_error import flow_error
from amiwarp.studies.evaluate.results import (
    NO_RESULT,
    Amount,
    CellResult,
    Chart,
    Claim,
    Settings,
    Share,
    Table,
    grouped,
    mean_of,
    rows_of,
    where_calibrated,
    wide_focal,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.truth import FrameTruth

TITLE = "Optical flow"
PROTOCOL = (
    "Flow is estimated in two ways. DIS (OpenCV, preset medium) compares the event images of two successive windows. "
    "Contrast maximisation fits the camera's rotation to one window, and then a velocity to each tile. The endpoint "
    "error (EPE) is the distance from the true flow, times the length of a window, on objects that do not move: at the "
    "pixels at which the stream has events, and at the edges of the true picture, which are the same pixels for all "
    "streams."
)
DIFFERENCES = (
    "The paper's main text names neither the algorithm nor the interval, which determines an error in pixels. Its "
    "difference of +0.19 px is marked for a comparison of its sign and order only. The settings of the contrast "
    "maximisation were chosen on recordings of seed 0, whose textures and motions differ from those of the seeds that "
    "are scored; it takes at most 100,000 events of a window, evenly thinned."
)
VERSION = 2
NEEDS_TRUTH = True

TURNS = (0.25, 0.5, 1.0)
"""Lengths of the windows [turns]."""
STANDARD_TURNS = 0.25
"""Length of the windows of the comparison with the paper [turns]: a quarter turn, its least."""
EDGE_CONTRAST = 0.1
"""Least slope of the true log luminance at an edge [1/px]."""
DARK = 0.02
"""Luminance that is added before the logarithm, as in the simulated sensor."""
PAPER_PX = 0.19
"""Increase of the endpoint error by the prism in the paper [px]."""


class _Row(TypedDict):
    stream: Stream
    method: Literal["DIS", "contrast maximisation"]
    turns: Amount
    pixels: Literal["events", "edges"]
    epe: Amount | None
    outliers: Share | None
    share: Share


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]


def conditions(settings: Settings) -> list[Condition]:
    """Return the room with a moving camera; in full also the ball, whose body is left out, and fast motion."""
    room = settings.conditions(world="room", trajectory="handheld")
    if settings.quick:
        return room
    more = [("room", "fast", FOCAL_PX), ("desk", "handheld", FOCAL_PX), ("ball", "handheld", wide_focal(settings))]
    return room + [c for world, motion, focal in more
                   for c in settings.conditions(world=world, trajectory=motion, focal_px=focal)]  # fmt: skip


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return the errors of each stream, method, length of the window and set of pixels."""
    turn_us = 60e6 / streams.condition.rpm
    middle = (streams.start_us + streams.end_us) // 2
    truth = streams.frame(middle)
    still = ~np.isin(truth.instance, moving_instances(streams))
    edges = still & edge_pixels(truth)
    rows = []
    # events from a longer window would change the interval, so the stream of equal count is left out
    names = [stream for stream in streams.names if stream is not Stream.SAME_COUNT]
    for turns in TURNS:
        window = round(turns * turn_us)
        if 2 * window > streams.end_us - streams.start_us:
            continue
        for stream in names:
            for method, flow, seen in _estimates(streams, stream, middle, window):
                for pixels, where in (("events", seen & still), ("edges", edges)):
                    found = flow_error(flow * window * 1e-6, truth.flow * window * 1e-6, where)
                    rows.append({"stream": stream.value, "method": method, "turns": turns, "pixels": pixels,
                                 "epe": _number(found.epe), "outliers": _number(found.outliers),
                                 "share": float(where.mean())})  # fmt: skip
    return {"rows": rows}


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _estimates(
    streams: Streams, stream: Stream, middle: int, window: int
) -> list[tuple[str, NDArray[np.float32], NDArray[np.bool_]]]:
    """Return both methods' names, flows [px/s] and the pixels at which they have events."""
    first, second = streams.window(stream, middle - window, middle), streams.window(stream, middle, middle + window)
    one = streams.window(stream, middle - window // 2, middle + window - window // 2)
    size = streams.size
    dis = flow_by_dis(first, second, size, window * 1e-6)
    both = (iwe(first, *size) > 0.5) & (iwe(second, *size) > 0.5)
    contrast = flow_by_contrast(one, streams.camera)
    return [("DIS", dis, both), ("contrast maximisation", contrast, iwe(one, *size) > 0.5)]


def moving_instances(streams: Streams) -> list[int]:
    """Return the instance numbers of the bodies that move."""
    world = streams.simulation.scene.world  # type: ignore[union-attr]  # the scene of a condition is a world
    names = {body.instance or body.name for body in world.moving}
    return [k + 1 for k, name in enumerate(world.instances) if name in names]


def edge_pixels(truth: FrameTruth) -> NDArray[np.bool_]:
    """Return the pixels at edges of the true picture, shape (height, width)."""
    log = np.log(truth.intensity.astype(np.float64) + DARK)
    return np.asarray(ndimage.gaussian_gradient_magnitude(log, 1.0) > EDGE_CONTRAST)


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the errors of the paper's protocol, and those over the length of the window."""
    rows = rows_of(results, "rows")
    names, values = ("scene", "camera", "pixels", "method", "stream"), ["epe", "outliers", "share"]
    columns = ("seeds", "EPE [px]", "std", "outliers", "std of outliers", "share of pixels", "std of share")
    standard = [r for r in rows if r["turns"] == STANDARD_TURNS]
    by_length = [r for r in rows if r["pixels"] == "edges"]
    return [
        Table("flow", "Endpoint error on still objects, windows of a quarter turn", (*names, *columns),
              grouped(standard, names, values), "Outliers: share of pixels with an error above 3 px."),
        Table("flow_window", "Endpoint error at edges over the length of the window",
              ("scene", "camera", "method", "stream", "window [turns]", *columns[:3]),
              grouped(by_length, ("scene", "camera", "method", "stream", "turns"), ["epe"]),
              "Errors in pixels grow with the length, as the motion does.",
              Chart("window [turns]", "EPE [px]", "stream", "std", panels=("scene", "camera", "method"), log_x=True)),
    ]  # fmt: skip


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdict on the small increase of the error by the prism, for each method."""
    rows = where_calibrated(rows_of(results, "rows"))
    rows = [r for r in rows if r["turns"] == STANDARD_TURNS and r["pixels"] == "edges"]
    return [_claim([r for r in rows if r["method"] == method], method) for method in ("DIS", "contrast maximisation")]


def _claim(rows: Sequence[dict[str, Any]], method: str) -> Claim:
    ours, plain = (
        mean_of([r for r in rows if r["stream"] == stream], "epe", lambda _: True)
        for stream in (Stream.CALIBRATED, Stream.PLAIN)
    )
    text = f"With the prism, compensated, the endpoint error is only slightly larger ({method})."
    rule = f"the mean of '{Stream.CALIBRATED}' is at most twice {PAPER_PX} px above that of '{Stream.PLAIN}', at edges"
    rule += ", over the recordings that could be calibrated"
    if ours is None or plain is None:
        return Claim.judge(text, f"+{PAPER_PX} px", NO_RESULT, None, rule)
    shown = f"{ours - plain:+.2f} px ({plain:.2f} to {ours:.2f} px)"
    return Claim.judge(text, f"+{PAPER_PX} px", shown, ours - plain <= 2.0 * PAPER_PX, rule)
