"""Checks of how a controller turns the motor and counts, for the conformance suite."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from amiwarp.live.link import protocol
from amiwarp.live.link.conformance_limits import (
    CHANGE_S,
    EARLY_SHARE,
    HOST_TIMEOUT,
    INDEX_COUNTS,
    INDEX_SHARE,
    JUMP,
    LATCH_COUNTS,
    LEAST_HZ,
    LONGEST_GAP_US,
    LOST_HOST_S,
    LOST_HOST_STOP,
    OVERSHOOT,
    PING_S,
    PLACE_SHARE,
    RAMP_S,
    SETTLE_S,
    SLICE_S,
    SPEED_TOLERANCE,
    STEADY_S,
    STEEP_COUNTS,
    STEEP_RPM_S,
    STEEP_SLICE_S,
    STOP_S,
)
from amiwarp.live.link.conformance_talk import Check, Conversation, reason
from amiwarp.live.link.conformance_times import check_sync


def check_rest(talk: Conversation) -> Check:
    """Check that the prism rests after a stop, without faults."""
    refused = talk.command(protocol.Stop())
    rests = talk.run(STOP_S, until=lambda: talk.status.state == 0)
    faults = [f for bit, f in enumerate(protocol.FAULTS) if talk.status.faults >> bit & 1]
    what = f"answer {reason(refused)}, state {talk.status.state}, faults: {', '.join(faults) or 'none'}"
    remedy = "answer a stop (0x82) with 0 and report state 0; remove the cause of faults"
    return Check("rests after a stop", refused == 0 and rests and not faults, what, remedy)


def check_samples(talk: Conversation) -> Check:
    """Check the rate of the encoder samples."""
    start = len(talk.samples)
    talk.run(2.0)
    t, _ = talk.counts_since(start)
    rate = (len(t) - 1) / max(float(t[-1] - t[0]), 1.0) * 1e6 if len(t) > 1 else 0.0
    gap = int(np.diff(t).max()) if len(t) > 1 else 0
    what = f"{rate:.0f} per second, longest gap {gap / 1000:.1f} ms"
    good = rate >= LEAST_HZ and gap <= LONGEST_GAP_US
    remedy = "latch a sample each millisecond; is the line too slow?"
    return Check("encoder samples at 1 kHz", good, what, remedy)


def check_speed(talk: Conversation) -> Iterator[Check]:
    """Turn up to a speed and keep it; check the ramp, the speed, and the pulses at this speed."""
    rpm = talk.rpm
    start = len(talk.samples)
    refused = talk.command(protocol.SetSpeed(rpm, abs(rpm) / RAMP_S))
    same = talk.run(CHANGE_S, until=lambda: math.isclose(talk.status.target_rpm, rpm, rel_tol=1e-6))
    what = f"answer {reason(refused)}, target {talk.status.target_rpm:g} rpm"
    yield Check(
        "accepts a speed",
        refused == 0 and same,
        what,
        "answer 0, and send a status with the same target at once",
    )
    arrived = talk.run(RAMP_S + SETTLE_S, until=lambda: talk.status.state == 1)
    talk.run(RAMP_S)  # the speed may still overshoot
    yield check_ramp(talk, start, arrived)
    steady = len(talk.samples)
    pulses = len(talk.index)
    syncs = len(talk.sync)
    talk.run(STEADY_S)
    mean = talk.speed(steady)
    what = f"{mean:.2f} rpm by the counts, {talk.status.rpm:.2f} rpm by the status"
    good = (
        abs(mean / rpm - 1.0) <= SPEED_TOLERANCE and abs(talk.status.rpm / rpm - 1.0) <= OVERSHOOT
    )
    yield Check(
        "keeps its speed",
        good and talk.status.state == 1,
        what,
        "check counts per turn and the control loop",
    )
    yield check_index(talk, pulses)
    yield check_sync(talk, syncs)


def check_ramp(talk: Conversation, start: int, arrived: bool) -> Check:
    """Check the speed during the ramp, by the samples from number ``start`` on."""
    t, count = talk.counts_since(start)
    slice_starts = np.arange(t[0], t[-1], SLICE_S * 1e6) if len(t) else np.zeros(0)
    factor = 60.0 / (SLICE_S * max(talk.status.counts_per_turn, 1) * talk.rpm)
    speed = np.diff(np.interp(slice_starts, t, count)) * factor  # of the target
    # A comparison with NaN fails: too few samples fail the check.
    highest = float(speed.max()) if len(speed) else math.nan
    lowest = float(speed.min()) if len(speed) else math.nan
    begun = float(speed[0]) if len(speed) > 1 else math.nan
    early = float(speed[1]) if len(speed) > 1 else math.nan
    what = (
        f"{100 * begun:.0f} % of the speed in the first {SLICE_S:g} s, then {100 * early:.0f} %, at most "
        f"{100 * highest:.0f} %"
    )
    if lowest < -OVERSHOOT:
        return Check(
            "follows the ramp",
            False,
            what,
            "the counts run backwards: exchange A and B, or the motor's wires",
        )
    on_time = begun <= SLICE_S / RAMP_S and EARLY_SHARE[0] <= early <= EARLY_SHARE[1]
    good = arrived and highest <= 1.0 + OVERSHOOT and on_time
    if not arrived:
        what += f'; no state "at speed" {SETTLE_S:g} s after the ramp'
    return Check(
        "follows the ramp", good, what, "limit the change of the speed; tune the control loop"
    )


def check_index(talk: Conversation, pulses: int) -> Check:
    """Check that index pulses, from number ``pulses`` on, are a turn apart."""
    name = "one index pulse per turn"
    remedy = "check the index sensor, its interrupt, and the counts per turn"
    counts = np.unwrap(np.array([c for _, c in talk.index[pulses:]], np.int64), period=1 << 32)
    expected = STEADY_S * abs(talk.rpm) / 60.0
    if len(counts) < max(2, expected / 2.0):
        return Check(name, False, f"{len(counts)} pulses in {expected:.0f} turns", remedy)
    per_turn = talk.status.counts_per_turn
    steps = np.abs(np.diff(counts))
    allowed = max(INDEX_COUNTS, INDEX_SHARE * per_turn)
    error = float(np.abs(steps - per_turn).max())
    together = float(abs(steps.sum() - len(steps) * per_turn))
    what = f"{len(counts)} pulses, {steps.min():,} to {steps.max():,} counts apart"
    return Check(name, error <= 0.01 * per_turn and together <= allowed, what, remedy)


def check_other_way(talk: Conversation) -> Check:
    """Turn the other way, at a speed that is not a whole number."""
    rpm = -0.75 * talk.rpm - math.copysign(0.375, talk.rpm)
    before = talk.index[-1:]
    refused = talk.command(protocol.SetSpeed(rpm, abs(talk.rpm) / RAMP_S))
    arrived = talk.run(
        2.0 * RAMP_S + SETTLE_S,
        until=lambda: talk.status.state == 1 and math.isclose(talk.status.target_rpm, rpm),
    )
    talk.run(RAMP_S)
    start = len(talk.samples)
    pulses = len(talk.index)
    talk.run(STEADY_S)
    mean = talk.speed(start)
    per_turn = max(talk.status.counts_per_turn, 1)
    what = (
        f"answer {reason(refused)}, {mean:.2f} of {rpm:.2f} rpm by the counts, "
        f"{talk.status.rpm:.2f} by the status"
    )
    good = (
        abs(mean / rpm - 1.0) <= SPEED_TOLERANCE and abs(talk.status.rpm / rpm - 1.0) <= OVERSHOOT
    )
    if before:
        away = [math.remainder(count - before[0][1], per_turn) for _, count in talk.index[pulses:]]
        place = max(map(abs, away), default=math.inf)
        what += f", the index {place:g} counts from its place forwards"
        good &= place <= LATCH_COUNTS + PLACE_SHARE * per_turn
    remedy = (
        "count down backwards; take the same edge of the index pulse in both directions, "
        "which is at lower counts"
    )
    return Check("turns the other way", refused == 0 and arrived and good, what, remedy)


def check_stop(talk: Conversation) -> Check:
    """Check that a stop brings the prism to rest."""
    refused = talk.command(protocol.Stop())
    start = talk.wire.now_us()
    rests = talk.run(STOP_S, until=lambda: talk.status.state == 0)
    after = (talk.wire.now_us() - start) * 1e-6
    samples = len(talk.samples)
    talk.run(SLICE_S)
    speed = talk.speed(samples)
    slow = max(0.05 * abs(talk.rpm), 60.0 / SLICE_S / max(talk.status.counts_per_turn, 1) * 2)
    still = abs(speed) < slow and abs(talk.status.rpm) < slow
    what = f"answer {reason(refused)}, state {talk.status.state} after {after:.1f} s, {speed:.1f} rpm by the counts"
    good = refused == 0 and rests and still and talk.status.target_rpm == 0
    return Check("stops", good, what, "brake to rest and report state 0 and target 0")


def check_steep_ramp(talk: Conversation) -> Check:
    """Check that the acceleration is limited if the ramp is too steep."""
    name = "limits its acceleration"
    rpm = talk.rpm / 2.0
    start = len(talk.samples)
    refused = talk.command(protocol.SetSpeed(rpm, STEEP_RPM_S))
    if refused == 2:
        return Check(name, None, f"it refuses a ramp of {STEEP_RPM_S:g} rpm/s", "")
    talk.run(RAMP_S)
    t, count = talk.counts_since(start)
    talk.command(protocol.Stop())
    talk.run(STOP_S, until=lambda: talk.status.state == 0)
    per_us = abs(rpm) / 60e6 * max(talk.status.counts_per_turn, 1)
    slice_us = max(STEEP_SLICE_S * 1e6, STEEP_COUNTS / per_us)
    slice_starts = np.arange(t[0], t[-1], slice_us) if len(t) else np.zeros(0)
    speed = (
        np.diff(np.interp(slice_starts, t, count)) / (slice_us * per_us) * math.copysign(1.0, rpm)
    )
    highest = float(speed.max()) if len(speed) else math.nan
    what = f"answer {reason(refused)}, at most {100 * highest:.0f} % of {rpm:g} rpm"
    remedy = "limit the ramp to one that the motor can follow, or tune the control loop"
    return Check(name, refused == 0 and 0.5 < highest <= 1.0 + OVERSHOOT, what, remedy)


def check_lost_host(talk: Conversation) -> Check:
    """Turn, be silent, and expect that the motor stops by itself; the setting is the one of before at the end."""
    name = "stops for a lost host, if told so"
    if talk.older:
        return Check(name, None, "older than firmware 1.1", "")
    rpm = talk.rpm / 2.0
    start = talk.ask(protocol.Condition)
    talk.run(SLICE_S)

    # With pings, the motor turns on.
    taken = talk.command(protocol.SetSetting(HOST_TIMEOUT, LOST_HOST_S))
    talk.command(protocol.SetSpeed(rpm, 2.0 * abs(rpm)))
    kept = talk.run(LOST_HOST_S + 1.0, until=lambda: talk.status.target_rpm == 0)

    # Without pings, it stops and says so.
    silent = talk.wire.now_us()
    talk.run(LOST_HOST_S + STOP_S, until=lambda: talk.status.target_rpm == 0, pings=False)
    after = (talk.wire.now_us() - silent) * 1e-6
    stopped = talk.run(STOP_S, until=lambda: talk.status.state == 0, pings=False)
    is_reported = bool(talk.status.faults & LOST_HOST_STOP)
    end = talk.ask(protocol.Condition)

    # A new command clears the fault. The setting cannot change while the prism turns.
    again = talk.command(protocol.SetSpeed(rpm, abs(rpm)))
    talk.run(CHANGE_S)
    cleared = not talk.status.faults & LOST_HOST_STOP
    while_turning = talk.command(protocol.SetSetting(HOST_TIMEOUT, LOST_HOST_S + 1))

    talk.command(protocol.Stop())
    talk.run(STOP_S, until=lambda: talk.status.state == 0)
    talk.run(SLICE_S)
    restored = talk.command(protocol.SetSetting(HOST_TIMEOUT, talk.timeout_s))
    counted = (
        isinstance(start, protocol.Condition)
        and isinstance(end, protocol.Condition)
        and end.host_stops == min(start.host_stops + 1, 0xFFFF)
        and end.host_timeout_s == LOST_HOST_S
    )
    on_time = LOST_HOST_S - PING_S <= after <= LOST_HOST_S + CHANGE_S
    good = (
        taken == restored == again == 0
        and not kept
        and stopped
        and is_reported
        and counted
        and cleared
    )
    what = (
        f"told {LOST_HOST_S} s, {'' if stopped else 'not '}stopped after {after:.1f} s of silence"
    )
    what += f"{'' if counted else ', not counted'}{'' if is_reported else ', not said'}"
    remedy = "brake when no frame came for the setting host-timeout; count it; set fault bit 10 until a new command"
    return Check(name, good and on_time and while_turning == 3, what, remedy)


def check_jumps(talk: Conversation) -> Check:
    """Check that no counts were lost or jumped."""
    t, count = talk.counts_since(0)
    fastest = JUMP * abs(talk.rpm) / 60e6 * talk.status.counts_per_turn  # counts per us
    allowed = LATCH_COUNTS + fastest * np.maximum(np.diff(t), 1000)
    jumps = int((np.abs(np.diff(count)) > allowed).sum())
    remedy = "count in 32 bits, over turns and past zero, and lose no edge"
    return Check("counts continue", jumps == 0, f"{jumps} jumps in {len(count):,} samples", remedy)
