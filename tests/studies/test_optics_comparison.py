"""The comparison of moving optics: extent, coverage, blur, events and depth against float64 oracles and simulations."""

import csv
import itertools
import json
import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
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
    Mirror,
    Plate,
    PlateModel,
    Prism,
    Scene,
    Simulation,
    Vibration,
)
from amiwarp.calib.timing_blur import QUANTISATION_PX
from amiwarp.cli.common import Common, command, report
from amiwarp.studies import (
    Design,
    Limits,
    Timing,
    design_results,
    optic_settings,
    optics_comparison,
)
from amiwarp.studies import commands as command_line
from amiwarp.studies.design import Choice, design
from amiwarp.studies.edge_coverage import PATH_ANGLES, coverage
from amiwarp.studies.event_volume import filled
from amiwarp.studies.image_flow import across_edges, change_of
from amiwarp.studies.optic_settings import Setting, settings
from amiwarp.studies.optics_comparison import Compared, Comparison, compare, reference_of
from amiwarp.studies.optics_comparison_chart import chart
from amiwarp.studies.optics_comparison_words import reasons
from amiwarp.studies.orbits import LEAST_SWING, image_grid, orbit_of, paths
from amiwarp.studies.plate_depth import depth_deviation
from reference import optics as reference

pytestmark = pytest.mark.slow  # one comparison for all takes many seconds

GLASS = Prism(0.0)
CAMERA = Camera.from_fov(160, 120, math.radians(60.0))
SMALL = Camera.from_fov(64, 48, math.radians(10.0))
"""A focal length of 366 px, between those of a 60° and a 90° lens at 640 × 480, and fast to simulate."""
SETTINGS = {
    each.name: each for each in settings(CAMERA, GLASS, math.radians(2.0), 12.0, (0.3, 0.6), {})
}
NAMES = list(SETTINGS)
RADIUS = orbit_of(CAMERA, Prism(math.radians(2.0))).radius


def oracle(setting: Setting, camera: Camera, pixels: np.ndarray, per_turn: int) -> np.ndarray:
    """Return the path of what each pixel sees in the image at rest, in float64, shape (pixels, angles, 2)."""
    first = np.arange(per_turn * setting.turns) * (2.0 * np.pi / per_turn)
    xy, theta = np.repeat(pixels, len(first), axis=0), np.tile(first, len(pixels))
    second, optic = theta * float(setting.ratio), setting.optic
    rays = reference.pixels_to_rays(camera, xy)
    if isinstance(optic, Mirror):
        mount = {
            "direction": 0.0,
            "second_direction": np.pi / 2.0,
            "fold": 0.0,
            "incidence": np.pi / 4.0,
        }
        tilts = dict(zip(("amplitude", "second_amplitude"), optic.amplitude, strict=True))
        phases = dict(zip(("phase", "second_phase"), optic.phase, strict=True))
        found = reference.in_mirror(
            camera, {**mount, **tilts, **phases}, xy, np.stack([theta, second], axis=1)
        )
    elif isinstance(optic, Vibration):
        values = {"amplitude": optic.amplitude, "phase": 0.0, "backward_x": optic.backward[0]}
        found = reference.turned(camera, reference.vibration(values, theta), xy)
    elif isinstance(optic, Plate):
        found = reference.at_depth(
            camera, optic, 0.0, xy, theta, np.full(len(xy), setting.inverse_depth)
        )
    else:
        for prism, angle in ((optic, theta), (optic.second, second)):
            rays = (
                rays
                if prism is None
                else reference.through_prism(prism, rays, angle, to_scene=True)
            )
        found = reference.rays_to_pixels(camera, rays)
    return found.reshape(len(pixels), len(first), 2)


