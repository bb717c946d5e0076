"""Downloads of a page: pictures, images, events, the calibration and films. No file is written on the server."""

from __future__ import annotations

import asyncio
import itertools
import re
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amiwarp.reconstruction.export import save_film
from amiwarp.viewer.choices import Axis, Colour, View
from amiwarp.viewer.cloud_scene import Look, Scene
from amiwarp.viewer.downloads import as_bytes, write_events, write_image
from amiwarp.viewer.drawing import orbit_lines
from amiwarp.viewer.image_kinds import ImageKind, make_images
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.jobs import JobCancelled

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from amiwarp.viewer.panel import Panel

FRAMES, FPS = 90, 25.0
"""Number of pictures of a film, and pictures per second."""
FILM_SIZE = (1280, 560)
"""Width and height of a film [px]."""
EXPORTS = {
    "picture": ("picture", ".png", "image/png"), "image": ("image", ".png", "image/png"),
    "values": ("image values", ".tif", "image/tiff"), "events": ("events", ".h5", "application/x-hdf5"),
    "compensated": ("compensated events", ".h5", "application/x-hdf5"),
    "calibration": ("calibration", ".json", "application/json"), "turntable": ("film, turning", ".mp4", "video/mp4"),
    "film": ("film from here", ".mp4", "video/mp4"),
}  # fmt: skip
"""Downloads by name: text of the button, suffix and media type."""
FILMS = ("turntable", "film")
"""Downloads that take long."""


class Exports:
    """Downloads of one page."""

    def __init__(self, panel: Panel) -> None:
        self._panel, self._ended = panel, False

    def end(self) -> None:
        """Stop a film that is being made."""
        self._ended = True

    def export(self, what: str) -> None:
        """Give the browser a file; ``what`` is a name in :data:`EXPORTS`."""
        if what == "picture":
            s = self._panel.state
            words = [s.name, s.events, f"sharpness {s.sharpness}"]
            self._panel.server.js_call("page", "picture", self._name(what), words)
        elif what in EXPORTS and not (what in FILMS and self._panel.state.busy):
            self._panel.start_job(self._film(what) if what in FILMS else self._write(what))

    def _name(self, what: str) -> str:
        """Return the name of a download, made of the recording's name, which may be that of a stream."""
        name = re.sub(r"[^\w.+=@-]+", "_", self._panel.inspector.recording.name)[:60].strip("._-~ ") or "recording"
        return f"{name}.{what}{EXPORTS[what][1]}"

    async def _write(self, what: str) -> None:
        panel, inspector = self._panel, self._panel.inspector
        kind, against = ImageKind(panel.state.kind), panel.comparison.knobs
        write: dict[str, Callable[[Path], object]] = {
            "image": lambda path: write_image(make_images(inspector, kind, against=against), path),
            "values": lambda path: write_image(make_images(inspector, kind, against=against), path),
            "events": partial(write_events, inspector, compensated=False),
            "compensated": partial(write_events, inspector, compensated=True),
            "calibration": lambda path: inspector.as_calibration().save(path),
        }
        with panel.errors_shown("export"):
            async with panel.device_lock, panel.buffers_lock:
                content = await panel.in_thread(as_bytes, EXPORTS[what][1], write[what])
            self._give(what, content)
        panel.state.flush()

    async def _film(self, what: str) -> None:
        panel, state = self._panel, self._panel.state
        inspector = Inspector(panel.inspector.recording, device=panel.inspector.device)
        inspector.set(panel.inspector.knobs)
        window, selection, step_us = panel.inspector.window, panel.inspector.selection, 1e6 / FPS * float(state.speed)
        look = Look(Colour(state.colour), Axis(state.axis), float(state.point_size), float(state.opacity),
                    dark=bool(state.dark), overlaid=bool(state.overlaid))  # fmt: skip
        look, against = look.for_clouds([title for _, title in state.titles]), panel.comparison.knobs
        view, loop = View(state.view[0]), asyncio.get_running_loop()
        with_orbit = bool(state.orbit_shown) and look.axis is Axis.ANGLE and panel.compensates
        assert window is not None

        def draw(scene: Scene) -> None:
            shown = inspector.show(against=against)
            orbit, column = orbit_lines(inspector, shown)
            lines = (orbit if against is None else column, column)
            scene.show(shown, look, lines if with_orbit else ())

        def pictures() -> Iterator[NDArray[np.uint8]]:
            inspector.open(*window, selection)
            with closing(Scene(FILM_SIZE)) as scene:
                draw(scene)
                scene.look_from(view, look)
                if what == "turntable":
                    yield from scene.turntable(FRAMES)
                    return
                start_us, last_us = float(window[0]), inspector.recording.events.t_last + 1 - window[1]
                while (start_us := start_us + step_us) <= last_us:
                    yield scene.picture()
                    inspector.open(round(start_us), window[1], selection)
                    draw(scene)
                yield scene.picture()

        def counted() -> Iterator[NDArray[np.uint8]]:
            for k, picture in enumerate(itertools.islice(pictures(), FRAMES)):
                if self._ended:
                    raise JobCancelled
                loop.call_soon_threadsafe(self._show_progress, k / FRAMES)
                yield picture

        with state:
            state.update({"busy": f"making the {EXPORTS[what][0]}", "progress": 0})
        try:
            with suppress(JobCancelled), panel.errors_shown("export"):
                write = partial(save_film, counted(), fps=FPS)
                async with panel.device_lock:
                    content = await panel.in_thread(as_bytes, EXPORTS[what][1], write)
                self._give(what, content)
        finally:
            with state:
                state.busy = ""

    def _show_progress(self, share: float) -> None:
        with self._panel.state:
            self._panel.state.progress = round(100.0 * share)

    def _give(self, what: str, content: bytes) -> None:
        name = self._name(what)
        self._panel.server.js_call("page", "download", name, content, EXPORTS[what][2])
        self._panel.show_message(f"{name}: {len(content) / 1e3:,.0f} kB, in the browser's downloads", "success")


def export_state() -> dict[str, Any]:
    """Return the state variable of the downloads: name, text and whether the download takes long."""
    return {"exports": [[name, text, name in FILMS] for name, (text, *_) in EXPORTS.items()]}
