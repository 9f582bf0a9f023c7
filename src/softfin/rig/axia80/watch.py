"""Faults of an Axia80's stream that its status bits do not show: a restart, values that stand
still, busy for long.

Pure: records go in, lines for people come out. A record has the sensor's own count of its samples
(`ft_sequence`), which only its power switch resets.
"""

from softfin.rig.axia80.rdt import BUSY_BIT, RdtRecord, wrapped_step

FROZEN_S = 0.1
"""Time for which values may be the same in all six channels, or the sensor busy [s]. From memory,
the noise of an Axia80 is thousands of counts, so that two equal records in a row are rare
already."""

REORDERED_SAMPLES = 4096
"""Samples by which the sensor's count may go back without a restart: half a second."""

RATE_MEASURED_S = 0.3
"""Shortest duration over which the rate of the sensor's count is measured [s]."""

RATE_ERROR = 0.02
"""Relative error of that rate."""

HELD_UP_S = 1.0
"""Time by which records may be held up on their way [s]: their counts then do not fit the time
between them."""


MAX_STEP_S = 60.0
"""Step ahead of the count that no record which was held up explains [s]."""


class StreamWatch:
    """Watches records in their order."""

    def __init__(self, rate_hz: float) -> None:
        self.has_restarted = False
        """Whether the sensor restarted since the stream was opened."""
        self._stuck_records = round(FROZEN_S * rate_hz)
        self._equal_counts = self._equal_samples = self._busy = 0
        self._began = 0.0
        """When the first record arrived [s]."""
        self._samples = 0
        """Samples that the sensor has counted since then."""
        self._newest: tuple[RdtRecord, float] | None = None

    @property
    def ft_sequence(self) -> int:
        """The sensor's count of samples at the newest record; 0 before the first."""
        return 0 if self._newest is None else self._newest[0].ft_sequence

    @property
    def ft_rate_hz(self) -> float:
        """Measured rate of the sensor's count [Hz]; 0 before it is known."""
        duration = 0.0 if self._newest is None else self._newest[1] - self._began
        return self._samples / duration if duration >= RATE_MEASURED_S else 0.0

    @property
    def is_busy(self) -> bool:
        """Whether the sensor has been busy for too long."""
        return self._busy > self._stuck_records

    def take(self, record: RdtRecord, time: float) -> None:
        """Take a record that arrived at a time [s] and is newer than those before."""
        self._busy = self._busy + 1 if record.status >> BUSY_BIT & 1 else 0
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
        self._equal_samples = self._equal_samples + 1 if samples == 0 else 0
        self._equal_counts = self._equal_counts + 1 if record.counts == before.counts else 0

    def _fits(self, samples: int, elapsed_s: float) -> bool:
        """Whether the count went on by as many samples as the time since the record before brings.

        A restart in a pause may be long past, so that the count is higher than before it: samples
        are missing then. And after three days a count is so high that one from 0 looks like a step
        ahead. Records that were held up together look like more samples than the time brings, which
        is not a restart.
        """
        rate_hz = self.ft_rate_hz
        if rate_hz <= 0:
            return True
        missing_s = elapsed_s - samples / rate_hz
        return -MAX_STEP_S <= missing_s <= HELD_UP_S + RATE_ERROR * elapsed_s

    def accept_restart(self) -> None:
        """The sensor's zero was set since: an earlier restart no longer matters."""
        self.has_restarted = False

    def lines(self) -> list[str]:
        """Return each fault as a line that ends with a fix."""
        lines = []
        if self.has_restarted:
            # Force limits and controller would work with the load of its mount as an offset.
            lines.append(
                "restarted, its zero is lost; let the fin rest and run: softfin rig zero --force"
            )
        if max(self._equal_counts, self._equal_samples) >= self._stuck_records:
            # Records still arrive, but force limits and controller would use a frozen value.
            lines.append(
                "its values are frozen; switch it off and on, then run: softfin rig zero --force"
            )
        if self.is_busy:
            lines.append(
                "it has been busy for too long, and its values may be old; do not use its web pages"
            )
        return lines
