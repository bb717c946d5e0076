"""Limit of the updates of one page to the rate at which the page takes them."""

from __future__ import annotations

import asyncio
from typing import Any

MOST_IN_FLIGHT = 8
"""Largest number of messages to the page that are unsent; while more are waiting, nothing is computed."""
WAIT_S = 0.02
"""Interval between two checks of the number of unsent messages [s]."""


async def wait_until_page_keeps_up(server: Any) -> None:
    """Wait until at most :data:`MOST_IN_FLIGHT` messages to the page are unsent."""
    while _in_flight(server) > MOST_IN_FLIGHT:
        await asyncio.sleep(WAIT_S)


def _in_flight(server: Any) -> int:
    return 0 if server.protocol is None else int(server.protocol.network_monitor.pending)
