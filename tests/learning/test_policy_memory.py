"""Memory of policies: what is counted is what lies on disk, and a policy of the default size fits
in 200 kB."""

from pathlib import Path

import jax
import numpy as np
import optax
import pytest

from softfin.learning.policy import (
    Policy,
    PolicyConfig,
    describe_memory,
    name_policy_arrays,
    policy_memory,
)
from softfin.storage import artifact as artifacts
from softfin.task.task import TaskConfig

OBSERVATIONS = TaskConfig(phase=True).observations


def made(config: PolicyConfig) -> Policy:
    return jax.tree.map(
        lambda x: np.zeros(x.shape, x.dtype),
        jax.eval_shape(lambda: Policy.create(jax.random.key(0), config, OBSERVATIONS)),
    )


def test_a_policy_of_the_default_size_and_its_normalisation_fit_in_200_kb_on_disk(
    tmp_path: Path,
) -> None:
    policy = made(PolicyConfig())
    arrays = {name: np.asarray(leaf) for name, leaf in name_policy_arrays(policy).items()}
    artifacts.save(tmp_path / "c", "controller", {"kind": "controller"}, arrays)
    written = (tmp_path / "c" / artifacts.WEIGHTS).stat().st_size
    assert any("normalisation" in name for name in arrays)
    assert written < 200_000
    assert policy_memory(policy)["weights_bytes"] <= written


def test_the_optimisers_part_is_what_adam_holds() -> None:
    policy = made(PolicyConfig(units=4, width=4))
    held = sum(
        leaf.size * leaf.dtype.itemsize
        for leaf in jax.tree.leaves(jax.eval_shape(optax.adam(1e-3).init, policy))
    )
    assert policy_memory(policy)["optimiser_bytes"] == pytest.approx(held, abs=8)


def test_stacked_policies_are_counted_each_alike() -> None:
    alone = made(PolicyConfig(units=4, width=4))
    six = jax.tree.map(lambda x: np.stack([x] * 6), alone)
    one = policy_memory(alone)
    all_six = policy_memory(six)
    for name in ("policies", "total_bytes", "total_weights_bytes"):
        assert all_six[name] == 6 * one[name]
    for name in ("weights", "weights_bytes", "optimiser_bytes"):
        assert all_six[name] == one[name]


def test_what_is_told_names_each_and_all() -> None:
    policy = made(PolicyConfig())
    told = describe_memory(policy_memory(jax.tree.map(lambda x: np.stack([x] * 6), policy)))
    assert told.startswith("memory: 6 policies of 24,")
    assert "1 policy of" in describe_memory(policy_memory(policy))
