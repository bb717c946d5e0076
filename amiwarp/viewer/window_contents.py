"""What the parts of the window show: sliders, texts, timeline, images and curves, as the inspector computes them."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amiwarp.choices import Vote
from amiwarp.imaging.iwe import iwe
from amiwarp.io.event_rates import EventRates
from amiwarp.plotting.colours import count_scale
from amiwarp.viewer import captions, layout, sliders
from amiwarp.viewer.filters import step_rows
from amiwarp.viewer.images import SLOW_KINDS, ImageKind, ShownImages, make_images
from amiwarp.viewer.sliders import UNITS
from amiwarp.viewer.window_actions import SPEED, WindowActions
from amiwarp.viewer.window_controls import Slider
from amiwarp.viewer.window_images import ImagePanel, panels_of
from amiwarp.viewer.window_keys import help_rows


class WindowContents(WindowActions):
    """Contents of the window's parts. The window says when they have changed, and draws them."""

    def _prepare(self) -> None:
        """Begin without curves and images."""
        self.curves: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        """Values and sharpness of the curves by parameter, in the units of the sliders."""
        self._curves_of: dict[str, Any] = {}  # window and selection of which the curves are
        self._statistics_of: Any = None  # window and selection of which the statistics are
        self._images: tuple[str, ShownImages] | None = None  # with their name
        self._scale_held = False  # whether the images have the scale of before a slider moved
        self._count_anew()
        self._rates_shown: tuple[Any, ...] = ()
        self._stream: list[str] = []  # figures of a live stream

    def _count_anew(self) -> None:
        """Begin to count the events for the timeline; the events of a live stream change."""
        self._counted = self.inspector.recording.events
        self._counted_stop_us = self._counted.t_last + 1
        self._rates = EventRates(self._counted)

    def _fields(self) -> list[Slider]:
        """Return the sliders of the parameters that matter, and of the time window."""
        out = self._parameter_fields() if self._has_controls else []
        whole_ms = self.whole_us * 1e-3
        start_us, length_us = self.time_window
        start_ms = (start_us - self.inspector.recording.events.t_first) * 1e-3
        title = f"window from {start_ms:.3f} ms"
        out.append(Slider("start_ms", start_ms, 0.0, whole_ms, 1e-3, title))
        length_ms = length_us * 1e-3
        title = f"length {length_ms:.3f} ms"
        if self.inspector.fixed_count is not None:
            title += f" ({self.inspector.fixed_count:,} events)"
        least_ms = min(0.1, 0.5 * whole_ms)
        out.append(Slider("length_ms", length_ms, least_ms, whole_ms, 1e-3, title))
        return out

    def _parameter_fields(self) -> list[Slider]:
        """Return the sliders of the parameters that are not 0, or that matter even then."""
        out = []
        always = (*self.inspector.orbit_names, "clock_offset", "rpm")
        for slider in sliders.sliders(self.inspector):
            name = slider["name"]
            value = slider["value"]
            if value or name in always or name.startswith("tilt"):
                title = f"{slider['label']} {sliders.with_unit(name, value, 6)} ({slider['note']})"
                ends = slider["least"], slider["most"]
                out.append(Slider(name, value, *ends, slider["step"], title))
        return out

    def _set_texts(self) -> None:
        """Set what the column says: the rate, what the filters leave, a message, and what is missing."""
        shown = self.shown
        notes = ["x: set a prism"]
        rate = f"{shown.span.count / shown.span.length_us * 1e6:,.0f} events/s"
        if self._has_controls:
            rate = f"model {self.inspector.knobs.model}, {rate}"
            notes = layout.what_is_missing(self.inspector)
        steps = [f"{name}: {rates}" for name, rates, _ in step_rows(shown.steps, shown.read_us)]
        both = [", ".join(row) for row in captions.beside_rows(self.inspector, shown)]
        self.sheets.controls.texts = [
            rate,
            *steps,
            *both,
            "h: help",
            "",
            *self._playing,
            self.message,
            *notes,
        ]
        self.sheets.controls.rows = self._stream
        self.sheets.statistics_old = self._statistics_of not in (
            None,
            self.inspector.window_and_selection,
        )
        self.sheets.help_rows = help_rows(
            optic=self._has_controls, depth=self.inspector.depth is not None
        )

    @property
    def _playing(self) -> list[str]:
        """Say that a recording is played, or that this has ended; a live stream has figures of its own."""
        if self.plays and self.inspector.latest is None:
            return [f"playing at {SPEED:g} × real time; space stops"]
        at_end = sum(self.time_window) > self.inspector.recording.events.t_last
        if at_end and math.isfinite(self._ended_s):
            return ["stopped at the end of the recording"]
        return []

    def _show_timeline(self) -> None:
        """Give the time window and the rates to the timeline."""
        line = self.sheets.timeline
        source = self.inspector.recording.events
        before = line.window
        line.window = (self.time_window[0] - source.t_first, self.time_window[1])
        if line.whole_us != self.whole_us:
            line.whole_us = self.whole_us
            line.show_all()
        if line.window != before:  # else the mouse may have moved the timeline away from it
            line.follow()
        progress = self._rates.share, self._rates.ended
        wanted = line.span, source.t_first, self._rates, progress
        if wanted != self._rates_shown:
            self._rates_shown = wanted
            low, high = (source.t_first + round(end) for end in line.span)
            edges, line.rates = self._rates.curve(low, high, layout.RATE_BINS)
            # Which a live stream has received since
            line.rates[:, edges[1:] > self._counted_stop_us] = np.nan
            line.edges = np.asarray(edges - source.t_first, np.float64)
            counted = self._rates.ended or self.inspector.latest is not None
            line.note = "" if counted else f"counting events: {100.0 * self._rates.share:.0f} %"

    def _make_images(self) -> None:
        """Make the images of what is shown. While a slider moves they keep their brightness.

        Some take long: they are made when nothing moves.
        """
        if self.image in SLOW_KINDS:
            self._images = None
            text = f"{self.image.value}: when nothing moves"
            self.sheets.show_images([], self.shown.region, text)
            return
        before = self._images
        self._new_images()
        if self._scale_held and before is not None and self._images is not None:
            name_before, images_before = before
            name, images = self._images
            if name_before == name:
                scale = images_before.scale
                kept = replace(images, scale=scale, after_scale=images_before.after_scale)
                self._images = name, kept
        self._show_images()

    def _new_images(self) -> None:
        """Make the images of what is shown, or say why there are none."""
        self._images = None
        with self.errors_shown("images"):
            images = make_images(
                self.inspector,
                self.image,
                against=self.b,
                shown=self.shown,
                difference=self.difference,
                decay_us=self.decay_us,
                same_scale=self.same_scale,
            )
            self._images = self._image_name, images

    def _show_images(self) -> None:
        """Give the images to the row. Of a recording without a prism, there is the whole image beside a region."""
        region = self.shown.region
        titles = self._look.titles
        if self._images is None:
            self.sheets.show_images([], region, "no images")
            return
        name, images = self._images
        named = tuple(f"{title}: {name}" for title in titles)
        if self.image is ImageKind.DEPTH or self.difference:  # beside the events as recorded
            named = f"{titles[0]}: {ImageKind.COUNT.value}", name
        panels = panels_of(images, named, region)
        size = self.inspector.recording.events.size
        if not self.compensates and region != (0, 0, *size):
            whole = iwe(self.shown.span.events, *size, vote=Vote.NEAREST)
            panel = ImagePanel("whole image: count", whole, count_scale([whole]), (0, 0, *size))
            panels.insert(0, panel)
        self.sheets.show_images(panels, region, images.note)

    def _curve_names(self) -> tuple[str, ...]:
        """Return the parameters of the two sharpness curves: the chosen one, and phase or the first one."""
        if not self.compensates:
            return ()
        return self.knob, next(name for name in ("phase", *self.sliders) if name != self.knob)

    def _slow_steps(self) -> Iterator[None]:
        """Compute statistics, slow images and sharpness curves in steps, so that the window follows its user."""
        if self.statistics_shown:
            self.sheets.show_statistics(self.inspector.statistics())
            self._statistics_of = self.inspector.window_and_selection
            self.sheets_changed()
            yield
        if self.image in SLOW_KINDS:
            self._new_images()
            self._show_images()
            self.sheets_changed()
            yield
        for name in self._curve_names():
            found = []
            chosen = self.inspector.window_and_selection
            for point in self.inspector.curve_points(name):
                found.append(point)
                yield
            values, sharpness = np.array(found).T
            self.curves[name] = values / UNITS[name], sharpness
            self._curves_of[name] = chosen
            self._show_curve(name)
            self.sheets_changed()

    def _show_curve(self, name: str) -> None:
        """Show a sharpness curve with the current value and the known true one.

        A curve of the window or selection before is grey, until the new one is computed.
        """
        if name in self.sheets.charts and name in self.curves:
            known = sliders.truths(self.inspector)[name], sliders.knob_values(self.inspector)[name]
            old = self._curves_of[name] != self.inspector.window_and_selection
            self.sheets.show_curve(name, *self.curves[name], known, old=old)
