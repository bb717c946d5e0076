"""Pairs of consecutive events of a pixel: what the equations of :mod:`amiwarp.brightness` are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.optics import model_camera, wrap_angle

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.encoder import Encoder
    from amiwarp.events import Events
    from amiwarp.optics import Model
    from amiwarp.turning import Turning


@dataclass(frozen=True, slots=True)
class Sensor:
    """What is known of the sensor's timing [us]; zero where nothing is."""

    latency_us: float = 0.0
    """Time from a change of brightness to its stamp."""
    refractory_us: float = 0.0
    """Time after an event at whose end a pixel takes its new reference."""


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


def upload_pairs(
    pairs: PairSet,
    encoder: Encoder,
    sensor: Sensor,
    slope: NDArray[np.float32] | None,
    *,
    middle_us: int,
    weak: float,
    device: Any,
) -> Any:
    """The pairs on ``device`` with the encoder's angle at either event, as the kernels' ``Pairs``.

    ``slope`` (n, 2): change of the angle at either event per unit of a drifting parameter. Times are from
    ``middle_us``.
    """
    import warp as wp

    from amiwarp.kernels.photometric import Pairs

    late = (sensor.refractory_us - sensor.latency_us, -sensor.latency_us)
    theta = [
        wrap_angle(encoder.angle_at(t) + encoder.speed_at(t) * shift * 1e-6)
        for t, shift in zip((pairs.first_t, pairs.second_t), late, strict=True)
    ]
    out = Pairs()
    out.weak = weak
    for name, dtype in (("x", wp.uint16), ("y", wp.uint16), ("tile", wp.int32), ("on", wp.uint8)):
        setattr(out, name, wp.array(getattr(pairs, name), dtype=dtype, device=device))
    columns: dict[str, Any] = {
        "theta": np.stack(theta, 1),
        "slope": np.zeros((len(pairs), 2)) if slope is None else slope,
        "time": np.stack([(t - middle_us) * 1e-6 for t in (pairs.first_t, pairs.second_t)], 1),
    }
    for name, values in columns.items():
        setattr(out, name, wp.array(values.astype(np.float32), dtype=wp.vec2, device=device))
    return out


def places_of(
    pairs: PairSet,
    model: Model,
    encoder: Encoder,
    sensor: Sensor,
    turning: Turning,
    *,
    drift: float,
    slope: NDArray[np.float32] | None,
    device: Any,
) -> NDArray[np.float32]:
    """Compensated places (x, y, x, y) of both events of each pair [px], shape (n, 4), the camera turned back."""
    import warp as wp

    from amiwarp.kernels.launch import launch
    from amiwarp.kernels.photometric import find_places

    arrays = upload_pairs(pairs, encoder, sensor, slope, middle_us=turning.middle_us, weak=0.0, device=device)
    out = wp.empty(len(pairs), dtype=wp.vec4, device=device)
    inputs = [model.params(device), model_camera(model, device), arrays, drift, turning.params()]
    launch(find_places, len(pairs), inputs, [out], device=device)
    places: NDArray[np.float32] = out.numpy()
    return places


def off_excess(pairs: PairSet, *, with_leak: bool = False) -> float:
    """Excess of the OFF threshold over the ON threshold, counted, not solved for: that would shrink it with the map.

    Over a whole turn brightness comes back to where it was, so ON steps and OFF steps add up to nothing, or
    ``with_leak`` to what leaked meanwhile: then places with many and with few events tell the two apart.
    """
    on = pairs.on == 1
    if not with_leak:
        count = int(on.sum())
        return count / max(1, len(pairs) - count) - 1.0
    cell = (pairs.y // 8).astype(np.int64) * (1 << 13) + pairs.x // 8
    _, index = np.unique(cell, return_inverse=True)
    ons, offs = np.bincount(index, weights=on), np.bincount(index, weights=~on)
    time = np.bincount(index, weights=(pairs.second_t - pairs.first_t) * 1e-6)
    columns = np.stack([offs, time], axis=1) / np.sqrt(ons + offs)[:, None]
    found = np.linalg.lstsq(columns, ons / np.sqrt(ons + offs), rcond=None)[0]
    return float(found[0]) - 1.0
