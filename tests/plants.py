"""A small analytic fin for tests: a first-order drive under a speed limit, and a force with the
square of its speed."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from softfin.core.plant import Ticks
from softfin.core.quantities import PAPER_LIMITS, TICK_S, Command, Limits, Reading


class FinState(NamedTuple):
    ticks: Int[Array, ""]
    angle: Float[Array, ""]
    phase: Float[Array, "2"]


class AnalyticFin(eqx.Module):
    """Angle goes to its target with time constant `lag_s`, no faster than commanded; force = gain
    v|v| (cos, -sin)."""

    gain: Float[Array, ""] = eqx.field(default=0.5, converter=lambda x: jnp.asarray(x, jnp.float32))
    noise_n: Float[Array, ""] = eqx.field(
        default=0.01, converter=lambda x: jnp.asarray(x, jnp.float32)
    )
    lag_s: float = eqx.field(default=0.05, static=True)

    @property
    def limits(self) -> Limits:
        return PAPER_LIMITS

    def init(self, key: PRNGKeyArray) -> FinState:
        return FinState(
            jnp.int32(0), jnp.float32(0.0), jax.random.uniform(key, (2,), maxval=1000.0)
        )

    def advance(self, state: FinState, command: Command, ticks: int) -> tuple[FinState, Reading]:
        def tick(state: FinState, _: None) -> tuple[FinState, Reading]:
            speed = jnp.clip(
                (command.angle - state.angle) / self.lag_s, -command.velocity, command.velocity
            )
            angle = state.angle + speed * TICK_S
            count = state.ticks + 1
            direction = jnp.stack([jnp.cos(angle), -jnp.sin(angle)])
            # A fast tone of random phase: as good as noise to these tests, and compiled in a
            # fraction of the time.
            noise = self.noise_n * jnp.sqrt(2.0) * jnp.sin(state.phase + 12.9898 * count)
            force = self.gain * speed**2 * direction + noise
            return FinState(count, angle, state.phase), Reading(
                count * jnp.float32(TICK_S), angle, speed, force
            )

        return jax.lax.scan(tick, state, None, ticks)


class PlainFin:
    """The same fin as a class that JAX knows nothing of, as a user's own simulator may be."""

    limits = PAPER_LIMITS

    def __init__(self, gain: float = 0.5) -> None:
        self._fin = AnalyticFin(gain=gain)
        self.identity = f"gain {gain:g}"

    def init(self, key: PRNGKeyArray) -> FinState:
        return self._fin.init(key)

    def advance(self, state: FinState, command: Command, ticks: int) -> tuple[FinState, Reading]:
        return self._fin.advance(state, command, ticks)


class Flapper(eqx.Module):
    """A controller that swings between two angles whatever the reference; remembers which side is
    next."""

    angle: float = 0.8
    velocity: float = 3.0

    def init(self) -> Float[Array, ""]:
        return jnp.float32(1.0)

    def act(
        self, state: Float[Array, ""], angle: Float[Array, ""], reference: Float[Array, "2"]
    ) -> tuple[Float[Array, ""], Command]:
        return -state, Command(self.angle * state, jnp.float32(self.velocity))

    def check(self, reference: tuple[float, float]) -> None:
        """Covers everything."""


SERVO_VELOCITY_RAD_S = 4.0


class StrokeFin(eqx.Module):
    """No dynamics but the shaft's place: a stroke to a target pushes steadily, the more the longer
    and faster it is.

    F = gain velocity (1 - cos(stroke)) (cos m, -sin m) + bias, m the middle of the stroke: a smooth
    function of the commands, and of 3 x 2 numbers alone for a gait of three strokes. About 3 N at
    most in +x, none in -x.
    """

    gain: Float[Array, ""] = eqx.field(default=0.5, converter=lambda x: jnp.asarray(x, jnp.float32))
    bias: Float[Array, "2"] = eqx.field(
        default=(0.0, 0.0), converter=lambda x: jnp.asarray(x, jnp.float32)
    )
    """[N], whatever the fin does."""

    @property
    def limits(self) -> Limits:
        return PAPER_LIMITS

    def init(self, key: PRNGKeyArray) -> tuple[Float[Array, ""], Float[Array, ""]]:
        return jnp.float32(0.0), jnp.float32(0.0)

    def advance(
        self, state: tuple[Float[Array, ""], Float[Array, ""]], command: Command, ticks: int
    ) -> tuple[tuple[Float[Array, ""], Float[Array, ""]], Reading]:
        time, angle = state
        stroke = command.angle - angle
        middle = (command.angle + angle) / 2
        push = self.gain * command.velocity * (1 - jnp.cos(stroke))
        force = push * jnp.stack([jnp.cos(middle), -jnp.sin(middle)]) + self.bias
        ones = jnp.ones(ticks)
        times = time + TICK_S * (jnp.arange(ticks) + 1)
        reading = Reading(times, ones * command.angle, ones * stroke, ones[:, None] * force)
        return (times[-1], jnp.asarray(command.angle, jnp.float32)), reading

    def hold_action(
        self,
        state: tuple[Float[Array, ""], Float[Array, ""]],
        command: Command,
        ticks: Ticks,
        rows: int,
    ) -> tuple[tuple[Float[Array, ""], Float[Array, ""]], Reading]:
        """A stroke is one whole, which many ticks one by one are not."""
        (_, angle), reading = self.advance(state, command, rows)
        return (jnp.asarray(reading.time)[ticks - 1], angle), reading


class ServoFin(StrokeFin):
    """A fin whose drive has no velocity command."""

    @property
    def limits(self) -> Limits:
        velocity = SERVO_VELOCITY_RAD_S
        return PAPER_LIMITS._replace(velocity_min=velocity, velocity_max=velocity)


class Misread(PlainFin):
    """A user's simulator whose sensor is off by 0.4 N in x, and which knows the true force."""

    def advance(self, state, command, ticks):
        state, reading = super().advance(state, command, ticks)
        return (state, reading.force[-1]), reading._replace(
            force=reading.force + jnp.array([0.4, 0.0])
        )

    def init(self, key):
        return super().init(key), jnp.zeros(2)

    def true_force(self, state):
        return state[1]


class MisreadFin(Misread):
    def advance(self, state, command, ticks):
        return super().advance(state[0], command, ticks)


class NoisyFin(StrokeFin):
    """The same fin, whose force sensor is known to have noise."""

    noise_n: float = eqx.field(default=0.0, static=True)

    @property
    def mean_force_noise_n(self) -> float:
        return self.noise_n


class DrivenFin(AnalyticFin):
    """The first fin without noise, with a torque of the water of speed |speed| / 5 [N m]."""

    noise_n: float = 0.0

    def init(self, key):
        return super().init(key), jnp.float32(0.0)

    def advance(self, state, command, ticks):
        fin, reading = super().advance(state[0], command, ticks)
        return (fin, reading.velocity[-1]), reading

    def torque(self, state):
        speed = state[1]
        return jnp.stack([speed * jnp.abs(speed) / 5, jnp.nan])
