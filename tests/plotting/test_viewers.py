"""Files and live streams for the viewers Rerun and Foxglove, read back by their own libraries."""

from __future__ import annotations

import asyncio
import io
import json
import math
import os
import struct
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from amiwarp import (
    AmiwarpError,
    Camera,
    Compensated,
    Encoder,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    compensate_events,
    save_recording,
)
from amiwarp.plotting import frames, live_viewers
from amiwarp.plotting.frames import COMPENSATED, RECORDED, Painter, Window
from amiwarp.plotting.live_viewers import LiveViewer
from amiwarp.plotting.viewer_files import save_for_viewer
from reference.calibration_sample import exact_calibration
from reference.evt_words import Evt3Decoder
from tests.cli.test_cli import run

CAMERA, PRISM = Camera.from_fov(64, 48, math.radians(60)), Prism(math.radians(2.0))
KNOWN = exact_calibration(CAMERA, PRISM, {"apex": PRISM.apex, "phase": 0.4})
FIRST, FRAME = 1_000_007, 10_000
BLUE, ORANGE = np.array([0.20, 0.55, 1.00]), np.array([1.00, 0.55, 0.10])


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Events in the frames 0, 1 and 4 of 10 ms each, with an encoder that begins before them."""
    rng = np.random.default_rng(1)
    t = FIRST + np.sort(
        np.concatenate([[0], rng.integers(0, 20_000, 4000), rng.integers(40_000, 50_000, 2000)])
    )
    n = len(t)
    events = Events.from_arrays(
        rng.integers(0, 64, n), rng.integers(0, 48, n), t, rng.integers(0, 2, n)
    )
    encoder = Encoder.constant_speed(720.0, FIRST - 5000, FIRST + 55_000)
    return Recording(MemoryEvents(events, 64, 48), CAMERA, encoder, PRISM, name="short")


def events_of(recording: Recording) -> Events:
    return Events.concatenate(list(recording.events.blocks()))


def picture(x: Any, y: Any, p: Any) -> np.ndarray:
    """Return the image of whole-pixel events, computed with NumPy."""
    counts = np.zeros((2, 48, 64))
    np.add.at(counts, (np.asarray(p, int), np.asarray(y, int), np.asarray(x, int)), 1.0)
    bright = np.sqrt(np.clip(counts / np.percentile(counts[counts > 0], 99.5), 0.0, 1.0))
    return 255.0 * np.clip(bright[0][..., None] * BLUE + bright[1][..., None] * ORANGE, 0.0, 1.0)


def decoded(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)), float)


def mcap_messages(path: Path) -> dict[str, list[tuple[int, Any, bytes]]]:
    """Return the time [ns], the schema and the data of all messages of an MCAP file, by topic."""
    reader = pytest.importorskip("mcap.reader")
    found: dict[str, list[tuple[int, Any, bytes]]] = {}
    with open(path, "rb") as file:
        for schema, channel, message in reader.make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, schema, message.data))
    return found


def protobuf(schema: Any, data: bytes) -> Any:
    """Decode a message by the definition that the file holds."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    pool = descriptor_pool.DescriptorPool()
    for one in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(one)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name)).FromString(data)


