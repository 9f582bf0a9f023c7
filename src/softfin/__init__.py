"""softfin: make a soft fin produce the force you ask for.

The stages of the pipeline, the records that they exchange, and the plants and controllers:

    import softfin

    softfin.collect(plant="tank", out="dataset")
    softfin.fit("dataset", out="surrogate")
    softfin.map_forces("surrogate", out="gaits")
    softfin.evaluate("gaits", plant="tank", out="evaluation")

``__init__.pyi`` lists the public names. Each is imported on first use, so that importing softfin is
fast. In Gymnasium, the environment is ``softfin.gym:softfin/ForceTracking-v0``, or just
``softfin/ForceTracking-v0`` if Gymnasium was imported before softfin.
"""

import inspect
import sys
from typing import Any

import lazy_loader

from softfin.core.arguments import check_arguments
from softfin.core.gym_registration import register

_import_name, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    value = _import_name(name)
    if inspect.isfunction(value):
        value = check_arguments(value)
    # The next access finds the name itself.
    globals()[name] = value
    return value


if "gymnasium" in sys.modules:
    register()
