"""Code that commands share: option types, configuration, arming, progress on stderr and results on
stdout. No JAX."""

import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, TypeAlias, TypeVar

from softfin.cli import options
from softfin.cli.options import Option
from softfin.core.choices import SEEDS, TransportName
from softfin.core.configuration import Configuration, read_yaml
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.core.printable import printable
from softfin.data.importing.importing import ImportConfig
from softfin.rig.arming import Arming
from softfin.storage import artifact as artifacts
from softfin.storage import paths
from softfin.storage.registry import is_live, resolve_plant

if TYPE_CHECKING:
    from softfin.rig.device import CheckResult
    from softfin.rig.robot_setup import RobotSetup

StageConfig = TypeVar("StageConfig", bound=Configuration)


def folder_option(kind: str, positional: bool = False) -> Option:
    """Option for the folder of an artifact, such as a controller."""
    metavar = kind.upper() if positional else "DIR"
    return Option(
        metavar, positional, check=lambda path, _: artifacts.find_description(Path(path), kind)
    )


def plant(metavar: str = "PLANT", positional: bool = False) -> Option:
    """Option for the name of a simulated plant."""
    return Option(metavar, positional, check=lambda name, _: resolve_plant(str(name)))


def _check_data(name: str | Path, _: object) -> None:
    path = Path(name)
    if path.is_dir() and not artifacts.is_kind(path, "surrogate"):
        artifacts.find_description(path, "dataset")
    else:
        resolve_plant(str(name))


