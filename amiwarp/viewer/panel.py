"""Page of the inspector: passes input from the browser to the inspector, and results back; the page in a browser."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import secrets
import tempfile
import traceback
import weakref
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from amiwarp.choices import Axis, Colour, View, Vote
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.export import save_values
from amiwarp.imaging.iwe import iwe
from amiwarp.io.event_rates import EventRates
from amiwarp.live.stream.session import LiveSource
from amiwarp.plotting.colours import Scale, count_scale
from amiwarp.tasks import Progress
from amiwarp.viewer import drawing, jobs, layout
from amiwarp.viewer.bookmarks import Bookmarks
from amiwarp.viewer.drawing import ImageKind, Look
from amiwarp.viewer.filters import Selection, step_rows
from amiwarp.viewer.inspector import WINDOW_POINTS, DisplayedWindow, Inspector, Knobs, Library
from amiwarp.viewer.jobs import JobCancelled, JobProgress
from amiwarp.viewer.serve import finite, serve, use_page

STEP_S = 0.2
"""Duration of counting events after which the timeline shows what is counted [s]."""
MOST_IN_FLIGHT = 8
"""Largest number of messages to the page that are unsent; while more are waiting, nothing is computed."""
WAIT_S = 0.02
"""Interval between two checks of the number of unsent messages [s]."""
_CUDA_LOCK = asyncio.Lock()
"""Lock for all tabs: Warp's CUDA calls may run in only one thread at a time."""
QUICK = {
    **dict.fromkeys(("newest", "window", "suggestion", "state", "knobs"), ("clouds", "images")),
    "look": ("clouds",),
}
SLOW = ("curve", "picture", "statistics")
"""Updates that are made at once, with the parts of the page that wait for them, and updates that take longer."""
PLAY_S, FOLLOW_S, RATES_S = 0.05, 0.1, 1.0
"""Shortest interval between two pictures while a recording is played, and while a live stream is followed, and between
two counts of a live stream's events for the timeline [s]."""


