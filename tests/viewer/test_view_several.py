"""Several recordings on one time axis: in the model, the command, the window and the page."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amiwarp import Camera, Encoder, Events, MemoryEvents, Prism, Recording, save_recording
from amiwarp.choices import Axis, Colour
from amiwarp.viewer import Inspector, Look, Window, captions, cloud_colours, layout, screenshot
from tests.viewer.test_view_cli import view

CAMERA = Camera.from_fov(64, 48, math.radians(60))


def recorded(
    name: str, first_us: int, seed: int, n: int = 30_000, encoder: bool = False
) -> Recording:
    """Return a recording of 0.3 s."""
    rng = np.random.default_rng(seed)
    t = first_us + np.sort(rng.integers(0, 300_000, n))
    t[0], t[-1] = first_us, first_us + 299_999
    events = Events.from_arrays(
        rng.integers(0, 64, n), rng.integers(0, 48, n), t, rng.integers(0, 2, n)
    )
    turns = Encoder.constant_speed(720.0, first_us - 1000, first_us + 301_000) if encoder else None
    prism = Prism(math.radians(1.0)) if encoder else None
    return Recording(MemoryEvents(events, 64, 48), CAMERA, turns, prism, name=name)


@pytest.fixture
def inspector() -> Inspector:
    made = Inspector(recorded("own", 5_000_000, 1, encoder=True))
    made.put_beside(recorded("early", 70_000, 2), -40_000)
    made.put_beside(recorded("late", 900_000, 3), 25_000)
    return made


@pytest.mark.parametrize(
    ("k", "first_us", "offset_us"), [(0, 70_000, -40_000), (1, 900_000, 25_000)]
)
def test_each_recording_is_shown_at_its_time(
    inspector: Inspector, k: int, first_us: int, offset_us: int
) -> None:
    inspector.beside = inspector.besides[k]
    inspector.open(5_060_000, 80_000)
    other = inspector.show().first
    # After the first event of the inspector's own recording
    t = other.events.t - first_us + offset_us
    assert 60_000 <= t.min() < 60_100
    assert 139_900 < t.max() < 140_000
    inside = (inspector.beside.recording.events.slice(0, 30_000).t - first_us + offset_us) // 20_000
    assert len(t) == np.isin(inside, (3, 4, 5, 6)).sum()
    np.testing.assert_allclose(cloud_colours.third_axis(other, Axis.TIME), t * 1e-3)
    assert cloud_colours.axis_range(other, Axis.TIME) == pytest.approx((60.0, 140.0))
    own = inspector.encoder.angle_at(5_000_000 + t)
    # The prism's angle at the same time
    np.testing.assert_allclose(np.sin(other.theta), np.sin(own), atol=1e-6)
    colours = cloud_colours.colours_of(other, Look(Colour.TIME), after=False)
    early, late = colours[t < 62_000].mean(axis=0), colours[t > 138_000].mean(axis=0)
    ends = cloud_colours.colours_of(inspector.show(), Look(Colour.TIME), after=True)[[0, -1]]
    np.testing.assert_allclose([early, late], ends, atol=8.0)
    name = ("early", "late")[k]
    said = f"; {name}, which starts at {offset_us * 1e-3:.3f} ms: "
    assert said in captions.caption(inspector, inspector.show())


def test_a_copy_keeps_all_recordings_and_the_chosen_one(inspector: Inspector) -> None:
    inspector.beside = inspector.besides[1]
    made = inspector.copy()
    assert [each.recording.name for each in made.besides] == ["early", "late"]
    assert made.beside is made.besides[1] is not inspector.besides[1]


def test_the_window_goes_through_the_recordings(inspector: Inspector) -> None:
    window = Window(inspector, size=(500, 350), off_screen=True)
    names = []
    for _ in range(3):
        assert window.inspector.beside is not None
        names.append(window.inspector.beside.recording.name)
        assert window.shown.first.span.first_us == window.inspector.beside.recording.events.t_first
        window.key("g")
        window.run_once()
    assert names == ["early", "late", "early"]
    window.scene.close()
    alone = Window(Inspector(recorded("own", 0, 1)), size=(500, 350), off_screen=True)
    alone.key("g")
    assert "start with --beside" in alone.message
    alone.scene.close()


@pytest.fixture
def files(tmp_path: Path) -> Path:
    for name, first_us, seed in (("own", 5_000_000, 1), ("early", 70_000, 2), ("late", 900_000, 3)):
        save_recording(
            tmp_path / f"{name}.h5", recorded(name, first_us, seed, encoder=name == "own")
        )
    return tmp_path


def test_the_command_takes_several_recordings_with_offsets(
    files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Inspector] = []
    monkeypatch.setattr(
        screenshot, "save_screenshot", lambda inspector, *_, **__: shown.append(inspector)
    )
    given = ["--beside", files / "early.h5", "--beside", files / "late.h5"]
    for options in ([], ["--beside-offset", "-0.04", "--beside-offset", "0.025"]):
        code, said, error = view(
            files / "own.h5", *given, *options, "--screenshot", files / "a.png", "--json"
        )
        assert code == 0, error
        assert json.loads(said)["events"] > 0
    assert [[each.offset_us for each in one.besides] for one in shown] == [
        [0, 0],
        [-40_000, 25_000],
    ]
    assert [each.recording.events.t_first for each in shown[0].besides] == [70_000, 900_000]
    code, _, error = view(
        files / "own.h5", *given, "--beside-offset", "1", "--screenshot", files / "a.png"
    )
    assert code == 1
    assert "--beside-offset 1: give one for each of the 2 --beside recordings" in error


def test_the_page_has_a_row_of_rates_for_each_recording(inspector: Inspector, browser: Any) -> None:
    pytest.importorskip("trame_client")
    from amiwarp.viewer import Panel
    from tests.viewer.test_serve import served, until

    panels: list[Panel] = []

    def build(server: Any) -> Any:
        panels.append(Panel(server, inspector))
        return panels[-1].close

    page = browser.new_page(viewport={"width": 1200, "height": 800})
    page.set_default_timeout(60e3)
    with served(build, layout.SETTABLE) as (url, _):
        page.goto(url)
        page.wait_for_function("document.querySelectorAll('#timeline canvas').length === 3")
        page.wait_for_function(
            "document.querySelector('#timeline .row-name').innerText.includes('events')"
        )
        names = page.locator("#timeline .row-name").all_inner_texts()
        assert panels[0].shown is not None
        span = panels[0].shown.span
        texts = ("early, which starts at -40.000 ms", "late, which starts at 25.000 ms")
        for name, text, other in zip(names, texts, inspector.besides, strict=True):
            t = (
                other.recording.events.slice(0, 30_000).t
                - other.recording.events.t_first
                + other.offset_us
            )
            start_us = span.start_us - 5_000_000
            count = np.count_nonzero((t >= start_us) & (t < start_us + span.length_us))
            assert name == f"{text}: {count:,} events in the window"
        until(
            lambda: np.isfinite(np.frombuffer(panels[0].state.rate_rows[1]["on"], np.float32)).all()
        )
        for row, other in zip(panels[0].state.rate_rows, inspector.besides, strict=True):
            events = other.recording.events.slice(0, 30_000)
            t = events.t - events.t[0] + other.offset_us
            edges = np.linspace(0, 300_000, layout.RATE_BINS + 1)
            for name, polarity in (("on", 1), ("off", 0)):
                counts, _ = np.histogram(t[events.p == polarity], edges)
                found = np.frombuffer(row[name], np.float32) * (300_000 / layout.RATE_BINS * 1e-6)
                np.testing.assert_allclose(found, counts, atol=0.01)
            # where the recording has not started, or has ended
            assert np.count_nonzero(found == 0.0) >= layout.RATE_BINS * 24 // 300
        assert page.locator("#beside").input_value() == "0"
        page.locator("#beside").select_option("1")
        page.wait_for_function(
            "document.querySelector('#against-title').innerText.includes('late')"
        )
        assert panels[0].shown is not None
        assert panels[0].shown.first.span.first_us == 900_000
        heights = [
            box["height"]
            for box in (each.bounding_box() for each in page.locator("#timeline canvas").all())
        ]
        assert min(heights) >= 35
        page.close()


def test_one_recording_beside_has_no_choice(inspector: Inspector) -> None:
    one = Inspector(recorded("own", 0, 1))
    one.put_beside(replace(recorded("other", 7, 2), name="other"))
    state = layout.initial_state(one)
    assert state["besides"] == ["other"]
    assert state["beside_chosen"] == 0
    assert "; other: " in captions.caption(one, one.show())
