"""Warning at the end of a session if many sensor records were lost."""

from itertools import count

import pytest

from softfin.core.errors import SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.rig import EmulatedRig
from softfin.rig.config import RigConfig
from softfin.rig.machine import Target
from softfin.rig.rig import Rig
from softfin.rig.safety import Guard
from softfin.rig.session import Session
from tests.rig.braking_fin import BrakingFin
from tests.rig.rigs import values_of


def warnings_of(transmit, is_stopped=False):
    """Return the warnings of a session with two motions and pauses in which softfin does not read
    the sensor."""
    clock = SimulatedClock()
    warnings = []
    with EmulatedRig(fin=BrakingFin(80.0, clock), clock=clock, sensor="lines") as behind:
        rig = Rig(RigConfig.build(values_of(behind)), clock)
        guard = Guard(rig.config.safety, rig.limits)
        with Session(rig, guard, warn=warnings.append) as session:
            clock.sleep(5.0)
            session.activate()
            behind.sensor.transmit = transmit
            session.hold(Target(1.0, 2.0), 100)
            session.deactivate()
            clock.sleep(5.0)
            session.activate()
            session.hold(Target(-1.0, 2.0), 100)
            if is_stopped:
                session.stop_request.ask("emergency_stop", "stopped by a key")
                with pytest.raises(SafetyStop):
                    session.tick()
            assert warnings == []
    return warnings


def every(period, instead):
    """Replace one line in each `period` lines with the lines in `instead`."""
    numbers = count(1)
    return lambda line: instead if next(numbers) % period == 0 else (line,)


@pytest.mark.parametrize("is_stopped", [False, True])
@pytest.mark.parametrize(
    ("period", "instead", "share"),
    [(2, (), "50%"), (50, (), "2%"), (20, (b"x\r\n",), "5%")],
)
def test_many_lost_or_unusable_records_cause_a_warning_with_their_share(
    period, instead, share, is_stopped
):
    (line,) = warnings_of(every(period, instead), is_stopped)
    assert line.startswith(f"force sensor: {share} of its records were lost or unusable (")
    assert line.endswith("then run: softfin rig check")


@pytest.mark.parametrize(
    "transmit", [lambda line: (line,), lambda line: (line, line), every(200, ())]
)
def test_few_lost_records_and_pauses_between_motions_cause_no_warning(transmit):
    assert warnings_of(transmit) == []
