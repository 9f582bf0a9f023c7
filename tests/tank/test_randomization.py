import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import ConfigurationError
from softfin.core.plant import roll
from softfin.core.quantities import Command
from softfin.tank import DomainRandomization, Tank, TankConfig, sample_tank, with_parameters
from softfin.tank.fin import FinConfig
from softfin.tank.randomization import ADDED_PARAMETERS

TANK = Tank(TankConfig(fin=FinConfig(plates=2)))
KEYS = jax.random.split(jax.random.key(3), 4)
NONE = DomainRandomization(**dict.fromkeys(DomainRandomization.model_fields, 0.0))


@jax.jit
def record(tank):
    commands = Command(jnp.tile(jnp.array([1.0, -1.0]), 2).repeat(30), jnp.full(120, 2.5))
    return roll(tank, tank.init(jax.random.key(0)), commands)[1]


def test_a_batch_of_different_tanks_runs_as_each_of_them_alone():
    tanks = jax.jit(jax.vmap(lambda key: sample_tank(TANK, key)))(KEYS)
    together = jax.vmap(record)(tanks)
    for i, key in enumerate(KEYS):
        alone = record(sample_tank(TANK, key))
        np.testing.assert_allclose(together.force[i], alone.force, atol=0.025)
        # One step of the encoder: an angle at the edge of two steps may be rounded either way.
        np.testing.assert_allclose(together.angle[i], alone.angle, atol=3e-5)
    assert np.asarray(together.force).std(0).max() > 0.1


@pytest.mark.parametrize("spread", [NONE, DomainRandomization.of(0.0)])
def test_no_spread_is_the_same_tank_to_the_last_bit(spread):
    together = jax.jit(jax.vmap(lambda key: sample_tank(TANK, key, spread)))(KEYS)
    for tank in (sample_tank(TANK, KEYS[0], spread), jax.tree.map(lambda leaf: leaf[1], together)):
        jax.tree.map(np.testing.assert_array_equal, tank, TANK)


def test_all_that_differs_shrinks_with_the_part_and_is_as_usual_from_0_15_on():
    usual = DomainRandomization()
    for part, share in ((0.0, 0), (0.03, 0.2), (0.15, 1), (0.6, 1)):
        spread = DomainRandomization.of(part)
        assert (spread.stiffness, spread.drag, spread.added_mass, spread.lag) == (part,) * 4
        for name in ("temperature_c", "drift", "misalignment_rad"):
            assert getattr(spread, name) == pytest.approx(share * getattr(usual, name))
        assert spread.is_none == (part == 0)


@pytest.mark.parametrize("part", [-0.1, 1.0, 1e9, float("nan"), float("inf")])
def test_a_part_out_of_range_is_one_clear_error(part):
    with pytest.raises(ConfigurationError, match=r"^--randomize"):
        DomainRandomization.of(part)


def test_draws_stay_within_the_spread_and_fill_it():
    spread = DomainRandomization(temperature_c=8.0, stiffness=0.3, lag=0.0)
    drawn = jax.vmap(lambda key: sample_tank(TANK, key, spread))(
        jax.random.split(jax.random.key(0), 500)
    )
    warmer = np.asarray(drawn.water.temperature - TANK.water.temperature)
    stiffer = np.asarray(drawn.fin.stiffness / TANK.fin.stiffness)[:, 0] - 1
    assert 7.5 < np.abs(warmer).max() <= 8.0
    assert 0.28 < np.abs(stiffer).max() <= 0.3001
    np.testing.assert_array_equal(drawn.drive.lag, TANK.drive.lag)
    assert abs(np.corrcoef(warmer, stiffer)[0, 1]) < 0.15


@pytest.mark.parametrize("name", DomainRandomization.model_fields)
def test_each_condition_changes_the_tank(name):
    plain = with_parameters(TANK)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), plain, TANK)
    other = with_parameters(TANK, **{name: (0.0 if name in ADDED_PARAMETERS else 1.0) + 0.1})
    changed = jax.tree.map(lambda a, b: not np.allclose(a, b, rtol=1e-6), other, plain)
    assert any(jax.tree.leaves(changed))
