"""Evaluation of fading: event rate of parts of the image over time, where the camera's motion cancels the prism's."""

import itertools
import math
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from amiwarp.errors import AmiwarpError
from amiwarp.optics.prism import Prism
from amiwarp.studies.evaluate.claims import Claim, differences, judge, untestable
from amiwarp.studies.evaluate.conditions import INDEX, Condition, Settings
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    Count,
    Table,
    grouped,
    rows_of,
)
from amiwarp.studies.evaluate.stored_pictures import (
    Picture,
    check_pictures,
    decode_picture,
    encode_picture,
)
from amiwarp.studies.evaluate.streams import Stream, Streams
from amiwarp.validation import whole

TITLE = "Perceptual fading"
PROTOCOL = (
    "The image moves behind the prism at the speed δ·2πf, where δ is the radius of the orbit in pixels and f the "
    "turns per second, in a direction that turns with the prism. Where the camera moves the image at the same speed "
    "in the opposite direction, both cancel. The image is divided into tiles, and the first two turns into 12 parts "
    "each. The event rate of a tile, relative to its mean, is set against the speed of the image through the prism, "
    "which the ground truth states, relative to δ·2πf. The whole image is degraded by its event rate "
    "in the worst of the parts of a turn, relative to its mean. A table of the first seed holds the rate of every tile "
    "over time, and marks the tiles where the camera alone moves the image at 0.75 to 1.25 of δ·2πf; the film marks "
    "them in red."
)
DIFFERENCES = "The paper shows single moments of a film. Here the rate is measured over all tiles and moments."
VERSION = 4
NEEDS_TRUTH = True

PARTS = 12
MOST_TURNS = 2
"""Parts of a turn, and largest number of turns from the start of the recording."""
TILE = 30
"""Size of a tile [px]."""
EDGES = (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0)
"""Limits of the classes of the relative speed."""
LEAST_RATE = 20.0
"""Smallest mean number of events of a tile in a part of a turn. Tiles with less texture say nothing."""
DIP = (0.0, 0.5)
USUAL = (0.75, 1.25)
"""Classes of the relative speed that are compared: cancelling motion, and the prism alone."""
FADED = 0.25
SMALL = 0.25
"""Loss of the event rate of a tile at which its texture fades, and of the whole image up to which it is small."""
RARE = 0.1
"""Share of tiles and moments up to which cancelling motion counts as rare."""
TILE_COLUMNS = (
    "camera",
    "rpm",
    "time_ms",
    "column",
    "row",
    "rate",
    "speed",
    "camera_speed",
    "marked",
)
"""Values of the table of tiles."""
RED = (213, 94, 0)
"""Colour of the borders of marked tiles in the film."""


class _Row(TypedDict):
    speed: Amount
    rate: Amount
    tiles: Count


class _Whole(TypedDict):
    lowest: Amount


class _Tiles(TypedDict):
    part_ms: Amount
    columns: Annotated[int, partial(whole, low=1, high=10_000)]
    rate: list[list[Amount]]
    speed: list[list[Amount]]
    camera_speed: list[list[Amount]]


def _checked_film(film: list[str], what: str) -> list[str]:
    check_pictures(film, 3, what)
    return film


def _checked_tiles(tiles: _Tiles, what: str) -> _Tiles:
    """Return the tiles if their tables have the same number of values in each row."""
    lengths = {
        tuple(map(len, table)) for table in (tiles["rate"], tiles["speed"], tiles["camera_speed"])
    }
    if len(lengths) > 1 or any(len(set(rows)) != 1 for rows in lengths):
        raise AmiwarpError(
            f"{what} has rows of unequal lengths; expected three tables of one shape"
        )
    return tiles


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]
    whole: list[_Whole]
    film: Annotated[list[str], _checked_film]
    tiles: Annotated[_Tiles, _checked_tiles] | None


def conditions(settings: Settings) -> list[Condition]:
    """Return fast motion through the room, whose speed comes near the prism's; in full also rest."""
    more = [("still", 720.0), ("fast", 360.0), ("fast", 1440.0)]
    cases = [("fast", 720.0)] + ([] if settings.quick else more)
    return [
        c
        for motion, rpm in cases
        for c in settings.conditions(world="room", trajectory=motion, rpm=rpm)
    ]


