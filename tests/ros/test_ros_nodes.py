"""Nodes of ROS 2, against a stand-in for rclpy and the message definitions of rosbags. No ROS is run."""

from __future__ import annotations

import array
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from amiwarp import (
    AmiwarpError,
    Calibration,
    Camera,
    Encoder,
    EventFilter,
    Events,
    MemoryEvents,
    Prism,
    Recording,
    compensate_events,
    convert,
    save_recording,
)
from tests import ROOT

pytest.importorskip("rosbags")
PACKAGE = ROOT / "ros" / "amiwarp_ros"
SIZE = (64, 48)
CAMERA = Camera.from_fov(*SIZE, 1.0)
RAD_PER_US = 720.0 * 2.0 * np.pi / 60e6
STAMP_US = 1_700_000_000_000_000
"""Time of ROS at which the sensor's clock began [us]."""
LONG_S = 60.0
"""Limit of waits [s]."""


@pytest.fixture(scope="module")
def ros() -> Iterator[Any]:
    """Stand-in for ROS, and the nodes that are imported with it."""
    from tests.ros import rclpy_stub

    before = dict(sys.modules)
    rclpy_stub.install()
    sys.path.insert(0, str(PACKAGE))
    import amiwarp_ros.compensate_node as compensate_node
    import amiwarp_ros.event_packets as event_packets
    import amiwarp_ros.event_publisher as event_publisher
    import amiwarp_ros.filter_node as filter_node
    import amiwarp_ros.message_source as message_source
    import amiwarp_ros.pictures_node as pictures_node

    yield SimpleNamespace(
        stub=rclpy_stub,
        packets=event_packets,
        source=message_source,
        whole_pixels=event_publisher.whole_pixels,
        Compensate=compensate_node.CompensateNode,
        Filter=filter_node.FilterNode,
        Pictures=pictures_node.PicturesNode,
        compensate_main=compensate_node.main,
    )
    sys.path.remove(str(PACKAGE))
    for name in set(sys.modules) - set(before):
        if name.partition(".")[0] in ("amiwarp_ros", "rclpy") or name.endswith("_msgs.msg"):
            del sys.modules[name]


@pytest.fixture
def overrides(ros: Any) -> Iterator[dict[str, Any]]:
    """Values of parameters. At the end all nodes are closed, because the thread of an open one keeps the program."""
    yield ros.stub.OVERRIDES
    ros.stub.OVERRIDES.clear()
    for node in ros.stub.NODES:
        node.close()
    ros.stub.NODES.clear()


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    path = tmp_path / "calibration.json"
    Calibration(
        model_name="exact",
        camera=CAMERA,
        prism=Prism(0.035),
        parameters={"apex": 0.026, "phase": 0.4},
        uncertainty={},
        free=("apex", "phase"),
        sharpness_name="variance",
        sharpness_before=1.0,
        sharpness_after=2.0,
        stages=(),
        events=300_000,
        seconds=1.5,
    ).save(path)
    return path


def make(count: int, start: int = 1000, step: int = 10) -> Events:
    rng = np.random.default_rng(start)
    t = start + step * np.arange(count)
    return Events.from_arrays(
        rng.integers(0, 64, count), rng.integers(0, 48, count), t, rng.integers(0, 2, count)
    )


def stamped(message: Any, t_us: int) -> Any:
    message.header.stamp.sec, rest = divmod(STAMP_US + t_us, 1_000_000)
    message.header.stamp.nanosec = 1000 * rest
    return message


def packet(ros: Any, events: Events, seq: int, delay_us: int = 0) -> Any:
    """Return a message in the encoding mono."""
    ((base_ns, data),) = ros.packets.mono_packets(events)
    message = ros.stub.CLASSES["event_camera_msgs/msg/EventPacket"](
        width=64, height=48, seq=seq, encoding="mono", time_base=base_ns
    )
    message.events = array.array("B", data.tobytes())
    message.header.frame_id = "camera"
    return stamped(message, int(events.t[0]) + delay_us)


def joint(ros: Any, t_us: int, *, wrapped: bool = True) -> Any:
    angle = RAD_PER_US * t_us
    if wrapped:
        angle = (angle + np.pi) % (2.0 * np.pi) - np.pi
    message = ros.stub.CLASSES["sensor_msgs/msg/JointState"](
        name=["wheel", "prism"], position=[-1.0, float(angle)]
    )
    return stamped(message, t_us)


