"""Bookmarks: named views of a recording in a file beside it, in command, window and page."""

import json
import math
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from amiwarp import AmiwarpError, Camera, Prism, open_recording, save_recording, simulate
from amiwarp.choices import Axis, Colour, View
from amiwarp.viewer import (
    Inspector,
    Selection,
    ViewState,
    Window,
    apply_state,
    current_state,
    encode_state,
)
from amiwarp.viewer.address import load_bookmark
from amiwarp.viewer.bookmarks import MOST_VIEWS, Bookmarks
from tests.viewer.test_view_cli import view


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory, texture: np.ndarray) -> Path:
    camera, prism = Camera.from_fov(96, 72, math.radians(50.0)), Prism(math.radians(1.0))
    path = tmp_path_factory.mktemp("bookmarks") / "recording.h5"
    save_recording(path, simulate(texture, camera, prism, duration_s=0.3, motion=720.0, seed=3))
    return path


@pytest.fixture
def path(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(original, tmp_path))


@pytest.fixture
def inspector(path: Path) -> Inspector:
    made = Inspector(open_recording(path))
    made.path = path
    return made


def another(inspector: Inspector) -> ViewState:
    """Return a state of which every field differs from the first one."""
    first = current_state(inspector)
    return replace(
        first, start_us=1234, length_us=50_001, selection=Selection(1, (8, 9, 80, 60), True, 3000),
        knobs=first.knobs.with_values({"apex": 0.0123, "phase": -2.5, "clock_offset": 71.5, "tilt_x": 0.01}),
        against=first.knobs.with_values({"phase": 0.25}), colour=Colour.TIME, axis=Axis.TIME, view=View.X_THIRD,
        overlaid=True,
    )  # fmt: skip


def near(found: ViewState, wanted: ViewState) -> bool:
    """Return whether two states are equal but for the last digits of their parameters."""
    for one, other in ((found.knobs, wanted.knobs), (found.against, wanted.against)):
        assert one is not None
        assert other is not None
        for name in ("apex", "phase", "clock_offset", "tilt_x"):
            assert one.value(name) == pytest.approx(other.value(name), rel=1e-9, abs=1e-12)
    return replace(found, knobs=wanted.knobs, against=wanted.against) == wanted


def test_a_view_comes_back_from_the_file_whatever_is_shown_first(
    inspector: Inspector, path: Path
) -> None:
    bookmarks, wanted, first = Bookmarks(path), another(inspector), current_state(inspector)
    assert bookmarks.names() == []
    bookmarks.save(" coast ", encode_state(wanted))
    bookmarks.save("Ä first", encode_state(first))
    assert bookmarks.path == path.with_name("recording.h5.view.json")
    assert Bookmarks(path).names() == ["coast", "Ä first"]
    found, wrong = load_bookmark(Bookmarks(path), "coast", inspector, first)
    assert wrong == ()
    assert near(found, wanted)
    back, wrong = load_bookmark(
        Bookmarks(path), "Ä first", inspector, replace(wanted, against=None)
    )
    assert wrong == ()
    assert replace(back, knobs=first.knobs) == first
    bookmarks.delete("coast")
    assert Bookmarks(path).names() == ["Ä first"]
    assert sorted(each.name for each in path.parent.iterdir()) == [
        "recording.h5",
        "recording.h5.view.json",
    ]


def test_nothing_is_replaced_unasked(inspector: Inspector, path: Path) -> None:
    bookmarks, state = Bookmarks(path), encode_state(current_state(inspector))
    bookmarks.save("one", state)
    before = bookmarks.path.read_bytes()
    with pytest.raises(AmiwarpError, match="'one' exists; give another name, or delete it first"):
        bookmarks.save("one", encode_state(another(inspector)))
    for name in ("", "   ", "a\nb", "x" * 61):
        with pytest.raises(AmiwarpError, match="cannot be taken; give 1 to 60"):
            bookmarks.save(name, state)
    for call in (bookmarks.delete, bookmarks.load):
        with pytest.raises(
            AmiwarpError, match=r"recording.h5.view.json: has no view 'two'; choose among one"
        ):
            call("two")
    assert bookmarks.path.read_bytes() == before
    data = json.loads(before)
    data["views"] = {f"{k:03}": "" for k in range(MOST_VIEWS)}
    bookmarks.path.write_text(json.dumps(data))
    with pytest.raises(AmiwarpError, match="holds 200 views, which is the maximum"):
        bookmarks.save("more", state)


