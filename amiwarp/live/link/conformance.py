"""Conformance suite for a controller: checks firmware, or the emulator, against ``docs/reference/link-protocol.md``.

The suite turns the motor. It stops the motor at its end, also after an error.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from amiwarp.errors import AmiwarpError
from amiwarp.live.link import protocol
from amiwarp.live.link.conformance_limits import LISTEN_S
from amiwarp.live.link.conformance_messages import (
    check_bad_frames,
    check_identity,
    check_losses,
    check_opening,
    check_pings,
    check_refusals,
    check_settings,
    check_silence,
    check_status,
)
from amiwarp.live.link.conformance_motion import (
    check_jumps,
    check_lost_host,
    check_other_way,
    check_rest,
    check_samples,
    check_speed,
    check_steep_ramp,
    check_stop,
)
from amiwarp.live.link.conformance_talk import Check, Conversation, Wire
from amiwarp.live.link.conformance_times import (
    check_clock,
    check_latch,
    check_pong_times,
    check_status_times,
)


def check_controller(
    wire: Wire, rpm: float, done: Callable[[Check], None] = lambda check: None
) -> list[Check]:
    """Check a controller and return the results in order. The motor turns at up to ``rpm`` [turns/min].

    ``done`` is called with each result. A controller without frames, or without a status, ends the suite early.
    """
    talk = Conversation(wire, rpm)
    results = []
    try:
        for check in all_checks(talk):
            results.append(check)
            done(check)
    finally:
        with contextlib.suppress(OSError, AmiwarpError):
            talk.send(protocol.Stop())
    return results


def all_checks(talk: Conversation) -> Iterator[Check]:
    """Run all checks, and yield their results in order."""
    talk.run(LISTEN_S, until=lambda: talk.decoder.received.frames > 1)
    received = talk.decoder.received
    what = f"{received.frames} frames, {received.damaged} damaged, {received.lines} lines of text"
    yield Check(
        "frames arrive",
        received.frames > 1,
        what,
        "check port, baud rate (460,800) and the sender's CRC",
    )
    if received.frames <= 1:
        return
    talk.first = protocol.FrameCounters(
        damaged=received.damaged, unknown=received.unknown, lost=received.lost
    )
    talk.run(LISTEN_S, until=lambda: talk.last_status is not None)
    yield check_status(talk)
    if talk.last_status is None:
        return
    yield check_pings(talk)
    yield check_rest(talk)
    yield check_samples(talk)
    yield check_refusals(talk)
    yield check_identity(talk)
    yield check_settings(talk)
    yield from check_speed(talk)
    yield from check_bad_frames(talk)
    yield check_silence(talk)
    yield check_other_way(talk)
    yield check_stop(talk)
    yield check_steep_ramp(talk)
    yield check_lost_host(talk)
    remedy = "send samples and index pulses in the order of their times, with time and count latched together"
    yield Check("times increase", talk.disorder == 0, f"{talk.disorder} out of order", remedy)
    yield check_latch(talk)
    yield check_jumps(talk)
    yield check_status_times(talk)
    yield check_opening(talk)
    yield check_clock(talk)
    yield check_pong_times(talk)
    yield check_losses(talk)
