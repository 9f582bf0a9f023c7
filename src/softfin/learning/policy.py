"""The policy, an LSTM (paper Sec. III-C2: LSTM-PPO), and the critic, which is used only during
training. Both normalize their inputs.

Actions are squashed Gaussians: a = tanh(u) with u ~ N(mean(observations so far), std). The
deterministic action is tanh(mean). All actions are therefore within the limits without clipping.
"""

from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree
from pydantic import Field, PositiveInt

from softfin.control.policy import PolicyMemory
from softfin.core.configuration import Configuration
from softfin.learning.layers import LinearLayer, LSTMCell, Normalisation

ACTION_SIZE = 2
"""Size of an action: angle and velocity."""

ActionVector = Float[Array, "actions"]
ObservationVector = Float[Array, "observations"]
BatchScalars = Float[Array, "*batch"]
PrivilegedBatch = Float[Array, "*batch privileged"]


class PolicyConfig(Configuration):
    """Size and initial values of the networks."""

    units: PositiveInt = 64
    """Number of LSTM units; not stated in the paper."""
    width: PositiveInt = 64
    """Number of units of the layer after the LSTM."""
    critic_width: PositiveInt = 128
    """Number of units of each hidden layer of the critic."""
    init_std: float = Field(default=0.6, gt=0)
    """Initial standard deviation of the exploration noise before the tanh [-]."""


class Layers(eqx.Module):
    """Layers of the policy: an LSTM, a tanh layer and a linear layer."""

    lstm: LSTMCell
    hidden: LinearLayer
    output: LinearLayer


class Policy(eqx.Module):
    """The actor, which maps observations to actions."""

    net: Layers
    log_std: ActionVector
    normalisation: Normalisation
    """Normalisation of the observations."""

    @classmethod
    def create(cls, key: PRNGKeyArray, config: PolicyConfig, observations: int) -> "Policy":
        """Initialize a policy whose mean action is close to 0 for all observations."""
        lstm, hidden, output = jax.random.split(key, 3)
        net = Layers(
            LSTMCell.create(lstm, observations, config.units),
            LinearLayer.create(hidden, config.units, config.width, 2**0.5),
            # The small gain keeps the initial mean action close to 0.
            LinearLayer.create(output, config.width, ACTION_SIZE, 0.01),
        )
        log_std = jnp.full(ACTION_SIZE, jnp.log(config.init_std), jnp.float32)
        return cls(net, log_std, Normalisation.create(observations))

    def init(self) -> PolicyMemory:
        """Return an empty memory."""
        return self.net.lstm.init()

    def act(
        self, memory: PolicyMemory, observation: ObservationVector
    ) -> tuple[PolicyMemory, ActionVector]:
        """Return the new memory and the deterministic action, in (-1, 1)."""
        memory, mean = self.step(memory, observation)
        return memory, jnp.tanh(mean)

    def step(
        self, memory: PolicyMemory, observation: ObservationVector
    ) -> tuple[PolicyMemory, ActionVector]:
        """Return the new memory and the mean action before the tanh."""
        memory = self.net.lstm.step(memory, self.normalisation(observation))
        return memory, self._mean(memory.hidden)

    def sequence(
        self,
        memory: PolicyMemory,
        observation: Float[Array, "time observations"],
        is_first: Bool[Array, "time"],
    ) -> Float[Array, "time actions"]:
        """Return the outputs of `step` over a sequence. The memory is cleared before each step with
        `is_first` set."""
        hidden = self.net.lstm.sequence(memory, self.normalisation(observation), is_first)
        return self._mean(hidden)

    def _mean(self, hidden: Float[Array, "*time units"]) -> Float[Array, "*time actions"]:
        return self.net.output(jnp.tanh(self.net.hidden(hidden)))

    def update_statistics(self, observation: Float[Array, "*batch observations"]) -> "Policy":
        """Return the policy with its normalization updated by observations."""
        return self.with_normalisation(self.normalisation.updated(observation))

    def with_normalisation(self, normalisation: Normalisation) -> "Policy":
        """Return the policy with a different normalization."""
        return cast(Policy, eqx.tree_at(lambda policy: policy.normalisation, self, normalisation))

    def log_prob(
        self, mean: Float[Array, "*t actions"], pre_tanh_action: Float[Array, "*t actions"]
    ) -> Float[Array, "*t"]:
        """Return the log-density of the action before the tanh. The Jacobian of the tanh cancels in
        density ratios."""
        # log N(u; mean, std) = -z^2 / 2 - log std - log(2 pi) / 2, with z = (u - mean) / std.
        z = (pre_tanh_action - mean) / jnp.exp(self.log_std)
        return -jnp.sum(0.5 * z**2 + self.log_std + 0.5 * jnp.log(2 * jnp.pi), axis=-1)

    def action_entropy(self) -> Float[Array, ""]:
        """Return the entropy of the action before the tanh [nat]."""
        return jnp.sum(self.log_std + 0.5 * jnp.log(2 * jnp.pi * jnp.e))


class Critic(eqx.Module):
    """Estimates the value of a state from the privileged observation.

    It has no memory, and robots do not need it.
    """

    layers: tuple[LinearLayer, LinearLayer, LinearLayer]
    inputs: Normalisation
    """Normalisation of the privileged observation."""
    values: Normalisation
    """Normalization of the values; the layers compute normalized values."""

    @classmethod
    def create(cls, key: PRNGKeyArray, privileged: int, width: int) -> "Critic":
        """Initialize a critic with `privileged` inputs."""
        first, second, last = jax.random.split(key, 3)
        layers = (
            LinearLayer.create(first, privileged, width, 1.0),
            LinearLayer.create(second, width, width, 1.0),
            LinearLayer.create(last, width, 1, 1.0),
        )
        return cls(layers, Normalisation.create(privileged), Normalisation.create(1))

    def __call__(self, privileged: PrivilegedBatch) -> BatchScalars:
        """Return the value of each state."""
        return self.values.inverse(self._normalised(privileged)[..., None])[..., 0]

    def loss(self, privileged: PrivilegedBatch, target: BatchScalars) -> Float[Array, ""]:
        """Return the mean squared error of the normalized values."""
        error = self._normalised(privileged) - self.values(target[..., None])[..., 0]
        return jnp.mean(error**2)

    def update_statistics(
        self,
        privileged: PrivilegedBatch,
        target: BatchScalars,
        most: float | int,
    ) -> "Critic":
        """Return the critic with normalizations updated by inputs and values; all earlier values
        together have a weight of at most `most` values.

        The last layer is adapted to the new normalization of the values, so that predictions stay
        the same (van Hasselt et al. 2016). The new normalization of the inputs still changes the
        predictions slightly.
        """
        # (x W + b) std + mean is unchanged for W' = W std / std' and
        # b' = (b std + mean - mean') / std'.
        old = self.values
        new = self.values.updated(target[..., None], most)
        first, second, last = self.layers
        last = LinearLayer(last.kernel * old.scale / new.scale, new(old.inverse(last.bias)))
        return Critic((first, second, last), self.inputs.updated(privileged), new)

    def _normalised(self, privileged: PrivilegedBatch) -> BatchScalars:
        first, second, last = self.layers
        return last(jnp.tanh(second(jnp.tanh(first(self.inputs(privileged))))))[..., 0]


class ActorCritic(eqx.Module):
    """The networks of LSTM-PPO."""

    policy: Policy
    critic: Critic


def name_policy_arrays(policy: PyTree) -> dict[str, Any]:
    """Return the leaves of a policy by their names in files, e.g. ``net.lstm.kernel``."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in jax.tree_util.tree_flatten_with_path(policy)[0]
    }
