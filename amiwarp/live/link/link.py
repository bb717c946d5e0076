"""Link to the prism's controller: reads its port in the background, reopens a lost port, sends commands and pings."""

from __future__ import annotations

import contextlib
import errno
import re
import threading
import time
from collections.abc import Callable
from typing import Any

from amiwarp.errors import AmiwarpError
from amiwarp.live.link.clocks import ClockMap, monotonic_us
from amiwarp.live.link.follower import Follower, LinkUpdate
from amiwarp.live.link.protocol import (
    REFUSALS,
    ControllerStatus,
    FrameDecoder,
    Message,
    Ping,
    SetCounts,
    SetSpeed,
    Stop,
    encode,
)

# Serial ports, opened by name, by USB id, or by detection of the controller.

BAUD = 460_800
"""Baud rate of the serial port [bit/s]. USB CDC ports ignore it."""
READ_S, WRITE_S = 0.05, 0.5
"""Time-outs of a read and of a write on the port [s]."""
LISTEN_S = 1.0
"""Time for which each port is read when the controller is searched for [s]."""
_USB = re.compile(r"([0-9a-fA-F]{4}):([0-9a-fA-F]{4})")


def open_port(where: str | None) -> Any:
    """Open a port and return its ``serial.Serial``.

    ``where``: name, pySerial URL, USB id ``VID:PID`` (hexadecimal), or None to detect the controller. Raises
    :class:`AmiwarpError`, with the available ports, if there is no such port or it cannot be opened.
    """
    if where is None:
        return _find()
    match = _USB.fullmatch(where)
    if match is None:
        return _open(where)
    wanted = int(match[1], 16), int(match[2], 16)
    names = [p.device for p in _ports() if (p.vid, p.pid) == wanted]
    if len(names) != 1:
        raise AmiwarpError(f"USB id {where}: {len(names)} ports have this id; {_available()}")
    return _open(names[0])


def usb_id(name: str) -> str | None:
    """Return ``VID:PID`` of a port, or None if it has none or shares it with another port."""
    ports = _ports()
    ids = [(p.vid, p.pid) for p in ports if p.device == name and p.vid is not None]
    if len(ids) != 1 or sum((p.vid, p.pid) == ids[0] for p in ports) != 1:
        return None
    return f"{ids[0][0]:04x}:{ids[0][1]:04x}"


def _ports() -> list[Any]:
    from serial.tools import list_ports

    return sorted(list_ports.comports(), key=lambda p: p.device)


def _available() -> str:
    listed = [p.device if p.vid is None else f"{p.device} ({p.vid:04x}:{p.pid:04x} {p.product})" for p in _ports()]
    return f"there are {', '.join(listed)}" if listed else "there is no serial port; is the controller plugged in?"


def _open(name: str) -> Any:
    import serial

    try:
        return serial.serial_for_url(name, BAUD, timeout=READ_S, write_timeout=WRITE_S, exclusive=True)
    except Exception as error:  # includes termios.error, which is not an OSError
        number = getattr(error, "errno", None)
        if number in (errno.EAGAIN, errno.EBUSY):
            raise AmiwarpError(f"{name}: another program has this port open; close that program first") from error
        if number == errno.EACCES:
            raise AmiwarpError(
                f"{name}: no permission to open this port; on Linux join the port's group (see ls -l {name})"
            ) from error
        why = "no such port" if number == errno.ENOENT else f"cannot be opened ({error})"
        raise AmiwarpError(f"{name}: {why}; {_available()}") from error


def _find() -> Any:
    """Open the first port on which controller frames or lines arrive, and return it."""
    errors = []
    for candidate in _ports():
        try:
            port = _open(candidate.device)
        except AmiwarpError as error:
            errors.append(str(error))
            continue
        if _is_controller(port):
            return port
        port.close()
    detail = "".join(f" ({line})" for line in errors)
    raise AmiwarpError(f"no port sends controller data; {_available()}{detail}; give a port by name")


def _is_controller(port: Any) -> bool:
    """Return whether controller frames or lines arrive within :data:`LISTEN_S`."""
    decoder, end = FrameDecoder(), time.monotonic() + LISTEN_S
    while time.monotonic() < end:
        try:
            decoder.feed(port.read(max(1, port.in_waiting)))
        except OSError:
            return False
        if decoder.received.frames or decoder.received.lines > 1:
            return True
    return False


READ_BYTES = 1 << 16
"""Largest number of bytes read from the port at once."""
RETRY_S = 0.2
"""Interval between attempts to reopen a lost port [s]."""
ANSWER_S = 1.0
"""Longest wait for the answer to a command [s]."""
QUICK_PINGS, QUICK_PING_US, PING_US = 10, 50_000, 1_000_000
"""Number of quick pings after the port is opened, interval of the quick pings [us], and interval of later pings [us].
"""


