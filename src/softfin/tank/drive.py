"""The drive: a positioning controller in profile position mode, a motor and a gearbox. It converts
commands to shaft motion.

The controller follows a trapezoidal velocity profile to the target angle at the commanded velocity,
within an acceleration limit. The profile is replanned in each step from its current state, so a
command may arrive at any time, even mid-stroke. A servo with limited torque makes the motor follow
the profile against the load of the fin. The gearbox between motor and fin may have backlash. The
encoder is on the motor. All angles, torques and inertias refer to the fin side of the gearbox.

Equations: docs/appendix/tank.md, "Drive".
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.quantities import PAPER_LIMITS, TICK_S, Command
from softfin.tank.chain import Scalar
from softfin.tank.fin import Shaft
from softfin.tank.sensor import config_arrays, to_multiple

DEAD_TICKS = 20
"""Maximum dead time [10 ms]."""


class DriveConfig(Configuration):
    """Motor, gearbox and positioning controller.

    The default velocity, acceleration, dead time and lag come from a calibration against the
    published fin (docs/appendix/tank.md). The motor and gearbox defaults are catalogue values for
    an assumed reduction of 111:1.
    """

    angle_min_rad: float = PAPER_LIMITS.angle_min
    """Minimum angle that the drive accepts [rad] (paper, Sec. III-A)."""
    angle_max_rad: float = PAPER_LIMITS.angle_max
    """Maximum angle that the drive accepts [rad] (paper, Sec. III-A)."""
    slowest_rad_s: float = Field(1.0, gt=0)
    """Minimum profile velocity that the drive accepts [rad/s] (paper, Sec. III-A)."""
    fastest_rad_s: float = Field(7.1, gt=0)
    """Maximum profile velocity that the drive accepts [rad/s]."""
    acceleration_rad_s2: float = Field(81.0, gt=0)
    """Acceleration and deceleration of the profile [rad/s2]."""
    dead_time_s: float = Field(0.029, ge=0, le=DEAD_TICKS * TICK_S)
    """Delay from a command to its first effect on the profile [s], caused by the computer and the
    bus."""
    lag_s: float = Field(0.001, ge=0)
    """Following error divided by velocity [s], caused by velocity damping in the servo."""
    stiffness_nm_rad: float = Field(300.0, gt=0)
    """Servo torque divided by following error [N m/rad]."""
    inertia_kg_m2: float = Field(0.028, gt=0)
    """Inertia of the rotor and gearbox times the square of the gear ratio [kg m2]; 22.6e-7 kg m2 at
    111:1."""
    torque_limit_nm: float = Field(6.0, gt=0)
    """Maximum torque of the motor and gearbox [N m]; the limit of a 32 mm planetary gearbox."""
    backlash_rad: float = Field(0.0, ge=0, le=0.2)
    """Backlash of the gearbox from end to end [rad]; 0.003 to 0.017 in catalogues."""
    encoder_step_rad: float = Field(2.83e-5, ge=0)
    """Encoder resolution [rad], for 2000 counts per turn at 111:1; 0 for no quantization."""


LIMIT_FIELDS = ("angle_min_rad", "angle_max_rad", "slowest_rad_s", "fastest_rad_s")
"""Limits of the commands; the other fields of `DriveConfig` are physical parameters."""


class DriveState(NamedTuple):
    """State of the profile and the motor, and the commands in the queue."""

    profile_angle: Scalar
    """Angle of the profile [rad]."""
    profile_velocity: Scalar
    """Angular velocity of the profile [rad/s]."""
    angle: Scalar
    """Angle of the motor [rad]."""
    rate: Scalar
    """Angular velocity of the motor [rad/s]."""
    torque: Scalar
    """Mean torque of the motor in the last step [N m]."""
    waiting: Command
    """Commands of the last `DEAD_TICKS` ticks, newest first."""


class Drive(eqx.Module):
    """Parameters of the drive as arrays."""

    acceleration: Scalar
    dead_time: Scalar
    lag: Scalar
    stiffness: Scalar
    inertia: Scalar
    torque_limit: Scalar
    backlash: Scalar
    encoder_step: Scalar

    def __init__(self, config: DriveConfig):
        (
            self.acceleration,
            self.dead_time,
            self.lag,
            self.stiffness,
            self.inertia,
            self.torque_limit,
            self.backlash,
            self.encoder_step,
        ) = config_arrays(config, without=LIMIT_FIELDS)

    def rest(self, angle_rad: float = 0.0) -> DriveState:
        """Return the state at rest at an angle, with a queue of commands for the same angle."""
        zero = jnp.zeros_like(self.lag)
        angle = jnp.full_like(zero, angle_rad)
        waiting = Command(
            jnp.full(DEAD_TICKS, angle_rad, zero.dtype), jnp.zeros(DEAD_TICKS, zero.dtype)
        )
        return DriveState(angle, zero, angle, zero, zero, waiting)

    def receive(self, state: DriveState, command: Command) -> tuple[DriveState, Command]:
        """Add a command to the queue; return the new state and the command that the profile follows
        in the next tick."""
        queue = jax.tree.map(jnp.append, command, state.waiting)
        waiting = jax.tree.map(lambda channel: channel[:-1], queue)
        return state._replace(waiting=waiting), delayed(queue, self.dead_time / TICK_S)

    def plan(self, state: DriveState, command: Command, seconds: float) -> DriveState:
        """Advance the profile by one time step."""
        velocity = next_velocity(
            state.profile_angle, state.profile_velocity, command, self.acceleration, seconds
        )
        mean = (velocity + state.profile_velocity) / 2
        return state._replace(
            profile_angle=state.profile_angle + seconds * mean, profile_velocity=velocity
        )

    def shaft(
        self,
        before: DriveState,
        planned: DriveState,
        seconds: float,
        carried: Scalar | float = 0.0,
    ) -> Shaft:
        """Return the shaft that drives the fin while the profile advances from `before` to
        `planned`."""
        half = seconds / 2
        pull, grip, rotor = self._servo(before, planned, half)

        # The implicit midpoint rule for the rotor, with the mean rate w over the step:
        #   J (w - rate) / (h / 2) = torque + load - drag w,   torque = pull - grip w.
        # At the torque limit, the torque is constant instead.
        def turn(load: Scalar, drag: Scalar) -> Scalar:
            free = (rotor * before.rate + pull + load) / (rotor + grip + drag)
            torque = pull - grip * free
            limited = jnp.clip(torque, -self.torque_limit, self.torque_limit)
            return jnp.where(
                limited == torque, free, (rotor * before.rate + limited + load) / (rotor + drag)
            )

        return Shaft(before.angle, self.backlash, turn, carried)

    def follow(
        self, before: DriveState, planned: DriveState, mean: Scalar, seconds: float
    ) -> DriveState:
        """Return the state after a step in which the motor rotated at the rate `mean` [rad/s]."""
        pull, grip, _ = self._servo(before, planned, seconds / 2)
        torque = jnp.clip(pull - grip * mean, -self.torque_limit, self.torque_limit)
        return planned._replace(
            angle=before.angle + seconds * mean, rate=2 * mean - before.rate, torque=torque
        )

    def read(self, state: DriveState) -> tuple[Scalar, Scalar]:
        """Return the angle [rad] and velocity [rad/s] that the encoder reads."""
        return to_multiple(state.angle, self.encoder_step), state.rate

    def _servo(
        self, before: DriveState, planned: DriveState, half: float
    ) -> tuple[Scalar, Scalar, Scalar]:
        """Return `pull`, `grip` and the inertia divided by half a step; the mean torque in the step
        is pull - grip * (mean rate) [N m]."""
        # tau = K (theta_p - theta - T_l theta') + D (theta_p' - theta') at the middle of the step,
        # where theta = before.angle + half * (mean rate). D = 2 sqrt(K J) is critical damping.
        damping = 2 * jnp.sqrt(self.stiffness * self.inertia)
        profile_angle = (before.profile_angle + planned.profile_angle) / 2
        profile_rate = (before.profile_velocity + planned.profile_velocity) / 2
        pull = self.stiffness * (profile_angle - before.angle) + damping * profile_rate
        return pull, self.stiffness * (self.lag + half) + damping, self.inertia / half


def next_velocity(
    angle: Scalar,
    velocity: Scalar,
    command: Command,
    acceleration: Scalar,
    seconds: float,
) -> Scalar:
    """Return the velocity of the profile after one time step: the highest one from which it can
    stop at the target without overshoot."""
    # In time steps h with deceleration a, the stopping distance of a velocity v is
    # v^2 / (2 a) + v h / 2, so the highest velocity is sqrt((a h / 2)^2 + 2 a |ahead|) - a h / 2.
    # |ahead| / h reaches the target in one step.
    ahead = command.angle - angle - seconds * velocity / 2
    gain = acceleration * seconds
    braking = jnp.sqrt((gain / 2) ** 2 + 2 * acceleration * jnp.abs(ahead)) - gain / 2
    speed = jnp.minimum(jnp.minimum(braking, jnp.abs(ahead) / seconds), command.velocity)
    change = jnp.sign(ahead) * speed - velocity
    return velocity + jnp.clip(change, -gain, gain)


def delayed(commands: Command, delay: Scalar) -> Command:
    """Return the command from `delay` ticks ago; `commands` are ordered from newest to oldest.

    A fractional delay interpolates between two commands, so that the result is differentiable with
    respect to the delay.
    """
    weights = delay_weights(commands.angle.shape[0], delay)
    return Command((weights * commands.angle).sum(), (weights * commands.velocity).sum())


def delay_weights(count: int, delay: Scalar) -> Float[Array, "count"]:
    """Return the weights of commands, ordered from newest to oldest, in the command from `delay`
    ticks ago."""
    age = jnp.arange(count, dtype=delay.dtype)
    return jnp.maximum(1 - jnp.abs(age - delay), 0.0)
