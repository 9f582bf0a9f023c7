"""First calls from Python, with arguments that look right."""

from pathlib import Path

import jax
import pytest

import softfin
from softfin.core.errors import CommandError, ConfigurationError, PlantError, RunError
from tests.control.folders import folder_option


@pytest.fixture(scope="module")
def controller(tmp_path_factory):
    folder = folder_option("single", tmp_path_factory.mktemp("controller"))
    return softfin.load_controller(str(folder))


@pytest.mark.parametrize(
    "call",
    [
        lambda loaded: softfin.fit("logs", Path("s")),
        lambda loaded: softfin.fit("logs", out="s", epochs=3),
        lambda loaded: softfin.export(loaded),
        lambda loaded: softfin.evaluate(loaded, plant="tank"),
        lambda loaded: softfin.evaluate("controller", loaded),
        lambda loaded: softfin.inspect_logs(3),
        lambda loaded: softfin.load_surrogate(None),
        lambda loaded: softfin.map_forces("tank", out="m", config=[1]),
        lambda loaded: softfin.CollectConfig(log=3),
        lambda loaded: softfin.TankConfig(sensor={"noise": 1}),
    ],
)
def test_wrong_arguments_are_errors_of_one_line(call, controller):
    with pytest.raises(ConfigurationError) as raised:
        call(controller)
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith(("softfin.", "config: ", "CollectConfig", "TankConfig"))


def test_a_misspelt_key_of_a_configuration_suggests_the_right_one():
    with pytest.raises(ConfigurationError, match="did you mean 'logs'"):
        softfin.CollectConfig(log=3)
    with pytest.raises(ConfigurationError, match="did you mean 'noise_n'"):
        softfin.TankConfig(sensor={"noise": 1})


@pytest.mark.parametrize("plant", ["tank", "surrogate"])
def test_a_plant_says_what_a_key_and_a_command_are(plant, tmp_path):
    softfin.write_example(tmp_path / "example")
    plant = softfin.find_plant("tank" if plant == "tank" else tmp_path / "example" / plant)
    with pytest.raises(PlantError, match=r"jax\.random\.key\(0\)"):
        plant.init(0)
    state = plant.init(jax.random.key(0))
    with pytest.raises(CommandError, match=r"softfin\.Command\(angle, velocity\)"):
        plant.advance(state, (0.1, 2.0), 33)


@pytest.mark.parametrize(
    ("measured", "reference"),
    [((0.0, 0.0), (1.0, 0.0)), (None, (1.0, 0.0)), ((0.0, (0.0, 0.0)), 3.0)],
)
def test_a_controller_says_what_a_measurement_is(measured, reference, controller):
    with pytest.raises(RunError, match=r"\(angle, \(force_x, force_y\)\)"):
        controller.act(controller.init(), measured, reference)
