"""The inspector driven from Python: in a window, in a page of a notebook, and in a notebook that a program runs."""

import asyncio
import base64
import io
import math
import sys
import threading
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import amiwarp
from amiwarp import (
    AmiwarpError,
    Camera,
    InspectorHandle,
    Prism,
    PrismMotion,
    Recording,
    save_recording,
    simulate,
)
from amiwarp.viewer import Inspector
from amiwarp.viewer.handle import _open_window
from amiwarp.viewer.knobs import Source

TURN_US, PHASE = 83_333, 2.0


@pytest.fixture(scope="module")
def recording(texture: np.ndarray) -> Recording:
    return simulate(
        texture, Camera.from_fov(96, 72, math.radians(50.0)), Prism(math.radians(1.0)), duration_s=0.3,
        motion=PrismMotion(720.0, phase=PHASE), nominal_prism=Prism(math.radians(1.2)), seed=3,
    )  # fmt: skip


@pytest.fixture
def handle(recording: Recording) -> Iterator[InspectorHandle]:
    """Handle of a window that is drawn off screen."""
    made = InspectorHandle(Inspector(recording))
    _open_window(made, Inspector(recording), off_screen=True)
    yield made
    made.close()


def window_of(handle: InspectorHandle) -> Any:
    assert handle._window is not None
    return handle._window


def test_values_are_read_and_set_in_radians(handle: InspectorHandle, recording: Recording) -> None:
    start = handle.values
    assert abs(start["phase"] - PHASE) < 0.2  # estimated at the start, as the window does
    assert start["apex"] == pytest.approx(math.radians(1.2))
    assert start["region"] == window_of(handle).inspector.selection.region is not None
    assert start["start_us"] == window_of(handle).time_window[0]
    handle.set(apex=math.radians(1.0), phase=-3.0, polarity=1, colour="residual", view="x-y")
    window = window_of(handle)
    assert (window.inspector.knobs.apex, window.inspector.knobs.phase) == (math.radians(1.0), -3.0)
    assert window.inspector.sources["phase"] is Source.HAND
    assert window.inspector.selection.polarity == 1
    assert np.all(window.shown.events.p == 1)  # drawn at once
    assert (window.look.colour, window.view) == ("residual", "x-y")
    assert handle.values == {
        **start, "apex": math.radians(1.0), "phase": -3.0, "polarity": 1, "colour": "residual", "view": "x-y",
    }  # fmt: skip
    window.undo()
    window.run_once()
    assert handle.values == start


def test_filters_and_images_are_set_as_on_the_page(handle: InspectorHandle) -> None:
    given = {
        "refractory_us": 700,
        "most_per_s": 2e5,
        "every": 3,
        "decay_us": 4000,
        "difference": True,
    }
    handle.set(**given, image="decay", same_scale=True)
    assert {name: handle.values[name] for name in given} == given
    window = window_of(handle)
    selection = window.inspector.selection
    assert (selection.refractory_us, selection.most_per_s, selection.every) == (700, 2e5, 3)
    assert (window.image.value, window.decay_us, window.difference, window.same_scale) == (
        "decay",
        4000,
        True,
        True,
    )
    assert [step.name for step in window.shown.steps][-3:] == [
        "refractory period",
        "rate",
        "every n-th",
    ]


def test_the_time_window_moves_on_the_events_clock(
    handle: InspectorHandle, recording: Recording
) -> None:
    first = recording.events.t_first
    length_us = handle.values["length_us"]
    assert abs(length_us - TURN_US) <= 1
    handle.seek(first + 50_000)
    assert window_of(handle).inspector.window == (first + 50_000, length_us)
    handle.seek(first + 20_000, 10_000)
    assert window_of(handle).shown.events.t.min() >= first + 20_000
    assert window_of(handle).shown.events.t.max() < first + 30_000
    assert (handle.values["start_us"], handle.values["length_us"]) == (first + 20_000, 10_000)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"apeks": 0.1}, "'apeks' is unknown; choose among model, apex, phase, clock_offset"),
        ({"rpm": 700.0}, "'rpm' is unknown; choose among"),  # there is an encoder
        ({"amplitude": 0.01}, "'amplitude' is unknown"),  # of another optic
        ({"apex": 1.0}, "apex = 1.0 is not a finite number"),
        ({"phase": math.nan}, "phase = nan"),
        ({"phase": "2"}, "phase = '2'"),
        ({"model": "mirror"}, "model is 'mirror'; choose among"),
        (
            {"start_us": 10**9},
            "start_us = 1000000000 is not a whole number in 87 .. 299988 us: from the first event",
        ),
        ({"length_us": 0}, "length_us = 0"),
        ({"region": (0, 0, 97, 72)}, "region = 97"),
        ({"region": (10, 10, 10, 20)}, "is no part of the image of 96x72 px"),
        ({"polarity": 2}, "polarity = 2"),
        ({"colour": "cause "}, "colour is 'cause '; choose among polarity"),
        ({"view": "z"}, "view is 'z'"),
        ({"overlaid": 1}, "overlaid is 1; expected a bool"),
        ({"phase": 1.0, "noise_us": -1}, "noise_us = -1"),
        ({"refractory_us": -1}, "refractory_us = -1"),
        ({"most_per_s": -1.0}, "most_per_s = -1.0"),
        ({"every": 0}, "every = 0"),
        ({"decay_us": 0}, "decay_us = 0"),
        ({"difference": 1}, "difference is 1; expected a bool"),
    ],
)
def test_what_cannot_be_set_is_said_and_changes_nothing(
    handle: InspectorHandle, values: dict[str, Any], says: str
) -> None:
    before, heard = handle.values, []
    handle.on_change(heard.append)
    with pytest.raises(AmiwarpError) as error:
        handle.set(**values)
    assert says in str(error.value)
    assert handle.values == before
    assert window_of(handle).inspector.knobs.phase == before["phase"]
    assert heard == []


