"""The inspector's window, drawn off screen: sliders, keys, curves, and that it shows the inspector's values."""

import gc
import itertools
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from ctypes.util import find_library
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import pyvista
from pyvista.plotting.utilities.regression import image_from_window
from scipy.spatial import ConvexHull

from amiwarp import (
    AmiwarpError,
    Camera,
    DepthMap,
    Encoder,
    Events,
    MemoryEvents,
    Plate,
    Prism,
    Recording,
    save_recording,
    simulate,
)
from amiwarp.choices import Axis, Colour, View
from amiwarp.imaging.palette import OFF_COLOUR
from amiwarp.optics import MODELS
from amiwarp.plotting import depth_image
from amiwarp.plotting.colours import GREY, ticks
from amiwarp.plotting.meshes import Box
from amiwarp.viewer import (
    ImageKind,
    Inspector,
    Look,
    Window,
    address,
    clouds_film,
    make_images,
    sliders,
)
from amiwarp.viewer.axes import CORNERS, CloudAxes, Label, projected, tick_texts, view_matrix
from amiwarp.viewer.captions import RECORDED
from amiwarp.viewer.filters import step_rows
from amiwarp.viewer.images import DECAY_US
from amiwarp.viewer.job_progress import JobCancelled
from amiwarp.viewer.orbit_lines import orbit_lines
from amiwarp.viewer.shown_window import DisplayedWindow
from amiwarp.viewer.sliders import UNITS
from amiwarp.viewer.texts import fitting_font, font, text_width, wrapped
from amiwarp.viewer.window_charts import Chart
from amiwarp.viewer.window_images import thinned
from amiwarp.viewer.window_keys import MORE_KEYS, OF_OPTICS, OF_PLAIN
from amiwarp.viewer.window_layout import Rect, first_size, places
from amiwarp.viewer.window_paper import GAP, Paper
from amiwarp.viewer.window_sheets import PANEL_COLOURS

SIZE = (900, 600)
TRUE = Prism(math.radians(1.0))


@pytest.fixture(scope="module")
def recording(texture: np.ndarray) -> Recording:
    camera = Camera.from_fov(120, 90, math.radians(50))
    return simulate(
        texture, camera, TRUE, duration_s=0.25, seed=1, nominal_prism=Prism(math.radians(1.2))
    )


