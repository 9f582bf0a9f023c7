"""Evaluation of a robot node in simulation: compares target wrenches with the wrenches of simulated
fins.

The chain is the same as in `softfin robot ros2`: `FinReferences` distributes the wrench, and the
controller of each fin tracks its reference at its own clock, as in a separate `softfin ros2`
process. The body does not move, and each fin moves in its own tank.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray
from pydantic import Field, PositiveInt

from softfin.control.controller import LoadedController
from softfin.control.pytrees import register_controllers
from softfin.control.references import nearest_trackable
from softfin.core.action_clock import ActionClock
from softfin.core.compilation import jit
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Ticks, repeat
from softfin.core.power import drive_power, mean_powers
from softfin.core.quantities import TICK_S, Command, Reading
from softfin.core.randomness import named_generator, named_key
from softfin.evaluation.experiment import closed_loop
from softfin.robot.allocation import Allocation, SixVector
from softfin.robot.description import WRENCH_AXES, MaxThrust, RobotConfig, max_thrust_per_fin
from softfin.robot.references import NODE_CLOCK, FinReferences
from softfin.tank import Tank, TankState
from softfin.tank.tank import Load

PART_OF_REACH = 0.7
"""Fraction of the maximum thrust of each fin within which the fin forces of targets are drawn."""

WINDOWS = 10
"""Number of windows for which each target is held, from rest; errors are computed over the second
half."""

Loads: TypeAlias = tuple[Load, Float[Array, "... 2"]]
"""Load of a fin on its mount, and the torques of its drive [N m] or, after a run, its mechanical
and electrical power [W]."""

Held: TypeAlias = tuple[TankState, tuple[Reading, None, Loads]]
"""State, and readings and loads, after one tick or an action."""

ReportPart: TypeAlias = Callable[[float, str], None]
"""Function that shows the completed fraction and a note."""


class RobotEvaluateConfig(Configuration):
    """Configuration of the evaluation of a robot."""

    max_thrust: MaxThrust | None = None
    """Maximum mean force that each fin can produce in every direction [N]: one number for all, or
    one per fin name. Required, as for the ROS 2 node."""
    targets: PositiveInt = 20
    """Number of random target wrenches."""
    repeats: PositiveInt = 5
    """Repetitions of each target; each fin starts at a random time."""
    dead: str | None = None
    """Name of a fin that the node has declared dead; it does not move."""
    seed: int = Field(0, ge=0)
    """Seed of targets, starting times and sensors."""


class SimulatedFin(NamedTuple):
    """A fin in a tank, with its own controller."""

    controller: LoadedController
    tank: Tank


def evaluate_robot(
    robot: RobotConfig,
    fins: Sequence[SimulatedFin],
    config: RobotEvaluateConfig,
    report: ReportPart = lambda *_: None,
) -> JsonObject:
    """Compare the mean wrench of the fins on a fixed body with random target wrenches.

    Returns:
        For each axis, averages over targets and repetitions [N, N m]; the mean power of all fins.
    """
    max_thrust_n = max_thrust_per_fin(robot, config.max_thrust)
    dead = find_dead(robot, config.dead)
    targets = draw_targets(robot, max_thrust_n, dead, config)
    ticks = WINDOWS * max(fin.controller.clock.window_ticks for fin in fins)
    series = [fin_references(robot, max_thrust_n, dead, target, ticks) for target in targets]
    references = np.stack([each.forces for each in series])
    tracked = track_references(fins, references, dead)
    wrench = np.zeros((config.targets, config.repeats, ticks, 6))
    power = np.zeros((config.targets, config.repeats, ticks, 2))
    matrix = robot.matrix()
    random = named_generator(config.seed, "robot/starts")
    for index, (fin, (name, mount)) in enumerate(zip(fins, robot.fins.items(), strict=True)):
        # The node of a fin does not know the phases of the other fins.
        starts = random.integers(fin.controller.clock.window_ticks, size=config.repeats)
        if index in dead:
            continue
        report(index / len(fins), name)
        key = named_key(config.seed, f"robot/{name}")
        forces, torques, own_power = fin_loads(fin, tracked[:, :, index], starts, ticks, key)
        power += own_power
        wrench += forces @ matrix[:, 2 * index : 2 * index + 2].T
        # The torque of the fin about its shaft adds to the moment of its force.
        wrench[..., 3:] += torques[..., None] * np.asarray(mount.shaft_axis)
    report(1.0, "")
    counted = wrench[:, :, ticks // 2 :]
    errors = np.abs(counted.mean(axis=2) - targets[:, None])
    tracked_wrench = tracked[:, -1].reshape(config.targets, -1) @ matrix.T
    thrust_n = np.linalg.norm(counted[..., :3].mean(axis=2), axis=-1).mean()
    powers = mean_powers(float(thrust_n), power[:, :, ticks // 2 :].mean(axis=(0, 1, 2)).tolist())
    replaced = np.delete((tracked != references).any(axis=3), dead, axis=2)
    return {
        "robot": robot.name,
        "dead": config.dead,
        "seconds": ticks * TICK_S,
        "target": _per_axis(np.abs(targets).mean(axis=0)),
        "error": _per_axis(errors.mean(axis=(0, 1))),
        "error_worst": _per_axis(errors.max(axis=(0, 1))),
        "error_of_references": _per_axis(np.abs(tracked_wrench - targets).mean(axis=0)),
        "ripple": _per_axis(counted.std(axis=2).mean(axis=(0, 1))),
        "power": powers,
        "targets_given_up": sum(bool(each.given_up[-1].any()) for each in series),
        "references_unreachable": round(float(replaced.mean()), 4),
    }


def find_dead(robot: RobotConfig, name: str | None) -> tuple[int, ...]:
    """Return the indices of the dead fins (at most one); raises ConfigurationError if the fin is
    unknown or the only fin."""
    if name is None:
        return ()
    names = list(robot.fins)
    if name not in names:
        raise ConfigurationError(f"dead = {name}: unknown fin; use one of {', '.join(names)}")
    if len(names) == 1:
        raise ConfigurationError(f"dead = {name}: {robot.name} has no other fin; remove this value")
    return (names.index(name),)


def draw_targets(
    robot: RobotConfig,
    max_thrust_n: Sequence[float],
    dead: Sequence[int],
    config: RobotEvaluateConfig,
) -> Float[np.ndarray, "targets 6"]:
    """Draw the wrenches of random fin forces, which are uniform over disks with `PART_OF_REACH` of
    each fin's maximum thrust as their radius."""
    random = named_generator(config.seed, "robot/targets")
    shape = (config.targets, len(max_thrust_n))
    # The square root makes the distribution uniform over the disk.
    size = PART_OF_REACH * np.array(max_thrust_n) * np.sqrt(random.uniform(size=shape))
    size[:, list(dead)] = 0
    angle = random.uniform(-np.pi, np.pi, shape)
    forces = np.stack([size * np.cos(angle), size * np.sin(angle)], axis=-1)
    return np.asarray(forces.reshape(config.targets, -1) @ robot.matrix().T)