class Link:
    """Connection to a controller, open until closed. No call blocks for longer than about a second.

    ``port``: name, USB id ``VID:PID``, pySerial URL, or None to detect the controller. ``counts_per_turn``: for a
    controller that does not report it (text lines). ``host_us``: the host's clock [us], increasing. Raises
    :class:`AmiwarpError` if the port cannot be opened at first; a port that is lost later is reopened.
    """

    def __init__(
        self, port: str | None = None, *, counts_per_turn: int | None = None, host_us: Callable[[], int] = monotonic_us
    ) -> None:
        if counts_per_turn is not None and counts_per_turn < 1:
            raise AmiwarpError(f"counts_per_turn = {counts_per_turn}; give the encoder's counts per turn, 1 or more")
        self._port: Any = open_port(port)
        self.name = str(self._port.port)
        self._where = port or usb_id(self.name) or self.name
        self._host_us = host_us
        self._follower = Follower(self.name, counts_per_turn)
        self._follower.opened(host_us())
        self._changed = threading.Condition()  # held while the follower or the answers are used
        self._writing = threading.Lock()  # held while the port or the sequence number is used
        self._answers: dict[int, int | None] = {}  # by the command's sequence number; None: not yet received
        self._sequence = self._number = 0
        self._ping_us = host_us()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="amiwarp-link", daemon=True)
        self._thread.start()

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the port. The motor keeps its last commanded speed."""
        self._ended.set()
        self._thread.join()

    @property
    def connected(self) -> bool:
        """Whether the serial port is open."""
        return self._port is not None

    @property
    def status(self) -> ControllerStatus | None:
        """Latest status of the controller; None before the first status."""
        return self._follower.status

    def poll(self) -> LinkUpdate:
        """Return the data received since the last call, without waiting."""
        with self._changed:
            return self._follower.take()

    def clock(self) -> ClockMap | None:
        """Return the map from the host's clock to the controller's clock (that of :attr:`LinkUpdate.t_us`).

        Returns None until three pings are answered.
        """
        with self._changed:
            return self._follower.clock()

    def set_speed(self, rpm: float, ramp: float) -> None:
        """Change the motor's speed to ``rpm`` (negative: backwards) at the rate ``ramp`` [rpm/s].

        Raises :class:`AmiwarpError` if the controller refuses the command.
        """
        self._command(SetSpeed(rpm, ramp), f"set speed {rpm:g} rpm")

    def stop(self) -> None:
        """Stop the motor. Raises :class:`AmiwarpError` if the controller refuses the command."""
        self._command(Stop(), "stop")

    def set_counts(self, per_turn: int) -> None:
        """Set the encoder's counts per turn in the controller.

        Raises :class:`AmiwarpError` if it refuses the command.
        """
        self._command(SetCounts(per_turn), f"set {per_turn} counts per turn")

    def _command(self, message: Message, what: str) -> None:
        """Send a command and wait for its answer. ``what``: name of the command in messages."""
        if self._follower.text:
            raise AmiwarpError(f"{self.name}: {what}: the controller sends lines of text, which take no commands")
        try:
            sequence = self._send(message, answered=True)
        except ValueError as error:
            raise AmiwarpError(f"{self.name}: {what}: {error}") from error
        except OSError as error:
            raise AmiwarpError(f"{self.name}: {what}: not sent, {error}") from error
        with self._changed:
            self._changed.wait_for(lambda: self._answers[sequence] is not None, ANSWER_S)
            refused = self._answers.pop(sequence)
        if refused is None:
            raise AmiwarpError(
                f"{self.name}: {what}: no answer in {ANSWER_S:g} s; check the controller by 'amiwarp motor status'"
            )
        if refused:
            why = REFUSALS[refused] if refused < len(REFUSALS) else f"reason {refused}"
            raise AmiwarpError(f"{self.name}: {what}: refused by the controller, {why}")

    def _send(self, message: Message, *, answered: bool = False) -> int:
        """Send a message and return its sequence number; ``answered``: store its answer.

        Raises OSError if the port is gone or blocks, ValueError for numbers outside their range.
        """
        with self._writing:
            sequence = self._sequence
            frame = encode(message, sequence)
            if self._port is None:
                raise OSError("the port is gone")
            self._sequence = (sequence + 1) & 0xFFFF
            if answered:
                with self._changed:
                    self._answers[sequence] = None
            try:
                self._port.write(frame)
            except BaseException:
                with self._changed:
                    self._answers.pop(sequence, None)
                raise
            return sequence

    def _run(self) -> None:
        while True:
            try:
                while not self._ended.is_set():
                    self._read_port()
            except OSError:
                self._note_loss()
            self._close_port()
            if self._ended.is_set() or not self._reopen():
                return

    def _read_port(self) -> None:
        """Read the bytes that have arrived, for a short time, and send a ping if one is due."""
        data = self._port.read(1)
        if data:
            data += self._port.read(min(self._port.in_waiting, READ_BYTES))
        now = self._host_us()
        with self._changed:
            for answer in self._follower.feed(data, now):
                if answer.sequence in self._answers:  # ignore answers to commands that nobody waits for
                    self._answers[answer.sequence] = answer.refused
            self._changed.notify_all()
            due = self._follower.speaks and now >= self._ping_us
            quick = len(self._follower.trips) < QUICK_PINGS
        if due:
            self._ping_us = now + (QUICK_PING_US if quick else PING_US)
            self._ping()

    def _ping(self) -> None:
        from serial import SerialTimeoutException

        self._number = (self._number + 1) & 0xFFFFFFFF
        with self._changed:
            self._follower.pinged(self._number, self._host_us())
        with contextlib.suppress(SerialTimeoutException):  # a port that blocks for a while is not gone
            self._send(Ping(self._number))

    def _note_loss(self) -> None:
        with self._changed:
            self._follower.say(f"{self.name}: the port is gone; trying again until it is back")

    def _close_port(self) -> None:
        with self._writing:
            port, self._port = self._port, None
        with contextlib.suppress(OSError):
            port.close()

    def _reopen(self) -> bool:
        """Open the port again; return False if the link was closed meanwhile."""
        while not self._ended.wait(RETRY_S):
            with contextlib.suppress(AmiwarpError):
                port = open_port(self._where)
                with self._changed:
                    self._follower.opened(self._host_us())
                    self._follower.say(f"{self.name}: the port is back")
                with self._writing:
                    self._port = port
                return True
        return False
