"""ROS 2 nodes of softfin."""
