"""Records what can be seen of a plant: simulated tick by tick, with the fin's shape if the plant
computes it.

Commands go in; a Footage comes out, with the Scale at which film and page draw it. A plant may have
a method ``shape(state)``, as the virtual tank does: points ``(points, 2)`` from the shaft to the
tip [m], in the tank's axes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.action_clock import WINDOW
from softfin.core.errors import PlantError
from softfin.core.plant import Plant, State, TrueForcePlant
from softfin.core.quantities import Command, Reading
from softfin.core.window import moving_average
from softfin.tank import Tank, TankConfig

LONGEST = 0.65
MEAN_LONGEST = 0.4
"""Length of the arrows of the largest force, and of the largest reference or mean force, relative
to the fin; on the same scale the second would be too short to see next to the peaks of a stroke."""

AxisRange = tuple[float, float]
FootageSeries = Float[np.ndarray, "ticks 2"]
NONE = np.zeros((1, 2))


class Footage(NamedTuple):
    """A fin in motion, in ticks of 10 ms."""

    command: Command
    """Fields ``(ticks,)``: the command in force before the reading of that tick."""
    reading: Reading
    """Fields ``(ticks,)``, force ``(ticks, 2)``."""
    true_force: FootageSeries | None
    """Force on the mount without sensor errors [N]; None if the plant has only readings."""
    average: Float[np.ndarray, "windows 2"]
    """Mean of the drawn force over the last 200 samples, from the first instant at which all exist
    [N]."""
    shape: Float[np.ndarray, "ticks points 2"]
    """Centre line of the fin from the shaft to the tip [m]."""
    length_m: float
    """Length of the fin from the shaft to the tip [m]."""
    shape_known: bool
    """Whether the plant computes the shape; if not, the shape is a straight line at the shaft's
    angle, as long as the default fin."""
    thickness: Float[np.ndarray, " points"]
    """Thickness at the same points [m]; that of the default fin, scaled, if the plant is not a
    tank."""
    reference: FootageSeries | None
    """The reference of the controller [N]."""

    @property
    def force(self) -> FootageSeries:
        """Force that is drawn [N]: the true one if it is known, otherwise the reading."""
        return np.asarray(self.reading.force if self.true_force is None else self.true_force)


Shots = tuple[Reading, Any, Any]
"""Readings, shapes ``(ticks, points, 2)`` [m] and true forces ``(ticks, 2)`` [N]; None for what the
plant lacks."""


def film(
    plant: Plant, key: PRNGKeyArray, commands: Command, reference: FootageSeries | None = None
) -> Footage:
    """Simulate the plant from rest, with one command per tick, ``(ticks,)``, which may follow a
    reference."""
    issued = Command(*(jnp.asarray(field, jnp.float32) for field in commands))
    shots = jax.jit(lambda: shoot(plant, plant.init(key), issued))()
    command, seen = jax.tree.map(np.asarray, (issued, shots))
    return develop(plant, command, seen, reference)


def shoot(plant: Plant, state: State, commands: Command) -> Shots:
    """Simulate the plant from a state, with one command per tick, ``(ticks,)``, and keep what can
    be seen; traceable."""
    shape_of: Callable[[State], Array | None] = getattr(plant, "shape", lambda state: None)

    def tick(state: State, command: Command) -> tuple[State, Shots]:
        state, reading = plant.advance(state, command, 1)
        true_force = plant.true_force(state) if isinstance(plant, TrueForcePlant) else None
        return state, (jax.tree.map(lambda x: x[0], reading), shape_of(state), true_force)

    shots: Shots = jax.lax.scan(tick, state, commands)[1]
    return shots


def develop(
    plant: Plant, command: Command, shots: Shots, reference: FootageSeries | None
) -> Footage:
    """Return the footage of a simulation under the commands, as NumPy arrays; raises PlantError for
    wrong shapes."""
    reading, shape, true_force = shots
    name = type(plant).__name__
    fin = TankConfig().fin
    for field, values in [*reading._asdict().items(), ("true_force", true_force)]:
        if values is not None and not np.isfinite(values).all():
            read = field if values is true_force else f"reading.{field}"
            raise PlantError(
                f"{name}: {read} is not finite; softfin.testing.check_plant says where"
            )
    has_shape = shape is not None
    if has_shape and (shape.ndim != 3 or shape.shape[1] < 2 or shape.shape[2] != 2):
        raise PlantError(
            f"{name}: shape(state) has shape {shape.shape[1:]}; it must be (points, 2), 2 points "
            "or more"
        )
    force = np.asarray(reading.force if true_force is None else true_force, np.float64)
    angle = np.asarray(reading.angle)
    if not has_shape:
        tip = fin.length_m * np.stack([-np.cos(angle), np.sin(angle)], axis=-1)
        shape = np.stack([np.zeros_like(tip), tip], axis=1)
    length = float(np.linalg.norm(np.diff(shape[0], axis=0), axis=1).sum())
    # That of the default fin, in proportion to the length.
    thickness = fin.thickness(np.linspace(0, fin.length_m, shape.shape[1])) * length / fin.length_m
    return Footage(
        command=command,
        reading=reading,
        true_force=true_force,
        average=moving_average(force) if len(force) >= WINDOW else np.zeros((0, 2)),
        shape=shape,
        length_m=length,
        shape_known=has_shape,
        thickness=np.asarray(plant.fin.thickness) if isinstance(plant, Tank) else thickness,
        reference=reference,
    )


class Scale(NamedTuple):
    """Scale of one drawing, the same for all its frames: the visible part of the tank, and the
    length of a newton."""

    length_m: float
    """Length of the fin [m]."""
    metres_per_newton: float
    """Scale of the force's arrow."""
    key_n: float
    """A round force for the key [N]."""
    metres_per_mean_newton: float
    """Scale of the reference and the mean force."""
    mean_key_n: float
    """A round force for their key [N]."""
    x: AxisRange
    """Visible part of the tank [m]."""
    y: AxisRange
    force: AxisRange
    """Axis of the force traces [N]."""
    angle: AxisRange
    """Axis of the angle's trace [rad]."""


