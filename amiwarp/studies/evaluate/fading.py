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
from amiwarp.studies.evaluate.claims import Claim, Differences, differences, judge, untestable
from amiwarp.studies.evaluate.conditions import INDEX, Condition, Settings
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    Count,
    Table,
    grouped,
    rows_of,
    where,
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
LEAST_EVENTS = 20.0
"""Smallest mean number of events of a tile in a part of a turn. Tiles with less texture say nothing."""
DIP = (0.0, 0.5)
USUAL = (0.75, 1.25)
"""Classes of the relative speed that are compared: cancelling motion, and the prism alone."""
FADED = 0.25
"""Loss of the event rate of a tile at which its texture fades, relative to its mean."""
SMALL = 0.25
"""Loss of the event rate of the whole image up to which it is small, relative to its mean."""
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
    part_us = round(60e6 / condition.rpm / PARTS)
    end_us = min(streams.end_us - part_us + 1, MOST_TURNS * PARTS * part_us)
    orbit = orbit_speed(condition)
    is_first = condition.seed == settings.first_seed
    has_film = is_first and condition.trajectory == "fast" and condition.rpm == 720.0

    # For each part of a turn: events of the image and of each tile, and speeds of each tile relative to the prism's
    image_counts = []
    tile_counts = []
    speeds = []
    camera_speeds = []
    film = []
    for start in range(0, end_us, part_us):
        events = streams.window(Stream.RAW, start, start + part_us)
        image_counts.append(len(events))
        tile_counts.append(_tile_sums(events.x, events.y, np.ones(len(events)), streams.size))
        frame = streams.frame(start + part_us // 2)
        speeds.append(_mean_speed(frame.flow_with_prism, streams.size) / orbit)
        camera_speed = _mean_speed(frame.flow, streams.size) / orbit
        camera_speeds.append(camera_speed)
        if has_film:
            film.append(_frame(events.x, events.y, streams.size, _marked(camera_speed)))

    width, _ = streams.size
    rates = 1e3 * np.array(tile_counts) / part_us
    tiles = {
        "part_ms": part_us * 1e-3,
        "columns": width // TILE,
        "rate": np.round(rates, 3).tolist(),
        "speed": np.round(speeds, 3).tolist(),
        "camera_speed": np.round(camera_speeds, 3).tolist(),
    }
    lowest = min(image_counts) / max(float(np.mean(image_counts)), 1.0)
    return {
        "rows": _classes(np.array(tile_counts), np.array(speeds)),
        "whole": [{"lowest": lowest}],
        "film": film,
        "tiles": tiles if is_first else None,
    }


def _mean_speed(flow: NDArray[np.floating], size: tuple[int, int]) -> NDArray[np.float64]:
    """Return the mean speed of the image in each tile [px/s], shape (tiles,); 0 where the flow is unknown."""
    y, x = np.mgrid[: flow.shape[0], : flow.shape[1]]
    speed = np.nan_to_num(np.hypot(flow[..., 0], flow[..., 1]))
    return _tile_sums(x.ravel(), y.ravel(), speed.ravel(), size) / TILE**2


def _marked(camera_speed: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which tiles the camera alone moves about as fast as the prism does, by their relative speed."""
    slowest, fastest = USUAL
    return np.asarray((camera_speed >= slowest) & (camera_speed < fastest))


def _tile_rows(tiles: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each part of a turn and tile, of the tiles that :func:`measure` returns."""
    rate = np.array(tiles["rate"])
    speed = np.array(tiles["speed"])
    camera_speed = np.array(tiles["camera_speed"])
    marked = _marked(camera_speed)
    rows = []
    for part, tile in np.ndindex(rate.shape):
        row, column = divmod(tile, tiles["columns"])
        values = {
            "time_ms": (part + 0.5) * tiles["part_ms"],
            "column": column,
            "row": row,
            "rate": float(rate[part, tile]),
            "speed": float(speed[part, tile]),
            "camera_speed": float(camera_speed[part, tile]),
            "marked": bool(marked[part, tile]),
        }
        rows.append(values)
    return rows


def _tile_sums(
    x: NDArray[Any], y: NDArray[Any], weight: NDArray[Any], size: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the sums of the weights of places [px] in each tile that lies whole in the image, shape (tiles,)."""
    width, height = size
    columns = width // TILE
    rows = height // TILE
    column = x.astype(np.int64) // TILE
    row = y.astype(np.int64) // TILE
    in_tile = (column < columns) & (row < rows)
    tile = (row * columns + column)[in_tile]
    return np.asarray(np.bincount(tile, weight[in_tile], rows * columns), np.float64)


def _classes(counts: NDArray[np.float64], speeds: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Return the mean relative event rate of each class of relative speed. Arrays of shape (parts, tiles)."""
    mean = counts.mean(axis=0)
    textured = mean >= LEAST_EVENTS
    relative = counts[:, textured] / mean[textured]
    speed = speeds[:, textured]
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
    pixel = y.astype(np.int64) * width + x
    counts = np.bincount(pixel, minlength=width * height).reshape(height, width)
    grey = (255 - np.minimum(255, 85 * counts)).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, axis=2)
    for index in np.flatnonzero(marked).tolist():
        row, column = divmod(index, width // TILE)
        tile = picture[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
        tile[[0, -1]] = RED
        tile[:, [0, -1]] = RED
    return encode_picture(picture)


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the relative event rate over the relative speed, and the rate of every tile over time."""
    classes = _with_speed_of_prism(rows_of(results, "rows"))
    images = _with_speed_of_prism(rows_of(results, "whole"))
    speed = "speed through the prism / δ·2πf"
    return [
        Table(
            "fading",
            "Event rate where camera and prism cancel",
            ("camera", "prism", speed, "seeds", "relative rate", "std"),
            grouped(classes, ("camera", "prism", "speed"), ["rate"]),
            "Rate of a tile relative to its mean over the recording. Near 0 the motions cancel; 1 is the prism's own "
            "speed.",
            Chart(speed, "relative rate", "camera", "std", panels=("prism",)),
        ),
        Table(
            "fading_whole",
            "Lowest event rate of the whole image",
            ("camera", "prism", "seeds", "relative rate", "std"),
            grouped(images, ("camera", "prism"), ["lowest"]),
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
                speed,
                "camera's speed / δ·2πf",
                "camera as fast as the prism",
            ),
            [tuple(row[name] for name in TILE_COLUMNS) for row in _rows_of_tiles(results)],
            f"Tiles of {TILE} px, raw events, first seed.",
            long=True,
        ),
    ]


def _with_speed_of_prism(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows with the speed of the prism in words."""
    return [{**row, "prism": f"{row['rpm']:g} rpm"} for row in rows]


def _rows_of_tiles(results: Sequence[CellResult]) -> list[dict[str, Any]]:
    """Return a row for each part of a turn and tile of all results that have tiles."""
    rows = []
    for result in results:
        condition = result.condition
        if isinstance(condition, Condition) and result.values.get("tiles"):
            known = {"camera": condition.trajectory, "rpm": condition.rpm}
            rows += [{**known, **row} for row in _tile_rows(result.values["tiles"])]
    return rows


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
    rows = where(rows_of(results, "rows"), camera="fast")
    images = where(rows_of(results, "whole"), camera="fast")
    loss = _loss_in_dip(rows)
    relative_rate = (
        "the event rate below half of the speed δ·2πf relative to that at 0.75 to 1.25 of it"
    )
    return [
        judge(
            5,
            "Texture fades where the camera's motion cancels the prism's.",
            loss,
            relative_rate,
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
            # The speed is the paper's.
            {"room": _shares_of_dip(where(rows, rpm=Condition.rpm))},
            "the share of tiles and moments below half of the speed δ·2πf",
            below=RARE,
        ),
        judge(
            None,
            f"The event rate of the whole image falls by less than {SMALL:.0%}.",
            differences(images, "lowest", {}, by=("scene", "rpm")),
            "the event rate in the worst twelfth of a turn relative to its mean",
            above=1.0 - SMALL,
        ),
        judge(
            None,
            "The event rate of the tiles concerned falls by less than half.",
            loss,
            relative_rate,
            above=-0.5,
        ),
    ]


def _loss_in_dip(rows: Sequence[dict[str, Any]]) -> Differences:
    """Return the change of the event rate where the motions cancel, relative to where only the prism moves."""
    of_class = []
    for row in rows:
        for name, (low, high) in (("dip", DIP), ("usual", USUAL)):
            if low <= row["speed"] <= high:
                of_class.append(row | {"class": name})
    return differences(
        of_class, "rate", {"class": "dip"}, {"class": "usual"}, by=("scene", "rpm"), relative=True
    )


def _shares_of_dip(rows: Sequence[dict[str, Any]]) -> dict[int, float]:
    """Return the share of tiles and moments in which the motions cancel, by seed."""
    tiles: dict[int, int] = {}
    tiles_in_dip: dict[int, int] = {}
    for row in rows:
        seed = row["seed"]
        tiles[seed] = tiles.get(seed, 0) + row["tiles"]
        if row["speed"] < DIP[1]:
            tiles_in_dip[seed] = tiles_in_dip.get(seed, 0) + row["tiles"]
    return {seed: tiles_in_dip.get(seed, 0) / count for seed, count in tiles.items()}
