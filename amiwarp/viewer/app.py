"""The inspector's fronts: in a browser, in a window of its own, in a notebook, and as a picture without any of them.

The window is the same page in a browser's own window without tabs: one panel to keep, nothing more to install than what
every desktop has, and the same over SSH.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amiwarp.errors import AmiwarpError
from amiwarp.io.output import check_output
from amiwarp.viewer.choices import View
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.panel import Panel
from amiwarp.viewer.scene import Look, Scene
from amiwarp.viewer.serve import serve
from amiwarp.viewer.values import SETTABLE

if TYPE_CHECKING:
    from amiwarp.calib import Calibration
    from amiwarp.events.recording import Recording

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome", "msedge", "brave-browser")
"""Those that open a page in a window of its own."""
HERE = "127.0.0.1"


def has_display() -> bool:
    """Whether a window can open."""
    return not sys.platform.startswith("linux") or any(os.environ.get(n) for n in ("DISPLAY", "WAYLAND_DISPLAY"))


def serve_panel(
    make: Callable[[], Inspector], folder: Path, *, host: str = HERE, port: int = 0, ready: Callable[[str], None]
) -> None:
    """Serve the panel until interrupted, each tab with its own inspector.

    ``folder``: of exports. ``ready`` gets the address. Raises :class:`AmiwarpError` if nothing can be served there.
    """
    with suppress(KeyboardInterrupt):
        asyncio.run(_serve(make, folder, host, port, ready))


async def _serve(
    make: Callable[[], Inspector], folder: Path, host: str, port: int, ready: Callable[[str], None]
) -> None:
    token = secrets.token_urlsafe(16)
    await serve(partial(_tab, make, folder), settable=SETTABLE, host=host, port=port, token=token, ready=ready)


def _tab(make: Callable[[], Inspector], folder: Path, server: Any) -> Callable[[], None]:
    return Panel(server, make(), folder).close


def export_folder(recording: Path | None, given: Path | None) -> Path:
    """Return where a page's exports go: to ``given``, else to the recording's folder, else where the command runs.

    Raises :class:`AmiwarpError` if that is no folder.
    """
    folder = given or (recording.parent if recording is not None else Path())
    if not folder.is_dir():
        raise AmiwarpError(f"{folder}: is no folder; make it first, or give another --out-dir")
    return folder.resolve()


def open_window(make: Callable[[], Inspector], folder: Path, ready: Callable[[str], None]) -> None:
    """Opens the panel in a window and serves it until that is closed; in a tab where no browser has such windows."""

    async def both() -> None:
        found: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        serving: asyncio.Future[Any] = asyncio.create_task(_serve(make, folder, HERE, 0, found.set_result))
        await asyncio.wait([serving, found], return_when=asyncio.FIRST_COMPLETED)
        if serving.done():
            serving.result()
        url = found.result()
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
        asyncio.run(both())


def view(
    recording: Recording,
    calibration: Calibration | None = None,
    *,
    device: Any = "cpu",
    height: int = 700,
    out_dir: str | os.PathLike[str] | None = None,
) -> Any:
    """Show the panel below a notebook's cell, served by the notebook's own loop until the kernel ends.

    ``height`` [px]. ``out_dir``: folder of the files that the page exports; without it the recording's, or the current
    one. Raises :class:`AmiwarpError` for a recording without events, another camera's calibration, or no folder.
    """
    from IPython.display import IFrame, display

    folder = export_folder(getattr(recording.events, "path", None), None if out_dir is None else Path(out_dir))

    Inspector(recording, calibration, device=device)  # what is wrong is said here
    make = partial(Inspector, recording, calibration, device=device)
    show = _serve(make, folder, HERE, 0, lambda url: display(IFrame(url, "100%", height)))
    return asyncio.get_running_loop().create_task(show)


def save_screenshot(
    inspector: Inspector, path: Path, *, view: View = View.FREE, look: Look | None = None, size: tuple[int, int]
) -> None:
    """Writes both clouds as PNG; ``size``: of the picture [px]."""
    check_output(path)
    look = look or Look()
    scene = Scene(size)
    scene.show(inspector.show(), look)
    scene.look_from(view, look)
    scene.save(path)
    scene.close()
