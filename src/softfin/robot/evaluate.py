"""Evaluation of a robot in simulation: wrenches, station keeping with a push and a current, and
paths, with all fins or with one dead."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.choices import RobotTask
from softfin.core.configuration import Configuration
from softfin.core.json_object import JsonObject
from softfin.core.quantities import RATE_HZ, TICK_S
from softfin.core.randomness import named_generator
from softfin.robot.baselines import MakeDriver, build_drivers
from softfin.robot.body_config import Three
from softfin.robot.description import WRENCH_AXES, RobotConfig
from softfin.robot.fin_driver import FinGaits
from softfin.robot.fin_gaits import find_fin_gaits
from softfin.robot.noise import NoiseConfig
from softfin.robot.paths import hold_place, lemniscate, lissajous
from softfin.robot.simulation import Orders, RobotSimulation
from softfin.robot.trial import Disturbances, Record, rest_commands, run_trial, stack_commands
from softfin.robot.wrench_driver import WrenchDriver
from softfin.tank import Tank

ReportNote = Callable[[float, str], None]

MIN_COUNTED_S = PAPER_CLOCK.max_ticks * TICK_S
"""Shortest evaluated part of a trial [s]: one action, half of which may be lost by rounding to
whole actions."""

EARLIEST_DEATH = 0.2
LATEST_DEATH = 0.6
"""Range of the time at which a fin dies, as fractions of a trial's duration."""


class RobotEvaluateConfig(Configuration):
    """Configuration of a robot's evaluation."""

    tasks: tuple[RobotTask, ...] = ("wrenches", "hold", "lemniscate", "lissajous")
    """Tasks, in the order of execution."""
    seeds: PositiveInt = 5
    """Number of repetitions, each with its own noise and directions of push and current."""
    wrenches: PositiveInt = 100
    """Number of random wrenches."""
    part_of_reach: float = Field(0.7, gt=0, le=1)
    """Fraction of the reach within which the wrenches are drawn."""
    hold_s: PositiveFloat = 120
    """Duration of station keeping [s], rounded to whole actions of 1/3 s."""
    path_s: PositiveFloat = 150
    """Duration of path following [s], rounded to whole actions of 1/3 s."""
    settled_s: PositiveFloat = 30
    """Time after the start, the push and a fin's death during which errors are not evaluated
    [s]."""
    push_n_s: float = Field(1.0, ge=0)
    """Horizontal push on the body during station keeping [N s]."""
    current_m_s: float = Field(0.05, ge=0)
    """Horizontal current during station keeping [m/s]."""
    lemniscate_m_s: PositiveFloat = 0.1
    """Mean speed along the lemniscate, 2 m by 1 m [m/s]."""
    lissajous_m_s: PositiveFloat = 0.1
    """Mean speed along the Lissajous curve, 2 m by 1 m by 0.5 m [m/s]."""
    baselines: bool = False
    """Whether to evaluate simpler drivers as well: without phases, with the pseudo-inverse, and
    with an analytic model of the fin."""
    dead: bool = False
    """Whether one fin dies at a random time in every trial, each fin in turn."""
    noise: NoiseConfig = NoiseConfig()
    """Noise of the robot's state estimate."""
    seed: int = Field(0, ge=0)
    """Seed of all random numbers."""

    @model_validator(mode="after")
    def _settles(self) -> "RobotEvaluateConfig":
        for task in self.tasks:
            if task == "wrenches":
                continue
            name, seconds = ("hold_s", self.hold_s) if task == "hold" else ("path_s", self.path_s)
            # The push occurs between 1 and 2 times `settled_s`, and errors are evaluated again
            # another `settled_s` later.
            least = self.settled_s * (3 if task == "hold" else 1) + MIN_COUNTED_S
            if self.dead:
                least = max(least, (self.settled_s + MIN_COUNTED_S) / (1 - LATEST_DEATH))
            if seconds < least:
                raise ValueError(
                    f"{name} = {seconds:g}: must be at least {least:g} s with settled_s = "
                    f"{self.settled_s:g}, otherwise nothing is evaluated"
                )
        return self


class RobotEvaluation(NamedTuple):
    """Figures for every task, and the record of each task's first trial."""

    figures: JsonObject
    records: dict[str, Record]


