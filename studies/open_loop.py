"""Open-loop commands for a target force: shaft sines, the inverse model of the U-CAT robots, and
random gaits, found by trying them on a plant, usually a surrogate.

Commands are issued once per tick, so that they can follow a sine. The drive runs a velocity profile
to its target angle. The target follows the sine, while the profile velocity, which is a limit,
stays at the sine's maximum speed. If the limit followed the speed of the sine, it would slow the
profile down at each reversal: in the virtual tank, a sine of 0.4 rad at 2 Hz would reach 0.25 rad
instead of 0.39 rad.

The inverse model gives the amplitude of a sine about the direction of the target force:

    |F| = K f^2 (1 - cos A),  K = 8 rho C_d S r_c^2 pi^2

The equation and its coefficients are those of `forceToAmplitude` in the WrenchDriver of the ROS 1
package ``tut_arrows`` (Tallinn University of Technology).
"""

from itertools import product
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import RunError
from softfin.core.plant import Plant, State, TrueForcePlant
from softfin.core.quantities import RATE_HZ, TICK_S, AnyArray, Command, Limits, Reading
from softfin.core.randomness import named_generator, named_key
from softfin.core.window import moving_error

MeanForces = Float[np.ndarray, "cases ticks 2"]
ReferenceRows = Float[np.ndarray, "references 2"]
Sines = Float[np.ndarray, "cases 3"]
"""Centre [rad], amplitude [rad] and frequency [Hz]."""

CHUNK = 256
"""Maximum number of cases per call; larger sets are split, so that one program serves them all."""

OFFSETS = np.array(list(product(range(-2, 3), repeat=2)))
"""Offsets of the 5 x 5 sines around a sine to refine, in steps of centre and amplitude."""

FREQUENCIES_HZ = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
"""Frequencies of the sines; a whole number of periods fits into the window of 2 s, so that the mean
has no ripple."""

MAX_AMPLITUDE_RAD = 1.5
"""Largest amplitude of a sine in the search."""

UCAT_CONSTANT_N_S2 = 8 * 1000.0 * 0.15 * 0.02 * 0.1**2 * np.pi**2
"""K for water of 1000 kg/m3, a drag coefficient of 0.15, a fin of 0.02 m2 and an arm of 0.1 m."""

UCAT_AMPLITUDES_RAD = (0.1, 1.2)
"""Smallest and largest amplitude that the WrenchDriver commands."""

TRIALS = 6
"""Number of sines about angle 0 to which the constant K is fitted."""


class ShaftSine(NamedTuple):
    """angle(t) = centre + amplitude sin(2 pi frequency t)."""

    centre: Float[AnyArray, "*shape"]
    """Centre angle [rad]."""
    amplitude: Float[AnyArray, "*shape"]
    """Amplitude [rad]."""
    frequency: Float[AnyArray, "*shape"]
    """Frequency [Hz]."""

    def command(self, limits: Limits, time_s: Float[AnyArray, "*times"]) -> Command:
        """Return the commands at some times, clipped to the limits."""
        angle = self.centre + self.amplitude * jnp.sin(2 * jnp.pi * self.frequency * time_s)
        # |d angle / dt| = 2 pi f A |cos(2 pi f t)|, at most 2 pi f A.
        fastest = 2 * jnp.pi * self.frequency * self.amplitude
        velocity = jnp.clip(fastest, limits.velocity_min, limits.velocity_max)
        return Command(
            jnp.clip(angle, limits.angle_min, limits.angle_max),
            jnp.broadcast_to(velocity, angle.shape),
        )

    def commands(self, limits: Limits, ticks: int) -> Command:
        """Return commands ``(*shape, ticks)``, clipped to the limits."""
        columns = ShaftSine(*(jnp.asarray(part, jnp.float32)[..., None] for part in self))
        # The command of a tick affects the reading at the end of that tick, so time starts at 1.
        return columns.command(limits, (jnp.arange(ticks) + 1) * TICK_S)