@pytest.mark.parametrize("name", NAMES)
def test_extents_agree_with_float64_traces_of_rays(name: str) -> None:
    setting = SETTINGS[name]
    pixels = image_grid(CAMERA)
    moved = oracle(setting, CAMERA, pixels, 40)
    radii = np.sqrt(moved.var(axis=1).sum(axis=1))
    expected = RADIUS * 0.5 if name == "plate, 0.6 m" else RADIUS
    assert math.sqrt(np.mean(radii**2)) == pytest.approx(expected, rel=2e-3)
    found = paths(setting.model(CAMERA), pixels, 40, setting.turns)
    np.testing.assert_allclose(found, moved, rtol=0, atol=2e-3)  # px


def least_by_search(moved: np.ndarray, per_turn: int, window: float, *, every: int = 2) -> float:
    """Return the smallest displacement across an edge within the window [turns], over starts, directions and pixels."""
    normals = np.radians(np.arange(0.0, 180.0, 1.0))
    across = moved @ np.stack([np.cos(normals), np.sin(normals)])
    steps = np.arange(round(window * per_turn) + 1)
    starts = range(0, across.shape[1], every)
    return min(
        float(np.ptp(one[(start + steps) % len(one)], axis=0).min())
        for one, start in itertools.product(across, starts)
    )


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("window", [0.25, 0.4, 1.2])
def test_coverage_agrees_with_a_search_over_starts_and_directions(name: str, window: float) -> None:
    setting = SETTINGS[name]
    pixels = image_grid(CAMERA, 3, 3)
    found = coverage(paths(setting.model(CAMERA), pixels, PATH_ANGLES, setting.turns), window)
    exact = oracle(setting, CAMERA, pixels, 200)
    expected = least_by_search(exact, 200, window)
    assert found.swing == pytest.approx(expected, abs=0.02)  # px
    whole = least_by_search(exact, 200, float(setting.turns), every=1000)
    assert math.isfinite(found.complete) == (whole >= LEAST_SWING) == (name != "pair, opposite")
    if math.isfinite(found.complete):
        assert least_by_search(exact, 200, found.complete) == pytest.approx(LEAST_SWING, abs=0.1)


def test_a_line_leaves_out_the_edges_along_it() -> None:
    theta = np.arange(PATH_ANGLES) * (2.0 * np.pi / PATH_ANGLES)
    for degrees in (0.0, 30.0, 120.0):
        along = np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees))])
        found = coverage((4.0 * np.cos(theta))[None, :, None] * along, 0.4)
        assert found.complete == math.inf
        # 8 px along the line are less than 1 px across edges within asin(1/8) of it
        assert found.left_out == pytest.approx(2.0 * math.asin(1.0 / 8.0) / math.pi, abs=0.01)
        assert math.degrees(found.blind) == pytest.approx(degrees, abs=0.6)


def test_a_wedge_covers_edges_as_a_circle_does() -> None:
    prism = Prism(math.radians(2.0))
    found = coverage(paths(ExactModel(CAMERA, prism), image_grid(CAMERA, 9, 7), PATH_ANGLES), 0.25)
    orbit = orbit_of(CAMERA, prism)
    assert found.swing == pytest.approx(orbit.swing, rel=0.02)
    # a displacement of 1 px takes an arc of 2 acos(1 - 1 / r), if the edge turns back in its middle
    assert found.complete == pytest.approx(
        math.acos(1.0 - 1.0 / orbit.smallest) / math.pi, rel=0.02
    )


def test_errors_across_the_edges_that_fire() -> None:
    """The closed form is the mean over all edge directions, weighted by the rate at which the flow crosses them."""
    rng = np.random.default_rng(0)
    error, flow = rng.normal(size=(4, 30, 2)), rng.normal(size=(4, 30, 2))
    normals = np.linspace(0.0, 2.0 * np.pi, 20_000, endpoint=False)
    normal = np.stack([np.cos(normals), np.sin(normals)])
    weight = np.abs(flow @ normal)
    expected = np.sum(weight * (error @ normal) ** 2, axis=(1, 2)) / np.sum(weight, axis=(1, 2))
    np.testing.assert_allclose(across_edges(error, flow), expected, rtol=1e-6)


