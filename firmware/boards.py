"""The firmware as controllers that Python drives in simulated time, like ``amiwarp.live.link.emulator.Controller``.

``python boards.py native`` or ``python boards.py IMAGE`` checks it; ``--link PATH`` offers a serial port.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))  # also if a test loads this file by its path

import release  # noqa: E402

BUILD = HERE / "build"
COUNTS = (4096, 16384)
"""Counts per turn of the quadrature encoder, and of the magnetic one if it turns with the prism."""
FAULTS = (
    "jammed",
    "driver_fault",
    "no_index",
    "dead_a",
    "reversed_motor",
    "bad_spi",
    "runaway",
    "dead_encoder",
    "lost_counts",
    "no_magnet",
    "error_flag",
    "bouncing_index",
    "odd_index",
    "no_supply",
    "sensed",
    "load",
    "heavy",
    "volts",
    "divider",
    "bad_store",
)
"""Faults of the simulated motor and encoder, explained by ``enum value`` in ``native/motor.h``, in its order."""
PHYSICS = ("no_load_rpm", "rise_s", "cogging", "cogs", "friction", "most_pull", "noise", "inl")
"""What the simulated motor and encoder are, after :data:`FAULTS` in ``enum value``."""
MOTOR = (*FAULTS, *PHYSICS, "angle", "rpm")


@contextlib.contextmanager
def flash_of(image: Path) -> Iterator[Path]:
    """Give a file that a simulator loads: the image, or the content of the flash that a .uf2 or .hex describes."""
    if image.suffix not in (".uf2", ".hex"):
        yield image
        return
    with tempfile.TemporaryDirectory() as folder:
        flash = Path(folder) / "flash.bin"
        flash.write_bytes(release.read(image))
        yield flash


class NativeBoard:
    """The firmware's core compiled for this computer, with the motor and encoder of ``native/board.c``.

    ``pulses``: 0 for ten per second, 1 at the index, 2 from the camera (see :meth:`pulse`). Times are in us.
    """

    VALUES = (
        *MOTOR, "now", "late_us", "pulses", "fastest_rpm", "unfed_us", "pulse_shortest_us", "pulse_longest_us",
        "driven",
    )  # fmt: skip
    """What :meth:`get` returns; the names before ``angle`` are faults that :meth:`set` switches."""
    plugged = True

    def __init__(
        self, *, counts_per_turn: int | None = None, magnetic: bool = False, pulses: int = 0, drift_ppm: float = 0.0,
        clock_start: float = 0.0, seed: int = 1, library: Path = BUILD / "libboard.so",
    ) -> None:  # fmt: skip
        self._load(library)
        counts, numbers = (
            counts_per_turn or COUNTS[magnetic],
            map(ctypes.c_double, (drift_ppm, clock_start)),
        )
        self._board = ctypes.c_void_p(
            self.library.board_new(counts, int(magnetic), pulses, *numbers, seed)
        )

    def _load(self, library: Path) -> None:
        self.library = ctypes.CDLL(str(library))
        self.library.board_new.restype = ctypes.c_void_p
        self.library.board_get.restype = ctypes.c_double
        self.library.board_advance.restype = ctypes.c_uint32
        self._out = ctypes.create_string_buffer(1 << 20)

    def advance(self, now_us: int) -> bytes:
        """Run until a simulated time and return the bytes sent; the simulated line of the core is infinitely fast."""
        size = self.library.board_advance(
            self._board, ctypes.c_uint64(max(now_us, 0)), self._out, len(self._out)
        )
        return self._out.raw[:size] if size else b""

    def feed(self, data: bytes, now_us: int) -> None:
        """Give the firmware bytes from the host at a simulated time."""
        self.library.board_feed(self._board, data, len(data))

    def set(self, name: str, value: float = 1.0) -> None:
        """Switch a fault on or off."""
        self.library.board_set(self._board, self.VALUES.index(name), ctypes.c_double(value))

    def get(self, name: str) -> float:
        """Return a value of the simulated board."""
        return float(self.library.board_get(self._board, self.VALUES.index(name)))

    @property
    def now(self) -> int:
        """Simulated time [us]."""
        return int(self.get("now"))

    def reset(self) -> None:
        """Reset the controller; the motor's shaft keeps its position."""
        self.library.board_reset(self._board)

    def pulse(self) -> None:
        """Give a pulse of the camera to the firmware, now."""
        self.library.board_pulse(self._board)

    def counters(self) -> dict[str, int]:
        """Return the firmware's statistics of received frames."""
        names = (
            "frames",
            "damaged",
            "unknown",
            "lost",
            "overruns",
            "encoder_errors",
            "index_bounces",
        )
        return {name: self.library.board_counter(self._board, k) for k, name in enumerate(names)}


