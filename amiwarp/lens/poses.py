"""Time spans in which a board and the camera stand still: the poses of a lens calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.first_guess import ANGLE_RANGES, CELL
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events, MemoryEvents, Recording
from amiwarp.tasks import in_order

LEAST_TURNS, MOST_TURNS = 1.5, 3.0
"""Shortest still span, and the longest part of one that is used, from its middle [turns]."""
LEAST_REPETITION = 0.75
"""Smallest correlation of the events of two successive turns while nothing moves. A still board's was 0.96 to 0.98,
that of a board that moved by 1.8 px in a turn 0.82, and by 3.7 px 0.52."""
WITHOUT_PRISM = "because without it a still board gives no events"
MOVES = (
    "no turn of the prism repeats the one before: hold the board and the camera still for two turns; without a prism, "
    "a still board gives no events"
)
MOST_POSES = 40
"""Largest number of poses that are used. More would lengthen the work, and hardly improve the lens."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Span of a recording in which the board stands still."""

    name: str
    """Name for messages: that of the recording, with the time of the span if the recording has several."""
    recording: Recording
    """The events of the span, at most three turns, in memory."""


def still_poses(recordings: Sequence[Recording]) -> tuple[list[Pose], dict[str, str]]:
    """Return the still spans of all recordings, and the reason by name of each recording that has none.

    Raises :class:`AmiwarpError`, with the reason of the first recording, if none has any.
    """
    recordings = _named_apart(recordings)
    spans, reasons = list[tuple[Recording, tuple[int, int]]](), dict[str, str]()
    for recording, found in zip(recordings, in_order(partial(_spans_of, one) for one in recordings), strict=True):
        if isinstance(found, AmiwarpError):
            reasons[recording.name] = str(found)
        else:
            spans += [(recording, span) for span in found]
    if not spans:
        raise AmiwarpError(f"{recordings[0].name}: {reasons[recordings[0].name]}")
    if len(spans) > MOST_POSES:
        spans = [spans[k] for k in np.linspace(0, len(spans) - 1, MOST_POSES).round().astype(int)]
    several = {recording.name for recording in recordings if sum(one is recording for one, _ in spans) > 1}
    return [_pose(recording, *span, several=recording.name in several) for recording, span in spans], reasons


def _named_apart(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings with names of which no two are equal, because poses are known by them."""
    found: dict[str, Recording] = {}
    for recording in recordings:
        name, count = recording.name, 1
        while name in found:
            count += 1
            name = f"{recording.name} ({count})"
        found[name] = replace(recording, name=name)
    return list(found.values())


def _pose(recording: Recording, start: int, stop: int, *, several: bool) -> Pose:
    first = recording.events.t_first
    where = f", {(start - first) * 1e-6:.2f} to {(stop - first) * 1e-6:.2f} s" if several else ""
    events = MemoryEvents(recording.events.between(start, stop), *recording.events.size)
    return Pose(f"{recording.name}{where}", replace(recording, events=events))


def _spans_of(recording: Recording) -> list[tuple[int, int]] | AmiwarpError:
    """Return start and end of every still span [us], each at most :data:`MOST_TURNS` long, or why there is none."""
    try:
        return _found_spans(recording)
    except AmiwarpError as error:
        return error


def _found_spans(recording: Recording) -> list[tuple[int, int]]:
    encoder, source = recording.encoder, recording.events
    if encoder is None:
        raise AmiwarpError(f"has no encoder; record the angle of a turning prism, {WITHOUT_PRISM}")
    if not len(source):
        raise AmiwarpError("has no events; give a recording with events")
    first, last = max(source.t_first, encoder.coverage[0]), min(source.t_last, encoder.coverage[1])
    turns = abs(encoder.rpm) * (last - first) / 60e6
    if turns < LEAST_TURNS:
        raise AmiwarpError(too_few_turns(turns))
    turn = (last - first) / turns
    if turns < 2.0:
        return [(first, last)]
    edges = first + (np.arange(int(turns) + 1) * turn).astype(np.int64)
    edges[-1] = last
    still = _repetition(recording, encoder, edges) >= LEAST_REPETITION
    found = [(int(edges[a]), int(edges[b])) for a, b in _runs(still)]
    if not found:
        raise AmiwarpError(MOVES)
    return [used_part(a, b, turn) for a, b in found]


def too_few_turns(turns: float) -> str:
    """Return the reason for an error: the prism makes too few turns for a pose."""
    return (
        f"the prism makes {max(turns, 0.0):.2g} turns; a pose needs {LEAST_TURNS:g} turns of the prism in front of a "
        f"board that stands still, {WITHOUT_PRISM}"
    )


def used_part(start: int, stop: int, turn: float) -> tuple[int, int]:
    """Return the part of a still span that is used: at most :data:`MOST_TURNS` turns, in its middle [us]."""
    half = int(0.5 * MOST_TURNS * turn)
    return max(start, (start + stop) // 2 - half), min(stop, (start + stop) // 2 + half)


def _repetition(recording: Recording, encoder: Encoder, edges: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the repetition of each turn after the first, shape (turns - 1,)."""
    before: NDArray[Any] | None = None
    out: list[float] = []
    for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        counts = counts_of(recording.events.between(start, stop), encoder, recording.events.size)
        if before is not None:
            out.append(repetition(before, counts))
        before = counts
    return np.array(out)


def counts_of(turn: Events, encoder: Encoder, size: tuple[int, int]) -> NDArray[np.float64]:
    """Return the events of a turn, ON minus OFF, by cell of the image and range of prism angles, flattened."""
    columns, rows = (-(-side // CELL) for side in size)
    angle = np.floor(encoder.angle_at(turn.t) * (ANGLE_RANGES / math.tau)).astype(np.int64) % ANGLE_RANGES
    cell = ((turn.y // CELL).astype(np.int64) * columns + turn.x // CELL) * ANGLE_RANGES + angle
    return np.asarray(
        np.bincount(cell, weights=2.0 * turn.p - 1.0, minlength=rows * columns * ANGLE_RANGES), np.float64
    )


def repetition(before: NDArray[np.float64], counts: NDArray[np.float64]) -> float:
    """Return the correlation of the events of a turn with those of the turn before, see :data:`LEAST_REPETITION`."""
    energy = math.sqrt(float(counts @ counts) * float(before @ before))
    return float(counts @ before) / max(energy, 1e-30)


def _runs(still: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and last edge of each run of still turns: ``still[k]`` compares the turns k and k + 1."""
    steps = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    return [(int(a), int(b) + 1) for a, b in steps.reshape(-1, 2)]
