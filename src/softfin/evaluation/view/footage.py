"""Record of what can be seen of a plant: rolled tick by tick, with the fin's shape wherever the plant computes it.

Commands go in, a Footage comes out, from which film and page are drawn. A plant may have a method ``shape(state)``, as
the virtual tank does: points ``(points, 2)`` from the shaft to the tip [m], in the axes of the tank.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.action_clock import WINDOW
from softfin.core.errors import PlantError
from softfin.core.plant import Plant, State
from softfin.core.quantities import Command, Reading
from softfin.core.window import moving_average
from softfin.tank import Tank, TankConfig, TankState


class Footage(NamedTuple):
    """A fin in motion, in ticks of 10 ms."""

    command: Command
    """Fields ``(ticks,)``: the command under which the reading of that tick came about."""
    reading: Reading
    """Fields ``(ticks,)``, force ``(ticks, 2)``."""
    average: Float[np.ndarray, "windows 2"]
    """Mean of the force over the last 200 samples, from the first instant at which all are there [N]."""
    shape: Float[np.ndarray, "ticks points 2"]
    """Middle line of the fin from the shaft to the tip [m]."""
    shape_known: bool
    """Whether the plant computes the shape; if not, it is a line at the shaft's angle, as long as the default fin."""
    thickness: Float[np.ndarray, " points"]
    """Thickness at the same points [m]; that of the default fin, in proportion, where the plant is not a tank."""
    stream: Float[np.ndarray, "ticks 2"] | None
    """Velocity of the water that the fin has set moving [m/s]; None where it is still or not known."""
    reference: Float[np.ndarray, "ticks 2"] | None
    """The force that a controller was asked for [N]."""

    @property
    def length_m(self) -> float:
        """Length of the fin from the shaft to the tip [m]."""
        return float(np.linalg.norm(np.diff(self.shape[0], axis=0), axis=1).sum())


class Shots(NamedTuple):
    """Readings of a plant and what else can be seen of it, in ticks of 10 ms."""

    reading: Reading
    shape: Any
    """Shapes ``(ticks, points, 2)`` [m], or None where the plant does not compute them."""
    stream: Any
    """Velocities of the water ``(ticks, 2)`` [m/s], or None where the plant has none."""


def film(
    plant: Plant, key: PRNGKeyArray, commands: Command, reference: Float[np.ndarray, "ticks 2"] | None = None
) -> Footage:
    """Roll the plant from rest, one command a tick, ``(ticks,)``, that follow a reference where there is one."""
    issued = Command(*(jnp.asarray(field, jnp.float32) for field in commands))
    shots = jax.jit(lambda: shoot(plant, plant.init(key), issued))()
    command, seen = jax.tree.map(np.asarray, (issued, shots))
    return develop(plant, command, seen, reference)


def shoot(plant: Plant, state: State, commands: Command) -> Shots:
    """Roll the plant from a state, one command a tick, ``(ticks,)``, and keep what can be seen; traceable."""
    shape_of: Callable[[State], Array] | None = getattr(plant, "shape", None)

    def tick(state: State, command: Command) -> tuple[State, Shots]:
        state, reading = plant.advance(state, command, 1)
        stream = state.flow.stream if isinstance(state, TankState) else None
        return state, Shots(
            jax.tree.map(lambda x: x[0], reading), None if shape_of is None else shape_of(state), stream
        )

    return jax.lax.scan(tick, state, commands)[1]


def develop(plant: Plant, command: Command, shots: Shots, reference: Float[np.ndarray, "ticks 2"] | None) -> Footage:
    """The footage of what was shot under the commands, all as NumPy arrays; raises PlantError for wrong shapes."""
    reading, shape, stream = shots
    name = type(plant).__name__
    for field, values in reading._asdict().items():
        if not np.isfinite(values).all():
            raise PlantError(f"{name}: reading.{field} is not finite; softfin.testing.check_plant says where")
    if shape is not None and (shape.ndim != 3 or shape.shape[1] < 2 or shape.shape[2] != 2):
        raise PlantError(f"{name}: shape(state) has shape {shape.shape[1:]}; it must be (points, 2), 2 points or more")
    force = np.asarray(reading.force, np.float64)
    footage = Footage(
        command=command,
        reading=reading,
        average=moving_average(force) if len(force) >= WINDOW else np.zeros((0, 2)),
        shape=straight(np.asarray(reading.angle), TankConfig().fin.length_m) if shape is None else shape,
        shape_known=shape is not None,
        thickness=np.zeros(0),
        stream=stream if stream is not None and stream.any() else None,
        reference=reference,
    )
    if isinstance(plant, Tank):
        return footage._replace(thickness=np.asarray(plant.fin.thickness))
    fin = TankConfig().fin
    default = fin.thickness(np.linspace(0, fin.length_m, footage.shape.shape[1]))
    return footage._replace(thickness=default * footage.length_m / fin.length_m)


def straight(angle: Float[np.ndarray, " ticks"], length_m: float) -> Float[np.ndarray, "ticks 2 2"]:
    """A blade along (-cos, +sin) of the angle."""
    tip = length_m * np.stack([-np.cos(angle), np.sin(angle)], axis=-1)
    return np.stack([np.zeros_like(tip), tip], axis=1)