class SimulatedBoard:
    """The image for the RP2040 on rp2040js (needs Node.js and ``npm install`` in ``simulator``), in simulated time.

    ``image``: flash image (``.bin`` or ``.uf2``); ``counts_per_turn`` of the prism is that for which it was built.
    Times are in us. ``usb``: a host is connected to the chip's USB.
    """

    MHZ = 125
    plugged = True

    def __init__(
        self,
        image: Path,
        *,
        magnetic: bool = False,
        counts_per_turn: int | None = None,
        usb: bool = False,
    ) -> None:
        bus = "usb" if usb else "no-usb"
        kind, counts = "MAGNETIC" if magnetic else "QUADRATURE", counts_per_turn or COUNTS[magnetic]
        with flash_of(image) as flash:
            self._start(flash, kind, counts, bus)
        self._inbox = b""
        self.now = 0

    def _start(self, flash: Path, kind: str, counts: int, bus: str) -> None:
        """Start the simulator, and wait until it has read the flash."""
        self._process = subprocess.Popen(
            ["node", str(HERE / "simulator" / "board.mjs"), str(flash), kind, str(counts), bus],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
        )  # fmt: skip
        self.get("resets")

    def _ask(self, line: str) -> str:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(line + "\n")
        answer = self._process.stdout.readline()
        if not answer:
            raise RuntimeError(f"the simulator ended with status {self._process.wait()}")
        return answer.rstrip("\n")

    def advance(self, now_us: int) -> bytes:
        """Run until a simulated time and return the bytes sent."""
        inbox, self._inbox = self._inbox, b""
        now, _, data = self._ask(f"run {max(now_us, self.now)} {inbox.hex()}").partition(" ")
        self.now = int(now)
        return bytes.fromhex(data)

    def feed(self, data: bytes, now_us: int) -> None:
        """Give bytes to the UART, at its baud rate."""
        self._inbox += data

    def set(self, name: str, value: float = 1.0) -> None:
        """Switch a fault on or off."""
        self._ask(f"set {name} {value}")

    def get(self, name: str) -> Any:
        """Return a value of the simulated board."""
        return json.loads(self._ask(f"get {name}"))

    def usb(self, what: bytes | str = b"") -> bytes:
        """Give bytes to the USB host's serial port, or ``open``, ``close`` or ``reset`` it; return what it received."""
        return bytes.fromhex(self._ask(f"usb {what if isinstance(what, str) else what.hex()}"))

    def interrupts(self) -> dict[str, dict[str, int]]:
        """Return the longest run and the sum of the runs [cycles], by interrupt."""
        worst, busy = self.get("worst"), self.get("busy")
        names = {"16": "tick", "29": "edges", "36": "UART"}
        return {
            name: {"worst": worst[key], "busy": busy[key]}
            for key, name in names.items()
            if key in worst
        }

    def reset(self) -> None:
        """Reset the chip."""
        self._ask("reset")

    def hang(self, where: str) -> None:
        """Let the program hang in its main ``loop`` or its ``tick``'s interrupt, or stop the ticks (``no-tick``)."""
        self._ask(f"hang {where}")

    def close(self) -> None:
        """End the simulator."""
        self._process.communicate()


class UsbBoard(SimulatedBoard):
    """The image for the RP2040 on rp2040js, with the link over USB instead of the UART."""

    def __init__(
        self, image: Path, *, magnetic: bool = False, counts_per_turn: int | None = None
    ) -> None:
        super().__init__(image, magnetic=magnetic, counts_per_turn=counts_per_turn, usb=True)
        self._received = b""

    def advance(self, now_us: int) -> bytes:
        """Run until a simulated time and return the bytes that the host received."""
        super().advance(now_us)
        received, self._received = self._received + self.usb(), b""
        return received

    def feed(self, data: bytes, now_us: int) -> None:
        """Give bytes to the host's serial port."""
        if data:
            self._received += self.usb(data)


