"""The inspector in a real browser, used with mouse and keys; its server runs in a thread of the test process."""

import asyncio
import io
import math
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    DepthMap,
    Encoder,
    Events,
    MemoryEvents,
    Plate,
    Prism,
    PrismMotion,
    Recording,
    SensorModel,
    calibrate,
    open_recording,
    save_recording,
    simulate,
)
from amiwarp.live.stream import (
    LiveSource,
    RecentEvents,
    encode_encoder,
    encode_events,
    encode_hello,
    open_source,
    reopen_source,
)
from amiwarp.live.stream.recent_events import followed
from amiwarp.plotting import depth_image
from amiwarp.plotting.colours import table_of
from amiwarp.viewer import (
    ImageKind,
    Inspector,
    Library,
    calibration_job,
    captions,
    clouds_film,
    estimate_phase,
    make_images,
)
from amiwarp.viewer import inspector as inspector_module
from amiwarp.viewer.clouds_film import FILM_SIZE
from amiwarp.viewer.job_progress import JobCancelled
from amiwarp.viewer.knobs import Source
from amiwarp.viewer.layout import KEYS, SETTABLE
from amiwarp.viewer.legend_actors import strip_share
from amiwarp.viewer.scene import FOOT_PX
from tests.live.test_stream_returning import sender
from tests.viewer.test_serve import WAIT_S, served, until

pytest.importorskip("trame_client")
APEX_DEG, NOMINAL_DEG, RPM, PHASE = 1.0, 1.2, 720.0, 2.0
TURN_MS = 60e3 / RPM
PICKED = (
    r"x (?P<x>\d+), y (?P<y>\d+) px; (?P<t>[\d.]+) ms \(t = (?P<own>\d+) µs\); (?P<p>ON|OFF); θ (?P<theta>[\d.]+)°; "
    r"compensated (?P<cx>-?[\d.]+), (?P<cy>-?[\d.]+) px"
)
SIZES = ((1366, 768), (800, 600), (2560, 1440))


