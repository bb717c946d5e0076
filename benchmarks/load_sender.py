"""Sender of the synthetic stream of :mod:`benchmarks.load`, as a process of its own.

    python -m benchmarks.load_sender ADDRESS MEV_S SECONDS

Prints its address, waits for a line, sends the stream in real time, and prints what it sent as JSON. With ``cable``
for the address, it closes the connection in the middle without an end, and accepts it again five seconds later.
"""

from __future__ import annotations

import json
import socket
import sys
import threading
import time

from amiwarp.live.link import monotonic_us
from amiwarp.live.stream import encode_end, encode_events, encode_hello, open_sink
from benchmarks.load_stream import PACKET_US, PERIOD_PACKETS, Pattern, cpu_s, wait_until
from benchmarks.stages import SIZE

GAP_S = 5.0
"""Time without the sender in the case "cable" [s], a multiple of the pattern's period."""


def send(address: str, mev_s: float, seconds: float) -> dict[str, float]:
    """Send to a sink, and return counts."""
    pattern = Pattern(mev_s, filters=False, undistorts=False)
    go = threading.Event()
    sent = 0
    with open_sink(address, encode_hello(*SIZE)) as sink:
        print(sink.address, flush=True)
        threading.Thread(target=lambda: (sys.stdin.readline(), go.set()), daemon=True).start()
        while not go.wait(0.01):
            sink.tick()
        spent = cpu_s()
        start_us = monotonic_us()
        for k in range(round(1e6 * seconds / PACKET_US)):
            wait_until(start_us + (k + 1) * PACKET_US)
            events = pattern.packet(k, start_us)
            sink.send(encode_events(events))
            sent += len(events)
        spent = cpu_s() - spent
    return {"sent": sent, "lost_packets": sink.lost, "cpu_s": spent}


def send_with_gap(mev_s: float, seconds: float) -> dict[str, float]:
    """Send over a connection that is closed in the middle, and return counts."""
    pattern = Pattern(mev_s, filters=False, undistorts=False)
    count = round(1e6 * seconds / PACKET_US)
    middle = count // 2 // PERIOD_PACKETS * PERIOD_PACKETS
    gap = round(1e6 * GAP_S / PACKET_US)
    sent = 0
    start_us = 0
    with socket.create_server(("127.0.0.1", 0)) as server:
        print(f"tcp:127.0.0.1:{server.getsockname()[1]}", flush=True)
        for numbers, end in (
            (range(middle), b""),
            (range(middle + gap, count + gap), encode_end()),
        ):
            if start_us:
                wait_until(start_us + numbers[0] * PACKET_US)
            connection, _ = server.accept()
            with connection:
                connection.sendall(encode_hello(*SIZE))
                if not start_us:
                    sys.stdin.readline()
                    start_us = monotonic_us()
                for k in numbers:
                    wait_until(start_us + (k + 1) * PACKET_US)
                    events = pattern.packet(k, start_us)
                    connection.sendall(encode_events(events))
                    sent += len(events)
                connection.sendall(end)
    return {"sent": sent, "lost_packets": 0, "cpu_s": time.process_time()}


if __name__ == "__main__":
    where, rate, length = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
    told = send_with_gap(rate, length) if where == "cable" else send(where, rate, length)
    print(json.dumps(told), flush=True)
