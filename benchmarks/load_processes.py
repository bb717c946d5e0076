"""Cases of :mod:`benchmarks.load` with other processes: senders, readers, and a pulled cable."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from amiwarp import Compensated
from amiwarp.live import LivePackets
from amiwarp.live.stream import Session, SocketSink, encode_compensated, encode_hello, open_source
from benchmarks.load_sender import GAP_S
from benchmarks.load_stream import PACKET_US, PERIOD_US, Check, PacedSource, Pattern
from benchmarks.stages import SIZE

ROOT = Path(__file__).resolve().parent.parent
SLOW_S = 0.02
"""Pause of the slow reader after each packet, which has the events of a millisecond or more [s]."""


def program(module: str, *arguments: object) -> subprocess.Popen[str]:
    """Start a program of this folder, whose input and output are pipes."""
    command = [sys.executable, "-m", f"benchmarks.{module}", *map(str, arguments)]
    return subprocess.Popen(
        command, cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )


def line_of(child: subprocess.Popen[str]) -> str:
    """Return the next line that a program prints."""
    assert child.stdout is not None
    return child.stdout.readline().strip()


class Sender:
    """Process that sends, and the source of what it sends. It starts once the source is read."""

    def __init__(self, child: subprocess.Popen[str], wait_s: float) -> None:
        self._child = child
        self.source: Any = open_source(line_of(child), wait_s=wait_s)
        threading.Timer(0.5, self._go).start()

    def _go(self) -> None:
        assert self._child.stdin is not None
        self._child.stdin.write("go\n")
        self._child.stdin.flush()

    def told(self) -> dict[str, Any]:
        """Return what the sender printed at its end."""
        return dict(json.loads(line_of(self._child)))


@contextlib.contextmanager
def sent_by_process(
    kind: str, mev_s: float, seconds: float, wait_s: float = 0.0
) -> Iterator[Sender]:
    """Start a sender, and end it."""
    addresses = {"shm": f"shm:amiwarp-load-{os.getpid()}", "tcp": "tcp:127.0.0.1:0"}
    child = program("load_sender", addresses.get(kind, kind), mev_s, seconds)
    try:
        yield Sender(child, wait_s)
    finally:
        child.kill()
        child.communicate()


def cable(mev_s: float, seconds: float, pattern: Pattern) -> dict[str, Any]:
    """Return the figures of a stream whose sender is gone for five seconds."""
    check = Check(pattern)
    messages: list[str] = []
    with sent_by_process("cable", mev_s, seconds, 4 * GAP_S) as sender:
        packets = LivePackets(sender.source)
        session = Session(
            sender.source,
            chosen=pattern.filter,
            undistort=pattern.lens,
            sinks=(packets.put,),
            say=messages.append,
        )
        packets.start(session)
        with packets:
            for packet in packets:
                check.take(packet)
        told = sender.told()
    read, *stages = session.status.stages
    removed = {name: count for stage in stages for name, count in stage.removed.items()}
    is_whole = told["sent"] == read.received == check.events + sum(removed.values())
    gap = round(1e6 * GAP_S) // PERIOD_US
    return {
        "mev_s": mev_s,
        "sent": told["sent"],
        "kept": check.events,
        "removed": removed,
        "lost": read.removed["queue"],
        "returns": sender.source.returns,
        "equal": check.wrong == 0,
        "right": is_whole
        and check.wrong == 0
        and sender.source.returns == 1
        and check.skipped == gap,
    }


def served(
    mev_s: float,
    seconds: float,
    pattern: Pattern,
    pauses_s: list[float],
    *,
    kill: bool = False,
) -> dict[str, Any]:
    """Serve a stream over TCP to readers with pauses, and return what came. ``kill``: the last one in the middle."""
    sink = SocketSink("tcp:127.0.0.1:0", encode_hello(*SIZE))
    children = [program("load_reader", sink.address, mev_s, pause_s) for pause_s in pauses_s]
    for child in children:
        line_of(child)
        for _ in range(20):
            sink.tick()
            time.sleep(0.01)
    sent = [0, 0]

    def send(packet: Compensated) -> None:
        sink.send(encode_compensated(packet.events, packet.flags))
        sent[0] += 1
        sent[1] += len(packet.events)

    source = PacedSource(pattern, round(1e6 * seconds / PACKET_US))
    session = Session(
        source, chosen=pattern.filter, undistort=pattern.lens, sinks=(send,), say=lambda _: None
    )
    if kill:
        threading.Timer(seconds / 2, children[-1].kill).start()
    status = session.run(threading.Event(), lambda _: sink.tick())
    read, *stages = status.stages
    removed = {name: count for stage in stages for name, count in stage.removed.items()}
    is_whole = source.sent == read.received == sent[1] + sum(removed.values())
    sink.close()
    out = [child.communicate()[0] for child in children]
    told = [json.loads(text) for text in out if text]
    return {
        "mev_s": mev_s,
        "sent": source.sent,
        "kept": sent[1],
        "removed": removed,
        "lost": read.removed["queue"],
        "packets_sent": sent[0],
        "packets_lost": sink.lost,
        "readers": told,
        "whole": is_whole,
    }


def slow_reader(
    mev_s: float, seconds: float, pattern: Pattern, *, must_lose: bool = True
) -> dict[str, Any]:
    """Return the figures of a stream with a quick and a slow reader; ``must_lose``: only then right."""
    row = served(mev_s, seconds, pattern, [0.0, SLOW_S])
    quick, slow = row["readers"]
    lost = row["packets_lost"]
    is_counted = slow["packets"] + lost == quick["packets"] == row["packets_sent"]
    is_equal = quick["wrong"] == 0 and quick["events"] == row["kept"]
    is_slow = lost > 0 or not must_lose
    return {**row, "equal": is_equal, "right": row["whole"] and is_counted and is_equal and is_slow}


def killed_reader(mev_s: float, seconds: float, pattern: Pattern) -> dict[str, Any]:
    """Return the figures of a stream of whose two readers one is killed."""
    row = served(mev_s, seconds, pattern, [0.0, 0.0], kill=True)
    (left,) = row["readers"]
    is_equal = left["wrong"] == 0 and left["events"] == row["kept"] and left["has_ended"]
    return {
        **row,
        "equal": is_equal,
        "right": row["whole"] and is_equal and not row["packets_lost"],
    }