@pytest.fixture(scope="module", autouse=True)
def only_new_garbage() -> None:
    """Leave what earlier tests loaded out of the garbage collections here, which would take ten times as long."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def without_garbage() -> None:
    """Free the windows of earlier tests here: a helper thread would do it while VTK draws."""
    gc.collect()


@pytest.fixture
def window(recording: Recording) -> Iterator[Window]:
    made = Window(Inspector(recording), size=SIZE, off_screen=True)
    yield made
    made.scene.close()


def points(window: Window, k: int) -> np.ndarray:
    """Return the points of a cloud as VTK has them, at x, y [px] and on the third axis."""
    box, xyz = window.scene.box, np.asarray(window.scene._clouds[k].mapper.dataset.points, float)
    return np.stack([xyz[:, 0], -xyz[:, 1], xyz[:, 2] / box.stretch + box.low], axis=1)


def check(window: Window) -> None:
    """Both clouds are where the inspector says."""
    shown, third = window.inspector.show(), np.degrees(window.shown.theta)
    for k, xy in enumerate((shown.before, shown.after)):
        np.testing.assert_allclose(points(window, k), np.column_stack([xy, third]), atol=2e-3)


def drag(window: Window, name: str, value: float) -> None:
    """Move a slider to a value, and draw."""
    window.slide(name, value)
    assert window.run_once()


def said(window: Window) -> str:
    """Return what the column says."""
    return " ".join(window.sheets.controls.texts)


def chart(window: Window, name: str) -> Chart:
    """Return a chart by the name of the parameter, or "orbit" and "intervals"."""
    return window.sheets.charts[name]


def test_the_window_starts_as_the_page_does(window: Window, recording: Recording) -> None:
    """It shows the suggested region, with an estimated phase, one turn in the middle."""
    assert "phase estimated" in said(window)
    assert window.inspector.selection.region is not None
    assert window.inspector.window == Inspector(recording).first_window()
    assert set(window.sliders) == {
        "apex",
        "phase",
        "clock_offset",
        "tilt_x",
        "tilt_y",
        "start_ms",
        "length_ms",
    }
    check(window)
    assert f"{window.shown.selected:,} of these selected" in window.scene._caption.input


@pytest.mark.parametrize(
    ("name", "value"), [("apex", 0.7), ("phase", -30.0), ("clock_offset", 900.0), ("tilt_y", 5.0)]
)
def test_a_slider_moves_the_compensated_cloud(window: Window, name: str, value: float) -> None:
    before, after = points(window, 0), points(window, 1)
    mesh = window.scene._meshes[1]
    drag(window, name, value)
    assert window.inspector.knobs.value(name) == pytest.approx(value * UNITS[name], abs=1e-6)
    assert window.scene._meshes[1] is mesh  # the points are moved where they are
    check(window)
    assert np.abs(points(window, 1)[:, :2] - after[:, :2]).max() > 0.05
    np.testing.assert_array_equal(points(window, 0)[:, :2], before[:, :2])
    assert f"{value:g}" in window.sliders[name].title
    assert window.knob == name


def mouse(window: Window, event: str, place: tuple[int, int], *, shift: bool = False) -> None:
    """Send a mouse event at a place, in pixels from left and bottom, as a window system does."""
    interactor = window.plotter.iren.interactor
    interactor.SetEventInformation(*place, 0, int(shift), "\0", 0, None)
    interactor.InvokeEvent(f"{event}Event")


def pull(window: Window, place: tuple[int, int], button: str, *, shift: bool = False) -> None:
    """Press a button, move the mouse in steps, also over the other cloud, and release the button."""
    x, y = place
    mouse(window, f"{button}ButtonPress", place, shift=shift)
    for step in (10, 20, 30):
        mouse(window, "MouseMove", (x + step, y + step // 2), shift=shift)
    mouse(window, f"{button}ButtonRelease", (x + 30, y + 15), shift=shift)


def nine_places(window: Window) -> list[tuple[int, int]]:
    """Return nine places on the clouds, in pixels from left and bottom."""
    shown = [renderer.GetViewport() for renderer in window.scene._views if renderer.GetDraw()]
    left, bottom = shown[0][:2]
    width, height = window.plotter.window_size
    return [
        (
            round(width * (left + across * (1.0 - left))),
            round(height * (bottom + up * (1.0 - bottom))),
        )
        for across in (0.05, 0.45, 0.9)
        for up in (0.05, 0.5, 0.9)
    ]


def check_the_mouse_moves_the_camera(window: Window) -> None:
    """Each drag, and the wheel after it, moves the camera, and what is drawn follows."""
    camera = window.scene._views[0].camera
    for place in nine_places(window):
        window.look_from(View.FREE)
        assert window.run_once()
        picture = window.scene.picture()
        for action in (
            "Left",
            "MouseWheelForward",
            "shift",
            "Middle",
            "MouseWheelBackward",
            "Right",
        ):
            before = *camera.position, *camera.focal_point, *camera.up
            if action.startswith("MouseWheel"):
                mouse(window, action, place)
            elif action == "shift":
                pull(window, place, "Left", shift=True)
            else:
                pull(window, place, action)
            after = *camera.position, *camera.focal_point, *camera.up
            assert np.abs(np.subtract(after, before)).max() > 0.1, (place, action)
        assert window.run_once(), place
        # only the clouds, their frames and labels have changed, not texts, legends and charts
        changed = (window.scene.picture() != picture).any(axis=2)
        outside = changed.copy()
        for renderer in window.scene._views:
            (left, low), (width, height) = renderer.GetOrigin(), renderer.GetSize()
            bottom = len(changed) - low
            outside[bottom - height : bottom, left : left + width] = False
        assert changed.sum() > 1000, place
        assert not outside.any(), place


def test_the_mouse_turns_shifts_and_zooms_the_clouds(window: Window) -> None:
    """At nine places, beside each other and overlaid, and after help and statistics were shown."""
    while window.run_once():  # until the curves are there
        pass
    check_the_mouse_moves_the_camera(window)
    for key in ("h", "h", "i", "i"):
        window.key(key)
        assert window.run_once()
    window.toggle("overlaid")
    assert window.run_once()
    check_the_mouse_moves_the_camera(window)


def test_the_mouse_turns_a_cloud_without_charts(recording: Recording) -> None:
    made = Window(
        Inspector(replace(recording, encoder=None, prism=None)), size=SIZE, off_screen=True
    )
    assert not made.compensates
    check_the_mouse_moves_the_camera(made)
    made.scene.close()


def test_a_drag_that_leaves_a_cloud_turns_it_nevertheless(window: Window) -> None:
    """The mouse moves over help, charts and sliders, and is released there."""
    window.key("h")
    assert window.run_once()
    camera = window.scene._views[0].camera
    for end in ((450, 450), (600, 60), (60, 300)):  # help, charts, sliders
        mouse(window, "LeftButtonPress", (320, 260))
        mouse(window, "MouseMove", (330, 270))
        before = camera.position
        mouse(window, "MouseMove", end)
        mouse(window, "LeftButtonRelease", end)
        assert window.run_once()
        assert math.dist(camera.position, before) > 1.0
        assert window.knob == "apex"  # no slider has moved


def test_the_slider_of_the_size_is_that_of_a_vibrating_camera(recording: Recording) -> None:
    inspector = Inspector(replace(recording, encoder=None, prism=None))
    inspector.use_model("vibration")
    made = Window(inspector, size=SIZE, off_screen=True)
    assert list(made.sliders) == ["amplitude", "phase", "rpm", "start_ms", "length_ms"]
    drag(made, "amplitude", 0.35)
    assert made.sliders["amplitude"].title == "amplitude 0.35° (set by hand)"
    assert made.inspector.knobs.value("amplitude") == pytest.approx(math.radians(0.35), abs=1e-6)
    made.scene.close()


def test_a_depth_map_is_shown_as_an_image_and_as_points(window: Window) -> None:
    window.key("5")
    assert window.run_once()
    assert "there is no depth map" in said(window)
    camera = Camera.from_fov(40, 30, 1.0)
    rng = np.random.default_rng(0)
    x, y = (rng.integers(0, size, 4000).astype(np.uint16) for size in (40, 30))
    events = Events(
        x, y, np.sort(rng.integers(0, 100_000, 4000)), rng.integers(0, 2, 4000).astype(np.uint8)
    )
    inverse = np.full((30, 40), np.nan, np.float32)
    inverse[:15, :20], inverse[15:, :20] = 2.0, 1.25
    points = np.dstack([*np.mgrid[:30, :40][::-1], np.zeros((30, 40))]).astype(np.float32)
    points[..., 2] = 1.0 / inverse
    encoder = Encoder.constant_speed(720.0, 0, 100_000)
    inspector = Inspector(
        Recording(MemoryEvents(events, 40, 30), camera, encoder, Plate(0.01, 0.8))
    )
    inspector.use_depths(DepthMap(inverse, 0.05 * inverse, points))
    made = Window(inspector, size=SIZE, off_screen=True)
    # The map gives the depths
    assert list(made.sliders) == [
        "phase",
        "clock_offset",
        "start_ms",
        "length_ms",
    ]
    bar, image, cloud = made.sheets.depth
    place = (500, 400)  # on the left cloud
    assert made.plotter.iren.interactor.FindPokedRenderer(*place) is made.scene._views[0]
    made.key("5")
    assert made.run_once()
    assert [bool(each.GetDraw()) for each in (bar, image, cloud)] == [True] * 3
    assert made.plotter.iren.interactor.FindPokedRenderer(*place) is image
    shown = [next(actor.mapper.dataset for actor in each.actors.values() if hasattr(actor, "mapper"))
             for each in (image, cloud)]  # fmt: skip
    metres, scale = depth_image(inspector.depth)
    np.testing.assert_array_equal(
        np.asarray(shown[0]["colour"]).reshape(30, 40, 3)[::-1], scale.rgb(metres)
    )
    assert shown[0].bounds[:4] == (-0.5, 39.5, -29.5, 0.5)  # as the pixels of the clouds
    known = np.isfinite(inverse)
    found, (px, py, pz) = np.asarray(shown[1].points), points[known].T
    np.testing.assert_array_equal(found, np.column_stack([px, pz, -py]))
    np.testing.assert_array_equal(shown[1]["colour"], scale.rgb(metres[known]))
    made.key("1")
    assert made.run_once()
    assert not any(each.GetDraw() for each in made.sheets.depth)
    assert made.plotter.iren.interactor.FindPokedRenderer(*place) is made.scene._views[0]
    made.scene.close()


def test_sliders_set_the_time_window(window: Window, recording: Recording) -> None:
    drag(window, "length_ms", 20.0)
    drag(window, "start_ms", 50.0)
    assert window.inspector.window == (recording.events.t_first + 50_000, 20_000)
    check(window)
    t = window.shown.events.t
    assert t.min() >= recording.events.t_first + 50_000
    assert t.max() < recording.events.t_first + 70_000


def test_a_slider_stays_the_same_while_it_is_dragged(window: Window) -> None:
    """Also if it chooses another parameter, or there is a motion to compensate only from then on."""
    slider = window.sliders["phase"]
    for value in (10.0, 20.0):
        drag(window, "phase", value)
        assert window.sliders["phase"] is slider
        assert slider.value == pytest.approx(value)
    assert window.knob == "phase"
    assert "phase" in window.sheets.charts


def test_parameters_that_cannot_be_shown_are_refused(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    good, show = window.inspector.knobs, window.inspector.show

    def refusing(**given: Any) -> DisplayedWindow:
        if window.inspector.knobs.apex > math.radians(2.0):
            raise AmiwarpError("no such prism")
        return show(**given)

    monkeypatch.setattr(window.inspector, "show", refusing)
    drag(window, "apex", 2.2)
    assert "no such prism" in said(window)
    assert window.inspector.knobs == good
    assert window.sliders["apex"].value == pytest.approx(math.degrees(good.apex), abs=1e-3)


def test_events_without_a_solution_are_not_drawn(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    show = window.inspector.show
    for step in (3, 1):  # every third event has no solution; no event has one
        with monkeypatch.context() as patch:
            patch.setattr(
                window.inspector, "show", lambda step=step, **given: without(show(**given), step)
            )
            drag(window, "apex", 1.0 + 0.1 * step)
            cloud = window.scene._clouds[1]
            lost = np.isnan(window.shown.after[:, 0]).sum()
            assert lost == -(-len(window.shown.after) // step)
            assert cloud.visibility == (step == 3)
            assert step == 1 or len(points(window, 1)) == len(window.shown.after) - lost
            assert window.scene._clouds[0].visibility
            window._draw_at(7)
            assert cloud.visibility == (step == 3)
            window._draw_at(1)
    drag(window, "apex", 0.9)
    assert window.scene._clouds[1].visibility
    check(window)


def without(shown: DisplayedWindow, step: int) -> DisplayedWindow:
    """Return a window in which every ``step``-th event has no solution."""
    after = shown.after.copy()
    after[::step] = np.nan
    return replace(shown, after=after)


def test_many_moves_of_a_slider_cost_one_picture(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    shows: list[float] = []
    show = window.inspector.show
    monkeypatch.setattr(
        window.inspector, "show", lambda **given: shows.append(0.0) or show(**given)
    )
    for value in (0.5, 0.6, 0.7):
        window.slide("apex", value)
    window.run_once()
    assert len(shows) == 1
    assert window.inspector.knobs.apex == pytest.approx(math.radians(0.7), abs=1e-6)


def test_a_slow_renderer_draws_fewer_points_until_nothing_moves(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    everything = len(points(window, 1))
    window._coarse = 7
    drag(window, "apex", 0.8)
    assert len(points(window, 1)) == -(-everything // 7)
    assert f", {-(-everything // 7):,} of these drawn" in window.scene._caption.input
    monkeypatch.setattr("amiwarp.viewer.window.REST_S", 0.0)
    assert window.run_once()
    check(window)
    assert ", all of these drawn" in window.scene._caption.input


def test_curves_of_the_window_before_are_grey_until_the_new_ones_are_there(window: Window) -> None:
    def shown() -> list[tuple[str, str]]:
        lines = [chart(window, name).curves[0] for name in window._curve_names()]
        return [(line.label, line.colour) for line in lines]

    new, old = [("sharpness", "")] * 2, [("former window", GREY)] * 2
    assert sum(1 for _ in window._slow) > 0
    assert shown() == new
    window.whole()
    window.update()
    assert shown() == old
    assert sum(1 for _ in window._slow) > 0
    assert shown() == new
    window.step(1)
    window.update()
    assert shown() == old


def test_the_curves_have_their_top_at_the_true_parameters(
    window: Window, recording: Recording
) -> None:
    window.take_truth()
    window.update()
    steps = sum(1 for _ in window._slow)
    assert steps == sum(len(window.curves[name][0]) for name in ("apex", "phase"))
    for name, tolerance in (("apex", 0.1), ("phase", 8.0)):
        values, sharpness = window.curves[name]
        expected = window.inspector.curve(name)
        np.testing.assert_allclose(values * UNITS[name], expected[0])
        np.testing.assert_allclose(sharpness, expected[1])
        assert values[np.argmax(sharpness)] == pytest.approx(
            sliders.knob_values(window.inspector)[name], abs=tolerance
        )
        line, truth, now = chart(window, name).curves
        np.testing.assert_allclose(line.y, sharpness)
        assert truth.x[0] == now.x[0] == sliders.truths(window.inspector)[name]
    x, y = chart(window, "orbit").curves
    radius = np.hypot(x.y, y.y)
    camera = recording.camera
    assert camera is not None
    assert radius.mean() == pytest.approx(camera.fx * math.tan(TRUE.deflection), rel=0.1)


@pytest.mark.parametrize("cloud", [0, 1])
def test_a_click_describes_the_event_and_shows_its_orbit(window: Window, cloud: int) -> None:
    from vtkmodules.vtkRenderingCore import vtkCoordinate

    shown, renderer = window.shown, window.plotter.renderers[cloud]
    place = vtkCoordinate()
    place.SetCoordinateSystemToWorld()
    drawn = np.asarray(window.scene._clouds[cloud].mapper.dataset.points)
    place.SetValue(*drawn[1234])
    at = place.GetComputedDisplayValue(renderer)
    interactor = window.plotter.iren.interactor
    interactor.SetEventPosition(*at)
    interactor.InvokeEvent("LeftButtonPressEvent")
    interactor.InvokeEvent("LeftButtonReleaseEvent")
    window.run_once()
    k = window._picked
    place.SetValue(*drawn[k])
    assert math.dist(place.GetComputedDisplayValue(renderer), at) <= 6.0
    e = shown.events
    assert f"x {e.x[k]}, y {e.y[k]} px" in " ".join(said(window).split())
    x, _ = chart(window, "orbit").curves
    orbit, column = orbit_lines(window.inspector, shown, k)
    np.testing.assert_allclose(x.y, orbit[:, 0] - column[:, 0], atol=1e-3)
    np.testing.assert_allclose(column[0, :2], shown.after[k], atol=1e-3)
    window.pick((int(renderer.GetOrigin()[0]) + 3, int(renderer.GetOrigin()[1]) + 3))
    window.run_once()
    assert window._picked == -1
    drag(window, "length_ms", 20.0)
    assert window._picked == -1


def test_keys_do_what_the_help_says(window: Window) -> None:
    window.key("h")
    window.run_once()
    assert window.sheets.help.renderer.GetDraw()
    words = [words for _, words in window.sheets.help_rows]
    assert all(text in words for key, _, text in MORE_KEYS if key not in OF_PLAIN | {"5"})
    assert "redo; also Ctrl+Y" in words
    window.key("question")
    window.run_once()
    assert not window.sheets.help.renderer.GetDraw()

    pictures = [window.scene.picture()]
    for key in ("d", "k", "2", "o", "t", "plus", "n", "m", "w"):
        window.key(key)
        assert window.run_once(), key
        pictures.append(window.scene.picture())
        assert (pictures[-1] != pictures[-2]).any(), key
    assert window.look.dark
    assert window.look.overlaid
    assert (window.look.colour, window.look.axis, window.view) == (Colour.ANGLE, Axis.TIME, View.XY)
    assert window.look.point_size == 3.0
    assert (
        window.inspector.knobs.model
        == list(MODELS)[(list(MODELS).index("exact") + 1) % len(MODELS)]
    )
    assert (window.shown.events.p == 1).all()
    assert window.shown.region == (0, 0, 120, 90)


def test_steps_nudges_and_undo(window: Window) -> None:
    drag(window, "length_ms", 20.0)
    start = window.inspector.window
    assert start is not None
    window.key("Right")
    window.run_once()
    assert window.inspector.window == (
        pytest.approx(start[0] + window.inspector.turn_us, abs=50.0),
        start[1],
    )
    window.key("Tab")
    window.run_once()
    assert window.knob == "phase"
    phase = sliders.knob_values(window.inspector)["phase"]
    window.key("Up")
    window.run_once()
    assert sliders.knob_values(window.inspector)["phase"] == pytest.approx(phase + 0.25, abs=1e-3)
    for _ in range(2):
        window.key("z")
        window.run_once()
    assert sliders.knob_values(window.inspector)["phase"] == pytest.approx(phase)
    assert window.inspector.window == start
    drag(window, "length_ms", 15.0)
    for key in ("Right", "z"):  # an undo right after a change undoes that change, and can be redone
        window.key(key)
    window.run_once()
    assert window.inspector.window[0] == start[0]
    window.key("y")
    window.run_once()
    assert window.inspector.window[0] == pytest.approx(
        start[0] + window.inspector.turn_us, abs=50.0
    )
    window.key("q")
    assert window.closed


def test_statistics_of_the_region_are_those_of_the_page(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("amiwarp.viewer.window.REST_S", 0.0)
    window.key("i")
    for key in ("d", "n"):
        window.key(key)
        while window.run_once():
            pass
        assert window.sheets.side.renderer.background_color.hex_rgb == PANEL_COLOURS[True][0]
        found = window.inspector.statistics()
        for name, text in found["rows"]:
            assert f"{name}:  {text}" in window.sheets.statistics
        line, median = chart(window, "intervals").curves
        np.testing.assert_allclose(line.y, found["y"])
        assert median.x[0] == found["median"]
    assert ["ON", "100.0 %"] in found["rows"]
    assert window.sheets.side.renderer.GetDraw()
    window.key("i")
    window.run_once()
    assert not window.sheets.side.renderer.GetDraw()


def test_statistics_of_the_window_before_are_marked(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the recording is played, and after a change, until the new ones are there."""
    window.key("i")
    settle(window, monkeypatch)

    def title() -> tuple[str, str]:
        texts = [text for text, _, _ in texts_of(window) if text.startswith("Statistics of ")]
        assert len(texts) == 1
        return texts[0], chart(window, "intervals").curves[0].colour

    new, old = (
        ("Statistics of the selected events", OFF_COLOUR),
        ("Statistics of the former window", GREY),
    )
    assert title() == new
    window.key("space")
    for _ in range(2):
        window._played_s -= 0.1
        window.run_once()
        assert title() == old
    window.key("space")
    settle(window, monkeypatch)
    assert title() == new
    for change in ("n", "w"):
        window.key(change)
        window.run_once()
        assert title() == old, change
        settle(window, monkeypatch)
        assert title() == new, change
    drag(window, "apex", 0.9)  # of which the statistics of recorded events know nothing
    assert title() == new


