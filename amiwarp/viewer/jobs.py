"""Long-running jobs of a page: calibration, and playback of the recording."""

from __future__ import annotations

import asyncio
import math
import traceback
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amiwarp.calib import Calibration, Settings, calibrate
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import rpm_between
from amiwarp.progress import Progress, silent
from amiwarp.viewer.images import SelectedPart, select_part
from amiwarp.viewer.layout import SCOPES, SLIDERS, UNITS
from amiwarp.viewer.window import CURVE_HALF_WIDTH, Source, WindowImager

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from amiwarp.events.recording import Recording
    from amiwarp.live.stream.recent_events import RecentEvents
    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.panel import Panel


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
    measure = inspector.sharpness_meter(WindowImager(inspector.recording.events.size, inspector.device))
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


def scope_text(inspector: Inspector) -> str:
    """Return on which events :func:`calibrate_selected` works, for the page."""
    return _text(inspector, _part(inspector))


def calibrate_selected(
    inspector: Inspector, settings: Settings | None = None, *, progress: Progress | None = None
) -> FoundCalibration:
    """Calibrate on the events of the window and the selection.

    Without an encoder, the search starts at the speed set on the page. Raises :class:`AmiwarpError` if these events
    cannot determine the parameters.
    """
    part = _part(inspector)
    scope = _text(inspector, part)
    found = calibrate(part.recording, _started(inspector, settings), device=inspector.device, progress=progress)
    whole = replace(found, camera=inspector.camera)
    return _compared(inspector, whole, scope)


def calibrate_whole(
    inspector: Inspector, settings: Settings | None = None, *, progress: Progress | None = None
) -> FoundCalibration:
    """Calibrate on the whole recording, as ``amiwarp calibrate`` does.

    Without an encoder, the search starts at the speed set on the page. Raises :class:`AmiwarpError` if the recording
    cannot determine the parameters.
    """
    recording = inspector.recording
    found = calibrate(recording, _started(inspector, settings), device=inspector.device, progress=progress)
    return _compared(inspector, found, f"the whole recording, {len(recording.events):,} events")


def _started(inspector: Inspector, settings: Settings | None) -> Settings:
    """Return settings that start at the speed set on the page if there is no encoder."""
    settings, rpm = settings or Settings(), inspector.knobs.rpm
    return settings if inspector.has_encoder or not rpm else replace(settings, start={"rpm": rpm, **settings.start})


def _compared(inspector: Inspector, found: Calibration, scope: str) -> FoundCalibration:
    """Return a calibration with the sharpness of the shown region before and after it."""
    sharpness = inspector.sharpness_meter(WindowImager(inspector.recording.events.size, inspector.device))
    values = (sharpness(each) for each in (None, inspector.knobs, inspector.knobs_of(found)))
    return FoundCalibration(found, scope, *values)


def _part(inspector: Inspector) -> SelectedPart:
    window = inspector.loaded
    return select_part(inspector, window, window.region)


def _text(inspector: Inspector, part: SelectedPart) -> str:
    """Return a description of the events of a part."""
    s, first = inspector.selection, inspector.recording.events.t_first
    start_s = (part.start_us - first) * 1e-6
    kind = "" if s.polarity is None else ("OFF ", "ON ")[s.polarity]
    texts = [
        f"{len(part.recording.events):,} {kind}events from {start_s:.3f} s to {start_s + part.length_us * 1e-6:.3f} s"
    ]
    if s.region is not None:
        left, top, right, bottom = s.region
        texts.append(f"x {left} to {right - 1}, y {top} to {bottom - 1} px")
    texts += ["without hot pixels"] if s.hide_hot else []
    texts += [f"without background activity ({s.noise_us * 1e-3:g} ms)"] if s.noise_us is not None else []
    return ", ".join(texts)


@dataclass(frozen=True, eq=False)
class CostSurface:
    """Sharpness of the shown region over two parameters, with all others fixed."""

    names: tuple[str, str]
    """Names of the parameters along the columns and along the rows."""
    values: tuple[NDArray[np.float64], NDArray[np.float64]]
    """Values of these parameters, in their units, shapes ``(columns,)`` and ``(rows,)``."""
    sharpness: NDArray[np.float64]
    """Sharpness, shape ``(rows, columns)``."""

    @property
    def best(self) -> tuple[float, float]:
        """Values of both parameters with the largest sharpness."""
        row, column = np.unravel_index(int(np.argmax(self.sharpness)), self.sharpness.shape)
        return float(self.values[0][column]), float(self.values[1][row])


