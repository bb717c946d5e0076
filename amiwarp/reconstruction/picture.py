"""A picture of the scene from the events of a window: log intensity, solved for, with no network and no training.

The pairs of consecutive events of each pixel are linear equations in the log-intensity map (see
:mod:`amiwarp.brightness.solver`). One tile, the image grown by the prism's orbit, is solved for; the picture is cut
out of it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from amiwarp.brightness.event_pairs import EventTable, PairSet
from amiwarp.brightness.solver import BrightnessMap, Smoothness, Tiles
from amiwarp.compensation.recordings import check_size
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import TURN, Encoder
from amiwarp.optics.camera_rotation import CameraRotation, border
from amiwarp.reconstruction.choices import Fill
from amiwarp.validation import choice

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.result import Calibration
    from amiwarp.events.recording import Recording
    from amiwarp.optics.models import Model

SCALES = (1.0, 0.5, 0.5)
"""Of Cauchy's weights, round by round [thresholds]: an equation that is off by as much counts half."""
STEPS = 30
"""Of conjugate gradients in each round."""
SMOOTHNESS = (0.004, 0.02, 0.1, 0.5)
"""Weights of the prior among which held-out equations choose."""
WEAK = 0.03
"""Weight of silence and open ends: the one that held-out equations like best, or near it (see the docs)."""
HELD_OUT = 8
"""Every so many-th pair is held out."""
PROBE = 96
"""The choice is made on a square of so many pixels with the most events."""
EDGE = 0.5
"""Neighbours that differ by more [thresholds] are an edge to ``Fill.EDGE``."""
MEAN_HOLD = 1e-6
"""Of the map's square: holds its mean, of which no equation tells."""
SPANS = 8
"""A turn in so many parts: a pixel silent throughout says in each that nothing changed."""
COVERED = 0.5
"""Of a node that the picture claims to know: the sum of its equations' weights."""
HOLDS, AGREED = 0.25, 0.4
"""An equation that is off by the one [thresholds] holds by half; so much of those about a node must hold."""
SPECK = 12
"""Known regions of fewer pixels are noise."""
PINHOLE = 4
"""Unknown places of up to so many pixels within a known region are known: equations on all sides of them are."""
NEAR = 2
"""Pairs of events that are further from what is known are noise, and left out [px]."""
STILL_US = 100_000
"""Default window where no prism turns [us]."""
LARGEST_MARGIN = 0.5
"""Of the image's width: by no more is the map grown."""

"""Called with what is being done and the share of it that is."""


@dataclass(frozen=True, eq=False)
class Picture:
    """The scene over a window, without the prism."""

    log: NDArray[np.float32]
    """Log intensity in units of the ON threshold, median 0, shape (height, width); NaN where it is not filled.

    It is determined up to one constant for each connected region of :attr:`known`; the fill joins them.
    """
    known: NDArray[np.bool_]
    """Where events determine it."""
    start_us: int
    length_us: int
    pairs: int
    """Equations of two events each."""
    off_excess: float
    """The OFF threshold over the ON threshold, less 1, as it was taken to be."""
    smoothness: float
    """Weight of the prior that held-out equations chose."""
    residual: float
    """Median of the equations' absolute residuals [ON thresholds]; near 1 where the optics or the motion is wrong."""
    hot: int
    """Pixels left out because they fire too much."""
    seconds: float
    unknowns: NDArray[np.float32] = field(repr=False)
    """The whole map, to start the next window from."""

    def intensity(self, contrast: float = 0.25) -> NDArray[np.float32]:
        """Relative linear intensity for an ON threshold of ``contrast`` (log intensity), 1 at the median."""
        return np.exp(np.float32(contrast) * self.log)


