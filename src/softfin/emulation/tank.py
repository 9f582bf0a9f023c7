"""The virtual tank as the fin of emulated devices; it advances with the clock.

Motion and force are interpolated between samples of 10 ms, so all readings are one sample old.
"""

import math
import threading

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from softfin.core.clock import Clock
from softfin.core.json_object import JsonObject
from softfin.core.log_channels import CURRENT_CHANNEL, LOAD_CHANNELS
from softfin.core.plant import rest_command
from softfin.core.quantities import TICK_S, Command
from softfin.emulation.fin import COAST_RAD_S2, FinMotion
from softfin.tank import Tank

SAMPLE_VALUES = 7
"""Number of values of a sample: see `_tick`."""


class TankFin:
    """A virtual tank that implements the `EmulatedFin` protocol."""

    def __init__(self, tank: Tank, seed: int, clock: Clock) -> None:
        self.tank = tank
        self._clock = clock
        self._lock = threading.RLock()
        self._state: PyTree = self.tank.init(jax.random.key(seed))
        self._command = rest_command(self.tank.limits)
        # Run two steps so that everything is compiled before the first reading.
        self._before = self._step()
        self._after = self._step()
        self._time = clock()
        self._latest: tuple[float, FinMotion] | None = None

    def remembered(self) -> JsonObject:
        """Return the complete state for JSON."""
        with self._lock:
            self._catch_up()
            leaves = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves(self._plain())]
            return {"state": leaves, "before": self._before.tolist(), "after": self._after.tolist()}

    def recall(self, remembered: JsonObject) -> None:
        """Continue from a saved state; raises ValueError if it is from a different tank."""
        with self._lock:
            plain = self._plain()
            now, tree = jax.tree.flatten((plain, self._before, self._after))
            # States of earlier versions lack the torque about the shaft.
            samples = [[*remembered[name], 0.0][:SAMPLE_VALUES] for name in ("before", "after")]
            held = (*remembered["state"], *samples)
            then = [np.asarray(leaf, like.dtype) for leaf, like in zip(held, now, strict=True)]
            if [leaf.shape for leaf in then] != [leaf.shape for leaf in now]:
                raise ValueError("state of a different tank")
            plain, self._before, self._after = jax.tree.unflatten(tree, then)
            state, self._command = jax.tree.map(jnp.asarray, plain)
            self._state = state._replace(
                key=jax.random.wrap_key_data(state.key), torque=self._state.torque
            )
            self._time = self._clock()
            self._latest = None

    def move(self, angle: float, velocity: float) -> None:
        """Move to an angle [rad], clamped to the limits of the tank drive as in a real drive."""
        limits = self.tank.limits
        with self._lock:
            self._catch_up()
            self._command = Command(
                jnp.float32(min(max(angle, limits.angle_min), limits.angle_max)),
                jnp.float32(min(max(velocity, limits.velocity_min), limits.velocity_max)),
            )

    def halt(self) -> None:
        """Brake along the steepest ramp: move to the angle at which the fin can stop."""
        self._come_to_rest(float(self.tank.drive.acceleration), math.inf)

    def coast(self) -> None:
        """Move as far as the fin would coast. The tank's drive has a single ramp, so the fin keeps
        its velocity until shortly before the end."""
        self._come_to_rest(COAST_RAD_S2)

    def _come_to_rest(self, deceleration: float, profile_velocity: float | None = None) -> None:
        """Move to where the fin stops with a deceleration [rad/s2], by default at its present
        velocity."""
        with self._lock:
            self._catch_up()
            angle = self._after[0]
            velocity = self._after[1]
            if profile_velocity is None:
                profile_velocity = abs(velocity)
            # Braking distance: v^2 / (2 a).
            self.move(angle + velocity * abs(velocity) / (2 * deceleration), profile_velocity)

    def now(self) -> FinMotion:
        """Return the motion and force one sample ago."""
        with self._lock:
            now = self._clock()
            # Drive and sensor call this many times at the same time.
            if self._latest is None or self._latest[0] != now:
                self._catch_up()
                part = min(max((now - self._time) / TICK_S, 0.0), 1.0)
                angle, velocity, demand, current, x, y, torque = (
                    (1 - part) * self._before + part * self._after
                ).tolist()
                # The tank has no out-of-plane loads.
                wrench = (x, y, 0.0, 0.0, 0.0, torque)
                self._latest = (now, FinMotion(angle, velocity, demand, current, wrench))
            return self._latest[1]

    def _plain(self) -> tuple[PyTree, Command]:
        """Return state and command, with the random key as plain numbers and without the torque,
        which the next tick replaces."""
        key = jax.random.key_data(self._state.key)
        return self._state._replace(key=key, torque=None), self._command

    def _catch_up(self) -> None:
        now = self._clock()
        while now - self._time > TICK_S:
            self._before = self._after
            self._after = self._step()
            self._time += TICK_S

    def _step(self) -> np.ndarray:
        self._state, sample = _tick(self.tank, self._state, self._command)
        return np.asarray(sample, float)


@jax.jit
def _tick(tank: Tank, state: PyTree, command: Command) -> tuple[PyTree, Float[jax.Array, " 7"]]:
    """Advance by one sample; return the state and an array of angle, velocity, profile angle, motor
    current, force (x, y) and torque about the shaft."""
    state, read, loads = tank.measure(state, command)
    return state, jnp.array(
        [
            read.angle,
            read.velocity,
            state.drive.profile_angle,
            loads[CURRENT_CHANNEL],
            *read.force,
            loads[LOAD_CHANNELS[-1]],
        ]
    )
