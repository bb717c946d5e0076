"""A picture of the scene from the events of a time window: log intensity by least squares, without training.

The pairs of consecutive events of each pixel are linear equations in the log-intensity map, see
:mod:`amiwarp.brightness.solver`. The map is one tile: the image, extended by the prism's orbit. The picture is cut out
of it. ``docs/explanation/reconstruction.md`` gives the method and its limits.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.brightness.event_table import EventTable
from amiwarp.brightness.pairs import PairSet
from amiwarp.brightness.sensor_timing import SensorTiming
from amiwarp.brightness.solver import BrightnessMap, Smoothness
from amiwarp.brightness.tiles import Tiles
from amiwarp.choices import Fill
from amiwarp.compensation.recordings import check_size
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.device_events import DeviceMemoryEvents, device_of, read_between
from amiwarp.events.encoder import Encoder, check_prisms
from amiwarp.events.encoder_speed import turn_between
from amiwarp.events.recording import Recording
from amiwarp.kernels.page_locked_memory import start_read
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.base import Model
from amiwarp.reconstruction.known_nodes import known_nodes, nodes_near
from amiwarp.reconstruction.off_excess import off_excess_by_counts
from amiwarp.reconstruction.picture import Picture, upload_picture
from amiwarp.reconstruction.smoothness import (
    CHOICE_STEPS,
    SMOOTHNESS,
    choice_square,
    start_weight_choice,
)
from amiwarp.reconstruction.windows import map_tile, window_count, window_span
from amiwarp.results.calibration import Calibration
from amiwarp.schema.calls import guarded
from amiwarp.validation import TIME_LIMIT, choice, real, whole

SCALES = (1.0, 0.5, 0.5)
"""Residual at which an equation gets half weight, in each round of Cauchy weights [thresholds]."""
STEPS = 24
"""Number of conjugate-gradient steps in each round of Cauchy weights."""
NOISE_DISTANCE = 2
"""Distance from known pixels beyond which pairs of events are excluded as noise [px]."""


def solve_rounds(
    solver: BrightnessMap, pair_count: int, last: NDArray[np.float32] | None
) -> tuple[Callable[[], float], Callable[[], NDArray[np.bool_]]]:
    """Solve for the map. Return functions that wait for the median residual and for the known nodes.

    The known nodes have shape (rows, columns). A GPU still works when this returns. ``last`` is the solution of the
    previous window, from which this one starts.
    """
    *first_scales, last_scale = SCALES
    if last is not None:
        # Its map is good enough to leave the coarsest round out. The sensor's unknowns are this window's own.
        nodes = solver.tiles.nodes
        unknowns = last.copy()
        unknowns[nodes:] = solver.unknowns[nodes:]
        solver.unknowns = unknowns
        first_scales = first_scales[1:]
    solver.solve(*first_scales, steps=STEPS)
    residual = solver.residuals.start_median(pair_count)
    covered = known_nodes(solver)
    solver.keep(nodes_near(covered, NOISE_DISTANCE))
    solver.solve(last_scale, steps=STEPS)
    return residual, lambda: covered.numpy().view(np.bool_)


WEAK_WEIGHT = 0.03
"""Weight of the equations from silence and from the window's ends, relative to pairs of events. Held-out pairs are
predicted best near this weight."""
HOLD_OUT_EVERY = 8
"""Interval of held-out pairs: every eighth pair of events is held out to choose the smoothness."""
FEWEST_HELD_OUT = 50
"""Number of held-out pairs from which they choose the smoothness; with fewer, the strongest prior is taken."""
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
        The camera's own rotation; by default the calibration's.
    fill : Fill, optional
        How to fill unknown parts.
    smoothness : float, optional
        Weight of the smoothness prior. By default the first window chooses it, for the later ones too.
    with_silence : bool, default True
        Whether pixels without events give equations. They are half of the work, and make even areas smooth.
    device : str or warp.Device, optional
        Device to compute on, by default the device of :class:`DeviceMemoryEvents`, else the CPU.

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
        smoothness: float | None = None,
        with_silence: bool = True,
        device: Any = None,
    ) -> None:
        if not len(recording.events):
            raise AmiwarpError(
                f"{recording.name}: has no events; give a recording with events",
                ErrorCode.CONTENT_MISSING,
            )
        first = recording.events.t_first
        last = recording.events.t_last
        if calibration is not None:
            check_size(calibration, recording.events.size, recording.name)
            model = calibration.model
            encoder = calibration.encoder_for(recording.encoder, first, last)
        encoder = encoder or recording.encoder
        if model is None or encoder is None:
            raise AmiwarpError(
                f"{recording.name}: give a calibration, or a model and an encoder",
                ErrorCode.CONTENT_MISSING,
            )
        check_size(model, recording.events.size, recording.name, what="model")
        check_prisms(encoder, model.ANGLES)
        self.recording = recording
        self.model = model
        self.encoder = encoder
        if camera_rotation is None and calibration is not None:
            camera_rotation = calibration.camera_rotation
        self.camera_rotation = camera_rotation or CameraRotation()
        self.device = device_of(recording.events, device)
        self.fill = choice(Fill, fill, "fill")
        self.turn_us = turn_between(encoder, first, last)
        if smoothness is not None:
            smoothness = real(smoothness, "smoothness", 0.0)
        self._smoothness = smoothness
        self._with_silence = with_silence

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
        return window_span(self.recording, self.turn_us, start_us, length_us, turns)

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
        recording = self.recording
        began = time.perf_counter()
        table, count = self._table(start_us, length_us)
        # The host reads and counts while a GPU works on. So what it starts and what it waits for alternate.
        tile_of = start_read(table.tile_of)
        pairs = self._pairs(table, start_us, length_us)
        pair_count = pairs.of_two_events
        if not pair_count:
            where = f"{start_us} .. {start_us + length_us} us"
            raise AmiwarpError(
                f"{recording.name}: no pixel fires twice in {where}; give a longer window",
                ErrorCode.CONTENT_MISSING,
            )
        off = off_excess_by_counts(recording.events, self.turn_us, start_us, length_us)
        left, top, tiles = self._tile(start_us, length_us)
        middle_us = start_us + length_us // 2
        smoothness_found = self._start_choice(count, pairs, middle_us, (left, top), off)
        solver = self._solver(pairs, tiles, off, middle_us)
        smoothness = smoothness_found()
        solver.restart(smoothness)
        start = None if last is None else last.to_host().unknowns
        median_residual, covered = solve_rounds(solver, pair_count, start)
        hot = int((tile_of() < 0).sum())
        residual = median_residual()

        # Cut the image out of the map, and set the free constant by the median.
        width, height = recording.events.size
        cut = np.s_[top : top + height, left : left + width]
        known = covered()[cut]
        unknowns = solver.unknowns
        log = unknowns[: tiles.nodes].reshape(tiles.rows, tiles.columns)[cut]
        log = log - np.median(log[known] if known.any() else log)
        if self.fill is Fill.NONE:
            log = np.where(known, log, np.float32(np.nan))
        found = Picture(
            log=log.astype(np.float32),
            known=known,
            start_us=start_us,
            length_us=length_us,
            pairs=pair_count,
            off_excess=off,
            smoothness=smoothness,
            residual=residual,
            hot=hot,
            seconds=time.perf_counter() - began,
            unknowns=unknowns,
        )
        if isinstance(recording.events, DeviceMemoryEvents):
            return upload_picture(found, self.device)
        return found

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
        return window_count(self.recording, start_us, length_us, step_us)

    def _table(self, start_us: int, length_us: int) -> tuple[EventTable, NDArray[np.int32]]:
        """Return the window's events without hot pixels, and the number of events per pixel, shape (height, width)."""
        whole(start_us, "start_us", -TIME_LIMIT, TIME_LIMIT, " us")
        whole(length_us, "length_us", 1, 3_600_000_000, " us")
        events = read_between(self.recording.events, start_us, start_us + length_us)
        if not len(events):
            where = f"{start_us} .. {start_us + length_us} us"
            raise AmiwarpError(
                f"{self.recording.name}: no events in {where}; give another window",
                ErrorCode.CONTENT_MISSING,
            )
        width, height = self.recording.events.size
        table = EventTable([events], np.zeros((height, width), np.int32), self.device)
        return table, table.exclude_hot_pixels()

    def _pairs(
        self, table: EventTable, start_us: int, length_us: int, sensor: SensorTiming | None = None
    ) -> PairSet:
        """Return all equations of a window: pairs of events, ends of the window, and silence."""
        quiet = None
        if self._with_silence:
            turn = min(self.turn_us or length_us, length_us)
            spans = max(2, round(SPANS_PER_TURN * length_us / turn))
            edges = np.round(np.linspace(start_us, start_us + length_us, spans + 1))
            quiet = (edges.astype(np.int64), min(spans, SPANS_PER_TURN))
        return table.pairs(
            self.encoder,
            longest_gap_us=length_us,
            sensor=sensor,
            middle_us=start_us + length_us // 2,
            weak=WEAK_WEIGHT,
            window=(start_us, start_us + length_us),
            quiet=quiet,
        )

    def _solver(self, pairs: PairSet, tiles: Tiles, off: float, middle_us: int) -> BrightnessMap:
        """Return a solver for the pairs on the given tiles, with the pairs displaced by the optical model."""
        edge = EDGE_STEP if self.fill is Fill.EDGE else 0.0
        prior = Smoothness(self._smoothness or SMOOTHNESS[0], edge)
        solver = BrightnessMap(
            pairs,
            tiles,
            off_excess=off,
            damping=MEAN_DAMPING,
            smoothness=prior,
            middle_us=middle_us,
        )
        solver.place(self.model, camera_rotation=self.camera_rotation)
        return solver

    def _start_choice(
        self,
        count: NDArray[np.int32],
        pairs: PairSet,
        middle_us: int,
        margin: tuple[int, int],
        off: float,
    ) -> Callable[[], float]:
        """Start to find the smoothness weight with the lowest cost of held-out pairs, in the busiest part of the image.

        Return a function that waits for it, and keeps it for later windows. A weight that is known stays.
        """
        if self._smoothness is not None:
            return partial(float, self._smoothness)
        found = self._start_held_out(count, pairs, middle_us, margin, off)

        def chosen() -> float:
            self._smoothness = found()
            return self._smoothness

        return chosen

    def _start_held_out(
        self,
        count: NDArray[np.int32],
        pairs: PairSet,
        middle_us: int,
        margin: tuple[int, int],
        off: float,
    ) -> Callable[[], float]:
        """Start to find the weight by held-out pairs. Return a function that waits for it."""
        x0, y0, side = choice_square(count)
        part = pairs.of_square(x0, y0, side)
        if part.hold_out(HOLD_OUT_EVERY) < FEWEST_HELD_OUT:
            return lambda: SMOOTHNESS[-1]
        left, top = margin
        origin = np.array([[x0 - left, y0 - top]], np.float32)
        tiles = Tiles(origin, side + 2 * top, side + 2 * left, 1.0)
        solver = self._solver(part, tiles, off, middle_us)

        def start_cost(weight: float) -> Callable[[], float]:
            solver.restart(weight)
            solver.solve(*SCALES[:2], steps=CHOICE_STEPS)
            return solver.residuals.start_mean_cost(SCALES[0], held=True)

        return start_weight_choice(start_cost)

    def _tile(self, start_us: int, length_us: int) -> tuple[int, int, Tiles]:
        """Return the map's margin left of and above the image (columns, rows), and the map of a window."""
        about_middle = self.camera_rotation.about(start_us + length_us // 2)
        return map_tile(self.model, about_middle, length_us)


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
        The camera's own rotation; by default the calibration's.
    fill : Fill, optional
        How to fill unknown parts.
    device : str or warp.Device, optional
        Device to compute on, by default the device of :class:`DeviceMemoryEvents`, else the CPU.

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
        recording,
        calibration,
        model=model,
        encoder=encoder,
        camera_rotation=camera_rotation,
        fill=fill,
        device=device,
    )
    return work.window(*work.span(start_us, length_us, turns))
