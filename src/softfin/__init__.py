"""softfin: learn to make the force that you ask a soft fin for.

The stages of the main job, the records that pass between them, and what plants and controllers are:

    import softfin

    softfin.collect("tank", Path("dataset"))
    softfin.fit(Path("dataset"), Path("surrogate"))
    softfin.train("surrogate", Path("controller"))
    softfin.evaluate(Path("controller"), "tank", Path("evaluation"))

Everything is imported when it is first used, so that ``import softfin`` costs nothing. Gymnasium knows the environment
``softfin/ForceTracking-v0`` once both are imported, in either order, and ``softfin:softfin/ForceTracking-v0`` always.
"""

import importlib
from typing import TYPE_CHECKING, Any

from softfin.tracking.registration import register_with_gymnasium

if TYPE_CHECKING:
    from softfin import testing
    from softfin.calibration.config import CalibrateConfig
    from softfin.control.store import load_controller
    from softfin.evaluation.baselines import BaselinesConfig
    from softfin.evaluation.compare import CompareConfig
    from softfin.evaluation.evaluate import EvaluateConfig
    from softfin.logs.collect import CollectConfig
    from softfin.logs.dataset import Dataset
    from softfin.logs.importing import ImportConfig
    from softfin.plants import find_plant
    from softfin.quantities import Command, Limits, Log, Reading
    from softfin.reproduction import PRESETS, ReproduceConfig, reproduce
    from softfin.stages import (
        calibrate,
        collect,
        compare,
        evaluate,
        fit,
        gaits,
        import_keras,
        import_logs,
        inspect_logs,
        map_forces,
        train,
        view,
    )
    from softfin.stages_baselines import baselines
    from softfin.surrogate import (
        AutoConfig,
        FitConfig,
        StreamingConfig,
        StreamingSurrogate,
        Surrogate,
        load_surrogate,
    )
    from softfin.surrogate.active import ActiveCollectConfig
    from softfin.tank import Tank, TankConfig
    from softfin.training.force_map import MapConfig
    from softfin.training.train import GRID, SINGLE, TrainConfig
    from softfin.viewing import ViewConfig

__all__ = [
    "GRID",
    "PRESETS",
    "SINGLE",
    "ActiveCollectConfig",
    "AutoConfig",
    "BaselinesConfig",
    "CalibrateConfig",
    "CollectConfig",
    "Command",
    "CompareConfig",
    "Dataset",
    "EvaluateConfig",
    "FitConfig",
    "ImportConfig",
    "Limits",
    "Log",
    "MapConfig",
    "Reading",
    "ReproduceConfig",
    "StreamingConfig",
    "StreamingSurrogate",
    "Surrogate",
    "Tank",
    "TankConfig",
    "TrainConfig",
    "ViewConfig",
    "baselines",
    "calibrate",
    "collect",
    "compare",
    "evaluate",
    "find_plant",
    "fit",
    "gaits",
    "import_keras",
    "import_logs",
    "inspect_logs",
    "load_controller",
    "load_surrogate",
    "map_forces",
    "reproduce",
    "testing",
    "train",
    "view",
]

_HOMES = {
    "softfin.calibration.config": ("CalibrateConfig",),
    "softfin.control.store": ("load_controller",),
    "softfin.evaluation.baselines": ("BaselinesConfig",),
    "softfin.evaluation.compare": ("CompareConfig",),
    "softfin.evaluation.evaluate": ("EvaluateConfig",),
    "softfin.logs.collect": ("CollectConfig",),
    "softfin.logs.dataset": ("Dataset",),
    "softfin.logs.importing": ("ImportConfig",),
    "softfin.plants": ("find_plant",),
    "softfin.quantities": ("Command", "Limits", "Log", "Reading"),
    "softfin.reproduction": ("PRESETS", "ReproduceConfig", "reproduce"),
    "softfin.stages": (
        "calibrate",
        "collect",
        "compare",
        "evaluate",
        "fit",
        "gaits",
        "import_keras",
        "import_logs",
        "inspect_logs",
        "map_forces",
        "train",
        "view",
    ),
    "softfin.stages_baselines": ("baselines",),
    "softfin.surrogate": (
        "AutoConfig",
        "FitConfig",
        "StreamingConfig",
        "StreamingSurrogate",
        "Surrogate",
        "load_surrogate",
    ),
    "softfin.surrogate.active": ("ActiveCollectConfig",),
    "softfin.tank": ("Tank", "TankConfig"),
    "softfin.training.force_map": ("MapConfig",),
    "softfin.training.train": ("GRID", "SINGLE", "TrainConfig"),
    "softfin.viewing": ("ViewConfig",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "testing":
        return importlib.import_module("softfin.testing")
    if name not in _HOME_OF:
        raise AttributeError(f"module 'softfin' has no attribute {name!r}; it has {', '.join(__all__)}")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__


register_with_gymnasium()
