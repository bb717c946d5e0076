"""Start and end of a node."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException

from amiwarp import AmiwarpError


def run(make: Callable[[], Any], args: list[str] | None) -> None:
    """Make a node, and run it until Ctrl-C or the end of ROS. An error of amiwarp ends the program with its line."""
    rclpy.init(args=args)
    try:
        node = make()
        try:
            rclpy.spin(node)
        finally:
            node.close()
            node.destroy_node()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except AmiwarpError as error:
        sys.exit(f"amiwarp_ros: {error}")
    finally:
        rclpy.try_shutdown()
