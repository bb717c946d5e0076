"""A picture of the scene from the events of a time window: log intensity by least squares, without training.

The pairs of consecutive events of each pixel are linear equations in the log-intensity map, see
:mod:`amiwarp.brightness.solver`. The map is one tile: the image, extended by the prism's orbit. The picture is cut out
of it. ``docs/explanation/reconstruction.md`` gives the method and its limits.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.solver import BrightnessMap, EventTable, PairSet, SensorTiming, Smoothness, Tiles
from amiwarp.calib.result import Calibration
from amiwarp.choices import CONTRAST, Fill, Tone
from amiwarp.compensation.recordings import check_size
from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceMemoryEvents, device_of, read_between, wait
from amiwarp.events.encoder import TWO_PI, Encoder, check_prisms, turn_between
from amiwarp.events.recording import EventSource, Recording
from amiwarp.imaging.export import encode_image
from amiwarp.io.files import NewFile, check_output
from amiwarp.io.formats import check_ending, video_library
from amiwarp.kernels import known_nodes as kernels
from amiwarp.kernels.launch import launch, load, start_read
from amiwarp.optics.camera import CameraRotation, border
from amiwarp.optics.models import Model
from amiwarp.validation import TIME_LIMIT, choice, guarded, real, whole

# Decision which nodes of a brightness map the events determine.

LEAST_COVERAGE = 0.5
"""Smallest sum of equation weights at a node that counts as known."""
HOLDS_SCALE, LEAST_AGREEMENT = 0.25, 0.4
"""Residual [thresholds] at which an equation gets half weight, and smallest ratio of the sum of these weights to the
sum of full weights at a known node.

A node is known only if enough of the equations around it hold.
"""
SMALLEST_REGION = 12
"""Smallest number of pixels of a connected known region, at most 16; smaller regions are noise."""
LARGEST_HOLE = 4
"""Largest hole of unknown pixels inside a known region that is marked as known [px], because equations surround the
hole."""


def known_nodes(solver: BrightnessMap) -> wp.array:
    """Return 1 for the nodes that events determine, else 0: uint8, shape (rows, columns), on the device.

    These are nodes with enough equations, most of which hold.
    """
    hold, everything = (solver.coverage_on_device(scale) for scale in (HOLDS_SCALE, 1e6))
    known = wp.empty((solver.tiles.rows, solver.tiles.columns), dtype=wp.uint8, device=solver.device)
    inputs = [hold, everything, LEAST_COVERAGE, LEAST_AGREEMENT]
    launch(kernels.mark_known, known.size, inputs, [known.flatten()], device=solver.device)
    return without_small_holes(without_small_regions(known))


def nodes_near(known: wp.array, by: int) -> wp.array:
    """Return 1 for the nodes at most ``by`` steps from known ones, else 0, shape (nodes,); all 1 if none is known.

    Steps go along rows and columns.
    """
    found = wp.zeros(1, dtype=int, device=known.device)
    launch(kernels.find_marked, known.size, [known.flatten()], [found], device=known.device)
    out = wp.empty(known.size, dtype=wp.uint8, device=known.device)
    launch(kernels.widen, known.size, [known, found, by], [out], device=known.device)
    return out


def without_small_regions(known: wp.array) -> wp.array:
    """Return the mask without connected regions of fewer than :data:`SMALLEST_REGION` pixels."""
    return _without_small(known, 1, SMALLEST_REGION)


def without_small_holes(known: wp.array) -> wp.array:
    """Return the mask with holes of up to :data:`LARGEST_HOLE` pixels filled."""
    return _without_small(known, 0, LARGEST_HOLE + 1)


def _without_small(mask: wp.array, value: int, least: int) -> wp.array:
    """Return the mask without regions of ``value`` that have fewer than ``least`` pixels."""
    if mask.device.is_cuda:
        out = wp.empty_like(mask)
        launch(kernels.drop_small_regions, mask.size, [mask, value, least], [out], device=mask.device)
        return out
    large = np.zeros(mask.shape, np.uint8)
    arrays = [wp.array(array, device="cpu", copy=False) for array in (mask.numpy() ^ np.uint8(1 - value), large)]
    load(kernels.find_large_regions, mask.device)
    wp.launch(kernels.find_large_regions, 1, [arrays[0], least, arrays[1]], device="cpu")
    return wp.array(large ^ np.uint8(1 - value), device="cpu", copy=False)


# Rounds of robust weights that solve for the map of a picture.

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
    nodes = solver.tiles.nodes
    if last is not None:
        unknowns = last.copy()
        unknowns[nodes:] = solver.unknowns[nodes:]
        solver.unknowns = unknowns
    solver.solve(*SCALES[0 if last is None else 1 : -1], steps=STEPS)
    residual = solver.residuals.start_median(pair_count)
    covered = known_nodes(solver)
    solver.keep(nodes_near(covered, NOISE_DISTANCE))
    solver.solve(SCALES[-1], steps=STEPS)
    return residual, lambda: covered.numpy().view(np.bool_)


# Properties of one time window: time, size of the map, smoothness, ratio of the thresholds.

LARGEST_MARGIN = 0.5
"""Largest margin of the map on each side of the image, relative to the image's width."""
SMOOTHNESS = (0.004, 0.02, 0.1, 0.5)
"""Candidate weights of the smoothness prior, ascending; held-out equations choose among them."""
TIE = 1.05
"""Ratio of costs of held-out equations up to which the larger weight is chosen. Converged maps nearly tie."""
CHOICE_STEPS = 12
"""Number of conjugate-gradient steps in each round with which the weights are compared. In 28 windows of 12 recordings,
8, 12, 16 and 24 steps chose the same."""
CHOICE_SQUARES = (64, 96)
"""Sides of the square of pixels in which the smoothness is chosen [px]."""
CHOICE_EVENTS = 24_000
"""Number of events that suffices for the choice in the smaller square."""
STILL_WINDOW_US = 100_000
"""Default length of a time window if the prism does not turn [us]."""


