"""The networks of one fin, tick by tick: drive network (commands to motion) and force network
(motion to force).

A fin mirrored in the plane y = 0 is the same fin: angle, angular velocity and force y change sign
(odd), force x and speeds do not (even). The recurrent core of both networks has this symmetry built
into its weights.
"""

from typing import Any, Literal, NamedTuple

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
"""Longest initial time constant of the gates [ticks]; the shortest is 2, so that both ripples and
strokes are remembered."""


class Parity(NamedTuple):
    """Sizes, inputs, outputs or memory, split by parity: even parts are unchanged by the mirror,
    odd ones change sign."""

    even: PyTree
    odd: PyTree


class MirrorCore(eqx.Module):
    """A gated recurrent unit, h' = h + u (c - h) with a gate u and a candidate c; mirrors inputs to
    outputs exactly.

    Odd candidates are odd functions of odd inputs; gates, even candidates and what multiplies the
    odd ones are functions of even inputs and of `magnitude` of mixtures of the odd ones.
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
        # In random order, so that the gates open by 1 / time constant.
        gates = jax.random.permutation(
            keys[2], -jnp.log(jnp.geomspace(2.0, SLOWEST, 2 * units) - 1)
        )
        self.bias = jnp.concatenate([gates, jnp.zeros(units), jnp.ones(units)])
        self.hidden_in = _uniform(keys[3], 2 * units, hidden)
        self.hidden_bias = jnp.zeros(hidden)
        # Zero, so that training starts from the physical model alone.
        self.even_out = jnp.zeros((hidden, outputs.even))
        self.odd_out = jnp.zeros((units, outputs.odd))
        self.odd_factors = jnp.zeros((hidden, outputs.odd * units))

    def blank(self) -> Parity:
        """Return an empty memory."""
        return Parity(jnp.zeros(self.units), jnp.zeros(self.units))

    def step(self, memory: Parity, inputs: Parity) -> tuple[Parity, Parity]:
        """Advance by one tick: (memory, inputs) -> (memory, outputs)."""
        n = self.units
        # A linear map without bias keeps odd inputs odd; the magnitudes of the mixtures are even,
        # so they may enter the gates.
        candidates, mixtures = jnp.split(jnp.concatenate([memory.odd, inputs.odd]) @ self.odd_in, 2)
        sizes = magnitude(mixtures)
        gates = jnp.concatenate([memory.even, inputs.even, sizes]) @ self.even_in + self.bias
        opening = jax.nn.sigmoid(gates[: 2 * n])
        # h' = h + u (c - h). A product of an odd candidate and an even factor is odd, and so is its
        # tanh.
        even = memory.even + opening[:n] * (jnp.tanh(gates[2 * n : 3 * n]) - memory.even)
        odd = memory.odd + opening[n:] * (jnp.tanh(candidates * gates[3 * n :]) - memory.odd)
        hidden = jnp.tanh(jnp.concatenate([even, sizes]) @ self.hidden_in + self.hidden_bias)
        # The odd outputs are linear in the odd memory, with weights that depend on the even part.
        factors = self.odd_out.T + (hidden @ self.odd_factors).reshape(-1, n)
        return Parity(even, odd), Parity(hidden @ self.even_out, factors @ odd)


def magnitude(x: Array) -> Array:
    """Return sqrt(1 + x^2) - 1: even and smooth, x^2 / 2 where small and |x| where large, as drag
    in the velocity."""
    return jnp.sqrt(1 + x * x) - 1


def _uniform(key: PRNGKeyArray, inputs: int, outputs: int) -> Float[Array, "inputs outputs"]:
    """Draw entries with a variance of 1/2 divided by the number of inputs: less than preserves the
    spread, because all memory is fed back."""
    reach = jnp.sqrt(1.5 / inputs)
    return jax.random.uniform(key, (inputs, outputs), minval=-reach, maxval=reach)


def products(net: eqx.Module) -> int:
    """Return the number of multiplications of one tick: every matrix of one fin's networks is used
    once."""
    return sum(leaf.size for leaf in jax.tree.leaves(net) if leaf.ndim == 2)


class DriveNetConfig(Configuration):
    """Size of the drive network, and its built-in structure, which is fixed but stored with it."""

    units: PositiveInt = 8
    """Size of the memory of each parity."""
    hidden: PositiveInt = 16
    """Units of the layer between memory and output."""
    mirror: Literal[True] = True
    """The drive behaves the same in both directions."""
    profile: Literal[True] = True
    """The trapezoidal profile is known, and the network adds only the rest: the fin's load, the
    servo, the play."""


class FollowingState(NamedTuple):
    """State that the drive network carries from tick to tick."""

    profile: ProfileState
    memory: Parity
    motion: Motion


class FollowingNet(eqx.Module):
    """The drive network, which predicts the deviation of the shaft from its profile; one fin, no
    batch axes."""

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
        """Return the state for a given motion and the commands of the last `MAX_DELAY` ticks,
        newest first."""
        return FollowingState(
            jax.lax.stop_gradient(self.profile).start(motion, waiting), self.core.blank(), motion
        )

    def step(self, state: FollowingState, command: Command) -> FollowingState:
        """Advance by one tick under a command; `motion` of the new state is the new motion of the
        shaft."""
        # Identified before and not trained: its corners give poor gradients.
        fixed: Any = jax.lax.stop_gradient(self.profile)
        profile, target = fixed.step(state.profile, command)
        before = fixed.motion(state.profile)
        now = fixed.motion(profile)
        velocity = self.scales.velocity_rad_s
        change = self.scales.change_rad_s
        behind = target.angle - now.angle
        faster = now.velocity - before.velocity
        odd = jnp.stack([behind / self.scales.angle_rad, now.velocity / velocity, faster / change])
        memory, outputs = self.core.step(
            state.memory, Parity((target.velocity / velocity)[None], odd)
        )
        # An output of 1 moves the shaft by about one tick's motion: the network is a correction.
        angle = now.angle + TICK_S * velocity * outputs.odd[0]
        return FollowingState(
            profile, memory, Motion(angle, now.velocity + change * outputs.odd[1])
        )


class ForceNetConfig(Configuration):
    """Size of the force network, and its built-in structure, which is fixed but stored with it."""

    units: PositiveInt = 16
    """Size of the memory of each parity."""
    hidden: PositiveInt = 32
    """Units of the layer between memory and force."""
    wake: int = Field(default=4, ge=0, le=64)
    """Number of vectors remembered in the tank's axes; their initial time constants are 0.05 to 1.5
    s."""
    mirror: Literal[True] = True
    """Mirrored motion gives mirrored force."""
    turning: Literal[True] = True
    """The force turns with the fin: the tank is the same in all directions."""
    quasi_steady: Literal[True] = True
    """Whether a force of added mass and drag, with fitted coefficients, is added to the output of
    the network."""
    heteroscedastic: Literal[False] = False
    """The network does not learn the scatter of the readings about its force."""


class ForceState(NamedTuple):
    """State that the force network carries from tick to tick."""

    memory: Parity
    wake: Parity
    """Components along and across the fin [1]."""
    motion: Motion


class ForceNet(eqx.Module):
    """The force network of one fin; no batch axes.

    In the frame that rotates with the shaft the angle has no effect, because still water looks the
    same in all directions. The network therefore takes only rates, and returns the force along the
    fin's axis (thrust, even) and across it (odd). The wake, which stays in the tank's axes, is
    represented by a few vectors that are rotated back at each tick.
    """

    core: MirrorCore
    along: Float[Array, "wake_source wake"]
    """Weights with which the memory pushes the wake along the fin."""
    across: Float[Array, "wake_source wake"]
    """Weights with which the memory pushes the wake across the fin."""
    log_time: Float[Array, "wake"]
    """Logarithm of the wake's time constants [s]."""
    thrust: Float[Array, "2"]
    """Coefficients of velocity squared and velocity times its change."""
    resistance: Float[Array, "3"]
    """Coefficients of the velocity's change (added mass), velocity times speed (drag) and velocity
    (friction)."""
    mount_turn: Float[Array, ""]
    """Angle of the sensor relative to the tank's axes [rad]."""
    offset: Float[Array, "2"]
    """Offset of the sensor: its reading at zero force [force scale]."""
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
        self.config = config
        self.scales = scales

    def start(self, motion: Motion) -> ForceState:
        """Return a state that remembers only the motion of the tick before."""
        still = jnp.zeros(self.config.wake)
        return ForceState(self.core.blank(), Parity(still, still), motion)

    def step(self, state: ForceState, motion: Motion) -> tuple[ForceState, Float[Array, "2"]]:
        """Advance to the new motion of the shaft; predicts the force (x, y) read at that moment
        [N]."""
        # Seen from a fin that has turned, the tank has turned the other way.
        wake = Parity(*_turned(state.wake.even, state.wake.odd, state.motion.angle - motion.angle))
        # Morison's force on a moving body: thrust and drag grow with the square of the velocity,
        # added mass with its change. All rates are in units of `scales`.
        velocity = motion.velocity / self.scales.velocity_rad_s
        change = (motion.velocity - state.motion.velocity) / self.scales.change_rad_s
        drag = velocity * jnp.abs(velocity)
        rates = jnp.stack([velocity, change, drag])
        memory, outputs = self.core.step(
            state.memory, Parity(wake.even, jnp.concatenate([rates, wake.odd]))
        )
        along = outputs.even[0] + self.thrust @ jnp.stack([velocity**2, velocity * change])
        across = outputs.odd[0] + self.resistance @ jnp.stack([change, drag, velocity])
        x, y = _turned(along, across, self.mount_turn + motion.angle)
        force = self.scales.force_n * (jnp.stack([x, y]) + self.offset)
        # Each vector of the wake w relaxes towards the push p of the fin, tau w' = p - w, solved
        # exactly over one tick.
        kept = jnp.exp(-TICK_S * jnp.exp(-self.log_time))
        pushed = Parity(memory.even @ self.along, memory.odd @ self.across)
        wake = jax.tree.map(lambda old, new: kept * old + (1 - kept) * new, wake, pushed)
        return ForceState(memory, wake, motion), force


def _turned(along: Array, across: Array, angle: AnyArray) -> tuple[Array, Array]:
    """Components along (cos, -sin) and across (sin, cos) of an angle, in the axes from which the
    angle is counted."""
    cos = jnp.cos(angle)
    sin = jnp.sin(angle)
    return along * cos + across * sin, across * cos - along * sin
