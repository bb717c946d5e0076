"""Nodes of ROS 2 for event cameras, by amiwarp."""
