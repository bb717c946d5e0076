"""Pictures of the clouds on their way to one page: no more of them at a time than it takes."""

from __future__ import annotations

import asyncio
from typing import Any

MOST_IN_FLIGHT = 8
"""Messages that wait to be sent; while there are more, nothing is drawn."""
WAIT_S = 0.02
FRAME_S = 1.0 / 30.0
"""Between two pictures while the mouse turns the clouds."""
BREATH_S = 0.01
"""Left to other pages between two pictures, however long they take."""


async def room(server: Any) -> None:
    """Wait until the page has taken most of what was sent to it."""
    while _in_flight(server) > MOST_IN_FLIGHT:
        await asyncio.sleep(WAIT_S)


def _in_flight(server: Any) -> int:
    return 0 if server.protocol is None else int(server.protocol.network_monitor.pending)


class Frames:
    """Stands between VTK's delivery of pictures and the page.

    VTK's own sends each picture at once, and starts one more animation with each press of the mouse.
    """

    def __init__(self, server: Any, delivery: Any) -> None:
        """``delivery``: the protocol ``vtkWebPublishImageDelivery`` of the ``server``."""
        self._server, self._delivery = server, delivery
        self._send = delivery.push_render
        self._late: asyncio.TimerHandle | None = None
        self._next: asyncio.TimerHandle | None = None
        self._turning = ""
        delivery.push_render = self._push
        delivery.start_view_animation = self._start
        delivery.stop_view_animation = self._stop

    def close(self) -> None:
        """Draw no more, and end what VTK keeps of the page."""
        for timer in filter(None, (self._late, self._next)):
            timer.cancel()
        delivery, self._turning = self._delivery, ""
        for observed in delivery.tracking_views.values():
            for tag in observed["tags"]:
                delivery.app.RemoveObserver(tag)
        delivery.tracking_views.clear()
        delivery.stale_handler_count.clear()
        for name in ("push_render", "start_view_animation", "stop_view_animation"):
            vars(delivery).pop(name, None)

    def _push(self, view: str, ignore_animation: bool = False, stale_count: int = 0) -> None:
        if self._turning and not ignore_animation:
            return
        if _in_flight(self._server) > MOST_IN_FLIGHT:
            if self._late is None:
                self._late = asyncio.get_running_loop().call_later(WAIT_S, self._push_late, view)
            return
        self._send(view, True, stale_count)

    def _push_late(self, view: str) -> None:
        self._late = None
        self._push(view)

    def _start(self, view: str = "-1") -> None:
        self._turning = view
        if self._next is None:
            self._animate()

    def _stop(self, view: str = "-1") -> None:
        self._turning = ""

    def _animate(self) -> None:
        self._next, loop = None, asyncio.get_running_loop()
        if self._turning:
            began = loop.time()
            self._push(self._turning, ignore_animation=True)
            took = loop.time() - began
            self._next = loop.call_later(max(FRAME_S - took, BREATH_S), self._animate)
