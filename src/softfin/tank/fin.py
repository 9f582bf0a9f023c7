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
from pydantic import Field, model_validator

from softfin.configuration import Configuration
from softfin.tank import chain
from softfin.tank.chain import Moments, Motion, PerPlate, Scale, Wrench


class FinConfig(Configuration):
    """Geometry and material; thickness and span change linearly from root to tip.

    Length, bracket, modulus and damping are a calibration's against the published fin (docs/tank.md); span and
    thickness were held, as no recording tells them from modulus and drag.
    """

    plates: int = Field(8, ge=1, le=32)
    """Rigid plates in the chain [-]; the error of the force falls at least as their number squared."""
    length_m: float = Field(0.187, gt=0)
    """From the shaft to the tip [m]."""
    root_length_m: float = Field(0.0195, ge=0)
    """Of the aluminium bracket that stiffens the root, from the shaft [m]."""
    span_m: float = Field(0.081, gt=0)
    """Across the plane of beating, at the shaft [m]."""
    tip_span_ratio: float = Field(1.0, gt=0)
    """Span at the tip over that at the shaft [-]."""
    root_thickness_m: float = Field(0.019, gt=0)
    """At the shaft [m]."""
    tip_thickness_ratio: float = Field(1.0, gt=0)
    """Thickness at the tip over that at the shaft [-]."""
    youngs_modulus_pa: float = Field(2.72e6, gt=0)
    """In bending [Pa]; from the silicone's hardness, Shore A 22, one expects 0.8e6 (Gent 1958), 1.1e6 in a plate."""
    density_kg_m3: float = Field(1150.0, gt=0)
    """Of the silicone [kg/m3]; addition silicones have 1050 to 1200."""
    damping_s: float = Field(0.0273, ge=0)
    """Kelvin-Voigt time: damping over stiffness of each joint [s]; a loss factor of 0.27 at 1.6 Hz."""

    @model_validator(mode="after")
    def _within(self) -> "FinConfig":
        if self.root_length_m > self.length_m:
            raise ValueError(f"root_length_m must not be above length_m = {self.length_m:g}")
        return self

    def span(self, along: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Of the fin at distances from the shaft [m]."""
        return self.span_m * (1 - (1 - self.tip_span_ratio) * along / self.length_m)

    def thickness(self, along: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Of the fin at distances from the shaft [m]."""
        return self.root_thickness_m * (1 - (1 - self.tip_thickness_ratio) * along / self.length_m)


BRACKET_BENDING_N_M = 70e9 * 0.003**3 / 12
"""Bending stiffness over span of the aluminium bracket [N m]: 70 GPa, taken to be 3 mm thick."""


class FinState(NamedTuple):
    """Of the plates."""

    angles: PerPlate
    """Absolute [rad]."""
    rates: PerPlate
    """[rad/s]"""
    accelerations: PerPlate
    """In the last step [rad/s2]."""
    earlier: PerPlate
    """In the step before that [rad/s2]."""


Turn = Callable[[Float[Array, ""], Float[Array, ""]], Float[Array, ""]]
"""The shaft's mean rate of turning [rad/s], where the fin exerts load - drag * rate on it."""


class Shaft(NamedTuple):
    """What the fin hangs on, at the start of a step."""

    angle: Float[Array, ""]
    """[rad]"""
    play: Float[Array, ""]
    """Angle over which the joint between shaft and fin transmits nothing [rad]: the gearbox's backlash."""
    turn: Turn
    """Its mean rate over the step, by the moment with which the fin loads it."""


Loads = Callable[[Motion], tuple[Moments, Wrench]]
"""What water does besides its inertia to plates that move in it: resists [kg/s], and exerts forces [N]."""


class Surroundings(NamedTuple):
    """What the fin moves in."""

    inertia: Moments
    """Of the water that each plate carries [kg, kg m, kg m2]."""
    stream: Float[Array, "2"]
    """Velocity (x, y) of the water far from the fin [m/s]; inertia and loads are those of the motion relative to it."""
    loads: Loads


class Fin(eqx.Module):
    """What a step needs to know of the fin."""

    plate_length: Float[Array, ""]
    stiffness: PerPlate
    """Of the joint at the inner end of each plate [N m/rad]."""
    damping: PerPlate
    """Likewise [N m s/rad]."""
    inertia: Moments
    """Of the fin itself, without the water [kg, kg m, kg m2]."""

    def __init__(self, config: FinConfig):
        plate = config.length_m / config.plates
        stiffness = 1 / _compliance(config)
        self.plate_length = jnp.asarray(plate)
        self.stiffness = jnp.asarray(stiffness)
        self.damping = jnp.asarray(stiffness * config.damping_s)
        zeroth, first, second = plate_moments(
            config, lambda s: config.density_kg_m3 * config.span(s) * config.thickness(s)
        )
        self.inertia = Moments(zeroth, first, second, along=zeroth)

    def scaled(self, stiffness: Scale = 1.0, length: Scale = 1.0, thickness: Scale = 1.0) -> "Fin":
        """Another casting of the same fin, its bracket in proportion; damping keeps its time."""
        bending = stiffness * thickness**3 / length
        changed: Fin = eqx.tree_at(
            lambda fin: (fin.plate_length, fin.stiffness, fin.damping, fin.inertia),
            self,
            (
                self.plate_length * length,
                self.stiffness * bending,
                self.damping * bending,
                self.inertia.stretched(length, thickness),
            ),
        )
        return changed

    def rest(self) -> FinState:
        """Straight along angle 0, still."""
        return FinState(*(jnp.zeros_like(self.stiffness) for _ in FinState._fields))

    def shape(self, state: FinState) -> Float[Array, "points 2"]:
        """The shaft and the outer end of each plate, in the axes of the tank [m]."""
        plates = self.plate_length * jnp.stack([-jnp.cos(state.angles), jnp.sin(state.angles)], axis=-1)
        return jnp.concatenate([jnp.zeros((1, 2), plates.dtype), jnp.cumsum(plates, axis=0)])

    def relative(self, state: FinState, around: Surroundings) -> Motion:
        """Of each plate, relative to the stream."""
        return self._motion(state).less(chain.components(state.angles, around.stream))

    def momenta(self, state: FinState, around: Surroundings) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        """Of the fin itself and of the water that it carries, in the axes of the tank [N s]."""
        return (
            chain.resultant(state.angles, self.inertia.times(self._motion(state))),
            chain.resultant(state.angles, around.inertia.times(self.relative(state, around))),
        )

    def energy(self, state: FinState, shaft_angle: Float[Array, ""], inertia: Moments) -> Float[Array, ""]:
        """Kinetic and elastic [J], in still water and without play."""
        motion = self._motion(state)
        momentum = inertia.times(motion)
        kinetic = sum((p * v).sum() for p, v in zip(momentum, motion, strict=True)) / 2
        bends = _bends(state.angles, shaft_angle)
        return kinetic + (self.stiffness * bends**2).sum() / 2

    def frequencies(self, inertia: Moments) -> NDArray[np.floating[Any]]:
        """Natural frequencies about straight with that inertia, clamped and undamped, lowest first [rad/s]."""
        straight = chain.pose(jnp.zeros_like(self.stiffness), self.plate_length)
        factor = np.linalg.inv(np.linalg.cholesky(chain.matrix(straight, inertia)))
        stiffness = np.array(_joint_matrix(self.stiffness))
        stiffness[0, 0] += self.stiffness[0]
        return np.sqrt(np.linalg.eigvalsh(factor @ stiffness @ factor.T))

    def step(
        self, state: FinState, shaft: Shaft, around: Surroundings, seconds: float
    ) -> tuple[FinState, Float[Array, ""], Float[Array, "2"]]:
        """One step of time; also the mean rate of the shaft in it [rad/s] and the mean force of the loads [N]."""
        half = seconds / 2
        # A stiff mode that the midpoint rule leaves ringing from step to step has no part in the two steps' mean.
        foretold = state.rates + half * (state.accelerations + state.earlier) / 2
        angles = state.angles + half * (state.rates + foretold) / 2
        pose = chain.pose(angles, self.plate_length)
        stream = chain.components(angles, around.stream)
        motion = chain.motion(pose, foretold)
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
    """Between the shaft and the first plate."""

    stiffness: Float[Array, ""]
    """[N m/rad]"""
    grip: Float[Array, ""]
    """What it transmits in a step of their relative rate, where it is tight [N m s2/rad]."""
    bend: Float[Array, ""]
    """At the start of the step [rad]."""


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


def plate_moments(
    config: FinConfig, density: Callable[[NDArray[np.floating[Any]]], NDArray[np.floating[Any]]]
) -> tuple[PerPlate, PerPlate, PerPlate]:
    """Integrals of a density per length, times distance from the inner end to the power 0, 1, 2, over each plate."""
    plate = config.length_m / config.plates
    # Exact for the cubic densities of a linear taper.
    nodes, weights = np.polynomial.legendre.leggauss(4)
    inside = (nodes[:, None] + 1) / 2 * plate
    mass = weights[:, None] / 2 * plate * density(np.arange(config.plates) * plate + inside)
    zeroth, first, second = (jnp.asarray((mass * inside**order).sum(0)) for order in range(3))
    return zeroth, first, second


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


def _compliance(config: FinConfig) -> NDArray[np.floating[Any]]:
    """Of each joint [rad/(N m)]: the beam's, from the middle of one plate to that of the next.

    The joints bend where their plates meet, the beam all along between. So each piece of beam counts by the work that a
    load on the tip does in bending it, which makes the deflection under such a load that of the beam, however few the
    plates.
    """
    plate = config.length_m / config.plates
    joints = np.arange(config.plates) * plate
    middles = joints[:-1] + plate / 2
    start, stop = np.append(0.0, middles), np.append(middles, config.length_m)

    def work(
        start: NDArray[np.floating[Any]], stop: NDArray[np.floating[Any]], bracket: float
    ) -> NDArray[np.floating[Any]]:
        nodes, weights = np.polynomial.legendre.leggauss(8)
        along = start + (nodes[:, None] + 1) / 2 * (stop - start)
        bending = config.span(along) * (config.youngs_modulus_pa * config.thickness(along) ** 3 / 12 + bracket)
        shares = weights[:, None] / 2 * (config.length_m - along) ** 2 / bending
        return np.asarray((stop - start) * shares.sum(axis=0))

    edge = np.clip(config.root_length_m, start, stop)
    whole = work(start, edge, BRACKET_BENDING_N_M) + work(edge, stop, 0.0)
    return np.asarray(whole / (config.length_m - joints) ** 2)
