"""The page with plain recordings, in a real browser: filters, hot pixels, frequencies, windows by number of events."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from amiwarp import (
    Camera,
    EventFilter,
    MemoryEvents,
    Prism,
    Recording,
    find_hot_pixels,
    open_recording,
    simulate,
)
from amiwarp.viewer import Inspector
from amiwarp.viewer.filters import step_rows
from amiwarp.viewer.layout import SETTABLE
from tests.viewer.test_serve import served, until
from tests.viewer.test_view_browser import (
    SIZES,
    Tabs,
    download,
    drawn,
    enter,
    field,
    message,
    middle,
    ready,
    seen_change,
)
from tests.viewer.test_view_filters import HEIGHT, HOT, LENGTH_US, WIDTH, blinking, sorted_events

pytest.importorskip("trame_client")


@pytest.fixture(scope="module")
def plain() -> Recording:
    """Return a recording without a prism: random events, a hot pixel, and a lamp of 100 Hz of 10 x 4 pixels."""
    rng = np.random.default_rng(5)
    n = 12_000
    noise = np.stack(
        [
            rng.integers(0, WIDTH, n),
            rng.integers(0, HEIGHT, n),
            rng.integers(0, LENGTH_US, n),
            rng.integers(0, 2, n),
        ],
        1,
    )
    hot = np.stack(
        [np.full(900, HOT[0]), np.full(900, HOT[1]), np.arange(900) * 220, np.arange(900) % 2], 1
    )
    lamp = [blinking(x, y, 100.0, 40.0 * x) for x in range(20, 30) for y in range(4, 8)]
    rows = np.concatenate([noise, hot, *lamp])
    return Recording(
        MemoryEvents(sorted_events(rows[rows[:, 2] < LENGTH_US]), WIDTH, HEIGHT), name="plain"
    )


@pytest.fixture(scope="module")
def tabs() -> Iterator[Tabs]:
    build = Tabs()
    with served(build, SETTABLE) as (build.url, build.loop):
        yield build


@pytest.fixture
def opened(
    browser: Any, tabs: Tabs, caplog: pytest.LogCaptureFixture
) -> Iterator[Callable[..., Any]]:
    """Return a function that opens the page of a recording. At the end, no error was logged by browser or server."""
    context = browser.new_context(
        viewport=dict(zip(("width", "height"), SIZES[0], strict=True)),
        permissions=["clipboard-read", "clipboard-write"],
    )
    yield lambda recording, address="": tabs.open(context, lambda: Inspector(recording), address)
    closed = tabs.closed + len(context.pages)
    context.close()
    until(lambda: tabs.closed == closed)
    assert tabs.failures == []
    assert [
        record.getMessage()
        for record in caplog.records
        if record.levelname in ("ERROR", "CRITICAL")
    ] == []


def whole(page: Any) -> None:
    """Show the whole time."""
    enter(page, "start_ms", 0)
    enter(page, "length_ms", LENGTH_US * 1e-3)
    ready(page)


def test_the_filter_chain_shows_rates_and_numbers_and_downloads_what_it_shows(
    opened: Callable[..., Any], tabs: Tabs, plain: Recording, tmp_path: Path
) -> None:
    page = opened(plain)
    whole(page)
    assert page.locator("#steps").count() == 0
    page.locator("#noise").check()
    enter(page, "noise_ms", 3)
    enter(page, "refractory_ms", 0.5)
    enter(page, "most_mev_s", 0.03)
    enter(page, "every", 2)
    page.locator("#hide_hot").check()
    page.locator("#steps dt").nth(4).wait_for()
    ready(page)
    events, size = plain.events.slice(0, len(plain.events)), plain.events.size
    chosen = EventFilter(
        hot_pixels=find_hot_pixels(events, size),
        refractory_us=500,
        background_us=3000,
        most_per_s=3e4,
        every=2,
    )
    kept = chosen.apply(events, size)
    names = ["hot pixels", "refractory period", "background activity", "rate", "every n-th"]
    assert page.locator("#steps dt").all_inner_texts() == names
    loaded = tabs.panels[-1].inspector.loaded
    rows = step_rows(loaded.steps, LENGTH_US)
    assert page.locator("#steps dd").all_inner_texts() == [text for row in rows for text in row[1:]]
    assert f"→ {len(kept):,} events" in rows[-1][2]
    assert f"{len(kept):,} of these selected" in page.locator("#events").inner_text()
    written = open_recording(download(page, "events", tmp_path)).events
    np.testing.assert_array_equal(written.slice(0, len(written)).t, kept.t)
    page.wait_for_function(
        "location.hash.includes('refractory_us=500') && location.hash.includes('every=2')"
    )
    again = opened(plain, page.evaluate("location.hash"))
    until(lambda: f"{len(kept):,} of these selected" in again.locator("#events").inner_text())
    values = [field(again, name) for name in ("noise_ms", "refractory_ms", "most_mev_s", "every")]
    assert values == [3.0, 0.5, 0.03, 2.0]
    page.bring_to_front()
    page.keyboard.press("z")
    until(lambda: not page.locator("#hide_hot").is_checked())
    page.keyboard.press("z")
    until(lambda: field(page, "every") == 1.0)


def test_a_refused_filter_leaves_the_last_one(
    opened: Callable[..., Any], tabs: Tabs, plain: Recording
) -> None:
    page = opened(plain)
    enter(page, "refractory_ms", 1)
    page.locator("#steps").wait_for()
    enter(page, "every", 0)
    page.locator(".filters .wrong").filter(has_text="0 is refused: give 1 to").wait_for()
    page.evaluate("trame.trigger('typed', ['every', '0'])")  # not from the field
    message(page, "every n-th event: 0")
    assert field(page, "every") == 1.0
    page.locator("#message button").click()
    ready(page)
    shown = page.locator("#events").inner_text()
    enter(page, "every", 1_000_000)  # which keeps one event
    page.locator("#events").filter(has_text=" 1 of these selected").wait_for()
    enter(page, "every", 1)
    page.locator("#events").filter(has_text=shown).wait_for()


def test_hot_pixels_are_listed_marked_on_the_images_and_copied(
    opened: Callable[..., Any], tabs: Tabs, plain: Recording
) -> None:
    page = opened(plain)
    image = drawn(page, "#image-overview")
    page.locator("#do-hot").click()
    rows = page.locator("#hot tbody tr")
    rows.first.wait_for()
    x, y = HOT
    assert rows.first.locator("button").inner_text() == f"{x}, {y}"
    first = tabs.panels[-1].inspector.hot_pixels[0]
    assert rows.first.locator("td").all_inner_texts()[1:] == [
        f"{first.rate:,.0f}",
        f"{100.0 * first.share:.3g}",
    ]
    rows.first.locator("button").click()
    page.locator("#hot button[aria-pressed=true]").wait_for()
    until(lambda: bool((np.abs(drawn(page, "#image-overview") - image).max(axis=2) > 40).any()))
    seen = drawn(page, "#image-overview")
    box = page.locator("#image-overview").bounding_box()
    scale = min(box["width"] / WIDTH, box["height"] / HEIGHT)
    centre = [
        box["width"] / 2 + (x + 0.5 - WIDTH / 2) * scale,
        box["height"] / 2 + (y + 0.5 - HEIGHT / 2) * scale,
    ]
    yellow = (seen[..., 0] > 200) & (seen[..., 1] > 190) & (seen[..., 2] < 120)
    rows_seen, columns_seen = np.nonzero(yellow)
    assert [columns_seen.mean(), rows_seen.mean()] == pytest.approx(centre, abs=2.0)
    page.locator("#do-copy-hot").click()
    page.locator("#do-copy-hot").filter(has_text="copied").wait_for()
    lines = page.evaluate("navigator.clipboard.readText()").split("\n")
    assert lines[0] == "x,y,events/s,%"
    assert lines[1].split(",")[:2] == [str(x), str(y)]
    assert len(lines) == 1 + len(tabs.panels[-1].inspector.hot_pixels)
    page.locator("#do-unmark").click()
    until(lambda: np.abs(drawn(page, "#image-overview") - image).max() <= 1)


def test_a_lamp_is_seen_in_the_image_of_frequencies_and_recent_pixels_in_that_of_decay(
    opened: Callable[..., Any], tabs: Tabs, plain: Recording, tmp_path: Path
) -> None:
    page = opened(plain)
    whole(page)
    page.locator("#kind").select_option("frequency")
    page.locator("#image-note").filter(has_text="Hz: ").wait_for()
    ready(page)
    first = page.locator("#image-note").inner_text().split(";")[0]
    hz, pixels = float(first.split(" Hz: ")[0]), int(first.split(" Hz: ")[1].removesuffix(" px"))
    assert hz == pytest.approx(100.0, rel=0.01)
    assert 35 <= pixels <= 45
    assert page.locator(".colour-bar .title").last.inner_text() == "frequency [Hz]"
    box = page.locator("#image-after").bounding_box()
    scale = min(box["width"] / WIDTH, box["height"] / HEIGHT)

    def hover(x: int, y: int) -> None:
        page.mouse.move(
            box["x"] + box["width"] / 2 + (x + 0.5 - WIDTH / 2) * scale,
            box["y"] + box["height"] / 2 + (y + 0.5 - HEIGHT / 2) * scale,
        )

    hover(25, 5)
    page.locator(".tile small").first.filter(has_text="x 25, y 5 px: ").filter(
        has_text="Hz"
    ).wait_for()
    hover(40, 20)
    page.locator(".tile small").first.filter(has_text="x 40, y 20 px: no frequency").wait_for()
    with Image.open(download(page, "values", tmp_path)) as values:
        found = np.asarray(values)
    assert np.nanmedian(found[4:8, 20:30]) == pytest.approx(100.0, rel=0.02)
    page.locator("#kind").select_option("decay")
    page.locator(".colour-bar .title").filter(has_text="exp(-age / 10 ms) [1]").wait_for()
    ready(page)
    image = drawn(page, "#image-after")
    enter(page, "decay_ms", 200)
    page.locator(".colour-bar .title").filter(has_text="exp(-age / 200 ms) [1]").wait_for()
    assert seen_change(page, "#image-after", image).mean() > image.mean()
    page.wait_for_function("location.hash.includes('decay_us=200000')")


def test_a_window_by_number_keeps_it_on_steps_and_while_it_is_played(
    opened: Callable[..., Any], tabs: Tabs, plain: Recording
) -> None:
    page = opened(plain)
    times = plain.events.slice(0, len(plain.events)).t
    enter(page, "start_ms", 20)
    enter(page, "events", 900)
    page.locator("#fixed").filter(has_text="Each window holds 900 events").wait_for()
    ready(page)
    assert field(page, "events") == pytest.approx(900, abs=4)
    end_us = tabs.panels[-1].inspector.window[0] + tabs.panels[-1].inspector.window[1]
    page.locator("#do-step").click()
    until(lambda: field(page, "start_ms") > 20.0)
    ready(page)
    expected = times[np.searchsorted(times, end_us)] - times[0]
    assert 1e3 * field(page, "start_ms") == pytest.approx(expected, abs=1)
    assert field(page, "events") == pytest.approx(900, abs=4)
    page.keyboard.press("ArrowLeft")
    until(lambda: field(page, "start_ms") == pytest.approx(20.0, abs=0.2))
    ready(page)
    counts = set()
    page.locator("#do-play").click()
    until(lambda: counts.add(field(page, "events")) or field(page, "start_ms") > 21.0)
    page.locator("#do-play").click()
    ready(page)
    assert all(count == pytest.approx(900, abs=4) for count in counts)
    enter(page, "length_ms", 10)
    page.locator("#fixed").wait_for(state="detached")
    ready(page)
    page.keyboard.press("z")
    page.locator("#fixed").wait_for()


def test_a_region_outside_of_the_image_is_not_like_pixels_without_events(
    opened: Callable[..., Any], plain: Recording
) -> None:
    page = opened(plain)
    image = drawn(page, "#image-overview")
    height, width = image.shape[:2]
    scale = min(width / WIDTH, height / HEIGHT)
    inner = image[round((height - scale * HEIGHT) / 2) + 2 :][: round(scale * HEIGHT) - 4]
    assert (inner.max(axis=2) < 5).mean() > 0.02  # pixels without an event are black
    assert height > scale * HEIGHT + 8
    border = image[: int((height - scale * HEIGHT) / 2) - 1]
    assert border.min() > 100


def test_the_brightness_of_images_waits_until_a_slider_is_released(
    opened: Callable[..., Any], tabs: Tabs, texture: np.ndarray
) -> None:
    camera = Camera.from_fov(96, 72, math.radians(50.0))
    turning = simulate(texture, camera, Prism(math.radians(1.0)), duration_s=0.2, seed=3)
    page = opened(turning)
    state = tabs.panels[-1].state
    high, sharp = state.after["high"], page.locator("#sharpness").inner_text()
    x, y = middle(page, "#slider-phase")
    page.mouse.move(x, y)
    page.mouse.down()
    for distance in (15, 30, 45):
        page.mouse.move(x + distance, y, steps=3)
        until(lambda sharp=sharp: page.locator("#sharpness").inner_text() != sharp)
        sharp = page.locator("#sharpness").inner_text()
    assert state.after["high"] == state.before["high"] == high
    page.mouse.up()
    until(lambda: state.after["high"] != high)
    ready(page)
    page.keyboard.press("z")  # the whole drag is one step
    until(lambda: state.after["high"] == high)


def test_a_cloud_is_downloaded_for_other_programs(
    opened: Callable[..., Any], plain: Recording, tmp_path: Path
) -> None:
    pyvista = pytest.importorskip("pyvista")
    page = opened(plain)
    enter(page, "every", 3)
    ready(page)
    cloud = pyvista.read(download(page, "vtp", tmp_path))
    events = plain.events.slice(0, len(plain.events))
    start = 1e3 * field(page, "start_ms") + events.t[0]
    within = events[(events.t >= start) & (events.t < start + 1e3 * field(page, "length_ms"))]
    np.testing.assert_array_equal(cloud["t_us"], (within.t - events.t[0])[::3])
    np.testing.assert_allclose(cloud.points[:, 0], within.x[::3])
    np.testing.assert_allclose(cloud.points[:, 1], -within.y[::3].astype(float))
    z_ms = cloud.points[:, 2] / cloud.field_data["z_scale"][0] + cloud.field_data["z_start"][0]
    np.testing.assert_allclose(z_ms, cloud["t_us"] * 1e-3, atol=1e-3)


@pytest.mark.parametrize("scale", [1, 3])
def test_a_picture_has_the_chosen_scale_and_says_its_resolution(
    opened: Callable[..., Any], plain: Recording, tmp_path: Path, scale: int
) -> None:
    page = opened(plain)
    box = page.locator(".clouds canvas").bounding_box()
    frames = page.evaluate("document.querySelector('.clouds canvas').width")
    page.locator("#picture_scale").select_option(str(scale))
    with Image.open(download(page, "picture", tmp_path)) as picture:
        assert picture.width == round(box["width"]) * scale
        assert picture.info["dpi"] == pytest.approx((96 * scale, 96 * scale), abs=0.5)
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 20
    with Image.open(download(page, "image", tmp_path)) as picture:
        assert picture.info["dpi"] == pytest.approx((96 * scale, 96 * scale), abs=0.5)
    # The page stays as it is
    assert page.evaluate("document.querySelector('.clouds canvas').width") == frames


@pytest.mark.parametrize("dark", [False, True])
def test_filters_lists_and_two_recordings_meet_the_rules_of_axe(
    browser: Any, tabs: Tabs, plain: Recording, dark: bool
) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")

    def make() -> Inspector:
        made = Inspector(plain)
        made.put_beside(replace(plain, name="other"))
        return made

    context = browser.new_context(viewport=dict(zip(("width", "height"), SIZES[0], strict=True)))
    try:
        page = tabs.open(context, make)
        if dark:
            page.keyboard.press("d")
            page.locator("[data-theme=dark]").wait_for()
        page.locator("#noise").check()
        enter(page, "events", 500)
        page.locator("#kind").select_option("decay")
        page.locator("#do-hot").click()
        page.locator("#hot button").first.click()
        ready(page)
        found = axe.Axe().run(page).response["violations"]
        assert [
            (each["id"], [node["html"][:120] for node in each["nodes"]]) for each in found
        ] == []
        for width, height in (*SIZES, (390, 844)):
            page.set_viewport_size({"width": width, "height": height})
            page.wait_for_timeout(150)
            assert page.evaluate(f"document.documentElement.scrollWidth <= {width}")
            side = page.locator(".side")
            edge = side.evaluate("side => side.getBoundingClientRect().left + side.clientWidth")
            rights = "all => all.map(one => one.getBoundingClientRect().right)"
            assert (
                max(page.locator(".side :is(button, input, select, dd)").evaluate_all(rights))
                <= edge + 0.5
            )
    finally:
        closed = tabs.closed + len(context.pages)
        context.close()
        until(lambda: tabs.closed == closed)
    assert tabs.failures == []
