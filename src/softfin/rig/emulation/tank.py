"""The virtual tank as the fin behind emulated devices: it moves on with the clock, whoever looks.

Between two samples of 10 ms motion and force are interpolated, so all that is seen is one sample old.
"""

import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from softfin.core.clock import REAL, Clock
from softfin.core.plant import rest_command
from softfin.core.quantities import TICK_S, Command, Reading
from softfin.rig.emulation.fin import FinMotion
from softfin.tank import Tank

AMPERE_PER_NM = 1 / (111 * 0.0259)
"""Current of the emulated motor for a torque at the fin: a reduction of 111:1 and 25.9 mN m/A, both assumed."""

LONGEST_S = 2.0
"""In real time: after a longer pause of this process the fin goes on from where it was, as if there had been none."""


class TankFin:
    """Meets the EmulatedFin contract."""

    def __init__(self, tank: Tank | None = None, seed: int = 0, clock: Clock = REAL) -> None:
        self.tank = tank or Tank()
        self._clock = clock
        self._lock = threading.Lock()
        self._state: Any = self.tank.init(jax.random.key(seed))
        self._command = rest_command(self.tank.limits)
        # Twice, so that everything is compiled before anybody looks.
        self._before = self._after = self._step()
        self._before, self._after = self._after, self._step()
        self._time = clock()
        self._seen: tuple[float, FinMotion] | None = None

    def remembered(self) -> dict[str, Any]:
        """All of its state, for JSON."""
        with self._lock:
            self._catch_up()
            state = self._state._replace(key=jax.random.key_data(self._state.key))
            leaves = [np.asarray(leaf).tolist() for leaf in jax.tree.leaves((state, self._command))]
            return {"state": leaves, "before": self._before.tolist(), "after": self._after.tolist()}

    def recall(self, remembered: dict[str, Any]) -> None:
        """Go on from there; raises ValueError where that is the state of another tank."""
        with self._lock:
            bare = self._state._replace(key=jax.random.key_data(self._state.key))
            now, tree = jax.tree.flatten((bare, self._command))
            then = [np.asarray(leaf, like.dtype) for leaf, like in zip(remembered["state"], now, strict=True)]
            before, after = (np.array(remembered[name], float) for name in ("before", "after"))
            shapes = [leaf.shape for leaf in (*then, before, after)]
            if shapes != [leaf.shape for leaf in (*now, self._before, self._after)]:
                raise ValueError("a state of another tank")
            state, self._command = jax.tree.unflatten(tree, [jnp.asarray(leaf) for leaf in then])
            self._state = state._replace(key=jax.random.wrap_key_data(state.key))
            self._before, self._after, self._time, self._seen = before, after, self._clock(), None

    def move(self, angle: float, velocity: float) -> None:
        """Brought within what the tank's drive takes, as the drive's own limits would."""
        limits = self.tank.limits
        angle = min(max(angle, limits.angle_min), limits.angle_max)
        velocity = min(max(velocity, limits.velocity_min), limits.velocity_max)
        with self._lock:
            self._catch_up()
            self._command = Command(jnp.float32(angle), jnp.float32(velocity))

    def halt(self) -> None:
        """At the fastest ramp, to where it can stop."""
        with self._lock:
            self._catch_up()
            angle, velocity = self._after[0], self._after[1]
            ahead = velocity * abs(velocity) / (2 * float(self.tank.drive.acceleration))
            limits = self.tank.limits
            goal = min(max(angle + ahead, limits.angle_min), limits.angle_max)
            self._command = Command(jnp.float32(goal), jnp.float32(limits.velocity_max))

    def now(self) -> FinMotion:
        """One sample ago."""
        with self._lock:
            now = self._clock()
            # Drive and sensor ask many times at one moment.
            if self._seen is None or self._seen[0] != now:
                self._seen = (now, self._at(now))
            return self._seen[1]

    def _at(self, now: float) -> FinMotion:
        self._catch_up()
        part = min(max((now - self._time) / TICK_S, 0.0), 1.0)
        angle, velocity, demand, torque, x, y = ((1 - part) * self._before + part * self._after).tolist()
        return FinMotion(angle, velocity, demand, torque * AMPERE_PER_NM, (x, y, 0.0, 0.0, 0.0, 0.0))

    def _catch_up(self) -> None:
        now = self._clock()
        if now - self._time > LONGEST_S:
            self._time = now - TICK_S
        while now - self._time > TICK_S:
            self._before, self._after = self._after, self._step()
            self._time += TICK_S

    def _step(self) -> np.ndarray:
        self._state, seen = _tick(self.tank, self._state, self._command)
        return np.asarray(seen, float)


@jax.jit
def _tick(tank: Tank, state: Any, command: Command) -> tuple[Any, Any]:
    """One sample on: the state, and angle, velocity, the profile's angle, torque and both forces."""
    state, reading = tank.advance(state, command, 1)
    read: Reading = jax.tree.map(lambda x: x[0], reading)
    drive = state.drive
    seen = [read.angle, read.velocity, drive.profile_angle, drive.torque, read.force[0], read.force[1]]
    return state, jnp.stack([jnp.asarray(value) for value in seen])