def evaluate_robot(
    robot: RobotConfig,
    tanks: Sequence[Tank],
    config: RobotEvaluateConfig,
    report: ReportNote = lambda *_: None,
) -> RobotEvaluation:
    """Evaluate a robot in simulation, with `tanks` as its fins."""
    report(0.0, "gaits of the fins")
    gaits = find_all_gaits(tanks)
    simulation = RobotSimulation(robot, tanks)
    drivers = build_drivers(robot, gaits)
    figures: JsonObject = {
        "robot": robot.name,
        "reach_n": [round(each.reach, 3) for each in gaits],
    }
    records: dict[str, Record] = {}
    wrenches = draw_wrenches(robot, gaits, config)
    done = 0
    total = len(config.tasks) * config.seeds
    for task in config.tasks:
        if task == "wrenches":
            figures[task] = wrench_errors(simulation, drivers["whole"], wrenches)
            free = wrench_errors(simulation, drivers["without phases"], wrenches)
            figures[task]["roll_ripple_ratio"] = (
                figures[task]["ripple"]["roll"] / free["ripple"]["roll"]
            )
            done += config.seeds
            continue
        rows = []
        for seed in range(config.seeds):
            report(done / total, f"{task}, seed {seed}")
            record, row = trial(simulation, drivers["whole"], task, config, config.seed + seed)
            rows.append(row)
            records.setdefault(task, record)
            done += 1
        figures[task] = rows
    if config.baselines:
        figures["baselines"] = {}
        for name, driver in drivers.items():
            report(0.99, f"baseline: {name}")
            scores: JsonObject = {"wrenches": wrench_errors(simulation, driver, wrenches)}
            for task in config.tasks:
                if task != "wrenches":
                    seeds = range(config.seed, config.seed + config.seeds)
                    scores[task] = [
                        trial(simulation, driver, task, config, seed)[1] for seed in seeds
                    ]
            figures["baselines"][name] = scores
    report(1.0, "")
    return RobotEvaluation(figures, records)


def find_all_gaits(tanks: Sequence[Tank]) -> tuple[FinGaits, ...]:
    """Find the gaits of each fin; fins with the same plant share them."""
    found: dict[int, FinGaits] = {}
    for tank in tanks:
        if id(tank) not in found:
            found[id(tank)] = find_fin_gaits(tank)
    return tuple(found[id(tank)] for tank in tanks)


def trial(
    simulation: RobotSimulation,
    driver: MakeDriver,
    task: RobotTask,
    config: RobotEvaluateConfig,
    seed: int,
) -> tuple[Record, JsonObject]:
    """Run one trial of a task, and return its record and errors."""
    random = named_generator(seed, f"robot/{task}")
    trouble = Disturbances()
    settled_from_s = config.settled_s
    seconds = float(config.path_s)
    told: JsonObject = {"seed": seed}
    if task == "hold":
        seconds = float(config.hold_s)
        path = hold_place()
        # Directions [rad].
        current, push = random.uniform(-np.pi, np.pi, 2)
        trouble = trouble._replace(
            current_m_s=_horizontal(config.current_m_s, current),
            push_n_s=_horizontal(config.push_n_s, push),
            push_at_s=random.uniform(1, 2) * config.settled_s,
        )
        told["current_from_deg"] = round(float(np.degrees(current)) % 360 - 180)
        told["push_at_s"] = round(trouble.push_at_s, 1)
    elif task == "lissajous":
        speed = config.lissajous_m_s
        path = lissajous(speed)
    else:
        speed = config.lemniscate_m_s
        path = lemniscate(speed)
    if config.dead:
        fins = list(simulation.robot.fins)
        fin = seed % len(fins)
        at = random.uniform(EARLIEST_DEATH, LATEST_DEATH) * seconds
        trouble = trouble._replace(dead_fin=fin, dead_at_s=at)
        settled_from_s = at + config.settled_s
        told |= {"dead": fins[fin], "dead_at_s": round(at, 1)}
    record = run_trial(simulation, driver(seed), path, seconds, trouble, config.noise, seed)
    # From the record, because a trial consists of whole actions and may be slightly longer or
    # shorter than `seconds`.
    ticks = np.arange(len(record.time))
    counted = ticks >= settled_from_s * RATE_HZ
    if task == "hold":
        settled_again_s = trouble.push_at_s + config.settled_s
        # Exclude the time from the push until the robot has settled again.
        counted &= (ticks < trouble.push_at_s * RATE_HZ) | (ticks >= settled_again_s * RATE_HZ)
    position = record.position_error()[counted]
    attitude = record.attitude_error()[counted]
    told |= {
        "position_rms_m": _rms(position),
        "position_worst_m": float(position.max()),
        "attitude_rms_deg": float(np.degrees(_rms(attitude))),
        "attitude_worst_deg": float(np.degrees(attitude.max())),
        "given_up": dict(zip(WRENCH_AXES, record.given_up.mean(axis=0).tolist(), strict=True)),
    }
    if task != "hold":
        told["speed_m_s"] = float(speed)
    return record, told