class Reconstruction:
    """Pictures of windows of one recording, with all that they share."""

    def __init__(
        self,
        recording: Recording,
        calibration: Calibration | None = None,
        *,
        model: Model | None = None,
        encoder: Encoder | None = None,
        camera_rotation: CameraRotation | None = None,
        fill: Fill = Fill.SMOOTH,
        device: Any = "cpu",
    ) -> None:
        """Give a ``calibration``, or a ``model`` and, unless the recording has one, an ``encoder``.

        ``turning``: how the camera turns, unless the calibration found it.

        Raises :class:`AmiwarpError` for a camera of another size, no
        events, or no encoder.
        """
        if not len(recording.events):
            raise AmiwarpError(f"{recording.name}: has no events to make a picture of")
        first, last = recording.events.t_first, recording.events.t_last
        if calibration is not None:
            check_size(calibration, recording.events.size, recording.name)
            model, encoder = calibration.model, calibration.encoder_for(recording.encoder, first, last)
        encoder = encoder or recording.encoder
        if model is None or encoder is None:
            raise AmiwarpError(f"{recording.name}: give a calibration, or a model and an encoder")
        if (model.camera.width, model.camera.height) != recording.events.size:
            width, height = recording.events.size
            given = f"{model.camera.width}x{model.camera.height}"
            raise AmiwarpError(
                f"{recording.name}: is {width}x{height}, the model is for {given}; calibrate this camera"
            )
        self.recording, self.model, self.encoder = recording, model, encoder
        if camera_rotation is None and calibration is not None:
            camera_rotation = calibration.camera_rotation
        self.camera_rotation, self.device = camera_rotation or CameraRotation(), device
        self.fill = choice(Fill, fill, "fill")
        self.turn_us = abs(60e6 / encoder.rpm) if abs(encoder.rpm) > 1e-3 else None
        self._smoothness: float | None = None

    def span(
        self, start_us: int | None = None, length_us: int | None = None, turns: float | None = None
    ) -> tuple[int, int]:
        """Start and length of a window [us]: from the first event where not given, one turn or 0.1 s long."""
        first, last = self.recording.events.t_first, self.recording.events.t_last
        if turns is not None:
            if length_us is not None or self.turn_us is None:
                raise AmiwarpError("turns: the prism does not turn, or a length is given too; give a length alone")
            length_us = round(turns * self.turn_us)
        start = first if start_us is None else start_us
        length = length_us or round(self.turn_us or STILL_US)
        if length < 1 or start > last or start + length <= first:
            where = f"{start} .. {start + length} us"
            raise AmiwarpError(f"{self.recording.name}: no events in {where}; they are at {first} .. {last} us")
        return start, length

    def window(self, start_us: int, length_us: int, *, last: Picture | None = None) -> Picture:
        """The picture of one window; it starts from that of the window before where that is given.

        Raises :class:`AmiwarpError` where no pixel fires twice.
        """
        began = time.perf_counter()
        recording = self.recording
        width, height = recording.events.size
        table, count = self._table(start_us, length_us)
        pairs = self._pairs(table, start_us, length_us)
        real = int((pairs.column("on") < 2).sum())
        if not real:
            where = f"{start_us} .. {start_us + length_us} us"
            raise AmiwarpError(f"{recording.name}: no pixel fires twice in {where}; give a longer window")
        off = self._off_excess(start_us, length_us)
        if self._smoothness is None:
            self._smoothness = self._choose(count, pairs, start_us, length_us, off)
        left, top, tiles = self._tile(start_us, length_us)
        solver = self._solver(pairs, tiles, off, start_us + length_us // 2)
        if last is not None:
            unknowns = last.unknowns.copy()
            unknowns[tiles.nodes :] = solver.unknowns[tiles.nodes :]
            solver.unknowns = unknowns
        for scale in SCALES[:-1] if last is None else SCALES[1:-1]:
            solver.solve(scale, steps=STEPS)
        typical = solver.residuals.median(real)
        covered = known_nodes(solver)
        if covered.any():
            solver.keep(grown(covered, NEAR)[None])
        solver.solve(SCALES[-1], steps=STEPS)
        cut = np.s_[top : top + height, left : left + width]
        unknowns = solver.unknowns
        log, known = unknowns[: tiles.nodes].reshape(tiles.rows, tiles.columns)[cut], covered[cut]
        log = log - np.median(log[known] if known.any() else log)
        if self.fill is Fill.NONE:
            log = np.where(known, log, np.float32(np.nan))
        hot = int((table.tile_of.numpy() < 0).sum())
        return Picture(
            log.astype(np.float32), known, start_us, length_us, real, off, self._smoothness,
            typical, hot, time.perf_counter() - began, unknowns,
        )  # fmt: skip

    def windows(self, start_us: int, length_us: int, *, step_us: float) -> Iterator[Picture]:
        """Pictures of windows that slide by ``step_us``, each started from the one before, to the last that is whole.

        A window without a pair of events repeats the picture before it.
        """
        last: Picture | None = None
        for k in range(self.count(start_us, length_us, step_us=step_us)):
            try:
                last = self.window(start_us + round(k * step_us), length_us, last=last)
            except AmiwarpError:
                if last is None:
                    raise
            yield last

    def count(self, start_us: int, length_us: int, *, step_us: float) -> int:
        """How many pictures :meth:`windows` gives."""
        room = self.recording.events.t_last + 1 - start_us - length_us
        return max(1, math.floor(room / step_us) + 1)

    def _table(self, start_us: int, length_us: int) -> tuple[EventTable, NDArray[np.int32]]:
        """The window's events without those of hot pixels, and how many each pixel fired, shape (height, width)."""
        events = self.recording.events.between(start_us, start_us + length_us)
        width, height = self.recording.events.size
        table = EventTable([events], np.zeros((height, width), np.int32), self.device)
        return table, table.leave_out_hot()

    def _pairs(self, table: EventTable, start_us: int, length_us: int) -> PairSet:
        """All equations of a window: pairs of events, open ends, and silence."""
        turn = min(self.turn_us or length_us, length_us)
        spans = max(2, round(SPANS * length_us / turn))
        edges = np.round(np.linspace(start_us, start_us + length_us, spans + 1)).astype(np.int64)
        return table.pairs(
            self.encoder, longest_gap_us=length_us, middle_us=start_us + length_us // 2, weak=WEAK,
            window=(start_us, start_us + length_us), quiet=(edges, min(spans, SPANS)),
        )  # fmt: skip

    def _solver(self, pairs: PairSet, tiles: Tiles, off: float, middle_us: int) -> BrightnessMap:
        prior = Smoothness(self._smoothness or SMOOTHNESS[0], EDGE if self.fill is Fill.EDGE else 0.0)
        solver = BrightnessMap(pairs, tiles, off_excess=off, damping=MEAN_HOLD, smoothness=prior, middle_us=middle_us)
        solver.place(self.model, camera_rotation=self.camera_rotation)
        return solver

    def _off_excess(self, start_us: int, length_us: int) -> float:
        """Over whole turns a pixel comes back to where it was: ONs times their threshold equal OFFs times theirs."""
        first, last = self.recording.events.t_first, self.recording.events.t_last
        if self.turn_us is None or last - first < self.turn_us:
            return 0.0
        length = max(1, math.floor(length_us / self.turn_us)) * self.turn_us
        start = min(max(start_us, first), last - length)
        p = self.recording.events.between(round(start), round(start + length)).p
        on = int(p.sum())
        return float(np.clip(on / max(len(p) - on, 1) - 1.0, -0.7, 2.0)) if len(p) >= 1000 else 0.0

    def _choose(self, count: NDArray[np.int32], pairs: PairSet, start_us: int, length_us: int, off: float) -> float:
        """The prior's weight under which held-out equations come out best, on the busiest part of the image."""
        x0, y0 = busiest(count)
        part = pairs.of_square(x0, y0, PROBE)
        if part.hold_out(HELD_OUT) < 50:
            return SMOOTHNESS[-1]
        left, top, _ = self._tile(start_us, length_us)
        shape = (PROBE + 2 * top, PROBE + 2 * left)
        tiles = Tiles(np.array([[x0 - left, y0 - top]], np.float32), *shape, 1.0)
        solver = self._solver(part, tiles, off, start_us + length_us // 2)
        scores = []
        for weight in SMOOTHNESS:
            solver.restart(weight)
            for scale in SCALES[:2]:
                solver.solve(scale, steps=STEPS)
            scores.append(solver.residuals.mean_cost(SCALES[0], held=True))
        return SMOOTHNESS[int(np.nanargmin(scores))]

    def _tile(self, start_us: int, length_us: int) -> tuple[int, int, Tiles]:
        """Columns and rows of the map before the image's first, and the map: all that the window's pixels can see."""
        camera = self.model.camera
        camera_rotation = self.camera_rotation.about(start_us + length_us // 2)
        margin = np.max(np.abs(orbit(self.model)), axis=0) + camera_rotation.reach(camera, length_us * 0.5e-6)
        limit = LARGEST_MARGIN * camera.width
        left, top = (math.ceil(min(float(m), limit)) + 2 for m in margin)
        origin = np.array([[-left, -top]], np.float32)
        return left, top, Tiles(origin, camera.height + 2 * top, camera.width + 2 * left, 1.0)


def reconstruct(
    recording: Recording,
    calibration: Calibration | None = None,
    *,
    model: Model | None = None,
    encoder: Encoder | None = None,
    start_us: int | None = None,
    length_us: int | None = None,
    turns: float | None = None,
    camera_rotation: CameraRotation | None = None,
    fill: Fill = Fill.SMOOTH,
    device: Any = "cpu",
) -> Picture:
    """The picture of a window, from a quarter turn up: of ``length_us`` or ``turns`` (default: one) from ``start_us``.

    See :class:`Reconstruction` for the rest, and for several windows.
    """
    work = Reconstruction(
        recording, calibration, model=model, encoder=encoder, camera_rotation=camera_rotation, fill=fill, device=device
    )
    return work.window(*work.span(start_us, length_us, turns))


def known_nodes(solver: BrightnessMap) -> NDArray[np.bool_]:
    """Nodes of the map that events determine: enough equations hold there, and most of those that there are."""
    hold, everything = solver.coverage(HOLDS)[0], solver.coverage(1e6)[0]
    return without_pinholes(without_specks((hold >= COVERED) & (hold >= AGREED * everything)))


def grown(mask: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """The mask and all within so many steps to a neighbour, sideways or up and down."""
    for _ in range(by):
        out = mask.copy()
        for one, other in ((out, mask), (out.T, mask.T)):
            one[1:] |= other[:-1]
            one[:-1] |= other[1:]
        mask = out
    return mask


def without_specks(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask without regions under :data:`SPECK` pixels."""
    label, count = ndimage.label(known)
    size = np.bincount(label.ravel(), minlength=count + 1)
    size[0] = 0
    return np.asarray((size >= SPECK)[label])


def without_pinholes(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask with the holes of up to :data:`PINHOLE` pixels closed."""
    label, count = ndimage.label(~known)
    size = np.bincount(label.ravel(), minlength=count + 1)
    return np.asarray(known | (size[label] <= PINHOLE))


def busiest(count: NDArray[np.int32]) -> tuple[int, int]:
    """First column and row of the :data:`PROBE` pixels' square with the most events (``count``, by pixel)."""
    rows = np.add.reduceat(count, np.arange(0, count.shape[0], PROBE), axis=0)
    cells = np.add.reduceat(rows, np.arange(0, count.shape[1], PROBE), axis=1)
    row, column = np.unravel_index(int(cells.argmax()), cells.shape)
    return int(column) * PROBE, int(row) * PROBE


def orbit(model: Model) -> NDArray[np.float64]:
    """How far the prism moves pixels of the image's border over a turn [px], shape (n, 2)."""
    xy = border(model.camera)
    theta = np.arange(24) * (TURN / 24)
    at = np.repeat(xy, 24, axis=0)
    moved = model.compensate_points(at.astype(np.float32), np.tile(theta, len(xy)))
    away = np.asarray(moved, np.float64) - at
    return away[np.isfinite(away).all(axis=1)]
