"""Register units of Dynamixel X-series servos, for the driver and for logs of register values.

Source: ROBOTIS e-Manual, the control tables on the pages "XM430-W210", "XM430-W350" and
"XH430-V350", and the linked pages about single entries. No value has been measured.
"""

from typing import NamedTuple

CENTER = 2048
"""Position in the middle of the turn, which softfin uses as angle 0."""

TICKS_PER_TURN = 4096

VELOCITY_UNIT_RPM = 0.229
"""Unit of velocity [rev/min]."""

VOLTAGE_UNIT_V = 0.1
"""Unit of the input voltage [V]."""


class Model(NamedTuple):
    """Properties that differ between the models."""

    number: int
    current_unit_a: float
    """Unit of the present current [A]."""


MODELS = {
    "XM430-W210": Model(1030, 2.69e-3),
    "XM430-W350": Model(1020, 2.69e-3),
    "XH430-V350": Model(1040, 1.34e-3),
}
"""Supported models. Model Number (0) is on the page of each model, and the unit is in the entry
Present Current (126). On the pages "XM430-W350" and "XH430-V350", this entry refers to Goal Current
(102) ("about 2.69 mA", "about 1.34 mA"). Other models of the X series have the same control table,
apart from the XL330, the XC330 and models without a current sensor."""
