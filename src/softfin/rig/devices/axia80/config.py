"""Configuration of the force sensor in a rig's file."""

from typing import Literal

import pydantic

from softfin.core.configuration import Configuration
from softfin.data.importing.importing import FORCE_FRAMES

ADDRESS_FIELDS = ("address", "http_port", "rdt_port")
"""Fields that only define the sensor's address, which may change at any time; the others affect the
readings."""


class Axia80Config(Configuration):
    """An ATI Axia80 with an Ethernet interface; the address and the ports default to its factory
    settings."""

    address: str = pydantic.Field(min_length=1)
    """IP address or host name of the sensor; the factory setting is 192.168.1.1."""
    frame: Literal[FORCE_FRAMES]  # type: ignore[valid-type]
    """Sensor axes along softfin's +x (forward thrust on the robot) and +y, e.g. ``y,-x``; z follows
    from the right-hand rule. No default, because it depends on how the sensor is mounted."""
    http_port: int = pydantic.Field(default=80, ge=1, le=65535)
    """TCP port of the sensor's web pages, from which units and scale are read."""
    rdt_port: int = pydantic.Field(default=49152, ge=1, le=65535)
    """UDP port of the sensor's stream."""
    rate_hz: float = pydantic.Field(default=1000.0, ge=200, le=8000)
    """RDT output rate set in the sensor [Hz]; the default is ten records per log row, which leaves
    room for the filter. softfin measures the rate when it opens the sensor and rejects a deviation
    of more than 10%."""
    cutoff_hz: float = pydantic.Field(default=30.0, ge=10, le=40)
    """Cut-off frequency of the anti-alias filter (gain 1/2) [Hz]; 30 Hz passes signals below 10 Hz
    and delays the force by 34 ms."""
    product: str | None = None
    """Product name that the sensor must report; None accepts any."""
    serial: str | None = None
    """Calibration serial number that the sensor must report; None accepts any."""
