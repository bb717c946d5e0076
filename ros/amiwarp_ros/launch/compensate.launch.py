"""Start the compensation of one camera's events and, with ``pictures_hz:=15``, pictures of the scene."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "namespace": ("", "namespace of the node and its topics"),
    "events": ("/event_camera/events", "topic of the camera's events"),
    "joint_states": ("/prism/joint_states", "topic of the prism's angle"),
}
PARAMETERS = {
    "calibration": (str, "", "calibration file of amiwarp (.json)"),
    "port": (str, "", "serial port of the prism's controller; empty: angles from joint_states"),
    "joint": (str, "", "name of the prism's joint in joint_states; empty: the first one"),
    "wait_ms": (float, "10.0", "longest wait of an event for its angle (ms)"),
    "device": (str, "cpu", "device that computes: cpu or cuda:0"),
    "pictures_hz": (float, "0.0", "pictures of the scene per second (Hz); 0: none"),
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
        executable="compensate",
        namespace=LaunchConfiguration("namespace"),
        parameters=[parameters],
        remappings=[(name, LaunchConfiguration(name)) for name in ("events", "joint_states")],
    )
    return LaunchDescription([*declared, node])
