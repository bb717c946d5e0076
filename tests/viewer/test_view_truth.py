"""The inspector shows the ground truth of a simulation: colours, legends, and the description of an event."""

import itertools
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image
from typer.testing import CliRunner

from amiwarp import (
    AmiwarpError,
    Cause,
    Events,
    MemoryEvents,
    Recording,
    Truth,
    WorldLabels,
    open_recording,
    save_recording,
)
from amiwarp.choices import Axis, Colour, View
from amiwarp.plotting.colours import CAUSE_COLOURS, GREY
from amiwarp.viewer import Inspector, Look, Selection
from amiwarp.viewer import inspector as viewer
from amiwarp.viewer import inspector as window
from amiwarp.viewer.captions import event_text
from amiwarp.viewer.cloud_colours import colours_of, legend_of
from amiwarp.viewer.drawn_truth import colours_on_offer, truth_text
from amiwarp.viewer.layout import initial_state
from amiwarp.viewer.scene import Scene
from tests.command_line import app

COUNT, SIZE = 6000, (40, 30)
WITHOUT = [Colour.POLARITY, Colour.ANGLE, Colour.TIME, Colour.DENSITY, Colour.RESIDUAL]


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Events of which the time gives the depth (t in µs is mm), the instance (t mod 3) and the cause (t mod 4)."""
    rng = np.random.default_rng(3)
    x, y = (rng.integers(0, most, COUNT).astype(np.uint16) for most in SIZE)
    t = np.sort(rng.integers(500, 60_000, COUNT))
    events = Events(x, y, t, rng.integers(0, 2, COUNT).astype(np.uint8))
    truth = Truth(
        {"apex": 0.02},
        stored_causes=(t % 4).astype(np.uint8),
        stored_instances=(t % 3).astype(np.uint16),
        stored_depths=np.where(t % 3 == 0, np.inf, t * 1e-3).astype(np.float32),
        labels=WorldLabels("box", ("floor", "red ball"), ("floor", "ball")),
    )
    return Recording(MemoryEvents(events, *SIZE), truth=truth, name="box")


@pytest.fixture
def inspector(recording: Recording) -> Inspector:
    made = Inspector(recording)
    made.open(0, 60_000)
    return made


@pytest.fixture(scope="module")
def scene() -> Iterator[Scene]:
    made = Scene((600, 300))
    yield made
    made.close()


def test_a_colour_is_offered_if_the_recording_has_its_truth(recording: Recording) -> None:
    assert recording.truth is not None
    assert colours_on_offer(None) == colours_on_offer(Truth({"apex": 0.02})) == WITHOUT
    assert colours_on_offer(recording.truth) == [
        *WITHOUT,
        Colour.CAUSE,
        Colour.INSTANCE,
        Colour.DEPTH,
    ]
    only = replace(recording.truth, stored_instances=None, stored_depths=None)
    assert colours_on_offer(only) == [*WITHOUT, Colour.CAUSE]
    state = initial_state(Inspector(replace(recording, truth=only)))
    assert state["colours"] == [c.value for c in (*WITHOUT, Colour.CAUSE)]
    assert state["truth"] == "per event: cause; 2 instances"
    assert truth_text(recording.truth) == "per event: cause, instance, depth; 2 instances"
    assert truth_text(None) == ""


def test_a_colour_without_truth_is_refused(recording: Recording) -> None:
    shown = Inspector(replace(recording, truth=None)).show()
    with pytest.raises(
        AmiwarpError,
        match=r"colour 'depth' needs ground truth .* choose among polarity, angle, time",
    ):
        colours_of(shown, Look(Colour.DEPTH), after=True)


def check(inspector: Inspector) -> None:
    """Check that the truth of the drawn events is theirs."""
    shown = inspector.show()
    t = shown.events.t
    assert np.array_equal(shown.truth.values(Colour.CAUSE), t % 4)
    assert np.array_equal(shown.truth.values(Colour.INSTANCE), t % 3)
    depth = shown.truth.values(Colour.DEPTH)
    np.testing.assert_allclose(depth[t % 3 > 0], t[t % 3 > 0] * 1e-3, rtol=1e-6)


def test_each_drawn_event_has_its_own_truth(
    inspector: Inspector, recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The window and the selection may leave out events, a large window is thinned, and a file is read in parts."""
    check(inspector)
    some = Selection(polarity=1, region=(5, 5, 30, 25))
    inspector.open(20_000, 15_000, some)
    assert 100 < inspector.show().selected < 0.3 * COUNT
    check(inspector)
    save_recording(tmp_path / "box.h5", recording)
    monkeypatch.setattr(viewer, "MOST_EVENTS", 1280)
    monkeypatch.setattr(window, "MOST_POINTS", 200)
    for each in (recording, open_recording(tmp_path / "box.h5")):
        thinned = Inspector(each)
        thinned.open(10_000, 45_000, some)
        assert thinned.show().span.count > 1280 == len(thinned.show().span.events)
        assert len(thinned.show().events) == 200
        check(thinned)


