"""Evaluation of the segmentation of a ball that is thrown before a moving camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, TypedDict

import numpy as np

from amiwarp.studies.evaluate.conditions import Condition, Stream, Streams
from amiwarp.studies.evaluate.flow import moving_instances
from amiwarp.studies.evaluate.measures.masks import overlap
from amiwarp.studies.evaluate.motion_segmentation import SegmentationSettings, moving_events
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    Claim,
    Count,
    Settings,
    Share,
    Table,
    by_case,
    compared,
    grouped,
    rows_of,
    wide_focal,
)

TITLE = "Motion segmentation"
PROTOCOL = (
    "In windows of a quarter turn, the camera's rotation is that of the sharpest image of the events (contrast "
    "maximisation). A region stays blurred if its events agree much better (1.5 times) under a further velocity in the "
    "image. The events of such regions are clustered over x, y and t (DBSCAN); large clusters are moving bodies. IoU, "
    "precision and recall compare them, event by event, with the events whose pixel saw the ball. Events of noise "
    "count too, as what their pixel saw."
)
DIFFERENCES = (
    "The paper shows pictures only, and does not describe its clustering. Ours has the settings of "
    "`SegmentationSettings`, which are the same for all streams. They were chosen on recordings of seed 0 of this "
    "world, whose texture, throw and camera motion differ from those of the seeds that are scored. The agreement is "
    "measured on at most 100,000 events of a window, evenly thinned."
)
VERSION = 3
NEEDS_TRUTH = True

WINDOW_TURNS = 0.25
"""Length of a window [turns]."""
QUICK_WINDOWS, FULL_WINDOWS = 1, 2
"""Number of windows of a recording."""
STANDARD = SegmentationSettings()
"""Settings of the comparison."""
VARIED = {"gain": (1.25, 2.0), "least_share": (0.08, 0.3), "density": (1.0, 4.0), "radius_px": (5.0, 12.0)}
"""Further values of the settings in the sensitivity curves."""
NAMES = {"gain": "least gain", "least_share": "least share of a cluster", "density": "least density of a cluster",
         "radius_px": "radius of the clustering [px]"}  # fmt: skip
"""What the settings are called in the report."""


class _Row(TypedDict):
    stream: Stream
    events: Count
    gain: Amount
    least_share: Share
    density: Amount
    radius_px: Amount
    share: Share | None
    iou: Share | None
    precision: Share | None
    recall: Share | None


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]


def conditions(settings: Settings) -> list[Condition]:
    """Return the ball before a moving camera. The lens sees the whole throw."""
    return settings.conditions(world="ball", trajectory="handheld", focal_px=wide_focal(settings))


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return IoU, precision and recall for each stream, window and choice of settings."""
    choices = [STANDARD, *(replace(STANDARD, **{n: v}) for n, values in VARIED.items() for v in values)]
    length = round(WINDOW_TURNS * 60e6 / streams.condition.rpm)
    count = QUICK_WINDOWS if settings.quick else FULL_WINDOWS
    starts = np.linspace(streams.start_us, streams.end_us - length, count + 2).astype(np.int64)[1:-1]
    moving = moving_instances(streams)
    rows = []
    for stream in streams.names:
        for start in starts.tolist():
            events = streams.window(stream, start, start + length)
            instance = streams.event_truth(stream, start, start + length).instance
            assert instance is not None
            truth = np.isin(instance, moving)
            for chosen, found in zip(choices, moving_events(events, streams.camera, choices), strict=True):
                scores = {name: _number(value) for name, value in asdict(overlap(found, truth)).items()}
                rows.append({"stream": stream.value, "events": len(events), **_values(chosen),
                             "share": float(truth.mean()) if len(truth) else None, **scores})  # fmt: skip
    return {"rows": rows}


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


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the scores of the standard settings, and those over the least gain."""
    rows = rows_of(results, "rows")
    names, scores = ("scene", "camera", "stream"), ["iou", "precision", "recall"]
    columns = ("seeds x windows", "IoU", "std of IoU", "precision", "std of precision", "recall", "std of recall")
    standard = [r for r in rows if _values(STANDARD).items() <= r.items()]
    return [
        Table("segmentation", "Segmentation of a thrown ball, per event",
              (*names, *columns, "events of the ball", "std of share"), grouped(standard, names, [*scores, "share"]),
              "Precision is undefined for a window in which no body is found; its IoU is 0."),
        Table("segmentation_settings", "Segmentation over its settings",
              ("setting", *names, "value of the setting", *columns),
              grouped(_curves(rows), ("setting", *names, "value of the setting"), scores),
              "Gain: that in agreement of what stays blurred. The other settings are those of the clustering.",
              Chart("value of the setting", "IoU", "stream", "std of IoU", panels=("setting",))),
    ]  # fmt: skip


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdict on the segmentation, which the paper shows in pictures."""
    rows = [r for r in rows_of(results, "rows") if _values(STANDARD).items() <= r.items()]
    holds, ours = compared(by_case(rows, ("scene", "camera"), "iou"), Stream.PLAIN, "higher", larger=True)
    rule = f"the mean IoU of '{Stream.CALIBRATED}' is above that of '{Stream.PLAIN}' by more than either spread"
    return [
        Claim.judge("A thrown ball is segmented better with the AMI-EV (moving camera).", "pictures", ours, holds, rule)
    ]
