"""What a rig's file says of its force sensor, and the turn from the sensor's axes to softfin's."""

from typing import Literal

import numpy as np
import pydantic
from jaxtyping import Float

from softfin.core.configuration import Configuration
from softfin.data.importing.importing import FORCE_FRAMES
from softfin.rig import filter as anti_alias


class SensorConfig(Configuration):
    """An ATI Axia80 with an Ethernet socket; the defaults are those of the sensor as it is delivered."""

    address: str = pydantic.Field(min_length=1)
    """IP address or name of the sensor; a new one has 192.168.1.1."""
    frame: Literal[FORCE_FRAMES]  # type: ignore[valid-type]
    """What is softfin's +x (thrust that pushes the robot forward) and +y in the sensor's own axes, as ``y,-x``; z
    follows by the right hand. It depends on how the sensor is mounted, so there is no default."""
    http_port: int = pydantic.Field(default=80, ge=1, le=65535)
    """Of the sensor's web pages, where its units and scale are read."""
    rdt_port: int = pydantic.Field(default=49152, ge=1, le=65535)
    """Of its stream (UDP)."""
    rate_hz: float = pydantic.Field(default=1000.0, ge=200, le=8000)
    """Records a second that the sensor is set to send [Hz]; ten for each row of a log leaves room for the filter. The
    rate is measured when the sensor is opened, and refused where it is 10% away."""
    cutoff_hz: float = pydantic.Field(default=30.0, ge=10, le=40)
    """Of the anti-alias filter, where its gain is 1/2 [Hz]; 30 passes what is below 10 Hz and costs 34 ms of delay."""
    product: str | None = None
    """Product name that the sensor must give; None takes any."""
    serial: str | None = None
    """Serial number of its calibration that the sensor must give; None takes any."""
    bias_on_open: bool = False
    """Set the sensor's own zero when it is opened: only with the fin at rest in still water."""

    @pydantic.model_validator(mode="after")
    def _filterable(self) -> "SensorConfig":
        if len(anti_alias.design(self.rate_hz, self.cutoff_hz)) / self.rate_hz > 0.25:
            raise ValueError(f"cutoff_hz = {self.cutoff_hz} delays the force too much; take 12 to 40")
        return self


def rotation(frame: str) -> Float[np.ndarray, "3 3"]:
    """Turns vectors, forces and torques alike, from the sensor's axes into softfin's: a rotation whatever the frame.

    Where the frame mirrors x and y, as ``y,x`` does, the sensor looks the other way, so its z is turned round.
    """
    rows = [_axis(name) for name in frame.split(",")]
    return np.array([*rows, np.cross(rows[0], rows[1])])


def _axis(name: str) -> Float[np.ndarray, "3"]:
    axis = np.zeros(3)
    axis["xy".index(name[-1])] = -1.0 if name.startswith("-") else 1.0
    return axis