def max_sizes(footage: Footage) -> Float[np.ndarray, "2"]:
    """Return the sizes of the largest force, and of the largest reference or mean force [N]; 0 if
    it has none."""
    means = np.concatenate(
        [footage.average, NONE if footage.reference is None else footage.reference]
    )
    return np.array([np.linalg.norm(each, axis=1).max() for each in (footage.force, means)], float)


def choose_scale(
    footage: Footage, greatest: Float[np.ndarray, "2"] | None = None, angle: AxisRange | None = None
) -> Scale:
    """Return the scale by which fin and arrows stay in the picture at every tick.

    For footage that is still growing, it holds up to the `greatest` sizes while the fin stays
    within the `angle` [rad].
    """
    length = footage.length_m
    force = np.asarray(footage.force, float)
    asked = NONE if footage.reference is None else np.unique(footage.reference, axis=0)
    shown = np.concatenate([force, asked])
    angles = np.concatenate([footage.reading.angle, footage.command.angle])
    force_n, mean_n = (max_sizes(footage) if greatest is None else greatest).tolist()
    axis = (-force_n, force_n)
    if greatest is None:
        axis = (min(float(shown.min()), 0.0), max(float(shown.max()), 0.0))
        # At least half a newton, so that the noise of a fin at rest is not magnified.
        force_n = max(float(np.linalg.norm(shown, axis=1).max()), 0.5)
        mean_n = force_n if footage.reference is None else max(mean_n, 0.25)
    # The longest arrow is a fixed part of the fin's length. Means are drawn longer than forces,
    # never shorter.
    per_newton = LONGEST * length / force_n
    per_mean_newton = max(MEAN_LONGEST * length / mean_n, per_newton)
    seen = np.array([[-length, -length], [LONGEST * length, length]])
    if greatest is None:
        means = np.concatenate([footage.average, asked])
        seen = np.concatenate(
            [footage.shape.reshape(-1, 2), force * per_newton, means * per_mean_newton, NONE]
        )
    margin = 0.12 * length
    (left, bottom) = (seen.min(axis=0) - margin).tolist()
    (right, top) = (seen.max(axis=0) + margin).tolist()
    return Scale(
        length_m=length,
        metres_per_newton=per_newton,
        key_n=round_down(force_n / 2),
        metres_per_mean_newton=per_mean_newton,
        mean_key_n=round_down(mean_n / 2),
        x=(left, right),
        y=(bottom, top),
        force=_padded(*axis),
        angle=_padded(*(angle or (float(angles.min()), float(angles.max())))),
    )


def round_down(value: float) -> float:
    """Return the last of 1, 2, 5, 10, 20 .. that is not above a value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)) * power)


def _padded(low: float, high: float) -> AxisRange:
    pad = 0.06 * max(high - low, 1e-3)
    return low - pad, high + pad
