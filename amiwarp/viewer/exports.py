"""Files that the page offers as downloads: images, events and films."""

import itertools
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import View
from amiwarp.compensation.recordings import BlockCompensator
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder
from amiwarp.events.recording import Events
from amiwarp.imaging.export import encode_image, encode_png
from amiwarp.io import RecordingWriter
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.files import NewFile
from amiwarp.io.formats import check_ending
from amiwarp.progress import Progress
from amiwarp.reconstruction.export import save_film
from amiwarp.viewer.clouds import Look, Scene, orbit_lines
from amiwarp.viewer.images import ShownImages
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.window import Knobs, kept

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


# Films of the clouds, and the downloads that a page offers. No file is written on the server.

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


def download_name(recording: str, what: str) -> str:
    """Return the file name of a download. ``recording``: name of the recording, which may be that of a stream."""
    name = re.sub(r"[^\w.+=@-]+", "_", recording)[:60].strip("._-~ ") or "recording"
    return f"{name}.{what}{EXPORTS[what][1]}"


def write_film(
    path: Path, inspector: Inspector, look: Look, view: View, progress: Progress, *, what: str,
    against: Knobs | None, with_orbit: bool, speed: float,
) -> None:  # fmt: skip
    """Write a film of the clouds to a new file.

    ``what``: "turntable" for a camera that moves once around the clouds of the inspector's window, or "film" for a time
    window that moves on from there with ``speed`` times real time. ``against``: parameters of the left cloud; None for
    the recorded events. ``progress`` may raise an error to stop the film.
    """

    def draw(scene: Scene) -> None:
        shown = inspector.show(against=against)
        orbit, column = orbit_lines(inspector, shown)
        lines = (orbit if against is None else column, column)
        scene.show(shown, look, lines if with_orbit else ())

    def pictures() -> Iterator[NDArray[np.uint8]]:
        with closing(Scene(FILM_SIZE)) as scene:
            draw(scene)
            scene.look_from(view, look)
            if what == "turntable":
                yield from scene.turntable(FRAMES)
                return
            span = inspector.loaded.span
            start_us, last_us = float(span.start_us), inspector.recording.events.t_last + 1 - span.length_us
            while (start_us := start_us + 1e6 / FPS * speed) <= last_us:
                yield scene.picture()
                inspector.open(round(start_us), span.length_us)
                draw(scene)
            yield scene.picture()

    def counted() -> Iterator[NDArray[np.uint8]]:
        for k, picture in enumerate(itertools.islice(pictures(), FRAMES)):
            progress(f"making the {EXPORTS[what][0]}", k / FRAMES)
            yield picture

    save_film(counted(), path, fps=FPS)
