"""Checks of what a controller sends and answers, for the conformance suite."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator

from amiwarp.live.link import protocol
from amiwarp.live.link.conformance_limits import (
    ANSWER_S,
    BURST,
    HOST_TIMEOUT,
    LISTEN_S,
    MOST_SUPPLY_V,
    OVERSHOOT,
    PONG_S,
    SILENCE_S,
)
from amiwarp.live.link.conformance_talk import Check, Conversation, reason


def check_status(talk: Conversation) -> Check:
    """Check the first status."""
    name = "status once per second"
    remedy = "send a status (type 0x04) once per second and on each change"
    status = talk.last_status
    if status is None:
        return Check(name, False, f"none in {LISTEN_S:g} s", remedy)
    known = status.state < len(protocol.STATES) and status.faults >> len(protocol.FAULTS) == 0
    what = f"state {status.state}, faults {status.faults:#x}, {status.counts_per_turn:,} counts per turn"
    return Check(
        name,
        known and status.counts_per_turn > 0,
        what,
        "send a known state, faults and counts per turn",
    )


def check_pings(talk: Conversation) -> Check:
    """Check that pings are answered soon, also several at once."""
    sent = []
    for _ in range(10):
        sent.append(talk.ping())
        talk.run(ANSWER_S, until=lambda: sent[-1] not in talk.sent, pings=False)
    trips = sorted(received - at for at, _, received in talk.trips)
    burst = [talk.expect_pong() for _ in range(BURST)]
    together = b"".join(
        protocol.encode(protocol.Ping(number), talk.next_sequence()) for number in burst
    )
    talk.wire.write(b"\0" + together)  # two zeros in a row enclose no frame
    talk.run(ANSWER_S, until=lambda: not talk.sent.keys() & set(burst), pings=False)
    sent += burst
    missing = sum(number in talk.sent for number in sent)
    what = f"{missing} of {len(sent)} without a pong"
    median_us = trips[len(trips) // 2] if trips else 0
    if trips:
        what += f", round trip {median_us / 1000:.1f} ms"
    good = missing == 0 and median_us <= PONG_S * 1e6
    return Check(
        "answers pings", good, what, "check the line to the controller, and send a pong at once"
    )


def check_refusals(talk: Conversation) -> Check:
    """Check that commands with values out of range are refused."""
    speeds = (math.nan, 100.0), (math.inf, 100.0), (1e9, 100.0), (-1e9, 100.0)
    ramps = (10.0, -1.0), (10.0, 0.0), (10.0, math.nan), (10.0, math.inf)
    wrong: list[protocol.Message] = [protocol.SetSpeed(*pair) for pair in (*speeds, *ramps)]
    wrong.append(protocol.SetCounts(0))
    wrong.append(protocol.SetCounts(1 << 24))
    answers = [talk.command(message) for message in wrong]
    same = talk.command(protocol.SetCounts(talk.status.counts_per_turn))
    target = talk.status.target_rpm
    what = f"answers {', '.join(map(reason, answers))}; target {target:g} rpm; same counts: {reason(same)}"
    remedy = (
        "answer 2 to speeds that are not finite or too high, to ramps that are not finite or not above 0, and to 0 "
        "or more than 16,777,215 counts per turn; answer 0 to the counts that it has"
    )
    good = set(answers) == {2} and target == 0 and same == 0
    return Check("refuses what is out of range", good, what, remedy)


def check_identity(talk: Conversation) -> Check:
    """Check what the controller says of itself: firmware, board, supply."""
    name = "says what it is"
    remedy = "answer 0x85 by the message that it asks for, then 0; 2 to other types"
    older = talk.command(protocol.Ask(protocol.Identity.KIND))
    if older in (None, 1):
        talk.older = True
        return Check(name, None, f"answer {reason(older)}: older than firmware 1.1", "")
    who = talk.ask(protocol.Identity)
    condition = talk.ask(protocol.Condition)
    other = talk.command(protocol.Ask(0x7F))
    if not isinstance(who, protocol.Identity) or not isinstance(condition, protocol.Condition):
        return Check(
            name,
            False,
            f"answer {reason(older)}, but no identity or condition before it",
            remedy,
        )
    supply = "unknown" if condition.supply_v is None else f"{condition.supply_v:.1f} V"
    what = f"firmware {who.version} on {who.board_name or 'an unnamed board'}, supply {supply}"
    named = who.board_name != "" and "?" not in who.board_name and who.version != "0.0.0"
    possible = condition.supply_v is None or 0 < condition.supply_v <= MOST_SUPPLY_V
    known = condition.stored < len(protocol.STORED)
    return Check(
        name,
        named and possible and known and other == 2,
        f"{what}, other: {reason(other)}",
        remedy,
    )


def check_settings(talk: Conversation) -> Check:
    """Read each setting, change it, and change it back; check that values out of range are refused."""
    name = "keeps settings within their ranges"
    remedy = "compare the settings' keys and ranges with the protocol"
    if talk.older:
        return Check(name, None, "older than firmware 1.1", "")
    wrong = []
    for key, setting in enumerate(protocol.SETTINGS):
        value = talk.setting(key)
        if value is None or not setting.contains(value):
            wrong.append(f"{setting.name} is {value}")
            continue
        harmless = setting.most if setting.name == "overvoltage" else setting.least
        other = next(v for v in (value - 1, value + 1, harmless) if setting.contains(v))
        below = setting.least - 2 if setting.contains(setting.least - 1) else setting.least - 1
        steps = [(setting.most + 1, 2, value), (below, 2, value), (-(1 << 31), 2, value)]
        steps += [(other, 0, other), (value, 0, value)]
        for tried, expected, kept in steps:
            answer = talk.command(protocol.SetSetting(key, tried))
            if answer != expected or talk.setting(key) != kept:
                wrong.append(
                    f"{setting.name} {tried}: answer {reason(answer)}, then {talk.setting(key)}"
                )
    beyond = talk.command(protocol.SetSetting(len(protocol.SETTINGS), 1))
    if beyond != 2:
        wrong.append(f"an unknown setting: answer {reason(beyond)}")
    counts = talk.status.counts_per_turn
    if talk.setting(0) != counts:
        wrong.append(f"counts-per-turn is not the status's {counts:,}")
    talk.timeout_s = talk.setting(HOST_TIMEOUT) or 0
    # Else the motor stops in the silence of later checks
    talk.command(protocol.SetSetting(HOST_TIMEOUT, 0))
    what = (
        "; ".join(wrong[:3]) or f"{len(protocol.SETTINGS)} settings read, changed, and changed back"
    )
    return Check(name, not wrong, what, remedy)


def check_bad_frames(talk: Conversation) -> Iterator[Check]:
    """Check that damaged frames have no effect, and how unknown commands are answered. The motor turns."""
    rng = random.Random(0)
    slower = protocol.SetSpeed(talk.rpm / 2.0, 1e3)
    for frame in [
        *(damaged_frame(talk, protocol.Stop(), byte) for byte in range(2, 8)),
        *(damaged_frame(talk, slower, byte) for byte in (4, 6, 8, 11)),
        protocol.encode(protocol.Stop(), talk.next_sequence())[:-3] + b"\0",
        bytes(rng.randrange(1, 256) for _ in range(300)) + b"\0",
        b"\x55" * 700 + b"\0",
    ]:
        talk.wire.write(frame)
        talk.run(0.05, pings=False)
    kept_after_damage = keeps_speed(talk)

    unanswered = [
        b"\2\x82\0\0",  # another version
        b"\1\xf0\0\0" + b"\1" * 600,  # longer than a frame may be
    ]
    unheard = [offer_packet(talk, packet) for packet in unanswered]
    # Unknown commands, and commands whose payload has another size
    other = [
        b"\1\xf0\0\0",
        b"\1\xf0\0\0" + bytes(300),
        b"\1\xf0\0\0" + b"\1" * 300,  # more than one full block
        b"\1\x82\0\0\7",
        b"\1\x81\0\0" + bytes(12),
        b"\1\x83\0\0\1",
    ]
    answers = [talk.answers.pop(offer_packet(talk, packet), None) for packet in other]
    heard = sum(number in talk.answers for number in unheard)
    kept_at_end = keeps_speed(talk)
    kept = kept_after_damage and kept_at_end
    what = (
        f"pong: {'yes' if kept else 'no'}, target {talk.status.target_rpm:g} rpm, {heard} answered"
    )
    remedy = (
        "drop frames with a wrong CRC, version or length, and synchronise at the next zero byte"
    )
    yield Check("ignores bad frames", kept and heard == 0, what, remedy)
    name = "answers unknown commands"
    what = f"answers {', '.join(map(reason, answers))}"
    if not any(answer is not None for answer in answers):
        yield Check(name, None, "none: an older controller, which skips them", "")
        return
    yield Check(
        name,
        set(answers) == {1},
        what,
        "answer 1 to an unknown type, and to a payload of another size",
    )


def damaged_frame(talk: Conversation, message: protocol.Message, byte: int) -> bytes:
    """Return a frame that is whole but for one bit of a byte of the packet or of its CRC."""
    from cobs import cobs

    packet = bytearray(cobs.decode(protocol.encode(message, talk.next_sequence())[:-1]))
    packet[byte] ^= 0x10
    return bytes(cobs.encode(bytes(packet))) + b"\0"


def offer_packet(talk: Conversation, packet: bytes) -> int:
    """Send a packet with a sequence number and a valid CRC; return the number."""
    number = talk.next_sequence()
    talk.commands.add(number)
    talk.wire.write(protocol.framed(packet[:2] + number.to_bytes(2, "little") + packet[4:]))
    talk.run(0.05, pings=False)
    return number


def keeps_speed(talk: Conversation) -> bool:
    """Whether a ping is answered, and the speed is the same as before."""
    number = talk.ping()
    answered = talk.run(ANSWER_S, until=lambda: number not in talk.sent, pings=False)
    return answered and math.isclose(talk.status.target_rpm, talk.rpm, rel_tol=1e-6)


def check_silence(talk: Conversation) -> Check:
    """Check that a silent host is noticed, and that the motor turns on."""
    lost = 1 << protocol.FAULTS.index("host lost")
    start = talk.wire.now_us()
    noticed = talk.run(SILENCE_S, until=lambda: bool(talk.status.faults & lost), pings=False)
    after = (talk.wire.now_us() - start) * 1e-6
    samples = len(talk.samples)
    talk.run(0.5, pings=False)
    speed = talk.speed(samples)
    talk.ping()
    cleared = talk.run(LISTEN_S, until=lambda: not talk.status.faults & lost)
    turning = abs(speed / talk.rpm - 1.0) <= OVERSHOOT
    noted = f"reported after {after:.1f} s" if noticed else f"not reported in {SILENCE_S:g} s"
    what = f'"host lost" {noted}, {speed:.0f} rpm meanwhile, {"" if cleared else "not "}cleared by a ping'
    remedy = "set fault bit 4 after a few seconds without a frame, clear it at the next; keep the motor turning"
    return Check("notices a silent host", noticed and turning and cleared, what, remedy)


def check_opening(talk: Conversation) -> Check:
    """Check that the controller is not reset when the port is opened."""
    name = "runs on when the port is opened"
    before = talk.latest_us
    restarts = talk.decoder.received.restarts
    kept = talk.decoder.received.damaged, talk.decoder.received.lost
    if not talk.wire.reopen():
        return Check(name, None, "this line cannot be opened again", "")
    start = len(talk.samples)
    talk.run(LISTEN_S, until=lambda: len(talk.samples) > start + 100)
    again = talk.decoder.received
    alive = len(talk.samples) > start
    good = alive and again.restarts == restarts and talk.samples[start][0] > before
    again.damaged, again.lost = kept  # closing the port cuts frames
    ended = "restarted" if alive else "no samples"
    what = "sequence numbers and clock continue" if good else ended
    return Check(name, good, what, "disable the board's automatic reset by DTR")


def check_losses(talk: Conversation) -> Check:
    """Check that no frame was damaged or lost since the first ones."""
    now = talk.decoder.received
    first = talk.first
    assert first is not None
    damaged = now.damaged - first.damaged
    lost = now.lost - first.lost
    unknown = now.unknown - first.unknown
    what = f"{now.frames:,} frames: {damaged} damaged, {lost} lost, {unknown} unknown, {now.restarts} restarts"
    remedy = "check cable and baud rate; print nothing else on this port; did the controller reset?"
    return Check(
        "no frame is damaged or lost",
        damaged + lost + unknown + now.restarts == 0,
        what,
        remedy,
    )
