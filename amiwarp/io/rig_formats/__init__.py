"""Recorded rigs in the layouts of public data sets, of Kalibr and of ROS."""
