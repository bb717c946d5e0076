"""Count the events in a ring of amiwarp, without amiwarp: ``python reader.py NAME``.

The layout is in docs/reference/stream-format.md, "Shared memory".
"""

import struct
import sys
import time
import zlib
from multiprocessing import resource_tracker
from multiprocessing.shared_memory import SharedMemory


def main(name: str) -> str:
    """Read the ring to the end of its stream; return the counts."""
    if sys.version_info >= (3, 13):
        memory = SharedMemory(name, track=False)
    else:  # without this, Python would remove the ring when this program ends
        memory = SharedMemory(name)
        resource_tracker.unregister(f"/{name}", "shared_memory")
    with memory.buf.toreadonly() as ring:
        magic, version, slots, slot_bytes, _, place = struct.unpack_from("<4sIIIII", ring)
        if (magic, version) != (b"AMIR", 1):
            return "this is no ring of version 1"
        with ring[: place + slots * slot_bytes] as part, part.cast("Q") as words:
            return count(ring, words, slots, slot_bytes, place)


def count(ring: memoryview, words: memoryview, slots: int, slot_bytes: int, place: int) -> str:
    """Count events and lost packets."""
    number, beat, beat_s, events, lost = words[4], words[5], time.monotonic(), 0, 0
    print("reading", flush=True)
    while time.monotonic() < beat_s + 3.0:  # 3 s without a beat: the writer died
        ahead = words[4] - number
        if words[5] != beat:
            beat, beat_s = words[5], time.monotonic()
        if ahead == 0:
            time.sleep(0.0005)
            continue
        if ahead >= slots:  # overtaken: go on in the middle of the ring
            lost += ahead - slots // 2
            number += ahead - slots // 2
        start = place + number % slots * slot_bytes
        found, length, check = struct.unpack_from("<QII", ring, start)
        packet = bytes(ring[start + 16 : start + min(16 + length, slot_bytes)])
        if found != number + 1 or words[start // 8] != found or len(packet) < 20:
            continue
        _, _, kind, _, rows, _, checksum = struct.unpack_from("<4sBBHIII", packet)
        if checksum != check ^ (found & 0xFFFFFFFF) or checksum != zlib.crc32(packet[20:]):
            continue
        number += 1
        events += rows if kind in (2, 3) else 0  # events, or compensated events
        if kind == 6:
            return f"{events} events, {lost} packets lost"
    return "the writer died"


print(main(sys.argv[1]))
