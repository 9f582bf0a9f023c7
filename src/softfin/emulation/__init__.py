"""Emulated devices that implement the protocols of the drive and the sensor, connected to the
virtual tank."""
