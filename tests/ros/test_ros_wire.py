"""Messages of ROS 2 between two processes, over CycloneDDS with ROS's names of topics and types."""

import hashlib
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from amiwarp import Events
from tests import ROOT

pytest.importorskip("rosbags")
pytest.importorskip("cyclonedds", reason="needs the wheel of CycloneDDS: pip install cyclonedds")
MESSAGES = 12
EVENTS = 500


def words_of(events: Events) -> list[int]:
    """Return the bytes of events in the encoding mono, after a time base of 0."""
    word = events.t.astype(np.uint64) * np.uint64(1000) | events.x.astype(np.uint64) << np.uint64(
        32
    )
    word |= events.y.astype(np.uint64) << np.uint64(48) | events.p.astype(np.uint64) << np.uint64(
        63
    )
    return word.astype("<u8").view(np.uint8).tolist()


def message(k: int, events: Events) -> Any:
    from tests.ros.dds_packets import EventPacket, Header, Time

    header = Header(Time(1_700_000_000, k), "camera")
    return EventPacket(header, 48, 64, 2 * k, 0, "mono", False, words_of(events))


def make(k: int) -> Events:
    t = np.arange(EVENTS) + 1000 * k
    return Events.from_arrays(t % 64, t % 48, t, t % 2)


def test_the_bytes_on_the_wire_are_those_of_a_bag() -> None:
    from tests.ros.rclpy_stub import STORE

    name = "event_camera_msgs/msg/EventPacket"
    data = message(3, make(3)).serialize()
    again = STORE.deserialize_cdr(data, name)
    assert (again.seq, again.encoding, again.header.stamp.nanosec) == (6, "mono", 3)
    assert bytes(STORE.serialize_cdr(again, name)) == bytes(data)


def test_a_subscriber_in_another_process_reads_all_events() -> None:
    from tests.ros.dds_packets import writer_on

    domain = 100 + os.getpid() % 100
    command = [sys.executable, "-m", "tests.ros.dds_packets", str(domain), str(MESSAGES)]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    reader = subprocess.Popen(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, text=True
    )
    assert reader.stdout is not None
    assert reader.stdout.readline() == "ready\n"
    writer = writer_on(domain)
    digest = hashlib.sha256()
    for k in range(MESSAGES):
        events = make(k)
        writer.write(message(k, events))
        for column in (events.x, events.y, events.t, events.p):
            digest.update(column.tobytes())
    text, _ = reader.communicate(timeout=60.0)
    assert text == f"{MESSAGES * EVENTS} {MESSAGES - 1} {digest.hexdigest()}\n"
