import numpy as np
import pytest

from softfin.tank.calibration.config import Parameter
from softfin.tank.calibration.search import Linear, _row, determination

PARAMETERS = tuple(
    Parameter(f"fin.{name}", 1.0, 2.0) for name in ("length_m", "span_m", "density_kg_m3")
)


def linear(slopes, noise, seed=0, point=(0.5, 0.5, 0.5)):
    """A problem whose residuals are noise about the optimum: 40 pieces of 200 ticks, one
    channel."""
    generator = np.random.default_rng(seed)
    residuals = noise(generator, (40, 200, 1))
    flat = slopes.reshape(len(slopes), -1)
    # At the optimum the residuals are at right angles to the slopes.
    used = flat[np.abs(flat).sum(axis=1) > 0]
    residuals -= (used.T @ np.linalg.lstsq(used.T, residuals.reshape(-1), rcond=None)[0]).reshape(
        residuals.shape
    )
    return Linear(np.array(point), residuals, slopes)


def white(generator, shape):
    return 0.1 * generator.normal(size=shape)


def slow(generator, shape):
    """Each value holds for 20 ticks: a twentieth of the samples are independent."""
    return np.repeat(0.1 * generator.normal(size=(shape[0], shape[1] // 20, 1)), 20, axis=1)


def errors(found):
    """Standard errors in scaled coordinates."""
    rows = zip(PARAMETERS, found["parameters"].values(), strict=True)
    return [row["standard_error"] / parameter.slope(0.5) for parameter, row in rows]


@pytest.fixture
def slopes():
    return np.random.default_rng(1).normal(size=(3, 40, 200, 1))


def test_with_white_errors_it_is_the_formula_of_ordinary_least_squares(slopes):
    found = determination(linear(slopes, white), 20, PARAMETERS)
    flat = slopes.reshape(3, -1)
    expected = 0.1 * np.sqrt(np.diag(np.linalg.inv(flat @ flat.T)))
    np.testing.assert_allclose(errors(found), expected, rtol=0.15)
    assert found["blocks"] == 400


def test_errors_that_last_are_not_counted_as_independent():
    constant = np.repeat(np.random.default_rng(1).normal(size=(1, 40, 10, 1)), 20, axis=2)
    slopes = np.concatenate([constant, np.random.default_rng(2).normal(size=(2, 40, 200, 1))])
    lasting, brief = (
        errors(determination(linear(slopes, noise), 20, PARAMETERS))[0] for noise in (slow, white)
    )
    assert lasting / brief == pytest.approx(np.sqrt(20), rel=0.2)


def test_a_parameter_without_effect_and_one_on_a_bound_have_no_standard_error(slopes):
    slopes[2] = 0.0
    found = linear(slopes, white, point=(0.5, 1.0, 0.5))
    # Beyond the end of the range it would be better still.
    found = found._replace(residuals=found.residuals - 0.01 * slopes[1])
    rows = determination(found, 20, PARAMETERS)["parameters"]
    assert rows["fin.span_m"]["determined"] == "high end"
    assert rows["fin.density_kg_m3"]["determined"] == "no effect"
    assert rows["fin.density_kg_m3"]["standard_error"] is None
    assert rows["fin.length_m"]["determined"] == "well"
    low, high = rows["fin.length_m"]["interval"]
    assert low < rows["fin.length_m"]["value"] < high


def test_the_poorer_the_logs_the_poorer_the_verdict(slopes):
    verdicts = [
        determination(linear(slopes * scale, white), 20, PARAMETERS)["parameters"]["fin.length_m"][
            "determined"
        ]
        for scale in (1.0, 0.01, 0.001)
    ]
    assert verdicts == ["well", "roughly", "poorly"]


def test_an_interval_has_finite_ends_whatever_the_logs_leave_open() -> None:
    """An error of 85 widths of a range of two decades would end beyond the greatest float."""
    row = _row(Parameter("fin.youngs_modulus_pa", 3e5, 3e7), 0.5, 85.0, None)
    low, high = row["interval"]
    assert 0 < low < 3e5 < 3e7 < high < np.inf
    assert row["determined"] == "poorly"
