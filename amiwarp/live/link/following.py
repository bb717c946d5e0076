"""From the controller's bytes to times, angles, pulses and messages: what of the link needs no port and no thread."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np

from amiwarp.live.link.angles import Angles, Fault, Report
from amiwarp.live.link.clocks import FEWEST, WRAP, Clock, Unwrapped, from_round_trips
from amiwarp.live.link.news import MOST_PARTS, MOST_PULSES, News, Part
from amiwarp.live.link.protocol import FAULTS, Answer, Decoder, Index, Message, Pong, Samples, Status, Sync

MOST = 100_000
"""Samples kept for who does not ask, over a minute and a half at 1 kHz; then the oldest are dropped."""
TRIPS = 60
"""Round trips kept."""
LATE_US = 100_000
"""A clock that goes back further was reset."""
AHEAD_US = 2_000_000
"""A clock that goes ahead of the host's by more, all at once, was set anew."""
SILENT_US = 1_800_000_000
"""After such a silence nobody knows how often the clock wrapped."""
FASTEST = 200.0
"""Turns a second: counts that run faster, by more than a turn, began anew."""
HOLD_TURNS = 2
"""Within these the first index pulse is waited for."""
STATUS_US = 2_000_000
"""So long the controller's own counts per turn are waited for: it sends its status once a second."""
OFTEN_US = 1_000_000
"""Messages of losses and noise come no closer than this."""
STALL_US, STALL_COUNTS = 300_000, 5.0
"""Counts that stay for so long, and for the time of so many at the speed that the controller names, are stalled."""
FROM_FIRST = "angles are from where the encoder was first read"
HOST_LOST = 1 << FAULTS.index("host lost")


