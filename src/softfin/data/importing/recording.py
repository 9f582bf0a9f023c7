"""A recording as it was found: channels by name on one clock or several, before any of it is moved to 100 Hz."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.core.quantities import Log
from softfin.data.checks.findings import Finding

Part = Literal["train", "test"]

Channels = dict[str, Float[np.ndarray, "rows"]]
"""By name."""


class Track(NamedTuple):
    """Channels that share a clock: a whole table, or one topic of a bag."""

    time: Float[np.ndarray, "rows"]
    """[s], as recorded: it may repeat, jump and lack values."""
    channels: Channels
    """SI units and softfin's axes; NaN where there is no value."""


class Recording(NamedTuple):
    """One log, as yet unchecked."""

    name: str
    part: Part
    tracks: tuple[Track, ...]
    findings: tuple[Finding, ...] = ()
    """Of its reading."""
    time_unit: str = "s"
    """That its clock was read in; the tracks' times are in seconds."""


class NamedLog(NamedTuple):
    """A log at 100 Hz, and what it is called."""

    name: str
    part: Part
    log: Log
    start_s: float = 0.0
    """What the recording's clock said at the log's time 0 [s]."""
