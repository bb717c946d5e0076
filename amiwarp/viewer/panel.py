"""Page of the inspector: passes input from the widgets to the inspector, and the inspector's results to the page.

Each browser tab has one panel with its own inspector, scene and state. Slow work runs in threads. If a slider moves
several times meanwhile, only its last position is used.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.errors import AmiwarpError
from amiwarp.plotting.figures import Images
from amiwarp.reconstruction.choices import Tone
from amiwarp.reconstruction.export import tones
from amiwarp.reconstruction.picture import reconstruct
from amiwarp.viewer.choices import Axis, Colour, View
from amiwarp.viewer.clicks import ClickDetector
from amiwarp.viewer.cloud_scene import ORBIT_COLOUR, Look, Scene
from amiwarp.viewer.exports import export_path
from amiwarp.viewer.frames import wait_until_page_keeps_up
from amiwarp.viewer.jobs import CalibrationJob, Playback
from amiwarp.viewer.layout import KEYS, NAMES, UNITS, build
from amiwarp.viewer.message_filter import finite
from amiwarp.viewer.page_values import event_text, initial_state, jpeg, percent_of_range, polyline, source_state
from amiwarp.viewer.parameters import Selection

if TYPE_CHECKING:
    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.window import DisplayedWindow

_CUDA_LOCK = asyncio.Lock()
"""Lock for all tabs: Warp's CUDA calls may run in only one thread at a time."""


