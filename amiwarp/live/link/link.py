"""Link to the prism's controller: a thread that reads its port and sends pings, and commands that wait for answers."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from typing import Any

from amiwarp.errors import AmiwarpError, ErrorCode
from amiwarp.live.link import protocol
from amiwarp.live.link.clocks import ClockMap, monotonic_us
from amiwarp.live.link.follower import Follower
from amiwarp.live.link.ports import open_port, usb_id
from amiwarp.live.link.updates import LinkUpdate
from amiwarp.tasks import BackgroundLoop

READ_BYTES = 1 << 16
"""Largest number of bytes read from the port at once."""
RETRY_S = 0.2
"""Interval between attempts to reopen a lost port [s]."""
ANSWER_S = 1.0
"""Longest wait for the answer to a command [s]."""
QUICK_PINGS = 10
QUICK_PING_US = 50_000
PING_US = 1_000_000
"""Number of quick pings after the port is opened, interval of the quick pings [us], and interval of later pings [us].
"""
QUICK_ASK_US = 250_000
ASK_US = 1_000_000
"""Interval of the questions for the controller's identity and condition until they are known, and later [us]."""
PINGS_PER_TIMEOUT = 4
"""Number of pings within the time after which a controller stops the motor for a lost host, so that some may be lost.
"""


def _why_refused(refused: int) -> str:
    """Return the words for the number with which a controller refuses a command."""
    if refused >= len(protocol.REFUSALS):
        return f"reason {refused}"
    why = protocol.REFUSALS[refused]
    if why == "not possible now":
        why += "; a command to the motor waits for a stop after a fault, one that changes settings for rest"
    return why


