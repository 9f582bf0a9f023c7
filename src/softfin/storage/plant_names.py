"""What a plant is called: ``tank``, a YAML file, a surrogate's folder, ``package.module:plant``; no JAX here."""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeAlias

from softfin.core.errors import PlantError
from softfin.storage import artifact as artifacts
from softfin.storage.live import TANK, is_live

HELP = (
    "tank, the YAML file of a tank, the folder of a surrogate (./NAME where it is called as a plant is), or "
    "package.module:plant (one's own simulator)"
)

PlantKind: TypeAlias = Literal["tank", "tank file", "surrogate", "object"]
"""The virtual tank, the tank of a YAML file, the surrogate in a folder, or an object of a Python module."""


def resolve_plant(name: str) -> PlantKind:
    """The kind of plant that `name` stands for; raises PlantError with what there is."""
    path = Path(name)
    if is_live(name):
        folder = f"; the folder of this name is ./{name}" if path.exists() else ""
        raise PlantError(
            f"plant {name}: moves in real time and cannot be simulated; collect, evaluate and run take it{folder}"
        )
    if name == TANK:
        return "tank"
    if path.suffix in (".yaml", ".yml") and path.is_file():
        return "tank file"
    if artifacts.is_kind(path, "surrogate"):
        return "surrogate"
    if ":" in name and not path.exists():
        import_object(name)
        return "object"
    what = (
        "holds no surrogate.json" if path.is_dir() else "is a file of no such kind" if path.exists() else "is no folder"
    )
    raise PlantError(f"plant {name}: unknown ({what}); give {HELP}")


def import_object(name: str) -> Any:
    """What ``package.module:attribute`` names, imported; raises PlantError where there is no such thing."""
    module, _, attribute = name.partition(":")
    with running_user_code(name):
        imported = importlib.import_module(module)
        if not hasattr(imported, attribute):
            raise PlantError(f"plant {name}: module {module} has no {attribute!r}; give {HELP}")
        return getattr(imported, attribute)


@contextmanager
def running_user_code(name: str) -> Iterator[None]:
    """Run the code of the user's plant `name`: the working folder is on the path, all errors become PlantError."""
    # As `python -m` does: one's own simulator mostly lies in the folder where one works.
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        yield
    except PlantError:
        raise
    except Exception as error:
        # It may fail in any way.
        reason = " ".join(str(error).split())
        raise PlantError(f"plant {name}: {type(error).__name__}: {reason}; give {HELP}") from error
    finally:
        sys.path.remove(here)
