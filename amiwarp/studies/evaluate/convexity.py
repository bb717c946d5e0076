"""Evaluation of the calibration's cost over deflection and phase: its optimum, other minima, and where it is convex."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, TypedDict, get_args

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib.paper_method import WINDOW_US
from amiwarp.calib.phase_search import BANDS, PhaseObjective, tiles_of
from amiwarp.calib.phase_tiles import FINEST
from amiwarp.calib.preparation import prepare
from amiwarp.calib.settings import STAGES
from amiwarp.calib.settings import Settings as CalibrationSettings
from amiwarp.calib.sharpness_search import Search
from amiwarp.choices import Sharpness
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import MemoryEvents, Recording
from amiwarp.optics.prism import Prism
from amiwarp.studies.evaluate.claims import Claim, Differences, differences, judge, untestable
from amiwarp.studies.evaluate.conditions import DISCS, IDEAL, INDEX, Condition, Settings
from amiwarp.studies.evaluate.cost_shape import shape_of
from amiwarp.studies.evaluate.results import (
    Amount,
    CellResult,
    Chart,
    Count,
    Share,
    Table,
    grouped,
    rows_of,
)
from amiwarp.studies.evaluate.stored_pictures import Picture
from amiwarp.studies.evaluate.streams import Stream, Streams

TITLE = "Convexity of the calibration's cost"
PROTOCOL = (
    "A camera at rest records discs through the prism, with an ideal sensor and with the DVXplorer's model, and a "
    "room. The cost of compensating the events by the circle "
    "is computed over deflection (0.1 to 1.9 of the true one) and phase (a full turn), for windows of different "
    "lengths from the start of the recording: the paper's J = Σ 1/(1 + exp(h/η)) over pixels with h > 0 events, with "
    "η = 1 event; the same with an η so large that it counts the pixels with events; the cost of amiwarp's local "
    "search, minus the variance of the image of events over its mean; and the cost of its global search, the share of "
    "sums of events in phase with the prism that no scene explains, over long waves and over all waves. The optimum is "
    "the lowest cell of the grid. "
    "Convex is the region around it in which the Hessian over both parameters, of second differences, is positive "
    "definite. The basin is the share of the grid from which the steepest descent ends at the optimum. The error is "
    "the distance of the optimum's displacement from the true one; the true phase does not contain the sensor's delay."
)
DIFFERENCES = (
    "The paper's equations S1 and S3, its η and its proof are in its supplement, which was not at hand: J is the cost "
    "of its main text. An evenly thinned part of the events is used; all windows of a recording are thinned alike."
)
VERSION = 2
NEEDS_TRUTH = True

WINDOWS_S = (0.25, 0.5, 1.0, 2.0, 4.0)
QUICK_WINDOWS_S = (0.25, 2.0)
"""Lengths of the windows [s]; a recording is as long as the longest one."""
SIZES = np.linspace(0.1, 1.9, 19)
"""Deflections of the grid, relative to the true one."""
PHASES = np.radians(np.arange(-180.0, 180.0, 10.0))
"""Phases of the grid, relative to the true one [rad]."""
MOST_EVENTS = 4_000_000
QUICK_MOST_EVENTS = 400_000
"""Largest number of events of the longest window."""
CostName = Literal[
    "J, η = 1", "J, large η", "minus contrast", "phase, long waves", "phase, all waves"
]
"""Type of the name of a cost."""
PAPER, PIXELS, OURS, LONG_WAVES, ALL_WAVES = get_args(CostName)
NOISE_FREE = "ideal sensor"
"""Name of the sensor without limits and noise."""
SMALL = (160, 120)
"""Width and height of the image [px]."""
LEAST_PHASE_DEG = 10.0
"""Half range of phases, a step of the grid, above which a cost counts as convex around its optimum [deg]."""
LEAST_S = 0.25
LONGER_S = 4.0
"""Lengths of the windows that are compared with the paper's 2 s [s]."""
SOMETIMES = 0.05
LITTLE_PX = 0.5
"""Least share of recordings that counts as some, and largest gain that counts as little, a step of the grid [px]."""
FOUND_PX = 1.0
"""Largest error of an optimum that counts as found: what the grid and the sensor's delay leave [px]."""


