"""Figures for print and VTP files of what the inspector shows."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
from matplotlib.cm import ScalarMappable
from matplotlib.text import Text
from PIL import Image

from amiwarp import (
    Calibration,
    Camera,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    event_clouds,
    open_recording,
    save_recording,
    simulate,
)
from amiwarp.choices import Axis, Colour, View
from amiwarp.imaging.regions import inside
from amiwarp.plotting import Scale
from amiwarp.plotting.figures import blank
from amiwarp.viewer import ImageKind, Inspector, Look, captions, images, publish
from amiwarp.viewer.look import CAMERA_DIRECTIONS
from reference.calibration_sample import exact_calibration
from tests.viewer.test_view_cli import view

REGION = (20, 10, 90, 70)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory, texture: np.ndarray) -> Path:
    folder = tmp_path_factory.mktemp("publish")
    camera, prism = Camera.from_fov(120, 90, math.radians(50)), Prism(math.radians(1.0))
    recording = simulate(
        texture, camera, prism, duration_s=0.2, seed=1, nominal_prism=Prism(math.radians(1.3))
    )
    save_recording(folder / "recording.h5", recording)
    assert recording.truth is not None
    found = {"apex": prism.apex, "phase": recording.truth.parameters["phase"]}
    exact_calibration(camera, prism, found).save(folder / "c.json")
    save_recording(folder / "plain.h5", Recording(recording.events))
    return folder


@pytest.fixture
def inspector(files: Path) -> Inspector:
    made = Inspector(open_recording(files / "recording.h5"), Calibration.load(files / "c.json"))
    made.open(*made.first_window(), replace(made.selection, region=REGION))
    return made


def text_of(figure: Any) -> str:
    """Return all texts of a figure."""
    return "\n".join(text.get_text() for text in figure.findobj(Text))


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Figures that are drawn from here on."""
    figures: list[Any] = []

    def kept(*args: Any, **options: Any) -> Any:
        figures.append(blank(*args, **options))
        return figures[-1]

    monkeypatch.setattr(publish, "blank", kept)
    return figures


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "head"),
    [
        ("a.png", ["--size", "100x80mm", "--dpi", "150"], b"\x89PNG"),
        ("a.png", ["--size", "600x500", "--dpi", "120"], b"\x89PNG"),
        ("a.svg", [], b"<?xml"),
        ("a.pdf", ["--size", "90x70mm"], b"%PDF"),
    ],
)
def test_a_figure_has_the_wanted_size(
    files: Path, tmp_path: Path, name: str, options: list[str], head: bytes, drawn: list[Any]
) -> None:
    given = [
        files / "recording.h5",
        "--calibration",
        files / "c.json",
        "--region",
        ",".join(map(str, REGION)),
    ]
    code, said, error = view(*given, "--screenshot", tmp_path / name, *options, "--json")
    assert code == 0, error
    data, content = json.loads(said), (tmp_path / name).read_bytes()
    assert content.startswith(head)
    assert data["region"] == list(REGION)
    if name.endswith("png"):
        wanted = (591, 472) if "150" in options else (600, 500)
        with Image.open(tmp_path / name) as picture:
            assert np.abs(np.subtract(picture.size, wanted)).max() <= 1
            assert picture.info["dpi"][0] == pytest.approx(float(options[-1]), abs=0.1)
    elif name.endswith("svg"):
        assert b'width="510.2' in content  # pt: 180 mm
        assert b"<image" in content  # the points
    else:
        assert b"/MediaBox [ 0 0 255.1181" in content  # pt: 90 mm
    [figure] = drawn
    text = text_of(figure)
    for words in ("as recorded", "compensated", "x [px]", "y [px]", "θ [°]", "apex angle [°]", "phase [°]",
                  "events per pixel", "x 20 to 90, y 10 to 70 px", "ON: brighter", "model exact: apex 1°"):  # fmt: skip
        assert words in text.replace("\n", " ")
    assert f"{data['events']:,} events" in text.replace("\n", " ")


@pytest.mark.parametrize(
    ("kind", "across", "up"), [(View.XY, 0, 1), (View.X_THIRD, 0, 2), (View.Y_THIRD, 1, 2)]
)
def test_points_are_where_the_model_moves_them(
    inspector: Inspector, kind: View, across: int, up: int
) -> None:
    shown, look = inspector.show(), Look(Colour.POLARITY, Axis.ANGLE)
    ax = publish._draw_cloud(
        blank((4.0, 3.0)), (1, 1, 1), shown.after, shown, look, kind, stride=3, after=True
    )
    found, third = np.asarray(ax.collections[0].get_offsets()), np.degrees(shown.theta)[::3]
    x, y = shown.after[::3].T
    within = (x >= 19.5) & (x <= 89.5) & (y >= 9.5) & (y <= 69.5)
    assert 0 < np.count_nonzero(within) < len(x)
    points = [values[within] for values in (x, y, third)]
    np.testing.assert_allclose(found, np.column_stack([points[across], points[up]]), atol=1e-4)
    limits = (19.5, 89.5), (69.5, 9.5), (0.0, 360.0)  # y points down, as in the image
    assert (ax.get_xlim(), ax.get_ylim()) == (limits[across], limits[up])
    on = shown.events.p[::3][within] == 1
    colours = ax.collections[0].get_facecolors()[:, :3]
    assert len(np.unique(colours[on], axis=0)) == len(np.unique(colours[~on], axis=0)) == 1
    assert not np.array_equal(colours[on][0], colours[~on][0])


