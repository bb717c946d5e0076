"""Evaluation of corners: how long corner tracks live, and how far they are from the truth."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, TypedDict

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import CornerMethod
from amiwarp.events.truth import Cause, FrameTruth
from amiwarp.imaging.corners import detect_corners
from amiwarp.simulation.worlds.world_scene import WorldScene
from amiwarp.studies.evaluate.charts import CHANCE
from amiwarp.studies.evaluate.claims import Claim, differences, judge, ranges, untestable
from amiwarp.studies.evaluate.conditions import FEATURES_APEX, Condition, Settings
from amiwarp.studies.evaluate.corner_tracks import GAP_US, Tracks, link_corners
from amiwarp.studies.evaluate.frame_tracks import track_frames
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    ChartKind,
    Table,
    finite,
    grouped,
    rows_of,
    where,
)
from amiwarp.studies.evaluate.streams import Frames, Stream, Streams
from amiwarp.studies.evaluate.track_quality import LIMITS_PX, quality_curve
from amiwarp.studies.evaluate.track_truth import seen_places, true_paths

TITLE = "Corners"
PROTOCOL = (
    "eFAST and Arc* detect corners in the events as recorded. The events are then compensated, and corner events up to "
    f"3 px and {GAP_US / 1000:.0f} ms apart are joined to tracks. The truth of a track is the point of the world that "
    "its first event saw, projected to the image without the prism. A track ends where it is further from the truth "
    "than a limit (5 px in the comparison), or where the point is hidden. Tracks alive at a time are the sum of all "
    "lifetimes over the duration. Chance are as many corners as the calibrated AMI-EV has, at its times and at "
    "random places: the tracker also joins these, within its 3 px. Apex 1°. In frames of the standard camera, "
    "corners are found by Shi and Tomasi, tracked by Lucas and Kanade (OpenCV). The error of the compensation is the "
    "distance of events from where a camera without a prism would see their points."
)
DIFFERENCES = (
    "The paper's main text gives neither the tracker nor the limit at which a track ends. The ranking depends on the "
    "limit: see the curves. Scenes are simulated."
)
VERSION = 4
NEEDS_TRUTH = True

LIMIT_PX = 5.0
"""Distance from the truth at which a track ends in the comparison [px]."""
SOME_LIMITS_PX = (2.0, LIMIT_PX, 10.0)
"""Distances for which verdicts are given [px]."""
GAPS_US = (10_000, 25_000, 50_000)
"""Largest times between two corner events of a track, for the sensitivity curve [us]."""
INSTANTS = 5
"""Number of instants whose depth tells which points are hidden."""
SOURCES = {
    Stream.PLAIN: (Stream.PLAIN,),
    Stream.RAW: (Stream.TRUE, Stream.CALIBRATED, Stream.SELF, Stream.RAW),
}
"""Streams whose positions are the positions of the events of another stream, by that stream."""
PAPER_ERROR_PX = (1.0, 2.0)
"""Range of an error of about 1.5 px [px]."""
SLIGHT_PX = 1.0
SAME_PX = 0.1
"""Changes of the error that count as slight and as none [px]."""
FAR = 1.0
"""Relative difference of an update rate that is far above another one."""
SUBSTANTIAL = 0.25
"""Increase of the lifetime that counts as substantial, relative to the S-EV's."""
VALUES = ("number", "alive", "lifetime_ms", "error_px", "update_hz")
"""Names of the values of each row."""
FRAME_CORNERS = "frames"
"""Detector of the corners of a standard camera, among the detectors of corners of events."""
SERIES = ("scene", "camera", "detector", "stream")
PANELS = ("scene", "camera", "detector")
"""Columns whose values make a line of a table or a curve of a chart, and a panel of a chart."""
AMI = {"stream": Stream.CALIBRATED}
PLAIN = {"stream": Stream.PLAIN}
FAST_FRAMES = {"stream": Frames.FAST, "detector": FRAME_CORNERS}
"""Rows that verdicts compare: of the AMI-EV, of the S-EV, and of a standard camera with 60 frames/s."""
RELATIVE_TO_PLAIN = (
    f"of '{Stream.CALIBRATED}' less the same of '{Stream.PLAIN}', relative to the latter,"
)
TRACKS_END = f"if tracks end {LIMIT_PX:g} px from the truth"
"""Parts of the texts of verdicts."""


