"""Start the compensation and, with ``pictures:=true``, the pictures of one camera."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return the nodes and their arguments."""
    arguments = {
        "calibration": ("", "calibration file of amiwarp (.json)"),
        "events": ("/event_camera/events", "topic of the camera's events"),
        "port": ("", "serial port of the prism's controller; empty: angles from joint_states"),
        "joint_states": ("/prism/joint_states", "topic of the prism's angle"),
        "pictures": ("false", "whether to make pictures of the scene"),
    }
    parameters = {name: LaunchConfiguration(name) for name in ("calibration", "port")}
    topics = [(name, LaunchConfiguration(name)) for name in ("events", "joint_states")]
    compensate = Node(
        package="amiwarp_ros", executable="compensate", parameters=[parameters], remappings=topics
    )
    pictures = Node(
        package="amiwarp_ros",
        executable="pictures",
        parameters=[parameters],
        remappings=topics,
        condition=IfCondition(LaunchConfiguration("pictures")),
    )
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, (value, text) in arguments.items()
    ]
    return LaunchDescription([*declared, compensate, pictures])
