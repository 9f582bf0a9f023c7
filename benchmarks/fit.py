"""Fitting both nets: samples a second, and the share of the matrix-product rate by counted FLOPs."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.measure import entry, interleaved, matmul
from softfin.surrogate import FitConfig
from softfin.surrogate.fit import COLUMNS, Learner
from softfin.surrogate.network import NetworkConfig

ROWS, UPDATES = 400_000, 25


def training_flops(config: NetworkConfig) -> int:
    """Forward, gradient of the weights and of the inputs, one matrix product each; none of the first layer's inputs."""
    first = 2 * config.layers[0].products(config.examples()[0])
    if config.layers[0].kind == "lstm":
        # Of an LSTM only the products with the data have no gradient to pass on; those with its own past do.
        steps, features = config.examples()[0]
        first = 2 * config.layers[0].units * features * (3 + 4 * (steps - 1))
    return 3 * config.flops() - first


def main() -> list[dict[str, Any]]:
    config = FitConfig()
    learner = Learner(config, UPDATES)
    random = np.random.default_rng(0)
    table = jnp.asarray(random.uniform(size=(ROWS, len(COLUMNS))), jnp.float32)
    batches = jnp.asarray(random.integers(0, ROWS - 101, (UPDATES, config.batch)), jnp.int32)
    state = learner.start(jax.random.key(0))
    product, flops = matmul()
    call, square = interleaved(
        [lambda: learner.run((state.nets, state.optimiser), table, batches, jax.random.key(1)), product]
    )
    rate, samples = flops / square, UPDATES * config.batch / call
    each = training_flops(config.posnet) + training_flops(config.forcenet)
    return [
        entry("fit, share of the matmul rate", samples * each / rate, "-", 0.5,
              samples_per_s=samples, flops_per_sample=each, batch=config.batch, matmul_gflop_s=rate / 1e9)
    ]  # fmt: skip
