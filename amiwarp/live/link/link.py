"""Link to the prism's controller: reads its port in the background, reopens a lost port, sends commands and pings."""

from __future__ import annotations

import contextlib
import threading
from typing import TYPE_CHECKING, Any

from amiwarp.errors import AmiwarpError
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.link.follower import Follower
from amiwarp.live.link.port import open_port, usb_id
from amiwarp.live.link.protocol import REFUSALS, Message, Ping, SetCounts, SetSpeed, Stop, encode

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from amiwarp.live.link.clocks import ClockMap
    from amiwarp.live.link.protocol import ControllerStatus
    from amiwarp.live.link.updates import LinkUpdate

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
