"""The paper's experiment: starting from rest, a controller tracks a reference force on a plant.

The controller acts three times per second (paper Sec. IV) or at the rate of its own clock.

References may be constant or moving. All references and seeds run in parallel in one compiled
program, which records every tick of 10 ms.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from softfin.control.controller import Controller, ControllerState, Measured, controller_clock
from softfin.control.pytrees import register_controllers
from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.compilation import jit
from softfin.core.errors import PlantError
from softfin.core.plant import (
    Plant,
    State,
    Ticks,
    check_commands,
    drop_padding,
    hold_action_with_hidden,
    masked_mean,
    mean_loads,
    rest_command,
)
from softfin.core.power import drive_power
from softfin.core.quantities import RATE_HZ, AnyArray, Command, Limits, Reading


def min_seconds(clock: ActionClock) -> int:
    """Return the minimum duration of an experiment [s]: it must contain the first window and up to
    a second of further windows, and two complete actions in its second half."""
    return max(clock.window_ticks // RATE_HZ + 1, math.ceil(4 * clock.max_ticks / RATE_HZ))


MIN_SECONDS = min_seconds(PAPER_CLOCK)
"""Minimum duration of an experiment with the paper's clock [s]."""


ReferenceSeries: TypeAlias = Float[AnyArray, "references *ticks 2"]
"""Reference forces (x, y) [N]: one per experiment, or one per tick, valid until the reading of the
tick."""


class ExperimentRecording(NamedTuple):
    """References, commands and readings of experiments, one per tick of 10 ms."""

    reference: ReferenceSeries
    command: Command
    """Fields ``(references, seeds, ticks)``: the command that was active until the reading of the
    tick."""
    reading: Reading
    """Fields ``(references, seeds, ticks)``, force ``(references, seeds, ticks, 2)``."""
    true_force: Float[AnyArray, "references seeds ticks 2"] | None = None
    """Force on the mount without sensor errors [N]; None if the plant provides only readings."""
    clock: ActionClock = PAPER_CLOCK
    """Clock of the controller."""
    estimate: Any = None
    """Estimates of the feedback after each action ``(references, seeds, actions, ...)``; None
    without feedback."""
    power: Float[AnyArray, "references seeds ticks 2"] | None = None
    """Mechanical power on the fin and electrical power of the motor (`softfin.core.power`), NaN for
    one that is not measured [W]; None without both."""

    @property
    def force(self) -> Float[AnyArray, "references seeds ticks 2"]:
        """Force used for scoring [N]: the true force if known, otherwise the reading."""
        return self.reading.force if self.true_force is None else self.true_force

    def first(self) -> "ExperimentRecording":
        """Return the first seed as NumPy arrays; the seed axis remains, with length 1."""
        command, reading, true_force, estimate, power = jax.tree.map(
            lambda x: np.asarray(x[:, :1]),
            (self.command, self.reading, self.true_force, self.estimate, self.power),
        )
        return self._replace(
            reference=np.asarray(self.reference),
            command=command,
            reading=reading,
            true_force=true_force,
            estimate=estimate,
            power=power,
        )


@runtime_checkable
class RealTime(Protocol):
    """A real fin on which experiments run in real time."""

    @property
    def limits(self) -> Limits:
        """Limits of the commands."""
        ...

    def experiments(
        self, references: Float[np.ndarray, "references *ticks 2"], seconds: int, repetitions: int
    ) -> ExperimentRecording:
        """Run each reference `repetitions` times from rest, one run after the other."""
        ...


EvaluationTarget: TypeAlias = Plant | RealTime
"""Simulated or real fin on which a controller is evaluated."""


def run(
    controller: Controller,
    plant: EvaluationTarget,
    references: ReferenceSeries,
    seconds: int,
    keys: Key[Array, "seeds"],
) -> ExperimentRecording:
    """Run every reference with every plant key, each from rest.

    A reference is one force, or one force per tick. The controller observes the force at the tick
    at which it acts.
    """
    return run_together(controller, plant, [(references, seconds)], keys)[0]


