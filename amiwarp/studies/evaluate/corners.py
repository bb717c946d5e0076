"""Evaluation of corners: how long corner tracks live, and how far they are from the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from amiwarp.choices import CornerMethod
from amiwarp.imaging.corners import detect_corners
from amiwarp.simulation.worlds.world import WorldScene
from amiwarp.studies.evaluate import study
from amiwarp.studies.evaluate.measures import GAP_US, LIMITS_PX, link_corners, quality_curve, true_paths
from amiwarp.studies.evaluate.study import CellResult, Chart, Claim, Condition, Settings, Stream, Streams, Table

if TYPE_CHECKING:
    from numpy.typing import NDArray

TITLE = "Corners"
PROTOCOL = (
    "eFAST and Arc* detect corners in the events as recorded. The events are then compensated, and corner events up to "
    f"3 px and {GAP_US / 1000:.0f} ms apart are joined to tracks. The truth of a track is the point of the world that "
    "its first event saw, projected to the image without the prism. A track ends where it is further from the truth "
    "than a limit (5 px in the comparison), or where the point is hidden. Apex 1°."
)
DIFFERENCES = (
    "The paper's main text gives neither the tracker nor the limit at which a track ends. The ranking depends on the "
    "limit: see the curves. Scenes are simulated."
)
VERSION = 2
NEEDS_TRUTH = True

APEX = math.radians(1.0)
"""Apex angle of the paper's evaluation of features [rad]."""
LIMIT_PX = 5.0
"""Distance from the truth at which a track ends in the comparison [px]."""
GAPS_US = (10_000, 25_000, 50_000)
"""Largest times between two corner events of a track, for the sensitivity curve [us]."""
INSTANTS = 5
"""Number of instants whose depth tells which points are hidden."""
SOURCES = {
    Stream.PLAIN: (Stream.PLAIN,),
    Stream.RAW: (Stream.TRUE, Stream.CALIBRATED, Stream.RAW),
}
"""Streams whose positions are those of the events of another stream, by that stream."""
VALUES = ("number", "lifetime_ms", "error_px", "update_hz")
"""Names of the values of each row."""


class _Row(TypedDict):
    detector: CornerMethod
    stream: Stream
    limit: study.Amount
    gap: study.Amount
    number: study.Amount | None
    lifetime_ms: study.Amount | None
    error_px: study.Amount | None
    update_hz: study.Amount | None


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]
    gaps: list[_Row]