def film_of(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.array(
            [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)], np.int16
        )


def test_a_film_goes_to_the_end_of_the_recording(recording: Recording, tmp_path: Path) -> None:
    inspector, last = Inspector(recording), recording.events.t_last + 1
    inspector.open(last - 60_000, 20_000)
    shares: list[float] = []
    film = {"look": Look(), "view": View.FREE, "what": "film", "speed": 0.25}
    made = clouds_film.write_film(
        tmp_path / "film.mp4", inspector, progress=lambda _, share: shares.append(share), **film
    )
    pictures = film_of(tmp_path / "film.mp4")
    assert made == len(pictures) == len(shares) == 5  # 10 ms of the recording each
    assert shares == [0.0, 0.2, 0.4, 0.6, 0.8]
    assert np.abs(pictures[0] - pictures[-1]).mean() > 0.5
    assert inspector.window == (last - 60_000, 20_000)
    ended = clouds_film.write_film(
        tmp_path / "part.mp4", inspector, progress=lambda *_: None, ended=lambda: True, **film
    )
    assert ended == len(film_of(tmp_path / "part.mp4")) == 1

    def stopped(_: str, share: float) -> None:
        if share > 0.3:
            raise JobCancelled

    with pytest.raises(JobCancelled):
        clouds_film.write_film(tmp_path / "none.mp4", inspector, progress=stopped, **film)
    assert {path.name for path in tmp_path.iterdir()} == {"film.mp4", "part.mp4"}


@pytest.mark.parametrize(("key", "films"), [("f", 1), ("c", 0)])
def test_a_film_of_the_window_is_ended_or_cancelled(
    window: Window, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, key: str, films: int
) -> None:
    monkeypatch.chdir(tmp_path)
    show, shares = window._show_progress, list[float]()

    def progress(what: str, share: float) -> None:
        shares.append(share)
        if len(shares) == 3:
            window.key(key)
        window._job_keys_due_s = 0.0
        show(what, share)
        assert "(f ends it, c cancels it)" in " ".join(said(window).split())

    monkeypatch.setattr(window, "_show_progress", progress)
    window.key("f")
    window.run_once()
    assert [len(film_of(path)) for path in tmp_path.iterdir()] == [3] * films
    assert ("saved" if films else "film cancelled") in said(window)
    assert len(shares) == 3
    assert not window._job_keys


FILM_OF_A_WINDOW = """
import sys
import numpy as np
from amiwarp import open_recording
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.window import Window

def seen():
    with open(sys.argv[2], "rb") as screen:
        return np.frombuffer(screen.read(), "<u4")[-640 * 480:].reshape(480, 640) & 0xffffff

window = Window(Inspector(open_recording(sys.argv[1])), size=(640, 480))
while window.run_once():
    pass
before, show, pictures = seen(), window._show_progress, []

def progress(what, share):
    window._job_keys_due_s = 0.0
    show(what, share)
    pictures.append(seen())
    if len(pictures) == 4:
        window.key("f")

window._show_progress = progress
window.key("f")
while window.run_once():
    pass
for after in (*pictures, seen()):
    differs = after != before
    print(differs.mean(), differs[:, 200:].mean(), (differs.any(axis=1)).sum())
print(window.message)
"""
"""A window on a display that makes a film: prints how much of the screen changes, with and without its column."""


@pytest.mark.skipif(
    find_library("X11") is None or shutil.which("Xvfb") is None, reason="needs Xvfb, an X server"
)
def test_a_film_leaves_the_window_on_a_display_as_it_was(
    recording: Recording, tmp_path: Path
) -> None:
    """Only the message changes, on the screen of the X server, while the film is made and afterwards."""
    save_recording(tmp_path / "r.h5", recording)
    read, write = os.pipe()
    screen = tmp_path / "Xvfb_screen0"
    server = subprocess.Popen(["Xvfb", "-displayfd", str(write), "-screen", "0", "640x480x24", "-fbdir", tmp_path],
                              pass_fds=[write], stderr=subprocess.DEVNULL)  # fmt: skip
    os.close(write)
    with server, os.fdopen(read) as number:
        plain = {
            key: value for key, value in os.environ.items() if key != "VTK_DEFAULT_OPENGL_WINDOW"
        }
        done = subprocess.run(
            [sys.executable, "-c", FILM_OF_A_WINDOW, tmp_path / "r.h5", screen],
            env={**plain, "DISPLAY": f":{number.readline().strip()}"},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=120.0,
            check=False,
        )
        server.terminate()
    assert done.returncode == 0, done.stderr
    *rows, message = [line for line in done.stdout.splitlines() if not line.startswith("Warp")]
    shares = np.array([row.split() for row in rows], float)
    assert message == f"saved r.film.mp4 in {tmp_path}"
    assert len(film_of(tmp_path / "r.film.mp4")) == 4
    assert len(shares) == 5
    assert (shares[:, 0] > 0.0).all()
    assert (shares[:, 0] < 0.03).all()
    assert (shares[:, 1] == 0.0).all()


