"""Start and end of a node."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException

from amiwarp import AmiwarpError


def run(make: Callable[[], Any], args: list[str] | None) -> None:
    """Make a node, and run it until Ctrl-C or the end of ROS. An error of amiwarp, or of a
    parameter, ends the program with its line.
    """
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
    except ParameterException as error:
        sys.exit(f"amiwarp_ros: {error}; a DOUBLE has a decimal point, as 15.0")
    finally:
        rclpy.try_shutdown()