def decoded(ros: Any, messages: list[Any]) -> Events:
    decoder = ros.packets.PacketDecoder()
    parts = [decoder.decode(message)[0] for message in messages]
    assert decoder.missing == 0
    return Events.concatenate(parts) if parts else Events.empty()


def wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + LONG_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


def assert_equal(got: Events, expected: Events) -> None:
    for name in ("x", "y", "t", "p"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))


def test_mono_packets_hold_all_events_of_long_times(ros: Any) -> None:
    events = make(200_000, step=100)
    found = list(ros.packets.mono_packets(events))
    assert len(found) >= 5  # of at most 65,536 events and 4.29 s
    total = 0
    for base_ns, data in found:
        words = np.frombuffer(data, "<u8")
        part = events[total : total + len(words)]
        np.testing.assert_array_equal(base_ns // 1000 + (words & 0xFFFFFFFF) // 1000, part.t)
        np.testing.assert_array_equal(words >> 32 & 0xFFFF, part.x)
        np.testing.assert_array_equal(words >> 48 & 0x7FFF, part.y)
        np.testing.assert_array_equal(words >> 63, part.p)
        total += len(words)
    assert total == len(events)


def test_messages_of_a_bag_are_decoded_and_gaps_are_counted(ros: Any, tmp_path: Path) -> None:
    """EVT 3.0, as drivers send it: every event after a gap has its own row and time."""
    from rosbags.rosbag2.storage_mcap import McapReader

    path = tmp_path / "bag.mcap"
    events = make(20_000)
    save_bag(path, events)
    bag = McapReader(path)
    bag.open()
    raw = [data for _, _, data in bag.messages(bag.connections)]
    bag.close()
    stored = [
        ros.stub.STORE.deserialize_cdr(data, "event_camera_msgs/msg/EventPacket") for data in raw
    ]
    assert len(stored) >= 10
    decoder = ros.packets.PacketDecoder()
    got = Events.concatenate([decoder.decode(message)[0] for message in stored])
    assert_equal(got, events)
    assert (decoder.missing, decoder.late) == (0, 0)

    decoder = ros.packets.PacketDecoder()
    kept = [*stored[:3], *stored[6:]]
    left = Events.concatenate([decoder.decode(message)[0] for message in kept])
    assert decoder.missing == 3
    lost = np.isin(events.t, left.t, invert=True)
    assert_equal(left, events[~lost])
    assert 0 < np.count_nonzero(lost) < len(events)
    empty, edges = decoder.decode(stored[5])
    assert (len(empty), len(edges), decoder.late) == (0, 0, 1)
    stored[0].header.stamp.sec += 1000
    with pytest.raises(AmiwarpError, match=f"seq fell from {len(stored) - 1} to 0"):
        decoder.decode(stored[0])


def save_bag(path: Path, events: Events) -> None:
    native = path.with_suffix(".h5")
    save_recording(native, Recording(MemoryEvents(events, *SIZE)))
    convert(native, path)


def test_after_a_cut_words_that_need_lost_ones_are_dropped(ros: Any) -> None:
    """Two events whose row was in the lost message, then a row and a time of its own."""
    words = [0x2805, 0x6010, 0x2806, 0x8001, 0x2807, 0x6003, 0x000A, 0x2808]
    message = ros.stub.CLASSES["event_camera_msgs/msg/EventPacket"](
        width=64, height=48, seq=1, encoding="evt3"
    )
    message.events = array.array("B", np.array(words, "<u2").tobytes())
    events, _ = ros.packets.PacketDecoder().decode(stamped(message, 0))
    assert (events.x.tolist(), events.y.tolist(), events.t.tolist()) == ([8], [10], [4099])


def test_a_message_is_left_as_it_came(ros: Any) -> None:
    message = packet(ros, make(10), 0)
    before = message.events
    ros.packets.PacketDecoder().decode(message)
    assert message.events is before


def test_a_bag_that_is_played_again_ends_the_node(ros: Any) -> None:
    """Its stamps and numbers are those of the first time, so nothing would be published any more."""
    bag = [packet(ros, make(5, 1000 * (k + 1)), k) for k in range(30)]
    decoder = ros.packets.PacketDecoder()
    for message in [*bag, *bag[1:10], packet(ros, make(5, 99_000), 30), *bag[11:20]]:
        decoder.decode(message)
    assert decoder.late == 18
    with pytest.raises(AmiwarpError, match="seq 20 after 30; the bag was played anew"):
        decoder.decode(bag[20])


def test_the_clock_takes_the_smallest_delay_of_the_last_seconds(ros: Any) -> None:
    clock = ros.source.StampClock()
    assert clock.offset_us is None
    for stamp, delay in ((0, 900), (1_000_000, 300), (2_000_000, 700), (5_900_000, 800)):
        clock.note(STAMP_US + stamp + delay, stamp)
    assert clock.offset_us == STAMP_US + 300
    clock.note(STAMP_US + 6_100_000 + 750, 6_100_000)
    assert clock.offset_us == STAMP_US + 700
    clock.note(STAMP_US + 6_200_000 + 100, 6_200_000)
    assert clock.offset_us == STAMP_US + 100


@pytest.mark.parametrize("wrapped", [True, False])
def test_angles_of_joint_states_lie_on_the_events_clock(ros: Any, wrapped: bool) -> None:
    source = ros.source.MessageSource("/events", SIZE, encoders=1, joint="prism")
    source.put_joints(joint(ros, 500))  # the clocks are not related yet
    source.put_events(packet(ros, make(10), 0))
    times = list(range(1000, 200_000, 5000))
    for t in times:
        source.put_joints(joint(ros, t, wrapped=wrapped))
    source.put_joints(joint(ros, times[-1], wrapped=wrapped))  # twice
    for nothing in (float("nan"), float("inf")):
        broken = joint(ros, 250_000)
        broken.position = [nothing for _ in broken.position]
        source.put_joints(broken)
    other = joint(ros, 300_000)
    other.name = ["wheel", "arm"]
    source.put_joints(other)
    source.close()
    packets = list(source.packets())
    t = np.concatenate([found.encoder_t for found in packets])
    angle = np.concatenate([found.encoder_angle for found in packets])
    assert t.tolist() == times
    turns = (angle - RAD_PER_US * t) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns[0]), rtol=0, atol=1e-9)
    assert len(packets[0].events) == 10


