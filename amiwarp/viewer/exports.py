"""Files that the page offers as downloads: pictures, images, events, calibrations and films."""

from __future__ import annotations

import asyncio
import itertools
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.choices import Axis, Colour, View
from amiwarp.compensation.recordings import BlockCompensator
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.events import Events
from amiwarp.imaging.export import encode_image, encode_png
from amiwarp.io import RecordingWriter
from amiwarp.io.atomic_output import NewFile
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.formats import check_ending
from amiwarp.reconstruction.export import save_film
from amiwarp.viewer.clouds import Look, Scene, orbit_lines
from amiwarp.viewer.images import ImageKind, make_images
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.jobs import JobCancelled
from amiwarp.viewer.window import kept

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.viewer.images import ShownImages
    from amiwarp.viewer.panel import Panel


# Files that the page offers as downloads: events of the window, images and calibrations.

BLOCK = 1 << 20
"""Number of events that are written at a time."""
IMAGE_SUFFIXES = (".png", ".tif", ".npy")
"""Suffixes of image files: colours as on the page, values as float32, values as an array."""


def as_bytes(suffix: str, write: Callable[[Path], object]) -> bytes:
    """Return the content of a file that ``write`` writes to the path that it is given, which ends in ``suffix``."""
    with tempfile.TemporaryDirectory(prefix="amiwarp-", ignore_cleanup_errors=True) as folder:
        path = Path(folder) / f"download{suffix}"
        write(path)
        return path.read_bytes()


def write_events(inspector: Inspector, path: Path, *, compensated: bool) -> int:
    """Write all selected events of the window to a new native file, and return their number.

    Compensated events get sub-pixel coordinates, with the parameters set on the page. A window with more events than
    the page reads is written completely. Raises :class:`AmiwarpError` if the file exists.
    """
    recording, span, encoder = inspector.recording, inspector.loaded.span, inspector.adjusted_encoder
    width, height = recording.events.size
    first_us = max(span.start_us, encoder.coverage[0])
    last_us = min(span.start_us + span.length_us, encoder.coverage[1])
    metadata = {**recording.metadata, **({"compensated_with": inspector.knobs.model} if compensated else {})}
    with RecordingWriter(
        path, width=width, height=height, camera=inspector.camera, prism=recording.prism, metadata=metadata,
        encoder=_cut(encoder, first_us, last_us) if inspector.has_encoder else None,
    ) as writer:  # fmt: skip
        compensator = BlockCompensator(inspector.model, encoder, first_us, last_us, inspector.device)
        for block in _selected_blocks(inspector):
            if compensated:
                moved, inside = compensator(block, all_cores=True)
                writer.append(moved, inside=inside)
            else:
                writer.append(block)
        return len(writer)


def write_image(images: ShownImages, path: Path, *, before: bool = False) -> None:
    """Write one of the images to a new file: .png with the page's colours, .tif or .npy with its values.

    ``before``: write the first image instead of the second. A .tif of two polarities has two pages, OFF and ON. Raises
    :class:`AmiwarpError` for another suffix, if the file exists, or if there is no such image.
    """
    from PIL import Image

    values = images.before if before else images.after
    if values is None:
        raise AmiwarpError(f"there is no image of {images.kind.value} before compensation; export the compensated one")
    ending = check_ending(path, "images are written", IMAGE_SUFFIXES)
    with NewFile(path) as new:
        if ending == ".png":
            encode_png(new.part, images.scale.rgb(values))
        elif ending == ".npy":
            with open(new.part, "wb") as file:
                np.save(file, np.asarray(values, np.float32))
        else:
            pages = values if values.ndim == 3 else values[None]
            first, *more = (Image.fromarray(np.asarray(page, np.float32)) for page in pages)
            encode_image(new.part, first, "TIFF", save_all=bool(more), append_images=more)


def _selected_blocks(inspector: Inspector) -> Iterator[Events]:
    """Yield all selected events of the window, in blocks.

    The noise filter of a block sees the last events of the block before it.
    """
    window, hot = inspector.loaded, inspector.hot if inspector.selection.hide_hot else None
    noise_us, last = inspector.selection.noise_us or 0, None
    for block in filter(len, _blocks(inspector)):
        events = block if last is None else Events.concatenate([last, block])
        chosen = kept(inspector.recording, events, inspector.selection, window.region, hot)[-len(block) :]
        yield block if chosen.all() else block[chosen]
        last = events[int(np.searchsorted(events.t, block.t[-1] - noise_us)) :] if noise_us else None


def _blocks(inspector: Inspector) -> Iterator[Events]:
    """Yield all events of the window, in blocks."""
    source, span = inspector.recording.events, inspector.loaded.span
    end_us = span.start_us + span.length_us
    if span.count == len(span.events):
        yield span.events
    elif isinstance(source, FileEvents):  # can only be read from its start
        for block in source.blocks():
            first, stop = np.searchsorted(block.t, (span.start_us, end_us))
            yield block[first:stop]
            if stop < len(block):
                return
    else:
        stop = source.find(end_us)
        for start in range(source.find(span.start_us), stop, BLOCK):
            yield source.slice(start, min(start + BLOCK, stop))


def _cut(encoder: Encoder, first_us: int, last_us: int) -> Encoder:
    """Return the samples of an encoder that cover a time span, with one more on each side."""
    first = max(int(np.searchsorted(encoder.t, first_us + encoder.clock_offset_us)) - 2, 0)
    stop = int(np.searchsorted(encoder.t, last_us + encoder.clock_offset_us)) + 2
    t, pulses = encoder.t[first:stop], encoder.index_t
    if pulses is not None:
        pulses = pulses[(pulses >= t[0]) & (pulses <= t[-1])]
    return Encoder(t, encoder.angle[first:stop], encoder.clock_offset_us, pulses)


# Downloads of a page: pictures, images, events, the calibration and films. No file is written on the server.

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
