"""Stand-in for rclpy and its messages, written from their documented signatures.

https://docs.ros.org/en/humble/p/rclpy/ has the signatures. Messages have the fields that rosbags defines for ROS 2
Humble; as in rclpy, a message has no other fields, and takes ``array.array`` for bytes.
"""

from __future__ import annotations

import array
import copy
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, List, NamedTuple  # noqa: UP035 (what launch knows)
from unittest import mock

import numpy as np
import yaml
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

EVENT_PACKET = """std_msgs/Header header
uint32 height
uint32 width
uint64 seq
uint64 time_base
string encoding
bool is_bigendian
uint8[] events
"""
"""Definition of event_camera_msgs/EventPacket, from its package."""
STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(get_types_from_msg(EVENT_PACKET, "event_camera_msgs/msg/EventPacket"))
NAMES = (
    "builtin_interfaces/msg/Time",
    "std_msgs/msg/Header",
    "event_camera_msgs/msg/EventPacket",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/JointState",
    "diagnostic_msgs/msg/DiagnosticArray",
    "diagnostic_msgs/msg/DiagnosticStatus",
    "diagnostic_msgs/msg/KeyValue",
)
CLASSES: dict[str, type] = {}


def default_of(kind: Any) -> Any:
    """Return the value of a field that nobody set."""
    code, detail = kind
    if code.name == "NAME":
        return CLASSES[detail]()
    if code.name == "SEQUENCE":
        inner = detail[0]
        is_bytes = inner[0].name == "BASE" and inner[1][0] == "uint8"
        return array.array("B") if is_bytes else []
    base = detail[0]
    return {"string": "", "bool": False, "float64": 0.0, "byte": b"\0"}.get(base, 0)


def check(name: str, field: str, kind: Any, value: Any) -> None:
    """Raise as rclpy does, for values of other types."""
    base = kind[1][0] if kind[0].name == "BASE" else None
    default = default_of(kind)
    is_number = base is not None and base not in ("string", "bool", "byte")
    if is_number and base.startswith(("uint", "int")):
        bits = int(base.lstrip("uint"))
        low = 0 if base.startswith("u") else -(1 << (bits - 1))
        assert type(value) is int, (name, field, value)
        assert low <= value < low + (1 << bits), (name, field, value)
    elif field != "name" or not isinstance(value, list | tuple):
        assert isinstance(value, type(default)), (name, field, value)


def message_class(full: str) -> type:
    """Return the class of a message."""
    fields = dict(STORE.fielddefs[full][1])

    def __init__(self: Any, **values: Any) -> None:
        for field, kind in fields.items():
            object.__setattr__(self, field, default_of(kind))
        for field, value in values.items():
            setattr(self, field, value)

    def __setattr__(self: Any, field: str, value: Any) -> None:
        assert field in fields, f"{full} has no field {field}"
        check(full, field, fields[field], value)
        object.__setattr__(self, field, value)

    members = {"__init__": __init__, "__setattr__": __setattr__, "full": full}
    return type(full.rpartition("/")[2], (), members)


for one in NAMES:
    CLASSES[one] = message_class(one)
status = CLASSES["diagnostic_msgs/msg/DiagnosticStatus"]
status.OK, status.WARN, status.ERROR, status.STALE = b"\0", b"\1", b"\2", b"\3"  # type: ignore[attr-defined]


def to_rosbags(message: Any) -> Any:
    """Return the message as an object of rosbags."""
    values = {}
    for field, _ in STORE.fielddefs[message.full][1]:
        value = getattr(message, field)
        if hasattr(value, "full"):
            value = to_rosbags(value)
        elif isinstance(value, array.array):
            value = np.frombuffer(value.tobytes(), np.uint8)
        elif isinstance(value, bytes):
            value = value[0]
        elif isinstance(value, list | tuple) and value and hasattr(value[0], "full"):
            value = [to_rosbags(part) for part in value]
        elif isinstance(value, list | tuple) and field in ("position", "velocity", "effort"):
            value = np.asarray(value, np.float64)
        values[field] = value
    return STORE.types[message.full](**values)


def round_trip(message: Any) -> None:
    """Assert that rosbags serialises the message, and reads the same bytes back."""
    data = bytes(STORE.serialize_cdr(to_rosbags(message), message.full))
    again = STORE.deserialize_cdr(data, message.full)
    assert bytes(STORE.serialize_cdr(again, message.full)) == data


class Logger:
    """Logger of a node."""

    def __init__(self) -> None:
        self.said: list[tuple[str, str]] = []

    def info(self, message: str) -> None:
        self.said.append(("info", message))

    def warning(self, message: str) -> None:
        self.said.append(("warning", message))

    def error(self, message: str) -> None:
        self.said.append(("error", message))


class Publisher:
    """Publisher, which keeps copies of the messages."""

    def __init__(self, kind: type) -> None:
        self._kind = kind
        self.messages: list[Any] = []

    def publish(self, message: Any) -> None:
        assert type(message) is self._kind
        round_trip(message)
        self.messages.append(copy.deepcopy(message))


