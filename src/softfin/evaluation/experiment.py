"""The paper's experiment: from rest, a controller tracks a reference force on a plant, 3 actions a
second (Sec. IV).

Controller, plant and reference forces, constant or moving, go in, a recording of every 10 ms comes
out; all references and seeds run side by side in one compiled program.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from softfin.control.controller import Controller, ControllerState, Measured
from softfin.core.action_clock import ACTION_TICKS, MAX_ACTION_TICKS, action_ticks
from softfin.core.compilation import jit
from softfin.core.errors import PlantError
from softfin.core.plant import (
    Plant,
    State,
    Ticks,
    drop_padding,
    hold_action_with_true_force,
    masked_mean,
)
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import RATE_HZ, AnyArray, Command, Limits, Reading

MIN_SECONDS = 3
"""Shortest length of an experiment [s]; the first window of the moving average takes 2 s."""


ReferenceSeries: TypeAlias = Float[AnyArray, "references *ticks 2"]
"""Reference forces (x, y) [N]: one for the whole experiment, or one per tick, valid until that
tick's reading."""


class ExperimentRecording(NamedTuple):
    """Series of references, commands and readings of experiments, in ticks of 10 ms."""

    reference: ReferenceSeries
    command: Command
    """Fields ``(references, seeds, ticks)``: the command in force before the reading of that
    tick."""
    reading: Reading
    """Fields ``(references, seeds, ticks)``, force ``(references, seeds, ticks, 2)``."""
    true_force: Float[AnyArray, "references seeds ticks 2"] | None = None
    """Force on the mount without sensor errors [N]; None if the plant has only readings."""

    @property
    def force(self) -> Float[AnyArray, "references seeds ticks 2"]:
        """Force by which a controller is judged [N]: the true one if it is known, otherwise the
        reading."""
        return self.reading.force if self.true_force is None else self.true_force

    def first(self) -> "ExperimentRecording":
        """Return the first seed only, with its axis kept, as NumPy arrays."""
        series = jax.tree.map(
            lambda x: np.asarray(x[:, :1]), (self.command, self.reading, self.true_force)
        )
        return ExperimentRecording(np.asarray(self.reference), *series)


@runtime_checkable
class RealTime(Protocol):
    """A real fin with its controller, on which experiments take real time."""

    @property
    def limits(self) -> Limits:
        """The commands that it accepts."""
        ...

    def experiments(
        self, references: Float[np.ndarray, "references *ticks 2"], seconds: int, repetitions: int
    ) -> ExperimentRecording:
        """Run every reference `repetitions` times, one after the other, each from rest."""
        ...


EvaluationTarget: TypeAlias = Plant | RealTime
"""The fin on which a controller is evaluated, simulated or real."""


def run(
    controller: Controller,
    plant: EvaluationTarget,
    references: ReferenceSeries,
    seconds: int,
    keys: Key[Array, "seeds"],
) -> ExperimentRecording:
    """Run every reference with every key of the plant, each from rest, for whole seconds.

    A reference is one force, or one per tick, of which the controller observes that of the tick at
    which it acts.
    """
    return run_together(controller, plant, [(references, seconds)], keys)[0]


