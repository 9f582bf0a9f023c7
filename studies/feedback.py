"""Measures feedback on fins that change: ``python -m studies.feedback`` and the names of cases.

Errors are those of the true mean force over each window of the clock, with the example's gaits.
Each case is run without feedback and with force, torque and both; `motor` has neither a force nor a
torque sensor, only the current of a motor whose torque constant is off by 10% and whose Coulomb
friction is 5% of its torque (standard deviations, unknown to the estimator).
"""

import sys
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PRNGKeyArray

import softfin
from softfin.control.controller import LoadedController
from softfin.control.family import Family, load_family
from softfin.control.feedback import UNFAMILIAR, Estimate, Feedback, FeedbackConfig
from softfin.control.pytrees import register_controllers
from softfin.core.action_clock import ActionClock
from softfin.core.quantities import Command, Limits, Reading
from softfin.evaluation.experiment import simulate
from softfin.evaluation.find_family import FamilyConfig
from softfin.tank import Tank, TankConfig
from softfin.tank.changing import ChangingTank
from softfin.tank.randomization import sample_tank, with_parameters
from softfin.tank.tank import TankState

GAITS = Path(softfin.__file__).parent / "example" / "gaits"

SIX = np.array([(1, -1), (2, -1), (2, 0), (3, 0), (1, 1), (2, 1)], float)

TORQUE_CONSTANT_ERROR = 0.1

FRICTION = 0.05

WIDTHS = FamilyConfig().widths


class ChangingFin(eqx.Module):
    """A tank that changes, and a motor with an unknown torque constant and friction."""

    tank: ChangingTank
    scale: Float[Array, ""]
    friction_nm: Float[Array, ""]
    has_sensor: bool = eqx.field(static=True)
    """Whether the torque on the fin is measured."""

    @property
    def limits(self) -> Limits:
        return self.tank.limits

    def init(self, key: PRNGKeyArray) -> TankState:
        return self.tank.init(key)

    def advance(self, state: TankState, command: Command, ticks: int) -> tuple[TankState, Reading]:
        return self.tank.advance(state, command, ticks)

    def true_force(self, state: TankState) -> Float[Array, "2"]:
        return self.tank.true_force(state)

    def torque(self, state: TankState) -> Float[Array, "2"]:
        shaft, motor = self.tank.torque(state)
        friction = self.friction_nm * jnp.sign(state.drive.rate)
        seen = shaft if self.has_sensor else jnp.nan * shaft
        return jnp.stack([seen, self.scale * (motor + friction)])


def changing(
    before: Tank,
    after: Tank | None = None,
    start_s: float = 0.0,
    end_s: float = 0.0,
    motor: tuple[float, float] = (1.0, 0.0),
    has_sensor: bool = True,
) -> ChangingFin:
    """Return a fin that changes from `start_s` to `end_s`."""
    tank = ChangingTank.between(before, before if after is None else after, start_s, end_s)
    return ChangingFin(tank, *map(jnp.float32, motor), has_sensor)


class Run(NamedTuple):
    """True mean force of each window, and the estimates after it."""

    force: Float[np.ndarray, "fins windows 2"]
    reference: Float[np.ndarray, "fins windows 2"]
    estimate: Estimate | None

    @property
    def error(self) -> Float[np.ndarray, "fins windows 2"]:
        return self.force - self.reference

    def coverage(self, from_window: int = 2) -> float | str:
        """Return how often the true mean force is within the 90% interval, except in the first
        window after the reference moved."""
        if self.estimate is None:
            return ""
        is_within = np.abs(self.force - self.estimate.force) <= self.estimate.half_width
        is_held = (np.diff(self.reference, axis=1) == 0).all(axis=2)
        return float(is_within[:, 1:][:, from_window - 1 :][is_held[:, from_window - 1 :]].mean())


@eqx.filter_jit
def _loop(
    controller: Any,
    fins: ChangingFin,
    references: Float[Array, "fins actions 2"],
    keys: Key[Array, "fins"],
) -> tuple[Array, Any]:
    clock: ActionClock = controller.clock

    def one(fin: ChangingFin, asked: Array, key: PRNGKeyArray) -> tuple[Array, Any]:
        run = simulate(controller, fin, asked, key)
        windows = len(asked) // clock.window_actions
        whole = run.output.true_force[: windows * clock.window_ticks]
        last = slice(clock.window_actions - 1, windows * clock.window_actions, clock.window_actions)
        estimates = jax.tree.map(lambda part: part[last], run.estimate)
        return whole.reshape(windows, clock.window_ticks, 2).mean(axis=1), estimates

    return jax.vmap(one)(fins, references, keys)


BATCH = 20
"""Number of fins that are run at once, and a last part of any size."""


