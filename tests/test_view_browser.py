"""The inspector in a real browser, used with mouse and keys; its server runs in a thread of the test process."""

import asyncio
import io
import itertools
import math
import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_serve import WAIT_S, served, until

from amiwarp.calib import Calibration, calibrate
from amiwarp.events.events import MemoryEvents
from amiwarp.events.recording import Recording, Truth
from amiwarp.io import open_recording, save_recording
from amiwarp.optics.camera import Camera
from amiwarp.optics.prism import Prism
from amiwarp.reconstruction.export import save_film
from amiwarp.simulation.motion import PrismMotion
from amiwarp.simulation.simulator import simulate
from amiwarp.viewer import jobs
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.layout import KEYS
from amiwarp.viewer.page_values import SETTABLE

pytest.importorskip("trame_vuetify")
APEX_DEG, NOMINAL_DEG, RPM = 1.0, 1.2, 720.0
TURN_MS = 60e3 / RPM
PICKED = (
    r"x (?P<x>\d+), y (?P<y>\d+) px; t (?P<t>\d+) µs; θ (?P<theta>[\d.]+)°; (?P<p>ON|OFF); "
    r"compensated (?P<cx>-?[\d.]+), (?P<cy>-?[\d.]+) px"
)
SIZE = {"width": 1366, "height": 768}


@pytest.fixture(scope="module")
def recording(texture: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Return a recording of four turns, read from a file."""
    made = simulate(
        texture, Camera.from_fov(128, 96, math.radians(50.0)), Prism(math.radians(APEX_DEG)), duration_s=4 * 60 / RPM,
        motion=PrismMotion(RPM, phase=2.0), nominal_prism=Prism(math.radians(NOMINAL_DEG)), seed=3,
    )  # fmt: skip
    path = tmp_path_factory.mktemp("recording") / "discs.h5"
    save_recording(path, made)
    return replace(open_recording(path), truth=made.truth)


@pytest.fixture(scope="module")
def context(browser: Any) -> Any:
    """Return a browser context with the window size of the tests."""
    return browser.new_context(viewport=SIZE)


class Tabs:
    """Builds a panel with the inspector from ``make`` for each opened page, and counts the closed pages."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.url, self.closed = folder, "", 0
        self.make: Callable[[], Inspector]
        self.loop: asyncio.AbstractEventLoop
        self.panels: list[Any] = []
        self.failures: list[str] = []
        """Errors and warnings from the browser's console."""

    def open(self, context: Any, make: Callable[[], Inspector]) -> Any:
        """Open a page, and wait until all its parts are drawn."""
        self.make = make
        page = context.new_page()
        page.set_default_timeout(1e3 * WAIT_S)
        page.on("console", self._console)
        page.on("pageerror", lambda error: self.failures.append(str(error)))
        page.goto(self.url)
        page.wait_for_function("document.querySelector('#curve-text')?.textContent.includes('best at')")
        page.locator("#cloud img").wait_for()
        if math.isfinite(self.panels[-1].inspector.turn_us):
            page.locator("#image-picture").wait_for()
        return page

    def _console(self, message: Any) -> None:
        if message.type in ("error", "warning") and not message.location["url"].endswith("/paraview/"):
            self.failures.append(message.text)  # the page first tries ParaView's launcher, which does not exist

    def __call__(self, server: Any) -> Callable[[], None]:
        from amiwarp.viewer.panel import Panel

        panel = Panel(server, self.make(), self.folder)
        self.panels.append(panel)

        def close() -> None:
            panel.close()
            self.closed += 1

        return close


@pytest.fixture(scope="module")
def tabs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tabs]:
    build = Tabs(tmp_path_factory.mktemp("exports"))
    with served(build, SETTABLE) as (build.url, build.loop):
        yield build


@pytest.fixture
def nothing_fails(tabs: Tabs, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]) -> Iterator[None]:
    """Check after the test that neither the browser nor the server reported an error."""
    yield
    assert tabs.failures == []
    assert [record.getMessage() for record in caplog.records if record.levelname in ("ERROR", "CRITICAL")] == []
    assert "Traceback" not in capfd.readouterr().err