def test_b_is_compared_with(window: Window) -> None:
    window.key("b")
    drag(window, "apex", 0.4)
    assert window._look.titles == ("compensated with B", "compensated with A")
    assert window.b is not None
    shown = window.inspector.show(against=window.b)
    np.testing.assert_allclose(points(window, 0)[:, :2], shown.before, atol=2e-3)
    assert np.abs(shown.before - shown.after).max() > 1.0


def test_a_time_without_events_is_said_and_the_picture_stays(
    window: Window, recording: Recording
) -> None:
    shown = window.shown
    events = recording.events.slice(0, len(recording.events))
    gap = Events.concatenate([events[:1], events[-9_000:]])
    window.inspector.recording = replace(
        window.inspector.recording, events=MemoryEvents(gap, *recording.events.size)
    )
    drag(window, "start_ms", 20.0)
    assert "take another window" in " ".join(said(window).split())
    assert window.shown is shown


def test_playing_moves_the_window_to_the_end(window: Window, recording: Recording) -> None:
    start = window.inspector.window
    assert start is not None
    window.key("space")
    window._played_s -= 0.1  # 10 ms of the recording
    window.run_once()
    assert window.inspector.window is not None
    assert window.inspector.window[0] >= start[0] + 10_000
    window._played_s -= 100.0
    window.run_once()
    assert not window.plays
    assert sum(window.inspector.window) == recording.events.t_last + 1


