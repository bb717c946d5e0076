"""The choice of prism and speed: its formulas, its predictions against simulations, and the paper's own choice."""

import csv
import itertools
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from matplotlib.text import Text
from PIL import Image
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Camera,
    ExactModel,
    FlatSide,
    Prism,
    PrismMotion,
    RadialTangential,
    Scene,
    SensorModel,
    Simulation,
    apex_from_deflection,
)
from amiwarp.calib.timing_blur import QUANTISATION_PX
from amiwarp.cli.common import Common, command, report
from amiwarp.studies import Design, Limits, Timing, design_results, event_volume
from amiwarp.studies import commands as command_line
from amiwarp.studies import design as study
from amiwarp.studies.design import ACROSS, design
from amiwarp.studies.design_chart import chart
from amiwarp.studies.design_words import headline, reasons
from amiwarp.studies.event_volume import TILE, _complete, filled, measure, tiles
from amiwarp.studies.orbits import LEAST_SWING, QUARTER_SWING, Orbit, orbit_of

GLASS = Prism(0.0)
SMALL = Camera.from_fov(64, 48, math.radians(10.0))
"""A focal length of 366 px, between those of a 60° and a 90° lens at 640 × 480, and fast to simulate."""


def angles(*degrees: float) -> list[float]:
    return [math.radians(value) for value in degrees]


@pytest.fixture(scope="module")
def scene(texture: np.ndarray) -> Scene:
    return Scene.from_picture(texture)


@pytest.fixture(scope="module")
def made(scene: Scene) -> Design:
    return design(SMALL, scene, GLASS, apexes=angles(0.5, 1, 2), rpms=[180, 720, 2880])


def under(made: Design, **limits: Any) -> Design:
    return replace(made, limits=Limits(**limits))


def test_least_swing_of_a_quarter_turn() -> None:
    """The least swing over all edge directions and all start angles. No other direction has so small a swing."""
    start, direction = np.meshgrid(
        np.radians(np.arange(0.0, 360.0, 1.0)), np.radians(np.arange(0.0, 180.0, 1.0))
    )
    turn = np.linspace(0.0, np.pi / 2.0, 91)
    across = np.cos(start[..., None] + turn - direction[..., None])
    assert np.ptp(across, axis=2).min() == pytest.approx(QUARTER_SWING, abs=1e-4)


def test_share_of_an_error_across_the_edges_that_fire() -> None:
    """An edge whose normal lies at an angle to the motion fires at the rate of its cosine."""
    cosine = np.abs(np.cos(np.linspace(0.0, 2.0 * np.pi, 10_000, endpoint=False)))
    assert math.sqrt(np.average(cosine**2, weights=cosine)) == pytest.approx(ACROSS, abs=1e-6)


@pytest.mark.parametrize("side", list(FlatSide))
def test_orbits_are_those_of_the_axial_ray_and_grow_off_the_axis(side: FlatSide) -> None:
    camera = Camera.from_fov(160, 120, math.radians(60.0))
    orbit = orbit_of(camera, Prism(math.radians(1.0), 1.55, side))
    assert orbit.smallest == pytest.approx(camera.fx * math.tan(orbit.deflection), abs=0.02)
    assert orbit.smallest < orbit.radius < 2.0 * orbit.smallest
    twice = orbit_of(camera, Prism(math.radians(2.0), 1.55, side))
    assert twice.radius == pytest.approx(2.0 * orbit.radius, rel=0.01)
    assert all(twice.errors[name] > orbit.errors[name] for name in ("circle", "radial", "ellipse"))
    assert orbit.errors["circle"] > orbit.errors["radial"] > orbit.errors["exact"] == 0.0


