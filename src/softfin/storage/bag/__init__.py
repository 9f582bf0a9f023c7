"""ROS 2 bags in MCAP format: live recording, recovery and reading."""
