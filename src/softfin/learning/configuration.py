"""Configuration of a training run: its fields, the presets and how to choose one, and its checks
against a plant."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, NonNegativeFloat, PositiveInt, model_validator

from softfin.control.grid import SwitchingConfig
from softfin.core.action_clock import ActionClock
from softfin.core.choices import Algorithm, AlgorithmOption, AlgorithmPreset, PolicyLayout
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.plant import EnsemblePlant, Plant
from softfin.gaits.gait import FinForces, GaitTable
from softfin.gaits.reachable import Cell, Cells, Reachable, bounding_box
from softfin.gaits.simulate import missing_gradient
from softfin.gaits.usable import check_usable
from softfin.learning.gradient import GradientConfig
from softfin.learning.policy import PolicyConfig
from softfin.learning.ppo import PPOConfig
from softfin.task.references import PAPER_CELLS, PAPER_RANGE, check_apart, lattice
from softfin.task.task import TaskConfig

EDGE_ROUNDING_N = 1e-3
"""Tolerance for the edges of lattices and regions, which are rounded in files, for the paper's fin
[N]."""

GRID_SHAPE = (2, 3)
"""Number of cells along x and y in a grid over a fin's reach: six in all, as in the paper."""

CHECKED_POINTS = 8
"""Number of points along each side of a cell; the fin must reach at least one of them."""


class TrainConfig(Configuration):
    """Configuration of a training run; the defaults are those of `GRID`."""

    controller: PolicyLayout = "grid"
    """Type of controller: one policy for all references (`single`), or one per cell (`grid`)."""
    steps: PositiveInt = 10_000
    """Number of actions in the plant per policy, over all its environments. The paper uses 10,000
    per cell of a grid, and 30,000 for a single controller."""
    cells: Cells = Field(PAPER_CELLS, min_length=1)
    """Range of references for each policy [N]; one cell for `single`."""
    margin_n: NonNegativeFloat = 0.0
    """Margin around the cells in which policies are also trained [N], because a grid switches with
    hysteresis."""
    switching: SwitchingConfig = SwitchingConfig(margin_n=0.0)
    """Switching between the policies of a grid. If its margin is larger than `margin_n`, policies
    get references for which they were not trained. Both are 0 in the paper's grid."""
    task: TaskConfig = TaskConfig()
    """Force-tracking task."""
    policy: PolicyConfig = PolicyConfig()
    """Size and initial values of the networks."""
    ensemble: Literal["mean", "each"] = "mean"
    """Use of an ensemble in training: each fin is the mean of all members (`mean`), or one member
    (`each`, which requires at least two members). Evaluations always use the mean."""
    algorithm: Algorithm = "ppo"
    """LSTM-PPO, or gradients through the plant."""
    ppo: PPOConfig = PPOConfig()
    """Configuration of LSTM-PPO."""
    gradient: GradientConfig = GradientConfig()
    """Configuration of gradient training."""
    num_evaluations: PositiveInt = 10
    """Number of evaluations of the deterministic policies, evenly spaced over the run; each one
    writes a checkpoint."""
    lattice: PositiveInt = 2
    """Number of evaluation references per axis of each cell. Actions of evaluations do not count as
    `steps`.

    The policy with the lowest error is kept. The default avoids the paper's six references, which
    are the centres of its cells, because a policy must not be selected on the references for which
    its errors are reported.
    """

    @model_validator(mode="after")
    def _fits(self) -> "TrainConfig":
        if self.controller == "single" and len(self.cells) != 1:
            raise ValueError(
                f"a single controller must have one cell, not {len(self.cells)}; use one cell, or "
                "controller=grid"
            )
        check_apart(self.cells, "cells")
        if self.begins_as_gaits and not self.task.phase:
            raise ValueError(
                "task.phase is false, but a policy that starts from gaits must observe the phase; "
                "set task.phase=true or gradient.warm_start=false"
            )
        return self

    @property
    def num_updates(self) -> int:
        """Number of updates of each policy: complete rollouts within `steps`."""
        return self.steps // self.learning.steps_per_update

    @property
    def learning(self) -> PPOConfig | GradientConfig:
        """Configuration of the selected algorithm."""
        return self.ppo if self.algorithm == "ppo" else self.gradient

    @property
    def begins_as_gaits(self) -> bool:
        """Whether policies start from gaits."""
        return self.algorithm == "gradient" and self.gradient.warm_start

    @property
    def training_range(self) -> Cell:
        """Bounding box of all references for which policies are trained."""
        return bounding_box(self.cells).expanded(self.margin_n)

    def evaluation_references(
        self, reachable: Reachable | None
    ) -> Float[np.ndarray, "cells references 2"]:
        """Return the evaluation references of each cell [N], each moved to the nearest reachable
        force."""
        lattices = [cell.lattice(self.lattice) for cell in self.cells]
        return np.asarray(
            lattices if reachable is None else reachable.nearest(lattices), np.float32
        )


