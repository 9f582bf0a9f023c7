import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.surrogate.streaming.nets import SLOWEST, MirrorCore, Parity, magnitude
from tests.surrogate.streaming.small import filled

INPUTS = Parity(2, 3)
OUTPUTS = Parity(1, 2)
UNITS = 3
HIDDEN = 4


def core(seed=0):
    return filled(MirrorCore(INPUTS, OUTPUTS, UNITS, HIDDEN, jax.random.key(seed)), seed)


def inputs(ticks, seed=0):
    random = np.random.default_rng(seed)
    return Parity(*(jnp.asarray(random.normal(size=(ticks, size)), jnp.float32) for size in INPUTS))


@jax.jit
def scanned(net, series):
    return jax.lax.scan(lambda memory, now: net.step(memory, now), net.blank(), series)[1]


def test_step_by_step_it_says_what_a_scan_says():
    net = core()
    series = inputs(12)
    said = scanned(net, series)
    memory = net.blank()
    for tick in range(12):
        memory, now = net.step(memory, jax.tree.map(lambda x, tick=tick: x[tick], series))
        for one, other in zip(now, said, strict=True):
            np.testing.assert_allclose(one, other[tick], rtol=1e-4, atol=1e-5)
    assert np.abs(said.even).max() > 0.1


def test_a_mirror_changes_the_sign_of_what_is_odd_and_nothing_else():
    net = core()
    series = inputs(50)
    said = scanned(net, series)
    other = scanned(net, series._replace(odd=-series.odd))
    np.testing.assert_allclose(other.even, said.even, atol=1e-6)
    np.testing.assert_allclose(other.odd, -said.odd, atol=1e-6)
    assert min(np.abs(said.even).max(), np.abs(said.odd).max()) > 0.1


def test_the_odd_outputs_of_a_mirror_core_see_the_even_inputs_and_the_other_way_round():
    net = core()
    series = inputs(50)
    said = scanned(net, series)
    assert np.abs(scanned(net, series._replace(even=series.even + 1)).odd - said.odd).max() > 0.1
    assert np.abs(scanned(net, series._replace(odd=2 * series.odd)).even - said.even).max() > 0.1


def test_untrained_it_says_nothing():
    said = scanned(MirrorCore(INPUTS, OUTPUTS, UNITS, HIDDEN, jax.random.key(0)), inputs(20))
    assert not np.any(said.even)
    assert not np.any(said.odd)


def test_gates_begin_with_time_constants_from_two_ticks_to_the_slowest():
    net = MirrorCore(INPUTS, OUTPUTS, UNITS, HIDDEN, jax.random.key(0))
    ticks = 1 / jax.nn.sigmoid(net.bias[:6])
    assert float(ticks.min()) == pytest.approx(2, rel=1e-4)
    assert float(ticks.max()) == pytest.approx(SLOWEST, rel=1e-4)


def test_the_magnitude_is_a_square_where_small_and_the_size_where_large():
    x = jnp.asarray([-0.01, 0.01, -1e3, 1e3])
    np.testing.assert_allclose(magnitude(x), [5e-5, 5e-5, 999, 999], rtol=2e-2)
