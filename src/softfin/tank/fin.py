"""The soft fin: a tapered silicone plate, bending in the plane of beating, modelled as a chain of
plates with elastic joints.

The first joint holds the fin on the shaft and transmits its load. One time step treats bending,
structural damping, the water's resistance and the shaft by the implicit midpoint rule, and the
remaining nonlinearity at a midpoint predicted from the last accelerations: second order in the
step, one linear solve. No stiffness and no damping makes it unstable, but a large rotation in one
step does (docs/appendix/tank.md, "Step of time").
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.tank import chain
from softfin.tank.chain import (
    Moments,
    PerPlate,
    PlanarVector,
    PlateMatrix,
    PlateMotion,
    PlateWrench,
    Scalar,
)

PlateSeries: TypeAlias = NDArray[np.floating[Any]]


class FinConfig(Configuration):
    """Geometry and material; thickness and span change linearly from root to tip.

    Length, bracket, modulus and damping come from a calibration against the published fin
    (docs/appendix/tank.md); span and thickness were fixed, because no recording can separate them
    from modulus and drag.
    """

    plates: int = Field(8, ge=1, le=32)
    """Rigid plates in the chain [-]; the error of the force falls at least with their number
    squared."""
    length_m: float = Field(0.187, gt=0)
    """Length from the shaft to the tip [m]."""
    root_length_m: float = Field(0.0195, ge=0)
    """Length of the aluminium bracket that stiffens the root, from the shaft [m]."""
    span_m: float = Field(0.081, gt=0)
    """Span across the plane of beating, at the shaft [m]."""
    tip_span_ratio: float = Field(1.0, gt=0)
    """Span at the tip divided by that at the shaft [-]."""
    root_thickness_m: float = Field(0.019, gt=0)
    """Thickness at the shaft [m]."""
    tip_thickness_ratio: float = Field(1.0, gt=0)
    """Thickness at the tip divided by that at the shaft [-]."""
    youngs_modulus_pa: float = Field(2.72e6, gt=0)
    """Young's modulus in bending [Pa]; the hardness, Shore A 22, gives 0.8e6 (Gent 1958), and 1.1e6
    in a plate."""
    density_kg_m3: float = Field(1150.0, gt=0)
    """Density of the silicone [kg/m3]; addition silicones have 1050 to 1200."""
    damping_s: float = Field(0.0273, ge=0)
    """Kelvin-Voigt time: damping divided by stiffness of each joint [s]; a loss factor of 0.27 at
    1.6 Hz."""

    def span(self, along: PlateSeries) -> PlateSeries:
        """Return the span of the fin at distances from the shaft [m]."""
        return self.span_m * (1 - (1 - self.tip_span_ratio) * along / self.length_m)

    def thickness(self, along: PlateSeries) -> PlateSeries:
        """Return the thickness of the fin at distances from the shaft [m]."""
        return self.root_thickness_m * (1 - (1 - self.tip_thickness_ratio) * along / self.length_m)


BRACKET_BENDING_N_M = 70e9 * 0.003**3 / 12
"""Bending stiffness over span of the aluminium bracket [N m]: 70 GPa, taken to be 3 mm thick."""


def plate_moments(
    config: FinConfig, density: Callable[[PlateSeries], PlateSeries]
) -> tuple[PerPlate, PerPlate, PerPlate]:
    """Integrate a density per length, times the distance from the inner end to the power 0, 1 and
    2, over each plate."""
    plate = config.length_m / config.plates
    # Exact for the cubic densities of a linear taper.
    nodes, weights = np.polynomial.legendre.leggauss(4)
    inside = (nodes[:, None] + 1) / 2 * plate
    mass = weights[:, None] / 2 * plate * density(np.arange(config.plates) * plate + inside)
    zeroth, first, second = (jnp.asarray((mass * inside**order).sum(0)) for order in range(3))
    return zeroth, first, second


def compliance(config: FinConfig) -> PlateSeries:
    """Return the compliance of each joint [rad/(N m)]: the beam's, from the middle of one plate to
    that of the next.

    Joints bend only where plates meet, a beam bends everywhere. Each part of the beam is therefore
    weighted by the work that a load at the tip does in bending it, so that the deflection under
    such a load equals that of the beam for any number of plates.
    """
    plate = config.length_m / config.plates
    joints = np.arange(config.plates) * plate
    middles = joints[:-1] + plate / 2
    start = np.append(0.0, middles)
    stop = np.append(middles, config.length_m)

    def work(start: PlateSeries, stop: PlateSeries, bracket: float) -> PlateSeries:
        nodes, weights = np.polynomial.legendre.leggauss(8)
        along = start + (nodes[:, None] + 1) / 2 * (stop - start)
        bending = config.span(along) * (
            config.youngs_modulus_pa * config.thickness(along) ** 3 / 12 + bracket
        )
        shares = weights[:, None] / 2 * (config.length_m - along) ** 2 / bending
        return np.asarray((stop - start) * shares.sum(axis=0))

    edge = np.clip(config.root_length_m, start, stop)
    whole = work(start, edge, BRACKET_BENDING_N_M) + work(edge, stop, 0.0)
    return np.asarray(whole / (config.length_m - joints) ** 2)


class FinState(NamedTuple):
    """State of the plates."""

    angles: PerPlate
    """Angle of each plate from the axes of the tank [rad]."""
    rates: PerPlate
    """Angular velocity of each plate, including that of a rotating mount [rad/s]."""
    accelerations: PerPlate
    """Accelerations in the last step [rad/s2]."""
    earlier: PerPlate
    """Accelerations in the step before that [rad/s2]."""


class Mount(NamedTuple):
    """Motion of the robot that carries the fin, at the shaft, during a tick; in the axes of the
    tank, which rotate with it.

    Motion along the shaft and rotation about other axes are left out, because they move the fin
    edgewise.
    """

    velocity: PlanarVector
    """Velocity (x, y) relative to the water far away, which is at rest [m/s]."""
    acceleration: PlanarVector
    """Acceleration (x, y) relative to that water [m/s2]."""
    turn: Scalar
    """Angular velocity about the shaft, in the sense of the shaft's angle [rad/s]."""


