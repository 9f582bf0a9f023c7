"""What tests of robots share: U-CAT, its fins' gaits and the simulation, made once a run."""

import pytest

from softfin.robot.description import load_robot
from softfin.robot.evaluate import gaits_of
from softfin.robot.simulation import RobotSimulation
from softfin.tank import Tank


@pytest.fixture(scope="session")
def ucat():
    return load_robot("ucat")


@pytest.fixture(scope="session")
def gaits():
    return gaits_of([Tank()] * 4)


@pytest.fixture(scope="session")
def simulation(ucat):
    return RobotSimulation(ucat, [Tank()] * 4)