def cost_surface(
    inspector: Inspector, *, points: tuple[int, int] = SURFACE_POINTS, progress: Progress | None = None
) -> CostSurface:
    """Return the sharpness over the two parameters that matter most.

    These are apex, from 0 to twice its value, and phase, over one turn about its value. Without an encoder, they are
    speed and apex. ``points``: numbers of their values. The call may run in a thread; ``progress`` may raise an error
    to stop it.
    """
    progress, current = progress or silent, inspector.knobs
    sharpness = inspector.sharpness_meter(WindowImager(inspector.recording.events.size, inspector.device))
    apex = np.linspace(0.0, 2.0 * (current.apex or inspector.prism.apex), points[0])
    if inspector.has_encoder:
        names, values = ("apex", "phase"), (apex, current.phase + np.linspace(-math.pi, math.pi, points[1]))
    else:
        width = CURVE_HALF_WIDTH["rpm"]
        names, values = ("apex", "rpm"), (apex, current.rpm + np.linspace(-width, width, points[1]))
    out = np.empty((len(values[1]), len(values[0])))
    for row, second in enumerate(values[1]):
        progress(f"sharpness over {names[0]} and {names[1]}", row / len(out))
        for column, first in enumerate(values[0]):
            changes: dict[str, Any] = {names[0]: float(first), names[1]: float(second)}
            out[row, column] = sharpness(replace(current, **changes))
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
            self._messages[-1] if self._messages else "",
        )  # fmt: skip


PLAY_S, FOLLOW_S = 0.05, 0.25
"""Shortest interval between two pictures while a recording is played, and while a live stream is followed [s]."""
PROGRESS_S = 0.1
"""Shortest interval between two progress messages of a calibration [s].

A small recording causes eighty per second, and the page would draw each of them.
"""


class JobCancelled(Exception):
    """Raised to stop work whose result is no longer needed."""


class CalibrationJob:
    """Calibration on what the page shows or on the whole recording, in a thread, and its map of sharpness."""

    def __init__(self, panel: Panel) -> None:
        self._panel, self.cancelled = panel, False
        self.found: Calibration | None = None
        """Result of the calibration that the user has not accepted yet; None if there is none."""

    def toggle(self) -> None:
        """Start a calibration, or cancel the running one."""
        state = self._panel.state
        if state.busy:
            if state.calibrating:
                self.cancelled = True
                state.busy = "calibrating: cancelling"
            return
        self.cancelled, self.found = False, None
        state.update({"busy": "calibrating", "calibrating": True, "progress": 0, "found": "", "surface": None})
        self._panel.start_job(self._run())

    def cancel(self) -> None:
        self.cancelled = True

    async def _run(self) -> None:
        panel, inspector = self._panel, self._panel.inspector
        call = calibrate_selected if panel.state.scope == SCOPES[0] else calibrate_whole
        try:
            found = await self._in_thread(call, inspector)
            if isinstance(found, str):
                text, severity = ("calibration cancelled", "info") if self.cancelled else (found, "error")
                panel.show_message(text, severity)
                return
            self.found = found.calibration
            with panel.state:
                panel.state.found = summary(found)
                panel.state.against_choices = panel.comparison.choices
            surface = await self._in_thread(cost_surface, inspector)
            if not isinstance(surface, str) and panel.inspector is inspector:
                with panel.state:
                    panel.state.surface = surface_state(surface, inspector, self.found)
        finally:
            with panel.state:
                panel.state.update({"busy": "", "calibrating": False})

    async def _in_thread(self, call: Callable[..., Any], inspector: Inspector) -> Any:
        """Return the result of a call with progress, or the text of its error."""
        progress = _progress_callback(self)
        async with self._panel.device_lock:
            return await self._panel.in_thread(_guarded, call, weakref.ref(inspector), progress)

    def show_progress(self, what: str, share: float) -> None:
        """Show the current step and the finished share, 0 to 1."""
        if self.cancelled:
            return
        with self._panel.state:
            self._panel.state.update({"busy": what, "progress": round(100 * min(share, 1.0))})


def _progress_callback(job: CalibrationJob) -> Progress:
    """Return the progress callback of a calibration, which stops the calibration once the job is cancelled.

    It holds the job by a weak reference, because NLopt never releases its callbacks.
    """
    job_reference, loop, last_s = weakref.ref(job), asyncio.get_running_loop(), -math.inf

    def progress(what: str, share: float) -> None:
        nonlocal last_s
        if not wanted():
            raise JobCancelled
        if (now := loop.time()) >= last_s + PROGRESS_S:
            last_s = now
            loop.call_soon_threadsafe(show, what, share)

    def wanted() -> bool:
        job = job_reference()
        return job is not None and not job.cancelled

    def show(what: str, share: float) -> None:
        if (job := job_reference()) is not None:
            job.show_progress(what, share)

    return progress


def _guarded(call: Callable[..., Any], inspector: weakref.ref[Inspector], progress: Progress) -> Any:
    """Return the result of a call, or the text of its error; None if the inspector is gone.

    NLopt keeps the last error, and its traceback would keep all local variables of this call and its callers alive.
    """
    known = inspector()
    try:
        return None if known is None else call(known, progress=progress)
    except (AmiwarpError, JobCancelled) as error:
        traceback.clear_frames(error.__traceback__)
        return str(error)
    finally:
        known = None


def summary(found: FoundCalibration) -> str:
    """Return a description of the result of a calibration."""
    c = found.calibration
    p, exact = c.parameters, c.exact.parameters
    warnings = "".join(f"; {text}" for text in c.warnings)
    apex, phase = (math.degrees(x) for x in (exact.get("apex", 0.0), p["phase"]))
    return (
        f"found on {found.scope}: {c.model_name} model, apex {apex:.4g}°, phase {phase:.4g}°; sharpness of the region "
        f"{found.before:.3g} as recorded, {found.current:.3g} now, {found.after:.3g} with the result; "
        f"{c.seconds:.1f} s{warnings}"
    )


