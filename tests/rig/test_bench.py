import pytest

from softfin.core.errors import RigError
from softfin.core.quantities import PAPER_LIMITS, Limits
from softfin.rig.bench import Bench, check_fits
from softfin.rig.safety import SafetyConfig
from tests.rig.machines import FreeFin

LIMITS = Limits(*map(float, PAPER_LIMITS))


def bench(fin="blue"):
    return Bench(FreeFin(), SafetyConfig(), fin)


def test_a_controller_of_this_fin_within_its_limits_fits():
    check_fits("c", LIMITS, "blue", bench())
    check_fits("c", LIMITS, None, bench())
    check_fits("c", LIMITS, "blue", bench(None))


def test_a_controller_of_another_fin_is_refused():
    with pytest.raises(RigError, match="c: trained for the fin 'red'; this rig's is 'blue'; train one for it"):
        check_fits("c", LIMITS, "red", bench())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"angle_max": 1.8}, r"an? angle of -1\.5708 \.\. 1\.8 rad; free fin takes -1\.5708 \.\. 1\.5708"),
        ({"angle_min": -1.8}, "angle"),
        ({"velocity_min": 0.5}, "velocity of 0.5"),
        ({"velocity_max": 4.0}, "velocity of 1 .. 4 rad/s"),
    ],
)
def test_a_controller_that_commands_more_than_the_machine_takes_is_refused(change, words):
    with pytest.raises(RigError, match=words):
        check_fits("c", LIMITS._replace(**change), None, bench())
