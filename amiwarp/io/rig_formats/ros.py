"""ROS bags of a rig: for each sensor its events, images, calibration, IMU samples and true poses; places in tf_static.

Types of messages: `sensor_msgs <https://docs.ros.org/en/api/sensor_msgs/html/index-msg.html>`_,
`REP 118 <https://www.ros.org/reps/rep-0118.html>`_ for depth (32FC1 in metres, infinite beyond the range, NaN if
unknown) and `REP 145 <https://www.ros.org/reps/rep-0145.html>`_ for the IMU. The frame ``rig`` is the parent of the
frames of the sensors, which are called as the sensors.
"""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Generator
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from amiwarp.events.other_sensors import ImageStore
from amiwarp.io.export import Pixels, check_limits
from amiwarp.io.output_formats import LIMITS, Outline, OutputFormat, Rounding
from amiwarp.io.rig_description import span_of
from amiwarp.io.rig_formats.task import ROUNDED, Matrix, RigTask
from amiwarp.io.ros.ros1_writer import ARRAY, EARLIEST_NS, ArrayEncoder
from amiwarp.io.ros.ros2_writer import MESSAGE, PacketEncoder, ros2_file

Messages: TypeAlias = Generator[tuple[int, Any, bytes], None, None]
"""Time of the recording [ns], connection of the library, which stands for a topic, and serialised message."""

RIG_FRAME = "rig"
"""Name of the rig's frame."""

WORLD_FRAME = "world"
"""Name of the frame of true poses."""

PLACES = "tf2_msgs/msg/TFMessage"
"""Type of the message with the places of the sensors."""

PLACES_DEFINITION = "geometry_msgs/TransformStamped[] transforms\n"
"""Its definition in ROS 1, which not all collections of messages hold."""


def write_ros1_rig(task: RigTask, part: Path) -> None:
    """Write a ROS 1 bag."""
    about = _outline(task, OutputFormat.ROS1)
    # The first encoder says which library is missing.
    store = ArrayEncoder(about).store
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import get_types_from_msg

    if PLACES not in store.types:
        store.register(get_types_from_msg(PLACES_DEFINITION, PLACES))

    with Writer(part) as writer:
        _write(task, writer, _Ros(store, writer, 1), about)


def write_ros2_rig(task: RigTask, part: Path) -> None:
    """Write a ROS 2 bag, MCAP or SQLite by the extension of the output."""
    about = _outline(task, OutputFormat.ROS2)
    store = PacketEncoder(about).store
    with ros2_file(part, task.out.suffix.lower()) as writer:
        _write(task, writer, _Ros(store, writer, 2), about)


class _Ros:
    """Messages of one version of ROS, and the topics of the bag that is written."""

    def __init__(self, store: Any, writer: Any, version: int) -> None:
        self.store = store
        self.types = store.types
        self.version = version
        self._writer = writer
        self._counts: dict[str, int] = {}

    def topic(self, name: str, kind: str, *, kept: bool = False) -> Any:
        """Add a topic. Late subscribers get the last message of a topic that is ``kept``."""
        if self.version == 1:
            latching = int(kept)
            return self._writer.add_connection(
                name, kind, typestore=self.store, callerid="/amiwarp", latching=latching
            )
        profiles = [_kept_profile()] if kept else []
        return self._writer.add_connection(
            name, kind, typestore=self.store, offered_qos_profiles=profiles
        )

    def serialised(self, message: Any, kind: str) -> bytes:
        """Return the bytes of a message."""
        if self.version == 1:
            return bytes(self.store.serialize_ros1(message, kind))
        return bytes(self.store.serialize_cdr(message, kind))

    def header(self, t_us: int, frame: str) -> Any:
        """Return a header with a time and the name of a frame."""
        seconds, microseconds = divmod(t_us, 1_000_000)
        stamp = self.types["builtin_interfaces/msg/Time"](seconds, 1000 * microseconds)
        header = self.types["std_msgs/msg/Header"]
        if self.version == 1:
            number = self._counts.get(frame, 0)
            self._counts[frame] = number + 1
            return header(seq=number, stamp=stamp, frame_id=frame)
        return header(stamp=stamp, frame_id=frame)

    def vector(self, values: Any, kind: str = "Vector3") -> Any:
        """Return a vector or a point."""
        x, y, z = map(float, values)
        return self.types[f"geometry_msgs/msg/{kind}"](x, y, z)

    def quaternion(self, values: Any) -> Any:
        """Return a quaternion of x, y, z, w."""
        x, y, z, w = map(float, values)
        return self.types["geometry_msgs/msg/Quaternion"](x, y, z, w)

    def transform(self, t_us: int, parent: str, child: str, matrix: Matrix) -> Any:
        """Return the place of a frame in its parent: the matrix turns points of the frame into the parent's frame."""
        from scipy.spatial.transform import Rotation

        quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        place = self.types["geometry_msgs/msg/Transform"](
            self.vector(matrix[:3, 3]), self.quaternion(quaternion)
        )
        stamped = self.types["geometry_msgs/msg/TransformStamped"]
        return stamped(self.header(t_us, parent), child, place)