def test_the_compensate_node_publishes_what_compensation_gives(
    ros: Any, overrides: dict[str, Any], calibration: Path
) -> None:
    overrides.update(calibration=str(calibration), joint="prism", wait_ms=10_000.0)
    node = ros.Compensate()
    parts = [make(400, 1000 + 4000 * k) for k in range(20)]
    for k, part in enumerate(parts):
        node.callbacks["events"](packet(ros, part, k))
        for t in range(int(part.t[0]), int(part.t[-1]) + 1001, 1000):
            node.callbacks["joint_states"](joint(ros, t))
    t = np.arange(1000, 82_001, 1000)
    model = Calibration.load(calibration).model
    events = Events.concatenate(parts)
    xy = np.rint(compensate_events(events, model, Encoder(t, RAD_PER_US * t)))
    inside = (xy[:, 0] >= 0) & (xy[:, 0] < 64) & (xy[:, 1] >= 0) & (xy[:, 1] < 48)
    assert 4000 < np.count_nonzero(inside) < 8000
    published = str(np.count_nonzero(inside))
    wait_for(lambda: node.status.done == 8000 and node.figures()["published events"] == published)
    node.timers_[0]()
    node.close()
    messages = node.publishers_["compensated/events"].messages
    got = decoded(ros, messages)
    np.testing.assert_array_equal(got.t, events.t[inside])
    np.testing.assert_array_equal(got.x, xy[inside, 0])
    np.testing.assert_array_equal(got.y, xy[inside, 1])
    np.testing.assert_array_equal(got.p, events.p[inside])
    assert [message.seq for message in messages] == list(range(len(messages)))
    assert {message.header.frame_id for message in messages} == {"camera"}
    first = messages[0].header.stamp
    assert first.sec * 1_000_000 + first.nanosec // 1000 == STAMP_US + int(got.t[0])
    (said,) = node.publishers_["/diagnostics"].messages
    values = {value.key: value.value for value in said.status[0].values}
    assert (said.status[0].level, said.status[0].name) == (b"\0", "/compensate")
    assert values["events"] == "8000"
    assert values["published events"] == str(len(got)) == published
    assert values["missing messages"] == "0"
    assert int(values["events with an extrapolated angle"]) == 0


