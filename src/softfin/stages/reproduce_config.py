"""Configuration of a complete run, stage by stage, and the presets of ``softfin reproduce``."""

from pydantic import PositiveInt, model_validator

from softfin.control.disturbance_observer import DisturbanceObserverConfig
from softfin.core.choices import ControllerKind, ReproducePreset
from softfin.core.configuration import Configuration
from softfin.data.collect import CollectConfig
from softfin.evaluation.evaluate import EvaluateConfig
from softfin.gaits.force_map import MapConfig
from softfin.gaits.reachable import PAPER_REFERENCES
from softfin.gaits.search import GaitConfig
from softfin.gaits.simulate import SurveyConfig
from softfin.learning.configuration import GRID, PAPER_PRESETS, SINGLE, TrainConfig
from softfin.surrogate import FitConfig, StreamingConfig
from softfin.task.signals import Recorded

ONE_STEP = Recorded(time_s=(0, 10), force_n=((2, -1), (2, 1)))
"""Moving reference: one step from one side to the other."""


class ReproduceConfig(Configuration):
    """Configuration of all stages; the defaults are the paper's data and budgets. A policy set to
    null is skipped."""

    collect: CollectConfig = CollectConfig()
    """Logs of the plant; unused if the plant is a surrogate."""
    fit: StreamingConfig | FitConfig = FitConfig()
    """Surrogate; the class of the configuration selects its architecture. Unused if the plant is a
    surrogate."""
    gaits: MapConfig = MapConfig()
    """Gaits for the forces that the fin can produce."""
    single: TrainConfig | None = PAPER_PRESETS["single"]
    """One policy for all references."""
    grid: TrainConfig | None = PAPER_PRESETS["grid"]
    """One policy per cell."""
    evaluate: EvaluateConfig = EvaluateConfig(seeds=1, references=PAPER_REFERENCES)
    """Experiments; each trained controller runs all of them, `seeds` times. With `trim`, all run in
    the plant without and with force feedback."""
    seeds: PositiveInt = 5
    """Number of policies trained per kind, from consecutive seeds; intervals are computed over
    them."""

    @property
    def policies(self) -> dict[ControllerKind, TrainConfig]:
        """Training runs by kind of controller."""
        trained: dict[ControllerKind, TrainConfig] = {}
        if self.single is not None:
            trained["single"] = self.single
        if self.grid is not None:
            trained["grid"] = self.grid
        return trained

    @property
    def kinds(self) -> list[ControllerKind]:
        """Kinds of controllers that are produced."""
        return ["gaits", *self.policies]

    @model_validator(mode="after")
    def _clocks_equal(self) -> "ReproduceConfig":
        for name, policy in self.policies.items():
            if policy.task.clock != self.gaits.clock:
                raise ValueError(
                    f"{name}.task.clock is {policy.task.clock}, but gaits.clock is "
                    f"{self.gaits.clock}; use one clock, because one page shows all controllers"
                )
        return self

    @model_validator(mode="after")
    def _references_fixed(self) -> "ReproduceConfig":
        for name in ("error_map", "random"):
            if getattr(self.evaluate, name):
                raise ValueError(
                    f"evaluate.{name} is set, but a reproduction evaluates only fixed references; "
                    "omit it, and use it in softfin evaluate with one of the controllers instead"
                )
        return self


PRESETS: dict[ReproducePreset, ReproduceConfig] = {
    "paper": ReproduceConfig(),
    "demo": ReproduceConfig(
        collect=CollectConfig(logs=10, test_logs=1, rows=6_000),
        fit=StreamingConfig(members=3, drive_updates=200, force_updates=400),
        single=SINGLE,
        grid=None,
        evaluate=EvaluateConfig(
            seeds=1,
            references=PAPER_REFERENCES,
            recorded=ONE_STEP,
            trim=DisturbanceObserverConfig(),
        ),
        seeds=1,
    ),
    "tiny": ReproduceConfig(
        collect=CollectConfig(logs=3, test_logs=1, rows=1500),
        fit=StreamingConfig(members=2, drive_updates=20, force_updates=20, batch=8, ticks=200),
        gaits=MapConfig(spacing_n=1.7, survey=SurveyConfig(pushes=1), gaits=GaitConfig(steps=2)),
        single=SINGLE.changed(["steps=960", "num_evaluations=1"]),
        grid=GRID.changed(["steps=960", "num_evaluations=2"]),
        evaluate=EvaluateConfig(
            seeds=1,
            references=PAPER_REFERENCES,
            seconds=6,
            recorded=ONE_STEP,
            trim=DisturbanceObserverConfig(),
        ),
        seeds=2,
    ),
}
"""``paper``: the paper's full data and budgets, and gaits. ``demo``: a streaming surrogate from ten
minutes of data, gaits and a single policy, in two minutes. ``tiny``: a check that every stage
works."""