def numbers(advice: str, count: int | None = None) -> Callable[[str, str], tuple[float, ...]]:
    """Return a parser for `count` comma-separated numbers; its error message ends with `advice`."""

    def parse(text: str, option: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if not values or count not in (None, len(values)):
            raise ConfigurationError(f"{option} {text}: {advice}")
        return values

    return parse


def _check_vacant(path: str | Path, command: Configuration) -> None:
    # With --resume the stage decides whether the existing output belongs to this run.
    may_exist = getattr(command, "overwrite", False) or getattr(command, "resume", False)
    artifacts.check_vacant(Path(path), may_exist)


Out: TypeAlias = Annotated[Path, Option("DIR", check=_check_vacant)]
File: TypeAlias = Annotated[Path, Option("FILE")]
ReferenceFile: TypeAlias = Annotated[
    Path, Option("FILE", check=lambda path, _: paths.check_reference_file(Path(path)))
]
YamlFile: TypeAlias = Annotated[
    Path, Option("FILE", check=lambda path, _: paths.check_readable(Path(path)))
]
ControllerFolder: TypeAlias = Annotated[Path, folder_option("controller", positional=True)]
PlantName: TypeAlias = Annotated[str, plant()]
AnyPlant: TypeAlias = Annotated[
    str, Option("PLANT", check=lambda name, _: is_live(str(name)) or resolve_plant(str(name)))
]
LivePlant: TypeAlias = Annotated[str, Option("PLANT")]
Logs: TypeAlias = Annotated[
    Path, Option("LOGS", True, check=lambda path, _: paths.find_recordings(Path(path)))
]
Data: TypeAlias = Annotated[str, Option("DATA", positional=True, check=_check_data)]
ForcePair: TypeAlias = Annotated[
    tuple[float, float],
    Option("X,Y", parse=numbers("not a force; use X,Y in newtons, e.g. 1,-1", 2)),
]


Repeats: TypeAlias = Annotated[int, Option(former_name="--seeds")]


class CommandOptions(Configuration):
    """Options of every command. Calling an instance runs the command."""

    HELP_TITLE: ClassVar = "general options"

    json_: bool = False
    """Print the result as JSON."""
    debug: bool = False
    """Show the traceback of an error."""

    def check(self) -> None:
        """Raise a SoftfinError for unusable options, before anything is computed or imported."""
        seed = getattr(self, "seed", None)
        if seed is not None and not 0 <= seed < SEEDS:
            raise ConfigurationError(f"--seed {seed}: must be a whole number from 0 to {SEEDS - 1}")
        options.check_values(self)

    def __call__(self) -> None:
        """Run the command."""
        raise NotImplementedError

    def tell_findings(self, findings: "Iterable[CheckResult]") -> str:
        """Print each finding as soon as it is available; returns the names of failed checks,
        separated by commas."""
        results = []
        for finding in findings:
            results.append(finding)
            if not self.json_:
                sys.stdout.write(printable(str(finding)) + "\n")
                sys.stdout.flush()
        if self.json_:
            self.tell([finding._asdict() for finding in results], "")
        return ", ".join(finding.what for finding in results if finding.state == "wrong")

    def tell(self, result: object, text: str) -> None:
        """Print the result, as JSON or as text."""
        sys.stdout.write(
            artifacts.dump_json(result) if self.json_ else printable(text.rstrip("\n"), "\n") + "\n"
        )


class Common(CommandOptions):
    """Options of every command that writes files."""

    HELP_TITLE: ClassVar = "general options"

    overwrite: bool = False
    """Replace existing output, and discard an unfinished run."""


class Configured(Common):
    """Options of every command that has a configuration."""

    HELP_TITLE: ClassVar = "general options"

    config: YamlFile | None = None
    """YAML file with configuration values; see docs/reference/configuration.md for the fields."""
    set: Annotated[tuple[str, ...], Option("PATH=VALUE")] = ()
    """Set one configuration value."""

    def configured(self, base: StageConfig, **given: object) -> StageConfig:
        """Return the default configuration with the YAML file, then `--set`, then the options
        applied.

        An option applies if its default is None or () and its name is that of a field. `given`
        contains the values that the command parses itself, or whose options have another name.
        """
        config = base
        if self.config is not None:
            config = base.merged(read_yaml(self.config), str(self.config))
        for name, option in type(self).model_fields.items():
            value = getattr(self, name)
            is_changed = option.default in (None, ()) and value not in (None, ())
            # The command itself interprets text options and passes their values in `given`.
            if name in type(base).model_fields and is_changed and not isinstance(value, str):
                given.setdefault(name, value)
        changes = {name: value for name, value in given.items() if value not in (None, ())}
        return config.changed(self.set).merged(changes, "options")


class NodeOptions(Configured):
    """Options of every command that runs as a ROS 2 node."""

    transport: TransportName | None = None
    """rclpy requires ROS 2, dds does not (default: auto, rclpy if it is installed)."""
    domain: int | None = None
    """ROS domain ID (default: ROS_DOMAIN_ID, or 0)."""
    network: str | None = None
    """For dds: network interface, such as eth0, on which to share the topics (default: this
    computer only)."""

    @property
    def connection(self) -> JsonObject | None:
        """Options that were set, as the node's `connection`; None if none were."""
        names = {"transport", "domain", "network"}
        return self.model_dump(include=names, exclude_none=True) or None


class LogOptions(ImportConfig):
    """Options of every command that reads recordings made by other software; softfin's own
    recordings need none of these."""

    HELP_TITLE: ClassVar = "logs not recorded by softfin"

    @property
    def recordings(self) -> ImportConfig:
        """Only the import options."""
        return ImportConfig(**{name: getattr(self, name) for name in ImportConfig.model_fields})

    @staticmethod
    def columns_read(columns: Mapping[str, str]) -> str:
        """Return one line per log: how columns without softfin's names were interpreted."""
        return "".join(f"{log}: {text}\n" for log, text in columns.items())


class Armed(Configuration):
    """Options of every command that may move a real fin."""

    arm: bool = False
    """Allow the real fin to move, after you confirm on the terminal."""
    yes: bool = False
    """With --arm, skip the confirmation. For scripts only: make sure that no one can reach the
    fin."""

    def confirm(
        self, robot: "RobotSetup", motion: str | None = None, needs_proof: bool = True
    ) -> None:
        """Ask the operator to confirm the motion; see `Arming.confirm`."""
        Arming(self.arm, self.yes).confirm(robot, motion, needs_proof)