def test_events_at_the_border_are_rounded_or_left_out(ros: Any) -> None:
    x = np.array([-0.6, -0.4, 63.4, 63.6, 10.0, 10.0, np.nan, 20.5], np.float32)
    y = np.array([5.0, 5.0, 5.0, 5.0, 47.6, -0.4, np.nan, 7.0], np.float32)
    events = Events(x, y, np.arange(8), np.ones(8, np.uint8))
    keep = np.array([True] * 7 + [False])
    found = ros.whole_pixels(events, keep, SIZE)
    assert (found.x.tolist(), found.y.tolist()) == ([0, 63, 10], [5, 5, 0])
    assert found.t.tolist() == [1, 2, 5]
    assert found.x.dtype == np.uint16


def test_diagnostics_warn_once_of_messages_that_are_missing(
    ros: Any, overrides: dict[str, Any], calibration: Path
) -> None:
    overrides.update(calibration=str(calibration))
    node = ros.Compensate()
    for seq in (0, 4):
        node.callbacks["events"](packet(ros, make(10, 1000 + 1000 * seq), seq))
    node.timers_[0]()
    node.timers_[0]()
    other = packet(ros, make(10, 90_000), 5)
    other.encoding = "evt9"
    node.callbacks["events"](other)
    with pytest.raises(AmiwarpError, match="evt9"):  # which ends the program
        node.timers_[0]()
    node.close()
    states = [message.status[0] for message in node.publishers_["/diagnostics"].messages]
    assert [state.level for state in states] == [b"\1", b"\0", b"\2"]
    assert states[0].message == "3 missing messages"
    assert "evt9" in states[2].message
    assert node.logger.said[-1][0] == "error"


def test_the_pictures_node_publishes_grey_images(
    ros: Any, overrides: dict[str, Any], calibration: Path
) -> None:
    overrides.update(calibration=str(calibration), joint="prism", rate_hz=50.0, wait_ms=10_000.0)
    node = ros.Pictures()
    for k in range(60):
        part = make(200, 1000 + 4000 * k, 20)
        node.callbacks["events"](packet(ros, part, k))
        for t in range(int(part.t[0]), int(part.t[-1]) + 1001, 1000):
            node.callbacks["joint_states"](joint(ros, t))
    images = node.publishers_["picture"].messages
    # A computer that is too slow for all of them makes the newest one
    wait_for(lambda: len(images) >= 1)
    node.close()
    image = images[0]
    assert (image.width, image.height, image.step, image.encoding) == (64, 48, 64, "mono8")
    assert len(image.data) == 64 * 48
    assert len(set(image.data)) > 20
    stamp = image.header.stamp
    end_us = stamp.sec * 1_000_000 + stamp.nanosec // 1000 - STAMP_US
    assert 84_000 < end_us <= 241_000  # after a whole turn, of 83 ms


def test_the_compensate_node_publishes_pictures_too(
    ros: Any, overrides: dict[str, Any], calibration: Path
) -> None:
    """In one node, because only one can open the controller's port."""
    overrides.update(calibration=str(calibration), joint="prism", pictures_hz=50.0, wait_ms=1e4)
    node = ros.Compensate()
    for k in range(40):
        part = make(200, 1000 + 4000 * k, 20)
        node.callbacks["events"](packet(ros, part, k))
        for t in range(int(part.t[0]), int(part.t[-1]) + 1001, 1000):
            node.callbacks["joint_states"](joint(ros, t))
    images = node.publishers_["picture"].messages
    wait_for(lambda: len(images) >= 1 and node.status.done == 8000)
    assert int(node.figures()["pictures"]) >= 1
    node.close()
    assert node.publishers_["compensated/events"].messages
    plain = dict(overrides, pictures_hz=0.0)
    overrides.update(plain)
    assert "picture" not in ros.Compensate().publishers_


def test_the_filter_node_keeps_what_the_filter_of_files_keeps(
    ros: Any, overrides: dict[str, Any]
) -> None:
    overrides.update(background_us=3000, refractory_us=500, region=[5, 5, 60, 40])
    node = ros.Filter()
    events = make(6000, step=3)
    for k, start in enumerate(range(0, 6000, 377)):
        node.callbacks["events"](packet(ros, events[start : start + 377], k))
    node.timers_[0]()
    got = decoded(ros, node.publishers_["filtered/events"].messages)
    chosen = EventFilter(background_us=3000, refractory_us=500, region=(5, 5, 60, 40))
    expected = chosen.apply(events, SIZE)
    assert 0 < len(expected) < 6000
    assert_equal(got, expected)
    (said,) = node.publishers_["/diagnostics"].messages
    values = {value.key: value.value for value in said.status[0].values}
    removed = sum(int(value) for key, value in values.items() if key.startswith("removed"))
    assert removed == 6000 - len(expected)