def fin_references(
    robot: RobotConfig,
    max_thrust_n: Sequence[float],
    dead: Sequence[int],
    target: SixVector,
    ticks: int,
) -> Allocation:
    """Return the references that the node sends within `ticks`, from its start, for a constant
    target wrench; the first axis of all fields is that of its actions."""
    node = FinReferences(robot, max_thrust_n)
    for fin in dead:
        node.declare_dead(fin)
    actions = [node.act(target) for _ in range(NODE_CLOCK.actions_within(ticks))]
    return Allocation(*(np.stack(rows) for rows in zip(*actions, strict=True)))


def track_references(
    fins: Sequence[SimulatedFin],
    references: Float[np.ndarray, "targets actions fins 2"],
    dead: Sequence[int],
) -> Float[np.ndarray, "targets actions fins 2"]:
    """Return the forces that the fins track [N]; as in the node of a fin, unreachable references
    are replaced by the nearest reachable force."""
    tracked = references.copy()
    for index, fin in enumerate(fins):
        if index not in dead:
            asked = references[:, :, index].reshape(-1, 2)
            near = nearest_trackable(fin.controller, asked)
            tracked[:, :, index] = near.reshape(references.shape[0], -1, 2)
    return tracked


def fin_loads(
    fin: SimulatedFin,
    references: Float[np.ndarray, "targets actions 2"],
    starts: Int[np.ndarray, "repeats"],
    ticks: int,
    key: PRNGKeyArray,
) -> tuple[
    Float[np.ndarray, "targets repeats ticks 2"],
    Float[np.ndarray, "targets repeats ticks"],
    Float[np.ndarray, "targets repeats ticks 2"],
]:
    """Return the force [N] of a fin on its mount, the torque about its shaft [N m] and its
    mechanical and electrical power [W] in every tick of the node.

    The fin is at rest until it starts, a number of ticks after the node. At each action, its
    controller tracks the latest of the `references` from the node.
    """
    clock = fin.controller.clock
    actions = clock.actions_within(ticks)
    newest = newest_references(clock, starts, actions, references.shape[1])
    keys = jax.random.split(key, len(starts))
    register_controllers()
    load, own_power = _loads(fin, jnp.asarray(references[:, newest], jnp.float32), keys, clock)
    force = np.zeros((len(references), len(starts), ticks, 2))
    torque = np.zeros((len(references), len(starts), ticks))
    power = np.zeros_like(force)
    for repeat_index, start in enumerate(starts):
        force[:, repeat_index, start:] = load.force[:, repeat_index, : ticks - start]
        torque[:, repeat_index, start:] = load.torque[:, repeat_index, : ticks - start]
        power[:, repeat_index, start:] = own_power[:, repeat_index, : ticks - start]
    return force, torque, power


