"""Window of the inspector: event clouds, images, sliders, curves and a timeline, drawn with PyVista."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from amiwarp.choices import Axis, View
from amiwarp.errors import AmiwarpError
from amiwarp.events.recording import Recording
from amiwarp.tasks import interrupts_later, no_garbage_collection
from amiwarp.viewer import captions, depth_view, first_phase, orbit_lines, view_state
from amiwarp.viewer.actions import Request
from amiwarp.viewer.bookmarks import Bookmarks
from amiwarp.viewer.inspector import Inspector
from amiwarp.viewer.job_progress import PROGRESS_S, JobCancelled
from amiwarp.viewer.look import Look
from amiwarp.viewer.scene import Scene
from amiwarp.viewer.view_state import ViewState
from amiwarp.viewer.watched_stream import WatchedStream
from amiwarp.viewer.window_actions import FINE, SPEED
from amiwarp.viewer.window_contents import WindowContents
from amiwarp.viewer.window_layout import LARGEST, Places, first_size, places
from amiwarp.viewer.window_mouse import Mouse
from amiwarp.viewer.window_sheets import RENDERERS, Sheets

SMOOTH_S = 0.04
"""Longest time for drawing while something moves [s]. Slower renderers then draw every second (third, ...) point."""
LEAST_POINTS = 30_000
"""Number of points that are drawn in any case."""
DRAWING_SHARE = 0.2
"""Largest share of the time of a calibration in which the window draws."""
REST_S = 0.3
"""Time without a change after which all points are drawn, and the sharpness curves computed [s]."""
IDLE_S = 0.005
"""Interval between two looks for input while there is nothing to do [s]."""
FOLLOW_S = 0.25
"""Interval between two pictures of a live stream [s]."""
COUNT_S = 0.02
"""Time for which events are counted for the timeline between two looks for input [s]."""
DRAW_COUNTED_S = 0.2
"""Shortest interval between two drawings of what is counted [s]."""
RECOUNT_S = 1.0
"""Shortest interval between two counts of a live stream [s]."""


class Window(WindowContents):
    """Window that shows an inspector. :meth:`run` follows the user until the window is closed.

    Input only notes what must be done (:meth:`request`); :meth:`update` does it, so that many moves of a slider during
    one picture cost one. What is shown is described by :meth:`remember` and set by :meth:`show_state`, as on the page.
    """

    def __init__(
        self,
        inspector: Inspector,
        *,
        look: Look | None = None,
        view: View = View.FREE,
        size: tuple[int, int] | None = None,
        off_screen: bool = False,
    ) -> None:
        """Open the window. ``size``: in pixels; by default, the largest that fits the screen.

        ``off_screen``: draw without a display, for tests. Raises :class:`AmiwarpError` if there is no display, or no
        events in the inspector's window.
        """
        self.scene = Scene(size or LARGEST, more=RENDERERS, off_screen=off_screen)
        self.plotter = self.scene.plotter
        if size is None and not off_screen:
            self.plotter.window_size = first_size(tuple(self.plotter.render_window.GetScreenSize()))
        self.inspector = inspector
        self.view = view
        self.bookmarks = None if inspector.path is None else Bookmarks(inspector.path)
        self.look = look or Look(axis=Axis.ANGLE if self.compensates else Axis.TIME)
        self.first_dark = self.look.dark
        self.statistics_shown = not self.compensates  # instead of the charts of the sharpness
        self.knob = inspector.orbit_names[0]
        self.message = ""
        self.sheets = Sheets(list(self.plotter.renderers)[-RENDERERS:], self)
        self.mouse = Mouse(self)
        self._prepare()
        self.places: Places
        """Where the parts of the window are."""
        self.time_window = inspector.window or inspector.first_window()
        self._depth_drawn = False
        self._requests: set[Request] = set()
        self._undo_step = ""
        self._interrupts: list[int] = []
        self._progress_due_s = 0.0
        self._built: tuple[Any, ...] = ()
        self._exposed = True
        self._sheets_old = False
        # When something has changed, and the events of a live stream and the counted ones were shown, last.
        self._changed_s = 0.0
        self._counted_s = 0.0
        self._counted_drawn_s = 0.0
        self._coarse = 1
        self._slow: Iterator[None] = iter(())
        self._listen()
        self._start()

    def run(self) -> None:
        """Follow the user until the window is closed or the command is interrupted."""
        with contextlib.suppress(KeyboardInterrupt), contextlib.closing(self.scene):
            while not (self.closed or self.plotter.iren.interactor.GetDone()):
                # VTK ends the process if an exception leaves one of its callbacks
                with interrupts_later() as self._interrupts:
                    if not self.run_once():
                        time.sleep(IDLE_S)

    @no_garbage_collection()  # by a helper thread, which would end VTK's objects while this thread draws
    def run_once(self) -> bool:
        """Handle the input so far, and draw if something has changed; return whether there was something to do."""
        interactor = self.plotter.iren.interactor
        interactor.EnableRenderOff()  # VTK would draw after each of many mouse moves
        interactor.ProcessEvents()
        interactor.EnableRenderOn()
        now = time.perf_counter()
        self._play(now)
        if tuple(self.plotter.render_window.GetSize()) != self.places.size:
            self.request("look")
        if self._requests or self._exposed or self.mouse.turned:
            self._changed_s = now
            self._draw_at(self._coarse)
            return True
        if self._sheets_old:
            self._draw_sheets()
            return True
        if now - self._changed_s < REST_S or self.mouse.pressed:
            return False
        return self._rest()

    def _rest(self) -> bool:
        """Do what takes long while nothing moves; return whether there was something to do."""
        if self._scale_held:
            self._scale_held = False
            self._make_images()
            self._sheets_old = True
        if self.scene.stride > 1:
            self._draw_at(1)
            return True
        if self._sheets_old:  # drawn in the next turn
            return True
        ended = object()
        if next(self._slow, ended) is not ended:
            return True
        return self._count_events()

    def update(self) -> None:
        """Compute what was requested, and give it to VTK."""
        requests = self._requests
        self._requests = set()
        inspector = self.inspector
        try:
            self._compute(requests)
        except AmiwarpError as error:
            if not self.has_shown:
                raise
            self.message = str(error)
            # The sliders return to what is shown.
            inspector.knobs = self._shown_knobs
        self.time_window = inspector.window or inspector.first_window()
        self._build()
        if requests - {"look"}:
            self._scale_held = bool(self._undo_step) and self._images is not None
            self._make_images()
        self._show()
        if not self.plays:
            self.remember(self._undo_step)
        self.announce()

    def _compute(self, requests: set[Request]) -> None:
        """Read, set and compute what was requested. Raises :class:`AmiwarpError` if there are no such events."""
        inspector = self.inspector
        if requests & {"window", "suggestion"}:
            inspector.open(*self.time_window)
        if "state" in requests:
            if not self.plays:
                self.remember("")  # what came before an undo can be redone
            state = self.travelled()
            if state is not None:
                self.show_state(state)
        if "suggestion" in requests:
            first_phase.estimate_phase(inspector)
            suggested = replace(inspector.selection, region=inspector.suggest_region())
            inspector.open(*self.time_window, suggested)
        if requests - {"look"}:
            before = self.shown.events if self.has_shown else None
            self.shown = inspector.show(against=self.b)
            self.has_shown = True
            self._shown_knobs = inspector.knobs
            if before is not self.shown.events:
                self._picked = -1  # the picked event is gone
            self.message = ""

    def request(self, *what: Request, change: str = "") -> None:
        """Request an update. Requests with the same ``change``, such as the name of a slider, are undone together."""
        self._requests.update(what)
        self._undo_step = f"{change} {self.mouse.drags}" if change else ""
        if set(what) - {"look"}:
            self._slow = self._slow_steps()

    def show_state(self, state: ViewState) -> None:
        """Show what a state describes. Raises :class:`AmiwarpError`, and changes nothing, if it selects no events."""
        view_state.apply_state(self.inspector, state)
        self.b = state.against
        self.view = state.view
        self.image = state.image
        self.difference = state.difference
        self.decay_us = state.decay_us
        self.same_scale = state.same_scale
        self.look = replace(
            self.look, axis=state.axis, colour=state.colour, overlaid=state.overlaid
        )
        self.scene.look_from(self.view, self._look)

    # Time

    def _play(self, now: float) -> None:
        """Move the window by the time since the last call, if the recording is played; or follow a live stream."""
        if self.inspector.latest is not None:
            self._follow(self.inspector.latest, now)
        elif self.plays:
            self.plays = self.advance(1e6 * SPEED * (now - self._played_s), loop=self.loop)
            self._played_s = now
            self._ended_s = -math.inf if self.plays else now

    def _follow(self, latest: Callable[[], Recording], now: float) -> None:
        """Show the figures of a live stream, and its last events if it is followed."""
        if now - self._played_s < FOLLOW_S:
            return
        self._played_s = now
        if isinstance(latest, WatchedStream):
            rows, note = latest.figures()
            self._stream = [*(f"{name}: {text}" for name, text, _ in rows), note]
        if self.plays:
            with self.errors_shown("window"):
                self.inspector.renew()
            self.move(self.inspector.recording.events.t_last)
            if now - self._counted_s > RECOUNT_S:
                self._counted_s = now
                self._count_anew()
                self._rates.fill(
                    DRAW_COUNTED_S
                )  # of two seconds: there is no rest in which to go on
        else:
            if self._counted is not self.inspector.recording.events:
                self._count_anew()
            self.sheets_changed()

    def _count_events(self) -> bool:
        """Count events for the timeline for a short time; return whether some were left."""
        if self._rates.ended:
            return False
        finished = True
        with self.errors_shown("timeline"):
            finished = self._rates.fill(COUNT_S)
        now = time.perf_counter()
        if finished or now - self._counted_drawn_s > DRAW_COUNTED_S:
            self._counted_drawn_s = now
            self._sheets_old = True
        return True

    def _show_progress(self, what: str, share: float) -> None:
        """Show how far a calibration is, and handle the input meanwhile."""
        cancelled = not self._job_keys or self._interrupts
        if cancelled or self.closed or self.plotter.iren.interactor.GetDone():
            raise JobCancelled
        now = time.perf_counter()
        if now >= self._progress_due_s:
            self.message = f"{what}: {100.0 * min(share, 1.0):.0f} % ({self._job_keys})"
            self.request("look")
            # A job runs inside a key's callback, so inside run_once(): this draws and handles keys meanwhile. The keys
            # of a running job stop it, so that no other job begins in it.
            self.run_once()
            after = time.perf_counter()
            self._progress_due_s = after + max(PROGRESS_S, (after - now) / DRAWING_SHARE)

    # Drawing

    def _listen(self) -> None:
        """Follow keys and requests to draw, instead of what VTK and PyVista do with them."""
        iren = self.plotter.iren
        iren.clear_key_event_callbacks()
        iren.interactor.AddObserver("KeyPressEvent", lambda caller, _: self.key(caller.GetKeySym()))
        iren.interactor.AddObserver("RenderEvent", lambda *_: self._expose())
        iren.style.AddObserver("CharEvent", lambda *_: None)

    def _expose(self) -> None:
        """Note that VTK wants to draw: all of the window, as it was hidden, unless only the camera has moved."""
        self._exposed = self._exposed or not (self.mouse.turns or self.mouse.turned)

    def _start(self) -> None:
        self.inspector.renew()
        # a live stream may have lost the events of its first window while this one was made
        self.time_window = self.inspector.window or self.inspector.first_window()
        self.plays = self.inspector.latest is not None
        self._count_anew()
        self.request("window")
        if self.compensates:
            self.request("suggestion")
        self.update()
        if self.inspector.bookmark:
            self.open_view(self.inspector.bookmark)
        self.scene.look_from(self.view, self._look)
        if not self.plotter.off_screen:  # not before there is something to show
            self.plotter.iren.initialize()
            self.plotter.render_window.SetWindowName(f"amiwarp: {self.inspector.recording.name}")
        self._draw_at(1)

    def _draw_at(self, stride: int) -> None:
        """Draw every ``stride``-th point. If only the camera has moved, only the clouds are drawn."""
        changed = self.scene.stride != stride
        everything = bool(self._requests) or self._exposed
        self.scene.stride = stride
        if self._requests:
            self.update()
        elif changed:
            self._show_clouds()
        self.mouse.turned = False
        self._exposed = False
        start = time.perf_counter()
        flat = self.sheets.flat
        drawn = [
            renderer for renderer in self.plotter.renderers if everything or renderer not in flat
        ]
        self._render(drawn)
        if everything:
            self._sheets_old = False
        if stride == 1:
            too_slow = math.ceil((time.perf_counter() - start) / SMOOTH_S)
            self._coarse = max(1, min(too_slow, len(self.shown.events) // LEAST_POINTS))

    def _draw_sheets(self) -> None:
        """Draw what is beside the clouds, but not these, which may take long."""
        self._sheets_old = False
        self._set_texts()
        self._show_timeline()
        self._show_sheets()
        self._render(self.sheets.flat)

    def _render(self, which: list[Any]) -> None:
        """Draw some of the renderers that are not hidden. The others keep what they show."""
        hidden = [
            renderer
            for renderer in self.plotter.renderers
            if renderer.GetDraw() and renderer not in which
        ]
        for renderer in hidden:
            renderer.SetDraw(False)
        self.plotter.render_window.Render()
        for renderer in hidden:
            renderer.SetDraw(True)

    def _build(self) -> None:
        """Lay the parts of the window out, and give sliders and texts to them."""
        fields = self._fields()
        names = [slider.name for slider in fields if slider.name not in FINE]
        if names and self.knob not in names:
            self.knob = names[0]
        self.sheets.set_sliders(fields, self.knob)
        built = self._built
        self._built = (self._curve_names(), self.statistics_shown)
        if built != self._built:
            self.sheets.set_charts(self._curve_names())
            self._slow = self._slow_steps()
        width, height = self.plotter.render_window.GetSize()
        self.places = places(
            (width, height), compensates=self.compensates, statistics=self.statistics_shown
        )
        clouds = self.places.clouds.shares(self.places.size)
        self.scene.place(clouds, self.places.font_px, self._look)
        self._set_texts()

    def _show(self) -> None:
        """Give what is to be shown to VTK."""
        self._show_clouds()
        if self.compensates:
            orbit, column = orbit_lines.orbit_lines(self.inspector, self.shown, self._picked)
            # Of the scene point by the prism
            self.sheets.show_orbit(orbit[:, 2], orbit[:, :2] - column[:, :2])
        for name in self._curve_names():
            self._show_curve(name)
        self._show_timeline()
        if self.depth_shown and self.inspector.depth is not None and not self._depth_drawn:
            first = list(self.plotter.renderers).index(self.sheets.depth[0])
            depth_view.draw_depth(self.plotter, first, self.inspector.depth, self.places.font_px)
            self._depth_drawn = True
        self._show_sheets()

    def _show_sheets(self) -> None:
        self.sheets.draw(
            self.places,
            dark=self.look.dark,
            help_shown=self.help_shown,
            side_shown=self.statistics_shown,
            depth_shown=self.depth_shown,
        )

    def _show_clouds(self) -> None:
        look = self._look
        lines = orbit_lines.shown_lines(self.inspector, self.shown, look.axis, self.b, self._picked)
        self.scene.show(
            self.shown, look, lines, captions.caption(self.inspector, self.shown, self.scene.stride)
        )
