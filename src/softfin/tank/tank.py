"""The virtual tank: drive, soft fin, water and force sensor combined into a `Plant`.

A `Tank` is a pytree of arrays, so tanks with different parameters can be stacked and simulated
together with `vmap`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.log_channels import CURRENT_CHANNEL, LOAD_CHANNELS
from softfin.core.plant import check_commands, check_key
from softfin.core.power import EC_MAX_30, motor_current
from softfin.core.quantities import TICK_S, Command, Limits, Reading
from softfin.core.window import PAPER_WINDOW
from softfin.tank.chain import PlanarVector, Scalar
from softfin.tank.drive import LIMIT_FIELDS, Drive, DriveConfig, DriveState
from softfin.tank.fin import Fin, FinConfig, FinState, Mount
from softfin.tank.hydrodynamics import Flow, Water, WaterConfig
from softfin.tank.sensor import Sensor, SensorConfig, SensorState

EXPERIMENT_S = 30.0
"""Duration of the paper's experiments [s]; the sensor is zeroed before each one."""


class TankConfig(Configuration):
    """All parameters of a tank."""

    drive: DriveConfig = DriveConfig()
    """Drive of the shaft."""
    fin: FinConfig = FinConfig()
    """Geometry and material of the fin."""
    water: WaterConfig = WaterConfig()
    """Water temperature and hydrodynamic loads on the fin."""
    sensor: SensorConfig = SensorConfig()
    """Force sensor under the fin."""
    steps_per_tick: int = Field(2, ge=1, le=1000)
    """Number of time steps per tick of 10 ms [-]. The RMS force error is inversely proportional to
    the square of this number; with 2 steps, it is 0.4%."""


class TankState(NamedTuple):
    """State of a tank."""

    ticks: Int[Array, ""]
    """Time since `init` [10 ms]."""
    drive: DriveState
    fin: FinState
    flow: Flow
    sensor: SensorState
    force: PlanarVector
    """True mean force (x, y) on the mount over the last tick [N]."""
    torque: Float[Array, "2"]
    """Mean torques over the last tick [N m]: on the fin about the shaft, and of the motor, which
    also accelerates the rotor. A torque has the sign of the velocity if the drive delivers
    power."""
    key: PRNGKeyArray
    """Key for the sensor noise."""


class Load(NamedTuple):
    """Mean load of a fin on its mount over a tick, without sensor errors."""

    force: PlanarVector
    """Force (x, y) [N]."""
    torque: Scalar
    """Torque about the shaft, with the sign of the shaft angle [N m]."""


class Tank(eqx.Module):
    """A soft fin in still water; implements `Plant`."""

    drive: Drive
    fin: Fin
    water: Water
    sensor: Sensor
    steps_per_tick: int = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    """Command limits from the drive configuration."""

    def __init__(self, config: TankConfig | None = None):
        config = config or TankConfig()
        self.drive = Drive(config.drive)
        self.fin = Fin(config.fin)
        self.water = Water(config.water, config.fin)
        self.sensor = Sensor(config.sensor)
        self.steps_per_tick = config.steps_per_tick
        self.limits = Limits(*(getattr(config.drive, name) for name in LIMIT_FIELDS))

    @property
    def mean_force_noise_n(self) -> float:
        """Standard deviation of the measured mean force over the evaluation window at the end of an
        experiment [N]."""
        return self.sensor.mean_noise(PAPER_WINDOW, EXPERIMENT_S)

    def init(self, key: PRNGKeyArray) -> TankState:
        """Return the state of a fin at rest with a zeroed sensor; the key determines sensor drift
        and noise."""
        check_key(key)
        drift, noise = jax.random.split(key)
        sensor = self.sensor.rest(drift)
        return TankState(
            jnp.int32(0),
            self.drive.rest(self.limits.rest_angle),
            self.fin.rest(self.limits.rest_angle),
            self.water.rest(),
            sensor,
            jnp.zeros_like(sensor.drift),
            jnp.zeros_like(sensor.drift),
            noise,
        )

    def advance(self, state: TankState, command: Command, ticks: int) -> tuple[TankState, Reading]:
        """Hold the command for `ticks` samples of 10 ms and return a reading after each, with
        fields ``(ticks,)``."""
        check_commands(self.limits, command)
        dtype = state.fin.angles.dtype
        command = Command(jnp.asarray(command.angle, dtype), jnp.asarray(command.velocity, dtype))

        def tick(state: TankState, _: None) -> tuple[TankState, Reading]:
            state, reading, _load = self.tick(state, command)
            return state, reading

        return jax.lax.scan(tick, state, length=ticks)

    def measure(
        self, state: TankState, command: Command
    ) -> tuple[TankState, Reading, dict[str, Scalar]]:
        """Hold a command for one tick, like `advance`; also return torque and current as log
        channels, without sensor errors."""
        check_commands(self.limits, command)
        after, reading, _load = self.tick(state, command)
        velocity = (state.drive.rate + after.drive.rate) / 2
        current = motor_current(after.torque, velocity, EC_MAX_30)
        return after, reading, {LOAD_CHANNELS[-1]: after.torque[0], CURRENT_CHANNEL: current}

    def true_force(self, state: TankState) -> PlanarVector:
        """Return the mean force on the mount over the last tick, without sensor errors [N]."""
        return state.force

    def torque(self, state: TankState) -> Float[Array, "2"]:
        """Return the mean torques over the last tick [N m]: on the fin about the shaft, and of the
        motor."""
        return state.torque

    def shape(self, state: TankState) -> Float[Array, "points 2"]:
        """Return the positions of the shaft and the outer end of each plate in tank axes [m]."""
        return self.fin.shape(state.fin)

    def tick(
        self, state: TankState, command: Command, mount: Mount | None = None
    ) -> tuple[TankState, Reading, Load]:
        """Hold a command for one tick of 10 ms, on a fixed mount or a moving `mount`.

        The motion of the mount is constant within the tick, and all forces are in mount axes. The
        wake moves with the mount.
        """
        seconds = TICK_S / self.steps_per_tick
        around = self.water.around(state.flow)
        carried = 0.0 if mount is None else mount.turn
        # The stream and the drag coefficients stay constant during the tick.
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
        # The momentum balance of the fin and its added mass over the tick determines the force on
        # the mount: the hydrodynamic loads minus the rate of change of the momenta.
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
        # The part of the motor torque that accelerates the rotor does not reach the fin. The mount
        # carries the reaction of the torque on the fin.
        motor_torque = torques.mean()
        torque = motor_torque - self.drive.inertia * (drive.rate - state.drive.rate) / TICK_S
        both = jnp.stack([torque, motor_torque])
        return (
            TankState(ticks, drive, fin, flow, sensor, force, both, state.key),
            reading,
            Load(force, -torque),
        )