class _Row(TypedDict):
    cost: CostName
    window: Amount
    events: Count
    error: Amount
    found: Share
    minima: Count
    basin: Share
    convex: Share
    size_half: Amount
    phase_half: Amount


def _checked_surface(surface: list[list[float]], what: str) -> list[list[float]]:
    if [len(row) for row in surface] != [len(PHASES)] * len(SIZES):
        raise AmiwarpError(f"{what} is not a table of {len(SIZES)} x {len(PHASES)} values")
    return surface


class _Surface(TypedDict):
    cost: CostName
    window: Amount
    values: Annotated[list[list[float]], _checked_surface]


class Values(TypedDict):
    """What :func:`measure` returns."""

    rows: list[_Row]
    surfaces: list[_Surface]


def conditions(settings: Settings) -> list[Condition]:
    """Return long recordings by a camera at rest: discs by two sensors, and in full a room."""
    seconds = max(QUICK_WINDOWS_S if settings.quick else WINDOWS_S)
    small = replace(settings, width=SMALL[0], height=SMALL[1], duration_s=seconds)
    cases = [
        (DISCS, IDEAL),
        (DISCS, None),
        *([] if settings.quick else [("room", None)]),
    ]
    return [
        c
        for world, only in cases
        for c in small.conditions(world=world, trajectory="still", only=only)
    ]


