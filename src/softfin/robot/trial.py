"""Simulated trial: a robot keeps station or follows a path, with noise in its state estimate."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.quantities import TICK_S, Command
from softfin.core.randomness import named_generator
from softfin.robot.body_config import Three
from softfin.robot.dynamics import BodyState
from softfin.robot.fin_driver import fin_command
from softfin.robot.motion_control import SEEN_ACTIONS, MotionController
from softfin.robot.noise import NoiseConfig, estimated
from softfin.robot.paths import Path, path_twist
from softfin.robot.simulation import Ambient, Orders, RobotSimulation
from softfin.robot.wrench_driver import WrenchDriver

SWAY = 1


class Disturbances(NamedTuple):
    """Disturbances of a trial."""

    current_m_s: Three = (0.0, 0.0, 0.0)
    """Steady current in world axes [m/s]."""
    push_n_s: Three = (0.0, 0.0, 0.0)
    """Impulse at the origin in body axes, spread over one action [N s]."""
    push_at_s: float = 10.0
    dead_fin: int | None = None
    """Index of the fin that dies: its drive brakes, its shaft stays where it stops, and the
    controller is notified."""
    dead_at_s: float = 20.0


class Record(NamedTuple):
    """Record of a trial; rows are ticks unless stated otherwise."""

    time: Float[np.ndarray, "ticks"]
    body: BodyState
    target_position: Float[np.ndarray, "ticks 3"]
    target_attitude: Float[np.ndarray, "ticks 4"]
    fin_wrench: Float[np.ndarray, "ticks 6"]
    """Total wrench of the fins [N, N m]."""
    shapes: np.ndarray
    """``(ticks, fins, points, 2)`` [m]."""
    asked: Float[np.ndarray, "actions 6"]
    """Wrench requested by the controller [N, N m]."""
    expected: Float[np.ndarray, "actions 6"]
    """Wrench that the fins were expected to produce in still water [N, N m]."""
    forces: Float[np.ndarray, "actions fins 2"]
    """Target mean force of each fin [N]."""
    given_up: np.ndarray
    """``(actions, 6)``"""

    def position_error(self) -> Float[np.ndarray, "ticks"]:
        """Return the distance from the path [m]."""
        return np.asarray(np.linalg.norm(self.body.position - self.target_position, axis=1))

    def attitude_error(self) -> Float[np.ndarray, "ticks"]:
        """Return the angle between the robot and the path [rad]."""
        # |q1 . q2| = cos(angle / 2).
        between = np.abs((self.target_attitude * self.body.attitude).sum(axis=1))
        return np.asarray(2 * np.arccos(np.minimum(between, 1)))


def run_trial(
    simulation: RobotSimulation,
    driver: WrenchDriver,
    path: Path,
    seconds: float | int,
    disturbances: Disturbances | None = None,
    noise: NoiseConfig | None = None,
    seed: int = 0,
) -> Record:
    """Run a trial of `seconds` [s], from rest at the start of the path."""
    trouble = disturbances or Disturbances()
    noise = noise or NoiseConfig()
    controller = MotionController(simulation.robot)
    random = named_generator(seed, "robot/noise")
    start = path(0.0)
    state = simulation.init(
        jax.random.key(seed), BodyState(start.position, start.attitude, np.zeros(6))
    )
    deviation = np.zeros((1, 12))
    kept, new = noise.decay(TICK_S)
    control = controller.init()
    driving = driver.init()
    before = rest_commands(driver)
    rows = []
    actions = []
    seen: list[tuple[np.ndarray, ...]] = [
        (np.asarray(start.position)[None], np.asarray(start.attitude)[None], np.zeros((1, 6)))
    ]
    time = 0.0
    for ticks in PAPER_CLOCK.action_ticks(round(seconds * PAPER_CLOCK.rate_hz)):
        dying = trouble.dead_fin
        if dying is not None and time >= trouble.dead_at_s and dying not in driver.dead:
            driver.declare_dead(dying)
            controller.sway_reach_n = driver.allocator.reach_along(SWAY)
        last = [np.concatenate(part) for part in zip(*seen[-SEEN_ACTIONS:], strict=True)]
        middle = time - (len(last[0]) - 1) * TICK_S / 2
        ahead = path(time + ticks * TICK_S / 2)
        control, wrench = controller.act(control, last, path(middle), path(time), ahead)
        driving, driven = driver.act(driving, wrench, np.asarray(path_twist(ahead)))
        control = controller.acknowledge(control, driven.wrench, ahead)
        commands = stack_commands(driven.commands)
        orders = Orders(before, commands, jnp.asarray(driven.delays))
        before = commands
        for fin in driver.dead:
            # A drive brakes on a command with zero velocity, whatever its angle.
            orders = Orders(_stopped(orders.before, fin), _stopped(orders.now, fin), orders.delays)
        around = _ambient(trouble, time, ticks)
        state, happened = simulation.advance(state, orders, around, ticks)
        happened = jax.tree.map(partial(_first, ticks), happened)
        rows.append(happened)
        # AR(1) noise; the state of the filter continues in the next action.
        noisy, deviation = lfilter(
            [1.0], [1.0, -kept], new * random.normal(size=(ticks, 12)), axis=0, zi=deviation
        )
        seen = [*seen[-1:], estimated(happened.body, noisy * noise.deviations())]
        actions.append((wrench, driven.wrench, driven.forces, driven.given_up))
        time += ticks * TICK_S
    happened = jax.tree.map(lambda *parts: np.concatenate(parts), *rows)
    times = TICK_S * np.arange(1, len(happened.wrench) + 1)
    targets = [path(time) for time in times.tolist()]
    return Record(
        times,
        BodyState(*(np.asarray(part, float) for part in happened.body)),
        np.array([target.position for target in targets]),
        np.array([target.attitude for target in targets]),
        np.asarray(happened.wrench, float),
        happened.shapes,
        *map(np.array, zip(*actions, strict=True)),
    )


def _ambient(trouble: Disturbances, time: float, ticks: int) -> Ambient:
    """Return the current and the push during the action of `ticks` ticks that starts at `time`
    [s]."""
    push = np.zeros(6)
    if 0 <= time - trouble.push_at_s < 1 / PAPER_CLOCK.rate_hz:
        # Constant force over the action: impulse / time.
        push[:3] = np.asarray(trouble.push_n_s) / (ticks * TICK_S)
    return Ambient(jnp.asarray(trouble.current_m_s, jnp.float32), jnp.asarray(push, jnp.float32))


def _stopped(commands: Command, fin: int) -> Command:
    return commands._replace(velocity=jnp.asarray(commands.velocity).at[fin].set(0.0))


def rest_commands(driver: WrenchDriver) -> Command:
    """Return the commands that keep fins at rest at angle 0, with fields ``(fins,)``."""
    return stack_commands([fin_command(0.0, gaits.limits.velocity_min) for gaits in driver.gaits])


def stack_commands(commands: Sequence[Command]) -> Command:
    """Stack the commands of all fins into one command with fields ``(fins,)``."""
    return Command(*(jnp.asarray(x, jnp.float32) for x in zip(*commands, strict=True)))


def _first(count: int, rows: jax.Array) -> np.ndarray:
    return np.asarray(rows)[:count]
