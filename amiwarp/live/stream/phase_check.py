"""A watch beside a stream: looks from time to time whether the prism's phase is still what it was."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from amiwarp.calib import calibrate
from amiwarp.compensation.streams import held_bytes
from amiwarp.errors import AmiwarpError
from amiwarp.events.encoder import TURN
from amiwarp.events.events import Events, MemoryEvents
from amiwarp.events.recording import Recording

if TYPE_CHECKING:
    from amiwarp.calib.result import Calibration
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.encoder_stream import EncoderStream

REACH = math.radians(20.0)
"""A phase further off is not sought: then the answer lies at the edge, and is further off than anyone bears anyway."""
MUCH, FAR = math.radians(1.5), math.radians(5.0)
"""Changes since the first look, and distances from the calibrated phase, that are told; its bias is up to 3 deg."""
LEAST = 20_000
"""Events, and at least half a turn of them, without which nothing is said."""
MOST_BYTES = 1 << 24
"""Memory of the events that are remembered, the last ones: about a million."""
EVALUATIONS = 40


@dataclass(frozen=True, slots=True)
class Phase:
    """What was found."""

    away: float
    """From the calibrated phase [rad]."""
    std: float
    """[rad]"""


class PhaseCheck:
    """Finds the phase anew by sharpness, on the CPU and in a thread of its own; give it what the compensator gets.

    Sharpness has a bias that the sensor gives it, so what counts is the change since the first look.
    """

    def __init__(self, calibration: Calibration, every_s: float, say: Callable[[str], None]) -> None:
        """``say`` gets a sentence where the phase has changed."""
        self._calibration, self._every_s, self._say = calibration, every_s, say
        self._due, self._closed = 0.0, False
        self._recent: deque[Events] = deque()
        self.held_bytes = 0
        """Memory that these take [bytes]."""
        self._thread: threading.Thread | None = None
        self._found: Phase | None = None
        self._first: Phase | None = None
        self._away: float | None = None
        self._told: float | None = None

    def look(self, encoder: EncoderStream) -> float | None:
        """Starts a look where it is time; what the last one found, from the calibrated phase [rad], None before it."""
        found = self.result()
        if found is not None:
            self._first = self._first or found
            self._away = found.away
            self._judge(found, self._first)
        if time.monotonic() >= self._due and self.begin(encoder):
            self._due = time.monotonic() + self._every_s
        return self._away

    def _judge(self, found: Phase, first: Phase) -> None:
        changed = found.away - first.away
        if self._told is not None and abs(found.away - self._told) < MUCH:
            return
        self._told = None
        if abs(found.away) > FAR:
            self._told = found.away
            self._say(f"the phase is {math.degrees(found.away):+.1f} deg from the calibrated one: calibrate anew")
        elif abs(changed) > max(MUCH, 4.0 * math.hypot(found.std, first.std)):
            self._told = found.away
            since = f"since the first look, {math.degrees(found.away):+.1f} from the calibrated one"
            self._say(f"the phase has moved by {math.degrees(changed):+.1f} deg {since}: has the index slipped?")

    def put(self, events: Events) -> None:
        """Events as the sensor gave them."""
        self._recent.append(events)
        self.held_bytes += held_bytes(events)
        while self.held_bytes - held_bytes(self._recent[0]) > MOST_BYTES:
            self.held_bytes -= held_bytes(self._recent.popleft())

    def begin(self, encoder: EncoderStream) -> bool:
        """Starts a look at the last turn, unless one is under way or there is too little; whether it did."""
        last = encoder.last
        if self._closed or self._thread is not None or last is None or not self._recent:
            return False
        events = Events.concatenate(list(self._recent))
        events = events[: int(events.t.searchsorted(last, side="right"))]
        if len(events) < LEAST:
            return False
        samples = encoder.over(int(events.t[0]), int(events.t[-1]))
        speed = abs(samples.rpm) * TURN / 60e6
        begin = int(events.t[-1]) - round(1.2 * TURN / speed) if speed else int(events.t[0])
        events = events[int(events.t.searchsorted(begin)) :]
        swept = speed * float(events.t[-1] - events.t[0]) if len(events) else 0.0
        if len(events) < LEAST or swept < TURN / 2.0 or encoder.guessed(events.t).any():
            return False
        self._thread = threading.Thread(target=self._look, args=(events, samples), name="amiwarp-watch", daemon=True)
        self._thread.start()
        return True

    def result(self) -> Phase | None:
        """What the last look found, once; None while there is nothing new."""
        if self._thread is None or self._thread.is_alive():
            return None
        self._thread.join()
        self._thread = None
        found, self._found = self._found, None
        return found

    def close(self) -> None:
        """Waits for a look that is under way; there is no other."""
        self._closed = True
        if self._thread is not None:
            self._thread.join()

    def _look(self, events: Events, encoder: Encoder) -> None:
        known = self._calibration
        phase = known.parameters["phase"]
        recording = Recording(MemoryEvents(events, known.camera.width, known.camera.height), known.camera, encoder,
                              known.prism, name="the stream")  # fmt: skip
        start = {n: x for n, x in known.parameters.items() if n not in ("clock_offset", "rpm")}
        try:
            found = calibrate(
                recording, model=known.model_name, free=("phase",), start=start, stages=("sharpness",), events=100_000,
                bounds={"phase": (phase - REACH, phase + REACH)}, global_evaluations=EVALUATIONS,
                local_algorithm="LN_SBPLX", device="cpu",
            )  # fmt: skip
        except AmiwarpError:
            return  # no texture, say: the next look may see more
        self._found = Phase(found.parameters["phase"] - phase, found.uncertainty["phase"])
