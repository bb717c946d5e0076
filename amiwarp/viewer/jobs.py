"""Work of the inspector's page in threads: phase, calibration, live stream as a recording, and downloads."""

import asyncio
import contextlib
import logging
import math
import re
import weakref
from collections.abc import Callable, Coroutine, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.calib import Calibration, Settings, calibrate
from amiwarp.calib.settings import AUTO
from amiwarp.choices import View
from amiwarp.compensation.recordings import BlockCompensator
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import Encoder, rpm_between
from amiwarp.events.recording import Events, Recording
from amiwarp.imaging.export import encode_image
from amiwarp.io import RecordingWriter
from amiwarp.io.file_scan import FileEvents
from amiwarp.io.files import NewFile
from amiwarp.io.formats import check_ending
from amiwarp.live.stream.session import RecentEvents
from amiwarp.optics.models import ExactModel, alternatives
from amiwarp.reconstruction.picture import save_film
from amiwarp.tasks import Progress, silent
from amiwarp.viewer.drawing import Look, Scene, ShownImages, caption, select_part, shown_lines
from amiwarp.viewer.inspector import CURVE_HALF_WIDTH, MOST_SEARCHED, Inspector, Knobs, Source, busiest, size_name

# Work of one page: its threads, jobs and updates, and the messages about their errors.

MOST_IN_FLIGHT = 8
"""Largest number of messages to the page that are unsent; while more are waiting, nothing is computed."""
WAIT_S = 0.02
"""Interval between two checks of the number of unsent messages [s]."""
PROGRESS_S = 0.1
"""Shortest interval between two progress messages of a job [s].

The calibration of a small recording causes eighty per second, and the page would draw each of them.
"""
_CUDA_LOCK = asyncio.Lock()
"""Lock for all tabs: Warp's CUDA calls may run in only one thread at a time."""
QUICK = {**dict.fromkeys(("window", "suggestion", "state", "knobs"), ("clouds", "images")), "look": ("clouds",)}
SLOW = ("curve", "picture", "statistics")
"""Updates that are made at once, with the parts of the page that wait for them, and updates that take longer."""


class JobCancelled(Exception):
    """Raised to stop work whose result is no longer needed."""


class JobProgress:
    """Progress callback of a job in a thread. It stops the job once ``cancelled`` is set.

    It holds the page by a weak reference, because NLopt never releases its callbacks.
    """

    def __init__(self, show: Callable[[str, float], None]) -> None:
        """``show``: method of the page that shows the name of a step and the finished share, 0 to 1."""
        self.cancelled = False
        self.ended = False
        """Whether a film ends with the pictures made so far."""
        self._show, self._loop, self._last_s = weakref.WeakMethod(show), asyncio.get_running_loop(), -math.inf

    def __call__(self, what: str, share: float) -> None:
        if self.cancelled or self._show() is None:
            raise JobCancelled
        if (now := self._loop.time()) >= self._last_s + PROGRESS_S:
            self._last_s = now
            self._loop.call_soon_threadsafe(self._pass_on, what, share)

    def _pass_on(self, what: str, share: float) -> None:
        if (show := self._show()) is not None and not self.cancelled:
            show(what, share)


