"""The drive network (commands to motion) and the force network (motion to force) of one fin; both
advance one tick at a time.

A fin is symmetric about the plane y = 0. A reflection in this plane changes the sign of the angle,
the angular velocity and the y force (odd quantities), but not of the x force and speeds (even
quantities). The recurrent core of both networks has this symmetry by construction.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree
from pydantic import Field, PositiveInt

from softfin.core.configuration import Configuration
from softfin.core.quantities import TICK_S, AnyArray, Command
from softfin.surrogate.streaming.profile import Profile, ProfileState
from softfin.surrogate.streaming.segments import Motion, Scales

SLOWEST = 60.0
"""Longest initial time constant of the gates [ticks]. The shortest is 2, so the memory covers both
ripples and strokes."""


class Parity(NamedTuple):
    """Sizes, inputs, outputs or memory, split into parts that the reflection leaves unchanged
    (even) and parts whose sign it changes (odd)."""

    even: PyTree
    odd: PyTree


class MirrorCore(eqx.Module):
    """A mirror-symmetric gated recurrent unit, h' = h + u (c - h), with gates u and candidates c.

    Odd candidates are odd functions of odd inputs. The gates, the even candidates and the factors
    of the odd candidates depend on the even inputs and the `magnitude` of mixtures of odd inputs.
    Mirrored inputs therefore produce exactly mirrored outputs.
    """

    odd_in: Float[Array, "odd_inputs candidates_and_magnitudes"]
    even_in: Float[Array, "even_inputs gates_candidates_factors"]
    bias: Float[Array, "gates_candidates_factors"]
    hidden_in: Float[Array, "hidden_inputs hidden"]
    hidden_bias: Float[Array, "hidden"]
    even_out: Float[Array, "hidden even_outputs"]
    odd_out: Float[Array, "units odd_outputs"]
    odd_factors: Float[Array, "hidden odd_outputs_times_units"]
    units: int = eqx.field(static=True)

    def __init__(
        self, inputs: Parity, outputs: Parity, units: int, hidden: int, key: PRNGKeyArray
    ) -> None:
        keys = jax.random.split(key, 4)
        self.units = units
        self.odd_in = _uniform(keys[0], units + inputs.odd, 2 * units)
        self.even_in = _uniform(keys[1], 2 * units + inputs.even, 4 * units)
        # sigmoid(bias) = 1 / T for a time constant of T ticks, so bias = -log(T - 1). The order is
        # random so that even and odd memory have time constants in the same range.
        gates = jax.random.permutation(
            keys[2], -jnp.log(jnp.geomspace(2.0, SLOWEST, 2 * units) - 1)
        )
        self.bias = jnp.concatenate([gates, jnp.zeros(units), jnp.ones(units)])
        self.hidden_in = _uniform(keys[3], 2 * units, hidden)
        self.hidden_bias = jnp.zeros(hidden)
        # All outputs start at zero so that training starts from the physical model alone.
        self.even_out = jnp.zeros((hidden, outputs.even))
        self.odd_out = jnp.zeros((units, outputs.odd))
        self.odd_factors = jnp.zeros((hidden, outputs.odd * units))

    def blank(self) -> Parity:
        """Return an empty memory."""
        return Parity(jnp.zeros(self.units), jnp.zeros(self.units))

    def step(self, memory: Parity, inputs: Parity) -> tuple[Parity, Parity]:
        """Advance by one tick and return the new memory and the outputs."""
        # A linear map without bias keeps odd inputs odd. The magnitudes of the mixtures are even,
        # so the gates may depend on them.
        candidates, mixtures = jnp.split(jnp.concatenate([memory.odd, inputs.odd]) @ self.odd_in, 2)
        sizes = magnitude(mixtures)
        gates = jnp.concatenate([memory.even, inputs.even, sizes]) @ self.even_in + self.bias
        memory = update_memory(memory, candidates, gates)
        return memory, self.read(memory, sizes)

    def read(self, memory: Parity, sizes: Float[Array, "units"]) -> Parity:
        """Return the outputs for a new memory and the magnitudes of the mixtures."""
        hidden = jnp.tanh(jnp.concatenate([memory.even, sizes]) @ self.hidden_in + self.hidden_bias)
        # The odd outputs are linear in the odd memory, with weights that depend on the even part.
        factors = self.odd_out.T + (hidden @ self.odd_factors).reshape(-1, self.units)
        return Parity(hidden @ self.even_out, factors @ memory.odd)


def update_memory(
    memory: Parity,
    candidates: Float[Array, "*shape units"],
    gates: Float[Array, "*shape four_units"],
) -> Parity:
    """Return the new memory h' = h + u (c - h).

    `gates` contains the even gates, odd gates, even candidates and odd factors, before their
    activation functions.
    """
    even_gates, odd_gates, even_candidates, factors = jnp.split(gates, 4, axis=-1)
    even = memory.even + jax.nn.sigmoid(even_gates) * (jnp.tanh(even_candidates) - memory.even)
    # The product of an odd candidate and an even factor is odd, and so is its tanh.
    odd = memory.odd + jax.nn.sigmoid(odd_gates) * (jnp.tanh(candidates * factors) - memory.odd)
    return Parity(even, odd)


def magnitude(x: Array) -> Array:
    """Return sqrt(1 + x^2) - 1, an even and smooth function: x^2 / 2 for small x, and |x| for large
    x."""
    return jnp.sqrt(1 + x * x) - 1


def _uniform(key: PRNGKeyArray, inputs: int, outputs: int) -> Float[Array, "inputs outputs"]:
    """Draw a matrix with entries of variance 1 / (2 inputs).

    A variance of 1 / inputs would preserve the signal variance. The variance is lower here because
    all memory is fed back.
    """
    # A uniform distribution on [-r, r] has variance r^2 / 3.
    reach = jnp.sqrt(1.5 / inputs)
    return jax.random.uniform(key, (inputs, outputs), minval=-reach, maxval=reach)


class DriveNetConfig(Configuration):
    """Size of the drive network."""

    units: PositiveInt = 8
    """Size of the even memory and of the odd memory."""
    hidden: PositiveInt = 16
    """Number of units in the layer between memory and output."""


class FollowingState(NamedTuple):
    """State of the drive network between ticks."""

    profile: ProfileState
    memory: Parity
    motion: Motion


class FollowingNet(eqx.Module):
    """The drive network, which predicts the deviation of the shaft from its profile, for one fin
    without batch axes."""

    core: MirrorCore
    profile: Profile
    config: DriveNetConfig = eqx.field(static=True)
    scales: Scales = eqx.field(static=True)

    def __init__(self, config: DriveNetConfig, scales: Scales, key: PRNGKeyArray) -> None:
        self.core = MirrorCore(Parity(1, 3), Parity(0, 2), config.units, config.hidden, key)
        self.profile = Profile()
        self.config = config
        self.scales = scales

    def start(self, motion: Motion, waiting: Command) -> FollowingState:
        """Return the state for a motion and the commands in the last `MAX_DELAY` ticks, newest
        first."""
        return FollowingState(
            jax.lax.stop_gradient(self.profile).start(motion, waiting), self.core.blank(), motion
        )

    def step(self, state: FollowingState, command: Command) -> FollowingState:
        """Advance by one tick under a command; the new state contains the new motion of the
        shaft."""
        # The profile is already identified and is not trained, because its corners cause poor
        # gradients.
        fixed: Profile = jax.lax.stop_gradient(self.profile)
        profile, target = fixed.step(state.profile, command)
        before = fixed.shaft(state.profile.motion)
        now = fixed.shaft(profile.motion)
        velocity = self.scales.velocity_rad_s
        change = self.scales.change_rad_s
        behind = target.angle - now.angle
        faster = now.velocity - before.velocity
        odd = jnp.stack([behind / self.scales.angle_rad, now.velocity / velocity, faster / change])
        memory, outputs = self.core.step(
            state.memory, Parity((target.velocity / velocity)[None], odd)
        )
        # The network output is a correction in units of the scales: 1 is the shaft motion of one
        # tick at the typical velocity.
        angle = now.angle + TICK_S * velocity * outputs.odd[0]
        return FollowingState(
            profile, memory, Motion(angle, now.velocity + change * outputs.odd[1])
        )


class ForceNetConfig(Configuration):
    """Size of the force network."""

    units: PositiveInt = 16
    """Size of the even memory and of the odd memory."""
    hidden: PositiveInt = 32
    """Number of units in the layer between memory and force."""
    wake: int = Field(default=4, ge=0, le=64)
    """Number of wake vectors, which are fixed in tank axes. Their initial time constants are 0.05
    to 1.5 s."""

    @property
    def odd_features(self) -> int:
        """Number of odd quantities in a `ForceState`."""
        return self.units + self.wake + 3


class ForceState(NamedTuple):
    """State of the force network between ticks."""

    memory: Parity
    wake: Parity
    """Wake vectors, split into components along and across the fin [-]."""
    motion: Motion
    rates: Float[Array, "3"]
    """Rates of the motion in the last tick (`ForceNet.rates`) [-]."""

    def odd_features(self) -> Float[Array, "odd_features"]:
        """Return all odd quantities of the state; the torque about the shaft is odd as well."""
        return jnp.concatenate([self.memory.odd, self.wake.odd, self.rates])


class ForceNet(eqx.Module):
    """The force network of one fin, without batch axes.

    In the frame that rotates with the shaft, the angle has no effect, because still water is the
    same in all directions. The inputs of the network are therefore only rates, and the outputs are
    the force along the fin axis (thrust, even) and across it (odd). The wake, which does not rotate
    with the fin, is represented by a few vectors that are rotated back at each tick.
    """

    core: MirrorCore
    along: Float[Array, "wake_source wake"]
    """Weights from the even memory to the component of the wake along the fin."""
    across: Float[Array, "wake_source wake"]
    """Weights from the odd memory to the component of the wake across the fin."""
    log_time: Float[Array, "wake"]
    """Natural logarithm of the time constants of the wake in seconds."""
    thrust: Float[Array, "2"]
    """Coefficients of the force along the fin: velocity squared, and velocity times its change."""
    resistance: Float[Array, "3"]
    """Coefficients of the force across the fin: change of velocity (added mass), velocity times
    speed (drag), and velocity (friction)."""
    mount_turn: Float[Array, ""]
    """Angle of the sensor relative to the tank axes [rad]."""
    offset: Float[Array, "2"]
    """Reading of the sensor at zero force, divided by the force scale [-]."""
    torque: Float[Array, "odd_features"] | None
    """Coefficients of the torque on the fin [N m]; None if the logs do not contain it."""
    optional: ClassVar[tuple[str, ...]] = ("torque",)
    """Names of the fields that do not change the identity if they are None."""
    config: ForceNetConfig = eqx.field(static=True)
    scales: Scales = eqx.field(static=True)

    def __init__(self, config: ForceNetConfig, scales: Scales, key: PRNGKeyArray) -> None:
        self.core = MirrorCore(
            Parity(config.wake, 3 + config.wake), Parity(1, 1), config.units, config.hidden, key
        )
        self.along = jnp.zeros((config.units, config.wake))
        self.across = jnp.zeros((config.units, config.wake))
        self.log_time = jnp.log(jnp.geomspace(0.05, 1.5, config.wake))
        self.thrust = jnp.zeros(2)
        self.resistance = jnp.zeros(3)
        self.mount_turn = jnp.zeros(())
        self.offset = jnp.zeros(2)
        self.torque = None
        self.config = config
        self.scales = scales

    def start(self, motion: Motion) -> ForceState:
        """Return a state with an empty memory and the motion of the previous tick."""
        still = jnp.zeros(self.config.wake)
        return ForceState(self.core.blank(), Parity(still, still), motion, jnp.zeros(3))

    def step(self, state: ForceState, motion: Motion) -> tuple[ForceState, Float[Array, "2"]]:
        """Advance to a new motion of the shaft and predict the force reading (x, y) [N]."""
        rates = self.rates(state.motion, motion)
        # In the frame of the fin, the wake rotates in the direction opposite to the fin.
        turn = state.motion.angle - motion.angle
        wake = rotate(state.wake, jnp.cos(turn), jnp.sin(turn))
        memory, outputs = self.core.step(
            state.memory, Parity(wake.even, jnp.concatenate([rates, wake.odd]))
        )
        pushed = Parity(memory.even @ self.along, memory.odd @ self.across)
        force = self.force(outputs, rates, motion.angle)
        return ForceState(memory, relax(wake, pushed, self.kept()), motion, rates), force

    def rates(self, before: Motion, motion: Motion) -> Float[Array, "*shape 3"]:
        """Return the velocity, the change of velocity and the drag, in units of `scales`, for two
        successive motions ``(*shape,)``."""
        velocity = motion.velocity / self.scales.velocity_rad_s
        change = (motion.velocity - before.velocity) / self.scales.change_rad_s
        return jnp.stack([velocity, change, velocity * jnp.abs(velocity)], axis=-1)

    def force(
        self, outputs: Parity, rates: Float[Array, "3"], angle: Float[AnyArray, ""]
    ) -> Float[Array, "2"]:
        """Return the force reading (x, y) for the core outputs [N]."""
        # Morison's equation for a moving body: thrust and drag are proportional to the square of
        # the velocity, and the added-mass force to the change of velocity.
        velocity, change, drag = rates
        along = outputs.even[0] + self.thrust @ jnp.stack([velocity**2, velocity * change])
        across = outputs.odd[0] + self.resistance @ jnp.stack([change, drag, velocity])
        turn = self.mount_turn + angle
        reading = jnp.stack(rotate(Parity(along, across), jnp.cos(turn), jnp.sin(turn)))
        return self.scales.force_n * (reading + self.offset)

    def kept(self) -> Float[Array, "wake"]:
        """Return the fraction of each wake vector that remains after a tick."""
        return jnp.exp(-TICK_S * jnp.exp(-self.log_time))


def relax(wake: Parity, pushed: Parity, kept: Float[Array, "wake"]) -> Parity:
    """Advance wake vectors by one tick.

    Each wake vector w relaxes towards a vector p that depends on the memory, tau dw/dt = p - w. The
    exact solution over a tick is w' = k w + (1 - k) p, with k = exp(-TICK_S / tau).
    """
    relaxed: Parity = jax.tree.map(lambda old, new: kept * old + (1 - kept) * new, wake, pushed)
    return relaxed


def rotate(vector: Parity, cos: Array, sin: Array) -> Parity:
    """Rotate the components along and across a fin into the axes in which its angle is measured:
    (x, y) = along * (cos, -sin) + across * (sin, cos), where cos and sin belong to the angle of the
    fin."""
    along, across = vector
    return Parity(along * cos + across * sin, across * cos - along * sin)