def _kept_profile() -> Any:
    """Return the quality of service of a topic whose last message late subscribers get."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    forever = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        forever,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        False,
    )


def _outline(task: RigTask, format: OutputFormat) -> Outline:
    """Return what the writers of events need to know. The clock of all sensors begins at the same time."""
    spans = [span for name in task.rig.sensors if (span := span_of(task.recording(name)))]
    sizes = [task.recording(name).events.size for name in task.rig.sensors]
    about = Outline(
        path=task.out,
        width=max(width for width, _ in sizes),
        height=max(height for _, height in sizes),
        t_first=min((first for first, _ in spans), default=0),
        t_last=max((last for _, last in spans), default=0),
        codec=task.codec,
    )
    check_limits(about, LIMITS[format])
    return about


def _write(task: RigTask, writer: Any, ros: _Ros, about: Outline) -> None:
    """Write the messages of all sensors in the order of their times."""
    streams = [_places(task, ros, about.t_first)]
    for name in task.rig.sensors:
        streams += _streams(task, ros, name, about)
        recording = task.recording(name)
        if recording.encoder is not None:
            task.left_out.add("encoder")
        if recording.frames is not None and recording.frames.exposure is not None:
            task.left_out.add("exposures")
    total_ns = max(1000 * (about.t_last - about.t_first), 1)
    with contextlib.ExitStack() as opened:
        for stream in streams:
            opened.enter_context(contextlib.closing(stream))
        for t_ns, connection, data in heapq.merge(*streams, key=itemgetter(0)):
            writer.write(connection, max(t_ns, EARLIEST_NS), data)
            task.progress("writing", min((t_ns - 1000 * about.t_first) / total_ns, 1.0))


def _streams(task: RigTask, ros: _Ros, name: str, about: Outline) -> list[Any]:
    """Return the messages of a sensor, one iterator for each topic."""
    recording = task.recording(name)
    streams = []
    if len(recording.events):
        width, height = recording.events.size
        of_sensor = Outline(about.path, width, height, about.t_first, about.t_last, about.codec)
        streams.append(_event_messages(task, ros, name, of_sensor))
    for topic, images in ((f"/{name}", recording.frames), (f"/{name}/depth", recording.depth)):
        if images is not None:
            streams.append(_image_messages(ros, f"{topic}/image_raw", name, images))
            if recording.camera is not None:
                streams.append(_info_messages(task, ros, f"{topic}/camera_info", name, images.t))
    if recording.frames is None and recording.depth is None and recording.camera is not None:
        span = span_of(recording)
        t = np.array([about.t_first if span is None else span[0]])
        streams.append(_info_messages(task, ros, f"/{name}/camera_info", name, t))
    if recording.imu is not None:
        streams.append(_imu_messages(task, ros, name))
    if recording.truth is not None and recording.truth.poses is not None:
        streams.append(_pose_messages(task, ros, name))
    return streams


def _event_messages(task: RigTask, ros: _Ros, name: str, about: Outline) -> Messages:
    encoder = ArrayEncoder(about, name) if ros.version == 1 else PacketEncoder(about, name)
    topic = ros.topic(f"/{name}/events", ARRAY if ros.version == 1 else MESSAGE)
    limits = LIMITS[OutputFormat.ROS1 if ros.version == 1 else OutputFormat.ROS2]
    events = task.recording(name).events
    rounded = Pixels(limits, events.size, Rounding.NEAREST, 0)
    for block in events.blocks():
        if not block.whole_pixels:
            task.note(ROUNDED.format(name))
            block = rounded(block)
        if not len(block):
            continue
        for t_ns, data in encoder(block):
            yield t_ns, topic, bytes(data)


def _image_messages(ros: _Ros, topic_name: str, frame: str, images: ImageStore) -> Messages:
    kind = "sensor_msgs/msg/Image"
    topic = ros.topic(topic_name, kind)
    make = ros.types[kind]
    for t, image in zip(images.t.tolist(), images, strict=True):
        height, width = image.shape[:2]
        data = np.ascontiguousarray(image, image.dtype.newbyteorder("<")).view(np.uint8).ravel()
        message = make(
            ros.header(t, frame), height, width, encoding_of(image), 0, data.size // height, data
        )
        yield 1000 * t, topic, ros.serialised(message, kind)


def encoding_of(image: NDArray[Any]) -> str:
    """Return ROS's name of the encoding of a frame or a depth map."""
    if image.dtype == np.float32:
        return "32FC1"
    bits = 8 * image.dtype.itemsize
    if image.ndim == 2:
        return f"mono{bits}"
    return "rgb8" if bits == 8 else "rgb16"