def test_the_change_of_log_intensity_on_a_slope() -> None:
    """On a circle of radius r, a constant gradient g makes the log intensity go up and down by 4 r g a turn."""
    radius, angle = 3.0, np.arange(240) * (2.0 * np.pi / 240)
    # A turn takes 1 s
    flow = 2.0 * np.pi * radius * np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    everywhere = np.tile(flow, (33 * 25, 1, 1))
    slopes = np.full((48, 64), 0.3), np.full((48, 64), -0.4)
    found = change_of(everywhere, slopes, SMALL)
    assert found.shape == (48, 64)
    np.testing.assert_allclose(found, 4.0 * radius * 0.5, rtol=1e-3)


@pytest.mark.parametrize("depth", [0.3, 0.6])
def test_the_depth_of_an_edge_scatters_as_predicted(depth: float) -> None:
    """Edges of random directions and places cross pixels; depth and place are fitted to the noisy crossings."""
    setting = SETTINGS[f"plate, {depth:g} m"]
    model, noise = setting.model(CAMERA), 0.15
    assert isinstance(model, PlateModel)
    rng = np.random.default_rng(3)
    grid = rng.choice(image_grid(CAMERA), 400)
    track = oracle(setting, CAMERA, grid, 2000)
    nearer = oracle(
        replace(setting, inverse_depth=setting.inverse_depth * 1.001), CAMERA, grid, 2000
    )
    off = []
    for path, other in zip(track, nearer, strict=True):
        normal = np.array([math.cos(angle := rng.uniform(0.0, 2.0 * np.pi)), math.sin(angle)])
        # For the logarithm of the inverse depth
        place, slope = (
            path @ normal,
            (other - path) @ normal / 1e-3,
        )
        crossed = np.flatnonzero(
            np.diff(np.floor(place + rng.uniform()), append=np.floor(place[0])) != 0
        )
        known = np.stack([slope[crossed], np.ones(len(crossed))], axis=1)
        if len(crossed) > 2:
            off.append(
                np.linalg.lstsq(known, rng.normal(0.0, noise, len(crossed)), rcond=None)[0][0]
            )
    assert len(off) > 380
    assert np.std(off) == pytest.approx(depth_deviation(model, noise), rel=0.15)


# A whole comparison, of a small camera.


@pytest.fixture(scope="module")
def scene(texture: np.ndarray) -> Scene:
    return Scene.from_picture(texture)


@pytest.fixture(scope="module")
def compared(scene: Scene) -> Comparison:
    apexes = [math.radians(value) for value in (0.5, 1.0, 2.0)]
    made = design(SMALL, scene, GLASS, apexes=apexes, rpms=[720.0, 1440.0])
    return compare(made, scene, depths=(0.5, 1.0, 10.0))


def under(compared: Comparison, **limits: float) -> Comparison:
    """Return a comparison under other limits, with the violations that follow from them."""
    made = replace(compared.design, limits=Limits(**limits))
    results = []
    for result in compared.results:
        kept = {
            "edges": result.coverage.swing >= LEAST_SWING,
            "blur": result.blur_px <= made.limits.tolerance_px,
            "bandwidth": made.limits.bandwidth is None
            or result.events_per_s <= made.limits.bandwidth,
        }
        results.append(
            replace(result, misses=tuple(name for name, good in kept.items() if not good))
        )
    return replace(compared, design=made, results=tuple(results))


def test_the_wedge_has_the_numbers_of_the_design_study(compared: Comparison) -> None:
    wedge, choice = compared.results[0], compared.design.chosen
    assert choice is compared.reference is not None
    assert (wedge.radius, wedge.smallest) == (choice.orbit.radius, choice.orbit.smallest)
    assert wedge.clock_px == pytest.approx(choice.clock_px, rel=0.01)
    assert wedge.encoder_px == pytest.approx(choice.encoder_px, rel=0.01)
    assert wedge.blur_px == pytest.approx(choice.blur_px, rel=1e-3)
    assert wedge.events_per_s == pytest.approx(choice.events_per_s, rel=1e-3)
    assert wedge.setting.hz == choice.rpm / 60.0
    assert wedge.misses == ()


