"""Detection of faults that an Axia80's status bits do not report: a restart, frozen values, and a
long busy state.

Without I/O: records in, messages out. Each record contains the sensor's sample counter
(`ft_sequence`), which is reset only by a power cycle.
"""

import numpy as np

from softfin.rig.devices.axia80.rdt import BUSY_BIT, RdtRecord, wrapped_step
from softfin.rig.frozen import FrozenChannels
from softfin.rig.machine import WRENCH_CHANNELS

FROZEN_S = 0.1
"""Time for which a channel may stay constant, or the sensor may be busy [s]. The noise of an Axia80
is thousands of counts (not verified), so even two equal consecutive records are rare."""

SAMPLE_COUNTER = "sample counter"

REORDERED_SAMPLES = 4096
"""Number of samples by which the counter may go back without a restart: half a second at 8 kHz."""

RATE_MEASURED_S = 0.3
"""Shortest duration over which the counter's rate is measured [s]."""

RATE_ERROR = 0.02
"""Relative error of the measured rate."""

HELD_UP_S = 1.0
"""Time by which records may be delayed on their way [s]; their counters then do not match the time
between them."""


MAX_STEP_S = 60.0
"""Step of the counter that delayed records cannot explain [s]."""


class StreamWatch:
    """Fault detector, which processes the records in order of arrival."""

    def __init__(self, rate_hz: float) -> None:
        self.has_restarted = False
        """Whether the sensor has restarted since the stream was opened."""
        self._busy_records = round(FROZEN_S * rate_hz)
        self._busy = 0
        self._frozen = FrozenChannels((*WRENCH_CHANNELS, SAMPLE_COUNTER), self._busy_records)
        self._began = 0.0
        """Arrival time of the first record [s]."""
        self._samples = 0
        """Number of samples counted by the sensor since then."""
        self._newest: tuple[RdtRecord, float] | None = None

    @property
    def ft_sequence(self) -> int:
        """Sample counter in the latest record; 0 before the first."""
        return 0 if self._newest is None else self._newest[0].ft_sequence

    @property
    def ft_rate_hz(self) -> float:
        """Measured rate of the sample counter [Hz]; 0 until it is known."""
        duration = 0.0 if self._newest is None else self._newest[1] - self._began
        return self._samples / duration if duration >= RATE_MEASURED_S else 0.0

    @property
    def is_busy(self) -> bool:
        """Whether the sensor has been busy for too long."""
        return self._busy > self._busy_records

    def take(self, record: RdtRecord, time: float) -> None:
        """Process a record that arrived at `time` [s]; it must be newer than those before."""
        self._busy = self._busy + 1 if record.status >> BUSY_BIT & 1 else 0
        self._frozen.put(np.array((*record.counts, record.ft_sequence)))
        if self._newest is None:
            self._began = time
            self._newest = record, time
            return
        before, before_time = self._newest
        samples = wrapped_step(before.ft_sequence, record.ft_sequence)
        if samples < -REORDERED_SAMPLES or not self._fits(samples, time - before_time):
            self.has_restarted = True
        self._newest = record, time
        self._samples += samples

    def _fits(self, samples: int, elapsed_s: float) -> bool:
        """Return whether the counter advanced by the number of samples expected for the elapsed
        time [s].

        If the sensor restarted long ago in a pause, its counter may be higher than before the
        pause, but samples are missing. After three days, the counter is so high that a restart at 0
        looks like a step ahead. Records that were delayed together look like more samples than
        expected, which is not a restart.
        """
        rate_hz = self.ft_rate_hz
        if rate_hz <= 0:
            return True
        missing_s = elapsed_s - samples / rate_hz
        return -MAX_STEP_S <= missing_s <= HELD_UP_S + RATE_ERROR * elapsed_s

    def accept_restart(self) -> None:
        """Forget an earlier restart, because the sensor's zero has been set since."""
        self.has_restarted = False

    def lines(self) -> list[str]:
        """Return one line per fault, ending with its fix."""
        lines = []
        if self.has_restarted:
            # The load of the mount would be an offset in all forces that the limits and the
            # controller use.
            lines.append(
                "restarted, so its zero is lost; let the fin rest and run: softfin rig zero --force"
            )
        if names := self._frozen.names():
            # Records still arrive, but the force limits and the controller would use a frozen
            # value.
            lines.append(
                f"values are frozen ({', '.join(names)}); switch it off and on, then run: softfin "
                "rig zero --force"
            )
        if self.is_busy:
            lines.append(
                "busy for too long, so its values may be outdated; do not use its web pages"
            )
        return lines