def _ping_interval_us(timeout_s: int) -> int:
    """Return the interval of pings [us] for a controller that stops the motor after a time without pings.

    ``timeout_s``: that time [s], 0 if it never does.
    """
    if timeout_s == 0:
        return PING_US
    return min(PING_US, timeout_s * 1_000_000 // PINGS_PER_TIMEOUT)


class Link(BackgroundLoop):
    """Connection to a controller, open until closed. No call blocks for longer than about a second.

    The motor keeps its last commanded speed after :meth:`close`.

    ``port``: name, USB id ``VID:PID``, pySerial URL, or None to detect the controller. ``counts_per_turn``: for a
    controller that does not report it (text lines). ``host_us``: the host's clock [us], increasing. Raises
    :class:`AmiwarpError` if the port cannot be opened at first; a port that is lost later is reopened.
    """

    def __init__(
        self,
        port: str | None = None,
        *,
        counts_per_turn: int | None = None,
        host_us: Callable[[], int] = monotonic_us,
    ) -> None:
        if counts_per_turn is not None and counts_per_turn < 1:
            raise AmiwarpError(
                f"counts_per_turn = {counts_per_turn}; give the encoder's counts per turn, 1 or more"
            )
        self._port: Any = open_port(port)
        self.name = str(self._port.port)
        self._where = port or usb_id(self.name) or self.name
        self._host_us = host_us
        self._follower = Follower(self.name, counts_per_turn)
        self._follower.opened(host_us())
        self._changed = threading.Condition()  # held while the follower or the answers are used
        self._writing = threading.Lock()  # held while the port or the sequence number is used
        # By the command's sequence number; None until the answer is received
        self._answers: dict[int, int | None] = {}
        self._sequence = 0
        self._number = 0
        now = host_us()
        self._ping_us = now
        self._ask_us = now
        # Sequence number of the latest question in the background
        self._question: int | None = None
        self._start_thread("amiwarp-link")

    @property
    def connected(self) -> bool:
        """Whether the serial port is open."""
        return self._port is not None

    @property
    def status(self) -> protocol.ControllerStatus | None:
        """Latest status of the controller; None before the first status."""
        return self._follower.status

    @property
    def identity(self) -> protocol.Identity | None:
        """Firmware and board of the controller; None if it has not said them, as firmware before 1.1."""
        return self._follower.identity

    @property
    def condition(self) -> protocol.Condition | None:
        """Supply voltage and time-out, asked for once per second; None if the controller has not reported them."""
        return self._follower.condition

    @property
    def older(self) -> bool:
        """Whether the controller has refused to say what it is: its firmware is older than 1.1."""
        return self._follower.older

    def poll(self) -> LinkUpdate:
        """Return the data received since the last call, without waiting."""
        with self._changed:
            return self._follower.take()

    def clock(self) -> ClockMap | None:
        """Return the map from the host's clock to the controller's clock (the clock of :attr:`LinkUpdate.t_us`).

        Returns None until three pings are answered.
        """
        with self._changed:
            return self._follower.clock()

    def set_speed(self, rpm: float, ramp: float) -> None:
        """Change the motor's speed to ``rpm`` (negative: backwards) at the rate ``ramp`` [rpm/s].

        Raises :class:`AmiwarpError` if the controller refuses the command.
        """
        self._command(protocol.SetSpeed(rpm, ramp), f"set speed {rpm:g} rpm")

    def stop(self) -> None:
        """Stop the motor. Raises :class:`AmiwarpError` if the controller refuses the command."""
        self._command(protocol.Stop(), "stop")

    def set_counts(self, per_turn: int) -> None:
        """Set the encoder's counts per turn in the controller.

        Raises :class:`AmiwarpError` if it refuses the command.
        """
        self._command(protocol.SetCounts(per_turn), f"set {per_turn} counts per turn")

    def settings(self) -> dict[str, int]:
        """Return the controller's settings by name, in the units of ``protocol.SETTINGS``.

        Raises :class:`AmiwarpError` if the controller does not tell them, as firmware before 1.1, or if one is damaged
        on the line.
        """
        with self._changed:
            self._follower.settings.clear()
        for key, setting in enumerate(protocol.SETTINGS):
            self._command(
                protocol.Ask(protocol.Setting.KIND, key), f"read the setting {setting.name}"
            )
        with self._changed:
            values = dict(self._follower.settings)
        for key, setting in enumerate(protocol.SETTINGS):
            if key not in values:
                raise AmiwarpError(
                    f"{self.name}: setting {setting.name}: its value was damaged on the line; read the settings again"
                )
        return {setting.name: values[key] for key, setting in enumerate(protocol.SETTINGS)}

    def set_setting(self, name: str, value: int) -> None:
        """Change a setting of the controller until its next reset, while the prism rests.

        ``protocol.SETTINGS`` has the names and units. Raises :class:`AmiwarpError` for another name, for a value
        out of its range, or if the controller refuses.
        """
        keys = {setting.name: key for key, setting in enumerate(protocol.SETTINGS)}
        if name not in keys:
            raise AmiwarpError(
                f"setting {name!r}: there is none of this name; give one of {', '.join(keys)}"
            )
        key = keys[name]
        setting = protocol.SETTINGS[key]
        if not setting.contains(value):
            off = "0 (off), or " if setting.off else ""
            unit = f" {setting.unit}" if setting.unit else ""
            raise AmiwarpError(
                f"setting {name} = {value}: give {off}{setting.least} to {setting.most}{unit}"
            )
        self._command(protocol.SetSetting(key, value), f"set {name} = {value}")

    def save_settings(self) -> None:
        """Save the settings in the controller's memory, where they outlive a reset.

        Raises :class:`AmiwarpError` if it refuses, as while the prism turns, or if the memory does not keep them.
        """
        self._command(protocol.SaveSettings(), "save the settings")

    def restore_settings(self) -> None:
        """Change all settings back to the build's, until the next reset.

        Raises :class:`AmiwarpError` if the controller refuses, as while the prism turns.
        """
        self._command(protocol.RestoreSettings(), "restore the settings of the build")

    def _command(self, message: protocol.Message, what: str) -> None:
        """Send a command and wait for its answer. ``what``: name of the command in messages."""
        if self._follower.text:
            raise AmiwarpError(
                f"{self.name}: {what}: the controller sends lines of text, which take no commands"
            )
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
                f"{self.name}: {what}: no answer in {ANSWER_S:g} s; check the controller by 'amiwarp motor status'",
                ErrorCode.UNREACHABLE,
            )
        if refused:
            raise AmiwarpError(
                f"{self.name}: {what}: refused by the controller, {_why_refused(refused)}"
            )

    def _send(self, message: protocol.Message, *, answered: bool = False) -> int:
        """Send a message and return its sequence number; ``answered``: store its answer.

        Raises OSError if the port is gone or blocks, ValueError for numbers outside their range.
        """
        with self._writing:
            sequence = self._sequence
            frame = protocol.encode(message, sequence)
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
                self._note_answer(answer)
            self._changed.notify_all()
            speaks = self._follower.speaks
            condition = self._follower.condition
            quick = len(self._follower.trips) < QUICK_PINGS
        timeout_s = 0 if condition is None else condition.host_timeout_s
        if speaks and now >= self._ping_us:
            interval_us = QUICK_PING_US if quick else _ping_interval_us(timeout_s)
            self._ping_us = now + interval_us
            self._ping()
        if speaks and now >= self._ask_us and not self._follower.older:
            self._ask_us = now + (QUICK_ASK_US if condition is None else ASK_US)
            self._ask(protocol.Identity if self._follower.identity is None else protocol.Condition)

    def _note_answer(self, answer: protocol.Answer) -> None:
        """Store the answer to a command or question; ignore answers that nobody waits for."""
        if answer.sequence in self._answers:
            self._answers[answer.sequence] = answer.refused
        elif answer.sequence == self._question:
            unknown = answer.refused == protocol.REFUSALS.index("unknown command")
            self._follower.older = self._follower.older or unknown

    def _ask(self, kind: type[protocol.Identity | protocol.Condition]) -> None:
        """Ask for a message, without waiting for it."""
        from serial import SerialTimeoutException

        with contextlib.suppress(SerialTimeoutException):
            self._question = self._send(protocol.Ask(kind.KIND))

    def _ping(self) -> None:
        from serial import SerialTimeoutException

        self._number = (self._number + 1) & 0xFFFFFFFF
        with self._changed:
            self._follower.pinged(self._number, self._host_us())
        # A port that blocks for a while is not gone.
        with contextlib.suppress(SerialTimeoutException):
            self._send(protocol.Ping(self._number))

    def _note_loss(self) -> None:
        with self._changed:
            self._follower.say(f"{self.name}: the port is gone; trying again until it is back")

    def _close_port(self) -> None:
        with self._writing:
            port = self._port
            self._port = None
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
