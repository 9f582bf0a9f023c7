"""Types of options: how each value is called in help, read, and checked; no JAX."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from softfin.cli.options import Option
from softfin.core.errors import ConfigurationError
from softfin.storage import artifact as artifacts
from softfin.storage import paths
from softfin.storage.registry import is_live, resolve_plant


def folder_of(kind: str, positional: bool = False) -> Option:
    """Option for the folder of an artifact, such as a controller."""
    metavar = kind.upper() if positional else "DIR"
    return Option(metavar, positional, check=lambda path, _: artifacts.find_description(Path(path), kind))


def plant(metavar: str = "PLANT", positional: bool = False) -> Option:
    """Option for the name of a simulated plant."""
    return Option(metavar, positional, check=lambda name, _: resolve_plant(name))


def _check_vacant(path: Path, command: Any) -> None:
    # With --resume the stage decides whether what is there is the run that goes on.
    artifacts.check_vacant(path, command.overwrite or getattr(command, "resume", False))


def _check_any_plant(name: str, _: Any) -> None:
    if not is_live(name):
        resolve_plant(name)


def _check_data(name: str, _: Any) -> None:
    path = Path(name)
    if path.is_dir() and not artifacts.is_kind(path, "surrogate"):
        artifacts.find_description(path, "dataset")
    else:
        resolve_plant(name)


def numbers(advice: str, count: int | None = None) -> Callable[[str, str], tuple[float, ...]]:
    """Make a reader of `count` numbers with commas between them, whose error ends in the advice."""

    def parse(text: str, option: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if not values or count not in (None, len(values)):
            raise ConfigurationError(f"{option} {text}: {advice}")
        return values

    return parse


def _force(text: str, option: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigurationError(f"{option}={text}: not a force; write {option}=X,Y in newton, as 1,-1") from None
    return x, y


Out: TypeAlias = Annotated[Path, Option("DIR", check=_check_vacant)]
File: TypeAlias = Annotated[Path, Option("FILE")]
ReferenceFile: TypeAlias = Annotated[Path, Option("FILE", check=lambda path, _: paths.check_reference_file(path))]
YamlFile: TypeAlias = Annotated[Path, Option("FILE", check=lambda path, _: paths.check_readable(path))]
Controller: TypeAlias = Annotated[Path, folder_of("controller", positional=True)]
Plant: TypeAlias = Annotated[str, plant()]
AnyPlant: TypeAlias = Annotated[str, Option("PLANT", check=_check_any_plant)]
LivePlant: TypeAlias = Annotated[str, Option("PLANT")]
Logs: TypeAlias = Annotated[Path, Option("LOGS", True, check=lambda path, _: paths.find_recordings(path))]
Data: TypeAlias = Annotated[str, Option("DATA", positional=True, check=_check_data)]
Force: TypeAlias = Annotated[tuple[float, float], Option("X,Y", parse=_force)]