class PageWork:
    """What is computed for one page, in threads, and the messages about it.

    Updates run one after the other. If a slider moves several times meanwhile, only its last position is used. What
    waits for an update is marked on the page. Nothing is computed while the page does not keep up with the messages.
    """

    def __init__(self, server: Any, device: Any) -> None:
        self.server, self.state = server, server.state
        self.buffers_lock = asyncio.Lock()
        """Lock of the inspector's buffers on the device, which only one thread may use at a time."""
        self.device_lock: Any = _CUDA_LOCK if "cuda" in str(device) else contextlib.nullcontext()
        self._quick_requests: set[str] = set()
        self._slow_requests: set[str] = set()
        self._doing: set[str] = set()
        self._quick: asyncio.Task[None] | None = None
        self._slow: asyncio.Task[None] | None = None
        self._jobs: set[asyncio.Task[None]] = set()
        self._error_source = ""
        # A tab's own pool, which ends with the tab: calibration or film; curve or picture; quick updates.
        self._threads = ThreadPoolExecutor(3, "amiwarp-tab")

    async def make(self, todo: set[str]) -> None:
        """Make a set of quick updates."""
        raise NotImplementedError

    async def make_slow(self, name: str) -> None:
        """Make one slow update."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop all work. A thread ends when its current work is done."""
        for task in self._jobs:
            task.cancel()
        self._threads.shutdown(wait=False, cancel_futures=True)

    def request(self, *what: str) -> None:
        """Request quick updates: "window", "knobs", "look", "suggestion" or "state"."""
        self._quick_requests.update(what)
        self._show_pending()
        if self._quick is None or self._quick.done():
            self._quick = self.start_job(self._update())

    def request_slow(self, *what: str) -> None:
        """Request updates that run in a thread after all quick updates: "curve", "picture" or "preparation"."""
        self._slow_requests.update(what)
        self._show_pending()
        if self._slow is None or self._slow.done():
            self._slow = self.start_job(self._update_slowly())

    async def until_drawn(self) -> None:
        """Wait until no quick update is pending."""
        while self._quick is not None and not self._quick.done():
            await asyncio.sleep(0.005)

    def start_job(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Run a job until it ends or the browser tab is closed."""
        self._jobs.add(task := asyncio.get_running_loop().create_task(work))
        task.add_done_callback(self._ended)
        return task

    async def in_thread(self, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Call ``work`` in one of the browser tab's threads, and return its result."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, partial(work, *args, **options))

    def say(self, text: str, severity: str = "info") -> None:
        """Show a message."""
        with self.state:
            self.state.update({"message": text, "severity": severity})

    @contextlib.contextmanager
    def errors_shown(self, what: str) -> Iterator[None]:
        """Show errors of the enclosed code as a message, until the same kind of action (``what``) succeeds."""
        try:
            yield
        except (AmiwarpError, OSError) as error:
            self._error_source = what
            self.state.update({"message": str(error), "severity": "error"})
        else:
            if self.state.severity == "error" and self._error_source == what:
                self.state.update({"message": "", "severity": "info"})

    def _show_pending(self) -> None:
        """Show which parts of the page wait for an update."""
        quick = self._quick_requests | self._doing
        parts = {part for what in quick for part in QUICK.get(what, ())} | (self._slow_requests | self._doing) & {*SLOW}
        self.state.updating = sorted(parts)

    def _ended(self, task: asyncio.Task[None]) -> None:
        self._jobs.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            logging.getLogger(__name__).error("the page's work failed", exc_info=error)
            text = f"internal error: {error or type(error).__name__}; the log of the server shows the details"
            self.say(text, "error")

    async def _update(self) -> None:
        while self._quick_requests:
            while (page := self.server.protocol) is not None and page.network_monitor.pending > MOST_IN_FLIGHT:
                await asyncio.sleep(WAIT_S)
            todo, self._quick_requests = self._quick_requests, set()
            async with self._done(todo), self.device_lock, self.buffers_lock:
                await self.make(todo)
            await asyncio.sleep(0)

    async def _update_slowly(self) -> None:
        while self._slow_requests:
            await self.until_drawn()
            name = min(self._slow_requests)  # in alphabetical order: the curve first, the preparation last
            self._slow_requests.discard(name)
            async with self._done({name}), self.device_lock:
                with self.errors_shown(name):
                    await self.make_slow(name)

    @contextlib.asynccontextmanager
    async def _done(self, todo: set[str]) -> Any:
        """Mark updates as being made, and send the state to the browser when they are made."""
        self._doing |= todo
        try:
            yield
        finally:
            self._doing -= todo
            with self.state:
                self._show_pending()


# Estimate of the prism's phase at first sight, so that the page opens with compensated events.

COARSE = 24
"""Number of phases of the first search, over one turn."""
FINER = (3.0, 12.0)
"""Divisors of the step of the first search, for the steps of the second and the third one."""
LEAST_GAIN = 1.3
"""Smallest ratio of the sharpness at the best phase to that at the median phase. It is 2 to 3 for scenes, and 1.1 for
random events."""


def estimate_phase(inspector: Inspector) -> bool:
    """Set an unknown phase to that with the highest sharpness of the time window; return whether there is one.

    A phase that is known, from a calibration or by hand, is kept. So is any phase if the prism does not rotate, or if
    no phase sharpens the image.
    """
    if inspector.sources["phase"] is not Source.ASSUMED or not math.isfinite(inspector.turn_us):
        return False
    measure = _searched(inspector).sharpness_meter()
    sharpness: dict[float, float] = {}

    def best(phases: list[float]) -> float:
        for phase in phases:
            if phase not in sharpness:
                sharpness[phase] = measure(replace(inspector.knobs, phase=phase))
        return max(sharpness, key=lambda phase: sharpness[phase])

    step = math.tau / COARSE
    found = best((step * np.arange(COARSE) - math.pi).tolist())
    usual = float(np.median([*sharpness.values()]))
    for share in FINER:
        found = best([found + k * step / share for k in (-2, -1, 1, 2)])
    if sharpness[found] < max(measure(None), LEAST_GAIN * usual):
        return False
    inspector.set(replace(inspector.knobs, phase=found))
    inspector.sources["phase"] = Source.ESTIMATED
    return True


def _searched(inspector: Inspector) -> Inspector:
    """Return the inspector, or one of the part of a large sensor with most events, so that the search stays short."""
    width, height = inspector.recording.events.size
    if width * height <= MOST_SEARCHED:
        return inspector
    window = inspector.loaded
    part = select_part(inspector, window, busiest(inspector.counts(window, None)))
    small = Inspector(part.recording, device=inspector.device)
    small.set(inspector.knobs)
    small.window = part.start_us, part.length_us
    return small


# Calibration on what the inspector shows, and the sharpness over two parameters.

SURFACE_POINTS = (21, 37)
"""Number of values of the first and the second parameter of a cost surface."""


@dataclass(frozen=True, eq=False)
class FoundCalibration:
    """Result of a calibration on the shown events, which nobody has accepted yet."""

    calibration: Calibration
    """The calibration, of the whole camera."""
    scope: str
    """The events that it used, for the page."""
    before: float
    """Sharpness of the shown region as recorded."""
    current: float
    """Sharpness of the shown region with the inspector's parameters at the end of the calibration."""
    after: float
    """Sharpness of the shown region with the calibrated parameters."""


def calibrated_events(inspector: Inspector, *, whole: bool = False) -> tuple[Recording, str]:
    """Return the events that :func:`find_calibration` uses, and a description of them for the page."""
    if whole:
        return inspector.recording, f"the whole recording, {len(inspector.recording.events):,} events"
    part = select_part(inspector, inspector.loaded, inspector.loaded.region)
    s, start_s = inspector.selection, (part.start_us - inspector.recording.events.t_first) * 1e-6
    kind, end_s = "" if s.polarity is None else ("OFF ", "ON ")[s.polarity], start_s + part.length_us * 1e-6
    texts = [f"{len(part.recording.events):,} {kind}events from {start_s:.3f} s to {end_s:.3f} s"]
    if s.region is not None:
        left, top, right, bottom = s.region
        texts.append(f"x {left} to {right - 1}, y {top} to {bottom - 1} px")
    texts += ["without hot pixels"] if s.hide_hot else []
    texts += [f"without background activity ({s.noise_us * 1e-3:g} ms)"] if s.noise_us is not None else []
    return part.recording, ", ".join(texts)


def find_calibration(
    inspector: Inspector, settings: Settings | None = None, *, whole: bool = False, progress: Progress | None = None
) -> FoundCalibration:
    """Calibrate on the events of the window and the selection, or on the whole recording as ``amiwarp calibrate`` does.

    Without an encoder, the search starts at the speed set on the page. Raises :class:`AmiwarpError` if these events
    cannot determine the parameters.
    """
    (recording, scope), rpm = calibrated_events(inspector, whole=whole), inspector.knobs.rpm
    wedge = ExactModel.NAME in alternatives(inspector.knobs.model)
    settings = settings or Settings(model=AUTO if wedge else inspector.knobs.model)
    if rpm and not inspector.has_encoder:
        settings = replace(settings, start={"rpm": rpm, **settings.start})
    found = calibrate(recording, settings, device=inspector.device, progress=progress)
    if not whole:
        found = replace(found, camera=inspector.camera)
    sharpness = inspector.sharpness_meter()
    values = (sharpness(each) for each in (None, inspector.knobs, inspector.knobs_of(found)))
    return FoundCalibration(found, scope, *values)


@dataclass(frozen=True, eq=False)
class CostSurface:
    """Sharpness of the shown region over two parameters, with all others fixed."""

    names: tuple[str, str]
    """Names of the parameters along the columns and along the rows."""
    values: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Values of these parameters, in their units, shapes ``(columns,)`` and ``(rows,)``."""
    sharpness: NDArray[np.float64]
    """Sharpness, shape ``(rows, columns)``."""


def cost_surface(
    inspector: Inspector, *, points: tuple[int, int] = SURFACE_POINTS, progress: Progress | None = None
) -> CostSurface:
    """Return the sharpness over the two parameters that matter most.

    These are the size, from 0 to twice its value, and phase, over one turn about its value. Without an encoder, they
    are speed and size; with a depth map, clock offset and phase. ``points``: numbers of their values. The call may run
    in a thread; ``progress`` may raise an error to stop it.
    """
    progress, current = progress or silent, inspector.knobs
    sharpness = inspector.sharpness_meter()
    size = size_name(current.model)
    sizes = np.linspace(0.0, 2.0 * (current.value(size) or inspector.nominal_apex or CURVE_HALF_WIDTH[size]), points[0])
    if inspector.depth is not None:  # there is no one size
        width, size = CURVE_HALF_WIDTH["clock_offset"], "clock_offset"
        sizes = current.clock_offset + np.linspace(-width, width, points[0])
    if inspector.has_encoder:
        names, values = (size, "phase"), (sizes, current.phase + np.linspace(-math.pi, math.pi, points[1]))
    else:
        width = CURVE_HALF_WIDTH["rpm"]
        names, values = (size, "rpm"), (sizes, current.rpm + np.linspace(-width, width, points[1]))
    out = np.empty((len(values[1]), len(values[0])))
    for row, second in enumerate(values[1]):
        progress(f"sharpness over {names[0]} and {names[1]}", row / len(out))
        for column, first in enumerate(values[0]):
            changes: dict[str, Any] = {names[0]: float(first), names[1]: float(second)}
            out[row, column] = sharpness(current.with_values(changes))
    return CostSurface(names, values, out)


# Live stream as the inspector sees it: its last seconds as a recording, and figures about it.


@dataclass(frozen=True)
class LiveFigures:
    """Figures about a live stream, for the page."""

    connected: bool
    """Whether events arrive."""
    problem: str
    """Why no events arrive; empty if they do."""
    no_angles: str
    """Why no angles of the prism arrive; empty if they do, or if no events arrive either."""
    rate_mev_s: float
    """Rate of the received events [million events/s]."""
    latency_ms: float
    """Time since the latest events arrived [ms]: the age of what is shown, if it is shown now."""
    turn_share: float
    """Share of a turn of the prism that the kept events cover, 0 to 1."""
    dropped: int
    """Number of events that were dropped because this computer was too slow."""
    late: int
    """Number of events that arrived out of order and got a later time."""
    rpm: float | None
    """Measured speed of the prism in the last turn of the shown events [turns/min]; None if it is unknown."""
    message: str
    """Latest message of the source or of the controller; empty if there was none."""
    segment: int = 1
    """Number of the shown segment: a new one begins when the source comes back, with a clock of its own."""


class LiveSource:
    """Function that returns the last seconds of a stream as a recording, with figures about the stream."""

    def __init__(self, recent: RecentEvents, messages: Sequence[str]) -> None:
        """Start with events of at least one turn. ``messages`` grows while the stream is followed.

        Raises :class:`AmiwarpError` if there are fewer events.
        """
        first = recent.recording()
        if first is None:
            raise AmiwarpError("the stream has delivered less than one full turn; wait for one")
        self._recent, self._messages, self._last = recent, messages, first

    def __call__(self) -> Recording:
        """Return the latest events of at least one turn."""
        self._last = self._recent.recording() or self._last
        return self._last

    def figures(self) -> LiveFigures:
        """Return the figures of this moment."""
        recent, status, problem = self._recent, self._recent.status, self._recent.silence
        last, encoder = self._last.events.t_last, self._last.encoder
        turn_us = 2e6 if encoder is None else min(2e6, 60e6 / max(abs(encoder.rpm), 1.0))
        rpm = None if encoder is None else rpm_between(encoder, round(last - turn_us), last)
        return LiveFigures(
            not problem, problem, "" if problem else recent.encoder_silence, 0.0 if problem else status.rate_mev_s,
            1e3 * recent.age_s, recent.turn_share, status.dropped, status.late, rpm,
            self._messages[-1] if self._messages else "", recent.segment,
        )  # fmt: skip


# Files that the page offers as downloads: images, events and films.

BLOCK = 1 << 20
"""Number of events that are written at a time."""
COLUMNS = ("t", "x", "y", "p", "theta", "x_compensated", "y_compensated")
"""Columns of a table of events: time [us], pixel, polarity, prism angle [rad] and compensated place [px]."""


def write_events(inspector: Inspector, path: Path, *, compensated: bool) -> int:
    """Write all selected events of the window to a new native file, and return their number.

    Compensated events get sub-pixel coordinates, with the parameters set on the page. Camera, prism and encoder that
    the recording lacks are those set on the page. A window with more events than the page reads is written completely.
    Raises :class:`AmiwarpError` if the file exists.
    """
    recording, span, encoder = inspector.recording, inspector.loaded.span, inspector.adjusted_encoder
    width, height = recording.events.size
    first_us = max(span.start_us, encoder.coverage[0])
    last_us = min(span.start_us + span.length_us, encoder.coverage[1])
    metadata = {**recording.metadata, **({"compensated_with": inspector.knobs.model} if compensated else {})}
    with RecordingWriter(
        path, width=width, height=height, camera=inspector.camera, prism=inspector.nominal_prism, metadata=metadata,
        encoder=_cut(encoder, first_us, last_us) if inspector.has_encoder or inspector.knobs.rpm else None,
    ) as writer:  # fmt: skip
        compensator = BlockCompensator(inspector.model, encoder, first_us, last_us, inspector.device)
        for block in _selected_blocks(inspector):
            if compensated:
                moved, inside = compensator(block, all_cores=True)
                writer.append(moved, inside=inside)
            else:
                writer.append(block)
        return len(writer)


def write_table(inspector: Inspector, path: Path) -> None:
    """Write all selected events of the window, with :data:`COLUMNS`, to a new .csv or .npz file.

    Raises :class:`AmiwarpError` for another suffix, or if the file exists.
    """
    ending = check_ending(path, "tables are written", (".csv", ".npz"))
    encoder, knobs = inspector.adjusted_encoder, inspector.knobs

    def table(e: Events) -> tuple[NDArray[Any], ...]:
        theta, moved = np.mod(encoder.angle_at(e.t), math.tau), inspector.positions(e, knobs)
        return e.t, e.x, e.y, e.p, theta, moved[:, 0], moved[:, 1]

    tables = map(table, _selected_blocks(inspector))
    with NewFile(path) as new, open(new.part, "wb") as file:
        if ending == ".npz":
            columns: dict[str, Any] = {
                name: np.concatenate(parts) for name, *parts in zip(COLUMNS, *tables, strict=True)
            }
            width, height = inspector.recording.events.size
            np.savez_compressed(file, width=width, height=height, **columns)
            return
        file.write((",".join(COLUMNS) + "\n").encode())
        for each in tables:
            np.savetxt(file, np.column_stack(each), fmt="%d,%d,%d,%d,%.6f,%.3f,%.3f")


def write_image(images: ShownImages, path: Path) -> None:
    """Write the values of the second image to a new .tif file, float32; two polarities on two pages, OFF and ON.

    Raises :class:`AmiwarpError` for another suffix, or if the file exists.
    """
    from PIL import Image

    check_ending(path, "values of images are written", (".tif",))
    with NewFile(path) as new:
        pages = images.after if images.after.ndim == 3 else images.after[None]
        first, *more = (Image.fromarray(np.asarray(page, np.float32)) for page in pages)
        encode_image(new.part, first, "TIFF", save_all=bool(more), append_images=more)


def _selected_blocks(inspector: Inspector) -> Iterator[Events]:
    """Yield all selected events of the window, in blocks.

    The noise filter of a block sees the last events of the block before it.
    """
    noise_us, last = inspector.selection.noise_us or 0, None
    for block in filter(len, _blocks(inspector)):
        events = block if last is None else Events.concatenate([last, block])
        chosen = inspector.kept(events, inspector.selection, inspector.loaded.region)[-len(block) :]
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
"""Number of pictures of a turning film, and pictures per second."""
FILM_SIZE = (1280, 560)
"""Width and height of a film [px]."""
EXPORTS = {
    "picture": ("picture", ".png"), "image": ("images", ".png"), "values": ("image values", ".tif"),
    "events": ("events", ".h5"), "compensated": ("compensated events", ".h5"), "csv": ("events, CSV", ".csv"),
    "npz": ("events, NPZ", ".npz"), "calibration": ("calibration", ".json"), "turntable": ("film, turning", ".mp4"),
    "film": ("film from here", ".mp4"),
}  # fmt: skip
"""Downloads by name: text of the button, and suffix."""
FILMS = ("turntable", "film")
"""Downloads that take long."""


def download_name(recording: str, what: str) -> str:
    """Return the file name of a download. ``recording``: name of the recording, which may be that of a stream."""
    name = re.sub(r"[^\w.+=@-]+", "_", recording)[:60].strip("._-~ ") or "recording"
    suffix = EXPORTS[what][1]
    return f"{name}{suffix}" if suffix == f".{what}" else f"{name}.{what}{suffix}"


def write_film(
    path: Path, inspector: Inspector, look: Look, view: View, progress: Progress, *, what: str,
    against: Knobs | None = None, with_orbit: bool = True, speed: float, ended: Callable[[], bool] = lambda: False,
) -> int:  # fmt: skip
    """Write a film of the clouds to a new file, picture by picture, and return their number.

    ``what``: "turntable" for a camera that moves once around the clouds of the inspector's window, or "film" for a time
    window that moves on from there with ``speed`` times real time, to the end of the recording or until ``ended``
    returns True. A time without events keeps the picture before it. ``against``: parameters of the left cloud; None for
    the recorded events. ``progress`` may raise an error to stop the film; no file is left then.
    """
    inspector, turns = inspector.copy(), what == "turntable"
    span, step_us = inspector.loaded.span, 1e6 / FPS * speed
    last_us = inspector.recording.events.t_last + 1 - span.length_us
    frames = FRAMES if turns else 1 + max(0, math.floor((last_us - span.start_us) / step_us))

    def draw(scene: Scene) -> None:
        shown = inspector.show(against=against)
        lines = shown_lines(inspector, shown, look.axis, against) if with_orbit else ()
        scene.show(shown, look, lines, caption(inspector, shown))

    def pictures() -> Iterator[NDArray[np.uint8]]:
        with contextlib.closing(Scene(FILM_SIZE)) as scene:
            draw(scene)
            scene.look_from(view, look)
            turning = scene.turntable(frames)
            for k in range(frames):
                if k and ended():
                    return
                progress(f"making the {EXPORTS[what][0]}, {k / FPS:.0f} of {frames / FPS:.0f} s", k / frames)
                if k and not turns:
                    with contextlib.suppress(AmiwarpError):  # there are no events at this time
                        inspector.open(span.start_us + round(k * step_us), span.length_us)
                        draw(scene)
                yield next(turning) if turns else scene.picture()

    return save_film(pictures(), path, fps=FPS)
