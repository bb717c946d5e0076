"""Diagnostics of the nodes, as ``diagnostic_msgs/DiagnosticArray``."""

from __future__ import annotations

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from amiwarp import AmiwarpError


class Diagnostics:
    """Publisher of the state of a node on ``/diagnostics``, once per second."""

    def __init__(self, node: Any) -> None:
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._before: dict[str, int] = {}

    def publish(self, counts: dict[str, int], figures: dict[str, str], failure: str | None) -> None:
        """Publish numbers and texts. ``counts`` of what is lost warn when they have grown since the last call.

        Raises :class:`AmiwarpError` after a failure was published, which ends the node.
        """
        grown = [name for name, count in counts.items() if count > self._before.get(name, 0)]
        self._before = dict(counts)
        status = DiagnosticStatus(
            name=self._node.get_fully_qualified_name(), level=DiagnosticStatus.OK
        )
        status.message = "running"
        if grown:
            status.level = DiagnosticStatus.WARN
            status.message = ", ".join(f"{counts[name]} {name}" for name in grown)
        if failure is not None:
            status.level = DiagnosticStatus.ERROR
            status.message = failure
        values = {**{name: str(count) for name, count in counts.items()}, **figures}
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)
        if failure is not None:
            raise AmiwarpError(failure)