class _Row(TypedDict):
    detector: Literal["frames", *CornerMethod]  # type: ignore[valid-type]
    stream: Literal["chance", *Stream, *Frames]  # type: ignore[valid-type]
    limit: Amount
    gap: Amount
    number: Amount | None
    alive: Amount | None
    lifetime_ms: Amount | None
    error_px: Amount | None
    update_hz: Amount | None


class _Error(TypedDict):
    stream: Stream
    median_px: Amount | None
    rms_px: Amount | None


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]
    gaps: list[_Row]
    errors: list[_Error]


def conditions(settings: Settings) -> list[Condition]:
    """Return the scenes without the street, with the apex angle of the paper's features."""
    scenes = [c for c in settings.scenes() if c.world != "street"]
    return [replace(condition, apex=FEATURES_APEX) for condition in scenes]


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return number, lifetime, error and update rate of the tracks, for each detector, stream, limit and gap."""
    instants = np.linspace(streams.start_us, streams.end_us - 1, INSTANTS).astype(int)
    frames = [streams.frame(int(t)) for t in instants]
    rows: list[dict[str, Any]] = []
    gaps: list[dict[str, Any]] = []
    names = streams.names_with_own(settings)
    for source, members in SOURCES.items():
        compared = [stream for stream in members if stream in names]
        for row in _event_quality(streams, source, compared, frames):
            if row["gap"] == GAP_US / 1e3:
                rows.append(row)
            if row["limit"] == LIMIT_PX and row["stream"] != CHANCE:
                gaps.append(row)
    for kind in Frames:
        known = {"detector": FRAME_CORNERS, "stream": kind.value, "gap": kind.interval_us / 1e3}
        rows += [known | row for row in _frame_quality(streams, kind, frames)]
    errors = [
        {"stream": stream.value, **_compensation_error(streams, stream)}
        for stream in SOURCES[Stream.RAW]
        if stream in names
    ]
    return {"rows": rows, "gaps": gaps, "errors": errors}


def _event_quality(
    streams: Streams, source: Stream, compared: Sequence[Stream], frames: Sequence[FrameTruth]
) -> list[dict[str, Any]]:
    """Return the quality of the tracks of event corners, for each detector, stream, limit and gap, and by chance.

    The corners are found in the events of ``source``. They lie where the ``compared`` streams place these events.
    """
    span = streams.start_us, streams.end_us
    events, indices = streams.indexed_window(source, *span)
    place = streams.event_truth(source, *span).place
    assert place is not None
    rows: list[dict[str, Any]] = []
    for detector in CornerMethod:
        is_corner = detect_corners(events, streams.size, detector=detector)
        for stream in compared:
            known = {"detector": detector.value, "stream": stream.value}
            t, xy, which = _corners(streams, stream, is_corner, indices)
            if stream is Stream.CALIBRATED:
                by_chance = _chance_quality(streams, t, frames)
                rows += [known | {"stream": CHANCE} | row for row in by_chance]
            for gap_us in GAPS_US:
                quality = _quality(streams, t, xy, place[which], frames, gap_us)
                rows += [known | row for row in quality]
    return rows


def _frame_quality(
    streams: Streams, kind: Frames, frames: Sequence[FrameTruth]
) -> list[dict[str, Any]]:
    """Return the quality of the tracks in the frames of a standard camera, for each limit."""
    scene = streams.simulation.scene
    times = streams.exposures(kind).tolist()
    assert isinstance(scene, WorldScene)
    tracks = track_frames([streams.grey_frame(t) for t in times], times)
    instants = times if scene.trajectory.moves else [streams.start_us]
    views = [streams.frame(t) for t in instants]
    return _curve(streams, tracks, _begun_on(streams, tracks, views), frames)


def _chance_quality(
    streams: Streams, t: NDArray[np.int64], frames: Sequence[FrameTruth]
) -> list[dict[str, Any]]:
    """Return the quality of the tracks of corners at random places, for each limit. ``t``: their times [us]."""
    places = np.random.default_rng(streams.condition.seed).uniform(
        -0.5, np.array(streams.size) - 0.5, (len(t), 2)
    )
    tracks = link_corners(t, places)
    curve = _curve(streams, tracks, _begun_on(streams, tracks, frames), frames)
    return [row | {"gap": GAP_US / 1e3} for row in curve]


def _begun_on(
    streams: Streams, tracks: Tracks, frames: Sequence[FrameTruth]
) -> NDArray[np.float64]:
    """Return the point of the world at the first place of each track [m], shape (tracks, 3), by the nearest frame."""
    scene = streams.simulation.scene
    assert isinstance(scene, WorldScene)
    t = tracks.t[tracks.first]
    xy = tracks.xy[tracks.first]
    nearest = np.abs(t[:, None] - np.array([frame.t_us for frame in frames])).argmin(axis=1)
    places = np.full((len(t), 3), np.nan)
    for index in np.unique(nearest).tolist():
        chosen = nearest == index
        places[chosen] = seen_places(
            frames[index], streams.camera, scene.trajectory, xy[chosen], t[chosen]
        )
    return places


def _compensation_error(streams: Streams, stream: Stream) -> dict[str, float | None]:
    """Return median and rms of the distance of a stream's events from the true places of what they saw [px]."""
    span = streams.start_us, streams.end_us
    events = streams.window(stream, *span)
    truth = streams.event_truth(stream, *span)
    assert truth.points is not None
    assert truth.cause is not None
    x, y = truth.points.T
    error = np.hypot(events.x - x, events.y - y)
    error = error[truth.cause == Cause.SIGNAL.code]
    error = error[np.isfinite(error)]
    if not len(error):
        return {"median_px": None, "rms_px": None}
    median = float(np.median(error))
    rms = float(np.sqrt(np.mean(error**2)))
    return {"median_px": finite(median), "rms_px": finite(rms)}


