"""The inspector's page in a browser."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
from collections.abc import Callable
from typing import Any

from amiwarp.viewer import layout
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.library import Library
from amiwarp.viewer.panel import Panel
from amiwarp.viewer.serve import serve

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
        asyncio.run(
            serve_tabs(make_inspector, library, host=host, port=port, token=token, ready=ready)
        )


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
