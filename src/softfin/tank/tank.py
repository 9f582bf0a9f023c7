"""The virtual tank: drive, soft fin, water and force sensor composed behind the Plant contract.

A `Tank` is a pytree of arrays, so tanks that differ in their parameters can be stacked and run side
by side by `vmap`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.plant import check_commands
from softfin.core.quantities import PAPER_LIMITS, TICK_S, Command, Limits, Reading
from softfin.tank.chain import PlanarVector, Scalar
from softfin.tank.drive import Drive, DriveConfig, DriveState
from softfin.tank.fin import Fin, FinConfig, FinState, Mount
from softfin.tank.hydrodynamics import Flow, Water, WaterConfig
from softfin.tank.sensor import Sensor, SensorConfig, SensorState


class TankConfig(Configuration):
    """All parameters of a tank."""

    drive: DriveConfig = DriveConfig()
    """Drive of the shaft."""
    fin: FinConfig = FinConfig()
    """Geometry and material of the fin."""
    water: WaterConfig = WaterConfig()
    """Temperature of the water and its loads on the fin."""
    sensor: SensorConfig = SensorConfig()
    """Force sensor under the fin."""
    steps_per_tick: int = Field(2, ge=1, le=1000)
    """Time steps in each sample of 10 ms [-]; the error of the force falls with their square: 0.4%
    (rms) at 2."""


class TankState(NamedTuple):
    """State of all moving parts, the number of samples so far, and the key of the sensor's
    noise."""

    ticks: Int[Array, ""]
    drive: DriveState
    fin: FinState
    flow: Flow
    sensor: SensorState
    force: PlanarVector
    """True mean force on the mount over the last tick (x, y) [N]."""
    key: PRNGKeyArray


class Load(NamedTuple):
    """Mean load of a fin on its mount over a tick, without sensor errors."""

    force: PlanarVector
    """Force (x, y) [N]."""
    torque: Scalar
    """Torque about the shaft, in the sense of the shaft's angle [N m]."""


class Tank(eqx.Module):
    """A soft fin in still water; meets the Plant contract."""

    drive: Drive
    fin: Fin
    water: Water
    sensor: Sensor
    steps_per_tick: int = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    """The commands that the drive accepts: angles of the paper (Sec. III-A), velocities of its
    configuration."""

    def __init__(self, config: TankConfig | None = None):
        config = config or TankConfig()
        self.drive = Drive(config.drive)
        self.fin = Fin(config.fin)
        self.water = Water(config.water, config.fin)
        self.sensor = Sensor(config.sensor)
        self.steps_per_tick = config.steps_per_tick
        self.limits = PAPER_LIMITS._replace(
            velocity_min=config.drive.slowest_rad_s, velocity_max=config.drive.fastest_rad_s
        )

    def init(self, key: PRNGKeyArray) -> TankState:
        """Return the fin at rest at angle 0, with the sensor just zeroed; the key determines the
        sensor's drift and noise."""
        drift, noise = jax.random.split(key)
        sensor = self.sensor.rest(drift)
        return TankState(
            jnp.int32(0),
            self.drive.rest(),
            self.fin.rest(),
            self.water.rest(),
            sensor,
            jnp.zeros_like(sensor.drift),
            noise,
        )

    def advance(self, state: TankState, command: Command, ticks: int) -> tuple[TankState, Reading]:
        """Hold the command for `ticks` samples of 10 ms and read after each; fields have the shape
        ``(ticks,)``."""
        check_commands(self.limits, command)
        dtype = state.fin.angles.dtype
        command = Command(jnp.asarray(command.angle, dtype), jnp.asarray(command.velocity, dtype))

        def tick(state: TankState, _: None) -> tuple[TankState, Reading]:
            state, reading, _load = self.tick(state, command)
            return state, reading

        return jax.lax.scan(tick, state, length=ticks)

    def true_force(self, state: TankState) -> PlanarVector:
        """Return the mean force on the mount over the last tick, without the errors of the sensor
        [N]."""
        return state.force

    def shape(self, state: TankState) -> Float[Array, "points 2"]:
        """Return where the fin is: the shaft and the outer end of each plate, in the axes of the
        tank [m]."""
        return self.fin.shape(state.fin)

    def tick(
        self, state: TankState, command: Command, mount: Mount | None = None
    ) -> tuple[TankState, Reading, Load]:
        """Hold a command for one sample of 10 ms, on a mount that moves or stands still.

        The mount's motion is constant within the tick; all forces are in its axes. The wake stays
        with the fin.
        """
        seconds = TICK_S / self.steps_per_tick
        around = self.water.around(state.flow)
        carried = 0.0 if mount is None else mount.turn
        if mount is not None:
            around = around._replace(
                stream=around.stream - mount.velocity, acceleration=mount.acceleration
            )
        drive, obeyed = self.drive.receive(state.drive, command)

        def step(
            moving: tuple[DriveState, FinState], _: None
        ) -> tuple[tuple[DriveState, FinState], tuple[PlanarVector, Scalar]]:
            drive, fin = moving
            planned = self.drive.plan(drive, obeyed, seconds)
            fin, rate, force = self.fin.step(
                fin, self.drive.shaft(drive, planned, seconds, carried), around, seconds
            )
            drive = self.drive.follow(drive, planned, rate, seconds)
            return (drive, fin), (force, drive.torque)

        (drive, fin), (forces, torques) = jax.lax.scan(
            step, (drive, state.fin), length=self.steps_per_tick
        )
        # The force of the fin on its mount is that of the water on the fin, minus the change of the
        # fin's own momentum.
        own, added = jax.tree.map(
            lambda before, after: (after - before) / TICK_S,
            self.fin.momenta(state.fin, around),
            self.fin.momenta(fin, around),
        )
        loads = forces.mean(0)
        force = loads - added - own
        if mount is not None:
            force -= self.fin.inertial_force(fin, around, mount)
        noise = jax.random.fold_in(state.key, state.ticks)
        sensor, measured = self.sensor.read(state.sensor, force, noise)
        flow = self.water.stirred(state.flow, self.fin.relative(fin, around), loads)
        angle, velocity = self.drive.read(drive)
        ticks = state.ticks + 1
        reading = Reading(ticks * jnp.asarray(TICK_S, angle.dtype), angle, velocity, measured)
        # The torque of the motor that does not accelerate its own inertia reacts on the gearbox's
        # housing.
        torque = self.drive.inertia * (drive.rate - state.drive.rate) / TICK_S - torques.mean()
        return (
            TankState(ticks, drive, fin, flow, sensor, force, state.key),
            reading,
            Load(force, torque),
        )