def test_points_that_are_left_out_take_their_truth_with_them(inspector: Inspector) -> None:
    shown = inspector.show()
    for read_before in (False, True):  # the second time, the values of all points are known already
        few = shown.every(7)
        assert np.array_equal(few.truth.values(Colour.CAUSE), few.events.t % 4)
        assert np.array_equal(few.truth.values(Colour.INSTANCE), few.events.t % 3)
        if not read_before:
            assert np.array_equal(shown.truth.values(Colour.CAUSE), shown.events.t % 4)


def test_legends_name_what_the_colours_show(inspector: Inspector) -> None:
    shown, share = inspector.show(), 100.0 / COUNT
    t = shown.events.t
    for colour, names, divisor in (
        (Colour.CAUSE, [cause.value.replace("_", " ") for cause in Cause], 4),
        (Colour.INSTANCE, ["sky", "floor", "red ball"], 3),
    ):
        colours = colours_of(shown, Look(colour), after=True)
        title, *rows = legend_of(shown.truth, colour, 9)
        assert title == ("", colour.value)
        assert {text for _, text in rows} == {
            f"{n} {share * (t % divisor == k).sum():.3g} %" for k, n in enumerate(names)
        }
        for rgb, text in rows:
            of_row = t % divisor == next(k for k, name in enumerate(names) if text.startswith(name))
            assert (np.abs(colours[of_row] - 255.0 * np.array(to_rgb(rgb))) <= 1.0).all()
    assert legend_of(shown.truth, Colour.TIME, 9) == ()
    assert legend_of(shown.truth, Colour.CAUSE, 3)[-1][1].startswith("1 more 2")


def test_near_is_light_far_is_dark_and_the_sky_grey(inspector: Inspector) -> None:
    shown = inspector.show()
    colours, depth = (
        colours_of(shown, Look(Colour.DEPTH), after=False),
        shown.truth.values(Colour.DEPTH),
    )
    assert (colours[np.isinf(depth)] == 128).all()
    seen = np.argsort(depth)[: int(np.isfinite(depth).sum())]
    light = colours[seen].astype(float) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(light) < 2.0).all()
    assert light[0] - light[-1] > 150
    title, *rows, sky = legend_of(shown.truth, Colour.DEPTH, 5)
    low, high = np.percentile(depth[np.isfinite(depth)], (2, 98))
    assert title == ("", "depth [m]")
    assert sky == (GREY, "sky")
    np.testing.assert_allclose(
        [float(text) for _, text in rows], np.geomspace(low, high, 5), rtol=5e-3
    )


