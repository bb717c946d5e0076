"""Pairs of consecutive events of a pixel, whose equations the brightness map solves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.kernels import equations as eqs
from amiwarp.kernels import equations_cpu, residual_slopes
from amiwarp.kernels import pairs as pair_kernels
from amiwarp.kernels.camera import pinhole_params
from amiwarp.kernels.launch import launch
from amiwarp.kernels.map_positions import find_places
from amiwarp.optics.camera_rotation import CameraRotation
from amiwarp.optics.models.base import Model, model_camera

Vector = NDArray[np.float64]

SAMPLED_TIMES = 1 << 15
"""Number of pairs whose times give the statistics of all."""


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

    def with_columns(self, **columns: Any) -> Any:
        """Return the kernels' struct with other columns. The pairs themselves stay as they are."""
        struct: Any = eqs.Pairs
        out = struct()
        for name in struct.vars:
            value = columns[name] if name in columns else getattr(self.arrays, name)
            setattr(out, name, value)
        return out

    def set_path(self, factors: Vector) -> None:
        """Set how the scene of each tile of a rotating camera moves in the image; see :meth:`path_array`."""
        self.arrays.path = self.path_array(factors)

    def path_array(self, factors: Vector) -> Any:
        """Return the paths of the tiles on the device.

        ``factors`` are the factors of t, t², … along x and y [px/s, px/s², …], shape (tiles, 2, ``PATH_TERMS``). t is
        the time of an event [s].
        """
        flat = factors.ravel().astype(np.float32)
        return wp.array(flat, dtype=float, device=self.device)

    def column(self, name: str) -> NDArray[Any]:
        """Return the column ``x``, ``y``, ``tile`` or ``on`` of the pairs as a NumPy array, shape (n,)."""
        padded: NDArray[Any] = getattr(self.arrays, name).numpy()
        return padded[: len(self)]

    @property
    def time(self) -> NDArray[np.float32]:
        """First and second time of each pair [s], relative to the window's middle, shape (2, n)."""
        padded: NDArray[np.float32] = self.arrays.time.numpy()
        both = padded.reshape(2, -1)
        return both[:, : len(self)]

    @cached_property
    def some_times(self) -> Vector:
        """Times of some pairs, evenly chosen [s], shape (2, m).

        At least :data:`SAMPLED_TIMES` pairs are chosen; all, if there are fewer.
        """
        every = max(1, len(self) // SAMPLED_TIMES)
        both = self.arrays.time.reshape((2, -1))
        values: NDArray[np.float32] = both[:, : len(self) : every].numpy()
        return values.astype(np.float64)

    def split_by_time(self) -> tuple[Any, Any]:
        """Return each pair's mean time, in standard deviations from the mean of all, and 1 if its gap is long, else 0.

        Both are on the device. A gap is long if it is longer than the median. Mean, standard deviation and median are
        taken from :attr:`some_times`.
        """
        first, second = self.some_times
        middle = 0.5 * (first + second)
        mean = float(middle.mean())
        spread = max(float(middle.std()), 1e-9)
        gap = second - first
        rank = (len(first) - 1) // 2
        median_gap = float(np.partition(gap, rank)[rank])

        late = wp.empty(self.arrays.stride, dtype=float, device=self.device)
        long = wp.empty(self.arrays.stride, dtype=float, device=self.device)
        launch(
            residual_slopes.split_by_time,
            len(self),
            [self.arrays, mean, spread, median_gap],
            [late, long],
            device=self.device,
        )
        return late, long

    def angle_patterns(self, middle: tuple[float, float]) -> Any:
        """Return patterns of errors of the prism's angle at the ends of each pair, one in each row, on the device.

        They are cosine and sine of the encoder's angle and of twice the angle, and the distance of the pixel from
        ``middle`` along x and y [px]. The shape is (6, 2 · padded pairs); each row is laid out as the pairs' slopes.
        """
        x, y = middle
        ends = 2 * self.arrays.stride
        patterns = wp.zeros((6, ends), dtype=float, device=self.device)
        launch(
            residual_slopes.angle_patterns,
            len(self),
            [self.arrays, float(x), float(y)],
            [patterns],
            device=self.device,
        )
        return patterns

    def with_slope(
        self,
        slope_of: Callable[[NDArray[np.int64]], Vector],
        middle_us: int,
    ) -> PairSet:
        """Attach to each pair the change of its prism angles per unit of a drifting parameter, and return the set.

        ``slope_of`` returns the change of the angle at given times [us].
        """
        values = np.zeros((2, self.arrays.stride), np.float32)
        for event, time_s in enumerate(self.time.astype(np.float64)):
            elapsed_us = np.rint(time_s * 1e6).astype(np.int64)
            values[event, : len(self)] = slope_of(elapsed_us + middle_us)
        self.arrays.slope = wp.array(values.ravel(), dtype=float, device=self.device)
        return self

    def set_offset(self, values: NDArray[np.float32]) -> None:
        """Set what the left side of each equation lacks [thresholds], shape (padded pairs,).

        The first call allocates it. Maps must be made afterwards.
        """
        if len(self.arrays.offset):
            self.arrays.offset.assign(values)
        else:
            self.arrays.offset = wp.array(values, dtype=float, device=self.device)

    def clear_lags(self) -> None:
        """Set the lags of slow pixels to none. The first call allocates them; maps must be made afterwards."""
        arrays = self.arrays
        if not len(arrays.lag):
            arrays.lag = wp.zeros(4 * arrays.stride, dtype=float, device=self.device)
            arrays.offset = wp.zeros(arrays.stride, dtype=float, device=self.device)
        # A lag is a complex factor for each event: 1 for none.
        none = np.zeros((4, arrays.stride), np.float32)
        none[0::2] = 1.0
        arrays.lag.assign(none.ravel())
        arrays.offset.zero_()

    def drop_lags(self) -> None:
        """Undo :meth:`clear_lags`, for the maps that were made before."""
        nothing = wp.empty(0, dtype=float, device=self.device)
        self.arrays.lag = nothing
        self.arrays.offset = nothing

    @classmethod
    def concatenate(cls, parts: Sequence[PairSet]) -> PairSet:
        """Join pair sets, in which equations from silence must have the same weight."""
        if len(parts) == 1:
            return parts[0]
        first = parts[0]
        count = sum(len(part) for part in parts)
        drifts = any(part.arrays.slope.shape[0] for part in parts)
        joined = empty_pairs(count, first.device, weak=first.arrays.weak, drifts=drifts)
        place = 0
        for part in parts:
            inputs = [part.arrays, place]
            launch(pair_kernels.copy_all, len(part), inputs, [joined], device=first.device)
            place += len(part)
        return cls(joined, first.device)

    def of_tiles(self, listed: NDArray[np.bool_]) -> PairSet:
        """Return the pairs on tiles whose value in ``listed`` is true, shape (tiles,)."""
        numbers = wp.array(listed.astype(np.int32), dtype=int, device=self.device)
        return self._select(pair_kernels.mark_listed, [self.arrays.tile, numbers])

    def of_square(self, left: int, top: int, side: int) -> PairSet:
        """Return the pairs of the pixels in a square of ``side`` px with corner (``left``, ``top``)."""
        return self._select(pair_kernels.mark_square, [self.arrays, left, top, side])

    def on_tiles(
        self,
        model: Model,
        camera_rotation: CameraRotation,
        drift: float,
        tile_of: Any,
    ) -> PairSet:
        """Return the pairs whose compensated events both fall on the same tile.

        ``tile_of`` gives the tile of each pixel of the map, or -1, on the device.
        """
        places = wp.empty(len(self), dtype=wp.vec4, device=self.device)
        camera = pinhole_params(model.camera) or model_camera(model, self.device)
        inputs = [
            model.params(self.device),
            camera,
            self.arrays,
            drift,
            camera_rotation.params(self.device),
        ]
        launch(find_places, len(self), inputs, [places], device=self.device)
        return self._select(
            pair_kernels.mark_same_tile,
            [places, tile_of],
            [self.arrays.tile],
        )

    def hold_out(self, every: int) -> int:
        """Mark every ``every``-th pair of two events as held out, so that it is not fitted; return the number held out.

        Pairs of two events must come first in the set.
        """
        launch(
            pair_kernels.hold_out,
            len(self),
            [every],
            [self.arrays.on],
            device=self.device,
        )
        held = self.column("on") & int(eqs.HELD)
        return int(np.count_nonzero(held))

    def _select(self, kernel: Any, inputs: list[Any], outputs: Sequence[Any] = ()) -> PairSet:
        """Return the pairs that a kernel marks."""
        device = self.device
        flag = wp.empty(len(self), dtype=int, device=device)
        launch(kernel, len(self), inputs, [*outputs, flag], device=device)
        place, count = running_count(flag)
        drifts = self.arrays.slope.shape[0] > 0
        selected = empty_pairs(count, device, drifts=drifts)
        launch(
            pair_kernels.copy_marked,
            len(self),
            [self.arrays, flag, place],
            [selected],
            device=device,
        )
        return PairSet(selected, device)


def off_excess(pairs: PairSet, *, with_leak: bool = False) -> float:
    """Return the ratio of the OFF to the ON threshold, minus 1, from the numbers of ON and OFF pairs.

    A solution for the ratio would be biased, because damping shrinks it together with the map. Over a whole turn,
    brightness returns to its start. So ON steps and OFF steps sum to zero, or, ``with_leak``, to the leakage: places
    with many and places with few events then separate ratio and leak.
    """
    on = pairs.column("on") == 1
    if not with_leak:
        on_pairs = int(on.sum())
        off_pairs = len(pairs) - on_pairs
        return on_pairs / max(1, off_pairs) - 1.0

    # Numbers of both, and the time that passes, in squares of 8 x 8 pixels.
    row = (pairs.column("y") // 8).astype(np.int64)
    column = pairs.column("x") // 8
    _, square = np.unique(row * (1 << 13) + column, return_inverse=True)
    ons = np.bincount(square, weights=on)
    offs = np.bincount(square, weights=~on)
    first, second = pairs.time.astype(np.float64)
    time = np.bincount(square, weights=second - first)

    # Fit ons = ratio · offs + leak · time. The counts have Poisson noise.
    noise = np.sqrt(ons + offs)
    columns = np.stack([offs, time], axis=1) / noise[:, None]
    solution, *_ = np.linalg.lstsq(columns, ons / noise, rcond=None)
    ratio = float(solution[0])
    return ratio - 1.0


def running_count(flag: Any) -> tuple[Any, int]:
    """Return the running count of the marked entries, and their total."""
    place = wp.empty_like(flag)
    if not len(flag):
        return place, 0
    wp.utils.array_scan(flag, place, inclusive=True)
    total = place[-1:].numpy()
    return place, int(total[0])


def empty_pairs(count: int, device: Any, *, weak: float = 0.0, drifts: bool = False) -> Any:
    """Return a set of ``count`` pairs to be filled, whose arrays are padded to whole blocks.

    The padding is zero on a CPU, whose kernels process whole blocks. It is undefined on CUDA, where no kernel reads it.
    Columns of one type share an array, because allocating is slow on CUDA.
    """
    block = int(equations_cpu.BLOCK)
    blocks = max(1, math.ceil(count / block))
    stride = blocks * block
    pixels = wp.empty(2 * stride, dtype=wp.uint16, device=device)
    flags = wp.empty(stride, dtype=wp.uint8, device=device)
    # One value for the tile, two for the times, four for the azimuths, and two for the slopes.
    columns = 9 if drifts else 7
    values = wp.empty(columns * stride, dtype=float, device=device)
    nothing = wp.empty(0, dtype=float, device=device)
    if pixels.device.is_cpu:
        for array in (pixels, flags, values):
            rows = array.numpy().reshape(-1, stride)
            rows[:, count:] = 0

    out = eqs.Pairs()
    out.stride = stride
    out.count = count
    out.weak = weak
    out.x = pixels[:stride]
    out.y = pixels[stride:]
    out.on = flags
    out.tile = values[:stride].view(int)
    out.time = values[stride : 3 * stride]
    out.azimuth = values[3 * stride : 7 * stride]
    out.slope = values[7 * stride :] if drifts else nothing
    out.lag = nothing
    out.offset = nothing
    out.path = nothing
    return out
