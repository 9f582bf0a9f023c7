"""The ATI Axia80 force/torque sensor: its UDP stream as records for a `StreamedSensor`.

Scale and units come from the web pages of the sensor; the stream uses RDT (ATI manual
9610-05-Ethernet Axia). Tested with the emulator, which a third-party client can also read, but not
with a real sensor.
"""

import numpy as np

from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.device_type import ForceSensorType
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.axia80.pages import read_settings
from softfin.rig.devices.axia80.rdt import BUSY_BIT, RdtCommand, decode_status
from softfin.rig.devices.axia80.stream import Arrival, RdtClient
from softfin.rig.loss_estimate import wrapped_step
from softfin.rig.streamed_sensor import FIRST_WAIT_S, RecordSource, StreamedSensor, TimedWrench

RETRY_S = 0.1
"""Time without a record after which the stream is requested again [s]. UDP may lose a request, and
a restarted sensor does not send until requested."""

OLD_S = 0.5
"""Age at which a record is discarded, because it is too old to affect a usable force [s]."""

LATE_RECORDS = 64
"""Maximum number of records by which a record may be late; a later record belongs to a different
stream."""

REORDERED_SAMPLES = 4096
"""Maximum number of samples by which the sensor counter may go back without a restart: half a
second at 8 kHz."""

MAX_GAP = 1 << 24
"""Maximum gap [records or samples]: half an hour at 8 kHz."""


def axia80_sensor(config: Axia80Config, clock: Computer = COMPUTER) -> StreamedSensor:
    """Create an Axia80."""
    return StreamedSensor(config, RdtSource(config, clock), clock)


class RdtSource(RecordSource):
    """The stream of one sensor."""

    unit = "record"
    remedy = "check its power and cable, and make sure that no other program reads it"
    constant_s = 0.1
    """Time for which a channel may keep its value [s]. The noise of an Axia80 is thousands of
    counts (not verified), so even two equal consecutive records are rare."""

    def __init__(self, config: Axia80Config, clock: Computer) -> None:
        # The sensor streams only to the latest client, so a second program would cut off the first.
        super().__init__(config.address, config.address, config.rdt_port)
        self.config = config
        self.clock = clock
        self._client: RdtClient | None = None
        self._reset()

    def _reset(self) -> None:
        self.counted.clear()
        self.status = 0
        """Status bits set in any of the latest records."""
        self._product = ""
        self._scale = np.ones(6)
        self._newest: Arrival | None = None
        self._is_first_burst = self._is_new_stream = True
        self._has_restarted = False
        self._num_busy = 0
        """Number of consecutive latest records from a busy sensor."""
        self._missing = 0
        """Number of records lost or discarded since the latest returned record."""
        self._active_at = self.clock()
        """Time of the latest request or record [s]."""

    def open(self) -> None:
        """Read the sensor pages and request the stream; raises RigError if the sensor does not
        match the rig file, and DeviceError if it does not respond."""
        config = self.config
        clock = self.clock
        self._reset()
        settings = read_settings(config.address, config.http_port, clock)
        self._product = settings.prodname
        self._scale = np.array(settings.scale)
        # A restart clears any zero that was set in the sensor, which makes softfin's zero wrong.
        self.identity = {"serial": settings.calsn, "own_zero": settings.setbias}
        self._client = RdtClient(config.address, config.rdt_port, clock)
        self._request()

    def take(self) -> list[TimedWrench]:
        """Return the usable records that have arrived; request the stream again if it has ended."""
        client = self._open_client()
        arrivals = client.drain()
        self.counted["refused_datagrams"] = client.refused
        now = self.clock()
        if not arrivals:
            if now - self._active_at >= RETRY_S:
                self._request()
            return []
        self._active_at = now
        if self._is_first_burst:
            # Linux enables timestamps with a delay, so the first timestamps may be too late.
            self._is_first_burst = False
            return []
        self.status = 0
        self.counted["records"] += len(arrivals)
        records = []
        for record, time in arrivals:
            self.status |= record.status
            if not self._advance(Arrival(record, time)):
                # The record is out of order or duplicated, which does not happen on a single cable.
                self.counted["late"] += 1
            elif self._num_busy:
                # The values of the record may be outdated.
                self._missing += 1
            elif now - time > OLD_S:
                self.counted["discarded"] += 1
                self._missing += 1
            else:
                records.append(TimedWrench(self._scale * record.counts, self._missing, time))
                self._missing = 0
        return records

    def describe(self) -> str:
        """Return the product."""
        return self._product

    def explain_silence(self) -> str:
        """Return a text that states that the sensor is busy, or what to check."""
        config = self.config
        if self._num_busy:
            return (
                f"busy for more than {FIRST_WAIT_S:g} s; do not use its web pages; if it stays "
                "busy, switch it off and on"
            )
        return (
            f"its web page on port {config.http_port} works, but no record arrived from UDP port "
            f"{config.rdt_port} within {FIRST_WAIT_S:g} s ({self._open_client().refused} malformed "
            "datagrams); check rdt_port, the RDT setting on the sensor's communication page, and "
            "the firewall"
        )

    def complaints(self) -> list[str]:
        """Return the errors in the status of the latest records, including a restart and a long
        busy state."""
        lines = [str(bit) for bit in decode_status(self.status) if bit.is_error]
        if self._has_restarted:
            lines.append("restarted; check its supply and cable, then start again")
        if self._num_busy > self.constant_s * self.config.rate_hz:
            lines.append("busy for too long; do not use its web pages")
        return lines

    def notes(self) -> tuple[str, ...]:
        """Return notes on sensor states that do not stop the fin, e.g. that the forces are
        simulated."""
        return tuple(str(bit) for bit in decode_status(self.status) if not bit.is_error)

    def close(self) -> None:
        """Stop the stream and close the socket; may be called repeatedly and never raises."""
        if self._client is not None and not self._client.closed:
            self._client.send(RdtCommand.STOP)
            self._client.close()
        self.status = 0

    def _open_client(self) -> RdtClient:
        assert self._client is not None, "StreamedSensor uses open sources only"
        return self._client

    def _request(self) -> None:
        """Request a new stream, whose sequence numbers start again."""
        self._open_client().send(RdtCommand.START)
        self._active_at = self.clock()
        self._is_new_stream = True

    def _advance(self, arrival: Arrival) -> bool:
        """Count a record; return False if it is not newer than the previous records."""
        record = arrival.record
        steps = 1
        if self._newest is not None:
            before = self._newest.record
            steps = wrapped_step(before.rdt_sequence, record.rdt_sequence)
            if self._is_new_stream or not -LATE_RECORDS <= steps <= MAX_GAP:
                # The number of records between two streams can only be estimated from the time;
                # they are not counted as lost.
                elapsed_s = arrival.time - self._newest.time
                self._missing += max(round(elapsed_s * self.config.rate_hz) - 1, 0)
                steps = 1
            if steps <= 0:
                return False
            samples = wrapped_step(before.ft_sequence, record.ft_sequence)
            # Only a restart sets back the sensor counter.
            self._has_restarted |= not -REORDERED_SAMPLES <= samples <= MAX_GAP
        self._newest = arrival
        self._is_new_stream = False
        self.counted["lost"] += steps - 1
        self._missing += steps - 1
        self._num_busy = self._num_busy + 1 if record.status >> BUSY_BIT & 1 else 0
        return True


AXIA80 = ForceSensorType(Axia80Config, axia80_sensor)
"""The type `axia80`."""
