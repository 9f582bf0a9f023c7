"""What tests of robots share."""

import pytest

from softfin.robot.description import load_robot


@pytest.fixture(scope="session")
def ucat():
    return load_robot("ucat")