def rerun_columns(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of all chunks of a file for Rerun, by entity."""
    chunk = pytest.importorskip("rerun.chunk")
    found: dict[str, list[dict[str, Any]]] = {}
    for one in chunk.RrdReader(path).stream():
        batch = one.to_record_batch()
        if "sensor_time" in batch.schema.names:
            t = batch["sensor_time"].cast("int64").to_pylist()
            for k, row in enumerate(batch.to_pylist()):
                found.setdefault(one.entity_path, []).append({**row, "t": t[k] // 1000})
    return found


STARTS = [FIRST, FIRST + FRAME, FIRST + 2 * FRAME, FIRST + 4 * FRAME]
"""Starts of the frames: the third is empty, and shows that the next window holds no events."""


def test_foxglove_reads_images_angles_and_events(recording, tmp_path, device):
    pytest.importorskip("foxglove")
    path = tmp_path / "out.mcap"
    summary = save_for_viewer(recording, path, calibration=KNOWN, frame_us=FRAME, device=device)
    assert (summary.events, summary.frames, summary.streams) == (6001, 4, (RECORDED, COMPENSATED))
    messages, events = mcap_messages(path), events_of(recording)
    assert set(messages) == {
        "/recorded/image",
        "/compensated/image",
        "/prism/angle",
        "/event_camera/events",
    }
    for name in ("recorded", "compensated"):
        assert [t for t, _, _ in messages[f"/{name}/image"]] == [1000 * t for t in STARTS]
    for start, (t, schema, data) in zip(STARTS, messages["/recorded/image"], strict=True):
        image = protobuf(schema, data)
        assert (schema.name, image.format) == ("foxglove.CompressedImage", "png")
        assert image.timestamp.seconds * 10**9 + image.timestamp.nanos == t
        inside = (start <= events.t) & (events.t < start + FRAME)
        found = decoded(image.data)
        expected = (
            picture(*(v[inside] for v in (events.x, events.y, events.p)))
            if inside.any()
            else np.zeros_like(found)
        )
        np.testing.assert_allclose(found, expected, rtol=0, atol=1.0)  # levels
    angles = messages["/prism/angle"]
    t = np.array([one[0] for one in angles]) // 1000
    assert summary.angles == len(t) == 30
    degrees = np.array([json.loads(one[2])["degrees"] for one in angles])
    np.testing.assert_allclose(
        degrees, np.degrees(recording.encoder.angle_at(t)) % 360.0, rtol=0, atol=1e-9
    )

    rosbags = pytest.importorskip("rosbags.typesys")
    _, schema, _ = messages["/event_camera/events"][0]
    assert (schema.name, schema.encoding) == ("event_camera_msgs/msg/EventPacket", "ros2msg")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    types = rosbags.get_types_from_msg(schema.data.decode(), schema.name)
    store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
    decoder, parts = Evt3Decoder(), []
    for time, _, data in messages["/event_camera/events"]:
        message = store.deserialize_cdr(data, schema.name)
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == time
        assert (message.width, message.height, message.encoding) == (64, 48, "evt3")
        parts.append(decoder.decode(message.events.view("<u2"))[0])
    for column, values in zip(
        (events.x, events.y, events.t, events.p), zip(*parts, strict=True), strict=True
    ):
        np.testing.assert_array_equal(np.concatenate(values), column)


def test_rerun_reads_images_points_and_angles(recording, tmp_path):
    pytest.importorskip("rerun.chunk")
    path = tmp_path / "out.rrd"
    summary = save_for_viewer(recording, path, calibration=KNOWN, frame_us=FRAME)
    rows, events = rerun_columns(path), events_of(recording)
    moved = compensate_events(events, KNOWN.model, recording.encoder)
    for name, x, y in ((RECORDED, events.x, events.y), (COMPENSATED, moved[:, 0], moved[:, 1])):
        images = {row["t"]: bytes(row["EncodedImage:blob"][0]) for row in rows[f"/{name}/image"]}
        clouds = {row["t"]: row for row in rows[f"/{name}/points"]}
        assert sorted(images) == sorted(clouds) == STARTS
        assert {row["EncodedImage:media_type"][0] for row in rows[f"/{name}/image"]} == {
            "image/png"
        }
        for start in STARTS:
            inside = (start <= events.t) & (events.t < start + FRAME)
            passed = 100.0 * (events.t[inside] - start) / FRAME
            places = np.reshape(np.array(clouds[start]["Points3D:positions"] or [], float), (-1, 3))
            np.testing.assert_allclose(
                places, np.stack([x[inside], y[inside], passed], axis=1), rtol=0, atol=1e-3
            )
            # Red of RGBA
            on = np.array(clouds[start]["Points3D:colors"] or [], np.uint32) >> 24 == 255
            np.testing.assert_array_equal(on, events.p[inside] == 1)
            if name == RECORDED and inside.any():
                expected = picture(*(v[inside] for v in (events.x, events.y, events.p)))
                # Levels
                np.testing.assert_allclose(decoded(images[start]), expected, rtol=0, atol=1.0)
    t = np.array([row["t"] for row in rows["/prism/angle"]])
    degrees = np.array([row["Scalars:scalars"][0] for row in rows["/prism/angle"]])
    assert summary.angles == len(t) == 30
    np.testing.assert_allclose(
        degrees, np.degrees(recording.encoder.angle_at(t)) % 360.0, rtol=0, atol=1e-9
    )


def test_clouds_are_thinned_evenly(monkeypatch):
    monkeypatch.setattr(frames, "MOST_POINTS", 100)
    events = Events.from_arrays(
        np.arange(450) % 64, np.zeros(450, int), np.arange(450), np.zeros(450, int)
    )
    places, colours = frames.points(Window(0, 450, {}), events)
    np.testing.assert_array_equal(places[:, 0], np.arange(0, 450, 5) % 64)
    assert colours.shape == (90, 3)


@pytest.mark.parametrize("ending", [".rrd", ".mcap"])
def test_a_failure_leaves_no_file(recording, tmp_path, monkeypatch, ending):
    pytest.importorskip({".rrd": "rerun.chunk", ".mcap": "foxglove"}[ending])

    def fails(self: Any, events: Events) -> Any:
        raise OSError("no space")

    monkeypatch.setattr(Painter, "__call__", fails)
    with pytest.raises(AmiwarpError, match=rf"out\{ending}: .*no space"):
        save_for_viewer(recording, tmp_path / f"out{ending}")
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(("ending", "module"), [(".rrd", "rerun"), (".mcap", "foxglove")])
def test_a_missing_library_is_named(recording, tmp_path, monkeypatch, ending, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(AmiwarpError, match=rf"out\{ending}: .*pip install 'amiwarp\[{module}\]'"):
        save_for_viewer(recording, tmp_path / f"out{ending}")
    assert os.listdir(tmp_path) == []


def test_recordings_without_events_are_refused(tmp_path):
    empty = Recording(MemoryEvents(Events.empty(), 64, 48), name="empty")
    with pytest.raises(AmiwarpError, match="empty: holds no events to show"):
        save_for_viewer(empty, tmp_path / "out.rrd")


def test_the_command_writes_files_for_viewers(recording, tmp_path):
    pytest.importorskip("foxglove")
    save_recording(tmp_path / "in.h5", recording)
    KNOWN.save(tmp_path / "known.json")
    out = tmp_path / "out.mcap"
    given = ["convert", str(tmp_path / "in.h5"), str(out), "--foxglove"]
    result = run(
        *given, "--calibration", str(tmp_path / "known.json"), "--frame-ms", "10", "--json"
    )
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["frames"] == len(mcap_messages(out)["/compensated/image"]) == 4
    assert run(*given).exit_code == 1  # exists
    for options, said in (
        (["a.h5", "--foxglove"], "files for Foxglove end in .mcap"),
        (["a.mcap", "--frame-ms", "5"], "--calibration and --frame-ms are for viewers"),
        (["a.rrd", "--round", "nearest"], "is a file for a viewer; leave out --format"),
    ):
        refused = run("convert", str(tmp_path / "in.h5"), str(tmp_path / options[0]), *options[1:])
        assert refused.exit_code == 1
        assert said in refused.output
        assert not (tmp_path / options[0]).exists()


def live(recording: Recording, viewer: LiveViewer) -> None:
    """Pass a recording to a viewer in small packets, as a session does."""
    viewer.append_encoder(recording.encoder.t, recording.encoder.angle, second=False)
    for events in recording.events.blocks(count=500):
        viewer.append(events)
        viewer.tick()
        xy = compensate_events(events, KNOWN.model, recording.encoder)
        viewer(
            Compensated(
                Events(xy[:, 0], xy[:, 1], events.t, events.p), np.zeros(len(events), np.uint8)
            )
        )


def test_live_frames_hold_every_event(recording):
    sent: list[Window] = []
    with LiveViewer(sent.append, lambda: None, (64, 48), frame_us=FRAME) as viewer:
        live(recording, viewer)
    # The first frame of 10 ms begins before the first event
    assert viewer.lost + len(sent) == 2 * 4
    events = events_of(recording)
    for window in sent:
        for frame in window.frames.values():
            inside = (window.t <= events.t) & (events.t < window.t + FRAME)
            np.testing.assert_array_equal(frame.events.t, events.t[inside])


def test_a_slow_viewer_loses_frames_and_never_blocks(recording, monkeypatch):
    monkeypatch.setattr(live_viewers, "MOST_WAITING", 2)
    go, sent = threading.Event(), []

    def send(window: Window) -> None:
        go.wait()
        sent.append(window)

    viewer = LiveViewer(send, lambda: None, (64, 48), frame_us=1000)
    live(recording, viewer)  # returns although nothing can be sent
    lost = viewer.lost
    assert lost >= 50
    go.set()
    viewer.close()
    assert len(sent) <= 5


def test_rerun_gets_a_live_stream(recording, tmp_path, monkeypatch):
    rerun = pytest.importorskip("rerun")
    path = tmp_path / "live.rrd"
    monkeypatch.setattr(rerun.RecordingStream, "connect_grpc", lambda self, url: self.save(path))
    with live_viewers.rerun_viewer("127.0.0.1:9876", (64, 48), "camera") as viewer:
        live(recording, viewer)
    rows = rerun_columns(path)
    assert sum(len(rows[f"/{name}/image"]) for name in (RECORDED, COMPENSATED)) == 4 - viewer.lost
    with pytest.raises(AmiwarpError, match="--rerun 'nowhere' is not an address"):
        live_viewers.rerun_viewer("nowhere", (64, 48), "camera")


def test_a_missing_library_leaves_no_file_of_a_stream(recording, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "foxglove", None)
    save_recording(tmp_path / "in.h5", recording)
    KNOWN.save(tmp_path / "known.json")
    result = run(
        "live", tmp_path / "in.h5", "--calibration", tmp_path / "known.json", "--out", tmp_path / "out.h5",
        "--foxglove", "127.0.0.1:0",
    )  # fmt: skip
    assert result.exit_code == 1
    assert "pip install 'amiwarp[foxglove]'" in result.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.h5", "known.json"]


def test_foxglove_gets_a_live_stream(recording):
    """A client by Foxglove's WebSocket protocol subscribes to all topics, and gets images and angles."""
    pytest.importorskip("foxglove")
    aiohttp = pytest.importorskip("aiohttp")
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    counts: dict[str, int] = {}

    async def follow(viewer: LiveViewer) -> None:
        async with aiohttp.ClientSession() as session:
            client = await session.ws_connect(
                f"ws://127.0.0.1:{port}", protocols=["foxglove.sdk.v1"]
            )
            topics: dict[int, str] = {}
            while len(topics) < 4:
                message = (
                    json.loads((await client.receive(30.0)).data)
                    if topics
                    else await first_advertise(client)
                )
                if message["op"] == "advertise":
                    new = {one["id"]: one["topic"] for one in message["channels"]}
                    await client.send_json(
                        {
                            "op": "subscribe",
                            "subscriptions": [{"id": k, "channelId": k} for k in new],
                        }
                    )
                    topics |= new
            await asyncio.sleep(0.5)  # until the server has taken the subscription
            await asyncio.to_thread(live, recording, viewer)
            while (
                min(
                    counts.get(name, 0)
                    for name in ("/recorded/image", "/compensated/image", "/prism/angle")
                )
                < 1
            ):
                message = await client.receive(30.0)
                if message.type == aiohttp.WSMsgType.BINARY and message.data[0] == 1:
                    at, t = struct.unpack_from("<IQ", message.data, 1)
                    counts[topics[at]] = counts.get(topics[at], 0) + 1
                    assert 0 <= t - 1000 * FIRST + 10**8 < 2 * 10**8
            await client.close()

    async def first_advertise(client: Any) -> Any:
        while True:
            message = await client.receive(30.0)
            if (
                message.type == aiohttp.WSMsgType.TEXT
                and json.loads(message.data)["op"] == "advertise"
            ):
                return json.loads(message.data)

    with live_viewers.foxglove_server(f"127.0.0.1:{port}", (64, 48)) as viewer:
        asyncio.run(follow(viewer))
        with pytest.raises(AmiwarpError, match="cannot listen there"):
            live_viewers.foxglove_server(f"127.0.0.1:{port}", (64, 48))
    assert set(counts) >= {"/recorded/image", "/compensated/image", "/prism/angle"}
