"""What keys, sliders and the mouse do in the window."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from amiwarp.choices import Axis, View
from amiwarp.errors import AmiwarpError
from amiwarp.imaging.export import save_png
from amiwarp.imaging.regions import Region
from amiwarp.optics.models.registry import alternatives
from amiwarp.viewer import calibration_job, captions, clouds_film, downloads, sliders
from amiwarp.viewer.actions import Actions
from amiwarp.viewer.drawn_truth import colours_on_offer
from amiwarp.viewer.filters import HotPixel
from amiwarp.viewer.images import DECAY_US, SLOW_KINDS, ImageKind
from amiwarp.viewer.job_progress import JobCancelled
from amiwarp.viewer.look import Look
from amiwarp.viewer.scene import Scene
from amiwarp.viewer.shown_window import DisplayedWindow
from amiwarp.viewer.sliders import SLIDERS, UNITS
from amiwarp.viewer.window_controls import Slider
from amiwarp.viewer.window_keys import KEYS, OF_OPTICS, X_KEYS
from amiwarp.viewer.window_sheets import Sheets

SPEED = 0.1
"""Speed of playing, relative to real time."""
FINE = ("start_ms", "length_ms")
"""Sliders of the time window."""
STOP_S = 1.0
"""Time after the end of playing in which the key for it still means to stop [s]."""
NAMED_HOT = 3
"""Number of hot pixels that the message names."""
NOISE_US = 2_000
"""Time of the noise filter [us]."""
DECAY_ENDS = (10, 10_000_000)
"""Shortest and longest decay time [us]."""


class WindowActions(Actions):
    """Actions of the window. They only change what is wanted; the window then computes and draws it."""

    keys = KEYS
    image = ImageKind.COUNT
    decay_us = DECAY_US
    same_scale = False
    difference = False
    scene: Scene
    sheets: Sheets
    shown: DisplayedWindow
    """What the window shows."""
    has_shown = False
    """Whether there is anything in :attr:`shown`."""
    first_dark: bool
    """Whether the window was dark at first."""
    knob: str
    """Parameter that the arrow keys move, and over which the first curve is."""
    message: str
    """Text that is shown in the column."""
    plays = False
    loop = False
    closed = False
    help_shown = False
    statistics_shown = False
    depth_shown = False
    optic_shown = False
    """Whether a recording shows the controls of a prism though nothing says that there is one."""
    update: Callable[[], None]
    """Compute what was requested, and give it to VTK."""
    _slow: Iterator[None]  # what takes long, in steps
    _slow_steps: Callable[[], Iterator[None]]
    _show_progress: Callable[[str, float], None]
    _view_name = ""  # the bookmark that was shown last
    _picked = -1  # the event whose orbit is shown
    _played_s = 0.0  # when the time window was moved last by playing
    _ended_s = -math.inf  # when playing came to the end of the recording
    _job_keys = ""  # the keys that stop the calibration or film that runs
    _film_ends = False  # whether a film ends now

    def close(self) -> None:
        """Close the window after the current picture."""
        self.closed = True

    def key(self, key: str) -> None:
        """Run the action of a key, by its name in VTK."""
        name = X_KEYS.get(key, key)
        if name in OF_OPTICS and not self._has_controls:
            self.say(f"{name} is for a recording with a prism; x: set a prism")
            return
        super().key(name)

    def slide(self, name: str, value: float) -> None:
        """Set a value, in the unit of its slider."""
        if name == "start_ms":
            self.move_window(round(value * 1e3))
        elif name == "length_ms":
            start_us = self.time_window[0] - self.inspector.recording.events.t_first
            self.resize_window(start_us, start_us + round(value * 1e3))
        elif name in self.sliders:
            self.knob = name
            knobs = self.inspector.knobs.with_values({name: value * UNITS[name]})
            if knobs != self.inspector.knobs:
                self.inspector.set(knobs)
                self.request("knobs", change=name)

    @property
    def sliders(self) -> dict[str, Slider]:
        """Sliders by the name of their value."""
        return self.sheets.controls.sliders

    def move_window(self, start_us: int) -> None:
        """Move the time window to a start after the first event [us]; playing stops, except a live stream's."""
        self.plays = self.plays and self.inspector.latest is not None
        self.move(self.inspector.recording.events.t_first + start_us, change="start_ms")

    def resize_window(self, start_us: int, end_us: int) -> None:
        """Set the ends of the time window, after the first event [us]. It then keeps its length, not its events."""
        self.inspector.fixed_count = None
        start_us = max(0, start_us)
        length_us = min(max(1, end_us - start_us), self.whole_us)
        self.time_window = self.inspector.recording.events.t_first + start_us, length_us
        self.move(self.time_window[0], change="length_ms")

    def draw_region(self, region: Region) -> None:
        """Show a part of the image."""
        self._select(region=region)

    def sheets_changed(self) -> None:
        """Draw again what is beside the clouds."""
        self._sheets_old = True

    def nudge(self, steps: int) -> None:
        """Move the chosen parameter by steps of its slider."""
        if self.knob not in self.sliders:
            return
        value = sliders.knob_values(self.inspector)[self.knob]
        _, _, (_, _, step) = SLIDERS[self.knob]
        self.slide(self.knob, value + steps * step)

    def choose_next(self, what: str) -> None:
        """Choose the next "knob" (parameter for the keys and the curve), "model", "colour", "polarity" or "image"."""
        inspector = self.inspector
        knobs = self.inspector.knobs
        if what == "knob":
            names = [name for name in self.sliders if name not in FINE]
            self.knob = _following(names or [self.knob], self.knob)
            self.request("look")
        elif what == "model":
            model = _following(list(alternatives(knobs.model)), knobs.model)
            inspector.set(replace(knobs, model=model))
            self.request("knobs")
        elif what == "colour":
            colours = colours_on_offer(inspector.recording.truth)
            self.restyle(colour=_following(colours, self.look.colour))
        elif what == "image":
            shown = self.image, self.difference
            self.image, self.difference = _following(self._image_kinds(), shown)
            self.request("knobs")
        else:
            self._select(polarity=_following([None, 1, 0], inspector.selection.polarity))

    def filter(self, name: str) -> None:
        """Leave out the events of hot pixels ("hide_hot"), or background activity ("noise_us"), or show them again."""
        selection = self.inspector.selection
        if name == "hide_hot":
            self._select(hide_hot=not selection.hide_hot)
            if self.inspector.selection.hide_hot:
                self.update()  # which clears the message before
                self.say(self.message or _hot_text(self.inspector.hot_pixels))
        else:
            self._select(noise_us=NOISE_US if selection.noise_us is None else None)

    def scale_count(self, factor: float) -> None:
        """Show a time window with a multiple of the events; it keeps their number when it moves."""
        source = self.inspector.recording.events
        self.inspector.fixed_count = min(max(1, round(self.shown.span.count * factor)), len(source))
        self.request("window")

    def scale_decay(self, factor: float) -> None:
        """Show the decaying time surface with another decay time."""
        low, high = DECAY_ENDS
        self.image = ImageKind.DECAY
        self.difference = False
        self.decay_us = min(max(round(self.decay_us * factor), low), high)
        self.request("knobs")

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
        self.message = ""
        if name == "loop":
            self.message = "play in a loop" if self.loop else "play once"
        self._slow = self._slow_steps()
        self.request("look")

    def toggle_axis(self) -> None:
        """Switch the third axis between angle and time. Without a motion there is no angle."""
        if self.compensates or self.look.axis is Axis.ANGLE:
            super().toggle_axis()
        else:
            self.say("there is no prism angle; x: set a prism")

    def look_from(self, view: str) -> None:
        """Set the direction from which the clouds are seen, and fit them into the window."""
        self.view = View(view)
        self.depth_shown = False
        self.scene.look_from(self.view, self._look)
        self.request("look")

    def pick(self, place: tuple[int, int]) -> None:
        """Describe the event that is drawn at a place, and show its orbit. ``place``: pixels from left and bottom."""
        if self.depth_shown:
            return
        self._picked = self.scene.event_at(place, self.shown, self._look)
        text = ""
        if self._picked >= 0:
            text = captions.event_text(self.shown, self._picked, compensated=self.compensates)
        self.say(text)

    def reset(self) -> None:
        """Show the first state again, also light or dark, which the history does not hold."""
        super().reset()
        self.restyle(dark=self.first_dark)

    def whole(self) -> None:
        """Show the whole image."""
        self._select(region=None)

    def keep_b(self) -> None:
        """Keep the parameters as B, and show them on the left; a second time, show the recorded events again."""
        self.b = None if self.b == self.inspector.knobs else self.inspector.knobs
        self.request("knobs")

    def play(self) -> None:
        """Play the recording from the current window, or follow a live stream; stop if already playing.

        Who wants to stop just when playing ends does not start it again.
        """
        now = time.perf_counter()
        if now - self._ended_s < STOP_S:
            return
        was = self.plays
        self.plays = not self.plays and self.can_play()
        self._played_s = now
        if was:
            self.say("stopped")
        elif self.plays:
            self.say("")

    def calibrate(self) -> None:
        """Calibrate on the shown events, or cancel the running calibration. The window goes on meanwhile."""
        if self._job_keys:
            self._job_keys = ""
            return
        with self._job("calibration", "c cancels it"):
            self.calibration_result, text = calibration_job.find_calibration(
                self.inspector, progress=self._show_progress
            )
            self.message = f"{text}. Press a to accept"

    def film(self) -> None:
        """Save a film from here on under a new name in the current folder, or end it. The window goes on meanwhile."""
        self._film_ends = bool(self._job_keys)
        if self._job_keys:
            return
        with self._job("film", "f ends it, c cancels it"):
            path = self._new_name("film")
            clouds_film.write_film(
                path,
                self.inspector,
                self._look,
                self.view,
                self._show_progress,
                what="film",
                against=self.b,
                speed=SPEED,
                ended=lambda: self._film_ends,
            )
            self.message = f"saved {path} in {path.parent.resolve()}"

    @contextlib.contextmanager
    def _job(self, what: str, keys: str) -> Iterator[None]:
        """Run a long job, which :meth:`calibrate` cancels. ``keys``: those that stop it, in words."""
        self._job_keys = keys
        with self.errors_shown("window"):
            try:
                yield
            except JobCancelled:
                self.message = f"{what} cancelled"
        self._job_keys = ""
        self.request("look")

    def export(self, what: str) -> None:
        """Save the calibration, or a picture of the window, under a new name in the current folder."""
        path = self._new_name(what)
        with self.errors_shown("window"):
            if what == "picture":
                save_png(path, self.scene.picture())
            else:
                self.inspector.as_calibration().save(path)
            self.say(f"saved {path} in {path.parent.resolve()}")

    def choose_next_beside(self) -> None:
        """Show the next of the recordings that are on the same time axis."""
        others = self.inspector.besides
        now = self.inspector.beside
        if now is None:
            self.say("there is no other recording; start with --beside FILE")
            return
        self.choose_beside((others.index(now) + 1) % len(others))

    def save_next_view(self) -> None:
        """Save what is shown as a bookmark, under the first free number."""
        names = self._views()
        if names is None:
            return
        number = 1
        while f"view {number}" in names:
            number += 1
        self.save_view(f"view {number}")

    def open_view(self, name: str) -> None:
        """Show a bookmark, and its name or what is wrong with it."""
        self.message = f"bookmark {name}"
        self._view_name = name
        super().open_view(name)
        told = self.message
        self.update()
        self.say(self.message or told)

    def open_next_view(self) -> None:
        """Show the bookmark after the one that was shown last."""
        names = self._views()
        if names:
            self.open_view(_following(names, self._view_name))
        elif names is not None:
            self.say("there are no bookmarks; u saves one")

    def _views(self) -> list[str] | None:
        """Return the names of the bookmarks; None, with a message, if there can be none."""
        if self.bookmarks is None:
            self.say("bookmarks are kept beside a file; this recording is none")
            return None
        try:
            return self.bookmarks.names()
        except AmiwarpError as error:
            self.say(str(error))
            return None

    def _new_name(self, what: str) -> Path:
        return downloads.unused_path(downloads.download_name(self.inspector.recording.name, what))

    @property
    def _look(self) -> Look:
        against = "recorded" if self.b is None else "B"
        return self.look.for_clouds(captions.cloud_titles(self.inspector, against))

    def say(self, text: str) -> None:
        """Show a message."""
        self.message = text
        self.request("look")

    def _select(self, **changes: Any) -> None:
        inspector = self.inspector
        with self.errors_shown("window"):
            inspector.open(*self.time_window, replace(inspector.selection, **changes))
            self.request("knobs")

    @property
    def _has_controls(self) -> bool:
        """Whether there are controls of a prism."""
        return self.optic_shown or self.inspector.has_optic

    def _image_kinds(self) -> list[tuple[ImageKind, bool]]:
        """Return the kinds of images on offer, and whether the second one is their difference."""
        kinds = [(kind, False) for kind in ImageKind]
        if self.inspector.depth is None:
            kinds.remove((ImageKind.DEPTH, False))
        if not self.compensates:
            kinds = [(kind, False) for kind, _ in kinds if kind not in SLOW_KINDS]
        if len(self._look.titles) > 1:
            kinds.append((ImageKind.COUNT, True))
        return kinds

    @property
    def _image_name(self) -> str:
        return "difference" if self.difference else self.image.value


def _hot_text(hot: Sequence[HotPixel]) -> str:
    """Return how many hot pixels there are, and the places and rates of the busiest ones."""
    if not hot:
        return "no hot pixels found"
    busiest = "; ".join(
        f"x {pixel.x}, y {pixel.y}: {pixel.rate:,.0f} events/s" for pixel in hot[:NAMED_HOT]
    )
    most = "with the highest rates: " if len(hot) > NAMED_HOT else ""
    return f"{len(hot):,} hot pixel{'s' if len(hot) > 1 else ''} hidden; {most}{busiest}"


def _following(choices: list[Any], now: Any) -> Any:
    """Return the choice after the current one."""
    return choices[(choices.index(now) + 1) % len(choices) if now in choices else 0]