def run(
    controller: Any,
    fins: Sequence[ChangingFin],
    references: Float[np.ndarray, "fins actions 2"],
    seed: int = 0,
) -> Run:
    """Run a controller on each fin with its own references."""
    register_controllers()
    keys = jax.random.split(jax.random.key(seed), len(fins))
    parts = []
    for first in range(0, len(fins), BATCH):
        part = slice(first, first + BATCH)
        stacked = jax.tree.map(lambda *each: jnp.stack(each), *fins[part])
        asked = jnp.asarray(references[part], jnp.float32)
        parts.append(jax.tree.map(np.asarray, _loop(controller, stacked, asked, keys[part])))
    force, estimate = jax.tree.map(lambda *each: np.concatenate(each), *parts)
    actions = controller.clock.window_actions
    windows = force.shape[1]
    return Run(force, references[:, actions - 1 : windows * actions : actions], estimate)


def sampled(name: str, count: int, around: Tank | None = None) -> list[Tank]:
    """Return fins that no family was made from."""
    keys = jax.random.split(jax.random.key(zlib.crc32(name.encode())), count)
    return [sample_tank(around or Tank(), key, WIDTHS) for key in keys]


def motors(count: int, torque_nm: float = 0.95) -> list[tuple[float, float]]:
    """Return the factor of the torque constant and the friction of motors."""
    generator = np.random.default_rng(7)
    scales = 1 + TORQUE_CONSTANT_ERROR * generator.normal(size=count)
    frictions = FRICTION * torque_nm * generator.normal(size=count)
    return list(zip(scales.tolist(), np.abs(frictions).tolist(), strict=True))


def held(references: Sequence[Sequence[float]], fins: int, seconds: float, each_s: float) -> Any:
    """Return references that take turns, ``(fins, actions, 2)``; each fin starts with another."""
    actions = int(3 * seconds)
    turn = np.arange(actions) // int(3 * each_s)
    order = (turn[None] + np.arange(fins)[:, None]) % len(references)
    return np.asarray(references, float)[order]


class Setup(NamedTuple):
    """A way to control the fin."""

    name: str
    controller: Any
    has_sensor: bool = True
    """Whether there is a torque sensor."""


def setups(
    controller: LoadedController, family: Family | None, config: FeedbackConfig
) -> list[Setup]:
    """Return what is compared."""

    def use(measurements: str) -> Feedback:
        return Feedback(controller, config.changed([f"uses={measurements}"]), family)

    return [
        Setup("nothing", controller),
        Setup("force, no family", Feedback(controller, config)),
        Setup("force", use("force")),
        Setup("torque", use("torque")),
        Setup("motor", use("torque"), has_sensor=False),
        Setup("force and torque", use("both")),
        Setup("force and motor", use("both"), has_sensor=False),
    ]


def rms(error: np.ndarray) -> float:
    """Return the root mean square."""
    return float(np.sqrt((error**2).mean()))


Fins = Callable[[Setup], list[ChangingFin]]


def load() -> tuple[LoadedController, Family]:
    """Return the example's gaits and their family."""
    controller = softfin.load_controller(GAITS)
    family = load_family(GAITS, controller)
    assert family is not None
    return controller, family


def line(*cells: object) -> None:
    """Print a row of a Markdown table."""
    texts = [f"{cell:.4f}" if isinstance(cell, float) else str(cell) for cell in cells]
    print(f"| {' | '.join(texts)} |", flush=True)


def toggle(count: int = 10) -> None:
    """A reference that toggles for 20 min, in the default tank and in others."""
    controller, family = load()
    references = held([(3, 0), (2, 0)], count, 1200, 10)
    line("20 min, (3, 0) and (2, 0)", "error x", "error y", "in other fins: x", "y", "covered")
    for setup in setups(controller, family, FeedbackConfig()):
        fins = [changing(Tank(), has_sensor=setup.has_sensor) for _ in range(count)]
        found = run(setup.controller, fins, references)
        others = [
            changing(tank, motor=motor, has_sensor=setup.has_sensor)
            for tank, motor in zip(sampled("toggle", count), motors(count), strict=True)
        ]
        other = run(setup.controller, others, references)
        # The last window before each change of the reference.
        late = slice(4, None, 5)
        x, y = (rms(found.error[:, late, axis]) for axis in (0, 1))
        other_x, other_y = (rms(other.error[:, late, axis]) for axis in (0, 1))
        line(setup.name, x, y, other_x, other_y, found.coverage())


