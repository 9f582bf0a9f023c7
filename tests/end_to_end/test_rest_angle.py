"""A fin whose range excludes angle 0, from the tank to its controller, small."""

import jax
import numpy as np
import pytest
import yaml

from softfin.control.controller import Measured
from softfin.control.store import load_controller
from softfin.core.plant import roll
from softfin.core.quantities import PAPER_LIMITS, Command
from softfin.evaluation.evaluate import EvaluateConfig, score_controller
from softfin.stages.collect import collect
from softfin.stages.controllers import train
from softfin.stages.surrogates import fit
from softfin.storage.dataset import Dataset
from softfin.surrogate import load_surrogate
from softfin.tank import Tank, TankConfig
from tests.plants import StrokeFin
from tests.staged import COARSE, STREAMING, short_search  # noqa: F401  # pytest finds fixtures here
from tests.stages.test_training import PPO

LOW = 0.2
HIGH = 1.2
SIDEWAYS = COARSE | {
    "drive": {"angle_min_rad": LOW, "angle_max_rad": HIGH},
    "sensor": {"noise_n": 0, "drift_n": 0},
}


class Sideways(StrokeFin):
    """A fin without dynamics and with this range."""

    @property
    def limits(self):
        return PAPER_LIMITS._replace(angle_min=LOW, angle_max=HIGH)


@pytest.mark.usefixtures("short_search")
def test_a_surrogate_of_logs_without_angle_0_rests_at_the_end_of_their_range(tmp_path):
    tank = tmp_path / "tank.yaml"
    tank.write_text(yaml.safe_dump(SIDEWAYS))
    collect(plant=str(tank), out=tmp_path / "dataset", logs=3, test_logs=1, rows=700)
    data = Dataset.open(tmp_path / "dataset")
    for log in data.load([*data.train, *data.test]):
        assert abs(log.reading.angle[0] - LOW) < 0.03
        assert min(log.command.angle) >= LOW - 1e-6
        assert min(log.reading.angle) > LOW - 0.1
    fitted = fit(tmp_path / "dataset", out=tmp_path / "surrogate", config=STREAMING)
    assert fitted["issues"]["error"] == 0
    assert fitted["issues"]["warning"] >= 1
    limits = load_surrogate(tmp_path / "surrogate").limits
    assert LOW - 1e-6 <= limits.rest_angle < LOW + 0.1


def test_a_controller_of_a_fin_that_cannot_reach_angle_0_stays_within_its_range(tmp_path):
    fin = Sideways()
    train(fin, out=tmp_path / "controller", config=PPO)
    controller = load_controller(tmp_path / "controller")
    assert controller.limits == fin.limits
    state = controller.init()
    for _ in range(9):
        state, command = controller.act(state, Measured(LOW, (0.0, 0.0)), (1.0, -1.0))
        assert LOW - 1e-6 <= command.angle <= HIGH + 1e-6
    config = EvaluateConfig(seconds=3, seeds=1, references=((1, -1),))
    judged = score_controller(controller, fin, config).summary()
    assert np.isfinite(judged["mean"]["x"]["error_n"])


@pytest.mark.parametrize(("low", "high", "rest"), [(LOW, HIGH, LOW), (-1.5, -0.3, -0.3)])
def test_a_tank_at_rest_stays_there_without_force(low, high, rest):
    drive = {"angle_min_rad": low, "angle_max_rad": high}
    sensor = {"noise_n": 0, "drift_n": 0}
    tank = Tank(TankConfig.build(COARSE | {"drive": drive, "sensor": sensor}, "tank"))
    still = Command(np.full(50, rest, np.float32), np.full(50, 1.0, np.float32))
    _, reading = roll(tank, tank.init(jax.random.key(0)), still)
    np.testing.assert_allclose(reading.angle, rest, atol=1e-4)
    np.testing.assert_allclose(reading.velocity, 0, atol=1e-4)
    np.testing.assert_allclose(reading.force, 0, atol=1e-3)