def test_tiles_see_what_their_part_of_the_image_sees() -> None:
    camera = Camera.from_fov(
        320, 200, math.radians(70.0), RadialTangential(-0.2, 0.05, 1e-3, -5e-4)
    )
    model = ExactModel(camera, Prism(0.03))
    parts = tiles(camera)
    assert len(parts) > 40
    seen = np.zeros((camera.height, camera.width), int)
    for part in parts:
        left, top = round(camera.cx - part.cx), round(camera.cy - part.cy)
        seen[top : top + TILE, left : left + TILE] += 1
        corner = np.array([left, top], np.float64)
        xy = np.array([[0.0, 0.0], [TILE - 1.0, 5.0]])
        theta = np.array([0.3, 2.0])
        whole = model.compensate_points(xy + corner, theta) - corner
        np.testing.assert_allclose(
            replace(model, camera=part).compensate_points(xy, theta), whole, rtol=0, atol=1e-3
        )
    assert seen.max() == 1
    assert seen.sum() == len(parts) * TILE**2
    assert tiles(Camera.from_fov(40, 30, 1.0)) == [Camera.from_fov(40, 30, 1.0)]


def test_the_law_predicts_whole_simulations(texture: np.ndarray) -> None:
    """For an apex and a speed that were not used in the fit."""
    camera = Camera.from_fov(240, 180, math.radians(30.0))
    apexes = angles(0.5, 2.0)
    whole = filled(Scene.from_picture(texture), camera, Prism(apexes[-1]))
    template = Simulation(whole, camera, GLASS, 1.0)
    law = measure(template, apexes, [180.0, 720.0, 2880.0], lambda what, share: None)
    assert law.simulated < 0.7 * law.pixels
    for apex, rpm in ((math.radians(0.8), 720.0), (math.radians(1.2), 1440.0)):
        prism = Prism(apex)
        full = replace(
            template, prism=prism, motion=PrismMotion(rpm), duration_s=120.0 / rpm, seed=5
        )
        found = (
            sum(int((e.t >= full.duration_us // 2).sum()) for e, _ in full.blocks()) * rpm / 60.0
        )
        assert law.events_per_s(orbit_of(camera, prism), rpm) == pytest.approx(found, rel=0.1)


def test_the_blur_of_jittered_stamps(texture: np.ndarray) -> None:
    """Events compensated with the true prism deviate along the orbit as predicted, without the factor for edges."""
    jitter, rpm, prism = 150.0, 720.0, Prism(math.radians(2.0))
    sensor = replace(SensorModel.ideal(), latency_us=4.0 * jitter, latency_jitter_us=jitter)
    simulation = Simulation(
        Scene.from_picture(texture), SMALL, prism, 0.1, motion=PrismMotion(rpm), sensor=sensor
    )
    recording = simulation.run()
    events = recording.events.slice(0, len(recording.events))
    assert recording.truth is not None
    theta = simulation.motion.angle(events.t - 4.0 * jitter)
    back = ExactModel(SMALL, prism).compensate_points(
        np.stack([events.x, events.y], 1).astype(np.float64), theta
    )
    off = np.linalg.norm(back - recording.truth.points(0, len(events)), axis=1)
    predicted = Timing(jitter, 0.0).blur(orbit_of(SMALL, prism).radius, rpm)[0] / ACROSS
    assert float(np.sqrt(np.nanmean(off**2))) == pytest.approx(predicted, rel=0.08)


def curves(made: Design) -> tuple[list[float], list[float], list[float]]:
    """Return for each apex the error of the paper's single circle, the blur, and the events per second."""
    circle = [orbit.errors["circle"] for orbit in made.orbits]
    return circle, [c.blur_px for c in made.choices], [c.events_per_s for c in made.choices]


@pytest.mark.parametrize(
    ("fov", "index", "deflected"),
    [(60.0, 1.5168, False), (90.0, 1.55, True)],
    ids=["apex", "deflection"],
)
def test_the_paper_is_reproduced(scene: Scene, fov: float, index: float, deflected: bool) -> None:
    """Of 0.5, 1 and 2° at 640 × 480 and 720 rpm, 1° is chosen, whether these are apexes or, at 90°, deflections.

    Error and event rate grow with the apex, the error of the single circle slightly faster than in proportion.
    """
    camera = Camera.from_fov(640, 480, math.radians(fov))
    named = angles(0.5, 1.0, 2.0)
    apexes = [apex_from_deflection(angle, index) for angle in named] if deflected else named
    made = design(camera, scene, Prism(0.0, index), apexes=apexes, rpms=[720.0])
    assert made.chosen is not None
    assert named[apexes.index(made.chosen.orbit.apex)] == math.radians(1.0)
    assert [c.misses for c in made.choices] == [("edges",), (), ()]
    circle, blur, events = curves(made)
    for grown in (circle, blur, events):
        assert grown == sorted(grown)
    assert [b / a for a, b in itertools.pairwise(circle)] == pytest.approx([2.0, 2.0], abs=0.1)
    assert all(1.5 < b / a < 2.1 for a, b in itertools.pairwise(events))


def test_speed_costs_events_and_blur_and_shortens_the_window(made: Design) -> None:
    for orbit in made.orbits:
        row = [made.at(orbit.apex, rpm) for rpm in made.rpms]
        assert [c.window_ms for c in row] == pytest.approx([83.3333, 20.8333, 5.2083], abs=1e-3)
        assert row[0].events_per_s < row[1].events_per_s < row[2].events_per_s
        # at most in proportion, because of the refractory period
        assert row[2].events_per_s < 4.0 * row[1].events_per_s * 1.02
        assert QUANTISATION_PX < row[0].blur_px < row[1].blur_px < row[2].blur_px


def test_the_choice_keeps_all_limits_with_the_fewest_events(made: Design) -> None:
    assert made.chosen is not None
    kept = [c for c in made.choices if not c.misses]
    assert made.chosen.events_per_s == min(c.events_per_s for c in kept)
    assert made.chosen.orbit.swing >= LEAST_SWING
    smallest, largest = made.range_at(made.chosen.rpm)
    assert smallest <= made.chosen.orbit.apex <= largest
    edge = orbit_of(SMALL, Prism(smallest))
    assert edge.swing == pytest.approx(LEAST_SWING, abs=0.01)
    text = "\n".join(reasons(made))
    assert f"fewest of the {len(kept)} choices of 9" in text
    assert f"{made.chosen.rpm:g} rpm" in headline(made)


def test_no_prism_suits_a_tolerance_below_the_pixels_even_with_exact_times(made: Design) -> None:
    exact = replace(made, timing=Timing(clock_us=0.0, encoder=0.0))
    assert exact.range_at(720.0)[1] == math.inf
    assert replace(exact, limits=Limits(tolerance_px=0.2)).range_at(720.0)[1] == 0.0


def test_each_limit_rules_out_and_says_so(made: Design) -> None:
    fewest = min(c.events_per_s for c in made.choices)
    for limits, name, why in (
        ({"tolerance_px": 0.2}, "blur", "pixels alone leave 0.29"),
        ({"window_ms": 1.0}, "window", "a faster prism"),
        ({"bandwidth": 0.5 * fewest}, "bandwidth", "a higher threshold"),
    ):
        none = under(made, **limits)
        assert none.chosen is None
        assert all(name in c.misses for c in none.choices)
        (line,) = [text for text in reasons(none) if text.startswith(f"{name}: rules out 9 of 9")]
        assert why in line
        assert "none of 9 choices" in headline(none)


def test_limits_move_the_choice(made: Design) -> None:
    assert made.chosen is not None
    fast = under(made, window_ms=6.0).chosen
    assert fast is not None
    assert fast.rpm == 2880.0
    slow = under(made, window_ms=100.0).chosen
    assert slow is not None
    assert slow.rpm == 180.0
    assert slow.orbit.apex == fast.orbit.apex == made.chosen.orbit.apex


def test_the_model_is_the_smallest_that_keeps_the_budget(scene: Scene) -> None:
    lenses = [Camera.from_fov(64, 48, math.radians(fov)) for fov in (4.0, 90.0)]
    found = [
        design(camera, scene, GLASS, apexes=angles(1.0, 4.0), rpms=[720.0]) for camera in lenses
    ]
    assert found[0].choices[0].model == "circle"
    assert found[1].choices[1].model != "circle"
    for choice in (c for each in found for c in each.choices):
        before = list(choice.orbit.errors)[: list(choice.orbit.errors).index(choice.model)]
        assert all(choice.orbit.errors[name] > choice.budget_px for name in before)
        assert (
            choice.orbit.errors[choice.model]
            <= choice.budget_px
            == pytest.approx(0.1 * choice.blur_px, abs=1e-9)
        )
    loose = under(found[1], budget_px=10.0).choices[1]
    assert loose.model == "circle"
    assert loose.error_px > loose.blur_px + 0.01


@pytest.mark.parametrize(
    ("words", "values"),
    [
        ("at least one", {"apexes": []}),
        ("above 0", {"apexes": [0.0]}),
        ("above 0", {"rpms": [-720.0]}),
        ("no texture", {"scene": Scene.from_picture(np.full((20, 20), 0.5, np.float32))}),
    ],
)
def test_what_makes_no_sense_is_refused(scene: Scene, words: str, values: dict[str, Any]) -> None:
    given = {"scene": scene, "apexes": [0.02], "rpms": [720.0], **values}
    with pytest.raises(AmiwarpError, match=words):
        design(SMALL, given["scene"], GLASS, apexes=given["apexes"], rpms=given["rpms"])


def test_limits_and_timing_must_be_possible() -> None:
    for name in ("tolerance_px", "window_ms", "bandwidth", "budget_px"):
        with pytest.raises(AmiwarpError, match=name):
            Limits(**{name: 0.0})
    with pytest.raises(AmiwarpError, match="clock error -1 us"):
        Timing(clock_us=-1)


@pytest.mark.parametrize("count", [(1, 1), (3, 3), (5, 6)])
def test_no_letters_of_the_chart_overlap(made: Design, count: tuple[int, int]) -> None:
    bent = [replace(made.orbits[1], apex=math.radians(0.25 * 2.0**k)) for k in range(count[0])]
    orbits = made.orbits if count[0] == 3 else tuple(bent)
    rpms = tuple(180.0 * 2.0**k for k in range(count[1]))
    made = replace(
        made, orbits=orbits, rpms=rpms, limits=Limits(bandwidth=1e4, tolerance_px=0.1 * count[0])
    )
    figure = chart(made)
    figure.canvas.draw()
    found = [t for t in figure.findobj(Text) if t.get_text().strip() and t.get_visible()]
    boxes = [(t.get_text(), Text.get_window_extent(t).shrunk(0.95, 0.85)) for t in found]
    crossing = [
        (a, b) for (a, box), (b, other) in itertools.combinations(boxes, 2) if box.overlaps(other)
    ]
    assert crossing == []
    outside = [text for text, box in boxes if box.x0 < 0.0 or box.y0 < 0.0]
    assert outside + [text for text, box in boxes if (box.max > figure.bbox.max).any()] == []


def test_the_command_writes_chart_and_tables(tmp_path: Path, texture: np.ndarray) -> None:
    app = typer.Typer()
    command(app, command_line.run_design, name="design", example="")
    picture = tmp_path / "picture.png"
    Image.fromarray(texture).save(picture)
    grid = ["--size", "64x48", "--fov-deg", "10", "--apex-deg", "0.5,1,2", "--rpm", "720,360"]
    words = ["--picture", str(picture), *grid]
    out = tmp_path / "new" / "out"
    result = CliRunner().invoke(app, [*words, "--out", str(out), "--json", "--device", "cpu"])
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout)
    assert sorted(path.name for path in out.iterdir()) == [
        "design.csv",
        "design.json",
        "design.png",
        "design.svg",
    ]
    assert {
        name: json.loads((out / "design.json").read_text())[name]
        for name in ("recommended", "choices")
    } == {name: said[name] for name in ("recommended", "choices")}
    rows = list(csv.DictReader((out / "design.csv").read_text().splitlines()))
    assert [float(row["apex_deg"]) for row in rows] == pytest.approx(
        [0.5, 0.5, 1.0, 1.0, 2.0, 2.0], abs=1e-9
    )
    assert [float(row["rpm"]) for row in rows] == [360.0, 720.0] * 3
    assert said["recommended"]["misses"] == []
    with Image.open(out / "design.png") as drawn:
        assert drawn.size[0] > 1000


def test_what_fails_does_not_end_the_command(
    tmp_path: Path, texture: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    app = typer.Typer()
    command(app, command_line.run_design, name="design", example="")
    picture, out = tmp_path / "picture.png", tmp_path / "out"
    Image.fromarray(texture).save(picture)
    orbit_of, simulated = study.orbit_of, event_volume.simulated_yield

    def planted(camera: Camera, prism: Prism, *args: Any) -> Orbit:
        if prism.apex == math.radians(2.0):
            raise np.linalg.LinAlgError("Singular matrix")
        return orbit_of(camera, prism, *args)

    def also(case: Simulation, *args: Any) -> tuple[float, float]:
        if math.degrees(case.glass.apex) < 0.6 and float(np.asarray(case.motion.rpm)) > 600.0:
            raise MemoryError
        return simulated(case, *args)

    monkeypatch.setattr(study, "orbit_of", planted)
    monkeypatch.setattr(event_volume, "simulated_yield", also)
    words = ["--picture", str(picture), "--size", "64x48", "--fov-deg", "10", "--rpm", "720,360"]
    run = CliRunner().invoke
    done = run(app, [*words, "--apex-deg", "0.5,1,2", "--out", str(out), "--device", "cpu"])
    assert done.exit_code == 0, done.output
    data = json.loads((out / "design.json").read_text())
    assert list(data["failed"]) == ["apex 2°", "simulation of apex 0.5° at 720 rpm"]
    assert data["failed"]["apex 2°"].startswith(
        "LinAlgError: Singular matrix (in design, studies/design.py:"
    )
    assert [round(c["apex_deg"], 6) for c in data["choices"]] == [0.5, 0.5, 1.0, 1.0]
    assert data["volume"]["apex_deg"] == pytest.approx([1.0], abs=1e-9)
    assert f"failed: apex 2°: {data['failed']['apex 2°']}" in data["reasons"]
    assert done.stdout.endswith(
        "failed, and left out: apex 2°; simulation of apex 0.5° at 720 rpm\n"
    )
    nothing = run(
        app, [*words, "--apex-deg", "2", "--out", str(tmp_path / "none"), "--device", "cpu"]
    )
    assert nothing.exit_code == 1
    assert "apex 2°: LinAlgError: Singular matrix" in str(nothing.exception)


@pytest.mark.parametrize(
    ("missing", "rows", "columns"),
    [
        ([], [0, 1, 2], [0, 1]),
        ([(1, 0)], [0, 2], [0, 1]),
        ([(0, 1), (1, 1)], [0, 1, 2], [0]),
        ([(0, 0), (1, 0), (2, 0), (1, 1)], [0, 2], [1]),
    ],
)
def test_a_law_keeps_as_many_simulations_as_form_a_table(
    missing: list[tuple[int, int]], rows: list[int], columns: list[int]
) -> None:
    there = np.ones((3, 2), np.bool_)
    for at in missing:
        there[at] = False
    kept = _complete(there)
    assert kept is not None
    assert [each.tolist() for each in kept] == [rows, columns]
    assert _complete(np.zeros((3, 2), np.bool_)) is None


def test_what_people_read(made: Design, capsys: pytest.CaptureFixture[str]) -> None:
    report(Common(), {}, design_results.design_lines(made, {"png": "design.png"}))
    assert made.chosen is not None
    said = capsys.readouterr().out.splitlines()
    (row,) = [line.split() for line in said if "recommended" in line]
    assert row[:2] == [f"{math.degrees(made.chosen.orbit.apex):g}°", f"{made.chosen.rpm:g}"]
    assert "blur" in "".join(line for line in said if "misses" not in line)
    assert said[-1] == "design.png"
