"""Delivery of rendered pictures to one page, limited to the rate at which the page takes them."""

from __future__ import annotations

import asyncio
from typing import Any

MOST_IN_FLIGHT = 8
"""Largest number of messages to the page that are unsent; while more are waiting, no picture is drawn."""
WAIT_S = 0.02
"""Interval between two checks of the number of unsent messages [s]."""
FRAME_S = 1.0 / 30.0
"""Shortest interval between two pictures while the mouse rotates the clouds [s]."""
PAUSE_S = 0.01
"""Shortest pause between two pictures [s]. It leaves time for other pages, however long drawing takes."""


async def wait_until_page_keeps_up(server: Any) -> None:
    """Wait until at most :data:`MOST_IN_FLIGHT` messages to the page are unsent."""
    while _in_flight(server) > MOST_IN_FLIGHT:
        await asyncio.sleep(WAIT_S)


def _in_flight(server: Any) -> int:
    return 0 if server.protocol is None else int(server.protocol.network_monitor.pending)


class PictureThrottle:
    """Replacement of VTK's picture delivery that waits while the page is slow.

    VTK itself sends every picture immediately, and starts one more animation at each press of a mouse button.
    """

    def __init__(self, server: Any, delivery: Any) -> None:
        """Replace the sending methods of ``delivery``, the server's ``vtkWebPublishImageDelivery`` protocol."""
        self._server, self._delivery = server, delivery
        self._send = delivery.push_render
        self._retry: asyncio.TimerHandle | None = None
        self._next: asyncio.TimerHandle | None = None
        self._animated_view = ""
        delivery.push_render = self._push
        delivery.start_view_animation = self._start
        delivery.stop_view_animation = self._stop

    def close(self) -> None:
        """Stop drawing pictures, and remove VTK's observers and records of the page."""
        for timer in filter(None, (self._retry, self._next)):
            timer.cancel()
        delivery, self._animated_view = self._delivery, ""
        for observed in delivery.tracking_views.values():
            for tag in observed["tags"]:
                delivery.app.RemoveObserver(tag)
        delivery.tracking_views.clear()
        delivery.stale_handler_count.clear()
        for name in ("push_render", "start_view_animation", "stop_view_animation"):
            vars(delivery).pop(name, None)

    def _push(self, view: str, ignore_animation: bool = False, stale_count: int = 0) -> None:
        if self._animated_view and not ignore_animation:
            return
        if _in_flight(self._server) > MOST_IN_FLIGHT:
            if self._retry is None:
                self._retry = asyncio.get_running_loop().call_later(WAIT_S, self._push_again, view)
            return
        self._send(view, True, stale_count)

    def _push_again(self, view: str) -> None:
        self._retry = None
        self._push(view)

    def _start(self, view: str = "-1") -> None:
        self._animated_view = view
        if self._next is None:
            self._animate()

    def _stop(self, view: str = "-1") -> None:
        self._animated_view = ""

    def _animate(self) -> None:
        self._next, loop = None, asyncio.get_running_loop()
        if self._animated_view:
            start_s = loop.time()
            self._push(self._animated_view, ignore_animation=True)
            drawing_s = loop.time() - start_s
            self._next = loop.call_later(max(FRAME_S - drawing_s, PAUSE_S), self._animate)