class Node:
    """Node, with what a test looks at."""

    def __init__(self, node_name: str) -> None:
        self.name = node_name
        self.parameters: dict[str, Any] = {}
        self.descriptors: dict[str, Any] = {}
        self.publishers_: dict[str, Publisher] = {}
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.timers_: list[Callable[[], None]] = []
        self.logger = Logger()
        self.destroyed = False

    def declare_parameter(self, name: str, value: Any = None, descriptor: Any = None) -> Any:
        self.descriptors[name] = descriptor
        self.parameters[name] = OVERRIDES.get(name, value)
        return self.get_parameter(name)

    def get_parameter(self, name: str) -> Any:
        return SimpleNamespace(name=name, value=self.parameters[name])

    def create_publisher(self, msg_type: type, topic: str, qos_profile: Any) -> Publisher:
        assert isinstance(qos_profile, int | QoSProfile)
        self.publishers_[topic] = Publisher(msg_type)
        return self.publishers_[topic]

    def create_subscription(
        self, msg_type: type, topic: str, callback: Callable[[Any], None], qos_profile: Any
    ) -> object:
        assert isinstance(qos_profile, int | QoSProfile)
        self.callbacks[topic] = callback
        return object()

    def create_timer(self, timer_period_sec: float, callback: Callable[[], None]) -> object:
        self.timers_.append(callback)
        NODES.append(self)  # the last call of the constructors
        return object()

    def get_logger(self) -> Logger:
        return self.logger

    def get_clock(self) -> Any:
        time = CLASSES["builtin_interfaces/msg/Time"](sec=1_700_000_000, nanosec=5)
        return SimpleNamespace(now=lambda: SimpleNamespace(to_msg=lambda: time))

    def get_fully_qualified_name(self) -> str:
        return f"/{self.name}"

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        return f"/{topic}"

    def destroy_node(self) -> None:
        self.destroyed = True


NODES: list[Node] = []
"""Nodes that were made."""
OVERRIDES: dict[str, Any] = {}
"""Values of parameters, as from a launch file."""


class QoSProfile:
    """Quality of service."""

    def __init__(self, *, depth: int, reliability: str = "reliable") -> None:
        self.depth = depth
        self.reliability = reliability


class ParameterDescriptor:
    """Message rcl_interfaces/ParameterDescriptor."""

    def __init__(self, *, description: str = "", read_only: bool = False) -> None:
        self.description = description
        self.read_only = read_only
        self.floating_point_range: list[Any] = []
        self.integer_range: list[Any] = []


class ParameterException(Exception):
    """Base of what rclpy raises for a parameter."""


class ExternalShutdownException(Exception):
    """Raised by spin when ROS ends."""


class LaunchConfiguration(NamedTuple):
    """Value of an argument of a launch file."""

    name: str

    def evaluate(self, declared: dict[str, str]) -> str:
        """Return the default, which must be declared."""
        return declared[self.name]


class ParameterValue:
    """Parameter of a node with its type, as launch_ros converts it."""

    def __init__(self, value: LaunchConfiguration, *, value_type: Any) -> None:
        assert value_type in (int, float, bool, str, List[int])  # noqa: UP006 (what launch knows)
        self.value = value
        self.value_type = value_type

    def evaluate(self, declared: dict[str, str]) -> Any:
        """Return the value: a list as YAML, another type from the text."""
        text = self.value.evaluate(declared)
        return yaml.safe_load(text) if self.value_type is List[int] else self.value_type(text)  # noqa: UP006


def launched(path: Path) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the defaults of the arguments of a launch file, and what it says of its one node."""
    declared: dict[str, str] = {}
    nodes: list[dict[str, Any]] = []

    def declare(name: str, *, default_value: str, description: str) -> None:
        assert description
        declared[name] = default_value

    modules: dict[str, dict[str, Any]] = {
        "launch": {"LaunchDescription": list},
        "launch.actions": {"DeclareLaunchArgument": declare},
        "launch.substitutions": {"LaunchConfiguration": LaunchConfiguration},
        "launch_ros": {},
        "launch_ros.actions": {"Node": lambda **what: nodes.append(what)},
        "launch_ros.parameter_descriptions": {"ParameterValue": ParameterValue},
    }
    with mock.patch.dict(sys.modules, {name: _module(name, of) for name, of in modules.items()}):
        runpy.run_path(str(path))["generate_launch_description"]()
    (node,) = nodes
    return declared, node


def _module(name: str, members: dict[str, Any]) -> ModuleType:
    module = ModuleType(name)
    vars(module).update(members)
    return module


def install() -> list[str]:
    """Put the stand-in into ``sys.modules``; return the names of its modules."""
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {"init": lambda args=None: None, "spin": None, "try_shutdown": lambda: None},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {
            "QoSProfile": QoSProfile,
            "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT="best effort"),
        },
        "rclpy.exceptions": {"ParameterException": ParameterException},
        "rclpy.executors": {"ExternalShutdownException": ExternalShutdownException},
        "rcl_interfaces.msg": {
            "ParameterDescriptor": ParameterDescriptor,
            "FloatingPointRange": SimpleNamespace,
            "IntegerRange": SimpleNamespace,
        },
    }
    for full, kind in CLASSES.items():
        package, _, name = full.split("/")
        modules.setdefault(f"{package}.msg", {})[name] = kind
    for name in list(modules):
        modules.setdefault(name.partition(".")[0], {})
    for name, members in modules.items():
        sys.modules[name] = _module(name, members)
    return list(modules)
