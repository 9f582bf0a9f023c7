"""Power of experiments in their scores."""

import numpy as np
import pytest

from softfin.core.power import mean_powers, power_cells, power_kind
from softfin.evaluation.experiment import ExperimentRecording
from softfin.evaluation.scores import mean_scores, score
from tests.evaluation.test_scores import record

RECORDING = record(np.full((400, 2), [1.5, -2.0]))


def with_power(watts) -> ExperimentRecording:
    shape = (*RECORDING.reading.angle.shape, 2)
    return RECORDING._replace(power=np.broadcast_to(np.asarray(watts, float), shape))


def test_the_mean_power_of_an_experiment_is_in_its_scores():
    power = mean_scores(score(with_power([2.0, 4.0])))["power"]
    assert power["mechanical"]["force_per_watt_n"] == pytest.approx(2.5 / 2)
    assert power_kind(power) == "electrical"
    assert power["electrical"]["force_per_watt_n"] == pytest.approx(2.5 / 4)
    assert power["electrical"]["per_minute_j"] == 240


def test_power_that_is_not_known_is_left_out():
    assert "power" not in mean_scores(score(RECORDING))
    assert list(mean_scores(score(with_power([2.0, np.nan])))["power"]) == ["mechanical"]
    assert mean_scores(score(with_power([np.nan, np.nan])))["power"] == {}


def test_some_missing_values_do_not_matter():
    """Up to half of an experiment, such as currents that did not arrive."""
    recording = with_power([2.0, 4.0])
    power = np.array(recording.power)
    power[:, :, :20, 1] = np.nan
    found = mean_scores(score(recording._replace(power=power)))["power"]
    assert found["electrical"]["mean_w"] == 4.0
    power[:, :, :300, 1] = np.nan
    assert "electrical" not in mean_scores(score(recording._replace(power=power)))["power"]


def test_a_row_without_the_power_of_its_table_has_dashes():
    assert power_cells(mean_powers(1.0, [2.0, np.nan]), "mechanical") == ["2.00", "0.50"]
    assert power_cells(mean_powers(1.0, [2.0, np.nan]), "electrical") == ["-", "-"]


def test_a_fin_that_gives_power_back_has_no_force_per_watt():
    assert mean_powers(1.0, [-1.0, np.nan])["mechanical"]["force_per_watt_n"] is None