def live_state(f: LiveFigures) -> dict[str, Any]:
    """Return the figures of a stream for the page: rows of name, value and whether it is bad, and what is wrong."""
    angles, speed = f.connected and not f.no_angles, "unknown" if f.rpm is None else f"{f.rpm:.1f} rpm"
    fresh = angles and f.turn_share >= 1.0
    rows: list[tuple[str, str, bool]] = [
        ("events", "receiving" if f.connected else "interrupted, last ones shown", not f.connected),
        ("prism angles", "receiving" if angles else "interrupted, last turn shown", not angles),
        ("rate", f"{f.rate_mev_s:.2f} million events/s", False),
        ("latency", f"{f.latency_ms:.0f} ms" if f.connected else "–", f.connected and f.latency_ms > 1e3),
        ("turn covered", f"{100.0 * f.turn_share:.0f} %", f.turn_share < 1.0),
        ("speed of the prism", speed if fresh else f"{speed}, last measured", f.rpm is None or not fresh),
        ("lost events", f"{f.dropped:,}", f.dropped > 0), ("out of order", f"{f.late:,}", f.late > 0),
    ]  # fmt: skip
    if f.connected and f.message:
        rows.append(("last message", f.message, False))
    message = "" if f.message == f.problem else f.message
    note = "" if f.connected else f"The stream is interrupted: {f.problem}. {message}".strip()
    if f.no_angles:
        note = f"No prism angles arrive: {f.no_angles}. The last turn before it is shown, until they return."
    return {"live_rows": [[name, text, "bad" if bad else ""] for name, text, bad in rows], "stream_note": note}


def surface_state(surface: CostSurface, inspector: Inspector, found: Calibration | None) -> dict[str, Any]:
    """Return the map of sharpness for the page, with marks of the current, the found and the true parameters."""
    names, scales = surface.names, [UNITS[name] for name in surface.names]
    x, y = ((values / scale).tolist() for values, scale in zip(surface.values, scales, strict=True))
    known = {"now": ("○", inspector.knobs), "truth": ("◇", inspector.truth),
             "result": ("✕", None if found is None else inspector.knobs_of(found))}  # fmt: skip
    marks = []
    for title, (sign, knobs) in known.items():
        if knobs is not None:
            place = [getattr(knobs, name) / scale for name, scale in zip(names, scales, strict=True)]
            if names[1] == "phase":
                place[1] += 360.0 * round((inspector.knobs.phase / scales[1] - place[1]) / 360.0)
            marks.append({"x": place[0], "y": place[1], "sign": sign, "title": title})
    titles = [f"{SLIDERS[name][0]} ({SLIDERS[name][1]})" for name in names]
    return {"x": x, "y": y, "values": surface.sharpness.tolist(), "marks": marks, "x_title": titles[0],
            "y_title": titles[1]}  # fmt: skip


class Playback:
    """Playback of the recording: moves the time window through it, on the page or for a film."""

    def __init__(self, panel: Panel) -> None:
        self._panel, self._ended = panel, False
        self.runs = False
        """Whether the playback task is running; after a stop it runs until it notices the stop."""

    def end(self) -> None:
        """Stop the playback for good."""
        self._ended = True

    def toggle(self) -> None:
        """Play the recording from the current window, or follow a live stream; stop if already playing."""
        state = self._panel.state
        state.playing = not state.playing
        if not state.playing or self.runs:
            return
        if self._panel.inspector.latest is None and self._panel.move(float(state.start_ms)):
            self._panel.move(0.0)  # restart after the end
        self.runs = True
        self._panel.start_job(self._play())

    async def watch(self, source: LiveSource) -> None:
        """Show the figures of a live stream, also while it is not followed, until the page is closed."""
        while True:
            with self._panel.state as state:
                state.update(live_state(source.figures()))
            await asyncio.sleep(FOLLOW_S)

    async def _play(self) -> None:
        try:
            await (self._run() if self._panel.inspector.latest is None else self._follow())
        finally:
            self.runs = False

    async def _run(self) -> None:
        panel, state, loop = self._panel, self._panel.state, asyncio.get_running_loop()
        elapsed_s = PLAY_S
        while state.playing:
            start_s = loop.time()
            with state:
                if panel.move(float(state.start_ms) + 1e3 * elapsed_s * float(state.speed)):
                    state.playing = bool(state.loop)
                    panel.move(0.0 if state.loop else float(state.start_ms))
            await panel.wait_until_drawn()
            await asyncio.sleep(max(0.0, PLAY_S - (loop.time() - start_s)))
            elapsed_s = loop.time() - start_s
        panel.slider_released()

    async def _follow(self) -> None:
        panel, state = self._panel, self._panel.state
        await panel.wait_until_drawn()  # with the suggested region
        while state.playing:
            with state:
                panel.renew()
            await panel.wait_until_drawn()
            await asyncio.sleep(FOLLOW_S)
        panel.slider_released()
