"""What a reproduction consists of: the configurations of its stages, and presets of them."""

from pydantic import Field, PositiveInt, model_validator

from softfin.core.choices import ReproducePreset
from softfin.core.configuration import Configuration
from softfin.data.collect import CollectConfig
from softfin.evaluation.evaluate import EvaluateConfig
from softfin.learning.configuration import GRADIENT_GRID, GRADIENT_SINGLE, GRID, SINGLE, TrainConfig
from softfin.surrogate import FitConfig, StreamingConfig

CONTROLLERS = ("single", "grid")


class ReproduceConfig(Configuration):
    """All stages; the defaults are the paper's data and budgets."""

    collect: CollectConfig = CollectConfig()
    """Logs of the plant; not used when the plant is a surrogate."""
    fit: FitConfig | StreamingConfig = FitConfig()
    """The surrogate, the paper's nets or streaming ones; not used when the plant is one."""
    single: TrainConfig = SINGLE
    """One controller for all references."""
    grid: TrainConfig = GRID
    """One policy a cell."""
    evaluate: EvaluateConfig = EvaluateConfig(seeds=1)
    """The experiments; each trained controller does all of them, `seeds` times."""
    seeds: PositiveInt = Field(default=5)
    """Controllers trained of each kind, from seeds 0, 1, ...: the intervals are over these."""

    @model_validator(mode="after")
    def _covered(self) -> "ReproduceConfig":
        for name in ("moving", "recorded", "error_map", "random"):
            if value := getattr(self.evaluate, name):
                given = "a signal" if name == "recorded" else repr(value)
                raise ValueError(
                    f"evaluate.{name} is {given}; a reproduction evaluates constant references: leave it out; give it "
                    "to softfin evaluate with a controller of the reproduction"
                )
        for reference in self.evaluate.references:
            for kind in CONTROLLERS:
                if all(cell.distance(reference) > 0 for cell in getattr(self, kind).cells):
                    raise ValueError(
                        f"evaluate.references has {reference} N, which no cell of {kind} covers; add a cell"
                    )
        return self


def _shrunk(train: TrainConfig, steps: int) -> TrainConfig:
    return train.model_copy(update={"steps": steps})


PRESETS: dict[ReproducePreset, ReproduceConfig] = {
    "paper": ReproduceConfig(),
    "streaming": ReproduceConfig(fit=StreamingConfig()),
    "best": ReproduceConfig(fit=StreamingConfig(), single=GRADIENT_SINGLE, grid=GRADIENT_GRID),
    "demo": ReproduceConfig(
        collect=CollectConfig(logs=20, rows=12_000),
        fit=FitConfig(epochs=4),
        single=_shrunk(SINGLE, 20_000),
        grid=_shrunk(GRID, 8_000),
        seeds=2,
    ),
    "tiny": ReproduceConfig(
        collect=CollectConfig(logs=3, test_logs=1, rows=1500),
        fit=FitConfig(epochs=1),
        single=_shrunk(SINGLE, 960),
        grid=_shrunk(GRID, 960),
        evaluate=EvaluateConfig(seeds=1, seconds=6),
        seeds=2,
    ),
}
"""``paper``: the paper's full data and budgets. ``streaming``: the same with a streaming surrogate.
``best``: that surrogate, and controllers by gradients through it.
``demo``: a few minutes, with two thirds of the paper's steps or more.
``tiny``: does every stage work at all?"""
