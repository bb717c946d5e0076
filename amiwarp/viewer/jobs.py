"""Long-running jobs of a page: calibration, and playback of the recording."""

from __future__ import annotations

import asyncio
import math
import traceback
import weakref
from typing import TYPE_CHECKING, Any

from amiwarp.calib import Calibration, Settings, calibrate
from amiwarp.errors import AmiwarpError
from amiwarp.progress import Progress

if TYPE_CHECKING:
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
    """Calibration of the panel's recording, in a thread."""

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
        state.update({"busy": "calibrating", "calibrating": True, "progress": 0, "found": ""})
        self._panel.start_job(self._run())

    def cancel(self) -> None:
        self.cancelled = True

    async def _run(self) -> None:
        panel, inspector = self._panel, self._panel.inspector
        rpm = inspector.knobs.rpm
        settings = Settings(start={} if inspector.has_encoder or not rpm else {"rpm": rpm})
        try:
            async with panel.device_lock:
                progress = _progress_callback(self)
                found = await panel.in_thread(
                    _calibrate, inspector.recording, settings, device=inspector.device, progress=progress
                )
            if self.cancelled:
                panel.show_message("calibration cancelled", "info")
            elif isinstance(found, str):
                panel.show_message(found, "error")
            else:
                self.found = found
                with panel.state:
                    panel.state.found = summary(found)
        finally:
            with panel.state:
                panel.state.update({"busy": "", "calibrating": False})

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


def _calibrate(*args: Any, **options: Any) -> Calibration | str:
    """Return the result of :func:`calibrate`, or the text of its error.

    NLopt also keeps the last error, and its traceback would keep all local variables alive.
    """
    try:
        return calibrate(*args, **options)
    except (AmiwarpError, JobCancelled) as error:
        traceback.clear_frames(error.__traceback__)
        return str(error)


def summary(c: Calibration) -> str:
    """Return a one-line description of a calibration."""
    p, exact = c.parameters, c.exact.parameters
    warnings = "".join(f"; {text}" for text in c.warnings)
    apex, phase = (math.degrees(x) for x in (exact.get("apex", 0.0), p["phase"]))
    return (
        f"{c.model_name} model, apex {apex:.4g}°, phase {phase:.4g}°; "
        f"sharpness {c.sharpness_before:.3g} to {c.sharpness_after:.3g}; {c.seconds:.1f} s{warnings}"
    )


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
        while state.playing:
            with state:
                panel.renew()
            await panel.wait_until_drawn()
            await asyncio.sleep(FOLLOW_S)
        panel.slider_released()
