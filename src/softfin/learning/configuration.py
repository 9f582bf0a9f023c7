"""Configuration of a training run: its fields, the presets, the choice between them, and the check
against a plant."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, NonNegativeFloat, PositiveInt, model_validator

from softfin.control.grid import SwitchingConfig
from softfin.core.action_clock import ACTION_TICKS
from softfin.core.choices import Algorithm, AlgorithmOption, AlgorithmPreset, PolicyLayout
from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.plant import EnsemblePlant, Plant
from softfin.gaits.gait import ForceMap
from softfin.gaits.reachable import Cell, Cells, Reachable, bounding_box
from softfin.gaits.simulate import missing_gradient
from softfin.learning.gradient import GradientConfig
from softfin.learning.policy import PolicyConfig
from softfin.learning.ppo import PPOConfig
from softfin.task.references import PAPER_CELLS, PAPER_RANGE, check_apart
from softfin.task.task import TaskConfig

EDGE_ROUNDING_N = 1e-3
"""Tolerance for the edges of lattices and regions, which are rounded in their files [N]."""


class TrainConfig(Configuration):
    """Configuration of a training run; the defaults are those of `GRID`."""

    controller: PolicyLayout = "grid"
    """One policy for a whole range of references, or one for each cell of a grid."""
    steps: PositiveInt = 10_000
    """Actions in the plant for each policy, over all its environments; the paper has 10,000 per
    cell, and 30,000 for single."""
    cells: Cells = Field(PAPER_CELLS, min_length=1)
    """References [N] for which each policy is trained; one cell for `single`."""
    margin_n: NonNegativeFloat = 0.0
    """Margin around their cells for which policies are also trained [N], because a grid switches
    with a hysteresis."""
    switching: SwitchingConfig = SwitchingConfig(margin_n=0.0)
    """How a grid switches between its policies; a switching margin larger than `margin_n` gives a
    policy references for which it was not trained, so the paper's grid has neither."""
    task: TaskConfig = TaskConfig()
    """The force-tracking task."""
    policy: PolicyConfig = PolicyConfig()
    """Size and start of the networks."""
    ensemble: Literal["mean", "each"] = "mean"
    """Use of an ensemble in training: each fin is the mean of all members, or one of the members;
    the mean is evaluated. `each` needs an ensemble of two or more members."""
    algorithm: Algorithm = "ppo"
    """LSTM-PPO or gradients through the plant."""
    ppo: PPOConfig = PPOConfig()
    """Settings of LSTM-PPO."""
    gradient: GradientConfig = GradientConfig()
    """Settings of gradient training."""
    num_evaluations: PositiveInt = 10
    """Number of evaluations of the deterministic policies, evenly spaced over the run; a checkpoint
    is written each time."""
    lattice: PositiveInt = 2
    """Policies are evaluated at lattice x lattice references of each cell; these actions do not
    count as `steps`.

    The best policy is kept. The defaults avoid the paper's six references, which are the centres of
    its cells: a policy must not be selected on the references for which its errors are reported.
    """

    @model_validator(mode="after")
    def _fits(self) -> "TrainConfig":
        if self.controller == "single" and len(self.cells) != 1:
            raise ValueError(
                f"a single controller has one cell, not {len(self.cells)}; give one, or "
                "controller=grid"
            )
        check_apart(self.cells, "cells")
        if self.begins_as_gaits and not self.task.phase:
            raise ValueError(
                "task.phase is false, and a policy that begins as gaits observes the phase; leave "
                "it true, or give gradient.warm_start=false"
            )
        return self

    @property
    def num_updates(self) -> int:
        """Updates of each policy: as many whole rollouts as fit into `steps`."""
        return self.steps // self.learning.steps_per_update

    @property
    def learning(self) -> PPOConfig | GradientConfig:
        """Settings of the algorithm."""
        return self.ppo if self.algorithm == "ppo" else self.gradient

    @property
    def begins_as_gaits(self) -> bool:
        """Whether policies start as copies of gaits, which are found over all their references."""
        return self.algorithm == "gradient" and self.gradient.warm_start

    @property
    def training_range(self) -> Cell:
        """The bounding box of all references for which policies are trained."""
        return bounding_box(self.cells).expanded(self.margin_n)

    def evaluation_references(
        self, reachable: Reachable | None
    ) -> Float[np.ndarray, "cells references 2"]:
        """The lattice of references of each cell [N], each moved to the nearest force that the fin
        can make."""
        lattices = [cell.lattice(self.lattice) for cell in self.cells]
        return np.asarray(
            lattices if reachable is None else reachable.nearest(lattices), np.float32
        )


