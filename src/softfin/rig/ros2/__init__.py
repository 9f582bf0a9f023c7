"""A fin behind ROS 2 topics."""