GRID = TrainConfig()
"""The paper's grid-switching controller, with its number of steps."""

SINGLE = TrainConfig(
    controller="single",
    steps=30_000,
    cells=(PAPER_RANGE,),
    task=TaskConfig(reference_actions=45),
    ppo=PPOConfig(num_envs=32, num_epochs=8),
    lattice=4,
)
"""The paper's single controller, with its number of steps."""

GRADIENT_SINGLE = SINGLE.changed(
    (
        "algorithm=gradient",
        "steps=23040",
        "num_evaluations=5",
        "task.phase=true",
        "task.reward.target=window",
        "task.reference_actions=24",
        "margin_n=0.1",
        "gradient.map.spacing_n=0.55",
    )
)
"""A single controller trained by gradients through the plant, in 40 updates."""

GRADIENT_GRID = GRADIENT_SINGLE.merged(
    {
        "controller": "grid",
        "cells": GRID.model_dump()["cells"],
        "steps": 2_880,
        "num_evaluations": 5,
        "margin_n": 0.1,
        "switching": {"margin_n": 0.1},
        "gradient": {"num_envs": 8, "learning_rate": 3e-4},
    },
    "grid",
)
"""A grid of policies trained by gradients through the plant, in 20 updates."""

HINDSIGHT = ("ppo.relabelling=1",)
"""Configuration change that also uses each rollout for other references; not in the paper."""

TRAIN_PRESETS: Mapping[tuple[AlgorithmPreset, PolicyLayout], TrainConfig] = MappingProxyType(
    {
        ("ppo", "single"): SINGLE,
        ("ppo", "grid"): GRID,
        ("ppo-hindsight", "single"): SINGLE.changed(HINDSIGHT),
        ("ppo-hindsight", "grid"): GRID.changed(HINDSIGHT),
        ("gradient", "single"): GRADIENT_SINGLE,
        ("gradient", "grid"): GRADIENT_GRID,
    }
)
"""Presets by algorithm and type of controller."""


def choose_preset(
    plant: Plant, controller: PolicyLayout = "single", algorithm: AlgorithmOption = "auto"
) -> tuple[TrainConfig, str]:
    """Return the preset for a plant and the reason for its algorithm; `auto` uses gradients if the
    plant has them."""
    if algorithm != "auto":
        return TRAIN_PRESETS[algorithm, controller], f"{algorithm}, as requested"
    missing = missing_gradient(plant)
    if missing is None:
        return TRAIN_PRESETS["gradient", controller], "gradient, because the plant has gradients"
    reason = f"ppo-hindsight, because the plant has no gradient: {missing}"
    return TRAIN_PRESETS["ppo-hindsight", controller], reason


def for_clock(config: TrainConfig, clock: ActionClock) -> TrainConfig:
    """Adapt a preset to another clock. Numbers of actions are scaled so that their durations stay
    the same; the number of updates does not change. A longer window scales the durations by the
    same factor."""
    own = config.task.clock
    ratio = clock.rate_hz / own.rate_hz * max(1, clock.window_ticks / own.window_ticks)
    cycle = len(clock.ticks)

    def actions(count: int) -> int:
        return cycle * max(1, round(count * ratio / cycle))

    learning = config.learning
    num_steps = actions(learning.num_steps)
    return config.merged(
        {
            "task": {
                "clock": clock.model_dump(),
                "episode_actions": actions(config.task.episode_actions),
                "reference_actions": actions(config.task.reference_actions),
            },
            "switching": {"fade_actions": round(config.switching.fade_actions * ratio)},
            "steps": config.steps * num_steps // learning.num_steps,
            "ppo": {"num_steps": actions(config.ppo.num_steps)},
            "gradient": {"num_steps": actions(config.gradient.num_steps)},
        },
        "clock",
    )


def fit_to_reach(config: TrainConfig, forces: FinForces) -> TrainConfig:
    """Return a preset for all forces that a fin can produce, as far as there are gaits for them.

    Cells cover the reach. The preset's values in newtons were tuned for the paper's fin, so they
    are multiplied by the size of this one; the reward is divided by it.
    """
    size = forces.reachable.size
    box = reach_box(forces)
    cells: Cells = (box,)
    if config.controller == "grid":
        cells = without_unreachable(lattice(*GRID_SHAPE, box), forces.reachable)
    x, y = config.task.reward.weight
    values = {
        "cells": [cell.model_dump() for cell in cells],
        "margin_n": config.margin_n * size,
        "switching": {
            "margin_n": config.switching.margin_n * size,
            "step_n": config.switching.step_n * size,
        },
        "task": {
            "force_scale_n": config.task.force_scale_n * size,
            "reward": {"weight": (x / size, y / size)},
        },
        "gradient": {
            "rounding_n": config.gradient.rounding_n * size,
            "map": {"spacing_n": None},
        },
    }
    return config.merged(values, "reach")


