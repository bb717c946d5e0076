"""Work of one page: its threads, jobs and updates, and the messages about their errors."""

import asyncio
import contextlib
import logging
import math
import weakref
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from amiwarp.errors import AmiwarpError

MOST_IN_FLIGHT = 8
"""Largest number of messages to the page that are unsent; while more are waiting, nothing is computed."""
WAIT_S = 0.02
"""Interval between two checks of the number of unsent messages [s]."""
PROGRESS_S = 0.1
"""Shortest interval between two progress messages of a job [s].

The calibration of a small recording causes eighty per second, and the page would draw each of them.
"""
_CUDA_LOCK = asyncio.Lock()
"""Lock for all tabs: Warp's CUDA calls may run in only one thread at a time."""
QUICK = {**dict.fromkeys(("window", "suggestion", "state", "knobs"), ("clouds", "images")), "look": ("clouds",)}
SLOW = ("curve", "picture")
"""Updates that are made at once, with the parts of the page that wait for them, and updates that take longer."""


class JobCancelled(Exception):
    """Raised to stop work whose result is no longer needed."""


class JobProgress:
    """Progress callback of a job in a thread. It stops the job once ``cancelled`` is set.

    It holds the page by a weak reference, because NLopt never releases its callbacks.
    """

    def __init__(self, show: Callable[[str, float], None]) -> None:
        """``show``: method of the page that shows the name of a step and the finished share, 0 to 1."""
        self.cancelled = False
        self._show, self._loop, self._last_s = weakref.WeakMethod(show), asyncio.get_running_loop(), -math.inf

    def __call__(self, what: str, share: float) -> None:
        if self.cancelled or self._show() is None:
            raise JobCancelled
        if (now := self._loop.time()) >= self._last_s + PROGRESS_S:
            self._last_s = now
            self._loop.call_soon_threadsafe(self._pass_on, what, share)

    def _pass_on(self, what: str, share: float) -> None:
        if (show := self._show()) is not None and not self.cancelled:
            show(what, share)


class PageWork:
    """What is computed for one page, in threads, and the messages about it.

    Updates run one after the other. If a slider moves several times meanwhile, only its last position is used. What
    waits for an update is marked on the page. Nothing is computed while the page does not keep up with the messages.
    """

    def __init__(
        self, server: Any, device: Any, make: Callable[[set[str]], Awaitable[None]],
        make_slow: Callable[[str], Awaitable[None]],
    ) -> None:  # fmt: skip
        """``make`` makes a set of quick updates, and ``make_slow`` one slow update."""
        self._server, self._state = server, server.state
        self._make, self._make_slow = make, make_slow
        self.buffers_lock = asyncio.Lock()
        """Lock of the inspector's buffers on the device, which only one thread may use at a time."""
        self.device_lock: Any = _CUDA_LOCK if "cuda" in str(device) else contextlib.nullcontext()
        self._quick_requests: set[str] = set()
        self._slow_requests: set[str] = set()
        self._doing: set[str] = set()
        self._quick: asyncio.Task[None] | None = None
        self._slow: asyncio.Task[None] | None = None
        self._jobs: set[asyncio.Task[None]] = set()
        self._error_source = ""
        self._threads = ThreadPoolExecutor(3, "amiwarp-tab")  # calibration or film; curve or picture; quick updates

    def close(self) -> None:
        """Stop all work. A thread ends when its current work is done."""
        for task in [*self._jobs, *filter(None, [self._quick, self._slow])]:
            task.cancel()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def request(self, *what: str) -> None:
        """Request quick updates: "window", "knobs", "look", "suggestion" or "state"."""
        self._quick_requests.update(what)
        self._show_pending()
        if self._quick is None:
            self._quick = self._task(self._update())

    def request_slow(self, *what: str) -> None:
        """Request updates that run in a thread after all quick updates: "curve", "picture" or "preparation"."""
        self._slow_requests.update(what)
        self._show_pending()
        if self._slow is None:
            self._slow = self._task(self._update_slowly())

    async def until_drawn(self) -> None:
        """Wait until no quick update is pending."""
        while self._quick is not None:
            await asyncio.sleep(0.005)

    def start_job(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a job until it ends or the browser tab is closed."""
        self._jobs.add(task := self._task(work))
        task.add_done_callback(self._jobs.discard)

    async def in_thread(self, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Call ``work`` in one of the browser tab's threads, and return its result."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, partial(work, *args, **options))

    def show_message(self, text: str, severity: str) -> None:
        with self._state:
            self._state.update({"message": text, "severity": severity})

    @contextlib.contextmanager
    def errors_shown(self, what: str) -> Iterator[None]:
        """Show errors of the enclosed code as a message, until the same kind of action (``what``) succeeds."""
        try:
            yield
        except (AmiwarpError, OSError) as error:
            self._error_source = what
            self._state.update({"message": str(error), "severity": "error"})
        else:
            if self._state.severity == "error" and self._error_source == what:
                self._state.update({"message": "", "severity": "info"})

    def _show_pending(self) -> None:
        """Show which parts of the page wait for an update."""
        quick = self._quick_requests | self._doing
        parts = {part for what in quick for part in QUICK.get(what, ())} | (self._slow_requests | self._doing) & {*SLOW}
        self._state.updating = sorted(parts)

    def _task(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        task.add_done_callback(self._ended)
        return task

    def _ended(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            logging.getLogger(__name__).error("the page's work failed", exc_info=error)
            text = f"internal error: {error or type(error).__name__}; the log of the server shows the details"
            self.show_message(text, "error")

    async def _update(self) -> None:
        try:
            while self._quick_requests:
                while self._in_flight() > MOST_IN_FLIGHT:
                    await asyncio.sleep(WAIT_S)
                todo, self._quick_requests = self._quick_requests, set()
                async with self._done(todo), self.device_lock, self.buffers_lock:
                    await self._make(todo)
                await asyncio.sleep(0)
        finally:
            self._quick = None

    def _in_flight(self) -> int:
        """Return the number of unsent messages to the page."""
        return 0 if self._server.protocol is None else int(self._server.protocol.network_monitor.pending)

    async def _update_slowly(self) -> None:
        try:
            while self._slow_requests:
                await self.until_drawn()
                name = min(self._slow_requests)  # in alphabetical order: the curve first, the preparation last
                self._slow_requests.discard(name)
                async with self._done({name}), self.device_lock:
                    with self.errors_shown(name):
                        await self._make_slow(name)
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
            with self._state:
                self._show_pending()
