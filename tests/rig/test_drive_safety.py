"""The last steps of a stop, which all drives share."""

from softfin.core.errors import DeviceError
from softfin.emulation.clock import SimulatedClock
from softfin.rig.drive_safety import stays_off


def test_a_drive_that_falls_silent_is_reported_as_unconfirmed_within_seconds():
    clock = SimulatedClock()

    def is_off():
        clock.sleep(0.5)
        raise DeviceError("no answer")

    began = clock()
    assert not stays_off(clock, is_off, 0.01)
    assert clock() - began < 3.0