def settled_span(source: EventSource, turn_us: float | None, length_us: int | None) -> tuple[int, int]:
    """Return start and length [us] of a time window without the beginning of the recording, if it is long enough.

    There, the reference of a pixel is unknown until its first event. ``turn_us``: duration of a turn [us], None if the
    prism does not turn. ``length_us``: length of the window, by default a turn.
    """
    beginning = round(turn_us or STILL_WINDOW_US)
    length = length_us or beginning
    first, last = source.t_first, source.t_last
    return max(first, min(first + beginning, last + 1 - length)), length


def window_span(
    recording: Recording, turn_us: float | None, start_us: int | None, length_us: int | None, turns: float | None
) -> tuple[int, int]:
    """Return start and length [us] of a time window, see :meth:`Reconstruction.span`. ``turn_us``: as above."""
    first, last = recording.events.t_first, recording.events.t_last
    if turns is not None:
        if length_us is not None:
            raise AmiwarpError("turns and length_us are both given; give one of them")
        if turn_us is None:
            raise AmiwarpError("turns is given, but the prism does not turn; give a length")
        length_us = round(turns * turn_us)
    settled, length = settled_span(recording.events, turn_us, length_us)
    start = settled if start_us is None else start_us
    if length < 1 or start > last or start + length <= first:
        where = f"{start} .. {start + length} us"
        raise AmiwarpError(f"{recording.name}: no events in {where}; give a window that overlaps {first} .. {last} us")
    return start, length


