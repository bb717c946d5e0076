"""What the nodes with a calibration share: the session, its thread and its diagnostics."""

from __future__ import annotations

import contextlib
import threading
from typing import Any

from event_camera_msgs.msg import EventPacket
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState

from amiwarp import AmiwarpError, Calibration
from amiwarp.compensation.recordings import check_size
from amiwarp.live.link import Link
from amiwarp.live.stream import Session, SessionStatus
from amiwarp_ros.diagnostics import Diagnostics
from amiwarp_ros.message_source import MessageSource
from amiwarp_ros.parameters import Parameter, declare

INPUT_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Takes messages of reliable publishers and of others."""
PARAMETERS = (
    Parameter("calibration", "", "Calibration file of amiwarp (.json)"),
    Parameter(
        "port",
        "",
        "Serial port of the prism's controller, or 'find'; empty: angles from the topic joint_states",
    ),
    Parameter("joint", "", "Name of the prism's joint in joint_states; empty: the first one"),
    Parameter("wait_ms", 10.0, "Longest wait of an event for its angle (ms)", (0.0, 10_000.0)),
    Parameter("device", "cpu", "Device that computes: cpu or cuda:0"),
)


class LiveNode(Node):
    """Node with a session of amiwarp, which starts with the first message with events.

    A class that is derived from it has :meth:`make_session` and :meth:`figures`.
    """

    def __init__(self, name: str, parameters: tuple[Parameter, ...] = ()) -> None:
        super().__init__(name)
        self.values = declare(self, (*PARAMETERS, *parameters))
        path = self.values["calibration"]
        if not path:
            raise AmiwarpError(
                "the parameter calibration is empty; give a file of 'amiwarp calibrate'"
            )
        self.calibration = Calibration.load(path)
        self.source: MessageSource | None = None
        self.failure: str | None = None
        """Why the node does no more work, in one line."""
        self.status = SessionStatus()
        self._resources = contextlib.ExitStack()
        self.link: Link | None = None
        if self.values["port"]:
            port = None if self.values["port"] == "find" else self.values["port"]
            self.link = self._resources.enter_context(Link(port))
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._diagnostics = Diagnostics(self)
        self.create_subscription(EventPacket, "events", self._take_events, INPUT_QOS)
        if self.link is None:
            self.create_subscription(JointState, "joint_states", self._take_joints, INPUT_QOS)
        self.create_timer(1.0, self._publish_diagnostics)

    def make_session(self, source: MessageSource, frame_id: str) -> Session:
        """Return the session of the node."""
        raise NotImplementedError

    def figures(self) -> dict[str, str]:
        """Return what the diagnostics say about the node's own work."""
        raise NotImplementedError

    def finish(self) -> None:
        """Finish the node's own work, after its session."""

    def say(self, message: str) -> None:
        """Log a message of amiwarp."""
        self.get_logger().warning(message)

    def close(self) -> None:
        """End the session, and wait for it."""
        self._stop.set()
        if self.source is not None:
            self.source.close()
        if self._thread is not None:
            self._thread.join()
        self._resources.close()

    def _take_events(self, message: Any) -> None:
        if self.failure is not None:
            return
        try:
            if self.source is None:
                self.source = self._start(message)
            self.source.put_events(message)
        except AmiwarpError as error:
            self._fail(str(error))

    def _take_joints(self, message: Any) -> None:
        if self.source is not None and self.failure is None:
            self.source.put_joints(message)

    def _start(self, message: Any) -> MessageSource:
        size = (int(message.width), int(message.height))
        encoders = 0 if self.link is not None else 1
        source = MessageSource(
            self.resolve_topic_name("events"), size, encoders=encoders, joint=self.values["joint"]
        )
        check_size(self.calibration, size, source.name)
        session = self.make_session(source, message.header.frame_id)
        self._thread = threading.Thread(target=self._run, args=(session,), name="amiwarp-session")
        self._thread.start()
        return source

    def _run(self, session: Session) -> None:
        try:
            self.status = session.run(self._stop, self._note)
            self.finish()
        except Exception as error:
            self._fail(str(error))

    def _note(self, status: SessionStatus) -> None:
        self.status = status

    def _fail(self, what: str) -> None:
        self.failure = what
        self.get_logger().error(what)
        self._stop.set()

    def _publish_diagnostics(self) -> None:
        status = self.status
        counts = {"late events": status.late, "dropped events": status.dropped}
        figures = {
            "events": str(status.events),
            "million events/s": f"{status.rate_mev_s:.3f}",
            "latency ms (median)": f"{status.latency_ms[0]:.1f}",
            "waiting events": str(status.waiting),
            **self.figures(),
        }
        if self.source is not None:
            counts["missing messages"] = self.source.decoder.missing
            counts["late messages"] = self.source.decoder.late
            if self.source.decoder.note is not None:
                figures["assumed"] = self.source.decoder.note
        self._diagnostics.publish(counts, figures, self.failure)