def test_parameters_have_descriptions_and_ranges(
    ros: Any, overrides: dict[str, Any], calibration: Path
) -> None:
    overrides.update(calibration=str(calibration))
    for make_node in (ros.Compensate, ros.Pictures, ros.Filter):
        node = make_node()
        for name, descriptor in node.descriptors.items():
            assert descriptor.description, name
            assert descriptor.read_only
        node.close()
    wait = ros.Compensate().descriptors["wait_ms"].floating_point_range[0]
    assert (wait.from_value, wait.to_value) == (0.0, 10_000.0)


def test_a_node_without_a_calibration_ends_with_one_line(ros: Any) -> None:
    with pytest.raises(SystemExit, match="amiwarp_ros: the parameter calibration is empty"):
        ros.compensate_main([])


def test_a_parameter_of_another_type_ends_with_one_line(
    ros: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_args: Any) -> None:
        raise ros.stub.ParameterException("'wait_ms' is '10' of type 'INTEGER', expecting 'DOUBLE'")

    monkeypatch.setattr(ros.stub.Node, "declare_parameter", refuse)
    with pytest.raises(SystemExit, match=r"'wait_ms' is '10' .*; a DOUBLE has a decimal point"):
        ros.compensate_main([])


@pytest.mark.parametrize("name", ["Compensate", "Filter"])
def test_every_parameter_is_an_argument_of_the_launch_file(
    ros: Any, overrides: dict[str, Any], calibration: Path, name: str
) -> None:
    """ROS ignores an argument that no launch file declares, without a word."""
    declared, node = ros.stub.launched(PACKAGE / "launch" / f"{name.lower()}.launch.py")
    assert node["executable"] == name.lower()
    given = {key: value.evaluate(declared) for key, value in node["parameters"][0].items()}
    overrides.update(calibration=str(calibration))
    parameters = getattr(ros, name)().parameters
    parameters["calibration"] = ""
    if name == "Filter":
        del parameters["calibration"]
        parameters["background_us"] = 5000
    assert given == parameters
    assert {key: type(value) for key, value in given.items()} == {
        key: type(value) for key, value in parameters.items()
    }
    topics = {key: value.evaluate(declared) for key, value in node["remappings"]}
    assert topics["events"] == "/event_camera/events"
    assert node["namespace"].evaluate(declared) == ""


def test_a_node_ends_with_ros(
    ros: Any, overrides: dict[str, Any], calibration: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    overrides.update(calibration=str(calibration))
    nodes = []

    def spin(node: Any) -> None:
        nodes.append(node)
        node.callbacks["events"](packet(ros, make(10), 0))
        raise ros.stub.ExternalShutdownException

    monkeypatch.setattr(sys.modules["rclpy"], "spin", spin)
    ros.compensate_main([])
    assert nodes[0].destroyed
    assert not nodes[0]._thread.is_alive()


def test_the_package_is_complete() -> None:
    """What colcon and ros2 look for: one name and one version, an executable for each node, launch files."""
    tree = ElementTree.parse(PACKAGE / "package.xml")
    setup = (PACKAGE / "setup.py").read_text(encoding="utf-8")
    assert tree.findtext("name") == "amiwarp_ros"
    assert f'version="{tree.findtext("version")}"' in setup
    assert tree.findtext("export/build_type") == "ament_python"
    assert (PACKAGE / "resource" / "amiwarp_ros").exists()
    depends = {element.text for element in tree.findall("exec_depend")}
    assert {"rclpy", "event_camera_msgs", "sensor_msgs", "diagnostic_msgs"} <= depends
    for node in (PACKAGE / "amiwarp_ros").glob("*_node.py"):
        if node.stem != "live_node":
            assert f"{{NAME}}.{node.stem}:main" in setup
    for launch in (PACKAGE / "launch").glob("*"):
        assert launch.name.endswith(".launch.py")
        compile(launch.read_text(encoding="utf-8"), str(launch), "exec")
