"""The soft fin: a tapered silicone plate that bends in the plane of beating, modelled as a chain of
rigid plates with elastic joints.

The first joint connects the fin to the shaft. A time step applies the implicit midpoint rule to
bending, structural damping, the resistance of the water, and the shaft. All other nonlinear terms
are evaluated at a midpoint predicted from the last accelerations. The method is second-order and
needs one linear solve per step. It is stable for any stiffness and damping, but not for large
rotations in one step (docs/appendix/tank.md, "Step of time").
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

    The default length, bracket, modulus and damping come from a calibration against the published
    fin (docs/appendix/tank.md). Span and thickness were fixed, because no log can separate them
    from modulus and drag.
    """

    plates: int = Field(8, ge=1, le=32)
    """Number of rigid plates [-]. The force error decreases at least with the square of this
    number."""
    length_m: float = Field(0.187, gt=0)
    """Length from the shaft to the tip [m]."""
    root_length_m: float = Field(0.0195, ge=0)
    """Length of the aluminium bracket that stiffens the root, measured from the shaft [m]."""
    span_m: float = Field(0.081, gt=0)
    """Span at the shaft, perpendicular to the plane of beating [m]."""
    tip_span_ratio: float = Field(1.0, gt=0)
    """Span at the tip divided by span at the shaft [-]."""
    root_thickness_m: float = Field(0.019, gt=0)
    """Thickness at the shaft [m]."""
    tip_thickness_ratio: float = Field(1.0, gt=0)
    """Thickness at the tip divided by thickness at the shaft [-]."""
    youngs_modulus_pa: float = Field(2.72e6, gt=0)
    """Young's modulus in bending [Pa]. A hardness of Shore A 22 corresponds to 0.8e6 (Gent 1958),
    or 1.1e6 in a plate."""
    density_kg_m3: float = Field(1150.0, gt=0)
    """Density of the silicone [kg/m3]; 1050 to 1200 for addition silicones."""
    damping_s: float = Field(0.0273, ge=0)
    """Kelvin-Voigt time: damping of each joint divided by its stiffness [s]. The default
    corresponds to a loss factor of 0.27 at 1.6 Hz."""

    def span(self, along: PlateSeries) -> PlateSeries:
        """Return the span of the fin at distances from the shaft [m]."""
        return self.span_m * (1 - (1 - self.tip_span_ratio) * along / self.length_m)

    def thickness(self, along: PlateSeries) -> PlateSeries:
        """Return the thickness of the fin at distances from the shaft [m]."""
        return self.root_thickness_m * (1 - (1 - self.tip_thickness_ratio) * along / self.length_m)


BRACKET_BENDING_N_M = 70e9 * 0.003**3 / 12
"""Bending stiffness of the aluminium bracket divided by its span [N m]: E t^3 / 12, with a modulus
of 70 GPa and an assumed thickness of 3 mm."""


def plate_moments(
    config: FinConfig, density: Callable[[PlateSeries], PlateSeries]
) -> tuple[PerPlate, PerPlate, PerPlate]:
    """Integrate rho(s), rho(s) s and rho(s) s^2 over each plate, for a density per length rho and
    the distance s from the inner end."""
    plate = config.length_m / config.plates
    # Gauss-Legendre with 4 points is exact up to degree 7. The density of a linear taper, span
    # times thickness or span squared, has degree 2, so the integrands have at most degree 4.
    nodes, weights = np.polynomial.legendre.leggauss(4)
    inside = (nodes[:, None] + 1) / 2 * plate
    mass = weights[:, None] / 2 * plate * density(np.arange(config.plates) * plate + inside)
    zeroth, first, second = (jnp.asarray((mass * inside**order).sum(0)) for order in range(3))
    return zeroth, first, second


def compliance(config: FinConfig) -> PlateSeries:
    """Return the compliance of each joint [rad/(N m)]: that of the beam between the midpoints of
    the adjacent plates.

    The beam bends everywhere, but the chain only at its joints. Each part of the beam is therefore
    weighted by the work that a load at the tip does in bending it. The deflection under such a load
    then equals that of the beam for any number of plates.
    """
    plate = config.length_m / config.plates
    joints = np.arange(config.plates) * plate
    middles = joints[:-1] + plate / 2
    start = np.append(0.0, middles)
    stop = np.append(middles, config.length_m)

    # 1 / k = 1 / (L - x_joint)^2 * integral of (L - x)^2 / EI(x), where EI = b (E t^3 / 12 + B)
    # with the stiffness B of the bracket. The integral is split at the end of the bracket.
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
    """Angle of each plate in the tank's axes [rad]."""
    rates: PerPlate
    """Angular velocity of each plate, including that of a rotating mount [rad/s]."""
    accelerations: PerPlate
    """Mean angular acceleration in the last step [rad/s2]."""
    earlier: PerPlate
    """Mean angular acceleration in the step before the last [rad/s2]."""