class Panel:
    """Panel that connects the page of one browser tab with its inspector. Call :meth:`close` when the tab is closed."""

    def __init__(self, server: Any, inspector: Inspector, folder: Path) -> None:
        """Build the page on a new trame server; exports are written to ``folder``."""
        self.server, self.state, self.inspector, self.folder = server, server.state, inspector, folder
        self.scene = Scene()
        self.device_lock: Any = _CUDA_LOCK if "cuda" in str(inspector.device) else contextlib.nullcontext()
        self.calibration_job, self.playback = CalibrationJob(self), Playback(self)
        self._quick_requests: set[str] = set()
        self._slow_requests: set[str] = set()
        self._quick: asyncio.Task[None] | None = None
        self._slow: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._shown: DisplayedWindow | None = None
        self._picked: int | None = None
        self._error_source = ""
        self._threads = ThreadPoolExecutor(2, "amiwarp-tab")  # calibration or film; curve or picture
        self.state.update(initial_state(inspector))
        self._show_knobs()
        self.open_window()
        build(server, self)
        self._clicks = ClickDetector(self.scene.plotter, self._pick)
        for what, names in {
            "knobs": NAMES, "view": ("view",), "window": ("start_ms", "length_ms", "polarity", "region_x", "region_y",
            "hide_hot"), "look": ("colour", "axis", "point_size", "opacity", "dark", "overlaid", "orbit_shown"),
        }.items():  # fmt: skip
            self.state.change(*names)(lambda what=what, **_: self.request(what))
        for call in (partial(self.request, "knobs"), self.slider_released):
            self.state.change("model")(lambda call=call, **_: call())
        self.request_slow("curve", "picture")
        if inspector.latest is not None:
            self.playback.toggle()

    def close(self) -> None:
        """Stop all work of the browser tab. A thread ends when its current work is done."""
        self.calibration_job.cancel()
        self.playback.end()
        for task in [*self._tasks, *filter(None, [self._quick, self._slow])]:
            task.cancel()
        self._threads.shutdown(wait=False, cancel_futures=True)
        self._clicks.close()
        self.scene.close()

    # called by the page

    def slider_released(self) -> None:
        """Update the slow parts of the page after a slider was released."""
        self.request_slow("curve", "picture")

    def typed(self, name: str, text: str) -> None:
        """Set the value that a user typed into a number field."""
        if name not in (*NAMES, "start_ms", "length_ms", "turns"):
            return
        try:
            value = finite(text)
        except ValueError:
            self.show_message(f"{text!r} is not a number; give a number such as 1.5", "error")
            return
        if name == "turns":
            name, value = "length_ms", value * float(self.state.turn_ms)
        self.state[name] = round(value, 4)
        if name in NAMES:
            self.select_curve(name)
            self.request("knobs")
        else:
            self.request("window")
        self.slider_released()

    def select_curve(self, name: str) -> None:
        """Select the parameter over which the sharpness curve is drawn."""
        if name in NAMES:
            self.state.knob = name

    def key(self, key: str) -> None:
        """Run the action of a key that was pressed outside of a text field."""
        for known, (name, *given), _ in KEYS:
            if key == known:
                getattr(self, name)(*given)

    def toggle(self, name: str) -> None:
        """Invert a state variable that is true or false."""
        self.state[name] = not self.state[name]

    def toggle_axis(self) -> None:
        """Switch the third axis between angle and time."""
        angle, time = Axis.ANGLE.value, Axis.TIME.value
        self.state.axis = time if self.state.axis == angle else angle

    def look_from(self, view: str) -> None:
        """Set the view, and reset a camera that the mouse has moved."""
        self.state.view = view
        self.request("view")

    def step(self, turns: float) -> None:
        """Move the time window by one turn, forward (1) or back (-1).

        If the prism does not rotate, the window moves by its own length.
        """
        if turns not in (-1, 1):
            return
        turn = self.inspector.turn_us * 1e-3
        self.move(float(self.state.start_ms) + turns * (turn if math.isfinite(turn) else float(self.state.length_ms)))
        self.request("window")
        self.slider_released()

    def play(self) -> None:
        self.playback.toggle()

    def calibrate(self) -> None:
        self.calibration_job.toggle()

    def accept(self) -> None:
        """Set the prism's parameters to the result of the calibration."""
        if self.calibration_job.found is not None:
            with self.errors_shown("knobs"):
                self.inspector.accept(self.calibration_job.found)
            self.discard()
            self._show_knobs()
            self.request("knobs")
            self.request_slow("curve", "picture")

    def discard(self) -> None:
        self.calibration_job.found, self.state.found = None, ""

    def save(self) -> None:
        """Write a calibration file with the current parameters."""
        with self.errors_shown("export"):
            path = self.path("calibration", ".json")
            self.inspector.as_calibration().save(path)
            self.show_message(f"{path}: written", "success")

    def save_picture(self) -> None:
        """Write a picture of the event clouds."""
        with self.errors_shown("export"):
            path = self.path("", ".png")
            self.scene.save(path)
            self.show_message(f"{path}: written", "success")

    # called by jobs

    def request(self, *what: str) -> None:
        """Request quick updates of the page: "window", "knobs", "look" or "view"."""
        self._quick_requests.update(what)
        if self._quick is None:
            self._quick = self._task(self._work())

    def request_slow(self, *what: str) -> None:
        """Request updates that run in a thread after all quick updates: "curve" or "picture"."""
        self._slow_requests.update(what)
        if self._slow is None:
            self._slow = self._task(self._work_slowly())

    async def wait_until_drawn(self) -> None:
        """Wait until no quick update is pending."""
        while self._quick is not None:
            await asyncio.sleep(0.005)

    def start_job(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a job until it ends or the browser tab is closed."""
        self._tasks.add(task := self._task(work))
        task.add_done_callback(self._tasks.discard)

    async def in_thread(self, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """Call ``work`` in one of the browser tab's threads, and return its result."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, partial(work, *args, **options))

    def show_message(self, text: str, severity: str) -> None:
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

    def move(self, start_ms: float) -> bool:
        """Move the time window to a start [ms], limited to the recording. Return whether the window is at the end."""
        last = max(0.0, float(self.state.whole_ms) - float(self.state.length_ms))
        self.state.start_ms = round(min(max(start_ms, 0.0), last), 3)
        return start_ms >= last

    def renew(self) -> None:
        """Take the current events of a live stream, and move the window to their end."""
        with self.errors_shown("stream"):
            self.inspector.renew()
        self.state.update(source_state(self.inspector))
        self.move(float(self.state.whole_ms))
        self.request("window")

    def path(self, what: str, *endings: str) -> Path:
        """Return the path of an export, named by the page's field, else by the recording and ``what``."""
        name = self.inspector.recording.name
        return export_path(self.folder, str(self.state.out or ""), f"{name}.{what}" if what else name, endings)

    def open_window(self) -> None:
        """Read and draw the events of the page's window and selection."""
        s, source = self.state, self.inspector.recording.events
        with self.errors_shown("window"):
            start, length = float(s.start_ms), min(float(s.length_ms), float(s.whole_ms))
            if not length > 0.0:
                raise AmiwarpError(f"a window of {length:g} ms; give a length above 0")
            (left, right), (top, bottom) = (sorted(map(int, s[n])) for n in ("region_x", "region_y"))
            region = (left, top, right, bottom)
            polarity = {"both": None, "ON": 1, "OFF": 0}[s.polarity]
            whole = region == (0, 0, *source.size)
            selection = Selection(polarity, None if whole else region, bool(s.hide_hot))
            self.inspector.open(source.t_first + round(start * 1e3), max(1, round(length * 1e3)), selection)
            s.update({"shown_from": start / s.whole_ms, "shown_part": length / s.whole_ms})
            self._picked = None
        with self.errors_shown("knobs"):
            self._draw()

    # internal

    def _task(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        task.add_done_callback(self._ended)
        return task

    def _ended(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            logging.getLogger(__name__).error("the page's work failed", exc_info=error)
            text = f"internal error: {error or type(error).__name__}; the log of the server shows the details"
            self.show_message(text, "error")

    async def _work(self) -> None:
        try:
            while self._quick_requests:
                await wait_until_page_keeps_up(self.server)
                todo, self._quick_requests = self._quick_requests, set()
                async with self.device_lock:
                    with self.state:
                        self._do(todo)
                await asyncio.sleep(0)
        finally:
            self._quick = None

    def _do(self, todo: set[str]) -> None:
        if "window" in todo:
            self.open_window()
            self.request_slow("curve")
        with self.errors_shown("knobs"):
            if "knobs" in todo:
                rounded = self._knobs()
                values = {name: float(self.state[name]) * UNITS[name] for name in NAMES
                          if self.state[name] != rounded[name]}  # fmt: skip
                self.inspector.set(replace(self.inspector.knobs, model=self.state.model, **values))
            if todo & {"knobs", "look"}:
                self._draw()
            if "view" in todo:
                self.scene.look_from(View(self.state.view), self._look)
        self.server.controller.view_update()

    async def _work_slowly(self) -> None:
        try:
            while self._slow_requests:
                await self.wait_until_drawn()
                name = min(self._slow_requests)  # the curve comes before the picture
                self._slow_requests.discard(name)
                async with self.device_lock:
                    with self.errors_shown(name):
                        await (self._curve() if name == "curve" else self._reconstruct())
                self.state.flush()
        finally:
            self._slow = None

    def _knobs(self) -> dict[str, float]:
        """Return the prism's parameters in the page's units, rounded as the page shows them."""
        return {name: round(getattr(self.inspector.knobs, name) / scale, 4) for name, scale in UNITS.items()}

    def _show_knobs(self) -> None:
        self.state.update({**self._knobs(), "model": self.inspector.knobs.model})

    def _draw(self) -> None:
        shown = self._shown = self.inspector.show()
        self.scene.show(shown, self._look)
        self._mark(shown)
        s, span = self.state, shown.span
        left, top, right, bottom = shown.region
        images = Images(*(i[top:bottom, left:right] for i in (shown.image_before, shown.image_after)))
        s.before, s.after = (jpeg(np.sqrt(np.clip(i / images.top, 0.0, 1.0))) for i in (images.before, images.after))
        read = "" if shown.selected == span.count else f", {shown.selected:,} in the images"
        s.events = f"{span.count:,} events{read}, {len(shown.events):,} drawn"
        gain = shown.sharpness_after / max(shown.sharpness_before, 1e-12)
        s.sharpness = f"{shown.sharpness_before:.3f} → {shown.sharpness_after:.3f} (×{gain:.2f})"
        s.curve_mark = percent_of_range(float(s[s.knob]), float(s.curve_low), float(s.curve_high))
        turn = self.inspector.turn_us
        s.turn_ms = turn * 1e-3 if math.isfinite(turn) else 0.0
        if s.picked:
            s.picked = "" if self._picked is None else event_text(shown, self._picked)

    @property
    def _look(self) -> Look:
        s = self.state
        points = float(s.point_size), float(s.opacity)
        return Look(Colour(s.colour), Axis(s.axis), *points, dark=bool(s.dark), overlaid=bool(s.overlaid))

    def _mark(self, shown: DisplayedWindow) -> None:
        """Draw the orbit of the scene point of the picked event, or of the middle of the region."""
        if not self.state.orbit_shown or self.state.axis != Axis.ANGLE.value:
            self.scene.mark([])
            return
        left, top, right, bottom = shown.region
        middle = np.array([left + right, top + bottom]) / 2.0
        point = middle if self._picked is None else shown.after[self._picked]
        theta, xy = self.inspector.orbit(float(point[0]), float(point[1]))
        still = np.broadcast_to(point, xy.shape)
        orbit, column = (self.scene.box.positions(each, np.degrees(theta)) for each in (xy, still))
        self.scene.mark([(0, orbit, ORBIT_COLOUR), (0 if self.state.overlaid else 1, column, ORBIT_COLOUR)])

    async def _curve(self) -> None:
        s, name = self.state, self.state.knob
        values, scores = await self.in_thread(self.inspector.curve, name)
        if not len(values):
            return
        x = values / UNITS[name]
        s.curve, s.curve_low, s.curve_high = polyline(x, scores), float(x[0]), float(x[-1])
        s.curve_mark = percent_of_range(float(s[name]), s.curve_low, s.curve_high)
        s.curve_text = f"sharpness {scores.min():.3f} to {scores.max():.3f}, best at {x[int(np.argmax(scores))]:.4g}"

    async def _reconstruct(self) -> None:
        s, inspector, shown = self.state, self.inspector, self._shown
        if shown is None or not math.isfinite(inspector.turn_us):
            return
        try:
            picture = await self.in_thread(
                reconstruct, inspector.recording, model=inspector.model, encoder=inspector.adjusted_encoder,
                start_us=shown.span.start_us, length_us=shown.span.length_us, device=inspector.device,
            )  # fmt: skip
        except AmiwarpError as error:
            s.update({"picture": "", "picture_note": str(error)})
            return
        left, top, right, bottom = shown.region
        s.picture = jpeg(tones(picture.to_host(), Tone.MAPPED)[top:bottom, left:right])
        s.picture_note = f"{picture.pairs:,} pairs, residual {picture.residual:.2f}"

    def _pick(self, x: float, y: float) -> None:
        """Describe the event at a clicked position, given as shares of the picture from its top left."""
        if self._shown is None:
            return
        k = self.scene.pick(x, y)
        with self.state:
            self._picked = k
            self.state.picked = "" if k is None else event_text(self._shown, k)
            self.request("look")
