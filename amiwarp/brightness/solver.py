"""The scene's log brightness from pairs of events: sparse, matrix-free least squares on the device.

An event states that the log brightness at its pixel changed by one threshold since the last event of that pixel. With L
the map on the prism-free pixel grid and w(x, θ) the compensated coordinates, L(w(x, θ₂)) − L(w(x, θ₁)) = ±C: linear in
L. L is in units of the ON threshold. See ``docs/explanation/photometric.md``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice, pairwise
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.events.device_events import DeviceEvents, check_sensor, join, time_span
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.kernels import conjugate_gradients as cg
from amiwarp.kernels import equations as eqs
from amiwarp.kernels import equations_cpu, equations_cuda, multilevel
from amiwarp.kernels import pairs as pair_kernels
from amiwarp.kernels import slow_pixels as slow_kernels
from amiwarp.kernels.camera import pinhole_params
from amiwarp.kernels.launch import BLOCK_DIM, SMALLEST_SLICE, Program, RepeatedLaunches, launch, slice_count, start_read
from amiwarp.kernels.map_positions import find_places, place_blocks, place_pairs, place_still
from amiwarp.kernels.prism_angle import encoder_params
from amiwarp.optics.camera import CameraRotation
from amiwarp.optics.models import Model, model_camera
from amiwarp.validation import guarded

# Pairs of consecutive events of a pixel, whose equations the map solves, and their positions.
#
# Pairs are built on the device in three steps: sort the events by pixel, mark candidates for pairs, write the marked
# pairs.

SAMPLED_TIMES = 1 << 15
"""Number of pairs whose times give the statistics of all."""


@guarded
@dataclass(frozen=True, slots=True)
class SensorTiming:
    """Known timing of the sensor [us]; 0 for unknown values.

    Examples
    --------
    >>> amiwarp.SensorTiming(latency_us=100.0)
    SensorTiming(latency_us=100.0, refractory_us=0.0)
    """

    latency_us: float = 0.0
    """Time from a brightness change at the pixel to the time stamp of its event [us]."""
    refractory_us: float = 0.0
    """Refractory period: time after an event until the pixel takes its new reference [us]."""


@dataclass(frozen=True, eq=False)
class PairSet:
    """Pairs on a device. Each is two events of a pixel, or one event and the start or end of the time window."""

    arrays: Any
    """Columns of the pairs: the kernels' struct ``Pairs``."""
    device: Any
    of_two_events: int | None = None
    """Number of pairs of two events, which come first; None if it was not counted."""

    def __len__(self) -> int:
        return int(self.arrays.count)

    def set_path(self, factors: NDArray[np.float64]) -> None:
        """Set how the scene of each tile of a rotating camera moves in the image; see :meth:`path_array`."""
        self.arrays.path = self.path_array(factors)

    def path_array(self, factors: NDArray[np.float64]) -> Any:
        """Return the paths of the tiles on the device.

        ``factors`` are those of t, t², … along x and y [px/s, px/s², …], shape (tiles, 2, ``PATH_TERMS``), with the
        time t of an event [s].
        """
        return wp.array(factors.ravel().astype(np.float32), dtype=float, device=self.device)

    def column(self, name: str) -> NDArray[Any]:
        """Return the column ``x``, ``y``, ``tile`` or ``on`` of the pairs as a NumPy array, shape (n,)."""
        values: NDArray[Any] = getattr(self.arrays, name).numpy()
        return values[: len(self)]

    @property
    def time(self) -> NDArray[np.float32]:
        """First and second time of each pair [s], relative to the window's middle, shape (2, n)."""
        values: NDArray[np.float32] = self.arrays.time.numpy()
        return values.reshape(2, -1)[:, : len(self)]

    @cached_property
    def some_times(self) -> NDArray[np.float64]:
        """Times of some pairs, evenly chosen [s], shape (2, m).

        At least :data:`SAMPLED` pairs are chosen; all, if there are fewer.
        """
        every = max(1, len(self) // SAMPLED_TIMES)
        values: NDArray[np.float32] = self.arrays.time.reshape((2, -1))[:, : len(self) : every].numpy()
        return values.astype(np.float64)

    def split_by_time(self) -> tuple[Any, Any]:
        """Return each pair's mean time, in standard deviations from that of all, and 1 if its gap is long, else 0.

        Both are on the device. A gap is long if it is longer than the median. The statistics are those of
        :attr:`some_times`.
        """
        first, second = self.some_times
        middle = 0.5 * (first + second)
        late, long = (wp.empty(self.arrays.stride, dtype=float, device=self.device) for _ in "ll")
        spread = max(float(middle.std()), 1e-9)
        gap, rank = second - first, (len(first) - 1) // 2
        inputs = [self.arrays, float(middle.mean()), spread, float(np.partition(gap, rank)[rank])]
        launch(eqs.split_by_time, len(self), inputs, [late, long], device=self.device)
        return late, long

    def angle_patterns(self, middle: tuple[float, float]) -> Any:
        """Return patterns of errors of the prism's angle at the ends of each pair, one in each row, on the device.

        They are cosine and sine of the encoder's angle and of twice the angle, and the distance of the pixel from
        ``middle`` along x and y [px]. The shape is (6, 2 · padded pairs), that of the pairs' slopes in each row.
        """
        out = wp.zeros((6, 2 * self.arrays.stride), dtype=float, device=self.device)
        launch(eqs.angle_patterns, len(self), [self.arrays, *map(float, middle)], [out], device=self.device)
        return out

    def with_slope(self, slope_of: Callable[[NDArray[np.int64]], NDArray[np.float64]], middle_us: int) -> PairSet:
        """Attach to each pair the change of its prism angles per unit of a drifting parameter, and return the set.

        ``slope_of`` returns the change of the angle at given times [us].
        """
        values = np.zeros((2, self.arrays.stride), np.float32)
        for k, t in enumerate(self.time.astype(np.float64)):
            values[k, : len(self)] = slope_of(np.rint(t * 1e6).astype(np.int64) + middle_us)
        self.arrays.slope = wp.array(values.ravel(), dtype=float, device=self.device)
        return self

    def clear_lags(self) -> None:
        """Set the lags of slow pixels to none. The first call allocates them; maps must be made afterwards."""
        arrays = self.arrays
        if not len(arrays.lag):
            arrays.lag = wp.zeros(4 * arrays.stride, dtype=float, device=self.device)
            arrays.offset = wp.zeros(arrays.stride, dtype=float, device=self.device)
        none = np.zeros((4, arrays.stride), np.float32)
        none[0::2] = 1.0
        arrays.lag.assign(none.ravel())
        arrays.offset.zero_()

    def drop_lags(self) -> None:
        """Undo :meth:`clear_lags`, for the maps that were made before."""
        self.arrays.lag = self.arrays.offset = wp.empty(0, dtype=float, device=self.device)

    @classmethod
    def concatenate(cls, parts: Sequence[PairSet]) -> PairSet:
        """Join pair sets, in which equations from silence must have the same weight."""
        if len(parts) == 1:
            return parts[0]
        first = parts[0].arrays
        drifts = any(part.arrays.slope.shape[0] for part in parts)
        out = _empty(sum(map(len, parts)), parts[0].device, weak=first.weak, drifts=drifts)
        at = 0
        for part in parts:
            launch(pair_kernels.append, len(part), [part.arrays, at], [out], device=part.device)
            at += len(part)
        return cls(out, parts[0].device)

    def of_tiles(self, listed: NDArray[np.bool_]) -> PairSet:
        """Return the pairs on tiles whose value in ``listed`` is true, shape (tiles,)."""
        numbers = wp.array(listed.astype(np.int32), dtype=int, device=self.device)
        return self._select(pair_kernels.mark_listed, [self.arrays.tile, numbers])

    def of_square(self, left: int, top: int, side: int) -> PairSet:
        """Return the pairs of the pixels in a square of ``side`` px with corner (``left``, ``top``)."""
        return self._select(pair_kernels.mark_square, [self.arrays, left, top, side])

    def on_tiles(self, model: Model, camera_rotation: CameraRotation, drift: float, tile_of: Any) -> PairSet:
        """Return the pairs whose compensated events both fall on the same tile.

        ``tile_of`` gives the tile of each pixel of the map, or -1, on the device.
        """
        places = wp.empty(len(self), dtype=wp.vec4, device=self.device)
        inputs = [
            model.params(self.device),
            pinhole_params(model.camera) or model_camera(model, self.device),
            self.arrays,
            drift,
            camera_rotation.params(),
        ]
        launch(find_places, len(self), inputs, [places], device=self.device)
        return self._select(pair_kernels.mark_same_tile, [places, tile_of], [self.arrays.tile])

    def hold_out(self, every: int) -> int:
        """Mark every ``every``-th pair of two events as held out, so that it is not fitted; return the number held out.

        Pairs of two events must come first in the set.
        """
        launch(pair_kernels.hold_out, len(self), [every], [self.arrays.on], device=self.device)
        return int(np.count_nonzero(self.column("on") & int(eqs.HELD)))

    def _select(self, kernel: Any, inputs: list[Any], outputs: Sequence[Any] = ()) -> PairSet:
        """Return the pairs that a kernel marks."""
        flag = wp.empty(len(self), dtype=int, device=self.device)
        launch(kernel, len(self), inputs, [*outputs, flag], device=self.device)
        place, count = _running_count(flag)
        out = _empty(count, self.device, drifts=self.arrays.slope.shape[0] > 0)
        launch(pair_kernels.select, len(self), [self.arrays, flag, place], [out], device=self.device)
        return PairSet(out, self.device)


class EventTable:
    """Events of one or more time spans on a device, sorted by pixel."""

    def __init__(
        self,
        spans: Sequence[Events | DeviceEvents],
        tile_of: Any,
        device: Any,
        *,
        joined: DeviceEvents | None = None,
    ) -> None:
        """Copy the events of the time spans to the device, without sorting them; a single span on it is not copied.

        ``joined`` gives the events of all spans, if they are on the device already. Only pixels with ``tile_of`` >= 0
        are used: shape (height, width), NumPy or on the device.
        """
        self.device = wp.get_device(device)
        if isinstance(tile_of, np.ndarray):
            tile_of = wp.array(tile_of, dtype=int, device=device)
        self.tile_of, self.spans = tile_of, [span for span in spans if len(span)]
        for span in [joined] if joined else self.spans:
            check_sensor(span)
        self.arrays = pair_kernels.Sorted()
        self.arrays.columns = tile_of.shape[1]
        self.arrays.pixels = tile_of.shape[0] * tile_of.shape[1]
        side = int(pair_kernels.SQUARE)
        self.arrays.places = math.prod(-(-n // side) * side for n in tile_of.shape)
        for name, dtype in (("x", wp.uint16), ("y", wp.uint16), ("t", wp.int64), ("p", wp.uint8)):
            parts = [getattr(span, name) for span in ([joined] if joined else self.spans)]
            setattr(self.arrays, name, _upload(parts, dtype, self.device))
        self.arrays.count = 0

    @property
    def covers(self) -> tuple[int, int]:
        """Times of the first and the last event [us]."""
        ends = [time_span(span) for span in self.spans]
        return min(first for first, _ in ends), max(last for _, last in ends)

    def sort(self) -> None:
        """Sort the events by time span and pixel; within a pixel, events stay in time order."""
        s, n = self.arrays, len(self.arrays.x)
        flag = wp.empty(n, dtype=int, device=self.device)
        launch(pair_kernels.mark_inside, n, [s.x, s.y, self.tile_of], [flag], device=self.device)
        place, s.count = _running_count(flag)
        s.key, s.order = (wp.empty(2 * s.count, dtype=int, device=self.device) for _ in "ko")
        first = np.cumsum([0, *(len(span) for span in self.spans[:-1])])
        inputs = [s.x, s.y, self.tile_of, place, wp.array(first, dtype=int, device=self.device), s.places]
        launch(pair_kernels.fill_keys, n, inputs, [s.key, s.order], device=self.device)
        if s.count:
            bits = (s.places * max(1, len(self.spans))).bit_length()
            wp.utils.radix_sort_pairs(s.key, s.order, s.count, end_bit=bits)

    def pairs(
        self,
        encoder: Encoder,
        *,
        longest_gap_us: int,
        shortest_gap_us: float = 0.0,
        sensor: SensorTiming | None = None,
        middle_us: int = 0,
        weak: float = 0.0,
        window: tuple[int, int] | None = None,
        quiet: tuple[NDArray[np.int64], int] | None = None,
    ) -> PairSet:
        """Return pairs of consecutive events of each pixel.

        Their gap is at most ``longest_gap_us`` and more than ``shortest_gap_us``. With a ``window`` (start, stop) [us],
        pairs of open ends and of silence are added, with weight ``weak``:

        - Open ends: from the window's start to each pixel's first event, and from its last event to the stop. At the
          start, the brightness is anywhere within one threshold of the reference, so on average the first event finds
          it one threshold further. After the last event, it stays within one threshold. Without the pairs at the start,
          every edge that enters would look lower than when it leaves, and the map would slope.
        - Silence: ``quiet`` gives the increasing boundaries of time spans [us], and a number n. Used are runs of at
          least n successive spans in which a pixel does not fire. Silence is information: along the pixel's path, the
          brightness changed by no more than about one threshold.
        """
        self.sort()
        sensor = sensor or SensorTiming()
        times = pair_kernels.Window()
        times.start, times.stop = window or (0, 0)
        times.middle, times.longest, times.shortest = middle_us, longest_gap_us, shortest_gap_us
        times.late_first, times.late_second = sensor.refractory_us - sensor.latency_us, -sensor.latency_us
        m, device = self.arrays.count, self.device
        kinds = 1 if window is None else 3
        ends, base = (0, m) if window is None else (m, kinds * m)
        edges, at_least = (np.zeros(1, np.int64), 0) if quiet is None else quiet
        spans = (len(edges) - 1) * self.arrays.places
        flag = wp.empty(base + spans, dtype=int, device=device)
        launch(pair_kernels.mark_pairs, m, [self.arrays, times], [flag], device=device)
        launch(pair_kernels.mark_ends, ends, [self.arrays], [flag], device=device)
        if spans:
            edges_d = wp.array(edges, dtype=wp.int64, device=device)
            self._mark_quiet(edges_d, at_least, base, flag)
        place, count = _running_count(flag)
        of_two_events = count if len(flag) == m else int(place[m - 1 : m].numpy()[0]) if m else 0
        out = _empty(count, device, weak=weak)
        if not count:
            return PairSet(out, device, 0)
        span = self.covers if window is None else (min(self.covers[0], window[0]), max(self.covers[1], window[1]))
        angles = encoder_params(encoder, *span, device)
        launch(
            pair_kernels.write_pairs,
            m,
            [self.arrays, times, angles, self.tile_of, flag, place, kinds],
            [out],
            device=device,
        )
        if spans:
            of_spans = _empty(len(edges) - 1, device)
            launch(pair_kernels.write_spans, len(edges) - 1, [edges_d, times, angles], [of_spans], device=device)
            inputs = [of_spans, self.tile_of, base, flag, place]
            launch(pair_kernels.write_quiet, spans, inputs, [out], device=device)
        return PairSet(out, device, of_two_events)

    def _mark_quiet(self, edges: Any, at_least: int, base: int, flag: Any) -> None:
        """Mark the time spans in which pixels are silent."""
        fired = wp.zeros((len(edges) - 1) * self.arrays.pixels, dtype=wp.uint8, device=self.device)
        launch(pair_kernels.mark_spans, len(self.arrays.x), [self.arrays, edges], [fired], device=self.device)
        inputs = [fired, self.tile_of, at_least, base]
        launch(pair_kernels.mark_quiet, self.arrays.places, inputs, [flag], device=self.device)

    def exclude_hot_pixels(self) -> NDArray[np.int32]:
        """Exclude pixels that fire far more often than the busiest pixels around them, by setting ``tile_of`` to -1.

        Returns the number of events of each pixel, shape (height, width).
        """
        rows, columns = self.tile_of.shape
        count = wp.zeros(rows * columns, dtype=int, device=self.device)
        n = len(self.arrays.x)
        launch(
            pair_kernels.count_pixels, n, [self.arrays], [count], device=self.device, smallest=n + 1
        )  # one CPU thread only: several would add to the same counters
        launch(pair_kernels.mark_hot, rows * columns, [count.reshape((rows, columns)), 0], [self.tile_of.flatten()],
               device=self.device)  # fmt: skip
        counts: NDArray[np.int32] = count.numpy().reshape(rows, columns)
        return counts


def off_excess(pairs: PairSet, *, with_leak: bool = False) -> float:
    """Return the ratio of the OFF to the ON threshold, minus 1, from the numbers of ON and OFF pairs.

    A solution for the ratio would be biased, because damping shrinks it together with the map. Over a whole turn,
    brightness returns to its start. So ON steps and OFF steps sum to zero, or, ``with_leak``, to the leakage: places
    with many and places with few events then separate ratio and leak.
    """
    on = pairs.column("on") == 1
    if not with_leak:
        count = int(on.sum())
        return count / max(1, len(pairs) - count) - 1.0
    cell = (pairs.column("y") // 8).astype(np.int64) * (1 << 13) + pairs.column("x") // 8
    _, index = np.unique(cell, return_inverse=True)
    ons, offs = np.bincount(index, weights=on), np.bincount(index, weights=~on)
    first, second = pairs.time.astype(np.float64)
    time = np.bincount(index, weights=second - first)
    columns = np.stack([offs, time], axis=1) / np.sqrt(ons + offs)[:, None]
    found = np.linalg.lstsq(columns, ons / np.sqrt(ons + offs), rcond=None)[0]
    return float(found[0]) - 1.0


def _upload(parts: Sequence[NDArray[Any] | wp.array], dtype: Any, device: Any) -> Any:
    """Return the values of arrays as one array on a device. NumPy arrays are joined first: many copies take longer."""
    if not parts:
        return wp.empty(0, dtype=dtype, device=device)
    if isinstance(parts[0], wp.array):
        return join(parts).to(device)
    values = parts[0] if len(parts) == 1 else np.concatenate(parts)
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device, copy=False)


def _running_count(flag: Any) -> tuple[Any, int]:
    """Return the running count of the marked entries, and their total."""
    place = wp.empty_like(flag)
    if not len(flag):
        return place, 0
    wp.utils.array_scan(flag, place, inclusive=True)
    return place, int(place[-1:].numpy()[0])


def _empty(count: int, device: Any, *, weak: float = 0.0, drifts: bool = False) -> Any:
    """Return a set of ``count`` pairs to be filled, whose arrays are padded to whole blocks.

    The padding is zero on a CPU, whose kernels process whole blocks. It is undefined on CUDA, where no kernel reads it.
    Columns of one type share an array, because allocating is slow on CUDA.
    """
    out = eqs.Pairs()
    block = int(equations_cpu.BLOCK)
    n = out.stride = max(1, -(-count // block)) * block
    out.count, out.weak = count, weak
    pixels, flags = wp.empty(2 * n, dtype=wp.uint16, device=device), wp.empty(n, dtype=wp.uint8, device=device)
    values = wp.empty((9 if drifts else 7) * n, dtype=float, device=device)
    nothing = wp.empty(0, dtype=float, device=device)
    out.x, out.y, out.on = pixels[:n], pixels[n:], flags
    out.tile, out.time, out.azimuth = values[:n].view(int), values[n : 3 * n], values[3 * n : 7 * n]
    out.slope = values[7 * n :] if drifts else nothing
    out.lag = out.offset = out.path = nothing
    if pixels.device.is_cpu:
        for array in (pixels, flags, values):
            array.numpy().reshape(-1, n)[:, count:] = 0
    return out


# Chains of event pairs on a CPU: positions that successive pairs share are stored once.

FEW_BLOCKS = 256
"""Smallest number of blocks of pairs for which a second CPU thread is used."""


class PairChains:
    """Positions of pairs on a map in chains, and sums over the pairs' weighted equations on a CPU.

    The sums have a slice for each thread.
    """

    kernels = equations_cpu
    """Kernels over all equations."""

    def __init__(self, pairs: PairSet, atlas: Any, geometry: Any) -> None:
        """Allocate the arrays for ``pairs`` on the map of ``atlas``, whose positions ``geometry`` will hold."""
        self._pairs, self._atlas, self._geometry = pairs.arrays, atlas, geometry
        stride, device = pairs.arrays.stride, pairs.device
        self.threads = stride // int(equations_cpu.BLOCK)
        """Number of threads of the kernels, each for a block of pairs."""
        self.arrays = equations_cpu.Chains()
        """Columns of the positions: the kernels' struct ``Chains``."""
        for name, dtype in (("cell", int), ("x", float), ("y", float), ("weight", float)):
            setattr(self.arrays, name, wp.empty(2 * stride, dtype=dtype, device=device))
        self.arrays.count = wp.empty(self.threads, dtype=int, device=device)
        self.arrays.end = wp.empty(stride, dtype=wp.uint8, device=device)

    def take_positions(self) -> None:
        """Take the present positions, and join pairs that begin where the pair before them ends."""
        inputs = [self._geometry.cell, self._geometry.part, self._geometry.stride]
        launch(equations_cpu.make_chains, self.threads, inputs, [self.arrays], device="cpu", smallest=FEW_BLOCKS)

    @property
    def inputs(self) -> list[Any]:
        """First inputs of the kernels that compute a value for each equation."""
        return [self._pairs, self._atlas, self._geometry, self.arrays]

    def add_product(self, program: Any, weight: Any, vector: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W A vector, for equations A with weights W."""
        inputs = [self._pairs, self._atlas, self.arrays, weight, vector]
        program.add_slices(equations_cpu.apply_normal, self.threads, inputs, slices, smallest=FEW_BLOCKS)

    def add_transpose(self, program: Any, weight: Any, residual: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W residual."""
        inputs = [self._pairs, self._atlas, self.arrays, weight, residual]
        program.add_slices(equations_cpu.apply_transpose, self.threads, inputs, slices, smallest=FEW_BLOCKS)

    def add_diagonal(self, program: Any, weight: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += diag(Aᵀ W A). Later products must have the same weights."""
        program.add(equations_cpu.weigh_chains, self.threads, [weight], [self.arrays], smallest=FEW_BLOCKS)
        inputs = [self._pairs, self._atlas, self.arrays, weight]
        program.add_slices(equations_cpu.add_diagonal, self.threads, inputs, slices, smallest=FEW_BLOCKS)


# Ends of event pairs on CUDA in the order of the map, so that neighbouring threads add to the same nodes.


class PairEnds:
    """Positions of both ends of pairs in the order of the map, and sums over the pairs' weighted equations on CUDA.

    Its methods are those of :class:`amiwarp.brightness.solver.PairChains`.
    """

    kernels = equations_cuda
    """Kernels over all equations."""

    def __init__(self, pairs: PairSet, atlas: Any, geometry: Any) -> None:
        """Allocate the arrays for ``pairs`` on the map of ``atlas``, whose positions ``geometry`` will hold."""
        self._pairs, self._atlas, self._geometry = pairs.arrays, atlas, geometry
        self._nodes = int(atlas.rows * atlas.columns * (atlas.origin.size // 2))
        self.threads, stride = len(pairs), pairs.arrays.stride
        """Number of threads of the kernels, each for a pair."""
        self._device, self._launch = pairs.device, RepeatedLaunches(pairs.device)
        self.arrays = equations_cuda.Ends()
        """Columns of the ends: the kernels' struct ``Ends``."""
        self.arrays.part = wp.empty(2 * stride, dtype=wp.vec2, device=self._device)
        self.arrays.order, self.arrays.cell = (wp.empty(4 * stride, dtype=int, device=self._device) for _ in "oc")
        self._flow = wp.empty(stride, dtype=float, device=self._device)
        self._ends, self._end_inputs = 2 * stride, [self.arrays, stride, atlas.columns]

    def take_positions(self) -> None:
        """Take the present positions, and sort them."""
        ends, nodes = self._ends, self._nodes
        inputs, outputs = [self._geometry, self.threads, nodes], [self.arrays.cell, self.arrays.order]
        self._launch(equations_cuda.list_ends, ends, inputs, outputs)
        wp.utils.radix_sort_pairs(*outputs, ends, end_bit=nodes.bit_length())
        self._launch(equations_cuda.take_fractions, ends, [self._geometry], [self.arrays])

    @property
    def inputs(self) -> list[Any]:
        """First inputs of the kernels that compute a value for each equation."""
        return [self._pairs, self._atlas, self._geometry]

    def add_product(self, program: Any, weight: Any, vector: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W A vector, for equations A with weights W."""
        program.add(equations_cuda.find_flows, self.threads, [*self.inputs, weight, vector], [self._flow, *slices])
        program.add(equations_cuda.add_ends, self._ends, [*self._end_inputs, self._flow, 0], slices)

    def add_transpose(self, program: Any, weight: Any, residual: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W residual."""
        inputs = [self._pairs, self._atlas, weight, residual]
        program.add(equations_cuda.weigh_residuals, self.threads, inputs, [self._flow, *slices])
        program.add(equations_cuda.add_ends, self._ends, [*self._end_inputs, self._flow, 0], slices)

    def add_diagonal(self, program: Any, weight: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += diag(Aᵀ W A)."""
        if self._atlas.with_leak or self._atlas.with_off:
            inputs = [self._pairs, self._atlas, weight]
            program.add(equations_cuda.add_sensor_diagonal, self.threads, inputs, slices)
        program.add(equations_cuda.add_ends, self._ends, [*self._end_inputs, weight, 1], slices)


# Positions of event pairs on the brightness map, for a model and a rotation of the camera.


class PairPositions:
    """Positions of ``pairs`` on the map of ``atlas``, the kernels' struct. Owns its buffers."""

    def __init__(self, pairs: PairSet, atlas: Any, middle_us: int) -> None:
        """Allocate the buffers. ``middle_us`` is the time to which the times of the pairs are relative [us]."""
        self.pairs, self.device, self._atlas, self._middle_us = pairs, wp.get_device(pairs.device), atlas, middle_us
        self.geometry = self._new_geometry()
        """Positions: the kernels' struct ``Geometry``."""
        self.equations = (PairChains if self.device.is_cpu else PairEnds)(pairs, atlas, self.geometry)
        """Equations of the pairs at these positions."""
        self._nothing = wp.empty(0, dtype=float, device=self.device)
        self._still = CameraRotation(middle_us=middle_us)
        self._launch = RepeatedLaunches(self.device)

    def _new_geometry(self) -> Any:
        g = eqs.Geometry()
        g.stride = self.pairs.arrays.stride
        g.cell = wp.empty(2 * g.stride, dtype=int, device=self.device)
        g.part = wp.empty(4 * g.stride, dtype=float, device=self.device)
        return g

    def place(
        self, model: Model, drift: float, camera_rotation: CameraRotation | None, out: Any, image: Any = None,
        path: Any = None,
    ) -> None:  # fmt: skip
        """Compute the positions into ``out``. A ``path`` replaces that of the pairs.

        With the map ``image``, on a CPU and if :meth:`_in_blocks`, ``out`` gets the changes of brightness instead.
        """
        arrays, turn = self.pairs.arrays, self._turn(camera_rotation)
        if path is not None:
            present, arrays.path = arrays.path, path
            self.place(model, drift, camera_rotation, out, image)
            arrays.path = present
            return
        n = arrays.stride if self.device.is_cpu else arrays.count  # CPU kernels also read the padding
        if not self._in_blocks(model, turn):
            inputs = [model.params(self.device), model_camera(model, self.device), arrays, self._atlas]
            self._launch(place_pairs, n, [*inputs, drift, turn.params()], [out])
            return
        inputs = [model.params(self.device), pinhole_params(model.camera), arrays, self._atlas]
        if not self.device.is_cpu:
            self._launch(place_still, n, inputs, [out])
            return
        inputs += [drift, turn.params(), self._nothing if image is None else image]
        outputs = [out, self._nothing] if image is None else [self.geometry, out]
        self._launch(place_blocks, self.equations.threads, inputs, outputs, smallest=FEW_BLOCKS)

    def _turn(self, camera_rotation: CameraRotation | None) -> CameraRotation:
        return (
            self._still
            if camera_rotation is None or not camera_rotation.moves
            else camera_rotation.about(self._middle_us)
        )

    def _in_blocks(self, model: Model, turn: CameraRotation) -> bool:
        """Return whether the fast kernels apply: no distortion, no slow pixels, and on CUDA only the prism moves."""
        arrays = self.pairs.arrays
        moves = arrays.slope.shape[0] > 0 or turn.moves
        return model.camera.distortion is None and not arrays.lag.shape[0] and (self.device.is_cpu or not moves)

    @cached_property
    def _sides(self) -> tuple[Any, Any]:
        """Buffers for the positions at two more parameter values, for finite differences."""
        return self._new_geometry(), self._new_geometry()

    @cached_property
    def _changes(self) -> tuple[Any, Any]:
        """Buffers for the changes of brightness at two parameter values, for finite differences."""
        plus, minus = (wp.empty(self.geometry.stride, dtype=float, device=self.device) for _ in "+-")
        return plus, minus

    def find_slope(self, plus: dict[str, Any], minus: dict[str, Any], width: float, image: Any) -> Any:
        """Return the derivative of the residuals for the map ``image``; see :meth:`BrightnessMap.find_slope`."""
        both = (plus, minus)
        out = wp.empty(self.pairs.arrays.stride, dtype=float, device=self.device)
        if self.device.is_cpu and all(self._in_blocks(at["model"], self._turn(at["camera_rotation"])) for at in both):
            for change, at in zip(self._changes, both, strict=True):
                self.place(**at, out=change, image=image)
            self._launch(eqs.slope_of_changes, len(self.pairs), [*self._changes, width], [out])
            return out
        for side, at in zip(self._sides, both, strict=True):
            self.place(**at, out=side)
        inputs = [self.pairs.arrays, self._atlas, *self._sides, image, width]
        self._launch(eqs.slope_between, len(self.pairs), inputs, [out])
        return out

    def keep(self, nodes: wp.array) -> None:
        """Exclude pairs of two events that are off the ``nodes``; see :meth:`BrightnessMap.keep`."""
        inputs = [nodes, self.pairs.arrays.on, self.geometry.stride]
        self._launch(pair_kernels.keep_nodes, len(self.pairs), inputs, [self.geometry.cell])
        self.equations.take_positions()


_Step = tuple[Any, int, list[Any], list[Any], int]  # kernel, number of threads, inputs, outputs, smallest slice


# Multigrid preconditioner for large maps.
#
# Corrections are computed on coarser and coarser grids, which transport brightness far across the map.

COARSEST = 6
"""Smallest number of rows or columns of a grid; coarser grids are not made."""
STRIDES = (3, 5, 11, 23)
"""Every how many pairs one is used to estimate the diagonal of the first grid, the second, the third, and the further
ones. They have no common divisor with the usual numbers of pairs per silent pixel. With fewer pairs, more steps are
needed."""
SMALL = 2048
"""Largest number of nodes of a grid that a single block of threads processes on CUDA, with all coarser grids."""


class GridHierarchy:
    """Grids over one tile of (rows, columns) map nodes. Each grid has twice the node spacing of the previous grid."""

    def __init__(self, rows: int, columns: int, device: Any) -> None:
        """Allocate the grids over a tile of ``rows`` × ``columns`` nodes."""
        self.shapes = [(rows, columns)]
        while min(self.shapes[-1]) // 2 + 1 >= COARSEST:
            self.shapes.append((self.shapes[-1][0] // 2 + 1, self.shapes[-1][1] // 2 + 1))
        sizes = [r * c for r, c in self.shapes[1:]]
        self._first = [sum(sizes[:k]) for k in range(len(sizes) + 1)]
        self._all = [wp.zeros(sum(sizes), dtype=float, device=device) for _ in range(3)]
        self._diagonal, self._residual, self._correction = (
            [one[a:b] for a, b in pairwise(self._first)] for one in self._all
        )

    def prepare(self, program: Any, equations: list[Any], count: int, sums: Any, slices: list[Any]) -> None:
        """Add to ``program`` the computation of the grids' diagonals for the current weights of the equations."""
        for level, diagonal in enumerate(self._diagonal, start=1):
            stride = STRIDES[min(level, len(STRIDES)) - 1]
            inputs = [*equations, float(2**level), self.shapes[level][1], stride]
            program.add_slices(multilevel.add_coarse_diagonal, count // stride, inputs, slices)
            program.add(cg.gather, len(diagonal), [sums], [diagonal])

    def correct(self, program: Any, diagonal: Any, prior: Any, residual: Any, out: Any) -> None:
        """Add to ``program`` the step ``out`` = sum of the grids' corrections for the finest grid's ``residual``."""
        if not self._correction:
            program.add(multilevel.divide, len(out), [diagonal, residual], [out])
            return
        steps = self._steps_by_rows if program.device.is_cpu else self._steps_by_nodes
        for kernel, n, inputs, outputs, smallest in steps(diagonal, prior, residual, out):
            program.add(kernel, n, inputs, outputs, smallest=smallest)

    def _restrictions(self, residual: Any, prior: Any) -> Iterator[tuple[list[Any], list[Any]]]:
        """Yield inputs and outputs of the restriction to each grid but the finest."""
        fines = [residual, *self._residual]
        for level, (fine, *outputs) in enumerate(zip(fines, self._residual, self._correction, strict=False)):
            yield [fine, *self.shapes[level], self._diagonal[level], prior, 4.0 ** (level + 1)], outputs

    def _steps_by_rows(self, diagonal: Any, prior: Any, residual: Any, out: Any) -> Iterator[_Step]:
        """Yield the launches of :meth:`correct` with a row of nodes per thread."""
        grids = zip(self.shapes[1:], self._restrictions(residual, prior), strict=True)
        for (rows, columns), (inputs, outputs) in grids:
            yield multilevel.restrict_rows, rows, inputs, outputs, SMALLEST_SLICE // (4 * columns) + 1
        for level in range(len(self._correction) - 1, -1, -1):
            rows, columns = self.shapes[level]
            inputs, smallest = [self._correction[level], self.shapes[level + 1][1]], SMALLEST_SLICE // columns + 1
            if level:
                outputs = [self._correction[level - 1]]
                yield multilevel.prolong_rows, rows, [*inputs, columns], outputs, smallest
            else:
                inputs += [rows, columns, diagonal, residual]
                yield multilevel.prolong_rows_to_finest, rows, inputs, [out], smallest

    def _steps_by_nodes(self, diagonal: Any, prior: Any, residual: Any, out: Any) -> Iterator[_Step]:
        """Yield the launches of :meth:`correct` with a node per thread, and the small grids in one block of threads."""
        small = sum(rows * columns <= SMALL for rows, columns in self.shapes[2:])
        large = len(self._correction) - small
        for inputs, outputs in islice(self._restrictions(residual, prior), large):
            yield multilevel.restrict, len(outputs[0]), inputs, outputs, SMALLEST_SLICE
        if small:
            all_diagonals, *outputs = self._all
            inputs = [*self.shapes[large], self._first[large - 1], small, all_diagonals, prior, 4.0**large]
            yield multilevel.correct_small, BLOCK_DIM, inputs, outputs, SMALLEST_SLICE
        for level in range(large if small else large - 1, 0, -1):
            rows, columns = self.shapes[level]
            inputs, outputs = [self._correction[level], rows, columns], [self._correction[level - 1]]
            yield multilevel.prolong, rows * columns, inputs, outputs, SMALLEST_SLICE
        inputs = [self._correction[0], *self.shapes[0], diagonal, residual]
        yield multilevel.prolong_to_finest, len(out), inputs, [out], SMALLEST_SLICE


# Tiles of the brightness map.


@dataclass(frozen=True, slots=True)
class Tiles:
    """Rectangular parts of the map, all of the same size, with nodes ``1 / density`` px apart."""

    origin: NDArray[np.float32]
    """Pixel coordinates (x, y) of each tile's first node [px], shape (tiles, 2)."""
    rows: int
    """Number of rows of nodes per tile."""
    columns: int
    """Number of columns of nodes per tile."""
    density: float = 2.0
    """Map nodes per pixel along each axis."""

    @property
    def nodes(self) -> int:
        """Total number of map nodes."""
        return len(self.origin) * self.rows * self.columns

    def at_density(self, density: float) -> Tiles:
        """Return tiles of the same place and size with another number of nodes per pixel along each axis."""
        rows, columns = (math.ceil((n - 1) * density / self.density) + 1 for n in (self.rows, self.columns))
        return replace(self, rows=rows, columns=columns, density=density)


# Statistics of the residuals of a map's equations, computed on the device: mean cost, sums, median.

CHUNKS = 8
"""Smallest number of chunks of a vector for which a second CPU thread is used."""
SUM_COPIES = 64
"""Number of copies of each tile's sum on a GPU."""


class Residuals:
    """Residuals of the equations of ``pairs`` [thresholds] and the equations' weights.

    A pair off the map has the residual NaN.
    """

    def __init__(self, pairs: PairSet, tiles: int) -> None:
        self.pairs, self.tiles, self.device, self.count = pairs, tiles, wp.get_device(pairs.device), len(pairs)
        n = pairs.arrays.stride
        self.values, self.weight = (wp.zeros(n, dtype=float, device=self.device) for _ in "vw")
        self._width = int(cg.CPU_WIDTH) if self.device.is_cpu else 1
        self._launch = RepeatedLaunches(self.device)

    def start_mean_cost(self, scale: float, *, missing: float = math.nan, held: bool = False) -> Callable[[], float]:
        """Start to compute the mean Cauchy cost of the residuals, and return a function that waits for it.

        That is log(1 + (r / ``scale``)²) for the residuals r of all pairs or the held-out ones. ``held``: whether only
        held-out pairs count. ``missing``: residual of pairs off the map; NaN excludes these pairs.
        """
        threads, parts = self._sum_shape
        partial = self._doubles(2, parts)
        inputs = [self.values, self.pairs.arrays.on, int(eqs.HELD) * held, self.count, scale, missing, self._width]
        self._launch(eqs.sum_costs, threads, inputs, [partial], smallest=CHUNKS)
        sums = start_read(partial)

        def result() -> float:
            total, number = sums().sum(axis=1)
            return float(total / number) if number else math.nan

        return result

    def start_products(self, factors: list[tuple[Any, Any]]) -> Callable[[], NDArray[np.float64]]:
        """Start to sum a · b · weight over the pairs, for each (a, b) on the device.

        Return a function that waits for the sums.
        """
        threads, parts = self._sum_shape
        partial = self._doubles(len(factors), parts)
        for k, (a, b) in enumerate(factors):
            inputs = [a, b, self.weight, self.count, self._width]
            self._launch(eqs.sum_products, threads, inputs, [partial[k]], smallest=CHUNKS)
        sums = start_read(partial)
        return lambda: np.asarray(sums().sum(axis=1))

    def start_clusters(self, slopes: list[Any]) -> Callable[[], NDArray[np.float64]]:
        """Start to sum slope · weight · residual over clusters of neighbouring pairs.

        Return a function that waits for the sums, shape (slopes, clusters).
        """
        size = self.tiles if self.tiles > 1 else 1 << 20
        rows = []
        for slope in slopes:
            # on a GPU, many threads would wait for each other to add to the few sums of the tiles
            copies = SUM_COPIES if self.device.is_cuda and self.tiles > 1 else 1
            sums = wp.zeros((2, size * copies), dtype=wp.int64, device=self.device)
            inputs = [self.pairs.arrays, self.tiles, copies, slope, self.weight, self.values, 0, sums]
            # one CPU thread only: several would add to the same sums
            wp.launch(eqs.add_clusters, self.count, inputs=inputs, device=self.device)
            # the sums of one tile are too large for page-locked memory
            rows.append(start_read(sums) if self.tiles > 1 else sums.numpy)

        def result() -> NDArray[np.float64]:
            both = [row().reshape(2, size, -1).sum(axis=2) for row in rows]
            return np.array([total[number > 0] / 2.0**32 for total, number in both])

        return result

    def products_by_square(
        self, factors: list[Any], side: int, columns: int, rows: int
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return sums of a · b · weight over the pairs of each square of pixels, for all a and b of ``factors``.

        The factors are on the device. The squares have ``side`` pixels along each axis; there are ``columns`` x
        ``rows`` of them. Those without pairs are left out, and so are pairs for which any factor is NaN. Return the
        sums, shape (squares, factors, factors), and the numbers of the squares, row by row, shape (squares,).
        """
        n, squares = self.count, columns * rows
        values = wp.empty((len(factors), n), dtype=float, device=self.device)
        for k, factor in enumerate(factors):
            wp.copy(values[k], factor, count=n)
        square, order = (wp.empty(2 * n, dtype=int, device=self.device) for _ in "so")
        inputs = [self.pairs.arrays, values, side, columns, squares]
        launch(eqs.find_squares, n, inputs, [square, order], device=self.device)
        wp.utils.radix_sort_pairs(square, order, n, end_bit=squares.bit_length())
        starts = wp.empty(squares + 1, dtype=int, device=self.device)
        launch(eqs.find_starts, squares + 1, [square, n], [starts], device=self.device)
        upper = np.triu_indices(len(factors))
        sums = self._doubles(squares, len(upper[0]))
        inputs = [values, self.weight, order, starts]
        if self.device.is_cpu and len(factors) <= eqs.MOST_ROWS:
            launch(eqs.sum_squares, squares, inputs, [sums], device="cpu", smallest=CHUNKS)
        else:
            lanes = 1 if self.device.is_cpu else 32
            inputs += [*(wp.array(k, dtype=int, device=self.device) for k in upper), lanes]
            launch(eqs.sum_square_products, lanes * sums.size, inputs, [sums], device=self.device, smallest=CHUNKS)
        used = np.flatnonzero(np.diff(starts.numpy()))
        found = np.empty((len(used), len(factors), len(factors)))
        found[:, upper[0], upper[1]] = found[:, upper[1], upper[0]] = sums.numpy()[used]
        return found, used

    def median(self) -> float:
        """Return the median absolute residual; NaN if there is none."""
        return self.start_median(self.count)()

    def start_median(self, n: int) -> Callable[[], float]:
        """Start to compute the median absolute residual of the first ``n`` pairs, NaN if there is none.

        Return a function that waits for it.
        """
        if self.device.is_cpu:
            values = np.abs(self.values.numpy()[:n])
            values = values[np.isfinite(values)]
            found = float(np.median(values)) if len(values) else math.nan
            return lambda: found
        keys, order = (wp.empty(2 * n, dtype=t, device=self.device) for t in (float, int))
        number = wp.zeros(1, dtype=int, device=self.device)
        wp.launch(eqs.magnitudes, n, inputs=[self.values, 0, keys, number], device=self.device)
        wp.utils.radix_sort_pairs(keys, order, n)

        def result() -> float:
            known = int(number.numpy()[0])
            return float(keys[(known - 1) // 2 : known // 2 + 1].numpy().mean()) if known else math.nan

        return result

    @cached_property
    def _sum_shape(self) -> tuple[int, int]:
        """Numbers of threads and of partial sums for a sum over all pairs."""
        if self.device.is_cpu:
            threads = -(-self.count // self._width)
            return threads, threads
        blocks = -(-self.count // BLOCK_DIM)  # block sums need whole blocks
        return blocks * BLOCK_DIM, blocks

    def _doubles(self, *shape: int) -> Any:
        return wp.empty(shape, dtype=wp.float64, device=self.device)


FEW_CHUNKS = 16
"""Smallest number of chunks of the unknowns for which a second CPU thread is used. Fewer take less time than the
hand-over to a thread."""
DAMPING = 0.02
"""Weight of the squared map values relative to the equations. It determines unknowns that no equation does."""
CONTRAST = 6.0
"""Mean square of a map [thresholds²] above which its damping may decrease in inverse proportion: the same picture has
larger values in smaller thresholds, and damping that does not follow them flattens it more."""


@dataclass(frozen=True, slots=True)
class Smoothness:
    """Smoothness prior of the map.

    It extends the map into regions without equations, and suppresses isolated outliers.
    """

    weight: float
    """Weight of the squared difference of neighbouring map nodes; an equation from events has weight 1."""
    edge: float = 0.0
    """Difference of neighbouring nodes above which their link weakens (Charbonnier) [thresholds]; 0: all links have
    equal weight."""


class BrightnessMap:
    """Brightness map for a set of pairs of events, and its solver. Owns its buffers; a solve starts from the last map.

    Repeated launches are recorded once (:class:`amiwarp.kernels.launch.Program`). No values are copied to
    the host between launches.
    """

    def __init__(
        self,
        pairs: PairSet,
        tiles: Tiles,
        *,
        with_leak: bool = False,
        off_excess: float | None = None,
        damping: float = DAMPING,
        smoothness: Smoothness | None = None,
        middle_us: int = 0,
    ) -> None:
        """Allocate the buffers.

        ``off_excess``: OFF threshold over ON threshold, minus 1, if it is known; it is then fixed, not solved for.
        ``middle_us``: reference time of a rotating camera, to which the times of the pairs are relative [us]. Raises
        :class:`AmiwarpError` if there are no pairs.
        """
        if not len(pairs):
            raise AmiwarpError("no pixel fired twice in time, so no brightness can be found; give a longer recording")
        self.device, self.tiles, self.count = wp.get_device(pairs.device), tiles, len(pairs)
        self.pairs, self.middle_us, self.smoothness = pairs, middle_us, smoothness
        self._atlas = eqs.Atlas()
        self._atlas.origin = wp.array(tiles.origin.ravel(), dtype=float, device=self.device)
        self._atlas.rows, self._atlas.columns, self._atlas.density = tiles.rows, tiles.columns, tiles.density
        self._atlas.with_leak, self._atlas.with_off = float(with_leak), int(off_excess is None)
        unknowns = tiles.nodes + int(cg.EXTRA)
        self._image = self._zeros(unknowns)
        self._sums = wp.zeros((slice_count(self.device), unknowns), dtype=wp.int64, device=self.device)
        self._slices = [self._sums[k] for k in range(len(self._sums))]
        self._make_vectors(unknowns)
        self._make_prior(damping, unknowns)
        if off_excess is not None:
            self._prior.held = tiles.nodes + 1  # of the sensor unknowns, the leak comes first
            self._image[-1:].fill_(off_excess)
        self.residuals = Residuals(pairs, len(tiles.origin))
        self._scale, self._solved = self._zeros(1), False
        self._at = PairPositions(pairs, self._atlas, middle_us)
        self._equations, self._launch = self._at.equations, RepeatedLaunches(self.device)

    def _zeros(self, n: int) -> Any:
        return wp.zeros(n, dtype=float, device=self.device)

    def _make_vectors(self, unknowns: int) -> None:
        """Allocate the vectors of the conjugate-gradient method."""
        self._width = cg.CPU_WIDTH if self.device.is_cpu else 1
        self._threads = -(-unknowns // self._width)
        self._u, self._dots = cg.Unknowns(), cg.Dots()
        for name in ("diagonal", "residual", "direction", "product"):
            setattr(self._u, name, self._zeros(unknowns))
        parts = -(-self._threads // (1 if self.device.is_cpu else BLOCK_DIM))
        for name, n in (("scalars", 2), ("pq", parts), ("rz", parts)):
            setattr(self._dots, name, wp.zeros(n, dtype=wp.float64, device=self.device))

    def _make_prior(self, damping: float, unknowns: int) -> None:
        """Set up damping, smoothness, and the multigrid preconditioner of a single tile."""
        linked = self.smoothness is not None
        self._prior = cg.Prior()
        self._prior.columns = self.tiles.columns
        self._prior.damping = wp.full(1, damping, dtype=float, device=self.device)
        self._prior.linked, self._prior.held = int(linked), unknowns
        self._prior.right, self._prior.down = (self._zeros(unknowns * linked) for _ in "xy")
        self._prior.smooth = self._zeros(1)
        if self.smoothness is not None:
            self._prior.smooth.fill_(self.smoothness.weight)
        one = linked and len(self.tiles.origin) == 1
        self._grids = GridHierarchy(self.tiles.rows, self.tiles.columns, self.device) if one else None
        self._z = self._zeros(unknowns * one)

    # -- positions of the pairs

    def place(self, model: Model, *, drift: float = 0.0, camera_rotation: CameraRotation | None = None) -> None:
        """Compute the positions of the pairs on the map, for a model and a camera rotation about ``middle_us``."""
        self._at.place(model, drift, camera_rotation, self._at.geometry)
        self._equations.take_positions()

    def path_arguments(self, model: Model) -> list[Any]:
        """Return the kernel arguments that describe the map and the paths of the pairs' pixels over it."""
        camera = model_camera(model, self.device)
        return [model.params(self.device), camera, self.pairs.arrays, self._atlas, self._image]

    def find_slope(self, plus: dict[str, Any], minus: dict[str, Any], width: float) -> Any:
        """Return the derivative of each pair's residual along a line in parameter space, for a fixed map.

        It is the change of the residual from the parameters ``minus`` to ``plus``, divided by their distance ``width``.
        Both are keyword arguments of :meth:`place`. The positions that :meth:`place` stored remain unchanged.
        """
        return self._at.find_slope(plus, minus, width, self._image)

    def keep(self, nodes: wp.array) -> None:
        """Exclude pairs of two events, as noise, if either event is off the nodes for which ``nodes`` is 1.

        ``nodes`` is uint8, shape (nodes,), on the device.
        """
        self._at.keep(nodes)

    # -- solving

    def solve(self, *scales: float, steps: int, rounds: int = 1) -> None:
        """Solve for the map: for each of ``scales``, ``rounds`` times, set the Cauchy weights and run ``steps`` steps.

        The steps are those of conjugate gradients. A scale is the residual at which an equation gets half weight
        [thresholds]. Afterwards ``residuals`` holds the residual of every pair [thresholds] on the device, NaN for
        pairs off the map.
        """
        for scale in scales:
            self._scale.fill_(scale)
            for _ in range(rounds):
                self._weigh.run()
                self._prepare.run()
                if not self._solved:  # the coarser grids need not follow the weights
                    self._prepare_grids.run()
                self._solved = True
                self._descent.run(steps)
        self._weigh.run()

    def restart(self, smoothness: float) -> None:
        """Set the map to zero and change the weight of the smoothness prior."""
        self.clear()
        self._prior.smooth.fill_(smoothness)

    def clear(self) -> None:
        """Set the map to zero; leak and threshold remain."""
        self._image[: self.tiles.nodes].zero_()

    def relax_damping(self) -> bool:
        """Reduce the damping if the solved map has a large contrast, and return whether it has."""
        parts = len(self._dots.pq)
        partial = wp.empty((2, parts), dtype=wp.float64, device=self.device)
        threads = parts if self.device.is_cpu else parts * BLOCK_DIM  # block sums need whole blocks
        inputs = [self._image[: self.tiles.nodes], self._width]
        self._launch(cg.sum_seen, threads, inputs, [partial], smallest=FEW_CHUNKS)
        squares, number = partial.numpy().sum(axis=1).tolist()
        if squares <= CONTRAST * number:
            return False
        self.set_damping(DAMPING * CONTRAST * number / squares)
        return True

    def set_damping(self, damping: float) -> None:
        """Change the damping; the map remains, and must be solved again."""
        self._prior.damping.fill_(damping)

    def prepare_projection(self) -> None:
        """Prepare :meth:`unexplained` with the weights that the last :meth:`solve` set."""
        self._prepare.run()

    def add(self, change: Any, factor: float) -> None:
        """Add a change of the map times a factor to the map."""
        self._launch(cg.add_multiple, len(change), [change, factor], [self._image])

    def unexplained(self, target: Any, change: Any = None, *, steps: int) -> Any:
        """Return the part of ``target`` (pairs, on the device) that no change of the map explains.

        This is the projection of variable projection (Golub and Pereyra 1973). It is solved by conjugate gradients that
        start from ``change``, or from none.
        """
        wp.copy(self._projection.residual, target)
        if change is None:
            self._projection.image.zero_()
        else:
            wp.copy(self._projection.image, change)
            self._subtract(change, self._projection.residual)
        self._projection.run(steps)
        rest = wp.clone(target)
        self._subtract(self._projection.image, rest)
        return rest

    def explaining_change(self) -> Any:
        """Return a copy of the change of the map that explains the rest of the last target of :meth:`unexplained`."""
        return wp.clone(self._projection.image)

    def _subtract(self, vector: Any, residual: Any) -> None:
        """Subtract the left sides of the equations, for a ``vector`` of unknowns, from ``residual``."""
        equations, inputs = self._equations, [*self._equations.inputs, vector]
        self._launch(equations.kernels.subtract, equations.threads, inputs, [residual], smallest=FEW_BLOCKS)

    @cached_property
    def _weigh(self) -> Any:
        """Program that computes the residuals and the weights of the equations."""
        program = Program(self.device)
        self._add_weigh(program)
        return program

    def _add_weigh(self, program: Any) -> None:
        equations, out = self._equations, [self.residuals.weight, self.residuals.values]
        inputs = [*equations.inputs, self._image, self._scale]
        program.add(equations.kernels.weigh, equations.threads, inputs, out, smallest=FEW_BLOCKS)

    @cached_property
    def _prepare(self) -> Any:
        """Program that computes the smoothness links and the diagonals for the current weights and map."""
        program = Program(self.device)
        if self.smoothness is not None:
            inputs = [self._image, self.tiles.rows, self.smoothness.edge, self._prior]
            program.add(cg.link, self.tiles.nodes, inputs, [self._prior.right, self._prior.down])
        self._equations.add_diagonal(program, self.residuals.weight, self._slices)
        program.add(cg.gather_diagonal, len(self._image), [self._sums, self._prior], [self._u.diagonal])
        return program

    @cached_property
    def _prepare_grids(self) -> Any:
        """Program that computes the diagonals of the coarser grids for the current weights."""
        program = Program(self.device)
        if self._grids is not None:
            equations = [self._atlas, self._at.geometry, self.residuals.weight]
            self._grids.prepare(program, equations, self.count, self._sums, self._slices)
        return program

    @cached_property
    def _descent(self) -> _ConjugateGradients:
        return _ConjugateGradients(self, self._image, self.residuals.values)

    @cached_property
    def _projection(self) -> _ConjugateGradients:
        return _ConjugateGradients(self, self._zeros(len(self._image)), self._zeros(self.pairs.arrays.stride))

    # -- results

    @property
    def unknowns(self) -> NDArray[np.float32]:
        """Copy of the unknowns: map, leak [thresholds/s], and OFF threshold over ON threshold, minus 1."""
        values: NDArray[np.float32] = self._image.numpy()
        return values.copy() if self.device.is_cpu else values

    @unknowns.setter
    def unknowns(self, values: NDArray[np.float32] | wp.array) -> None:
        self._image.assign(values)

    def copy_unknowns(self) -> wp.array:
        """Return a copy of the unknowns on the device."""
        return wp.clone(self._image)

    def start_from(self, other: BrightnessMap) -> None:
        """Set map, leak and OFF threshold to those of ``other``, whose tiles are the same but for their density."""
        maps, closer = other.maps(), other.tiles.density / self.tiles.density
        for axis, count in ((1, self.tiles.rows), (2, self.tiles.columns)):
            most = maps.shape[axis] - 1
            at = np.minimum(np.arange(count, dtype=np.float32) * np.float32(closer), most)
            low = np.minimum(at.astype(np.int64), most - 1)
            share = (at - low).reshape([-1 if k == axis else 1 for k in range(3)])
            maps = maps.take(low, axis) * (1.0 - share) + maps.take(low + 1, axis) * share
        self.unknowns = np.concatenate([maps.ravel(), other.extra])

    def maps(self) -> NDArray[np.float32]:
        """Return the map [ON thresholds], shape (tiles, rows, columns)."""
        shape = (len(self.tiles.origin), self.tiles.rows, self.tiles.columns)
        return self.unknowns[: self.tiles.nodes].reshape(shape)

    def coverage(self, scale: float = 1.0) -> NDArray[np.float32]:
        """Return how well pairs of two events determine each node, shape (tiles, rows, columns).

        Each equation contributes its weight for the Cauchy scale ``scale`` [thresholds].
        """
        shape = (len(self.tiles.origin), self.tiles.rows, self.tiles.columns)
        found: NDArray[np.float32] = self.coverage_on_device(scale).numpy()
        return found[: self.tiles.nodes].reshape(shape)

    def coverage_on_device(self, scale: float) -> wp.array:
        """Return :meth:`coverage` as one vector on the device, followed by values of the other unknowns."""
        self._scale.fill_(scale)
        weak, self.pairs.arrays.weak = self.pairs.arrays.weak, 0.0
        program = Program(self.device)
        self._add_weigh(program)
        self._equations.add_diagonal(program, self.residuals.weight, self._slices)
        out = self._zeros(len(self._image))
        program.add(cg.gather, len(out), [self._sums], [out])
        program.launch()
        self.pairs.arrays.weak = weak
        return out

    @property
    def extra(self) -> NDArray[np.float32]:
        """Unknowns after the map: the leak [thresholds/s], and OFF threshold over ON threshold, minus 1."""
        values: NDArray[np.float32] = self._image[self.tiles.nodes :].numpy()
        return values.copy() if self.device.is_cpu else values


class _ConjugateGradients:
    """Conjugate gradients on the normal equations, preconditioned by the diagonal or by :class:`GridHierarchy`.

    They change ``image`` to reduce ``residual``, which must be the residual of the initial ``image``.
    """

    def __init__(self, of: BrightnessMap, image: Any, residual: Any) -> None:
        self.image, self.residual = image, residual
        self._map, self._start, self._step = of, Program(of.device), Program(of.device)
        of._equations.add_transpose(self._start, of.residuals.weight, residual, of._slices)
        self._add(self._start, cg.start_descent, [of._sums, of._prior, image], [of._u, of._dots])
        if of._grids is None:
            self._add(self._step, cg.update_search_direction, [], [of._u, of._dots])
        else:
            self._add(self._step, cg.update_search_direction_with, [of._z], [of._u, of._dots])
        of._equations.add_product(self._step, of.residuals.weight, of._u.direction, of._slices)
        self._add(self._step, cg.finish_product, [of._sums, of._prior], [of._u, of._dots])
        self._add(self._step, cg.descend, [], [image, of._u, of._dots])
        if of._grids is not None:
            for program in (self._start, self._step):  # preconditioned residual, and its product with the residual
                of._grids.correct(program, of._u.diagonal, of._prior, of._u.residual, of._z)
                self._add(program, cg.dot, [of._u.residual, of._z], [of._dots.rz])

    def run(self, steps: int) -> None:
        """Start from the current ``image`` and run ``steps`` iterations."""
        self._start.run()
        self._step.run(steps)

    def _add(self, program: Any, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        program.add(kernel, self._map._threads, [*inputs, self._map._width], outputs, smallest=FEW_CHUNKS)


# Pixels with slow photoreceptors: their events come late and from a smaller orbit, the more so the darker they are.
#
# A photoreceptor is modelled as a first-order low-pass filter whose rate is proportional to the light (Delbruck and
# Mead, ISCAS 1994). At an angular speed ω, a filter with time constant τ sees a circular orbit rotated by atan(ω τ) and
# contracted by cos(atan(ω τ)), exactly so where the brightness is linear over the orbit. What the filter's output
# differs from that elsewhere is computed along the prism's path and moved to the right side of the equations.

SAMPLED = 1 << 13
"""Smallest number of pairs whose brightness gives the median of all; all are used if there are fewer."""
THRESHOLD = 0.25
"""Assumed ON threshold [log intensity], which turns the map's brightness into light. Data sheets state 0.1 to 0.4."""


def darkness(brightness: BrightnessMap, model: Model, *, ahead: float = 0.0) -> tuple[Any, float]:
    """Return the time constant at each event, relative to that at the median brightness of all, and that brightness.

    Parameters
    ----------
    brightness : BrightnessMap
        Solved map.
    model : Model
        Model with the phase at which the map was solved.
    ahead : float, default 0.0
        Angle by which the prism is ahead of that phase, because the events come late [rad].

    Returns
    -------
    relative : warp.array
        Relative time constants at the first and the second event of each pair, shape (2, n) padded to (2, m).
    middle : float
        Median brightness [ON thresholds].
    """
    pairs, device = brightness.pairs, brightness.device
    pixels = slow_kernels.Photoreceptor()
    pixels.ahead = ahead

    def compute(every: int, columns: int) -> Any:
        out = wp.empty((2, columns), dtype=float, device=device)
        inputs = [*brightness.path_arguments(model), pixels, every]
        launch(slow_kernels.find_time_constants, -(-len(pairs) // every), inputs, [out], device=device)
        return out

    every = max(1, len(pairs) // SAMPLED)
    pixels.middle = float(np.nanmedian(compute(every, -(-len(pairs) // every)).numpy()))
    pixels.threshold = THRESHOLD
    return compute(1, pairs.arrays.stride), pixels.middle


def set_lags(
    brightness: BrightnessMap, model: Model, turns: NDArray[np.float64], ahead: float, *, with_offsets: bool
) -> None:
    """Give the pairs the lags of slow pixels, relative to a mean lag, which remains part of the phase.

    Parameters
    ----------
    brightness : BrightnessMap
        Solved map, whose pairs have lags (:meth:`PairSet.clear_lags`).
    model : Model
        Model with the phase at which the map was solved.
    turns : numpy.ndarray
        Angle by which the prism turns within the time constant at median brightness [rad], shape (tiles,).
    ahead : float
        The mean lag [rad].
    with_offsets : bool
        Whether to compute what the filter's output differs from the brightness on the contracted orbit. The map must
        have been solved with lags.
    """
    pairs, tile = brightness.pairs, brightness.pairs.column("tile")
    relative, middle = darkness(brightness, model, ahead=ahead if with_offsets else 0.0)
    lag = np.arctan(turns[tile] * relative.numpy()[:, : len(pairs)])
    factor = np.cos(lag) * np.exp(1j * (ahead - lag))
    values = np.zeros((4, pairs.arrays.stride), np.float32)
    values[0] = values[2] = 1.0
    values[0::2, : len(pairs)], values[1::2, : len(pairs)] = factor.real, factor.imag
    pairs.arrays.lag.assign(values.ravel())
    pairs.arrays.offset.zero_()
    if with_offsets:
        filtering = slow_kernels.Photoreceptor()
        filtering.threshold, filtering.middle, filtering.ahead = THRESHOLD, middle, ahead
        filtering.turn = wp.array(turns, dtype=float, device=brightness.device)
        inputs = [*brightness.path_arguments(model), filtering]
        launch(slow_kernels.find_offsets, len(pairs), inputs, [pairs.arrays.offset], device=brightness.device)
