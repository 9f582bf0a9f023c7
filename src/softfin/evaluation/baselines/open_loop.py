"""Commands that know nothing of the fin's readings, played on a plant: judged as controllers are, or compared.

Commands are issued one a tick, so that a sine can be commanded; an action held for 33 ticks is 33 equal commands.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from softfin.core.plant import Plant, roll
from softfin.core.quantities import Command, Limits, Reading
from softfin.core.randomness import key_of
from softfin.core.window import moving_error
from softfin.evaluation.doubt import doubt
from softfin.evaluation.evaluate import EvaluateConfig, Evaluation
from softfin.evaluation.experiment import Recording, alike, check_finite, first_of
from softfin.evaluation.scores import Scores, score

Forces = Float[np.ndarray, "cases ticks 2"]

CHUNK = 256
"""Cases that run side by side at most: one compiled program serves any greater number of them."""


class OpenLoop:
    """Plays series of commands on one plant, each from rest; `limits` are those that commands are to keep."""

    def __init__(self, plant: Plant, limits: Limits) -> None:
        self.plant, self.limits = plant, limits

        def one(command: Command, key: PRNGKeyArray) -> Reading:
            return roll(plant, plant.init(key), command)[1]

        self._each = jax.jit(jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None)))
        self._force = jax.jit(jax.vmap(lambda command, key: one(command, key).force, in_axes=(0, None)))

    def readings(self, commands: Command, keys: Key[Array, "seeds"]) -> Reading:
        """Every series with every key of the plant: fields ``(cases, seeds, ticks)``."""
        readings: Reading = self._each(commands, keys)
        return readings

    def forces(self, commands: Command, key: PRNGKeyArray) -> Forces:
        """Of many series, all with one key."""
        count = len(commands.angle)
        size = min(CHUNK, count)
        # Filled up with repetitions of the last case, whose forces are dropped again.
        padded = Command(*(jnp.pad(part, ((0, -count % size), (0, 0)), mode="edge") for part in commands))
        starts = range(0, count, size)
        parts = [self._force(Command(*(part[i : i + size] for part in padded)), key) for i in starts]
        return np.concatenate([np.asarray(part) for part in parts])[:count]


def judge(player: OpenLoop, commands: Command, config: EvaluateConfig) -> Evaluation:
    """Score a series of commands for each reference, ``(references, ticks)``, as `evaluate` does a controller."""
    reading = jax.tree.map(np.asarray, player.readings(commands, evaluation_keys(config)))
    issued = Command(*(np.repeat(np.asarray(part)[:, None], config.seeds, axis=1) for part in commands))
    return score_all(Recording(np.asarray(config.references, np.float32), issued, reading), player.plant, config)


def evaluation_keys(config: EvaluateConfig) -> Key[Array, "seeds"]:
    """Those with which `evaluate` starts a plant, so that baselines meet the same noise."""
    return jnp.stack([key_of(config.seed, f"evaluate/{repetition}") for repetition in range(config.seeds)])


def score_all(recording: Recording, plant: Plant, config: EvaluateConfig) -> Evaluation:
    """Of experiments that were run without a controller of softfin's."""
    check_finite(recording)
    scores, repetitions = score(recording), config.seeds
    if alike(recording):
        scores, repetitions = Scores(*(field[:, :1] for field in scores)), 1
    kept = first_of(recording)
    return Evaluation(config, scores, repetitions, kept, doubt(plant, kept))


def missed(forces: Forces, references: Float[np.ndarray, "references 2"]) -> Float[np.ndarray, "cases references"]:
    """What each case would miss each reference by: the errors of x and y together [N], as in Table II."""
    return np.stack([moving_error(forces, reference).sum(axis=1) for reference in references], axis=1)