def map_tile(model: Model, camera_rotation: CameraRotation, length_us: int) -> tuple[int, int, Tiles]:
    """Return the map's margin left of and above the image (columns, rows), and the map of all that pixels see.

    ``camera_rotation`` is the rotation about the window's middle. ``length_us`` is the window's length [us].
    """
    camera = model.camera
    margin = np.max(np.abs(border_displacements(model)), axis=0) + camera_rotation.reach(camera, length_us * 0.5e-6)
    limit = LARGEST_MARGIN * camera.width
    left, top = (math.ceil(min(float(m), limit)) + 2 for m in margin)
    origin = np.array([[-left, -top]], np.float32)
    return left, top, Tiles(origin, camera.height + 2 * top, camera.width + 2 * left, 1.0)


def border_displacements(model: Model) -> NDArray[np.float64]:
    """Return the displacements of the image's border by the prism over one turn [px], shape (n, 2)."""
    xy = border(model.camera)
    theta = np.arange(24) * (TWO_PI / 24)
    at = np.repeat(xy, 24, axis=0)
    moved = model.compensate_points(at.astype(np.float32), np.tile(theta, len(xy)))
    away = np.asarray(moved, np.float64) - at
    return away[np.isfinite(away).all(axis=1)]


def choice_square(count: NDArray[np.int32]) -> tuple[int, int, int]:
    """Return first column, first row and side of the square of pixels in which the smoothness is chosen.

    It is the square with the most events, of the smallest side with enough events. ``count``: events per pixel, shape
    ``(height, width)``.
    """
    for side in CHOICE_SQUARES:
        rows = [count[k : k + side].sum(axis=0, dtype=count.dtype) for k in range(0, count.shape[0], side)]
        cells = np.add.reduceat(rows, np.arange(0, count.shape[1], side), axis=1)
        row, column = np.unravel_index(int(cells.argmax()), cells.shape)
        if cells.max() >= CHOICE_EVENTS:
            break
    return int(column) * side, int(row) * side, side


def start_lowest_weight(start_cost: Callable[[float], Callable[[], float]]) -> Callable[[], float]:
    """Start to find the largest weight of :data:`SMOOTHNESS` whose cost is nearly the lowest; see :data:`TIE`.

    ``start_cost`` starts to compute the cost of a weight and returns a function that waits for it. Return a function
    that waits for the weight. The cost falls and then rises with the weight. So the two middle weights show on which
    side the lowest cost is.
    """
    weakest, weak, strong, strongest = SMOOTHNESS
    waiting = start_cost(weak), start_cost(strong)

    def result() -> float:
        weak_cost, strong_cost = (cost() for cost in waiting)
        if strong_cost <= TIE * weak_cost:
            return strongest if start_cost(strongest)() <= TIE * min(weak_cost, strong_cost) else strong
        return weak if weak_cost <= TIE * start_cost(weakest)() else weakest

    return result


def off_excess_by_counts(source: EventSource, turn_us: float | None, start_us: int, length_us: int) -> float:
    """Return the ratio of the OFF to the ON threshold, minus 1, from event counts over whole turns near the window.

    After a whole turn, a pixel is back at its brightness. So the number of ON events times the ON threshold equals the
    number of OFF events times the OFF threshold. This does not hold in the first turn of a recording: before a pixel
    fires, its reference is not the brightness that an event left. So later turns are counted; in a recording of less
    than two turns, the first event of each pixel is not counted.
    """
    first, last = source.t_first, source.t_last
    if turn_us is None or last - first < turn_us:
        return 0.0
    turns = (last - first) / turn_us
    length = max(1, math.floor(min(length_us / turn_us, turns - 1.0))) * turn_us
    start = min(max(start_us, first + turn_us), last - length)
    settled = start >= first + turn_us
    events = read_between(source, round(start if settled else first), round(start + length))
    t, x, y, p = (v if isinstance(v, np.ndarray) else v.numpy() for v in (events.t, events.x, events.y, events.p))
    if not settled:
        counted = t >= start
        counted[first_of_each_pixel(x, y, source.size[0])] = False
        p = p[counted]
    on = int(p.sum())
    return float(np.clip(on / max(len(p) - on, 1) - 1.0, -0.7, 2.0)) if len(p) >= 1000 else 0.0


