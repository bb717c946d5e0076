"""Long-running jobs of a page: calibration, and playback of the recording."""

from __future__ import annotations

import asyncio
import math
import traceback
import weakref
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from amiwarp.errors import AmiwarpError
from amiwarp.progress import Progress
from amiwarp.viewer.layout import SCOPES, SLIDERS, UNITS
from amiwarp.viewer.live_source import LiveFigures, LiveSource
from amiwarp.viewer.selected_calibration import (
    CostSurface,
    FoundCalibration,
    calibrate_selected,
    calibrate_whole,
    cost_surface,
)

if TYPE_CHECKING:
    from amiwarp.calib import Calibration
    from amiwarp.viewer.inspector import Inspector
    from amiwarp.viewer.panel import Panel

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
