import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import ConfigurationError
from softfin.core.plant import roll
from softfin.core.quantities import Command
from softfin.tank import (
    DomainRandomization,
    PhysicalParameters,
    Tank,
    TankConfig,
    sample_parameters,
    sample_tank,
    with_parameters,
)
from softfin.tank.fin import FinConfig

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
        np.testing.assert_allclose(together.angle[i], alone.angle, atol=1e-5)
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
    with pytest.raises(ConfigurationError, match=r"^--randomize \S+: give a part from 0, .* to less than 1$"):
        DomainRandomization.of(part)


def test_draws_stay_within_the_spread_and_fill_it():
    spread = DomainRandomization(temperature_c=8.0, stiffness=0.3, lag=0.0)
    drawn = jax.vmap(lambda key: sample_parameters(key, spread))(jax.random.split(jax.random.key(0), 500))
    assert 7.5 < np.abs(drawn.temperature_c).max() <= 8.0
    assert 0.28 < np.abs(np.asarray(drawn.stiffness) - 1).max() <= 0.3001
    np.testing.assert_array_equal(drawn.lag, 1.0)
    assert abs(np.corrcoef(drawn.temperature_c, drawn.stiffness)[0, 1]) < 0.15


@pytest.mark.parametrize("name", PhysicalParameters._fields)
def test_each_condition_changes_the_tank(name):
    plain = PhysicalParameters(
        *(jnp.float32(name not in ("temperature_c", "misalignment_rad")) for name in PhysicalParameters._fields)
    )
    other = with_parameters(TANK, plain._replace(**{name: getattr(plain, name) + 0.1}))
    changed = jax.tree.map(lambda a, b: not np.allclose(a, b, rtol=1e-6), other, with_parameters(TANK, plain))
    assert any(jax.tree.leaves(changed))
