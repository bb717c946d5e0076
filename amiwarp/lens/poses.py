"""Time spans in which a board and the camera stand still: the poses of a lens calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.repeated_turns import counts_of, repetition
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import MemoryEvents, Recording
from amiwarp.tasks import in_order

Vector = NDArray[np.float64]

LEAST_TURNS = 1.5
"""Length of the shortest still span that is used [turns]."""
MOST_TURNS = 3.0
"""Length of the longest part of a still span that is used, in its middle [turns]."""
LEAST_REPETITION = 0.75
"""Smallest correlation of the events of two successive turns while nothing moves. A still board's was 0.96 to 0.98,
a board that moved by 1.8 px in a turn had 0.82, and by 3.7 px 0.52."""
WITHOUT_PRISM_TEXT = "because without it a still board gives no events"
"""End of the messages that ask for a turning prism."""
MOVES_TEXT = (
    "no turn of the prism repeats the one before: hold the board and the camera still for two turns; without a prism, "
    "a still board gives no events"
)
"""Message about a recording in which something moves all the time."""
MOST_POSES = 40
"""Largest number of poses that are used. More would lengthen the work, and hardly improve the lens."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Span of a recording in which the board stands still."""

    name: str
    """Name for messages: the recording's name, with the time of the span if the recording has several."""
    recording: Recording
    """The events of the span, at most three turns, in memory."""


def still_poses(recordings: Sequence[Recording]) -> tuple[list[Pose], dict[str, str]]:
    """Return the still spans of all recordings, and the reason by name of each recording that has none.

    Of more than :data:`MOST_POSES` spans, some are left out, evenly: a recording of which all are left out is in
    neither. Raises :class:`AmiwarpError`, with the reason of the first recording, if none has any.
    """
    recordings = _named_apart(recordings)
    spans: list[tuple[Recording, tuple[int, int]]] = []
    reasons: dict[str, str] = {}
    jobs = (partial(_spans_or_reason, recording) for recording in recordings)
    for recording, found in zip(recordings, in_order(jobs), strict=True):
        if isinstance(found, AmiwarpError):
            reasons[recording.name] = str(found)
        else:
            spans += [(recording, span) for span in found]
    if not spans:
        first = recordings[0].name
        raise AmiwarpError(f"{first}: {reasons[first]}")
    if len(spans) > MOST_POSES:
        chosen = np.linspace(0, len(spans) - 1, MOST_POSES).round().astype(int)
        spans = [spans[k] for k in chosen]

    count = Counter(recording.name for recording, _ in spans)
    poses = []
    for recording, (start, stop) in spans:
        several = count[recording.name] > 1
        poses.append(_pose(recording, start, stop, several=several))
    return poses, reasons


def _named_apart(recordings: Sequence[Recording]) -> list[Recording]:
    """Return the recordings with names of which no two are equal, because poses are known by them."""
    found: dict[str, Recording] = {}
    for recording in recordings:
        name = recording.name
        count = 1
        while name in found:
            count += 1
            name = f"{recording.name} ({count})"
        found[name] = replace(recording, name=name)
    return list(found.values())


def _pose(recording: Recording, start: int, stop: int, *, several: bool) -> Pose:
    """Return a still span of a recording as a pose; with its times in the name if there are several."""
    source = recording.events
    name = recording.name
    if several:
        start_s = (start - source.t_first) * 1e-6
        stop_s = (stop - source.t_first) * 1e-6
        name += f", {start_s:.2f} to {stop_s:.2f} s"
    events = MemoryEvents(source.between(start, stop), *source.size)
    return Pose(name, replace(recording, events=events))


def _spans_or_reason(recording: Recording) -> list[tuple[int, int]] | AmiwarpError:
    """Return start and end of every still span [us], each at most :data:`MOST_TURNS` long, or why there is none."""
    # Raised in another thread, an error would end the work on the other recordings too.
    try:
        return _still_spans(recording)
    except AmiwarpError as error:
        return error


def _still_spans(recording: Recording) -> list[tuple[int, int]]:
    """Return start and end of every still span [us]. Raises :class:`AmiwarpError` if there is none."""
    encoder = recording.encoder
    source = recording.events
    if encoder is None:
        raise AmiwarpError(
            f"has no encoder; record the angle of a turning prism, {WITHOUT_PRISM_TEXT}",
            ErrorCode.CONTENT_MISSING,
        )
    if not len(source):
        raise AmiwarpError("has no events; give a recording with events", ErrorCode.CONTENT_MISSING)
    first_covered, last_covered = encoder.coverage
    first = max(source.t_first, first_covered)
    last = min(source.t_last, last_covered)
    turns = abs(encoder.rpm) * (last - first) / 60e6
    if turns < LEAST_TURNS:
        raise AmiwarpError(too_few_turns(turns))
    turn = (last - first) / turns
    if turns < 2.0:
        return [(first, last)]  # no two turns to compare
    elapsed = np.arange(int(turns) + 1) * turn
    edges = first + elapsed.astype(np.int64)
    edges[-1] = last
    still = _repetition(recording, encoder, edges) >= LEAST_REPETITION
    found = []
    for first_edge, last_edge in _runs(still):
        start = int(edges[first_edge])
        stop = int(edges[last_edge])
        found.append(used_part(start, stop, turn))
    if not found:
        raise AmiwarpError(MOVES_TEXT)
    return found


def too_few_turns(turns: float) -> str:
    """Return the reason for an error: the prism makes too few turns for a pose."""
    return (
        f"the prism makes {max(turns, 0.0):.2g} turns; a pose needs {LEAST_TURNS:g} turns of the prism in front of a "
        f"board that stands still, {WITHOUT_PRISM_TEXT}"
    )


def used_part(start: int, stop: int, turn: float) -> tuple[int, int]:
    """Return the part of a still span that is used: at most :data:`MOST_TURNS` turns, in its middle [us]."""
    half = int(0.5 * MOST_TURNS * turn)
    middle = (start + stop) // 2
    return max(start, middle - half), min(stop, middle + half)


def _repetition(recording: Recording, encoder: Encoder, edges: NDArray[np.int64]) -> Vector:
    """Return the repetition of each turn after the first, shape (turns - 1,)."""
    source = recording.events
    before: Vector | None = None
    found: list[float] = []
    for start, stop in pairwise(edges.tolist()):
        turn = source.between(start, stop)
        counts = counts_of(turn, encoder, source.size)
        if before is not None:
            found.append(repetition(before, counts))
        before = counts
    return np.array(found)


def _runs(still: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and last edge of each run of still turns: ``still[k]`` compares the turns k and k + 1."""
    padded = np.pad(still, 1).astype(np.int8)
    steps = np.flatnonzero(np.diff(padded))
    begins = steps[0::2].tolist()
    ends = steps[1::2].tolist()
    return [(first, last + 1) for first, last in zip(begins, ends, strict=True)]
