"""Finding a plant by what a user calls it: ``tank``, the folder of a surrogate, or ``package.module:plant``."""

import importlib
import sys
from pathlib import Path
from typing import Any

from softfin import artifacts
from softfin.errors import PlantError
from softfin.plant import Plant

HELP = "tank, the folder of a surrogate, or package.module:plant (one's own simulator)"


def find_plant(name: str) -> Plant:
    """The plant that `name` stands for; raises PlantError with what there is."""
    path = Path(name)
    if name == "tank":
        from softfin.tank import Tank

        return Tank()
    if artifacts.is_kind(path, "surrogate"):
        from softfin.surrogate import load_surrogate

        return load_surrogate(path)
    module, colon, attribute = name.partition(":")
    if colon and not path.exists():
        return _imported(name, module, attribute)
    what = "holds no surrogate.json" if path.is_dir() else "is no folder"
    raise PlantError(f"--plant {name}: unknown plant ({what}); give {HELP}")


def is_surrogate(name: str) -> bool:
    """Whether `name` stands for a surrogate's folder."""
    return artifacts.is_kind(Path(name), "surrogate")


def _imported(name: str, module: str, attribute: str) -> Plant:
    # As `python -m` does: one's own simulator mostly lies in the folder where one works.
    sys.path.insert(0, str(Path.cwd()))
    try:
        plant: Any = getattr(importlib.import_module(module), attribute)
    except ImportError as error:
        raise PlantError(f"--plant {name}: {error}; give {HELP}") from None
    except AttributeError:
        raise PlantError(f"--plant {name}: module {module} has no {attribute!r}; give {HELP}") from None
    finally:
        sys.path.pop(0)
    if isinstance(plant, type) or (callable(plant) and not isinstance(plant, Plant)):
        plant = plant()
    if not isinstance(plant, Plant):
        raise PlantError(f"--plant {name}: a {type(plant).__name__} is no plant: it needs limits, init and advance; "
                         "softfin.testing.check_plant says what is missing")  # fmt: skip
    return plant