def test_all_optics_move_the_image_alike(compared: Comparison) -> None:
    for result in compared.results:
        expected = compared.results[0].radius * min(
            1.0, 0.5 * (result.setting.inverse_depth or 2.0)
        )
        assert result.radius == pytest.approx(expected, rel=5e-3)
        assert (result.setting.hz == 12.0) == (result.setting.name != "vibration")
        assert result.smallest <= result.radius


def test_the_law_of_events_holds_for_all_optics(compared: Comparison) -> None:
    """Along a line it is known to be too high, as edges nearly along the line do not reach the threshold."""
    for result in compared.results[:-1]:  # that of the last plate is under half a pixel
        tolerance = (
            0.15
            if result.setting.name == "pair, opposite" or result.setting.kind == "plate"
            else 0.05
        )
        assert abs(result.deviation) < tolerance + 2.0 * result.uncertainty, result.setting.name
        assert result.uncertainty < 0.1


@pytest.mark.parametrize("name", ["pair, unequal", "mirror, circle", "vibration"])
def test_the_law_predicts_simulations_of_the_whole_camera(
    compared: Comparison, scene: Scene, name: str
) -> None:
    result = next(r for r in compared.results if r.setting.name == name)
    setting = result.setting
    turn_s = 1.0 / setting.hz
    seen = filled(scene, SMALL, Prism(math.radians(2.0)))
    full = Simulation(
        seen, SMALL, setting.optic, (1 + 2 * setting.turns) * turn_s, motion=setting.motion, seed=7
    )
    found = sum(int((events.t >= 1e6 * turn_s).sum()) for events, _ in full.blocks())
    assert result.events_per_s == pytest.approx(found / (2 * setting.turns * turn_s), rel=0.08)


def test_what_is_determined_and_known(compared: Comparison) -> None:
    by_name = {r.setting.name: r for r in compared.results}
    near, far, too_far = (by_name[f"plate, {depth:g} m"] for depth in (0.5, 1.0, 10.0))
    assert near.depth_deviation is not None
    assert far.depth_deviation is not None
    # σ/r over √(4 r / 3) crossings
    assert far.depth_deviation / near.depth_deviation == pytest.approx(2.0**1.5, rel=0.05)
    assert near.depth_deviation == pytest.approx(
        near.blur_px / (near.radius * math.sqrt(4.0 * near.radius / 3.0)), rel=0.1
    )
    assert too_far.depth_deviation is None
    assert all(r.depth_deviation is None for r in compared.results if r.setting.kind != "plate")
    vibration = by_name["vibration"]
    assert vibration.encoder_px == 0.0
    assert vibration.setting.NEEDS["vibration"][2] == "events alone"
    assert all(r.encoder_px > 0.0 for r in compared.results if r is not vibration)


def test_angles_of_two_prisms_blur_independently(compared: Comparison) -> None:
    """Each circle of radius r/√2 blurs by its own angle's error; the error of one is not along the whole motion."""
    pair = next(r for r in compared.results if r.setting.name == "pair, opposite")
    one = Timing().blur(pair.radius / math.sqrt(2.0), 720.0)[1]
    # of each circle's direction, on average over the line, half lies along the motion
    assert one < pair.encoder_px < math.sqrt(2.0) * one
    assert pair.clock_px > compared.results[0].clock_px  # it is fastest where it fires most


