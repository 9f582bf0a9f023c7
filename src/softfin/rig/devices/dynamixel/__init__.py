"""ROBOTIS Dynamixel servos of the X series, over Protocol 2.0 on a serial port of their own."""