Open = Callable[..., Any]


@pytest.fixture
def opened(context: Any, tabs: Tabs, recording: Recording, nothing_fails: None) -> Iterator[Open]:
    """Return a function that opens a page; close these pages after the test."""
    pages: list[Any] = []

    def open_page(of: Recording | None = None, calibration: Calibration | None = None, **more: Any) -> Any:
        pages.append(tabs.open(context, lambda: Inspector(of or recording, calibration, **more)))
        return pages[-1]

    yield open_page
    closed = tabs.closed + len([page for page in pages if not page.is_closed()])
    for page in pages:
        page.close()
    until(lambda: tabs.closed == closed)


@pytest.fixture(scope="module")
def kept(context: Any, tabs: Tabs, recording: Recording) -> tuple[Any, Any, dict[str, Any]]:
    """Return a page shared by the tests, its panel and its initial state. Opening a page takes longer than a test."""
    page = tabs.open(context, lambda: Inspector(recording))
    return page, tabs.panels[-1], dict(tabs.panels[-1].state.to_dict())


@pytest.fixture
def page(kept: tuple[Any, Any, dict[str, Any]], tabs: Tabs, nothing_fails: None) -> Any:
    """Return the shared page, reset to its initial state."""
    page, panel, first = kept

    async def anew() -> str:
        panel.calibration_job.cancel()
        panel.discard()
        with panel.state:
            panel.state.update({**first, "trame__title": panel.state.trame__title})
        panel.look_from(first["view"])
        while panel.state.busy or panel._quick or panel._slow:
            await asyncio.sleep(0.01)
        with panel.state:
            panel.state.trame__title += "."
        return str(panel.state.trame__title)

    page.bring_to_front()
    page.mouse.up()
    page.evaluate("document.activeElement.blur(); document.querySelector('.side').scrollTop = 0")
    title = asyncio.run_coroutine_threadsafe(anew(), tabs.loop).result(WAIT_S)
    page.wait_for_function("title => document.title === title", arg=title)
    return page


def sharpness(page: Any) -> tuple[float, float]:
    """Return the sharpness as recorded and compensated, read from the page."""
    found = re.search(r"sharpness ([\d.]+) → ([\d.]+) \(×[\d.]+\)", page.locator("#sharpness").inner_text())
    assert found is not None
    return float(found[1]), float(found[2])


def source(page: Any, name: str) -> str:
    """Return the address of an image on the page."""
    address = page.locator(f"#{name}").get_attribute("src")
    assert address.startswith("data:image/jpeg;base64,")
    return str(address)


def cloud(page: Any) -> np.ndarray:
    """Return a screenshot of the clouds, shape ``(height, width, 3)``."""
    png = page.locator("#cloud").screenshot()
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), np.int16)


def seen_change(page: Any, before: np.ndarray) -> np.ndarray:
    """Wait until the clouds differ from ``before``; return the new screenshot."""
    now = before

    def changed() -> bool:
        nonlocal now
        now = cloud(page)
        return bool((np.abs(now - before).max(axis=2) > 40).mean() > 0.01)

    until(changed)
    return now


def field(page: Any, name: str) -> float:
    return float(page.locator(f"#field-{name}").input_value())


def enter(page: Any, name: str, value: float | str) -> None:
    """Type a number into a field, and press Enter."""
    page.locator(f"#field-{name}").fill(str(value))
    page.locator(f"#field-{name}").press("Enter")


def thumb(page: Any, of: str) -> Any:
    return page.locator(f".v-slider:has(#{of}) .v-slider-thumb")


def grab(page: Any, of: str) -> tuple[float, float]:
    """Press the mouse button on a slider's thumb; return the thumb's centre [px]."""
    thumb(page, of).scroll_into_view_if_needed()
    box = thumb(page, of).bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    return x, y


def message(page: Any, text: str) -> None:
    """Wait until the page shows a message with this text."""
    page.locator("#message").filter(has_text=text).wait_for()


