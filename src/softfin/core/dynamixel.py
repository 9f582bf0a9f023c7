"""Units of the registers of a Dynamixel of the X series, for its driver and for logs of registers.

Source: ROBOTIS e-Manual, the control tables on the pages "XM430-W210", "XM430-W350" and
"XH430-V350", and the pages on single entries to which they link. None of it has been measured.
"""

from typing import NamedTuple

CENTER = 2048
"""Position in the middle of the turn, which softfin uses as the fin's zero."""

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
"""Supported models. Model Number (0) is printed on the page of each model, and the unit as that of
Present Current (126) or, on the pages "XM430-W350" and "XH430-V350", of Goal Current (102), to
which Present Current refers ("about 2.69 mA", "about 1.34 mA"). Others of the X series have the
same control table, apart from the XL330 and XC330, and those without a current sensor."""
