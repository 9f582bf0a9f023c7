"""The policy, an LSTM (paper Sec. III-C2: LSTM-PPO), and the critic that only training needs; both normalise.

Actions are squashed Gaussians: a = tanh(u), u ~ N(mean(observations so far), deviation). The deterministic action is
tanh(mean). So every action is within the limits, and none is clipped.
"""

from collections.abc import Mapping
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from pydantic import Field, PositiveInt

from softfin.core.configuration import Configuration
from softfin.core.errors import ArtifactError
from softfin.learning.lstm import LSTM, Memory, weights
from softfin.learning.normalisation import Normalisation


class PolicyConfig(Configuration):
    """Size and start of the networks."""

    units: PositiveInt = 64
    """Of the LSTM; the paper has 256, in a policy of 592,325 weights."""
    width: PositiveInt = 64
    """Of the layer behind the LSTM."""
    critic_width: PositiveInt = 128
    """Of both layers of the critic."""
    deviation: float = Field(default=0.6, gt=0)
    """Of the exploration noise before the squashing, at the start."""


class Dense(eqx.Module):
    """x W + b."""

    kernel: Float[Array, "inputs outputs"]
    bias: Float[Array, "outputs"]

    @classmethod
    def create(cls, key: PRNGKeyArray, inputs: int, outputs: int, gain: float) -> "Dense":
        """New weights; `gain` scales what it says."""
        return cls(weights(key, (inputs, outputs), gain), jnp.zeros(outputs))

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """Of each vector in a batch."""
        return x @ self.kernel + self.bias


class Recurrent(eqx.Module):
    """LSTM, one layer, one linear layer."""

    lstm: LSTM
    hidden: Dense
    output: Dense

    @classmethod
    def create(cls, key: PRNGKeyArray, config: PolicyConfig, inputs: int, outputs: int, gain: float) -> "Recurrent":
        """New weights; `gain` scales the last layer."""
        lstm, hidden, output = jax.random.split(key, 3)
        return cls(
            LSTM.create(lstm, inputs, config.units),
            Dense.create(hidden, config.units, config.width, 2**0.5),
            Dense.create(output, config.width, outputs, gain),
        )

    def init(self) -> Memory:
        """Nothing remembered."""
        return self.lstm.init()

    def step(self, memory: Memory, x: Float[Array, "inputs"]) -> tuple[Memory, Float[Array, "outputs"]]:
        """One step."""
        memory = self.lstm.step(memory, x)
        return memory, self._read(memory.hidden)

    def sequence(
        self, memory: Memory, x: Float[Array, "time inputs"], fresh: Bool[Array, "time"]
    ) -> Float[Array, "time outputs"]:
        """What `step` says over a sequence, the memory cleared before every step that is `fresh`."""
        return self._read(self.lstm.sequence(memory, x, fresh))

    def _read(self, hidden: Float[Array, "*time units"]) -> Float[Array, "*time outputs"]:
        return self.output(jnp.tanh(self.hidden(hidden)))


