"""Ways to open the inspector: in a browser, in a window, in a notebook, or as a picture file.

The window is a browser window without tabs or address bar that shows the same page. So there is only one user interface
to maintain, nothing extra to install, and the inspector works in the same way over SSH.
"""

from __future__ import annotations

import asyncio
import math
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import webbrowser
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

from amiwarp.calib import Calibration
from amiwarp.choices import View
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.io.files import check_output, interrupts_later
from amiwarp.validation import guarded
from amiwarp.viewer.clouds import Look, Scene
from amiwarp.viewer.inspector import Inspector, Library
from amiwarp.viewer.layout import SETTABLE
from amiwarp.viewer.panel import RECORDED, Panel
from amiwarp.viewer.serve import serve

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "msedge", "brave-browser")
"""Commands of the browsers that can show a page in a window without tabs (``--app``), in order of preference."""
LOCALHOST = "127.0.0.1"


def has_display() -> bool:
    """Return whether this machine has a display on which a window can be opened."""
    return not sys.platform.startswith("linux") or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))


def serve_panel(
    make_inspector: Callable[[], Inspector],
    library: Library | None = None,
    *,
    host: str = LOCALHOST,
    port: int = 0,
    ready: Callable[[str], None],
) -> None:
    """Serve the inspector's page until interrupted; each browser tab gets its own inspector.

    ``library``: other recordings that the page may open. ``ready`` is called with the page's address as soon as it can
    be opened.
    Raises :class:`AmiwarpError` if the host or the port cannot be used.
    """
    with suppress(KeyboardInterrupt):
        asyncio.run(_serve(make_inspector, library, host, port, ready))


async def _serve(
    make_inspector: Callable[[], Inspector], library: Library | None, host: str, port: int, ready: Callable[[str], None]
) -> None:
    def build(server: Any) -> Callable[[], None]:
        return Panel(server, make_inspector(), library).close

    await serve(build, settable=SETTABLE, host=host, port=port, token=secrets.token_urlsafe(16), ready=ready)


def open_window(make_inspector: Callable[[], Inspector], library: Library | None, ready: Callable[[str], None]) -> None:
    """Open the page in a window and serve it until the window is closed.

    If none of :data:`BROWSERS` is installed, open a tab of the default browser and serve until interrupted.
    """

    async def serve_and_show() -> None:
        address: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        serving: asyncio.Future[Any] = asyncio.create_task(
            _serve(make_inspector, library, LOCALHOST, 0, address.set_result)
        )
        await asyncio.wait([serving, address], return_when=asyncio.FIRST_COMPLETED)
        if serving.done():
            serving.result()
        url = address.result()
        ready(url)
        browser = next(filter(None, map(shutil.which, BROWSERS)), None)
        if browser is None:
            webbrowser.open(url)
            await serving
            return
        with tempfile.TemporaryDirectory(prefix="amiwarp-", ignore_cleanup_errors=True) as profile:
            options = [f"--app={url}", f"--user-data-dir={profile}", "--no-first-run", "--window-size=1366,768"]
            if hasattr(os, "geteuid") and os.geteuid() == 0:
                options.append("--no-sandbox")  # browsers refuse to run as root otherwise
            window = await asyncio.create_subprocess_exec(browser, *options, stderr=subprocess.DEVNULL)
            await window.wait()
        serving.cancel()
        with suppress(asyncio.CancelledError):
            await serving

    with suppress(KeyboardInterrupt):
        asyncio.run(serve_and_show())


@guarded
class NotebookPage:
    """The inspector's page below a notebook cell.

    Parameters
    ----------
    serving : asyncio.Task
        Task that serves the page.

    Examples
    --------
    >>> page = amiwarp.view(amiwarp.open_recording("recording.h5"))  # doctest: +SKIP
    >>> page.close()  # doctest: +SKIP
    """

    def __init__(self, serving: asyncio.Task[None]) -> None:
        self._serving = serving

    def close(self) -> None:
        """Stop serving the page.

        Examples
        --------
        >>> page.close()  # doctest: +SKIP
        """
        self._serving.cancel()

    def _ipython_display_(self) -> None:
        """Show nothing more than the page, which is already shown."""


@guarded
def view(
    recording: Recording,
    calibration: Calibration | None = None,
    *,
    device: Any = "cpu",
    height: int = 700,
) -> NotebookPage:
    """Show the inspector below a notebook cell. Warp's messages are switched off, so that the cell shows only the page.

    Parameters
    ----------
    recording : Recording
        Events to show. Encoder, camera and prism may be missing.
    calibration : Calibration or None
        Parameters of the prism at the start. Without it, the page starts with the nominal prism.
    device : str or warp.Device
        Device that compensates the events.
    height : int
        Height of the page in the notebook [px].

    Returns
    -------
    NotebookPage
        The page, which is served until the kernel ends or its ``close`` is called.

    Raises
    ------
    AmiwarpError
        If the recording holds no events, or the calibration belongs to a camera of another size.

    Examples
    --------
    >>> amiwarp.view(amiwarp.open_recording("recording.h5"))  # doctest: +SKIP
    """
    try:
        loop = asyncio.get_running_loop()
        from IPython.display import IFrame, display
    except (ImportError, RuntimeError) as error:  # no IPython, or no running loop
        given = f"{recording.name}: view shows a recording in a notebook"
        raise AmiwarpError(f"{given}; elsewhere, run in a shell: amiwarp view FILE") from error

    from amiwarp.kernels.launch import start_quietly

    start_quietly()
    Inspector(recording, calibration, device=device)  # raises errors in the cell, before the page is served
    make_inspector = partial(Inspector, recording, calibration, device=device)
    serving = _serve(make_inspector, None, LOCALHOST, 0, lambda url: display(IFrame(url, "100%", height)))
    return NotebookPage(loop.create_task(serving))


def save_screenshot(
    inspector: Inspector, path: Path, *, view: View = View.FREE, look: Look | None = None, size: tuple[int, int]
) -> None:
    """Write a picture of both event clouds as PNG; ``size`` is its width and height [px]."""

    check_output(path)
    look = look or Look()
    if not math.isfinite(inspector.turn_us):
        look = look.for_clouds([RECORDED])
    clouds = inspector.show()
    with interrupts_later(), closing(Scene(size)) as scene:  # VTK crashes if an exception leaves it half-drawn
        scene.show(clouds, look)
        scene.look_from(view, look)
        scene.save(path)
