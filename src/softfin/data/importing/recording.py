"""A recording as it was found: channels by name on one clock or several, before any of it is moved to 100 Hz."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from softfin.core.quantities import Log
from softfin.data.issues import Issue

Part = Literal["train", "test"]

Channels = dict[str, Float[np.ndarray, "rows"]]
"""Values by the channel's name."""


class Track(NamedTuple):
    """Channels that share a clock: a whole table, or one topic of a bag."""

    time: Float[np.ndarray, "rows"]
    """Time as recorded [s]: it may repeat, jump and lack values."""
    channels: Channels
    """Values in SI units and softfin's axes; NaN where there is none."""

    def take(self, rows: slice | Bool[np.ndarray, "rows"]) -> "Track":
        """Keep some of the rows."""
        return Track(self.time[rows], {name: values[rows] for name, values in self.channels.items()})


class Recording(NamedTuple):
    """One recording, as yet unchecked."""

    name: str
    part: Part
    tracks: tuple[Track, ...]
    issues: tuple[Issue, ...] = ()
    """Issues that were met in reading it."""


class NamedLog(NamedTuple):
    """A log at 100 Hz with its name."""

    name: str
    part: Part
    log: Log
    start_s: float = 0.0
    """Time of the recording's clock at the log's time 0 [s]."""
