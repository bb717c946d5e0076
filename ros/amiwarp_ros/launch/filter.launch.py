"""Start the filter of one camera's events."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Return the node and its arguments."""
    events = DeclareLaunchArgument("events", default_value="/event_camera/events")
    background = DeclareLaunchArgument("background_us", default_value="5000")
    node = Node(
        package="amiwarp_ros",
        executable="filter",
        parameters=[
            {"background_us": ParameterValue(LaunchConfiguration("background_us"), value_type=int)}
        ],
        remappings=[("events", LaunchConfiguration("events"))],
    )
    return LaunchDescription([events, background, node])
