"""The link to the prism's controller: a port read in the background, reopened when it is lost; commands and pings."""

from __future__ import annotations

import contextlib
import threading
from typing import TYPE_CHECKING, Any

from amiwarp.errors import AmiwarpError
from amiwarp.live.link.clocks import monotonic_us
from amiwarp.live.link.following import Follower
from amiwarp.live.link.port import open_port, usb_id
from amiwarp.live.link.protocol import REFUSALS, Message, Ping, SetCounts, SetSpeed, Stop, encode

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

    from amiwarp.live.link.clocks import Clock
    from amiwarp.live.link.news import News
    from amiwarp.live.link.protocol import Status

READ_BYTES = 1 << 16
"""Most that is taken from the port at once."""
RETRY_S = 0.2
"""Between attempts to open a port that is gone."""
ANSWER_S = 1.0
"""Longest wait for the answer to a command."""
QUICK, QUICK_US, PING_US = 10, 50_000, 1_000_000
"""The first pings come quickly, the others once a second."""


class Link:
    """Follows a controller until it is closed. No call blocks for longer than about a second.

    ``port``: a name, a USB id ``VID:PID``, a URL of pySerial, or None to look for one. ``counts_per_turn``: for a
    controller that does not tell it (lines of text). ``host_us``: the host's clock [us], increasing. Raises
    :class:`AmiwarpError` where the port cannot be opened now; one that is lost later is opened again.
    """

    def __init__(
        self, port: str | None = None, *, counts_per_turn: int | None = None, host_us: Callable[[], int] = monotonic_us
    ) -> None:
        if counts_per_turn is not None and counts_per_turn < 1:
            raise AmiwarpError(f"counts_per_turn = {counts_per_turn}; give 1 or more")
        self._port: Any = open_port(port)
        self.name = str(self._port.port)
        self._where = port or usb_id(self.name) or self.name
        self._host_us = host_us
        self._follower = Follower(self.name, counts_per_turn)
        self._follower.opened(host_us())
        self._changed = threading.Condition()  # guards the follower and the answers
        self._writing = threading.Lock()  # guards the port and the sequence
        self._answers: dict[int, int | None] = {}  # by the sequence number of the command; None: not come yet
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
        """Ends it; the motor goes on as it was told."""
        self._ended.set()
        self._thread.join()

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    @property
    def status(self) -> Status | None:
        """What the controller said of itself last."""
        return self._follower.status

    def poll(self) -> News:
        """What came since the last call; at once."""
        with self._changed:
            return self._follower.take()

    def clock(self) -> Clock | None:
        """The controller's clock (as in :attr:`News.t_us`) beside the host's; None until three pings came back."""
        with self._changed:
            return self._follower.clock()

    def set_speed(self, rpm: float, ramp: float) -> None:
        """Turn at ``rpm``, negative backwards, changed by ``ramp`` [rpm/s]. Raises :class:`AmiwarpError` if refused."""
        self._command(SetSpeed(rpm, ramp), f"set speed {rpm:g} rpm")

    def stop(self) -> None:
        """Come to rest. Raises :class:`AmiwarpError` if refused."""
        self._command(Stop(), "stop")

    def set_counts(self, per_turn: int) -> None:
        """Tell the encoder's counts per turn. Raises :class:`AmiwarpError` if refused."""
        self._command(SetCounts(per_turn), f"set {per_turn} counts per turn")

    def _command(self, message: Message, what: str) -> None:
        if self._follower.text:
            raise AmiwarpError(f"{self.name}: {what}: it sends lines of text, which take no commands")
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
            raise AmiwarpError(f"{self.name}: {what}: no answer in {ANSWER_S:g} s; see 'amiwarp motor status'")
        if refused:
            why = REFUSALS[refused] if refused < len(REFUSALS) else f"reason {refused}"
            raise AmiwarpError(f"{self.name}: {what}: refused by the controller, {why}")

    def _send(self, message: Message, *, answered: bool = False) -> int:
        """Its sequence number; ``answered``: its answer is kept.

        Raises OSError where the port is gone or takes nothing, ValueError for bad numbers.
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
                    self._turn()
            except OSError:
                self._lost()
            self._shut()
            if self._ended.is_set() or not self._reopen():
                return

    def _turn(self) -> None:
        """Reads what is there, waiting a little; pings when it is time."""
        data = self._port.read(1)
        if data:
            data += self._port.read(min(self._port.in_waiting, READ_BYTES))
        now = self._host_us()
        with self._changed:
            for answer in self._follower.feed(data, now):
                if answer.sequence in self._answers:  # any other answers nothing that waits
                    self._answers[answer.sequence] = answer.refused
            self._changed.notify_all()
            due = self._follower.speaks and now >= self._ping_us
            quick = len(self._follower.trips) < QUICK
        if due:
            self._ping_us = now + (QUICK_US if quick else PING_US)
            self._ping()

    def _ping(self) -> None:
        from serial import SerialTimeoutException

        self._number = (self._number + 1) & 0xFFFFFFFF
        with self._changed:
            self._follower.pinged(self._number, self._host_us())
        with contextlib.suppress(SerialTimeoutException):  # a port that takes nothing for a while is not gone
            self._send(Ping(self._number))

    def _lost(self) -> None:
        with self._changed:
            self._follower.say(f"{self.name}: the port is gone; trying again until it is back")

    def _shut(self) -> None:
        with self._writing:
            port, self._port = self._port, None
        with contextlib.suppress(OSError):
            port.close()

    def _reopen(self) -> bool:
        """Whether it was opened, not ended."""
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
