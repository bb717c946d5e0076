"""``amiwarp emulate``: emulated prism controller behind a serial port that other programs can open."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amiwarp.cli import common as cli
from amiwarp.cli import say
from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.events.recording import Recording
from amiwarp.io import open_recording
from amiwarp.live.commands.session import stopped_by_interrupt
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.link.emulated_faults import EmulatedFault
from amiwarp.live.link.emulator import Controller
from amiwarp.live.link.pseudo_terminal import PseudoTerminal
from amiwarp.live.link.rotors import Motor, Played, Rotor

if TYPE_CHECKING:
    from amiwarp.live.stream.emulated_camera import EmulatedCamera


STEP_S = 0.05
"""Interval between two checks whether the emulation shall end [s]."""
AFTER_S = 1.0
"""Time for which the controller continues after the camera's last event [s]."""
LATE_US = 100_000
"""Delay of the camera's events above which a message is printed [us]."""
_in_controller = partial(typer.Option, rich_help_panel="Controller")
_in_playback = partial(typer.Option, rich_help_panel="Playback")


@dataclass(frozen=True)
class ControllerOptions:
    """Options for the emulated controller."""

    counts_per_turn: Annotated[
        int, _in_controller(min=1, max=1 << 24, help="Encoder counts per turn.")
    ] = 4096
    rpm: Annotated[
        float,
        _in_controller(
            min=-6000.0, max=6000.0, help="Speed at the start (turns/min); negative: backwards."
        ),
    ] = 0.0
    drift_ppm: Annotated[
        float,
        _in_controller(
            min=-1e5,
            max=1e5,
            help="Frequency error of the controller's clock (ppm); positive: fast.",
        ),
    ] = 0.0
    fault: Annotated[
        list[str] | None,
        _in_controller(
            help="Fault with its start and duration (s): garbage, truncate, crc, drop (bytes), missed-index, stall, "
            "slip, reverse, reset, clock-jump or unplug. Can be repeated.",
            metavar="NAME@SECONDS[+DURATION]",
        ),
    ] = None

    supply_v: Annotated[
        float | None,
        _in_controller(
            min=0.0, max=60.0, help="Voltage of the motor's supply (V). Default: not sensed."
        ),
    ] = None

    def build(self, rotor: Rotor, seed: int) -> Controller:
        """Return an emulated controller, with the options' settings, that drives ``rotor``."""
        return Controller(
            rotor,
            counts_per_turn=self.counts_per_turn,
            drift_ppm=self.drift_ppm,
            faults=[EmulatedFault.parse(text) for text in self.fault or ()],
            supply_mv=None if self.supply_v is None else round(1000.0 * self.supply_v),
            seed=seed,
        )


@dataclass(frozen=True)
class PlaybackOptions:
    """Options for playing a recording instead of emulating a motor."""

    recording: Annotated[
        Path | None,
        _in_playback(
            help="Recording to play: its prism rotation replaces the motor, its events are served at --camera."
        ),
    ] = None
    camera: Annotated[
        str | None,
        _in_playback(
            help="Address of an emulated camera that serves the recording's events: tcp:HOST:PORT or unix:PATH. "
            "Playing starts when the first client connects.",
            metavar="ADDRESS",
        ),
    ] = None

    def open(self) -> _Playback | None:
        """Open the recording. Return None if none is given."""
        if self.recording is None and self.camera is None:
            return None
        if self.recording is None or self.camera is None:
            raise AmiwarpError(
                "--recording and --camera belong together; give both or neither", ErrorCode.OPTIONS
            )
        recording = open_recording(self.recording)
        if recording.encoder is None:
            raise AmiwarpError(
                f"{self.recording}: has no encoder samples; give a recording with an encoder",
                ErrorCode.CONTENT_MISSING,
            )
        if recording.encoder.second is not None:
            raise AmiwarpError(
                f"{self.recording}: has two encoders, the emulated controller one; replay it with 'amiwarp live' or "
                "'amiwarp record', which take the file's own samples"
            )
        return _Playback(recording, Played(recording.encoder), self.camera)


@dataclass(frozen=True)
class _Playback:
    """Recording to play, its prism rotation, and the address that serves its events."""

    recording: Recording
    rotor: Played
    address: str

    def camera(self, controller: Controller, now_us: Callable[[], int]) -> EmulatedCamera:
        from amiwarp.live.stream.emulated_camera import EmulatedCamera

        return EmulatedCamera(self.recording, self.rotor, controller, self.address, now_us)


def run_emulate(
    *,
    link: Annotated[
        Path | None,
        typer.Option(
            help="Symbolic link to create for the port; valid again after a fault 'unplug'. Default: none."
        ),
        cli.NO_FILE,
    ] = None,
    options: ControllerOptions,
    playback: PlaybackOptions,
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="Stop after this time (s). Default: at Ctrl-C.")
    ] = None,
    common: cli.Common,
) -> None:
    """Emulate a prism controller with motor, encoder and index pulse, and inject faults on request.

    Programs can be tried out against it without hardware.
    """
    played = playback.open()
    if played is not None and options.rpm:
        raise AmiwarpError(
            "--rpm applies to the emulated motor, which --recording replaces; remove one of them",
            ErrorCode.OPTIONS,
        )
    rotor = Motor(options.rpm, seed=common.seed) if played is None else played.rotor
    controller = options.build(rotor, common.seed)
    origin = monotonic_us()

    def now_us() -> int:
        return monotonic_us() - origin

    with contextlib.ExitStack() as resources:
        stop = threading.Event()
        resources.enter_context(stopped_by_interrupt(stop))
        terminal = resources.enter_context(PseudoTerminal(controller, link, now_us=now_us))
        camera = (
            None if played is None else resources.enter_context(played.camera(controller, now_us))
        )
        _print_names(terminal, camera, common)
        _wait_for_end(stop, seconds, camera)
        if camera is not None and camera.late_us > LATE_US:
            late = f"events were sent up to {camera.late_us * 1e-6:.1f} s late, none was lost"
            say(f"{late}: this machine or a receiver is slower than the recording")


def _print_names(
    terminal: PseudoTerminal, camera: EmulatedCamera | None, common: cli.Common
) -> None:
    """Print the port, the camera's address and a command to try next."""
    if camera is None:
        hint = f"amiwarp motor status --port {terminal.name}"
        data = {"port": terminal.name, "try": hint}
        lines = [terminal.name, f"try: {hint}", "stop with Ctrl-C"]
    else:
        hint = f"amiwarp live {camera.address} --port {terminal.name} --calibration CALIBRATION"
        data = {"port": terminal.name, "try": hint, "camera": camera.address}
        lines = [terminal.name, camera.address, f"try: {hint}"]
    cli.report(common, data, lines)


def _wait_for_end(
    stop: threading.Event, seconds: float | None, camera: EmulatedCamera | None
) -> None:
    """Wait until ``stop`` is set, ``seconds`` have passed, or :data:`AFTER_S` after the camera's last event."""
    end = math.inf if seconds is None else time.monotonic() + seconds
    while not stop.wait(STEP_S) and time.monotonic() < end:
        if camera is not None and camera.done.is_set():
            stop.wait(AFTER_S)
            return
