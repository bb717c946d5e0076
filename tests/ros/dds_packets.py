"""Messages of ROS 2 on the wire, with CycloneDDS: types with the names that ROS 2 gives them, and a subscriber.

``python -m tests.ros.dds_packets DOMAIN COUNT`` prints ``ready``, waits for messages, and prints what it read.
"""

import hashlib
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int32, sequence, uint8, uint32, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

TOPIC = "rt/event_camera/events"
"""Topic ``/event_camera/events`` of ROS 2: ``rt`` marks topics."""
QOS = Qos(Policy.Reliability.Reliable(duration(seconds=5)), Policy.History.KeepLast(1000))
LONG_S = 30.0
"""Limit of waits [s]."""


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """Message builtin_interfaces/Time."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """Message std_msgs/Header."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
class EventPacket(IdlStruct, typename="event_camera_msgs::msg::dds_::EventPacket_"):
    """Message event_camera_msgs/EventPacket."""

    header: Header = field(default_factory=Header)
    height: uint32 = 0
    width: uint32 = 0
    seq: uint64 = 0
    time_base: uint64 = 0
    encoding: str = ""
    is_bigendian: bool = False
    events: sequence[uint8] = field(default_factory=list)


def on_topic(domain: int) -> tuple[DomainParticipant, Topic]:
    """Return a participant and the topic."""
    participant = DomainParticipant(domain)
    return participant, Topic(participant, TOPIC, EventPacket)


def writer_on(domain: int) -> DataWriter:
    """Return a writer, as soon as one reader is there."""
    participant, topic = on_topic(domain)
    writer = DataWriter(participant, topic, qos=QOS)
    until = time.monotonic() + LONG_S
    while not writer.get_matched_subscriptions():
        assert time.monotonic() < until
        time.sleep(0.01)
    return writer


def main(domain: int, count: int) -> None:
    """Read a number of messages with the decoder of ``amiwarp_ros``."""
    sys.path.insert(0, str(Path(__file__).parents[2] / "ros" / "amiwarp_ros"))
    from amiwarp_ros.event_packets import PacketDecoder

    participant, topic = on_topic(domain)
    reader = DataReader(participant, topic, qos=QOS)
    decoder = PacketDecoder()
    digest = hashlib.sha256()
    events = 0
    received = 0
    print("ready", flush=True)
    until = time.monotonic() + LONG_S
    while received < count and time.monotonic() < until:
        for message in reader.take(100):
            found, _ = decoder.decode(message)
            for column in (found.x, found.y, found.t, found.p):
                digest.update(column.tobytes())
            events += len(found)
            received += 1
        time.sleep(0.001)
    print(events, decoder.missing, digest.hexdigest(), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
