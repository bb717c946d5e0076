"""Page of the inspector: passes input from the browser to the inspector, and results back."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
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
from amiwarp.plotting.colours import Scale, count_scale
from amiwarp.tasks import Progress
from amiwarp.viewer import (
    calibration_job,
    captions,
    clouds_film,
    cost_surface,
    downloads,
    first_phase,
    images,
    layout,
    orbit_lines,
    page_state,
    sliders,
    view_state,
)
from amiwarp.viewer.actions import Actions, Request
from amiwarp.viewer.address import MOST_COUNT, decode_state, encode_state
from amiwarp.viewer.bookmarks import Bookmarks
from amiwarp.viewer.filters import Selection, step_rows
from amiwarp.viewer.images import SLOW_KINDS, ImageKind, ShownImages
from amiwarp.viewer.inspector import WINDOW_POINTS, Inspector
from amiwarp.viewer.job_progress import JobCancelled, JobProgress
from amiwarp.viewer.knobs import Knobs
from amiwarp.viewer.library import Library
from amiwarp.viewer.look import Look
from amiwarp.viewer.page_files import use_page
from amiwarp.viewer.page_messages import finite_number
from amiwarp.viewer.shown_window import DisplayedWindow
from amiwarp.viewer.sliders import FIELD_LIMITS, GIVEN, SLIDERS, UNITS
from amiwarp.viewer.view_state import History, ViewState
from amiwarp.viewer.watched_stream import WatchedStream

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
"""Updates that are made at once, with the parts of the page that wait for them."""
SLOW = ("curve", "picture", "statistics")
"""Updates that take longer; each is named as the part of the page that waits for it."""
SLOW_ORDER = (*SLOW, "preparation")
"""Slow updates in the order in which they are made: what is on the page first."""
PLAY_S = 0.05
"""Shortest interval between two pictures while a recording is played [s]."""
FOLLOW_S = 0.1
"""Shortest interval between two pictures while a live stream is followed [s]."""
RATES_S = 1.0
"""Shortest interval between two counts of a live stream's events for the timeline [s]."""