class Shaft(NamedTuple):
    """Motion of the shaft at the start of a step."""

    angle: Scalar
    """Angle of the shaft [rad]."""
    play: Scalar
    """Angle over which the joint between shaft and fin transmits nothing [rad]: the gearbox's
    backlash."""
    turn: Callable[[Scalar, Scalar], Scalar]
    """Function from load and drag to the shaft's mean rate [rad/s]; the fin exerts load - drag *
    rate on it."""
    carried: Scalar | float = 0.0
    """Angular velocity of the mount, to be added to the shaft's own rate [rad/s]."""


class Surroundings(NamedTuple):
    """Water in which the fin moves."""

    inertia: Moments
    """Inertia of the water that each plate carries [kg, kg m, kg m2]."""
    stream: PlanarVector
    """Velocity (x, y) of the water past the mount [m/s]; inertia and loads are those of the motion
    relative to it."""
    loads: Callable[[PlateMotion], tuple[Moments, PlateWrench]]
    """Effects of water on moving plates other than inertia: resistance [kg/s] and forces [N]."""
    acceleration: PlanarVector | None = None
    """Acceleration (x, y) of the mount through the water [m/s2]; None if it stands still."""


class Fin(eqx.Module):
    """Plates and joints of the fin as arrays."""

    plate_length: Scalar
    stiffness: PerPlate
    """Stiffness of the joint at the inner end of each plate [N m/rad]."""
    damping: PerPlate
    """Damping of the joint at the inner end of each plate [N m s/rad]."""
    inertia: Moments
    """Inertia of the fin itself, without the water [kg, kg m, kg m2]."""
    thickness: Float[Array, " points"]
    """Thickness at the shaft and the outer end of each plate [m]: used only for drawing, not for
    the motion."""

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

    def rest(self) -> FinState:
        """Return the state of a straight fin at angle 0, at rest."""
        still = jnp.zeros_like(self.stiffness)
        return FinState(still, still, still, still)

    def shape(self, state: FinState) -> Float[Array, "points 2"]:
        """Return the shaft and the outer end of each plate, in the axes of the tank [m]."""
        plates = self.plate_length * jnp.stack(
            [-jnp.cos(state.angles), jnp.sin(state.angles)], axis=-1
        )
        return jnp.concatenate([jnp.zeros((1, 2), plates.dtype), jnp.cumsum(plates, axis=0)])

    def relative(self, state: FinState, around: Surroundings) -> PlateMotion:
        """Return the motion of each plate relative to the stream."""
        stream = chain.components(state.angles, around.stream)
        relative: PlateMotion = jax.tree.map(jnp.subtract, self._motion(state), stream)
        return relative

    def momenta(self, state: FinState, around: Surroundings) -> tuple[PlanarVector, PlanarVector]:
        """Return the momenta of the fin itself and of the water it carries, in the axes of the tank
        [N s]."""
        return (
            chain.resultant(state.angles, self.inertia.times(self._motion(state))),
            chain.resultant(state.angles, around.inertia.times(self.relative(state, around))),
        )

    def inertial_force(self, state: FinState, around: Surroundings, mount: Mount) -> PlanarVector:
        """Return the part of the momenta's rate of change that is due to the mount's motion, in its
        axes [N].

        The rest is the change of `momenta` in those axes, at the mount's velocity.
        """

        def turned(vector: PlanarVector) -> PlanarVector:
            return mount.turn * jnp.stack([vector[1], -vector[0]])

        def needed(inertia: Moments, acceleration: PlanarVector) -> PlanarVector:
            return chain.resultant(
                state.angles, inertia.times(chain.components(state.angles, acceleration))
            )

        own, added = self.momenta(state, around)
        acceleration = mount.acceleration
        return (
            turned(own + added)
            + needed(self.inertia, acceleration)
            + needed(around.inertia, acceleration - turned(mount.velocity))
        )

    def step(
        self, state: FinState, shaft: Shaft, around: Surroundings, seconds: float
    ) -> tuple[FinState, Scalar, PlanarVector]:
        """Take one time step; also return the shaft's mean rate [rad/s] and the mean force of the
        loads [N] in it."""
        half = seconds / 2
        # The midpoint rule leaves stiff modes ringing from step to step; averaged over two steps
        # their accelerations cancel.
        predicted = state.rates + half * (state.accelerations + state.earlier) / 2
        angles = state.angles + half * (state.rates + predicted) / 2 - half * shaft.carried
        pose = chain.pose(angles, self.plate_length)
        stream = chain.components(angles, around.stream)
        motion = chain.motion(pose, predicted)
        relative = jax.tree.map(jnp.subtract, motion, stream)
        resistance, push = around.loads(relative)
        push = jax.tree.map(jnp.add, push, resistance.times(stream))
        inertia = jax.tree.map(jnp.add, self.inertia, around.inertia)
        driven = push
        if around.acceleration is not None:
            driven = jax.tree.map(
                jnp.subtract, push, inertia.times(chain.components(angles, around.acceleration))
            )
        impulse = jax.tree.map(
            lambda p, c, w, f: p + half * (c + w + f),
            inertia.times(chain.motion(pose, state.rates)),
            chain.centripetal(pose, self.inertia, motion),
            chain.centripetal(pose, around.inertia, relative),
            driven,
        )
        grips = half * (self.damping + half * self.stiffness)
        bends = state.angles - jnp.concatenate([shaft.angle[None], state.angles[:-1]])
        strains = half * self.stiffness * bends
        left = chain.momentum_matrix(
            pose, jax.tree.map(lambda m, r: m + half * r, inertia, resistance)
        )
        right = chain.project(pose, impulse) - _between(strains)
        root_inertia, root_impulse, expand = chain.condense(left + _joint_matrix(grips), right)
        bend = state.angles[0] - shaft.angle
        first, rate = _held(
            root_inertia, root_impulse, shaft, self.stiffness[0], grips[0], bend, half
        )
        mean = expand(first)
        force = jax.tree.map(lambda f, r: f - r, push, resistance.times(chain.motion(pose, mean)))
        after = FinState(
            state.angles + seconds * mean - seconds * shaft.carried,
            2 * mean - state.rates,
            (mean - state.rates) / half,
            state.accelerations,
        )
        return after, rate, chain.resultant(angles, force)

    def _motion(self, state: FinState) -> PlateMotion:
        return chain.motion(chain.pose(state.angles, self.plate_length), state.rates)


