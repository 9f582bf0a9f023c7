"""An episode of the Gymnasium environment while it goes on: actions in, a picture of all that has passed so far out."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from softfin.core.action_clock import MOST_TICKS
from softfin.core.plant import Plant, State, rest_command
from softfin.core.quantities import Command, Limits
from softfin.evaluation.view.footage import Shots, develop, shoot
from softfin.evaluation.view.picture import Image, Picture
from softfin.evaluation.view.scale import Greatest, round_up
from softfin.tank import Tank


class EpisodeFilm:
    """Picture of a plant that is recorded action by action.

    For that the plant is rolled a second time, tick by tick: it is pure, so it moves as it did for the task.
    """

    def __init__(self, plant: Plant, seconds: float, greatest_reference_n: float) -> None:
        self._plant, self._limits, self._seconds = plant, Limits(*plant.limits), seconds
        self._shoot = jax.jit(lambda state, commands: shoot(plant, state, commands))
        greatest = round_up(greatest_reference_n)
        self._greatest = Greatest(force_n=greatest, mean_n=greatest, stream_m_s=0.05)
        self._parts: list[tuple[Command, Shots, Float[np.ndarray, "ticks 2"]]] = []
        self._resting = True
        self._picture: Picture | None = None

    def reset(self, state: State, reference: Float[np.ndarray, "2"]) -> None:
        """Begin with a fin at rest, as it is one tick later; the first action takes the place of that tick."""
        self._parts, self._resting = [], True
        self.add(state, rest_command(self._limits), 1, reference)
        self._resting = True

    def add(self, state: State, command: Command, ticks: int, reference: Float[np.ndarray, "2"]) -> None:
        """Add an action: the plant before it, its command, how long it is held, the reference [N]."""
        # One compiled program, for the longest: a tick does not depend on those that follow.
        commands = Command(*(jnp.full(MOST_TICKS, field, jnp.float32) for field in command))
        held, shots = jax.tree.map(lambda x: np.asarray(x)[:ticks], (commands, self._shoot(state, commands)))
        part = (held, shots, np.tile(np.asarray(reference, np.float32), (ticks, 1)))
        self._parts = [part] if self._resting else [*self._parts, part]
        self._resting = False

    def frame(self) -> Image:
        """The picture of this moment."""
        command, shots, reference = jax.tree.map(lambda *parts: np.concatenate(parts), *self._parts)
        # With the stream even where the water is still, so that what is drawn stays in its place.
        footage = develop(self._plant, command, shots, reference)._replace(stream=shots.stream)
        greatest = self._greatest.including(footage)
        if self._picture is None or greatest != self._greatest:
            self._greatest = greatest
            scale = greatest.scale(footage.length_m, (self._limits.angle_min, self._limits.angle_max))
            where = "the virtual tank" if isinstance(self._plant, Tank) else type(self._plant).__name__
            self._picture = Picture(footage, f"A soft fin in {where}", scale=scale, seconds=self._seconds)
        return self._picture.last_frame(footage)