def test_in_three_dimensions_it_is_seen_as_in_the_inspector(inspector: Inspector) -> None:
    shown, look = inspector.show(), Look(Colour.POLARITY, Axis.TIME)
    ax = publish._draw_cloud(
        blank((4.0, 3.0)), (1, 1, 1), shown.before, shown, look, View.FREE, stride=1, after=False
    )  # fmt: skip
    x, _, t = ax.collections[0]._offsets3d
    assert len(x) == len(shown.events)
    np.testing.assert_allclose(t, (shown.events.t - shown.span.first_us) * 1e-3)
    away = np.array(CAMERA_DIRECTIONS[View.FREE][0])
    elevation, azimuth = math.radians(ax.elev), math.radians(ax.azim)
    seen = [
        math.cos(elevation) * math.cos(azimuth),
        math.cos(elevation) * math.sin(azimuth),
        math.sin(elevation),
    ]
    np.testing.assert_allclose(seen, away / np.linalg.norm(away))
    assert ax.get_ylim() == (69.5, 9.5)
    assert ax.get_zlabel() == "t [ms]"


def test_values_get_the_colours_of_their_scale() -> None:
    scale, values = (
        Scale("a", "b", 1.0, 9.0, "cividis", 0.5),
        np.array([[0.0, 1.0, 3.0, 7.0, 9.0, 11.0]]),
    )
    made = ScalarMappable(**publish._mapped(scale)).to_rgba(values, bytes=True)[..., :3]
    # A step of the 256 colours
    np.testing.assert_allclose(made.astype(int), scale.rgb(values), atol=3)


def test_curves_and_marks_are_those_of_the_inspector(inspector: Inspector) -> None:
    ax = blank((3.0, 2.0)).subplots()
    publish._draw_curve(ax, inspector, "phase")
    values, sharpness = inspector.curve("phase")
    np.testing.assert_allclose(ax.lines[0].get_xdata(), np.degrees(values))
    np.testing.assert_allclose(ax.lines[0].get_ydata(), sharpness)
    marks = {line.get_label(): line.get_xdata()[0] for line in ax.lines[1:]}
    assert inspector.truth is not None
    assert marks == {
        "shown": pytest.approx(math.degrees(inspector.knobs.phase)),
        "truth": pytest.approx(math.degrees(inspector.truth.phase)),
    }


def test_rates_are_those_of_the_region() -> None:
    rng = np.random.default_rng(1)
    n = 20_000
    events = Events.from_arrays(rng.integers(0, 64, n), rng.integers(0, 48, n),
                                1000 + np.sort(rng.integers(0, 500_000, n)), rng.integers(0, 2, n))  # fmt: skip
    made = Inspector(Recording(MemoryEvents(events, 64, 48)))
    made.open(101_000, 200_000, replace(made.selection, region=(0, 0, 32, 48)))
    ax = blank((3.0, 2.0)).subplots()
    publish._draw_rates(ax, made)
    within = inside(events, (0, 0, 32, 48)) & (events.t >= 101_000) & (events.t < 301_000)
    first_ms = (101_000 - events.t[0]) * 1e-3
    for patch, polarity in zip(ax.patches, (1, 0), strict=True):
        values, edges, _ = patch.get_data()
        np.testing.assert_allclose(edges, first_ms + np.linspace(0.0, 200.0, 101))
        total = (values * 1e6 * np.diff(edges) * 1e-3).sum()
        assert total == pytest.approx(np.count_nonzero(within & (events.p == polarity)))


def test_a_vtp_holds_both_clouds(files: Path, tmp_path: Path, inspector: Inspector) -> None:
    out = tmp_path / "clouds.vtp"
    given = ["--region", ",".join(map(str, REGION)), "--json"]
    code, said, error = view(
        files / "recording.h5", "--calibration", files / "c.json", "--screenshot", out, *given
    )
    assert code == 0, error
    read, span = pyvista.read(out), inspector.loaded.span
    window = span.start_us, span.start_us + span.length_us
    pair = event_clouds(
        inspector.recording, Calibration.load(files / "c.json"), window=window, region=REGION
    )
    assert json.loads(said)["drawn"] == pair[0].n_points
    assert [np.count_nonzero(read["compensated"] == k) for k in (0, 1)] == [
        cloud.n_points for cloud in pair
    ]
    for k, cloud in enumerate(pair):
        part = read["compensated"] == k
        np.testing.assert_array_equal(read.points[part], cloud.points)
        for name in cloud.point_data:
            np.testing.assert_array_equal(read[name][part], cloud[name])
    assert read.field_data["t_first_us"].tolist() == [inspector.recording.events.t_first]
    assert [each.name for each in tmp_path.iterdir()] == ["clouds.vtp"]