def unsaid(page: Any) -> None:
    """Wait until the page shows no message."""
    page.locator("#message").wait_for(state="detached")


def true_phase(recording: Recording, at_us: float | None = None) -> float:
    """Return the true phase [deg]. ``at_us`` is the time at which the angle is 0 if there is no encoder [us]."""
    assert recording.truth is not None
    assert recording.encoder is not None
    turned = 0.0 if at_us is None else float(recording.encoder.angle_at(np.array([at_us], np.int64))[0])
    return math.degrees(math.remainder(recording.truth.parameters["phase"] + turned, math.tau))


def test_the_page_shows_counts_sharpness_images_and_clouds(page: Any, recording: Recording) -> None:
    events = recording.events
    t, (start, length) = events.slice(0, len(events)).t, Inspector(recording).first_window()
    count = int(((t >= start) & (t < start + length)).sum())
    assert page.locator("#events").inner_text() == f"{count:,} events, {count:,} drawn"
    assert page.title().startswith("amiwarp: discs")
    before, after = sharpness(page)
    assert min(before, after) > 1.0
    assert before != after
    assert source(page, "image-before") != source(page, "image-after")
    assert field(page, "apex") == NOMINAL_DEG
    assert field(page, "length_ms") == pytest.approx(TURN_MS, abs=0.01)
    picture = cloud(page)
    for half in np.split(picture, 2, axis=1):
        coloured = half.max(axis=2) - half.min(axis=2) > 80
        assert coloured.mean() > 0.05
        assert len(np.unique(half.reshape(-1, 3), axis=0)) > 20
    assert page.locator("#plot-rate polyline").get_attribute("points").count(",") > 100


def test_while_a_slider_is_dragged_image_and_sharpness_follow_and_at_rest_the_rest(page: Any) -> None:
    enter(page, "phase", -120)
    page.get_by_text("sharpness over phase").wait_for()
    curve = page.locator("#plot-curve polyline")
    first = sharpness(page), source(page, "image-after"), field(page, "apex")
    slow = curve.get_attribute("points"), page.locator("#curve-text").inner_text(), source(page, "image-picture")
    x, y = grab(page, "slider-apex")
    seen = [first]
    for distance in (-15, -30, -45):
        page.mouse.move(x + distance, y, steps=3)
        until(lambda: sharpness(page) != seen[-1][0] and source(page, "image-after") != seen[-1][1])
        seen.append((sharpness(page), source(page, "image-after"), field(page, "apex")))
        assert seen[-1][2] < seen[-2][2]
    page.mouse.up()
    until(lambda: curve.get_attribute("points") != slow[0])
    until(lambda: page.locator("#curve-text").inner_text() != slow[1])
    until(lambda: source(page, "image-picture") != slow[2])
    assert re.fullmatch(r"sharpness [\d.]+ to [\d.]+, best at -?[\d.]+", page.locator("#curve-text").inner_text())
    assert sharpness(page)[0] == first[0][0]
    assert page.locator(".tile").nth(3).inner_text().startswith("sharpness over apex")
    grab(page, "slider-phase")
    page.mouse.up()
    page.get_by_text("sharpness over phase").wait_for()
    page.locator("#curve-text").filter(has_text="best at -1").wait_for()


def test_a_colour_that_shows_ground_truth_is_offered_with_it_and_has_a_legend(
    opened: Open, recording: Recording
) -> None:
    depths = np.linspace(1.0, 4.0, len(recording.events), dtype=np.float32)
    page = opened(replace(recording, truth=Truth(stored_depths=depths)))
    assert page.locator("#truth").inner_text() == "ground truth: per event: depth"
    before = cloud(page)
    page.locator(".v-select:has(#colour)").click()
    choices = page.locator(".v-overlay .v-list-item")
    choices.filter(has_text="depth").wait_for()
    assert choices.all_inner_texts() == ["polarity", "angle", "time", "density", "residual", "depth"]
    choices.filter(has_text="depth").click()
    until(lambda: (np.abs(cloud(page)[:120, :20] - before[:120, :20]).max(axis=2) > 40).sum() > 100)
    page.mouse.click(*(page.locator("#cloud").bounding_box()[side] + 270 for side in ("x", "y")))
    page.locator("#picked").filter(has_text=re.compile(r"px; depth \d\.\d{3} m")).wait_for()