class Mount(NamedTuple):
    """Motion of the robot at the shaft during a tick, in the tank's axes, which rotate with the
    robot.

    Motion along the shaft and rotation about other axes are neglected, because they move the fin
    edgewise.
    """

    velocity: PlanarVector
    """Velocity (x, y) relative to the still water far away [m/s]."""
    acceleration: PlanarVector
    """Acceleration (x, y) relative to the still water far away [m/s2]."""
    turn: Scalar
    """Angular velocity about the shaft, with the sign of the shaft angle [rad/s]."""


class Shaft(NamedTuple):
    """The shaft during a time step."""

    angle: Scalar
    """Angle of the shaft at the start of the step [rad]."""
    play: Scalar
    """Backlash of the gearbox, over which the joint between shaft and fin transmits no torque
    [rad]."""
    turn: Callable[[Scalar, Scalar], Scalar]
    """Function from load [N m] and drag [N m s/rad] to the mean rate of the shaft [rad/s]. The fin
    exerts the torque load - drag * rate on the shaft."""
    carried: Scalar | float = 0.0
    """Angular velocity of the mount [rad/s]; the rate of the shaft is relative to the mount."""


class Surroundings(NamedTuple):
    """The water around the fin."""

    inertia: Moments
    """Added mass of each plate [kg, kg m, kg m2]."""
    stream: PlanarVector
    """Velocity (x, y) of the water relative to the mount [m/s]. Inertia and loads depend on the
    motion of the plates relative to it."""
    loads: Callable[[PlateMotion], tuple[Moments, PlateWrench]]
    """Function from relative motion to resistance [kg/s] and other forces [N], without inertia."""
    acceleration: PlanarVector | None = None
    """Acceleration (x, y) of the mount through the water [m/s2]; None if it does not move."""


