"""The panel of the inspector's page, without a browser: errors, order of updates, and work that outlives its file."""

import asyncio
import math
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import numpy as np
import pytest

from amiwarp import AmiwarpError, Camera, Encoder, Events, MemoryEvents, Prism, Recording
from amiwarp.io.event_rates import EventRates
from amiwarp.viewer import Inspector, calibration_job

pytest.importorskip("trame_client")

WAIT_S = 60.0
CAMERA = Camera.from_fov(64, 48, math.radians(60.0))


class DamagedEvents(MemoryEvents):
    """Events of a file in which a chunk in the middle cannot be read."""

    def blocks(self, **_: Any) -> Iterator[Events]:
        yield self.slice(0, 1000)
        raise AmiwarpError("events 1000 .. 2000: damaged chunk; copy the file again")


def recorded(name: str, kind: type[MemoryEvents] = MemoryEvents) -> Recording:
    """Return a recording of 0.3 s through a prism that turns."""
    rng = np.random.default_rng(5)
    count = 30_000
    t = np.sort(rng.integers(0, 300_000, count))
    events = Events.from_arrays(
        rng.integers(0, 64, count), rng.integers(0, 48, count), t, rng.integers(0, 2, count)
    )
    encoder = Encoder.constant_speed(720.0, -1000, 301_000)
    return Recording(kind(events, 64, 48), CAMERA, encoder, Prism(math.radians(1.0)), name=name)


def with_panel(inspector: Inspector, work: Callable[[Any], Awaitable[None]]) -> None:
    """Run ``work`` with a panel whose page is not open in any browser."""
    from trame_server import Server

    from amiwarp.viewer import Panel

    async def main() -> None:
        panel = Panel(Server("amiwarp_test_panel"), inspector)
        try:
            await work(panel)
        finally:
            panel.close()

    asyncio.run(asyncio.wait_for(main(), WAIT_S))


async def until(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(0.01)


def test_a_damaged_chunk_is_an_error_of_the_file_and_no_internal_one() -> None:
    async def work(panel: Any) -> None:
        await until(lambda: "damaged chunk" in panel.state.message)
        assert panel.state.message == "events 1000 .. 2000: damaged chunk; copy the file again"
        assert panel.state.severity == "error"

    with_panel(Inspector(recorded("damaged", DamagedEvents)), work)


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (AmiwarpError("a.h5: is empty; record again"), "a.h5: is empty; record again"),
        (OSError("the disk is gone"), "the disk is gone"),
        (ValueError("odd"), "internal error: odd; the log of the server shows the details"),
    ],
)
def test_only_unforeseen_errors_of_jobs_are_internal(error: Exception, text: str) -> None:
    async def failing() -> None:
        raise error

    async def work(panel: Any) -> None:
        await asyncio.wait([panel.work.start_job(failing())])
        await until(lambda: panel.state.message == text)

    with_panel(Inspector(recorded("own")), work)


def test_slow_updates_begin_with_what_is_on_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    async def work(panel: Any) -> None:
        await until(lambda: not panel.state.updating and panel.shown is not None)

        async def note(name: str) -> None:
            made.append(name)

        monkeypatch.setattr(panel.work, "update_slowly", note)
        panel.work.request_slow("preparation", "statistics", "picture", "curve")
        await until(lambda: len(made) == 4)
        assert made == ["curve", "picture", "statistics", "preparation"]

    with_panel(Inspector(recorded("own")), work)


def test_a_region_may_be_typed_from_any_corner() -> None:
    async def work(panel: Any) -> None:
        panel.draw(40, 30, 10, 5)
        assert panel.state.region_wanted == [10, 5, 40, 30]
        panel.draw(99, -3, -1, 99)
        assert panel.state.region_wanted == [0, 0, 64, 48]
        assert panel.state.region_kind == "whole"

    with_panel(Inspector(recorded("own")), work)


def test_the_timeline_is_counted_outside_the_event_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[threading.Thread] = []
    curve = EventRates.curve

    def noting(rates: EventRates, *given: Any) -> Any:
        threads.append(threading.current_thread())
        return curve(rates, *given)

    monkeypatch.setattr(EventRates, "curve", noting)

    async def work(panel: Any) -> None:
        await until(lambda: bool(panel.state.rate_on) and not panel.state.rate_note)
        before = len(threads)
        panel.zoom_timeline(100.0, 100.2)
        await until(lambda: len(threads) > before)
        await until(lambda: len(panel.state.rate_on) == 4 * 200)  # bins of 1 us
        assert threading.main_thread() not in threads

    with_panel(Inspector(recorded("own")), work)


def test_a_count_ends_quietly_when_another_recording_is_opened(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    first = Inspector(recorded("own"))
    first.put_beside(recorded("beside"), 0)
    may_end, fill = threading.Event(), EventRates.fill

    def waiting(rates: EventRates, seconds: float) -> bool:
        may_end.wait(WAIT_S)
        return fill(rates, seconds)

    monkeypatch.setattr(EventRates, "fill", waiting)

    async def work(panel: Any) -> None:
        await until(lambda: not panel.state.updating and panel.shown is not None)
        may_end.set()
        time.sleep(0.3)  # the count is ready, and the event loop has not heard of it
        await asyncio.sleep(0)
        panel.start(Inspector(recorded("next")))
        await until(lambda: bool(panel.state.rate_on) and not panel.state.rate_note)
        assert panel.state.message == ""
        assert panel.state.rate_rows == []

    with_panel(first, work)
    assert "the page's work failed" not in caplog.text


def test_a_calibration_of_the_recording_before_is_forgotten(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    may_end = [threading.Event(), threading.Event()]
    started: list[Inspector] = []

    def find(inspector: Inspector, *, progress: Any, whole: bool) -> tuple[Any, str]:
        started.append(inspector)
        may_end[len(started) - 1].wait(WAIT_S)
        return inspector.as_calibration(), f"found in {inspector.recording.name}"

    monkeypatch.setattr(calibration_job, "find_calibration", find)

    async def work(panel: Any) -> None:
        await until(lambda: panel.shown is not None)
        panel.calibrate()
        await until(lambda: len(started) == 1)
        old = next(job for job in panel.work.jobs if "_calibrate" in repr(job.get_coro()))
        panel.start(Inspector(recorded("next")))
        await until(lambda: panel.shown is not None)
        panel.calibrate()
        await until(lambda: len(started) == 2)
        may_end[0].set()
        await asyncio.wait([old])
        assert panel.calibration_result is None
        assert panel.state.found == ""
        assert panel.state.calibrating, "the next calibration runs"
        may_end[1].set()
        await until(lambda: panel.state.found == "found in next")
        await until(lambda: not panel.state.busy)

    with_panel(Inspector(recorded("own")), work)
