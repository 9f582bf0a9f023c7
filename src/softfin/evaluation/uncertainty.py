"""How far an evaluation in a surrogate can be trusted: where it left its data, and how wrong its mean force may be.

An ensemble is run over the recorded commands once more, for its distance from its data and its intervals; other plants
have neither.
"""

from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.plant import EnsemblePlant, State
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import AXES, Command
from softfin.core.window import moving_average
from softfin.evaluation.experiment import EvaluationTarget, ExperimentRecording

RARELY = 0.01
"""Fraction of samples beyond the data up to which there is no warning: ten times that of the data themselves."""


class SurrogateUncertainty(NamedTuple):
    """Uncertainty of a surrogate's forces, for each reference."""

    out_of_distribution_fraction: Float[np.ndarray, "references"]
    """Fraction of the samples at a distance of more than 1: further than all but 1 of 1000 training moments."""
    furthest: Float[np.ndarray, "references"]
    """Greatest distance."""
    half_width: Float[np.ndarray, "references 2"]
    """Half-width of the stated interval of the mean force, mean over the windows [N]."""

    def to_dict(self, index: int) -> dict[str, Any]:
        """Values of one reference, for JSON."""
        return {
            "out_of_distribution_fraction": float(self.out_of_distribution_fraction[index]),
            "furthest": float(self.furthest[index]),
            **{f"half_width_{axis}_n": float(self.half_width[index, i]) for i, axis in enumerate(AXES)},
        }

    def warning(self) -> str | None:
        """A sentence on how much lies beyond the data; None where hardly anything does."""
        fraction = self.out_of_distribution_fraction.mean()
        text = (
            f"{fraction:.1%} of the samples lie beyond what the surrogate was fitted to (distance up to "
            f"{self.furthest.max():.1f}, 1 is its edge): its forces there are extrapolated"
        )
        return text if fraction > RARELY else None


def uncertainty_of(plant: EvaluationTarget, recording: ExperimentRecording) -> SurrogateUncertainty | None:
    """Return the uncertainty in the first repetition of every reference; None for a plant that estimates none."""
    if not isinstance(plant, EnsemblePlant):
        return None
    commands = Command(*(jnp.asarray(part[:, 0]) for part in recording.command))
    distance, force = (np.asarray(part) for part in _run_members(cast(EnsemblePlant, jit_argument(plant)), commands))
    means = np.stack([moving_average(member) for member in np.moveaxis(force, 2, 0)])
    half_width = np.asarray(plant.interval.half_width(means))
    return SurrogateUncertainty((distance > 1).mean(axis=1), distance.max(axis=1), half_width.mean(axis=1))


@eqx.filter_jit
def _run_members(plant: EnsemblePlant, commands: Command) -> tuple[Array, Array]:
    """Distances ``(references, ticks)`` and the members' forces ``(references, ticks, members, 2)``."""

    def tick(state: State, command: Command) -> tuple[State, tuple[Array, Array]]:
        state, each = plant.advance_members(state, command, 1)
        return state, (plant.distance(state), jnp.asarray(each.force[:, 0]))

    start = plant.init(jax.random.key(0))
    return jax.vmap(lambda issued: jax.lax.scan(tick, start, issued)[1])(commands)
