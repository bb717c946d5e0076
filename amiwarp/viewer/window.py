"""Window of the inspector: both event clouds, sliders, sharpness curves and orbit, drawn with PyVista."""

import contextlib
import itertools
import math
import textwrap
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Axis, View
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.imaging.export import save_png
from amiwarp.imaging.palette import OFF_COLOUR, ON_COLOUR
from amiwarp.live.stream.session import LiveSource
from amiwarp.optics.models import alternatives
from amiwarp.plotting.colours import GREY
from amiwarp.tasks import interrupts_later, no_garbage_collection
from amiwarp.viewer import drawing, jobs, layout
from amiwarp.viewer.drawing import Look, Scene
from amiwarp.viewer.inspector import DisplayedWindow, Inspector, colours_on_offer

SIZE = (1500, 950)
"""Width and height of the window at the start [px]."""
CORNER = (0.2, 0.25)
"""Width of the column of sliders and height of the row of charts, in shares of the window's size."""
SMOOTH_S = 0.05
"""Longest time for drawing while something moves [s]. Slower renderers then draw every second (third, ...) point."""
LEAST_POINTS = 30_000
"""Number of points that are drawn in any case."""
DRAWING_SHARE = 0.2
"""Largest share of the time of a calibration in which the window draws."""
CLICK_PX = 3.0
"""Distance up to which the mouse may move between press and release for a click [px]."""
REST_S = 0.3
"""Time without a change after which all points are drawn, and the sharpness curves computed [s]."""
IDLE_S, FOLLOW_S = 0.005, 0.25
"""Interval between two looks for input, and between two pictures of a live stream [s]."""
COLUMN_LETTERS = 34
"""Length of the lines of text above the sliders [characters]."""
HELP_PLACE, STATISTICS_PLACE = (0.35, 0.46, 0.72, 0.97), (0.735, 0.0, 1.0, 0.25)
"""Left, bottom, right and top of help and statistics, in shares of the window's size."""
DEPTH_SHARES = (CORNER[0], 0.34, 0.67, 1.0)
"""Edges between colour bar, image and points of a depth map, in shares of the window's width."""
HELP_PAPER = {False: "#f0f0ea", True: "#24282e"}
"""Background of help and statistics, for light (False) and dark (True) mode."""
LEGEND_SHARE = 0.5
"""Height of the space for the legend above the curves of a chart, as a share of their height."""
INTERVAL_CURVES = ((OFF_COLOUR, 2.0, "intervals"), (ON_COLOUR, 2.0, "median"))
"""Colour, width and name of the histogram of intervals, and of the line at their median."""
MARKS = ((drawing.ORBIT_COLOUR, 5.0, "truth"), (ON_COLOUR, 2.0, "now"))
"""Colour, width and name of the lines that mark values on a sharpness curve."""
ORBIT_CURVES = ((ON_COLOUR, 2.0, "in x"), (OFF_COLOUR, 2.0, "in y"))
"""Colour, width and name of the curves of a scene point's displacement."""
KEY_NAMES = {"?": "h or ?", "ArrowRight": "→", "ArrowLeft": "←", " ": "space", "Up": "↑", "Down": "↓"}
"""How the help writes keys, where it does not use their names."""
SPEED = 0.1
"""Speed of playing, relative to real time."""
FINE = ("start_ms", "length_ms")
"""Sliders of the time window."""
X_KEYS = {
    "Right": "ArrowRight", "Left": "ArrowLeft", "space": " ", "question": "?", "h": "?", "plus": "+", "equal": "+",
    "minus": "-", "comma": ",", "period": ".",
}  # fmt: skip
"""Keys by their names in VTK, where these differ."""
MORE_KEYS = (
    ("Up", ("nudge", 1), "the parameter moved last: up by a step"),
    ("Down", ("nudge", -1), "the parameter moved last: down by a step"),
    ("Tab", ("choose_next", "knob"), "choose the next parameter for these keys and the curve"),
    ("m", ("choose_next", "model"), "next optical model"),
    ("5", ("toggle", "depth_shown"), "the depth map (--depth) as an image and as points, or the clouds"),
    ("k", ("choose_next", "colour"), "next quantity shown by colour"),
    ("n", ("choose_next", "polarity"), "ON, OFF or both"),
    ("i", ("toggle", "statistics_shown"), "statistics of the selected events of the region: show or hide"),
    (",", ("scale_count", 0.5), "a time window with half as many events"),
    (".", ("scale_count", 2.0), "a time window with twice as many events"),
    ("x", ("toggle", "optic_shown"), "controls of a prism, for a recording that does not say that there is one"),
    ("v", ("take_truth",), "take the known true parameters of a simulation"),
    ("+", ("resize_points", 1.0), "larger points"),
    ("-", ("resize_points", -1.0), "smaller points"),
    ("f", ("film",), "film from here on, at a tenth of real time; f ends it, c cancels it"),
    ("q", ("close",), "close the window"),
)
"""Keys that only the window has, as :data:`amiwarp.viewer.layout.KEYS`."""