DAMAGED = {
    "no json": (b"{", "cannot be read as bookmarks"),
    "a list": (b"[]", "expected an object"),
    "foreign": (b'{"views": {"a": "start_ms=1"}}', "holds no bookmarks of amiwarp"),
    "newer": (
        b'{"format": "amiwarp views", "version": 2, "views": {}}',
        "holds no bookmarks of amiwarp",
    ),
    "numbers": (
        b'{"format": "amiwarp views", "version": 1, "views": {"a": 1}}',
        "holds no bookmarks of amiwarp",
    ),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_or_foreign_file_is_said_and_kept(
    inspector: Inspector, path: Path, tmp_path: Path, name: str
) -> None:
    content, says = DAMAGED[name]
    file = path.with_name("recording.h5.view.json")
    file.write_bytes(content)
    with pytest.raises(AmiwarpError, match=says):
        Bookmarks(path).save("mine", encode_state(current_state(inspector)))
    code, _, error = view(
        path, "--bookmark", "a", "--screenshot", tmp_path / "out.png", "--size", "200x100"
    )
    assert code == 0, error
    assert says in error
    assert "shown without bookmarks" in error
    assert (tmp_path / "out.png").exists()
    assert file.read_bytes() == content


def test_a_wrong_value_is_said_and_the_rest_is_taken(inspector: Inspector, path: Path) -> None:
    bookmarks, state = Bookmarks(path), current_state(inspector)
    text = "start_ms=20&phase=10&colour=rainbow"
    bookmarks.path.write_text(
        json.dumps({"format": "amiwarp views", "version": 1, "views": {"a": text}})
    )
    found, wrong = load_bookmark(bookmarks, "a", inspector, state)
    assert wrong == (
        "recording.h5.view.json: 'a': the address gives 'colour' = 'rainbow', which this recording cannot show",
    )
    assert (found.start_us, found.colour) == (20_000, Colour.POLARITY)
    assert found.knobs.phase == pytest.approx(math.radians(10.0))


def test_a_picture_of_a_bookmark(inspector: Inspector, path: Path, tmp_path: Path) -> None:
    wanted = replace(another(inspector), against=None)
    Bookmarks(path).save("coast", encode_state(wanted))
    size = ["--size", "300x150"]
    code, said, error = view(
        path, "--bookmark", "coast", "--screenshot", tmp_path / "one.png", *size, "--json"
    )
    assert code == 0, error
    data = json.loads(said)
    assert data["region"] == [8, 9, 80, 60]
    apply_state(inspector, wanted)
    assert data["events"] == inspector.loaded.span.count
    assert data["sharpness_after"] == pytest.approx(inspector.show().sharpness_after, rel=1e-6)
    options = [
        "--colour",
        "time",
        "--axis",
        "time",
        "--view",
        "x-θ",
        "--overlaid",
        "--window",
        "0.001234:0.051235",
    ]
    code, _, error = view(
        path, "--screenshot", tmp_path / "two.png", *size, *options, "--region", "8,9,80,60"
    )
    assert code == 0, error
    one, two = (np.asarray(Image.open(tmp_path / f"{name}.png"), int) for name in ("one", "two"))
    assert np.abs(one[:110, :80] - two[:110, :80]).max() == 0  # one legend


def test_an_unknown_bookmark_is_refused(path: Path, inspector: Inspector, tmp_path: Path) -> None:
    Bookmarks(path).save("one", encode_state(current_state(inspector)))
    code, _, error = view(path, "--bookmark", "two", "--screenshot", tmp_path / "out.png")
    assert code == 1
    assert "recording.h5.view.json does not hold it; choose among one" in error
    assert not (tmp_path / "out.png").exists()


@pytest.fixture
def window(inspector: Inspector) -> Iterator[Window]:
    made = Window(inspector, size=(600, 400), off_screen=True)
    yield made
    made.scene.close()


def test_the_window_saves_and_opens_bookmarks(window: Window, path: Path) -> None:
    window.key("j")
    assert window.message == "there are no bookmarks; u saves one"
    first = window.state_now()
    window.key("u")
    window.run_once()
    assert window.message == "saved 'view 1' in recording.h5.view.json"
    window.slide("phase", 77.0)
    window.key("3")
    window.run_once()
    window.key("u")
    second = window.state_now()
    window.key("j")
    assert window.message == "bookmark view 1"
    assert near(
        replace(window.state_now(), against=first.knobs), replace(first, against=first.knobs)
    )
    window.key("j")
    assert window.message == "bookmark view 2"
    assert math.degrees(window.inspector.knobs.phase) == pytest.approx(77.0)
    assert window.view is View.X_THIRD
    assert window.state_now().selection == second.selection
    window.key("z")  # undo
    window.run_once()
    assert window.inspector.knobs.phase == pytest.approx(first.knobs.phase)
    window.key("j")
    assert window.message == "bookmark view 1"  # after the last one
    Bookmarks(path).path.write_text("[]")
    window.key("u")
    assert "expected an object" in window.message
    window.bookmarks = None
    window.key("j")
    assert window.message == "bookmarks are kept beside a file; this recording is none"


def test_a_window_starts_with_a_bookmark(inspector: Inspector, path: Path) -> None:
    wanted = another(inspector)
    Bookmarks(path).save("coast", encode_state(wanted))
    inspector.bookmark = "coast"
    made = Window(inspector, size=(600, 400), off_screen=True)
    assert near(made.state_now(), wanted)
    assert made.b is not None
    made.scene.close()


def test_the_page_lists_saves_opens_and_deletes_bookmarks(path: Path, browser: Any) -> None:
    pytest.importorskip("trame_client")
    from amiwarp.viewer import Panel
    from amiwarp.viewer.layout import SETTABLE
    from tests.viewer.test_serve import served

    wrong = replace(another(Inspector(open_recording(path))), against=None)
    Bookmarks(path).save("wrong phase", encode_state(wrong))

    def build(server: Any) -> Any:
        made = Inspector(open_recording(path))
        made.path, made.bookmark = path, "wrong phase"
        return Panel(server, made).close

    page = browser.new_page(viewport={"width": 1200, "height": 760})
    page.set_default_timeout(60e3)
    with served(build, SETTABLE) as (url, _):
        page.goto(url)
        page.wait_for_function("document.querySelector('#region-right')?.value === '80'")
        assert page.locator("#field-start_ms").input_value() == "1.234"
        assert page.locator("#polarity-ON").is_checked()
        assert page.locator("#views .hint").inner_text() == "in recording.h5.view.json"
        page.locator("#field-phase").fill("20")
        page.locator("#field-phase").press("Enter")
        page.wait_for_function("document.querySelector('#updating').style.display === 'none'")
        page.locator("#view-name").fill("better")
        page.locator("#do-save-view").click()
        page.wait_for_function("document.querySelectorAll('#views li').length === 2")
        assert "saved 'better' in recording.h5.view.json" in page.locator("#message").inner_text()
        page.locator("#do-save-view").click()
        page.wait_for_function("document.querySelector('#message').innerText.includes('exists')")
        page.get_by_role("button", name="wrong phase", exact=True).click()
        page.wait_for_function(
            "Math.abs(Number(document.querySelector('#field-phase').value) + 143.2394) < 1e-3"
        )
        page.get_by_role("button", name="better", exact=True).click()
        page.wait_for_function("document.querySelector('#field-phase').value === '20'")
        page.get_by_role("button", name="delete the bookmark wrong phase").click()
        page.wait_for_function("document.querySelectorAll('#views li').length === 1")
        assert Bookmarks(path).names() == ["better"]
        page.close()