def test_a_plain_recording_has_one_cloud_over_time(
    files: Path, tmp_path: Path, drawn: list[Any]
) -> None:
    code, said, error = view(files / "plain.h5", "--screenshot", tmp_path / "a.vtp", "--json")
    assert code == 0, error
    read, shown = (
        pyvista.read(tmp_path / "a.vtp"),
        Inspector(open_recording(files / "plain.h5")).show(),
    )
    assert read.n_points == json.loads(said)["drawn"] == len(shown.events)
    np.testing.assert_array_equal(read["t_us"], shown.events.t - shown.span.first_us)
    scale, start = read.field_data["z_scale"][0], read.field_data["z_start"][0]
    np.testing.assert_allclose(read.points[:, 2] / scale + start, read["t_us"] * 1e-3, atol=1e-3)
    np.testing.assert_allclose(read.points[:, 1], -shown.events.y.astype(float))
    code, _, error = view(files / "plain.h5", "--screenshot", tmp_path / "a.pdf")
    assert code == 0, error
    text = text_of(drawn[0])
    assert "rate [Mev/s]" in text
    assert "compensated" not in text


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["--screenshot", "a.vtp", "--size", "100x80"], "leave --size and --dpi out"),
        (["--screenshot", "a.vtp", "--dpi", "100"], "leave --size and --dpi out"),
        (["--screenshot", "a.pdf", "--dpi", "20"], "--dpi 20: give 50 to 1200"),
        (["--screenshot", "a.pdf", "--size", "20x80mm"], "must be 40 to 1000 mm"),
        (
            ["--screenshot", "a.pdf", "--size", "80mm"],
            "--size '80' is not a size; write it like 180x130mm",
        ),
        (["--screenshot", "a.svg", "--dark"], "leave --dark out"),
        (["--screenshot", "a.gif"], "written as .png, .svg, .pdf or .vtp"),
        (["--dpi", "300"], "give --screenshot too"),
        (["--size", "80x80mm"], "give --screenshot too"),
    ],
)
def test_what_no_figure_can_have_is_said(
    files: Path, tmp_path: Path, args: list[str], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, said, error = view(files / "recording.h5", *args)
    assert (code, said) == (1, "")
    assert says in error
    assert list(tmp_path.iterdir()) == []


def test_each_of_two_recordings_has_its_own_scale_and_bar(inspector: Inspector) -> None:
    events = inspector.recording.events
    few = MemoryEvents(events.slice(0, len(events))[::20], *events.size)
    alone = blank((6.0, 3.0))
    titles = captions.cloud_titles(inspector, "recorded", Axis.ANGLE)
    publish._draw_charts(alone, inspector, inspector.show(), titles, None, compensates=True)
    assert text_of(alone).count("events per pixel") == 1
    inspector.put_beside(Recording(few, inspector.camera, name="few"))
    figure, shown = blank((6.0, 3.0)), inspector.show()
    titles = captions.cloud_titles(inspector, "recorded", Axis.ANGLE)
    publish._draw_charts(figure, inspector, shown, titles, None, compensates=True)
    pair = images.make_images(inspector, ImageKind.COUNT, shown=shown)
    assert pair.after_scale is not None
    assert pair.scale.high < pair.after_scale.high
    tops = {
        ax.get_title().replace("\n", " "): ax.images[0].norm.vmax
        for ax in figure.axes
        if ax.images and ax.get_title()
    }
    assert tops == dict(zip(titles, (pair.scale.high, pair.after_scale.high), strict=True))
    assert text_of(figure).count("events per pixel") == 2


def test_a_figure_says_whose_angles_are_shown(
    inspector: Inspector, tmp_path: Path, drawn: list[Any]
) -> None:
    few = MemoryEvents(inspector.recording.events.slice(0, 5000), 120, 90)
    inspector.put_beside(Recording(few, inspector.camera, name="few"))
    inspector.open(inspector.recording.events.t_first, 5000)
    page = publish.Page(dpi=60)
    publish.save_figure(
        inspector, tmp_path / "a.png", page, view=View.FREE, look=Look(Colour.POLARITY, Axis.ANGLE)
    )
    assert "few, as recorded, at the prism angles of recording" in text_of(drawn[0]).replace(
        "\n", " "
    )
