"""The Plant interface, for anything that moves on command. The virtual tank, every surrogate and
your own simulator are plants.

A plant is pure and traceable, so that `jit`, `vmap`, `scan` and `grad` work on it. Plants are
immutable; `softfin.core.plant_identity` compares them.
"""

import reprlib
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.errors import CommandError, PlantError
from softfin.core.power import mechanical_power
from softfin.core.quantities import AnyArray, Command, Limits, Reading

# A clock may be part of a pytree and has no leaves. It is registered here because modules for the
# robot must not import JAX.
jax.tree_util.register_static(ActionClock)

State: TypeAlias = PyTree
Output = TypeVar("Output")

Ticks: TypeAlias = int | Int[Array, ""]
"""Duration of an action, 33 or 34 ticks; a traced value, not a shape."""


@runtime_checkable
class Plant(Protocol):
    """A fin that is realistic enough for training. A plant is a single fin without batch axes;
    `jax.vmap` adds them.

    Compiled programs hold an action by calling `advance` one tick at a time in a scan. If a plant
    can compute many ticks at once more quickly, it may have a method `hold_action(state, command,
    ticks, rows)` that is equivalent to the function `hold_action`.
    """

    @property
    def limits(self) -> Limits:
        """Limits of the accepted commands [rad, rad/s]; outside them, readings are meaningless."""

    def init(self, key: PRNGKeyArray) -> State:
        """Return the state at time 0 of a fin at rest at `limits.rest_angle`. The key determines
        all randomness (sensor noise, conditions)."""

    def advance(self, state: State, command: Command, ticks: int) -> tuple[State, Reading]:
        """Hold the scalar command for `ticks` samples of 10 ms (`ticks` is static) and read after
        each sample; fields have the shape ``(ticks,)``. To compile it, call it within a function
        and pass this function to `jax.jit`."""


@runtime_checkable
class TrueForcePlant(Plant, Protocol):
    """A plant that simulates a sensor, and therefore provides the true force behind its readings.
    Errors are computed from the true force."""

    def true_force(self, state: State) -> Float[Array, "2"]:
        """Return the mean force of the fin on its mount over the last tick, (x, y) [N], without
        sensor errors."""


@runtime_checkable
class TorquePlant(Plant, Protocol):
    """A plant that also provides the torque of its drive, which feedback can use."""

    def torque(self, state: State) -> Float[Array, "2"] | None:
        """Return the mean torques over the last tick [N m]: on the fin about the shaft, and of the
        motor, which also accelerates the rotor. A torque has the sign of the velocity if the drive
        delivers power. An unknown torque is NaN; None if both are unknown."""


@runtime_checkable
class NoisyPlant(Plant, Protocol):
    """A plant with known noise in the force measurements."""

    @property
    def mean_force_noise_n(self) -> float:
        """Standard deviation of the measured mean force over 2 s for given commands [N].

        White noise averages out over the window, but drift remains.
        """


@runtime_checkable
class ForceInterval(Protocol):
    """Prediction interval for an ensemble's mean force over one window."""

    def half_width(self, means: Float[AnyArray, "members *shape"]) -> Float[AnyArray, "*shape"]:
        """Return the half-width of the interval [N] for the mean force of each member [N]."""

    def caveat(self) -> str | None:
        """Return the reason not to rely on the interval as one sentence, or None."""


@runtime_checkable
class EnsemblePlant(Plant, Protocol):
    """A plant with several members, whose disagreement estimates its error; `advance` returns their
    mean."""

    @property
    def size(self) -> int:
        """Number of members."""

    @property
    def interval(self) -> ForceInterval:
        """Interval for the mean force, based on the disagreement between the members."""

    def advance_members(self, state: State, command: Command, ticks: int) -> tuple[State, Reading]:
        """Like `advance`, but return the readings of every member: fields ``(members, ticks)``."""

    def distance(self, state: State) -> Float[Array, ""]:
        """Return the distance of the last motion from the training data: 1 at the edge of the data,
        larger outside."""


def check_key(key: PRNGKeyArray) -> None:
    """Raise PlantError if the key is not a JAX key but a number, for example."""
    if not isinstance(key, jax.Array):
        raise PlantError(f"key = {reprlib.repr(key)}: must be a JAX key; use jax.random.key(0)")


def check_commands(limits: Limits, commands: Command) -> None:
    """Raise CommandError if a command is outside the limits. Traced values are unknown and not
    checked: in a compiled program, a plant follows any command."""
    if not isinstance(commands, Command):
        raise CommandError(
            f"command = {reprlib.repr(commands)}: must be softfin.Command(angle, velocity)"
        )
    for name, unit, channel, low, high in (
        ("angle", "rad", commands.angle, limits.angle_min, limits.angle_max),
        ("velocity", "rad/s", commands.velocity, limits.velocity_min, limits.velocity_max),
    ):
        if any(isinstance(value, jax.core.Tracer) for value in (channel, low, high)):
            continue
        values = np.asarray(channel)
        # Limits are in double precision and commands in single precision, whose rounding error
        # grows with the magnitude of the limit.
        tolerance = 1e-6 * max(1.0, abs(low), abs(high))
        # Negated, so that NaN is outside as well.
        outside = ~((values >= low - tolerance) & (values <= high + tolerance))
        if outside.any():
            raise CommandError(
                f"command {name} = {values[outside].flat[0]:g} {unit}: the plant accepts {low:g} "
                f"to {high:g} {unit}"
            )