def test_playing_is_said_and_does_not_start_again_when_it_was_to_stop(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "playing" not in said(window)
    window.key("space")
    window.run_once()
    assert "playing at 0.1 × real time" in said(window)
    window.key("space")
    window.run_once()
    assert "playing" not in said(window)
    assert "stopped" in said(window)
    assert "end of the recording" not in said(window)
    window.key("space")
    window.run_once()
    assert window.plays
    assert "stopped" not in said(window)
    window._played_s -= 100.0
    window.run_once()
    assert "stopped at the end of the recording" in said(window)
    end = window.time_window
    window.key("space")  # of a user who saw the window move until just now
    window.run_once()
    assert not window.plays
    assert window.time_window == end
    window._ended_s -= 1.1
    window.key("space")
    window.run_once()
    assert window.plays
    assert window.time_window[0] < end[0]
    assert "stopped" not in said(window)
    window.key("space")
    window.key("Left")
    window.run_once()
    assert "end of the recording" not in said(window)


def test_a_file_without_a_prism_has_one_large_cloud(recording: Recording) -> None:
    plain = replace(recording, encoder=None, truth=None)
    window = Window(Inspector(plain), size=SIZE, off_screen=True)
    assert window._look.titles == (RECORDED,)
    assert window.look.axis is Axis.TIME
    assert list(window.sheets.charts) == ["intervals"]
    assert "no encoder" in said(window)
    assert window.plotter.renderers[0].GetViewport()[2] == 1.0
    middle = window.scene.picture()[200:400, 400:700].astype(int)
    assert (np.ptp(middle, axis=2) > 100).mean() > 0.1  # its points are there, in colour
    drag(window, "rpm", 720.0)  # now there is a motion to compensate
    assert "rpm" in window.sheets.charts
    assert len(window._look.titles) == 2
    window.scene.close()


def test_a_plain_recording_has_controls_of_a_prism_only_when_they_are_asked_for(
    recording: Recording,
) -> None:
    window = Window(
        Inspector(replace(recording, encoder=None, prism=None)), size=SIZE, off_screen=True
    )
    assert list(window.sliders) == ["start_ms", "length_ms"]
    count, length_us = window.shown.span.count, window.shown.span.length_us
    assert said(window).startswith(f"{count / length_us * 1e6:,.0f} events/s ")
    assert "encoder" not in said(window)
    for key in ("Up", "Down", "Tab"):  # of the parameter moved last: there is none
        window.key(key)
        window.run_once()
    window.key("comma")
    window.run_once()
    half = window.shown.span.count
    assert half == pytest.approx(count / 2, abs=20)
    window.key("period")
    window.run_once()
    assert window.shown.span.count == pytest.approx(2 * half, abs=20)
    window.key("x")
    window.run_once()
    assert list(window.sliders)[:3] == ["apex", "phase", "rpm"]
    assert "no encoder" in said(window)
    window.scene.close()


def test_the_calibration_and_a_picture_are_saved_under_new_names(
    window: Window, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    window.plotter.off_screen = (
        False  # on a display, PyVista takes no picture before its own show()
    )
    for key in ("s", "p", "p"):
        window.key(key)
        window.run_once()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert len(names) == 3
    assert [name.rpartition(".")[2] for name in names] == ["json", "png", "png"]
    assert "saved" in said(window)


def test_the_message_of_a_file_names_the_folder(
    window: Window, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for key, name in (("p", "simulation.picture.png"), ("s", "simulation.calibration.json")):
        window.key(key)
        assert window.message == f"saved {name} in {tmp_path}"
    assert ("p", "save a picture of the window") in window.sheets.help_rows


def test_the_first_state_is_also_that_of_light_and_dark(window: Window) -> None:
    for first in (False, True):
        window.look = replace(window.look, dark=first)
        window.first_dark = first
        for keys in ("do", "ddo", "do"):
            for key in (*keys, "r"):
                window.key(key)
                window.run_once()
            assert (window.look.dark, window.look.overlaid) == (first, False)


def test_calibrate_shows_its_progress_and_is_accepted(window: Window) -> None:
    window.whole()
    window.run_once()
    window.key("c")
    window.run_once()
    assert window.calibration_result is not None
    assert "Press a to accept" in " ".join(said(window).split())
    window.key("a")
    window.run_once()
    assert window.inspector.knobs.apex == pytest.approx(TRUE.apex, rel=0.05)
    check(window)


def test_a_calibration_is_cancelled_by_the_same_key(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    def find_calibration(_inspector: Inspector, *, progress: object) -> None:
        window.key("c")
        assert callable(progress)
        progress("fitting", 0.5)

    monkeypatch.setattr("amiwarp.viewer.calibration_job.find_calibration", find_calibration)
    window.key("c")
    window.run_once()
    assert "calibration cancelled" in said(window)
    assert window.calibration_result is None


def test_a_live_stream_is_followed(recording: Recording) -> None:
    half = recording.events.slice(0, len(recording.events) // 2)
    early = replace(recording, events=MemoryEvents(half, *recording.events.size))
    streams = [recording, early, early]
    window = Window(Inspector(early, latest=lambda: streams.pop() if len(streams) > 1 else recording), size=SIZE,
                    off_screen=True)  # fmt: skip
    assert window.plays
    for _ in range(3):
        window._played_s -= 1.0
        window.run_once()
    assert sum(window.inspector.window or ()) == recording.events.t_last + 1
    window.scene.close()


def test_a_live_stream_may_have_gone_on_while_the_window_was_made(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    half, size = len(recording.events) // 2, recording.events.size
    early = replace(recording, events=MemoryEvents(recording.events.slice(0, half), *size))
    late = replace(recording, events=MemoryEvents(recording.events.slice(half, 2 * half), *size))
    window = Window(Inspector(early, latest=lambda: late), size=SIZE, off_screen=True)
    assert window.shown.events.t.min() >= late.events.t_first
    settle(window, monkeypatch)
    whole, seconds = late.events.slice(0, half), np.diff(window.sheets.timeline.edges) * 1e-6
    np.testing.assert_allclose((window.sheets.timeline.rates * seconds).sum(), len(whole))
    window._counted_stop_us = (late.events.t_first + late.events.t_last) // 2
    window._rates_shown = ()
    window._show_timeline()
    known = np.isfinite(window.sheets.timeline.rates).all(axis=0)
    assert 0.4 < known.mean() < 0.6  # what came later has no rate of 0
    assert known[0]
    window.scene.close()


def test_an_empty_window_at_the_start_is_an_error(recording: Recording) -> None:
    inspector = Inspector(recording)
    inspector.window = recording.events.t_last + 1_000, 1_000
    with pytest.raises(AmiwarpError, match="take another window"):
        Window(inspector, size=SIZE, off_screen=True)


# The mouse on sliders, images and timeline, as a hand moves it


def strike(window: Window, *places: tuple[float, float], shift: bool = False) -> None:
    """Press the left button at a place, move the mouse over others, release it at the last one, and draw."""
    first, *others = [(round(x), round(y)) for x, y in places]
    mouse(window, "LeftButtonPress", first, shift=shift)
    for place in others:
        mouse(window, "MouseMove", place, shift=shift)
    mouse(window, "LeftButtonRelease", (others or [first])[-1], shift=shift)
    assert window.run_once()


def settle(window: Window, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the window do all that it does when nothing moves."""
    with monkeypatch.context() as patch:
        patch.setattr("amiwarp.viewer.window.REST_S", 0.0)
        while window.run_once():
            pass


def changed(window: Window, before: np.ndarray, rect: Rect) -> float:
    """Return the share of the pixels of a part of the window that differ from a picture before."""
    differs = (window.scene.picture() != before).any(axis=2)[::-1]
    return float(
        differs[round(rect.low) : round(rect.top), round(rect.left) : round(rect.right)].mean()
    )


def test_the_handle_of_a_slider_follows_the_mouse(window: Window) -> None:
    slider, camera = window.sliders["apex"], window.scene._views[0].camera.position
    x, y = slider.column(), 0.5 * (slider.track.low + slider.track.top)
    picture, places = window.scene.picture(), window.places
    # The mouse is not on the middle, and leaves the slider
    strike(window, (x + 2, y), (x + 12, y), (x + 42, y + 100))
    expected = slider.least + (x + 40 - slider.track.left) / slider.track.width * (
        slider.most - slider.least
    )
    assert math.degrees(window.inspector.knobs.apex) == pytest.approx(expected, abs=slider.step)
    assert slider.column() == pytest.approx(x + 40, abs=1.5)
    check(window)
    assert changed(window, picture, places.clouds) > 0.001
    assert changed(window, picture, places.images) > 0.01
    assert window.scene._views[0].camera.position == camera
    knobs = window.inspector.knobs
    mouse(window, "MouseMove", (round(x), round(y)))  # the button is no longer pressed
    window.run_once()
    assert window.inspector.knobs == knobs
    strike(window, (slider.track.left + 0.25 * slider.track.width, y))  # a click beside the handle
    quarter = slider.least + 0.25 * (slider.most - slider.least)
    assert math.degrees(window.inspector.knobs.apex) == pytest.approx(quarter, abs=0.02)
    now = math.degrees(window.inspector.knobs.apex)
    mouse(window, "MouseWheelForward", (round(x), round(y)))
    window.run_once()
    assert math.degrees(window.inspector.knobs.apex) == pytest.approx(now + slider.step, abs=1e-6)
    for _ in range(3):  # the wheel, the click, and the drag, each in one step
        window.key("z")
        window.run_once()
    assert math.degrees(window.inspector.knobs.apex) == pytest.approx(1.2, abs=1e-6)


def test_each_slider_is_under_its_own_title(window: Window) -> None:
    """The mouse takes the slider that it is on, from the first to the last one."""
    for name in list(window.sliders):
        slider = window.sliders[name]
        values = {
            each: window.sliders[each].value
            for each in window.sliders
            if each not in ("length_ms", "start_ms")
        }
        strike(
            window, (slider.column(), slider.track.low), (slider.column() + 15, slider.track.low)
        )
        moved = {each for each, value in values.items() if window.sliders[each].value != value}
        assert moved == {name} - {"start_ms", "length_ms"}, name
    assert window.time_window == window.inspector.window


def test_a_region_is_drawn_on_the_first_image(window: Window) -> None:
    window.whole()
    window.run_once()
    frame, size = window.sheets.images.frames[0], window.inspector.recording.events.size
    picture, places = window.scene.picture(), window.places

    def place(x: float, y: float) -> tuple[float, float]:
        return frame.left + x / size[0] * frame.width, frame.top - y / size[1] * frame.height

    mouse(window, "LeftButtonPress", tuple(map(round, place(20.5, 10.5))))
    mouse(window, "MouseMove", tuple(map(round, place(60.5, 50.5))))
    assert window.run_once()
    assert window.sheets.images._region_text() == "x 20 to 61, y 10 to 51 px"
    assert changed(window, picture, frame) > 0.02  # the region is drawn while the mouse moves
    assert changed(window, picture, places.clouds) == 0.0
    mouse(window, "MouseMove", tuple(map(round, place(80.5, 70.5))))
    mouse(window, "LeftButtonRelease", tuple(map(round, place(80.5, 70.5))))
    assert window.run_once()
    assert window.shown.region == (20, 10, 81, 71)
    assert window.inspector.selection.region == (20, 10, 81, 71)
    assert changed(window, picture, places.clouds) > 0.01
    check(window)
    # A region of a region, from its lower right corner on
    left, top, right, bottom = window.shown.region
    frame, (width, height) = window.sheets.images.frames[1], (right - left, bottom - top)
    corners = (frame.left + 40.5 / width * frame.width, frame.top - 30.5 / height * frame.height)
    strike(window, corners, (frame.left - 50, frame.top + 50))
    assert window.shown.region == (left, top, left + 41, top + 31)
    # No more than a click
    strike(window, (frame.left + 20, frame.top - 20), (frame.left + 21, frame.top - 21))
    assert window.shown.region == (left, top, left + 41, top + 31)
    window.key("z")
    window.run_once()
    assert window.shown.region == (20, 10, 81, 71)
    window.key("w")
    window.run_once()
    assert window.shown.region == (0, 0, *size)
    window.key("e")
    window.run_once()
    assert window.inspector.selection.region == window.inspector.suggest_region()


def test_the_mouse_reads_the_values_of_both_images(window: Window) -> None:
    window.whole()
    window.run_once()
    row, shown = window.sheets.images, window.shown
    y, x = np.unravel_index(np.argmax(shown.image_after), shown.image_after.shape)
    width, height = window.inspector.recording.events.size
    beside = round(row.frames[0].left), round(row.frames[0].top) + 5
    for frame in row.frames:
        at = (
            frame.left + (x + 0.5) / width * frame.width,
            frame.top - (y + 0.5) / height * frame.height,
        )
        mouse(window, "MouseMove", (round(at[0]), round(at[1])))
        assert window.run_once()
        before, after = shown.image_before[y, x], shown.image_after[y, x]
        assert row._under == f"x {x}, y {y} px: {before:g} events → {after:g} events"
        mouse(window, "MouseMove", beside)
        assert window.run_once()
        assert row._under == ""


def test_the_values_below_the_images_are_always_under_the_mouse(window: Window) -> None:
    """Also after a region was drawn, while nothing moves, and after the parameters have changed."""
    window.whole()
    window.run_once()
    row = window.sheets.images

    def check_at(place: tuple[int, int]) -> None:
        found = row.pixel_at(place)
        assert found is not None
        _, (x, y) = found
        before, after = window.shown.image_before[y, x], window.shown.image_after[y, x]
        expected = f"x {x}, y {y} px: {before:g} events → {after:g} events"
        assert row._under == expected
        assert expected in {text for text, _, _ in texts_of(window)}

    frame = row.frames[0]
    start, end = (
        (round(frame.left + 10), round(frame.top - 10)),
        (round(frame.left + 60), round(frame.top - 50)),
    )
    mouse(window, "MouseMove", start)
    window.run_once()
    check_at(start)
    strike(window, start, end)
    check_at(end)
    drag(window, "apex", 0.5)
    check_at(end)
    window.key("w")
    window.run_once()
    check_at(end)


def test_each_colour_bar_has_its_label_beside_it(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written upwards, right of the image; it says that the numbers are at square roots, if they are."""
    for key, label in (
        ("", "events per pixel (square root)"),
        ("6", "events per pixel (square root)"),
        ("6", "time"),
    ):
        if key:
            window.key(key)
        settle(window, monkeypatch)
        row = window.sheets.images
        frame = row.frames[-1]
        found = [(text, box) for text, box, _ in texts_of(window) if text.startswith(label)]
        assert len(found) == 1, label
        text, (left, right, low, top) = found[0]
        x, y = window.places.strip.left, window.places.strip.low
        assert x + left > frame.right
        assert right - left < 2.0 * window.places.font_px < top - low
        assert y + low >= frame.low - 2
        assert y + top <= frame.top + 2
        assert text.endswith("(square root)") == (row.panels[-1].scale.gamma == 0.5)


def test_the_images_are_those_of_the_page(window: Window, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each kind has the values of the inspector, in the colours of its scale; what is around is paper."""
    kinds = []
    for _ in range(12):
        kinds.append((window.image, window.difference))
        settle(window, monkeypatch)
        images = make_images(window.inspector, window.image, difference=window.difference)
        row = window.sheets.images
        for k, (values, scale) in enumerate(
            ((images.before, images.scale), (images.after, images.after_scale or images.scale))
        ):
            if values is None:
                assert row.panels[k].values is None
                continue
            np.testing.assert_array_equal(row.panels[k].values, values)
            assert row.panels[k].scale == scale
            frame = row.frames[k]
            seen = window.scene.picture()[::-1][
                int(frame.low) : int(frame.top), int(frame.left) : int(frame.right)
            ]
            rgb = scale.rgb(values)
            corners = [(0, 0), (0, -1), (-1, 0), (-1, -1)]
            assert all((seen[::-1][corner] == rgb[corner]).all() for corner in corners), (
                window.image,
                k,
            )
        window.key("6")
        assert window.run_once()
        if (window.image, window.difference) == kinds[0]:
            break
    names = {kind for kind, _ in kinds}
    assert names == set(ImageKind) - {ImageKind.DEPTH}
    assert (ImageKind.COUNT, True) in kinds
    frame = window.sheets.images.frames[0]
    beside = window.scene.picture()[::-1][int(frame.low) + 5, int(frame.left) - 4]
    assert (beside == 255).all()  # not black, which means no events


def test_the_kind_of_images_is_undone_and_set_by_a_state(window: Window) -> None:
    window.key("6")
    window.run_once()
    assert window.image is ImageKind.POLARITY
    assert window.history is not None
    assert window.history.state.image is ImageKind.POLARITY
    window.key("z")
    window.run_once()
    assert window.image is ImageKind.COUNT
    state = replace(
        window.history.state, difference=True, axis=Axis.TIME, view=View.XY, decay_us=500
    )
    window.show_state(state)
    window.request("knobs")
    window.run_once()
    assert window.difference
    assert window.remember("").state == state
    assert address.decode_state(
        address.encode_state(state, window.history.first), window.history.first,
        size=window.inspector.recording.events.size, duration_us=window.whole_us,
    ) == (state, ())  # fmt: skip


def test_brightness_stays_while_a_slider_moves(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    window.slide("apex", 0.2)
    settle(window, monkeypatch)
    slider, first = window.sliders["apex"], window.sheets.images.panels[1].scale
    x, y = round(slider.column()), round(slider.track.low)
    mouse(window, "LeftButtonPress", (x, y))
    for step in (20, 40, 60):
        mouse(window, "MouseMove", (x + step, y))
        window.run_once()
        assert window.sheets.images.panels[1].scale == first
    monkeypatch.setattr("amiwarp.viewer.window.REST_S", 0.0)
    assert not window.run_once()  # while the button is pressed, it does not rest
    assert window.sheets.images.panels[1].scale == first
    mouse(window, "LeftButtonRelease", (x + 60, y))
    settle(window, monkeypatch)
    now = window.sheets.images.panels[1].scale
    assert now == make_images(window.inspector, ImageKind.COUNT).scale != first


def test_the_timeline_moves_resizes_and_zooms(
    window: Window, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle(window, monkeypatch)
    line, first = window.sheets.timeline, recording.events.t_first
    y = 0.5 * (line.rect.low + line.rect.top)
    start, length = line.window
    px_us = line.column_of(1000.0) - line.column_of(0.0)  # pixels of a millisecond
    middle = line.column_of(start + 0.5 * length)
    camera = window.scene._views[0].camera.position
    strike(window, (middle, y), (middle + 5 * px_us, y), (middle + 10 * px_us, y + 300))
    assert window.inspector.window == (pytest.approx(first + start + 10_000, abs=500), length)
    check(window)
    assert window.scene._views[0].camera.position == camera
    start, _ = line.window
    strike(window, (line.column_of(start), y), (line.column_of(start + 20_000), y))
    assert window.inspector.window == (
        pytest.approx(first + start + 20_000, abs=500), pytest.approx(length - 20_000, abs=500),
    )  # fmt: skip
    end = sum(line.window)
    strike(window, (line.column_of(end), y), (line.column_of(end + 8_000), y))
    assert sum(line.window) == pytest.approx(end + 8_000, abs=500)
    assert line.window[0] == pytest.approx(start + 20_000, abs=500)
    strike(window, (line.column_of(200_000), y))  # a click moves the middle there
    assert line.window[0] + 0.5 * line.window[1] == pytest.approx(200_000, abs=600)
    before, picture = line.span, window.scene.picture()
    at = line.column_of(100_000)
    mouse(window, "MouseWheelForward", (round(at), round(y)))
    assert window.run_once()
    assert line.span[1] - line.span[0] == pytest.approx((before[1] - before[0]) / 1.25)
    assert line.column_of(100_000) == pytest.approx(at, abs=1.0)
    assert changed(window, picture, window.places.timeline) > 0.005
    assert changed(window, picture, window.places.clouds) == 0.0
    for _ in range(4):
        mouse(window, "MouseWheelForward", (round(at), round(y)))
        window.run_once()
    shown, held = line.span, line.time_at(at)
    strike(window, (at, y), (at + 60, y), shift=True)
    assert line.span[1] - line.span[0] == pytest.approx(shown[1] - shown[0])
    assert line.time_at(at + 60) == pytest.approx(held, abs=200)
    for _ in range(9):
        mouse(window, "MouseWheelBackward", (round(at), round(y)))
        window.run_once()
    assert line.span == (0.0, window.whole_us)


def test_the_timeline_has_the_rates_of_the_recording(
    window: Window, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle(window, monkeypatch)
    line, e = window.sheets.timeline, recording.events.slice(0, len(recording.events))
    seconds = np.diff(line.edges) * 1e-6
    counts = (line.rates * seconds).sum(axis=1)
    np.testing.assert_allclose(counts, [np.count_nonzero(e.p == 0), np.count_nonzero(e.p == 1)])
    k = 120
    inside = (e.t - recording.events.t_first >= line.edges[k]) & (
        e.t - recording.events.t_first < line.edges[k + 1]
    )
    np.testing.assert_allclose(
        line.rates[:, k] * seconds[k], [np.sum(inside & (e.p == 0)), np.sum(inside & (e.p == 1))]
    )


class BreakingOff(MemoryEvents):
    """Events of a file whose second chunk cannot be read."""

    def blocks(self, **_: Any) -> Iterator[Events]:
        yield self.slice(0, 100)
        raise AmiwarpError("damaged chunk; copy the file again")


def test_damage_found_while_counting_is_said_and_the_window_stays(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    events = recording.events
    damaged = BreakingOff(events.slice(0, len(events)), *events.size)
    window = Window(Inspector(replace(recording, events=damaged)), size=SIZE, off_screen=True)
    settle(window, monkeypatch)
    assert "damaged chunk" in window.message
    assert window.sheets.timeline.note == ""
    assert np.isnan(window.sheets.timeline.rates[0, -10:]).all()
    window.scene.close()


def test_the_timeline_follows_a_window_that_leaves_it(window: Window) -> None:
    line = window.sheets.timeline
    line.span = 0.0, 50_000.0
    drag(window, "length_ms", 10.0)
    drag(window, "start_ms", 150.0)
    low, high = line.span
    assert low < 155_000 < high
    assert high - low == 50_000.0


# The camera


def seen_depths(window: Window) -> list[np.ndarray]:
    """Return where the drawn points and the corners of the box lie between near (0) and far end (1) of each view."""
    box, depths = window.scene.box, []
    corners = np.array(
        list(
            itertools.product(
                (box.left, box.right), (-box.bottom, -box.top), (0.0, box.axis_height)
            )
        )
    )
    for renderer in window.scene.views:
        if not renderer.GetDraw():
            continue
        window.plotter.render_window.Render()
        for cloud in window.scene._clouds:
            if renderer.HasViewProp(cloud):
                drawn = np.concatenate([corners, np.asarray(cloud.mapper.dataset.points)])
                depths.append(projected(drawn, view_matrix(renderer), renderer.GetSize())[1])
    return depths


def test_no_change_of_the_view_cuts_the_clouds_off(recording: Recording) -> None:
    """A real sequence: overlaid, zoomed, side by side, overlaid, and back to the first state."""
    window = Window(
        Inspector(recording), look=Look(dark=True, overlaid=True), size=SIZE, off_screen=True
    )
    place = nine_places(window)[4]
    for action in (
        "o",
        "wheel",
        "wheel",
        "wheel",
        "wheel",
        "wheel",
        "wheel",
        "o",
        "o",
        "r",
        "o",
        "2",
        "1",
        "w",
        "k",
    ):
        if action == "wheel":
            mouse(window, "MouseWheelForward", place)
        else:
            window.key(action)
        assert window.run_once()
        depths = seen_depths(window)
        assert len(depths) == 2
        for depth in depths:
            # Zoomed, the camera may be in the box
            assert action == "wheel" or depth.min() >= 0.0, action
            assert depth.max() <= 1.0, action
    window.scene.close()


def test_a_new_region_does_not_turn_the_camera(window: Window) -> None:
    window.whole()
    window.run_once()
    pull(window, nine_places(window)[4], "Left")
    assert window.run_once()
    camera = window.scene._views[0].camera
    direction, up, place = camera.direction, camera.up, camera.position
    frame = window.sheets.images.frames[0]
    strike(window, (frame.left + 10, frame.top - 10), (frame.left + 60, frame.top - 50))
    assert window.shown.region != (0, 0, 120, 90)
    np.testing.assert_allclose(camera.direction, direction, atol=1e-9)
    assert np.dot(camera.up, up) > 0.9
    assert math.dist(camera.position, place) > 10.0
    box, renderer = window.scene.box, window.scene._views[0]
    corners = np.array(
        list(
            itertools.product(
                (box.left, box.right), (-box.bottom, -box.top), (0.0, box.axis_height)
            )
        )
    )
    places_of, _ = projected(corners, view_matrix(renderer), renderer.GetSize())
    assert (places_of > 0.0).all()
    assert (places_of < renderer.GetSize()).all()
    assert (np.ptp(places_of, axis=0) / renderer.GetSize()).max() > 0.5
    window.plotter.window_size = (1000, 700)
    assert window.run_once()
    np.testing.assert_allclose(camera.direction, direction, atol=1e-9)
    window.key("1")
    window.run_once()
    assert math.dist(camera.direction, direction) > 0.05


def test_labels_are_readable_in_front_of_events_and_not_cut(window: Window) -> None:
    """Events lie behind the numbers, as a wrong apex angle moves them; a line is between zoomed clouds, which touch."""
    window.draw_region((40, 30, 80, 60))
    window.run_once()
    drag(window, "apex", 2.2)
    window.key("3")
    window.run_once()
    covered = 0
    for _ in range(4):
        mouse(window, "MouseWheelForward", nine_places(window)[4])
        assert window.run_once()
        picture, height = window.scene.picture(), window.plotter.window_size[1]
        for k, renderer in enumerate(window.scene._views):
            x, y = renderer.GetOrigin()
            size = renderer.GetSize()
            drawn, _ = projected(
                np.asarray(window.scene._clouds[k].mapper.dataset.points),
                view_matrix(renderer),
                size,
            )
            for label in window.scene._axes[k].labels():
                half = 0.4 * text_width(label.text, 10), 3.0
                behind = (np.abs(drawn - label.place) < half).all(axis=1)
                covered += behind.any()
                left, low = (round(at - reach) for at, reach in zip(label.place, half, strict=True))
                right, top = (
                    round(at + reach) for at, reach in zip(label.place, half, strict=True)
                )
                part = picture[height - y - top : height - y - low, x + left : x + right].astype(
                    int
                )
                assert np.ptp(part, axis=2).max() < 30, label  # grey letters on white
        for text, (left, right, low, top), (wide, high) in texts_of(window):
            assert left >= -1, text
            assert right <= wide + 1, text
            assert low >= -2, text
            assert top <= high + 2, text
        second = window.scene._views[1]
        column = picture[height - second.GetOrigin()[1] - second.GetSize()[1] // 2, :, :]
        assert tuple(column[second.GetOrigin()[0]]) == pyvista.Color(GREY).int_rgb
    assert covered > 0


# Layout, texts and axes


def test_the_first_size_fits_the_screen() -> None:
    assert first_size((1920, 1080)) == (1500, 950)
    assert first_size((1366, 768)) == (1366, 698)
    assert first_size((1280, 1024)) == (1280, 950)


@pytest.mark.parametrize("size", [(900, 600), (1366, 698), (1500, 950), (2560, 1400)])
def test_the_parts_of_the_window_lie_beside_each_other(size: tuple[int, int]) -> None:
    for compensates in (True, False):
        for statistics in (True, False):
            p = places(size, compensates=compensates, statistics=statistics)
            parts = [p.column, p.clouds, p.images, p.timeline]
            parts += [p.charts] if compensates else []
            parts += [p.side] if statistics else []
            assert sum(part.width * part.height for part in parts) == pytest.approx(
                size[0] * size[1]
            )
            assert all(min(part.width, part.height) >= 5 * p.font_px for part in parts)
            for k, one in enumerate(parts):
                assert min(one.left, one.low) >= 0.0
                assert one.right <= size[0]
                assert one.top <= size[1]
                for other in parts[:k]:
                    across = min(one.right, other.right) - max(one.left, other.left)
                    up = min(one.top, other.top) - max(one.low, other.low)
                    assert min(across, up) <= 1e-6
    fonts = [
        places((round(s * 1500), round(s * 950)), compensates=True, statistics=False).font_px
        for s in (0.5, 1, 2)
    ]
    assert fonts == [10, 12, 24]


def texts_of(
    window: Window,
) -> list[tuple[str, tuple[float, float, float, float], tuple[int, int]]]:
    """Return each visible text, its left, right, low and top in its renderer, and the size of that [px]."""
    found = []
    for renderer in window.plotter.renderers:
        if not renderer.GetDraw() or min(renderer.GetSize()) < 2:
            continue
        for prop in renderer.GetViewProps():
            if prop.IsA("vtkTextActor") and prop.GetVisibility() and prop.GetInput():
                box = [0.0] * 4
                prop.GetBoundingBox(renderer, box)  # from its place on
                x, y = prop.GetPositionCoordinate().GetComputedViewportValue(renderer)
                around = (x + box[0], x + box[1], y + box[2], y + box[3])
                found.append((prop.GetInput(), around, renderer.GetSize()))
    return found


@pytest.mark.parametrize("size", [(900, 600), (1366, 698), (1500, 950)])
@pytest.mark.parametrize("plain", [False, True])
def test_no_text_is_cut_off(
    recording: Recording, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int], plain: bool
) -> None:
    """Also help, statistics, long notes, and texts after the window has got another size; in one font."""
    shown = replace(recording, encoder=None, prism=None, truth=None) if plain else recording
    window = Window(Inspector(shown), size=(1200, 800), off_screen=True)
    settle(window, monkeypatch)
    picture = window.scene.picture()
    window.plotter.window_size = size
    assert window.run_once()
    assert window.places.size == size
    for keys in ((), ("i",), ("h",), ("k", "6"), ("k", "k", "6", "d"), ("2",), ("x", "6")):
        for key in keys:
            window.key(key)
        settle(window, monkeypatch)
        picture = window.scene.picture()
        assert picture.shape[:2] == size[::-1]
        texts = texts_of(window)
        assert len(texts) > 20
        for text, (left, right, low, top), (width, height) in texts:
            assert left >= -1, (keys, text)
            assert low >= -2, (keys, text)
            assert right <= width + 1, (keys, text)
            assert top <= height + 2, (keys, text)
    fonts = {
        prop.GetTextProperty().GetFontFile()
        for renderer in window.plotter.renderers
        for prop in renderer.GetViewProps()
        if prop.IsA("vtkTextActor")
    }
    assert fonts == {str(font())}
    window.scene.close()


@pytest.mark.parametrize("elevation", [-70, -20, 15, 80])
def test_labels_of_the_axes_are_outside_of_the_box(elevation: int) -> None:
    """From each side, they are outside of the box in the picture, without overlaps, on the right edges."""
    plotter = pyvista.Plotter(off_screen=True, window_size=[500, 400])
    box, camera = Box(20, 30, 140, 120, 0.0, 360.0), plotter.renderer.camera
    plotter.add_mesh(
        pyvista.Box((20, 140, -120, -30, 0, box.axis_height)), render=False, reset_camera=False
    )
    axes, middle = CloudAxes(plotter.renderer), np.array([80.0, -75.0, 0.5 * box.axis_height])
    axes.label(box, ("x", "y", "θ"), ("white", "black"), 12)
    camera.focal_point, camera.up, camera.view_angle = middle, (0.0, 0.0, 1.0), 30.0
    ends = np.array([(20, 140), (-120, -30), (0, box.axis_height)])
    for azimuth in range(0, 360, 24):
        a, e = math.radians(azimuth), math.radians(elevation)
        away = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
        camera.position = tuple(middle + 450.0 * away)
        labels = axes.labels()
        corners, _ = projected(
            np.take_along_axis(ends.T, CORNERS, axis=0),
            view_matrix(plotter.renderer),
            plotter.window_size,
        )
        check_labels(labels, corners, least={"x", "y", "θ"} if abs(elevation) < 70 else {"x", "y"})
    plotter.close()


def check_labels(labels: list[Label], corners: np.ndarray, least: set[str]) -> None:
    """Labels are outside of the box, apart, and those of an axis at an edge of the outline that is parallel to it.

    ``corners``: those of the box in the picture [px]; ``least``: titles that are there.
    """
    hull = ConvexHull(corners)
    outline = {frozenset(simplex) for simplex in hull.simplices.tolist()}
    assert {label.text for label in labels} >= least
    for k, label in enumerate(labels):
        # Beyond a side of the outline
        assert (hull.equations @ [*label.place, 1.0]).max() > 4.0, label
        for other in labels[:k]:
            apart = np.abs(np.subtract(label.place, other.place))
            assert apart[0] > 0.4 * 12 or apart[1] > 0.9 * 12, (label, other)
        if label.text in ("x", "y", "θ"):
            axis = "xyθ".index(label.text)
            starts = np.flatnonzero(CORNERS[:, axis] == 0)
            stops = starts + (4, 2, 1)[axis]
            away = np.linalg.norm(0.5 * (corners[starts] + corners[stops]) - label.place, axis=1)
            nearest = int(np.argmin(away))
            assert frozenset((starts[nearest], stops[nearest])) in outline, label


def test_numbers_of_the_axes_are_where_their_values_are(window: Window) -> None:
    window.key("2")
    window.run_once()
    scene, box = window.scene, window.scene.box
    labels = scene._axes[0].labels()
    renderer = scene._views[0]
    for label in labels:
        if not label.text.isdigit():
            continue
        ends = np.array(
            [[float(label.text), -box.bottom, 0.0], [box.left, -float(label.text), 0.0]]
        )
        (at_x, at_y), _ = projected(ends, view_matrix(renderer), renderer.GetSize())
        below = abs(label.place[0] - at_x[0]) < 1.0 and 0.0 < at_x[1] - label.place[1] < 30.0
        beside = abs(label.place[1] - at_y[1]) < 1.0 and 0.0 < at_y[0] - label.place[0] < 50.0
        assert below or beside, label
    assert {"x [px]", "y [px]"} <= {label.text for label in labels}
    assert "θ [°]" not in {label.text for label in labels}  # along which the camera looks


def test_points_are_as_large_as_pixels_in_the_image(window: Window) -> None:
    """So that an area with an event at each pixel has no gaps, and no point covers its neighbours."""
    window.whole()
    window.key("2")
    window.run_once()
    renderer, camera = window.scene._views[0], window.scene._views[0].camera
    pixel_px = renderer.GetSize()[1] / (2.0 * camera.parallel_scale)
    assert window.scene._clouds[0].prop.point_size == pytest.approx(pixel_px)
    window.key("plus")
    window.run_once()
    assert window.scene._clouds[0].prop.point_size == pytest.approx(1.5 * pixel_px)
    window.key("1")
    window.run_once()
    assert window.scene._clouds[0].prop.point_size == 3.0


def test_a_chart_has_two_numbers_at_each_axis(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle(window, monkeypatch)
    for name in ("apex", "phase", "orbit"):
        drawn = chart(window, name)
        for low, high in (drawn.x_range, drawn.y_range):
            values = ticks(low, high, 4 if high == 360.0 else 3)
            assert len(values) >= 2, name
            assert len(set(tick_texts(values.tolist()))) == len(values)
        for curve in drawn.curves:
            if len(curve.y):
                assert drawn.y_range[0] <= curve.y.min() <= curve.y.max() <= drawn.y_range[1]


def test_numbers_have_the_decimals_that_they_need() -> None:
    assert tick_texts([0.5, 1.0, 1.5]) == ["0.5", "1.0", "1.5"]
    assert tick_texts([0.0, 90.0, 180.0]) == ["0", "90", "180"]
    assert tick_texts([100_000.25, 100_000.5]) == ["100000.25", "100000.50"]
    assert tick_texts([-0.0, 0.1]) == ["0.0", "0.1"]


def test_while_the_camera_moves_only_the_clouds_are_drawn(
    window: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle(window, monkeypatch)
    window.key("h")
    window.run_once()
    drawn: list[set[str]] = []
    names = {window.sheets.strip.renderer: "strip", window.sheets.column.renderer: "column",
             window.sheets.help.renderer: "help", window.scene._views[0]: "cloud"}  # fmt: skip
    for renderer, name in names.items():
        renderer.AddObserver("StartEvent", lambda *_, name=name: drawn[-1].add(name))
    x, y = nine_places(window)[0]  # below the help
    mouse(window, "LeftButtonPress", (x, y))
    window.plotter.iren.interactor.EnableRenderOff()  # as while the window handles the events of a display
    for step in (5, 10):
        drawn.append(set())
        mouse(window, "MouseMove", (x + step, y))
        assert window.run_once()
        window.plotter.iren.interactor.EnableRenderOff()
    assert drawn == [{"cloud", "help"}] * 2  # the help lies over the clouds
    drawn.append(set())
    mouse(window, "LeftButtonRelease", (x + 10, y))
    window.key("d")
    assert window.run_once()
    assert drawn[-1] == {"cloud", "help", "strip", "column"}


# Plain recordings


@pytest.fixture
def plain(recording: Recording) -> Iterator[Window]:
    made = Window(
        Inspector(replace(recording, encoder=None, prism=None, truth=None)),
        size=SIZE,
        off_screen=True,
    )
    yield made
    made.scene.close()


def test_a_plain_recording_has_no_keys_of_a_prism(plain: Window) -> None:
    keys = {key for key, _ in plain.sheets.help_rows}
    assert not keys & OF_OPTICS
    assert "x" in keys
    assert not any("prism" in words for key, words in plain.sheets.help_rows if key != "x")
    knobs, look = plain.inspector.knobs, plain.look
    for key in ("t", "m", "c", "b", "v"):
        plain.key(key)
        plain.run_once()
        assert "with a prism; x: set a prism" in said(plain)
    assert (plain.inspector.knobs, plain.look) == (knobs, look)
    assert plain.b is None
    plain.key("x")
    plain.run_once()
    assert {key for key, _ in plain.sheets.help_rows} >= OF_OPTICS
    plain.key("t")  # there is still no motion, and so no angle
    plain.run_once()
    assert plain.look.axis is Axis.TIME


def test_steps_and_playing_keep_the_number_of_events(
    plain: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain.key("comma")
    plain.run_once()
    count = plain.inspector.fixed_count
    assert count is not None
    assert f"({count:,} events)" in plain.sliders["length_ms"].title
    assert plain.shown.span.count == pytest.approx(count, abs=5)
    before, lengths = plain.inspector.window, set()
    assert before is not None
    for key in ("Right", "Right", "Left"):
        plain.key(key)
        plain.run_once()
        assert plain.inspector.window is not None
        assert plain.shown.span.count == pytest.approx(count, abs=5)
        lengths.add(plain.inspector.window[1])
    assert len(lengths) > 1
    # From the end of the first window on
    assert plain.inspector.window[0] == pytest.approx(sum(before), abs=3)
    plain.key("space")
    plain._played_s -= 0.1
    plain.run_once()
    assert plain.shown.span.count == pytest.approx(count, abs=5)
    plain.key("space")
    line = plain.sheets.timeline
    y, end = 0.5 * (line.rect.low + line.rect.top), sum(line.window)
    strike(plain, (line.column_of(end), y), (line.column_of(end) + 20, y))  # sets a length again
    assert plain.inspector.fixed_count is None
    length = plain.time_window[1]
    plain.key("Left")
    plain.run_once()
    assert plain.time_window[1] == length


def test_filters_say_the_rates_before_and_after_them(plain: Window) -> None:
    everything = plain.shown.selected
    plain.key("8")
    plain.run_once()
    assert plain.inspector.selection.noise_us == 2_000
    assert plain.shown.selected < everything
    rows = step_rows(plain.shown.steps, plain.shown.read_us)
    assert [f"{name}: {rates}" for name, rates, _ in rows] == plain.sheets.controls.texts[
        1 : 1 + len(rows)
    ]
    assert rows
    plain.key("8")
    plain.key("7")
    plain.run_once()
    assert plain.inspector.selection.noise_us is None
    assert plain.inspector.selection.hide_hot
    assert "1 hot pixel hidden; x 73, y 28: 84 events/s" in said(plain)
    plain.key("bracketleft")
    plain.run_once()
    assert plain.image is ImageKind.DECAY
    assert plain.decay_us == DECAY_US // 2
    plain.key("bracketright")
    plain.run_once()
    assert plain.decay_us == DECAY_US


def test_hot_pixels_are_named_when_they_are_hidden(recording: Recording) -> None:
    events, size = recording.events.slice(0, len(recording.events)), recording.events.size
    rng = np.random.default_rng(1)
    places_of = {(7, 5): 4_000, (100, 80): 5_000, (60, 20): 3_000, (30, 70): 2_500}
    parts = [events]
    for (x, y), count in places_of.items():
        t = np.sort(rng.integers(events.t[0], events.t[-1], count))
        parts.append(
            Events(
                np.full(count, x, np.uint16),
                np.full(count, y, np.uint16),
                t,
                np.ones(count, np.uint8),
            )
        )
    together = Events.concatenate(parts)
    noisy = MemoryEvents(together[np.argsort(together.t, kind="stable")], *size)
    window = Window(Inspector(replace(recording, events=noisy, encoder=None, prism=None, truth=None)), size=SIZE,
                    off_screen=True)  # fmt: skip
    window.key("7")
    window.run_once()
    found = window.inspector.hot_pixels
    assert [(each.x, each.y) for each in found[:3]] == [(100, 80), (7, 5), (60, 20)]
    words = " ".join(said(window).split())
    assert (
        f"{len(found)} hot pixels hidden; with the highest rates: x 100, y 80: {found[0].rate:,.0f} ev"
        in words
    )
    assert f"x 60, y 20: {found[2].rate:,.0f} events/s" in words
    assert "x 30, y 70" not in words
    assert found[0].rate == pytest.approx(5_000 / 0.25, rel=0.05)
    window.key("7")
    window.run_once()
    assert "hot pixels hidden" not in said(window)
    window.scene.close()


def test_a_plain_recording_has_the_whole_image_beside_a_region(
    plain: Window, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle(plain, monkeypatch)
    assert plain.statistics_shown  # where a recording with a prism has its charts
    assert len(plain.sheets.images.panels) == 1
    plain.draw_region((20, 10, 80, 70))
    plain.run_once()
    whole, part = plain.sheets.images.panels
    events = plain.shown.span.events
    expected = np.zeros((90, 120))
    np.add.at(expected, (events.y, events.x), 1)
    np.testing.assert_array_equal(whole.values, expected)
    np.testing.assert_array_equal(part.values, expected[10:70, 20:80])
    frame = plain.sheets.images.frames[0]
    places_of = [
        (frame.left + x / 120 * frame.width, frame.top - y / 90 * frame.height)
        for x, y in ((5.5, 5.5), (40.5, 50.5))
    ]
    strike(plain, *places_of)  # on the whole image, also beyond the region
    assert plain.shown.region == (5, 5, 41, 51)


def test_a_large_image_shows_the_largest_values_of_squares() -> None:
    values = np.arange(35, dtype=np.float32).reshape(5, 7)
    values[0, 0] = np.nan
    np.testing.assert_array_equal(
        thinned(values, 2), [[8, 10, 12, 13], [22, 24, 26, 27], [29, 31, 33, 34]]
    )
    pair = np.stack([values, -values])
    assert thinned(pair, 3).shape == (2, 2, 3)
    np.testing.assert_array_equal(thinned(pair, 3)[1], [[-1, -3, -6], [-21, -24, -27]])
    assert thinned(values, 1) is values


def test_lines_of_text_are_as_wide_as_they_may_be() -> None:
    text = "the phase is estimated from the events: calibrate"
    lines = wrapped(text, 120.0, 12)
    assert " ".join(lines) == text
    assert len(lines) > 1
    for line, following in itertools.pairwise(lines):
        assert text_width(line, 12) <= 120.0 < text_width(f"{line} {following.split()[0]}", 12)
    assert wrapped("a\n\nb", 120.0, 12) == ["a", "", "b"]
    size = fitting_font(text, 200.0, 12)
    assert text_width(text, size) <= 200.0 < text_width(text, size + 1)
    assert fitting_font(text, 1000.0, 12) == 12


def test_paper_draws_where_it_is_told() -> None:
    """A line with a gap, an area, a picture from its top on, in pixels of the window; the next drawing is empty."""
    plotter = pyvista.Plotter(off_screen=True, window_size=[200, 100], shape=(1, 2), border=False)
    paper, part = Paper(plotter.renderers[1]), Rect(80, 20, 200, 100)
    rgb = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)

    def pixels() -> np.ndarray:
        plotter.render_window.Render()
        return image_from_window(plotter.render_window, ignore_alpha=True)[::-1]

    paper.clear(part, (200, 100), 12, ("white", "black"))
    paper.line([(100, 30.5), (120, 30.5), GAP, (150, 30.5), (170, 30.5)])
    paper.area(Rect(100, 50, 110, 60), "#0000ff")
    paper.picture(rgb, Rect(140, 40, 180, 80))
    paper.end()
    seen = pixels()
    dark = np.flatnonzero((seen[29:33] < 100).all(axis=2).any(axis=0))
    assert (dark.min(), dark.max()) == (100, pytest.approx(169, abs=1))
    assert not ((dark > 121) & (dark < 149)).any()
    assert (seen[55, 105] == (0, 0, 255)).all()
    assert [seen[y, x].tolist() for y in (70, 50) for x in (150, 170)] == rgb.reshape(4, 3).tolist()
    paper.clear(part, (200, 100), 12, ("white", "black"))
    paper.end()
    assert (pixels()[20:, 80:] == 255).all()
    plotter.close()
