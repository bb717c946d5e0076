"""Downloads of the inspector's page: figures, values, clouds, films and files that the browser gets."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

from amiwarp.imaging.export import save_values
from amiwarp.viewer import clouds_film, downloads, layout
from amiwarp.viewer.job_progress import JobCancelled, JobProgress
from amiwarp.viewer.page_panel import PagePanel


class PageDownloads:
    """Files that a panel writes for the browser, in a folder of its own."""

    def __init__(self, panel: PagePanel) -> None:
        self.panel = panel
        """The panel whose view is written."""
        self._folder = tempfile.TemporaryDirectory(prefix="amiwarp-", ignore_cleanup_errors=True)
        self.folder = self._folder.name
        """Path of the folder."""

    def close(self) -> None:
        """Remove the files."""
        self._folder.cleanup()

    async def write_file(self, what: str) -> None:
        """Write a file that is no film, and give it to the browser."""
        async with self.panel.work.device_lock, self.panel.work.buffers_lock:
            await self._download(what, partial(WRITERS[what], self))

    def write_figure(self, path: Path) -> None:
        """Write what the page shows as a figure."""
        from amiwarp.viewer.publish import Page, save_figure

        save_figure(
            self.panel.inspector,
            path,
            page=Page(),
            view=self.panel.view,
            look=self.panel.look,
            against=self.panel.against,
        )

    def write_values(self, path: Path) -> None:
        """Write the values of the second image."""
        save_values(path, self.panel.make_images().after)

    async def write_film(self, what: str) -> None:
        """Make a film in a thread, with its progress on the page, and give it to the browser."""
        state = self.panel.state
        look = self.panel.look.for_clouds([title for _, title in state.titles])
        progress = JobProgress(self.panel.show_progress)
        self.panel.progress = progress
        film = partial(
            clouds_film.write_film,
            inspector=self.panel.inspector.copy(),
            look=look,
            view=self.panel.view,
            progress=progress,
            what=what,
            against=self.panel.against,
            with_orbit=bool(state.orbit_shown),
            speed=float(state.speed),
            ended=lambda: progress.ended,
        )
        self.panel.show_progress(f"making the {layout.EXPORTS[what][0]}", 0.0)
        try:
            with contextlib.suppress(JobCancelled):
                async with self.panel.work.device_lock:
                    await self._download(what, film)
        finally:
            with state:
                state.busy = ""

    async def _download(self, what: str, write: Callable[[Path], object]) -> None:
        """Write a file in a thread, and give it to the browser."""
        name = downloads.download_name(self.panel.inspector.recording.name, what)
        with self.panel.errors_shown("export"):
            path = Path(self.folder) / name
            path.unlink(missing_ok=True)
            await self.panel.work.in_thread(write, path)
            about = path.stat()
            # With its time, as a browser keeps what it has loaded from an address.
            address = f"{self.panel.server.name}/{name}?{about.st_mtime_ns}"
            self.panel.server.js_call("page", "download", name, address)
            size = f"{about.st_size / 1e3:,.0f} kB"
            self.panel.say(f"{name}: {size}, in the browser's downloads", "success")
        self.panel.state.flush()


WRITERS: dict[str, Callable[[PageDownloads, Path], object]] = {
    "pdf": PageDownloads.write_figure,
    "svg": PageDownloads.write_figure,
    "values": PageDownloads.write_values,
    "csv": lambda page, path: downloads.write_table(page.panel.inspector, path),
    "npz": lambda page, path: downloads.write_table(page.panel.inspector, path),
    "events": lambda page, path: downloads.write_events(
        page.panel.inspector, path, compensated=False
    ),
    "compensated": lambda page, path: downloads.write_events(
        page.panel.inspector, path, compensated=True
    ),
    "calibration": lambda page, path: page.panel.inspector.as_calibration().save(path),
    "vtp": lambda page, path: downloads.write_cloud(
        page.panel.inspector, path, axis=page.panel.look.axis, compensated=False
    ),
    "vtp_after": lambda page, path: downloads.write_cloud(
        page.panel.inspector, path, axis=page.panel.look.axis, compensated=True
    ),
}
"""Functions that write the downloads that are no films, by the names in :data:`amiwarp.viewer.layout.EXPORTS`."""