def run_together(
    controller: Controller,
    plant: EvaluationTarget,
    experiments: Sequence[tuple[AnyArray, int]],
    keys: Key[Array, "seeds"],
) -> list[ExperimentRecording]:
    """Run several sets of references, each with its own duration [s]; on a simulated plant, one
    program runs all sets.

    A controller that is not a pytree of arrays and numbers cannot be compiled; it runs in Python.
    """
    series = [(np.asarray(references, np.float32), seconds) for references, seconds in experiments]
    if isinstance(plant, RealTime):
        return [plant.experiments(asked, seconds, len(keys)) for asked, seconds in series]
    clock = controller_clock(controller)
    actions = clock.actions_within(max(seconds for _, seconds in series) * RATE_HZ)
    # Tick at which each action starts and the controller observes the reference.
    starts = np.cumsum([0, *clock.action_ticks(actions)])[:-1]
    observed = []
    for asked, seconds in series:
        if asked.ndim == 3 and asked.shape[1] != seconds * RATE_HZ:
            raise ValueError(
                f"got {asked.shape[1]} references; must be one per tick of {seconds} s, i.e. "
                f"{seconds * RATE_HZ}"
            )
        asked = asked[:, None] if asked.ndim == 2 else asked
        # Shorter experiments hold their last force until the end of the longest experiment; these
        # ticks are cut off below.
        observed.append(asked[:, np.minimum(starts, asked.shape[1] - 1)])
    register_controllers()
    parties = (controller, plant)
    is_pytree = all(map(eqx.is_array_like, jax.tree.leaves(controller)))
    program = _program if is_pytree else _run_in_python
    recorded = program(parties, jnp.asarray(np.concatenate(observed)), keys)
    # Each set gets its own rows and ticks of the results.
    first = 0
    recordings = []
    for references, seconds in experiments:
        part = slice(first, first + len(references)), slice(None), slice(seconds * RATE_HZ)
        own = jax.tree.map(lambda x, part=part: x[part], recorded[:3])
        command, reading, (true_force, power) = own
        acted = (*part[:2], slice(clock.actions_within(seconds * RATE_HZ)))
        estimate = jax.tree.map(lambda x, acted=acted: x[acted], recorded.estimate)
        recordings.append(
            ExperimentRecording(references, command, reading, true_force, clock, estimate, power)
        )
        first += len(references)
    return recordings


def independent(recording: ExperimentRecording) -> ExperimentRecording:
    """Drop the repetitions of a deterministic plant, which are identical; raises PlantError if a
    value is not finite."""
    force = np.asarray(recording.reading.force)
    angle = np.asarray(recording.reading.angle)
    finite = {"force": np.isfinite(force).all(axis=-1), "angle": np.isfinite(angle)}
    if recording.true_force is not None:
        finite["true force"] = np.isfinite(np.asarray(recording.true_force)).all(axis=-1)
    bad = np.argwhere(~np.logical_and.reduce(list(finite.values())))
    if bad.size:
        index, seed, tick = bad[0]
        name = next(name for name, is_finite in finite.items() if not is_finite[index, seed, tick])
        commanded = float(recording.command.angle[index, seed, tick])
        velocity = float(recording.command.velocity[index, seed, tick])
        asked = np.asarray(recording.reference)[index]
        x, y = asked if asked.ndim == 1 else asked[tick]
        raise PlantError(
            f"reference ({x:g}, {y:g}) N, seed {seed}, {(tick + 1) / RATE_HZ:.2f} s: {name} is not "
            f"finite after the command (angle {commanded:.3f} rad, velocity {velocity:.3f} rad/s); "
            "every reading and true force of a plant must be finite"
        )
    return recording.first() if (force == force[:, :1]).all() else recording