def test_unknown_numbers_have_a_name_and_a_colour(recording: Recording) -> None:
    assert recording.truth is not None
    strange = Truth(stored_causes=np.full(COUNT, 9, np.uint8), stored_instances=np.full(COUNT, 7, np.uint16),
                    stored_depths=np.full(COUNT, np.inf, np.float32))  # fmt: skip
    shown = Inspector(replace(recording, truth=strange)).show()
    assert legend_of(shown.truth, Colour.CAUSE, 5)[1:] == ((GREY, "cause 9 100 %"),)
    assert legend_of(shown.truth, Colour.INSTANCE, 5)[1][1].startswith("instance 7")
    assert legend_of(shown.truth, Colour.DEPTH, 3)[-1] == (GREY, "sky")
    assert (colours_of(shown, Look(Colour.DEPTH), after=True) == 128).all()


def test_a_clicked_event_is_described_with_its_truth(inspector: Inspector) -> None:
    shown = inspector.show()
    k = int(np.flatnonzero(shown.events.t % 12 == 2)[0])
    expected = f"; cause leak; instance red ball; depth {shown.events.t[k] * 1e-3:.3f} m"
    assert event_text(shown, k, compensated=True).endswith(f" px{expected}")


def test_a_clicked_event_of_a_plain_recording_has_no_angle(inspector: Inspector) -> None:
    shown = inspector.show()
    events = shown.events
    said = event_text(shown, 5, compensated=False)
    first = inspector.recording.events.t_first
    assert said.startswith(
        f"x {events.x[5]}, y {events.y[5]} px; {(events.t[5] - first) * 1e-3:.3f} ms "
    )
    # The time as in the recording
    assert f"(t = {events.t[5]} µs); {'ON' if events.p[5] else 'OFF'}" in said
    assert "θ" not in said
    assert "compensated" not in said


def test_the_legend_has_its_strip_next_to_the_clouds(scene: Scene, inspector: Inspector) -> None:
    look, shown = Look(Colour.CAUSE, Axis.TIME), inspector.show()

    def mark(picture: np.ndarray, colour: str) -> np.ndarray:
        """Return the columns with pixels of a colour in the strip."""
        return np.flatnonzero(
            (picture[:, :20] == np.rint(255 * np.array(to_rgb(colour)))).all(axis=2).any(axis=0)
        )

    scene.show(shown, replace(look, colour=Colour.TIME))
    scene.look_from(View.XY, look)
    bare = scene.picture()
    scene.show(shown, look)
    explained = scene.picture()
    for colour in CAUSE_COLOURS:
        assert not len(mark(bare, colour))
        assert len(mark(explained, colour)) >= 4
    assert scene.plotter.renderers[0].GetViewport()[0] > 0.15
    scene.show(shown, replace(look, colour=Colour.TIME))
    assert np.abs(scene.picture().astype(int) - bare).mean() < 1.0  # the clouds are back


def test_a_picture_shows_the_truth(recording: Recording, tmp_path: Path) -> None:
    save_recording(tmp_path / "box.h5", recording)
    save_recording(tmp_path / "plain.h5", replace(recording, truth=None))
    assert open_recording(tmp_path / "plain.h5").truth is None

    def view(name: str, colour: str) -> tuple[int, str, str]:
        out = str(tmp_path / f"{name}.{colour}.png")
        options = ["--screenshot", out, "--colour", colour, "--size", "400x200", "--json"]
        done = CliRunner().invoke(app, ["view", str(tmp_path / f"{name}.h5"), *options])
        return done.exit_code, done.stdout, done.stderr

    pictures = []
    for colour in ("cause", "instance", "depth"):
        code, said, _ = view("box", colour)
        assert code == 0
        with Image.open(json.loads(said)["file"]) as picture:
            pictures.append(np.asarray(picture.convert("RGB"), float))
        code, said, error = view("plain", colour)
        assert (code, said) == (1, "")
        assert f"colour '{colour}' needs ground truth that the recording does not hold" in error
        assert not (tmp_path / f"plain.{colour}.png").exists()
    assert all(np.abs(a - b).mean() > 2.0 for a, b in itertools.combinations(pictures, 2))