def test_callbacks_get_what_has_changed(handle: InspectorHandle, recording: Recording) -> None:
    heard: list[dict[str, Any]] = []
    stop = handle.on_change(heard.append)
    handle.set(phase=1.5)
    handle.set(phase=1.5)  # nothing changes
    handle.set(phase=1.5, apex=0.01)
    window = window_of(handle)
    window.slide("phase", 10.0)  # [deg], as the mouse does
    window.run_once()
    window.step(-1)
    window.run_once()
    start = handle.values["start_us"]
    assert heard == [
        {"phase": 1.5},
        {"apex": 0.01},
        {"phase": pytest.approx(math.radians(10.0))},
        {"start_us": start},
    ]
    assert start == window.time_window[0]
    stop()
    handle.set(phase=0.0)
    assert len(heard) == 4


def test_an_error_of_a_callback_is_reported_and_stops_nothing(
    handle: InspectorHandle, caplog: pytest.LogCaptureFixture
) -> None:
    heard: list[dict[str, Any]] = []

    def fails(changed: dict[str, Any]) -> None:
        raise ValueError("of the user")

    handle.on_change(fails)
    handle.on_change(heard.append)
    handle.set(phase=0.5)
    assert heard == [{"phase": 0.5}]
    assert "the callback fails failed" in caplog.text
    assert "of the user" in caplog.text
    assert window_of(handle).message == "the callback fails failed: ValueError: of the user"
    handle.set(phase=0.6)
    assert window_of(handle).inspector.knobs.phase == 0.6


def test_a_callback_may_set_values(handle: InspectorHandle) -> None:
    """It follows the phase with the apex, while the window handles the slider."""
    handle.on_change(
        lambda changed: handle.set(apex=changed["phase"] / 100.0) if "phase" in changed else None
    )
    window = window_of(handle)
    window.slide("phase", 90.0)
    window.run_once()
    window.run_once()  # what the callback has set
    assert window.inspector.knobs.apex == pytest.approx(math.radians(0.9))
    assert handle.values["apex"] == pytest.approx(math.radians(0.9))


def test_a_picture_shows_what_is_set(handle: InspectorHandle) -> None:
    right, size = np.asarray(handle.picture((400, 200))), (200, 400, 3)
    handle.set(phase=handle.values["phase"] + math.pi)
    wrong = np.asarray(handle.picture((400, 200)))
    assert right.shape == wrong.shape == size
    changed = np.abs(right.astype(int) - wrong).max(axis=2) > 60
    middle = 220  # between the clouds, right of the legend
    # Only the compensated cloud
    assert changed[20:170, middle:].mean() > 10.0 * changed[20:170, :middle].mean()
    assert np.asarray(handle.picture((400, 200), dark=True))[100, 2].max() < 60


def test_a_closed_window_leaves_values_and_pictures(recording: Recording) -> None:
    made = InspectorHandle(Inspector(recording))
    _open_window(made, Inspector(recording), off_screen=True)
    window = window_of(made)
    made.on_change(lambda changed: made.close())
    window.slide("phase", 30.0)
    made.run()  # ends at the callback
    assert made._window is None
    made.set(phase=1.0)
    assert made.values["phase"] == 1.0
    assert made.picture((200, 100)).size == (200, 100)


