"""The virtual tank: drive, soft fin, still water and force sensor composed behind the Plant contract.

A `Tank` is a pytree of arrays, so tanks that differ in their parameters can be stacked and run side by side by `vmap`.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray
from pydantic import Field

from softfin.configuration import Configuration
from softfin.quantities import PAPER_LIMITS, TICK_S, Command, Limits, Reading
from softfin.tank.chain import Moments
from softfin.tank.drive import Drive, DriveConfig, DriveState
from softfin.tank.fin import Fin, FinConfig, FinState
from softfin.tank.hydrodynamics import Water, WaterConfig
from softfin.tank.sensor import Sensor, SensorConfig, SensorState


class TankConfig(Configuration):
    """Everything that makes a tank."""

    drive: DriveConfig = DriveConfig()
    """Of the shaft."""
    fin: FinConfig = FinConfig()
    """Its geometry and material."""
    water: WaterConfig = WaterConfig()
    """Its temperature and its loads on the fin."""
    sensor: SensorConfig = SensorConfig()
    """Under the fin."""
    steps_per_tick: int = Field(2, ge=1, le=1000)
    """Steps of time in each sample of 10 ms [-]; the error of the force falls as their square: 0.12% at 2 (rms)."""


class TankState(NamedTuple):
    """Of everything that moves, the samples read so far, and the key that the sensor's noise is drawn from."""

    ticks: Int[Array, ""]
    drive: DriveState
    fin: FinState
    sensor: SensorState
    key: PRNGKeyArray


class Tank(eqx.Module):
    """A soft fin in still water (a Plant)."""

    drive: Drive
    fin: Fin
    water: Water
    sensor: Sensor
    steps_per_tick: int = eqx.field(static=True)

    def __init__(self, config: TankConfig | None = None):
        config = config or TankConfig()
        self.drive = Drive(config.drive)
        self.fin = Fin(config.fin)
        self.water = Water(config.water, config.fin)
        self.sensor = Sensor(config.sensor)
        self.steps_per_tick = config.steps_per_tick

    @property
    def limits(self) -> Limits:
        """The commands of the paper, Sec. III-A."""
        return PAPER_LIMITS

    def init(self, key: PRNGKeyArray) -> TankState:
        """The fin at rest at angle 0; the key draws the sensor's drift and its noise."""
        drift, noise = jax.random.split(key)
        return TankState(jnp.int32(0), self.drive.rest(), self.fin.rest(), self.sensor.rest(drift), noise)

    def advance(self, state: TankState, command: Command, ticks: int) -> tuple[TankState, Reading]:
        """Hold the command for `ticks` samples of 10 ms and read after each: fields ``(ticks,)``."""
        dtype = state.fin.angles.dtype
        command = Command(jnp.asarray(command.angle, dtype), jnp.asarray(command.velocity, dtype))
        inertia = self.inertia()
        return jax.lax.scan(lambda state, _: self._tick(state, command, inertia), state, length=ticks)

    def inertia(self) -> Moments:
        """Of the fin and the water that it moves [kg, kg m, kg m2]."""
        both: Moments = jax.tree.map(jnp.add, self.fin.inertia, self.water.inertia())
        return both

    def _tick(self, state: TankState, command: Command, inertia: Moments) -> tuple[TankState, Reading]:
        seconds = TICK_S / self.steps_per_tick

        def step(moving: tuple[DriveState, FinState], _: None) -> tuple[tuple[DriveState, FinState], Float[Array, "2"]]:
            drive, shaft = self.drive.step(moving[0], command, seconds)
            fin, force = self.fin.step(moving[1], shaft, inertia, self.water.loads, seconds)
            return (drive, fin), force

        (drive, fin), forces = jax.lax.scan(step, (state.drive, state.fin), length=self.steps_per_tick)
        # The fin presses on its mount with what the water exerts on it less what goes into its own momentum; the
        # water's inertia is counted with the fin's.
        gained = self.fin.momentum(fin, inertia) - self.fin.momentum(state.fin, inertia)
        force = forces.mean(0) - gained / TICK_S
        sensor, measured = self.sensor.read(state.sensor, force, jax.random.fold_in(state.key, state.ticks))
        angle, velocity = self.drive.read(drive)
        ticks = state.ticks + 1
        reading = Reading(ticks * jnp.asarray(TICK_S, angle.dtype), angle, velocity, measured)
        return TankState(ticks, drive, fin, sensor, state.key), reading