GRID = TrainConfig()
"""The paper's grid-switching controller on its budget."""

SINGLE = TrainConfig(
    controller="single",
    steps=30_000,
    cells=(PAPER_RANGE,),
    task=TaskConfig(reference_actions=45),
    ppo=PPOConfig(num_envs=32, num_epochs=8),
    lattice=4,
)
"""The paper's single controller on its budget."""

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
"""One controller by gradients through the plant: 40 updates."""

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
"""One policy per cell by gradients through the plant: 20 updates."""

HINDSIGHT = ("ppo.relabelling=1",)
"""Also learn from each rollout for other references; not in the paper."""

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
"""Presets by algorithm and kind of controller."""


def choose_preset(
    plant: Plant, controller: PolicyLayout = "grid", algorithm: AlgorithmOption = "auto"
) -> tuple[TrainConfig, str]:
    """Return the preset for a plant, and why its algorithm was chosen; auto uses gradients if the
    plant has them."""
    if algorithm != "auto":
        return TRAIN_PRESETS[algorithm, controller], f"{algorithm}, as asked"
    missing = missing_gradient(plant)
    if missing is None:
        return TRAIN_PRESETS["gradient", controller], "gradient, as the plant has gradients"
    reason = f"ppo-hindsight, because the plant has no gradient: {missing}"
    return TRAIN_PRESETS["ppo-hindsight", controller], reason


def check(
    plant: Plant, config: TrainConfig, seeds: Sequence[int], force_map: ForceMap | None = None
) -> None:
    """Raise ConfigurationError if the budget is smaller than one rollout, or anything else does not
    fit."""
    if not seeds or len(set(seeds)) != len(seeds):
        raise ConfigurationError(f"seeds {list(seeds)}: give at least one, and each once")
    learning = config.learning
    task = config.task
    if config.num_updates == 0:
        raise ConfigurationError(
            f"steps = {config.steps}: fewer than one rollout of {learning.steps_per_update} "
            f"({learning.num_envs} environments x {learning.num_steps} actions); give more steps"
        )
    samples = task.episode_actions // len(ACTION_TICKS) * sum(ACTION_TICKS)
    if samples < task.window_samples:
        raise ConfigurationError(
            f"task.episode_actions = {task.episode_actions}: an episode of {samples} samples "
            f"contains no whole window of {task.window_samples} to evaluate; give a longer episode "
            "or a "
            "smaller task.window_samples"
        )
    members = plant.size if isinstance(plant, EnsemblePlant) else 1
    if config.ensemble == "each" and members < 2:
        raise ConfigurationError(
            "ensemble = each: the plant is not an ensemble of two members or more; leave it out, "
            "or fit a streaming surrogate with --set members=5"
        )
    if not config.begins_as_gaits or force_map is None:
        return
    box = config.training_range
    table = force_map.gaits.table
    least, greatest = force_map.reachable.bounds()
    low = np.maximum(box.low, least) + EDGE_ROUNDING_N
    high = np.minimum(box.high, greatest) - EDGE_ROUNDING_N
    if np.any(table.low > low) or np.any(table.high < high):
        between = Cell(low=tuple(map(float, table.low)), high=tuple(map(float, table.high)))
        raise ConfigurationError(
            f"map of {between}: its gaits do not reach over the references to train for ({box}); "
            "map these too, or all that the fin can make (softfin map without a box)"
        )
