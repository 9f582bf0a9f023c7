"""Finds plants by name: ``tank``, a tank YAML file, a surrogate folder or
``package.module:plant``.

Real fins are called ``rig`` and ``ros2``, optionally followed by ``:FILE``;
`softfin.rig.robot_setup` opens them. A folder with the name of a plant must be written as
``./tank``. JAX is imported only when a plant is built.
"""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from softfin.core.errors import ConfigurationError, PlantError, one_line
from softfin.storage import artifact as artifacts
from softfin.storage.paths import find_recordings

if TYPE_CHECKING:
    from collections.abc import Callable

    from softfin.core.plant import Plant

TANK = "tank"
"""Name of the virtual tank."""

LIVE = ("rig", "ros2")
"""Names of real fins, which move in real time."""

HELP = (
    "tank, a tank YAML file, a surrogate folder (./NAME if it has the name of a plant), or "
    "package.module:plant (your own simulator)"
)


def is_live(name: str) -> bool:
    """Return whether `name` refers to a real fin."""
    return name.partition(":")[0] in LIVE


def is_surrogate(name: str) -> bool:
    """Return whether `name` refers to a surrogate folder."""
    return name != TANK and not is_live(name) and artifacts.is_kind(Path(name), "surrogate")


def resolve_plant(name: str) -> "Callable[[], Plant]":
    """Return a function that builds the plant `name`; if the plant does not exist, raises
    PlantError with the possible names."""
    path = Path(name)
    # Surrogates and tanks are in packages that depend on this package, so they are imported by
    # name.
    if is_live(name):
        folder = f"; for the folder of this name, use ./{name}" if path.exists() else ""
        raise PlantError(
            f"plant {name}: moves in real time and cannot be simulated; use it with collect, "
            f"evaluate or run{folder}"
        )
    if name == TANK or (path.suffix in (".yaml", ".yml") and path.is_file()):
        return partial(_build_tank, name)
    if artifacts.is_kind(path, "surrogate"):
        return lambda: importlib.import_module("softfin.surrogate").load_surrogate(path)
    if ":" in name and not path.exists():
        _import_plant(name)
        return partial(_import_plant, name, build=True)
    what = "does not exist"
    if path.is_dir():
        what = "contains no surrogate.json"
    elif path.exists():
        what = "is not a YAML file"
    raise PlantError(f"plant {name}: unknown ({what}); use {HELP}")


def check_plant(name: "str | Path | Plant") -> None:
    """Raise PlantError if there is no simulated plant with this name."""
    if isinstance(name, str | Path):
        resolve_plant(_name_path(name))


def _name_path(name: str | Path) -> str:
    """Return a path as text that cannot be mistaken for the name of a plant."""
    if isinstance(name, str):
        return name
    return str(name) if name.is_absolute() else f"./{name}"


def check_data(name: "str | Path | Plant") -> None:
    """Raise SoftfinError if `name` is neither a folder of logs nor a plant."""
    if not isinstance(name, str | Path):
        _check_is_plant(name, "data")
        return
    path = Path(name)
    if path.is_dir() and not artifacts.is_kind(path, "surrogate"):
        find_recordings(path)
    else:
        resolve_plant(_name_path(name))


def find_plant(name: "str | Path | Plant") -> "Plant":
    """Build or load a plant.

    Args:
        name: tank, a tank YAML file, a surrogate folder, package.module:name, rig:FILE, or a plant,
            which is returned unchanged.

    Returns:
        The plant.

    Raises:
        PlantError: If the plant does not exist or its limits are invalid.

    Example:
        >>> tank = softfin.find_plant("tank")
    """
    if not isinstance(name, str | Path):
        return _check_is_plant(name, "plant")
    from softfin.core.quantities import Limits

    check_precision()
    plant = resolve_plant(_name_path(name))()
    try:
        problem = Limits(*map(float, plant.limits)).problem()
    except (TypeError, ValueError) as error:
        raise PlantError(
            f"plant {name}: limits must be a softfin.Limits of four numbers ({error})"
        ) from None
    if problem:
        raise PlantError(f"plant {name}: {problem}")
    if not type(plant).__module__.startswith("softfin."):
        _check_simulator(plant, str(name))
    return plant


def check_precision() -> None:
    """Raise ConfigurationError if JAX computes in double precision, because softfin's programs
    would not compile."""
    import jax

    if cast(Any, jax.config).read("jax_enable_x64"):
        raise ConfigurationError(
            "JAX: jax_enable_x64 is on, but softfin computes in single precision; unset "
            "JAX_ENABLE_X64 or call jax.config.update('jax_enable_x64', False)"
        )


def _check_simulator(plant: "Plant", name: str) -> None:
    """Raise PlantError if a user's simulator has no identity or cannot be traced."""
    import jax

    from softfin.core.plant import rest_command
    from softfin.core.plant_identity import identity

    identity(plant)
    command = rest_command(plant.limits)
    try:
        jax.eval_shape(lambda key: plant.advance(plant.init(key), command, 1), jax.random.key(0))
    except Exception as error:
        # The user's code may raise any error.
        raise PlantError(
            f"plant {name}: cannot be traced ({type(error).__name__}: {one_line(error)}); run "
            "softfin.testing.check_plant to find out what is wrong"
        ) from error


def plant_name(plant: object) -> str:
    """Return the name by which the user selected a plant, or the name of its class."""
    return str(plant) if isinstance(plant, str | Path) else type(plant).__name__


def _build_tank(name: str) -> Any:
    from softfin.core.configuration import read_yaml

    tank = importlib.import_module("softfin.tank")
    return tank.Tank(tank.TankConfig.build({} if name == TANK else read_yaml(Path(name)), name))


def import_object(name: str) -> Any:
    """Import ``package.module:attribute`` from the current folder or an installed package; raises
    any error that the module raises."""
    module, _, attribute = name.partition(":")
    with _current_folder_on_path():
        return getattr(importlib.import_module(module), attribute)


def build_object(name: str, protocols: "tuple[type, ...]") -> Any:
    """Import ``package.module:attribute``, and call it if it is a class or a function rather than
    an object with one of the protocols; raises any error that the module raises."""
    found = import_object(name)
    if isinstance(found, type) or (callable(found) and not isinstance(found, protocols)):
        with _current_folder_on_path():
            return found()
    return found


@contextmanager
def _current_folder_on_path() -> Iterator[None]:
    # As with `python -m`, because users usually keep their own modules in the working directory.
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        yield
    finally:
        sys.path.remove(here)


def _import_plant(name: str, build: bool = False) -> Any:
    """Import ``package.module:attribute``. With `build`, return the plant, which is the attribute
    itself or the result of calling it."""
    try:
        if not build:
            return import_object(name)
        from softfin.core.plant import Plant

        plant = build_object(name, (Plant,))
    except Exception as error:
        # The user's code may raise any error.
        reason = one_line(error)
        raise PlantError(f"plant {name}: {type(error).__name__}: {reason}; use {HELP}") from error
    return _check_is_plant(plant, f"plant {name}")


def _check_is_plant(plant: object, name: str) -> "Plant":
    """Return the object if it is a plant; otherwise raise PlantError."""
    from softfin.core.plant import Plant

    if not isinstance(plant, Plant):
        raise PlantError(
            f"{name}: a {type(plant).__name__} is not a plant with limits, init and advance; run "
            "softfin.testing.check_plant to find out what is missing, or use the name of a plant"
        )
    return plant
