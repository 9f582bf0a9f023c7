"""A fin whose range excludes angle 0, from the tank to its controller, small."""

import jax
import numpy as np
import pytest

from softfin.control.store import load_controller
from softfin.core.plant import roll
from softfin.core.quantities import Command
from softfin.storage.dataset import Dataset
from softfin.surrogate import load_surrogate
from softfin.tank import Tank, TankConfig
from tests.end_to_end.test_stages import run, write
from tests.staged import COARSE, MAP, STREAMING, TRAIN, short_search  # noqa: F401  # pytest finds fixtures here

LOW = 0.2
HIGH = 1.2
SIDEWAYS = COARSE | {
    "drive": {"angle_min_rad": LOW, "angle_max_rad": HIGH},
    "sensor": {"noise_n": 0, "drift_n": 0},
}


@pytest.mark.usefixtures("short_search")
def test_a_fin_that_cannot_reach_angle_0_starts_at_the_end_of_its_range(capsys, tmp_path):
    tank = write(tmp_path / "tank.yaml", SIDEWAYS)
    dataset, surrogate, gaits, controller = (
        str(tmp_path / name) for name in ("dataset", "surrogate", "gaits", "controller")
    )
    logs = ("--logs", "3", "--test-logs", "1", "--rows", "700")
    run(capsys, "collect", "--plant", tank, *logs, "--out", dataset)
    data = Dataset.open(tmp_path / "dataset")
    for log in data.load([*data.train, *data.test]):
        assert abs(log.reading.angle[0] - LOW) < 0.03
        assert min(log.command.angle) >= LOW - 1e-6
        assert min(log.reading.angle) > LOW - 0.1
    fitting = write(tmp_path / "fit.yaml", STREAMING | {"force_updates": 200})
    fitted = run(capsys, "fit", dataset, "--config", fitting, "--out", surrogate)
    assert fitted["issues"]["error"] == 0
    assert fitted["issues"]["warning"] >= 1
    plant = load_surrogate(tmp_path / "surrogate")
    assert LOW - 1e-6 <= plant.limits.rest_angle < LOW + 0.1
    searching = write(tmp_path / "map.yaml", MAP | {"box": None, "spacing_n": None, "nodes": 4})
    run(capsys, "map", surrogate, "--config", searching, "--out", gaits)
    training = write(tmp_path / "train.yaml", TRAIN)
    run(capsys, "train", surrogate, "--config", training, "--out", controller)
    trained = load_controller(tmp_path / "controller")
    assert trained.limits == plant.limits
    words = ("--plant", tank, "--seconds", "3", "--repeats", "1")
    judged = run(capsys, "evaluate", controller, *words, "--out", str(tmp_path / "judged"))
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
