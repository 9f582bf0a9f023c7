"""Configuration of a complete run, stage by stage, and the presets of ``softfin reproduce``."""

from pydantic import PositiveInt, model_validator

from softfin.control.disturbance_observer import DisturbanceObserverConfig
from softfin.core.choices import ControllerKind, ReproducePreset
from softfin.core.configuration import Configuration
from softfin.data.collect import CollectConfig
from softfin.evaluation.evaluate import EvaluateConfig
from softfin.gaits.force_map import MapConfig
from softfin.gaits.reachable import PAPER_REFERENCES, bounding_box, format_force
from softfin.gaits.search import GaitConfig
from softfin.gaits.simulate import SurveyConfig
from softfin.learning.configuration import GRADIENT_GRID, GRADIENT_SINGLE, GRID, SINGLE, TrainConfig
from softfin.surrogate import FitConfig, StreamingConfig
from softfin.task.references import PAPER_RANGE
from softfin.task.signals import Recorded

CONTROLLER_KINDS: tuple[ControllerKind, ...] = ("gaits", "single", "grid")
"""Kinds of controllers, in the order in which they are produced."""

ONE_STEP = Recorded(time_s=(0, 10), force_n=((2, -1), (2, 1)))
"""Moving reference: one step from one side to the other."""


class ReproduceConfig(Configuration):
    """Configuration of all stages; the defaults are the paper's data and budgets. A controller set
    to null is skipped."""

    collect: CollectConfig = CollectConfig()
    """Logs of the plant; unused if the plant is a surrogate."""
    fit: StreamingConfig | FitConfig = FitConfig()
    """Surrogate; the class of the configuration selects its architecture. Unused if the plant is a
    surrogate."""
    gaits: MapConfig | None = None
    """Force map. Its gaits form a controller and initialise policies that start from gaits. Without
    a box, the map covers all references of the trained controllers."""
    single: TrainConfig | None = SINGLE
    """One policy for all references."""
    grid: TrainConfig | None = GRID
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
        return [kind for kind in CONTROLLER_KINDS if getattr(self, kind) is not None]

    @property
    def map(self) -> MapConfig | None:
        """The force map with its box."""
        if self.gaits is None or self.gaits.box is not None:
            return self.gaits
        box = bounding_box(
            [config.training_range for config in self.policies.values()] or [PAPER_RANGE]
        )
        return self.gaits.model_copy(update={"box": box})

    @model_validator(mode="after")
    def _covered(self) -> "ReproduceConfig":
        for name in ("error_map", "random"):
            if getattr(self.evaluate, name):
                raise ValueError(
                    f"evaluate.{name} is set, but a reproduction evaluates only fixed references; "
                    "omit it, and use it in softfin evaluate with one of the controllers instead"
                )
        if not self.kinds:
            raise ValueError("gaits, single and grid are all null; set at least one of them")
        cells = {kind: config.cells for kind, config in self.policies.items()}
        if self.map is not None and self.map.box is not None:
            cells["gaits"] = (self.map.box,)
        for reference in self.evaluate.references:
            for kind, own in cells.items():
                if all(cell.distance(reference) > 0 for cell in own):
                    raise ValueError(
                        f"evaluate.references has {format_force(reference)} N, which no cell of "
                        f"{kind} covers; add a cell"
                    )
        return self


PRESETS: dict[ReproducePreset, ReproduceConfig] = {
    "paper": ReproduceConfig(),
    "streaming": ReproduceConfig(fit=StreamingConfig()),
    "best": ReproduceConfig(
        fit=StreamingConfig(),
        gaits=GRADIENT_SINGLE.gradient.map,
        single=GRADIENT_SINGLE,
        grid=GRADIENT_GRID,
    ),
    "demo": ReproduceConfig(
        collect=CollectConfig(logs=10, test_logs=1, rows=6_000),
        fit=StreamingConfig(members=3, drive_updates=200, force_updates=400),
        gaits=GRADIENT_SINGLE.gradient.map,
        single=GRADIENT_SINGLE.changed(["steps=11520", "num_evaluations=4"]),
        grid=None,
        evaluate=EvaluateConfig(
            seeds=1,
            references=PAPER_REFERENCES,
            recorded=ONE_STEP,
            trim=DisturbanceObserverConfig(),
        ),
        seeds=2,
    ),
    "tiny": ReproduceConfig(
        collect=CollectConfig(logs=3, test_logs=1, rows=1500),
        fit=StreamingConfig(members=2, drive_updates=20, force_updates=20, batch=8, ticks=200),
        gaits=MapConfig(spacing_n=1.7, survey=SurveyConfig(pushes=1), gaits=GaitConfig(steps=2)),
        single=GRADIENT_SINGLE.changed(["steps=1152", "num_evaluations=1"]),
        grid=GRID.model_copy(update={"steps": 960}),
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
"""``paper``: the paper's full data and budgets. ``streaming``: the same with a streaming surrogate.
``best``: streaming surrogate, with gaits and controllers found by gradients through it. ``demo``:
the same from ten minutes of data, without the grid, in a few minutes. ``tiny``: a check that every
stage works."""
