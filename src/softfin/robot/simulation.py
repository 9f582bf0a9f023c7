"""Simulation of a robot in water: its body, and each fin in a virtual tank on a mount that moves
with the body."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.plant import Ticks
from softfin.core.quantities import Command
from softfin.robot.description import RobotConfig
from softfin.robot.dynamics import BodyState, Dynamics
from softfin.robot.rotation import cross
from softfin.tank import Tank, TankState
from softfin.tank.fin import Mount
from softfin.tank.tank import Load

BodyVector = Float[Array, "6"]
"""Twist or wrench in body axes."""


class Ambient(NamedTuple):
    """Current and external push during an action."""

    current: Float[Array, "3"]
    """Steady velocity of the water in world axes [m/s]."""
    push: BodyVector
    """External wrench on the body, in body axes [N, N m]."""


class Orders(NamedTuple):
    """Commands of all fins during an action, fields ``(fins,)``."""

    before: Command
    """Commands of the previous action."""
    now: Command
    delays: Int[Array, "fins"]
    """Delay from the start of the action to each fin's command [ticks]."""

    def at(self, tick: Int[Array, ""]) -> Command:
        """Return the commands that are active at a tick of the action."""
        held: Command = jax.tree.map(
            lambda old, new: jnp.where(tick < self.delays, old, new), self.before, self.now
        )
        return held


class RobotState(NamedTuple):
    """State of the body and the fins."""

    body: BodyState
    acceleration: BodyVector
    """Rate of change of the twist relative to the water in the previous tick."""
    fins: TankState


class RobotTicks(NamedTuple):
    """Motion and wrench at each tick of an action."""

    body: BodyState
    wrench: Float[Array, "ticks 6"]
    """Total wrench of the fins on the body, in body axes [N, N m]."""
    shapes: Float[Array, "ticks fins points 2"]
    """Positions of the shaft and the outer end of each plate, in each fin's axes [m]."""


Advanced = tuple[RobotState, RobotTicks]
"""State after an action, and the rows of its ticks."""


class RobotSimulation:
    """A robot and its fins, simulated with compiled JAX programs."""

    def __init__(self, robot: RobotConfig, tanks: Sequence[Tank]) -> None:
        self.robot = robot
        self.dynamics = Dynamics.of(robot.body)
        self._fin_mounts = robot.mounts()
        self._matrix = robot.matrix()
        # Stacked, so that one compiled program simulates all fins.
        self.tanks: Tank = jax.tree.map(lambda *x: jnp.stack(x), *tanks)
        self._advance = eqx.filter_jit(self._advance_action)

    def init(self, key: PRNGKeyArray, body: BodyState | None = None) -> RobotState:
        """Return the state of fins at rest on a body with the given state (default: at rest)."""
        keys = jax.random.split(key, len(self.robot.fins))
        fins = eqx.filter_vmap(lambda tank, key: tank.init(key))(self.tanks, keys)
        start = jax.tree.map(jnp.float32, body or BodyState.rest())
        return RobotState(start, jnp.zeros(6), fins)

    def advance(self, state: RobotState, orders: Orders, around: Ambient, ticks: Ticks) -> Advanced:
        """Advance by an action of 33 or 34 ticks; returns 34 rows, of which the first `ticks` are
        valid."""
        advanced: Advanced = self._advance(state, orders, around, ticks)
        return advanced

    def _advance_action(
        self, state: RobotState, orders: Orders, around: Ambient, ticks: Ticks
    ) -> Advanced:
        return _scan_ticks(
            lambda state, index: self.tick(state, orders.at(index), around), state, ticks
        )

    def held(self, orders: Orders) -> Float[Array, "actions ticks 6"]:
        """Return the wrench of the fins on a fixed body, from rest, for orders ``(actions, fins)``,
        with 34 rows per action."""
        start = self.init(jax.random.key(0))
        still = jax.tree.map(
            lambda x: jnp.zeros((len(self.robot.fins), *x.shape)),
            Mount(jnp.zeros(2), jnp.zeros(2), jnp.zeros(())),
        )

        def action(fins: PyTree, now: tuple[Orders, Array]) -> tuple[Any, Array]:
            orders, ticks = now

            def tick(fins: PyTree, index: Array) -> tuple[Any, Array]:
                fins, loads, _ = self._fins(fins, orders.at(index), still)
                return fins, self._wrench(loads)

            return _scan_ticks(tick, fins, ticks)

        ticks = jnp.asarray(PAPER_CLOCK.action_ticks(len(orders.delays)))
        return jax.lax.scan(action, start.fins, (orders, ticks))[1]

    def _wrench(self, loads: Load) -> BodyVector:
        wrench = jnp.asarray(self._matrix, jnp.float32) @ loads.force.reshape(-1)
        # The fins' moments about their shafts add to the moments of their forces.
        return wrench.at[3:].add(loads.torque @ self._fin_mounts.shafts)

    def tick(self, state: RobotState, commands: Command, around: Ambient) -> Advanced:
        """Advance by one tick of 10 ms."""
        mounts = self._mounts(
            jnp.asarray(self.dynamics.relative_twist(state.body, around.current)),
            state.acceleration,
        )
        fins, loads, shapes = self._fins(state.fins, commands, mounts)
        wrench = self._wrench(loads)
        acceleration = self.dynamics.acceleration(state.body, wrench + around.push, around.current)
        body = self.dynamics.step(state.body, wrench + around.push, around.current)
        return RobotState(body, jnp.asarray(acceleration), fins), RobotTicks(body, wrench, shapes)

    def _mounts(self, twist: BodyVector, acceleration: BodyVector) -> Mount:
        """Return the motion of each fin's mount through the water, in the fin's axes."""
        velocity = twist[:3]
        turn = twist[3:]
        # Acceleration of the origin in an inertial frame: a = dv/dt + omega x v.
        linear = acceleration[:3] + cross(turn, velocity)

        def each(place: Array, axes: Array, shaft: Array) -> Mount:
            # v = v0 + omega x r, and a = a0 + alpha x r + omega x (omega x r).
            around = cross(turn, place)
            speeding = linear + cross(acceleration[3:], place) + cross(turn, around)
            return Mount((velocity + around) @ axes, speeding @ axes, turn @ shaft)

        return jax.vmap(each)(*(jnp.asarray(x, jnp.float32) for x in self._fin_mounts))

    def _fins(
        self, states: TankState, commands: Command, mounts: Mount
    ) -> tuple[TankState, Load, Array]:
        def each(
            tank: Tank, state: TankState, command: Command, mount: Mount
        ) -> tuple[TankState, Load, Array]:
            state, _, load = tank.tick(state, command, mount)
            return state, load, tank.shape(state)

        advanced: tuple[TankState, Load, Array] = eqx.filter_vmap(each)(
            self.tanks, states, commands, mounts
        )
        return advanced


def _scan_ticks(
    tick: Callable[[Any, Array], tuple[Any, Any]], state: PyTree, ticks: Ticks
) -> tuple[Any, Any]:
    """Scan the ticks of an action; returns the state after the first `ticks` and 34 rows."""

    def one(state: PyTree, index: Array) -> tuple[Any, Any]:
        after, row = tick(state, index)
        # Actions have 33 or 34 ticks, but a compiled program has a fixed length: discard the extra
        # tick.
        return jax.tree.map(partial(jnp.where, index < ticks), after, state), row

    return jax.lax.scan(one, state, jnp.arange(PAPER_CLOCK.max_ticks))
