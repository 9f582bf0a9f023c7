"""Configuration of the force sensor in a rig's file."""

import math
from typing import Literal

import pydantic

from softfin.rig.device import ForceSensorConfig
from softfin.rig.filter import BRIDGED_S, design


class Axia80Config(ForceSensorConfig):
    """An ATI Axia80 with an Ethernet interface; the address and the ports default to its factory
    settings."""

    type: Literal["axia80"] = "axia80"
    """An Axia80."""
    address: str = pydantic.Field(min_length=1)
    """IP address or host name of the sensor; the factory setting is 192.168.1.1."""
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

    def check_stale(self, force_stale_s: float) -> None:
        """Raise ValueError if the filter delays the force by too much for a limit on its age
        [s]."""
        # The delay of a symmetric filter is half its length.
        delay = len(design(self.rate_hz, self.cutoff_hz)) // 2 / self.rate_hz
        # After a gap too long to bridge, the filter takes twice its delay to refill, and the latest
        # force is one delay older than the gap. A shorter limit would stop the fin because of a
        # dozen lost records.
        needed = 3 * delay + 2 * BRIDGED_S
        if force_stale_s < needed:
            least = math.ceil(100 * needed) / 100
            raise ValueError(
                f"safety.force_stale_s = {force_stale_s:g}: the force filter alone "
                f"delays by {delay:.3f} s, and by three times that after lost records; use "
                f"{least:.2f} or more, or a higher sensor.cutoff_hz"
            )