def _corners(
    streams: Streams, stream: Stream, is_corner: NDArray[np.bool_], indices: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """Return times [us] and places [px] of a stream's corners, and their positions in ``is_corner``.

    ``is_corner``: which events of the recording that the stream belongs to are corners; ``indices``: the indices of
    these events.
    """
    events, rows = streams.indexed_window(stream, streams.start_us, streams.end_us)
    which = rows - indices[0] if len(rows) else rows
    corners = is_corner[which]
    xy = np.stack([events.x[corners], events.y[corners]], axis=1).astype(np.float64)
    return events.t[corners], xy, which[corners]


def _quality(
    streams: Streams,
    t: NDArray[np.int64],
    xy: NDArray[np.float64],
    place: NDArray[np.float32],
    frames: Sequence[Any],
    gap_us: int,
) -> list[dict[str, Any]]:
    """Return the quality of the tracks of corners for each limit; a value is None if there are no tracks."""
    tracks = link_corners(t, xy, gap_us=gap_us)
    curve = _curve(streams, tracks, place[tracks.index[tracks.first]], frames)
    return [row | {"gap": gap_us / 1e3} for row in curve]


def _curve(
    streams: Streams, tracks: Tracks, places: NDArray[np.floating], frames: Sequence[FrameTruth]
) -> list[dict[str, Any]]:
    """Return the quality of tracks for each limit as values of rows. ``places``: where each track begins [m]."""
    scene = streams.simulation.scene
    assert isinstance(scene, WorldScene)
    truth = true_paths(tracks, places, streams.camera, scene.trajectory, frames)
    span_s = (streams.end_us - streams.start_us) * 1e-6
    rows = []
    for quality in quality_curve(tracks, truth, LIMITS_PX):
        values = (
            float(quality.tracks),
            quality.total_s / span_s,
            1e3 * quality.lifetime_s,
            quality.error_px,
            quality.update_hz,
        )
        by_name = dict(zip(VALUES, map(finite, values), strict=True))
        rows.append({"limit": quality.limit_px, **by_name})
    return rows


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the quality at the limit of the comparison, and the curves of lifetime and error over the limit."""
    rows = rows_of(results, "rows")
    return [
        _quality_table(where(rows, limit=LIMIT_PX)),
        _compensation_table(rows_of(results, "errors")),
        _limit_table(rows, "corners_lifetime", "lifetime_ms", "lifetime [ms]"),
        _limit_table(rows, "corners_error", "error_px", "error [px]"),
        _gap_table(rows_of(results, "gaps")),
    ]


def _quality_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the table of all values of the tracks at the limit of the comparison."""
    columns = (
        "seeds",
        "tracks",
        "std of tracks",
        "alive at a time",
        "std of alive",
        "lifetime [ms]",
        "std",
        "error [px]",
        "std of error",
        "updates [1/s]",
        "std of updates",
    )
    return Table(
        "corners",
        f"Tracks of corners that end {LIMIT_PX:g} px from the truth",
        (*SERIES, *columns),
        grouped(rows, SERIES, VALUES),
        "Longer lifetimes and smaller errors are better. A plain camera at rest has no tracks.",
        Chart(
            "camera",
            "lifetime [ms]",
            "stream",
            "std",
            panels=("scene", "detector"),
            kind=ChartKind.BARS,
        ),
    )


def _compensation_table(errors: Sequence[dict[str, Any]]) -> Table:
    """Return the table of the compensation's error."""
    return Table(
        "corners_compensation",
        "Error of the compensation, apex 1°",
        ("scene", "camera", "stream", "seeds", "median [px]", "std", "rms [px]", "std of rms"),
        grouped(errors, ("scene", "camera", "stream"), ["median_px", "rms_px"]),
        "Events of signals; rounding to pixels does not count, as both share a pixel. The sensor's delay counts: "
        "the true model holds for the moment when the light changed, the true place for the event.",
    )


def _limit_table(rows: Sequence[dict[str, Any]], name: str, value: str, label: str) -> Table:
    """Return the table of a value of the tracks, whose column is called ``label``, over the limit."""
    return Table(
        name,
        f"{label.partition(' ')[0].capitalize()} over the limit",
        (*SERIES, "limit [px]", "seeds", label, "std"),
        grouped(rows, (*SERIES, "limit"), [value]),
        "A lenient limit hides errors; a strict one ends tracks early.",
        Chart("limit [px]", label, "stream", "std", panels=PANELS),
    )


def _gap_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the table of the lifetime over the largest time between two corner events of a track."""
    return Table(
        "corners_gap",
        "Lifetime over the largest time between two corner events of a track",
        (*SERIES, "gap [ms]", "seeds", "lifetime [ms]", "std"),
        grouped(rows, (*SERIES, "gap"), ["lifetime_ms"]),
        "A quarter turn at 720 rpm takes 21 ms.",
        Chart("gap [ms]", "lifetime [ms]", "stream", "std", panels=PANELS),
    )


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the number, lifetime, error and update rate of tracks, and on their robustness."""
    rows = rows_of(results, "rows")
    at_limit = where(rows, limit=LIMIT_PX)
    moving = [row for row in rows if row["camera"] != "still"]
    moving_at_limit = where(moving, limit=LIMIT_PX)
    return [
        *_claims_of_paper(moving_at_limit),
        *_error_checks(at_limit, moving_at_limit),
        *_number_checks(moving_at_limit),
        *_chance_checks(where(moving_at_limit, detector=CornerMethod.EFAST)),
        _compensation_check(rows_of(results, "errors")),
        *_limit_checks(moving),
    ]


def _claims_of_paper(moving: Sequence[dict[str, Any]]) -> list[Claim]:
    """Judge the paper's claims on number and update rate by the rows of moving cameras at the usual limit."""
    efast = where(moving, detector=CornerMethod.EFAST)
    verdicts = [
        judge(
            6,
            f"More corners are tracked at a time (eFAST, moving camera, {TRACKS_END}).",
            differences(efast, "alive", AMI, PLAIN, relative=True),
            f"the mean number of tracks that are alive {RELATIVE_TO_PLAIN}",
            above=0.0,
        ),
        untestable(
            6,
            "Tracks live substantially longer, with an error of about 1.5 px.",
            "the paper does not state at which error a track ends, and that decides both: see the checks",
        ),
        untestable(
            6,
            "Their error is slightly larger than the S-EV's, and does not depend on the camera's motion.",
            "the paper does not state at which error a track ends, which bounds the error: see the checks",
        ),
        untestable(
            6,
            "More corners are tracked than by a standard camera in hard light.",
            "no world has dim light, "
            "and the paper states neither the light nor the noise of the cameras in it, which would decide",
        ),
    ]
    for name, stream in (("S-EV", PLAIN), ("AMI-EV", AMI)):
        events = stream | {"detector": CornerMethod.EFAST}
        claim = judge(
            7,
            f"A track of the {name} gets more than {1.0 + FAR:g} times as many updates per second as one of a "
            "standard camera with 60 frames/s (eFAST; the paper's 'far above' has no number).",
            differences(moving, "update_hz", events, FAST_FRAMES, relative=True),
            "the updates of a track per second less the updates of frames, relative to the latter,",
            above=FAR,
        )
        verdicts.append(claim)
    return verdicts


def _error_checks(rows: Sequence[dict[str, Any]], moving: Sequence[dict[str, Any]]) -> list[Claim]:
    """Check the error at the usual limit: against the S-EV's, and over the camera's motions."""
    efast = where(moving, detector=CornerMethod.EFAST)
    rows_of_room = where(rows, detector=CornerMethod.EFAST, scene="room")
    return [
        judge(
            None,
            f"The error is larger than the S-EV's, by up to {SLIGHT_PX:g} px (moving camera, {TRACKS_END}).",
            differences(efast, "error_px", AMI, PLAIN),
            f"the error of '{Stream.CALIBRATED}' less the same of '{Stream.PLAIN}'",
            above=0.0,
            below=SLIGHT_PX,
            unit="px",
        ),
        judge(
            None,
            f"The error does not depend on the camera's motion, within {SAME_PX:g} px (room, {TRACKS_END}).",
            differences(ranges(rows_of_room, "error_px"), "error_px", AMI, by=("scene",)),
            f"the range of the error of '{Stream.CALIBRATED}' over the camera's motions, with rest,",
            below=SAME_PX,
            unit="px",
        ),
    ]


def _number_checks(moving: Sequence[dict[str, Any]]) -> list[Claim]:
    """Check the number of tracks against chance and against a standard camera in good light."""
    efast = where(moving, detector=CornerMethod.EFAST)
    events = AMI | {"detector": CornerMethod.EFAST}
    return [
        judge(
            None,
            "More are tracked than of as many corners at random places.",
            differences(efast, "alive", AMI, {"stream": CHANCE}),
            f"the mean number of tracks that are alive of '{Stream.CALIBRATED}' less the same of chance",
            above=0.0,
        ),
        judge(
            None,
            "More are tracked than by a standard camera with 60 frames/s in good light.",
            differences(moving, "alive", events, FAST_FRAMES, relative=True),
            "the mean number of tracks that are alive less the same of frames, relative to the latter,",
            above=0.0,
        ),
    ]


def _chance_checks(efast: Sequence[dict[str, Any]]) -> list[Claim]:
    """Check error and lifetime against corners at random places."""
    return [
        judge(
            None,
            "The error is smaller than with as many corners at random places.",
            differences(efast, "error_px", AMI, {"stream": CHANCE}),
            f"the error of '{Stream.CALIBRATED}' less the same of chance",
            below=0.0,
            unit="px",
        ),
        judge(
            None,
            "Tracks live longer than with as many corners at random places.",
            differences(efast, "lifetime_ms", AMI, {"stream": CHANCE}),
            f"the lifetime of '{Stream.CALIBRATED}' less the same of chance",
            above=0.0,
            unit="ms",
        ),
    ]


def _compensation_check(errors: Sequence[dict[str, Any]]) -> Claim:
    return judge(
        None,
        "The rms error of the exact compensation is at most 2 px (apex 1°).",
        differences(errors, "rms_px", AMI),
        f"the error of '{Stream.CALIBRATED}'",
        below=2.0,
        unit="px",
    )


def _limit_checks(moving: Sequence[dict[str, Any]]) -> list[Claim]:
    """Check error and lifetime at several limits, which the paper does not state."""
    verdicts = []
    low_px, high_px = PAPER_ERROR_PX
    for limit in SOME_LIMITS_PX:
        efast = where(moving, detector=CornerMethod.EFAST, limit=limit)
        claim = judge(
            None,
            f"The error is about 1.5 px if tracks end {limit:g} px from the truth.",
            differences(efast, "error_px", AMI),
            f"the mean error of '{Stream.CALIBRATED}'",
            above=low_px,
            below=high_px,
            unit="px",
        )
        verdicts.append(claim)
    for name, detector in (("eFAST", CornerMethod.EFAST), ("Arc*", CornerMethod.ARC)):
        for limit in SOME_LIMITS_PX:
            rows = where(moving, detector=detector, limit=limit)
            claim = judge(
                None,
                f"Tracks live longer by {SUBSTANTIAL:.0%} with {name} and a limit of {limit:g} px (moving camera).",
                differences(rows, "lifetime_ms", AMI, PLAIN, relative=True),
                f"the lifetime {RELATIVE_TO_PLAIN}",
                above=SUBSTANTIAL,
            )
            verdicts.append(claim)
    return verdicts