def run_together(
    controller: Controller,
    plant: EvaluationTarget,
    experiments: Sequence[tuple[AnyArray, int]],
    keys: Key[Array, "seeds"],
) -> list[ExperimentRecording]:
    """Run several sets of references, each with its own duration; in a simulated plant all in one
    program."""
    series = [(np.asarray(references, np.float32), seconds) for references, seconds in experiments]
    if isinstance(plant, RealTime):
        return [plant.experiments(asked, seconds, len(keys)) for asked, seconds in series]
    actions = max(seconds for _, seconds in series) * len(ACTION_TICKS)
    # Tick at which each action begins, and at which the controller observes the reference.
    starts = np.cumsum([0, *action_ticks(actions)])[:-1]
    observed = []
    for asked, seconds in series:
        if asked.ndim == 3 and asked.shape[1] != seconds * RATE_HZ:
            raise ValueError(f"{asked.shape[1]} references are not one per tick of {seconds} s")
        asked = asked[:, None] if asked.ndim == 2 else asked
        # After its end the last force is held, and the result is left out below.
        observed.append(asked[:, np.minimum(starts, asked.shape[1] - 1)])
    parties = (controller, jit_argument(plant))
    recorded = _program(parties, jnp.asarray(np.concatenate(observed)), keys)
    if len(experiments) == 1:
        return [ExperimentRecording(experiments[0][0], *recorded)]
    # Each set has its own rows of the references, and the ticks of its own seconds.
    first = 0
    recordings = []
    for references, seconds in experiments:
        part = slice(first, first + len(references)), slice(None), slice(seconds * RATE_HZ)
        own = jax.tree.map(lambda x, part=part: x[part], recorded)
        recordings.append(ExperimentRecording(references, *own))
        first += len(references)
    return recordings


def independent(recording: ExperimentRecording) -> ExperimentRecording:
    """Drop identical repetitions, as of a plant without randomness; raise PlantError unless all is
    finite."""
    force = np.asarray(recording.reading.force)
    angle = np.asarray(recording.reading.angle)
    finite = {"force": np.isfinite(force).all(axis=-1), "angle": np.isfinite(angle)}
    if recording.true_force is not None:
        finite["true force"] = np.isfinite(np.asarray(recording.true_force)).all(axis=-1)
    bad = np.argwhere(~np.logical_and.reduce(list(finite.values())))
    if bad.size:
        index, seed, tick = bad[0]
        name = next(name for name, is_finite in finite.items() if not is_finite[index, seed, tick])
        commanded, velocity = (float(part[index, seed, tick]) for part in recording.command)
        asked = np.asarray(recording.reference)[index]
        x, y = asked if asked.ndim == 1 else asked[tick]
        raise PlantError(
            f"reference ({x:g}, {y:g}) N, seed {seed}, {(tick + 1) / RATE_HZ:.2f} s: {name} is not "
            f"finite after the command (angle {commanded:.3f} rad, velocity {velocity:.3f} rad/s); "
            "every reading and true force of a plant must be finite"
        )
    return recording.first() if (force == force[:, :1]).all() else recording


RecordedTicks: TypeAlias = tuple[Command, Reading, Array | None]
"""Commands, readings and, if the plant knows it, the true force over a series of ticks."""


@jit("low")
def _program(
    parties: tuple[Controller, Plant],
    references: Float[Array, "references actions 2"],
    keys: Key[Array, "seeds"],
) -> RecordedTicks:
    """Run experiments; compiled once for controllers and plants that differ only in their
    arrays."""
    controller, plant = parties
    actions = references.shape[1]
    Carry: TypeAlias = tuple[ControllerState, State, Measured]

    def action(carry: Carry, now: tuple[Float[Array, "2"], Ticks]) -> tuple[Carry, RecordedTicks]:
        """Act on the readings taken while the previous action was held."""
        (memory, state, measured) = carry
        (reference, ticks) = now
        memory, command = controller.act(memory, measured, reference)
        state, (reading, true_force) = hold_action_with_true_force(plant, state, command, ticks)
        measured = Measured(
            jnp.asarray(reading.angle)[ticks - 1], masked_mean(jnp.asarray(reading.force), ticks)
        )
        held = jax.tree.map(lambda x: jnp.full(MAX_ACTION_TICKS, x, jnp.float32), command)
        return (memory, state, measured), (held, reading, true_force)

    def one(asked: Float[Array, "actions 2"], key: PRNGKeyArray) -> RecordedTicks:
        carry = (controller.init(), plant.init(key), Measured(jnp.float32(0.0), jnp.zeros(2)))
        _, kept = jax.lax.scan(action, carry, (asked, jnp.asarray(action_ticks(actions))))
        recorded: RecordedTicks = jax.tree.map(lambda x: drop_padding(x, actions), kept)
        return recorded

    each: RecordedTicks = jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(
        references, keys
    )
    return each
