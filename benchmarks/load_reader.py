"""Reader of the filtered and undistorted stream of :mod:`benchmarks.load`, as a process of its own.

    python -m benchmarks.load_reader ADDRESS MEV_S PAUSE_S

It pauses after each packet, prints "ready" once it is connected, and at the end what it got, as JSON.
"""

from __future__ import annotations

import json
import sys
import time

from amiwarp import Compensated
from amiwarp.live.stream import End, PacketDecoder
from amiwarp.live.stream.sockets import connect
from benchmarks.load_stream import Check, Pattern, quantiles_ms


def read(address: str, mev_s: float, pause_s: float) -> dict[str, object]:
    """Read the stream to its end, and return counts."""
    check = Check(Pattern(mev_s))
    decoder = PacketDecoder(address)
    packets = 0
    events = 0
    has_ended = False
    with connect(address) as connection:
        print("ready", flush=True)
        while data := connection.recv(1 << 20):
            for message in decoder.feed(data):
                has_ended = isinstance(message, End)
                if isinstance(message, Compensated):
                    packets += 1
                    events += len(message.events)
                    if not pause_s:
                        check.take(message)
                    time.sleep(pause_s)
    return {
        "packets": packets,
        "events": events,
        "wrong": check.wrong,
        "has_ended": has_ended,
        **quantiles_ms(check.latencies_us),
    }


if __name__ == "__main__":
    print(json.dumps(read(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]))), flush=True)