def _held(
    inertia: Scalar,
    impulse: Scalar,
    shaft: Shaft,
    stiffness: Scalar,
    grip: Scalar,
    bend: Scalar,
    half: float,
) -> tuple[Scalar, Scalar]:
    """Return the mean rates over a step of the first plate and of the shaft on its mount.

    The joint between them has a stiffness [N m/rad], a bend at the start [rad] and, when engaged, a
    grip: angular impulse per relative rate [N m s2/rad]. If the midpoint of the step, computed with
    a loose joint, is within the play, the joint is loose; otherwise it is strained from that edge
    of the play. A contact is therefore found in the step in which it happens, and takes up the
    motion softly.
    """

    def rates(strain: Scalar, grip: Scalar) -> tuple[Scalar, Scalar]:
        total = inertia + grip
        drag = grip * inertia / total
        load = (strain * inertia + grip * impulse) / total - drag * shaft.carried
        rate = shaft.turn(load / half, drag / half)
        return (impulse - strain + grip * (rate + shaft.carried)) / total, rate

    nothing = jnp.zeros_like(grip)
    first, rate = rates(nothing, nothing)
    edge = shaft.play / 2
    middle = bend + half * (first - rate - shaft.carried)
    for beyond, slack in ((middle >= edge, edge), (middle <= -edge, -edge)):
        tight = rates(half * stiffness * (bend - slack), grip)
        first = jnp.where(beyond, tight[0], first)
        rate = jnp.where(beyond, tight[1], rate)
    return first, rate


def _between(torques: PerPlate) -> PerPlate:
    """Return the moments that the joints between plates, all except the first, exert on each
    plate."""
    inner = torques.at[0].set(0.0)
    return inner - jnp.append(inner[1:], 0.0)


def _joint_matrix(joints: PerPlate) -> PlateMatrix:
    """Return the tridiagonal matrix that maps plate angles to the moments of the joints between
    plates."""
    inner = joints.at[0].set(0.0)
    below = jnp.diag(inner[1:], -1)
    return jnp.diag(inner + jnp.append(inner[1:], 0.0)) - below - below.T