def test_a_typed_number_has_its_curve_and_picture_too(page: Any) -> None:
    picture, text = source(page, "image-picture"), page.locator("#curve-text").inner_text()
    enter(page, "phase", 100)
    page.get_by_text("sharpness over phase").wait_for()
    until(lambda: page.locator("#curve-text").inner_text() != text)
    until(lambda: source(page, "image-picture") != picture)


def test_what_calibration_found_is_accepted_saved_and_opened_again(
    page: Any, opened: Open, recording: Recording, tabs: Tabs
) -> None:
    before = sharpness(page)
    page.locator("#do-calibrate").click()
    page.locator(".side").get_by_text("calibrating, ").wait_for()
    assert page.locator(".side .v-progress-linear--active").is_visible()
    page.locator("#found").wait_for()
    assert not page.locator(".side .v-progress-linear--active").is_visible()
    text = page.locator("#found").inner_text()
    apex, phase = map(float, re.findall(r"(?:apex|phase) (-?[\d.]+)°", text))
    assert apex == pytest.approx(APEX_DEG, rel=0.05)
    assert math.remainder(phase - true_phase(recording), 360.0) == pytest.approx(0.0, abs=2.0)
    assert (sharpness(page), field(page, "apex")) == (before, NOMINAL_DEG)  # the result is not accepted yet

    page.locator("#do-accept").click()
    page.locator("#found").wait_for(state="detached")
    until(lambda: sharpness(page) != before)
    assert field(page, "apex") == pytest.approx(apex, abs=1e-3)
    assert float(thumb(page, "slider-apex").get_attribute("aria-valuenow")) == pytest.approx(apex, abs=0.005)
    assert field(page, "phase") == pytest.approx(phase, abs=0.1)
    accepted = sharpness(page)
    assert accepted[1] > 1.1 * before[0] > 1.1 * before[1]

    path = tabs.folder / "found.json"
    page.locator("#out").fill(path.name)
    page.locator("#do-save").click()
    message(page, f"{path}: written")
    saved = Calibration.load(path)
    assert saved.photometric is not None  # the complete result is saved, not the rounded numbers of the page
    assert math.degrees(saved.exact.parameters["apex"]) == pytest.approx(apex, abs=1e-3)

    again = opened(calibration=saved)
    assert field(again, "apex") == field(page, "apex")
    assert field(again, "phase") == field(page, "phase")
    assert sharpness(again) == accepted


def test_what_was_set_by_hand_is_saved(page: Any, tabs: Tabs, recording: Recording) -> None:
    before = sharpness(page)
    enter(page, "apex", 0.9)
    enter(page, "phase", 115)
    until(lambda: sharpness(page)[1] > before[0])
    page.locator("#do-save").click()
    message(page, "discs.calibration.json: written")
    saved = Calibration.load(tabs.folder / "discs.calibration.json")
    assert math.degrees(saved.parameters["apex"]) == pytest.approx(0.9)
    shown = Inspector(recording, saved).show()
    assert sharpness(page) == pytest.approx((shown.sharpness_before, shown.sharpness_after), abs=6e-4)


