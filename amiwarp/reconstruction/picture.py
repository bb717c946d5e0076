"""A picture of the scene from the events of a time window: log intensity by least squares, without training.

The pairs of consecutive events of each pixel are linear equations in the log-intensity map, see
:mod:`amiwarp.brightness.solver`. The map is one tile: the image, extended by the prism's orbit. The picture is cut out
of it. ``docs/explanation/reconstruction.md`` gives the method and its limits.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.brightness.event_pairs import EventTable, PairSet
from amiwarp.brightness.solver import BrightnessMap, Smoothness
from amiwarp.brightness.tiles import Tiles
from amiwarp.compensation.recordings import check_size
from amiwarp.errors import AmiwarpError
from amiwarp.events.checks import TIME_LIMIT
from amiwarp.events.device_source import DeviceMemoryEvents, device_of, read_between
from amiwarp.events.encoder_speed import turn_between
from amiwarp.kernels.page_locked import start_read
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.reconstruction.choices import Fill
from amiwarp.reconstruction.result import Picture, upload_picture
from amiwarp.reconstruction.rounds import SCALES, solve_rounds
from amiwarp.reconstruction.window import (
    CHOICE_STEPS,
    SMOOTHNESS,
    choice_square,
    map_tile,
    off_excess_by_counts,
    settled_span,
    start_lowest_weight,
)
from amiwarp.validation import choice, guarded, real, whole

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.calib.result import Calibration
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.recording import Recording
    from amiwarp.optics.models import Model

WEAK_WEIGHT = 0.03
"""Weight of the equations from silence and from the window's ends, relative to pairs of events. Held-out pairs are
predicted best near this weight."""
HOLD_OUT_EVERY = 8
"""Interval of held-out pairs: every eighth pair of events is held out to choose the smoothness."""
EDGE_STEP = 0.5
"""Difference of neighbouring nodes above which ``Fill.EDGE`` treats them as separated by an edge [thresholds]."""
MEAN_DAMPING = 1e-6
"""Weight of the squared map values. It determines the mean of the map, which no equation does."""
SPANS_PER_TURN = 8
"""Number of time spans per turn. A pixel that is silent in all spans of a turn adds one no-change equation per span."""


@guarded
class Reconstruction:
    """Reconstruction of pictures from time windows of one recording.

    Parameters
    ----------
    recording : Recording
        Recording with events.
    calibration : Calibration, optional
        Calibration of the same sensor size. It provides model, encoder and camera rotation.
    model : Model, optional
        Optical model of the prism, if there is no calibration.
    encoder : Encoder, optional
        Encoder, if neither calibration nor recording provides one.
    camera_rotation : CameraRotation, optional
        The camera's own rotation; by default that of the calibration.
    fill : Fill, optional
        How to fill unknown parts.
    device : str or warp.Device, optional
        Device to compute on, by default that of :class:`DeviceMemoryEvents`, else the CPU.

    Raises
    ------
    AmiwarpError
        If the recording has no events, the sensor sizes differ, there is no model or no encoder, or the events are on
        another device than ``device``.

    Examples
    --------
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    >>> camera, prism = amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.03)
    >>> recording = amiwarp.simulate(picture, camera, prism, duration_s=0.1)
    >>> work = amiwarp.Reconstruction(recording, model=amiwarp.ExactModel.from_prism(camera, prism, 0.0))
    >>> work.window(*work.span(turns=1.0)).log.shape
    (24, 32)
    """

    def __init__(
        self,
        recording: Recording,
        calibration: Calibration | None = None,
        *,
        model: Model | None = None,
        encoder: Encoder | None = None,
        camera_rotation: CameraRotation | None = None,
        fill: Fill = Fill.SMOOTH,
        device: Any = None,
    ) -> None:
        if not len(recording.events):
            raise AmiwarpError(f"{recording.name}: has no events; give a recording with events")
        first, last = recording.events.t_first, recording.events.t_last
        if calibration is not None:
            check_size(calibration, recording.events.size, recording.name)
            model, encoder = calibration.model, calibration.encoder_for(recording.encoder, first, last)
        encoder = encoder or recording.encoder
        if model is None or encoder is None:
            raise AmiwarpError(f"{recording.name}: give a calibration, or a model and an encoder")
        check_size(model, recording.events.size, recording.name, what="model")
        self.recording, self.model, self.encoder = recording, model, encoder
        if camera_rotation is None and calibration is not None:
            camera_rotation = calibration.camera_rotation
        self.camera_rotation, self.device = camera_rotation or CameraRotation(), device_of(recording.events, device)
        self.fill = choice(Fill, fill, "fill")
        self.turn_us = turn_between(encoder, first, last)
        self.smoothness: float | None = None  # weight of the prior; None: the next window chooses it

    def span(
        self, start_us: int | None = None, length_us: int | None = None, turns: float | None = None
    ) -> tuple[int, int]:
        """Return start and length of a time window.

        Parameters
        ----------
        start_us : int, optional
            Start [us]; by default one turn (0.1 s without rotation) after the first event, or as late as possible.
        length_us : int, optional
            Length [us]; by default one turn, or 0.1 s if the prism does not turn.
        turns : float, optional
            Length [turns], instead of ``length_us``.

        Returns
        -------
        tuple of int
            Start and length [us].

        Raises
        ------
        AmiwarpError
            If the window has no events, or both lengths are given, or ``turns`` is given and the prism does not turn.
        """
        first, last = self.recording.events.t_first, self.recording.events.t_last
        if turns is not None:
            if length_us is not None:
                raise AmiwarpError("turns and length_us are both given; give one of them")
            if self.turn_us is None:
                raise AmiwarpError("turns is given, but the prism does not turn; give a length")
            length_us = round(turns * self.turn_us)
        settled, length = settled_span(self.recording.events, self.turn_us, length_us)
        start = settled if start_us is None else start_us
        if length < 1 or start > last or start + length <= first:
            where = f"{start} .. {start + length} us"
            raise AmiwarpError(
                f"{self.recording.name}: no events in {where}; give a window that overlaps {first} .. {last} us"
            )
        return start, length

    def window(self, start_us: int, length_us: int, *, last: Picture | None = None) -> Picture:
        """Reconstruct the picture of one time window.

        Parameters
        ----------
        start_us : int
            Start [us].
        length_us : int
            Length [us].
        last : Picture, optional
            Picture of the window before, from which the solver starts.

        Returns
        -------
        Picture
            The picture. It is on the device if the events are.

        Raises
        ------
        AmiwarpError
            If no pixel fires twice in the window.
        """
        recording, began = self.recording, time.perf_counter()
        width, height = recording.events.size
        table, count = self._table(start_us, length_us)
        tile_of = start_read(table.tile_of)
        pairs = self._pairs(table, start_us, length_us)
        pair_count = pairs.of_two_events
        if not pair_count:
            where = f"{start_us} .. {start_us + length_us} us"
            raise AmiwarpError(f"{recording.name}: no pixel fires twice in {where}; give a longer window")
        off = off_excess_by_counts(recording.events, self.turn_us, start_us, length_us)
        left, top, tiles = self._tile(start_us, length_us)
        middle_us = start_us + length_us // 2
        choice = self._start_choice(count, pairs, middle_us, (left, top), off)
        solver = self._solver(pairs, tiles, off, middle_us)
        smoothness = self.smoothness = choice()
        solver.restart(smoothness)
        waiting_residual, waiting_covered = solve_rounds(solver, pair_count, last)
        hot = int((tile_of() < 0).sum())  # while a GPU still solves
        residual, covered = waiting_residual(), waiting_covered()
        cut = np.s_[top : top + height, left : left + width]
        unknowns = solver.unknowns
        log, known = unknowns[: tiles.nodes].reshape(tiles.rows, tiles.columns)[cut], covered[cut]
        log = log - np.median(log[known] if known.any() else log)
        if self.fill is Fill.NONE:
            log = np.where(known, log, np.float32(np.nan))
        found = Picture(
            log=log.astype(np.float32), known=known, start_us=start_us, length_us=length_us, pairs=pair_count,
            off_excess=off, smoothness=smoothness, residual=residual, hot=hot,
            seconds=time.perf_counter() - began, unknowns=unknowns,
        )  # fmt: skip
        return upload_picture(found, self.device) if isinstance(recording.events, DeviceMemoryEvents) else found

    def windows(self, start_us: int, length_us: int, *, step_us: float) -> Iterator[Picture]:
        """Yield pictures of sliding windows, each started from the one before, up to the last complete window.

        A window without a pair of events repeats the picture before it.

        Parameters
        ----------
        start_us : int
            Start of the first window [us].
        length_us : int
            Length of each window [us].
        step_us : float
            Distance between the starts of windows [us].

        Yields
        ------
        Picture
            Picture of each window.
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
        """Return the number of pictures that :meth:`windows` yields.

        Parameters
        ----------
        start_us : int
            Start of the first window [us].
        length_us : int
            Length of each window [us].
        step_us : float
            Distance between the starts of windows [us].

        Returns
        -------
        int
            Number of pictures, at least 1.
        """
        step_us = real(step_us, "step_us", 1.0, TIME_LIMIT, " us")
        room = self.recording.events.t_last + 1 - start_us - length_us
        return max(1, math.floor(room / step_us) + 1)

    def _table(self, start_us: int, length_us: int) -> tuple[EventTable, NDArray[np.int32]]:
        """Return the window's events without hot pixels, and the number of events per pixel, shape (height, width)."""
        whole(start_us, "start_us", -TIME_LIMIT, TIME_LIMIT, " us")
        whole(length_us, "length_us", 1, 3_600_000_000, " us")
        events = read_between(self.recording.events, start_us, start_us + length_us)
        if not len(events):
            where = f"{start_us} .. {start_us + length_us} us"
            raise AmiwarpError(f"{self.recording.name}: no events in {where}; give another window")
        width, height = self.recording.events.size
        table = EventTable([events], np.zeros((height, width), np.int32), self.device)
        return table, table.exclude_hot_pixels()

    def _pairs(self, table: EventTable, start_us: int, length_us: int) -> PairSet:
        """Return all equations of a window: pairs of events, ends of the window, and silence."""
        turn = min(self.turn_us or length_us, length_us)
        spans = max(2, round(SPANS_PER_TURN * length_us / turn))
        edges = np.round(np.linspace(start_us, start_us + length_us, spans + 1)).astype(np.int64)
        return table.pairs(
            self.encoder, longest_gap_us=length_us, middle_us=start_us + length_us // 2, weak=WEAK_WEIGHT,
            window=(start_us, start_us + length_us), quiet=(edges, min(spans, SPANS_PER_TURN)),
        )  # fmt: skip

    def _solver(self, pairs: PairSet, tiles: Tiles, off: float, middle_us: int) -> BrightnessMap:
        """Return a solver for the pairs on the given tiles, with the pairs displaced by the optical model."""
        prior = Smoothness(self.smoothness or SMOOTHNESS[0], EDGE_STEP if self.fill is Fill.EDGE else 0.0)
        solver = BrightnessMap(
            pairs, tiles, off_excess=off, damping=MEAN_DAMPING, smoothness=prior, middle_us=middle_us
        )
        solver.place(self.model, camera_rotation=self.camera_rotation)
        return solver

    def _start_choice(
        self, count: NDArray[np.int32], pairs: PairSet, middle_us: int, margin: tuple[int, int], off: float
    ) -> Callable[[], float]:
        """Start to find the smoothness weight with the lowest cost of held-out pairs, in the busiest part of the image.

        Return a function that waits for it. If there is a weight already, it is kept.
        """
        if self.smoothness is not None:
            return partial(float, self.smoothness)
        x0, y0, side = choice_square(count)
        part = pairs.of_square(x0, y0, side)
        if part.hold_out(HOLD_OUT_EVERY) < 50:
            return lambda: SMOOTHNESS[-1]
        left, top = margin
        tiles = Tiles(np.array([[x0 - left, y0 - top]], np.float32), side + 2 * top, side + 2 * left, 1.0)
        solver = self._solver(part, tiles, off, middle_us)

        def start_cost(weight: float) -> Callable[[], float]:
            solver.restart(weight)
            solver.solve(*SCALES[:2], steps=CHOICE_STEPS)
            return solver.residuals.start_mean_cost(SCALES[0], held=True)

        return start_lowest_weight(start_cost)

    def _tile(self, start_us: int, length_us: int) -> tuple[int, int, Tiles]:
        """Return the map's margin left of and above the image (columns, rows), and the map of a window."""
        return map_tile(self.model, self.camera_rotation.about(start_us + length_us // 2), length_us)


@guarded
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
    device: Any = None,
) -> Picture:
    """Reconstruct a picture of the scene from one time window, a quarter turn of the prism or longer.

    Use :class:`Reconstruction` for several windows.

    Parameters
    ----------
    recording : Recording
        Recording with events.
    calibration : Calibration, optional
        Calibration of the same sensor size. It provides model, encoder and camera rotation.
    model : Model, optional
        Optical model of the prism, if there is no calibration.
    encoder : Encoder, optional
        Encoder, if neither calibration nor recording provides one.
    start_us : int, optional
        Start of the window [us]; by default one turn (0.1 s without rotation of the prism) after the first event, or as
        late as possible.
    length_us : int, optional
        Length of the window [us]; by default one turn, or 0.1 s if the prism does not turn.
    turns : float, optional
        Length of the window [turns], instead of ``length_us``.
    camera_rotation : CameraRotation, optional
        The camera's own rotation; by default that of the calibration.
    fill : Fill, optional
        How to fill unknown parts.
    device : str or warp.Device, optional
        Device to compute on, by default that of :class:`DeviceMemoryEvents`, else the CPU.

    Returns
    -------
    Picture
        The picture. It is on the device if the events are, in :class:`DeviceMemoryEvents`.

    Raises
    ------
    AmiwarpError
        If the recording has no events in the window, the sensor sizes differ, there is no model or no encoder, or the
        events are on another device than ``device``.

    Examples
    --------
    >>> import numpy as np
    >>> picture = np.random.default_rng(0).random((64, 64)).astype(np.float32)
    >>> camera, prism = amiwarp.Camera.from_fov(32, 24, 1.0), amiwarp.Prism(0.03)
    >>> recording = amiwarp.simulate(picture, camera, prism, duration_s=0.1)
    >>> found = amiwarp.reconstruct(recording, model=amiwarp.ExactModel.from_prism(camera, prism, 0.0))
    >>> found.known.shape
    (24, 32)
    """
    work = Reconstruction(
        recording, calibration, model=model, encoder=encoder, camera_rotation=camera_rotation, fill=fill, device=device
    )
    return work.window(*work.span(start_us, length_us, turns))
