"""Record the visible motion of a plant tick by tick, with the fin's shape if the plant computes it.

`Footage` is the recording, and `Scale` is the scale at which images and pages draw it. A plant may
have a method ``shape(state)``, as the virtual tank does, that returns points ``(points, 2)`` from
the shaft to the tip [m], in the tank's axes.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.errors import PlantError
from softfin.core.plant import Plant, State, TrueForcePlant
from softfin.core.quantities import AnyArray, Command, Reading
from softfin.core.window import moving_average
from softfin.tank import Tank, TankConfig

LONGEST = 0.65
MEAN_LONGEST = 0.4
"""Arrow lengths of the largest force, and of the largest reference or mean force, relative to the
fin. On the scale of the force, whose peaks are large, means and references would be invisible."""

AxisRange = tuple[float, float]
FootageSeries = Float[np.ndarray, "ticks 2"]
NONE = np.zeros((1, 2))


class Footage(NamedTuple):
    """Recorded motion of a fin, in ticks of 10 ms."""

    command: Command
    """Fields ``(ticks,)``: the command that was active up to the reading of that tick."""
    reading: Reading
    """Fields ``(ticks,)``, force ``(ticks, 2)``."""
    true_force: FootageSeries | None
    """Force on the mount without sensor errors [N]; None if the plant has only readings."""
    average: Float[np.ndarray, "windows 2"]
    """Mean of the drawn force over the last window, from the end of the first one [N]."""
    shape: Float[np.ndarray, "ticks points 2"]
    """Centre line of the fin from the shaft to the tip [m]."""
    length_m: float
    """Length of the fin from the shaft to the tip [m]."""
    shape_known: bool
    """Whether the plant computes the shape; otherwise it is a straight line at the shaft's angle,
    with the length of the default fin."""
    thickness: Float[np.ndarray, " points"]
    """Thickness at the same points [m]; if the plant is not a tank, the scaled thickness of the
    default fin."""
    reference: FootageSeries | None
    """Reference force of the controller [N]."""
    clock: ActionClock = PAPER_CLOCK
    """Clock of the controller, which defines the window."""

    @property
    def force(self) -> FootageSeries:
        """Force to draw [N]: the true force if known, otherwise the reading."""
        return np.asarray(self.reading.force if self.true_force is None else self.true_force)


Shots: TypeAlias = tuple[Reading, AnyArray | None, AnyArray | None]
"""Readings, shapes ``(ticks, points, 2)`` [m] and true forces ``(ticks, 2)`` [N]; None for series
that the plant does not compute."""


def film(
    plant: Plant,
    key: PRNGKeyArray,
    commands: Command,
    reference: FootageSeries | None = None,
    clock: ActionClock = PAPER_CLOCK,
) -> Footage:
    """Simulate the plant from rest, with one command per tick ``(ticks,)``; `reference` is the one
    that the commands track."""
    angle, velocity = commands
    issued = Command(jnp.asarray(angle, jnp.float32), jnp.asarray(velocity, jnp.float32))
    shots = jax.jit(lambda: shoot(plant, plant.init(key), issued))()
    command, seen = jax.tree.map(np.asarray, (issued, shots))
    return develop(plant, command, seen, reference, clock)


def shoot(plant: Plant, state: State, commands: Command) -> Shots:
    """Simulate the plant from a state, with one command per tick ``(ticks,)``, and record what is
    visible; traceable by JAX."""
    shape_of: Callable[[State], Array | None] = getattr(plant, "shape", lambda state: None)

    def tick(state: State, command: Command) -> tuple[State, Shots]:
        state, reading = plant.advance(state, command, 1)
        true_force = plant.true_force(state) if isinstance(plant, TrueForcePlant) else None
        return state, (jax.tree.map(lambda x: x[0], reading), shape_of(state), true_force)

    shots: Shots = jax.lax.scan(tick, state, commands)[1]
    return shots


def develop(
    plant: Plant,
    command: Command,
    shots: Shots,
    reference: FootageSeries | None,
    clock: ActionClock,
) -> Footage:
    """Convert a recorded simulation to footage, as NumPy arrays; raises PlantError for values that
    are not finite and for wrong shapes."""
    reading, shape, true_force = shots
    name = type(plant).__name__
    fin = TankConfig().fin
    for field, values in [*reading._asdict().items(), ("true_force", true_force)]:
        if values is not None and not np.isfinite(values).all():
            read = field if values is true_force else f"reading.{field}"
            raise PlantError(
                f"{name}: {read} is not finite; run softfin.testing.check_plant to find the cause"
            )
    force = np.asarray(reading.force if true_force is None else true_force, np.float64)
    if shape is None:
        # At angle 0 the fin points along -x, and at positive angles towards +y.
        angle = np.asarray(reading.angle)
        tip = fin.length_m * np.stack([-np.cos(angle), np.sin(angle)], axis=-1)
        points = np.stack([np.zeros_like(tip), tip], axis=1)
    elif shape.ndim != 3 or shape.shape[1] < 2 or shape.shape[2] != 2:
        raise PlantError(
            f"{name}: shape(state) has shape {shape.shape[1:]}; must be (points, 2) with at least "
            "2 points"
        )
    else:
        points = np.asarray(shape)
    length = float(np.linalg.norm(np.diff(points[0], axis=0), axis=1).sum())
    # Thickness of the default fin, scaled to this length.
    thickness = fin.thickness(np.linspace(0, fin.length_m, points.shape[1])) * length / fin.length_m
    window = clock.window_ticks
    average = moving_average(force, window) if len(force) >= window else np.zeros((0, 2))
    return Footage(
        command=command,
        reading=reading,
        true_force=None if true_force is None else np.asarray(true_force),
        average=average,
        shape=points,
        length_m=length,
        shape_known=shape is not None,
        thickness=np.asarray(plant.fin.thickness) if isinstance(plant, Tank) else thickness,
        reference=reference,
        clock=clock,
    )


class Scale(NamedTuple):
    """Scale of a drawing, the same for all frames: visible part of the tank and length of the
    arrows."""

    length_m: float
    """Length of the fin [m]."""
    metres_per_newton: float
    """Length of the force arrow per newton [m/N]."""
    key_n: float
    """Round force for the key [N]."""
    metres_per_mean_newton: float
    """Length of the reference and mean force arrows per newton [m/N]."""
    mean_key_n: float
    """Round force for the key of these arrows [N]."""
    x: AxisRange
    """Visible part of the tank [m]."""
    y: AxisRange
    force: AxisRange
    """Axis limits of the force traces [N]."""
    angle: AxisRange
    """Axis limits of the angle trace [rad]."""


def max_sizes(footage: Footage) -> Float[np.ndarray, "2"]:
    """Return the magnitudes of the largest force, and of the largest reference or mean force (0 if
    there is neither) [N]."""
    means = np.concatenate(
        [footage.average, NONE if footage.reference is None else footage.reference]
    )
    force_n = np.linalg.norm(footage.force, axis=1).max()
    mean_n = np.linalg.norm(means, axis=1).max()
    return np.array([force_n, mean_n], float)


def choose_scale(
    footage: Footage, greatest: Float[np.ndarray, "2"] | None = None, angle: AxisRange | None = None
) -> Scale:
    """Return a scale at which the fin and the arrows stay within the picture at every tick.

    For footage that is still growing, the scale is valid for forces up to the `greatest` magnitudes
    (`max_sizes`) and for angles within `angle` [rad].
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
        # At least 0.5 N for the paper's fin, so that the noise of a fin at rest is not magnified.
        # At the same speed, the forces of similar fins grow with their area.
        min_n = 0.5 * (length / TankConfig().fin.length_m) ** 2
        force_n = max(float(np.linalg.norm(shown, axis=1).max()), min_n)
        mean_n = force_n if footage.reference is None else max(mean_n, min_n / 2)
    # The longest arrow is a fixed fraction of the fin's length. One newton of a mean is never drawn
    # shorter than one newton of a force.
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
    """Return the largest of .., 0.5, 1, 2, 5, 10, .. that does not exceed a value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)) * power)


def _padded(low: float, high: float) -> AxisRange:
    pad = 0.06 * max(high - low, 1e-3)
    return low - pad, high + pad
