"""Additional channels that a log may contain besides command, angle, velocity and force (x, y).

A channel's name is its column in log files and ends in its unit. The names below have the same
meaning on the rig, in bags and on import; a log may also contain other channels. softfin
learns only from the torque about the shaft, which streaming surrogates predict.

The z axis is x cross y, along the shaft. A positive velocity turns the fin about -z, from +y to +x.
The load of the fin on its mount opposes the drive, so torque about z times velocity is the power
that the drive delivers to the fin.
"""

LOG_COLUMNS = (
    "time_s",
    "command_angle_rad",
    "command_velocity_rad_s",
    "angle_rad",
    "velocity_rad_s",
    "force_x_n",
    "force_y_n",
)
"""Columns that every log file has; a channel must have a different name."""

LOAD_CHANNELS = ("force_z_n", "torque_x_nm", "torque_y_nm", "torque_nm")
"""Load of the fin on its mount, in the order of a wrench: force along z [N] and torque about x, y
and z [N m]. The last one is the torque about the shaft."""

CURRENT_CHANNEL = "current_a"
"""Current of the drive motor [A]."""

VOLTAGE_CHANNEL = "voltage_v"
"""Supply voltage of the drive [V]."""
