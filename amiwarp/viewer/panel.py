"""Page of the inspector: passes input from the browser to the inspector, and the inspector's results to the browser.

Each browser tab has one panel with its own inspector and state. Slow work runs in threads. If a slider moves several
times meanwhile, only its last position is used. What waits for an update is marked on the page.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from amiwarp.errors import AmiwarpError
from amiwarp.viewer.comparison import Comparison
from amiwarp.viewer.frames import wait_until_page_keeps_up
from amiwarp.viewer.jobs import CalibrationJob, Playback
from amiwarp.viewer.layout import NAMES, SLIDERS, UNITS, template
from amiwarp.viewer.live_source import LiveSource
from amiwarp.viewer.page_calls import PageCalls
from amiwarp.viewer.page_exports import Exports
from amiwarp.viewer.page_files import use_page
from amiwarp.viewer.page_history import PageHistory
from amiwarp.viewer.page_values import CLIENT_ONLY, initial_state, notes, source_state
from amiwarp.viewer.parameters import Selection
from amiwarp.viewer.rate_view import RateView
from amiwarp.viewer.updates import Updates

if TYPE_CHECKING:
    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.library import Library

_CUDA_LOCK = asyncio.Lock()
"""Lock for all tabs: Warp's CUDA calls may run in only one thread at a time."""
QUICK = {**dict.fromkeys(("window", "suggestion", "state", "knobs"), ("clouds", "images")), "look": ("clouds",)}
SLOW = ("curve", "picture")
"""Updates that are made at once, with the parts of the page that wait for them, and updates that take longer."""


