"""The soft fin: a tapered silicone plate, bending in the plane of beating, as a chain of plates with sprung joints.

The first joint holds the fin on the shaft, and loads it back. One step of time takes bending, structural damping, the
water's resistance and the shaft by the implicit midpoint rule, and what is left of the nonlinearity at a midpoint that
the last accelerations foretell: second order in the step, one linear solve. No stiffness and no damping makes it
unstable; turning far in one step does (docs/tank.md, "Step of time").
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from softfin.core.compilation import used_once
from softfin.tank import chain
from softfin.tank.chain import Moments, Motion, PerPlate, Scale, Wrench
from softfin.tank.geometry import FinConfig, compliance, plate_moments


class FinState(NamedTuple):
    """State of the plates."""

    angles: PerPlate
    """Absolute angle of each plate [rad]."""
    rates: PerPlate
    """Angular velocity of each plate [rad/s]."""
    accelerations: PerPlate
    """Accelerations in the last step [rad/s2]."""
    earlier: PerPlate
    """Accelerations in the step before that [rad/s2]."""


Turn = Callable[[Float[Array, ""], Float[Array, ""]], Float[Array, ""]]
"""The shaft's mean rate of turning [rad/s], where the fin exerts load - drag * rate on it."""


class Shaft(NamedTuple):
    """What the fin hangs on, at the start of a step."""

    angle: Float[Array, ""]
    """Angle of the shaft [rad]."""
    play: Float[Array, ""]
    """Angle over which the joint between shaft and fin transmits nothing [rad]: the gearbox's backlash."""
    turn: Turn
    """Mean rate of the shaft over the step, by the moment with which the fin loads it."""


Loads = Callable[[Motion], tuple[Moments, Wrench]]
"""What water does besides its inertia to plates that move in it: resists [kg/s], and exerts forces [N]."""


class Surroundings(NamedTuple):
    """What the fin moves in."""

    inertia: Moments
    """Inertia of the water that each plate carries [kg, kg m, kg m2]."""
    stream: Float[Array, "2"]
    """Velocity (x, y) of the water far from the fin [m/s]; inertia and loads are those of the motion relative to it."""
    loads: Loads


class Fin(eqx.Module):
    """Plates and joints of the fin as arrays."""

    plate_length: Float[Array, ""]
    stiffness: PerPlate
    """Stiffness of the joint at the inner end of each plate [N m/rad]."""
    damping: PerPlate
    """Damping of the joint at the inner end of each plate [N m s/rad]."""
    inertia: Moments
    """Inertia of the fin itself, without the water [kg, kg m, kg m2]."""
    thickness: Float[Array, " points"]
    """Thickness at the shaft and the outer end of each plate [m]: not needed for motion, only to be drawn."""

    def __init__(self, config: FinConfig):
        plate = config.length_m / config.plates
        stiffness = 1 / compliance(config)
        self.plate_length = jnp.asarray(plate, float)
        self.stiffness = jnp.asarray(stiffness)
        self.damping = jnp.asarray(stiffness * config.damping_s)
        zeroth, first, second = plate_moments(
            config, lambda s: config.density_kg_m3 * config.span(s) * config.thickness(s)
        )
        self.inertia = Moments(zeroth, first, second, along=zeroth)
        self.thickness = jnp.asarray(config.thickness(np.arange(config.plates + 1) * plate))

    def scaled(self, stiffness: Scale = 1.0, length: Scale = 1.0, thickness: Scale = 1.0) -> "Fin":
        """Return another casting of the same fin, its bracket in proportion; damping keeps its time."""
        bending = stiffness * thickness**3 / length
        changed: Fin = eqx.tree_at(
            lambda fin: (fin.plate_length, fin.stiffness, fin.damping, fin.inertia, fin.thickness),
            self,
            (
                self.plate_length * length,
                self.stiffness * bending,
                self.damping * bending,
                self.inertia.stretched(length, thickness),
                self.thickness * thickness,
            ),
        )
        return changed

    def rest(self) -> FinState:
        """Return the state straight along angle 0, still."""
        return FinState(*(jnp.zeros_like(self.stiffness) for _ in FinState._fields))

    def shape(self, state: FinState) -> Float[Array, "points 2"]:
        """Return the shaft and the outer end of each plate, in the axes of the tank [m]."""
        plates = self.plate_length * jnp.stack([-jnp.cos(state.angles), jnp.sin(state.angles)], axis=-1)
        return jnp.concatenate([jnp.zeros((1, 2), plates.dtype), jnp.cumsum(plates, axis=0)])

    def relative(self, state: FinState, around: Surroundings) -> Motion:
        """Return the motion of each plate relative to the stream."""
        return self._motion(state).less(chain.components(state.angles, around.stream))

    def momenta(self, state: FinState, around: Surroundings) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        """Return the momenta of the fin itself and of the water that it carries, in the axes of the tank [N s]."""
        return (
            chain.resultant(state.angles, self.inertia.times(self._motion(state))),
            chain.resultant(state.angles, around.inertia.times(self.relative(state, around))),
        )

    def energy(self, state: FinState, shaft_angle: Float[Array, ""], inertia: Moments) -> Float[Array, ""]:
        """Return the kinetic and elastic energy [J], in still water and without play."""
        motion = self._motion(state)
        momentum = inertia.times(motion)
        kinetic = sum((p * v).sum() for p, v in zip(momentum, motion, strict=True)) / 2
        bends = _bends(state.angles, shaft_angle)
        return kinetic + (self.stiffness * bends**2).sum() / 2

    def frequencies(self, inertia: Moments) -> NDArray[np.floating[Any]]:
        """Return natural frequencies about straight with that inertia, clamped and undamped, lowest first [rad/s]."""
        mass, stiffness = _vibrating(self.plate_length, self.stiffness, inertia)
        factor = np.linalg.inv(np.linalg.cholesky(mass))
        return np.sqrt(np.linalg.eigvalsh(factor @ stiffness @ factor.T))

    def step(
        self, state: FinState, shaft: Shaft, around: Surroundings, seconds: float
    ) -> tuple[FinState, Float[Array, ""], Float[Array, "2"]]:
        """Take one step of time; return also the shaft's mean rate in it [rad/s] and the loads' mean force [N]."""
        half = seconds / 2
        # The midpoint rule leaves stiff modes ringing from step to step; over two steps their accelerations cancel.
        predicted = state.rates + half * (state.accelerations + state.earlier) / 2
        angles = state.angles + half * (state.rates + predicted) / 2
        pose = chain.pose(angles, self.plate_length)
        stream = chain.components(angles, around.stream)
        motion = chain.motion(pose, predicted)
        relative = motion.less(stream)
        resistance, push = around.loads(relative)
        push = jax.tree.map(jnp.add, push, resistance.times(stream))
        inertia = jax.tree.map(jnp.add, self.inertia, around.inertia)
        impulse = jax.tree.map(
            lambda p, c, w, f: p + half * (c + w + f),
            inertia.times(chain.motion(pose, state.rates)),
            chain.centripetal(pose, self.inertia, motion),
            chain.centripetal(pose, around.inertia, relative),
            push,
        )
        grips = half * (self.damping + half * self.stiffness)
        strains = half * self.stiffness * _bends(state.angles, shaft.angle)
        left = chain.matrix(pose, jax.tree.map(lambda m, r: m + half * r, inertia, resistance))
        right = chain.project(pose, impulse) - _between(strains)
        rates: list[Float[Array, ""]] = []

        def root(inertia: Float[Array, ""], impulse: Float[Array, ""]) -> Float[Array, ""]:
            first, rate = _held(
                inertia, impulse, shaft, Joint(self.stiffness[0], grips[0], state.angles[0] - shaft.angle), half
            )
            rates.append(rate)
            return first

        mean = chain.solve(left + _joint_matrix(grips), right, root)
        force = jax.tree.map(lambda f, r: f - r, push, resistance.times(chain.motion(pose, mean)))
        after = FinState(
            state.angles + seconds * mean, 2 * mean - state.rates, (mean - state.rates) / half, state.accelerations
        )
        return after, rates[0], chain.resultant(angles, force)

    def _motion(self, state: FinState) -> Motion:
        return chain.motion(chain.pose(state.angles, self.plate_length), state.rates)