def first_of_each_pixel(x: NDArray[Any], y: NDArray[Any], width: int) -> NDArray[np.int64]:
    """Return the index of the first event of each pixel that fires, for events in time order, shape (pixels,)."""
    index: NDArray[np.int64] = np.unique(y.astype(np.int64) * width + x, return_index=True)[1]
    return index


# Reconstructed picture of a scene.

ARRAYS = ("log", "known", "unknowns")
"""Names of the arrays of a picture."""


@guarded
@dataclass(frozen=True, eq=False)
class Picture:
    """Picture of the scene over a time window, without the prism.

    Its arrays are NumPy arrays, or Warp arrays on a device if the events are there (:class:`DeviceMemoryEvents`). Their
    values are not checked.
    PyTorch, CuPy and JAX read Warp arrays through DLPack without a copy.

    Examples
    --------
    >>> import numpy as np
    >>> picture = amiwarp.Picture(
    ...     log=np.array([[0.0, 2.0]], np.float32), known=np.array([[True, True]]), start_us=0, length_us=1000, pairs=2,
    ...     off_excess=0.0, smoothness=0.02, residual=0.1, hot=0, seconds=0.0, unknowns=np.zeros(2, np.float32))
    >>> picture.intensity(0.5).round(2)
    array([[1.  , 2.72]], dtype=float32)
    """

    log: Any
    """Log intensity in units of the ON threshold, median 0, float32, shape (height, width); NaN where it is not filled.

    Events determine it up to one constant per connected region of :attr:`known`; the fill joins the regions.
    """
    known: Any
    """Whether events determine the pixel, bool, shape (height, width)."""
    start_us: int
    """Start of the time window [us]."""
    length_us: int
    """Length of the time window [us]."""
    pairs: int
    """Number of equations from pairs of two events."""
    off_excess: float
    """Assumed ratio of the OFF to the ON threshold, minus 1."""
    smoothness: float
    """Weight of the smoothness prior, chosen by equations that were held out of the fit."""
    residual: float
    """Median absolute residual of the equations [ON thresholds]. Near 1, the optical model or the motion is wrong."""
    hot: int
    """Number of hot pixels that were excluded."""
    seconds: float
    """Computing time of the picture [s]."""
    unknowns: Any
    """Solution of the whole map with its margin, flattened, followed by the sensor's unknowns, float32, shape (n,). The
    next window can start from it."""

    def __repr__(self) -> str:
        height, width = self.log.shape
        span = f"t {self.start_us} .. {self.start_us + self.length_us} us"
        return f"Picture({width}x{height} px, {span}, {self.pairs:,} pairs, residual {self.residual:.3g})"

    def to_host(self) -> Picture:
        """Return the picture in NumPy arrays: copies from a GPU, views on a CPU.

        Returns
        -------
        Picture
            The picture; this one if its arrays are NumPy arrays.
        """
        if not isinstance(self.log, wp.array):
            return self
        return replace(self, **{name: getattr(self, name).numpy() for name in ARRAYS})

    def intensity(self, contrast: float = 0.25) -> Any:
        """Return relative linear intensity, 1 at the median.

        Parameters
        ----------
        contrast : float, optional
            ON threshold [log intensity].

        Returns
        -------
        ndarray or warp.array
            Intensity, float32, shape ``(height, width)``; NaN where the picture is not filled. It is where the picture
            is.
        """
        contrast = real(contrast, "contrast", 0.0, 10.0)
        if isinstance(self.log, wp.array):
            out = wp.empty_like(self.log)
            wp.launch(kernels.exponentiate, out.shape, inputs=[self.log, contrast], outputs=[out], device=out.device)
            wait(out.device)
            return out
        return np.exp(np.float32(contrast) * self.log)


