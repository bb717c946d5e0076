"""Poses of the board from a live stream: finds when it stands still, and says which parts of the image lack corners."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from math import tau as TWO_PI
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.first_guess import ANGLE_RANGES
from amiwarp.calib.repeated_turns import counts_of, repetition
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.encoder import Encoder
from amiwarp.events.encoder_stream import starts_of_runs
from amiwarp.events.recording import Events, MemoryEvents, Recording, held_bytes
from amiwarp.lens import poses
from amiwarp.lens.board import Board, Corners, opencv
from amiwarp.lens.calibration import TWO_BOARDS, LensWork
from amiwarp.lens.corner_fit import fit_lens
from amiwarp.lens.projection import first_pose, tilt_of
from amiwarp.lens.result import GOOD_POSES, LensCalibration, coverage_of, lacking
from amiwarp.optics.camera import Camera
from amiwarp.optics.models.exact import ExactModel
from amiwarp.optics.prism import NominalPrism, as_wedge
from amiwarp.tasks import Progress, silent

SETTLED_TURNS = 5
"""Length at which a still span is used before it ends [turns]: three, and one to settle on either side."""
MOST_BYTES = 1 << 27
"""Largest memory of a turn's events [bytes], about ten millions. Without a full turn within it, what waits is
dropped."""
MOST_SAMPLES = 1 << 14
"""Largest number of encoder samples of a turn. Without a full turn within it, what waits is dropped."""
SAME_PX = 5.0
"""A pose whose corners are all nearer than this to the corners of an earlier pose tells nothing new [px]."""


class StillSpans:
    """Finds the still spans of a stream, turn by turn, by the rule of :func:`~amiwarp.lens.poses.still_poses`.

    It consumes a session's events and encoder samples, and keeps what belongs to the present span. ``found`` is called
    once with each span, at most three turns of it, when it is :data:`SETTLED_TURNS` long or ends.
    """

    def __init__(
        self,
        name: str,
        size: tuple[int, int],
        prism: NominalPrism | None,
        found: Callable[[Recording], None],
    ) -> None:
        self._name = name
        self._size = size
        self._prism = prism
        self._found = found
        self.turns = self.samples = 0
        """Number of turns of the prism, and number of encoder samples so far."""
        self._t: NDArray[np.int64] = np.zeros(0, np.int64)
        self._angle: NDArray[np.float64] = np.zeros(0)
        self._held = 0
        self._last_us = -(1 << 62)
        self._restart(0)

    def append(self, events: Events) -> None:
        """Take events, in order of time."""
        self._waiting.append(events)
        self._held += held_bytes(events)
        self._last_us = int(events.t[-1])
        self._advance()

    def append_encoder(
        self,
        t_us: NDArray[np.int64],
        angle: NDArray[np.float64],
        index_t_us: object = None,
        *,
        second: bool = False,
    ) -> None:
        """Take samples of the prism's angle on the events' clock. A gap between samples ends a span.

        There is no ``second`` encoder: a lens is calibrated with one prism.
        """
        self.samples += len(t_us)
        self._t = np.concatenate([self._t, t_us])
        self._angle = np.concatenate([self._angle, angle])
        if first := starts_of_runs(self._t, self._angle)[-1]:
            self._restart(first)
        self._advance()

    def tick(self) -> None:
        """Do nothing, because no data wait to be written."""

    def finish(self) -> None:
        """Use the span that the end of the stream ends. Raises :class:`AmiwarpError` if the prism did not turn."""
        if not self.samples:
            raise AmiwarpError(
                f"{self._name}: no encoder samples have come; connect the encoder, or give the controller's --port",
                ErrorCode.CONTENT_MISSING,
            )
        if not self.turns:
            raise AmiwarpError(
                f"{self._name}: {poses.too_few_turns(float(np.ptp(self._angle)) / TWO_PI)}"
            )
        self._end_span()

    def _restart(self, first: int) -> None:
        """Begin a new span with an encoder sample; use the present one, and drop the waiting events."""
        if self._t.size:
            self._end_span()
        self._t = self._t[first:]
        self._angle = self._angle[first:]
        self._waiting = list[Events]()
        self._held = 0
        self._edges = list[int]()
        self._span = list[Events]()
        """Edges [us] and events of the turns of the present span."""
        self._before: NDArray[np.float64] | None = None
        self._used = False

    def _advance(self) -> None:
        """Process the turns that are complete."""
        while (edge := self._next_edge()) is not None:
            self._turn(self._edges[-1], edge)
        if self._held > MOST_BYTES or len(self._t) > (len(self._edges) + 1) * MOST_SAMPLES:
            self._restart(max(len(self._t) - 1, 0))

    def _next_edge(self) -> int | None:
        """Return the end of the next turn [us], or None if its samples or events have not arrived yet."""
        if len(self._t) < 2:
            return None
        self._edges = self._edges or [int(self._t[0])]
        start = self._edges[-1]
        angle_at_start = np.interp(start, self._t, self._angle)
        turned = np.abs(self._angle - angle_at_start) * (self._t > start)
        if turned[-1] < TWO_PI:
            return None
        k = int(np.argmax(turned >= TWO_PI))
        around = slice(k - 1, k + 1)
        edge = int(np.interp(TWO_PI, turned[around], self._t[around]))
        if self._last_us < edge:
            return None
        return edge

    def _turn(self, start: int, edge: int) -> None:
        """Compare a turn with the one before: it continues the present span, or begins a new one."""
        events = Events.concatenate(self._waiting)
        behind = events[int(np.searchsorted(events.t, edge)) :]
        self._waiting = [behind]
        self._held = held_bytes(behind)
        turn = _between(events, start, edge)
        self.turns += 1
        longest_us = np.diff(turn.t, prepend=start, append=edge).max()
        if longest_us > (edge - start) / ANGLE_RANGES:
            # a board shows events at every angle: some were lost on the way
            self._end_span()
            self._edges = [edge]
            self._span = []
            self._used = False
            self._before = None
            return
        encoder = Encoder(self._t, self._angle)
        counts = counts_of(turn, encoder, self._size)
        if self._before is None or repetition(self._before, counts) < poses.LEAST_REPETITION:
            self._end_span()
            self._edges = [start]
            self._span = []
            self._used = False
        self._before = counts
        self._edges = [*self._edges, edge]
        self._span = [*self._span, turn]
        if len(self._span) >= SETTLED_TURNS:
            self._end_span()
        kept = max(int(np.searchsorted(self._t, self._edges[0])) - 1, 0)
        self._t = self._t[kept:]
        self._angle = self._angle[kept:]

    def _end_span(self) -> None:
        """Use the present span if it was not used yet and has two turns."""
        edges = self._edges
        span = self._span
        if len(span) >= 2 and not self._used:
            self._used = True
            turn_us = (edges[-1] - edges[0]) / len(span)
            first, last = poses.used_part(edges[0], edges[-1], turn_us)
            part = _between(Events.concatenate(span), first, last)
            # Without the rest of the span
            events = Events(part.x.copy(), part.y.copy(), part.t.copy(), part.p.copy())
            low = max(int(np.searchsorted(self._t, first)) - 1, 0)
            high = int(np.searchsorted(self._t, last)) + 1
            t = self._t[low:high].copy()
            angle = self._angle[low:high].copy()
            recording = Recording(
                events=MemoryEvents(events, *self._size),
                camera=None,
                encoder=Encoder(t, angle),
                prism=self._prism,
                name=self._name,
            )
            self._found(recording)
        if self._used:
            self._edges = edges[-1:]
            self._span = []


def _between(events: Events, start: int, stop: int) -> Events:
    first, last = np.searchsorted(events.t, [start, stop])
    return events[first:last]


class LiveLens:
    """Poses of a board that a stream has shown so far, until they are enough for a lens calibration."""

    def __init__(
        self,
        board: Board,
        camera: Camera,
        device: Any,
        say: Callable[[str], None],
    ) -> None:
        """Start with a rough ``camera``. ``say`` is called with what each pose shows, and what is missing."""
        opencv()  # at once, not after the first pose
        self._board = board
        self._camera = camera
        self._device = device
        self._say = say
        self.enough = False
        """Whether the poses suffice for a good calibration."""
        self.poses = list[poses.Pose]()
        """Poses that count."""
        self._spans = 0
        self._seen = list[Corners]()
        self._tilts = list[float]()
        self._left_out = dict[str, str]()
        self._model: ExactModel | None = None

    def add(self, recording: Recording) -> None:
        """Look for the board in a still span, and say what it adds."""
        if self.enough:
            return
        self._spans += 1
        pose = poses.Pose(f"pose {self._spans}", recording)
        try:
            corners = self._find(pose)
        except AmiwarpError as error:
            reason = str(error).removeprefix(f"{recording.name}: ")
            self._left_out[pose.name] = reason
            self._say(f"{pose.name}: {reason}")
            return
        for earlier, before in zip(self.poses, self._seen, strict=True):
            if _same(before, corners):
                self._say(f"{pose.name}: as {earlier.name}, so it does not count; move the board")
                return
        self.poses.append(pose)
        self._seen.append(corners)
        placed = first_pose(self._camera, self._board, corners)
        self._tilts.append(tilt_of(placed))
        self._tell(pose.name)

    def calibrate(self, progress: Progress) -> LensCalibration:
        """Calibrate from the poses. Raises :class:`AmiwarpError` as :func:`~amiwarp.calibrate_lens` does."""
        if not self._spans:
            raise AmiwarpError(poses.MOVES_TEXT)
        work = LensWork(
            self._board,
            self._camera,
            self.poses,
            self._device,
            progress,
            self._left_out,
        )
        return work.run()

    def _find(self, pose: poses.Pose) -> Corners:
        """Return the board's corners in a pose. Raises :class:`AmiwarpError` with the reason if it is not seen."""
        work = LensWork(self._board, self._camera, [pose], self._device, silent)
        for model in self._models(work):
            pictures = work.pictures(model, [pose.name], 0, turns=0.5)
            picture = pictures[pose.name]
            corners = self._board.find(picture)
            if corners is not None:
                if self._board.has_another(picture, corners):
                    raise AmiwarpError(TWO_BOARDS)
                self._model = model
                return corners
        raise AmiwarpError(self._board.missing(picture))

    def _models(self, work: LensWork) -> Iterator[ExactModel]:
        """Yield the prism that showed the board last; then the pose's sharpest one, unless that prism has shown two."""
        if self._model is not None:
            yield self._model
        if len(self.poses) >= 2:
            return
        [(_, search)] = work.searches(work.poses, ("apex", "phase"), {})
        found = search.run()
        yield ExactModel.from_values(self._camera, as_wedge(found.full_space.prism), found.best)

    def _tell(self, name: str) -> None:
        """Say what the latest pose shows, where in the image corners were so far, and what is missing."""
        count = len(self.poses)
        tilt = math.degrees(self._tilts[-1])
        counted = f"{count} of {GOOD_POSES} poses" if count < GOOD_POSES else f"{count} poses"
        self._say(
            f"{name}: board seen, tilt {tilt:.0f} deg; {counted}, corners in the nine parts of the image:"
        )
        coverage = coverage_of(self._seen, self._camera.width, self._camera.height)
        for row in coverage:
            self._say("".join(f"{corners:6d}" for corners in row))
        missing = lacking(self._tilts, coverage)
        if count >= GOOD_POSES and not missing:
            try:
                fit_lens(self._camera, self._board, self._seen)
            except AmiwarpError as error:
                missing = [str(error)]
        for text in missing:
            self._say(f"still missing: {text}")
        self.enough = (count >= GOOD_POSES and not missing) or count >= poses.MOST_POSES
        if self.enough:
            self._say(f"enough: {count} poses; calibrating")


def _same(one: Corners, other: Corners) -> bool:
    """Return whether two poses show the same corners at nearly the same places."""
    _, of_one, of_other = np.intersect1d(one.ids, other.ids, return_indices=True)
    if len(of_one) != max(len(one.ids), len(other.ids)):
        return False
    away = np.linalg.norm(one.xy[of_one] - other.xy[of_other], axis=1)
    return bool((away < SAME_PX).all())
