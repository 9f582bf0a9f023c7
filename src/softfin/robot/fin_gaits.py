"""Search for a fin's gaits in its tank: simulate strokes of many amplitudes and invert the map from
amplitude to mean force."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import PlantError
from softfin.core.quantities import PAPER_LIMITS, RATE_HZ, Command
from softfin.core.randomness import named_key
from softfin.robot.fin_driver import MOVING, FinGaits
from softfin.tank import Tank, TankState
from softfin.tank.fin import Mount
from softfin.tank.tank import Load

STROKES_RAD = np.linspace(0, 1.2, 41)
"""Amplitudes to try [rad]; above 1.2 rad, a fin of any stiffness only pushes back and forth."""

HELD_WINDOWS = 4
"""Number of 2 s windows for which a gait is repeated from rest; only the last one is evaluated."""

MAX_SIDE_FORCE_FRACTION = 0.05
"""Maximum mean side force of a gait, as a fraction of its thrust. Above this, strokes do not finish
within their action, so each one starts differently."""

STREAM_M_S = 0.05
"""Velocity through the water, along and across the thrust, at which the force loss is measured
[m/s]."""


def find_fin_gaits(tank: Tank) -> FinGaits:
    """Simulate strokes about angle 0, and keep those for which the mean force increases with the
    amplitude.

    Raises:
        PlantError: the tank does not have the default range of angles, or fewer than two
            amplitudes are left.
    """
    if tank.limits[:2] != PAPER_LIMITS[:2]:
        raise PlantError(
            f"robot: the tank limits the angle to {tank.limits.angle_min:g} .. "
            f"{tank.limits.angle_max:g} rad, but the fins of a robot turn to any angle; remove "
            "drive.angle_min_rad and drive.angle_max_rad from the tank's file"
        )
    amplitudes = jnp.asarray(STROKES_RAD)

    def mean_force(velocity_m_s: tuple[float, float]) -> np.ndarray:
        forces, _ = _strokes(tank, amplitudes, jnp.asarray(velocity_m_s))
        return np.asarray(np.asarray(forces, float).mean(axis=1))

    still = _strokes(tank, amplitudes, jnp.zeros(2))
    forces, moments = (np.asarray(each, float) for each in still)
    mean = forces.mean(axis=1)
    along = mean - mean_force((STREAM_M_S, 0.0))
    across = mean - mean_force((0.0, STREAM_M_S))
    loss = np.stack([along[:, 0], across[:, 1]], axis=1)
    # Fourier coefficient at the stroke frequency, which is half the action rate; a stroke to the
    # positive side starts at phase 0.
    turn = np.exp(-1j * np.pi * PAPER_CLOCK.rate_hz / RATE_HZ * np.arange(PAPER_CLOCK.window_ticks))
    ripple = (
        np.stack([forces[..., 1] @ turn, moments @ turn], axis=1) * 2 / PAPER_CLOCK.window_ticks
    )
    count = 1
    # Keep the monotonic part, which can be inverted.
    while count < len(mean) and mean[count, 0] > mean[count - 1, 0]:
        if abs(mean[count, 1]) > MAX_SIDE_FORCE_FRACTION * mean[count, 0] + 0.01:
            break
        count += 1
    if count < 3:
        raise PlantError(
            f"robot: strokes of {STROKES_RAD[1]:.2f} and {STROKES_RAD[2]:.2f} rad about angle 0 "
            f"produce {mean[1, 0]:.3g} and {mean[2, 0]:.3g} N of thrust in this tank, but thrust "
            "must increase with the amplitude; check the tank's configuration"
        )
    mean[0] = 0
    return FinGaits(
        mean[:count, 0], STROKES_RAD[:count], ripple[:count], loss[:count] / STREAM_M_S, tank.limits
    )


@eqx.filter_jit
def _strokes(
    tank: Tank, amplitudes: Float[Array, "n"], velocity_m_s: Float[Array, "2"]
) -> tuple[Float[Array, "n ticks 2"], Float[Array, "n ticks"]]:
    """Return the forces [N] and the moments about the shaft [N m] over the last window, for a fin
    towed through the water."""
    mount = Mount(velocity_m_s, jnp.zeros(2), jnp.zeros(()))
    limits = tank.limits
    # Strokes to alternating sides, one per action.
    sides = np.repeat(
        [1.0, -1.0] * (PAPER_CLOCK.window_actions // 2 * HELD_WINDOWS),
        PAPER_CLOCK.action_ticks(PAPER_CLOCK.window_actions * HELD_WINDOWS),
    )

    def each(amplitude: Float[Array, ""]) -> tuple[Float[Array, "ticks 2"], Float[Array, "ticks"]]:
        # From one side to the other within the moving part of an action.
        velocity = jnp.clip(
            2 * amplitude * PAPER_CLOCK.rate_hz / MOVING, limits.velocity_min, limits.velocity_max
        )

        def tick(state: TankState, side: Float[Array, ""]) -> tuple[TankState, Load]:
            state, _, load = tank.tick(state, Command(amplitude * side, velocity), mount)
            return state, load

        load = jax.lax.scan(tick, tank.init(named_key(0, "gaits")), jnp.asarray(sides))[1]
        return load.force[-PAPER_CLOCK.window_ticks :], load.torque[-PAPER_CLOCK.window_ticks :]

    return jax.vmap(each)(amplitudes)
