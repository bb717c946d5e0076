"""Processor time of the sinks of a stream: for each event, in the program that sends.

    python -m benchmarks.sinks [--seconds 2] [--out FILE.json]

A stream of compensated events, in packets of 5,000 (half a millisecond of a fast sensor), goes to programs that only
receive it. ``send_ns`` is the processor time of the thread that calls ``send``, for each event and without encoding.
Half a millisecond lies between two packets, as between packets of a camera.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from amiwarp import Events
from amiwarp.live.stream import encode_compensated, encode_hello, open_sink
from amiwarp.studies.machine import machine

PACKET = 5_000
PAUSE_S = 0.0005
REPEATS = 5
RECEIVER = """
import sys
from amiwarp.live.stream.stream_source import RECEIVERS
from amiwarp.live.stream.sockets import connect
address = sys.argv[1]
kind = address.partition(":")[0]
print("ready", flush=True)
if kind in RECEIVERS:
    receiver = RECEIVERS[kind](address)
    while receiver.problem is None:
        packet = receiver.receive(1.0)
        if packet is not None and packet[5] == 6:
            break
    print(receiver.lost)
    receiver.close()
else:
    connection = connect(address)
    while connection.recv(1 << 16):
        pass
    print(0)
"""


def measured(address: str, receivers: int, seconds: float) -> dict[str, Any]:
    """Return the processor time of a sink with a number of receivers."""
    rng = np.random.default_rng(0)
    events = Events(
        rng.uniform(0, 640, PACKET).astype(np.float32),
        rng.uniform(0, 480, PACKET).astype(np.float32),
        np.arange(PACKET),
        rng.integers(0, 2, PACKET).astype(np.uint8),
    )
    data = encode_compensated(events, np.zeros(PACKET, np.uint8))
    sink = open_sink(address, encode_hello(640, 480))
    command = [sys.executable, "-c", RECEIVER, address]
    children = [
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(receivers)
    ]
    for child in children:
        assert child.stdout is not None
        child.stdout.readline()
    until = time.monotonic() + 1.5  # they connect
    while time.monotonic() < until:
        sink.tick()
        time.sleep(0.01)
    times = []
    for _ in range(REPEATS):
        packets = 0
        began = time.thread_time()
        until = time.monotonic() + seconds / REPEATS
        while time.monotonic() < until:
            sink.send(data)
            packets += 1
            time.sleep(PAUSE_S)
        times.append((time.thread_time() - began) / (packets * PACKET) * 1e9)
    sink.close()
    lost = [int(child.communicate()[0]) for child in children]
    return {
        "sink": address.partition(":")[0],
        "receivers": receivers,
        "send_ns": statistics.median(times),
        "least_ns": min(times),
        "most_ns": max(times),
        "lost_at_receivers": lost,
        "not_sent": sink.lost,
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    rows = []
    with TemporaryDirectory() as folder:
        addresses = {
            "shm": f"shm:amiwarp-bench-{os.getpid()}",
            "unix": f"unix:{folder}/socket",
            "tcp": "tcp:127.0.0.1:45871",
            "udp": "udp:127.0.0.1:45872",
        }
        for receivers in (0, 1, 4):
            for kind, address in addresses.items():
                if kind == "udp" and receivers > 1:
                    continue  # one address, one receiver
                rows.append(measured(address, receivers, args.seconds))
                print(json.dumps(rows[-1]), flush=True)
    if args.out:
        args.out.write_text(json.dumps({"machine": machine("cpu"), "rows": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