def measure(streams: Streams, settings: Settings) -> dict[str, Any]:
    """Return the shape of each cost for each window, and the surfaces of the first seed's 2 s."""
    lengths = QUICK_WINDOWS_S if settings.quick else WINDOWS_S
    most = QUICK_MOST_EVENTS if settings.quick else MOST_EVENTS
    total = streams.count(Stream.RAW, 0, round(max(lengths) * 1e6))
    step = max(1, -(-total // most))
    radius = math.tan(_deflection(streams)) * streams.camera.fx
    rows = []
    surfaces = []
    for seconds in lengths:
        for name, cost, events in _costs(streams, round(seconds * 1e6), step):
            shape = shape_of(cost)
            size, phase = shape.lowest
            error = radius * abs(SIZES[size] * np.exp(1j * PHASES[phase]) - 1.0)
            rows.append(
                {
                    "cost": name,
                    "window": seconds,
                    "events": events,
                    "error": error,
                    "found": float(error <= FOUND_PX),
                    "minima": shape.minima,
                    "basin": shape.basin,
                    "convex": float(shape.convex.mean()),
                    "size_half": shape.half_width(0) * float(SIZES[1] - SIZES[0]),
                    "phase_half": shape.half_width(1) * math.degrees(PHASES[1] - PHASES[0]),
                }
            )
            if streams.condition.seed == settings.first_seed and round(seconds * 1e6) == WINDOW_US:
                surfaces.append(
                    {"cost": name, "window": seconds, "values": np.round(cost, 4).tolist()}
                )
    return {"rows": rows, "surfaces": surfaces}


def _deflection(streams: Streams) -> float:
    return Prism(streams.condition.apex, INDEX).deflection


def _costs(
    streams: Streams, length_us: int, step: int
) -> list[tuple[str, NDArray[np.float64], int]]:
    """Return name and values of each cost over the grid, shape (sizes, phases), and the number of events."""
    recording = streams.recording
    assert recording.truth is not None
    events = recording.events.between(0, length_us)[::step]
    part = replace(recording, events=MemoryEvents(events, *streams.size))
    phase = recording.truth.parameters["phase"]
    costs = surfaces_of(part, _deflection(streams), phase, device=streams.device)
    return [(name, cost, len(events)) for name, cost in costs.items()]


def surfaces_of(
    recording: Recording, deflection: float, phase: float, *, device: str
) -> dict[str, NDArray[np.float64]]:
    """Return each cost by name over the grid about the true values [rad], shape (sizes, phases)."""

    def search_by(kind: Sharpness) -> Search:
        settings = CalibrationSettings(
            model="circle", sharpness=kind, events=len(recording.events), stages=STAGES[:1]
        )
        search, *_ = prepare(recording, settings, device=device)
        return search

    def over_grid(search: Search, cost: Callable[[dict[str, float]], Any]) -> NDArray[np.float64]:
        rows = []
        for size in SIZES:
            of_size = {**search.space.start, "deflection": size * deflection}
            rows.append([cost({**of_size, "phase": phase + shift}) for shift in PHASES])
        return np.array(rows)

    by_paper = search_by(Sharpness.PAPER_J)

    def costs_of_paper(point: dict[str, float]) -> tuple[float, float]:
        """Return J with η = 1, and J with a large η, which counts the pixels with events."""
        cost = -by_paper.fine.values(point)
        return cost, 0.5 * np.count_nonzero(by_paper.fine.image(point).numpy() > 0.0)

    paper, pixels = np.moveaxis(over_grid(by_paper, costs_of_paper), -1, 0)
    ours = search_by(Sharpness.VARIANCE)
    costs = {
        PAPER: paper,
        PIXELS: pixels,
        OURS: over_grid(ours, lambda point: -ours.fine.values(point)),
    }
    tiles = tiles_of(ours.calibration_events, ours.space)
    for name, finest in ((LONG_WAVES, BANDS[0]), (ALL_WAVES, FINEST)):
        in_phase = PhaseObjective(ours.space, tiles, finest)
        costs[name] = -over_grid(ours, in_phase.measure)[..., 0]
    return costs


def tables(results: Sequence[CellResult]) -> list[Table]:
    """Return the shape of the costs over the length of the window."""
    rows = _rows(results)
    values = ["error", "found", "minima", "basin", "size_half", "phase_half"]
    heads = (
        "error [px]",
        "std",
        "optimum found",
        "std of found",
        "minima",
        "std of minima",
        "basin",
        "std of basin",
        "convex, size ±",
        "std of size",
        "convex, phase ± [°]",
        "std of phase",
    )
    names = ("scene", "cost", "window [s]", "seeds")
    table_rows = grouped(rows, ("scene", "cost", "window"), values)
    return [
        Table(
            "convexity",
            "Optimum of the calibration's cost over the window",
            (*names, *heads),
            table_rows,
            f"An optimum is found if its error is at most {FOUND_PX:g} px.",
            Chart("window [s]", "error [px]", "cost", "std", panels=("scene",), log_x=True),
        ),
        Table(
            "convexity_domain",
            "Convex domain around the optimum",
            (*names, *heads),
            table_rows,
            "Half the range of phases through the optimum in which the cost is convex. The minima of the grid "
            "include noise.",
            Chart(
                "window [s]",
                "convex, phase ± [°]",
                "cost",
                "std of phase",
                panels=("scene",),
                log_x=True,
            ),
        ),
    ]


def _rows(results: Sequence[CellResult]) -> list[dict[str, Any]]:
    """Return the rows, with the sensor as part of the scene."""
    rows = rows_of(results, "rows")
    return [row | {"scene": _scene(row["world"], row["only"])} for row in rows]


def _scene(world: str, only: str | None) -> str:
    return world if only is None else f"{world}, {NOISE_FREE}"


def pictures(results: Sequence[CellResult]) -> list[Picture]:
    """Return the surfaces of the first seed as contours, with the convex domain."""
    drawn = []
    for result in results:
        condition = result.condition
        if isinstance(condition, Condition) and result.values.get("surfaces"):
            scene = _scene(condition.world, condition.only)
            caption = (
                f"Costs over deflection and phase, {scene}, 2 s, first seed. White: boundary of the "
                "convex domain. Cross: true values. Circle: lowest cell."
            )
            name = scene.replace(", ", "_").replace(" ", "_")
            frame = contours(result.values["surfaces"])
            drawn.append(Picture(f"convexity_{name}", caption, [frame]))
    return drawn


def contours(surfaces: Sequence[dict[str, Any]]) -> NDArray[np.uint8]:
    """Return a picture of the contours of costs, one panel each."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.4 * len(surfaces), 2.6), layout="constrained", dpi=150)
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(surfaces), squeeze=False, sharey=True).ravel()
    for ax, surface in zip(axes, surfaces, strict=True):
        cost = np.array(surface["values"])
        degrees = np.degrees(PHASES)
        shape = shape_of(cost)
        ax.contourf(degrees, SIZES, cost, levels=20, cmap="viridis")
        convex = shape.convex.astype(float)
        ax.contour(degrees, SIZES, convex, levels=[0.5], colors="white", linewidths=1.2)
        size, phase = shape.lowest
        ax.plot(degrees[phase], SIZES[size], "o", mfc="none", mec="white", ms=7)
        ax.plot(0.0, 1.0, "x", color="red", ms=6)
        ax.set_title(surface["cost"], fontsize=9)
        ax.set_xlabel("phase error [°]", fontsize=8)
        ax.set_xticks([-180, -90, 0, 90])
        ax.tick_params(labelsize=8)
    axes[0].set_ylabel("deflection / true", fontsize=8)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3].copy()


def claims(results: Sequence[CellResult]) -> list[Claim]:
    """Return the verdicts on the calibration from 2 s: its optimum, and the convexity of the cost around it."""
    rows = _rows(results)
    all_ideal = [row for row in rows if row["only"] is not None]
    all_noisy = [row for row in rows if row["only"] is None]
    ideal = _of_usual_length(all_ideal)
    noisy = _of_usual_length(all_noisy)
    return [
        untestable(
            16,
            "Recordings shorter than 2 s sometimes do not converge.",
            "a grid that holds the true values has nothing to converge, and the paper names no optimiser",
        ),
        *_lengths(16, PIXELS, all_ideal),
        *_lengths(None, OURS, all_noisy),
        # The paper states no η: its claim is about the one for which it can hold, and the others are checks.
        *_shape_claims(16, PIXELS, ideal, "ideal sensor"),
        *_shape_claims(None, PIXELS, noisy, "DVXplorer"),
        *_shape_claims(None, PAPER, ideal, "ideal sensor"),
        *_shape_claims(None, PAPER, noisy, "DVXplorer"),
        *_shape_claims(None, OURS, noisy, "DVXplorer"),
    ]


def _shape_claims(
    number: int | None, cost: str, rows: Sequence[dict[str, Any]], sensor: str
) -> list[Claim]:
    """Judge the optimum of a cost from 2 s: whether it is the true one, unique, and within a convex domain."""

    def values(column: str) -> Differences:
        return differences(rows, column, {"cost": cost}, by=("scene",))

    return [
        judge(
            number,
            f"With '{cost}' and 2 s, the optimum is the true one ({sensor}).",
            values("error"),
            "the error of the optimum",
            below=FOUND_PX,
            unit="px",
        ),
        judge(
            number,
            f"With '{cost}' and 2 s, the optimum is unique ({sensor}).",
            values("unique"),
            "the share of recordings with one minimum on the grid",
            above=1.0 - SOMETIMES,
        ),
        judge(
            number,
            f"With '{cost}' and 2 s, the cost is convex around the true values ({sensor}).",
            values("convex_deg"),
            "half the range of convex phases",
            above=LEAST_PHASE_DEG,
            unit="°",
        ),
    ]


def _of_usual_length(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of the paper's 2 s, with the range of convex phases, and whether there is one minimum."""
    chosen = []
    for row in rows:
        if row["window"] == WINDOW_US * 1e-6:
            convex_deg = row["phase_half"] * row["found"]
            unique = float(row["minima"] == 1)
            chosen.append(row | {"convex_deg": convex_deg, "unique": unique})
    return chosen


def _lengths(number: int | None, cost: str, rows: Sequence[dict[str, Any]]) -> list[Claim]:
    """Return the verdicts on recordings that are shorter and longer than the paper's 2 s, by a cost."""
    usual = {"cost": cost, "window": WINDOW_US * 1e-6}
    less = {"cost": cost, "window": LEAST_S}
    more = {"cost": cost, "window": LONGER_S}
    sensor = "(ideal sensor)" if number else "(DVXplorer)"
    return [
        judge(
            number,
            f"With '{cost}', {LONGER_S:g} s gain little over 2 s {sensor}.",
            differences(rows, "error", usual, more, by=("scene",)),
            f"the error of the optimum in 2 s less that in {LONGER_S:g} s",
            below=LITTLE_PX,
            unit="px",
        ),
        judge(
            None,
            f"With '{cost}' and {LEAST_S:g} s, the true optimum is sometimes not found on the grid {sensor}.",
            differences(rows, "found", less, usual, by=("scene",)),
            f"the share of recordings in which it is found in {LEAST_S:g} s less that in 2 s",
            below=-SOMETIMES,
        ),
    ]