def test_the_advice_keeps_the_limits_and_says_why(compared: Comparison) -> None:
    by_task = {advice.task: advice for advice in compared.advice}
    assert list(by_task) == ["blur", "events", "directions", "depth"]
    kept = [r for r in compared.results if not r.misses and r.setting.kind != "plate"]
    chosen = {task: advice.chosen for task, advice in by_task.items()}
    assert chosen["blur"] is compared.results[0]  # all are alike, and the wedge is the simplest
    best = min(r.events_per_s_px for r in kept)
    assert chosen["events"] is not None
    assert chosen["events"].events_per_s_px <= 1.05 * best
    assert chosen["directions"] is max(kept, key=lambda r: r.coverage.swing)
    assert chosen["depth"] is not None
    assert chosen["depth"].setting.name == "plate, 0.5 m"
    text = "\n".join(reasons(compared))
    assert "violated by pair opposite (edges: 0.00 px," in text
    assert "10 m orbit of" in text
    assert "near and far points alike" in by_task["depth"].why
    assert "at 20 turns/s" in by_task["directions"].why


def test_limits_move_the_advice(compared: Comparison) -> None:
    events = sorted(
        r.events_per_s for r in compared.results if not r.misses and r.setting.kind != "plate"
    )
    least = under(compared, bandwidth=1.001 * events[0])
    assert {a.chosen.setting.name for a in least.advice if a.chosen and a.task != "depth"} == {
        r.setting.name for r in compared.results if r.events_per_s == events[0]
    }
    assert "Mev/s; violated by wedge (bandwidth)" in reasons(least)[1]
    none = under(compared, tolerance_px=0.1)
    assert [a.chosen for a in none.advice[:3]] == [None, None, None]
    assert none.advice[0].why == "no optic keeps all limits"


def test_without_a_suitable_wedge_the_nearest_is_compared(compared: Comparison) -> None:
    assert reference_of(compared.design) is compared.design.chosen
    strict = replace(compared.design, limits=Limits(window_ms=12.0, tolerance_px=0.1))
    assert strict.chosen is None
    found = reference_of(strict)
    # the blur is too large for all choices, the window too short for the slower speed
    assert found.misses == ("blur",)
    assert found.rpm == 1440.0
    assert "nearest to the limits" in reasons(replace(compared, design=strict, reference=found))[0]


@pytest.mark.parametrize(
    ("depths", "words"),
    [
        ((), "at least one"),
        ((0.01,), "0.05 m or more"),
        ((math.nan,), "0.05 m"),
        ((40.0,), "mm thick"),
    ],
)
def test_impossible_depths_are_refused(
    compared: Comparison, scene: Scene, depths: tuple[float], words: str
) -> None:
    with pytest.raises(AmiwarpError, match=words):
        compare(compared.design, scene, depths=depths)


