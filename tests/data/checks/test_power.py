"""Torques and currents with which power would be wrong."""

import numpy as np
import pytest

from softfin.core.quantities import Log
from softfin.data.checks.inspection import inspect
from softfin.data.collect import CollectConfig, collect_logs
from softfin.data.importing.importing import ImportConfig
from softfin.tank import Tank
from tests.data.faulty import named


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Log:
    """Of the tank, with torque and current."""
    config = CollectConfig(logs=1, test_logs=0, rows=3000, seed=2, channels=True)
    dataset = collect_logs(Tank(), config, tmp_path_factory.mktemp("power") / "data")
    return next(iter(dataset.load(dataset.train)))


def found(log: Log, config: ImportConfig | None = None, **channels: np.ndarray) -> dict[str, str]:
    """The fixes by name of the issues of the log with these channels."""
    changed = log._replace(channels={**log.channels, **channels})
    issues = inspect(named(changed, test=0), config=config).issues
    return {one.name: one.fix for one in issues if one.name != "no test logs"}


def test_power_of_the_tank_has_no_fault(log):
    assert not found(log)


def test_a_torque_of_the_wrong_sign_is_told_with_the_option(log):
    reversed_ = -log.channels["torque_nm"] + 0.3
    assert found(log, torque_nm=reversed_) == {"torque sign": "--negate torque"}
    negated = ImportConfig(negate=("torque",))
    assert found(log, negated, torque_nm=reversed_) == {"torque sign": "remove --negate"}


def test_a_torque_that_is_only_noise_has_no_sign(log):
    random = np.random.default_rng(4)
    for _ in range(8):
        noise = random.normal(0, 0.01, len(log.reading.time)).astype(np.float32)
        assert "torque sign" not in found(log, torque_nm=noise)


def test_a_torque_that_is_almost_never_measured_is_not_judged(log):
    torque = np.full(len(log.reading.time), np.nan, np.float32)
    torque[-5:] = [0.1, 0.2, 0.1, 0.3, 0.2]
    assert not {"torque unit", "torque axis", "torque sign"} & set(found(log, torque_nm=torque))


def test_missing_values_hide_no_fault(log):
    torque = 1000 * log.channels["torque_nm"]
    torque[500] = np.nan
    assert "1,000" in found(log, torque_nm=torque)["torque unit"]


def test_a_log_without_forces_has_no_lever(log):
    still = log._replace(reading=log.reading._replace(force=0 * log.reading.force))
    assert not {"torque unit", "torque axis", "torque sign"} & set(found(still))


def test_a_torque_in_newton_millimetres_is_told(log):
    assert "1,000" in found(log, torque_nm=1000 * log.channels["torque_nm"])["torque unit"]


def test_a_torque_about_another_axis_is_told(log):
    # The sensor is 0.2 m below the fin and also has its own noise.
    noise = np.random.default_rng(0).normal(0, 0.005, len(log.reading.force))
    across = -0.2 * np.asarray(log.reading.force)[:, 1] + noise
    assert "--columns torque=" in found(log, torque_nm=across)["torque axis"]


@pytest.mark.parametrize("column", ["torque_nm", "current_a"])
def test_a_constant_column_is_told(log, column):
    constant = np.full(len(log.reading.time), 0.5, np.float32)
    assert found(log, **{column: constant}) == {"constant": "remove the column"}


def test_a_log_without_these_columns_has_no_power_and_no_fault(log):
    assert not inspect(named(log._replace(channels={}), test=0)).issues[1:]
