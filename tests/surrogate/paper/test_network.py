import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.flops import count_flops
from pydantic import ValidationError

from softfin.core.errors import ArtifactError
from softfin.surrogate.paper.network import (
    FORCENET,
    LSTM,
    POSNET,
    Conv1D,
    Dropout,
    Flatten,
    Network,
    NetworkConfig,
)
from softfin.surrogate.training import name_net_arrays, restored


def convolution(x, kernel, bias):
    """Same-padded, stride 1, one example (steps, features), by the definition."""
    steps = len(x)
    taps = len(kernel)
    y = np.tile(bias, (steps, 1)).astype(float)
    for t in range(steps):
        for k in range(taps):
            source = t + k - (taps - 1) // 2
            if 0 <= source < steps:
                y[t] += x[source] @ kernel[k]
    return y


def lstm(x, kernel, recurrent, bias):
    """All hidden states of one example (steps, features), by the definition."""
    units = len(recurrent)
    h = np.zeros(units)
    c = np.zeros(units)
    states = []
    for step in x:
        z = step @ kernel + h @ recurrent + bias
        i, f, g, o = (z[n * units : (n + 1) * units] for n in range(4))
        c = c / (1 + np.exp(-f)) + np.tanh(g) / (1 + np.exp(-i))
        h = np.tanh(c) / (1 + np.exp(-o))
        states.append(h)
    return np.array(states)


@pytest.mark.parametrize(("config", "parameters"), [(POSNET, 113_601), (FORCENET, 129_794)])
def test_the_networks_have_the_parameters_of_table_one(config, parameters):
    assert config.parameters() == parameters
    leaves = jax.tree.leaves(Network.create(config, jax.random.key(0)))
    assert sum(array.size for array in leaves) == parameters


@pytest.mark.parametrize("kernel", [1, 2, 3, 5])
@pytest.mark.parametrize("steps", [1, 2, 3, 4])
def test_a_convolution_is_the_sum_over_its_taps(kernel, steps):
    random = np.random.default_rng(0)
    weights = {
        "kernel": random.normal(size=(kernel, 7, 4)).astype(np.float32),
        "bias": random.normal(size=4).astype(np.float32),
    }
    x = random.normal(size=(3, steps, 7)).astype(np.float32)
    y = Conv1D(filters=4, kernel=kernel, activation="linear").apply(
        jax.tree.map(jnp.asarray, weights), jnp.asarray(x)
    )
    np.testing.assert_allclose(y, [convolution(one, **weights) for one in x], atol=1e-5)


@pytest.mark.parametrize("sequence", [True, False])
def test_an_lstm_follows_its_equations(sequence):
    random = np.random.default_rng(1)
    shapes = {"kernel": (5, 24), "recurrent": (6, 24), "bias": (24,)}
    weights = {name: random.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    x = random.normal(size=(3, 4, 5)).astype(np.float32)
    y = LSTM(units=6, sequence=sequence).apply(jax.tree.map(jnp.asarray, weights), jnp.asarray(x))
    expected = np.array([lstm(one, **weights) for one in x])
    np.testing.assert_allclose(y, expected if sequence else expected[:, -1], atol=1e-5)


def test_counted_flops_of_the_benchmarks_are_those_that_the_compiler_counts():
    for config in (POSNET, FORCENET):
        net = Network.create(config, jax.random.key(0))
        x = jnp.zeros((256, len(config.channels), config.window))
        program = jax.jit(lambda net, x: net(x)).lower(net, x).compile()
        counted = program.cost_analysis()["flops"] / 256
        assert count_flops(net, x[:1]) == pytest.approx(counted, rel=0.06)


def test_dropout_drops_only_with_a_key_and_keeps_the_mean():
    config = NetworkConfig(
        channels=("a",), outputs=("b",), window=4096, layers=(Flatten(), Dropout(rate=0.4))
    )
    net = Network.create(config, jax.random.key(0))
    ones = jnp.ones((1, 1, 4096))
    assert (net(ones) == 1).all()
    dropped = net(ones, jax.random.key(1))
    assert float((dropped == 0).mean()) == pytest.approx(0.4, abs=0.03)
    assert float(dropped.mean()) == pytest.approx(1.0, abs=0.05)


def test_weights_by_name_make_the_same_network():
    net = Network.create(FORCENET, jax.random.key(3))
    x = jax.random.normal(jax.random.key(4), (2, 3, 100))
    weights = name_net_arrays(net.layers)
    assert set(weights) >= {"0.kernel", "0.recurrent", "0.bias", "5.bias"}
    same = Network(FORCENET, restored(FORCENET.shapes(), weights, "here"))
    np.testing.assert_array_equal(same(x), net(x))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a.pop("0.kernel"), r"here: 0.kernel is missing; .* \(5, 100, 128\)"),
        (lambda a: a.update({"0.bias": np.zeros(3)}), r"0.bias has the shape \(3,\); .* \(128,\)"),
        (lambda a: a["0.bias"].fill(np.nan), "0.bias is not finite"),
    ],
)
def test_odd_weights_are_refused_by_name(change, words):
    named = name_net_arrays(Network.create(POSNET, jax.random.key(0)).layers)
    arrays = {name: array.copy() for name, array in named.items()}
    change(arrays)
    with pytest.raises(ArtifactError, match=words):
        restored(POSNET.shapes(), arrays, "here")


def test_an_unknown_layer_is_no_network():
    described = {"channels": ["a"], "outputs": ["b"], "layers": [{"kind": "attention"}]}
    with pytest.raises(ValidationError, match="attention"):
        NetworkConfig.model_validate(described)
