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

from softfin.core.gym_registration import register_with_gymnasium

if TYPE_CHECKING:
    from softfin import testing
    from softfin.control.store import load_controller
    from softfin.core.quantities import Command, Limits, Log, Reading
    from softfin.data.collect import CollectConfig
    from softfin.data.importing.importing import ImportConfig
    from softfin.evaluation.baselines.baselines import BaselinesConfig
    from softfin.evaluation.evaluate import EvaluateConfig
    from softfin.evaluation.view import ViewConfig
    from softfin.gaits.force_map import MapConfig
    from softfin.learning.configuration import GRID, SINGLE, TrainConfig
    from softfin.stages.baselines import baselines
    from softfin.stages.offline import (
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
    from softfin.stages.reproduce import PRESETS, ReproduceConfig, reproduce
    from softfin.storage.dataset import Dataset
    from softfin.storage.registry import find_plant
    from softfin.surrogate import AutoConfig, FitConfig, StreamingConfig, StreamingSurrogate, Surrogate, load_surrogate
    from softfin.surrogate.active import ActiveCollectConfig
    from softfin.surrogate.compare.compare import CompareConfig
    from softfin.tank import Tank, TankConfig
    from softfin.tank.calibration.config import CalibrateConfig

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
    "softfin.tank.calibration.config": ("CalibrateConfig",),
    "softfin.control.store": ("load_controller",),
    "softfin.evaluation.baselines.baselines": ("BaselinesConfig",),
    "softfin.surrogate.compare.compare": ("CompareConfig",),
    "softfin.evaluation.evaluate": ("EvaluateConfig",),
    "softfin.data.collect": ("CollectConfig",),
    "softfin.storage.dataset": ("Dataset",),
    "softfin.data.importing.importing": ("ImportConfig",),
    "softfin.storage.registry": ("find_plant",),
    "softfin.core.quantities": ("Command", "Limits", "Log", "Reading"),
    "softfin.stages.reproduce": ("PRESETS", "ReproduceConfig", "reproduce"),
    "softfin.stages.offline": (
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
    "softfin.stages.baselines": ("baselines",),
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
    "softfin.gaits.force_map": ("MapConfig",),
    "softfin.learning.configuration": ("GRID", "SINGLE", "TrainConfig"),
    "softfin.evaluation.view": ("ViewConfig",),
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
