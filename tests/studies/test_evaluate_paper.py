"""Evaluations of timing errors, of the circle, of segmentation by object, of the calibration's cost and of fading."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from amiwarp import Camera, Events, ExactModel, Prism
from amiwarp.studies.evaluate import (
    QUICK,
    CellResult,
    Condition,
    Stream,
    Streams,
    Table,
    Verdict,
    apex_speed,
    convexity,
    edge_matches,
    edges,
    fading,
    overlaps,
)
from amiwarp.studies.evaluate.conditions import DISCS, IDEAL
from amiwarp.studies.evaluate.cost_shape import shape_of


def check_tables(evaluation: object, results: list[CellResult]) -> dict[str, Table]:
    """Return the tables by name, after a check of their columns."""
    tables: list[Table] = evaluation.tables(results)  # type: ignore[attr-defined]
    for table in tables:
        assert {len(row) for row in table.rows} <= {len(table.columns)}
        chart = table.chart
        if chart is not None:
            assert {chart.x, chart.y, chart.series, chart.spread, *chart.panels} <= {
                None,
                *table.columns,
            }
    return {table.name: table for table in tables}


# Timing errors and the circle.

APEX_DEG = 1.0


def usual(rpm: float, seed: int = 1) -> CellResult:
    """Return the result of the usual sensor in a small image."""
    condition = Condition(
        DISCS, "still", math.radians(APEX_DEG), rpm, seed, 60.0 / rpm, 120, 100, cutoff_hz=1000.0
    )
    values = json.loads(json.dumps(apex_speed.measure(Streams(condition), QUICK), allow_nan=False))
    return CellResult("apex_speed", condition, values)


@pytest.fixture(scope="module")
def cells() -> list[CellResult]:
    return [usual(rpm, seed) for rpm in (720.0, 1440.0) for seed in (1, 2)]


def test_timing_errors_displace_events_as_the_formula_says(cells: list[CellResult]) -> None:
    """An error ε of the clock turns the orbit of radius δ by ωε: the displacement is 2 δ sin(ωε/2)."""
    radius = 554.0 * math.tan(0.55 * math.radians(APEX_DEG))  # px: (n - 1) times the apex angle
    for cell in cells:
        assert isinstance(cell.condition, Condition)
        omega = cell.condition.rpm * 2.0 * math.pi / 60.0
        offset = 1e-3 * (1.0 - 720.0 / cell.condition.rpm)
        expected = {"none": 0.0, "drift": 2.0 * radius * math.sin(omega * 1e-3 / 2.0),
                    "offset, calibrated at 720 rpm": 2.0 * radius * math.sin(omega * offset / 2.0),
                    "slow wander": radius * omega * 1e-3, "error of each sample": radius * omega * 1e-3}  # fmt: skip
        found = {
            e["timing"]: e["displacement"]
            for e in cell.values["errors"]
            if e["model"] == apex_speed.EXACT
        }
        assert set(found) == set(expected)
        for kind, value in expected.items():
            # exact refraction makes the orbit larger than δ by 1 to 3 % within this image
            assert found[kind] == pytest.approx(value, rel=0.03, abs=1e-3), kind


def test_timing_errors_blur_edges(cells: list[CellResult]) -> None:
    """An offset displaces events along a circle of radius d: across an edge by d/√2 rms, or 0.88 d for the middle 68 %.

    It adds to the blur in squares.
    """
    for cell in cells:
        rows = {e["timing"]: e for e in cell.values["errors"] if e["model"] == apex_speed.EXACT}
        none, drift = rows["none"], rows["drift"]
        low, high = (
            none["blur"] ** 2 + share * drift["displacement"] ** 2 for share in (0.5, 0.88**2)
        )
        assert 0.9 * low < drift["blur"] ** 2 < 1.1 * high


def test_tables_and_verdicts_of_timing_errors(cells: list[CellResult]) -> None:
    whole = Condition(DISCS, "still", rpm=720.0, width=640, height=480, cutoff_hz=1000.0)
    wide = [CellResult("apex_speed", replace(whole, apex=math.radians(degrees), seed=seed), {"errors": [
                {"degrees": degrees, "model": model, "timing": timing, "error_us": us, "blur": 1.0, "edge_blur": 1.0,
                 "displacement": math.hypot(own * degrees, 4e-4 * us * degrees) + 0.01 * seed}
                for model, own in ((apex_speed.CIRCLE, 0.57), (apex_speed.EXACT, 0.0))
                for timing, us in ((apex_speed.NONE, 0.0), (apex_speed.WANDER, 1000.0))]})
            for degrees in (1.0, 2.0) for seed in (1, 2)]  # fmt: skip
    tables = check_tables(apex_speed, [*cells, *wide])
    assert len(tables["apex_speed_timing"].rows) == 10
    assert len(tables["apex_speed_models"].rows) == 8
    assert {row[1] for row in tables["apex_speed_circle"].rows} == {"60°", "77.3°", "90°"}
    verdict = {c.text: c.verdict for c in apex_speed.claims([*cells, *wide])}
    ours = [v for text, v in verdict.items() if text.startswith("With exact refraction")]
    assert ours == [Verdict.REPRODUCED, Verdict.NOT_REPRODUCED]  # 0 < 0.57 px, but 0.8 > 0.7 px
    assert [v for text, v in verdict.items() if "is larger than the error of 1°" in text] == [
        Verdict.REPRODUCED
    ] * 2
    system = [
        v for text, v in verdict.items() if text.startswith("The error of a system as the paper's")
    ]
    # 0.5° is not in these results
    assert system == [
        Verdict.NOT_TESTABLE,
        Verdict.REPRODUCED,
        Verdict.REPRODUCED,
    ]
    assert [v for text, v in verdict.items() if text.startswith("The circle's error")] == [
        Verdict.NOT_TESTABLE,  # as it is stated
        Verdict.REPRODUCED, Verdict.NOT_REPRODUCED, Verdict.REPRODUCED, Verdict.REPRODUCED,  # 0.5°
        Verdict.REPRODUCED, Verdict.NOT_REPRODUCED, Verdict.REPRODUCED, Verdict.NOT_REPRODUCED,  # 1°
    ]  # fmt: skip


@pytest.mark.parametrize(("timed", "none", "caused", "expected"), [
    (1.0, 0.63, Verdict.REPRODUCED, [Verdict.REPRODUCED, Verdict.REPRODUCED]),
    (0.75, 0.63, Verdict.NOT_REPRODUCED, [Verdict.NOT_REPRODUCED, Verdict.REPRODUCED]),
    (1.0, 0.9, Verdict.NOT_REPRODUCED, [Verdict.REPRODUCED, Verdict.NOT_REPRODUCED]),
])  # fmt: skip
def test_a_surge_is_one_with_timing_errors_and_not_without(
    timed: float, none: float, caused: Verdict, expected: list[Verdict]
) -> None:
    """Blur at 1440 rpm, with and without timing errors; at lower speeds it is 0.65 and 0.7 px, or 0.58 and 0.6 px."""
    turn = Condition(DISCS, "still", math.radians(1.0), cutoff_hz=1000.0)
    cells = [CellResult("apex_speed", replace(turn, rpm=rpm, seed=seed), {"errors": [
                {"degrees": 1.0, "model": apex_speed.EXACT, "timing": timing, "error_us": us, "displacement": 0.1,
                 "blur": blur + 0.001 * seed, "edge_blur": blur + 0.001 * seed}
                for timing, us, blur in ((apex_speed.WANDER, 1000.0, first), (apex_speed.NONE, 0.0, second))]})
             for rpm, first, second in ((360.0, 0.65, 0.58), (720.0, 0.7, 0.6), (1440.0, timed, none))
             for seed in (1, 2)]  # fmt: skip
    found = [c for c in apex_speed.claims(cells) if "(apex 1°)" in c.text]
    assert all(c.number is None for c in found)
    checks = {
        measure: [c.verdict for c in found if f"the {measure}" in c.text]
        for measure in ("edge blur", "blur")
    }
    assert checks == {measure: [caused, *expected] for measure in ("edge blur", "blur")}
    assert [c.verdict for c in apex_speed.claims(cells) if c.number == 13] == [Verdict.NOT_TESTABLE]
    assert len(check_tables(apex_speed, cells)["apex_speed_surge"].rows) == 4


def test_an_error_in_proportion_to_the_speed_does_not_surge() -> None:
    rows = [
        {"apex_name": "1°", "seed": 1, "rpm": rpm, "blur": rpm / 720.0}
        for rpm in (360.0, 720.0, 1440.0)
    ]
    (found,) = apex_speed.surge_of(rows, "blur")
    assert (found["below"], found["above"], found["surge"]) == (1.0, 1.0, 0.0)
    assert apex_speed.surge_of(rows[1:], "blur") == []


def test_more_events_and_more_error_with_apex_and_speed() -> None:
    """The event rate grows with apex and speed, the blur with the apex only."""
    made = [CellResult("apex_speed", Condition(DISCS, "still", math.radians(degrees), rpm, seed, cutoff_hz=1000.0), {
                "rows": [{"degrees": degrees, "delay": 0.0, "blur": 1.0, "edge_blur": blur + 0.01 * seed,
                          "mev_per_s": degrees * rpm / 720.0 + 0.01 * seed}]})
            for degrees, rpm, blur in ((0.5, 720.0, 0.6), (1.0, 720.0, 0.8), (2.0, 720.0, 1.0), (0.5, 1440.0, 0.5))
            for seed in (1, 2)]  # fmt: skip
    yes, no = Verdict.REPRODUCED, Verdict.NOT_REPRODUCED
    events = [
        c for c in apex_speed.claims(made) if c.number == 14 and "gives more events" in c.text
    ]
    assert [c.verdict for c in events] == [yes, yes]
    general = [
        c
        for c in apex_speed.claims(made)
        if c.number == 15 and "with the circle" not in c.text.lower()
    ]
    assert [c.verdict for c in general] == [yes, yes, yes, no]


def test_the_best_circle_is_the_least_squares_one() -> None:
    """Deflections on a grid, with the displacement of both models summed over pixels and angles."""
    camera = Camera.from_fov(64, 48, 1.0)
    true = ExactModel.from_prism(camera, Prism(0.02, 1.55), 0.3)
    x, y, angle = (
        m.ravel()
        for m in np.meshgrid(np.linspace(0, 63, 16), np.linspace(0, 47, 12), np.arange(12) / 2.0)
    )
    there = true.compensate_points(np.stack([x, y], axis=1), angle)
    best = apex_speed.best_circle(true)

    def cost(deflection: float) -> float:
        circle = type(best)(camera, deflection, 0.3, true.prism.flat_side)
        return float(
            np.sum((circle.compensate_points(np.stack([x, y], axis=1), angle) - there) ** 2)
        )

    sizes = true.prism.deflection * np.linspace(0.9, 1.2, 301)
    assert best.deflection == pytest.approx(sizes[np.argmin([cost(d) for d in sizes])], rel=0.01)


# Edges.


@pytest.mark.parametrize(("column", "chance"), [(10, 0), (29, 40)])
def test_chance_is_the_score_of_the_turned_image(column: int, chance: int) -> None:
    """A line in the middle of the image matches itself when it is turned, another line does not."""
    mask = np.zeros((40, 60), np.bool_)
    mask[:, column] = True
    image = edge_matches.WindowImage(
        mask.astype(np.float64), {edges.CANNY: mask, edges.GEOMETRY: mask}, None
    )  # type: ignore[arg-type]
    rows = edge_matches.match_rows("S-EV", image, image.masks(), (1.5,))
    assert {(row["matched"][-1], row["chance"][-1], row["true"]) for row in rows} == {
        (40, chance, 40)
    }


def edge_cell(seed: int, along: dict[Stream, float]) -> CellResult:
    """Return a cell in which the moving AMI-EV has a better score and a chance that is better by more."""
    images = [{"stream": s, "found": [100] * 33, "entropy": [0.5] * 33} for s in along]
    rows = [{"stream": s, "truth": edges.CANNY, "tolerance": 6.0, "matched": [matched + seed] * 33,
             "chance": [chance] * 33, "true": 100}
            for s, matched, chance in ((Stream.PLAIN, 60, 20), (Stream.CALIBRATED, 90, 80))]  # fmt: skip
    sectors = [{"stream": s, "angle": angle, "recall": 0.5 * share + 0.001 * seed}
               for s, value in along.items() for angle, share in ((7.5, 1.0), (82.5, value))]  # fmt: skip
    return CellResult(
        "edges", Condition(seed=seed), {"images": images, "rows": rows, "sectors": sectors}
    )


def test_edges_are_judged_by_the_score_and_checked_by_the_margin_over_chance() -> None:
    cells = [edge_cell(seed, {Stream.PLAIN: 0.5, Stream.CALIBRATED: 1.0}) for seed in (1, 2)]
    check_tables(edges, cells)
    claims = {c.text: c for c in edges.claims(cells)}
    (margin,) = (c for text, c in claims.items() if text.startswith("They are better than chance"))
    assert (margin.verdict, margin.ours) == (Verdict.NOT_REPRODUCED, "-0.3 [-0.3, -0.3], 2 seeds")
    (score,) = (c for text, c in claims.items() if text.startswith("Event images of the moving"))
    assert (score.verdict, score.number) == (Verdict.REPRODUCED, 2)


@pytest.mark.parametrize(("plain", "ami", "expected"), [
    (0.5, 1.0, [Verdict.REPRODUCED, Verdict.REPRODUCED]),
    (0.5, 0.8, [Verdict.REPRODUCED, Verdict.NOT_REPRODUCED]),
    (1.1, 0.95, [Verdict.NOT_REPRODUCED, Verdict.REPRODUCED]),
])  # fmt: skip
def test_edges_along_the_motion_are_judged_in_both_directions(
    plain: float, ami: float, expected: list[Verdict]
) -> None:
    cells = [edge_cell(seed, {Stream.PLAIN: plain, Stream.CALIBRATED: ami}) for seed in (1, 2)]
    assert [c.verdict for c in edges.claims(cells) if c.number == 3] == expected


# Segmentation by object.


def block(x: float, y: float, side: int) -> NDArray[np.float64]:
    """Return the pixels of a square, shape (n, 2)."""
    return (
        np.stack(np.meshgrid(np.arange(side) + x, np.arange(side) + y), axis=-1)
        .reshape(-1, 2)
        .astype(np.float64)
    )


def test_iou_of_objects_does_not_depend_on_their_share_of_events() -> None:
    body, other = np.zeros((2, 60, 80), np.bool_)
    body[20:30, 20:30] = True
    other[40:44, 60:64] = True
    # The found body is shifted by half of its size
    found, background = (
        block(25, 20, 10),
        block(0, 40, 20),
    )
    for copies in (1, 7):
        xy = np.concatenate([np.repeat(found, copies, axis=0), background]).astype(np.float32)
        number = np.repeat([1, 0], [copies * len(found), len(background)])
        events = Events.from_arrays(*xy.T, np.arange(len(xy)), np.ones(len(xy)))
        assert overlaps.object_ious(events, number, [body, other]) == [
            pytest.approx(50.0 / 150.0),
            0.0,
        ]
    none = np.zeros(len(xy), np.intp)
    assert overlaps.object_ious(events, none, [body]) == [0.0]


def test_each_object_has_its_best_cluster() -> None:
    one, two = np.zeros((2, 60, 80), np.bool_)
    one[5:15, 5:15] = two[30:40, 50:60] = True
    xy = np.concatenate([block(5, 5, 10), block(50, 30, 5)]).astype(np.float32)
    number = np.repeat([1, 2], [100, 25])
    events = Events.from_arrays(*xy.T, np.arange(len(xy)), np.ones(len(xy)))
    assert overlaps.object_ious(events, number, [two, one]) == [pytest.approx(0.25), 1.0]


# Convexity of the cost.

SIZE, PHASE = np.meshgrid(convexity.SIZES, convexity.PHASES, indexing="ij")


def test_a_bowl_over_a_periodic_phase() -> None:
    """(s - 1)² - cos(p - 0.01) has one minimum, and is convex where the cosine is positive."""
    shape = shape_of((SIZE - 1.0) ** 2 - np.cos(PHASE - 0.01))
    assert (SIZE[shape.lowest], PHASE[shape.lowest]) == (pytest.approx(1.0), pytest.approx(0.0))
    assert (shape.minima, shape.basin) == (1, 1.0)
    expected = np.cos(PHASE - 0.01) > 0.0
    expected[[0, -1]] = False
    np.testing.assert_array_equal(shape.convex, expected)
    assert shape.half_width(1) == 9.0  # 18 of 36 phases
    assert shape.half_width(0) == 8.5  # all inner sizes


def test_two_minima_of_which_one_is_lower() -> None:
    """-cos 2p - 0.1 cos(p - 2) over a bowl: the lowest one is at π, across the border of the grid."""
    cost = (SIZE - 1.0) ** 2 - np.cos(2.0 * PHASE) + 0.1 * np.cos(PHASE)
    shape = shape_of(cost)
    assert shape.minima == 2
    assert PHASE[shape.lowest] == pytest.approx(-math.pi)
    assert 0.4 < shape.basin < 0.6
    away = np.abs(np.angle(np.exp(1j * (PHASE - math.pi))))
    second = 4.0 * np.cos(2.0 * PHASE) - 0.1 * np.cos(PHASE)
    expected = (second > 0.0) & (away < math.pi / 2.0)
    expected[[0, -1]] = False
    np.testing.assert_array_equal(shape.convex, expected)


def test_a_saddle_is_not_convex() -> None:
    """The mixed derivative counts: s² + p² + 3 s p is not convex, although it is along both axes."""
    i, j = np.meshgrid(np.arange(19.0) - 9.0, np.arange(36.0) - 18.0, indexing="ij")
    shape = shape_of(i**2 + j**2 + 3.0 * i * j)
    assert not shape.convex[2:-2, 2:-2].any()


@pytest.mark.slow
def test_the_cost_of_a_recording() -> None:
    """An ideal sensor before discs: contrast has one optimum, the true one, in a convex domain."""
    condition = Condition(DISCS, "still", math.radians(1.0), 1440.0, 1, 2.0, 100, 80, only=IDEAL)
    values = json.loads(json.dumps(convexity.measure(Streams(condition), QUICK), allow_nan=False))
    assert {len(s["values"]) for s in values["surfaces"]} == {len(convexity.SIZES)}
    rows = {row["cost"]: row for row in values["rows"] if row["window"] == 2.0}
    ours = rows[convexity.OURS]
    assert (ours["minima"], ours["basin"]) == (1, 1.0)
    assert ours["error"] <= convexity.FOUND_PX
    assert ours["phase_half"] >= 10.0  # degrees
    assert not rows[convexity.PAPER]["found"]
    in_phase = rows[convexity.LONG_WAVES]
    assert in_phase["error"] <= convexity.FOUND_PX
    assert in_phase["phase_half"] >= ours["phase_half"]
    # the opposite phase is another minimum
    assert in_phase["basin"] < 0.9
    result = CellResult("convexity", condition, values)
    check_tables(convexity, [result])
    (picture,) = convexity.pictures([result])
    assert picture.frames[0].ndim == 3
    assert "ideal sensor" in picture.caption


@pytest.mark.parametrize(("short", "usual", "expected"), [
    ((5.0, 0.2), 0.3, [Verdict.UNDECIDED, Verdict.REPRODUCED]),
    ((5.0, 5.0), 0.3, [Verdict.REPRODUCED, Verdict.REPRODUCED]),
    ((0.9, 0.9), 0.9, [Verdict.NOT_REPRODUCED, Verdict.NOT_REPRODUCED]),
])  # fmt: skip
def test_lengths_of_recordings_are_judged(
    short: tuple[float, ...], usual: float, expected: list[Verdict]
) -> None:
    """Errors of the optimum in 0.25 s of two seeds, and in 2 s; in 4 s it is 0.2 px."""
    condition = Condition(DISCS, "still", only=IDEAL)
    cells = [CellResult("convexity", replace(condition, seed=seed), {"rows": [
                {"cost": convexity.PIXELS, "window": window, "error": error, "found": float(error <= 1.0), "minima": 1,
                 "phase_half": 20.0}
                for window, error in ((0.25, short[seed]), (2.0, usual), (4.0, 0.2))]}) for seed in (0, 1)]  # fmt: skip
    claims = [c for c in convexity.claims(cells) if c.verdict is not Verdict.NOT_TESTABLE]
    claims = [c for text in ("0.25 s", "4 s") for c in claims if text in c.text]
    assert [c.verdict for c in claims] == expected
    # The grid says nothing of how an optimiser converges
    assert [c.number for c in claims] == [
        None,
        16,
    ]


# Fading.


def test_fading_is_judged_by_its_size_and_by_how_rare_it_is() -> None:
    """Where motions cancel, 5 % of the tiles and moments, the rate falls to 0.2 of the usual one; in all, to 0.9."""
    classes = [
        {"speed": 0.125, "rate": 0.2, "tiles": 5},
        {"speed": 0.875, "rate": 1.0, "tiles": 95},
    ]
    values = {"rows": classes, "whole": [{"lowest": 0.9}]}
    cells = [CellResult("fading", Condition("room", "fast", seed=seed), values) for seed in (1, 2)]
    yes = Verdict.REPRODUCED
    assert [c.verdict for c in fading.claims(cells)] == [
        yes, Verdict.NOT_TESTABLE, yes, yes, Verdict.NOT_REPRODUCED,
    ]  # fmt: skip
    assert fading.claims(cells)[2].ours.startswith("0.05 ")
    assert fading.claims(cells)[3].ours.startswith("0.9 ")
    check_tables(fading, cells)
