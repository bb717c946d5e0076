"""What a panel does for longer: a calibration that can be cancelled, a recording that plays, films."""

from __future__ import annotations

import asyncio
import math
import traceback
import weakref
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from amiwarp.calib import Calibration, Settings, calibrate
from amiwarp.errors import AmiwarpError
from amiwarp.progress import Progress
from amiwarp.reconstruction.export import save_film

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from amiwarp.viewer.panel import Panel

FRAMES, FPS = 90, 25.0
"""Of a film."""
LEAST_S, LIVE_S = 0.05, 0.25
"""Between the pictures of a recording that is played, and of a live stream."""
PROGRESS_S = 0.1
"""Between two words of a calibration's progress: a small recording has eighty in a second, a page draws all of them."""


class Cancelled(Exception):
    """Raised inside work that nobody waits for any more."""


class Calibrating:
    """A calibration of the panel's recording, in a thread."""

    def __init__(self, panel: Panel) -> None:
        self._panel, self.cancelled = panel, False
        self.found: Calibration | None = None
        """What waits to be accepted."""

    def toggle(self) -> None:
        """Starts it, or cancels the one that runs."""
        state = self._panel.state
        if state.busy:
            if state.busy.startswith("calibrating"):
                self.cancelled = True
                state.busy = "calibrating: about to be cancelled"
            return
        self.cancelled, self.found = False, None
        state.update({"busy": "calibrating", "progress": 0, "found": ""})
        self._panel.begin(self._run())

    def cancel(self) -> None:
        self.cancelled = True

    async def _run(self) -> None:
        panel, inspector = self._panel, self._panel.inspector
        rpm = inspector.knobs.rpm
        settings = Settings(start={} if inspector.has_encoder or not rpm else {"rpm": rpm})
        try:
            async with panel.warp:
                found = await panel.in_thread(
                    _calibrate, inspector.recording, settings, device=inspector.device, progress=_teller(self)
                )
            if self.cancelled:
                panel.say("calibration cancelled", "info")
            elif isinstance(found, str):
                panel.say(found, "error")
            else:
                self.found = found
                with panel.state:
                    panel.state.found = summary(found)
        finally:
            with panel.state:
                panel.state.busy = ""

    def tell(self, what: str, share: float) -> None:
        """Shows how far it is."""
        if self.cancelled:
            return
        with self._panel.state:
            self._panel.state.update({"busy": what, "progress": round(100 * min(share, 1.0))})


def _teller(job: Calibrating) -> Progress:
    """What a calibration calls in its thread. NLopt never lets go of what it calls, so this knows the job weakly."""
    known, loop, told = weakref.ref(job), asyncio.get_running_loop(), -math.inf

    def tell(what: str, share: float) -> None:
        nonlocal told
        if not wanted():
            raise Cancelled
        if (now := loop.time()) >= told + PROGRESS_S:
            told = now
            loop.call_soon_threadsafe(show, what, share)

    def wanted() -> bool:
        job = known()
        return job is not None and not job.cancelled

    def show(what: str, share: float) -> None:
        if (job := known()) is not None:
            job.tell(what, share)

    return tell


def _calibrate(*args: Any, **options: Any) -> Calibration | str:
    """What :func:`calibrate` finds, or why nothing: NLopt also keeps what was raised, and with it every frame."""
    try:
        return calibrate(*args, **options)
    except (AmiwarpError, Cancelled) as error:
        traceback.clear_frames(error.__traceback__)
        return str(error)


def summary(c: Calibration) -> str:
    """A calibration in a line."""
    p, exact = c.parameters, c.exact.parameters
    warnings = "".join(f"; {text}" for text in c.warnings)
    apex, phase = (math.degrees(x) for x in (exact.get("apex", 0.0), p["phase"]))
    return (
        f"{c.model_name} model, apex {apex:.4g}°, phase {phase:.4g}°; "
        f"sharpness {c.sharpness_before:.3g} to {c.sharpness_after:.3g}; {c.seconds:.1f} s{warnings}"
    )


class Playing:
    """The panel's window moving through the recording, on the page or into a film."""

    def __init__(self, panel: Panel) -> None:
        self._panel, self._ended = panel, False
        self.runs = False
        """Until it has noticed that it was stopped, too."""

    def end(self) -> None:
        """Also of a film that is being written."""
        self._ended = True

    def toggle(self) -> None:
        """Runs through the recording from here, or follows a live stream, or stops."""
        state = self._panel.state
        state.playing = not state.playing
        if not state.playing or self.runs:
            return
        if self._panel.inspector.latest is None and self._panel.move(float(state.start_ms)):
            self._panel.move(0.0)  # at the end: from the beginning
        self.runs = True
        self._panel.begin(self._play())

    async def _play(self) -> None:
        try:
            await (self._run() if self._panel.inspector.latest is None else self._follow())
        finally:
            self.runs = False

    async def _run(self) -> None:
        panel, state, loop = self._panel, self._panel.state, asyncio.get_running_loop()
        took = LEAST_S
        while state.playing:
            began = loop.time()
            with state:
                if panel.move(float(state.start_ms) + 1e3 * took * float(state.speed)):
                    state.playing = False
                panel.ask("window")
            await panel.settled()
            await asyncio.sleep(max(0.0, LEAST_S - (loop.time() - began)))
            took = loop.time() - began
        panel.released()

    async def _follow(self) -> None:
        panel, state = self._panel, self._panel.state
        while state.playing:
            with state:
                panel.renew()
            await panel.settled()
            await asyncio.sleep(LIVE_S)
        panel.released()

    def turntable(self) -> None:
        """Writes a film of one turn about the clouds."""
        self._panel.begin(self._film("turntable", lambda: self._panel.scene.turntable(FRAMES)))

    def film(self) -> None:
        """Writes a film of the recording from here on."""
        self._panel.begin(self._film("film", self._frames))

    async def _film(self, what: str, frames: Callable[[], Iterator[NDArray[np.uint8]]]) -> None:
        """Drawn one by one in this loop, which serves the pages in between, and written in a thread."""
        panel, state, loop, pictures = self._panel, self._panel.state, asyncio.get_running_loop(), frames()
        if state.busy:
            return

        async def draw() -> NDArray[np.uint8] | None:
            await panel.settled()
            if self._ended:
                raise Cancelled
            with state:
                state.progress += 100.0 / FRAMES
                return next(pictures, None)

        def drawn() -> Iterator[NDArray[np.uint8]]:
            while (picture := asyncio.run_coroutine_threadsafe(draw(), loop).result()) is not None:
                yield picture

        with state:
            state.update({"busy": f"writing the {what}", "progress": 0})
        try:
            with panel.reported("export"):
                path = panel.path(what, ".mp4", ".gif")
                count = await panel.in_thread(save_film, drawn(), path, fps=FPS)
                panel.say(f"{path}: {count} frames written", "success")
            panel.server.controller.view_update()
        finally:
            with state:
                state.busy = ""

    def _frames(self) -> Iterator[Any]:
        panel = self._panel
        for _ in range(FRAMES):
            picture = panel.scene.picture()
            ended = panel.move(float(panel.state.start_ms) + 1e3 / FPS * float(panel.state.speed))
            panel.ask("window")  # drawn when the next picture is asked for
            yield picture
            if ended:
                return
