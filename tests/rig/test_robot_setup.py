import pytest
import yaml

from softfin.control.feedback import FeedbackConfig
from softfin.core.configuration import Changes, configure
from softfin.core.errors import RigError
from softfin.core.quantities import PAPER_LIMITS, Limits
from softfin.rig.rig import Rig
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.safety import SafetyConfig
from softfin.stages.driving import RunConfig
from softfin.stages.machines import find_robot
from tests.rig.machines import FreeFin
from tests.rig.test_config import VALUES, written

LIMITS = Limits(*map(float, PAPER_LIMITS))


def robot(fin="blue"):
    return RobotSetup(FreeFin(), SafetyConfig(), fin)


def test_a_controller_of_this_fin_within_its_limits_fits():
    robot().check_fits("c", LIMITS, "blue")
    robot().check_fits("c", LIMITS, None)
    robot(None).check_fits("c", LIMITS, "blue")


def test_a_controller_of_another_fin_is_refused():
    with pytest.raises(
        RigError,
        match="c: trained for fin 'red', but this rig has fin 'blue'; train a controller for this fin",
    ):
        robot().check_fits("c", LIMITS, "red")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"angle_max": 1.8},
            r"an? angle of -1\.5708 \.\. 1\.8 rad; free fin accepts -1\.5708 \.\. 1\.5708",
        ),
        ({"angle_min": -1.8}, "angle"),
        ({"velocity_min": 0.5}, "velocity of 0.5"),
        ({"velocity_max": 4.0}, "velocity of 1 .. 4 rad/s"),
    ],
)
def test_a_controller_that_commands_more_than_the_machine_takes_is_refused(change, words):
    with pytest.raises(RigError, match=words):
        robot().check_fits("c", LIMITS._replace(**change), None)


def test_an_option_overrides_the_rig_file_even_if_it_equals_the_default():
    setup = RobotSetup(
        FreeFin(), SafetyConfig(), feedback=FeedbackConfig(drift_n=0.2, drift_s=60.0)
    )
    typed = Changes(None, {"--feedback.drift-n": str(FeedbackConfig().drift_n)})
    settings = configure(RunConfig(), typed, feedback={})
    assert setup.feedback_settings(settings.feedback) == FeedbackConfig(drift_s=60.0)
    assert setup.feedback_settings(FeedbackConfig()) == setup.feedback
    assert setup.feedback_settings(None) is None


def test_a_rig_is_found_by_its_file_without_being_opened(tmp_path):
    robot = find_robot(f"rig:{written(tmp_path)}")
    assert isinstance(robot.machine, Rig)
    assert (robot.fin, robot.machine.name) == ("blue", "rig of blue")
    assert robot.configuration["sensor"]["address"] == "192.168.1.1"
    assert robot.machine.counters()["drive_targets_repeated"] == 0


def test_the_file_beside_one_is_the_default(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(VALUES))
    assert find_robot("rig").fin == "blue"
    with pytest.raises(RigError, match=r"ros2\.yaml: cannot be read \(No such file"):
        find_robot("ros2")


def test_another_name_says_what_there_is():
    with pytest.raises(
        RigError, match="plant tank: not a real fin; use rig or ros2, optionally with :FILE"
    ):
        find_robot("tank")