@pytest.fixture(scope="module")
def recording(texture: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Return a recording of four turns, read from a file."""
    made = simulate(
        texture, Camera.from_fov(128, 96, math.radians(50.0)), Prism(math.radians(APEX_DEG)), duration_s=4 * 60 / RPM,
        motion=PrismMotion(RPM, phase=PHASE), nominal_prism=Prism(math.radians(NOMINAL_DEG)), seed=3,
    )  # fmt: skip
    path = tmp_path_factory.mktemp("recording") / "discs.h5"
    save_recording(path, made)
    return replace(open_recording(path), truth=made.truth)


@pytest.fixture(scope="module")
def context(browser: Any) -> Any:
    """Return a browser context with the window size of the tests."""
    return browser.new_context(viewport=dict(zip(("width", "height"), SIZES[0], strict=True)))


class Tabs:
    """Builds a panel with the inspector from ``make`` for each opened page, and counts the closed pages."""

    def __init__(self) -> None:
        self.url, self.closed = "", 0
        self.make: Callable[[], Inspector]
        self.library: Library | None = None
        self.loop: asyncio.AbstractEventLoop
        self.panels: list[Any] = []
        self.failures: list[str] = []
        """Errors and warnings from the browser's console."""

    def open(self, context: Any, make: Callable[[], Inspector], address: str = "") -> Any:
        """Open a page, and wait until all its parts are drawn."""
        self.make = make
        page = context.new_page()
        page.set_default_timeout(1e3 * WAIT_S)
        page.on("console", self._console)
        page.on("pageerror", lambda error: self.failures.append(str(error)))
        page.goto(self.url + address)
        ready(page)
        return page

    def _console(self, message: Any) -> None:
        if message.type in ("error", "warning"):
            self.failures.append(message.text)

    def __call__(self, server: Any) -> Callable[[], None]:
        from amiwarp.viewer import Panel

        panel = Panel(server, self.make(), self.library)
        self.panels.append(panel)

        def close() -> None:
            panel.close()
            self.closed += 1

        return close


@pytest.fixture(scope="module")
def tabs() -> Iterator[Tabs]:
    build = Tabs()
    with served(build, SETTABLE) as (build.url, build.loop):
        yield build


@pytest.fixture
def nothing_fails(
    tabs: Tabs, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> Iterator[None]:
    """Check after the test that neither the browser nor the server reported an error."""
    yield
    assert tabs.failures == []
    assert [
        record.getMessage()
        for record in caplog.records
        if record.levelname in ("ERROR", "CRITICAL")
    ] == []
    assert "Traceback" not in capfd.readouterr().err


Open = Callable[..., Any]


@pytest.fixture
def opened(context: Any, tabs: Tabs, recording: Recording, nothing_fails: None) -> Iterator[Open]:
    """Return a function that opens a page; close these pages after the test."""
    pages: list[Any] = []

    def open_page(
        of: Recording | None = None, calibration: Calibration | None = None, address: str = "",
        depth: DepthMap | None = None, **more: Any,
    ) -> Any:  # fmt: skip
        def make() -> Inspector:
            made = Inspector(of or recording, calibration, **more)
            if depth is not None:
                made.use_depths(depth)
            return made

        pages.append(tabs.open(context, make, address))
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
    return page, tabs.panels[-1], {name: tabs.panels[-1].state[name] for name in SETTABLE}


@pytest.fixture
def page(kept: tuple[Any, Any, dict[str, Any]], tabs: Tabs, nothing_fails: None) -> Any:
    """Return the shared page, reset to its initial state."""
    page, panel, first = kept

    async def anew() -> None:
        panel.cancel()
        with panel.state:
            panel.state.playing = False
        while panel.state.busy or panel.plays:
            await asyncio.sleep(0.01)
        with panel.state:
            panel.discard()
            panel.show_b(None)
            panel.state.update({**first, "message": "", "region_kind": "suggested"})
            panel.pick(-1)
            panel.look_from("free")
            panel.reset()
        while panel.state.updating:
            await asyncio.sleep(0.01)

    page.bring_to_front()
    page.mouse.up()
    page.evaluate("document.activeElement.blur(); document.querySelector('.side').scrollTop = 0")
    asyncio.run_coroutine_threadsafe(anew(), tabs.loop).result(WAIT_S)
    ready(page)
    return page


def ready(page: Any) -> None:
    """Wait until the page shows a window, and no part of it waits for an update."""
    page.locator("#curve-text, #sharpness, #two").first.wait_for()
    # trame keeps changes back while a call is pending
    page.wait_for_function("!trame.state.dirtyKeys.size && !trame.state.client.isBusy()")
    page.evaluate("trame.trigger('answer')")  # the server has taken what the test has changed
    page.wait_for_function(
        "document.querySelector('#updating').style.display === 'none'"
        " && Number(document.querySelector('.clouds canvas')?.dataset.frames) > 0"
        " && document.querySelector('#events').textContent.includes('drawn')"
    )


def sharpness(page: Any) -> tuple[float, float]:
    """Return the sharpness as recorded and compensated, read from the page."""
    found = re.search(r"sharpness (-?[\d.]+) → (-?[\d.]+)", page.locator("#sharpness").inner_text())
    assert found is not None
    return float(found[1]), float(found[2])


def drawn(page: Any, selector: str) -> np.ndarray:
    """Return a screenshot of an element, shape ``(height, width, 3)``."""
    return np.asarray(
        Image.open(io.BytesIO(page.locator(selector).screenshot())).convert("RGB"), np.int16
    )


def cloud(page: Any) -> np.ndarray:
    return drawn(page, ".clouds canvas")


def seen_change(page: Any, selector: str, before: np.ndarray) -> np.ndarray:
    """Wait until an element looks different from ``before``; return the new screenshot."""
    now = before

    def changed() -> bool:
        nonlocal now
        now = drawn(page, selector)
        return now.shape != before.shape or bool(
            (np.abs(now - before).max(axis=2) > 40).mean() > 0.005
        )

    until(changed)
    return now


def field(page: Any, name: str) -> float:
    return float(page.locator(f"#field-{name}").input_value())


def enter(page: Any, name: str, value: float | str) -> None:
    """Type a number into a field, and press Enter."""
    page.locator(f"#field-{name}").fill(str(value))
    page.locator(f"#field-{name}").press("Enter")


def slider(panel: Any, name: str) -> float:
    """Return the value of a slider in the state of a page."""
    return float(next(each["value"] for each in panel.state.knobs if each["name"] == name))


def message(page: Any, text: str) -> None:
    """Wait until the page shows a message with this text."""
    page.locator("#message").filter(has_text=text).wait_for()


def middle(page: Any, selector: str) -> tuple[float, float]:
    """Return the centre of an element in the window [px]."""
    page.locator(selector).scroll_into_view_if_needed()
    box = page.locator(selector).bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def region(page: Any) -> list[int]:
    """Return the region of the image that the page shows [px]."""
    return [
        int(page.locator(f"#region-{side}").input_value())
        for side in ("left", "top", "right", "bottom")
    ]


def download(page: Any, name: str, folder: Path) -> Path:
    """Press the button of a download; return the saved file."""
    with page.expect_download() as waiting:
        page.locator(f"#do-{name}").click()
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return path


def test_at_first_sight_the_effect_is_shown_with_a_legend(page: Any, recording: Recording) -> None:
    inspector = Inspector(recording)
    assert estimate_phase(inspector)
    suggested = inspector.suggest_region()
    assert region(page) == list(suggested)
    assert field(page, "phase") == pytest.approx(math.degrees(PHASE), abs=8.0)
    assert sharpness(page)[1] > 1.1 * sharpness(page)[0]
    t, (start, length) = (
        recording.events.slice(0, len(recording.events)).t,
        inspector.first_window(),
    )
    count = int(((t >= start) & (t < start + length)).sum())
    assert page.locator("#events").inner_text().startswith(f"{count:,} events, ")
    assert page.title() == "amiwarp: discs"
    assert page.locator("#legend").inner_text().split("\n")[:3] == [
        "polarity",
        "ON: brighter",
        "OFF: darker",
    ]
    picture = cloud(page)
    for half in np.split(picture[:, : picture.shape[1] // 2 * 2], 2, axis=1):
        assert (half.max(axis=2) - half.min(axis=2) > 80).mean() > 0.01
    for name in ("#image-overview", "#image-before", "#image-after", "#timeline canvas"):
        assert drawn(page, name).std() > 5.0
    assert page.locator("#curve polyline").get_attribute("points").count(",") > 10
    assert (
        page.locator("#prism .missing").inner_text().startswith("phase estimated from the events")
    )
    assert page.locator(".knob:has(#slider-phase) .note").inner_text() == "estimated"
    page.locator("#do-whole").click()
    page.wait_for_function("document.querySelector('#region-right').value === '128'")
    ready(page)
    assert region(page) == [0, 0, 128, 96]
    page.keyboard.press("e")
    until(lambda: region(page) == list(suggested))


def test_while_a_slider_moves_the_page_follows_and_the_curve_is_that_of_the_slider(
    page: Any,
) -> None:
    first, image = sharpness(page), drawn(page, "#image-after")
    title, curve = page.locator("#curve-title"), page.locator("#curve polyline")
    points = curve.get_attribute("points")
    x, y = middle(page, "#slider-phase")
    page.mouse.move(x, y)
    page.mouse.down()
    for distance in (10, 25, 40):
        before = sharpness(page), field(page, "phase")
        page.mouse.move(x + distance, y, steps=3)
        until(lambda before=before: sharpness(page) != before[0])
        assert field(page, "phase") > before[1]
    page.mouse.up()
    seen_change(page, "#image-after", image)
    title.filter(has_text="sharpness over phase").wait_for()
    until(lambda: curve.get_attribute("points") != points)
    assert sharpness(page)[0] == first[0]
    assert page.locator(".knob:has(#slider-phase) .note").inner_text() == "set by hand"
    page.locator("#slider-tilt_x").focus()
    page.keyboard.press("ArrowRight")
    title.filter(has_text="sharpness over tilt in x").wait_for()
    ready(page)
    assert page.locator("#curve .plot-x").inner_text() == "tilt in x (°)"
    until(lambda: page.locator("#curve-text").inner_text().endswith("now 0.05"))
    points = curve.get_attribute("points")
    enter(page, "apex", 0.9)
    title.filter(has_text="sharpness over apex angle").wait_for()
    until(lambda: curve.get_attribute("points") != points)
    assert page.locator("#curve line.truth").count() == 1
    enter(page, "phase", 60.0)
    page.locator("#curve-text").filter(has_text="peak at the edge 90, now 60").wait_for()
    assert page.locator("#curve line.truth").count() == 0  # the true phase is not on the axis


def test_undo_redo_reset_and_the_address_bring_a_state_back(page: Any, opened: Open) -> None:
    first = sharpness(page), region(page)
    enter(page, "apex", 0.9)
    until(lambda: sharpness(page) != first[0])
    ready(page)
    box = page.locator("#image-overview").bounding_box()
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.3 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 0.7 * box["height"], steps=3)
    page.mouse.up()
    until(lambda: region(page) != first[1])
    ready(page)
    second = sharpness(page), region(page)
    left, top, right, bottom = second[1]
    assert 20 < right - left < 100
    assert 20 < bottom - top < 60
    page.wait_for_function("location.hash.includes('region') && location.hash.includes('apex=0.9')")
    other = opened(address=page.evaluate("location.hash"))
    until(lambda: region(other) == second[1])
    until(lambda: sharpness(other) == second[0])
    other.reload()
    ready(other)
    until(lambda: (sharpness(other), region(other), field(other, "apex")) == (*second, 0.9))
    page.bring_to_front()
    page.keyboard.press("z")
    until(lambda: region(page) == first[1])
    assert field(page, "apex") == 0.9
    page.locator("#do-redo").click()
    until(lambda: (sharpness(page), region(page)) == second)
    page.keyboard.press("r")  # a shortcut works after a click
    until(lambda: (sharpness(page), region(page)) == first)
    assert field(page, "apex") == NOMINAL_DEG
    page.evaluate("location.hash = 'apex=90&nonsense=1'")
    message(page, "the address gives 'apex' = '90'")


def test_what_calibration_found_is_compared_accepted_and_saved(
    page: Any, opened: Open, recording: Recording, tmp_path: Path
) -> None:
    first = sharpness(page)
    enter(page, "phase", 20.0)
    until(lambda: sharpness(page)[1] < first[1])
    ready(page)
    before = sharpness(page)
    assert re.match(
        r"on [\d,]+ events from .* s, x \d+ to \d+", page.locator("#calibrate-on").inner_text()
    )
    page.locator("#do-calibrate").click()
    page.locator("#found").wait_for()
    text = page.locator("#found p").inner_text()
    apex, phase = map(float, re.findall(r"(?:apex|phase) (-?[\d.]+)°", text))
    assert apex == pytest.approx(APEX_DEG, rel=0.1)
    assert math.remainder(phase - math.degrees(PHASE), 360.0) == pytest.approx(0.0, abs=5.0)
    # The result is not accepted yet
    assert (sharpness(page), field(page, "apex")) == (
        before,
        NOMINAL_DEG,
    )
    page.locator("#surface .cross.result, #surface .cross").first.wait_for()
    page.locator("#busy").wait_for(state="detached")
    now = page.locator("#surface .cross").first  # the circle of the current parameters follows them
    place = now.get_attribute("style") or now.get_attribute("transform") or str(now.bounding_box())
    enter(page, "apex", 0.7 * NOMINAL_DEG)
    until(
        lambda: (
            (
                now.get_attribute("style")
                or now.get_attribute("transform")
                or str(now.bounding_box())
            )
            != place
        )
    )
    enter(page, "apex", NOMINAL_DEG)
    ready(page)
    page.locator("#do-compare-found").click()
    page.locator("#against-title").filter(has_text="compensated with the result").wait_for()
    until(lambda: sharpness(page)[0] > 1.1 * sharpness(page)[1])
    page.locator("#do-accept").click()
    page.locator("#found").wait_for(state="detached")
    until(lambda: sharpness(page)[1] > 1.1 * sharpness(page)[0])
    ready(page)
    assert field(page, "apex") == pytest.approx(apex, abs=1e-3)
    assert page.locator(".knob:has(#slider-apex) .note").inner_text() == "calibrated"
    path = download(page, "calibration", tmp_path)
    assert path.name == "discs.calibration.json"
    saved = Calibration.load(path)
    assert math.degrees(saved.exact.parameters["apex"]) == pytest.approx(apex, abs=1e-3)
    again = opened(calibration=saved)
    assert field(again, "phase") == field(page, "phase")


def test_two_sets_of_parameters_are_compared(page: Any, kept: Any) -> None:
    page.locator("#do-truth").click()
    until(lambda: field(page, "apex") == pytest.approx(APEX_DEG))
    ready(page)
    until(lambda: sharpness(page)[1] > 1.1 * sharpness(page)[0])
    # A pair each of tilt, cylinder power and wobble, and three more
    assert page.locator("i.truth").count() == 9
    best = sharpness(page)[1]
    page.keyboard.press("b")
    page.locator("#b-text").filter(has_text="apex 1°").wait_for()
    ready(page)
    assert kept[1].state.orbit == kept[1].state.column  # both clouds are compensated
    enter(page, "apex", 0.5)
    until(lambda: sharpness(page)[0] == pytest.approx(best) and sharpness(page)[1] < best)
    page.locator("#do-swap").click()
    until(
        lambda: (
            field(page, "apex") == pytest.approx(APEX_DEG)
            and sharpness(page)[1] == pytest.approx(best)
        )
    )
    image = drawn(page, "#image-after")
    page.locator("#difference").check()
    seen_change(page, "#image-after", image)
    page.locator("#against").select_option("recorded")
    until(lambda: kept[1].state.orbit != kept[1].state.column)
    page.locator("#against-title").filter(has_text="as recorded").wait_for()


def endless(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Make calibrations repeat forever. Return an event that is set when one is cancelled."""
    ended = threading.Event()

    def again(*args: Any, **kwargs: Any) -> None:
        try:
            while True:
                calibrate(*args, **kwargs)
        except JobCancelled:
            ended.set()
            raise

    monkeypatch.setattr(calibration_job, "calibrate", again)
    return ended


def test_a_calibration_is_cancelled_and_a_closed_tab_ends_its_own(
    page: Any, opened: Open, tabs: Tabs, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = endless(monkeypatch)
    page.locator("#do-calibrate").click()
    page.locator("#busy").filter(has_text="calibrating, ").wait_for()
    before = sharpness(page)
    enter(page, "apex", 0.7)
    until(lambda: sharpness(page) != before)  # the page still responds
    page.locator("#do-calibrate").filter(has_text="cancel").click()
    message(page, "calibration cancelled")
    assert ended.wait(WAIT_S)
    until(lambda: page.locator("#found, #busy").count() == 0)
    ended.clear()
    second = opened()
    assert field(second, "apex") == NOMINAL_DEG
    second.keyboard.press("c")
    second.locator("#busy").filter(has_text="calibrating, ").wait_for()
    assert page.locator("#busy").count() == 0
    second.close()
    assert ended.wait(WAIT_S)


def test_bad_values_are_said_and_good_ones_make_the_page_go_on(
    page: Any, recording: Recording
) -> None:
    for name, bad, good, words in (
        ("length_ms", "0", "40", "the window's length is 0 ms; give a length above 0"),
        ("start_ms", "99999", "100", "no events from 99999.000 ms on for 40.000 ms"),
        ("start_ms", "-1e300", "50", "no events from"),
    ):
        ready(page)
        events, value = page.locator("#events").inner_text(), field(page, name)
        enter(page, name, bad)
        message(page, words)
        assert page.locator("#events").inner_text() == events
        until(lambda name=name, value=value: field(page, name) == value)  # what is still shown
        enter(page, name, good)
        page.locator("#message").wait_for(state="detached")
    # A region without width: its sides may be typed in any order.
    page.locator("#region-left").fill(page.locator("#region-right").input_value())
    page.locator("#region-left").press("Enter")
    message(page, "none of them selected")
    page.locator("#do-whole").click()
    page.locator("#message").wait_for(state="detached")
    page.locator("#polarity-OFF").check()
    page.locator("#events").filter(has_text="selected").wait_for()
    page.locator("#polarity-both").check()
    page.locator("#noise").check()
    enter(page, "start_ms", 0)
    enter(page, "length_ms", "1e300")
    page.locator("#events").filter(has_text=f"{len(recording.events):,} events, ").wait_for()


def test_a_value_out_of_range_is_refused_at_its_field_in_its_unit(page: Any, kept: Any) -> None:
    wrong, before = page.locator(".knob:has(#field-apex) .wrong"), sharpness(page)
    for bad, words in (
        ("60", "60 is refused: give 0 to 29.9 °"),
        ("-1", "-1 is refused"),
        ("", "This is refused"),
    ):
        enter(page, "apex", bad)
        wrong.filter(has_text=words).wait_for()
        assert "1.2 is kept" in wrong.inner_text()
        assert field(page, "apex") == NOMINAL_DEG
        assert page.locator("#field-apex").get_attribute("aria-invalid") == "true"
    assert (sharpness(page), page.locator("#message").count()) == (before, 0)
    enter(page, "apex", 0.9)  # later changes work
    until(lambda: sharpness(page) != before)
    assert wrong.count() == 0
    page.evaluate("trame.trigger('typed', ['apex', '60'])")  # not from the field
    message(page, "apex angle: 60 ° is refused; give 0 to 29.9 °")
    assert slider(kept[1], "apex") == 0.9
    page.locator("#message button").click()


def test_a_value_that_the_model_refuses_leaves_the_last_good_one(
    page: Any, kept: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready(page)
    before, show = sharpness(page), Inspector.show

    def refused(inspector: Inspector, knobs: Any = None, **more: Any) -> Any:
        if inspector.knobs.apex > math.radians(2.0):
            raise AmiwarpError("total reflection")
        return show(inspector, knobs, **more)

    monkeypatch.setattr(Inspector, "show", refused)
    enter(page, "apex", 2.5)
    message(page, "total reflection")
    until(lambda: field(page, "apex") == NOMINAL_DEG)
    assert kept[1].inspector.sources["apex"] is not Source.HAND
    enter(page, "phase", 20.0)
    until(lambda: sharpness(page) != before)
    page.locator("#message").wait_for(state="detached")


def test_enter_leaves_a_field_and_later_keys_are_shortcuts(page: Any) -> None:
    page.locator("#field-phase").click()
    page.keyboard.press("Control+a")
    page.keyboard.type("20")
    page.keyboard.press("Enter")
    page.keyboard.press("2")
    page.locator("#view-x-y[aria-pressed=true]").wait_for()
    ready(page)
    assert field(page, "phase") == 20.0
    page.locator("#field-phase").click()
    page.keyboard.type("77")
    page.keyboard.press("Escape")
    assert field(page, "phase") == 20.0


def test_a_server_is_marked_while_it_does_not_answer(page: Any, tabs: Tabs) -> None:
    ready(page)
    assert page.locator("#late").count() == 0
    goes_on = threading.Event()
    tabs.loop.call_soon_threadsafe(goes_on.wait, WAIT_S)
    page.locator("#late").filter(has_text="The server has not answered").wait_for()
    goes_on.set()
    page.locator("#late").wait_for(state="detached")


def test_the_numbers_of_events_add_up_and_the_scope_is_the_chosen_one(
    opened: Open, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inspector_module, "MOST_EVENTS", 64 * 40)
    monkeypatch.setattr(inspector_module, "MOST_POINTS", 200)
    page = opened()
    pattern = r"([\d,]+) events, 2,560 of them read, ([\d,]+) of these selected, 200 of these drawn"
    found = re.fullmatch(pattern, page.locator("#events").inner_text())
    assert found is not None
    assert int(found[1].replace(",", "")) > 2560 > int(found[2].replace(",", "")) > 200
    page.locator("#calibrate-on").filter(has_text="x ").wait_for()
    page.locator("#scope").select_option("whole recording")
    expected = f"on the whole recording, {len(recording.events):,} events"
    page.locator("#calibrate-on").filter(has_text=expected).wait_for()


AS_A_CARD = """
const known = WebGL2RenderingContext.prototype.getParameter, made = HTMLCanvasElement.prototype.getContext;
WebGL2RenderingContext.prototype.getParameter = function (name) {
  return name === 0x9246 ? 'a graphics card' : known.call(this, name);
};
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  const context = made.call(this, kind, { ...options, failIfMajorPerformanceCaveat: false });
  if (kind === 'webgl2' && context) window.card = context;
  return context;
};"""
"""Program that makes a browser take the software that draws its WebGL for a graphics card."""


def test_a_graphics_card_draws_more_points_and_the_same_picture(
    browser: Any, opened: Open, tabs: Tabs, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = opened()
    expected = {}
    for view in ("free", "x-y"):
        page.locator(f"#view-{view}").click()
        ready(page)
        page.wait_for_timeout(200)
        expected[view] = cloud(page)
    monkeypatch.setattr(inspector_module, "MOST_POINTS", 500)
    own = browser.new_context(viewport=page.viewport_size)
    own.add_init_script(AS_A_CARD)
    try:
        drawn_by_card = tabs.open(own, tabs.make)
        if not drawn_by_card.evaluate("Boolean(window.card)"):
            pytest.skip("this browser has no WebGL 2")
        drawn_by_card.locator("#events").filter(has_text="all of these drawn").wait_for()
        for view, picture in expected.items():
            drawn_by_card.locator(f"#view-{view}").click()
            ready(drawn_by_card)
            drawn_by_card.wait_for_timeout(200)
            now = cloud(drawn_by_card)
            assert (np.abs(now - picture).max(axis=2) > 40).mean() < 0.002
        drawn_by_card.evaluate("window.card.getExtension('WEBGL_lose_context').loseContext()")
        until(lambda: drawn_by_card.evaluate("window.card.isContextLost()"))
        drawn_by_card.locator("#view-free").click()
        drawn_by_card.wait_for_timeout(200)
        assert (np.abs(cloud(drawn_by_card) - expected["free"]).max(axis=2) > 40).mean() < 0.002
    finally:
        closed = tabs.closed + 1
        own.close()
        until(lambda: tabs.closed == closed)
        # the software that plays the card warns that it is slow
        tabs.failures[:] = [
            each for each in tabs.failures if "GPU stall due to ReadPixels" not in each
        ]


def test_downloads_leave_no_file_on_the_server(
    page: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recording: Recording
) -> None:
    import av

    folder = recording.events.path.parent  # type: ignore[attr-defined]
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    monkeypatch.setattr(clouds_film, "FRAMES", 4)
    with Image.open(download(page, "picture", tmp_path)) as picture:
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 20
    assert download(page, "pdf", tmp_path).read_bytes().startswith(b"%PDF")
    figure = download(page, "svg", tmp_path).read_text()
    assert "<svg" in figure
    assert "sharpness" in figure
    plain, moved = (
        open_recording(download(page, name, tmp_path)).events for name in ("events", "compensated")
    )
    assert 0.5 * len(plain) < len(moved) <= len(plain)

    def film() -> tuple[np.ndarray, float]:
        """Return the pictures of a film, and the mean difference of the two clouds in the first one."""
        with av.open(str(download(page, "turntable", tmp_path))) as container:
            pictures = np.array(
                [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)], np.int16
            )
        width, height = FILM_SIZE
        # The legend is on the left, the caption below
        strip = round(width * strip_share(["ON: brighter"], width))
        strip += (width - strip) % 2
        half = (width - strip) // 2
        for part in (
            pictures[0, : height // 3, :strip],
            pictures[0, height - FOOT_PX :],
        ):  # have words
            assert (part.max(axis=2) < 120).mean() > 0.005
        left, right = (
            pictures[0, : height - FOOT_PX, first : first + half] for first in (strip, strip + half)
        )
        return pictures, float(np.abs(left - right).mean())

    pictures, apart = film()
    assert len(pictures) == 4
    assert np.abs(pictures[0] - pictures[2]).mean() > 1.0
    page.locator("#do-keep").click()  # both clouds show the same parameters
    page.locator("#against-title").filter(has_text="compensated with B").wait_for()
    assert film()[1] < 0.15 * apart
    page.locator("#speed").select_option("0.001")
    with page.expect_download() as waiting:  # thousands of pictures to the end of the recording
        page.locator("#do-film").click()
        page.locator("#do-end-film").click()
    with av.open(str(waiting.value.path())) as container:
        assert 1 <= len(list(container.decode(video=0))) < 100
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == before


def colours_in(picture: np.ndarray, colours: np.ndarray) -> float:
    """Return the share of colours, shape (n, 3), that occur in a picture, each to within 4 levels of 255."""
    pixels = np.unique(picture.reshape(-1, 3), axis=0).astype(np.int16)
    return float(
        np.mean(
            [np.abs(pixels - colour).max(axis=1).min() <= 4 for colour in colours.astype(np.int16)]
        )
    )


def test_pictures_have_legend_colour_bar_and_caption_and_images_the_difference(
    page: Any, kept: Any, tmp_path: Path
) -> None:
    def picture(name: str) -> np.ndarray:
        with Image.open(download(page, name, tmp_path)) as image:
            return np.asarray(image.convert("RGB"))

    inspector = kept[1].inspector
    page.locator("#picture_scale").select_option("1")
    page.locator("#colour").select_option("residual")
    ready(page)
    height = page.locator(".clouds canvas").bounding_box()["height"]
    below = picture("picture")[int(height) :]
    assert colours_in(below, table_of("cividis")[10:-10:10]) > 0.95
    words = captions.caption(inspector, inspector.show())
    left, top, right, bottom = region(page)
    assert f"x {left} to {right}, y {top} to {bottom} px" in words
    assert " ms; " in words
    ink = (below.max(axis=2) < 100).any(axis=1)  # rows of text
    assert np.count_nonzero(np.diff(ink.astype(np.int8)) == 1) >= 4
    page.locator("#difference").check()
    page.locator("#after-title").filter(has_text="difference").wait_for()
    ready(page)
    pair = make_images(inspector, ImageKind.COUNT, difference=True)
    assert pair.before is not None
    assert pair.after_scale is not None
    found, size = picture("image"), -(-320 // (right - left))
    wide, tall = size * (right - left), size * (bottom - top)
    for k, (values, scale) in enumerate(
        ((pair.before, pair.scale), (pair.after, pair.after_scale))
    ):
        x = 12 + k * (wide + 12)
        image = found[32 : 32 + tall : size, x : x + wide : size]
        assert np.abs(image.astype(np.int16) - scale.rgb(values)).max() <= 1
        bar = found[32 + tall + 8, x : x + wide]
        assert colours_in(bar[None], table_of(scale.colours)[10:-10:10]) > 0.95
    with Image.open(download(page, "values", tmp_path)) as image:
        np.testing.assert_array_equal(np.asarray(image), pair.after)
    assert (
        len(np.genfromtxt(download(page, "csv", tmp_path), delimiter=",", names=True))
        == inspector.loaded.selected
    )
    assert len(np.load(download(page, "npz", tmp_path))["t"]) == inspector.loaded.selected


def test_keys_work_also_after_clicks_and_help_closes_by_key_and_button(page: Any) -> None:
    seen = cloud(page)
    page.locator("#view-x-y").click()
    seen = seen_change(page, ".clouds canvas", seen)
    page.keyboard.press("o")
    seen = seen_change(page, ".clouds canvas", seen)
    assert page.locator("#do-overlaid").get_attribute("aria-pressed") == "true"
    page.keyboard.press("d")
    page.locator("[data-theme=dark]").wait_for()
    until(lambda: cloud(page).mean() < 80)
    page.keyboard.press("t")
    until(lambda: page.locator("#axis").input_value() == "time")
    start = field(page, "start_ms")
    page.locator("#loop").check()
    page.keyboard.press("ArrowRight")
    until(lambda: field(page, "start_ms") == pytest.approx(start + TURN_MS, abs=0.01))
    events = page.locator("#events").inner_text()
    page.keyboard.press(" ")
    page.locator("#do-play").filter(has_text="stop").wait_for()
    until(lambda: page.locator("#events").inner_text() != events)
    page.keyboard.press(" ")
    page.locator("#do-play").filter(has_text="play").wait_for()

    page.keyboard.press("?")
    page.locator("#help").wait_for()
    shown = [row.locator("td").all_inner_texts() for row in page.locator("#help tr").all()]
    signs = {" ": "space", "ArrowRight": "→", "ArrowLeft": "←"}
    assert shown == [[signs.get(key, key), words] for key, _, words in KEYS]
    page.keyboard.press("?")
    page.locator("#help").wait_for(state="hidden")
    page.locator("#do-help").click()
    page.locator("#help-close").click()
    page.locator("#help").wait_for(state="hidden")
    start = field(page, "start_ms")
    page.locator("#field-apex").click()
    page.keyboard.type("d2")
    page.keyboard.press("ArrowRight")
    assert page.locator("[data-theme=dark]").count() == 1
    assert field(page, "start_ms") == start


def test_the_timeline_is_clicked_dragged_and_zoomed(page: Any, recording: Recording) -> None:
    whole = (recording.events.t_last - recording.events.t_first + 1) * 1e-3
    box = page.locator("#timeline canvas").bounding_box()
    across, y = box["width"] - 68, box["y"] + 20

    def x(ms: float) -> float:
        return float(box["x"] + 62 + ms / whole * across)

    page.mouse.click(x(50.0), y)
    until(
        lambda: (
            field(page, "start_ms") == pytest.approx(50.0 - TURN_MS / 2, abs=2.0)
            or field(page, "start_ms") == 0
        )
    )
    ready(page)
    start = field(page, "start_ms")
    page.mouse.move(x(start + 20.0), y)
    page.mouse.down()
    page.mouse.move(x(start + 120.0), y, steps=4)
    page.mouse.up()
    until(lambda: field(page, "start_ms") == pytest.approx(start + 100.0, abs=2.0))
    seen = drawn(page, "#timeline canvas")
    page.mouse.move(x(150.0), y)
    page.mouse.wheel(0, -400)
    seen_change(page, "#timeline canvas", seen)
    page.mouse.dblclick(x(150.0), y)


def test_an_image_is_zoomed_and_moved_and_stays_in_its_frame(page: Any) -> None:
    def under(dx: float = 0.0) -> list[int]:
        """Return the pixel under the mouse, which is ``dx`` away from the middle of the whole image."""
        page.mouse.move(x + dx + 1, y)
        page.mouse.move(x + dx, y)
        text = page.locator(".tile small").first.inner_text()
        return [int(each) for each in re.findall(r"-?\d+", text)]

    x, y = middle(page, "#image-overview")
    first, image = under(30), drawn(page, "#image-overview")
    page.mouse.wheel(0, -800)
    seen_change(page, "#image-overview", image)
    assert under(30) == pytest.approx(first, abs=1)  # the place under the mouse stays
    page.keyboard.down("Shift")
    page.mouse.down()
    for dx in (20, 0, -20):
        page.mouse.move(x + dx, y)
        assert under(dx) == pytest.approx(first, abs=1)  # so it does while it is dragged
    page.mouse.move(x + 5000, y)
    page.mouse.up()
    page.keyboard.up("Shift")
    box = page.locator("#image-overview").bounding_box()
    assert under(box["x"] + 3 - x)[0] in (0, 1)  # the image ends at the edge of its frame
    page.mouse.dblclick(x, y)
    until(lambda: np.abs(drawn(page, "#image-overview") - image).mean() < 1.0)


def pixel(page: Any, selector: str, x: int, y: int) -> tuple[float, float]:
    """Return where an image that is not zoomed shows the middle of a pixel, in the window [px]."""
    left, top, right, bottom = region(page)
    box = page.locator(selector).bounding_box()
    scale = min(box["width"] / (right - left), box["height"] / (bottom - top))
    return (
        box["x"] + box["width"] / 2 + (x + 0.5 - (left + right) / 2) * scale,
        box["y"] + box["height"] / 2 + (y + 0.5 - (top + bottom) / 2) * scale,
    )


def test_counts_and_polarities_are_exact_in_image_colour_pointer_and_file(
    page: Any, kept: Any, recording: Recording, tmp_path: Path
) -> None:
    page.locator("#kind").select_option("polarity")
    page.locator(".colour-square").first.wait_for()
    ready(page)
    left, top, right, bottom = region(page)
    loaded = kept[1].inspector.loaded
    events = loaded.counted
    counts = np.zeros((2, 96, 128), np.int64)
    np.add.at(counts, (events.p, events.y, events.x), 1)
    inner = np.s_[top + 1 : bottom - 1, left + 1 : right - 1]
    y, x = np.unravel_index(np.argmax(counts.min(axis=0)[inner]), counts[0][inner].shape)
    x, y = int(x) + left + 1, int(y) + top + 1
    off, on = counts[:, y, x].tolist()
    assert min(off, on) > 0  # both polarities overlap here
    at = pixel(page, "#image-before", x, y)
    page.mouse.move(*at)
    hover = page.locator(".tile small").first
    hover.filter(has_text=f"x {x}, y {y} px: {off} OFF, {on} ON").wait_for()
    page.mouse.move(2, 2)
    shown = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), np.int16)[
        int(at[1]), int(at[0])
    ]
    images = make_images(kept[1].inspector, ImageKind.POLARITY)
    assert images.before is not None
    np.testing.assert_array_equal(images.before, counts[:, top:bottom, left:right])
    assert np.abs(shown - images.scale.rgb(images.before)[y - top, x - left]).max() <= 1
    page.locator("#kind").select_option("count")
    page.locator(".colour-square").first.wait_for(state="detached")
    ready(page)
    page.mouse.move(*at)
    hover.filter(has_text=f"x {x}, y {y} px: {off + on} events").wait_for()
    with Image.open(download(page, "values", tmp_path)) as values:
        found = np.asarray(values)
    np.testing.assert_array_equal(found, np.rint(found))
    page.mouse.move(*pixel(page, "#image-after", x, y))
    hover.filter(has_text=f"x {x}, y {y} px: {found[y - top, x - left]:.0f} events").wait_for()


def test_a_depth_map_is_an_image_in_metres_with_unknown_pixels_marked(
    opened: Open, tmp_path: Path
) -> None:
    rng, n = np.random.default_rng(0), 20_000
    x, y = (rng.integers(0, size, n).astype(np.uint16) for size in (64, 48))
    events = Events(
        x, y, np.sort(rng.integers(0, 100_000, n)), rng.integers(0, 2, n).astype(np.uint8)
    )
    behind = Recording(
        MemoryEvents(events, 64, 48), Camera.from_fov(64, 48, 1.0), Encoder.constant_speed(720.0, 0, 100_000),
        Plate(0.01, 0.8),
    )  # fmt: skip
    inverse = np.full((48, 64), np.nan, np.float32)
    inverse[:24, :32], inverse[24:, :32] = 2.0, 1.25
    depth = DepthMap(inverse, 0.05 * inverse, np.zeros((48, 64, 3), np.float32))
    page = opened(behind)
    assert page.locator(".knob label").first.inner_text() == "inverse depth (1/m)"
    assert "depth" not in page.locator("#kind option").all_inner_texts()
    page = opened(behind, depth=depth)
    assert page.locator(".knob label").first.inner_text() == "phase (°)"  # the map gives the depths
    page.locator("#do-whole").click()
    page.wait_for_function("document.querySelector('#region-right').value === '64'")
    page.locator("#kind").select_option("depth")
    page.locator("#after-title").filter(has_text="depth map").wait_for()
    ready(page)
    assert page.locator(".colour-bar .title").last.inner_text() == "depth [m]; blue: unknown"
    hover = page.locator(".tile small").first
    for (column, row), text in {(10, 10): "0.5 m", (10, 40): "0.8 m", (50, 10): "unknown"}.items():
        page.mouse.move(*pixel(page, "#image-after", column, row))
        hover.filter(has_text=f"x {column}, y {row} px: {text}").wait_for()
    page.mouse.move(2, 2)
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), np.int16)
    seen = [
        picture[int(y), int(x)]
        for x, y in (pixel(page, "#image-after", *at) for at in ((10, 10), (50, 10)))
    ]
    _, scale = depth_image(depth)
    for colour, metres in zip(seen, (0.5, math.nan), strict=True):
        assert np.abs(colour - scale.rgb(np.array([metres]))[0].astype(int)).max() <= 1
    with Image.open(download(page, "values", tmp_path)) as values:
        np.testing.assert_allclose(np.asarray(values), 1.0 / inverse, rtol=1e-6)


def test_a_click_on_an_event_tells_all_about_it(page: Any, kept: Any, recording: Recording) -> None:
    encoder, panel = recording.encoder, kept[1]
    assert encoder is not None
    events = recording.events.slice(0, len(recording.events))
    page.keyboard.press("2")
    page.locator("#orbit").uncheck()
    ready(page)
    page.wait_for_timeout(100)
    seen = cloud(page)
    rows, columns = np.nonzero(seen.max(axis=2) - seen.min(axis=2) > 100)
    half = seen.shape[1] // 2
    for k in (np.flatnonzero(columns < half)[300], np.flatnonzero(columns >= half)[300]):
        before = page.locator("#picked").all_inner_texts()
        page.locator(".clouds canvas").click(position={"x": float(columns[k]), "y": float(rows[k])})
        until(lambda before=before: page.locator("#picked").all_inner_texts() not in ([], before))
        match = re.match(PICKED, page.locator("#picked span").inner_text())
        assert match is not None
        x, y, p = int(match["x"]), int(match["y"]), int(match["p"] == "ON")
        t = recording.events.t_first + round(float(match["t"]) * 1e3)
        assert int(match["own"]) == t
        assert ((events.x == x) & (events.y == y) & (events.t == t) & (events.p == p)).sum() == 1
        theta = encoder.angle_at(np.array([t]))
        assert float(match["theta"]) == pytest.approx(math.degrees(theta[0] % math.tau), abs=0.006)
        place = panel.inspector.model.compensate_points(
            np.array([[x, y]], np.float32), theta.astype(np.float32)
        )[0]
        assert [float(match["cx"]), float(match["cy"])] == pytest.approx(place.tolist(), abs=0.006)
    page.locator("#picked button").click()
    page.locator("#picked").wait_for(state="detached")


def test_the_page_fits_windows_of_all_sizes(page: Any) -> None:
    parts = (
        "header.bar", ".clouds canvas", ".side", ".strip", "#timeline", "#image-overview", "#image-before",
        "#image-after",
        "#curve", "#view-free", "#view-x-y", *(f"header.bar > *:nth-child({k})" for k in range(1, 10)),
    )  # fmt: skip
    try:
        for width, height in SIZES:
            page.set_viewport_size({"width": width, "height": height})
            page.wait_for_timeout(150)
            for name in parts:
                box = page.locator(name).bounding_box()
                if (
                    box is None or box["width"] * box["height"] == 0.0
                ):  # such as the space between buttons
                    continue
                assert min(box["x"], box["y"]) >= 0, (name, width)
                assert box["x"] + box["width"] <= width, (name, width)
                assert box["y"] + box["height"] <= height, (name, width)
            box = page.locator(".clouds canvas").bounding_box()
            assert box["width"] * box["height"] > 0.25 * width * height
            assert page.locator("#image-after").bounding_box()["height"] > 50
            side = page.locator(".side")
            edge = side.evaluate("side => side.getBoundingClientRect().left + side.clientWidth")
            rights = "all => all.map(one => one.getBoundingClientRect().right)"
            assert (
                max(page.locator(".side :is(button, input, select)").evaluate_all(rights)) <= edge
            )
        page.set_viewport_size({"width": 390, "height": 844})
        page.wait_for_timeout(150)
        assert page.evaluate("document.documentElement.scrollWidth <= 390")
    finally:
        page.set_viewport_size({"width": SIZES[0][0], "height": SIZES[0][1]})


def test_at_a_zoom_of_200_percent_the_clouds_fill_the_window_and_the_rest_is_below(
    page: Any,
) -> None:
    try:
        page.set_viewport_size({"width": 683, "height": 384})
        page.wait_for_timeout(150)
        box = page.locator(".clouds canvas").bounding_box()
        assert box["width"] * box["height"] > 0.35 * 683 * 384
        assert box["y"] + box["height"] < 384
        picture = cloud(page)
        for half in np.split(picture[:, : picture.shape[1] // 2 * 2], 2, axis=1):
            assert (half.max(axis=2) - half.min(axis=2) > 80).mean() > 0.01
        for name in ("#image-after", "#curve", "#timeline canvas"):
            page.locator(name).scroll_into_view_if_needed()
            box = page.locator(name).bounding_box()
            assert min(box["width"], box["height"]) > 40
            assert box["y"] + box["height"] <= 384
        assert page.evaluate("document.documentElement.scrollWidth <= 683")
    finally:
        page.set_viewport_size({"width": SIZES[0][0], "height": SIZES[0][1]})


def test_a_large_sensor_is_shown_soon_in_squares_of_pixels(opened: Open) -> None:
    rng, n, (width, height) = np.random.default_rng(0), 60_000, (2880, 1620)
    x, y = rng.integers(0, width, n), rng.integers(0, height, n)
    x[: n // 2] = 1000 + rng.normal(0.0, 2.0, n // 2).astype(np.int64)
    events = Events.from_arrays(x, y, np.sort(rng.integers(0, 200_000, n)), rng.integers(0, 2, n))
    turning = Encoder.constant_speed(720.0, -5000, 205_000)
    made = Recording(
        MemoryEvents(events, width, height),
        Camera.from_fov(width, height, 1.0),
        turning,
        Prism(0.02),
    )
    page = opened(of=made)
    left, _, right, _ = region(page)
    assert right - left <= 120
    # The line, or where the prism may have moved it from
    assert abs((left + right) / 2 - 1000) < 150
    page.mouse.move(*middle(page, "#image-overview"))
    page.locator(".tile small").first.filter(has_text="events at most in 2×2 px").wait_for()


def texts(page: Any, *, zoomed: bool) -> list[str]:
    """Return the texts of the clouds at the present zoom, or after a turn of the wheel over the left one."""
    page.evaluate("""() => {
        window.drawnTexts = new Set();
        window.writeText ||= CanvasRenderingContext2D.prototype.fillText;
        CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {
            if (this.canvas.closest('.clouds')) window.drawnTexts.add(text);
            return window.writeText.call(this, text, ...rest);
        };
    }""")
    box = page.locator(".clouds canvas").bounding_box()
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.wheel(0, -1200 if zoomed else -1)
    page.wait_for_timeout(150)
    found: list[str] = page.evaluate("[...window.drawnTexts]")
    page.evaluate("CanvasRenderingContext2D.prototype.fillText = window.writeText; null")
    return found


@pytest.mark.parametrize("view", ["free", "x-y", "x-θ", "y-θ"])
def test_ticks_stay_at_every_zoom_and_points_leave_title_and_ticks_alone(
    page: Any, view: str
) -> None:
    page.locator(f"#view-{view}").click()
    page.locator("#do-whole").click()
    page.wait_for_function("document.querySelector('#region-right').value === '128'")
    ready(page)
    number = re.compile(r"-?[\d.]+")
    at_first, zoomed = texts(page, zoomed=False), texts(page, zoomed=True)
    for found in (at_first, zoomed):
        assert len([text for text in found if number.fullmatch(text)]) >= 4
        assert "as recorded" in found
    assert {text for text in zoomed if number.fullmatch(text)} != {
        text for text in at_first if number.fullmatch(text)
    }
    picture = cloud(page)[:24]  # the titles
    assert (picture.max(axis=2) - picture.min(axis=2)).max() < 40
    if view != "free":
        left = cloud(page)[30:-46, :50]  # titles and ticks of the upright axis
        assert (left.max(axis=2) - left.min(axis=2)).max() < 40


FRAMES = """async (views) => {
    const page = [...document.scripts].find((each) => each.src.endsWith('/page.js')).src;
    const { Camera, seenPart } = await import(page.replace('page.js', 'camera.js'));
    const { drawFrame } = await import(page.replace('page.js', 'frame.js'));
    const context = document.createElement('canvas').getContext('2d');
    return views.map(({ azimuth, elevation, zoom, at, size, region, third }) => {
        const [left, top, right, bottom] = region;
        const half = [(right - left) / 2, (bottom - top) / 2, 0.375 * Math.max(right - left, bottom - top)];
        const camera = new Camera('free');
        Object.assign(camera, { azimuth, elevation });
        camera.scale(zoom, ...at);
        const projection = camera.project(half, ...size);
        const box = seenPart(half, projection);
        const all = [[left, right], [bottom, top], third];
        const axes = all.map(([low, high], k) => ({
            title: ['x (px)', 'y (px)', 'θ (°)'][k],
            ends: box.map((end) => low + ((end[k] + half[k]) / (2 * half[k])) * (high - low)),
        }));
        const labels = drawFrame(context, projection, box, axes, ['#000000', '#ffffff'], 12, size);
        const corners = [0, 1, 2, 3, 4, 5, 6, 7].map(
            (n) => projection.at([0, 1, 2].map((k) => box[(n >> k) & 1][k])).slice(0, 2),
        );
        const place = (label) => { // where its value is on the four edges of the whole box
            return [0, 1, 2, 3].map((n) => projection.at([0, 1, 2].map((k) => {
                const [low, high] = all[k];
                if (k === label.axis) return -half[k] + ((label.value - low) / (high - low)) * 2 * half[k];
                const other = [0, 1, 2].filter((each) => each !== label.axis).indexOf(k);
                return ((n >> other) & 1 ? 1 : -1) * half[k];
            })).slice(0, 2));
        };
        return { corners, labels: labels.map((label) => ({ ...label, edges: label.title ? [] : place(label) })) };
    });
}"""


def frames(
    page: Any, views: list[dict[str, Any]]
) -> list[tuple[dict[str, Any], np.ndarray, list[dict[str, Any]]]]:
    """Return views, the corners of their boxes, shape ``(8, 2)``, and their labels [px]."""
    found = page.evaluate(FRAMES, views)
    return [
        (view, np.array(each["corners"]), each["labels"])
        for view, each in zip(views, found, strict=True)
    ]


def overlapping(labels: list[dict[str, Any]]) -> bool:
    boxes = [label["box"] for label in labels]
    return any(
        a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
        for k, a in enumerate(boxes)
        for b in boxes[:k]
    )


def inside_hull(corners: np.ndarray, place: list[float], margin: float) -> bool:
    """Return whether a place is in the outline of the corners, by more than a margin [px]."""
    around = np.array(
        [
            [math.cos(angle), math.sin(angle)]
            for angle in np.linspace(0.0, math.tau, 180, endpoint=False)
        ]
    )
    return bool(((around @ corners.T).max(axis=1) - around @ np.array(place) > margin).all())


SHEETS = ([532, 360], [1064, 360], [764, 590], [390, 300])
REGIONS = ([208, 154, 314, 234], [0, 0, 320, 240], [0, 0, 1280, 720], [40, 10, 60, 90])


@pytest.mark.parametrize("third", [[0, 360], [38.349, 57.523]])
def test_each_axis_has_two_numbers_at_the_outline_of_the_box(page: Any, third: list[float]) -> None:
    views = [
        {"azimuth": azimuth, "elevation": elevation, "zoom": 1.0, "at": [0, 0], "size": size, "region": box,
         "third": third}
        for azimuth in [math.atan2(-1.35, 1), *np.arange(-3.0, 3.2, 0.55).tolist()] for elevation in (0.42, -0.3, 0.9)
        for size in SHEETS for box in REGIONS
    ]  # fmt: skip
    for view, corners, labels in frames(page, views):
        assert not overlapping(labels), view
        for axis in range(3):
            numbers = [
                label for label in labels if label["axis"] == axis and not label.get("title")
            ]
            assert len(numbers) >= 2, (view, axis)
            for label in numbers:
                assert float(label["text"]) == pytest.approx(label["value"], rel=1e-5, abs=1e-9)
                assert min(math.dist(label["from"], edge) for edge in label["edges"]) < 0.5, (
                    view,
                    label,
                )
                assert not inside_hull(corners, label["middle"], 2.0), (view, label)
        assert {label["axis"] for label in labels if label.get("title")} == {0, 1, 2}, view


def test_at_the_first_view_the_full_turn_has_both_ends(page: Any) -> None:
    first = {
        "azimuth": math.atan2(-1.35, 1),
        "elevation": 0.42,
        "zoom": 1.0,
        "at": [0, 0],
        "third": [0, 360],
    }
    for view, _, labels in frames(
        page, [{**first, "size": size, "region": box} for size in SHEETS for box in REGIONS]
    ):
        assert {"0", "360"} <= {label["text"] for label in labels if label["axis"] == 2}, view


def test_close_to_the_cloud_the_box_stays_whole_and_numbers_are_at_the_border_or_its_outline(
    page: Any,
) -> None:
    rng = np.random.default_rng(5)
    first = {"third": [0, 360]}
    total = inside = 0
    views = [
        {**first, "azimuth": azimuth, "elevation": elevation, "zoom": zoom, "size": size, "region": box,
         "at": (min(size) * rng.uniform(-0.15, 0.15, 2)).tolist()}
        for zoom in (1.5, 2.5, 6.0, 30.0) for azimuth in (math.atan2(-1.35, 1), 0.6, 2.4) for elevation in (0.42, 0.15)
        for size in SHEETS for box in REGIONS[:3]
    ]  # fmt: skip
    for view, corners, labels in frames(page, views):
        width, height = view["size"]
        spread = np.ptp(corners, axis=0)
        # The box grows with the points
        assert max(spread / np.array(view["size"])) > 0.55 * view["zoom"], view
        assert not overlapping(labels), view
        for label in labels:
            left, top, right, bottom = label["box"]
            assert min(left, top - 24) >= 0, (view, label)
            assert min(width - right, height - bottom) >= 0, (view, label)
        for axis in range(3):
            numbers = [
                label for label in labels if label["axis"] == axis and not label.get("title")
            ]
            assert len(numbers) >= 2, (view, axis)
            for label in numbers:
                x, y = label["from"]
                at_edge = min(math.dist(label["from"], edge) for edge in label["edges"]) < 0.5
                at_border = min(x, width - x, y - 26, height - y) < 0.5
                total += 1
                inside += not (at_edge or at_border)
    assert total > 0
    assert inside < 0.01 * total  # where no face with the axis is in the picture


SAID_MS = 6000


def test_a_message_moves_no_cloud_and_only_what_was_saved_is_said_for_a_short_time(
    page: Any, kept: Any, tabs: Tabs
) -> None:
    canvas = page.locator(".clouds canvas").bounding_box()
    page.evaluate("trame.trigger('typed', ['apex', 'x'])")
    message(page, "is not a number")
    assert page.locator(".clouds canvas").bounding_box() == canvas
    text = page.locator("#message").bounding_box()
    assert text["y"] >= canvas["y"]
    assert text["y"] + text["height"] <= canvas["y"] + 40  # above the box, where the title is
    page.wait_for_timeout(SAID_MS + 500)
    assert page.locator("#message").is_visible()
    for severity in ("info", "success"):  # of a bookmark and of a file
        tabs.loop.call_soon_threadsafe(kept[1].say, "saved 'from above'", severity)
        message(page, "from above")
        page.wait_for_timeout(SAID_MS / 2)
        assert page.locator("#message").is_visible()
        page.locator("#message").wait_for(state="detached", timeout=SAID_MS)


def test_the_viewpoint_is_marked_until_the_cloud_is_turned(page: Any) -> None:
    def marked() -> list[str]:
        found: list[str] = page.locator("[id^=view-][aria-pressed=true]").evaluate_all(
            "all => all.map(one => one.id)"
        )
        return found

    x, y = middle(page, ".clouds canvas")
    for view in ("free", "x-θ"):
        page.locator(f"#view-{view}").click()
        until(lambda view=view: marked() == [f"view-{view}"])
        page.mouse.move(x, y)
        page.mouse.wheel(0, -100)  # closer, from the same side
        page.wait_for_timeout(100)
        assert marked() == [f"view-{view}"]
        page.mouse.down()
        page.mouse.move(x + 40, y + 10, steps=3)
        page.mouse.up()
        until(lambda: marked() == [])
    page.locator("#view-x-θ").click()
    until(lambda: marked() == ["view-x-θ"])
    page.locator(".clouds canvas").focus()
    page.keyboard.press("Shift+ArrowLeft")
    until(lambda: marked() == [])


def test_a_zoomed_timeline_goes_on_with_the_window_that_is_played(page: Any, kept: Any) -> None:
    state = kept[1].state
    page.evaluate("trame.trigger('zoom_timeline', [0, 150])")
    until(lambda: state.rate_span == [0, 150])
    enter(page, "start_ms", 200)
    ready(page)
    assert state.rate_span == [0, 150]  # somebody may look at another part of the recording
    enter(page, "start_ms", 40)
    ready(page)
    page.locator("#speed").select_option("0.3")
    page.locator("#do-play").click()
    until(lambda: state.rate_span[0] > 10.0)
    page.locator("#do-play").click()
    ready(page)
    low, high = state.rate_span
    assert high - low == pytest.approx(150.0)
    assert low <= state.start_ms
    assert state.start_ms + state.length_ms <= high


NARROW = 15  # width of the scrollbar [px], which a browser without a screen does not show


@pytest.mark.parametrize("size", [(1366, 768), (1920, 1080), (1024, 700)])
def test_texts_of_the_controls_are_whole_and_apart(page: Any, size: tuple[int, int]) -> None:
    try:
        page.set_viewport_size({"width": size[0], "height": size[1]})
        page.add_style_tag(content=f".side {{ border-right: {NARROW}px solid }}")
        page.wait_for_timeout(150)
        rows = "all => all.map((one) => [one.textContent, one.getClientRects().length])"
        parts = page.locator("#steps dd").first.locator(".part").evaluate_all(rows)
        assert [re.sub(r"[\d.]+", "1", text) for text, _ in parts] in (
            ["1 →", "1 Mev/s"],
            ["1 →", "1 kev/s"],
        )
        assert {lines for _, lines in page.locator("#steps .part").evaluate_all(rows)} == {1}
        hint = page.locator(".side .hint").first
        words = hint.inner_text()
        hint.evaluate(
            "(one, name) => { one.textContent = name; }", f"in {'long_name_' * 8}.aedat4.view.json"
        )
        assert hint.evaluate("one => one.scrollWidth <= one.clientWidth")
        hint.evaluate("(one, words) => { one.textContent = words; }", words)
        for alone in (False, True):  # without a prism, the page has other columns
            page.evaluate(
                "alone => document.querySelector('.page').classList.toggle('alone', alone)", alone
            )
            spans = page.locator(".filters label").evaluate_all("""all => all.map((one) => {
                const range = document.createRange();
                range.setStart(one, 0);
                range.setEndBefore(one.querySelector('.number'));
                const box = range.getBoundingClientRect();
                return [box.left, box.right];
            })""")
            assert all(right + 1 < left for (_, right), (left, _) in pairwise(spans)), spans
            assert spans[-1][1] <= page.locator(".filters").evaluate(
                "one => one.getBoundingClientRect().right"
            )
            page.locator("#field-start_ms").evaluate("one => { one.value = '208.309'; }")
            assert page.locator("#field-start_ms").evaluate(
                "one => one.scrollWidth <= one.clientWidth"
            )
        wide = page.locator(".side *").evaluate_all("""all => {
            const side = document.querySelector('.side');
            const edge = side.getBoundingClientRect().left + side.clientWidth;
            const wide = all.filter((one) => one.getBoundingClientRect().right > edge + 1);
            return wide.map((one) => one.outerHTML.slice(0, 120));
        }""")
        assert wide == []
    finally:
        page.evaluate("document.querySelector('.page').classList.remove('alone')")
        page.evaluate("document.head.lastElementChild.remove()")
        page.set_viewport_size({"width": SIZES[0][0], "height": SIZES[0][1]})


def test_control_z_undoes_and_the_look_is_kept_on_reload(opened: Open) -> None:
    page = opened()
    try:
        enter(page, "apex", 0.9)
        ready(page)
        page.keyboard.press("Control+z")
        until(lambda: field(page, "apex") == NOMINAL_DEG)
        page.keyboard.press("Control+Shift+Z")
        until(lambda: field(page, "apex") == 0.9)
        page.keyboard.press("d")
        page.locator("[data-theme=dark]").wait_for()
        page.locator("#point_size").fill("5")
        page.wait_for_timeout(200)
        page.reload()
        ready(page)
        page.locator("[data-theme=dark]").wait_for()
        until(lambda: page.locator("#point_size").input_value() == "5")
    finally:
        page.evaluate("localStorage.clear()")


def test_undo_before_a_change_is_computed_undoes_it_and_redo_brings_it_back(
    page: Any, tabs: Tabs, kept: tuple[Any, Any, dict[str, Any]]
) -> None:
    panel = kept[1]

    def at_once() -> None:
        panel.typed("apex", "0.9")
        panel.undo()

    tabs.loop.call_soon_threadsafe(at_once)
    until(lambda: bool(panel.state.can_redo))
    ready(page)
    assert field(page, "apex") == NOMINAL_DEG
    page.keyboard.press("y")
    until(lambda: field(page, "apex") == 0.9)


def test_a_drag_is_undone_in_one_step_also_if_it_is_released_before_its_last_value_is_shown(
    page: Any, tabs: Tabs, kept: tuple[Any, Any, dict[str, Any]]
) -> None:
    panel, first = kept[1], field(page, "phase")
    tabs.loop.call_soon_threadsafe(panel.slide, "phase", 10.0)
    until(lambda: field(page, "phase") == 10.0)
    ready(page)

    def end() -> None:
        panel.slide("phase", 20.0)
        panel.released()

    tabs.loop.call_soon_threadsafe(end)
    until(lambda: field(page, "phase") == 20.0)
    ready(page)
    page.keyboard.press("z")
    until(lambda: field(page, "phase") == first)


@pytest.mark.parametrize("step", ["open", "show"])
def test_a_value_typed_while_the_window_is_read_or_computed_is_kept(
    page: Any, kept: tuple[Any, Any, dict[str, Any]], monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    inspector, reads, goes_on = kept[1].inspector, threading.Event(), threading.Event()
    read = getattr(inspector, step)

    def slow(*args: Any, **more: Any) -> Any:
        reads.set()
        assert goes_on.wait(WAIT_S)
        return read(*args, **more)

    monkeypatch.setattr(inspector, step, slow)
    enter(page, "start_ms", 20)
    assert reads.wait(WAIT_S)
    enter(page, "apex", 0.9)
    until(lambda: bool(slider(kept[1], "apex") == 0.9))
    goes_on.set()
    until(lambda: math.isclose(inspector.knobs.apex, math.radians(0.9)))
    ready(page)
    assert field(page, "apex") == 0.9


def test_one_event_has_no_sharpness(opened: Open, recording: Recording) -> None:
    one = MemoryEvents(recording.events.slice(20_000, 20_001), *recording.events.size)
    page = opened(of=replace(recording, events=one, truth=None))
    assert page.locator("#sharpness").inner_text() == "sharpness unknown: too few events"


@pytest.mark.parametrize("dark", [False, True])
def test_labels_focus_and_contrast_meet_the_rules_of_axe(page: Any, dark: bool) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    if dark:
        page.keyboard.press("d")
        page.locator("[data-theme=dark]").wait_for()
    page.keyboard.press("?")
    for _ in range(2):  # with the help and without it
        found = axe.Axe().run(page).response["violations"]
        assert [
            (each["id"], [node["html"][:120] for node in each["nodes"]]) for each in found
        ] == []
        page.keyboard.press("Escape")


def test_without_encoder_there_is_one_cloud_until_the_speed_is_set(
    opened: Open, recording: Recording
) -> None:
    page = opened(of=replace(recording, encoder=None, prism=None))
    page.locator("#do-optic").click()
    page.locator("#prism").wait_for()
    assert page.locator("#image-before, #curve, #slider-clock_offset").count() == 0
    assert "no encoder" in page.locator("#prism .missing").first.inner_text()
    assert page.locator("#axis").input_value() == "time"
    assert page.locator("#do-step").inner_text() == "window ▶"
    start, length = field(page, "start_ms"), field(page, "length_ms")
    page.keyboard.press("ArrowLeft")
    until(lambda: field(page, "start_ms") == pytest.approx(start - length, abs=0.01))
    enter(page, "rpm", RPM)
    page.locator("#image-before").wait_for()
    assert "no encoder" not in page.locator("#prism").inner_text()
    assert page.locator("#do-step").inner_text() == "turn ▶"
    page.locator("#curve-title").filter(has_text="speed of the prism").wait_for()
    until(lambda: page.locator("#axis").input_value() == "angle")
    page.locator("#name").click()
    page.keyboard.press("t")
    until(lambda: page.locator("#axis").input_value() == "time")


def test_a_plain_recording_has_windows_by_time_and_count_and_no_controls_of_a_prism(
    opened: Open, recording: Recording
) -> None:
    """Ground truth of a prism does not bring its controls back: nothing in the recording says that one moves."""
    page = opened(of=replace(recording, encoder=None, prism=None))
    optical = "#prism, #calibration, #do-truth, #field-turns, #do-calibration, #do-compensated, #do-suggested, #curve"
    assert page.locator(optical).count() == 0
    assert page.locator("#axis option").all_inner_texts() == ["time"]
    page.locator("#statistics dd").filter(has_text="events/s").wait_for()
    assert "→" not in page.locator("#sharpness").inner_text()
    enter(page, "events", 1000)
    events = recording.events.slice(0, len(recording.events))
    first = np.searchsorted(events.t - events.t[0], 1e3 * field(page, "start_ms"))
    # With those of equal time
    expected = np.count_nonzero(events.t[first:] <= events.t[first + 999])
    page.locator("#events").filter(has_text=f"{expected:,} events, all drawn").wait_for()
    assert field(page, "events") == expected
    page.locator("#do-optic").click()
    page.locator("#slider-rpm").wait_for()
    assert page.locator("#calibration, #do-truth, #field-turns").count() == 3


def test_a_recording_without_a_prism_is_played_fills_its_pane_and_gets_camera_and_prism(
    opened: Open, recording: Recording, tmp_path: Path
) -> None:
    first = recording.events.slice(0, len(recording.events))
    short = MemoryEvents(first[first.t < first.t[0] + 80_000], *recording.events.size)
    page = opened(of=Recording(short, name="plain"))
    page.locator("#do-whole").click()
    ready(page)
    picture = cloud(page)
    rows, columns = np.nonzero(picture.max(axis=2) - picture.min(axis=2) > 80)
    spread = np.ptp(np.percentile(rows, [0.1, 99.9])) * np.ptp(np.percentile(columns, [0.1, 99.9]))
    assert spread > 0.45 * picture.shape[0] * picture.shape[1]
    start = field(page, "start_ms")
    page.keyboard.press(" ")
    until(lambda: field(page, "start_ms") > start + 1.0)
    page.keyboard.press(" ")
    page.locator("#do-play").filter(has_text="play").wait_for()
    enter(page, "start_ms", 0)
    enter(page, "length_ms", 1000)
    ready(page)
    page.keyboard.press(" ")
    message(page, "the window holds the whole recording")
    page.locator("#do-optic").click()
    enter(page, "fov_deg", 50)
    enter(page, "prism_index", 1.6)
    until(lambda: "camera unknown" not in page.locator("#prism").inner_text())
    enter(page, "rpm", RPM)
    page.locator("#image-before").wait_for()
    enter(page, "apex", 1.1)
    ready(page)
    assert field(page, "fov_deg") == 50.0
    saved = open_recording(download(page, "events", tmp_path))
    assert saved.camera == Camera.from_fov(128, 96, math.radians(50.0))
    assert isinstance(saved.prism, Prism)
    assert (math.degrees(saved.prism.apex), saved.prism.index) == (pytest.approx(1.1), 1.6)
    assert saved.encoder is not None
    assert saved.encoder.rpm == pytest.approx(RPM, rel=1e-4)
    assert len(saved.events) == len(short)
    for step, values in (("undo", (60.0, 1.5168)), ("redo", (50.0, 1.6))):
        for _ in range(4):  # apex, speed, index and field of view
            page.locator(f"#do-{step}").click()
            ready(page)
        until(lambda wanted=values: (field(page, "fov_deg"), field(page, "prism_index")) == wanted)
    again = opened(of=saved)
    assert again.locator("#field-fov_deg").count() == 0
    assert again.locator("#image-before").count() == 1


def test_a_live_stream_is_followed_until_one_stops_it(
    opened: Open, tabs: Tabs, recording: Recording
) -> None:
    """The stream grows by 0.5 ms at each request. After a stop, the page keeps working with the events it has."""
    events, asked = recording.events, [0]
    width, height = events.size

    status: Any = SimpleNamespace(
        silence="", encoder_silence="", age_s=0.012, lag_s=0.0, turn_share=1.0, segment=1
    )
    status.recorder = SimpleNamespace(text="", problem="")
    status.status = SimpleNamespace(rate_mev_s=1.25, dropped=3, late=0)

    class Stream(LiveSource):
        def __init__(self) -> None:
            self._recent, self._messages, self._last = status, (), recording

        def __call__(self) -> Recording:
            asked.append(asked[-1] + 1)
            end = events.t_first + round(1.2e3 * TURN_MS) + 500 * asked[-1]
            return replace(
                recording, events=MemoryEvents(events.between(events.t_first, end), width, height)
            )

    latest = Stream()
    page = opened(of=latest(), latest=latest)
    page.locator("#live").filter(has_text="1.25 million events/s").wait_for()
    assert page.locator("#do-suggested").get_attribute("aria-pressed") == "true"
    assert page.locator(".knob:has(#slider-phase) .note").inner_text() == "estimated"
    status.silence = "no events for 2 s"
    page.locator("#stream-note").filter(
        has_text="The stream is interrupted: no events for 2 s"
    ).wait_for()
    status.silence, status.encoder_silence = "", "the port COM3 of the controller is gone"
    page.locator("#stream-note").filter(has_text="No prism angles arrive: the port COM3").wait_for()
    assert f"{RPM:.1f} rpm, last measured" in page.locator("#live dd.bad").all_inner_texts()
    status.encoder_silence, status.lag_s = "", 3.25
    page.locator("#stream-note").filter(has_text="The events are 3.2 s late").wait_for()
    status.lag_s = 0.0
    page.locator("#stream-note").wait_for(state="detached")
    assert page.locator("#live dd.bad").inner_text() == "3"
    assert page.locator("#do-play").inner_text() == "stop"
    shown = field(page, "start_ms")
    until(lambda: field(page, "start_ms") > shown + 8.0)
    page.locator("#do-play").click()
    page.locator("#do-play").filter(has_text="follow").wait_for()
    status.silence = "no events for 2 s"  # it is said although the stream is not followed
    page.locator("#stream-note").wait_for()
    status.silence = ""
    page.locator("#stream-note").wait_for(state="detached")
    until(lambda: not tabs.panels[-1].plays)
    times, start = len(asked), field(page, "start_ms")
    before = sharpness(page)
    enter(page, "apex", APEX_DEG)
    until(lambda: sharpness(page) != before)
    assert len(asked) == times
    assert field(page, "start_ms") == start
    page.locator("#do-play").click()
    until(lambda: field(page, "start_ms") > start)


def test_a_stream_that_goes_on_does_not_disturb_what_is_computed_of_it(
    opened: Open, tabs: Tabs, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The encoder of each picture covers only its own events, and a curve takes longer than a picture."""
    events, encoder, asked = recording.events, recording.encoder, [0]
    assert encoder is not None

    def latest() -> Recording:
        asked[0] += 1
        start = events.t_first + 1000 * (asked[0] % 140)
        part = events.between(start, start + round(1.2e3 * TURN_MS))
        low, high = np.searchsorted(encoder.t, (part.t[0] - 2000, part.t[-1] + 2000))
        own = Encoder(encoder.t[low:high], encoder.angle[low:high])
        return replace(recording, events=MemoryEvents(part, *events.size), encoder=own, truth=None)

    meter = Inspector.sharpness_meter

    def slow(inspector: Inspector) -> Callable[..., float]:
        measure, then = meter(inspector), asked[0]
        if asked[0] > 3:  # while the stream is followed
            until(lambda: asked[0] > then + 40)
        return measure

    monkeypatch.setattr(Inspector, "sharpness_meter", slow)
    page = opened(of=latest(), latest=latest)
    page.locator("#curve polyline").wait_for()
    enter(page, "apex", 1.1)
    page.locator("#curve-text").filter(has_text="now 1.1").wait_for()
    shown = asked[0]
    until(lambda: asked[0] > shown + 20)
    assert page.locator("#message").count() == 0
    assert tabs.panels[-1].state.message == ""


def test_a_live_stream_is_recorded_to_a_new_file(
    opened: Open, recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stream.h5").write_bytes(b"mine")
    events, encoder, size = (
        recording.events.slice(0, len(recording.events)),
        recording.encoder,
        recording.events.size,
    )
    assert encoder is not None
    named = SimpleNamespace(
        size=size, camera=recording.camera, prism=recording.prism, name="stream", encoders=1
    )
    ring = RecentEvents(named)  # type: ignore[arg-type]

    def arrive(start_us: int, stop_us: int) -> None:
        first, last = np.searchsorted(encoder.t, (start_us, stop_us))
        ring.append_encoder(encoder.t[first:last], encoder.angle[first:last])
        ring.append(events[(events.t >= start_us) & (events.t < stop_us)])

    arrive(0, 150_000)
    live = LiveSource(ring, [])
    page = opened(of=live(), latest=live)
    page.locator("#do-record").click()
    message(page, "recording to ")
    page.locator("#do-record").filter(has_text="stop recording").wait_for()
    arrive(150_000, 250_000)
    count = int(((events.t >= 150_000) & (events.t < 250_000)).sum())
    page.locator("#live dd").filter(has_text=f"stream-1.h5: {count:,} events").wait_for()
    page.locator("#do-record").click()
    message(page, f"stream-1.h5: {count:,} events")
    page.locator("#do-record").filter(has_text=re.compile("^record$")).wait_for()
    found = open_recording(tmp_path / "stream-1.h5")
    assert len(found.events) == count
    assert found.encoder is not None
    assert (tmp_path / "stream.h5").read_bytes() == b"mine"


def test_a_live_stream_comes_back_after_its_source_was_restarted(
    opened: Open, tabs: Tabs, recording: Recording, tmp_path: Path
) -> None:
    """The clock of the second sender is an hour behind that of the first one."""
    encoder, events = recording.encoder, recording.events.slice(0, len(recording.events))
    assert encoder is not None
    streams = [
        encode_hello(128, 96, recording.camera, recording.prism)
        + encode_encoder(encoder.t - hour, encoder.angle) + encode_events(replace(events, t=events.t - hour))
        for hour in (0, 3_600_000_000)
    ]  # fmt: skip
    said: list[str] = []
    with ExitStack() as stack:
        with sender(tmp_path / "s", streams[0]) as address:
            recent = RecentEvents(source := open_source(address))
            stack.enter_context(
                followed(source, None, recent, said.append, partial(reopen_source, address))
            )
            latest = LiveSource(recent, said)
            page = opened(of=latest(), latest=latest)
            page.locator("#stream-note").filter(has_text="the stream broke off").wait_for()
            assert page.locator("#live").filter(has_text="segment").count() == 0
        with sender(tmp_path / "s", streams[1], streams[1]):
            page.locator("#live dl").filter(has_text="since the source came back").wait_for()
            until(lambda: latest().events.t_first < events.t[0])
            until(lambda: tabs.panels[-1].inspector.recording.events.t_first < events.t[0])
    assert any("the stream is back: segment 2" in text for text in said)
    before = sharpness(page)
    enter(page, "apex", 0.7)  # the page goes on with the new events
    until(lambda: sharpness(page) != before)


def test_another_file_of_the_folder_is_opened(
    opened: Open, tabs: Tabs, recording: Recording, tmp_path: Path
) -> None:
    small = replace(
        recording, events=MemoryEvents(recording.events.slice(0, 20_000), *recording.events.size)
    )
    save_recording(tmp_path / "other.h5", small)
    (tmp_path / "broken.h5").write_bytes(b"nothing")
    (tmp_path / "notes.md").write_text("no recording")
    tabs.library = Library(tmp_path, lambda path: Inspector(open_recording(path)))
    try:
        page = opened()
        page.locator("#do-open").click()
        assert page.locator("#open .files button").all_inner_texts() == ["broken.h5", "other.h5"]
        page.locator("#open").get_by_text("broken.h5").click()
        message(page, "broken.h5")
        assert page.locator("#name").inner_text() == "discs"
        page.evaluate("trame.trigger('open_file', ['../discs.h5'])")
        message(page, "is no recording in")
        page.locator("#do-open").click()
        page.locator("#open").get_by_text("other.h5").click()
        page.locator("#name").filter(has_text="other").wait_for()
        page.locator("#events").filter(has_text="drawn").wait_for()
        ready(page)
    finally:
        tabs.library = None


class Notebook(BaseHTTPRequestHandler):
    """Server of a page with a frame."""

    frame = ""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(f'<iframe src="{self.frame}" width="1200" height="700"></iframe>'.encode())

    def log_message(self, *args: object) -> None:
        pass


def test_a_page_in_a_notebook_of_another_site_works_and_an_ended_server_is_said(
    browser: Any, recording: Recording
) -> None:
    """The page is in a frame of 127.0.0.1 in a page of localhost, to which browsers send no strict cookies."""
    build = Tabs()
    build.make = lambda: Inspector(recording)
    with (
        browser.new_context() as fresh,
        ThreadingHTTPServer(("127.0.0.1", 0), Notebook) as notebook,
    ):
        threading.Thread(target=notebook.serve_forever, daemon=True).start()
        page = fresh.new_page()
        page.set_default_timeout(1e3 * WAIT_S)
        with served(build, SETTABLE) as (Notebook.frame, _):
            page.goto(f"http://localhost:{notebook.server_port}/")
            inside = page.frame_locator("iframe")
            inside.locator("#events").filter(has_text="drawn").wait_for()
        inside.locator("#lost").filter(has_text="The server does not answer").wait_for()
        assert inside.locator(".clouds canvas").is_visible()
        notebook.shutdown()


def test_curves_and_statistics_of_the_window_before_are_marked_while_it_is_played(
    page: Any,
) -> None:
    curve = page.locator("#curve-text")
    statistics = page.locator("#statistics.stale h2")
    assert curve.inner_text().startswith("peak ")
    page.locator("#field-start_ms").fill("1")
    page.locator("#field-start_ms").press("Enter")
    ready(page)
    assert curve.inner_text().startswith("peak ")
    page.locator("#do-play").click()
    curve.filter(has_text="of the former window: peak ").wait_for()
    page.locator("figure.stale #curve").wait_for()
    statistics.filter(has_text="(of the former window)").wait_for()
    page.locator("#do-play").click()  # playing ends after its current picture
    curve.filter(has_text=re.compile("^peak ")).wait_for()
    statistics.wait_for(state="detached")


def test_a_slice_of_the_third_axis_is_drawn(page: Any, kept: Any) -> None:
    page.locator("#view-x-θ").click()
    page.locator("#orbit").uncheck()
    ready(page)
    before = cloud(page)
    words = page.locator("#events").inner_text()
    page.locator("#slice-from").fill("0.5")
    after = seen_change(page, ".clouds canvas", before)
    assert page.locator("label:has(#slice-from)").inner_text().split() == ["θ", "from", "180"]
    height = before.shape[0]
    coloured = [(np.ptp(each, axis=2) > 90)[:, : each.shape[1] // 2] for each in (before, after)]
    lower = slice(int(0.55 * height), int(0.85 * height))
    assert coloured[0][lower].any()
    assert not coloured[1][lower].any()  # angles below 180 degrees
    page.locator("#slice-to").fill("0.75")
    theta = np.degrees(kept[1].shown.theta)
    seen = np.count_nonzero((theta >= 180.0) & (theta <= 270.0))
    chosen = words.removesuffix(", all of these drawn")
    assert chosen != words
    page.locator("#events").filter(
        has_text=re.compile(f"^{chosen}, {seen:,} of these drawn .slice.$")
    ).wait_for()
    page.locator("#slice-from").fill("0")
    page.locator("#slice-to").fill("1")
    assert page.locator("#events").inner_text() == words
    assert np.array_equal(seen_change(page, ".clouds canvas", after), before)


def test_statistics_of_the_region(page: Any, kept: tuple[Any, Any, dict[str, Any]]) -> None:
    shown = page.locator("#statistics dd")
    shown.filter(has_text="events/s").wait_for()
    assert [text for _, text in kept[1].inspector.statistics()["rows"]] == shown.all_inner_texts()
    page.locator("#polarity-ON").check()
    shown.filter(has_text="100.0 %").wait_for()


def test_another_recording_is_shown_on_the_left(
    context: Any, tabs: Tabs, recording: Recording, nothing_fails: None
) -> None:
    still = simulate(
        np.full((96, 128), 128, np.uint8), recording.camera, recording.prism, duration_s=4 * 60 / RPM,
        motion=PrismMotion(RPM), sensor=SensorModel(shot_noise_hz=3.0), seed=1,
    )  # fmt: skip
    noise = replace(still, encoder=None, truth=None, name="noise")

    def make() -> Inspector:
        made = Inspector(recording)
        made.take_truth()
        made.put_beside(noise)
        return made

    page = tabs.open(context, make)
    try:
        assert page.locator("#against-title").inner_text() == "noise, as recorded"
        assert page.locator("#after-title").inner_text() == "discs, compensated"
        titles = [title for _, title in tabs.panels[-1].state.titles]
        assert titles == ["noise, as recorded, at the prism angles of discs", "discs, compensated"]
        shown, inspector = tabs.panels[-1].shown, tabs.panels[-1].inspector
        assert shown.beside is not None
        # They would read as before and after
        assert page.locator("#sharpness, #difference").count() == 0
        sharp = (shown.beside.sharpness_before, shown.sharpness_after)
        assert page.locator("#two").inner_text().endswith(f"discs: sharpness {sharp[1]:.3f}")
        assert "→" not in page.locator("#two").inner_text()
        figures = page.locator("#recordings dd").all_inner_texts()
        for part, figure, counts in zip(
            (shown.beside, shown), figures[::2], figures[1::2], strict=True
        ):
            seconds = 1e-6 * part.span.length_us
            rate = (
                float(figure.split(" ")[0])
                * {"ev/s": 1.0, "kev/s": 1e3, "Mev/s": 1e6}[figure.split(" ")[1]]
            )
            assert rate == pytest.approx(part.selected / seconds, rel=0.01)
            assert f"{part.span.count:,} events" in counts
        before, after = (tabs.panels[-1].state[name]["high"] for name in ("before", "after"))
        # The noise has few events per pixel: its image has a brightness of its own
        assert before < after
        page.locator("#same_scale").check()
        ready(page)
        assert tabs.panels[-1].state.before["high"] == tabs.panels[-1].state.after["high"] == after
        words = captions.caption(inspector, shown)
        assert "noise: " in words
        assert "discs: " in words
        page.locator("#axis").select_option("time")
        until(lambda: tabs.panels[-1].state.titles[0][1] == "noise, as recorded")
        picture = cloud(page)
        half = picture.shape[1] // 2
        coloured = [
            (np.ptp(each, axis=2) > 60).mean() for each in (picture[:, :half], picture[:, half:])
        ]
        assert 0.0 < coloured[0] < 0.3 * coloured[1]
        x, y = middle(page, ".clouds canvas")
        for dx in range(-8, 9, 2):  # no event of the other recording can be picked
            page.mouse.click(x - half / 2 + 4 * dx, y)
        ready(page)
        assert page.locator("#picked").count() == 0
    finally:
        closed = tabs.closed + 1
        page.close()
        until(lambda: tabs.closed == closed)