class Panel(Actions):
    """Panel that connects the page of one browser tab with its inspector. Call :meth:`close` when the tab is closed.

    The page may call the methods in :data:`amiwarp.viewer.layout.CALLS`. The server checks their arguments by their
    annotations. Updates are computed in threads, one after the other. If a slider moves several times meanwhile, only
    its last position is used. What waits for an update is marked on the page. Nothing is computed while the page does
    not keep up with the messages.
    """

    def __init__(self, server: Any, inspector: Inspector, library: Library | None = None) -> None:
        """Build the page on a new trame server. ``library``: other recordings that the page may open."""
        self.server = server
        self.state = server.state
        self.inspector = inspector
        self._library = library
        self.buffers_lock = asyncio.Lock()
        """Lock of the inspector's buffers on the device, which only one thread may use at a time."""
        # Locks, in the order in which they are taken: device_lock, for CUDA; then buffers_lock, for the inspector's own
        # buffers. Slow updates, calibrations and films work on a snapshot or a copy, and take the first only.
        self.device_lock: Any = contextlib.nullcontext()
        if "cuda" in str(inspector.device):
            self.device_lock = _CUDA_LOCK
        self._quick_requests: set[str] = set()
        self._slow_requests: set[str] = set()
        self._being_made: set[str] = set()
        self._quick_task: asyncio.Task[None] | None = None
        self._slow_task: asyncio.Task[None] | None = None
        self._jobs: set[asyncio.Task[None]] = set()
        self._error_source = ""
        # The tab's own pool, which ends with it. One thread each for: calibration or film, slow updates, quick updates.
        self._threads = ThreadPoolExecutor(3, "amiwarp-tab")
        self.shown: DisplayedWindow | None = None
        """Window as the page shows it; None before the first update."""
        self.plays = False
        """Whether the playback runs; after a stop it runs until it notices the stop."""
        self._picked = -1
        """Index of the drawn event that is described; -1 for none."""
        self._has_graphics_card = False
        """Whether the browser draws with a graphics card."""
        self._lasting = False
        """Whether a change lasts, such as a drag: meanwhile the brightness of images does not follow it."""
        self._scales: tuple[Scale, Scale] | None = None
        """Scales of the two images that are shown."""
        self._scales_of: ImageKind | None = None
        """Kind of the images that have these scales."""
        self._surface_middle: Knobs | None = None
        """Parameters in the middle of the map of sharpness."""
        self._made_for: dict[str, Any] = {}
        """Window and selection for which each slow part of the page was made, by its name."""
        # Successive changes of one name are undone together, until a release.
        self._change = ""
        """Name of the change that lasts, with the number of the drag; empty for none."""
        self._drags = 0
        """Number of releases so far."""
        self._rates: list[EventRates] = []
        """Counted events of the recording, and of the recordings on its time axis."""
        self._rates_first_us = 0
        """First event of the recording when its events were counted [us]."""
        self._progress = JobProgress(self._show_progress)  # of the latest calibration or film
        self._folder = tempfile.TemporaryDirectory(prefix="amiwarp-", ignore_cleanup_errors=True)
        use_page(server, self._folder.name)
        self.state.client_only(*layout.CLIENT_ONLY)
        self._wanted: dict[str, Any] = {}
        """Values that were set on the page, and that the inspector has not taken yet, in the page's units."""
        self._listen()
        self.start(inspector)

    def start(self, inspector: Inspector) -> None:
        """Show an inspector from its first state."""
        self.inspector = inspector
        self.shown = None
        self.b = None
        self.calibration_result = None
        self._picked = -1
        self.history = None
        self.history_steps = ()
        self._rates = []  # the next count has not begun
        self._made_for.clear()
        self.use_card(self._has_graphics_card)
        inspector.renew()  # a live stream may have gone on since the inspector was made
        files: list[list[str]] = []
        folder = ""
        if self._library is not None:
            files = self._library.files()
            folder = str(self._library.folder)
        self.state.update({**layout.initial_state(inspector), "files": files, "folder": folder})
        self._wanted = {}
        self.time_window = inspector.window or inspector.first_window()
        self.start_job(self._count_events())
        self.request("window")
        if self.compensates:
            self.request("suggestion")
        self.released()
        self.request_slow("preparation")
        if inspector.latest is not None:
            self.play()
        if isinstance(inspector.latest, WatchedStream):
            self.start_job(self._show_stream_figures(inspector.latest))
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
        state = self.state
        return Look(
            Colour(state.colour),
            Axis(state.axis),
            state.point_size,
            state.opacity,
            state.dark,
            state.overlaid,
        )

    @look.setter
    def look(self, look: Look) -> None:
        self.state.update(
            {"colour": look.colour.value, "axis": look.axis.value, "overlaid": look.overlaid}
        )

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
        start_us = self._clock_us(float(self.state.start_ms))
        length_us = round(float(self.state.length_ms) * 1e3)
        return start_us, max(1, length_us)

    @time_window.setter
    def time_window(self, window: tuple[int, int]) -> None:
        start_us, length_us = window
        start_us -= self.inspector.recording.events.t_first
        self.state.update(
            {"start_ms": round(start_us * 1e-3, 3), "length_ms": round(length_us * 1e-3, 3)}
        )

    def request(self, *what: Request, change: str = "") -> None:
        """Request quick updates; "newest" is for a live stream.

        ``change``: name of a change that lasts, such as a drag; it is undone in one step.
        """
        self._change = f"{change} {self._drags}" if change else ""
        self._lasting = bool(change)
        self._quick_requests.update(what)
        self._show_pending()
        if self._quick_task is None or self._quick_task.done():
            self._quick_task = self.start_job(self._run_quick_updates())

    def request_slow(self, *what: str) -> None:
        """Request updates of :data:`SLOW_ORDER`, which run in a thread after all quick updates."""
        self._slow_requests.update(what)
        self._show_pending()
        if self._slow_task is None or self._slow_task.done():
            self._slow_task = self.start_job(self._run_slow_updates())

    async def until_drawn(self) -> None:
        """Wait until no quick update is pending."""
        while self._quick_task is not None and not self._quick_task.done():
            await asyncio.wait([self._quick_task])

    def start_job(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run a job until it ends or the browser tab is closed."""
        task = asyncio.get_running_loop().create_task(work)
        self._jobs.add(task)
        task.add_done_callback(self._job_ended)
        return task

    async def in_thread(self, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Call ``work`` in one of the browser tab's threads, and return its result."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, partial(work, *args, **options))

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
        parts = (self._slow_requests | self._being_made) & {*SLOW}
        for what in self._quick_requests | self._being_made:
            parts.update(QUICK.get(what, ()))
        self.state.updating = sorted(parts)

    def _job_ended(self, task: asyncio.Task[None]) -> None:
        """Forget a job, and show the error that ended it."""
        self._jobs.discard(task)
        error = None if task.cancelled() else task.exception()
        if error is not None:
            if isinstance(error, (AmiwarpError, OSError)):
                self.say(str(error), "error")
                return
            logging.getLogger(__name__).error("the page's work failed", exc_info=error)
            text = f"internal error: {error or type(error).__name__}; the log of the server shows the details"
            self.say(text, "error")

    async def _run_quick_updates(self) -> None:
        """Make the requested quick updates until none is left; requests that arrive meanwhile are made together."""
        while self._quick_requests:
            while self._page_lags():
                await asyncio.sleep(WAIT_S)
            todo = self._quick_requests
            self._quick_requests = set()
            async with self._marked_on_page(todo), self.device_lock, self.buffers_lock:
                await self.update_quickly(todo)
            await asyncio.sleep(0)

    def _page_lags(self) -> bool:
        """Return whether the page does not keep up with the messages."""
        page = self.server.protocol
        return page is not None and page.network_monitor.pending > MOST_IN_FLIGHT

    async def _run_slow_updates(self) -> None:
        """Make the requested slow updates one after the other, each when no quick update is pending."""
        while self._slow_requests:
            await self.until_drawn()
            name = min(self._slow_requests, key=SLOW_ORDER.index)
            self._slow_requests.discard(name)
            async with self._marked_on_page({name}), self.device_lock:
                with self.errors_shown(name):
                    await self.update_slowly(name)

    @contextlib.asynccontextmanager
    async def _marked_on_page(self, todo: set[str]) -> Any:
        """Mark updates as being made, and send the state to the browser when they are made."""
        self._being_made |= todo
        try:
            yield
        finally:
            self._being_made -= todo
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
        # The images get the scale of what is shown now, as part of the same change.
        if self._lasting:
            change = self._change
            self.request("knobs")
            self._change = change
        self._drags += 1
        self.request_slow(*SLOW)

    def choose(self, name: str) -> None:
        """Select the parameter over which the sharpness curve is drawn."""
        if name in SLIDERS and name != self.state.knob:
            self.state.knob = name
            self.request_slow("curve")

    def typed(self, name: str, text: str) -> None:
        """Set the value that a user typed into a number field."""
        times = ("start_ms", "length_ms", "turns", "events")
        if name not in (*FIELD_LIMITS, *layout.FILTER_FIELDS, *times):
            return
        try:
            value = finite_number(text)
        except ValueError:
            self.say(f"{text!r} is not a number; give a number such as 1.5", "error")
            return
        if name in FIELD_LIMITS:
            self.slide(name, value)
        elif name in layout.FILTER_FIELDS:
            self._set_filter(name, value)
        elif name == "events":
            self.state.fixed_count = min(max(1, round(value)), MOST_COUNT)
            self.request("window")
        else:
            if name == "turns":
                self.state.length_ms = round(value * float(self.state.turn_ms), 4)
            else:
                self.state[name] = round(value, 4)
            if name != "start_ms":  # the window has this length now, not a number of events
                self.state.fixed_count = 0
            self.request("window")
        self.released()

    def _set_filter(self, name: str, value: float) -> None:
        """Set a field of a filter, or the decay time of images."""
        label, unit, limits = layout.FILTER_FIELDS[name]
        if self._is_refused(label, value, unit, limits):
            return
        self.state[name] = round(value) if name == "every" else value
        self.request("knobs" if name == "decay_ms" else "window")

    def _is_refused(self, label: str, value: float, unit: str, limits: tuple[float, float]) -> bool:
        """Return whether a value is outside its limits, and say so."""
        low, high = limits
        if low <= value <= high:
            return False
        self.say(f"{label}: {value:g} {unit} is refused; give {low:g} to {high:g} {unit}", "error")
        return True

    def step(self, count: int) -> None:
        """Move the time window, as :meth:`Actions.step` does. To count events takes long, and is done in a thread."""
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
            hot = await self.in_thread(lambda: self.inspector.hot_pixels)
            rows = [
                [pixel.x, pixel.y, f"{pixel.rate:,.0f}", f"{100.0 * pixel.share:.3g}"]
                for pixel in hot
            ]
            with self.state:
                self.state.hot_rows = rows

    def slide(self, name: str, value: float) -> None:
        """Set a parameter of the prism or the camera, in the unit of its slider or field."""
        if name not in FIELD_LIMITS:
            return
        field = SLIDERS[name] if name in SLIDERS else GIVEN[name]
        if self._is_refused(field.label, value, field.unit, FIELD_LIMITS[name]):
            return
        self._wanted[name] = round(value, 4)
        if name in SLIDERS:
            self.state.knob = name
        self.show_knobs()
        self.request("knobs", change=name)

    def use_card(self, has_card: bool) -> None:
        """Show more points if the browser has a graphics card to draw them."""
        self._has_graphics_card = has_card
        if has_card and self.inspector.most_points < WINDOW_POINTS:
            self.inspector.most_points = WINDOW_POINTS
            self.request("window")

    def answer(self) -> None:
        """Do nothing: the page asks only whether the server answers."""

    def toggle(self, name: str) -> None:
        """Invert a state variable that is true or false. The page cannot call this, only press keys that do."""
        self.state[name] = not self.state[name]

    def look_from(self, view: str) -> None:
        """Set the view, and reset a camera that the mouse has moved."""
        if view in list(View):
            self.view = View(view)

    def pick(self, k: int) -> None:
        """Describe the drawn event with the index ``k``, and show its orbit; -1 for none."""
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
        file = ""
        if self.bookmarks is not None:
            file = self.bookmarks.path.name
            with self.errors_shown("bookmarks"):
                names = self.bookmarks.names()
        self.state.update({"views": names, "views_file": file})

    def choose_beside(self, k: int) -> None:
        """Show the recording with the number ``k`` of those that are on the same time axis."""
        super().choose_beside(k)
        if self.inspector.beside is not None:
            self.state.beside_chosen = self.inspector.besides.index(self.inspector.beside)

    # Region of the image

    def draw(self, left: float, top: float, right: float, bottom: float) -> None:
        """Show a region of the image [px] that was drawn or typed."""
        # Typed sides may come in any order.
        left, right = sorted((left, right))
        top, bottom = sorted((top, bottom))
        width, height = self.state.size
        sides = (left, top, right, bottom)
        limits = (width, height, width, height)
        region = [
            min(max(round(side), 0), limit) for side, limit in zip(sides, limits, strict=True)
        ]
        whole = region == [0, 0, width, height]
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
        start = max(0.0, float(start_ms))
        end = min(float(end_ms), float(self.state.whole_ms))
        if end > start:
            self.state.fixed_count = 0
            self.time_window = self._clock_us(start), max(1, round(1e3 * (end - start)))
            self.request("window", change="length_ms")

    def zoom_timeline(self, start_ms: float, end_ms: float) -> None:
        """Show another part of the time on the timeline [ms]."""
        start = max(0.0, float(start_ms))
        end = min(float(end_ms), float(self.state.whole_ms))
        if end - start > 1e-2:
            self.state.rate_span = [start, end]
            self.start_job(self._show_zoomed_rates())

    def play(self) -> None:
        """Play the recording from the current window, or follow a live stream; stop if already playing."""
        state = self.state
        state.playing = not state.playing and (self.plays or self.can_play())
        if state.playing and not self.plays:
            self.plays = True
            work = (
                self._play_recording() if self.inspector.latest is None else self._follow_stream()
            )
            self.start_job(work).add_done_callback(lambda _: setattr(self, "plays", False))

    async def _play_recording(self) -> None:
        """Move the time window on, by as much as real time has gone on, until playing is stopped."""
        state = self.state
        loop = asyncio.get_running_loop()
        elapsed_s = PLAY_S
        while state.playing:
            start_s = loop.time()
            with state:
                shown_us = 1e6 * elapsed_s * float(state.speed)
                state.playing = self.advance(shown_us, loop=bool(state.loop))
            await self.until_drawn()
            await asyncio.sleep(max(0.0, PLAY_S - (loop.time() - start_s)))
            elapsed_s = loop.time() - start_s
        self.released()

    async def _follow_stream(self) -> None:
        """Show the current events of a live stream, again and again."""
        await self.until_drawn()  # with the suggested region
        loop = asyncio.get_running_loop()
        counted_s = -math.inf
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
        if isinstance(self.inspector.latest, WatchedStream):
            self.start_job(self._start_or_stop_recording(self.inspector.latest))

    async def _start_or_stop_recording(self, source: WatchedStream) -> None:
        with self.errors_shown("recording"):
            if source.is_recording:
                self.say(f"saved {await self.in_thread(source.stop_recording)}", "success")
            else:
                stem = downloads.file_stem(self.inspector.recording.name)
                path = downloads.unused_path(f"{stem}.h5").resolve()
                await self.in_thread(source.record, path)
                self.say(
                    f"recording to {path} until you press stop, or the stream or the command ends"
                )
        self.state.flush()

    async def _show_stream_figures(self, source: WatchedStream) -> None:
        """Show the figures of a live stream, also while it is not followed, until the page is closed."""
        while True:
            with self.state as state:
                state.live_rows, state.stream_note = source.figures()
                state.recording = source.is_recording
            await asyncio.sleep(FOLLOW_S)

    def _clock_us(self, time_ms: float) -> int:
        """Return a time of the page, which counts from the first event [ms], on the events' clock [us]."""
        return int(self.inspector.recording.events.t_first) + round(time_ms * 1e3)

    async def _count_events(self) -> None:
        """Count the recording's events in the background, for the timeline."""
        inspectors = (self.inspector, *self.inspector.besides)
        rates = [EventRates(each.recording.events) for each in inspectors]
        self._rates = rates
        self._rates_first_us = self.inspector.recording.events.t_first
        with self.errors_shown("timeline"):
            for each in rates:
                finished = False
                while not finished and rates is self._rates:
                    finished = await self.in_thread(each.fill, STEP_S)
                    await self._show_rates()
        self.state.flush()

    async def _show_zoomed_rates(self) -> None:
        with self.errors_shown("timeline"):
            await self._show_rates()
        self.state.flush()

    async def _show_rates(self) -> None:
        """Show what is counted of the shown part of the time, unless the page shows another part before it is ready."""
        rates = self._rates
        span = self.state.rate_span
        if not rates:
            return
        values = await self.in_thread(self._rate_state, self.inspector, rates, span)
        if rates is self._rates and span == self.state.rate_span:
            with self.state:
                self.state.update(values)

    def _rate_state(
        self, inspector: Inspector, rates: list[EventRates], span: list[float]
    ) -> dict[str, Any]:
        """Return the state variables of the timeline between two times [ms]. It may read events from a file."""
        # Of a live stream, the counted events may be a second older than the shown ones.
        first_us = self._rates_first_us
        start_us, end_us = (round(1e3 * each) for each in span)
        own, *others = rates
        _, own_rates = own.curve(first_us + start_us, first_us + end_us, layout.RATE_BINS)
        off, on = map(page_state.float_bytes, own_rates)
        rows = []
        for each, counted in zip(inspector.besides, others, strict=True):
            _, rates_beside = counted.curve(
                each.time_of(start_us), each.time_of(end_us), layout.RATE_BINS
            )
            off_beside, on_beside = map(page_state.float_bytes, rates_beside)
            name = captions.beside_text(each)
            rows.append({"name": name, "on": on_beside, "off": off_beside})
        note = "" if own.share >= 1.0 else f"counting events: {100.0 * own.share:.0f} %"
        return {"rate_on": on, "rate_off": off, "rate_note": note, "rate_rows": rows}

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
        if knobs is None:
            self.state.update({"has_b": False, "b_text": "", "against": "recorded"})
        else:
            orbit = sliders.orbit_text(knobs.model, knobs.value, knobs.phase)
            text = f"{knobs.model}, {orbit}"
            self.state.update({"has_b": True, "b_text": text, "against": "B"})
        self.request("knobs")

    def set_knobs(self) -> None:
        """Give the inspector the values that were set on the page."""
        inspector = self.inspector
        wanted = self._wanted
        self._wanted = {}
        view_state.set_given(
            inspector, wanted.pop("fov_deg", None), wanted.pop("prism_index", None)
        )
        model = wanted.pop("model", inspector.knobs.model)
        values = {name: value * UNITS[name] for name, value in wanted.items()}
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
        """Return what the left cloud can show now, by the names in :data:`amiwarp.viewer.captions.AGAINST`."""
        comparable: dict[str, Knobs | None] = {"recorded": None}
        if self.b is not None:
            comparable["B"] = self.b
        if self.calibration_result is not None:
            comparable["found"] = self.inspector.knobs_of(self.calibration_result)
        truth = self.inspector.truth
        if truth is not None:
            comparable["truth"] = truth
        return comparable

    def _against_choices(self) -> list[list[str]]:
        """Return names and titles of what the left cloud can show now."""
        return [[name, captions.against_title(self.inspector, name)] for name in self._comparable()]

    # Calibration

    def calibrate(self) -> None:
        """Start a calibration, or cancel the running one."""
        if not self.state.busy:
            self.calibration_result = None
            self.state.update(
                {
                    "busy": "calibrating",
                    "calibrating": True,
                    "progress": 0,
                    "found": "",
                    "surface": None,
                }
            )
            self._progress = JobProgress(self._show_progress)
            self.start_job(self._calibrate(self._progress))
        elif self.state.calibrating:
            self.cancel()
            self.state.busy = "calibrating: cancelling"

    async def _calibrate(self, progress: JobProgress) -> None:
        """Calibrate in a thread, and show the result with a map of sharpness about it."""
        inspector = self.inspector
        state = self.state
        try:
            find = partial(calibration_job.find_calibration, whole=state.scope != layout.SCOPES[0])
            async with self.device_lock:
                answer = await self.in_thread(
                    _result_or_error, find, weakref.ref(inspector), progress
                )
            if self.inspector is not inspector:  # another recording was opened meanwhile
                return
            if isinstance(answer, str):
                if progress.cancelled:
                    self.say("calibration cancelled", "info")
                else:
                    self.say(answer, "error")
                return
            self.calibration_result, text = answer
            with state:
                state.update({"found": text, "against_choices": self._against_choices()})
            async with self.device_lock:
                draw = partial(cost_surface.cost_surface, found=self.calibration_result)
                self._surface_middle = inspector.knobs
                surface = await self.in_thread(
                    _result_or_error, draw, weakref.ref(inspector), progress
                )
            if not isinstance(surface, str) and self.inspector is inspector:
                with state:
                    state.surface = surface
        finally:
            # In another recording, the next calibration may run already.
            if self._progress is progress:
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
        if what not in layout.EXPORTS:
            return
        if what in ("picture", "image"):  # the browser draws them
            if self.shown is not None:
                name = downloads.download_name(self.inspector.recording.name, what)
                words = captions.caption(self.inspector, self.shown).split("; ")
                self.server.js_call("page", what, name, words)
        elif what in layout.FILMS:
            if not self.state.busy:
                self.start_job(self._write_film(what))
        else:
            self.start_job(self._write_export(what))

    async def _write_export(self, what: str) -> None:
        """Write a file that is no film, and give it to the browser."""
        async with self.device_lock, self.buffers_lock:
            await self._download(what, partial(WRITERS[what], self))

    def write_figure(self, path: Path) -> None:
        """Write what the page shows as a figure."""
        from amiwarp.viewer.publish import Page, save_figure

        save_figure(
            self.inspector,
            path,
            page=Page(),
            view=self.view,
            look=self.look,
            against=self.against,
        )

    def write_values(self, path: Path) -> None:
        """Write the values of the second image."""
        save_values(path, self._make_images().after)

    async def _write_film(self, what: str) -> None:
        """Make a film in a thread, with its progress on the page, and give it to the browser."""
        state = self.state
        look = self.look.for_clouds([title for _, title in state.titles])
        progress = JobProgress(self._show_progress)
        self._progress = progress
        film = partial(
            clouds_film.write_film,
            inspector=self.inspector.copy(),
            look=look,
            view=self.view,
            progress=progress,
            what=what,
            against=self.against,
            with_orbit=bool(state.orbit_shown),
            speed=float(state.speed),
            ended=lambda: progress.ended,
        )
        self._show_progress(f"making the {layout.EXPORTS[what][0]}", 0.0)
        try:
            with contextlib.suppress(JobCancelled):
                async with self.device_lock:
                    await self._download(what, film)
        finally:
            with state:
                state.busy = ""

    async def _download(self, what: str, write: Callable[[Path], object]) -> None:
        """Write a file in a thread, and give it to the browser."""
        name = downloads.download_name(self.inspector.recording.name, what)
        with self.errors_shown("export"):
            path = Path(self._folder.name) / name
            path.unlink(missing_ok=True)
            await self.in_thread(write, path)
            about = path.stat()
            # With its time, as a browser keeps what it has loaded from an address.
            address = f"{self.server.name}/{name}?{about.st_mtime_ns}"
            self.server.js_call("page", "download", name, address)
            size = f"{about.st_size / 1e3:,.0f} kB"
            self.say(f"{name}: {size}, in the browser's downloads", "success")
        self.state.flush()

    # Undo, redo, reset, and the state in the page's address

    def restore(self, address: str) -> None:
        """Show the state that an address describes."""

        def described(history: History) -> ViewState:
            size = self.inspector.recording.events.size
            state, wrong = decode_state(
                address, history.first, size=size, duration_us=self.whole_us
            )
            if wrong:
                self.say("; ".join(wrong), "error")
            return state

        self.travel(described)

    def remember(self, change: str) -> History:
        """Add what the page shows now to the history, and to its address."""
        history = super().remember(change)
        self.state.update(
            {
                "can_undo": history.can_undo,
                "can_redo": history.can_redo,
                "address": encode_state(history.state, history.first),
            }
        )
        return history

    async def _apply_history_steps(self) -> None:
        """Show the requested state. Raises :class:`AmiwarpError` if it selects no events."""
        wanted = self.travelled()
        if wanted is None:
            return
        await self.in_thread(view_state.apply_state, self.inspector, wanted)
        state = self.state
        selection = wanted.selection
        region = list(selection.region or (0, 0, *state.size))
        region_kind = state.region_kind
        if region != state.region_wanted:
            region_kind = "whole" if selection.region is None else "drawn"
        self.time_window = self.inspector.window or self.time_window
        state.update(
            {
                **layout.filter_state(selection),
                "region_wanted": region,
                "region_kind": region_kind,
                "kind": wanted.image.value,
                "fixed_count": wanted.fixed_count or 0,
                "decay_ms": wanted.decay_us * 1e-3,
                "same_scale": wanted.same_scale,
                "difference": wanted.difference,
            }
        )
        self.look = replace(
            self.look, colour=wanted.colour, axis=wanted.axis, overlaid=wanted.overlaid
        )
        if wanted.view is not self.view:
            self.view = wanted.view
        if wanted.against != self.against:
            self.show_b(wanted.against)

    # Updates of what the page shows

    async def update_quickly(self, todo: set[str]) -> None:
        """Make quick updates of :data:`QUICK`."""
        if "newest" in todo:  # here, because no other update uses the events that it replaces
            await self._take_newest()
            todo = {*todo, "window"}
        if self.shown is not None and "state" in todo and len(todo) > 1:
            # What came before an undo can be redone.
            await self.update_quickly(todo - {"state"})
            todo = {"state"}
        if todo & {"window", "suggestion"}:
            with self.errors_shown("window"):
                await self._read_window_or_stay(suggest="suggestion" in todo)
        with self.errors_shown("knobs"):
            values = await self._take_knobs_or_stay(todo)
            self._show_values(values)
            if not self.state.playing:
                self.remember("" if todo & {"suggestion", "state"} else self._change)
            self.announce()

    async def _take_newest(self) -> None:
        """Take the current events of a live stream."""
        with self.errors_shown("stream"):
            await self.in_thread(self.inspector.renew)
            self.state.update(layout.source_state(self.inspector))
            self.time_window = self.newest_window()

    async def _read_window_or_stay(self, *, suggest: bool) -> None:
        """Read the window that the page shows. If it has no events, show again what is still open, and raise the error.

        Playback goes on through a time without events.
        """
        try:
            await self._read_window(suggest=suggest)
        except AmiwarpError:
            if self.inspector.window is not None and not self.state.playing:
                self.time_window = self.inspector.window
                self.state.region_wanted = list(self.inspector.loaded.region)
                self.state.update(layout.filter_state(self.inspector.selection))
            raise

    async def _take_knobs_or_stay(self, todo: set[str]) -> dict[str, Any]:
        """Set what was requested in the inspector, and return the state variables that show it.

        If it is refused, the parameters stay as they were, and the error is raised.
        """
        good = self.inspector.knobs, dict(self.inspector.sources)
        try:
            if "knobs" in todo:
                self.set_knobs()
            if self.shown is None:
                self.remember("")
            if "state" in todo:
                await self._apply_history_steps()
            self.show_knobs()
            self.shown, values = await self.in_thread(self._displayed)
        except AmiwarpError:
            self.inspector.knobs, self.inspector.sources = good
            self.show_knobs()
            raise
        return values

    def _show_values(self, values: dict[str, Any]) -> None:
        """Show state variables of the current parameters, and what depends on them elsewhere on the page."""
        state = self.state
        if self.compensates != bool(state.turn_ms):  # the speed of a prism was set, or set to 0
            state.axis = (Axis.ANGLE if self.compensates else Axis.TIME).value
            self.request("look")
        mark = sliders.knob_values(self.inspector)[state.knob]
        self._show_old()
        if state.surface:  # the parameters may have moved on its map
            marks = cost_surface.surface_marks(
                self.inspector,
                state.surface["names"],
                self._surface_middle or self.inspector.knobs,
                self.calibration_result,
            )
            state.surface = {**state.surface, "marks": marks}
        # A live stream may have got its encoder.
        state.optic = bool(state.optic or self.inspector.has_optic)
        state.update({**values, "turn_ms": layout.turn_ms(self.inspector), "curve_mark": mark})

    def _show_old(self) -> None:
        """Show which slow parts of the page are still of another window or selection."""
        current = self.inspector.window_and_selection
        self.state.old = sorted(
            name for name, made_for in self._made_for.items() if made_for != current
        )

    async def update_slowly(self, name: str) -> None:
        """Make a slow update: "curve", "picture" (of a slow kind), "statistics" or "preparation" of such a picture."""
        inspector = self.inspector.snapshot()  # a live stream changes nothing in it
        made_for = inspector.window_and_selection
        await self._update_part(name, inspector)
        if name != "preparation":
            self._made_for[name] = made_for
            self._show_old()

    async def _update_part(self, name: str, inspector: Inspector) -> None:
        if name == "preparation":
            await self.in_thread(images.prepare, inspector)
        elif name == "statistics":
            self.state.statistics = await self.in_thread(inspector.statistics)
        elif name == "curve":
            await self._update_curve(inspector)
        elif self.image in SLOW_KINDS and self.shown is not None:
            self.state.update(await self.in_thread(self._image_state, self.shown, inspector))

    async def _read_window(self, *, suggest: bool) -> None:
        """Read the window and the selection that the page shows."""
        state = self.state
        inspector = self.inspector
        if not float(state.length_ms) > 0.0:
            raise AmiwarpError(
                f"the window's length is {state.length_ms:g} ms; give a length above 0"
            )
        start_us, length_us = self.time_window
        length_us = min(length_us, self.whole_us)
        known_count = inspector.fixed_count
        inspector.fixed_count = int(state.fixed_count) or None
        try:
            await self.in_thread(inspector.open, start_us, length_us, self._selection())
        except AmiwarpError:
            inspector.fixed_count = known_count
            state.fixed_count = known_count or 0
            raise
        if inspector.fixed_count is not None and inspector.window is not None:
            start_us, length_us = inspector.window
            self.time_window = inspector.window
        if suggest:
            await self.in_thread(first_phase.estimate_phase, inspector)
            region = await self.in_thread(inspector.suggest_region)
            state.update({"region_wanted": list(region), "region_kind": "suggested"})
            await self.in_thread(inspector.open, start_us, length_us, self._selection())
        self._picked = -1

    def _selection(self) -> Selection:
        """Return the conditions for events that the page shows."""
        state = self.state
        region = tuple(state.region_wanted)
        whole = (0, 0, *state.size)
        return Selection(
            polarity={"both": None, "ON": 1, "OFF": 0}[state.polarity],
            region=None if region == whole else region,
            hide_hot=bool(state.hide_hot),
            noise_us=round(1e3 * float(state.noise_ms)) if state.noise_filter else None,
            refractory_us=round(1e3 * float(state.refractory_ms)),
            most_per_s=1e6 * float(state.most_mev_s),
            every=int(state.every),
        )

    def _displayed(self) -> tuple[DisplayedWindow, dict[str, Any]]:
        """Return what is to be shown, and the state variables that show it."""
        state = self.state
        before = self.shown
        against = self.against
        shown = self.inspector.show(against=against)
        values = page_state.cloud_state(
            shown, Colour(state.colour), Axis(state.axis), dark=bool(state.dark)
        )
        values["image_slow"] = self.image in SLOW_KINDS
        if not values["image_slow"]:
            values |= self._image_state(shown)
        lines = orbit_lines.shown_lines(
            self.inspector, shown, self.look.axis, against, self._picked
        )
        if not lines or not state.orbit_shown:
            lines = (np.zeros(0), np.zeros(0))
        values["orbit"], values["column"] = map(page_state.float_bytes, lines)
        if before is None or shown.span is not before.span:
            values |= self._span_state(shown)
        left = "recorded" if against is None else state.against
        titles = captions.cloud_titles(self.inspector, left, Axis(state.axis))
        picked_text = ""
        if self._picked >= 0:
            picked_text = captions.event_text(shown, self._picked, compensated=self.compensates)
        return shown, {
            **values,
            "titles": [list(each) for each in enumerate(titles)],
            "events": captions.chosen_text(shown),
            "steps": step_rows(shown.steps, shown.read_us),
            "beside_rows": captions.beside_rows(self.inspector, shown),
            "drawn": captions.drawn_text(shown),
            "count": shown.span.count,
            "sharpness": captions.sharpness_text(shown, compensated=self.compensates),
            "picked": self._picked,
            "picked_text": picked_text,
            "after_title": self._after_title(shown),
            "against_title": captions.against_title(self.inspector, left),
            "against_choices": self._against_choices(),
        }

    def _span_state(self, shown: DisplayedWindow) -> dict[str, Any]:
        """Return the state variables of all events of the time window, whatever is selected."""
        size = self.inspector.recording.events.size
        counts = iwe(shown.span.events, *size, vote=Vote.NEAREST)
        return {
            "overview": page_state.picture_state(counts, count_scale([counts])),
            "beside_counts": self.inspector.counts_beside(shown.span),
            "rig_pictures": self._rig_state(shown),
        }

    def _rig_state(self, shown: DisplayedWindow) -> list[dict[str, Any]]:
        """Return the pictures of the sensors of a rig at the time of the window; none for a single recording."""
        shown_rig = self.inspector.shown_rig
        return [] if shown_rig is None else page_state.rig_state(shown_rig.pictures(shown.span))

    def _after_title(self, shown: DisplayedWindow) -> str:
        """Return the title of the second image."""
        name = self.inspector.recording.name
        if self.image is ImageKind.DEPTH:
            return "depth map"
        if not self.compensates:
            return "region" if shown.beside is None else f"{name}, as recorded"
        if shown.beside is not None:
            return f"{name}, compensated"
        if self.state.difference and self.image is ImageKind.COUNT:
            return "difference"
        return "compensated"

    def _image_state(
        self, shown: DisplayedWindow, inspector: Inspector | None = None
    ) -> dict[str, Any]:
        """Return the state variables of the images of the region, or why there are none."""
        try:
            made = self._make_images(shown, inspector)
        except AmiwarpError as error:
            return {"before": None, "after": None, "image_note": str(error)}
        after_scale = made.after_scale or made.scale
        self._scales = made.scale, after_scale
        self._scales_of = self.image
        before = None
        if made.before is not None:
            before = page_state.picture_state(made.before, made.scale)
        return {
            "before": before,
            "after": page_state.picture_state(made.after, after_scale),
            "image_scale": page_state.scale_state(made.scale),
            "after_scale": page_state.scale_state(after_scale),
            "image_note": made.note,
        }

    def _make_images(
        self, shown: DisplayedWindow | None = None, inspector: Inspector | None = None
    ) -> ShownImages:
        """Return the images as the page has chosen them, of the tab's inspector or of a snapshot of it."""
        return images.make_images(
            inspector or self.inspector,
            self.image,
            against=self.against,
            shown=shown,
            difference=self.difference,
            decay_us=self.decay_us,
            same_scale=self.same_scale,
            kept=self._scales if self._lasting and self._scales_of == self.image else None,
        )

    async def _update_curve(self, inspector: Inspector) -> None:
        """Show on which events a calibration would run, and the sharpness over the chosen parameter."""
        state = self.state
        name = self.state.knob
        describe = partial(calibration_job.calibrated_events, inspector)
        _, selection_text = await self.in_thread(describe, whole=False)
        _, whole_text = await self.in_thread(describe, whole=True)
        state.calibrate_on = [selection_text, whole_text]
        if not self.compensates:
            return
        values, scores = await self.in_thread(inspector.curve, name)
        x: list[float] = (values / UNITS[name]).tolist()
        if not x:
            return
        slider = SLIDERS[name]
        best = int(np.argmax(scores))
        peak = f"{x[best]:.4g}"
        if best in (0, len(x) - 1):
            peak = f"at the edge {peak}"
        now = sliders.knob_values(self.inspector)[name]
        state.curve = {
            "name": slider.label,
            "title": f"{slider.label} ({slider.unit})",
            "text": f"peak {peak}, now {now:.4g}",
            "x": x,
            "y": scores.tolist(),
            "truth": sliders.truths(self.inspector)[name],
        }
        state.curve_mark = now


def _result_or_error(
    call: Callable[..., Any], reference: weakref.ref[Inspector], progress: Progress
) -> Any:
    """Return the result of a call with the inspector of a reference, or the text of its error; None if it is gone.

    NLopt keeps the last error, and its traceback would keep all local variables of this call and its callers alive.
    """
    inspector = reference()
    try:
        return None if inspector is None else call(inspector, progress=progress)
    except (AmiwarpError, JobCancelled) as error:
        traceback.clear_frames(error.__traceback__)
        return str(error)
    finally:
        inspector = None  # this frame may be kept alive, too


WRITERS: dict[str, Callable[[Panel, Path], object]] = {
    "pdf": Panel.write_figure,
    "svg": Panel.write_figure,
    "values": Panel.write_values,
    "csv": lambda panel, path: downloads.write_table(panel.inspector, path),
    "npz": lambda panel, path: downloads.write_table(panel.inspector, path),
    "events": lambda panel, path: downloads.write_events(panel.inspector, path, compensated=False),
    "compensated": lambda panel, path: downloads.write_events(
        panel.inspector, path, compensated=True
    ),
    "calibration": lambda panel, path: panel.inspector.as_calibration().save(path),
    "vtp": lambda panel, path: downloads.write_cloud(
        panel.inspector, path, axis=panel.look.axis, compensated=False
    ),
    "vtp_after": lambda panel, path: downloads.write_cloud(
        panel.inspector, path, axis=panel.look.axis, compensated=True
    ),
}
"""Functions that write the downloads that are no films, by the names in :data:`amiwarp.viewer.layout.EXPORTS`."""
