"""The scene's log brightness from pairs of events: sparse least squares, matrix-free, on the device.

An event says that log brightness at its pixel changed by the threshold since that pixel's last event. With L the map on
the prism-free pixel grid and w(x, θ) the compensated place, L(w(x, θ₂)) − L(w(x, θ₁)) = ±C: linear in L. L is in units
of the ON threshold. See ``docs/calibration.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.multilevel import Levels
from amiwarp.optics import model_camera, wrap_angle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.encoder import Encoder
    from amiwarp.events import Events
    from amiwarp.optics import Model

WEAK_WEIGHT = 0.05
"""Of a pair that is not of two events (:func:`open_ends`, :func:`quiet_pairs`): right only to within a threshold."""

DAMPING = 0.02
"""Weight of the map's own square beside the equations: it holds unknowns that none determines."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """What is known of the sensor's timing [us]; zero where nothing is."""

    latency_us: float = 0.0
    """Time from a change of brightness to its stamp."""
    refractory_us: float = 0.0
    """Time after an event at whose end a pixel takes its new reference."""


@dataclass(frozen=True, slots=True)
class Smoothness:
    """A prior that carries the map into places without equations, and takes salt out."""

    weight: float
    """Of the squared difference of neighbouring nodes, beside the equations' weight of 1."""
    edge: float = 0.0
    """Neighbours that differ by more [thresholds] are linked the less (Charbonnier); 0 for links of equal weight."""


@dataclass(frozen=True, slots=True)
class Tiles:
    """Parts of the map: equal rectangles, nodes ``1 / density`` px apart."""

    origin: NDArray[np.float32]
    """Pixel of each tile's first node, shape (tiles, 2)."""
    rows: int
    columns: int
    density: float = 2.0

    @property
    def nodes(self) -> int:
        return len(self.origin) * self.rows * self.columns


