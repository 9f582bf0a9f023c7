"""What the values of options stand for: how each is called in help, read, and looked at; no JAX, NumPy or pydantic."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from softfin.cli.options import Option
from softfin.core.errors import ConfigurationError
from softfin.storage import artifact as artifacts
from softfin.storage import paths
from softfin.storage.registry import is_live, resolve_plant


def folder_of(kind: str, positional: bool = False) -> Option:
    """The folder of an artifact, such as a controller."""
    metavar = kind.upper() if positional else "DIR"
    return Option(metavar, positional, check=lambda path, _: artifacts.find_description(Path(path), kind))


def plant(metavar: str = "PLANT", positional: bool = False) -> Option:
    """The name of a simulated plant."""
    return Option(metavar, positional, check=lambda name, _: resolve_plant(name))


def logs(metavar: str = "LOGS") -> Option:
    """A dataset or recordings of any other kind, the first positional argument."""
    return Option(metavar, positional=True, check=lambda path, _: paths.find_recordings(path))


def _check_vacant(path: Path, command: Any) -> None:
    # With --resume the stage decides whether what is there is the run that goes on.
    artifacts.check_vacant(path, command.overwrite or getattr(command, "resume", False))


def _check_any_plant(name: str, _: Any) -> None:
    if is_live(name):
        check_live_plant(name, _)
    else:
        resolve_plant(name)


def check_live_plant(name: str, _: Any) -> None:
    """Raise a SoftfinError unless `name` stands for a real fin whose file is there."""
    if not is_live(name):
        raise ConfigurationError(
            f"--plant {name}: is not a real fin; give rig, ros2, or one of these with :FILE; softfin evaluate runs a "
            "controller on a simulated one"
        )
    kind, _, file = name.partition(":")
    paths.find_rig_file("rig" if kind == "rig" else "ros2", Path(file) if file else None)


def _check_data(name: str, _: Any) -> None:
    path = Path(name)
    if path.is_dir() and not artifacts.is_kind(path, "surrogate"):
        artifacts.find_description(path, "dataset")
    else:
        resolve_plant(name)


def numbers(advice: str, count: int | None = None) -> Callable[[str, str], tuple[float, ...]]:
    """A reader of `count` numbers with commas between them; what is none of these gets the advice as its error."""

    def parse(text: str, option: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if not values or count not in (None, len(values)):
            raise ConfigurationError(f"{option} {text}: {advice}")
        return values

    return parse


def force(text: str, option: str) -> tuple[float, float]:
    """A reference force as it is typed."""
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
Logs: TypeAlias = Annotated[Path, logs()]
Data: TypeAlias = Annotated[str, Option("DATA", positional=True, check=_check_data)]
Force: TypeAlias = Annotated[tuple[float, float], Option("X,Y", parse=force)]
LivePlant: TypeAlias = Annotated[str, Option("PLANT", check=check_live_plant)]
