"""Robots with several fins on one body: distribution of a wrench among the fins, as the robot's ROS
2 node runs it."""
