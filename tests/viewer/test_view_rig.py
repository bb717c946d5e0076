"""A rig in the inspector: pictures of all sensors at the time of the window, in the model, the command and the page."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Camera,
    Events,
    MemoryEvents,
    MemoryImages,
    Recording,
    RigRecording,
    RigSensor,
    save_rig,
)
from amiwarp.viewer import Inspector, Panel, ShownRig, main_sensor
from tests.viewer.test_serve import WAIT_S, served
from tests.viewer.test_view_cli import view

CAMERA = Camera.from_fov(64, 48, math.radians(60))
START = 3_000_000
FRAMES = START + np.arange(7) * 50_000


def recorded(seed: int, size: tuple[int, int], late_us: int = 0, **more: Any) -> Recording:
    """Return a recording of 0.3 s."""
    rng = np.random.default_rng(seed)
    t = START + late_us + np.sort(rng.integers(0, 300_000, 20_000))
    t[0] = START + late_us
    width, height = size
    x, y, p = (rng.integers(0, most, t.size) for most in (width, height, 2))
    events = MemoryEvents(Events.from_arrays(x, y, t, p), width, height)
    return Recording(events, name=f"seed{seed}", **more)


def make_rig() -> RigRecording:
    grey = np.arange(7, dtype=np.uint16)[:, None, None] * np.ones((7, 48, 64), np.uint16)
    colours = np.zeros((7, 20, 30, 3), np.uint16)
    colours[:, 4, 5] = np.arange(7)[:, None] * 256 + [0, 256, 512]
    metres = np.full((7, 10, 12), 2.5, np.float32)
    metres[:, 0, :3] = np.inf, np.nan, 4.0
    empty = MemoryEvents(recorded(0, (64, 48)).events[:0], 64, 48)
    place = np.eye(3, 4)
    frames = MemoryImages(FRAMES, grey)
    return RigRecording(
        {
            "depth": RigSensor(
                "depth", Recording(empty, depth=MemoryImages(FRAMES, metres)), place
            ),
            "right": RigSensor("events", recorded(2, (64, 48), 1700, camera=CAMERA), place),
            "left": RigSensor("events", recorded(1, (64, 48), camera=CAMERA, frames=frames), place),
            "small": RigSensor("events", recorded(3, (32, 24)), place),
            "colour": RigSensor(
                "frames", Recording(empty, frames=MemoryImages(FRAMES, colours)), place
            ),
        }
    )


def opened(rig: RigRecording) -> Inspector:
    inspector = Inspector(rig["left"].recording)
    inspector.show_rig(ShownRig(rig, "left"))
    return inspector


def test_all_sensors_are_seen_at_the_time_of_the_window() -> None:
    rig = make_rig()
    inspector = opened(rig)
    inspector.open(START + 120_000, 60_000)
    assert inspector.shown_rig is not None
    found = {each.name: each for each in inspector.shown_rig.pictures(inspector.show().span)}
    assert list(found) == ["depth", "right", "left, frames", "small", "colour"]
    for name in ("right", "small"):
        events = rig[name].recording.events.between(START + 120_000, START + 180_000)
        width, height = rig[name].recording.events.size
        expected = np.zeros((height, width))
        np.add.at(expected, (events.y, events.x), 1)
        np.testing.assert_array_equal(found[name].values, expected)
        assert found[name].text == f"{len(events):,} events"
    # The middle of the window is nearest to the fourth frame.
    assert found["left, frames"].values.max() == found["left, frames"].values.min() == 3
    assert found["colour"].values[4, 5].tolist() == [3, 4, 5]
    assert found["colour"].scale is None
    assert found["depth"].text == found["colour"].text == "150.0 ms (middle +0.0 ms)"
    depth = found["depth"].values
    assert np.isnan(depth[0]).tolist() == [True, True, *[False] * 10]
    assert depth[0, 2] == 4.0
    inspector.open(START + 60_000, 60_000)
    later = {each.name: each for each in inspector.shown_rig.pictures(inspector.show().span)}
    assert later["left, frames"].values.max() == 2
    assert later["depth"].text == "100.0 ms (middle +10.0 ms)"


def test_cameras_of_one_size_are_on_one_time_axis() -> None:
    inspector = opened(make_rig())
    (right,) = inspector.besides
    assert (right.recording.name, right.offset_us) == ("seed2", 1700)
    inspector.open(START + 120_000, 60_000)
    times = inspector.show().first.events.t
    assert START + 120_000 <= times.min() < times.max() < START + 180_000


def test_the_main_sensor_has_events() -> None:
    rig = make_rig()
    assert main_sensor(rig, None) == "left"
    assert main_sensor(rig, "small") == "small"
    named = RigRecording({"depth": rig["depth"], "b": rig["small"], "a": rig["left"]})
    assert main_sensor(named, None) == "b"
    with pytest.raises(AmiwarpError, match="depth has no events; choose among right, left, small"):
        main_sensor(rig, "depth")
    with pytest.raises(AmiwarpError, match="has no sensor 'rear'; choose among depth, right"):
        main_sensor(rig, "rear")
    with pytest.raises(AmiwarpError, match="no sensor has events; the inspector needs one"):
        main_sensor(RigRecording({"depth": rig["depth"]}), None)


def test_the_command_opens_rigs(tmp_path: Path) -> None:
    save_rig(tmp_path / "rig", make_rig())
    picture = ["--screenshot", tmp_path / "a.png", "--size", "300x200"]
    code, text, _ = view(tmp_path / "rig", *picture, "--sensor", "right")
    events = make_rig()["right"].recording.events
    assert (code, (tmp_path / "a.png").is_file()) == (0, True)
    shown = int(text.split(": ", 1)[1].split(" events")[0].replace(",", ""))
    assert 0 < shown < len(events)
    for words, message in (
        (["--beside", tmp_path / "rig/left.h5"], "is a rig; leave out --beside, --bookmark"),
        (["--bookmark", "a"], "is a rig; leave out --beside, --bookmark"),
        (["--sensor", "colour"], "colour has no events"),
    ):
        code, _, error = view(tmp_path / "rig", "--screenshot", tmp_path / "b.png", *words)
        assert (code, message in " ".join(error.split())) == (1, True), error
    code, _, error = view(tmp_path / "rig/left.h5", *picture, "--sensor", "left", "--force")
    assert (code, "is no rig; leave out --sensor" in " ".join(error.split())) == (1, True)


def test_on_the_page_all_sensors_follow_the_timeline(browser: Any) -> None:
    panels: list[Any] = []
    failures: list[str] = []

    def build(server: Any) -> Any:
        panels.append(Panel(server, opened(make_rig())))
        return panels[-1].close

    with served(build, {}) as (url, _), browser.new_context() as context:
        page = context.new_page()
        page.set_default_timeout(1e3 * WAIT_S)
        page.on("console", lambda each: each.type == "error" and failures.append(each.text))
        page.on("pageerror", lambda error: failures.append(str(error)))
        page.goto(url)
        page.locator("#sensor-colour").wait_for()
        page.wait_for_function("document.querySelector('#updating').style.display === 'none'")
        names = [each.inner_text() for each in page.locator(".sensor figcaption").all()]
        assert names == ["depth", "right", "left, frames", "small", "colour"]
        before = page.locator(".sensor > small[title]").all_inner_texts()
        box = page.locator("#timeline canvas").first.bounding_box()
        x, y = box["x"] + 62 + 0.5 * (box["width"] - 68), box["y"] + 20
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x - 0.3 * (box["width"] - 68), y, steps=4)
        page.mouse.up()
        page.wait_for_function(
            "before => [...document.querySelectorAll('.sensor > small[title]')]"
            ".every((each, k) => each.innerText !== before[k])",
            arg=before,
        )
        page.locator("#show-depth").uncheck()
        page.locator("#sensor-depth").wait_for(state="detached")
        # The page draws the colours of the frame that the server chose.
        state = next(each for each in panels[0].state.rig_pictures if each["name"] == "colour")
        rgba = np.frombuffer(state["picture"]["rgba"], np.uint8).reshape(20, 30, 4)
        row = round(float(state["text"].split(" ")[0]) / 50)
        assert rgba[4, 5].tolist() == [row, row + 1, row + 2, 255]
        page.close()
    assert failures == []
