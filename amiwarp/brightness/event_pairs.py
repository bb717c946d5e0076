"""Pairs of consecutive events of a pixel, the equations of :mod:`amiwarp.brightness.solver`, and their positions.

Pairs are built on the device in three steps: sort the events by pixel, mark candidates for pairs, write the marked
pairs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.events.device_events import DeviceEvents, encoder_params, join, time_span
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.kernels import equations_cpu, equations_cuda
from amiwarp.kernels import pairs as kernels
from amiwarp.kernels.equations import HELD, Geometry, Pairs, slope_between, slope_of_changes, split_by_time
from amiwarp.kernels.equations_cpu import BLOCK, Chains, make_chains, weigh_chains
from amiwarp.kernels.equations_cuda import Ends, add_ends, list_ends, take_fractions
from amiwarp.kernels.launch import RepeatedLaunches, launch
from amiwarp.kernels.map_positions import find_places, place_blocks, place_pairs, place_still
from amiwarp.optics.camera import CameraRotation, pinhole_params
from amiwarp.optics.models import Model, model_camera
from amiwarp.validation import guarded

SAMPLED = 1 << 15
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
        every = max(1, len(self) // SAMPLED)
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
        launch(split_by_time, len(self), inputs, [late, long], device=self.device)
        return late, long

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
            launch(kernels.append, len(part), [part.arrays, at], [out], device=part.device)
            at += len(part)
        return cls(out, parts[0].device)

    def of_tiles(self, listed: NDArray[np.bool_]) -> PairSet:
        """Return the pairs on tiles whose value in ``listed`` is true, shape (tiles,)."""
        numbers = wp.array(listed.astype(np.int32), dtype=int, device=self.device)
        return self._select(kernels.mark_listed, [self.arrays.tile, numbers])

    def of_square(self, left: int, top: int, side: int) -> PairSet:
        """Return the pairs of the pixels in a square of ``side`` px with corner (``left``, ``top``)."""
        return self._select(kernels.mark_square, [self.arrays, left, top, side])

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
        return self._select(kernels.mark_same_tile, [places, tile_of], [self.arrays.tile])

    def hold_out(self, every: int) -> int:
        """Mark every ``every``-th pair of two events as held out, so that it is not fitted; return the number held out.

        Pairs of two events must come first in the set.
        """
        launch(kernels.hold_out, len(self), [every], [self.arrays.on], device=self.device)
        return int(np.count_nonzero(self.column("on") & int(HELD)))

    def _select(self, kernel: Any, inputs: list[Any], outputs: Sequence[Any] = ()) -> PairSet:
        """Return the pairs that a kernel marks."""
        flag = wp.empty(len(self), dtype=int, device=self.device)
        launch(kernel, len(self), inputs, [*outputs, flag], device=self.device)
        place, count = _running_count(flag)
        out = _empty(count, self.device, drifts=self.arrays.slope.shape[0] > 0)
        launch(kernels.select, len(self), [self.arrays, flag, place], [out], device=self.device)
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
        self.arrays = kernels.Sorted()
        self.arrays.columns = tile_of.shape[1]
        self.arrays.pixels = tile_of.shape[0] * tile_of.shape[1]
        side = int(kernels.SQUARE)
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
        launch(kernels.mark_inside, n, [s.x, s.y, self.tile_of], [flag], device=self.device)
        place, s.count = _running_count(flag)
        s.key, s.order = (wp.empty(2 * s.count, dtype=int, device=self.device) for _ in "ko")
        first = np.cumsum([0, *(len(span) for span in self.spans[:-1])])
        inputs = [s.x, s.y, self.tile_of, place, wp.array(first, dtype=int, device=self.device), s.places]
        launch(kernels.fill_keys, n, inputs, [s.key, s.order], device=self.device)
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
        times = kernels.Window()
        times.start, times.stop = window or (0, 0)
        times.middle, times.longest, times.shortest = middle_us, longest_gap_us, shortest_gap_us
        times.late_first, times.late_second = sensor.refractory_us - sensor.latency_us, -sensor.latency_us
        m, device = self.arrays.count, self.device
        ends, base = (0, m) if window is None else (m, 3 * m)
        edges, at_least = (np.zeros(1, np.int64), 0) if quiet is None else quiet
        spans = (len(edges) - 1) * self.arrays.places
        flag = wp.empty(base + spans, dtype=int, device=device)
        launch(kernels.mark_pairs, m, [self.arrays, times], [flag], device=device)
        launch(kernels.mark_ends, ends, [self.arrays], [flag], device=device)
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
        launch(kernels.write_pairs, base, [self.arrays, times, angles, self.tile_of, flag, place], [out], device=device)
        if spans:
            of_spans = _empty(len(edges) - 1, device)
            launch(kernels.write_spans, len(edges) - 1, [edges_d, times, angles], [of_spans], device=device)
            inputs = [of_spans, self.tile_of, base, flag, place]
            launch(kernels.write_quiet, spans, inputs, [out], device=device)
        return PairSet(out, device, of_two_events)

    def _mark_quiet(self, edges: Any, at_least: int, base: int, flag: Any) -> None:
        """Mark the time spans in which pixels are silent."""
        fired = wp.zeros((len(edges) - 1) * self.arrays.pixels, dtype=wp.uint8, device=self.device)
        launch(kernels.mark_spans, len(self.arrays.x), [self.arrays, edges], [fired], device=self.device)
        inputs = [fired, self.tile_of, at_least, base]
        launch(kernels.mark_quiet, self.arrays.places, inputs, [flag], device=self.device)

    def exclude_hot_pixels(self) -> NDArray[np.int32]:
        """Exclude pixels that fire far more often than the busiest pixels around them, by setting ``tile_of`` to -1.

        Returns the number of events of each pixel, shape (height, width).
        """
        rows, columns = self.tile_of.shape
        count = wp.zeros(rows * columns, dtype=int, device=self.device)
        n = len(self.arrays.x)
        launch(
            kernels.count_pixels, n, [self.arrays], [count], device=self.device, smallest=n + 1
        )  # one CPU thread only: several would add to the same counters
        launch(kernels.mark_hot, rows * columns, [count.reshape((rows, columns)), 0], [self.tile_of.flatten()],
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
    out = Pairs()
    block = int(BLOCK)
    n = out.stride = max(1, -(-count // block)) * block
    out.count, out.weak = count, weak
    pixels, flags = wp.empty(2 * n, dtype=wp.uint16, device=device), wp.empty(n, dtype=wp.uint8, device=device)
    values = wp.empty((9 if drifts else 7) * n, dtype=float, device=device)
    nothing = wp.empty(0, dtype=float, device=device)
    out.x, out.y, out.on = pixels[:n], pixels[n:], flags
    out.tile, out.time, out.azimuth = values[:n].view(int), values[n : 3 * n], values[3 * n : 7 * n]
    out.slope = values[7 * n :] if drifts else nothing
    out.lag = out.offset = nothing
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
        self.threads = stride // int(BLOCK)
        """Number of threads of the kernels, each for a block of pairs."""
        self.arrays = Chains()
        """Columns of the positions: the kernels' struct ``Chains``."""
        for name, dtype in (("cell", int), ("x", float), ("y", float), ("weight", float)):
            setattr(self.arrays, name, wp.empty(2 * stride, dtype=dtype, device=device))
        self.arrays.count = wp.empty(self.threads, dtype=int, device=device)
        self.arrays.end = wp.empty(stride, dtype=wp.uint8, device=device)

    def take_positions(self) -> None:
        """Take the present positions, and join pairs that begin where the pair before them ends."""
        inputs = [self._geometry.cell, self._geometry.part, self._geometry.stride]
        launch(make_chains, self.threads, inputs, [self.arrays], device="cpu", smallest=FEW_BLOCKS)

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
        program.add(weigh_chains, self.threads, [weight], [self.arrays], smallest=FEW_BLOCKS)
        inputs = [self._pairs, self._atlas, self.arrays, weight]
        program.add_slices(equations_cpu.add_diagonal, self.threads, inputs, slices, smallest=FEW_BLOCKS)


