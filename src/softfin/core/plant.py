"""The Plant contract: what moves when commanded. The virtual tank, every surrogate, one's own
simulator are Plants.

A plant is pure and traceable, so that `jit`, `vmap`, `scan` and `grad` go through it.
"""

from collections.abc import Callable
from functools import partial
from typing import Protocol, TypeAlias, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from softfin.core.action_clock import MAX_ACTION_TICKS, action_ticks, valid_rows
from softfin.core.errors import CommandError
from softfin.core.quantities import AnyArray, Command, Limits, Reading

State: TypeAlias = PyTree
Output = TypeVar("Output")

Ticks: TypeAlias = int | Int[Array, ""]
"""33 or 34, how long an action is held; a value in a program and not a shape."""


@runtime_checkable
class Plant(Protocol):
    """A fin, real enough to learn from: one fin, no batch axes (`jax.vmap` adds them).

    Programs hold an action by `advance` of one tick, in a scan. A plant that is faster with many
    ticks at once may have a method `hold_action(state, command, ticks)`, which does what the
    function `hold_action` says.
    """

    @property
    def limits(self) -> Limits:
        """The commands that the plant takes, angle 0 among them [rad, rad/s]; beyond them its
        readings mean nothing."""

    def init(self, key: PRNGKeyArray) -> State:
        """The fin at rest at angle 0, time 0. The key draws whatever is random (sensor noise,
        conditions)."""

    def advance(self, state: State, command: Command, ticks: int) -> tuple[State, Reading]:
        """Hold the scalar command for `ticks` samples of 10 ms (static) and read after each: fields
        ``(ticks,)``."""


@runtime_checkable
class TrueForcePlant(Plant, Protocol):
    """A plant that simulates a sensor, and so knows the force behind its readings; errors are
    judged by that force."""

    def true_force(self, state: State) -> Float[Array, "2"]:
        """Mean force of the fin on its mount over the last tick (x, y) [N], without the errors of a
        sensor."""


@runtime_checkable
class ForceInterval(Protocol):
    """Interval on the mean force of an ensemble over one window."""

    def half_width(self, means: Float[AnyArray, "members *shape"]) -> Float[AnyArray, "*shape"]:
        """Half of the interval's width [N], from the mean force of each member [N]."""

    def caveat(self) -> str | None:
        """Reason not to rely on the interval, in a sentence; None where there is none."""


@runtime_checkable
class EnsemblePlant(Plant, Protocol):
    """A plant of several members that estimates its own errors; `advance` reads the mean over the
    members."""

    @property
    def size(self) -> int:
        """Number of members."""

    @property
    def interval(self) -> ForceInterval:
        """Interval on the mean force, from how much the members disagree."""

    def member(self, index: Int[Array, ""]) -> Plant:
        """One member as a plant of its own; `index` may be a value in a program."""

    def advance_members(self, state: State, command: Command, ticks: int) -> tuple[State, Reading]:
        """Advance as `advance` does, with every member's own reading: fields ``(members,
        ticks)``."""

    def distance(self, state: State) -> Float[Array, ""]:
        """Distance of the last motion from the training data: 1 at their edge, more beyond it."""


def check_commands(limits: Limits, commands: Command) -> None:
    """Refuse commands beyond the limits, where their values are known: not while a program is being
    compiled."""
    for name, unit, channel, low, high in (
        ("angle", "rad", commands.angle, limits.angle_min, limits.angle_max),
        ("velocity", "rad/s", commands.velocity, limits.velocity_min, limits.velocity_max),
    ):
        if isinstance(channel, jax.core.Tracer):
            continue
        values = np.asarray(channel)
        # Limits are kept in double precision, commands in single, whose error grows with the size
        # of a limit.
        tolerance = 1e-6 * max(1.0, abs(low), abs(high))
        outside = ~((values >= low - tolerance) & (values <= high + tolerance))
        if outside.any():
            raise CommandError(
                f"command {name} = {values[outside].flat[0]:g} {unit}: the plant takes {low:g} to "
                f"{high:g} {unit}"
            )


def roll(plant: Plant, state: State, commands: Command) -> tuple[State, Reading]:
    """Issue one command a tick, ``(ticks,)``, and read after each; raises CommandError beyond the
    plant's limits."""
    check_commands(plant.limits, commands)
    return jax.lax.scan(partial(_tick, plant), state, commands)