class Follower:
    """Feed it what the port gives, take the news. ``name``: the port, for messages. Raises nothing, holds little.

    Samples are held back until the first index pulse tells their absolute angle, for two turns at most; lines of text
    are not, they have no index. ``counts_per_turn`` is for controllers that do not tell it.
    """

    def __init__(self, name: str, counts_per_turn: int | None = None) -> None:
        self.name = name
        self.status: Status | None = None
        self.trips: deque[tuple[int, int, int]] = deque(maxlen=TRIPS)
        """Of pings: sent (host), answered (controller), received (host) [us]."""
        self._given_per_turn = counts_per_turn
        self._per_turn: int | None = None
        self._parts: deque[Part] = deque([Part(False)])
        self._kept = 0
        self._dropped = 0
        self._begin()
        self.opened(0)

    def opened(self, host_us: int) -> None:
        """The port was opened, or opened again: what the decoder holds is void, what is known of the prism is not."""
        self._decoder = Decoder()
        self._opened_us, self._bytes, self._dumb = host_us, 0, False
        self._damaged: int | None = None  # what is cut by the opening is no damage
        self._lost = self._late = 0
        self._noise_us = self._lost_us = -OFTEN_US
        self._sequence: int | None = None
        self._heard, self._reopened = False, True

    def _begin(self) -> None:
        self._clock, self._ahead, self._seen_us = Unwrapped(), -math.inf, 0
        self._angles = None if self._per_turn is None else Angles(self._per_turn)
        self._waiting: deque[tuple[bool, int, int]] = deque(maxlen=MOST)  # for the counts per turn: index?, time, count
        self._holding: deque[tuple[int, int]] | None = deque(maxlen=MOST)  # for the index
        self._pulses: deque[int] = deque(maxlen=MOST_PULSES)
        self._suspect: tuple[int, int] | None = None
        self._counted: tuple[int, int] | None = None  # time and count, made whole
        self._given: int | None = None
        self._still, self._stalled, self._status_us = (0, 0), False, -1
        self._faults = 0
        self._pings: dict[int, int] = {}
        self.trips.clear()

    @property
    def speaks(self) -> bool:
        """Whether frames came since the port was opened: pings and commands make sense."""
        return self._decoder.received.frames > 0

    @property
    def text(self) -> bool:
        """Whether lines came: there is nothing to ask, and no answer."""
        return self._decoder.received.lines > 0

    def pinged(self, number: int, host_us: int) -> None:
        """A ping was sent."""
        self._pings[number] = host_us
        self._pings.pop(number - TRIPS, None)

    def clock(self) -> Clock | None:
        """The controller's clock beside the host's; None until three pings were answered.

        How much longer than the way there the way back always takes is not known: that does not average out.
        """
        if len(self.trips) < FEWEST:
            return None
        sent, answered, received = np.array(self.trips, np.int64).T
        clock = from_round_trips(sent, answered, received)
        shared = float((received - sent).min()) / math.sqrt(12.0)
        return replace(clock, offset_std_us=math.hypot(clock.offset_std_us, shared))

    def say(self, sentence: str) -> None:
        """A message, in its place among the samples."""
        self._parts[-1].messages.append(sentence)

    def take(self) -> News:
        """What came since the last call; where the controller began anew in between, first what was before that."""
        part = self._parts.popleft()
        if not self._parts:
            self._parts.append(Part(False))
        self._kept -= len(part.samples)
        if self._dropped:
            part.messages.append(f"{self._dropped:,} samples were dropped, the oldest: nobody asked for them")
            self._dropped = 0
        return part.news()

    def feed(self, data: bytes, host_us: int) -> list[Answer]:
        """Bytes that were read at a time of the host [us], none where nothing came; the answers to commands in them."""
        self._bytes += len(data)
        answers = []
        for sequence, message in self._decoder.feed(data):
            if sequence is not None:
                before, self._sequence = self._sequence, sequence
                if before is not None and (sequence - before) & 0xFFFF >= 1 << 15:
                    self._restart("the controller was reset")
            if isinstance(message, Answer):
                answers.append(message)
            else:
                self._take_in(message, host_us, text=sequence is None)
        self._account(host_us)
        return answers

    def _take_in(self, message: Message, host_us: int, *, text: bool) -> None:
        if isinstance(message, Samples):
            for raw_t, raw_count in zip(message.t_us, message.count, strict=True):
                self._sample(raw_t, raw_count, host_us, text)
        elif isinstance(message, Index):
            t, count = self._place(message.t_us, message.count, host_us)
            self._now_or_later(True, t, count)
        elif isinstance(message, Sync):
            t = self._time(message.t_us, host_us)
            self._parts[-1].sync.append((message.number, t, host_us))
        elif isinstance(message, Pong):
            t = self._time(message.t_us, host_us)
            self._heard = True
            if message.number in self._pings:
                self.trips.append((self._pings.pop(message.number), t, host_us))
        elif isinstance(message, Status):
            self._state(message, self._time(message.t_us, host_us))

    def _sample(self, raw_t: int, raw_count: int, host_us: int, text: bool) -> None:
        """A line of text may be wrong: what does not follow is believed once the next follows it."""
        if text and self._per_turn is None:
            self._decide(self._given_per_turn)
        before, self._suspect = self._suspect, None
        if text and self._odd(raw_t, raw_count, host_us):
            if before is None or not self._follows(before, raw_t, raw_count):
                self._suspect = raw_t, raw_count
                self._decoder.received.damaged += 1
                return
            self._now_or_later(False, *self._place(*before, host_us))
        t, count = self._place(raw_t, raw_count, host_us)
        if text and self._holding is not None and self._per_turn is not None:
            self.say(f"{self.name}: lines of text have no index pulse: {FROM_FIRST}")
            self._release()
        if not text and self._per_turn is None and self._waiting and t - self._waiting[0][1] > STATUS_US:
            self._decide(self._given_per_turn)
        self._now_or_later(False, t, count)

    def _follows(self, before: tuple[int, int], raw_t: int, raw_count: int) -> bool:
        step = (raw_t - before[0]) % WRAP
        return 0 < step < AHEAD_US and abs(raw_count - before[1]) <= self._farthest(step)

    def _farthest(self, step_us: int) -> float:
        """Counts that a prism can turn by, and a turn."""
        return (self._per_turn or math.inf) * (1.0 + FASTEST * max(step_us, 0) * 1e-6)

    def _odd(self, raw_t: int, raw_count: int | None, host_us: int) -> str:
        """Why a sample does not go on from the one before; empty where it does."""
        if self._clock.last is None:
            return ""
        ahead = self._clock.ahead(raw_t)
        beside = self._clock.last + ahead - host_us - self._ahead  # negative for what waited somewhere
        behind = self._reopened and beside < -AHEAD_US  # nothing waited in a port that was closed
        if ahead < -LATE_US or behind or host_us - self._seen_us > SILENT_US:
            return "the controller's clock began anew, it was reset"
        if beside > AHEAD_US:
            return "the controller's clock jumped ahead"
        if raw_count is not None and self._counted is not None:
            step = self._step(raw_count)
            if abs(step) > self._farthest(self._clock.last + ahead - self._counted[0]):
                return f"the counts jumped by {step:,}"
        return ""

    def _step(self, raw_count: int) -> int:
        """To a count from the last, over a wrap of 32 bits."""
        assert self._counted is not None
        return (raw_count - self._counted[1] + WRAP // 2) % WRAP - WRAP // 2

    def _time(self, raw_t: int, host_us: int) -> int:
        why = self._odd(raw_t, None, host_us)
        if why:
            self._restart(why)
        t = self._clock(raw_t)
        self._ahead, self._seen_us, self._reopened = max(self._ahead, t - host_us), host_us, False
        return t

    def _place(self, raw_t: int, raw_count: int, host_us: int) -> tuple[int, int]:
        """Time and count, made whole."""
        why = self._odd(raw_t, raw_count, host_us)
        if why:
            self._restart(why)
        t = self._time(raw_t, host_us)
        count = raw_count if self._counted is None else self._counted[1] + self._step(raw_count)
        self._counted = t, count
        return t, count

    def _restart(self, why: str) -> None:
        self._release()
        if self._parts[-1].samples:
            self._parts.append(Part(True))
        if len(self._parts) > MOST_PARTS:
            gone = len(self._parts[0].samples)
            self._kept, self._dropped = self._kept - gone, self._dropped + gone
            self._join()
        self._parts[-1].restarted = True
        self._parts[-1].sync.clear()  # by the clock that is void
        self.say(f"{self.name}: {why}; angles begin anew")
        self._lost = self._decoder.received.lost
        self._begin()

    def _decide(self, per_turn: int | None) -> None:
        """The counts per turn are known, or there is nowhere to know them from."""
        if per_turn is None:
            if not self._dumb:
                self.say(f"{self.name}: it does not tell the encoder's counts per turn; give counts_per_turn")
            self._dumb = True
        elif per_turn != self._per_turn:
            before, self._per_turn = self._per_turn, per_turn
            if before is not None:
                self._restart(f"the controller counts {per_turn:,} a turn now, not {before:,}")
            self._angles = Angles(per_turn)
            while self._waiting:
                self._now_or_later(*self._waiting.popleft())

    def _now_or_later(self, pulse: bool, t: int, count: int) -> None:
        if self._angles is None:
            self._waiting.append((pulse, t, count))
        elif pulse:
            self._index(self._angles, t, count)
        else:
            self._turned(self._angles, t, count)

    def _turned(self, angles: Angles, t: int, count: int) -> None:
        angle, reports = angles.count(t, count)
        self._tell(angles, reports)
        self._watch(angles, t, count)
        if self._holding is None:
            self._give(t, angle)
            return
        self._holding.append((t, count))
        if abs(count - self._holding[0][1]) > HOLD_TURNS * angles.counts_per_turn:
            self.say(f"no index pulse in {HOLD_TURNS} turns: {FROM_FIRST}")
            self._release()

    def _index(self, angles: Angles, t: int, count: int) -> None:
        late = self._holding is None and not angles.absolute
        before = angles.angle(count) if late else 0.0
        self._tell(angles, angles.index(t, count))
        if late:
            moved = math.degrees(angles.angle(count) - before)
            self.say(f"the index pulse came: angles are absolute from here, and move by {moved:+.1f} deg")
        self._pulses.append(t)
        self._release()

    def _release(self) -> None:
        held, self._holding = self._holding or (), None
        for t, count in held:
            assert self._angles is not None
            self._give(t, self._angles.angle(count))

    def _give(self, t: int, angle: float) -> None:
        if self._given is not None and t <= self._given:
            self._late += 1
            return
        self._given = t
        part = self._parts[-1]
        while self._pulses and self._pulses[0] <= t:
            part.index.append(self._pulses.popleft())
        part.samples.append((t, angle))
        self._kept += 1
        if self._kept > MOST:
            gone, _ = self._parts[0].samples.popleft()
            while (pulses := self._parts[0].index) and pulses[0] <= gone:
                pulses.popleft()
            self._kept, self._dropped = self._kept - 1, self._dropped + 1
            if not self._parts[0].samples:
                self._join()

    def _join(self) -> None:
        """Merge the first part, whose samples are dropped, into the next."""
        gone, part = self._parts.popleft(), self._parts[0]
        part.restarted |= gone.restarted
        part.messages.extendleft(reversed(gone.messages))

    def _tell(self, angles: Angles, reports: tuple[Report, ...]) -> None:
        for report in reports:
            if report.fault is Fault.SLIP:
                what = f"{abs(report.counts):,} counts {'were lost' if report.counts < 0 else 'too many'}"
                self.say(f"slip: {what} by the index pulse; angles are right again from there")
            elif report.fault is Fault.MISSED_INDEX:
                self.say(f"no index pulse for {abs(report.counts) / angles.counts_per_turn:.1f} turns")
            else:
                self.say("the prism turns the other way")

    def _watch(self, angles: Angles, t: int, count: int) -> None:
        """Counts that stay, while the controller said meanwhile that it turns."""
        if self._still[0] == 0 or count != self._still[1]:
            self._still, self._stalled = (t, count), False
            return
        status = self.status
        if self._stalled or status is None or self._status_us < self._still[0]:
            return
        rpm = max(abs(status.rpm), abs(status.target_rpm) if status.state == 1 else 0.0)
        rate = rpm / 60e6 * angles.counts_per_turn
        if rpm > 0 and t - self._still[0] > max(STALL_US, STALL_COUNTS / rate):
            self._stalled = True
            self.say(f"the encoder stays at count {count:,} while the controller says {status.rpm:g} rpm")

    def _state(self, status: Status, t: int) -> None:
        self.status, self._status_us = status, t
        self._decide(status.counts_per_turn or self._per_turn or self._given_per_turn)
        # It had not heard of this host before the first ping: that is no news.
        faults = status.faults if self._heard else status.faults & ~HOST_LOST
        for bit, name in enumerate(FAULTS):
            if faults & ~self._faults & 1 << bit:
                self.say(f"the controller reports a fault: {name}")
        self._faults = faults

    def _account(self, host_us: int) -> None:
        """Losses and noise, said not too often."""
        received = self._decoder.received
        if not (self.speaks or self.text):
            if self._bytes and host_us - self._opened_us > STATUS_US and not self._dumb:
                self.say(f"{self.name}: what it sends is neither frames nor lines of samples; wrong port or baud rate?")
                self._dumb = True
            return
        if self._damaged is not None and received.damaged > self._damaged:
            if host_us - self._noise_us > OFTEN_US:
                self.say(f"{self.name}: damaged frames or lines, dropped; is the cable noisy?")
            self._noise_us = host_us
        self._damaged = received.damaged
        if host_us - self._lost_us > OFTEN_US and (received.lost > self._lost or self._late):
            if received.lost > self._lost:
                self.say(f"{self.name}: frames lost: {received.lost - self._lost:,}")
            if self._late:
                self.say(f"{self.name}: samples out of order, dropped: {self._late:,}")
            self._lost, self._late, self._lost_us = received.lost, 0, host_us