class Policy(eqx.Module):
    """The actor: observations in, actions out."""

    net: Recurrent
    log_deviation: Float[Array, "actions"]
    normalisation: Normalisation
    """Of the observations."""

    @classmethod
    def create(cls, key: PRNGKeyArray, config: PolicyConfig, observations: int, actions: int = 2) -> "Policy":
        """New weights; at the start the mean action is near the middle whatever is observed."""
        deviation = jnp.full(actions, jnp.log(config.deviation))
        net = Recurrent.create(key, config, observations, actions, 0.01)
        return cls(net, jnp.asarray(deviation, jnp.float32), Normalisation.create(observations))

    def init(self) -> Memory:
        """Nothing remembered."""
        return self.net.init()

    def act(self, memory: Memory, observation: Float[Array, "observations"]) -> tuple[Memory, Float[Array, "actions"]]:
        """The deterministic action, in (-1, 1)."""
        memory, mean = self.step(memory, observation)
        return memory, jnp.tanh(mean)

    def step(self, memory: Memory, observation: Float[Array, "observations"]) -> tuple[Memory, Float[Array, "actions"]]:
        """The mean before the squashing."""
        return self.net.step(memory, self.normalisation(observation))

    def sequence(
        self, memory: Memory, observation: Float[Array, "time observations"], fresh: Bool[Array, "time"]
    ) -> Float[Array, "time actions"]:
        """What `step` says over a sequence, the memory cleared before every step that is `fresh`."""
        return self.net.sequence(memory, self.normalisation(observation), fresh)

    def having_seen(self, observation: Float[Array, "*batch observations"]) -> "Policy":
        """With observations counted in the normalisation."""
        return self.normalised(self.normalisation.updated(observation))

    def normalised(self, normalisation: Normalisation) -> "Policy":
        """The same weights with another normalisation."""
        return cast(Policy, eqx.tree_at(lambda policy: policy.normalisation, self, normalisation))

    def log_density(self, mean: Float[Array, "*t actions"], raw: Float[Array, "*t actions"]) -> Float[Array, "*t"]:
        """Of the action before the squashing; the squashing cancels in every ratio of densities."""
        z = (raw - mean) / jnp.exp(self.log_deviation)
        return -jnp.sum(0.5 * z**2 + self.log_deviation + 0.5 * jnp.log(2 * jnp.pi), axis=-1)

    @classmethod
    def of(cls, config: PolicyConfig, observations: int, arrays: Mapping[str, np.ndarray], source: str) -> "Policy":
        """From named arrays, all of which may have a leading axis of policies; `source` is named in errors."""
        template = jax.eval_shape(lambda: cls.create(jax.random.key(0), config, observations))
        shapes = named(template)
        if sorted(shapes) != sorted(arrays):
            odd = sorted(set(shapes) ^ set(arrays))
            raise ArtifactError(f"{source}: weights {', '.join(odd)} are missing or unknown; copy the folder again")
        stacks = {arrays[name].shape[: arrays[name].ndim - leaf.ndim] for name, leaf in shapes.items()}
        for name, leaf in shapes.items():
            if arrays[name].shape[arrays[name].ndim - leaf.ndim :] != leaf.shape or len(stacks) > 1:
                raise ArtifactError(
                    f"{source}: {name} has shape {arrays[name].shape}; its configuration needs {leaf.shape} for each "
                    "policy; copy the folder again"
                )
        leaves = [jnp.asarray(arrays[name], jnp.float32) for name in shapes]
        return cast(Policy, jax.tree.unflatten(jax.tree.structure(template), leaves))

    def entropy(self) -> Float[Array, ""]:
        """Of the action before the squashing [nat]."""
        return jnp.sum(self.log_deviation + 0.5 * jnp.log(2 * jnp.pi * jnp.e))


class Critic(eqx.Module):
    """What reward is to come, from all that a simulator knows: it needs no memory, and no robot needs it."""

    layers: tuple[Dense, Dense, Dense]
    reads: Normalisation
    """Of what it sees."""
    says: Normalisation
    """Of values: the layers' unit."""

    @classmethod
    def create(cls, key: PRNGKeyArray, seen: int, width: int) -> "Critic":
        """New weights."""
        sizes = ((seen, width), (width, width), (width, 1))
        first, second, last = (
            Dense.create(k, *size, 1.0) for k, size in zip(jax.random.split(key, 3), sizes, strict=True)
        )
        return cls((first, second, last), Normalisation.create(seen), Normalisation.create(1))

    def __call__(self, seen: Float[Array, "*batch seen"]) -> Float[Array, "*batch"]:
        """Value."""
        return self.says.undone(self._unscaled(seen)[..., None])[..., 0]

    def loss(self, seen: Float[Array, "*batch seen"], target: Float[Array, "*batch"]) -> Float[Array, ""]:
        """Mean squared error, in the layers' unit."""
        return jnp.mean((self._unscaled(seen) - self.says(target[..., None])[..., 0]) ** 2)

    def having_seen(
        self, seen: Float[Array, "*batch seen"], target: Float[Array, "*batch"], longest: float | int
    ) -> "Critic":
        """With inputs and values counted, values as at most `longest`.

        The last layer takes the values' new unit over (van Hasselt et al. 2016); the inputs' new normalisation still
        moves what the same inputs are said to be worth, a little.
        """
        old, new = self.says, self.says.updated(target[..., None], longest)
        first, second, last = self.layers
        last = Dense(last.kernel * old.scale / new.scale, new(old.undone(last.bias)))
        return Critic((first, second, last), self.reads.updated(seen), new)

    def _unscaled(self, seen: Float[Array, "*batch seen"]) -> Float[Array, "*batch"]:
        first, second, last = self.layers
        return last(jnp.tanh(second(jnp.tanh(first(self.reads(seen))))))[..., 0]


class ActorCritic(eqx.Module):
    """What training changes."""

    policy: Policy
    critic: Critic

    @classmethod
    def create(cls, key: PRNGKeyArray, config: PolicyConfig, observations: int, seen: int) -> "ActorCritic":
        """New weights; the critic sees `seen` numbers."""
        actor, critic = jax.random.split(key)
        return cls(Policy.create(actor, config, observations), Critic.create(critic, seen, config.critic_width))


def named(tree: Any) -> dict[str, Any]:
    """The leaves of a pytree by their paths, such as ``net.lstm.kernel``."""
    paths, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in paths}
