"""What tests of robots share: U-CAT, its fins' gaits and the simulation, made once a run."""

import pytest

from softfin.robot.description import RobotConfig, load_robot
from softfin.robot.evaluate import find_all_gaits
from softfin.robot.simulation import RobotSimulation
from softfin.tank import Tank


@pytest.fixture(scope="session")
def ucat():
    return load_robot("ucat")


@pytest.fixture(scope="session")
def sister(ucat):
    """U-CAT with the body of its laboratory's simulator in its first release (eeUVsim_Gazebo
    v1.0.0), with z up.

    It has little drag along the nose, and a centre of gravity far from the origin: roll and sway
    are coupled. The simulator's inertia about the origin is split so that inertia and added mass
    are those of a rigid body.
    """
    body = {
        "mass_kg": 20,
        "inertia_kg_m2": [0.05, 0.40, 0.42],
        "added_mass": [40, 21, 2, 0.0343, 1.2652, 2.5864],
        "drag_linear": [6.542, 100.7, 30.61, 0, 0, 0.313],
        "drag_quadratic": [2.98, 260, 161, 3.4244, 2.1014, 0.7226],
        "centre_of_gravity_m": [0, 0, 0.1],
        "centre_of_buoyancy_m": [0, 0, 0.2],
    }
    return RobotConfig.build(
        {**ucat.model_dump(mode="json"), "name": "sister", "body": body}, "test"
    )


@pytest.fixture(scope="session")
def gaits():
    return find_all_gaits([Tank()] * 4)


@pytest.fixture(scope="session")
def simulation(ucat):
    return RobotSimulation(ucat, [Tank()] * 4)
