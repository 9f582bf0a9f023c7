"""A force sensor whose driver publishes WrenchStamped messages on a ROS 2 topic."""