def inverse(
    forces: Float[AnyArray, "*references 2"],
    frequency: float,
    limits: Limits,
    constant: float = UCAT_CONSTANT_N_S2,
) -> ShaftSine:
    """Return the sine that should produce each mean force [N]; `constant` is K [N s2].

    Thrust at angle theta points along (cos theta, -sin theta), so a force towards -y requires a
    positive angle.
    """
    direction = jnp.arctan2(-forces[..., 1], forces[..., 0])
    centre = jnp.clip(direction, limits.angle_min, limits.angle_max)
    # A = arccos(1 - |F| / (K f^2)); the largest possible force is 2 K f^2.
    cosine = 1 - jnp.linalg.norm(forces, axis=-1) / (constant * frequency**2)
    amplitude = jnp.clip(jnp.arccos(jnp.maximum(cosine, -1.0)), *UCAT_AMPLITUDES_RAD)
    return ShaftSine(centre, amplitude, jnp.full_like(amplitude, frequency))


@eqx.filter_jit
def run_commands(
    plant: Plant, commands: Command, keys: Key[Array, "seeds"]
) -> tuple[Reading, Array | None]:
    """Issue every series of commands with every key of the plant, each from rest.

    Returns the readings ``(cases, seeds, ticks)`` and the true force ``(cases, seeds, ticks, 2)``
    [N], or None if the plant does not compute it.
    """

    def tick(state: State, command: Command) -> tuple[State, tuple[Reading, Array | None]]:
        state, reading = plant.advance(state, command, 1)
        true_force = plant.true_force(state) if isinstance(plant, TrueForcePlant) else None
        return state, (jax.tree.map(lambda x: x[0], reading), true_force)

    def one(commands: Command, key: PRNGKeyArray) -> tuple[Reading, Array | None]:
        return jax.lax.scan(tick, plant.init(key), commands)[1]

    return jax.vmap(jax.vmap(one, in_axes=(None, 0)), in_axes=(0, None))(commands, keys)


def repeated(gaits: Command, seconds: int) -> Command:
    """Repeat gaits of six actions on the 33/33/34 clock: one command per tick."""
    actions = np.arange(PAPER_CLOCK.window_actions * seconds) % PAPER_CLOCK.window_actions
    rows = np.repeat(actions, PAPER_CLOCK.action_ticks(len(actions)))[: seconds * RATE_HZ]
    return Command(*(np.asarray(part)[..., rows].astype(np.float32) for part in gaits))


def force_errors(
    forces: MeanForces, references: ReferenceRows
) -> Float[np.ndarray, "cases references"]:
    """Return the error of each case at each reference [N]: the sum of the errors in x and y, as
    defined for Table II."""
    return np.stack(
        [moving_error(forces, reference).sum(axis=1) for reference in references], axis=1
    )


