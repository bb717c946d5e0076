"""Start the filter of one camera's events."""

from typing import List  # noqa: UP035 (what launch knows)

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "namespace": ("", "namespace of the node and its topics"),
    "events": ("/event_camera/events", "topic of the camera's events"),
}
PARAMETERS = {
    "background_us": (int, "5000", "remove events without a neighbour in this time before (us)"),
    "refractory_us": (int, "0", "remove events in this time after the last of their pixel (us)"),
    "most_per_s": (float, "0.0", "largest rate (events/s); 0: any"),
    "region": (List[int], "[0, 0, 0, 0]", "left, top, right, bottom (px); zeros: all"),  # noqa: UP006
}
"""Type, default and description of each parameter of the node. ROS ignores arguments that are not declared."""


def generate_launch_description() -> LaunchDescription:
    """Return the node and its arguments."""
    texts = {name: (default, text) for name, (_, default, text) in PARAMETERS.items()}
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in {**ARGUMENTS, **texts}.items()
    ]
    parameters = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (kind, _, _) in PARAMETERS.items()
    }
    node = Node(
        package="amiwarp_ros",
        executable="filter",
        namespace=LaunchConfiguration("namespace"),
        parameters=[parameters],
        remappings=[("events", LaunchConfiguration("events"))],
    )
    return LaunchDescription([*declared, node])
