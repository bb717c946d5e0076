"""Pairs of successive events of a pixel, and the parts of the scene that the photometric stage maps."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from numpy.typing import NDArray

from amiwarp.brightness.event_table import EventTable
from amiwarp.brightness.pairs import PairSet
from amiwarp.brightness.sensor_timing import SensorTiming
from amiwarp.brightness.tiles import Tiles
from amiwarp.calib.photometric.pair_spans import (
    most_pairs,
    time_spans,
    turn_length,
    van_der_corput,
)
from amiwarp.calib.photometric.tiles import choose_tiles, near_tiles, one_tile
from amiwarp.calib.settings import PhotometricSettings
from amiwarp.calib.sharpness_objective import reach
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Events, Recording
from amiwarp.optics.models.registry import MODELS

if TYPE_CHECKING:
    from amiwarp.calib.events_ahead import EventsAhead
    from amiwarp.calib.sharpness_search import Search

MARGIN_PX = 3
"""Border of a tile's brightness map for events that a change of the parameters moves, for a still camera [px]."""
ROTATION_MARGIN_PX = 8
"""The same for a rotating camera [px]."""
LONGEST_GAP_US = 60_000
"""Longest time between the two events of a pair [us]. Noise makes longer gaps unreliable."""
LONGEST_PATH_GAP_US = 200_000
"""The same for pairs that tell the path of the prism's angle: while the prism starts from rest, events come slowly."""
FEWEST_PAIRS = 1_500
"""Smallest number of pairs of events for the photometric stage."""
PAIRS_PER_NODE = 1.5
"""Smallest number of equations per unknown of the brightness map. A map with fewer fits any parameters."""
MANY_PAIRS = 100_000
"""Number of pairs above which fewer of them per node determine a fine map."""
FINE_PAIRS_PER_NODE = 4.2
"""Smallest number of equations per unknown of a map with more than one node per pixel along each axis, of a recording
with few pairs."""
FINE_PAIRS_PER_NODE_OF_MANY = 3.9
"""The same for a recording with :data:`MANY_PAIRS`."""
FEWEST_TURNS = 2
"""Number of turns of the prism that are always used, if the recording has them."""
EVENTS_AT_A_TIME = 4_000_000
"""Mean number of events in each of the time spans that are read one after the other."""
FEWEST_TILES = 6
"""Number of tiles of the scene that are always used."""
FEWEST_OF_SECTOR = 20
"""Median number of events of a part of a turn above which silence is looked for. The model tells the number of parts.
"""
SILENT_SHARE = 0.05
"""Share of that number below which a part of a turn is silent."""