class AvrBoard(NativeBoard):
    """The image for the ATmega2560 (``.elf``) on simavr, see :class:`NativeBoard`. Times are in us, others cycles."""

    MHZ = 16
    VALUES = (*MOTOR, "now", "cycles", "watchdogs", "boot_us", "enable", "sync")
    LISTS = ("index_us", "trigger_us", "enabled_us")
    INTERRUPTS = {  # noqa: RUF012
        "edge A": 5, "edge B": 6, "tick": 17, "UART in": 25, "UART out": 26, "index": 41, "camera": 46,
    }  # fmt: skip
    """Numbers of the vectors."""

    def __init__(
        self,
        image: Path,
        *,
        counts_per_turn: int | None = None,
        library: Path = BUILD / "libavr.so",
    ) -> None:
        self._load(library)
        with flash_of(image) as flash:
            self._board = ctypes.c_void_p(
                self.library.board_new(str(flash).encode(), counts_per_turn or COUNTS[0])
            )
        if not self._board:
            raise FileNotFoundError(f"{image} cannot be read: run make -C firmware avr")

    def get(self, name: str) -> Any:
        """Return a value, or a list of times."""
        if name in self.LISTS:
            times = ctypes.POINTER(ctypes.c_double)()
            size = self.library.board_times(
                self._board, self.LISTS.index(name), ctypes.byref(times)
            )
            return times[:size]
        return super().get(name)

    def interrupts(self) -> dict[str, dict[str, int]]:
        """Return the longest run, the longest delay of the start, and the sum of the runs [cycles], by interrupt."""
        out, found = (ctypes.c_double * 3)(), {}
        for name, vector in self.INTERRUPTS.items():
            self.library.board_interrupt(self._board, vector, out)
            found[name] = dict(zip(("worst", "late", "busy"), map(int, out), strict=True))
        return found

    def hang(self, where: str) -> None:
        """Let the program hang in its main ``loop`` or its ``tick``'s interrupt, or stop the ticks (``no-tick``)."""
        self.library.board_hang(self._board, ("loop", "tick", "no-tick").index(where))

    def close(self) -> None:
        """Do nothing: the board ends with the process."""


class SimulatedWire:
    """Line to a board in simulated time, for ``amiwarp.live.link.conformance.check_controller``."""

    def __init__(self, board: Any) -> None:
        self.board = board

    def now_us(self) -> int:
        """Return the simulated time [us]."""
        return int(self.board.now)

    def read(self) -> bytes:
        """Run for 5 ms and return the bytes sent."""
        return bytes(self.board.advance(self.board.now + 5000))

    def write(self, data: bytes) -> None:
        """Send bytes to the board."""
        self.board.feed(data, self.board.now)

    def reopen(self) -> bool:
        """Return True: opening a port does not act on these boards."""
        return True


def make(name: str, counts_per_turn: int | None = None, *, usb: bool = False) -> Any:
    """Return the board ``native``, ``native-magnetic``, or one for an image: .bin, .uf2 (RP2040), .elf, .hex (AVR)."""
    if name.startswith("native"):
        return NativeBoard(magnetic=name.endswith("magnetic"), counts_per_turn=counts_per_turn)
    if name.endswith((".elf", ".hex")):
        return AvrBoard(Path(name), counts_per_turn=counts_per_turn)
    kind = UsbBoard if usb else SimulatedBoard
    return kind(Path(name), magnetic="MAGNETIC" in name, counts_per_turn=counts_per_turn)


def serve(board: Any, link: Path, seconds: float) -> None:
    """Offer a board as a serial port. A simulator slower than real time slows the board's clock, and loses nothing."""
    from amiwarp.live.link.pseudo_terminal import PseudoTerminal

    state = [time.monotonic(), float(board.now)]

    def now_us() -> int:
        now = time.monotonic()
        state[1] += min(now - state[0], 0.05) * 1e6
        state[0] = now
        return int(state[1])

    with PseudoTerminal(board, link, now_us=now_us) as port:
        print(port.name, flush=True)
        time.sleep(seconds)


def main() -> int:
    """Serve a board, or check it in simulated time."""
    from amiwarp.live.link.conformance import check_controller

    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument(
        "board", help="native, native-magnetic, or an image (.bin, .uf2: RP2040; .elf, .hex: AVR)"
    )
    options.add_argument("--link", type=Path, help="symbolic link for the serial port")
    options.add_argument(
        "--counts-per-turn", type=int, help="of the prism, for which the image was built"
    )
    options.add_argument(
        "--usb", action="store_true", help="link over the RP2040's USB instead of its UART"
    )
    options.add_argument("--seconds", type=float, default=3600.0)
    options.add_argument("--rpm", type=float, default=240.0)
    chosen = options.parse_args()
    board = make(chosen.board, chosen.counts_per_turn, usb=chosen.usb)
    if chosen.link is not None:
        serve(board, chosen.link, chosen.seconds)
        return 0
    checks = check_controller(
        SimulatedWire(board),
        chosen.rpm,
        lambda c: print(f"{c.passed!s:6} {c.name}: {c.measured}", flush=True),
    )
    return int(any(check.passed is False for check in checks))


if __name__ == "__main__":
    sys.exit(main())