def test_an_optic_that_fails_does_not_end_the_comparison(
    compared: Comparison, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    compare_one, sized = optics_comparison._compared, optic_settings._sized

    def planted(design: Design, reference: Choice, setting: Setting, *args: Any) -> Compared:
        if setting.kind in ("wedge", "plate"):
            raise np.linalg.LinAlgError("Singular matrix")
        return compare_one(design, reference, setting, *args)

    def also(make: Callable[[float], Setting], size: float, *args: Any) -> Setting:
        if make(size).kind == "vibration":
            raise AmiwarpError("no such motor")
        return sized(make, size, *args)

    monkeypatch.setattr(optics_comparison, "_compared", planted)
    monkeypatch.setattr(optic_settings, "_sized", also)
    found = compare(compared.design, scene, depths=[0.5])
    assert [r.setting.name for r in found.results] == [
        "pair, opposite", "pair, unequal", "mirror, circle", "mirror, 3:4",
    ]  # fmt: skip
    assert list(found.failed) == ["vibration", "wedge", "plate, 0.5 m"]
    assert found.failed["vibration"].startswith("no such motor (in ")
    assert {a.task: a.chosen is None for a in found.advice}["depth"]
    assert "no plate could be compared" in found.advice[-1].why
    assert f"failed: wedge: {found.failed['wedge']}" in reasons(found)
    assert "Failed, and left out: vibration; wedge; plate, 0.5 m." in [
        t.get_text() for t in chart(found).texts
    ]
    assert design_results.comparison_summary(found)["failed"] == found.failed
    monkeypatch.setattr(optics_comparison, "_compared", lambda *_: {}["nothing"])
    with pytest.raises(
        AmiwarpError, match=r"vibration: no such motor .*; wedge: KeyError: 'nothing'"
    ):
        compare(compared.design, scene, depths=[0.5])


def test_settings_repeat_after_their_turns() -> None:
    assert SETTINGS["pair, unequal"].ratio == Fraction(-1, 2)
    assert {name: each.turns for name, each in SETTINGS.items() if each.turns > 1} == {
        "pair, unequal": 2, "mirror, 3:4": 3,
    }  # fmt: skip
    for each in SETTINGS.values():
        model = each.model(CAMERA)
        pixel, ends = np.array([[20.0, 30.0]] * 2), 2.0 * np.pi * np.array([0.1, 0.1 + each.turns])
        first, last = model.compensate_points(pixel, ends)
        np.testing.assert_allclose(last, first, rtol=0, atol=1e-3)  # px


# What people read.


def test_no_letters_of_the_chart_overlap(compared: Comparison) -> None:
    figure = chart(compared)
    figure.canvas.draw()
    found = [t for t in figure.findobj(Text) if t.get_text().strip() and t.get_visible()]
    boxes = [(t.get_text(), Text.get_window_extent(t).shrunk(0.95, 0.85)) for t in found]
    crossing = [
        (a, b) for (a, box), (b, other) in itertools.combinations(boxes, 2) if box.overlaps(other)
    ]
    assert crossing == []
    outside = [
        text
        for text, box in boxes
        if box.x0 < 0.0 or box.y0 < 0.0 or (box.max > figure.bbox.max).any()
    ]
    assert outside == []


def test_the_command_writes_the_comparison(tmp_path: Path, texture: np.ndarray) -> None:
    app = typer.Typer()
    command(app, command_line.run_design, name="design", example="")
    picture = tmp_path / "picture.png"
    Image.fromarray(texture).save(picture)
    grid = [
        "--size",
        "32x32",
        "--fov-deg",
        "5",
        "--apex-deg",
        "1",
        "--rpm",
        "720",
        "--picture",
        str(picture),
    ]
    out = tmp_path / "out"
    run = CliRunner().invoke
    refused = run(app, [*grid, "--out", str(out), "--depth-m", "1"])
    assert refused.exit_code == 1
    assert "--depth-m applies to the comparison" in str(refused.exception)
    assert not out.exists()
    result = run(
        app,
        [*grid, "--out", str(out), "--compare", "--depth-m", "0.5", "--json", "--device", "cpu"],
    )
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout)
    names = [
        f"{name}.{kind}" for name in ("design", "optics") for kind in ("csv", "json", "png", "svg")
    ]
    assert sorted(path.name for path in out.iterdir()) == names
    assert json.loads((out / "optics.json").read_text()) == said["comparison"]
    rows = list(csv.DictReader((out / "optics.csv").read_text().splitlines()))
    assert [row["optic"] for row in rows] == [o["optic"] for o in said["comparison"]["optics"]]
    assert [o["optic"] for o in said["comparison"]["optics"]] == [
        "wedge", "pair, opposite", "pair, unequal", "mirror, circle", "mirror, 3:4", "vibration", "plate, 0.5 m",
    ]  # fmt: skip
    assert [o["depth_determined"] for o in said["comparison"]["optics"]] == [False] * 6 + [True]
    assert said["comparison"]["recommended"]["depth"] == "plate, 0.5 m"
    with Image.open(out / "optics.png") as drawn:
        assert drawn.size[0] > 1000


def test_the_table_of_the_command(compared: Comparison, capsys: pytest.CaptureFixture[str]) -> None:
    report(Common(), {}, design_results.comparison_lines(compared))
    said = capsys.readouterr().out.splitlines()
    (row,) = [line for line in said if line.startswith("pair, opposite")]
    assert "never" in row
    assert "not determined" in row
    assert row.endswith("edges")
    assert any(line.startswith("depth") and "± " in line for line in said)
    assert compared.results[0].blur_px > QUANTISATION_PX