# Ends of event pairs on CUDA in the order of the map, so that neighbouring threads add to the same nodes.


class PairEnds:
    """Positions of both ends of pairs in the order of the map, and sums over the pairs' weighted equations on CUDA.

    Its methods are those of :class:`amiwarp.brightness.event_pairs.PairChains`.
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
        self.arrays = Ends()
        """Columns of the ends: the kernels' struct ``Ends``."""
        self.arrays.part = wp.empty(2 * stride, dtype=wp.vec2, device=self._device)
        self.arrays.order, self.arrays.cell = (wp.empty(4 * stride, dtype=int, device=self._device) for _ in "oc")
        self._flow = wp.empty(stride, dtype=float, device=self._device)
        self._ends, self._end_inputs = 2 * stride, [self.arrays, stride, atlas.columns]

    def take_positions(self) -> None:
        """Take the present positions, and sort them."""
        ends, nodes = self._ends, self._nodes
        inputs, outputs = [self._geometry, self.threads, nodes], [self.arrays.cell, self.arrays.order]
        self._launch(list_ends, ends, inputs, outputs)
        wp.utils.radix_sort_pairs(*outputs, ends, end_bit=nodes.bit_length())
        self._launch(take_fractions, ends, [self._geometry], [self.arrays])

    @property
    def inputs(self) -> list[Any]:
        """First inputs of the kernels that compute a value for each equation."""
        return [self._pairs, self._atlas, self._geometry]

    def add_product(self, program: Any, weight: Any, vector: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W A vector, for equations A with weights W."""
        program.add(equations_cuda.find_flows, self.threads, [*self.inputs, weight, vector], [self._flow, *slices])
        program.add(add_ends, self._ends, [*self._end_inputs, self._flow, 0], slices)

    def add_transpose(self, program: Any, weight: Any, residual: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += Aᵀ W residual."""
        inputs = [self._pairs, self._atlas, weight, residual]
        program.add(equations_cuda.weigh_residuals, self.threads, inputs, [self._flow, *slices])
        program.add(add_ends, self._ends, [*self._end_inputs, self._flow, 0], slices)

    def add_diagonal(self, program: Any, weight: Any, slices: list[Any]) -> None:
        """Add to ``program``: slices += diag(Aᵀ W A)."""
        if self._atlas.with_leak or self._atlas.with_off:
            inputs = [self._pairs, self._atlas, weight]
            program.add(equations_cuda.add_sensor_diagonal, self.threads, inputs, slices)
        program.add(add_ends, self._ends, [*self._end_inputs, weight, 1], slices)


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
        self._launch = RepeatedLaunches(self.device)

    def _new_geometry(self) -> Any:
        g = Geometry()
        g.stride = self.pairs.arrays.stride
        g.cell = wp.empty(2 * g.stride, dtype=int, device=self.device)
        g.part = wp.empty(4 * g.stride, dtype=float, device=self.device)
        return g

    def place(
        self, model: Model, drift: float, camera_rotation: CameraRotation | None, out: Any, image: Any = None
    ) -> None:
        """Compute the positions into ``out``.

        With the map ``image``, on a CPU and if :meth:`_in_blocks`, ``out`` gets the changes of brightness instead.
        """
        arrays, turn = self.pairs.arrays, self._turn(camera_rotation)
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
        return (camera_rotation or CameraRotation()).about(self._middle_us)

    def _in_blocks(self, model: Model, turn: CameraRotation) -> bool:
        """Return whether the fast kernels apply: no distortion, no slow pixels, and on CUDA only the prism moves."""
        arrays = self.pairs.arrays
        moves = arrays.slope.shape[0] > 0 or any((*turn.angular_velocity, *turn.angular_acceleration))
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
            self._launch(slope_of_changes, len(self.pairs), [*self._changes, width], [out])
            return out
        for side, at in zip(self._sides, both, strict=True):
            self.place(**at, out=side)
        inputs = [self.pairs.arrays, self._atlas, *self._sides, image, width]
        self._launch(slope_between, len(self.pairs), inputs, [out])
        return out

    def keep(self, nodes: wp.array) -> None:
        """Exclude pairs of two events that are off the ``nodes``; see :meth:`BrightnessMap.keep`."""
        inputs = [nodes, self.pairs.arrays.on, self.geometry.stride]
        self._launch(kernels.keep_nodes, len(self.pairs), inputs, [self.geometry.cell])
        self.equations.take_positions()