class Panel:
    """Panel that connects the page of one browser tab with its inspector. Call :meth:`close` when the tab is closed."""

    def __init__(self, server: Any, inspector: Inspector, library: Library | None = None) -> None:
        """Build the page on a new trame server. ``library``: other recordings that the page may open."""
        self.server, self.state, self.inspector, self.library = server, server.state, inspector, library
        self.buffers_lock = asyncio.Lock()
        """Lock of the inspector's buffers on the device, which only one thread may use at a time."""
        self.device_lock: Any = _CUDA_LOCK if "cuda" in str(inspector.device) else contextlib.nullcontext()
        self.calibration_job, self.playback, self.updates = CalibrationJob(self), Playback(self), Updates(self)
        self.calls = PageCalls(self)
        self.comparison, self.history, self.rates = Comparison(self), PageHistory(self), RateView(self)
        self.exports = Exports(self)
        self.change = ""
        """What the user changes; successive changes of one name are undone together."""
        self._drags = 0
        self._quick_requests: set[str] = set()
        self._slow_requests: set[str] = set()
        self._doing: set[str] = set()
        self._quick: asyncio.Task[None] | None = None
        self._slow: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._error_source = ""
        self._threads = ThreadPoolExecutor(3, "amiwarp-tab")  # calibration or film; curve or picture; quick updates
        use_page(server, template())
        self.state.client_only(*CLIENT_ONLY)
        self._listen()
        self.start(inspector)

    def start(self, inspector: Inspector) -> None:
        """Show an inspector from its first state."""
        self.inspector, state = inspector, self.state
        inspector.renew()  # a live stream may have gone on since the inspector was made
        files = [] if self.library is None else self.library.files()
        folder = "" if self.library is None else str(self.library.folder)
        state.update({**initial_state(inspector), "files": files, "folder": folder})
        start, length = inspector.window or inspector.first_window()
        state.update({"start_ms": round((start - self.zero_us) * 1e-3, 3), "length_ms": round(length * 1e-3, 3),
                      "region_wanted": [0, 0, *inspector.recording.events.size], "knob": "apex"})  # fmt: skip
        self.show_knobs()
        self.updates.first()
        self.history.forget()
        self.comparison.b = None
        self.rates.start()
        self.request("window", *(["suggestion"] if self.compensates else []))
        self.slider_released()
        self.request_slow("preparation")
        if inspector.latest is not None:
            self.playback.toggle()
        if isinstance(inspector.latest, LiveSource):
            self.start_job(self.playback.watch(inspector.latest))

    async def open_file(self, name: str) -> None:
        """Show another recording of the library."""
        if self.library is None:
            return
        self.calibration_job.cancel()
        self.state.playing = False
        with self.errors_shown("file"):
            inspector = await self.in_thread(self.library.open, name)
            await self.wait_until_drawn()
            self.start(inspector)
        self.state.flush()

    def close(self) -> None:
        """Stop all work of the browser tab. A thread ends when its current work is done."""
        self.calibration_job.cancel()
        self.playback.end()
        self.exports.end()
        for task in [*self._tasks, *filter(None, [self._quick, self._slow])]:
            task.cancel()
        self._threads.shutdown(wait=False, cancel_futures=True)

    @property
    def zero_us(self) -> int:
        """Time of the recording's first event, from which the page counts all times [us]."""
        return int(self.inspector.recording.events.t_first)

    @property
    def compensates(self) -> bool:
        """Whether the prism rotates, so that there is a motion to compensate."""
        return math.isfinite(self.inspector.turn_us)

    def knobs_taken(self) -> None:
        """Show parameters that the inspector has taken from elsewhere."""
        self.show_knobs()
        self.request("knobs")
        self.slider_released()

    def slider_released(self) -> None:
        """Update the slow parts of the page after a change, and end what is undone in one step."""
        self._drags += 1
        self.request_slow(*SLOW)

    def show_region(self, region: list[int], kind: str) -> None:
        """Show a region of the image [px]. ``kind`` is "drawn", "whole" or "suggested"."""
        width, height = self.state.size
        left, right = (min(max(x, 0), width) for x in region[::2])
        top, bottom = (min(max(y, 0), height) for y in region[1::2])
        self.state.update({"region_wanted": [left, top, right, bottom], "region_kind": kind})
        self.request("window")
        self.slider_released()

    def request(self, *what: str, change: str = "") -> None:
        """Request quick updates of the page: "window", "knobs", "look", "suggestion" or "state".

        ``change``: name of a change that lasts, such as a drag; it is undone in one step.
        """
        self.change = f"{change} {self._drags}" if change else ""
        self._quick_requests.update(what)
        self._show_pending()
        if self._quick is None:
            self._quick = self._task(self._work())

    def request_slow(self, *what: str) -> None:
        """Request updates that run in a thread after all quick updates: "curve", "picture" or "preparation"."""
        self._slow_requests.update(what)
        self._show_pending()
        if self._slow is None:
            self._slow = self._task(self._work_slowly())

    async def wait_until_drawn(self) -> None:
        """Wait until no quick update is pending."""
        while self._quick is not None:
            await asyncio.sleep(0.005)

    def start_job(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a job until it ends or the browser tab is closed."""
        self._tasks.add(task := self._task(work))
        task.add_done_callback(self._tasks.discard)

    async def in_thread(self, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Call ``work`` in one of the browser tab's threads, and return its result."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, partial(work, *args, **options))

    def show_message(self, text: str, severity: str) -> None:
        with self.state:
            self.state.update({"message": text, "severity": severity})

    @contextlib.contextmanager
    def errors_shown(self, what: str) -> Iterator[None]:
        """Show errors of the enclosed code as a message, until the same kind of action (``what``) succeeds."""
        try:
            yield
        except (AmiwarpError, OSError) as error:
            self._error_source = what
            self.state.update({"message": str(error), "severity": "error"})
        else:
            if self.state.severity == "error" and self._error_source == what:
                self.state.update({"message": "", "severity": "info"})

    def move(self, start_ms: float, change: str = "") -> bool:
        """Move the time window to a start [ms], limited to the recording. Return whether the window is at the end."""
        last = max(0.0, float(self.state.whole_ms) - float(self.state.length_ms))
        self.state.start_ms = round(min(max(start_ms, 0.0), last), 3)
        self.request("window", change=change)
        return start_ms >= last

    def renew(self) -> None:
        """Take the current events of a live stream, and move the window to their end."""
        with self.errors_shown("stream"):
            self.inspector.renew()
        self.state.update(source_state(self.inspector))
        self.rates.start()
        self.move(float(self.state.whole_ms))

    def download(self, name: str, content: bytes, kind: str) -> None:
        """Give the browser a file to save; ``kind`` is its media type."""
        self.server.js_call("page", "download", name, content, kind)

    def selection(self) -> Selection:
        """Return the conditions for events that the page shows."""
        s = self.state
        region, whole = tuple(s.region_wanted), (0, 0, *s.size)
        noise_us = round(1e3 * float(s.noise_ms)) if s.noise_filter else None
        return Selection({"both": None, "ON": 1, "OFF": 0}[s.polarity], None if region == whole else region,
                         bool(s.hide_hot), noise_us)  # fmt: skip

    def show_knobs(self) -> None:
        """Show the inspector's parameters on the page."""
        inspector = self.inspector
        sources = {name: str(source.value) for name, source in inspector.sources.items()}
        self.state.update(
            {**self._knobs(), "model": inspector.knobs.model, "sources": sources, "notes": notes(inspector)}
        )

    # internal

    def _listen(self) -> None:
        """Follow the state variables that the page sets, and offer the functions that it calls."""
        for name in NAMES:
            self.state.change(name)(_without_state(self._dragged, name))
        for what, names in {
            "window": ("polarity", "hide_hot", "noise_filter"), "look": ("colour", "axis", "dark", "orbit_shown"),
            "knobs": ("model", "against", "kind", "difference"),
        }.items():  # fmt: skip
            self.state.change(*names)(_without_state(self.request, what))
        self.state.change("model", "kind", "polarity", "hide_hot", "noise_filter")(_without_state(self.slider_released))
        for name, call in self.calls.offered.items():
            self.server.trigger(name)(call)

    def _dragged(self, name: str) -> None:
        """Follow a slider. Values that the server itself has set are ignored."""
        if self.state[name] != self._knobs()[name]:
            self.state.knob = name
            self.request("knobs", change=name)

    def _knobs(self) -> dict[str, float]:
        """Return the prism's parameters in the page's units, rounded as the page shows them."""
        return {name: round(getattr(self.inspector.knobs, name) / scale, 4) for name, scale in UNITS.items()}

    def _show_pending(self) -> None:
        """Show which parts of the page wait for an update."""
        quick = self._quick_requests | self._doing
        parts = {part for what in quick for part in QUICK.get(what, ())} | (self._slow_requests | self._doing) & {*SLOW}
        self.state.updating = sorted(parts)

    def _task(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        task.add_done_callback(self._ended)
        return task

    def _ended(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            logging.getLogger(__name__).error("the page's work failed", exc_info=error)
            text = f"internal error: {error or type(error).__name__}; the log of the server shows the details"
            self.show_message(text, "error")

    async def _work(self) -> None:
        try:
            while self._quick_requests:
                await wait_until_page_keeps_up(self.server)
                todo, self._quick_requests = self._quick_requests, set()
                async with self._done(todo), self.device_lock, self.buffers_lock:
                    await self.updates.make(todo)
                await asyncio.sleep(0)
        finally:
            self._quick = None

    async def _work_slowly(self) -> None:
        try:
            while self._slow_requests:
                await self.wait_until_drawn()
                name = min(self._slow_requests)  # in alphabetical order: the curve first, the preparation last
                self._slow_requests.discard(name)
                async with self._done({name}), self.device_lock:
                    with self.errors_shown(name):
                        await self.updates.make_slow(name)
        finally:
            self._slow = None

    @contextlib.asynccontextmanager
    async def _done(self, todo: set[str]) -> Any:
        """Mark updates as being made, and send the state to the browser when they are made."""
        self._doing |= todo
        try:
            yield
        finally:
            self._doing -= todo
            with self.state:
                self._show_pending()

    def set_knobs(self) -> None:
        """Give the inspector the parameters that the page shows, where they differ from the inspector's."""
        rounded = self._knobs()
        values = {name: float(self.state[name]) * UNITS[name] for name in NAMES
                  if self.state[name] != rounded[name]}  # fmt: skip
        self.inspector.set(replace(self.inspector.knobs, model=self.state.model, **values))

    def knob_title(self) -> tuple[str, str]:
        """Return the name of the sharpness curve's parameter, and its name with the unit."""
        label, unit, *_ = SLIDERS[self.state.knob]
        return label, f"{label} ({unit})"


def _without_state(call: Callable[..., None], *args: str) -> Callable[..., None]:
    """Return a function that ignores the page's state, which trame passes to it, and calls ``call``."""
    return lambda **_: call(*args)