class Panel(layout.Actions):
    """Panel that connects the page of one browser tab with its inspector. Call :meth:`close` when the tab is closed.

    The page may call the methods in :data:`amiwarp.viewer.layout.CALLS`. The server checks their arguments by their
    annotations. Updates are computed in threads, one after the other. If a slider moves several times meanwhile, only
    its last position is used. What waits for an update is marked on the page. Nothing is computed while the page does
    not keep up with the messages.
    """

    def __init__(self, server: Any, inspector: Inspector, library: Library | None = None) -> None:
        """Build the page on a new trame server. ``library``: other recordings that the page may open."""
        self.server, self.state, self.inspector, self._library = server, server.state, inspector, library
        self.buffers_lock = asyncio.Lock()
        """Lock of the inspector's buffers on the device, which only one thread may use at a time."""
        self.device_lock: Any = _CUDA_LOCK if "cuda" in str(inspector.device) else contextlib.nullcontext()
        self._quick_requests: set[str] = set()
        self._slow_requests: set[str] = set()
        self._doing: set[str] = set()
        self._quick: asyncio.Task[None] | None = None
        self._slow: asyncio.Task[None] | None = None
        self._jobs: set[asyncio.Task[None]] = set()
        self._error_source = ""
        # A tab's own pool, which ends with the tab: calibration or film; curve or picture; quick updates.
        self._threads = ThreadPoolExecutor(3, "amiwarp-tab")
        self.shown: DisplayedWindow | None = None
        """Window as the page shows it; None before the first update."""
        self.plays = False
        """Whether the playback runs; after a stop it runs until it notices the stop."""
        self._picked, self._card = -1, False
        self._held = False
        """Whether a change lasts, such as a drag: meanwhile the brightness of images does not follow it."""
        self._scales: tuple[Scale, Scale] | None = None
        self._scales_of: ImageKind | None = None
        self._surface_about: Knobs | None = None  # parameters in the middle of the map of sharpness
        self._made_for: dict[str, Any] = {}  # window and selection of which the slow parts of the page are, by name
        self._change, self._drags = "", 0  # successive changes of one name are undone together, until a release
        self._rates: list[EventRates] = []  # of the recording, and of those on its time axis
        self._rates_first_us = 0
        self._progress = JobProgress(self._show_progress)  # of the latest calibration or film
        self._folder = tempfile.TemporaryDirectory(prefix="amiwarp-", ignore_cleanup_errors=True)
        use_page(server, self._folder.name)
        self.state.client_only(*layout.CLIENT_ONLY)
        self._listen()
        self.start(inspector)

    def start(self, inspector: Inspector) -> None:
        """Show an inspector from its first state."""
        self.inspector, self.shown, self.b, self.found, self._picked = inspector, None, None, None, -1
        self.history, self.steps = None, ()
        self._made_for.clear()
        self.use_card(self._card)
        inspector.renew()  # a live stream may have gone on since the inspector was made
        files = [] if self._library is None else self._library.files()
        folder = "" if self._library is None else str(self._library.folder)
        self.state.update({**layout.initial_state(inspector), "files": files, "folder": folder})
        self._wanted: dict[str, Any] = {}  # values that were set on the page, and that the inspector has not taken yet
        self.time_window = inspector.window or inspector.first_window()
        self.start_job(self._count_events())
        self.request("window", *(["suggestion"] if self.compensates else []))
        self.released()
        self.request_slow("preparation")
        if inspector.latest is not None:
            self.play()
        if isinstance(inspector.latest, LiveSource):
            self.start_job(self._watch(inspector.latest))
        self.bookmarks = None if inspector.path is None else Bookmarks(inspector.path)
        self._list_views()
        if inspector.bookmark:
            self.open_view(inspector.bookmark)

    def close(self) -> None:
        """Stop all work of the browser tab, and remove its downloads. A thread ends when its current work is done."""
        self._folder.cleanup()
        self.cancel()
        self.inspector.close()
        for task in self._jobs:
            task.cancel()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def cancel(self) -> None:
        """Stop the calibration or the film that is being made."""
        self._progress.cancelled = True

    def end_film(self) -> None:
        """End the film that is being made with the pictures made so far."""
        self._progress.ended = True

    @property
    def look(self) -> Look:
        """Style of the clouds."""
        s = self.state
        return Look(Colour(s.colour), Axis(s.axis), s.point_size, s.opacity, s.dark, s.overlaid)

    @look.setter
    def look(self, look: Look) -> None:
        self.state.update({"colour": look.colour.value, "axis": look.axis.value, "overlaid": look.overlaid})

    @property
    def view(self) -> View:
        """Direction from which the clouds are seen. Setting it resets a camera that the mouse has moved."""
        return View(self.state.view[0])

    @view.setter
    def view(self, view: View) -> None:
        self.state.view = [view.value, self.state.view[1] + 1]

    @property
    def image(self) -> ImageKind:
        """What the images show."""
        return ImageKind(self.state.kind)

    @property
    def decay_us(self) -> int:
        """Decay time of a decaying time surface [us]."""
        return max(1, round(1e3 * float(self.state.decay_ms)))

    @property
    def same_scale(self) -> bool:
        """Whether images of two recordings have one scale."""
        return bool(self.state.same_scale)

    @property
    def difference(self) -> bool:
        """Whether the second image shows the difference of the two images."""
        return bool(self.state.difference)

    @property
    def time_window(self) -> tuple[int, int]:
        """Start and length of the time window that the page shows, on the events' clock [us]."""
        return self._clock_us(float(self.state.start_ms)), max(1, round(float(self.state.length_ms) * 1e3))

    @time_window.setter
    def time_window(self, window: tuple[int, int]) -> None:
        start_us, length_us = window[0] - self.inspector.recording.events.t_first, window[1]
        self.state.update({"start_ms": round(start_us * 1e-3, 3), "length_ms": round(length_us * 1e-3, 3)})

    def request(self, *what: str, change: str = "") -> None:
        """Request quick updates: "newest" (of a live stream), "window", "knobs", "look", "suggestion" or "state".

        ``change``: name of a change that lasts, such as a drag; it is undone in one step.
        """
        self._change = f"{change} {self._drags}" if change else ""
        self._held = bool(change)
        self._quick_requests.update(what)
        self._show_pending()
        if self._quick is None or self._quick.done():
            self._quick = self.start_job(self._update())

    def request_slow(self, *what: str) -> None:
        """Request updates that run in a thread after all quick updates: "curve", "picture" or "preparation"."""
        self._slow_requests.update(what)
        self._show_pending()
        if self._slow is None or self._slow.done():
            self._slow = self.start_job(self._update_slowly())

    async def until_drawn(self) -> None:
        """Wait until no quick update is pending."""
        while self._quick is not None and not self._quick.done():
            await asyncio.wait([self._quick])

    def start_job(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run a job until it ends or the browser tab is closed."""
        self._jobs.add(task := asyncio.get_running_loop().create_task(work))
        task.add_done_callback(self._ended)
        return task

    async def in_thread(self, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Call ``work`` in one of the browser tab's threads, and return its result."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, partial(work, *args, **options))

    def say(self, text: str, severity: str = "info") -> None:
        """Show a message."""
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

    def _show_pending(self) -> None:
        """Show which parts of the page wait for an update."""
        quick = self._quick_requests | self._doing
        parts = {part for what in quick for part in QUICK.get(what, ())} | (self._slow_requests | self._doing) & {*SLOW}
        self.state.updating = sorted(parts)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._jobs.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            logging.getLogger(__name__).error("the page's work failed", exc_info=error)
            text = f"internal error: {error or type(error).__name__}; the log of the server shows the details"
            self.say(text, "error")

    async def _update(self) -> None:
        while self._quick_requests:
            while (page := self.server.protocol) is not None and page.network_monitor.pending > MOST_IN_FLIGHT:
                await asyncio.sleep(WAIT_S)
            todo, self._quick_requests = self._quick_requests, set()
            async with self._done(todo), self.device_lock, self.buffers_lock:
                await self.make(todo)
            await asyncio.sleep(0)

    async def _update_slowly(self) -> None:
        while self._slow_requests:
            await self.until_drawn()
            name = min(self._slow_requests)  # in alphabetical order: the curve first, the preparation last
            self._slow_requests.discard(name)
            async with self._done({name}), self.device_lock:
                with self.errors_shown(name):
                    await self.make_slow(name)

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

    def _listen(self) -> None:
        """Follow the state variables that the page sets, and offer the methods that it calls."""

        def follow(names: tuple[str, ...], call: Callable[..., None], *given: str) -> None:
            self.state.change(*names)(lambda **_: call(*given))  # trame gives the whole state

        follow(("polarity", "hide_hot", "noise_filter"), self.request, "window")
        follow(("colour", "axis", "dark", "orbit_shown"), self.request, "look")
        follow(("model",), lambda: self._wanted.update(model=self.state.model))
        follow(("model", "against", "kind", "difference", "same_scale"), self.request, "knobs")
        follow(("model", "kind", "polarity", "hide_hot", "noise_filter"), self.released)
        for name in layout.CALLS:
            self.server.trigger(name)(getattr(self, name))

    # Buttons, keys, fields and the mouse

    def released(self) -> None:
        """Update the slow parts of the page after a change, and end what is undone in one step."""
        if self._held:  # the images get the scale of what is shown now, as part of the same change
            change = self._change
            self.request("knobs")
            self._change = change
        self._drags += 1
        self.request_slow(*SLOW)

    def choose(self, name: str) -> None:
        """Select the parameter over which the sharpness curve is drawn."""
        if name in layout.SLIDERS and name != self.state.knob:
            self.state.knob = name
            self.request_slow("curve")

    def typed(self, name: str, text: str) -> None:
        """Set the value that a user typed into a number field."""
        if name not in (*layout.FIELD_LIMITS, *layout.FILTER_FIELDS, "start_ms", "length_ms", "turns", "events"):
            return
        try:
            value = finite(text)
        except ValueError:
            self.say(f"{text!r} is not a number; give a number such as 1.5", "error")
            return
        if name in layout.FIELD_LIMITS:
            self.slide(name, value)
        elif name in layout.FILTER_FIELDS:
            self._set_filter(name, value)
        elif name == "events":
            self.state.fixed_count = min(max(1, round(value)), layout.MOST_COUNT)
            self.request("window")
        else:
            length = name == "turns"
            self.state["length_ms" if length else name] = round(value * float(self.state.turn_ms if length else 1.0), 4)
            self.state.fixed_count = self.state.fixed_count if name == "start_ms" else 0
            self.request("window")
        self.released()

    def _set_filter(self, name: str, value: float) -> None:
        """Set a field of a filter, or the decay time of images."""
        label, unit, (low, high) = layout.FILTER_FIELDS[name]
        if not low <= value <= high:
            self.say(f"{label}: {value:g} {unit} is refused; give {low:g} to {high:g} {unit}", "error")
            return
        self.state[name] = round(value) if name == "every" else value
        self.request("knobs" if name == "decay_ms" else "window")

    def step(self, count: int) -> None:
        """Move the time window by turns or by its length; set by number, by as many events, found in a thread."""
        if self.inspector.fixed_count is None:
            super().step(count)
        else:
            self.start_job(self._step_events(count))

    async def _step_events(self, count: int) -> None:
        with self.errors_shown("window"):
            self.move(await self.in_thread(self.inspector.start_after, count))
            self.released()

    def list_hot(self) -> None:
        """List the hot pixels of the recording."""
        self.start_job(self._list_hot())

    async def _list_hot(self) -> None:
        with self.errors_shown("hot pixels"):
            found = await self.in_thread(lambda: self.inspector.hot_pixels)
            rows = [[each.x, each.y, f"{each.rate:,.0f}", f"{100.0 * each.share:.3g}"] for each in found]
            with self.state:
                self.state.hot_rows = rows

    def slide(self, name: str, value: float) -> None:
        """Set a parameter of the prism or the camera, in the unit of its slider or field."""
        if name not in layout.FIELD_LIMITS:
            return
        (low, high), (label, unit, *_) = layout.FIELD_LIMITS[name], {**layout.SLIDERS, **layout.GIVEN}[name]
        if not low <= value <= high:
            self.say(f"{label}: {value:g} {unit} is refused; give {low:g} to {high:g} {unit}", "error")
            return
        self._wanted[name] = round(value, 4)
        if name in layout.SLIDERS:
            self.state.knob = name
        self.show_knobs()
        self.request("knobs", change=name)

    def use_card(self, found: bool) -> None:
        """Show more points if the browser has a graphics card to draw them."""
        self._card = found
        if found and self.inspector.most_points < WINDOW_POINTS:
            self.inspector.most_points = WINDOW_POINTS
            self.request("window")

    def answer(self) -> None:
        """Do nothing: the page asks only whether the server answers."""

    def toggle(self, name: str) -> None:
        """Invert a state variable that is true or false."""
        self.state[name] = not self.state[name]

    def look_from(self, view: str) -> None:
        """Set the view, and reset a camera that the mouse has moved."""
        if view in list(View):
            self.view = View(view)

    def pick(self, k: int) -> None:
        """Describe a drawn event, and show its orbit; -1 for none."""
        known = self.shown is not None and 0 <= k < len(self.shown.events)
        self._picked = int(k) if known else -1
        self.request("look")

    def open_file(self, name: str) -> None:
        """Show another recording of the folder."""
        self.state.open_shown = False
        self.start_job(self._open_file(name))

    async def _open_file(self, name: str) -> None:
        if self._library is None:
            return
        if self.state.calibrating:
            self.cancel()
        self.state.playing = False
        with self.errors_shown("file"):
            inspector = await self.in_thread(self._library.open, name)
            await self.until_drawn()
            self.start(inspector)
        self.state.flush()

    # Bookmarks

    def save_view(self, name: str) -> None:
        """Save what is shown as a bookmark."""
        super().save_view(name)
        self._list_views()

    def delete_view(self, name: str) -> None:
        """Delete a bookmark."""
        if self.bookmarks is not None:
            with self.errors_shown("bookmark"):
                self.bookmarks.delete(name)
            self._list_views()

    def _list_views(self) -> None:
        """Show the names of the bookmarks."""
        names: list[str] = []
        if self.bookmarks is not None:
            with self.errors_shown("bookmarks"):
                names = self.bookmarks.names()
        self.state.update({
            "views": names, "views_file": "" if self.bookmarks is None else self.bookmarks.path.name,
        })  # fmt: skip

    def choose_beside(self, k: int) -> None:
        """Show the recording with the number ``k`` of those that are on the same time axis."""
        super().choose_beside(k)
        if self.inspector.beside is not None:
            self.state.beside_chosen = self.inspector.besides.index(self.inspector.beside)

    # Region of the image

    def draw(self, left: float, top: float, right: float, bottom: float) -> None:
        """Show a region of the image [px] that was drawn or typed."""
        sides, limits = (left, top, right, bottom), 2 * self.state.size
        region = [min(max(round(each), 0), limit) for each, limit in zip(sides, limits, strict=True)]
        whole = region == [0, 0, *self.state.size]
        self.state.update({"region_wanted": region, "region_kind": "whole" if whole else "drawn"})
        self.request("window")
        self.released()

    def whole(self) -> None:
        """Show the whole image."""
        self.draw(0, 0, *self.state.size)

    # Time: window, timeline and playback. The page counts all times from the recording's first event.

    def move_window(self, start_ms: float) -> None:
        """Move the time window to a start [ms]; playing stops, except a live stream's."""
        if not self.state.live:
            self.state.playing = False
        self.move(self._clock_us(float(start_ms)), change="start_ms")

    def resize_window(self, start_ms: float, end_ms: float) -> None:
        """Set the ends of the time window [ms]."""
        start, end = max(0.0, float(start_ms)), min(float(end_ms), float(self.state.whole_ms))
        if end > start:
            self.state.fixed_count = 0
            self.time_window = self._clock_us(start), max(1, round(1e3 * (end - start)))
            self.request("window", change="length_ms")

    def zoom_timeline(self, start_ms: float, end_ms: float) -> None:
        """Show another part of the time on the timeline [ms]."""
        start, end = max(0.0, float(start_ms)), min(float(end_ms), float(self.state.whole_ms))
        if end - start > 1e-2:
            self.state.rate_span = [start, end]
            self._show_rates()

    def play(self) -> None:
        """Play the recording from the current window, or follow a live stream; stop if already playing."""
        state = self.state
        state.playing = not state.playing and (self.plays or self.can_play())
        if state.playing and not self.plays:
            self.plays = True
            work = self._run() if self.inspector.latest is None else self._follow()
            self.start_job(work).add_done_callback(lambda _: setattr(self, "plays", False))

    async def _run(self) -> None:
        state, loop, elapsed_s = self.state, asyncio.get_running_loop(), PLAY_S
        while state.playing:
            start_s = loop.time()
            with state:
                state.playing = self.advance(1e6 * elapsed_s * float(state.speed), loop=bool(state.loop))
            await self.until_drawn()
            await asyncio.sleep(max(0.0, PLAY_S - (loop.time() - start_s)))
            elapsed_s = loop.time() - start_s
        self.released()

    async def _follow(self) -> None:
        """Show the current events of a live stream, again and again."""
        await self.until_drawn()  # with the suggested region
        loop, counted_s = asyncio.get_running_loop(), -math.inf
        while self.state.playing:
            start_s = loop.time()
            if start_s >= counted_s + RATES_S:
                counted_s = start_s
                self.start_job(self._count_events())
            self.request("newest")
            await self.until_drawn()
            await asyncio.sleep(max(0.01, FOLLOW_S - (loop.time() - start_s)))
        self.released()

    def record(self) -> None:
        """Save a live stream from now on to a new file in the current folder of the server, or finish the file."""
        if isinstance(self.inspector.latest, LiveSource):
            self.start_job(self._record(self.inspector.latest))

    async def _record(self, source: LiveSource) -> None:
        with self.errors_shown("recording"):
            if source.is_recording:
                self.say(f"saved {await self.in_thread(source.stop_recording)}", "success")
            else:
                path = jobs.unused_path(f"{jobs.file_stem(self.inspector.recording.name)}.h5")
                await self.in_thread(source.record, path.resolve())
                self.say(f"recording to {path.resolve()} until you press stop, or the stream or the command ends")
        self.state.flush()

    async def _watch(self, source: LiveSource) -> None:
        """Show the figures of a live stream, also while it is not followed, until the page is closed."""
        while True:
            with self.state as state:
                state.live_rows, state.stream_note = source.figures()
                state.recording = source.is_recording
            await asyncio.sleep(FOLLOW_S)

    def _clock_us(self, time_ms: float) -> int:
        return int(self.inspector.recording.events.t_first) + round(time_ms * 1e3)

    async def _count_events(self) -> None:
        """Count the recording's events in the background, for the timeline."""
        inspectors = (self.inspector, *self.inspector.besides)
        rates = self._rates = [EventRates(each.recording.events) for each in inspectors]
        self._rates_first_us = self.inspector.recording.events.t_first
        for each in rates:
            finished = False
            while not finished and rates is self._rates:
                finished = await self.in_thread(each.fill, STEP_S)
                with self.state:
                    self._show_rates()

    def _show_rates(self) -> None:
        # Of a live stream, the counted events may be a second older than the shown ones.
        first_us = self._rates_first_us
        start_us, end_us = (round(1e3 * each) for each in self.state.rate_span)
        own, *others = self._rates
        _, rates = own.curve(first_us + start_us, first_us + end_us, layout.BINS)
        off, on, share = *map(drawing.float_bytes, rates), own.share
        rows = []
        for each, counted in zip(self.inspector.besides, others, strict=True):
            _, rates = counted.curve(each.time_of(start_us), each.time_of(end_us), layout.BINS)
            rows.append({"name": drawing.beside_text(each), "on": drawing.float_bytes(rates[1]),
                         "off": drawing.float_bytes(rates[0])})  # fmt: skip
        note = "" if share >= 1.0 else f"counting events: {100.0 * share:.0f} %"
        self.state.update({"rate_on": on, "rate_off": off, "rate_note": note, "rate_rows": rows})

    # Parameters of the prism, and those to compare with

    def swap_b(self) -> None:
        """Exchange the current parameters and B."""
        if self.b is not None:
            now = self.inspector.knobs
            with self.errors_shown("knobs"):
                self.inspector.set(self.b)
                self.show_b(now)
            self.knobs_taken()

    def keep_b(self) -> None:
        """Keep the current parameters as B, and show them on the left."""
        self.show_b(self.inspector.knobs)

    def show_b(self, knobs: Knobs | None) -> None:
        """Show parameters on the left as B; None for the recorded events."""
        self.b = knobs
        orbit = "" if knobs is None else layout.orbit_text(knobs.model, knobs.value, knobs.phase)
        text, against = ("", "recorded") if knobs is None else (f"{knobs.model}, {orbit}", "B")
        self.state.update({"has_b": knobs is not None, "b_text": text, "against": against})
        self.request("knobs")

    def set_knobs(self) -> None:
        """Give the inspector the values that were set on the page."""
        inspector, wanted, self._wanted = self.inspector, self._wanted, {}
        layout.set_given(inspector, wanted.pop("fov_deg", None), wanted.pop("prism_index", None))
        model = wanted.pop("model", inspector.knobs.model)
        values = {name: value * layout.UNITS[name] for name, value in wanted.items()}
        inspector.set(replace(inspector.knobs.with_values(values), model=model))

    def show_knobs(self) -> None:
        """Show the inspector's parameters on the page, or the values that it has not taken yet."""
        state = layout.knob_state(self.inspector)
        for field in (*state["knobs"], *state["given"]):
            field["value"] = self._wanted.get(field["name"], field["value"])
        self.state.update({**state, "model": self._wanted.get("model", state["model"])})

    def knobs_taken(self) -> None:
        """Show parameters that the inspector has taken from elsewhere."""
        self.show_knobs()
        super().knobs_taken()

    @property
    def against(self) -> Knobs | None:
        """Parameters that the left cloud and image show; None for the recorded events."""
        return self._comparable().get(self.state.against)

    def _comparable(self) -> dict[str, Knobs | None]:
        """Return what the left cloud can show now, by the names in :data:`amiwarp.viewer.drawing.AGAINST`."""
        found = None if self.found is None else self.inspector.knobs_of(self.found)
        known = {"B": self.b, "found": found, "truth": self.inspector.truth}
        return {"recorded": None, **{name: knobs for name, knobs in known.items() if knobs is not None}}

    def _against_choices(self) -> list[list[str]]:
        """Return names and titles of what the left cloud can show now."""
        return [[name, drawing.against_title(self.inspector, name)] for name in self._comparable()]

    # Calibration

    def calibrate(self) -> None:
        """Start a calibration, or cancel the running one."""
        if not self.state.busy:
            self.found = None
            self.state.update({"busy": "calibrating", "calibrating": True, "progress": 0, "found": "", "surface": None})
            self._progress = JobProgress(self._show_progress)
            self.start_job(self._calibrate(self._progress))
        elif self.state.calibrating:
            self.cancel()
            self.state.busy = "calibrating: cancelling"

    async def _calibrate(self, progress: JobProgress) -> None:
        """Calibrate in a thread, and show the result with a map of sharpness about it."""
        inspector, state = self.inspector, self.state
        try:
            find = partial(jobs.find_calibration, whole=state.scope != layout.SCOPES[0])
            async with self.device_lock:
                found = await self.in_thread(_guarded, find, weakref.ref(inspector), progress)
            if isinstance(found, str):
                text, severity = ("calibration cancelled", "info") if progress.cancelled else (found, "error")
                self.say(text, severity)
                return
            self.found, text = found
            with state:
                state.update({"found": text, "against_choices": self._against_choices()})
            async with self.device_lock:
                draw = partial(jobs.cost_surface, found=self.found)
                self._surface_about = inspector.knobs
                surface = await self.in_thread(_guarded, draw, weakref.ref(inspector), progress)
            if not isinstance(surface, str) and self.inspector is inspector:
                with state:
                    state.surface = surface
        finally:
            with state:
                state.update({"busy": "", "calibrating": False})

    def _show_progress(self, what: str, share: float) -> None:
        """Show the current step of a calibration or a film, and the finished share, 0 to 1."""
        with self.state:
            self.state.update({"busy": what, "progress": round(100 * min(share, 1.0))})

    def discard(self) -> None:
        """Forget the result of the calibration."""
        super().discard()
        self.state.update({"found": "", "surface": None})
        if self.state.against == "found":
            self.show_b(self.b)

    # Downloads

    def export(self, what: str) -> None:
        """Give the browser a file; ``what`` is a name in :data:`amiwarp.viewer.layout.EXPORTS`."""
        s = self.state
        if what in ("picture", "image") and self.shown is not None:
            words = drawing.caption(self.inspector, self.shown).split("; ")
            self.server.js_call("page", what, jobs.download_name(self.inspector.recording.name, what), words)
        elif what in layout.EXPORTS and what not in ("picture", "image") and not (what in layout.FILMS and s.busy):
            self.start_job(self._film(what) if what in layout.FILMS else self._write(what))

    async def _write(self, what: str) -> None:
        from amiwarp.viewer.publish import Page, save_figure

        inspector = self.inspector
        figure = partial(save_figure, inspector, page=Page(), view=self.view, look=self.look, against=self.against)
        write: dict[str, Callable[[Path], object]] = {
            **dict.fromkeys(("pdf", "svg"), figure),
            "values": lambda path: save_values(path, self._pair().after),
            **dict.fromkeys(("csv", "npz"), partial(jobs.write_table, inspector)),
            "events": partial(jobs.write_events, inspector, compensated=False),
            "compensated": partial(jobs.write_events, inspector, compensated=True),
            "calibration": lambda path: inspector.as_calibration().save(path),
            "vtp": partial(jobs.write_cloud, inspector, axis=self.look.axis, compensated=False),
            "vtp_after": partial(jobs.write_cloud, inspector, axis=self.look.axis, compensated=True),
        }  # fmt: skip
        async with self.device_lock, self.buffers_lock:
            await self._download(what, write[what])

    async def _film(self, what: str) -> None:
        s = self.state
        look = self.look.for_clouds([title for _, title in s.titles])
        self._progress = progress = JobProgress(self._show_progress)
        film = partial(
            jobs.write_film, inspector=self.inspector.copy(), look=look, view=self.view, progress=progress, what=what,
            against=self.against, with_orbit=bool(s.orbit_shown), speed=float(s.speed),
            ended=lambda: progress.ended,
        )  # fmt: skip
        self._show_progress(f"making the {layout.EXPORTS[what][0]}", 0.0)
        try:
            with contextlib.suppress(JobCancelled):
                async with self.device_lock:
                    await self._download(what, film)
        finally:
            with s:
                s.busy = ""

    async def _download(self, what: str, write: Callable[[Path], object]) -> None:
        """Write a file in a thread, and give it to the browser."""
        name = jobs.download_name(self.inspector.recording.name, what)
        with self.errors_shown("export"):
            path = Path(self._folder.name) / name
            path.unlink(missing_ok=True)
            await self.in_thread(write, path)
            about = path.stat()  # with its time, as a browser keeps what it has loaded from an address
            self.server.js_call("page", "download", name, f"{self.server.name}/{name}?{about.st_mtime_ns}")
            self.say(f"{name}: {about.st_size / 1e3:,.0f} kB, in the browser's downloads", "success")
        self.state.flush()

    # Undo, redo, reset, and the state in the page's address

    def restore(self, address: str) -> None:
        """Show the state that an address describes."""

        def described(history: layout.History) -> layout.ViewState:
            size = self.inspector.recording.events.size
            state, wrong = layout.decode_state(address, history.first, size=size, duration_us=self.whole_us)
            if wrong:
                self.say("; ".join(wrong), "error")
            return state

        self.travel(described)

    def remember(self, change: str) -> layout.History:
        """Add what the page shows now to the history, and to its address."""
        h = super().remember(change)
        address = layout.encode_state(h.state, h.first)
        self.state.update({"can_undo": h.can_undo, "can_redo": h.can_redo, "address": address})
        return h

    async def _apply_steps(self) -> None:
        """Show the requested state. Raises :class:`AmiwarpError` if it selects no events."""
        wanted = self.travelled()
        if wanted is None:
            return
        await self.in_thread(layout.apply_state, self.inspector, wanted)
        s, selection = self.state, wanted.selection
        region = list(selection.region or (0, 0, *s.size))
        kind = s.region_kind if region == s.region_wanted else "whole" if selection.region is None else "drawn"
        self.time_window = self.inspector.window or self.time_window
        s.update({
            **layout.filter_state(selection), "region_wanted": region, "region_kind": kind, "kind": wanted.image.value,
            "fixed_count": wanted.fixed_count or 0, "decay_ms": wanted.decay_us * 1e-3, "same_scale": wanted.same_scale,
            "difference": wanted.difference,
        })  # fmt: skip
        self.look = replace(self.look, colour=wanted.colour, axis=wanted.axis, overlaid=wanted.overlaid)
        if wanted.view is not self.view:
            self.view = wanted.view
        if wanted.against != self.against:
            self.show_b(wanted.against)

    # Updates of what the page shows

    async def make(self, todo: set[str]) -> None:
        """Make quick updates: "newest", "suggestion", "window", "knobs", "look" and "state"."""
        state = self.state
        if "newest" in todo:  # here, because no other update uses the events that it replaces
            with self.errors_shown("stream"):
                await self.in_thread(self.inspector.renew)
                state.update(layout.source_state(self.inspector))
                self.time_window = self.newest_window()
            todo = {*todo, "window"}
        if self.shown is not None and "state" in todo and len(todo) > 1:  # what came before an undo can be redone
            await self.make(todo - {"state"})
            todo = {"state"}
        if todo & {"window", "suggestion"}:
            with self.errors_shown("window"):
                try:
                    await self._open(suggest="suggestion" in todo)
                except AmiwarpError:  # show again what is still open; playback goes on through a time without events
                    if self.inspector.window is not None and not state.playing:
                        self.time_window = self.inspector.window
                        state.region_wanted = list(self.inspector.loaded.region)
                        state.update(layout.filter_state(self.inspector.selection))
                    raise
        with self.errors_shown("knobs"):
            good = self.inspector.knobs, dict(self.inspector.sources)
            try:
                if "knobs" in todo:
                    self.set_knobs()
                if self.shown is None:
                    self.remember("")
                if "state" in todo:
                    await self._apply_steps()
                self.show_knobs()
                self.shown, values = await self.in_thread(self._compute)
            except AmiwarpError:
                self.inspector.knobs, self.inspector.sources = good
                self.show_knobs()
                raise
            if self.compensates != bool(state.turn_ms):  # the speed of a prism was set, or set to 0
                state.axis = (Axis.ANGLE if self.compensates else Axis.TIME).value
                self.request("look")
            mark = layout.knob_values(self.inspector)[state.knob]
            self._show_old()
            if state.surface:  # the parameters may have moved on its map
                marks = jobs.surface_marks(
                    self.inspector, state.surface["names"], self._surface_about or self.inspector.knobs, self.found
                )
                state.surface = {**state.surface, "marks": marks}
            state.optic = bool(state.optic or self.inspector.has_optic)  # a live stream may have got its encoder
            state.update({**values, "turn_ms": layout.turn_ms(self.inspector), "curve_mark": mark})
            if not state.playing:
                self.remember("" if todo & {"suggestion", "state"} else self._change)
            self.announce()

    def _show_old(self) -> None:
        """Show which slow parts of the page are still of another window or selection."""
        chosen = self.inspector.chosen
        self.state.old = sorted(name for name, made_for in self._made_for.items() if made_for != chosen)

    async def make_slow(self, name: str) -> None:
        """Make a slow update: "curve", "picture", "statistics", or "preparation" of the first picture."""
        inspector = self.inspector.snapshot()  # of which a live stream changes nothing
        chosen = inspector.chosen
        await self._make_slow(name, inspector)
        if name != "preparation":
            self._made_for[name] = chosen
            self._show_old()

    async def _make_slow(self, name: str, inspector: Inspector) -> None:
        if name == "preparation":
            await self.in_thread(drawing.prepare, inspector)
        elif name == "statistics":
            self.state.statistics = await self.in_thread(inspector.statistics)
        elif name == "curve":
            await self._curve(inspector)
        elif self.image is ImageKind.LOG_INTENSITY and self.shown is not None:
            self.state.update(await self.in_thread(self._images, self.shown, inspector))

    async def _open(self, *, suggest: bool) -> None:
        """Read the window and the selection that the page shows."""
        s, inspector, in_thread = self.state, self.inspector, self.in_thread
        if not float(s.length_ms) > 0.0:
            raise AmiwarpError(f"a window of {s.length_ms:g} ms; give a length above 0")
        start_us, length_us = self.time_window
        length_us, known_count = min(length_us, self.whole_us), inspector.fixed_count
        inspector.fixed_count = int(s.fixed_count) or None
        try:
            await in_thread(inspector.open, start_us, length_us, self._selection())
        except AmiwarpError:
            inspector.fixed_count = known_count
            s.fixed_count = known_count or 0
            raise
        if inspector.fixed_count is not None and inspector.window is not None:
            self.time_window = start_us, length_us = inspector.window
        if suggest:
            await in_thread(jobs.estimate_phase, inspector)
            region = await in_thread(inspector.suggest_region)
            s.update({"region_wanted": list(region), "region_kind": "suggested"})
            await in_thread(inspector.open, start_us, length_us, self._selection())
        self._picked = -1

    def _selection(self) -> Selection:
        """Return the conditions for events that the page shows."""
        s = self.state
        region, whole = tuple(s.region_wanted), (0, 0, *s.size)
        return Selection(
            polarity={"both": None, "ON": 1, "OFF": 0}[s.polarity],
            region=None if region == whole else region,
            hide_hot=bool(s.hide_hot),
            noise_us=round(1e3 * float(s.noise_ms)) if s.noise_filter else None,
            refractory_us=round(1e3 * float(s.refractory_ms)),
            most_per_s=1e6 * float(s.most_mev_s),
            every=int(s.every),
        )

    def _compute(self) -> tuple[DisplayedWindow, dict[str, Any]]:
        """Return what is to be shown, and the state variables that show it."""
        s, before, against = self.state, self.shown, self.against
        shown = self.inspector.show(against=against)
        values = drawing.cloud_state(shown, Colour(s.colour), Axis(s.axis), dark=bool(s.dark))
        values["image_slow"] = self.image is ImageKind.LOG_INTENSITY
        if not values["image_slow"]:
            values |= self._images(shown)
        found = drawing.shown_lines(self.inspector, shown, self.look.axis, against, self._picked)
        lines = found if found and s.orbit_shown else (np.zeros(0),) * 2
        values["orbit"], values["column"] = map(drawing.float_bytes, lines)
        if before is None or shown.span is not before.span:
            counts = iwe(shown.span.events, *self.inspector.recording.events.size, vote=Vote.NEAREST)
            values["overview"] = drawing.picture_state(counts, count_scale([counts]))
            values["beside_counts"] = self.inspector.counts_beside(shown.span)
        left = "recorded" if against is None else s.against
        titles = drawing.cloud_titles(self.inspector, left, Axis(s.axis))
        return shown, {
            **values, "titles": [list(each) for each in enumerate(titles)], "events": drawing.chosen_text(shown),
            "steps": step_rows(shown.steps, shown.read_us), "beside_rows": drawing.beside_rows(self.inspector, shown),
            "drawn": drawing.drawn_text(shown), "count": shown.span.count,
            "sharpness": drawing.sharpness_text(shown, compensated=self.compensates), "picked": self._picked,
            "picked_text": "" if self._picked < 0 else drawing.event_text(
                shown, self._picked, compensated=self.compensates
            ),
            "after_title": self._after_title(shown),
            "against_title": drawing.against_title(self.inspector, left), "against_choices": self._against_choices(),
        }  # fmt: skip

    def _after_title(self, shown: DisplayedWindow) -> str:
        """Return the title of the second image."""
        name = self.inspector.recording.name
        if self.image is ImageKind.DEPTH:
            return "depth map"
        if not self.compensates:
            return "region" if shown.beside is None else f"{name}, as recorded"
        if shown.beside is not None:
            return f"{name}, compensated"
        return "difference" if self.state.difference and self.image is ImageKind.COUNT else "compensated"

    def _images(self, shown: DisplayedWindow, inspector: Inspector | None = None) -> dict[str, Any]:
        """Return the state variables of the images of the region, or why there are none."""
        try:
            pair = self._pair(shown, inspector)
        except AmiwarpError as error:
            return {"before": None, "after": None, "image_note": str(error)}
        scales = pair.scale, pair.after_scale or pair.scale
        self._scales, self._scales_of = scales, self.image
        before, after = (
            None if image is None else drawing.picture_state(image, scale)
            for image, scale in zip((pair.before, pair.after), scales, strict=True)
        )
        first, second = map(drawing.scale_state, scales)
        return {"before": before, "after": after, "image_scale": first, "after_scale": second, "image_note": pair.note}

    def _pair(self, shown: DisplayedWindow | None = None, inspector: Inspector | None = None) -> drawing.ShownImages:
        return drawing.make_images(
            inspector or self.inspector,
            self.image,
            against=self.against,
            shown=shown,
            difference=self.difference,
            decay_us=self.decay_us,
            same_scale=self.same_scale,
            kept=self._scales if self._held and self._scales_of == self.image else None,
        )

    async def _curve(self, inspector: Inspector) -> None:
        s, name = self.state, self.state.knob
        find = partial(jobs.calibrated_events, inspector)
        s.calibrate_on = [(await self.in_thread(find, whole=whole))[1] for whole in (False, True)]
        if not self.compensates:
            return
        values, scores = await self.in_thread(inspector.curve, name)
        x: list[float] = (values / layout.UNITS[name]).tolist()
        if not x:
            return
        label, unit, *_ = layout.SLIDERS[name]
        best = int(np.argmax(scores))
        peak = f"{'at the edge ' if best in (0, len(x) - 1) else ''}{x[best]:.4g}"
        now = layout.knob_values(self.inspector)[name]
        s.curve = {"name": label, "title": f"{label} ({unit})", "text": f"peak {peak}, now {now:.4g}", "x": x,
                   "y": scores.tolist(), "truth": layout.truths(self.inspector)[name]}  # fmt: skip
        s.curve_mark = now


def _guarded(call: Callable[..., Any], inspector: weakref.ref[Inspector], progress: Progress) -> Any:
    """Return the result of a call, or the text of its error; None if the inspector is gone.

    NLopt keeps the last error, and its traceback would keep all local variables of this call and its callers alive.
    """
    known = inspector()
    try:
        return None if known is None else call(known, progress=progress)
    except (AmiwarpError, JobCancelled) as error:
        traceback.clear_frames(error.__traceback__)
        return str(error)
    finally:
        known = None


# The page in a browser.

LOCAL_HOST = "127.0.0.1"
"""Address of this machine that only this machine can reach."""


def serve_panel(
    make_inspector: Callable[[], Inspector],
    library: Library | None = None,
    *,
    host: str = LOCAL_HOST,
    port: int = 0,
    ready: Callable[[str], None],
) -> None:
    """Serve the inspector's page until interrupted; each browser tab gets its own inspector.

    ``library``: other recordings that the page may open. ``ready`` is called with the page's address as soon as it can
    be opened.
    Raises :class:`AmiwarpError` if the host or the port cannot be used.
    """
    with contextlib.suppress(KeyboardInterrupt):
        token = secrets.token_urlsafe(16)
        asyncio.run(serve_tabs(make_inspector, library, host=host, port=port, token=token, ready=ready))


async def serve_tabs(
    make_inspector: Callable[[], Inspector],
    library: Library | None = None,
    *,
    opened: Callable[[Panel], None] = lambda panel: None,
    **options: Any,
) -> None:
    """Serve the page, as :func:`serve_panel` does. ``opened`` is called with the panel of each tab that opens."""

    def build(server: Any) -> Callable[[], None]:
        panel = Panel(server, make_inspector(), library)
        opened(panel)
        return panel.close

    await serve(build, settable=layout.SETTABLE, **options)
