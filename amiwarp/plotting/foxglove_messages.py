"""Frames for the viewer Foxglove: messages of topics, which an MCAP file holds and a server sends."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from amiwarp.errors import optional_module
from amiwarp.io.output_formats import Outline
from amiwarp.io.ros.ros2_writer import MESSAGE, TOPIC, PacketEncoder
from amiwarp.plotting.frames import ANGLES, COMPENSATED, RECORDED, Window, degrees_in_turn

ANGLE_SCHEMA = {
    "title": "amiwarp.PrismAngle",
    "type": "object",
    "properties": {"degrees": {"type": "number"}},
}
"""JSON schema of the messages with a prism angle. Foxglove has no message for a number."""


def foxglove_module() -> Any:
    """Import Foxglove's library. Raises :class:`AmiwarpError` if it is missing."""
    for name in ("foxglove.messages", "foxglove"):
        module = optional_module(name, "foxglove", "Foxglove needs its library")
    return module


def foxglove_topics() -> dict[str, tuple[str, Any]]:
    """Return the encoding of the messages and the schema of each topic of Foxglove."""
    foxglove = foxglove_module()
    image = foxglove.messages.CompressedImage.get_schema()
    text = json.dumps(ANGLE_SCHEMA).encode()
    angle = foxglove.Schema(name=ANGLE_SCHEMA["title"], encoding="jsonschema", data=text)
    topics = {}
    for name in (RECORDED, COMPENSATED):
        topics[f"/{name}/image"] = ("protobuf", image)
    for name in ANGLES:
        topics[f"/prism/{name}"] = ("json", angle)
    return topics


def foxglove_messages(window: Window) -> Iterator[tuple[str, int, bytes]]:
    """Yield the messages of a window for Foxglove: topic, time [ns] and data."""
    messages = foxglove_module().messages
    seconds, microseconds = divmod(window.t, 10**6)
    for name, frame in window.frames.items():
        stamp = messages.Timestamp(sec=seconds, nsec=1000 * microseconds)
        image = messages.CompressedImage(
            timestamp=stamp, frame_id="event_camera", data=frame.png, format="png"
        )
        yield f"/{name}/image", 1000 * window.t, image.encode()
    for name, (times, angle) in window.angles.items():
        in_degrees = degrees_in_turn(angle).tolist()
        for t, degrees in zip(times.tolist(), in_degrees, strict=True):
            data = json.dumps({"degrees": degrees}).encode()
            yield f"/prism/{name}", 1000 * t, data


def write_foxglove(part: Path, content: Iterable[Window], about: Outline) -> None:
    """Write windows to an MCAP file for Foxglove, with the recorded events as packets of ROS 2 if they are whole."""
    foxglove_module()
    mcap = optional_module("mcap.writer", "foxglove", "Foxglove needs mcap")
    encoder = PacketEncoder(about)
    definition = encoder.store.generate_msgdef(MESSAGE, ros_version=2)[0].encode()
    with open(part, "wb") as file:
        writer = mcap.Writer(file)
        writer.start(library="amiwarp")
        channels: dict[str, int] = {}
        known = {}
        for topic, (kind, schema) in foxglove_topics().items():
            known[topic] = (kind, schema.name, schema.encoding, schema.data)
        known[TOPIC] = ("cdr", MESSAGE, "ros2msg", definition)
        schemas: dict[str, int] = {}
        for window in content:
            messages = list(foxglove_messages(window))
            events = window.frames[RECORDED].events
            if events.whole_pixels:
                messages += [(TOPIC, t, bytes(data)) for t, data in encoder(events)]
            messages.sort(key=lambda message: message[1])  # by time
            for topic, t, data in messages:
                if topic not in channels:
                    kind, name, encoding, text = known[topic]
                    if name not in schemas:
                        schemas[name] = writer.register_schema(name, encoding, text)
                    channels[topic] = writer.register_channel(topic, kind, schemas[name])
                writer.add_message(channels[topic], log_time=t, publish_time=t, data=data)
        writer.finish()