def test_without_notebook_and_display_both_are_named(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    if sys.platform != "linux":
        pytest.skip("other systems have a display")
    monkeypatch.setenv("DISPLAY", "")
    with pytest.raises(
        AmiwarpError,
        match=r"there is no display.* in a notebook or a window; .*amiwarp view FILE --web",
    ):
        amiwarp.view(recording)


def test_a_notebook_names_the_extra_of_the_page(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[object] = []
    fake = types.ModuleType("IPython.display")
    vars(fake).update(IFrame=lambda url, width, height: url, display=shown.append)
    monkeypatch.setitem(sys.modules, "IPython", types.ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", fake)
    monkeypatch.setitem(sys.modules, "aiohttp", None)

    async def cell() -> None:
        amiwarp.view(recording)

    with pytest.raises(AmiwarpError, match=r"run: pip install 'amiwarp\[page\]'"):
        asyncio.run(cell())
    assert shown == []


def test_a_page_follows_its_handle_and_tells_what_its_user_does(
    recording: Recording, monkeypatch: pytest.MonkeyPatch, browser: Any
) -> None:
    """A cell opens the page; later cells set values, before and after a browser shows it."""
    pytest.importorskip("trame_client")
    pages: list[str] = []
    fake = types.ModuleType("IPython.display")
    vars(fake).update(IFrame=lambda url, width, height: url, display=pages.append)
    monkeypatch.setitem(sys.modules, "IPython", types.ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", fake)
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    heard: list[dict[str, Any]] = []

    def cell(call: Any) -> Any:
        async def work() -> Any:
            return call()

        return asyncio.run_coroutine_threadsafe(work(), loop).result(60.0)

    page = browser.new_page(viewport={"width": 1200, "height": 760})
    page.set_default_timeout(60e3)
    try:
        handle = cell(lambda: amiwarp.view(recording))
        cell(lambda: handle.on_change(heard.append))
        first = recording.events.t_first
        cell(lambda: handle.set(phase=math.radians(33.0)))
        cell(lambda: handle.seek(first + 40_000))
        page.goto(pages[0])
        page.wait_for_function("document.querySelector('#field-phase')?.value === '33'")
        assert page.locator("#field-start_ms").input_value() == "40"
        cell(lambda: handle.set(apex=math.radians(0.8), region=(8, 8, 80, 64)))
        page.wait_for_function("document.querySelector('#field-apex')?.value === '0.8'")
        page.wait_for_function("document.querySelector('#region-right')?.value === '80'")
        assert page.locator("#field-phase").input_value() == "33"  # which nobody has changed
        heard.clear()
        page.locator("#field-phase").fill("-20")
        page.locator("#field-phase").press("Enter")
        page.wait_for_function("document.querySelector('#updating').style.display === 'none'")
        until(lambda: heard)
        assert heard == [{"phase": pytest.approx(math.radians(-20.0))}]
        assert cell(lambda: handle.values)["phase"] == pytest.approx(math.radians(-20.0))
        page.locator("#do-undo").click()
        page.wait_for_function("document.querySelector('#field-phase')?.value === '33'")
        until(lambda: len(heard) == 2)
        assert heard[-1] == {"phase": pytest.approx(math.radians(33.0))}

        def fails(changed: dict[str, Any]) -> None:
            raise ValueError("of the user")

        cell(lambda: handle.on_change(fails))
        cell(lambda: handle.set(phase=0.0))
        page.wait_for_function(
            "document.querySelector('#message')?.innerText.includes('ValueError: of the user')"
        )
        page.wait_for_function("document.querySelector('#field-phase')?.value === '0'")
    finally:
        page.close()
        cell(handle.close)
        asyncio.run_coroutine_threadsafe(asyncio.wait([handle._serving]), loop).result(60.0)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(60.0)
        loop.close()


def until(met: Any) -> None:
    """Wait until a condition is met."""
    waiting = threading.Event()
    for _ in range(600):
        if met():
            return
        waiting.wait(0.1)
    raise AssertionError("not met within a minute")


@pytest.mark.slow
def test_a_notebook_that_a_program_runs_keeps_page_and_pictures(
    recording: Recording, tmp_path: Path
) -> None:
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    save_recording(tmp_path / "recording.h5", recording)
    cells = [
        "import amiwarp\ninspector = amiwarp.view(amiwarp.open_recording('recording.h5'))",
        "heard = []\ninspector.on_change(heard.append)\ninspector.picture((400, 200))",
        "inspector.set(phase=inspector.values['phase'] + 3.0)\ninspector.picture((400, 200))",
        "print(*heard)\ninspector.seek(10_000)\nprint(inspector.values['start_us'])\ninspector.close()",
    ]
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    done = nbclient.NotebookClient(
        book, timeout=120, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    shown = [[output.get("data", {}) for output in cell.outputs] for cell in done.cells]
    assert "<iframe" in shown[0][0]["text/html"]
    pictures = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(shown[k][-1]["image/png"]))))
        for k in (1, 2)
    ]
    assert pictures[0].shape == pictures[1].shape == (200, 400, 3)
    changed = np.abs(pictures[0].astype(int) - pictures[1]).max(axis=2) > 60
    assert changed[20:170, 220:].mean() > 10.0 * changed[20:170, :220].mean()
    said = "".join(output.text for output in done.cells[3].outputs)
    assert said.startswith("{'phase': ")
    assert said.endswith("\n10000\n")