class _PairCollector:
    """Collector of pairs of events that fall on the same tile, compensated by the result of the sharpness stage."""

    def __init__(
        self,
        recording: Recording,
        search: Search,
        tile_of: NDArray[np.int32],
        near: NDArray[np.int32],
        sensor: SensorTiming,
        *,
        ahead: EventsAhead | None = None,
        longest_gap_us: int = LONGEST_GAP_US,
    ) -> None:
        """``tile_of`` is the tile of each pixel of the map, or -1; events of the pixels with ``near`` >= 0 are used.

        ``ahead`` are events that are on the device already.
        """
        self._recording = recording
        self._search = search
        self._sensor = sensor
        self._ahead = ahead
        self._longest_gap_us = longest_gap_us
        self._tile_of = wp.array(tile_of, dtype=int, device=search.device)
        self._near = wp.array(near, dtype=int, device=search.device)
        self._found: list[PairSet] = []
        self._done = 0
        self._heard_us = 0
        self._read_us = 0

    @property
    def silent_share(self) -> float:
        """Share of the time in which no events came."""
        return 1.0 - self._heard_us / max(1, self._read_us)

    def read(self, spans: list[tuple[int, int]]) -> int:
        """Collect the pairs of events inside the time spans [us], which extend the spans of earlier calls.

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
        search = self._search
        source = self._recording.events
        space = search.space
        best = search.best
        calibration_events = search.calibration_events
        joined = None if self._ahead is None else self._ahead.take(spans)
        turn_us = turn_length(self._recording, calibration_events.encoder)
        sector_us = turn_us / MODELS[space.model].SECTORS
        parts: list[Events] = []
        for span in spans:
            parts += split_at_silence(source.between(*span), sector_us)
        self._heard_us += sum(int(part.t[-1]) - int(part.t[0]) for part in parts)
        self._read_us += sum(stop - start for start, stop in spans)
        if joined is not None and sum(map(len, parts)) < len(joined):
            joined = None  # events next to silence must not be taken as successive ones
        table = EventTable(parts, self._near, search.device, joined=joined)
        pairs = table.pairs(
            calibration_events.encoder,
            longest_gap_us=self._longest_gap_us,
            shortest_gap_us=2.0 * self._sensor.pause_us,
            sensor=self._sensor,
            middle_us=space.middle_us,
        )
        if not len(pairs):
            return pairs
        if calibration_events.slope_of is not None:
            pairs = pairs.with_slope(calibration_events.slope_of, space.middle_us)
        return pairs.on_tiles(
            space.build(best), space.camera_rotation(best), space.drift(best), self._tile_of
        )


def split_at_silence(events: Events, length_us: float) -> list[Events]:
    """Return the events in parts, without the silence between them: times of ``length_us`` and more with few events.

    Where a sensor or its link loses all events for a while, the next event of a pixel does not follow the last one.
    """
    t = events.t
    if not len(t):
        return []
    edges = np.arange(int(t[0]), int(t[-1]) + length_us, length_us)
    # Real numbers would make a copy of all times
    at = np.searchsorted(t, np.ceil(edges).astype(np.int64))
    counts = np.diff(at)
    if not len(counts) or np.median(counts) < FEWEST_OF_SECTOR:
        return [events]

    # Successive times with events are one part.
    heard = (counts >= SILENT_SHARE * np.median(counts)).astype(np.int8)
    change = np.diff(np.concatenate([[0], heard, [0]]))
    starts = at[np.flatnonzero(change == 1)].tolist()
    stops = at[np.flatnonzero(change == -1)].tolist()
    return [events[start:stop] for start, stop in zip(starts, stops, strict=True)]


@dataclass(frozen=True)
class CollectedPairs:
    """Pairs of events of a recording, and the tiles of the scene on which they fall."""

    pairs: PairSet
    tiles: Tiles
    silent_share: float
    """Share of the time in which no events came."""


def collect_pairs(
    recording: Recording,
    search: Search,
    settings: PhotometricSettings,
    *,
    always_tiles: bool = False,
    ahead: EventsAhead | None = None,
) -> CollectedPairs:
    """Return pairs of events from whole turns spread over the recording.

    There are about :func:`most_pairs` pairs. At least :data:`FEWEST_TURNS` turns are used, if the recording has them.
    If these hold too many pairs, whole tiles are left out: fewer pairs on the same tiles would not determine the map.
    If they hold few, the whole image is one tile, unless ``always_tiles``. ``ahead`` are events that are on the device
    already.
    """
    first = recording.events.t_first
    most = most_pairs(search)
    turn = turn_length(recording, search.calibration_events.encoder)
    margin = ROTATION_MARGIN_PX if search.full_space.moving else MARGIN_PX
    few = len(recording.events.between(first, first + int(FEWEST_TURNS * turn) + 1)) <= most
    if few and not always_tiles:
        tile_of, tiles = one_tile(*recording.events.size, settings.density, margin)
    else:
        image = search.fine.image(search.best)
        tile_of, tiles = choose_tiles(image, search.pad, settings.density, margin)
    far = math.ceil(reach(search.space, search.best)) + 1
    near = near_tiles(tiles, margin, far, tile_of.shape)

    # Read turns until there are enough pairs.
    collector = _PairCollector(recording, search, tile_of, near, settings.sensor, ahead=ahead)
    spans = time_spans(recording, search)
    many = min(FEWEST_TURNS, len(spans))
    found = collector.read(spans[:many])
    while found < most and many < len(spans):
        many = min(len(spans), max(many + 1, math.ceil(many * most / max(found, 1))))
        found = collector.read(spans[:many])

    # Leave out whole tiles if there are too many.
    pairs = collector.pairs()
    count = len(tiles.origin)
    keep = max(FEWEST_TILES, round(count * most / max(len(pairs), 1)))
    if keep < count:
        pairs = pairs.of_tiles(np.isin(np.arange(count), van_der_corput(count)[:keep]))
    return CollectedPairs(pairs, tiles, collector.silent_share)


def collect_everywhere(
    recording: Recording, search: Search, settings: PhotometricSettings, most: int, most_tiles: int
) -> tuple[PairSet, Tiles]:
    """Return about ``most`` pairs of events from all times of a recording, and at most ``most_tiles`` tiles.

    The pairs come from pixels that are evenly spread over the tiles.
    """
    source = recording.events
    image = search.fine.image(search.best)
    tile_of, tiles = choose_tiles(image, search.pad, settings.density, MARGIN_PX)
    used = van_der_corput(len(tiles.origin))[:most_tiles]
    # The last one stands for pixels without a tile
    number = np.full(len(tiles.origin) + 1, -1, np.int32)
    number[used] = np.arange(len(used))
    tile_of = number[tile_of]
    tiles = replace(tiles, origin=tiles.origin[used])

    # Few pixels, from the whole recording.
    far = math.ceil(reach(search.space, search.best)) + 1
    near = near_tiles(tiles, MARGIN_PX, far, tile_of.shape)
    share = most / max(1.0, len(source) * float(np.mean(tile_of >= 0)))
    near[np.random.default_rng(0).random(near.shape) >= share] = -1
    collector = _PairCollector(
        recording, search, tile_of, near, settings.sensor, longest_gap_us=LONGEST_PATH_GAP_US
    )
    parts = -(-len(source) // EVENTS_AT_A_TIME)
    edges = np.linspace(source.t_first, source.t_last + 1, parts + 1).astype(np.int64).tolist()
    spans = [*itertools.pairwise(edges)]
    for k in range(parts):
        collector.read(spans[: k + 1])
    return collector.pairs(), tiles


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
            "record for longer",
            ErrorCode.CALIBRATION_REFUSED,
        )
    return 1.0 - 1.0 / ratio