class Fin(eqx.Module):
    """Plates and joints of the fin, as arrays."""

    plate_length: Scalar
    stiffness: PerPlate
    """Stiffness of the joint at the inner end of each plate [N m/rad]."""
    damping: PerPlate
    """Damping of the joint at the inner end of each plate [N m s/rad]."""
    inertia: Moments
    """Inertia of the fin without added mass [kg, kg m, kg m2]."""
    thickness: Float[Array, " points"]
    """Thickness at the shaft and at the outer end of each plate [m]; used only for drawing."""

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

    def rest(self, angle_rad: float = 0.0) -> FinState:
        """Return the state of a straight fin at rest at an angle."""
        still = jnp.zeros_like(self.stiffness)
        return FinState(jnp.full_like(still, angle_rad), still, still, still)

    def shape(self, state: FinState) -> Float[Array, "points 2"]:
        """Return the positions of the shaft and of each plate's outer end, in the tank's axes
        [m]."""
        plates = self.plate_length * jnp.stack(
            [-jnp.cos(state.angles), jnp.sin(state.angles)], axis=-1
        )
        return jnp.concatenate([jnp.zeros((1, 2), plates.dtype), jnp.cumsum(plates, axis=0)])

    def relative(self, state: FinState, around: Surroundings) -> PlateMotion:
        """Return the motion of each plate relative to the water."""
        stream = chain.components(state.angles, around.stream)
        relative: PlateMotion = jax.tree.map(jnp.subtract, self._motion(state), stream)
        return relative

    def momenta(self, state: FinState, around: Surroundings) -> tuple[PlanarVector, PlanarVector]:
        """Return the momenta of the fin and of its added mass, in the tank's axes [N s]."""
        return (
            chain.resultant(state.angles, self.inertia.times(self._motion(state))),
            chain.resultant(state.angles, around.inertia.times(self.relative(state, around))),
        )

    def inertial_force(self, state: FinState, around: Surroundings, mount: Mount) -> PlanarVector:
        """Return the part of the momenta's rate of change that the mount motion causes, in the
        mount axes [N].

        The other part is the change of `momenta` in these axes.
        """

        # dp/dt in rotating axes: the change of its components plus W x p = W (p_y, -p_x).
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
        """Advance by one time step; also return the shaft mean rate [rad/s] and the mean force of
        the loads [N] in the step.

        With the mean rates w over a step h, this solves, for the mass matrix M, the resistance R
        and the joint matrix G = h/2 (C + h/2 K):
        (M + h/2 R + G) w = M rates + h/2 (centripetal + loads - K bends).
        """
        half = seconds / 2
        # The midpoint rule leaves stiff modes ringing with a period of two steps. The mean of the
        # accelerations of two steps does not contain this ringing.
        predicted = state.rates + half * (state.accelerations + state.earlier) / 2
        angles = state.angles + half * (state.rates + predicted) / 2 - half * shaft.carried
        pose = chain.pose(angles, self.plate_length)
        stream = chain.components(angles, around.stream)
        motion = chain.motion(pose, predicted)
        relative = jax.tree.map(jnp.subtract, motion, stream)
        resistance, push = around.loads(relative)
        # The resistance acts on the motion relative to the stream. The stream's contribution is
        # known and moves to the right-hand side.
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
        # Angular impulse of the joints over half a step: `strains` for the initial bend, and
        # `grips` per mean bending rate.
        grips = half * (self.damping + half * self.stiffness)
        bends = state.angles - jnp.concatenate([shaft.angle[None], state.angles[:-1]])
        strains = half * self.stiffness * bends
        left = chain.momentum_matrix(
            pose, jax.tree.map(lambda m, r: m + half * r, inertia, resistance)
        )
        right = chain.project(pose, impulse) - _between(strains)
        # The first plate is solved separately, because the shaft's backlash and torque limit are
        # nonlinear.
        root_inertia, root_impulse, expand = chain.condense(left + _joint_matrix(grips), right)
        bend = state.angles[0] - shaft.angle
        first, rate = _held(
            root_inertia, root_impulse, shaft, self.stiffness[0], grips[0], bend, half
        )
        mean = expand(first)
        force = jax.tree.map(lambda f, r: f - r, push, resistance.times(chain.motion(pose, mean)))
        # The midpoint rule: mean = (rates + rates') / 2.
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
    """Return the mean rates of the first plate, and of the shaft relative to its mount, over a
    step.

    The step is first computed with a loose joint. If this leaves the joint within the play at the
    step's midpoint, the joint is loose; otherwise it is engaged, and its deflection is measured
    from the edge of the play that it has passed. A contact is therefore detected in the step in
    which it occurs.

    Args:
        inertia: Inertia at the first plate, from `chain.condense`.
        impulse: Angular impulse at the first plate, from `chain.condense`.
        shaft: The shaft.
        stiffness: Stiffness of the joint between shaft and plate [N m/rad].
        grip: Angular impulse of the engaged joint per relative rate [N m s2/rad].
        bend: Bend of the joint at the start of the step [rad].
        half: Half of the time step [s].
    """

    # inertia * first = impulse - strain - grip * (first - rate - carried). The torque on the shaft,
    # (strain + grip * (first - rate - carried)) / half, becomes load - drag * rate if `first` is
    # eliminated.
    def rates(strain: Scalar, grip: Scalar) -> tuple[Scalar, Scalar]:
        total = inertia + grip
        drag = grip * inertia / total
        load = (strain * inertia + grip * impulse) / total - drag * shaft.carried
        rate = shaft.turn(load / half, drag / half)
        return (impulse - strain + grip * (rate + shaft.carried)) / total, rate

    # All three cases are computed and one is selected, because a branch cannot depend on traced
    # values.
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
    """Return the difference of the joint torques at both ends of each plate, without the joint at
    the shaft."""
    inner = torques.at[0].set(0.0)
    return inner - jnp.append(inner[1:], 0.0)


def _joint_matrix(joints: PerPlate) -> PlateMatrix:
    """Return the tridiagonal matrix that maps plate angles to the moments of the joints, without
    the joint at the shaft."""
    inner = joints.at[0].set(0.0)
    below = jnp.diag(inner[1:], -1)
    return jnp.diag(inner + jnp.append(inner[1:], 0.0)) - below - below.T