class Window(layout.Actions):
    """Window that shows an inspector. :meth:`run` follows the user until the window is closed.

    Input only notes what must be done (:meth:`request`); :meth:`update` does it, so that many moves of a slider during
    one picture cost one.
    """

    keys = layout.KEYS + MORE_KEYS

    def __init__(
        self, inspector: Inspector, *, look: Look | None = None, view: View = View.FREE, size: tuple[int, int] = SIZE,
        off_screen: bool = False,
    ) -> None:  # fmt: skip
        """Open the window. ``off_screen``: draw without a display, for tests.

        Raises :class:`AmiwarpError` if there is no display, or no events in the inspector's window.
        """
        self.scene = Scene(size, corner=CORNER, more=7, off_screen=off_screen)
        self.inspector, self.view = inspector, view
        self.look = look or Look(axis=Axis.ANGLE if self.compensates else Axis.TIME)
        self.shown: DisplayedWindow
        """What the window shows."""
        self.help_shown = self.statistics_shown = self.depth_shown = self.plays = self.loop = self.closed = False
        self.optic_shown = False
        """Whether a recording shows the controls of a prism though nothing says that there is one."""
        self.knob, self.message = inspector.orbit_names[0], ""
        self.sliders: dict[str, Any] = {}
        """Slider widgets by the name of their value."""
        self.plotter = self.scene.plotter
        self._controls, self._charts, *self._depth, self._help, self._statistics = list(self.plotter.renderers)[-7:]
        self._depth_drawn = False
        self._wanted: set[str] = set()
        self.time_window = inspector.window or inspector.first_window()
        self._change, self._progress, self._film_ends = "", False, False
        self._interrupts: list[int] = []
        self._progress_due_s = 0.0
        self._picked, self._pressed = -1, (0, 0)
        self._built: tuple[Any, ...] = ()
        self._dirty, self._changed_s, self._played_s = True, 0.0, 0.0
        self._coarse = 1
        self._curves: Iterator[None] = iter(())
        self._plots: dict[str, tuple[Any, list[Any]]] = {}
        self.curves: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        """Values and sharpness of the curves by parameter, in the units of the sliders."""
        self._curves_of: dict[str, Any] = {}  # window and selection of which the curves are
        self._stream: list[str] = []
        self._texts = [drawing.text_actor("", "black", (0.05, top)) for top in (0.985, 0.97, 0.26, 0.97)]
        self._listen()
        self._start()

    def close(self) -> None:
        """Close the window after the current picture."""
        self.closed = True

    def run(self) -> None:
        """Follow the user until the window is closed or the command is interrupted."""
        with contextlib.suppress(KeyboardInterrupt), contextlib.closing(self.scene):
            while not (self.closed or self.plotter.iren.interactor.GetDone()):
                # VTK ends the process if an exception leaves one of its callbacks
                with interrupts_later() as self._interrupts:
                    if not self.turn():
                        time.sleep(IDLE_S)

    @no_garbage_collection()  # by a helper thread, which would end VTK's objects while this thread draws
    def turn(self) -> bool:
        """Handle the input so far, and draw if something has changed; return whether there was something to do."""
        interactor = self.plotter.iren.interactor
        interactor.EnableRenderOff()  # VTK would draw after each of many mouse moves
        interactor.ProcessEvents()
        interactor.EnableRenderOn()
        now = time.perf_counter()
        self._play(now)
        if self._wanted or self._dirty:
            self._changed_s = now
            self._draw_at(self._coarse)
            return True
        if now - self._changed_s < REST_S:
            return False
        if self.scene.stride > 1:
            self._draw_at(1)
            return True
        return next(self._curves, self) is not self

    def update(self) -> None:
        """Compute what was requested, and give it to VTK."""
        wanted, self._wanted = self._wanted, set()
        inspector = self.inspector
        try:
            if wanted & {"window", "suggestion"}:
                inspector.open(*self.time_window)
            if "state" in wanted:
                if not self.plays:
                    self.remember("")  # what came before an undo can be redone
                if (state := self.travelled()) is not None:
                    layout.apply_state(inspector, state)
                    self.b, self.view = state.against, state.view
                    self.look = replace(self.look, axis=state.axis, colour=state.colour, overlaid=state.overlaid)
                    self.scene.look_from(self.view, self._look)
            if "suggestion" in wanted:
                jobs.estimate_phase(inspector)
                inspector.open(*self.time_window, replace(inspector.selection, region=inspector.suggest_region()))
            before = getattr(self, "shown", None)
            self.shown, self._shown_knobs = inspector.show(against=self.b), inspector.knobs
            self._picked = self._picked if before is not None and before.events is self.shown.events else -1
            self.message = "" if wanted - {"look"} else self.message
        except AmiwarpError as error:
            if not hasattr(self, "shown"):
                raise
            self.message = str(error)
            inspector.knobs = self._shown_knobs
        self.time_window = inspector.window or inspector.first_window()
        self._build()
        self._show()
        if not self.plays:
            self.remember(self._change)

    def request(self, *what: str, change: str = "") -> None:
        """Request an update: "window", "suggestion", "knobs", "state" or "look"."""
        self._wanted.update(what)
        self._change = change
        if set(what) - {"look"}:
            self._curves = self._curve_steps()

    # Input: sliders and keys

    def key(self, key: str) -> None:
        """Run the action of a key, by its name in VTK."""
        super().key(X_KEYS.get(key, key))

    def slide(self, name: str, value: float) -> None:
        """Set a value, in the unit of its slider."""
        if name not in self.sliders:  # PyVista also calls this while it makes a slider
            return
        if name in FINE:
            if name == "start_ms":
                self.move(self.inspector.recording.events.t_first + round(value * 1e3), change=name)
            else:
                self.time_window = self.time_window[0], min(max(1, round(value * 1e3)), self.whole_us)
                self.move(self.time_window[0], change=name)
            return
        self.knob = name
        knobs = self.inspector.knobs.with_values({name: value * layout.UNITS[name]})
        if knobs != self.inspector.knobs:
            self.inspector.set(knobs)
            self.request("knobs", change=name)

    def nudge(self, steps: int) -> None:
        """Move the chosen parameter by steps of its slider."""
        if self.knob not in self.sliders:
            return
        step = layout.SLIDERS[self.knob][2][2]
        self.slide(self.knob, layout.knob_values(self.inspector)[self.knob] + steps * step)

    def choose_next(self, what: str) -> None:
        """Choose the next parameter for the keys and the curve, or the next model, colour or polarity that is shown."""
        inspector, knobs = self.inspector, self.inspector.knobs
        if what == "knob":
            self.knob = _following([name for name in self.sliders if name not in FINE] or [self.knob], self.knob)
            self.request("look")
        elif what == "model":
            inspector.set(replace(knobs, model=_following(list(alternatives(knobs.model)), knobs.model)))
            self.request("knobs")
        elif what == "colour":
            self.restyle(colour=_following(colours_on_offer(inspector.recording.truth), self.look.colour))
        else:
            self._select(polarity=_following([None, 1, 0], inspector.selection.polarity))

    def scale_count(self, factor: float) -> None:
        """Show a time window with so many times as many events."""
        count = round(self.shown.span.count * factor)
        with self.errors_shown("window"):
            self.time_window = self.inspector.window_of(self.time_window[0], count)
            self.request("window")

    def resize_points(self, px: float) -> None:
        """Make the points larger."""
        self.restyle(point_size=min(max(self.look.point_size + px, 1.0), 20.0))

    def toggle(self, name: str) -> None:
        """Invert "overlaid", "dark", "loop", "help_shown", "statistics_shown", "depth_shown" or "optic_shown"."""
        if name in ("overlaid", "dark"):
            self.restyle(**{name: not getattr(self.look, name)})
            return
        if name == "depth_shown" and self.inspector.depth is None:
            self.say("there is no depth map; start with --depth FILE")
            return
        setattr(self, name, not getattr(self, name))
        self._curves = self._curve_steps()
        self.request("look")

    def look_from(self, view: str) -> None:
        """Set the direction from which the clouds are seen, and fit them into the window."""
        self.view, self.depth_shown = View(view), False
        self.scene.look_from(self.view, self._look)
        self.request("look")

    def _click(self, event: str) -> None:
        place = self.plotter.iren.interactor.GetEventPosition()
        if event.startswith("LeftButtonPress"):
            self._pressed = place
        elif math.dist(place, self._pressed) <= CLICK_PX and not self.depth_shown:
            self.pick(place)

    def pick(self, place: tuple[int, int]) -> None:
        """Describe the event that is drawn at a place, and show its orbit. ``place``: pixels from left and bottom."""
        self._picked = self.scene.event_at(place, self.shown, self._look)
        self.say("" if self._picked < 0 else drawing.event_text(self.shown, self._picked))

    def whole(self) -> None:
        """Show the whole image."""
        self._select(region=None)

    def keep_b(self) -> None:
        """Keep the parameters as B, and show them on the left; a second time, show the recorded events again."""
        self.b = None if self.b == self.inspector.knobs else self.inspector.knobs
        self.request("knobs")

    def play(self) -> None:
        """Play the recording from the current window, or follow a live stream; stop if already playing."""
        self.plays, self._played_s = not self.plays and self.can_play(), time.perf_counter()

    def calibrate(self) -> None:
        """Calibrate on the shown events, or cancel the running calibration. The window goes on meanwhile."""
        if self._progress:
            self._progress = False
            return
        with self._job("calibration"):
            self.found, text = jobs.find_calibration(self.inspector, progress=self._show_progress)
            self.message = f"{text}. Press a to accept"

    def film(self) -> None:
        """Save a film from here on under a new name in the current folder, or end it. The window goes on meanwhile."""
        self._film_ends = self._progress
        if self._progress:
            return
        with self._job("film"):
            path = self._new_name("film")
            jobs.write_film(path, self.inspector, self._look, self.view, self._show_progress, what="film",
                            against=self.b, speed=SPEED, ended=lambda: self._film_ends)  # fmt: skip
            self.message = f"saved {path}"

    @contextlib.contextmanager
    def _job(self, what: str) -> Iterator[None]:
        """Run a long job, which :meth:`calibrate` cancels."""
        self._progress = True
        with self.errors_shown("window"):
            try:
                yield
            except jobs.JobCancelled:
                self.message = f"{what} cancelled"
        self._progress = False
        self.request("look")

    def export(self, what: str) -> None:
        """Save the calibration, or a picture of the window, under a new name in the current folder."""
        path = self._new_name(what)
        with self.errors_shown("window"):
            if what == "picture":
                save_png(path, self.scene.picture())
            else:
                self.inspector.as_calibration().save(path)
            self.say(f"saved {path}")

    def _new_name(self, what: str) -> Path:
        name = Path(jobs.download_name(self.inspector.recording.name, what))
        names = (name.with_stem(f"{name.stem}-{k}") if k else name for k in itertools.count())
        return next(each for each in names if not each.exists())

    # State

    @property
    def _look(self) -> Look:
        against = "recorded" if self.b is None else "B"
        return self.look.for_clouds(drawing.cloud_titles(self.inspector, against))

    def say(self, text: str) -> None:
        """Show a message."""
        self.message = text
        self.request("look")

    def _select(self, **changes: Any) -> None:
        inspector = self.inspector
        with self.errors_shown("window"):
            inspector.open(*self.time_window, replace(inspector.selection, **changes))
            self.request("knobs")

    def _play(self, now: float) -> None:
        """Move the window by the time since the last call, if the recording is played; or follow a live stream."""
        if self.inspector.latest is not None:
            self._follow(self.inspector.latest, now)
        elif self.plays:
            self.plays = self.advance(1e6 * SPEED * (now - self._played_s), loop=self.loop)
            self._played_s = now

    def _follow(self, latest: Callable[[], Recording], now: float) -> None:
        """Show the figures of a live stream, and its last events if it is followed."""
        if now - self._played_s < FOLLOW_S:
            return
        self._played_s = now
        if isinstance(latest, LiveSource):
            rows, note = latest.figures()
            self._stream = [*(f"{name}: {text}" for name, text, _ in rows), note]
        if self.plays:
            with self.errors_shown("window"):
                self.inspector.renew()
            self.move(self.inspector.recording.events.t_last)
        else:
            self._show_texts()
            self.plotter.render_window.Render()

    def _show_progress(self, what: str, share: float) -> None:
        """Show how far a calibration is, and handle the input meanwhile."""
        if not self._progress or self._interrupts or self.closed or self.plotter.iren.interactor.GetDone():
            raise jobs.JobCancelled
        if (now := time.perf_counter()) >= self._progress_due_s:
            self.message = f"{what}: {100.0 * min(share, 1.0):.0f} % (c cancels)"
            self.request("look")
            self.turn()
            after = time.perf_counter()
            self._progress_due_s = after + max(jobs.PROGRESS_S, (after - now) / DRAWING_SHARE)

    # Drawing

    def _listen(self) -> None:
        """Follow keys and requests to draw, instead of what VTK and PyVista do with them."""
        iren = self.plotter.iren
        iren.clear_key_event_callbacks()
        iren.interactor.AddObserver("KeyPressEvent", lambda caller, _: self.key(caller.GetKeySym()))
        iren.interactor.AddObserver("RenderEvent", lambda *_: setattr(self, "_dirty", True))
        iren.style.AddObserver("CharEvent", lambda *_: None)
        for event in ("LeftButtonPressEvent", "LeftButtonReleaseEvent"):
            iren.style.AddObserver(event, lambda _, event: self._click(event))

    def _start(self) -> None:
        self._controls.SetViewport(0.0, 0.0, CORNER[0], 1.0)
        homes = self._controls, self._help, self._controls, self._statistics
        for renderer, actor in zip(homes, self._texts, strict=True):
            renderer.add_actor(actor, render=False, pickable=False, reset_camera=False)
        self.inspector.renew()
        self.plays = self.inspector.latest is not None
        self.request("window", *(["suggestion"] if self.compensates else []))
        self.update()
        self.scene.look_from(self.view, self._look)
        if not self.plotter.off_screen:  # not before there is something to show
            self.plotter.iren.initialize()
            self.plotter.render_window.SetWindowName(f"amiwarp: {self.inspector.recording.name}")
        self._draw_at(1)

    def _draw_at(self, stride: int) -> None:
        """Draw every ``stride``-th point."""
        changed = self.scene.stride != stride
        self.scene.stride = stride
        if self._wanted:
            self.update()
        elif changed:
            self._show()
        start = time.perf_counter()
        self.plotter.render_window.Render()
        self._dirty = False
        if stride == 1:
            too_slow = math.ceil((time.perf_counter() - start) / SMOOTH_S)
            self._coarse = max(1, min(too_slow, len(self.shown.events) // LEAST_POINTS))

    def _show(self) -> None:
        """Give what is to be shown to VTK."""
        shown, look = self.shown, self._look
        lines = drawing.shown_lines(self.inspector, shown, look.axis, self.b, self._picked)
        if self.compensates:
            chart, plots = self._plots["orbit"]
            orbit, column = drawing.orbit_lines(self.inspector, shown, self._picked)
            moved = orbit[:, :2] - column[:, :2]  # of the scene point of the orbit by the prism, over one turn
            for k in range(2):
                plots[k].update(orbit[:, 2], moved[:, k])
            low, high = moved.min(), max(moved.max(), moved.min() + 1e-3)
            chart.x_range, chart.y_range = (0.0, 360.0), (1.1 * low, high + LEGEND_SHARE * (high - low))
        self.scene.show(shown, look, lines, drawing.caption(self.inspector, shown, self.scene.stride))
        for name in self.curves:
            self._plot_curve(name)

    def _build(self) -> None:
        """Make sliders, charts and texts anew if they have changed, and set the sliders' values.

        A slider is not made anew while the mouse drags it.
        """
        import pyvista

        dark, fields = self.look.dark, self._fields()
        names = tuple(fields)
        parameters = [name for name in names if name not in FINE]
        self.knob = self.knob if self.knob in parameters or not parameters else parameters[0]
        built, self._built = self._built, (names, dark, self.compensates, self.knob)
        if built[:1] != self._built[:1]:
            self._make_sliders(names)
        if built[1:] != self._built[1:]:
            self._make_charts()
            self.scene.place((CORNER[0], CORNER[1] if self.compensates else 0.0), self._look)
            self._curves = self._curve_steps()
        for name, slider in self.sliders.items():
            shape, (value, low, high, title) = slider.GetRepresentation(), fields[name]
            shape.SetMinimumValue(low)
            shape.SetMaximumValue(high)
            shape.SetValue(value)
            shape.SetTitleText(title)
            ink = drawing.ORBIT_COLOUR if name == self.knob else drawing.BACKGROUND_AND_INK[dark][1]
            for part in ("Title", "Slider", "Tube", "Cap"):
                getattr(shape, f"Get{part}Property")().SetColor(pyvista.Color(ink).float_rgb)
        self._show_texts()

    def _fields(self) -> dict[str, tuple[float, float, float, str]]:
        """Return value, ends and title of the sliders: of the parameters that matter, and of the time window."""
        out, always = {}, (*self.inspector.orbit_names, "clock_offset", "rpm")
        for slider in layout.sliders(self.inspector) if self._has_controls else ():
            name, value = slider["name"], slider["value"]
            if value or name in always or name.startswith("tilt"):
                title = f"{slider['label']} {layout.with_unit(name, value, 6)} ({slider['note']})"
                out[name] = value, slider["least"], slider["most"], title
        whole_ms, length_ms = self.whole_us * 1e-3, self.time_window[1] * 1e-3
        start_ms = (self.time_window[0] - self.inspector.recording.events.t_first) * 1e-3
        out["start_ms"] = start_ms, 0.0, whole_ms, f"window from {start_ms:.3f} ms"
        out["length_ms"] = length_ms, min(0.1, 0.5 * whole_ms), whole_ms, f"length {length_ms:.3f} ms"
        return out

    @property
    def _has_controls(self) -> bool:
        """Whether there are controls of a prism."""
        return self.optic_shown or self.inspector.has_optic

    def _make_sliders(self, names: tuple[str, ...]) -> None:
        import pyvista

        style = pyvista.TextProperty(font_file=str(drawing.font()), justification_horizontal="center",
                                     justification_vertical="center")  # fmt: skip
        self.plotter.clear_slider_widgets()
        self.plotter.subplot(0, drawing.OWN_RENDERERS)
        self.sliders = {}
        for k, name in enumerate(names):
            y = 0.8 - 0.74 * k / max(len(names) - 1, 9)
            slider = self.plotter.add_slider_widget(
                lambda value, name=name: self.slide(name, value), (0.0, 1.0), value=0.5, pointa=(0.05, y),
                pointb=(0.95, y), interaction_event="always", title_height=0.014, tube_width=0.003, slider_width=0.02,
            )  # fmt: skip
            slider.KeyPressActivationOff()  # VTK's key i would hide it
            slider.GetRepresentation().ShowSliderLabelOff()
            slider.GetRepresentation().SetEndCapWidth(0.01)
            slider.GetRepresentation().GetTitleProperty().ShallowCopy(style)
            self.sliders[name] = slider

    def _make_charts(self) -> None:
        """Make the charts: sharpness over two parameters, displacement of a scene point in a turn, and intervals."""
        ink = drawing.BACKGROUND_AND_INK[self.look.dark][1]
        for name, (chart, _) in self._plots.items():
            (self._statistics if name == "intervals" else self._charts).remove_chart(chart)
        drawing.place_renderer(self._charts, (CORNER[0], 0.0, 1.0, CORNER[1]), shown=self.compensates)
        self._plots = {}
        for k, name in enumerate((*self._curve_names(), "orbit")):
            label, unit, *_ = layout.SLIDERS.get(name, ("prism angle", "°"))
            titles = f"{label} [{unit}]" if unit else label, "displacement [px]" if name == "orbit" else "sharpness"
            curves = ORBIT_CURVES if name == "orbit" else ((ink, 2.0, "sharpness"), *MARKS)
            self._plots[name] = self._chart(self._charts, titles, (0.01 + 0.33 * k, 0.02, 0.32, 0.96), curves)
        titles = "log10 of the interval of a pixel [µs]", "share [%]"
        self._plots["intervals"] = self._chart(self._statistics, titles, (0.02, 0.02, 0.96, 0.62), INTERVAL_CURVES)

    def _chart(
        self, home: Any, titles: tuple[str, str], place: tuple[float, ...], curves: tuple[tuple[str, float, str], ...]
    ) -> tuple[Any, list[Any]]:
        """Make a chart at a place (left, bottom, width, height) of a renderer; return it with its empty curves."""
        import pyvista

        paper, ink = drawing.BACKGROUND_AND_INK[self.look.dark]
        paper = HELP_PAPER[self.look.dark] if home is self._statistics else paper
        chart = pyvista.Chart2D(size=place[2:], loc=place[:2], x_label=titles[0], y_label=titles[1], grid=False)
        chart.background_color, chart.border_color = paper, paper
        for axis in (chart.x_axis, chart.y_axis):
            axis.pen.color, axis.label_size, axis.tick_label_size = ink, 13, 11
            axis.GetTitleProperties().SetColor(pyvista.Color(ink).float_rgb)
            axis.GetLabelProperties().SetColor(pyvista.Color(ink).float_rgb)
        lines = [chart.line([], [], color=colour, width=width, label=text) for colour, width, text in curves]
        chart.legend_visible, legend = True, chart.GetLegend()
        legend.GetBrush().SetColorF(pyvista.Color(paper).float_rgb)
        legend.GetPen().SetColorF(pyvista.Color(paper).float_rgb)
        legend.GetLabelProperties().SetColor(pyvista.Color(ink).float_rgb)
        home.add_chart(chart)
        return chart, lines

    def _curve_names(self) -> tuple[str, str]:
        """Return the parameters of the two sharpness curves: the chosen one, and phase or the first one."""
        return self.knob, next(name for name in ("phase", *self.sliders) if name != self.knob)

    def _curve_steps(self) -> Iterator[None]:
        """Compute statistics and sharpness curves, one value at a time, so that the window follows its user."""
        if self.statistics_shown:
            self._show_statistics()
            yield
        for name in self._curve_names() if self.compensates else ():
            found, chosen = [], self.inspector.chosen
            for point in self.inspector.curve_points(name):
                found.append(point)
                yield
            values, sharpness = np.array(found).T
            self.curves[name] = values / layout.UNITS[name], sharpness
            self._curves_of[name] = chosen
            self._plot_curve(name)
            self._dirty = True

    def _plot_curve(self, name: str) -> None:
        """Plot a sharpness curve with the current value and the known true one.

        A curve of the window or selection before is grey, until the new one is computed.
        """
        if name not in self._plots or name not in self.curves:
            return
        (chart, lines), (x, y) = self._plots[name], self.curves[name]
        lines[0].update(x, y)
        old = self._curves_of[name] != self.inspector.chosen
        lines[0].color = GREY if old else drawing.BACKGROUND_AND_INK[self.look.dark][1]
        lines[0].label = "of the former window" if old else "sharpness"
        ends = np.array([y.min(), y.max()]) + max(np.ptp(y), 1e-6) * np.array([-0.05, LEGEND_SHARE])
        known = layout.truths(self.inspector)[name], layout.knob_values(self.inspector)[name]
        for line, value in zip(lines[1:], known, strict=True):
            inside = value is not None and x[0] <= value <= x[-1]
            line.update([value, value], ends) if inside else line.update([], [])
        chart.x_range, chart.y_range = (x[0], x[-1]), ends

    def _show_statistics(self) -> None:
        """Show the statistics of the selected events, as the page does."""
        found, (chart, (line, mark)) = self.inspector.statistics(), self._plots["intervals"]
        rows = [f"{name}:  {text}" for name, text in found["rows"]]
        self._texts[3].input = "\n".join(["Statistics of the selected events", *rows])
        x, y = found["x"] or [0.0, 6.0], found["y"] if found["x"] else [0.0, 0.0]
        median, top = found["median"], 1.3 * max(*y, 1.0)
        line.update(x, y)
        mark.update([] if median is None else [median, median], [] if median is None else [0.0, top])
        chart.x_range, chart.y_range = (x[0], x[-1]), (0.0, top)
        self._dirty = True

    def _show_texts(self) -> None:
        """Show what is missing, messages, and the help."""
        paper, ink = drawing.BACKGROUND_AND_INK[self.look.dark]
        if self._has_controls:
            about, notes = f"model {self.inspector.knobs.model}", layout.notes(self.inspector)
        else:
            span = self.shown.span
            about, notes = f"{span.count / span.length_us * 1e6:,.0f} events/s", ["x: set a prism"]
        notes = [f"{about}      h: help", "", self.message, *notes]
        notes, stream = ([line for text in texts for line in textwrap.wrap(text, COLUMN_LETTERS)]
                         for texts in (notes, self._stream))  # fmt: skip
        rows = [f"{KEY_NAMES.get(key, key):>6}   {words}" for key, _, words in self.keys]
        for actor, lines in zip(self._texts, (notes, rows, stream), strict=False):
            actor.input = "\n".join(lines)
        for actor in self._texts:
            actor.prop.color = ink
        drawing.place_renderer(self._help, HELP_PLACE, shown=self.help_shown)
        drawing.place_renderer(self._statistics, STATISTICS_PLACE, shown=self.statistics_shown)
        for renderer, (left, right) in zip(self._depth, itertools.pairwise(DEPTH_SHARES), strict=True):
            drawing.place_renderer(renderer, (left, CORNER[1], right, 1.0), shown=self.depth_shown)
        for renderer in (self._help, self._statistics):
            renderer.set_background(HELP_PAPER[self.look.dark])
        for renderer in (self._controls, self._charts):
            renderer.set_background(paper)
        if self.depth_shown and self.inspector.depth is not None and not self._depth_drawn:
            drawing.draw_depth(self.plotter, drawing.OWN_RENDERERS + 2, self.inspector.depth)
            self._depth_drawn = True


def _following(choices: list[Any], now: Any) -> Any:
    """Return the choice after the current one."""
    return choices[(choices.index(now) + 1) % len(choices) if now in choices else 0]
