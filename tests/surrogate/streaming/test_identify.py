from types import SimpleNamespace

import jax
import numpy as np
import pytest

from softfin.surrogate.streaming import profile as module
from softfin.surrogate.streaming.profile import Profile, identify
from tests.surrogate.streaming import small

TRUE = Profile(
    gain=1.03, zero=0.02, delay=3.4, velocity_factor=0.95, velocity_limit=2.5, acceleration=30.0
)
NOISE_RAD = 1e-3


def same(one, other):
    return jax.tree.leaves(one) == jax.tree.leaves(other)


def test_the_coefficients_of_a_drive_are_read_off_its_logs(monkeypatch):
    monkeypatch.setattr(module, "SEGMENTS", 32)
    monkeypatch.setattr(module, "STARTS", 1)
    logs = [small.recorded(800, seed, TRUE, noise_rad=NOISE_RAD) for seed in range(4)]
    profile, error = identify(logs, seed=0)
    found, true = (
        SimpleNamespace(**{name: float(x) for name, x in vars(each).items()})
        for each in (profile, TRUE)
    )
    assert found.gain == pytest.approx(true.gain, abs=1e-3)
    assert found.zero == pytest.approx(true.zero, abs=5e-4)
    # A lag is a delay but for the corners of the profile.
    assert found.delay + 100 * found.lag == pytest.approx(true.delay, abs=0.1)
    assert found.velocity_factor == pytest.approx(true.velocity_factor, abs=2e-3)
    assert found.velocity_limit == pytest.approx(true.velocity_limit, rel=2e-3)
    assert found.acceleration == pytest.approx(true.acceleration, rel=0.05)
    # The mean size of the noise, and what the first row's own noise shifts.
    assert error == pytest.approx(NOISE_RAD * np.sqrt(2 / np.pi), rel=0.3)


def test_short_logs_are_read_in_shorter_pieces(monkeypatch):
    monkeypatch.setattr(module, "GENERATIONS", 2)
    found, _ = identify([small.recorded(80, seed) for seed in range(2)], seed=0)
    assert float(found.gain) == pytest.approx(1.0, abs=0.2)


def test_numpys_global_generator_is_left_alone_and_the_seed_alone_decides(monkeypatch):
    monkeypatch.setattr(module, "GENERATIONS", 1)
    monkeypatch.setattr(module, "SEGMENTS", 2)
    logs = [small.recorded(80, 0)]
    found = []
    for state in (5, 6):
        np.random.seed(state)  # noqa: NPY002
        before = np.random.get_state()  # noqa: NPY002
        found.append(identify(logs, seed=1))
        after = np.random.get_state()  # noqa: NPY002
        np.testing.assert_equal(after, before)
    assert same(found[0], found[1])
    assert not same(identify(logs, seed=2), found[0])


def test_searches_begin_at_several_delays_and_the_best_counts(monkeypatch):
    """From one delay alone, one search in five ends at a wrong one."""
    monkeypatch.setattr(module, "GENERATIONS", 1)
    monkeypatch.setattr(module, "SEGMENTS", 2)
    begun = []
    errors = []
    search = module.cma_es

    def noted(guess, step, *words, **options):
        begun.append((guess[2], step))
        made = search(guess, step, *words, **options)
        tell = made.tell
        made.tell = lambda asked, told: (errors.append(min(told)), tell(asked, told))
        return made

    monkeypatch.setattr(module, "cma_es", noted)
    _, error = identify([small.recorded(80, 0)], seed=1)
    assert set(begun) == {(3.0, 0.2), (2.0, 0.2), (3.0, 0.4), (2.0, 0.4)}
    assert error == min(errors)