def sudden(count: int = 100, each_s: float = 60) -> None:
    """All parameters change together at 30 s."""
    controller, family = load()
    references = held([(2, 0), (1, -1), (2, 1)], count, 60, each_s)
    line("change at 30 s", "before", "6 s", "10 s", "20 s after", "within 1.5", "covered")
    nominal = run(controller, [changing(Tank())] * 3, references[:3]).error[:, 10:].mean(axis=1)
    unchanged = np.abs(nominal)[np.arange(count) % 3]
    for setup in setups(controller, family, FeedbackConfig()):
        fins = [
            changing(Tank(), tank, 30, 30, motor, setup.has_sensor)
            for tank, motor in zip(sampled("sudden", count), motors(count), strict=True)
        ]
        found = run(setup.controller, fins, references)
        errors = [rms(found.error[:, window]) for window in (14, 17, 19, 24)]
        size = np.linalg.norm(found.error[:, 19], axis=1)
        allowed = 1.5 * np.maximum(np.linalg.norm(unchanged, axis=1), 0.02)
        line(setup.name, *errors, float((size <= allowed).mean()), found.coverage())


def slow(count: int = 10) -> None:
    """A fin that changes by 0.2 N over 10 min at one reference, then stays."""
    controller, family = load()
    references = held([(2, 0)], count, 1200, 1200)
    changed = with_parameters(Tank(), stiffness=0.75, drag=0.9)
    both = [changing(Tank()), changing(changed)]
    forces = run(controller, both, references[:2, :60]).force[:, -1]
    size_n = float(np.linalg.norm(forces[1] - forces[0]))
    share = 0.2 / size_n
    after = jax.tree.map(lambda a, b: a + (b - a) * share, Tank(), changed)
    line(f"0.2 N over 10 min ({size_n:.2f} N before scaling)", "5 min", "10 min", "20 min", "cov.")
    for setup in setups(controller, family, FeedbackConfig()):
        fins = [changing(Tank(), after, 0, 600, has_sensor=setup.has_sensor)] * count
        found = run(setup.controller, fins, references)
        errors = [
            rms(np.linalg.norm(found.error[:, window - 15 : window].mean(axis=1), axis=-1))
            for window in (150, 300, 600)
        ]
        line(setup.name, *errors, found.coverage())


def outside(count: int = 20) -> None:
    """Fins that are not of the family, torn fins, and a loose sensor."""
    controller, family = load()
    references = held([(2, 0), (1, -1), (2, 1)], count, 60, 60)
    default = TankConfig()
    shapes = {
        "span -20%": {"span_m": 0.8},
        "length -20%": {"length_m": 0.8},
        "tip as thick as the root": {"root_thickness_m": 0.8, "tip_thickness_ratio": 1.25},
        "torn: span -30%": {"span_m": 0.7},
        "torn: length -30%": {"length_m": 0.7},
    }
    line("changed at 30 s", "way", "error 20 s after", "alarms within 3 windows", "level")
    for name, factors in shapes.items():
        fin = default.fin
        values = {field: getattr(fin, field) * factor for field, factor in factors.items()}
        after = Tank(default.model_copy(update={"fin": fin.model_copy(update=values)}))
        for setup in setups(controller, family, FeedbackConfig()):
            fins = [changing(Tank(), after, 30, 30, has_sensor=setup.has_sensor)] * count
            found = run(setup.controller, fins, references)
            alarms: object = ""
            level: object = ""
            if found.estimate is not None:
                alarms = float((found.estimate.level[:, 15:18] > UNFAMILIAR).any(axis=1).mean())
                level = float(np.median(found.estimate.level[:, 17]))
            line(name, setup.name, rms(found.error[:, 24:]), alarms, level)


def false_alarms(count: int = 20) -> None:
    """Half an hour of changing references on fins of the family."""
    controller, family = load()
    references = held(SIX.tolist(), count, 1800, 10)
    line("30 min", "alarms per fin", "largest level", "covered")
    for setup in setups(controller, family, FeedbackConfig())[2:]:
        fins = [
            changing(tank, motor=motor, has_sensor=setup.has_sensor)
            for tank, motor in zip(sampled("alarm", count), motors(count), strict=True)
        ]
        found = run(setup.controller, fins, references)
        assert found.estimate is not None
        starts = np.diff((found.estimate.level > UNFAMILIAR).astype(int), axis=1) == 1
        line(
            setup.name,
            float(starts.sum(axis=1).mean()),
            float(found.estimate.level.max()),
            found.coverage(),
        )


CASES: dict[str, Callable[[], None]] = {
    "toggle": toggle,
    "sudden": sudden,
    "slow": slow,
    "outside": outside,
    "false_alarms": false_alarms,
    "turns": partial(sudden, each_s=10),
    "quick": partial(sudden, 20),
}


if __name__ == "__main__":
    for case in sys.argv[1:] or [name for name in CASES if name != "quick"]:
        print(f"\n{case}")
        CASES[case]()