class OpenLoopSearch(NamedTuple):
    """Search for sines and gaits by trying them on a plant."""

    plant: Plant
    limits: Limits
    """Limits of the commands."""
    seed: int
    seconds: int = 8
    """Duration of a trial from rest [s]; the first 2 s fill the first window."""
    centres: int = 13
    """Number of centre angles in the first lattice, over the angle limits."""
    amplitudes: int = 8
    """Number of amplitudes in the first lattice, up to `MAX_AMPLITUDE_RAD`."""
    kept: int = 4
    """Number of sines that are refined per reference."""
    refinements: int = 4
    """Number of refinement rounds; each halves the steps of centre and amplitude."""
    gaits: int = 256
    """Number of random gaits of six actions; a look-up table might contain as many."""

    def forces(self, commands: Command) -> MeanForces:
        """Return the forces of many series of commands, all with the same key."""
        count = len(commands.angle)
        size = min(CHUNK, count)
        # Pad with copies of the last case to full chunks; their forces are dropped at the end.
        padding = ((0, -count % size), (0, 0))
        angle, velocity = (np.pad(field, padding, mode="edge") for field in commands)
        keys = named_key(self.seed, "baselines/search")[None]
        forces = []
        for start in range(0, count, size):
            chunk = Command(angle[start : start + size], velocity[start : start + size])
            reading, _ = run_commands(self.plant, chunk, keys)
            forces.append(np.asarray(reading.force[:, 0]))
        return np.concatenate(forces)[:count]

    def forces_of_sines(self, sines: Sines) -> MeanForces:
        """Return the forces of many sines."""
        return self.forces(ShaftSine(*sines.T).commands(self.limits, self.seconds * RATE_HZ))

    def best_sines(self, references: ReferenceRows) -> ShaftSine:
        """Find the sine with the smallest error for each reference: first on a lattice, then on
        finer lattices around the best sines."""
        low = np.array([self.limits.angle_min, 0.0])
        high = np.array([self.limits.angle_max, MAX_AMPLITUDE_RAD])
        # Spacing of the lattice. Its amplitudes start above 0, because at 0 all frequencies give
        # the same motion.
        step = (high - low) / [self.centres - 1, self.amplitudes]
        centres = np.linspace(low[0], high[0], self.centres)
        amplitudes = np.linspace(low[1], high[1], self.amplitudes + 1)[1:]
        lattice = np.array(list(product(centres, amplitudes, FREQUENCIES_HZ)))
        errors = force_errors(self.forces_of_sines(lattice), references)
        tried = [(lattice, error) for error in errors.T]
        for _ in range(self.refinements):
            step = step / 2
            near = []
            # For each reference, the best sines and their 5 x 5 neighbours of the same frequency.
            for points, error in tried:
                best = points[np.argsort(error)[: self.kept]].repeat(len(OFFSETS), axis=0)
                offsets = np.tile(OFFSETS * step, (len(best) // len(OFFSETS), 1))
                best[:, :2] = np.clip(best[:, :2] + offsets, low, high)
                near.append(best)
            # All references in one call, so that they share one compiled program.
            forces = np.split(
                self.forces_of_sines(np.concatenate(near)),
                np.cumsum([len(new) for new in near])[:-1],
            )
            extended = []
            for (points, error), new, force, reference in zip(
                tried, near, forces, references, strict=True
            ):
                new_error = force_errors(force, reference[None])[:, 0]
                extended.append((np.concatenate([points, new]), np.concatenate([error, new_error])))
            tried = extended
        return ShaftSine(*np.stack([points[error.argmin()] for points, error in tried], axis=1))

    def best_gaits(self, references: ReferenceRows) -> Command:
        """Find the gait with the smallest error for each reference ``(references, 6)``; all
        references share the same random gaits."""
        limits = self.limits
        generator = named_generator(self.seed, "baselines/gaits")
        shape = (self.gaits, PAPER_CLOCK.window_actions)
        gaits = Command(
            generator.uniform(limits.angle_min, limits.angle_max, shape),
            generator.uniform(limits.velocity_min, limits.velocity_max, shape),
        )
        errors = force_errors(self.forces(repeated(gaits, self.seconds)), references)
        best = errors.argmin(axis=0)
        return Command(gaits.angle[best], gaits.velocity[best])

    def fitted_constant(self, frequency: float) -> float:
        """Fit the inverse model's constant K [N s2] to the fin by least squares; raises RunError if
        the force opposes the model's direction."""
        amplitude = np.linspace(*UCAT_AMPLITUDES_RAD, TRIALS)
        sines = np.stack([0 * amplitude, amplitude, np.full_like(amplitude, frequency)], axis=1)
        # At angle 0, thrust is along x. The first 2 s, in which the fin starts, are left out.
        forces = self.forces_of_sines(sines)[:, 2 * RATE_HZ :, 0]
        force = forces.mean(axis=1, dtype=np.float64)
        # F = K u with u = f^2 (1 - cos A), so the least-squares fit is K = (u . F) / (u . u).
        unit = frequency**2 * (1 - np.cos(amplitude))
        constant = float(unit @ force / (unit @ unit))
        if not constant > 0:
            raise RunError(
                f"inverse model at {frequency:g} Hz: the mean force of the trials is "
                f"{force.mean():.3g} N, against the zero direction, but the model requires thrust "
                "along it; use another frequency"
            )
        return constant
