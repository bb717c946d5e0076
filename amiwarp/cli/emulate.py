"""``amiwarp emulate``: the prism's controller as a program, behind a serial port that programs can open."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amiwarp.cli import say
from amiwarp.cli.console import report
from amiwarp.cli.options import NO_FILE, Common
from amiwarp.cli.streams import stopped_by_interrupt
from amiwarp.errors import AmiwarpError
from amiwarp.io import open_recording
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.link.emulator import Controller, Fault
from amiwarp.live.link.rotors import Motor, Played
from amiwarp.live.link.terminal import PseudoTerminal

if TYPE_CHECKING:
    from amiwarp.events.encoder import Encoder
    from amiwarp.events.recording import Recording

EXAMPLE = "amiwarp emulate --link ./prism --rpm 720 --fault slip@5 --fault unplug@10+2"

STEP_S, AFTER_S = 0.05, 1.0
"""Between two looks at whether it is to end; and so long the controller goes on after the camera's last event."""
LATE_US = 100_000
"""From which on it is told that events were late."""


def run(
    *,
    link: Annotated[
        Path | None,
        typer.Option(help="Link to the port: its name also after a fault 'unplug'. Default: none."),
        NO_FILE,
    ] = None,
    counts_per_turn: Annotated[int, typer.Option(min=1, max=1 << 24, help="Of the encoder.")] = 4096,
    rpm: Annotated[float, typer.Option(min=-6000.0, max=6000.0, help="Speed to begin with (turns/min).")] = 0.0,
    drift_ppm: Annotated[float, typer.Option(min=-1e5, max=1e5, help="By how much its clock is fast (ppm).")] = 0.0,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="From a time on, for a while (s); again for more. garbage, truncate, crc, drop (bytes), missed-index, "
            "stall, slip, reverse, reset, clock-jump, unplug.",
            metavar="NAME@SECONDS[+DURATION]",
        ),
    ] = None,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="End after so long. Default: by Ctrl-C.")] = None,
    recording: Annotated[
        Path | None,
        typer.Option(help="Play this recording: its rotation in place of a motor's, its events at --camera."),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            help="Be the camera, too: serve its events at tcp:HOST:PORT or unix:PATH, once somebody connects.",
            metavar="ADDRESS",
        ),
    ] = None,
    common: Common,
) -> None:
    """Be a controller with motor, encoder and index, for trying out without one, and with what goes wrong on demand."""
    from amiwarp.live.stream.emulated import EmulatedCamera

    if (recording is None) != (camera is None):
        raise AmiwarpError("--recording and --camera go together: what is played, and where its events are served")
    rotor: Motor | Played = Motor(rpm, seed=common.seed)
    played = None if recording is None else _recording(recording)
    if played is not None:
        rotor = Played(played[1])
    controller = Controller(
        rotor,
        counts_per_turn=counts_per_turn,
        drift_ppm=drift_ppm,
        faults=[Fault.parse(text) for text in fault or ()],
        seed=common.seed,
    )
    origin = monotonic_us()

    def now_us() -> int:
        return monotonic_us() - origin

    with contextlib.ExitStack() as held:
        stop = threading.Event()
        held.enter_context(stopped_by_interrupt(stop))
        terminal = held.enter_context(PseudoTerminal(controller, link, now_us=now_us))
        hint = f"amiwarp motor status --port {terminal.name}"
        data, lines = {"port": terminal.name, "try": hint}, [terminal.name, f"try: {hint}", "Ctrl-C ends it"]
        served = None
        if played is not None and camera is not None and isinstance(rotor, Played):
            served = held.enter_context(EmulatedCamera(played[0], rotor, controller, camera, now_us))
            hint = f"amiwarp live {served.address} --port {terminal.name} --calibration CALIBRATION"
            data, lines = (
                {**data, "camera": served.address, "try": hint},
                [terminal.name, served.address, f"try: {hint}"],
            )
        report(common, data, lines)
        end = math.inf if seconds is None else time.monotonic() + seconds
        while not stop.wait(STEP_S) and time.monotonic() < end:
            if served is not None and served.done.is_set():
                stop.wait(AFTER_S)
                break
        if served is not None and served.late_us > LATE_US:
            late = f"events were sent up to {served.late_us * 1e-6:.1f} s late, none lost"
            say(f"{late}: this machine, or who listens, is slower than the recording")


def _recording(path: Path) -> tuple[Recording, Encoder]:
    opened = open_recording(path)
    if opened.encoder is None:
        raise AmiwarpError(f"{path}: has no encoder; give a recording that has")
    return opened, opened.encoder
