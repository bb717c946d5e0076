"""ROS bags."""