Torque: TypeAlias = Float[AnyArray, "rows 2"] | None
"""Mean torque on the fin and of the motor in each tick [N m]; None if the plant does not compute
it."""

Held: TypeAlias = tuple[State, tuple[Reading, Torque, Any]]
"""State after an action, and the readings, torques and extra output of each tick."""


class LoopRecording(NamedTuple):
    """A run of a controller on a plant; all but the estimate have one entry per tick."""

    command: Command
    reading: Reading
    output: Any
    """Output of `hold`."""
    estimate: Any
    """Result of `controller.estimate` after each action; None if there is no such method."""


def closed_loop(
    controller: Controller,
    plant: Plant,
    hold: Callable[[State, Command, Ticks], Held],
    references: Float[Array, "actions 2"],
    key: PRNGKeyArray,
    clock: ActionClock,
) -> LoopRecording:
    """Run a controller on a plant from rest, with one reference per action.

    `hold` holds a command for an action; its readings, torques and output may be padded to the
    longest action.
    """
    actions = len(references)
    estimate = getattr(controller, "estimate", lambda state: None)
    Carry: TypeAlias = tuple[ControllerState, State, Measured]
    Ticked: TypeAlias = tuple[Command, Reading, Any]

    def action(
        carry: Carry, now: tuple[Float[Array, "2"], Ticks]
    ) -> tuple[Carry, tuple[Ticked, Any]]:
        """Act on the readings taken while the previous action was held."""
        (memory, state, measured) = carry
        (reference, ticks) = now
        memory, command = controller.act(memory, measured, reference)
        state, (reading, torque, output) = hold(state, command, ticks)
        measured = _measured(reading, torque, ticks)
        held = jax.tree.map(lambda x: jnp.full(clock.max_ticks, x, jnp.float32), command)
        return (memory, state, measured), ((held, reading, output), estimate(memory))

    state = plant.init(key)
    carry = (controller.init(), state, _measure_at_rest(plant, state, hold))
    _, (kept, estimates) = jax.lax.scan(
        action, carry, (references, jnp.asarray(clock.action_ticks(actions)))
    )
    command, reading, output = jax.tree.map(lambda x: drop_padding(x, actions, clock), kept)
    return LoopRecording(command, reading, output, estimates)


def _measure_at_rest(
    plant: Plant, state: State, hold: Callable[[State, Command, Ticks], Held]
) -> Measured:
    """Return the measurements for the first action, which is computed before the first reading, as
    if the fin were at rest."""
    shapes = jax.eval_shape(hold, state, rest_command(plant.limits), jnp.int32(1))[1]
    reading, torque, _ = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    rest = _measured(reading, torque, 1)
    return rest._replace(angle=jnp.float32(plant.limits.rest_angle))


def _measured(reading: Reading, torque: Torque, ticks: Ticks) -> Measured:
    """Return the measurements for a controller after an action: the last angle, and means."""
    # Readings are padded to the longest action, so use the last valid angle and average only over
    # the valid forces.
    angle = jnp.asarray(reading.angle)[ticks - 1]
    force = masked_mean(jnp.asarray(reading.force), ticks)
    if torque is None:
        return Measured(angle, force)
    loads = mean_loads(jnp.asarray(torque), jnp.asarray(reading.velocity), ticks)
    return Measured(angle, force, *loads)


def simulate(
    controller: Controller, plant: Plant, references: Float[Array, "actions 2"], key: PRNGKeyArray
) -> LoopRecording:
    """Run a controller on a plant from rest, like `closed_loop`; the output is what the plant knows
    besides its readings (`Hidden`)."""
    clock = controller_clock(controller)
    return closed_loop(controller, plant, partial(_hold_once, plant, clock), references, key, clock)