def roll_with_true_force(
    plant: Plant, state: State, commands: Command
) -> tuple[State, tuple[Reading, Array | None]]:
    """Issue commands as `roll` does; also return the true force ``(ticks, 2)`` [N], None where it
    is not known."""
    check_commands(plant.limits, commands)
    return jax.lax.scan(partial(_tick_with_true_force, plant), state, commands)


def _tick(plant: Plant, state: State, command: Command) -> tuple[State, Reading]:
    state, reading = plant.advance(state, command, 1)
    return state, jax.tree.map(lambda x: x[0], reading)


def _tick_with_true_force(
    plant: Plant, state: State, command: Command
) -> tuple[State, tuple[Reading, Array | None]]:
    state, reading = plant.advance(state, command, 1)
    true_force = plant.true_force(state) if isinstance(plant, TrueForcePlant) else None
    return state, (jax.tree.map(lambda x: x[0], reading), true_force)


def rest_command(limits: Limits) -> Command:
    """The command under which a fin at rest at angle 0 stays there: angle 0 at the least
    velocity."""
    return Command(jnp.float32(0.0), jnp.float32(limits.velocity_min))


def hold_action(
    plant: Plant, state: State, command: Command, ticks: Ticks
) -> tuple[State, Reading]:
    """Hold a command for one action of 33 or 34 ticks; fields ``(34,)``, of which the first `ticks`
    count.

    All actions have one shape, so whatever is compiled holds the plant once.
    """
    own = getattr(plant, "hold_action", None)
    if own is not None:
        held: tuple[State, Reading] = own(state, command, ticks)
        return held
    return repeat(partial(_tick, plant, command=command), state, ticks)


def hold_action_with_true_force(
    plant: Plant, state: State, command: Command, ticks: Ticks
) -> tuple[State, tuple[Reading, Array | None]]:
    """Hold a command as `hold_action` does; also return the true force ``(34, 2)`` [N], None where
    it is not known."""
    if not isinstance(plant, TrueForcePlant):
        state, reading = hold_action(plant, state, command, ticks)
        return state, (reading, None)
    return repeat(partial(_tick_with_true_force, plant, command=command), state, ticks)


def repeat(
    tick: Callable[[State], tuple[State, Output]], state: State, ticks: Ticks
) -> tuple[State, Output]:
    """`tick` so many times; what it gives is stacked to ``(34, ...)``, of which the first `ticks`
    count."""
    # Where it is differentiated, a tick is computed again: quicker than to keep what lies within
    # it.
    again: Callable[[State], tuple[State, Output]] = jax.checkpoint(tick, prevent_cse=False)

    def one(state: State, index: Int[Array, ""]) -> tuple[State, Output]:
        after, output = again(state)
        return jax.tree.map(partial(jnp.where, index < ticks), after, state), output

    return jax.lax.scan(one, state, jnp.arange(MAX_ACTION_TICKS))


def masked_mean(rows: Array, ticks: Ticks) -> Array:
    """Mean over those of an action's rows ``(34, ...)`` that count."""
    counts = (jnp.arange(len(rows)) < ticks).reshape(-1, *[1] * (rows.ndim - 1))
    return jnp.where(counts, rows, 0).sum(axis=0) / ticks


def hold(plant: Plant, state: State, actions: Command) -> tuple[State, Reading]:
    """Hold each of ``(actions,)`` commands on the 3.0 Hz clock; fields ``(ticks,)`` with 100 ticks
    for 3 actions."""
    check_commands(plant.limits, actions)
    count = actions.angle.shape[0]
    held = (actions, jnp.asarray(action_ticks(count)))
    state, reading = jax.lax.scan(lambda state, now: hold_action(plant, state, *now), state, held)
    return state, jax.tree.map(lambda x: drop_padding(x, count), reading)


def drop_padding(rows: Array, actions: int) -> Array:
    """``(actions, 34, ...)`` rows of actions that follow one another from the clock's start, as
    ``(ticks, ...)``."""
    return rows.reshape(-1, *rows.shape[2:])[np.asarray(valid_rows(actions))]