class Joint(NamedTuple):
    """Joint between the shaft and the first plate."""

    stiffness: Float[Array, ""]
    """Stiffness of the joint [N m/rad]."""
    grip: Float[Array, ""]
    """Angular impulse over relative rate in a step, where the joint is tight [N m s2/rad]."""
    bend: Float[Array, ""]
    """Bend of the joint at the start of the step [rad]."""


def _held(
    inertia: Float[Array, ""], impulse: Float[Array, ""], shaft: Shaft, joint: Joint, half: float
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean rates of the first plate and of the shaft over a step.

    Where the step's midpoint would be within the joint's play if it were loose, it is loose; beyond, it is strained
    from that edge of the play. So a contact is found in the step in which it happens, and takes the motion up softly.
    """

    def rates(strain: Float[Array, ""], grip: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        total = inertia + grip
        load = (strain * inertia + grip * impulse) / total
        rate = shaft.turn(load / half, grip * inertia / total / half)
        return (impulse - strain + grip * rate) / total, rate

    nothing = jnp.zeros_like(joint.grip)
    first, rate = rates(nothing, nothing)
    edge = shaft.play / 2
    middle = joint.bend + half * (first - rate)
    for beyond, slack in ((middle >= edge, edge), (middle <= -edge, -edge)):
        tight = rates(half * joint.stiffness * (joint.bend - slack), joint.grip)
        first, rate = jnp.where(beyond, tight[0], first), jnp.where(beyond, tight[1], rate)
    return first, rate


@used_once
def _vibrating(
    plate_length: Float[Array, ""], stiffness: PerPlate, inertia: Moments
) -> tuple[Float[Array, "plates plates"], Float[Array, "plates plates"]]:
    """Mass and stiffness matrices about straight, clamped."""
    straight = chain.pose(jnp.zeros_like(stiffness), plate_length)
    return chain.matrix(straight, inertia), _joint_matrix(stiffness).at[0, 0].add(stiffness[0])


def _bends(angles: PerPlate, shaft_angle: Float[Array, ""]) -> PerPlate:
    return angles - jnp.concatenate([shaft_angle[None], angles[:-1]])


def _between(torques: PerPlate) -> PerPlate:
    """What the joints between plates, all but the first, take from each plate."""
    inner = torques.at[0].set(0.0)
    return inner - jnp.append(inner[1:], 0.0)


def _joint_matrix(joints: PerPlate) -> Float[Array, "plates plates"]:
    """The tridiagonal matrix that takes angles of plates to what the joints between them take from each."""
    inner = joints.at[0].set(0.0)
    below = jnp.diag(inner[1:], -1)
    return jnp.diag(inner + jnp.append(inner[1:], 0.0)) - below - below.T
