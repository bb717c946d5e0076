"""Work of the inspector's page: quick and slow updates one after the other, and other jobs, in threads of its own."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from amiwarp.errors import AmiwarpError

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


class PageWork:
    """Updates and jobs of the page of one browser tab.

    Updates are made one after the other. Requests that come while one is made are made together after it, so of a
    slider that moves several times only the last position is used. What waits for an update is marked on the page.
    Nothing is made while the page does not keep up with the messages.
    """

    def __init__(
        self,
        server: Any,
        *,
        on_gpu: bool,
        update_quickly: Callable[[set[str]], Awaitable[None]],
        update_slowly: Callable[[str], Awaitable[None]],
        say: Callable[[str, str], None],
    ) -> None:
        """Set up the work for a tab's trame server. ``say`` shows a message of a severity."""
        self._server = server
        self.update_quickly = update_quickly
        """Function that makes some updates of :data:`QUICK`."""
        self.update_slowly = update_slowly
        """Function that makes one update of :data:`SLOW_ORDER`."""
        self._say = say
        # Locks, in the order in which they are taken: device_lock, for CUDA; then buffers_lock, for the inspector's own
        # buffers. Slow updates, calibrations and films work on a snapshot or a copy, and take the first only.
        self.device_lock: Any = _CUDA_LOCK if on_gpu else contextlib.nullcontext()
        self.buffers_lock = asyncio.Lock()
        """Lock of the inspector's buffers on the device, which only one thread may use at a time."""
        self._quick_requests: set[str] = set()
        self._slow_requests: set[str] = set()
        self._being_made: set[str] = set()
        self._quick_task: asyncio.Task[None] | None = None
        self._slow_task: asyncio.Task[None] | None = None
        self.jobs: set[asyncio.Task[None]] = set()
        """Jobs that run."""
        # The tab's own pool, which ends with it. One thread each for: calibration or film, slow updates, quick updates.
        self._threads = ThreadPoolExecutor(3, "amiwarp-tab")

    def close(self) -> None:
        """Stop all work. A thread ends when its current work is done."""
        for task in self.jobs:
            task.cancel()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def request_quick(self, *what: str) -> None:
        """Request updates of :data:`QUICK`."""
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
        self.jobs.add(task)
        task.add_done_callback(self._job_ended)
        return task

    async def in_thread(self, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Call ``work`` in one of the browser tab's threads, and return its result."""
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._threads, partial(work, *args, **options))

    def _job_ended(self, task: asyncio.Task[None]) -> None:
        """Forget a job, and show the error that ended it."""
        self.jobs.discard(task)
        error = None if task.cancelled() else task.exception()
        if error is None:
            return
        if isinstance(error, (AmiwarpError, OSError)):
            self._say(str(error), "error")
            return
        logging.getLogger(__name__).error("the page's work failed", exc_info=error)
        text = f"internal error: {error or type(error).__name__}; the log of the server shows the details"
        self._say(text, "error")

    def _show_pending(self) -> None:
        """Show which parts of the page wait for an update."""
        parts = (self._slow_requests | self._being_made) & {*SLOW}
        for what in self._quick_requests | self._being_made:
            parts.update(QUICK.get(what, ()))
        self._server.state.updating = sorted(parts)

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
        page = self._server.protocol
        return page is not None and page.network_monitor.pending > MOST_IN_FLIGHT

    async def _run_slow_updates(self) -> None:
        """Make the requested slow updates one after the other, each when no quick update is pending."""
        while self._slow_requests:
            await self.until_drawn()
            name = min(self._slow_requests, key=SLOW_ORDER.index)
            self._slow_requests.discard(name)
            async with self._marked_on_page({name}), self.device_lock:
                await self.update_slowly(name)

    @contextlib.asynccontextmanager
    async def _marked_on_page(self, todo: set[str]) -> Any:
        """Mark updates as being made, and send the state to the browser when they are made."""
        self._being_made |= todo
        try:
            yield
        finally:
            self._being_made -= todo
            with self._server.state:
                self._show_pending()