def upload_picture(picture: Picture, device: Any) -> Picture:
    """Return the picture in Warp arrays on a device."""
    found = replace(picture, **{name: wp.array(getattr(picture, name), device=device) for name in ARRAYS})
    wait(found.log.device)
    return found


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
        check_prisms(encoder, model.ANGLES)
        self.recording, self.model, self.encoder = recording, model, encoder
        if camera_rotation is None and calibration is not None:
            camera_rotation = calibration.camera_rotation
        self.camera_rotation, self.device = camera_rotation or CameraRotation(), device_of(recording.events, device)
        self.fill = choice(Fill, fill, "fill")
        self.turn_us = turn_between(encoder, first, last)
        self.smoothness: float | None = None  # weight of the prior; None: the next window chooses it
        self.with_silence = True  # whether pixels without events give equations, which make half of the work

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
        waiting_residual, waiting_covered = solve_rounds(
            solver, pair_count, None if last is None else last.to_host().unknowns
        )
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

    def _pairs(self, table: EventTable, start_us: int, length_us: int, sensor: SensorTiming | None = None) -> PairSet:
        """Return all equations of a window: pairs of events, ends of the window, and silence."""
        turn = min(self.turn_us or length_us, length_us)
        spans = max(2, round(SPANS_PER_TURN * length_us / turn))
        edges = np.round(np.linspace(start_us, start_us + length_us, spans + 1)).astype(np.int64)
        return table.pairs(
            self.encoder, longest_gap_us=length_us, sensor=sensor, middle_us=start_us + length_us // 2,
            weak=WEAK_WEIGHT, window=(start_us, start_us + length_us),
            quiet=(edges, min(spans, SPANS_PER_TURN)) if self.with_silence else None,
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


# Write reconstructed pictures to files: 8 and 16 bit pictures, arrays and video. Each file is complete or absent.

DARK, BRIGHT = 0.5, 99.5
"""Percentiles of intensity over the known pixels that are shown black and white."""
GAMMA = 2.2
"""Gamma with which pictures are displayed."""
LIMITS_UPDATE = 0.1
"""Weight of a new frame in the running average of a video's black and white levels. A small weight prevents flicker."""
GIF_FPS = 50.0
"""Most frames per second of a GIF. Programs show those with shorter frames more slowly."""
STILL_SUFFIXES = (".png", ".tif", ".tiff", ".npy")
"""File suffixes of single pictures."""
MASK_SUFFIXES = (".png", ".tif", ".tiff")
"""File suffixes of masks."""
VIDEO = ".mp4"
"""File suffix of videos."""
FILM_SUFFIXES = (VIDEO, ".gif")
"""File suffixes of films."""


def limits(picture: Picture, contrast: float = CONTRAST) -> tuple[float, float]:
    """Return the intensities that are shown black and white."""
    shown = picture.known if picture.known.any() else np.isfinite(picture.log)
    dark, bright = np.exp(contrast * np.percentile(picture.log[shown], [DARK, BRIGHT]))
    return float(dark), float(max(bright, dark * (1.0 + 1e-6)))


def tones(
    picture: Picture, tone: Tone, *, contrast: float = CONTRAST, between: tuple[float, float] | None = None
) -> NDArray[np.float32]:
    """Return the picture as pixel values 0 .. 1, shape (height, width); 0 where the picture is not filled.

    ``contrast``: the ON threshold [log intensity]. ``between``: intensities shown black and white, by default those of
    :func:`limits`.
    """
    tone = choice(Tone, tone, "tone")
    dark, bright = between or limits(picture, contrast)
    light = picture.intensity(contrast)
    if tone is Tone.LINEAR:
        value = np.clip(light / bright, 0.0, 1.0)
    else:
        value = np.clip((light - dark) / (bright - dark), 0.0, 1.0) ** (1.0 / GAMMA)
    return np.nan_to_num(value).astype(np.float32)


def check_path(path: Path, endings: tuple[str, ...] = (*STILL_SUFFIXES, VIDEO), *, overwrite: bool = False) -> None:
    """Raise :class:`AmiwarpError` for a file suffix that is not in ``endings``, or a folder that does not exist."""
    check_ending(path, "pictures are written", endings)
    check_output(path, overwrite=overwrite)


def save_picture(
    picture: Picture, path: Path, *, tone: Tone = Tone.MAPPED, bits: int = 8, contrast: float = CONTRAST
) -> None:
    """Write a reconstructed picture as .png (8 or 16 bit), .tif (16 bit) or .npy.

    A .npy file holds the natural log intensity, float32, NaN where it is not filled.
    """
    _save_still(path, bits, array=lambda: contrast * picture.log, grey=lambda: tones(picture, tone, contrast=contrast))


def save_network_picture(image: NDArray[np.float32], path: Path, *, tone: Tone = Tone.MAPPED, bits: int = 8) -> None:
    """Write the picture of a network, shape (height, width), as .png, .tif or .npy, which holds its values."""
    _save_still(path, bits, array=lambda: image, grey=lambda: _network_tones(image, tone, _network_limits(image)))


def _save_still(path: Path, bits: int, *, array: Callable[[], Any], grey: Callable[[], NDArray[np.float32]]) -> None:
    """Write a picture: ``array`` as .npy, or the pixel values 0 .. 1 of ``grey`` as .png or .tif."""
    check_path(path, STILL_SUFFIXES)
    if bits not in (8, 16):
        raise AmiwarpError(f"{path}: {bits} bits per pixel; expected 8 or 16")
    ending = path.suffix.lower()
    if ending == ".npy":
        with NewFile(path) as new, open(new.part, "wb") as file:
            np.save(file, array().astype(np.float32))
        return
    save_grey(grey(), path, bits=bits if ending == ".png" else 16)


def _network_limits(image: NDArray[np.float32]) -> tuple[float, float]:
    """Return the values of a network's picture that are shown black and white."""
    dark, bright = np.percentile(np.nan_to_num(image), [DARK, BRIGHT])
    return float(dark), float(bright)


def _network_tones(image: NDArray[np.float32], tone: Tone, between: tuple[float, float]) -> NDArray[np.float32]:
    """Return a network's picture as pixel values 0 .. 1. Networks learn from pictures that have a gamma already."""
    dark, bright = (0.0, 1.0) if choice(Tone, tone, "tone") is Tone.LINEAR else between
    return np.clip((np.nan_to_num(image) - dark) / max(bright - dark, 1e-6), 0.0, 1.0).astype(np.float32)


def save_mask(picture: Picture, path: Path) -> None:
    """Write the mask of known pixels as .png or .tif: white where events determine the picture."""
    check_path(path, MASK_SUFFIXES)
    save_grey(picture.known.astype(np.float32), path, bits=8)


def save_grey(value: NDArray[np.float32], path: Path, *, bits: int) -> None:
    """Write values 0 .. 1, shape (height, width), as a grey picture of 8 or 16 bits."""
    from PIL import Image

    kind = np.uint8 if bits == 8 else np.uint16
    image = Image.fromarray(np.rint(value * np.iinfo(kind).max).astype(kind))
    with NewFile(path) as new:
        encode_image(new.part, image, "PNG" if path.suffix.lower() == ".png" else "TIFF")


def save_video(
    pictures: Iterable[Picture], path: Path, *, fps: float, tone: Tone = Tone.MAPPED, contrast: float = CONTRAST
) -> int:
    """Write an MP4 video (H.264) and return its number of frames.

    Black and white levels follow the scene slowly.
    """
    return _save_steady(
        pictures, path, fps,
        levels=lambda picture: limits(picture, contrast),
        grey=lambda picture, between: tones(picture, tone, contrast=contrast, between=between),
    )  # fmt: skip


def save_network_video(
    images: Iterable[NDArray[np.float32]], path: Path, *, fps: float, tone: Tone = Tone.MAPPED
) -> int:
    """Write the pictures of a network as :func:`save_video` does, and return their number."""
    return _save_steady(
        images, path, fps, levels=_network_limits, grey=lambda image, between: _network_tones(image, tone, between)
    )


def _save_steady(
    pictures: Iterable[Any], path: Path, fps: float, *, levels: Callable[[Any], tuple[float, float]],
    grey: Callable[[Any, tuple[float, float]], NDArray[np.float32]],
) -> int:  # fmt: skip
    """Write pictures as video, by functions of a picture's black and white levels, and of its values between them."""

    def frames() -> Iterator[NDArray[np.uint8]]:
        between: tuple[float, float] | None = None
        for picture in pictures:
            dark, bright = levels(picture)
            if between is not None:
                dark = between[0] + LIMITS_UPDATE * (dark - between[0])
                bright = between[1] + LIMITS_UPDATE * (bright - between[1])
            between = (dark, bright)
            yield np.rint(255.0 * grey(picture, between)).astype(np.uint8)

    return save_film(frames(), path, fps=fps)


def check_film(path: Path, *, overwrite: bool = False) -> Any:
    """Return PyAV. Raises :class:`AmiwarpError` without it, and for a file that cannot be a film or be written."""
    check_path(path, FILM_SUFFIXES, overwrite=overwrite)
    return video_library(path)


def save_film(frames: Iterable[NDArray[np.uint8]], path: Path, *, fps: float, overwrite: bool = False) -> int:
    """Write frames as MP4 (H.264), or as GIF if ``path`` ends in .gif, and return the number of frames.

    Each frame has shape (height, width) or (height, width, 3). Raises :class:`AmiwarpError` for no frames, an unknown
    suffix, a folder that does not exist, or without PyAV.
    """
    av = check_film(path, overwrite=overwrite)
    count, kind = 0, path.suffix.lower().removeprefix(".")
    if kind == "gif" and fps > GIF_FPS:
        raise AmiwarpError(
            f"{path}: a GIF has at most {GIF_FPS:g} frames/s that programs show at their speed, not {fps:g}; give "
            "fewer, or write .mp4"
        )
    with (
        _films_are_written(path),
        NewFile(path, overwrite=overwrite) as new,
        av.open(str(new.part), "w", format=kind) as container,
    ):
        stream: Any = None
        for value in map(padded_to_even, frames):
            if stream is None:
                stream = _add_stream(container, fps, value.shape[:2], kind)
            frame = av.VideoFrame.from_ndarray(value, format="gray" if value.ndim == 2 else "rgb24")
            container.mux(stream.encode(frame))
            count += 1
        if stream is None:
            raise AmiwarpError(f"{path}: no picture to write; give at least one frame")
        container.mux(stream.encode())
    return count


@contextlib.contextmanager
def _films_are_written(path: Path) -> Iterator[None]:
    """Turn the errors of PyAV, such as for a picture that is too large, into :class:`AmiwarpError`."""
    from av.error import FFmpegError

    try:
        yield
    except FFmpegError as error:
        raise AmiwarpError(f"{path}: cannot be written as a film: {error.strerror}; try smaller pictures") from error


def _add_stream(container: Any, fps: float, shape: tuple[int, ...], kind: str) -> Any:
    """Add a video stream to a PyAV container and return it."""
    rate = Fraction(fps).limit_denominator(1000)
    stream = container.add_stream("gif" if kind == "gif" else "libx264", rate=rate)
    stream.height, stream.width = shape
    stream.pix_fmt = "rgb8" if kind == "gif" else "yuv420p"
    if kind != "gif":
        stream.options = {"crf": "16", "preset": "fast"}
    return stream


def padded_to_even(value: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repeat the last row or column of an image with an odd height or width, because the codec requires even sizes."""
    rows, columns = value.shape[:2]
    return np.pad(value, ((0, rows % 2), (0, columns % 2), *[(0, 0)] * (value.ndim - 2)), mode="edge")