def endless(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Make calibrations repeat forever. Return an event that is set when one is cancelled."""
    ended = threading.Event()

    def again(*args: Any, **kwargs: Any) -> None:
        try:
            while True:
                calibrate(*args, **kwargs)
        except jobs.JobCancelled:
            ended.set()
            raise

    monkeypatch.setattr(jobs, "calibrate", again)
    return ended


def test_a_calibration_is_cancelled_and_leaves_nothing(page: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    endless(monkeypatch)
    page.locator("#do-calibrate").click()
    page.locator(".side").get_by_text("calibrating, ").wait_for()
    before = sharpness(page)
    enter(page, "apex", 0.7)
    until(lambda: sharpness(page) != before)  # the page still responds
    page.locator("#do-calibrate").filter(has_text="cancel").click()
    message(page, "calibration cancelled")
    page.locator("#do-calibrate").filter(has_text="calibrate").wait_for()
    assert page.locator("#found").count() == 0
    assert page.locator(".side .v-progress-linear--active").count() == 0
    assert field(page, "apex") == 0.7


def test_bad_windows_are_said_and_a_good_one_makes_the_view_go_on(page: Any, recording: Recording) -> None:
    for name, bad, good, words in (
        ("length_ms", "0", "40", "a window of 0 ms; give a length above 0"),
        ("length_ms", "", "50", "a window of 0 ms; give a length above 0"),
        ("start_ms", "99999", "100", "no events from 99999.000 ms on for 50.000 ms"),
        ("start_ms", "-1e300", "50", "no events from"),
    ):
        events = page.locator("#events").inner_text()
        enter(page, name, bad)
        message(page, words)
        assert page.locator("#events").inner_text() == events
        enter(page, name, good)
        unsaid(page)
        until(lambda events=events: page.locator("#events").inner_text() != events)
    first = sharpness(page)
    enter(page, "length_ms", "0")
    enter(page, "apex", 0.8)
    until(lambda: sharpness(page) != first)
    page.locator("#curve-text").filter(has_text="best at 0.").wait_for()
    message(page, "a window of 0 ms")  # the window is still invalid
    enter(page, "start_ms", 0)
    enter(page, "length_ms", "1e300")
    unsaid(page)
    page.locator("#events").filter(has_text=f"{len(recording.events):,} events").wait_for()


def test_an_empty_selection_is_said(page: Any) -> None:
    events = page.locator("#events").inner_text()
    left = page.locator(".v-range-slider .v-slider-thumb").first
    left.press("End")
    message(page, "none of them selected")
    assert page.locator("#events").inner_text() == events
    left.press("Home")
    unsaid(page)
    page.locator("#polarity").get_by_text("OFF").click()
    page.locator("#events").filter(has_text="in the images").wait_for()
    page.locator("#polarity").get_by_text("both").click()
    until(lambda: page.locator("#events").inner_text() == events)


def test_a_bad_knob_is_said_and_a_good_one_makes_the_view_go_on(page: Any) -> None:
    before = sharpness(page)
    enter(page, "apex", -1)
    message(page, "apex")
    enter(page, "apex", 0.8)
    unsaid(page)
    until(lambda: sharpness(page)[1] > before[1])


def test_exports_go_to_one_folder_under_new_plain_names(page: Any, tabs: Tabs, tmp_path: Path) -> None:
    outside = tmp_path / "outside.png"
    for name, given, words in (
        ("picture", str(outside), "holds '/'"),
        ("picture", "../outside.png", "holds '/'"),
        ("save", "..", "is not the name of an ordinary file"),
        ("save", "c.h5", "the name must end in .json"),
    ):
        page.locator("#out").fill(given)
        page.locator(f"#do-{name}").click()
        message(page, words)
        assert page.locator("#message.text-error, #message.bg-error").count() == 1
    assert not outside.exists()
    assert not (tabs.folder.parent / "outside.png").exists()
    page.locator("#out").fill("seen")
    page.locator("#do-picture").click()
    message(page, f"{tabs.folder / 'seen.png'}: written")
    written = (tabs.folder / "seen.png").read_bytes()
    with Image.open(io.BytesIO(written)) as picture:
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 20
    page.locator("#do-picture").click()
    message(page, "exists, and the page never replaces a file")
    assert (tabs.folder / "seen.png").read_bytes() == written
    page.locator("#out").fill("")
    for expected in ("discs.png", "discs.2.png"):
        page.locator("#do-picture").click()
        message(page, f"{tabs.folder / expected}: written")
    before = sharpness(page)
    enter(page, "apex", 0.8)
    until(lambda: sharpness(page) != before)


@pytest.mark.parametrize("what", ["turntable", "film"])
def test_while_a_film_is_written_the_view_is_alive(
    page: Any, tabs: Tabs, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import av

    alive = threading.Event()

    def held(frames: Iterator[Any], path: Path, *, fps: float) -> int:
        first = next(frames)
        assert alive.wait(WAIT_S)
        return save_film(itertools.chain([first], frames), path, fps=fps)

    monkeypatch.setattr(jobs, "FRAMES", 8)
    monkeypatch.setattr(jobs, "save_film", held)
    first = sharpness(page), field(page, "start_ms")
    page.locator(f"#do-{what}").click()
    page.locator(".side").get_by_text(f"writing the {what}").wait_for()
    enter(page, "apex", 0.8)
    until(lambda: sharpness(page) != first[0])
    alive.set()
    message(page, f"discs.{what}.mp4: 8 frames written")
    page.locator("#do-film:enabled").wait_for()
    with av.open(str(tabs.folder / f"discs.{what}.mp4")) as container:
        pictures = [frame.to_ndarray(format="rgb24").astype(np.int16) for frame in container.decode(video=0)]
    assert len(pictures) == 8
    assert np.abs(pictures[2] - pictures[6]).mean() > 1.0
    assert (field(page, "start_ms") > first[1]) == (what == "film")


def test_keys(page: Any) -> None:
    seen = cloud(page)
    page.keyboard.press("2")
    seen = seen_change(page, seen)
    assert page.locator(".bar .v-btn--active").inner_text().lower() == "x-y"
    page.keyboard.press("o")
    page.locator("#do-overlaid").filter(has_text="side by side").wait_for()
    seen = seen_change(page, seen)
    page.keyboard.press("d")
    page.locator(".v-theme--dark .panel").wait_for()
    until(lambda: cloud(page).mean() < 80)
    seen = cloud(page)
    page.keyboard.press("4")
    seen = seen_change(page, seen)
    page.keyboard.press("t")
    page.locator(".v-select:has(#axis)").filter(has_text="time").wait_for()
    seen_change(page, seen)

    start = field(page, "start_ms")
    page.keyboard.press("ArrowRight")
    until(lambda: field(page, "start_ms") == pytest.approx(start + TURN_MS, abs=0.01))
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    until(lambda: field(page, "start_ms") == pytest.approx(start - TURN_MS, abs=0.01))
    events = page.locator("#events").inner_text()
    page.keyboard.press(" ")
    page.locator("#do-play").filter(has_text="stop").wait_for()
    until(lambda: field(page, "start_ms") > start - TURN_MS + 5.0)
    until(lambda: page.locator("#events").inner_text() != events)
    page.keyboard.press(" ")
    page.locator("#do-play").filter(has_text="play").wait_for()

    page.keyboard.press("?")
    page.locator("#help").wait_for()
    shown = [row.locator("td").all_inner_texts() for row in page.locator("#help tr").all()]
    assert shown == [["space" if key == " " else key, words] for key, _, words in KEYS]
    page.keyboard.press("?")
    page.locator("#help").wait_for(state="hidden")


def test_a_window_is_told_in_turns_too(page: Any) -> None:
    enter(page, "turns", 0.5)
    until(lambda: field(page, "length_ms") == pytest.approx(30e3 / RPM, abs=0.01))
    assert field(page, "turns") == 0.5


def test_keys_typed_into_a_field_do_nothing_else(page: Any) -> None:
    page.locator("#out").click()
    page.keyboard.type("2do t?acsp")
    assert page.locator("#out").input_value() == "2do t?acsp"
    start = field(page, "start_ms")
    page.locator("#field-apex").click()
    page.keyboard.press("ArrowRight")
    page.locator("#field-length_ms").fill("50")  # the server handles calls in order
    page.keyboard.press("Enter")
    until(lambda: field(page, "turns") == 0.6)
    assert field(page, "start_ms") == start
    assert [page.locator(name).count() for name in (".v-theme--dark", "#help", "#message")] == [0, 0, 0]
    assert page.locator("#do-overlaid").inner_text().lower() == "overlaid"
    assert page.locator("#do-calibrate").inner_text().lower() == "calibrate"
    assert page.locator(".v-select:has(#axis)").inner_text().split()[-1] == "angle"


def test_tabs_know_nothing_of_each_other_and_a_closed_one_ends_its_work(
    page: Any, opened: Open, tabs: Tabs, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = endless(monkeypatch)
    first, second = page, opened()
    before = sharpness(first)
    x, y = grab(second, "slider-apex")
    second.mouse.move(x - 40, y, steps=2)
    second.mouse.up()
    until(lambda: sharpness(second) != before)
    second.locator("#do-calibrate").click()
    second.locator(".side").get_by_text("calibrating, ").wait_for()
    assert (sharpness(first), field(first, "apex")) == (before, NOMINAL_DEG)
    assert first.locator(".side .v-progress-linear--active").count() == 0
    closed = tabs.closed
    second.close()
    until(lambda: tabs.closed == closed + 1)
    assert ended.wait(WAIT_S)
    enter(first, "apex", 0.8)
    until(lambda: sharpness(first) != before)


def test_a_click_on_an_event_tells_all_about_it(page: Any, kept: Any, recording: Recording) -> None:
    encoder, panel = recording.encoder, kept[1]
    assert encoder is not None
    events = recording.events.slice(0, len(recording.events))

    def picked() -> str:
        return "".join(page.locator("#picked").all_inner_texts())

    seen = cloud(page)
    page.keyboard.press("2")
    seen = seen_change(page, seen)
    rows, columns = np.nonzero(seen.max(axis=2) - seen.min(axis=2) > 100)
    half = seen.shape[1] // 2
    for side in (columns < half, columns >= half):
        clicks, found = [], []
        for k in np.quantile(np.flatnonzero(side), (0.2, 0.5, 0.8)).astype(int):
            before = picked()
            page.locator("#cloud").click(position={"x": float(columns[k]), "y": float(rows[k])})
            until(lambda before=before: picked() not in ("", before))
            match = re.match(PICKED, picked())
            assert match is not None
            x, y, t, p = int(match["x"]), int(match["y"]), int(match["t"]), int(match["p"] == "ON")
            assert ((events.x == x) & (events.y == y) & (events.t == t) & (events.p == p)).sum() == 1
            theta = encoder.angle_at(np.array([t]))
            assert float(match["theta"]) == pytest.approx(math.degrees(theta[0] % math.tau), abs=0.006)
            place = panel.inspector.model.compensate_points(np.array([[x, y]], np.float32), theta.astype(np.float32))[0]
            assert [float(match["cx"]), float(match["cy"])] == pytest.approx(place.tolist(), abs=0.006)
            clicks.append((columns[k], rows[k]))
            found.append((x, y) if side[0] else place)
        steps, moved = np.diff(clicks, axis=0), np.diff(found, axis=0)
        scale = np.linalg.norm(steps, axis=1) / np.linalg.norm(moved, axis=1)  # one scale and direction
        np.testing.assert_allclose(moved * scale[:, None], steps, atol=12)
        np.testing.assert_allclose(scale, scale.mean(), rtol=0.1)
    text = picked()
    enter(page, "apex", 0.5)
    until(lambda: picked() != text)  # the compensated position has changed
    assert picked().split(";")[:4] == text.split(";")[:4]


def test_everything_needed_is_inside_the_window(page: Any) -> None:
    boxes = {name: page.locator(name).bounding_box() for name in (".bar", "#cloud", ".strip", ".side")}
    boxes |= {f"tile {k}": tile.bounding_box() for k, tile in enumerate(page.locator(".tile").all())}
    within = [
        *(f".bar > *:nth-child({k + 1})" for k in range(page.locator(".bar > *").count())),
        "#image-before", "#image-after", "#image-picture", "#plot-curve", "#curve-text", "#plot-rate",
    ]  # fmt: skip
    boxes |= {name: page.locator(name).bounding_box() for name in within}
    assert sum(name.startswith("tile") for name in boxes) == 4
    for name, box in boxes.items():
        assert box["width"] > 0, name
        assert box["height"] > 8 or name.startswith(".bar >"), name  # the gap between the items has no height
        assert min(box["x"], box["y"]) >= 0, name
        assert box["x"] + box["width"] <= SIZE["width"], name
        assert box["y"] + box["height"] <= SIZE["height"], name
    assert boxes["#cloud"]["width"] * boxes["#cloud"]["height"] > 0.4 * SIZE["width"] * SIZE["height"]
    last = page.locator("#do-film")
    side = page.locator(".side")
    side.hover()
    page.mouse.wheel(0, 5000)
    until(lambda: last.bounding_box()["y"] + last.bounding_box()["height"] <= SIZE["height"])
    rights = "all => all.map(one => one.getBoundingClientRect().right)"
    edge = side.evaluate("side => side.getBoundingClientRect().left + side.clientWidth")
    assert max(page.locator(".side :is(button, input, .v-field, .v-slider-track)").evaluate_all(rights)) <= edge
    assert page.evaluate("document.documentElement.scrollHeight <= window.innerHeight")


def test_without_encoder_and_prism_the_speed_that_is_set_brings_the_angle(opened: Open, recording: Recording) -> None:
    page = opened(of=replace(recording, encoder=None, prism=None))
    axis = page.locator(".v-select:has(#axis)")
    assert axis.inner_text().split()[-1] == "time"
    assert page.locator("#slider-clock_offset").count() == 0
    assert page.locator("#do-step").is_disabled()
    before = sharpness(page)
    events = recording.events
    enter(page, "rpm", RPM)
    page.locator("#do-step:enabled").wait_for()
    until(lambda: field(page, "turns") == 1.2)
    enter(page, "apex", APEX_DEG)
    enter(page, "phase", round(true_phase(recording, (events.t_first + events.t_last) // 2), 2))
    until(lambda: sharpness(page)[1] > 1.15 * before[0])
    seen = cloud(page)
    page.locator("#events").click()
    page.keyboard.press("t")
    axis.filter(has_text="angle").wait_for()
    seen_change(page, seen)
    best = sharpness(page)[1]
    x, y = grab(page, "slider-rpm")
    page.mouse.move(x + 10, y, steps=2)
    page.mouse.up()
    until(lambda: sharpness(page)[1] < 0.9 * best)
    page.locator("#curve-text").filter(has_text="best at").wait_for()


def test_a_live_stream_is_followed_until_one_stops_it(opened: Open, tabs: Tabs, recording: Recording) -> None:
    """The stream grows by 5 ms at each request. After a stop, the page keeps working with the events it has."""
    events, asked = recording.events, [0]
    width, height = events.size

    def latest() -> Recording:
        asked.append(asked[-1] + 1)
        end = events.t_first + round(1.2e3 * TURN_MS) + 5000 * asked[-1]
        return replace(recording, events=MemoryEvents(events.between(events.t_first, end), width, height))

    page = opened(of=latest(), latest=latest)
    assert page.locator("#do-play").inner_text().lower() == "stop"
    shown, picture = field(page, "start_ms"), source(page, "image-before")
    until(lambda: field(page, "start_ms") > shown + 8.0 and source(page, "image-before") != picture)
    page.locator("#do-play").click()
    page.locator("#do-play").filter(has_text=re.compile("follow", re.I)).wait_for()
    until(lambda: not tabs.panels[-1].playback.runs)
    times = len(asked)
    start, counts = field(page, "start_ms"), page.locator("#events").inner_text()
    enter(page, "apex", APEX_DEG)
    until(lambda: sharpness(page)[1] > 0)
    assert len(asked) == times
    assert (field(page, "start_ms"), page.locator("#events").inner_text()) == (start, counts)
    page.locator("#do-play").click()
    until(lambda: field(page, "start_ms") > start)