def conditions(settings: Settings) -> list[Condition]:
    """Return the room at rest and moving, in full also the desk, with the apex angle of the paper's features."""
    scenes = [c for c in settings.scenes() if c.world != "street" and c.trajectory != "fast"]
    return [replace(condition, apex=APEX) for condition in scenes]


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return number, lifetime, error and update rate of the tracks, for each detector, stream, limit and gap."""
    instants = np.linspace(streams.start_us, streams.end_us - 1, INSTANTS).astype(int)
    frames = [streams.frame(int(t)) for t in instants]
    rows: list[dict[str, Any]] = []
    gaps: list[dict[str, Any]] = []
    for source, members in SOURCES.items():
        span = streams.start_us, streams.end_us
        raw, indices = streams.indexed_window(source, *span)
        place = streams.event_truth(source, *span).place
        assert place is not None
        for detector in CornerMethod:
            found = detect_corners(raw, streams.size, detector=detector)
            for stream in (s for s in members if s in streams.names):
                known = {"detector": detector.value, "stream": stream.value}
                t, xy, which = _corners(streams, stream, found, indices)
                for gap_us in GAPS_US:
                    curve = [known | row for row in _quality(streams, t, xy, place[which], frames, gap_us)]
                    rows += curve if gap_us == GAP_US else []
                    gaps += [row for row in curve if row["limit"] == LIMIT_PX]
    return {"rows": rows, "gaps": gaps}


def _corners(
    streams: Streams, stream: Stream, found: NDArray[np.bool_], indices: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """Return times and places [px] of a stream's corners, and their positions in ``found``.

    ``found``: which events of the recording that the stream belongs to are corners; ``indices``: those events' indices.
    """
    events, rows = streams.indexed_window(stream, streams.start_us, streams.end_us)
    which = rows - indices[0] if len(rows) else rows
    corners = found[which]
    xy = np.stack([events.x[corners], events.y[corners]], axis=1).astype(np.float64)
    return events.t[corners], xy, which[corners]


def _quality(
    streams: Streams, t: NDArray[np.int64], xy: NDArray[np.float64], place: NDArray[np.float32],
    frames: Sequence[Any], gap_us: int,
) -> list[dict[str, Any]]:  # fmt: skip
    """Return the quality of the tracks of corners for each limit; a value is None if there are no tracks."""
    scene = streams.simulation.scene
    assert isinstance(scene, WorldScene)
    tracks = link_corners(t, xy, gap_us=gap_us)
    truth = true_paths(tracks, place[tracks.index[tracks.first]], streams.camera, scene.trajectory, frames)
    found = []
    for q in quality_curve(tracks, truth, LIMITS_PX):
        values = (float(q.number), 1e3 * q.lifetime_s, q.error_px, q.update_hz)
        found.append(
            {"limit": q.limit_px, "gap": gap_us / 1e3, **dict(zip(VALUES, map(study.finite, values), strict=True))}
        )
    return found


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the quality at the limit of the comparison, and the curves of lifetime and error over the limit."""
    rows = study.rows_of(results, "rows")
    by = ("scene", "camera", "detector", "stream")
    names = ("seeds", "tracks", "std of tracks", "lifetime [ms]", "std", "error [px]", "std of error",
             "updates [1/s]", "std of updates")  # fmt: skip
    standard = [r for r in rows if r["limit"] == LIMIT_PX]
    panels = ("scene", "camera", "detector")

    def over_limit(name: str, value: str, shown: str) -> Table:
        return Table(name, f"{shown.partition(' ')[0].capitalize()} over the limit",
                     (*by, "limit [px]", "seeds", shown, "std"), study.grouped(rows, (*by, "limit"), [value]),
                     "A lenient limit hides errors; a strict one ends tracks early.",
                     Chart("limit [px]", shown, "stream", "std", panels=panels))  # fmt: skip

    return [
        Table("corners", f"Tracks of corners that end {LIMIT_PX:g} px from the truth", (*by, *names),
              study.grouped(standard, by, VALUES), "Longer lifetimes and smaller errors are better. "
              "A plain camera at rest has no tracks.",
              Chart("camera", "lifetime [ms]", "stream", "std", panels=("scene", "detector"),
                    kind=study.ChartKind.BARS)),
        over_limit("corners_lifetime", "lifetime_ms", "lifetime [ms]"),
        over_limit("corners_error", "error_px", "error [px]"),
        Table("corners_gap", "Lifetime over the largest time between two corner events of a track",
              (*by, "gap [ms]", "seeds", "lifetime [ms]", "std"),
              study.grouped(study.rows_of(results, "gaps"), (*by, "gap"), ["lifetime_ms"]),
              "A quarter turn at 720 rpm takes 21 ms.",
              Chart("gap [ms]", "lifetime [ms]", "stream", "std", panels=panels)),
    ]  # fmt: skip


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the lifetime of tracks at the limit of the comparison, and for every limit."""
    moving = [r for r in study.rows_of(results, "rows") if r["camera"] != "still"]
    standard = [r for r in moving if r["limit"] == LIMIT_PX]
    text = "Corners of the AMI-EV live substantially longer than those of the S-EV (moving camera)."
    return [
        _longer(standard, text, "curves"),
        _longer(moving, f"The same for every limit from {LIMITS_PX[0]:g} to {LIMITS_PX[-1]:g} px.", "not in the paper"),
    ]


def _longer(rows: Sequence[dict[str, Any]], text: str, paper: str) -> Claim:
    """Judge whether the tracks of the calibrated AMI-EV live longer than those of the S-EV in each case."""
    cases = study.by_case(rows, ("scene", "camera", "detector", "limit"), "lifetime_ms")
    holds, ours = study.compared(cases, Stream.PLAIN, "longer", larger=True)
    rule = f"the mean lifetime of '{Stream.CALIBRATED}' exceeds that of '{Stream.PLAIN}' by more than either spread"
    return Claim.judge(text, paper, ours, holds, rule)