@dataclass(frozen=True)
class PairSet:
    """Pairs of consecutive events of a pixel, on the host."""

    x: NDArray[np.uint16]
    y: NDArray[np.uint16]
    first_t: NDArray[np.int64]
    """Time of the event that sets the reference [us]."""
    second_t: NDArray[np.int64]
    on: NDArray[np.uint8]
    """Polarity of the second event; plus 2 where there is none at the second time, 4 where none at the first."""
    tile: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.x)

    def __getitem__(self, which: slice | NDArray[Any]) -> PairSet:
        names = ("x", "y", "first_t", "second_t", "on", "tile")
        return PairSet(*(getattr(self, name)[which] for name in names))

    @classmethod
    def concatenate(cls, parts: list[PairSet]) -> PairSet:
        names = ("x", "y", "first_t", "second_t", "on", "tile")
        return cls(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def pair_events(
    events: Events,
    tile_of: NDArray[np.int32],
    *,
    longest_gap_us: int,
    shortest_gap_us: float = 0.0,
    device: Any = "cpu",
) -> PairSet:
    """Consecutive events of each pixel of a tile (``tile_of`` (height, width) >= 0), sorted on ``device``.

    Left out are pairs further apart than ``longest_gap_us``, or closer than ``shortest_gap_us``.
    """
    import warp as wp

    tile = tile_of[events.y, events.x]
    events, tile = events[tile >= 0], tile[tile >= 0]
    n, width = len(events), tile_of.shape[1]
    if n < 2:
        return PairSet(events.x[:0], events.y[:0], events.t[:0], events.t[:0], events.p[:0], tile[:0])
    keys = np.zeros(2 * n, dtype=np.int32)
    keys[:n] = events.y.astype(np.int32) * width + events.x
    keys_d = wp.array(keys, dtype=wp.int32, device=device)
    order_d = wp.array(np.arange(2 * n, dtype=np.int32), dtype=wp.int32, device=device)
    wp.utils.radix_sort_pairs(keys_d, order_d, n)
    pixel, order = keys_d.numpy()[:n], order_d.numpy()[:n]
    gap = np.diff(events.t[order])
    pair = np.flatnonzero((pixel[1:] == pixel[:-1]) & (gap <= longest_gap_us) & (gap > shortest_gap_us))
    first, second = order[pair], order[pair + 1]
    return PairSet(events.x[first], events.y[first], events.t[first], events.t[second], events.p[second], tile[first])


def open_ends(events: Events, tile_of: NDArray[np.int32], start: int, stop: int) -> PairSet:
    """From the window's ``start`` to each pixel's first event, and from its last to ``stop`` [us].

    At the start the brightness is anywhere within a threshold of the reference, so that the first event finds it one
    threshold further in the mean; after the last it stays within one. Without the former, every edge that enters would
    look lower than it looks when it leaves, and the map would slope.
    """
    events = events[tile_of[events.y, events.x] >= 0]
    pixel = events.y.astype(np.int64) * tile_of.shape[1] + events.x
    first = np.unique(pixel, return_index=True)[1]
    last = len(pixel) - 1 - np.unique(pixel[::-1], return_index=True)[1]
    e, z = events[first], events[last]
    return PairSet(
        np.concatenate([e.x, z.x]),
        np.concatenate([e.y, z.y]),
        np.concatenate([np.full(len(e), start, np.int64), z.t]),
        np.concatenate([e.t, np.full(len(z), stop, np.int64)]),
        np.concatenate([e.p | 4, np.full(len(z), 2, np.uint8)]).astype(np.uint8),
        np.concatenate([tile_of[e.y, e.x], tile_of[z.y, z.x]]),
    )


def quiet_pairs(events: Events, tile_of: NDArray[np.int32], edges: NDArray[np.int64], *, at_least: int) -> PairSet:
    """Spans between two of ``edges`` (rising times [us]) of pixels that fire in none of ``at_least`` spans about them.

    Silence is information: the log brightness along the pixel's way changed by no more than about a threshold.
    """
    spans = len(edges) - 1
    span = np.searchsorted(edges, events.t, side="right") - 1
    inside = (span >= 0) & (span < spans)
    run = np.ones((spans, *tile_of.shape), np.int32)
    run[span[inside], events.y[inside], events.x[inside]] = 0
    for k in range(1, spans):
        run[k] *= 1 + run[k - 1]
    for k in range(spans - 2, -1, -1):
        run[k] = np.where((run[k] > 0) & (run[k + 1] > 0), run[k + 1], run[k])
    at, y, x = np.nonzero((run >= at_least) & (tile_of >= 0))
    on = np.full(len(at), 2, np.uint8)
    return PairSet(x.astype(np.uint16), y.astype(np.uint16), edges[at], edges[at + 1], on, tile_of[y, x])


class BrightnessMap:
    """The map of a set of pairs and its solver; owns its buffers. Solves warm-start from the last map."""

    def __init__(
        self,
        pairs: PairSet,
        tiles: Tiles,
        encoder: Encoder,
        *,
        sensor: Sensor | None = None,
        slope: NDArray[np.float32] | None = None,
        with_off: bool = True,
        with_leak: bool = False,
        off_excess: float | None = None,
        damping: float = DAMPING,
        smoothness: Smoothness | None = None,
        device: Any = "cpu",
    ) -> None:
        """``slope`` (n, 2): change of the encoder's angle at either event per unit of a drifting parameter.

        ``off_excess``: the OFF threshold's excess over the ON threshold where it is known: held, not solved for.
        """
        import warp as wp

        from amiwarp.kernels import photometric as kernels
        from amiwarp.kernels.launch import slice_count
        from amiwarp.kernels.prior import Prior

        if not len(pairs):
            raise AmiwarpError("no pixel fired twice in time: there is no pair of events to learn the brightness from")
        self.device, self.tiles, self.count = wp.get_device(device), tiles, len(pairs)
        self.middle_us = (int(pairs.first_t.min()) + int(pairs.second_t.max())) // 2
        self._pairs = self._upload(pairs, encoder, sensor or Sensor(), slope)
        self._atlas = kernels.Atlas()
        self._atlas.origin = wp.array(tiles.origin, dtype=wp.vec2, device=device)
        self._atlas.rows, self._atlas.columns, self._atlas.density = tiles.rows, tiles.columns, tiles.density
        self._atlas.with_off, self._atlas.with_leak = float(with_off), float(with_leak)
        unknowns = tiles.nodes + int(kernels.EXTRA)
        names = ("image", "residual", "direction", "product", "diagonal")
        self._image, self._r, self._p, self._q, self._diagonal = (
            wp.zeros(unknowns, dtype=float, device=device) for _ in names
        )
        self._sums = wp.zeros((slice_count(device), unknowns), dtype=wp.int64, device=device)
        self._slices = [self._sums[k] for k in range(len(self._sums))]
        self._partial = wp.zeros(-(-unknowns // int(kernels.SEGMENT)), dtype=wp.float64, device=device)
        self._scalars = wp.zeros(3, dtype=wp.float64, device=device)
        self.smoothness = smoothness
        self._prior = Prior()
        self._prior.damping, self._prior.columns = damping, tiles.columns
        self._prior.linked, self._prior.held = int(smoothness is not None), unknowns
        links = unknowns if smoothness is not None else 0
        self._prior.right, self._prior.down = (wp.zeros(links, dtype=float, device=device) for _ in "xy")
        one = smoothness is not None and len(tiles.origin) == 1
        self._levels = Levels(tiles.rows, tiles.columns, self.device) if one else None
        self._z = wp.zeros(unknowns if one else 0, dtype=float, device=device)
        if off_excess is not None:
            self._prior.held = tiles.nodes
            self._image.assign(np.concatenate([np.zeros(tiles.nodes), [off_excess, 0.0]]).astype(np.float32))
        self._weight = wp.zeros(self.count, dtype=float, device=device)
        self._residual = wp.zeros(self.count, dtype=float, device=device)
        self._geometry = kernels.Geometry()
        self._geometry.cell = wp.zeros(self.count, dtype=wp.vec2i, device=device)
        self._geometry.first = wp.zeros(self.count, dtype=wp.vec2, device=device)
        self._geometry.second = wp.zeros(self.count, dtype=wp.vec2, device=device)

    def _upload(self, pairs: PairSet, encoder: Encoder, sensor: Sensor, slope: NDArray[np.float32] | None) -> Any:
        import warp as wp

        from amiwarp.kernels.photometric import Pairs

        speed = [encoder.speed_at(t) for t in (pairs.first_t, pairs.second_t)]
        late = (sensor.refractory_us - sensor.latency_us, -sensor.latency_us)
        theta = [
            wrap_angle(encoder.angle_at(t) + s * shift * 1e-6)
            for t, s, shift in zip((pairs.first_t, pairs.second_t), speed, late, strict=True)
        ]
        out = Pairs()
        out.weak = WEAK_WEIGHT
        for name, dtype in (("x", wp.uint16), ("y", wp.uint16), ("tile", wp.int32), ("on", wp.uint8)):
            setattr(out, name, wp.array(getattr(pairs, name), dtype=dtype, device=self.device))
        times = [(t - self.middle_us) * 1e-6 for t in (pairs.first_t, pairs.second_t)]
        zeros = np.zeros((len(pairs), 2), dtype=np.float32)
        columns: dict[str, Any] = {
            "theta": np.stack(theta, 1),
            "slope": zeros if slope is None else slope,
            "time": np.stack(times, 1),
        }
        for name, values in columns.items():
            setattr(out, name, wp.array(values.astype(np.float32), dtype=wp.vec2, device=self.device))
        return out

    def place(self, model: Model, *, drift: float = 0.0, omega: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Where the pairs fall for these parameters; ``omega``: the camera's angular velocity [rad/s]."""
        import warp as wp

        from amiwarp.kernels.launch import launch
        from amiwarp.kernels.photometric import place_pairs

        inputs = [model.params(self.device), model_camera(model, self.device), self._pairs, self._atlas, drift]
        launch(place_pairs, self.count, [*inputs, wp.vec3(*omega)], [self._geometry], device=self.device)

    def solve(self, scale: float, *, steps: int, rounds: int = 1) -> NDArray[np.float32]:
        """``rounds`` of Cauchy weights of ``scale`` [thresholds] and ``steps`` of conjugate gradients each.

        Returns the residual of every pair [thresholds], NaN for pairs off the map.
        """
        for _ in range(rounds):
            self._weigh(scale)
            self._descend(steps)
        self._weigh(scale)
        residual: NDArray[np.float32] = self._residual.numpy()
        return residual.copy()

    def _weigh(self, scale: float) -> None:
        from amiwarp.kernels.launch import launch
        from amiwarp.kernels.photometric import weigh

        inputs = [self._pairs, self._atlas, self._geometry, self._image, scale]
        launch(weigh, self.count, inputs, [self._weight, self._residual], device=self.device)

    def _descend(self, steps: int) -> None:
        """Conjugate gradients on the normal equations, preconditioned by the diagonal or by :class:`Levels`."""
        import warp as wp

        from amiwarp.kernels import photometric as k
        from amiwarp.kernels.launch import launch, launch_slices

        equations = [self._pairs, self._atlas, self._geometry, self._weight]
        unknowns = len(self._image)
        self._link()
        self._find_diagonal()
        if self._levels is not None:
            self._levels.prepare(equations, self.count, self._sums, self._slices)
        launch_slices(k.apply_residual, self.count, [*equations, self._image], self._slices, device=self.device)
        launch(k.gather, unknowns, [self._sums], [self._r], device=self.device)
        self._by_segment(k.start_descent, [self._prior, self._diagonal, self._image, self._r, self._p], [], 0)
        if self._levels is not None:
            self._correct(0)
            wp.copy(self._p, self._z)
        for _ in range(steps):
            launch_slices(k.apply_normal, self.count, [*equations, self._p], self._slices, device=self.device)
            self._by_segment(k.finish_product, [self._sums, self._prior, self._p, self._q], [], 1)
            inputs = [self._prior, self._scalars, self._diagonal, self._p, self._q, self._r]
            self._by_segment(k.descend, inputs, [self._image], 2)
            self._turn()
            wp.copy(self._scalars, self._scalars, 0, 2, 1)

    def _by_segment(self, kernel: Any, inputs: list[Any], outputs: list[Any], at: int) -> None:
        """Run a kernel that leaves partial sums, and put their total into the scalar ``at``."""
        import warp as wp

        from amiwarp.kernels.launch import launch
        from amiwarp.kernels.photometric import sum_partial

        launch(kernel, len(self._partial), inputs, [*outputs, self._partial], device=self.device, smallest=64)
        wp.launch(sum_partial, dim=1, inputs=[self._partial, at, self._scalars], device=self.device)

    def _correct(self, at: int) -> None:
        """The preconditioned residual, and its product with the residual into the scalar ``at``."""
        from amiwarp.kernels.multilevel import dot

        assert self._levels is not None
        assert self.smoothness is not None
        self._levels.correct(self._diagonal, self._prior, self.smoothness.weight, self._r, self._z)
        self._by_segment(dot, [self._r, self._z], [], at)

    def _turn(self) -> None:
        """The next direction."""
        from amiwarp.kernels import multilevel
        from amiwarp.kernels.launch import launch
        from amiwarp.kernels.photometric import turn

        if self._levels is None:
            inputs = [self._prior, self._scalars, self._diagonal, self._r]
            launch(turn, len(self._image), inputs, [self._p], device=self.device)
            return
        self._correct(2)
        launch(multilevel.turn_to, len(self._image), [self._scalars, self._z], [self._p], device=self.device)

    def _link(self) -> None:
        """Weights of the links between nodes, from the map as it is."""
        from amiwarp.kernels.launch import launch
        from amiwarp.kernels.prior import link

        if self.smoothness is not None:
            weight, edge = self.smoothness.weight, self.smoothness.edge
            inputs = [self._image, self.tiles.rows, self.tiles.columns, weight, edge]
            launch(link, self.tiles.nodes, inputs, [self._prior.right, self._prior.down], device=self.device)

    @property
    def unknowns(self) -> NDArray[np.float32]:
        """A copy of the map and, behind it, the OFF threshold's excess over the ON threshold and the leak [1/s]."""
        values: NDArray[np.float32] = self._image.numpy()
        return values.copy()

    @unknowns.setter
    def unknowns(self, values: NDArray[np.float32]) -> None:
        self._image.assign(values)

    def maps(self) -> NDArray[np.float32]:
        """The map [ON thresholds], shape (tiles, rows, columns)."""
        shape = (len(self.tiles.origin), self.tiles.rows, self.tiles.columns)
        return self.unknowns[: self.tiles.nodes].reshape(shape)

    def coverage(self, scale: float = 1.0) -> NDArray[np.float32]:
        """How much pairs of two events say of each node, with weights of ``scale``, shape (tiles, rows, columns)."""
        self._pairs.weak = 0.0
        self._weigh(scale)
        self._find_diagonal()
        self._pairs.weak = WEAK_WEIGHT
        shape = (len(self.tiles.origin), self.tiles.rows, self.tiles.columns)
        diagonal: NDArray[np.float32] = self._diagonal.numpy()[: self.tiles.nodes].reshape(shape)
        return diagonal.copy()

    def keep(self, nodes: NDArray[np.bool_]) -> None:
        """Pairs of two events that lie off ``nodes`` (tiles, rows, columns), either of them, are left out: noise."""
        import warp as wp

        cell: NDArray[np.int32] = self._geometry.cell.numpy().copy()
        on = nodes.ravel()
        inside = (cell[:, 0] >= 0) & (self._pairs.on.numpy() < 2)
        off = np.zeros(self.count, np.bool_)
        off[inside] = ~(on[cell[inside, 0]] & on[cell[inside, 1]])
        cell[off] = -1
        self._geometry.cell = wp.array(cell, dtype=wp.vec2i, device=self.device)

    def _find_diagonal(self) -> None:
        from amiwarp.kernels import photometric as k
        from amiwarp.kernels.launch import launch, launch_slices

        equations = [self._pairs, self._atlas, self._geometry, self._weight]
        launch_slices(k.add_diagonal, self.count, equations, self._slices, device=self.device)
        launch(k.gather, len(self._image), [self._sums], [self._diagonal], device=self.device)
