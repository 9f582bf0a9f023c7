"""The search for a fin's gaits, in its plant: strokes of many amplitudes are simulated, their mean forces inverted."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.action_clock import ACTION_RATE_HZ, WINDOW, ticks_of
from softfin.core.errors import PlantError
from softfin.core.plant import Plant, hold
from softfin.core.plant_identity import jit_argument
from softfin.core.quantities import RATE_HZ, Command
from softfin.core.randomness import key_of
from softfin.robot.fin_driver import MOVING, FinGaits
from softfin.tank import Tank

AMPLITUDES = np.linspace(0, 1.2, 41)
"""Strokes that are tried [rad]; beyond 1.2 a fin of any stiffness pushes itself to and fro."""

CYCLES = 4
"""Windows of 2 s that a gait is repeated for from rest; the last one counts."""

ASIDE = 0.05
"""Part of its force that a gait may make across the direction of pushing in the mean: beyond, strokes do not end within
their action and each begins another way."""


def find_fin_gaits(plant: Plant) -> FinGaits:
    """Simulate strokes about angle 0, and keep those whose mean force grows with the amplitude."""
    forces, moments = (np.asarray(each, float) for each in _strokes(jit_argument(plant), jnp.asarray(AMPLITUDES)))
    mean = forces.mean(axis=1)
    # Of a sine at the strokes' frequency, which is half of the actions'; a stroke to the positive side begins at 0.
    turn = np.exp(-1j * np.pi * ACTION_RATE_HZ / RATE_HZ * np.arange(WINDOW))
    ripple = np.stack([forces[..., 1] @ turn, moments @ turn], axis=1) * 2 / WINDOW
    count = 1
    while count < len(mean) and mean[count, 0] > mean[count - 1, 0]:
        if abs(mean[count, 1]) > ASIDE * mean[count, 0] + 0.01:
            break
        count += 1
    if count < 3:
        raise PlantError(f"robot: strokes of {AMPLITUDES[1]:.2f} and {AMPLITUDES[2]:.2f} rad about angle 0 make "
                         f"{mean[1, 0]:.3g} and {mean[2, 0]:.3g} N of thrust in this plant; a fin's thrust must grow "
                         "with its strokes")  # fmt: skip
    mean[0] = 0
    return FinGaits(mean[:count, 0], AMPLITUDES[:count], ripple[:count], plant.limits)


@eqx.filter_jit
def _strokes(plant: Plant, amplitudes: Float[Array, "n"]) -> tuple[Float[Array, "n ticks 2"], Float[Array, "n ticks"]]:
    """Forces [N] and moments about the shaft [N m] over the last window."""
    limits = plant.limits
    sides = jnp.where(jnp.arange(6 * CYCLES) % 2 == 0, 1.0, -1.0)

    def each(amplitude: Float[Array, ""]) -> tuple[Float[Array, "ticks 2"], Float[Array, "ticks"]]:
        velocity = jnp.clip(2 * amplitude * ACTION_RATE_HZ / MOVING, limits.velocity_min, limits.velocity_max)
        commands = Command(amplitude * sides, jnp.broadcast_to(velocity, sides.shape))
        state = plant.init(key_of(0, "gaits"))
        if not isinstance(plant, Tank):
            force = hold(plant, state, commands)[1].force[-WINDOW:]
            return force, jnp.zeros(WINDOW)
        each_tick = jax.tree.map(lambda x: jnp.repeat(x, np.array(ticks_of(len(sides)))), commands)

        def tick(state: object, command: Command) -> tuple[object, tuple[Float[Array, "2"], Float[Array, ""]]]:
            state, _, load = plant.tick(state, command)
            return state, (load.force, load.torque)

        force, torque = jax.lax.scan(tick, state, each_tick)[1]
        return force[-WINDOW:], torque[-WINDOW:]

    return jax.vmap(each)(amplitudes)