def orbit_speed(condition: Condition) -> float:
    """Return the speed of the image behind the prism, δ·2πf [px/s]."""
    radius = math.tan(Prism(condition.apex, INDEX).deflection) * condition.focal_px
    return radius * 2.0 * math.pi * condition.rpm / 60.0


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return the relative event rate by class of relative speed, the lowest one of the whole image, tiles and film."""
    condition = streams.condition
    length = round(60e6 / condition.rpm / PARTS)
    starts = range(0, min(streams.end_us - length + 1, MOST_TURNS * PARTS * length), length)
    orbit = orbit_speed(condition)
    numbers = []
    counts = []
    speeds = []
    cameras = []
    frames = []
    is_first = condition.seed == settings.first_seed
    film = is_first and condition.trajectory == "fast" and condition.rpm == 720.0
    for start in starts:
        events = streams.window(Stream.RAW, start, start + length)
        numbers.append(len(events))
        counts.append(_tiles(events.x, events.y, np.ones(len(events)), streams.size))
        frame = streams.frame(start + length // 2)
        speeds.append(_mean_speed(frame.flow_with_prism, streams.size) / orbit)
        cameras.append(_mean_speed(frame.flow, streams.size) / orbit)
        if film:
            frames.append(_frame(events.x, events.y, streams.size, _marked(cameras[-1])))
    rows = _classes(np.array(counts), np.array(speeds))
    width, _ = streams.size
    rates = 1e3 * np.array(counts) / length
    tiles = {
        "part_ms": length * 1e-3,
        "columns": width // TILE,
        "rate": np.round(rates, 3).tolist(),
        "speed": np.round(speeds, 3).tolist(),
        "camera_speed": np.round(cameras, 3).tolist(),
    }
    lowest = min(numbers) / max(float(np.mean(numbers)), 1.0)
    return {
        "rows": rows,
        "whole": [{"lowest": lowest}],
        "film": frames,
        "tiles": tiles if is_first else None,
    }


def _mean_speed(flow: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.float64]:
    """Return the mean speed of the image in each tile [px/s], shape (tiles,); 0 where the flow is unknown."""
    y, x = np.mgrid[: flow.shape[0], : flow.shape[1]]
    speed = np.nan_to_num(np.hypot(flow[..., 0], flow[..., 1]))
    return _tiles(x.ravel(), y.ravel(), speed.ravel(), size) / TILE**2


def _marked(camera: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the tiles that the camera alone moves about as fast as the prism does, by their relative speed."""
    return np.asarray((camera >= USUAL[0]) & (camera < USUAL[1]))