def _horizontal(size: float, angle: float) -> Three:
    return size * np.cos(angle), size * np.sin(angle), 0.0


def _rms(values: Float[np.ndarray, "n"]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def draw_wrenches(
    robot: RobotConfig, gaits: Sequence[FinGaits], config: RobotEvaluateConfig
) -> Float[np.ndarray, "n 6"]:
    """Draw the wrenches of random fin forces, which are uniform over disks with a fraction of each
    fin's reach as their radius."""
    random = named_generator(config.seed, "robot/wrenches")
    reach = np.array([each.reach for each in gaits])
    # The square root makes the distribution uniform over the disk.
    size = (
        config.part_of_reach * reach * np.sqrt(random.uniform(size=(config.wrenches, len(gaits))))
    )
    angle = random.uniform(-np.pi, np.pi, size.shape)
    forces = np.stack([size * np.cos(angle), size * np.sin(angle)], axis=-1)
    return np.asarray(forces.reshape(config.wrenches, -1) @ robot.matrix().T)


WRENCH_ACTIONS = 4 * PAPER_CLOCK.window_actions
"""Number of actions for which each wrench is held, from rest; only the last window is evaluated."""


def wrench_errors(
    simulation: RobotSimulation, driver: MakeDriver, wrenches: Float[np.ndarray, "n 6"]
) -> JsonObject:
    """Compare the mean wrenches over a window with the target wrenches, on a fixed body; also
    return their ripple."""
    orders = [_orders(driver(index), wrench) for index, wrench in enumerate(wrenches)]
    held = _held(simulation, orders)
    window = slice(-PAPER_CLOCK.window_ticks, None)
    error = held[:, window].mean(axis=1) - wrenches
    force_error = np.linalg.norm(error[:, :3], axis=1)
    moment_error = np.linalg.norm(error[:, 3:], axis=1)
    ripple = np.sqrt(held[:, window].var(axis=1).mean(axis=0))
    return {
        "count": len(wrenches),
        "force_error_n": float(force_error.mean()),
        "force_error_worst_n": float(force_error.max()),
        "moment_error_nm": float(moment_error.mean()),
        "moment_error_worst_nm": float(moment_error.max()),
        "ripple": dict(zip(WRENCH_AXES, ripple.tolist(), strict=True)),
    }


def _orders(driver: WrenchDriver, wrench: Float[np.ndarray, "6"]) -> Orders:
    """Return a driver's orders for one wrench, from rest, with fields ``(actions, fins)``."""
    state = driver.init()
    orders = []
    before = rest_commands(driver)
    for _ in range(WRENCH_ACTIONS):
        state, driven = driver.act(state, wrench)
        now = stack_commands(driven.commands)
        orders.append(Orders(before, now, jnp.asarray(driven.delays)))
        before = now
    stacked: Orders = jax.tree.map(lambda *rows: np.stack(rows), *orders)
    return stacked


def _held(simulation: RobotSimulation, orders: Sequence[Orders]) -> Float[np.ndarray, "n ticks 6"]:
    """Return the fins' wrenches on a fixed body."""
    together = jax.tree.map(lambda *rows: np.stack(rows), *orders)
    wrenches = np.asarray(eqx.filter_jit(jax.vmap(simulation.held))(together), float)
    return wrenches.reshape(len(orders), -1, 6)[:, np.array(PAPER_CLOCK.valid_rows(WRENCH_ACTIONS))]
