"""Collection of the pairs of successive events of a pixel that the photometric stage uses."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from amiwarp.brightness.event_pairs import EventTable, PairSet, SensorTiming
from amiwarp.calib.photometric.events_ahead import EventsAhead
from amiwarp.calib.photometric.scene_tiles import choose_tiles, near_tiles, one_tile
from amiwarp.calib.sharpness.objective import reach
from amiwarp.errors import AmiwarpError
from amiwarp.events.events import MemoryEvents

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.brightness.tiles import Tiles
    from amiwarp.calib.photometric.stage import PhotometricSettings
    from amiwarp.calib.sharpness.search import Search
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.recording import Recording

MARGIN_PX, ROTATION_MARGIN_PX = 3, 8
"""Border of a tile's brightness map for events that a change of the parameters moves [px]: for a still camera, and for
a rotating one."""
LONGEST_GAP_US = 60_000
"""Longest time between the two events of a pair [us]. Noise makes longer gaps unreliable."""
FEWEST_PAIRS = 1_500
"""Smallest number of pairs of events for the photometric stage."""
PAIRS_PER_NODE = 1.5
"""Smallest number of equations per unknown of the brightness map. A map with fewer fits any parameters."""
MANY_PAIRS = 100_000
"""Number of pairs from which on fewer of them per node determine a fine map."""
FINE_PAIRS_PER_NODE, FINE_PAIRS_PER_NODE_OF_MANY = 4.2, 3.9
"""Smallest number of equations per unknown of a map with more than one node per pixel along each axis: of a recording
with few pairs, and of one with :data:`MANY_PAIRS`."""
FEWEST_TURNS = 2
"""Number of turns of the prism that are always used, if the recording has them."""
EVENTS_PER_PAIR = 10
"""Number of events that are copied ahead for each wanted pair. The tiles hold about a tenth of the events as pairs."""
FEWEST_TILES = 6
"""Number of tiles of the scene that are always used."""


class _PairCollector:
    """Collector of pairs of events that fall on the same tile, compensated by the result of the sharpness stage."""

    def __init__(
        self,
        recording: Recording,
        search: Search,
        tile_of: NDArray[np.int32],
        near: NDArray[np.int32],
        sensor: SensorTiming,
        ahead: EventsAhead | None,
    ) -> None:
        """``tile_of`` is the tile of each pixel of the map, or -1; events of the pixels with ``near`` >= 0 are used."""
        self.recording, self.search, self.sensor, self._ahead = recording, search, sensor, ahead
        self._tile_of, self._near = (wp.array(a, dtype=int, device=search.device) for a in (tile_of, near))
        self._found: list[PairSet] = []
        self._done = 0

    def read(self, spans: list[tuple[int, int]]) -> int:
        """Collect the pairs of events inside the time spans [us], which extend those of earlier calls.

        Return the number of all pairs. Only new spans are read.
        """
        if len(spans) > self._done:
            self._found.append(self._new_pairs(spans[self._done :]))
            self._done = len(spans)
        return sum(map(len, self._found))

    def pairs(self) -> PairSet:
        """Return all pairs."""
        return PairSet.concatenate(self._found)

    def _new_pairs(self, spans: list[tuple[int, int]]) -> PairSet:
        search, source = self.search, self.recording.events
        space, best, calibration_events = search.space, search.best, search.calibration_events
        joined = None if self._ahead is None else self._ahead.take(spans)
        table = EventTable([source.between(*span) for span in spans], self._near, search.device, joined=joined)
        pairs = table.pairs(
            calibration_events.encoder, longest_gap_us=LONGEST_GAP_US, shortest_gap_us=2.0 * self.sensor.refractory_us,
            sensor=self.sensor, middle_us=space.middle_us,
        )  # fmt: skip
        if not len(pairs):
            return pairs
        if calibration_events.slope_of is not None:
            pairs = pairs.with_slope(calibration_events.slope_of, space.middle_us)
        return pairs.on_tiles(space.build(best), space.camera_rotation(best), space.drift(best), self._tile_of)


def turn_length(recording: Recording, encoder: Encoder) -> float:
    """Return the duration of a turn of the prism [us]; the duration of the recording if it is shorter."""
    whole = float(recording.events.t_last - recording.events.t_first + 1)
    return min(60e6 / max(abs(encoder.rpm), 1e-6), whole)


def time_spans(recording: Recording, search: Search) -> list[tuple[int, int]]:
    """Return the time spans whose events give pairs, in the order of their use [us]: turns of the prism.

    A rotating camera needs successive turns, so it gets one span.
    """
    first, last = recording.events.t_first, recording.events.t_last
    if search.full_space.moving:
        return [(first, last + 1)]
    turn = turn_length(recording, search.calibration_events.encoder)
    turns = max(1, int((last - first + 1) / turn))
    return [(first + int(k * turn), first + int(k * turn) + int(turn)) for k in van_der_corput(turns)]


def upload_ahead(recording: Recording, search: Search) -> AbstractContextManager[EventsAhead | None]:
    """Start to copy the events that :func:`collect_pairs` will probably need to a GPU.

    Only events in memory are copied. On a CPU, or without a photometric stage, the context gives None.
    """
    device, source, settings = wp.get_device(search.device), recording.events, search.settings
    if device.is_cpu or not isinstance(source, MemoryEvents) or "photometric" not in settings.stages:
        return nullcontext()
    most = EVENTS_PER_PAIR * settings.photometric.pairs
    return EventsAhead(source, time_spans(recording, search), most, device)


def collect_pairs(
    recording: Recording, search: Search, settings: PhotometricSettings, ahead: EventsAhead | None = None
) -> tuple[PairSet, Tiles]:
    """Return about ``settings.pairs`` pairs of events, from whole turns spread over the recording, and the map's tiles.

    At least :data:`FEWEST_TURNS` turns are used, if the recording has them. If these hold too many pairs, whole tiles
    are left out: fewer pairs on the same tiles would not determine the map. ``ahead``: events already on the device.
    """
    first = recording.events.t_first
    turn = turn_length(recording, search.calibration_events.encoder)
    margin = ROTATION_MARGIN_PX if search.full_space.moving else MARGIN_PX
    if len(recording.events.between(first, first + int(FEWEST_TURNS * turn) + 1)) <= settings.pairs:
        tile_of, tiles = one_tile(*recording.events.size, settings.density, margin)
    else:
        tile_of, tiles = choose_tiles(search.fine.image(search.best), search.pad, settings.density, margin)
    near = near_tiles(tiles, margin, math.ceil(reach(search.space, search.best)) + 1, tile_of.shape)
    collector = _PairCollector(recording, search, tile_of, near, settings.sensor, ahead)
    spans = time_spans(recording, search)
    many = min(FEWEST_TURNS, len(spans))
    found = collector.read(spans[:many])
    while found < settings.pairs and many < len(spans):
        many = min(len(spans), max(many + 1, math.ceil(many * settings.pairs / max(found, 1))))
        found = collector.read(spans[:many])
    pairs, count = collector.pairs(), len(tiles.origin)
    keep = max(FEWEST_TILES, round(count * settings.pairs / max(len(pairs), 1)))
    if keep >= count:
        return pairs, tiles
    return pairs.of_tiles(np.isin(np.arange(count), van_der_corput(count)[:keep])), tiles


def van_der_corput(n: int) -> list[int]:
    """Return 0 … n-1 in van der Corput's order: the first k numbers are evenly spread for every k."""
    bits = max(1, (n - 1).bit_length())
    order = (int(f"{k:0{bits}b}"[::-1], 2) for k in range(1 << bits))
    return [k for k in order if k < n]


def pairs_per_node(coverage: NDArray[np.float32], pairs: int) -> float:
    """Return the number of pairs of events per node of the map that they touch."""
    return pairs / max(1, int((coverage > 0.5).sum()))


def fine_map_is_determined(coverage: NDArray[np.float32], pairs: int) -> bool:
    """Return whether there are enough pairs for a map with more than one node per pixel along each axis."""
    fewest = FINE_PAIRS_PER_NODE_OF_MANY if pairs >= MANY_PAIRS else FINE_PAIRS_PER_NODE
    return pairs_per_node(coverage, pairs) >= fewest


def check_pairs(name: str, coverage: NDArray[np.float32], pairs: int) -> float:
    """Return 1 minus the ratio of map unknowns to pairs of events; raise :class:`AmiwarpError` for too few pairs."""
    ratio = pairs_per_node(coverage, pairs)
    if pairs < FEWEST_PAIRS or ratio < PAIRS_PER_NODE:
        raise AmiwarpError(
            f"{name}: {pairs} pairs of events are too few for the {pairs / ratio:.0f} unknowns of a brightness map; "
            "record for longer"
        )
    return 1.0 - 1.0 / ratio
