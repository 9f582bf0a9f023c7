"""Checks files and folders given by the user before any work starts. This module uses neither NumPy
nor JAX, so mistakes are reported immediately."""

import shlex
from collections.abc import Iterator
from pathlib import Path

from softfin.core.errors import ConfigurationError, LogError, SoftfinError
from softfin.storage import artifact as artifacts

CSV = (".csv", ".tsv", ".txt")
PARQUET = (".parquet",)
BAGS = (".mcap", ".db3", ".bag")
DATASET_PARTS = {"train": 4, "test": 3}
"""Subfolders of a dataset, and the number of digits in their log names."""

RIG_FILE = Path("rig.yaml")


def check_readable(
    path: Path, kind: type[SoftfinError] = ConfigurationError, hint: str = "", option: str = ""
) -> None:
    """Raise an error of class `kind` unless `path` is a readable file."""
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise kind(f"{option}{path}: cannot be read ({error.strerror or error}){hint}") from None


def find_recordings(path: Path) -> list[Path]:
    """Return the tables and bags at a path, sorted by name; raises LogError if there are none."""
    if not path.exists():
        raise LogError(
            f"{path}: no such file or folder; use a CSV file, a Parquet file, a ROS 2 bag, or a "
            "folder of them"
        )
    if not path.is_dir():
        check_readable(path, LogError, "; use a CSV file, a Parquet file or a ROS 2 bag")
    if artifacts.is_kind(path, "dataset"):
        train, test = list_logs(path)
        found = [*train, *test]
    else:
        found = list(_walk(path, ()))
    if not found:
        raise LogError(
            f"{path}: contains no recordings; supported are {', '.join((*CSV, *PARQUET))} files "
            f"and ROS bags ({', '.join(BAGS)})"
        )
    return found


def list_logs(dataset: Path) -> list[list[Path]]:
    """Return the logs of each part of a dataset, training logs first, sorted by name."""
    return [sorted((dataset / part).glob("*.parquet")) for part in DATASET_PARTS]


def _walk(path: Path, within: tuple[Path, ...]) -> Iterator[Path]:
    """Yield the recordings below a folder, without following links that lead back into the
    folder."""
    if path.is_file() or is_bag(path):
        if is_bag(path) or path.suffix.lower() in (*CSV, *PARQUET):
            yield path
    elif path.is_dir() and (folder := path.resolve()) not in within:
        for entry in sorted(path.iterdir()):
            if not entry.name.startswith("."):
                yield from _walk(entry, (*within, folder))


def is_bag(path: Path) -> bool:
    """Return whether `path` is a ROS bag: a bag folder or a file of a bag."""
    is_bag_file = path.suffix.lower() in BAGS and path.is_file()
    return is_bag_file or (path / "metadata.yaml").is_file()


def check_monitored(path: Path) -> None:
    """Raise LogError if there is no recording to follow."""
    if not path.is_file() and not path.is_dir():
        raise LogError(
            f"{path}: no such file or folder; use a bag (.mcap), or the folder that bags are "
            "written to"
        )


def check_reference_file(path: Path) -> None:
    """Raise ConfigurationError unless there is a readable .csv or .parquet file."""
    if path.suffix not in (".csv", ".parquet"):
        raise ConfigurationError(f"--reference-file {path}: must be a .csv or .parquet file")
    check_readable(path, option="--reference-file ")


def typed_path(path: Path | str) -> str:
    """Return a path as it is typed in a shell, even if it begins like an option."""
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)
