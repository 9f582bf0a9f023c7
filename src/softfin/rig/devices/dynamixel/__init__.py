"""ROBOTIS Dynamixel X-series servos, over Protocol 2.0 on a separate serial port each."""