def roll(plant: Plant, state: State, commands: Command) -> tuple[State, Reading]:
    """Issue one command per tick, ``(ticks,)``, and read after each tick; raises CommandError if a
    command is outside the plant's limits."""
    check_commands(plant.limits, commands)
    return jax.lax.scan(partial(_tick, plant), state, commands)


def _tick(plant: Plant, state: State, command: Command) -> tuple[State, Reading]:
    state, reading = plant.advance(state, command, 1)
    return state, jax.tree.map(lambda x: x[0], reading)


def rest_command(limits: Limits) -> Command:
    """Return the command that keeps a fin at rest: its rest angle at the lowest velocity."""
    return Command(jnp.float32(limits.rest_angle), jnp.float32(limits.velocity_min))


def hold_action(
    plant: Plant, state: State, command: Command, ticks: Ticks, rows: int
) -> tuple[State, Reading]:
    """Hold a command for one action; fields have the shape ``(rows,)``, and the first `ticks` rows
    are valid.

    All actions have the same shape, so a compiled program contains the plant only once.
    """
    own = getattr(plant, "hold_action", None)
    if own is not None:
        held: tuple[State, Reading] = own(state, command, ticks, rows)
        return held
    return repeat(partial(_tick, plant, command=command), state, ticks, rows)


class Hidden(NamedTuple):
    """Quantities that a simulated plant provides in addition to its readings, or None."""

    true_force: Float[AnyArray, "rows 2"] | None
    """Mean force of the fin on its mount over each tick [N]."""
    torque: Float[AnyArray, "rows 2"] | None
    """Mean torque over each tick, on the fin and of the motor [N m]."""


def hold_action_with_hidden(
    plant: Plant, state: State, command: Command, ticks: Ticks, rows: int
) -> tuple[State, tuple[Reading, Hidden]]:
    """Hold a command like `hold_action`; also return the hidden quantities."""
    if not isinstance(plant, TrueForcePlant | TorquePlant):
        state, reading = hold_action(plant, state, command, ticks, rows)
        return state, (reading, Hidden(None, None))

    def tick(state: State) -> tuple[State, tuple[Reading, Hidden]]:
        state, reading = _tick(plant, state, command)
        force = plant.true_force(state) if isinstance(plant, TrueForcePlant) else None
        torque = plant.torque(state) if isinstance(plant, TorquePlant) else None
        return state, (reading, Hidden(force, torque))

    return repeat(tick, state, ticks, rows)


def repeat(
    tick: Callable[[State], tuple[State, Output]], state: State, ticks: Ticks, rows: int
) -> tuple[State, Output]:
    """Repeat `tick` for `ticks` ticks and stack its results as ``(rows, ...)``; the first `ticks`
    rows are valid."""
    # For gradients, recomputing a tick is faster than storing its intermediate values.
    again: Callable[[State], tuple[State, Output]] = jax.checkpoint(tick, prevent_cse=False)

    def one(state: State, index: Int[Array, ""]) -> tuple[State, Output]:
        after, output = again(state)
        # After the last tick the state stays the same; the additional output is padding.
        return jax.tree.map(partial(jnp.where, index < ticks), after, state), output

    return jax.lax.scan(one, state, jnp.arange(rows))


def check_power(plant: Plant, weight: float, name: str) -> None:
    """Raise PlantError if the power has a weight, but the plant does not provide the torque."""
    if weight and not has_torque(plant):
        raise PlantError(
            f"{name} = {weight:g}: this plant does not provide the torque on the fin, so its power "
            "is unknown; use 0, or fit a streaming surrogate to logs with the column torque_nm"
        )


def masked_mean(rows: Array, ticks: Ticks) -> Array:
    """Return the mean over the valid rows of an action, ``(rows, ...)``."""
    counts = (jnp.arange(len(rows)) < ticks).reshape(-1, *[1] * (rows.ndim - 1))
    return jnp.where(counts, rows, 0).sum(axis=0) / ticks


def has_torque(plant: Plant) -> bool:
    """Return whether a plant provides the torque on the fin."""
    return (
        isinstance(plant, TorquePlant) and plant.torque(plant.init(jax.random.key(0))) is not None
    )


def mean_loads(torque: Array, velocity: Array, ticks: Ticks) -> tuple[Array, Array]:
    """Return the mean torque [N m] and power [W] over the valid rows of an action, first on the
    fin, then of the motor; `torque` is ``(rows, 2)``."""
    power = mechanical_power(torque, velocity)
    shaft, motor = masked_mean(jnp.stack([torque, power], axis=1), ticks).T
    return shaft, motor


def hold(
    plant: Plant,
    state: State,
    actions: Command,
    clock: ActionClock = PAPER_CLOCK,
    hold_one: Callable[[Plant, State, Command, Ticks, int], tuple[State, Any]] = hold_action,
) -> tuple[State, Any]:
    """Hold each of the ``(actions,)`` commands for one action of the clock, and return the readings
    (or other output of `hold_one`); fields have the shape ``(ticks,)``."""
    check_commands(plant.limits, actions)
    count = actions.angle.shape[0]
    held = (actions, jnp.asarray(clock.action_ticks(count)))
    state, output = jax.lax.scan(
        lambda state, now: hold_one(plant, state, *now, clock.max_ticks), state, held
    )
    return state, jax.tree.map(lambda x: drop_padding(x, count, clock), output)


def drop_padding(rows: Array, actions: int, clock: ActionClock) -> Array:
    """Concatenate the valid rows of consecutive actions, ``(actions, rows, ...)``, into ``(ticks,
    ...)``; the first action is the first of the clock."""
    return rows.reshape(-1, *rows.shape[2:])[np.asarray(clock.valid_rows(actions))]