def newest_references(
    clock: ActionClock, starts: Int[np.ndarray, "repeats"], actions: int, num_references: int
) -> Int[np.ndarray, "repeats actions"]:
    """Return the index of the latest reference from the node at each action of a fin that starts a
    number of ticks after the node."""
    fin_ticks = np.cumsum([0, *clock.action_ticks(actions)])[:-1]
    sent_ticks = np.cumsum([0, *NODE_CLOCK.action_ticks(num_references)])[:-1]
    now = starts[:, None] + fin_ticks
    return np.asarray(np.searchsorted(sent_ticks, now, side="right") - 1)


@jit("low")
def _loads(
    fin: SimulatedFin,
    references: Float[Array, "targets repeats actions 2"],
    keys: Key[Array, "repeats"],
    clock: ActionClock,
) -> Loads:
    """Return the loads of a fin from rest, with fields ``(targets, repeats, ticks, ...)``; compiled
    once for all fins that differ only in their arrays."""
    controller, tank = fin

    def hold(state: TankState, command: Command, ticks: Ticks) -> Held:
        def tick(state: TankState) -> Held:
            state, reading, load = tank.tick(state, command)
            return state, (reading, None, (load, state.torque))

        return repeat(tick, state, ticks, clock.max_ticks)

    def one(references: Float[Array, "actions 2"], key: PRNGKeyArray) -> Loads:
        run = closed_loop(controller, tank, hold, references, key, clock)
        load, torque = run.output
        return load, drive_power(torque, jnp.asarray(run.reading.velocity))

    loads: Loads = jax.vmap(jax.vmap(one), in_axes=(0, None))(references, keys)
    return loads


def _per_axis(values: SixVector) -> dict[str, float]:
    return dict(zip(WRENCH_AXES, (round(float(value), 4) for value in values), strict=True))
