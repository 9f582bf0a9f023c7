"""ROS 2 bags in MCAP: written while a fin moves, recovered, converted."""
