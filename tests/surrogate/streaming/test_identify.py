import numpy as np
import pytest

from softfin.surrogate.streaming import identify as module
from softfin.surrogate.streaming.identify import identify
from softfin.surrogate.streaming.profile import ProfileConfig
from tests.surrogate.streaming import small

TRUE = ProfileConfig(
    gain=1.03, zero_rad=0.02, delay_ticks=3.4, velocity_factor=0.95, velocity_limit_rad_s=2.5, acceleration_rad_s2=30.0
)
NOISE_RAD = 1e-3


def test_the_coefficients_of_a_drive_are_read_off_its_logs(monkeypatch):
    monkeypatch.setattr(module, "STRETCHES", 32)
    monkeypatch.setattr(module, "STARTS", 1)
    logs = [small.recorded(800, seed, TRUE, noise_rad=NOISE_RAD) for seed in range(4)]
    found, error = identify(logs, seed=0)
    assert found.gain == pytest.approx(TRUE.gain, abs=1e-3)
    assert found.zero_rad == pytest.approx(TRUE.zero_rad, abs=5e-4)
    # A lag is a delay but for the corners of the profile.
    assert found.delay_ticks + 100 * found.lag_s == pytest.approx(TRUE.delay_ticks, abs=0.1)
    assert found.velocity_factor == pytest.approx(TRUE.velocity_factor, abs=2e-3)
    assert found.velocity_limit_rad_s == pytest.approx(TRUE.velocity_limit_rad_s, rel=2e-3)
    assert found.acceleration_rad_s2 == pytest.approx(TRUE.acceleration_rad_s2, rel=0.05)
    # The mean size of the noise, and what the first row's own noise shifts.
    assert error == pytest.approx(NOISE_RAD * np.sqrt(2 / np.pi), rel=0.3)


def test_short_logs_are_read_in_shorter_pieces(monkeypatch):
    monkeypatch.setattr(module, "GENERATIONS", 2)
    found, _ = identify([small.recorded(80, seed) for seed in range(2)], seed=0)
    assert found.gain == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("seed", [0, 1, 2**30, 2**31 - 1, 2**40])
def test_the_search_has_a_seed_that_it_can_take(seed):
    """CMA-ES takes the clock for 0, and NumPy nothing from 2^32 on."""
    for start in range(module.STARTS):
        assert 0 < module._seed_of(seed, start) < 2**31