def _info_messages(
    task: RigTask, ros: _Ros, topic_name: str, name: str, times: NDArray[np.int64]
) -> Messages:
    kind = "sensor_msgs/msg/CameraInfo"
    topic = ros.topic(topic_name, kind)
    camera = task.camera(name)
    matrix, coefficients = camera.to_opencv()
    models = {4: "equidistant", 5: "plumb_bob", 8: "rational_polynomial"}
    region = ros.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    for t in times.tolist():
        message = ros.types[kind](
            ros.header(t, name),
            camera.height,
            camera.width,
            models[len(coefficients)],
            coefficients,
            matrix.ravel(),
            np.eye(3).ravel(),
            np.c_[matrix, np.zeros(3)].ravel(),
            0,
            0,
            region,
        )
        yield 1000 * t, topic, ros.serialised(message, kind)


def imu_frame(name: str) -> str:
    """Return the name of the frame of the IMU that a sensor carries."""
    return f"{name}_imu"


def _imu_messages(task: RigTask, ros: _Ros, name: str) -> Messages:
    kind = "sensor_msgs/msg/Imu"
    topic = ros.topic(f"/{name}/imu", kind)
    imu = task.recording(name).imu
    assert imu is not None
    # By the definition of the message, -1 marks a quantity that is not measured: here, the orientation.
    unknown = np.array([-1.0, *[0.0] * 8])
    still = ros.quaternion((0.0, 0.0, 0.0, 1.0))
    for t, turning, force in zip(
        imu.t.tolist(), imu.angular_velocity, imu.acceleration, strict=True
    ):
        values = []
        for vector in (turning, force):
            is_known = bool(np.isfinite(vector).all())
            values += [
                ros.vector(vector if is_known else np.zeros(3)),
                np.zeros(9) if is_known else unknown,
            ]
        message = ros.types[kind](ros.header(t, imu_frame(name)), still, unknown, *values)
        yield 1000 * t, topic, ros.serialised(message, kind)


def _pose_messages(task: RigTask, ros: _Ros, name: str) -> Messages:
    kind = "geometry_msgs/msg/PoseStamped"
    topic = ros.topic(f"/{name}/pose", kind)
    truth = task.recording(name).truth
    assert truth is not None
    assert truth.poses is not None
    poses = truth.poses[:]
    for t, pose in zip(poses.t.tolist(), poses.camera, strict=True):
        place = ros.types["geometry_msgs/msg/Pose"](
            ros.vector(pose[:3], "Point"), ros.quaternion(pose[3:])
        )
        message = ros.types[kind](ros.header(t, WORLD_FRAME), place)
        yield 1000 * t, topic, ros.serialised(message, kind)


def _places(task: RigTask, ros: _Ros, t_us: int) -> Messages:
    """Yield the one message with the places of the sensors on the rig, and of the IMU on its camera."""
    topic = ros.topic("/tf_static", PLACES, kept=True)
    transforms = []
    for name in task.rig.sensors:
        transforms.append(ros.transform(t_us, RIG_FRAME, name, task.rig[name].to_rig))
        if task.recording(name).imu is not None:
            place = task.imu_to_camera(name)
            transforms.append(ros.transform(t_us, name, imu_frame(name), place))
    yield 1000 * t_us, topic, ros.serialised(ros.types[PLACES](transforms), PLACES)
