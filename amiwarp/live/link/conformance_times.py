"""Checks of a controller's clock and of the times in its messages, for the conformance suite."""

from __future__ import annotations

import itertools
import math

import numpy as np

from amiwarp.live.link import protocol
from amiwarp.live.link.camera_clock import are_multiples
from amiwarp.live.link.clocks import FEWEST_PAIRS, fit_to_round_trips
from amiwarp.live.link.conformance_limits import (
    CLOCK_TOLERANCE,
    LATCH_COUNTS,
    LATCH_US,
    OVERSHOOT,
    STALE_US,
    STATUS_S,
    STEADY_S,
    SYNC_HZ,
)
from amiwarp.live.link.conformance_talk import Check, Conversation


def check_latch(talk: Conversation) -> Check:
    """Check that time and count of index pulses fit the samples."""
    name = "latches time and count together"
    t, count = talk.counts_since(0)
    inside = [(pulse_us, c) for pulse_us, c in talk.index if len(t) and t[0] < pulse_us < t[-1]]
    # The resolution of the clock is the common divisor of intervals, of which one alone says nothing
    if len(inside) < 3:
        return Check(name, None, "too few index pulses", "")
    pulse_us, latched = np.array(inside, np.int64).T
    off = latched - np.interp(pulse_us, t, count)
    off -= (1 << 32) * np.rint(off / (1 << 32))
    # Pulses of the ramps, too: at a perfectly constant speed all of them are whole milliseconds apart.
    resolution = math.gcd(*np.diff(pulse_us).tolist())
    rate = abs(talk.rpm) / 60e6 * talk.status.counts_per_turn
    what = f"index pulses within {np.abs(off).max():.1f} counts of the samples, clock in steps of {resolution} us"
    # Samples are a millisecond apart: a line between two may be off by a hundredth of the way
    interpolated = 0.01 * 1000.0 * rate
    good = (
        np.abs(off).max() <= LATCH_COUNTS + LATCH_US * rate + interpolated
        and resolution <= LATCH_US
    )
    return Check(
        name,
        bool(good),
        what,
        "read clock and counter together in the interrupt; use a clock of 1 us",
    )


def check_status_times(talk: Conversation) -> Check:
    """Check that statuses came often enough, and did not claim the speed too early."""
    gaps = np.diff([t for t, _ in talk.statuses])
    gap = float(gaps.max()) * 1e-6 if len(gaps) else math.inf
    early = [
        m
        for _, m in talk.statuses
        if m.state == 1 and abs(m.rpm - m.target_rpm) > OVERSHOOT * abs(talk.rpm)
    ]
    what = (
        f"{len(talk.statuses)} statuses, {gap:.2f} s apart at most, "
        f"{len(early)} say too early that it is at speed"
    )
    remedy = "send a status once per second, and state 1 only at the speed"
    return Check("keeps sending its status", gap <= STATUS_S and not early, what, remedy)


def check_sync(talk: Conversation, syncs: int) -> Check:
    """Check the sync pulses from number ``syncs`` on."""
    name = "sync pulses"
    pulses = talk.sync[syncs:]
    if not pulses:
        return Check(name, None, "none; without them clocks agree to about a millisecond", "")
    rate = len(pulses) / STEADY_S
    consecutive = all((b - a) % (1 << 32) == 1 for (_, a), (_, b) in itertools.pairwise(pulses))
    times = np.unwrap(np.array([t for t, _ in pulses], np.int64), period=1 << 32).astype(np.int64)
    regular = are_multiples(times)
    order = "numbers in order" if consecutive else "numbers with gaps"
    spacing = (
        "at regular intervals, by which clocks are not known for sure"
        if regular
        else "at irregular intervals"
    )
    good = consecutive and SYNC_HZ[0] <= rate <= SYNC_HZ[1]
    least, most = protocol.PULSE_INTERVAL_MS
    remedy = (
        f"send a pulse every {least} to {most} ms, drawn at random for each, and number them from 0"
    )
    return Check(name, good, f"{rate:.1f} per second, {spacing}, {order}", remedy)


def check_clock(talk: Conversation) -> Check:
    """Check the rate of the controller's clock."""
    name = "its clock counts microseconds"
    remedy = "count microseconds; wrap at 32 bits, not before"
    if len(talk.trips) < FEWEST_PAIRS:
        return Check(name, None, "too few pongs", remedy)
    drift = fit_to_round_trips(*np.array(talk.trips, np.int64).T).drift
    return Check(
        name,
        abs(drift) <= CLOCK_TOLERANCE,
        f"{1e6 * drift:+.0f} ppm to this computer's",
        remedy,
    )


def check_pong_times(talk: Conversation) -> Check:
    """Check that the time in each pong lies within its round trip."""
    name = "pongs carry its time"
    remedy = "put the clock of the samples into each pong and status as it is sent"
    if len(talk.trips) < FEWEST_PAIRS:
        return Check(name, None, "too few pongs", remedy)
    sent, answered, received = np.array(talk.trips, np.int64).T
    middle = sent + (received - sent) // 2
    outside = (
        np.abs(answered - fit_to_round_trips(sent, answered, received)(middle))
        - (received - sent) / 2
    )
    worst = max(float(outside.max()), 0.0)
    what = f"{worst / 1000:.1f} ms outside the round trip, {talk.apart} times apart, {talk.stray} not asked for"
    return Check(name, worst <= STALE_US and talk.apart + talk.stray == 0, what, remedy)
