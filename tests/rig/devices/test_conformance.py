"""softfin's own devices meet their contracts, and the kit notices those that do not."""

import pytest

from softfin.core.errors import RigError
from softfin.rig.config import RigConfig
from softfin.rig.rig import Rig
from softfin.testing import check_drive, check_force_sensor
from tests.rig.rigs import simulated, values_of


@pytest.fixture
def bench():
    with simulated() as behind:
        config = RigConfig.build(behind.values() | {"drive": values_of(behind)["drive"]})
        rig = Rig(config, behind.clock)
        yield behind, rig
        rig.close()


def test_the_axia80_meets_the_contract_of_a_force_sensor(bench):
    behind, rig = bench
    check_force_sensor(rig.sensor, behind.sensor.silence)


def test_the_epos2_meets_the_contract_of_a_drive(bench):
    behind, rig = bench
    check_drive(rig.drive, behind.clock)


def test_a_sensor_whose_time_stands_still_is_refused(bench):
    _, rig = bench
    first = []
    read = rig.sensor.read

    def frozen():
        first.append(read())
        return first[0]

    rig.sensor.read = frozen
    with pytest.raises(RigError, match=r"force_time is .* s ago|force_time does not change"):
        check_force_sensor(rig.sensor)


def test_a_drive_that_accepts_commands_while_it_is_off_is_refused(bench):
    behind, rig = bench
    rig.drive.command = lambda target: None
    with pytest.raises(RigError, match="accepted a command before it was enabled"):
        check_drive(rig.drive, behind.clock)
