"""The inspector's panel in a browser: what its widgets say to the inspector, what is shown back to the page.

One panel is one tab: an inspector, a scene and a state of its own. What takes long runs in a thread; of knobs that
moved meanwhile only where they came to rest counts.
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
from amiwarp.viewer.exports import export_path
from amiwarp.viewer.frames import room
from amiwarp.viewer.message_filter import finite
from amiwarp.viewer.inspector import Selection
from amiwarp.viewer.jobs import Calibrating, Playing
from amiwarp.viewer.layout import KEYS, NAMES, UNITS, build
from amiwarp.viewer.scene import ORBIT_COLOUR, Look, Scene
from amiwarp.viewer.values import event_text, first_values, jpeg, of_source, polyline, share

if TYPE_CHECKING:
    from amiwarp.viewer.inspector import Inspector, Shown

CLICK_PX = 3
"""A mouse that moved less between press and release picked an event."""
_ONE_AT_A_TIME = asyncio.Lock()
"""Warp's CUDA side keeps its books for one thread at a time, whichever tab it works for."""


class Panel:
    """Builds itself on a fresh trame server; :meth:`close` when the tab is gone."""

    def __init__(self, server: Any, inspector: Inspector, folder: Path) -> None:
        """``folder``: where exports go."""
        self.server, self.state, self.inspector, self.folder = server, server.state, inspector, folder
        self.scene = Scene()
        self.warp: Any = _ONE_AT_A_TIME if "cuda" in str(inspector.device) else contextlib.nullcontext()
        self.calibrating, self.playing = Calibrating(self), Playing(self)
        self._pending: set[str] = set()
        self._waiting: set[str] = set()
        self._quick: asyncio.Task[None] | None = None
        self._slow: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._shown: Shown | None = None
        self._picked: int | None = None
        self._press: tuple[int, int] | None = None
        self._wrong = ""
        self._threads = ThreadPoolExecutor(2, "amiwarp-tab")  # a calibration or a film, and a curve or a picture
        self.state.update(first_values(inspector))
        self._show_knobs()
        self.open_window()
        build(server, self)
        mouse = self.scene.plotter.iren.interactor
        style = mouse.GetInteractorStyle()  # it takes the mouse when that is pressed: the release goes to no other
        self._observed = [(mouse, mouse.AddObserver("LeftButtonPressEvent", self._pressed)),
                          (style, style.AddObserver("EndInteractionEvent", self._released))]  # fmt: skip
        for what, names in {
            "knobs": NAMES, "view": ("view",), "window": ("start_ms", "length_ms", "polarity", "region_x", "region_y",
            "hide_hot"), "look": ("colour", "axis", "point_size", "opacity", "dark", "overlaid", "orbit_shown"),
        }.items():  # fmt: skip
            self.state.change(*names)(lambda what=what, **_: self.ask(what))
        for call in (partial(self.ask, "knobs"), self.released):
            self.state.change("model")(lambda call=call, **_: call())
        self.later("curve", "picture")
        if inspector.latest is not None:
            self.playing.toggle()

    def close(self) -> None:
        """Ends what is going on; its threads end with their work."""
        self.calibrating.cancel()
        self.playing.end()
        for task in [*self._tasks, *filter(None, [self._quick, self._slow])]:
            task.cancel()
        self._threads.shutdown(wait=False, cancel_futures=True)
        for seen, tag in self._observed:  # VTK holds the panel by them, out of the collector's sight
            seen.RemoveObserver(tag)
        self.scene.close()

    # what the page asks for

    def released(self) -> None:
        """A slider came to rest."""
        self.later("curve", "picture")

    def typed(self, name: str, text: str) -> None:
        """A number was entered in a field."""
        if name not in (*NAMES, "start_ms", "length_ms", "turns"):
            return
        try:
            value = finite(text)
        except ValueError:
            self.say(f"{text!r} is no number; give one such as 1.5", "error")
            return
        if name == "turns":
            name, value = "length_ms", value * float(self.state.turn_ms)
        self.state[name] = round(value, 4)
        if name in NAMES:
            self.moved(name)
            self.ask("knobs")
        else:
            self.ask("window")
        self.released()

    def moved(self, name: str) -> None:
        """Of which knob the curve is drawn."""
        if name in NAMES:
            self.state.knob = name

    def key(self, key: str) -> None:
        """A key was pressed outside of a field."""
        for known, (name, *given), _ in KEYS:
            if key == known:
                getattr(self, name)(*given)

    def toggle(self, name: str) -> None:
        """Flips a switch of the page."""
        self.state[name] = not self.state[name]

    def toggle_axis(self) -> None:
        angle, time = Axis.ANGLE.value, Axis.TIME.value
        self.state.axis = time if self.state.axis == angle else angle

    def look_from(self, view: str) -> None:
        """Also where that is the view already and the mouse has turned it."""
        self.state.view = view
        self.ask("view")

    def step(self, turns: float) -> None:
        """Moves the window by a turn on (1) or back (-1), or by its own length where no prism turns."""
        if turns not in (-1, 1):
            return
        turn = self.inspector.turn_us * 1e-3
        self.move(float(self.state.start_ms) + turns * (turn if math.isfinite(turn) else float(self.state.length_ms)))
        self.ask("window")
        self.released()

    def play(self) -> None:
        self.playing.toggle()

    def calibrate(self) -> None:
        self.calibrating.toggle()

    def accept(self) -> None:
        """Takes over what calibration found."""
        if self.calibrating.found is not None:
            with self.reported("knobs"):
                self.inspector.accept(self.calibrating.found)
            self.discard()
            self._show_knobs()
            self.ask("knobs")
            self.later("curve", "picture")

    def discard(self) -> None:
        self.calibrating.found, self.state.found = None, ""

    def save(self) -> None:
        """Writes the calibration as it is set."""
        with self.reported("export"):
            path = self.path("calibration", ".json")
            self.inspector.as_calibration().save(path)
            self.say(f"{path}: written", "success")

    def save_picture(self) -> None:
        """Writes what is seen."""
        with self.reported("export"):
            path = self.path("", ".png")
            self.scene.save(path)
            self.say(f"{path}: written", "success")

    # what jobs use

    def ask(self, *what: str) -> None:
        """What is quick, as often as it is asked for."""
        self._pending.update(what)
        if self._quick is None:
            self._quick = self._task(self._work())

    def later(self, *what: str) -> None:
        """What takes longer, in a thread, when nothing quick is waiting."""
        self._waiting.update(what)
        if self._slow is None:
            self._slow = self._task(self._work_slowly())

    async def settled(self) -> None:
        """Waits for what is quick."""
        while self._quick is not None:
            await asyncio.sleep(0.005)

    def begin(self, work: Coroutine[Any, Any, None]) -> None:
        """Runs a job until it ends or the tab is gone."""
        self._tasks.add(task := self._task(work))
        task.add_done_callback(self._tasks.discard)

    async def in_thread(self, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """What ``work`` returns, called in one of this tab's threads."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, partial(work, *args, **options))

    def say(self, text: str, severity: str) -> None:
        with self.state:
            self.state.update({"message": text, "severity": severity})

    @contextlib.contextmanager
    def reported(self, what: str) -> Iterator[None]:
        """What goes wrong is said in the interface until the same is right again."""
        try:
            yield
        except (AmiwarpError, OSError) as error:
            self._wrong = what
            self.state.update({"message": str(error), "severity": "error"})
        else:
            if self.state.severity == "error" and self._wrong == what:
                self.state.update({"message": "", "severity": "info"})

    def move(self, start_ms: float) -> bool:
        """Sets where the window starts, inside the recording; whether it is at the end."""
        last = max(0.0, float(self.state.whole_ms) - float(self.state.length_ms))
        self.state.start_ms = round(min(max(start_ms, 0.0), last), 3)
        return start_ms >= last

    def renew(self) -> None:
        """Takes over what a live stream has become, the window at its end."""
        with self.reported("stream"):
            self.inspector.renew()
        self.state.update(of_source(self.inspector))
        self.move(float(self.state.whole_ms))
        self.ask("window")

    def path(self, what: str, *endings: str) -> Path:
        """Where an export goes: what the field says, or the recording's name and ``what`` it is."""
        name = self.inspector.recording.name
        return export_path(self.folder, str(self.state.out or ""), f"{name}.{what}" if what else name, endings)

    def open_window(self) -> None:
        """Reads and draws what the page's window and selection say."""
        s, source = self.state, self.inspector.recording.events
        with self.reported("window"):
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
        with self.reported("knobs"):
            self._draw()

    # inside

    def _task(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(work)
        task.add_done_callback(self._ended)
        return task

    def _ended(self, task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            logging.getLogger(__name__).error("the page's work failed", exc_info=error)
            self.say(f"this failed: {error or type(error).__name__}; its server knows more", "error")

    async def _work(self) -> None:
        try:
            while self._pending:
                await room(self.server)
                todo, self._pending = self._pending, set()
                async with self.warp:
                    with self.state:
                        self._do(todo)
                await asyncio.sleep(0)
        finally:
            self._quick = None

    def _do(self, todo: set[str]) -> None:
        if "window" in todo:
            self.open_window()
            self.later("curve")
        with self.reported("knobs"):
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
            while self._waiting:
                await self.settled()
                name = min(self._waiting)  # the curve first
                self._waiting.discard(name)
                async with self.warp:
                    with self.reported(name):
                        await (self._curve() if name == "curve" else self._reconstruct())
                self.state.flush()
        finally:
            self._slow = None

    def _knobs(self) -> dict[str, float]:
        """As the page shows them."""
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
        s.curve_mark = share(float(s[s.knob]), float(s.curve_low), float(s.curve_high))
        turn = self.inspector.turn_us
        s.turn_ms = turn * 1e-3 if math.isfinite(turn) else 0.0
        if s.picked:
            s.picked = "" if self._picked is None else event_text(shown, self._picked)

    @property
    def _look(self) -> Look:
        s = self.state
        points = float(s.point_size), float(s.opacity)
        return Look(Colour(s.colour), Axis(s.axis), *points, dark=bool(s.dark), overlaid=bool(s.overlaid))

    def _mark(self, shown: Shown) -> None:
        """The orbit of the scene point under the event that was picked, or of the middle of what is shown."""
        if not self.state.orbit_shown or self.state.axis != Axis.ANGLE.value:
            self.scene.mark([])
            return
        left, top, right, bottom = shown.region
        middle = np.array([left + right, top + bottom]) / 2.0
        point = middle if self._picked is None else shown.after[self._picked]
        theta, xy = self.inspector.orbit(float(point[0]), float(point[1]))
        still = np.broadcast_to(point, xy.shape)
        orbit, column = (self.scene.box.places(each, np.degrees(theta)) for each in (xy, still))
        self.scene.mark([(0, orbit, ORBIT_COLOUR), (0 if self.state.overlaid else 1, column, ORBIT_COLOUR)])

    async def _curve(self) -> None:
        s, name = self.state, self.state.knob
        values, scores = await self.in_thread(self.inspector.curve, name)
        if not len(values):
            return
        x = values / UNITS[name]
        s.curve, s.curve_low, s.curve_high = polyline(x, scores), float(x[0]), float(x[-1])
        s.curve_mark = share(float(s[name]), s.curve_low, s.curve_high)
        s.curve_text = f"sharpness {scores.min():.3f} to {scores.max():.3f}, best at {x[int(np.argmax(scores))]:.4g}"

    async def _reconstruct(self) -> None:
        s, inspector, shown = self.state, self.inspector, self._shown
        if shown is None or not math.isfinite(inspector.turn_us):
            return
        try:
            picture = await self.in_thread(
                reconstruct, inspector.recording, model=inspector.model, encoder=inspector.set_encoder,
                start_us=shown.span.start_us, length_us=shown.span.length_us, device=inspector.device,
            )  # fmt: skip
        except AmiwarpError as error:
            s.update({"picture": "", "picture_note": str(error)})
            return
        left, top, right, bottom = shown.region
        s.picture = jpeg(tones(picture, Tone.MAPPED)[top:bottom, left:right])
        s.picture_note = f"{picture.pairs:,} pairs, residual {picture.residual:.2f}"

    def _pressed(self, interactor: Any, _event: str) -> None:
        self._press = interactor.GetEventPosition()

    def _released(self, style: Any, _event: str) -> None:
        press, self._press = self._press, None
        x, y = style.GetInteractor().GetEventPosition()
        if press is None or math.dist((x, y), press) > CLICK_PX or self._shown is None:
            return
        width, height = self.scene.plotter.window_size
        k = self.scene.pick(x / width, 1.0 - y / height)
        with self.state:
            self._picked = k
            self.state.picked = "" if k is None else event_text(self._shown, k)
            self.ask("look")