def reach_box(forces: FinForces) -> Cell:
    """Return the bounding box of the forces that a fin can produce, as far as there are gaits for
    them."""
    box = forces.reachable.bounding_box()
    return box if forces.gaits is None else box.clipped(forces.gaits.low, forces.gaits.high)


def without_unreachable(cells: Cells, reachable: Reachable) -> Cells:
    """Return the cells of which a fin can produce at least one force; all cells if it can produce
    none at all, which `check` reports."""
    return tuple(cell for cell in cells if _can_make(reachable, cell)) or cells


def _can_make(reachable: Reachable, cell: Cell) -> bool:
    """Return whether a fin can produce at least one force of a cell."""
    return bool(reachable.contains(cell.lattice(CHECKED_POINTS)).any())


def check(
    plant: Plant,
    config: TrainConfig,
    seeds: Sequence[int],
    forces: FinForces | None = None,
) -> None:
    """Check a configuration against a plant, seeds, and the forces that the plant can produce.

    Raises:
        ConfigurationError: they are incompatible, the fin can produce none of the forces of a cell,
            or the number of steps is less than one rollout.
        PlantError: the fin's forces cannot be controlled.
    """
    if not seeds or len(set(seeds)) != len(seeds):
        raise ConfigurationError(f"seeds {list(seeds)}: use at least one seed, without duplicates")
    learning = config.learning
    task = config.task
    if config.num_updates == 0:
        raise ConfigurationError(
            f"steps = {config.steps}: fewer than one rollout of {learning.steps_per_update} "
            f"({learning.num_envs} environments x {learning.num_steps} actions); use more steps"
        )
    cycle = len(task.clock.ticks)
    if learning.num_steps % cycle:
        raise ConfigurationError(
            f"{config.algorithm}.num_steps = {learning.num_steps}: must be a whole number of "
            f"cycles of the clock; use a multiple of {cycle}"
        )
    samples = sum(task.clock.action_ticks(task.episode_actions))
    if samples < task.window_ticks:
        raise ConfigurationError(
            f"task.episode_actions = {task.episode_actions}: an episode of {samples} samples is "
            f"shorter than the window of {task.window_ticks} samples to evaluate; use longer "
            "episodes or a smaller task.window_samples"
        )
    members = plant.size if isinstance(plant, EnsemblePlant) else 1
    if config.ensemble == "each" and members < 2:
        raise ConfigurationError(
            "ensemble = each: the plant must be an ensemble of at least two members; remove the "
            "option, or fit a streaming surrogate with --set members=5"
        )
    if forces is None:
        return
    check_usable(plant, forces.reachable)
    _check_reach(config.cells, forces.reachable)
    if forces.gaits is not None and forces.clock != task.clock:
        raise ConfigurationError(
            f"map: its clock ({forces.clock}) differs from that of the training ({task.clock}); "
            "use the same --clock for softfin map and softfin train"
        )
    if config.begins_as_gaits and forces.gaits is not None:
        _check_gaits(config, forces.gaits, forces.reachable)


def _check_gaits(config: TrainConfig, table: GaitTable, reachable: Reachable) -> None:
    """Raise ConfigurationError if the gaits of a map do not cover the references for training."""
    box = config.training_range
    # References outside the reachable region are moved into it, so gaits need not cover them.
    reachable_low, reachable_high = reachable.bounds()
    rounding_n = EDGE_ROUNDING_N * reachable.size
    low = np.maximum(box.low, reachable_low) + rounding_n
    high = np.minimum(box.high, reachable_high) - rounding_n
    if np.any(table.low > low) or np.any(table.high < high):
        covered = Cell(low=tuple(map(float, table.low)), high=tuple(map(float, table.high)))
        raise ConfigurationError(
            f"map of {covered}: its gaits do not cover the references for training ({box}); map a "
            "box that contains them, or the full reachable region (softfin map without a box)"
        )


def _check_reach(cells: Cells, reachable: Reachable) -> None:
    for cell in cells:
        if not _can_make(reachable, cell):
            raise ConfigurationError(
                f"range {cell}: this fin cannot produce any of these forces; its reach is "
                f"{reachable.describe()}; choose a range within it, or omit --range to train "
                "for all of it"
            )
