"""The task as a Gymnasium environment, ``softfin/ForceTracking-v0``, for any reinforcement-learning
library.

gymnasium.make("softfin.gym:softfin/ForceTracking-v0", plant=surrogate, render_mode="rgb_array")
"""

from functools import partial
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from softfin.control.policy import ANGLE_SCALE_RAD
from softfin.core.errors import InputError
from softfin.core.gym_registration import ID, register
from softfin.core.plant import Plant
from softfin.core.window import window_mean
from softfin.gaits.reachable import Cell
from softfin.storage.registry import find_plant
from softfin.task.references import PAPER_RANGE, References
from softfin.task.task import ForceTracking, TaskConfig, TaskState

Observation = Float[np.ndarray, "observations"]

register()


class ForceTrackingEnv(gymnasium.Env[Observation, Float[np.ndarray, "2"]]):
    """Track a reference force. Episodes never terminate; they are truncated after
    `config.episode_actions`.

    An observation consists of the angle [units of 90 degrees], the reference (x, y) [units of
    `config.force_scale_n`], and the last `config.past_actions` + 1 actions (angle, velocity), the
    latest first. An action (angle, velocity) in [-1, 1] covers the limits of the plant.
    `info` contains the window's ``error_n``, its Sobolev term ``smoothness_n``, the
    ``reference_n`` (each x, y) and the ``force_n`` at every tick of the action.

    `plant` is a Plant or its name: tank, a tank YAML file, a surrogate folder or
    package.module:plant. The plant is loaded when the environment is created; create a new
    environment if the plant changes. In render mode ``rgb_array``, `render` draws the fin with its
    force, its mean force and the reference after the last action.

    The default `references` and `config` suit the paper's fin; pass others for a fin of another
    size.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 3}  # noqa: RUF012

    def __init__(
        self,
        plant: Plant | str = "tank",
        config: TaskConfig | None = None,
        references: Cell = PAPER_RANGE,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(f"{ID}: render_mode {render_mode!r}; must be 'rgb_array' or None")
        self.task = ForceTracking(find_plant(plant), config or TaskConfig())
        clock = self.task.config.clock
        self.metadata = self.metadata | {"render_fps": round(clock.rate_hz)}
        self.references = references
        self.render_mode = render_mode
        # Bounds: the angle, which may overshoot its limits, the references, the actions.
        limits = self.task.plant.limits
        angle_rad = max(np.pi, 1.5 * abs(limits.angle_min), 1.5 * abs(limits.angle_max))
        greatest = np.abs([references.low, references.high]).max(axis=0)
        self._greatest_n = float(greatest.max())
        actions = [1.0] * (self.task.config.observations - 3)
        high = np.array(
            [angle_rad / ANGLE_SCALE_RAD, *greatest / self.task.config.force_scale_n, *actions],
            np.float32,
        )
        self.observation_space = gymnasium.spaces.Box(-high, high, dtype=np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
        # Wrapped in new functions, because JAX would otherwise reuse the trace of an equal task.
        self._reset = jax.jit(partial(self.task.reset))
        self._observe = jax.jit(partial(self.task.observe))
        self._step = jax.jit(partial(self.task.step))
        self._state: TaskState | None = None
        self._actions = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Reset the fin to rest; ``options={"reference": (x, y)}`` sets the reference, otherwise it
        is drawn at random."""
        super().reset(seed=seed)
        references = self.references
        if unknown := set(options or {}) - {"reference"}:
            raise InputError(f"{ID}: unknown reset option {unknown.pop()!r}; use 'reference'")
        if options and "reference" in options:
            x, y = (float(value) for value in options["reference"])
            if references.distance((x, y)) > 0:
                raise InputError(
                    f"{ID}: reference ({x:g}, {y:g}) N is outside {references}; create the "
                    "environment with a wider range"
                )
            references = Cell(low=(x, y), high=(x, y))
        # Gymnasium's generator seeds JAX, so that `seed` determines the episode.
        key = jax.random.key(self.np_random.integers(2**31))
        self._state = self._reset(key, References.of(references))
        self._actions = 0
        return np.array(self._observe(self._state)), {
            "reference_n": np.array(self._state.reference)
        }

    def step(
        self, action: Float[np.ndarray, "2"]
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Hold an action for its 33 or 34 ticks."""
        if self._state is None:
            raise InputError(f"{ID}: step before reset; call reset first")
        if not self.action_space.contains(np.asarray(action, np.float32)):
            raise InputError(
                f"{ID}: action {action} must be two numbers in [-1, 1]; clip it or squash it"
            )
        reference = np.array(self._state.reference)
        durations = self.task.config.clock.ticks
        ticks = durations[self._actions % len(durations)]
        held = jnp.asarray(action, jnp.float32)
        self._state, outcome = self._step(self._state, held, ticks)
        self._actions += 1
        truncated = self._actions >= self.task.config.episode_actions
        info = {
            "error_n": np.array(outcome.terms.error),
            "smoothness_n": np.array(outcome.terms.smoothness),
            "reference_n": reference,
            "force_n": np.array(outcome.forces[:ticks]),
        }
        return np.array(self._observe(self._state)), float(outcome.reward), False, truncated, info

    def render(self) -> Any:
        """Return an image of the fin after the last action, ``(height, width, 3)`` bytes.

        A plant that computes the fin's shape has a method ``shape(state)``, as the virtual tank
        does; it returns the centre line from the shaft to the tip, ``(points, 2)`` [m]. For other
        plants, the fin is a straight line of 0.2 m.
        """
        if self.render_mode is None or self._state is None:
            raise InputError(
                f'{ID}: cannot render; create it with render_mode="rgb_array" and call reset first'
            )
        # Imported here, because Matplotlib imports slowly and is needed only for rendering.
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        from softfin.evaluation.fin_figure import draw_fin

        plant = self.task.plant
        state = self._state
        # At angle 0 the fin points along -x, and at positive angles towards +y.
        tip = 0.2 * np.array([-np.cos(state.angle), np.sin(state.angle)])
        shape = plant.shape(state.plant) if hasattr(plant, "shape") else [np.zeros(2), tip]
        # At first there are fewer readings than in a window.
        mean = window_mean(state.forces, jnp.maximum(state.samples, 1))
        forces = np.stack([state.forces[-1], mean, state.reference])
        figure = Figure((4.8, 4.8), layout="constrained")
        # Matplotlib's canvas has no type annotations.
        canvas: Any = FigureCanvasAgg(figure)
        axes = figure.subplots()
        draw_fin(axes, np.asarray(shape), forces, 3 * self._greatest_n)
        axes.legend(loc="lower left")
        canvas.draw()
        return np.array(canvas.buffer_rgba())[..., :3]