def _hold_once(
    plant: Plant, clock: ActionClock, state: State, command: Command, ticks: Ticks
) -> Held:
    """Hold a command on a plant for an action; the extra output is `Hidden`."""
    state, (reading, hidden) = hold_action_with_hidden(
        plant, state, command, ticks, clock.max_ticks
    )
    return state, (reading, hidden.torque, hidden)


@jit("low")
def _program(
    parties: tuple[Controller, Plant],
    references: Float[Array, "references actions 2"],
    keys: Key[Array, "seeds"],
) -> LoopRecording:
    """Run experiments; compiled once for all controllers and plants that differ only in their
    arrays."""
    controller, plant = parties

    def one(asked: Float[Array, "actions 2"], key: PRNGKeyArray) -> LoopRecording:
        return _add_power(simulate(controller, plant, asked, key))

    # Keys are the inner axis and references the outer axis: (references, seeds, ticks).
    each: LoopRecording = jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(
        references, keys
    )
    return each


def _add_power(run: LoopRecording) -> LoopRecording:
    """Replace the output of one run, which is `Hidden`, by the true force and the power."""
    torque = run.output.torque
    power = None if torque is None else drive_power(torque, jnp.asarray(run.reading.velocity))
    return run._replace(output=(run.output.true_force, power))


def _run_in_python(
    parties: tuple[Controller, Plant],
    references: Float[Array, "references actions 2"],
    keys: Key[Array, "seeds"],
) -> LoopRecording:
    """Run experiments like `_program`, with a controller that runs in Python: all experiments
    run in lock step, action by action, and one compiled program moves all fins. There are no
    estimates.

    Raises CommandError if a command is outside the limits of the plant.
    """
    controller, plant = parties
    clock = controller_clock(controller)
    count, actions, _ = references.shape
    asked = np.repeat(np.asarray(references), len(keys), axis=0)
    memories = [controller.init() for _ in asked]
    states, measured = _start(plant, clock, jnp.tile(keys, count))
    kept = []
    for index, ticks in enumerate(clock.action_ticks(actions)):
        seen = jax.tree.map(np.asarray, measured)
        commands = []
        for run, reference in enumerate(asked[:, index]):
            own = jax.tree.map(lambda part, run=run: part[run], seen)
            memories[run], command = controller.act(memories[run], own, reference)
            commands.append(command)
        angle, velocity = np.array(commands, np.float32).T
        command = Command(jnp.asarray(angle), jnp.asarray(velocity))
        check_commands(plant.limits, command)
        states, measured, held = _hold(plant, clock, states, command, jnp.int32(ticks))
        kept.append(jax.tree.map(np.asarray, held))

    def together(*parts: Any) -> Any:
        rows = np.concatenate(parts, axis=1)[:, clock.valid_rows(actions)]
        return rows.reshape(count, len(keys), *rows.shape[1:])

    command, reading, hidden = jax.tree.map(together, *kept)
    recorded = LoopRecording(command, reading, hidden, None)
    return jax.vmap(jax.vmap(_add_power))(recorded)


@jit("low")
def _start(plant: Plant, clock: ActionClock, keys: Key[Array, "runs"]) -> tuple[State, Measured]:
    def one(key: Key[Array, ""]) -> tuple[State, Measured]:
        state = plant.init(key)
        return state, _measure_at_rest(plant, state, partial(_hold_once, plant, clock))

    return jax.vmap(one)(keys)


@jit("low")
def _hold(
    plant: Plant, clock: ActionClock, states: State, commands: Command, ticks: Ticks
) -> tuple[State, Measured, Any]:
    """Hold one command on each fin; also return its measurements, and the command, readings and
    hidden quantities of each tick."""

    def one(state: State, command: Command) -> tuple[State, Measured, Any]:
        state, (reading, torque, hidden) = _hold_once(plant, clock, state, command, ticks)
        held = jax.tree.map(lambda x: jnp.full(clock.max_ticks, x), command)
        return state, _measured(reading, torque, ticks), (held, reading, hidden)

    return jax.vmap(one)(states, commands)