def _tile_rows(tiles: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each part of a turn and tile, of the tiles that :func:`measure` returns."""
    rate = np.array(tiles["rate"])
    speed = np.array(tiles["speed"])
    camera = np.array(tiles["camera_speed"])
    marked = _marked(camera)
    rows = []
    for part, tile in np.ndindex(rate.shape):
        row, column = divmod(tile, tiles["columns"])
        values = {
            "time_ms": (part + 0.5) * tiles["part_ms"],
            "column": column,
            "row": row,
            "rate": float(rate[part, tile]),
            "speed": float(speed[part, tile]),
            "camera_speed": float(camera[part, tile]),
            "marked": bool(marked[part, tile]),
        }
        rows.append(values)
    return rows


def _tiles(
    x: NDArray[Any], y: NDArray[Any], weight: NDArray[Any], size: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the sums of the weights in each whole tile."""
    width, height = size
    columns = width // TILE
    rows = height // TILE
    column = x.astype(np.int64) // TILE
    row = y.astype(np.int64) // TILE
    whole = (column < columns) & (row < rows)
    tile = (row * columns + column)[whole]
    return np.asarray(np.bincount(tile, weight[whole], rows * columns), np.float64)


def _classes(counts: NDArray[np.float64], speeds: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Return the mean relative event rate of each class of relative speed. Arrays of shape (parts, tiles)."""
    mean = counts.mean(axis=0)
    good = mean >= LEAST_RATE
    relative = counts[:, good] / mean[good]
    speed = speeds[:, good]
    rows = []
    for low, high in itertools.pairwise(EDGES):
        chosen = (speed >= low) & (speed < high)
        if chosen.any():
            rate = float(relative[chosen].mean())
            rows.append({"speed": (low + high) / 2.0, "rate": rate, "tiles": int(chosen.sum())})
    return rows


def _frame(
    x: NDArray[Any], y: NDArray[Any], size: tuple[int, int], marked: NDArray[np.bool_]
) -> str:
    """Return the events of a part of a turn as a frame of the film: white without events, black with many events.

    The borders of marked tiles are red.
    """
    width, height = size
    counts = np.bincount(y.astype(np.int64) * width + x, minlength=width * height).reshape(
        height, width
    )
    picture = np.repeat((255 - np.minimum(255, 85 * counts)).astype(np.uint8)[..., None], 3, axis=2)
    for tile in np.flatnonzero(marked).tolist():
        row, column = divmod(tile, width // TILE)
        part = picture[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
        part[[0, -1]] = RED
        part[:, [0, -1]] = RED
    return encode_picture(picture)


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the relative event rate over the relative speed, and the rate of every tile over time."""
    rows = [{**row, "prism": f"{row['rpm']:g} rpm"} for row in rows_of(results, "rows")]
    whole = [{**row, "prism": f"{row['rpm']:g} rpm"} for row in rows_of(results, "whole")]
    tiles = []
    for result in results:
        condition = result.condition
        if isinstance(condition, Condition) and result.values.get("tiles"):
            known = {"camera": condition.trajectory, "rpm": condition.rpm}
            tiles += [{**known, **row} for row in _tile_rows(result.values["tiles"])]
    x = "speed through the prism / δ·2πf"
    return [
        Table(
            "fading",
            "Event rate where camera and prism cancel",
            ("camera", "prism", x, "seeds", "relative rate", "std"),
            grouped(rows, ("camera", "prism", "speed"), ["rate"]),
            "Rate of a tile relative to its mean over the recording. Near 0 the motions cancel; 1 is the prism's own "
            "speed.",
            Chart(x, "relative rate", "camera", "std", panels=("prism",)),
        ),
        Table(
            "fading_whole",
            "Lowest event rate of the whole image",
            ("camera", "prism", "seeds", "relative rate", "std"),
            grouped(whole, ("camera", "prism"), ["lowest"]),
            "Rate in the worst twelfth of a turn relative to the mean over up to two turns.",
        ),
        Table(
            "fading_tiles",
            "Event rate of every tile over time",
            (
                "camera",
                "rpm",
                "time [ms]",
                "tile column",
                "tile row",
                "rate [kev/s]",
                x,
                "camera's speed / δ·2πf",
                "camera as fast as the prism",
            ),
            [tuple(r[k] for k in TILE_COLUMNS) for r in tiles],
            f"Tiles of {TILE} px, raw events, first seed.",
            long=True,
        ),
    ]


def pictures(results: Sequence[CellResult]) -> list[Picture]:
    """Return the film of the first seed, ten times slower or more."""
    films = [r for r in results if r.values.get("film")]
    if not films:
        return []
    frames = [decode_picture(text) for text in films[0].values["film"]]
    caption = (
        "Raw events of the AMI-EV moving fast, one frame for each twelfth of a turn (6.9 ms), slowed "
        "down. Red: tiles that the camera alone moves at 0.75 to 1.25 times the speed of the prism; they fade "
        "once a turn, where the motions cancel."
    )
    return [Picture("fading_film", caption, frames, 0.12)]


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the dip of the event rate, on its size, and on how rare it is."""
    rows = [r for r in rows_of(results, "rows") if r["camera"] == "fast"]
    classes = {"dip": DIP, "usual": USUAL}
    two = []
    for row in rows:
        for name, (low, high) in classes.items():
            if low <= row["speed"] <= high:
                two.append(row | {"class": name})
    found = differences(
        two, "rate", {"class": "dip"}, {"class": "usual"}, by=("scene", "rpm"), relative=True
    )
    what = "the event rate below half of the speed δ·2πf relative to that at 0.75 to 1.25 of it"
    shares: dict[str, dict[int, float]] = {}
    for seed in dict.fromkeys(
        r["seed"] for r in rows if r["rpm"] == Condition.rpm
    ):  # the paper's speed
        own = [r for r in rows if (r["rpm"], r["seed"]) == (Condition.rpm, seed)]
        dip = sum(r["tiles"] for r in own if r["speed"] < DIP[1])
        shares.setdefault("room", {})[seed] = dip / sum(r["tiles"] for r in own)
    return [
        judge(
            5,
            "Texture fades where the camera's motion cancels the prism's.",
            found,
            what,
            below=-FADED,
        ),
        untestable(
            5,
            "The degradation is small.",
            "the paper shows it in a film, without a measure; see the checks",
        ),
        judge(
            5,
            "These moments are rare (720 rpm).",
            shares,
            "the share of tiles and moments below half of the speed δ·2πf",
            below=RARE,
        ),
        judge(
            None,
            f"The event rate of the whole image falls by less than {SMALL:.0%}.",
            differences(
                [r for r in rows_of(results, "whole") if r["camera"] == "fast"],
                "lowest",
                {},
                by=("scene", "rpm"),
            ),
            "the event rate in the worst twelfth of a turn relative to its mean",
            above=1.0 - SMALL,
        ),
        judge(
            None,
            "The event rate of the tiles concerned falls by less than half.",
            found,
            what,
            above=-0.5,
        ),
    ]
